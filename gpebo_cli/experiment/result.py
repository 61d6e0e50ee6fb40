"""What a run returns: sampled signals with their names, evidence, and how long each stage took.

These are plain frozen dataclasses over arrays, time first. The output layer turns them into
tables, figures and ``summary.json``; nothing in here knows about files, pandas or matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain

import numpy as np

from gpebo_cli.evidence.excitation import Excitation
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.findings import Assumption, OnDemand, Requirement, evaluated, replaced
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.model.plant import kind_of_name
from gpebo_cli.schema import instant
from gpebo_cli.settings import Settings

_OUTSIDE = 0.2  # share of correlations outside a band that white noise leaves with 5 % of them


@dataclass(frozen=True)
class ActiveBound:
    """A bound that holds an estimate at the end."""

    name: str  # of a state or an unknown
    value: float
    time: float | None  # at which the state is there; None: an unknown

    def __str__(self) -> str:
        when = "" if self.time is None else f" at t = {instant(self.time)}"
        return f"{self.name} = {self.value:g}{when}"

    def near(self, other: ActiveBound, distance: float) -> bool:
        """Whether it is the same bound at nearly the same time."""
        same = (self.name, self.value) == (other.name, other.value)
        return same and abs((self.time or 0.0) - (other.time or 0.0)) <= distance


@dataclass(frozen=True)
class StateChange:
    """A state that consistent initialisation (or a jump of the input) moved."""

    state: str
    given: float
    used: float
    time: float


@dataclass(frozen=True, kw_only=True)
class SignalsResult:
    """Signals on the output grid, wherever they are from."""

    t: Array  # (N,)
    inputs: Array  # (N, m)
    outputs: Array  # (N, r)
    states: Array  # (N, n), NaN for a state that was not recorded
    elements: int
    measured_inputs: Array | None = None  # (N, m) what the observer saw; None: the same
    measured_outputs: Array | None = None  # (N, r)
    bounded: bool = True  # known functions are, between the times at which they are evaluated


@dataclass(frozen=True, kw_only=True)
class RecordingResult(SignalsResult):
    """Those of a recording, and which file they are from."""

    file: str
    sha256: str
    rows: int
    hold: str | Mapping[str, str]  # as data.hold says it
    first: float  # times of its first and last sample
    last: float
    known_states: tuple[str, ...]
    note: str = ""  # what the last line of a run has to say of it, from "; " on


@dataclass(frozen=True, kw_only=True)
class SimulationResult(SignalsResult):
    """Those of a simulated plant, and how they were obtained."""

    index: int  # differentiation index: strangeness index + 1, or 0 for an explicit ODE
    strangeness_index: int
    differential: int  # d, number of differential equations
    algebraic: int  # a, number of constraints, hidden ones included
    initial_state: Array  # (n,) the consistent one
    moved: tuple[StateChange, ...]  # by consistent initialisation at the start
    jumps: tuple[StateChange, ...]  # at jumps of the inputs inside the horizon
    impulses: tuple[tuple[float, str], ...]  # (time, state) where a jump puts a Dirac impulse
    error_estimate: float  # relative to each state's own size, the largest
    state_errors: Array | None = None  # (n,) the estimate for each state, relative to its own size
    vague: tuple[str, ...] = ()  # states of which few digits are known
    linear_solves: float | None = None  # what Newton's method cost; None: the plant is linear


@dataclass(frozen=True)
class RegressionResult:
    """Y = psi eta on the output grid."""

    t: Array  # (N,)
    Y: Array  # (N, rows)
    psi: Array  # (N, rows, p)
    parameters: tuple[str, ...]  # p names: the plant's unknowns, then e0_<state>
    error_estimate: float


def told_apart(parameters: tuple[str, ...], system: DescriptorSystem) -> tuple[str, ...]:
    """The parameters, if no two of them, and no state, have the same name (ConfigError).

    Tables go by name. Several files have e0_x_2 of x, and of a state x_2; filters have w_x of x.
    """
    kinds = {"an estimated parameter": parameters, "a state": system.states, "an unknown": ()}
    kind_of_name(f"plant {system.name}", kinds)
    return parameters


@dataclass(frozen=True)
class EstimationResult:
    """Estimates of every case (a case is one combination of gains) on a grid of times."""

    cases: tuple[Mapping[str, float], ...]  # G combinations, gain name -> value
    t: Array  # (M,) perhaps coarser than the output grid when there are many cases
    names: tuple[str, ...]  # p names of what is estimated, mostly the regression's parameters
    parameters: Array  # (G, M, p)
    true_parameters: Array  # (M, p), NaN where nobody knows
    states: Array  # (G, M, n), NaN for a state the observer does not see
    checks: Mapping[str, Array]  # further estimates by column name, (G, M) each
    requirement: Requirement
    still: BoolArray  # (G,) cases that are where they began: it was not met at all
    # (D, M), D = 1 if it is the same for every case, else G; None: no mixing
    delta: OnDemand[Array | None] = OnDemand()
    parameters_std: Array | None = None  # (G, M, p) standard deviations; None: nobody knows
    states_std: Array | None = None  # (G, M, n)
    active: Mapping[int, tuple[ActiveBound, ...]] = field(default_factory=dict)  # bounds, by case
    explaining: Array | None = None  # (G, p) at the end; one value of many where not determined
    # How far final estimates of the best case may be off, relative to each one's size, by name;
    # and what spoils them though enough was there. None is known where η moves.
    doubts: OnDemand[tuple[Mapping[str, float], tuple[str, ...]]] = OnDemand(lambda: ({}, ()))

    __getstate__ = evaluated

    @property
    def warnings(self) -> tuple[str, ...]:
        """What spoils the estimates, one line each."""
        return self.doubts[1]

    def with_deviations(self, std: Array | None) -> EstimationResult:
        """The same with deviations (G, M, p + n); None: nobody knows."""
        of_eta, of_x = (None, None) if std is None else np.split(std, [len(self.names)], axis=2)
        return replaced(self, parameters_std=of_eta, states_std=of_x)

    @cached_property
    def gains(self) -> dict[str, Array]:
        """The gains of all cases (G,) by name, in order of first appearance; NaN: it has none."""
        names = dict.fromkeys(chain.from_iterable(self.cases))
        return {name: np.array([case.get(name, np.nan) for case in self.cases]) for name in names}


@dataclass(frozen=True)
class NoiseStatistics:
    """Errors of the estimates at the horizon over many seeds of the noise."""

    seeds: int
    t: float
    names: tuple[str, ...]  # (p,)
    truth: Array  # (p,)
    bias: Array  # (G, p) mean error
    deviation: Array  # (G, p) standard deviation, from the mean over the seeds
    rms: Array  # (G, p) root mean square error


def place_of_least(values: Array) -> int | None:
    """Place of the least finite value of (g,), None if there is none."""
    place = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    return place if np.isfinite(values[place]) else None


@dataclass(frozen=True)
class Fit:
    """How well the final estimates explain all data: what is known without the truth."""

    residual: Array  # (G,) root mean square over time of ‖Y − ψη̂(end)‖
    size: float  # the same of ‖Y‖
    least: float  # the same with least squares of the same data; NaN where η changes
    outputs: Array | None = None  # (N, r) ŷ of the best case at the times of the signals
    correlation: Array | None = None  # (lags,) of its residual at the samples, from lag 1 on
    slow: bool = False  # whether more of it than of white noise varies slowly
    follows: bool = False  # whether it depends on the inputs, which noise does not
    lag: float = np.nan  # seconds
    band: float = np.nan  # 95 % of the correlations of white noise are within
    far: Sequence[tuple[str, int, float]] = ()  # outputs, samples far from most, time of the first
    rounded: Sequence[tuple[str, float]] = ()  # outputs, and steps above what is left of them
    coarse: Sequence[str] = ()  # outputs that the hold may miss between rows by more than that
    least_white: bool = False  # whether that of weighed least squares is, where it is not
    of_inputs: tuple[str, ...] = ()  # inputs with noise, which the plant colours
    in_matrices: tuple[str, ...] = ()  # outputs, whose noise there is no error of Y
    fed_back: tuple[str, ...] = ()  # outputs, whose noise moves the observer's state
    ratio: float | None = None  # of the residual to what the sensors' noise makes of it, √χ²/dof

    @property
    def white(self) -> bool | None:
        """Whether the residual looks like white noise; None: it was not looked at."""
        if self.correlation is None:
            return None
        outside = np.abs(self.correlation) > self.band
        return bool(outside.mean() <= _OUTSIDE) and not (self.slow or self.follows)

    @property
    def best(self) -> int:
        """The case with the least residual."""
        return place_of_least(self.residual) or 0


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """Everything one run produced; the later stages are None when ``observer=none``.

    What is there for readers only is computed when it is first read. Signals are from a simulation
    or from a recording; the other one of the two is None.
    """

    settings: Settings
    system: DescriptorSystem
    simulation: SimulationResult | None = None
    recording: RecordingResult | None = None
    regression: RegressionResult | None = None
    excitation: Excitation | None = None
    estimation: EstimationResult | None = None
    metrics: Metrics | None = None
    timings: Mapping[str, float]  # stage -> seconds
    assumptions: OnDemand[tuple[Assumption, ...]] = OnDemand()
    verdict: OnDemand[str] = OnDemand()  # the last line a person reads
    noise: NoiseStatistics | None = None  # where more than one seed was asked for
    fit: Fit | None = None  # of a recording
    # From when on each parameter and state is determined by the data, None: never.
    estimable: OnDemand[Mapping[str, float | None]] = OnDemand(dict)
    left_out: tuple[str, ...] = ()  # states that the observer does not estimate
    # What does not stop a run and spoils its result, one line each.
    warnings: OnDemand[tuple[str, ...]] = OnDemand(tuple)

    __getstate__ = evaluated

    @property
    def signals(self) -> SignalsResult:
        """Inputs, outputs and what is known of the states, on the output grid.

        Raises:
            ValueError: the result has neither a simulation nor a recording.
        """
        signals = self.recording if self.simulation is None else self.simulation
        if signals is None:
            raise ValueError("a result needs a simulation or a recording")
        return signals
