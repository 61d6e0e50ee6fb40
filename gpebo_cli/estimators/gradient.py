"""The classical gradient estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import ResumableEstimator, gain
from gpebo_cli.estimators._vector import (
    VectorEstimates,
    VectorLaw,
    VectorRecursion,
    vector_estimates,
)
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.errors import EPS
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.errors import ErrorRecursion, ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import SampledEstimates
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known
from gpebo_cli.regression.samples import SampledRegression

_ALL = 10.0  # σ from which on e^{−σ²} is nothing


@dataclass(frozen=True, kw_only=True)
class Gradient(ResumableEstimator):
    """η̂' = γ ψᵀ(Y − ψη̂): converges exponentially if and only if ψ is persistently exciting.

    Attributes:
        gamma: γ, also by parameter.
    """

    gamma: object = gain(10.0, by_parameter=True)

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> VectorEstimates:  # noqa: ARG002
        """Prepare the law for the times t (M,); a case is integrated when it is asked for."""
        information = Trajectory(regression.mesh, regression.outer.values[..., : regression.p])
        floor = regression.floor * regression.units
        law = VectorLaw(regression.psi, regression.psi, regression.Y, floor)
        return vector_estimates(self, regression, law, information, t)

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:  # noqa: ARG002
        """δη̂' = Γψᵀ(δY − ψ δη̂), of every case."""
        p = regression.p

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            psi = regression.psi(t, inside)
            into = gain[:, None] * transpose(psi)
            return ErrorSystem(-into @ psi, into, np.eye(p)[None], np.zeros((1, p, psi.shape[1])))

        gains = self.gains("gamma", regression.parameters)
        return tuple(partial(at, np.broadcast_to(gain, p)) for gain in gains)

    def recursive(self, parameters: Sequence[str]) -> RecursiveGradient:
        """The estimator at samples: exact for a ψ that is held between them."""
        return RecursiveGradient(self.start(parameters), self.gains("gamma", parameters))

    def estimate_moving(
        self, regression: LinearRegression, t: Array, known: Known, dynamics: Dynamics
    ) -> VectorEstimates:
        """η̂' = 𝔸η̂ + 𝕓 + Γψᵀ(Y − ψη̂) at the times t (M,)."""
        plain = self.resume(regression, t, known)
        return replace(plain, law=replace(plain.law, dynamics=dynamics))


class RecursiveGradient(VectorRecursion):
    """The law over each sample, for ψ and Y as the hold rule has them between samples."""

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each.

        With ψΓ^½√h = U Σ Vᵀ a step is η̂ + Γ^½ V (1 − e^{−Σ²})/Σ Uᵀ √h (Y − ψη̂).
        """
        rows, p, roots = regression.weighted(), regression.p, self.roots[:, None, None]
        U, sigma, Vt = np.linalg.svd(rows[..., :p] * roots, full_matrices=False)
        sigma = np.where(sigma > p * EPS * sigma[..., :1], sigma, 0.0)  # else it is rounding
        gone = -np.expm1(-np.minimum(sigma, _ALL) ** 2)
        done = np.divide(gone, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
        L = transpose((U * done[..., None, :]) @ Vt * roots)
        shrunk = np.eye(p) - (transpose(Vt * roots) * gone[..., None, :]) @ (Vt / roots)
        eta, met = self.advance(L, shrunk, rows[..., p])

        def errors() -> tuple[ErrorRecursion, ...]:
            """δη̂' = (I − LN) δη̂ + L δY, of every case."""
            eye, r = np.eye(p)[None], regression.rows.shape[1]
            old, new = (np.sqrt(share)[:, None, None] for share in regression.shares)
            return tuple(
                ErrorRecursion(A, old * own[..., :r], new * own[..., -r:], eye)
                for own, A in zip(L, shrunk, strict=True)
            )

        return SampledEstimates(eta, None, errors, met)


ESTIMATOR = Gradient
