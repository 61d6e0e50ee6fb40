"""How things are measured: alternating runs, medians, and the loosest tolerance that will do."""

from __future__ import annotations

import os
import re
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpebo_cli.model.descriptor import DescriptorSystem

Array = NDArray[np.float64]
Solve = Callable[[], Array]
Prepare = Callable[[float], Solve]  # a tolerance -> what is timed
_SLOW = 5.0  # seconds; a single run is not short of precision then


def as_new(system: DescriptorSystem) -> DescriptorSystem:
    """The plant as its first run meets it: what earlier runs found out about it is forgotten."""
    getattr(system.coefficients, "kept", {}).clear()
    return system


class Failed(Exception):  # noqa: N818  a result, not a mistake
    """A solver did not solve; the text is its own."""


@dataclass(frozen=True)
class Found:
    """A solver at the tolerance that was chosen for it."""

    solve: Solve
    error: float
    tolerance: float
    took: float  # seconds of its first run
    note: str = ""  # how the search ended, if not well


@dataclass(frozen=True)
class Row:
    """One comparison. Errors are the largest at the compared times, in absolute terms."""

    name: str
    ours_seconds: float
    ours_error: float | None
    peer: str
    peer_seconds: float | None  # None: it fails, and ``note`` says how
    peer_error: float | None
    target: float | None = None  # an error above it is no solution, whatever the time
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """The peer's time over ours."""
        return None if self.peer_seconds is None else self.peer_seconds / self.ours_seconds

    @property
    def verdict(self) -> str:
        """Which of both is faster, of those whose error meets the target."""
        if _misses(self.ours_error, self.target):
            return "our error too large"
        if self.peer_seconds is None:
            return "no result"
        if _misses(self.peer_error, self.target):
            return "larger error"
        return "ours faster" if self.peer_seconds >= self.ours_seconds else "peer faster"

    def record(self) -> dict[str, Any]:
        """The row as it stands in the JSON."""
        return {**asdict(self), "ratio": self.ratio, "verdict": self.verdict}


def _misses(error: float | None, target: float | None) -> bool:
    return error is not None and target is not None and not error <= target


def seconds(call: Callable[[], object], budget: float = 0.5, least: int = 3) -> float:
    """Median time of some runs after one that is not counted."""
    return alternate(call, None, budget, least)[0]


def alternate(
    ours: Callable[[], object], peer: Callable[[], object] | None, budget: float = 2.0,
    least: int = 3,
) -> tuple[float, float]:
    """Medians of both, run in turns: whatever else the machine does, it does it to both.

    Each is run ``least`` times, and on until ``budget`` seconds are over. One run of ours before
    is not counted; a peer has been run when its tolerance was chosen.
    """
    calls = [ours] if peer is None else [ours, peer]
    ours()
    taken: list[list[float]] = [[] for _ in calls]
    start = time.perf_counter()
    while len(taken[0]) < least or (
        time.perf_counter() - start < budget and len(taken[0]) < 200
    ):
        for call, times in zip(calls, taken, strict=True):
            before = time.perf_counter()
            call()
            times.append(time.perf_counter() - before)
    medians = [statistics.median(times) for times in taken]
    return medians[0], medians[-1]


def loosest(
    prepare: Prepare, tolerances: Sequence[float], error: Callable[[Array], float], target: float,
    patience: float = 30.0,
) -> Found:
    """The first of ``tolerances`` (loose to tight) whose measured error is at most ``target``.

    If there is none within ``patience`` seconds of this process's own work, the one with the
    smallest error so far.

    Raises:
        Failed: it cannot be imported, or solves at no tolerance; the first message.
    """
    best: Found | None = None
    messages: list[str] = []
    impatient = ""
    end = time.process_time() + patience
    for tolerance in tolerances:
        left = end - time.process_time()
        if left <= 0:
            impatient = f"; search ended after {patience:.0f} s"
            break
        try:
            with at_most(left), silent():
                solve = prepare(tolerance)
                began = time.perf_counter()
                values = solve()
                took = time.perf_counter() - began
            reached = error(values)
        except ImportError as problem:
            raise Failed(f"cannot be imported: {problem}") from problem
        except Exception as problem:  # noqa: BLE001  whatever a peer does, the others go on
            messages.append(_words(problem))
            continue
        if np.isfinite(reached) and (best is None or reached < best.error):
            best = Found(solve, reached, tolerance, took)
        if reached <= target:
            break
    if best is None:
        raise Failed(messages[0] if messages else "no finite solution")
    return replace(best, note=impatient)


def compare(
    name: str, ours: Found, peer: str, prepare: Prepare, tolerances: Sequence[float],
    error: Callable[[Array], float], target: float, *, budget: float = 2.0,
    patience: float = 30.0, scale: float = 1.0,
) -> Row:
    """One row: the peer at its loosest sufficient tolerance, in turns with ours.

    A peer that misses the target is timed once, as is a slow one. ``scale``
    multiplies the peer's time, where it does only a part of the work.
    """
    say(f"{name}: {peer}")
    try:
        found = loosest(prepare, tolerances, error, target, patience)
        once = found.error > target or found.took > _SLOW
        with silent():
            ours_seconds, peer_seconds = alternate(
                ours.solve, found.solve, 0.0 if once else budget, 1 if once else 3
            )
    except Exception as problem:  # noqa: BLE001  a row that says so, not the end of the others
        alone = seconds(ours.solve, min(budget, 0.3))
        return Row(name, alone, ours.error, peer, None, None, target, _words(problem))
    return Row(
        name, ours_seconds, ours.error, peer, scale * peer_seconds, found.error, target,
        f"tolerance {found.tolerance:.2g}, ours {ours.tolerance:.2g}{found.note}",
    )


@contextmanager
def at_most(limit: float) -> Iterator[None]:
    """Interrupt Python code after some seconds of its own work; code in C ends first."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not done within {limit:.0f} s")

    previous = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, previous)


@contextmanager
def silent() -> Iterator[None]:
    """Drop what C code writes to stderr: SUNDIALS comments on every failure."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def decades(first: float, last: float, per_decade: int = 2) -> list[float]:
    """Tolerances 10^first … 10^last, loose to tight."""
    count = round(abs(last - first) * per_decade) + 1
    return [float(x) for x in np.logspace(first, last, count)]


def say(text: str) -> None:
    """Progress, to stderr."""
    sys.stderr.write(f"  {text}\n")
    sys.stderr.flush()


def _words(problem: BaseException) -> str:
    """What a solver says about its failure: the last line, without places in its source."""
    lines = [line.strip() for line in str(problem).splitlines() if line.strip(" -")]
    text = re.sub(r"^\S*\.\w+:\d+: ", "", lines[-1] if lines else type(problem).__name__)
    return text[:140]
