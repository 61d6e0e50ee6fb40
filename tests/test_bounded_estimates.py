"""observer.bounds: against a full-information quadratic programme of another package."""

from __future__ import annotations

import json
from types import SimpleNamespace

import clarabel
import numpy as np
import pytest
from plants import one_state
from processes import refused, write_table
from scipy import sparse
from scipy.linalg import expm
from scipy.optimize import brentq

from gpebo_cli import run
from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment import bounds as bounds_
from gpebo_cli.experiment.result import ActiveBound
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import AffineStateMap, gpebo

TANK = {
    "name": "tank", "states": ["h1", "h2"], "inputs": {"V": "sin(t)"}, "unknowns": {"leak": -0.05},
    "outputs": ["y"], "E": [[1, 0], [0, 1]], "A": [[-0.8, -0.5], [1, -0.5]], "B": [[1], [0]],
    "F": [[-1], [0]], "C": [[0, 1]], "initial_state": {"h1": 1, "h2": 0},
}
HORIZON, F0 = 8.0, 1e-3
LOW = -0.84
BOUNDS = {"states": {"h1": [LOW, None]}, "unknowns": {"leak": [0, None]}}


def autonomous(A, of_leak, of_sine):
    """z = (x, leak, sin t, cos t) moves by itself: a step is an exponential."""
    n = len(A)
    out = np.zeros((n + 3, n + 3))
    out[:n, :n], out[:n, n], out[:n, n + 1] = A, of_leak, of_sine
    out[-2, -1], out[-1, -2] = 1.0, -1.0
    return out


M = autonomous(TANK["A"], [-1, 0], [1, 0])
TRUE = np.array([1.0, 0.0, -0.05, 0.0, 1.0])
OTHERS = {  # a plant, the same without algebraic states, its start, and the output's place
    "with a force of a spring and a damper": (
        TANK | {
            "states": ["p", "v", "f"], "E": [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
            "A": [[0, 1, 0], [0, 0, 1], [-2, -0.4, -1]], "B": [[0], [1], [0]],
            "F": [[0], [-1], [0]], "C": [[1, 0, 0]], "initial_state": {"p": 1, "v": 0.5, "f": -2.2},
        }, autonomous([[0, 1], [-2, -0.4]], [0, -1], [0, 1]), [1.0, 0.5], 0,
    ),
    "of three in a row": (
        TANK | {
            "states": ["a", "b", "c"], "E": np.eye(3).tolist(),
            "A": [[-1, 0.2, 0], [1, -0.7, 0.1], [0, 0.5, -0.3]], "B": [[1], [0], [0]],
            "F": [[0], [-1], [0]], "C": [[0, 0, 1]], "initial_state": {"a": 1, "b": 0, "c": 0.5},
        }, autonomous([[-1, 0.2, 0], [1, -0.7, 0.1], [0, 0.5, -0.3]], [0, -1, 0], [1, 0, 0]),
        [1.0, 0.0, 0.5], 2,
    ),
}


def full_information(bounds, horizon, at, M=M, true=TRUE, output=1):
    """x(0) and the leak of the least sum of squares, the first state being bounded at one time.

    The unknowns are the states at all nodes of a Gauss rule and at that time, and the leak; steps
    of the plant are equations between them.
    """
    size = len(M) - 3
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0.0, horizon, 11)
    h = np.diff(edges)[:, None]
    points = (edges[:-1, None] + h * (nodes + 1.0) / 2.0).ravel()
    rule = dict(zip(points.tolist(), (h * weights / 2.0).ravel().tolist(), strict=True))
    t = np.unique([0.0, at, *points])
    n = size * len(t) + 1  # unknowns: states one after the other, then the leak
    P, q = np.zeros(n), np.zeros(n)
    rows, right = [], []
    for k, time in enumerate(t):
        P[size * k + output] = rule.get(time, 0.0)
        q[size * k + output] = -rule.get(time, 0.0) * (expm(M * time) @ true)[output]
        if k:
            step = expm(M * (time - t[k - 1]))
            known = step[:size, -2:] @ [np.sin(t[k - 1]), np.cos(t[k - 1])]
            for i in range(size):
                row = np.zeros(n)
                row[size * k + i] = 1.0
                row[size * (k - 1) : size * k] = -step[i, :size]
                row[-1] = -step[i, size]
                rows.append(row)
                right.append(known[i])
    P[[*range(size), -1]] += F0
    place = {"states": size * int(np.searchsorted(t, at)), "unknowns": n - 1}
    low = {"states": LOW, "unknowns": 0.0}
    sides = np.zeros((len(bounds), n))
    sides[np.arange(len(bounds)), [place[kind] for kind in bounds]] = -1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas", "tol_ktratio"):
        setattr(settings, name, 1e-13)
    x = np.array(clarabel.DefaultSolver(
        sparse.diags(P, format="csc"), q, sparse.csc_matrix(np.vstack([*rows, *sides])),
        np.append(right, [-low[kind] for kind in bounds]),
        [clarabel.ZeroConeT(len(rows)), clarabel.NonnegativeConeT(len(bounds))], settings,
    ).solve().x)
    return np.array([*x[:size], x[-1], 0.0, 1.0])


