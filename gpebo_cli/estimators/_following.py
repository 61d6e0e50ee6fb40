"""Estimates of parameters that move: η' = 𝔸η + 𝕓."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.estimators._mixed import energy_requirement
from gpebo_cli.estimators._vector import VectorEstimates, VectorLaw
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.estimator import Unmixed
from gpebo_cli.regression.resets import ExtensionState

_DIGITS = 1e-12  # reciprocal condition of Ω below which some direction is rounding


def follow(
    extended: Trajectory, dynamics: Dynamics, start: Array, gains: Array, t: Array
) -> VectorEstimates:
    """η̂' = 𝔸η̂ + 𝕓 + ΓΔ (𝐘 − Δ η̂) with Δ and 𝐘 = adj(Ω)𝒴 of [Ω | 𝒴] (p, p + 1), on its mesh.

    γ∫Δ² has to be larger than the growth of η, so that the error falls.
    """
    values = extended.values
    delta, Y, _ = determinant_and_adjugate_action(values[..., :-1], values[..., -1:])
    mesh = extended.mesh
    diagonal = Trajectory(mesh, delta[..., None, None] * np.eye(values.shape[2]))
    law = VectorLaw(diagonal, diagonal, Trajectory(mesh, Y[..., 0]), dynamics=dynamics)
    A = dynamics.A
    rate = Trajectory(A.mesh, np.linalg.eigvals(A.values).real.max(axis=-1))
    grown = max(float(rate.integral().final), 0.0)
    mixed = Trajectory(mesh, delta)
    energy = float(Trajectory(mesh, delta**2).integral().final)
    requirement = energy_requirement(
        "γ∫Δ² above the growth of the state", float(gains.min()), energy, grown + DECAY,
        f"1 % of the initial error of a state that may grow by e^{grown:.3g}",
    )
    return VectorEstimates(law, start, gains, t, requirement, mixed=mixed)


@dataclass(frozen=True, eq=False)
class SolvedEstimates(Unmixed):
    """η̂ = Ω⁻¹ 𝒴 of every case, from [Ω | 𝒴] (M, p, p + 1) with Ω > 0."""

    extended: tuple[Array, ...]  # (M, p, p + 1) each
    reached: tuple[ExtensionState, ...] = ()

    @property
    def requirement(self) -> Requirement:
        """Ω has to be regular at the horizon."""
        sigma = [np.linalg.svd(e[-1, :, :-1], compute_uv=False) for e in self.extended]
        worst = min(float(s[-1] / s[0]) for s in sigma)
        return Requirement(
            name="F⁻¹ regular", holds=worst >= _DIGITS,
            evidence={"reciprocal_condition": worst, "needed": _DIGITS},
            text=f"σ_min/σ_max of F⁻¹ is {worst:.2g} at the end; needed is {_DIGITS:.0e}",
        )

    def parameters(self, cases: slice, start: Array | None = None) -> Array:  # noqa: ARG002
        """η̂ of some cases, shape (g, M, p) (SolverError: Ω is singular at one of the times)."""
        try:
            return np.array([
                np.linalg.solve(e[..., :-1], e[..., -1:])[..., 0] for e in self.extended[cases]
            ])
        except np.linalg.LinAlgError as error:
            raise SolverError(
                "observer.remedy=current_coordinates: F⁻¹ is singular, because "
                "A_0 has directions that decay too fast; use output_injection or reset"
            ) from error
