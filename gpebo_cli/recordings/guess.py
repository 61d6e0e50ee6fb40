"""A look at a file of measurements: how it is written, and which column may be which signal.

What is found is a guess, for a person to read; nothing here decides anything in a run.
"""

from __future__ import annotations

import csv
import difflib
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from math import isnan, pi
from operator import ne

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.recordings.lines import DATE, MISSING, TIME, seconds, split_cells
from gpebo_cli.recordings.table import check_text, read_file, typed_table
from gpebo_cli.settings import DataSettings

_SEPARATORS = (",", ";", "\t", " ")
_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1,
             "h": 1e2, "k": 1e3, "M": 1e6}
_SPELLED = {"°C": "degC", "°": "deg", "Ω": "ohm", "²": "2", "³": "3", "^": ""}
_OTHER = {"l": (1e-3, "m3"), "L": (1e-3, "m3"), "bar": (1e5, "Pa"), "deg": (pi / 180.0, "rad"),
          "rpm": (pi / 30.0, "rad/s"), "%": (0.01, "1")}
_TIMES = ("t", "time", "zeit", "timestamp", "datetime", "date", "datum", "temps", "tiempo")
_UNITS = {"s": "s", "sec": "s", "seconds": "s", "ms": "ms", "msec": "ms", "milliseconds": "ms",
          "min": "min", "minutes": "min", "h": "h", "hours": "h"}
_STEPS = 0.5  # of its rows: an input that changes at so many of them may be one that steps
_RATES = {"s": 1.0, "min": 60.0, "h": 3600.0}
_BY_UNIT = "its unit"
_LOOKED_AT = 50  # rows below the header
# What loggers write where they have nothing, and instruments (SCPI) for no number or infinity.
_NINES = re.compile(r"-?9{3,}[.,]?[09]*|[+-]?9[.,]91?0*[eE]\+?37")


@dataclass
class Guess:
    """How a file is written, and what is said about it."""

    separator: str = ","
    decimal: str = "."
    time_unit: str = "s"  # as data.time_unit has it
    columns: dict[str, str] = field(default_factory=dict)  # what each signal is called in the file
    held: list[str] = field(default_factory=list)  # inputs that stay where they are for some rows
    scale: dict[str, float] = field(default_factory=dict)  # from the file's units to the plant's
    missing: int = 0  # cells that are empty in the columns that are read, or hold one of
    gaps: list[float] = field(default_factory=list)  # nines alone, far from all other numbers
    reasons: dict[str, str] = field(default_factory=dict)  # why, by key or signal
    doubts: list[str] = field(default_factory=list)  # what was not understood, a line each
    lacking: list[str] = field(default_factory=list)  # signals without a column


def guess(path: str, system: DescriptorSystem) -> Guess:
    """Look at the table in the file ``path`` for the signals of ``system`` (ConfigError)."""
    content = read_file(path)
    frame = typed_table(path, content)
    if frame is not None:
        plain = frame.apply(lambda c: c.dt.total_seconds() if c.dtype.kind == "m" else c)
        content = plain.to_csv(index=False).encode()
    check_text(path, content)
    lines = content.decode("utf-8-sig").rstrip().replace("\r\n", "\n").split("\n")
    found = Guess()
    table = _table(path, lines[: _LOOKED_AT + 1], found)
    header, rows = [name.strip() for name in table[0]], table[1:]
    if not rows:
        raise ConfigError(f"{path} has no rows below its header")
    try:
        every = list(csv.reader(lines[1:], delimiter=found.separator))
    except csv.Error as error:
        raise ConfigError(f"{path} is not CSV: {error}") from None

    def known(k: int) -> Iterator[str]:
        cells = (row[k].strip() for row in every if k < len(row))
        return (cell for cell in cells if cell.lower() not in MISSING)

    cells = [list(islice(known(k), _LOOKED_AT)) for k in range(len(header))]
    commas = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
    comma = next((cell.strip() for row in rows for cell in row if commas.fullmatch(cell)), "")
    if found.separator != "," and comma:
        found.decimal = ","
        found.reasons["decimal"] = f"numbers such as {comma}"
    _find_time(header, cells, (*system.inputs, *system.outputs), found)
    _find_signals(header, cells, system, found)
    taken = [header.index(name) for name in found.columns.values()]
    for name in system.inputs:
        values = list(known(header.index(found.columns[name]))) if name in found.columns else []
        steps = sum(map(ne, values, values[1:]))
        if 0 < steps <= _STEPS * len(values):
            found.held.append(name)
    for k in taken:
        _find_gaps([row[k].strip() for row in every if k < len(row)], found)
    unused = [name for name in header if name not in found.columns.values()]
    if unused:
        found.doubts.append(f"not read: {', '.join(unused)}")
    return found


