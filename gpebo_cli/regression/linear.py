"""The linear regression Y = ψ η: what an observer hands to any estimator (paper, eq. lre)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.regression.dynamics import Dynamics, filtered

_SINGULAR = 1e-14  # share of the largest singular value below which one is rounding
_SYMMETRIC = 1e-8  # below this share of Ω, what is not symmetric is rounding
SMALL_SPECTRUM = 16  # size of symmetric matrices, up to which LAPACK's calls cost more than it does
_FEW_COLUMNS = 32  # of a product, up to which BLAS costs more than what there is to add up
SURPLUS = 1e4  # integrals: what is known may outweigh what one segment teaches by this factor


@dataclass(frozen=True, eq=False)
class Reset:
    """From ``time`` on the regression is about η₊ = T η + τ (observer.remedy: reset)."""

    time: float
    transform: Array  # (p, p) T, invertible
    shift: Array  # (p,) τ
    floor: float  # size below which η₊ is rounding: it may be the difference of known numbers
    keep: float = 1.0  # share of what is known that still counts

    def parameters(self, eta: Array) -> Array:
        """η₊ of η (..., p)."""
        return np.asarray(eta @ self.transform.T + self.shift)


@dataclass(frozen=True, eq=False)
class ExtensionState:
    """What is known of η at one time: Ω η = 𝒴, and how much of it is new."""

    values: Array  # [Ω | 𝒴] (p, p + 1)
    level: float  # size that data of one segment alone have given Ω, the largest so far
    memory: float = 1.0  # z of least squares with forgetting
    surplus: float = SURPLUS  # how many times ``level`` a reset may make of Ω

    def after(self, reset: Reset) -> ExtensionState:
        """The same knowledge of η₊ = T η + τ.

        S Ω T⁻¹ η₊ = S (𝒴 + Ω T⁻¹ τ) holds for any S. S = T⁻ᵀ, Ω₊ = T⁻ᵀ Ω T⁻¹, keeps a Gram matrix
        one. Directions that T shrinks are those in which η₊ is known the better, without bound.
        What exceeds ``surplus`` times that which a segment's data amount to is cut down to it by
        a row of S: float64 holds 16 digits, and those of the other directions are needed. It is
        1e4 for integrals, which add up over segments, and 1 for filters, which do not.

        With Ω = KᵀL, equal factors for a Gram matrix, the columns of L T⁻¹ are of very different
        sizes; QR with the largest first keeps them apart, and a row of R is cut as a whole.
        """
        omega, rhs = self.values[:, :-1], self.values[:, -1]
        symmetric = bool(np.abs(omega - omega.T).max() <= _SYMMETRIC * np.abs(omega).max())
        u, size, vt = np.linalg.svd(0.5 * (omega + omega.T) if symmetric else omega)
        root = np.sqrt(size)
        rhs = np.divide(
            u.T @ rhs, root, out=np.zeros_like(root),
            where=size > max(_SINGULAR * size[0], np.finfo(float).tiny),
        )  # of L η
        U, sigma, Vt = np.linalg.svd(reset.transform)
        inverse = Vt.T / np.maximum(sigma, _SINGULAR * sigma[0])  # T⁻¹ = inverse Uᵀ
        left, right = root[:, None] * (u.T @ inverse), root[:, None] * (vt @ inverse)
        order = np.argsort(-np.linalg.norm(right, axis=0), kind="stable")
        q, r = np.linalg.qr(right[:, order])
        limit = np.sqrt(self.surplus * self.level)
        share = _share(r, limit)
        right[:, order] = share * r
        rhs = share[:, 0] * (q.T @ rhs) + right @ (U.T @ reset.shift)
        if symmetric:
            left = right.T  # equal but for rounding, which would add up from reset to reset
        else:
            left = (share * (q.T @ left)).T
            left *= _share(left, limit * np.sqrt(len(left)))
        values = U @ left @ np.column_stack([right @ U.T, rhs])
        return replace(self, values=reset.keep * values)


def _share(rows: Array, limit: float) -> Array:
    """Factors (m, 1) ≤ 1 that bring rows (m, p) down to a length."""
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.divide(limit, length, out=np.ones_like(length), where=length > limit))


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
    resets: tuple[Reset, ...] = ()  # at edges of the mesh, in the order of time
    floor: float = 0.0  # size below which parameters are rounding
    dynamics: Dynamics | None = None  # of parameters that move; then there are no resets

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
        """[G | h] with G(t) = ∫ψᵀψ, h(t) = ∫ψᵀY from the start, shape (p, p + c).

        After a reset it is about the new parameters: Gη = h goes on. For parameters that move it
        is about the current ones and forgets at their rate ρ, a lower bound of what is known.
        """
        if self.dynamics is not None:
            ones = np.ones(self.p)
            return filtered(self.outer, 0.0 * ones, ones, self.dynamics)
        if not self.resets:
            return self.outer.integral()
        pieces, known = [], np.zeros((self.p, self.p + 1))
        level = 0.0
        for segment, reset in zip(self.segments, (*self.resets, None), strict=True):
            own = segment.outer.integral()
            pieces.append(own.values + known)
            level = max(level, largest(own.final))
            if reset is not None:
                known = ExtensionState(pieces[-1][-1, -1], level).after(reset).values
        return Trajectory(self.mesh, np.concatenate(pieces))

    @cached_property
    def segments(self) -> tuple[LinearRegression, ...]:
        """The regression between one reset and the next, each about its own parameters."""
        if not self.resets:
            return (self,)
        mesh = self.mesh
        cuts = np.searchsorted(mesh.edges, [reset.time for reset in self.resets])
        out = []
        bounds = pairwise([0, *(int(cut) for cut in cuts), mesh.size])
        floors = (self.floor, *(reset.floor for reset in self.resets))
        for (first, last), floor in zip(bounds, floors, strict=True):
            piece = Mesh(mesh.edges[first : last + 1], mesh.rule)
            out.append(replace(
                self, Y=Trajectory(piece, self.Y.values[first:last]),
                psi=Trajectory(piece, self.psi.values[first:last]), resets=(),
                floor=floor,
            ))
        return tuple(out)


def outer_products(psi: Array, Y: Array) -> Array:
    """[ψᵀψ | ψᵀY] of shape (..., p, p + c) from ψ (..., rows, p) and Y (..., rows[, c])."""
    Y = with_realisations(psi, Y)
    if (
        kernels.compiled is not None and psi.ndim == 4  # on a mesh
        and psi.shape[3] + Y.shape[3] <= _FEW_COLUMNS
    ):
        products: Array = kernels.compiled.outer_products(psi, Y)
        return products
    both = np.concatenate([psi, Y], axis=-1)
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


def largest(extended: Array) -> float:
    """‖Ω‖₂ of [Ω | 𝒴] (..., p, p + c), the largest of all."""
    p = extended.shape[-2]
    return spectral_norm(extended, p) if extended.size else 0.0


def spectral_norm(matrices: Array, columns: int) -> float:
    """‖·‖₂ of the first columns of matrices (..., a, b), the largest of all."""
    if kernels.compiled is not None and min(matrices.shape[-2], columns) <= SMALL_SPECTRUM:
        found: float | None = kernels.compiled.spectral_norm(matrices, columns)
        if found is not None:  # else not all is finite
            return found
    norms = np.linalg.norm(matrices[..., :columns], 2, axis=(-2, -1))
    return float(norms.max(initial=0.0))


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
