"""What any observer returns: a regression, and how its parameters give the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.regression import LinearRegression
from gpebo_cli.result import Assumption
from gpebo_cli.systems.descriptor import Array

# η̂ (g, M, p) at fixed times -> x̂ (g, M, n), NaN for a state the observer does not see
Reconstruction = Callable[[Array], Array]


class StateMap(Protocol):
    """From parameter estimates to state estimates."""

    @property
    def times(self) -> Array:
        """Times at which the map needs the estimates, besides those asked for; perhaps none."""
        ...

    def at(self, t: Array) -> Reconstruction:
        """The map at the times t (M,), ascending, ``times`` among them."""
        ...

    def checks(self, t: Array, states: Array) -> Mapping[str, Array]:
        """The same states by another way, by column name (g, M) each, from x̂ (g, M, n)."""
        ...


@dataclass(frozen=True, eq=False)
class AffineStateMap:
    """x = offset + gain η at every time."""

    offset: Trajectory  # (n,)
    gain: Trajectory  # (n, p)

    @property
    def times(self) -> Array:
        """None."""
        return np.zeros(0)

    def at(self, t: Array) -> Reconstruction:
        """Sample offset and gain once for all cases."""
        sampler = self.offset.mesh.sampler(t)
        offset, gain = sampler(self.offset.values), sampler(self.gain.values)

        def reconstruct(eta: Array) -> Array:
            return np.asarray(offset + np.matmul(gain, eta[..., None])[..., 0])

        return reconstruct

    def checks(self, t: Array, states: Array) -> Mapping[str, Array]:  # noqa: ARG002  protocol
        """None."""
        return {}


@dataclass(frozen=True, eq=False)
class Observation:
    """The observer's output."""

    regression: LinearRegression
    state_map: StateMap
    initial_basis: Array  # (n, n_a) V1, orthonormal basis of range P(start)
    xi_a0: Array  # (n_a,)
    error_estimate: float
    assumptions: tuple[Assumption, ...]  # of this observer, with their evidence
    growth: float  # largest ‖Φ(t)‖ entry

    def true_parameters(self, theta: Array, initial_state: Array) -> Array:
        """η = (θ, e₀) with e₀ = ξ_a0 − V1ᵀ P x(start) = ξ_a0 − V1ᵀ x(start), shape (p,)."""
        return np.concatenate([theta, self.xi_a0 - self.initial_basis.T @ initial_state])
