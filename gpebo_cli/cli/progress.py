"""Stages of a run on stderr, while it runs."""

from __future__ import annotations

import sys
from threading import Timer
from time import monotonic
from typing import Self

from gpebo_cli.cli import interrupts

_DELAY = 1.0  # seconds: what is quicker than this needs no progress


class Progress:
    """Stages of a run on stderr, if that is a terminal and the run takes more than a second."""

    def __init__(self, *, quiet: bool = False) -> None:
        self._terminal = sys.stderr.isatty() and not quiet
        self._stage = ""
        self._start = monotonic()
        self._timer = Timer(_DELAY, self._show)
        self._timer.daemon = True

    def __enter__(self) -> Self:
        if self._terminal:
            self._timer.start()  # says something even if the first stage takes for ever
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()

    def __call__(self, stage: str) -> None:
        """A stage begins, unless Ctrl-C was pressed in the last one."""
        interrupts.check()
        self._stage = stage
        if self._terminal and monotonic() - self._start > _DELAY:
            self._show()

    def _show(self) -> None:
        sys.stderr.write(f"{monotonic() - self._start:6.1f} s  {self._stage}\n")
        sys.stderr.flush()
