"""DREM behind a regressor that stays exciting when Δ is so for an interval only.

After Bobtsov, Yi, Ortega and Astolfi, Generation of new exciting regressors for consistent on-line
estimation of unknown constant parameters, arXiv:2104.02210: to 𝐘 = Δη_i belongs the system

    η_i' = 0 = u1 z − u1 z,   z' = u2 𝐘 + u3 z = u2 Δ η_i + u3 z,   z(0) = 0

whose state (η_i, z) an observer follows up to e = Φ (η_i, 0), Φ' = [[0, u1], [u2 Δ, u3]] Φ, as a
GPEBO does. Its second row is the new regression e_2 = Φ_21 η_i, and u1, u2, u3 are free. Here
u1 = −κΔ², u2 = κΔ and u3 = 0, with which Φ is a rotation: Φ_21 = sin(κ∫Δ²) stays where it is when
Δ ends, and is persistently exciting unless κ∫Δ² stops at a multiple of π. This choice is ours; the
equations were derived, not copied.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gpebo_cli.estimators._base import GainEstimator, gain
from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._mixed import MixedEstimates, filter_rates
from gpebo_cli.estimators._mixing import filled
from gpebo_cli.estimators._scalar import scalar_path
from gpebo_cli.estimators.drem import Drem
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action, transpose
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression

_TOLERANCE, _MAX_ELEMENTS = 1e-12, 200_000
_KNOWN = 1e-13  # of Φ_21, from which on e_2/Φ_21 is more than rounding


@dataclass(frozen=True, kw_only=True)
class Exciting(GainEstimator):
    """Kreisselmeier filters, mixing, the new regressor, and η̂_i' = γ Φ_21 (e_2 − Φ_21 η̂_i).

    Attributes:
        gamma: γ; a number, a list (one case each), ``logspace(a, b, n)``, or a mapping by
            parameter (one gain each).
        kappa: κ of the rotation; None is π/2 over ∫Δ² at the end, the most that never turns back.
        rates: λ of the filters, as of ``drem``.
        initial: η̂ at the start, a number, one per parameter, or a mapping by parameter.
    """

    gamma: object = gain(10.0, by_parameter=True, auto=True)
    kappa: float | None = None
    rates: object = field(default=None, metadata={"key": "lambda"})

    def estimate(self, regression: LinearRegression, t: Array) -> MixedEstimates:
        """Extend, mix, rotate, and keep what the closed form needs at the times t (M,)."""
        inner, kappa = self._mixed(regression, t)
        (path,) = inner.groups
        columns = 1 + path.quotient.shape[-1]

        def rotation(t: Array, inside: Array) -> LinearEquation:
            delta, Y, _ = path.signals(t, inside)
            A = np.zeros((len(t), 2, 2))
            A[:, 1, 0] = kappa * delta**2
            A[:, 0, 1] = -A[:, 1, 0]
            f = np.zeros((len(t), 2, columns))
            f[:, 1, 1:] = kappa * delta[:, None] * Y
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

    def _mixed(self, regression: LinearRegression, t: Array) -> tuple[MixedEstimates, float]:
        """𝐘 = Δη as of ``drem``, and κ."""
        plain = Drem(gamma=self.gamma, rates=self.rates, initial=self.initial)
        inner = plain.resume(regression, t, ())
        energy = max(float(inner.groups[0].energy[-1, -1]), 1e-300)
        return inner, 0.5 * np.pi / energy if self.kappa is None else self.kappa

    def errors(self, regression: LinearRegression) -> tuple[ErrorsAt, ...]:
        """δ𝒴 as of ``drem``, δe' = κΔ²[[0, −1], [1, 0]] δe + κΔ (0, adj(Ω) δ𝒴), of every case.

        Then δη̂' = γΦ_21 (δe_2 − Φ_21 δη̂).
        """
        names, p, end = regression.parameters, regression.p, regression.mesh.edges[-1:]
        rates, kappa = filter_rates(self.rates, names), self._mixed(regression, end)[1]
        extended = kreisselmeier(regression, rates)
        (law,) = self.estimate(regression, end).groups
        filtered, first, second, last = (np.arange(p) + k * p for k in range(4))

        def of_case(gain: Array) -> ErrorsAt:
            def at(t: Array, inside: Array) -> ErrorSystem:
                omega = extended(t, inside)[..., :p]
                delta, adjugate, _ = determinant_and_adjugate_action(omega)
                new, psi = law.signals(t, inside)[0][:, None], regression.psi(t, inside)
                A = np.zeros((len(t), 4 * p, 4 * p))
                A[:, filtered, filtered] = -rates
                A[:, first, second] = -kappa * delta[:, None] ** 2
                A[:, second, first] = kappa * delta[:, None] ** 2
                A[:, 2 * p : 3 * p, :p] = kappa * delta[:, None, None] * adjugate
                A[:, last, second], A[:, last, last] = gain * new, -gain * new**2
                B = np.zeros((len(t), 4 * p, psi.shape[1]))
                B[:, :p] = rates[:, None] * transpose(psi)
                return ErrorSystem(A, B, np.eye(4 * p)[None, 3 * p :], np.zeros_like(B[:1, :p]))

            return at

        return tuple(map(of_case, self.gains("gamma", names)))


ESTIMATOR = Exciting
