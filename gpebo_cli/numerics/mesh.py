"""A mesh of elements in time and the piecewise polynomials that live on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from itertools import pairwise
from math import factorial, prod
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from gpebo_cli.kernels import elements, signals
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.model.expressions.intervals import Interval, polynomials
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.radau import RadauRule

# Functions that jump are decided this far (relative to the element) inside its ends, so that both
# ends of an element see the limit from within. Nodes in between decide for themselves: a jump
# that nobody announced then shows up as an unresolved element, not as a wrong number.
_INSIDE = 1e-3
FIRST_ELEMENTS = 24  # of a first mesh: enough nodes to notice a pulse, few enough to be free
SHARE = 1e-3  # of the largest component: what is smaller is measured against that
_FOOT = 1e-8  # of its final size: what a component was before may be that wrong
_WIDE = 32  # columns, from which on BLAS's products are faster than the kernels
_MANY = 1 << 16  # numbers, from which on sampling them by element pays
SNAP = 8.0 * float(np.finfo(float).eps)  # of a time: by how much it may miss a sample or an edge
_EXACT = 4.0 * np.finfo(float).eps
_BLUR = 8.0 * np.finfo(float).eps
_EQUAL = 1e-11  # relative difference of lengths that is rounding,
_ROUNDING = 8 * float(np.finfo(float).eps)  # if it is this of the span: short ones differ by more
_TINY = float(np.finfo(np.float64).tiny)
_WINDOW = 1 << 12  # elements of a long mesh that are solved together


# Point values (K, s + 1, c) of signals of one kind, and what is small among them: ``unresolved``.
Kind = tuple[Array, float | Array]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Elements [edges[k], edges[k+1]], each with the points of one Radau rule."""

    edges: Array  # (K + 1,) ascending, beside ``origin``
    rule: RadauRule
    # Far from zero, times are told apart to a rounding of that only: elements may be shorter.
    origin: float = 0.0

    def __repr__(self) -> str:
        return f"<mesh of {self.size} elements, t = {self.edges[0]:g} to {self.edges[-1]:g} s>"

    @property
    def blur(self) -> Array:
        """Shares (K,) of an element's length by which rounding of times moves its nodes."""
        return np.asarray(_BLUR * np.abs(self.edges[1:]) / self.steps)

    @property
    def size(self) -> int:
        """Number of elements K."""
        return len(self.edges) - 1

    @property
    def span(self) -> tuple[float, float]:
        """First and last time, seconds."""
        return float(self.origin + self.edges[0]), float(self.origin + self.edges[-1])

    @cached_property
    def steps(self) -> Array:
        """Element lengths, shape (K,)."""
        return np.asarray(self.edges[1:] - self.edges[:-1])

    @cached_property
    def points(self) -> Array:
        """Left end and nodes of every element, shape (K, s + 1)."""
        points = self.edges[:-1, None] + self.steps[:, None] * self.rule.points
        points[:, -1] = self.edges[1:]
        return self.origin + points if self.origin else points

    @cached_property
    def inside(self) -> Array:
        """Where functions that jump are decided, shape (K, s + 1)."""
        inside = self.points.copy()
        inside[:, 0] += _INSIDE * self.steps
        inside[:, -1] -= _INSIDE * self.steps
        return inside

    def trajectory(self, flat: Array) -> Trajectory:
        """The signal (K, s + 1, …) with these values, one point after the other."""
        return Trajectory(self, flat.reshape(self.size, len(self.rule.points), *flat.shape[1:]))

    def along(self, signal: Callable[[Array, Array], Array]) -> Trajectory:
        """A signal, (N, …) at times (N,) and where jumps are decided, at all points."""
        return self.trajectory(signal(self.points.ravel(), self.inside.ravel()))

    def sampled(self, t: Array, values: Array) -> Samples:
        """A signal of which nothing but its values (M, …) at some times (M,) is kept."""
        return Samples(self, values[None], t)

    def windows(self) -> list[Mesh]:
        """This mesh, or the pieces of a long one that are solved one after the other."""
        if self.size <= _WINDOW:
            return [self]
        cuts = range(0, self.size, _WINDOW)
        return [replace(self, edges=self.edges[k : k + _WINDOW + 1]) for k in cuts]

    def shares(self, t: Array) -> Iterator[Array]:
        """Those of the times t (M,), ascending, that are in each of :meth:`windows`."""
        starts = self.origin + self.edges[:-1:_WINDOW][: len(self.windows())]
        yield from np.split(t, t.searchsorted(starts[1:]))

    def split(self, parts: IntArray) -> tuple[Mesh, IntArray]:
        """Cut element k into ``parts[k]`` equal ones; ``parts`` has shape (K,).

        Returns:
            The new mesh, and for each new element the old one it equals, or −1 if it is new.
        """
        parent, own = np.arange(self.size).repeat(parts), parts.repeat(parts)
        position = np.arange(len(parent)) - (parts.cumsum() - parts)[parent]
        edges = np.empty(len(parent) + 1)
        edges[:-1] = self.edges[parent] + self.steps[parent] * (position / own)
        edges[-1] = self.edges[-1]
        return replace(self, edges=edges), np.where(own == 1, parent, -1)

    def sampler(self, t: Array, inside: Array | None = None) -> Sampler:
        """Interpolation from this mesh to the times ``t`` (N,).

        At an edge the element that contains ``inside`` is used; by default the one to the right.
        """
        known, plain = self._sampler, inside is None
        if plain and known and np.array_equal(known[0], t):
            return known[1]  # type: ignore[no-any-return]
        # A sample that was meant to be an edge may miss it by rounding: snap to the right element.
        # Relative to t itself: next to t = 0 elements may be as short as a stiff transient.
        asked, rule, t = t, self.rule, np.asarray(t, dtype=np.float64) - self.origin
        belongs = beside_edges(t) if inside is None else inside - self.origin
        found = Sampler(*signals.interpolation(
            self.edges, rule.points, rule.barycentric, t, belongs, _EXACT
        ))
        if plain and found.weights.size <= _MANY:
            known[:] = np.array(asked), found
        return found

    @cached_property
    def _sampler(self) -> list[Any]:
        """The last times that were few, and what came of them: several signals ask for the same."""
        return []


