"""``gpebo run``: hands the command line to Hydra, runs each job, reports."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from gpebo_cli.cli import arguments as command_line
from gpebo_cli.cli.arguments import Arguments
from gpebo_cli.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpebo_cli.experiment.result import RunResult
    from gpebo_cli.model.descriptor import DescriptorSystem
    from gpebo_cli.settings import Settings

STDIN = "-"  # as data.file: rows are read from standard input, as they come


def main(words: list[str]) -> int:
    """Do what the words after ``gpebo run`` ask for; the exit code.

    Raises:
        GpeboError: whatever is wrong with the words, the configuration or the run.
    """
    arguments = command_line.parse(words)
    if "--version" in arguments.switches:
        from gpebo_cli._version import __version__

        sys.stdout.write(f"gpebo {__version__}\n")
        return 0
    if arguments.config_dir is not None:
        from gpebo_cli.cli.guard import check_folder

        check_folder(arguments.config_dir, arguments.config_name)
    jobs = _Jobs(arguments)
    if f"data.file={STDIN}" in arguments.overrides:  # no folder: its estimates go to stdout
        arguments = arguments.with_override("hydra.run.dir=.")
    call_hydra(arguments, jobs)
    return jobs.finish()


def call_hydra(arguments: Arguments, task: Callable[[DictConfig], None]) -> None:
    """Compose and call ``task`` with the configuration of every job; its errors as ours.

    Raises:
        ConfigError: the command line or a file is wrong.
    """
    # Without it Hydra prints its errors, over several lines, and exits with 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Hydra's own parser reads sys.argv, and names the program after it in --hydra-help.
    sys.argv = [f"{sys.argv[0]} run", *arguments.for_hydra]
    import hydra

    from gpebo_cli.cli.hydra_errors import LIBRARY_ERRORS, explain
    from gpebo_cli.cli.locations import conf_folder

    def job(cfg: DictConfig) -> None:
        task(cfg)

    decorate = hydra.main(
        version_base="1.3", config_path=conf_folder(), config_name=command_line.PRIMARY
    )
    try:
        decorate(job)()
    except LIBRARY_ERRORS as error:
        raise ConfigError(explain(error, arguments)) from error


class _Jobs:
    """A single run or a sweep's job; which, Hydra knows: a recipe may set ``hydra.mode``.

    A sweep's launcher may send a copy of this object to another process. Its jobs therefore leave
    nothing in it: what became of them is on disk, where the sweep collects it.
    """

    def __init__(self, arguments: Arguments) -> None:
        self._arguments = arguments
        self._single: _Single | None = None

    def __call__(self, cfg: DictConfig) -> None:
        from hydra.core.hydra_config import HydraConfig
        from hydra.types import RunMode

        if HydraConfig.get().mode == RunMode.MULTIRUN:
            from gpebo_cli.cli.sweep import run_sweep_job

            run_sweep_job(cfg, self._arguments)
        else:
            self._single = _Single(self._arguments)
            self._single(cfg)

    def finish(self) -> int:
        """Print the result, or raise what went wrong; of a sweep, or without a job, nothing."""
        return 0 if self._single is None else self._single.finish()


class _Single:
    """One run, called back by Hydra.

    What goes wrong is kept and raised when Hydra is done: raised inside, Hydra would print about
    it, too.
    """

    def __init__(self, arguments: Arguments) -> None:
        self._arguments = arguments
        self._error: Exception | None = None
        self._done: tuple[RunResult, str] | None = None
        self._stream: tuple[Settings, DescriptorSystem] | None = None

    def __call__(self, cfg: DictConfig) -> None:
        from omegaconf import OmegaConf

        from gpebo_cli.cli.job import output_folder, read_job, remove_if_empty, run_job

        folder = output_folder()
        if word := self._arguments.of_a_sweep:
            remove_if_empty(folder)
            self._error = ConfigError(
                f"{word} is for a sweep; add -m and several values, as in "
                "-m estimator.gamma=1e6,1e8"
            )
            return
        try:
            if OmegaConf.select(cfg, "data.file") == STDIN:
                remove_if_empty(folder)
                self._stream = read_job(cfg, self._arguments, draw=False)[:2]
                return
            self._done = run_job(cfg, self._arguments, folder, draw=True), folder
        except Exception as error:  # noqa: BLE001  raised again by finish()
            remove_if_empty(folder)
            self._error = error

    def finish(self) -> int:
        """Print the result, or raise what went wrong."""
        if self._error is not None:
            raise self._error
        if self._stream is not None:
            from gpebo_cli.cli import stream

            return stream.run(*self._stream)
        if self._done is not None:
            from gpebo_cli.cli.report import print_run

            result, folder = self._done
            print_run(result, os.path.relpath(folder))
        return 0
