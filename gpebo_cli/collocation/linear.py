"""Linear time-varying ODEs and strangeness-free DAEs by collocation, all elements at once.

    E(t) X' = A(t) X + f(t),      X(start) = X_0

Everything this program integrates has this form. Because it is linear, an element does not need
to know where it starts: one batched solve gives, for every element, the map from its left end to
its nodes, and the elements are chained with small products afterwards. Refinement therefore
solves only the elements that are new.

Stage equations at node i of an element of length h, with D = R⁻¹ the Radau differentiation:

    E_i (D X − (D𝟙) x_0)_i / h = A_i X_i + f_i
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from gpebo_cli.collocation.mesh import (
    Mesh,
    Trajectory,
    legendre_tail,
    signal_scale,
    unresolved,
)
from gpebo_cli.collocation.radau import RadauRule
from gpebo_cli.errors import SolverError
from gpebo_cli.systems.descriptor import Array, BoolArray, IntArray


class Coefficients(NamedTuple):
    """The equation at N times; a leading axis of 1 means constant in time."""

    E: Array | None  # (N, n, n), None for the identity
    A: Array  # (N, n, n)
    f: Array  # (N, n, columns)
    extras: tuple[Array, ...] = ()  # (N, ...) each: whatever the monitor needs at these times


# (point values (K, s + 1, n, columns), extras (K, s + 1, ...)) -> signals by kind
Monitor = Callable[[Array, tuple[Array, ...]], list[tuple[Array, float]]]

_CHUNK = 1 << 23  # numbers in one batch of element systems (64 MB)
_MAX_PARTS = 8  # an element is cut into at most this many at once
_LEVEL = 0.3  # coefficients that fall by less than this over two degrees are noise
_ROUNDING = 64 * np.finfo(float).eps


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

    coefficients: Callable[[Array, Array], Coefficients]
    start: Array  # (n, columns)
    monitor: Monitor | None = None
    name: str = "equation"
    floor: float = 0.0  # size below which the solution itself is rounding
    renewal: Renewal | None = None


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Point values of X on the mesh that resolves it, and an estimate of the error."""

    trajectory: Trajectory  # values (K, s + 1, n, columns)
    error_estimate: float  # relative to each signal's own size
    rounds: int
    extras: tuple[Array, ...] = ()  # of the coefficients, (K, s + 1, ...) each


@dataclass(frozen=True, eq=False)
class _ElementMaps:
    """X at the nodes of each element = ``homogeneous`` X(left end) + ``particular``."""

    homogeneous: Array  # (K, s, n, n)
    particular: Array  # (K, s, n, columns)
    extras: tuple[Array, ...]  # (K, s + 1, ...) each


def solve(
    problem: LinearProblem,
    mesh: Mesh,
    *,
    tol: float,
    max_elements: int,
    restarts: Mapping[float, Callable[[Array], Array]] | None = None,
) -> LinearSolution:
    """Solve on ``mesh``, refined until every signal is resolved to ``tol``.

    Args:
        problem: the equation.
        mesh: where to start; its edges stay edges.
        tol: target for the tail of each element's Legendre coefficients, relative to each
            signal's own size.
        max_elements: refuse to go beyond.
        restarts: at these edges, the map from the limit from the left to the new start.

    Raises:
        SolverError: if ``max_elements`` do not reach ``tol``; names the time.
    """
    maps = _element_maps(problem, mesh, np.ones(mesh.size, dtype=bool))
    floor = np.zeros(mesh.size)  # the tail of the parent, to notice that cutting no longer helps
    rounds = 1
    while True:
        values, propagated = _chain(maps, problem, mesh, restarts or {})
        if not np.isfinite(values).all():
            k = int(np.argmin(np.isfinite(values).all(axis=(1, 2, 3))))
            raise SolverError(
                f"the solution of the {problem.name} is not finite from t = {mesh.edges[k]:.6g} on"
            )
        tail = unresolved_signals(problem, mesh, values, maps.extras)
        # Rounding floor: an element whose parent was already this good is not cut again.
        stalled = (floor > 0) & (tail > 0.25 * floor) & (tail < 1e-6)
        poor = (tail > tol) & ~stalled
        if not poor.any():
            break
        parts = np.ones(mesh.size, dtype=np.intp)
        wanted = 1.25 * (tail[poor] / tol) ** (1.0 / mesh.rule.stages)
        parts[poor] = np.clip(np.ceil(wanted), 2, _MAX_PARTS).astype(np.intp)
        _check_budget(problem, mesh, tail, parts, max_elements)
        finer, kept = mesh.split(parts)
        fresh = kept < 0
        new = _element_maps(problem, finer, fresh)
        floor = np.where(fresh, np.repeat(tail, parts), np.repeat(floor, parts))
        maps = _merge(maps, new, kept, fresh)
        mesh, rounds = finer, rounds + 1
    noise = _visible_noise(values, mesh)
    estimate = max(float(tail.max(initial=0.0)), noise, propagated, _ROUNDING)
    return LinearSolution(Trajectory(mesh, values), estimate, rounds, maps.extras)


