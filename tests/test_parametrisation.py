"""η = S(θ): the unknowns behind a regression that is linear in more parameters than there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from processes import refused
from regressions import adjugate, integrate
from scipy.integrate import trapezoid
from scipy.optimize import least_squares

from gpebo_cli import ConfigError, SolverError, estimators, run
from gpebo_cli.estimators import LinearRegression
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


def test_fits_side_by_side_are_those_of_each_whatever_the_size_of_the_weights():
    p, rng = regression_from_mapping(TEXT).parametrisation, np.random.default_rng(2)
    roots = rng.normal(size=(9, 4, 4))
    weights = np.swapaxes(roots, 1, 2) @ roots
    eta = S(rng.uniform(p.low, p.high, (9, 2))) + 0.3 * rng.normal(size=(9, 4))
    eta[4, 1] = np.nan
    alone = np.concatenate([p.fitted(eta[k : k + 1], weights[k : k + 1]) for k in range(9)])
    assert np.isfinite(alone).all(axis=1).tolist() == [k != 4 for k in range(9)]
    for size in (1e-9, 1e9):
        np.testing.assert_allclose(p.fitted(eta, size * weights), alone, rtol=1e-7)
        gains = (p.gain(alone[:4], by * weights[:4]) for by in (size, 1.0))
        np.testing.assert_allclose(*gains, rtol=1e-9)


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
    *(({"box": {**TEXT["box"], "a": ends}}, "box.a must be [low, high] with low < high")
      for ends in ([2, 1], [2, 2])),
    *(({"box": {**TEXT["box"], "a": ends}}, f"box.a must be [low, high], not {ends}")
      for ends in ([0], [0, 1, 2], 3)),
    ({"S": None}, "box is for S"),
    ({"S": ["a", "b", "a*c", "1"]}, "S[2]"),
    ({"psi": [["u", "1"]]}, "an entry for each of the 4 unknowns (eta_1, eta_2, eta_3, eta_4)"),
    ({"Y": ["a*u"]}, "a is an unknown and cannot be used here"),
])
def test_mistakes(change, message):
    with refused(message):
        regression_from_mapping({**TEXT, **change})


def test_at_samples_the_fit_is_that_of_the_sums_so_far():
    noise = {"name": "gaussian", "outputs": 0.1, "sample_time": 0.05}
    found = run(
        regression=TEXT, observer={"sample_time": 0.05, "hold": "linear"}, noise=noise,
        estimator={"name": "least_squares", "f0": [1e-12, 1e-9]}, time={"horizon": 10},
    )
    p = regression_from_mapping(TEXT).parametrisation
    rows = np.column_stack([np.sin(found.estimates_t), np.ones_like(found.estimates_t),
                            np.cos(2 * found.estimates_t),
                            np.sin(found.estimates_t) * np.cos(found.estimates_t)])
    G = rows.T @ rows * 0.05  # near that of linear pieces
    eta = np.array([found.estimates[f"eta_{k}"][:, -1] for k in range(1, 5)]).T
    theta = np.array([found.estimates[name][:, -1] for name in ("a", "b")]).T
    np.testing.assert_allclose(p.fitted(eta, np.array([G, G])), theta, atol=2e-3)
    assert np.abs(theta - [2.0, 0.5]).max() < 0.1
    # Deviations are those of continuous time, but for the hold.
    held = run(regression=TEXT, noise=noise, time={"horizon": 10},
               estimator={"name": "least_squares", "f0": 1e-12})
    for name in ("a_std", "b_std"):
        ours, other = (r.to_pandas("estimates")[name].iloc[-1] for r in (found, held))
        assert ours == pytest.approx(other, rel=0.1)


# The gradient of a monotone S ------------------------------------------------------------------

IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]
MONOTONE = {"name": "monotone", "gamma": 3e3, "lambda": [0.3, 0.5, 0.7, 0.9], "T": IDENTITY}


def given(disturbance=None, horizon=6.0):
    """The regression of TEXT without the text, its Y disturbed."""
    def psi(t):
        return np.stack(
            [np.sin(t), np.ones_like(t), np.cos(2 * t), np.sin(t) * np.cos(t)], axis=-1
        )[..., None, :]

    def Y(t):
        return psi(t) @ S(np.array([2.0, 0.5])) + (0.0 if disturbance is None else disturbance(t))

    made = LinearRegression.from_functions(psi, Y, ["e1", "e2", "e3", "e4"], horizon)
    return replace(made, parametrisation=regression_from_mapping(TEXT).parametrisation), psi, Y


def wobble(t):
    return 0.2 * np.sin(3.0 * np.asarray(t))[..., None]


def test_the_monotone_gradient_against_an_integration_of_its_odes():
    made, psi, Y = given(wobble)
    t, rates = np.linspace(0.0, 6.0, 31), np.array(MONOTONE["lambda"])

    def f(t, x):
        omega, calY, theta = x[:16].reshape(4, 4), x[16:20], x[20:]
        row, y = psi(np.array(t))[0], Y(np.array(t))[0]
        delta = np.linalg.det(omega)
        rest = adjugate(omega) @ calY - delta * S(theta)
        return np.concatenate([
            (-rates[:, None] * (omega - np.outer(row, row))).ravel(), -rates * (calY - row * y),
            3e3 * delta * np.array(IDENTITY) @ rest,
        ])

    expected = integrate(f, np.concatenate([np.zeros(20), [2.55, 1.55]]), t)[:, 20:]
    found = estimators.build(MONOTONE).estimate(made, t)
    eta = found.parameters(slice(None))[0]
    np.testing.assert_allclose(eta, S(expected), atol=1e-9)
    fine = np.linspace(0.0, 6.0, 6001)
    energy = trapezoid(found.delta(fine)[0] ** 2, fine)
    assert found.requirement.evidence == pytest.approx({
        "integral_delta_squared": energy, "gamma_times_integral": 3e3 * energy,
        "needed": np.log(100.0),
    }, rel=1e-5)
    twice = estimators.build(MONOTONE | {"T": (2.0 * np.array(IDENTITY)).tolist()})
    needed = twice.estimate(made, t).requirement.evidence["needed"]
    assert needed == pytest.approx(np.log(100.0) / 2.0, rel=0.02)  # of which μ is a lower bound
    # ... and what is reported for θ is that θ, also before anything is exciting.
    weight = made.gram(t)[..., :4]
    np.testing.assert_allclose(made.parametrisation.fitted(eta, weight), expected, atol=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_the_monotone_gradient_of_one_unknown_begins_where_it_should(unit):
    """With ψ = 1 a filter has Δ = 1 − e^(−λt) and η̄ is θ from the start on; in any unit of θ."""
    one = {
        "name": "one", "unknowns": {"a": 2.0 * unit}, "box": {"a": [0, 8.0 * unit]},
        "S": [f"a/{unit}"], "psi": [["1"]],
    }
    made = run(
        regression=one, time={"horizon": 3, "samples": 31},
        estimator={"name": "monotone", "gamma": 1.5, "lambda": 4.0, "T": [[unit]]},
    )
    x = np.exp(-4.0 * made.t)
    energy = made.t - (1.0 - x) / 2.0 + (1.0 - x**2) / 8.0
    found = made.estimates["a"][0] / unit
    np.testing.assert_allclose(found, 2.0 + 2.0 * np.exp(-1.5 * energy), atol=1e-9)


@pytest.mark.filterwarnings("ignore:lsoda")
def test_a_monotone_gradient_that_cannot_be_integrated_is_refused():
    one = {"name": "one", "unknowns": {"a": 2}, "box": {"a": [0, 8]}, "S": ["a"], "psi": [["1"]]}
    with pytest.raises(SolverError, match="the monotone law cannot be integrated: "):
        run(regression=one, time={"horizon": 3, "samples": 2},
            estimator={"name": "monotone", "gamma": 1e200, "lambda": 4.0, "T": [[1]]})


def test_errors_of_the_monotone_gradient_are_its_linearisation():
    made, *_ = given()
    t, small = np.linspace(0.0, 6.0, 13), 1e-6
    estimator = estimators.build(MONOTONE)
    disturbed, *_ = given(lambda t: small * wobble(t))
    change = [
        estimator.estimate(one, t).parameters(slice(None))[0] for one in (disturbed, made)
    ]
    (errors,) = estimator.errors(made)

    def f(t, s):
        found = errors(np.array([t]), np.array([t]))
        return found.A[0] @ s + found.B[0] @ wobble(t)

    s = integrate(f, np.zeros(6), t)
    expected = np.einsum("nij,nj->ni", errors(t, t).C, s)
    np.testing.assert_allclose((change[0] - change[1]) / small, expected, atol=1e-4)


@pytest.mark.parametrize(("entries", "T", "message"), [
    (["a", "b", "a*b", "exp(-b)"], IDENTITY, None),
    (["a", "b", "a*b", "exp(-b)"], None, None),
    (["a", "b**2 - b", "1", "2"], IDENTITY, r"T∇S .* is not positive at a = .*, b = 0\.4"),
    (["a", "b", "1", "2"], [[1.0, 0.0]], "2 rows of 4 numbers"),
    (["sqrt(a)", "b", "1", "2"], IDENTITY, None),
])
def test_monotony_is_verified_on_the_whole_box(entries, T, message):
    p = regression_from_mapping({**TEXT, "S": entries}).parametrisation
    made = replace(given()[0], parametrisation=p)
    estimator = estimators.build({**MONOTONE, "T": T})
    if message is not None:
        with pytest.raises(ConfigError, match=message):
            estimator.estimate(made, np.array([1.0]))
        return
    found = estimator.estimate(made, np.array([1.0]))
    assert replace(estimator, initial={"a": 1, "b": 2}).law(p)[3].tolist() == [1.0, 2.0]
    theta = np.random.default_rng(0).uniform(p.low, p.high, (1000, 2))
    slope = found.T @ p.jacobian(theta)
    least = np.linalg.eigvalsh(slope + np.swapaxes(slope, 1, 2))[:, 0].min()
    assert 0.0 < 2.0 * found.mu <= least
    assert found.mu > 0.1 * least


def test_places_of_the_box_without_a_value_are_named():
    p = regression_from_mapping({**TEXT, "S": ["sqrt(a - 0.5)", "b", "1", "2"]}).parametrisation
    made = replace(given()[0], parametrisation=p)
    with pytest.raises(ConfigError, match=r"S\[0\] .* has no finite value at a = 0\.\d+, b = "):
        estimators.build(MONOTONE).estimate(made, np.array([1.0]))
    theta = np.array([[1.0, 1.0], [0.25, 2.0], [3.0, 1.0]])  # the second of these is the one
    with pytest.raises(ConfigError, match=r"S\[0\] .* at a = 0\.25, b = 2, in the box$"):
        p.values(theta)
    with pytest.raises(ConfigError, match=r"a = 7 is not within its box, \[[\d.]+, [\d.]+\]"):
        regression_from_mapping({**TEXT, "unknowns": {"a": 7, "b": 0.5}})


@pytest.mark.parametrize("estimator", [
    {"name": "least_squares", "f0": [1e-9, 1.0]}, MONOTONE,
], ids=lambda e: e["name"])
def test_seeds_say_how_well_the_unknowns_are_estimated(estimator):
    """Bias and deviation of θ̂ over seeds are those of runs with one seed each."""
    noise = {"name": "gaussian", "outputs": 0.05, "sample_time": 0.1}
    given = {"regression": TEXT, "estimator": estimator, "time": {"horizon": 3}}
    found = run(**given, noise={**noise, "seeds": 2}).details.noise
    single = np.array([
        [run_i.estimates[name][:, -1] for name in ("a", "b")]
        for run_i in (run(**given, noise={**noise, "seed": i}) for i in range(2))
    ])
    assert found.names[-2:] == ("a", "b")
    np.testing.assert_allclose(found.truth[-2:], [2.0, 0.5])
    expected = single.mean(axis=0).T - [2.0, 0.5]
    np.testing.assert_allclose(found.bias[:, -2:], expected, atol=1e-8)
    np.testing.assert_allclose(found.deviation[:, -2:], single.std(axis=0, ddof=1).T, atol=1e-8)


def test_at_samples_estimates_are_compared_with_what_least_squares_makes_of_them():
    """Of exact data that is the truth, for η and for what S is made of."""
    found = run(regression=TEXT, estimator={"name": "gradient", "gamma": 1e-3},
                observer={"sample_time": 0.1}, time={"horizon": 6})
    doubts, _ = found.details.estimation.doubts
    for name, true in {"a": 2.0, "b": 0.5, "eta_3": 1.0}.items():
        off = 1.0 - found.estimates[name][0, -1] / true
        assert doubts[name] == pytest.approx(off, rel=1e-6), name


def test_the_monotone_gradient_is_for_parametrisations():
    with pytest.raises(ConfigError, match="is for a regression with S and box"):
        run("circuit", estimator="monotone", time={"horizon": 1})
    found = run(regression=TEXT, estimator=MONOTONE, time={"horizon": 12}, noise={
        "name": "gaussian", "outputs": 0.01, "sample_time": 0.1})
    assert abs(found.estimates["a"][0, -1] - 2.0) < 0.05
    assert {"a_std", "eta_3_std"} <= set(found.to_pandas("estimates").columns)


@pytest.mark.parametrize("bent", ["sqrt(a)", "atan(5*(a - 2))"])
def test_a_step_too_large_for_newtons_method_is_taken_in_parts(bent):
    """At samples, from a = 5: a whole step would go where S has no value, or never arrive."""
    found = run(
        regression={**TEXT, "S": [bent, "b", "1", "2"], "unknowns": {"a": 0.2, "b": 0.5}},
        estimator={**MONOTONE, "gamma": 1e14, "initial": {"a": 5, "b": 0.5}},
        observer={"sample_time": 0.5, "hold": "zoh"}, time={"horizon": 5},
    )
    assert found.estimates["a"][0, 0] == pytest.approx(5.0)
    assert found.estimates["a"][0, -1] == pytest.approx(0.2, abs=1e-9)
