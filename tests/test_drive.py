"""Inputs given as tables: what was recorded drives a simulation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from pandas import DataFrame
from plants import one_state
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import CubicSpline
from scipy.special import erf

from gpebo_cli import run
from gpebo_cli.errors import ConfigError

T = np.array([0.0, 0.4, 1.1, 1.3, 2.2, 3.0])
U = np.array([0.3, -1.0, 2.0, 2.0, 0.5, 1.0])
FUNCTIONS = {
    "zoh": lambda t: U[np.clip(np.searchsorted(T, t, side="right") - 1, 0, 4)],
    "linear": lambda t: np.interp(t, T, U),
    "cubic": CubicSpline(T, U),
}
PLANT = one_state(name="driven", A=[[-1]], B=[[1]], initial_state={"x": 0.5})


def table(folder):
    rows = "".join(f"{t},{u}\n" for t, u in zip(T, U, strict=True))
    (folder / "u.csv").write_text(f"t,u\n{rows}")
    return str(folder / "u.csv")


def signals(plant, **words):
    return run(plant, observer="none", time={"horizon": 3, "samples": 61}, **words)


@pytest.mark.parametrize("hold", FUNCTIONS)
def test_the_solution_is_that_of_the_held_table(tmp_path, hold):
    given = {"file": table(tmp_path), "column": "u", "hold": hold}
    result = signals({**PLANT, "inputs": {"u": given}})
    u = FUNCTIONS[hold]
    for k in (13, 30, 60):  # x(t) = e^{−t} (x(0) + ∫ e^{s} u(s) ds)
        t = result.t[k]
        cuts = [c for c in T if c < t] + [t]
        area = sum(quad(lambda s: np.exp(s) * u(s), a, b, epsabs=1e-13)[0]
                   for a, b in pairwise(cuts))
        assert result["x"][k] == pytest.approx(np.exp(-t) * (0.5 + area), abs=1e-8)
    inner = ~np.isin(result.t, T)
    assert result["u"][inner] == pytest.approx(u(result.t[inner]), abs=1e-12)


def test_a_plant_of_index_2_gets_the_derivative(tmp_path):
    """0 = x − u, x' = z."""
    plant = {
        **PLANT, "states": ["x", "z"], "E": [[1, 0], [0, 0]], "A": [[0, 1], [1, 0]],
        "B": [[0], [-1]], "C": [[1, 1]], "initial_state": {"x": 0, "z": 0},
        "inputs": {"u": {"file": table(tmp_path), "hold": "cubic"}},
    }
    result = signals(plant)
    assert result["z"] == pytest.approx(FUNCTIONS["cubic"](result.t, 1), abs=1e-9)


def test_matrices_may_depend_on_a_table_beside_other_inputs(tmp_path):
    given = {"u": {"file": table(tmp_path), "scale": 2}, "v": "1 + t"}
    result = signals({**PLANT, "inputs": given, "A": [["-u"]], "B": [[0, 1]]})

    def integral(t):  # of 2 u
        cuts = [c for c in T if c < t] + [t]
        return np.trapezoid(2 * FUNCTIONS["linear"](np.array(cuts)), cuts) if t else 0.0

    t = result.t[-1]
    cuts = [*T]
    area = sum(quad(lambda s: np.exp(integral(s) - integral(t)) * (1 + s), a, b)[0]
               for a, b in pairwise(cuts))
    assert result["x"][-1] == pytest.approx(0.5 * np.exp(-integral(t)) + area, rel=1e-7)


def test_a_regression_takes_tables_too(tmp_path):
    content = {"name": "line", "unknowns": {"a": 2.0}, "psi": [["u"]],
               "signals": {"u": {"file": table(tmp_path)}}}
    result = run(regression=content, estimator="least_squares", time={"horizon": 3})
    assert result.estimates["a"][0, -1] == pytest.approx(2.0, abs=1e-6)


