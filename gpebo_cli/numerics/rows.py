"""Where signals are sampled; recordings have rows, and so has the noise of simulations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array, BoolArray

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
        steps = np.diff(self.t)
        if self.lines:
            beside = np.pad(steps, 1, "edge")
            steps = 0.25 * (beside[:-2] + 2.0 * steps + beside[2:])
        row = np.searchsorted(self.t, t, side="right") - 1
        return np.asarray(steps[row.clip(0, len(steps) - 1)])


def of_lines(t: Array) -> Array:
    """∫ of what straight lines between times (N,) make of 1 at one of them and 0 at the others."""
    half = 0.5 * np.diff(t)
    return np.asarray(np.append(half, 0.0) + np.append(0.0, half))
