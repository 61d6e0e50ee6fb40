"""What functions of time can do between the times at which one looks: roots, and nothing narrow.

Sampling cannot settle whether something narrow was missed. Here a cell of time is done with only
when interval arithmetic says so, and is halved until it does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.model.expressions.intervals import Interval
from gpebo_cli.model.expressions.jets import NOTHING
from gpebo_cli.model.expressions.program import Program
from gpebo_cli.model.expressions.syntax import shorten
from gpebo_cli.model.expressions.tape import Tape

ORDER = 8  # of the Taylor polynomials that functions are compared with
RESOLVED = 1e-6  # of its largest value, by which a function may differ from such a polynomial
COARSER = 3
_DEEPEST = 45  # halvings of a cell
_LOOKED = 10  # halvings after which what has no bound has to have a value at least
_NEAR, _STEEP = 1e-9, 0.9  # of a cell; an exponent: what grows like 1/distance has no integral
_CELLS = 64  # to begin with, where roots are looked for
_NARROWEST = 1e-13  # of the span; cells are not cut further
_MOST_CELLS = 1 << 15
_MOST_VALUES = 1 << 20  # of all expressions in all cells, where these are more
_AT_ONCE = 1 << 14  # cells whose bounds are held at the same time
# No narrower than a signal; kinks and jumps are edges.
_POLYNOMIAL = {"add", "multiply", "negative", "signal", "abs", "sign", "min", "max"}
_MOST_ALONG = 1 << 13  # cells along signals, whose bounds no kernel finds, and
_FOR_EACH = 2  # cells for each element of those, if these are more
_SAME = 1e-12  # of the span: found instants closer than this to another are that one
_ROUNDING = 1e-14  # of an argument: changes of sign within it are not looked for
_MOST_SWITCHED = 1 << 16
_WIDTH = 0.125  # of bounds of an argument at one time that its rounding is
_MULTIPLE = 3  # orders of roots
_BISECTIONS = 100  # more than enough to leave two neighbouring floats


# From the ends of cells of time, (N,) and (N,), to Taylor coefficients of each signal anywhere in
# them; None stands for what the tape has for it.
Cells = Callable[[Array, Array], Sequence[list[Interval] | None]]


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of what a tape's expressions do over cells of time."""

    tape: Tape
    # Of signals; None: they are functions of time.
    signals: Cells | None = None
    _programs: dict[tuple[int, bool], Program | None] = field(default_factory=dict, init=False)

    def of(self, low: Array, high: Array, order: int, inside: Array | None = None
           ) -> tuple[Array, Array]:
        """Least and largest Taylor coefficients (order + 1, N, outputs) for all t of cells (N,).

        Jumps are decided at times ``inside`` of the cells, where no function jumps within its cell;
        None: functions may jump, and derivatives of those that do mean nothing.
        """
        key = order, inside is not None
        if kernels.expressions.RUNS_PROGRAMS and self.signals is None:
            if key not in self._programs:
                self._programs[key] = self.tape.program(*key)
            program = self._programs[key]
            if program is not None:
                decided = low if inside is None else inside
                found = kernels.expressions.intervals(low, high, decided, *program)
                if found is not None:
                    return found
        cell, along = Interval(low, high), self.signals and self.signals(low, high)
        at: Any = cell if inside is None else inside
        with np.errstate(all="ignore"):
            places: list[Any] = self.tape.run(cell, order, at, along)
        bounds = np.zeros((2, order + 1, len(low), len(self.tape.outputs)))
        for column, place in enumerate(self.tape.outputs):
            for k, value in enumerate(places[place][: order + 1]):
                bounds[:, k, :, column] = (
                    (value.low, value.high) if isinstance(value, Interval) else value
                )
        return bounds[0], bounds[1]


