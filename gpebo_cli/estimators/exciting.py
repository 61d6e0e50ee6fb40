"""DREM behind a regressor that stays exciting when Δ is so for an interval only.

After the idea of Bobtsov, Yi, Ortega and Astolfi, Generation of new exciting regressors for
consistent on-line estimation of unknown constant parameters, arXiv:2104.02210. To 𝐘 = Δη_i belongs

    η_i' = 0 = u1 z − u1 z,   z' = u2 𝐘 + u3 z = u2 Δ η_i + u3 z,   z(0) = 0

whose state (η_i, z) an observer follows up to e = Φ (η_i, 0), Φ' = [[0, u1], [u2 Δ, u3]] Φ, as a
GPEBO does. Its second row is the new regression e_2 = Φ_21 η_i, and u1, u2, u3 are free. Here

    u1 = −φ',   u2 Δ = φ',   u3 = 0,   φ = (π/2) (1 − e^{−κ∫Δ²}),

with which Φ is the rotation by φ: Φ_21 = sin φ never falls, and stays where it is when Δ ends.
The paper was not at hand. The observer and this choice were derived from its abstract; they are
what stands here, and need not be the paper's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import GainEstimator, gain
from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._mixed import MixedEstimates, filter_rates, scalar_errors
from gpebo_cli.estimators._mixing import filled, mix
from gpebo_cli.estimators._scalar import ScalarPath, scalar_path
from gpebo_cli.estimators.drem import Drem
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action, transpose
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.schema import number

_TOLERANCE, _MAX_ELEMENTS = 1e-12, 200_000
_KNOWN = 1e-13  # of Φ_21, from which on e_2/Φ_21 is more than rounding


@dataclass(frozen=True, kw_only=True)
class Exciting(GainEstimator):
    """Kreisselmeier filters, mixing, the new regressor, and η̂_i' = γ Φ_21 (e_2 − Φ_21 η̂_i).

    Attributes:
        gamma: γ; a number, a list (one case each), ``logspace(a, b, n)``, or a mapping by
            parameter (one gain each).
        kappa: κ of the rotation, of the size of 1/∫Δ²; with a larger one Φ_21 is there earlier, and
            what comes later counts less.
        rates: λ of the filters, as of ``drem``.
    """

    gamma: object = gain(10.0, by_parameter=True, auto=True)
    kappa: float = 1e10
    rates: object = field(default=None, metadata={"key": "lambda"})

    def estimate(self, regression: LinearRegression, t: Array) -> MixedEstimates:
        """Extend, mix, rotate, and keep what the closed form needs at the times t (M,).

        Raises:
            ConfigError: κ is not positive.
        """
        inner = Drem(gamma=self.gamma, rates=self.rates, initial=self.initial).resume(
            regression, t, ()
        )
        (path,) = inner.groups
        columns, turning = 1 + path.quotient.shape[-1], self._turning(path)

        def rotation(t: Array, inside: Array) -> LinearEquation:
            delta, Y, _ = path.signals(t, inside)
            A = np.zeros((len(t), 2, 2))
            turn = turning(t, inside) * delta  # u2
            A[:, 1, 0] = turn * delta
            A[:, 0, 1] = -A[:, 1, 0]
            f = np.zeros((len(t), 2, columns))
            f[:, 1, 1:] = turn[:, None] * Y
            return LinearEquation(None, A, f)

        start = np.zeros((2, columns))
        start[0, 0] = 1.0  # of Φ; e − Φ (η, 0) and z start at 0
        found = solve(
            LinearProblem(rotation, start, name="new regressor"), path.mesh,
            tol=_TOLERANCE, max_elements=_MAX_ELEMENTS,
        ).trajectory

        def signals(t: Array, inside: Array) -> tuple[Array, Array, Array]:
            values = found(t, inside)[:, 1]
            return values[:, 0], values[:, 1:], np.minimum(np.abs(values[:, 0]), 1.0)

        new, right = found.values[:, :, 1, 0], found.values[:, :, 1, 1:]
        usable = np.abs(new) > _KNOWN
        quotient = filled(right / np.where(usable, new, 1.0)[..., None], usable)
        law = scalar_path(found.mesh, signals, new, quotient, np.asarray(t), None, path.floor)
        return replace(inner, groups=(law,), condition="IE")

    def _turning(self, path: ScalarPath) -> Callable[[Array, Array], Array]:
        """φ'/Δ² = κ (π/2) e^{−κ∫Δ²} at times (N,)."""
        kappa = number(self.kappa, "estimator.kappa")
        energy = Trajectory(path.mesh, path.energy)
        return lambda t, inside: 0.5 * np.pi * kappa * np.exp(-kappa * energy(t, inside))

    def errors(self, regression: LinearRegression) -> tuple[ErrorsAt, ...]:
        """δ𝒴 as of ``drem``, δe' = φ'[[0, −1], [1, 0]] δe + φ'/Δ (0, adj(Ω) δ𝒴), of every case.

        Then δη̂' = γΦ_21 (δe_2 − Φ_21 δη̂).
        """
        names, p, end = regression.parameters, regression.p, regression.mesh.edges[-1:]
        rates = filter_rates(self.rates, names)
        extended = kreisselmeier(regression, rates)
        turning = self._turning(mix(extended, end))
        (law,) = self.estimate(regression, end).groups
        first, second = np.arange(p, 2 * p), np.arange(2 * p, 3 * p)

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            omega = extended(t, inside)[..., :p]
            delta, adjugate, _ = determinant_and_adjugate_action(omega)
            turn = (turning(t, inside) * delta)[:, None]
            filters = np.zeros((len(t), 3 * p, 3 * p))
            filters[:, :p, :p] = np.diag(rates)
            filters[:, first, second] = turn * delta[:, None]
            filters[:, second, first] = -filters[:, first, second]
            filters[:, second, :p] = -turn[..., None] * adjugate
            into = np.zeros((len(t), 3 * p, regression.psi.values.shape[2]))
            into[:, :p] = rates[:, None] * transpose(regression.psi(t, inside))
            e_2 = np.eye(3 * p)[None, 2 * p :]
            return scalar_errors(filters, into, law.signals(t, inside)[0], e_2, gain)

        return tuple(partial(at, gain) for gain in self.gains("gamma", names))


ESTIMATOR = Exciting
