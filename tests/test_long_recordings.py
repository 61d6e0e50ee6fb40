"""Recordings with many more samples than results: elements and errors in groups change nothing."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from gpebo_cli import estimators, run
from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence import uncertainty
from gpebo_cli.evidence.excitation import assess
from gpebo_cli.evidence.groups import each_alone, grouped
from gpebo_cli.experiment import fit
from gpebo_cli.experiment.fit import _follows, _step, _varies_slowly
from gpebo_cli.findings import Requirement
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics import mesh
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.observers import Measurements, build, gpebo
from gpebo_cli.observers._base import SignalNoise
from gpebo_cli.observers.reduced import condensed, extension
from gpebo_cli.observers.reduced import system as reduced
from gpebo_cli.observers.reduced.regression import Assembled
from gpebo_cli.recordings.hold import held, recording_mesh
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression import linear
from gpebo_cli.regression.errors import ErrorSystem
from gpebo_cli.regression.estimator import Lasting, Unmixed
from gpebo_cli.regression.resets import ExtensionState
from gpebo_cli.settings import ExcitationSettings, SolverSettings
from tests.plants import one_state, shipped
from tests.processes import write_table
from tests.regressions import ETA, regression, three

STEP = {  # its A jumps, between samples and away from wanted times
    "name": "steps", "states": ["x1", "x2"], "inputs": {"u": 0}, "unknowns": {"a": 1},
    "outputs": ["y", "z"], "E": [[1, 0], [0, 0]],
    "A": [["-1 - step(t - 1.2345)", 1], [1, -2]], "B": [[1], [0]], "F": [["cos(t)"], [0]],
    "C": [[1, 0], [0, 1]], "initial_state": {"x1": 1, "x2": 0},
}
FAST = {**STEP, "name": "fast", "A": [[-90, 80], [1, -2]], "B": [[0], [1]]}
PLANTS = {"steps": STEP, "fast": FAST}
TIMES = np.linspace(0.0, 10.0, 41)


def rough(system, hold, rows=700, horizon=4.0):
    """Uneven samples of a rough signal, as an observer sees them."""
    rng = np.random.default_rng(0)
    t = np.sort(np.append(rng.uniform(0.0, horizon, rows - 2), [0.0, horizon]))
    values = rng.standard_normal((rows, system.m + system.r)) + np.sin(t)[:, None]
    mesh = recording_mesh(t, values, hold, (0.0, horizon), system.coefficients, 1e-10)
    both = mesh.along(held(t, values, hold)).values
    signals = (Trajectory(mesh, part) for part in np.split(both, [system.m], axis=2))
    return Measurements(*signals)


@pytest.mark.parametrize(("hold", "at_once"), [("linear", 50), ("zoh", 8192)])
@pytest.mark.parametrize("name", ["circuit", "descriptor", "strangeness_free", "steps", "fast"])
def test_the_long_elements_of_a_regression_keep_what_the_short_ones_say(
    name, hold, at_once, monkeypatch
):
    """G, h, the misfit and x at the wanted times, of signals that no long element resolves."""
    monkeypatch.setattr(condensed, "_AT_ONCE", at_once)
    system = plant_from_mapping(PLANTS[name], name) if name in PLANTS else shipped(name)
    signals, wanted = rough(system, hold), np.linspace(0.0, 4.0, 23)
    whole, few = (
        build({"name": "gpebo"}).observe(system, each, SolverSettings())
        for each in (signals, replace(signals, wanted=wanted))
    )
    assert few.regression.mesh.size < whole.regression.mesh.size / 3
    assert few.regression.parameters == whole.regression.parameters
    before, after = whole.regression.gram(wanted), few.regression.gram(wanted)
    np.testing.assert_allclose(after, before, atol=1e-8 * np.abs(before).max())
    for part in ("offset", "gain"):
        before, after = (getattr(each.state_map, part)(wanted) for each in (whole, few))
        np.testing.assert_allclose(after, before, atol=1e-8 * np.abs(before).max())
    at, eta = signals.mesh.edges[:-1], np.ones(whole.regression.p)
    residual = whole.regression.Y(at) - whole.regression.psi(at) @ eta
    rms = np.sqrt((residual**2).sum(axis=1).mean())
    assert np.sqrt(few.regression.misfit(eta) / 4.0) == pytest.approx(rms, rel=1e-8)


@pytest.mark.parametrize("name", ["gpebo", "kalman_bucy"])
def test_the_error_of_what_all_rows_add_is_in_the_estimate(name, monkeypatch):
    driven, system = condensed.driven, plant_from_mapping(STEP)
    noise = SignalNoise(np.zeros(1), np.full(2, 0.1), 0.01)
    signals = replace(
        rough(system, "linear", rows=300), noise=noise, wanted=np.linspace(0.0, 4.0, 5)
    )
    monkeypatch.setattr(condensed, "driven", lambda *a, **k: (*driven(*a, **k)[:2], 0.125))
    found = build({"name": name}).observe(system, signals, SolverSettings())
    assert found.error_estimate == 0.125


def test_a_long_recording_is_thinned_to_lines_between_wanted_times_and_where_matrices_jump():
    system, solver = plant_from_mapping(STEP), SolverSettings()
    signals = rough(system, "linear", rows=300)
    wanted = signals.mesh.edges[[20, 100, 201]]
    few = condensed.thinned(system, replace(signals, wanted=wanted), solver)
    assert few.mesh.edges.tolist() == sorted([0.0, *wanted, 1.2345, 4.0])
    both = few.at(few.mesh.edges)
    np.testing.assert_allclose(both, signals.at(few.mesh.edges), atol=1e-12)
    middle = few.at(0.5 * (few.mesh.edges[1:] + few.mesh.edges[:-1]))
    np.testing.assert_allclose(middle, 0.5 * (both[1:] + both[:-1]), atol=1e-12)
    count = signals.mesh.size // 8
    derivatives = InputDerivatives.of_plant(system, np.ones(1, dtype=bool))
    battery = shipped("battery")
    for plant, changes in (
        (system, {"wanted": None}), (system, {"wanted": np.linspace(0.0, 4.0, count + 1)}),
        (system, {"wanted": wanted, "derivatives": derivatives}), (battery, {"wanted": wanted}),
    ):
        assert condensed.thinned(plant, replace(signals, **changes), solver) is None
    most = replace(signals, wanted=np.linspace(0.0, 4.0, count))
    assert condensed.thinned(system, most, solver) is not None


@pytest.mark.parametrize("hold", ["linear", "zoh"])
def test_where_states_have_bounds_the_map_is_kept_at_all_rows(hold):
    system = plant_from_mapping(STEP)
    signals, wanted = rough(system, hold), np.linspace(0.0, 4.0, 23)
    whole, few = (
        build({"name": "gpebo", "bounds": {"states": {"x1": [-9.0, 9.0]}}}).observe(
            system, each, SolverSettings()
        ).state_map for each in (signals, replace(signals, wanted=wanted))
    )
    assert set(signals.mesh.edges) | set(wanted) <= set(few.offset.t)
    inside = np.minimum(few.offset.t + 1e-9, 4.0)
    for part in ("offset", "gain"):
        expected = getattr(whole, part)(few.offset.t, inside)
        np.testing.assert_allclose(
            getattr(few, part)(few.offset.t), expected, atol=1e-8 * np.abs(expected).max()
        )


@pytest.mark.parametrize(
    ("rate", "size", "interpolated"), [(1.0, 2, True), (60.0, 2, False), (1.0, 40, False)]
)
def test_a_system_of_errors_is_interpolated_where_it_is_small_and_the_mesh_resolves_it(
    rate, size, interpolated
):
    asked, long = [], mesh.initial_mesh(0.0, 2.0, [], 4, radau_rule(9))

    def errors(t, inside):
        asked.append(t)
        A = np.sin(rate * t)[:, None, None] + np.arange(size**2).reshape(size, size)
        return ErrorSystem(A, np.ones((1, size, 3)), 2.0 * A[:, :1], np.zeros((1, 1, 3)))

    t = np.linspace(0.0, 2.0, 41)
    for found, expected in zip(
        condensed._interpolated(errors, long, 1e-10)(t, t), errors(t, t), strict=True
    ):
        np.testing.assert_allclose(found + 0.0 * expected, expected + 0.0 * found, atol=1e-9)
    assert len(asked) == (2 if interpolated else 3)


@pytest.mark.parametrize(("plant", "horizon"), [("battery", 60.0), ("motor", 0.1)])
@pytest.mark.parametrize("estimator", ["mre", {"name": "least_squares", "f0": 1e-6}])
def test_a_long_mesh_is_solved_window_by_window(plant, horizon, estimator, monkeypatch):
    """Where matrices follow signals: the same numbers, and an error estimate of the same size.

    What is said of the assumptions is the same, too: of Φ both ends are kept.
    """
    made = run(plant, observer="none", time={"horizon": horizon, "samples": 151})
    names = [*made.inputs, *made.outputs]
    rng = np.random.default_rng(0)
    data = {"t": made.t, **{
        name: made[name] + 0.01 * made[name].std() * rng.standard_normal(151) for name in names
    }}
    results = []
    for window in (10**6, 16):
        monkeypatch.setattr(mesh, "_WINDOW", window)
        monkeypatch.setattr(gpebo, "_LONG", 2 * window)
        results.append(run(plant, data=data, estimator=estimator, time={"samples": 31}).details)
    whole, windows = (
        np.concatenate([each.estimation.parameters[0], each.estimation.states[0]], axis=1)
        for each in results
    )
    size = np.abs(whole).max(axis=0)
    np.testing.assert_allclose(windows / size, whole / size, rtol=0.0, atol=1e-8)
    found = [each.regression.error_estimate for each in results]
    assert found[0] / 10 < found[1] < 10 * found[0]
    one, other = ({
        (a.name, key): value for a in each.assumptions for key, value in a.evidence.items()
        if isinstance(value, float)
    } for each in results)
    assert other == pytest.approx(one, rel=1e-6)


def test_windows_together_have_the_largest_errors_and_sizes_of_each():
    """And the weakest singular value; the terms of ψ are as large as they were so far."""
    def part(start, error, size, weakest):
        made = mesh.initial_mesh(start, start + 1.0, [], 1, radau_rule(2))
        signals = [np.full((3, *shape), size) for shape in ((1,), (1, 2), (2,), (2, 2))]
        found = Assembled(
            *signals, size, np.array([size, 2.0]), np.array([[size, 1.0, 3.0 - size]]),
            np.array([[3.0 - size, 1.0], [0.0, size]]),
        )
        z = Trajectory(made, np.full((1, 3, 1, 3), size))
        return extension.Extension(z, error, found, np.array([[size, 2.0]]), (weakest, start))

    whole = extension.joined([
        part(0.0, 0.5, 1.0, 0.3), part(1.0, 0.25, 2.0, 0.1), part(2.0, 0.125, 0.5, 0.2),
    ])
    found = whole.assembled
    assert (whole.error_estimate, whole.weakest, found.Y_scale) == (0.5, (0.1, 1.0), 2.0)
    assert whole.mesh.edges.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert whole.scale.tolist() == [[1.0, 2.0], [2.0, 2.0], [2.0, 2.0]]
    assert found.column_scale.tolist() == [2.0, 2.0]
    assert found.largest.tolist() == [[2.0, 1.0, 2.5]]
    assert found.moving.tolist() == [[2.5, 1.0], [0.0, 2.0]]
    for values in (whole.trajectory.values, found.Y, found.psi, found.offset, found.gain):
        assert values.reshape(3, -1).min(axis=1).tolist() == [1.0, 2.0, 0.5]


@pytest.mark.parametrize("size", [3, 4, 8, 9, 11])
def test_times_are_shared_out_to_the_windows_they_are_in(size, monkeypatch):
    """Of four elements of one second each, the last one of what is left; from t = 5."""
    monkeypatch.setattr(mesh, "_WINDOW", 4)
    whole = Mesh(np.arange(size + 1.0), radau_rule(3), 5.0)
    t = 5.25 + 0.5 * np.arange(2 * size)
    shares = list(whole.shares(t))
    assert [len(share) for share in shares] == [2 * window.size for window in whole.windows()]
    for share, window in zip(shares, whole.windows(), strict=True):
        assert window.span[0] < share[0] <= share[-1] < window.span[1]


@pytest.mark.parametrize(("observer", "estimator"), [
    ("kalman_bucy", "ls_drem"),
    *(({"name": "gpebo", "remedy": "current_coordinates"}, e) for e in (
        "drem", "mre", "gradient", "least_squares", {"name": "least_squares", "f0": [0.1, 1.0]},
    )),
    ("gpebo", {"name": "fct", "mu": [0.1, 0.3]}),  # side by side
])
def test_a_long_filter_runs_window_by_window(observer, estimator, monkeypatch):
    """That of a window goes on where the one before has ended."""
    made = run("descriptor", observer="none", time={"horizon": 6.0, "samples": 151})
    names, rng = [*made.inputs, *made.outputs], np.random.default_rng(0)
    data = {"t": made.t, **{name: made[name] + 0.01 * rng.standard_normal(151) for name in names}}
    found, errors = [], []
    for window in (10**6, 16):
        monkeypatch.setattr(mesh, "_WINDOW", window)
        monkeypatch.setattr(linear, "_WINDOW", window)
        details = run(
            "descriptor", data=data, observer=observer, estimator=estimator, time={"samples": 31}
        ).details
        made = details.estimation
        assert details.regression.error_estimate < 1e-6
        errors.append(details.regression.error_estimate)
        reached = made.requirement.evidence.values() if observer != "kalman_bucy" else ()
        found.append(
            [made.parameters, made.states, made.parameters_std, made.states_std, *reached]
        )
    for windows, whole in zip(found[1], found[0], strict=True):
        if whole is not None:
            np.testing.assert_allclose(windows, whole, rtol=2e-7, atol=1e-11)
    assert errors[0] / 10 < errors[1] < 10 * errors[0]


@pytest.mark.parametrize("name", ["descriptor", "steps"])
def test_a_filter_runs_on_long_elements_and_follows_every_sample(name):
    """Its P does not depend on signals that no long element resolves, and ζ̂ is linear in them."""
    system = plant_from_mapping(PLANTS[name], name) if name in PLANTS else shipped(name)
    signals, wanted = rough(system, "linear", rows=300), np.linspace(0.0, 4.0, 23)
    noise = SignalNoise(np.full(system.m, 0.1), np.full(system.r, 0.3), 0.01)
    whole, few = (
        build({"name": "kalman_bucy"}).observe(system, each, SolverSettings()).state_map
        for each in (replace(signals, noise=noise), replace(signals, noise=noise, wanted=wanted))
    )
    assert few.filtered.mesh.size < whole.filtered.mesh.size / 3
    for one, other in zip(few.filtered.at(wanted), whole.filtered.at(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-8 * np.abs(other).max())
    for k in (0, 1):  # offset and gain
        found, expected = (each.filtered.extras[k](wanted) for each in (few, whole))
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_windows_measure_what_has_decayed_by_the_size_it_had(monkeypatch):
    """The battery's Φ loses eight orders: resolved for itself, it would take a finer mesh."""
    signals = rough(shipped("battery"), "linear", horizon=600.0)
    found = []
    for window in (10**6, 64):
        monkeypatch.setattr(mesh, "_WINDOW", window)
        observer = build({"name": "gpebo"})
        found.append(observer.observe(shipped("battery"), signals, SolverSettings()).regression)
    whole, windows = found
    assert whole.mesh.size <= windows.mesh.size < 1.1 * whole.mesh.size
    np.testing.assert_allclose(windows.gram.final, whole.gram.final, rtol=1e-8)
    np.testing.assert_allclose(windows.scale[-1], whole.scale[-1], rtol=1e-8)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_samples_in_groups_have_the_deviations_of_each_alone(hold, tmp_path, monkeypatch):
    """Of two files, whose errors begin anew; the battery's ψ bends at every sample."""
    rng = np.random.default_rng(0)
    made = run("battery", observer="none", time={"horizon": 600.0, "samples": 501})
    (u,), (y,) = made.inputs, made.outputs
    files = []
    for k, rows in enumerate((1500, 1550)):
        t = np.linspace(0.0, 600.0, rows)
        table = [t, np.interp(t, made.t, made[u]), np.interp(t, made.t, made[y])]
        table[2] = table[2] + 0.05 * rng.standard_normal(rows)
        files.append(tmp_path / f"{k}.csv")
        np.savetxt(files[-1], np.transpose(table), delimiter=",", header=f"t,{u},{y}", comments="")
    found = []
    for groups in (150, 10**9):
        monkeypatch.setattr(uncertainty, "_GROUPS", groups)
        result = run(
            "battery", data={"file": list(map(str, files)), "hold": hold}, time={"samples": 31},
            estimator="least_squares",
        )
        found.append(result.details.estimation)
    for part in ("parameters_std", "states_std"):
        groups, alone = (getattr(each, part)[0] for each in found)
        np.testing.assert_allclose(groups, alone, rtol=1e-2, atol=1e-2 * alone.max())
        assert not np.array_equal(groups, alone, equal_nan=True)