def test_tables_are_found_beside_the_plant_and_nowhere_else(tmp_path):
    home, other = tmp_path / "mine" / "plant", tmp_path / "other"
    home.mkdir(parents=True)
    other.mkdir()
    text = "".join(f"{key}: {value}\n" for key, value in PLANT.items()).replace("'", "")
    for name, file in (("near", "u.csv"), ("far", table(other))):
        (home / f"{name}.yaml").write_text(
            text.replace("driven", name) + f"inputs: {{u: {{file: {file}}}}}\n"
        )
    table(home.parent)
    result = signals("near", config_dir=home.parent)
    assert result["u"] == pytest.approx(FUNCTIONS["linear"](result.t))
    with pytest.raises(ConfigError, match=r"inputs\.u\.file: .* lies outside of .*copy it there"):
        signals("far", config_dir=home.parent)


@pytest.mark.parametrize(("given", "said"), [
    ({"column": "w"}, r"inputs\.u: .*u\.csv, line 1: there is no column w"),
    ({"colum": "u"}, r"inputs\.u\.colum: no such key; .*did you mean column\?"),
    ({"hold": "spline"}, r"inputs\.u\.hold: expected zoh or linear or cubic"),
    ({"file": "no.csv"}, r"inputs\.u: no\.csv cannot be read"),
])
def test_mistakes_are_named(tmp_path, given, said):
    with pytest.raises(ConfigError, match=said):
        signals({**PLANT, "inputs": {"u": {"file": table(tmp_path)} | given}})


@pytest.mark.parametrize("others", [{}, {"phi": ["-y**3"]}])
def test_an_experiment_stays_within_the_table(tmp_path, others):
    plant = {**PLANT, **others, "inputs": {"u": {"file": table(tmp_path)}}}
    for time, beyond in (({"horizon": 4}, 4), ({"start": -1, "horizon": 2}, -1)):
        with pytest.raises(ConfigError, match=f"is of t = 0 to 3, .* needs t = {beyond};"):
            run(plant, observer="none", time=time)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_kinks_that_a_table_passes_are_edges_of_elements(tmp_path, hold):
    """x' = |u| + sign(u) on straight lines through zero: a mesh without the zeros is 1e-8 off."""
    plant = {**PLANT, "A": [[0]], "phi": ["abs(u) + sign(u)"], "B": [[0]],
             "inputs": {"u": {"file": table(tmp_path), "hold": hold}}}
    result = signals(plant)
    u = FUNCTIONS[hold]
    zeros = [a - u_a * (b - a) / (u_b - u_a)
             for (a, u_a), (b, u_b) in pairwise(zip(T, U, strict=True)) if u_a * u_b < 0]
    cuts = np.union1d(T, zeros if hold == "linear" else [])
    middles, steps = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)  # lines between cuts
    area = np.sum(steps * (np.abs(u(middles)) + np.sign(u(middles))))
    assert result["x"][-1] == pytest.approx(0.5 + area, abs=1e-12)


@pytest.mark.parametrize("argument", [
    "(u - 0.7)*(u - 0.7001)", "abs(u - 0.70005) - 5e-5", "exp(-1) - exp(-((u - 0.70005)/5e-5)**2)"
])
def test_a_table_may_pass_a_jump_and_come_back_at_once(tmp_path, argument):
    """x' = sign(.), −1 for 0.7 < u < 0.7001 only."""
    plant = {**PLANT, "A": [[0]], "phi": [f"sign({argument})"], "B": None,
             "inputs": {"u": {"file": table(tmp_path)}}}
    slopes = np.diff(U) / np.diff(T)
    inside = sum(1e-4 / abs(slope) for slope, ends in zip(slopes, pairwise(U), strict=True)
                 if min(ends) < 0.7 < max(ends))
    assert signals(plant)["x"][-1] == pytest.approx(3.5 - 2 * inside, abs=1e-8)


@pytest.mark.parametrize("width", [1e-2, 1e-4])
@pytest.mark.parametrize("extra", [{}, {"v": "sin(t)"}])
def test_what_is_narrow_in_a_table_is_found(tmp_path, width, extra):
    """x' = exp(−((u − a)/w)²)/w, whose integral over a line is known."""
    plant = {**PLANT, "A": [[0]], "phi": [f"exp(-((u - 0.7123)/{width})**2)/{width}"], "B": None,
             "inputs": {**extra, "u": {"file": table(tmp_path)}}}
    slopes = np.diff(U) / np.diff(T)
    ends = erf((U - 0.7123) / width)
    moved = slopes != 0.0  # on the others u is far away
    area = np.sqrt(np.pi) / 2 * np.sum(np.diff(ends)[moved] / slopes[moved])
    assert signals(plant)["x"][-1] == pytest.approx(0.5 + area, abs=1e-8)


