"""Commands in processes of their own, and how refusals are looked at, those of calls, too."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np
import pandas as pd
import pytest

from gpebo_cli.errors import ConfigError

ROOT = Path(__file__).parents[1]


def environment(**more: str) -> dict[str, str]:
    """An environment in which ``import gpebo_cli`` is this checkout's."""
    inherited = {k: v for k, v in os.environ.items() if k != "HYDRA_FULL_ERROR"}
    return {**inherited, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", **more}


def python(
    *words: object, cwd: Path | None = None, text: str = "", **more: str
) -> subprocess.CompletedProcess[str]:
    """What Python says to these words, with ``text`` as its standard input."""
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=cwd, env=environment(**more), input=text,
        capture_output=True, text=True, check=False, timeout=120,
    )


def process(*words: object, **more: object) -> subprocess.CompletedProcess[str]:
    """A ``gpebo`` that starts as a user's does; see :func:`python`."""
    return python("-m", "gpebo_cli", *words, **more)


def begin(*words: object, cwd: Path, **more: str) -> subprocess.Popen[str]:
    """The same while it runs."""
    return subprocess.Popen(
        [sys.executable, "-m", "gpebo_cli", *map(str, words)], cwd=cwd, env=environment(**more),
        text=True, bufsize=1, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )


def wait_for(folder: Path, pattern: str, count: int = 1) -> None:
    """Until there are as many such files in a folder, for three minutes at most."""
    deadline = monotonic() + 180
    while len(list(folder.glob(pattern))) < count and monotonic() < deadline:
        sleep(0.005)


def install(folder: Path, module: str, group: str, **entries: str) -> None:
    """What `pip install` leaves of a package with entry points."""
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    lines = [f"[{group}]", *(f"{name} = {module}:{what}" for name, what in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines))


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file by the names of their columns."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def read_table(path: Path) -> tuple[list[str], np.ndarray[Any, np.dtype[np.float64]]]:
    """The header of a CSV file and its numbers, NaN where a cell is empty."""
    with path.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    return header, np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])


def write_table(path: Path, columns: Mapping[str, object]) -> str:
    """Write columns as a CSV file, without rounding; the name of the file."""
    pd.DataFrame(columns).to_csv(path, index=False)
    return str(path)


@contextmanager
def refused(
    *parts: str, by: type[Exception] = ConfigError, begins: str = ""
) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """What is done inside is refused in one line with all these parts."""
    with pytest.raises(by) as caught:
        yield caught
    said = str(caught.value)
    assert len(said.splitlines()) == 1
    assert said.startswith(begins)
    assert [part for part in parts if part not in said] == [], said


def printed(done: subprocess.CompletedProcess[str]) -> str:
    """What a command printed that ended well, without a word on standard error."""
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def assert_refused(done: subprocess.CompletedProcess[str], *parts: str, code: int = 2) -> None:
    """A command has said one line with all these parts, and nothing else."""
    said = done.stderr
    assert (done.returncode, done.stdout, said.count("\n")) == (code, "", 1), said
    assert said.startswith("gpebo: error: ")
    assert [part for part in parts if part not in said] == [], said
