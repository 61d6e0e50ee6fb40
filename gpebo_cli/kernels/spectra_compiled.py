"""As :mod:`spectra_numpy`, in C."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled, spectra_numpy
from gpebo_cli.kernels.arrays import Array

_SMALL = 8  # rows, up to which LAPACK's calls cost more than what they compute


def eigenvalues(matrices: Array) -> Array:
    """In C for small matrices of finite numbers."""
    found: Array | None = None
    if matrices.shape[1] <= _SMALL:
        found = _compiled.eigenvalues(matrices)
    return spectra_numpy.eigenvalues(matrices) if found is None else found
