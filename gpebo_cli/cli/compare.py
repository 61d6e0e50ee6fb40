"""``gpebo compare``: one table and a few figures over finished runs and sweeps."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from gpebo_cli.cli.options import parse
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.results.report import columns
from gpebo_cli.schema import known_name

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
    """Compare finished runs; the exit code (ConfigError, GpeboError)."""
    arguments = parse("compare", words, _VALUES, _SWITCHES)
    if not arguments.words:
        raise ConfigError("gpebo compare needs folders of runs or sweeps; see gpebo compare --help")

    from gpebo_cli.results import comparison
    from gpebo_cli.results.files import cell, csv_text, make_folder, write_text
    from gpebo_cli.results.names import ranking, shown_metrics

    cases = [case for name in arguments.words for case in _cases(name)]
    if not cases:
        raise GpeboError("nothing to compare: no run in these folders has estimated anything")
    measured = [case.metrics for case in cases]
    metrics, best = shown_metrics(measured), ranking(measured)
    sort = arguments.values.get("--sort", best)
    known = comparison.names(cases)
    asked = [n.strip() for n in arguments.values.get("--columns", "").split(",") if n.strip()]
    for option, name in (("--sort", sort), *(("--columns", name) for name in asked)):
        known_name(name, known, f"{option} {name}: no such column")
    cases = comparison.ordered(cases, sort, reverse="--reverse" in arguments.switches)
    rows = [comparison.row(case) for case in cases]

    several = [] if all(case.number == 0 for case in cases) else ["case"]
    seen = ["run", *several, *comparison.varying(cases), *metrics]
    if sort not in seen:
        seen.insert(1, sort)
    seen, known = asked or seen, asked or known

    def cells(row: Mapping[str, Value], columns: Sequence[str], digits: int) -> list[str]:
        values = [row.get(name) for name in columns]
        return [value if isinstance(value, str) else cell(value, digits) for value in values]

    lines = columns([seen, *(cells(row, seen, 5) for row in rows[:_SHOWN_ROWS])])
    if len(rows) > _SHOWN_ROWS:
        lines.append(f"… {len(rows) - _SHOWN_ROWS} more; --csv FILE has all")
    sys.stdout.write("".join(f"{line}\n" for line in lines))

    if "--csv" in arguments.values:
        path = Path(arguments.values["--csv"])
        make_folder(path.parent)
        write_text(path, csv_text([known, *(cells(row, known, 17) for row in rows)]))
        sys.stdout.write(f"{path}\n")
    if "--no-figures" not in arguments.switches:
        from gpebo_cli.results.style import save

        stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S-%f")
        folder = Path(arguments.values.get("--output", f"outputs/comparisons/{stamp}"))
        make_folder(folder)
        for name, figure in comparison.figures(cases, sort if sort in metrics else best):
            path = folder / f"{name}.png"
            save(figure, path)
            sys.stdout.write(f"{path}\n")
    return 0


def _cases(name: str) -> list[Case]:
    """All cases in a run's or a sweep's folder, or in all of those that a folder holds.

    Jobs that are not done are counted on stderr.
    """
    from gpebo_cli.results.finished import find

    cases = []
    for found in find(name):
        left_out = sum(record.status != "done" for record in found.records)
        if left_out:
            jobs = f"{left_out} of {len(found.records)} jobs"
            sys.stderr.write(f"{found.path}: {jobs} are not done and left out\n")
        cases += found.cases
    return cases