def test_a_bend_at_a_sample_within_a_group_is_no_edge():
    """Edges elsewhere, such as a jump of the matrices, stay."""
    samples, jump = np.linspace(0.0, 100.0, 20_001), 12.3456
    edges = np.sort(np.append(samples, jump))
    rows = Rows(samples)
    groups = grouped(rows, 100.0, np.array([50.0]), np.zeros(1), 20, 16)
    assert [found.alone for found in (groups, each_alone(rows, np.zeros(1)))] == [False, True]
    mesh = uncertainty._mesh(edges, groups, edges[:1])
    fresh = np.diff(uncertainty._group_of(mesh, groups.starts), prepend=-1) > 0
    expected = np.union1d(groups.starts, [jump, 100.0])
    late = mesh.edges > 4.0  # before, elements are shorter than groups
    np.testing.assert_array_equal(mesh.edges[late], expected[expected > 4.0])
    assert mesh.size < 1500
    np.testing.assert_array_equal(mesh.edges[:-1][fresh], groups.starts)


def test_after_each_start_samples_are_in_groups_as_after_the_first():
    """They grow with the rows since it, and begin at the rows of the start and of those asked."""
    rows, halves = Rows(np.linspace(0.0, 100.0, 20_001)), np.array([0.0, 50.0])
    starts = grouped(rows, 100.0, np.array([25.0, 75.0]), halves, 20, 16).starts
    first, second = np.split(starts, [np.searchsorted(starts, 50.0)])
    assert {25.0, 50.0, 75.0} <= set(starts.tolist())
    assert np.diff(first).max() > 10 * np.diff(first).min()
    np.testing.assert_allclose(second[: len(first)] - 50.0, first, atol=1e-9)


