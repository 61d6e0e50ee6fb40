"""Unknowns that vary in the simulation: the observer is not told, forgetting follows."""

from __future__ import annotations

import numpy as np
import pytest
from plants import left_of_identities, observed, seen, shipped
from scipy.integrate import solve_ivp
from units import Units, in_units

from gpebo_cli import run
from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.functions import system_from_functions
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers import observe
from gpebo_cli.results.figures import describe, parameters
from gpebo_cli.results.finished import read_errors, read_run
from gpebo_cli.results.summary import estimates_at_end
from gpebo_cli.settings import Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

SOLVER = SolverSettings()
STEP = {"theta1": "1.5 + step(t - 2.2)", "theta2": "-0.8 + 0.3*sin(3*t)"}


def theta(t):
    return np.array([1.5 + (t >= 2.2), -0.8 + 0.3 * np.sin(3 * t)])


def test_the_simulation_against_scipy():
    """x_b eliminated by hand from the last row, integrated up to the step and on from it."""
    system = shipped("descriptor", unknowns=STEP)
    simulation = simulate(system, TimeSettings(horizon=5.0), SOLVER)
    assert 2.2 in simulation.signals.mesh.edges

    def slope(t, x, inside):
        u = np.sin(t) + 0.5 * np.cos(2 * t)
        a, b = theta(t)
        a = theta(inside)[0]
        x3 = -(0.5 * x[0] - x[1] + 0.5 * u + 0.5 * a) / (2 + np.sin(t))
        return [
            -x[0] + (0.5 + np.sin(t) / 4) * x[1] + x3 + a,
            -0.5 * x[0] - (0.5 + np.cos(t) / 4) * x[1] + 0.5 * x3 + u + np.cos(t) * b,
        ]

    x, found = np.array([1.0, -1.0]), []
    for start, stop in ((0.0, 2.2), (2.2, 5.0)):
        middle = 0.5 * (start + stop)
        done = solve_ivp(slope, (start, stop), x, method="DOP853", rtol=1e-12, atol=1e-13,
                         args=(middle,))
        x = done.y[:, -1]
        found.append(x)
    ours = simulation.signals.states(np.array([2.2, 5.0]))[:, :2]
    assert ours == pytest.approx(np.array(found), abs=1e-10)
    other = simulate(system, TimeSettings(horizon=5.0), SolverSettings(name="ivp", tol=1e-10))
    assert other.signals.states(np.array([5.0])) == pytest.approx(
        simulation.signals.states(np.array([5.0])), abs=1e-7
    )


@pytest.mark.parametrize("source", ["text", "functions"])
def test_a_hidden_constraint_takes_derivatives_of_the_unknown(source):
    """x1' = x2, 0 = θ − x1: x2 = θ', of index 2."""
    E, A, F, C = [[1, 0], [0, 0]], [[0, 1], [-1, 0]], [[0], [1]], [[1, 1]]
    if source == "text":
        system = plant_from_mapping({
            "name": "hidden", "states": ["x1", "x2"], "unknowns": {"a": "exp(sin(2*t))"},
            "outputs": ["y"], "E": E, "A": A, "F": F, "C": C, "initial_state": [0, 0],
        })
    else:
        system = system_from_functions(
            "hidden", E, A, F=F, C=C, theta=lambda t: np.exp(np.sin(2 * t))[:, None],
            initial_state=[0, 0],
        )
    assert system.theta_varies
    signals = simulate(system, TimeSettings(horizon=3.0), SOLVER).signals
    t = np.linspace(0.0, 3.0, 31)
    value = np.exp(np.sin(2 * t))
    expected = np.stack([value, 2 * np.cos(2 * t) * value], axis=1)
    assert signals.states(t) == pytest.approx(expected, abs=1e-9)
    assert system.theta_at(t)[:, 0] == pytest.approx(value)


@pytest.mark.parametrize("plant", ["descriptor", "rotating", "rotating, other units"])
def test_the_regression_holds_with_the_truth_that_varies(plant):
    if plant == "descriptor":
        system = shipped("descriptor", unknowns=STEP)
    else:  # the kernel of E rotates: the extension is integrated in all coordinates
        content = {
            "name": "rotating", "states": ["x1", "x2"], "unknowns": {"a": "1 + t/4"},
            "outputs": ["y1", "y2"], "E": [["cos(t)", "sin(t)"], [0, 0]],
            "A": [[-1, 0.5], ["-sin(t)", "cos(t)"]], "F": [[1], [0.3]],
            "C": [[1, 0], [0.2, 1]], "initial_state": {"x1": 1, "x2": 0},
        }
        states = np.array([1.0, 1e-3] if "units" in plant else [1.0, 1.0])
        system = plant_from_mapping(in_units(
            content, Units(states, np.ones(1), np.ones(0), np.ones(2), np.ones(2), 1.0)
        ))
    signals, observation = observed(system, 4.0)
    t = np.linspace(0.0, 4.0, 41)
    assert max(left_of_identities(system, signals, observation, t)) < 2e-9
    # The same η gives the state, and e₀ starts where the constant one is.
    eta = observation.truth(t, system.theta_at(t), signals.states)
    constant = observation.truth(t, np.repeat(eta[:1, : system.q], 41, 0), signals.states)
    assert eta[0] == pytest.approx(constant[0], abs=1e-10)
    assert np.abs(eta[-1, system.q :] - constant[-1, system.q :]).max() > 0.1
    assert (constant == constant[0]).all()


