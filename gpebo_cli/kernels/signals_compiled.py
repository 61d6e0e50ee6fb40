"""As :mod:`signals_numpy`, in C."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels import _compiled
from gpebo_cli.kernels.arrays import Array

_WIDE = 256  # columns, from which on a pass for each point is faster than one for each column

tails = _compiled.tails
interpolation = _compiled.interpolation
sample = _compiled.sample


def largest(values: Array) -> Array:
    """In C for few columns."""
    if values.shape[0] > 1 and values.shape[2] > _WIDE:
        return np.asarray(np.maximum(values.max(axis=1), -values.min(axis=1)))
    found: Array = _compiled.largest(values)
    return found
