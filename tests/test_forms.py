"""The observer on the strangeness-free form: any index, whatever is measured; further terms."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import BOOST, LORENZ, shipped
from regressions import regression
from scipy.integrate import solve_ivp
from test_observer import ROTATING
from units import Units, drawn, in_units

from gpebo_cli import check, run
from gpebo_cli.errors import ConfigError, ModelError, SolverError
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import AffineStateMap, Measurements, gpebo, observe
from gpebo_cli.observers.reduced.matrices import _eliminate_in_part, observer_matrices
from gpebo_cli.observers.reduced.system import reduced_system
from gpebo_cli.reduction.form import EquationForm, InputDerivatives, strangeness_free
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

SOLVER = SolverSettings()

# Manufactured: states are chosen functions, and the inputs are what makes them so.
CAPACITORS = {
    "name": "capacitors",
    "states": ["v1", "v2", "i", "is"],
    "inputs": {
        "u1": "sin(2*t)/2 + 3*cos(2*t) + exp(-t/5)*sin(t)",
        "u2": "-2*sin(t)**2 - 2*sin(t) + 5*cos(t)/4 + 8/5 - exp(-t/5)*sin(t)",
        "u3": "-sin(2*t) + cos(t) + 1 + 2*exp(-t/5)*sin(t)/15 + exp(-t/5)*cos(t)",
        "u4": "-sin(2*t)",
    },
    "unknowns": {"leak": -0.35},
    "outputs": ["y"],
    "E": [[2, 0, 0, 0], [0, "2 + sin(t)", 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]],
    "A": [[-0.5, 0, -1, 1], [0, "-cos(t) - 1/4", 1, 0], [1, -1, "-1/3", 0], [1, 0, 0, 0]],
    "B": np.eye(4).tolist(),
    "F": [[0], [1], [0], [0]],
    "C": [[0, 1, 0, 0]],
    "initial_state": [0, 2, 0, 1],
}
CAPACITORS_STATES = ("sin(2*t)", "cos(t) + 1", "exp(-t/5)*sin(t)", "cos(2*t)")
# A pendulum about its swing, index 3: positions, velocities, the force of the rod; θ is a load.
PENDULUM = {
    "name": "pendulum",
    "parameters": {"a": "0.6*sin(t)"},
    "states": ["x", "y", "vx", "vy", "force"],
    "inputs": {"wind": "sin(2*t)", "pull": "cos(3*t)"},
    "unknowns": {"load": 0.7},
    "outputs": ["seen"],
    "E": np.diag([1, 1, 1, 1, 0]).tolist(),
    "A": [
        [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [-2, 0, -0.1, 0, "sin(a)"], [0, "-1", 0, -0.2, "-cos(a)"],
        ["sin(a)", "-cos(a)", 0, 0, 0],
    ],
    "B": [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]],
    "F": [[0], [0], [1], ["cos(t)"], [0]],
    "C": [[1, 0, 0, 0, 0]],
    "initial_state": [1, 0, 0, 0.5, 0],
}
# Two tanks joined by a pipe of incompressible water: the flow in it is what keeps the levels equal.
TANKS = {
    "name": "tanks",
    "states": ["h1", "h2", "flow"],
    "inputs": {"feed": "2 + sin(t)"},
    "unknowns": {"leak": 0.3},
    "outputs": ["level"],
    "E": [["2 + cos(t)/2", 0, 0], [0, 1, 0], [0, 0, 0]],
    "A": [["sin(t)/2", 0, -1], [0, -0.4, 1], [1, -1, 0]],
    "B": [[1], [0], [0]],
    "F": [[-1], [0], [0]],
    "C": [[0, 1, 0]],
    "initial_state": [1, 1, 0],
}

# Crank, coupler and rocker about their motion, index 3: three angles, two forces of the loop.
FOUR_BAR = {
    "name": "four_bar",
    "parameters": {
        "l1": 1, "l2": 3, "l3": 2.5, "l4": 3.2,
        "a": "1.1 + 0.6*sin(t) + 0.2*t",
        "gx": "l4 - l1*cos(a)", "gy": "-l1*sin(a)",   # from the crank's pin to the rocker's bearing
        "g": "sqrt(gx**2 + gy**2)",
        "b": "atan(gy/gx) + acos((g**2 + l2**2 - l3**2)/(2*g*l2))",
        "px": "l1*cos(a) + l2*cos(b) - l4", "py": "l1*sin(a) + l2*sin(b)",
        "c": "atan(py/px) + pi*(1 - sign(px))/2",
    },
    "states": ["da", "db", "dc", "wa", "wb", "wc", "fx", "fy"],
    "inputs": {"drive": "sin(2*t)", "wind": "cos(3*t)"},
    "unknowns": {"load": 0.8},
    "outputs": ["crank"],
    "E": [[1, 0, 0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0, 0],
          [0, 0, 0, 4, "1.5*cos(a-b)", 0, 0, 0], [0, 0, 0, "1.5*cos(a-b)", 3, 0, 0, 0],
          [0, 0, 0, 0, 0, 2, 0, 0], [0] * 8, [0] * 8],
    "A": [[0, 0, 0, 1, 0, 0, 0, 0], [0, 0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1, 0, 0],
          [-2, 0, 0, -0.3, "-3*sin(a-b)*d(b)", 0, "-l1*sin(a)", "l1*cos(a)"],
          [0, -1, 0, "3*sin(a-b)*d(a)", -0.2, 0, "-l2*sin(b)", "l2*cos(b)"],
          [0, 0, -1.5, 0, 0, -0.4, "l3*sin(c)", "-l3*cos(c)"],
          ["-l1*sin(a)", "-l2*sin(b)", "l3*sin(c)", 0, 0, 0, 0, 0],
          ["l1*cos(a)", "l2*cos(b)", "-l3*cos(c)", 0, 0, 0, 0, 0]],
    "B": [[0, 0], [0, 0], [0, 0], [1, 0], [0, 0], [0, 1], [0, 0], [0, 0]],
    "F": [[0], [0], [0], [0], [0], ["1+cos(t)/2"], [0], [0]],
    "C": [[1, 0, 0, 0, 0, 0, 0, 0]],
    "initial_state": [0.1, 0, 0, 0, 0, 0, 0, 0],
}
# Trolley and load on a rope of varying length about a swing, index 3; θ are friction and wind.
CRANE = {
    "name": "crane",
    "parameters": {"s": "0.5*sin(1.3*t)", "L": "3 + 0.5*cos(t/2)"},
    "states": ["x", "px", "pz", "vx", "vpx", "vpz", "tension"],
    "inputs": {"push": "sin(t)", "hoist": "0.1*sin(t)**2"},
    "unknowns": {"friction": 0.5, "wind": -0.3},
    "outputs": ["y"],
    "E": np.diag([1, 1, 1, 2, 1, 1, 0]).tolist(),
    "A": [[0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 1, 0],
          ["-3/L", "3/L", 0, -0.3, 0, 0, "sin(s)"], ["3/L", "-3/L", 0, 0, -0.1, 0, "-sin(s)"],
          [0, 0, "-3/L", 0, 0, -0.1, "cos(s)"],
          ["-sin(s)", "sin(s)", "-cos(s)", 0, 0, 0, 0]],
    "B": [[0, 0], [0, 0], [0, 0], [1, 0], [0, 0], [0, 0], [0, -1]],
    "F": [[0, 0], [0, 0], [0, 0], ["cos(t)", 0], [0, 1], [0, 0], [0, 0]],
    "C": [[1, 0, 0, 0, 0, 0, 0]],
    "initial_state": [0, 0.2, 0, 0, 0, 0, 0],
}
# Two capacitors and a source in one loop, index 2, and a coil; θ is a leak.
LC_LOOP = {
    "name": "lc_loop",
    "parameters": {"C1": "2 + sin(t)/2", "C2": "1 + cos(t)/3", "L": "1.5 + sin(2*t)/2"},
    "states": ["v1", "v2", "v3", "i", "is"],
    "inputs": {"V": "3*sin(t) + cos(2*t)"},
    "unknowns": {"leak": 0.4},
    "outputs": ["y"],
    "E": [["C1", 0, 0, 0, 0], [0, "C2", 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, "L", 0],
          [0, 0, 0, 0, 0]],
    "A": [["-d(C1)", 0, 0, 0, 1], [0, "-d(C2)", 0, -1, 1], [0, 0, -0.5, 1, 0],
          [0, 1, -1, "-0.2-d(L)", 0],
          [-1, -1, 0, 0, 0]],
    "B": [[0], [0], [0], [0], [1]],
    "F": [[0], [0], [1], [0], [0]],
    "C": [[0, 0, 1, 0, 0]],
    "initial_state": [0, 1, 0, 0, 0],
}


def observed(plant, horizon=10.0, noisy=(), **settings):
    """η − truth and the largest error of the states, by least squares over the whole horizon."""
    system = plant if not isinstance(plant, dict) else plant_from_mapping(plant)
    signals = simulate(system, TimeSettings(horizon=horizon), SOLVER).signals
    known = np.array([name not in noisy for name in system.inputs], dtype=bool)
    seen = Measurements(
        signals.inputs, signals.outputs, None, InputDerivatives.of_plant(system, known)
    )
    found = observe(system, seen, SOLVER, **settings)
    gram = found.regression.gram.final
    eta = np.linalg.lstsq(gram[:, :-1], gram[:, -1], rcond=1e-16)[0]
    t = np.linspace(0.0, horizon, 101)
    truth = found.truth(t, system.theta_at(t), signals.states)[-1]
    x = found.state_map.at(t)(np.broadcast_to(eta, (1, len(t), len(eta))))[0]
    return found, eta - truth, float(np.abs(x - signals.states(t)).max())


@pytest.mark.parametrize("when", [0.7, 1.2345678])
def test_assumption_1_may_fail_at_a_time_that_is_met_when_elements_are_cut(when):
    plant = {
        "name": "passing", "states": ["w", "a", "b"], "outputs": ["y"], "inputs": {"u": "sin(t)"},
        "E": [[1, 0, 0], [0, 0, 1], [0, 0, 0]], "A": [[-1, 1, 0.5], [0, 1, 0], [0, 0, 1]],
        "B": [[0], [0], [-1]], "C": [[1, f"t - {when}", 0]], "initial_state": [1, 0, 0],
    }
    with pytest.raises((ModelError, SolverError)):
        observed(plant, form="given")
    _, error, of_states = observed(plant)
    assert max(np.abs(error).max(), of_states) < 1e-9


def assert_terms(regression):
    """The scale is that of the terms of ψ so far, which are no smaller than ψ."""
    sizes = np.abs(regression.psi.values[:, [0, -1]]).max(axis=(1, 2))
    scale = np.broadcast_to(regression.scale, sizes.shape)
    assert (scale >= (1.0 - 1e-9) * np.maximum.accumulate(sizes, axis=0)).all()
    assert (np.diff(scale, axis=0) >= 0.0).all()


CONSTRAINED = [CAPACITORS, PENDULUM, TANKS, FOUR_BAR, CRANE, LC_LOOP]


@pytest.mark.parametrize("start", [None, 0.3])
@pytest.mark.parametrize("plant", CONSTRAINED, ids=lambda p: p["name"])
def test_constrained_plants_from_one_output(plant, start):
    """Wherever the extension starts: hidden constraints leave it less than the states of E x'."""
    if plant not in (CAPACITORS, CRANE):  # of which something is left
        with pytest.raises(ModelError, match=r"Assumption 1 .* observer\.form=strangeness_free"):
            observed(plant, form="given")
    E = plant_from_mapping(plant).coefficients.taylor(np.zeros(1), 0).E[0, 0]
    xi_a0 = None if start is None else [start] * int(np.linalg.matrix_rank(E))
    found, error, of_states = observed(plant, xi_a0=xi_a0)
    assert np.abs(error).max() < 1e-9
    assert of_states < 1e-9
    assert_terms(found.regression)
    assert "on the strangeness-free form, for as given Assumption 1" in found.note
    evidence = {a.name: a.evidence for a in found.assumptions}["Assumption 1"]
    assert evidence["form"] == "strangeness_free"


