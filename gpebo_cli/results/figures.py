"""The figures of one run; those of the paper (arXiv:2407.14373, Figs. 2 to 8) among them.

Each function takes the result of a run and returns the panels of a figure, which are its data;
none if the run has nothing for it (no observer, no mixing). ``FIGURES`` finds them by name.
:func:`draw` makes pictures of the same panels that ``series`` makes tables of. Importing this
module is cheap: matplotlib is loaded by the first picture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import EstimationResult, RunResult
from gpebo_cli.model.descriptor import Array
from gpebo_cli.results import style
from gpebo_cli.results.names import FIGURE_NAMES
from gpebo_cli.results.style import (
    Axis,
    Curve,
    Panel,
    compose,
    line,
    number_text,
    symbol,
    with_unit,
)
from gpebo_cli.schema import nearest, shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FigureFunction = Callable[[RunResult], list[Panel]]

MAX_CASES = 4  # curves of more cases than that do not stay apart
_INITIAL = "e0_"  # of the names of parameters that stand for an initial state
MIN_GAINS = 3  # fewer points are not a curve over the gain


def states(result: RunResult) -> list[Panel]:
    """Fig. 3: the true states over time, one panel per unit."""
    known, names = _known(result), result.system.states
    shown = result.signals.states[:, known]
    return _by_unit(result, "states", [names[i] for i in known], result.signals.t, shown)


def signals(result: RunResult) -> list[Panel]:
    """Inputs and outputs over time: all an observer gets to see, beside the truth if it differs."""
    s, system = result.signals, result.system
    return [
        *_by_unit(result, "inputs", system.inputs, s.t, s.inputs, s.measured_inputs),
        *_by_unit(result, "outputs", system.outputs, s.t, s.outputs, s.measured_outputs),
    ]


def regressor(result: RunResult) -> list[Panel]:
    """Fig. 2: the regressor ψ over time, one panel per row that is not zero throughout."""
    regression = result.regression
    if regression is None or not regression.parameters:
        return []
    psi = regression.psi
    rows = [row for row in range(psi.shape[1]) if np.any(psi[:, row])] or [0]
    return [
        Panel(
            label="regressor ψ" if len(rows) == 1 else f"ψ, row {row + 1}",
            curves=tuple(
                Curve(regression.t, psi[:, row, column], f"ψ {name}", line(column))
                for column, name in enumerate(regression.parameters)
            ),
            legend=row == rows[0],
        )
        for row in rows
        if row < psi.shape[1]
    ]


def estimates(result: RunResult) -> list[Panel]:
    """All states and their estimates, where the parameters do not tell x_a from x_b."""
    differential, other = _split(result)
    return [] if differential else _estimates(result, other)


def estimates_a(result: RunResult) -> list[Panel]:
    """Fig. 4: the differential states x_a and their estimates."""
    return _estimates(result, _split(result)[0])


def estimates_b(result: RunResult) -> list[Panel]:
    """Fig. 5: the other states x_b and their estimates."""
    differential, other = _split(result)
    return _estimates(result, other) if differential else []


def parameters(result: RunResult) -> list[Panel]:
    """Estimates of the parameters over time, with the truth dashed, where the truth varies.

    The components of e₀ are left out: where θ varies they are what makes up for it, of any size.
    """
    estimation = result.estimation
    if estimation is None or not result.system.theta_varies:
        return []
    shown = _shown_cases(estimation)
    labels = _case_labels(result, estimation, shown)
    panels = []
    for i, name in enumerate(result.system.unknowns):
        truth = estimation.true_parameters[:, i]
        curves = [
            Curve(estimation.t, estimation.parameters[case, :, i], label, line(k))
            for k, (case, label) in enumerate(zip(shown, labels, strict=True))
        ]
        curves.append(Curve(estimation.t, truth, "true", style.VARYING))
        panels.append(
            Panel(
                with_unit(name, _parameter_unit(result, name)),
                tuple(curves),
                limits=_estimate_limits(truth, estimation.parameters[shown, :, i]),
                legend=i == 0,
                note=_note(estimation, shown) if i == 0 else "",
            )
        )
    return panels


def parameter_error(result: RunResult) -> list[Panel]:
    """Fig. 6: error of every parameter (for the circuit, the initial conditions), logarithmic.

    Where θ varies, of the unknowns only, as in ``parameters``.
    """
    estimation = result.estimation
    if estimation is None:
        return []
    truth = estimation.true_parameters
    known = np.flatnonzero(~np.isnan(truth).any(axis=0))
    size = np.nan_to_num(np.max(np.abs(truth), axis=0))
    largest = float(np.max(size, initial=0.0))  # the measure of one that is zero
    curves = [
        (
            name,
            _parameter_unit(result, name),
            estimation.parameters[:, :, i] - truth[:, i],
            float(size[i]) or largest,
        )
        for i, name in enumerate(estimation.names)
        if i in known and (not result.system.theta_varies or name in result.system.unknowns)
    ]
    return _errors(result, estimation, curves)


def state_error(result: RunResult) -> list[Panel]:
    """Error of all states, where the parameters do not tell x_a from x_b."""
    differential, other = _split(result)
    return [] if differential else _state_errors(result, other)


def state_error_a(result: RunResult) -> list[Panel]:
    """Fig. 7: error of the differential states x_a, logarithmic."""
    return _state_errors(result, _split(result)[0])


def state_error_b(result: RunResult) -> list[Panel]:
    """Fig. 8: error of the other states x_b, logarithmic."""
    differential, other = _split(result)
    return _state_errors(result, other) if differential else []


def gram(result: RunResult) -> list[Panel]:
    """Eigenvalues of the Gram matrix G(t), the level asked of them and when it is reached."""
    excitation = result.excitation
    if excitation is None or excitation.gram_eigenvalues.shape[1] == 0:
        return []
    t, eigenvalues = excitation.t, excitation.gram_eigenvalues
    ends = t[[0, -1]]
    curves = [
        Curve(t, eigenvalues[:, i], f"λ{style.subscript(i + 1)}", line(i))
        for i in range(eigenvalues.shape[1])
    ]
    level = f"ρ = {number_text(excitation.rho)}"
    curves.append(Curve(ends, np.full(2, excitation.rho), level, style.LIMIT))
    reached = None
    if excitation.t_c is not None:
        reached = (excitation.t_c, f"t_c = {number_text(excitation.t_c)} s")
    size = float(np.nanmax(eigenvalues, initial=0.0))
    return [
        Panel("eigenvalues of G", tuple(curves), log=True, size=size, vertical=reached, legend=True)
    ]


def delta(result: RunResult) -> list[Panel]:
    """Δ, the determinant that mixing leaves as a scalar regressor, logarithmic."""
    estimation = result.estimation
    if estimation is None or estimation.delta is None:
        return []
    values = np.abs(estimation.delta)
    shown = _shown_cases(estimation) if len(values) > 1 else [0]
    labels = _case_labels(result, estimation, shown) if len(values) > 1 else [""]
    curves = tuple(
        Curve(estimation.t, values[case], label, line(i))
        for i, (case, label) in enumerate(zip(shown, labels, strict=True))
    )
    size = float(np.max(values[np.isfinite(values)], initial=0.0))
    note = _note(estimation, shown) if len(values) > 1 else ""
    return [Panel("|Δ|", curves, log=True, size=size, legend=len(shown) > 1, note=note)]


def gains(result: RunResult) -> list[Panel]:
    """Final errors and seconds to 1 % over the one gain that varies, if at least three do."""
    estimation, metrics = result.estimation, result.metrics
    gain = _varying_gain(estimation) if estimation is not None else None
    if estimation is None or metrics is None or gain is None:
        return []
    values = np.array([case[gain] for case in estimation.cases])
    order = np.argsort(values, kind="stable")
    axis = Axis(gain, f"gain {symbol(gain)}", log=True)

    def over_gain(parameters: Array, states: Array) -> tuple[Curve, ...]:
        pairs = (("parameters", parameters), ("states", states))
        return tuple(
            Curve(values[order], column[order], label, replace(line(k), dots=True))
            for k, (label, column) in enumerate(pairs)
        )

    if np.isnan(metrics.final_error_parameters).all() and not _known(result):
        return []
    final = over_gain(metrics.final_error_parameters, metrics.final_error_states)
    seconds = over_gain(metrics.seconds_to_1pct_parameters, metrics.seconds_to_1pct_states)
    size = max(_parameter_size(result), _state_size(result))
    # Seconds on a linear axis: they seldom span a decade, and a decade is all one could label.
    return [
        Panel("final error", final, log=True, size=size, axis=axis, legend=True),
        Panel("time to 1 % (s)", seconds, axis=axis),
    ]


def error_norms(result: RunResult) -> list[Panel]:
    """Norms of the errors of all parameters and of all states for a few of at least three cases."""
    estimation = result.estimation
    if estimation is None or len(estimation.cases) < MIN_GAINS:
        return []
    shown = _shown_cases(estimation)
    labels = _case_labels(result, estimation, shown)
    named = [(label, result, case) for label, case in zip(labels, shown, strict=True)]
    return _norm_panels(named, _note(estimation, shown))


def overlay(results: Mapping[str, RunResult]) -> list[Panel]:
    """Norms of the errors of runs that have one case each, by the name each run goes by."""
    return _norm_panels([(label, result, 0) for label, result in results.items()], "")


FIGURES: dict[str, FigureFunction] = {name: globals()[name] for name in FIGURE_NAMES}


def check_names(names: Iterable[str]) -> None:
    """Refuse names that are not figures; worth doing before a long run.

    Raises:
        ConfigError: one is unknown; it is named with the most similar one that exists.
    """
    for name in names:
        if name not in FIGURES:
            raise ConfigError(
                f"figures: there is no figure {shown(name)}; known: {', '.join(FIGURES)}"
                + nearest(str(name), FIGURES)
            )


def describe(
    result: RunResult, names: Iterable[str] | None = None
) -> Iterator[tuple[str, list[Panel]]]:
    """Panels of the figures called ``names``; those the run has nothing for are left out.

    With ``None``, all; ``signals``, which the paper does not have, only if there was no observer or
    it saw something else than the truth.

    Raises:
        ConfigError: a name is unknown; at once, not at the first figure.
    """
    if names is None:
        noisy = result.signals.measured_outputs is not None
        plain = result.estimation is None or noisy
        names = [name for name in FIGURES if name != "signals" or plain]
    wanted = list(dict.fromkeys(names))
    check_names(wanted)
    described = ((name, FIGURES[name](result)) for name in wanted)
    return ((name, panels) for name, panels in described if panels)


def draw(result: RunResult, names: Iterable[str] | None = None) -> Iterator[tuple[str, Figure]]:
    """Draw what :func:`describe` gives, one figure at a time.

    Raises:
        ConfigError: a name is unknown; at once, not at the first figure.
    """
    return ((name, compose(panels)) for name, panels in describe(result, names))


def _split(result: RunResult) -> tuple[list[int], list[int]]:
    """Numbers of the states x_a, whose initial value is a parameter ``e0_<state>``, and the rest.

    Where the kernel of E(t) rotates the parameters are ``e0_1…``, of no single state: none is x_a.
    """
    parameters = result.estimation.names if result.estimation else ()
    names = result.system.states
    differential = [i for i, name in enumerate(names) if _INITIAL + name in parameters]
    return differential, [i for i in range(len(names)) if i not in differential]


def _parameter_unit(result: RunResult, parameter: str) -> str:
    units = result.system.units
    return units.get(parameter) or units.get(parameter.removeprefix(_INITIAL), "")


def _by_unit(
    result: RunResult, kind: str, names: Sequence[str], t: Array, values: Array,
    measured: Array | None = None,
) -> list[Panel]:
    """One panel per unit, in the order in which the units appear; what was measured behind."""
    units = [result.system.units.get(name, "") for name in names]
    panels = []
    for unit in dict.fromkeys(units):
        members = [i for i, other in enumerate(units) if other == unit]
        label = names[members[0]] if len(members) == 1 else kind
        curves = tuple(Curve(t, values[:, i], names[i], line(k)) for k, i in enumerate(members))
        if measured is not None:
            curves = (
                *(
                    Curve(t, measured[:, i], f"{names[i]} measured", style.MEASURED)
                    for i in members
                    if np.any(measured[:, i] != values[:, i])
                ),
                *curves,
            )
        panels.append(Panel(with_unit(label, unit), curves, legend=len(curves) > 1))
    return panels


def truth_at(result: RunResult, t: Array) -> Array:
    """True states (M, n) at the times t (M,) of the estimates, which are some of the output's."""
    signals = result.signals
    if len(t) == len(signals.t):
        return signals.states
    # The middle between two neighbours: rounding of a time does not choose another row.
    nearest = np.searchsorted(0.5 * (signals.t[1:] + signals.t[:-1]), t)
    states: Array = signals.states[nearest]
    return states


