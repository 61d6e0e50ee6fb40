"""Parameters that move by known dynamics: η' = 𝔸 η + 𝕓 (observer.remedy: current_coordinates)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import gamma, pi, sqrt

import numpy as np

from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.model.expressions.bounds import halved, with_others
from gpebo_cli.numerics.collocation import merged, solve
from gpebo_cli.numerics.linalg import largest_over_time, transpose
from gpebo_cli.numerics.mesh import SHARE, Mesh, Trajectory, joined, unresolved_kinds
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import RadauRule, radau_rule
from gpebo_cli.numerics.refinement import refine
from gpebo_cli.regression.resets import ExtensionState, Known

TOLERANCE = 1e-12
_MAX_ELEMENTS = 200_000
_ADVICE = "use another observer.remedy, or a shorter time.horizon"
_LEVELS, _BESIDE_TIES = 96, 0.1234  # of ρ, a decade; none of them is at a round number
_SHORT = 0.01  # of a decay's own time
_STAGES = 7  # up to which more of them are cheaper than more elements
_GROWTH = 1e3  # within an element: as many digits are lost


@dataclass(frozen=True, eq=False)
class Dynamics:
    """𝔸 and 𝕓 on one mesh."""

    rows: Trajectory  # (k, p + 1) the last rows of [𝔸 | 𝕓]; above them are zeros
    units: Array  # (p,) in which parameters are comparable

    def at(self, t: Array, inside: Array) -> tuple[Array, Array]:
        """𝔸 (N, p, p) and 𝕓 (N, p) at the times t (N,)."""
        rows = self.rows(t, inside)
        still = rows.shape[2] - 1 - rows.shape[1]
        whole = np.pad(rows, ((0, 0), (still, 0), (0, 0)))
        return whole[..., :-1], whole[..., -1]

    def leaves(self, some: BoolArray) -> bool:
        """Whether some of η (p,) do not move, as unknowns do not."""
        return not some[len(some) - self.rows.values.shape[2] :].any()

    def about(self, columns: IntArray) -> Dynamics:
        """The same for η at ``columns`` (k,), where the others are zero and do not move."""
        rows = self.rows.values[..., [*columns, -1]]
        return Dynamics(Trajectory(self.rows.mesh, rows), self.units[columns])

    @cached_property
    def growth(self) -> float:
        """By which power of e parameters may grow, ∫ of the largest real part or 0."""
        mesh, values = self.rows.mesh, self.rows.values
        rates = fastest(values.reshape(mesh.points.size, *values.shape[2:]))[1]
        return float(mesh.trajectory(rates).integral().final)

    @cached_property
    def forgetting(self) -> tuple[Array, Array]:
        """Times (k,) at which ρ rises, and what it is before, between and after them (k + 1,).

        ρ/2 is the next of 96 rates a decade above the fastest decay of 𝔸 at any time so far. A
        decay that has gone on for less than 0.01 of its own time does not count.
        """
        mesh, values = self.rows.mesh, self.rows.values
        start = mesh.span[0]

        def needed(t: Array, rows: Array) -> Array:
            rate = fastest(rows)[0]
            some = rate * (t - start) > _SHORT
            level = np.ceil(_LEVELS * np.log10(np.where(some, rate, 1.0)) - _BESIDE_TIES)
            return np.where(some, level, -np.inf)

        t = mesh.points.ravel()
        found = needed(t, values.reshape(t.size, *values.shape[2:]))
        levels, times = [-np.inf], list[float]()
        for k in np.flatnonzero(np.diff(np.maximum.accumulate(found)) > 0.0):
            while levels[-1] < found[k + 1]:
                at = halved(
                    lambda t: np.where(needed(t, self.rows(t)) > levels[-1], 1.0, -1.0),
                    np.array([-1.0]), t[k : k + 1], t[k + 1 : k + 2],
                )
                there = float(needed(at, self.rows(at))[0])
                times.append(float(at[0]))
                levels.append(there if there > levels[-1] else float(found[k + 1]))
        return np.array(times), 2.0 * 10.0 ** ((np.array(levels) + _BESIDE_TIES) / _LEVELS)


def fastest(rows: Array) -> tuple[Array, Array]:
    """Rates of the fastest decay and growth, (N,) each, or 0, of the last rows (N, k, p + 1).

    They are found where a matrix differs from the one before it.
    """
    A = rows[..., -1 - rows.shape[1] : -1]
    fresh = np.append(True, (A[1:] != A[:-1]).any(axis=(1, 2)))
    real = np.linalg.eigvals(A[fresh]).real
    which = fresh.cumsum() - 1
    return -real.min(axis=1, initial=0.0)[which], real.max(axis=1, initial=0.0)[which]


def filtered(
    outer: Trajectory, rates: Array, gains: Array, dynamics: Dynamics, known: Known = ()
) -> Trajectory:
    """[Ω | 𝒴] (p, p + 1) with Ω η = 𝒴 at every time, for η that moves.

        Ω' = −(Λ + ρI)Ω − 𝔸ᵀΩ − Ω𝔸 + Γψᵀψ,    𝒴' = −(Λ + ρI)𝒴 − 𝔸ᵀ𝒴 + Ω𝕓 + Γψᵀy

    Nothing in it grows as solutions of η' = 𝔸η do; in directions that decay, Ω would grow as the
    square of their inverse, which the forgetting ρ(t) makes up for, twice the rate of the fastest
    decay so far. ``outer`` is [ψᵀψ | ψᵀy] (p, p + 1), and Λ and Γ have the diagonals ``rates`` and
    ``gains`` (p,). It goes on from what is ``known``, see :func:`state_of`, or starts at zero.
    """
    p, units = outer.values.shape[2], dynamics.units
    # It is solved for comparable parameters: what is small in its unit only is no rounding.
    own = units[:, None] * np.append(units, 1.0)
    outer = Trajectory(outer.mesh, own * outer.values)
    start, sizes = np.zeros((2, p, p + 1))
    if known:
        start, sizes = own * known[0].values, own * known[0].level
    pieces, (times, levels) = list[Trajectory](), dynamics.forgetting
    rule = _rule(outer.mesh, float(rates.max(initial=0.0) + levels[-1]))

    def moving(t: Array, inside: Array) -> tuple[Array, Array, Array]:
        """Λ + ρI + 𝔸ᵀ and 𝔸 (N, p, p), and 𝕓 (N, p)."""
        (A, b), rho = dynamics.at(t, inside), levels[np.searchsorted(times, inside)]
        A = A * units / units[:, None]
        return transpose(A) + (rates + rho[:, None])[:, None] * np.eye(p), A, b / units

    for window in outer.mesh.windows():
        within = times[(times > window.span[0]) & (times < window.span[1])]
        finer = Mesh(with_others(window.edges, within), rule)
        arguments = finer, outer, gains, moving, start, sizes
        pieces.append(_carried(*arguments) or _over(*arguments))
        start = pieces[-1].final
        sizes = np.maximum(sizes, largest_over_time(pieces[-1].values, 2))
    found = joined(pieces)
    return Trajectory(found.mesh, found.values / own)


def _rule(mesh: Mesh, rate: float) -> RadauRule:
    """That of a mesh, or one of more stages, which e^{−rate t} needs in the usual element.

    Its Legendre coefficients are √π xⁿ/Γ(n + ½), x = rate h/4. Cuts would make more points.
    """
    x, stages = 0.25 * rate * float(np.median(mesh.steps)), mesh.rule.stages
    while stages < _STAGES and sqrt(pi) * x ** (stages + 1) > TOLERANCE * gamma(stages + 1.5):
        stages += 1
    return radau_rule(stages)


def state_of(extended: Trajectory, known: Known) -> ExtensionState:
    """From what :func:`filtered` goes on after [Ω | 𝒴] (p, p + 1), made of what was ``known``."""
    sizes = largest_over_time(extended.values, 2)
    return ExtensionState(extended.final, np.maximum(sizes, known[0].level) if known else sizes)


def _carried(
    mesh: Mesh, outer: Trajectory, gains: Array,
    moving: Callable[[Array, Array], tuple[Array, Array, Array]], start: Array, sizes: Array,
) -> Trajectory | None:
    """:func:`_over` for short elements, where nothing grows much; None: something does.

    W' = (𝔸 + Λ + ρI) W and N' = [[𝔸, −𝕓], [0, 0]] N, which start at I in each element, make

        (Wᵀ [Ω | 𝒴] N)' = Wᵀ Γψᵀ[ψ | y] N

    an integral: systems have p equations instead of the p² of Ω.
    """
    p, rule = len(start), mesh.rule

    def maps(mesh: Mesh, some: BoolArray) -> list[Array]:
        """At the nodes of some elements W⁻ᵀ, the integral from the left end, N⁻¹, and sizes."""
        h, t, inside = mesh.steps[some], mesh.points[some], mesh.inside[some]
        decay, A, b = moving(t.ravel(), inside.ravel())
        own, count = np.arange(len(h)), len(h)

        def solved(A: Array, f: Array) -> tuple[Array, Array]:
            return elements.element_maps(
                rule.differentiation, h, None, A, f, None, None, own, count
            )

        W = transpose(solved(transpose(decay), np.zeros((1, p, 0)))[0])
        N = np.zeros((count, rule.stages, p + 1, p + 1))
        N[..., p, p] = 1.0
        N[..., :p, :p], N[..., :p, p:] = solved(A, -b[..., None])
        forced = gains[:, None] * outer(t[:, 1:].ravel(), inside[:, 1:].ravel())
        added = W @ forced.reshape(count, rule.stages, p, p + 1) @ N
        weights = h[:, None, None] * rule.integration
        added = (weights @ added.reshape(count, rule.stages, -1)).reshape(added.shape)
        back, forth = np.asarray(np.linalg.inv(W)), np.asarray(np.linalg.inv(N))
        largest = [np.abs(x).max(axis=(1, 2, 3), initial=0.0) for x in (W, N, back, forth)]
        return [back, added, forth, np.stack(largest, axis=1)]

    def evaluate(
        mesh: Mesh, before: tuple[list[Array], Array] | None, kept: IntArray
    ) -> tuple[tuple[list[Array], Array], Array]:
        parts = first if before is None else merged(before[0], maps(mesh, kept < 0), kept)
        back, added, forth, _ = parts
        values = np.empty((mesh.size, rule.stages + 1, p, p + 1))
        reached = start
        for k in range(mesh.size):
            values[k, 0] = reached
            reached = back[k, -1] @ (reached + added[k, -1]) @ forth[k, -1]
        values[:, 1:] = back @ (values[:, :1] + added) @ forth
        kinds = []
        for part in (np.s_[..., :p], np.s_[..., p:]):
            signal = values[part].reshape(*values.shape[:2], -1)
            least = SHARE * np.abs(signal).max(initial=0.0)
            kinds.append((signal, np.maximum(sizes[part].ravel(), least)))
        return (parts, values), unresolved_kinds(kinds, rule)

    first = maps(mesh, np.ones(mesh.size, dtype=bool))
    if not first[3].max() < _GROWTH:
        return None
    mesh, (_, values), _ = refine(
        evaluate, mesh, tol=TOLERANCE, max_elements=_MAX_ELEMENTS, name="filter of the regressor",
        advice=_ADVICE,
    )
    return Trajectory(mesh, values)


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
        floor=sizes[:, :p].reshape(-1, 1), advice=_ADVICE,
    )
    omega = solve(problem, mesh, tol=TOLERANCE, max_elements=_MAX_ELEMENTS).trajectory

    def of_rhs(t: Array, inside: Array) -> LinearEquation:
        sampled = omega(t, inside)[..., 0].reshape(-1, p, p)
        decay, _, b = moving(t, inside)
        f = np.einsum("nij,nj->ni", sampled, b) + gains * outer(t, inside)[..., p]
        return LinearEquation(None, -decay, f[..., None])

    # From the mesh of Ω on: in one of its elements Ω is a polynomial.
    problem = LinearProblem(
        of_rhs, start[:, p:], name="filter of the regression", floor=sizes[:, p:],
        advice=_ADVICE,
    )
    rhs = solve(problem, omega.mesh, tol=TOLERANCE, max_elements=_MAX_ELEMENTS).trajectory
    found = rhs.mesh.along(omega).values.reshape(*rhs.values.shape[:2], p, p)
    return Trajectory(rhs.mesh, np.concatenate([found, rhs.values], axis=3))
