"""Any estimator over a regression whose parameters are replaced at resets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.estimators._base import GainEstimator
from gpebo_cli.estimators._registry import Several, able
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.regression.estimator import (
    Estimates,
    Estimator,
    Found,
    Moving,
    Resumable,
    ResumableEstimates,
)
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Reset

_FOLLOW = "observer.remedy=current_coordinates needs an estimator that can follow a state"
_GO_ON = "observer.remedy=reset needs an estimator that can go on after a reset"


def tuned(estimator: Estimator, regression: LinearRegression) -> Estimator:
    """The estimator with numbers for gains that are ``auto``; one of another kind unchanged."""
    if regression.resets or regression.dynamics is not None:
        return estimator
    return tuned_for(
        estimator, lambda one: one.estimate(regression, regression.mesh.edges[-1:]).requirement
    )


def tuned_for(estimator: Estimator, requirement: Callable[[Estimator], Requirement]) -> Estimator:
    """:func:`tuned`, by what data make an estimator require."""
    if isinstance(estimator, GainEstimator | Several):
        return estimator.tuned(requirement)
    return estimator


def raised(estimator: Estimator, requirement: Requirement) -> Estimator:
    """The estimator, with higher gains where none were given and the default is too low."""
    return estimator.raised(requirement) if isinstance(estimator, GainEstimator) else estimator


def estimate(estimator: Estimator, regression: LinearRegression, t: Array) -> Estimates:
    """``estimator.estimate`` from segment to segment, at the times t (M,), ascending.

    At a reset η̂ becomes T η̂ + τ and the extension ``ExtensionState.after``. A time at which
    there is a reset belongs to what follows it.
    """
    if not regression.p:  # constraints alone determine the states
        nothing = Requirement("none", True, {}, "there is nothing to estimate")
        return Found(np.zeros((len(estimator.cases), len(t), 0)), nothing)
    if regression.dynamics is not None:
        moving = able(estimator, Moving, _FOLLOW)
        return moving.estimate_moving(regression, regression.dynamics, t)
    if not regression.resets:
        return estimator.estimate(regression, t)
    segments = regression.segments
    first = np.searchsorted(t, [s.mesh.edges[0] for s in segments[1:]], side="left")
    parts: list[ResumableEstimates] = []
    known: tuple[ExtensionState, ...] = ()
    resumable = able(estimator, Resumable, _GO_ON)
    for k, (segment, own) in enumerate(zip(segments, np.split(t, first), strict=True)):
        if k > 0:
            reset = regression.resets[k - 1]
            known = tuple(state.after(reset) for state in parts[-1].reached)
        # The end is added to the times that are asked for: there the next one takes over.
        times = np.append(own, segment.mesh.edges[-1])
        parts.append(resumable.resume(segment, times, known))
    return Chain(tuple(parts), regression.resets)


@dataclass(frozen=True, eq=False)
class Chain:
    """Estimates of each segment at its own times and its end."""

    parts: tuple[ResumableEstimates, ...]
    resets: tuple[Reset, ...]

    @property
    def reached(self) -> tuple[ExtensionState, ...]:
        """The extensions at the end of the last segment."""
        return self.parts[-1].reached

    def delta(self, t: Array) -> Array | None:
        """Δ at the times t (M,); it jumps where the parameters do."""
        cuts = np.searchsorted(t, [reset.time for reset in self.resets], side="left")
        pieces = [part.delta(own) for part, own in zip(self.parts, np.split(t, cuts), strict=True)]
        found = [piece for piece in pieces if piece is not None]
        return np.concatenate(found, axis=1) if found else None

    @property
    def requirement(self) -> Requirement:
        """What is needed, of the first segment that meets it, or of the last."""
        found = [part.requirement for part in self.parts]
        k = next((i for i, requirement in enumerate(found) if requirement.holds), len(found) - 1)
        text = f"in segment {k + 1} of the {len(found)} between resets, {found[k].text}"
        return replace(found[k], text=text)

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases, shape (g, M, p), each in the parameters of its time."""
        pieces: list[Array] = []
        for k, part in enumerate(self.parts):
            eta = part.parameters(cases, start)
            pieces.append(eta[:, :-1])
            if k < len(self.resets):
                start = self.resets[k].parameters(eta[:, -1])
        return np.concatenate(pieces, axis=1)