def _known(result: RunResult) -> list[int]:
    """Those of the states whose truth is known: all but those a recording does not have."""
    unknown = np.isnan(result.signals.states).all(axis=0)
    return [int(i) for i in np.flatnonzero(~unknown)]


def _shown_cases(estimation: EstimationResult) -> list[int]:
    count = len(estimation.cases)
    if count <= MAX_CASES:
        return list(range(count))
    return [int(case) for case in np.linspace(0, count - 1, MAX_CASES).round()]


def _seen(result: RunResult, members: Iterable[int]) -> list[int]:
    """Those of the states ``members`` that the observer sees: not all of their estimates NaN."""
    estimation = result.estimation
    if estimation is None:
        return []
    return [i for i in members if not np.isnan(estimation.states[:, :, i]).all()]


def _varying_gain(estimation: EstimationResult) -> str | None:
    """The gain that alone tells the cases apart, if there are enough of them to draw a curve."""
    names = dict.fromkeys(name for case in estimation.cases for name in case)
    values = {name: {case.get(name, np.nan) for case in estimation.cases} for name in names}
    varying = [name for name, found in values.items() if len(found) > 1]
    if len(varying) != 1:
        return None
    found = values[varying[0]]
    usable = len(found) >= MIN_GAINS and all(np.isfinite(v) and v > 0 for v in found)
    return varying[0] if usable else None


