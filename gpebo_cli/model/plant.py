"""From the plain data of a plant file to a :class:`DescriptorSystem`, checked at construction.

Every message names the plant, the key and the entry, and where two sizes disagree, both.
"""

from __future__ import annotations

import keyword
import re
from collections import ChainMap
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.archive import ARCHIVE, with_archive
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.model.expressions.syntax import RESERVED, Expression, no_word, parse, shorten, signal
from gpebo_cli.model.matrix import Side, brief, is_empty, items_of, matrix, per_row
from gpebo_cli.model.text import MatrixEntries, coefficients_of
from gpebo_cli.schema import check_keys, counted, listed, nearest, quoting

KEYS = (
    "name", "title", "reference", "parameters", "states", "inputs", "unknowns", "outputs",
    "E", "A", "B", "F", "phi", "C", "D", "H", "initial_state", "units", "labels",
    "observer_defaults", ARCHIVE,
)
"""Keys of a plant file; name, states, E, A and initial_state are required."""

# Which signals may stand in what, and why not others.
_OF_ALL = dict.fromkeys(("an input", "an output"), "")
_OF_INPUTS = {"an input": "", "an output": "; y = C x + D u + H θ would contain itself"}
_OF_TIME = dict.fromkeys(("an input", "an output"), ": its derivative would be needed")

_Read = Callable[[object, str, Mapping[str, str] | None], Expression]  # value, where, allowed

_PLANT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,79}")  # it becomes part of a folder's name
_LONGEST_LABEL = 80
_MAX_PARAMETERS = 10_000  # a few seconds' work
_YAML_BOOLEAN = "YAML reads on, off, yes and no as booleans"