def test_samples_on_both_sides_of_a_pause_begin_groups():
    """Of them the step over it is one group's own, and none has rows before and behind it."""
    t = np.linspace(0.0, 100.0, 20_001)
    rows = Rows(t[(t <= 40.003) | (t >= 60.002)])
    after = int(np.searchsorted(rows.t, 50.0))
    assert np.flatnonzero(rows.pauses).tolist() == [after - 1]
    starts = grouped(rows, 100.0, np.array([100.0]), np.zeros(1), 20, 16).starts
    assert set(rows.t[after - 1 : after + 1].tolist()) <= set(starts.tolist())
    assert len(starts) < 0.1 * len(rows.t)


@pytest.mark.parametrize("rows", [None, Rows(TIMES), Rows(TIMES, "linear")])
def test_what_outputs_miss_between_rows_is_that_of_the_hold(rows):
    """A held value is off y = 3t by √(∫(3τ)²/h) = 3h/√3, and a line off y = t² by h²/4 at most."""
    source, h = SimpleNamespace(rows=rows), TIMES[1]
    lines = rows is not None and rows.lines
    far = fit._missed(TIMES, np.stack([3.0 * TIMES, TIMES**2], axis=1), source)
    assert far[0] == pytest.approx(0.0 if lines else 3.0 * h / np.sqrt(3.0), abs=1e-12)
    if lines:
        assert far[1] == pytest.approx(0.25 * h**2)


