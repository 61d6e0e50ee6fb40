"""Linear time-varying ODEs and strangeness-free DAEs by collocation, all elements at once.

    E(t) X' = A(t) X + f(t),      X(start) = X_0

Everything this program integrates has this form. Because it is linear, an element does not need
to know where it starts: one batched solve gives, for every element, the map from its left end to
its nodes, and the elements are chained with small products afterwards. Refinement therefore
solves only the elements that are new.

Stage equations at node i of an element of length h, with D = R⁻¹ the Radau differentiation:

    E_i (D X − (D𝟙) x_0)_i / h = A_i X_i + f_i

Where constraints are given apart, X_i = T_i z_i + p_i satisfies them at every node and z is what
is solved for: the same collocation with s·d unknowns instead of s·n. No derivative of T appears,
so T need not be smooth in time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.kernels import elements, elements_numpy
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics import taylor
from gpebo_cli.numerics.errors import (
    CHANCE,
    EPS,
    estimated_errors,
    least_sizes,
    nothing_left,
    through_constraints,
)
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import Mesh, Trajectory, equal_lengths, unresolved, unresolved_kinds
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem, at_points
from gpebo_cli.numerics.radau import ComplexArray, RadauRule, differentiation_schur
from gpebo_cli.numerics.refinement import refine
from gpebo_cli.numerics.rounding import FAST, kept_share, noise_of, noise_of_instants

_CHUNK = 1 << 20  # numbers of maps that are made at once (8 MB)
_DIRECT = 400  # unknowns
_SERIES = 100  # unknowns, from which on series may cost less
_POINTS = 1 << 14  # at which coefficients are evaluated at once: what fits the cache
_COARSE = 1e-6  # tails beyond that are rounding, and of which component is not known
_BEYOND = 5.0  # times what the constraints are seen to be missed by, which counts of a bound
_MODEST = 1e100  # values up to here may be multiplied with each other
# The C library gives freed memory back to the system, page by page, and takes as much again a
# moment later, unless it has seen a larger array come and go: up to 32 MB. This one is never
# written to.
np.empty((1 << 22) - 4096)


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Point values of X on the mesh that resolves it, and an estimate of the error."""

    trajectory: Trajectory  # values (K, s + 1, n, columns)
    error_estimate: float  # relative to each signal's own size, the largest
    errors: Array  # (n, columns) of each component of X relative to its largest value
    lost: float | None  # from when on a component's error exceeds the component
    extras: tuple[Array, ...] = ()  # of the coefficients, (K, s + 1, ...) each, or (1, 1, ...)
    uncertain: Array | None = None  # (n, columns) estimated errors at the end
    vague: BoolArray | None = None  # (n, columns) components of which few digits are known


# X at the nodes of each element = ``homogeneous`` X(left end) + ``particular``: the first one
# (K, s, n, n), or (1, s, n, n) if it is the same for all; the second (K, s, n, columns); ``noise``
# (K, n, n + 2 columns), see estimated_errors; and extras (K, s + 1, ...), or (1, 1, ...) where they
# are constant.
_Maps = list[Array]


