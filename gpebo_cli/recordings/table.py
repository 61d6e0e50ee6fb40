"""A recording as text: CSV with a column ``t`` and columns named like the plant's signals.

Every row that is read is checked as it is read, so that a file and a stream say the same about
the same mistake: source, line (the header is line 1), column, what stands there and what would do.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.schema import nearest, shown

TIME = "t"
_SEPARATORS = {";": "semicolons", "\t": "tabs"}


@dataclass(frozen=True)
class Header:
    """Which columns of a table are read, and where they stand."""

    source: str  # a file's name or "standard input", for messages
    width: int  # columns of the table
    names: tuple[str, ...]  # of those that are read: t, inputs, outputs, states that are there
    positions: tuple[int, ...]
    known: tuple[int, ...]  # numbers of the states that are there


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows that were read, time first."""

    t: Array  # (N,) ascending
    inputs: Array  # (N, m)
    outputs: Array  # (N, r)
    states: Array  # (N, n), NaN for one the table does not have


@dataclass(frozen=True, eq=False)
class Table:
    """A whole file: its samples and which file it was."""

    header: Header
    samples: Samples
    lines: tuple[int, int]  # of the first and of the last sample
    sha256: str


def read_table(path: str, system: DescriptorSystem) -> Table:
    """Read the recording in the file ``path``.

    Raises:
        ConfigError: it cannot be read, or something in it is not what a recording has; one line
            that names the file, the line and the column.
    """
    try:
        with open(path, "rb") as stream:
            content = stream.read()
    except IsADirectoryError:
        raise ConfigError(f"data.file: {path} is a folder, not a file") from None
    except OSError as error:
        raise ConfigError(f"data.file: {path} cannot be read: {error.strerror}") from error
    except ValueError as error:  # a NUL in the name
        raise ConfigError(f"data.file: {shown(path)} is no name of a file") from error
    rows = _cells(path, _text(path, content))
    _, first = next(rows, (0, None))
    if first is None:
        raise ConfigError(f"{path} is empty; expected a header and rows")
    header = read_header(path, first, system)
    reader = RowReader(header)
    lines, values = [], []
    for line, cells in rows:
        values.append(reader.read(line, cells))
        lines.append(line)
    if len(values) < 2:
        raise ConfigError(f"{path} has {len(values)} rows below its header; at least 2 are needed")
    return Table(
        header, samples(header, np.array(values), system), (lines[0], lines[-1]),
        hashlib.sha256(content).hexdigest(),
    )


