"""As :mod:`elements_numpy`, in C."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gpebo_cli.kernels import _compiled, elements_numpy
from gpebo_cli.kernels.arrays import Array

# Up to these sizes C is faster than calls of LAPACK and BLAS: at them by a quarter, for one
# component ten times (24 elements of 14 stages; one core with AVX-512).
_SMALL_SYSTEM = 100  # unknowns of an element
_SMALL_STATE = 16  # components, and
_SMALL_VALUE = 200  # components times columns


def _is_small(n: int, columns: int) -> bool:
    return n <= _SMALL_STATE and n * columns <= _SMALL_VALUE


def element_maps(*arguments: Any) -> tuple[Array, Array]:
    """In C for small systems."""
    D, _, _, A, f, *_ = arguments
    if len(D) * A.shape[1] > _SMALL_SYSTEM or not _is_small(A.shape[2], f.shape[2]):
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


def carried_errors(values: Array, *others: Any) -> Any:
    """In C for few components."""
    either = _compiled if _is_small(*values.shape[2:]) else elements_numpy
    return either.carried_errors(values, *others)


series = _compiled.series
stiff = _compiled.stiff
