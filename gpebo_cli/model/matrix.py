"""A matrix as a plant file has it: rows, entries by place, or an array; its size is checked."""

from __future__ import annotations

import itertools
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.entries import is_sparse
from gpebo_cli.model.expressions.syntax import shorten
from gpebo_cli.schema import counted, listed, nearest, quoting

Grid = list[list[tuple[int, object]]]  # entries by row, each with its column


@dataclass(frozen=True)
class Side:
    """What the rows or the columns of a matrix stand for."""

    noun: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        """``there are 2 inputs (V, I)``, for messages."""
        verb = "is" if len(self.names) == 1 else "are"
        named = f" ({listed(self.names)})" if self.names else ""
        return f"there {verb} {counted(len(self.names), self.noun)}{named}"


def items_of(value: object) -> list[object] | None:
    """The items of a list or an array, None for anything else (text is no list of letters)."""
    if isinstance(value, np.ndarray) and value.ndim == 1:
        return list(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return list(value)
    return None


def brief(value: object) -> str:
    """Any value, short: aliases can make a small YAML file a gigantic nested list."""
    return shorten(value if isinstance(value, str) else reprlib.repr(value))


def matrix(where: str, value: object, down: Side, across: Side, *, needed: bool) -> Grid:
    """The entries of a matrix, whose place and name are ``where``; of a sparse one those it has.

    ``value`` is a list of rows, a mapping of places, an array (rows, columns) or one of SciPy's
    sparse ones. If it is not ``needed``, there may be no entries (ConfigError: anything else, or a
    size that is not that of ``down`` and ``across``).
    """
    n_rows, n_columns = len(down.names), len(across.names)
    if is_empty(value):
        if needed and n_rows and n_columns:
            why = across if down.noun == "state" else down
            raise ConfigError(
                f"{where} is missing; {why}, so it needs {counted(n_rows, 'row')} "
                f"of {n_columns}"
            )
        return []
    if isinstance(value, np.ndarray) or is_sparse(value):
        return _numbers(where, value, down, across)
    if isinstance(value, Mapping) and value:
        return _by_place(where, value, down, across)
    rows = per_row(where, value, down, f"be a list of {counted(n_rows, 'row')}", "row")
    grid: Grid = []
    for i, row in enumerate(rows):
        entries = items_of(row)
        if entries is None:
            raise ConfigError(
                f"{where}[{i}] must be a list, one entry per {across.noun}, not {brief(row)}"
            )
        grid.append(list(enumerate(entries)))
    widths = [len(row) for row in grid]
    for i, width in enumerate(widths):
        if width != widths[0]:
            plant, _, key = where.rpartition(": ")
            raise ConfigError(
                f"{plant}: the rows of {key} differ: {key}[0] has length {widths[0]}, "
                f"{key}[{i}] has length {width}{_quoting(grid)}"
            )
    if widths[0] != n_columns:
        raise ConfigError(
            f"{where} has {counted(widths[0], 'column')} but {across}{_quoting(grid)}"
        )
    return grid


def _quoting(grid: Grid) -> str:
    return quoting([entry for row in grid for _, entry in row])


def per_row(where: str, value: object, rows: Side, must: str, noun: str) -> list[object]:
    """The items of a list, as many as there are rows (ConfigError: it is none, or has others)."""
    items = items_of(value)
    if items is None:
        raise ConfigError(f"{where} must {must}, not {brief(value)}")
    if len(items) != len(rows.names):
        raise ConfigError(f"{where} has {counted(len(items), noun)} but {rows}{quoting(items)}")
    return items


def _by_place(where: str, value: Mapping[Any, object], down: Side, across: Side) -> Grid:
    """The entries of a mapping, by row and column: ``e1,il: -1`` or ``e1: {il: -1}``."""
    grid: list[dict[int, object]] = [{} for _ in down.names]
    places = [{name: i for i, name in enumerate(side.names)} for side in (down, across)]
    for label, given in value.items():
        row, comma, column = str(label).partition(",")
        if comma:
            given = {column: given}  # noqa: PLW2901  the same, written otherwise
        if not isinstance(given, Mapping):
            raise ConfigError(
                f"{where} has {brief(label)}: {brief(given)}; write entries as "
                f"'row,column': value (in braces with quotation marks) or row: {{column: value}}"
            )
        i = _place(f"{where}: row", row, down, places[0])
        for name, entry in given.items():
            j = _place(f"{where}: column", str(name), across, places[1])
            if j in grid[i]:
                raise ConfigError(f"{where} has the entry {row.strip()},{name} twice")
            grid[i][j] = entry
    return [sorted(row.items()) for row in grid]


def _place(where: str, label: str, side: Side, places: Mapping[str, int]) -> int:
    """Number of a row or column by its name, or by its number from 0 on."""
    label = label.strip()
    if label in places:
        return places[label]
    if label.isdecimal() and int(label) < len(side.names):
        return int(label)
    raise ConfigError(
        f"{where} {brief(label)} is no {side.noun}{nearest(label, side.names)}, and no "
        f"number from 0 to {len(side.names) - 1}; {side}"
    )


def _numbers(where: str, value: Any, down: Side, across: Side) -> Grid:
    """The same of an array, or of one of SciPy's sparse matrices."""
    shape = (len(down.names), len(across.names))
    if value.shape != shape:
        size = " × ".join(map(str, value.shape))
        raise ConfigError(
            f"{where} is {size}, and {down} and {across}: expected {shape[0]} × {shape[1]}"
        )
    if isinstance(value, np.ndarray):
        return [list(enumerate(row)) for row in value.tolist()]
    csr = value.tocsr(copy=True)
    csr.sum_duplicates()
    columns, values, starts = csr.indices.tolist(), csr.data.tolist(), csr.indptr.tolist()
    return [
        list(zip(columns[a:b], values[a:b], strict=True)) for a, b in itertools.pairwise(starts)
    ]


def is_empty(value: object) -> bool:
    """Whether a key has nothing behind it, or an empty list."""
    return value is None or (isinstance(value, list) and not value)