def _parameter_size(result: RunResult) -> float:
    if result.estimation is None:
        return 0.0
    truth = result.estimation.true_parameters
    known = truth[:, ~np.isnan(truth).any(axis=0)]
    return float(np.max(np.linalg.norm(known, axis=1), initial=0.0))


def _state_size(result: RunResult) -> float:
    """The largest norm of the states that the observer sees."""
    seen = result.signals.states[:, _seen(result, _known(result))]
    return float(np.max(np.linalg.norm(seen, axis=1), initial=0.0))


def _norm_panels(named: Sequence[tuple[str, RunResult, int]], note: str) -> list[Panel]:
    """Norms of the errors of parameters and of states: a curve per label, run and case."""
    of_parameters: list[Curve] = []
    of_states: list[Curve] = []
    sizes = [0.0, 0.0]
    for k, (label, result, case) in enumerate(named):
        estimation = result.estimation
        if estimation is None:
            continue
        parameters = estimation.parameters[case] - estimation.true_parameters
        parameters = parameters[:, ~np.isnan(estimation.true_parameters).any(axis=0)]
        seen = _seen(result, _known(result))
        states = (estimation.states[case] - truth_at(result, estimation.t))[:, seen]
        for curves, errors in ((of_parameters, parameters), (of_states, states)):
            if errors.shape[1]:
                curves.append(Curve(estimation.t, np.linalg.norm(errors, axis=1), label, line(k)))
        sizes = [max(sizes[0], _parameter_size(result)), max(sizes[1], _state_size(result))]
    panels = [
        Panel("‖parameter error‖", tuple(of_parameters), log=True, size=sizes[0]),
        Panel("‖state error‖", tuple(of_states), log=True, size=sizes[1]),
    ]
    panels = [panel for panel in panels if panel.curves]
    return [replace(panel, legend=True, note=note) for panel in panels[:1]] + panels[1:]


