"""Recordings: what is read, what is refused, and that a run's own signals give its estimates."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml
from examples import assert_repeats, gpebo
from hypothesis import given
from hypothesis import strategies as st
from plants import experiment, one_state, shipped
from processes import assert_refused, printed, refused, write_table
from scipy.io import savemat

from gpebo_cli import check, run
from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence.metrics import STANDING
from gpebo_cli.experiment.pipeline import run_experiment, stream
from gpebo_cli.experiment.several import _factor as factor_of
from gpebo_cli.experiment.several import _joined
from gpebo_cli.model import archive
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.recordings.guess import _factor, guess
from gpebo_cli.recordings.hold import bends, edges, held, recording_mesh
from gpebo_cli.recordings.lines import DATE, LineReader, seconds
from gpebo_cli.recordings.load import load
from gpebo_cli.recordings.table import read_table
from gpebo_cli.results.finished import read_columns, read_errors, read_run
from gpebo_cli.settings import DataSettings, Settings, TimeSettings

WHOLE = TimeSettings(-np.inf, np.inf, 201)
ESTIMATOR = {"name": "ls_drem"}


def signals_of(result):
    signals, system = result.signals, result.system
    names = ["t", *system.inputs, *system.outputs, *system.states]
    table = [signals.t, *signals.inputs.T, *signals.outputs.T, *signals.states.T]
    return dict(zip(names, table, strict=True))


def simulated(name="circuit", samples=1001, horizon=20.0):
    return experiment(shipped(name), ESTIMATOR, horizon, samples)


def recorded(path, name="circuit", hold="linear", time=WHOLE, **more):
    data = DataSettings("csv", path, hold)
    return run_experiment(
        Settings(estimator=ESTIMATOR, time=time, data=data, **more), shipped(name)
    )


def read(path, **more):
    """A recording of the circuit in a file."""
    return read_table(DataSettings("csv", str(path), **more), shipped("circuit"))


def streamed(path, content, **more):
    """Rows of the same, and what is wrong, if they come as a stream."""
    reader = LineReader(str(path), DataSettings("csv", **more), shipped("circuit"))
    return reader.feed(content, last=True)


# A run's own signals fed back ----------------------------------------------------------------


@pytest.mark.parametrize(("hold", "order"), [("zoh", 1), ("linear", 2), ("cubic", 4)])
def test_estimates_converge_to_those_of_the_run_as_samples_get_finer(tmp_path, hold, order):
    errors = []
    for samples in (201, 401, 801):
        made = simulated(samples=samples, horizon=10.0)
        result = recorded(
            write_table(tmp_path / "r.csv", signals_of(made)), hold=hold,
            time=TimeSettings(0.0, 10.0, samples),
        )
        difference = result.estimation.parameters[0, -1] - made.estimation.parameters[0, -1]
        errors.append(np.abs(difference).max())
        assert result.estimation.names == made.estimation.names
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert abs(rates[-1] - order) < 0.35


def test_a_cubic_recording_reproduces_the_estimates(tmp_path):
    made = simulated()
    path = write_table(tmp_path / "r.csv", signals_of(made))
    result = recorded(path, hold="cubic", time=TimeSettings(0.0, 20.0, 1001))
    late = made.signals.t > 3.0
    difference = np.abs(result.estimation.states - made.estimation.states)[0]
    size = np.abs(made.signals.states).max(axis=0)
    assert (difference / size)[late].max() < 1e-6
    np.testing.assert_allclose(
        result.estimation.true_parameters, made.estimation.true_parameters, atol=1e-12
    )
    assert result.metrics.final_error_states[0] < 1e-7 * size.max()


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_a_run_on_held_signals_is_reproduced_to_rounding(tmp_path, hold):
    made, span = simulated(samples=201), TimeSettings(0.0, 20.0, 201)
    first = recorded(write_table(tmp_path / "1.csv", signals_of(made)), hold=hold, time=span)
    again = recorded(write_table(tmp_path / "2.csv", signals_of(first)), hold=hold, time=span)
    np.testing.assert_array_equal(again.signals.outputs, first.signals.outputs)
    np.testing.assert_array_equal(again.estimation.parameters, first.estimation.parameters)
    np.testing.assert_array_equal(again.estimation.states, first.estimation.states)


def test_unknown_parameters_of_a_recording_are_estimated_and_their_truth_is_not_known(tmp_path):
    made = simulated("descriptor")
    result = recorded(write_table(tmp_path / "r.csv", signals_of(made)), "descriptor", "cubic")
    truth = result.estimation.true_parameters
    assert np.isnan(truth[:, :2]).all()
    np.testing.assert_allclose(truth[:, 2:], [[-1.0, 1.0]] * len(truth), atol=1e-12)
    np.testing.assert_allclose(result.estimation.parameters[0, -1, :2], [1.5, -0.8], atol=1e-5)
    assert result.metrics.final_error_parameters[0] < 1e-5  # of those that are known
    assert result.fit.residual[0] < 1e-5 * result.fit.size


@pytest.mark.filterwarnings("error")
def test_without_states_nothing_is_compared_and_the_fit_is_told(tmp_path):
    columns = signals_of(simulated())
    path = write_table(tmp_path / "r.csv", {k: columns[k] for k in ("V", "t", "y")})
    result = recorded(path, hold="cubic")
    for name, values in result.metrics.columns.items():
        assert np.isnan(values).all() != name.startswith(STANDING)  # which needs no truth
    assert np.isnan(result.estimation.true_parameters).all()
    assert np.isfinite(result.estimation.states).all()
    assert result.fit.residual[0] < 1e-7 * result.fit.size
    assert "|Y − ψη̂|" in result.verdict
    assert "state error" not in result.verdict


def test_some_of_the_states_are_compared_where_some_are_recorded(tmp_path):
    columns = signals_of(simulated())
    path = write_table(tmp_path / "r.csv", {k: columns[k] for k in ("t", "V", "y", "e2")})
    result = recorded(path, hold="cubic")
    assert np.isfinite(result.metrics.final_error_states[0])
    known = ~np.isnan(result.estimation.true_parameters[-1])
    assert known.tolist() == [False, True, False]


def test_the_span_may_be_a_part_of_the_recording(tmp_path):
    path = write_table(tmp_path / "r.csv", signals_of(simulated()))
    result = recorded(path, hold="cubic", time=TimeSettings(5.003, 10.0, 101))
    assert result.signals.t[0] == 5.003
    assert result.signals.t[-1] == pytest.approx(15.003)
    assert result.metrics.final_error_states[0] < 1e-4


@pytest.mark.parametrize(("first", "step"), [(0.0, 0.01), (1e4, 0.01), (1.7e9, 0.1)])
def test_a_sample_that_misses_its_row_by_rounding_has_that_row(first, step):
    """z = u, which is held, from the fourth row to the last."""
    plant = {
        "name": "two", "states": ["x", "z"], "inputs": {"u": 0}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-0.5, 0], [0, -1]], "B": [[1], [1]], "C": [[1, 0]],
        "initial_state": [0, 0],
    }
    t, u = np.round(first + step * np.arange(40), 6), np.sin(np.arange(40.0))
    data = {"frame": pd.DataFrame({"t": t, "u": u, "y": u}), "hold": "zoh"}
    found = run(
        plant, data=data, observer={"sample_time": step}, estimator="least_squares",
        time={"start": float(t[3])}, uncertainty=False,
    )
    assert found["u"].tolist() == u[3:].tolist()
    assert found["z_hat"][0] == pytest.approx(u[3:], abs=1e-12)


@pytest.mark.parametrize("horizon", [1e-9, 1e-6, 1e-5])
def test_a_span_of_a_recording_may_be_too_short_beside_its_start(horizon):
    t = 1.7e9 + np.arange(4.0)
    data = {"frame": pd.DataFrame({"t": t, "V": np.sin(t), "y": np.cos(t)})}
    with pytest.raises(ConfigError, match=r"s is too short to be resolved beside its start"):
        run("circuit", data=data, time={"horizon": horizon})


# The mesh ------------------------------------------------------------------------------------


def test_smooth_samples_share_elements_and_rough_ones_do_not():
    source = shipped("circuit").coefficients
    t = np.linspace(0.0, 20.0, 20001)
    smooth, rough = np.sin(t)[:, None], np.random.default_rng(0).normal(size=(len(t), 1))
    for values, few in ((smooth, True), (rough, False)):
        mesh = recording_mesh(t, values, "cubic", (0.0, 20.0), source, 1e-12)
        assert (mesh.size < 500) == few
        signal = held(t, values, "cubic")
        inner = np.linspace(0.1, 19.9, 997)
        assert np.abs(mesh.along(signal)(inner) - signal(inner, inner)).max() < 1e-10


@pytest.mark.parametrize(("rows", "stages"), [(51, 9), (20_001, 3)])
def test_elements_have_the_nodes_that_the_plants_modes_need(rows, stages):
    """Whatever the clock starts at; beside rows that are close a mode is a straight line."""
    source = plant_from_mapping(one_state(A=[[-2]])).coefficients
    for start in (0.0, 5.0):
        t = np.linspace(start, start + 10.0, rows)
        signals = np.sin(t)[:, None]
        mesh = recording_mesh(t, signals, "zoh", (t[0], t[-1]), source, 1e-12)
        assert (mesh.size, mesh.rule.stages) == (rows - 1, stages)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_a_held_signal_is_exact_on_its_mesh_and_edges_are_where_it_bends(hold):
    source = shipped("circuit").coefficients
    t = np.array([0.0, 0.3, 0.5, 1.7, 2.0, 2.5])
    values = np.array([[1.0], [1.0], [2.0], [3.0], [3.0], [0.0]])
    mesh = recording_mesh(t, values, hold, (0.1, 2.4), source, 1e-9)
    trajectory = mesh.along(held(t, values, hold))
    at = np.linspace(0.11, 2.39, 101)
    expected = (
        values[np.searchsorted(t, at, side="right") - 1, 0]
        if hold == "zoh" else np.interp(at, t, values[:, 0])
    )
    np.testing.assert_allclose(trajectory(at)[:, 0], expected, atol=1e-13)
    corners = {"zoh": [0.5, 1.7], "linear": [0.3, 0.5, 1.7, 2.0]}[hold]
    assert set(corners) <= set(mesh.edges.tolist())


def test_rows_that_are_close_do_not_bend_a_line_by_rounding():
    t = np.cumsum(np.tile([1.0, 1e-6], 20))
    assert not bends(t, np.pi * t[:, None], "linear").any()
    source, span = shipped("circuit").coefficients, (t[0], t[-1])
    few, many = (
        recording_mesh(at, np.pi * at[:, None], "linear", span, source, 1e-9).edges
        for at in (t[[0, -1]], t)
    )
    np.testing.assert_array_equal(many, few)  # no row is an edge


STEPPED = {
    "name": "stepped", "states": ["x"], "inputs": {"u": 1, "v": 1}, "outputs": ["y"],
    "unknowns": {"k": 1, "drift": 1}, "E": [[1]], "A": [[0]], "B": [[0, 2]], "C": [[1]],
    "F": [["u", -1]], "initial_state": [0],
}


def stepped():
    """Rows of x' = 2.5 u − 0.4 + 2 v from 0.3 on, u held from row to row and v zero."""
    t = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.2, 200))
    u = np.round(np.sin(0.7 * t), 1)
    y = 0.3 + np.append(0.0, np.cumsum(np.diff(t) * (2.5 * u[:-1] - 0.4)))
    return {"t": t - t[0], "u": u, "v": 0.0 * t, "y": y}


