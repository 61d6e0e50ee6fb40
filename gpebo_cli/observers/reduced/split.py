"""E⁺ and the subspaces of E(t), constant in time where they can be.

E⁺ and with it P = E⁺E are those of states in units of comparable size, D: E⁺ = D (E D)⁺. So P is an
orthogonal projector in D⁻¹x, and depends on no unit. A basis B (n, k) of range P comes with its
dual (k, n), dual B = I and dual P = dual. Coordinate axes are their own dual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gpebo_cli.errors import ModelError
from gpebo_cli.kernels.arrays import across, down, inverses
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.linalg import (
    exact_product,
    largest_over_time,
    orthonormal_complement,
    transpose,
    without_rounding,
)
from gpebo_cli.schema import instant

_TURNED = 8 * float(np.finfo(float).eps)  # of E outside the frame, relative: rounding
_PROJECTOR_TURNED = 1e-13
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Split:
    """E⁺ and the subspaces of E at N times; a leading axis of 1 means constant in time."""

    rank: int  # n_a
    basis: Array  # (n, k) B with w = B z: range P where that is constant, else I
    dual: Array  # (k, n), z = dual w
    pinv: Array  # (N, k, n) dual E⁺
    turn: Array | None  # (N, k, n) dual Ṗ, None for zero
    equations: Array  # (N, e, n) L: Π itself, or the e = n_b equations without derivatives
    kernel: Array  # (N, n, n_b) orthonormal in comparable units
    projector: Array  # (N, n, n) P
    frame: Frame | None  # None where kernel or range turn

    def coordinates(self, states: tuple[str, ...], units: Array) -> tuple[str, ...]:
        """Names of w's coordinates z, (k,), from those of the states and their units (n,)."""
        if self.basis.shape[1] > self.rank:
            return tuple(f"w_{state}" for state in states)
        own = self.projector[0] * units / units[:, None]
        names = initial_basis(own, self.rank, states, units)[2]
        return tuple(name.replace("e0_", "w_", 1) for name in names)


@dataclass(frozen=True, eq=False)
class Remaining:
    """The part of w that is kept where Assumption 1 fails, see :mod:`.partial`."""

    kept: Array  # (n, k) with
    dual: Array  # (k, n)
    given_up: Array  # (n, c), the rest of range P
    rank: int  # of 𝒜 on the kernel and on what is given up


@dataclass(frozen=True, eq=False)
class Frame:
    """Kernel and range of an E(t) in which neither depends on time."""

    domain: Array  # (n, n_a) of range P, with
    dual: Array  # (n_a, n)
    range: Array  # (n, n_a) orthonormal, of range E
    kernel: Array  # (n, n_b)
    equations: Array  # (e, n)
    remaining: Remaining | None = None

    @cached_property
    def projector(self) -> Array:
        """P, (n, n)."""
        return np.asarray(self.domain @ self.dual)

    @cached_property
    def axes(self) -> bool:
        """Whether domain and kernel are coordinate axes."""
        return bool(np.count_nonzero(self.domain) == self.domain.shape[1])


def axes_frame(entries: Array) -> Frame | None:
    """Coordinate axes where E, of entries up to (n, n), has columns and rows that are exactly zero.

    E = diag(E_a(t), 0) is such a case; None where their numbers differ.
    """
    used = entries != 0.0  # NaN is not zero
    rows, columns = used.any(axis=1), used.any(axis=0)
    if np.count_nonzero(rows) != np.count_nonzero(columns):
        return None
    axes = np.eye(len(entries))
    domain = axes[:, columns]
    return Frame(domain, domain.T, axes[:, rows], axes[:, ~columns], axes[~rows])


