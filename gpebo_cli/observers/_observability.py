"""Uniform observability of a linear time-varying system, as evidence.

    M(t) = ∫_t^{t+T} Ψ(τ,t)ᵀ W(τ) Ψ(τ,t) dτ,      Ψ' = A Ψ,  Ψ(t,t) = I,      W = cᵀV⁻¹c

is what the measurements of one window tell about the state at its start, in units of P⁻¹. Kalman's
uniform complete observability is a lower (and upper) bound on M(t) over all t; excitation (IE) is
M > 0 for one window, the whole horizon. Windows are summed from elements, each of which starts
with Ψ = I, so that nothing grows over the horizon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule

_WINDOWS = 10  # to a horizon
_STAGES = 6  # at least: products that begin anew in every element look rough to fewer


@dataclass(frozen=True, eq=False)
class WindowGramians:
    """M over windows that start at some edges of a mesh and last ``window`` seconds or more."""

    starts: Array  # (W,)
    gramians: Array  # (W, n, n)
    window: float


def window_gramians(
    model: Callable[[Array, Array], tuple[Array, Array]], n: int, mesh: Mesh, *, tol: float,
    max_elements: int,
) -> WindowGramians:
    """M over windows of a tenth of the horizon, from every edge that leaves room for one.

    ``model`` gives A and W (N, n, n) at times (N,); ``tol`` is relative to the size of Ψ and of
    what is integrated.
    """

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        A, W = model(t, inside)
        return LinearEquation(None, A, np.zeros((len(A), n, n)), (W,))

    def products(values: Array, extras: tuple[Array, ...]) -> Array:
        return np.asarray(transpose(values) @ extras[0] @ values)

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[tuple[Array, float]]:
        found = products(values, extras)
        return [(found.reshape(*found.shape[:2], -1), 0.0)]

    problem = LinearProblem(
        coefficients, np.eye(n), monitor, "observability Gramian",
        renewal=lambda reached: np.eye(len(reached)),
    )
    mesh = replace(mesh, rule=radau_rule(max(mesh.rule.stages, _STAGES)))
    solution = solve(problem, mesh, tol=tol, max_elements=max_elements)
    mesh, values = solution.trajectory.mesh, solution.trajectory.values
    local = Trajectory(mesh, products(values, solution.extras)).integral(local=True).values[:, -1]
    return _sum_windows(mesh, values[:, -1], local)


def _sum_windows(mesh: Mesh, transition: Array, local: Array) -> WindowGramians:
    """M of all windows from Ψ over each element and its own integral, (K, n, n) each."""
    edges = mesh.edges
    window = float(edges[-1] - edges[0]) / _WINDOWS
    slack = 1e-9 * window
    first = np.flatnonzero(edges[:-1] + window <= edges[-1] + slack)
    after = np.searchsorted(edges, edges[first] + window - slack)  # the edge that ends the window
    n = local.shape[-1]
    gramians = np.zeros((len(first), n, n))
    reached = np.broadcast_to(np.eye(n), gramians.shape).copy()
    for step in range(int((after - first).max(initial=0))):
        on = np.flatnonzero(first + step < after)
        k = first[on] + step
        gramians[on] += transpose(reached[on]) @ local[k] @ reached[on]
        reached[on] = transition[k] @ reached[on]
    return WindowGramians(mesh.points[first, 0], gramians, window)
