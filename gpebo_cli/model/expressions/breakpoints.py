"""Times at which expressions jump or have a kink: where elements of the solver must end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions.syntax import Expression
from gpebo_cli.model.expressions.tape import Tape, record

GRID = 2000  # cells in which sign changes of arguments that are not affine are looked for
_SAME = 1e-12  # of the span: found instants closer than this to another are that one
_BISECTIONS = 100  # more than enough to leave two neighbouring floats


def breakpoints(expressions: Sequence[Expression], start: float, stop: float) -> Array:
    """Breakpoints of expressions; see :func:`breakpoints_of_tape`."""
    return breakpoints_of_tape(record(expressions), start, stop)


def breakpoints_of_tape(tape: Tape, start: float, stop: float) -> Array:
    """Times strictly between ``start`` and ``stop`` where some expression jumps or has a kink.

    Instants of ``step`` and zeros of affine arguments of ``abs`` and ``sign`` are exact. Zeros of
    other arguments are found as sign changes over a grid of GRID cells, then bisected to
    rounding; two zeros in one cell, and zeros without a change of sign, are not seen.

    Returns:
        Sorted, without repetitions, seconds, shape (number,).

    Raises:
        ConfigError: an argument that is not finite at some time.
    """
    if not tape.jumps:
        return np.zeros(0)
    steps = [i.value for i in tape.instructions if i.operation == "step"]
    affine = [s.affine for s in tape.switches if s.affine is not None]
    instants = np.array([*steps, *(-offset / slope for offset, slope in affine)], dtype=float)
    exact = np.unique(instants[(instants > start) & (instants < stop)])
    if len(affine) == len(tape.switches) or not start < stop:
        return exact

    found = np.sort(_sign_changes(tape, exact, start, stop))
    near = _SAME * (stop - start)
    result = [start, *exact, stop]
    for time in found:
        if np.abs(np.array(result) - time).min() > near:
            result.append(float(time))
    return np.sort(np.array(result))[1:-1]


def _sign_changes(tape: Tape, knots: Array, start: float, stop: float) -> Array:
    """Zeros of all arguments between the knots, unsorted."""
    grid = np.union1d(np.linspace(start, stop, GRID + 1), knots)
    left, right = grid[:-1], grid[1:]
    middle = 0.5 * (left + right)  # decides what jumps at either end of a cell
    at_left = tape.arguments_of_switches(left, middle)
    at_right = tape.arguments_of_switches(right, middle)

    # Exactly zero where two cells meet, with opposite signs at their other ends.
    met = (at_right[:, :-1] == 0) & (at_left[:, :-1] * at_right[:, 1:] < 0)
    zeros = right[:-1][met.any(axis=0)]

    which, cell = np.nonzero(at_left * at_right < 0)
    low, high, inside = left[cell], right[cell], middle[cell]
    sign_low = np.sign(at_left[which, cell])
    for _ in range(_BISECTIONS):
        half = 0.5 * (low + high)
        if np.all((half <= low) | (half >= high)):
            break
        value = tape.arguments_of_switches(half, inside)[which, np.arange(len(half))]
        before = np.sign(value) == sign_low
        low, high = np.where(before, half, low), np.where(before, high, half)
    return np.concatenate([zeros, high])
