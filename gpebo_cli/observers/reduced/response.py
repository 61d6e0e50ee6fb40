"""What noise of the signals does to the regression and to the state."""

from __future__ import annotations

from collections.abc import Callable

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
    added, _, error = driven(
        errors_at, errors, mesh, np.zeros((size, e_y.shape[-1])), rows, tol=np.inf,
        max_elements=mesh.size,
    )
    if error > _RESPONSE:
        raise SolverError(
            f"noise.seeds: the response to noise is resolved to {error:.1e} only; lower "
            "noise.sample_time or solver.tol"
        )
    return added.values


def driven(
    errors_at: ErrorsAt, errors: Callable[[Array, Array], Array], mesh: Mesh, start: Array,
    rows: int | None = None, *, tol: float, max_elements: int, floor: Array | float = 0.0,
) -> tuple[Trajectory, Array, float]:
    """What errors (N, m + r, c) add to Y and the offset, or to Y (rows, c), from ζ = ``start``.

    Beside it stand ζ (k, c) at the end and an error estimate. Below sizes ``floor`` (k, c) ζ is not
    resolved for its own sake.
    """
    problem = LinearProblem(
        lambda t, inside: errors_at(t, inside).driven(errors(t, inside), rows), start,
        name="response to errors of the signals", floor=floor,
    )
    solution = solve(problem, mesh, tol=tol, max_elements=max_elements)
    z, (C, direct) = solution.trajectory, solution.extras
    return Trajectory(z.mesh, C @ z.values + direct), z.final, solution.error_estimate
