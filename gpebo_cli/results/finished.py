"""Runs that are done, read back from their folders: cases with gains and metrics, error curves."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.evidence.metrics import NAMES as METRICS
from gpebo_cli.evidence.metrics import is_metric
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.reading import read_bytes, strict_json
from gpebo_cli.results.sweep_folder import PLAN, JobRecord, read_plan, read_records
from gpebo_cli.schema import shown

_NUMBER = re.compile(r"-?(?:[0-9]+(?:\.[0-9]+)?(?:e[+-]?[0-9]+)?)")
INITIAL = "e0_"  # of the names of parameters that stand for an initial state
_MOST_BYTES = 200_000_000  # of a file; as cells they take eight times as many


@dataclass(frozen=True)
class Case:
    """One case of a finished run: where it is, what was chosen, how it went."""

    run: str  # the folder, as a person named it
    folder: Path
    number: int  # of the case in that folder
    chosen: Mapping[str, str | float]  # plant, estimator, overrides, gains
    metrics: Mapping[str, float]  # METRICS first, NaN: never; NAME_hat and NAME_std at the end


@dataclass(frozen=True)
class ErrorCurves:
    """Norms of the errors of one case, (M,) each, and the size of what they are errors of."""

    t: Array
    parameters: Array  # (M,), empty where nothing is known
    states: Array  # (M,)
    parameter_size: float
    state_size: float

    @classmethod
    def of(cls, t: Array, of_eta: Array, of_x: Array, eta: Array, x: Array) -> ErrorCurves:
        """Of errors (M, p) and (M, n) at the times t (M,), with true values (…, p) and (…, n).

        Where there are no columns, nothing is known.
        """
        norms = [
            np.linalg.norm(errors, axis=1) if errors.shape[1] else np.zeros(0)
            for errors in (of_eta, of_x)
        ]
        return cls(t, norms[0], norms[1], largest(eta), largest(x))


def largest(values: Array) -> float:
    """The largest norm over time of values (N, c)."""
    return float(np.linalg.norm(values, axis=1).max(initial=0.0))


def rows_at(times: Array, t: Array) -> IntArray:
    """Which of the times (N,) those of estimates t (M,) are, whatever the last digits say."""
    return np.searchsorted(0.5 * (times[1:] + times[:-1]), t)


@dataclass(frozen=True)
class Found:
    """A run, or a sweep with the ``records`` of its jobs."""

    path: str  # as it was given
    label: str
    runs: list[tuple[str, Path, Mapping[str, str]]]  # name, folder, overrides; those that are done
    records: list[JobRecord] = field(default_factory=list)

    @property
    def cases(self) -> list[Case]:
        """All cases of the runs."""
        return [case for run in self.runs for case in read_run(*run)]


def find(name: str) -> list[Found]:
    """What a folder is, or all that is in it (ConfigError)."""
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
        (f"{label}/{r.job}", folder / str(r.job), r.overrides)
        for r in records
        if r.status == "done"
    ]
    return [Found(name, label, done, records)]


def is_run(folder: Path) -> bool:
    """Whether ``folder`` is one that a run has completed."""
    return (folder / "summary.json").is_file()


def read_run(run: str, folder: Path, overrides: Mapping[str, str]) -> list[Case]:
    """All cases of a finished run; none if it had no estimator.

    ``overrides`` distinguish it from others, where that is known (a job of a sweep).
    """
    summary = read_summary(folder)
    if not (estimator := _mapping(summary, "estimator")):
        return []
    chosen = {"plant": str(summary.get("plant")), "estimator": str(estimator.get("name"))}
    columns = read_columns(folder / "cases.csv", "case", present=METRICS)
    gains = [name for name in columns if name != "case" and not is_metric(name)]
    metrics = dict.fromkeys((*METRICS, *filter(is_metric, columns)))
    # estimator.gamma=… is in the table already, as the gain.
    told = {k: v for k, v in overrides.items() if k.removeprefix("estimator.") not in gains}
    return [
        Case(
            run, folder, int(number),
            {**chosen, **told, **{name: float(columns[name][i]) for name in gains}},
            {name: float(columns[name][i]) for name in metrics}
            | _estimates(summary, int(number)),
        )
        for i, number in enumerate(columns["case"])
    ]


def _estimates(summary: Mapping[str, Any], case: int) -> dict[str, float]:
    """What one case estimated at the end, and its deviation where that is known."""
    told = _mapping(summary, "estimates")
    told = _mapping(told, str(case)) if all(name.isdigit() for name in told) else told
    found = {}
    for name, one in told.items():
        for suffix, key in (("_hat", "value"), ("_std", "std")):
            if isinstance(one, Mapping) and isinstance(one.get(key), int | float):
                found[name + suffix] = float(one[key])
    return found


def _mapping(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = content.get(key)
    return found if isinstance(found, Mapping) else {}


def span(folder: Path) -> tuple[float, float]:
    """First and last time of a finished run's signals (GpeboError)."""
    path = folder / "signals.csv"
    try:
        names, first, *_, last = _bytes(path).splitlines()
        k = names.decode().split(",").index("t")
        return float(first.split(b",")[k]), float(last.split(b",")[k])
    except (ValueError, IndexError):
        raise GpeboError(f"{path}: not the signals of a run") from None


