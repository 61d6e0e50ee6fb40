"""As :mod:`signals_numpy`, in C."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels import _compiled
from gpebo_cli.kernels.arrays import Array

tails = _compiled.tails
sample = _compiled.sample


def low_pass(D: Array, steps: Array, values: Array, rates: Array, start: Array) -> Array:
    """In C."""
    found: Array | None = _compiled.low_pass(D, steps, values, rates, start)
    if found is None:
        raise np.linalg.LinAlgError("a pivot is zero")
    return found
