"""DREM as in the paper: Kreisselmeier extension, mixing, scalar gradient laws (Section V)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gpebo_cli.estimators._base import combinations, per_parameter
from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._following import FollowingEstimates, follow
from gpebo_cli.estimators._mixed import (
    MixedEstimates,
    energy_requirement,
    estimate_mixed,
    filter_rates,
    gain_axis,
    gain_matrix,
)
from gpebo_cli.estimators._recursive import (
    KreisselmeierFilter,
    SampledEstimates,
    ScalarLaw,
    mix_sampled,
)
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.regression.dynamics import Dynamics, filtered
from gpebo_cli.regression.linear import ExtensionState, LinearRegression, SampledRegression


@dataclass(frozen=True)
class Drem:
    """Kreisselmeier filters, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Without noise η̃(t) = e^{−γ∫Δ²} η̃(0): it converges if and only if Δ is not square integrable.
    Interval excitation alone is not enough, because the filters forget.

    Attributes:
        gamma: γ, a number, a list (one case each), ``logspace(a, b, n)``, or a mapping by
            parameter (one gain each).
        rates: λ of the filters, a number, one per parameter, or a mapping by parameter; None is
            0.1, 0.2, 0.3, …, for three parameters the paper's choice.
        initial: η̂ at the start, a number, one per parameter, or a mapping by parameter.
    """

    gamma: object = 1e10
    rates: object = field(default=None, metadata={"key": "lambda"})
    initial: object = 0.0

    @property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """One case per gain; a gain per parameter is one case."""
        return combinations(gain_axis(self.gamma, "estimator.gamma"))

    def recursive(self, parameters: Sequence[str]) -> RecursiveDrem:
        """The same at samples."""
        return RecursiveDrem(self, parameters)

    def estimate(
        self, regression: LinearRegression, t: Array, known: Sequence[ExtensionState] = ()
    ) -> MixedEstimates:
        """Extend, mix, and keep what the closed form needs at the times t (M,)."""
        return estimate_mixed(regression, t, kreisselmeier, self, known)

    def estimate_moving(
        self, regression: LinearRegression, dynamics: Dynamics, t: Array
    ) -> FollowingEstimates:
        """η̂' = 𝔸η̂ + 𝕓 + ΓΔ (𝐘 − Δ η̂) at the times t (M,).

        It follows where γΔ² exceeds the growth of η.
        """
        names = regression.parameters
        rates = filter_rates(self.rates, names)
        extended = filtered(regression.outer, rates, rates, dynamics)
        gains = gain_matrix(self.gamma, names, "estimator.gamma")
        start = per_parameter(self.initial, names, "estimator.initial")
        return follow(extended, dynamics, start, gains, np.asarray(t))


class RecursiveDrem:
    """DREM at samples: filters of held signals, mixing, a closed-form step of the scalar law."""

    def __init__(self, settings: Drem, parameters: Sequence[str]) -> None:
        names = tuple(parameters)
        self._filter = KreisselmeierFilter(filter_rates(settings.rates, names))
        self._gains = gain_matrix(settings.gamma, names, "estimator.gamma")
        start = per_parameter(settings.initial, names, "estimator.initial")
        self._law = ScalarLaw(start, self._gains, 1)

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each."""
        return self._law.update(regression, *mix_sampled(self._filter.update(regression)))

    @property
    def requirement(self) -> Requirement:
        """γ∫Δ² so far."""
        energy = float(self._law.energy[0])
        return energy_requirement("Δ not in L2", float(self._gains.min()), energy)


ESTIMATOR = Drem
