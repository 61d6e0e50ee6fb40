"""What every observer is, and what it is given.

ξ_a(start) = V1 ξ_a0,    weights w of the outputs: √(w/max w) y = √(w/max w) C x
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from gpebo_cli.errors import ConfigError, check_memory
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, differential_order
from gpebo_cli.model.text import switching
from gpebo_cli.numerics.mesh import Mesh, Trajectory, aside
from gpebo_cli.observers._observation import Observation, SampledBlock, Truth
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.schema import per_name
from gpebo_cli.settings import SolverSettings

_HELD = 3  # arrays of every kind that are alive at once; measured

ByName = float | Sequence[float] | Mapping[str, float]


@dataclass(frozen=True, eq=False)
class SignalNoise:
    """What is known of the noise on the observer's signals."""

    inputs: Array  # (m,) standard deviation of every sample
    outputs: Array  # (r,)
    sample_time: float  # seconds, on the average
    cells: Array | None = None  # (K + 1,) of a recording: between them errors are of one sample

    @property
    def variances(self) -> Array:
        """Variances of (ν_u, ν_y) at any time, (m + r,)."""
        return np.concatenate([self.inputs, self.outputs]) ** 2


@dataclass(frozen=True, eq=False)
class Measurements:
    """What an observer gets to see."""

    inputs: Trajectory  # u (m,) and
    outputs: Trajectory  # y (r,), on the same mesh
    noise: SignalNoise | None = None  # for an observer that weighs by it; None: there is none
    derivatives: InputDerivatives | None = None  # of the inputs; None: they are not known
    wanted: Array | None = None  # (N,) times that results are for; None: all

    @property
    def mesh(self) -> Mesh:
        """The mesh on which both signals are given."""
        return self.inputs.mesh

    @property
    def span(self) -> tuple[float, float]:
        """First and last time, seconds."""
        return float(self.mesh.edges[0]), float(self.mesh.edges[-1])

    def at(
        self, t: Array, inside: Array | None = None, system: DescriptorSystem | None = None
    ) -> Array:
        """[u; y] at the times t (N,), shape (N, m + r).

        Where matrices of the ``system`` switch at t, signals are on their side of that.
        """
        there = t
        if inside is not None and system is not None and switching(system.coefficients):
            there = aside(t, inside)
        return np.concatenate([self.inputs(there, inside), self.outputs(there, inside)], axis=1)

    def check_memory(self, system: DescriptorSystem) -> None:
        """Refuse a recording whose samples make more than memory holds (ConfigError)."""
        if self.wanted is None:
            return
        start, stop = self.span
        p = system.q + differential_order(system, start)
        each = _HELD * (p + 1) * (system.n + p + system.m + system.r)
        check_memory(
            f"what is made of each of the recording's {self.mesh.size} samples",
            each * self.mesh.points.size,
            lambda share: f"time.horizon={share * (stop - start):.3g} fits, and observer=gpebo "
            "takes any number of rows as a stream (data.file=- < FILE)",
        )


class Observer(Protocol):
    """Settings of one observer; immutable."""

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """From measured signals to a regression, and a map from its parameters to the state.

        The true θ and initial state of ``system`` are not looked at.

        Raises:
            ModelError: an assumption of the observer fails; names the time and the evidence.
            ConfigError: settings that do not fit the plant.
            SolverError: the tolerance cannot be reached.
        """
        ...


class Sampling(NamedTuple):
    """An observer that runs at samples."""

    step: float  # seconds between them
    hold: str  # what it assumes of u and y in between: zoh or linear


class Reached(Protocol):
    """What a recursion remembers after its last sample."""

    @property
    def t(self) -> float:
        """The time of that sample."""
        ...

    @property
    def growth(self) -> float | None:
        """Largest entry of Φ so far; None where there is no Φ."""
        ...

    @property
    def error_estimate(self) -> float:
        """Error estimate of what is integrated between samples, so far."""
        ...


class Recursion(Protocol):
    """An observer from one sample to the next; immutable."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the regression's parameters, p of them."""
        ...

    def advance(
        self, state: Any, t: Array, u: Array, y: Array
    ) -> tuple[Reached, SampledBlock]:
        """Carry ``state`` (None before the first sample) over u (K, m), y (K, r) at t (K,)."""
        ...

    def assumptions(self, reached: Any) -> tuple[Assumption, ...]:
        """What was needed so far, with its evidence."""
        ...

    def truth(self, extension: Array) -> Truth:
        """What the parameters are, from [ξ_a | ξ_b | Φ] (K, k, 1 + p) at the times to be asked."""
        ...


@runtime_checkable
class Responding(Recursion, Protocol):
    """A recursion that can tell how errors of the signals become errors of Y and of the state."""

    def responding(self, noisy: BoolArray) -> Recursion:
        """The same with ``errors`` where those of the noisy ones of [u; y] (m + r,) are linear."""
        ...


@runtime_checkable
class AtSamples(Observer, Protocol):
    """An observer that can run at samples, as a controller does it."""

    def sampling(self) -> Sampling | None:
        """The samples at which it was asked to run; None if it runs in continuous time."""
        ...

    def at_samples(
        self, system: DescriptorSystem, solver: SolverSettings, hold: str, start: float,
        sample: Array, derivatives: InputDerivatives | None,
    ) -> Recursion:
        """The observer in discrete time, whose first sample [u; y] (m + r,) is at ``start``.

        ``derivatives`` of the inputs are for constraints that contain them; None: nobody knows any.
        """
        ...


def initial_extension(
    given: Mapping[str, float] | list[float] | None, system: DescriptorSystem,
    names: tuple[str, ...],
) -> Array:
    """ξ_a(start) in the coordinates of V1, shape (n_a,): ``observer.xi_a0``, the plant's, or 0.

    The setting is ``given``, ``names`` are those of e₀'s components.

    Raises:
        ConfigError: unknown state, or the wrong number of values.
    """
    where = "observer.xi_a0"
    if given is None:
        given = system.observer_defaults.get("xi_a0")  # type: ignore[assignment]
        where = f"plant {system.name}: observer_defaults.xi_a0"
    if given is None:
        return np.zeros(len(names))
    labels = [name.removeprefix("e0_") for name in names]
    return per_name(given, labels, "differential state", where, "finite", absent=0.0)


def output_scale(weights: ByName | None, system: DescriptorSystem) -> Array:
    """√(w/max w) of the weights w, shape (r,): exactly one for outputs that count equally.

    Raises:
        ConfigError: the wrong number of weights, an unknown output, or no positive one.
    """
    if weights is None:
        return np.ones(system.r)
    w = per_name(weights, system.outputs, "output", "observer.weights", absent=1.0)
    if not w.any():
        raise ConfigError("observer.weights: at least one output must have a positive weight")
    return np.asarray(np.sqrt(w / w.max()))
