"""How good estimates are against the truth, against loops over each quantity."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gpebo_cli import run
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.experiment import accuracy
from gpebo_cli.experiment.sources import _without_rounding
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import AffineStateMap

MESH = Mesh(np.linspace(2.0, 6.0, 9), radau_rule(3))
GRID = np.linspace(2.0, 6.0, 41)
SIZES = np.array([2.0, 1.0, 3.0]), np.array([1.0, 0.5, 4.0, 0.0])


def recorded(rng):
    """Two cases of three parameters and four states, one of each unknown at the end.

    One error falls within a step, one is zero, and one never falls.
    """
    p, n = 3, 4
    offset, gain = (
        Trajectory(MESH, rng.normal(size=(*MESH.points.shape, *shape))) for shape in ((n,), (n, p))
    )
    truth, state_map = rng.normal(size=p) * np.ones((41, 1)), AffineStateMap(offset, gain)
    rates = np.array([[60.0, 2.0, 3.0], [0.0, 2.0, 0.0]])[:, None]
    first = np.array([[2.0, -1.0, -0.7], [0.0, -0.5, 0.4]])[:, None]
    eta = truth + first * np.exp(-rates * (GRID[:, None] - 2.0))
    x = state_map.at(GRID)(truth[None])[0]
    truth[-1, 1], x[-1, 1] = np.nan, np.nan
    return state_map, truth, x, eta


def measured(state_map, truth, x, eta, judged, **more):
    chosen = np.array([0, 7, 40])
    kept, seen = np.empty((2, 3, 3)), np.empty((2, 3, 4))
    evaluate = accuracy.evaluation(
        state_map, GRID, truth, x, SIZES, judged, chosen, **{"each": True, "alone": False} | more
    )
    found = evaluate(eta, kept, seen)
    x_hat = state_map.at(GRID)(eta)
    np.testing.assert_array_equal(kept, eta[:, chosen])
    np.testing.assert_allclose(seen, x_hat[:, chosen], atol=1e-12)
    return found, x_hat


@pytest.mark.parametrize("judged", [[True, True, True], [True, True, False], [False] * 3])
def test_metrics_are_the_same_whatever_is_affine(judged):
    """What nobody knows at the end does not count, and neither does what is not judged."""
    state_map, truth, x, eta = recorded(np.random.default_rng(1))
    judged = np.array(judged)
    found, x_hat = measured(state_map, truth, x, eta, judged)
    plain = SimpleNamespace(at=state_map.at)
    np.testing.assert_allclose(measured(plain, truth, x, eta, judged)[0], found, rtol=1e-9)
    few, _ = measured(state_map, truth, x, eta, judged, each=False)
    np.testing.assert_allclose(few, found[:5], rtol=1e-12)
    names = ["a", "b", "c"], SimpleNamespace(states=("w", "x", "y", "z"))
    metrics = accuracy.metrics_of(found, *names)
    assert accuracy.metrics_of(few, *names).seconds_to_1pct == {}
    of_eta, of_x = np.abs(eta - truth), np.abs(x_hat - x)
    some = np.array([0, 2])[judged[[0, 2]]]
    expected = of_eta[:, -1, some].max(axis=1, initial=0.0)
    np.testing.assert_allclose(metrics.final_error_parameters, expected)
    np.testing.assert_allclose(
        metrics.final_error_states, of_x[:, -1, [0, 2, 3]].max(axis=1), rtol=1e-9
    )
    squares = (of_x[..., [0, 2]] ** 2 / SIZES[1][[0, 2]] ** 2).sum(axis=2)  # z has no size
    rms = np.sqrt(np.trapezoid(squares, GRID) / 4.0)
    np.testing.assert_allclose(metrics.rms_error_states, rms, rtol=1e-9)
    seconds = metrics.seconds_to_1pct
    a, c = np.array([np.log(100.0) / 60.0, 0.0]), np.array([np.log(100.0) / 3.0, np.nan])
    np.testing.assert_allclose(seconds["a"], a if judged[0] else np.nan)
    np.testing.assert_allclose(seconds["c"], c if judged[2] else np.nan)
    assert np.isnan([seconds["b"], seconds["x"]]).all()
    assert (metrics.seconds_to_1pct_parameters[0] > 0.0) == judged.any()
    for of_state in (metrics.seconds_to_1pct_states, seconds["w"], seconds["y"]):
        assert of_state[0] > 0.5
        assert np.isnan(of_state[1])


def settled_by_hand(t, away, level):
    """The first time of the grid from which on something is within a level."""
    above = np.flatnonzero(np.abs(away) > level)
    return t[above[-1] + 1] - t[0] if len(above) else 0.0


def test_estimates_settle_by_the_deviation_of_the_last_time_though_it_just_fell():
    one = np.ones((1, 4, 1))
    estimation = SimpleNamespace(
        t=np.arange(4.0), names=("a",), parameters=np.array([8.0, 3.0, 1.5, 0.0])[None, :, None],
        parameters_std=one * [[10.0], [10.0], [10.0], [1.0]], states_std=one,
    )
    metrics, system = Metrics(*np.zeros((5, 1))), SimpleNamespace(states=("x",), q=1)
    found = accuracy.standing(estimation, metrics, one[..., None], system).seconds_to_settled
    assert 1.0 < found["a"][0] <= 2.0


@pytest.mark.parametrize("told", ["gains", "filter", "seeds", "nothing"])
def test_estimates_have_settled_where_they_are_within_two_deviations_of_the_end(told):
    """Of states what the final parameters make of the signals; of a filter what it has to learn.

    The largest deviation of the last quarter counts for states.
    """
    rng = np.random.default_rng(2)
    eta = 5.0 + np.exp(-GRID[:, None]) * [[40.0, -70.0]]
    sigma = 0.1 + np.exp(2.0 - GRID[:, None]) * [[0.3, 0.2]]
    of_x = 0.2 + 0.05 * np.sin(7.0 * GRID[:, None] + [[0.0, 1.0]]) + np.exp(2.0 - GRID[:, None])
    gains = rng.normal(size=(41, 2, 2))
    known = told in {"gains", "filter"}
    estimation = SimpleNamespace(
        t=GRID, names=("a", "e0_x"), parameters=eta[None],
        parameters_std=sigma[None] if known else None, states_std=of_x[None] if known else None,
    )
    system = SimpleNamespace(states=("x", "y"), q=1)
    seeds = SimpleNamespace(deviation=sigma[None, -1]) if told == "seeds" else None
    empty = Metrics(*np.zeros((5, 1)))
    found = accuracy.standing(
        estimation, empty, gains[None] if told == "gains" else None, system, seeds
    ).seconds_to_settled
    away, late = eta - eta[-1], GRID >= 5.0
    level = {"a": 2.0 * sigma[-1, 0], "e0_x": 2.0 * sigma[-1, 1]}
    course = {"a": away[:, 0], "e0_x": away[:, 1]}
    end = of_x[late].max(axis=0)
    if told == "gains":
        course |= dict(zip(("x", "y"), np.einsum("tij,tj->it", gains, away), strict=True))
    elif told == "filter":  # of which e₀ moves, too
        level["e0_x"] = 2.0 * sigma[late, 1].max()
        moving = np.column_stack([sigma[:, 1], of_x])
        rest = np.sqrt(np.maximum(moving**2 - np.append(level["e0_x"] / 2.0, end) ** 2, 0.0))
        course |= dict(zip(("e0_x", "x", "y"), rest.T, strict=True))
    if known:
        level |= dict(zip(("x", "y"), 2.0 * end, strict=True))
    expected = {
        name: settled_by_hand(GRID, course[name], level[name]) for name in level
    } if told != "nothing" else {}
    assert set(found) == set(expected)
    for name, (seconds,) in found.items():
        assert expected[name] - 0.1 - 1e-9 <= seconds <= expected[name] + 1e-9
        assert name not in {"a", "e0_x"} or told == "filter" or 0.5 < seconds < 4.0


def test_states_that_are_rounding_count_as_zero():
    """p1 and p3 are held where they are: simulated, they and their velocities are 1e-18."""
    E, A = np.diag([1.0] * 6 + [0.0] * 2), np.zeros((8, 8))
    E[3:6, 3:6] = [[2, 1, 0], [1, 3, 1], [0, 1, 2]]
    A[:3, 3:6], A[3, 6], A[5, 7], A[6, 0], A[7, 2] = np.eye(3), 1, 1, 1, 1
    A[3:6, :3] = [[-67, -69, 69], [-70, -2, 2], [70, 2, 68]]
    A[3:6, 3:6] = [[1.5, 1.5, -1.5], [-3, -3, 3], [3, 3, -3]]
    states = ["p1", "p2", "p3", "v1", "v2", "v3", "l1", "l2"]
    result = run({
        "name": "held", "states": states, "outputs": ["y"], "E": E.tolist(), "A": A.tolist(),
        "C": [[0, 1, 0, 0, 0, 0, 0.01, 0]], "initial_state": [0, 0.1, 0, 0, 0.2, 0, 0, 0],
    }, estimator={"name": "least_squares", "f0": 1e-6}, time={"horizon": 1})
    norm = np.sqrt(sum(
        (result.errors[s][0] / np.abs(result[s]).max()) ** 2 for s in ("p2", "v2", "l1", "l2")
    ))
    t, case = result.estimates_t, result.cases[0]
    after = t[np.flatnonzero(norm > 0.01 * norm[0])[-1] + 1]
    assert case["seconds_to_1pct_states"] == pytest.approx(after, abs=2e-3)
    assert case["rms_error_states"] == pytest.approx(np.sqrt(np.trapezoid(norm**2, t)), rel=1e-2)
    assert case["seconds_to_1pct_p3"] == 0.0


def test_states_are_no_zeros_where_rounding_has_grown():
    """Of those of a chaotic plant nothing is known, but they are as large as others."""
    mesh, units = Mesh(np.array([0.0, 1.0]), radau_rule(3)), np.array([1.0, 1e-9, 1e3])
    values = np.ones((1, 4, 3)) * units
    values[..., 2] *= 1e-18
    simulation = SimpleNamespace(
        signals=SimpleNamespace(states=Trajectory(mesh, values)),
        structure=SimpleNamespace(scaling=SimpleNamespace(columns=units)),
        state_errors=np.array([1e-9, 15.0, 15.0]),
    )
    found = _without_rounding(simulation).values
    assert (found == values * [1.0, 1.0, 0.0]).all()