def h1(time, start):
    return float((expm(M * time) @ start)[0])


def lowest(start, horizon):
    """When h1 is least."""
    t = np.linspace(0.0, horizon, 41)
    k = int(np.argmin([h1(time, start) for time in t]))
    slope = lambda time: (M @ expm(M * time) @ start)[0]  # noqa: E731
    return brentq(slope, t[k - 1], t[k + 1], xtol=1e-13)


@pytest.mark.parametrize("kinds", [("states", "unknowns"), ("states",), ("unknowns",)])
def test_least_squares_within_bounds_is_the_full_information_programme(kinds):
    """θ̂ and the whole trajectory; the plant's truth breaks both bounds."""
    bounds = {kind: BOUNDS[kind] for kind in kinds}
    result = run(
        TANK, estimator={"name": "least_squares", "f0": F0}, observer={"bounds": bounds},
        time={"horizon": HORIZON, "samples": 9},
    )

    def off(at):
        return lowest(full_information(bounds, HORIZON, at), HORIZON) - at

    at = brentq(off, 4.8, 5.4, xtol=1e-11) if "states" in kinds else 5.0
    expected = full_information(bounds, HORIZON, at)
    ours = [-result.estimates["e0_h1"], -result.estimates["e0_h2"], result.estimates["leak"]]
    ours = np.array(ours)[:, 0, -1]
    np.testing.assert_allclose(ours, expected[:3], atol=1e-8)
    there = (expm(M * HORIZON) @ expected)[:2]
    np.testing.assert_allclose(
        [result.estimates[f"h{i}"][0, -1] for i in (1, 2)], there, atol=1e-8
    )
    time = np.linspace(0.0, HORIZON, 201)
    assert min(h1(t, [*ours, 0.0, 1.0]) for t in time) >= (LOW - 1e-9 if "states" in kinds else -1)
    active = {bound.name for bound in result.details.estimation.active[0]}
    assert active == {{"states": "h1", "unknowns": "leak"}[kind] for kind in kinds}


@pytest.mark.parametrize("name", OTHERS)
def test_other_plants_within_bounds_are_the_full_information_programme(name):
    plant, matrix, start, output = OTHERS[name]
    result = run(
        plant, estimator={"name": "least_squares", "f0": F0},
        observer={"bounds": {"unknowns": {"leak": [0, None]}}},
        time={"horizon": HORIZON, "samples": 9},
    )
    expected = full_information(
        ["unknowns"], HORIZON, 5.0, matrix, np.array([*start, -0.05, 0.0, 1.0]), output
    )
    there, names = expm(matrix * HORIZON) @ expected, plant["states"][: len(start)]
    np.testing.assert_allclose(
        [result.estimates[f"e0_{each}"][0, -1] for each in names], -expected[: len(start)],
        atol=1e-8,
    )
    ours = [result.estimates[each][0, -1] for each in (*names, "leak")]
    np.testing.assert_allclose(ours, there[: len(start) + 1], atol=1e-8)