def _note(estimation: EstimationResult, shown: Sequence[int]) -> str:
    count = len(estimation.cases)
    return f"{len(shown)} of {count} cases:" if len(shown) < count else ""


def _case_labels(
    result: RunResult, estimation: EstimationResult, shown: Sequence[int]
) -> list[str]:
    """Name cases by the gains that vary among those shown; a single one by its estimator."""
    cases = [estimation.cases[case] for case in shown]
    gains = list(dict.fromkeys(gain for case in cases for gain in case))
    varying = [gain for gain in gains if len({case.get(gain) for case in cases}) > 1]
    if not varying:
        name = str(result.settings.estimator.get("name", "estimate"))
        return [name] if len(shown) == 1 else [f"{name}, case {case}" for case in shown]
    return [
        ", ".join(f"{symbol(gain)} = {number_text(case[gain])}" for gain in varying if gain in case)
        for case in cases
    ]


def _estimates(result: RunResult, members: Sequence[int]) -> list[Panel]:
    estimation = result.estimation
    members = _seen(result, members)
    if estimation is None or not members:
        return []
    signals, system = result.signals, result.system
    known = _known(result)
    shown = _shown_cases(estimation)
    labels = _case_labels(result, estimation, shown)
    panels = []
    for i in members:
        truth = signals.states[:, i]
        name = system.states[i]
        curves = [Curve(signals.t, truth, "true", style.TRUTH)] if i in known else []
        curves += [
            Curve(estimation.t, estimation.states[case, :, i], label, line(k))
            for k, (case, label) in enumerate(zip(shown, labels, strict=True))
        ]
        deviation = _deviation(estimation, name)
        if deviation is not None:
            middle = estimation.states[0, :, i]
            curves += [
                Curve(estimation.t, middle + 2 * deviation, "± 2σ", style.SPREAD),
                Curve(estimation.t, middle - 2 * deviation, "", style.SPREAD),
            ]
        panels.append(
            Panel(
                with_unit(name, system.units.get(name, "")),
                tuple(curves),
                limits=(
                    _estimate_limits(truth, estimation.states[shown, :, i]) if i in known else None
                ),
                legend=i == members[0],
                note=_note(estimation, shown) if i == members[0] else "",
            )
        )
    return panels


