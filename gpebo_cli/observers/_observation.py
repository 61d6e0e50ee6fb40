"""What any observer returns: a regression, and how its parameters give the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol, runtime_checkable

import numpy as np

from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.errors import ErrorsAt, ErrorSteps
from gpebo_cli.regression.estimator import Estimator
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.samples import SampledRegression

_LARGE = 32  # parameters, from which on gains are not sampled for one case

# η̂ (g, M, p) at fixed times -> x̂ (g, M, n), NaN for a state the observer does not see
Reconstruction = Callable[[Array], Array]


# Further errors of inputs (K, s + 1, m, c) and outputs (K, s + 1, r, c) at the points of the
# regression's mesh -> what they add to Y (K, s + 1, rows, c). Y is affine in the signals.
Response = Callable[[Array, Array], Array]


class StateMap(Protocol):
    """From parameter estimates to state estimates."""

    @property
    def times(self) -> Array:
        """Times at which the map needs the estimates, besides those asked for; by default none."""
        return np.zeros(0)

    def at(self, t: Array) -> Reconstruction:
        """The map at the times t (M,), ascending, ``times`` among them."""
        ...

    def checks(self, t: Array, states: Array) -> Mapping[str, Array]:  # noqa: ARG002
        """The same states by another way, by column name (g, M) each, from x̂ (g, M, n)."""
        return {}


@runtime_checkable
class Differentiable(StateMap, Protocol):
    """A map that tells what small errors of the estimates become."""

    def gains(self, t: Array, states: Array) -> Array:
        """∂x̂/∂η̂ at the times t (M,), where the estimates are x̂ (g, M, n): (g, M, n, p)."""
        ...


@runtime_checkable
class Filtering(StateMap, Protocol):
    """The map of an observer that estimates by itself and says how well."""

    def deviations(self, t: Array) -> tuple[Array, Array]:
        """Standard deviations at the times t (M,) of what is estimated (M, p) and of x̂ (M, n)."""
        ...


@dataclass(frozen=True, eq=False)
class AffineStateMap(StateMap):
    """x = offset + gain η at every time."""

    offset: Trajectory  # (n,)
    gain: Trajectory  # (n, p)
    units: Array | None = None  # (n,) of the states, in which rounding is of one size, if known

    def at(self, t: Array) -> Reconstruction:
        """Sample offset and gain at the times t (M,) once for all cases."""
        sampler = self.offset.mesh.sampler(t)
        offset = sampler(self.offset.values)
        gain = cache(lambda: sampler(self.gain.values))

        def reconstruct(eta: Array) -> Array:
            if len(eta) == 1 and self.large:
                return offset + sampler.products(self.gain.values, eta[0])[None]
            return np.asarray(offset + np.matmul(gain(), eta[..., None])[..., 0])

        return reconstruct

    @property
    def large(self) -> bool:
        """Whether gains are so large that for one case they should not be sampled."""
        return bool(self.gain.values.shape[3] >= _LARGE)

    def gains(self, t: Array, states: Array) -> Array:
        """The gain at the times t (M,) for every case of x̂ (g, M, n)."""
        gain = self.gain(t)
        return np.broadcast_to(gain, (len(states), *gain.shape))


class Truth(Protocol):
    """What the estimated parameters really are, for those who know the true signals."""

    def __call__(self, t: Array, theta: Array, states: Trajectory) -> Array:
        """η at the times t (M,), shape (M, p), from θ there (M, q) and the states (n,)."""
        ...


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
        return np.concatenate([theta, e0[np.searchsorted(times, t, side="right")]], axis=1)


def _is_constant(theta: Array) -> bool:
    """Whether θ (M, q) is the same at all times; of a broadcast array that is known at once."""
    return theta.strides[0] == 0 or not theta.size or not (theta[1:] != theta[:-1]).any()


def log_norm(Phi: Array) -> float:
    """ln ‖Φ‖₂ of a matrix (n, n_a); Φ = 0 counts as the smallest number there is."""
    sigma = np.linalg.svd(Phi, compute_uv=False)
    return float(np.log(max(sigma.max(initial=0.0 if Phi.size else 1.0), np.finfo(float).tiny)))


def largest_entry(values: Array) -> float:
    """Size of the largest entry of values (…, columns)."""
    return float(max(values.max(initial=0.0), -values.min(initial=0.0)))  # without a copy


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


# (η̂ (g, K, p), G (K, p, p)) -> x̂ (g, K, n) and ∂x̂/∂η̂ (g, K, n, p)
Fit = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class SampledBlock:
    """The regression at K samples, and how parameters give the state there."""

    regression: SampledRegression
    offset: Array  # (K, n)
    gain: Array  # (K, n, p) x = offset + gain η
    extension: Array  # (K, k, 1 + p) [ξ_a | ξ_b | Φ]
    scale: Array  # (K, p) of the terms of each column of ψ so far
    errors: ErrorSteps | None = None  # how errors of [u; y] become those of Y and of the offset
    units: Array | None = None  # (n,) as of ``AffineStateMap``
    fit: Fit | None = None  # where the state is not affine in η: instead of offset and gain

    def about(self, columns: IntArray) -> SampledBlock:
        """The same about some of the parameters (k,), the others being zero."""
        whole = self.regression
        rows = whole.rows[..., [*columns, whole.p]]
        return replace(
            self, regression=replace(whole, rows=rows), gain=self.gain[..., columns],
            scale=self.scale[:, columns],
        )
