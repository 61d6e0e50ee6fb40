"""The circuit with a thousand gains: one run of ours, a thousand of theirs.

Ten of the thousand are timed for the peers and the time is scaled; errors are over those ten, too.
diffrax's ``vmap`` was tried: a hundred gains at once take longer than one after the other, because
all of them step until the last is done.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.circuit import (
    OURS,
    TARGET,
    DiffraxPeer,
    optimised,
    ours,
    scipy_peer,
    script,
    truth,
)
from benchmarks.measure import Array, Row, Solve, compare, decades, loosest

COUNT = 1000
GAINS = [float(gain) for gain in np.logspace(6, 12, COUNT)]


def some(count: int) -> list[float]:
    """``count`` of the gains, evenly spread."""
    return GAINS[COUNT // count // 2 :: COUNT // count]


def error(values: Array) -> float:
    """Largest error at any gain; ``values`` (G, T, 5) are for all gains or for some."""
    exact = np.array([truth(gain) for gain in some(len(values))])
    return float(np.abs(values - exact).max())


def all_gains(tol: float) -> Solve:
    """Ours, all of them in one run."""
    return ours(tol, GAINS)


def rows() -> list[Row]:
    """Every peer at its loosest tolerance that serves all gains it is timed with."""
    mine = loosest(all_gains, OURS, error, TARGET)
    row = partial(
        compare, "circuit, 1,000 gains", mine, tolerances=decades(-9, -13), error=error,
        target=TARGET, budget=5.0, patience=120.0,
    )
    table = [
        row(peer=f"scipy {method}, {how}, × 1,000",
            prepare=scipy_peer(method, right, some(10)), scale=COUNT / 10)
        for method in ("LSODA", "BDF", "Radau")
        for how, right in (("script", script), ("optimised", optimised))
    ]
    return [
        *table,
        row(peer="diffrax Kvaerno5, × 1,000", prepare=DiffraxPeer("Kvaerno5", some(10)),
            scale=COUNT / 10),
    ]
