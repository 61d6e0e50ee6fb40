"""``gpebo run -m``: plan the jobs, hand them to a launcher, collect what they left on disk."""

from __future__ import annotations

import hashlib
import math
import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, RangeSweep
from hydra.core.utils import JobStatus
from omegaconf import DictConfig, OmegaConf

from gpebo_cli.cli import interrupts, workers
from gpebo_cli.cli.arguments import Arguments, quoted
from gpebo_cli.cli.hydra_errors import LIBRARY_ERRORS
from gpebo_cli.cli.job import destination, read_job, run_job
from gpebo_cli.cli.sweep_progress import Watch, told
from gpebo_cli.configs.locations import GROUPS
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.evidence.metrics import is_metric
from gpebo_cli.model.archive import ARCHIVE
from gpebo_cli.reading import open_regular
from gpebo_cli.results import sweep_folder
from gpebo_cli.results.files import csv_text, make_folder, write_text
from gpebo_cli.results.names import shown_metrics
from gpebo_cli.results.report import case_rows, columns
from gpebo_cli.results.sweep_folder import STOP, TABLE, JobRecord, Plan
from gpebo_cli.schema import counted, shown

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader
    from hydra.plugins.launcher import Launcher

_NAMED_FAILURES = 5  # in the last line; results.csv has all
_SHOWN_ROWS = 20
_MAX_JOBS = 100_000
_SUBDIR = "${hydra:job.num}"
_DESCRIPTIONS = "", "plant", "regression"  # folders of files that name others


def run_sweep_job(cfg: DictConfig, arguments: Arguments, starter: int) -> None:
    """Run one job and record what became of it, in whatever process this is.

    A job that fails is recorded and the next one runs; Hydra itself would stop at the first. If
    the process ``starter`` of the sweep is killed, this one ends, too.
    """
    workers.follow(starter)
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    stop = folder.parent / STOP
    if stop.exists():
        return
    start = perf_counter()
    cases: list[dict[str, float | None]] = []
    error = ""
    interrupts.check()
    try:
        job = read_job(cfg, arguments, draw=False)
        rows = case_rows(run_job(job, str(folder), quiet=True, loud=arguments.given.loud))
        cases = [{k: v if math.isfinite(v) else None for k, v in row.items()} for row in rows]
    except GpeboError as raised:
        error = str(raised)
    except Exception as raised:  # noqa: BLE001  the next job runs whatever became of this one
        interrupts.check()  # a library may have wrapped it
        error = f"internal error: {type(raised).__name__}: {raised}"
    make_folder(folder)
    record = JobRecord(
        job=int(folder.name),
        overrides=_overrides(hydra.overrides.task),
        status="failed" if error else "done",
        seconds=perf_counter() - start,
        error=" ".join(error.split()),
        cases=cases,
    )
    sweep_folder.write_record(folder, record)
    if error and hydra.sweeper.fail_fast:
        write_text(stop, f"{record.job}\n")


def run_sweep(
    jobs: Sequence[Sequence[str]], config: DictConfig, launcher: Launcher, loader: ConfigLoader
) -> None:
    """Run those of ``jobs`` that are not done, write ``results.csv``, print its beginning.

    A job is a list of overrides, its number is its place; ``hydra.sweeper`` of ``config``, from
    which all start, says where to go on and when to stop. The launcher runs
    :func:`run_sweep_job` somewhere and returns when all is done (ConfigError: a key of
    ``hydra.sweep`` that a sweep does not have, or a folder that it cannot have).
    """
    orders = config.hydra.sweeper
    if not jobs:
        raise ConfigError("a sweep of no jobs: a range is empty, or glob(…) finds no file")
    folder = Path(destination("hydra.sweep.dir", config.hydra.sweep.dir))
    if "${" in str(folder):  # Hydra would replace it in each job, and write elsewhere
        raise ConfigError(f"{folder}: ${{ in the path of a sweep; choose another hydra.sweep.dir")
    # Unresolved: Hydra numbers the folders of jobs, job by job.
    sweep = cast("dict[str, Any]", OmegaConf.to_container(config.hydra.sweep, resolve=False))
    if (given := sweep.get("subdir")) != _SUBDIR:
        raise ConfigError(
            f"hydra.sweep.subdir={given}: the folders of jobs are numbered, so that a sweep can be "
            "resumed; leave it away"
        )
    plan = Plan(tuple(map(_overrides, jobs)), _digest(_compositions(jobs, config, loader)))
    _check_folder(folder, plan, resume=orders.resume is not None)
    before = sweep_folder.read_records(folder, plan)
    waiting = [record.job for record in before if record.status != "done"]
    if orders.dry_run:
        _print_plan(before, resumed=orders.resume is not None)
        return

    make_folder(folder)
    plan.write(folder)
    sweep_folder.clear(folder, waiting)
    errors: dict[int, str] = {}
    trouble = ""
    finished = False
    try:
        with Watch(folder, plan, waiting, quiet=orders.quiet):
            trouble = _launch(jobs, waiting, folder, orders, launcher, errors)
        finished = True
    finally:  # also when it is interrupted: what is done is in the table
        records = [
            replace(r, error=errors.get(r.job, "no result")) if r.status == "missing" else r
            for r in sweep_folder.read_records(folder, plan)
        ]
        write_text(folder / TABLE, csv_text(sweep_folder.table(records)))
        if not orders.quiet:
            _print_table(records, folder, rows=finished)
    _raise_failures(records, folder, trouble, stopped=(folder / STOP).exists())


