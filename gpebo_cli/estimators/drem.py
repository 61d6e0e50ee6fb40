"""DREM as in the paper: Kreisselmeier extension, mixing, scalar gradient laws (Section V)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._following import follow
from gpebo_cli.estimators._mixed import FilteredEstimator, filter_rates
from gpebo_cli.estimators._vector import VectorEstimates
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import largest, transpose
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics, filtered
from gpebo_cli.regression.linear import LinearRegression


@dataclass(frozen=True, kw_only=True)
class Drem(FilteredEstimator):
    """Kreisselmeier filters, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Without noise η̃(t) = e^{−γ∫Δ²} η̃(0): it converges if and only if Δ is not square integrable.
    Interval excitation alone is not enough, because the filters forget.
    """

    def extend(self, regression: LinearRegression, rates: Array, start: Array | None) -> Trajectory:
        """Filtered [ψᵀψ | ψᵀY], shape (p, p + c)."""
        return kreisselmeier(regression, rates, start)

    def seen(self, psi: Array) -> Array:
        """ψᵀ (N, p, rows) of ψ (N, rows, p)."""
        return transpose(psi)

    def size(self, regression: LinearRegression) -> float:
        """The size of ψᵀψ, which no filter exceeds."""
        return largest(regression.outer.values)

    def estimate_moving(
        self, regression: LinearRegression, dynamics: Dynamics, t: Array
    ) -> VectorEstimates:
        """η̂' = 𝔸η̂ + 𝕓 + ΓΔ (𝐘 − Δ η̂) at the times t (M,).

        It follows where γΔ² exceeds the growth of η.
        """
        names = regression.parameters
        rates = filter_rates(self.rates, names)
        extended = filtered(regression.outer, rates, rates, dynamics)
        return follow(
            extended, dynamics, self.start(names), self.gains("gamma", names), np.asarray(t)
        )


ESTIMATOR = Drem
