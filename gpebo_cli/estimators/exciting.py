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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import WindowedEstimator, gain
from gpebo_cli.estimators._mixed import MixedEstimates, RecursiveMixed, scalar_errors
from gpebo_cli.estimators._recursive import Mixed, Steps, in_series
from gpebo_cli.estimators._scalar import ScalarPath, filled, resolved_for, scalar_path
from gpebo_cli.estimators.drem import Drem
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import reciprocals
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known
from gpebo_cli.regression.samples import Filter, SampledRegression

_TOLERANCE, _MAX_ELEMENTS = 1e-12, 200_000
_KNOWN = 1e-13  # of Φ_21, from which on e_2/Φ_21 is more than rounding


@dataclass(frozen=True, kw_only=True)
class Exciting(WindowedEstimator):
    """Kreisselmeier filters, mixing, the new regressor, and η̂_i' = γ Φ_21 (e_2 − Φ_21 η̂_i).

    Attributes:
        gamma: γ, also by parameter.
        kappa: κ of the rotation, of the size of 1/∫Δ²; with a larger one Φ_21 is there earlier, and
            what comes later counts less.
        rates: λ of the filters, as of ``drem``.
    """

    gamma: object = gain(10.0, by_parameter=True, auto=True)
    kappa: float = field(default=1e10, metadata={"positive": True})
    rates: object = field(default=None, metadata={"key": "lambda"})

    def go_on(self, regression: LinearRegression, t: Array, known: Known) -> MixedEstimates:
        """Extend, mix, rotate, and keep what the closed form needs at the times t (M,)."""
        inner = self.part(Drem).resume(regression, t, known)
        path = resolved_for(inner.groups[0], np.array([[self.kappa]]))
        columns, left = 1 + path.quotient.shape[-1], self._left(path, known)

        def rotation(t: Array, inside: Array) -> LinearEquation:
            delta, Y, _ = path.signals(t, inside)
            A = np.zeros((len(t), 2, 2))
            turn = self.kappa * left(t, inside) * delta  # u2
            A[:, 1, 0] = turn * delta
            A[:, 0, 1] = -A[:, 1, 0]
            f = np.zeros((len(t), 2, columns))
            f[:, 1, 1:] = turn[:, None] * Y
            return LinearEquation(None, A, f)

        # The first column is of Φ; e − Φ (η, 0) and z start at 0.
        start = known[0].turned if known else np.outer([1.0, 0.0], np.eye(columns)[0])
        found = solve(
            LinearProblem(rotation, start, name="new regressor", advice="use estimator=drem"),
            path.mesh, tol=_TOLERANCE, max_elements=_MAX_ELEMENTS,
        ).trajectory

        def signals(t: Array, inside: Array) -> tuple[Array, Array, Array]:
            values = found(t, inside)[:, 1]
            return values[:, 0], values[:, 1:], values[:, 0]

        new, right = found.values[:, :, 1, 0], found.values[:, :, 1, 1:]
        usable = new > _KNOWN
        quotient = filled(right / np.where(usable, new, 1.0)[..., None], usable)
        law = scalar_path(found.mesh, signals, new, new, quotient, t, path.floor)
        (end,) = inner.at_end()
        end = replace(end, turned=found.final)
        law = resolved_for(law, inner.gains)
        return replace(inner, groups=(law,), condition="IE", at_end=lambda: (end,))

    def recursive(self, parameters: Sequence[str]) -> RecursiveMixed:
        """The estimator at samples."""
        return RecursiveMixed(self, parameters, Rotation(self, parameters).update, "IE")

    def _left(self, path: ScalarPath, known: Known) -> Callable[[Array, Array], Array]:
        """π/2 − φ = (π/2) e^{−κ∫Δ²} at times (N,)."""
        Phi = known[0].turned[:, 0] if known else np.eye(2)[0]
        start, energy = np.arctan2(*Phi), Trajectory(path.mesh, path.energy)
        return lambda t, inside: start * np.exp(-self.kappa * energy(t, inside))

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δ𝒴 as of ``drem``, δe' = φ'[[0, −1], [1, 0]] δe + φ'/Δ (0, adj(Ω) δ𝒴), of every case.

        Then δη̂' = γΦ_21 (δe_2 − Φ_21 δη̂).
        """
        p, end, linear = regression.p, regression.mesh.edges[-1:], self.part(Drem)
        rates, mixed = linear.behind(regression, known)
        left = self._left(linear.resume(regression, end, known).groups[0], known)
        first, second = np.arange(p, 2 * p), np.arange(2 * p, 3 * p)

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            seen, delta, adjugate = mixed(t, inside)
            rest = left(t, inside)
            turn = (self.kappa * rest * delta)[:, None]
            filters = np.zeros((len(t), 3 * p, 3 * p))
            filters[:, :p, :p] = np.diag(rates)
            filters[:, first, second] = turn * delta[:, None]
            filters[:, second, first] = -filters[:, first, second]
            filters[:, second, :p] = -turn[..., None] * adjugate
            into = np.pad(seen, ((0, 0), (0, 2 * p), (0, 0)))
            e_2 = np.eye(3 * p)[None, 2 * p :]
            return scalar_errors(filters, into, np.cos(rest), e_2, gain)

        return tuple(partial(at, gain) for gain in self.gains("gamma", regression.parameters))


class Rotation:
    """The rotation over each sample, exact for 𝐘/Δ as it is there or in the middle.

    With c = e_1 + i e_2 and η̄ = 𝐘/Δ a turn by δ makes e^{iδ}(c + η̄) − η̄ of c.
    """

    def __init__(self, settings: Exciting, parameters: Sequence[str]) -> None:
        self._mixing, self._steps = settings.part(Drem).mixing(parameters), Steps()
        self._kappa = settings.kappa
        self._energy, self._turned = 0.0, np.zeros(len(parameters), complex)  # ∫Δ², c e^{−iφ}
        self._inverse: Array | None = None

    def update(self, regression: SampledRegression) -> Mixed:
        """Φ_21 and e_2/Φ_21 at K samples."""
        mixed = self._mixing(regression)
        energy, mean, both = self._steps.means(regression, mixed.delta**2, mixed)
        so_far = np.cumsum(np.concatenate([[self._energy], energy]))
        phi = -0.5 * np.pi * np.expm1(-self._kappa * so_far)
        self._energy, turn = float(so_far[-1]), np.exp(1j * np.diff(phi))
        new = np.sin(phi[1:])
        steps = ((turn - 1.0) * np.exp(-1j * phi[1:]))[:, None] * mean
        turned = self._turned + np.cumsum(steps, axis=0)
        self._turned = turned[-1]
        known = new > _KNOWN
        e_2 = (turned * np.exp(1j * phi[1:, None])).imag
        inverse = reciprocals(new, known)

        def errors() -> tuple[list[Filter], list[Array]]:
            (own,), (Q,) = mixed.behind()
            p = mean.shape[1]
            before = Q[:1] if self._inverse is None else self._inverse
            previous, self._inverse = np.concatenate([before, Q[:-1]]), Q[-1:]
            share = np.where(both, 0.5, 1.0)[:, None, None]
            # δη̄ of a step is what follows from δ𝒴 before it and from both ends of it.
            cos, sin, eye = turn.real[:, None, None], turn.imag[:, None, None], np.eye(p)
            keep = np.block([[cos * eye, -sin * eye], [sin * eye, cos * eye]])
            of_new, of_old = (
                np.concatenate([(cos - 1.0) * x, sin * x], axis=1)
                for x in (share * Q, (1.0 - share) * previous)
            )
            whole = in_series(own, keep, of_new, of_old)
            return [whole], [inverse[:, None, None] * np.eye(p, 3 * p, 2 * p)]

        return Mixed(new[:, None], (inverse[:, None] * e_2)[:, None], known[:, None], errors)


ESTIMATOR = Exciting
