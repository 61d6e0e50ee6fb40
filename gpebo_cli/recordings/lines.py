"""Rows of a recording as text: which columns are the plant's signals, and their numbers.

:class:`RowReader` says what a row may be, for files and for streams, and names a mistake with its
source, line (the header is line 1) and column.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.schema import LARGEST, known_name, nearest, shown
from gpebo_cli.settings import DataSettings

TIME = "t"
_SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_WORDS = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";"}  # as data.separator
# ASCII digits only: Python would read １.５, 1_0 and what stands beside a no-break space, too.
_NUMBER = r"[ \t]*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[ \t]*"
MISSING = ("", "-", "nan", "na", "n/a", "null", "none")  # where data.missing allows it
_REPEATED = "; data.missing=drop leaves out rows whose time repeats"
_LOCAL = "; local times go back where summer time ends, unless they have a zone (+02:00)"
BLANK = b" \t\r"
_LONGEST_LINE, _MOST_BLANK = 1 << 20, 1000
DATE = "a date and time as in 2024-05-31T12:00:00.250 or 31.05.2024 12:00:00"
_DAY_FIRST = re.compile(r"\A\s*([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4})\b")
_PLAIN_DATE = re.compile(  # up to microseconds
    r"[0-9]{4}(?:-[0-9]{2}){2}(?:[T ][0-9]{2}(?::[0-9]{2}){1,2}(?:[.,][0-9]{1,6})?)?"
    r"(?:Z|[+-][0-9]{2}:[0-9]{2})?"
)


@dataclass(frozen=True)
class Header:
    """Which columns of a table are read, and where they stand."""

    source: str  # a file's name or "standard input", for messages
    width: int  # columns of the table
    names: tuple[str, ...]  # in the table, of those that are read: t, inputs, outputs, states
    positions: tuple[int, ...]
    known: tuple[int, ...]  # numbers of the states that are there
    scale: tuple[float, ...]  # by which each column is multiplied; of t to seconds


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows that were read, time first."""

    t: Array  # (N,) ascending
    inputs: Array  # (N, m)
    outputs: Array  # (N, r)
    states: Array  # (N, n), NaN for one the table does not have


def separator(data: DataSettings) -> str:
    """The character between cells (ConfigError: it is no such character)."""
    found = _WORDS.get(data.separator, data.separator)
    if len(found) != 1 or found in '"\r\n' or found.isalnum() or found == data.decimal:
        raise ConfigError(
            f"data.separator: expected one character, not {data.decimal!r} (that is data.decimal), "
            f"or {', '.join(_WORDS)}; got {shown(data.separator)}"
        )
    return found


def split_cells(source: str, line: int, text: str, data: DataSettings) -> list[str]:
    """The cells of one line; cells may be quoted (ConfigError: the line is not CSV)."""
    if "\r" in text:
        raise ConfigError(
            f"{source}, line {line}: a carriage return without a newline; lines end with LF or CRLF"
        )
    if '"' not in text:
        return text.split(separator(data))
    try:
        return next(csv.reader([text], delimiter=separator(data), strict=True))
    except csv.Error as error:
        raise ConfigError(f"{source}, line {line}: not CSV: {error}") from None


