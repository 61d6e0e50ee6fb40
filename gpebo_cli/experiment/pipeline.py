"""One experiment from settings to result; the way of the data in one function.

system → simulate → signals → observer → regression → estimator → estimates → evidence, metrics
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from gpebo_cli import estimators, kernels
from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.evidence.excitation import WINDOWS, Excitation, assess, sampled_window_level
from gpebo_cli.evidence.metrics import SETTLED, Metrics, settling_time, time_rms
from gpebo_cli.experiment import sources
from gpebo_cli.experiment.assumptions import of_observation, warnings
from gpebo_cli.experiment.noise import noise_levels
from gpebo_cli.experiment.result import EstimationResult, Fit, RegressionResult, RunResult
from gpebo_cli.experiment.sampled import SampledRun
from gpebo_cli.experiment.seeds import check_seeds, over_seeds
from gpebo_cli.experiment.verdict import verdict
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import SMALL
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Observation, StateMap, check_remedy, observe, signal_noise
from gpebo_cli.observers.observation import AffineStateMap
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import Settings

_SAMPLES_AT_ONCE = 2048
_BATCH = 1 << 19  # numbers held at once while cases are evaluated: what fits the cache


@dataclass
class _Clock:
    """Seconds per stage; the only mutable thing in a run."""

    progress: Callable[[str], None]
    seconds: dict[str, float] = field(default_factory=dict)
    _since: float = field(default_factory=perf_counter)
    _stage: str = ""

    def stage(self, name: str) -> None:
        now = perf_counter()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._since, self._stage = now, name
        if name:
            self.progress(name)


def run_experiment(
    settings: Settings,
    system: DescriptorSystem,
    progress: Callable[[str], None] = lambda _stage: None,
    estimator: estimators.Estimator | None = None,
) -> RunResult:
    """Simulate the plant, observe it, estimate, and collect the evidence.

    Args:
        settings: what to do; ``settings.plant`` is not read, ``system`` is it.
        system: the plant.
        progress: called with the name of each stage as it starts.
        estimator: used instead of the one that ``settings.estimator`` names.

    Raises:
        ConfigError: settings that do not fit the plant.
        ModelError: the plant cannot be simulated, or Assumption 1 fails.
        SolverError: a tolerance cannot be reached.
    """
    recorded = settings.data.name == "csv"
    observed = settings.observer.name != "none"
    if recorded and not observed:
        raise ConfigError(
            "observer=none simulates the plant, and data=csv does not; choose one of them"
        )
    levels = noise_levels(settings.noise, system)
    sources.check_noise(settings, levels)
    if not recorded:
        sources.check_time(settings.time)
    clock = _Clock(progress)
    if not observed:
        estimator = None
    elif estimator is None:
        estimator = estimators.build(settings.estimator)
    check_seeds(settings.noise, levels, settings.observer)

    clock.stage("read" if recorded else "simulate")
    source = (
        sources.recorded(settings, system)
        if recorded
        else sources.simulated(settings, system, levels)
    )
    if estimator is None:
        clock.stage("")
        return RunResult(
            settings=settings, system=system, simulation=source.simulation, regression=None,
            excitation=None, estimation=None, metrics=None, assumptions=source.assumptions,
            timings=clock.seconds, verdict=source.verdict,
        )

    check_remedy(settings.observer)
    if settings.observer.sample_time is not None:
        return _run_at_samples(settings, system, source, estimator, clock)
    clock.stage("observe")
    t = source.t
    observation = observe(
        system, source.inputs, source.outputs, settings.observer, settings.solver,
        signal_noise(settings.noise, levels),
    )
    if observation.estimator is not None:
        # What the result is labelled with is what estimated.
        settings = replace(settings, estimator={"name": settings.observer.name})
    regression = observation.regression
    sampler = regression.mesh.sampler(t)
    sampled = RegressionResult(
        t=t,
        Y=sampler(regression.Y.values),
        psi=sampler(regression.psi.values),
        parameters=regression.parameters,
        error_estimate=observation.error_estimate,
    )
    clock.stage("excitation")
    excitation = assess(regression, t, settings.excitation)
    clock.stage("estimate")
    found = warnings(observation)
    try:
        estimation, metrics = _estimate(
            settings, observation.estimator or estimator, observation, source, t
        )
    except SolverError as error:
        raise SolverError("; ".join([str(error), *found])) from error
    noise = None
    if settings.noise.seeds > 1 and source.true is not None:
        clock.stage("seeds")
        truth = estimation.true_parameters[-1]
        noise = over_seeds(observation, source.true, estimator, truth, settings.noise, levels)
    fit = _fit(observation, estimation) if recorded else None
    clock.stage("")
    return RunResult(
        settings=settings, system=system, simulation=source.simulation, regression=sampled,
        excitation=excitation, estimation=estimation, metrics=metrics,
        assumptions=(*source.assumptions, *of_observation(observation, excitation)),
        timings=clock.seconds,
        verdict="; ".join([
            verdict(excitation, estimation, metrics, fit) + observation.note, *found
        ]),
        noise=noise,
        warnings=found,
        recording=source.recording,
        fit=fit,
    )


def _run_at_samples(
    settings: Settings, system: DescriptorSystem, source: sources.Source,
    estimator: estimators.Estimator, clock: _Clock,
) -> RunResult:
    """Observer and estimator at samples of the signals, ``observer.sample_time`` apart."""
    observer, edges = settings.observer, source.inputs.mesh.edges
    if observer.sample_time is None:
        raise ValueError("the observer runs in continuous time")
    clock.stage("observe and estimate")
    run = SampledRun(settings, system, observer.hold, float(edges[0]), estimator)
    t = sources.sample_times(observer.sample_time, float(edges[0]), float(edges[-1]))
    sampled_u, sampled_y = source.inputs(t), source.outputs(t)
    parts = [slice(i, i + _SAMPLES_AT_ONCE) for i in range(0, len(t), _SAMPLES_AT_ONCE)]
    made = [run.feed(t[part], sampled_u[part], sampled_y[part]) for part in parts]
    parameters = np.concatenate([part.parameters for part in made], axis=1)
    states = np.concatenate([part.states for part in made], axis=1)
    rows = np.concatenate([part.regression.rows[1:] for part in made])
    eigenvalues = np.concatenate([part.gram_eigenvalues for part in made])
    p = len(run.parameters)

    x = source.states(t)
    extension = np.concatenate([part.extension for part in made])
    truth = run.truth(extension)(t, source.theta(t), source.states)
    metrics = Metrics(*_measure(t, (parameters - truth)[..., source.judged], states - x))
    chosen = sources.kept_samples(1, len(t), settings.time.samples)
    kept = chosen[sources.kept_samples(len(run.cases), len(chosen), settings.output.max_rows)]
    deltas = [part.delta for part in made if part.delta is not None]
    estimation = EstimationResult(
        cases=run.cases,
        t=t[kept],
        names=run.parameters,
        parameters=parameters[:, kept],
        true_parameters=truth[kept],
        states=states[:, kept],
        delta=np.concatenate(deltas, axis=1)[:, kept] if deltas else None,
        checks={},
        requirement=run.requirement,
    )
    clock.stage("excitation")
    direction, smallest, largest = run.weakest_direction
    reached = np.flatnonzero(eigenvalues[:, 0] >= run.rho) if p else np.zeros(0, dtype=np.intp)
    window = settings.excitation.window or (t[-1] - t[0]) / WINDOWS
    regression = SampledRegression(
        t, np.diff(t, prepend=t[0]), np.concatenate([rows[:1], rows]), observer.hold
    )
    excitation = Excitation(
        t=t[chosen],
        gram_eigenvalues=eigenvalues[chosen],
        pe_level=sampled_window_level(regression, window)[chosen],
        window=window,
        is_ie=len(reached) > 0,
        t_c=float(t[reached[0]]) if len(reached) else None,
        rho=run.rho,
        lambda_min=smallest,
        condition=largest / smallest if smallest > 0 else float("inf"),
        weakest_direction=direction,
    )
    fit = run.fit(parameters[:, -1]) if source.recording is not None else None
    found = warnings(run)
    clock.stage("")
    return RunResult(
        settings=settings, system=system, simulation=source.simulation,
        regression=RegressionResult(
            t[chosen], rows[chosen, :, p], rows[chosen, :, :p], run.parameters, run.error_estimate
        ),
        excitation=excitation, estimation=estimation, metrics=metrics,
        assumptions=(*source.assumptions, *of_observation(run, excitation)),
        timings=clock.seconds,
        verdict="; ".join([verdict(excitation, estimation, metrics, fit), *found]),
        recording=source.recording,
        fit=fit,
        warnings=found,
    )


def _estimate(
    settings: Settings,
    estimator: estimators.Estimator,
    observation: Observation,
    source: sources.Source,
    t: Array,
) -> tuple[EstimationResult, Metrics]:
    """Run every case on the mesh and the samples that are kept; measure on both."""
    regression, state_map = observation.regression, observation.state_map
    cases = estimator.cases
    kept = t[sources.kept_samples(len(cases), len(t), settings.output.max_rows)]
    grid = _union(regression.mesh.points.ravel(), state_map.times, kept)
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


def _union(*times: Array) -> Array:
    """All of several sets of times, ascending, each once."""
    every = np.concatenate(times)
    every.sort()
    first = np.empty(len(every), dtype=bool)
    first[:1] = True
    np.not_equal(every[1:], every[:-1], out=first[1:])
    return every[first]


# η̂ (g, M, p) on the grid -> the five columns of ``cases.csv`` (5, g), and η̂ (g, k, p) and
# x̂ (g, k, n) at the samples that are kept
_Evaluation = Callable[[Array], tuple[Array, Array, Array]]


def _evaluation(
    state_map: StateMap, grid: Array, truth: Array, x: Array, judged: slice, chosen: IntArray
) -> _Evaluation:
    """How a batch of cases is measured on the grid (M,) against η (M, p) and x (M, n)."""
    large = max(truth.shape[1], x.shape[1]) > SMALL
    if kernels.compiled is None or large or not isinstance(state_map, AffineStateMap):
        reconstruct = state_map.at(grid)

        def evaluate(eta: Array) -> tuple[Array, Array, Array]:
            x_hat = reconstruct(eta)
            numbers = _measure(grid, (eta - truth)[..., judged], x_hat - x)
            return numbers, eta[:, chosen], x_hat[:, chosen]

        return evaluate

    measured, columns = kernels.compiled.measured, np.arange(truth.shape[1])[judged]
    sampler = state_map.offset.mesh.sampler(grid)
    offset, gain = sampler(state_map.offset.values), sampler(state_map.gain.values)

    def evaluate_affine(eta: Array) -> tuple[Array, Array, Array]:
        """The same in one pass over the estimates: x̂ is formed where it is needed."""
        found: tuple[Array, Array, Array] = measured(
            grid, np.asarray(eta, dtype=np.float64), truth, columns, offset, gain, x, chosen,
            SETTLED,
        )
        return found

    return evaluate_affine


def _measure(grid: Array, parameter_error: Array, state_error: Array) -> Array:
    """The five columns of ``cases.csv``, shape (5, g).

    Over what the observer sees and what is known of the truth; NaN where that is nothing.
    """
    out = np.full((5, len(parameter_error)), np.nan)
    known = ~np.isnan(parameter_error[0, -1])
    if known.any() or not known.size:
        norm = np.linalg.norm(parameter_error[..., known], axis=2)
        out[0] = settling_time(grid, norm)
        out[2] = np.abs(parameter_error[:, -1, known]).max(axis=1, initial=0.0)
    known = ~np.isnan(state_error[0, -1])
    if known.any():
        norm = np.linalg.norm(state_error[..., known], axis=2)
        out[1], out[4] = settling_time(grid, norm), time_rms(grid, norm)
        out[3] = np.abs(state_error[:, -1, known]).max(axis=1)
    return out


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
