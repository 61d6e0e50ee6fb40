"""``gpebo check``: every assumption that a run would rest on, with its evidence."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gpebo_cli.commands import arguments as command_line
from gpebo_cli.commands.arguments import Arguments
from gpebo_cli.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpebo_cli.result import Assumption

_WIDTH = 100


def main(words: list[str]) -> int:
    """Print the table, or JSON; 0 if everything that is needed holds, else 1.

    Raises:
        GpeboError: the words or the configuration are wrong, or the solver fails.
    """
    if "--help" in words or "-h" in words:
        from gpebo_cli.commands.usage import CHECK_HELP

        sys.stdout.write(CHECK_HELP)
        return 0
    as_json = "--json" in words
    arguments = command_line.parse([word for word in words if word != "--json"])
    word = "-m" if "--multirun" in arguments.switches else arguments.of_a_sweep
    if word:
        raise ConfigError(f"gpebo check looks at one configuration; leave out {word}")
    if arguments.config_dir is not None:
        from gpebo_cli.commands.guard import check_folder

        check_folder(arguments.config_dir, arguments.config_name)
    check = _Check(arguments)
    from gpebo_cli.commands.run import call_hydra

    # Hydra makes the folder of a job before it runs it; a check writes nothing.
    # A recipe of a sweep is checked as far as it goes without the sweep.
    once = arguments.with_override("hydra.run.dir=.").with_override("hydra.mode=RUN")
    call_hydra(once, check)
    return check.finish(as_json=as_json)


class _Check:
    """Called back by Hydra; keeps what was found, or what went wrong."""

    def __init__(self, arguments: Arguments) -> None:
        self._arguments = arguments
        self._error: Exception | None = None
        self._title = ""
        self._found: Sequence[Assumption] = ()

    def __call__(self, cfg: DictConfig) -> None:
        from gpebo_cli.commands.job import read_job

        try:
            settings, system, _ = read_job(cfg, self._arguments, draw=False)
            from gpebo_cli.assumptions import check

            self._title = f"plant {system.name}, observer {settings.observer.name}"
            self._found = check(settings, system)
        except Exception as error:  # noqa: BLE001  raised again by finish()
            self._error = error

    def finish(self, *, as_json: bool) -> int:
        """Print what was found, or raise what went wrong."""
        if self._error is not None:
            raise self._error
        if not self._found:  # --cfg and the like: no job was run
            return 0
        failed = [a for a in self._found if not a.holds]
        sys.stdout.write(_json(self._found) if as_json else _table(self._title, self._found))
        return 1 if failed else 0


def _json(found: Sequence[Assumption]) -> str:
    from gpebo_cli.outputs.summary import plain

    rows = [
        {"name": a.name, "statement": a.statement, "holds": a.holds, "evidence": a.evidence}
        for a in found
    ]
    holds = all(a.holds for a in found)
    text = json.dumps(plain({"holds": holds, "assumptions": rows}), indent=2, ensure_ascii=False)
    return text + "\n"


def _table(title: str, found: Sequence[Assumption]) -> str:
    width = max(len(a.name) for a in found)
    lines = [title]
    for a in found:
        lines.append(f"  {'holds' if a.holds else 'FAILS'}  {a.name:<{width}}  {a.statement}")
        evidence = ", ".join(f"{key} {_value(value)}" for key, value in a.evidence.items())
        lines += _wrapped(evidence, " " * (width + 11))
    failed = [a.name for a in found if not a.holds]
    verdict = f"{', '.join(failed)} failed" if failed else "everything that is needed holds"
    return "\n".join([*lines, verdict]) + "\n"


def _value(value: float | str | None) -> str:
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _wrapped(text: str, indent: str) -> list[str]:
    import textwrap

    return textwrap.wrap(text, _WIDTH, initial_indent=indent, subsequent_indent=indent)
