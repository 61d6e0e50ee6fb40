"""Where signals are sampled; recordings have rows, and so has the noise of simulations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array, BoolArray, IntArray

_PAUSE = 5.0  # times the median step: a longer one is a pause,
_RARE = 100.0  # unless one in so many files has it by the chance of its uneven rows


class Rows(NamedTuple):
    """Where signals were sampled: each row has an error of its own."""

    t: Array  # (N,) seconds, ascending
    hold: str = "zoh"  # what is assumed between them, of their errors, too

    @property
    def lines(self) -> bool:
        """Whether errors between rows are on straight lines, or near them; else they are held."""
        return self.hold != "zoh"

    @property
    def pauses(self) -> BoolArray:
        """Which steps are pauses (N − 1,).

        Steps between random times have exponential tails: so much longer than half of them is as
        likely once more as a quarter is beyond the middle.
        """
        steps = np.diff(self.t)
        middle, upper = np.quantile(steps, [0.5, 0.75])
        by_chance = middle + np.log2(_RARE * len(steps)) * (upper - middle)
        return np.asarray(steps > max(_PAUSE * middle, by_chance))

    def intensities(self, t: Array) -> Array:
        """Of white noise that moves integrals as errors of variance 1 do, at times t (M,), in s.

        What lines make of an error beside a time has a part in the steps on both sides.
        """
        row = np.searchsorted(self.t, t, side="right") - 1

        def steps(row: IntArray) -> Array:
            k = row.clip(0, len(self.t) - 2)
            return np.asarray(self.t[k + 1] - self.t[k])

        if not self.lines:
            return steps(row)
        row = row.clip(0, len(self.t) - 2)
        return 0.25 * (steps(row - 1) + 2.0 * steps(row) + steps(row + 1))
