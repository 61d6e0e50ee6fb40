"""Sampled noise: what the observer sees, to the last bit where there is none."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from examples import gpebo
from plants import one_state, shipped
from processes import assert_refused, printed
from scipy.integrate import solve_ivp
from test_cli import folders

from gpebo_cli import run
from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators import build
from gpebo_cli.experiment.noise import (
    between,
    draw_errors,
    measure,
    noise_grid,
    noise_levels,
    sampled_mesh,
)
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import Measurements, observe
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

TIME = TimeSettings(horizon=4.0)
SOLVER = SolverSettings()


def seen(system, **noise):
    """True and measured signals of a plant."""
    settings = NoiseSettings(**noise)
    signals = simulate(system, TIME, SOLVER).signals
    return signals, measure(signals, noise_levels(settings, system), settings.seed)


def flat_mesh(edges, stages=12):
    return initial_mesh(edges[0], edges[-1], edges, 1, radau_rule(stages))


# None ---------------------------------------------------------------------------------------


def test_no_noise_is_the_run_without_noise_bit_for_bit():
    system = shipped("descriptor")
    settings = Settings(estimator={"name": "ls_drem"}, time=TIME)
    silent = NoiseSettings("gaussian", 0.037, [0.0], {"u": 0.0}, 0.0, "band_limited", 7)
    signals, measured = seen(system, sample_time=0.037)
    assert measured is signals
    without = run_experiment(settings, system)
    zero = run_experiment(replace(settings, noise=silent), system)
    for name in ("parameters", "states"):
        ours, theirs = getattr(zero.estimation, name), getattr(without.estimation, name)
        assert ours.tobytes() == theirs.tobytes()
    assert zero.simulation.measured_outputs is None


def test_a_signal_without_noise_of_its_own_keeps_its_bits():
    system = shipped("descriptor")
    noise = NoiseSettings(outputs=0.1, sample_time=0.05)
    settings = Settings(estimator={"name": "least_squares"}, time=TIME, noise=noise)
    simulation = run_experiment(settings, system).simulation
    assert simulation.measured_inputs.tobytes() == simulation.inputs.tobytes()
    noisy = run_experiment(replace(settings, noise=replace(noise, inputs=0.1)), system).simulation
    assert np.std(noisy.measured_inputs - noisy.inputs) == pytest.approx(0.1, rel=0.3)
    assert np.std(simulation.measured_outputs - simulation.outputs) == pytest.approx(0.1, rel=0.3)
    system = shipped("canonical")
    settings = replace(settings, noise=replace(noise, outputs={system.outputs[0]: 0.1}))
    simulation = run_experiment(settings, system).simulation
    noisy, silent = (simulation.measured_outputs - simulation.outputs).T
    assert noisy.all()
    assert not silent.any()


# Instants -----------------------------------------------------------------------------------


@pytest.mark.parametrize("sample_time", [0.1, 0.3, 1 / 3, 0.0703, 7.0])
def test_elements_end_at_the_instants_and_old_edges_stay(sample_time):
    mesh = flat_mesh(np.array([0.0, 0.3, 0.7 + 1e-14, 1.23, 2.1]))
    sampled = sampled_mesh(mesh, sample_time)
    edges = sampled.mesh.edges
    instants = np.arange(0.0, 2.1 - 1e-9, sample_time)
    assert set(mesh.edges) <= set(edges)
    assert np.abs(instants[:, None] - edges).min(axis=1).max() < 1e-6 * sample_time
    assert len(sampled.first) == len(instants)
    assert np.diff(edges).min() > 1e-6 * sample_time  # no slivers where both kinds meet
    middle = 0.5 * (edges[1:] + edges[:-1])
    assert (sampled.sample == np.searchsorted(instants, middle) - 1).all()


@pytest.mark.parametrize("start", [0.0, -3.0, 1e5])
def test_the_error_is_held_from_each_instant_to_the_next(start):
    mesh = flat_mesh(start + np.array([0.0, 0.33, 1.0]))
    grid = sampled_mesh(mesh, 0.1)
    errors = np.arange(11.0)[:, None]
    values = np.broadcast_to(between(errors, grid, "hold"), (grid.mesh.size, 13, 1))
    held = Trajectory(grid.mesh, values)
    t = start + 0.1 * np.arange(10) + 0.05
    assert held(t).ravel() == pytest.approx(np.arange(10.0), abs=1e-12)
    at_instants = held(grid.mesh.edges[grid.first])  # the sample counts from its instant on
    assert at_instants.ravel() == pytest.approx(np.arange(10.0), abs=1e-12)


# Statistics ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["hold", "band_limited"])
def test_variance_over_seeds_is_what_was_asked_for_at_every_time(shape):
    system = shipped("descriptor")
    signals = simulate(system, TIME, SOLVER).signals
    t = np.linspace(0.05, 3.95, 61)
    errors = []
    for seed in range(300):
        settings = NoiseSettings(outputs=0.2, inputs=0.03, sample_time=0.1, shape=shape, seed=seed)
        grid = noise_grid(signals.mesh, settings)
        true = Trajectory(grid.mesh, signals.outputs(
            grid.mesh.points.ravel(), grid.mesh.inside.ravel()
        ).reshape(*grid.mesh.points.shape, 1))
        y, u = draw_errors(true, grid, noise_levels(settings, system), seed)
        points = (*grid.mesh.points.shape, 1)
        sampler = grid.mesh.sampler(t)
        errors.append([
            sampler(np.broadcast_to(between(e, grid, shape), points))[:, 0] for e in (y, u)
        ])
    errors = np.array(errors)  # (seeds, 2, times)
    # The relative error of a variance from 300 draws is √(2/300) = 0.082; five of them.
    assert errors[:, 0].var(axis=0) == pytest.approx(np.full(61, 0.04), rel=0.41)
    assert errors[:, 1].var(axis=0) == pytest.approx(np.full(61, 9e-4), rel=0.41)
    assert errors[:, 0].var() == pytest.approx(0.04, rel=0.05)
    assert np.abs(errors.mean(axis=0) / [[0.2], [0.03]]).max() < 5 / np.sqrt(300)
    assert abs(np.corrcoef(errors[:, 0].ravel(), errors[:, 1].ravel())[0, 1]) < 0.1


def test_the_seed_decides():
    system = shipped("descriptor")
    _, one = seen(system, outputs=0.1, seed=1)
    _, again = seen(system, outputs=0.1, seed=1)
    _, two = seen(system, outputs=0.1, seed=2)
    assert one.outputs.values.tobytes() == again.outputs.values.tobytes()
    assert np.abs(one.outputs.values - two.outputs.values).max() > 0.1


@pytest.mark.parametrize("sample_time", [0.1, 4.0 / 39.0])
def test_the_error_at_the_end_is_not_that_of_the_start(sample_time):
    """Though the samples are continued periodically, an even or an odd number of them."""
    signals, measured = seen(
        shipped("descriptor"), outputs=0.1, sample_time=sample_time, shape="band_limited", seed=2
    )
    mesh = measured.outputs.mesh
    errors = measured.outputs.values - mesh.along(signals.outputs).values
    assert abs(errors[-1, -1, 0] - errors[0, 0, 0]) > 1e-3


def test_quantisation_rounds_what_is_sampled():
    signals, measured = seen(shipped("descriptor"), quantisation=0.25, sample_time=0.1)
    t = 0.1 * np.arange(40)
    assert measured.outputs(t) / 0.25 == pytest.approx(np.rint(signals.outputs(t) / 0.25), abs=1e-9)
    assert np.abs(measured.outputs(t) - signals.outputs(t)).max() <= 0.125 + 1e-12
    _, noisy = seen(shipped("descriptor"), quantisation=0.25, sample_time=0.1, outputs=0.5)
    steps = noisy.outputs(t) / 0.25
    assert steps == pytest.approx(np.rint(steps), abs=1e-9)


def test_a_result_has_the_rounded_outputs_of_a_sensor_without_noise():
    noise = {"name": "gaussian", "outputs": 0, "quantisation": 0.25, "sample_time": 0.1}
    found = run("descriptor", noise=noise, time={"horizon": 2, "samples": 21}).details.signals
    rounded = np.rint(found.outputs / 0.25)[:-1]  # the last time still belongs to the sample before
    assert found.measured_outputs[:-1] / 0.25 == pytest.approx(rounded, abs=1e-9)


def test_what_has_no_name_in_a_mapping_of_levels_has_no_noise():
    plant = plant_from_mapping(one_state(
        inputs={"u": 1, "v": 1}, B=[[1, 1]], outputs=["y", "z"], C=[[1], [2]]
    ))
    levels = noise_levels(NoiseSettings(outputs={"y": 1}, inputs={"v": 2}, quantisation={"z": 3}),
                          plant)
    found = levels.outputs.tolist(), levels.inputs.tolist(), levels.steps.tolist()
    assert found == ([1, 0], [0, 2], [0, 3])


# The band -----------------------------------------------------------------------------------


@pytest.mark.parametrize("stages", [3, 9, 12])
def test_nothing_above_half_the_sampling_rate(stages):
    edges = np.array([0.0, 0.317, 1.9, 2.05, 4.0])  # intervals cut by edges of the mesh's own
    settings = NoiseSettings(sample_time=0.1, shape="band_limited")
    grid = noise_grid(flat_mesh(edges, stages), settings)
    errors = np.random.default_rng(3).standard_normal((41, 2))
    e = Trajectory(grid.mesh, between(errors, grid, "band_limited"))
    assert e(0.1 * np.arange(40)) == pytest.approx(errors[:40], abs=1e-9)
    # The defining series, with as many periods of the samples as it takes: 1/k² after pairing.
    t = np.array([0.333, 1.234, 1.95, 3.99])
    k = np.arange(-200_000, 200_041)
    sinc = np.sinc((t[:, None] - 0.1 * k) / 0.1)
    taper = 1.0 - np.abs(k) / 200_041.0  # Cesàro: the periodic series does not converge absolutely
    expected = (sinc * taper) @ errors[k % 41]
    assert e(t) == pytest.approx(expected, abs=2e-3)
    # Over one period of 41 samples, resolved 8-fold; the last sample lies beyond the horizon.
    fine = sampled_mesh(flat_mesh(np.array([0.0, 4.1]), 12), 0.1)
    whole = Trajectory(fine.mesh, between(errors, fine, "band_limited"))
    spectrum = np.abs(np.fft.rfft(whole(4.1 * np.arange(328) / 328), axis=0))
    assert spectrum[21:].max() < 1e-9 * spectrum.max()
    assert spectrum[:21].min() > 1e-4 * spectrum.max()


# Against an independent integration ---------------------------------------------------------


@pytest.mark.parametrize("shape", ["hold", "band_limited"])
def test_the_regression_of_noisy_signals(shape):
    """The paper's block formulas for E = diag(I, 0), integrated by scipy from sample to sample."""
    system = shipped("descriptor")
    noise = {"outputs": 0.3, "inputs": 0.2, "sample_time": 0.1, "shape": shape, "seed": 5}
    _, measured = seen(system, **noise)
    regression = observe(system, Measurements(measured.inputs, measured.outputs), SOLVER).regression

    def blocks(t):
        c = system.coefficients.taylor(np.array([t]), 0)
        A, B, C = c.A[0, 0], c.B[0, 0], c.C[0, 0]
        Ab = np.vstack([A[2:, 2:], C[:, 2:]])
        Aa = np.vstack([A[2:, :2], C[:, :2]])
        K = np.linalg.pinv(Ab)
        u, y = measured.inputs(np.array([t]))[0], measured.outputs(np.array([t]))[0]
        g = np.concatenate([B[2:] @ u, -y])
        return A, B, Ab, Aa, K, g, u

    def derivative(t, xi, last):
        A, B, _, Aa, K, g, u = blocks(min(t, last))
        return A[:2, :2] @ xi + B[:2] @ u - A[:2, 2:] @ K @ (Aa @ xi + g)

    xi, t = np.zeros(2), 0.0
    for k in range(30):
        stop = 0.1 * (k + 1)
        last = np.nextafter(stop, 0.0) - 1e-13
        done = solve_ivp(
            derivative, (t, stop), xi, method="DOP853", rtol=1e-10, atol=1e-12, args=(last,)
        )
        xi, t = done.y[:, -1], stop
    _, _, Ab, Aa, K, g, _ = blocks(3.0 + 1e-12)
    expected = (np.eye(2) - Ab @ K) @ (Aa @ xi + g)
    ours = regression.Y(np.array([3.0 + 1e-12]))[0]
    # Rows of R in the coordinates of the observer: the algebraic equation of E, then the output.
    assert ours == pytest.approx(expected, abs=1e-8)


