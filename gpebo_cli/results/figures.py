"""The figures of one run; those of the paper (arXiv:2407.14373, Figs. 2 to 8) among them.

Each function takes the result of a run and returns the panels of a figure, which are its data;
none if the run has nothing for it (no observer, no mixing). ``FIGURES`` finds them by name.
:func:`draw` makes pictures of the same panels that ``series`` makes tables of. Importing this
module is cheap: matplotlib is loaded by the first picture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from typing import TYPE_CHECKING, Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.accuracy import judged_of
from gpebo_cli.experiment.result import EstimationResult, RunResult
from gpebo_cli.model.descriptor import Array
from gpebo_cli.results import style
from gpebo_cli.results.comparison import norm_panels, words
from gpebo_cli.results.finished import INITIAL, ErrorCurves, largest, rows_at
from gpebo_cli.results.names import FIGURE_NAMES, SETTLED
from gpebo_cli.results.style import Axis, Curve, Panel, check_look, compose, line
from gpebo_cli.results.symbols import error_of, number_text, symbol, typeset, unit_of
from gpebo_cli.schema import known_name, shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FigureFunction = Callable[[RunResult], list[Panel]]

MAX_CASES = 4  # curves of more cases than that do not stay apart
MAX_DOTS = 200  # more points than that are a line
MIN_GAINS = 3  # fewer points are not a curve over the gain


def states(result: RunResult) -> list[Panel]:
    """Fig. 3: the true states over time, one panel per unit."""
    known = _known(result)
    names = [result.system.states[i] for i in known]
    return _by_unit(result, "states", names, result.signals.states[:, known])


def signals(result: RunResult) -> list[Panel]:
    """Inputs and outputs over time: all an observer gets to see, beside the truth if it differs."""
    s, system = result.signals, result.system
    return [
        *_by_unit(result, "inputs", system.inputs, s.inputs, s.measured_inputs),
        *_by_unit(result, "outputs", system.outputs, s.outputs, s.measured_outputs),
    ]


def regressor(result: RunResult) -> list[Panel]:
    """Fig. 2: the regressor ψ over time, one panel per row that is not zero throughout."""
    regression = result.regression
    if regression is None or not regression.parameters:
        return []
    psi, labels = regression.psi, result.system.labels
    every = range(psi.shape[1])
    rows, panels = [row for row in every if np.any(psi[:, row])] or every[:1], []
    for row in rows:
        curves = tuple(
            Curve(regression.t, psi[:, row, column], f"ψ {name}", line(column),
                  f"for {typeset(name, labels)}")
            for column, name in enumerate(regression.parameters)
        )
        name = f"ψ, row {row + 1}" if len(rows) > 1 else "regressor ψ"
        panels.append(Panel(name, curves, text=name.replace("ψ", r"$\psi$")))
    return _with_legend(panels)


def _of_estimates(
    figure: Callable[[RunResult, EstimationResult], list[Panel]]
) -> FigureFunction:
    """A figure of estimates, with the legend of all its panels above the first one."""

    @wraps(figure)
    def of_run(result: RunResult) -> list[Panel]:
        estimation = result.estimation
        if estimation is None:
            return []
        count = len(estimation.cases)
        note = f"{MAX_CASES} of {count} cases:" if count > MAX_CASES else ""
        return _with_legend(figure(result, estimation), note)

    return of_run


@_of_estimates
def parameters(result: RunResult, estimation: EstimationResult) -> list[Panel]:
    """Estimates of the parameters over time, with the truth where it is known.

    Where θ varies the components of e₀ are left out: they are what makes up for it, of any size.
    """
    varies = result.system.theta_varies
    truth = estimation.true_parameters
    panels = []
    for i, name in enumerate(estimation.names):
        if varies and name not in result.system.unknowns:
            continue
        curve = _truth(result, name, estimation.t, truth[:, i])
        if varies and _known_by_data(result, name):
            curve = replace(curve, style=style.VARYING)
        values = estimation.parameters[:, :, i]
        panels.append(_estimate(result, estimation, name, values, curve, behind=not varies))
    return panels


def fit(result: RunResult) -> list[Panel]:
    """Measured outputs with those of the final estimates, the difference below; of a recording."""
    found = result.fit
    if found is None or found.outputs is None:
        return []
    s, labels = result.signals, result.system.labels
    panels = []
    for i, name in enumerate(result.system.outputs):
        unit, text = unit_of(name, result.system.units), typeset(name, labels)
        measured, fitted = s.outputs[:, i], found.outputs[:, i]
        curves = (
            Curve(s.t, measured, f"{name} measured", style.MEASURED, f"{text} measured"),
            Curve(s.t, fitted, f"{name} fitted", line(0), f"{text} fitted"),
        )
        left = (Curve(s.t, measured - fitted, "", style.RESIDUAL),)
        panels += [
            _panel(result, name, curves, legend=True),
            Panel(f"residual of {name}", left, unit, f"residual of {text}"),
        ]
    return panels


def whiteness(result: RunResult) -> list[Panel]:
    """Autocorrelation of the residual, of a recording, with the band of white noise."""
    found = result.fit
    if found is None or found.correlation is None:
        return []
    lags: Array = found.lag * np.arange(1.0, len(found.correlation) + 1)
    band = np.full(len(lags), found.band)
    curves = (
        Curve(lags, found.correlation, "correlation", replace(line(0), dots=True)),
        Curve(lags, band, "95 % of white noise", style.SPREAD, down_to=-band),
    )
    axis = Axis("lag", "lag", "s")
    return [Panel("autocorrelation of the residual", curves, axis=axis, legend=True)]


@_of_estimates
def parameter_error(result: RunResult, estimation: EstimationResult) -> list[Panel]:
    """Fig. 6: error of every parameter (for the circuit, the initial conditions).

    Where θ varies, only those of the unknowns are drawn, as in ``parameters``.
    """
    truth = estimation.true_parameters
    size = np.nan_to_num(np.max(np.abs(truth), axis=0))
    largest = float(np.max(size, initial=0.0))
    size = np.where(size > 1e-12 * largest, size, largest)  # of one that is zero but for rounding
    errors = estimation.parameters - truth
    return [
        _error(result, estimation, name, errors[:, :, i], float(size[i]))
        for i, name in enumerate(estimation.names)
        if not np.isnan(truth[:, i]).any()
        and (not result.system.theta_varies or name in result.system.unknowns)
    ]


def gram(result: RunResult) -> list[Panel]:
    """Eigenvalues of the Gram matrix G(t), the level asked of them and when it is reached."""
    excitation = result.excitation
    if excitation is None or excitation.gram_eigenvalues.shape[1] == 0:
        return []
    t, eigenvalues = excitation.t, excitation.gram_eigenvalues
    curves = [
        Curve(t, values, symbol(f"lambda_{i + 1}"), line(i), rf"$\lambda_{{{i + 1}}}$")
        for i, values in enumerate(eigenvalues.T)
    ]
    if (rho := excitation.rho) is not None:
        level = number_text(rho)
        curves.append(
            Curve(t[[0, -1]], np.full(2, rho), f"ρ = {level}", style.LIMIT, rf"$\rho$ = {level}")
        )
    reached = None
    if excitation.t_c is not None:
        reached = (excitation.t_c, f"t_c = {number_text(excitation.t_c)} s")
    size = float(np.nanmax(eigenvalues, initial=0.0))
    panel = Panel("eigenvalues of G", tuple(curves), text="eigenvalues of $G$", log=True,
                  size=size, vertical=reached)
    return _with_legend([panel])


@_of_estimates
def delta(result: RunResult, estimation: EstimationResult) -> list[Panel]:
    """Δ, the determinant that mixing leaves as a scalar regressor, logarithmic."""
    if estimation.delta is None:
        return []
    values = np.abs(estimation.delta)
    size = float(np.max(values[np.isfinite(values)], initial=0.0))
    alone = (Curve(estimation.t, values[0], "", line(0)),)
    curves = _per_case(result, estimation, values) if len(values) > 1 else alone
    return [Panel("|Δ|", curves, text=r"$|\Delta|$", log=True, size=size)]


def gains(result: RunResult) -> list[Panel]:
    """Final errors and times over the one gain that varies, if at least three do.

    Times are those to 1 %, and under noise those from which on all is within ±2σ of the end, if
    there are such times.
    """
    estimation, metrics = result.estimation, result.metrics
    gain = _varying_gain(estimation) if estimation is not None else None
    if estimation is None or metrics is None or gain is None:
        return []
    if np.isnan(metrics.final_error_parameters).all() and not _known(result):
        return []
    values = estimation.gains[gain]
    order = np.argsort(values, kind="stable")
    axis = Axis(gain, f"gain {symbol(gain)}", log=True)

    def curve(metric: str, label: str, k: int) -> Curve:
        y = metrics.columns[metric][order]
        return Curve(values[order], y, label, replace(line(k), dots=len(order) <= MAX_DOTS))

    def over_gain(kind: str) -> tuple[Curve, ...]:
        of = ("parameters", "states")
        return tuple(curve(f"{kind}_{each}", each, k) for k, each in enumerate(of))

    times = Panel("time to 1 %", over_gain("seconds_to_1pct"), "s", axis=axis)
    if metrics.seconds_to_settled is not None:
        times = Panel("time to ±2σ", (curve(SETTLED, "all", 2),), "s", axis=axis)
    ever = any(np.isfinite(each.y).any() for each in times.curves)
    truth, seen = estimation.true_parameters, _seen(estimation, _known(result))
    judged = judged_of(result.system, len(estimation.names))
    of_eta = truth[:, judged & ~np.isnan(truth).any(axis=0)]
    size = max(largest(of_eta), largest(result.signals.states[:, seen]))
    # Seconds on a linear axis: they seldom span a decade, and a decade is all one could label.
    return _with_legend([
        Panel("final error", over_gain("final_error"), log=True, size=size, axis=axis),
        *([times] if ever else []),
    ])


@_of_estimates
def error_norms(result: RunResult, estimation: EstimationResult) -> list[Panel]:
    """Norms of the errors of all parameters and of all states for a few of at least three cases."""
    if len(estimation.cases) < MIN_GAINS:
        return []
    return _norm_panels([(label, result, case) for label, case in _shown(result, estimation)])


def overlay(results: Mapping[str, RunResult]) -> list[Panel]:
    """Norms of the errors of runs that have one case each, by the name each run goes by."""
    return _norm_panels([(label, result, 0) for label, result in results.items()])


def check_names(names: Iterable[str]) -> None:
    """Refuse names that are not figures; worth doing before a long run (ConfigError)."""
    for name in names:
        known_name(name, FIGURES, f"figures: there is no figure {shown(name)}")


def describe(
    result: RunResult, names: Iterable[str] | None = None, *, strict: bool = False
) -> dict[str, list[Panel]]:
    """Panels of the figures called ``names``; those the run has nothing for are left out.

    With ``None``, all but what says little: ``signals``, which the paper does not have, is there if
    there was no observer or it saw something else than the truth; ``parameters`` if θ varies or
    the signals are a recording. A name that is unknown is a ConfigError, and, if ``strict``, one
    that the run has nothing for.
    """
    if names is None:
        noisy = result.signals.measured_outputs is not None
        said = {"signals": result.estimation is None or noisy,
                "parameters": result.system.theta_varies or result.recording is not None}
        names = [name for name in FIGURES if said.get(name, True)]
    wanted = list(dict.fromkeys(names))
    check_names(wanted)
    found = {name: FIGURES[name](result) for name in wanted}
    empty = [name for name, panels in found.items() if not panels]
    if strict and empty:
        has = [name for name, function in FIGURES.items() if function(result)]
        raise ConfigError(
            f"figures: this run has nothing for {', '.join(empty)}; it has {', '.join(has)}"
        )
    return {name: panels for name, panels in found.items() if panels}


def draw(result: RunResult, names: Iterable[str] | None = None) -> Iterator[tuple[str, Figure]]:
    """Draw figures, one at a time, as ``settings.output`` wants them to look."""
    described = describe(result, names, strict=names is not None)
    look = result.settings.output
    if described:
        check_look(look.style, result.system.labels)
    return ((name, compose(panels, look)) for name, panels in described.items())


def _with_legend(panels: list[Panel], note: str = "") -> list[Panel]:
    """The same with a legend above the first one, which is that of all."""
    return [replace(panel, legend=True, note=note) for panel in panels[:1]] + panels[1:]


def _of_states(
    figure: Callable[[RunResult, EstimationResult, Sequence[int]], list[Panel]], part: str
) -> FigureFunction:
    """A figure of the states x_a, whose initial value is a parameter ``e0_<state>``, or the rest.

    Where the kernel of E(t) rotates the parameters are ``e0_1…``, of no single state: none is x_a,
    and there is one figure of all states, whose ``part`` is empty.
    """

    def of_part(result: RunResult, estimation: EstimationResult) -> list[Panel]:
        """The states x_a, the states x_b, or all where the parameters do not tell them apart."""
        names = result.system.states
        a = [i for i, name in enumerate(names) if INITIAL + name in estimation.names]
        b = [i for i in range(len(names)) if i not in a]
        members = {"": [] if a else b, "a": a, "b": b if a else []}
        return figure(result, estimation, members[part])

    return _of_estimates(of_part)


def _panel(result: RunResult, name: str, curves: tuple[Curve, ...], **more: Any) -> Panel:
    """The panel of one quantity, called as the plant's author calls it."""
    system = result.system
    return Panel(
        name, curves, unit_of(name, system.units), typeset(name, system.labels), **more
    )


