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

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.kernels import elements
from gpebo_cli.kernels.elements_numpy import at_nodes, forcing_at_nodes
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics.mesh import (
    SHARE,
    Mesh,
    Trajectory,
    unresolved_kinds,
    used_coefficients,
)
from gpebo_cli.numerics.radau import RadauRule, differentiation_schur


class Constraints(NamedTuple):
    """All X that satisfy the constraints at N times: X = T z + offset with any z."""

    basis: Array  # (N, n, d) T
    offset: Array  # (N, n, columns)


class LinearEquation(NamedTuple):
    """The equation at N times; a leading axis of 1 means constant in time.

    With ``constraints``, E, A and f are the d differential equations only.
    """

    E: Array | None  # (N, n or d, n), None for the identity
    A: Array  # (N, n or d, n)
    f: Array  # (N, n or d, columns)
    extras: tuple[Array, ...] = ()  # (N, ...) each: whatever the monitor needs at these times
    constraints: Constraints | None = None


# (point values (K, s + 1, n, columns), extras (K, s + 1, ...)) -> signals by kind
Monitor = Callable[[Array, tuple[Array, ...]], list[tuple[Array, float]]]

_CHUNK = 1 << 23  # numbers in one batch of element systems (64 MB)
_DIRECT = 400  # unknowns
_POINTS = 1 << 14  # at which coefficients are evaluated at once: what fits the cache
_MODEST = 1e100  # values up to here may be multiplied with each other
_MAX_PARTS = 8  # an element is cut into at most this many at once
_LEVEL = 0.3  # coefficients that fall by less than this over two degrees are noise
_EPS = float(np.finfo(float).eps)
_ROUNDING = 64 * _EPS
_EQUAL = 1e-11  # relative difference of lengths that is rounding
# The C library gives freed memory back to the system, page by page, and takes as much again a
# moment later, unless it has seen a larger array come and go. This one is never written to.
np.empty(_CHUNK // 4)


class Renewal(Protocol):
    """At every edge, an equivalent value to go on with: a basis whose columns grow is changed."""

    def state(self, reached: Array) -> Array:
        """What (n, columns) replaces the limit from the left."""
        ...

    def error(self, reached: Array, error: Array) -> Array:
        """What becomes of small errors (e, n, columns) of that limit."""
        ...


@dataclass(frozen=True)
class LinearProblem:
    """The equation, and which other signals of the solution have to be resolved by the mesh.

    ``coefficients(t, inside)`` evaluates E, A, f at times of shape (N,); functions that jump are
    decided at ``inside``. It is called once for each element, at all of its points.
    ``monitor`` returns further signals computed from the solution, grouped by kind: (point values
    (K, s + 1, c), size below which that kind is rounding).
    """

    coefficients: Callable[[Array, Array], LinearEquation]
    start: Array  # (n, columns)
    monitor: Monitor | None = None
    name: str = "equation"
    floor: float = 0.0  # size below which the solution itself is rounding
    # (n, n + 1) by how much relative rounding of the components, and of 1, reaches each component
    amplification: Array | None = None
    renewal: Renewal | None = None


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Point values of X on the mesh that resolves it, and an estimate of the error."""

    trajectory: Trajectory  # values (K, s + 1, n, columns)
    error_estimate: float  # relative to each signal's own size
    rounds: int
    extras: tuple[Array, ...] = ()  # of the coefficients, (K, s + 1, ...) each, or (1, 1, ...)


@dataclass(frozen=True, eq=False)
class _ElementMaps:
    """X at the nodes of each element = ``homogeneous`` X(left end) + ``particular``."""

    homogeneous: Array  # (K, s, n, n), or (1, s, n, n) if it is the same for all
    particular: Array  # (K, s, n, columns)
    extras: tuple[Array, ...]  # (K, s + 1, ...) each, or (1, 1, ...) if constant


def solve(
    problem: LinearProblem,
    mesh: Mesh,
    *,
    tol: float,
    max_elements: int,
    restarts: Mapping[float, Callable[[Array], Array]] | None = None,
    known: LinearEquation | None = None,
) -> LinearSolution:
    """Solve on ``mesh``, refined until every signal is resolved to ``tol``.

    Args:
        problem: the equation.
        mesh: where to start; its edges stay edges.
        tol: target for the tail of each element's Legendre coefficients, relative to each
            signal's own size.
        max_elements: refuse to go beyond.
        restarts: at these edges, the map from the limit from the left (n, columns) to the new
            start.
        known: the coefficients at all points of ``mesh``, where they are at hand.

    Raises:
        SolverError: if ``max_elements`` do not reach ``tol``; names the time.
    """
    maps = _element_maps(problem, mesh, None, known)
    floor: Array | None = None  # the tail of the parent, to notice that cutting no longer helps
    rounds = 1
    while True:
        values, whole = _chain(maps, problem, mesh, restarts or {})
        tail = _tail_of_numbers(problem, mesh, values, maps.extras, whole)
        poor = tail > tol
        if floor is not None:
            # Rounding floor: an element whose parent was already this good is not cut again.
            poor &= ~((floor > 0) & (tail > 0.25 * floor) & (tail < 1e-6))
        if not poor.any():
            if whole == mesh.size:
                break
            raise SolverError(
                f"the solution of the {problem.name} is not finite from "
                f"t = {mesh.edges[whole]:.6g} on: it grows beyond all numbers; "
                "is a sign wrong? Else shorten time.horizon"
            )
        parts = wanted_parts(tail, poor, tol, mesh.rule.stages)
        _check_budget(problem, mesh, tail, parts, max_elements)
        finer, kept = mesh.split(parts)
        fresh = kept < 0
        new = _element_maps(problem, finer, fresh)
        before = np.repeat(np.zeros(mesh.size) if floor is None else floor, parts)
        floor = np.where(fresh, np.repeat(tail, parts), before)
        maps = _merge(maps, new, kept, fresh)
        mesh, rounds = finer, rounds + 1
    estimate = max(float(tail.max(initial=0.0)), _estimates(problem, maps, values, mesh))
    return LinearSolution(Trajectory(mesh, values), estimate, rounds, maps.extras)


def _tail_of_numbers(
    problem: LinearProblem, mesh: Mesh, values: Array, extras: tuple[Array, ...], whole: int
) -> Array:
    """:func:`unresolved_signals`; where not all is finite, of the elements before, else zero.

    So many elements in front are finite as ``whole`` says.

    Elements that are too long may seem to grow, and many of them multiply to anything: those in
    front are resolved first.
    """
    if whole == mesh.size:
        return unresolved_signals(problem, mesh, values, extras)
    with np.errstate(invalid="ignore"):
        count = int(np.argmin((np.abs(values) < _MODEST).all(axis=(1, 2, 3))))
    tail = np.zeros(mesh.size)
    if count:
        tail[:count] = unresolved_signals(
            problem, Mesh(mesh.edges[: count + 1], mesh.rule), values[:count],
            tuple(e if e.shape[:2] == (1, 1) else e[:count] for e in extras),
        )
    return tail


def wanted_parts(tail: Array, poor: BoolArray, tol: float, stages: int) -> IntArray:
    """Into how many parts (K,) to cut each element so that its tail (K,) falls to ``tol``."""
    parts = np.ones(len(tail), dtype=np.intp)
    wanted = 1.25 * (tail[poor] / tol) ** (1.0 / stages)
    parts[poor] = np.minimum(np.maximum(np.ceil(wanted), 2), _MAX_PARTS).astype(np.intp)
    return parts


def unresolved_signals(
    problem: LinearProblem, mesh: Mesh, values: Array, extras: tuple[Array, ...]
) -> Array:
    """:func:`unresolved_kinds` over the solution and everything computed from it, shape (K,)."""
    size, points, n, columns = values.shape
    kinds = [(values.reshape(size, points, n * columns), problem.floor)]
    if problem.monitor is not None:
        kinds += problem.monitor(values, extras)
    return unresolved_kinds(kinds, mesh.rule)


def _estimates(
    problem: LinearProblem, maps: _ElementMaps, values: Array, mesh: Mesh
) -> float:
    """The largest of accumulated error, visible noise and rounding, relative to the sizes."""
    renew = None if problem.renewal is None else problem.renewal.error
    found = elements.estimates(
        maps.homogeneous, values, mesh.rule.to_legendre, used_coefficients(mesh.rule),
        problem.amplification, problem.floor, SHARE, _LEVEL, renew,
    )
    return max(_ROUNDING, *found)


def _check_budget(
    problem: LinearProblem, mesh: Mesh, tail: Array, parts: IntArray, max_elements: int
) -> None:
    worst = int(np.argmax(tail))
    t = mesh.edges[worst]
    # Next to t = 0 floating point resolves any transient; elsewhere 64 units in the last place.
    resolution = 64 * _EPS * np.abs(mesh.edges[1:])
    if parts.sum() > max_elements:
        raise SolverError(
            f"the {problem.name} is not resolved with {max_elements} elements; worst near "
            f"t = {t:.6g} (tail {tail[worst]:.1e}); raise solver.max_elements or solver.tol"
        )
    if (mesh.steps < resolution)[parts > 1].any():
        raise SolverError(
            f"the {problem.name} cannot be resolved near t = {t:.6g}: elements reached the "
            f"resolution of floating point (tail {tail[worst]:.1e}); is there a jump or a "
            "singularity?"
        )


def _merge(old: _ElementMaps, new: _ElementMaps, kept: IntArray, fresh: BoolArray) -> _ElementMaps:
    def merged(before: Array, after: Array) -> Array:
        out = np.empty((len(kept), *before.shape[1:]))
        out[~fresh] = before if len(before) == 1 else before[kept[~fresh]]
        out[fresh] = after
        return out

    return _ElementMaps(
        merged(old.homogeneous, new.homogeneous),
        merged(old.particular, new.particular),
        tuple(
            a if a.shape[:2] == (1, 1) else merged(a, b)
            for a, b in zip(old.extras, new.extras, strict=True)
        ),
    )


def _element_maps(
    problem: LinearProblem, mesh: Mesh, elements: BoolArray | None,
    known: LinearEquation | None = None,
) -> _ElementMaps:
    """Solve the block systems of some elements, None: all, in chunks of bounded memory."""
    n, columns = problem.start.shape
    s = mesh.rule.stages
    h, t, inside = mesh.steps, mesh.points, mesh.inside
    if elements is not None:
        h, t, inside = h[elements], t[elements], inside[elements]
    numbers = s * n * (n + columns)
    if known is None or not _is_constant(known):
        numbers += s * s * n * n
    chunk = max(1, min(_CHUNK // numbers, _POINTS // (s + 1)))
    if len(h) <= chunk:
        c = problem.coefficients(t.ravel(), inside.ravel()) if known is None else known
        return _solve_elements(problem, mesh.rule, h, t, c)
    whole: list[Array] = []  # filled piece by piece: all pieces beside the whole are twice as much
    for i in range(0, len(h), chunk):
        part = slice(i, i + chunk)
        if known is None:
            c = problem.coefficients(t[part].ravel(), inside[part].ravel())
        else:
            c = _at_points(known, slice(i * (s + 1), (i + chunk) * (s + 1)))
        maps = _solve_elements(problem, mesh.rule, h[part], t[part], c)
        piece = [maps.homogeneous, maps.particular, *maps.extras]
        if not whole:
            whole = [
                values if values.shape[:2] == (1, 1) else np.empty((len(h), *values.shape[1:]))
                for values in piece
            ]
        for everywhere, here in zip(whole, piece, strict=True):
            if everywhere.shape[:2] != (1, 1):
                everywhere[part] = here
    return _ElementMaps(whole[0], whole[1], tuple(whole[2:]))


def _is_constant(c: LinearEquation) -> bool:
    """Whether everything but the forcing is constant in time."""
    matrices = [c.A] if c.E is None else [c.A, c.E]
    if c.constraints is not None:
        matrices.append(c.constraints.basis)
    return all(len(matrix) == 1 for matrix in matrices)


def _at_points(c: LinearEquation, part: slice) -> LinearEquation:
    """The coefficients at some of their times."""

    def some(values: Array) -> Array:
        return values if len(values) == 1 else values[part]

    return LinearEquation(
        None if c.E is None else some(c.E), some(c.A), some(c.f), tuple(map(some, c.extras)),
        None if c.constraints is None else Constraints(*map(some, c.constraints)),
    )


def at_points(values: Array, k: int, s: int) -> Array:
    """(k (s + 1), ...) -> (k, s + 1, ...); (1, ...) -> (1, 1, ...)."""
    if len(values) == 1:
        return values[None]
    return values.reshape(k, s + 1, *values.shape[1:])


def _solve_elements(
    problem: LinearProblem, rule: RadauRule, h: Array, t: Array, c: LinearEquation
) -> _ElementMaps:
    k, s = len(h), rule.stages
    extras = tuple([at_points(extra, k, s) for extra in c.extras])
    basis, offset = (None, None) if c.constraints is None else c.constraints
    group = _equal_lengths(h) if _is_constant(c) else np.arange(k)
    groups = int(group.max(initial=-1)) + 1
    solve = elements.element_maps
    if _is_constant(c) and s * c.A.shape[1] > _DIRECT:
        solve = _decoupled_maps
    try:
        homogeneous, particular = solve(
            rule.differentiation, h, c.E, c.A, c.f, basis, offset, group, groups
        )
    except np.linalg.LinAlgError as error:
        raise SolverError(
            f"the {problem.name} has a singular collocation system between t = {t[0, 0]:.6g} "
            f"and {t[-1, -1]:.6g}; loosen solver.tol, or choose a horizon that avoids this time"
        ) from error
    if 1 < groups < k:
        homogeneous = homogeneous[group]
    return _ElementMaps(homogeneous, particular, extras)


def _equal_lengths(h: Array) -> IntArray:
    """Group (K,) of each length; those that differ by rounding only count as equal."""
    order = np.argsort(h, kind="stable")
    new = np.diff(h[order]) > _EQUAL * h.max()
    group = np.empty(len(h), dtype=np.intp)
    group[order] = np.append(0, np.cumsum(new))
    return group


def _decoupled_maps(
    D: Array, h: Array, E: Array | None, A: Array, f: Array, basis: Array | None,
    offset: Array | None, group: IntArray, groups: int,
) -> tuple[Array, Array]:
    """As ``elements.element_maps`` for constant E, A and T: stages are decoupled."""
    k, s, columns = len(h), len(D), f.shape[2]
    d, n = A.shape[1:]
    forcing = forcing_at_nodes(D, h, E, A, f, offset)
    E_, A_ = np.eye(n) if E is None else E[0], A[0]
    T = np.eye(n) if basis is None else basis[0]
    start = D.sum(axis=1)[:, None, None]
    homogeneous, particular = np.empty((groups, s, n, n)), np.empty((k, s, n, columns))
    for g in range(groups):
        same = np.flatnonzero(group == g)
        step = h[same[0]]
        right = np.empty((s, d, n + len(same) * columns))
        right[:, :, :n] = start / step * E_
        right[:, :, n:] = np.moveaxis(forcing[same], 0, 2).reshape(s, d, len(same) * columns)
        solved = T @ solve_constant(s, step, E_ @ T, A_ @ T, right)
        homogeneous[g] = solved[:, :, :n]
        particular[same] = np.moveaxis(
            solved[:, :, n:].reshape(s, n, len(same), columns), 2, 0
        )
    if offset is not None:
        particular += at_nodes(offset, k, s)
    return homogeneous, particular


def solve_constant(s: int, step: float, E: Array, A: Array, right: Array) -> Array:
    """(D/h ⊗ E − I ⊗ A) Z = ``right`` for constant E, A (d, d); Z and ``right`` (s, d, columns).

    With D = U T Uᴴ the stages decouple from the last to the first: s systems of size d instead of
    one of size s·d.
    """
    U, T = differentiation_schur(s)
    T = T / step
    Y = np.tensordot(U.conj().T, right, axes=1)
    EY = np.empty_like(Y)
    for i in range(s - 1, -1, -1):
        later = np.tensordot(T[i, i + 1 :], EY[i + 1 :], axes=1)
        Y[i] = np.linalg.solve(T[i, i] * E - A, Y[i] - later)
        EY[i] = E @ Y[i]
    return np.asarray(np.tensordot(U, Y, axes=1).real)


def _chain(
    maps: _ElementMaps,
    problem: LinearProblem,
    mesh: Mesh,
    restarts: Mapping[float, Callable[[Array], Array]],
) -> tuple[Array, int]:
    """Point values (K, s + 1, n, columns), and how many elements in front are finite."""
    renew = None if problem.renewal is None else problem.renewal.state
    if not restarts:
        return elements.chain(maps.homogeneous, maps.particular, problem.start, renew)
    edges = mesh.edges.tolist()
    cuts = [0, *(k for k in range(1, mesh.size) if edges[k] in restarts), mesh.size]
    state, pieces, whole = problem.start, [], 0
    for first, last in pairwise(cuts):
        if first:
            state = restarts[edges[first]](state)
            if renew is not None:
                state = renew(state)
        part = slice(first, last)
        same = len(maps.homogeneous) == 1
        homogeneous = maps.homogeneous if same else maps.homogeneous[part]
        values, finite = elements.chain(homogeneous, maps.particular[part], state, renew)
        whole += finite if whole == first else 0
        pieces.append(values)
        state = values[-1, -1]
    return np.concatenate(pieces), whole
