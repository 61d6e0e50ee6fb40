"""mine: regularised least squares, an example that works as it stands.

η̂(t) = (f₀ I + G(t))⁻¹ (f₀ η̂₀ + h(t)),      G = ∫ψᵀψ dt,    h = ∫ψᵀY dt
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.estimators import Array, GainEstimator, LinearRegression, Requirement, gain


@dataclass(frozen=True, kw_only=True)
class Mine(GainEstimator):
    """The settings: one field for each key of the YAML file.

    Attributes:
        f0: weight of the start; a number, a list (one case each), or ``logspace(a, b, n)``.
        initial: η̂ at the start, a number, one per parameter, or a mapping by parameter.
    """

    f0: object = gain(1e-6)

    def estimate(self, regression: LinearRegression, t: Array) -> Estimates:
        """Everything but the gains, once for all cases, at the times t (M,)."""
        names = regression.parameters
        return Estimates(
            gram=regression.gram(t),
            f0=self.gains("f0", names)[:, 0],
            start=self.start(names),
            realisations=regression.realisations,
        )


@dataclass(frozen=True, eq=False)
class Estimates:
    """The estimates of every case at M times."""

    gram: Array  # (M, p, p + c) [G | h]
    f0: Array  # (g,)
    start: Array  # (p,) η̂₀
    realisations: tuple[int, ...]  # () or (c,): how many Y there are over the one ψ

    def parameters(self, cases: slice) -> Array:
        """η̂ of some cases, (g, M, p), or (g, M, p, c) for c realisations."""
        p = len(self.start)
        f0 = self.f0[cases, None, None, None]
        left = f0 * np.eye(p) + self.gram[..., :p]
        right = f0 * self.start[:, None] + self.gram[..., p:]
        eta = np.asarray(np.linalg.solve(left, right))
        return eta.reshape(*eta.shape[:3], *self.realisations)

    @property
    def requirement(self) -> Requirement:
        """The error of the slowest direction has shrunk by 1 + λ_min(G)/f₀."""
        smallest = np.linalg.eigvalsh(self.gram[-1, :, : len(self.start)])[0]
        ratio = float(smallest / self.f0.max())
        return Requirement(
            name="λ_min(G) → ∞",
            holds=ratio >= 99.0,
            evidence={"lambda_min_over_f0": ratio, "needed": 99.0},
            text=f"λ_min(G)/f₀ = {ratio:.3g}; 1 % of the initial error needs 99",
        )

    def delta(self, t: Array) -> None:  # noqa: ARG002  an estimator that mixes returns Δ here
        """Nothing is mixed, at any of the times t (M,)."""
        return
