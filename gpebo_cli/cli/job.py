"""One job of Hydra's: its configuration read, the experiment run, its folder written."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gpebo_cli.cli import composed, configuration
from gpebo_cli.cli.arguments import PRIMARY, Arguments
from gpebo_cli.cli.locations import GROUPS, conf_folder
from gpebo_cli.cli.report import Progress
from gpebo_cli.errors import ConfigError

if TYPE_CHECKING:
    from gpebo_cli.experiment.result import RunResult
    from gpebo_cli.model.descriptor import DescriptorSystem
    from gpebo_cli.settings import Settings


def output_folder() -> str:
    """The folder that Hydra has made for the running job."""
    return str(HydraConfig.get().runtime.output_dir)


def remove_if_empty(folder: str) -> None:
    """Remove the folder of a job that wrote nothing, unless it is where the user stands."""
    if os.path.realpath(folder) == os.path.realpath(os.curdir):
        return
    try:
        os.rmdir(folder)
    except OSError:  # not empty: somebody's, or useful
        return


def run_job(
    cfg: DictConfig, arguments: Arguments, folder: str, *, draw: bool, quiet: bool = False
) -> RunResult:
    """Run the experiment that ``cfg`` describes and write ``folder``.

    Args:
        cfg: the job's configuration, without Hydra's section.
        arguments: the command line, for where files came from.
        folder: where to write.
        draw: whether figures are drawn unless the configuration says otherwise.
        quiet: whether to leave the terminal alone: a sweep shows its own progress.

    Raises:
        GpeboError: the configuration is wrong, or the experiment failed.
    """
    settings, system, config = read_job(cfg, arguments, draw=draw)

    # Only now, when the configuration is known to be good: half a second of imports.
    from gpebo_cli.experiment.pipeline import run_experiment
    from gpebo_cli.results.figures import check_names
    from gpebo_cli.results.folder import write_run

    if isinstance(settings.output.figures, list):
        check_names(settings.output.figures)
    with Progress(quiet=quiet) as progress:
        result = run_experiment(settings, system, progress)
        progress("write")
        write_run(result, Path(folder), configuration.config_text(config, _patterns()))
    return result


def read_job(
    cfg: DictConfig, arguments: Arguments, *, draw: bool
) -> tuple[Settings, DescriptorSystem, dict[str, Any]]:
    """Settings, plant and the plain configuration that ``cfg`` describes.

    Raises:
        ConfigError: the configuration or the plant is wrong.
    """
    choices = dict(HydraConfig.get().runtime.choices)
    _refuse_shadowed(choices, arguments)
    config = composed.plain(cfg)
    settings = configuration.settings(config, draw=draw)

    from gpebo_cli.model.plant import plant_from_mapping

    system = plant_from_mapping(settings.plant, _plant_file(choices, arguments))
    return settings, system, configuration.complete(config, settings)


def _refuse_shadowed(choices: dict[str, str | None], arguments: Arguments) -> None:
    """Hydra silently prefers its first folder; a user's file that it ignores is a trap."""
    if arguments.config_dir is None:
        return
    for group in GROUPS:
        name = f"{choices.get(group)}.yaml"
        mine = os.path.join(arguments.config_dir, group, name)
        if os.path.isfile(mine) and os.path.isfile(os.path.join(conf_folder(), group, name)):
            raise ConfigError(
                f"{mine} has the name of one that comes with gpebo and would be ignored; rename it"
            )


def _plant_file(choices: dict[str, str | None], arguments: Arguments) -> str:
    """Where the plant was written, for messages."""
    if "plant" in choices:
        inside = os.path.join("plant", f"{choices['plant']}.yaml")
    else:
        inside = f"{arguments.config_name}.yaml"
    for folder in arguments.folders:
        path = os.path.join(folder, inside)
        if os.path.isfile(path):
            return min(path, os.path.relpath(path), key=len)
    return ""


def _patterns() -> configuration.RunPatterns:
    """The patterns of folders that a repeated run gets: never this run's own folder.

    Where the folder is fixed, by the user or because the job is one of a sweep, the pattern is
    the one of conf/gpebo.yaml.
    """
    hydra = HydraConfig.get()
    run, sweep = (
        cast("dict[str, str]", OmegaConf.to_container(section, resolve=False))
        for section in (hydra.run, hydra.sweep)
    )
    if "${now:" not in str(run["dir"]) or "${now:" not in str(sweep["dir"]):
        path = os.path.join(conf_folder(), f"{PRIMARY}.yaml")
        return configuration.patterns(configuration.load(path))
    return configuration.patterns({"hydra": {"run": run, "sweep": sweep}})
