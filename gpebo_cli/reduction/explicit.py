"""From a large sparse descriptor system of any index to x' = M x + g, by elimination.

Row operations bring E to the form [I W; 0 0], x_J + W x_C → x_J takes W away, and then every
equation without derivatives gives one state by the others. One that has no algebraic state left is
a constraint: it gives a differential state, whose own equation becomes

    0 = (R_j + f_j) + Σ_k (α_k' x_k + α_k (R_k + f_k)) + φ',        x_j = −Σ_k α_k x_k − φ

with x_k' = R_k + f_k. All entries are Taylor coefficients at many times at once, so these
derivatives are exact, and entries that are always zero cost nothing. Which pivots may be taken is
judged over all times: one that comes near zero, or an entry that is neither rounding nor clear of
it, is left to the derivative array, which has singular values to tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.model.entries import Entries
from gpebo_cli.model.expressions import jets
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.taylor import Sparse
from gpebo_cli.reduction.scaling import Scaling, balance_entries

_STEADY = 0.2  # a pivot keeps this share of its largest value at all times
_SOUND = 0.1  # of the largest entry of its row, in units of the states
_ROUNDING, _CLEAR = 1e-13, 1e-9  # of what an entry is the difference of: zero below, sure above
_AT_ONCE = 32  # times, whose entries are there twice while they are copied
_FILL = 40  # entries per equation; with more of them, a matrix is not sparse

_NOTHING = np.zeros((1, 1))

Row = dict[int, Array]


class UndecidedError(Exception):
    """Elimination does not decide the structure."""


class MoreOrdersError(UndecidedError):
    """A derivative is needed of an order that was not evaluated."""


@dataclass(frozen=True, eq=False)
class Explicit:
    """x_I' = M x_I + f at N times, and all other states from these."""

    states: IntArray  # (d,) I
    matrix: Sparse  # M
    f: Array  # (N or 1, d)
    # x_i −= Σ a_k x_k + φ one after the other: i, {k: a (N or 1,)}, φ (N or 1,)
    others: tuple[tuple[int, Row, Array], ...]
    shifts: int  # how many, the last of these, are x_j −= Σ W x_k: together under a derivative
    mu: int
    state_units: Array  # (n,)
    pivot: float  # the smallest one at any time, relative to its row
    moved: Mapping[str, BoolArray]  # of which values (v,) of E and A derivatives may be needed
    known: float = 0.0  # sizes of what is known in the states
    loss: float = 1.0  # by how much elimination may have made rounding grow

    @property
    def d(self) -> int:
        """Number of differential equations."""
        return len(self.states)

    @property
    def units(self) -> Array:
        """Units of x_I (d,)."""
        return self.state_units[self.states]

    def reduced(self, x: Array) -> Array:
        """x_I (d,) of a state (n,)."""
        shifted = x.copy()
        for j, row, _ in self.others:
            shifted[j] += sum(w[0] * x[k] for k, w in row.items())
        return shifted[self.states]

    def at_first(self) -> Explicit:
        """What gives the states at the first of the times."""
        return replace(self, others=tuple(
            (i, {k: a[:1] for k, a in row.items()}, phi[:1]) for i, row, phi in self.others
        ))

    def states_from(self, z: Array) -> Array:
        """x (N, n, c) from x_I (N, d, c)."""
        x = np.zeros((len(self.state_units), len(z), z.shape[2]))
        x[self.states] = z.swapaxes(0, 1)
        for i, row, known in self.others:
            x[i] -= known[:, None]
            for k, a in row.items():
                x[i] -= a[:, None] * x[k]
        return x.swapaxes(0, 1)

    def sizes_from(self, size: Array) -> Array:
        """What states (n, c) are made of at most, from sizes of x_I (d, c)."""
        x = np.zeros((len(self.state_units), size.shape[1]))
        x[self.states] = size
        for i, row, _ in self.others:
            for k, a in row.items():
                x[i] += np.abs(a).max() * x[k]
        return x


def product(a: Array, b: Array) -> Array:
    """Of (orders, N or 1) each, to the order that both are known to."""
    return np.array(jets.multiply(list(a), list(b), min(len(a), len(b)) - 1))


def _reciprocal(a: Array) -> Array:
    return np.array(jets.divide([1.0], list(a), len(a) - 1))


def _sum(a: Array, b: Array) -> Array:
    orders = min(len(a), len(b))
    return np.asarray(a[:orders] + b[:orders])