def test_a_stiff_gradient_takes_few_elements_where_y_bends_at_every_sample(monkeypatch):
    """η̂' = −r (η̂ − Y/ψ) with r h = 500 in each of 200 rough samples, in closed form."""
    monkeypatch.setattr("gpebo_cli.estimators._vector._MAX_ELEMENTS", 800)
    mesh, psi = flat_mesh(np.linspace(0.0, 1.0, 201), stages=6), 100.0
    rows, rate = 1.0 + 1e-5 * np.random.default_rng(0).standard_normal(201), 500.0 * 200
    share = (mesh.points - mesh.edges[:-1, None]) / mesh.steps[:, None]
    Y = rows[:-1, None] + share * np.diff(rows)[:, None]
    regression = LinearRegression(
        Trajectory(mesh, psi * Y[..., None]), Trajectory(mesh, np.full((*Y.shape, 1, 1), psi)),
        ("a",), 1.0,
    )
    law = build({"name": "gradient", "gamma": rate / psi**2, "initial": [rows[0]]})
    ours = law.estimate(regression, mesh.edges).parameters(slice(None))[0, :, 0]
    eta, expected = rows[0], [rows[0]]
    for row, slope in zip(rows, np.diff(rows) * 200, strict=False):
        follows = row - slope / rate  # what η̂ does when all else has gone, at the start
        eta = follows + slope / 200 + np.exp(-rate / 200) * (eta - follows)
        expected.append(eta)
    np.testing.assert_allclose(ours, expected, atol=1e-8)


