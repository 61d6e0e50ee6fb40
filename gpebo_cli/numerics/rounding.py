"""Rounding of an equation's terms: what it may bring about in an element, and what is left of that.

A fast mode of rate λ forgets it within 1/λ: in an element of length h that is 1/(λ h) of it. In
other directions the terms of the fast mode, which are large, leave all that they bring.
"""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.errors import TINY, random_signs
from gpebo_cli.numerics.linalg import inverse_or_none, largest_within
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem, at_points

_MUCH = 1e3  # roundings of the largest value, from which on it is worth while to look closer
FAST = 100.0  # a rate times the length of an element in which little would be forgotten below
_GROWING = 8.0  # times the share of an element that is over: no swing that is resolved averages it
_AT_ONCE = 256  # elements


def noise_of(h: Array, t: Array, c: LinearEquation) -> Array:
    """By how much relative rounding of each component, and of 1, may move X within an element.

    What T brings of :func:`_of_terms` (k, n, n + 2 columns); zero where E is not invertible.
    """
    found, (k, points) = _of_terms(h, t, c), t.shape
    if c.constraints is not None:
        basis = at_points(c.constraints.basis, k, points - 1)
        return np.asarray(largest_within(basis) @ found)
    if c.E is None:
        return found
    inverse, singular = inverse_or_none(at_points(c.E, k, points - 1)[:, -1])
    inverse[singular] = 0.0
    return np.asarray(np.abs(inverse) @ found)


def _of_terms(h: Array, t: Array, c: LinearEquation) -> Array:
    """By how much relative rounding may move the equations of an element, (k, d, n + 2 columns).

    h times |A| and |f|, or their terms; what rounding of the times t (k, s + 1) makes of A that
    moves; and, apart, what it makes of f, and of A times what constraints say, that move.
    """
    k, s = len(h), t.shape[1] - 1
    d, n = c.A.shape[1:]
    high, low = np.empty((2, max(len(c.A), len(c.f)) // (s + 1) or 1, d, n + c.f.shape[2]))
    for part, values in ((slice(n), c.A), (slice(n, None), c.f)):
        along = np.ascontiguousarray(at_points(values, k, s).swapaxes(0, 1))
        high[..., part], low[..., part] = along.max(axis=0), along.min(axis=0)
    del along
    found, moved = np.maximum(high, -low), np.abs(t[:, -1, None, None]) * (high - low)
    of_time = moved[..., n:]
    if c.constraints is not None:
        forcing = at_points(c.A @ c.constraints.offset, k, s)
        swing = forcing.max(axis=1) - forcing.min(axis=1)
        of_time = of_time + np.abs(t[:, -1, None, None]) * swing
    found = h[:, None, None] * (found if c.terms is None else np.maximum(found, c.terms))
    found[..., :n] += moved[..., :n]
    return np.concatenate([found, of_time], axis=2)


def kept_share(problem: LinearProblem, mesh: Mesh, noise: Array, values: Array) -> Array:
    """Which share (K or 1, ·, 1) of :func:`noise_of` is left where values (K, s + 1, …) end.

    It is looked at where that is much and equations are fast. Rounding of one term knows nothing of
    another's, nor at one node of that at the next; where A is constant, it is the same at all.
    """
    fast = mesh.steps * problem.rate > FAST
    if not fast.any():
        return np.ones((1, 1, 1))
    sizes, share = largest_within(values), np.ones((mesh.size, values.shape[2], 1))

    def moved(noise: Array, sizes: Array) -> Array:
        n, columns = sizes.shape[1:]
        apart = noise[..., n:].reshape(*noise.shape[:2], 2, columns)
        return np.asarray(noise[..., :n] @ sizes + apart.sum(axis=2))

    most = moved(noise, sizes)
    much = np.flatnonzero((most > _MUCH * sizes.max(axis=0)).any(axis=(1, 2)) & fast)
    for k in range(0, len(much), _AT_ONCE):
        some = much[k : k + _AT_ONCE]
        h, t = mesh.steps[some], mesh.points[some]
        c = problem.coefficients(t.ravel(), mesh.inside[some].ravel())
        squares, terms = np.square(_responses(mesh, h, c)).mean(axis=2), _of_terms(h, t, c)
        unit = max(float(sizes[some].max()), TINY)  # squares of what grows are no numbers
        terms[..., values.shape[2] :] /= unit
        left = np.sqrt(squares @ moved(np.square(terms), np.square(sizes[some] / unit)))
        part = left / np.maximum(most[some] / unit, TINY)
        share[some] = np.minimum(part, 1.0).max(axis=2, keepdims=True)
    return share


def _responses(mesh: Mesh, h: Array, c: LinearEquation) -> Array:
    """X at right ends by what an error of each equation would bring in h, (k, n, choices, d).

    Errors at the nodes have random signs, chosen several times, or grow with the time.
    """
    points, (d, n), k = mesh.rule.points, c.A.shape[1:], len(h)
    alike, random = len(c.A) == 1, random_signs(mesh.rule.stages, 1)[:, 0]
    errors = np.kron(_GROWING * points[:, None] if alike else random, np.eye(d))
    forcing = np.tile(errors.reshape(len(points), d, -1), (k, 1, 1))
    basis = None if c.constraints is None else c.constraints.basis
    offset = None if basis is None else np.zeros((1, n, forcing.shape[2]))
    _, found = elements.element_maps(
        mesh.rule.differentiation, h, c.E, c.A, forcing, basis, offset, np.arange(k), k
    )
    return np.asarray(found[:, -1].reshape(k, n, -1, d) / h[:, None, None, None])


def noise_of_instants(problem: LinearProblem, solution: Trajectory, cuts: Array) -> Array:
    """By how much rounding of instants (C,) moves X in the elements, (K or 1, n, columns).

    Between an instant and where it should be, X has the slope of the wrong side.
    """
    found = np.zeros((solution.mesh.size if len(cuts) else 1, *solution.values.shape[2:]))
    if len(cuts):
        after, slopes = np.searchsorted(solution.mesh.edges, cuts), solution.derivative().values
        jumps = np.abs(slopes[after, 0] - slopes[after - 1, -1])
        found[after] = problem.blur(cuts)[:, None, None] * jumps
    return found
