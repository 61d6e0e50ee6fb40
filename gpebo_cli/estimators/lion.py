"""DREM with the LTI extension of Lion: filtered copies of the regressor itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from gpebo_cli.estimators._base import combinations
from gpebo_cli.estimators._extension import lion
from gpebo_cli.estimators._mixed import MixedEstimates, estimate_mixed, gain_axis
from gpebo_cli.model.descriptor import Array
from gpebo_cli.regression.linear import ExtensionState, LinearRegression


@dataclass(frozen=True)
class Lion:
    """Filters λ_i/(p + λ_i) of ψ and Y, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    The attributes are those of ``drem``; the rates must differ from one another.
    """

    gamma: object = 1e10
    rates: object = field(default=None, metadata={"key": "lambda"})
    initial: object = 0.0

    @property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """One case per gain; a gain per parameter is one case."""
        return combinations(gain_axis(self.gamma, "estimator.gamma"))

    def estimate(
        self, regression: LinearRegression, t: Array, known: Sequence[ExtensionState] = ()
    ) -> MixedEstimates:
        """Extend, mix, and keep what the closed form needs at the times t (M,)."""
        return estimate_mixed(regression, t, lion, self, known, linear=True)


ESTIMATOR = Lion