def _derivative(a: Array) -> Array:
    if len(a) < 2:
        raise MoreOrdersError
    return np.array(jets.derivative(list(a), len(a) - 2))


def _size(a: Array) -> float:
    return float(np.abs(a[0]).max())


class _Equations:
    """Rows of entries; one becomes a mapping where it is touched."""

    def __init__(self, found: Entries, name: str, known: Row, units: Array) -> None:
        self.found, self.name, n, places = found, name, len(units), found.places[name]
        order = np.lexsort(places[::-1])
        self.values, self.order = getattr(found.values, name), found.which(name)[order]
        self.place = [place[order] for place in places]  # rows, and columns
        self.first = np.searchsorted(self.place[0], np.arange(n + 1))
        self.known = dict(known)  # in those rows that have something
        self.units = units
        self.rows: dict[int, Row] = {}  # those that were touched
        self.divided = np.full(n, -1)  # by which value of E a row waits to be divided
        self.least = 1.0  # pivot so far, relative to its row
        by_column = np.argsort(self.place[1], kind="stable")
        self._in_column = self.place[0][by_column]
        self._column = np.searchsorted(self.place[1][by_column], np.arange(n + 1))
        self._where: dict[int, set[int]] = {}

    def row(self, i: int) -> Row:
        """Row i, to be changed."""
        if i not in self.rows:
            part = slice(self.first[i], self.first[i + 1])
            values = list(self.found.jets(self.name, self.order[part]).transpose(2, 0, 1).copy())
            if self.divided[i] >= 0:
                values = [product(v, self._factor(i)) for v in values]
            self.rows[i] = dict(zip(self.place[1][part].tolist(), values, strict=True))
        return self.rows[i]

    def where(self, k: int) -> set[int]:
        """The rows that have an entry k, to be changed."""
        if k not in self._where:
            part = slice(self._column[k], self._column[k + 1])
            self._where[k] = set(self._in_column[part].tolist())
        return self._where[k]

    def _factor(self, i: int) -> Array:
        return _reciprocal(self.found.jets("E", self.divided[i, None])[:, :, 0])

    def divide(self, rows: IntArray, pivots: IntArray) -> None:
        """Divide untouched rows (r,) by values of E (r,), their entries when needed."""
        self.divided[rows] = pivots
        for i in self.known.keys() & set(rows.tolist()):
            self.known[i] = product(self.known[i], self._factor(i))

    def moved(self) -> BoolArray:
        """Which of the values (v,) are in rows that were touched."""
        found = np.zeros(self.values.shape[2], dtype=bool)
        for i in self.rows:
            found[self.order[self.first[i] : self.first[i + 1]]] = True
        return found

    def assembled(self, chosen: IntArray, states: IntArray) -> Sparse:
        """Rows ``chosen`` (d,), with columns ``states`` (d,)."""
        position = np.full(len(self.units), -1)
        position[chosen] = np.arange(len(chosen))
        column = np.full(len(self.units), -1)
        column[states] = np.arange(len(states))
        plain = position[self.place[0]] >= 0
        plain[np.isin(self.place[0], list(self.rows))] = False
        touched = [
            (int(position[i]), k, value[0]) for i, row in self.rows.items() if position[i] >= 0
            for k, value in row.items()
        ]
        i = np.concatenate([position[self.place[0][plain]], [t[0] for t in touched]])
        j = np.concatenate([column[self.place[1][plain]], column[[t[1] for t in touched]]])
        values = self.values, self.found.values.E, *(t[2][None] for t in touched)
        count = max(value.shape[1] for value in values)
        order = np.argsort(i, kind="stable")
        place = np.empty(len(i), dtype=np.intp)  # of each entry in the end
        place[order] = np.arange(len(i))
        of_plain = np.zeros(len(i), dtype=np.intp)
        of_plain[place[: plain.sum()]] = self.order[plain]
        factor = self.divided[self.place[0][plain]]
        waiting, factor = place[: plain.sum()][factor >= 0], factor[factor >= 0]
        entries = np.empty((count, len(i)))
        E, of_all = self.found.values.E[0], (count, self.values.shape[2])
        np.broadcast_to(self.values[0], of_all).take(
            of_plain, axis=1, out=entries, mode="clip"  # another mode would copy
        )
        for first in range(0, count, _AT_ONCE) if len(waiting) else ():
            some = slice(first, first + _AT_ONCE)
            entries[some, waiting] /= (E[some] if len(E) > 1 else E)[:, factor]
        for k, (_, _, value) in zip(place[plain.sum() :].tolist(), touched, strict=True):
            entries[:, k] = value
        rows = np.searchsorted(i[order], np.arange(len(chosen) + 1))
        return Sparse(rows, j[order].astype(np.intp), entries)

    def forcing(self, chosen: IntArray) -> Array:
        """What is known in the rows ``chosen`` (d,), (N or 1, d)."""
        known = [(p, self.known[i][0]) for p, i in enumerate(chosen.tolist()) if i in self.known]
        f = np.zeros((max((len(value) for _, value in known), default=1), len(chosen)))
        for p, value in known:
            f[:, p] = value
        return f

    def add(self, i: int, factor: Array, row: Row, known: Array | None) -> None:
        """Add a multiple of a row to row i."""
        into = self.row(i)
        for k, value in row.items():
            more = product(factor, value)
            old = into.get(k)
            if old is None:
                into[k] = more
                self.where(k).add(i)
                continue
            new = _sum(old, more)
            before, after = max(_size(old), _size(more)), _size(new)
            if after > _CLEAR * before or before == 0.0:
                into[k] = new
            elif after <= _ROUNDING * before and np.abs(new).max() <= _ROUNDING * max(
                np.abs(old).max(), np.abs(more).max()
            ):
                del into[k]
                self.where(k).discard(i)
            else:
                raise UndecidedError
        if len(into) > _FILL + len(self.units) // 4:
            raise UndecidedError
        if known is not None:
            self.tell(i, product(factor, known))

    def tell(self, i: int, known: Array) -> None:
        """Add something known to row i."""
        self.known[i] = _sum(self.known[i], known) if i in self.known else known

    def add_derivatives(self, i: int, row: Row, known: Array | None) -> None:
        """Add Σ a_k' x_k and φ', of entries that move, to row i."""
        for k, a in row.items():
            if a.shape[1] > 1 or (a[1:] != 0.0).any():
                changes = _derivative(a)
                self.add(i, np.eye(len(changes), 1), {k: changes}, None)
        if known is not None:
            self.tell(i, _derivative(known))

    def pivot(self, i: int, allowed: Iterable[int]) -> int:
        """A state among ``allowed`` that row i can give, in as few other rows as possible."""
        row = self.row(i)
        sizes = {k: _size(row[k]) * self.units[k] for k in allowed}
        largest = max(sizes.values(), default=0.0)
        smallest = {k: float(np.abs(row[k][0]).min()) * self.units[k] for k in sizes}
        fit = [
            k for k, size in sizes.items()
            if size >= _SOUND * largest and smallest[k] >= _STEADY * size > 0.0
        ]
        if not fit:  # as of an equation that says nothing
            raise UndecidedError
        chosen = min(fit, key=lambda k: (len(self.where(k)), -sizes[k], k))
        self.least = min(self.least, smallest[chosen] / largest)
        return chosen

    def put(self, i: int, k: int) -> Array:
        """The entry k of row i, which is taken out of it."""
        self.where(k).discard(i)
        return self.row(i).pop(k)