def read_header(
    source: str, cells: Sequence[str], data: DataSettings, system: DescriptorSystem
) -> Header:
    """Find the columns of the plant's signals among the names of a table's columns.

    ``data.columns`` says what a signal is called there. Without it, a column ``<name>_measured``,
    as ``signals.csv`` of a run with noise has it beside the truth, is what an observer gets to see,
    and is read in place of ``<name>`` (ConfigError: a column is missing or stands there twice, or a
    name is no signal's).
    """
    names, columns, scale = [cell.strip() for cell in cells], data.columns or {}, data.scale or {}
    signals = (TIME, *system.inputs, *system.outputs)
    for key, given in (("columns", columns), ("scale", scale)):
        for name in given:
            what = f"data.{key}: {shown(name)} is no signal of plant {system.name}"
            known_name(name, (*signals, *system.states), what, "those are")
    for name, factor in scale.items():
        if not 0.0 < abs(factor) < np.inf:
            raise ConfigError(f"data.scale.{name} must be a finite number other than 0")
    if len(names) == 1 and data.separator == ",":
        for character, word in _SEPARATORS.items():
            if character in names[0]:
                raise ConfigError(
                    f"{source}, line 1: cells are separated by {word}; expected commas, or "
                    f"data.separator='{character if character != chr(9) else 'tab'}'"
                )
    measured = {name: f"{name}_measured" for name in signals if f"{name}_measured" in names}
    called = {name: columns.get(name, measured.get(name, name)) for name in signals}
    known = tuple(i for i, x in enumerate(system.states) if columns.get(x, x) in names)
    called |= {x: columns.get(x, x) for x in (system.states[i] for i in known)}
    wanted = tuple(called.values())
    for name in (*wanted, *(columns[x] for x in columns if x not in called)):
        count = names.count(name)
        if count > 1:
            raise ConfigError(f"{source}, line 1: column {name} stands there {count} times")
        if count == 0:
            unused = [other for other in names if other not in wanted]
            needed = ", ".join(called[signal] for signal in signals)
            kind = "plant" if system.regression is None else "regression"
            raise ConfigError(
                f"{source}, line 1: there is no column {name}; {kind} {system.name} needs "
                f"{needed}, the header has {shown(', '.join(names))}{nearest(name, unused)}; "
                "data.columns says what a signal is called"
                + "; line 1 has to be the header" * set(names).isdisjoint(wanted)
            )
    factors = {TIME: _SECONDS.get(data.time_unit, 1.0), **scale}
    return Header(
        source, len(names), wanted, tuple(map(names.index, wanted)), known,
        tuple(factors.get(name, 1.0) for name in called),
    )


class RowReader:
    """Reads one row after the other; remembers the time of the last one."""

    def __init__(self, header: Header, data: DataSettings) -> None:
        self._header, self._data = header, data
        self._last = (-math.inf, 0)  # time and line
        self._origin: Any = None  # of dates
        self._number = re.compile(_NUMBER.replace(r"\.", re.escape(data.decimal)))

    def read(self, line: int, cells: Sequence[str]) -> list[float]:
        """The numbers of the columns that are read; NaN where a sample is allowed to be missing.

        Too few or too many cells, one that is empty or not a finite number, or a time that is not
        later than the last one are a ConfigError.
        """
        header = self._header
        if len(cells) != header.width:
            what = "is empty" if cells in ([], [""]) else f"has {len(cells)} cells"
            raise ConfigError(
                f"{header.source}, line {line} {what}; the header has {header.width}"
            )
        row = zip(header.names, header.positions, header.scale, strict=True)
        values = [
            self._value(f"{header.source}, line {line}, column {name}", cells[k], first=i == 0)
            * scale
            for i, (name, k, scale) in enumerate(row)
        ]
        t, (before, line_before) = values[0], self._last
        if t <= before:
            if t == before and self._data.missing == "drop":
                return [math.nan] * len(values)
            how = "repeats" if t == before else "is before"
            raise ConfigError(
                f"{header.source}, line {line}, column {header.names[0]}: {t!r} {how} {before!r} "
                f"of line {line_before}; times must increase"
                + (_REPEATED if t == before else _LOCAL * (self._origin is not None))
            )
        if not math.isnan(t):
            self._last = (t, line)
        return values

    def _value(self, where: str, cell: str, *, first: bool) -> float:
        policy, text = self._data.missing, cell.strip(" \t")
        plain = self._number.fullmatch(cell) is not None
        value = float(cell.replace(self._data.decimal, ".")) if plain else math.nan
        of_gap = not first and value in (self._data.gaps or ())
        gap = text.lower() in MISSING
        if of_gap or gap:
            if policy == "drop" or (policy != "refuse" and not first):
                return math.nan
            if not text:
                raise ConfigError(
                    f"{where}: the sample is missing; every row needs a number there"
                    + ("" if first else ", or data.missing says what to do")
                )
        if of_gap:
            raise ConfigError(
                f"{where}: {text} is a gap (data.gaps); data.missing says what to do"
            )
        if first and self._data.time_unit == "datetime":
            [value], self._origin = seconds([cell], self._origin)
            if math.isnan(value):
                raise ConfigError(f"{where}: {shown(cell)} is not {DATE}")
            return float(value)
        if not plain:
            finite = text.lower().lstrip("+-") in ("nan", "inf", "infinity")
            raise ConfigError(
                f"{where}: {shown(cell)} is not {'a finite number' if finite else 'a number'}"
                + ("; data.missing says what to do with a gap" if gap and not first else "")
            )
        if abs(value) > LARGEST:
            raise ConfigError(
                f"{where}: {shown(text)} is too large; numbers go up to {LARGEST:g} here"
            )
        return value


