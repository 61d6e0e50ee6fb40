"""The mesh that the known functions in E x' = A x + f ask for, before anything is solved."""

from __future__ import annotations

from collections.abc import Callable
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
from gpebo_cli.numerics.mesh import (
    FIRST_ELEMENTS,
    SHARE,
    Kind,
    Mesh,
    initial_edges,
    legendre_tail,
    unresolved,
    unresolved_kinds,
)
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.refinement import wanted_parts
from gpebo_cli.settings import SolverSettings, TimeSettings

_FEWEST = 6  # elements
_USUAL = 1.5  # times the mean length: elements of a first mesh are up to so long, beside jumps
_LOOKS = 40  # times within each first element at which known functions are looked at once more
_MOST_LOOKS = 1 << 16
_SURPRISE = 100.0  # times what the nodes let expect: then something stands between them
_LOOK_ROUNDS = 8
_CUTS = 3  # without effect, after which what is left of a signal may be rounding
_NOTHING = 1e-12  # of what an input stands beside: less is rounding
_NEAR_ZERO = 1e-2  # reciprocals of what comes nearer to zero, relatively, resolve nothing
_MARGIN = 1e-3  # of the tolerance, to which known functions are resolved on few elements: what is
# made of them takes more degrees
Known = TypeVar("Known")
SHORT = 4.0  # rate times length of elements that are few; exp(t) is resolved to 1e-9 there


