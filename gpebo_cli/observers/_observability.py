"""Uniform observability of a linear time-varying system, as evidence.

    M(t) = ∫_t^{t+T} Ψ(τ,t)ᵀ W(τ) Ψ(τ,t) dτ,      Ψ' = A Ψ,  Ψ(t,t) = I,      W = cᵀV⁻¹c

is what the measurements of one window tell about the state at its start, in units of P⁻¹. Kalman's
uniform complete observability is a lower (and upper) bound on M(t) over all t; excitation (IE) is
M > 0 for one window, the whole horizon. Windows are summed from elements, each of which starts
with Ψ = I, so that nothing grows over the horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.errors import EPS
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Kind, Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule

_WINDOWS = 10  # to a horizon
_STARTS = 20  # of windows within one: they do not hang on a mesh
_SAME = 1e-9  # of a window: times that are no different
_STAGES = 6  # at least: with fewer, many more elements are needed


def window_gramians(
    model: Callable[[Array, Array], tuple[Array, Array]], n: int, mesh: Mesh, *, tol: float,
    max_elements: int,
) -> tuple[Array, Array, float]:
    """M (W, n, n) over windows of a tenth of the horizon, when these begin (W,), and its length.

    They begin at times of equal distance. ``model`` gives A and W (N, n, n) at times (N,); ``tol``
    is relative to the largest M of a window.
    """

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        A, W = model(t, inside)
        return LinearEquation(None, A, np.zeros((len(A), n, n)), (W,))

    def products(values: Array, extras: tuple[Array, ...]) -> Array:
        return np.asarray(transpose(values) @ extras[0] @ values)

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[Kind]:
        found = values * size[:, None] / size, products(values, extras) / (size[:, None] * size)
        return [(each.reshape(*each.shape[:2], n * n), least) for each in found]

    problem = LinearProblem(
        coefficients, np.eye(n), monitor, "observability Gramian",
        renewal=lambda reached: np.eye(len(reached)), told=True,
    )
    edges, (start, stop) = mesh.edges, mesh.edges[[0, -1]]
    window, grid = (stop - start) / _WINDOWS, np.linspace(start, stop, _WINDOWS * _STARTS + 1)
    near = edges[np.searchsorted(edges, grid - _SAME * window).clip(max=mesh.size)]
    grid = np.where(np.abs(near - grid) <= _SAME * window, near, grid)
    mesh = replace(mesh, edges=np.union1d(edges, grid), rule=radau_rule(
        max(mesh.rule.stages, _STAGES)
    ))

    def over_windows(tol: float) -> tuple[Array, float]:
        worst = 0.0
        found: list[tuple[Array, Array, Array]] = []
        for part in mesh.windows():
            solution = solve(problem, part, tol=tol, max_elements=max_elements)
            own, values = solution.trajectory.mesh, solution.trajectory.values
            worst = max(worst, solution.error_estimate)
            weighed = Trajectory(own, products(values, solution.extras))
            local = weighed.integral(local=True).values[:, -1]
            first = np.append(0, np.flatnonzero(np.isin(own.edges[1:-1], grid)) + 1)
            after = np.append(first[1:], own.size)
            found.append((own.edges[first], *_summed(values[:, -1], local, first, after)))
        starts, transition, local = map(np.concatenate, zip(*found, strict=True))
        first = np.searchsorted(starts, grid[:-_STARTS])
        after = np.searchsorted(np.append(starts, stop), grid[_STARTS:])
        return _summed(transition, local, first, after)[1], worst

    size: Array = np.ones(n)
    least: Array | float = 0.0
    gramians, worst = over_windows(np.inf)
    if worst > tol:
        # Products begin anew in every element, and are small there beside what they are in a
        # window: that is what they are resolved for, and known well enough from the mesh as it is.
        size = np.sqrt(np.einsum("wii->wi", gramians).max(axis=0) / window)
        size = np.maximum(size, EPS * size.max(initial=0.0)) if size.any() else np.ones(n)
        least = np.ones(n * n)
        gramians, _ = over_windows(tol)
    return gramians, mesh.origin + grid[:-_STARTS], float(window)


def _summed(
    transition: Array, local: Array, first: IntArray, after: IntArray
) -> tuple[Array, Array]:
    """Ψ and M (W, n, n) over elements ``first`` to ``after`` (W,), from those of each (K, n, n)."""
    n = local.shape[-1]
    gramians = np.zeros((len(first), n, n))
    reached = np.broadcast_to(np.eye(n), gramians.shape).copy()
    for step in range(int((after - first).max(initial=0))):
        on = np.flatnonzero(first + step < after)
        k = first[on] + step
        gramians[on] += transpose(reached[on]) @ local[k] @ reached[on]
        reached[on] = transition[k] @ reached[on]
    return reached, gramians
