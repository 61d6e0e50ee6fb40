"""What every observer is, what it is given, and what it returns.

ξ_a(start) = V1 ξ_a0,    weights w of the outputs: √(w/max w) y = √(w/max w) C x
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from gpebo_cli.errors import ConfigError, check_memory
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import (
    Array,
    BoolArray,
    DescriptorSystem,
    IntArray,
    differential_order,
)
from gpebo_cli.model.expressions.tape import on_their_side
from gpebo_cli.model.text import sided
from gpebo_cli.numerics.mesh import Mesh, Samples, Trajectory, beside_edges
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.recordings.hold import Hold
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression.errors import ErrorsAt, ErrorSteps
from gpebo_cli.regression.estimator import Estimator
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import per_name
from gpebo_cli.settings import SolverSettings

_HELD = 3  # arrays of every kind that are alive at once; measured
_KEPT, _BESIDE = 1.15, 30  # the same of windows, and numbers that deviations hold for a sample
_LARGE = 32  # parameters, from which on gains are not sampled for one case

T = TypeVar("T")
ByName = float | Sequence[float] | Mapping[str, float]

# η̂ (g, M, p) at fixed times -> x̂ (g, M, n), NaN for a state the observer does not see
Reconstruction = Callable[[Array], Array]

# Further errors of inputs (K, s + 1, m, c) and outputs (K, s + 1, r, c) at the points of the
# regression's mesh -> what they add to Y (K, s + 1, rows, c). Y is affine in the signals.
Response = Callable[[Array, Array], Array]


@dataclass(frozen=True, eq=False)
class SignalNoise:
    """What is known of the noise on the observer's signals."""

    inputs: Array  # (m,) standard deviation of every sample
    outputs: Array  # (r,)
    sample_time: float  # seconds, on the average
    rows: Rows | None = None  # of a recording

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
    # (M,) times at which the state map is asked for, if estimators go on from window to window;
    asked: Array | None = None  # None: any
    # Elements and points of the meshes of other recordings, whose results are kept as well, each
    beside: Sequence[tuple[int, int]] = ()  # with columns for its own start.
    like: Measurements | None = None  # the first recording, whose start decides on units; None: own

    @property
    def mesh(self) -> Mesh:
        """The mesh on which both signals are given."""
        return self.inputs.mesh

    @property
    def span(self) -> tuple[float, float]:
        """First and last time, seconds."""
        return self.mesh.span

    def at(
        self, t: Array, inside: Array | None = None, system: DescriptorSystem | None = None
    ) -> Array:
        """[u; y] at the times t (N,), shape (N, m + r).

        Where matrices of the ``system`` switch at t, signals are on their side of that.
        """
        def seen(t: Array, inside: Array | None) -> Array:
            return np.concatenate([self.inputs(t, inside), self.outputs(t, inside)], axis=1)

        arguments = None if system is None else sided(system.coefficients)
        return seen(on_their_side(arguments, t, inside, seen), inside)

    def check_memory(self, system: DescriptorSystem, times: float = 1.0, more: int = 0) -> None:
        """Refuse a recording whose samples make more than memory holds (ConfigError).

        An observer may hold so many ``times`` what a regression and a state map take, or so many
        ``more`` numbers at each point.
        """
        if self.wanted is None:
            return
        start, stop = self.span
        n, signals, rank = system.n, system.m + system.r, differential_order(system, start)
        p = system.q + rank
        elements, points = np.sum([(self.mesh.size, self.mesh.points.size), *self.beside], axis=0)
        numbers = times * _HELD * (p + 1) * (n + p + signals) * points
        if self.asked is not None and times == 1.0:
            # Y, ψ, the signals and what is more at all points, and the state map at samples; of
            # several recordings each one's and all together.
            widths = {p, p + rank * len(self.beside)}
            numbers = _KEPT * sum(
                points * ((n - rank + system.r) * (own + 1) + signals + 2 + more)
                + elements * ((n + 1) * (own + 2) + signals + _BESIDE) for own in widths
            )
        check_memory(
            f"what is made of each of the recording's {self.mesh.size} samples", numbers,
            lambda share: f"time.horizon={share * (stop - start):.3g} fits, and observer=gpebo "
            "takes any number of rows as a stream (data.file=- < FILE)",
        )


