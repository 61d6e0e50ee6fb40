"""From a plain mapping to a frozen dataclass: every key known, every value of its type.

The dataclass is the schema. A field is found by its name, or by ``metadata["key"]`` where the
name is a word of Python's (``lambda``). ``metadata["range"]`` is the accepted range of a number,
ends included, and ``metadata["positive"]`` asks for more than zero. A field whose value is one of
several objects has ``metadata["one_of"]``, dataclasses by name: the key says which, and their
settings are keys beside it. Numbers may come as text: YAML 1.1 reads ``1e-9`` as a string, and
refusing it would help nobody.
"""

from __future__ import annotations

import difflib
import math
import os
import types
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import lru_cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from gpebo_cli.errors import ConfigError

if typing.TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

T = TypeVar("T")

LARGEST = 1e50
"""Largest number in plants, settings and samples: squares of products are numbers, too."""
_WORDS = frozenset({str, bytes, int, float, bool, type(None)})  # what is plain as it is
_SHOWN = 60  # characters of a wrong value that a message repeats


def nearest(given: str, known: Iterable[str]) -> str:
    """``"; did you mean x?"`` where one of the known names is near, else nothing.

    Examples:
        >>> nearest("gama", ["gamma", "lambda"])
        '; did you mean gamma?'
        >>> nearest("zzz", ["gamma", "lambda"])
        ''
    """
    folded = {name.casefold(): name for name in reversed(list(known))}  # a for A is the nearest
    near = difflib.get_close_matches(given[:_SHOWN].casefold(), folded, 1, cutoff=0.5)
    return f"; did you mean {folded[near[0]]}?" if near else ""


def unknown(what: str, given: object, known: Iterable[str], there: str = "known:") -> ConfigError:
    """The error for a name that is none: ``what`` is wrong, ``there`` are others, one is near."""
    names = [str(name) for name in known]
    return ConfigError(f"{what}; {there} {', '.join(names) or 'none'}{nearest(str(given), names)}")


def known_name(name: T, known: Collection[str], what: str, there: str = "known:") -> T:
    """``name``, one of those that are known, or an error as of :func:`unknown` (ConfigError)."""
    if name not in known:
        raise unknown(what, name, known, there)
    return name


def check_keys(given: Iterable[object], known: Collection[str], where: str) -> None:
    """Refuse a key of a file that is not among those that are known (ConfigError)."""
    for key in given:
        if key not in known:
            raise ConfigError(
                f"{where}: unknown key {shown(str(key))}{nearest(str(key), known)} "
                f"(accepted: {', '.join(known)})"
            )


def listed(names: Sequence[str]) -> str:
    """The names with commas, the first eight of them."""
    return ", ".join([*names[:8], *(["..."] if len(names) > 8 else [])])


def counted(number: int, noun: str) -> str:
    """``1 row``, ``2 rows``, ``3 entries``."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else plural}"


def quoting(values: object) -> str:
    """What to add to a message about a list, an item of which is the end of a call: ``0)``.

    Within brackets and braces a comma ends a value for YAML, that of ``max(y, 0)`` as well.
    """
    texts = [v for v in values if isinstance(v, str)] if isinstance(values, list) else []
    cut = any(text.count(")") > text.count("(") for text in texts)
    return "; within brackets and braces, quote what has a comma" * cut


def instant(t: float, digits: int = 4) -> str:
    """A time in seconds as messages tell it: in digits, a large one to hundredths."""
    return f"{t:.{digits}g}" if abs(t) < 10.0**digits else f"{round(t, 2):.15g}"


def shown(value: object) -> str:
    """A value as a message repeats it: on one line, printable, and not too long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer with too many digits, or a cycle
        return f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def plain(value: object) -> Any:
    """``value`` with arrays, tuples, ranges and paths as the lists and texts of a YAML file."""
    if isinstance(value, Mapping):  # most are words, and the rest of this takes longer
        return {k: one if type(one) in _WORDS else plain(one) for k, one in value.items()}
    if type(value) in _WORDS:
        return value
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(inner) for inner in value]
    if hasattr(value, "toarray"):  # SciPy's sparse matrices
        value = value.toarray()
    if hasattr(value, "tolist"):  # NumPy's arrays and scalars
        return plain(value.tolist())
    return os.fspath(value) if isinstance(value, os.PathLike) else value


