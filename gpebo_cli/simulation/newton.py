"""Simulation of plants whose matrices depend on their outputs: Newton's method, window by window.

Each iterate is one linear problem, the plant linearised along the iterate before: with
G = E x' − f(x) it solves ∂G/∂x Δx = −G. A trajectory
that grows or is chaotic has no start for the whole horizon from which Newton's method converges, so
the horizon is followed in windows, as long as convergence allows. At last the whole horizon is
solved once, linearised along what was found: errors of the windows are seen to grow with the
solution there, and the estimate is that of the whole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import process_time
from typing import cast

import numpy as np

from gpebo_cli.errors import ConfigError, GpeboError, ModelError, SolverError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.mesh import Mesh, Trajectory, joined, signal_scale
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.linearised import Linearised

_MOST_ITERATES = 30  # past a jump each takes a share of the change before, and not its square
_TOLD = 8  # iterates, after which the last share tells whether that will do
_FAST = 6  # iterates: a window that needs no more may be followed by a longer one
_LOOSE = 1e-4  # tolerance of iterates that are far from the solution
_NEAR = 1e-2  # change from which on iterates are worth the full tolerance
_FEW_ELEMENTS, _MORE_ELEMENTS = 1_000, 8  # of late iterates: so many, or times those before
_ROUNDED = 100.0  # tolerances: a change of fewer that does not shrink is rounding, but past jumps
_SHRINKS = 0.5  # changes that do not fall to this share do not converge
_MOST_GROWTH = 12.0  # of the logarithm of a small error within one window
_SHORTEST = 1e-8  # of the horizon; where shorter windows are needed the solution ends
_AROUND = 1e-3  # of the horizon: a refusal so near to where the solution ends is about its end
_SAFETY = 10.0
_PART = 0.2  # of the computing time allowed, after which it is known whether that will do
_SOON, _HOPELESS = 0.04, 10.0  # or after so little of it, where the rest takes times all of it
_PACE = 3  # windows that say how fast it goes on


@dataclass(frozen=True)
class Effort:
    """What Newton's method took."""

    windows: int
    iterates: int  # linear problems, each over its window
    linear_solves: float  # the same in linear problems over the whole horizon
    last_change: float  # of the states, relative to their size, that the last iterate is expected


# Solves a linear plant: (system, time, solver, growth) -> its states; None: they may grow faster
# than that, in 1/s.
Solve = Callable[[DescriptorSystem, TimeSettings, SolverSettings, float], Trajectory | None]


class SlidesError(SolverError):
    """Newton's method does not converge where outputs pass a jump or a kink."""


def follow(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings, solve: Solve
) -> Effort:
    """Follow the solution from ``system.initial_state``; the last thing solved is all of it.

    SolverError: the solution ends within the horizon; names the time and the reason.
    """
    t, stop = time.start, time.start + time.horizon
    length, x = time.horizon, system.initial_state
    pieces: list[Trajectory] = []
    refused: GpeboError | None = None
    refused_until = t
    iterates, work, change = 0, 0.0, 0.0
    at_rest = Linearised(system, _at_rest(x, t, length, solver))
    _refuse_start(at_rest, t)
    begin, spent = process_time(), list[tuple[float, float]]()
    while t < stop - 1e-12 * time.horizon:
        spent.append((process_time() - begin, t))
        # What has a name there is the reason: no value, a zero divisor, a rank, a jump.
        named = refused if t <= refused_until <= t + _AROUND * time.horizon else None
        try:
            _refuse_slow(system, time, spent, solver.max_seconds)
        except SolverError as error:
            # Windows that were only too long are refused for what their iterates pass.
            near = refused_until - t <= _AROUND * (t - time.start)
            raise (_ends(system, t, x, named) if named and near else error) from None
        length = stop - t if stop - t < 1.25 * length else length
        own, window = replace(system, initial_state=x), replace(time, start=t, horizon=length)
        try:
            piece, count, solves, last = _window(own, window, solver, solve)
        except GpeboError as error:
            if isinstance(error, ConfigError | ModelError | SlidesError):
                refused, named, refused_until = error, error, t + length
            length *= 0.25
            if length < _SHORTEST * time.horizon:
                raise _ends(system, t, x, named or error) from None
            continue
        pieces.append(piece)
        iterates, work = iterates + count, work + solves * length / time.horizon
        change = max(change, last)
        t, x = t + length, piece.final
        length *= 2.0 if count <= _FAST else 1.0
    whole = joined(pieces)
    # Once more where elements end at jumps and kinks: those are instants of the iterate before.
    # Repeated iterates would let rounding of one instant grow in those that follow it.
    switched = len(Linearised(system, whole).switched) > 0
    for _ in range((len(pieces) > 1) + switched):
        before, linear = whole, replace(system, coefficients=Linearised(system, whole))
        whole = cast(Trajectory, solve(linear, time, solver, np.inf))
        iterates, work = iterates + 1, work + 1.0
    if switched:
        change = max(change, _change(whole, before))
    return Effort(len(pieces), iterates, work, change)