class StateMap(Protocol):
    """From parameter estimates to state estimates."""

    @property
    def times(self) -> Array:
        """Times at which the map needs the estimates, besides those asked for; by default none."""
        return np.zeros(0)

    def at(self, t: Array) -> Reconstruction:
        """The map at the times t (M,), ascending, ``times`` among them."""

    def checks(self, t: Array, states: Array) -> Mapping[str, Array]:  # noqa: ARG002
        """The same states by another way, by column name (g, M) each, from x̂ (g, M, n)."""
        return {}


@runtime_checkable
class Differentiable(StateMap, Protocol):
    """A map that tells what small errors of the estimates become."""

    def gains(self, t: Array, states: Array) -> Array:
        """∂x̂/∂η̂ at the times t (M,), where the estimates are x̂ (g, M, n): (g, M, n, p)."""


@runtime_checkable
class Filtering(StateMap, Protocol):
    """The map of an observer that estimates by itself and says how well."""

    def deviations(self, t: Array) -> tuple[Array, Array]:
        """Standard deviations at the times t (M,) of what is estimated (M, p) and of x̂ (M, n)."""


@dataclass(frozen=True, eq=False)
class AffineStateMap(StateMap):
    """x = offset + gain η at every time."""

    offset: Trajectory  # (n,)
    gain: Trajectory  # (n, p)
    units: Array | None = None  # (n,) of the states, in which rounding is of one size, if known

    def at(self, t: Array) -> Reconstruction:
        """Sample offset and gain at the times t (M,) once for all cases."""
        offset, gain = self.offset(t), cache(lambda: self.gain(t))

        def reconstruct(eta: Array) -> Array:
            if len(eta) == 1 and self.large:
                products = self.gain.mesh.sampler(t).products(self.gain.values, eta[0])
                return offset + products[None]
            return np.asarray(offset + np.matmul(gain(), eta[..., None])[..., 0])

        return reconstruct

    @property
    def large(self) -> bool:
        """Whether gains are so large that for one case they should not be sampled."""
        return self.gain.values.shape[3] >= _LARGE and not isinstance(self.gain, Samples)

    def gains(self, t: Array, states: Array) -> Array:
        """The gain at the times t (M,) for every case of x̂ (g, M, n)."""
        gain = self.gain(t)
        return np.broadcast_to(gain, (len(states), *gain.shape))


class Truth(Protocol):
    """What the estimated parameters really are, for those who know the true signals."""

    def __call__(self, t: Array, theta: Array, states: Trajectory) -> Array:
        """η at the times t (M,), shape (M, p), from θ there (M, q) and the states (n,)."""


