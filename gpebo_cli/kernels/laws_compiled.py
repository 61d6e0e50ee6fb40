"""As :mod:`laws_numpy`, in C."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels import _compiled, laws_numpy
from gpebo_cli.kernels.arrays import Array

_FEW = 64  # rows, up to which LAPACK's calls and pivots cost more than elimination in C

stepped_law = _compiled.stepped_law
squared_errors = _compiled.squared_errors


def mixed(extended: Array, added: Array | None) -> tuple[Array, Array, Array]:
    """In C for small Ω, and with r where nothing is rounding."""
    if extended.shape[1] > _FEW:
        return laws_numpy.mixed(extended, added)
    found: tuple[Array, Array, Array] = _compiled.mixed(extended, added)
    if added is not None and (rest := ~np.isfinite(found[1]).all(axis=(1, 2))).any():
        found[1][rest] = laws_numpy.regularised(extended[rest], added[rest])
    return found
