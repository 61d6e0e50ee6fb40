"""Times at which expressions jump or have a kink: where elements of the solver must end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions.bounds import roots
from gpebo_cli.model.expressions.syntax import Expression
from gpebo_cli.model.expressions.tape import Tape, record

_SAME = 1e-12  # of the span: found instants closer than this to another are that one


def breakpoints(expressions: Sequence[Expression], start: float, stop: float) -> Array:
    """Breakpoints of expressions; see :func:`breakpoints_of_tape`."""
    return breakpoints_of_tape(record(expressions), start, stop)


def breakpoints_of_tape(tape: Tape, start: float, stop: float) -> Array:
    """Times strictly between ``start`` and ``stop`` where some expression jumps or has a kink.

    Instants of ``step`` and zeros of affine arguments of ``abs``, ``sign``, ``min`` and ``max`` are
    exact, changes of sign of other arguments isolated by bounds, see :func:`roots`, and bisected to
    rounding.

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

    found = np.sort(roots(tape, exact, start, stop))
    near = _SAME * (stop - start)
    known = np.concatenate([[start], exact, [stop]])
    place = np.searchsorted(known, found)  # between start and stop, where all of them are
    new = (found - known[np.maximum(place - 1, 0)] > near) & (
        known[np.minimum(place, len(known) - 1)] - found > near
    )
    new[1:] &= np.diff(found) > near
    return np.sort(np.concatenate([exact, found[new]]))