def _by_unit(
    result: RunResult, kind: str, names: Sequence[str], values: Array,
    measured: Array | None = None,
) -> list[Panel]:
    """One panel per unit, in the order in which the units appear; what was measured behind."""
    t, texts = result.signals.t, [typeset(name, result.system.labels) for name in names]
    by_unit: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        by_unit.setdefault(result.system.units.get(name, ""), []).append(i)
    panels = []
    for unit, members in by_unit.items():
        behind = [] if measured is None else [
            Curve(t, measured[:, i], f"{names[i]} measured", style.MEASURED, f"{texts[i]} measured")
            for i in members if np.any(measured[:, i] != values[:, i])
        ]
        own = [Curve(t, values[:, i], names[i], line(k), texts[i]) for k, i in enumerate(members)]
        curves, first = (*behind, *own), members[0]
        name, text = (names[first], texts[first]) if len(members) == 1 else (kind, kind)
        panels.append(Panel(name, curves, unit, text, legend=len(curves) > 1))
    return panels


def truth_at(result: RunResult, t: Array) -> Array:
    """True states (M, n) at the times t (M,) of the estimates, which are some of the output's."""
    signals = result.signals
    return np.asarray(signals.states[rows_at(signals.t, t)])


def _known(result: RunResult) -> list[int]:
    """Those of the states whose truth is known: all but those a recording does not have."""
    unknown = np.isnan(result.signals.states).all(axis=0)
    return [int(i) for i in np.flatnonzero(~unknown)]