def test_what_is_narrow_in_a_signal_excites_a_regression(tmp_path):
    content = {"name": "slit", "unknowns": {"a": 2.0}, "psi": [["exp(-((u - 0.7123)/1e-4)**2)"]],
               "signals": {"u": {"file": table(tmp_path)}}}
    estimator = {"name": "least_squares", "f0": 1e-12}
    result = run(regression=content, estimator=estimator, time={"horizon": 3})
    assert result.estimates["a"][0, -1] == pytest.approx(2.0, abs=1e-3)


def test_what_is_narrow_in_a_recorded_signal_is_found():
    """y = θ G(u), recorded where u is slow beside it: θ by all the slits that the lines pass."""
    t = np.linspace(0.0, 6.0, 25)
    u = 1.5 * np.sin(1.7 * t)
    ends = np.sqrt(np.pi) / 2 * erf((u - 0.3123) / 1e-3)
    x = 0.2 + 0.7 * np.concatenate([[0.0], np.cumsum(np.diff(ends) / np.diff(u) * np.diff(t))])
    plant = {**PLANT, "A": [[0]], "B": None, "inputs": {"u": 0}, "unknowns": {"a": 0.7},
             "F": [["exp(-((u - 0.3123)/1e-3)**2)/1e-3"]]}
    result = run(plant, data=DataFrame({"t": t, "u": u, "y": x}), estimator="least_squares")
    assert result.estimates["a"][0, -1] == pytest.approx(0.7, rel=0.1)  # y is a line in between


@pytest.mark.parametrize(
    "observer", [{"name": "gpebo", "sample_time": 0.05}, {"name": "kalman_bucy"}]
)
def test_what_is_narrow_between_samples_reaches_the_observer(observer):
    """F is a pulse of 1e-4 s; a model that misses it says that the parameter is not excited."""
    plant = {
        "name": "pulse", "states": ["x", "z"], "unknowns": {"a": 1.5}, "outputs": ["y"],
        "E": [[1, 0], [0, 1]], "A": [[-0.2, 1], [0, -0.1]], "C": [[1, 0]],
        "F": [[0], ["exp(-((t - 3.3127)/1e-4)**2)/1e-4"]], "initial_state": [1, 0.5],
    }
    simulated = run(plant, observer="none", time={"horizon": 5, "samples": 101})
    recorded = DataFrame({"t": simulated.t, "y": simulated["y"]})
    estimator = {"name": "least_squares", "f0": 1e-9}
    result = run(plant, data=recorded, observer=observer, estimator=estimator)
    assert result.estimates["a"][0, -1] == pytest.approx(1.5, abs=0.03)


def test_a_table_drives_a_plant_whose_outputs_pass_kinks(tmp_path):
    """x' = −max(x, 0) − |u| + 1 + u beside the same with the kinks' times put in by hand."""
    plant = {**PLANT, "A": [[0]], "phi": ["1 - max(y, 0) - abs(u)"], "initial_state": {"x": -0.5},
             "inputs": {"u": {"file": table(tmp_path)}}}
    x, t, u = -0.5, 0.0, FUNCTIONS["linear"]
    zeros = [0.4 * 0.3 / 1.3, 0.4 + 0.7 / 3.0]
    for end in np.union1d(T[1:], zeros):
        while t < end:
            positive = x > 0 or (x == 0 and 1 + u(t) - abs(u(t)) > 0)
            crossing = lambda _t, x: x[0]  # noqa: E731
            crossing.terminal, crossing.direction = True, -1 if positive else 1
            found = solve_ivp(
                lambda t, x, on=positive: 1 - on * x - abs(u(t)) + u(t), (t, end), [x], "DOP853",
                rtol=1e-13, atol=1e-14, events=crossing,
            )
            t, x = found.t[-1], 0.0 if found.status else found.y[0, -1]
    assert signals(plant)["x"][-1] == pytest.approx(x, abs=1e-10)