def test_each_signal_may_have_its_own_hold():
    """x is lines where u is held, whatever the steps: k and drift come out to rounding."""
    for hold, right in ({"u": "zoh"}, True), ("linear", False), ("zoh", False):
        found = run(STEPPED, data={"frame": stepped(), "hold": hold},
                    estimator={"name": "least_squares", "f0": None})
        away = np.abs(found.details.estimation.parameters[0, -1, :2] - [2.5, 0.4]).max()
        assert away < 1e-11 if right else away > 1e-4


def test_so_it_may_in_a_stream():
    rows = stepped()
    u, y = np.column_stack([rows["u"], rows["v"]]), rows["y"][:, None]
    settings = Settings(
        estimator={"name": "least_squares", "f0": 1e-14}, observer={"name": "gpebo"},
        data=DataSettings(hold={"u": "zoh"}), time=TimeSettings(np.nan, np.nan),
    )
    online = stream(settings, plant_from_mapping(STEPPED))(rows["t"][0], np.append(u[0], y[0]))
    made = online.feed(rows["t"], u, y)
    np.testing.assert_allclose(made.parameters[0, -1, :2], [2.5, 0.4], atol=1e-11)
    *of_psi, of_Y = np.linalg.norm(made.regression.weighted(), axis=(0, 1))
    np.testing.assert_allclose(online.natural_sizes * of_psi, of_Y, rtol=1e-9)


def test_of_states_that_nobody_measured_there_are_no_errors_to_be_compared(tmp_path):
    t = np.linspace(0.0, 3.0, 31)
    plant = one_state(states=["x", "v"], E=[[1, 0], [0, 1]], A=[[0, 1], [-1, 0]], C=[[1, 0]],
                      initial_state=[1, 0])
    data = {"t": t, "y": np.cos(t), "x": np.cos(t)}
    run(plant, data=data, time={"samples": 31}).save(tmp_path, figures=False)
    (found,) = read_errors(read_run("r", tmp_path, {}))
    x = read_columns(tmp_path / "estimates.csv")["x_hat"]
    np.testing.assert_allclose(found.states, np.abs(x - np.cos(found.t)), atol=1e-9)


@pytest.mark.parametrize(("hold", "between"), [("zoh", 2.5), ("linear", 2.5), ("cubic", 2.25)])
def test_true_states_between_rows_are_splines_where_outputs_are(hold, between):
    t = np.arange(5.0)
    data = DataSettings("csv", frame=pd.DataFrame({"t": t, "y": t, "x": t**2}), hold=hold)
    found = load(plant_from_mapping(one_state()), data, WHOLE, 1e-9).states(np.array([1.5]))
    np.testing.assert_allclose(found, [[between]], rtol=1e-12)


def test_elements_end_where_one_of_the_signals_bends():
    """A spline beside an input that is held, and derivatives of the former alone."""
    t = np.linspace(0.0, 4.0, 401)
    rows = {"t": t, "u": np.floor(t), "v": np.sin(t), "y": np.cos(t)}
    data = DataSettings("csv", frame=pd.DataFrame(rows),
                        hold={"u": "zoh", "v": "cubic", "y": "cubic"})
    read = load(plant_from_mapping(STEPPED), data, WHOLE, 1e-9)
    edges = read.inputs.mesh.edges
    assert {1.0, 2.0, 3.0} <= set(edges)
    assert len(edges) < 60
    at = np.linspace(0.123, 3.9, 77)
    exact = np.column_stack([np.floor(at), np.sin(at)])
    np.testing.assert_allclose(read.inputs(at), exact, atol=1e-8)
    assert read.derivatives.known.tolist() == [False, True]
    assert read.rows.hold == "cubic"


@pytest.mark.parametrize(("hold", "sample"), [("zoh", 3), ("linear", 2)])
def test_a_sample_bends_where_one_of_the_columns_does(hold, sample):
    values = np.array([[7.0, 0.0], [7.0, 0.0], [7.0, 0.0], [7.0, 1.0]])
    assert bends(np.arange(4.0), values, hold).nonzero()[0].tolist() == [sample]


def test_a_cut_next_to_a_sample_is_that_sample():
    t = np.array([0.0, 1.0, 2.0])
    assert edges(t, np.array([1.0 + 1e-12, 1.5])).tolist() == [0.0, 1.0, 1.5, 2.0]
    assert Mesh(edges(t, np.zeros(0)), radau_rule(2)).size == 2


# What is refused -----------------------------------------------------------------------------

