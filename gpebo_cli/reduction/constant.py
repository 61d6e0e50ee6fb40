"""From E x' = A x + f with constant, full E and A of any index to z' = M z + g, once for all times.

Equations that have no derivative are constraints. Differentiated, they take the places of those
rows of E that vanished; what vanishes then is a hidden constraint (Luenberger's shuffle), until E
is regular. Each step is one singular value decomposition of n rows of unit length, where a
derivative array has (μ + 1) n of them. A singular value that is neither rounding nor clear of it is
left to the derivative array.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import factorial

import numpy as np

from gpebo_cli.kernels.arrays import inverses
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.taylor import Sparse
from gpebo_cli.reduction.explicit import MoreOrdersError, UndecidedError
from gpebo_cli.reduction.scaling import scales_of

_ROUNDING, _CLEAR = 1e-12, 1e-5  # relative singular values: zero below, sure above
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class ConstantForm:
    """z' = M z + f and x = T z + offset at N times, with what ``explicit.Explicit`` has."""

    dynamics: Array  # (d, d) M
    basis: Array  # (n, d) T
    inverse: Array  # (d, n) z = this x
    constraints: Array  # (μ + 1, n, n) offset = Σ this f_j, Taylor coefficients
    forced: Array  # (d, n) f = this f(t) + ``through`` offset
    through: Array  # (d, n)
    mu: int
    pivot: float  # the smallest singular value that counts, relative
    offset: Array  # (N, n)
    f: Array  # (N, d)
    # Sizes of the terms of the offset (n,)
    known: Array | float = 0.0

    def along(self, f: Array) -> ConstantForm:
        """With what is known in the equations (orders, N, n); MoreOrdersError: too few."""
        if len(f) < len(self.constraints):
            raise MoreOrdersError
        terms = [*zip(f, self.constraints, strict=False)]
        offset = sum((x @ S.T for x, S in terms), np.zeros(f.shape[1:]))
        known = sum(np.abs(S) @ np.abs(x).max(axis=0) for x, S in terms)
        return replace(
            self, offset=offset, known=known, f=f[0] @ self.forced.T + offset @ self.through.T
        )

    @property
    def loss(self) -> float:
        """By how much elimination may have made rounding grow."""
        return 1.0 / self.pivot

    @property
    def d(self) -> int:
        """Number of differential equations."""
        return len(self.dynamics)

    @property
    def units(self) -> Array:
        """Units of z (d,)."""
        return np.ones(self.d)

    @property
    def matrix(self) -> Sparse:
        """M, with every entry."""
        d, entries = self.d, self.dynamics.reshape(1, -1)
        return Sparse(np.arange(0, d * d + 1, max(d, 1)), np.tile(np.arange(d), d), entries)

    def reduced(self, x: Array) -> Array:
        """z (d,) of a state (n,)."""
        return np.asarray(self.inverse @ x)

    def at_first(self) -> ConstantForm:
        """What gives the states at the first of the times."""
        return replace(self, offset=self.offset[:1])

    def states_from(self, z: Array) -> Array:
        """x (N, n, c) from z (N, d, c)."""
        return np.asarray(np.moveaxis(np.tensordot(self.basis, z, axes=(1, 1)), 0, 1)
                          + self.offset[:, :, None])

    def sizes_from(self, size: Array) -> Array:
        """What states (n, c) are made of at most, from sizes of z (d, c)."""
        return np.asarray(np.abs(self.basis) @ size)


def constant_form(E: Array, A: Array, max_mu: int) -> ConstantForm:
    """Of E and A (n, n), without anything known in the equations.

    UndecidedError: singular values do not decide the structure, or μ would exceed ``max_mu``.
    """
    n = len(E)
    rows, columns, time = scales_of(E, A)
    size = np.linalg.norm(rows[:, None] * E * columns / time, axis=1)
    rows /= np.exp2(np.rint(np.log2(np.where(size > 0.0, size, 1.0))))
    e, a = rows[:, None] * E * columns / time, rows[:, None] * A * columns
    found, least = _constraints(e, a, max_mu)
    A2 = np.concatenate([np.zeros((0, n)), *(C for C, _ in found)])
    count, levels = len(A2), max(len(found), 1)
    if count > n:  # some of them are rounding: equations that depend on others
        raise UndecidedError
    known_in = np.zeros((levels, count, n))
    place = 0
    for C, p in found:
        known_in[: len(p), place : place + len(C)] = np.array(p)
        place += len(C)
    size = np.maximum(np.linalg.norm(A2, axis=1), _TINY)[:, None]
    A2, known_in = A2 / size, known_in / size
    free = np.linalg.svd(A2)[2][count:].T
    Z1 = np.linalg.svd(e @ free, full_matrices=False)[0]
    whole = np.concatenate([Z1.T @ e, A2])
    # Rows of A2 have unit length: what constraints determine is of the same scale before and after.
    inverse = inverses((whole / np.linalg.norm(whole, axis=1)[:, None])[None])[0]
    if not np.linalg.norm(inverse) < 1.0 / _CLEAR:
        raise UndecidedError
    d = n - count
    constrained = -columns[:, None] * inverse[:, d:]
    # z = Nᵀx with an orthonormal basis N of what constraints leave: not Z1ᵀE x, of which the states
    # may be small differences.
    explicit = np.linalg.solve(Z1.T @ e @ free, Z1.T @ np.concatenate([a, e, np.eye(n)], axis=1))
    of_a, of_e, of_f = (explicit[:, k * n : (k + 1) * n] for k in range(3))
    powers = np.array([[[factorial(j) * time**j]] for j in range(levels)])  # f^(j) is j! f_j
    return ConstantForm(
        of_a @ free / time, columns[:, None] * free, of_e / columns,
        constrained @ known_in * powers * rows, of_f * rows / time, of_a / columns / time,
        levels - 1, least, np.zeros((1, n)), np.zeros((1, d)),
    )


def _constraints(e: Array, a: Array, max_mu: int) -> tuple[list[tuple[Array, list[Array]]], float]:
    """Constraints 0 = C x + Σ p_j d^j f/ds^j of e dx/ds = a x + f by their level; least pivot."""
    n = len(e)
    known = [np.eye(n)]  # now dx/ds = left x + Σ known_j d^j f/ds^j
    now, left = e, a
    found: list[tuple[Array, list[Array]]] = []
    least = 1.0
    for _ in range(max_mu + 2):
        size = np.linalg.norm(now, axis=1)
        inward = 1.0 / np.where(size > 0.0, size, 1.0)[:, None]
        now, left, known = now * inward, left * inward, [p * inward for p in known]
        U, sigma, _ = np.linalg.svd(now)
        sigma /= max(sigma[0], _TINY)
        rank = int((sigma > _CLEAR).sum())
        if (sigma[rank:] > _ROUNDING).any():
            raise UndecidedError
        least = min(least, float(sigma[:rank].min(initial=1.0)))
        if rank == n:
            return found, least
        kept, gone = U[:, :rank].T, U[:, rank:].T
        C, of_f, nothing = gone @ left, [gone @ p for p in known], np.zeros((n - rank, n))
        found.append((C, of_f))
        now, left = np.concatenate([kept @ now, C]), np.concatenate([kept @ left, nothing])
        known = [
            np.concatenate([kept @ p, -q])
            for p, q in zip([*known, np.zeros((n, n))], [nothing, *of_f], strict=True)
        ]
    raise UndecidedError
