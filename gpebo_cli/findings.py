"""What is found out about a run on the way: evidence as data, never a bare yes or no."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite


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
