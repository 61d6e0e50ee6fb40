"""Large systems that are not stiff, x' = A x + f with few entries: series in time.

An element needs no factorisation where h‖A‖ is modest, see :mod:`.taylor`. Errors are carried on by
the same series, to two digits.

Where h‖A‖ is not modest, equations of collocation are solved: by :mod:`.elimination`, or where A is
full and constant with one factorisation for all elements of one length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics import taylor
from gpebo_cli.numerics.collocation import LinearSolution, decoupled, unresolved_signals
from gpebo_cli.numerics.elimination import StiffError, by_elimination
from gpebo_cli.numerics.errors import END, EPS, LEVEL, TINY, Errors, judged_errors, random_signs
from gpebo_cli.numerics.linalg import largest_within
from gpebo_cli.numerics.mesh import SHARE, Mesh, Trajectory, equal_lengths, predicted_tail
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem, at_points
from gpebo_cli.numerics.radau import ComplexArray
from gpebo_cli.numerics.refinement import refine
from gpebo_cli.numerics.taylor import DENSE, LENGTH, Sparse, by_entries

MOST_ELEMENTS = 800  # with more of them the system counts as stiff
_DIGITS = 1e-2  # of the tolerance, to which series go on
_ROUGH = 0.02  # to which errors are carried
_AT_ONCE = 4  # elements of which all points are held, where errors are carried
_FEW_COLUMNS = 4  # whose errors are carried one by one

# Values (K, s + 1, d, c) of x' = A x + f on a mesh, f of the first columns, from a start (d, c),
# with kicks (K, d, c) at right ends; and how far each element may be from a solution, relative
March = Callable[[Mesh, Sparse, Array, Any, Array, float], tuple[Array, Array]]

Equation = tuple[Sparse, Array, tuple[Array, ...]]


def solve(
    problem: LinearProblem, equation: Callable[[Mesh], Equation], mesh: Mesh, *,
    units: Array, tol: float, max_elements: int, stiff: bool = False,
) -> LinearSolution | None:
    """As :func:`gpebo_cli.numerics.collocation.solve`, or None where series will not do.

    In place of the problem's coefficients the ``equation`` gives A, f (P or 1, d, ·) of the first
    columns and what the monitor needs, at the points of a mesh. Components have ``units`` (d,).
    Where it is ``stiff``, elements are solved, without series.
    """
    A, _, _ = equation(mesh)
    march: March = partial(taylor.march, 1.0 / units)
    if stiff:
        full = len(A.entries) == 1 and len(A.columns) > DENSE * len(A.rows) ** 2
        march = by_factors(A) if full else by_elimination
    else:
        parts = np.ceil(mesh.steps * A.norms(A.sizes(mesh.size), units) / LENGTH)
        parts = np.maximum(parts, 1.0)
        if not parts.sum() <= min(MOST_ELEMENTS, max_elements):
            return None
        if parts.max() > 1.0:
            mesh = mesh.split(parts.astype(np.intp))[0]
    del A  # another one would be as much again

    def evaluate(mesh: Mesh, before: _Found | None, kept: IntArray) -> tuple[_Found, Array]:
        # What comes before the first element that was cut is as it was.
        front, start = int(np.argmax(kept < 0)), problem.start
        if before is not None and front:
            done = before.trajectory.values[:front].copy(), before.change[:front].copy()
            start = done[0][-1, -1]
        del before
        A, f, extras = equation(mesh)
        enough = max(_DIGITS * tol, 8.0 * EPS)
        there = f if len(f) == 1 else f[len(f) // mesh.size * front :]
        values, change = march(*_part(mesh, A, front), there, None, start, enough)
        if front:
            values, change = map(np.concatenate, zip(done, (values, change), strict=True))
        if (change[np.isfinite(change)] > 8.0 * enough).any() or not np.isfinite(values[-1]).all():
            raise StiffError
        sizes = largest_within(values)
        made_of, moved = _terms(A, f, mesh, values, sizes)
        made_of = sizes if stiff else made_of
        found = _Found(A, Trajectory(mesh, values), sizes, change, made_of, moved, extras)
        tail = unresolved_signals(problem, mesh.rule, values, extras, made_of.max(axis=0), tol)
        return found, np.maximum(tail, np.isinf(change))  # zeros where no series converges

    try:
        mesh, found, tail = refine(
            evaluate, mesh, tol=tol, max_elements=max_elements, name=problem.name,
            patience=1 + stiff,
        )
    except StiffError:
        return None
    errors = _errors(march, problem, mesh, found, stiff=stiff)
    lost = errors.lost
    return LinearSolution(
        found.trajectory,
        max(float(tail.max(initial=0.0)), errors.estimate), errors.relative,
        None if lost == mesh.size else float(mesh.edges[lost + 1]), found.extras,
    )


def solve_dense(
    problem: LinearProblem, mesh: Mesh, *, tol: float, max_elements: int,
    known: LinearEquation | None = None,
) -> LinearSolution | None:
    """:func:`solve` for x' = A x + f with full arrays, of which most entries are zero.

    ``f`` may be of the first columns only. None also where too few entries are zero.
    """
    first = mesh

    @lru_cache(maxsize=1)
    def equation(mesh: Mesh) -> Equation:
        c = known if mesh is first else None
        c = c or problem.coefficients(mesh.points.ravel(), mesh.inside.ravel())
        A = by_entries(c.A)
        if len(A.columns) > DENSE * c.A[0].size:
            raise StiffError
        return A, c.f, tuple(at_points(e, mesh.size, mesh.rule.stages) for e in c.extras)

    try:
        return solve(
            problem, equation, mesh, units=np.ones(len(problem.start)), tol=tol,
            max_elements=max_elements,
        )
    except StiffError:
        return None


class _Found(NamedTuple):
    """What was found on a mesh."""

    A: Sparse
    trajectory: Trajectory  # (d, c)
    sizes: Array  # (K, d, c) the largest in each element
    change: Array  # (K,) the last in each element, relative
    made_of: Array  # (K, d, c) sizes of what right ends are the sum of
    moved: Array  # (K, d, c) what rounding of the equation's terms moves
    extras: tuple[Array, ...]


def _part(mesh: Mesh, A: Sparse, first: int, last: int | None = None) -> tuple[Mesh, Sparse]:
    """Some elements of a mesh, and A there."""
    if len(A.entries) > 1:
        points = mesh.rule.stages + 1
        A = A._replace(entries=A.entries[points * first : last and points * last])
    return replace(mesh, edges=mesh.edges[first : last and last + 1]), A


def by_factors(A: Sparse) -> March:
    """A march for one constant A, by solving (D/h ⊗ I − I ⊗ A) X = D𝟙/h x_0 + f."""
    from scipy.linalg import lu_factor, lu_solve

    full, factors = A.full()[0], dict[str, Any]()

    def solved(shift: complex, right: ComplexArray) -> ComplexArray:
        """(shift I − A) y = r, with one factorisation for what is equal but for rounding."""
        known = f"{shift:.13e}"
        if known not in factors:
            factors[known] = lu_factor(shift * np.eye(len(full)) - full, overwrite_a=True)
        return np.asarray(lu_solve(factors[known], right, check_finite=False), np.complex128)

    def march(
        mesh: Mesh, _: Sparse, f: Array, kicks: Array | None, start: Array, _tol: float
    ) -> tuple[Array, Array]:
        s, (d, columns) = mesh.rule.stages, start.shape
        from_left = mesh.rule.differentiation.sum(axis=1)[:, None, None]
        values, state = np.empty((mesh.size, s + 1, d, columns)), start
        for k, step in enumerate(equal_lengths(mesh.steps, mesh)[1].tolist()):
            right = np.broadcast_to(from_left / step * state, (s, d, columns)).copy()
            points = slice(k * (s + 1) + 1, (k + 1) * (s + 1))
            right[:, :, : f.shape[2]] += f if len(f) == 1 else f[points]
            values[k, 0], values[k, 1:] = state, decoupled(s, step, right, solved)
            state = values[k, -1] if kicks is None else values[k, -1] + kicks[k]
        return values, np.zeros(mesh.size)

    return march


def _terms(
    A: Sparse, f: Array, mesh: Mesh, values: Array, sizes: Array
) -> tuple[Array, Array]:
    """What right ends are made of, and what rounding of the equation's terms moves, (K, d, c)."""
    K, points = values.shape[:2]
    h, late = mesh.steps[:, None, None], np.abs(mesh.edges[1:, None, None])
    within = A.product(A.sizes(K), sizes)
    moved = np.zeros_like(within)
    if len(A.entries) > 1:
        moved += A.product(np.ptp(A.entries.reshape(K, points, -1), axis=1), sizes)
    forced = slice(0, f.shape[2])
    f = at_points(f, K, points - 1)
    within[:, :, forced] += np.abs(f).max(axis=1)
    moved[:, :, forced] += np.ptp(f, axis=1)
    return np.abs(values[:, 0]) + h * within, h * within + late * moved


