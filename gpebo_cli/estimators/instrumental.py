"""DREM with an instrumental variable and averaging: unbiased behind coloured disturbances.

After the idea of Glushchenko and Lastochkin, Instrumental variables based DREM for online
asymptotic identification of perturbed linear systems, arXiv:2312.15631. Y = ψη + w, and an
instrument ζ that has nothing in common with w: the mean of ζY goes to the mean of ζψ times η. Here
ζ is ψ itself as it was d seconds ago, which needs w to forget within d:

    Ω' = (ζψ − Ω)/(T₀ + t),   𝒴' = (ζY − 𝒴)/(T₀ + t),   ζ(t) = ψ(t − d)ᵀ,   then mixing, as in drem.

The instrument is ours, because an estimator sees ψ and no reference signal. Of the paper only the
abstract and introduction were at hand, so these equations need not be its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import GainEstimator, gain
from gpebo_cli.estimators._extension import averaged, lagged
from gpebo_cli.estimators._mixed import MixedEstimates, scalar_errors
from gpebo_cli.estimators._mixing import mix
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.schema import number


@dataclass(frozen=True, kw_only=True)
class Instrumental(GainEstimator):
    """Means of products with a delayed ψ, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Attributes:
        gamma: γ; a number, a list (one case each), ``logspace(a, b, n)``, or a mapping by
            parameter (one gain each).
        delay: d of the instrument in seconds.
        settle: T₀ of the means in seconds.
    """

    gamma: object = gain(1e10, by_parameter=True, auto=True)
    delay: float = 0.5
    settle: float = 1.0

    def means(self, regression: LinearRegression) -> Trajectory:
        """Means of products with [ψ(t) ; ψ(t − d)]ᵀ, (2p, p + c).

        Raises:
            ConfigError: the delay or T₀ is not positive.
        """
        delay, settle = (number(getattr(self, k), f"estimator.{k}") for k in ("delay", "settle"))
        return averaged(regression, delay, settle)

    def left(self, means: Array, names: Sequence[str]) -> Array:  # noqa: ARG002
        """What makes p equations of the 2p means (N, 2p, p + c), (N or 1, p, 2p)."""
        return np.eye(2 * len(names))[None, len(names) :]

    def estimate(self, regression: LinearRegression, t: Array) -> MixedEstimates:
        """Extend, mix, and keep what the closed form needs at the times t (M,)."""
        names, means = regression.parameters, self.means(regression)
        rows = means.values.reshape(-1, *means.values.shape[2:])
        square = (self.left(rows, names) @ rows).reshape(*means.values.shape[:2], len(names), -1)
        return MixedEstimates(
            groups=(mix(Trajectory(means.mesh, square), np.asarray(t), regression.floor),),
            at_end=lambda: (),
            start=self.start(names),
            gains=self.gains("gamma", names),
            condition="Δ not in L2",
            realisations=regression.realisations,
        )

    def errors(self, regression: LinearRegression) -> tuple[ErrorsAt, ...]:
        """δ𝒴' = (ζδY − δ𝒴)/(T₀ + t) of all means, δη̂' = γΔ(adj(Ω) δ𝒴 − Δ δη̂), of every case."""
        names, p = regression.parameters, regression.p
        means, began = self.means(regression), regression.mesh.edges[0]

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            rows = means(t, inside)
            left = self.left(rows, names)
            delta, adjugate, _ = determinant_and_adjugate_action(left @ rows[..., :p])
            rate = 1.0 / (self.settle + t - began)
            rates = np.repeat(rate[:, None], 2 * p, axis=1)
            into = rates[..., None] * lagged(regression, self.delay, t, inside)
            return scalar_errors(rates, into, delta, adjugate @ left, gain)

        return tuple(partial(at, gain) for gain in self.gains("gamma", names))


ESTIMATOR = Instrumental
