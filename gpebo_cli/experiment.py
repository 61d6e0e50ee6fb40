"""One experiment from settings to result; the way of the data in one function.

system → simulate → signals → observer → regression → estimator → estimates → evidence, metrics
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from gpebo_cli import estimators
from gpebo_cli.assumptions import of_observation, of_simulation
from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.errors import ConfigError
from gpebo_cli.excitation import assess
from gpebo_cli.measurement import check_samples, measure, noise_levels
from gpebo_cli.metrics import settling_time, time_rms
from gpebo_cli.observers import Observation, observe, signal_noise
from gpebo_cli.realisations import check_seeds, over_seeds
from gpebo_cli.result import (
    EstimationResult,
    Excitation,
    Metrics,
    RegressionResult,
    RunResult,
    SimulationResult,
    StateChange,
)
from gpebo_cli.settings import Settings, TimeSettings
from gpebo_cli.simulation.simulate import Simulation, simulate
from gpebo_cli.systems.descriptor import Array, DescriptorSystem

_MOVED = 1e-9  # changes of a state below this share of the largest state are rounding
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
    _check_time(settings.time)
    clock = _Clock(progress)
    observed = settings.observer.name != "none"
    if not observed:
        estimator = None
    elif estimator is None:
        estimator = estimators.build(settings.estimator)
    levels = noise_levels(settings.noise, system)
    if not levels.silent:
        check_samples(
            settings.time.horizon, settings.noise.sample_time, settings.solver.max_elements
        )
    check_seeds(settings.noise, levels, settings.observer.name)

    clock.stage("simulate")
    t = np.linspace(
        settings.time.start, settings.time.start + settings.time.horizon, settings.time.samples
    )
    simulation = simulate(system, settings.time, settings.solver)
    signals = simulation.signals
    measured = measure(signals, settings.noise, levels)
    simulated = _sample_simulation(system, simulation, t)
    if not levels.silent:
        simulated = replace(
            simulated,
            # Without noise of its own a signal keeps its bits; the finer mesh only adds rounding.
            measured_inputs=np.where(levels.noisy_inputs, measured.inputs(t), simulated.inputs),
            measured_outputs=np.where(levels.noisy_outputs, measured.outputs(t), simulated.outputs),
        )
    if estimator is None:
        clock.stage("")
        return RunResult(
            settings=settings, system=system, simulation=simulated, regression=None,
            excitation=None, estimation=None, metrics=None,
            assumptions=tuple(of_simulation(system, simulation)), timings=clock.seconds,
            verdict=_simulation_verdict(simulated),
        )

    clock.stage("observe")
    _refuse_impulses(system, simulated)
    observation = observe(
        system, measured.inputs, measured.outputs, settings.observer, settings.solver,
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
        settings, observation.estimator or estimator, observation, system, signals.states, t
    )
    noise = None
    if settings.noise.seeds > 1:
        clock.stage("seeds")
        truth = estimation.true_parameters[-1]
        noise = over_seeds(observation, signals, estimator, truth, settings.noise, levels)
    clock.stage("")
    return RunResult(
        settings=settings, system=system, simulation=simulated, regression=sampled,
        excitation=excitation, estimation=estimation, metrics=metrics,
        assumptions=(
            *of_simulation(system, simulation), *of_observation(observation, excitation)
        ),
        timings=clock.seconds,
        verdict=_verdict(excitation, estimation, metrics) + observation.note,
        noise=noise,
    )


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
    system: DescriptorSystem,
    states: Trajectory,
    t: Array,
) -> tuple[EstimationResult, Metrics]:
    """Run every case on the mesh and the samples that are kept; measure on both."""
    regression, state_map = observation.regression, observation.state_map
    cases = estimator.cases
    kept = t[_kept_samples(len(cases), len(t), settings.output.max_rows)]
    grid = np.unique(np.concatenate([regression.mesh.points.ravel(), state_map.times, kept]))
    estimates = estimator.estimate(regression, grid)
    chosen = np.searchsorted(grid, kept)

    reconstruct = state_map.at(grid)
    x = states(grid)
    truth = observation.truth(grid, system.theta_at(grid), states)
    size, p, n = len(cases), truth.shape[1], x.shape[1]
    # Where θ varies e₀ makes up for it, and of what size it is says nothing: θ is what counts.
    judged = slice(system.q if system.theta_varies else p)
    parameters, estimated = np.empty((size, len(kept), p)), np.empty((size, len(kept), n))
    numbers = np.empty((5, size))
    batch = max(1, _BATCH // (len(grid) * (2 * p + n)))
    for first in range(0, size, batch):
        part = slice(first, min(first + batch, size))
        eta = estimates.parameters(part)
        x_hat = reconstruct(eta)
        parameters[part], estimated[part] = eta[:, chosen], x_hat[:, chosen]
        numbers[:, part] = _measure(grid, (eta - truth)[..., judged], x_hat - x)
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
    """The five columns of ``cases.csv``, shape (5, g), over the states the observer sees."""
    unseen = np.isnan(state_error[0, -1])
    if unseen.any():
        state_error = state_error[:, :, ~unseen]
    parameter_norm = np.sqrt(np.einsum("gmi,gmi->gm", parameter_error, parameter_error))
    state_norm = np.sqrt(np.einsum("gmi,gmi->gm", state_error, state_error))
    return np.array([
        settling_time(grid, parameter_norm),
        settling_time(grid, state_norm),
        np.abs(parameter_error[:, -1]).max(axis=1),
        np.abs(state_error[:, -1]).max(axis=1),
        time_rms(grid, state_norm),
    ])


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


def _verdict(excitation: Excitation, estimation: EstimationResult, metrics: Metrics) -> str:
    """The last line: exciting or not and from when on, and how well the state is known."""
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
    best = _best_case(metrics)
    label = _case_label(estimation.cases[best])
    seconds = metrics.seconds_to_1pct_states[best]
    reached = f"below 1 % after {seconds:.4g} s" if np.isfinite(seconds) else "never below 1 %"
    second = (
        f"state error {metrics.final_error_states[best]:.2g} at the end, {reached}"
        + (f" ({label})" if label else "")
    )
    line = f"{first}; {second}"
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
