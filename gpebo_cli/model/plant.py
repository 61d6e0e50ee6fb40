"""From the plain data of a plant file to a :class:`DescriptorSystem`, checked at construction.

Every message names the plant, the key and the entry, and where two sizes disagree, both.
"""

from __future__ import annotations

import itertools
import keyword
import re
import reprlib
from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.archive import ARCHIVE, with_archive
from gpebo_cli.model.descriptor import MATRIX_NAMES, Array, Coefficients, DescriptorSystem
from gpebo_cli.model.entries import Entries, is_sparse
from gpebo_cli.model.expressions import (
    RESERVED,
    Assembly,
    Bounds,
    Expression,
    Tape,
    breakpoints_of_tape,
    divisors_of,
    parse,
    record,
    resolved,
    shorten,
    signal,
)
from gpebo_cli.schema import nearest

KEYS = (
    "name",
    "title",
    "reference",
    "parameters",
    "states",
    "inputs",
    "unknowns",
    "outputs",
    "E",
    "A",
    "B",
    "F",
    "phi",
    "C",
    "D",
    "H",
    "initial_state",
    "units",
    "labels",
    "observer_defaults",
    ARCHIVE,
)
"""Keys of a plant file; name, states, E, A and initial_state are required."""

# Shape of a matrix, and its entries by position, row after row; what is not there is 0.
_Entries = tuple[tuple[int, ...], dict[int, Expression]]

# Which signals may stand in what, and why not others.
_OF_ALL = dict.fromkeys(("an input", "an output"), "")
_OF_INPUTS = {"an input": "", "an output": "; y = C x + D u + H θ would contain itself"}
_OF_TIME = dict.fromkeys(("an input", "an output"), ": its derivative would be needed")

_PLANT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,79}")  # it becomes part of a folder's name
_LONGEST_LABEL = 80
_MAX_PARAMETERS = 10_000  # a few seconds' work
_YAML_BOOLEAN = "YAML reads on, off, yes and no as booleans"


@dataclass(frozen=True, eq=False)
class _Layout:
    """How one matrix is put together from constants and columns of the tape's values."""

    shape: tuple[int, ...]
    fixed: Array  # (size,), constants; zero where an entry depends on time
    positions: NDArray[np.intp]  # of the entries that depend on time
    columns: NDArray[np.intp]  # where their values stand among the tape's outputs

    def assemble(self, values: Array) -> Array:
        """Coefficients (K + 1, N, *shape) from the tape's values (K + 1, N, M)."""
        orders, times = values.shape[:2]
        if not len(self.positions):
            once = np.zeros((orders, 1, *self.shape))
            once[0] = self.fixed.reshape(self.shape)
            # What np.broadcast_to does, at a fifth of its price: it is called for every matrix.
            strides = (once.strides[0], 0, *once.strides[2:])
            repeated: Array = np.ndarray((orders, times, *self.shape), float, once, 0, strides)
            repeated.flags.writeable = False
            return repeated
        flat = np.zeros((orders, times, len(self.fixed)))
        flat[0] = self.fixed
        flat[:, :, self.positions] = values[:, :, self.columns]
        return flat.reshape(orders, times, *self.shape)