@pytest.mark.parametrize("name", ["gradient", "mre"])
def test_vector_laws_follow_a_regression_that_jumps(name):
    """The residual of the law jumps with every sample; η̂ against a batch of matrix integrals."""
    mesh = flat_mesh(np.linspace(0.0, 2.0, 21))
    steps = np.random.default_rng(0).standard_normal(20)
    psi = np.stack([np.ones_like(mesh.points), np.sin(mesh.points)], axis=-1)[:, :, None]
    Y = np.broadcast_to(steps[:, None, None], (*mesh.points.shape, 1))
    regression = LinearRegression(
        Trajectory(mesh, Y), Trajectory(mesh, psi), ("a", "b"), 1.0
    )
    t = np.array([0.0, 0.55, 2.0])
    ours = build({"name": name, "gamma": 3.0}).estimate(regression, t).parameters(slice(None))[0]

    def row(t):
        return np.array([1.0, np.sin(t)])

    def gradient(t, x, level):
        return 3.0 * row(t) * (level - row(t) @ x)

    def memory(t, x, level):
        eta, Omega, Z = x[:2], x[2:6].reshape(2, 2), x[6:]
        return np.concatenate([
            3.0 * (Z - Omega @ eta),
            (-0.2 * (Omega - np.outer(row(t), row(t)))).ravel(),
            -0.2 * (Z - row(t) * level),
        ])

    law, x = (gradient, np.zeros(2)) if name == "gradient" else (memory, np.zeros(8))
    found = [x[:2]]
    for k in range(20):
        inner = [0.55, 0.6] if k == 5 else [0.1 * (k + 1)]
        done = solve_ivp(
            law, (0.1 * k, 0.1 * (k + 1)), x, method="DOP853", rtol=1e-11, atol=1e-13,
            t_eval=inner, args=(steps[k],),
        )
        if k in (5, 19):
            found.append(done.y[:2, 0])
        x = done.y[:, -1]
    assert ours == pytest.approx(np.array(found), abs=1e-9)


