"""DREM as in the paper: Kreisselmeier extension, mixing, scalar gradient laws (Section V)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.estimators._mixed import FilteredEstimator, energy_requirement, filter_rates
from gpebo_cli.estimators._vector import VectorEstimates, VectorLaw
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics, filtered, state_of
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known


@dataclass(frozen=True, kw_only=True)
class Drem(FilteredEstimator):
    """Kreisselmeier filters, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Without noise η̃(t) = e^{−γ∫Δ²} η̃(0): it converges if and only if Δ is not square integrable.
    Interval excitation alone is not enough, because the filters forget.
    """

    def estimate_moving(
        self, regression: LinearRegression, t: Array, known: Known, dynamics: Dynamics
    ) -> VectorEstimates:
        """η̂' = 𝔸η̂ + 𝕓 + ΓΔ (𝐘 − Δ η̂) at the times t (M,).

        It follows where γΔ² exceeds the growth of η.
        """
        names = regression.parameters
        rates = filter_rates(self.rates, names)
        extended = filtered(regression.outer, rates, rates, dynamics, known)
        return follow(
            extended, dynamics, self.start(names), self.gains("gamma", names), np.asarray(t), known
        )


def follow(
    extended: Trajectory, dynamics: Dynamics, start: Array, gains: Array, t: Array,
    known: Known = (),
) -> VectorEstimates:
    """η̂' = 𝔸η̂ + 𝕓 + ΓΔ (𝐘 − Δ η̂) with Δ and 𝐘 = adj(Ω)𝒴 of [Ω | 𝒴] (p, p + 1), on its mesh.

    γ∫Δ² has to be larger than the growth of η, so that the error falls.
    """
    values = extended.values
    delta, Y, _ = determinant_and_adjugate_action(values[..., :-1], values[..., -1:])
    mesh = extended.mesh
    same = Trajectory(mesh, np.broadcast_to(delta[..., None, None], Y.shape))
    law = VectorLaw(None, same, Trajectory(mesh, Y[..., 0]), dynamics=dynamics, mixed=True)
    mixed = Trajectory(mesh, delta)
    energy = sum(each.energy for each in known) + float(Trajectory(mesh, delta**2).integral().final)
    requirement = energy_requirement(
        gains, energy, "γ∫Δ² above the growth of the state", dynamics.growth + DECAY,
        f"1 % of the initial error of a state that may grow by e^{dynamics.growth:.3g}",
    )
    state = replace(state_of(extended, known), energy=energy)
    return VectorEstimates(
        law, start, gains, t, same, requirement, reached=(state,), mixed=mixed
    )


ESTIMATOR = Drem