GOOD = "t,V,y\n0,1,2\n0.5,1,3\n1,2,3\n"
BAD = {
    "a missing sample": ("t,V,y\n0,1,2\n1,,3\n", ["line 3", "column V", "missing"]),
    "spaces only": ("t,V,y\n0,1,2\n1,  ,3\n", ["line 3", "column V", "missing"]),
    "a repeated time": ("t,V,y\n0,1,2\n0,1,3\n", ["line 3", "column t", "repeats", "line 2"]),
    "a decreasing time": ("t,V,y\n1,1,2\n0.5,1,3\n", ["line 3", "column t", "is before"]),
    "a missing column": ("t,v,y\n0,1,2\n1,1,3\n", ["line 1", "no column V", "mean v?"]),
    "a line above the header": ("Model,M3\n" + GOOD, ["line 1", "line 1 has to be the header"]),
    "line ends of an old Mac": (GOOD.replace("\n", "\r"), ["line 1: a carriage return", "or CRLF"]),
    "a double column": ("t,V,y,y\n0,1,2,2\n", ["line 1", "column y", "2 times"]),
    "nan": ("t,V,y\n0,1,2\n1,nan,3\n", ["line 3", "column V", "'nan'", "finite"]),
    "inf": ("t,V,y\n0,1,2\n1,1,-inf\n", ["line 3", "column y", "finite"]),
    "text": ("t,V,y\n0,1,2\n1,off,3\n", ["line 3", "column V", "'off'", "not a number"]),
    "a name over two lines": ("t,V,y\x85y\n0,1,2\n", ["line 1", "no column y", r"mean y\x85y?"]),
    "a short row": ("t,V,y\n0,1,2\n1,2\n", ["line 3", "2 cells", "header has 3"]),
    "a long row": ("t,V,y\n0,1,2,3\n", ["line 2", "4 cells", "header has 3"]),
    "an empty line": ("t,V,y\n0,1,2\n\n1,1,3\n", ["line 3", "is empty"]),
    "two empty lines": ("t,V,y\n0,1,2\n\n\n1,1,3\n", ["line 3", "is empty"]),
    "semicolons": ("t;V;y\n0;1;2\n", ["line 1", "semicolons", "commas"]),
    "tabs": ("t\tV\ty\n0\t1\t2\n", ["line 1", "tabs"]),
    "nothing": ("", ["empty"]),
    "a header only": (GOOD[:6], ["0 rows"]),
    "one row": (GOOD[:12], ["1 rows"]),
    "an open quote": ('t,V,y\n0,"1,2\n', ["line 2", "not CSV"]),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_mistake_in_a_file_is_named_with_its_place(tmp_path, mistake):
    text, parts = BAD[mistake]
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with refused(str(path), *parts) as error:
        read(path)
    assert ("with a gap" in str(error.value)) == (mistake == "nan")
    if parts[0].startswith("line"):  # a stream, whose length nobody knows, says the same
        assert streamed(path, text.encode())[1] == str(error.value)


def test_a_space_separates_nothing_in_a_file_with_tabs(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text(GOOD.replace(",", "\t").replace("1\t2\t3", "1 2\t3"))
    with refused("line 4", "2 cells", "header has 3"):
        read(path, separator="tab")


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_rows_are_the_same_however_a_stream_is_cut(size):
    reader = LineReader("standard input", DataSettings("csv"), shipped("circuit"))
    content, rows = GOOD.replace("\n", "\r\n").encode(), []
    for i in range(0, len(content), size):
        more, message = reader.feed(content[i : i + size])
        assert message == ""
        rows += more
    assert rows == [[0.0, 1.0, 2.0], [0.5, 1.0, 3.0], [1.0, 2.0, 3.0]]


@pytest.mark.parametrize("last", [False, True])
def test_a_line_without_an_end_is_refused_by_its_number(last):
    """With the rows before it, whatever pieces they come in."""
    reader = LineReader("S", DataSettings("csv"), shipped("circuit"))
    content = b"t,V,y\n0,1,2\n" + b"1" * ((1 << 20) + 1)
    assert reader.feed(content[:-1]) == ([[0.0, 1.0, 2.0]], "")
    assert reader.feed(b"1", last=last) == ([], "S, line 3: longer than 1048576 bytes")
    again = LineReader("S", DataSettings("csv"), shipped("circuit"))
    assert again.feed(content, last=last) == (
        [[0.0, 1.0, 2.0]], "S, line 3: longer than 1048576 bytes"
    )


CELLS = st.sampled_from([
    "0", "1", "2.5", "-1e3", ".5", "5.", " 7 ", "\t8", "+9", "1e400", "nan", "inf", "", "１", "1_0",
    "0x1", "True", "\u00a01", "\v2", "3\f", "4\r", "5\0", "1e", '"6"', '"7', "1 2", "\u20289",
])


@given(st.lists(st.lists(CELLS, min_size=2, max_size=4), max_size=5), st.booleans())
def test_a_file_and_a_stream_agree_whatever_stands_there(tmp_path_factory, rows, windows):
    end = "\r\n" if windows else "\n"
    times = [[str(k), *cells] for k, cells in enumerate(rows)]
    content = "".join(",".join(cells) + end for cells in [["t", "V", "y"], *times]).encode()
    path = tmp_path_factory.mktemp("alike") / "r.csv"
    path.write_bytes(content)
    told, wrong = streamed(path, content)
    try:
        found = read(path).samples
        rows = np.column_stack([found.t, found.inputs, found.outputs]).tolist()
        assert (rows, "") == (told, wrong)
    except ConfigError as error:
        said = str(error)
        assert said == wrong or (not wrong and len(told) < 2 and "rows below" in said)


HEAD, ROWS = "t,V,y\n", "0,1,2\n1,2,3\n"
READINGS = {  # what is read, or in which line it is refused
    "plain": (HEAD + ROWS, 0), "a byte order mark": ("\ufeff" + HEAD + ROWS, 0),
    "two marks": ("\ufeff\ufeff" + HEAD + ROWS, 1), "a mark below": (HEAD + "\ufeff" + ROWS, 2),
    "CRLF": ((HEAD + ROWS).replace("\n", "\r\n"), 0), "CR": ((HEAD + ROWS).replace("\n", "\r"), 1),
    "CR inside": (HEAD + "0,1\r,2\n", 2), "two CR": (HEAD + "0,1,2\r\r\n1,1,1\n", 2),
    "no last newline": (HEAD + ROWS.rstrip(), 0), "a blank line": (HEAD + "0,1,2\n\n1,2,3\n", 3),
    "blank first": ("\n" + HEAD + ROWS, 1), "blank last": (HEAD + ROWS + "\n \n", 0),
    "a separator behind each": ((HEAD + ROWS).replace("\n", ",\n"), 0),
    "a separator behind rows": (HEAD + ROWS.replace("\n", ",\n"), 2),
    "a name twice": ("t,V,V,y\n0,1,1,2\n", 1),
    "an unread name twice": ("t,V,y,a,a\n0,1,2,x,z\n1,1,1,,\n", 0),
    "quoted names": ('"t","V","y"\n' + ROWS, 0), "quoted lines": (HEAD + '0,"1\n",2\n', 2),
    "quotes inside": (HEAD + '0,1"2,3\n', 2), "quotes behind": (HEAD + '0,"1"2,3\n', 2),
    "a blank before quotes": (HEAD + '0, "1",2\n', 2),
    "semicolons": ((HEAD + ROWS).replace(",", ";"), 1),
    "a NUL": (HEAD + "0,1\0,2\n", 2), "no ASCII space": (HEAD + "0,1\u2003,2\n", 2),
    "a line separator": (HEAD + "0,1,2\u20281,2,3\n", 2),
    "next line": (HEAD + "0,1,2\x851,2,3\n", 2),
    "no UTF-8": (HEAD + "0,\udcff,2\n", 2),
    "a comment": (HEAD + "# 0\n" + ROWS, 2), "decimal comma": (HEAD + "0,1,5,2\n", 2),
    **{f"the cell {cell!r}": (HEAD + f"0,1,{cell}\n1,2,3\n", 2) for cell in (
        "１.５", "٣", "1\u00a0", "\v1", "1\f", "1_000", "1e999", "-1e999", "nan", "NaN",
        "inf", "-Infinity", "0x10", "0b1", "1e", "e5", "1.5.2", "--1", "+ 1", "1 2", "true",
        "None", "", " ", "1j", "1d5", "∞", "−1", "1e300", "-2e50",
    )},
    **{f"the number {cell!r}": (HEAD + f"0,1,{cell}\n1,2,3\n", 0) for cell in (
        " 1", "1\t", "+1", "-0", "1.", ".5", "1E5", "1e-400", "007", '"2"', '" 2"', "9" * 50,
    )},
}


@pytest.mark.parametrize("name", READINGS)
def test_a_file_and_a_stream_have_one_strict_reading(tmp_path, name):
    text, line = READINGS[name]
    path = tmp_path / "r.csv"
    content = text.encode(errors="surrogateescape")
    path.write_bytes(content)
    told, wrong = streamed(path, content)
    if line:
        with refused(wrong, begins=f"{path}, line {line}"):
            read(path)
    else:
        found = read(path).samples
        rows = np.column_stack([found.t, found.inputs, found.outputs]).tolist()
        assert (rows, "") == (told, wrong)
        assert len(rows) == 2


def test_files_that_would_fill_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "MAX_BYTES", 100_000)
    savemat(tmp_path / "packed.mat", {"t": np.zeros(20_000)}, do_compression=True)
    with open(tmp_path / "sparse.csv", "wb") as stream:
        stream.truncate(1 << 40)
    for name, said in (("packed.mat", "or unpacks to more"), ("sparse.csv", "at most 500000000")):
        with pytest.raises(ConfigError, match=said):
            read(tmp_path / name)


@pytest.mark.parametrize("blank", ["\n\n", "\n \n\t\n", "\r\n\r\n"])
def test_blank_lines_count_unless_they_are_the_last(tmp_path, blank):
    path = tmp_path / "r.csv"
    path.write_bytes((GOOD + blank).encode())
    assert len(read(path).samples.t) == 3
    reader = LineReader("S", DataSettings("csv"), shipped("circuit"))
    rows, wrong = reader.feed((GOOD + blank).encode())
    assert (len(rows), wrong) == (3, "")
    assert "line 5" in reader.feed(b"9,1,1\n")[1]


def test_many_rows_are_read_in_seconds(tmp_path):
    t = np.arange(200_000) * 0.1
    path = write_table(tmp_path / "r.csv", {"t": t, "V": np.sin(t), "y": np.cos(t)})
    start = process_time()
    found = read(path).samples
    assert process_time() - start < 4.0
    np.testing.assert_array_equal(found.t, t)
    np.testing.assert_array_equal(found.outputs[:, 0], np.cos(t))


# Files as they come from elsewhere ------------------------------------------------------------

ELSEWHERE = """\
"Time / ms";"U in (V)";note;"I, measured"\r
0;1000,5;start;2,5\r
500;2000;;-1e1\r
1000;;"";3\r
1500;1;"a; b";,25\r
"""
OF_ELSEWHERE = {
    "columns": {"t": "Time / ms", "V": "U in (V)", "y": "I, measured"}, "scale": {"V": 1e-3},
    "time_unit": "ms", "separator": ";", "decimal": ",",
}


@pytest.mark.parametrize(
    ("missing", "t", "V"),
    [
        ("hold", [0.0, 0.5, 1.0, 1.5], [1.0005, 2.0, 2.0, 1e-3]),
        ("interpolate", [0.0, 0.5, 1.0, 1.5], [1.0005, 2.0, 1.0005, 1e-3]),
        ("drop", [0.0, 0.5, 1.5], [1.0005, 2.0, 1e-3]),
    ],
)
def test_names_units_separators_and_gaps_are_said(tmp_path, missing, t, V):
    path = tmp_path / "r.csv"
    path.write_text(ELSEWHERE, newline="")
    found = read(path, missing=missing, **OF_ELSEWHERE).samples
    np.testing.assert_allclose(found.t, t, rtol=1e-15)
    np.testing.assert_allclose(found.inputs[:, 0], V, rtol=1e-12)
    if missing == "interpolate":
        with pytest.raises(ConfigError, match="a stream takes refuse, hold or drop"):
            streamed(path, b"", missing=missing, **OF_ELSEWHERE)
        return
    rows, wrong = streamed(path, ELSEWHERE.encode(), missing=missing, **OF_ELSEWHERE)
    assert wrong == ""
    np.testing.assert_array_equal([row[0] for row in rows], found.t)
    np.testing.assert_array_equal([row[1] for row in rows], found.inputs[:, 0])


def test_a_decimal_comma_is_the_only_sign_of_a_fraction(tmp_path):
    path, how = tmp_path / "r.csv", {"separator": ";", "decimal": ","}
    path.write_text("t;V;y\n0;1,5;2\n0,5;-,25;3e-1\n")
    assert read(path, **how).samples.inputs.tolist() == [[1.5], [-0.25]]
    path.write_text("t;V;y\n0;1,5;2\n0,5;2.5;3\n")
    with pytest.raises(ConfigError, match=r"line 3, column V: '2\.5' is not a num"):
        read(path, **how)


@pytest.mark.parametrize(("cell", "why"), [
    ("1e400", "too large; numbers go up to"), ("-1e60", "too large; numbers go up to"),
    ("-inf", "not a finite number"),
])
def test_a_number_that_overflows_is_too_large_as_others_are(cell, why, tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(f"t,V,y\n0,1,2\n1,{cell},2\n")
    with pytest.raises(ConfigError, match=f"line 3, column V: '{cell}' is {why}"):
        read(path)


def test_a_gap_is_refused_unless_it_is_said_what_to_do(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(ELSEWHERE, newline="")
    with pytest.raises(ConfigError, match=r"line 4, column U in \(V\): the sample is missing"):
        read(path, **OF_ELSEWHERE)


@pytest.mark.parametrize(("missing", "hold", "lines", "V"), [
    ("hold", "linear", (3, 6), [1.0, 1.0, 2.0, 2.0]),
    ("interpolate", "linear", (3, 5), [1.0, 1.5, 2.0]),
    ("interpolate", {"V": "zoh"}, (3, 5), [1.0, 1.0, 2.0]),
])
def test_rows_before_all_signals_have_begun_are_left_out(tmp_path, missing, hold, lines, V):
    path = tmp_path / "r.csv"
    path.write_text("t,V,y\n0,,5\n1,1,6\n2,,7\n3,2,8\n4,,9\n")
    found = read(path, missing=missing, hold=hold)
    assert found.lines == lines
    assert found.samples.inputs[:, 0].tolist() == V
    assert found.samples.outputs[:, 0].tolist() == [6.0, 7.0, 8.0, 9.0][: len(V)]
    if missing == "hold":
        rows, wrong = streamed(path, path.read_bytes(), missing=missing, hold=hold)
        assert (wrong, [row[1] for row in rows]) == ("", V)
    path.write_text("t,V,y\n0,,5\n1,,6\n")
    with pytest.raises(ConfigError, match="0 rows without gaps; 2 are needed"):
        read(path, missing=missing, hold=hold)


def test_rows_that_repeat_a_time_are_left_out_where_that_is_said(tmp_path):
    path, rows = tmp_path / "r.csv", pd.DataFrame({"t": [0, 1, 1, 2], "V": [1, 2, 3, 4], "y": 1.0})
    rows.to_csv(path, index=False)
    with pytest.raises(ConfigError, match=r"line 4, column t: 1\.0 repeats .* data\.missing=drop"):
        read(path)
    for frame in (None, rows):
        found = read(path, missing="drop", frame=frame)
        assert (found.left_out, found.samples.inputs[:, 0].tolist()) == (1, [1.0, 2.0, 4.0])
    told, wrong = streamed(path, path.read_bytes(), missing="drop")
    assert (wrong, [row[1] for row in told]) == ("", [1.0, 2.0, 4.0])


def test_dates_are_seconds_after_the_first(tmp_path):
    path = tmp_path / "r.csv"
    days = ["2024-02-28T23:59:59", "2024-02-29 00:00:00,25", "2024-03-01T00:00:00.25Z"]
    path.write_text("t,V,y\n" + "".join(f'"{day}",1,2\n' for day in days))
    expected = [0.0, 1.25, 86401.25]
    assert read(path, time_unit="datetime").samples.t.tolist() == expected
    rows, wrong = streamed(path, path.read_bytes(), time_unit="datetime")
    assert ([row[0] for row in rows], wrong) == (expected, "")
    others = ["31.5.2024 9:00:00", "31.05.2024 09:00:00,5", "2024-05-31T09:00:00.5000001"]
    for day, t in zip(others, [0.0, 0.5, 0.5000001], strict=True):
        assert seconds([day], seconds(others[:1], None)[1])[0] == pytest.approx([t], rel=1e-15)
    summer = ["2024-03-31T01:59:00+01:00", "2024-03-31T03:00:00+02:00"]  # a minute later in Berlin
    assert seconds(summer, None)[0].tolist() == [0.0, 60.0]
    path.write_text("t,V,y\n" + "".join(f"{day},1,2\n" for day in [days[0], "29/02/2024"]))
    with pytest.raises(ConfigError, match=r"line 3, column t: '29/02/2024' is not a date"):
        read(path, time_unit="datetime")
    clock = ["2025-10-26 02:59:30", "2025-10-26 02:00:00"]  # half a minute later in Berlin
    path.write_text("t,V,y\n" + "".join(f"{time},1,2\n" for time in clock))
    with pytest.raises(ConfigError, match=r"times must increase; local times go back where summer"):
        read(path, time_unit="datetime")


def test_data_frames_parquet_and_mat_are_the_same_recording(tmp_path):
    rows = {"t": [0.0, 0.5, 1.0], "V": [1.0, 2.0, 4.0], "y": [3.0, 5.0, 6.0]}
    frame = pd.DataFrame(rows)
    pages = np.zeros((3, 2, 2))
    savemat(tmp_path / "r.mat", {**rows, "note": "text", "single": 3.0, "pages": pages})
    since = pd.to_timedelta(frame["t"], unit="s")
    dated = frame.set_index(pd.Timestamp("2024-01-01") + since).drop(columns="t")
    frames = frame, frame.set_index("t"), frame.assign(t=since), dated
    tables = [read("", frame=one) for one in frames] + [read(tmp_path / "r.mat")]
    if find_spec("pyarrow"):
        frame.to_parquet(tmp_path / "r.parquet")
        tables.append(read(tmp_path / "r.parquet"))
    for table in tables:
        assert table.samples.t.tolist() == rows["t"]
        assert table.samples.inputs[:, 0].tolist() == rows["V"]
        assert table.samples.outputs[:, 0].tolist() == rows["y"]


def test_durations_of_a_data_frame_begin_where_they_say(tmp_path, monkeypatch):
    t = pd.to_timedelta([10.0, 10.5, 12.0], unit="s")
    frame = pd.DataFrame({"t": t, "V": 1.0, "y": 2.0})
    assert read("", frame=frame).samples.t.tolist() == [10.0, 10.5, 12.0]
    (tmp_path / "r.parquet").touch()
    monkeypatch.setattr("gpebo_cli.recordings.guess.typed_table", lambda *_: frame)
    found = guess(str(tmp_path / "r.parquet"), shipped("circuit"))
    assert (found.columns["t"], found.time_unit, found.doubts) == ("t", "s", [])


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"V": ["a", "b", "c"]}, "column V: "),
        ({"V": [1.0, np.nan, 2.0]}, "row 1, column V: nan is no number within"),
        ({"t": [0.0, 1.0, 1.0]}, "column t: 1.0 follows 1.0; times must increase"),
        ({"t": [1.0, 0.5, 2.0]}, "column t: 0.5 follows 1.0; times must increase"),
        ({"t": [0.0, np.nan, 1.0]}, "row 1, column t"),
        ({"V": [True, False, True]}, "column V: bool"),
        ({"V": [1.0, 2.0, 3j]}, "column V: complex128 is not numbers"),
        ({"V": [1.0, 2.0, -1e60]}, "row 2, column V: -1e+60 is no number within ±1e+50"),
        ({"t": ["2024-01-01", "b", "c"]}, "is not numbers; data.time_unit=datetime reads dates"),
    ],
)
def test_what_is_wrong_with_a_data_frame(change, part):
    good = {"t": [0.0, 0.5, 1.0], "V": [1.0, 2.0, 4.0], "y": [3.0, 5.0, 6.0]}
    frame = pd.DataFrame(good | change)
    with refused(part):
        read("", frame=frame)
    with refused("has 1 rows; at least 2 are needed"):
        read("", frame=pd.DataFrame(good).iloc[:1])
    dates = ["2024-01-01", "2024-01-02", "2024-01-03"]
    with refused("column V: object is not numbers"):  # whatever the times are
        read("", frame=pd.DataFrame({"t": dates, "V": pd.Series(dates, dtype=object),
                                     "y": [3.0, 5.0, 6.0]}), time_unit="datetime")
    with refused("row 1, column t: nan"):  # whatever is done about gaps of signals
        read("", frame=pd.DataFrame(good | {"t": [0.0, np.nan, 1.0]}), missing="hold")
    with refused("row 0, column V: inf is no number") as told:  # and no gap
        read("", frame=pd.DataFrame(good | {"V": [np.inf, 1.0, 2.0]}), missing="drop")
    assert "data.missing" not in str(told.value)
    back = {"t": [0.0, 0.5, 0.2], "V": [1.0, 2.0, np.nan]}
    with refused("0.2 follows 0.5; times must increase"):  # where a signal is missing, too
        read("", frame=pd.DataFrame(good | back), missing="hold")


