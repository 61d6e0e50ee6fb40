"""Processes that a launcher starts here: they end with this one, and none is missed when it dies.

joblib's workers outlive a parent that is killed, and are told of Ctrl-C beside it. And joblib
notices a dead worker, unless it died in the middle of sending a result: then it waits for the rest
of the message for ever, and does not even collect its dead child. So joblib runs on a thread of its
own, and the main thread looks after both.
"""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing import resource_tracker
from pathlib import Path
from threading import Thread
from threading import enumerate as threads
from time import monotonic, sleep
from typing import TypeVar

T = TypeVar("T")

_PATIENCE = 8.0  # seconds; a launcher that is alive collects dead children at once
_INTERVAL = 0.5
_FAREWELL = 5.0  # seconds that a launcher has to notice that its workers are gone
_LAUNCHER = "gpebo launcher"  # name of the thread


def apart(launch: Callable[[], T], patience: float = _PATIENCE) -> T:
    """What ``launch`` returns, or raises; its processes do not hear Ctrl-C, only this thread does.

    Raises:
        ChildProcessError: a child has been dead and uncollected for longer than ``patience``.
        KeyboardInterrupt: Ctrl-C was pressed; the processes have been ended.
    """
    outcome: Future[T] = Future()

    def run() -> None:
        try:
            _start_trackers()
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it
            outcome.set_result(launch())
        except BaseException as error:  # noqa: BLE001  raised again below
            outcome.set_exception(error)

    thread = Thread(target=run, name=_LAUNCHER, daemon=True)
    thread.start()
    try:
        _wait(thread, patience)
    except BaseException:
        with warnings.catch_warnings(action="ignore"):  # of the launcher, about what is done here
            end_children()
            thread.join(_FAREWELL)
        raise
    return outcome.result()


def stranded() -> bool:
    """Whether a launcher still waits for a worker that is gone.

    Its own threads do, too, and Python would wait for these before it ends.
    """
    return any(thread.name == _LAUNCHER for thread in threads())


def _start_trackers() -> None:
    """Start the processes that clean up, now: whoever starts them no longer blocks SIGINT then."""
    resource_tracker.ensure_running()
    with suppress(ImportError):
        from joblib.externals.loky.backend import (  # type: ignore[import-untyped,unused-ignore]
            resource_tracker as of_loky,
        )

        of_loky.ensure_running()


def _wait(thread: Thread, patience: float) -> None:
    since: dict[int, float] = {}
    while thread.is_alive():
        thread.join(min(_INTERVAL, patience / 2))
        now = monotonic()
        since = {pid: since.get(pid, now) for pid in children("Z")}
        if any(now - first >= patience for first in since.values()):
            raise ChildProcessError("a worker died while it was sending a result")


def follow(starter: int, *, must: bool = False) -> None:
    """End this process as soon as ``starter``, which it descends from, has ended.

    One that it does not descend from is not followed, or, where it ``must``, has ended already.
    """

    def watch() -> None:
        while starter in ancestors():
            sleep(_INTERVAL)
        os._exit(1)

    if starter != os.getpid() and (must or starter in ancestors()):
        Thread(target=watch, daemon=True).start()


def ancestors() -> list[int]:
    """Parent of this process, its parent, and so on; where there is no ``/proc``, the first."""
    found = [os.getppid()]
    with suppress(OSError, ValueError):
        while found[-1] > 1:
            found.append(_status(found[-1])[1])
    return found


def children(states: str) -> list[int]:
    """Processes that this one has started and that are in one of the states, as in ``/proc``."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            state, parent = _status(int(entry.name))
        except (OSError, ValueError):  # gone in between
            continue
        if parent == os.getpid() and state in states:
            found.append(int(entry.name))
    return found


def _status(pid: int) -> tuple[str, int]:
    """State and parent of a process."""
    text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    state, parent = text.rpartition(")")[2].split()[:2]
    return state, int(parent)


def end_children() -> None:
    """Ask all living children to end."""
    for pid in children("RSDT"):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
