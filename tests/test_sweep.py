"""Sweeps: planned, recorded on disk, killed in the middle, resumed, compared."""

from __future__ import annotations

import io
import json
import os
import re
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from examples import gpebo
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hypothesis import example, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from plants import DECAYING
from processes import assert_refused, begin, printed, refused, rows_of, wait_for
from scipy.integrate import trapezoid

from gpebo_cli import run
from gpebo_cli.cli.arguments import logspace, parse, quoted
from gpebo_cli.cli.composition import _readable
from gpebo_cli.cli.progress import Progress
from gpebo_cli.cli.sweep import _launch, _overrides, _print_table, _raise_failures
from gpebo_cli.cli.sweep_progress import Watch, told
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.results import sweep_folder
from gpebo_cli.results.names import METRICS, SETTLED
from gpebo_cli.results.sweep_folder import JobRecord, Plan, read_plan, read_record, write_record

FAST = ["figures=none", "time.samples=51"]
SWEEP = ["run", "-m", "estimator.gamma=logspace(6,8,3)", "estimator=drem,ls_drem", *FAST]
posix = pytest.mark.skipif(os.name == "nt", reason="POSIX signals")


def rows(folder):
    return rows_of(folder / "results.csv")


def without_seconds(folder):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows(folder)]


def stamps(folder):
    return {path: path.stat().st_mtime_ns for path in folder.glob("*/result.json")}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    printed(gpebo(*SWEEP, "hydra.sweep.dir=sweep", cwd=folder))
    return folder / "sweep"


# What is run ----------------------------------------------------------------------------------


def test_logspace_is_one_job_for_each_value(uninterrupted):
    table = rows(uninterrupted)
    gains = [float(row["gamma"]) for row in table]
    assert gains[::2] == gains[1::2] == pytest.approx([1e6, 1e7, 1e8], rel=1e-15)
    assert [row["estimator"] for row in table] == ["drem", "ls_drem"] * 3
    assert [row["job"] for row in table] == [str(n) for n in range(6)]


def test_logspace_has_the_numbers_of_the_axis_of_one_run():
    from gpebo_cli.estimators import axis

    text = "logspace(-3, 7, 23)"
    assert [float(v) for v in logspace(text, "g").split(",")] == list(axis(text, "g"))
    assert logspace("1e6", "g") is None
    with pytest.raises(ConfigError, match="whole number"):
        logspace("logspace(0,1,2.5)", "estimator.gamma")


def test_logspace_is_a_sweep_with_m_but_not_where_it_is_quoted():
    assert parse(["-m", "g=logspace(0,1,2)"]).overrides == ("g=1,10",)
    assert parse(["-m", "g='logspace(0,1,2)'"]).overrides == ("g='logspace(0,1,2)'",)


@pytest.mark.parametrize("text", ["a", "it's", "a\\b", "a\\", "a\\'b", "a,b {c}=[d] $"])
def test_quoted_text_is_read_back_by_hydra(text):
    (override,) = OverridesParser.create().parse_overrides([f"key={quoted(text)}"])
    assert override.value() == text


FORMULAS = ["sin(t)", "max(0, sin(t))", "min(max(u, 0), -(1 + t))", "it's (new)", "2*t", "a b"]


@settings(deadline=None, max_examples=25)
@example([("2*t", False), ("a, b", True), ("it's (new)", False)])
@given(st.lists(st.tuples(st.sampled_from(FORMULAS), st.booleans()), min_size=2, max_size=4))
def test_formulas_are_swept_whether_or_not_each_of_them_is_quoted(values):
    word = ",".join(quoted(text) if within else text for text, within in values)
    parser = OverridesParser.create()
    swept = parser.parse_override(_readable(parser, f"key={word}", swept=True)).value()
    assert [getattr(one, "text", one) for one in swept.list] == [text for text, _ in values]


