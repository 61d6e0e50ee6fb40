"""A line on a terminal while a sweep runs: how many jobs are done, failed and left, and how long.

The launcher is blocked until all jobs are done, and may run them elsewhere. So the folder is
looked at from a thread: the same for every launcher, and it shows what really is on disk.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Self

from gpebo_cli.cli.sweep_folder import RESULT, Plan, job_folder, read_record

_PERIOD = 0.5  # seconds between two looks
_BAR = 24  # characters


class Bar:
    """Shows the jobs in ``waiting`` on stderr, if that is a terminal."""

    def __init__(self, folder: Path, plan: Plan, waiting: Sequence[int]) -> None:
        self._folder = folder
        self._plan = plan
        self._before = len(plan.jobs) - len(waiting)
        self._waiting = list(waiting)
        self._failed = 0
        self._start = monotonic()
        self._end = Event()
        self._thread = Thread(target=self._watch, daemon=True)
        self._terminal = sys.stderr.isatty()

    def __enter__(self) -> Self:
        if self._terminal:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal:
            self._end.set()
            self._thread.join()
            sys.stderr.write("\r\x1b[K")  # what follows begins on a clean line
            sys.stderr.flush()

    def _watch(self) -> None:
        count = len(self._waiting)
        while True:
            self._look()
            ended = count - len(self._waiting)
            text = line(
                self._before + ended, len(self._plan.jobs), self._failed, ended,
                monotonic() - self._start,
            )
            width = shutil.get_terminal_size().columns - 1
            sys.stderr.write(f"\r{text[:width]}\x1b[K")
            sys.stderr.flush()
            if self._end.wait(_PERIOD):
                return

    def _look(self) -> None:
        left = []
        for number in self._waiting:
            if (job_folder(self._folder, number) / RESULT).exists():
                record = read_record(self._folder, number, self._plan.jobs[number])
                self._failed += record.status == "failed"
            else:
                left.append(number)
        self._waiting = left


def line(ended: int, total: int, failed: int, now: int, seconds: float) -> str:
    """The text of the bar.

    Args:
        ended: jobs with a result, those of earlier attempts included.
        total: jobs of the sweep.
        failed: how many failed in this attempt.
        now: how many ended in this attempt.
        seconds: how long this attempt has taken.
    """
    full = _BAR * ended // total if total else _BAR
    left = total - ended
    time = f", {_duration(seconds / now * left)} left" if now and left else ""
    failures = f", {failed} failed" if failed else ""
    return f"[{'#' * full}{'.' * (_BAR - full)}] {ended}/{total} jobs{failures}{time}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