def _errors(
    march: March, problem: LinearProblem, mesh: Mesh, found: _Found, *, stiff: bool
) -> Errors:
    """Errors of the solution, see :mod:`gpebo_cli.numerics.errors`.

    Of many columns the largest error at each place is carried on, for all of them. Where it is
    ``stiff``, rounding of the terms grows from the left end on: a fast mode forgets most of it.
    """
    A, values, rule = found.A, found.trajectory.values, mesh.rule
    K, points, n, columns = values.shape
    sizes = found.sizes
    last = np.abs(rule.to_legendre[-4:] @ values.reshape(K, points, n * columns))
    size = np.maximum(sizes, TINY)
    tail = predicted_tail(last, rule, size.reshape(K, -1)).reshape(sizes.shape)
    # As in numerics.errors; and what series leave out.
    units = np.ones((n, 1)) if problem.units is None else problem.units
    beside = np.maximum(sizes, SHARE * units * (sizes / units).max(axis=1, keepdims=True))
    change, h = found.change[:, None, None], mesh.steps[:, None, None]
    moved = (EPS + change * stiff) * found.moved
    added = tail * (tail / size) ** (0.5 - 0.5 / rule.stages) + EPS * END * found.made_of
    added += change * sizes if stiff else change * beside + moved
    added += np.where(sizes.max(axis=0) > 0.0, TINY, 0.0)  # what decays to nothing is lost
    start = EPS * np.abs(values[0, 0])
    noise = np.zeros((n, columns))
    if points > 4:
        before, after = last[:, :2].max(axis=1), last[:, 2:].max(axis=1)
        noise = np.where(after >= LEVEL * before, after, 0.0).max(axis=0).reshape(n, columns)
    if columns > _FEW_COLUMNS:
        added, start, moved = (x.max(axis=-1, keepdims=True) for x in (added, start, moved))
    signs = random_signs(K, n)[..., None]
    kicks = (signs[1:] * added[:, :, None]).reshape(K, n, -1)
    start = (signs[0] * start[:, None]).reshape(n, -1)
    ends, left = np.empty_like(kicks), np.empty(K)
    count = _AT_ONCE if stiff else K
    for first in range(0, K, count):
        part, forcing = slice(first, first + count), np.zeros((1, n, 0))
        if stiff:
            slopes = 2.0 * signs[1:][part] * (moved[part] / h[part])[:, :, None]
            forcing = rule.points[:, None, None] * slopes.reshape(-1, 1, *start.shape)
            forcing = forcing.reshape(-1, *start.shape)
        found_there, left[part] = march(
            *_part(mesh, A, first, first + count), forcing, kicks[part], start, _ROUGH
        )
        ends[part] = found_there[:, -1]
        start = (ends[part] + kicks[part])[-1]
    kicks[~np.isfinite(left)] = np.inf
    squares = ((ends + kicks) ** 2).reshape(K, n, -1, added.shape[2])
    systematic = np.arange(2, K + 2)[:, None, None]
    carried = np.sqrt(systematic * squares.mean(axis=2)) + np.zeros(columns)
    return judged_errors(
        problem, carried, carried.max(axis=0), tail.max(axis=0), sizes.max(axis=0), noise,
        found.made_of.max(axis=0),
    )
