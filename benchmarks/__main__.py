"""``make bench``: medians over alternating runs, errors beside times, numbers never typed in.

Writes ``outputs/benchmarks.json`` (rows: name, ours_seconds, ours_error, peer, peer_seconds,
peer_error, ratio) and ``docs/benchmarks.md``.
"""

from __future__ import annotations

import json
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np

from benchmarks.circuit import HORIZON, ours, scipy_run

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from plants import DATA, problem, reference, shipped  # noqa: E402

from gpebo_cli.settings import SolverSettings, TimeSettings  # noqa: E402
from gpebo_cli.simulation.simulate import simulate  # noqa: E402

Row = dict[str, object]
_OURS_TOL = 1e-7  # gives the error that the scipy runs are held to


def seconds(call: Callable[[], object], runs: int) -> float:
    """Median wall time of some runs after one that is not counted."""
    call()
    taken = []
    for _ in range(runs):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def circuit_rows() -> list[Row]:
    """The whole experiment against one monolithic ODE, each tolerance giving a like error."""
    system = shipped("circuit")
    truth = np.array(reference("circuit")["at"][-1]["x"])
    result = ours(system, _OURS_TOL)
    error = max(
        float(np.abs(result.simulation.states[-1] - truth).max()),
        float(result.metrics.final_error_parameters[0]),  # type: ignore[union-attr]
    )
    took = seconds(lambda: ours(system, _OURS_TOL), 15)
    rows: list[Row] = []
    best = np.inf
    for method, rtol in (("LSODA", 1e-9), ("BDF", 1e-8), ("Radau", 1e-9)):
        peer_error, _ = scipy_run(method, rtol)
        peer = seconds(lambda m=method, r=rtol: scipy_run(m, r), 1)  # type: ignore[misc]
        best = min(best, peer)
        rows.append(_row("circuit, γ = 1e10", took, error, f"scipy {method}", peer, peer_error))
    gains = np.logspace(6, 12, 1000).tolist()
    many = seconds(lambda: ours(system, _OURS_TOL, gains), 3)
    rows.append(
        _row("circuit, 1,000 gains", many, error, "scipy, best of the above × 1,000",
             1000 * best, float(min(r["peer_error"] for r in rows)))  # type: ignore[type-var]
    )
    return rows


def problem_rows() -> list[Row]:
    """The published problems: ours only, loading the text apart."""
    import sympy as sp

    rows: list[Row] = []
    for path in sorted((DATA / "problems").glob("*.json")):
        if "not_unique" in path.stem:
            continue
        data, system = problem(path)
        start, stop = data["tspan"]
        when, solver = TimeSettings(start, stop - start), SolverSettings(tol=1e-9)
        result = simulate(system, when, solver)
        t = np.linspace(start, stop, 201)
        symbol = sp.Symbol("t")
        exact = np.array([
            sp.lambdify(symbol, sp.sympify(text), "numpy")(t) + 0 * t for text in data["solution"]
        ]).T
        error = float(np.abs(result.signals.states(t) - exact).max())
        took = seconds(lambda s=system, w=when, v=solver: simulate(s, w, v), 9)  # type: ignore[misc]
        loading = seconds(lambda p=path: problem(p), 5)  # type: ignore[misc]
        rows.append(_row(path.stem, took, error, "reading the plant's text", loading, None))
    return rows


def growth_rows() -> list[Row]:
    """Time and memory against the horizon, gains and samples."""
    system = shipped("circuit")
    rows: list[Row] = []
    for horizon in (20.0, 200.0, 2000.0):
        when = TimeSettings(horizon=horizon)
        took = seconds(lambda w=when: simulate(system, w, SolverSettings()), 1)  # type: ignore[misc]
        rows.append(_row(f"simulate, horizon {horizon:g} s", took, None, "", None, None))
    for count in (1, 100, 10_000):
        gains = np.logspace(6, 12, count).tolist()
        took = seconds(lambda g=gains: ours(system, 1e-12, g), 1)  # type: ignore[misc]
        rows.append(_row(f"{count:,} gains", took, None, "", None, None))
    for samples in (1_000, 100_000):
        took = seconds(lambda s=samples: ours(system, 1e-12, 1e10, s), 1)  # type: ignore[misc]
        rows.append(_row(f"{samples:,} samples", took, None, "", None, None))
    return rows


def _row(
    name: str, took: float, error: float | None, peer: str, peer_seconds: float | None,
    peer_error: float | None,
) -> Row:
    ratio = None if peer_seconds is None else peer_seconds / took
    return {
        "name": name, "ours_seconds": took, "ours_error": error, "peer": peer,
        "peer_seconds": peer_seconds, "peer_error": peer_error, "ratio": ratio,
    }


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _table(rows: list[Row]) -> str:
    head = ["name", "ours_seconds", "ours_error", "peer", "peer_seconds", "peer_error", "ratio"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(_cell(row[key]) for key in head) + " |" for row in rows]
    return "\n".join(lines)


def main() -> None:
    """Run everything and write the two files."""
    sections = {
        "The circuit experiment": circuit_rows(),
        "Published problems": problem_rows(),
        "Growth": growth_rows(),
    }
    rows = [row for section in sections.values() for row in section]
    versions = ", ".join(f"{p} {version(p)}" for p in ("numpy", "scipy"))
    today = date.today().isoformat()  # noqa: DTZ011  the reader's own calendar
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    text = [
        "# Benchmarks",
        "",
        (
            f"Made by `make bench` on {today}: Python {platform.python_version()}, {versions}, "
            f"{platform.machine()}, {platform.system()}. Seconds are medians; ratios are peer over "
            f"ours. The horizon is {HORIZON:g} s unless the name says otherwise. Peak memory of "
            f"the whole benchmark: {memory:.0f} MB."
        ),
    ]
    for title, section in sections.items():
        text += ["", f"## {title}", "", _table(section)]
    (ROOT / "outputs" / "benchmarks.json").write_text(json.dumps(rows, indent=2) + "\n", "utf-8")
    (ROOT / "docs" / "benchmarks.md").write_text("\n".join(text) + "\n", "utf-8")
    sys.stdout.write("\n".join(text) + "\n")


if __name__ == "__main__":
    main()
