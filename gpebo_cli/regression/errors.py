"""How small errors go through an observer or an estimator: a linear system of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem

_RESPONSE = 1e-6  # error of the response to noise, which is known to no more digits than that


class ErrorSystem(NamedTuple):
    """s' = A s + B i, o = C s + D i at N times; a leading axis of 1 means constant in time.

    Of an observer i are the errors of u and y, and o those of Y and of the state's offset. Of an
    estimator i are those of Y, and o those of η̂ (mathematics: ζ' = A_0 ζ + B_e e,
    δY = R(𝒜ζ + E e)).
    """

    A: Array  # (N, S, S)
    B: Array  # (N, S, I)
    C: Array  # (N, O, S)
    D: Array  # (N, O, I)

    def with_constants(self, C: Array) -> ErrorSystem:
        """The same with c more s at the end that nothing moves, and C (N or 1, O, c) of these."""
        more, count = C.shape[2], max(len(self.C), len(C))
        C = np.concatenate([
            np.broadcast_to(each, (count, *each.shape[1:])) for each in (self.C, C)
        ], axis=2)
        A = np.pad(self.A, ((0, 0), (0, more), (0, more)))
        return ErrorSystem(A, np.pad(self.B, ((0, 0), (0, more), (0, 0))), C, self.D)


# (times (N,), inside (N,)) -> the system there
ErrorsAt = Callable[[Array, Array], ErrorSystem]


def one_after_another(
    starts: Array, pieces: Callable[[int, Array, Array], ErrorSystem]
) -> ErrorsAt:
    """Systems that each hold from one of the ``starts`` (k,) on, by number, times and inside."""

    def at(t: Array, inside: Array) -> ErrorSystem:
        piece = np.maximum(np.searchsorted(starts, inside, side="right") - 1, 0)
        numbers = np.unique(piece)
        if len(numbers) == 1:
            return pieces(int(numbers[0]), t, inside)
        found: list[Array] = []
        for k in numbers.tolist():
            chosen = piece == k
            for i, part in enumerate(pieces(k, t[chosen], inside[chosen])):
                if len(found) <= i:
                    found.append(np.zeros((len(t), *part.shape[1:])))
                found[i][chosen] = part
        return ErrorSystem(*found)

    return at


class ErrorSteps(NamedTuple):
    """The same of an observer at K samples, with the errors e before and e' after each step.

    ζ' = step [ζ; e; e'], o = C ζ' + D e'.
    """

    step: Array  # (K, S, S + 2 I)
    C: Array  # (K, O, S)
    D: Array  # (K, O, I)

    @classmethod
    def at(cls, step: Array, system: ErrorSystem) -> ErrorSteps:
        """With the outputs of a system at the samples."""
        return cls(step, *(
            np.broadcast_to(part, (len(step), *part.shape[1:])) for part in (system.C, system.D)
        ))


class ErrorRecursion(NamedTuple):
    """The same of an estimator: s' = A s + old δY + new δY', δη̂ = C s'."""

    A: Array  # (K, S, S)
    old: Array  # (K, S, rows)
    new: Array  # (K, S, rows)
    C: Array  # (K, p, S)


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

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        system, e = errors_at(t, inside), errors(t, inside)
        return LinearEquation(
            None, system.A, system.B @ e, (system.C[:, :rows], system.D[:, :rows] @ e)
        )

    problem = LinearProblem(
        coefficients, start, name="response to errors of the signals", floor=floor
    )
    solution = solve(problem, mesh, tol=tol, max_elements=max_elements)
    z, (C, direct) = solution.trajectory, solution.extras
    return Trajectory(z.mesh, C @ z.values + direct), z.final, solution.error_estimate