def first_mesh(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> tuple[Mesh, Array, bool]:
    """A mesh without anything narrow between its nodes, jumps (B,), and whether that is sure."""
    start, stop = time.start, time.start + time.horizon
    cuts = system.coefficients.breakpoints(start, stop)
    edges, bounded = system.coefficients.resolved(initial_edges(start, stop, cuts))
    return Mesh(edges, radau_rule(solver.stages)), cuts, bounded


def few_elements(system: DescriptorSystem, mesh: Mesh, cuts: Array, longest: float) -> Mesh:
    """Fewer elements than those of a first mesh, equal parts of which last up to ``longest`` (s).

    Nothing narrow hides in these, either, or it is the mesh itself; the cuts (B,) stay.
    """
    start, stop = mesh.edges[0], mesh.edges[-1]
    longest *= max(1.0, np.ceil((stop - start) / longest / FIRST_ELEMENTS))
    few = max(_FEWEST, int(np.ceil((stop - start) / longest)))
    edges, bounded = system.coefficients.resolved(initial_edges(start, stop, cuts, few))
    coarse = Mesh(edges, mesh.rule)
    return coarse if bounded and coarse.steps.max() <= longest else mesh


def known_resolved(
    system: DescriptorSystem, evaluated: Callable[[Mesh], Coefficients],
    looked_at: Callable[[Array], Coefficients], mesh: Mesh, c: Coefficients, beside: Array,
    solver: SolverSettings, *, bounded: bool,
) -> tuple[Mesh, Coefficients]:
    """The mesh on which nothing is overlooked and inputs are resolved, and the model there.

    It begins with a mesh and the model ``c`` there; ``evaluated`` gives it on others, ``looked_at``
    its values at any times. Inputs compare with sizes ``beside`` them (m,). ``bounded``: nothing
    narrow hides between the nodes. Elements longer than those of a first mesh are cut down to such
    until all known functions are resolved.
    """
    usual = _USUAL * float(mesh.edges[-1] - mesh.edges[0]) / FIRST_ELEMENTS
    cut = system.m > 0 and "u" not in system.coefficients.constant
    while float(mesh.steps.max()) > usual:
        kinds = _known_kinds(system, c, mesh, SHARE * beside)
        if not kinds:
            break
        tail = unresolved_kinds(kinds, mesh.rule)
        poor = (tail > _MARGIN * solver.tol) & (mesh.steps > usual)
        if not poor.any():
            cut &= not bounded or bool((tail > solver.tol).any())
            break
        parts = wanted_parts(tail, poor, _MARGIN * solver.tol, mesh.rule.stages)
        mesh, _ = mesh.split(np.minimum(parts, np.ceil(mesh.steps / usual).astype(np.intp)))
        c = evaluated(mesh)
    for _ in range(0 if bounded else _LOOK_ROUNDS):
        overlooked = _overlooked(system, c, looked_at, mesh, solver.tol, beside)
        if not overlooked.any():
            break
        mesh, _ = mesh.split(np.where(overlooked, 8, 1).astype(np.intp))
        c = evaluated(mesh)
    if cut:
        def of_inputs(mesh: Mesh, c: Coefficients) -> Array:
            u = c.u[0].reshape(*mesh.points.shape, -1)
            return unresolved(u, mesh.rule, SHARE * beside)

        mesh, c = cut_where(of_inputs, evaluated, mesh, c, solver.tol, solver.max_elements)
    return mesh, c


def cut_where(
    tail_of: Callable[[Mesh, Known], Array], evaluated: Callable[[Mesh], Known], mesh: Mesh,
    known: Known, tol: float, max_elements: int,
) -> tuple[Mesh, Known]:
    """Elements cut until what is known there, and need not be solved for, has small tails.

    ``tail_of`` says how large they are (K,); cuts end where only rounding is left, or there would
    be too many elements. The result is the mesh, and what is known on it.
    """
    before: Array | float = np.inf
    missed: Array | float = 0.0  # cuts in a row without effect
    while True:
        tail = tail_of(mesh, known)
        missed = np.where(tail < 0.25 * before, 0.0, missed + 1.0)
        poor = (tail > tol) & (tail > mesh.blur) & (missed < np.where(tail > 1e-6, _CUTS, 1))
        parts = wanted_parts(tail, poor, tol, mesh.rule.stages)
        too_short = mesh.steps[poor] < 1e-6 * (mesh.edges[-1] - mesh.edges[0]) / mesh.size
        if not poor.any() or too_short.any() or parts.sum() > max_elements:
            return mesh, known
        before, missed = tail.repeat(parts), missed.repeat(parts)
        mesh, _ = mesh.split(parts)
        known = evaluated(mesh)


def least_beside(terms: Array, B: Array, rows: IntArray, columns: IntArray, m: int) -> Array:
    """The sizes that m inputs have to compare with, (m,).

    An input whose share of every equation is rounding of the others' is rounding itself. Beside it
    stand ``terms`` (n,) of the equations; B has entries of sizes (e,) in rows and columns (e,).
    """
    least, there = np.full(m, np.inf), B > 0.0
    np.minimum.at(least, columns[there], terms[rows[there]] / B[there])
    return np.where(np.isfinite(least), least, 0.0)


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
    if not looks:
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
        missed = np.abs(mesh.rule.interpolation(places) @ nodes - actual).max(axis=1)
        far = (missed > _SURPRISE * least * size).any(axis=0)
        # Each beside its own tail: rounding of one says nothing of another.
        tail = legendre_tail(nodes[..., far], mesh.rule, size[far])
        least_of = np.maximum(tail, least * size[far])
        found |= (missed[:, far] > _SURPRISE * least_of).any(axis=1)
    return found


def _known_kinds(
    system: DescriptorSystem, c: Coefficients, mesh: Mesh, least: Array
) -> list[Kind]:
    """Every function of the model with its derivatives; inputs count as at ``least`` so large (m,).

    Reciprocals of what E holds are among them: the state sees those, and they may be harder to
    resolve by far.
    """
    moving = [name for name in MATRIX_NAMES if name not in system.coefficients.constant]
    inputs = [(c.u[0].reshape(*mesh.points.shape, -1), least)] if "u" in moving else []
    kinds = [values for name in moving for values in getattr(c, name)[name == "u" :]]
    if "E" in moving:
        E = c.E[0].reshape(mesh.points.size, -1)
        size = np.abs(E)
        kinds.append(1.0 / E[:, size.min(axis=0) > _NEAR_ZERO * size.max(axis=0)])
    return [*inputs, *(
        (values.reshape(*mesh.points.shape, -1), 0.0) for values in kinds if values.size
    )]
