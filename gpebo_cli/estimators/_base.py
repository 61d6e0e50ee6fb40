"""How gains become an axis, and what every estimator has: cases, gains, a start.

An estimator sees a regression Y = ψη and times at which to report; it knows nothing of plants.
Its gains may each be a number, a list, or ``logspace(a, b, n)``: every combination is one case,
and all cases are computed from one pass over the regression.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from math import prod
from typing import Any, Self, TypeVar

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.regression.errors import ErrorSystem
from gpebo_cli.regression.estimator import Estimates, WindowEstimates
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known
from gpebo_cli.schema import LARGEST, Accepted, number, per_name

Part = TypeVar("Part", bound="GainEstimator")

_LOGSPACE = re.compile(r"logspace\(\s*([^,()]+),\s*([^,()]+),\s*([^,()]+)\)")
_LARGEST = 1e300  # of gains, which make up for the units of the regression
_MAX_CASES = 1_000_000
_AMPLE = 10.0  # times the least gain that would do: 1 % long before the end
_MANY = 8  # numbers, from which on looking at them one by one is what takes the time


@dataclass(frozen=True)
class _Gain:
    """What is written beside a field that is a gain."""

    accept: Accepted
    by_parameter: bool
    auto: bool
    relative: float | None


def gain(
    default: float | None, accept: Accepted = "positive", *, by_parameter: bool = False,
    auto: bool = False, relative: float | None = None,
) -> Any:
    """A field of an estimator that is a gain: a number, a list, or ``logspace(a, b, n)``.

    It may be ``by_parameter``, a mapping which makes one case; ``auto``, which
    :meth:`GainEstimator.tuned` replaces: the larger the gain the faster, and the requirement says
    which one is the least; ``relative``: None stands for this one without a unit, relative to
    something of the data so far, and no case names it.
    """
    declared = _Gain(accept, by_parameter, auto, relative)
    return field(default=default, metadata={"gain": declared})


@dataclass(frozen=True, kw_only=True)
class GainEstimator(ABC):
    """Settings of an estimator: fields declared by :func:`gain`, and where η̂ starts.

    A gain is a number, a list or ``logspace(a, b, n)`` (one case each), or, where it may be one by
    parameter, a mapping (one gain each).

    Attributes:
        initial: η̂ at the start, a number, one per parameter, or a mapping by parameter.
    """

    initial: object = 0.0

    def axes(self) -> dict[str, Sequence[float]]:
        """The gains as axes, in the order in which they are declared."""
        axes: dict[str, Sequence[float]] = {}
        for own in fields(self):
            declared = own.metadata.get("gain")
            if declared is None:
                continue
            value, where = getattr(self, own.name), f"estimator.{own.name}"
            if declared.by_parameter and isinstance(value, Mapping):
                for key, of_one in value.items():
                    axes[f"{own.name}_{key}"] = (number(of_one, f"{where}.{key}", declared.accept),)
            elif declared.auto and is_auto(value):
                axes[own.name] = (float("nan"),)
            elif value is not None or declared.relative is None:
                given = own.default if value is None else value
                axes[own.name] = axis(given, where, declared.accept)
        return axes

    @cached_property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """Every combination of the gains; the last one that is declared varies fastest."""
        return combinations(self.axes())

    def tuned(self, requirement: Callable[[Self], Requirement]) -> Self:
        """The estimator with a number for a gain that is ``auto``: ten times the least that does.

        The least is that of the ``requirement`` for γ = 1 over all of the data; where no gain
        would do, it is the default one.
        """
        chosen = {}
        for own in fields(self):
            if "gain" in own.metadata and is_auto(getattr(self, own.name)):
                once: dict[str, Any] = {own.name: 1.0}
                least = requirement(replace(self, **once)).gain
                chosen[own.name] = _AMPLE * least if 0.0 < least < np.inf else own.default
        return replace(self, **chosen) if chosen else self

    def gains(self, name: str, parameters: Sequence[str]) -> Array:
        """The values of one gain, shape (g, 1), or (1, p) where it is a mapping by parameter.

        ConfigError: a mapping that does not name every parameter.
        """
        value, where = getattr(self, name), f"estimator.{name}"
        if value is None:
            own = type(self).__dataclass_fields__[name]
            relative = own.metadata["gain"].relative
            value = own.default if relative is None else relative
        if is_auto(value):
            raise ConfigError(
                f"{where}: auto needs to know the signals to their end; give a number with resets "
                "and in streams"
            )
        if isinstance(value, Mapping):
            return per_name(value, parameters, "parameter", where, "positive")[None]
        return np.array(axis(value, where))[:, None]

    def start(self, parameters: Sequence[str]) -> Array:
        """η̂ at the start, shape (p,)."""
        return per_name(self.initial, parameters, "parameter", "estimator.initial", "finite")

    def part(self, kind: type[Part]) -> Part:
        """Another estimator with these settings, as far as it has them, that this one rests on."""
        return kind(**{own.name: getattr(self, own.name) for own in fields(kind)})

    @abstractmethod
    def estimate(self, regression: LinearRegression, t: Array) -> Estimates:
        """Prepare the estimates at the times t (M,), ascending."""


@dataclass(frozen=True, kw_only=True)
class WindowedEstimator(GainEstimator):
    """A :class:`GainEstimator` that takes a long regression window by window."""

    def estimate(self, regression: LinearRegression, t: Array) -> WindowEstimates:
        """Prepare the estimates at the times t (M,), ascending; nothing is known before."""
        return self.go_on(regression, t, ())

    @abstractmethod
    def go_on(self, regression: LinearRegression, t: Array, known: Known) -> WindowEstimates:
        """Prepare the estimates at the times t (M,), with what is known at the start."""


@dataclass(frozen=True, kw_only=True)
class ResumableEstimator(WindowedEstimator):
    """One that can go on after a reset, too (observer.remedy: reset)."""

    def go_on(self, regression: LinearRegression, t: Array, known: Known) -> WindowEstimates:
        """As after a reset that changes nothing, at the times t (M,)."""
        return self.resume(regression, t, known)

    @abstractmethod
    def resume(self, regression: LinearRegression, t: Array, known: Known) -> WindowEstimates:
        """Prepare the estimates at the times t (M,), with extensions known at the start."""


def filtered_errors(
    filters: Array, into: Array, law: Array, forcing: Array, out: Array | None = None
) -> ErrorSystem:
    """Errors of filters with s states behind Y, and of a law with q behind the filters.

        δf' = −filters δf + into δY,      δs' = −law δs + forcing δf,      δη̂ = out δs or δs

    Filters are rates (s,) or (N, s), or matrices (N, s, s); the others are matrices (N, …, …).
    """
    (count, s, rows), q = into.shape, law.shape[-1]
    A = np.zeros((count, s + q, s + q))
    A[:, :s, :s] = -(filters if filters.ndim == 3 else filters[..., None] * np.eye(s))
    A[:, s:, :s], A[:, s:, s:] = forcing, -law
    B = np.concatenate([into, np.zeros((count, q, rows))], axis=1)
    out = np.eye(q)[None] if out is None else out
    C = np.concatenate([np.zeros((*out.shape[:2], s)), out], axis=2)
    return ErrorSystem(A, B, C, np.zeros((1, out.shape[1], rows)))


def is_auto(value: object) -> bool:
    """Whether a gain is to be chosen when the excitation is known."""
    return isinstance(value, str) and value == "auto"


def axis(value: object, where: str, accept: Accepted = "positive") -> tuple[float, ...]:
    """The values of one gain: a number, a list of numbers, or ``logspace(a, b, n)``.

    Raises:
        ConfigError: anything else, an empty list, or a value that is not accepted.

    Examples:
        >>> axis("logspace(0, 2, 3)", "estimator.gamma")
        (1.0, 10.0, 100.0)
    """
    if isinstance(value, str):
        value = _from_text(value, where)
    items = list(value) if isinstance(value, Sequence) else [value]
    if not items:
        raise ConfigError(f"{where} is an empty list; give a number, a list or logspace(a, b, n)")
    largest = _LARGEST if accept == "positive" else LARGEST
    if len(items) > _MANY and set(map(type, items)) <= {float, np.float64}:
        values = np.array(items)
        if values.max() <= largest and values.min() > 0.0:
            return tuple(values.tolist())
    return tuple(number(item, where, accept, largest) for item in items)


def _from_text(text: str, where: str) -> object:
    match = _LOGSPACE.fullmatch(text.strip())
    if match is None:
        try:
            return float(text)  # a number that YAML left as text, 1e10 for instance
        except ValueError:
            raise ConfigError(
                f"{where}: {text!r} is not a positive number, a list of them, or logspace(a, b, n)"
            ) from None
    low, high = (number(part, where, "finite") for part in match.groups()[:2])
    count = number(match[3], where)
    if count != int(count) or not 1 <= count <= _MAX_CASES or max(abs(low), abs(high)) > 300:
        raise ConfigError(
            f"{where}: logspace({low:g}, {high:g}, {count:g}) needs exponents within ±300 and a "
            f"whole number of values up to {_MAX_CASES}"
        )
    return [float(x) for x in np.logspace(low, high, int(count))]


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