@dataclass(frozen=True, eq=False)
class TextCoefficients:
    """The matrices of a plant given as text; a ``CoefficientSource``.

    All entries that depend on time are evaluated together, equal ones once. Matrices that do not
    depend on time come as read-only broadcast arrays.
    """

    tape: Tape
    layouts: Mapping[str, _Layout]  # by the names in MATRIX_NAMES
    unknowns: Tape  # theta on its own
    signals: Mapping[str, frozenset[str]]  # what a matrix depends on, by the same names
    outputs: frozenset[str]
    name: str
    restricted: TextCoefficients | None = None  # ``of_time``, where that is something else
    divisors: tuple[Expression, ...] = ()  # continuous ones of outputs, with the text they stand in

    @cached_property
    def constant(self) -> frozenset[str]:
        """Those of ``MATRIX_NAMES`` that do not depend on time."""
        return frozenset(k for k, layout in self.layouts.items() if not len(layout.positions))

    @cached_property
    def zero(self) -> frozenset[str]:
        """Those of ``constant`` that vanish."""
        return frozenset(k for k in self.constant if not self.layouts[k].fixed.any())

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        """All matrices at the times ``t`` (N,) in seconds, to ``order``; see the protocol.

        Raises:
            ConfigError: an entry without a finite value or derivative; names it and the time. Or
                a matrix depends on an output, and there are no signals.
        """
        if signals is None:
            for matrix, names in self.signals.items():
                if not names.isdisjoint(self.outputs):
                    raise ConfigError(
                        f"plant {self.name}: {matrix} depends on the output "
                        f"{min(names & self.outputs)}, which is not known here"
                    )
        t = np.asarray(t, dtype=np.float64)
        filled = self._assembly.taylor(t, order, inside, signals)
        if filled is None:
            values = self.tape.taylor(t, order, inside, signals)
            filled = tuple(self.layouts[k].assemble(values) for k in MATRIX_NAMES)
        found = Coefficients._make(filled)
        if signals is None:
            return found
        if self.divisors:
            self._refuse_crossings(t, inside, signals)
        return found.along(signals)

    @cached_property
    def _divisors(self) -> Tape:
        return record(self.divisors)

    def _refuse_crossings(self, t: Array, inside: Array | None, signals: Array) -> None:
        """Refuse a divisor whose sign differs at two times that follow each other."""
        ascending = np.argsort(t, kind="stable")
        values = self._divisors.taylor(t, 0, inside, signals[:1])[0][ascending]
        crossed = np.argwhere(values[1:] * values[:-1] < 0.0)
        if len(crossed):
            k, j = crossed[0]
            where, (before, after) = self.divisors[j], values[k : k + 2, j]
            first, then = t[ascending][k : k + 2]
            at = first + (then - first) * before / (before - after)
            raise ConfigError(
                f"{where.where} = {shorten(where.text)} divides by something that passes through "
                f"zero near t = {at:.6g}"
            )

    def entries(self, t: Array, order: int, inside: Array | None = None) -> Entries:
        """All entries that are not zero at the times t (N,), as ``model.entries`` has them."""
        moving = self.tape.taylor(np.asarray(t, dtype=np.float64), order, inside)
        values: dict[str, Array] = {}
        places: dict[str, tuple[NDArray[np.intp], ...]] = {}
        for name, layout in self.layouts.items():
            fixed = np.flatnonzero(layout.fixed)
            there = np.concatenate([fixed, layout.positions])
            found = np.zeros((order + 1, len(t) if len(layout.positions) else 1, len(there)))
            found[0, :, : len(fixed)] = layout.fixed[fixed]
            if len(layout.positions):
                found[:, :, len(fixed) :] = moving[:, :, layout.columns]
            values[name] = found
            places[name] = np.unravel_index(there, layout.shape)
        return Entries(Coefficients(**values), places)

    @property
    def of_time(self) -> TextCoefficients:
        """The same with zero for entries that depend on outputs."""
        return self.restricted or self

    def truth(self, t: Array) -> Array:
        """True values of the unknowns at the times ``t`` (N,), shape (N, q)."""
        values: Array = self.unknowns.taylor(t, 0)[0]
        return values

    @cached_property
    def _assembly(self) -> Assembly:
        layouts = [self.layouts[name] for name in MATRIX_NAMES]
        targets = np.empty((len(self.tape.outputs), 2), dtype=np.intp)
        for matrix, layout in enumerate(layouts):
            targets[layout.columns, 0] = matrix
            targets[layout.columns, 1] = layout.positions
        fixed = tuple(layout.fixed.reshape(layout.shape) for layout in layouts)
        return Assembly(self.tape, targets, fixed)

    def breakpoints(self, start: float, stop: float) -> Array:
        """Times strictly between ``start`` and ``stop``, sorted, of jumps and kinks."""
        if (start, stop) not in self._breakpoints:
            self._breakpoints[start, stop] = breakpoints_of_tape(self.tape, start, stop)
        return self._breakpoints[start, stop].copy()

    @cached_property
    def _breakpoints(self) -> dict[tuple[float, float], Array]:
        return {}

    def resolved(self, edges: Array) -> Array:
        """Edges of cells in which nothing narrow hides, from edges (K + 1,); see the protocol."""
        key = edges.tobytes()
        if key not in self._resolved:
            self._resolved[key] = resolved(self._bounds, edges)
        return self._resolved[key]

    @cached_property
    def _resolved(self) -> dict[bytes, Array]:
        return {}

    @cached_property
    def _bounds(self) -> Bounds:
        return Bounds(self.tape.of([k for k in self.tape.outputs if k in self.tape.of_time]))


