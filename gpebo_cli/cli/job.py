"""One job: its configuration read, the experiment run, its folder written."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from gpebo_cli.cli import composition
from gpebo_cli.cli.arguments import Arguments
from gpebo_cli.cli.progress import Progress
from gpebo_cli.configs import configuration
from gpebo_cli.errors import ConfigError
from gpebo_cli.reading import as_seen_from_here

if TYPE_CHECKING:
    from gpebo_cli.experiment.result import RunResult
    from gpebo_cli.model.descriptor import DescriptorSystem
    from gpebo_cli.settings import Settings


@dataclass(frozen=True)
class Job:
    """A configuration that has been checked."""

    settings: Settings
    system: DescriptorSystem
    config: dict[str, Any]  # as ``config.yaml`` has it


def read_job(cfg: DictConfig, arguments: Arguments, *, draw: bool) -> Job:
    """The job that ``cfg`` describes; figures are drawn if it, or else ``draw``, says so."""
    config = composition.plain(cfg)
    settings = configuration.settings(config, draw=draw)

    from gpebo_cli.estimators import build
    from gpebo_cli.recordings.drive import located
    from gpebo_cli.regression.text import system_from_mapping

    build(settings.estimator)  # used or not: its name becomes part of a folder's
    hydra = cfg.hydra if "hydra" in cfg else HydraConfig.get()
    source = described_in(hydra.runtime.choices, arguments)
    system = system_from_mapping(config["plant"], source)
    config["plant"] = located(config["plant"], source)
    return Job(settings, system, configuration.complete(config, settings))


def run_job(job: Job, folder: str, *, quiet: bool, loud: bool) -> RunResult:
    """Run the experiment of ``job`` and write ``folder``."""
    # Only now, when the configuration is known to be good: half a second of imports.
    from gpebo_cli.experiment.pipeline import run_experiment
    from gpebo_cli.results.figures import check_names
    from gpebo_cli.results.folder import write_run
    from gpebo_cli.results.tables import check_parquet

    settings = job.settings
    if isinstance(settings.output.figures, list):
        check_names(settings.output.figures)
    if settings.output.parquet:
        check_parquet()
    with Progress(quiet=quiet, loud=loud) as progress:
        result = run_experiment(settings, job.system, progress)
        progress("write")
        write_run(result, Path(folder), configuration.config_text(job.config))
    return result


def destination(key: str, given: object) -> str:
    """The folder that ``key`` names, absolute (ConfigError: it is empty, as an unset variable)."""
    if not (path := str(given)):
        raise ConfigError(f"{key} is empty; give a folder (the current one is .) or leave it away")
    return os.path.abspath(os.path.expanduser(path))


def remove_if_empty(folder: str) -> None:
    """Remove the folder of a run that wrote nothing, unless it is where the user stands."""
    if os.path.realpath(folder) != os.path.realpath(os.curdir):
        with suppress(OSError):  # not empty: somebody's, or useful
            os.rmdir(folder)


def described_in(chosen: Mapping[str, Any], arguments: Arguments) -> str:
    """Where the plant or regression that was chosen, or the primary configuration, was written."""
    files = (f"{group}/{chosen[group]}" for group in ("regression", "plant") if chosen.get(group))
    inside = next(files, arguments.config_name)
    for folder in arguments.folders:
        path = os.path.join(folder, f"{inside}.yaml")
        if os.path.isfile(path):
            return as_seen_from_here(path)
    return ""
