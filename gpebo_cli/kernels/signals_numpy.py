"""Signals on a mesh: whether it resolves them, and interpolation."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels.arrays import Array, IntArray

_CHUNK = 1 << 22  # numbers gathered at once
_TINY = float(np.finfo(float).tiny)


def tails(
    values: Array, to_legendre: Array, used: int, foot: float, share: float, floor: float,
    least: Array | None,
) -> Array:
    """What each element's polynomial leaves out (K,), as its last Legendre coefficients say.

    Of signals of one kind at the points (K, s + 1, c), a coefficient of degree j < s + 1, of which
    the last ``used`` count, is taken relative to the largest value of its component so far, which
    is floored at ``foot`` times its final one, ``share`` of the largest component, and ``floor``;
    ρ^j predicts ρ^(s + 1), and the largest prediction of all components counts. Components count as
    being at least as large as ``least`` (c,), and are compared in units of their size; None: as
    they are.
    """
    if not values.size:
        return np.zeros(len(values))
    last = np.abs(np.matmul(to_legendre[len(to_legendre) - used :], values))
    size = np.maximum.accumulate(np.abs(values).max(axis=1), axis=0)
    final = size[-1]
    size = np.maximum(size, foot * final)
    unit = np.ones_like(final)
    if least is not None:
        unit = np.maximum(np.maximum(final, least), _TINY)
        size = np.where(final < unit, 1.0, size / unit)
    size = np.maximum(size, np.maximum(share * size.max(axis=1, keepdims=True), max(floor, _TINY)))
    worst = (last / (size * unit)[:, None]).max(axis=2)
    points = len(to_legendre)
    powers = points / np.arange(points - used, points)
    return np.asarray((np.minimum(worst, 1.0) ** powers).max(axis=1, initial=0.0))


def largest(values: Array) -> Array:
    """Largest sizes (K, c) of values (K, points, c); 0 of none. Points first in memory are fast."""
    sizes = np.abs(np.swapaxes(values, 0, 1), order="C")
    return np.asarray(sizes.max(axis=0, initial=0.0), dtype=np.float64)


def interpolation(
    edges: Array, places: Array, barycentric: Array, t: Array, belongs: Array, exact: float
) -> tuple[IntArray, Array]:
    """Elements (N,) that contain ``belongs`` (N,), weights (N, s + 1) for the values at t (N,).

    Elements have ``edges`` (K + 1,), and points at ``places`` (s + 1,) with ``barycentric``
    weights. Nearer than ``exact`` to a point, in elements, the point's own value is taken.
    """
    element = edges[1:-1].searchsorted(belongs, side="right")
    left = edges[element]
    distance = (t - left) / (edges[element + 1] - left) - places[:, None]
    point, row = (np.abs(distance) < exact).nonzero()
    distance[point, row] = 1.0
    weights = barycentric[:, None] / distance  # of all times in a row: that is fast
    weights = np.ascontiguousarray((weights / weights.sum(axis=0)).T)
    weights[row] = 0.0
    weights[row, point] = 1.0
    return element, weights


def sample(element: IntArray, weights: Array, values: Array) -> Array:
    """Weighted sums (N, c) of the point values (K, s + 1, c) of an element for each time (N,)."""
    out = np.empty((len(element), values.shape[2]))
    chunk = max(1, _CHUNK // max(1, values.shape[1] * values.shape[2]))
    for i in range(0, len(out), chunk):
        part = slice(i, i + chunk)
        out[part] = np.matmul(weights[part, None, :], values[element[part]])[:, 0]
    return out
