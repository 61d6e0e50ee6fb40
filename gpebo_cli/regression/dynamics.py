"""Parameters that move by known dynamics: η' = 𝔸 η + 𝕓 (observer.remedy: current_coordinates)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import largest_over_time, transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory, joined
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem

_TOLERANCE = 1e-12
_MAX_ELEMENTS = 200_000


@dataclass(frozen=True, eq=False)
class Dynamics:
    """𝔸 and 𝕓 on one mesh."""

    A: Trajectory  # (p, p)
    b: Trajectory  # (p,)
    forgetting: float  # 1/s ρ: what is known of directions that decay must fade as fast as it grows
    units: Array  # (p,) in which parameters are comparable


def filtered(
    outer: Trajectory, rates: Array, gains: Array, dynamics: Dynamics, start: Array | None = None
) -> Trajectory:
    """[Ω | 𝒴] (p, p + 1) with Ω η = 𝒴 at every time, for η that moves.

        Ω' = −(Λ + ρI)Ω − 𝔸ᵀΩ − Ω𝔸 + Γψᵀψ,    𝒴' = −(Λ + ρI)𝒴 − 𝔸ᵀ𝒴 + Ω𝕓 + Γψᵀy

    Nothing in it grows as solutions of η' = 𝔸η do; in directions that decay, Ω would grow as the
    square of their inverse, which the forgetting ρ makes up for. ``outer`` is [ψᵀψ | ψᵀy]
    (p, p + 1), and Λ and Γ have the diagonals ``rates`` and ``gains`` (p,).
    """
    p, units = outer.values.shape[2], dynamics.units
    # It is solved for comparable parameters: what is small in its unit only is no rounding.
    own = units[:, None] * np.append(units, 1.0)
    outer = Trajectory(outer.mesh, own * outer.values)
    mesh, A, b = dynamics.A.mesh, dynamics.A.values, dynamics.b.values
    turn = Trajectory(mesh, np.concatenate([A * units / units[:, None], (b / units)[..., None]], 3))
    known, sizes = np.zeros((p, p + 1)) if start is None else own * start, np.zeros((p, p + 1))
    decay, pieces = np.diag(rates + dynamics.forgetting), list[Trajectory]()
    for window in outer.mesh.windows():
        pieces.append(_over(window, outer, decay, gains, turn, known, sizes))
        known = pieces[-1].final
        sizes = np.maximum(sizes, largest_over_time(pieces[-1].values, 2))
    found = joined(pieces)
    return Trajectory(found.mesh, found.values / own)


def _over(
    mesh: Mesh, outer: Trajectory, decay: Array, gains: Array, turn: Trajectory, start: Array,
    sizes: Array,
) -> Trajectory:
    """[Ω | 𝒴] on a window, for [𝔸 | 𝕓] and from ``start`` (p, p + 1), which was of ``sizes``."""
    p = len(start)
    eye = np.eye(p)

    def of_omega(t: Array, inside: Array) -> LinearEquation:
        A = turn(t, inside)[..., :p]
        left = -(decay + transpose(A))
        M = np.einsum("nij,kl->nikjl", left, eye) - np.einsum("ij,nlk->nikjl", eye, A)
        f = gains[:, None] * outer(t, inside)[..., :p]
        return LinearEquation(None, M.reshape(-1, p * p, p * p), f.reshape(-1, p * p, 1))

    problem = LinearProblem(
        of_omega, start[:, :p].reshape(-1, 1), name="filter of the regressor",
        floor=sizes[:, :p].reshape(-1, 1),
    )
    omega = solve(problem, mesh, tol=_TOLERANCE, max_elements=_MAX_ELEMENTS).trajectory

    def of_rhs(t: Array, inside: Array) -> LinearEquation:
        sampled = omega(t, inside)[..., 0].reshape(-1, p, p)
        moving = turn(t, inside)
        f = np.einsum("nij,nj->ni", sampled, moving[..., p])
        f = f + gains * outer(t, inside)[..., p]
        return LinearEquation(None, -(decay + transpose(moving[..., :p])), f[..., None])

    # From the mesh of Ω on: in one of its elements Ω is a polynomial.
    problem = LinearProblem(
        of_rhs, start[:, p:], name="filter of the regression", floor=sizes[:, p:]
    )
    rhs = solve(problem, omega.mesh, tol=_TOLERANCE, max_elements=_MAX_ELEMENTS).trajectory
    t, inside = rhs.mesh.points.ravel(), rhs.mesh.inside.ravel()
    both = np.concatenate(
        [omega(t, inside).reshape(-1, p, p), rhs.values.reshape(-1, p, 1)], axis=2
    )
    return rhs.mesh.trajectory(both)