def _deviation(estimation: EstimationResult, name: str) -> Array | None:
    """The standard deviation (M,) that an estimator with one case states of an estimate."""
    stated = estimation.checks.get(f"{name}_std")
    return stated[0] if stated is not None and len(stated) == 1 else None


def _estimate_limits(truth: Array, guesses: Array) -> tuple[float, float]:
    """Show the truth and all estimates, but do not let a wild one flatten the truth to a line."""
    low, high = float(np.nanmin(truth)), float(np.nanmax(truth))
    room = 2.0 * (high - low or abs(high) or 1.0)
    finite = guesses[np.isfinite(guesses)]
    lowest = float(np.min(finite, initial=low))
    highest = float(np.max(finite, initial=high))
    return max(lowest, low - room), min(highest, high + room)


def _state_errors(result: RunResult, members: Sequence[int]) -> list[Panel]:
    estimation, known = result.estimation, _known(result)
    members = [i for i in _seen(result, members) if i in known]
    if estimation is None or not members:
        return []
    truth = truth_at(result, estimation.t)
    names, units = result.system.states, result.system.units
    curves = [
        (
            names[i],
            units.get(names[i], ""),
            estimation.states[:, :, i] - truth[:, i],
            float(np.max(np.abs(truth[:, i]), initial=0.0)),
        )
        for i in members
    ]
    return _errors(result, estimation, curves)


def _errors(
    result: RunResult,
    estimation: EstimationResult,
    quantities: Sequence[tuple[str, str, Array, float]],
) -> list[Panel]:
    """One logarithmic panel per quantity: its name, unit, error (G, M) and size."""
    shown = _shown_cases(estimation)
    labels = _case_labels(result, estimation, shown)
    panels = []
    for number, (name, unit, error, size) in enumerate(quantities):
        curves = [
            Curve(estimation.t, np.abs(error[case]), label, line(k))
            for k, (case, label) in enumerate(zip(shown, labels, strict=True))
        ]
        deviation = _deviation(estimation, name)
        if deviation is not None:
            curves.append(Curve(estimation.t, 2 * deviation, "2σ", style.SPREAD))
        panels.append(
            Panel(
                with_unit(f"error of {name}", unit),
                tuple(curves),
                log=True,
                size=size,
                legend=number == 0,
                note=_note(estimation, shown) if number == 0 else "",
            )
        )
    return panels