def test_dates_of_a_data_frame_may_be_text():
    dates = ["2024-01-01", "2024-01-01T00:00:02", "2024-01-01T00:01:00"]
    frame = pd.DataFrame({"t": dates, "V": 1.0, "y": 2.0})
    assert read("", frame=frame, time_unit="datetime").samples.t.tolist() == [0.0, 2.0, 60.0]


def test_rows_without_a_time_may_be_the_first_of_a_data_frame():
    times = pd.Series([pd.NaT, pd.Timestamp("2024-01-01"), pd.Timestamp("2024-01-01 00:00:02")])
    for t, more in (times, {}), (times.astype(str), {"time_unit": "datetime"}):
        frame = pd.DataFrame({"t": t, "V": 1.0, "y": 2.0})
        assert read("", frame=frame, missing="drop", **more).samples.t.tolist() == [0.0, 2.0]


@pytest.mark.parametrize("data", [[pd.DataFrame()], [{"t": [0, 1]}], ["a.csv", 3], 3])
def test_what_is_neither_files_nor_a_frame_is_one_line(data):
    with refused("data: expected a file, a list of files or one pandas.DataFrame, got"):
        run("circuit", data=data)


@pytest.mark.parametrize(
    ("settings", "part"),
    [
        ({"columns": {"W": "x"}}, "data.columns: 'W' is no signal"),
        ({"scale": {"V": 0.0}}, "data.scale.V must be a finite number other than 0"),
        ({"columns": {"V": "U"}}, "no column U"),
        ({"scale": {"v": 2.0}}, "did you mean V?"),
        ({"hold": {"v": "zoh"}}, "data.hold.v: plant circuit has no such signal; those are V, y"),
        ({"separator": "ab"}, "data.separator"),
        ({"separator": ".", }, "data.separator"),
        *(({"separator": mark}, "data.separator: expected one character") for mark in '"\r\n'),
        ({"file": ["a.csv", "b.csv"]}, "data.file: here one file is needed, not several"),
    ],
)
def test_settings_that_do_not_fit_the_file(tmp_path, settings, part):
    path = tmp_path / "r.csv"
    path.write_text(GOOD)
    given = {"name": "csv", "file": str(path), **settings}
    with refused(part):
        read_table(DataSettings(**given), shipped("circuit"))


@pytest.mark.parametrize("name", ["/dev/zero", "pipe"])
def test_a_device_or_a_pipe_is_no_recording(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    path = os.path.join(tmp_path, name)  # an absolute name stays as it is
    with pytest.raises(ConfigError, match="is not a regular file"):
        read(path)


def test_files_that_are_not_text(tmp_path):
    path = tmp_path / "r.csv"
    for content, part in ((b"t,V,y\n0,1,\xff\n", "line 2"), (GOOD.encode("utf-16"), "UTF-16")):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=part):
            read(path)


def test_a_byte_order_mark_quotes_and_other_columns_do_no_harm(tmp_path):
    path = tmp_path / "r.csv"
    content = b'\xef\xbb\xbf"t",note,y,V\r\n0,"a, b",2,1\r\n1,,3,"4"\r\n\r\n'
    path.write_bytes(content)
    table = read(path)
    assert table.samples.inputs.tolist() == [[1.0], [4.0]]
    assert table.samples.outputs.tolist() == [[2.0], [3.0]]
    assert table.lines == (2, 3)
    assert table.sha256 == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    ("time", "parts"),
    [
        (TimeSettings(0.0, 20.0, 11), ["line 4", "ends at t = 1", "0 + 20", "horizon=null"]),
        (TimeSettings(-1.0, 1.0, 11), ["line 2", "0 to 1", "time.start = -1"]),
        (TimeSettings(1.0, np.inf, 11), ["time.start = 1"]),
    ],
)
def test_a_span_that_is_not_recorded(tmp_path, time, parts):
    path = tmp_path / "r.csv"
    path.write_text(GOOD)
    with refused(*parts):
        load(shipped("circuit"), DataSettings("csv", str(path)), time, 1e-12)


def test_the_span_of_a_recording_by_the_clock_is_told_to_hundredths(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("t,V,y\n1764259200.5,1,2\n1764259201,1,3\n")
    with refused("is of t = 1764259200.5 to 1764259201, which does not have time.start = 0"):
        load(shipped("circuit"), DataSettings("csv", str(path)), TimeSettings(0.0, 1.0, 11), 1e-12)


def test_rows_of_a_span_are_those_inside_of_it_and_its_ends(tmp_path):
    t = np.arange(11.0)
    path = write_table(tmp_path / "r.csv", {"t": t, "V": np.sin(t), "y": np.cos(t)})
    found = load(shipped("circuit"), DataSettings("csv", path), TimeSettings(2.5, 5.5, 11), 1e-12)
    np.testing.assert_array_equal(found.rows.t, [2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])


def test_a_span_that_misses_the_samples_by_rounding_is_theirs(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("t,V,y\n0.1,1,2\n0.2,1,3\n0.3,2,3\n")
    for start, horizon in ((0.1, 0.2), (0.1 - 1e-13, 0.2 + 2e-13)):
        time = TimeSettings(start, horizon, 11)
        found = load(shipped("circuit"), DataSettings("csv", str(path)), time, 1e-12)
        assert found.span == (0.1, 0.3)


def test_measured_columns_are_what_the_observer_sees(tmp_path):
    """As in the signals.csv of a run with noise: y is the truth, y_measured what was measured."""
    columns = signals_of(simulated(samples=401))
    wrong = {name: np.zeros(401) for name in ("V", "y")}
    beside = {"V_measured": columns["V"], "y_measured": columns["y"]}
    plain = recorded(write_table(tmp_path / "plain.csv", columns))
    found = recorded(write_table(tmp_path / "beside.csv", {**columns, **wrong, **beside}))
    np.testing.assert_array_equal(found.estimation.states, plain.estimation.states)
    np.testing.assert_array_equal(found.signals.outputs, plain.signals.outputs)


def test_a_recording_without_an_observer_is_refused(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(GOOD)
    with pytest.raises(ConfigError, match="observer=none"):
        recorded(str(path), observer={"name": "none"})


# The command line ----------------------------------------------------------------------------


def test_a_recording_from_the_command_line(tmp_path):
    columns = signals_of(simulated("descriptor", 301, 10.0))
    path = write_table(tmp_path / "rec.csv", {k: columns[k] for k in ("t", "u", "y")})
    words = ["plant=descriptor", f"data.file={path}", "data.hold=cubic", "estimator=ls_drem"]
    assert "unknown" in printed(gpebo("run", *words, "hydra.run.dir=out", cwd=tmp_path))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["recording"]["rows"] == 301
    assert summary["recording"]["sha256"] == hashlib.sha256(Path(path).read_bytes()).hexdigest()
    assert summary["parameters"]["theta1"] is None
    assert summary["cases"][0]["final_error_states"] is None
    assert summary["fit"]["rms_residual"][0] < 1e-3 * summary["fit"]["rms_Y"]
    header = (tmp_path / "out" / "signals.csv").read_text().partition("\n")[0]
    assert header == "t,u,y"
    assert_repeats(tmp_path / "out", "estimates.csv")
    printed(gpebo("compare", "out", "again", "--no-figures", cwd=tmp_path))
    assert "interval excitation" in printed(gpebo("check", *words, cwd=tmp_path))


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["data=csv"], "data.file"),
        (["data.file=nowhere.csv"], "nowhere.csv cannot be read"),
        (["data.file=."], "is a folder"),
        (["data=cvs"], "did you mean csv?"),
        (["data.file=bad.csv"], "bad.csv, line 3, column V"),
        (["data.file=bad.csv", "data.hold=foh"], "zoh or linear or cubic"),
    ],
)
def test_what_is_wrong_with_a_recording_is_one_line(tmp_path, words, part):
    (tmp_path / "bad.csv").write_text(BAD["a missing sample"][0])
    assert_refused(gpebo("run", *words, cwd=tmp_path), part)