def plant_from_mapping(
    mapping: Mapping[str, object], source: str = "", kind: str = "plant"
) -> DescriptorSystem:
    """Build a plant from the plain data of its file.

    Args:
        mapping: the KEYS of a plant file; one that is absent, None or empty is the same.
        source: the file, for messages.
        kind: what it is called in messages; only a plant needs states.

    Raises:
        ConfigError: anything that is missing, unknown, of the wrong kind or size, or not an
            expression of the language of ``gpebo_cli.model.expressions``.
    """
    file = f" ({source})" if source else ""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{kind}{file} must be a mapping with the keys {', '.join(KEYS)}")
    name = _plant_name(mapping.get("name"), file, kind)
    plant = f"{kind} {name}{file}"
    for key in mapping:
        if key not in KEYS:
            hint = nearest(str(key), KEYS)
            raise ConfigError(
                f"{plant}: unknown key {_show(key)}{hint} (accepted: {', '.join(KEYS)})"
            )
    mapping = with_archive(mapping, source, plant)

    states = _names(plant, "states", _required(mapping, "states", plant))
    if not states and kind == "plant":
        raise ConfigError(f"{plant}: states is empty; a plant has at least one state")
    inputs = _named_values(plant, "inputs", mapping.get("inputs"), "{V: sin(t)}")
    unknowns = _named_values(plant, "unknowns", mapping.get("unknowns"), "{theta1: 1.5}")
    outputs = _names(plant, "outputs", _or_empty(mapping.get("outputs"), ()))
    kinds = {
        "a state": states,
        "an input": tuple(inputs),
        "an unknown": tuple(unknowns),
        "an output": outputs,
    }
    elsewhere = _kind_of_name(plant, kinds)
    signals = {
        name: signal(name, place, elsewhere[name])
        for place, name in enumerate((*inputs, *outputs))
    }
    clash = [name for name in unknowns if name.startswith("e0_") and name[3:] in states]
    if clash:
        raise ConfigError(
            f"{plant}: the unknown {clash[0]} has the name of the estimated initial error of "
            f"the state {clash[0][3:]}; choose another name"
        )
    parameters = read_parameters(plant, mapping.get("parameters"), signals, elsewhere)

    everything = {**signals, **parameters}

    def read(value: object, where: str, allowed: Mapping[str, str] | None = None) -> Expression:
        known = parameters if allowed is None else everything
        expression = parse(value, known, f"{plant}: {where}", elsewhere)
        _check_signals(expression, elsewhere, allowed or {}, where.partition("[")[0])
        return expression

    rows = _Side("state", states)
    u = [read(value, f"inputs.{label}") for label, value in inputs.items()]
    driven, sought = _Side("input", tuple(inputs)), _Side("unknown", tuple(unknowns))
    measured = _Side("output", outputs)
    sides = {
        "E": (rows, rows, _OF_TIME),
        "A": (rows, rows, _OF_ALL),
        "F": (rows, sought, _OF_ALL),
        "C": (measured, rows, _OF_INPUTS),
        "D": (measured, driven, _OF_INPUTS),
        "H": (measured, sought, _OF_INPUTS),
        "B": (rows, driven, _OF_ALL),
    }
    known = _known_term(plant, mapping.get("phi"), rows)
    entries: dict[str, _Entries] = {
        "phi": (
            (len(states),),
            {i: read(value, f"phi[{i}]", _OF_ALL) for i, value in enumerate(known)},
        )
    }
    for key, (down, across, allowed) in sides.items():
        # Unknowns may be in the outputs only; inputs too, or in other matrices.
        elsewhere_too = {"D", "H"}
        if not _is_empty(mapping.get("H")):
            elsewhere_too.add("F")
        named = any(
            not e.node.signals.isdisjoint(inputs)
            for _, given in entries.values() for e in given.values()
        )
        if named or not _is_empty(mapping.get("D")):
            elsewhere_too.add("B")
        needed = key not in elsewhere_too
        grid = _matrix(plant, key, mapping.get(key), down, across, needed=needed)
        width = len(across.names)
        entries[key] = (
            (len(down.names), width),
            {
                i * width + j: read(value, f"{key}[{i}][{j}]", allowed)
                for i, row in enumerate(grid)
                for j, value in row
                if type(value) not in (int, float) or value != 0  # most of a large matrix are 0
            },
        )
    entries["u"] = (len(inputs),), dict(enumerate(u))

    theta = [read(value, f"unknowns.{label}") for label, value in unknowns.items()]
    entries["theta"] = (len(unknowns),), dict(enumerate(theta))
    given = _initial_values(plant, _required(mapping, "initial_state", plant), states)
    initial = [read(value, f"initial_state.{label}").value for label, value in given.items()]
    return DescriptorSystem(
        name=name,
        states=states,
        coefficients=_coefficients(entries, u, frozenset(outputs), name),
        initial_state=np.array(initial),
        inputs=tuple(inputs),
        unknowns=tuple(unknowns),
        outputs=outputs,
        theta=np.array([e.value if e.is_constant else np.nan for e in theta]),
        title=_line(plant, "title", mapping.get("title")),
        reference=_line(plant, "reference", mapping.get("reference")),
        source=source,
        units=_texts(plant, "units", mapping, tuple(elsewhere)),
        labels=_labels(plant, mapping, (*elsewhere, *(f"e0_{state}" for state in states))),
        observer_defaults=dict(_mapping(plant, "observer_defaults", mapping)),
    )