def beside_edges(t: Array) -> Array:
    """Times (M,) that reach an edge, or a sample, which those that are given miss by rounding."""
    return np.asarray(t + SNAP * np.abs(t))


@dataclass(frozen=True, eq=False)
class Sampler:
    """Barycentric interpolation to fixed times; apply it to any signal of the same mesh."""

    element: IntArray  # (N,)
    weights: Array  # (N, s + 1)

    def __call__(self, values: Array) -> Array:
        """Sample point values (K, s + 1, ...) at the times: (N, ...)."""
        flat = _flat(values)
        columns = flat.shape[2]
        wide = columns > _WIDE and columns * len(self.element) >= _MANY
        # One product for each element gathers nothing for each time.
        if wide and 2 * len(self._runs) <= len(self.element):
            sampled = np.empty((len(self.element), columns))
            for k, some in self._runs:
                np.matmul(self.weights[some], flat[k], out=sampled[some])
        else:
            sampled = signals.sample(self.element, self.weights, flat)
        return sampled.reshape(len(sampled), *values.shape[2:])

    def products(self, values: Array, factors: Array) -> Array:
        """Matrices (K, s + 1, n, p), at the times, with vectors there (M, p): (M, n).

        Matrices of whole elements are multiplied: none is interpolated.
        """
        found = np.empty((len(factors), values.shape[2]))
        for k, some in self._runs:
            found[some] = np.einsum("mj,jnm->mn", self.weights[some], values[k] @ factors[some].T)
        return found

    @cached_property
    def _runs(self) -> list[tuple[int, slice]]:
        """The element that some times in a row share, and which times these are."""
        changes = np.flatnonzero(np.diff(self.element, prepend=-1, append=-1)).tolist()
        return [(self.element[first], slice(first, last)) for first, last in pairwise(changes)]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A signal given by its values at the points of a mesh, shape (K, s + 1, ...).

    Within an element it is the interpolating polynomial of degree s; it may jump between elements.
    """

    mesh: Mesh
    values: Array  # (K, s + 1, …)

    def __repr__(self) -> str:
        return f"<trajectory {self.values.shape[2:]} on a {repr(self.mesh)[1:]}"

    def __call__(self, t: Array, inside: Array | None = None) -> Array:
        """Values at the times t (N,), shape (N, ...); at edges see :meth:`Mesh.sampler`."""
        return self.mesh.sampler(t, inside)(self.values)

    @property
    def final(self) -> Array:
        """Value at the end of the mesh, which does not hold the others."""
        return np.array(self.values[-1, -1])

    def derivative(self) -> Trajectory:
        """That of each element's polynomial, in 1/s."""
        out = _derivative(self.mesh.rule) @ _flat(self.values) / self.mesh.steps[:, None, None]
        return Trajectory(self.mesh, out.reshape(self.values.shape))

    def taylor(self, t: Array, order: int, inside: Array | None = None) -> Array:
        """Taylor coefficients of each element's polynomial at t (N,), (order + 1, N, …)."""
        sampler, signal = self.mesh.sampler(t, inside), self
        found = np.empty((order + 1, len(t), *self.values.shape[2:]))
        for k in range(order + 1):
            signal = signal.derivative() if k else signal
            found[k] = sampler(signal.values) / factorial(k)
        return found

    def cells(self, low: Array, high: Array) -> list[list[Interval]]:
        """Taylor coefficients of each signal at any time of cells (N,), each in one element."""
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        c = self.taylor(middle, self.mesh.rule.stages, middle)
        return [polynomials(each, half) for each in np.moveaxis(c, 2, 0)]

    def integral(self, *, local: bool = False) -> Trajectory:
        """∫ from the start of the mesh, by its own quadrature (order 2s − 1 at the ends).

        ``local``: from the left end of each element.
        """
        mesh, flat = self.mesh, _flat(self.values)
        out = np.empty(flat.shape)
        out[:, 0] = 0.0
        weights = mesh.steps[:, None, None] * mesh.rule.integration
        np.matmul(weights, flat[:, 1:], out=out[:, 1:])
        if not local:
            out[1:] += out[:-1, -1].cumsum(axis=0)[:, None]
        return Trajectory(mesh, out.reshape(self.values.shape))

    def low_pass(self, rate: Array | float, start: Array | None = None) -> Trajectory:
        """Z of Z' = −λ (Z − S): the filter λ/(p + λ) applied to this signal S.

        With a rate λ > 0 in 1/s, a scalar () or an array that broadcasts against one value (...,)
        of the signal, and with Z at the start of the shape of one value; None: 0.
        """
        mesh, rule = self.mesh, self.mesh.rule
        shape = self.values.shape[2:]
        rates = np.broadcast_to(np.asarray(rate, dtype=np.float64), shape).ravel()
        at_start = np.zeros(len(rates)) if start is None else start.ravel()
        values, (group, steps) = _flat(self.values), equal_lengths(mesh.steps, mesh)
        filtered = np.empty(values.shape)
        for one in sorted({*rates.tolist()}):
            some = (rates == one).nonzero()[0]
            own, forced = elements.element_maps(
                rule.differentiation, steps, None, np.full((1, 1, 1), -one),
                (one * values[..., some]).reshape(-1, 1, len(some)), None, None,
                group, int(group.max()) + 1,
            )
            found = elements.chain(own[group], forced, at_start[None, some])[0]
            filtered[..., some] = found[:, :, 0]
        return Trajectory(mesh, filtered.reshape(self.values.shape))