def solve(
    problem: LinearProblem, mesh: Mesh, *, tol: float, max_elements: int,
    restarts: Mapping[float, Callable[[Array], Array]] | None = None,
    known: LinearEquation | None = None,
) -> LinearSolution:
    """Solve on ``mesh``, refined until every signal is resolved to ``tol``.

    Edges of the mesh stay edges. ``tol`` is for the tail of each element's Legendre coefficients,
    relative to each signal's own size. At ``restarts`` a map makes a new start of the limit from
    the left (n, columns); ``known`` are the coefficients at all points of ``mesh``, where they are
    at hand.
    """

    def evaluate(
        mesh: Mesh, before: tuple[_Maps, Array, int] | None, kept: IntArray
    ) -> tuple[tuple[_Maps, Array, int], Array]:
        given, fresh = known if before is None else None, kept < 0
        if fresh.all():
            before = None  # it would be as much again
        maps = _element_maps(problem, mesh, fresh, given)
        if before is not None:
            maps = merged(before[0], maps, kept)
        values, whole = _chain(maps, problem, mesh, restarts or {})
        tail = _tail_of_numbers(problem, mesh, values, maps, whole, tol)
        return (maps, values, whole), tail

    mesh, (maps, values, whole), tail = refine(
        evaluate, mesh, tol=tol, max_elements=max_elements, name=problem.name,
        fixed=restarts or (), advice=problem.advice,
    )
    if whole < mesh.size:
        raise _not_finite(problem, mesh, maps, values, float(mesh.edges[whole]))
    homogeneous, particular, noise, *extras = maps
    left = float(tail.max(initial=0.0))
    if problem.renewal is not None:
        of_each = np.full(problem.start.shape, left)
        return LinearSolution(Trajectory(mesh, values), left, of_each, None, tuple(extras))
    kept = kept_share(problem, mesh, noise, values)
    cuts = np.array(list(restarts or ()))
    instants = noise_of_instants(problem, Trajectory(mesh, values), cuts)
    bound = EPS * through_constraints(problem, largest_over_time(values, 2))
    shown = problem.missed and problem.missed(mesh, values, bound)
    if shown is not None:
        problem = replace(problem, seen=_BEYOND * CHANCE * shown / EPS)
    errors = estimated_errors(
        problem, mesh, homogeneous[:, -1], particular[:, -1], noise, values, kept, instants
    )
    if shown is not None:
        errors = errors._replace(largest=np.maximum(errors.largest, CHANCE * shown))
    if left > _COARSE:
        errors = errors._replace(largest=np.maximum(errors.largest, left * errors.own))
    return LinearSolution(
        Trajectory(mesh, values), max(left, errors.estimate), errors.relative,
        None if errors.lost == mesh.size else float(mesh.edges[errors.lost + 1]), tuple(extras),
        errors.last, None if problem.units is None else errors.vague(tol),
    )


def _not_finite(
    problem: LinearProblem, mesh: Mesh, maps: _Maps, values: Array, since: float
) -> SolverError:
    """Why a solution is not finite: it grows, or what rounding left of something small does."""
    count = _modest(values)
    if count and problem.renewal is None:
        homogeneous, particular, noise = (array[:count] for array in maps[:3])
        lost = estimated_errors(
            problem, Mesh(mesh.edges[: count + 1], mesh.rule), homogeneous[:, -1],
            particular[:, -1], noise, values[:count],
        ).lost
        if lost < count:
            return nothing_left(problem.name, float(mesh.edges[lost + 1]))
    return SolverError(
        f"the solution of the {problem.name} is not finite from t = {since:.6g} on: it grows "
        "beyond all numbers; is a sign wrong? Else shorten time.horizon"
    )


def _modest(values: Array) -> int:
    """How many elements in front have values (K, ...) that may be multiplied with each other."""
    with np.errstate(invalid="ignore"):
        modest = (np.abs(values) < _MODEST).all(axis=(1, 2, 3))
    return len(values) if modest.all() else int(np.argmin(modest))


def _tail_of_numbers(
    problem: LinearProblem, mesh: Mesh, values: Array, maps: _Maps, whole: int, tol: float
) -> Array:
    """:func:`unresolved_signals`; where not all is finite, of the elements before, else zero.

    The first ``whole`` elements are finite. Elements that are too long may seem to grow, and many
    of them multiply to anything: those in front are resolved first.
    """
    count = mesh.size if whole == mesh.size else _modest(values)
    tail = np.zeros(mesh.size)
    if count:
        part = slice(count)
        if problem.units is not None:
            last, particular = (np.abs(array[part, -1]) for array in maps[:2])
            made_of = last @ np.abs(values[part, 0]) + particular
        else:  # lengths are said: there may be no components
            made_of = values[part].reshape(count * values.shape[1], *values.shape[2:])
        tail[part] = unresolved_signals(
            problem, mesh.rule, values[part],
            tuple(e[part] for e in maps[3:]), largest_over_time(made_of), tol,
        )
    return tail