@pytest.mark.parametrize(("words", "keys", "count"), [
    (SWEEP, ["estimator.gamma", "estimator"], 6),
    (["run", "experiment=gain_multirun"], ["estimator", "estimator.gamma"], 10),  # of a recipe
    (["run", "-m", "estimator=glob(l*)"], ["estimator"], 3),  # least_squares, lion, ls_drem
])
def test_dry_run_lists_the_jobs_and_leaves_nothing(tmp_path, words, keys, count):
    head, *jobs, last = printed(gpebo(*words, "--dry-run", cwd=tmp_path)).splitlines()
    assert head.split()[: 1 + len(keys)] == ["job", *keys]
    assert (len(jobs), last) == (count, f"{count} jobs; nothing was run")
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize("word", ["--dry-run", "resume=.", "fail_fast=true"])
def test_words_of_a_sweep_are_refused_without_one(tmp_path, word):
    assert_refused(gpebo("run", word, *FAST, cwd=tmp_path), "is for a sweep; add -m")
    assert list(tmp_path.glob("outputs/runs/*")) == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["resume=nowhere"], "resume=nowhere: there is no such folder"),
        (["fail_fast=maybe"], "fail_fast: expected true or false"),
        (["hydra/sweeper=basic"], "has a sweeper of its own"),
        (["hydra.sweep.subdir=x"], "the folders of jobs are numbered"),
        (["estimator=drem,dremm"], "estimator=dremm: there is no such estimator"),
        (["estimator.gama=1,2"], "estimator.gama: no such key"),
        (["experiment=gain_sweep,gain_multirun"], "experiment=gain_multirun: a sweep is"),
        (["hydra/launcher=joblibb"], "there is no such hydra/launcher; known: basic"),
    ],
)
def test_wrong_words_are_one_line_before_anything_runs(tmp_path, words, expected):
    done = gpebo("run", "-m", "estimator.gamma=1e6,1e7", *words, *FAST, cwd=tmp_path)
    assert_refused(done, expected)
    assert not list(tmp_path.glob("outputs/sweeps/*/*"))


def test_figures_when_they_are_asked_for(tmp_path):
    words = ["time.samples=51", "estimator.gamma=1e8", "hydra.sweep.dir=sweep"]
    printed(gpebo("run", "-m", "figures=[regressor]", *words, cwd=tmp_path))
    assert [path.name for path in tmp_path.glob("sweep/0/figures/*")] == ["regressor.png"]


# Failures -------------------------------------------------------------------------------------


def test_what_a_launcher_refuses_is_no_launcher_that_gave_up(tmp_path):
    """Wrong words are the user's to change, and said as such."""
    def launch(batch, initial_job_idx):
        raise ConfigError(str(batch[initial_job_idx][0]))

    orders = OmegaConf.create({"max_batch_size": None, "fail_fast": False})
    with pytest.raises(ConfigError, match="n=1"):
        _launch([["n=1"]], [0], tmp_path, orders, SimpleNamespace(launch=launch), {})


def test_why_a_launcher_gave_up_is_one_line(tmp_path):
    def launch(batch, initial_job_idx):
        raise RuntimeError("a worker died.\n\nIts exit code")

    orders = OmegaConf.create({"max_batch_size": None, "fail_fast": False})
    found = _launch([["n=1"]], [0], tmp_path, orders, SimpleNamespace(launch=launch), {})
    assert found == "RuntimeError: a worker died. Its exit code"


@pytest.mark.parametrize(("word", "meant"), [("c d", "c d"), ("'c, d'", "c, d"), ("2*t", "2*t")])
def test_a_value_stands_in_tables_as_it_is_meant(word, meant):
    (override,) = OverridesParser.create().parse_overrides([f"title={word},e"])
    first = next(override.sweep_string_iterator())
    assert _overrides([f"title={first}"]) == {"title": meant}


def test_what_keeps_a_job_from_its_record_is_said_of_that_job(tmp_path):
    """A full disk for instance; of jobs that are done nothing is said."""
    returned = [JobReturn(_return_value=0, status=JobStatus.COMPLETED),
                JobReturn(_return_value=OSError("no\nspace"), status=JobStatus.FAILED)]
    orders, errors = OmegaConf.create({"max_batch_size": None, "fail_fast": False}), {}
    launcher = SimpleNamespace(launch=lambda batch, initial_job_idx: returned)
    assert _launch([["n=1"], ["n=2"]], [0, 1], tmp_path, orders, launcher, errors) == ""
    assert errors == {1: "OSError: no space"}


def test_fail_fast_stops_at_the_first_and_the_rest_can_be_run_later(tmp_path):
    words = ["run", "-m", "estimator.gamma=1e6,-1,1e8", "hydra.run.dir=one", *FAST]
    done = gpebo(*words, "hydra.sweep.dir=sweep", "fail_fast=true", cwd=tmp_path)
    assert done.returncode == 1
    assert "1 of 3 jobs failed: job 1: estimator.gamma" in done.stderr
    assert "1 job without a result (fail_fast); go on with resume=sweep" in done.stderr
    assert [row["status"] for row in rows(tmp_path / "sweep")] == ["done", "failed", "missing"]
    again = gpebo(*words, "hydra.sweep.dir=sweep", "resume=sweep", cwd=tmp_path)
    assert not (tmp_path / "outputs").exists()
    assert again.returncode == 1
    assert again.stderr.count("\n") == 1
    assert [row["status"] for row in rows(tmp_path / "sweep")] == ["done", "failed", "done"]


