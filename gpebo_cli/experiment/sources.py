"""Where signals come from: a simulation of the plant, with noise or without, or a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.assumptions import of_simulation
from gpebo_cli.experiment.noise import NoiseLevels, measure
from gpebo_cli.experiment.result import RecordingResult, SimulationResult, StateChange
from gpebo_cli.experiment.verdict import (
    columns_note,
    functions_note,
    pauses_note,
    rows_note,
    simulation_verdict,
)
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import SNAP, Trajectory
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.observers import Sampling, build, sampling
from gpebo_cli.recordings.hold import each_of, holds
from gpebo_cli.recordings.load import load
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression.text import simulation_of
from gpebo_cli.schema import LARGEST
from gpebo_cli.settings import Settings
from gpebo_cli.simulation.signals import Signals, Simulation

_MOVED = 1e-9  # changes of a state below this share of its size are rounding
_NEVER = 1e-6  # in the plant's units, of the largest state: a state that is smaller is nothing
_ROUNDING = 1e-12  # by which a sample may miss the end of the horizon
_RESOLVED = 1e-10  # of the start: shorter horizons have steps of few roundings
_MAX_SAMPLES = 1_000_000


@dataclass(frozen=True, eq=False)
class Source:
    """What the observer gets to see, and what is known about it."""

    t: Array  # (N,) the output grid
    levels: NoiseLevels  # of the noise, of a recording as far as they are given
    inputs: Trajectory  # (m,)
    outputs: Trajectory  # (r,)
    states: Trajectory  # (n,) the truth, NaN where nobody knows
    theta: Callable[[Array], Array]  # times (M,) -> (M, q), likewise
    assumptions: Callable[[], Sequence[Assumption]]  # of the plant, when they are asked for
    verdict: str = ""  # where nothing is estimated
    derivatives: InputDerivatives | None = None  # of the inputs, as far as they are known
    true: Signals | None = None  # of a simulation, without noise
    simulation: SimulationResult | None = None
    recording: RecordingResult | None = None
    rows: Rows | None = None  # of a recording
    samples: Array | None = None  # (N,) of one recording: the times of its rows with an output
    pieces: tuple[Source, ...] = ()  # several recordings, each with its own times and signals
    own_t: Array | None = None  # (N,) the plant's time on the output grid, where that is another

    @property
    def noisy(self) -> bool:
        """Whether there are errors in what the observer gets to see."""
        return self.recording is not None or not self.levels.silent


def simulated(
    settings: Settings, system: DescriptorSystem, levels: NoiseLevels, samples: Sampling | None
) -> Source:
    """Signals of the plant, for an observer at ``samples`` or in continuous time (ConfigError)."""
    start = settings.time.start
    t = _grid(settings, samples, start, start + settings.time.horizon)
    simulation = simulation_of(system, settings.time, settings.solver)
    measured = measure(simulation.signals, levels, settings.noise.seed)
    simulated = _sample_simulation(system, simulation, t)
    if not levels.silent:
        # Without noise of its own a signal keeps its bits; the finer mesh only adds rounding.
        noisy = (levels.outputs > 0) | (levels.steps > 0)
        simulated = replace(
            simulated,
            measured_inputs=np.where(levels.inputs > 0, measured.inputs(t), simulated.inputs),
            measured_outputs=np.where(noisy, measured.outputs(t), simulated.outputs),
        )
    if simulated.impulses and settings.observer["name"] != "none":
        when, state = simulated.impulses[0]
        raise ConfigError(
            f"plant {system.name}: the jump of the input at t = {when:.6g} puts an impulse into "
            f"{state}; an observer cannot be driven by it. Use a continuous input, or "
            "observer=none to simulate only"
        )
    return Source(
        t=t, levels=levels, inputs=measured.inputs, outputs=measured.outputs,
        states=_without_rounding(simulation), theta=system.theta_at,
        assumptions=partial(of_simulation, system, simulation),
        verdict=simulation_verdict(simulated) + functions_note(system, simulated),
        derivatives=InputDerivatives.of_plant(system, levels.inputs == 0),
        true=simulation.signals, simulation=simulated,
    )


def _without_rounding(simulation: Simulation) -> Trajectory:
    """The states that estimates are compared with; one that is nothing but rounding is zero.

    Constraints that hold a state at zero leave 1e-18 of it, and its error is no smaller. Where all
    states are as uncertain, rounding has grown, and none of them is zero.
    """
    states, errors = simulation.signals.states, simulation.state_errors
    if errors is None or (errors < 1.0).all():
        return states
    size = largest_over_time(states.values, 2)
    zero = (errors >= 1.0) & (size < _nothing(simulation, size))
    return replace(states, values=np.where(zero, 0.0, states.values))


def _nothing(simulation: Simulation, size: Array) -> Array:
    """Below what a state is nothing beside the others, whose largest values are size (n,)."""
    columns = simulation.structure.scaling.columns
    units = columns if len(columns) else np.ones(len(size))
    return np.asarray(_NEVER * units * (size / units).max(initial=0.0))


def recorded(
    settings: Settings, system: DescriptorSystem, levels: NoiseLevels, samples: Sampling | None
) -> Source:
    """Signals of a recording; nobody knows what θ was when it was made."""
    recording = load(system, settings.data, settings.time, settings.solver.tol)
    t, table = _grid(settings, samples, *recording.span), recording.table
    samples_t = table.samples.t
    return Source(
        t=t, levels=levels, inputs=recording.inputs, outputs=recording.outputs,
        states=recording.states, theta=lambda at: np.full((len(at), system.q), np.nan),
        assumptions=tuple, derivatives=recording.derivatives,
        rows=recording.rows, samples=samples_t[table.measured],
        recording=RecordingResult(
            **vars(recording.sampled(t)), file=table.header.source, sha256=table.sha256,
            rows=len(samples_t), hold=settings.data.hold,
            first=float(samples_t[0]), last=float(samples_t[-1]),
            known_states=tuple(system.states[i] for i in table.header.known),
            elements=recording.inputs.mesh.size, bounded=recording.bounded,
            note=columns_note(table.header.names[1 : 1 + system.m + system.r])
            + rows_note(table.left_out, table.filled, settings.data.missing)
            + pauses_note(recording.rows),
        ),
    )


def check(settings: Settings, levels: NoiseLevels) -> None:
    """Refuse what no source can give: noise on a recording, a span or a grid that is none, ….

    ConfigError: names the key and what it may be.
    """
    if settings.data.name == "csv":
        if settings.observer["name"] == "none":
            raise ConfigError(
                "observer=none simulates the plant, and data=csv does not; choose one of them"
            )
        _refuse_made_up(levels)
        return
    time, step, most = settings.time, settings.noise.sample_time, settings.solver.max_elements
    if not levels.silent and time.horizon / step > most:
        raise ConfigError(
            f"noise.sample_time = {step:g} s makes {time.horizon / step:.6g} samples over "
            f"{time.horizon:g} s, and each needs an element; solver.max_elements is {most}. "
            "Raise one of them"
        )
    if not time.horizon >= max(abs(time.start) * _RESOLVED, 1.0 / LARGEST):
        raise ConfigError(
            f"time.horizon = {time.horizon:g} s is too short to be resolved beside time.start = "
            f"{time.start:g}"
        )


def _refuse_made_up(levels: NoiseLevels) -> None:
    if levels.settings.seeds > 1 or levels.steps.any():
        raise ConfigError(
            "noise.seeds and noise.quantisation are for simulations; what is recorded or streamed "
            "has its own noise, of which noise.outputs and noise.inputs say how large it is"
        )


def check_stream(settings: Settings, system: DescriptorSystem, levels: NoiseLevels) -> None:
    """Refuse what would need later rows of a recording, whose rows come one after the other.

    ConfigError: names the key and what it may be.
    """
    _refuse_made_up(levels)
    if "cubic" in each_of(holds(settings.data.hold, system), 1):
        raise ConfigError(
            "data.hold=cubic needs to know the samples to come; a stream takes zoh or linear"
        )
    if sampling(build(settings.observer)) is not None:
        raise ConfigError(
            "observer.sample_time: the rows of a stream are the samples; leave it null"
        )
    if np.isfinite([settings.time.start, settings.time.horizon]).any():
        raise ConfigError(
            "a stream begins with its first row and ends with its last; leave time.start and "
            "time.horizon null"
        )


def _grid(settings: Settings, samples: Sampling | None, start: float, stop: float) -> Array:
    """The output grid (N,): evenly spaced; of an observer at samples, some of those."""
    if samples is None:
        return np.linspace(start, stop, settings.time.samples)
    t = sample_times(samples.step, start, stop)
    return np.asarray(t[kept_samples(1, len(t), settings.time.samples)])


def sample_times(step: float, start: float, stop: float) -> Array:
    """start, start + T, … up to stop, (K,) (ConfigError)."""
    rounding = SNAP * abs(stop)
    count = int(np.floor(((stop - start) * (1.0 + _ROUNDING) + rounding) / step))
    if count < 1:
        raise ConfigError(
            f"observer.sample_time = {step:g} is longer than the horizon of {stop - start:g} s"
        )
    if count > _MAX_SAMPLES:
        raise ConfigError(
            f"observer.sample_time = {step:g} makes {count} samples; at most {_MAX_SAMPLES} fit in "
            "one run"
        )
    return np.asarray(np.minimum(start + step * np.arange(count + 1), stop), dtype=np.float64)


def _sample_simulation(
    system: DescriptorSystem, simulation: Simulation, t: Array
) -> SimulationResult:
    signals, structure = simulation.signals, simulation.structure
    sampler = signals.mesh.sampler(t)
    start = float(signals.mesh.edges[0])
    size = largest_over_time(signals.states.values, 2)
    size = np.maximum(size, _nothing(simulation, size))
    jumps = [
        change
        for when, before, jump in simulation.jumps
        for change in _changes(system, before, jump.after, when, size)
    ]
    impulses = [
        (when, state)
        for when, _, jump in simulation.jumps
        for i, state in enumerate(system.states)
        if jump.impulses[:, i].any()
    ]
    return SimulationResult(
        t=t, inputs=sampler(signals.inputs.values), outputs=sampler(signals.outputs.values),
        states=sampler(signals.states.values), index=structure.index,
        strangeness_index=structure.mu, differential=structure.d, algebraic=structure.a,
        initial_state=simulation.initial_state,
        moved=tuple(_changes(system, system.initial_state, simulation.initial_state, start, size)),
        jumps=tuple(jumps), impulses=tuple(impulses),
        error_estimate=simulation.error_estimate, state_errors=simulation.state_errors,
        vague=tuple(compress(system.states, [] if simulation.vague is None else simulation.vague)),
        linear_solves=None if simulation.effort is None else simulation.effort.linear_solves,
        elements=signals.mesh.size, bounded=simulation.bounded,
    )


def _changes(
    system: DescriptorSystem, before: Array, after: Array, time: float, size: Array
) -> list[StateChange]:
    scale = _MOVED * np.maximum(size, np.abs(before))
    return [
        StateChange(state, old, new, time)
        for state, old, new, least in zip(
            system.states, before.tolist(), after.tolist(), scale.tolist(), strict=True
        )
        if abs(new - old) > least
    ]


def kept_samples(cases: int, samples: int, max_rows: int) -> IntArray:
    """Indices of the samples that are kept, evenly spread, first and last among them."""
    count = min(samples, max(2, max_rows // max(cases, 1)))
    return np.unique(np.rint(np.linspace(0, samples - 1, count)).astype(np.intp))