def test_the_observer_is_not_told():
    one, other = shipped("descriptor"), shipped("descriptor", unknowns={"theta1": 7, "theta2": "t"})
    signals = simulate(one, TimeSettings(horizon=3.0), SOLVER).signals
    first, second = (
        observe(system, seen(signals), SOLVER).regression
        for system in (one, other)
    )
    assert first.Y.values.tobytes() == second.Y.values.tobytes()
    assert first.psi.values.tobytes() == second.psi.values.tobytes()


@pytest.mark.parametrize("name", ["least_squares", "ls_drem"])
def test_forgetting_follows_a_step_and_remembering_does_not(name):
    system = shipped("descriptor", unknowns={"theta1": "1.5 + step(t - 10)", "theta2": -0.8})
    settings = Settings(
        estimator={"name": name, "beta": [0.0, 1.0]}, time=TimeSettings(horizon=30.0)
    )
    result = run_experiment(settings, system)
    before = np.searchsorted(result.estimation.t, 9.9)
    remembering, forgetting = result.estimation.parameters[:, :, 0]
    assert remembering[before] == pytest.approx(1.5, abs=0.01)
    assert forgetting[before] == pytest.approx(1.5, abs=0.01)
    assert forgetting[-1] == pytest.approx(2.5, abs=1e-3)
    assert abs(remembering[-1] - 2.5) > 0.3
    truth = result.estimation.true_parameters[:, 0]
    assert (truth[before], truth[-1]) == (1.5, 2.5)
    assert estimates_at_end(result, result.estimation, 1)["theta1"]["true"] == 2.5
    # What is reported is the error of θ, not of the e₀ that makes up for its step.
    errors = np.abs(result.estimation.parameters - result.estimation.true_parameters)[:, -1, :2]
    assert result.metrics.final_error_parameters == pytest.approx(errors.max(axis=1), rel=1e-9)
    assert np.isfinite(result.metrics.seconds_to_1pct_states[1])
    assert np.isnan(result.metrics.seconds_to_1pct_states[0])
    panels = parameters(result)
    assert [panel.label for panel in panels] == ["theta1", "theta2"]
    assert np.array_equal(panels[0].curves[-1].y, truth)


def test_a_constant_unknown_is_drawn_with_e0_where_it_is_asked_for():
    settings = Settings(estimator={"name": "least_squares"}, time=TimeSettings(horizon=2.0))
    result = run_experiment(settings, shipped("descriptor"))
    assert [panel.name for panel in parameters(result)] == list(result.estimation.names)
    assert "parameters" not in describe(result)


def test_a_function_of_the_wrong_shape_is_refused():
    system = system_from_functions(
        "wrong", [[1.0]], [[0.0]], F=[[1.0]], theta=lambda t: np.ones((1, 1)), initial_state=[0.0]
    )
    with pytest.raises(ConfigError, match="theta returned shape"):
        simulate(system, TimeSettings(horizon=1.0), SOLVER)


def test_error_norms_are_of_theta(tmp_path):
    """e₀ makes up for what varies, of any size: curves count θ, as the metrics do."""
    system = shipped("descriptor", unknowns=STEP)
    result = run(system, estimator="ls_drem", gamma=[1, 2, 3], time={"horizon": 4, "samples": 41})
    result.save(tmp_path / "a", figures=False)
    errors = result.details.estimation.parameters - result.details.estimation.true_parameters
    theta = np.linalg.norm(errors[:, :, :2], axis=2)
    assert np.linalg.norm(errors[:, -1], axis=1).min() > 2 * theta[:, -1].max()
    (panel,) = describe(result.details, ["error_norms"])["error_norms"][:1]
    np.testing.assert_allclose([curve.y for curve in panel.curves], theta, rtol=1e-9)
    (final, *_), x = describe(result.details, ["gains"])["gains"], result.details.signals.states
    size = np.linalg.norm(result.details.estimation.true_parameters[:, :2], axis=1).max()
    assert final.size == pytest.approx(max(size, np.linalg.norm(x, axis=1).max()))
    read = read_errors(read_run("a", tmp_path / "a", {}))
    np.testing.assert_allclose([each.parameters for each in read], theta, rtol=1e-9)


@pytest.mark.parametrize("bounds", [None, {"unknowns": {"theta1": [-9, 9]}}])
def test_statistics_over_seeds_are_about_the_same_truth_as_a_run(bounds):
    """What is true of e₀ follows from all that θ did; bounds observe each seed by itself."""
    plant = {
        "name": "step", "states": ["x"], "outputs": ["y"], "E": [[1]], "A": [[-0.5]],
        "unknowns": {"theta1": "1 + step(t - 1)"}, "F": [[1]], "C": [[1]], "initial_state": [1],
    }
    found = run(plant, time={"horizon": 2, "samples": 21}, estimator="ls_drem", uncertainty=False,
                observer={"name": "gpebo", "bounds": bounds},
                noise={"name": "gaussian", "sample_time": 0.1, "outputs": 0.01, "seeds": 2}).details
    assert found.estimation.true_parameters[-1, 1] != found.estimation.true_parameters[0, 1]
    np.testing.assert_allclose(found.noise.truth, found.estimation.true_parameters[-1], rtol=1e-9)
    first = found.estimation.parameters[:, -1] - found.noise.truth
    assert (np.abs(first - found.noise.bias) < 10 * found.noise.deviation).all()