def read_errors(cases: Sequence[Case]) -> list[ErrorCurves]:
    """Error norms over time of ``cases``, each folder being read once."""
    read = cache(_read_errors)
    return [read(case.folder)(case.number) for case in cases]


def _read_errors(folder: Path) -> Callable[[int], ErrorCurves]:
    """What finds the error norms of a case, by its number."""
    truth = _mapping(read_summary(folder), "parameters")
    # Of a recording, not every true value is known.
    known = {name: float(v) for name, v in truth.items() if isinstance(v, int | float)}
    path = folder / "estimates.csv"
    everything = read_columns(path, "case", "t", present=[f"{name}_hat" for name in known])
    signals = read_columns(folder / "signals.csv", "t")
    if any(f"{name}_true" in everything for name in known):  # θ varies, and e0 makes up for it
        known = {name: value for name, value in known.items() if not name.startswith(INITIAL)}

    def of_case(number: int) -> ErrorCurves:
        """Its error norms (GpeboError: there is no such case)."""
        rows = everything["case"] == number
        if not rows.any():
            raise GpeboError(f"{path}: there is no case {number}")
        columns = {name: column[rows] for name, column in everything.items()}
        at = rows_at(signals["t"], columns["t"])
        hats = [name.removesuffix("_hat") for name in columns if name.endswith("_hat")]

        def table(found: Iterable[Array]) -> Array:
            return np.array([*found]).reshape(-1, len(at)).T

        # Parameters stand first; a state may have the name of one.
        states = [
            s for s in hats[len(truth) :]
            if s in signals and not np.isnan(columns[f"{s}_hat"]).all()
        ]
        x = table(signals[name][at] for name in states)
        of_eta = (columns[f"{k}_hat"] - columns.get(f"{k}_true", v) for k, v in known.items())
        return ErrorCurves.of(
            columns["t"], table(of_eta), table(columns[f"{s}_hat"] for s in states) - x,
            np.array([list(known.values())]), x,
        )

    return of_case


def read_summary(folder: Path) -> dict[str, Any]:
    """The content of ``summary.json`` (GpeboError: it is missing, or is none)."""
    path = folder / "summary.json"
    try:
        content = strict_json(_bytes(path))
    except (ValueError, RecursionError):
        raise GpeboError(f"{path}: not JSON") from None
    if not isinstance(content, dict):
        raise GpeboError(f"{path}: not the summary of a run")
    return content


def _bytes(path: Path) -> bytes:
    """The content of a regular file; a pipe under its name would be waited for."""
    try:
        return read_bytes(path, _MOST_BYTES)
    except ConfigError as error:  # no user wrote this file: a run should have
        raise GpeboError(str(error)) from error


def read_columns(path: Path, *filled: str, present: Sequence[str] = ()) -> dict[str, Array]:
    """A table of numbers that a run wrote, by column; NaN for an empty cell.

    Columns that are ``filled`` have a number in every row; those ``present`` may have gaps
    (GpeboError: they are missing, or it is not such a table; the line and the column are named).
    """
    try:
        content = _bytes(path)
        header, *rows = csv.reader(content.decode().splitlines())
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise GpeboError(f"{path}, line {line}: not UTF-8 text") from None
    except (csv.Error, ValueError):
        raise GpeboError(f"{path}: not a table with a header") from None
    for name in (*filled, *present):
        if name not in header:
            raise GpeboError(f"{path}, line 1: there is no column {name}")
    if not rows:
        raise GpeboError(f"{path}: there are no rows below its header")
    for line, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise GpeboError(f"{path}, line {line}: {len(row)} cells; the header has {len(header)}")
        for name, cell in zip(header, row, strict=True):
            if not _is_number(cell):
                where = f"{path}, line {line}, column {name}"
                raise GpeboError(f"{where}: {shown(cell)} is not a number")
    numbers = np.array([[float(cell or "nan") for cell in row] for row in rows])
    for name in filled:
        for gap in np.flatnonzero(~np.isfinite(numbers[:, header.index(name)])):
            raise GpeboError(f"{path}, line {gap + 2}, column {name}: there is no number")
    return dict(zip(header, numbers.T, strict=True))


def _is_number(cell: str) -> bool:
    """Whether a cell is as runs write them: ``%.17g`` of a number, of infinity, too, or nothing."""
    if not cell or cell.endswith("inf"):
        return cell in ("", "inf", "-inf")
    return _NUMBER.fullmatch(cell) is not None and isfinite(float(cell))  # 1e999 is not