def _seen(estimation: EstimationResult, members: Iterable[int]) -> list[int]:
    """Those of the states ``members`` that the observer sees: not all of their estimates NaN."""
    return [i for i in members if not np.isnan(estimation.states[:, :, i]).all()]


def _varying_gain(estimation: EstimationResult) -> str | None:
    """The gain that alone tells the cases apart, if there are enough of them to draw a curve."""
    distinct = {name: np.unique(values) for name, values in estimation.gains.items()}
    varying = [(name, found) for name, found in distinct.items() if len(found) > 1]
    if len(varying) != 1:
        return None
    ((name, found),) = varying
    return name if len(found) >= MIN_GAINS and np.isfinite(found).all() and found[0] > 0 else None


def _norm_panels(named: Sequence[tuple[str, RunResult, int]]) -> list[Panel]:
    """Norms of the errors of parameters and of states: a curve per label, run and case."""
    labels, curves = [], []
    for label, result, case in named:
        estimation = result.estimation
        if estimation is None:
            continue
        truth, x = estimation.true_parameters, truth_at(result, estimation.t)
        known, seen = ~np.isnan(truth).any(axis=0), _seen(estimation, _known(result))
        known &= judged_of(result.system, len(estimation.names))
        labels.append(label)
        curves.append(ErrorCurves.of(
            estimation.t, (estimation.parameters[case] - truth)[:, known],
            (estimation.states[case] - x)[:, seen], truth[:, known], result.signals.states[:, seen],
        ))
    log = all(result.settings.output.error == "log" for _, result, _ in named)
    return norm_panels(curves, labels, log=log)


