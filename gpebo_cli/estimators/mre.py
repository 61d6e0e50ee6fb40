"""Memory regressor extension: Kreisselmeier's filters without mixing.

The worked example of how an estimator is added (docs/howto/estimator.md): this module and
``conf/estimator/mre.yaml`` are all of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.estimators._base import combinations, number, per_parameter
from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._mixed import gain_axis, gain_matrix
from gpebo_cli.estimators._vector import VectorEstimates, VectorLaw
from gpebo_cli.excitation import persistent
from gpebo_cli.regression import LinearRegression
from gpebo_cli.systems.descriptor import Array


@dataclass(frozen=True)
class MemoryExtension:
    """η̂' = γ (𝒴 − Ω η̂) with Ω, 𝒴 from filters λ/(p + λ) of ψᵀψ, ψᵀY.

    One λ for all rows: Ω is then symmetric and positive semidefinite, which the law needs.

    Attributes:
        gamma: γ; a number, a list (one case each), ``logspace(a, b, n)``, or a mapping by
            parameter (one gain each).
        rate: λ of the filters.
        initial: η̂ at the start, a number, one per parameter, or a mapping by parameter.
    """

    gamma: object = 100.0
    rate: object = field(default=0.2, metadata={"key": "lambda"})
    initial: object = 0.0

    @property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """One case per gain; a gain per parameter is one case."""
        return combinations(gain_axis(self.gamma, "estimator.gamma"))

    def estimate(self, regression: LinearRegression, t: Array) -> VectorEstimates:
        """Prepare the law for the times t (M,); a case is integrated when it is asked for."""
        p = regression.p
        rate = number(self.rate, "estimator.lambda")
        extended = kreisselmeier(regression, np.full(p, rate))
        mesh, values = extended.mesh, extended.values
        omega = Trajectory(mesh, values[..., :p])
        identity = np.broadcast_to(np.eye(p), values[..., :p].shape)
        gains = gain_matrix(self.gamma, regression.parameters, "estimator.gamma")
        return VectorEstimates(
            law=VectorLaw(
                M=Trajectory(mesh, identity),
                N=omega,
                b=Trajectory(mesh, values[..., p:]),
            ),
            start=per_parameter(self.initial, regression.parameters, "estimator.initial"),
            gains=gains,
            t=np.asarray(t),
            realisations=regression.realisations,
            requirement=persistent(omega, float(gains.min())),
        )


ESTIMATOR = MemoryExtension
