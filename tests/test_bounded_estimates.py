"""observer.bounds: against a full-information quadratic programme of another package."""

from __future__ import annotations

import json

import clarabel
import numpy as np
import pytest
from processes import refused
from scipy import sparse
from scipy.linalg import expm
from scipy.optimize import brentq

from gpebo_cli import run

TANK = {
    "name": "tank", "states": ["h1", "h2"], "inputs": {"V": "sin(t)"}, "unknowns": {"leak": -0.05},
    "outputs": ["y"], "E": [[1, 0], [0, 1]], "A": [[-0.8, -0.5], [1, -0.5]], "B": [[1], [0]],
    "F": [[-1], [0]], "C": [[0, 1]], "initial_state": {"h1": 1, "h2": 0},
}
HORIZON, F0 = 8.0, 1e-3
LOW = -0.84
BOUNDS = {"states": {"h1": [LOW, None]}, "unknowns": {"leak": [0, None]}}
# z = (h1, h2, leak, sin t, cos t) moves by itself: a step is an exponential.
M = np.zeros((5, 5))
M[:2, :2], M[0, 2], M[0, 3] = TANK["A"], -1.0, 1.0
M[3, 4], M[4, 3] = 1.0, -1.0
TRUE = np.array([1.0, 0.0, -0.05, 0.0, 1.0])


def full_information(bounds, horizon, at):
    """h1(0), h2(0) and the leak of the least sum of squares, h1 being bounded at one time.

    The unknowns are the states at all nodes of a Gauss rule and at that time, and the leak; steps
    of the plant are equations between them.
    """
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0.0, horizon, 11)
    h = np.diff(edges)[:, None]
    points = (edges[:-1, None] + h * (nodes + 1.0) / 2.0).ravel()
    rule = dict(zip(points.tolist(), (h * weights / 2.0).ravel().tolist(), strict=True))
    t = np.unique([0.0, at, *points])
    n = 2 * len(t) + 1  # unknowns: states one after the other, then the leak
    P, q = np.zeros(n), np.zeros(n)
    rows, right = [], []
    for k, time in enumerate(t):
        P[2 * k + 1] = rule.get(time, 0.0)
        q[2 * k + 1] = -rule.get(time, 0.0) * (expm(M * time) @ TRUE)[1]
        if k:
            step = expm(M * (time - t[k - 1]))
            known = step[:2, 3:] @ [np.sin(t[k - 1]), np.cos(t[k - 1])]
            for i in range(2):
                row = np.zeros(n)
                row[2 * k + i] = 1.0
                row[2 * k - 2 : 2 * k] = -step[i, :2]
                row[-1] = -step[i, 2]
                rows.append(row)
                right.append(known[i])
    P[[0, 1, -1]] += F0
    place = {"states": 2 * int(np.searchsorted(t, at)), "unknowns": n - 1}
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
    return np.array([x[0], x[1], x[-1], 0.0, 1.0])


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


def test_estimates_respect_bounds_at_all_times_whatever_the_estimator(tmp_path):
    """From the command line; what holds them is said in the last line and in the summary."""
    for estimator in ("gradient", "drem", "ls_drem"):
        result = run(TANK, estimator=estimator, observer={"bounds": BOUNDS},
                     time={"horizon": HORIZON, "samples": 41})
        assert result.estimates["h1"].min() >= LOW - 1e-9
        assert result.estimates["leak"].min() >= -1e-9
    assert "held by bounds: leak = 0, h1 = -0.84 at t = " in result.verdict
    result.save(tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["active_bounds"][0] == {"case": 0, "name": "leak", "value": 0.0, "time": None}


@pytest.mark.parametrize(("changes", "part"), [
    ({"bounds": {"states": {"h3": [0, 1]}}}, "did you mean h"),
    ({"bounds": {"states": {"h1": [1, 0]}}}, "expected [low, high]"),
    ({"bounds": {"unknowns": {"leak": [1]}}}, "expected [low, high]"),
    ({"bounds": {"unknown": {"leak": [1, 2]}}}, "accepted: states, unknowns"),
    ({"bounds": {"states": {"h2": [5, 6], "h1": [0, 1]}}}, "no estimate respects those of h2, h1"),
    ({"bounds": BOUNDS, "sample_time": 0.1}, "continuous time only"),
    ({"bounds": BOUNDS, "remedy": "reset"}, "accepted remedies"),
])
def test_bounds_that_cannot_be(changes, part):
    with refused(part):
        run(TANK, observer=changes, time={"horizon": HORIZON, "samples": 5})