TANKS = {
    "name": "tanks", "states": ["h1", "h2", "q"], "inputs": {"u": "0.2 + 0.05*sin(t/200)"},
    "unknowns": {"leak": 4e-5, "gain": 9.3e-4}, "outputs": ["level"],
    "E": [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
    "A": [[-0.004, 0, 0], [0.004, -0.003, 0], [0, 3, -1]], "F": [[-1, "u"], [0, 0], [0, 0]],
    "C": [[0, 1, 0]], "initial_state": {"h1": 0.03, "h2": 0.05, "q": 0.15},
}


def test_a_rate_that_is_wrong_by_a_twentieth_is_noticed_and_the_right_one_is_not():
    """Both unknowns make up for most of it: the residual grows by 1 %, but slowly varying."""
    made = run(TANKS, observer="none", time={"horizon": 2e4, "samples": 3001})
    level = made["level"] + 5e-4 * np.random.default_rng(0).standard_normal(3001)
    noise = {"name": "gaussian", "outputs": 5e-4}
    wrong = {**TANKS, "A": [[-0.004, 0, 0], [0.004, -0.00315, 0], [0, 3, -1]]}
    said = [
        run(plant, data={"t": made.t, "u": made["u"], "level": level}, noise=noise).verdict
        for plant in (TANKS, wrong)
    ]
    assert "up to white noise" in said[0]
    assert "is not white" in said[1]


def test_what_is_made_of_a_recording_is_forecast(monkeypatch, tmp_path):
    """A plant that follows what is measured keeps every sample, and a machine must not swap."""
    t = np.linspace(0.0, 40.0, 2001)
    data = {"t": t, "current": 2.0 + np.sin(t), "v": 3.7 - 0.03 * np.sin(t)}
    monkeypatch.setattr("gpebo_cli.errors._MOST", 0.005)
    with pytest.raises(ConfigError, match=r"2000 samples would take some 0.00\d* GB .*; "
                       r"time.horizon=20.8 fits, and .* \(data.file=- < FILE\)$"):
        run("battery", data=data)
    run("battery", data=data, time={"horizon": 20.5})
    # The filter holds more where all of it is compared, and so do several files together.
    known = {**data, "v1": 0.0 * t}
    with pytest.raises(ConfigError, match=r"time\.horizon=2.98 fits"):
        run("battery", data=known, observer="kalman_bucy", time={"horizon": 20.5})
    table = np.column_stack([data["t"], data["current"], data["v"]])[:1026]
    files = [str(tmp_path / name) for name in ("a.csv", "b.csv")]
    for file in files:
        np.savetxt(file, table, delimiter=",", header="t,current,v", comments="")
    # Each is there beside the other, and none beside itself.
    monkeypatch.setattr("gpebo_cli.errors._MOST", 0.002)
    needs = []
    for file in files[0], files:
        with pytest.raises(ConfigError, match="1025 samples would take some") as refusal:
            run("battery", data={"file": file})
        needs.append(float(str(refusal.value).partition("some ")[2].split()[0]))
    assert needs[1] == pytest.approx(2.0 * needs[0], rel=0.01)
    # Those that go on from window to window are there each by itself and, wider, all together; in
    # current coordinates there are dynamics beside the regression.
    monkeypatch.setattr(gpebo, "_LONG", 32)
    monkeypatch.setattr("gpebo_cli.errors._MOST", 2e-3)
    given = {"data": data, "time": {"samples": 41}, "estimator": "least_squares"}
    with pytest.raises(ConfigError, match=r"would take some 0\.00267 GB .*horizon=30 fits"):
        run("battery", **given, observer={"remedy": "current_coordinates"})
    monkeypatch.setattr("gpebo_cli.errors._MOST", 5e-4)
    sizes = []
    for some in (files[:1], files):
        with pytest.raises(ConfigError, match="would take some") as told:
            run("battery", data={"file": some}, time={"samples": 41})
        sizes.append(float(str(told.value).split("some ")[1].split(" GB")[0]))
    assert 4.0 < sizes[1] / sizes[0] < 8.0


def test_the_residual_of_two_long_files_is_that_of_their_rows(tmp_path):
    """Least squares of y = e^-t x(0) + e by NumPy, of each file by itself."""
    t, noise, files, left = np.linspace(0.0, 5.0, 401), np.random.default_rng(0), [], []
    for k in range(2):
        y = 3.0 * np.exp(-t) + 0.1 * noise.standard_normal(401)
        files.append(write_table(tmp_path / f"{k}.csv", {"t": t, "y": y}))
        psi = np.exp(-t[:, None])
        left.append(y - psi @ np.linalg.lstsq(psi, y)[0])
    plant = one_state(A=[[-1]])
    for data in files[:1], files:
        found = run(plant, data=data, estimator="least_squares", time={"samples": 5}).details.fit
        assert found.residual == pytest.approx([np.std(left[: len(data)])], rel=0.01)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_noise_of_two_files_is_white_however_many_times_are_asked_for(hold, tmp_path):
    """Ten to a row and more, where what is held or interpolated between two rows is alike.

    The rows of one file are farther apart.
    """
    noise, files = np.random.default_rng(0), []
    for rows in 81, 41:
        t = np.linspace(0.0, 4.0, rows)
        y = 3.0 * np.exp(-t) + 0.1 * noise.standard_normal(rows)
        files.append(write_table(tmp_path / f"{rows}.csv", {"t": t, "y": y}))
    found = run(one_state(A=[[-1]]), data={"file": files, "hold": hold},
                estimator="least_squares", time={"samples": 1601})  # fmt: skip
    assert found.details.fit.white
    assert found.details.fit.lag >= 2.0 * t[1]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_to_what_an_output_is_rounded_is_no_question_of_its_sign(sign):
    y = sign * np.repeat([3.0, 3.1, 3.2, 3.1, 3.4], 5)
    assert _step(y) == pytest.approx(0.1)
    assert _step(y + 0.01 * np.sin(np.arange(25.0) ** 2)) == 0.0


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_the_level_of_the_noise_is_that_of_the_rows_whatever_makes_elements_many(hold, tmp_path):
    """Functions of time do, whose cells are shorter than steps between rows."""
    t = np.linspace(0.0, 4.0, 41)
    y = np.exp(-t) + 0.1 * np.random.default_rng(0).standard_normal(41)
    data = {"file": write_table(tmp_path / "r.csv", {"t": t, "y": y}), "hold": hold}
    few, many = (
        run(one_state(phi=[phi]), data=data, estimator="least_squares", time={"samples": 5})
        for phi in ("0", "1e-13*sin(300*t)")
    )
    assert many.details.recording.elements >= 4 * few.details.recording.elements
    one, other = (each.details.estimation.states_std[0, -1] for each in (few, many))
    assert other == pytest.approx(one, rel=1e-9)


def test_an_estimator_without_its_map_is_refused_before_a_file_is_read():
    with pytest.raises(ConfigError, match="monotone is for a regression with S and box"):
        run("battery", data={"file": "nowhere.csv"}, estimator="monotone")


def test_a_slow_misfit_far_below_the_noise_is_told_and_white_noise_is_not():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((300, 1000, 2))
    wave = 0.25 * np.sin(np.linspace(0.0, 12.0, 1000))[:, None]
    assert np.mean([_varies_slowly(e) for e in white]) < 0.04
    for misfit in (wave, 0.13):
        assert np.mean([_varies_slowly(e + misfit) for e in white]) > 0.9


def test_what_follows_an_input_far_below_the_noise_is_told_and_white_noise_does_not():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((100, 10_000, 2))
    fast = np.sin(0.4 * np.arange(10_000))
    inputs = np.stack([fast, np.ones(10_000), rng.standard_normal(10_000)], axis=1)
    late = 0.1 * np.roll(fast, 7)[:, None]
    assert np.mean([_follows(e, inputs) for e in white]) < 0.03
    assert np.mean([_follows(e + late, inputs) for e in white]) > 0.9
    assert np.mean([_varies_slowly(e + late) for e in white]) < 0.1
    assert not _follows(white[0] + late, inputs[:, 1:2])
    assert not _follows(white[0] + late, inputs[:, :0])


@pytest.mark.parametrize("outputs", [1, 3])
def test_white_noise_is_taken_for_a_misfit_as_often_as_is_asked_for(outputs, monkeypatch):
    """Once in twenty times, by what follows an input, in any unit, and by the mean of few."""
    monkeypatch.setattr(fit, "_RARE", 0.05)
    rng = np.random.default_rng(0)
    white, inputs = rng.standard_normal((500, 160, outputs)), rng.standard_normal((160, 2))
    follows = [_follows(e, inputs) for e in white]
    assert 0.03 < np.mean(follows) < 0.07
    assert follows[:50] == [_follows(e + 9.0, [1e-6, 1e3] * inputs + 1e-3) for e in white[:50]]
    assert 0.03 < np.mean([_varies_slowly(e[:24]) for e in white]) < 0.1


@pytest.mark.parametrize(("count", "told"), [(13, False), (14, True)])
def test_fewer_samples_than_inputs_explain_say_nothing(count, told):
    """Three inputs, now and one sample ago, and the mean: 7 numbers, with 5 or 6 left for noise."""
    rng = np.random.default_rng(0)
    inputs = rng.standard_normal((count, 3))
    residual = inputs[:, :1] + 1e-3 * rng.standard_normal((count, 1))
    assert _follows(residual, inputs) == told


def test_a_rate_that_is_five_percent_off_follows_the_input():
    right, wrong = (one_state(A=[[a]], B=[[1]], inputs={"u": "sin(3*t)"}) for a in (-1.0, -1.05))
    made = run(right, observer="none", time={"samples": 2001})
    noise = 0.02 * np.random.default_rng(1).standard_normal(2001)
    data = {"t": made.t, **made.inputs, "y": made["y"] + noise}
    assert run(right, data=data, estimator="least_squares").details.fit.white
    said = run(wrong, data=data, estimator="least_squares").verdict
    assert "is not white (its correlation is" in said
    assert "it follows the inputs), which suggests" in said
    silent = {"t": made.t, **made.inputs, "y": made["y"]}  # less is left than y changes by
    said = run(wrong, data={k: x[::40] for k, x in silent.items()}, estimator="ls_drem").verdict
    assert "(data.hold), or a missing or wrong parameter" in said


def test_what_a_sensor_shows_too_much_at_all_times_is_told():
    """Six deviations of the mean, a fifth of the noise of one sample."""
    plant = one_state(A=[[-1]], phi=["sin(t)"])
    made = run(plant, observer="none", time={"samples": 1001})
    noise = 0.05 * np.random.default_rng(1).standard_normal(1001)
    for offset, white in ((0.0, True), (0.01, False)):
        data = {"t": made.t, "y": made["y"] + noise + offset}
        result = run(plant, data=data, estimator="least_squares")
        assert result.details.fit.white is white


def test_noise_in_the_matrices_is_named_and_may_be_taken_out():
    """The output stands in A: the plant is right, and the residual is not white.

    Along a copy without noise it is, and there are deviations; and a plant that is wrong is told.
    """
    made = run("duffing", observer="none", time={"horizon": 15.0, "samples": 601})
    noise = 0.05 * np.random.default_rng(0).standard_normal(601)
    data = {"t": made.t, **made.inputs, "position": made["position"] + noise}
    plain = run("duffing", data=data, estimator="least_squares").verdict
    assert "is not white" in plain
    assert "which noise of position in the matrices does (observer.remedy=noise_free takes" in plain
    given = {"data": data, "estimator": "least_squares", "observer": {"remedy": "noise_free"}}
    clean = run("duffing", **given)
    assert "explain the data up to white noise" in clean.verdict
    e = clean.details.estimation
    assert (np.abs(e.parameters[0, -1, :2] - [-1, 1]) < 3.0 * e.parameters_std[0, -1, :2]).all()
    wrong = run(shipped("duffing", A=[[0, 1], [0, -0.2]]), **given).verdict  # damping is 0.3
    assert "is not white" in wrong
    assert "in the matrices" not in wrong


def test_at_samples_estimates_are_as_far_from_least_squares_as_in_continuous_time():
    """Of parameters and of states at the end, which a drift has moved since the start."""
    given = {"estimator": "gradient", "gamma": 1e-3, "time": {"samples": 201}}
    found = [
        run("battery", observer=observer, **given).details.estimation.doubts[0]
        for observer in ({}, {"sample_time": 0.05})
    ]
    assert found[1] == pytest.approx(found[0], rel=0.05, abs=1e-3)
    assert max(found[0].values()) > 0.5


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.1}])
def test_a_law_that_is_not_done_is_no_fault_of_the_model(observer):
    """Least squares of the same data explain them; what γ leaves is not a sensor that fails."""
    made = run("battery", observer="none", time={"horizon": 20.0, "samples": 201})
    noise = 1e-3 * np.random.default_rng(0).standard_normal(201)
    data = {"t": made.t, **made.inputs, "v": made["v"] + noise}
    given = {"data": data, "observer": observer}
    least = run("battery", estimator="least_squares", **given)
    slow = run("battery", estimator="gradient", gamma=1e-3, **given)
    told = f"least squares of the same data leave {least.details.fit.least:.2g}: what is left says"
    assert told in slow.verdict
    assert "suggests" not in slow.verdict
    assert "least squares of" not in least.verdict


