"""Computing time and peak memory of `gpebo run` on long recordings, beside a stream of the rows.

The command as a user calls it, figures included, in a process of its own. The recordings are
simulations with noise: the circuit, whose ψ is a function of time, and plants whose matrices
follow what is measured. ``python -m benchmarks.recordings PLANT ROWS ESTIMATOR [stream]`` prints
one line of JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import say

HORIZONS = {"circuit": 200.0, "battery": 20_000.0, "motor": 20.0}  # seconds
NOISE = {"circuit": 1e-3, "battery": 1e-3, "motor": 1e-2}
ROWS, MANY = 100_000, 1_000_000
ESTIMATORS = ("least_squares", "ls_drem", "drem", "fct", "gradient", "mre", "lion", "power",
              "exciting", "instrumental", "annihilator")


def table() -> list[dict[str, Any]]:
    """All plants and estimators, and a million rows of the circuit."""
    asked = [(plant, ROWS, name) for plant in HORIZONS for name in ESTIMATORS]
    asked += [("circuit", MANY, name) for name in ESTIMATORS[:2]]
    return [both(*each) for each in asked]


def both(plant: str, rows: int, estimator: str) -> dict[str, Any]:
    """One of them, and the stream of the same rows."""
    say(f"recordings: {plant}, {rows:,} rows, {estimator}")
    whole = measured(plant, rows, estimator)
    streamed = measured(plant, rows, estimator, stream=True) if rows == ROWS else {}
    return {"plant": plant, "rows": rows, "estimator": estimator, **whole,
            "stream": streamed.get("seconds")}


def measured(plant: str, rows: int, estimator: str, *, stream: bool = False) -> dict[str, Any]:
    """Seconds of computing and bytes at the worst moment; why there are none, where it fails."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.csv"
        _record(plant, rows, file)
        words = [sys.executable, "-m", "gpebo_cli", "run", f"plant={plant}",
                 f"estimator={estimator}", f"data.file={'-' if stream else file}"]
        words += [] if stream else [f"hydra.run.dir={folder}/out"]
        with file.open() as given, (Path(folder) / "said").open("w+") as said:
            process = subprocess.Popen(  # noqa: S603  this program
                words, stdin=given, stdout=subprocess.DEVNULL, stderr=said,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            )
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            said.seek(0)
            lines = said.read().strip().splitlines()
    if status:
        return {"note": lines[-1] if lines else f"exit {process.returncode}"}
    return {"seconds": used.ru_utime + used.ru_stime, "bytes": used.ru_maxrss * 1024}


def _record(plant: str, rows: int, file: Path) -> None:
    from gpebo_cli import run

    made = run(plant, observer="none", time={"horizon": HORIZONS[plant], "samples": rows})
    rng, columns = np.random.default_rng(1), {"t": made.t, **made.inputs, **made.outputs}
    for name in made.outputs:
        columns[name] = columns[name] + NOISE[plant] * rng.standard_normal(rows)
    np.savetxt(file, np.column_stack([*columns.values()]), fmt="%.10g", delimiter=",",
               header=",".join(columns), comments="")


if __name__ == "__main__":
    name, count, law, *more = sys.argv[1:]
    sys.stdout.write(json.dumps(measured(name, int(count), law, stream=bool(more))) + "\n")