@pytest.mark.parametrize(
    ("words", "key", "expected"),
    [
        (SWEEP[2:], "hydra.sweep.dir", "has a sweep already; add resume="),
        (["estimator.gamma=1e6,1e7", "estimator=drem,ls_drem", *FAST], "resume",
         "has 6 jobs and this one 4"),
        ([*SWEEP[2:], "time.horizon=10"], "resume", "job 0 had time.horizon=None and has '10' now"),
    ],
)
def test_a_sweep_is_not_taken_for_another(tmp_path, uninterrupted, words, key, expected):
    done = gpebo("run", "-m", *words, f"{key}={uninterrupted}", cwd=tmp_path)
    assert_refused(done, expected)


def test_only_a_sweep_is_resumed(tmp_path):
    (tmp_path / "notes.txt").touch()
    done = gpebo(*SWEEP, "resume=.", cwd=tmp_path)
    assert_refused(done, "resume=.: there is no sweep.json in it")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("swept", [["plant=mine", "estimator.gamma=1,2"], ["plant=circuit,mine"]])
def test_a_plant_that_has_changed_is_not_mixed_with_the_old_one(tmp_path, swept):
    plant = tmp_path / "plant" / "mine.yaml"
    plant.parent.mkdir()
    plant.write_text(DECAYING)
    words = ["run", "-m", "--config-dir", ".", *swept, "time.horizon=1", *FAST]
    assert gpebo(*words, "hydra.sweep.dir=sweep", cwd=tmp_path).returncode == 0
    plant.write_text(DECAYING.replace("-1", "-2"))
    done = gpebo(*words, "resume=sweep", cwd=tmp_path)
    assert_refused(done, "a configuration file has changed")


@pytest.mark.parametrize("swept", [["estimator.gamma=1,2"], ["data.file=other.csv,rows.csv"]])
def test_a_recording_that_has_changed_is_not_mixed_with_the_old_one(tmp_path, swept):
    for name in ("rows.csv", "other.csv"):
        (tmp_path / name).write_text("t,V,y\n0,0,1\n0.5,0,1\n1,0,1\n")
    words = ["run", "-m", "data=csv", "data.file=rows.csv", *swept, *FAST, "hydra.sweep.dir=sweep"]
    gpebo(*words, cwd=tmp_path)
    assert gpebo(*words, "resume=sweep", "--dry-run", cwd=tmp_path).returncode == 0
    (tmp_path / "rows.csv").write_text("t,V,y\n0,0,1\n0.5,0,2\n1,0,1\n")
    assert_refused(gpebo(*words, "resume=sweep", cwd=tmp_path), "such as a recording")


# Interrupted and resumed ----------------------------------------------------------------------


@posix
@pytest.mark.parametrize(("pattern", "count"), [("sweep.json", 1), ("*/result.json", 3)])
def test_killed_and_resumed_is_as_if_nothing_had_happened(tmp_path, uninterrupted, pattern, count):
    sweep = tmp_path / "sweep"
    with begin(*SWEEP, "hydra.sweep.dir=sweep", cwd=tmp_path) as process:
        wait_for(sweep, pattern, count)
        process.kill()
    assert not (sweep / "results.csv").exists()
    before = stamps(sweep)
    listed = gpebo(*SWEEP, "resume=sweep", "--dry-run", cwd=tmp_path)
    assert f"6 jobs, {len(before)} of them done; nothing was run" in listed.stdout
    printed(gpebo(*SWEEP, "resume=sweep", cwd=tmp_path))
    after = stamps(sweep)
    assert {path: after[path] for path in before} == before, "a finished job is never run again"
    assert without_seconds(sweep) == without_seconds(uninterrupted)
    assert not list(sweep.glob("*/.*"))


@posix
def test_an_interruption_writes_the_table_and_says_where(tmp_path, uninterrupted):
    with begin(*SWEEP, "hydra.sweep.dir=sweep", cwd=tmp_path) as process:
        wait_for(tmp_path / "sweep", "*/result.json", 2)
        process.send_signal(signal.SIGINT)
        output, error = process.communicate(timeout=60)
    # `python -m` ends by the signal itself, which a shell shows as 130, too, if it arrived while
    # CPython executed a string (dataclasses do, when they are imported), handled or not.
    assert process.returncode in (130, -signal.SIGINT)
    assert error == "gpebo: error: interrupted\n"
    assert output.splitlines()[0] == "sweep/results.csv"
    statuses = [row["status"] for row in rows(tmp_path / "sweep")]
    assert statuses.count("done") >= 2
    assert set(statuses) == {"done", "missing"}
    assert gpebo(*SWEEP, "resume=sweep", cwd=tmp_path).returncode == 0
    assert without_seconds(tmp_path / "sweep") == without_seconds(uninterrupted)


def test_a_finished_sweep_resumes_to_itself(tmp_path, uninterrupted):
    before = stamps(uninterrupted), (uninterrupted / "results.csv").read_bytes()
    assert gpebo(*SWEEP, f"resume={uninterrupted}", cwd=tmp_path).returncode == 0
    assert (stamps(uninterrupted), (uninterrupted / "results.csv").read_bytes()) == before