def sizes_of(found: Entries, name: str) -> Array:
    """The largest of each entry over time, (e,)."""
    return largest_over_time(getattr(found.values, name)[0])[found.which(name)]


def scaling_of(found: Entries, n: int) -> Scaling:
    """:func:`balance` of the entries of n equations."""
    sizes = [sizes_of(found, name) for name in "EA"]
    (i, j), kind = np.hstack([found.places[name] for name in "EA"]), [*map(len, sizes)]
    return balance_entries(np.concatenate(sizes), (np.repeat([0, 1], kind), i, j), n)


def explicit_form(found: Entries, scaling: Scaling, f: Row) -> Explicit:
    """Eliminate, with the model at N times (or UndecidedError).

    ``f`` are the Taylor coefficients (orders, N or 1) of what is known in those equations in
    which there is something.
    """
    units = scaling.columns
    A = _Equations(found, "A", f, units)
    E = _Equations(found, "E", {}, units)
    equation_of = _leading(E, A)
    shifts = _shifted(E, A, equation_of)
    count = len(shifts)
    others, mu = _without_others(A, equation_of)
    states = np.array(sorted(equation_of), dtype=np.intp)
    chosen = np.array([equation_of[k] for k in states.tolist()], dtype=np.intp)
    moved, by = {"E": E.moved(), "A": A.moved()}, A.divided[[*A.rows]]
    moved["E"][by[by >= 0]] = True
    left = tuple(
        (i, {k: a[0].copy() for k, a in row.items()}, phi[0].copy())
        for i, row, phi in (*reversed(others), *shifts)
    )
    del others, shifts
    matrix = A.assembled(chosen, states)
    del A.rows  # what is known comes in the place of that
    return Explicit(
        states, matrix, A.forcing(chosen), left,
        count, mu, units, min(E.least, A.least), moved,
    )


