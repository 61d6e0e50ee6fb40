"""``gpebo check``: every assumption that a run would rest on, with its evidence."""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gpebo_cli.cli import arguments as command_line
from gpebo_cli.errors import ConfigError
from gpebo_cli.schema import instant

if TYPE_CHECKING:
    from gpebo_cli.experiment.assumptions import Examination
    from gpebo_cli.experiment.sensors import Sensor
    from gpebo_cli.findings import Assumption

_WIDTH = 100
_TIMES = ("at", "t_c")  # in evidence

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
    "Assumption 1": "add an output (a row of C) that sees the algebraic states, or take hidden "
    "constraints (observer.form=strangeness_free)",
    "Assumption 2": "the direction named is not visible in the outputs: measure more "
    "(sensors=all tries every state), lengthen time.horizon, start at another time, "
    "or leave an unknown out; one that no output depends on cannot be estimated. Another input "
    "helps only where psi_depends_on names one, or an output",
    "Assumption 3": "measure z_a alone with one output, or use observer=gpebo",
    "Assumption 4": "choose a horizon without that zero, or use observer=gpebo",
    "Assumption 5": "as for Assumption 2: measure more, or lengthen time.horizon",
    "Assumption 6": "name an output that fits (observer.output), or use observer=gpebo",
    "Assumption 7": "choose another gain (observer.L_w), or use observer=gpebo",
    "uniform observability": "what was learnt before lasts only as long as observer.process is 0; "
    "measure more, or use observer=gpebo, which needs Assumption 2 alone",
    "Growth of Φ": "the observer's own dynamics are unstable over this horizon: take a remedy of "
    "observer=gpebo in continuous time (observer.remedy=output_injection, reset or "
    "current_coordinates), shorten time.horizon, or take outputs that see more of the state",
}
"""What to do about an assumption that fails, by its name."""


def main(words: list[str]) -> int:
    """Print the table, or JSON; 0 if everything that is needed holds, else 1 (ConfigError)."""
    sensors = "sensors=all" in words
    wrong = [word for word in words if word.startswith("sensors=") and word != "sensors=all"]
    if wrong:
        raise ConfigError(f"{wrong[0]}: the only choice is sensors=all, every state in turn")
    arguments = command_line.parse(
        [word for word in words if word != "sensors=all"], "check", ["--json"]
    )
    switches = arguments.given.switches
    word = "-m" if "--multirun" in switches else arguments.of_a_sweep
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
        from gpebo_cli.experiment.assumptions import examine
        from gpebo_cli.experiment.sensors import candidates

        examined = examine(job.settings, job.system)
        tried = candidates(job.settings, job.system) if sensors else []
    found = examined.assumptions
    title = f"plant {job.system.name}, observer {job.settings.observer['name']}"
    sys.stdout.write(
        _json(examined, tried) if "--json" in switches
        else _table(title, found, [*_knowledge(examined), *_sensors(tried)])
    )
    return 0 if all(a.holds for a in found) else 1


def _knowledge(examined: Examination) -> list[str]:
    """What can be known, from when on, and how well."""
    width, lines = max(map(len, examined.estimable), default=0), []
    for name, since in examined.estimable.items():
        why = "left out by this observer" if name in examined.left_out else "cannot be known"
        text = why if since is None else f"estimable from t = {instant(since)} s on"
        if (deviation := examined.deviations.get(name)) is not None:
            text += f", deviation {deviation:.3g} per unit of noise of the outputs"
        lines.append(f"  {name:<{width}}  {text}")
    return lines


def _sensors(tried: Sequence[Sensor]) -> list[str]:
    """A row for each state as a further output, the best first, then the best beside it."""
    if not tried:
        return []
    from gpebo_cli.results.report import columns

    rows = [["measure too", "estimable", "gained", "deviations fall by", "with those above by"]]
    rows += [
        [s.state, str(len(s.estimable)), ", ".join(s.gained) or "nothing", f"{s.fall:.3g}",
         f"{s.fall_together:.3g}"]
        for s in tried
    ]
    return columns(rows)


def _json(examined: Examination, tried: Sequence[Sensor]) -> str:
    from gpebo_cli.results.summary import strict

    found = examined.assumptions
    content: dict[str, object] = {
        "holds": all(a.holds for a in found), "assumptions": [vars(a) for a in found],
        "estimable": examined.estimable, "deviations": examined.deviations,
    }
    if tried:
        content["sensors"] = [vars(sensor) for sensor in tried]
    return json.dumps(strict(content), indent=2, ensure_ascii=False) + "\n"


def _table(title: str, found: Sequence[Assumption], more: Sequence[str]) -> str:
    width = max(len(a.name) for a in found)
    lines = [title]
    for a in found:
        lines.append(f"  {'holds' if a.holds else 'FAILS'}  {a.name:<{width}}  {a.statement}")
        evidence = ", ".join(
            f"{k} {'none' if v is None else v}" if not isinstance(v, float)
            else f"{k} {instant(v) if k in _TIMES else f'{v:.4g}'}"
            for k, v in a.evidence.items()
        )
        lines += _wrapped(evidence, " " * (width + 11))
        # Other refusals of a simulation say themselves what to do.
        advised = a.name != "Solvability" or "not uniquely solvable" in evidence
        if not a.holds and a.name in _ADVICE and advised:
            lines += _wrapped(f"to do: {_ADVICE[a.name]}", " " * (width + 11))
    failed = [a.name for a in found if not a.holds]
    verdict = f"{', '.join(failed)} failed" if failed else "everything that is needed holds"
    return "\n".join([*lines, *more, verdict]) + "\n"


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=indent, subsequent_indent=indent)
