"""Inputs given as tables of samples, so that what was recorded drives a simulation.

    inputs: {u: {file: u.csv, column: u, hold: linear}}

Between samples an input is a polynomial of t, with the derivatives that a plant of higher index
needs. Elements end at the samples where it jumps or bends.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from typing import Literal, cast

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.archive import ARCHIVE
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem
from gpebo_cli.model.expressions import Cells, Tape, switched, with_others
from gpebo_cli.model.expressions.intervals import Interval, polynomials
from gpebo_cli.model.text import TextCoefficients
from gpebo_cli.numerics.mesh import aside
from gpebo_cli.reading import beside
from gpebo_cli.recordings.hold import bends
from gpebo_cli.recordings.table import TIME, read_table
from gpebo_cli.schema import read
from gpebo_cli.settings import DataSettings

_ROUNDING = 1e-12  # of the largest time: by how much an experiment may exceed the samples
_LOOKS = np.linspace(0.0, 1.0, 9)  # of a piece, where one looks at the sign of what switches


@dataclass(frozen=True)
class _Given:
    """What a plant's file says of such an input; keys as of ``data``."""

    file: str
    column: str | None = None  # by default the input's name
    time: str = TIME  # the column of times
    hold: Literal["zoh", "linear", "cubic"] = "linear"
    scale: float = 1.0
    time_unit: Literal["s", "ms", "min", "h", "datetime"] = "s"
    separator: str = ","
    decimal: Literal[".", ","] = "."
    missing: Literal["refuse", "hold", "interpolate", "drop"] = "refuse"
    gaps: list[float] | None = None


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
                f"{self.where} is of t = {first:g} to {last:g}, and the experiment needs "
                f"t = {beyond:g}; set time.start and time.horizon, or give a longer table"
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
class Driven:
    """Matrices of a text, some of its inputs being tables; a ``CoefficientSource``."""

    given: TextCoefficients  # with zero in place of those inputs
    tables: Mapping[int, Piecewise]  # by the number of the input
    outputs: int  # r

    @cached_property
    def constant(self) -> frozenset[str]:
        """Those of the text but u."""
        return self.given.constant - {"u"}

    @cached_property
    def zero(self) -> frozenset[str]:
        """Those of the text but u."""
        return self.given.zero - {"u"}

    @property
    def signals(self) -> Mapping[str, frozenset[str]]:
        """As of the text."""
        return self.given.signals

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        """All matrices at the times t (N,), see the protocol."""
        if signals is not None:
            return self.given.taylor(t, order, inside, signals)
        found, known = self._known(t, order, inside)
        if not self.signals:
            return found._replace(u=known[:, :, : found.u.shape[2]])
        return self.given.taylor(t, order, inside, known)

    def _known(self, t: Array, order: int, inside: Array | None) -> tuple[Coefficients, Array]:
        """What the text says without tables, and [u; 0] (order + 1, N, m + r) with them."""
        found = self.given.of_time.taylor(t, order, inside)
        # Nothing depends on y.
        known = np.concatenate([found.u, np.zeros((order + 1, len(t), self.outputs))], axis=2)
        inside = t if inside is None else inside
        there = aside(t, inside) if self._switches.outputs else t  # on its side of what switches
        for k, table in self.tables.items():
            known[:, :, k] = table.taylor(there, order, inside)
        return found, known

    @cached_property
    def of_time(self) -> Driven:
        """The same with zero for what depends on outputs."""
        return replace(self, given=self.given.of_time)

    def with_cells(self, cells: Array) -> Driven:
        """As of the text, for cells (number,)."""
        return replace(self, given=self.given.with_cells(cells))

    @property
    def switches(self) -> Tape:
        """Those of the text."""
        return self.given.switches

    def along(self, signals: Cells, numbers: Container[int], edges: Array) -> tuple[Array, bool]:
        """As of the text, from edges (K + 1,)."""
        return self.given.along(signals, numbers, edges)

    def truth(self, t: Array) -> Array:
        """True values of the unknowns at the times t (N,), shape (N, q)."""
        return self.given.truth(t)

    def breakpoints(self, start: float, stop: float) -> Array:
        """Those of the text, the samples where an input jumps or bends, and what inputs switch."""
        for table in self.tables.values():
            table.cover(np.array([start, stop]))
        corners = np.concatenate([table.corners for table in self.tables.values()])
        inner = corners[(corners > start) & (corners < stop)]
        found = np.union1d(self.given.breakpoints(start, stop), inner)
        if not self._switches.outputs or not start < stop:
            return found
        edges, _ = self._along_tables(np.concatenate([[start], found, [stop]]))
        t = edges[:-1, None] + np.diff(edges)[:, None] * _LOOKS
        t = aside(t, t.mean(axis=1, keepdims=True)).ravel()  # each in its own piece
        new = switched(self._switches, t, lambda t, order: self._known(t, order, t)[1])
        return with_others(np.array([start, *found, stop]), new)[1:-1]

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        """As of the text, from edges (K + 1,), and of what follows tables: they are polynomials."""
        edges, sure = self.given.resolved(edges)
        edges, also = self._along_tables(edges)
        return edges, sure and also

    def _along_tables(self, edges: Array) -> tuple[Array, bool]:
        """:meth:`resolved` for what follows tables, from edges (K + 1,)."""
        def cells(low: Array, high: Array) -> list[list[Interval] | None]:
            half = 0.5 * (high - low)
            jets = {
                k: polynomials(table.taylor(low + half, len(table.pieces) - 1, low + half), half)
                for k, table in self.tables.items()
            }
            return [jets.get(k) for k in range(self.given.m)]

        return self.given.along(cells, self.tables, edges)

    @cached_property
    def _switches(self) -> Tape:
        """Arguments of sign, abs, min and max that follow tables, and no outputs."""
        tape = self.given.tape
        followers = tape.following(self.tables) & tape.of_time
        return tape.of([s.argument for s in tape.switches if s.argument in followers])


