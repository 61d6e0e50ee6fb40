"""What noise of the signals does to the regression and to the state."""

from __future__ import annotations

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.kernels.arrays import joined
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearProblem
from gpebo_cli.observers.reduced.extension import ReducedSystem
from gpebo_cli.observers.reduced.matrices import ObserverMatrices
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem

_RESPONSE = 1e-6  # error of the response to noise, which is known to no more digits than that


def errors_of(reduced: ReducedSystem, kept: IntArray) -> ErrorsAt:
    """Errors e of [u; y], what they add to Y (rows ``kept`` (k,)), and to the state's offset.

    ζ' = A_0 ζ + b_0(e),    δY = R (𝒜 ζ + g_y(e)),    δoffset = ζ − K (𝒜 ζ + g_y(e))
    """
    return lambda t, inside: error_system(reduced.matrices(t, inside), kept, reduced.system.m)


def error_system(o: ObserverMatrices, kept: IntArray | slice, inputs: int) -> ErrorSystem:
    """The same from the matrices at N times, of the rows ``kept`` (k,), for a number of inputs."""
    R, H, Q1 = o.residual[:, kept], o.elimination, transpose(o.range)
    g = o.of_noise(o.g_signals, inputs)
    return ErrorSystem(
        o.dynamics, o.of_noise(o.from_signals, inputs),
        joined(R @ o.on_basis, o.split.basis - H @ (Q1 @ o.on_basis), axis=1),
        joined(R @ g, -H @ (Q1 @ g), axis=1),
    )


def respond(mesh: Mesh, errors_at: ErrorsAt, rows: int, e_u: Array, e_y: Array) -> Array:
    """What errors e_u (K, s + 1, m, c) and e_y (K, s + 1, r, c) add to Y, (K, s + 1, rows, c).

    All columns in one solve on the mesh of the regression, in whose elements errors are smooth
    (SolverError: the mesh does not resolve the response).
    """
    errors = Trajectory(mesh, np.concatenate([e_u, e_y], axis=2))
    size = errors_at(mesh.edges[:1], mesh.inside[0, :1]).A.shape[1]
    problem = LinearProblem(
        lambda t, inside: errors_at(t, inside).driven(errors(t, inside), rows),
        np.zeros((size, e_y.shape[-1])), name="response to noise",
    )
    solution = solve(problem, mesh, tol=np.inf, max_elements=mesh.size)
    if solution.error_estimate > _RESPONSE:
        raise SolverError(
            f"noise.seeds: the response to noise is resolved to {solution.error_estimate:.1e} only;"
            " lower noise.sample_time or solver.tol"
        )
    algebraic, direct = solution.extras
    return np.asarray(algebraic @ solution.trajectory.values + direct)