# What is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(("noise", "message"), [
    ({"outputs": -1.0}, "noise.outputs: expected 0 or a positive number, got -1"),
    ({"outputs": [0.1, 0.2]}, r"noise.outputs has 2 values but there are 1 outputs"),
    ({"outputs": {"yy": 0.1}}, "there is no output 'yy'; the outputs are y; did you mean y?"),
    ({"inputs": {"y": 0.1}}, "there is no input 'y'"),
    ({"quantisation": float("nan")}, "noise.quantisation: expected 0 or a positive"),
    ({"outputs": 1.0, "sample_time": 1e-7}, "2e\\+08 samples over 20 s.*max_elements is 200000"),
])
def test_wrong_settings_are_refused_before_anything_is_run(noise, message):
    settings = Settings(estimator={"name": "gradient"}, noise=NoiseSettings(**noise))
    stages = []
    with pytest.raises(ConfigError, match=message):
        run_experiment(settings, shipped("descriptor"), stages.append)
    assert stages == []


@pytest.mark.parametrize(("words", "message"), [
    (["noise=gaussian", "noise.outputs=-1"], "noise.outputs: expected 0 or a positive"),
    (["noise=gaussian", "noise.outputs={yy:1}"], "did you mean y?"),
    (["noise=gaussian", "noise.sample_time=0"], "noise.sample_time: expected a positive number"),
    (["noise=gaussian", "noise.sample_time=.inf"], "noise.sample_time: expected a finite number"),
    (["noise=gaussian", "noise.seed=-1"], "noise.seed: expected 0 or more"),
    (["noise=gaussian", "noise.sample_time=1e-9"], "2e+10 samples"),
    (["noise=gaussian", "noise.shape=held"], "expected hold or band_limited"),
    (["noise=gauss"], "did you mean gaussian?"),
])
def test_wrong_settings_are_one_line_and_exit_2(tmp_path, words, message):
    assert_refused(gpebo("run", "figures=none", *words, cwd=tmp_path), message)
    assert folders(tmp_path) == []