def plant_from_mapping(
    mapping: Mapping[str, object], source: str = "", kind: str = "plant"
) -> DescriptorSystem:
    """Build a plant from the plain data of its file.

    Of the KEYS in the mapping one that is absent, None or empty is the same. Messages name the
    ``source``, its file, and what ``kind`` it is; only a plant needs states.

    Raises:
        ConfigError: anything that is missing, unknown, of the wrong kind or size, or not an
            expression of the language of ``gpebo_cli.model.expressions``.
    """
    file = f" ({source})" if source else ""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{kind}{file} must be a mapping with the keys {', '.join(KEYS)}")
    name = _required(mapping, "name", f"{kind}{file}")
    if not isinstance(name, str) or not _PLANT_NAME.fullmatch(name):
        raise ConfigError(
            f"{kind}{file}: name is {brief(name)}; write text of letters, digits, "
            "'_', '-', '.' and blanks that starts with a letter or digit (it names folders)"
        )
    plant = f"{kind} {name}{file}"
    check_keys(mapping, KEYS, plant)
    mapping = with_archive(mapping, source, plant)

    states = _names(plant, "states", _required(mapping, "states", plant))
    if not states and kind == "plant":
        raise ConfigError(f"{plant}: states is empty; a plant has at least one state")
    inputs = named_values(plant, "inputs", mapping.get("inputs"), "{V: sin(t)}")
    unknowns = named_values(plant, "unknowns", mapping.get("unknowns"), "{theta1: 1.5}")
    outputs = _names(plant, "outputs", mapping.get("outputs"))
    kinds = {
        "a state": states,
        "an input": tuple(inputs),
        "an unknown": tuple(unknowns),
        "an output": outputs,
    }
    elsewhere = kind_of_name(plant, kinds)
    signals = {
        name: signal(name, place, elsewhere[name])
        for place, name in enumerate((*inputs, *outputs))
    }
    parameters = read_parameters(plant, mapping.get("parameters"), signals, elsewhere)

    everything = {**signals, **parameters}

    def read(value: object, where: str, allowed: Mapping[str, str] | None) -> Expression:
        """ConfigError: signals that may not stand there, also inside of parameters."""
        known = parameters if allowed is None else everything
        expression = parse(value, known, f"{plant}: {where}", elsewhere)
        for name in sorted(expression.node.signals):
            why = (allowed or {}).get(elsewhere[name])
            if why != "":
                raise ConfigError(
                    f"{expression.where} = {shorten(expression.text)}: {name} is {elsewhere[name]} "
                    f"and may not stand in {where.partition('[')[0]}{why or ''}"
                )
        return expression

    where = "inputs" if kind == "plant" else "signals"
    u = [read(value, f"{where}.{label}", None) for label, value in inputs.items()]
    entries = _entries(plant, mapping, read, kinds)
    entries["u"] = (len(inputs),), dict(enumerate(u))
    for label, value in unknowns.items():
        if value is None:
            raise ConfigError(
                f"{plant}: unknowns.{label} is empty; write its true value, which simulations "
                "use, or any number where nobody knows it"
            )
    theta = [read(value, f"unknowns.{label}", None) for label, value in unknowns.items()]
    entries["theta"] = (len(unknowns),), dict(enumerate(theta))
    given = _initial_values(plant, _required(mapping, "initial_state", plant), states)
    initial = [read(value, f"initial_state.{label}", None).value for label, value in given.items()]
    return DescriptorSystem(
        name=name,
        states=states,
        coefficients=coefficients_of(entries, u, frozenset(outputs), name),
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


def _entries(
    plant: str, mapping: Mapping[str, object], read: _Read, kinds: Mapping[str, tuple[str, ...]]
) -> dict[str, MatrixEntries]:
    """What stands in φ and in each matrix; the names are those of states, inputs and so on."""
    rows, driven, sought, measured = (
        Side(kind.split()[1], names) for kind, names in kinds.items()
    )
    sides = {
        "E": (rows, rows, _OF_TIME),
        "A": (rows, rows, _OF_ALL),
        "F": (rows, sought, _OF_ALL),
        "C": (measured, rows, _OF_INPUTS),
        "D": (measured, driven, _OF_INPUTS),
        "H": (measured, sought, _OF_INPUTS),
        "B": (rows, driven, _OF_ALL),
    }
    phi, count = mapping.get("phi"), len(rows.names)
    must = f"be a list of {counted(count, 'entry')}, one for each row of E"
    known = [] if is_empty(phi) else per_row(f"{plant}: phi", phi, rows, must, "entry")
    entries: dict[str, MatrixEntries] = {
        "phi": ((count,), {i: read(value, f"phi[{i}]", _OF_ALL) for i, value in enumerate(known)})
    }
    for key, (down, across, allowed) in sides.items():
        # Unknowns may be in the outputs only; inputs too, or in other matrices.
        optional = key in "DH" or (key == "F" and not is_empty(mapping.get("H"))) or (
            key == "B" and (not is_empty(mapping.get("D")) or any(
                not e.node.signals.isdisjoint(driven.names)
                for _, given in entries.values() for e in given.values()
            ))
        )
        grid = matrix(f"{plant}: {key}", mapping.get(key), down, across, needed=not optional)
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
    return entries


def _required(mapping: Mapping[str, object], key: str, plant: str) -> object:
    value = mapping.get(key)
    if value is None:
        raise ConfigError(f"{plant}: {key} is missing")
    return value


def _line(plant: str, key: str, value: object) -> str:
    """A one-line text; the breaks of folded YAML text become blanks."""
    if value is None:
        return ""
    if isinstance(value, bool | Mapping) or items_of(value) is not None:
        raise ConfigError(f"{plant}: {key} must be one line of text; quote it")
    return " ".join(str(value).split())


def _mapping(plant: str, key: str, mapping: Mapping[str, object]) -> Mapping[str, object]:
    value = {} if mapping.get(key) is None else mapping[key]
    if not isinstance(value, Mapping):
        raise ConfigError(f"{plant}: {key} must be a mapping, not {brief(value)}")
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
            f"{plant}: {key} has the name {brief(value)}; a name is made of the letters "
            f"a-z, A-Z, digits and _, and starts with no digit{quoting([value])}"
        )
    if value in RESERVED:
        raise ConfigError(
            f"{plant}: {key} has the name {value}, which is reserved "
            f"(reserved: {', '.join(sorted(RESERVED))})"
        )
    return value