@dataclass(frozen=True, eq=False)
class InitialError:
    """η = (θ, e₀) with e₀ = ξ_a0 − V1⁺P x(start).

    If θ varies, no constant e₀ makes w = ξ_a + ξ_b θ − Φ e₀ true, but this one does, and with it
    Y = ψη still holds at every time:

        e₀(t) = Φ⁺ (ξ_a + ξ_b θ(t) − w),      e₀' = Φ⁺ ξ_b θ'.

    Where the extension starts again later on, e₀ is that of the last start before a time.
    """

    initial_dual: Array  # (n_a, n) V1⁺P, V1 a basis of range P(start)
    xi_a0: Array  # (n_a,)
    dual: Array  # (k, n) that gives the coordinates of the extension, k = n_a or n
    extension: Callable[[Array], Array]  # times (M,) -> [ξ_a | ξ_b | Φ], (M, k, 1 + p)
    units: Array | None = None  # (k,) of those, in which P is an orthogonal projector; None: ones
    later: tuple[tuple[float, Array, Array], ...] = ()  # time, V1⁺P (n_a, n) and ξ_a0 (n_a,) there

    def __call__(self, t: Array, theta: Array, states: Trajectory) -> Array:
        """η at the times t (M,), shape (M, p)."""
        if not (_is_constant(theta) or np.isnan(theta).any()):
            W, z, q = self.extension(t), states(t) @ self.dual.T, theta.shape[1]
            if self.units is not None:
                W, z = W / self.units[:, None], z / self.units
            xi_a, xi_b, Phi = W[..., 0], W[..., 1 : 1 + q], W[..., 1 + q :]
            # Φᵀ z = Φᵀ w, because the columns of Φ lie in the range of the projector P.
            distance = xi_a + np.einsum("mij,mj->mi", xi_b, theta) - z
            e0 = np.einsum("mij,mj->mi", np.linalg.pinv(Phi, rcond=0.0), distance)
            return np.concatenate([theta, e0], axis=1)
        times = np.array([start[0] for start in self.later])
        starts = [(self.initial_dual, self.xi_a0), *(start[1:] for start in self.later)]
        x = [states.values[0, 0], *(states(times) if self.later else ())]
        # A state that nobody knows (NaN) does not spoil components it has no part in.
        e0 = np.array([
            xi_a0 - np.where(dual == 0.0, 0.0, dual * own).sum(axis=1)
            for (dual, xi_a0), own in zip(starts, x, strict=True)
        ])
        reached = np.searchsorted(times, beside_edges(t), side="right")
        return np.concatenate([theta, e0[reached]], axis=1)


def _is_constant(theta: Array) -> bool:
    """Whether θ (M, q) is the same at all times; of a broadcast array that is known at once."""
    return theta.strides[0] == 0 or not theta.size or not (theta[1:] != theta[:-1]).any()


def log_norm(Phi: Array) -> float:
    """ln ‖Φ‖₂ of a matrix (n, n_a); Φ = 0 counts as the smallest number there is."""
    sigma = np.linalg.svd(Phi, compute_uv=False)
    return float(np.log(max(sigma.max(initial=0.0 if Phi.size else 1.0), np.finfo(float).tiny)))