def constant_split(
    E: Array, states: tuple[str, ...], units: Array, rank_tol: float
) -> Split | None:
    """E⁺ at the times (N, n, n), if kernel and range of E are the same at all of them.

    Coordinate axes where columns and rows are exactly zero; else from the singular vectors at the
    first time. The states have units (n,).
    """
    frame = axes_frame(largest_over_time(E))
    if frame is not None:
        split = split_in_frame(E, frame, units, rank_tol)
        if split is not None:
            return split
    U, sigma, Vt = np.linalg.svd(E[0] * units)
    rank = int((sigma > rank_tol * np.linalg.norm(E * units, axis=(1, 2)).max()).sum())
    U1, V2 = U[:, :rank], units[:, None] * Vt[rank:].T
    domain, dual, _ = initial_basis(Vt[:rank].T @ Vt[:rank], rank, states, units)
    equations = without_rounding(orthonormal_complement(U1)[None])[0]
    return split_in_frame(E, Frame(domain, dual, U1, V2, equations), units, rank_tol)


def split_in_frame(E: Array, frame: Frame, units: Array, rank_tol: float) -> Split | None:
    """E⁺ = B (UᵀE B)⁻¹ Uᵀ of E (N, n, n), or None.

    None where kernel, range or rank are not those of the frame at one of the times.
    """
    B, U = frame.domain, frame.range
    beside = across(E, frame.kernel), down(frame.equations, E) * units
    outside = max(float(np.abs(part).max(initial=0.0)) for part in beside)
    size = 0.0 if outside == 0.0 else float(np.abs(E * units).max())
    own = np.linalg.norm(B / units[:, None], axis=0)  # of columns that are not yet comparable
    inner = across(down(U.T, E), B) / own
    diagonal = np.einsum("nii->ni", inner)
    alone = np.count_nonzero(inner) == np.count_nonzero(diagonal) == diagonal.size
    inverse = (1.0 / diagonal)[:, :, None] * np.eye(len(own)) if alone else inverses(inner)
    norms = [
        float(np.linalg.norm(part, axis=(1, 2)).max(initial=0.0)) for part in (inner, inverse)
    ]
    if not fits(outside, size, B.shape[1], norms[0], norms[1], rank_tol):
        return None
    return within_frame(frame, inverse / own[:, None] @ U.T)


def fits(
    outside: float, size: float, rank: int, inner: float, inverse: float, rank_tol: float
) -> bool:
    """Whether E has this frame and full rank in it, beyond what singular values could change.

    That is told by the largest entries of E ``outside`` the frame and at all (``size``), and by the
    largest norms over the times of UᵀE B and of its inverse.
    """
    if outside > _TURNED * size:
        return False
    return 1.0 / max(inverse, TINY) > math.sqrt(rank) * rank_tol * inner


def within_frame(frame: Frame, pinv: Array) -> Split:
    """The split in a frame, with dual E⁺ (N, n_a, n)."""
    basis, dual, kernel, projector = frame.domain, frame.dual, frame.kernel, frame.projector
    if (left := frame.remaining) is not None:
        basis, dual, pinv = left.kept, left.dual, left.dual @ frame.domain @ pinv
        kernel, projector = np.hstack([kernel, left.given_up]), basis @ dual
    return Split(
        rank=basis.shape[1], basis=basis, dual=dual, pinv=pinv, turn=None,
        equations=frame.equations[None], kernel=kernel[None], projector=projector[None],
        frame=frame,
    )


