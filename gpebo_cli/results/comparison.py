"""Finished runs side by side: a table, error curves overlaid, metrics over gains, heat maps."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.results import style
from gpebo_cli.results.finished import Case, ErrorCurves, read_errors, span
from gpebo_cli.results.names import METRICS, WORDS, ranking, shown_metrics
from gpebo_cli.results.style import Axis, Curve, Panel, compose, line
from gpebo_cli.results.symbols import number_text, symbol, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = str | float

_MOST_CURVES = len(style.LINES)  # more do not stay apart
_MIN_POINTS = 3  # fewer are not a curve
_MOST_MAPS = 8


def row(case: Case) -> dict[str, Value]:
    """One row of the table: run, case, what was chosen, gains, metrics (NaN: never)."""
    return {"run": case.run, "case": float(case.number), **case.chosen, **case.metrics}


def names(cases: Sequence[Case]) -> list[str]:
    """Columns of the table: of all cases, in order of first appearance, metrics last."""
    known = dict.fromkeys(name for case in cases for name in row(case))
    last = dict.fromkeys((*METRICS, *(name for case in cases for name in case.metrics)))
    return [*(name for name in known if name not in last), *last]


def varying(cases: Sequence[Case]) -> list[str]:
    """Those of the choices (settings and gains) that are not the same for all who have them.

    A gain that only some estimators have follows from the estimator and says nothing new; one that
    only some cases of an estimator have, as beside a mapping by parameter, does.
    """
    values: dict[str, set[Value]] = {}
    gains: dict[Value | None, set[str]] = {}
    for case in cases:
        for name, value in case.chosen.items():
            values.setdefault(name, set()).add(value)
            if isinstance(value, float):
                gains.setdefault(case.chosen.get("estimator"), set()).add(name)
    for case in cases:
        for name in gains.get(case.chosen.get("estimator"), set()).difference(case.chosen):
            values[name].add("")
    return [name for name, found in values.items() if len(found) > 1]


def ordered(cases: Sequence[Case], by: str, *, reverse: bool = False) -> list[Case]:
    """Cases sorted by a column; those without a value are last either way."""
    values = [row(case).get(by, math.nan) for case in cases]

    def key(k: int) -> tuple[bool, float, str]:
        number = _as_number(values[k])
        return math.isnan(number), 0.0 if math.isnan(number) else number, str(values[k])

    missing = [k for k, v in enumerate(values) if isinstance(v, float) and math.isnan(v)]
    present = [k for k in range(len(cases)) if k not in missing]
    return [cases[k] for k in (*sorted(present, key=key, reverse=reverse), *missing)]


def figures(cases: Sequence[Case], metric: str = "") -> Iterator[tuple[str, Figure]]:
    """Draw, one at a time: error curves, metrics over each number that varies, heat maps.

    Of many cases, the error curves of a few evenly spaced ones are drawn. Heat maps show
    ``metric``, by default that by which cases are ranked.
    """
    metric = metric or ranking(case.metrics for case in cases)
    for suffix, members in _comparable(cases).items():
        if panels := error_panels(members):
            yield f"errors{suffix}", compose(panels)
        # Sorted by name: the files are called the same however the cases are sorted.
        numbers = sorted(name for name in varying(members) if _is_axis(members, name))
        for name in numbers:
            if panels := metric_panels(members, name):
                yield f"over_{name}{suffix}", compose(panels)
        for across, up in combinations(numbers, 2):
            for k, (label, some) in enumerate(_groups(members, (across, up)).items()):
                grid = heat_grid(some, across, up, metric)
                if k < _MOST_MAPS and grid is not None:
                    name = f"{metric}_over_{across}_and_{up}{suffix}" + (f"_{k + 1}" if k else "")
                    yield name, _heat_map(*grid, (across, up, metric), label)


def _comparable(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """Cases of one plant over one span of time, by what the names of their figures end with."""
    spans = {case.folder: span(case.folder) for case in cases}
    groups: dict[tuple[Value, tuple[float, float]], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.chosen["plant"], spans[case.folder]), []).append(case)
    if len(groups) == 1:
        return {"": list(cases)}
    plants = [str(plant).replace("/", "_") for plant, _ in groups]  # published/akzo is no folder
    suffixes = (
        f"_{plant}" + (f"_{plants[:k].count(plant) + 1}" if plants.count(plant) > 1 else "")
        for k, plant in enumerate(plants)
    )
    return dict(zip(suffixes, groups.values(), strict=True))


def error_panels(cases: Sequence[Case]) -> list[Panel]:
    """Norms of the errors of parameters and states over time, a curve per case."""
    count = len(cases)
    places = np.linspace(0, count - 1, min(count, _MOST_CURVES)).round().astype(int)
    chosen = [cases[int(place)] for place in places]
    note = f"{len(chosen)} of {count} cases:" if len(chosen) < count else ""
    panels = norm_panels(read_errors(chosen), _labels(cases, chosen))
    return [replace(panel, note=note if panel.legend else "") for panel in panels]


def norm_panels(
    curves: Sequence[ErrorCurves], labels: Sequence[str], *, log: bool = True
) -> list[Panel]:
    """Norms of the errors of parameters and of states over time; without curves, no panel."""
    panels: list[Panel] = []
    for part in ("parameter", "state"):
        norms = [getattr(each, f"{part}s") for each in curves]
        drawn = tuple(
            Curve(each.t, norm, text, line(k))
            for k, (each, norm, text) in enumerate(zip(curves, norms, labels, strict=True))
            if len(norm)
        )
        if drawn:
            size = max(getattr(each, f"{part}_size") for each in curves)
            panels.append(Panel(f"‖{part} error‖", drawn, log=log, size=size, legend=not panels))
    return panels


def metric_panels(cases: Sequence[Case], name: str) -> list[Panel]:
    """Every metric over the number ``name``, doubly logarithmic: a curve for each other choice.

    There are none if every curve has fewer than three points, or if there are more curves than
    stay apart.
    """
    groups = {
        label: members
        for label, members in _groups(cases, (name,)).items()
        if len({_choice(case, name) for case in members}) >= _MIN_POINTS
    }
    if not 0 < len(groups) <= _MOST_CURVES:
        return []
    axis = Axis(name, symbol(name), log=True)
    panels: list[Panel] = []
    for metric in shown_metrics(case.metrics for case in cases):
        curves = []
        for k, (label, members) in enumerate(groups.items()):
            x = np.array([_choice(case, name) for case in members])
            y = np.array([case.metrics.get(metric, np.nan) for case in members])
            order = np.argsort(x, kind="stable")
            curves.append(Curve(x[order], y[order], label, replace(line(k), dots=True)))
        if any(np.isfinite(c.y).any() and np.nanmax(c.y) > 0 for c in curves):
            legend = not panels and len(curves) > 1
            panels.append(
                Panel(_label(metric), tuple(curves), log=True, axis=axis, legend=legend)
            )
    return panels


def heat_grid(
    cases: Sequence[Case], across: str, up: str, metric: str
) -> tuple[Array, Array, Array] | None:
    """Values of ``across`` (K,), of ``up`` (J,) and the metric (J, K), NaN where there is none.

    None unless both have at least two values and most of the grid is there: a list of pairs is
    no map.
    """
    x = np.unique([_choice(case, across) for case in cases])
    y = np.unique([_choice(case, up) for case in cases])
    if min(len(x), len(y)) < 2 or 2 * len(cases) < len(x) * len(y):
        return None
    values = np.full((len(y), len(x)), np.nan)
    for case in cases:
        j, k = (np.searchsorted(v, _choice(case, n)) for v, n in ((y, up), (x, across)))
        values[j, k] = case.metrics.get(metric, np.nan)
    return (x, y, values) if np.isfinite(values).any() else None


def _heat_map(
    x: Array, y: Array, values: Array, columns: tuple[str, str, str], label: str
) -> Figure:
    """One cell per case, all of the same size: gains are spaced by factors, as a rule."""
    from matplotlib.colors import LogNorm, Normalize

    across, up, metric = columns
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    log = low > 0 and high > 10 * low
    norm = LogNorm(low, high) if log else Normalize(low, high)
    with style.our_rc():
        figure = style.new_figure(style.WIDTH, 2.6)
        figure.set_layout_engine("constrained")
        axes = figure.subplots()
        axes.set_facecolor("#DDDDDD")  # no value: never reached, or no such case
        image = axes.imshow(
            np.ma.masked_invalid(values), origin="lower", aspect="auto", norm=norm, cmap="cividis",
            interpolation="nearest",
        )
        for axis, numbers, name in ((axes.xaxis, x, across), (axes.yaxis, y, up)):
            places = np.linspace(0, len(numbers) - 1, min(len(numbers), 5)).astype(int)
            axis.set_ticks(places, [number_text(float(numbers[p])) for p in places])
            axis.set_label_text(symbol(name))
        bar = figure.colorbar(image, ax=axes, pad=0.02)
        ends = np.geomspace(low, high, 4) if log else np.linspace(low, high, 4)
        bar.set_ticks([])
        bar.ax.yaxis.set_ticks(ends, [f"{value:.2g}" for value in ends])
        bar.ax.yaxis.minorticks_off()
        title = _label(metric) + (f"; {label}" if label else "")
        axes.set_title("\n".join(textwrap.wrap(title, 48)), fontsize=style.TEXT, loc="left")
    return figure


def _label(metric: str) -> str:
    return with_unit(WORDS[metric], "s" if metric.startswith("seconds") else "")


def _choice(case: Case, name: str) -> float:
    return _as_number(case.chosen.get(name, np.nan))


def _as_number(value: Value) -> float:
    try:
        return float(value)
    except ValueError:
        return math.nan


def _is_axis(cases: Sequence[Case], name: str) -> bool:
    """Whether a choice is a positive number wherever there is one: a gain, a tolerance, a time."""
    values = [case.chosen[name] for case in cases if name in case.chosen]
    return all(0 < _as_number(value) < math.inf for value in values)


def _groups(cases: Sequence[Case], without: tuple[str, ...]) -> dict[str, list[Case]]:
    """Cases that have ``without``, by all their other choices that vary, in words.

    Where that leaves a choice twice, runs differ in what they do not tell: each folder is a group.
    """
    relevant = [case for case in cases if all(name in case.chosen for name in without)]
    others = [name for name in varying(relevant) if name not in without]
    twice = len({str(sorted(case.chosen.items())) for case in relevant}) < len(relevant)
    groups: dict[str, list[Case]] = {}
    for case in relevant:
        folder = [case.run.partition("/")[0]] if twice else []
        label = ", ".join(filter(None, [*folder, words(case.chosen, others)]))
        groups.setdefault(label, []).append(case)
    return groups


def _labels(cases: Sequence[Case], chosen: Sequence[Case]) -> list[str]:
    """The shortest name of each of those chosen that tells it from all others."""
    others, runs = varying(cases), {case.run for case in cases}
    if len({words(case.chosen, others) for case in cases}) == len(cases):
        return [words(case.chosen, others) for case in chosen]
    if len(runs) == len(cases):
        others = []
    parts = [[case.run if len(runs) > 1 else "", words(case.chosen, others)] for case in chosen]
    return [", ".join(filter(None, each)) for each in parts]


def words(chosen: Mapping[str, Value], names: Iterable[str]) -> str:
    """``drem, γ = 10⁸``, of what has these names: they are left out where the value says it all."""
    parts = []
    for name, value in ((name, chosen[name]) for name in names if name in chosen):
        number = _as_number(value)
        if math.isfinite(number):
            parts.append(f"{symbol(name)} = {number_text(number)}")
        else:
            parts.append(str(value) if name in ("plant", "estimator") else f"{name} = {value}")
    return ", ".join(parts)
