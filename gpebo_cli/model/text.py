"""The matrices of a plant given as text: constants, expressions on one tape, tables as inputs."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import comb
from types import MappingProxyType

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import (
    MATRIX_NAMES,
    Array,
    BoolArray,
    Coefficients,
    CoefficientSource,
    DescriptorSystem,
    IntArray,
)
from gpebo_cli.model.entries import Entries, Places, entries_of
from gpebo_cli.model.expressions.bounds import (
    Bounds,
    Cells,
    blurred,
    breakpoints,
    resolved,
    resolved_along,
    switched,
    with_others,
)
from gpebo_cli.model.expressions.intervals import Interval, polynomials
from gpebo_cli.model.expressions.nodes import divisors_of
from gpebo_cli.model.expressions.syntax import Expression, shorten
from gpebo_cli.model.expressions.tape import Assembly, Tape, aside, on_their_side, record
from gpebo_cli.schema import instant

# Shape of a matrix, and its entries by position, row after row; what is not there is 0.
MatrixEntries = tuple[tuple[int, ...], dict[int, Expression]]

# Of its size before and after: a divisor that comes so near zero touches it.
_TOUCHED = 1e-12
_EPS = float(np.finfo(float).eps)
_KEPT = 16  # edges of cells
_ROUNDING = 1e-12  # of the largest time: by how much an experiment may exceed a table
_LOOKS = np.linspace(0.0, 1.0, 9)  # of a piece, where one looks at the sign of what switches


@dataclass(frozen=True, eq=False)
class Piecewise:
    """A function of time, one polynomial from each sample to the next."""

    where: str  # for messages
    t: Array  # (N,)
    pieces: Array  # (degree + 1, N - 1), coefficients of powers of t − t_k
    corners: Array  # samples (C,) where neighbouring pieces are not one polynomial

    def cover(self, t: Array) -> None:
        """Refuse times t (M,) beyond the samples (ConfigError)."""
        first, last = self.t[0], self.t[-1]
        slack = _ROUNDING * max(abs(first), abs(last))
        if len(t) and (t.min() < first - slack or t.max() > last + slack):
            beyond = t.min() if t.min() < first - slack else t.max()
            raise ConfigError(
                f"{self.where} is of t = {instant(first, 6)} to {instant(last, 6)}, and the "
                f"experiment needs t = {instant(beyond, 6)}; set time.start and time.horizon, or "
                "give a longer table"
            )

    def taylor(self, t: Array, order: int, inside: Array) -> Array:
        """Taylor coefficients (order + 1, M) at times t (M,) (ConfigError)."""
        self.cover(t)
        k = np.clip(np.searchsorted(self.t, inside, side="right") - 1, 0, len(self.t) - 2)
        since, degree = t - self.t[k], len(self.pieces) - 1
        found = np.zeros((order + 1, len(t)))
        for j in range(min(order, degree) + 1):
            for i in range(degree, j - 1, -1):  # Horner's rule
                found[j] = found[j] * since + comb(i, j) * self.pieces[i, k]
        return found


@dataclass(frozen=True, eq=False)
class TextCoefficients:
    """The matrices of a plant given as text; a ``CoefficientSource``.

    All entries that depend on time are evaluated together, equal ones once. Matrices that do not
    depend on time come as read-only broadcast arrays.
    """

    assembly: Assembly  # of the matrices in the order of MATRIX_NAMES
    unknowns: Tape  # theta on its own
    signals: Mapping[str, frozenset[str]]  # what a matrix depends on, by the same names
    outputs: frozenset[str]
    name: str
    divisors: Tape  # continuous ones of outputs, with the text they stand in
    restricted: TextCoefficients | None = None  # ``of_time``, where that is something else
    cells: Array | None = None  # (number,) edges of cells that are short for another reason
    tables: Mapping[int, Piecewise] = field(default_factory=dict)  # for inputs, by their numbers
    # What others have found out about these matrices, by what was asked: they never change.
    kept: dict[object, object] = field(default_factory=dict, init=False)
    # Breakpoints (number,) by the span, and edges (number,) of cells by the edges asked for.
    _breakpoints: dict[tuple[float, float], Array] = field(default_factory=dict, init=False)
    # (number,)
    _resolved: dict[bytes, tuple[Array, bool]] = field(default_factory=dict, init=False)

    @property
    def tape(self) -> Tape:
        """What the entries that depend on time are computed by."""
        return self.assembly.tape

    @cached_property
    def constant(self) -> frozenset[str]:
        """Those of ``MATRIX_NAMES`` that do not depend on time."""
        moving = {MATRIX_NAMES[k] for k in self.assembly.targets[:, 0].tolist()}
        return frozenset(MATRIX_NAMES) - moving - ({"u"} if self.tables else set())

    @cached_property
    def zero(self) -> frozenset[str]:
        """Those of ``constant`` that vanish."""
        fixed = zip(MATRIX_NAMES, self.assembly.fixed, strict=True)
        return self.constant.intersection(name for name, matrix in fixed if not matrix.any())

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        """All matrices at the times ``t`` (N,) in seconds, to ``order``; see the protocol.

        ConfigError: an entry without a finite value or derivative; names it and the time. Or a
        matrix depends on an output, and there are no signals.
        """
        if signals is None:
            for matrix, names in self.signals.items():
                if not names.isdisjoint(self.outputs):
                    raise ConfigError(
                        f"plant {self.name}: {matrix} depends on the output "
                        f"{min(names & self.outputs)}, which is not known here"
                    )
        t = np.asarray(t, dtype=np.float64)
        if signals is None and self.tables:
            found, signals = self._tabled(t, order, inside)
            if not self.signals:
                return found.along(signals)
        if signals is None:
            return Coefficients._make(self.assembly.taylor(t, order, self._amid(inside)))
        found = Coefficients._make(self.assembly.taylor(t, order, inside, signals))
        if self.divisors.outputs:
            self._refuse_crossings(t, inside, signals)
        return found.along(signals)

    def _amid(self, inside: Array | None) -> Array | None:
        """The times in the middle between breakpoints in place of those ``inside`` (N,).

        Nothing switches between two of them, but beside one rounding of an argument might: where
        that turns around by little more than its rounding, an element may be no longer than this.
        """
        if inside is None or not inside.size:
            return inside
        first, last = float(inside.min()), float(inside.max())
        for (start, stop), cuts in self._breakpoints.items():
            if len(cuts) and start <= first and last <= stop:
                edges = np.concatenate([[start], cuts, [stop]])
                k = np.searchsorted(cuts, inside, side="right")
                return np.asarray(0.5 * (edges[k] + edges[k + 1]))
        return inside

    def _tabled(self, t: Array, order: int, inside: Array | None) -> tuple[Coefficients, Array]:
        """What the text says without tables, and [u; 0] (order + 1, N, m + r) with them."""
        inside = t if inside is None else inside

        def told(t: Array, there: Array, inside: Array, order: int) -> tuple[Coefficients, Array]:
            found = Coefficients._make(self.of_time.assembly.taylor(t, order, inside))
            # Nothing depends on y.
            nothing = np.zeros((order + 1, len(t), len(self.outputs)))
            known = np.concatenate([found.u, nothing], axis=2)
            for k, table in self.tables.items():
                known[:, :, k] = table.taylor(there, order, inside)
            return found, known

        arguments = self._of_tables if self._of_tables.outputs else None
        there = on_their_side(arguments, t, inside, lambda t, at: told(t, t, at, 0)[1][0])
        return told(t, there, inside, order)

    @cached_property
    def _of_tables(self) -> Tape:
        """Arguments of sign, abs, min and max that follow tables, and no outputs."""
        followers = self.tape.following(self.tables) & self.tape.of_time
        return self.tape.of([s.argument for s in self.tape.switches if s.argument in followers])

    def _refuse_crossings(self, t: Array, inside: Array | None, signals: Array) -> None:
        """Refuse a divisor that changes its sign between two times, or nearly vanishes at one."""
        ascending = np.argsort(t, kind="stable")
        values = self.divisors.taylor(t, 0, inside, signals[:1])[0][ascending]
        size = np.abs(values)
        before = np.maximum.accumulate(size)
        after = np.maximum.accumulate(size[::-1])[::-1]
        touched = size[:-1] <= _TOUCHED * np.minimum(before, after)[:-1]
        crossed = np.argwhere((values[1:] * values[:-1] < 0.0) | (touched & (size[:-1] > 0.0)))
        if len(crossed):
            k, j = crossed[0]
            where, (before, after) = self.divisors.labels[j], values[k : k + 2, j]
            first, then = t[ascending][k : k + 2]
            at = first
            if before * after < 0.0:
                at += (then - first) * before / (before - after)
            raise ConfigError(
                f"{where.where} = {shorten(where.text)} divides by something that passes through "
                f"zero near t = {instant(at, 6)}"
            )

    def entries(
        self, t: Array, order: int, inside: Array | None = None,
        moved: Mapping[str, BoolArray] = MappingProxyType({}),
    ) -> Entries:
        """All entries that are not zero at the times t (N,), as ``model.entries`` has them."""
        if self.tables:
            return entries_of(self.taylor(t, order, inside), self.constant)
        apart, places, shared = self._apart
        moved = {name: some for name, some in moved.items() if order and name not in self.constant}
        inside, jets = self._amid(inside), {}
        values = Coefficients(*apart.of(MATRIX_NAMES, moved).taylor(t, order, inside))
        if moved:
            whole = Coefficients(*apart.taylor(t, 0, inside))
            for name, some in moved.items():
                jets[name] = np.where(some, some.cumsum() - 1, -1), getattr(values, name)
                values = values._replace(**{name: getattr(whole, name)})
        once = {name: getattr(values, name)[:, :1] for name in self.constant}
        return Entries(values._replace(**once), places, shared, jets)

    @cached_property
    def _apart(self) -> tuple[Assembly, dict[str, Places], dict[str, IntArray]]:
        """Entries that are not zero, equal ones of a matrix once; where they are, and which."""
        targets, fixed = self.assembly.targets.copy(), []
        places: dict[str, Places] = {}
        shared: dict[str, IntArray] = {}
        for k, (name, matrix) in enumerate(zip(MATRIX_NAMES, self.assembly.fixed, strict=True)):
            known, moving = np.flatnonzero(matrix), np.flatnonzero(targets[:, 0] == k)
            there = np.concatenate([known, targets[moving, 1]])
            places[name] = np.unravel_index(there, matrix.shape)
            values, seen = matrix.flat[known], dict[object, int]()
            which = [*values.tolist(), *((self.tape.outputs[j],) for j in moving.tolist())]
            keys = which if matrix.ndim > 1 else range(len(which))
            shared[name] = np.array([seen.setdefault(key, len(seen)) for key in keys], np.intp)
            targets[moving, 1] = shared[name][len(known) :]
            fixed.append(np.zeros(len(seen)))
            fixed[k][shared[name][: len(known)]] = values
        return Assembly(self.tape, targets, tuple(fixed)), places, shared

    @property
    def of_time(self) -> TextCoefficients:
        """The same with zero for entries that depend on outputs."""
        return self.restricted or self

    def truth(self, t: Array) -> Array:
        """True values of the unknowns at the times ``t`` (N,), shape (N, q)."""
        return np.asarray(self.unknowns.taylor(t, 0)[0])

    def breakpoints(self, start: float, stop: float) -> Array:
        """Times strictly between ``start`` and ``stop``, sorted, of jumps and kinks.

        Samples of tables where they jump or bend, and what they switch, are among them.
        """
        if (start, stop) not in self._breakpoints:
            found = breakpoints(self.tape, start, stop)
            if self.tables:
                found = self._with_corners(found, start, stop)
            self._breakpoints[start, stop] = found
        return self._breakpoints[start, stop].copy()

    def _with_corners(self, found: Array, start: float, stop: float) -> Array:
        """Breakpoints (number,) of the text with those of tables."""
        for table in self.tables.values():
            table.cover(np.array([start, stop]))
        corners = np.concatenate([table.corners for table in self.tables.values()])
        found = np.union1d(found, corners[(corners > start) & (corners < stop)])
        if not self._of_tables.outputs or not start < stop:
            return found
        edges, _ = self._along_tables(np.concatenate([[start], found, [stop]]))
        t = edges[:-1, None] + np.diff(edges)[:, None] * _LOOKS
        t = aside(t, t.mean(axis=1, keepdims=True)).ravel()  # each in its own piece
        new = switched(self._of_tables, t, lambda t, order: self._tabled(t, order, t)[1])
        return with_others(np.array([start, *found, stop]), new)[1:-1]

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        """Edges of cells in which nothing narrow hides, from edges (K + 1,); see the protocol."""
        key = edges.tobytes()
        if key not in self._resolved:
            if self.cells is not None:
                inner = (self.cells > edges[0]) & (self.cells < edges[-1])
                edges = np.union1d(edges, self.cells[inner])
            if len(self._resolved) >= _KEPT:
                self._resolved.clear()  # a stream asks for ever new ones
            edges, sure = resolved(self._bounds, edges)
            edges, also = self._along_tables(edges) if self.tables else (edges, True)
            self._resolved[key] = edges, sure and also
        return self._resolved[key]

    def _along_tables(self, edges: Array) -> tuple[Array, bool]:
        """:meth:`resolved` for what follows tables, from edges (K + 1,): they are polynomials."""
        def cells(low: Array, high: Array) -> list[list[Interval] | None]:
            half = 0.5 * (high - low)
            jets = {
                k: polynomials(table.taylor(low + half, len(table.pieces) - 1, low + half), half)
                for k, table in self.tables.items()
            }
            return [jets.get(k) for k in range(self.m)]

        return self.along(cells, self.tables, edges)

    def along(self, signals: Cells, numbers: Container[int], edges: Array) -> tuple[Array, bool]:
        """:meth:`resolved` for what follows the signals of these numbers, whose cells are given.

        Other inputs are their functions of time; what follows other outputs has no cells. From
        edges (K + 1,).
        """
        unknown = [k for k in range(self.m, self.m + len(self.outputs)) if k not in numbers]
        followers = self.tape.following(numbers) - self.tape.following(unknown)
        return resolved_along(self.tape, followers, signals, edges)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return int(self.assembly.fixed[MATRIX_NAMES.index("u")].size)

    @cached_property
    def switches(self) -> Tape:
        """Arguments of sign, abs, min and max that follow outputs."""
        places = [s.argument for s in self.tape.switches]
        return self.tape.of([place for place in places if place not in self.tape.of_time])

    @cached_property
    def sided(self) -> tuple[Tape, Tape]:
        """Arguments that follow signals, inputs as well, of sign, and of all that switches.

        Values of abs, min and max have no sides, but their derivatives do.
        """
        followers = self.tape.following(range(self.m + len(self.outputs)))
        signs = {i.arguments[0] for i in self.tape.instructions if i.operation == "sign"}
        every = {s.argument for s in self.tape.switches}
        return self.tape.of(sorted(signs & followers)), self.tape.of(sorted(every & followers))

    def with_cells(self, cells: Array) -> TextCoefficients:
        """The same with ``cells`` (number,) among the edges of what is resolved in time."""
        return replace(self, restricted=replace(self.of_time, cells=cells))

    def with_tables(self, tables: Mapping[int, Piecewise]) -> TextCoefficients:
        """The same with tables for some inputs, by their numbers."""
        own = None if self.restricted is None else self.restricted.with_tables(tables)
        return replace(self, tables=tables, restricted=own)

    @cached_property
    def without_inputs(self) -> TextCoefficients:
        """The same with zero for inputs that no matrix follows, where these come from outside."""
        targets, outputs = self.assembly.targets, np.array(self.tape.outputs, dtype=np.intp)
        u = MATRIX_NAMES.index("u")
        others = outputs[targets[:, 0] != u].tolist()
        idle = [k for k in range(self.m) if self.tape.following({k}).isdisjoint(others)]
        kept = (targets[:, 0] != u) | ~np.isin(targets[:, 1], idle)
        fixed = list(self.assembly.fixed)
        fixed[u] = np.where(np.isin(np.arange(self.m), idle), 0.0, fixed[u])
        tape = self.tape.of(outputs[kept].tolist())
        return replace(
            self, assembly=Assembly(tape, targets[kept], tuple(fixed)),
            tables={k: table for k, table in self.tables.items() if k not in idle},
            restricted=self.restricted and self.restricted.without_inputs,
        )

    @cached_property
    def _bounds(self) -> Bounds:
        return Bounds(self.tape.of([k for k in self.tape.outputs if k in self.tape.of_time]))


def driven_from_outside(system: DescriptorSystem) -> DescriptorSystem:
    """The plant whose inputs are measured: functions of time that it has for them do not count."""
    source = system.coefficients
    if not isinstance(source, TextCoefficients) or system.regression is not None:
        return system
    return replace(system, coefficients=source.without_inputs)


def switching(source: CoefficientSource) -> Tape | None:
    """Arguments of what jumps or has a kink where outputs say so, if there are any known."""
    found = source.switches if isinstance(source, TextCoefficients) else None
    return found if found is not None and found.outputs else None


def sided(source: CoefficientSource, order: int = 0) -> Tape | None:
    """Arguments of what jumps where signals say so, up to an order, if there are any known."""
    known = getattr(source, "sided", None)
    return known[min(order, 1)] if known and known[min(order, 1)].outputs else None


def blur_of(source: CoefficientSource, cuts: Array) -> Array:
    """By how much breakpoints (C,) may be wrong, in units of rounding."""
    if not isinstance(source, TextCoefficients):
        return np.abs(cuts)
    return np.maximum(np.abs(cuts), blurred(source.of_time.tape, cuts) / _EPS)


def coefficients_of(
    entries: Mapping[str, MatrixEntries],
    inputs: Sequence[Expression],
    outputs: frozenset[str],
    name: str,
) -> TextCoefficients:
    """Coefficients from entries by the names in ``MATRIX_NAMES``, and those of theta.

    Inputs stand for their names in ``entries``, outputs have values only along signals.
    """
    restricted = None
    signals = {
        key: frozenset[str]().union(*(e.node.signals for e in given.values()))
        for key, (_, given) in entries.items()
    }
    if not all(map(outputs.isdisjoint, signals.values())):
        kept = {
            key: (shape, {k: e for k, e in given.items() if e.node.signals.isdisjoint(outputs)})
            for key, (shape, given) in entries.items()
        }
        restricted = coefficients_of(kept, inputs, outputs, name)
    varying: list[Expression] = []
    targets: list[tuple[int, int]] = []
    fixed = {key: np.zeros(shape) for key, (shape, _) in entries.items()}
    for key, (_, given) in entries.items():
        constant = {k: e.value for k, e in given.items() if e.is_constant}
        fixed[key].flat[list(constant)] = list(constant.values())
        moving = {k: e for k, e in given.items() if k not in constant}
        targets += [(MATRIX_NAMES.index(key), k) for k in moving]
        varying += moving.values()
    assembly = Assembly(
        record(varying, inputs), np.array(targets, dtype=np.intp).reshape(-1, 2),
        tuple(fixed[name] for name in MATRIX_NAMES),
    )
    depending = {key: signals[key] for key in MATRIX_NAMES if signals[key]}
    truth = record(list(entries["theta"][1].values()))
    divisors = record([
        Expression(node, e.text, e.where) for e in varying for node in divisors_of(e.node)
        if not node.signals.isdisjoint(outputs)
    ])
    return TextCoefficients(assembly, truth, depending, outputs, name, divisors, restricted)
