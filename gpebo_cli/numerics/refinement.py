"""Refinement: elements are cut until everything that is computed on a mesh is resolved."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics.errors import EPS
from gpebo_cli.numerics.mesh import Kind, Mesh, unresolved_kinds
from gpebo_cli.numerics.problem import LinearProblem
from gpebo_cli.schema import instant

_MAX_PARTS = 8  # an element is cut into at most this many at once
_ROUNDING = 1e-6  # a tail below may be rounding, which cutting does not make smaller
# These four decide about rounding. They are chosen on equations of index 2 to 4 that leave few
# digits, with some room to solutions that are resolved at last; no bound gives them.
_SOME = 20  # elements that cuts did not make better: whether that is rounding is looked at,
_OTHER = 0.05  # which changes their tails by so much at times a rounding away.
_LOST = 1e-3  # of a signal: rounding beyond that leaves too little of it
_MANY = 200  # elements: rounding in fewer may be due to their length

Found = TypeVar("Found")
# (mesh, what was found on the mesh before, the old element of each new one or −1)
# -> (what is found, the tail of each element (K,))
Evaluate = Callable[[Mesh, "Found | None", IntArray], tuple[Found, Array]]


class RoundingError(SolverError):
    """The solver cannot reach the tolerance, for what it ``found`` is rounding in a part."""

    def __init__(self, message: str, found: Any = None) -> None:
        super().__init__(message)
        self.found = found


def refine(
    evaluate: Evaluate[Found], mesh: Mesh, *, tol: float, max_elements: int, name: str,
    patience: int = 1, fixed: Iterable[float] = (), advice: str = LinearProblem.advice,
) -> tuple[Mesh, Found, Array]:
    """Cut the elements of ``mesh`` until the tail of each one is at most ``tol``.

    ``evaluate`` finds what is wanted on a mesh, and what each element leaves out of it, relative to
    its size; it may keep what was found on the elements that have not been cut. Edges of the mesh
    stay edges, and those at which something happens are ``fixed`` times to the last digit. After as
    many cuts without effect as the ``patience`` what is left counts as rounding: what swings within
    a long element may not become smaller by the first. The result is the mesh, what was found on
    it, and the tails (K,) (SolverError: if ``max_elements`` do not reach ``tol``, or rounding
    leaves fewer than three digits; names the time).
    """
    found: Found | None = None
    kept = np.full(mesh.size, -1)
    # The tail of the element that each one was cut from, over the number of its parts.
    floor: Array | float = np.inf
    missed: Array | float = 0.0  # how many cuts had no effect
    while True:
        held, found = [found], None  # ``evaluate`` may let go of it
        found, tail = evaluate(mesh, held.pop(), kept)
        poor = tail > tol
        if not poor.any():
            return mesh, found, tail
        poor &= tail > mesh.blur
        # An element that was cut and is no better than the one it comes from, but for what is in
        # proportion to its length, shows rounding.
        missed = np.where(tail <= 0.5 * floor, 0.0, missed + 1.0)
        poor &= (missed < patience) | (tail >= _ROUNDING)
        if not poor.any():
            return mesh, found, tail
        stuck = poor & (missed > 1)
        if stuck.sum() > max(_SOME, 0.02 * mesh.size):
            away = np.where(np.isin(mesh.edges, list(fixed)), 0.0, 64 * EPS)
            moved = replace(mesh, edges=mesh.edges + away * np.abs(mesh.edges).max())
            # Elements that are fine are not judged by it, and not solved again.
            there, other = evaluate(moved, found, np.where(poor, -1, np.arange(mesh.size)))
            change = np.abs(other / np.maximum(tail, EPS) - 1.0)
            if np.mean(np.minimum(change[stuck], 1.0)) > _OTHER:
                noisy = poor & (change > _OTHER)
                rest = poor & ~noisy  # what is merely fast: a transient beside them
                few = rest.sum() <= _SOME
                left = float(other[noisy if few else stuck].max())
                many = (missed > 1).sum() > _MANY
                if left <= _LOST and many:
                    if not (few and rest.any()):
                        return mesh, there, other
                    poor = rest
                elif many or left * stuck.sum() > _SOME:
                    t = mesh.points[int(np.argmax(np.where(noisy, other, 0.0))), 0]
                    raise RoundingError(
                        f"the {name} cannot be resolved near t = {instant(t, 6)}: rounding in its "
                        f"equations is {left:.1e} of it, whatever the elements; accepted is a "
                        "solver.tol above that, or equations that lose fewer digits", there,
                    )
        parts = wanted_parts(tail, poor, tol, mesh.rule.stages)
        _check_budget(mesh, tail, parts, max_elements, name, advice)
        before, cut = (np.broadcast_to(x, len(tail)).repeat(parts) for x in (floor, tail / parts))
        missed = missed.repeat(parts)
        mesh, kept = mesh.split(parts)
        floor = np.where(kept < 0, cut, before)


def resolve(
    evaluate: Callable[[Mesh], tuple[Found, Sequence[Kind]]],
    mesh: Mesh, *, tol: float, max_elements: int, name: str,
) -> tuple[Mesh, Found, float]:
    """Resolve signals that are known: nothing is integrated.

    ``evaluate`` gives what is wanted on a mesh, and the signals (K, s + 1, c) to resolve, each kind
    with its floor (see :func:`unresolved_kinds`), perhaps with elements in front; the rest is as of
    :func:`refine`. The result is the mesh, what is wanted on it, and the largest tail.
    """

    def on(mesh: Mesh, before: Found | None, kept: IntArray) -> tuple[Found, Array]:  # noqa: ARG001
        found, kinds = evaluate(mesh)
        return found, unresolved_kinds(kinds, mesh.rule)[-mesh.size :]

    mesh, found, tail = refine(on, mesh, tol=tol, max_elements=max_elements, name=name)
    return mesh, found, float(tail.max(initial=0.0))


def wanted_parts(tail: Array, poor: BoolArray, tol: float, stages: int) -> IntArray:
    """Into how many parts (K,) to cut each element so that its tail (K,) falls to ``tol``."""
    parts = np.ones(len(tail), dtype=np.intp)
    wanted = 1.25 * (tail[poor] / tol) ** (1.0 / stages)
    parts[poor] = np.minimum(np.maximum(np.ceil(wanted), 2), _MAX_PARTS).astype(np.intp)
    return parts


def _check_budget(
    mesh: Mesh, tail: Array, parts: IntArray, max_elements: int, name: str, advice: str
) -> None:
    # Next to t = 0 floating point resolves any transient; elsewhere 64 units in the last place.
    cut = (parts > 1).nonzero()[0]
    short = (mesh.steps[cut] < 64 * EPS * np.abs(mesh.edges[cut + 1])).any()
    worst = int(np.argmax(tail))
    t = mesh.points[worst, 0]
    if parts.sum() > max_elements:
        raise SolverError(
            f"the {name} is not resolved with {max_elements} elements; worst near "
            f"t = {instant(t, 6)} (tail {tail[worst]:.1e}); {advice}"
        )
    if short:
        far = abs(mesh.edges[0]) > mesh.edges[-1] - mesh.edges[0]
        why = (
            f"times there are told apart to {np.spacing(abs(t)):.1g} s only: let them begin at 0"
            if far else "is there a jump or a singularity?"
        )
        raise SolverError(
            f"the {name} cannot be resolved near t = {instant(t, 6)}: elements reached the "
            f"resolution of floating point (tail {tail[worst]:.1e}); {why}"
        )