def test_an_output_that_is_used_up_for_a_state_is_no_residual():
    """The circuit's iv is y less il: rounding is left, in which no pattern means anything."""
    made = run("circuit", observer="none", time={"samples": 401})
    noisy = made["y"] + 0.02 * np.random.default_rng(0).standard_normal(401)
    data = {"t": made.t, "V": made["V"], "y": noisy}
    for level, wrong in ((0.02, False), (0.001, True)):
        result = run("circuit", data=data, noise={"name": "gaussian", "outputs": level})
        assert result.details.fit.correlation is None
        assert ("suggests" in result.verdict) == wrong
        assert 0.5 < result.details.fit.ratio * level / 0.02 < 3.0
    without = run("circuit", data=data, uncertainty=False)
    assert without.details.estimation.parameters_std is None


@pytest.mark.parametrize("settings", [
    {"name": "least_squares"}, {"name": "least_squares", "beta": 0.3}, {"name": "gradient"},
    {"name": "ls_drem"}, {"name": "drem", "gamma": [1e2, 1e4]}, {"name": "mre"}, {"name": "lion"},
    {"name": "fct", "gamma": [1e2, 1e4]}, {"name": "fct", "extension": "least_squares"},
    {"name": "power", "gamma": 10.0}, {"name": "exciting", "kappa": 1e3},
    {"name": "instrumental", "gamma": [1e2, 1e4]}, {"name": "annihilator", "perturbed": ["p1"]},
], ids=str)
def test_estimators_and_evidence_go_on_from_window_to_window(settings, monkeypatch):
    """Nothing tells where a long regression was cut: estimates, deviations, excitation, misfit."""
    signal, t = regression(three, ETA, disturbance=lambda t: 0.1 * np.sin(9.0 * t)), TIMES
    t = t[(t < 3.0) | (t > 6.0)]  # some windows have none
    estimator, looked = estimators.build(settings), ExcitationSettings(rho=1.0)
    found = []
    for window in (1 << 12, 17):
        monkeypatch.setattr(linear, "_WINDOW", window)
        own = replace(signal)
        assert own.long == (window == 17)
        made = estimators.estimate(estimator, own, t, t[5:30])
        seen = assess(own, t, looked)
        numbers = [
            made.parameters(slice(None)), made.delta(t[5:30:3]), seen.pe_level,
            seen.known.eigenvalues, seen.gram_eigenvalues, seen.t_c, seen.lambda_min,
            own.misfit(0.9 * ETA),
            *made.requirement.evidence.values(),
        ]
        if isinstance(estimator, estimators.Affine):
            for at, _ in estimators.errors(estimator, own):
                numbers += [np.broadcast_to(x, (len(t), *x.shape[1:])) for x in at(t, t)]
        found.append([np.array(x, dtype=float) for x in numbers if x is not None])
    for whole, cut in zip(*found, strict=True):
        np.testing.assert_allclose(cut, whole, rtol=1e-9, atol=1e-11 * np.nanmax(np.abs(whole)))