def _shown(result: RunResult, estimation: EstimationResult) -> list[tuple[str, int]]:
    """Names and numbers of the cases that are shown.

    They are named by the gains that vary among them; a single one by its estimator.
    """
    count = len(estimation.cases)
    chosen = [int(case) for case in np.linspace(0, count - 1, min(count, MAX_CASES)).round()]
    cases = [estimation.cases[case] for case in chosen]
    gains = list(dict.fromkeys(gain for case in cases for gain in case))
    varying = [gain for gain in gains if len({case.get(gain) for case in cases}) > 1]
    if not varying:
        name = str(result.settings.estimator.get("name", "estimate"))
        return [(name if count == 1 else f"{name}, case {case}", case) for case in chosen]
    return [(words(case, varying), k) for case, k in zip(cases, chosen, strict=True)]


def _per_case(
    result: RunResult, estimation: EstimationResult, values: Array
) -> tuple[Curve, ...]:
    """A curve for each case that is shown, of values (G, M) at the times of the estimates."""
    return tuple(
        Curve(estimation.t, values[case], label, line(k))
        for k, (label, case) in enumerate(_shown(result, estimation))
    )


def _deviation(result: RunResult, estimation: EstimationResult, name: str) -> Array | None:
    """The standard deviation (M,) of an estimate, where there is one case."""
    if len(estimation.cases) != 1:
        return None
    for names, found in (
        (estimation.names, estimation.parameters_std), (result.system.states, estimation.states_std)
    ):
        if name in names and found is not None:
            return found[0, :, names.index(name)]
    return None