def _check_signals(
    expression: Expression, kinds: Mapping[str, str], allowed: Mapping[str, str], key: str
) -> None:
    """Refuse signals that may not stand in what ``key`` names, also inside of parameters."""
    for name in sorted(expression.node.signals):
        why = allowed.get(kinds[name], "")
        if kinds[name] not in allowed or why:
            raise ConfigError(
                f"{expression.where} = {shorten(expression.text)}: {name} is {kinds[name]} and "
                f"may not stand in {key}{why}"
            )


def _coefficients(
    entries: Mapping[str, _Entries],
    inputs: Sequence[Expression],
    outputs: frozenset[str],
    name: str,
    restricted: TextCoefficients | None = None,
) -> TextCoefficients:
    if restricted is None and any(
        not e.node.signals.isdisjoint(outputs)
        for _, given in entries.values() for e in given.values()
    ):
        kept = {
            key: (shape, {k: e for k, e in given.items() if e.node.signals.isdisjoint(outputs)})
            for key, (shape, given) in entries.items()
        }
        restricted = _coefficients(kept, inputs, outputs, name)
    varying: list[Expression] = []
    layouts: dict[str, _Layout] = {}
    for key, (shape, given) in entries.items():
        fixed = np.zeros(prod(shape))
        constant = {k: e.value for k, e in given.items() if e.is_constant}
        fixed[list(constant)] = list(constant.values())
        moving = {k: e for k, e in given.items() if k not in constant}
        layouts[key] = _Layout(
            shape,
            fixed,
            np.array(list(moving), dtype=np.intp),
            np.arange(len(varying), len(varying) + len(moving), dtype=np.intp),
        )
        varying += moving.values()
    signals = {
        key: frozenset[str]().union(*(e.node.signals for e in given.values()))
        for key, (_, given) in entries.items()
    }
    depending = {key: signals[key] for key in MATRIX_NAMES if signals[key]}
    truth = record(list(entries["theta"][1].values()))
    divisors = tuple(
        Expression(node, e.text, e.where) for e in varying for node in divisors_of(e.node)
        if not node.signals.isdisjoint(outputs)
    )
    return TextCoefficients(
        record(varying, inputs), layouts, truth, depending, outputs, name, restricted, divisors
    )


@dataclass(frozen=True)
class _Side:
    """What the rows or the columns of a matrix stand for."""

    noun: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        """``there are 2 inputs (V, I)``, for messages."""
        verb = "is" if len(self.names) == 1 else "are"
        named = f" ({_listed(self.names)})" if self.names else ""
        return f"there {verb} {_count(len(self.names), self.noun)}{named}"


