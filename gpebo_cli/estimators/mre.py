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
from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._mixed import reached
from gpebo_cli.estimators._vector import VectorEstimates, VectorLaw
from gpebo_cli.evidence.excitation import persistent
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import largest, transpose
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics, filtered
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState
from gpebo_cli.schema import number


@dataclass(frozen=True, kw_only=True)
class MemoryExtension(ResumableEstimator):
    """η̂' = γ (𝒴 − Ω η̂) with Ω, 𝒴 from filters λ/(p + λ) of ψᵀψ, ψᵀY.

    One λ for all rows: Ω is then symmetric and positive semidefinite, which the law needs.

    Attributes:
        gamma: γ; a number, a list (one case each), ``logspace(a, b, n)``, or a mapping by
            parameter (one gain each).
        rate: λ of the filters.
    """

    gamma: object = gain(100.0, by_parameter=True)
    rate: object = field(default=0.2, metadata={"key": "lambda"})

    def resume(
        self, regression: LinearRegression, t: Array, known: Sequence[ExtensionState]
    ) -> VectorEstimates:
        """Prepare the law for the times t (M,); a case is integrated when it is asked for."""
        extended = kreisselmeier(
            regression, self._rates(regression.p), known[0].values if known else None
        )
        state = reached(largest(regression.outer.values), extended, known)
        return replace(self._estimates(regression, extended, t), reached=(state,))

    def errors(
        self, regression: LinearRegression, known: Sequence[ExtensionState] = ()
    ) -> tuple[ErrorsAt, ...]:
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
        self, regression: LinearRegression, dynamics: Dynamics, t: Array
    ) -> VectorEstimates:
        """η̂' = 𝔸η̂ + 𝕓 + Γ(𝒴 − Ω η̂) at the times t (M,)."""
        rates = self._rates(regression.p)
        plain = self._estimates(regression, filtered(regression.outer, rates, rates, dynamics), t)
        return replace(plain, law=replace(plain.law, dynamics=dynamics))

    def _rates(self, p: int) -> Array:
        return np.full(p, number(self.rate, "estimator.lambda"))

    def _estimates(
        self, regression: LinearRegression, extended: Trajectory, t: Array
    ) -> VectorEstimates:
        p = regression.p
        mesh, values = extended.mesh, extended.values
        omega = Trajectory(mesh, values[..., :p])
        identity = np.broadcast_to(np.eye(p), values[..., :p].shape)
        gains = self.gains("gamma", regression.parameters)
        return VectorEstimates(
            law=VectorLaw(
                M=Trajectory(mesh, identity),
                N=omega,
                b=Trajectory(mesh, values[..., p:]),
                floor=regression.floor,
            ),
            start=self.start(regression.parameters),
            gains=gains,
            t=np.asarray(t),
            realisations=regression.realisations,
            requirement=persistent(omega, float(gains.min())),
        )


ESTIMATOR = MemoryExtension
