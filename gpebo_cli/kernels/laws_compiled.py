"""As :mod:`laws_numpy`, in C."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled, laws_numpy
from gpebo_cli.kernels.arrays import Array

_SMALL = 16  # rows, up to which LAPACK's calls cost more than what they compute

stepped_law = _compiled.stepped_law
squared_errors = _compiled.squared_errors


def mixed(extended: Array) -> tuple[Array, Array, Array]:
    """In C for small Ω."""
    if extended.shape[1] > _SMALL:
        return laws_numpy.mixed(extended)
    found: tuple[Array, Array, Array] = _compiled.mixed(extended)
    return found
