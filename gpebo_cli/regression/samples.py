"""The regression at samples: what an observer in discrete time hands to an estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import SNAP
from gpebo_cli.recordings.hold import held
from gpebo_cli.regression.parametrisation import Parametrisation

Past = tuple[Array, Array]  # times (N,) and values (N, c) of samples that a delay still needs


@dataclass(frozen=True, eq=False)
class SampledRegression:
    """Y = ψη at K successive samples, with what the sample before them had.

    Integrals over a step between samples are taken as the hold rule has it: of the newest sample
    (zoh), or the mean of both ends (linear).
    """

    t: Array  # (K,)
    steps: Array  # (K,) seconds since the sample before; 0 for the first of all
    rows: Array  # (K + 1, rows, p + 1) [ψ | Y], first that of the sample before (the first: itself)
    hold: str  # zoh or linear
    parametrisation: Parametrisation | None = None
    scale: Array | float = 0.0  # (K, p) sizes of the terms of each column of ψ so far

    @property
    def p(self) -> int:
        """Number of parameters."""
        return int(self.rows.shape[2]) - 1

    @property
    def shares(self) -> tuple[Array, Array]:
        """Weights of both ends of a step in an integral over it, (K,) each."""
        if self.hold == "zoh":
            return np.zeros_like(self.steps), self.steps
        return 0.5 * self.steps, 0.5 * self.steps

    def weighted(self) -> Array:
        """Rows whose squares add up to ∫[ψ | Y]ᵀ[ψ | Y] over each step, (K, ·, p + 1)."""
        old, new = (np.sqrt(share)[:, None, None] for share in self.shares)
        if self.hold == "zoh":
            return np.asarray(new * self.rows[1:])
        return np.concatenate([old * self.rows[:-1], new * self.rows[1:]], axis=1)


class Filter(NamedTuple):
    """δf' = A δf + old δY + new δY' over each step, f = 𝒴 or more."""

    A: Array  # (K, s, s)
    old: Array  # (K, s, rows)
    new: Array  # (K, s, rows)


def integrating(regression: SampledRegression, beta: float = 0.0) -> Filter:
    """The filter of h_z, with forgetting at the rate β."""
    p = regression.p
    into = transpose(regression.rows[..., :p])
    old, new = (share[:, None, None] for share in regression.shares)
    decay = np.exp(-beta * regression.steps)[:, None, None] * np.eye(p)
    return Filter(decay, old * into[:-1], new * into[1:])


def ago(t: Array, delay: float) -> Array:
    """t − d (K,); what would miss a sample by rounding is not before it."""
    return np.asarray(t - delay + SNAP * (np.abs(t) + delay))


def delayed(past: Past, t: Array, x: Array, delay: float, hold: str) -> tuple[Array, Past]:
    """x(t − d) (K, c) as the hold has it, zero before the first sample of all, d in seconds.

    Samples (K, c) are at t (K,); the past is what the last call gave, at first the first one alone.
    """
    new, at = t > past[0][-1], ago(t, delay)
    times, values = np.append(past[0], t[new]), np.append(past[1], x[new], axis=0)
    between = held(times, values, hold if len(times) > 1 else "zoh")
    kept = max(int(np.searchsorted(times, at[-1], side="right")) - 1, 0)
    out = np.where((at >= times[0])[:, None], between(t - delay, at), 0.0)
    return out, (times[kept:], values[kept:])
