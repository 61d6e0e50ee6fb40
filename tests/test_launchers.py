"""The same sweep on every launcher that is installed and, for Slurm, running."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import threading
import time
from pathlib import Path

import pytest
from examples import gpebo as one_by_one
from processes import assert_refused, begin, python, wait_for
from processes import process as gpebo
from test_sweep import FAST, rows, without_seconds

import gpebo_cli.cli.workers
from gpebo_cli.cli.workers import apart

WORDS = ["run", "-m", "estimator.gamma=1e6,-1,1e8", *FAST]


def why_not(launcher):
    """Why a launcher cannot be used here, or nothing."""
    package = {
        "joblib": "hydra_joblib_launcher",
        "ray": "hydra_ray_launcher",
        "submitit_slurm": "hydra_submitit_launcher",
    }[launcher]
    try:
        if importlib.util.find_spec(f"hydra_plugins.{package}") is None:
            return f"{package} is not installed"
    except ModuleNotFoundError:
        return f"{package} is not installed"
    if launcher != "submitit_slurm":
        return ""
    try:
        nodes = subprocess.run(
            ["sinfo", "--noheader", "--format", "%T"], capture_output=True, text=True, check=False,
            timeout=20,
        )
    except (OSError, subprocess.TimeoutExpired):
        return "there is no Slurm here"
    return "" if "idle" in nodes.stdout else "no Slurm node is idle"


def options(launcher, shared):
    """The words that choose a launcher; Slurm's jobs must find this checkout."""
    words = [f"launcher={launcher.removeprefix('submitit_')}"]
    if launcher == "joblib":
        words.append("hydra.launcher.n_jobs=2")
    if launcher == "submitit_slurm":
        words.append("hydra.launcher.timeout_min=5")
    return [*words, f"hydra.sweep.dir={shared}"]


@pytest.fixture(scope="module")
def basic(tmp_path_factory):
    folder = tmp_path_factory.mktemp("basic")
    one_by_one(*WORDS, "hydra.sweep.dir=sweep", cwd=folder)
    return folder / "sweep"


def numbers(folder):
    """The table with its numbers rounded: other processes may have other threads in BLAS."""
    names = ("job", "estimator.gamma", "status", "error")
    return [
        ([row[name] for name in names], row["seconds_to_1pct_states"][:9]) for row in rows(folder)
    ]