def test_an_estimator_of_ones_own_goes_on_from_window_to_window(monkeypatch):
    """What it needs to say so is one method, and that its estimates know what was before them."""

    @dataclass(frozen=True)
    class Sum(Unmixed, Lasting):
        sums: Trajectory
        t: np.ndarray

        @property
        def reached(self):
            return (ExtensionState(self.sums.final, 0.0),)

        @property
        def requirement(self):
            return Requirement("none", True, {"sum": float(self.sums.final.sum())}, "")

        def parameters(self, cases, start=None):
            return self.sums(self.t)[None, :, -1][cases]

    class Adding:
        cases = ({},)

        def estimate(self, regression, t):
            return self.go_on(regression, t, ())

        def go_on(self, regression, t, known):
            sums = regression.gram.values + (known[0].values if known else 0.0)
            return Sum(Trajectory(regression.mesh, sums), t)

    found = []
    for window in (1 << 12, 17):
        monkeypatch.setattr(linear, "_WINDOW", window)
        made = estimators.estimate(Adding(), regression(three, ETA), TIMES)
        assert isinstance(made, Sum) == (window > 17)
        found.append([made.parameters(slice(None)), made.requirement.evidence["sum"]])
    for whole, cut in zip(*found, strict=True):
        np.testing.assert_allclose(cut, whole, rtol=1e-12, atol=1e-12)


