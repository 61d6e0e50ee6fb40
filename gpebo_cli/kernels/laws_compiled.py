"""As :mod:`laws_numpy`, in C."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels import _compiled, laws_numpy
from gpebo_cli.kernels.arrays import Array

_SMALL = 16  # rows, up to which LAPACK's calls cost more than what they compute, and
_FEW = 64  # up to which its pivots do, which are needed where others are rounding

stepped_law = _compiled.stepped_law
squared_errors = _compiled.squared_errors


def mixed(extended: Array, added: Array | None) -> tuple[Array, Array, Array]:
    """In C for small Ω, and with r where nothing is rounding."""
    if extended.shape[1] > (_SMALL if added is None else _FEW):
        return laws_numpy.mixed(extended, added)
    found: tuple[Array, Array, Array] = _compiled.mixed(extended, added)
    if added is not None and (rest := ~np.isfinite(found[1]).all(axis=(1, 2))).any():
        found[1][rest] = laws_numpy.regularised(extended[rest], added[rest])
    return found
