"""Many seeds in one job, against one run per seed and against theory; weights of outputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from examples import gpebo
from plants import left_of_identities, observed, shipped
from processes import printed, rows_of
from regressions import ETA, regression, three
from scipy.integrate import trapezoid
from test_cli import folders

from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators import build
from gpebo_cli.experiment.noise import measure, noise_levels
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers.reduced.matrices import observer_matrices
from gpebo_cli.reduction.form import EquationForm
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

ESTIMATORS = (
    {"name": "gradient", "gamma": [1.0, 10.0]},
    {"name": "least_squares", "beta": [0.0, 0.5]},
    {"name": "least_squares", "beta": 0.5, "f0": 0.1, "bound": 1e3},
    {"name": "mre"},
    {"name": "drem", "gamma": [1e2, 1e4]},
    {"name": "drem", "gamma": {"p1": 1e2, "p2": 1e3, "p3": 1e4}},
    {"name": "lion", "gamma": 1e4},
    {"name": "ls_drem", "gamma": [1.0, 10.0]},
    {"name": "fct", "gamma": 1e2},
    {"name": "power", "gamma": [1e2, 1e3]},
    {"name": "exciting"},
    {"name": "instrumental", "gamma": 1e2},
    {"name": "annihilator", "gamma": 1e2},
)


def two_outputs(**more):
    """A decaying state and an unknown, seen twice; no algebraic state."""
    return plant_from_mapping({
        "name": "twice", "states": ["x"], "unknowns": {"a": 0.4}, "outputs": ["y1", "y2"],
        "E": [[1]], "A": [[-0.3]], "F": [[1]], "C": [[1], [0.5]], "initial_state": {"x": 1}, **more,
    })


def settings(system, estimator, horizon=4.0, weights=None, **noise):
    return Settings(
        estimator=estimator, time=TimeSettings(horizon=horizon, samples=11),
        observer={"name": "gpebo", "weights": weights},
        noise=NoiseSettings(name="gaussian", **noise),
    )


# The axis of realisations ------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.1, 0.0])  # of what is exact there is a closed form
@pytest.mark.parametrize("settings", ESTIMATORS, ids=lambda s: "-".join(map(str, s.values())))
def test_estimators_carry_realisations_through(settings, size):
    def disturbance(k):
        return lambda t: size * np.sin((2 + k) * t + k)

    single = [regression(three, ETA, 6.0, 40, disturbance(k)) for k in range(3)]
    together = replace(
        single[0],
        Y=Trajectory(single[0].mesh, np.stack([one.Y.values for one in single], axis=-1)),
    )
    t = np.array([0.0, 1.7, 6.0])
    ours = build(settings).estimate(together, t).parameters(slice(None))
    expected = np.stack(
        [build(settings).estimate(one, t).parameters(slice(None)) for one in single], axis=-1
    )
    assert ours.shape == expected.shape == (len(build(settings).cases), 3, 3, 3)
    assert ours == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("settings", ESTIMATORS, ids=lambda s: "-".join(map(str, s.values())))
def test_estimates_do_not_depend_on_when_the_clock_began(settings):
    """Neither what is required, nor what errors of Y do."""
    own, begin = regression(three, ETA, 6.0, 40, lambda t: 0.1 * np.sin(2 * t)), -512.0
    edges = own.mesh.edges + begin
    mesh = Mesh(edges, own.mesh.rule)
    other = replace(
        own, Y=Trajectory(mesh, own.Y.values), psi=Trajectory(mesh, own.psi.values)
    )
    t, found = np.array([0.0, 1.7, 2.55, 6.0]), []
    for about, at in ((own, t), (other, t + begin)):
        made = build(settings).estimate(about, at)
        numbers = [made.parameters(slice(None)), *made.requirement.evidence.values()]
        if made.delta(at) is not None:
            numbers.append(made.delta(at))
        if hasattr(build(settings), "errors"):
            for errors in build(settings).errors(about):
                numbers += [x + np.zeros((4, 1, 1)) for x in errors(at[1:2], at[1:2])]
        found.append(numbers)
    for one, same in zip(*found, strict=True):
        np.testing.assert_allclose(same, one, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("estimator", ["gradient", "least_squares", "ls_drem"])
@pytest.mark.parametrize("noise", [
    {"outputs": 0.1, "inputs": 0.05, "sample_time": 0.05},
    {"outputs": 0.1, "sample_time": 0.1, "shape": "band_limited", "quantisation": 0.2},
])
def test_the_axis_of_seeds_is_one_run_per_seed(estimator, noise):
    system = shipped("descriptor")
    together = run_experiment(
        settings(system, {"name": estimator}, seed=4, seeds=3, **noise), system
    ).noise
    errors = []
    for seed in (4, 5, 6):
        result = run_experiment(settings(system, {"name": estimator}, seed=seed, **noise), system)
        assert result.noise is None
        estimation = result.estimation
        errors.append(estimation.parameters[0, -1] - estimation.true_parameters[-1])
    errors = np.array(errors)
    size = np.abs(errors).max()
    assert together.names == ("theta1", "theta2", "e0_x1", "e0_x2")
    assert together.bias[0] == pytest.approx(errors.mean(axis=0), abs=1e-6 * size)
    assert together.deviation[0] == pytest.approx(errors.std(axis=0, ddof=1), abs=1e-6 * size)
    assert together.rms[0] == pytest.approx(np.sqrt((errors**2).mean(axis=0)), abs=1e-6 * size)


def theory(rates, sigma, sample_time, horizon):
    """Covariance of least squares: σ² G⁻¹ (Σ_k w_k w_kᵀ) G⁻¹, w_k = ∫ψᵀ over a sample.

    ψ = c [−ξ_b, Φ] with Φ = e^{−t/√…}: here Φ = e^{−0.3t} and ξ_b = (1 − Φ)/0.3, c by output.
    """
    fine = np.linspace(0.0, horizon, 40_001)
    Phi = np.exp(-0.3 * fine)
    psi = np.stack([-(1 - Phi) / 0.3, Phi], axis=1)
    G = np.zeros((2, 2))
    middle = np.zeros((2, 2))
    per = round(sample_time / (fine[1] - fine[0]))
    for c, weight, deviation in zip((1.0, 0.5), rates, sigma, strict=True):
        G += weight * c**2 * trapezoid(psi[:, :, None] * psi[:, None], fine, axis=0)
        for k in range(round(horizon / sample_time)):
            part = slice(per * k, per * (k + 1) + 1)
            w = weight * c * trapezoid(psi[part], fine[part], axis=0)
            middle += deviation**2 * np.outer(w, w)
    inverse = np.linalg.inv(G)
    return inverse @ middle @ inverse


@pytest.mark.parametrize("weights", [None, [1.0, 0.04]])
def test_the_covariance_of_least_squares_is_the_theoretical_one(weights):
    system, sigma = two_outputs(), (0.1, 0.5)
    found = run_experiment(
        settings(
            system, {"name": "least_squares", "f0": 1e-12}, weights=weights, outputs=list(sigma),
            sample_time=0.1, seeds=400,
        ),
        system,
    ).noise
    expected = np.sqrt(np.diag(theory(weights or (1.0, 1.0), sigma, 0.1, 4.0)))
    # 400 draws know a deviation to 1/√800 = 3.5 %, a mean to 1/√400 of it; four times that.
    assert found.deviation[0] == pytest.approx(expected, rel=0.14)
    assert np.abs(found.bias[0] / expected).max() < 4 / np.sqrt(400)


# Weights -----------------------------------------------------------------------------------


def test_weights_of_one_over_the_variance_are_the_best():
    system, sigma = two_outputs(), [0.1, 0.5]
    rms = {}
    for name, weights in {"none": None, "best": [25, 1], "worst": [1, 25]}.items():
        rms[name] = run_experiment(
            settings(
                system, {"name": "least_squares"}, weights=weights, outputs=sigma, sample_time=0.1,
                seeds=200,
            ),
            system,
        ).noise.rms[0]
    assert (rms["best"] < 0.9 * rms["none"]).all()
    assert (rms["none"] < 0.5 * rms["worst"]).all()


def test_equal_weights_change_nothing_and_an_output_that_has_none_weighs_1():
    system = two_outputs()
    for weights in ((None, {"y1": 0.1, "y2": 0.1}), ([4.0, 1.0], {"y1": 4.0})):
        plain, equal = (observed(system, 2.0, weights=w)[1].regression for w in weights)
        assert plain.Y.values.tobytes() == equal.Y.values.tobytes()
        assert plain.psi.values.tobytes() == equal.psi.values.tobytes()


def test_weights_count_outputs_as_they_are_written():
    """No unit is in between; without that 1/σ² would not be the best."""
    psi = observed(two_outputs(C=[[1], [50]]), 2.0, weights=[9.0, 1.0])[1].regression.psi.values
    assert psi[..., 1, :] == pytest.approx(50.0 / 3.0 * psi[..., 0, :])


def test_weighted_elimination_is_weighted_least_squares():
    """K minimises ‖W^½(𝒜v + g)‖, and the squares of ψ are those of what is left, weighted."""
    system = shipped(
        "descriptor", outputs=["y1", "y2", "y3"],
        C=[[1, 0, 0.5], ["0.3*cos(t)", 1, -0.4], [0, 0.2, 1]],
    )
    t = np.array([0.7])
    w = np.array([1.0, 1.0, 1.0, 1.0, 0.3, 0.05])
    form = EquationForm(system, Units.plain(system))
    weighted = observer_matrices(form, t, t, 1e-10, output_scale=np.sqrt(w[3:]))
    plain = observer_matrices(form, t, t, 1e-10)
    A, column = plain.algebraic[0], plain.algebraic[0][:, 2:]  # x3 is the kernel of E
    w = w[-len(A) :]  # of the plant's equations those that are algebraic, then the outputs
    W = np.diag(w)
    g = np.random.default_rng(1).standard_normal(len(A))
    best = -np.linalg.solve(column.T @ W @ column, column.T @ W @ (A[:, :2] @ [1.0, 2.0] + g))
    scaled = np.sqrt(w) * g
    K = (weighted.elimination @ np.swapaxes(weighted.range, 1, 2))[0]
    left = weighted.algebraic[0] @ [1.0, 2.0, 0.0] + scaled
    ours = [1.0, 2.0, 0.0] - K @ left
    assert ours == pytest.approx([1.0, 2.0, best[0]], abs=1e-12)
    left = A[:, :2] @ [1.0, 2.0] + g + column @ best
    residual = weighted.residual[0] @ (weighted.algebraic[0] @ [1.0, 2.0, 0.0] + scaled)
    assert residual @ residual == pytest.approx(left @ W @ left, rel=1e-12)
    # The observer's equation stays true: w' = A_0 w + b_0 + D_0 θ for any elimination.
    found = observed(system, 3.0, weights=[1, 0.3, 0.05])
    of_Y, of_x = left_of_identities(system, *found, np.linspace(0.0, 3.0, 13))
    assert (of_Y < 1e-10, of_x < 1e-9) == (True, True)


def test_weights_of_the_canonical_observer():
    system = shipped("canonical")
    one, half = (
        observed(system, 2.0, name="canonical", weights=w)[1].regression
        for w in (None, [0.25, 1.0])
    )
    assert half.psi.values == pytest.approx(0.5 * one.psi.values, abs=1e-14)
    assert half.Y(np.array([1.3])) == pytest.approx(0.5 * one.Y(np.array([1.3])), abs=1e-11)


@pytest.mark.parametrize(("weights", "message"), [
    ([1.0], "observer.weights has 1 values but there are 2 outputs"),
    ({"y3": 1.0}, "there is no output 'y3'; the outputs are y1, y2"),
    ([1.0, -1.0], "observer.weights.y2: expected 0 or a positive number, got -1"),
    ([0.0, 0.0], "at least one output must have a positive weight"),
])
def test_wrong_weights(weights, message):
    system = two_outputs()
    with pytest.raises(ConfigError, match=message):
        run_experiment(settings(system, {"name": "gradient"}, weights=weights), system)


# What is refused, and files ----------------------------------------------------------------


@pytest.mark.parametrize(("observer", "noise", "message"), [
    ("gpebo", {"seeds": 5}, "noise.seeds = 5, but there is no noise"),
    ("none", {"seeds": 5, "outputs": 0.1}, "needs an observer in continuous time"),
])
def test_seeds_of_nothing_are_refused(observer, noise, message):
    system = shipped("canonical")
    wrong = Settings(
        estimator={"name": "gradient"}, observer={"name": observer},
        noise=NoiseSettings(**noise),
    )
    with pytest.raises(ConfigError, match=message):
        run_experiment(wrong, system)


def test_noise_csv(tmp_path):
    words = ["plant=descriptor", "time.horizon=2", "time.samples=11", "figures=none"]
    said = printed(gpebo(
        "run", *words, "estimator=ls_drem", "estimator.gamma=[1,10]", "noise=gaussian",
        "noise.sample_time=0.1", "noise.seeds=20", cwd=tmp_path,
    ))
    assert "over 20 seeds" in said
    [folder] = folders(tmp_path)
    rows = rows_of(folder / "noise.csv")
    assert [row["parameter"] for row in rows] == 2 * ["theta1", "theta2", "e0_x1", "e0_x2"]
    assert [row["gamma"] for row in rows] == 4 * ["1"] + 4 * ["10"]
    for row in rows:
        bias, deviation, rms = (float(row[key]) for key in ("bias", "deviation", "rms"))
        assert rms**2 == pytest.approx(bias**2 + deviation**2 * 19 / 20)
        assert deviation > 0


def test_levels_follow_names():
    system = two_outputs()
    noise = NoiseSettings(outputs={"y2": 0.3}, sample_time=0.5)
    signals = simulate(system, TimeSettings(horizon=2.0), SolverSettings()).signals
    measured = measure(signals, noise_levels(noise, system), noise.seed)
    t = np.linspace(0.0, 1.9, 20)
    difference = measured.outputs(t) - signals.outputs(t)
    assert np.abs(difference[:, 0]).max() < 1e-14
    assert np.abs(difference[:, 1]).max() > 0.1