def unresolved_signals(
    problem: LinearProblem, rule: RadauRule, values: Array, extras: tuple[Array, ...],
    made_of: Array, tol: float,
) -> Array:
    """:func:`unresolved_kinds` over the solution and everything computed from it, shape (K,).

    Each component is measured by its own size, but see :func:`least_sizes` for what it is
    ``made_of`` (n, columns).
    """
    size, points, n, columns = values.shape
    tail = np.zeros(size)
    if problem.monitor is not None:  # it may show elements before these
        tail = unresolved_kinds(problem.monitor(values, extras), rule)[-size:]
    if problem.told:
        return tail
    least = least_sizes(problem, made_of, tol).reshape(n * columns)
    return np.maximum(tail, unresolved(values.reshape(size, points, n * columns), rule, least))


def merged(before: Sequence[Array], after: Sequence[Array], kept: IntArray) -> list[Array]:
    """Of all elements of a mesh, from those of the mesh before and of the fresh ones.

    Both (K, s, ...) each, or (1, 1, ...) where all have the same; ``kept`` (K',) says for each
    element which one before it is, −1 for a fresh one.
    """
    fresh = kept < 0

    def whole(one: Array, other: Array) -> Array:
        if one.shape[:2] == other.shape[:2] == (1, 1):
            return one
        found = one.take(kept, axis=0, mode="clip")  # one copy: long horizons have gigabytes
        if found.shape[1] < other.shape[1]:
            found = found.repeat(other.shape[1], axis=1)
        found[fresh] = other
        return found

    return [whole(one, other) for one, other in zip(before, after, strict=True)]