@dataclass(frozen=True, eq=False)
class Observation:
    """The observer's output.

    An observer that estimates by itself brings its own ``estimator``; the regression is then the
    evidence of excitation only. ``names`` are those of what is estimated, where that is not the
    regression's parameters.
    """

    regression: LinearRegression
    state_map: StateMap
    truth: Truth
    error_estimate: float
    assumptions: tuple[Assumption, ...]  # of this observer, with their evidence
    growth: float | None  # largest entry of Φ since its last reset; None: states do not rest on Φ
    estimator: Estimator | None = None
    names: tuple[str, ...] | None = None
    # Whose least squares say what the plant explains, where this observer estimates by itself.
    evidence: Observation | None = None
    drifts: bool = False  # its estimates are no constants that would explain all of the data
    respond: Response | None = None  # None: the observer cannot tell
    errors: ErrorsAt | None = None  # the same as a linear system; its outputs are δY, δoffset
    growth_rate: float | None = None  # 1/s, ln ‖Φ‖₂ over the horizon
    note: str = ""  # what the last line of a run has to say of it, from "; " on
    starts: Array | None = None  # (k,) of several experiments one after the other; None: of one
    bounds: Mapping[str, Mapping[str, Sequence[float | None]]] | None = None  # ``observer.bounds``
    unseen: tuple[str, ...] = ()  # states that the map leaves NaN, where it is not affine

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of what is estimated, (p,)."""
        return self.regression.parameters if self.names is None else self.names

    @property
    def of_constants(self) -> AffineStateMap | None:
        """The state map, where it is affine in constant parameters of one regression; else None."""
        regression, constant = self.regression, self.estimator is None and self.names is None
        constant &= not regression.resets and regression.dynamics is None
        return self.state_map if constant and isinstance(self.state_map, AffineStateMap) else None

    def about(
        self, columns: IntArray, make: Callable[[LinearRegression, IntArray], T]
    ) -> tuple[T, IntArray]:
        """What is made of the regression about some of its parameters, and which these are, (k,).

        The others are zero. They are all where settings have as many numbers as parameters.
        """
        whole = self.regression
        if 0 < len(columns) < whole.p and whole.leaves(columns):
            still = replace(self, regression=replace(whole, resets=(), dynamics=None))
            with suppress(ConfigError):
                if still.of_constants is not None:
                    return make(whole.about(columns), columns), columns
        every = np.arange(len(self.parameters))
        return make(whole, every), every


# (η̂ (g, K, p), G (K, p, p)) -> x̂ (g, K, n) and ∂x̂/∂η̂ (g, K, n, p)
Fit = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class SampledBlock:
    """The regression at K samples, and how parameters give the state there."""

    regression: SampledRegression
    offset: Array  # (K, n)
    gain: Array  # (K, n, p) x = offset + gain η
    extension: Array  # (K, k, 1 + p) [ξ_a | ξ_b | Φ]
    errors: ErrorSteps | None = None  # how errors of [u; y] become those of Y and of the offset
    units: Array | None = None  # (n,) as of ``AffineStateMap``
    fit: Fit | None = None  # where the state is not affine in η: instead of offset and gain


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


class Sampling(NamedTuple):
    """An observer that runs at samples."""

    step: float  # seconds between them
    hold: str  # what it assumes of u and y in between: zoh or linear


class Reached(Protocol):
    """What a recursion remembers after its last sample."""

    @property
    def t(self) -> float:
        """The time of that sample."""

    @property
    def growth(self) -> float | None:
        """Largest entry of Φ so far; None where there is no Φ."""

    @property
    def log_norm(self) -> float | None:
        """ln ‖Φ‖₂ at that sample; None where there is no Φ."""

    @property
    def error_estimate(self) -> float:
        """Error estimate of what is integrated between samples, so far."""


class Recursion(Protocol):
    """An observer from one sample to the next; immutable."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the regression's parameters, p of them."""

    def advance(
        self, state: Any, t: Array, u: Array, y: Array
    ) -> tuple[Reached, SampledBlock]:
        """Carry ``state`` (None before the first sample) over u (K, m), y (K, r) at t (K,)."""

    def assumptions(self, reached: Any) -> tuple[Assumption, ...]:
        """What was needed so far, with its evidence."""

    def truth(self, extension: Array) -> Truth:
        """What the parameters are, from [ξ_a | ξ_b | Φ] (K, k, 1 + p) at the times to be asked."""


@runtime_checkable
class Responding(Recursion, Protocol):
    """A recursion that can tell how errors of the signals become errors of Y and of the state."""

    def responding(self, noisy: BoolArray) -> Recursion:
        """The same with ``errors`` where those of the noisy ones of [u; y] (m + r,) are linear."""


@runtime_checkable
class AtSamples(Observer, Protocol):
    """An observer that can run at samples, as a controller does it."""

    def sampling(self) -> Sampling | None:
        """The samples at which it was asked to run; None if it runs in continuous time."""

    def at_samples(
        self, system: DescriptorSystem, solver: SolverSettings, hold: Hold, start: float,
        sample: Array, derivatives: InputDerivatives | None,
    ) -> Recursion:
        """The observer in discrete time, whose first sample [u; y] (m + r,) is at ``start``.

        ``derivatives`` of the inputs are for constraints that contain them; None: nobody knows any.
        """


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


def output_scale(weights: ByName | None, system: DescriptorSystem) -> Array | None:
    """√(w/max w) of the weights w, shape (r,); without weights None, each output in its own unit.

    Raises:
        ConfigError: the wrong number of weights, an unknown output, or no positive one.
    """
    if weights is None:
        return None
    w = per_name(weights, system.outputs, "output", "observer.weights", absent=1.0)
    if not w.any():
        raise ConfigError("observer.weights: at least one output must have a positive weight")
    return np.asarray(np.sqrt(w / w.max()))