# The files ------------------------------------------------------------------------------------


RECORD = '{"status": "done", "overrides": {"a": "1"}, "seconds": 1, "error": "", "cases": [%s]}'


@pytest.mark.parametrize("text", [
    "", "{", "[]", '{"status": "done"}', '{"status": "odd"}',
    *(RECORD % case for case in ('{"x": 1e999}', '{"x": NaN}', '{"x": "y"}', "1", '{"x": [1]}')),
])
def test_what_is_no_result_is_a_missing_job(tmp_path, text):
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "result.json").write_text(text)
    assert read_record(tmp_path, 0, {"a": "1"}).status == "missing"


def test_a_result_of_other_overrides_is_a_missing_job(tmp_path):
    (tmp_path / "0").mkdir()
    record = JobRecord(0, {"a": "1"}, "done", 0.5, "", [{"gamma": 1.0, "x": None}])
    write_record(tmp_path / "0", record)
    assert read_record(tmp_path, 0, {"a": "1"}) == record
    assert read_record(tmp_path, 0, {"a": "2"}).status == "missing"


def test_what_a_job_left_is_no_result_of_its_next_attempt(tmp_path):
    records = [JobRecord(k, {"a": "1"}, "done", 0.5, "", [{"gamma": 1.0}]) for k in (0, 1)]
    for record in records:
        folder = tmp_path / str(record.job)
        folder.mkdir()
        write_record(folder, record)
        for name in (".half.tmp", "kept.csv"):
            (folder / name).touch()
    (tmp_path / ".stop").touch()
    sweep_folder.clear(tmp_path, [1])
    assert [read_record(tmp_path, k, {"a": "1"}).status for k in (0, 1)] == ["done", "missing"]
    assert [path.name for path in (tmp_path / "1").iterdir()] == ["kept.csv"]
    assert not (tmp_path / ".stop").exists()


def test_a_plan_is_read_back(tmp_path):
    plan = Plan(({"a": "[1,2]", "b": "'ü'"}, {}), "0123")
    assert read_plan(tmp_path) is None
    plan.write(tmp_path)
    assert read_plan(tmp_path) == plan
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": 3}))
    with pytest.raises(ConfigError, match="not the plan of a sweep"):
        read_plan(tmp_path)


def test_what_stands_in_the_place_of_a_plan_is_refused(tmp_path):
    """A sweep would be begun over the jobs of another one."""
    (tmp_path / "sweep.json").mkdir()
    with pytest.raises(ConfigError, match=r"sweep\.json is not a regular file"):
        read_plan(tmp_path)


def test_the_table_has_a_row_for_every_job_and_case():
    records = [
        JobRecord(0, {"a": "1"}, "done", 0.5, "", [{"g": 1.0}, {"g": 2.0}]),
        JobRecord(1, {"a": "2"}, "failed", 0.25, "why"),
        JobRecord(2, {"a": "3"}, "missing"),
    ]
    assert sweep_folder.table(records) == [
        ["job", "a", "status", "case", "g", "seconds", "error"],
        ["0", "1", "done", "0", "1", "0.5", ""],
        ["0", "1", "done", "1", "2", "0.5", ""],
        ["1", "2", "failed", "", "", "0.25", "why"],
        ["2", "3", "missing", "", "", "", ""],
    ]


def test_on_a_terminal_a_table_fills_and_says_what_is_left(tmp_path, monkeypatch):
    from rich.console import Console

    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    console = Console(file=io.StringIO(), width=100, color_system=None)
    gains = ("1e6", "100000000.0", "1e9")  # the second one as Hydra tells of 1e8
    files = ("[/b]", "[a]", ":x:")  # which are markup to rich
    jobs = tuple({"estimator.gamma": gain, "plant": "circuit", "data.file": file}
                 for gain, file in zip(gains, files, strict=True))
    with Watch(tmp_path, Plan(jobs, "x"), [0, 1, 2]) as watch:
        for job, status in enumerate(("done", "failed")):
            (tmp_path / str(job)).mkdir()
            cases = [{"seconds_to_1pct_parameters": 5.25}] if status == "done" else []
            write_record(tmp_path / str(job), JobRecord(job, jobs[job], status, 0.5, "", cases))
        console.print(watch._look())
    said = console.file.getvalue()
    assert "2/3" in said
    assert "left:" in said
    assert re.search(r"0 +1e6 +\[/b\] +done +0\.5 +5\.25", said)
    assert re.search(r"1 +1e\+08 +\[a\] +failed +0\.5", said)
    assert "plant" not in said, "what is the same for all is left out"
    assert not Watch(tmp_path, Plan(jobs, "x"), [0], quiet=True)._terminal