def unresolved_signals(
    problem: LinearProblem, mesh: Mesh, values: Array, extras: tuple[Array, ...]
) -> Array:
    """:func:`unresolved` over the solution and everything computed from it, shape (K,)."""
    tail = unresolved(values.reshape(*values.shape[:2], -1), mesh.rule, problem.floor)
    if problem.monitor is not None:
        for signals, floor in problem.monitor(values, extras):
            tail = np.maximum(tail, unresolved(signals, mesh.rule, floor))
    return tail


def _visible_noise(values: Array, mesh: Mesh) -> float:
    """Rounding as the last coefficients show it: those of a signal fall, those of noise do not."""
    if mesh.rule.stages < 4:
        return 0.0
    flat = values.reshape(*values.shape[:2], -1)
    last = np.abs(np.matmul(mesh.rule.to_legendre[-4:], flat))  # degrees s − 3 … s
    before, after = last[:, :2].max(axis=1), last[:, 2:].max(axis=1)
    noise = np.where(after >= _LEVEL * before, after, 0.0).max(axis=0)
    return float((noise / signal_scale(flat)).max(initial=0.0))


def _check_budget(
    problem: LinearProblem, mesh: Mesh, tail: Array, parts: IntArray, max_elements: int
) -> None:
    worst = int(np.argmax(tail))
    t = mesh.edges[worst]
    # Next to t = 0 floating point resolves any transient; elsewhere 64 units in the last place.
    resolution = 64 * np.finfo(float).eps * np.abs(mesh.edges[1:])
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
        out[~fresh], out[fresh] = before[kept[~fresh]], after
        return out

    return _ElementMaps(
        merged(old.homogeneous, new.homogeneous),
        merged(old.particular, new.particular),
        tuple(merged(a, b) for a, b in zip(old.extras, new.extras, strict=True)),
    )


