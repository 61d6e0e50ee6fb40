"""A mesh of elements in time and the piecewise polynomials that live on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gpebo_cli.collocation.radau import RadauRule
from gpebo_cli.linalg import affine_scan
from gpebo_cli.systems.descriptor import Array, IntArray

# Functions that jump are decided this far (relative to the element) inside its ends, so that both
# ends of an element see the limit from within. Nodes in between decide for themselves: a jump
# that nobody announced then shows up as an unresolved element, not as a wrong number.
_INSIDE = 1e-3
_CHUNK = 1 << 22  # numbers gathered at once when sampling
_COEFFICIENTS = 4  # of the last ones, from which the next is predicted
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Elements [edges[k], edges[k+1]], each with the points of one Radau rule."""

    edges: Array  # (K + 1,) ascending
    rule: RadauRule

    @property
    def size(self) -> int:
        """Number of elements K."""
        return len(self.edges) - 1

    @cached_property
    def steps(self) -> Array:
        """Element lengths, shape (K,)."""
        return np.diff(self.edges)

    @cached_property
    def points(self) -> Array:
        """Left end and nodes of every element, shape (K, s + 1)."""
        points = self.edges[:-1, None] + self.steps[:, None] * self.rule.points
        points[:, -1] = self.edges[1:]
        return points

    @cached_property
    def inside(self) -> Array:
        """Where functions that jump are decided, shape (K, s + 1)."""
        inside = self.points.copy()
        inside[:, 0] += _INSIDE * self.steps
        inside[:, -1] -= _INSIDE * self.steps
        return inside

    def split(self, parts: IntArray) -> tuple[Mesh, IntArray]:
        """Cut element k into ``parts[k]`` equal ones.

        Returns:
            The new mesh, and for each new element the old one it equals, or −1 if it is new.
        """
        parent = np.repeat(np.arange(self.size), parts)
        first = np.cumsum(parts) - parts
        position = np.arange(len(parent)) - first[parent]
        left = self.edges[parent] + self.steps[parent] * (position / parts[parent])
        edges = np.append(left, self.edges[-1])
        return Mesh(edges, self.rule), np.where(parts[parent] == 1, parent, -1)

    def sampler(self, t: Array, inside: Array | None = None) -> Sampler:
        """Interpolation from this mesh to the times ``t`` (N,).

        At an edge the element that contains ``inside`` is used; by default the one to the right.
        """
        t = np.asarray(t, dtype=np.float64)
        # A sample that was meant to be an edge may miss it by rounding: snap to the right element.
        # Relative to t itself: next to t = 0 elements may be as short as a stiff transient.
        snap = 8.0 * np.finfo(float).eps * np.abs(t)
        belongs = t + snap if inside is None else inside
        element = np.searchsorted(self.edges, belongs, side="right") - 1
        element = np.clip(element, 0, self.size - 1)
        local = (t - self.edges[element]) / self.steps[element]
        distance = local[:, None] - self.rule.points
        exact = np.abs(distance) < 4.0 * np.finfo(float).eps
        hit = exact.any(axis=1)
        with np.errstate(divide="ignore"):
            weights = self.rule.barycentric / np.where(exact, 1.0, distance)
        weights[hit] = exact[hit]
        weights /= weights.sum(axis=1, keepdims=True)
        return Sampler(element, weights)