def test_estimates_respect_bounds_at_all_times_whatever_the_estimator(tmp_path):
    """From the command line; what holds them is said in the last line and in the summary."""
    for estimator in ("gradient", "drem", "ls_drem"):
        result = run(TANK, estimator=estimator, observer={"bounds": BOUNDS},
                     time={"horizon": HORIZON, "samples": 41})
        assert result.estimates["h1"].min() >= LOW - 1e-9
        assert result.estimates["leak"].min() >= -1e-9
        assert result.details.estimation.doubts == ({}, ())  # least squares know no bounds
    assert "held by bounds: leak = 0, h1 = -0.84 at t = " in result.verdict
    result.save(tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["active_bounds"][0] == {"case": 0, "name": "leak", "value": 0.0, "time": None}


@pytest.mark.parametrize(("changes", "part"), [
    ({"bounds": {"states": {"h3": [0, 1]}}}, "did you mean h"),
    ({"bounds": {"states": {"h1": [1, 0]}}}, "expected [low, high]"),
    ({"bounds": {"unknowns": {"leak": [1]}}}, "expected [low, high]"),
    ({"bounds": {"unknown": {"leak": [1, 2]}}}, "accepted: states, unknowns"),
    ({"bounds": {"states": {"h2": [5, 6], "h1": [0, 1]}}},
     "no estimate respects those of h2, h1 together with the data up to t = 2"),
    ({"bounds": BOUNDS, "sample_time": 0.1}, "continuous time only"),
    ({"bounds": BOUNDS, "remedy": "reset"}, "accepted remedies"),
])
def test_bounds_that_cannot_be(changes, part):
    with refused(part):
        run(TANK, observer=changes, time={"horizon": HORIZON, "samples": 5})


@pytest.mark.parametrize("follows", [False, True])
def test_a_long_recording_respects_bounds_in_all_of_its_rows(follows, monkeypatch):
    """As a short one does between its rows, too, but for what is between them."""
    plant = {**TANK, "A": [["-0.8 - 0.1*y**2", -0.5], [1, -0.5]]} if follows else TANK
    t = np.linspace(0.0, HORIZON, 801)
    made = run(plant, observer="none", time={"horizon": HORIZON, "samples": len(t)})
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(t))
    data = {"t": t, "V": made["V"], "y": made["y"] + noise}
    low = float(made["h1"].min()) + 0.1
    settings = {
        "data": data, "estimator": {"name": "least_squares", "f0": F0}, "time": {"samples": 38},
        "observer": {"name": "gpebo", "form": "given", "bounds": {"states": {"h1": [low, None]}}},
    }
    short = run(plant, **settings)
    monkeypatch.setattr(gpebo, "_LONG", 32)
    monkeypatch.setattr(bounds_, "_GROUP", 7)
    found = run(plant, **settings)
    free = run(plant, **settings | {"observer": {"name": "gpebo", "form": "given"}})
    for name in ("h1", "h2", "leak"):
        expected = short.estimates[name][0]
        moved = np.abs(free.estimates[name][0] - expected).max()
        assert np.abs(found.estimates[name][0] - expected).max() < 1e-3 * moved
    assert "held by bounds: h1" in found.verdict