def _listed(names: Sequence[str], limit: int = 8) -> str:
    """The names with commas, the first ``limit`` of them."""
    rest = [] if len(names) <= limit else ["..."]
    return ", ".join([*names[:limit], *rest])


def _count(number: int, noun: str) -> str:
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else plural}"


def _list(value: object) -> list[object] | None:
    """The items of a list, None for anything else (text is not a list of letters)."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return list(value)
    return None


def _show(value: object) -> str:
    """Any value, short: aliases can make a small YAML file a gigantic nested list."""
    return shorten(value if isinstance(value, str) else reprlib.repr(value))


def _or_empty(value: object, empty: object) -> object:
    """The value, or ``empty`` where the key is absent or has nothing behind it."""
    return empty if value is None else value


def _required(mapping: Mapping[str, object], key: str, plant: str) -> object:
    value = mapping.get(key)
    if value is None:
        raise ConfigError(f"{plant}: {key} is missing")
    return value


def _plant_name(value: object, file: str, kind: str) -> str:
    if value is None:
        raise ConfigError(f"{kind}{file}: name is missing")
    if not isinstance(value, str) or not _PLANT_NAME.fullmatch(value):
        raise ConfigError(
            f"{kind}{file}: name is {_show(value)}; write text of letters, digits, "
            "'_', '-', '.' and blanks that starts with a letter or digit (it names folders)"
        )
    return value


def _line(plant: str, key: str, value: object) -> str:
    """A one-line text; the breaks of folded YAML text become blanks."""
    if value is None:
        return ""
    if isinstance(value, bool | Mapping) or _list(value) is not None:
        raise ConfigError(f"{plant}: {key} must be one line of text; quote it")
    return " ".join(str(value).split())


def _mapping(plant: str, key: str, mapping: Mapping[str, object]) -> Mapping[str, object]:
    value = _or_empty(mapping.get(key), {})
    if not isinstance(value, Mapping):
        raise ConfigError(f"{plant}: {key} must be a mapping, not {_show(value)}")
    return value


def _name(plant: str, key: str, value: object) -> str:
    """A name that can head a column and stand in an expression."""
    if isinstance(value, bool):
        raise ConfigError(
            f"{plant}: {key} has the boolean {str(value).lower()} as a name; quote it "
            f"({_YAML_BOOLEAN})"
        )
    if not (isinstance(value, str) and value.isascii() and value.isidentifier()):
        raise ConfigError(
            f"{plant}: {key} has the name {_show(value)}; a name is made of the letters "
            "a-z, A-Z, digits and _, and starts with no digit"
        )
    if value in RESERVED:
        raise ConfigError(
            f"{plant}: {key} has the name {value}, which is reserved "
            f"(reserved: {', '.join(sorted(RESERVED))})"
        )
    return value


def _names(plant: str, key: str, value: object) -> tuple[str, ...]:
    items = _list(value)
    if items is None:
        raise ConfigError(
            f"{plant}: {key} must be a list of names such as [x1, x2], not {_show(value)}"
        )
    return tuple(_name(plant, key, item) for item in items)


def _named_values(plant: str, key: str, value: object, example: str) -> dict[str, object]:
    if value is None or value == []:
        return {}
    if not isinstance(value, Mapping):
        raise ConfigError(
            f"{plant}: {key} must map names to values, such as {example}, not {_show(value)}"
        )
    return {_name(plant, key, label): item for label, item in value.items()}


def _kind_of_name(plant: str, kinds: Mapping[str, Iterable[str]]) -> dict[str, str]:
    """Which kind each name is; refuses names given twice, because columns are found by name."""
    seen: dict[str, str] = {}
    for kind, names in kinds.items():
        for name in names:
            if name in seen:
                twice = f"{kind} twice" if seen[name] == kind else f"{seen[name]} and {kind}"
                raise ConfigError(f"{plant}: {name} is {twice}; every name must be used once")
            seen[name] = kind
    return seen


def read_parameters(
    plant: str, value: object, signals: Mapping[str, Expression], elsewhere: Mapping[str, str]
) -> dict[str, Expression]:
    """The named expressions of a file, each of which may use those above it.

    Args:
        plant: what the file is, for messages.
        value: of its key ``parameters``.
        signals: inputs and outputs by name.
        elsewhere: names that may not be used, with what they are.

    Raises:
        ConfigError: a value that is no expression of the language, or a name that cannot be one.
    """
    given = _named_values(plant, "parameters", value, "{R: 2 + sin(t)}")
    if len(given) > _MAX_PARAMETERS:
        raise ConfigError(f"{plant}: {len(given)} parameters; at most {_MAX_PARAMETERS} are read")
    parameters: dict[str, Expression] = {}
    known = dict(signals)
    later = dict.fromkeys(given, "a parameter defined further down")
    refused = ChainMap(later, dict(elsewhere))
    for label, item in given.items():
        if keyword.iskeyword(label):
            raise ConfigError(
                f"{plant}: parameters has the name {label}, a word of Python that cannot stand "
                f"in an expression; write {label}_ or another name"
            )
        where = f"{plant}: parameters.{label}"
        later[label] = "this parameter itself"
        known[label] = parameters[label] = parse(item, known, where, refused)
    return parameters


def _matrix(
    plant: str, key: str, value: object, down: _Side, across: _Side, *, needed: bool
) -> list[list[tuple[int, object]]]:
    """The entries of a matrix by row, each with its column; sizes checked.

    None where there are none and none are ``needed``. Of a sparse matrix those that it has.
    """
    n_rows, n_columns = len(down.names), len(across.names)
    if _is_empty(value) and not needed:
        return []
    if isinstance(value, np.ndarray) or is_sparse(value):
        return _numbers(plant, key, value, down, across)
    if isinstance(value, Mapping) and value:
        return _by_place(plant, key, value, down, across)
    if _is_empty(value):
        if n_rows and n_columns:
            why = across if down.noun == "state" else down
            raise ConfigError(
                f"{plant}: {key} is missing; {why}, so it needs {_count(n_rows, 'row')} "
                f"of {n_columns}"
            )
        return []
    rows = _list(value)
    if rows is None:
        raise ConfigError(
            f"{plant}: {key} must be a list of {_count(n_rows, 'row')}, not {_show(value)}"
        )
    if len(rows) != n_rows:
        raise ConfigError(f"{plant}: {key} has {_count(len(rows), 'row')} but {down}")
    grid: list[list[tuple[int, object]]] = []
    for i, row in enumerate(rows):
        entries = _list(row)
        if entries is None:
            raise ConfigError(
                f"{plant}: {key}[{i}] must be a list, one entry per {across.noun}, not {_show(row)}"
            )
        grid.append(list(enumerate(entries)))
    widths = [len(row) for row in grid]
    for i, width in enumerate(widths):
        if width != widths[0]:
            raise ConfigError(
                f"{plant}: the rows of {key} differ: {key}[0] has length {widths[0]}, "
                f"{key}[{i}] has length {width}"
            )
    if widths[0] != n_columns:
        raise ConfigError(f"{plant}: {key} has {_count(widths[0], 'column')} but {across}")
    return grid


def _by_place(
    plant: str, key: str, value: Mapping[Any, object], down: _Side, across: _Side
) -> list[list[tuple[int, object]]]:
    """The entries of a mapping, by row and column: ``e1,il: -1`` or ``e1: {il: -1}``."""
    grid: list[dict[int, object]] = [{} for _ in down.names]
    places = [{name: i for i, name in enumerate(side.names)} for side in (down, across)]
    for label, given in value.items():
        row, comma, column = str(label).partition(",")
        if comma:
            given = {column: given}  # noqa: PLW2901  the same, written otherwise
        if not isinstance(given, Mapping):
            raise ConfigError(
                f"{plant}: {key} has {_show(label)}: {_show(given)}; write entries as "
                f"'row,column': value (in braces with quotation marks) or row: {{column: value}}"
            )
        i = _place(plant, f"{key}: row", row, down, places[0])
        for name, entry in given.items():
            j = _place(plant, f"{key}: column", str(name), across, places[1])
            if j in grid[i]:
                raise ConfigError(f"{plant}: {key} has the entry {row.strip()},{name} twice")
            grid[i][j] = entry
    return [sorted(row.items()) for row in grid]


def _place(
    plant: str, where: str, label: str, side: _Side, places: Mapping[str, int]
) -> int:
    """Of a row or column by its name, or by its number from 0 on."""
    label = label.strip()
    if label in places:
        return places[label]
    if label.isdecimal() and int(label) < len(side.names):
        return int(label)
    raise ConfigError(
        f"{plant}: {where} {_show(label)} is no {side.noun}{nearest(label, side.names)}, and no "
        f"number from 0 to {len(side.names) - 1}; {side}"
    )


def _numbers(
    plant: str, key: str, value: Any, down: _Side, across: _Side
) -> list[list[tuple[int, object]]]:
    """The same of an array, or of one of SciPy's sparse matrices."""
    shape = (len(down.names), len(across.names))
    if value.shape != shape:
        size = " × ".join(map(str, value.shape))
        raise ConfigError(
            f"{plant}: {key} is {size}, and {down} and {across}: expected {shape[0]} × {shape[1]}"
        )
    if isinstance(value, np.ndarray):
        return [list(enumerate(row)) for row in value.tolist()]
    csr = value.tocsr(copy=True)
    csr.sum_duplicates()
    columns, values, starts = csr.indices.tolist(), csr.data.tolist(), csr.indptr.tolist()
    return [
        list(zip(columns[a:b], values[a:b], strict=True)) for a, b in itertools.pairwise(starts)
    ]


