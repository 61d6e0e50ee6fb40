"""As :mod:`elements_numpy`, in C."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpebo_cli.kernels import _compiled, elements_numpy
from gpebo_cli.kernels.arrays import Array, IntArray

# Up to these sizes C is faster than calls of LAPACK and BLAS: at them by a quarter, for one
# component ten times (24 elements of 14 stages; one core with AVX-512).
_SMALL_SYSTEM = 100  # unknowns of an element
_SMALL_STATE = 16  # components, and
_SMALL_VALUE = 200  # components times columns


def _is_small(n: int, columns: int) -> bool:
    return n <= _SMALL_STATE and n * columns <= _SMALL_VALUE


def element_maps(
    D: Array, h: Array, E: Array | None, A: Array, f: Array, basis: Array | None,
    offset: Array | None, group: IntArray, groups: int,
) -> tuple[Array, Array]:
    """In C for small systems."""
    arguments = D, h, E, A, f, basis, offset, group, groups
    unknowns = len(D) * A.shape[1]
    if unknowns > _SMALL_SYSTEM or not _is_small(A.shape[2], f.shape[2]):
        return elements_numpy.element_maps(*arguments)
    found: tuple[Array, Array] | None = _compiled.element_maps(*arguments)
    if found is None:
        raise np.linalg.LinAlgError("a pivot is zero")
    return found


def chain(
    homogeneous: Array, particular: Array, start: Array,
    renew: Callable[[Array], Array] | None = None,
) -> tuple[Array, int]:
    """In C for few components that nothing replaces."""
    if renew is not None or not _is_small(*start.shape):
        return elements_numpy.chain(homogeneous, particular, start, renew)
    values, whole = _compiled.chain(homogeneous, particular, start)
    return values, int(whole[0])


def carried_errors(
    values: Array, to_legendre: Array, powers: Array, last: Array, particular: Array, noise: Array,
    signs: Array, h: Array, level: float, end: float, chance: float, same: float,
    renew: Callable[[Array, Array], Array] | None = None,
) -> tuple[Array, Array]:
    """In C for few components that nothing replaces."""
    arguments = (
        values, to_legendre, powers, last, particular, noise, signs, h, level, end, chance, same
    )
    if renew is not None or not _is_small(*values.shape[2:]):
        return elements_numpy.carried_errors(*arguments, renew)
    found: tuple[Array, Array] = _compiled.carried_errors(*arguments)
    return found


def sweeps(
    R: Array, h: Array, rows: IntArray, indices: IntArray, entries: Array, f: Array,
    kicks: Array | None, onward: Array, start: Array, weights: Array, tol: float,
    share: float, most: int,
) -> tuple[Array, Array]:
    """In C, where each row uses those before it."""
    found: tuple[Array, Array] = _compiled.sweeps(
        R, h, rows, indices, entries, f, kicks, onward, start, weights, tol, share, most
    )
    return found


def substituted(
    left: Array, place: IntArray, target: IntArray, source: IntArray, block: IntArray, full: Array,
    diagonal: Array, f: Array, kicks: Array | None, start: Array,
) -> Array:
    """In C."""
    found: Array = _compiled.substituted(
        left, place, target, source, block, full, diagonal, f, kicks, start
    )
    return found
