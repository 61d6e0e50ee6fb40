"""The run folder: tables that round-trip, strict JSON, and files that are whole or absent."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from factories import STATES, make_result, with_figures, without_observer
from processes import read_table, refused

from gpebo_cli.errors import ConfigError, GpeboError, printable
from gpebo_cli.experiment.result import (
    ActiveBound,
    EstimationResult,
    Fit,
    RunResult,
    StateChange,
)
from gpebo_cli.results import files, tables
from gpebo_cli.results.finished import span
from gpebo_cli.results.folder import write_run
from gpebo_cli.results.provenance import GitState, Provenance, git_state, provenance
from gpebo_cli.results.report import columns
from gpebo_cli.results.summary import strict, summary_text

TABLES = [f"{name}.csv" for name in tables.TABLES]
MADE_BY = Provenance({"gpebo": "0.1.0"}, GitState("c0ffee", False))


def write(result: RunResult, folder: Path, figures: bool | list[str] = False) -> Path:
    write_run(with_figures(result, figures), folder, "plant: circuit\n", MADE_BY)
    return folder


def read_summary(folder: Path) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    content: dict[str, Any] = json.loads(
        (folder / "summary.json").read_text(encoding="utf-8"), parse_constant=refuse
    )
    return content


def test_tables_as_parquet_have_the_same_numbers(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow.parquet")
    result = make_result(samples=51)
    output = replace(result.settings.output, parquet=True, figures=False)
    asked = replace(result, settings=replace(result.settings, output=output))
    write_run(asked, tmp_path, "plant: circuit\n", MADE_BY)
    for name in TABLES:
        header, rows = read_table(tmp_path / name)
        table = pyarrow.read_table((tmp_path / name).with_suffix(".parquet"))
        assert table.column_names == header
        columns = [[np.nan if v is None else v for v in c.to_pylist()] for c in table.columns]
        np.testing.assert_array_equal(np.transpose(columns), rows)
    write(result, tmp_path)
    assert not list(tmp_path.glob("*.parquet"))


def test_signals_round_trip_with_their_names(tmp_path: Path) -> None:
    """But for a state of which nothing is known; one that is known at times has empty cells."""
    result = make_result(samples=5001)  # more rows than one chunk
    result.simulation.states[:9, 0] = result.simulation.states[:, -1] = np.nan
    header, table = read_table(write(result, tmp_path) / "signals.csv")
    simulation = result.simulation
    assert header == ["t", "V", "y", *STATES[:-1]]
    expected = [simulation.t, simulation.inputs, simulation.outputs, simulation.states[:, :-1]]
    np.testing.assert_array_equal(table, np.column_stack(expected))


def test_regression_is_written_row_by_row(tmp_path: Path) -> None:
    result = make_result(samples=50)
    assert result.regression is not None
    psi = np.concatenate([result.regression.psi, 2.0 * result.regression.psi], axis=1)
    Y = np.concatenate([result.regression.Y, 2.0 * result.regression.Y], axis=1)
    regression = replace(result.regression, psi=psi, Y=Y)
    folder = write(replace(result, regression=regression), tmp_path)
    header, table = read_table(folder / "regression.csv")
    names = ["e0_e1", "e0_e2", "e0_il"]
    assert header == [
        "t",
        "Y_1",
        "Y_2",
        *(f"psi_1_{name}" for name in names),
        *(f"psi_2_{name}" for name in names),
    ]
    np.testing.assert_array_equal(table[:, 1:3], Y)
    np.testing.assert_array_equal(table[:, 3:6], psi[:, 0])
    np.testing.assert_array_equal(table[:, 6:], psi[:, 1])


def test_excitation_table(tmp_path: Path) -> None:
    result = make_result(samples=50)
    assert result.excitation is not None
    header, table = read_table(write(result, tmp_path) / "excitation.csv")
    assert header == ["t", "gram_eig_1", "gram_eig_2", "gram_eig_3", "pe_level", "normalised_min"]
    np.testing.assert_array_equal(table[:, 1:4], result.excitation.gram_eigenvalues)
    np.testing.assert_array_equal(table[:, 4], result.excitation.pe_level)


@pytest.mark.parametrize("mixing", [True, False])
def test_estimates_are_long_and_count_cases_from_zero(tmp_path: Path, mixing: bool) -> None:
    result = make_result(samples=200, thin=10, mixing=mixing)
    estimation = result.estimation
    assert estimation is not None
    header, table = read_table(write(result, tmp_path) / "estimates.csv")
    hats = [f"{name}_hat" for name in ("e0_e1", "e0_e2", "e0_il", *STATES)]
    assert header == ["case", "t", *hats, *(["delta"] if mixing else [])]
    assert table.shape == (2 * 20, len(header))
    np.testing.assert_array_equal(table[:, 0], np.repeat([0, 1], 20))
    for case in (0, 1):
        rows = table[table[:, 0] == case]
        np.testing.assert_array_equal(rows[:, 1], estimation.t)
        np.testing.assert_array_equal(rows[:, 2:5], estimation.parameters[case])
        np.testing.assert_array_equal(rows[:, 5:11], estimation.states[case])
        if estimation.delta is not None:
            np.testing.assert_array_equal(rows[:, 11], estimation.delta[0])


def test_each_case_gets_its_own_delta(tmp_path: Path) -> None:
    result = make_result(samples=30)
    assert result.estimation is not None
    assert result.estimation.delta is not None
    delta = np.concatenate([result.estimation.delta, 3.0 * result.estimation.delta])
    result = replace(result, estimation=replace(result.estimation, delta=delta))
    _, table = read_table(write(result, tmp_path) / "estimates.csv")
    np.testing.assert_array_equal(table[:, -1], delta.ravel())


def test_cases_name_their_gains_and_leave_unreached_times_empty(tmp_path: Path) -> None:
    result = make_result(gammas=(1e6, 1e10))
    path = write(result, tmp_path) / "cases.csv"
    header, table = read_table(path)
    assert header == [
        "case",
        "gamma",
        "seconds_to_1pct_parameters",
        "seconds_to_1pct_states",
        "final_error_parameters",
        "final_error_states",
        "rms_error_states",
    ]
    np.testing.assert_array_equal(table[:, 1], [1e6, 1e10])
    first, second = path.read_text().splitlines()[1:]
    assert first.startswith("0,1000000,,,")
    assert second.startswith("1,10000000000,6,")


def test_cases_with_different_gains_share_the_columns(tmp_path: Path) -> None:
    result = make_result()
    estimation: EstimationResult | None = result.estimation
    assert estimation is not None
    cases = ({"gamma": 1.0}, {"gamma": 2.0, "alpha": 0.1})
    result = replace(result, estimation=replace(estimation, cases=cases))
    header, table = read_table(write(result, tmp_path) / "cases.csv")
    assert header[:3] == ["case", "gamma", "alpha"]
    np.testing.assert_array_equal(table[:, 1:3], [[1.0, np.nan], [2.0, 0.1]])


@pytest.mark.parametrize("value", [0.1, 1 / 3, 5e-324, -0.0, 1.7976931348623157e308, np.inf])
def test_every_float_survives(tmp_path: Path, value: float) -> None:
    result = make_result(samples=3)
    states = np.full_like(result.simulation.states, value)
    result = replace(result, simulation=replace(result.simulation, states=states))
    _, table = read_table(write(result, tmp_path) / "signals.csv")
    assert table[:, 3:].tobytes() == states.tobytes()  # the sign of zero too


def test_a_complete_folder(tmp_path: Path) -> None:
    folder = write(make_result(), tmp_path / "deep" / "run", figures=["delta"])
    found = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert found == {*TABLES, "config.yaml", "summary.json", "figures/delta.png"}
    assert (folder / "config.yaml").read_text() == "plant: circuit\n"


def test_without_an_observer_only_signals_are_written(tmp_path: Path) -> None:
    folder = write(without_observer(make_result()), tmp_path)
    assert sorted(os.listdir(folder)) == ["config.yaml", "signals.csv", "summary.json"]
    summary = read_summary(folder)
    assert summary["status"] == "done"
    assert summary["observer"] == "none"
    for key in ("estimator", "excitation", "cases", "estimator_requirement", "parameters"):
        assert summary[key] is None


def test_no_table_of_an_earlier_run_stays(tmp_path: Path) -> None:
    write(make_result(), tmp_path, figures=["delta", "states"])
    (tmp_path / "notes.txt").write_text("mine")
    write(without_observer(make_result()), tmp_path, figures=["states"])
    assert sorted(os.listdir(tmp_path)) == [
        "config.yaml",
        "figures",
        "notes.txt",
        "signals.csv",
        "summary.json",
    ]
    assert os.listdir(tmp_path / "figures") == ["states.png"]


def test_two_runs_that_end_at_once_write_one_after_the_other(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    first, second = make_result(samples=3), without_observer(make_result(samples=3))
    thread = Thread(target=write, args=(second, tmp_path))
    with files.alone(tmp_path):
        thread.start()
        thread.join(0.2)
        assert os.listdir(tmp_path) == []
        for name, make in tables.TABLES.items():
            tables.write_table(tmp_path / f"{name}.csv", make(first))
    thread.join()
    assert sorted(os.listdir(tmp_path)) == ["config.yaml", "signals.csv", "summary.json"]


def test_summary_has_the_evidence(tmp_path: Path) -> None:
    summary = read_summary(write(make_result(), tmp_path))
    assert summary["plant"] == "circuit"
    assert summary["reference"] == "arXiv:2407.14373"
    assert (summary["index"], summary["strangeness_index"]) == (2, 1)
    assert summary["estimator"] == {"name": "drem", "gamma": [1e10, 1e8]}
    moved = summary["initial_state"]["moved"]
    assert moved == {"iv": {"from": -0.25, "to": -3.45, "change": pytest.approx(-3.2)}}
    assert summary["initial_state"]["given"]["iv"] == -0.25
    excitation = summary["excitation"]
    assert set(excitation) == {
        "is_ie",
        "t_c",
        "rho",
        "lambda_min",
        "condition",
        "weakest_direction",
        "pe_level_min", "normalised_min", "determined_at",
        "window",
    }
    assert list(excitation["weakest_direction"]) == ["e0_e1", "e0_e2", "e0_il"]
    # Only full windows count: the level at t = 0 is zero in every run.
    assert excitation["pe_level_min"] == pytest.approx(0.01 * (1 - np.exp(-2.0)))
    assert summary["assumptions"][0]["evidence"] == {"sigma_min": 0.3, "at": None}
    assert summary["estimator_requirement"]["name"] == "Δ not in L2"
    by_state = dict.fromkeys(STATES, 1e-13) | {"iv": 3e-13}
    assert summary["error_estimate"] == {
        "states": 3e-13, "by_state": by_state, "regression": 2e-13, "estimates": {},
    }
    assert [case["gains"] for case in summary["cases"]] == [{"gamma": 1e10}, {"gamma": 1e8}]
    assert summary["git"] == {"commit": "c0ffee", "dirty": False}
    assert summary["verdict"].startswith("done")


def test_summary_has_the_numbers_of_the_result(tmp_path: Path) -> None:
    result = make_result((1e10, 1e8, 1e6))
    assert result.metrics is not None
    assert result.excitation is not None
    jumps = (StateChange("e1", 1.0, 3.5, 4.0), StateChange("il", 2.0, -1.0, 5.0))
    fit = Fit(np.array([0.2, np.nan, 0.1]), 3.0, 0.05, correlation=np.zeros(5), band=0.2, ratio=1.5)
    bounds = {0: (ActiveBound("e1", 2.0, 3.0),), 2: (ActiveBound("il", -1.0, None),)}
    result = replace(
        result, fit=fit, estimation=replace(result.estimation, active=bounds),
        simulation=replace(result.simulation, jumps=jumps, impulses=((4.0, "iv"),)),
    )
    summary = read_summary(write(result, tmp_path))
    assert summary["jumps"] == [
        {"time": 4.0, "state": "e1", "from": 1.0, "to": 3.5, "change": 2.5},
        {"time": 5.0, "state": "il", "from": 2.0, "to": -1.0, "change": -3.0},
    ]
    assert summary["impulses"] == [{"time": 4.0, "state": "iv"}]
    assert summary["fit"] == {
        "rms_Y": 3.0, "rms_residual": [0.2, None, 0.1], "least_rms_residual": 0.1, "white": True,
        "noise_ratio": 1.5,
    }
    assert summary["active_bounds"] == [
        {"case": 0, "name": "e1", "value": 2.0, "time": 3.0},
        {"case": 2, "name": "il", "value": -1.0, "time": None},
    ]
    for k, case in enumerate(summary["cases"]):
        told = {name: strict(column[k]) for name, column in result.metrics.columns.items()}
        assert case == {"case": k, "gains": {"gamma": 10.0 ** (10 - 2 * k)}, **told}
    assert (summary["elements"], summary["timings"]) == (40, {"simulate": 0.002, "estimate": 0.001})
    told = {"t_c": result.excitation.t_c, "lambda_min": result.excitation.lambda_min,
            "normalised_min": result.excitation.level, "window": result.excitation.window,
            "condition": result.excitation.condition}
    assert {key: summary["excitation"][key] for key in told} == told


def test_summary_has_the_last_estimates_and_truths_of_each_case(tmp_path: Path) -> None:
    result = make_result(samples=50, thin=10)
    assert result.estimation is not None
    spread = np.arange(60.0).reshape(2, 5, 6)
    estimation = replace(
        result.estimation, states_std=spread, parameters_std=spread[..., :3],
        true_parameters=spread[1, :, 3:],
    )
    folder = write(replace(result, estimation=estimation), tmp_path)
    header, table = read_table(folder / "estimates.csv")
    names, signals = read_table(folder / "signals.csv")
    parameters = dict(zip(result.estimation.names, spread[1, -1, 3:], strict=True))
    assert read_summary(folder)["parameters"] == parameters
    truth = dict(zip(names, signals[-1], strict=True)) | parameters
    for case, told in read_summary(folder)["estimates"].items():
        last = dict(zip(header, table[table[:, 0] == int(case)][-1], strict=True))
        for name, one in told.items():
            found = [one["value"], one["std"], one["true"]]
            assert found == [last[f"{name}_hat"], last[f"{name}_std"], truth[name]]
        assert list(told) == ["e0_e1", "e0_e2", "e0_il", *STATES]


def test_summary_gives_ranges_for_many_cases(tmp_path: Path) -> None:
    gammas = (1e6, *np.logspace(8, 12, 100))
    summary = read_summary(write(make_result(gammas=gammas, samples=11), tmp_path))
    assert summary["cases"]["count"] == 101
    seconds = summary["cases"]["seconds_to_1pct_parameters"]
    assert seconds == {"min": pytest.approx(5.0), "max": pytest.approx(7.5), "finite": 100}


def test_summary_is_strict_json(tmp_path: Path) -> None:
    result = make_result(gammas=(1e6,))  # never reaches 1 %: NaN
    assert result.excitation is not None
    final = result.excitation.final
    excitation = replace(  # a spectrum that reaches zero has no condition
        result.excitation, t_c=None, pe_level=np.full(1001, np.nan),
        final=replace(final, eigenvalues=0.0 * final.eigenvalues),
    )
    summary = read_summary(write(replace(result, excitation=excitation), tmp_path))
    assert summary["cases"][0]["seconds_to_1pct_states"] is None
    assert summary["excitation"]["condition"] is None
    assert summary["excitation"]["pe_level_min"] is None


def test_plain_reduces_numpy_and_containers() -> None:
    value = {
        "a": np.float64("nan"),
        "b": (np.int64(3), np.bool_(True)),
        "c": np.array([1.0, -np.inf]),
    }
    assert strict(value) == {"a": None, "b": [3, True], "c": [1.0, None]}
    assert strict(Path("x")) == "x"
    assert strict({"of others": [Fraction(1, 3)]}) == {"of others": ["1/3"]}


def test_summary_keeps_the_order_of_its_keys() -> None:
    keys = list(json.loads(summary_text(make_result(), MADE_BY)))
    assert keys[:3] == ["status", "verdict", "plant"]
    assert keys[-3:] == ["timings", "versions", "git"]


@pytest.mark.parametrize("name", ["signals.csv", "estimates.csv", "summary.json", "config.yaml"])
def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    replaced = os.replace

    def full(source: str | Path, target: str | Path) -> None:
        if Path(target).name == name:
            raise OSError(errno.ENOSPC, "No space left on device")
        replaced(source, target)

    monkeypatch.setattr(os, "replace", full)
    with refused(str(tmp_path / name), "No space left", by=GpeboError):
        write(make_result(samples=11), tmp_path)
    assert name not in os.listdir(tmp_path)
    assert not [found for found in os.listdir(tmp_path) if found.endswith(".tmp")]
    # summary.json is what tells a finished folder.
    assert "summary.json" not in os.listdir(tmp_path)


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old")

    def chunks() -> Any:
        yield b"new"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        files.write_file(path, chunks())
    assert os.listdir(tmp_path) == ["table.csv"]
    assert path.read_text() == "old"


def test_a_file_in_the_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("")
    with pytest.raises(GpeboError, match=r"cannot create the folder .*run"):
        write(make_result(samples=11), tmp_path / "run")


def test_an_unknown_figure_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'parameter_eror'; .*did you mean parameter_error\?"):
        write(make_result(samples=11), tmp_path / "run", figures=["states", "parameter_eror"])
    assert not (tmp_path / "run").exists()


def test_a_regression_without_parameters_is_written(tmp_path: Path) -> None:
    result = make_result(parameters=(), samples=11)
    folder = write(result, tmp_path, figures=True)
    assert read_table(folder / "regression.csv")[0] == ["t", "Y_1"]
    assert read_table(folder / "excitation.csv")[0] == ["t", "pe_level", "normalised_min"]


def test_provenance_names_the_versions() -> None:
    versions = provenance().versions
    assert versions["numpy"] == np.__version__
    assert {"gpebo", "python", "scipy", "hydra-core", "matplotlib"} <= set(versions)


def git(folder: Path, *words: str) -> None:
    identity = ["-c", "user.name=test", "-c", "user.email=test@example.org"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    command = ["git", "-C", str(folder), *identity, *words]
    subprocess.run(command, check=True, capture_output=True, env=environment)


def test_git_state_of_a_checkout(tmp_path: Path) -> None:
    assert git_state(tmp_path) is None
    git(tmp_path, "init")
    assert git_state(tmp_path) == GitState(None, False)
    (tmp_path / "a").write_text("a")
    git(tmp_path, "add", "a")
    git(tmp_path, "commit", "-m", "first")
    state = git_state(tmp_path)
    assert state is not None
    assert state.commit is not None
    assert len(state.commit) == 40
    assert not state.dirty
    (tmp_path / "a").write_text("b")
    assert git_state(tmp_path) == GitState(state.commit, True)


def test_git_state_never_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".git").mkdir()  # not a repository
    assert git_state(tmp_path) is None
    monkeypatch.setenv("PATH", "")
    assert git_state(tmp_path) is None


def test_tables_need_neither_matplotlib_nor_pandas() -> None:
    code = (
        "import sys, gpebo_cli.results.tables, gpebo_cli.results.folder;"
        "print([name for name in ('matplotlib', 'pandas', 'scipy', 'PIL') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("content", ["", "t,y\n", "y\n0\n1\n", "t\n0\nx\n"])
def test_what_is_no_signals_has_no_span(content, tmp_path):
    (tmp_path / "signals.csv").write_text(content, encoding="utf-8")
    with refused("signals.csv: not the signals of a run", by=GpeboError):
        span(tmp_path)


def test_columns_of_a_table_are_as_wide_as_their_longest_cells():
    rows = [["gamma", "x"], ["1", "-12.5"]]
    assert columns(rows) == ["gamma      x", "    1  -12.5"]
    assert columns(rows, str.ljust) == ["gamma  x    ", "1      -12.5"]


def test_what_would_command_a_terminal_is_written_and_a_backslash_is_one():
    assert printable("C:\\a\x1b[2J ü\n") == "C:\\a\\x1b[2J ü\\n"