def _names(plant: str, key: str, value: object) -> tuple[str, ...]:
    items = [] if value is None else items_of(value)
    if items is None:
        raise ConfigError(
            f"{plant}: {key} must be a list of names such as [x1, x2], not {brief(value)}"
        )
    return tuple(_name(plant, key, item) for item in items)


def named_values(plant: str, key: str, value: object, example: str) -> dict[str, object]:
    """What a key of a file has by name, in its order (ConfigError: no mapping, or no names)."""
    if is_empty(value):
        return {}
    if not isinstance(value, Mapping):
        raise ConfigError(
            f"{plant}: {key} must map names to values, such as {example}, not {brief(value)}"
        )
    return {_name(plant, key, label): item for label, item in value.items()}


def kind_of_name(plant: str, kinds: Mapping[str, Collection[str]]) -> dict[str, str]:
    """Which kind each name is (ConfigError: one is given twice, and columns are found by name)."""
    seen: dict[str, str] = {}
    for kind, names in kinds.items():
        for name in names:
            if name in seen:
                twice = f"{kind} twice" if seen[name] == kind else f"{seen[name]} and {kind}"
                raise ConfigError(f"{plant}: {name} is {twice}; every name must be used once")
            seen[name] = kind
    states, unknowns = kinds["a state"], kinds["an unknown"]
    clash = [name for name in unknowns if name.startswith("e0_") and name[3:] in states]
    if clash:
        raise ConfigError(
            f"{plant}: the unknown {clash[0]} has the name of the estimated initial error of "
            f"the state {clash[0][3:]}; choose another name"
        )
    for name in {"parameters", "states"}.intersection((*unknowns, *states)):
        raise ConfigError(
            f"{plant}: {seen[name]} cannot be called {name}; seconds_to_1pct_{name} in "
            f"cases.csv is of all {name}"
        )
    return seen


def read_parameters(
    plant: str, value: object, signals: Mapping[str, Expression], elsewhere: Mapping[str, str]
) -> dict[str, Expression]:
    """The named expressions of a file, each of which may use those above it.

    Inputs and outputs are ``signals``; names that may not be used are ``elsewhere``, with what they
    are (ConfigError: a value that is no expression of the language, or a name that cannot be one).
    """
    given = named_values(plant, "parameters", value, "{R: 2 + sin(t)}")
    if len(given) > _MAX_PARAMETERS:
        raise ConfigError(f"{plant}: {len(given)} parameters; at most {_MAX_PARAMETERS} are read")
    parameters: dict[str, Expression] = {}
    known = dict(signals)
    later = dict.fromkeys(given, "a parameter defined further down")
    refused = ChainMap(later, dict(elsewhere))
    for label, item in given.items():
        if keyword.iskeyword(label):
            raise ConfigError(f"{plant}: parameters has the name {label}, {no_word(label)}")
        where = f"{plant}: parameters.{label}"
        later[label] = "this parameter itself"
        known[label] = parameters[label] = parse(item, known, where, refused)
    return parameters


def _initial_values(plant: str, value: object, states: tuple[str, ...]) -> dict[str, object]:
    """Initial value by state, in the order of the states."""
    if isinstance(value, Mapping):
        for label in value:
            if label not in states:
                raise ConfigError(
                    f"{plant}: initial_state has {brief(label)}, which is not a state"
                    f"{nearest(str(label), states)} (states: {listed(states)})"
                )
        missing = [state for state in states if state not in value]
        if missing:
            raise ConfigError(f"{plant}: initial_state lacks {listed(missing)}")
        return {state: value[state] for state in states}
    must = f"map states to numbers or list {counted(len(states), 'number')}"
    values = per_row(f"{plant}: initial_state", value, Side("state", states), must, "value")
    return dict(zip(states, values, strict=True))


def _texts(
    plant: str, key: str, mapping: Mapping[str, object], names: Sequence[str]
) -> dict[str, str]:
    texts: dict[str, str] = {}
    for label, text in _mapping(plant, key, mapping).items():
        if label not in names:
            raise ConfigError(
                f"{plant}: {key} has {brief(label)}, which is no state, input, output or "
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
                f"mathematics without $, as in i_L or \\theta_{{1}}, not {brief(text)}"
            )
    return labels
