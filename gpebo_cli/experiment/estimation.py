"""Observer and estimator over a source, in continuous time or at samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli import estimators, kernels
from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.evidence.excitation import (
    WINDOWS,
    Excitation,
    assess,
    estimable,
    sampled_window_level,
)
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.evidence.metrics import NAMES as METRICS
from gpebo_cli.evidence.metrics import (
    SETTLED,
    Metrics,
    levels,
    measure_squares,
    settled,
    settling_times,
    standing_since,
)
from gpebo_cli.experiment.assumptions import Observed, visible, warnings
from gpebo_cli.experiment.bounds import BoundedEstimates, bounded
from gpebo_cli.experiment.memory import check_samples
from gpebo_cli.experiment.noise import NoiseLevels, signal_noise
from gpebo_cli.experiment.online import Online, OnlineEstimates, joined
from gpebo_cli.experiment.pace import Pace
from gpebo_cli.experiment.result import EstimationResult, Fit, NoiseStatistics, RegressionResult
from gpebo_cli.experiment.seeds import over_seeds, refuse_seeds
from gpebo_cli.experiment.several import joined_observation
from gpebo_cli.experiment.sources import Source, kept_samples, sample_times
from gpebo_cli.experiment.uncertainty import (
    residual_ratio,
    sampled_deviations,
    standard_deviations,
)
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Measurements, Observation, Observer, Sampling, StateMap
from gpebo_cli.observers._observation import AffineStateMap
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import Settings
from gpebo_cli.simulation.signals import Signals

_SAMPLES_AT_ONCE = 2048
_LAGS = 20  # of the residual's autocorrelation
_PER_QUANTITY = 1000  # cases up to which each quantity's own time is told
_SILENT = 1e-9  # of an output: a residual below that is rounding
_LEAST = 1e-6  # of what would explain Y alone: a parameter smaller than that has no size of its own
_STILL = 1e-9  # of the same: an estimate that moved by less than that was not moved by data
_BATCH = 1 << 21  # numbers held at once while cases are evaluated: beyond it calls cost little

# name of a stage of the run -> what measures it
Stage = Callable[[str], AbstractContextManager[Pace]]


@dataclass(frozen=True, eq=False)
class Estimated:
    """What observer and estimator made of a source."""

    observed: Observed
    regression: RegressionResult
    excitation: Excitation
    estimation: EstimationResult
    metrics: Metrics
    fit: Fit | None  # of a recording
    # From when on each parameter and state can be known, None: never; or how that is found,
    estimable: Mapping[str, float | None] | Callable[[], Mapping[str, float | None]]
    unknown: Sequence[str]  # and of which it is never.
    left_out: tuple[str, ...] = ()  # states that the observer does not estimate
    noise: NoiseStatistics | None = None
    by_observer: bool = False  # the observer estimates by itself
    note: str = ""  # what the last line of a run has to say of it, from "; " on


def continuous(
    settings: Settings, system: DescriptorSystem, source: Source, levels: NoiseLevels,
    observer: Observer, estimator: estimators.Estimator, stage: Stage,
) -> Estimated:
    """Observer and estimator as differential equations.

    Raises:
        ConfigError: settings that do not fit the plant.
        ModelError: an assumption of the observer fails.
        SolverError: a tolerance cannot be reached.
    """
    t = source.t

    def observe(signals: Source | Signals) -> Observation:
        known = signals if isinstance(signals, Source) else source
        seen = Measurements(
            signals.inputs, signals.outputs, signal_noise(settings.noise, levels),
            known.derivatives, known.t if known.recording else None,
        )
        return observer.observe(system, seen, settings.solver)

    with stage("observe"):
        observation = (
            joined_observation([observe(each) for each in source.pieces], source.pieces, system.q)
            if source.pieces else observe(source)
        )
        regression = observation.regression
        sampler = regression.mesh.sampler(t)
        sampled = RegressionResult(
            t, sampler(regression.Y.values), sampler(regression.psi.values),
            regression.parameters, observation.error_estimate,
        )
    with stage("excitation"):
        excitation = assess(regression, t, settings.excitation, settings.solver.tol)
    with stage("estimate") as pace:
        known, seen_at = excitation.final, visible(observation, t, system.states)
        seen, names = seen_at(known), (regression.parameters, system.states)
        unknown = _never(estimable(known, t[-1:], *names, seen))
        estimator = estimators.tuned(estimator, regression)

        def times() -> dict[str, float | None]:
            return estimable(excitation.known, t, *names, seen_at(excitation.known))

        try:
            used, estimation, metrics = _estimate(
                settings, system, observation.estimator or estimator, observation, source, known,
                seen[-1], pace,
            )
            estimator = estimator if observation.estimator else used
        except SolverError as error:
            raise SolverError("; ".join([str(error), *warnings(observation)])) from error
    note = observation.note
    if settings.uncertainty and observation.estimator is None:
        with stage("uncertainty"):
            reduced, columns = _reduced(observation, known.independent)
            found = standard_deviations(
                reduced, estimator, source, settings.noise, levels, estimation.t,
                estimation.states,
            )
            if isinstance(found, str):
                note += f"; no standard deviations: {found}" if found else ""
            else:
                deviations = np.full(estimation.parameters.shape, np.nan)
                deviations[..., columns] = found[0]
                deviations[np.isnan(estimation.parameters)] = np.nan
                of_states = np.where(np.isnan(estimation.states), np.nan, found[1])
                deviations[estimation.still] = of_states[estimation.still] = np.nan
                estimation = replace(
                    estimation, parameters_std=deviations, states_std=of_states
                )
                metrics = _standing(estimation, metrics, reduced.state_map, columns, system)
    fit = _fit(observation, estimation, system, source) if source.recording else None
    if fit is not None and settings.uncertainty and not levels.silent:
        fit = replace(fit, ratio=residual_ratio(observation, source, settings.noise, levels))
    noise = None
    if settings.noise.seeds > 1 and source.true is not None:
        with stage("seeds") as pace:
            theta = source.theta(t[-1:])
            noise = over_seeds(
                observation, observe, source.true, theta, estimator, settings.noise, levels, pace
            )
    return Estimated(
        observation, sampled, excitation, estimation, metrics,
        fit, times, [name for name in unknown if name not in observation.unseen],
        observation.unseen, noise,
        observation.estimator is not None, note,
    )


def at_samples(
    settings: Settings, system: DescriptorSystem, source: Source, levels: NoiseLevels,
    samples: Sampling, estimator: estimators.Estimator, stage: Stage,
) -> Estimated:
    """Observer and estimator at samples of the signals, ``samples.step`` apart.

    Raises:
        ConfigError: the observer or the estimator works in continuous time only.
        ModelError: an assumption of the observer fails.
        SolverError: a step between samples cannot be resolved.
    """
    refuse_seeds(settings.noise)
    if source.pieces:
        raise ConfigError("data.file: several files need an observer in continuous time")
    start, stop = source.inputs.mesh.edges[[0, -1]].tolist()
    with stage("observe and estimate") as pace:
        t = sample_times(samples.step, start, stop)
        check_samples(len(estimator.cases), len(t), system)
        u, y = source.inputs(t), source.outputs(t)

        def fed(
            by: estimators.Estimator, columns: IntArray | None, *, last: bool
        ) -> tuple[Online, list[OnlineEstimates]]:
            wanted = (
                sampled_deviations(settings.noise, levels, source)
                if settings.uncertainty and last else None
            )
            online = Online(
                settings, system, samples.hold, start, np.append(u[0], y[0]), by, wanted,
                source.derivatives, columns,
            )
            made = []
            done = pace(len(t), f"samples with {len(estimator.cases)} cases")
            for i in range(0, len(t), _SAMPLES_AT_ONCE):
                part = slice(i, i + _SAMPLES_AT_ONCE)
                found = online.feed(t[part], u[part], y[part])
                made += [found] if last else []
                done(min(part.stop, len(t)))
            return online, made

        def estimated(columns: IntArray | None) -> tuple[Online, OnlineEstimates]:
            by = estimators.tuned_for(
                estimator, lambda one: fed(one, columns, last=False)[0].requirement
            )
            online, made = fed(by, columns, last=True)
            raised = estimators.raised(by, online.requirement)
            if raised is not by:
                online, made = fed(raised, columns, last=True)
            return online, joined(made)

        online, made = estimated(None)
        by, columns = online, made.known.independent
        if 0 < len(columns) < len(online.parameters) and not online.fits:
            # As many numbers in its settings as parameters: all are estimated.
            with suppress(ConfigError):
                by, few = estimated(columns)
                made = made.with_some(few, columns)
        truth = online.truth(made.extension)(t, source.theta(t), source.states)
        x = source.states(t)
        parameters = made.parameters * _told(made.known.parameters[-1])
        states = made.states * _told(made.seen[-1])
        numbers = _numbers(
            t, parameters - truth, states - x, _sizes(truth, online.natural_sizes, x),
            _judged(source, truth.shape[1]),
        )
    chosen = kept_samples(1, len(t), settings.time.samples)
    kept = chosen[kept_samples(len(by.cases), len(chosen), settings.output.max_rows)]
    p = parameters.shape[2]
    still = _still(parameters, by.requirement, online.natural_sizes)
    std = None if made.std is None or made.level is None else made.std[:, kept] * made.level[-1]
    if std is not None:
        told = np.concatenate([parameters, states], axis=2)[:, kept]
        std[np.isnan(told) | still[:, None, None]] = np.nan
    estimation = EstimationResult(
        cases=by.cases,
        t=t[kept],
        names=online.parameters,
        parameters=parameters[:, kept],
        true_parameters=truth[kept],
        states=states[:, kept],
        delta=None if made.delta is None else made.delta[:, kept],
        checks={},
        requirement=by.requirement,
        parameters_std=None if std is None else std[..., :p],
        states_std=None if std is None else std[..., p:],
        still=still,
    )
    with stage("excitation"):
        window = settings.excitation.window or (t[-1] - t[0]) / WINDOWS
        level = sampled_window_level(made.regression, window)[chosen]
        excitation = online.excitation(made, chosen, level, window)
    metrics = _metrics(numbers, online.parameters, system)
    times = estimable(
        excitation.known, excitation.t, online.parameters, system.states, made.seen[chosen]
    )
    return Estimated(
        online,
        _shown(made.regression, chosen, online),
        excitation, estimation,
        _standing(estimation, metrics, None, np.arange(len(online.parameters)), system),
        by.fit() if source.recording else None,
        times, _never(times),
        note=online.note
        + (_held(samples, metrics) if levels.silent and not source.recording else ""),
    )


def _never(times: Mapping[str, float | None]) -> list[str]:
    return [name for name, since in times.items() if since is None]


def _shown(regression: SampledRegression, chosen: IntArray, online: Online) -> RegressionResult:
    """The regression at some of the samples, for the tables."""
    rows, p = regression.rows[1:][chosen], regression.p
    return RegressionResult(
        regression.t[chosen], rows[..., p], rows[..., :p], online.parameters, online.error_estimate
    )


def _held(samples: Sampling, metrics: Metrics) -> str:
    """What the hold has to do with estimates that did not get as close as 1 %."""
    if np.isfinite(metrics.seconds_to_1pct_states).any() or not np.isfinite(
        metrics.final_error_states
    ).any():
        return ""
    if samples.hold == "zoh":
        return (
            "; the error of signals that are held between samples falls with "
            "observer.sample_time, and faster with observer.hold=linear"
        )
    return "; the error of straight lines between samples falls with observer.sample_time squared"


def _standing(
    estimation: EstimationResult, metrics: Metrics, state_map: StateMap | None, columns: IntArray,
    system: DescriptorSystem,
) -> Metrics:
    """With the times from which on estimates are within ±2σ of what the final ones say.

    A state is compared with what the final parameters make of the same signals, whose noise is then
    in both.
    """
    t, eta = estimation.t, estimation.parameters
    if estimation.parameters_std is None or estimation.states_std is None:
        return metrics
    times = [standing_since(t, eta, eta[:, -1:], estimation.parameters_std[:, -1])]
    names: Sequence[str] = estimation.names
    if isinstance(state_map, AffineStateMap):
        away = np.nan_to_num(eta - eta[:, -1:])[..., columns]
        of_x = np.einsum("mnp,gmp->gmn", state_map.gain(t), away)
        times.append(standing_since(t, of_x, 0.0 * of_x[:, :1], estimation.states_std[:, -1]))
        names = [*names, *system.states]
    return replace(
        metrics, seconds_to_settled=dict(zip(names, np.hstack(times).T, strict=True))
    )


def _estimate(
    settings: Settings, system: DescriptorSystem, estimator: estimators.Estimator,
    observation: Observation, source: Source, known: Knowledge, seen: BoolArray, pace: Pace,
) -> tuple[estimators.Estimator, EstimationResult, Metrics]:
    """Run every case on the mesh and the samples that are kept; measure on both.

    The first result is the estimator with the gains that were used. What is not determined at the
    end is NaN. If the estimator is not the observer's own and has nothing to carry over resets, the
    parameters that others can stand for are left out.
    """
    regression, state_map = observation.regression, observation.state_map
    cases, t = estimator.cases, source.t
    kept = t[kept_samples(len(cases), len(t), settings.output.max_rows)]
    # Where nobody knows the truth there is nothing to measure between the samples that are kept;
    # and each time with bounds is a programme of its own.
    blind = source.recording is not None and not source.recording.known_states
    points = kept if observation.bounds or blind else regression.mesh.points.ravel()
    grid = np.unique(np.concatenate([points, state_map.times, kept]))
    chosen = np.searchsorted(grid, kept)

    x = source.states(grid)
    truth = observation.truth(grid, source.theta(grid), source.states)
    size, p, n = len(cases), truth.shape[1], x.shape[1]
    each = size <= _PER_QUANTITY
    determined = np.ones(p, dtype=bool)
    about_own = observation.names is None and observation.estimator is None

    def made(by: estimators.Estimator) -> tuple[estimators.Estimates, IntArray]:
        if about_own:
            return _estimates(by, observation, grid, known.independent)
        return estimators.estimate(by, regression, grid), np.arange(p)

    if about_own:
        determined = known.parameters[-1]
    else:
        seen = np.ones(n, dtype=bool)
    estimates, columns = made(estimator)
    if observation.estimator is None:
        raised = estimators.raised(estimator, estimates.requirement)
        if raised is not estimator:
            estimator, (estimates, columns) = raised, made(raised)
    requirement = estimates.requirement
    if observation.bounds:
        estimates = bounded(observation.bounds, system, observation, columns, estimates, grid)
    told = _told(determined), _told(seen)
    natural = _natural_sizes(regression, p)
    sizes = _sizes(truth, natural, x)
    evaluate = _evaluation(
        state_map, grid, truth * told[0], x * told[1], sizes, _judged(source, p), chosen,
        each=each,
    )
    parameters, estimated = np.empty((size, len(kept), p)), np.empty((size, len(kept), n))
    numbers = np.empty((len(METRICS) + each * (p + n), size))
    batch = max(1, _BATCH // (len(grid) * (2 * p + n)))
    done = pace(size, "cases")
    for first in range(0, size, batch):
        part = slice(first, min(first + batch, size))
        eta = estimates.parameters(part)
        if len(columns) < p:
            whole = np.zeros((*eta.shape[:2], p))
            whole[..., columns] = eta
            eta = whole
        found, parameters[part], estimated[part] = evaluate(eta)
        numbers[:, part] = found[: len(numbers)]
        done(part.stop)
    checks = state_map.checks(kept, estimated)
    explaining = parameters[:, -1].copy()
    parameters[..., np.isnan(told[0])] = np.nan
    estimated[..., np.isnan(told[1])] = np.nan
    result = EstimationResult(
        cases=estimator.cases,
        t=kept,
        names=observation.parameters,
        parameters=parameters,
        true_parameters=truth[chosen],
        states=estimated,
        delta=estimates.delta(kept),
        checks=checks,
        requirement=requirement,
        active=estimates.active if isinstance(estimates, BoundedEstimates) else {},
        explaining=explaining,
        still=_still(parameters, requirement, natural),
    )
    return estimator, result, _metrics(numbers, observation.parameters, system)


def _estimates(
    estimator: estimators.Estimator, observation: Observation, grid: Array, columns: IntArray
) -> tuple[estimators.Estimates, IntArray]:
    """The estimates of some of the parameters, and of which: all, where settings are one each."""
    reduced, columns = _reduced(observation, columns)
    try:
        return estimators.estimate(estimator, reduced.regression, grid), columns
    except ConfigError:
        if reduced is observation:
            raise
        # As many numbers in its settings as parameters.
        whole = observation.regression
        return estimators.estimate(estimator, whole, grid), np.arange(whole.p)


def _reduced(observation: Observation, columns: IntArray) -> tuple[Observation, IntArray]:
    """The observation about some of the parameters, the others being zero, and about which."""
    whole, state_map = observation.regression, observation.state_map
    plain = not whole.resets and whole.dynamics is None and observation.names is None
    if len(columns) in (0, whole.p) or not plain or not isinstance(state_map, AffineStateMap):
        return observation, np.arange(whole.p)
    regression = replace(
        whole, psi=Trajectory(whole.mesh, whole.psi.values[..., columns]),
        parameters=tuple(whole.parameters[j] for j in columns),
        factor=None if whole.factor is None else whole.factor[:, [*columns, whole.p]],
        scale=np.broadcast_to(whole.scale, (whole.mesh.size, whole.p))[:, columns],
    )
    gain = Trajectory(state_map.gain.mesh, state_map.gain.values[..., columns])
    return replace(
        observation, regression=regression, state_map=replace(state_map, gain=gain)
    ), columns


def _natural_sizes(regression: LinearRegression, p: int) -> Array:
    """√(∫Y²/∫ψ_j²) (p,): the size of a parameter that alone would explain Y; zeros for others."""
    energy = np.einsum("jj->j", regression.gram.final[:, : regression.p])
    if len(energy) != p:
        return np.zeros(p)
    square = Trajectory(regression.mesh, (regression.Y.values**2).sum(axis=-1)).integral().final
    return np.asarray(np.sqrt(np.divide(square, energy, out=np.zeros(p), where=energy > 0.0)))


def _still(parameters: Array, requirement: Requirement, natural: Array) -> BoolArray:
    """Which cases (G,) of η̂ (G, M, p) are where they began, for want of what is required.

    Noise did not move them either, and a deviation of zero would claim that nothing is uncertain.
    """
    if requirement.holds or not len(natural):
        return np.zeros(len(parameters), dtype=bool)
    return np.asarray(~(np.ptp(parameters, axis=1) > _STILL * natural).any(axis=1))


def _sizes(truth: Array, natural: Array, x: Array) -> tuple[Array, Array]:
    """Sizes of the parameters (p,) and states (n,): by these, errors of all kinds are compared."""
    with np.errstate(invalid="ignore"):
        of_eta, of_x = largest_over_time(truth), largest_over_time(x)
        for size, values in ((of_eta, truth), (of_x, x)):
            unknown = np.isnan(size)
            size[unknown] = np.fmax.reduce(np.abs(values[:, unknown]), axis=0)
        # A parameter that is zero has no size but that with which it would explain Y.
        return np.where(of_eta > _LEAST * natural, of_eta, np.fmax(of_eta, natural)), of_x


def _judged(source: Source, p: int) -> BoolArray:
    judged = np.zeros(p, dtype=bool)
    judged[source.judged] = True
    return judged


def _weights(sizes: Array, counted: BoolArray) -> Array:
    """1/size², and 0 for what does not count or has no size."""
    counted = counted & (sizes > 0.0)
    return np.divide(1.0, sizes**2, out=np.zeros(len(sizes)), where=counted)


def _told(determined: BoolArray) -> Array:
    """Factors (c,) that make NaN of what is not determined.

    Where nothing is, there is nothing to tell apart, and what an estimator does then is shown.
    """
    return np.where(determined | ~determined.any(), 1.0, np.nan)


def _numbers(
    t: Array, of_eta: Array, of_x: Array, sizes: tuple[Array, Array], judged: BoolArray
) -> Array:
    """What ``Metrics`` are made of, (5 + p + n, g), of errors (g, M, p) and (g, M, n)."""
    seen, known = judged & ~np.isnan(of_eta[0, -1]), ~np.isnan(of_x[0, -1])
    squares = [
        np.einsum("gmj,j->gm", error[..., some] ** 2, _weights(size, some)[some])
        for error, size, some in ((of_eta, sizes[0], seen), (of_x, sizes[1], known))
    ]
    times = [settling_times(t, of_eta, sizes[0]), settling_times(t, of_x, sizes[1])]
    times[0][:, ~judged] = np.nan
    of_all = _of_all(t, squares, of_eta[:, -1], of_x[:, -1], judged)
    return np.concatenate([of_all, times[0].T, times[1].T])


def _of_all(
    t: Array, squares: Sequence[Array], of_eta: Array, of_x: Array, judged: BoolArray,
    last: Array | None = None,
) -> Array:
    """The first five of them from squared norms (g, M) and errors at the end (g, p) and (g, n).

    ``last`` as in :func:`measure_squares`.
    """
    seen, known = judged & ~np.isnan(of_eta[0]), ~np.isnan(of_x[0])
    metrics = measure_squares(
        t, squares[0] if seen.any() or not judged.any() else None, of_eta[:, seen],
        squares[1] if known.any() else None, of_x[:, known], last,
    )
    return np.array([getattr(metrics, name) for name in METRICS])


def _metrics(numbers: Array, parameters: Sequence[str], system: DescriptorSystem) -> Metrics:
    """From (5, g), or (5 + p + n, g) with the time of each quantity."""
    names = [*parameters, *system.states]
    each = dict(zip(names, numbers[5:], strict=True)) if len(numbers) > len(METRICS) else {}
    return replace(Metrics(*numbers[: len(METRICS)]), seconds_to_1pct=each)


# η̂ (g, M, p) on the grid -> the numbers that ``Metrics`` are made of (c, g), and η̂ (g, k, p) and
# x̂ (g, k, n) at the samples that are kept
_Evaluation = Callable[[Array], tuple[Array, Array, Array]]


def _evaluation(
    state_map: StateMap, grid: Array, truth: Array, x: Array, sizes: tuple[Array, Array],
    judged: BoolArray, chosen: IntArray, *, each: bool,
) -> _Evaluation:
    """How a batch of cases is measured on the grid (M,) against η (M, p) and x (M, n)."""
    if not isinstance(state_map, AffineStateMap):
        reconstruct = state_map.at(grid)

        def evaluate(eta: Array) -> tuple[Array, Array, Array]:
            x_hat = reconstruct(eta)
            numbers = _numbers(grid, eta - truth, x_hat - x, sizes, judged)
            return numbers, eta[:, chosen], x_hat[:, chosen]

        return evaluate
    sampler = state_map.offset.mesh.sampler(grid)
    offset, gain = sampler(state_map.offset.values), sampler(state_map.gain.values)
    size, p = np.concatenate(sizes), truth.shape[1]
    offset_kept, gain_kept = offset[chosen], np.swapaxes(gain[chosen], 1, 2)

    def errors(eta: Array, at: IntArray) -> Array:
        """Of η̂ and x̂ (g, p + n) at one time for each quantity of each case, indices ``at``."""
        place = len(grid) * np.arange(len(eta))[:, None] + at  # in all cases, one after the other
        j, m, i = np.arange(p), at[:, p:], np.arange(at.shape[1] - p)
        of_eta = eta.ravel().take(place[:, :p] * p + j) - truth[at[:, :p], j]
        flat = eta.reshape(eta.shape[0] * eta.shape[1], p)  # spelled out: p may be 0
        gains = gain.reshape(len(gain) * len(i), p).take(m * len(i) + i, axis=0)
        seen = np.einsum("gip,gip->gi", gains, flat.take(place[:, p:], axis=0))
        return np.concatenate([of_eta, offset[m, i] + seen - x[m, i]], axis=1)

    def errors_at(eta: Array, k: int) -> list[Array]:
        """Of η̂ (g, p) and x̂ (g, n) at one time."""
        return [eta[:, k] - truth[k], offset[k] + eta[:, k] @ gain[k].T - x[k]]

    def evaluate_affine(eta: Array) -> tuple[Array, Array, Array]:
        """The norms, with x̂ only where it is needed: on the grid its errors are numbers."""
        eta = np.asarray(eta, dtype=np.float64)
        of_eta, of_x = errors_at(eta, -1)
        in_eta = _weights(sizes[0], judged & ~np.isnan(of_eta[0]))
        in_x = _weights(sizes[1], ~np.isnan(of_x[0]))
        level = None
        if each:
            level = levels(np.concatenate(errors_at(eta, 0), axis=1), size)
        *squares, last, of_norms = kernels.laws.squared_errors(
            eta, truth, in_eta, offset, gain, x, in_x, level, SETTLED**2
        )
        numbers = _of_all(grid, squares, of_eta, of_x, judged, of_norms)
        if level is not None:
            k = np.clip(last, 0, max(len(grid) - 2, 0)).astype(np.intp)
            after = np.minimum(k + 1, len(grid) - 1)
            times = settled(grid, last, np.abs(errors(eta, k)), np.abs(errors(eta, after)), level)
            times[np.isnan(np.hstack([of_eta, of_x]))] = np.nan
            times[:, :p][:, ~judged] = np.nan
            numbers = np.concatenate([numbers, times.T])
        kept = eta.take(chosen, axis=1)
        x_hat = np.empty((len(eta), *offset_kept.shape))  # a product per time serves all cases
        np.matmul(kept.swapaxes(0, 1), gain_kept, out=x_hat.swapaxes(0, 1))
        x_hat += offset_kept
        return numbers, kept, x_hat

    return evaluate_affine


def _fit(
    observation: Observation, estimation: EstimationResult, system: DescriptorSystem,
    source: Source,
) -> Fit | None:
    """Root mean squares over time of Y − ψη̂ with the final estimates, and of Y; the fitted ŷ."""
    regression = observation.regression
    final = estimation.explaining
    if final is None or estimation.names != regression.parameters:
        return None
    duration = float(regression.mesh.edges[-1] - regression.mesh.edges[0])

    def rms(eta: Array) -> float:
        return float(np.sqrt(regression.misfit(eta) / duration))

    fit = Fit(np.array([rms(eta) for eta in final]), rms(np.zeros(regression.p)))
    if regression.resets or regression.dynamics is not None:
        return fit
    return _explained(
        fit, final[fit.best], observation.state_map, system, source,
        every=regression.factor is None and not source.pieces,
    )


def _explained(
    fit: Fit, eta: Array, state_map: StateMap, system: DescriptorSystem, source: Source, *,
    every: bool,
) -> Fit:
    """With ŷ = C x̂ + D u + H θ̂ of the final estimates η̂ (p,), and how white y − ŷ is.

    That is looked at at ``every`` sample, or at the output times if x̂ is known there only.
    """
    t, recording = source.t, source.recording
    if recording is None or len(state_map.times):
        return fit

    def outputs(t: Array, own_t: Array, u: Array, y: Array) -> Array:
        x = state_map.at(t)(np.broadcast_to(eta, (1, len(t), len(eta))))[0]
        c = system.coefficients.taylor(own_t, 0, signals=np.hstack([u, y])[None])
        terms = (c.C, x), (c.D, u), (c.H, np.tile(eta[: system.q], (len(t), 1)))
        return np.asarray(sum(
            np.matmul(matrix[0], signal[..., None])[..., 0] for matrix, signal in terms
        ))

    u, y = recording.inputs, recording.outputs
    fitted = outputs(t, t if source.own_t is None else source.own_t, u, y)
    fit = replace(fit, outputs=fitted)
    samples = source.inputs.mesh.edges
    if every and len(samples) > len(t):
        u, y = source.inputs(samples), source.outputs(samples)
        t, fitted = samples, outputs(samples, samples, u, y)
    # Two samples apart: between samples the signals are interpolated and no noise is white.
    apart = 2.0 * (recording.last - recording.first) / max(recording.rows - 1, 1)
    step = float(t[-1] - t[0]) / (len(t) - 1)
    stride = 1 if t is samples else max(1, int(np.ceil(apart / step)))
    residual = (y - fitted)[::stride]
    residual = residual - residual.mean(axis=0)
    power = (residual**2).sum(axis=0)
    # What an output is used up for leaves rounding, which is no noise.
    count, seen = len(residual), power > _SILENT**2 * (y[::stride] ** 2).sum(axis=0)
    lags = range(1, min(_LAGS, count // 4) + 1)
    if not seen.any() or not lags:
        return fit
    correlation = np.array([
        ((residual[lag:] * residual[:-lag]).sum(axis=0)[seen] / power[seen]).mean() for lag in lags
    ])
    names = frozenset[str]().union(*system.coefficients.signals.values())
    return replace(
        fit, correlation=correlation, lag=stride * step,
        in_matrices=tuple(name for name in system.outputs if name in names),
        band=1.96 / np.sqrt(count * seen.sum()),
    )
