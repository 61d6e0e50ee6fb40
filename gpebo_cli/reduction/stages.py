"""Index reduction one differentiation at a time, where derivative arrays cannot tell ranks.

A rate λ beside rates of 1, rotated into all equations, stands in a derivative array as λ, λ², …,
and beside them nothing shows what is of order one. Here each stage takes the equations without
derivatives, differentiates them and puts them in the place of what they came from,

    [E_r; 0] x' = [A_r; A_z] x + [f_r; f_z]   →   [E_r; A_z] x' = [A_r; −A_z'] x + [f_r; −f_z']

until E is regular. Rows of both blocks are made orthonormal, and constraints are taken without
what earlier ones say already: so neither rates nor what moves fast ever stands beside them. At each
time the row operations are Taylor series, and need not be continuous from time to time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpebo_cli.kernels.arrays import joined
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import taylor_product, transpose

_EPS = float(np.finfo(float).eps)
_TINY = float(np.finfo(float).tiny)
_FAR_BELOW = 1e-30  # of the largest entry
_SHARE = 0.1  # of a constraint that rounding may be
_CLEAR = 16.0  # times its rounding, what is smaller is zero
_DOUBT = 1e3  # times its rounding, what is smaller may be zero
_MOST = 0.5  # of the times: what is clear there, and not at others, is so suddenly
_VANISH = 0.1  # of its largest size over time, below which a constraint is about to vanish


class Stages(NamedTuple):
    """The constraints 0 = Â2 x + f2 at N times, with orthonormal rows."""

    A2: Array  # (N or 1, a, n)
    f2: Array  # (N, a, c)
    Z1: Array  # (N or 1, n, d) orthonormal basis of range(E T2), T2 of the kernel of Â2
    size: Array  # (M, a, n + c) what [Â2 f2] is the difference of, at some of the times
    ranks: tuple[int, ...]  # of E in each stage but the last
    # Singular values that are not zero, of E, of Â2 and of E T2, and the size that the equations
    # without derivatives have before they are made orthonormal, of all stages together.
    smallest: Array  # (N or 1, 4)


class UnclearError(Exception):
    """A rank is not the same everywhere, or not clear; at the time of this number."""

    def __init__(self, place: int, *, rounding: bool = False, sudden: bool = False) -> None:
        self.place, self.rounding = place, rounding  # whether rounding is all that is left
        self.sudden = sudden  # whether it is the same at most times


def _without_dust(E: Array) -> Array:
    """Matrices (N, n, n) in which zeros stand for entries with which LAPACK's SVD may not end."""
    return np.where(np.abs(E) > _FAR_BELOW * np.abs(E).max(axis=(1, 2), keepdims=True), E, 0.0)


def in_stages(
    E: Array, A: Array, f: Array, rank_tol: float, every: int,
    ranks: Sequence[int] | None = None,
) -> Stages:
    """Constraints of E x' = A x + f from scaled Taylor coefficients (orders, N or 1, n, c).

    Relative singular values below ``rank_tol``, and those that rounding explains, are zero.
    Rounding is looked at at ``every`` so many times. ``ranks`` have to be found; None: whatever the
    first time has (UnclearError: they are not, or the system is not uniquely solvable, or takes
    more orders).
    """
    mass, found, errors = E[0], list[int](), _Rounding(E, A, f, every)
    rows: list[tuple[Array, Array, list[list[Array]]]] = []
    smallest = np.array([np.inf, np.inf, np.inf, 1.0]) + np.zeros((len(mass), 1))

    def require(holds: BoolArray | bool, decides: Array | float = np.inf) -> None:
        if not np.all(holds):
            # Where what decides is hardly more than its rounding, that is the reason, unless most
            # times are clear and constraints vanish just there: then rounding is what is left.
            near = (rank_tol < decides) & (decides < _DOUBT * errors.noise) | errors.lost
            near, holds = np.broadcast_arrays(near, holds)
            place, sizes = int(np.argmin(holds)), smallest[:, 3]
            sudden = bool(np.mean(holds) > _MOST)
            vanish = sudden and sizes[place % len(sizes)] < _VANISH * sizes.max()
            raise UnclearError(place, rounding=bool(near[place]) and not vanish, sudden=sudden)

    while True:
        U, sigma, Vt = np.linalg.svd(_without_dust(E[0]))
        relative = sigma / np.maximum(sigma[:, :1], _TINY)
        counts = (relative > np.maximum(rank_tol, _CLEAR * errors.noise)[:, None]).sum(axis=1)
        r, n = int(counts[0]) if ranks is None else (*ranks, len(U[0]))[len(found)], len(U[0])
        require(counts == r, relative[np.arange(len(counts)), np.maximum(counts, r) - 1])
        smallest[:, 0] = np.minimum(smallest[:, 0], relative[:, r - 1] if r else np.inf)
        if r == n:
            break
        require(len(A) > 0 and n - r + sum(one[0].shape[2] for one in rows) <= n)
        found.append(r)
        # E_r = W1 E with E_r V = I at this time; W2 − X W1 takes everything else from E.
        W1, W2 = transpose(U[:, :, :r] / np.maximum(sigma[:, None, :r], _TINY)), transpose(U)[:, r:]
        V = transpose(Vt[:, :r])
        parts = [(W1 @ x, W2 @ x) for x in (E, A, f)]
        P, R = parts[0][0] @ V, parts[0][1] @ V
        X = R.copy()
        for k in range(1, len(X)):
            X[k] -= sum(X[k - j] @ P[j] for j in range(1, k + 1))
        A_z, f_z = (below - taylor_product(X, above) for above, below in parts[1:])
        A_z, f_z, known = _without(A_z, f_z, rows)
        Uz, size, _ = np.linalg.svd(A_z[0], full_matrices=False)
        # It is compared with its terms, because they may cancel.
        require(size[:, -1] > _CLEAR * _EPS * np.linalg.norm(abs(W2) @ abs(A[0]), axis=(1, 2)))
        Wz = transpose(Uz / size[:, None, :])
        smallest[:, 3] *= size[:, -1]
        A_z, f_z = Wz @ A_z, Wz @ f_z
        factors = W1, W2, Wz, V, X, *known, errors.rate * parts[0][0], parts[1][0]
        rows.append((A_z, f_z, errors.of_constraints(factors, [one[2] for one in rows])))
        E = _stacked(parts[0][0], A_z)
        A, f = (_stacked(above[:-1], -_slope(z)) for (above, _), z in
                zip(parts[1:], (A_z, f_z), strict=True))
    require(len(rows) > 0)
    A2, f2, size = (np.concatenate(part, axis=1) for part in zip(*(
        (A_z[0], f_z[0], joined(of[0][0][0], of[0][1][0], axis=2)) for A_z, f_z, of in rows
    ), strict=True))
    a = A2.shape[1]
    _, sigma, Vt = np.linalg.svd(A2)
    smallest[:, 1] = sigma[:, -1]
    Z1, sigma, _ = np.linalg.svd(mass @ transpose(Vt)[:, :, a:], full_matrices=False)
    if a < mass.shape[1]:
        smallest[:, 2] = sigma[:, -1] / np.maximum(np.linalg.norm(mass, axis=(1, 2)), _TINY)
    least = smallest[:, 1:3].min(axis=1)
    require(least > np.maximum(rank_tol, _CLEAR * errors.noise), least)
    return Stages(A2, f2, Z1, np.sqrt(size), tuple(found), smallest)


