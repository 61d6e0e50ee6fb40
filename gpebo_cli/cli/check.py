"""``gpebo check``: every assumption that a run would rest on, with its evidence."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gpebo_cli.cli import arguments as command_line
from gpebo_cli.errors import ConfigError

if TYPE_CHECKING:
    from gpebo_cli.findings import Assumption

_WIDTH = 100

_ADVICE = {
    "Solvability": "every state needs an equation of its own: look for a row that is missing, zero "
    "or the same as another, and for a state that stands in no row; if the index is really that "
    "high, raise solver.max_strangeness_index; if a rank changes at one time, choose a horizon "
    "(time.start, time.horizon) without it",
    "Regularity": "an equation is missing or stands twice: λE − A is singular for every λ",
    "Rank condition D2": "add an output that sees the algebraic states, as a row of C",
    "No impulses": "use a continuous input, for instance tanh(20*(t - 1)) instead of step(t - 1), "
    "or simulate only, with observer=none",
    "Rank of E": "choose a horizon in which no entry of E passes through zero; an E with a row of "
    "zeros is fine as long as it stays one",
    "Observer": "change the plant as said above, or use observer=gpebo",
    "Assumption 1": "add an output (a row of C) that sees the algebraic states",
    "Assumption 2": "the direction named is not visible in the outputs: change the input, so that "
    "the regressor's columns differ, measure more, or lengthen time.horizon; an unknown that no "
    "output depends on cannot be estimated",
    "Assumption 3": "measure z_a alone with one output, or use observer=gpebo",
    "Assumption 4": "choose a horizon without that zero, or use observer=gpebo",
    "Assumption 5": "as for Assumption 2: change the input, measure more, or lengthen time.horizon",
    "Assumption 6": "name an output that fits (observer.output), or use observer=gpebo",
    "Assumption 7": "choose another gain (observer.L_w), or use observer=gpebo",
    "uniform observability": "what was learnt before lasts only as long as observer.process is 0; "
    "measure more, or use observer=gpebo, which needs Assumption 2 alone",
    "Growth of Φ": "the observer's own dynamics are unstable over this horizon: shorten "
    "time.horizon, or take outputs that see more of the state",
}
"""What to do about an assumption that fails, by its name."""


def main(words: list[str]) -> int:
    """Print the table, or JSON; 0 if everything that is needed holds, else 1.

    Raises:
        ConfigError: the words or the configuration are wrong.
        GpeboError: the solver fails.
    """
    if "--help" in words or "-h" in words:
        from gpebo_cli.cli.usage import CHECK_HELP

        sys.stdout.write(CHECK_HELP)
        return 0
    as_json = "--json" in words
    arguments = command_line.parse(
        [word for word in words if word != "--json"], "check", ("--json", "--help")
    )
    word = "-m" if "--multirun" in arguments.switches else arguments.of_a_sweep
    if word:
        raise ConfigError(f"gpebo check looks at one configuration; leave out {word}")
    from gpebo_cli.cli import composition

    with composition.session(arguments) as hydra:
        if composition.show(hydra, arguments):
            return 0
        # A recipe of a sweep is checked as far as it goes without the sweep.
        config, _ = composition.compose(hydra, arguments)
        from gpebo_cli.cli.job import read_job

        job = read_job(config, arguments, draw=False)
        from gpebo_cli.experiment.assumptions import check

        found = check(job.settings, job.system)
    title = f"plant {job.system.name}, observer {job.settings.observer['name']}"
    sys.stdout.write(_json(found) if as_json else _table(title, found))
    return 0 if all(a.holds for a in found) else 1


def _json(found: Sequence[Assumption]) -> str:
    from gpebo_cli.results.summary import plain

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
        if not a.holds and a.name in _ADVICE:
            lines += _wrapped(f"to do: {_ADVICE[a.name]}", " " * (width + 11))
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
