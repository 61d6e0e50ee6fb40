"""Index reduction one differentiation at a time, where derivative arrays cannot tell ranks.

A rate λ beside rates of 1, rotated into all equations, stands in a derivative array as λ, λ², …,
and beside them nothing shows what is of order one. Here each stage takes the equations without
derivatives, differentiates them and puts them in the place of what they came from,

    [E_r; 0] x' = [A_r; A_z] x + [f_r; f_z]   →   [E_r; A_z] x' = [A_r; −A_z'] x + [f_r; −f_z']

until E is regular. Rows of both blocks are made orthonormal, so rates never stand beside them. At
each time the row operations are Taylor series, and need not be continuous from time to time.
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
_SHARE = 0.1  # of a constraint that rounding may be
_CLEAR = 16.0  # times its rounding, what is smaller is zero
_DOUBT = 1e3  # times its rounding, what is smaller may be zero


class Stages(NamedTuple):
    """The constraints 0 = Â2 x + f2 at N times, with orthonormal rows from each stage."""

    A2: Array  # (N or 1, a, n)
    f2: Array  # (N, a, c)
    Z1: Array  # (N or 1, n, d) orthonormal basis of range(E T2), T2 of the kernel of Â2
    size: Array  # (M, a, n + c) what [Â2 f2] is the difference of, at some of the times
    ranks: tuple[int, ...]  # of E in each stage but the last
    smallest: Array  # (N or 1, 3) singular values that are not zero: of E, of Â2 and of E T2


class UnclearError(Exception):
    """A rank is not the same everywhere, or not clear; at the time of this number."""

    def __init__(self, place: int, *, rounding: bool = False) -> None:
        self.place, self.rounding = place, rounding  # whether rounding is all that is left


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
    mass, noise, lost, found = E[0], _EPS, False, list[int]()

    def require(holds: BoolArray, decides: Array | float = np.inf) -> None:
        if not holds.all():
            # Where what decides is hardly more than its rounding, that is the reason.
            near = np.asarray((rank_tol < decides) & (decides < _DOUBT * noise))
            raise UnclearError(int(np.argmin(holds)), rounding=lost or bool((near & ~holds).any()))

    # Rounding errors of single entries, squared, in units of the last place of 1. An error of X
    # adds a share of A_r x + f_r. For a solution this is E_r x', where x moves as the coefficients
    # do; for a constraint, all its terms.
    rate = max(
        float(np.abs(x[1]).max(initial=0.0) / max(np.abs(x[0]).max(initial=0.0), _TINY))
        if len(x) > 1 else 0.0 for x in (E, A, f)
    )
    rounding = [[x[:, ::every] ** 2 for x in (E, A, f)] for _ in range(2)]
    rows: list[tuple[Array, Array, Array]] = []
    smallest = np.full((len(mass), 3), np.inf)
    while True:
        U, sigma, Vt = np.linalg.svd(E[0])
        relative = sigma / np.maximum(sigma[:, :1], _TINY)
        counts = (relative > max(rank_tol, _CLEAR * noise)).sum(axis=1)
        r, n = int(counts[0]) if ranks is None else (*ranks, len(U[0]))[len(found)], len(U[0])
        require(counts == r, relative[np.arange(len(counts)), np.maximum(counts, r) - 1])
        smallest[:, 0] = np.minimum(smallest[:, 0], relative[:, r - 1] if r else np.inf)
        if r == n:
            break
        require(np.full(1, len(A) > 0 and n - r + sum(len(one[0][0]) for one in rows) <= n))
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
        Uz, size, _ = np.linalg.svd(A_z[0], full_matrices=False)
        # It is compared with its terms, because they may cancel.
        require(size[:, -1] > _CLEAR * _EPS * np.linalg.norm(abs(W2) @ abs(A[0]), axis=(1, 2)))
        Wz = transpose(Uz / size[:, None, :])
        A_z, f_z = Wz @ A_z, Wz @ f_z
        factors = W1, W2, Wz, V, X, rate * parts[0][0], parts[1][0]
        *squares, mass_r, terms = (y[..., ::every, :, :] ** 2 for y in factors)
        (of_A, of_f), rounding[0] = _rounding(rounding[0], squares, mass_r)
        rows.append((A_z[0], f_z[0], joined(of_A[0], of_f[0], axis=2)))
        noise = _EPS * float(np.sqrt(of_A[0].max()))
        (of_A, _), rounding[1] = _rounding(rounding[1], squares, terms)
        lost |= bool(of_A[0].max() > (_SHARE / _EPS) ** 2)
        E = _stacked(parts[0][0], A_z)
        A, f = (_stacked(above[:-1], -_slope(z)) for (above, _), z in
                zip(parts[1:], (A_z, f_z), strict=True))
    require(np.full(1, len(rows) > 0))
    A2, f2, size = (np.concatenate(part, axis=1) for part in zip(*rows, strict=True))
    a = A2.shape[1]
    _, sigma, Vt = np.linalg.svd(A2)
    smallest[:, 1] = sigma[:, -1]
    Z1, sigma, _ = np.linalg.svd(mass @ transpose(Vt)[:, :, a:], full_matrices=False)
    if a < mass.shape[1]:
        smallest[:, 2] = sigma[:, -1] / np.maximum(np.linalg.norm(mass, axis=(1, 2)), _TINY)
    require(
        smallest[:, 1:].min(axis=1) > max(rank_tol, _CLEAR * noise), smallest[:, 1:].min(axis=1)
    )
    return Stages(A2, f2, Z1, np.sqrt(size), tuple(found), smallest)


def _rounding(
    rounding: list[Array], squares: list[Array], residual: Array
) -> tuple[list[Array], list[Array]]:
    """Squared errors of [A_z, f_z], and of [E, A, f] of the next stage, from those before.

    ``squares`` are those of W1, W2, Wz, V and X, by which these are multiplied, ``residual`` that
    of what an error of X is multiplied with.
    """
    w1, w2, wz, v, x = squares
    (e_r, e_z), *wrong = ((w1 @ y, w2 @ y) for y in rounding)
    of_z = [wz @ (below + taylor_product(x, above)) for above, below in wrong]
    of_x = wz @ taylor_product(e_z @ v + taylor_product(x, e_r @ v), residual)
    of_z[0] = of_z[0] + of_x[: len(of_z[0])]
    return of_z, [_stacked(e_r, of_z[0]), *(
        _stacked(above[:-1], _slope(z, power=2)) for (above, _), z in zip(wrong, of_z, strict=True)
    )]


def _slope(a: Array, power: int = 1) -> Array:
    """Coefficients of the derivative, one order less; or, squared, of its errors."""
    return np.asarray(a[1:] * np.arange(1.0, len(a)).reshape(-1, 1, 1, 1) ** power)


def _stacked(above: Array, below: Array) -> Array:
    """Rows of matrices of Taylor coefficients."""
    orders = min(len(above), len(below))
    return np.concatenate([above[:orders], below[:orders]], axis=2)
