"""What noise of the signals does to the regression."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.collocation import LinearEquation, LinearProblem, solve
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers.reduced.matrices import ObserverMatrices

_RESPONSE = 1e-6  # error of the response to noise, which is known to no more digits than that


def respond(
    mesh: Mesh, matrices: Callable[[Array, Array], ObserverMatrices], kept: IntArray,
    e_u: Array, e_y: Array,
) -> Array:
    """What errors of the signals add to Y, all columns in one solve on the mesh as it is.

        ζ' = A_0 ζ + b_0(e_u, e_y),  ζ(start) = 0,      δY = R (𝒜 ζ + g_y(e_u, e_y))

    Args:
        mesh: of the regression; errors are smooth within its elements.
        matrices: of the observer at times.
        kept: rows of the residual that are the regression.
        e_u: of the inputs at the points of the mesh, (K, s + 1, m, c).
        e_y: of the outputs, (K, s + 1, r, c).

    Returns:
        δY (K, s + 1, rows, c).

    Raises:
        SolverError: the mesh does not resolve the response.
    """
    errors = Trajectory(mesh, np.concatenate([e_u, e_y], axis=2))

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        o, e = matrices(t, inside), errors(t, inside)
        R = o.residual[:, kept]
        seen = (R @ o.algebraic @ o.split.basis, (R @ o.g_signals) @ e)
        return LinearEquation(None, o.dynamics, o.from_signals @ e, seen)

    size = matrices(mesh.edges[:1], mesh.inside[0, :1]).split.basis.shape[1]
    start = np.zeros((size, e_y.shape[-1]))
    problem = LinearProblem(coefficients, start, name="response to noise")
    solution = solve(problem, mesh, tol=np.inf, max_elements=mesh.size)
    if solution.error_estimate > _RESPONSE:
        raise SolverError(
            f"noise.seeds: the response to noise is resolved to {solution.error_estimate:.1e} only;"
            " lower noise.sample_time or solver.tol"
        )
    algebraic, direct = solution.extras
    return np.asarray(algebraic @ solution.trajectory.values + direct)
