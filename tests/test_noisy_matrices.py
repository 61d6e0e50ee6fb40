"""Noise of outputs that stand in the matrices: its bias is measured, and removed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plants import one_state, shipped

from gpebo_cli import run
from gpebo_cli.errors import SolverError
from gpebo_cli.experiment.noise import measure, noise_levels
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Measurements, observe
from gpebo_cli.observers.remedies.noise_free import _change
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

LEAST_SQUARES = {"name": "least_squares", "f0": 1e-12}


def found(system, remedy, horizon, sigma, sample_time=0.05, seeds=1, **more):
    return run_experiment(Settings(
        estimator=LEAST_SQUARES, observer={"name": "gpebo", "remedy": remedy},
        time=TimeSettings(horizon=horizon, samples=11), solver=SolverSettings(tol=1e-7),
        noise=NoiseSettings("gaussian", sample_time, sigma, seeds=seeds, **more),
    ), system)  # fmt: skip


def test_many_seeds_are_one_run_per_seed_along_noisy_signals():
    system = shipped("lorenz")
    many = found(system, "none", 1.0, 0.3, seeds=3).noise
    single = [found(system, "none", 1.0, 0.3, seed=seed).estimation for seed in range(3)]
    errors = np.array([e.parameters[0, -1] - e.true_parameters[-1] for e in single])
    np.testing.assert_allclose(many.bias[0], errors.mean(axis=0), rtol=1e-8)
    np.testing.assert_allclose(many.deviation[0], errors.std(axis=0, ddof=1), rtol=1e-8)


@pytest.mark.parametrize(
    ("name", "unknown", "horizon", "sigma", "sample_time"),
    [("generator", "line", 5.0, 0.15, 0.1)],
)
def test_a_noise_free_copy_removes_most_of_the_bias(name, unknown, horizon, sigma, sample_time):
    """Least squares along noisy signals is biased by many deviations of the mean; this is not."""
    system = shipped(name)
    j = system.unknowns.index(unknown)
    plain, clean = (
        found(system, remedy, horizon, sigma, sample_time, seeds=16)
        for remedy in ("none", "noise_free")
    )
    bias, deviation = plain.noise.bias[0, j], plain.noise.deviation[0, j]
    assert abs(bias) > 2.5 * deviation / 4
    assert abs(clean.noise.bias[0, j]) < 0.25 * abs(bias)
    assert clean.noise.deviation[0, j] < 0.75 * deviation
    # What one run says of its own deviation is what the seeds show (16 of them: to 18 %).
    std = clean.estimation.parameters_std[0, -1, j]
    assert 0.6 < std / clean.noise.deviation[0, j] < 1.6
    assert plain.estimation.parameters_std is None


def test_without_noise_the_copy_changes_nothing():
    for name, horizon in (("lorenz", 2.0), ("boost", 3.0), ("battery", 100.0)):
        system = shipped(name)
        signals = simulate(system, TimeSettings(horizon=horizon), SolverSettings()).signals
        seen = Measurements(signals.inputs, signals.outputs)
        observation = observe(system, seen, remedy="noise_free")
        t = np.array([horizon])
        truth = observation.truth(t, system.theta_at(t), signals.states)[0]
        eta = observation.regression.least_squares()
        np.testing.assert_allclose(eta, truth, rtol=1e-8, atol=1e-8 * np.abs(truth).max())
        if system.depends_on_outputs:
            assert observation.assumptions[-1].evidence["rounds"] == 2  # one shows that none is due


@pytest.mark.parametrize(("form", "of_force", "sigma"), [
    ("auto", 0, 0.0), ("strangeness_free", 0.3, 0.02),
])  # fmt: skip
def test_the_copy_is_observed_on_the_form_of_the_equations_that_is_chosen(form, of_force, sigma):
    """Of index 2; an output that sees no force leaves that form alone."""
    system = plant_from_mapping({
        "name": "held", "states": ["x", "s", "f"], "outputs": ["y"], "unknowns": {"k": 0.7},
        "E": [[1, 0, 0], [0, 1, 0], [0, 0, 0]], "A": [["-0.2*y**2", 0, 1], ["-y", 0, 1], [0, 1, 0]],
        "F": [["cos(2*y)"], [0], [0]], "phi": [0, 0, "-sin(t)"], "C": [[1, 0.5, of_force]],
        "initial_state": [1, 0, 2],
    })  # fmt: skip
    run = run_experiment(Settings(
        estimator=LEAST_SQUARES, time=TimeSettings(horizon=2.0, samples=11),
        observer={"name": "gpebo", "remedy": "noise_free", "form": form},
        noise=NoiseSettings("gaussian", 0.2, sigma), solver=SolverSettings(tol=1e-8),
    ), system)  # fmt: skip
    errors = run.estimation.parameters[0, -1] - run.estimation.true_parameters[-1]
    within = 3.0 * run.estimation.parameters_std[0, -1] if sigma else 1e-6
    assert (np.abs(errors) < within).all()
    assert ("observer on the strangeness-free form" in run.verdict) == (form == "auto")


def test_the_copy_is_on_its_side_of_what_an_input_switches():
    """An output whose matrix has a relay: rounding of the input decided at the ends of elements."""
    system = plant_from_mapping({
        "name": "relay", "states": ["x", "z"], "inputs": {"u": "cos(2*t)"}, "outputs": ["y", "v"],
        "E": [[1, 0], [0, 0]], "A": [["-0.3*y", 1], [1, "2 + sin(y)"]], "phi": [0, "-sin(t)"],
        "C": [[1, "sign(u)"], [1, 0]], "initial_state": [0, 1],  # which the observer knows: Y = 0
    })  # fmt: skip
    signals = simulate(system, TimeSettings(horizon=3.0), SolverSettings()).signals
    seen = Measurements(signals.inputs, signals.outputs)
    assert observe(system, seen, remedy="noise_free").error_estimate < 1e-6


def test_unknowns_in_a_noisy_output_are_linearised_with_it():
    """y = x + b, x' = −y² + θ: with the bias b of the sensor, which is not the output's noise."""
    def plant(theta, bias, start):
        return plant_from_mapping(one_state(
            outputs=["y", "z"], unknowns={"theta": theta, "b": bias}, F=[[1, 0]],
            phi=["-y**2 + sin(3*t)"], C=[[1], [1]], H=[[0, 1], [0, 0]], initial_state=[start],
        ))

    system = plant(2.0, 0.5, 0.3)
    signals = simulate(system, TimeSettings(horizon=4.0), SolverSettings()).signals
    settings = NoiseSettings("gaussian", 0.02, 0.02)
    noisy = measure(signals, noise_levels(settings, system), settings.seed)
    observation = observe(
        system, Measurements(noisy.inputs, noisy.outputs), remedy="noise_free"
    )
    eta = observation.regression.least_squares()
    other = observe(  # what the plant says of its unknowns plays no part
        plant(-1.0, 4.0, 0.3), Measurements(noisy.inputs, noisy.outputs), remedy="noise_free"
    )
    np.testing.assert_allclose(other.regression.least_squares(), eta, rtol=1e-9)
    x0 = -eta[2]
    t = np.linspace(0.0, 4.0, 4001)
    measured = noisy.outputs(t, np.minimum(t + 1e-9, 4.0))

    def misfit(values):
        fitted = simulate(plant(*values), TimeSettings(horizon=4.0), SolverSettings()).signals
        return ((measured - fitted.outputs(t)) ** 2).sum()

    # Stationary: no parameter can be moved to fit better.
    best = np.array([eta[0], eta[1], x0])
    for step in 0.01 * np.eye(3):
        assert misfit(best) < min(misfit(best + step), misfit(best - step))
        slope = misfit(best + step) - misfit(best - step)
        curvature = misfit(best + step) + misfit(best - step) - 2 * misfit(best)
        assert abs(slope) < 0.05 * curvature


def test_what_still_changes_is_measured_by_the_residual():
    """Of Y = 3 + cos 9t and ψ = 1 on 2π: the residual of 3 has the root mean square 1/√2."""
    made = LinearRegression.from_functions(
        lambda t: np.ones((*t.shape, 1, 1)), lambda t: 3.0 + np.cos(9.0 * t)[..., None], ["a"],
        2.0 * np.pi, 400,
    )
    change = _change(SimpleNamespace(regression=made), np.array([3.1]), np.array([3.0]), 0.0)
    assert change == pytest.approx(0.1 * np.sqrt(2.0), rel=0.02)
    wave = np.cos(made.mesh.points)[..., None]
    exact = replace(
        made, Y=Trajectory(made.mesh, 3.0 * wave), psi=Trajectory(made.mesh, wave[..., None])
    )
    change = _change(SimpleNamespace(regression=exact), np.array([3.1]), np.array([3.0]), 1e-6)
    rounding = 1e-6 * (3.0 + 3.0) / 1e-3  # is no residual
    assert change == pytest.approx(0.1 / np.sqrt(2.0) / rounding, rel=0.02)


def test_a_copy_that_cannot_be_followed_is_no_fault_of_the_file():
    """Measured is y = 1, where x' = -1/y falls by 3: the copy passes zero, and y never does."""
    plant = one_state(phi=["-1/y"], A=[[0]])
    t = np.linspace(0.0, 3.0, 61)
    with pytest.raises(SolverError, match=r"not settle; in round 1 .* divides by .* too large"):
        run(plant, data={"t": t, "y": np.ones(61)}, observer={"remedy": "noise_free"})


def test_a_copy_that_does_not_settle_is_refused(monkeypatch):
    with pytest.raises(SolverError, match="noise_free does not settle; in round"):
        found(shipped("duffing"), "noise_free", 40.0, 0.5, sample_time=0.5)
    monkeypatch.setattr("gpebo_cli.observers.remedies.noise_free._MOST_ROUNDS", 1)
    with pytest.raises(SolverError, match="in round 1 the signals that fit the data still change"):
        found(shipped("duffing"), "noise_free", 2.0, 0.1)


def test_a_response_to_noise_that_is_not_resolved_is_refused(monkeypatch):
    monkeypatch.setattr("gpebo_cli.regression.errors._RESPONSE", 0.0)
    with pytest.raises(SolverError, match=r"response to noise is resolved to .* only; lower"):
        found(shipped("descriptor"), "none", 1.0, 0.1, seeds=2)
