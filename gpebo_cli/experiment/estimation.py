"""Observer and estimator over a source, in continuous time or at samples."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from gpebo_cli import estimators, kernels
from gpebo_cli.errors import SolverError
from gpebo_cli.evidence.excitation import WINDOWS, Excitation, assess, sampled_window_level
from gpebo_cli.evidence.metrics import Metrics, measure, measure_squares
from gpebo_cli.experiment.assumptions import Observed, warnings
from gpebo_cli.experiment.noise import noise_levels, signal_noise
from gpebo_cli.experiment.online import Online, joined
from gpebo_cli.experiment.result import EstimationResult, Fit, NoiseStatistics, RegressionResult
from gpebo_cli.experiment.seeds import check_response, over_seeds
from gpebo_cli.experiment.sources import Source, kept_samples, sample_times
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Measurements, Observation, Observer, Sampling, StateMap
from gpebo_cli.observers._observation import AffineStateMap
from gpebo_cli.settings import Settings

_SAMPLES_AT_ONCE = 2048
_BATCH = 1 << 19  # numbers held at once while cases are evaluated: what fits the cache

# name of a stage of the run -> what measures it
Stage = Callable[[str], AbstractContextManager[None]]


@dataclass(frozen=True, eq=False)
class Estimated:
    """What observer and estimator made of a source."""

    observed: Observed
    regression: RegressionResult
    excitation: Excitation
    estimation: EstimationResult
    metrics: Metrics
    fit: Fit | None  # of a recording
    noise: NoiseStatistics | None = None
    by_observer: bool = False  # the observer estimates by itself
    note: str = ""  # what the last line of a run has to say of it, from "; " on


def continuous(
    settings: Settings, system: DescriptorSystem, source: Source, observer: Observer,
    estimator: estimators.Estimator, stage: Stage,
) -> Estimated:
    """Observer and estimator as differential equations.

    Raises:
        ConfigError: settings that do not fit the plant.
        ModelError: an assumption of the observer fails.
        SolverError: a tolerance cannot be reached.
    """
    levels = noise_levels(settings.noise, system)
    t = source.t
    with stage("observe"):
        seen = Measurements(
            source.inputs, source.outputs, signal_noise(settings.noise, levels)
        )
        observation = observer.observe(system, seen, settings.solver)
        check_response(settings.noise, observation.respond)
        regression = observation.regression
        sampler = regression.mesh.sampler(t)
        sampled = RegressionResult(
            t, sampler(regression.Y.values), sampler(regression.psi.values),
            regression.parameters, observation.error_estimate,
        )
    with stage("excitation"):
        excitation = assess(regression, t, settings.excitation, settings.solver.tol)
    with stage("estimate"):
        try:
            estimation, metrics = _estimate(
                settings, observation.estimator or estimator, observation, source
            )
        except SolverError as error:
            raise SolverError("; ".join([str(error), *warnings(observation)])) from error
    noise = None
    if settings.noise.seeds > 1 and source.true is not None:
        with stage("seeds"):
            truth = estimation.true_parameters[-1]
            noise = over_seeds(observation, source.true, estimator, truth, settings.noise, levels)
    return Estimated(
        observation, sampled, excitation, estimation, metrics,
        _fit(observation, estimation) if source.recording else None, noise,
        observation.estimator is not None, observation.note,
    )


def at_samples(
    settings: Settings, system: DescriptorSystem, source: Source, samples: Sampling,
    estimator: estimators.Estimator, stage: Stage,
) -> Estimated:
    """Observer and estimator at samples of the signals, ``samples.step`` apart.

    Raises:
        ConfigError: the observer or the estimator works in continuous time only.
        ModelError: an assumption of the observer fails.
        SolverError: a step between samples cannot be resolved.
    """
    check_response(settings.noise, None)
    start, stop = source.inputs.mesh.edges[[0, -1]].tolist()
    with stage("observe and estimate"):
        online = Online(settings, system, samples.hold, start, estimator)
        t = sample_times(samples.step, start, stop)
        u, y = source.inputs(t), source.outputs(t)
        parts = [slice(i, i + _SAMPLES_AT_ONCE) for i in range(0, len(t), _SAMPLES_AT_ONCE)]
        made = joined([online.feed(t[part], u[part], y[part]) for part in parts])
        truth = online.truth(made.extension)(t, source.theta(t), source.states)
        metrics = measure(
            t, (made.parameters - truth)[..., source.judged], made.states - source.states(t)
        )
    chosen = kept_samples(1, len(t), settings.time.samples)
    kept = chosen[kept_samples(len(online.cases), len(chosen), settings.output.max_rows)]
    estimation = EstimationResult(
        cases=online.cases,
        t=t[kept],
        names=online.parameters,
        parameters=made.parameters[:, kept],
        true_parameters=truth[kept],
        states=made.states[:, kept],
        delta=None if made.delta is None else made.delta[:, kept],
        checks={},
        requirement=online.requirement,
    )
    with stage("excitation"):
        window = settings.excitation.window or (t[-1] - t[0]) / WINDOWS
        level = sampled_window_level(made.regression, window)[chosen]
        excitation = online.excitation(made, chosen, level, window)
    rows, p = made.regression.rows[1:][chosen], len(online.parameters)
    return Estimated(
        online,
        RegressionResult(
            t[chosen], rows[..., p], rows[..., :p], online.parameters, online.error_estimate
        ),
        excitation, estimation, metrics,
        online.fit() if source.recording else None,
    )


def _estimate(
    settings: Settings, estimator: estimators.Estimator, observation: Observation, source: Source,
) -> tuple[EstimationResult, Metrics]:
    """Run every case on the mesh and the samples that are kept; measure on both."""
    regression, state_map = observation.regression, observation.state_map
    cases, t = estimator.cases, source.t
    kept = t[kept_samples(len(cases), len(t), settings.output.max_rows)]
    grid = np.unique(np.concatenate([regression.mesh.points.ravel(), state_map.times, kept]))
    estimates = estimators.estimate(estimator, regression, grid)
    chosen = np.searchsorted(grid, kept)

    x = source.states(grid)
    truth = observation.truth(grid, source.theta(grid), source.states)
    evaluate = _evaluation(state_map, grid, truth, x, source.judged, chosen)
    size, p, n = len(cases), truth.shape[1], x.shape[1]
    parameters, estimated = np.empty((size, len(kept), p)), np.empty((size, len(kept), n))
    numbers = np.empty((5, size))
    batch = max(1, _BATCH // (len(grid) * (2 * p + n)))
    for first in range(0, size, batch):
        part = slice(first, min(first + batch, size))
        numbers[:, part], parameters[part], estimated[part] = evaluate(estimates.parameters(part))
    result = EstimationResult(
        cases=cases,
        t=kept,
        names=observation.parameters,
        parameters=parameters,
        true_parameters=truth[chosen],
        states=estimated,
        delta=estimates.delta(kept),
        checks=state_map.checks(kept, estimated),
        requirement=estimates.requirement,
    )
    return result, Metrics(*numbers)


# η̂ (g, M, p) on the grid -> the five columns of ``cases.csv`` (5, g), and η̂ (g, k, p) and
# x̂ (g, k, n) at the samples that are kept
_Evaluation = Callable[[Array], tuple[Array, Array, Array]]


def _evaluation(
    state_map: StateMap, grid: Array, truth: Array, x: Array, judged: slice, chosen: IntArray
) -> _Evaluation:
    """How a batch of cases is measured on the grid (M,) against η (M, p) and x (M, n)."""
    reconstruct = state_map.at(grid)
    if not isinstance(state_map, AffineStateMap):
        def evaluate(eta: Array) -> tuple[Array, Array, Array]:
            x_hat = reconstruct(eta)
            metrics = measure(grid, (eta - truth)[..., judged], x_hat - x)
            return np.array(list(vars(metrics).values())), eta[:, chosen], x_hat[:, chosen]

        return evaluate

    sampler = state_map.offset.mesh.sampler(grid)
    offset, gain = sampler(state_map.offset.values), sampler(state_map.gain.values)
    in_eta = np.zeros(truth.shape[1], dtype=bool)
    in_eta[judged] = True

    def evaluate_affine(eta: Array) -> tuple[Array, Array, Array]:
        """The same, with x̂ only where it is needed: on the grid its errors are numbers."""
        eta = np.asarray(eta, dtype=np.float64)
        of_eta = eta[:, -1] - truth[-1]
        of_x = offset[-1] + eta[:, -1] @ gain[-1].T - x[-1]
        seen, known = in_eta & ~np.isnan(of_eta[0]), ~np.isnan(of_x[0])
        squares = kernels.laws.squared_errors(
            eta, truth, seen.astype(float), offset, gain, x, known.astype(float)
        )
        judges = seen.any() or not in_eta.any()
        metrics = measure_squares(
            grid, squares[0] if judges else None, of_eta[:, seen],
            squares[1] if known.any() else None, of_x[:, known],
        )
        x_hat = offset[chosen] + np.matmul(gain[chosen], eta[:, chosen, :, None])[..., 0]
        return np.array(list(vars(metrics).values())), eta[:, chosen], x_hat

    return evaluate_affine


def _fit(observation: Observation, estimation: EstimationResult) -> Fit | None:
    """Root mean squares over time of Y − ψη̂ with the final estimates, and of Y."""
    regression = observation.regression
    if estimation.names != regression.parameters:
        return None
    duration = float(regression.mesh.edges[-1] - regression.mesh.edges[0])

    def rms(signal: Array) -> float:
        square = Trajectory(regression.mesh, (signal**2).sum(axis=-1))
        return float(np.sqrt(max(float(square.integral().final), 0.0) / duration))

    Y, psi = regression.Y.values, regression.psi.values
    return Fit(np.array([rms(Y - psi @ eta[-1]) for eta in estimation.parameters]), rms(Y))