def _leading(E: _Equations, A: _Equations) -> dict[int, int]:
    """Bring E to [I W; 0 0]; which equation has x_k' alone, by k."""
    n, (rows, columns) = len(E.units), E.place
    single = np.bincount(rows, minlength=n)[rows] == 1
    single &= np.bincount(columns, minlength=n)[columns] == 1
    size = np.abs(E.values[0])
    least, most = size.min(axis=0)[E.order], size.max(axis=0)[E.order]
    single &= (least >= _STEADY * most) & (most > 0.0)
    if len(size) > 1 or (size != 1.0).any():
        A.divide(rows[single], E.order[single])
    del size
    equation_of = dict(zip(columns[single].tolist(), rows[single].tolist(), strict=True))
    left: list[int] = sorted(set(rows[~single].tolist()))
    while left:
        i = min(left, key=lambda i: len(E.row(i)))
        left.remove(i)
        if not E.row(i):
            continue
        k = E.pivot(i, [k for k in E.row(i) if k not in equation_of])
        factor = _reciprocal(E.row(i)[k])
        E.rows[i] = {j: product(factor, v) for j, v in E.row(i).items()}
        A.rows[i] = {j: product(factor, v) for j, v in A.row(i).items()}
        if i in A.known:
            A.known[i] = product(factor, A.known[i])
        rest = {j: v for j, v in E.rows[i].items() if j != k}
        for other in [o for o in E.where(k) if o != i]:
            times = -E.put(other, k)
            E.add(other, times, rest, None)
            A.add(other, times, A.rows[i], A.known.get(i))
        equation_of[k] = i
    return equation_of


def _shifted(
    E: _Equations, A: _Equations, equation_of: dict[int, int]
) -> list[tuple[int, Row, Array]]:
    """Take W away: x_j = x̃_j − Σ W x_k, x̃_j' = … + W' x_k."""
    shifts = []
    for j, i in equation_of.items():
        if len(E.rows.get(i, ())) < 2:  # x_j' alone
            continue
        W = {k: w for k, w in E.rows[i].items() if k != j}
        shifts.append((j, W, _NOTHING))
        for other in list(A.where(j)):
            A.add(other, -A.row(other)[j], W, None)
        A.add_derivatives(i, W, None)
    return shifts


def _without_others(
    A: _Equations, equation_of: dict[int, int]
) -> tuple[list[tuple[int, Row, Array]], int]:
    """Use every equation without derivatives to express one state by others."""
    level = dict.fromkeys(set(range(len(A.units))) - set(equation_of.values()), 0)
    others: list[tuple[int, Row, Array]] = []
    mu = 0
    while level:
        counts = {
            i: sum(k not in equation_of for k in A.row(i)) or len(A.units) for i in level
        }
        least = min(counts.values())
        for i in [i for i, count in counts.items() if count == least]:
            free = [k for k in A.row(i) if k not in equation_of]
            if not free and least < len(A.units):
                continue
            c = A.pivot(i, free or A.row(i))
            for k in A.row(i):
                A.where(k).discard(i)
            row, known = A.row(i), A.known.get(i)
            A.rows[i] = {}
            factor = _reciprocal(row.pop(c))
            row = {k: product(factor, v) for k, v in row.items()}
            if known is not None:
                known = product(factor, known)
            for other in list(A.where(c)):
                A.add(other, -A.put(other, c), row, known)
            others.append((c, row, _NOTHING if known is None else known))
            own = level.pop(i)
            mu = max(mu, own)
            if not free:  # the equation of x_c' becomes one without derivatives
                j = equation_of.pop(c)
                A.add_derivatives(j, row, known)
                for k, a in row.items():
                    A.add(j, a, A.row(equation_of[k]), A.known.get(equation_of[k]))
                level[j] = own + 1
    return others, mu
