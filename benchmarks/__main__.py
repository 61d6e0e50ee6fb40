"""``make bench``, or ``python -m benchmarks [PART…]``; numbers are measured, never typed in.

Writes ``benchmarks/benchmarks.json`` and, from it, ``docs/benchmarks.md``. Parts that are not
measured keep what they had. Without words all parts are, but for ``sweeps`` and ``recordings``,
which take half an hour each. ``python -m benchmarks kernels`` prints what each compiled kernel is
worth and writes it into ``docs/decisions.md``.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import traceback
from collections.abc import Callable
from datetime import date
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks import circuit, cold, gains, growth, ladders, problems, recordings, sweeps
from benchmarks import kernels as ablation
from benchmarks.measure import Row
from benchmarks.page import PARTS, page
from gpebo_cli import kernels

ROOT = Path(__file__).parent.parent
JSON = ROOT / "benchmarks" / "benchmarks.json"
PAGE = ROOT / "docs" / "benchmarks.md"
PLOT = ROOT / "docs" / "img" / "growth.png"
SLOW = ("recordings", "sweeps")
PACKAGES = ("numpy", "scipy", "matplotlib", "casadi", "scikit-sundae", "solve-dae", "diffrax",
            "jax")

Measured = tuple[list[Row], dict[str, Any]]


def _growth() -> Measured:
    axes = growth.table()
    growth.plot(axes, PLOT)
    return [], {"axes": axes, "ladders": _ladders()}


def _ladders() -> list[dict[str, Any]]:
    rows = ladders.table()
    ladders.plot(rows, PLOT.with_name("ladders.png"))
    return rows


MEASURE: dict[str, Callable[[], Measured]] = {
    "circuit": lambda: (circuit.rows(), {}),
    "gains": lambda: (gains.rows(), {}),
    "problems": lambda: (problems.rows(), {"deriving": problems.deriving()}),
    "cold": lambda: (cold.rows(), {}),
    "growth": _growth,
    "recordings": lambda: ([], {"rows": recordings.table()}),
    "sweeps": lambda: ([], {"rows": sweeps.table()}),
}


def merged(data: dict[str, Any], part: str, rows: list[Row], more: dict[str, Any],
           measured: dict[str, Any]) -> dict[str, Any]:
    """``data`` with one part replaced."""
    kept = [row for row in data.get("rows", []) if row["part"] != part]
    fresh = [{**row.record(), "part": part} for row in rows]
    return {
        "rows": sorted([*kept, *fresh], key=lambda row: PARTS.index(row["part"])),
        "parts": {**data.get("parts", {}), part: {"measured": measured, **more}},
    }


def environment() -> dict[str, Any]:
    """Machine, versions, date and load."""
    versions = {"Python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    versions["kernels"] = kernels.kind()
    machine = f"{_cpu()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}"
    return {
        "date": date.today().isoformat(),  # noqa: DTZ011  the reader's own calendar
        "machine": machine, "versions": versions, "blas": _blas(), "load": os.getloadavg()[0],
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown CPU"
    return next((s.partition(":")[2].strip() for s in lines if s.startswith("model name")), "CPU")


def _blas() -> str:
    """NumPy's and SciPy's libraries of linear algebra, and their threads."""
    import scipy.linalg  # noqa: F401  loads its own

    try:
        from threadpoolctl import threadpool_info
    except ImportError:
        return f"BLAS threads: {os.environ.get('OPENBLAS_NUM_THREADS', 'default')}"
    found = {
        f"{pool['internal_api']} {pool['version']}, {pool['num_threads']} threads"
        for pool in threadpool_info() if pool["user_api"] == "blas"
    }
    return "BLAS: " + " and ".join(sorted(found))


def write(data: dict[str, Any]) -> None:
    """The two files."""
    JSON.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", "utf-8")
    PAGE.write_text(page(data), "utf-8")


def main(words: list[str]) -> int:
    """Measure the parts named by ``words`` and write after each, so that nothing is lost."""
    if words == ["kernels"]:
        for found in ablation.table():
            ablation.write(found)
        sys.stdout.write(f"{found}\n")
        return 0
    unknown = [word for word in words if word not in PARTS]
    if unknown:
        sys.stderr.write(f"there is no part {unknown[0]!r}; there are {', '.join(PARTS)}\n")
        return 2
    data = json.loads(JSON.read_text("utf-8")) if JSON.exists() else {"rows": [], "parts": {}}
    failed = []
    for part in words or [part for part in PARTS if part not in SLOW]:
        sys.stderr.write(f"{part}\n")
        measured = environment()
        try:
            rows, more = MEASURE[part]()
        except Exception:  # noqa: BLE001  ours failed; the other parts are still worth measuring
            traceback.print_exc()
            failed.append(part)
            continue
        data = merged(data, part, rows, more, measured)
        write(data)
    if failed:
        sys.stderr.write(f"not measured, old numbers kept: {', '.join(failed)}\n")
        return 1
    sys.stdout.write(PAGE.read_text("utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
