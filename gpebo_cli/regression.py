"""The linear regression Y = ψ η: what an observer hands to any estimator (paper, eq. lre)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from gpebo_cli.collocation.mesh import Mesh, Trajectory
from gpebo_cli.result import Requirement
from gpebo_cli.systems.descriptor import Array


@dataclass(frozen=True, eq=False)
class LinearRegression:
    """Y (rows,) and ψ (rows, p) on one mesh, with the parameters' names.

    ``scale`` is the size of the terms ψ was formed from, before they cancelled: a regressor of
    1e-16 beside a scale of 1 is zero, whatever its eigenvalues say.

    Y may have a second axis, (rows, c): c realisations of its noise over one ψ, which noise does
    not reach. All estimators are affine in Y and carry the axis through to their estimates.
    """

    Y: Trajectory
    psi: Trajectory
    parameters: tuple[str, ...]
    scale: float

    @property
    def mesh(self) -> Mesh:
        """The mesh of all signals."""
        return self.psi.mesh

    @property
    def realisations(self) -> tuple[int, ...]:
        """(c,) if Y has that axis, else ()."""
        return self.Y.values.shape[3:]

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @cached_property
    def outer(self) -> Trajectory:
        """[ψᵀψ | ψᵀY], shape (p, p + c): everything an estimator needs of the regression."""
        return Trajectory(self.mesh, outer_products(self.psi.values, self.Y.values))

    @cached_property
    def gram(self) -> Trajectory:
        """[G | h] with G(t) = ∫ψᵀψ, h(t) = ∫ψᵀY from the start, shape (p, p + c)."""
        return self.outer.integral()


def outer_products(psi: Array, Y: Array) -> Array:
    """[ψᵀψ | ψᵀY] of shape (..., p, p + c) from ψ (..., rows, p) and Y (..., rows[, c])."""
    both = np.concatenate([psi, with_realisations(psi, Y)], axis=-1)
    return np.asarray(np.swapaxes(psi, -1, -2) @ both)


def with_realisations(psi: Array, Y: Array) -> Array:
    """Y (..., rows, c), with c = 1 where it has one realisation only."""
    return Y if Y.ndim == psi.ndim else Y[..., None]


@dataclass(frozen=True, eq=False)
class SampledRegression:
    """Y = ψη at K successive samples, with what the sample before them had.

    Integrals over a step between samples are taken as the hold rule has it: of the newest sample
    (zoh), or the mean of both ends (linear).
    """

    t: Array  # (K,)
    steps: Array  # (K,) seconds since the sample before; 0 for the first of all
    rows: Array  # (K + 1, rows, p + 1) [ψ | Y], first that of the sample before (the first: itself)
    hold: str  # zoh or linear

    @property
    def p(self) -> int:
        """Number of parameters."""
        return int(self.rows.shape[2]) - 1

    def weighted(self) -> Array:
        """Rows whose squares add up to ∫[ψ | Y]ᵀ[ψ | Y] over each step, (K, ·, p + 1)."""
        if self.hold == "zoh":
            return np.asarray(np.sqrt(self.steps)[:, None, None] * self.rows[1:])
        both = np.concatenate([self.rows[:-1], self.rows[1:]], axis=1)
        return np.asarray(np.sqrt(0.5 * self.steps)[:, None, None] * both)


class Estimates(Protocol):
    """The answer of one estimator on fixed times, for any of its cases."""

    def delta(self, t: Array) -> Array | None:
        """Δ at the times t (M,), shape (1 or cases, M), or None where nothing is mixed."""
        ...

    @property
    def requirement(self) -> Requirement:
        """What the estimator needs of the regressor, and what it got."""
        ...

    def parameters(self, cases: slice) -> Array:
        """η̂ of some cases at the times, shape (g, M, p), or (g, M, p, c) as Y has it."""
        ...


class Estimator(Protocol):
    """Settings of one estimator; immutable."""

    @property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """Every combination of gains, by name."""
        ...

    def estimate(self, regression: LinearRegression, t: Array) -> Estimates:
        """Prepare the estimates at the times t (M,), ascending.

        Raises:
            ConfigError: a setting's length does not match the parameters.
        """
        ...