@pytest.mark.parametrize(("cell", "shown"), [
    ("drem", "drem"), ("", ""), ("100000", "100000"), ("1000000", "1e+06"), ("0.123456", "0.1235"),
    ("sin(2.5*t)", "sin(2.5*t)"), ("1e8", "1e8"), ("100000000.0", "1e+08"),
])
def test_long_numbers_are_shown_with_four_digits(cell, shown):
    assert told(cell) == shown


def test_of_a_long_table_and_of_many_failures_the_first_ones_are_told(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    records = [
        JobRecord(k, {"a": str(k)}, "failed" if k < 7 else "done", 0.5, "why" * (k < 7))
        for k in range(25)
    ]
    for count, more in ((25, ["… 5 more"]), (21, ["… 1 more"]), (20, [])):
        _print_table(records[:count], tmp_path / "s", rows=True)
        head, *body = capsys.readouterr().out.splitlines()
        assert head.split() == ["job", "a", "status", "case", "seconds"]  # there are no metrics
        assert [line.split()[0] for line in body[:20]] == [str(k) for k in range(20)]
        ends = ["s/results.csv", f"{count} jobs, {count - 7} done, 7 failed"]
        assert body[20:] == [*more, *ends]
    failures = "; ".join(f"job {k}: why" for k in range(5))
    for count, more in ((7, "; and 2 more in results.csv"), (5, "")):
        with pytest.raises(GpeboError) as caught:
            _raise_failures([*records[:count], records[-1]], tmp_path / "s", "", stopped=False)
        assert str(caught.value) == f"{count} of {count + 1} jobs failed: {failures}{more}"
    with refused("the launcher gave up: it died", by=GpeboError):
        _raise_failures(records[7:], tmp_path / "s", "it died", stopped=False)
    _raise_failures(records[7:], tmp_path / "s", "", stopped=False)


def test_a_table_of_jobs_with_noise_leaves_out_what_is_chance_under_noise(tmp_path, capsys):
    case = {"gamma": 2.0, SETTLED: 3.0, **dict.fromkeys(METRICS, 0.5)}
    records = [JobRecord(k, {"a": str(k)}, "done", 0.5, "", cases=[case]) for k in range(2)]
    _print_table(records, tmp_path, rows=True)
    head = capsys.readouterr().out.split("\n", 1)[0].split()
    assert head[:-1] == ["job", "a", "status", "case", "gamma", SETTLED, *list(METRICS)[2:]]


def test_a_terminal_is_shown_stages_that_take_long_unless_they_are_printed(monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    for options, shown in (({}, True), ({"quiet": True}, False), ({"loud": True}, False)):
        with Progress(**options) as progress:
            assert progress._timer.is_alive() == shown


def test_a_bar_has_the_stage_that_is_under_way_and_how_much_of_it_is_done():
    class Part(str):
        __slots__ = ()
        share = 0.25

    with Progress(quiet=True) as progress:
        progress("simulate")
        progress._show()
        for stage, total, done in (("simulate", None, 0), ("observe", None, 0),
                                   (Part("observe"), 1.0, 0.25), ("estimate", None, 0)):
            if stage != "simulate":
                progress(stage)
            (task,) = progress._display.tasks
            assert (task.description, task.total, task.completed) == (stage, total, done)


def test_stages_are_told_with_their_seconds_and_how_far_they_are(capsys):
    told = []
    with Progress(loud=True) as progress:
        run(
            "circuit", gamma=list(range(1, 4001)), time={"horizon": 2},
            progress=lambda stage: (told.append(stage), progress(stage)),
        )
    shares = [stage.share for stage in told if hasattr(stage, "share")]
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] < 1
    lines = capsys.readouterr().err.splitlines()
    names = list(dict.fromkeys(map(str, told)))
    assert [line.split(" s  ")[1] for line in lines] == names


@pytest.mark.parametrize(("word", "out", "err"), [("-q", False, False), ("-v", True, True)])
def test_quiet_and_verbose(tmp_path, word, out, err):
    done = gpebo("run", word, "time.horizon=2", "figures=none", cwd=tmp_path)
    assert (done.returncode, bool(done.stdout), bool(done.stderr)) == (0, out, err)
    assert ("error estimates states" in done.stderr) == err
    words = ["run", "-m", word, "estimator.gamma=1,10", "hydra.sweep.dir=both", *FAST]
    done = gpebo(*words, cwd=tmp_path)
    assert (done.returncode, bool(done.stdout), bool(done.stderr)) == (0, out, err)
    both = gpebo("run", "-q", "-v", cwd=tmp_path)
    assert (both.returncode, both.stderr) == (2, "gpebo: error: -q and -v: one of them\n")


# gpebo compare --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compared(uninterrupted, tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    said = printed(gpebo(
        "compare", uninterrupted, "--csv", "all.csv", "--output", "drawn", cwd=folder
    ))
    return folder, said


