"""``gpebo compare``: one table and a few figures over finished runs and sweeps."""

from __future__ import annotations

import csv
import io
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from gpebo_cli.cli.options import parse
from gpebo_cli.cli.sweep_folder import PLAN, JobRecord, job_folder, read_plan, read_records
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.results.report import columns
from gpebo_cli.schema import nearest

if TYPE_CHECKING:
    from gpebo_cli.results.comparison import Value
    from gpebo_cli.results.finished import Case

_VALUES = {
    "--sort": "a column", "--columns": "names of columns, a,b,c", "--csv": "a file",
    "--output": "a folder",
}
_SWITCHES = ("--reverse", "--no-figures")
_SHOWN_ROWS = 40


def main(words: list[str]) -> int:
    """Compare finished runs; the exit code.

    Raises:
        ConfigError: an unknown option or column, or a folder that is neither a run nor a sweep.
        GpeboError: there is nothing to compare, or a file cannot be read or written.
    """
    arguments = parse("compare", words, _VALUES, _SWITCHES)
    if arguments.help:
        from gpebo_cli.cli.usage import COMPARE_HELP

        sys.stdout.write(COMPARE_HELP)
        return 0
    if not arguments.words:
        raise ConfigError("gpebo compare needs folders of runs or sweeps; see gpebo compare --help")

    from gpebo_cli.results import comparison
    from gpebo_cli.results.files import make_folder, write_text
    from gpebo_cli.results.names import METRICS

    cases = [case for name in arguments.words for case in _cases(name)]
    if not cases:
        raise GpeboError("nothing to compare: no run in these folders has estimated anything")
    sort = arguments.values.get("--sort", comparison.SORT)
    known = comparison.names(cases)
    asked = [name.strip() for name in arguments.values.get("--columns", "").split(",")]
    asked = [name for name in asked if name]
    for option, name in (("--sort", sort), *(("--columns", name) for name in asked)):
        if name not in known:
            raise ConfigError(
                f"{option} {name}: no such column; known: {', '.join(known)}" + nearest(name, known)
            )
    cases = comparison.ordered(cases, sort, reverse="--reverse" in arguments.switches)
    rows = [comparison.row(case) for case in cases]

    several = [] if all(case.number == 0 for case in cases) else ["case"]
    seen = ["run", *several, *comparison.varying(cases), *METRICS]
    if sort not in seen:
        seen.insert(1, sort)
    seen, known = asked or seen, asked or known
    lines = columns([seen, *([_shown(row.get(n)) for n in seen] for row in rows[:_SHOWN_ROWS])])
    if len(rows) > _SHOWN_ROWS:
        lines.append(f"… {len(rows) - _SHOWN_ROWS} more; --csv FILE has all")
    sys.stdout.write("".join(f"{line}\n" for line in lines))

    if "--csv" in arguments.values:
        path = Path(arguments.values["--csv"])
        make_folder(path.parent)
        write_text(path, _csv([known, *([_exact(row.get(n)) for n in known] for row in rows)]))
        sys.stdout.write(f"{path}\n")
    if "--no-figures" not in arguments.switches:
        from gpebo_cli.results.style import save

        folder = Path(arguments.values.get("--output") or _new_folder())
        make_folder(folder)
        metric = sort if sort in METRICS else comparison.SORT
        for name, figure in comparison.figures(cases, metric):
            path = folder / f"{name}.png"
            save(figure, path)
            sys.stdout.write(f"{path}\n")
    return 0


def _cases(name: str) -> list[Case]:
    """All cases in a run's or a sweep's folder, or in all of those that a folder holds.

    Jobs that are not done are counted on stderr.
    """
    from gpebo_cli.results.finished import read_run

    cases = []
    for found in find(name):
        left_out = sum(record.status != "done" for record in found.records)
        if left_out:
            total = len(found.records)
            sys.stderr.write(
                f"{found.path}: {left_out} of {total} jobs are not done and left out\n"
            )
        cases += [case for run in found.runs for case in read_run(*run)]
    return cases


@dataclass(frozen=True)
class Found:
    """A run, or a sweep with the ``records`` of its jobs."""

    path: str  # as it was given
    label: str
    runs: list[tuple[str, Path, Mapping[str, str]]]  # name, folder, overrides; those that are done
    records: list[JobRecord] = field(default_factory=list)


def find(name: str) -> list[Found]:
    """What a folder is, or all that is in it.

    Raises:
        ConfigError: neither a run nor a sweep, and nothing of that kind in it.
    """
    from gpebo_cli.results.finished import is_run

    folder = Path(name)
    if not folder.is_dir():
        raise ConfigError(f"{name}: there is no such folder")
    label = os.path.relpath(folder)
    # The stamps in the names of our own folders say more than where these are.
    label = folder.absolute().name if label.startswith((".", "outputs")) else label
    if is_run(folder):
        return [Found(name, label, [(label, folder, {})])]
    plan = read_plan(folder)
    if plan is None:
        inside = [p for p in sorted(folder.iterdir()) if is_run(p) or (p / PLAN).is_file()]
        if not inside:
            raise ConfigError(
                f"{name}: neither a finished run (summary.json) nor a sweep (sweep.json), and "
                "nothing of that kind in it"
            )
        return [found for path in inside for found in find(str(path))]
    records = read_records(folder, plan)
    done = [
        (f"{label}/{r.job}", job_folder(folder, r.job), r.overrides)
        for r in records
        if r.status == "done"
    ]
    return [Found(name, label, done, records)]


def _new_folder() -> str:
    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S-%f")
    return os.path.join("outputs", "comparisons", stamp)


def _shown(value: Value | None) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.5g}"  # noqa: PLR0124  NaN: never
    return "" if value is None else value


def _exact(value: Value | None) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.17g}"  # noqa: PLR0124
    return "" if value is None else value


def _csv(rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
