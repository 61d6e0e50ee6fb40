"""Any estimator over a regression whose parameters are replaced at resets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain, islice, zip_longest

import numpy as np

from gpebo_cli.estimators._base import GainEstimator
from gpebo_cli.estimators._registry import Several, SeveralEstimates, able
from gpebo_cli.evidence.uncertainty import after_reset
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import beside_edges
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem, one_after_another
from gpebo_cli.regression.estimator import (
    Affine,
    Estimates,
    Estimator,
    Found,
    Moving,
    Recursion,
    Recursive,
    Resumable,
    ResumableEstimates,
    SampledEstimates,
    Windowed,
    WindowEstimates,
)
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Known, Reset
from gpebo_cli.regression.samples import SampledRegression

GoOn = Callable[[LinearRegression, Array, Known], WindowEstimates]  # from a window to the next

_FOLLOW = "observer.remedy=current_coordinates needs an estimator that can follow a state"
_GO_ON = "observer.remedy=reset needs an estimator that can go on after a reset"
_AT_SAMPLES = "observer.sample_time and streams need an estimator that works at samples"
_MOST = 1 << 23  # numbers of estimates of all cases, which are held at once
# Constraints alone determine the states.
_NOTHING = Requirement("none", True, {}, "there is nothing to estimate")


def tuned(estimator: Estimator, regression: LinearRegression) -> Estimator:
    """The estimator with numbers for gains that are ``auto``; one of another kind unchanged."""
    if regression.resets or regression.dynamics is not None:
        return estimator
    return tuned_for(
        estimator, lambda one: estimate(one, regression, regression.mesh.edges[-1:]).requirement
    )


def tuned_for(estimator: Estimator, requirement: Callable[[Estimator], Requirement]) -> Estimator:
    """:func:`tuned`, by what data make an estimator require."""
    if isinstance(estimator, Several):
        members = tuple(tuned_for(member, requirement) for member in estimator.members)
        return replace(estimator, members=members)
    return estimator.tuned(requirement) if isinstance(estimator, GainEstimator) else estimator


def goes_on(estimator: Estimator) -> bool:
    """Whether it takes a long regression window by window."""
    one = estimator.members[0] if isinstance(estimator, Several) else estimator
    return isinstance(one, Windowed)


def estimate(
    estimator: Estimator, regression: LinearRegression, t: Array, shown: Array | None = None
) -> Estimates:
    """``estimator.estimate`` from segment to segment, at the times t (M,), ascending.

    What is mixed is asked for at some of them, ``shown`` (k,); None: at all.
    At a reset η̂ becomes T η̂ + τ and the extension ``ExtensionState.after``. A time at which
    there is a reset belongs to what follows it.
    """
    if isinstance(estimator, Several):
        each = [estimate(member, regression, t, shown) for member in estimator.members]
        return SeveralEstimates(tuple(each), tuple(len(m.cases) for m in estimator.members))
    if not regression.p:
        return Found(np.zeros((len(estimator.cases), len(t), 0)), _NOTHING)
    if not regression.resets:
        moving: GoOn | None = None
        if regression.dynamics is not None:
            follow = able(estimator, Moving, _FOLLOW).estimate_moving
            moving = partial(follow, dynamics=regression.dynamics)
        few = len(estimator.cases) * t.size * regression.p <= _MOST
        if regression.long and few and isinstance(estimator, Windowed):
            shown = t if shown is None else shown
            return in_windows(moving or estimator.go_on, regression, t, shown)
        return moving(regression, t, ()) if moving else estimator.estimate(regression, t)
    segments = regression.segments
    first = np.searchsorted(beside_edges(t), [s.mesh.edges[0] for s in segments[1:]], side="left")
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


@dataclass(frozen=True)
class _Idle:
    """A recursion without parameters, of so many cases."""

    cases: int
    requirement: Requirement = _NOTHING

    def update(self, regression: SampledRegression) -> SampledEstimates:
        return SampledEstimates(np.zeros((self.cases, len(regression.t), 0)), None)


def at_samples(estimator: Estimator, parameters: Sequence[str]) -> Recursion:
    """``estimator.recursive`` for parameters of these names, of which there may be none.

    ConfigError: it does not work at samples, or a setting of it does not.
    """
    made = able(estimator, Recursive, _AT_SAMPLES).recursive(parameters)
    return made if parameters else _Idle(len(estimator.cases))


def in_windows(go_on: GoOn, regression: LinearRegression, t: Array, shown: Array) -> Found:
    """Estimates at the times t (M,) of a long regression, window by window.

    What an estimator holds is that of one window; from one to the next it goes on as after a reset
    that changes nothing. Δ is found at the times ``shown`` (k,).
    """
    etas: list[Array] = []
    deltas: list[Array | None] = []

    def parts() -> Iterator[WindowEstimates]:
        known: Known = ()
        start = None
        starts = [window.mesh.edges[0] for window in regression.windows()][1:]
        times = (np.split(each, np.searchsorted(each, starts)) for each in (t, shown))
        for own, looked, window in zip(*times, regression.windows(), strict=True):
            end = window.mesh.edges[-1]  # there may be no other time
            part = go_on(window, np.append(own, end), known)
            eta, delta = part.parameters(slice(None), start), part.delta(np.append(looked, end))
            etas.append(eta[:, :-1])
            deltas.append(None if delta is None else delta[:, :-1])
            known, start = part.reached, eta[:, -1]
            yield part

    running = parts()
    first = next(running)
    requirement = first.over(chain([first], running), regression.mesh.span)
    mixed = None if deltas[0] is None else np.concatenate([d for d in deltas if d is not None], 1)
    return Found(np.concatenate(etas, axis=1), requirement, mixed, shown)


def errors(
    estimator: Affine, regression: LinearRegression
) -> Sequence[tuple[ErrorsAt, Sequence[tuple[float, Array]]]]:
    """``estimator.errors`` from segment to segment, and what resets do to them, of every case.

    Of a long regression what one window needs is held.
    """
    if not (isinstance(estimator, Windowed) and (regression.resets or regression.long)):
        return [(own, ()) for own in estimator.errors(regression)]

    def parts() -> Iterable[LinearRegression]:
        return regression.segments if regression.resets else regression.windows()

    known, ends = list[Known]([()]), list[Known]()
    for part, reset in zip_longest(parts(), regression.resets):
        ends.append(estimator.go_on(part, part.mesh.edges[-1:], known[-1]).reached)
        known.append(ends[-1] if reset is None else [state.after(reset) for state in ends[-1]])
    starts = np.array([part.mesh.edges[0] for part in parts()])

    @lru_cache(maxsize=None if regression.resets else 1)
    def of_part(k: int) -> Sequence[ErrorsAt]:
        part = next(islice(parts(), k, None))
        return estimator.errors(part, known[k])  # type: ignore[call-arg]

    def of_case(g: int) -> tuple[ErrorsAt, Sequence[tuple[float, Array]]]:
        if not regression.resets:
            return one_after_another(starts, lambda k, t, inside: of_part(k)[g](t, inside)), ()
        meshes = [segment.mesh for segment in regression.segments]
        at_ends = [
            of_part(k)[g](mesh.edges[-1:], mesh.inside[-1, -1:]) for k, mesh in enumerate(meshes)
        ]
        # After a reset a law may keep where it started, too.
        more = at_ends[-1].C.shape[2] - at_ends[0].C.shape[2]
        others = np.zeros((1, regression.p, more))

        def at(k: int, t: Array, inside: Array) -> ErrorSystem:
            system = of_part(k)[g](t, inside)
            return system if k else system.with_constants(others)

        at_ends[0] = at_ends[0].with_constants(others)
        turns = []
        for reset, system, own in zip(regression.resets, at_ends, ends, strict=False):
            state = own[g * len(own) // len(estimator.cases)] if own else None
            turns.append((reset.time, after_reset(system, reset, state)))
        return one_after_another(starts, at), turns

    return [of_case(g) for g in range(len(estimator.cases))]


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
        cuts = np.searchsorted(beside_edges(t), [reset.time for reset in self.resets], side="left")
        pairs = zip(self.parts, np.split(t, cuts), strict=True)
        pieces = [part.delta(own) for part, own in pairs if len(own)]
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
