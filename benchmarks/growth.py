"""Time and peak memory over the horizon, the number of gains and of samples.

Each point is a process of its own: ``python -m benchmarks.growth AXIS VALUE`` prints one line of
JSON. Memory is what the work adds to the peak that the imports reach.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import as_new, at_most, say

ROOT = Path(__file__).parent.parent
AXES: dict[str, tuple[str, tuple[int, ...]]] = {
    "horizon": ("the circuit experiment, horizon in s", (20, 200, 2_000, 20_000)),
    "descriptor": ("the descriptor experiment, horizon in s", (20, 200, 2_000, 20_000)),
    "gains": ("the circuit experiment, gains", (1, 10, 100, 1_000, 10_000, 100_000, 200_000)),
    "samples": ("the circuit experiment, samples", (1_000, 10_000, 100_000, 1_000_000)),
}
PATIENCE = 200.0  # seconds for one point, of its own work


def experiment(
    horizon: float = 20.0, gains: int = 1, samples: int = 2, name: str = "circuit"
) -> Callable[[], object]:
    """The numerical part of the experiment with a shipped plant."""
    from gpebo_cli import load_plant
    from gpebo_cli.experiment.pipeline import run_experiment
    from gpebo_cli.settings import Settings, SolverSettings, TimeSettings

    gamma: Any = 1e10 if gains == 1 else np.logspace(6, 12, gains).tolist()
    settings = Settings(
        estimator={"name": "drem", "gamma": gamma},
        time=TimeSettings(horizon=horizon, samples=samples), solver=SolverSettings(tol=1e-9),
    )
    system = load_plant(name)

    def run() -> object:
        estimation = run_experiment(settings, as_new(system)).estimation
        return None if estimation is None else np.asarray(estimation.parameters)

    return run


def work(axis: str, value: int) -> Callable[[], object]:
    """What is timed at one point."""
    if axis == "descriptor":
        return experiment(value, name="descriptor")
    return experiment(**{axis: value})  # type: ignore[arg-type]


def point(axis: str, value: int) -> dict[str, float]:
    """Seconds (the best of up to three runs) and bytes, in this process."""
    experiment()()  # imports, and whatever else is done once
    run = work(axis, value)
    before = _peak()
    taken: list[float] = []
    memory = 0
    while len(taken) < 3 and sum(taken) < 5.0:
        start = time.perf_counter()
        run()
        taken.append(time.perf_counter() - start)
        if len(taken) == 1:
            memory = _peak() - before
    return {"value": value, "seconds": min(taken), "bytes": memory, "before": before}


def _peak() -> int:
    """Bytes; Linux's own mark, for ``ru_maxrss`` begins with what the parent process had."""
    try:
        lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return next(int(s.split()[1]) * 1024 for s in lines if s.startswith("VmHWM:"))


def table() -> list[dict[str, Any]]:
    """All axes; an axis ends at a point that fails or takes too long."""
    axes = []
    for axis, (title, values) in AXES.items():
        points: list[dict[str, float]] = []
        note = ""
        for value in values:
            say(f"growth: {axis} {value:,}")
            try:
                points.append(_elsewhere(axis, value))
            except (subprocess.SubprocessError, ValueError) as problem:
                note = f"{value:,}: {_reason(problem)}"
                break
        axes.append({
            "axis": axis, "title": title, "points": points, "note": note,
            "seconds_exponent": exponent(points, "seconds"),
            "bytes_exponent": exponent(points, "bytes"),
        })
    return axes


def _elsewhere(axis: str, value: int) -> dict[str, float]:
    done = subprocess.run(  # noqa: S603  this program
        [sys.executable, "-m", "benchmarks.growth", axis, str(value)], cwd=ROOT, check=True,
        capture_output=True, text=True, timeout=1.5 * PATIENCE,
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _reason(problem: Exception) -> str:
    if isinstance(problem, subprocess.TimeoutExpired):
        return f"not done within {1.5 * PATIENCE:.0f} s"
    text = str(getattr(problem, "stderr", "") or problem).strip().splitlines()
    return text[-1] if text else str(problem)


def exponent(points: list[dict[str, float]], key: str) -> float | None:
    """Slope of log(key) over log(value) at the last three points, beyond the fixed costs."""
    last = [p for p in points if p[key] > 0][-3:]
    if len(last) < 2:
        return None
    x, y = (np.log([p[k] for p in last]) for k in ("value", key))
    return float(np.polyfit(x, y, 1)[0])


def plot(axes: list[dict[str, Any]], path: Path) -> None:
    """Seconds and memory over each axis, doubly logarithmic, beside a line of slope one."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    panels_of = (
        (("horizon", "descriptor"), "horizon (s)"), (("gains",), "gains"),
        (("samples",), "samples"),
    )
    columns = [([a for a in axes if a["axis"] in keys], label) for keys, label in panels_of]
    figure, panels = plt.subplots(
        2, 3, figsize=(8.5, 5.2), sharex="col", sharey="row", layout="constrained"
    )
    for column, (group, label) in enumerate(columns):
        for row, (key, unit) in enumerate((("seconds", 1.0), ("bytes", 2.0**20))):
            panel = panels[row, column]
            for k, axis in enumerate(group):
                shown = [(p["value"], p[key] / unit) for p in axis["points"] if p[key] > 0]
                if not shown:
                    continue
                x, y = np.array(shown).T
                name = "descriptor" if axis["axis"] == "descriptor" else "circuit"
                panel.loglog(x, y, "o-" if k == 0 else "s--", color=f"C{k}", label=name)
                if k == 0:
                    panel.loglog(x, y[-1] * x / x[-1], ":", color="0.5", label="slope 1")
            panel.grid(visible=True, alpha=0.3)
            if row == column == 0:
                panel.legend(fontsize=8)
        panels[1, column].set_xlabel(label)
    panels[0, 0].set_ylabel("seconds")
    panels[1, 0].set_ylabel("memory (MiB)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    with at_most(PATIENCE):
        sys.stdout.write(json.dumps(point(sys.argv[1], int(sys.argv[2]))) + "\n")
