"""What is integrated: linear equations in their unknowns, with columns that share the matrices."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Kind, Mesh


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
    # (K or 1, d, n + columns or 1) what [A f] are the difference of, at the end of each element
    terms: Array | None = None

    def of(self, elements: slice, points: int) -> LinearEquation:
        """This at those of the elements, of which each has so many points."""
        every = slice(points * elements.start, points * elements.stop)

        def some(values: Any, which: slice = every) -> Any:
            return values if values is None or len(values) == 1 else values[which]

        return LinearEquation(
            some(self.E), some(self.A), some(self.f), tuple(map(some, self.extras)),
            self.constraints and Constraints(*map(some, self.constraints)),
            some(self.terms, elements),
        )


# (point values (K, s + 1, n, columns), extras (K, s + 1, ...)) -> signals by kind
Monitor = Callable[[Array, tuple[Array, ...]], Iterable[Kind]]


@dataclass(frozen=True)
class LinearProblem:
    """The equation, and which other signals of the solution have to be resolved by the mesh.

    ``coefficients(t, inside)`` evaluates E, A, f at times of shape (N,); functions that jump are
    decided at ``inside``. It is called once for each element, at all of its points.
    ``monitor`` returns further signals computed from the solution, grouped by kind: (point values
    (K, s + 1, c), size below which that kind is rounding, or one for each (c,), see
    :func:`gpebo_cli.numerics.mesh.unresolved`).
    """

    coefficients: Callable[[Array, Array], LinearEquation]
    start: Array  # (n, columns)
    monitor: Monitor | None = None
    name: str = "equation"
    # Size below which the solution itself is rounding, or one (n, 1) for each component.
    floor: float | Array = 0.0
    # (n, n + 1) by how much relative rounding of the components, and of 1, reaches each component
    amplification: Array | None = None
    # By how much values (K, s + 1, n, columns) on a mesh miss the constraints, (n, columns): the
    # rounding that they are seen to have, beside a bound of it; None: nothing is looked at.
    missed: Callable[[Mesh, Array, Array], Array | None] | None = None
    # (n, columns) beyond which nothing counts of what amplification says, in units of rounding.
    seen: Array | float = float("inf")
    # An equivalent value at every edge to continue with, in place of the limit from the left (n,
    # columns): a basis whose columns grow is changed. What errors do is then not known.
    renewal: Callable[[Array], Array] | None = None
    # Where components have units of their own, one that is small beside the others counts for
    # itself, unless it is small beside what it is made of.
    units: Array | None = None  # (n, 1)
    uncertain: Array | None = None  # (n, columns) errors of the start beside rounding
    rate: float = 0.0  # how fast X may change by itself, 1/s; zero: nobody knows
    blur: Callable[[Array], Array] = np.abs  # how wrong instants (C,) may be, in units of rounding
    told: bool = False  # whether the monitor has all components among its signals
    advice: str = "raise solver.max_elements or solver.tol"  # where elements do not suffice


def at_points(values: Array, k: int, s: int) -> Array:
    """(k (s + 1), ...) -> (k, s + 1, ...); (1, ...) -> (1, 1, ...)."""
    if len(values) == 1:
        return values[None]
    return values.reshape(k, s + 1, *values.shape[1:])