def test_the_comparison_is_sorted_and_agrees_with_the_sweep(compared, uninterrupted):
    folder, output = compared
    head, *body = output.splitlines()
    assert head.split()[:3] == ["run", "estimator", "gamma"], "what is the same for all is left out"
    table = rows_of(folder / "all.csv")
    times = [float(row["seconds_to_1pct_parameters"]) for row in table]
    assert times == sorted(times)
    assert len(table) == 6
    assert [line.split()[0] for line in body[:6]] == [row["run"] for row in table]
    by_job = {row["job"]: row for row in rows(uninterrupted)}
    for row in table:
        job = by_job[row["run"].rpartition("/")[2]]
        names = ("estimator", "gamma", "final_error_states", "rms_error_states")
        assert [row[name] for name in names] == [job[name] for name in names]


def test_the_comparison_draws_errors_and_metrics_over_the_gain(compared):
    folder, output = compared
    drawn = sorted(path.name for path in (folder / "drawn").iterdir())
    assert drawn == ["errors.png", "over_gamma.png"]
    assert [line for line in output.splitlines() if line.endswith(".png")] == [
        f"drawn/{name}" for name in drawn
    ]


def test_a_folder_of_runs_and_sweeps_stands_for_all_of_them(compared, uninterrupted, tmp_path):
    _, direct = compared
    (tmp_path / "all").mkdir()
    (tmp_path / "all" / "sweep").symlink_to(uninterrupted)
    (tmp_path / "all" / "other").mkdir()
    said = printed(gpebo("compare", "all", "--no-figures", cwd=tmp_path))
    assert len(said.splitlines()) == 1 + len(rows(uninterrupted)), direct


def test_runs_and_their_cases_are_compared_with_a_heat_map_of_two_gains(tmp_path):
    words = ["estimator=ls_drem", "estimator.gamma=[1,10,100]", "estimator.f0=[1e-6,1e-4]", *FAST]
    assert gpebo("run", *words, "hydra.run.dir=a", cwd=tmp_path).returncode == 0
    assert gpebo("run", "estimator=drem", *FAST, "hydra.run.dir=b", cwd=tmp_path).returncode == 0
    words = ["compare", "a", "b", "--sort", "rms_error_states", "--reverse", "--output=drawn"]
    said = printed(gpebo(*words, cwd=tmp_path))
    names = {path.stem for path in (tmp_path / "drawn").iterdir()}
    assert names == {"errors", "over_gamma", "rms_error_states_over_f0_and_gamma"}
    table = [line.split() for line in said.splitlines() if line.lstrip()[0] in "ab"]
    values = [float(cells[-1]) for cells in table]
    assert len(values) == 7
    assert values == sorted(values, reverse=True)


def test_a_curve_does_not_join_runs_that_differ_in_what_they_do_not_tell():
    from gpebo_cli.results.comparison import _is_axis, metric_panels
    from gpebo_cli.results.finished import METRICS, Case

    def case(run, gain, error):
        metrics = dict.fromkeys(METRICS, error)
        return Case(run, Path(run), 0, {"plant": "p", "gamma": gain}, metrics)

    quiet = [case(f"quiet/{k}", 10.0**k, 1e-9) for k in (1, 0, 2)]
    (first, *_) = metric_panels([*quiet, case("noisy", 10.0, 1e-2)], "gamma")
    assert [(curve.label, curve.y.tolist()) for curve in first.curves] == [("quiet", [1e-9] * 3)]
    assert first.curves[0].x.tolist() == [1.0, 10.0, 100.0]
    assert first.curves[0].style.dots  # where runs are
    again = replace(quiet[0], run="again/1", chosen={"gamma": 10.0, "plant": "p"})
    (first, *_) = metric_panels([*quiet, again], "gamma")
    assert [curve.label for curve in first.curves] == ["quiet"]  # one run's own curve
    two = [replace(c, chosen=c.chosen | {"estimator": name})
           for name in ("drem", "mre") for c in quiet]
    panels = metric_panels(two, "gamma")
    assert [panel.legend for panel in panels] == [True, *[False] * (len(METRICS) - 1)]
    assert [curve.label for curve in panels[0].curves] == ["drem", "mre"]
    assert [_is_axis([*quiet, case("a", g, 1.0)], "gamma") for g in (0.5, 0.0)] == [True, False]
    assert _is_axis([*quiet, Case("b", Path("b"), 0, {"plant": "p"}, {})], "gamma")


def test_a_label_is_the_shortest_one_that_tells_a_case_from_the_others():
    from gpebo_cli.results.comparison import _labels
    from gpebo_cli.results.finished import Case

    def labels(*of):
        cases = [Case(run, Path(run), 0, {"estimator": name, "gamma": gain}, {})
                 for run, name, gain in of]
        return _labels(cases, cases[1:])

    assert labels(("a", "drem", 1.0), ("a", "drem", 10.0)) == ["γ = 10"]
    assert labels(("a", "drem", 1.0), ("a", "mre", 10.0)) == ["mre, γ = 10"]
    assert labels(("a", "drem", 1.0), ("b", "drem", 10.0)) == ["γ = 10"]
    assert labels(("a", "drem", 1.0), ("b", "drem", 1.0)) == ["b"]
    both = (("a", "drem", 1.0), ("b", "drem", 1.0), ("b", "drem", 10.0))
    assert labels(*both) == ["b, γ = 1", "b, γ = 10"]
    assert labels(*both[:2], ("c", "drem", 10.0)) == ["b", "c"]