# Two masses on a rod, index 3: the force in it acts on both.
ROD = {
    "name": "rod", "states": ["p1", "p2", "v1", "v2", "force"],
    "inputs": {"u": "sin(2*t) + cos(t)/2"}, "unknowns": {"load": 0.7}, "outputs": ["y"],
    "E": np.diag([1, 1, 1, 2, 0]).tolist(),
    "A": [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], ["-2 - sin(t)", 0, -0.1, 0, 1],
          [0, "-3/2 - 0.3*cos(2*t)", 0, -0.2, 0.6], [1, 0.6, 0, 0, 0]],
    "B": [[0], [0], [1], [0], [0]], "F": [[0], [0], [1], [0], [0]], "C": [[1, 0, 0, 0, 0]],
    "initial_state": [0.6, -1, 0, 0, 0],
}


@pytest.mark.parametrize(("plant", "lost"), [
    (CAPACITORS, {"is"}), (ROD, {"v1", "v2", "force"}),
], ids=["capacitors", "rod"])
@pytest.mark.parametrize("unit", [1.0, 1e-7])
def test_what_a_failure_of_assumption_1_does_not_touch_is_kept(plant, lost, unit):
    """The unknown v drives some states and not others; units of what is lost do not matter."""
    last = np.diag([*[1.0] * (len(plant["states"]) - 1), unit])
    plant = {**plant, "A": [[*row[:-1], f"({row[-1]})*{unit}"] for row in plant["A"]],
             "initial_state": list(np.linalg.solve(last, plant["initial_state"]))}
    result = run(plant, estimator="ls_drem", time={"horizon": 10},
                 observer={"name": "gpebo", "form": "given"})
    told = result.details.estimable
    assert {name for name in plant["states"] if told[name] is None} == lost
    for name in (*plant["unknowns"], *plant["states"]):
        error = np.abs(result.errors[name][0, -1])
        assert np.isnan(error) if name in lost else error < 1e-9
    (warning,) = result.details.warnings
    assert "fails at t = 0" in warning
    assert "singular value" in warning
    noisy = run(plant, estimator="ls_drem", time={"horizon": 10}, noise="gaussian",
                observer={"name": "gpebo", "form": "given"})
    stds = dict(zip(plant["states"], noisy.details.estimation.states_std[0, -1], strict=True))
    assert all(np.isfinite(stds[name]) == (name not in lost) for name in stds)
    with pytest.raises(ModelError, match="Assumption 1"):
        run(plant, observer={"name": "gpebo", "form": "given", "remedy": "reset"})


@settings(max_examples=4, deadline=None)
@given(
    where=st.floats(0.1, 2.9), first=st.sampled_from([0, 1]), follows=st.booleans(),
    sees=st.sampled_from(["{} - {}", "{1} - {0}", "({0} - {1})**2"]),
)
def test_an_output_that_is_blind_at_one_time_alone_fails_assumption_1_there(
    where, first, follows, sees
):
    """No node of the mesh need be there: next to it K has a pole, which elements may step over."""
    plant = {
        "name": "blind", "states": ["x", "z"], "inputs": {"u": "3*t"}, "outputs": ["y"],
        "unknowns": {"k": 1}, "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, 0]], "B": [[1], [0]],
        "phi": [0, "-cos(t)"], "F": [[1], [0]], "initial_state": [1, 0],
        "C": [[first, sees.format("u/3" if follows else "t", where)]],
    }
    with pytest.raises(ModelError, match=r"fails at t = \S+: .*=strangeness_free") as caught:
        run(plant, time={"horizon": 3}, observer={"name": "gpebo", "form": "given"})
    assert float(str(caught.value).split("t = ")[1].split(":")[0]) == pytest.approx(where, abs=1e-3)
    found = run(plant, time={"horizon": 3})
    assert max(float(np.abs(found.errors[name][0, -1])) for name in "xz") < 1e-9
    assert "fails at t" in found.verdict


def test_the_states_are_those_in_closed_form():
    system = plant_from_mapping(CAPACITORS)
    result = run(CAPACITORS, estimator="ls_drem", time={"horizon": 10})
    t = result["t"] if "t" in dir(result) else np.linspace(0, 10, 1001)
    exact = [eval(text.replace("sin", "np.sin").replace("cos", "np.cos")  # noqa: S307
                  .replace("exp", "np.exp"), {"np": np, "t": t}) for text in CAPACITORS_STATES]
    for name, values in zip(system.states, exact, strict=True):
        assert np.abs(result.estimates[name][0, -1] - values[-1]) < 1e-9


