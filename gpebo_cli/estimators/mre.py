"""Memory regressor extension: Kreisselmeier's filters without mixing.

The worked example of how an estimator is added (docs/howto/estimator.md): this module and
``conf/estimator/mre.yaml`` are all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import ResumableEstimator, filtered_errors, gain
from gpebo_cli.estimators._mixed import reached
from gpebo_cli.estimators._recursive import KreisselmeierFilter, in_series, over_steps
from gpebo_cli.estimators._scalar import kreisselmeier
from gpebo_cli.estimators._vector import (
    VectorEstimates,
    VectorLaw,
    VectorRecursion,
    vector_estimates,
)
from gpebo_cli.kernels.laws_numpy import mean_decay
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.errors import EPS
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics, filtered, state_of
from gpebo_cli.regression.errors import ErrorRecursion, ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import SampledEstimates
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known, level_of
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import number


@dataclass(frozen=True, kw_only=True)
class MemoryExtension(ResumableEstimator):
    """η̂' = γ (𝒴 − Ω η̂) with Ω, 𝒴 from filters λ/(p + λ) of ψᵀψ, ψᵀY.

    One λ for all rows: Ω is then symmetric and positive semidefinite, which the law needs.

    Attributes:
        gamma: γ, also by parameter.
        rate: λ of the filters.
    """

    gamma: object = gain(100.0, by_parameter=True)
    rate: object = field(default=0.2, metadata={"key": "lambda"})

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> VectorEstimates:
        """Prepare the law for the times t (M,); a case is integrated when it is asked for."""
        extended = kreisselmeier(
            regression, self._rates(regression.p), known[0].values if known else None
        )
        state = reached(level_of(regression.outer.values), extended, known)
        return replace(self._estimates(regression, extended, t), reached=(state,))

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δ𝒴' = −λ(δ𝒴 − ψᵀδY), δη̂' = Γ(δ𝒴 − Ω δη̂), of every case."""
        p = regression.p
        rates = self._rates(p)
        extended = kreisselmeier(regression, rates, known[0].values if known else None)

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            into = rates[:, None] * transpose(regression.psi(t, inside))
            law = gain * extended(t, inside)[..., :p]
            return filtered_errors(rates, into, law, gain * np.eye(p))

        gains = self.gains("gamma", regression.parameters)
        return tuple(partial(at, np.broadcast_to(gain, p)[:, None]) for gain in gains)

    def estimate_moving(
        self, regression: LinearRegression, t: Array, known: Known, dynamics: Dynamics
    ) -> VectorEstimates:
        """η̂' = 𝔸η̂ + 𝕓 + Γ(𝒴 − Ω η̂) at the times t (M,)."""
        rates = self._rates(regression.p)
        extended = filtered(regression.outer, rates, rates, dynamics, known)
        plain = self._estimates(regression, extended, t)
        law = replace(plain.law, dynamics=dynamics)
        return replace(plain, law=law, reached=(state_of(extended, known),))

    def recursive(self, parameters: Sequence[str]) -> RecursiveMemoryExtension:
        """The estimator at samples."""
        return RecursiveMemoryExtension(
            self.start(parameters), self.gains("gamma", parameters), self._rates(len(parameters))
        )

    def _rates(self, p: int) -> Array:
        return np.full(p, number(self.rate, "estimator.lambda"))

    def _estimates(
        self, regression: LinearRegression, extended: Trajectory, t: Array
    ) -> VectorEstimates:
        mesh, values, p = extended.mesh, extended.values, regression.p
        omega, rhs = Trajectory(mesh, values[..., :p]), Trajectory(mesh, values[..., p:])
        law = VectorLaw(None, omega, rhs, regression.floor * regression.units)
        return vector_estimates(self, regression, law, omega, t)


class RecursiveMemoryExtension(VectorRecursion):
    """Filters of held signals, and the law over each sample for Ω and 𝒴 as they are on average."""

    def __init__(self, start: Array, gains: Array, rates: Array) -> None:
        super().__init__(start, gains)
        self._filter = KreisselmeierFilter(rates)
        self._before = np.zeros((1, len(start), len(start) + 1))

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each.

        With Γ^½ ∫Ω Γ^½ = V M Vᵀ a step is η̂ + Γ^½ V (1 − e^{−M})/M Vᵀ Γ^½ (∫𝒴 − ∫Ω η̂).
        """
        extended, p = self._filter.update(regression), regression.p
        whole = over_steps(regression, extended, self._before)
        self._before = extended[-1:]
        omega, roots = whole[..., :p], self.roots[:, None]
        M, V = np.linalg.eigh(roots[..., None] * omega * roots[..., None, :])
        known = (M - p * EPS * M[..., -1:]) > 0.0  # others are rounding
        V, M = roots[..., None] * (V * known[..., None, :]), np.maximum(M, 0.0)[..., None, :]
        L = (V * mean_decay(M)) @ transpose(V)  # the mean of e^{−x} over 0 to M
        shrunk = np.eye(p) + (V * np.expm1(-M)) @ (transpose(V) / roots[..., None, :] ** 2)
        eta, met = self.advance(L, shrunk, whole[..., p])

        def errors() -> tuple[ErrorRecursion, ...]:
            """δ𝒴 of the filters, δη̂' = (I − L∫Ω) δη̂ + L ∫δ𝒴, of every case."""
            own, eta_of = self._filter.errors(), np.eye(p, 2 * p, p)[None]
            old, new = (share[:, None, None] for share in regression.shares)
            return tuple(
                ErrorRecursion(*in_series(own, left, new * by, old * by), eta_of)
                for by, left in zip(L, shrunk, strict=True)
            )

        return SampledEstimates(eta, None, errors, met)


ESTIMATOR = MemoryExtension
