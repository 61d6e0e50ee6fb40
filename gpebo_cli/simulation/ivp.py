"""The independent path: the same linear problems through ``scipy.integrate.solve_ivp``.

It shares with the collocation engine nothing but the mesh on which results are stored: another
integrator (DOP853), and for the plant another reduction (the underlying ODE instead of the
strangeness-free equations). It exists to check the engine, and is selected by ``solver=ivp``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import count, pairwise

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.kernels.structure_numpy import derivative_array, scaled
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.collocation import LinearSolution, unresolved_signals
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearProblem, at_points
from gpebo_cli.numerics.refinement import refine
from gpebo_cli.reduction.strangeness_free import forcing
from gpebo_cli.reduction.structure import Structure

_COARSER = 1e3  # times the tolerance, to which the mesh resolves: dense output is of lower order
_LOOK, _MOST = 2000, 200_000  # evaluations: after the first it is known whether more are needed


_Found = tuple[Array, tuple[Array, ...]]  # values, and what the monitor needs


def underlying_ode(
    system: DescriptorSystem, structure: Structure, t: Array, inside: Array
) -> tuple[Array, Array]:
    """x' = A x + f from one differentiation more than the strangeness index.

    The derivative array of order μ + 1 determines x_1 = x' uniquely (it is 1-full), so the first
    n rows of its minimum-norm solution are the ODE, A (N, n, n) and f (N, n). Solutions drift off
    the constraints slowly; the tolerance of the check is chosen accordingly.
    """
    n, scaling = system.n, structure.scaling
    M, N, g, _, _ = _array(system, structure, t, inside, structure.mu + 1)
    inverse = np.linalg.pinv(M, rcond=structure.rank_tol)[:, :n]
    # Back from x̃ = x/columns and time t/τ.
    back = scaling.columns[:, None] / scaling.time
    return back * (inverse @ N) / scaling.columns, (back * (inverse @ g))[:, :, 0]


def _array(
    system: DescriptorSystem, structure: Structure, t: Array, inside: Array, mu: int
) -> tuple[Array, Array, Array, Array, Array]:
    """M, N and g (N, (μ + 1) n, 1) of the derivative array, scaled, and E and A it is made of."""
    c = system.coefficients.taylor(t, mu, inside)
    scaling = structure.scaling
    e, a = scaled(c.E, c.A, scaling.rows, scaling.columns, scaling.time, mu + 1)
    M, N = derivative_array(e, a, mu)
    weights = (scaling.time ** np.arange(mu + 1))[:, None] * scaling.rows
    g = np.moveaxis(forcing(c) * weights[:, None, :], 0, 1).reshape(len(t), -1, 1)
    return M, N, g, e, a


def consistent_start(
    system: DescriptorSystem, structure: Structure, t: Array, inside: Array
) -> Array:
    """``consistent_state`` (n,) of this path: what jumps leave is told by the adjoint equation.

    For every smooth solution of Eᵀp' = −(A + E')ᵀp, (pᵀE x)' = pᵀf: pᵀE x does not jump where x
    does. The consistent p are those that the constraints of that equation leave.
    """
    scaling, x0, mu = structure.scaling, system.initial_state, structure.mu
    M, N, g, e, a = _array(system, structure, t, inside, mu)
    slope = np.arange(1, mu + 1)[:, None, None, None] * e[1:]
    turned = -a - np.concatenate([slope, 0.0 * e[:1]])  # more of E' has no effect
    adjoint = derivative_array(np.swapaxes(e, 2, 3), np.swapaxes(turned, 2, 3), mu)

    def constraints(M: Array, N: Array) -> tuple[Array, Array]:
        """Z2ᵀ and Z2ᵀN."""
        Z2 = np.linalg.svd(M[0])[0][:, len(M[0]) - structure.a :]
        return Z2.T, Z2.T @ N[0]

    kept = np.linalg.svd(constraints(*adjoint)[1])[2][structure.a :] @ e[0, 0]
    Z2, A2 = constraints(M, N)
    missed = Z2 @ g[0, :, 0] + A2 @ (x0 / scaling.columns)
    whole, right = np.concatenate([kept, A2]), np.concatenate([np.zeros(len(kept)), -missed])
    size = np.linalg.norm(whole, axis=1)
    return np.asarray(x0 + scaling.columns * np.linalg.solve(whole / size[:, None], right / size))


def solve(
    problem: LinearProblem, mesh: Mesh, *, tol: float, max_elements: int,
    restarts: Mapping[float, Callable[[Array], Array]] | None = None,
) -> LinearSolution:
    """Same meaning as :func:`gpebo_cli.numerics.collocation.solve`, for E = I (n, n) only.

    SolverError: solve_ivp gave up, or the mesh cannot resolve the result.
    """
    plain = replace(problem, units=None)

    def evaluate(mesh: Mesh, _: object, kept: IntArray) -> tuple[_Found, Array]:  # noqa: ARG001
        values = _sample(problem, mesh, max(tol, 1e-13), restarts or {})
        extras = problem.coefficients(mesh.points.ravel(), mesh.inside.ravel()).extras
        extras = tuple(at_points(e, mesh.size, mesh.rule.stages) for e in extras)
        sizes = largest_over_time(values, 2)
        tail = unresolved_signals(plain, mesh.rule, values, extras, sizes, tol)
        return (values, extras), tail

    mesh, (values, extras), tail = refine(
        evaluate, mesh, tol=_COARSER * tol, max_elements=max_elements,
        name=f"{problem.name} (solver=ivp)",
    )
    # What a looser tolerance changes tells how far errors of steps have grown.
    rough = _sample(problem, mesh, max(10.0 * tol, 1e-12), restarts or {})
    sizes = largest_over_time(values, 2)
    beside = np.maximum(sizes, 1e-9 * sizes.max(initial=1e-100))
    errors = largest_over_time(values - rough, 2) / beside
    errors = np.maximum(errors, max(tail.max(initial=0.0), 1e2 * tol))
    estimate = float(errors.max(initial=1e2 * tol))
    return LinearSolution(Trajectory(mesh, values), estimate, errors, None, extras)


def _sample(
    problem: LinearProblem, mesh: Mesh, tol: float,
    restarts: Mapping[float, Callable[[Array], Array]],
) -> Array:
    """Integrate piece by piece between restarts, sampled at all points of the mesh."""
    from scipy.integrate import solve_ivp

    shape = problem.start.shape
    values = np.empty((mesh.size, mesh.rule.stages + 1, *shape))
    cuts = sorted({0, mesh.size, *(int(np.searchsorted(mesh.edges, t)) for t in restarts)})
    state = problem.start
    for first, last in pairwise(cuts):
        left, right = mesh.edges[first], mesh.edges[last]
        if first:
            state = restarts[float(left)](state)
        if not np.isfinite(state).all():
            raise SolverError(
                f"solver=ivp: the {problem.name} is beyond all numbers at t = {left:.6g}"
            )
        margin = 1e-9 * (right - left)

        def derivative(
            t: float, x: Array, low: float = left + margin, high: float = right - margin,
            calls: Iterator[int] = count(1),  # noqa: B008 - one for each piece is what is meant
        ) -> Array:
            """ẋ (n m,), or SolverError where it is asked for too often."""
            called = next(calls)
            if called > _LOOK and called * (high - low) > _MOST * (t - low):
                raise SolverError(
                    f"solver=ivp: near t = {t:.6g} the {problem.name} takes more steps than an "
                    "explicit method can make; use solver=collocation"
                )
            c = problem.coefficients(np.array([t]), np.array([min(max(t, low), high)]))
            return np.asarray((c.A[0] @ x.reshape(shape) + c.f[0]).ravel())

        t = mesh.points[first:last].ravel()
        unique, where = np.unique(t, return_inverse=True)
        with np.errstate(over="ignore", invalid="ignore"):  # of what grows, which fails below
            solution = solve_ivp(
                derivative, (left, right), state.ravel(), method="DOP853", t_eval=unique,
                rtol=tol, atol=tol * 1e-2 * float(np.abs(state).max(initial=1e-3)),
            )
        if not solution.success:
            reached = solution.t[-1] if len(solution.t) else left
            raise SolverError(
                f"solver=ivp: the {problem.name} failed after t = {reached:.6g}: {solution.message}"
            )
        piece = solution.y.T[where].reshape(last - first, mesh.points.shape[1], *shape)
        values[first:last] = piece
        state = piece[-1, -1]
    return values
