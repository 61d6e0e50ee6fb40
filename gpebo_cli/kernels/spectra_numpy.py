"""Eigenvalues of small symmetric matrices."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels.arrays import Array


def eigenvalues(matrices: Array) -> Array:
    """Of symmetric matrices (N, p, p), ascending (N, p); further columns are not looked at."""
    return np.asarray(np.linalg.eigvalsh(matrices[..., : matrices.shape[1]]), dtype=np.float64)