def _element_maps(problem: LinearProblem, mesh: Mesh, elements: BoolArray) -> _ElementMaps:
    """Solve the block systems of size s·n of some elements, in chunks of bounded memory."""
    n, columns = problem.start.shape
    s = mesh.rule.stages
    h, t, inside = mesh.steps[elements], mesh.points[elements], mesh.inside[elements]
    chunk = max(1, _CHUNK // (s * s * n * n + s * n * (n + columns)))
    pieces = [
        _solve_elements(problem, mesh.rule, h[i : i + chunk], t[i : i + chunk],
                        inside[i : i + chunk])
        for i in range(0, len(h), chunk)
    ]
    if len(pieces) == 1:
        return pieces[0]
    return _ElementMaps(
        np.concatenate([p.homogeneous for p in pieces]),
        np.concatenate([p.particular for p in pieces]),
        tuple(np.concatenate(parts) for parts in zip(*(p.extras for p in pieces), strict=True)),
    )


def _at_nodes(values: Array, k: int, s: int) -> Array:
    """(k (s + 1), ...) or (1, ...) at points -> (k, s, ...) at nodes."""
    if len(values) == 1:
        return np.broadcast_to(values, (k, s, *values.shape[1:]))
    return values.reshape(k, s + 1, *values.shape[1:])[:, 1:]


def _solve_elements(
    problem: LinearProblem, rule: RadauRule, h: Array, t: Array, inside: Array
) -> _ElementMaps:
    k, s = len(h), rule.stages
    n, columns = problem.start.shape
    c = problem.coefficients(t.ravel(), inside.ravel())
    extras = tuple(extra.reshape(k, s + 1, *extra.shape[1:]) for extra in c.extras)
    constant = len(c.A) == 1 and (c.E is None or len(c.E) == 1)
    if constant and k > 1:
        solved = _solve_equal_elements(problem, rule, h, t, c)
        return _ElementMaps(solved[..., :n], solved[..., n:], extras)
    D_over_h = rule.differentiation / h[:, None, None]  # (k, s, s)
    system = np.zeros((k, s, n, s, n))
    right = np.empty((k, s, n, n + columns))
    start = D_over_h.sum(axis=2)  # (D𝟙)_i / h
    if c.E is None:
        diagonal = np.arange(n)
        system[:, :, diagonal, :, diagonal] = D_over_h
        right[..., :n] = start[..., None, None] * np.eye(n)
    else:
        E = _at_nodes(c.E, k, s)
        np.multiply(D_over_h[:, :, None, :, None], E[:, :, :, None, :], out=system)
        right[..., :n] = start[..., None, None] * E
    stage = np.arange(s)
    system[:, stage, :, stage, :] -= np.swapaxes(_at_nodes(c.A, k, s), 0, 1)
    right[..., n:] = _at_nodes(c.f, k, s)
    try:
        stacked = np.linalg.solve(
            system.reshape(k, s * n, s * n), right.reshape(k, s * n, n + columns)
        )
    except np.linalg.LinAlgError as error:
        raise SolverError(
            f"the {problem.name} has a singular collocation system between t = {t[0, 0]:.6g} "
            f"and {t[-1, -1]:.6g}"
        ) from error
    solved = np.asarray(stacked, dtype=np.float64).reshape(k, s, n, n + columns)
    return _ElementMaps(solved[..., :n], solved[..., n:], extras)


def _solve_equal_elements(
    problem: LinearProblem, rule: RadauRule, h: Array, t: Array, c: Coefficients
) -> Array:
    """With constant E and A, elements of one length share one factorisation.

    Lengths that differ by rounding only (equal parts of an element) count as equal. Returns what
    ``_solve_elements`` solves for, (k, s, n, n + columns).
    """
    k, s = len(h), rule.stages
    n, columns = problem.start.shape
    E = np.eye(n) if c.E is None else c.E[0]
    f = _at_nodes(c.f, k, s)
    start = rule.differentiation.sum(axis=1)
    out = np.empty((k, s, n, n + columns))
    for length in np.unique(np.round(h, 12 - int(np.floor(np.log10(h.max()))))):
        same = np.flatnonzero(np.abs(h - length) <= 1e-11 * h.max())
        system = np.kron(rule.differentiation / h[same[0]], E) - np.kron(np.eye(s), c.A[0])
        right = np.empty((s, n, n + len(same) * columns))
        right[:, :, :n] = (start / h[same[0]])[:, None, None] * E
        right[:, :, n:] = np.moveaxis(f[same], 0, 2).reshape(s, n, -1)
        try:
            solved = np.linalg.solve(system, right.reshape(s * n, -1)).reshape(s, n, -1)
        except np.linalg.LinAlgError as error:
            raise SolverError(
                f"the {problem.name} has a singular collocation system near t = {t[0, 0]:.6g}"
            ) from error
        out[same, :, :, :n] = solved[:, :, :n]
        particular = solved[:, :, n:].reshape(s, n, len(same), columns)
        out[same, :, :, n:] = np.moveaxis(particular, 2, 0)
    return out


def _chain(
    maps: _ElementMaps,
    problem: LinearProblem,
    mesh: Mesh,
    restarts: Mapping[float, Callable[[Array], Array]],
) -> tuple[Array, float]:
    """Point values (K, s + 1, n, columns), and the error that local errors add up to.

    The error of an element's right end is carried through the same maps as the solution, so that
    it decays where the system forgets and grows where it does not.
    """
    size, s, n = maps.homogeneous.shape[:3]
    columns = problem.start.shape[1]
    renewal = problem.renewal
    last_h, last_p = maps.homogeneous[:, -1], maps.particular[:, -1]
    jump = [restarts.get(float(edge)) for edge in mesh.edges[:-1]] if restarts else [None] * size
    left = np.empty((size, n, columns))
    state = problem.start
    values = np.empty((size, s + 1, n, columns))
    with np.errstate(over="ignore", invalid="ignore"):  # the caller reports what is not finite
        for k in range(size):
            restart = jump[k]
            if restart is not None and k > 0:
                state = restart(state)
            if renewal is not None and k > 0 and np.isfinite(state).all():
                state = renewal.state(state)
            left[k] = state
            state = last_h[k] @ state + last_p[k]
        values[:, 0] = left
        values[:, 1:] = maps.homogeneous @ left[:, None] + maps.particular
    if not np.isfinite(values).all():
        return values, np.inf
    return values, _propagated_error(last_h, values, mesh, renewal)


def _propagated_error(
    last_h: Array, values: Array, mesh: Mesh, renewal: Renewal | None
) -> float:
    """Largest accumulated end-point error, relative to each component's size.

    The local error of an end point is superconvergent (order 2s − 1 against s + 1 inside): with
    ρ the decay per Legendre coefficient it is about ρ^(s−1) times the element's tail. Half that
    exponent is used, to stay on the safe side of it, plus the rounding of one element.
    """
    rule = mesh.rule
    flat = values.reshape(*values.shape[:2], -1)
    scale = signal_scale(flat)
    size = np.abs(flat).max(axis=1)  # (K, c)
    tail = legendre_tail(flat, rule, scale)
    decay = np.clip(tail / np.maximum(size, np.finfo(float).tiny), 0.0, 1.0) ** (1 / rule.stages)
    rounding = 4 * np.finfo(float).eps * np.maximum(size, scale * np.finfo(float).eps)
    local = (tail * decay ** (0.5 * (rule.stages - 1)) + rounding).reshape(-1, *values.shape[2:])
    # Local errors have signs that nobody knows: all equal, and alternating, so that neither kind
    # of system can cancel both. Absolute values of the maps were rejected: a rotation would grow.
    error = np.zeros((2, *values.shape[2:]))
    worst = np.zeros(values.shape[2:])
    signs = np.array([1.0, 1.0])[:, None, None]
    for k in range(len(last_h)):
        error = last_h[k] @ error + signs * local[k]
        signs[1] *= -1.0
        worst = np.maximum(worst, np.abs(error).max(axis=0))
        if renewal is not None:
            error = renewal.error(values[k, -1], error)
    return float((worst.ravel() / scale).max(initial=0.0))
