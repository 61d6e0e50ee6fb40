"""Examples in texts, and a `gpebo` that starts at once to run them with.

A start of Python with NumPy, SciPy and Hydra takes longer than most examples. So one process
imports them and waits; the `gpebo` that :func:`environment` puts on the PATH hands its words,
folder and streams to it, and a fork of it is the command. Real starts are tested in test_cli.py
and test_wheel.py.
"""

from __future__ import annotations

import atexit
import os
import re
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import processes

ROOT = Path(__file__).parents[1]

_SERVER = """
import contextlib, json, os, signal, socket, sys, tempfile
import matplotlib.backends.backend_agg, matplotlib.figure, scipy.linalg, scipy.integrate
import hydra, pandas
import gpebo_cli.api.calls, gpebo_cli.cli.job, gpebo_cli.results.gallery, gpebo_cli.estimators
from gpebo_cli.cli.app import main

address = sys.argv[1]
# One run with figures: what it fills, such as Matplotlib's fonts and formulas, its forks have.
with (tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere,
      contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere)):
    sys.argv = ["gpebo", "run", "plant=circuit", f"hydra.run.dir={folder}"]
    main()

server = socket.socket(socket.AF_UNIX)
server.bind(address)
server.listen()
print("ready", flush=True)
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
while True:
    connection, _ = server.accept()
    if os.fork():
        connection.close()
        continue
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    server.close()
    message, streams, _, _ = socket.recv_fds(connection, 1 << 20, 3)
    folder, words = json.loads(message)
    for target, stream in enumerate(streams):
        os.dup2(stream, target)
    os.chdir(folder)
    sys.argv = ["gpebo", *words]
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    connection.sendall(bytes([code]))
    os._exit(code)
"""

_CLIENT = """\
#!{python} -SE
import json, os, socket, sys
client = socket.socket(socket.AF_UNIX)
client.connect({address!r})
message = json.dumps([os.getcwd(), sys.argv[1:]]).encode()
socket.send_fds(client, [message], [0, 1, 2])
sys.exit((client.recv(1) or b"\\xff")[0])
"""


@cache
def _bin_folder() -> str:
    """A folder with `gpebo` in it; the process behind it ends with this one."""
    folder = tempfile.TemporaryDirectory()
    address = str(Path(folder.name, "socket"))
    server = subprocess.Popen(
        [sys.executable, "-c", _SERVER, address], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL,
        env=processes.environment(OPENBLAS_NUM_THREADS="1"),
    )
    assert server.stdout is not None
    assert server.stdout.readline() == b"ready\n"

    def end() -> None:
        server.kill()
        server.wait()
        server.stdout.close()
        folder.cleanup()

    atexit.register(end)
    program = Path(folder.name, "gpebo")
    program.write_text(_CLIENT.format(python=sys.executable, address=address))
    program.chmod(0o755)
    return folder.name


def environment() -> dict[str, str]:
    """An environment in which ``gpebo`` and ``import gpebo_cli`` are this checkout's."""
    path = f"{_bin_folder()}{os.pathsep}{os.environ['PATH']}"
    return processes.environment(OPENBLAS_NUM_THREADS="1", PATH=path)


def gpebo(*words: object, cwd: Path, text: str = "") -> subprocess.CompletedProcess[str]:
    """One command with ``text`` as its standard input."""
    return subprocess.run(
        ["gpebo", *map(str, words)], cwd=cwd, env=environment(), capture_output=True, text=True,
        check=False, timeout=300, input=text,
    )


def assert_repeats(folder: Path, *names: str) -> None:
    """The run in a folder, once more from its configuration, gives the same bytes."""
    words = ("--config-dir", folder, "--config-name", "config", "hydra.run.dir=again")
    done = gpebo("run", *words, cwd=folder.parent)
    assert done.returncode == 0, done.stderr
    for name in names:
        assert (folder / name).read_bytes() == (folder.parent / "again" / name).read_bytes(), name


def shell(script: str, folder: Path) -> str:
    """Run a script as a user would type it; its output, both streams."""
    done = subprocess.run(
        ["bash", "-e", "-c", script], cwd=folder, env=environment(), capture_output=True,
        text=True, check=False, timeout=300, stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def python(source: str, folder: Path) -> str:
    """Run a Python block in a process of its own; what it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", source], cwd=folder, env=environment(),
        capture_output=True, text=True, check=False, timeout=300,
    )
    assert done.returncode == 0, f"{source}\n{done.stderr}"
    return done.stdout


def blocks(text: str, language: str) -> list[str]:
    """Fenced blocks of one language in a Markdown text."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands(help_text: str) -> list[str]:
    """The lines below ``examples:`` in a help text, without their comments."""
    found = re.search(r"^examples:\n((?:  .*\n)+)", help_text, re.MULTILINE)
    lines = [] if found is None else found[1].splitlines()
    return [line.partition(" # ")[0].strip() for line in lines]