def test_bounds_hold_at_every_row_of_several_long_files(tmp_path):
    """At few times of the output the state is known at the rows, at many at all points."""
    plant = one_state(inputs={"u": "sin(t)"}, unknowns={"leak": 0.3}, A=[[-0.5]], B=[[1]], F=[[-1]])
    files = []
    for k, start in enumerate((1.0, 3.0)):
        made = run({**plant, "initial_state": {"x": 1.0 - k}}, observer="none",
                   time={"start": start, "horizon": 4.0, "samples": 101})
        y = made["y"] + 0.1 * np.random.default_rng(k).standard_normal(101)
        files.append(write_table(tmp_path / f"{k}.csv", {"t": made.t, "u": made["u"], "y": y}))
    low = {"states": {"x": [-0.7, None]}}
    few, many = (
        run(plant, data={"file": files, "hold": "zoh"}, estimator="least_squares",
            time={"samples": samples}, observer={"bounds": low}).details.estimation
        for samples in (5, 17)
    )
    assert few.states[0, :, 0].min() >= -0.7 - 1e-9
    (one,), (other,) = few.active[0], many.active[0]
    assert one.time == pytest.approx(other.time) == pytest.approx(7.68)
    np.testing.assert_allclose(few.parameters[0, -1], many.parameters[0, -1], atol=1e-3)


def test_bounds_on_what_has_forgotten_its_start_move_no_estimate():
    """At 20 s, when b1 leaves its bounds, of its start e⁻⁴⁰ is left."""
    decaying = {
        **TANK, "states": ["b1", "b2"], "inputs": {"V": "-step(t - 20)"}, "unknowns": {}, "F": None,
        "A": [[-2, 0], [1, -2]], "initial_state": {"b1": 1, "b2": 0},
    }
    free, bounded = (
        run(decaying, observer={"name": "gpebo", **bounds}, time={"horizon": 22.0, "samples": 23})
        for bounds in ({}, {"bounds": {"states": {"b1": [-0.1, None]}}})
    )
    assert (bounded.estimates["b1"] == free.estimates["b1"]).all()
    assert "held by bounds" not in bounded.verdict
    assert bounded.estimates["b1"][0, -1] == pytest.approx((np.exp(-4.0) - 1.0) / 2.0, rel=1e-4)


def test_a_bound_of_an_unknown_is_near_itself():
    bound = ActiveBound("leak", 0.0, None)
    assert bound.near(bound, 0.1)
    assert not bound.near(ActiveBound("other", 0.0, None), 0.1)
    assert not ActiveBound("leak", 0.0, 1.0).near(ActiveBound("leak", 0.0, 2.0), 0.1)
    assert ActiveBound("leak", 0.0, 1.0).near(ActiveBound("leak", 0.0, 1.05), 0.1)


def test_bounds_of_one_number_say_what_an_unknown_is():
    bounds = {"unknowns": {"leak": [-0.02, -0.02]}}
    found = run(TANK, observer={"name": "gpebo", "bounds": bounds},
                time={"horizon": HORIZON, "samples": 21},
                estimator={"name": "least_squares", "f0": F0})
    np.testing.assert_allclose(found.estimates["leak"][0], -0.02, rtol=1e-9)


def test_a_bound_on_what_others_can_stand_for_changes_nothing_and_that_is_said():
    """Of two leaks the data have the sum: one may be what its bound says, and the states stay."""
    two = {**TANK, "unknowns": {"leak": -0.05, "other": 0.0}, "F": [[-1, -1], [0, 0]]}
    free, *held = (
        run(two, observer={"name": "gpebo", "bounds": {"unknowns": bounds}},
            time={"horizon": HORIZON, "samples": 21}, estimator={"name": "least_squares"})
        for bounds in ({}, {"leak": [0, None]}, {"other": [1, None]})
    )
    for found, name in zip(held, ("leak", "other"), strict=True):
        assert (found.estimates["h1"] == free.estimates["h1"]).all()
        assert f"; without effect, for want of data: observer.bounds of {name}" in found.verdict
        assert "held by bounds" not in found.verdict