def test_windows_keep_an_extension_everywhere_where_all_of_it_is_asked_for(monkeypatch):
    """An e₀ that varies with θ is made of it at any time."""
    plant, found, t, before = shipped("circuit"), [], TIMES / 50.0, []
    next_window = extension._Monitor.next_window
    monkeypatch.setattr(extension._Monitor, "next_window", lambda monitor, size: (
        next_window(monitor, size), before.append((size, len(monitor._past[0])))
    )[0])
    signals = rough(plant, "linear", 40, 0.8)
    for window in (10**6, 16):
        monkeypatch.setattr(mesh, "_WINDOW", window)
        made = build({"name": "gpebo"}).observe(plant, signals, SolverSettings())
        found.append(made.truth.extension(t))
    (elements, first), *_, (_, last) = before
    assert max(first, last) < elements / 2  # what stands in front of a window does not pile up
    np.testing.assert_allclose(found[1], found[0], atol=1e-9 * np.abs(found[0]).max())


def test_memory_is_at_least_that_of_the_map_from_all_parameters_to_all_states(monkeypatch):
    plant = plant_from_mapping({  # of which η are four initial errors
        "name": "four", "states": ["a", "b", "c", "e"], "outputs": ["y"], "E": np.eye(4).tolist(),
        "A": (-np.eye(4)).tolist(), "C": [[1, 1, 1, 1]], "initial_state": [0, 0, 0, 0],
    })
    signals = rough(plant, "linear", 40, 0.1)
    signals = replace(signals, wanted=signals.mesh.edges)
    least = 8e-9 * signals.mesh.points.size * 4 * plant.n
    monkeypatch.setattr("gpebo_cli.errors._MOST", least)
    with pytest.raises(ConfigError, match="what is made of each of the recording's"):
        signals.check_memory(plant)


