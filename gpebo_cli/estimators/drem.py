"""DREM as in the paper: Kreisselmeier extension, mixing, scalar gradient laws (Section V)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.estimators._following import follow
from gpebo_cli.estimators._mixed import FilteredEstimator, filter_rates
from gpebo_cli.estimators._vector import VectorEstimates
from gpebo_cli.model.descriptor import Array
from gpebo_cli.regression.dynamics import Dynamics, filtered
from gpebo_cli.regression.linear import LinearRegression


@dataclass(frozen=True, kw_only=True)
class Drem(FilteredEstimator):
    """Kreisselmeier filters, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Without noise η̃(t) = e^{−γ∫Δ²} η̃(0): it converges if and only if Δ is not square integrable.
    Interval excitation alone is not enough, because the filters forget.
    """

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