def _is_empty(value: object) -> bool:
    return value is None or (isinstance(value, list) and not value)


def _known_term(plant: str, value: object, rows: _Side) -> list[object]:
    """φ, one entry for each equation."""
    if _is_empty(value):
        return [0] * len(rows.names)
    entries = _list(value)
    if entries is None:
        raise ConfigError(
            f"{plant}: phi must be a list of {_count(len(rows.names), 'entry')}, one for each row "
            f"of E, not {_show(value)}"
        )
    if len(entries) != len(rows.names):
        raise ConfigError(f"{plant}: phi has {_count(len(entries), 'entry')} but {rows}")
    return entries


def _initial_values(plant: str, value: object, states: tuple[str, ...]) -> dict[str, object]:
    """Initial value by state, in the order of the states."""
    if isinstance(value, Mapping):
        for label in value:
            if label not in states:
                raise ConfigError(
                    f"{plant}: initial_state has {_show(label)}, which is not a state"
                    f"{nearest(str(label), states)} (states: {_listed(states)})"
                )
        missing = [state for state in states if state not in value]
        if missing:
            raise ConfigError(f"{plant}: initial_state lacks {_listed(missing)}")
        return {state: value[state] for state in states}
    values = _list(value)
    if values is None:
        raise ConfigError(
            f"{plant}: initial_state must map states to numbers or list "
            f"{_count(len(states), 'number')}, not {_show(value)}"
        )
    if len(values) != len(states):
        raise ConfigError(
            f"{plant}: initial_state has {_count(len(values), 'value')} but "
            f"{_Side('state', states)}"
        )
    return dict(zip(states, values, strict=True))


def _texts(
    plant: str, key: str, mapping: Mapping[str, object], names: Sequence[str]
) -> dict[str, str]:
    texts: dict[str, str] = {}
    for label, text in _mapping(plant, key, mapping).items():
        if label not in names:
            raise ConfigError(
                f"{plant}: {key} has {_show(label)}, which is no state, input, output or "
                f"unknown{nearest(str(label), names)}"
            )
        texts[label] = _line(plant, f"{key}.{label}", text)
    return texts


def _labels(plant: str, mapping: Mapping[str, object], names: Sequence[str]) -> dict[str, str]:
    """Names as figures have them, in the mathematics of TeX without dollars."""
    labels = _texts(plant, "labels", mapping, names)
    for name, text in labels.items():
        if not 0 < len(text) <= _LONGEST_LABEL or "$" in text:
            raise ConfigError(
                f"{plant}: labels.{name}: expected 1 to {_LONGEST_LABEL} characters of TeX's "
                f"mathematics without $, as in i_L or \\theta_{{1}}, not {_show(text)}"
            )
    return labels
