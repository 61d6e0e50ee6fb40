"""Simulate a descriptor system of any index: signals as piecewise polynomials on one mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpebo_cli.collocation.linear import (
    Coefficients,
    Constraints,
    LinearProblem,
    LinearSolution,
    solve,
)
from gpebo_cli.collocation.mesh import Mesh, Trajectory, initial_mesh
from gpebo_cli.collocation.radau import radau_rule
from gpebo_cli.errors import ModelError
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation import ivp
from gpebo_cli.simulation.consistency import Jump, consistent_state, jump
from gpebo_cli.simulation.derivative_array import StrangenessFree, Structure, analyse, reduce
from gpebo_cli.systems.descriptor import Array, DescriptorSystem

_FIRST_ELEMENTS = 24  # of the first mesh: enough nodes to notice a pulse, few enough to be free


@dataclass(frozen=True, eq=False)
class Signals:
    """What the observer may see (u, y) and, in a simulation, the truth (x)."""

    inputs: Trajectory  # (m,)
    outputs: Trajectory  # (r,)
    states: Trajectory  # (n,)

    @property
    def mesh(self) -> Mesh:
        """The mesh all three live on."""
        return self.states.mesh


@dataclass(frozen=True, eq=False)
class Simulation:
    """Signals with the evidence of how they were computed."""

    signals: Signals
    structure: Structure
    initial_state: Array  # (n,) consistent
    jumps: tuple[tuple[float, Array, Jump], ...]  # (time, limit from the left, jump)
    error_estimate: float


def simulate(system: DescriptorSystem, time: TimeSettings, solver: SolverSettings) -> Simulation:
    """Solve E x' = A x + B u + F θ from a consistent state near ``system.initial_state``.

    Raises:
        ModelError: not uniquely solvable, index too high, or a rank changes within the horizon.
        SolverError: the tolerance cannot be reached.
    """
    start, stop = time.start, time.start + time.horizon
    structure = analyse(
        system, start, stop, max_mu=solver.max_strangeness_index, rank_tol=solver.rank_tol
    )
    cuts = system.coefficients.breakpoints(start, stop)
    mesh = initial_mesh(start, stop, cuts, _FIRST_ELEMENTS, radau_rule(solver.stages))
    first = reduce(system, structure, mesh.points.ravel(), mesh.inside.ravel())
    x0 = _initial_state(system, first)

    happened: dict[float, tuple[Array, Jump]] = {}
    restarts: dict[float, Callable[[Array], Array]] = {}
    for cut in map(float, cuts):
        restarts[cut] = _restart(system, structure, cut, _width(mesh.edges, cut), happened)

    def coefficients(t: Array, inside: Array) -> Coefficients:
        return _equations(reduce(system, structure, t, inside))

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[tuple[Array, float]]:
        u, C = extras
        y = _outputs(C, values[..., 0])
        # An output may cancel identically (x1 − x2 of two equal states): it is resolved relative
        # to the states.
        size = float(np.abs(C).max(initial=0.0)) * float(np.abs(values).max(initial=0.0))
        return [(u, 0.0), (y, 1e-3 * max(size, floor))]

    # Where the constraints leave nothing of the state asked for, its rounding is no signal.
    floor = 1e-3 * float(np.abs(system.initial_state).max(initial=0.0))
    problem = LinearProblem(coefficients, x0[:, None], monitor, f"plant {system.name}", floor)
    if solver.name == "ivp":
        solution = _integrate(system, structure, problem, mesh, solver, restarts)
    else:
        solution = solve(
            problem, mesh, tol=solver.tol, max_elements=solver.max_elements, restarts=restarts,
            known=_equations(first),
        )
    mesh = solution.trajectory.mesh
    x = solution.trajectory.values[..., 0]
    u, C = solution.extras
    y = _outputs(C, x)
    return Simulation(
        signals=Signals(Trajectory(mesh, u), Trajectory(mesh, y), Trajectory(mesh, x)),
        structure=structure,
        initial_state=x0,
        jumps=tuple((t, *happened[t]) for t in sorted(happened)),
        error_estimate=solution.error_estimate,
    )


def _equations(reduced: StrangenessFree) -> Coefficients:
    """The strangeness-free equations in the form that the collocation takes."""
    extras = (reduced.u, reduced.C)
    f1 = reduced.f1[:, :, None]
    if reduced.basis is None or reduced.offset is None:
        return Coefficients(reduced.E1, reduced.A1, f1, extras)
    constraints = Constraints(reduced.basis, reduced.offset[:, :, None])
    return Coefficients(reduced.E1, reduced.A1, f1, extras, constraints)


def _initial_state(system: DescriptorSystem, reduced: StrangenessFree) -> Array:
    """The consistent state at the start, from the equations at times of which it is the first."""
    x0 = consistent_state(reduced, system.initial_state)
    if not np.isfinite(x0).all():
        raise ModelError(
            f"plant {system.name}: no finite consistent state at the start; look for entries that "
            "are huge or infinite there"
        )
    return x0


def _width(edges: Array, cut: float) -> float:
    """How far from a jump to look at the functions on either side of it."""
    k = int(np.searchsorted(edges, cut))
    return 1e-3 * float(min(edges[k + 1] - edges[k], edges[k] - edges[k - 1]))


def _restart(
    system: DescriptorSystem, structure: Structure, t: float, width: float,
    happened: dict[float, tuple[Array, Jump]],
) -> Callable[[Array], Array]:
    def restart(before: Array) -> Array:
        what = jump(system, structure, t, width, before[:, 0])
        happened[t] = (before[:, 0].copy(), what)
        return what.after[:, None]

    return restart


def _outputs(C: Array, x: Array) -> Array:
    """y = C x at points (K, s + 1)."""
    return np.asarray(np.matmul(C, x[..., None])[..., 0])


def _integrate(
    system: DescriptorSystem, structure: Structure, problem: LinearProblem, mesh: Mesh,
    solver: SolverSettings, restarts: dict[float, Callable[[Array], Array]],
) -> LinearSolution:
    """The independent path: the underlying ODE of the derivative array, by scipy."""

    def explicit(t: Array, inside: Array) -> Coefficients:
        A, f = ivp.underlying_ode(system, structure, t, inside)
        c = system.coefficients.taylor(t, 0, inside)
        return Coefficients(None, A, f[:, :, None], (c.u[0], c.C[0]))

    ode = LinearProblem(
        explicit, problem.start, problem.monitor, problem.name, problem.floor
    )
    return ivp.solve(
        ode, mesh, tol=solver.tol, max_elements=solver.max_elements, restarts=restarts
    )