def split_by_svd(
    system: DescriptorSystem, E: Array, dE: Array, t: Array, units: Array, rank_tol: float,
    like: Split | None,
) -> Split:
    """The general case: singular vectors at every time, and Ṗ = S + Sᵀ with S = E⁺ Ė Q.

    E and Ė (N, n, n) are those at the times t (N,), the states have units (n,), and a split that is
    given keeps its basis (ModelError: the rank changes, or the kernel turns where that of the basis
    did not).
    """
    U, sigma, Vt = np.linalg.svd(E * units)
    size = np.maximum(sigma.max(initial=0.0), TINY)
    ranks = (sigma > rank_tol * size).sum(axis=1)
    if (ranks != ranks[0]).any():
        k = int(np.argmax(ranks != ranks[0]))
        value = sigma[k, min(ranks[k], ranks[0])]
        raise ModelError(
            f"plant {system.name}: the rank of E changes from {ranks[0]} at t = {instant(t[0], 6)} "
            f"to {ranks[k]} at t = {instant(t[k], 6)} (singular value {value:.1e}); the observer "
            "needs it constant"
        )
    n_a = int(ranks[0])
    U1, V1, V2 = U[:, :, :n_a], transpose(Vt)[:, :, :n_a], transpose(Vt)[:, :, n_a:]
    # E⁺ in comparable units
    pinv_E = without_rounding((V1 / sigma[:, None, :n_a]) @ transpose(U1))
    P = V1 @ transpose(V1)
    Q = without_rounding(V2 @ transpose(V2))
    S = exact_product(pinv_E, exact_product(dE * units, Q))  # E⁺ Ė Q
    turned = float(np.abs(P - P[0]).max(initial=0.0)) >= _PROJECTOR_TURNED
    own = units[:, None]
    if like is not None:
        basis, dual = like.basis, like.dual
    elif turned:
        basis = dual = np.eye(system.n)
    else:
        basis, dual, _ = initial_basis(P[0], n_a, system.states, units)
    if like is not None and basis.shape[1] < system.n:
        off = np.abs(P - (basis @ dual) * units / own).max(axis=(1, 2)) >= 10 * _PROJECTOR_TURNED
        if off.any():
            raise ModelError(
                f"plant {system.name}: the kernel of E turns from t = "
                f"{instant(t[int(np.argmax(off))], 6)} on; start a run there, or make E smooth"
            )
    along = units_along(basis, units)[:, None]
    inverse = along * without_rounding((dual * units / along) @ pinv_E)
    return Split(
        rank=n_a, basis=basis, dual=dual, pinv=inverse,
        turn=(dual * units) @ (S + transpose(S)) / units,
        equations=without_rounding(orthonormal_complement(U1)),
        kernel=own * V2, projector=own * P / units, frame=None,
    )


def units_along(basis: Array, units: Array) -> Array:
    """Units (k,) of coordinates along a basis (n, k) of states with units (n,)."""
    return np.asarray(1.0 / np.linalg.norm(basis / units[:, None], axis=0))


def comparable(Phi: Array, units: Array) -> Array:
    """Φ (…, k, d) of coordinates with units (k,), with columns that start at size 1."""
    own = Phi / units[:, None]
    start = own[(0,) * (own.ndim - 2)]
    return np.asarray(own / np.linalg.norm(start, axis=0))


def initial_basis(
    P: Array, rank: int, states: tuple[str, ...], units: Array
) -> tuple[Array, Array, tuple[str, ...]]:
    """V1 (n, n_a), basis of range P(start), its dual and the names of e₀'s components.

    Coordinate axes where they span the range (E diagonal, or zero columns): e0_<state>. Else a
    basis that is orthonormal in comparable units, from the columns of P in the order of the states:
    e0_1, e0_2, … P is an orthogonal projector of rank n_a in comparable units (n,) of the states.
    """
    on_axes = P.diagonal() > 0.5
    exact = np.diag(on_axes.astype(np.float64))
    axes = on_axes.nonzero()[0]
    if len(axes) == rank and np.abs(P - exact).max(initial=0.0) < 1e-13:
        return exact[:, axes], exact[axes], tuple([f"e0_{states[i]}" for i in axes.tolist()])
    columns: list[Array] = []
    for column in P.T:  # Gram–Schmidt, twice: deterministic, unlike singular vectors
        v = column.copy()
        for _ in range(2):
            for u in columns:
                v -= (u @ v) * u
        norm = float(np.linalg.norm(v))
        if norm > 1e-6 and len(columns) < rank:
            columns.append(v / norm)
    V = without_rounding(np.array(columns).T.reshape(1, len(P), -1))[0]
    return units[:, None] * V, V.T / units, tuple(f"e0_{i + 1}" for i in range(rank))