def resolved(bounds: Bounds, edges: Array, most: int = 0) -> tuple[Array, bool]:
    """Edges of cells that are few times longer than what hides nothing, and whether all are.

    In cells 2**COARSER times shorter every expression is nearly a polynomial of degree ORDER.
    "Nearly" is RESOLVED of the largest value that the expression can have anywhere: with

        f(t) = Σ_{k<K} f_k(m) (t − m)^k + f_k(τ) (t − m)^K      for some τ of a cell around m,

    the bounds of f_K over the cell say by how much f can differ from such a polynomial. What is
    looked at a dozen times between these edges cannot hide a pulse. What has no finite bound, as a
    quotient while its divisor might vanish, is cut until it has one, or to rounding. The edges
    asked for (K + 1,), jumps and kinks among them, stay. ``most`` cells are enough; 0: as many as
    _MOST_CELLS and _MOST_VALUES let (ConfigError: a function of time has a pole, or no value).
    """
    low, high = edges[:-1], edges[1:]
    depth = np.zeros(len(low), dtype=np.intp)  # how often each has been halved
    rest, size = _rest(bounds, low, high)
    most = most or max(_MOST_CELLS, _MOST_VALUES // max(1, size.shape[1]))
    while True:
        # A bound that nothing reaches falls while its cell is cut.
        finite = np.where(np.isfinite(size), size, 0.0)
        enough = np.maximum(RESOLVED * finite.max(axis=0), NOTHING)
        poor = (rest > enough).any(axis=1) & (depth < _DEEPEST)
        if len(low) >= most or not poor.any():
            break
        middle = 0.5 * (low[poor] + high[poor])
        new = np.concatenate([low[poor], middle]), np.concatenate([middle, high[poor]])
        deeper = np.tile(depth[poor] + 1, 2)
        fresh = (*new, deeper, *_rest(bounds, *new))
        if bounds.signals is None:
            lost = ~np.isfinite(fresh[-1]).all(axis=1) & (deeper == _LOOKED)
            bounds.tape.taylor(np.sort(0.5 * (new[0] + new[1])[lost]), 0)
        low, high, depth, rest, size = (
            np.concatenate([old[~poor], more])
            for old, more in zip((low, high, depth, rest, size), fresh, strict=True)
        )
    if bounds.signals is None:
        _refuse_poles(bounds.tape, 0.5 * (low + high), edges, ~np.isfinite(size))
    order = np.argsort(low)
    return np.append(_coarser(low[order], depth[order], edges), edges[-1]), not poor.any()


def _refuse_poles(tape: Tape, t: Array, edges: Array, unbounded: BoolArray) -> None:
    """Refuse outputs with a pole in cells around t (N,) in which they are ``unbounded``."""
    cells = unbounded.any(axis=1)
    if not cells.any():
        return
    t, unbounded = t[cells], unbounded[cells]
    length = np.diff(edges)[np.searchsorted(edges[1:-1], t)]
    away = np.maximum(_NEAR * length, 1e3 * np.spacing(np.abs(t)))
    places = t[:, None] + away[:, None] * np.array([-1e-2, -1.0, 1.0, 1e-2])
    inside = np.clip(places, edges[0], edges[-1])
    size = np.abs(tape.taylor(inside.ravel(), 0)[0]).reshape(len(t), 4, -1)
    near, far = size[:, ::3].max(axis=1), size[:, 1:3].max(axis=1)
    pole = np.argwhere(unbounded & (near > far * 100.0**_STEEP))
    if len(pole):
        k, j = pole[np.argmin(t[pole[:, 0]])]
        label = tape.labels[j]
        raise ConfigError(
            f"{label.where} = {shorten(label.text)} grows beyond all numbers near t = {t[k]:.6g}; "
            "choose a horizon without that time"
        )


def resolved_along(
    tape: Tape, followers: AbstractSet[int], signals: Cells, edges: Array
) -> tuple[Array, bool]:
    """:func:`resolved` for those expressions whose places follow signals, whose cells are given.

    What is made of sums and products is no narrower than the signals. From edges (K + 1,).
    """
    if all(tape.instructions[place].operation in _POLYNOMIAL for place in followers):
        return edges, True
    places = [*tape.outputs, *(switch.argument for switch in tape.switches)]
    followed = tape.of([place for place in places if place in followers])
    return resolved(Bounds(followed, signals), edges, max(_MOST_ALONG, _FOR_EACH * len(edges)))


def _coarser(low: Array, depth: IntArray, edges: Array) -> Array:
    """Left ends of the cells that are left when halves are put together again, COARSER times."""
    low = low.copy()
    for _ in range(COARSER):
        whole = np.searchsorted(edges, low, side="right") - 1
        width = (edges[whole + 1] - edges[whole]) / 2.0**depth
        is_right = np.rint((low - edges[whole]) / width).astype(np.int64) % 2 == 1
        pair = (depth[1:] == depth[:-1]) & is_right[1:] & ~is_right[:-1] & (depth[1:] > 0)
        gone = np.append(False, pair)
        depth = depth - np.append(pair, False)
        low, depth = low[~gone], depth[~gone]
    return low


def _rest(bounds: Bounds, low: Array, high: Array) -> tuple[Array, Array]:
    """By how much expressions can differ from polynomials in each cell, and how large they get."""
    rest, size = np.empty((2, len(low), len(bounds.tape.outputs)))
    for first in range(0, len(low), _AT_ONCE):
        here = slice(first, first + _AT_ONCE)
        least, most = bounds.of(low[here], high[here], ORDER, 0.5 * (low[here] + high[here]))
        half = 0.5 * (high[here] - low[here])
        with np.errstate(invalid="ignore", over="ignore"):
            radius = 0.5 * (most - least) * half[:, None] ** np.arange(ORDER + 1)[:, None, None]
        rest[here] = np.where(np.isnan(radius), np.inf, radius).min(axis=0)
        size[here] = np.maximum(-least[0], most[0])
    return rest, size


def breakpoints(tape: Tape, start: float, stop: float) -> Array:
    """Times strictly between ``start`` and ``stop`` where some expression jumps or has a kink.

    They are sorted, without repetitions, in seconds (number,). Instants of ``step`` and zeros of
    affine arguments of ``abs``, ``sign``, ``min`` and ``max`` are exact, changes of sign of other
    arguments isolated by bounds, see :func:`roots`, and bisected to rounding.
    """
    steps = [i.value for i in tape.instructions if i.operation == "step"]
    affine = [s.affine for s in tape.switches if s.affine is not None]
    instants = np.array([*steps, *(-offset / slope for offset, slope in affine)], dtype=float)
    exact = np.unique(instants[(instants > start) & (instants < stop)])
    if len(affine) == len(tape.switches) or not start < stop:
        return exact

    found, near = np.sort(roots(tape, exact, start, stop)), _SAME * (stop - start)
    found = found[np.diff(found, prepend=-np.inf) > near]
    return with_others(np.array([start, *exact, stop]), found)[1:-1]


def with_others(known: Array, others: Array, near: Array | float | None = None) -> Array:
    """Times ``known`` (A,), sorted, and those ``others`` (B,) that are not so ``near`` to one.

    None: by more than rounding of the span between the first and the last.
    """
    near = _SAME * (known[-1] - known[0]) if near is None else near
    return np.union1d(known, others[~among(others, known, near)])


def among(t: Array, times: Array, near: Array | float) -> BoolArray:
    """Which of t (N,) are as ``near`` (N,) to one of the ascending times."""
    padded = np.concatenate([[-np.inf], times, [np.inf]])
    k = np.searchsorted(padded, t).clip(1)
    return np.asarray(np.minimum(t - padded[k - 1], padded[k] - t) <= near)


def roots(tape: Tape, knots: Array, start: float, stop: float) -> Array:
    """Times strictly between ``start`` and ``stop`` where an argument of a switch changes sign.

    A cell is dropped if bounds keep the argument away from zero, searched by bisection where it is
    monotone, and halved else, down to rounding. (A tangential zero has no change of sign, and
    switches nothing.) Cells end at ``knots`` (B,), sorted, where something jumps. What is found is
    unsorted (ConfigError: there are too many).
    """
    places = [s.argument for s in tape.switches if s.affine is None]
    arguments = tape.of([place for place in places if place in tape.of_time])
    if not arguments.outputs:
        return np.zeros(0)
    nested = Bounds(arguments.of([s.argument for s in arguments.switches]))
    bounds, searched = Bounds(arguments), range(len(arguments.outputs))
    grid = np.union1d(np.linspace(start, stop, _CELLS + 1), knots)
    # Which argument may vanish, and from when to when: the columns of ``active`` and the others.
    active = np.array([(j, a, b) for j in searched for a, b in pairwise(grid)]).T
    bracketed: list[Array] = []
    while active.size:
        possible, monotone, vanishing = _judged(bounds, nested, active)
        bracketed.append(active[:, monotone])
        rest = possible & ~monotone
        if rest.sum() > _MOST_CELLS:  # where it is zero, or there is no end of them
            if not vanishing[rest].all():
                raise ConfigError(
                    "an argument of sign, abs, min or max has more changes of sign than can be "
                    f"followed, near t = {active[1, rest & ~vanishing][0]:.6g}; choose a shorter "
                    "horizon"
                )
            break
        active = active[:, rest]
        tiny = active[2] - active[1] <= _NARROWEST * (stop - start)
        bracketed.append(_joined(active[:, tiny]))
        which, low, high = active[:, ~tiny]
        middle = 0.5 * (low + high)
        active = np.concatenate([[which, low, middle], [which, middle, high]], axis=1)
    return _bisected(arguments, np.concatenate(bracketed, axis=1))


def _judged(
    bounds: Bounds, nested: Bounds, cells: Array
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Whether arguments may vanish in their cells, may and are monotone, may in the middle."""
    (low, high), back = np.unique(cells[1:], axis=1, return_inverse=True)
    pick = back.ravel(), cells[0].astype(np.intp)
    (least0, least1), (most0, most1) = (
        [each[pick] for each in bound] for bound in bounds.of(low, high, 1)
    )
    middle = 0.5 * (low + high)
    least, most = (bound[0][pick] for bound in bounds.of(middle, middle, 0))
    inner = nested.of(low, high, 0)
    decided = (inner[0][0] > 0) | (inner[1][0] < 0)  # no sign inside of the argument may change
    smooth = decided.all(axis=1)[back.ravel()]
    with np.errstate(invalid="ignore"):
        reach = 0.5 * (cells[2] - cells[1]) * np.maximum(-least1, most1)
        away = smooth & ((least > reach) | (most < -reach))
    nothing = np.maximum(-least0, most0) < NOTHING  # as of max(0, .) where that is 0 all along
    possible = (least0 <= 0) & (most0 >= 0) & ~away & ~nothing
    return possible, possible & smooth & ((least1 > 0) | (most1 < 0)), (least <= 0) & (most >= 0)


def _joined(cells: Array) -> Array:
    """Neighbouring cells of one function as one."""
    which, low, high = cells[:, np.lexsort(cells[1::-1])]
    first = np.ones(len(which), dtype=bool)
    first[1:] = (which[1:] != which[:-1]) | (low[1:] != high[:-1])
    last = np.append(first[1:], True)[: len(which)]
    return np.array([which[first], low[first], high[last]])


def _bisected(arguments: Tape, cells: Array) -> Array:
    """The change of sign in each cell that has one between its ends."""
    (which, low, high), index = cells, np.arange(cells.shape[1])

    def sign(t: Array, inside: Array) -> Array:
        values: Array = arguments.taylor(t, 0, inside)[0][index, which.astype(np.intp)]
        return np.sign(values)

    middle, width = 0.5 * (low + high), high - low
    before, after = sign(low, middle), sign(high, middle)
    # A root that is the end of a cell: the sign changes beyond it.
    at_low = (before == 0) & (sign(low - width, low - 0.5 * width) * after < 0)
    at_high = (after == 0) & (sign(high + width, high + 0.5 * width) * before < 0)
    between = before * after < 0
    inner = halved(lambda t: sign(t, t), before, low, high)
    found = np.where(between, inner, np.where(at_low, low, high))
    return np.asarray(found[between | at_low | at_high])


def blurred(tape: Tape, t: Array) -> Array:
    """By how much changes of sign at times t (N,) may be wrong by rounding of arguments, seconds.

    An argument f that may vanish is rounded by some ε: less than min_k |ε/f_k|^(1/k) does not show.
    """
    arguments = tape.of([s.argument for s in tape.switches if s.affine is None])
    if not arguments.outputs:
        return np.zeros(len(t))
    least, most = (bound[0] for bound in Bounds(arguments).of(t, t, 0, t))  # no jump is rounding
    orders = np.arange(1, _MULTIPLE + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = _WIDTH * (most - least) / np.abs(arguments.taylor(t, _MULTIPLE, t)[1:])
    within = (share ** (1.0 / orders[:, None, None])).min(axis=0)
    vanishes = (least <= 0.0) & (most >= 0.0) & np.isfinite(within)
    return np.asarray(np.where(vanishes, within, 0.0).max(axis=1))


def switched(arguments: Tape, t: Array, signals: Callable[[Array, int], Array]) -> Array:
    """Times (number,) between those of t (N,), ascending, where an argument changes its sign.

    ``signals`` gives Taylor coefficients of [u; y] (order + 1, M, m + r) at any times (M,). Between
    two times at which an argument has one sign, it may change twice: where it turns around is
    looked at, too. Changes of sign that are rounding of an argument are left out.
    """
    def at(t: Array, order: int) -> Array:
        return np.asarray(arguments.taylor(t, order, None, signals(t, order)))

    value, slope = at(t, 1)
    above, least = value >= 0.0, _ROUNDING * np.abs(value).max(axis=0, initial=0.0)
    with np.errstate(over="ignore"):
        falls = np.where(above, slope, -slope) < 0.0
    low, j = np.nonzero((above[1:] == above[:-1]) & falls[:-1] & ~falls[1:])
    index = np.arange(len(j))
    side = np.where(above[low, j], 1.0, -1.0)
    turns = halved(
        lambda t: side * at(t, 1)[1][index, j] < 0.0, falls[low, j], t[low], t[low + 1]
    )
    beyond = side * at(turns, 0)[0][index, j] < -least[j]
    low, j, turns = low[beyond], j[beyond], turns[beyond]
    k, i = np.nonzero(above[1:] != above[:-1])
    told = np.maximum(np.abs(value[k, i]), np.abs(value[k + 1, i])) > least[i]
    k, i = k[told], i[told]
    left = np.concatenate([t[k], t[low], turns])
    right = np.concatenate([t[k + 1], turns, t[low + 1]])
    which, index = np.concatenate([i, j, j]), np.arange(len(left))
    if len(left) > _MOST_SWITCHED:
        return np.zeros(0)
    before = np.concatenate([above[k, i], above[low, j], ~above[low, j]])
    return np.unique(halved(lambda t: at(t, 0)[0][index, which] >= 0.0, before, left, right))


def halved(sign: Callable[[Array], Array], before: Array, low: Array, high: Array) -> Array:
    """Where signs at times (N,), ``before`` at low (N,), change up to high (N,), to rounding."""
    for _ in range(_BISECTIONS):
        half = 0.5 * (low + high)
        if np.all((half <= low) | (half >= high)):
            break
        left = sign(half) == before
        low, high = np.where(left, half, low), np.where(left, high, half)
    return high
