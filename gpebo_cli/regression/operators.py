"""The operators of a regression's text, on a mesh and from one sample to the next.

They are exact: on a mesh by its own rule, and at samples for what the hold has between them. Two
calls at samples keep one number of a filter or an integral, and the last d seconds of a delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.kernels.laws_numpy import mean_decay
from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions.tape import Tape
from gpebo_cli.numerics.linalg import affine_scan
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.samples import delayed


@dataclass(frozen=True, eq=False)
class OperatorState:
    """The argument of an operator at the samples that still count, and what was made of it."""

    t: Array  # (N,) at least the last sample
    x: Array  # (N,)
    z: float = 0.0  # of a filter or an integral


@dataclass(frozen=True, eq=False)
class Operator:
    """One operator of the text; its value is a further signal."""

    name: str  # lp, hp, integral or delay
    argument: Tape  # of one output
    number: float  # λ in 1/s or d in s; 0 for integral

    def __call__(self, x: Trajectory) -> Array:
        """The operator's values at the points of the mesh of x (K, s + 1), of that shape."""
        if self.name == "integral":
            return x.integral().values
        if self.name == "lp":
            return x.low_pass(self.number).values
        if self.name == "hp":
            return np.asarray(self.number * (x.values - x.low_pass(self.number).values))
        start = x.mesh.edges[0]
        t, inside = (times.ravel() - self.number for times in (x.mesh.points, x.mesh.inside))
        since = inside > start
        out = np.zeros(len(t))
        out[since] = x(np.maximum(t[since], start), inside[since])
        return out.reshape(x.values.shape)

    def most(self, elapsed: Array) -> Array | float:
        """How many times its argument its terms may be, ``elapsed`` (N,) s after the start."""
        if self.name == "integral":
            return elapsed
        return 2.0 * self.number if self.name == "hp" else 1.0

    def carried(
        self, hold: str, known: OperatorState, t: Array, x: Array
    ) -> tuple[Array, OperatorState]:
        """The operator's values (K,) at samples x (K,) at t (K,), and its state after them."""
        if self.name == "delay":
            past = known.t, known.x[:, None]
            out, (times, values) = delayed(past, t, x[:, None], self.number, hold)
            return out[:, 0], OperatorState(times, values[:, 0])
        steps = np.diff(t, prepend=known.t[-1])
        before = np.append(known.x[-1], x[:-1])
        after = before if hold == "zoh" else x  # at both ends of the step to a sample
        if self.name == "integral":
            z = known.z + np.cumsum(0.5 * steps * (before + after))
            return z, OperatorState(t[-1:], x[-1:], float(z[-1]))
        decay, mean = np.exp(-self.number * steps), mean_decay(self.number * steps)
        shift = (1.0 - mean) * after + (mean - decay) * before
        z = affine_scan(decay, shift, np.asarray(known.z))[1:]
        out = z if self.name == "lp" else self.number * (x - z)
        return out, OperatorState(t[-1:], x[-1:], float(z[-1]))