def _refuse_start(at_rest: Linearised, t: float) -> None:
    """Refuse by name what has no value at the outputs that the state at the start t makes."""
    system, at = at_rest.system, np.array([t])
    try:
        at_rest.taylor(at, 0)
    except ConfigError as error:
        known = system.coefficients.of_time.taylor(at, 0)
        y = known.C[0, 0] @ system.initial_state + known.D[0, 0] @ known.u[0, 0]
        made = zip(system.outputs, y + known.H[0, 0] @ known.theta[0, 0], strict=True)
        said = ", ".join(f"{name} = {y:.6g}" for name, y in made if name in system.followed)
        raise ConfigError(f"{error}, where initial_state makes {said}") from None


def _refuse_slow(
    system: DescriptorSystem, time: TimeSettings, spent: list[tuple[float, float]], most: float
) -> None:
    """Refuse what will take more than ``most`` seconds, from those ``spent`` until times t.

    Towards a time beyond which there is no solution, or one that swings ever faster, windows
    shrink, and what is left of the horizon takes times the seconds allowed at the last pace.
    """
    taken, t = spent[-1]
    late = [then for seconds, then in spent if seconds >= 0.5 * taken]
    left = (time.start + time.horizon - t) * 0.5 * taken
    shrink = taken > _SOON * most and left > _HOPELESS * most * (t - late[0])
    shrink = shrink and len(set(late)) > _PACE  # else windows were only too long
    if shrink or taken > max(_PART, (t - time.start) / time.horizon) * most:
        near = f", and it slows down towards t = {t:.6g}" if shrink else ""
        raise SolverError(
            f"plant {system.name}: the simulation of {time.horizon:g} s would take more computing "
            f"time than solver.max_seconds = {most:g} s (the first {t - time.start:.3g} s took "
            f"{taken:.2g} s{near}); shorten time.horizon, or raise solver.max_seconds"
        )


def _window(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings, solve: Solve
) -> tuple[Trajectory, int, float, float]:
    """Newton's method over one window, from a state that does not move.

    What comes is the last iterate, how many there were, what they cost in solutions to the full
    tolerance, and the change that one more is expected to make.
    """
    guess = _at_rest(system.initial_state, time.start, time.horizon, solver)
    before, work, was_full, passed = np.inf, 0.0, False, np.zeros(0)
    for count in range(1, _MOST_ITERATES + 1):
        full = before <= _NEAR or solver.tol >= _LOOSE
        along = Linearised(system, guess)
        passed = along.switched if len(along.switched) else passed  # one iterate may, the next not
        linear = replace(system, coefficients=along)
        own = solver if full else replace(solver, tol=_LOOSE)
        if count > 2 and full == was_full:  # many more of them at one tolerance do not converge
            most = max(_FEW_ELEMENTS, _MORE_ELEMENTS * guess.mesh.size)
            own = replace(own, max_elements=min(own.max_elements, most))
        found = solve(linear, time, own, _MOST_GROWTH / time.horizon)
        if found is None:
            break
        work += 1.0 if full else np.log(_LOOSE) / np.log(solver.tol)
        change = _change(found, guess)
        # Each change is about the square of the one before times a constant.
        growth = max(1.0, change / before / before) if 0.0 < before < np.inf else np.inf
        expected = min(change, _SAFETY * growth * change * change)
        share = _SHRINKS
        if count >= _TOLD:
            left = solver.tol / max(change, solver.tol)
            share = min(share, left ** (1.0 / (_MOST_ITERATES - count + 1)))
        # Loose iterates that agree to the full tolerance say nothing of its first change.
        agreed = full != was_full and before <= solver.tol
        stands = count > 2 and change > share * before and not agreed
        rounded = stands and change <= _ROUNDED * solver.tol and not len(passed)
        if full and (rounded or expected <= solver.tol):
            return found, count, work, expected
        if stands or not np.isfinite(change):
            break
        guess, before, was_full = found, change, full
    said = (
        f"Newton's method does not converge between t = {time.start:.9g} and "
        f"t = {time.start + time.horizon:.9g}"
    )
    if len(passed):
        raise SlidesError(
            f"{said}; outputs pass a jump or a kink near t = {passed[0]:.9g}, and the equations "
            "have no solution that slides along a jump"
        )
    raise SolverError(said)


def _change(found: Trajectory, before: Trajectory) -> float:
    """Of the states from one iterate to the next, relative to their size."""
    moved = np.abs(found.values - found.mesh.along(before).values).max(axis=(0, 1))
    return float((moved / signal_scale(found.values)).max())


def _at_rest(x: Array, start: float, length: float, solver: SolverSettings) -> Trajectory:
    """A state that does not move."""
    rule = radau_rule(solver.stages)
    mesh = Mesh(np.array([start, start + length]), rule)
    return Trajectory(mesh, np.tile(x, (1, rule.stages + 1, 1)))


def _ends(system: DescriptorSystem, t: float, x: Array, error: GpeboError) -> GpeboError:
    """Why no window, however short, leads on from here."""
    large = int(np.argmax(np.abs(x)))
    said = str(error).removeprefix(f"plant {system.name}: ")
    return type(error)(
        f"plant {system.name}: the solution cannot be followed beyond t = {t:.9g} "
        f"({system.states[large]} = {x[large]:.3g} there): {said}"
    )
