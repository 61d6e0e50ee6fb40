"""The folder of a sweep: its plan, a ``result.json`` for each job, and ``results.csv``.

    sweep.json          the plan: the overrides of every job, written before the first one starts
    <n>/result.json     what became of job n, written last, after everything else of the job
    results.csv         one row per job and case, made from the two above and from nothing else

Jobs may run in other processes, on other machines, and die with them. Only what is on disk
counts, so a sweep can be collected, and gone on with, whatever happened to whoever began it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from gpebo_cli.errors import ConfigError
from gpebo_cli.reading import open_regular, strict_json
from gpebo_cli.results.files import cell, remove_files, write_text
from gpebo_cli.schema import read

PLAN = "sweep.json"
RESULT = "result.json"
TABLE = "results.csv"
STOP = ".stop"  # with fail_fast=true: a job has failed, start no more

Overrides = Mapping[str, str]


@dataclass(frozen=True)
class JobRecord:
    """What became of one job: the content of its ``result.json``, or that there is none."""

    job: int
    overrides: Overrides
    status: Literal["done", "failed", "missing"]
    seconds: float | None = None
    error: str = ""
    cases: list[dict[str, float | None]] = field(default_factory=list)  # gains and metrics


@dataclass(frozen=True)
class Plan:
    """All jobs of a sweep, by number, and a digest of the configuration they share."""

    jobs: tuple[Overrides, ...]
    configuration: str

    def write(self, folder: Path) -> None:
        """Write ``sweep.json``."""
        # Every job on a line of its own: the file is for people, too.
        lines = ",\n  ".join(json.dumps(dict(job), ensure_ascii=False) for job in self.jobs)
        digest = json.dumps(self.configuration)
        write_text(folder / PLAN, f'{{"configuration": {digest}, "jobs": [\n  {lines}\n]}}\n')


def read_plan(folder: Path) -> Plan | None:
    """The plan in ``folder``, or None if there is none (ConfigError)."""
    try:
        with open_regular(folder / PLAN) as stream:
            text = stream.read()
    except ConfigError as error:
        if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
            return None
        raise
    try:
        content = strict_json(text)
        jobs = tuple({str(k): str(v) for k, v in job.items()} for job in content["jobs"])
        return Plan(jobs, str(content["configuration"]))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ConfigError(f"{folder / PLAN}: not the plan of a sweep of gpebo") from None


def write_record(folder: Path, record: JobRecord) -> None:
    """Write the ``result.json`` of a job to its own ``folder``."""
    text = json.dumps(asdict(record), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(folder / RESULT, text + "\n")


def read_record(folder: Path, number: int, overrides: Overrides) -> JobRecord:
    """What became of job ``number`` of the sweep in ``folder``.

    A file that is no result, or of other overrides, counts as none: the job is missing.
    """
    try:
        with open_regular(folder / str(number) / RESULT) as stream:
            record = read(JobRecord, strict_json(stream.read()), RESULT)
    except (ConfigError, OSError, ValueError, RecursionError):
        record = None
    if record is None or record.status == "missing" or record.overrides != dict(overrides):
        return JobRecord(number, overrides, "missing")
    return record


def read_records(folder: Path, plan: Plan) -> list[JobRecord]:
    """What became of every job of ``plan``, in its order."""
    return [read_record(folder, number, job) for number, job in enumerate(plan.jobs)]


def clear(folder: Path, numbers: Sequence[int]) -> None:
    """Remove what earlier attempts left of these jobs and would be taken for a new result."""
    remove_files([folder / STOP])
    for number in numbers:
        inside = folder / str(number)
        remove_files([inside / RESULT, *inside.glob(".*.tmp")])


def table(records: Sequence[JobRecord]) -> list[list[str]]:
    """Header and rows of ``results.csv``; a job that is not done has one row, and no case."""
    keys = list(dict.fromkeys(k for record in records for k in record.overrides))
    numbers = list(dict.fromkeys(k for r in records for case in r.cases for k in case))
    rows = [["job", *keys, "status", "case", *numbers, "seconds", "error"]]
    for record in records:
        for index, case in enumerate(record.cases or [{}]):
            rows.append([
                str(record.job),
                *(record.overrides.get(key, "") for key in keys),
                record.status,
                str(index) if record.cases else "",
                *(cell(case.get(name)) for name in numbers),
                "" if record.seconds is None else repr(record.seconds),
                record.error,
            ])
    return rows
