"""The regression at samples: what an observer in discrete time hands to an estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.model.descriptor import Array


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
