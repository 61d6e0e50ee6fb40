"""How well a case did: one number per case from its errors over time.

If e is the norm of an error, the settling time is the least T with e(t) ≤ e(0)/100 for all t ≥ T.
Under noise it is chance when an error is small, and an estimate has settled where it is within ±2σ
of what it is at the end from then on, σ being its deviation at the end
(``experiment.accuracy.standing`` says how that is meant of what moves).
The root mean square over time is √(∫e² dt / horizon).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from gpebo_cli.kernels.laws_numpy import last_above
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics.rows import of_lines

SETTLED = 0.01  # share of an error at the start, below which it has settled
_TINY = float(np.finfo(float).tiny)
_NOTHING = 1e-6  # of a quantity's size: an error that starts below this is none
DECAY = -float(np.log(SETTLED))  # exponent of an exponential that has settled


@dataclass(frozen=True)
class Metrics:
    """One number per case; NaN where a time was never reached."""

    seconds_to_1pct_parameters: Array  # (G,)
    seconds_to_1pct_states: Array  # (G,)
    final_error_parameters: Array  # (G,) max abs
    final_error_states: Array  # (G,) max abs
    rms_error_states: Array  # (G,)
    seconds_to_1pct: Mapping[str, Array] = field(default_factory=dict)  # of each quantity, (G,)
    # Under noise the same of ±2σ, (G,) each, empty where no σ is known; None: there is no noise.
    seconds_to_settled: Mapping[str, Array] | None = None

    @property
    def settled(self) -> Array:
        """When the last quantity has settled, (G,); NaN where that is not known of any."""
        each = (self.seconds_to_settled or {}).values()
        return np.asarray(np.fmax.reduce([*each, np.full(len(self.final_error_states), np.nan)]))

    @property
    def columns(self) -> dict[str, Array]:
        """Everything by the name it has in ``cases.csv``."""
        return {
            **{name: getattr(self, name) for name in NAMES},
            **{f"{SECONDS}{name}": times for name, times in self.seconds_to_1pct.items()},
            **({} if self.seconds_to_settled is None else {STANDING: self.settled}),
            **{f"{STANDING}_{k}": times for k, times in (self.seconds_to_settled or {}).items()},
        }


NAMES = tuple([f.name for f in fields(Metrics)][:5])
SECONDS, STANDING = "seconds_to_1pct_", "seconds_to_settled"


def is_metric(name: str) -> bool:
    """Whether a column of ``cases.csv`` is a metric, and no gain."""
    return name in NAMES or name.startswith((SECONDS, STANDING))


def measure_squares(
    t: Array, squares: Sequence[Array], of_eta: Array, of_x: Array, judged: BoolArray,
    last: Array | None = None,
) -> Array:
    """The five of ``NAMES`` (5, G) from squared norms (G, M) and errors at the end, (G, p), (G, n).

    Norms are of quantities in units of their own size. ``last`` (G, 2) are the times, as indices,
    at which they were above their levels last, where these are known. NaN where no quantity is
    known, or no parameter that is ``judged`` (p,).
    """
    out = np.full((5, len(of_eta)), np.nan)
    seen, known = judged & ~np.isnan(of_eta[0]), ~np.isnan(of_x[0])
    # As in `levels`, a norm that starts at rounding is to stay below 1 % of one.
    first = np.array([each[:, 0] for each in squares])
    some = first > _NOTHING**2
    level = SETTLED**2 * np.where(some, first, 1.0)
    times = _settled(t, squares, level, last.T if last is not None and some.all() else None)
    if seen.any() or not judged.any():
        out[0] = times[0]
        out[2] = np.abs(of_eta[:, seen]).max(axis=1, initial=0.0)
    if known.any():
        out[1] = times[1]
        out[3] = np.abs(of_x[:, known]).max(axis=1)
        out[4] = time_rms(t, squares[1])
    return out


def levels(first: Array, size: Array) -> Array:
    """Levels (g, c) below which errors that are ``first`` (g, c) at the start have settled.

    An error that starts at less than a millionth of its quantity's size (c,) is to stay below 1 %
    of that.
    """
    absolute = np.abs(first)
    return np.asarray(SETTLED * np.where(absolute > _NOTHING * size, absolute, size))


def settling_times(t: Array, error: Array, level: Array) -> Array:
    """Times (g, c) after which errors (g, M, c) stay below their levels (g, c).

    NaN if that is never reached, or the last error or the level is not known; 0 if the error is
    below it from the start. They count from the first of the times t (M,). Between two of them the
    logarithm of the error is taken as linear, which is exact where it decays exponentially.
    """
    absolute = np.abs(np.moveaxis(error, 2, 0))  # (c, g, M)
    out = _settled(t, absolute, level.T).T
    return np.where(np.isnan(error[:, -1] + level), np.nan, out)


def _settled(
    t: Array, errors: Sequence[Array] | Array, level: Array, last: Array | None = None
) -> Array:
    """:func:`settling_times` (c, g) of c sizes of errors (g, M) each below levels (c, g).

    ``last`` (c, g) are indices of the last times at which they are above, −1 for none; None: they
    are not known.
    """
    if last is None:
        last = np.array([
            last_above(error[:, :, None], own[:, None, None])[:, 0]
            for error, own in zip(errors, level, strict=True)
        ]).reshape(level.shape)
    rows = np.arange(level.shape[1])
    return settled(t, last, lambda at: np.array([
        error[rows, k] for error, k in zip(errors, at, strict=True)
    ]).reshape(level.shape), level)


def settled(t: Array, last: Array, sizes: Callable[[IntArray], Array], level: Array) -> Array:
    """:func:`settling_times` (...) where it is known when an error is above its level last.

    ``last`` is the index of that time among t (M,), −1 where there is none, and ``sizes`` are those
    of the error at such indices.
    """
    k = np.maximum(np.minimum(last, len(t) - 2), 0).astype(np.intp)
    after = np.minimum(k + 1, len(t) - 1)
    high, low, wanted = (np.log(np.maximum(e, _TINY)) for e in (sizes(k), sizes(after), level))
    with np.errstate(over="ignore"):  # where it does not fall, and the result is another one
        share = np.maximum((high - wanted) / np.maximum(high - low, _TINY), 0.0)
    crossed = t[k] + np.minimum(share, 1.0) * (t[after] - t[k]) - t[0]
    return np.where(last < 0, 0.0, np.where(last < len(t) - 1, crossed, np.nan))


def time_rms(t: Array, squares: Array) -> Array:
    """Root mean square over time (trapezoidal) of norms whose squares are (g, M), shape (g,)."""
    return np.asarray(np.sqrt(squares @ (of_lines(t) / (t[-1] - t[0]))))