def test_a_gain_that_only_some_cases_of_an_estimator_have_tells_them_apart():
    from gpebo_cli.results.comparison import varying
    from gpebo_cli.results.finished import Case

    def told(*chosen):
        every = ({"estimator": "drem", **one} for one in chosen)
        return varying([Case("a", Path("a"), 0, one, {}) for one in every])

    assert told({"gamma": 1.0}, {"gamma_a": 1.0, "gamma_b": 1.0}) == ["gamma", "gamma_a", "gamma_b"]
    assert told({"gamma": 1.0}, {"gamma": 1.0, "time.horizon": "3"}) == []
    assert told({"gamma": 1.0}, {"estimator": "ls_drem"}) == ["estimator"]


def test_a_map_has_each_case_in_its_place():
    import numpy as np

    from gpebo_cli.results.comparison import heat_grid
    from gpebo_cli.results.finished import Case

    def cases(*places):
        return [Case("r", Path("r"), 0, {"a": a, "b": b}, {"rms": 10 * a + b}) for a, b in places]

    x, y, values = heat_grid(cases((2, 5), (1, 4), (2, 4)), "a", "b", "rms")
    assert (x.tolist(), y.tolist()) == ([1, 2], [4, 5])
    np.testing.assert_array_equal(values, [[14, 24], [np.nan, 25]])
    assert heat_grid(cases((1, 4), (1, 5)), "a", "b", "rms") is None  # one column
    assert heat_grid(cases((1, 4), (2, 5)), "a", "b", "rms") is not None
    assert heat_grid(cases((1, 4), (2, 5), (3, 6)), "a", "b", "rms") is None  # a third of it
    assert heat_grid(cases((1, 4), (2, 5)), "a", "b", "other") is None


@pytest.mark.parametrize(("values", "told"), [
    ([[3, 4], [5, 12]], ["3", "6", "9", "12"]),
    ([[1, 2], [3, 1000]], ["1", "10", "1e+02", "1e+03"]),
    ([[0, 2], [3, 90]], ["0", "30", "60", "90"]), ([[1, 2], [3, 4]], ["1", "2", "3", "4"]),
])
def test_colours_of_a_map_are_logarithmic_over_more_than_a_decade(values, told):
    import numpy as np

    from gpebo_cli.results.comparison import _heat_map

    x = np.array([1.0, 10.0])
    figure = _heat_map(x, x, np.array(values, float), ("gamma", "f0", "rms_error_states"), "drem")
    assert [tick.get_text() for tick in figure.axes[1].get_yticklabels()] == told
    assert "drem" in figure.axes[0].get_title(loc="left")  # which runs they are
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("γ", "f₀")
    (image,), low, high = figure.axes[0].images, np.min(values), np.max(values)
    middle = np.sqrt(low * high) if high == 1000 else (low + high) / 2
    assert image.norm(middle) == pytest.approx(0.5)


def test_error_curves_are_those_of_the_run(tmp_path):
    import numpy as np
    import pandas as pd

    from gpebo_cli.results.comparison import error_panels
    from gpebo_cli.results.finished import read_errors, read_run

    words = ["run", "estimator.gamma=[1e6,1e8]", "plant=descriptor", "estimator=ls_drem", *FAST]
    assert gpebo(*words, "hydra.run.dir=a", cwd=tmp_path).returncode == 0
    cases = read_run("a", tmp_path / "a", {})
    assert [panel.note for panel in error_panels(cases)] == ["", ""], "none is left out"
    slow, fast = read_errors(cases)
    # At the start the estimates are zero: the error is η itself, (1.5, −0.8, −1, 1).
    assert slow.parameters[0] == fast.parameters[0] == pytest.approx(np.sqrt(1.5**2 + 0.64 + 2))
    assert slow.parameter_size == slow.parameters[0]
    x = pd.read_csv(tmp_path / "a" / "signals.csv")[["x1", "x2", "x3"]]
    estimates = pd.read_csv(tmp_path / "a" / "estimates.csv").query("case == 0")
    away = np.linalg.norm(estimates[[f"{i}_hat" for i in x]].to_numpy() - x.to_numpy(), axis=1)
    np.testing.assert_allclose(slow.states, away)
    away = estimates.to_numpy()[:, 2:6] - [1.5, -0.8, -1.0, 1.0]
    np.testing.assert_allclose(slow.parameters, np.linalg.norm(away, axis=1), rtol=1e-9)
    # The metric is of scaled states, the curves are not: their ratio is that of sizes of states.
    for case, curves in zip(cases, (slow, fast), strict=True):
        rms = np.sqrt(trapezoid(curves.states**2, curves.t) / 20.0)
        assert 0.1 * rms < case.metrics["rms_error_states"] < 10.0 * rms