def test_a_data_frame_from_python(tmp_path):
    columns = signals_of(simulated(samples=401))
    frame = pd.DataFrame({"time": columns["t"] / 60.0, "V": columns["V"], "y": columns["y"]})
    path = write_table(tmp_path / "r.csv", {k: columns[k] for k in ("t", "V", "y")})
    data = {"frame": frame, "columns": {"t": "time"}, "time_unit": "min"}
    result = run("circuit", estimator="ls_drem", data=data)
    expected = run("circuit", estimator="ls_drem", data=path)
    assert run("circuit", data=pd.read_csv(path)).t[-1] == 20.0
    np.testing.assert_allclose(
        result.estimates["il"], expected.estimates["il"], rtol=1e-6, atol=1e-6
    )
    saved = result.save(tmp_path / "out", figures=False)
    assert (saved / "config.yaml").read_text().startswith("# The plant, the estimator or the data")


def test_a_recording_from_python(tmp_path):
    columns = signals_of(simulated(samples=401))
    path = write_table(tmp_path / "r.csv", {k: columns[k] for k in ("t", "V", "y")})
    from_path = run("circuit", estimator="ls_drem", data=Path(path))
    cubic = run("circuit", estimator="ls_drem", data={"file": path, "hold": "cubic"})
    assert from_path.t[-1] == 20.0
    assert np.isnan(cubic["il"]).all()
    assert cubic.parameters == {k: cubic.estimates[k][0, -1] for k in cubic.parameters}
    fits = [result.details.fit.residual[0] for result in (from_path, cubic)]
    assert fits[1] < 1e-2 * fits[0]
    found = check("circuit", data=path)
    assert all(assumption.holds for assumption in found)
    saved = cubic.save(tmp_path / "out", figures=False)
    assert json.loads((saved / "summary.json").read_text())["recording"]["hold"] == "cubic"


# gpebo new recording -------------------------------------------------------------------------

FOUND = {
    "as it stands": ("t,V,y\n0,1,2\n1,2,3\n", {"t": "t", "V": "V", "y": "y"}, {}),
    "capitals, units": (
        "Time [ms];U in (mV);Y_measured\n0;1,5;2\n500;2,5;3\n",
        {"t": "Time [ms]", "V": "U in (mV)", "y": "Y_measured"},
        {"separator": ";", "decimal": ",", "time_unit": "ms", "scale": {"V": 1e-3}},
    ),
    "tabs, dates, a gap": (
        "stamp\tV (kV)\ty\n2024-01-01 00:00:00\t1\t2\n2024-01-01 00:00:01\t\t3\n"  # noqa: ISC004
        "2024-01-01 00:00:02\t1\t4\n",
        {"t": "stamp", "V": "V (kV)", "y": "y"},
        {"separator": "\t", "time_unit": "datetime", "scale": {"V": 1e3}, "missing": 1},
    ),
    "signs for gaps": (
        "t,V,y\n0,1,2\n1,-,3\n2,3,NaN\n3,4,5\n", {"t": "t", "V": "V", "y": "y"}, {"missing": 2}
    ),
    "microseconds": ("t_us,V,y\n0,1,2\n1,2,3\n", {"t": "t_us", "V": "V", "y": "y"},
                     {"scale": {"t": 1e-6}}),
    "decimal commas with exponents": (
        "t;V;y\n0,0E+00;1,0E+00;2\n1,0E+00;2,0E+00;3\n", {"t": "t", "V": "V", "y": "y"},
        {"separator": ";", "decimal": ","},
    ),
    "a date beside seconds": ("Date,Time (msec),V,y\n1.1.2024,0,1,2\n1.1.2024,1,2,3\n",
                              {"t": "Time (msec)", "V": "V", "y": "y"}, {"time_unit": "ms"}),
    "an output that begins late": (
        "t,V,y\n" + "".join(f"{k},{k % 7},\n" for k in range(60)) + "60,1,2\n61,2,3\n",
        {"t": "t", "V": "V", "y": "y"}, {"missing": 60},
    ),
    "by elimination": ("zeit,a,y\n0,1,2\n1,2,3\n", {"t": "zeit", "V": "a", "y": "y"}, {}),
}


@pytest.mark.parametrize("name", FOUND)
def test_a_look_at_a_file_finds_its_columns(tmp_path, name):
    text, columns, more = FOUND[name]
    path = tmp_path / "lab.csv"
    path.write_text(text, encoding="utf-8")
    found = guess(str(path), shipped("circuit"))
    assert found.columns == columns
    assert not found.lacking
    expected = {"separator": ",", "decimal": ".", "time_unit": "s", "scale": {}, "missing": 0}
    assert {key: getattr(found, key) for key in expected} == expected | more


def test_of_columns_with_the_unit_the_most_similar_name_is_taken(tmp_path):
    """In whatever order they stand; where the unit alone decides, a person is asked to look."""
    plant = one_state(outputs=["v_out"], inputs={"v_in": "0"}, B=[[1]])
    system = plant_from_mapping(plant | {"units": {"v_in": "V", "v_out": "V"}})
    path = tmp_path / "lab.csv"
    for head in "t,Vin (V),Vout (V)", "t,Vout (V),Vin (V)":
        path.write_text(f"{head}\n0,1,2\n1,2,3\n")
        found = guess(str(path), system)
        assert found.columns == {"t": "t", "v_in": "Vin (V)", "v_out": "Vout (V)"}
        assert found.reasons["v_in"] == "its unit, as of others: LOOK AT IT"
    path.write_text("t,v_in,Vout (V),Vaux (V)\n0,1,2,3\n1,2,3,4\n")
    assert guess(str(path), system).reasons["v_in"] == "the same name"
    path.write_text("t,a,v_inp,voltage_out\n0,1,2,3\n1,2,3,4\n")
    found = guess(str(path), plant_from_mapping(plant))
    assert (found.columns["v_in"], found.reasons["v_in"]) == ("v_inp", "a similar name")


def test_an_output_called_T_is_no_time(tmp_path):
    (tmp_path / "log.csv").write_text("Datum;T\n31.05.2024 9:00:00;1,5\n31.05.2024 9:00:01;2,5\n")
    found = guess(str(tmp_path / "log.csv"), plant_from_mapping(one_state(outputs=["T"])))
    assert (found.columns, found.time_unit) == ({"t": "Datum", "T": "T"}, "datetime")


def test_what_is_guessed_runs_as_it_stands(tmp_path):
    columns = signals_of(simulated(samples=201))
    lines = ["Time / ms;U (mV);I measured\x7f;\x1b[31mnote"]
    rows = zip(columns["t"], columns["V"], columns["y"], strict=True)
    for k, (t, V, y) in enumerate(rows):
        voltage = "" if k == 7 else f"{1e3 * V:.17g}"
        lines.append(f"{1e3 * t:.17g};{voltage};{y:.17g};".replace(".", ","))
    (tmp_path / "lab 1.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    said = printed(gpebo("new", "recording", "lab 1.csv", "--plant", "circuit", cwd=tmp_path))
    assert r"not understood: not read: \x1b[31mnote" in said
    assert "by elimination" in said
    words = ["plant=circuit", "data=lab_1", "estimator=ls_drem", "figures=none", "data.scale.y=1"]
    printed(gpebo("run", "--config-dir", ".", *words, "hydra.run.dir=out", cwd=tmp_path))
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["recording"]["last"] == 20.0
    again = gpebo("new", "recording", "lab 1.csv", "--plant", "circuit", cwd=tmp_path)
    assert_refused(again, "exists already")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["lab.csv"], "--plant NAME"),
        (["lab.csv", "--plant", "circut"], "did you mean circuit?"),
        (["none.csv", "--plant", "circuit"], "none.csv cannot be read"),
        (["one.csv", "--plant", "circuit"], "the same number of cells"),
        (["lab.mat", "--plant", "circuit"], "lab.mat cannot be read"),
    ],
)
def test_what_cannot_be_looked_at_is_one_line(tmp_path, words, part):
    (tmp_path / "lab.csv").write_text(GOOD)
    (tmp_path / "one.csv").write_text("a\n1\n2\n")
    assert_refused(gpebo("new", "recording", *words, cwd=tmp_path), part)


def test_a_look_at_a_table_with_types(tmp_path):
    """Matrices are columns; what has another length than t, or is no number, is not there."""
    t, both = np.arange(3.0), np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, 5.0]])
    path = tmp_path / "lab.mat"
    savemat(path, {"t": t, "fs": 1e3, "long": np.zeros(9), "volt in kV": both, "y": [1, 2, 3]})
    found = guess(str(path), shipped("circuit"))
    assert found.columns == {"t": "t", "y": "y"}
    for matrix in (both, both.T):  # a column or a row for each signal
        savemat(path, {"t": t, "V": matrix, "y": [[1], [2], [3]], "long": np.zeros(9)})
        found = guess(str(path), shipped("circuit"))
        assert (found.columns, found.missing) == ({"t": "t", "V": "V_1", "y": "y"}, 1)
    savemat(path, {"V": 9.0 - t, "y": t**2})
    assert {*guess(str(path), shipped("circuit")).columns.values()} <= {"V", "y"}  # that are there
    savemat(path, {"all": {"t": t, "V": t, "y": t}})
    with refused("lab.mat has no vectors of numbers; fields of a struct"):
        guess(str(path), shipped("circuit"))


