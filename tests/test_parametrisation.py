"""η = S(θ): the unknowns behind a regression that is linear in more parameters than there are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from gpebo_cli import ConfigError, run
from gpebo_cli.regression.text import regression_from_mapping

TEXT = {
    "name": "s", "unknowns": {"a": 2.0, "b": 0.5}, "box": {"a": [0.1, 5], "b": [0.1, 3]},
    "S": ["a", "b", "a*b", "exp(-b)"], "signals": {"u": "sin(t)"},
    "psi": [["u", "1", "cos(2*t)", "u*cos(t)"]],
}


def S(theta):
    a, b = np.moveaxis(theta, -1, 0)
    return np.stack([a, b, a * b, np.exp(-b)], axis=-1)


@pytest.mark.parametrize("estimator", ["ls_drem", "drem", "least_squares"])
def test_the_unknowns_are_found_and_stand_beside_the_parameters(estimator):
    found = run(regression=TEXT, estimator=estimator, time={"horizon": 10})
    exact = 1e-5 if estimator == "least_squares" else 1e-12  # f₀ is in it
    assert found.estimates["a"][0, -1] == pytest.approx(2.0, abs=exact)
    assert found.estimates["b"][0, -1] == pytest.approx(0.5, abs=exact)
    assert found.estimates["eta_3"][0, -1] == pytest.approx(1.0, abs=exact)
    assert "states" in found.details.verdict or "state error" in found.details.verdict


def test_jacobian_is_that_of_differences():
    p = regression_from_mapping(TEXT).parametrisation
    theta = np.random.default_rng(1).uniform(p.low, p.high, (5, 2))
    step = 1e-6
    for i in range(2):
        along = step * np.eye(2)[i]
        slope = (S(theta + along) - S(theta - along)) / (2 * step)
        np.testing.assert_allclose(p.jacobian(theta)[:, :, i], slope, atol=1e-8)


def test_it_is_weighted_least_squares_in_the_box():
    p = regression_from_mapping(TEXT).parametrisation
    rng = np.random.default_rng(2)
    for _ in range(20):
        root = rng.normal(size=(4, 4))
        eta = S(rng.uniform(p.low, p.high)) + 0.3 * rng.normal(size=4)
        found = p.fitted(eta[None], (root.T @ root)[None])[0]
        by_scipy = least_squares(
            lambda theta, eta=eta, root=root: root @ (eta - S(theta)), 0.5 * (p.low + p.high),
            bounds=(p.low, p.high), xtol=1e-15, ftol=1e-15, gtol=1e-15,
        ).x
        ours, theirs = (np.sum((root @ (eta - S(theta))) ** 2) for theta in (found, by_scipy))
        assert ours <= theirs * (1 + 1e-6) + 1e-12
        assert (p.low <= found).all()
        assert (found <= p.high).all()


def test_least_squares_then_means_nonlinear_least_squares_on_the_data():
    noise = {"name": "gaussian", "outputs": 0.2, "sample_time": 0.05}
    found = run(regression=TEXT, estimator={"name": "least_squares", "f0": 1e-12},
                time={"horizon": 10, "samples": 4001}, noise=noise)
    r = found.details.regression

    def residual(theta):
        return (r.Y[:, 0] - r.psi[:, 0] @ S(theta))[:-1]

    theta = least_squares(residual, [2.0, 0.5], xtol=1e-14).x
    # The grid's sum stands for the integral.
    assert found.estimates["a"][0, -1] == pytest.approx(theta[0], abs=2e-3)
    assert found.estimates["b"][0, -1] == pytest.approx(theta[1], abs=2e-3)
    assert abs(found.estimates["b"][0, -1] - 0.5) > 1e-4


def test_small_errors_of_the_parameters_go_on_to_the_unknowns():
    p = regression_from_mapping(TEXT).parametrisation
    rng = np.random.default_rng(3)
    theta = np.array([[2.0, 0.5]])
    root = rng.normal(size=(4, 4))
    weight = (root.T @ root)[None]
    step = 1e-5
    slopes = [
        (p.fitted(S(theta) + d, weight) - p.fitted(S(theta) - d, weight))[0] / (2 * step)
        for d in step * np.eye(4)[:, None]
    ]
    np.testing.assert_allclose(p.gain(theta, weight)[0], np.transpose(slopes), atol=1e-6)


def test_deviations_of_the_unknowns_follow_from_those_of_the_parameters():
    noise = {"name": "gaussian", "outputs": 0.05, "sample_time": 0.05}
    found = run(regression=TEXT, estimator="least_squares", time={"horizon": 10}, noise=noise)
    stated = found.details.estimation.states_std[0]
    assert found.to_pandas("estimates")["a_std"].iloc[-1] == stated[-1, 0]
    # The same regression with its own parameters alone, linearised by hand at the truth.
    r = found.details.regression
    J = regression_from_mapping(TEXT).parametrisation.jacobian(np.array([[2.0, 0.5]]))[0]
    psi = r.psi[:, 0] @ J
    step = 0.05  # every sample of Y has its own error, held for so long
    G = psi.T @ psi * (r.t[1] - r.t[0])
    by_hand = 0.05 * np.sqrt(step * np.diag(np.linalg.inv(G)))
    np.testing.assert_allclose(stated[-1], by_hand, rtol=0.05)


@pytest.mark.parametrize(("change", "message"), [
    ({"box": None}, "S needs a box"),
    ({"box": {"a": [0, 1]}}, "box.b must be [low, high]"),
    ({"box": {**TEXT["box"], "c": [0, 1]}}, "box.c is not an unknown (a, b)"),
    ({"box": {**TEXT["box"], "a": [2, 1]}}, "box.a must be [low, high] with low < high"),
    ({"S": None}, "box is for S"),
    ({"S": ["a", "b", "a*c", "1"]}, "S[2]"),
    ({"psi": [["u", "1"]]}, "an entry for each of the 4 unknowns (eta_1, eta_2, eta_3, eta_4)"),
    ({"Y": ["a*u"]}, "a is an unknown and cannot be used here"),
])
def test_mistakes(change, message):
    with pytest.raises(ConfigError) as error:
        regression_from_mapping({**TEXT, **change})
    assert message in str(error.value)


def test_at_samples_it_is_refused():
    with pytest.raises(ConfigError, match="S works in continuous time only"):
        run(regression=TEXT, observer={"sample_time": 0.01}, estimator="least_squares")
