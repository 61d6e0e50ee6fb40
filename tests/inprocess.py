"""The command line inside this process: some 20 times as fast as a process of its own."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from subprocess import CompletedProcess

from gpebo_cli.cli.app import main


@contextlib.contextmanager
def inside(folder):
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def gpebo(*words, cwd) -> CompletedProcess[str]:
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    err = io.StringIO()
    arguments = sys.argv
    sys.argv = ["gpebo", *map(str, words)]
    try:
        with inside(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main()
    finally:
        sys.argv = arguments
    out.seek(0)
    return CompletedProcess(words, code, out.read(), err.getvalue())
