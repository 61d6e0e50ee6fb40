"""``gpebo run plant=circuit estimator=drem`` from a cold start, all files and figures written.

The peer is a Python process that imports the same libraries and draws the same figures from the
CSV files that ours wrote (``plain_figures.py``): what no program of this kind can do without.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.measure import Row, alternate, say

ROOT = Path(__file__).parent.parent


def rows() -> list[Row]:
    """Both commands in turns."""
    say("gpebo run, cold")
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "first"
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}

        def start(*words: str) -> None:
            subprocess.run(  # noqa: S603  this program
                [sys.executable, *words], cwd=folder, env=environment, check=True,
                capture_output=True,
            )

        def ours(*more: str) -> None:
            start("-m", "gpebo_cli", "run", "plant=circuit", "estimator=drem", *more)

        ours(f"hydra.run.dir={first}")
        drawn = Path(folder) / "drawn"
        drawn.mkdir()

        def peer() -> None:
            start(str(ROOT / "benchmarks" / "plain_figures.py"), str(first), str(drawn))

        ours_seconds, peer_seconds = alternate(ours, peer, budget=15.0, least=7)
        same = {p.name for p in drawn.iterdir()} == {p.name for p in (first / "figures").iterdir()}
    return [
        Row(
            "gpebo run plant=circuit estimator=drem, cold", ours_seconds, None,
            "the same imports and figures from CSV", peer_seconds, None,
            note="" if same else "the figures are not the same",
        )
    ]