@dataclass(frozen=True, eq=False)
class Sampler:
    """Barycentric interpolation to fixed times; apply it to any signal of the same mesh."""

    element: IntArray  # (N,)
    weights: Array  # (N, s + 1)

    def __call__(self, values: Array) -> Array:
        """Sample point values (K, s + 1, ...) at the times: (N, ...)."""
        shape = values.shape[2:]
        flat = values.reshape(*values.shape[:2], -1)
        out = np.empty((len(self.element), flat.shape[2]))
        chunk = max(1, _CHUNK // max(1, flat.shape[1] * flat.shape[2]))
        for i in range(0, len(out), chunk):
            part = slice(i, i + chunk)
            gathered = flat[self.element[part]]
            out[part] = np.matmul(self.weights[part, None, :], gathered)[:, 0, :]
        return out.reshape(len(out), *shape)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A signal given by its values at the points of a mesh, shape (K, s + 1, ...).

    Within an element it is the interpolating polynomial of degree s; it may jump between elements.
    """

    mesh: Mesh
    values: Array

    def __call__(self, t: Array, inside: Array | None = None) -> Array:
        """Values at the times t (N,), shape (N, ...); at edges see :meth:`Mesh.sampler`."""
        return self.mesh.sampler(t, inside)(self.values)

    @property
    def final(self) -> Array:
        """Value at the end of the mesh."""
        return np.asarray(self.values[-1, -1])

    def local_integral(self) -> Trajectory:
        """∫ from the left end of each element, starting at zero again in the next one."""
        rule, mesh = self.mesh.rule, self.mesh
        flat = self.values.reshape(mesh.size, rule.stages + 1, -1)
        out = np.zeros_like(flat)
        out[:, 1:] = mesh.steps[:, None, None] * np.matmul(rule.integration, flat[:, 1:])
        return Trajectory(mesh, out.reshape(self.values.shape))

    def integral(self) -> Trajectory:
        """∫ from the start of the mesh, by the mesh's own quadrature (order 2s − 1 at the ends)."""
        local = self.local_integral().values
        total = np.cumsum(local[:, -1], axis=0)
        local[1:] += total[:-1, None]
        return Trajectory(self.mesh, local)

    def low_pass(self, rate: Array | float) -> Trajectory:
        """Z of Z' = −λ (Z − S), Z(start) = 0: the filter λ/(p + λ) applied to this signal S.

        Args:
            rate: λ > 0, a scalar or an array that broadcasts against one value of the signal.
        """
        mesh, rule = self.mesh, self.mesh.rule
        shape = self.values.shape[2:]
        rates = np.broadcast_to(np.asarray(rate, dtype=np.float64), shape).ravel()
        flat = self.values.reshape(mesh.size, rule.stages + 1, -1)
        out = np.empty_like(flat)
        for value in np.unique(rates):
            columns = np.flatnonzero(rates == value)
            hl = (value * mesh.steps)[:, None, None]  # h λ
            operator = rule.differentiation + hl * np.eye(rule.stages)
            start_column = rule.differentiation.sum(axis=1)
            right = np.empty((mesh.size, rule.stages, 1 + len(columns)))
            right[:, :, 0] = start_column
            right[:, :, 1:] = hl * flat[:, 1:, columns]
            solved = np.linalg.solve(operator, right)
            starts = affine_scan(
                solved[:, -1, :1], solved[:, -1, 1:], np.zeros(len(columns))
            )[:-1]
            out[:, 0, columns] = starts
            out[:, 1:, columns] = solved[:, :, :1] * starts[:, None] + solved[:, :, 1:]
        return Trajectory(mesh, out.reshape(self.values.shape))


def unresolved(values: Array, rule: RadauRule, floor: float = 0.0) -> Array:
    """How far each element is from resolving its signals, relative to the signals' own size.

    The first Legendre coefficient that an element leaves out (see :func:`legendre_tail`) against
    the largest value of that component so far: in a system that grows, what is an invisible error
    beside the end of the horizon is what the end is made of.

    Args:
        values: point values (K, s + 1, c) of signals of one kind.
        rule: the mesh's rule.
        floor: size below which a signal of this kind is rounding, see :func:`signal_scale`.

    Returns:
        shape (K,).
    """
    if values.shape[2] == 0:
        return np.zeros(len(values))
    scale = scale_so_far(values, floor)
    return np.asarray((legendre_tail(values, rule, scale) / scale).max(axis=1))


def legendre_tail(values: Array, rule: RadauRule, scale: Array) -> Array:
    """Size of what an element's polynomial of degree s leaves out, shape (K, c).

    Each of the last few coefficients |c_j| ≈ scale ρ^j predicts the next one after the last,
    scale ρ^(s+1); the largest prediction counts. Several, because single coefficients vanish by
    accident, two of them where the signal is odd or even.
    """
    s = rule.stages
    used = min(_COEFFICIENTS, s - 1)
    last = np.abs(np.matmul(rule.to_legendre[-used:], values))  # degrees s + 1 − used … s
    degrees = np.arange(s + 1 - used, s + 1)[:, None]
    size = np.broadcast_to(scale, last[:, 0].shape)[:, None]
    predicted = size * np.minimum(last / size, 1.0) ** ((s + 1) / degrees)
    return np.asarray(predicted.max(axis=1))


def scale_so_far(values: Array, floor: float = 0.0) -> Array:
    """Size of each component up to each element, (K, c), floored as in :func:`signal_scale`.

    Also floored at 1e-8 of the final size, so that the foot of a pulse costs nothing.
    """
    size = np.maximum.accumulate(np.abs(values).max(axis=1), axis=0)
    size = np.maximum(size, 1e-8 * size[-1])
    largest = 1e-3 * size.max(axis=1, initial=0.0, keepdims=True)
    return np.asarray(np.maximum(size, np.maximum(largest, max(floor, _TINY))))


def signal_scale(values: Array, floor: float = 0.0) -> Array:
    """Size of each component over the mesh (c,).

    A component more than three orders below the largest one, or below ``floor``, is measured
    against that: rounding in the large ones reaches it.
    """
    size = np.abs(values).max(axis=(0, 1))
    return np.asarray(np.maximum(size, max(1e-3 * float(size.max(initial=0.0)), floor, _TINY)))


def initial_mesh(start: float, stop: float, breakpoints: Sequence[float] | Array,
                 elements: int, rule: RadauRule) -> Mesh:
    """About ``elements`` equal elements, with every breakpoint an edge."""
    cuts = np.unique(np.concatenate([[start], np.asarray(breakpoints, dtype=float), [stop]]))
    cuts = cuts[(cuts >= start) & (cuts <= stop)]
    counts = np.maximum(1, np.rint(elements * np.diff(cuts) / (stop - start))).astype(int)
    pieces = [np.linspace(a, b, c, endpoint=False)
              for a, b, c in zip(cuts[:-1], cuts[1:], counts, strict=True)]
    return Mesh(np.append(np.concatenate(pieces), stop), rule)
