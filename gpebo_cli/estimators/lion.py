"""DREM with the LTI extension of Lion: filtered copies of the regressor itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.estimators._extension import lion
from gpebo_cli.estimators._mixed import FilteredEstimator
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import largest
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.linear import LinearRegression


@dataclass(frozen=True, kw_only=True)
class Lion(FilteredEstimator):
    """Filters λ_i/(p + λ_i) of ψ and Y, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    The rates must differ from one another.
    """

    def extend(self, regression: LinearRegression, rates: Array, start: Array | None) -> Trajectory:
        """Filtered rows of [ψ | Y], shape (p, p + c)."""
        return lion(regression, rates, start)

    def seen(self, psi: Array) -> Array:
        """Row i takes row i mod r of the regression: (N, p, rows) of ψ (N, rows, p)."""
        rows, p = psi.shape[1:]
        return np.broadcast_to(np.eye(rows)[np.arange(p) % rows], (len(psi), p, rows))

    def size(self, regression: LinearRegression) -> float:
        """The size of p rows of ψ, which no filter exceeds."""
        return float(np.sqrt(regression.p * largest(regression.outer.values)))


ESTIMATOR = Lion
