"""One experiment from settings to result; the way of the data in one function.

system → simulate → signals → observer → regression → estimator → estimates → evidence, metrics
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from gpebo_cli import estimators
from gpebo_cli.assumptions import of_observation, of_simulation, warnings
from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.errors import ConfigError
from gpebo_cli.excitation import WINDOWS, assess, sampled_window_level
from gpebo_cli.measurement import NoiseLevels, check_samples, measure, noise_levels
from gpebo_cli.metrics import settling_time, time_rms
from gpebo_cli.observers import Observation, check_remedy, observe, signal_noise
from gpebo_cli.realisations import check_seeds, over_seeds
from gpebo_cli.recordings.load import Recording, load
from gpebo_cli.regression import SampledRegression
from gpebo_cli.result import (
    Assumption,
    EstimationResult,
    Excitation,
    Fit,
    Metrics,
    RecordingResult,
    RegressionResult,
    RunResult,
    SimulationResult,
    StateChange,
)
from gpebo_cli.sampled import SampledRun
from gpebo_cli.settings import Settings, TimeSettings
from gpebo_cli.simulation.simulate import Signals, Simulation, simulate
from gpebo_cli.systems.descriptor import Array, DescriptorSystem

_MOVED = 1e-9  # changes of a state below this share of the largest state are rounding
_ROUNDING = 1e-12  # by which a sample may miss the end of the horizon
_MAX_SAMPLES = 1_000_000
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
    _check_noise(settings, levels)
    if not recorded:
        _check_time(settings.time)
    clock = _Clock(progress)
    if not observed:
        estimator = None
    elif estimator is None:
        estimator = estimators.build(settings.estimator)
    check_seeds(settings.noise, levels, settings.observer)

    clock.stage("read" if recorded else "simulate")
    source = _recorded(settings, system) if recorded else _simulated(settings, system, levels)
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
    estimation, metrics = _estimate(
        settings, observation.estimator or estimator, observation, source, t
    )
    noise = None
    if settings.noise.seeds > 1 and source.true is not None:
        clock.stage("seeds")
        truth = estimation.true_parameters[-1]
        noise = over_seeds(observation, source.true, estimator, truth, settings.noise, levels)
    fit = _fit(observation, estimation) if recorded else None
    found = warnings(observation)
    clock.stage("")
    return RunResult(
        settings=settings, system=system, simulation=source.simulation, regression=sampled,
        excitation=excitation, estimation=estimation, metrics=metrics,
        assumptions=(*source.assumptions, *of_observation(observation, excitation)),
        timings=clock.seconds,
        verdict="; ".join([
            _verdict(excitation, estimation, metrics, fit) + observation.note, *found
        ]),
        noise=noise,
        warnings=found,
        recording=source.recording,
        fit=fit,
    )


@dataclass(frozen=True, eq=False)
class _Source:
    """What the observer gets to see, and what is known about it."""

    t: Array  # (N,) the output grid
    inputs: Trajectory  # (m,)
    outputs: Trajectory  # (r,)
    states: Trajectory  # (n,) the truth, NaN where nobody knows
    theta: Callable[[Array], Array]  # times (M,) -> (M, q), likewise
    judged: slice  # parameters that count when estimates are compared with the truth
    assumptions: tuple[Assumption, ...]
    verdict: str
    true: Signals | None = None  # of a simulation, without noise
    simulation: SimulationResult | None = None
    recording: RecordingResult | None = None


def _grid(settings: Settings, start: float, stop: float) -> Array:
    """The output grid (N,): evenly spaced; of an observer at samples, some of those."""
    if settings.observer.sample_time is None:
        return np.linspace(start, stop, settings.time.samples)
    t = _sample_times(settings.observer.sample_time, start, stop)
    kept: Array = t[_kept_samples(1, len(t), settings.time.samples)]
    return kept


def _sample_times(step: float, start: float, stop: float) -> Array:
    """start, start + T, … up to stop, (K,)."""
    count = int(np.floor((stop - start) / step * (1.0 + _ROUNDING)))
    if count < 1:
        raise ConfigError(
            f"observer.sample_time = {step:g} is longer than the horizon of {stop - start:g} s"
        )
    if count > _MAX_SAMPLES:
        raise ConfigError(
            f"observer.sample_time = {step:g} makes {count} samples; at most {_MAX_SAMPLES} fit in "
            "one run"
        )
    return np.asarray(start + step * np.arange(count + 1), dtype=np.float64)


def _simulated(settings: Settings, system: DescriptorSystem, levels: NoiseLevels) -> _Source:
    """Signals of the plant."""
    t = _grid(settings, settings.time.start, settings.time.start + settings.time.horizon)
    simulation = simulate(system, settings.time, settings.solver)
    measured = measure(simulation.signals, settings.noise, levels)
    simulated = _sample_simulation(system, simulation, t)
    if not levels.silent:
        simulated = replace(
            simulated,
            # Without noise of its own a signal keeps its bits; the finer mesh only adds rounding.
            measured_inputs=np.where(levels.noisy_inputs, measured.inputs(t), simulated.inputs),
            measured_outputs=np.where(levels.noisy_outputs, measured.outputs(t), simulated.outputs),
        )
    if settings.observer.name != "none":
        _refuse_impulses(system, simulated)
    return _Source(
        t=t, inputs=measured.inputs, outputs=measured.outputs, states=simulation.signals.states,
        theta=system.theta_at, judged=_judged(system),
        assumptions=tuple(of_simulation(system, simulation)),
        verdict=_simulation_verdict(simulated), true=simulation.signals, simulation=simulated,
    )


def _judged(system: DescriptorSystem) -> slice:
    """Where θ varies e₀ makes up for it, and of what size it is says nothing: θ is what counts."""
    return slice(system.q if system.theta_varies else None)


def _recorded(settings: Settings, system: DescriptorSystem) -> _Source:
    """Signals of a recording; nobody knows what θ was when it was made."""
    recording = load(system, settings.data, settings.time, settings.solver.tol)
    t = _grid(settings, *recording.span)
    return _Source(
        t=t, inputs=recording.inputs, outputs=recording.outputs, states=recording.states,
        theta=lambda at: np.full((len(at), system.q), np.nan), judged=_judged(system),
        assumptions=(), verdict="",
        recording=_sample_recording(system, recording, t),
    )


def _sample_recording(
    system: DescriptorSystem, recording: Recording, t: Array
) -> RecordingResult:
    table, sampled = recording.table, recording.sampled(t)
    return RecordingResult(
        t=t,
        inputs=sampled.inputs,
        outputs=sampled.outputs,
        states=sampled.states,
        file=table.header.source,
        sha256=table.sha256,
        rows=len(table.samples.t),
        hold=recording.hold,
        first=float(table.samples.t[0]),
        last=float(table.samples.t[-1]),
        known_states=tuple(system.states[i] for i in table.header.known),
        elements=recording.inputs.mesh.size,
    )


def _run_at_samples(
    settings: Settings, system: DescriptorSystem, source: _Source,
    estimator: estimators.Estimator, clock: _Clock,
) -> RunResult:
    """Observer and estimator at samples of the signals, ``observer.sample_time`` apart."""
    observer, edges = settings.observer, source.inputs.mesh.edges
    if observer.sample_time is None:
        raise ValueError("the observer runs in continuous time")
    clock.stage("observe and estimate")
    run = SampledRun(settings, system, observer.hold, float(edges[0]), estimator)
    t = _sample_times(observer.sample_time, float(edges[0]), float(edges[-1]))
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
    chosen = _kept_samples(1, len(t), settings.time.samples)
    kept = chosen[_kept_samples(len(run.cases), len(chosen), settings.output.max_rows)]
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
        verdict="; ".join([_verdict(excitation, estimation, metrics, fit), *found]),
        recording=source.recording,
        fit=fit,
        warnings=found,
    )


def _check_noise(settings: Settings, levels: NoiseLevels) -> None:
    if levels.silent:
        return
    if settings.data.name == "csv":
        raise ConfigError("noise is for simulations; a recording (data=csv) has its own")
    check_samples(settings.time.horizon, settings.noise.sample_time, settings.solver.max_elements)


def _check_time(time: TimeSettings) -> None:
    if not (np.isfinite(time.horizon) and time.horizon > 0):
        raise ConfigError(f"time.horizon must be a positive number of seconds, got {time.horizon}")
    if not np.isfinite(time.start):
        raise ConfigError(f"time.start must be a finite time, got {time.start}")
    if time.samples < 2:
        raise ConfigError(f"time.samples must be at least 2, got {time.samples}")


def _sample_simulation(
    system: DescriptorSystem, simulation: Simulation, t: Array
) -> SimulationResult:
    signals, structure = simulation.signals, simulation.structure
    sampler = signals.mesh.sampler(t)
    start = float(signals.mesh.edges[0])
    jumps = [
        change
        for when, before, jump in simulation.jumps
        for change in _changes(system, before, jump.after, when)
    ]
    impulses = [
        (when, state)
        for when, _, jump in simulation.jumps
        for i, state in enumerate(system.states)
        if jump.impulses[:, i].any()
    ]
    return SimulationResult(
        t=t,
        inputs=sampler(signals.inputs.values),
        outputs=sampler(signals.outputs.values),
        states=sampler(signals.states.values),
        index=structure.index,
        strangeness_index=structure.mu,
        differential=structure.d,
        algebraic=structure.a,
        initial_state=simulation.initial_state,
        moved=tuple(_changes(system, system.initial_state, simulation.initial_state, start)),
        jumps=tuple(jumps),
        impulses=tuple(impulses),
        error_estimate=simulation.error_estimate,
        elements=signals.mesh.size,
    )


def _changes(
    system: DescriptorSystem, before: Array, after: Array, time: float
) -> list[StateChange]:
    scale = max(float(np.abs(before).max(initial=0.0)), float(np.abs(after).max(initial=0.0)))
    return [
        StateChange(state, float(old), float(new), time)
        for state, old, new in zip(system.states, before, after, strict=True)
        if abs(new - old) > _MOVED * scale
    ]


def _refuse_impulses(system: DescriptorSystem, simulated: SimulationResult) -> None:
    if simulated.impulses:
        t, state = simulated.impulses[0]
        raise ConfigError(
            f"plant {system.name}: the jump of the input at t = {t:.6g} puts an impulse into "
            f"{state}; an observer cannot be driven by it. Use a continuous input, or "
            "observer=none to simulate only"
        )


def _estimate(
    settings: Settings,
    estimator: estimators.Estimator,
    observation: Observation,
    source: _Source,
    t: Array,
) -> tuple[EstimationResult, Metrics]:
    """Run every case on the mesh and the samples that are kept; measure on both."""
    regression, state_map = observation.regression, observation.state_map
    cases = estimator.cases
    kept = t[_kept_samples(len(cases), len(t), settings.output.max_rows)]
    grid = np.unique(np.concatenate([regression.mesh.points.ravel(), state_map.times, kept]))
    estimates = estimators.estimate(estimator, regression, grid)
    chosen = np.searchsorted(grid, kept)

    reconstruct = state_map.at(grid)
    x = source.states(grid)
    truth = observation.truth(grid, source.theta(grid), source.states)
    size, p, n = len(cases), truth.shape[1], x.shape[1]
    parameters, estimated = np.empty((size, len(kept), p)), np.empty((size, len(kept), n))
    numbers = np.empty((5, size))
    batch = max(1, _BATCH // (len(grid) * (2 * p + n)))
    for first in range(0, size, batch):
        part = slice(first, min(first + batch, size))
        eta = estimates.parameters(part)
        x_hat = reconstruct(eta)
        parameters[part], estimated[part] = eta[:, chosen], x_hat[:, chosen]
        numbers[:, part] = _measure(grid, (eta - truth)[..., source.judged], x_hat - x)
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


def _kept_samples(cases: int, samples: int, max_rows: int) -> Array:
    """Indices of the samples that are kept, evenly spread, first and last among them."""
    count = min(samples, max(2, max_rows // max(cases, 1)))
    return np.unique(np.rint(np.linspace(0, samples - 1, count)).astype(np.intp))


def _simulation_verdict(simulated: SimulationResult) -> str:
    return (
        f"simulated: index {simulated.index}, {simulated.differential} differential and "
        f"{simulated.algebraic} algebraic equations, error estimate "
        f"{simulated.error_estimate:.1e} of each state's size"
    )


def _verdict(
    excitation: Excitation, estimation: EstimationResult, metrics: Metrics, fit: Fit | None = None
) -> str:
    """The last line: exciting or not and from when on, and how well the state is known.

    Without true states: how well the estimates explain the data.
    """
    if excitation.is_ie:
        first = (
            f"interval-exciting from t = {excitation.t_c:.4g} s on "
            f"(λ_min(G) = {excitation.lambda_min:.3g} at the end, ρ = {excitation.rho:.2g})"
        )
    else:
        first = (
            f"NOT interval-exciting: λ_min(G) = {excitation.lambda_min:.3g} < ρ = "
            f"{excitation.rho:.2g}; not excited: {excitation.weakest_direction}"
        )
    parts = [first]
    if np.isfinite(metrics.final_error_states).any():
        best = _best_case(metrics)
        seconds = metrics.seconds_to_1pct_states[best]
        reached = f"below 1 % after {seconds:.4g} s" if np.isfinite(seconds) else "never below 1 %"
        parts.append(f"state error {metrics.final_error_states[best]:.2g} at the end, {reached}")
    elif fit is not None:
        best = int(np.argmin(np.where(np.isfinite(fit.residual), fit.residual, np.inf)))
    else:
        best = 0
    if fit is not None:
        parts.append(
            f"|Y − ψη̂| with the final estimates is {fit.residual[best]:.2g}, |Y| is "
            f"{fit.size:.2g} (root mean squares)"
        )
    label = _case_label(estimation.cases[best])
    line = "; ".join(parts) + (f" ({label})" if label else "")
    if not estimation.requirement.holds:
        line += f"; {estimation.requirement.name} not met: {estimation.requirement.text}"
    return line


def _best_case(metrics: Metrics) -> int:
    """The first case below 1 % for good; if there is none, the one with the least final error.

    By the final error alone, cases that have all converged would be told apart by rounding.
    """
    seconds, final = metrics.seconds_to_1pct_states, metrics.final_error_states
    if np.isfinite(seconds).any():
        return int(np.nanargmin(seconds))
    return int(np.argmin(np.where(np.isfinite(final), final, np.inf)))


def _case_label(case: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in case.items())
