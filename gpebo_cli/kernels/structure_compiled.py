"""As :mod:`structure_numpy`, in C for small derivative arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gpebo_cli.kernels import _compiled, structure_numpy
from gpebo_cli.kernels.arrays import Array, IntArray

_SMALL = 32  # rows of M; beyond it LAPACK's blocks are worth its calls


def _for_small(name: str, *, declines: bool = False) -> Callable[..., Any]:
    """A function in C up to this size, unless it ``declines`` for numbers that are not for it."""
    compiled = getattr(_compiled, name)

    def either(E: Array, A: Array, rows: Array, *more: Any) -> Any:  # columns, time, orders, …
        small = more[2] * len(rows) <= _SMALL
        found = compiled(E, A, rows, *more) if small else None
        if found is None and (declines or not small):
            return getattr(structure_numpy, name)(E, A, rows, *more)
        return found

    either.__doc__ = f"{name}: in C for small arrays."
    return either


# Singular values and elimination need not see the same rank.
levels, _reference = (_for_small(name, declines=True) for name in ("levels", "reference"))
bounds, eliminated = map(_for_small, ("bounds", "eliminated"))


def reference(
    E: Array, A: Array, rows: Array, *more: Any
) -> tuple[int, Array, IntArray, IntArray, Array]:
    """As the others; what C returns is put into the same form."""
    count, smallest, first, second, Z1 = _reference(E, A, rows, *more)
    if isinstance(count, int):
        return count, smallest, first, second, Z1
    a = int(count[0])
    first, second = ((flags == 0).argsort(kind="stable") for flags in (first, second))
    return a, smallest, first, second, Z1[: max(0, len(rows) - a)].T.copy()
