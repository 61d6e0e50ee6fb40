"""The mesh that the known functions in E x' = A x + f ask for, before anything is solved."""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate, pairwise
from typing import TypeVar

import numpy as np

from gpebo_cli.model.descriptor import (
    MATRIX_NAMES,
    Array,
    BoolArray,
    Coefficients,
    DescriptorSystem,
    IntArray,
)
from gpebo_cli.numerics.mesh import FIRST_ELEMENTS, SHARE, Mesh, initial_mesh, unresolved
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.refinement import wanted_parts
from gpebo_cli.settings import SolverSettings, TimeSettings

_LOOKS = 40  # times within each first element at which known functions are looked at once more
_MOST_LOOKS = 1 << 16
_SURPRISE = 100.0  # times what the nodes let expect: then something stands between them
_LOOK_ROUNDS = 8
_NOTHING = 1e-12  # of what an input stands beside: less is rounding
_NEAR_ZERO = 1e-2  # reciprocals of what comes nearer to zero, relatively, resolve nothing
_MARGIN = 1e-3  # of the tolerance, to which known functions are resolved when joined: what is made
# of them takes more degrees
Known = TypeVar("Known")
SHORT = 4.0  # rate times length of joined elements; exp(t) is resolved to 1e-9 there


def first_mesh(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> tuple[Mesh, Array, bool]:
    """A mesh without anything narrow between its nodes, jumps (B,), and whether that is sure."""
    start, stop = time.start, time.start + time.horizon
    cuts = system.coefficients.breakpoints(start, stop)
    mesh = initial_mesh(start, stop, cuts, FIRST_ELEMENTS, radau_rule(solver.stages))
    edges, bounded = system.coefficients.resolved(mesh.edges)
    return Mesh(edges, mesh.rule), cuts, bounded


def known_resolved(
    system: DescriptorSystem, evaluated: Callable[[Mesh], Coefficients],
    looked_at: Callable[[Array], Coefficients], mesh: Mesh, c: Coefficients, beside: Array,
    solver: SolverSettings, cuts: Array, longest: float, *, bounded: bool,
) -> tuple[Mesh, Coefficients | None]:
    """The mesh on which nothing is overlooked and inputs are resolved, and the model there.

    It begins with a mesh and the model ``c`` there; ``evaluated`` gives it on others, ``looked_at``
    its values at any times. Inputs compare with sizes ``beside`` them (m,). ``bounded``: nothing
    narrow hides between the nodes. Where no element has to be cut, they are joined as far as known
    functions are resolved all the same, up to the ``longest`` (s); the cuts (B,) stay.
    """
    given = mesh
    for _ in range(0 if bounded else _LOOK_ROUNDS):
        overlooked = _overlooked(system, c, looked_at, mesh, solver.tol, beside)
        if not overlooked.any():
            break
        mesh, _ = mesh.split(np.where(overlooked, 8, 1).astype(np.intp))
        c = evaluated(mesh)
    if system.m and "u" not in system.coefficients.constant:
        def tail(mesh: Mesh, c: Coefficients) -> Array:
            u = c.u[0].reshape(*mesh.points.shape, -1)
            return unresolved(u, mesh.rule, SHARE * beside)

        mesh, c = cut_where(tail, evaluated, mesh, c, solver.tol, solver.max_elements)
    if mesh is not given or 2.0 * float(mesh.steps.min()) > longest:
        return mesh, c
    joined = _joined(system, mesh, c, cuts, _MARGIN * solver.tol, longest)
    return (mesh, c) if joined.size == mesh.size else (joined, None)


def cut_where(
    tail_of: Callable[[Mesh, Known], Array], evaluated: Callable[[Mesh], Known], mesh: Mesh,
    known: Known, tol: float, max_elements: int,
) -> tuple[Mesh, Known]:
    """Elements cut until what is known there, and need not be solved for, has small tails.

    ``tail_of`` says how large they are (K,); cuts end where only rounding is left, or there would
    be too many elements. The result is the mesh, and what is known on it.
    """
    before: Array | float = np.inf
    while True:
        tail = tail_of(mesh, known)
        poor = (tail > tol) & ((tail < 0.25 * before) | (tail > 1e-6))
        parts = wanted_parts(tail, poor, tol, mesh.rule.stages)
        too_short = mesh.steps[poor] < 1e-6 * (mesh.edges[-1] - mesh.edges[0]) / mesh.size
        if not poor.any() or too_short.any() or parts.sum() > max_elements:
            return mesh, known
        before = np.repeat(tail, parts)
        mesh, _ = mesh.split(parts)
        known = evaluated(mesh)


def least_beside(terms: Array, inputs: IntArray, m: int) -> Array:
    """The sizes that m inputs have to compare with, (m,).

    An input whose share of every equation is rounding of the others' is rounding itself: what
    stands beside it in one, divided by its factor there, are ``terms`` (e,) of ``inputs`` (e,).
    """
    least = np.full(m, np.inf)
    np.minimum.at(least, inputs, terms)
    return np.where(np.isfinite(least), least, 0.0)


def _joined(
    system: DescriptorSystem, mesh: Mesh, c: Coefficients, cuts: Array, tol: float, longest: float
) -> Mesh:
    """Elements joined where known functions are resolved all the same.

    The mesh is kept with the matrices of a text, as :func:`gpebo_cli.reduction.structure.analyse`
    keeps what it finds.
    """
    kept: dict[object, Mesh] = getattr(system.coefficients, "kept", {})
    asked = mesh.edges.tobytes(), mesh.rule, len(c.E), cuts.tobytes(), tol, longest
    if asked not in kept:
        values, counts = _known_kinds(system, c, mesh)
        kept[asked] = mesh.joined(values, counts, tol, cuts, longest)
    return kept[asked]


def _overlooked(
    system: DescriptorSystem, c: Coefficients, looked_at: Callable[[Array], Coefficients],
    mesh: Mesh, tol: float, beside: Array,
) -> BoolArray:
    """Elements (K,) with something narrow between their nodes, a pulse of an input for instance.

    That leaves no trace in Legendre coefficients. So known functions are looked at in between, and
    an element is suspected where they are far from what the coefficients let one expect.
    """
    looks = min(_LOOKS, _MOST_LOOKS // mesh.size)
    names = [name for name in MATRIX_NAMES if name not in system.coefficients.constant]
    found = np.zeros(mesh.size, dtype=bool)
    if looks == 0 or not names:
        return found
    places = (np.arange(looks) + 0.5) / looks
    t = mesh.edges[:-1, None] + mesh.steps[:, None] * places
    seen = looked_at(t.ravel())
    least = max(tol, 1e-12)
    # An input that is rounding of what stands beside it in its equations is not looked at.
    u = np.concatenate([c.u[0], seen.u[0]])
    audible = np.abs(u).max(axis=0, initial=0.0) > _NOTHING * beside
    for name in names:
        nodes, actual = (
            (getattr(of, name)[0] * (audible if name == "u" else 1.0)).reshape(mesh.size, count, -1)
            for of, count in ((c, mesh.rule.stages + 1), (seen, looks))
        )
        size = np.maximum(np.abs(actual).max(axis=(0, 1)), np.abs(nodes).max(axis=(0, 1)))
        moves = np.ptp(nodes, axis=(0, 1)) > 0.0
        there = (actual != nodes[:1, :1]).any(axis=(0, 1)) | moves
        missed = np.abs(mesh.rule.interpolation(places) @ nodes - actual).max(axis=1)
        far = (missed[:, there] / size[there]).max(axis=1, initial=0.0)
        if far.max(initial=0.0) > _SURPRISE * least:
            tail = unresolved(nodes[..., moves], mesh.rule)
            found |= far > _SURPRISE * np.maximum(tail, least)
    return found


def _known_kinds(
    system: DescriptorSystem, c: Coefficients, mesh: Mesh
) -> tuple[Array, IntArray]:
    """Every function of the model with its derivatives, (K, s + 1, c), and how many of each kind.

    Reciprocals of what E holds are among them: the state sees those, and they may be harder to
    resolve by far.
    """
    moving = [name for name in MATRIX_NAMES if name not in system.coefficients.constant]
    orders, times = c.E.shape[:2]
    parts = [getattr(c, name).reshape(orders, times, -1).swapaxes(1, 2) for name in moving]
    if not any(part.shape[1] for part in parts):
        return np.zeros((*mesh.points.shape, 0)), np.zeros(0, dtype=np.intp)
    whole = np.concatenate(parts, axis=1)  # all times of a function in a row: that is fast
    high, low = whole[0].max(axis=1), whole[0].min(axis=1)
    moves = high > low
    kinds = list(whole[:, moves])
    ends = accumulate([part.shape[1] for part in parts], initial=0)
    counts = [int(np.count_nonzero(moves[a:b])) for a, b in pairwise(ends)] * orders
    if moving[0] == "E":
        first = slice(parts[0].shape[1])
        size = np.abs([high[first], low[first]])
        away = (size.min(axis=0) > _NEAR_ZERO * size.max(axis=0)) & (high[first] * low[first] > 0.0)
        kinds.append(1.0 / whole[0, first][moves[first] & away])
        counts.append(len(kinds[-1]))
    values = np.concatenate(kinds).reshape(-1, *mesh.points.shape).transpose(1, 2, 0)
    return values, np.array([k for k in counts if k], dtype=np.intp)
