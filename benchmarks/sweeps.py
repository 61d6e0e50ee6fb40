"""Seconds and memory of a sweep on each launcher, and of the same gains as an axis of one run.

    python -m benchmarks sweeps

Memory is the largest sum, over all processes that work on the sweep, of their proportional set
sizes, sampled four times a second. Linux only. A launcher that is not installed, or Slurm that
does not run, is a row that says so.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.measure import say

LAUNCHERS = ("axis", "basic", "joblib", "ray", "submitit_slurm")
JOBS = 1000
ROOT = Path(__file__).parents[1]


def table(jobs: int = JOBS) -> list[dict[str, Any]]:
    """One row for each way."""
    rows = []
    for launcher in LAUNCHERS:
        say(f"sweeps: {launcher}, {jobs:,} jobs")
        row: dict[str, Any] = {
            "launcher": launcher, "jobs": jobs, "seconds": None, "bytes": None, "note": ""
        }
        with tempfile.TemporaryDirectory() as folder:
            try:
                row["seconds"], row["bytes"] = measure(command(launcher, jobs), folder)
            except ArithmeticError as problem:
                row["note"] = str(problem)
        rows.append(row)
    return rows


def command(launcher: str, jobs: int) -> list[str]:
    """``gpebo run`` over ``jobs`` gains, without figures."""
    gains = f"estimator.gamma=logspace(6,12,{jobs})"
    how = [] if launcher == "axis" else ["-m", f"hydra/launcher={launcher}"]
    return [sys.executable, "-m", "gpebo_cli", "run", gains, "figures=none", *how]


def measure(words: list[str], folder: str) -> tuple[float, int]:
    """Seconds until the command ends, and bytes of memory at the worst moment.

    Raises:
        ArithmeticError: it ended with an error, its last line.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    start = time.monotonic()
    with (Path(folder) / "stderr").open("w+", encoding="utf-8") as errors:
        process = subprocess.Popen(  # noqa: S603
            words, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=errors
        )
        most = 0
        while process.poll() is None:
            most = max(most, sum(map(memory, family(process.pid))))
            time.sleep(0.25)
        if process.returncode:
            errors.seek(0)
            lines = errors.read().strip().splitlines()
            raise ArithmeticError(lines[-1] if lines else f"exit {process.returncode}")
    return time.monotonic() - start, most


def family(root: int) -> set[int]:
    """``root``, its descendants, and tasks of Slurm that submitit started."""
    parents: dict[int, int] = {}
    found = {root}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            after_name = (entry / "stat").read_text().rpartition(")")[2].split()
            parents[int(entry.name)] = int(after_name[1])
            if b"submitit.core._submit" in (entry / "cmdline").read_bytes():
                found.add(int(entry.name))
        except OSError:
            continue  # it has ended
    while True:
        more = {child for child, parent in parents.items() if parent in found} - found
        if not more:
            return found
        found |= more


def memory(process: int) -> int:
    """Bytes of one process, shared pages divided among those that share them."""
    try:
        text = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0
    return sum(int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith("Pss:"))
