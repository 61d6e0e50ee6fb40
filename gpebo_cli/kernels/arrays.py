"""What kernels take and return, and what their NumPy forms share."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def joined(*parts: Array, axis: int) -> Array:
    """Blocks (N or 1, a, b) side by side (axis 2) or stacked (axis 1); those of one time repeat."""
    count = max(map(len, parts))
    return np.concatenate(
        [p if len(p) == count else np.broadcast_to(p, (count, *p.shape[1:])) for p in parts],
        axis=axis,
    )


def inverses(matrices: Array) -> Array:
    """Inverses (N, n, n), infinite where there is none."""
    try:
        return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        out = np.full_like(matrices, np.inf)
        for k, one in enumerate(matrices):
            with suppress(np.linalg.LinAlgError):
                out[k] = np.linalg.inv(one)
        return out


def axes_of(columns: Array) -> IntArray | slice | None:
    """Which coordinate axes columns (n, d) are, None where they are something else."""
    if np.count_nonzero(columns) != columns.shape[1] or not (columns.sum(axis=0) == 1.0).all():
        return None
    axes = columns.argmax(axis=0)
    one_by_one = len(axes) > 0 and (np.diff(axes) == 1).all()  # then nothing is copied
    return slice(axes[0], axes[-1] + 1) if one_by_one else axes


def across(matrix: Array, columns: Array) -> Array:
    """The product with columns (n, d), of which coordinate axes only choose."""
    axes = axes_of(columns)
    return matrix @ columns if axes is None else matrix[:, :, axes]


def down(rows: Array, matrix: Array) -> Array:
    """The product of rows (d, n) with a matrix, in the same way."""
    axes = axes_of(rows.T)
    return rows @ matrix if axes is None else matrix[:, axes]
