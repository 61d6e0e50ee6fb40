"""E⁺ and the subspaces of E(t), constant in time where they can be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gpebo_cli.errors import ModelError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.linalg import (
    exact_product,
    largest_over_time,
    orthonormal_complement,
    transpose,
    without_rounding,
)

_TURNED = 8 * float(np.finfo(float).eps)  # of E outside the frame, relative: rounding
_PROJECTOR_TURNED = 1e-13
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Split:
    """E⁺ and the subspaces of E at N times; a leading axis of 1 means constant in time."""

    rank: int  # n_a
    basis: Array  # (n, k) orthonormal B with w = B z: range P where that is constant, else I
    pinv: Array  # (N, k, n) BᵀE⁺
    turn: Array | None  # (N, k, n) BᵀṖ, None for zero
    equations: Array  # (N, e, n) L: Π itself, or the e = n_b equations without derivatives
    kernel: Array  # (N, n, n_b) orthonormal
    projector: Array  # (N, n, n) P
    frame: Frame | None  # None where kernel or range turn


@dataclass(frozen=True, eq=False)
class Remaining:
    """The part of w that is kept where Assumption 1 fails, see :mod:`.partial`."""

    kept: Array  # (n, k) orthonormal
    given_up: Array  # (n, c) orthonormal, the rest of range P
    rank: int  # of 𝒜 on the kernel and on what is given up


@dataclass(frozen=True, eq=False)
class Frame:
    """Kernel and range of an E(t) in which neither depends on time."""

    domain: Array  # (n, n_a) orthonormal, of range P
    range: Array  # (n, n_a) orthonormal, of range E
    kernel: Array  # (n, n_b)
    equations: Array  # (e, n)
    remaining: Remaining | None = None

    @cached_property
    def projector(self) -> Array:
        """P, (n, n)."""
        return np.asarray(self.domain @ self.domain.T)


def entry_sizes(E: Array) -> Array:
    """Largest size of each entry of E (N, n, n) over the times, (n, n)."""
    return largest_over_time(E)


def axes_frame(entries: Array) -> Frame | None:
    """Coordinate axes where E has columns and rows that are exactly zero.

    E = diag(E_a(t), 0) is such a case; None where their numbers differ.

    Args:
        entries: the size of each entry of E over the times, (n, n).
    """
    used = entries != 0.0  # NaN is not zero
    rows, columns = used.any(axis=1), used.any(axis=0)
    if np.count_nonzero(rows) != np.count_nonzero(columns):
        return None
    axes = np.eye(len(entries))
    return Frame(axes[:, columns], axes[:, rows], axes[:, ~columns], axes[~rows])


def constant_split(E: Array, states: tuple[str, ...], rank_tol: float) -> Split | None:
    """E⁺ at the times (N, n, n), if kernel and range of E are the same at all of them.

    Coordinate axes where columns and rows are exactly zero; else from the singular vectors at the
    first time.
    """
    frame = axes_frame(entry_sizes(E))
    if frame is not None:
        split = split_in_frame(E, frame, rank_tol)
        if split is not None:
            return split
    U, sigma, Vt = np.linalg.svd(E[0])
    rank = int((sigma > rank_tol * np.linalg.norm(E, axis=(1, 2)).max()).sum())
    U1, V2 = U[:, :rank], Vt[rank:].T
    domain, _ = initial_basis(Vt[:rank].T @ Vt[:rank], rank, states)
    equations = without_rounding(orthonormal_complement(U1)[None])[0]
    return split_in_frame(E, Frame(domain, U1, V2, equations), rank_tol)


def split_in_frame(E: Array, frame: Frame, rank_tol: float) -> Split | None:
    """E⁺ = B (UᵀE B)⁻¹ Uᵀ of E (N, n, n), or None.

    None where kernel, range or rank are not those of the frame at one of the times.
    """
    B, U = frame.domain, frame.range
    size, outside = (
        float(np.abs(part).max(initial=0.0)) for part in (E, E @ frame.kernel)
    )
    outside = max(outside, float(np.abs(frame.equations @ E).max(initial=0.0)))
    inner = U.T @ E @ B
    try:
        inverse = np.asarray(np.linalg.inv(inner), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    norms = [
        float(np.linalg.norm(part, axis=(1, 2)).max(initial=0.0)) for part in (inner, inverse)
    ]
    if not fits(outside, size, B.shape[1], norms[0], norms[1], rank_tol):
        return None
    return within_frame(frame, inverse @ U.T)


def fits(
    outside: float, size: float, rank: int, inner: float, inverse: float, rank_tol: float
) -> bool:
    """Whether E has this frame and full rank in it, beyond what singular values could change.

    Args:
        outside: largest entry of E outside the frame.
        size: largest entry of E.
        rank: of the frame.
        inner: largest norm of UᵀE B over the times.
        inverse: largest norm of its inverse.
        rank_tol: singular values below this, relative, are zero.
    """
    if outside > _TURNED * size:
        return False
    return 1.0 / max(inverse, TINY) > math.sqrt(max(rank, 1)) * rank_tol * inner


def within_frame(frame: Frame, pinv: Array) -> Split:
    """The split in a frame, with BᵀE⁺ (N, n_a, n)."""
    left = frame.remaining
    if left is not None:
        return Split(
            rank=left.kept.shape[1], basis=left.kept, pinv=left.kept.T @ frame.domain @ pinv,
            turn=None, equations=frame.equations[None],
            kernel=np.hstack([frame.kernel, left.given_up])[None],
            projector=(left.kept @ left.kept.T)[None], frame=frame,
        )
    return Split(
        rank=frame.domain.shape[1], basis=frame.domain, pinv=pinv, turn=None,
        equations=frame.equations[None], kernel=frame.kernel[None],
        projector=frame.projector[None], frame=frame,
    )


def split_by_svd(
    system: DescriptorSystem, E: Array, dE: Array, t: Array, rank_tol: float, basis: Array | None
) -> Split:
    """The general case: singular vectors at every time, and Ṗ = S + Sᵀ with S = E⁺ Ė Q.

    Args:
        system: for messages.
        E: (N, n, n).
        dE: its derivative (N, n, n).
        t: (N,).
        rank_tol: singular values below this, relative, are zero.
        basis: (n, k) of another split, which is kept.

    Raises:
        ModelError: the rank changes, or the kernel turns where that of the basis did not.
    """
    U, sigma, Vt = np.linalg.svd(E)
    size = np.maximum(sigma.max(initial=0.0), TINY)
    ranks = (sigma > rank_tol * size).sum(axis=1)
    if (ranks != ranks[0]).any():
        k = int(np.argmax(ranks != ranks[0]))
        value = sigma[k, min(ranks[k], ranks[0])]
        raise ModelError(
            f"plant {system.name}: the rank of E changes from {ranks[0]} at t = {t[0]:.6g} to "
            f"{ranks[k]} at t = {t[k]:.6g} (singular value {value:.1e}); the observer needs it "
            "constant"
        )
    n_a = int(ranks[0])
    U1, V1, V2 = U[:, :, :n_a], transpose(Vt)[:, :, :n_a], transpose(Vt)[:, :, n_a:]
    pinv_E = without_rounding((V1 / sigma[:, None, :n_a]) @ transpose(U1))  # E⁺
    P = V1 @ transpose(V1)
    S = exact_product(pinv_E, exact_product(dE, without_rounding(V2 @ transpose(V2))))  # E⁺ Ė Q
    turned = float(np.abs(P - P[0]).max(initial=0.0)) >= _PROJECTOR_TURNED
    if basis is None:
        basis = np.eye(system.n) if turned else initial_basis(P[0], n_a, system.states)[0]
    elif basis.shape[1] < system.n:
        off = np.abs(P - basis @ basis.T).max(axis=(1, 2))
        if off.max() >= 10 * _PROJECTOR_TURNED:
            raise ModelError(
                f"plant {system.name}: the kernel of E turns near t = {t[int(np.argmax(off))]:.6g} "
                "and nowhere else; start a run there, or make E smooth"
            )
    return Split(
        rank=n_a, basis=basis, pinv=without_rounding(basis.T @ pinv_E),
        turn=basis.T @ (S + transpose(S)), equations=without_rounding(orthonormal_complement(U1)),
        kernel=V2, projector=P, frame=None,
    )


def initial_basis(P: Array, rank: int, states: tuple[str, ...]) -> tuple[Array, tuple[str, ...]]:
    """V1 (n, n_a), orthonormal basis of range P(start), and the names of e₀'s components.

    Coordinate axes where they span the range (E diagonal, or zero columns): e0_<state>. Else an
    orthonormal basis made from the columns of P in the order of the states: e0_1, e0_2, …
    """
    on_axes = P.diagonal() > 0.5
    exact = np.diag(on_axes.astype(np.float64))
    axes = on_axes.nonzero()[0]
    if len(axes) == rank and np.abs(P - exact).max(initial=0.0) < 1e-13:
        return exact[:, axes], tuple([f"e0_{states[i]}" for i in axes.tolist()])
    columns: list[Array] = []
    for column in P.T:  # Gram–Schmidt, twice: deterministic, unlike singular vectors
        v = column.copy()
        for _ in range(2):
            for u in columns:
                v -= (u @ v) * u
        norm = float(np.linalg.norm(v))
        if norm > 1e-6 and len(columns) < rank:
            columns.append(v / norm)
    return np.array(columns).T.reshape(len(P), -1), tuple(f"e0_{i + 1}" for i in range(rank))
