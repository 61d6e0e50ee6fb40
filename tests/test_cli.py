"""The command line as a user meets it: a process, its streams and its exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import examples
import inprocess
import pytest
import yaml
from plants import DECAYING
from processes import (
    ROOT,
    assert_refused,
    begin,
    environment,
    printed,
    process,
    python,
    refused,
    rows_of,
    wait_for,
)

from gpebo_cli import run
from gpebo_cli.cli.job import destination, remove_if_empty
from gpebo_cli.cli.listing import KINDS

FAST = ["figures=none", "time.samples=51"]

MINE = DECAYING + "title: a decaying state\nreference: nowhere\n"


def gpebo(*words, cwd, **more):
    """A process of its own where its environment is another one."""
    return process(*words, cwd=cwd, **more) if more else examples.gpebo(*words, cwd=cwd)


def folders(cwd, kind="runs"):
    return sorted((cwd / "outputs" / kind).glob("*"))


@pytest.fixture
def mine(tmp_path):
    folder = tmp_path / "mine"
    (folder / "plant").mkdir(parents=True)
    (folder / "plant" / "mine.yaml").write_text(MINE)
    return folder


# Help, list, version ------------------------------------------------------------------------


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_help(tmp_path, words):
    assert "gpebo run plant=circuit estimator=drem" in printed(gpebo(*words, cwd=tmp_path))


@pytest.mark.parametrize("words", [["--version"], ["-V"], ["version"], ["run", "--version"]])
def test_version(tmp_path, words):
    assert printed(gpebo(*words, cwd=tmp_path)).startswith("gpebo ")


def test_run_help_lists_every_choice(tmp_path):
    said = printed(gpebo("run", "--help", cwd=tmp_path))
    for group in ("plant", "observer", "estimator", "solver", "noise", "experiment"):
        for path in (ROOT / "conf" / group).glob("*.yaml"):
            assert path.stem in said


def test_run_help_names_the_real_defaults(tmp_path):
    defaults = yaml.safe_load((ROOT / "conf" / "gpebo.yaml").read_text())["defaults"]
    chosen = {k: v for entry in defaults if isinstance(entry, dict) for k, v in entry.items()}
    text = gpebo("run", "--help", cwd=tmp_path).stdout
    for group in ("plant", "observer", "estimator", "solver", "noise"):
        line = next(x for x in text.splitlines() if x.strip().startswith(f"{group}="))
        assert line.split("=", 1)[1].split()[0] == chosen[group]


HEAVY = ("numpy", "hydra", "omegaconf", "yaml", "argparse", "pathlib", "re", "dataclasses")


@pytest.mark.parametrize(("words", "heavy"), [
    *((["-S", "--", *words], HEAVY)  # without site-packages, whose own .pth files import things
      for words in (["--help"], ["run", "--help"], ["list"], ["--version"])),
    (["-S", "--", "__complete", "run", "plant="],
     ["numpy", "hydra", "omegaconf", "yaml", "pandas"]),
    (["--", "run", "--cfg", "job"], ["numpy"]),
    (["--", "run", *FAST], ["pandas", "sympy", "matplotlib"]),
])
def test_nothing_heavy_is_imported_for_nothing(tmp_path, words, heavy):
    script = (
        "import sys; sys.argv = ['gpebo', *sys.argv[1:]]; from gpebo_cli.cli.app import main; "
        f"main(); heavy = {{*{heavy}}} & set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    split = words.index("--")
    printed(python(*words[:split], "-c", script, *words[split + 1 :], cwd=tmp_path))


def test_list_names_and_titles(tmp_path, mine):
    said = printed(gpebo("list", cwd=tmp_path))
    words = ("plants", "circuit", "drem", "gpebo", "paper_circuit", "arXiv:2407", "published/sir")
    for word in words:
        assert word in said
    assert [line for line in said.splitlines() if line[:1].strip()] == list(KINDS)
    plants = gpebo("list", "plants", "--config-dir", mine, cwd=tmp_path)
    assert "mine" in plants.stdout
    assert "a decaying state [nowhere]" in plants.stdout
    assert "drem" not in plants.stdout
    assert not any(line.startswith(("plants", " ")) for line in plants.stdout.splitlines())


def test_every_file_of_a_group_has_a_title():
    for group in ("plant", "observer", "estimator", "solver", "noise", "experiment"):
        for path in (ROOT / "conf" / group).resolve().rglob("*.yaml"):
            assert yaml.safe_load(path.read_text())["title"], path


def test_a_folder_may_be_named_by_what_hydra_knows(tmp_path):
    for plant in ("circuit", "descriptor"):  # of this run, not of the one before
        words = f"plant={plant}", "observer=none", "hydra.run.dir=${hydra:runtime.choices.plant}"
        printed(gpebo("run", *words, *FAST, cwd=tmp_path))
        assert (tmp_path / plant / "summary.json").exists()


def test_a_title_or_a_result_cannot_command_the_terminal(tmp_path, mine):
    (mine / "plant" / "evil.yaml").write_text("title: a\x1b[31mb\n")
    assert r"a\x1b[31mb" in printed(gpebo("list", "plants", "--config-dir", mine, cwd=tmp_path))
    for name in ("one", "two"):
        printed(gpebo("run", *FAST, f"hydra.run.dir={name}", cwd=tmp_path))
    summary = tmp_path / "two" / "summary.json"
    summary.write_text(summary.read_text().replace('"plant": "', r'"plant": "\u001b[31m'))
    said = printed(gpebo("compare", "one", "two", "--no-figures", cwd=tmp_path))
    assert r"\x1b[31mcircuit" in said


# Errors: one line, its exit code, a suggestion ----------------------------------------------

WRONG = [
    (["rnu"], "unknown command 'rnu'; known: run, "),
    (["rnu"], "did you mean run?"),
    (["plant=circuit"], "did you mean `gpebo run plant=circuit`?"),
    (["list", "plans"], "did you mean plants?"),
    (["list", "--config-dir", "nowhere"], "--config-dir nowhere: there is no such folder"),
    (["run", "plant=circut"], "error: plant=circut: there is no such plant"),
    (["run", "plant=circut"], "did you mean circuit?"),
    (["run", "plant=nan"], "plant=nan: there is no such plant"),
    (["run", "estimator=1e3"], "estimator=1e3: there is no such estimator"),
    (["run", "plant=null"], "plant=null: there is no such plant"),
    (["run", "plant=1,circuit"], "plant=1,circuit: several values; add -m for a run for each"),
    (["run", "time.horizon=1,2"], "time.horizon=1,2: several values; add -m for a run for each"),
    (["run", "estimator.gamma=1,2"], "'estimator.gamma=[1,2]' for a list (a case for each gain"),
    (["run", "-m", "plant=1,circuit"], "plant=1: there is no such plant"),
    (["run", "experiment=paper"], "did you mean paper_circuit?"),
    (["run", "estimtor=drem"], "did you mean estimator?"),
    (["run", "estimator.gama=1"], "estimator.gama: no such key"),
    (["run", "estimator.gama=1"], "did you mean gamma?"),
    (["run", "+estimator.foo=1"], "estimator.foo: no such key"),
    (["run", "+plant.foo=1"], "unknown key 'foo'"),
    (["run", "plant.inputs={W: 0}"], "plant.inputs.W: no such key"),
    (["run", "data.decimal=x", "data.file=a.csv"], "data.decimal: expected '.' or ',', got 'x'"),
    (["run", "+foo=1"], "foo: no such key"),
    (["run", "+plant=circuit"], "plant is chosen twice"),
    (["run", "~plant"], "plant.name is missing"),
    (["run", "plant"], "'plant' is not key=value"),
    (["run", "plant=cir[cuit"], "cannot be read as key=value"),
    (["run", "estimator.gamma=1,2"], "write 'estimator.gamma=[1,2]'"),
    (["run", "estimator.gamma=-1"], "estimator.gamma"),
    (["run", "time.samples=1.5"], "time.samples: expected a whole number, got 1.5"),
    (["run", "time.samples=1"], "time.samples: expected 2 to"),
    (["run", "time.horizon=abc"], "time.horizon: expected a finite number, got 'abc'"),
    (["run", "time.horizon=-1"], "time.horizon: expected a positive number, got -1"),
    (["run", "time=3"], "time: expected a mapping"),
    (["run", "time.start=???"], "time.start has no value yet"),
    (["run", "time.start=${plant.name}"], "time.start: ${…} is not allowed"),
    (["run", "solver.tol=1e-30"], "solver.tol: expected 1e-15 to 0.1"),
    (["run", "observer.regression=papr"], "did you mean paper?"),
    (["run", "figures=regressor"], "did you mean figures=[regressor]?"),
    (["run", "figures=[nope]"], "nope"),
    (["run", "+output.figures=all"], "output.figures: no such key; did you mean figures?"),
    (["run", "figures.width=wide"], "figures.width: expected column or page"),
    (["run", "figures.formats=[]"], "some of png, pdf and svg, got an empty list"),
    (["run", "figures.dpi=9"], "figures.dpi: expected 30 to 1200"),
    (["run", "figures.fromats=[png]"], "figures.fromats: no such key; figures has formats, width"),
    (["run", "plant.title=${oc.env:HOME}"], "plant.title: ${…} is not allowed"),
    (["run", "--multrun"], "did you mean --multirun?"),
    (["run", "--multirun=3"], "--multirun takes no value"),
    (["run", "--cfg", "jb"], "--cfg needs one of job, hydra, all, got 'jb'"),
    (["run", "estimator=[gradient,drem]"], "for a run for each: -m estimator=gradient,drem"),
    (["run", "-m", "plant=[circuit, window]"], "for a run for each: -m plant=circuit,window"),
    (["run", "noise=gaussian", "noise.seeds=1000000"], "expected 1 to 10000, got 1000000"),
    (["run", "noise=gaussian", "noise.seeds=10000"], "have 2e+07 samples; at most 2e+06 are"),
    (["run", "noise=gaussian", "noise.sample_time=1e-4"], "take some 7.68 GB of memory; a run"),
    (["run", "estimator.gamma=logspace(1,9,1e5)", "time.samples=100000", "output.max_rows=1e12"],
     "100000 cases with 100000 samples each (output.max_rows) would take some 2.88e+03 GB"),
    (["run", "estimator.gamma=logspace(1,9,1e5)", "observer.sample_time=0.01"],
     "100000 cases at 2001 samples would take some 154 GB of memory; a run may take 2 GB"),
    (["run", "estimator=least_squares", "estimator.beta=logspace(-3,1,1e5)"],
     "100000 combinations of alpha, f0 and beta"),
    (["run", "estimator.f0=logspace(-3,1,1e5)"], "each with matrices of its own, would take some"),
    (["run", "estimator.gamma=logspace(1,9,1000001)"], "whole number of values up to 1000000"),
    (["run", "-m", "time.horizon=range(1,1000000000)"], "a sweep of 999999999 jobs; at most"),
    (["run", "-m", "time.horizon=range(0,1,1e-6)", "plant=window,circuit"], "of 2000000 jobs"),
    # Values are listed before it shows that there is nothing to combine them with.
    (["run", "-m", "time.start=range(2,1)", "time.horizon=range(1,1000000000)"], "of 999999999 jo"),
    (["run", "observer.xi_a0.foo=1"], "observer.xi_a0 has no keys; give it as a whole"),
    (["run", "time.samples.foo=1"], "time.samples has no keys; give it as a whole"),
    (["run", "hydra.job.env_set={X: 1}"], "no such key; '+hydra.job.env_set.X=VALUE' adds one"),
    (["run", "plant.states.foo=1"], "base 10: 'foo'; a choice is one name, a list is given"),
    (["run", "plant.title='a\udcff'"], "is not text in UTF-8"),
    (["run", "+launcher=null"], "cannot be composed: Config group override must be"),
    (["run", "noise.outputs=0.1"], "noise has name, title; choose noise=gaussian first"),
    (["run", "+launcher=[1,2]"], "cannot be composed: argument of type"),
    (["run", "time=1"], "time: expected a mapping"),
    (["run", "--resolve"], "--resolve is for what --cfg prints; add --cfg job"),
    (["run", "--cfg", "job", "-m"], "only one of --multirun, --cfg at a time"),
    (["run", "--config-dir"], "--config-dir needs a value"),
    (["run", "--config-dir", "nowhere"], "--config-dir nowhere: there is no such folder"),
    (["run", "--config-name", "gpbo"], "did you mean gpebo?"),
    (["run", "tank"], "see gpebo run --help"),
    (["run", "circuit"], "did you mean plant=circuit?"),
    (["check", "plant=circut"], "did you mean circuit?"),
    (["check", "drem"], "did you mean estimator=drem?"),
    (["run", "--plant=circuit"], "plant is written without dashes, as in plant=circuit"),
    (["run", "gamma=3"], "did you mean estimator.gamma?"),
    (["run", "horizon=3"], "did you mean time.horizon?"),
    (["run", "plant=plant/mine.yaml"], "write --config-dir . plant=mine"),
    (["check", "--jsn"], "see gpebo check --help; did you mean --json?"),
    (["check", "--version"], "gpebo check: '--version' is no option"),
    (["list", "--confg-dir", "."], "did you mean --config-dir?"),
    (["figures", "paper_circit"], "did you mean paper_circuit?"),
    (["compare", "--srot", "x"], "did you mean --sort?"),
    (["run", "launcher=jobli"], "did you mean joblib?"),
    (["run", "hydra.run.dir="], "hydra.run.dir is empty; give a folder"),
    (["run", "-m", "time.horizon=1,2", "hydra.sweep.dir="], "hydra.sweep.dir is empty; give a"),
    (["run", "-m", "time.horizon=1,2", "hydra.run.dir=a"], "this sweep is given by hydra.sweep"),
    (["run", "hydra.sweep.dir=a"], "the folder of this run is given by hydra.run.dir=FOLDER"),
    (["run", "plant.states.9=1"], "plant.states.9=1: a list is given as a whole, as in"),
    (["run", "+plant.states.x=1"], "+plant.states.x=1: a list is given as a whole, as in"),
    (["run", "output=[1]"], "output=[1]: it has keys and is no list"),
    (["run", "hydra.run=3"], "hydra.run=3: it has keys and is no value"),
    (["run", "-m", "time.horizon=range(5,1)"], "a sweep of no jobs: a range is empty"),
    (["run", "-m", "estimator=glob(none*)"], "or glob(…) finds no file"),
    (["run", "-m", "plant=circuit,circut"], "plant=circut: there is no such plant"),
]


@pytest.mark.parametrize(("words", "expected"), WRONG)
def test_wrong_usage_is_one_line_and_exit_code_2(tmp_path, words, expected):
    assert_refused(gpebo(*words, cwd=tmp_path), expected)
    assert folders(tmp_path) == [], "a run that never began leaves no folder"


def test_a_plant_in_this_folder_is_told_from_one_that_is_nowhere(tmp_path, mine):
    done = gpebo("run", "plant=mine", *FAST, cwd=mine)
    assert_refused(done, "yours, plant/mine.yaml, is found with --config-dir .")
    assert_refused(gpebo("run", "mine", *FAST, cwd=mine), "did you mean plant=mine?")


def test_a_failed_run_is_exit_code_1(tmp_path):
    (tmp_path / "taken").touch()
    done = gpebo("run", "hydra.run.dir=taken", *FAST, cwd=tmp_path)
    assert_refused(done, "cannot create the folder ", "taken: File exists\n", code=1)


def test_a_folder_may_be_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert destination("hydra.run.dir", "~/mine") == str(tmp_path / "mine")


def test_a_traceback_when_it_is_asked_for(tmp_path):
    done = gpebo("run", "plant=circut", cwd=tmp_path, HYDRA_FULL_ERROR="1")
    assert done.returncode == 2
    assert "Traceback" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("gpebo: error: plant=circut")


@pytest.mark.parametrize(("error", "said"), [
    ("RuntimeError('first\\nsecond')",
     "internal error: RuntimeError: first second (set HYDRA_FULL_ERROR=1 for the traceback)"),
    ("MemoryError('17 GB')", "there is not enough memory for this: 17 GB"),
    ("OSError(28, 'No space left', 'a.csv')", "a.csv: No space left"),
    ("OSError('gone')", "gone"),
    ("FileNotFoundError(2, 'No such file')", "the current folder: No such file"),
])
def test_an_unexpected_error_is_one_line_too(tmp_path, error, said):
    script = (
        "import sys; from gpebo_cli.cli import app\n"
        f"def broken(words): raise {error}\n"
        "app._dispatch = broken; sys.exit(app.main())"
    )
    done = python("-c", script, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, f"gpebo: error: {said}\n")


def test_the_windows_of_somebodys_figures_do_not_matter():
    """Those of a notebook are in the environment of what is started from it."""
    script = (
        "import os; from gpebo_cli.cli import app\n"
        "app.main = lambda: print(os.environ['MPLBACKEND']) or 0\n"
        "app.entry()"
    )
    assert python("-c", script, MPLBACKEND="module://none").stdout == "agg\n"


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_an_interruption_is_exit_code_130_and_one_line(tmp_path):
    words = ["run", "estimator.gamma=logspace(0,12,200000)", "output.max_rows=400000"]
    with begin(*words, cwd=tmp_path) as running:
        wait_for(tmp_path, "outputs/runs/*")
        running.send_signal(signal.SIGINT)
        _, error = running.communicate(timeout=60)
    assert running.returncode == 130
    assert error == "gpebo: error: interrupted\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_one_line(tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gpebo_cli", "list"], cwd=tmp_path, env=environment(),
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)


@pytest.mark.skipif(os.name == "nt", reason="POSIX streams")
@pytest.mark.parametrize(("words", "closed"), [
    ("", "<&-"), ("", ">&-"), ("", "2>&-"), ("-m launcher=joblib", "<&- >&- 2>&-"),
])
def test_closed_streams_are_no_reason_not_to_run(tmp_path, words, closed):
    """As cron may start a program, and processes that it starts."""
    command = f"{sys.executable} -m gpebo_cli run {words} observer=none time.samples=3 figures=none"
    printed(subprocess.run(
        ["sh", "-c", f"exec {command} {closed}"], cwd=tmp_path, env=environment(),
        capture_output=True, text=True, check=False, timeout=60,
    ))
    assert len(list(tmp_path.glob("outputs/*/**/summary.json"))) == 1


def test_an_empty_folder_goes_unless_one_stands_in_it(tmp_path):
    for name in ("empty", "here", "full/result"):
        (tmp_path / name).mkdir(parents=True)
    with inprocess.inside(tmp_path / "here"):
        for name in ("empty", "here", "full"):
            remove_if_empty(str(tmp_path / name))
    assert {path.name for path in tmp_path.iterdir()} == {"here", "full"}


@pytest.mark.parametrize("words", [["--info", "all"], ["--cfg", "all"]])
def test_a_reader_that_has_seen_enough_of_hydra_is_no_news(tmp_path, words):
    command = f"{sys.executable} -m gpebo_cli run {' '.join(words)} | head -1"
    done = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, env=environment(), capture_output=True,
        text=True, check=False, timeout=60,
    )
    assert (done.stderr, done.stdout.count("\n")) == ("", 1)


def test_a_reader_that_stops_reading_is_no_error(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "gpebo_cli", "list"], cwd=tmp_path, env=environment(),
            stdout=writing, stderr=subprocess.PIPE, text=True, check=False,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


# Runs -----------------------------------------------------------------------------------------


def test_a_run_prints_table_folder_and_verdict(tmp_path):
    done = gpebo("run", "estimator=drem", "estimator.gamma=[1e8,1e10]", *FAST, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    *table, moved, folder, verdict = done.stdout.splitlines()
    assert len(table) == 3
    assert table[0].split()[0] == "gamma"
    assert "iv -0.25 → -3.45" in moved
    assert (tmp_path / folder / "summary.json").is_file()
    assert verdict.startswith("interval-exciting from t = ")
    assert folder.endswith("_circuit_drem")


def test_output_survives_a_terminal_that_knows_ascii_only(tmp_path):
    printed(gpebo("run", *FAST, cwd=tmp_path, PYTHONIOENCODING="ascii"))


def test_many_cases_are_a_short_table(tmp_path):
    done = gpebo("run", "estimator.gamma=logspace(6,10,100)", *FAST, cwd=tmp_path)
    assert len(done.stdout.splitlines()) < 20
    assert "… 88 more in cases.csv" in done.stdout


@pytest.mark.parametrize(("word", "gains"), [
    ("estimator.gamma=logspace(8, 10, 3)", [1e8, 1e9, 1e10]),
    ("experiment=paper_circuit", [1e8, 1e10]),
])
def test_a_gain_may_be_logspace_without_quotes_or_of_a_recipe(tmp_path, word, gains):
    printed(gpebo("run", word, *FAST, cwd=tmp_path))
    assert [float(row["gamma"]) for row in rows_of(folders(tmp_path)[0] / "cases.csv")] == gains


def test_simulate_only(tmp_path):
    said = printed(gpebo("run", "observer=none", *FAST, cwd=tmp_path))
    assert said.splitlines()[-1].startswith("simulated: index 2")


def test_a_plant_of_ones_own(tmp_path, mine):
    printed(gpebo("run", "--config-dir", mine, "plant=mine", *FAST, cwd=tmp_path))
    assert folders(tmp_path)[0].name.endswith("_mine_ls_drem")


def test_a_recipe_may_say_where_its_own_values_stand(tmp_path, mine):
    (mine / "experiment").mkdir(exist_ok=True)
    (mine / "experiment" / "both.yaml").write_text(
        "# @package _global_\ndefaults: [{override /plant: mine}, _self_]\ntitle: both\n"
    )
    words = "--config-dir", mine, "experiment=both", "--cfg", "job"
    said = yaml.safe_load(printed(gpebo("run", *words, cwd=tmp_path)))
    assert (said["plant"]["name"], said["title"]) == ("mine", "both")


def test_an_error_in_a_plant_names_its_file(tmp_path, mine):
    (mine / "plant" / "bad.yaml").write_text(MINE.replace("A: [[-1]]", "A: [[-z]]"))
    done = gpebo("run", "--config-dir", mine, "plant=bad", *FAST, cwd=tmp_path)
    assert_refused(done, "plant/bad.yaml")


def test_a_saved_configuration_repeats_the_run_in_a_new_folder(tmp_path, mine):
    words = ["--config-dir", mine, "plant=mine", "estimator.gamma=[1,2.5]", *FAST]
    assert gpebo("run", *words, "hydra.run.dir=first", cwd=tmp_path).returncode == 0
    first = tmp_path / "first"
    before = {path.name: path.read_bytes() for path in first.iterdir() if path.is_file()}
    printed(gpebo("run", "--config-dir", first, "--config-name", "config", cwd=tmp_path))
    (second,) = folders(tmp_path)
    assert second.name.endswith("_mine_ls_drem")
    for name in ("signals.csv", "estimates.csv", "cases.csv", "config.yaml"):
        assert (second / name).read_bytes() == before[name], name
    assert {path.name: path.read_bytes() for path in first.iterdir() if path.is_file()} == before
    # once more with a change on the command line
    printed(gpebo(
        "run", "--config-dir", first, "--config-name", "config", "time.horizon=5", cwd=tmp_path
    ))
    assert len(folders(tmp_path)) == 2
    group = gpebo(
        "run", "--config-dir", first, "--config-name", "config", "plant=circuit", cwd=tmp_path
    )
    assert_refused(group, "has plant written out")


def test_cfg_prints_the_configuration_and_runs_nothing(tmp_path):
    said = printed(gpebo("run", "--cfg", "job", "plant=descriptor", cwd=tmp_path))
    assert yaml.safe_load(said)["plant"]["name"] == "descriptor"
    assert folders(tmp_path) == []


@pytest.mark.parametrize(("word", "value"), [
    ("plant.inputs.V=2*sin(t)/(1 + t)", "2*sin(t)/(1 + t)"),
    ("plant.inputs.V=sin(t)", "sin(t)"),
    ("data.separator=;", ";"),
    ("data.decimal=,", ","),
    ("data.columns={u: U in (V), t: Time}", {"u": "U in (V)", "t": "Time"}),
    ('data.columns={"u": "U, in (V)"}', {"u": "U, in (V)"}),
    ("plant.C=[[1, -1-cos(t)], [true, null]]", [[1, "-1-cos(t)"], [True, None]]),
    ("plant.title=it's (new)", "it's (new)"),
])
def test_what_hydra_cannot_read_is_text(word, value, tmp_path):
    key = word.partition("=")[0]
    done = inprocess.gpebo("run", "--cfg", "job", "data=csv", word, cwd=tmp_path)
    assert not done.stderr
    found = yaml.safe_load(done.stdout)
    for part in key.split("."):
        found = found[part]
    assert found == value


# Sweeps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ["-m", "estimator.gamma=1e6,1e8", *FAST],
        ["plant=circuit", "-m", "estimator.gamma=1e6,1e8", *FAST],
        ["estimator.gamma=1e6,1e8", *FAST, "--multirun"],
    ],
)
def test_the_flag_of_a_sweep_may_stand_anywhere(tmp_path, words):
    printed(gpebo("run", *words, cwd=tmp_path))
    (sweep,) = folders(tmp_path, "sweeps")
    rows = rows_of(sweep / "results.csv")
    assert [float(row["estimator.gamma"]) for row in rows] == [1e6, 1e8]
    assert [row["status"] for row in rows] == ["done", "done"]
    slow, fast = (float(row["seconds_to_1pct_parameters"]) for row in rows)
    assert fast < slow
    assert not list(sweep.glob("*/figures"))


def test_a_failed_job_is_recorded_and_the_next_one_runs(tmp_path):
    done = gpebo("run", "-m", "estimator.gamma=-1,[1e6,1e8]", *FAST, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "1 of 2 jobs failed: job 0: estimator.gamma" in done.stderr
    (sweep,) = folders(tmp_path, "sweeps")
    failed, *cases = rows_of(sweep / "results.csv")
    assert failed["status"] == "failed"
    assert "estimator.gamma" in failed["error"]
    assert [(row["job"], row["case"], float(row["gamma"])) for row in cases] == [
        ("1", "0", 1e6), ("1", "1", 1e8),
    ]
    record = json.loads((sweep / "0" / "result.json").read_text())
    assert record["status"] == "failed"
    assert record["overrides"]["estimator.gamma"] == "-1"
    assert (sweep / "1" / "summary.json").is_file()


# Files of one's own ---------------------------------------------------------------------------


def test_half_written_neighbours_do_no_harm(tmp_path, mine):
    (mine / "plant" / "other.yaml").write_text("name: [")
    printed(gpebo("run", "--config-dir", mine, "plant=mine", *FAST, cwd=tmp_path))


def test_a_file_that_would_be_ignored_is_refused(tmp_path, mine):
    (mine / "plant" / "circuit.yaml").write_text(MINE)
    done = gpebo("run", "--config-dir", mine, "plant=circuit", *FAST, cwd=tmp_path)
    assert_refused(done, "would be ignored; rename it")
    with refused("would be ignored; rename it"):
        run("circuit", config_dir=mine)


def test_a_plant_may_have_a_number_for_a_name(tmp_path):
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "2024.yaml").write_text(DECAYING)
    printed(gpebo("run", "--config-dir", ".", "plant=2024", "figures=none", cwd=tmp_path))