def tables(
    inputs: object, where: str, source: str = ""
) -> tuple[object, dict[str, Piecewise]]:
    """The inputs of a plant's file ``source`` with zero for each table, and the tables by name."""
    if not isinstance(inputs, Mapping):
        return inputs, {}
    found = {
        str(name): _piecewise(str(name), given, f"{where}.{name}", source)
        for name, given in inputs.items() if isinstance(given, Mapping)
    }
    return {name: 0 if str(name) in found else value for name, value in inputs.items()}, found


def driven(system: DescriptorSystem, found: Mapping[str, Piecewise]) -> DescriptorSystem:
    """The system with tables in place of the inputs of their names."""
    if not found:
        return system
    text = cast(TextCoefficients, system.coefficients)  # a plant with a file is text
    numbers = {system.inputs.index(name): table for name, table in found.items()}
    return replace(system, coefficients=Driven(text, numbers, system.r))


def located(mapping: Mapping[str, object], source: str) -> Mapping[str, object]:
    """A plant's mapping with the paths of its other files as they are from here."""
    if isinstance(mapping.get(ARCHIVE), str):
        mapping = {**mapping, ARCHIVE: beside(str(mapping[ARCHIVE]), source, ARCHIVE)}
    key = "signals" if "psi" in mapping else "inputs"
    inputs = mapping.get(key)
    if not isinstance(inputs, Mapping):
        return mapping
    return {**mapping, key: {
        name: {**given, "file": beside(given["file"], source, f"{key}.{name}.file")}
        if isinstance(given, Mapping) and isinstance(given.get("file"), str) else given
        for name, given in inputs.items()
    }}


def _piecewise(name: str, content: Mapping[str, object], where: str, source: str) -> Piecewise:
    given = read(_Given, content, where)
    path = beside(given.file, source, f"{where}.file")
    column = given.column or name
    data = DataSettings(
        name="csv", file=path, columns={TIME: given.time, name: column}, scale={name: given.scale},
        time_unit=given.time_unit, separator=given.separator, decimal=given.decimal,
        missing=given.missing, gaps=given.gaps,
    )
    alone = DescriptorSystem(  # of which the table is a recording; its matrices are not read
        where, (), None, np.zeros(0), inputs=(name,),  # type: ignore[arg-type]
    )
    try:
        samples = read_table(data, alone).samples
    except ConfigError as error:
        text = str(error).removeprefix("data.file: ").partition("; plant ")[0]
        raise ConfigError(f"{where}: {text}") from error
    t, values = samples.t, samples.inputs[:, 0]
    if given.hold == "cubic":
        from scipy.interpolate import CubicSpline

        pieces, corners = CubicSpline(t, values).c[::-1], t[1:-1]
    else:
        pieces = values[None, :-1]
        if given.hold == "linear":
            pieces = np.stack([pieces[0], np.diff(values) / np.diff(t)])
        corners = t[bends(t, values[:, None], given.hold)]
    return Piecewise(f"{where}: {path}", t, np.asarray(pieces), corners)