def test_files_show_what_the_observer_saw(tmp_path):
    words = ["time.samples=51", "time.horizon=2", "noise=gaussian", "noise.outputs={y:0.5}"]
    printed(gpebo("run", *words, "noise.seed=3", "figures=[signals]", cwd=tmp_path))
    [folder] = folders(tmp_path)
    with (folder / "signals.csv").open() as stream:
        header, *rows = csv.reader(stream)
    states = ["e1", "e2", "il", "ir1", "ir2", "iv"]
    assert header == ["t", "V", "y", *states, "V_measured", "y_measured"]
    table = {name: np.array(column, float) for name, column in zip(header, zip(*rows, strict=True),
                                                                   strict=True)}
    assert table["y"] == pytest.approx(table["il"] + table["iv"], abs=1e-10)
    assert (table["V"] == table["V_measured"]).all()
    assert 0.3 < np.std(table["y_measured"] - table["y"]) < 0.7
    noise = json.loads((folder / "summary.json").read_text())["noise"]
    assert noise["seed"] == 3
    assert noise["outputs"] == {"y": 0.5}
    assert (folder / "figures" / "signals.png").exists()

    assert gpebo("run", *words[:2], "figures=none", "hydra.run.dir=plain",
                 cwd=tmp_path).returncode == 0
    with (tmp_path / "plain" / "signals.csv").open() as stream:
        assert next(csv.reader(stream)) == ["t", "V", "y", *states]
    assert json.loads((tmp_path / "plain" / "summary.json").read_text())["noise"] is None