def _element_maps(
    problem: LinearProblem, mesh: Mesh, elements: BoolArray, known: LinearEquation | None
) -> _Maps:
    """What some elements make of their left ends, found in chunks of bounded memory."""
    n, columns = problem.start.shape
    s = mesh.rule.stages
    h, t, inside = (each[elements] for each in (mesh.steps, mesh.points, mesh.inside))
    chunk = max(1, min(_CHUNK // max(s * n * (n + columns), 1), _POINTS // (s + 1)))
    whole: list[Array] = []  # filled piece by piece: all pieces beside the whole are twice as much
    for i in range(0, len(h), chunk):
        part = slice(i, i + chunk)
        if known is None:
            c = problem.coefficients(t[part].ravel(), inside[part].ravel())
        else:
            c = known.of(part, s + 1)
        maps = _solve_elements(problem, mesh, h[part], t[part], c)
        if len(h) <= chunk:
            return maps
        if not whole:
            whole = [
                values if values.shape[:2] == (1, 1) else np.empty((len(h), *values.shape[1:]))
                for values in maps
            ]
        for everywhere, here in zip(whole, maps, strict=True):
            if everywhere.shape[:2] != (1, 1):
                everywhere[part] = here
    return whole


def _is_constant(c: LinearEquation) -> bool:
    """Whether everything but the forcing is constant in time."""
    basis = None if c.constraints is None else c.constraints.basis
    return all(matrix is None or len(matrix) == 1 for matrix in (c.E, c.A, basis))


def _rows_alike(
    problem: LinearProblem, rule: RadauRule, h: Array, c: LinearEquation
) -> LinearEquation:
    """The equation with rows among which pivots may be chosen, in elements of lengths h (K,).

    In a short element D/h is large beside rows without E, whose unknowns would be taken from rows
    with it, and lose their digits: those are divided by h, too. In a long one rows of a fast mode
    are large. Where bases turn from node to node they would serve slow unknowns, which would have
    their rounding: all rows come to the size one, in units of the states.
    """
    E, units = c.E, problem.units
    if E is None or len(c.A) == 1:
        return c
    if units is None or problem.rate * h.max(initial=0.0) < FAST:
        if (some := E.any(axis=(0, 2))).all():
            return c
        weights = np.where(some, 1.0, (1.0 / h).repeat(rule.stages + 1)[:, None])[..., None]
        return c._replace(A=c.A * weights, f=c.f * weights)
    of_E, T = np.abs(E) @ units, c.constraints and c.constraints.basis
    of_A = np.abs(c.A) @ units if T is None else np.abs(c.A @ T) @ of_E
    slopes = np.append(0.0, np.abs(rule.differentiation).max(axis=1)) / h[:, None]
    size = np.maximum(of_E * slopes.reshape(-1, 1, 1), of_A)
    size[size == 0.0] = 1.0
    return c._replace(E=E / size, A=c.A / size, f=c.f / size)


def _solve_elements(
    problem: LinearProblem, mesh: Mesh, h: Array, t: Array, c: LinearEquation
) -> _Maps:
    k, s = len(h), mesh.rule.stages
    basis, offset = (None, None) if c.constraints is None else c.constraints
    group, groups = np.arange(k), k
    rows = _rows_alike(problem, mesh.rule, h, c)
    solve: Callable[..., tuple[Array, Array]] = elements.element_maps
    if _is_constant(c):
        group, h = equal_lengths(h, mesh)
        groups = int(group.max(initial=-1)) + 1
        if s * c.A.shape[1] > _DIRECT:
            solve = partial(elements_numpy.element_maps, solve=solve_constant)
    found = None
    if c.E is None and basis is None and len(c.A) > 1 and s * c.A.shape[1] > _SERIES:
        found = taylor.element_maps(mesh.rule, h, c.A, c.f)
    try:
        homogeneous, particular = found or solve(
            mesh.rule.differentiation, h, rows.E, rows.A, rows.f, basis, offset, group, groups
        )
    except np.linalg.LinAlgError as error:
        raise SolverError(
            f"the {problem.name} has a singular collocation system between t = {t[0, 0]:.6g} "
            f"and {t[-1, -1]:.6g}; loosen solver.tol, or choose a horizon that avoids this time"
        ) from error
    if 1 < groups < k:
        homogeneous = homogeneous[group]
    extras = [at_points(extra, k, s) for extra in c.extras]
    return [homogeneous, particular, noise_of(h, t, c), *extras]


def solve_constant(D: Array, h: float, E: Array, A: Array, T: Array | None, right: Array) -> Array:
    """As ``elements_numpy.solve_blocks`` for E, A (s, d, n) and T that are constant."""
    E, A = (E[0], A[0]) if T is None else (E[0] @ T[0], A[0] @ T[0])

    def solve(shift: complex, r: ComplexArray) -> ComplexArray:
        return np.asarray(np.linalg.solve(shift * E - A, r), dtype=np.complex128)

    return decoupled(len(D), h, right, solve, E)


def decoupled(
    s: int, step: float, right: Array, solve: Callable[[complex, ComplexArray], ComplexArray],
    E: Array | None = None,
) -> Array:
    """(D/h ⊗ E − I ⊗ A) Z = ``right`` (s, d, columns) by what solves (shift E − A) y = r.

    With D = U T Uᴴ the stages decouple from the last to the first: s systems of size d instead of
    one of size s·d. ``E`` (d, d): None is the identity.
    """
    U, T = differentiation_schur(s)
    T = T / step
    Y = np.tensordot(U.conj().T, right, axes=1)
    EY = Y if E is None else np.empty_like(Y)
    for i in range(s - 1, -1, -1):
        later = np.tensordot(T[i, i + 1 :], EY[i + 1 :], axes=1)
        Y[i] = solve(complex(T[i, i]), Y[i] - later)
        if E is not None:
            EY[i] = E @ Y[i]
    return np.asarray(np.tensordot(U, Y, axes=1).real)


def _chain(
    maps: _Maps, problem: LinearProblem, mesh: Mesh,
    restarts: Mapping[float, Callable[[Array], Array]],
) -> tuple[Array, int]:
    """Point values (K, s + 1, n, columns), and how many elements in front are finite."""
    renew = problem.renewal
    homogeneous, particular, *_ = maps
    if not restarts:
        return elements.chain(homogeneous, particular, problem.start, renew)
    edges = mesh.edges.tolist()
    cuts = [0, *(k for k in range(1, mesh.size) if edges[k] in restarts), mesh.size]
    state, pieces, whole = problem.start, [], 0
    for first, last in pairwise(cuts):
        if first:
            state = restarts[edges[first]](state)
        part = slice(first, last)
        own = homogeneous if len(homogeneous) == 1 else homogeneous[part]
        values, finite = elements.chain(own, particular[part], state, renew)
        whole += finite if whole == first else 0
        pieces.append(values)
        state = values[-1, -1]
    return np.concatenate(pieces), whole