def _without(
    A_z: Array, f_z: Array, rows: list[tuple[Array, Array, list[list[Array]]]]
) -> tuple[Array, Array, list[Array]]:
    """A constraint less constant shares of earlier ones, to which it is orthogonal then, and these.

    Twice, because what is left of large terms need not be after the first time.
    """
    shares = [np.zeros(())] * len(rows)
    for k, (A_k, f_k, _) in [*enumerate(rows)] * 2:
        share = A_z[0] @ transpose(A_k[0])
        A_z, f_z = A_z - share @ A_k[: len(A_z)], f_z - share @ f_k[: len(f_z)]
        shares[k] = shares[k] + share
    return A_z, f_z, shares


class _Rounding:
    """Rounding errors of single entries, squared, in units of the last place of 1.

    An error of X adds a share of A_r x + f_r. For a solution this is E_r x', where x moves as the
    coefficients do, at the ``rate``; for a constraint, all its terms. They are kept apart.
    """

    def __init__(self, E: Array, A: Array, f: Array, every: int) -> None:
        self.rate = max(
            float(np.abs(x[1]).max(initial=0.0) / max(np.abs(x[0]).max(initial=0.0), _TINY))
            if len(x) > 1 else 0.0 for x in (E, A, f)
        )
        self.every, self.of = every, [[x[:, ::every] ** 2 for x in (E, A, f)] for _ in range(2)]
        self.noise = np.full(1, _EPS)  # (N or 1,) of the last constraints
        self.lost = np.zeros(1, dtype=bool)  # (N or 1,) whether too little of one is left

    def of_constraints(
        self, factors: tuple[Array, ...], earlier: list[list[list[Array]]]
    ) -> list[list[Array]]:
        """Those of [A_z, f_z], of both kinds; those of [E, A, f] become those of the next stage.

        ``factors`` are W1, W2, Wz, V and X, by which errors so far are multiplied, and the shares
        of ``earlier`` constraints; the last two are what an error of X is multiplied with.
        """
        *squares, mass_r, terms = (y[..., :: self.every, :, :] ** 2 for y in factors)
        w1, w2, wz, v, x, *shares = squares
        found = []
        for k, residual in enumerate((mass_r, terms)):
            (e_r, e_z), *wrong = ((w1 @ y, w2 @ y) for y in self.of[k])
            of_z = [below + taylor_product(x, above) for above, below in wrong]
            for share, of in zip(shares, earlier, strict=True):
                of_z = [z + share @ one[: len(z)] for z, one in zip(of_z, of[k], strict=True)]
            of_z = [wz @ z for z in of_z]
            of_x = wz @ taylor_product(e_z @ v + taylor_product(x, e_r @ v), residual)
            of_z[0] = of_z[0] + of_x[: len(of_z[0])]
            self.of[k] = [_stacked(e_r, of_z[0]), *(
                _stacked(above[:-1], _slope(z, power=2))
                for (above, _), z in zip(wrong, of_z, strict=True)
            )]
            found.append(of_z)
        most, most_terms = (of[0][0].max(axis=(1, 2)) for of in found)
        if self.every > 1:  # those that are looked at stand for all times
            most, most_terms = most.max(keepdims=True), most_terms.max(keepdims=True)
        self.noise = _EPS * np.sqrt(most)
        self.lost = self.lost | (most_terms > (_SHARE / _EPS) ** 2)
        return found


def _slope(a: Array, power: int = 1) -> Array:
    """Coefficients of the derivative, one order less; or, squared, of its errors."""
    return np.asarray(a[1:] * np.arange(1.0, len(a)).reshape(-1, 1, 1, 1) ** power)


def _stacked(above: Array, below: Array) -> Array:
    """Rows of matrices of Taylor coefficients."""
    orders = min(len(above), len(below))
    return np.concatenate([above[:orders], below[:orders]], axis=2)