def _table(path: str, lines: Sequence[str], found: Guess) -> list[list[str]]:
    """Header and rows, split by the character that gives all of them most cells, and as many."""
    best, found.separator = _cut(lines)
    if not best:
        split_cells(path, 1, lines[0], DataSettings())  # which may be none for a run, either
        below = (k for k in range(1, len(lines) - 1) if _cut(lines[k:])[0])
        named = (k for k in below if not lines[k].lstrip(' "+-.')[:1].isdigit())
        line = next(named, 0) + 1
        raise ConfigError(
            f"{path}: no character of comma, semicolon, tab and space cuts its first lines into "
            "the same number of cells, two at least; " + (
                f"if line {line} is the header, remove what stands above it" if line > 1
                else "is the first line the header?"
            )
        )
    return best


def _cut(lines: Sequence[str]) -> tuple[list[list[str]], str]:
    """Cells of the lines, and the character between them; none, if that is no table."""
    best: list[list[str]] = []
    found = ""
    for separator in _SEPARATORS:
        with suppress(csv.Error):  # by a wrong one, a line may be longer than a cell can be
            rows = list(csv.reader(lines, delimiter=separator))
            widths = {len(row) for row in rows}
            if len(widths) == 1 and len(rows[0]) > max(1, len(best[0]) if best else 1):
                best, found = rows, separator
    return best, found


def _number(cell: str, decimal: str) -> float | None:
    try:
        return float(cell.replace(decimal, "."))
    except ValueError:
        return None


def _find_time(
    header: Sequence[str], cells: Sequence[Sequence[str]], signals: Sequence[str], found: Guess
) -> None:
    named = [k for k, name in enumerate(header) if _words(name)[:1] and
             _words(name)[0].casefold() in _TIMES and name not in signals]
    # Of a date beside a time of day the one that moves.
    k = max(named, key=lambda k: len(set(cells[k]))) if named else 0
    found.columns[TIME] = header[k]
    found.reasons[TIME] = "by its name" if named else "the first column: LOOK AT IT"
    numbers = [_number(cell, found.decimal) for cell in cells[k]]
    above = next((j for j, number in enumerate(numbers) if number is not None), 0)
    if above and None not in numbers[above:]:  # a row of units below the header
        found.doubts.append(
            f"column {header[k]}: {cells[k][0]!r} above its numbers; such rows have to be removed"
        )
        numbers = numbers[above:]
    if any(number is None for number in numbers):
        found.time_unit = "datetime"
        first = cells[k][0]
        if not isnan(seconds([first], None)[0][0]):
            found.reasons["time_unit"] = f"dates such as {first}"
        else:
            found.doubts.append(f"column {header[k]}: {first!r} is neither a number nor {DATE}")
        return
    words = [word.casefold() for word in _words(header[k])[1:]]
    units = [_UNITS[word] for word in words if word in _UNITS]
    found.time_unit = units[0] if units else "s"
    found.reasons["time_unit"] = "from the header" if units else "not said in the file"
    counted = ([str(first + j) for j in range(len(cells[k]))] for first in (0, 1))
    if not named and cells[k][2:] and list(cells[k]) in counted:
        found.doubts.append(
            f"column {header[k]} may count rows: data.scale.t is the time between them in seconds"
        )
    written = [word for word in words if _factor(word, "s")] or _units(header[k])
    if written and not units:
        _find_scale(TIME, header[k], written[0], "s", found)


def _find_gaps(cells: Sequence[str], found: Guess) -> None:
    """Count the gaps of a column, empty ones and those of nines, into what is found."""
    found.missing += sum(cell.lower() in MISSING for cell in cells)
    nines = {c: n for c, n in Counter(filter(_NINES.fullmatch, cells)).items() if n > 1}
    others = [_number(cell, found.decimal) for cell in cells if cell not in nines]
    numbers = [number for number in others if number is not None]
    for cell, count in nines.items():
        value = _number(cell, found.decimal)
        if value is None or not numbers:
            continue
        low, high = min(numbers), max(numbers)
        if low - value > high - low or value - high > high - low:
            found.missing += count
            found.gaps += [value] * (value not in found.gaps)
            found.reasons["gaps"] = f"{count} cells are {cell}, far from all others"
        else:
            found.doubts.append(f"{count} cells are {cell}: if that means a gap, leave them empty")


def _words(name: str) -> list[str]:
    return re.findall(r"[^\W_]+", name)


