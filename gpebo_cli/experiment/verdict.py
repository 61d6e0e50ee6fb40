"""The last line of a run: exciting or not and from when on, and how well the state is known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import isfinite

import numpy as np

from gpebo_cli.evidence.excitation import Excitation
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.experiment.doubts import WORSE
from gpebo_cli.experiment.result import (
    ActiveBound,
    Fit,
    SignalsResult,
    SimulationResult,
    place_of_least,
)
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.model.functions import FunctionCoefficients
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.schema import counted, instant

_MORE = 1.2  # times the sensors' noise: more than that is something else
_LESS = 0.1  # of the sensors' noise: less than that says nothing against the model
_FEW = 4.0  # the same where integrals of noise are all that is left: few independent numbers
_EXACT = 1e-4  # of Y: what is left is the interpolation between samples
_SUSPECTED = (
    "a missing or wrong parameter, a column of another unit or sign (data.scale, data.time_unit), "
    "a sensor that drifts or saturates, a noisy input, or a delay"
)
_OF_ESTIMATES = "what is left says more of these estimates than of the model"
_TAKEN_OUT = "observer.remedy=noise_free takes it out"
_NOT_FED_BACK = "observer.form=strangeness_free without a remedy does not"
_AMPLIFIED = 1e3  # times the tolerance: a simulation that is worse than that says so


def verdict(
    excitation: Excitation, cases: Sequence[Mapping[str, float]], requirement: Requirement,
    metrics: Metrics | None = None, fit: Fit | None = None,
    unknown: Sequence[str] = (), left_out: Sequence[str] = (),
    active: Mapping[int, Sequence[ActiveBound]] | None = None,
) -> str:
    """The last line: exciting or not and from when on, and how well the state is known.

    Without true states it says how well the estimates explain the data.
    """
    if excitation.rho is None:
        level = f"λ_min(G) = {excitation.level:.3g} with unit diagonal"
    else:
        level = f"λ_min(G) = {excitation.lambda_min:.3g}, ρ = {excitation.rho:.2g}"
    if excitation.t_c is not None:
        first = f"interval-exciting from t = {instant(excitation.t_c)} s on ({level})"
        determined = excitation.determined
        if determined is not None:
            since = f"from t = {instant(determined)} s on"
            since = since if len(excitation.t) > 1 else "at the end"  # all that a stream knows
            first += f", parameters well determined {since}"
    else:
        first = f"NOT interval-exciting: {level}; not excited: {excitation.weakest_direction}"
    without = ("not determined by the data", unknown), ("left out by the observer", left_out)
    parts = [first, *(f"{why}: {', '.join(names)}" for why, names in without if names)]
    best = None if metrics is None else _best_case(metrics)
    if metrics is not None and best is not None:
        seconds, reached = metrics.seconds_to_1pct_states[best], ", never below 1 %"
        if metrics.seconds_to_settled is not None:  # noise: when an error is small is chance
            seconds, reached = metrics.settled[best], ""
        if isfinite(seconds):
            near = "below 1 %" if reached else "all within ±2σ of the end"
            reached = f", {near} after {seconds:.4g} s"
        parts.append(f"state error {metrics.final_error_states[best]:.2g} at the end{reached}")
    else:
        best = 0 if fit is None else fit.best
    if fit is not None:
        parts.append(
            f"|Y − ψη̂| with the final estimates is {fit.residual[best]:.2g}, |Y| is "
            f"{fit.size:.2g} (root mean squares){_explains(fit, best)}"
        )
    if active and active.get(best):
        parts.append("held by bounds: " + ", ".join(map(str, active[best])))
    label = ", ".join(f"{name} = {value:.6g}" for name, value in cases[best].items())
    line = "; ".join(parts) + (f" ({label})" if label else "")
    if not requirement.holds:
        line += f"; {requirement.name} not met: {requirement.text}"
    return line


def _explains(fit: Fit, case: int) -> str:
    """What the residual says of the model."""
    residual = fit.residual[case]
    if residual > WORSE * fit.least and residual > _EXACT * fit.size:
        return f", where least squares of the same data leave {fit.least:.2g}: {_OF_ESTIMATES}"
    noise, why = "", _SUSPECTED
    if fit.ratio is not None:
        noise = f", {fit.ratio:.2f} times what the sensors' noise makes"
    if fit.correlation is None:  # all outputs are used up for states
        if fit.ratio is None:
            return ""
        return noise + (f", which suggests {why}" if fit.ratio > _FEW else "")
    if residual <= _EXACT * fit.size:
        return ": the estimates explain the data"
    coarse = f"rows too far apart for what {', '.join(fit.coarse)} does between them (data.hold)"
    if fit.least_white:
        of_least = "that of least squares that weigh each output by its noise is"
        why = f"{_OF_ESTIMATES}, or of {coarse}" if fit.coarse else _OF_ESTIMATES
        return f": the residual{noise and noise + ','} is not white, {of_least}: {why}"
    if fit.far:
        told = (f"{count} of {name} (first at t = {instant(t, 6)})" for name, count, t in fit.far)
        rest = "" if fit.white else (
            f"; without them the residual is not white, which they may have made, or {why}"
        )
        return (
            f": some samples are far from what explains the others, {', '.join(told)}, which "
            "suggests gaps that are written as numbers (data.gaps), a sensor that fails, or rows "
            "too far apart for what moves there"
            f"{noise}{rest}"
        )
    if fit.ratio is not None and fit.ratio < _LESS:
        return f": the residual is far below the noise{noise}"
    if fit.white and (fit.ratio is None or fit.ratio < _MORE):
        return f": the estimates explain the data up to white noise{noise}"
    if fit.white:
        return f": the residual is white{noise}, which suggests a noisier sensor than was said"
    made = " or ".join(f"noise of {', '.join(names)} {does}" for names, does in (
        (fit.in_matrices, f"in the matrices does ({_TAKEN_OUT})"), (fit.of_inputs, "does"),
        (fit.fed_back, f"does, which the observer feeds back ({_NOT_FED_BACK})"),
    ) if names)
    if fit.rounded:
        steps = ", ".join(f"{name} to steps of {step:.2g}" for name, step in fit.rounded)
        why = f"that it is rounding ({steps}), for which deviations are too small, or {why}"
    why = f"{coarse}, or {why}" if fit.coarse else why
    return (
        f": the residual{noise and noise + ','} is not white (its correlation is "
        f"{np.abs(fit.correlation).max():.2f}{', and a part of it is slow' * fit.slow}"
        f"{', and it follows the inputs' * fit.follows}), which "
        f"{made}{'; or it ' * bool(made)}suggests {why}"
    )


def simulation_verdict(simulated: SimulationResult) -> str:
    """The last line of a run without an observer."""
    return (
        f"simulated: index {simulated.index}, {simulated.differential} differential and "
        f"{simulated.algebraic} algebraic equations, error estimate "
        f"{simulated.error_estimate:.1e} of each state's size{_cost_and_loss(simulated)}"
    )


def simulation_note(simulated: SimulationResult | None, tol: float) -> str:
    """What the last line of a run has to say of the simulation, from "; " on."""
    if simulated is None:
        return ""
    told = _cost_and_loss(simulated)
    if simulated.error_estimate > _AMPLIFIED * tol:
        told += (
            "; the simulation is not as good as solver.tol, only to "
            f"{simulated.error_estimate:.1e} of each state's size"
        )
    return told


def _cost_and_loss(simulated: SimulationResult) -> str:
    """What the simulation of a nonlinear plant cost, and states that lost digits, from "; " on."""
    solves, told = simulated.linear_solves, ""
    if solves is not None:
        told = f"; Newton's method cost {solves:.2g} linear solves"
    if simulated.vague:
        told += (
            f"; less than three digits are known of {', '.join(simulated.vague)} "
            "(error_estimate.by_state in summary.json)"
        )
    return told


def columns_note(names: Sequence[str]) -> str:
    """What the last line of a run has to say of columns that are read for several signals."""
    several = [name for name, count in Counter(names).items() if count > 1]
    return f"; read for several signals: column {', '.join(several)}" if several else ""


def rows_note(left_out: int, filled: int, policy: str) -> str:
    """What the last line of a run has to say of rows that were left out and of filled cells."""
    why = "have gaps or repeat a time" if policy == "drop" else (
        "are before the first or after the last sample of a column"
    )
    note = f"; rows left out (data.missing={policy}): {left_out}, they {why}" if left_out else ""
    return note + (
        f"; cells filled (data.missing={policy}): {filled}, which deviations take for measured"
        if filled else ""
    )


def pauses_note(rows: Rows) -> str:
    """What the last line of a run has to say of pauses, through which it has no data."""
    long = np.diff(rows.t)[rows.pauses]
    if not len(long):
        return ""
    how, instead = ("signals are interpolated", "") if rows.lines else (
        "the last sample is held", "data.hold=linear, or "
    )
    return (
        f"; through {counted(len(long), 'pause')} of up to {long.max():.3g} s {how} "
        f"(data.hold={rows.hold}), which biases estimates beyond their deviations if the plant "
        f"moves meanwhile: take {instead}a file for each part (data.file=[…])"
    )


def functions_note(system: DescriptorSystem, signals: SignalsResult) -> str:
    """What the last line of a run has to say of functions without bounds, from "; " on."""
    source = system.coefficients
    if isinstance(source, FunctionCoefficients) and source.functions:
        which = f"functions from Python ({', '.join(source.functions)})"
    elif not signals.bounded:
        which = "functions that change so often"
    else:
        return ""
    return f"; nothing bounds what {which} do between the times at which they are evaluated"


def _best_case(metrics: Metrics) -> int | None:
    """The first case below 1 % for good; if there is none, the one with the least final error.

    By the final error alone, cases that have all converged would be told apart by rounding. Under
    noise both are chance, and the least error over the whole run counts. None where the error of no
    case is a number.
    """
    least_error = place_of_least(metrics.final_error_states)
    if least_error is None:
        return None
    noisy = metrics.seconds_to_settled is not None
    first = place_of_least(
        metrics.rms_error_states if noisy else metrics.seconds_to_1pct_states
    )
    return least_error if first is None else first
