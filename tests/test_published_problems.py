"""Published DAE problems with closed-form solutions, solved the general way."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from plants import DATA, problem

from gpebo_cli.errors import ModelError
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

FILES = sorted((DATA / "problems").glob("*.json"))
SOLVABLE = [path for path in FILES if "not_unique" not in path.stem]


def exact(solution: list[str], t: np.ndarray) -> np.ndarray:
    symbol = sp.Symbol("t")
    columns = [sp.lambdify(symbol, sp.sympify(text), "numpy")(t) + 0.0 * t for text in solution]
    return np.array(columns).T


@pytest.mark.parametrize("path", SOLVABLE, ids=lambda path: path.stem)
def test_problem_is_solved(path):
    data, system = problem(path)
    start, stop = data["tspan"]
    result = simulate(system, TimeSettings(start, stop - start), SolverSettings())
    assert result.structure.index == data["index"]
    assert result.structure.d == data["dynamic_dof"]
    t = np.linspace(start, stop, 401)
    truth = exact(data["solution"], t)
    error = np.abs(result.signals.states(t) - truth)
    assert error.max() < 1e-9
    # The estimate is a promise: relative to each state's size, it is not below a tenth of truth.
    size = np.maximum(np.abs(truth).max(axis=0), 1e-3 * np.abs(truth).max())
    assert (error / size).max() <= 10 * result.error_estimate


@pytest.mark.parametrize("path", SOLVABLE, ids=lambda path: path.stem)
def test_problem_is_solved_from_an_inconsistent_start(path):
    """Hidden constraints are found and the start is moved onto them."""
    data, system = problem(path)
    start, stop = data["tspan"]
    shifted = dict(vars(system), initial_state=system.initial_state + 0.3)
    result = simulate(type(system)(**shifted), TimeSettings(start, stop - start), SolverSettings())
    t = result.signals.mesh.points.ravel()
    if data["dynamic_dof"] == 0:  # no freedom: any start leads to the one solution
        error = np.abs(result.signals.states(t) - exact(data["solution"], t))
        assert error.max() < 1e-9


@pytest.mark.parametrize("angle", [0.0, *np.linspace(0.3, 6.0, 8)])
def test_the_problem_with_many_solutions_is_refused(angle):
    """Whatever rounding leaves of zeros, by which its equations are turned here."""
    data, _ = problem(DATA / "problems" / "km_3_1_not_unique.json")
    c, s = float(np.cos(angle)), float(np.sin(angle))
    turned = {name: [[f"{p!r}*({one}) + {q!r}*({other})" for one, other in zip(
        *data[name], strict=True)] for p, q in ((c, s), (-s, c))] for name in "EAB"}
    system = plant_from_mapping({
        "name": "turned", "states": ["x1", "x2"], "inputs": {"u1": 0, "u2": 0},
        "outputs": ["y1", "y2"], "C": data["C"], "initial_state": data["x0"], **turned,
    })
    with pytest.raises(ModelError, match="not uniquely solvable"):
        simulate(system, TimeSettings(0.0, 1.0), SolverSettings())


def test_a_rank_drop_of_E_that_leaves_the_solution_unique_is_passed():
    """E of the Berger–Ilchmann problem loses rank at t = π; its characteristic values do not."""
    data, system = problem(DATA / "problems" / "berger_ilchmann_hom.json")
    result = simulate(system, TimeSettings(0.5, 4.0), SolverSettings())
    t = np.linspace(0.5, 4.5, 301)
    truth = exact(data["solution"], t)
    assert np.abs(result.signals.states(t) - truth).max() < 1e-9 * np.abs(truth).max()


@pytest.mark.parametrize("path", SOLVABLE, ids=lambda path: path.stem)
def test_the_independent_path_agrees(path):
    """Another reduction (underlying ODE) and another integrator (DOP853)."""
    data, system = problem(path)
    start, stop = data["tspan"]
    time = TimeSettings(start, min(stop - start, 2.0))
    ours = simulate(system, time, SolverSettings())
    other = simulate(system, time, SolverSettings(name="ivp"))
    t = np.linspace(start, start + time.horizon, 101)
    assert np.abs(ours.signals.states(t) - other.signals.states(t)).max() < 1e-7
