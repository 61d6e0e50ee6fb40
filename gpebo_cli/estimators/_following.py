"""Estimates of parameters that move: η' = 𝔸η + 𝕓."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.estimators._vector import VectorLaw
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.resets import ExtensionState

_DIGITS = 1e-12  # reciprocal condition of Ω below which some direction is rounding


@dataclass(frozen=True, eq=False)
class FollowingEstimates:
    """η̂' = 𝔸η̂ + 𝕓 + ΓΔ (𝐘 − Δ η̂), one integration per case when it is asked for."""

    law: VectorLaw
    mixed: Trajectory  # Δ
    grown: float  # logarithm of what the fastest direction of η may grow by
    start: Array  # (p,)
    gains: Array  # (g, p or 1)
    t: Array  # (M,)
    reached: tuple[ExtensionState, ...] = ()

    def delta(self, t: Array) -> Array:
        """Δ at the times t (M,), shape (1, M)."""
        return self.mixed(t)[None]

    @property
    def requirement(self) -> Requirement:
        """γ∫Δ² has to be larger than the growth of η, so that the error falls."""
        energy = float(Trajectory(self.mixed.mesh, self.mixed.values**2).integral().final)
        gain = float(self.gains.min())
        needed = self.grown + DECAY
        return Requirement(
            name="γ∫Δ² above the growth of the state",
            holds=gain * energy >= needed,
            evidence={
                "integral_delta_squared": energy,
                "gamma_times_integral": gain * energy,
                "needed": needed,
            },
            text=(
                f"γ∫Δ² = {gain * energy:.3g} at the smallest gain {gain:.3g}; 1 % of the initial "
                f"error of a state that may grow by e^{self.grown:.3g} needs {needed:.3g}"
            ),
        )

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases, shape (g, M, p)."""
        gains, p = self.gains[cases], len(self.start)
        starts = np.broadcast_to(self.start if start is None else start, (len(gains), p))
        return np.array([
            self.law.solve(np.broadcast_to(gain, (p,)), own)(self.t)[..., 0]
            for gain, own in zip(gains, starts, strict=True)
        ])


def follow(
    extended: Trajectory, dynamics: Dynamics, start: Array, gains: Array, t: Array
) -> FollowingEstimates:
    """Mix [Ω | 𝒴] (p, p + 1); the law has Δ and 𝐘 = adj(Ω)𝒴 on the filters' mesh."""
    values = extended.values
    delta, Y, _ = determinant_and_adjugate_action(values[..., :-1], values[..., -1:])
    mesh = extended.mesh
    diagonal = Trajectory(mesh, delta[..., None, None] * np.eye(values.shape[2]))
    law = VectorLaw(diagonal, diagonal, Trajectory(mesh, Y[..., 0]), dynamics=dynamics)
    A = dynamics.A
    rate = Trajectory(A.mesh, np.linalg.eigvals(A.values).real.max(axis=-1))
    grown = max(float(rate.integral().final), 0.0)
    return FollowingEstimates(law, Trajectory(mesh, delta), grown, start, gains, t)


@dataclass(frozen=True, eq=False)
class SolvedEstimates:
    """η̂ = Ω⁻¹ 𝒴 of every case, from [Ω | 𝒴] (M, p, p + 1) with Ω > 0."""

    extended: tuple[Array, ...]  # (M, p, p + 1) each
    reached: tuple[ExtensionState, ...] = ()

    def delta(self, t: Array) -> None:  # noqa: ARG002  part of the protocol
        """Nothing is mixed, at any of the times t (M,)."""
        return

    @property
    def requirement(self) -> Requirement:
        """Ω has to be regular at the horizon."""
        sigma = [np.linalg.svd(e[-1, :, :-1], compute_uv=False) for e in self.extended]
        worst = min(float(s[-1] / s[0]) for s in sigma)
        return Requirement(
            name="F⁻¹ regular",
            holds=worst >= _DIGITS,
            evidence={"reciprocal_condition": worst, "needed": _DIGITS},
            text=f"σ_min/σ_max of F⁻¹ is {worst:.2g} at the end; needed is {_DIGITS:.0e}",
        )

    def parameters(self, cases: slice, start: Array | None = None) -> Array:  # noqa: ARG002
        """η̂ of some cases, shape (g, M, p).

        Raises:
            SolverError: Ω is singular at one of the times.
        """
        try:
            return np.array([
                np.linalg.solve(e[..., :-1], e[..., -1:])[..., 0] for e in self.extended[cases]
            ])
        except np.linalg.LinAlgError as error:
            raise SolverError(
                "observer.remedy=current_coordinates: F⁻¹ is singular, because "
                "A_0 has directions that decay too fast; use output_injection or reset"
            ) from error
