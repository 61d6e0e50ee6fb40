"""Ctrl-C, also where Python would lose it.

An exception raised by a signal handler inside a weak reference's callback or a ``__del__`` is
printed and dropped: Python's own import system has such callbacks. Then a run would go on as if
nothing had happened. So the signal is also remembered, and asked for between stages and jobs.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_received = threading.Event()


@contextmanager
def remembered() -> Iterator[None]:
    """Remember SIGINT while a command runs, and raise at its end what was lost until then.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    if threading.current_thread() is not threading.main_thread():  # only it may have handlers
        yield
        return
    _received.clear()
    handler, hook = signal.signal(signal.SIGINT, _remember), sys.unraisablehook
    sys.unraisablehook = _report_dropped
    try:
        yield
        check()
    finally:
        signal.signal(signal.SIGINT, handler)
        sys.unraisablehook = hook


def check() -> None:
    """Raise what was lost.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    if _received.is_set():
        raise KeyboardInterrupt


def _remember(_number: int, _frame: FrameType | None) -> None:
    _received.set()
    raise KeyboardInterrupt


def _report_dropped(unraisable: sys.UnraisableHookArgs) -> None:
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):  # that one is remembered
        sys.__unraisablehook__(unraisable)
