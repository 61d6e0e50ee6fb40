"""Commands that are killed at a random moment: no orphan, no half file, and sweeps go on.

``pytest tests/faults --kills 100`` kills a hundred times; without it, each command is killed once.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
SWEEP = ["run", "-m", "estimator.gamma=1e6,1e7,1e8,1e9", "figures=none", "time.samples=51"]
COMMANDS = {
    "run": ["run", "time.samples=51", "figures=[gram]", "hydra.run.dir=out"],
    "serial": [*SWEEP, "hydra.sweep.dir=sweep"],
    "joblib": [*SWEEP, "launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=sweep"],
    "figures": ["figures", "literal_regressor", "--output", "out"],
    "compare": ["compare", "WHOLE", "--output", "out"],
}
# A signal before our first line is the interpreter's, so the file says when that was reached.
BEGIN = "from gpebo_cli.cli.start import entry; open('begun', 'w').close(); entry()"

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")


def begin(words, cwd, mark=""):
    return subprocess.Popen(
        [sys.executable, "-c", BEGIN, *words], cwd=cwd, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "GPEBO_FAULT": mark},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )


def finished(words, cwd):
    with begin(words, cwd) as process:
        output, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    return output


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A sweep that nobody disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    finished(COMMANDS["serial"], folder)
    return folder / "sweep"


def pytest_generate_tests(metafunc):
    kills = metafunc.config.getoption("--kills")
    cases = [(list(COMMANDS)[i % len(COMMANDS)], SIGNALS[(i + i // 15) % 3], i)
             for i in range(kills)]
    metafunc.parametrize(("name", "how", "seed"), cases)


def alive(mark):
    """Processes whose environment has the mark, and that are no zombies."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if f"GPEBO_FAULT={mark}\0".encode() in (entry / "environ").read_bytes():
                found.append(entry.name)
        except OSError:
            continue
    return found


def assert_whole(folder):
    """Files are complete, or have a name that says they are not."""
    for path in folder.rglob("*"):
        if not path.is_file() or path.name.startswith(".") or path.name == "begun":
            continue
        content = path.read_bytes()
        if path.suffix == ".json":
            json.loads(content)
        elif path.suffix == ".csv":
            assert content.endswith(b"\n")
            assert len({len(row) for row in csv.reader(content.decode().splitlines())}) == 1
        elif path.suffix == ".png":
            assert content.endswith(b"IEND\xaeB`\x82")


def table(folder):
    with (folder / "results.csv").open() as stream:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(stream)]


def test_whatever_ends_a_command(tmp_path, whole, name, how, seed):
    words = [str(whole) if word == "WHOLE" else word for word in COMMANDS[name]]
    mark = uuid.uuid4().hex
    with begin(words, tmp_path, mark) as process:
        deadline = time.monotonic() + 60
        while not (tmp_path / "begun").exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(random.Random(seed).uniform(0.0, 2.5))  # noqa: S311
        with contextlib.suppress(ProcessLookupError):
            # A terminal tells everybody in front of it of Ctrl-C.
            (os.killpg if how == signal.SIGINT else os.kill)(process.pid, how)
        # Whoever is left holds these pipes.
        _, error = process.communicate(timeout=60 if how == signal.SIGINT else 5)
    ended = time.monotonic()
    while alive(mark) and time.monotonic() < ended + 5:
        time.sleep(0.05)
    assert alive(mark) == []
    assert_whole(tmp_path)
    if how == signal.SIGINT:
        lines = [line for line in error.splitlines() if "jobs are not done" not in line]
        expected = {130: ["gpebo: error: interrupted"], 0: []}
        assert lines == expected.get(process.returncode), (process.returncode, error)
    else:
        assert process.returncode in (-how, 0)
    if name in ("serial", "joblib") and process.returncode:
        words[-1] = "resume=sweep" if (tmp_path / "sweep").is_dir() else words[-1]
        finished(words, tmp_path)
        assert table(tmp_path / "sweep") == table(whole)
