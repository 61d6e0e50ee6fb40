"""Simulate a descriptor system of any index: signals as piecewise polynomials on one mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from math import isfinite

import numpy as np

from gpebo_cli.errors import ModelError, SolverError
from gpebo_cli.model.descriptor import (
    MATRIX_NAMES,
    Array,
    BoolArray,
    Coefficients,
    DescriptorSystem,
    IntArray,
    distinct,
)
from gpebo_cli.numerics.collocation import LinearSolution, solve
from gpebo_cli.numerics.errors import least_sizes
from gpebo_cli.numerics.linalg import inverse_or_none
from gpebo_cli.numerics.mesh import (
    FIRST_ELEMENTS,
    SHARE,
    Kind,
    Mesh,
    Trajectory,
    initial_mesh,
    unresolved,
)
from gpebo_cli.numerics.problem import Constraints, LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import RadauRule, radau_rule
from gpebo_cli.numerics.refinement import wanted_parts
from gpebo_cli.reduction.consistency import Jump, consistent_state, jump
from gpebo_cli.reduction.strangeness_free import (
    StrangenessFree,
    direct_part,
    strangeness_free_form,
)
from gpebo_cli.reduction.structure import Structure, analyse, growth_rates
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation import ivp
from gpebo_cli.simulation.linearised import Linearised
from gpebo_cli.simulation.newton import Effort, follow

_LOOKED_AT = 32  # times at which the mixing of states is looked at
_MARGIN = 1e-3  # of the tolerance, to which known functions are resolved when joined: what is made
# of them takes more degrees
_SHORT = 4.0  # rate times length of joined elements; exp(t) is resolved to 1e-9 there
_MOST_FOR_GROWTH = 1 << 26  # numbers; beyond them elements are cut only where that is seen to help
_LOOKS = 40  # times within each first element at which known functions are looked at once more
_MOST_LOOKS = 1 << 16
_SURPRISE = 100.0  # times what the nodes let expect: then something stands between them
_LOOK_ROUNDS = 8
_TINY = float(np.finfo(float).tiny)
_NEAR_ZERO = 1e-2  # reciprocals of what comes nearer to zero, relatively, resolve nothing


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
    error_estimate: float  # relative to each signal's own size, the largest
    bounded: bool  # known functions are bounded between the nodes: nothing narrow was missed
    effort: Effort | None = None  # of Newton's method, where the plant is not linear
    state_errors: Array | None = None  # (n,) of each state relative to its own largest value
    lost: float | None = None  # from when on rounding errors exceed a state


def simulate(system: DescriptorSystem, time: TimeSettings, solver: SolverSettings) -> Simulation:
    """Solve E x' = A x + B u + F θ + φ from a consistent state near ``system.initial_state``.

    Raises:
        ModelError: not uniquely solvable, index too high, or a rank changes within the horizon.
        SolverError: the tolerance cannot be reached, or the solution ends within the horizon.
        ConfigError: an entry without a finite value.
    """
    if not system.depends_on_outputs:
        simulation = _simulate_linear(system, time, solver)
        if simulation.lost is not None:
            raise SolverError(
                f"the plant {system.name} grows so that rounding errors are larger than a state "
                f"from t = {simulation.lost:.6g} on, and no digit of it is known; shorten "
                "time.horizon"
            )
        return simulation
    last: list[Simulation] = []

    def solve_linear(
        linear: DescriptorSystem, window: TimeSettings, settings: SolverSettings
    ) -> tuple[Trajectory, float]:
        last[:] = [_simulate_linear(linear, window, settings)]
        return last[0].signals.states, last[0].structure.growth

    effort = follow(system, time, replace(solver, name="collocation"), solve_linear)
    found = last[0]
    if solver.name == "ivp":
        # Along a guess that is wrong by δ, the independent path is wrong by δ² only.
        linear = replace(system, coefficients=Linearised(system, found.signals.states))
        found = _simulate_linear(linear, time, solver)
    return replace(
        found, effort=effort, error_estimate=max(found.error_estimate, effort.last_change)
    )


def _simulate_linear(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> Simulation:
    """:func:`simulate` for a plant whose matrices depend on time and inputs only."""
    start, stop = time.start, time.start + time.horizon
    structure = analyse(
        system, start, stop, max_mu=solver.max_strangeness_index, rank_tol=solver.rank_tol
    )
    cuts = system.coefficients.breakpoints(start, stop)
    mesh = initial_mesh(start, stop, cuts, FIRST_ELEMENTS, radau_rule(solver.stages))
    edges = system.coefficients.resolved(mesh.edges)
    if edges is not None:
        mesh = Mesh(edges, mesh.rule)
    mesh, c, terms = _known_resolved(
        system, structure, mesh, cuts, solver, bounded=edges is not None
    )
    first = strangeness_free_form(system, structure, mesh.points.ravel(), mesh.inside.ravel(), c)
    if solver.name == "ivp":
        inside = float(mesh.inside[0, 0])
        x0 = ivp.consistent_start(system, structure, start, inside)
    else:
        x0 = consistent_state(first, system.initial_state, structure.scaling.weights)
    _check_start(system, x0)

    happened: dict[float, tuple[Array, Jump]] = {}
    restarts: dict[float, Callable[[Array], Array]] = {}
    for cut in map(float, cuts):
        restarts[cut] = _restart(system, structure, cut, _width(mesh.edges, cut), happened)

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        return _equations(strangeness_free_form(system, structure, t, inside))

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[Kind]:
        u, C, *direct = extras
        # An output may cancel identically (x1 − x2 of two equal states): it is resolved relative
        # to the states.
        y = _outputs(C, values[..., 0], *direct)
        size = np.abs(values[..., 0]).max(axis=(0, 1))
        least = np.abs(C).max(axis=(0, 1)) @ least_sizes(problem, size[:, None], solver.tol)[:, 0]
        return [(u, SHARE * terms(size)), (y, least)]

    # Where the constraints leave nothing of the state asked for, its rounding is no signal.
    floor = SHARE * np.abs(system.initial_state)
    if first.basis is not None:
        floor = np.maximum(floor, np.abs(first.basis[0]) @ (np.abs(first.E1[0]) @ floor))
    problem = LinearProblem(
        coefficients, x0[:, None], monitor, f"plant {system.name}", floor[:, None],
        _amplification(first, float(mesh.steps.max())), apart=True,
    )
    if solver.name == "ivp":
        solution = _integrate(system, structure, problem, mesh, solver, restarts)
    else:
        solution = solve(
            problem, mesh, tol=solver.tol, max_elements=solver.max_elements, restarts=restarts,
            known=_equations(first),
        )
    mesh = solution.trajectory.mesh
    x = solution.trajectory.values[..., 0]
    u, C, *direct = solution.extras
    y = _outputs(C, x, *direct)
    return Simulation(
        signals=Signals(Trajectory(mesh, u), Trajectory(mesh, y), Trajectory(mesh, x)),
        structure=structure,
        initial_state=x0,
        jumps=tuple((t, *happened[t]) for t in sorted(happened)),
        error_estimate=solution.error_estimate,
        bounded=edges is not None,
        state_errors=solution.errors[:, 0],
        lost=solution.lost,
    )


def _known_resolved(
    system: DescriptorSystem, structure: Structure, mesh: Mesh, cuts: Array,
    solver: SolverSettings, *, bounded: bool,
) -> tuple[Mesh, Coefficients, Callable[[Array], Array]]:
    """The mesh that the known functions ask for, all of them there, and :func:`_beside_inputs`.

    Where bounds do not already say that nothing narrow hides between the nodes, it is looked for.
    Elements are cut until the inputs are resolved, as far as cutting helps: the solution's mesh
    has to resolve them in any case, and evaluating an input costs next to nothing beside solving
    for the state on elements that are too long. Where nothing needs the elements that short, they
    are joined again: what is narrow has been looked for on the short ones. But not where the state
    may grow or decay much within one of them: an element that does not resolve growth may hide it.
    """
    def evaluated(mesh: Mesh) -> Coefficients:
        return system.coefficients.taylor(mesh.points.ravel(), structure.mu, mesh.inside.ravel())

    longest = _SHORT / max(structure.rate, _TINY)
    if solver.name != "ivp" and mesh.steps.max() > longest:
        mesh = _growth_resolved(system, structure, mesh, solver)
    c = evaluated(mesh)
    terms = _beside_inputs(c)
    if solver.name == "ivp":
        return mesh, c, terms
    given = mesh
    for _ in range(0 if bounded else _LOOK_ROUNDS):
        overlooked = _overlooked(system, c, mesh, solver.tol)
        if not overlooked.any():
            break
        mesh, _ = mesh.split(np.where(overlooked, 8, 1).astype(np.intp))
        c = evaluated(mesh)
    before: Array | float = np.inf
    beside = terms(np.abs(system.initial_state))
    while system.m and "u" not in system.coefficients.constant:
        u = c.u[0].reshape(*mesh.points.shape, -1)
        tail = unresolved(u, mesh.rule, SHARE * beside)
        if tail.max() <= solver.tol:
            break
        poor = (tail > solver.tol) & ((tail < 0.25 * before) | (tail > 1e-6))
        parts = wanted_parts(tail, poor, solver.tol, mesh.rule.stages)
        too_short = mesh.steps[poor] < 1e-6 * (mesh.edges[-1] - mesh.edges[0]) / mesh.size
        if not poor.any() or too_short.any() or parts.sum() > solver.max_elements:
            break
        before = np.repeat(tail, parts)
        mesh, _ = mesh.split(parts)
        c = evaluated(mesh)
    if mesh is not given or not structure.steady or 2.0 * float(mesh.steps.min()) > longest:
        return mesh, c, terms
    values, counts = _known_kinds(system, c, mesh)
    joined = mesh.joined(values, counts, _MARGIN * solver.tol, cuts, longest)
    return joined, c if joined is mesh else evaluated(joined), terms


def _overlooked(
    system: DescriptorSystem, c: Coefficients, mesh: Mesh, tol: float
) -> BoolArray:
    """Elements (K,) with something narrow between their nodes, a pulse of an input for instance.

    What the nodes do not see leaves no trace in Legendre coefficients. So every known function is
    looked at in between, and an element is suspected where it is far from what the coefficients
    make one expect.
    """
    looks = min(_LOOKS, _MOST_LOOKS // mesh.size)
    names = [name for name in MATRIX_NAMES if name not in system.coefficients.constant]
    found = np.zeros(mesh.size, dtype=bool)
    if looks == 0 or not names:
        return found
    places, between = _looks(mesh.rule, looks)
    t = mesh.edges[:-1, None] + mesh.steps[:, None] * places
    seen = system.coefficients.taylor(t.ravel(), 0)
    least = max(tol, 1e-12)
    pairs = [array for name in names for array in (getattr(c, name), getattr(seen, name))]
    missed = _missed_between(between, *pairs)
    for name, far in zip(names, missed, strict=True):
        if far.max(initial=0.0) <= _SURPRISE * least:
            continue
        nodal = getattr(c, name)[0].reshape(*mesh.points.shape, -1)
        nodal = nodal[..., np.ptp(nodal, axis=(0, 1)) > 0.0]
        found |= far > _SURPRISE * np.maximum(unresolved(nodal, mesh.rule), least)
    return found


def _missed_between(between: Array, *pairs: Array) -> Array:
    """How far functions are from the polynomials through their nodes, (pairs, K), relative.

    Args:
        between: the polynomial at the places between, from its points (s + 1, looks).
        pairs: values (orders, K (s + 1), ...) at the points and (orders, K looks, ...) between, of
            one function after the other; the first order counts, of entries that move the worst.
    """
    points, looks = between.shape
    found = []
    for nodal, seen in zip(pairs[::2], pairs[1::2], strict=True):
        nodes = nodal[0].reshape(nodal.shape[1] // points, points, -1)
        actual = seen[0].reshape(len(nodes), looks, -1)
        first = nodes[:1, :1]
        moves = (nodes != first).any(axis=(0, 1)) | (actual != first).any(axis=(0, 1))
        nodes, actual = nodes[..., moves], actual[..., moves]
        size = np.maximum(np.abs(actual).max(axis=(0, 1)), np.abs(nodes).max(axis=(0, 1)))
        far = np.abs(between.T @ nodes - actual).max(axis=1) / size
        found.append(far.max(axis=1, initial=0.0))
    return np.array(found)


@lru_cache(maxsize=16)
def _looks(rule: RadauRule, looks: int) -> tuple[Array, Array]:
    """Places (looks,) in an element, and the polynomial there from its points (s + 1, looks)."""
    places = (np.arange(looks) + 0.5) / looks
    return places, np.ascontiguousarray(rule.interpolation(places).T)


def _growth_resolved(
    system: DescriptorSystem, structure: Structure, mesh: Mesh, solver: SolverSettings
) -> Mesh:
    """The mesh with elements short enough for the state not to grow much within one.

    An element that is too long damps what it does not resolve. A state that has become small would
    never be seen to grow again: its error is invisible beside the size it once had.

    Raises:
        SolverError: that takes more elements than there may be.
    """
    n = structure.d + structure.a
    most = min(_MOST_FOR_GROWTH / (mesh.rule.stages * n**2), solver.max_elements)
    parts = np.maximum(1.0, np.ceil(mesh.steps * (structure.growth / _SHORT)))
    if parts.sum() > most:
        # Only where it grows.
        form = strangeness_free_form(system, structure, mesh.points.ravel(), mesh.inside.ravel())
        rates = np.broadcast_to(growth_rates(form.E1, form.A1, form.basis), mesh.points.size)
        rates = rates.reshape(mesh.points.shape).max(axis=1)
        parts = np.maximum(1.0, np.ceil(mesh.steps * (rates / _SHORT)))
        if parts.sum() > most:
            worst = int(np.argmax(rates))
            raise SolverError(
                f"the plant {system.name} may grow by a factor of e^{_SHORT * parts.sum():.3g}, at "
                f"{rates[worst]:.3g} 1/s near t = {mesh.edges[worst]:.6g}, which takes more than "
                f"solver.max_elements = {most:.0f} elements; shorten time.horizon"
            )
    return mesh.split(parts.astype(np.intp))[0] if parts.max() > 1.0 else mesh


def _known_kinds(
    system: DescriptorSystem, c: Coefficients, mesh: Mesh
) -> tuple[Array, IntArray]:
    """Every function of the model with its derivatives, (K, s + 1, c), and how many of each kind.

    Reciprocals of what E holds are among them: the state sees those, and they may be harder to
    resolve by far.
    """
    parts = [
        getattr(c, name).reshape(len(c.E), c.E.shape[1], -1)
        for name in MATRIX_NAMES if name not in system.coefficients.constant
    ]
    parts = [part for part in parts if part.shape[2]]
    if not parts:
        return np.zeros((*mesh.points.shape, 0)), np.zeros(0, dtype=np.intp)
    whole = np.concatenate(parts, axis=2)
    high, low = whole[0].max(axis=0), whole[0].min(axis=0)
    moving = high > low
    kinds = list(whole[:, :, moving])
    counts = np.add.reduceat(moving, np.cumsum([0, *(part.shape[2] for part in parts[:-1])]))
    counts = np.tile(counts[counts > 0], len(kinds))
    if "E" not in system.coefficients.constant:
        first = slice(parts[0].shape[2])
        size = np.abs([high[first], low[first]])
        away = (size.min(axis=0) > _NEAR_ZERO * size.max(axis=0)) & (high[first] * low[first] > 0.0)
        kinds.append(1.0 / parts[0][0][:, moving[first] & away])
        counts = np.append(counts, kinds[-1].shape[1])
    values = np.concatenate(kinds, axis=1).reshape(*mesh.points.shape, -1)
    return values, counts[counts > 0]


def _amplification(form: StrangenessFree, step: float) -> Array:
    """By how much relative rounding of each state, and of 1, reaches each state, (n, n + 1).

    Through the constraints; through x = T z of z = E1 x, where a state that is the small difference
    of large components of z is rounding of those; and through the equations within a ``step``
    (seconds), because what integrates rounding is no signal either.
    """
    some = slice(None, None, max(1, len(form.E1) // _LOOKED_AT))
    E1, A1 = form.E1[some], form.A1[some if len(form.A1) > 1 else slice(None)]
    if form.basis is None:
        T, singular = inverse_or_none(E1)
        T[singular] = 0.0
    else:
        T = form.basis[some]
    found = form.amplification.copy()
    found[:, :-1] += (np.abs(T) @ np.abs(E1)).max(axis=0)
    within = np.minimum(step * (np.abs(T) @ np.abs(A1)).max(axis=0), 1.0)
    once = within @ found
    return np.asarray(found + once + within @ once)


def _equations(reduced: StrangenessFree) -> LinearEquation:
    """The strangeness-free equations in the form that the collocation takes."""
    extras = tuple(e for e in (reduced.u, reduced.C, reduced.direct) if e is not None)
    f1 = reduced.f1[:, :, None]
    if reduced.basis is None or reduced.offset is None:
        return LinearEquation(reduced.E1, reduced.A1, f1, extras)
    constraints = Constraints(reduced.basis, reduced.offset[:, :, None])
    return LinearEquation(reduced.E1, reduced.A1, f1, extras, constraints)


def _check_start(system: DescriptorSystem, x0: Array) -> None:
    if not all(map(isfinite, x0.tolist())):
        raise ModelError(
            f"plant {system.name}: no finite consistent state at the start; look for entries that "
            "are huge or infinite there"
        )


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


def _beside_inputs(c: Coefficients) -> Callable[[Array], Array]:
    """From the sizes of the states (n,) to those that the inputs (m,) have to compare with.

    An input whose share of every equation is rounding of the others' is rounding itself.
    """
    A, B = (np.abs(distinct(matrix)[0]).max(axis=0) for matrix in (c.A, c.B))

    def terms(size: Array) -> Array:
        none = np.full_like(B, np.inf)
        least = np.divide((A @ size)[:, None], B, out=none, where=B > 0.0)
        least = least.min(axis=0, initial=np.inf)
        return np.where(np.isfinite(least), least, 0.0)

    return terms


def _outputs(C: Array, x: Array, direct: Array | float = 0.0) -> Array:
    """y = C x + direct at points (K, s + 1)."""
    if C.shape[:2] == (1, 1):
        return np.asarray(x @ C[0, 0].T + direct)
    return np.asarray(np.matmul(C, x[..., None])[..., 0] + direct)


def _integrate(
    system: DescriptorSystem, structure: Structure, problem: LinearProblem, mesh: Mesh,
    solver: SolverSettings, restarts: dict[float, Callable[[Array], Array]],
) -> LinearSolution:
    """The independent path: the underlying ODE of the derivative array, by scipy."""

    def explicit(t: Array, inside: Array) -> LinearEquation:
        A, f = ivp.underlying_ode(system, structure, t, inside)
        c = system.coefficients.taylor(t, 0, inside)
        seen = c.u[0], c.C[0], direct_part(c, system.coefficients.zero)
        return LinearEquation(None, A, f[:, :, None], tuple(e for e in seen if e is not None))

    ode = replace(problem, coefficients=explicit)
    return ivp.solve(
        ode, mesh, tol=solver.tol, max_elements=solver.max_elements, restarts=restarts
    )