def test_signals_that_are_not_found_are_said(tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text("t,a,b,c\n0,1,2,3\n1,2,3,x\n")
    found = guess(str(path), shipped("circuit"))
    assert found.lacking == ["V", "y"]
    assert any("no column was found for V" in doubt for doubt in found.doubts)
    for content, message in (
        (b"t,V,y\n0,1,\xff\n", "lab.csv, line 2: not UTF-8 text"),
        (b"\n\xff,V,y\n0,1,2\n", "lab.csv, line 2: not UTF-8 text"),
        (b"t,V,y\n", "lab.csv has no rows below its header"),
        (b"t\n0\n1\n", "lab.csv: no character of comma, semicolon, tab and space cuts its first"),
        (b"t,V\n0,1,2\n", "lab.csv: no character of comma, semicolon, tab and space cuts its f"),
        (b"t,V,y\r0,1,2\r1,2,3\r", "lab.csv, line 1: a carriage return without a newline"),
        (b"t,V,y\n" + b"0,1,2\n" * 60 + b"3" * 200_000, "lab.csv is not CSV: field larger than"),
    ):
        path.write_bytes(content)
        with refused(message):
            guess(str(path), shipped("circuit"))


@pytest.mark.parametrize(("above", "told"), [
    ('Model,M3\nRecord,"2",s\n\n', "if line 4 is the header, remove what stands above it"),
    ("0,0\n", "if line 2 is the header"),
    ("t,V\n0,1\n1,2\n0,1,2\n", "is the first line the header?"),
])
def test_lines_above_the_header_are_told_by_the_number_of_the_header(tmp_path, above, told):
    path = tmp_path / "lab.csv"
    path.write_text(above + ("0,1,2\n" if "?" in told else "t,V,y\n0,1,2\n"))  # one row
    with refused(f"the same number of cells, two at least; {told}"):
        guess(str(path), shipped("circuit"))


def test_a_line_is_looked_at_that_is_longer_than_a_cell(tmp_path):
    wide = [["t", "V", "y", *(f"x{k}" + 10_000 * "_" for k in range(20))], ["0"] * 23, ["1"] * 23]
    (tmp_path / "lab.csv").write_text("\n".join(map(";".join, wide)))
    assert guess(str(tmp_path / "lab.csv"), shipped("circuit")).separator == ";"


def test_numbers_that_stand_for_gaps_are_said(tmp_path):
    """9999 far from all others is taken for one; near others a person has to say."""
    path = tmp_path / "lab.csv"
    path.write_text("t,V,y\n0,1,9999\n1,999,2\n2,3,9999\n3,2,2.5\n")
    found = guess(str(path), shipped("circuit"))
    assert (found.gaps, found.missing, found.doubts) == ([9999.0], 2, [])
    for cell in ("9999", "9999,0"):  # of which there is nothing else, or which are no numbers
        path.write_text(f"t;V;y\n0;1.5;{cell}\n1;99.9;{cell}\n2;3.2;{cell}\n3;2.1;{cell}\n")
        found = guess(str(path), shipped("circuit"))
        assert (found.gaps, found.missing) == ([], 0)
    path.write_text("t,V,y\n0,1,9999\n1,999,2\n2,3,9999\n3,2,9500\n")
    found = guess(str(path), shipped("circuit"))
    assert (found.gaps, found.missing) == ([], 0)
    assert found.doubts == ["2 cells are 9999: if that means a gap, leave them empty"]


    path.write_text("t,V,y\n0,1,-999\n1,2,2\n2,3,-999\n3,2,2.5\n")
    assert guess(str(path), shipped("circuit")).gaps == [-999.0]
    cells = "9.91E+37", "-9.9e37", "+9.91E+37", "9.9E37"  # SCPI: no number, and infinities
    rows = "".join(f"{k},{k % 3},{cells[k // 2]}\n" for k in range(8))
    path.write_text(f"t,V,y\n{rows}8,1,2\n")
    assert guess(str(path), shipped("circuit")).gaps == [9.91e37, -9.9e37, 9.9e37]


DAYS = "column time (days) may be in days, t is in s: data.scale.t is the factor between them"


@pytest.mark.parametrize(("head", "time", "said"), [
    ("when,v [A],Y", "0", {
        "columns": {"t": "when", "V": "v [A]", "y": "Y"}, "time_unit": "s", "scale": {"V": 1.0},
        "reasons": {"t": "the first column: LOOK AT IT", "time_unit": "not said in the file",
                    "V": "by elimination: LOOK AT IT", "y": "the same name but for capitals",
                    "scale.V": "A in the header, V here: WHICH FACTOR?"},
        "doubts": ["column v [A] may be in A, V is in V: data.scale.V is the factor between them"],
    }),
    ("time (min),V,y [mA]", "0", {
        "columns": {"t": "time (min)", "V": "V", "y": "y [mA]"}, "time_unit": "min",
        "scale": {"y": 1e-3}, "doubts": [],
        "reasons": {"t": "by its name", "time_unit": "from the header", "V": "the same name",
                    "y": "the name is in the header", "scale.y": "mA in the header, A here"},
    }),
    ("time (days),V,y", "0", {
        "time_unit": "s", "scale": {"t": 1.0},
        "doubts": [DAYS],
    }),
    ("t,V,y,note", "later", {
        "doubts": [f"column t: 'later' is neither a number nor {DATE}", "not read: note"],
    }),
])
def test_each_guess_has_its_reason_and_each_doubt_is_told(tmp_path, head, time, said):
    (tmp_path / "lab.csv").write_text(f"{head}\n{time},1,2{',a' * head.count('note')}\n")
    found = guess(str(tmp_path / "lab.csv"), shipped("circuit"))
    assert {key: getattr(found, key) for key in said} == said


def test_no_factor_is_asked_for_between_units_whose_zeros_differ(tmp_path):
    (tmp_path / "lab.csv").write_text("t,V,y [°C]\n0,1,20\n")
    plant = replace(shipped("circuit"), units={"y": "K"})
    [doubt] = guess(str(tmp_path / "lab.csv"), plant).doubts
    assert doubt.startswith("column y [°C] may be in °C, y is in K: their zeros differ, ")
    assert "data.scale" not in doubt


def test_a_row_of_units_and_numbers_of_rows_are_said(tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text("t (ms);V;y\n[ms];[V];[A]\n0;1,5;2\n10;1,6;2\n")
    found = guess(str(path), shipped("circuit"))
    assert (found.time_unit, found.decimal, found.columns["t"]) == ("ms", ",", "t (ms)")
    assert found.doubts == [
        "column t (ms): '[ms]' above its numbers; such rows have to be removed"
    ]
    path.write_text("t;V;y\n0;999;2\n1;1,001;2\n")  # a thousand, as a person sees who reads it
    assert guess(str(path), shipped("circuit")).reasons["decimal"] == "numbers such as 1,001"
    told = "column # may count rows: data.scale.t is the time between them in seconds"
    for name, first, doubts in ("#", 0, [told]), ("#", 1, [told]), ("#", 2, []), ("t", 0, []):
        rows = "".join(f"{first + k},1,2\n" for k in range(3))
        path.write_text(f"{name},V,y\n{rows}")
        assert guess(str(path), shipped("circuit")).doubts == doubts


def test_an_input_that_steps_is_guessed_to_be_held(tmp_path):
    """Half of its rows as the one before; gaps do not count, and a constant needs no hold."""
    path = tmp_path / "lab.csv"
    for V, steps in ("0 0 0 - 1 1 0 0", True), ("0 0 0 0 0 0", False), ("0 1 2 3 3 4 5 6", False):
        rows = "".join(f"{k},{cell},1\n" for k, cell in enumerate(V.split()))
        path.write_text(f"t,V,y\n{rows}")
        assert guess(str(path), shipped("circuit")).held == ["V"] * steps


def test_a_recording_with_numbers_for_gaps_is_that_with_gaps(tmp_path):
    """Three commands: nobody has to know that the logger writes 9999."""
    t = np.arange(0.0, 2.0, 0.02)
    y = 1.0 + np.sin(t)
    y[[7, 30, 31]] = 9999.0
    plant = one_state(name="level", phi=["cos(t)"], initial_state=[0])
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "level.yaml").write_text(yaml.safe_dump(plant))
    write_table(tmp_path / "log.csv", {"t": t, "y": y})
    command = ("new", "recording", "log.csv", "--plant", "level", "--config-dir", ".")
    assert gpebo(*command, cwd=tmp_path).returncode == 0
    data = yaml.safe_load((tmp_path / "data" / "log.yaml").read_text())
    assert (data["gaps"], data["missing"]) == ([9999.0], "interpolate")
    settings = DataSettings(file=str(tmp_path / "log.csv"), missing="interpolate", gaps=[9999.0])
    system = plant_from_mapping(plant, "level.yaml")
    level = read_table(settings, system).samples.outputs[:, 0]
    np.testing.assert_allclose(level, 1.0 + np.sin(t), atol=1e-3)
    savemat(tmp_path / "log.mat", {"t": t, "y": y})
    of_mat = read_table(replace(settings, file=str(tmp_path / "log.mat")), system).samples
    np.testing.assert_allclose(of_mat.outputs[:, 0], level, rtol=1e-15)
    with pytest.raises(ConfigError, match=r"9999\.0 is a gap \(data.gaps\); data.missing says"):
        read_table(replace(settings, missing="refuse"), system)


@pytest.mark.parametrize(("written", "unit", "factor"), [
    ("mV", "V", 1e-3), ("l/min", "l/s", 1 / 60), ("ml/min", "l/h", 0.06), ("A", "V", None),
    ("m/s", "m", None), ("kg/V", "kg/s", None), ("W", "kW", 1e-3), ("W", "mW", 1e3),
    ("µA", "mA", 1e-3), ("in", "min", None), ("l/min", "m3/s", 1e-3 / 60), ("m3/h", "L/h", 1e3),
    ("°C", "degC", 1.0), ("°C", "K", None), ("cm²", "m2", 1e-4), ("mm", "m3", None),
    ("mm/s²", "m/s2", 1e-3), ("kg/m3", "g/m3", 1e3), ("cm2/K", "m2/K", 1e-4), ("m2", "k2", None),
    ("rpm", "rad/s", np.pi / 30), ("mbar", "hPa", 1.0), ("kΩ", "ohm", 1e3), ("m", "V", None),
    ("mrad2", "rad2", 1e-6), ("km3", "m3", 1e9),
])
def test_units_are_converted_where_that_is_plain(written, unit, factor):
    assert _factor(written, unit) == (None if factor is None else pytest.approx(factor))


LEAKY = {
    "name": "leaky", "states": ["h1", "h2"], "inputs": {"V": "0"}, "unknowns": {"k": 0.4, "b": 0.1},
    "outputs": ["y"], "E": [[1, 0], [0, 1]], "A": [["-0.5 - 0.2*sin(t)", 0], [1, -0.3]],
    "B": [[1], [0]], "F": [["V", 0], [0, 1]], "C": [[0, 1]], "initial_state": {"h1": 1, "h2": 0},
}


def written(folder, name, start, V, h1, rows=401, noise=0.0, seed=0):
    """A file of the plant from its own start with its own input."""
    plant = {**LEAKY, "inputs": {"V": V}, "initial_state": {"h1": h1, "h2": 0.5}}
    made = run(plant, observer="none", time={"start": start, "horizon": 8, "samples": rows})
    table = made.to_pandas("signals").reset_index()[["t", "V", "y"]]
    table["y"] += noise * np.random.default_rng(seed).standard_normal(rows)
    return write_table(folder / name, table)


def test_several_files_share_unknowns_and_have_starts_of_their_own(tmp_path):
    """The plant's time is each file's own; what one file does not excite the other one does."""
    files = [
        written(tmp_path, "a.csv", 1.0, "sin(t)", 1.0),
        written(tmp_path, "b.csv", 3.0, "1 + cos(2*t)", -2.0, 201),
    ]
    result = run(LEAKY, data={"file": files, "hold": "cubic"}, time={"samples": 81})
    end = {name: values[0, -1] for name, values in result.estimates.items()}
    expected = {"k": 0.4, "b": 0.1, "e0_h1": -1.0, "e0_h2": -0.5, "e0_h1_2": 2.0, "e0_h2_2": -0.5}
    for name, value in expected.items():
        assert end[name] == pytest.approx(value, abs=1e-5), name
    assert (result.t[0], result.t[-1]) == (1.0, 17.0)
    assert len(result.t) == 161
    fit = result.details.fit
    np.testing.assert_allclose(fit.outputs[:, 0], result.outputs["y"], atol=1e-5)
    one = run(LEAKY, data={"file": files[1], "hold": "cubic"}, time={"samples": 81})
    np.testing.assert_allclose(
        result.estimates["h1"][0, -1], one.estimates["h1"][0, -1], atol=1e-5
    )


@pytest.mark.parametrize("known", [("a", "b"), ("a",)])
def test_states_of_several_files_are_known_where_each_file_has_them(tmp_path, known):
    """x = start e^-t; where two files meet the second one's first row counts."""
    t, files = np.linspace(0.0, 2.0, 21), []
    for name, start in (("a", 1.0), ("b", -3.0)):
        x = start * np.exp(-t)
        columns = {"t": t, "y": x, **({"x": x} if name in known else {})}
        files.append(write_table(tmp_path / f"{name}.csv", columns))
    result = run(one_state(), data={"file": files, "hold": "cubic"}, time={"samples": 21})
    first, second = np.exp(-t[:-1]), -3.0 * np.exp(-t)
    expected = np.append(first, second if "b" in known else np.full(21, np.nan))
    np.testing.assert_allclose(result.states["x"], expected, rtol=1e-9)
    assert result.details.recording.known_states == (("x",) if "b" in known else ())


@pytest.mark.parametrize(("grows", "remedy"), [
    ("0.001 + t", "none"), ("0.001 + 1e3*(1 - y)**2", "none"),
    ("0.001 + 1e3*(1 - y)**2", "noise_free"),
])
def test_outputs_count_alike_in_all_files(tmp_path, grows, remedy):
    """What acts from the first on the second state grows a thousandfold until the second file.

    Along a copy without noise that is known for the plant itself.
    """
    plant = one_state(
        states=["a", "b"], inputs={"u": 0}, outputs=["y", "z"], E=np.eye(2).tolist(),
        A=[[-1, 0], [grows, -1]], B=[[1], [0]], C=np.eye(2).tolist(), initial_state=[0, 0],
    )
    t = np.linspace(0.0, 1.0, 6)
    files = [str(tmp_path / f"{name}.csv") for name in "ab"]
    for file, start in zip(files, (0.0, 3.0), strict=True):
        y = np.cos(t) / (1.0 + start)
        write_table(file, {"t": start + t, "u": t, "y": y, "z": np.sin(t)})
    observer = {"name": "gpebo", "remedy": remedy}
    psi = run(plant, data=files, observer=observer, time={"samples": 3}).details.regression.psi
    np.testing.assert_array_equal(psi[2, :, 2:], psi[0, :, :2])


def test_many_files_are_estimated_as_well_as_one(tmp_path):
    """What ls_drem learns is learnt once the last one has begun, as if it were the first."""
    files = [
        written(tmp_path, f"{k}.csv", 0, f"1 + sin({k + 1}*t)", k, rows=41, noise=0.02, seed=k)
        for k in range(4)
    ]
    (eta, sigma), (least, least_sigma) = (
        (found.parameters[0, -1], found.parameters_std[0, -1])
        for found in (
            run(LEAKY, data=files, estimator=name, time={"samples": 5}, **more).details.estimation
            for name, more in (("ls_drem", {}), ("least_squares", {"f0": None}))
        )
    )
    np.testing.assert_array_less(np.abs(eta - least), 0.5 * least_sigma)
    np.testing.assert_allclose(sigma, least_sigma, rtol=0.2)


def test_a_short_recording_beside_a_long_one_leaves_the_noise_as_it_is(tmp_path):
    """Of the long one no row is kept, and what is kept of it has less noise than a row."""
    plant = one_state(A=[[-1]], unknowns={"k": 1.0}, F=[[1]])
    files, noise = [], np.random.default_rng(5)
    for rows in 1501, 61:
        t = np.linspace(0.0, 4.0, rows)
        y = 1.0 + np.exp(-t) + 0.1 * noise.standard_normal(rows)
        files.append(write_table(tmp_path / f"{rows}.csv", {"t": t, "y": y}))
    levels = {"name": "gaussian", "outputs": 0.1}
    told, found = (
        run(plant, data=files, time={"samples": 31}, **more).details
        for more in ({"noise": levels}, {})
    )
    assert told.fit.ratio == pytest.approx(1.0, abs=0.05)
    assert told.fit.white
    sigma = [each.estimation.parameters_std[0, -1] for each in (told, found)]
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=0.05)


