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