def test_the_loop_of_the_four_bar_linkage_closes():
    """Its angles are those of a linkage: l1 e^{ia} + l2 e^{ib} = l4 + l3 e^{ic}, at all times."""
    t = np.linspace(0.0, 10.0, 101)
    system = plant_from_mapping({**FOUR_BAR, "phi": [*"abc", *["0"] * 5]})
    a, b, c = system.coefficients.taylor(t, 0, t).phi[0, :, :3].T
    loop = np.exp(1j * a) + 3.0 * np.exp(1j * b) - 3.2 - 2.5 * np.exp(1j * c)
    assert np.abs(loop).max() < 1e-12


@pytest.mark.parametrize("plant", CONSTRAINED, ids=lambda p: p["name"])
def test_deviations_agree_with_seeds(plant):
    result = run(
        plant, estimator={"name": "least_squares", "f0": 1e-9}, time={"horizon": 5},
        noise={"name": "gaussian", "outputs": 0.01, "sample_time": 0.05, "seeds": 100},
    ).details
    ratio = result.noise.deviation[0] / result.estimation.parameters_std[0, -1]
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * 100))


def measured(plant):
    """With every state measured, Assumption 1 holds as given, too."""
    n = len(plant["states"])
    return {**plant, "outputs": [f"y{i}" for i in range(n)], "C": np.eye(n).tolist()}


FOLLOWING = {  # index 1: no output is differentiated
    "name": "following", "states": ["a", "z"], "unknowns": {"k": 2}, "outputs": ["y", "w"],
    "E": [[1, 0], [0, 0]], "A": [["-y", 1], ["y", "-2 - w**2"]], "F": [["sin(t)"], ["-w"]],
    "C": [[1, 0], [1, 1]], "initial_state": [1, 0],
}


# A mass on a guide that an unknown moves: constraints say p and v at the start, beside it.
GUIDED = {
    "name": "guided", "states": ["p", "v", "force", "z"], "inputs": {"u": "0.2 + sin(2*t)"},
    "unknowns": {"k": 0.7}, "outputs": ["y"], "E": np.diag([1, 1, 0, 1]).tolist(),
    "A": [[0, 1, 0, 0], [-1, -0.3, 1, 0], [1, 0, 0, 0], [0, 1, 0, -0.5]],
    "B": [[0], [0], [-0.4], [0]], "F": [[0], [0], ["-cos(t)"], [0]], "C": [[0, 0, 1, 0.5]],
    "initial_state": [0, 0, 0, 1],
}


@pytest.mark.parametrize("form", ["given", "strangeness_free"])
@pytest.mark.parametrize("plant", [
    *map(measured, [*CONSTRAINED, GUIDED]), FOLLOWING, ROTATING,
    shipped("circuit"), shipped("descriptor"),
], ids=lambda p: p["name"] if isinstance(p, dict) else p.name)
def test_both_forms_find_the_truth_where_both_exist(plant, form):
    found, error, of_states = observed(plant, 5.0, form=form)
    assert max(np.abs(error).max(), of_states) < 1e-10
    assert found.note == ""


@pytest.mark.parametrize("settings", [
    {"remedy": "reset", "reset_interval": 3.0}, {"remedy": "output_injection"},
], ids=lambda s: s["remedy"])
def test_remedies_take_the_same_form(settings):
    result = run(
        PENDULUM, estimator="ls_drem", time={"horizon": 10}, observer={"name": "gpebo", **settings}
    )
    assert np.abs(result.errors["load"][0, -1]) < 1e-9
    for state in PENDULUM["states"]:
        assert np.abs(result.errors[state][0, -1]) < 1e-9


@pytest.mark.parametrize("observer", [
    {"name": "gpebo", "remedy": "current_coordinates"}, {"name": "kalman_bucy"},
], ids=lambda o: o["name"])
def test_observers_of_the_current_state_take_the_same_form(observer):
    result = run(
        TANKS, estimator={"name": "least_squares", "f0": 1e-9}, time={"horizon": 10},
        observer=observer,
    )
    assert np.abs(result.errors["leak"][0, -1]) < 1e-6
    assert np.abs(result.errors["flow"][0, -1]) < 1e-6


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("plant", "derivatives"), [
    (CAPACITORS, [(1, 3)]), (CRANE, [(1, 1), (2, 1)]), (LC_LOOP, [(1, 0)]), (PENDULUM, []),
], ids=lambda p: p["name"] if isinstance(p, dict) else "")
def test_which_derivatives_hidden_constraints_contain_is_no_question_of_units(
    plant, derivatives, unit
):
    start = dict(zip(plant["states"], plant["initial_state"], strict=True))
    by = drawn(np.random.default_rng(2), plant_from_mapping(plant), decades=True)
    made = in_units({**plant, "initial_state": start}, by._replace(time=unit))
    system, t = plant_from_mapping(made), unit * np.linspace(0.0, 5.0, 17)
    inputs = InputDerivatives.of_plant(system, np.ones(system.m, dtype=bool))
    given = EquationForm.given(system, inputs, t)
    found = strangeness_free(given, t, t, None, max_mu=4, rank_tol=1e-10)
    assert list(found.derivatives) == derivatives


@pytest.mark.parametrize("unit", [1.0, 1e9])
@pytest.mark.parametrize("seed", range(3))
def test_a_derivative_that_is_rounding_in_other_coordinates_is_none(seed, unit):
    """Of x1' = x3 − x1 + u, x2' = x1 − x2 and 0 = x1 − v: x3 follows v', and no constraint u'.

    That holds of matrices with twelve decimals, too.
    """
    P, Q = np.random.default_rng(seed).normal(size=(2, 3, 3))
    E, A, B = ((unit * matrix.round(12)).tolist() for matrix in (
        P @ np.diag([1, 1, 0]) @ Q, P @ [[-1, 0, 1], [1, -1, 0], [1, 0, 0]] @ Q,
        P @ [[1, 0], [0, 0], [0, -1]],
    ))
    system = plant_from_mapping({
        "name": "p", "states": ["a", "b", "c"], "inputs": {"u": "sin(t)", "v": "cos(t)"},
        "outputs": ["y"], "E": E, "A": A, "B": B, "C": [[1, 0, 0]], "initial_state": [1, 1, 1],
    })
    t = np.linspace(0.0, 2.0, 17)
    inputs = InputDerivatives.of_plant(system, np.array([False, True]))
    given = EquationForm.given(system, inputs, t)
    found = strangeness_free(given, t, t, None, max_mu=3, rank_tol=1e-10)
    assert list(found.derivatives) == [(1, 1)]


@pytest.mark.parametrize("known", [None, False, True])
def test_an_input_in_the_equations_needs_its_derivatives_where_they_are_differentiated(known):
    """Tanks whose leak an input sets: the derivative of the other one is in a hidden constraint."""
    system = plant_from_mapping({
        "name": "p", "states": ["a", "b", "f"], "inputs": {"u": "2 + sin(t)", "v": "cos(t)"},
        "outputs": ["y"], "E": np.diag([1, 1, 0]).tolist(),
        "A": [["-u", 0, 1], [0, -1, 1], [1, -1, 0]], "B": [[0, 1], [0, 0], [0, 0]],
        "C": [[1, 0, 0]], "initial_state": [1, 1, 0],
    })
    t = np.linspace(0.0, 2.0, 17)
    signals = np.stack([2.0 + np.sin(t), np.cos(t), 0.0 * t], axis=1)
    which = None if known is None else np.array([known, True])
    inputs = None if which is None else InputDerivatives.of_plant(system, which)
    given = EquationForm.given(system, inputs, t, signals=signals)
    refused = pytest.raises(ConfigError, match="derivatives of the input u, the equations contain")
    with nullcontext() if known else refused:
        strangeness_free(given, t, t, signals, max_mu=3, rank_tol=1e-10)


