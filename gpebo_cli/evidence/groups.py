"""Which errors of rows count at a time: each row's own, those of groups, or a spline's.

Held errors and those on straight lines are one and two rows' at a time. The cubic spline through
rows depends on all of them. In B-splines (not-a-knot) it is e(t) = Σ c_k B_k(t), four of them at a
time, with T c = e and a banded T, so that the inverse of c's covariance, TᵀT = LᵀL, is banded as
well. With a lower triangular L the white w = L c make each c_k of the three before it:

    c_k = (w_k − L_{k,k−1} c_{k−1} − L_{k,k−2} c_{k−2} − L_{k,k−3} c_{k−3}) / L_kk.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.rows import Rows, of_lines

_DEGREE = 3
_EXACT = 1e4  # times an error of 1: what is known counts as one of 1 in so many
_NONE, _NOWHERE = np.zeros(0), np.zeros(0, dtype=np.intp)


class Groups(NamedTuple):
    """Errors: of groups of rows, which move integrals as all of their own together do, or others.

    One takes the place of another one at each of the ``starts``.
    """

    starts: Array  # (G,) the times of their first rows, and
    after: Array  # (G,) of the rows behind these
    shares: Array  # (C,) of a row's deviation
    memory: Array  # (C, a − 1) of the errors before each one; a of them count at a time
    first: IntArray  # (G,) of those that count from each start on
    others: Array  # the times of all other rows
    knots: Array = _NONE  # (N + 4 for each of them,) of splines
    knot: IntArray = _NOWHERE  # (G,) that at each start

    @property
    def alone(self) -> bool:
        """Whether each row has an error of its own."""
        return not len(self.others)

    def weights(self, t: Array, group: IntArray, until: Array) -> Array:
        """Shares at times t (…,) of the errors that count there, (a, …).

        Of a group's own one and of the next one's, which it gives way to ``until`` (G,).
        """
        if len(self.knots):
            return _splines(self.knots, self.knot[group], t)
        if not self.memory.shape[1]:
            return np.ones((1, *t.shape))
        tau = (t - self.starts[group]) / (until - self.starts)[group]
        return np.asarray([1.0 - tau, tau])


def grouped(rows: Rows, end: float, t: Array, starts: Array, most: int, per: int) -> Groups:
    """Rows (N,) up to ``end`` in groups of up to ``most``; those of splines stand alone.

    After k rows from a start they are of up to k/``per``. The row at or before a time of ``t`` or
    ``starts`` is the first one of its group, and so are those on both sides of a pause.
    """
    if most <= 1 or rows.hold == "cubic":
        return each_alone(rows, starts)
    instants, lines = rows.t, rows.lines
    if not lines:  # nothing is held from the end on
        instants = instants[: np.searchsorted(instants, end)]
    count = len(instants)
    near = 1e-6 * float(np.diff(instants).min())

    def at(times: Array) -> IntArray:
        return np.searchsorted(instants, times + near, side="right").clip(1) - 1

    steps = np.diff(instants, append=max(end, instants[-1]))
    pauses = np.flatnonzero(rows.pauses)
    fresh = at(starts)
    bounds = np.unique(np.concatenate([
        [0, count - 1, count], at(t), fresh, pauses, (pauses + 1).clip(max=count)
    ]))
    origins = fresh[np.searchsorted(fresh, bounds, side="right").clip(1) - 1]
    found: list[int] = []
    for (k, stop), origin in zip(pairwise(bounds.tolist()), origins.tolist(), strict=False):
        while k < stop:
            found.append(k)
            k += max(1, min(most, (k - origin) // per))  # noqa: PLW2901
    first = np.array(found)
    if lines:  # what each row counts for, and what the first ones of groups do, with lines between
        own, whole = (of_lines(x) for x in (instants, instants[first]))
        group = np.repeat(np.arange(len(first)), np.diff(first, append=count))
        tau = (instants - instants[first][group]) / np.diff(instants[first], append=np.inf)[group]
        squares = np.bincount(group, (1.0 - tau) * own**2)
        squares[1:] += np.bincount(group, tau * own**2)[:-1]
    else:
        whole, squares = (np.add.reduceat(steps**power, first) for power in (1, 2))
    return Groups(
        instants[first], instants[(first + 1).clip(max=count - 1)], np.sqrt(squares) / whole,
        np.zeros((len(first), int(lines))), np.arange(len(first)), np.delete(instants, first),
    )


def each_alone(rows: Rows, starts: Array) -> Groups:
    """Rows, each with its own error; splines begin anew at ``starts`` (S,), in seconds."""
    t = rows.t
    near = 1e-6 * np.diff(t, append=np.inf).min()  # of one row there is no interval
    pieces = np.split(t, np.searchsorted(t, starts[1:] - near))
    pieces = [np.append(x, after[:1]) for x, after in pairwise([*pieces, _NONE])]
    if rows.hold == "cubic":
        return _of_splines(pieces)
    memory = np.zeros((len(t), int(rows.lines)))
    return Groups(t, np.append(t[1:], np.inf), np.ones(len(t)), memory, np.arange(len(t)), t[:0])


def _of_splines(pieces: list[Array]) -> Groups:
    """Errors of splines, one through each of some rows (N,)."""
    from scipy.linalg import cholesky_banded  # slow to import

    found: list[tuple[Any, ...]] = []
    ends, errors, places = _DEGREE + 1, 0, 0
    for x in pieces:
        count = max(len(x), ends)
        first = np.arange(count - _DEGREE)
        knots = np.concatenate([x[:1].repeat(ends), x[2:-2], x[-1:].repeat(ends)])
        # The first two intervals between rows are of one polynomial, and so are the last two.
        row = (np.arange(count) - 1).clip(0, count - ends)
        # That through two or three rows has no differences of a higher order.
        none = np.diff(np.eye(ends), min(len(x), ends))
        T = np.hstack([_splines(knots, row[: len(x)] + _DEGREE, x), _EXACT * none])
        bands = np.zeros((ends, count))  # of TᵀT, from its last row and column to the first
        for j in range(ends):
            for i in range(ends - j):
                bands[j] += np.bincount(row + i, T[i] * T[i + j], count)
            bands[j, : count - j] = bands[j, : count - j][::-1]
            bands[j, count - j :] = 0.0
        L = cholesky_banded(bands, lower=True)[:, ::-1]
        shares, memory = 1.0 / L[0], -(L[1:] / L[0]).T
        found.append((
            x[np.append(0, first[1:] + 1)], shares, memory, first + errors, knots,
            first + _DEGREE + places,
        ))
        errors, places = errors + count, places + len(knots)
    starts, shares, memory, first, knots, knot = map(np.concatenate, zip(*found, strict=True))
    return Groups(starts, starts, shares, memory, first, starts[:0], knots, knot)


def _splines(knots: Array, knot: IntArray, t: Array) -> Array:
    """The B-splines (4, …) that are not zero at t (…,) from a ``knot`` (…,) on (Cox, de Boor)."""
    found = [np.ones(t.shape)]
    for k in range(1, _DEGREE + 1):
        left = [t - knots[knot + 1 - i] for i in range(k, 0, -1)]
        right = [knots[knot + i] - t for i in range(1, k + 1)]
        parts = [each / (a + b) for each, a, b in zip(found, left, right, strict=True)]
        found = [np.zeros(t.shape), *(a * part for a, part in zip(left, parts, strict=True))]
        for i, part in enumerate(parts):
            found[i] = found[i] + right[i] * part
    return np.asarray(found)
