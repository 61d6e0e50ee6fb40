"""What is found out about a run on the way: evidence as data, never a bare yes or no."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from typing import Any, Generic, TypeVar, overload

from gpebo_cli.kernels.threads import single

T = TypeVar("T")


class OnDemand(Generic[T]):
    """A field that may be given as a function without arguments, called when it is first read."""

    def __init__(self, default: Callable[[], T] | None = None) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_{name}"

    @overload
    def __get__(self, instance: None, owner: type) -> Callable[[], T]: ...
    @overload
    def __get__(self, instance: object, owner: type) -> T: ...
    def __get__(self, instance: object | None, owner: type) -> Callable[[], T] | T:
        if instance is None:  # dataclasses ask for the default
            if self._default is None:
                raise AttributeError
            return self._default
        values: dict[str, Any] = instance.__dict__
        if callable(values[self._name]):
            import numpy as np  # the command line's help does without

            with single(), np.errstate(all="ignore"):  # as in a run
                values[self._name] = values[self._name]()
        found: T = values[self._name]
        return found

    def __set__(self, instance: object, value: T | Callable[[], T]) -> None:
        instance.__dict__[self._name] = value


def replaced(instance: T, **changes: object) -> T:
    """``dataclasses.replace``, but what nobody has read is not found for the copy's sake."""
    held = vars(instance)
    names = [each.name for each in fields(instance)]  # type: ignore[arg-type]
    values = {name: held.get(f"_{name}", held.get(name)) for name in names}
    return type(instance)(**values | changes)


def evaluated(instance: object) -> dict[str, Any]:
    """What there is to be pickled of an instance: the values, and not how to find them."""
    with single():
        return {
            name: value() if name.startswith("_") and callable(value) else value
            for name, value in instance.__dict__.items()
        }


@dataclass(frozen=True)
class Direction:
    """A unit vector in parameter space, by name."""

    components: Mapping[str, float]

    def __str__(self) -> str:
        largest = max((abs(v) for v in self.components.values()), default=0.0)
        terms = [f"{v:+.3g} {k}" for k, v in self.components.items() if abs(v) >= 0.05 * largest]
        return " ".join(terms)


@dataclass(frozen=True)
class Requirement:
    """What an estimator needs of the regressor, and what it got."""

    name: str  # "PE", "IE", "Δ not in L2", ...
    holds: bool
    evidence: Mapping[str, float]
    text: str  # one sentence
    gain: float = float("nan")  # the least that would do, infinite if none does; NaN: it has none


@dataclass(frozen=True)
class Assumption:
    """One of the paper's assumptions (or a prerequisite), with its evidence."""

    name: str  # "Assumption 1", ...
    statement: str  # what it says, one line
    holds: bool
    evidence: Mapping[str, float | int | str | None]


def would_do(gain: float, least: float) -> str:
    """What a requirement's text says of the least gain that would do, if this one is less."""
    if gain >= least:
        return ""
    return f": γ ≥ {least:.2g}" if isfinite(least) else ": no γ would do"
