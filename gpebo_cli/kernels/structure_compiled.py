"""As :mod:`structure_numpy`, in C for small derivative arrays."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled, structure_numpy
from gpebo_cli.kernels.arrays import Array, IntArray

_SMALL = 32  # rows of M; beyond it LAPACK's blocks are worth its calls


def levels(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int, rank_tol: float,
    constraints: int,
) -> tuple[Array, Array]:
    """In C, unless singular values and elimination do not see the same rank."""
    arguments = E, A, rows, columns, time, orders, rank_tol, constraints
    found: tuple[Array, Array] | None = None
    if orders * len(rows) <= _SMALL:
        found = _compiled.levels(*arguments)
    return structure_numpy.levels(*arguments) if found is None else found


def reference(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int, place: int,
    rank_tol: float,
) -> tuple[int, Array, IntArray, IntArray, Array]:
    """In C, unless singular values and elimination do not see the same rank."""
    arguments = E, A, rows, columns, time, orders, place, rank_tol
    found = _compiled.reference(*arguments) if orders * len(rows) <= _SMALL else None
    if found is None:
        return structure_numpy.reference(*arguments)
    count, smallest, first, second, Z1 = found
    a = int(count[0])
    return a, smallest, first, second, Z1[: max(0, len(rows) - a)].T.copy()


def bounds(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int,
    pivot_rows: IntArray, pivot_columns: IntArray, rank: int, Z1: Array,
) -> tuple[Array, Array, Array]:
    """In C."""
    small = orders * len(rows) <= _SMALL
    found: tuple[Array, Array, Array] = (_compiled if small else structure_numpy).bounds(
        E, A, rows, columns, time, orders, pivot_rows, pivot_columns, rank, Z1
    )
    return found


def eliminated(
    E: Array, A: Array, rows: Array, columns: Array, time: float, orders: int, B: Array, F: Array,
    u: Array, theta: Array, pivot_rows: IntArray, pivot_columns: IntArray, rank: int, Z1: Array,
    every: int, growth: float, residual: float,
) -> tuple[Array, ...] | None:
    """In C; None where the elimination fails is the answer of both."""
    small = orders * len(rows) <= _SMALL
    found: tuple[Array, ...] | None = (_compiled if small else structure_numpy).eliminated(
        E, A, rows, columns, time, orders, B, F, u, theta, pivot_rows, pivot_columns, rank, Z1,
        every, growth, residual,
    )
    return found
