"""Ctrl-C, also where Python would lose it.

An exception raised by a signal handler inside a weak reference's callback or a ``__del__`` is
printed and dropped: Python's own import system has such callbacks. Then a run would go on as if
nothing had happened. So the signal is also remembered, and asked for between stages and jobs.
"""

from __future__ import annotations

import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # every command waits for what is imported here
    from types import FrameType


class Remembered:
    """While it is entered, SIGINT is remembered; at its end what was lost until then is raised."""

    received = False  # by the process as a whole, not by one object

    def __enter__(self) -> None:
        Remembered.received = False
        self._hook = sys.unraisablehook
        try:
            self._handler = signal.signal(signal.SIGINT, _remember)
        except ValueError:  # not the main thread, which alone may have handlers
            return
        sys.unraisablehook = _report_dropped

    def __exit__(self, kind: object, *_: object) -> None:
        sys.unraisablehook = self._hook
        if hasattr(self, "_handler"):
            signal.signal(signal.SIGINT, self._handler)
        lost, Remembered.received = Remembered.received, False  # it is not meant for later work
        if lost and kind is not KeyboardInterrupt:  # an import that it broke off is an ImportError
            raise KeyboardInterrupt


def check() -> None:
    """Raise what was lost (KeyboardInterrupt: Ctrl-C was pressed)."""
    if Remembered.received:
        raise KeyboardInterrupt


def _remember(_number: int, _frame: FrameType | None) -> None:
    Remembered.received = True
    raise KeyboardInterrupt


def _report_dropped(unraisable: sys.UnraisableHookArgs) -> None:
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):  # that one is remembered
        sys.__unraisablehook__(unraisable)