@pytest.mark.parametrize("time", [{"start": 1.96}, {"start": 0.0, "horizon": 0.03}])
def test_a_span_with_one_row_has_no_residual_to_look_at(time):
    t = np.linspace(0.0, 2.0, 21)
    result = run(one_state(), data={"t": t, "y": np.exp(-t)}, time=time)
    assert result.details.fit.white is None


def test_assumption_1_is_judged_by_the_weakest_of_several_files(tmp_path):
    """[ΠA; C] is c = 1 + cos(t)/2 on the kernel of E, beside 1: weakest at t = π, in one file."""
    plant = {
        "name": "p", "states": ["a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, 0]], "B": [[0], [1]],
        "C": [[0, "1 + cos(t)/2"]], "initial_state": [0, 0],
    }
    files = []
    for start in (0.0, 3.0):
        made = run(plant, observer="none", time={"start": start, "horizon": 1.0, "samples": 41})
        table = made.to_pandas("signals").reset_index()[["t", "u", "y"]]
        files.append(write_table(tmp_path / f"{start}.csv", table))
    form = {"name": "gpebo", "form": "given"}
    for data, shift in ((files, -2.0), (files[::-1], 0.0)):
        found = run(plant, data=data, observer=form, time={"samples": 5}).details.assumptions
        (one,) = (a.evidence for a in found if a.name == "Assumption 1")
        assert one["smallest_singular_value"] == pytest.approx(0.5 / np.sqrt(1.25), rel=1e-4)
        assert one["at"] == pytest.approx(np.pi + shift, abs=0.03)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_evidence_of_two_files_is_what_both_have_or_the_worse_of_either(order, tmp_path):
    """A = sin(t) makes Φ grow by e^0.73 in one of them, and by less in the other one."""
    plant, files = one_state(A=[["sin(t)"]]), []
    for start, rows in ((1.0, 16), (2.5, 21)):
        t = np.linspace(start, start + 1.0, rows)
        files.append(write_table(tmp_path / f"{rows}.csv", {"t": t, "y": np.exp(-np.cos(t))}))
    given = [[files[k] for k in order], *([each] for each in files)]
    both, *each = (run(plant, data=data, time={"samples": 5}).details for data in given)

    def growth(details):
        (found,) = (a.evidence for a in details.assumptions if a.name == "Growth of Φ")
        return found["largest_entry"], found["rate"]

    grown = np.cos(1.0) - np.cos(2.0)
    assert growth(each[0]) == pytest.approx((np.exp(grown), grown), rel=1e-6)
    assert growth(both) == pytest.approx(np.max([growth(one) for one in each], axis=0))
    recorded, apart = both.recording, [one.recording for one in each]
    assert recorded.rows == 16 + 21
    assert recorded.elements == sum(one.elements for one in apart)
    assert (recorded.file, recorded.sha256) == tuple(
        ", ".join(getattr(apart[k], name) for k in order) for name in ("file", "sha256")
    )
    worst = max(one.regression.error_estimate for one in each)
    assert both.regression.error_estimate == worst


def test_files_along_which_a_plant_has_other_constraints_have_no_deviations(tmp_path):
    """0 = b in one of them and b' = −b in the other; that a constraint holds is a row of its ψ."""
    files = []
    for start in (0.0, 6.0):
        t = np.linspace(start, start + 2.0, 41)
        columns = {"t": t, "y": np.exp(start - t), "w": 0.0 * t}
        files.append(write_table(tmp_path / f"{start:g}.csv", columns))
    plant = one_state(
        states=["a", "b"], outputs=["y", "w"], E=[[1, 0], [0, "step(t - 5)"]],
        A=[[-1, 0], [0, -1]], C=[[1, 1], [0, 1]], initial_state=[1, 0],
    )
    both, *each = (
        run(plant, data=data, time={"samples": 5}, estimator="least_squares")
        for data in (files, *files)
    )
    assert [one.details.estimation.states_std is None for one in (both, *each)] == [
        True, False, False,
    ]
    assert "no standard deviations" in both.verdict
    np.testing.assert_allclose(both.estimates["a"][0, -1], np.exp(-2.0), rtol=1e-3)


def test_signals_of_three_files_stand_one_after_the_other(tmp_path):
    """The first sample of a file takes the place of the last one of the file before."""
    t = np.array([0.0, 0.5, 1.0])
    y = np.array([[1.0, 0.6, 0.4], [2.0, 1.2, 0.7], [3.0, 1.8, 1.1]])
    files = [write_table(tmp_path / f"{k}.csv", {"t": t + 2 * k, "y": y[k]}) for k in range(3)]
    plant = one_state(A=[[-1]])
    found = run(plant, data={"file": files, "hold": "linear"}, time={"samples": 3})
    np.testing.assert_allclose(found.t, np.arange(7) / 2.0)
    assert (found.details.recording.first, found.details.recording.last) == (0.0, 3.0)
    (name,) = found.outputs
    np.testing.assert_allclose(found.outputs[name], [*y[0, :2], *y[1, :2], *y[2]])


def test_what_is_known_at_samples_of_several_files_is_put_one_after_the_other():
    """Elements and samples move by the same; where two files meet, the second one's count."""
    first, second = (
        Mesh(np.array(edges), radau_rule(3)).sampled(np.array(t), np.array(values))
        for edges, t, values in (
            ([0.0, 1.0, 2.0], [0.0, 2.0], [1.0, 2.0]),
            ([5.0, 6.0, 8.0], [5.0, 7.0, 8.0], [3.0, 4.0, 5.0]),
        )
    )
    both = _joined([first, second], [0.0, -3.0])
    np.testing.assert_array_equal(both.mesh.edges, [0.0, 1.0, 2.0, 3.0, 5.0])
    np.testing.assert_array_equal(both(np.array([0.0, 2.0, 4.0, 5.0])), [1.0, 3.0, 4.0, 5.0])


def test_rows_of_a_recording_have_the_weight_of_its_whole_time():
    """ψ = 1 and Y = 2 over 10 s, however many elements and rows there are."""
    regression = SimpleNamespace(
        factor=None, p=1, mesh=Mesh(np.array([5.0, 6.0, 9.0, 15.0]), radau_rule(3)),
        psi=lambda t: np.ones((len(t), 1, 1)), Y=lambda t: 2.0 * np.ones((len(t), 1)),
    )
    found = factor_of(regression, SimpleNamespace(samples=np.linspace(5.0, 15.0, 41)))
    np.testing.assert_allclose(found.T @ found, [[10.0, 20.0], [20.0, 40.0]], rtol=1e-12)


def test_deviations_of_several_files_are_those_of_independent_data(tmp_path):
    """Twice the same experiment: least squares has half the variance, and one level."""
    noisy = {"noise": 0.02, "rows": 201}
    files = [
        written(tmp_path, f"{k}.csv", 0.0, "sin(t)", 1.0, seed=k, **noisy) for k in range(2)
    ]
    noise = {"name": "gaussian", "outputs": 0.02}
    std = [
        run(LEAKY, estimator="least_squares", data=data, noise=noise,
            time={"samples": 11}).to_pandas("estimates")["k_std"].iloc[-1]
        for data in (files[0], files)
    ]
    assert std[1] == pytest.approx(std[0] / np.sqrt(2.0), rel=1e-3)
    found = run(LEAKY, estimator="least_squares", data=files, time={"samples": 11})
    assert found.to_pandas("estimates")["k_std"].iloc[-1] == pytest.approx(std[1], rel=0.15)
    for made_up in ({"seeds": 2}, {"quantisation": 0.1}):
        with refused("noise.seeds and noise.quantisation are for simulations"):
            run(LEAKY, data=files, noise={**noise, **made_up})
    joined = run(LEAKY, data=[*files, files[0]], time={"samples": 5}).details.recording
    assert (joined.first, joined.last, joined.rows) == (0.0, 24.0, 603)
    with pytest.raises(ConfigError, match="several files"):
        run(LEAKY, data=files, observer={"sample_time": 0.1})


def test_a_recorded_state_that_ends_at_zero_is_judged_by_its_size_over_time():
    """x = sin(πt/5) is zero at t = 20: an error of 1e-4 there is not large beside it."""
    t = np.linspace(0, 20, 4001)
    x, slope = np.sin(np.pi * t / 5), np.pi / 5 * np.cos(np.pi * t / 5)
    plant = one_state(
        inputs={"u": 0}, unknowns={"k": 0.5}, A=[[-1]], B=[[1]], F=[[1]], initial_state=[0]
    )
    recorded = pd.DataFrame({"t": t, "u": slope + x - 0.5, "y": x})
    result = run(
        plant, data=recorded, estimator={"name": "least_squares", "f0": 1e-3}
    ).details
    assert result.estimation.requirement.holds
    assert 1e-5 < abs(result.estimation.parameters[0, -1, 0] - 0.5) < 1e-3
    assert result.warnings == ()


@pytest.mark.parametrize(("gain", "bounded"), [
    ("exp(-((u - 0.5)/1e-3)**2)", True), ("exp(-(sin(1e4*u)/1e-4)**2)", False),
])
def test_a_recording_says_whether_what_follows_its_signals_is_bounded(gain, bounded, monkeypatch):
    """In more elements than the fewest cells, too; where there is no end of pulses, it is said."""
    monkeypatch.setattr("gpebo_cli.model.expressions.bounds._MOST_ALONG", 16)
    t = np.linspace(0.0, 6.0, 61)
    plant = one_state(inputs={"u": 0}, unknowns={"a": 1}, A=[[-1]], F=[[gain]])
    found = run(plant, data={"t": t, "u": np.sin(t), "y": np.exp(-t)}, estimator="least_squares")
    assert found.details.recording.bounded == bounded
    assert ("nothing bounds what functions that change so often" in found.verdict) != bounded


@pytest.mark.parametrize("random", [False, True])
def test_steps_between_random_times_are_no_pauses(random):
    steps = np.random.default_rng(1).exponential(0.5, 3000) if random else np.full(3000, 0.5)
    assert not Rows(np.cumsum(steps)).pauses.any()
    steps[[10, 2000]] = 20.0
    assert np.flatnonzero(Rows(np.cumsum(steps)).pauses).tolist() == [9, 1999]


def test_rows_that_are_left_out_are_said(tmp_path):
    t = np.arange(0.0, 4.0, 0.1)
    y = np.where((t < 0.45) | (t == t[20]), np.nan, np.cos(t))
    data = {"frame": pd.DataFrame({"t": t, "u": np.sin(t), "y": y}), "missing": "interpolate"}
    said = run("descriptor", data=data).verdict
    assert "; rows left out (data.missing=interpolate): 5, they are before the first" in said
    assert "cells filled" not in said


def test_functions_that_a_plant_has_for_its_inputs_do_not_count(tmp_path):
    """Neither a pole, nor a table that is too short, nor what changes so often that it takes long.

    But of an input that stands in a matrix as well.
    """
    t = np.linspace(0.0, 4.0, 11)
    data = {"t": t, "u": 2.0 + np.sin(t), "v": np.cos(t), "y": np.exp(-t)}
    file = write_table(tmp_path / "r.csv", data)
    short = {"file": write_table(tmp_path / "v.csv", {"t": t[:3], "v": t[:3]})}
    plant = one_state(B=[[1, 1]], unknowns={"a": 0}, F=[[1]])
    results = []
    for v in "0", "1/(t - 2) + 1e-9*sin(1e6*t)", short:
        given = {**plant, "inputs": {"u": "log(t)", "v": v}}
        results.append(run(given, data=file, estimator="least_squares", time={"samples": 5}))
        assert all(found.holds for found in check(given, data=file))
    for found in results[1:]:
        assert (found.estimates["a"] == results[0].estimates["a"]).all()
        assert found.verdict == results[0].verdict
    follows = {**plant, "A": [["-u"]], "inputs": {"u": "sin(t)", "v": "cos(t)"}}
    source = plant_from_mapping(follows).coefficients
    found = source.without_inputs
    assert found.taylor(np.ones(1), 1).u.tolist() == [[[np.sin(1.0), 0.0]], [[np.cos(1.0), 0.0]]]
    assert (found.taylor(np.ones(1), 0).A == source.taylor(np.ones(1), 0).A).all()


def test_a_column_that_is_read_for_several_signals_is_said():
    t = np.linspace(0.0, 4.0, 41)
    frame = pd.DataFrame({"t": t, "u": np.sin(t), "y": np.cos(t)})
    for columns in {}, {"u": "y"}:
        said = run("descriptor", data={"frame": frame, "columns": columns}).verdict
        assert ("; read for several signals: column y" in said) == bool(columns)


def test_cells_that_are_filled_have_no_error_of_their_own():
    """Where all outputs are missing; straight lines lead across as if the rows were not there."""
    t, rng = np.linspace(0.0, 8.0, 321), np.random.default_rng(0)
    made = run("descriptor", observer="none", time={"horizon": 8.0, "samples": 321})
    frame = pd.DataFrame({"t": t, "u": t, "y": made["y"] + 0.1 * rng.standard_normal(len(t))})
    frame.loc[(rng.random(len(t)) < 0.3) & (t > 0.0) & (t < 8.0), "y"] = np.nan
    filled, dropped = (
        run("descriptor", data={"frame": frame, "missing": policy}, estimator="least_squares")
        for policy in ("interpolate", "drop")
    )
    one, other = (each.details.estimation.states_std[0, -1] for each in (filled, dropped))
    np.testing.assert_allclose(one, other, rtol=1e-6)
    assert "cells filled" not in filled.verdict
    frame.loc[frame.index[frame["y"].notna()][50], "u"] = np.nan
    told = run("descriptor", data={"frame": frame, "missing": "hold"}).verdict
    assert "; cells filled (data.missing=hold): 1, which deviations take for measured" in told


@pytest.mark.parametrize(("hold", "told"), [
    ("zoh", "the last sample is held"), ("linear", "signals are interpolated"),
])
def test_pauses_are_said(hold, told, tmp_path):
    t = np.concatenate([np.arange(0.0, 2.0, 0.1), np.arange(5.0, 7.0, 0.1)])
    file = write_table(tmp_path / "r.csv", {"t": t, "u": np.sin(t), "y": np.cos(t)})
    said = run("descriptor", data={"file": file, "hold": hold}).verdict
    assert f"through 1 pause of up to 3.1 s {told}" in said


def test_errors_on_lines_have_the_steps_on_both_sides():
    """The corners of a hat over steps 1, 2 and 4 have the parts 1/4, 1/2 and 1/4."""
    rows, t = Rows(np.array([0.0, 1.0, 3.0, 7.0]), "linear"), np.array([0.5, 1.5, 5.0, 7.0])
    # At both ends there is no further step: that beside it counts once more.
    assert rows.intensities(t) == pytest.approx([1.25, 0.25 * (1.0 + 2.0 * 2.0 + 4.0), 3.5, 3.5])
    assert rows._replace(hold="zoh").intensities(t) == pytest.approx([1.0, 2.0, 4.0, 4.0])


def test_a_folder_and_too_many_cells_are_no_recording(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="is a folder, not a file"):
        run("circuit", data=tmp_path)
    (tmp_path / "b.parquet").write_bytes(b"PAR1")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pyarrow.parquet", None)
        with refused("b.parquet needs pyarrow: pip install 'gpebo[parquet]'"):
            run("circuit", data=tmp_path / "b.parquet")
    if not find_spec("pyarrow"):
        return
    frame = pd.DataFrame(stepped())
    frame.to_parquet(tmp_path / "a.parquet")
    monkeypatch.setattr("gpebo_cli.recordings.table._MOST_CELLS", frame.size - 1)
    with pytest.raises(ConfigError, match=f"has {frame.size} cells; at most {frame.size - 1} are"):
        run(STEPPED, data=tmp_path / "a.parquet")


def test_an_input_that_nobody_knows_is_a_state_without_an_equation():
    """x' = −x + dist, y = (x + dist, x), and 0 = x + dist − y₁ as an output that is zero."""
    t = np.linspace(0.0, 5.0, 101)
    x = (np.cos(t) + np.sin(t) + np.exp(-t)) / 2.0
    rows = {"t": t, "y1": x + np.cos(t), "y2": x, "u": -x - np.cos(t), "nothing": 0.0 * t}
    plant = {
        "name": "disturbed", "states": ["x", "dist"], "initial_state": [1, 1],
        "E": [[1, 0], [0, 0]], "A": [[-1, 1], [0, 0]],
    }
    for more in (
        {"outputs": ["y1", "y2"], "C": [[1, 1], [1, 0]]},
        {"outputs": ["nothing", "y2"], "C": [[1, 1], [1, 0]], "D": [[1], [0]],
         "inputs": {"u": "0"}, "B": [[0], [0]]},
    ):
        data = {"frame": pd.DataFrame(rows), "hold": "cubic"}
        result = run({**plant, **more}, data=data)
        for name, truth in (("x", x), ("dist", np.cos(t))):
            found = np.interp(4.0, result.estimates_t, result.estimates[name][0])
            assert found == pytest.approx(np.interp(4.0, t, truth), abs=1e-4)
        assert result.estimates["e0_x"][0, -1] == pytest.approx(-1.0, abs=1e-4)
