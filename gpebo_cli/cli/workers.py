"""Workers that died without their launcher noticing.

joblib notices a dead worker, unless it died in the middle of sending a result: then it waits for
the rest of the message for ever, and does not even collect its dead child. A child that nobody
collects for several seconds is that case. The sweep must end with its table all the same.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Self

_PATIENCE = 8.0  # seconds; a launcher that is alive collects dead children at once
_INTERVAL = 1.0


class Watch:
    """While it is entered, calls ``give_up`` if a child has been dead and uncollected for long.

    ``give_up`` is called on a thread, with the reason; the main thread is stuck and cannot be
    interrupted, so it should leave what is to be left and end the process. Where there is no
    ``/proc``, nothing is watched.
    """

    def __init__(self, give_up: Callable[[str], None], patience: float = _PATIENCE) -> None:
        self._give_up = give_up
        self._patience = patience
        self._done = Event()
        self._thread = Thread(target=self._look, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()

    def _look(self) -> None:
        since: dict[int, float] = {}
        while not self._done.wait(min(_INTERVAL, self._patience / 2)):
            now = monotonic()
            since = {pid: since.get(pid, now) for pid in children("Z")}
            if any(now - first >= self._patience for first in since.values()):
                self._give_up("a worker died while it was sending a result")
                return


def children(states: str) -> list[int]:
    """Processes that this one has started and that are in one of the states, as in ``/proc``."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = entry.read_text().rpartition(")")[2].split()[:2]
        except (OSError, ValueError):  # gone in between
            continue
        if int(parent) == os.getpid() and state in states:
            found.append(int(entry.parent.name))
    return found


def end_children() -> None:
    """Ask all living children to end."""
    for pid in children("RSDT"):
        try:
            os.kill(pid, signal.SIGTERM)
        except ProcessLookupError:
            continue
