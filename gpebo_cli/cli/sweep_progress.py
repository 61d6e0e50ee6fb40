"""A table on a terminal that fills while a sweep runs, and how long the rest will take.

The launcher is blocked until all jobs are done, and may run them elsewhere. So the folder is
looked at from a thread: the same for every launcher, and it shows what really is on disk.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

from gpebo_cli.cli.progress import display
from gpebo_cli.results.names import shown_metrics
from gpebo_cli.results.sweep_folder import RESULT, JobRecord, Plan, read_record

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

_LOOKS = 2.0  # a second
_ROWS = 12  # of jobs that ended last


class Watch:
    """Shows the jobs in ``waiting`` on stderr, if that is a terminal and nobody wants silence."""

    def __init__(
        self, folder: Path, plan: Plan, waiting: Sequence[int], *, quiet: bool = False
    ) -> None:
        self._folder, self._plan = folder, plan
        self._waiting = list(waiting)
        keys = dict.fromkeys(key for job in plan.jobs for key in job)
        self._varying = [k for k in keys if len({job.get(k) for job in plan.jobs}) > 1]
        self._ended: list[JobRecord] = []
        self._terminal = sys.stderr.isatty() and not quiet

    def __enter__(self) -> Self:
        if self._terminal:
            from rich.live import Live
            from rich.progress import MofNCompleteColumn

            self._bar = display(MofNCompleteColumn())
            count = len(self._plan.jobs)
            self._task = self._bar.add_task(
                "jobs", total=count, completed=count - len(self._waiting)
            )
            self._live = Live(
                get_renderable=self._look, console=self._bar.console, transient=True,
                refresh_per_second=_LOOKS,
            )
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal:
            self._live.stop()

    def _look(self) -> RenderableType:
        from rich.console import Group

        there = [n for n in self._waiting if (self._folder / str(n) / RESULT).exists()]
        self._ended += [read_record(self._folder, n, self._plan.jobs[n]) for n in there]
        self._waiting = [number for number in self._waiting if number not in there]
        self._bar.update(self._task, completed=len(self._plan.jobs) - len(self._waiting))
        return Group(table(self._ended, self._varying), self._bar)


def table(ended: Sequence[JobRecord], keys: Sequence[str]) -> Table:
    """The jobs that ended last: what varies, how long they took, how the first case went."""
    from rich.table import Table
    from rich.text import Text

    words = shown_metrics(record.cases[0] for record in ended if record.cases)
    shown = (next(iter(words)), "final_error_states")
    headings = (f"{words[shown[0]]} (s)", words[shown[1]])
    found = Table("job", *keys, "status", "seconds", *headings, box=None)
    for record in ended[-_ROWS:]:
        first = (record.cases or [{}])[0]
        numbers = [record.seconds, *(first.get(name) for name in shown)]
        found.add_row(
            str(record.job), *(Text(told(record.overrides.get(key, ""))) for key in keys),
            record.status,  # a bare text would have its brackets read as markup
            *("" if number is None else f"{number:.4g}" for number in numbers),
            style="red" if record.status == "failed" else None,
        )
    return found


def told(cell: str) -> str:
    """A cell of a table for a person: long numbers with four digits."""
    try:
        return f"{float(cell):.4g}" if "." in cell or len(cell) > 6 else cell
    except ValueError:
        return cell
