"""Parameters that move by known dynamics: η' = 𝔸 η + 𝕓 (observer.remedy: current_coordinates)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions import with_others
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import largest_over_time, transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory, joined
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem

TOLERANCE = 1e-12
_MAX_ELEMENTS = 200_000
_LEVELS, _BESIDE_TIES = 96, 0.1234  # of ρ, a decade; none of them is at a round number
_SHORT = 0.01  # of a decay's own time
_HALVES = 60  # of the time from one point to the next, in which ρ rises


@dataclass(frozen=True, eq=False)
class Dynamics:
    """𝔸 and 𝕓 on one mesh."""

    A: Trajectory  # (p, p)
    b: Trajectory  # (p,)
    constants: int  # so many of the parameters, the first ones, do not move
    units: Array  # (p,) in which parameters are comparable


def filtered(
    outer: Trajectory, rates: Array, gains: Array, dynamics: Dynamics, start: Array | None = None
) -> Trajectory:
    """[Ω | 𝒴] (p, p + 1) with Ω η = 𝒴 at every time, for η that moves.

        Ω' = −(Λ + ρI)Ω − 𝔸ᵀΩ − Ω𝔸 + Γψᵀψ,    𝒴' = −(Λ + ρI)𝒴 − 𝔸ᵀ𝒴 + Ω𝕓 + Γψᵀy

    Nothing in it grows as solutions of η' = 𝔸η do; in directions that decay, Ω would grow as the
    square of their inverse, which the forgetting ρ(t) makes up for, twice the rate of the fastest
    decay so far (``_forgetting``). ``outer`` is [ψᵀψ | ψᵀy] (p, p + 1), and Λ and Γ have the
    diagonals ``rates`` and ``gains`` (p,).
    """
    p, units = outer.values.shape[2], dynamics.units
    # It is solved for comparable parameters: what is small in its unit only is no rounding.
    own = units[:, None] * np.append(units, 1.0)
    outer = Trajectory(outer.mesh, own * outer.values)
    mesh, A, b = dynamics.A.mesh, dynamics.A.values, dynamics.b.values
    turn = Trajectory(mesh, np.concatenate([A * units / units[:, None], (b / units)[..., None]], 3))
    known, sizes = np.zeros((p, p + 1)) if start is None else own * start, np.zeros((p, p + 1))
    pieces, (times, levels) = list[Trajectory](), _forgetting(turn)

    def moving(t: Array, inside: Array) -> tuple[Array, Array, Array]:
        """Λ + ρI + 𝔸ᵀ and 𝔸 (N, p, p), and 𝕓 (N, p)."""
        at, rho = turn(t, inside), levels[np.searchsorted(times, inside)]
        A = at[..., :p]
        return transpose(A) + (rates + rho[:, None])[:, None] * np.eye(p), A, at[..., p]

    for window in outer.mesh.windows():
        within = times[(times > window.span[0]) & (times < window.span[1])]
        finer = Mesh(with_others(window.edges, within), window.rule)
        pieces.append(_over(finer, outer, gains, moving, known, sizes))
        known = pieces[-1].final
        sizes = np.maximum(sizes, largest_over_time(pieces[-1].values, 2))
    found = joined(pieces)
    return Trajectory(found.mesh, found.values / own)


def _forgetting(turn: Trajectory) -> tuple[Array, Array]:
    """Times (k,) at which ρ rises, and what it is before, between and after them (k + 1,).

    ρ/2 is the next of 96 rates a decade above the fastest decay of 𝔸 (p, p), in ``turn`` beside 𝕓,
    at any time so far. A decay that has gone on for less than 0.01 of its own time does not count.
    """
    p, start = turn.values.shape[2], turn.mesh.span[0]

    def needed(t: Array, A: Array) -> Array:
        rate = -np.linalg.eigvals(A[..., :p]).real.min(axis=-1)
        some = rate * (t - start) > _SHORT
        level = np.ceil(_LEVELS * np.log10(np.where(some, rate, 1.0)) - _BESIDE_TIES)
        return np.where(some, level, -np.inf)

    t = turn.mesh.points.ravel()
    found = needed(t, turn.values.reshape(-1, *turn.values.shape[2:]))
    levels, times = [-np.inf], list[float]()
    for k in np.flatnonzero(np.diff(np.maximum.accumulate(found)) > 0.0):
        while levels[-1] < found[k + 1]:
            low, high, level = t[k], t[k + 1], float(found[k + 1])
            for _ in range(_HALVES):
                middle = 0.5 * (low + high)
                there = float(needed(middle, turn(np.array([middle])))[0])
                if there > levels[-1]:
                    high, level = middle, there
                else:
                    low = middle
            times.append(float(high))
            levels.append(level)
    return np.array(times), 2.0 * 10.0 ** ((np.array(levels) + _BESIDE_TIES) / _LEVELS)


def _over(
    mesh: Mesh, outer: Trajectory, gains: Array,
    moving: Callable[[Array, Array], tuple[Array, Array, Array]], start: Array, sizes: Array,
) -> Trajectory:
    """[Ω | 𝒴] on a window, from ``start`` (p, p + 1), which was of ``sizes``."""
    p = len(start)
    eye = np.eye(p)

    def of_omega(t: Array, inside: Array) -> LinearEquation:
        decay, A, _ = moving(t, inside)
        M = -np.einsum("nij,kl->nikjl", decay, eye) - np.einsum("ij,nlk->nikjl", eye, A)
        f = gains[:, None] * outer(t, inside)[..., :p]
        return LinearEquation(None, M.reshape(-1, p * p, p * p), f.reshape(-1, p * p, 1))

    problem = LinearProblem(
        of_omega, start[:, :p].reshape(-1, 1), name="filter of the regressor",
        floor=sizes[:, :p].reshape(-1, 1),
    )
    omega = solve(problem, mesh, tol=TOLERANCE, max_elements=_MAX_ELEMENTS).trajectory

    def of_rhs(t: Array, inside: Array) -> LinearEquation:
        sampled = omega(t, inside)[..., 0].reshape(-1, p, p)
        decay, _, b = moving(t, inside)
        f = np.einsum("nij,nj->ni", sampled, b) + gains * outer(t, inside)[..., p]
        return LinearEquation(None, -decay, f[..., None])

    # From the mesh of Ω on: in one of its elements Ω is a polynomial.
    problem = LinearProblem(
        of_rhs, start[:, p:], name="filter of the regression", floor=sizes[:, p:]
    )
    rhs = solve(problem, omega.mesh, tol=TOLERANCE, max_elements=_MAX_ELEMENTS).trajectory
    t, inside = rhs.mesh.points.ravel(), rhs.mesh.inside.ravel()
    both = np.concatenate(
        [omega(t, inside).reshape(-1, p, p), rhs.values.reshape(-1, p, 1)], axis=2
    )
    return rhs.mesh.trajectory(both)