@pytest.mark.parametrize(("remedy", "name", "limits"), [
    ("none", "drem", (2.0, 0.3)),  # 3 with the state map at all points
    # 6 with all of 𝔸; and filters of all rows add 70 to 90, where windows differ by 4.
    *(("current_coordinates", name, (4.0, 8.0)) for name in (
        "drem", "mre", "least_squares", "gradient",
    )),
])
@np.errstate(all="ignore")  # as in a run
def test_a_row_more_takes_few_more_bytes(remedy, name, limits, monkeypatch):
    """In terms of ψ's, which is made along the motor's signals: held, and added by estimating."""
    for module in (mesh, linear):
        monkeypatch.setattr(module, "_WINDOW", 32)
    for module in (extension, reduced):
        monkeypatch.setattr(module, "AT_ONCE", 32 * 7)
    monkeypatch.setattr(gpebo, "_LONG", 32)
    plant, observer = shipped("motor"), build({"name": "gpebo", "remedy": remedy})
    law, found, t = estimators.build({"name": name}), [], np.linspace(0.0, 0.1, 21)
    for rows in (40, 200, 500):  # the first ones fill caches
        signals = rough(plant, "linear", rows, 0.1)
        signals = replace(signals, wanted=t, asked=np.union1d(signals.mesh.edges, t))
        tracemalloc.start()
        seen = observer.observe(plant, signals, SolverSettings())
        held, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        excitation = assess(seen.regression, t, ExcitationSettings())
        assert excitation.known.parameters.any()
        assert excitation.t_c is not None
        estimators.estimate(law, seen.regression, t).parameters(slice(None))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        found.append([seen.regression.psi.values.nbytes, held, peak - held])
    psi, held, added = np.subtract(found[2], found[1])
    assert 1.0 <= held / psi < limits[0]
    assert added / psi < limits[1]