@pytest.mark.parametrize("place", [0.1, 1.9])
def test_ranks_are_looked_at_over_all_of_the_horizon(place):
    """Beside either end, too, though the times at which equations are asked for are few."""
    system = plant_from_mapping({
        "name": "p", "states": ["x", "z"], "outputs": ["y"], "E": [[1, 0], [0, 0]],
        "A": [[-1, 1], [1, f"t - {place}"]], "C": [[1, 0]], "initial_state": [1, 1],
    })
    t = np.array([0.0, 1.0, 2.0])
    inputs = InputDerivatives.of_plant(system, np.ones(0, dtype=bool))
    with pytest.raises(ModelError, match="differential part changes at t = "):
        strangeness_free(
            EquationForm.given(system, inputs, t), t, t, None, max_mu=3, rank_tol=1e-10
        )


def test_an_algebraic_state_in_no_row_but_its_outputs_needs_the_form_as_given():
    """Titration: what is measured follows from a nonlinear row, in which only its output stands."""
    plant = {
        "name": "p", "states": ["x", "s"], "outputs": ["y"], "unknowns": {"feed": 0.5},
        "E": [[1, 0], [0, 0]], "A": [[-1, 0], [1, 0]], "F": [[1], [0]], "phi": [0, "-y - y**3"],
        "C": [[0, 1]], "initial_state": [2, 1],
    }
    with pytest.raises(ModelError, match=r"strangeness_free takes y as known, .*form=given takes"):
        run(plant, observer={"form": "strangeness_free"}, time={"horizon": 2.0})
    result = run(plant, observer={"form": "given"}, time={"horizon": 2.0}, estimator="ls_drem")
    assert abs(result.errors["feed"][0, -1]) < 1e-9


@pytest.mark.parametrize("known", [False, True])
def test_derivatives_of_inputs_go_along_where_they_are_known(known):
    """Those of outputs never do; of order zero there are values alone."""
    system, t = plant_from_mapping(BOOST), np.linspace(0.1, 1.0, 5)
    inputs = InputDerivatives.of_plant(system, np.array([True])) if known else None
    signals = np.stack([0.5 + 0.1 * np.sin(3 * t), 18.0 + t], axis=1)
    form = EquationForm.given(system, inputs, t, signals=signals)
    for order in (0, 2):
        along = form.along(t, t, signals, order)
        assert along.shape == (order + 1, 5, 2)
        np.testing.assert_array_equal(along[0], signals)
        assert not along[1:, :, 1].any()
        slopes = np.stack([0.3 * np.cos(3 * t), -0.45 * np.sin(3 * t)])[:order] * known
        np.testing.assert_allclose(along[1:, :, 0], slopes, atol=1e-14)
    with pytest.raises(ValueError, match="follow signals, and none are given"):
        form.along(t, t, None, 0)


def test_a_recorded_input_that_a_hidden_constraint_differentiates_is_named():
    """Of the four inputs u4 is the only one whose derivative is needed."""
    made = run(CAPACITORS, observer="none", time={"horizon": 3, "samples": 301})
    names = [*CAPACITORS["inputs"], *CAPACITORS["outputs"]]
    frame = made.to_pandas("signals").reset_index()[["t", *names]]
    found = run(CAPACITORS, data={"frame": frame, "hold": "cubic"}, estimator="least_squares")
    told = "; derivatives of u4 are its interpolant's, which amplify its noise"
    assert told in found.verdict
    assert "derivatives of" not in found.verdict.replace(told, "")


def test_a_recorded_input_in_the_matrices_of_a_hidden_constraint_is_named():
    """0 = u x - 1 makes z = x' = -u'/u²."""
    plant = {
        "name": "follows", "states": ["x", "z", "w"], "inputs": {"u": 1}, "outputs": ["y"],
        "E": np.diag([1, 0, 1]).tolist(), "A": [[0, 1, 0], ["u", 0, 0], [0, 0, -1]],
        "phi": [0, -1, 0], "B": [[0]] * 3, "C": [[0, 0, 1]], "initial_state": [0.5, 0, 1],
    }
    t = np.linspace(0.0, 3.0, 301)
    frame = {"t": t, "u": 2 + np.sin(t), "y": np.exp(-t)}
    found = run(plant, data={"frame": frame, "hold": "cubic"})
    assert "; derivatives of u are its interpolant's, which amplify its noise" in found.verdict
    z = -np.cos(t) / (2 + np.sin(t)) ** 2
    assert abs(found.estimates["z"][0, -1] - z[-1]) < 1e-6


def test_a_noisy_input_in_a_hidden_constraint_is_named():
    with pytest.raises(ConfigError, match=r"u4, a hidden constraint on i, is contains .* order 1"):
        observed(CAPACITORS, noisy=("u4",))
    observed(CAPACITORS, noisy=("u1", "u2", "u3"))  # in no hidden constraint
    with pytest.raises(ConfigError, match="the input u4"):
        run(CAPACITORS, observer={"name": "gpebo", "sample_time": 0.1}, estimator="ls_drem",
            noise={"name": "gaussian", "inputs": 0.1})


@pytest.mark.parametrize("plant", CONSTRAINED, ids=lambda p: p["name"])
def test_samples_converge_with_the_order_of_the_hold(plant):
    """Derivatives of inputs in hidden constraints are those of the plant's text."""
    names = [*plant["unknowns"], *plant["states"]]
    coarse, fine = ([
        np.abs(result.errors[name][0, -1]) / np.abs(result.estimates[name]).max() for name in names
    ] for result in (
        run(plant, estimator="ls_drem", time={"horizon": 10},
            observer={"name": "gpebo", "sample_time": step, "hold": "linear"})
        for step in (0.08, 0.04)
    ))
    assert max(fine) < 2e-3
    assert max(coarse) / max(fine) > 3.5


def test_check_says_which_form_and_why():
    (found,) = [a for a in check(TANKS) if a.name == "Assumption 1"]
    assert found.holds
    assert found.evidence["form"] == "strangeness_free"
    assert "as given Assumption 1" in str(found.evidence["because"])
    (found,) = [a for a in check("circuit") if a.name == "Assumption 1"]
    assert found.evidence["form"] == "given"


