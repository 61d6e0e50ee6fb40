"""``gpebo run``: composes the configuration, runs it once or hands it to a sweep, reports."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from gpebo_cli.cli import arguments as command_line
from gpebo_cli.cli.arguments import Arguments
from gpebo_cli.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

STDIN = "-"  # as data.file: rows are read from standard input, as they come


def main(words: list[str]) -> int:
    """Do what the words after ``gpebo run`` ask for; the exit code (ConfigError)."""
    arguments = command_line.parse(words)
    from gpebo_cli.cli import composition

    with composition.session(arguments) as hydra:
        if composition.show(hydra, arguments):
            return 0
        config, swept = composition.compose(hydra, arguments)
        own, other = ("sweep", "run") if swept else ("run", "sweep")
        given = {word.lstrip("+").partition("=")[0] for word in arguments.overrides}
        if f"hydra.{other}.dir" in given and f"hydra.{own}.dir" not in given:
            raise ConfigError(
                f"hydra.{other}.dir: the folder of this {own} is given by hydra.{own}.dir=FOLDER"
            )
        if not swept:
            return _once(config, arguments)

        from hydra._internal.callbacks import Callbacks
        from hydra.core.plugins import Plugins
        from hydra.types import HydraContext

        from gpebo_cli.cli.sweep import run_sweep_job

        sweeper = Plugins.instance().instantiate_sweeper(
            config=config,
            hydra_context=HydraContext(hydra.config_loader, Callbacks()),
            task_function=partial(run_sweep_job, arguments=arguments, starter=os.getpid()),
        )
        sweeper.sweep(list(config.hydra.overrides.task))
    return 0


def _once(config: DictConfig, arguments: Arguments) -> int:
    """One run: into a new folder, or from standard input to standard output."""
    if word := arguments.of_a_sweep:
        raise ConfigError(
            f"{word} is for a sweep; add -m and several values, as in -m estimator.gamma=1e6,1e8"
        )
    from gpebo_cli.cli.job import destination, read_job, remove_if_empty, run_job

    job = read_job(config, arguments, draw=True)
    if job.settings.data.file == STDIN:
        from gpebo_cli.cli import stream

        return stream.run(job.settings, job.system)
    # Its name has parts of the configuration, which has been checked by now.
    folder, given = destination("hydra.run.dir", config.hydra.run.dir), arguments.given
    from gpebo_cli.results.files import make_folder
    from gpebo_cli.results.report import loud_lines, run_lines

    make_folder(Path(folder))  # now, and not after an hour, if it cannot be made
    try:
        result = run_job(job, folder, quiet=given.quiet, loud=given.loud)
    except BaseException:
        remove_if_empty(folder)
        raise

    lines = [] if given.quiet else run_lines(result, os.path.relpath(folder))
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()  # before what follows on stderr
    more = loud_lines(result) if given.loud else []
    more += [f"gpebo: warning: {line}" for line in result.warnings]
    sys.stderr.write("".join(f"{line}\n" for line in more))
    return 0
