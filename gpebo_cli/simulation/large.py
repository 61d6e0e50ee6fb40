"""Simulate a large plant: elimination, then series in time, or solves where it is stiff.

A sparse plant is eliminated entry by entry at all times. A constant one that is full, or of which
pivots do not tell the structure, is reduced once, by singular values.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from gpebo_cli.model.descriptor import Array, BoolArray, Coefficients, DescriptorSystem
from gpebo_cli.model.entries import Entries, entries
from gpebo_cli.numerics import series
from gpebo_cli.numerics.collocation import LinearSolution
from gpebo_cli.numerics.errors import EPS, NOTHING, TINY, VALUE
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import SHARE, Kind, Mesh, Trajectory, legendre_tail, unresolved
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.refinement import RoundingError
from gpebo_cli.reduction.consistency import Jump
from gpebo_cli.reduction.constant import ConstantForm, constant_form
from gpebo_cli.reduction.explicit import (
    Explicit,
    MoreOrdersError,
    Row,
    UndecidedError,
    explicit_form,
    product,
    scaling_of,
    sizes_of,
)
from gpebo_cli.reduction.scaling import Scaling
from gpebo_cli.reduction.structure import Structure, analyse, index_above
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.known import (
    SHORT,
    cut_where,
    few_elements,
    first_mesh,
    known_resolved,
    least_beside,
)
from gpebo_cli.simulation.signals import Signals, Simulation

SMALL = 8  # states, up to which dense matrices are faster in any case
_FULL = 50  # states, beyond which full constant plants are simulated here, too
_ENTRIES = 4  # per row of E; with more of them E counts as full
_LENGTH = 2.6  # h‖A‖ of an element: products of two solutions, too, are resolved to 1e-9 there
_SOME = 5  # at every so many points it is seen how fast states move
_BESIDE = 1e-3  # of the shortest element: on which side of a cut a point is
_SAME = 1e-9  # of a value: what it jumps by less is rounding
_ROUNDING = 32.0  # units in the last place by which a consistent state may miss one asked for


def forcing(found: Entries) -> Row:
    """Taylor coefficients (orders, N or 1) of f = B u + F θ + φ in rows that have such terms."""
    f = {i: value for (i,), value in found.of("phi").items()}
    for matrix, vector in (("B", "u"), ("F", "theta")):
        known = found.of(vector)
        for (i, j), value in found.of(matrix).items():
            signal = known.get((j,))
            if signal is not None:
                term = product(value, signal)
                f[i] = f[i] + term if i in f else term
    return f


class _Plant:
    """The plant on one mesh after the other: its entries, and what elimination makes of them."""

    def __init__(self, system: DescriptorSystem, most: int) -> None:
        self.system, self.most, self.order = system, most, 0
        self.found: Entries
        self.form: Explicit | ConstantForm
        self.constant: ConstantForm | None = None  # what is the same at all times, and
        self.scaling: Scaling | None = None  # what nearly is
        self.at: Mesh | None = None  # of both, and
        self.eliminated = False  # whether ``form`` is of ``found``
        self.moved: Mapping[str, BoolArray] = {}  # what derivatives were needed of, if it is known

    def entries(self, mesh: Mesh, every: int = 1) -> Coefficients:
        """Every entry at every so many points of each element."""
        for old in ("form", "found"):
            vars(self).pop(old, None)  # two of them would be as much again
        self.at, self.eliminated = mesh if every == 1 else None, False
        t, inside = (places[:, ::every].ravel() for places in (mesh.points, mesh.inside))
        self.found = entries(self.system.coefficients, t, self.order, inside, self.moved)
        return self.found.values

    def eliminate(self, mesh: Mesh, every: int = 1) -> Explicit | ConstantForm:
        """The explicit form from :meth:`entries` at every so many points (UndecidedError)."""
        if self.at is not mesh:
            self.entries(mesh, every)
        while not self.eliminated:
            try:
                self.form = self.form_of(self.found, forcing(self.found))
            except MoreOrdersError:
                if self.moved:
                    self.moved = {}
                elif self.order == self.most:
                    raise
                else:
                    self.order += 1
                self.entries(mesh, every)
            else:
                self.eliminated, values = True, self.found.values
                if isinstance(self.form, Explicit) and values.A.shape[2] > self.system.n:
                    self.moved = self.form.moved  # of many values it pays to know that
                # Nothing else of E and A is needed now, nor of what others are parts of.
                A = largest_over_time(values.A[0])[None, None]
                values = values._replace(E=values.E[:, :1], A=A)
                kept = Coefficients(*(np.array(value[:1]) for value in values))
                self.found = self.found._replace(values=kept, moved={})
        return self.form

    def form_of(self, found: Entries, f: Row) -> Explicit | ConstantForm:
        """The explicit form of these entries, with what is known in the equations."""
        n, (E, A) = self.system.n, (getattr(found.values, name) for name in "EA")
        may_be_full = n > _FULL and E.shape[1] == A.shape[1] == 1
        if self.constant is None and not (may_be_full and len(found.which("E")) > _ENTRIES * n):
            try:
                self.scaling = self.scaling or scaling_of(found, n)
                form = explicit_form(found, self.scaling, f)
            except UndecidedError as error:
                if isinstance(error, MoreOrdersError) or not may_be_full:
                    raise
            else:
                if form.mu >= self.most:
                    raise index_above(self.system, self.most - 1, form.mu + 1)
                return form
        if self.constant is None:
            full = np.zeros((2, n, n))
            for matrix, name, values in zip(full, "EA", (E, A), strict=True):
                matrix[found.places[name]] = values[0, 0, found.which(name)]
            self.constant = constant_form(full[0], full[1], self.most - 1)
        times = max((value.shape[1] for value in f.values()), default=1)
        known = np.zeros((self.order + 1, times, n))
        for i, value in f.items():
            known[:, :, i] = value
        return self.constant.along(known)

    def structure(self) -> Structure:
        """As elimination found it."""
        form = self.form
        return Structure(
            mu=form.mu, a=self.system.n - form.d, d=form.d, smallest_singular_value=form.pivot,
            time_invariant=len(form.matrix.entries) == 1,
        )

    def matrix_tail(self, mesh: Mesh, form: Explicit | ConstantForm) -> Array:
        """How far each element is from resolving M times its length, where that is below 1 (K,)."""
        M, units = form.matrix, form.units
        if len(M.entries) == 1:
            return np.zeros(mesh.size)
        of_row = np.repeat(np.arange(form.d), np.diff(M.rows))
        scales = mesh.steps[:, None, None] * (units[M.columns] / units[of_row])
        tail = unresolved(M.entries.reshape(*mesh.points.shape, -1) * scales, mesh.rule, 1.0)
        tail[0] *= 2.0**mesh.rule.stages  # what begins at zero is small in the first element
        return tail


def large_simulation(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> Simulation | None:
    """:func:`gpebo_cli.simulation.simulate.simulate`, or None where elimination or series fail."""
    mesh, cuts, bounded = first_mesh(system, time, solver)
    plant = _Plant(system, solver.max_strangeness_index + 1)
    with np.errstate(all="ignore"), suppress(UndecidedError, RoundingError):
        return _simulated(plant, mesh, cuts, solver, bounded=bounded)
    return None


def structure_of(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> Structure:
    """The structure of a plant over a horizon, by elimination where that decides it."""
    if system.n > SMALL:
        plant = _Plant(system, solver.max_strangeness_index + 1)
        edges = np.array([time.start, time.start + time.horizon])
        with np.errstate(all="ignore"), suppress(UndecidedError):
            plant.eliminate(Mesh(edges, radau_rule(solver.stages)))
            return plant.structure()
    return dense_structure(system, time, solver)


def dense_structure(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> Structure:
    """The structure of a plant over a horizon, by ranks of its derivative array."""
    return analyse(
        system, time.start, time.start + time.horizon, max_mu=solver.max_strangeness_index,
        rank_tol=solver.rank_tol,
    )


def _simulated(
    plant: _Plant, mesh: Mesh, cuts: Array, solver: SolverSettings, *, bounded: bool
) -> Simulation | None:
    system, tol = plant.system, solver.tol
    form = plant.eliminate(mesh, _SOME)
    if not form.d:
        return None  # there is nothing to integrate, and the derivative array has all states
    if len(cuts) and (
        isinstance(form, ConstantForm) or form.shifts or not _smooth(plant, mesh, cuts)
    ):
        return None  # what jumps then is for the derivative array to say
    M, units = form.matrix, form.units
    shortest = longest = _LENGTH / max(M.norms(M.sizes(mesh.size), units).max(), TINY)
    stiff = bool(np.ceil(mesh.steps / longest).sum() > series.MOST_ELEMENTS)
    if stiff:
        longest = SHORT / max(M.growth(units, SHORT / float(mesh.steps.max())), TINY)

    used = plant.found.places["u"][0]
    beside = _beside_inputs(plant.found, np.abs(system.initial_state), system.m)[used]
    del form, M
    if bounded:
        mesh = few_elements(system, mesh, cuts, longest)
    mesh = known_resolved(
        system, plant.entries, lambda t: entries(system.coefficients, t, 0).values, mesh,
        plant.entries(mesh), beside, solver, bounded=bounded,
    )[0]
    parts = np.maximum(np.ceil(mesh.steps / longest), 1.0)
    if not parts.sum() <= solver.max_elements:
        return None
    if parts.max() > 1.0:
        mesh = mesh.split(parts.astype(np.intp))[0]
    if 2.0 * float(mesh.steps[0]) > longest:
        # What begins at zero is small in the first element, and is to be resolved there, too.
        mesh = Mesh(np.insert(mesh.edges, 1, mesh.edges[:2].mean()), mesh.rule)
    if stiff:  # what decays at once is not looked for by one round of cuts after the other
        finer = 8.0 ** -np.arange(np.floor(np.log2(mesh.steps[0] / shortest) / 3.0), 0.0, -1.0)
        edges = np.insert(mesh.edges, 1, mesh.edges[0] + mesh.steps[0] * finer)
        mesh = Mesh(edges, mesh.rule)
    # Known coefficients are resolved before anything is solved: that costs far less.
    mesh, form = cut_where(
        plant.matrix_tail, plant.eliminate, mesh, plant.eliminate(mesh), tol,
        solver.max_elements,
    )
    x0, z0 = _start(plant, mesh)
    floor_z = SHARE * np.abs(form.reduced(x0))[:, None]
    floor = form.sizes_from(floor_z)
    del form  # there may be others, on meshes that are finer

    def equation(mesh: Mesh) -> series.Equation:
        form = plant.eliminate(mesh)
        return form.matrix, form.f[:, :, None], ()

    def monitor(values: Array, _extras: tuple[Array, ...]) -> list[Kind]:
        x, y, u = _signals(plant, values)
        size = np.abs(x).max(axis=(0, 1))
        least = np.maximum(SHARE * plant.form.sizes_from(np.abs(values).max(axis=(0, 1))), floor)
        of_y = np.zeros((system.r, 1))
        np.add.at(of_y, plant.found.places["C"][0],
                  sizes_of(plant.found, "C")[:, None] * least[plant.found.places["C"][1]])
        shares = SHARE * _beside_inputs(plant.found, size, system.m)
        return [(x, least[:, 0]), (y, of_y[:, 0]), (u, shares)]

    problem = LinearProblem(
        _no_coefficients, z0[:, None], monitor, f"plant {system.name}", floor_z,
        units=units[:, None],
    )
    solution = series.solve(
        problem, equation, mesh, units=units, tol=tol, max_elements=solver.max_elements,
        stiff=stiff,
    )
    if solution is None:
        return None
    return _result(plant, solution, x0, cuts, bounded=bounded)


def _smooth(plant: _Plant, mesh: Mesh, cuts: Array) -> bool:
    """Whether no derivative that hidden constraints contain is an impulse at one of the cuts (B,).

    Then x_I does not jump. All that is differentiated has to be the same on both sides.
    """
    beside, longest = _BESIDE * mesh.steps.min(), mesh.steps.max()
    sides = np.concatenate([cuts - beside, cuts + beside])
    found = entries(plant.system.coefficients, np.tile(cuts, 2), plant.order, sides).values
    for name in ("E", "A", "B", "F", "phi", "u", "theta"):
        value = getattr(found, name)
        if value.shape[1] > 1:
            before, after = np.split(value, 2, axis=1)
            size, jump = (np.abs(x).max(axis=1) for x in (value, after - before))
            if (jump[:-1] > _SAME * (size[:-1] + longest * size[1:])).any():
                return False
    return True


def _no_coefficients(t: Array, inside: Array) -> LinearEquation:
    raise NotImplementedError  # the equation is given by mesh


def _beside_inputs(found: Entries, size: Array, m: int) -> Array:
    """:func:`least_beside` m inputs, (m,), with states of some size (n,)."""
    (i, j), (row, column) = found.places["A"], found.places["B"]
    terms = np.bincount(i, sizes_of(found, "A") * size[j], len(size)).astype(np.float64)
    return least_beside(terms, sizes_of(found, "B"), row, column, m)


def _signals(plant: _Plant, z: Array) -> tuple[Array, Array, Array]:
    """x (K, s + 1, n), y (K, s + 1, r) and u (K, s + 1, m) from z (K, s + 1, d, 1)."""
    system, found = plant.system, plant.found
    points = z.shape[:2]
    N = points[0] * points[1]
    x = plant.form.states_from(z.reshape(N, -1, 1))[:, :, 0]
    u, theta = np.zeros((N, system.m)), np.zeros((N, system.q))
    for name, signal in (("u", u), ("theta", theta)):
        signal[:, found.places[name][0]] = getattr(found.values, name)[0][:, found.which(name)]
    y = np.zeros((system.r, N))
    for name, signal in (("C", x), ("D", u), ("H", theta)):
        for (i, j), value in found.of(name).items():
            y[i] += value[0] * signal[:, j]
    return tuple(s.reshape(*points, -1) for s in (x, y.T, u))  # type: ignore[return-value]


def _start(plant: _Plant, mesh: Mesh) -> tuple[Array, Array]:
    """The consistent state (n,) at the start, and those of it that are integrated (d,).

    Without hidden constraints these are as they were asked for; otherwise see :func:`_conserved`.
    """
    form, x0 = plant.form, plant.system.initial_state
    z = form.reduced(x0)
    first = form.at_first()

    (i, j), values = plant.found.places["E"], plant.found.values.E[0, 0, plant.found.which("E")]

    def differential(x: Array, values: Array = values) -> Array:
        """E x (n, c)."""
        found = np.zeros(x.shape)
        np.add.at(found, i, values[:, None] * x[j])
        return found

    def sizes(z: Array) -> Array:
        """Of what states (n, 1) are made of."""
        return np.asarray(first.sizes_from(np.abs(z)[:, None])) + np.abs(x0)[:, None]

    missed = differential(first.states_from(z[None, :, None])[0] - x0[:, None])
    if (np.abs(missed) > _ROUNDING * EPS * differential(sizes(z), np.abs(values))).any():
        known = first.states_from(np.zeros((1, len(z), 1)))[0]
        moves = first.states_from(np.eye(len(z))[None])[0] - known
        kept = _conserved(plant, mesh).T
        moves, missed = kept @ differential(moves), kept @ missed
        size = np.abs(moves).max(axis=1, keepdims=True)
        z = z - np.linalg.solve(moves / size, missed / size)[:, 0]
    x = first.states_from(z[None, :, None])[0, :, 0]
    return np.where(np.abs(x - x0) <= _ROUNDING * EPS * sizes(z)[:, 0], x0, x), z


def _conserved(plant: _Plant, mesh: Mesh) -> Array:
    """Vectors p (n, d) of which pᵀE x does not jump where x does, at the start.

    They are consistent states of the adjoint equation Eᵀp' = −(A + E')ᵀp: for its smooth solutions
    (pᵀE x)' = pᵀf (UndecidedError: elimination does not solve it).
    """
    adjoint = _Plant(plant.system, plant.most)
    adjoint.order = plant.order  # more of E' has no effect
    t, inside = mesh.points[0, :1], mesh.inside[0, :1]
    now = entries(plant.system.coefficients, t, plant.order, inside)
    E, A = now.of("E"), {place: -v for place, v in now.of("A").items()}
    for place, v in E.items():
        if v[1:].any():
            slope = np.append(np.arange(1, len(v))[:, None] * v[1:], [[0.0]], axis=0)
            A[place] = A.get(place, 0.0) - slope
    places, values = {}, {}
    for name, terms in (("E", E), ("A", A)):
        places[name] = tuple(np.array([*terms]).T[::-1])
        values[name] = np.stack([*terms.values()], axis=2)
    form = adjoint.form_of(Entries(now.values._replace(**values), places), {})
    if form.d != plant.form.d:
        raise UndecidedError
    found: Array = form.states_from(np.eye(form.d)[None])[0]
    return found


def _result(
    plant: _Plant, solution: LinearSolution, x0: Array, cuts: Array, *, bounded: bool
) -> Simulation:
    mesh, z = solution.trajectory.mesh, solution.trajectory.values
    form, (x, y, u) = plant.form, _signals(plant, z)
    own_z, own = np.abs(z).max(axis=(0, 1)), np.abs(x).max(axis=(0, 1))
    made_of = np.maximum(form.sizes_from(own_z)[:, 0] + form.known, own)
    tail = legendre_tail(x, mesh.rule, np.maximum(np.abs(x).max(axis=1), TINY)).max(axis=0)
    wrong = form.sizes_from(solution.errors * own_z)[:, 0] + tail
    wrong += VALUE * EPS * form.loss * made_of
    scale = np.maximum(np.where(own > NOTHING * made_of, own, made_of), TINY)
    state_errors = wrong / scale
    at, none = np.searchsorted(mesh.edges, cuts).tolist(), np.zeros((form.mu, len(x0)))
    jumps = [(float(mesh.edges[k]), x[k - 1, -1], Jump(x[k, 0], none)) for k in at]
    return Simulation(
        signals=Signals(Trajectory(mesh, u), Trajectory(mesh, y), Trajectory(mesh, x)),
        structure=plant.structure(), initial_state=x0, jumps=tuple(jumps),
        error_estimate=max(solution.error_estimate, float(state_errors.max(initial=0.0))),
        bounded=bounded, state_errors=state_errors, lost=solution.lost,
    )
