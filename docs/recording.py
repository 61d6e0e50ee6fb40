"""Make the session of ``docs/howto/recording.md`` again: ``python docs/recording.py``.

The recording is simulated by SciPy alone, with all that a logger does to it; then the page's three
commands run on it, and what they print and draw goes into the page.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import sys
import tempfile
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

DOCS = Path(__file__).parent
PAGE, IMAGES = DOCS / "howto" / "recording.md", DOCS / "img"
ROWS = 50_000
COMMANDS = (
    "gpebo new recording logger.csv --plant tanks --config-dir .",
    "gpebo check --config-dir . plant=tanks data=logger",
    "gpebo run --config-dir . plant=tanks data=logger hydra.run.dir=result",
)

PLANT = """\
name: tanks
title: two tanks in series, with a leak and a pump whose gain is not known
states: [h1, h2, q]             # levels in m, outflow in l/s
inputs: {u: 0.2 + 0.05*sin(t/200)}
unknowns: {leak: 4e-5, gain: 9.3e-4}    # true values, for simulations only
outputs: [level]
units: {h1: m, h2: m, q: l/s, leak: m/s, gain: m/l, level: m, u: l/s}
E: [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
A: [[-0.004, 0, 0], [0.004, -0.003, 0], [0, 3, -1]]
F: [[-1, u], [0, 0], [0, 0]]            # the inflow is gain·u
C: [[0, 1, 0]]
initial_state: {h1: 0.03, h2: 0.05, q: 0.15}
"""
TRUE = {"leak": 4e-5, "gain": 9.3e-4}


def recording(rows: int = ROWS, seed: int = 3) -> str:
    """A logger's file: dates, litres per minute, millimetres, commas, gaps, noise and rounding."""
    generator = np.random.default_rng(seed)
    step, fine = 0.25, 4 * rows
    t = step * np.arange(fine)
    # The pump is ramped from one flow to the next, and on while the logger pauses.
    corners = np.arange(0.0, t[-1] + 400.0, 150.0)
    corners = corners[(corners < 0.3 * t[-1]) | (corners > 0.31 * t[-1])]
    u = np.interp(t, corners, generator.uniform(0.05, 0.4, len(corners)))
    inflow = TRUE["gain"] * u - TRUE["leak"]

    def level(rate: float, start: float, drive: np.ndarray) -> np.ndarray:
        decay = np.exp(-rate * step)
        gain = (1.0 - decay) / rate
        driven = lfilter([0.0, gain / 2.0], [1.0, -decay], drive)
        driven += lfilter([gain / 2.0], [1.0, -decay], np.append(0.0, drive[1:]))
        return start * decay ** np.arange(fine) + driven

    h2 = level(0.003, 0.05, 0.004 * level(0.004, 0.03, inflow))
    # Uneven sampling, and a pause.
    at = np.sort(generator.choice(fine - 8, rows, replace=False)) + 4
    at = at[(at < 0.3 * fine) | (at > 0.31 * fine)]
    measured = 1e3 * h2[at] + 2.0 * generator.standard_normal(len(at))
    missing = generator.random(len(at)) < 0.01
    begin = datetime(2024, 5, 31, 22, 0, 0)  # noqa: DTZ001  a logger without a zone
    lines = ["Zeit;pump u (l/min);level (mm);comment"]
    for k, m, gone in zip(at, measured, missing, strict=True):
        time = begin + timedelta(seconds=float(t[k]))
        cells = f"{60.0 * u[k]:.4f};" + ("" if gone else f"{round(2.0 * m) / 2.0:.1f}")
        lines.append(f"{time.isoformat(timespec='milliseconds')};{cells.replace('.', ',')};")
    return "\n".join(lines) + "\n"


def session(folder: Path, rows: int = ROWS, more: tuple[str, ...] = ()) -> list[str]:
    """What the three commands print, run in ``folder``; ``more`` words go to the last one."""
    from gpebo_cli.cli.app import main

    (folder / "plant").mkdir()
    (folder / "plant" / "tanks.yaml").write_text(PLANT, encoding="utf-8")
    (folder / "logger.csv").write_text(recording(rows), encoding="utf-8")
    printed, before, arguments = [], Path.cwd(), sys.argv
    os.chdir(folder)
    try:
        for command in COMMANDS:
            out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
            sys.argv = [*command.split(), *(more if command == COMMANDS[-1] else ())]
            with contextlib.redirect_stdout(out):
                code = main()
            out.seek(0)
            text = out.read()
            if code:
                raise RuntimeError(f"{command}: exit code {code}\n{text}")
            printed.append(text)
    finally:
        os.chdir(before)
        sys.argv = arguments
    return printed


def main() -> None:
    """Write the page's blocks and its figures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        printed = session(folder)
        for figure in ("fit", "parameters"):
            shutil.copy(folder / "result" / "figures" / f"{figure}.png",
                        IMAGES / f"recording_{figure}.png")
        head = "".join((folder / "logger.csv").read_text("utf-8").splitlines(keepends=True)[:4])
        guessed = (folder / "data" / "logger.yaml").read_text("utf-8").replace(f"{folder}/", "")
    page = PAGE.read_text(encoding="utf-8")
    blocks = {"plant": PLANT, "rows": head, "guess": guessed}
    blocks |= {f"command {k + 1}": f"$ {c}\n{text}" for k, (c, text) in
               enumerate(zip(COMMANDS, printed, strict=True))}
    for key, text in blocks.items():
        pattern = re.compile(rf"(<!-- {key} -->\n```[a-z]*\n).*?(```\n)", re.DOTALL)
        page = pattern.sub(lambda found, text=text: found[1] + text + found[2], page)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
