"""Finite-time DREM: the estimate is exact after a known amount of excitation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Literal

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators._base import ResumableEstimator, gain
from gpebo_cli.estimators._mixed import MixedEstimates
from gpebo_cli.estimators._scalar import ScalarPath
from gpebo_cli.estimators.drem import Drem
from gpebo_cli.estimators.ls_drem import LsDrem
from gpebo_cli.model.descriptor import Array
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import Recursion
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known
from gpebo_cli.schema import number


@dataclass(frozen=True, kw_only=True)
class FiniteTime(ResumableEstimator):
    """DREM plus w_c = min(e^{−γ∫Δ²}, 1 − μ), η̂_f = (η̂ − w_c η̂(0))/(1 − w_c).

    The estimate is exact, and not only asymptotically, once γ∫Δ² ≥ −ln(1 − μ).

    Attributes:
        extension: ``kreisselmeier`` (as ``drem``) or ``least_squares`` (as ``ls_drem``).
        mu: 0 < μ < 1; the smaller, the earlier, and the more a noisy η̂ is amplified (by 1/μ).
        gamma, rates, alpha, f0, beta, bound, initial: those of the extension and of the law.
    """

    extension: Literal["kreisselmeier", "least_squares"] = "kreisselmeier"
    mu: float = 0.1
    alpha: object = gain(1.0)
    f0: object = gain(1e-4)
    beta: object = gain(0.0, "nonnegative")
    bound: object = None
    gamma: object = gain(1e10, by_parameter=True, auto=True)
    rates: object = field(default=None, metadata={"key": "lambda"})

    @property
    def inner(self) -> Drem | LsDrem:
        """The asymptotic estimator that is corrected."""
        return self.part(Drem) if self.extension == "kreisselmeier" else self.part(LsDrem)

    def axes(self) -> dict[str, Sequence[float]]:
        """The cases of the inner estimator (ConfigError: ``mu`` is not between 0 and 1)."""
        mu = number(self.mu, "estimator.mu")
        if not mu < 1:
            raise ConfigError(f"estimator.mu must lie between 0 and 1, got {mu:g}")
        return self.inner.axes()

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δη̂_f = (δη̂ − w_c δη̂(0))/(1 − w_c), of every case; δη̂(0) is zero before any reset."""
        inner = self.inner.resume(regression, regression.mesh.edges[-1:], known)
        mu, gains = float(self.mu), inner.gains

        def at(
            errors: ErrorsAt, path: ScalarPath, before: float, gain: Array, t: Array, inside: Array
        ) -> ErrorSystem:
            energy = before + np.maximum(path.mesh.sampler(t, inside)(path.energy), 0.0)
            w_c = np.minimum(np.exp(-energy[:, None] * gain), 1.0 - mu)
            found = errors(t, inside)
            if known and regression.whole is None:  # the start is an estimate
                found = found.with_constants(-w_c[..., None] * np.eye(regression.p))
            return found._replace(C=found.C / (1.0 - w_c)[..., None])

        errors = self.inner.errors(regression, known)
        pairs = product(zip(inner.groups, inner.before, strict=True), gains)
        return tuple(
            partial(at, own, *group, gain)
            for own, (group, gain) in zip(errors, pairs, strict=True)
        )

    def recursive(self, parameters: Sequence[str]) -> Recursion:
        """The estimator at samples: w_c is exact there, too."""
        return self.inner.recursive(parameters, float(self.mu))

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> MixedEstimates:
        """The inner estimates at the times t (M,) with the correction on top.

        After a reset the law starts anew from the corrected estimate.
        """
        return replace(self.inner.resume(regression, t, known), mu=float(self.mu))


ESTIMATOR = FiniteTime