@lru_cache(maxsize=64)
def checked(settings: T, where: str) -> T:
    """Settings that were made without :func:`read`, as that has them (ConfigError)."""
    return read(type(settings), vars(settings), where)


def read(cls: type[T], mapping: object, where: str) -> T:
    """An instance of the dataclass ``cls`` from plain data.

    Its fields are numbers, text, literals, lists, mappings, unions of them, or dataclasses; one
    annotated ``object`` takes anything. Keys of the mapping are the names of fields; what is absent
    has its default. Messages begin with ``where``, the name of the whole (ConfigError: not a
    mapping, an unknown or missing key, or a value of the wrong type).
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{where}: expected a mapping of keys to values, got {shown(mapping)}")
    if not is_dataclass(cls):
        raise TypeError(f"{cls!r} is not a dataclass")
    hints = _hints(cls)  # annotations are text, which is compiled to read it
    by_key, known = _by_key(cls), keys(cls)
    for key in mapping:
        known_name(key, known, f"{where}.{key}: no such key", f"{where} has")
    values: dict[str, Any] = {}
    for key, field in by_key.items():
        if "one_of" in field.metadata:
            values[field.name] = _chosen(field, key, mapping, where)
        elif key in mapping:
            value = convert(mapping[key], hints[field.name], f"{where}.{key}")
            _check_range(value, field, f"{where}.{key}")
            values[field.name] = value
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ConfigError(f"{where}.{key} is missing; it has no default")
    return cls(**values)


@lru_cache(maxsize=256)
def keys(cls: type) -> tuple[str, ...]:
    """The keys that :func:`read` knows for a dataclass, those of what it chooses from included."""
    found: dict[str, None] = {}
    for key, field in _by_key(cls).items():
        found[key] = None
        for option in field.metadata.get("one_of", {}).values():
            found |= dict.fromkeys(keys(option))
    return tuple(found)


_hints = lru_cache(maxsize=64)(typing.get_type_hints)


@lru_cache(maxsize=256)
def _by_key(cls: Any) -> dict[str, Field[Any]]:
    return {field.metadata.get("key", field.name): field for field in fields(cls)}


def _chosen(field: Field[Any], key: str, mapping: Mapping[Any, Any], where: str) -> Any:
    """The one of several objects that ``mapping[key]`` names, with its own keys as its settings."""
    options = field.metadata["one_of"]
    default = next(name for name, option in options.items() if isinstance(field.default, option))
    chosen = convert(mapping.get(key, default), Literal[tuple(options)], f"{where}.{key}")
    own = keys(options[chosen])
    for name, option in options.items():
        for other, its in _by_key(option).items():
            make = its.default_factory
            usual = its.default if make is MISSING else make()
            if other not in own and mapping.get(other, usual) != usual:
                raise ConfigError(
                    f"{where}.{other} is of {where}.{key}={name}, but the {key} is {chosen}"
                )
    return read(options[chosen], {k: mapping[k] for k in own if k in mapping}, where)


def _check_range(value: Any, field: Field[Any], where: str) -> None:
    if value is None:
        return
    if "range" in field.metadata:
        low, high = field.metadata["range"]
        if not low <= value <= high:
            upto = f"to {high:g}" if math.isfinite(high) else "or more"
            raise ConfigError(f"{where}: expected {low:g} {upto}, got {shown(value)}")
    if field.metadata.get("positive") and value <= 0:
        raise ConfigError(f"{where}: expected a positive number, got {shown(value)}")


def convert(value: object, kind: Any, where: str) -> Any:
    """``value`` as the annotated type ``kind``, or a ConfigError that names what is accepted.

    The type is ``Any`` because annotations are: ``float | None`` is not a ``type``.
    """
    if kind is object or kind is Any:
        return value
    origin, arguments, hint = get_origin(kind), get_args(kind), ""
    if origin is Union or origin is types.UnionType:
        if value is None and type(None) in arguments:
            return None
        for alternative in arguments:
            with suppress(ConfigError):  # the message below names all alternatives
                return convert(value, alternative, where)
    elif origin is Literal:
        if isinstance(value, str | bool | int) and value in arguments:
            return value
        hint = nearest(shown(value).strip("'"), map(str, arguments))
    elif is_dataclass(kind):
        return read(typing.cast("Any", kind), value, where)
    else:
        found = _scalar(value, kind) if origin is None else _collection(value, kind, where)
        if found is not None:
            return found
    raise ConfigError(f"{where}: expected {_describe(kind)}, got {shown(value)}{hint}")


def _collection(value: object, kind: Any, where: str) -> Any:
    """``value`` as a list or mapping, or None if it is not one of that kind."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is list and isinstance(value, Sequence) and not isinstance(value, str):
        return [convert(v, arguments[0], f"{where}[{i}]") for i, v in enumerate(value)]
    if origin is not list and isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ConfigError(f"{where}: names must be text, got {shown(key)}")
        return {k: convert(v, arguments[1], f"{where}.{k}") for k, v in value.items()}
    return None


