"""Derivative arrays of a descriptor system: ranks at single times, elimination at many.

Kunkel & Mehrmann, Differential-Algebraic Equations (EMS 2006), chapter 3: E x' = A x + f is
differentiated μ times. In Taylor coefficients e_k = E^(k)/k!, a_k = A^(k)/k!, x_k = x^(k)/k!, …, in
scaled rows, states and time, this is M (x_1, …, x_{μ+1}) = N x_0 + g, free of binomials, with

    M_ij = (j + 1) e_{i−j} − a_{i−j−1},   N_i = a_i,   g_i = f_i,   i, j = 0 … μ.

With the rows and columns that carry the rank of M at one time in front, Z2ᵀ = [−X I] with
X = M21 M11⁻¹ is a left kernel of M at the others, and Â2 = Z2ᵀN are the constraints. A function
takes the model as E, A (orders, N or 1, n, n), scales of rows and columns (n,), the unit of time,
and the number μ + 1 of orders that are used.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpebo_cli.kernels.arrays import Array, BoolArray, IntArray, inverses

_TINY = float(np.finfo(float).tiny)
_ROUNDING = 1e-13  # of a basis of which columns have one entry of 1 each


def scaled(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int
) -> tuple[Array, Array]:
    """Taylor coefficients of E and A, (K, N, n, n), in scaled rows, states and time."""
    powers = time ** np.arange(orders, dtype=np.float64)[:, None, None, None]
    weight = rows[:, None] * columns
    return E[:orders] * weight * powers / time, A[:orders] * weight * powers


def derivative_array(e: Array, a: Array, mu: int) -> tuple[Array, Array]:
    """M (N, (μ+1) n, (μ+1) n) and N (N, (μ+1) n, n) from Taylor coefficients (K + 1, N, n, n)."""
    count, n = max(e.shape[1], a.shape[1]), e.shape[2]
    M = np.zeros((count, mu + 1, n, mu + 1, n))
    for i in range(mu + 1):
        for j in range(i + 1):
            M[:, i, :, j] = (j + 1) * e[i - j]
            if i - j - 1 >= 0:
                M[:, i, :, j] -= a[i - j - 1]
    N = np.moveaxis(a[: mu + 1], 0, 1).reshape(a.shape[1], (mu + 1) * n, n)
    return M.reshape(count, (mu + 1) * n, (mu + 1) * n), N


def array_size(M: Array, a: Array) -> Array:
    """Size (N,) of what the derivative array M (N,) was made from, A (K, N, n, n) included.

    With E = 0 it is still judged against A.
    """
    size = np.maximum(M, np.abs(a).max(axis=(0, 2, 3)))
    return np.asarray(np.maximum(size, _TINY))  # a plant of zeros has none


def levels(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int, rank_tol: float,
    constraints: int,
) -> tuple[Array, Array]:
    """How many constraints there are (N,), and the singular values that must not be zero (N, 3).

    These are the smallest of M, Â2 and E T2 that count, relative to the size of their factors;
    infinite where there is none, and not determined where there are more constraints than states.
    Singular values below ``rank_tol``, relative, are zero; so many as ``constraints`` says belong
    to constraints, whatever they are; −1: as many as are zero.
    """
    counts, smallest, _ = _levels(*scaled(E, A, rows, columns, time, orders), rank_tol, constraints)
    return counts.astype(np.float64), smallest


def _levels(
    e: Array, a: Array, rank_tol: float, constraints: int
) -> tuple[IntArray, Array, Array]:
    """:func:`levels` of scaled coefficients, and T2 where there are as many constraints as most."""
    n = e.shape[2]
    M, N = derivative_array(e, a, len(e) - 1)
    U, sigma, _ = np.linalg.svd(M)
    relative = sigma / array_size(sigma[:, 0], a)[:, None]
    counts = np.full(len(M), constraints)
    if constraints < 0:
        counts = M.shape[1] - (relative > rank_tol).sum(axis=1)
    smallest, T2 = np.full((len(M), 3), np.inf), np.zeros((1, n, 0))
    for count in np.unique(counts[counts <= n]):
        same, r = counts == count, M.shape[1] - int(count)
        if r:
            smallest[same, 0] = relative[same, r - 1]
        of_N = N if len(N) == 1 else N[same]
        _, s2, V2 = np.linalg.svd(np.swapaxes(U[same, :, r:], 1, 2) @ of_N)
        if count:
            smallest[same, 1] = s2[:, -1] / frobenius_norm(of_N)
        T2 = np.swapaxes(V2, 1, 2)[:, :, count:]
        if count < n:
            of_E = e[0] if e.shape[1] == 1 else e[0, same]
            s3 = np.linalg.svd(of_E @ T2, compute_uv=False)
            smallest[same, 2] = s3[:, -1] / frobenius_norm(of_E)
    return counts, smallest, T2


def reference(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int, place: int,
    rank_tol: float,
) -> tuple[int, Array, IntArray, IntArray, Array]:
    """Where elimination at other times starts from: :func:`levels` and pivots at one ``place``.

    They are the number of constraints a; the singular values (3,); all rows and all columns of M,
    those that carry its rank first; and Z1 (n, d), an orthonormal basis of range(E T2). With more
    constraints than states only the first one means something.
    """
    E, A = (x if x.shape[1] == 1 else x[:, place : place + 1] for x in (E, A))
    e, a = scaled(E, A, rows, columns, time, orders)
    counts, smallest, T2 = _levels(e, a, rank_tol, -1)
    count, M = int(counts[0]), derivative_array(e, a, orders - 1)[0][0]
    if count > len(rows):
        everything = np.arange(len(M))
        return count, smallest[0], everything, everything, np.zeros((len(rows), 0))
    Z1 = _with_zeros(np.linalg.svd(e[0, 0] @ T2[0], full_matrices=False)[0])
    return count, smallest[0], *_pivots(M, len(M) - count), Z1


def _with_zeros(basis: Array) -> Array:
    """An orthonormal basis (n, d) of the same range, where unconnected states stay apart.

    Singular vectors mix them, and then the rounding of one is in all of the others.
    """
    axes = _pivots(basis @ basis.T, basis.shape[1])[0][: basis.shape[1]]
    found = basis @ inverses(basis[None, axes])[0]
    return np.linalg.qr(np.where(np.abs(found) > _ROUNDING, found, 0.0))[0]


def _pivots(matrix: Array, count: int) -> tuple[IntArray, IntArray]:
    """All rows and columns, ``count`` that carry the rank first: elimination, complete pivoting."""
    left = matrix.copy()
    chosen = np.zeros((2, len(matrix)), dtype=bool)
    for _ in range(count):
        i, j = divmod(int(np.abs(left).argmax()), len(left))
        chosen[0, i] = chosen[1, j] = True
        left -= left[:, j, None] * (left[i] / left[i, j])
        left[i], left[:, j] = 0.0, 0.0
    first, second = np.argsort(~chosen, axis=1, kind="stable")
    return first, second


def frobenius_norm(matrix: Array) -> Array:
    """Frobenius norms (N,) of matrices (N, i, j), at least the smallest positive number."""
    return np.asarray(np.sqrt(np.einsum("nij,nij->n", matrix, matrix)) + _TINY)


def bounds(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int,
    pivot_rows: IntArray, pivot_columns: IntArray, rank: int, Z1: Array,
) -> tuple[Array, Array, Array]:
    """Lower bounds of the singular values of :func:`levels` at N times, by elimination.

    With W = [Z1ᵀE; Â2],

        σ_r(M) ≥ 1/‖M11⁻¹‖,      σ_min(Â2) ≥ 1/(‖W⁻¹‖ ‖Z2‖),      σ_min(E T2) ≥ 1/‖W⁻¹‖.

    Returns:
        the bounds (N, 3), zero or NaN where a block is singular; what the elimination leaves of M21
        and M22 relative to the size of M (N,); and the dynamics Z1ᵀA T (N, d, d), T being the first
        columns of W⁻¹.
    """
    e, a = scaled(E, A, rows, columns, time, orders)
    M, N = derivative_array(e, a, orders - 1)
    r, d = rank, Z1.shape[1]
    n = len(rows)
    M, N = M[:, pivot_rows[:, None], pivot_columns], N[:, pivot_rows]
    found = np.full((len(M), 3), np.inf)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        inverse = inverses(M[:, :r, :r])
        X = M[:, r:, :r] @ inverse
        whole = np.concatenate(
            [np.broadcast_to(Z1.T @ e[0], (len(M), d, n)), N[:, r:] - X @ N[:, :r]], axis=1
        )
        states = inverses(whole)
        determined, size = frobenius_norm(states), array_size(frobenius_norm(M), a)
        if r:
            found[:, 0] = 1.0 / (frobenius_norm(inverse) * size)
        if d < n:
            spread = np.sqrt(n - d + frobenius_norm(X) ** 2)
            found[:, 1] = 1.0 / (determined * spread * frobenius_norm(N))
        if d:
            found[:, 2] = 1.0 / (determined * frobenius_norm(e[0]))
        left = frobenius_norm(M[:, r:] - X @ M[:, :r]) / size
        return found, left, Z1.T @ a[0] @ states[:, :, :d]


def by_elimination(
    E: Array, M: Array, N: Array, g: Array, pivot_rows: IntArray, pivot_columns: IntArray,
    rank: int, Z1: Array, every: int, growth: float, residual: float,
) -> tuple[Array, Array, Array, Array, BoolArray]:
    """Â2 (N or 1, a, n), f2 (N, a, 1), sizes of the terms of both, [Z1ᵀE; Â2]⁻¹, where it failed.

    Sizes are those at every so many times; elimination fails where it grows more than ``growth``
    or leaves more than ``residual``.
    """
    count, n, r = len(M), E.shape[1], rank
    some = slice(0, None, every)
    right = np.concatenate([np.broadcast_to(N, (len(g), *N.shape[1:])), g], axis=2)[:, pivot_rows]
    M = M[:, pivot_rows[:, None], pivot_columns]
    with np.errstate(invalid="ignore", over="ignore"):
        inverse = inverses(M[:, :r, :r])
        X = M[:, r:, :r] @ inverse
        left = frobenius_norm(M[:, r:] - X @ M[:, :r])
        poor = ~((left <= residual * frobenius_norm(M)) & (frobenius_norm(X) <= growth))
        X[poor], inverse[poor] = 0.0, 0.0
        constraints = right[:, r:] - X @ right[:, :r]
        # What rounding of M leaves of the higher derivatives, which it should eliminate, counts.
        seen = some if count > 1 else slice(1)
        pivot = np.abs(M[seen, :r, :r])
        derivatives = np.abs(inverse[seen] @ right[some, :r])
        through = np.abs(right[some, :r]) + 2.0 * pivot @ derivatives
        size = np.abs(right[some, r:]) + np.abs(X[seen]) @ through
        A2 = constraints[:count, :, :n].copy()
        whole = np.concatenate([np.broadcast_to(Z1.T @ E, (count, Z1.shape[1], n)), A2], axis=1)
        scale = np.maximum(np.abs(whole).max(axis=2, initial=0.0), _TINY)
        inverse = inverses(whole / scale[:, :, None])
        poor |= ~(frobenius_norm(inverse) <= growth)
    return A2, constraints[:, :, n:].copy(), size, inverse / scale[:, None, :], poor


def eliminated(*_: Any) -> tuple[Array, ...] | None:
    """E1 x' = A1 x + f1 and 0 = Â2 x + f2 in the model's own states, at N times.

    With the coefficients of f = B u + F θ, B (orders, N or 1, n, m), F (…, n, q), u (…, m) and θ
    (…, q), and the pivots of :func:`bounds`. The amplification is looked at at ``every`` so many
    times; ``growth`` of the elimination and its relative ``residual`` are limits.

    Returns:
        E1, A1 (N, d, n), f1 (N, d), Â2 (N, a, n), f2 (N, a), T (N, n, d) and offset (N, n) of the
        consistent states T z + offset with z = E1 x, and by how much relative rounding of each
        state, and of 1, reaches each state through the constraints (n, n + 1). Matrices come at one
        time where E and A do. None where the elimination fails at some time, and without C: the
        caller then takes :func:`by_elimination` and :func:`in_own_states`.
    """
    return None


def in_own_states(
    E: Array, A: Array, f: Array, A2: Array, f2: Array, size: Array, inverse: Array,
    rows: Array, columns: Array, every: int,
) -> tuple[Array, ...]:
    """What :func:`eliminated` returns, from Â2 (N, a, n) in scaled form and [Z1ᵀE; Â2]⁻¹ = [T P].

    Only rows stay scaled, and row scalings do not matter. E, A and f are those of the model.
    """
    d = E.shape[1] - A2.shape[1]
    # With Z1 of one time the equations would be nearly lost where range(E T) is nearly at a right
    # angle to it, and beside them what polynomials leave out of the constraints' derivatives.
    inverse = columns[:, None] * inverse
    Q, R = np.linalg.qr(rows[:, None] * E @ inverse[:, :, :d])
    signs = np.copysign(1.0, np.diagonal(R, axis1=1, axis2=2))
    Q, R = Q * signs[:, None], R * signs[:, :, None]
    T, W1 = inverse[:, :, :d] @ inverses(R), np.swapaxes(Q, 1, 2) * rows
    E1, A2 = W1 @ E, A2 / columns
    of_f2 = inverse[:, :, d:] - T @ (E1 @ inverse[:, :, d:])
    amplification = (np.abs(of_f2[::every]) @ size).max(axis=0)
    amplification[:, :-1] /= columns
    offset = -(of_f2 @ f2)
    # Of components beside which others are large the inverse leaves rounding of these.
    offset -= T @ (E1 @ offset) + of_f2 @ (A2 @ offset + f2)
    return (
        E1, W1 @ A, np.matmul(W1, f[:, :, None])[:, :, 0], A2, f2[:, :, 0], T, offset[:, :, 0],
        amplification,
    )