def _estimate(
    result: RunResult, estimation: EstimationResult, name: str, values: Array, truth: Curve, *,
    behind: bool = True,
) -> Panel:
    """Estimates (G, M) of ``name`` with their ± 2σ, and the truth if it is known."""
    curves = _per_case(result, estimation, values)
    deviation, drawn = _deviation(result, estimation, name), np.stack([c.y for c in curves])
    bands = [] if deviation is None else [values[0] + side * deviation for side in (-2, 2)]
    if bands:
        low, high = bands
        band = Curve(estimation.t, high, "± 2σ", style.SPREAD, r"$\pm\,2\sigma$", down_to=low)
        curves = (*curves, band)
    if np.isfinite(truth.y).any():
        curves = (truth, *curves) if behind else (*curves, truth)
        limits = _estimate_limits(truth.y, drawn)
    else:  # what an estimate is in the second half stands for the truth
        late = drawn[0, drawn.shape[1] // 2 :]
        limits = _estimate_limits(late, np.vstack([drawn, *bands]), abs(float(late[-1])))
    return _panel(result, name, curves, limits=limits)


def _state_estimates(
    result: RunResult, estimation: EstimationResult, members: Sequence[int]
) -> list[Panel]:
    signals, known, seen, panels = result.signals, _known(result), _seen(estimation, members), []
    for i in members:
        name = result.system.states[i]
        truth = _truth(result, name, signals.t, signals.states[:, i])
        if i in seen:
            panels.append(_estimate(result, estimation, name, estimation.states[:, :, i], truth))
        elif not (_known_by_data(result, name) or name in result.left_out or i not in known):
            panels.append(_panel(result, name, (truth,), legend=True))
    return panels


def _known_by_data(result: RunResult, name: str) -> bool:
    """Whether the data determine a parameter or state, where that has been found out."""
    return result.estimable.get(name, 0.0) is not None


def _truth(result: RunResult, name: str, t: Array, values: Array) -> Curve:
    """The truth (M,) at the times t (M,), dashed where the data do not determine it."""
    if _known_by_data(result, name):
        return Curve(t, values, "true", style.TRUTH)
    return Curve(t, values, "true, not determined by the data", style.UNKNOWN)


def _estimate_limits(
    truth: Array, guesses: Array, size: float = 0.0
) -> tuple[float, float] | None:
    """Show the truth and all estimates, but do not let a wild one flatten the truth to a line.

    ``size`` takes the place of the range of a truth that hardly moves.
    """
    known = truth[np.isfinite(truth)]
    if not known.size:
        return None
    low, high = float(known.min()), float(known.max())
    room = 2.0 * (np.fmax(high - low, size) or abs(high) or 1.0)
    finite = guesses[np.isfinite(guesses)]
    lowest = float(np.min(finite, initial=low))
    highest = float(np.max(finite, initial=high))
    return max(lowest, low - room), min(highest, high + room)


def _state_errors(
    result: RunResult, estimation: EstimationResult, members: Sequence[int]
) -> list[Panel]:
    known, truth = _known(result), truth_at(result, estimation.t)
    return [
        _error(result, estimation, result.system.states[i],
               estimation.states[:, :, i] - truth[:, i],
               float(np.max(np.abs(truth[:, i]), initial=0.0)))
        for i in _seen(estimation, members)
        if i in known
    ]


def _error(
    result: RunResult, estimation: EstimationResult, name: str, error: Array, size: float
) -> Panel:
    """The error (G, M) of an estimate with its 2σ; ``size`` is that of the truth.

    It is the absolute value on a logarithmic axis, or has its sign on a linear one.
    """
    signed = result.settings.output.error == "linear"
    curves = _per_case(result, estimation, error if signed else np.abs(error))
    deviation = _deviation(result, estimation, name)
    if deviation is not None:
        up, down = 2 * deviation, -2 * deviation if signed else None
        label, text = ("± 2σ", r"$\pm\,2\sigma$") if signed else ("2σ", r"$2\sigma$")
        curves = (*curves, Curve(estimation.t, up, label, style.SPREAD, text, down_to=down))
    system = result.system
    return Panel(f"error of {name}", curves, unit_of(name, system.units),
                 error_of(name, system.labels, signed=signed), log=not signed, size=size)


# In the paper x_a and x_b are Figs. 4 and 5, their errors Figs. 7 and 8.
_PARTS = ("", "a", "b")
estimates, estimates_a, estimates_b = (_of_states(_state_estimates, part) for part in _PARTS)
state_error, state_error_a, state_error_b = (_of_states(_state_errors, part) for part in _PARTS)
FIGURES: dict[str, FigureFunction] = {name: globals()[name] for name in FIGURE_NAMES}