def seconds(cells: Sequence[str], origin: Any) -> tuple[Array, Any]:
    """Dates and times as seconds after ``origin``, by default the first one; NaN: it is none."""
    points = [_DAY_FIRST.sub(_year_first, cell).strip(" \t") for cell in cells]
    if all(map(_PLAIN_DATE.fullmatch, points)):
        with suppress(ValueError):
            dates = [datetime.fromisoformat(point) for point in points]
            dates = [date if date.tzinfo else date.replace(tzinfo=UTC) for date in dates]
            origin = dates[0] if origin is None else origin
            return np.array([(date - origin).total_seconds() for date in dates]), origin
    import pandas as pd

    points = [point.replace(",", ".") for point in points]  # ISO 8601 has both, pandas only this
    times = pd.to_datetime(points, format="ISO8601", utc=True, errors="coerce")
    origin = times.min() if origin is None else origin  # the first may be no time
    return np.asarray((times - origin).total_seconds(), dtype=np.float64), origin


def _year_first(found: re.Match[str]) -> str:
    day, month, year = found.groups()
    return f"{year}-{month:0>2}-{day:0>2}"


def samples(header: Header, values: Array, system: DescriptorSystem) -> Samples:
    """Sort the columns of rows (N, columns) into signals."""
    m, r = system.m, system.r
    states = np.full((len(values), system.n), np.nan)
    states[:, list(header.known)] = values[:, 1 + m + r :]
    return Samples(values[:, 0], values[:, 1 : 1 + m], values[:, 1 + m : 1 + m + r], states)


class LineReader:
    """Rows from pieces of text as they come; nothing is kept but the piece of a line."""

    def __init__(self, source: str, data: DataSettings, system: DescriptorSystem) -> None:
        if data.missing == "interpolate":
            raise ConfigError(
                "data.missing=interpolate needs the sample after a gap; a stream takes refuse, "
                "hold or drop"
            )
        self._source, self._data, self._system = source, data, system
        self._rest, self._line = b"", 0
        self._reader: RowReader | None = None
        self.header: Header | None = None  # once it is there
        self._before: list[float] = []
        self.left_out, self.filled = 0, 0  # rows; cells of inputs and outputs
        self._blank: list[tuple[int, bytes]] = []  # at the end of a table blank lines do not count

    def feed(self, piece: bytes, *, last: bool = False) -> tuple[list[list[float]], str]:
        """Rows that are complete with ``piece``, and what is wrong with the next one, if anything.

        After the ``last`` piece what stands behind the last newline is a line, too.
        """
        *lines, self._rest = (self._rest + piece).split(b"\n")
        too_long = len(self._rest) > _LONGEST_LINE
        if last and self._rest.strip() and not too_long:
            lines.append(self._rest)
        rows: list[list[float]] = []
        try:
            for text in lines:
                self._line += 1
                self._blank.append((self._line, text))
                if text.strip(BLANK) or len(self._blank) > _MOST_BLANK:
                    waiting, self._blank = self._blank, []
                    for line in waiting:
                        rows.extend(self._row(*line))
        except ConfigError as error:
            return rows, str(error)
        if too_long:
            return rows, f"{self._source}, line {self._line + 1}: longer than {_LONGEST_LINE} bytes"
        return rows, ""

    def _row(self, number: int, line: bytes) -> Iterator[list[float]]:
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8").removesuffix("\r")
        except UnicodeDecodeError:
            raise ConfigError(
                f"{self._source}, line {number}: not UTF-8 text; save it as UTF-8"
            ) from None
        cells = split_cells(self._source, number, text, self._data)
        if self._reader is None or self.header is None:
            self.header = read_header(self._source, cells, self._data, self._system)
            self._reader = RowReader(self.header, self._data)
            return
        row = self._reader.read(number, cells)
        gaps = list(map(math.isnan, row))
        if self._data.missing != "drop":
            held = self._before or row
            self._before = row = [held[k] if gap else row[k] for k, gap in enumerate(gaps)]
        if any(map(math.isnan, row)):
            self.left_out += 1
            return
        self.filled += sum(gaps[: 1 + self._system.m + self._system.r])
        yield row