def check_number(overrides: Sequence[Override]) -> None:
    """Refuse more jobs than anybody can wait for, before there is a list of them (ConfigError)."""
    jobs = 1
    for override in overrides:
        swept = override.value()
        if isinstance(swept, RangeSweep):
            span = (swept.stop or 0) - (swept.start or 0)
            jobs *= max(1, math.ceil(span / swept.step))
        elif isinstance(swept, ChoiceSweep):
            jobs *= len(swept.list)
    if jobs > _MAX_JOBS:
        raise ConfigError(
            f"a sweep of {jobs} jobs; at most {_MAX_JOBS}: gains are an axis of one run, as in "
            "'estimator.gamma=logspace(1,9,1000)' without -m"
        )


def _launch(
    jobs: Sequence[Sequence[str]],
    waiting: Sequence[int],
    folder: Path,
    orders: DictConfig,
    launcher: Launcher,
    errors: dict[int, str],
) -> str:
    """Hand over the jobs that wait; the reason if the launcher gave up.

    Jobs say where they write, in full: other processes have other working directories, and the
    jobs of a resumed sweep are not numbered from 0.
    """
    from hydra._internal.core_plugins.basic_launcher import BasicLauncher

    one_by_one = isinstance(launcher, BasicLauncher)  # fail_fast can stop between any two
    size = 1 if one_by_one else orders.max_batch_size or len(jobs)
    where = f"hydra.sweep.dir={quoted(str(folder))}"
    # What Ray is told by variables: workers' output is in Ray's own logs, no usage report.
    os.environ.setdefault("RAY_LOG_TO_DRIVER", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    forks = type(launcher).__name__ == "JoblibLauncher"
    if forks:
        how = {"initializer": partial(workers.follow, must=True), "initargs": (os.getpid(),)}
        cast("Any", launcher).joblib |= how  # arguments of joblib.Parallel
    for first in range(0, len(waiting), size):
        numbers = waiting[first : first + size]
        batch = [[*jobs[n], where, f"hydra.sweep.subdir='{n}'"] for n in numbers]
        try:
            launch = partial(launcher.launch, batch, initial_job_idx=numbers[0])
            returned = workers.apart(launch) if forks else launch()
        except (*LIBRARY_ERRORS, GpeboError):
            raise
        except Exception as error:  # noqa: BLE001  a worker died, a cluster is out of reach
            return " ".join(f"{type(error).__name__}: {error}".split())
        for number, job in zip(numbers, returned, strict=False):
            if job.status == JobStatus.FAILED:  # a full disk for instance
                raised = job._return_value  # noqa: SLF001  asked for in public, Hydra prints it
                errors[number] = " ".join(f"{type(raised).__name__}: {raised}".split())
        if orders.fail_fast and (folder / STOP).exists():
            break
    return ""


def _overrides(job: Sequence[str]) -> dict[str, str]:
    """What a job is; where it runs is no part of it, so a sweep may be gone on with elsewhere."""
    pairs = (text.partition("=") for text in job)
    return {
        key.lstrip("+"): _unquoted(value) for key, _, value in pairs
        if key != "launcher" and not key.startswith("~")
    }


def _unquoted(value: str) -> str:
    """A text as it was meant, without what Hydra's grammar needs: quotes, a backslash at blanks."""
    if not value.startswith(("'", '"')) and "\\" not in value:
        return value
    parsed = OverridesParser.create().parse_override(f"value={value}").value()
    return parsed if isinstance(parsed, str) else value


def _digest(configs: Iterable[DictConfig]) -> str:
    """Digest of what the jobs are made of: a resumed sweep must not mix two versions of a plant.

    Recordings and other files that configurations name count by their content.
    """
    found = hashlib.sha256()
    for config in configs:
        places = [
            os.path.join(source.path, group)
            for source in config.hydra.runtime.config_sources for group in _DESCRIPTIONS
        ]
        content = cast("dict[str, Any]", OmegaConf.to_container(config, resolve=False))
        content.pop("hydra", None)
        found.update(OmegaConf.to_yaml(OmegaConf.create(content), sort_keys=True).encode())
        for file, place in product(_files(content), ["", *places]):
            # What cannot be read is refused by the jobs.
            with suppress(ConfigError), open_regular(os.path.join(place, file)) as stream:
                found.update(hashlib.sha256(stream.read()).digest())
    return found.hexdigest()[:16]


def _files(content: object) -> Iterator[str]:
    """What a configuration names: recordings, tables of inputs, archives of matrices."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            if key in ("file", ARCHIVE):
                named = value if isinstance(value, list) else [value]
                yield from (each for each in named if isinstance(each, str))
            else:
                yield from _files(value)


def _compositions(
    jobs: Sequence[Sequence[str]], config: DictConfig, loader: ConfigLoader
) -> Iterator[DictConfig]:
    """What all jobs share, and one job for each choice of files.

    Other values cannot make keys appear or vanish, and Hydra composes every job twice, which takes
    longer than most jobs (ConfigError, Hydra's errors: one cannot be composed).
    """
    yield config
    seen = set()
    for job in jobs:
        pairs = [text.partition("=") for text in job]
        kind = tuple(
            (key, value if key.lstrip("+~") in (*GROUPS, "data.file") or "/" in key else "")
            for key, _, value in pairs
        )
        if kind not in seen:
            seen.add(kind)
            composed = loader.load_sweep_config(config, list(job))
            if composed.hydra.sweeper.params != config.hydra.sweeper.params:
                name = composed.hydra.runtime.choices.experiment
                raise ConfigError(f"experiment={name}: a sweep is no job of another; run it alone")
            yield composed


def _check_folder(folder: Path, plan: Plan, *, resume: bool) -> None:
    """Refuse to mix two sweeps in one folder."""
    there = sweep_folder.read_plan(folder)
    name = os.path.relpath(folder)
    if there is None:
        # Killed before it had a plan, a sweep leaves a folder with nothing in it.
        if resume and any(not path.name.endswith(".tmp") for path in folder.iterdir()):
            raise ConfigError(f"resume={name}: there is no sweep.json in it; give a sweep's folder")
        return
    if not resume:
        raise ConfigError(
            f"{name} has a sweep already; add resume={name} to go on with it, or choose another "
            "hydra.sweep.dir"
        )
    if len(there.jobs) != len(plan.jobs):
        raise ConfigError(
            f"resume={name}: that sweep has {len(there.jobs)} jobs and this one {len(plan.jobs)}; "
            "give the command that began it"
        )
    for number, (old, new) in enumerate(zip(there.jobs, plan.jobs, strict=True)):
        if dict(old) != dict(new):
            key = next(k for k in {**old, **new} if old.get(k) != new.get(k))
            raise ConfigError(
                f"resume={name}: job {number} had {key}={shown(old.get(key))} and has "
                f"{shown(new.get(key))} now; give the command that began the sweep"
            )
    if there.configuration != plan.configuration:
        raise ConfigError(
            f"resume={name}: a configuration file has changed since that sweep began, or a file "
            "that it names, such as a recording; begin a new one"
        )


def _print_plan(records: Sequence[JobRecord], *, resumed: bool) -> None:
    keys = list(dict.fromkeys(k for record in records for k in record.overrides))
    state = {"done": "done", "failed": "again", "missing": "to run"}
    head = ["job", *keys, "state"][: len(keys) + 1 + resumed]
    rows = [
        [str(r.job), *(r.overrides.get(k, "") for k in keys), state[r.status]][: len(head)]
        for r in records
    ]
    done = sum(record.status == "done" for record in records)
    told = f", {done} of them done" if resumed else ""
    lines = [*columns([head, *rows]), f"{counted(len(records), 'job')}{told}; nothing was run"]
    sys.stdout.write("".join(f"{line}\n" for line in lines))


def _print_table(records: Sequence[JobRecord], folder: Path, *, rows: bool) -> None:
    """The table's beginning (without it when interrupted), where it is, and counts."""
    lines = []
    if rows:
        # Errors stand below.
        cells = [[told(cell) for cell in row[:-1]] for row in sweep_folder.table(records)]
        metrics = shown_metrics(case for record in records for case in record.cases or ())
        seen = [k for k, name in enumerate(cells[0]) if name in metrics or not is_metric(name)]
        lines += columns([[row[k] for k in seen] for row in cells[: _SHOWN_ROWS + 1]])
        if len(cells) > _SHOWN_ROWS + 1:
            lines.append(f"… {len(cells) - _SHOWN_ROWS - 1} more")
    count = Counter(record.status for record in records)
    lines.append(str(Path(os.path.relpath(folder)) / TABLE))
    missing = f", {count['missing']} missing" if count["missing"] else ""
    jobs = counted(len(records), "job")
    lines.append(f"{jobs}, {count['done']} done, {count['failed']} failed{missing}")
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()  # before what follows on stderr


def _raise_failures(
    records: Sequence[JobRecord], folder: Path, trouble: str, *, stopped: bool
) -> None:
    failed = [record for record in records if record.status == "failed"]
    missing = [record for record in records if record.status == "missing"]
    if not (failed or missing or trouble):
        return
    parts = []
    if failed:
        named = "; ".join(f"job {r.job}: {r.error}" for r in failed[:_NAMED_FAILURES])
        more = len(failed) - _NAMED_FAILURES
        tail = f"; and {more} more in {TABLE}" if more > 0 else ""
        parts.append(f"{len(failed)} of {counted(len(records), 'job')} failed: {named}{tail}")
    if trouble:
        parts.append(f"the launcher gave up: {trouble[:300]}")
    if missing:
        why = " (fail_fast)" if stopped else ""
        parts.append(
            f"{counted(len(missing), 'job')} without a result{why}; go on with "
            f"resume={os.path.relpath(folder)}"
        )
    raise GpeboError("; ".join(parts))