def _scalar(value: object, kind: Any) -> Any:
    """``value`` as a number, text or truth value, or None if it is not one of that kind."""
    if kind not in (float, int):
        return value if isinstance(value, kind) else None
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value  # not by way of float: integers beyond 2**53 are kept
    found = _number(value)
    if found is None or not math.isfinite(found):
        return None
    if kind is float:
        return found
    return int(found) if found == int(found) else None


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None


Accepted = Literal["positive", "nonnegative", "finite"]
_WANTED = {
    "positive": (5e-324, "a positive number"), "nonnegative": (0.0, "0 or a positive number"),
    "finite": (-math.inf, "a finite number"),
}


def number(
    value: object, where: str, accept: Accepted = "positive", largest: float = LARGEST
) -> float:
    """One number, which may come as text (ConfigError)."""
    found = _number(value)
    if found is None and hasattr(value, "item"):  # a scalar of NumPy's
        found = _number(value.item())
    low, wanted = _WANTED[accept]
    if found is None or not math.isfinite(found) or found < low:
        raise ConfigError(f"{where}: expected {wanted}, got {shown(value)}")
    if abs(found) > largest:
        raise ConfigError(f"{where}: {found:g} is too large; numbers go up to {largest:g} here")
    return found


def per_name(
    value: object, names: Sequence[str], noun: str, where: str, accept: Accepted = "nonnegative",
    absent: float | None = None,
) -> NDArray[np.float64]:
    """A number for every name, shape (names,), from one for all, a list, or a mapping by name.

    Messages call the names ``noun`` and the setting ``where``. A name that a mapping leaves out has
    the value ``absent``; if that is None, the mapping has to name all (ConfigError: the wrong
    number of values, an unknown or missing name, or a wrong number).
    """
    import numpy as np

    there = f"the {noun}s are"
    if isinstance(value, Mapping):
        for key in value:
            known_name(key, names, f"{where}: there is no {noun} {key!r}", there)
        missing = [name for name in names if name not in value]
        if missing and absent is None:
            raise ConfigError(f"{where}: no value for {missing[0]!r}; {there} {', '.join(names)}")
        given = [value.get(name, absent) for name in names]
    elif isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) != len(names):
            raise ConfigError(
                f"{where} has {len(value)} values but there are {len(names)} {noun}s "
                f"({', '.join(names)})"
            )
        given = list(value)
    else:
        return np.full(len(names), number(value, where, accept))
    return np.array([
        number(one, f"{where}.{name}", accept) for name, one in zip(names, given, strict=True)
    ])


def _describe(kind: Any) -> str:
    """A type in the words of a person who writes YAML."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Union or origin is types.UnionType:
        return " or ".join(_describe(a) for a in arguments)
    if origin is Literal:
        return " or ".join(str(a) if str(a)[:1].isalnum() else shown(a) for a in arguments)
    if origin is list:
        return f"a list (each {_describe(arguments[0])})"
    if origin is not None:
        return f"a mapping of names (each {_describe(arguments[1])})"
    words = {
        float: "a finite number",
        int: "a whole number",
        bool: "true or false",
        str: "text",
        type(None): "null",
    }
    return words.get(kind, f"a mapping ({getattr(kind, '__name__', kind)})")