def _text(path: str, content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")  # a spreadsheet's byte order mark does no harm
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        utf16 = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        what = " (it is UTF-16)" if utf16 else ""
        raise ConfigError(f"{path}, line {line}: not UTF-8 text{what}; save it as UTF-8") from None


def _cells(source: str, text: str) -> Iterator[tuple[int, list[str]]]:
    """Lines, counted from 1, and their cells; empty lines at the end do not count."""
    lines = text.splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    for number, line in enumerate(lines, start=1):
        yield number, split_cells(source, number, line)


def split_cells(source: str, line: int, text: str) -> list[str]:
    """The cells of one line; cells may be quoted.

    Raises:
        ConfigError: the line is not CSV.
    """
    if '"' not in text:
        return text.split(",")
    try:
        return next(csv.reader([text], strict=True))
    except csv.Error as error:
        raise ConfigError(f"{source}, line {line}: not CSV: {error}") from None


def read_header(source: str, cells: Sequence[str], system: DescriptorSystem) -> Header:
    """Find the columns of the plant's signals among the names in the first line.

    A column ``<name>_measured``, as ``signals.csv`` of a run with noise has it beside the truth, is
    what an observer gets to see, and is read in place of ``<name>``.

    Raises:
        ConfigError: a column is missing or stands there twice.
    """
    names = [cell.strip() for cell in cells]
    if len(names) == 1:
        for separator, word in _SEPARATORS.items():
            if separator in names[0]:
                raise ConfigError(
                    f"{source}, line 1: cells are separated by {word}; use commas, and points in "
                    "numbers"
                )
    known = tuple(i for i, state in enumerate(system.states) if state in names)
    seen = (
        f"{name}_measured" if f"{name}_measured" in names else name
        for name in (*system.inputs, *system.outputs)
    )
    needed = (TIME, *seen)
    wanted = (*needed, *(system.states[i] for i in known))
    for name in wanted:
        count = names.count(name)
        if count > 1:
            raise ConfigError(f"{source}, line 1: column {name} stands there {count} times")
        if count == 0:
            unused = [other for other in names if other not in wanted]
            same = [other for other in unused if other.casefold() == name.casefold()]
            hint = f"; did you mean {same[0]}?" if same else nearest(name, unused)
            raise ConfigError(
                f"{source}, line 1: there is no column {name}; plant {system.name} needs "
                f"{', '.join(needed)}, the header has {shown(', '.join(names))}"
                + hint
            )
    positions = tuple(names.index(name) for name in wanted)
    return Header(source, len(names), wanted, positions, known)


class RowReader:
    """Reads one row after the other; remembers the time of the last one."""

    def __init__(self, header: Header) -> None:
        self._header = header
        self._last = (-math.inf, 0)  # time and line

    def read(self, line: int, cells: Sequence[str]) -> list[float]:
        """The numbers of the columns that are read.

        Raises:
            ConfigError: too few or too many cells, one that is empty or not a finite number, or
                a time that is not later than the last one.
        """
        header = self._header
        if len(cells) != header.width:
            what = "is empty" if cells in ([], [""]) else f"has {len(cells)} cells"
            raise ConfigError(
                f"{header.source}, line {line} {what}; the header has {header.width}"
            )
        try:
            values = [float(cells[i]) for i in header.positions]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)) or any("_" in cells[i] for i in header.positions):
            raise ConfigError(self._wrong_cell(line, cells))
        t, (before, line_before) = values[0], self._last
        if t <= before:
            how = "repeats" if t == before else "is before"
            raise ConfigError(
                f"{header.source}, line {line}, column {TIME}: {t!r} {how} {before!r} of line "
                f"{line_before}; times must increase"
            )
        self._last = (t, line)
        return values

    def _wrong_cell(self, line: int, cells: Sequence[str]) -> str:
        """The first cell that is not a finite number, as a message."""
        header = self._header
        for name, position in zip(header.names, header.positions, strict=True):
            cell = cells[position]
            where = f"{header.source}, line {line}, column {name}"
            if not cell.strip():
                return f"{where}: the sample is missing; every row needs a number there"
            try:
                number = float(cell.replace("_", "?"))  # Python would read 1_0 as 10
            except ValueError:
                return f"{where}: {shown(cell)} is not a number"
            if not math.isfinite(number):
                return f"{where}: {shown(cell.strip())} is not a finite number"
        raise AssertionError("no cell is wrong")


def samples(header: Header, values: Array, system: DescriptorSystem) -> Samples:
    """Sort the columns of rows (N, columns) into signals."""
    m, r = system.m, system.r
    states = np.full((len(values), system.n), np.nan)
    states[:, list(header.known)] = values[:, 1 + m + r :]
    return Samples(values[:, 0], values[:, 1 : 1 + m], values[:, 1 + m : 1 + m + r], states)


class LineReader:
    """Rows from pieces of text as they come; nothing is kept but the piece of a line."""

    def __init__(self, source: str, system: DescriptorSystem) -> None:
        self._source, self._system = source, system
        self._rest, self._line = b"", 0
        self._reader: RowReader | None = None
        self._header: Header | None = None

    @property
    def header(self) -> Header | None:
        """The header, once it is there."""
        return self._header

    def feed(self, piece: bytes, *, last: bool = False) -> tuple[list[list[float]], str]:
        """Rows that are complete with ``piece``, and what is wrong with the next one, if anything.

        Args:
            piece: what came.
            last: nothing else will: what stands behind the last newline is a line, too.
        """
        *lines, self._rest = (self._rest + piece).split(b"\n")
        if last and self._rest.strip():
            lines.append(self._rest)
        if len(self._rest) > _LONGEST_LINE:
            return [], f"{self._source}, line {self._line + 1}: longer than {_LONGEST_LINE} bytes"
        rows: list[list[float]] = []
        try:
            for line in lines:
                self._line += 1
                rows.extend(self._row(line))
        except ConfigError as error:
            return rows, str(error)
        return rows, ""

    def _row(self, line: bytes) -> Iterable[list[float]]:
        try:
            text = line.decode("utf-8-sig" if self._line == 1 else "utf-8").rstrip("\r")
        except UnicodeDecodeError:
            raise ConfigError(f"{self._source}, line {self._line}: not UTF-8 text") from None
        cells = split_cells(self._source, self._line, text)
        if self._reader is None:
            self._header = read_header(self._source, cells, self._system)
            self._reader = RowReader(self._header)
            return []
        return [self._reader.read(self._line, cells)]


_LONGEST_LINE = 1 << 20
