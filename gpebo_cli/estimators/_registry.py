"""Estimators by name; a plain field as an axis is one estimator for each value, run as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import get_type_hints

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators._base import axis, combinations
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.registry import Capability, Registry
from gpebo_cli.regression.estimator import Estimates, Estimator
from gpebo_cli.regression.linear import LinearRegression

_ESTIMATORS: Registry[Estimator] = Registry("estimator")
names, settings_of = _ESTIMATORS.names, _ESTIMATORS.settings_of


def build(settings: Mapping[str, object]) -> Estimator:
    """The estimator that ``settings["name"]`` asks for, with the remaining keys as its settings.

    Fields of the dataclass annotated ``float`` or ``int`` may be lists or ``logspace(a, b, n)``.

    Raises:
        ConfigError: unknown name or key, with the nearest known one.
    """
    several = {key: value for key, value in settings.items() if _is_axis(value)}
    hints = get_type_hints(_ESTIMATORS.find(settings)) if several else {}  # slow
    chosen = combinations({
        key: axis(value, f"estimator.{key}", "finite") for key, value in several.items()
        if hints.get(key) in (float, int)
    })
    each = tuple(_ESTIMATORS.build({**settings, **own}) for own in chosen)
    built = Several(chosen, each) if any(chosen) else each[0]
    _ = built.cases  # gains are read here, so that a wrong one is found before anything is run
    return built


def able(one: Estimator | None, capability: type[Capability], asked: str) -> Capability:
    """:meth:`Registry.able`, and a ConfigError that says so where there are several."""
    if isinstance(one, Several):
        keys = ", ".join(f"estimator.{key}" for key in one.chosen[0])
        raise ConfigError(
            f"{asked}; a list for {keys} makes several: give one value, or sweep over it with -m"
        )
    return _ESTIMATORS.able(one, capability, asked)


@dataclass(frozen=True)
class Several:
    """Estimators side by side; the cases of each are the cases of all, with what differs."""

    chosen: tuple[Mapping[str, float], ...]  # of each member, by field
    members: tuple[Estimator, ...]

    @property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """The cases of the first one, then of the second one, and so on."""
        pairs = zip(self.chosen, self.members, strict=True)
        return tuple({**own, **case} for own, member in pairs for case in member.cases)

    def estimate(self, regression: LinearRegression, t: Array) -> Estimates:
        """Prepare the estimates of all at the times t (M,)."""
        parts = tuple(member.estimate(regression, t) for member in self.members)
        return SeveralEstimates(parts, tuple(len(member.cases) for member in self.members))


@dataclass(frozen=True, eq=False)
class SeveralEstimates:
    """The estimates of :class:`Several`."""

    parts: tuple[Estimates, ...]
    counts: tuple[int, ...]  # of cases

    def delta(self, t: Array) -> Array | None:
        """Δ of all at the times t (M,), (cases, M); None where one has none."""
        found = [part.delta(t) for part in self.parts]
        rows = [
            np.broadcast_to(one, (count, len(t)))
            for one, count in zip(found, self.counts, strict=True) if one is not None
        ]
        return np.concatenate(rows) if len(rows) == len(found) else None

    @property
    def requirement(self) -> Requirement:
        """The first requirement that is not met, else that of the first estimator."""
        every = [part.requirement for part in self.parts]
        return next((one for one in every if not one.holds), every[0])

    def parameters(self, cases: slice) -> Array:
        """η̂ of some cases, (g, M, p)."""
        start, stop, _ = cases.indices(sum(self.counts))
        found = []
        for part, end, count in zip(self.parts, accumulate(self.counts), self.counts, strict=True):
            first, last = max(start - (end - count), 0), min(stop - (end - count), count)
            if first < last:
                found.append(part.parameters(slice(first, last)))
        return np.concatenate(found)


def _is_axis(value: object) -> bool:
    if isinstance(value, str):
        return value.strip().startswith("logspace(")
    return isinstance(value, Sequence)