def test_a_sweep_that_is_not_finished_is_compared_as_far_as_it_is(tmp_path, uninterrupted):
    import shutil

    shutil.copytree(uninterrupted, tmp_path / "part")
    (tmp_path / "part" / "3" / "result.json").unlink()
    done = gpebo("compare", "part", "--no-figures", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr == "part: 1 of 6 jobs are not done and left out\n"
    assert len(done.stdout.splitlines()) == 1 + 5
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "needs folders"),
        (["nowhere"], "nowhere: there is no such folder"),
        (["."], ".: neither a finished run (summary.json) nor a sweep (sweep.json)"),
        ([".", "--sort"], "--sort needs a column"),
        ([".", "--srt=x"], "did you mean --sort?"),
        (["SWEEP", "--sort", "rms_error"], "did you mean rms_error_states?"),
        (["SWEEP", "--columns", "run,gama"], "--columns gama: no such column"),
    ],
)
def test_wrong_words_of_compare_are_one_line(tmp_path, uninterrupted, words, expected):
    words = [str(uninterrupted) if word == "SWEEP" else word for word in words]
    assert_refused(gpebo("compare", *words, cwd=tmp_path), expected)


def test_a_comparison_has_the_columns_that_are_asked_for(uninterrupted, tmp_path):
    asked = "gamma,e0_il_hat,seconds_to_1pct_il"
    words = ["--columns", asked, "--csv", "some.csv", "--no-figures"]
    done = gpebo("compare", uninterrupted, *words, cwd=tmp_path)
    assert done.stdout.split("\n")[0].split() == asked.split(",")
    table = rows_of(tmp_path / "some.csv")
    assert list(table[0]) == asked.split(",")
    last = rows_of(uninterrupted / "0" / "estimates.csv")[-1]
    assert last["e0_il_hat"] in [row["e0_il_hat"] for row in table]


def test_a_folder_that_hydra_would_read_as_something_else_is_refused(tmp_path):
    folder = tmp_path / "${oc.env:HOME}"
    folder.mkdir()
    done = gpebo("run", "-m", "estimator.gamma=1,2", *FAST, "hydra.sweep.dir=s", cwd=folder)
    assert_refused(done, "${oc.env:HOME}/s: ${ in the path of a sweep")
    assert list(folder.iterdir()) == []


def test_where_jobs_run_is_no_part_of_the_table(tmp_path):
    """A sweep that began with one launcher config goes on with another, or none."""
    words = ["run", "-m", "estimator.gamma=1e6,1e8", *FAST]
    assert gpebo(*words, "launcher=basic", "hydra.sweep.dir=sweep", cwd=tmp_path).returncode == 0
    assert "launcher" not in rows(tmp_path / "sweep")[0]
    (tmp_path / "sweep" / "1" / "result.json").unlink()
    assert gpebo(*words, "resume=sweep", cwd=tmp_path).returncode == 0
    assert [row["status"] for row in rows(tmp_path / "sweep")] == ["done", "done"]


@pytest.mark.parametrize(("word", "shown"), [
    ("plant.inputs.V='3 + \\'t'", "3 + 't"),
    ('plant.inputs.V="sin(2*t)"', "sin(2*t)"),
    ('observer.xi_a0=["a b"]', '["a b"]'),
    ("estimator.gamma=1e8", "1e8"),
])
def test_a_formula_is_shown_as_it_was_written(word, shown):
    assert list(_overrides([word]).values()) == [shown]


def test_a_folder_from_a_stranger_cannot_bring_launchers(tmp_path):
    """A launcher's configuration names code to run."""
    (tmp_path / "launcher").mkdir()
    evil = tmp_path / "launcher" / "evil.yaml"
    evil.write_text("# @package hydra.launcher\n_target_: os.abort\n")
    done = gpebo("run", "-m", "--config-dir", ".", "launcher=evil", cwd=tmp_path)
    assert_refused(done, "there is no such launcher; known: basic")


def test_a_pipe_among_the_files_of_a_run_is_not_waited_for(tmp_path):
    assert gpebo("run", "figures=none", "hydra.run.dir=a", cwd=tmp_path).returncode == 0
    (tmp_path / "a" / "cases.csv").unlink()
    os.mkfifo(tmp_path / "a" / "cases.csv")
    done = gpebo("compare", "a", cwd=tmp_path)
    assert done.returncode != 0
    assert "a/cases.csv is not a regular file" in done.stderr