def _likeness(signal: str, unit: str, name: str) -> tuple[float, str]:
    """How much a column's name speaks for a signal, from 0 to 4, and why."""
    if name in (signal, f"{signal}_measured"):
        return 4.0, "the same name"
    if name.casefold() == signal.casefold():
        return 3.0, "the same name but for capitals"
    if signal in re.findall(r"\w+", re.sub(r"[(\[].*?[)\]]", "", name)):
        return 2.5, "the name is in the header"
    if signal in (*re.findall(r"\w+", name), *_words(name)):
        return 2.0, "the name is in the header"
    ratio = difflib.SequenceMatcher(None, signal.casefold(), name.casefold()).ratio()
    if unit and any(_factor(written, unit) is not None for written in _units(name)):
        return 1.5 + 0.4 * ratio, _BY_UNIT  # of several with that unit the most similar one
    return (ratio, "a similar name") if ratio > 0.6 else (0.0, "")


def _find_signals(
    header: Sequence[str], cells: Sequence[Sequence[str]], system: DescriptorSystem, found: Guess
) -> None:
    signals = (*system.inputs, *system.outputs)
    free = [
        k for k, name in enumerate(header)
        if name != found.columns[TIME]
        and any(_number(cell, found.decimal) is not None for cell in cells[k])
    ]
    pairs = sorted(
        ((_likeness(s, system.units.get(s, ""), header[k]), s, k) for s in signals for k in free),
        key=lambda pair: -pair[0][0],
    )
    with_unit = Counter(signal for (_, why), signal, _ in pairs if why == _BY_UNIT)
    for (points, why), signal, k in pairs:
        if points > 0 and signal not in found.columns and k in free:
            also = ", as of others: LOOK AT IT" * (why == _BY_UNIT and with_unit[signal] > 1)
            found.columns[signal], found.reasons[signal] = header[k], why + also
            free.remove(k)
    left = [signal for signal in signals if signal not in found.columns]
    if left and len(left) == len(free):
        for signal, k in zip(left, free, strict=True):
            found.columns[signal], found.reasons[signal] = header[k], "by elimination: LOOK AT IT"
        left = []
    found.lacking = left
    for signal in left:
        found.doubts.append(f"no column was found for {signal}: write it to data.columns.{signal}")
    for signal, name in found.columns.items():
        unit = system.units.get(signal, "")
        for written in _units(name) if unit else ():
            _find_scale(signal, name, written, unit, found)


def _find_scale(signal: str, name: str, written: str, unit: str, found: Guess) -> None:
    factor = _factor(written, unit)
    if factor is None:
        how = f"data.scale.{signal} is the factor between them"
        if "degC" in (_as_usual(written)[1], _as_usual(unit)[1]):
            how = f"their zeros differ, which no factor mends: write the plant in {written}"
        found.doubts.append(f"column {name} may be in {written}, {signal} is in {unit}: {how}")
    if factor != 1.0:
        found.scale[signal] = factor or 1.0
        found.reasons[f"scale.{signal}"] = f"{written} in the header, {unit} here" + (
            "" if factor else ": WHICH FACTOR?"
        )


def _units(name: str) -> list[str]:
    """What may be a unit in a column's name: ``U (mV)``, ``U [mV]``, ``U / mV``, ``U in mV``."""
    given = re.findall(r"[(\[]\s*([^\s)\]]+)\s*[)\]]|/\s*(\S+)$|\bin\s+([^\s(]+)$", name)
    return [part for groups in given for part in groups if part]


def _factor(written: str, unit: str) -> float | None:
    """From a unit with a prefix, per minute, or of another name, to the unit; None: it is none."""
    (size, written), (of_unit, unit) = _as_usual(written), _as_usual(unit)
    top, _, below = written.partition("/")
    wanted, _, per = unit.partition("/")
    if written == unit:
        return size / of_unit
    if below in _RATES and per in _RATES:
        times = _factor(top, wanted)
        return times and times * _RATES[per] / _RATES[below]
    for prefix, base in _prefixed(written):
        for other, same in _prefixed(unit):
            if base == same:
                first = base.partition("/")[0]  # mm/s2 is a thousandth of m/s2
                power = int(first[-1]) if first[-1] in "23" else 1
                return (prefix / other) ** power * size / of_unit
    return None


def _prefixed(unit: str) -> Iterator[tuple[float, str]]:
    """The unit itself, and without the first letter where that may be a prefix."""
    yield 1.0, unit
    if unit[:1] in _PREFIXES and unit[1:2].isalpha() and unit != "min":
        yield _PREFIXES[unit[0]], unit[1:]


def _as_usual(unit: str) -> tuple[float, str]:
    """How much of which other unit it is; 1 of its own, if nothing is known."""
    for sign, word in _SPELLED.items():
        unit = unit.replace(sign, word)
    if unit[1:] in _OTHER and unit[0] in _PREFIXES:
        size, base = _OTHER[unit[1:]]
        return _PREFIXES[unit[0]] * size, base
    return _OTHER.get(unit, (1.0, unit))