@dataclass(frozen=True, eq=False, repr=False)
class Samples(Trajectory):
    """A signal of which only values at some times are kept, (1, M, …); there is none in between."""

    t: Array  # (M,) ascending

    def __call__(self, t: Array, inside: Array | None = None) -> Array:  # noqa: ARG002
        """Values at times t (N,), which are among those (ValueError: they are not)."""
        k = self.t.searchsorted(t).clip(max=len(self.t) - 1)
        if (self.t[k] != t).any():
            raise ValueError("a signal is asked for where it was not kept")
        return np.asarray(self.values[0, k])


def joined(pieces: Sequence[Trajectory]) -> Trajectory:
    """Signals (K, s + 1, …) on neighbouring meshes of one rule as one."""
    edges = [pieces[0].mesh.edges[:1], *(piece.mesh.edges[1:] for piece in pieces)]
    mesh = Mesh(np.concatenate(edges), pieces[0].mesh.rule)
    return Trajectory(mesh, np.concatenate([piece.values for piece in pieces]))


def equal_lengths(h: Array, mesh: Mesh) -> tuple[IntArray, Array]:
    """Group (K,) of each length of a mesh's elements, and the group's mean in its place.

    Lengths that differ by rounding of the mesh's edges only count as equal. One of them for all
    would be wrong each time in the same direction, and over many elements that adds up; what their
    mean is wrong by adds up to nothing. Groups are numbered as they first appear.
    """
    group = np.zeros(len(h), dtype=np.intp)
    same = min(_EQUAL * h.max(initial=0.0), _ROUNDING * float(mesh.edges[-1] - mesh.edges[0]))
    if h.max(initial=0.0) - h.min(initial=np.inf) > same:
        order = h.argsort(kind="stable")
        ascending, longer = h[order], np.ones(len(h), dtype=bool)
        longer[1:] = ascending[1:] - ascending[:-1] > same
        first = np.minimum.reduceat(order, longer.nonzero()[0])
        group[order] = first.argsort().argsort()[longer.cumsum() - 1]
    return group, np.asarray((np.bincount(group, weights=h) / np.bincount(group))[group])


