"""Scalings under which the ranks of a model are judged, and units in which an observer sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import (
    Array,
    BoolArray,
    Coefficients,
    DescriptorSystem,
    IntArray,
    distinct,
)
from gpebo_cli.numerics.linalg import largest_over_time

_NOTHING = 1e-13  # entries below this, after scaling, are rounding
_ROUNDS, _LITTLE = 3, 1e-4  # of weighing entries by their squares; the least of these
_SCALED = 16  # rounds in which rows and columns are brought to the size one
_OPEN = 1e-10  # of the largest, added to squares: directions that are open come to nothing
_FULL = 400  # factors, up to which their equations are solved as full ones
_DECADES = 24.0  # of the unit of an unknown, at most: what rises later may be next to nothing yet
_BESIDE_TIES = 0.1234  # decades: where factors are rounded, halves and thirds are not at an edge


@dataclass(frozen=True, eq=False)
class Scaling:
    """Constant scalings under which ranks are judged: rows, states and the unit of time.

    Farads beside kiloohms would otherwise make an honest equation look like a rank deficiency.
    They are powers of two, so that scaling commits no rounding error.
    """

    rows: Array  # (n,)
    columns: Array  # (n,) x = columns * x̃
    time: float  # τ, derivatives are taken with respect to t/τ


class Units(NamedTuple):
    """Powers of ten in which what an observer sees is of comparable size, from its start alone.

    x = states * x̃, y = outputs * ỹ, θ = unknowns * θ̃; equations are divided by ``equations``.
    All are 1 where everything is within a decade of each other.
    """

    states: Array  # (n,)
    equations: Array  # (n,)
    outputs: Array  # (r,) the first one, of those that states connect, is 1
    unknowns: Array  # (q,)

    @classmethod
    def plain(cls, system: DescriptorSystem) -> Units:
        """Everything as it was written."""
        return cls(*map(np.ones, (system.n, system.n, system.r, system.q)))


def balance(c: Coefficients, mass: float = 1.0) -> Scaling:
    """Scalings that bring the entries of E/τ and A to comparable size, in any units.

    The logarithms of the factors minimise Σ (ln|E_ij| + r_i + c_j − τ)² + Σ (ln|A_ij| + r_i + c_j)²
    over all entries that are not zero, |·| being the largest over time: multiplying an equation, a
    state or the time by a number changes its factor alone. Terms of E count ``mass`` times.
    """
    sizes = np.array([largest_over_time(distinct(matrix)[0]) for matrix in (c.E, c.A)])
    places = sizes.nonzero()
    return balance_entries(sizes[places], places, len(sizes[0]), mass)


def balance_entries(
    sizes: Array, places: tuple[IntArray, ...], n: int, mass: float = 1.0
) -> Scaling:
    """:func:`balance` of n equations by entries of these sizes (e,): 0 of E or 1 of A, i and j."""
    kind, i, j = places
    counts = np.where(kind == 0, mass, 1.0)
    factors, *_ = _factors(sizes, i, j, kind - 1, (n, n), counts)
    powers = np.exp2(np.rint(factors / np.log(2.0)))
    return Scaling(powers[:n], powers[n:-1], float(powers[-1]))


def units_at(c: Coefficients) -> Units:
    """The units in which the entries of E/τ, A, F, C and H at one time are of comparable size.

    As in :func:`balance`, with outputs as further rows and unknowns as further columns. An entry
    that is zero counts by its first derivative that is not, and small ones, once it is seen which
    are, count little: a little damping tells nothing of a unit. A factor of all rows that hang
    together is left open: an output is as it was written.
    """
    (n, q), r = c.F.shape[2:], c.C.shape[2]
    entries = np.zeros((len(c.E), 2, n + r, n + q))
    entries[:, 0, :n, :n], entries[:, 1, :n, :n], entries[:, 1, :n, n:] = (
        np.abs(matrix[:, 0]) for matrix in (c.E, c.A, c.F)
    )
    entries[:, 1, n:, :n], entries[:, 1, n:, n:] = np.abs(c.C[:, 0]), np.abs(c.H[:, 0])
    order = (entries > 0.0).argmax(axis=0)
    sizes = np.choose(order, entries)
    kind, i, j = sizes.nonzero()
    order, sizes = (x[kind, i, j] for x in (order, sizes))
    factors, there, terms, logs = _factors(
        sizes, i, j, kind + order - 1, (n + r, n + q), np.ones(len(sizes))
    )
    for _ in range(_ROUNDS):
        counts = np.minimum(np.maximum(np.exp(2.0 * (terms @ factors + logs)), _LITTLE), 1.0)
        factors = terms.nearest(counts, logs)
    factors /= np.log(10.0)
    linked = np.zeros((n + r, n + q), dtype=bool)
    linked[i[there], j[there]] = True
    outputs_first = np.array([*range(n, n + r), *range(n)], dtype=np.intp)
    first, one = _first_of_each_part(linked, outputs_first), linked.argmax(axis=0)
    start = _references(factors[: n + r], first, (first >= n) == (np.arange(n + r) >= n))
    of_row = np.rint(start - factors[: n + r] + _BESIDE_TIES)
    of_column = np.rint(factors[n + r : -1] + start[one] + _BESIDE_TIES) - of_row[first][one]
    of_column[n:] = np.clip(of_column[n:], -_DECADES, _DECADES)
    rows, columns = 10.0 ** (of_row - of_row[first]), 10.0**of_column
    return Units(columns[:n], rows[:n], rows[n:], columns[n:])


def _factors(
    sizes: Array, i: IntArray, j: IntArray, order: IntArray, shape: tuple[int, int], counts: Array
) -> tuple[Array, BoolArray, _Terms, Array]:
    """Logarithms of the factors (a + b + 1,) of a matrix (a, b) with entries of these sizes (e,).

    Their rows i, columns j and powers of τ, and how often their squares count. Beside the factors
    stands which of the entries count, not those that turn out to be rounding, their terms and
    logarithms.
    """
    there = sizes > 0.0
    while True:
        of_time, logs = order[there].astype(np.float64), np.log(sizes[there])
        terms = _Terms(i[there], shape[0] + j[there], of_time, sum(shape) + 1)
        factors = terms.nearest(counts[there], logs)
        rest = terms.counting(factors, logs)
        if rest.all():
            return factors, there, terms, logs
        there[there] = rest  # once more without what turned out to be rounding


class _Terms(NamedTuple):
    """What r, c and τ contribute to the logarithms of e entries that are there."""

    rows: IntArray  # (e,) of each entry
    columns: IntArray  # (e,) after all rows
    of_time: Array  # (e,)
    total: int  # a + b + 1: how many factors there are

    def __matmul__(self, factors: Array) -> Array:
        """What the factors (a + b + 1,) add to each logarithm, (e,)."""
        found: Array = factors[self.rows] + factors[self.columns] + self.of_time * factors[-1]
        return found

    def counting(self, factors: Array, logs: Array) -> BoolArray:
        """Which of the entries, with these logarithms (e,), are no rounding beside others."""
        entries = np.exp(self @ factors + logs)
        if entries.min(initial=1.0) > _NOTHING * entries.max(initial=1.0):
            return np.ones(len(entries), dtype=bool)
        most = np.zeros(self.total)  # of each row and column
        for place in (self.rows, self.columns):
            np.maximum.at(most, place, entries)
        return np.asarray(entries > _NOTHING * np.sqrt(most[self.rows] * most[self.columns]))

    def transposed(self, values: Array) -> Array:
        """The product of the transpose with values (e,), (a + b + 1,)."""
        of_rows, of_columns = (
            np.bincount(which, values, self.total) for which in (self.rows, self.columns)
        )
        found = (of_rows + of_columns).astype(np.float64)  # without entries bincount has integers
        found[-1] = self.of_time @ values
        return found

    def nearest(self, counts: Array, logs: Array) -> Array:
        """The factors that leave least of logarithms (e,), nearly those of the least norm.

        Squares count so often (e,). Singular values of a thousand states would take longer than a
        run.
        """
        n, right = self.total, -self.transposed(logs * counts)
        with_time, own = (self.transposed(x * counts) for x in (self.of_time, 1.0))
        own[-1] = with_time[-1]
        own += _OPEN * counts.max(initial=1.0)
        every, last, with_time[-1] = np.arange(n), np.full(n, n - 1), 0.0
        values = np.concatenate([counts, counts, own, with_time, with_time])
        down = np.concatenate([self.rows, self.columns, every, every, last])
        across = np.concatenate([self.columns, self.rows, every, last, every])
        if n <= _FULL:
            whole = np.bincount(down * n + across, values, n * n).reshape(n, n)
            return np.asarray(np.linalg.solve(whole, right), dtype=np.float64)
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import splu

        return np.asarray(splu(csc_array((values, (down, across)), shape=(n, n))).solve(right))


def _first_of_each_part(linked: BoolArray, order: IntArray) -> IntArray:
    """For each row (a,) the first one, in this order, of those that columns link it to."""
    place = np.empty(len(order), dtype=np.intp)
    place[order] = np.arange(len(order))
    i, j = linked.nonzero()
    while True:
        of_column = np.full(linked.shape[1], len(order))
        np.minimum.at(of_column, j, place[i])
        nearer = place.copy()
        np.minimum.at(nearer, i, of_column[j])
        nearer = nearer[order[nearer]]  # a long chain takes few rounds
        if (nearer == place).all():
            return order[place]
        place = nearer


def _references(decades: Array, first: IntArray, counted: BoolArray) -> Array:
    """From where rows (a,) of these ``decades`` are counted in whole ones: (a,) alike in a part.

    Opposite of the widest gap that the ``counted`` rows of the part leave between what they are
    beside whole decades. So no order of them decides, nor a unit, which moves whole ones alone.
    """
    found = np.empty(len(decades))
    for row in np.unique(first):
        part = first == row
        turns = np.sort((decades[part & counted] + _BESIDE_TIES) % 1.0)
        gaps = np.diff(turns, append=turns[0] + 1.0)
        widest = int(np.round(gaps, 6).argmax())  # the first of equals
        found[part] = turns[widest] + 0.5 * gaps[widest] + 0.5 - _BESIDE_TIES
    return found


def scales_of(E: Array, A: Array) -> tuple[Array, Array, float]:
    """Scales of rows and columns (n,) and of time by which E/τ and A (n, n) are of the size one.

    By largest entries: means of logarithms, as in :func:`balance`, count the smallest
    ones as much, and of full matrices those are rounding (the driven cavity is then undecided).
    They are powers of two, so that scaling commits no rounding error.
    """
    E, A = np.abs(E), np.abs(A)
    r, c, time = np.zeros(len(E)), np.zeros(len(E)), 0.0
    for _ in range(_SCALED):
        e, a = (X * np.exp2(r[:, None] + c) for X in (E * np.exp2(-time), A))
        there = (e.max(axis=1) > 0.0) & (a.max(axis=1) > 0.0)
        if there.any():
            time += float(np.median(np.log2(e.max(axis=1)[there] / a.max(axis=1)[there])))
        both = np.maximum(e, a)
        size = [np.log2(np.where(x > 0.0, x, 1.0)) for x in (both.max(axis=1), both.max(axis=0))]
        r, c = r - 0.5 * size[0], c - 0.5 * size[1]
    return np.exp2(np.rint(r)), np.exp2(np.rint(c)), float(np.exp2(np.rint(time)))
