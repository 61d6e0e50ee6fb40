"""Simulate a descriptor system of any index: signals as piecewise polynomials on one mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np

from gpebo_cli.errors import ModelError, SolverError
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem, check_sizes, distinct
from gpebo_cli.model.text import TextCoefficients, blur_of
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.errors import EPS, NOTHING, TINY, least_sizes, nothing_left
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import SHARE, Kind, Mesh, Trajectory
from gpebo_cli.numerics.problem import Constraints, LinearEquation, LinearProblem
from gpebo_cli.numerics.refinement import RoundingError
from gpebo_cli.reduction.consistency import Jump, consistent_state, jumps
from gpebo_cli.reduction.strangeness_free import (
    StrangenessFree,
    direct_part,
    shown_rounding,
    strangeness_free_form,
)
from gpebo_cli.reduction.structure import Structure, growth_rates
from gpebo_cli.schema import checked
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation import ivp
from gpebo_cli.simulation.known import SHORT, few_elements, first_mesh, known_resolved, least_beside
from gpebo_cli.simulation.large import SMALL, dense_structure, large_simulation
from gpebo_cli.simulation.linearised import Linearised, looked_along
from gpebo_cli.simulation.newton import follow
from gpebo_cli.simulation.signals import Signals, Simulation

_SHARES = np.linspace(0.0, 1.0, 9)  # of the horizon, where numbers may be too large
_LOOKED_AT = 32  # times at which the mixing of states is looked at
_MOST_ALIKE, _LOOKED_AT_FOR_GROWTH = 6000, 2000  # elements: more are cut only where it grows
_MOST_FOR_GROWTH = 1 << 26  # numbers; beyond them elements are cut only where that is seen to help
_AT_ONCE = 128  # elements of which all equations are held
_LOOKS = 4  # at what entries do along a solution that is found closer and closer
_LITTLE = 1e-11  # of a state: rounding of constraints of which a bound is below is not looked at
_SAME = 1e3  # tolerances, by which a closer look moves nothing


def simulate(system: DescriptorSystem, time: TimeSettings, solver: SolverSettings) -> Simulation:
    """Solve E x' = A x + B u + F θ + φ from the state that follows from ``initial_state``.

    Raises:
        ModelError: not uniquely solvable, index too high, or a rank changes within the horizon.
        SolverError: the tolerance cannot be reached, or the solution ends within the horizon.
        ConfigError: an entry without a finite value, or one that is too large to compute with, or
            a setting out of its range.
    """
    time, solver = checked(time, "time"), checked(solver, "solver")
    check_sizes(system, time.start + time.horizon * _SHARES)
    if not system.depends_on_outputs:
        simulation = None
        if system.n > SMALL and solver.name == "collocation":
            simulation = large_simulation(system, time, solver)
        if simulation is None:
            simulation = _simulate_linear(system, time, solver)
        if simulation.lost is not None:
            raise nothing_left(f"plant {system.name}", simulation.lost)
        return simulation
    first_mesh(system, time, solver)  # windows would try a pole, or the end of a table, up to it
    last: list[Simulation] = []

    def solve_linear(
        linear: DescriptorSystem, window: TimeSettings, settings: SolverSettings, growth: float
    ) -> Trajectory | None:
        structure = dense_structure(linear, window, settings)
        if structure.growth > growth:
            return None
        with np.errstate(all="ignore"):  # an iterate need not be finite
            last[:] = [_simulate_linear(linear, window, settings, structure)]
        return last[0].signals.states

    plant, source, before = system, cast(TextCoefficients, system.coefficients), None
    for _ in range(_LOOKS):
        effort = follow(plant, time, replace(solver, name="collocation"), solve_linear)
        found = last[0]
        x, y = found.signals.states, found.signals.outputs
        if before is not None:
            moved = np.abs(x.values - x.mesh.along(before).values).max(axis=(0, 1))
            if (moved <= _SAME * solver.tol * np.abs(x.values).max(axis=(0, 1))).all():
                break
        known = Trajectory(x.mesh, np.concatenate([found.signals.inputs.values, y.values], axis=2))
        cells, bounded = looked_along(plant, known)
        if len(cells) == len(x.mesh.edges):
            break
        plant, before = replace(system, coefficients=source.with_cells(cells)), x
    else:
        bounded = False  # each closer look moved the solution
    if solver.name == "ivp":
        # Along a guess that is wrong by δ, the independent path is wrong by δ² only.
        linear = replace(system, coefficients=Linearised(system, found.signals.states))
        found = _simulate_linear(linear, time, solver)
    errors = found.state_errors
    return replace(
        found, effort=effort, error_estimate=max(found.error_estimate, effort.last_change),
        state_errors=None if errors is None else np.maximum(errors, effort.last_change),
        bounded=found.bounded and bounded,
    )


def _simulate_linear(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings,
    structure: Structure | None = None,
) -> Simulation:
    """:func:`simulate` for a plant whose matrices depend on time and inputs only."""
    structure = structure or dense_structure(system, time, solver)
    mesh, cuts, bounded = first_mesh(system, time, solver)
    mesh, c, terms = _known_resolved(system, structure, mesh, cuts, solver, bounded=bounded)
    # Of many elements some are looked at, and the equations are made where they are solved.
    few = mesh.size <= _AT_ONCE or structure.time_invariant
    points, some = len(mesh.rule.points), slice(None, None, 1 if few else mesh.size // _LOOKED_AT)
    first = strangeness_free_form(
        system, structure, mesh.points[some].ravel(), mesh.inside[some].ravel(), c if few else None,
        points,
    )
    del c  # as much as all that is made of it
    independent = solver.name == "ivp"  # the underlying ODE of the derivative array, by scipy
    x0 = _start(system, structure, mesh, None if independent else first)
    happened: dict[float, tuple[Array, Jump]] = {}
    restarts = _restarts(system, structure, cuts, mesh.edges, happened)

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        return _equations(strangeness_free_form(system, structure, t, inside, points=points))

    def explicit(t: Array, inside: Array) -> LinearEquation:
        A, f = ivp.underlying_ode(system, structure, t, inside)
        c = system.coefficients.taylor(t, 0, inside)
        seen = c.u[0], c.C[0], direct_part(c, system.coefficients.zero)
        return LinearEquation(None, A, f[:, :, None], seen)

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[Kind]:
        u, C, direct = extras
        # An output may cancel identically (x1 − x2 of two equal states): it is resolved relative
        # to the states.
        x = values[..., 0]
        y, size = np.einsum("...ij,...j->...i", C, x) + direct, largest_over_time(x, 2)
        least = least_sizes(problem, size[:, None], solver.tol)[:, 0]
        least = largest_over_time(C, 2) @ least
        return [(u, SHARE * terms(size)), (y, least)]

    # Where the constraints leave nothing of the state asked for, its rounding is no signal.
    floor = SHARE * np.abs(system.initial_state)
    if structure.a:
        floor = np.maximum(floor, np.abs(first.basis[0]) @ (np.abs(first.E1[0]) @ floor))
    units = structure.scaling.columns[:, None]
    within = _within(first, float(mesh.steps.max()))
    problem = LinearProblem(
        coefficients, x0[:, None], monitor, f"plant {system.name}", floor[:, None],
        _amplification(first, structure.scaling.columns, within),
        units=units, missed=partial(_missed, system, structure, within) if structure.a else None,
        rate=structure.rate, blur=partial(blur_of, system.coefficients),
    )
    if independent:
        problem = replace(problem, coefficients=explicit)
    known = _equations(first) if few else None
    own = partial(
        ivp.solve if independent else partial(solve, known=known), mesh=mesh,
        tol=solver.tol, max_elements=solver.max_elements, restarts=restarts,
    )
    del first, known
    try:
        solution = own(problem)
    except RoundingError as error:  # perhaps of states that are zero: others are what counts then
        most = (largest_over_time(error.found[1], 2) / units).max(initial=0.0)
        floor = np.maximum(floor[:, None], SHARE * most * units)
        problem = replace(problem, floor=floor)
        solution = own(problem)
    mesh = solution.trajectory.mesh
    x = solution.trajectory.values[..., 0]
    u, C, direct = solution.extras
    y = np.einsum("...ij,...j->...i", C, x) + direct
    return Simulation(
        signals=Signals(Trajectory(mesh, u), Trajectory(mesh, y), Trajectory(mesh, x)),
        structure=structure, initial_state=x0,
        jumps=tuple((t, *happened[t]) for t in sorted(happened)),
        error_estimate=solution.error_estimate, bounded=bounded,
        state_errors=solution.errors[:, 0], lost=solution.lost,
        vague=None if solution.vague is None else solution.vague[:, 0],
    )


def _start(
    system: DescriptorSystem, structure: Structure, mesh: Mesh, form: StrangenessFree | None
) -> Array:
    """The consistent state (n,) at the start, with the equations there or by the other path."""
    t, inside = mesh.points[0, :1], mesh.inside[0, :1]
    if form is None:
        x0 = ivp.consistent_start(system, structure, t, inside)
    else:
        def step(before: Array) -> Array:
            return jumps(system, structure, t, inside, inside, form)(0, before).after

        x0 = consistent_state(form, system.initial_state, step)
    if not np.isfinite(x0).all():
        raise ModelError(
            f"plant {system.name}: no finite consistent state at the start; look for entries that "
            "are huge or infinite there"
        )
    return x0


def _known_resolved(
    system: DescriptorSystem, structure: Structure, mesh: Mesh, cuts: Array,
    solver: SolverSettings, *, bounded: bool,
) -> tuple[Mesh, Coefficients, Callable[[Array], Array]]:
    """The mesh that the known functions ask for, all of them there, and :func:`_beside_inputs`.

    Elements are cut until the inputs are resolved, as far as cutting helps: evaluating an input
    costs next to nothing beside solving for the state on elements that are too long. Few of them
    are the first, but not where the state may grow or decay much within one: an element that does
    not resolve growth may hide it.
    """
    def evaluated(mesh: Mesh) -> Coefficients:
        return system.coefficients.taylor(mesh.points.ravel(), structure.mu, mesh.inside.ravel())

    if solver.name == "ivp":
        c = evaluated(mesh)
        return mesh, c, _beside_inputs(c)
    longest, first = SHORT / max(structure.rate, TINY), float(mesh.steps.max())
    if first > longest:
        mesh = _growth_resolved(system, structure, mesh, solver)
    elif structure.steady and bounded and 2.0 * first <= longest:
        mesh = few_elements(system, mesh, cuts, longest)
    c = evaluated(mesh)
    terms = _beside_inputs(c)
    beside = terms(np.abs(system.initial_state))
    mesh, c = known_resolved(
        system, evaluated, lambda t: system.coefficients.taylor(t, 0), mesh, c, beside, solver,
        bounded=bounded,
    )
    return mesh, c, terms


def _growth_resolved(
    system: DescriptorSystem, structure: Structure, mesh: Mesh, solver: SolverSettings
) -> Mesh:
    """The mesh with elements short enough for the state not to grow much within one.

    An element that is too long damps what it does not resolve. A state that has become small would
    never be seen to grow again: its error is invisible beside the size it once had (SolverError:
    that takes more elements than there may be).
    """
    n, A = structure.d + structure.a, structure.dynamics
    if A is not None:  # Gershgorin's discs say without eigenvalues whether there is little
        own = np.diagonal(A, axis1=1, axis2=2)
        bounds = [(own - np.abs(own) + np.abs(A).sum(axis=k)).max(initial=0.0) for k in (1, 2)]
        if min(bounds) * float(mesh.steps.max()) <= SHORT:
            return mesh
    most = min(_MOST_FOR_GROWTH / (mesh.rule.stages * n**2), solver.max_elements)
    parts = np.maximum(1.0, np.ceil(mesh.steps * (structure.growth / SHORT)))
    if parts.sum() > min(most, _MOST_ALIKE):
        # Only where it grows.
        length = (mesh.edges[-1] - mesh.edges[0]) / _LOOKED_AT_FOR_GROWTH
        mesh, _ = mesh.split(np.ceil(mesh.steps / length).astype(np.intp))
        form = strangeness_free_form(system, structure, mesh.points.ravel(), mesh.inside.ravel())
        rates = np.broadcast_to(growth_rates(form.A1 @ form.basis), mesh.points.size)
        rates = rates.reshape(mesh.points.shape).max(axis=1)
        parts = np.maximum(1.0, np.ceil(mesh.steps * (rates / SHORT)))
        if parts.sum() > most:
            worst = int(np.argmax(rates))
            by = "solver.max_elements" if most == solver.max_elements else f"the size {n} of A"
            raise SolverError(
                f"the plant {system.name} may grow by a factor of e^{mesh.steps @ rates:.3g}, at "
                f"{rates[worst]:.3g} 1/s near t = {mesh.edges[worst]:.6g}, which takes more than "
                f"the {most:.0f} elements that {by} allows; shorten time.horizon"
            )
    return mesh.split(parts.astype(np.intp))[0]


def _missed(
    system: DescriptorSystem, structure: Structure, within: Array, mesh: Mesh, values: Array,
    bound: Array,
) -> Array | None:
    """:func:`shown_rounding` along values on a mesh, and what :func:`_within` a step brings of it.

    None: its ``bound`` (n, 1) is little already where derivative arrays do, or nothing is seen.
    """
    if not structure.stages and (bound <= _LITTLE * largest_over_time(values, 2)).all():
        return None
    some = slice(None, None, -(-mesh.size // _LOOKED_AT))
    at = mesh.points[some, -1], mesh.inside[some, -1]
    try:
        squares = shown_rounding(system, structure, *at, values[some, -1]) ** 2
    except ModelError:
        return None  # no rank is clear beside so much rounding
    return np.asarray(np.sqrt(squares + within**2 @ squares))


def _within(form: StrangenessFree, step: float) -> Array:
    """Which share of an error of each state the equations bring to each state within a ``step``."""
    some = slice(None, None, max(1, len(form.E1) // _LOOKED_AT))
    T, A1 = form.basis[some], form.A1[some if len(form.A1) > 1 else slice(None)]
    return np.asarray(np.minimum(step * (np.abs(T) @ np.abs(A1)).max(axis=0), 1.0))


def _amplification(form: StrangenessFree, units: Array, within: Array) -> Array:
    """By how much relative rounding of each state, and of 1, reaches each state, (n, n + 1).

    Through the constraints; through x = T z of z = E1 x, where a state that is the small difference
    of large components of z is rounding of those, and an entry of T that is nothing beside the
    others (in ``units`` of the states (n,)) is rounding as a whole; and through the equations
    :func:`_within` a step, because what integrates rounding is no signal either.
    """
    some = slice(None, None, max(1, len(form.E1) // _LOOKED_AT))
    found, T, E1 = form.amplification.copy(), np.abs(form.basis[some]), np.abs(form.E1[some])
    sizes = T / units[:, None] * (E1 @ units)[:, None]
    rounding = np.where(sizes > NOTHING * sizes.max(initial=0.0), T, T / EPS)
    found[:, :-1] += (rounding @ E1).max(axis=0)
    once = within @ found
    return np.asarray(found + once + within @ once)


def _equations(reduced: StrangenessFree) -> LinearEquation:
    """The strangeness-free equations in the form that the collocation takes."""
    f1, extras = reduced.f1[:, :, None], (reduced.u, reduced.C, reduced.direct)
    own = Constraints(reduced.basis, reduced.offset[:, :, None]) if reduced.A2.shape[1] else None
    return LinearEquation(reduced.E1, reduced.A1, f1, extras, own, reduced.terms)


def _restarts(
    system: DescriptorSystem, structure: Structure, cuts: Array, edges: Array,
    happened: dict[float, tuple[Array, Jump]],
) -> dict[float, Callable[[Array], Array]]:
    """What is done to the states (n, 1) at each of the cuts; the jumps are kept in ``happened``."""
    if not len(cuts):
        return {}
    k, steps = np.searchsorted(edges, cuts), np.diff(edges)
    beside = 1e-3 * np.minimum(steps[k], steps[k - 1])
    at = jumps(system, structure, cuts, cuts - beside, cuts + beside)

    def restart(k: int, t: float, before: Array) -> Array:
        what = at(k, before[:, 0])
        happened[t] = (before[:, 0].copy(), what)
        return what.after[:, None]

    return {t: partial(restart, k, t) for k, t in enumerate(cuts.tolist())}


def _beside_inputs(c: Coefficients) -> Callable[[Array], Array]:
    """From the sizes of the states (n,) to :func:`least_beside` the inputs (m,)."""
    A, B = (largest_over_time(distinct(matrix)[0]) for matrix in (c.A, c.B))
    i, j = B.nonzero()
    return lambda size: least_beside(A @ size, B[i, j], i, j, B.shape[1])