@lru_cache(maxsize=16)
def _derivative(rule: RadauRule) -> Array:
    """From values at the points of the unit interval to those of the derivative there."""
    slopes = legendre.legder(rule.to_legendre, axis=0)
    return np.asarray(2.0 * legendre.legvander(2.0 * rule.points - 1.0, rule.stages - 1) @ slopes)


def _flat(values: Array) -> Array:
    """Values (K, s + 1, …) as (K, s + 1, c)."""
    return values.reshape(values.shape[0], values.shape[1], prod(values.shape[2:]))


def unresolved(values: Array, rule: RadauRule, floor: float | Array = 0.0) -> Array:
    """How far each element is from resolving signals of one kind, relative to their own size, (K,).

    The first Legendre coefficient that an element leaves out of values (K, s + 1, c) (see
    :func:`legendre_tail`) against the largest value of that component so far: in a system that
    grows, what is an invisible error beside the end of the horizon is what the end is made of. The
    ``floor`` is the size below which a signal of this kind is rounding; or sizes (c,) that the
    components count as having where they are smaller: then all of them are compared in units of
    their own size.
    """
    least, level = (floor, 0.0) if isinstance(floor, np.ndarray) else (None, floor)
    return signals.tails(
        values, rule.to_legendre, len(rule.to_next), _FOOT, SHARE, level, least
    )


def unresolved_kinds(kinds: Iterable[Kind], rule: RadauRule) -> Array:
    """:func:`unresolved` of signals of several kinds (values, floor), the worst; shape (K,)."""
    return reduce(np.maximum, (unresolved(values, rule, floor) for values, floor in kinds))


def legendre_tail(values: Array, rule: RadauRule, scale: Array) -> Array:
    """Size of what an element's polynomial of degree s leaves out, shape (K, c).

    Each of the last few coefficients |c_j| ≈ scale ρ^j predicts the next one after the last,
    scale ρ^(s+1); the largest prediction counts. Several, because single coefficients vanish by
    accident, two of them where the signal is odd or even.
    """
    return predicted_tail(np.abs(np.matmul(rule.to_legendre[-4:], values)), rule, scale)


def predicted_tail(last: Array, rule: RadauRule, scale: Array) -> Array:
    """:func:`legendre_tail` (K, c) from the sizes of the last coefficients (K, up to 4, c)."""
    size = np.broadcast_to(scale, last[:, 0].shape)[:, None]
    shares = np.minimum(last[:, -len(rule.to_next) :] / size, 1.0)
    with np.errstate(divide="ignore"):
        powers = np.log(shares, out=shares)  # one exponential is a fourth of as many powers
    powers *= rule.to_next[:, None]
    return np.asarray(size[:, 0] * np.exp(powers.max(axis=1)))


def signal_scale(values: Array) -> Array:
    """Size of each component over the mesh (c,).

    A component more than three orders below the largest one is measured against that: rounding in
    the large ones reaches it.
    """
    size = largest_over_time(values, 2)
    return np.asarray(np.maximum(size, max(SHARE * float(size.max(initial=0.0)), _TINY)))


def initial_mesh(start: float, stop: float, breakpoints: Sequence[float] | Array,
                 elements: int, rule: RadauRule) -> Mesh:
    """About ``elements`` equal elements, with every breakpoint (B,), in seconds, an edge."""
    return Mesh(initial_edges(start, stop, breakpoints, elements), rule)


def initial_edges(
    start: float, stop: float, breakpoints: Sequence[float] | Array, elements: int = FIRST_ELEMENTS
) -> Array:
    """The edges (K + 1,) of :func:`initial_mesh`, with breakpoints (B,) among them."""
    if not len(breakpoints):
        return np.linspace(start, stop, elements + 1)
    cuts = np.unique(np.concatenate([[start], np.asarray(breakpoints, dtype=float), [stop]]))
    cuts = cuts[(cuts >= start) & (cuts <= stop)]
    counts = np.maximum(1, np.rint(elements * np.diff(cuts) / (stop - start))).astype(int)
    pieces = [np.linspace(a, b, c, endpoint=False)
              for a, b, c in zip(cuts[:-1], cuts[1:], counts, strict=True)]
    return np.append(np.concatenate(pieces), stop)
