"""Seconds and memory of a sweep on each launcher, and of the same gains as an axis of one run.

    python benchmarks/sweeps.py [JOBS] [axis|basic|joblib|ray|submitit_slurm …]

Memory is the largest sum, over all processes that work on the sweep, of their proportional set
sizes, sampled four times a second. Linux only; launchers must be installed, Slurm must run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LAUNCHERS = ("axis", "basic", "joblib", "ray", "submitit_slurm")
ROOT = Path(__file__).parents[1]


def main() -> None:
    """Print one line per way."""
    words = sys.argv[1:]
    jobs = int(words.pop(0)) if words and words[0].isdigit() else 100
    for launcher in words or LAUNCHERS:
        with tempfile.TemporaryDirectory() as folder:
            seconds, memory = measure(command(launcher, jobs), folder)
        each = f"{1e3 * seconds / jobs:8.1f} ms per job"
        sys.stdout.write(
            f"{launcher:<15} {jobs:5d} {seconds:8.1f} s {each} {memory / 2**20:6.0f} MiB\n"
        )
        sys.stdout.flush()


def command(launcher: str, jobs: int) -> list[str]:
    """``gpebo run`` over ``jobs`` gains, without figures."""
    gains = f"estimator.gamma=logspace(6,12,{jobs})"
    how = [] if launcher == "axis" else ["-m", f"hydra/launcher={launcher}"]
    return [sys.executable, "-m", "gpebo_cli", "run", gains, "figures=none", *how]


def measure(words: list[str], folder: str) -> tuple[float, int]:
    """Seconds until the command ends, and bytes of memory at the worst moment."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    start = time.monotonic()
    process = subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.DEVNULL)  # noqa: S603
    most = 0
    while process.poll() is None:
        most = max(most, sum(map(memory, family(process.pid))))
        time.sleep(0.25)
    if process.returncode:
        sys.exit(f"{' '.join(words)} ended with {process.returncode}")
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


if __name__ == "__main__":
    main()