@pytest.mark.parametrize("launcher", ["joblib", "ray", "submitit_slurm"])
def test_every_launcher_makes_the_same_table(tmp_path, basic, launcher):
    if reason := why_not(launcher):
        pytest.skip(reason)
    words = [*WORDS, *options(launcher, "sweep")]
    done = gpebo(*words, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines()[-1] == "3 jobs, 2 done, 1 failed"
    assert done.stderr.splitlines()[-1].startswith("gpebo: error: 1 of 3 jobs failed: job 1: ")
    sweep = tmp_path / "sweep"
    assert numbers(sweep) == numbers(basic)

    # lose a job, go on: only that one and the failed one run again
    kept = (sweep / "2" / "result.json").stat().st_mtime_ns
    (sweep / "0" / "result.json").unlink()
    words[-1] = "resume=sweep"
    assert gpebo(*words, cwd=tmp_path).returncode == 1
    assert (sweep / "2" / "result.json").stat().st_mtime_ns == kept
    assert numbers(sweep) == numbers(basic)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_worker_that_dies_leaves_a_sweep_that_can_be_resumed(tmp_path):
    if reason := why_not("joblib"):
        pytest.skip(reason)
    many = ["run", "-m", "estimator.gamma=logspace(6,9,6)", *FAST]
    words = [*many, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=sweep"]
    with begin(*words, cwd=tmp_path) as process:
        wait_for(tmp_path / "sweep", "*/result.json", 1)
        for worker in workers(process.pid):
            os.kill(worker, signal.SIGKILL)
        output, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "missing" in output.splitlines()[-1]
    # TerminatedWorkerError, or, where a worker died while sending, what our own watch says.
    assert "the launcher gave up: " in error
    # Our last word; after it the dead pool's resource tracker, a process of its own, may warn.
    own = [line for line in error.splitlines() if line.startswith("gpebo: error: ")]
    assert own[-1].endswith("go on with resume=sweep")
    statuses = [row["status"] for row in rows(tmp_path / "sweep")]
    assert statuses.count("done") >= 1
    assert statuses.count("missing") >= 1

    assert one_by_one(*many, "resume=sweep", cwd=tmp_path).returncode == 0
    whole = tmp_path / "whole"
    assert one_by_one(*many, f"hydra.sweep.dir={whole}", cwd=tmp_path).returncode == 0
    assert without_seconds(tmp_path / "sweep") == without_seconds(whole)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_dead_child_that_nobody_collects_is_noticed(monkeypatch):
    """What joblib leaves of a worker that died while it was sending a result."""
    # Its living children are others' here: the process behind the `gpebo` of all tests is one.
    monkeypatch.setattr(gpebo_cli.cli.workers, "end_children", lambda: None)
    monkeypatch.setattr(gpebo_cli.cli.workers, "_FAREWELL", 0.1)
    ended, started = threading.Event(), []

    def launch():
        started.append(subprocess.Popen(["true"]))
        ended.wait(20)

    with pytest.raises(ChildProcessError, match="died while it was sending"):
        apart(launch, patience=0.2)
    ended.set()
    started[0].wait()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_launcher_that_waits_for_ever_does_not_keep_the_process():
    """Its threads do not end, and Python would wait for them."""
    script = """
import subprocess, threading
from gpebo_cli.cli import app, workers

def launch():
    child = subprocess.Popen(["true"])  # dropped, it would be collected
    threading.Thread(target=threading.Event().wait, daemon=False).start()  # Python waits for it
    threading.Event().wait()

def main():
    workers._FAREWELL = 0.1
    try:
        workers.apart(launch, patience=0.2)
    except ChildProcessError:
        print("given up")
        return 1

app.main = main
app.entry()
"""
    done = python("-c", script)
    assert (done.returncode, done.stdout) == (1, "given up\n")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_child_that_is_collected_is_not():
    def launch():
        for _ in range(5):
            subprocess.run(["true"], check=True)
            time.sleep(0.1)
        return "done"

    assert apart(launch, patience=0.2) == "done"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_a_child_may_be_collected_late(monkeypatch):
    monkeypatch.setattr(gpebo_cli.cli.workers, "_INTERVAL", 0.02)
    monkeypatch.setattr(gpebo_cli.cli.workers, "end_children", lambda: None)

    def launch():
        child = subprocess.Popen(["true"])
        time.sleep(0.2)
        return child.wait()

    assert apart(launch, patience=10.0) == 0


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent(tmp_path, how):
    if reason := why_not("joblib"):
        pytest.skip(reason)
    words = ["run", "-m", "time.horizon=range(2000,2100)", *FAST, "hydra/launcher=joblib"]
    with begin(*words, "hydra.launcher.n_jobs=2", "hydra.sweep.dir=s", cwd=tmp_path) as process:
        assert len(workers(process.pid)) > 0
        process.send_signal(how)
        # Workers and trackers hold these pipes: the end of both is the end of all of them.
        process.communicate(timeout=30)
    assert process.returncode == -how


def workers(parent):
    """Processes of joblib's that ``parent`` has started."""
    found = []
    deadline = time.monotonic() + 60
    while not found and time.monotonic() < deadline:
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                above = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if above == parent and b"popen_loky" in words:
                found.append(int(entry.name))
    return found


def test_a_launcher_that_is_not_installed_is_one_line_with_the_extra(tmp_path):
    if not why_not("ray"):
        pytest.skip("it is installed")
    done = gpebo(*WORDS, "hydra/launcher=ray", cwd=tmp_path)
    assert_refused(done, "pip install 'gpebo[ray]'")


@pytest.mark.parametrize("must", [True, False])
def test_a_worker_whose_starter_has_ended_before_it_is_followed_ends_where_it_must(must):
    ended = f"from gpebo_cli.cli.workers import follow; follow({2**31 - 1}, must={must})"
    done = python("-c", f"{ended}; import time; time.sleep({5.0 if must else 0.1})")
    assert done.returncode == must


BLOCKED = """
import signal
from joblib.externals.loky.backend import resource_tracker
from gpebo_cli.cli import workers

def launch():
    resource_tracker.ensure_running()
    return signal.pthread_sigmask(signal.SIG_BLOCK, ())

print(signal.SIGINT in workers.apart(launch))
"""


@pytest.mark.skipif(importlib.util.find_spec("joblib") is None, reason="needs joblib")
def test_workers_do_not_hear_ctrl_c_whatever_was_started_before_them():
    """Starting loky's tracker takes the signal's block away."""
    done = python("-c", BLOCKED)
    assert done.stdout == "True\n", done.stderr
