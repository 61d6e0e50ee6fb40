"""How gains become an axis.

An estimator sees a regression Y = ψη and times at which to report; it knows nothing of plants.
Its gains may each be a number, a list, or ``logspace(a, b, n)``: every combination is one case,
and all cases are computed from one pass over the regression.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import product
from math import prod

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array

_LOGSPACE = re.compile(r"logspace\(\s*([^,()]+),\s*([^,()]+),\s*([^,()]+)\)")
_MAX_CASES = 10_000_000
_MANY = 8  # numbers, from which on looking at them one by one is what takes the time


def axis(value: object, where: str, *, positive: bool = True) -> tuple[float, ...]:
    """The values of one gain: a number, a list of numbers, or ``logspace(a, b, n)``.

    Raises:
        ConfigError: anything else, an empty list, or a value that is not finite and positive.

    Examples:
        >>> axis("logspace(0, 2, 3)", "estimator.gamma")
        (1.0, 10.0, 100.0)
    """
    if isinstance(value, str):
        value = _from_text(value, where)
    items = list(value) if isinstance(value, Sequence) else [value]
    if not items:
        raise ConfigError(f"{where} is an empty list; give a number, a list or logspace(a, b, n)")
    if len(items) > _MANY and set(map(type, items)) <= {float, np.float64}:
        values = np.array(items)
        if np.isfinite(values).all() and (values.min() > 0.0 or not positive):
            return tuple(values.tolist())
    return tuple(number(item, where, positive=positive) for item in items)


def _from_text(text: str, where: str) -> object:
    match = _LOGSPACE.fullmatch(text.strip())
    if match is None:
        return [text]  # a number that YAML left as text, 1e10 for instance
    low, high = (number(part, where, positive=False) for part in match.groups()[:2])
    count = number(match[3], where)
    if count != int(count) or not 1 <= count <= _MAX_CASES or max(abs(low), abs(high)) > 300:
        raise ConfigError(
            f"{where}: logspace({low:g}, {high:g}, {count:g}) needs exponents within ±300 and a "
            f"whole number of values up to {_MAX_CASES}"
        )
    return [float(x) for x in np.logspace(low, high, int(count))]


def number(value: object, where: str, *, positive: bool = True) -> float:
    """One finite number (and positive, unless told otherwise) or a ConfigError."""
    wanted = "a positive number" if positive else "a finite number"
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            raise ConfigError(
                f"{where}: {value!r} is not {wanted}, a list of them, or logspace(a, b, n)"
            ) from None
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ConfigError(f"{where}: expected {wanted}, got {value!r}")
    result = float(value)
    if not np.isfinite(result) or (positive and result <= 0):
        raise ConfigError(f"{where}: expected {wanted}, got {value!r}")
    return result


def combinations(axes: Mapping[str, Sequence[float]]) -> tuple[Mapping[str, float], ...]:
    """Every combination of the axes' values; the last axis varies fastest.

    Raises:
        ConfigError: more combinations than fit into one run.

    Examples:
        >>> [dict(case) for case in combinations({"alpha": [1.0], "gamma": [10.0, 100.0]})]
        [{'alpha': 1.0, 'gamma': 10.0}, {'alpha': 1.0, 'gamma': 100.0}]
    """
    total = prod(len(values) for values in axes.values())
    if total > _MAX_CASES:
        raise ConfigError(f"the gains make {total} cases; at most {_MAX_CASES} fit in one run")
    if len(axes) == 1:
        ((name, only),) = axes.items()
        return tuple([{name: value} for value in only])
    return tuple(dict(zip(axes, values, strict=True)) for values in product(*axes.values()))


def per_parameter(
    value: object, parameters: Sequence[str], where: str, *, positive: bool = False
) -> Array:
    """A number for every parameter, shape (p,), from a number, a list, or a mapping by name.

    Raises:
        ConfigError: the wrong number of values, an unknown name, or not a number.
    """
    p = len(parameters)
    names = ", ".join(parameters)
    if isinstance(value, Mapping):
        unknown = [key for key in value if key not in parameters]
        missing = [name for name in parameters if name not in value]
        if unknown or missing:
            problem = f"unknown {unknown[0]!r}" if unknown else f"no value for {missing[0]!r}"
            raise ConfigError(f"{where}: {problem}; the parameters are {names}")
        return np.array([number(value[k], f"{where}.{k}", positive=positive) for k in parameters])
    if isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) != p:
            raise ConfigError(
                f"{where} has {len(value)} values but there are {p} parameters ({names})"
            )
        return np.array([number(v, where, positive=positive) for v in value])
    return np.full(p, number(value, where, positive=positive))