@pytest.mark.parametrize(("of_all", "long", "forms"), [
    ("growing", 10_000, ["auto", "strangeness_free"]), ("growing", 1, ["auto"]),
    ("circuit", 10_000, ["auto"]), ("index 1", 10_000, ["auto"]),
    ("index 2", 10_000, ["auto", "strangeness_free"]),
])
def test_the_other_form_costs_no_more_than_a_few_elements_where_one_will_do(
    of_all, long, forms, monkeypatch
):
    """What its rounding leaves is not resolved with all elements; that costs minutes.

    Unasked a long run is not observed twice, nor one that as given determines everything, nor one
    of index 1, whose constraints are all there: of c nothing is seen. No unit decides.
    """
    monkeypatch.setattr(gpebo, "_LONG", long)
    given, asked = gpebo.reduced_system, []

    def noted(system, signals, solver, **settings):
        asked.append((settings["form"], solver.max_elements))
        return given(system, signals, solver, **settings)

    monkeypatch.setattr(gpebo, "reduced_system", noted)
    growing = {
        "name": "growing", "states": ["a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[3, 1], [1, 1]], "B": [[1], [1]], "C": [[0, 1]],
        "initial_state": [1, -1],
    }
    hidden = {
        "name": "hidden", "states": list("abce"), "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": np.diag([1e-6, 0, 1e-6, 0]).tolist(), "B": [[0], [1e-9], [0], [1]],
        "A": [[-1e-6, 1e-6, 0, 0], [-1e-9, 1e-9 if of_all == "index 1" else 0, 0, 0],
              [0, 0, -1e-6, 0], [0, 0, 0, -1]], "C": [[0, 1, 0, 0]],
        "initial_state": [0, 0, 1, 0],
    }
    plants = {"growing": growing, "index 1": hidden, "index 2": hidden}
    run(plants.get(of_all, of_all), time={"horizon": 10})
    assert [form for form, _ in asked] == forms
    assert all(elements < 0.1 * SOLVER.max_elements for _, elements in asked)


@pytest.mark.parametrize(("part", "told"), [(1.0, (True, 3)), (1e-6, (True, 1))])
def test_what_was_told_is_told_for_good(part, told):
    """Two columns of ψ that are apart by ``part`` e^−t, which drowns in e^1.5t; x is their sum."""
    def psi(t):
        return np.exp(1.5 * t)[..., None] + part * np.exp(-t)[..., None] * np.arange(2)

    found = regression(psi, np.ones(2))
    of_state = np.ones((found.mesh.points.size, 1, 2))
    state_map = AffineStateMap(*map(found.mesh.trajectory, (of_state[:, :, 0], of_state)))
    observed = SimpleNamespace(regression=found, state_map=state_map, growth=None)
    assert gpebo._told(observed, SimpleNamespace(q=2, n=1), SOLVER) == told


@pytest.mark.parametrize(("told", "why"), [
    ([(True, 1), (True, 2)], "which determines more than the equations as given"),
    ([(False, 9), (True, 1)], "which tells with more digits what the equations as given tell, or"),
    ([(True, 2), (True, 2)], ""),
])
def test_why_the_other_form_is_taken_is_said(told, why, monkeypatch):
    monkeypatch.setattr(gpebo, "_same_on_both_forms", lambda *_: False)
    monkeypatch.setattr(gpebo, "_told", lambda *_: told.pop(0))
    said = run("descriptor", time={"horizon": 1}).verdict
    assert why in said
    assert ("strangeness-free form" in said) == bool(why)
    observer = {"name": "gpebo", "remedy": "reset"}  # of which that is not asked
    run("descriptor", time={"horizon": 1}, observer=observer, estimator="least_squares")
    assert not told


@pytest.mark.parametrize("remedy", ["reset", "output_injection", "current_coordinates"])
def test_with_a_remedy_too_the_other_form_is_taken_where_one_is_not_resolved(monkeypatch, remedy):
    given = gpebo.reduced_system

    def lost(system, signals, solver, *, form, **settings):
        if form in refused:
            raise SolverError(f"rounding of {form}")
        return given(system, signals, solver, form=form, **settings)

    monkeypatch.setattr(gpebo, "reduced_system", lost)
    observer = {"name": "gpebo", "remedy": remedy}
    refused = {"auto"}
    result = run("descriptor", observer=observer, estimator="least_squares", time={"horizon": 5})
    assert "strangeness-free form, for as given its signals are not" in result.details.verdict
    refused = {"auto", "strangeness_free"}
    with pytest.raises(SolverError, match="rounding of auto"):
        run("descriptor", observer=observer, estimator="least_squares", time={"horizon": 5})


def test_feedthrough_bias_of_a_sensor_and_a_known_term():
    plant = {
        "name": "biased", "states": ["x", "z"], "inputs": {"u": "sin(t) + cos(3*t)"},
        "unknowns": {"load": 0.4, "bias": -0.2}, "outputs": ["y1", "y2"],
        "E": [[1, 0], [0, 0]], "A": [["-1 + sin(t)/2", 1], [1, -2]], "B": [[1], [0.5]],
        "F": [["cos(t)", 0], [0, 0]], "phi": ["sin(2*t)", 0.3],
        "C": [[1, 0], [0, "1 + cos(t)/2"]], "D": [[0.7], [0]], "H": [[0, 1], ["sin(t)", 0]],
        "initial_state": [1, 0],
    }
    for form in ("given", "strangeness_free"):
        found, error, of_states = observed(plant, form=form)
        assert np.abs(error).max() < 1e-10
        assert of_states < 1e-10
        assert_terms(found.regression)


def test_an_unknown_of_the_outputs_alone_in_an_index_3_plant():
    plant = {**PENDULUM, "unknowns": {"load": 0.7, "offset": 0.25}, "H": [[0, 1]],
             "F": [[*row, 0] for row in PENDULUM["F"]], "D": [[0.3, 0]]}
    _, error, of_states = observed(plant, horizon=20.0)
    assert np.abs(error).max() < 1e-9
    assert of_states < 1e-9


def test_hidden_constraints_hold_on_the_solution():
    """0 = M x + M_v v + M_θ θ on the simulated states, with M a projector's rows."""
    system = plant_from_mapping(PENDULUM)
    signals = simulate(system, TimeSettings(horizon=5.0), SOLVER).signals
    t = np.linspace(0.0, 5.0, 57)
    inputs = InputDerivatives.of_plant(system, np.ones(2, dtype=bool))
    given = EquationForm.given(system, inputs)
    form = strangeness_free(given, t, t, None, max_mu=6, rank_tol=1e-10)
    assert form.structure is not None
    assert form.structure.mu == 2
    assert form.derivatives == ()
    hidden = form.equations(t, t, None).hidden
    v = form.driving(t, t, signals.inputs(t))[:, :, 0]
    left = np.einsum("nij,nj->ni", hidden.states, signals.states(t))
    left += np.einsum("nij,nj->ni", hidden.driving, v) + hidden.unknowns @ system.theta
    assert np.abs(left).max() < 1e-10
    assert (np.linalg.matrix_rank(hidden.states) == form.structure.a).all()


@pytest.mark.parametrize("plant", CONSTRAINED, ids=lambda p: p["name"])
def test_rounding_of_hidden_constraints_is_bounded_whatever_its_signs(plant):
    system, t = plant_from_mapping(plant), np.linspace(0.0, 5.0, 7)
    inputs = InputDerivatives.of_plant(system, np.ones(system.m, dtype=bool))
    given = EquationForm.given(system, inputs)
    form = strangeness_free(given, t, t, None, max_mu=6, rank_tol=1e-10)
    o, hidden = observer_matrices(form, t, t, 1e-10), form.equations(t, t, None).hidden
    K = (o.elimination @ transpose(o.range))[:, :, -system.n - system.r : -system.r]
    signs = np.sign(np.random.default_rng(0).normal(size=(50, 1, system.n, system.n)))
    wrong = np.abs(K @ (signs * hidden.rounding)).max(axis=(0, 1))
    assert (wrong <= (1.0 + 1e-9) * o.rounding + 1e-300).all()
    assert (o.rounding <= 100.0 * system.n * hidden.rounding.max()).all()


@pytest.mark.parametrize("plant", [CAPACITORS, LC_LOOP, CRANE], ids=lambda p: p["name"])
def test_rounding_of_hidden_constraints_is_as_large_in_any_units(plant):
    start, t = dict(zip(plant["states"], plant["initial_state"], strict=True)), np.linspace(0, 5, 7)
    by, found = drawn(np.random.default_rng(4), plant_from_mapping(plant), decades=True), []
    for units in (Units(*map(np.ones_like, by[:-1]), 1.0), by):
        system = plant_from_mapping(in_units({**plant, "initial_state": start}, units))
        T = float(units.time)
        inputs = InputDerivatives.of_plant(system, np.ones(system.m, dtype=bool))
        given = EquationForm.given(system, inputs, T * t)
        form = strangeness_free(given, T * t, T * t, None, max_mu=6, rank_tol=1e-10)
        found.append(form.equations(T * t, T * t, None).hidden.rounding * form.units.states)
    assert (found[1] < 1e3 * found[0].max()).all()
    assert found[1].max() > 1e-3 * found[0].max()


def test_derivatives_of_a_signal_are_those_of_its_polynomials():
    mesh = Mesh(np.linspace(0.0, 2.0, 9), radau_rule(10))
    signal = Trajectory(mesh, np.stack([np.sin(3 * mesh.points), mesh.points**2], axis=2))
    t = np.linspace(0.05, 1.95, 41)
    found = InputDerivatives.of_signal(signal, np.array([True, True])).taylor(t, t, 2)
    exact = [[np.sin(3 * t), t**2], [3 * np.cos(3 * t), 2 * t], [-4.5 * np.sin(3 * t), 1 + 0 * t]]
    np.testing.assert_allclose(found, np.moveaxis(exact, 1, 2), atol=1e-7)


# Matrices along measured signals ------------------------------------------------------------------


def solved(system, duty, horizon):
    """Trajectories of u, y and x by scipy."""
    C = system.coefficients.taylor(np.zeros(1), 0, None, np.ones((1, 1, system.m + 1))).C[0, 0]

    def right(t, x):
        at, signals = np.array([t]), np.append(duty(t)[: system.m], C @ x)
        c = system.coefficients.taylor(at, 0, at, signals[None, None])
        f = c.A[0, 0] @ x + c.F[0, 0] @ system.theta + c.phi[0, 0]
        return np.linalg.solve(c.E[0, 0], f)

    mesh = Mesh(np.linspace(0.0, horizon, 161), radau_rule(14))
    points = np.unique(mesh.points)
    found = solve_ivp(
        right, (0, horizon), system.initial_state, "DOP853", points, rtol=3e-14, atol=1e-13
    )
    x = found.y.T[np.searchsorted(points, mesh.points)]
    u = np.stack([duty(t)[: system.m] for t in mesh.points.ravel()])
    u = u.reshape(*mesh.points.shape, -1)
    return Trajectory(mesh, u), Trajectory(mesh, x @ C.T), Trajectory(mesh, x)


@pytest.mark.parametrize("plant", [BOOST, LORENZ], ids=lambda p: p["name"])
def test_matrices_along_measured_signals(plant):
    """Signals by scipy, an unknown and the initial state by the observer."""
    system = plant_from_mapping(plant)
    u, y, states = solved(system, lambda t: np.array([0.5 + 0.1 * np.sin(3 * t)]), 3.0)
    found = observe(system, Measurements(u, y), replace(SOLVER, tol=1e-11))
    gram = found.regression.gram.final
    eta = np.linalg.lstsq(gram[:, :-1], gram[:, -1], rcond=1e-16)[0]
    t = np.linspace(0.0, 3.0, 101)
    truth = found.truth(t, system.theta_at(t), states)[-1]
    np.testing.assert_allclose(eta, truth, atol=1e-9)
    estimate = found.state_map.at(t)(np.broadcast_to(eta, (1, len(t), len(eta))))[0]
    np.testing.assert_allclose(estimate, states(t), atol=1e-8)
    assert found.respond is None  # Y is not affine in noise that is in the matrices, too


def with_entry(row, column, entry):
    A = [list(entries) for entries in PENDULUM["A"]]
    A[row][column] = entry
    return {**PENDULUM, "A": A}


@pytest.mark.parametrize(("load", "pushes"), [(0.7, [0, 0, 1, "cos(t)", 0]), (0.0, [0] * 5)])
def test_an_output_in_equations_that_nobody_differentiates(load, pushes):
    """The pendulum's spring follows the measured position: its row stands in no derivative.

    Neither does it where no hidden constraint has part in the unknown.
    """
    plant = {**with_entry(2, 0, "-2 - seen**2"), "F": [[entry] for entry in pushes]}
    found, error, of_states = observed({**plant, "unknowns": {"load": load}}, 5.0)
    assert "strangeness-free" in found.note
    assert np.abs(error).max() < 1e-9
    assert of_states < 1e-9


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
@pytest.mark.parametrize("entry", [(4, 0, "sin(a) + seen/50"), (0, 0, "-seen")])
def test_a_hidden_constraint_that_differentiates_an_output_is_refused(entry, unit):
    """The rod's constraint is differentiated twice, the positions' equations once."""
    start = dict(zip(PENDULUM["states"], PENDULUM["initial_state"], strict=True))
    plant = {**with_entry(*entry), "initial_state": start}
    units = Units(*map(np.ones, (5, 1, 2, 1, 5)), unit)._replace(outputs=np.ones(1) / unit)
    system = plant_from_mapping(in_units(plant, units))
    mesh = Mesh(np.linspace(0.0, unit, 3), radau_rule(5))
    signal = Trajectory(mesh, np.ones((2, 6, 2)))
    seen = Measurements(
        signal, Trajectory(mesh, mesh.points[..., None] / unit**2), None,  # from zero on
        InputDerivatives.of_signal(signal, np.array([True, True])),
    )
    with pytest.raises(ConfigError, match="contains the derivative of the output seen, which is"):
        observe(system, seen, SOLVER)


# Edges ----------------------------------------------------------------------------------------


def test_a_plant_without_derivatives():
    plant = {
        "name": "algebraic", "states": ["x", "z"], "inputs": {"u": "sin(t)"},
        "unknowns": {"a": 0.5}, "outputs": ["y"], "E": [[0, 0], [0, 0]],
        "A": [[-1, 0.3], [0, -2]], "B": [[1], [0]], "F": [[0], [1]], "C": [[1, 0]],
        "initial_state": [0, 0],
    }
    for chosen in ({}, {"remedy": "reset"}, {"remedy": "output_injection"}):
        found, error, of_states = observed(plant, 5.0, **chosen)
        assert found.regression.parameters == ("a",)
        assert found.growth_rate == 0.0
        assert np.abs(error).max() < 1e-12
        assert of_states < 1e-12
    noisy = run(
        plant, estimator="drem", observer={"name": "gpebo", "sample_time": 0.05},
        noise={"name": "gaussian", "outputs": 0.01}, time={"horizon": 5},
    )
    assert abs(noisy.estimates["a"][0, -1] - 0.5) < 0.05


def test_the_horizon_does_not_change_the_past():
    """A row of E that grows: what comes later has no part in ψ, Y and G before."""
    plant = {**TANKS, "E": [["2 + t**3", 0, 0], [0, "1 + t", 0], [0, 0, 0]],
             "A": [["-3*t**2", 0, -1], [0, -0.4, 1], [1, "-1 - t/5", 0.1]]}
    t = np.linspace(0.0, 1.0, 21)
    one, other = (observed(plant, horizon)[0].regression for horizon in (1.0, 4.0))
    for name in ("psi", "Y"):
        squares = [np.einsum("nr...,nr...->n...", x, x) for x in (
            getattr(regression, name)(t) for regression in (one, other))]
        np.testing.assert_allclose(*squares, rtol=1e-9, atol=1e-12)


@settings(deadline=None, max_examples=8)
@given(st.floats(0.5, 30.0), st.sampled_from([0.0, 0.4, 2.0]))
def test_what_grows_away_from_hidden_constraints_stays_on_them(rate, turn):
    """p' = v, v' = κ²p + λ, p = sin t: away from the last equation p and v grow as e^{κt}."""
    c, s = f"cos({turn!r}*t)", f"sin({turn!r}*t)"
    plant = {
        "name": "held", "states": ["p", "v", "force", "q"], "inputs": {"u": "sin(t)"},
        "unknowns": {"bias": 0.7}, "outputs": ["y"],
        "E": [[c, s, 0, 0], [f"-{s}", c, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]],
        "A": [[f"{rate**2!r}*{s}", c, s, 0], [f"{rate**2!r}*{c}", f"-{s}", c, 0], [1, 0, 0, 0],
              [0, 1, 0, -1]],
        "B": [[0], [0], [-1], [0]], "F": [[0], [0], [0], [1]], "C": [[0, 0, 0, 1]],
        "initial_state": [0.0, 1.0, 0.0, 0.0],
    }
    found = run(plant, time={"horizon": 20, "samples": 51})
    estimation, x = found.details.estimation, found.details.simulation.states
    assert set(found.details.estimable) >= {"p", "v", "force", "q", "bias", "e0_q"}
    assert None not in found.details.estimable.values()
    assert np.abs(x[:, 0] - np.sin(estimation.t)).max() < 1e-10
    assert (np.abs(estimation.states[0, -1] - x[-1]) < 1e-9 * np.abs(x).max(axis=0)).all()
    assert estimation.parameters[0, -1, 0] == pytest.approx(0.7, rel=1e-9)


def test_rounding_of_hidden_constraints_is_no_signal():
    """E = P diag(I, N) Q of index 2, all turning, a mode of 1e4: x4 is told by constraints alone.

    What e₀ has part in it is rounding, which no mesh resolves.
    """
    def product(left, right):
        return [[" + ".join(f"({a})*({b})" for a, b in zip(row, column, strict=True) if "0" not in
                            (a, b)) or "0" for column in zip(*right, strict=True)] for row in left]

    def turned(i, j, angle):
        whole = [["1" if i == j else "0" for j in range(4)] for i in range(4)]
        whole[i][i] = whole[j][j] = f"cos({angle})"
        whole[i][j], whole[j][i] = f"sin({angle})", f"-sin({angle})"
        return whole

    P = product(turned(3, 0, "1.7*t + 3.7"), turned(1, 2, "2.5*t + 5.5"))
    Q = product(turned(0, 1, "5 - 0.55*t"), turned(1, 2, "0.2 - 0.06*t"))
    N = [["1", "0", "0", "0"], ["0", "1", "0", "0"], ["0"] * 4, ["0", "0", "1", "0"]]
    rates = [["-1e4", "0", "0", "0"], ["0", "-1", "0", "0"], ["0", "0", "1", "0"],
             ["0", "0", "0", "1"]]
    slope = [["0" if e == "0" else f"-d({e})" for e in row] for row in Q]
    A = [[f"{x} + {y}" for x, y in zip(*both, strict=True)] for both in zip(
        product(P, product(rates, Q)), product(P, product(N, slope)), strict=True)]
    plant = {
        "name": "stiff", "states": ["x1", "x2", "x3", "x4"], "inputs": {"u": "sin(t)"},
        "outputs": ["y1", "y2", "y3", "y4"], "E": product(P, product(N, Q)), "A": A,
        "B": product(P, [["1e4"], ["1"], ["1"], ["0"]]), "C": np.eye(4).tolist(),
        "initial_state": dict(zip(["x1", "x2", "x3", "x4"], [0.5, -1, 0, 0], strict=True)),
    }
    stated = []
    for unit in (1.0, 1e-7):
        units = Units(unit * np.ones(4), *map(np.ones, (0, 1, 4, 4)), 1.0)
        found = run(
            in_units(plant, units), observer={"name": "gpebo", "form": "strangeness_free"},
            estimator={"name": "least_squares", "f0": None}, time={"horizon": 2, "samples": 51},
        ).details
        error = np.abs(found.estimation.states[0, -1] - found.simulation.states[-1]).max() / unit
        stated.append(found.regression.error_estimate)
        assert error < stated[-1] < 1e-6
    assert 0.1 < stated[1] / stated[0] < 10.0


@settings(deadline=None, max_examples=8)
@given(st.lists(st.integers(-7, 7), min_size=4, max_size=4), st.sampled_from(["0.3", "12"]))
def test_states_of_very_different_sizes_turn_in_the_kernel_of_E(decades, rate):
    """E = diag(1, 1, 0, 0) Q(t), index 2: E⁺ has rows that are 1e-14 of each other."""
    Q = [["1", f"sin({rate}*t)", 0, "0.4"], [0, "1", f"cos({rate}*t)", "-0.3"],
         [f"sin({rate}*t)/2", 0, "1", 0], [0, f"cos({rate}*t)/3", 0, "1"]]
    size = [10.0**k for k in decades]
    A = [["0.2", "1", "0.5", 0], ["-1", "-0.1", 0, "1"], [0, 0, "1", 0], [0, "1", 0, 0]]

    def times(left):
        return [[" + ".join(f"({row[k]})*({Q[k][j]})" for k in range(4) if row[k] and Q[k][j]) or 0
                 for j in range(4)] for row in left]

    def in_units(matrix):
        return [[f"({entry})/{size[j]!r}" if entry else 0 for j, entry in enumerate(row)]
                for row in matrix]

    # E x' = A x + B u of z' = A z + B u in two rows: A Q − Q' there.
    A = [[f"{entry} - d({Q[k][j]})" if k < 2 and Q[k][j] else entry for j, entry in enumerate(row)]
         for k, row in enumerate(times(A))]
    plant = {
        "name": "turning", "states": list("abce"), "inputs": {"u": "sin(t)", "v": "cos(2*t)"},
        "outputs": ["y"], "E": in_units(times([["1", 0, 0, 0], [0, "1", 0, 0], [0] * 4, [0] * 4])),
        "A": in_units(A), "B": [[1, 0], [0, 1], [0, 1], [1, 0]],
        "C": in_units(times([["1", 0, "0.3", 0]])),
        "initial_state": [0.0] * 4,
    }
    found = run(plant, time={"horizon": 5, "samples": 51},
                observer={"name": "gpebo", "form": "strangeness_free"})
    x, told = found.details.simulation.states, found.details.estimation.states[0, -1]
    assert None not in [found.details.estimable[name] for name in "abce"]
    assert (np.abs(told - x[-1]) < 1e-7 * np.abs(x).max(axis=0)).all()


def test_an_equation_without_states_and_unknowns_is_observed_as_given():
    """0 = 0: the pencil is singular, and an output sees what no equation determines."""
    system = plant_from_mapping({
        "name": "free", "states": ["x", "v"], "outputs": ["y"], "E": [[1, 0], [0, 0]],
        "A": [[-1, 1], [0, 0]], "C": [[0, 1]], "initial_state": [0, 0],
    })
    mesh = initial_mesh(0.0, 4.0, [], 8, radau_rule(5))
    y = Trajectory(mesh, np.sin(mesh.points)[..., None])
    found = observe(system, Measurements(Trajectory(mesh, np.zeros((8, 6, 0))), y))
    v = found.state_map.offset
    np.testing.assert_allclose(v.values[..., 1], np.sin(v.mesh.points), atol=1e-15)


@pytest.mark.parametrize(("A", "C"), [
    ({(0, 2): 1}, [0, 0, 0, "step(t - 2)"]),  # a rank that changes
    ({(0, 2): 1}, [0, 1, 0, "t - 2.001"]),  # one that may
    # a - b is told, but neither a nor b: w drives their sum, of which nothing is seen.
    ({(0, 3): 1, (1, 3): 1}, [0, 0, 0, 0]),
])
def test_a_failure_of_assumption_1_keeps_nothing_where_no_state_is_told_at_all_times(A, C):
    entries = np.diag([-1.0, -1.0, 0.0, 0.0])
    for place, value in A.items():
        entries[place] = value
    system = plant_from_mapping({
        "name": "blind", "states": ["a", "b", "v", "w"], "outputs": ["y"],
        "E": np.diag([1, 1, 0, 0]).tolist(), "A": entries.tolist(), "C": [C],
        "initial_state": [0] * 4,
    })
    mesh = initial_mesh(0.0, 4.0, [], 8, radau_rule(5))
    u, y = (Trajectory(mesh, np.zeros((8, 6, count))) for count in (0, 1))
    with pytest.raises(ModelError, match=r"Assumption 1 .* singular value"):
        observe(system, Measurements(u, y), form="given")


@pytest.mark.parametrize("size", ["1", "exp(-20*t)"])
def test_assumption_1_fails_at_the_time_that_is_named(size):
    """0 = a + size (t − 2) v: v is told at any other time, however small its factor."""
    system = plant_from_mapping({
        "name": "once", "states": ["a", "v"], "outputs": ["y"], "E": [[1, 0], [0, 0]],
        "A": [[-1, 1], [1, f"{size}*(t - 2)"]], "C": [[1, 0]], "initial_state": [0, 0],
    })
    mesh = initial_mesh(0.0, 4.0, [], 8, radau_rule(5))
    u, y = (Trajectory(mesh, np.zeros((8, 6, count))) for count in (0, 1))
    told = r"Assumption 1 .* fails at t = 2: .* singular value 0\.0e\+00 .*form=strangeness_free"
    with pytest.raises(ModelError, match=told):
        observe(system, Measurements(u, y), form="given")


def test_assumption_1_that_fails_along_a_signal_is_seen_between_its_times():
    """0 = a + (u - 2.1) v along u = t: v is told at all times of the mesh."""
    system = plant_from_mapping({
        "name": "once", "states": ["a", "v"], "outputs": ["y"], "E": [[1, 0], [0, 0]],
        "inputs": {"u": "t"}, "B": [[0], [0]],
        "A": [[-1, 1], [1, "u - 2.1"]], "C": [[1, 0]], "initial_state": [0, 0],
    })
    mesh = initial_mesh(0.0, 4.0, [], 8, radau_rule(5))
    signals = Measurements(
        Trajectory(mesh, mesh.points[..., None]), Trajectory(mesh, np.zeros((8, 6, 1)))
    )
    with pytest.raises(ModelError, match=r"Assumption 1 .* fails at t = 2\.1: "):
        observe(system, signals, form="given")


@pytest.mark.parametrize(("off", "gone"), [
    ([0, 1, 1, 1, 0], [0, 1, 1, 1, 0]), ([1, 1, 0, 1, 1], [0] * 5), ([1] * 5, [1] * 5),
    ([0, 1, 1, 1, 1], [0, 1, 1, 1, 1]),
])
def test_an_output_is_off_where_it_is_at_three_times_in_a_row(off, gone):
    """Of y = c(t) x nothing is left in Y where c is zero for a while."""
    system = plant_from_mapping({
        "name": "off", "states": ["x"], "outputs": ["y"], "E": [[1]], "A": [[-1]], "C": [["t"]],
        "initial_state": [0],
    })
    t = np.where(off, 0.0, 1.0)
    form = EquationForm.given(system)
    found = observer_matrices(form, t, t, 1e-10)
    for alone, zero in ((True, off), (False, gone)):
        taken = found._measured(alone=alone)[:, -1, -1]
        assert np.broadcast_to(taken == 0.0, 5).tolist() == list(map(bool, zero))


def test_what_is_left_where_assumption_1_fails_is_left_at_all_times():
    """Of v and w one is told, but not at t = 2.1, which is met when elements are cut."""
    system = plant_from_mapping({
        "name": "less", "states": ["a", "v", "w"], "outputs": ["y", "z"], "C": [[1, 0, 0]] * 2,
        "E": np.diag([1, 0, 0]).tolist(), "initial_state": [0, 0, 0],
        "A": [[-1, 0, 0], [0, "1 - exp(-((t - 2.1)/0.05)**2)", 0], [0, 0, 0]],
    })
    mesh = initial_mesh(0.0, 4.0, [], 8, radau_rule(5))
    signals = Measurements(*(Trajectory(mesh, np.zeros((8, 6, count))) for count in (0, 2)))
    found = reduced_system(
        system, signals, SOLVER, form="given", in_part=True, weights={"y": 4.0, "z": 36.0}
    )
    assert found.lost.tolist() == [False, False, True]
    assert found.first.output_scale[1] == pytest.approx(3.0 * found.first.output_scale[0])
    t = np.array([1.0, 2.1, 3.0])
    with pytest.raises(ModelError, match=r"the rank of \[ΠA; C\] .* changes at t = 2\.1; use"):
        found.matrices(t, t)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_nothing_is_given_up_for_rounding_where_assumption_1_fails(share):
    """v drives a and b, but not share a − b, which obeys an equation of its own."""
    plant = {
        "name": "driven", "states": ["a", "b", "v"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": np.diag([1, 1, 0]).tolist(), "A": [[-1, 0, 1], [0, -1, share], [share, 1, 0]],
        "B": [[0], [0], [-1]], "C": [[1, 0, 0]], "initial_state": [1, -share, 0],
    }
    found = run(
        plant, time={"horizon": 3.0, "samples": 31}, observer={"name": "gpebo", "form": "given"},
        estimator={"name": "least_squares", "f0": 1e-14},
    ).details
    left = np.abs(found.estimation.states[0, -1] - found.simulation.states[-1])
    assert (left[:2] < 1e-9).all()
    assert np.isnan(left[2])
    (of_E,) = (a.evidence for a in found.assumptions if a.name == "Rank of E")
    assert of_E["rank"] == 2  # with the part that is given up


def test_what_a_failure_of_assumption_1_touches_at_some_times_only_is_lost():
    """Of a and b one combination is told, at t = 0 that is a, and at π/2 it is b."""
    plant = {
        "name": "turning", "states": ["w", "a", "b", "c"], "inputs": {"u": "sin(3*t)", "v": "2*t"},
        "outputs": ["y"], "E": np.diag([1, 0, 0, 1]).tolist(), "C": [[0, 0, 0, 1]],
        "A": [[-1, "-sin(t)", "cos(t)", 0], [0, "cos(t)", "sin(t)", 0], [1, 0, 0, 0],
              [0, 0, 0, -1]],
        "B": [[0, 0], [0, -1], [-1, 0], [0, 0]], "initial_state": [0, 0, 3, 1],
    }
    found = run(plant, time={"horizon": 3.0, "samples": 31}, estimator="ls_drem",
                observer={"name": "gpebo", "form": "given"}).details
    assert [found.estimable[name] is None for name in "wabc"] == [False, True, True, False]


def test_a_failure_of_assumption_1_where_the_kernel_of_E_turns_keeps_nothing():
    plant = {
        "name": "turning", "states": ["a", "b", "w"], "inputs": {"u": "sin(t)"},
        "unknowns": {"th": 1.0}, "outputs": ["y"], "C": [[0, 0, 1]], "initial_state": [0, 0, 0],
        "E": [["cos(t)", "sin(t)", 0], [0, 0, 1], [0, 0, 0]], "B": [[0], [0], [1]],
        "A": [[0, 0, 1], [0, 0, -1], ["cos(t)", "sin(t)", 0]], "F": [[0], [1], [0]],
    }
    short = {"horizon": 5.0, "samples": 21}
    with pytest.raises(ModelError, match="Assumption 1"):
        run(plant, time=short, observer={"name": "gpebo", "form": "given"})
    found = run(plant, time=short, estimator="least_squares").estimates["th"].ravel()[-1]
    assert found == pytest.approx(1.0, abs=1e-6)


def test_a_state_that_is_zero_because_terms_cancel_is_no_signal():
    """x3 is zero at all times; what rounding makes of it needs no elements."""
    plant = {
        "name": "cancelling", "states": [f"x{i + 1}" for i in range(6)], "outputs": ["y"],
        "inputs": {"u": "cos(0.7*t) + 0.5"}, "initial_state": [1, 0.3, 0, -3, -6, -5],
        "E": [[1, -2, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, -1, 0, 0, 0], [2, 0, 1, 3, 0, -1],
              [2, 0, 0, 3, 0, -1], [-2, 0, 0, -3, 0, 1]],
        "A": [["-2.56 - 0.64/(1 + t)", "3.96 - 0.3/(1 + t)", 0, 0, 0, 0],
              ["0.22 + 0.27/(1 + t)", "0.11/(1 + t) - 2.21", 0, 0, 0, 0],
              [0, 0, 1, -1, 0, 0], [-2, 0, 0, 1, 1, 0], [-2, 0, 0, 0, 1, 0], [0, 0, 0, -2, -1, 1]],
        "B": [[1], [2], [-2], [2], [0], [-1]],
        "C": [[1, 0, -1, -1, 1, 0]],
    }
    found = run(
        plant, observer={"name": "gpebo", "form": "strangeness_free"}, estimator="least_squares",
        solver={"max_elements": 100}, time={"horizon": 3, "samples": 21},
    )
    assert np.abs(found.errors["x3"]).max() < 1e-12
    assert np.abs(found.errors["x1"][0, -1]) < 1e-6


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_a_rank_in_part_is_relative_to_the_size_of_the_equations(unit):
    """Two of three columns are one: what is told of the others is the same in any unit."""
    columns, kernel = np.random.default_rng(0).normal(size=(3, 4, 3)), np.eye(5, 3)[None]
    columns[:, :, 2] = columns[:, :, 0]
    (of_plain, inverse, least), (of_other, other, also) = (
        _eliminate_in_part(
            SimpleNamespace(name="p"), by * columns, kernel, np.full(3, 2.0 * by), np.arange(3.0),
            1e-10, np.ones(5), 2,
        ) for by in (1.0, unit)
    )
    np.testing.assert_allclose(of_other @ transpose(of_other), of_plain @ transpose(of_plain),
                               atol=1e-12)
    np.testing.assert_allclose(other @ transpose(of_other) * unit, inverse @ transpose(of_plain),
                               atol=1e-9)
    np.testing.assert_allclose(also, least, rtol=1e-9)


def test_an_unknown_input_has_no_equation_but_those_of_the_outputs():
    """A disturbance that no output sees at once: neither form determines it, and both say why."""
    system = plant_from_mapping({
        "name": "p", "states": ["x", "dist"], "outputs": ["y"], "E": [[1, 0], [0, 0]],
        "A": [[-1, 1], [0, 0]], "C": [[1, 0]], "initial_state": [1, 0],
    })
    t = np.linspace(0.0, 2.0, 5)
    given = EquationForm.given(system, None, t)
    with pytest.raises(ModelError, match=r"leaves out the .* outputs, which observer.form=given"):
        strangeness_free(given, t, t, None, max_mu=3, rank_tol=1e-10)
