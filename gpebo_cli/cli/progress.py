"""How far long work is, on stderr: stages of a run, recipes, with the time that is left."""

from __future__ import annotations

import sys
from threading import Timer
from time import monotonic
from typing import TYPE_CHECKING, Self

from gpebo_cli.cli import interrupts

if TYPE_CHECKING:
    from rich.progress import Progress as Display
    from rich.progress import ProgressColumn

_DELAY = 1.0  # seconds: what is quicker than this needs no progress


def display(*more: ProgressColumn) -> Display:
    """A bar on stderr that is gone at the end: what, how far, how long still."""
    from rich import console, progress

    return progress.Progress(
        progress.TextColumn("{task.description}"), progress.BarColumn(24), *more,
        progress.TimeElapsedColumn(), progress.TextColumn("left:"), progress.TimeRemainingColumn(),
        console=console.Console(stderr=True), transient=True, speed_estimate_period=3600.0,
    )


class Progress:
    """Stages of a run, if stderr is a terminal and the run takes more than a second.

    ``loud`` (-v) prints each stage when it has ended, with its seconds, on any stderr.
    """

    def __init__(self, *, quiet: bool = False, loud: bool = False) -> None:
        self._terminal = sys.stderr.isatty() and not quiet and not loud
        self._loud = loud
        self._stage = ""
        self._since = monotonic()
        self._timer = Timer(_DELAY, self._show)
        self._timer.daemon = True
        self._display: Display | None = None

    def __enter__(self) -> Self:
        if self._terminal:
            self._timer.start()  # says something even while a long first stage runs
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        self._ended()
        if self._display is not None:
            self._display.stop()

    def __call__(self, stage: str) -> None:
        """A stage begins or gets on, unless Ctrl-C was pressed in the meantime.

        Its ``share``, where it has one, is how much of it is done.
        """
        interrupts.check()
        share = float(getattr(stage, "share", 0.0))
        if stage != self._stage:
            self._ended()
            self._stage, self._since = str(stage), monotonic()
        if self._display is None:
            return
        if not share:
            for task in self._display.task_ids:
                self._display.remove_task(task)
            self._display.add_task(self._stage, total=None)
        self._display.update(self._display.task_ids[-1], total=1.0 if share else None,
                             completed=share)

    def _ended(self) -> None:
        if self._loud and self._stage:
            sys.stderr.write(f"{monotonic() - self._since:8.3f} s  {self._stage}\n")
            sys.stderr.flush()

    def _show(self) -> None:
        shown = display()
        shown.add_task(self._stage, total=None)
        shown.start()
        self._display = shown