def test_bounds_hold_in_any_units():
    def bounded(unit):
        plant = {**TANK, "inputs": {"V": f"{unit}*sin(t)"}, "unknowns": {"leak": -0.05 * unit},
                 "initial_state": {"h1": unit, "h2": 0}}
        bounds = {"states": {"h1": [LOW * unit, None]}, "unknowns": {"leak": [0, None]}}
        found = run(
            plant, observer={"name": "gpebo", "bounds": bounds}, time={"horizon": HORIZON},
            estimator={"name": "least_squares", "f0": F0},
        )
        return found.estimates["h1"][0] / unit

    np.testing.assert_allclose(bounded(1e-12), bounded(1.0), atol=1e-6)


def test_bounds_are_told_in_the_order_of_time():
    """Programmes find them in another one."""
    plant = {
        "name": "three", "states": ["h1", "h2", "h3"], "inputs": {"V": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "A": [[-0.8, -0.5, 0], [1, -0.5, 0], [3e5, 0, -0.2]],
        "B": [[1], [0], [0]], "C": [[0, 1, 1e-7]], "initial_state": {"h1": 1, "h2": 0, "h3": 5e5},
    }
    bounds = {"h3": [-6.1e4, 7.2349e5], "h1": [-0.8876, 1.0]}
    found = run(
        plant, observer={"name": "gpebo", "bounds": {"states": bounds}},
        time={"horizon": HORIZON, "samples": 21}, estimator={"name": "least_squares", "f0": 0.3},
        noise={"name": "gaussian", "outputs": 0.05, "seed": 3, "sample_time": 0.2},
    )
    (held,) = found.details.estimation.active.values()
    times = [bound.time for bound in held]
    assert len(times) > 1
    assert times == sorted(times)


def test_where_nothing_is_known_yet_the_end_says_what_is_near():
    """With G = diag(9, 1) at the end η₁ + η₂ ≥ 1 is met at the start by (0.1, 0.9)."""
    t, mesh = np.array([0.0, 1.0, 2.0]), Mesh(np.array([0.0, 1.0, 2.0]), radau_rule(3))
    ones = np.ones(mesh.points.shape)
    gram = np.array([np.zeros((2, 2)), np.diag([1.0, 4.0]), np.diag([9.0, 1.0])])
    observation = SimpleNamespace(
        state_map=AffineStateMap(
            Trajectory(mesh, 0.0 * ones[..., None]), Trajectory(mesh, np.ones((*ones.shape, 1, 2)))
        ),
        regression=SimpleNamespace(p=2, gram_at=lambda _: gram),
    )
    found = bounds_.bounded(
        {"states": {"x": [1.0, None]}}, SimpleNamespace(states=("x",), unknowns=("a", "b")),
        observation, np.arange(2), SimpleNamespace(parameters=lambda _: np.zeros((1, 3, 2))), t,
    )
    np.testing.assert_allclose(
        found.parameters(slice(0, 1))[0], [[0.1, 0.9], [0.8, 0.2], [0.1, 0.9]], atol=1e-9
    )


@pytest.mark.parametrize("bounds", [{"unknowns": {"leak": [0, None]}}, BOUNDS])
def test_statistics_over_seeds_are_those_of_the_estimates_within_bounds(bounds):
    def made(**noise):
        return run(
            TANK, observer={"bounds": bounds}, estimator={"name": "least_squares"},
            noise={"name": "gaussian", "outputs": 0.2, "sample_time": 0.2, **noise},
            time={"horizon": 4, "samples": 3},
        ).details

    own = [made(seed=seed).estimation for seed in range(3)]
    errors = np.array([each.parameters[0, -1] - each.true_parameters[-1] for each in own])
    found = made(seeds=3).noise
    np.testing.assert_allclose(found.bias[0], errors.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(found.deviation[0], errors.std(axis=0, ddof=1), atol=1e-9)


@pytest.mark.parametrize("u", ["1 - 3*step(t - 1.3)", "-2*t + 4*step(t - 1.3)"])
def test_bounds_hold_on_both_sides_of_a_jump(u):
    """z = h + u jumps with u, and is lowest there."""
    plant = one_state(
        states=["h", "z"], inputs={"u": u}, unknowns={"k": 1}, E=[[1, 0], [0, 0]],
        A=[[-1, 0], [1, -1]], B=[[1], [1]], F=[[1], [0]], C=[[1, 0]], initial_state=[0.2, 1.2],
    )
    result = run(
        plant, observer={"bounds": {"states": {"z": [-0.3, None]}}}, estimator="least_squares",
        time={"horizon": 2, "samples": 201},
    )
    assert result.estimates["z"].min() > -0.3 - 1e-6


def test_bounds_hold_before_a_jump_that_is_less_than_what_leads_to_it():
    """z = x + u with x = 1 is −0.3 just before 1.3 s, and more at nodes, as from then on."""
    plant = one_state(
        states=["x", "z"], inputs={"u": "-t + (0.001 + 0.9999*(t - 1.3))*step(t - 1.3)"},
        E=[[1, 0], [0, 0]], A=[[0, 0], [1, -1]], B=[[0], [1]], C=[[1, 0]], initial_state=[1, 1],
    )
    result = run(
        plant, observer={"bounds": {"states": {"z": [-0.2995, None]}}}, estimator="least_squares",
        time={"horizon": 2, "samples": 3},
    )
    assert result.estimates["x"][0, -1] == pytest.approx(1.0005, abs=1e-7)


def test_a_state_that_an_input_determines_later_is_held_where_estimates_move_it():
    """z = x = 1 up to t = 2 and then u; of k + (x(0) − k) e^-t below 0.8 the best is 0.8 itself."""
    plant = one_state(
        states=["x", "z"], inputs={"u": "sin(3*t)"}, unknowns={"k": 1}, E=[[1, 0], [0, 0]],
        A=[[-1, 0], ["1 - step(t - 2)", -1]], B=[[0], ["step(t - 2)"]], F=[[1], [0]], C=[[1, 0]],
        initial_state=[1, 0],
    )
    observer = {"name": "gpebo", "bounds": {"states": {"z": [0.2, 0.8]}}}
    found = run(plant, observer=observer, estimator="least_squares",
                time={"horizon": 4, "samples": 2}).estimates
    np.testing.assert_allclose([found["k"][0, -1], found["x"][0, -1]], 0.8, rtol=1e-6)


@pytest.mark.parametrize("end", [1, 70, 300])
def test_rows_below_a_bound_are_in_groups_that_may_be(end):
    rng = np.random.default_rng(3)
    normals, levels, eta = rng.normal(size=(2, 300, 3)), np.full((2, 300), -1e3), rng.normal(size=3)
    for below in (0, 63, 64, 299):
        levels[:] = -1e3
        levels[1, below] = normals[1, below] @ eta + 1.0
        near = bounds_._Groups.of(normals, levels).near(eta, np.ones(2), end)
        assert (below in near) == (below < end)
        assert len(near) < 300


def test_a_bound_without_effect_has_none_over_seeds_and_is_a_range_all_the_same():
    two = {**TANK, "unknowns": {"leak": -0.05, "other": 0.0}, "F": [[-1, -1], [0, 0]]}

    def found(pair):
        return run(two, observer={"name": "gpebo", "bounds": {"unknowns": {"leak": pair}}},
                   noise={"name": "gaussian", "outputs": 0.01, "seeds": 3},
                   time={"horizon": HORIZON, "samples": 21}, estimator={"name": "least_squares"})

    free, held = (found(pair).details.noise for pair in ([None, None], [1, None]))
    np.testing.assert_allclose(held.bias, free.bias, rtol=1e-9)
    with pytest.raises(ConfigError, match=r"observer.bounds.unknowns.leak: expected \[low, high\]"):
        found([1, 0])
