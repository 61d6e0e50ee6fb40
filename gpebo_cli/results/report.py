"""What a person sees of a run: a table, what moved, the last line."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gpebo_cli.errors import printable
from gpebo_cli.evidence.metrics import is_metric
from gpebo_cli.results.names import SETTLED, known_by, shown_metrics
from gpebo_cli.results.symbols import number_text, symbol
from gpebo_cli.schema import instant

if TYPE_CHECKING:
    from gpebo_cli.experiment.result import NoiseStatistics, RunResult

_SHOWN_CASES = 12


def case_rows(result: RunResult, chosen: Iterable[int] | None = None) -> list[dict[str, float]]:
    """Gains and metrics of cases (None: all), named as in ``cases.csv``; none if unestimated."""
    estimation, metrics = result.estimation, result.metrics
    if estimation is None or metrics is None:
        return []
    columns, cases = metrics.columns, estimation.cases
    return [
        {**cases[i], **{name: float(values[i]) for name, values in columns.items()}}
        for i in (range(len(cases)) if chosen is None else chosen)
    ]


def loud_lines(result: RunResult) -> list[str]:
    """What the solvers did, for ``-v``: index, mesh, error estimates, versions."""
    from gpebo_cli.results.provenance import provenance
    from gpebo_cli.results.summary import summary

    told = summary(result, provenance())
    errors = {name: value for name, value in told["error_estimate"].items()
              if isinstance(value, float)}
    return [
        f"index {told['index']}, {told['elements']} elements, error estimates "
        + ", ".join(f"{name} {value:.2g}" for name, value in errors.items()),
        ", ".join(f"{name} {version}" for name, version in told["versions"].items()),
    ]


def case_table(result: RunResult) -> list[str]:
    """The lines of a table with one row per case; the middle of a long one is left out."""
    cases = () if result.estimation is None else result.estimation.cases
    count, half = len(cases), _SHOWN_CASES // 2
    few = count <= _SHOWN_CASES
    rows = case_rows(result, None if few else [*range(half), *range(count - half, count)])
    if not rows:
        return []
    gains = list(cases[0])
    shown = dict(list(shown_metrics(rows).items())[:-1])  # the last one is for comparisons
    head = [*gains, *shown.values()]
    body = [
        [*(f"{row[g]:g}" for g in gains), *(_told(n, row, "{:.2e}".format) for n in shown)]
        for row in rows
    ]
    lines = columns([head, *body])
    if not few:
        lines.insert(1 + half, f"… {count - 2 * half} more in cases.csv")
    return lines


def case_cells(named: Sequence[tuple[str, dict[str, float]]]) -> list[list[str]]:
    """Header and rows, for HTML, of what distinguishes cases, and their metrics.

    Each has the name of its run, empty if there is only one, and gains and metrics by the names
    of ``cases.csv``.
    """
    if not named:
        return []
    gains = list(dict.fromkeys(key for _, row in named for key in row if not is_metric(key)))
    several = any(name for name, _ in named)
    # Gains that are the same everywhere tell nothing; those of other estimators are not theirs.
    shown = [g for g in gains if len({row.get(g) for _, row in named}) > 1] or gains
    # Without the truth nothing is known of errors, nor from when on they are small.
    known = {
        key: words for key, words in shown_metrics([row for _, row in named]).items()
        if any(math.isfinite(row.get(known_by(key), math.nan)) for _, row in named)
    }
    head = [*(["estimator"] if several else []), *map(symbol, shown), *known.values()]
    rows = [
        [
            *([name] if several else []),
            *(number_text(row[gain]) if gain in row else "" for gain in shown),
            *(_told(key, row, number_text) for key in known),
        ]
        for name, row in named
    ]
    return [head, *rows]


def noise_table(noise: NoiseStatistics) -> list[str]:
    """Errors over the seeds, one row per case and parameter; of many cases the first ones."""
    cases = range(min(len(noise.bias), _SHOWN_CASES // max(1, len(noise.names)) or 1))
    numbers = (noise.bias, noise.deviation, noise.rms)
    body = [
        [str(case), name,
         *(f"{values[case, i]:.2e}".replace("nan", "unknown") for values in numbers)]
        for case in cases
        for i, name in enumerate(noise.names)
    ]
    head = ["case", f"over {noise.seeds} seeds", "bias", "deviation", "rms error"]
    more = len(noise.bias) - len(cases)
    return columns([head, *body]) + ([f"… {more} more cases in noise.csv"] if more else [])


def estimate_table(result: RunResult) -> list[str]:
    """Each estimate with its deviation and unit, since when it stands, and can be known at all."""
    from gpebo_cli.results.summary import estimates_at_end

    estimation = result.estimation
    if estimation is None:
        return []
    case = result.fit.best if result.fit is not None else 0
    over_time = np.concatenate([estimation.states[case], estimation.parameters[case]], axis=1)
    names = [*result.system.states, *estimation.names]
    standing = (result.metrics and result.metrics.seconds_to_settled) or {}
    near = "±2σ" if standing else "1 %"
    rows = [["", "estimate", "± std", "unit", f"within {near} of the end since", "estimable"]]
    for name, told in estimates_at_end(result, estimation, case).items():
        value, std, from_when = told["value"], told["std"], result.estimable.get(name)
        lasts = name in result.estimable  # the filter's w_<state> move as states do
        begins = "no" if from_when is None else f"from {instant(from_when)} s"
        estimable = begins if lasts else ""
        if not math.isfinite(value):
            why = "left out" if name in result.left_out else "not determined"
            rows.append([name, why, "", told["unit"] or "", "", estimable])
            continue
        away = np.abs(over_time[:, names.index(name)] - value) > 0.01 * abs(value)
        first = int(len(away) - np.argmax(away[::-1])) if away.any() else 0
        known = standing.get(name)
        when = estimation.t[first] if known is None else estimation.t[0] + known[case]
        lasts = lasts and name in estimation.names and math.isfinite(when)
        since = f"{instant(when)} s" if lasts else ""
        deviation = "" if std is None or not math.isfinite(std) else f"{std:.2g}"
        shown = f"{value:.6g}"
        if estimation.still[case] and name in estimation.names:
            shown, since = f"not moved from {over_time[0, names.index(name)]:.6g}", ""
        rows.append([name, shown, deviation, told["unit"] or "", since, estimable])
    return columns(rows)


def columns(
    rows: Sequence[Sequence[str]], aligned: Callable[[str, int], str] = str.rjust
) -> list[str]:
    """Rows of text, perhaps of other people's files, as lines with aligned columns."""
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(aligned, row, widths)) for row in rows]


def _told(metric: str, row: Mapping[str, float], text: Callable[[float], str]) -> str:
    """A metric of a case for a person, with the ``text`` of numbers that are no time."""
    value = row.get(metric, math.nan)
    if math.isnan(row.get(known_by(metric), math.nan)):
        return "unknown"
    if not metric.startswith("seconds"):
        return text(value)
    return f"{'after ' * (metric == SETTLED)}{value:.3f} s" if math.isfinite(value) else "never"


def run_lines(result: RunResult, folder: str = "") -> list[str]:
    """The lines that tell of a run: table, what moved, ``folder`` if given, and the verdict."""
    lines = case_table(result)
    if result.recording is not None or None in result.estimable.values():
        lines += estimate_table(result)
    if result.noise is not None:
        lines += noise_table(result.noise)
    changes = result.simulation.moved if result.simulation else ()
    moved = ", ".join(f"{m.state} {m.given:g} → {m.used:g}" for m in changes)
    if moved:
        lines.append(f"consistent initial state: {moved}")
    return [*lines, *([folder] if folder else []), result.verdict]
