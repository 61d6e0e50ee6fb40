"""The Kalman–Bucy filter on the reduced system: its model, consistency, convergence, messages."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from examples import assert_repeats, gpebo
from plants import experiment, one_state, seen, shipped
from processes import printed, rows_of
from test_cli import FAST, folders
from test_observer import ROTATING

from gpebo_cli import run as api_run
from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.assumptions import examine
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import SignalNoise, kalman_bucy, observe
from gpebo_cli.observers._filter_model import NoiseModel, filter_model
from gpebo_cli.observers._riccati import run_filter
from gpebo_cli.observers.reduced.matrices import observer_matrices
from gpebo_cli.reduction.form import EquationForm
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.results.figures import describe
from gpebo_cli.results.report import estimate_table
from gpebo_cli.settings import NoiseSettings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

SOLVER = SolverSettings()


def run(system: DescriptorSystem, horizon: float = 20.0, **more: Any) -> RunResult:
    estimator = more.pop("estimator", {"name": "drem"})
    return experiment(system, estimator, horizon, 401, **{"name": "kalman_bucy", **more})


def assumption(result: RunResult, name: str):
    return next(a for a in result.assumptions if a.name == name)


def in_basis(system: DescriptorSystem, t: Array, inside: Array, u: Array, y: Array, like=None):
    o = observer_matrices(EquationForm(system, Units.plain(system)), t, inside, 1e-10, like)
    signals = np.concatenate([u, y], axis=1)[:, :, None]
    return filter_model(o, signals, EquationForm(system, Units.plain(system))), o.split.basis, o


DIFFERENCE = {
    "name": "difference", "states": ["a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
    "E": [[1, -1], [0, 0]], "A": [[-1, 0], [1, 2]], "B": [[1], [1]], "C": [[2, -1]],
    "unknowns": {"k": 0.5}, "F": [[1], [0]], "initial_state": [1, -0.5],
}


@pytest.mark.parametrize("name", ["circuit", "descriptor", "rotating", "difference"])
def test_model_holds_on_the_true_state_whatever_the_noise(name):
    """ζ' = 𝔸ζ + b + Γν and z = cζ + Dν for ν that has any value: every sign is right."""
    written = {"rotating": ROTATING, "difference": DIFFERENCE}
    system = plant_from_mapping(written[name]) if name in written else shipped(name)
    signals = simulate(system, TimeSettings(), SOLVER).signals
    t = np.linspace(1.0, 19.0, 37)
    rng = np.random.default_rng(1)
    nu = rng.normal(size=(len(t), system.m + system.r))
    u, y = signals.inputs(t) + nu[:, : system.m], signals.outputs(t) + nu[:, system.m :]
    s, basis, o = in_basis(system, t, t, u, y)

    def zeta(at: Array) -> Array:
        form = EquationForm(system, Units.plain(system))
        P = observer_matrices(form, at, at, 1e-10).split.projector
        w = (P @ signals.states(at)[..., None])[..., 0] @ basis
        return np.concatenate([np.broadcast_to(system.theta, (len(at), system.q)), w], axis=1)

    h = 1e-3
    slope = (8 * (zeta(t + h) - zeta(t - h)) - zeta(t + 2 * h) + zeta(t - 2 * h)) / (12 * h)
    driven = s.b + np.einsum("nij,nj->ni", s.from_noise, nu)
    size = np.abs(slope).max()
    np.testing.assert_allclose(
        slope, np.einsum("nij,nj->ni", s.A, zeta(t)) + driven, atol=1e-8 * size
    )
    Zt = transpose(s.rows)
    np.testing.assert_allclose(
        Zt @ s.rows, np.broadcast_to(np.eye(system.r), (len(t), system.r, system.r)), atol=1e-12
    )
    residual = s.g_y + np.einsum("nij,nj->ni", s.c, zeta(t))
    from_noise = np.einsum("nij,nj->ni", s.in_measurement, nu)
    level = 1e-9 * np.abs(s.g_y).max()
    assert np.abs(np.einsum("nij,nj->ni", Zt, residual + from_noise)).max() < level
    # The r rows are all there is: none of the residual is left outside of them.
    outside = o.residual - s.rows @ Zt
    assert np.abs(np.einsum("nij,nj->ni", outside, residual)).max() < level
    # x from ζ, with what the noise does to it directly
    x = s.offset + np.einsum("nij,nj->ni", s.gain, zeta(t))
    x -= np.einsum("nij,nj->ni", s.direct, nu)
    np.testing.assert_allclose(x, signals.states(t), atol=1e-9 * np.abs(x).max())
    # What c is made of is the same or more, and more where it cancels.
    assert (np.sqrt(s.terms) >= (1.0 - 1e-12) * np.abs(s.c)).all()
    exact = np.abs(o.algebraic) @ np.abs(basis)
    np.testing.assert_allclose(np.sqrt(s.terms)[..., system.q :], exact, rtol=1e-12)


def normalised_errors(name: str, outputs: float, inputs: float, seeds: int) -> tuple[Array, int]:
    """(ζ̂ − ζ)ᵀP⁻¹(ζ̂ − ζ) at the end for many seeds at once: they share P and are columns."""
    system, sample_time = shipped(name), 0.05
    signals = simulate(system, TimeSettings(), SOLVER).signals
    noise = SignalNoise(np.full(system.m, inputs), np.full(system.r, outputs), sample_time)
    count = 400
    rng = np.random.default_rng(7)
    nu = rng.normal(size=(count, system.m + system.r, seeds)) * np.sqrt(noise.variances)[:, None]
    mesh = Mesh(np.linspace(0.0, 20.0, count + 1), signals.mesh.rule)
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    s, basis, first = in_basis(
        system, t, inside, signals.inputs(t, inside), signals.outputs(t, inside)
    )
    n = s.A.shape[1]
    intensities = NoiseModel(
        noise.variances * sample_time, np.zeros(n), np.full(n, 1e-6 * 10.0 * sample_time))

    def model(t: Array, inside: Array):
        s, _, _ = in_basis(
            system, t, inside, signals.inputs(t, inside), signals.outputs(t, inside), first
        )
        m = intensities.state_space(s)
        held = nu[np.floor(inside / sample_time).astype(int)]
        D = transpose(s.rows) @ s.in_measurement
        return m._replace(b=m.b - s.from_noise @ held, z=m.z + D @ held), ()

    truth = np.concatenate([system.theta, basis.T @ signals.states(np.array([0.0]))[0]])
    start = truth[:, None] + np.sqrt(10.0) * rng.normal(size=(n, seeds))
    filtered = run_filter(model, start, 10.0 * np.eye(n), mesh, tol=1e-8, max_elements=20_000)
    P, estimate = filtered.at(np.array([20.0]))
    end = np.concatenate([system.theta, basis.T @ signals.states(np.array([20.0]))[0]])
    error = estimate[0] - end[:, None]
    return np.einsum("is,is->s", error, np.linalg.solve(P[0], error)), n


@pytest.mark.parametrize(
    ("name", "outputs", "inputs"),
    [("descriptor", 0.05, 0.0), ("descriptor", 0.02, 0.1), ("circuit", 0.02, 0.05)],
)
def test_errors_are_as_large_as_the_covariance_says(name, outputs, inputs):
    seeds = 80
    found, n = normalised_errors(name, outputs, inputs, seeds)
    spread = np.sqrt(2 * n / seeds)  # of the mean of χ² with n degrees of freedom
    assert abs(found.mean() - n) < 4 * spread


def test_a_regularised_covariance_is_an_upper_bound():
    """The circuit with noise of the output only: e1 = −V is exact, and V would be zero."""
    seeds = 80
    found, n = normalised_errors("circuit", 0.02, 0.0, seeds)
    assert found.mean() < n + 4 * np.sqrt(2 * n / seeds)
    assert found.mean() > 0.3 * n  # and not by far: two of the three directions are not exact


@pytest.mark.parametrize("name", ["circuit", "descriptor", "rotating"])
def test_converges_without_noise(name):
    system = plant_from_mapping(ROTATING) if name == "rotating" else shipped(name)
    result = run(system)
    metrics, estimation = result.metrics, result.estimation
    assert metrics.final_error_states[0] < 1e-6
    assert metrics.final_error_parameters[0] < 1e-6
    assert estimation.requirement.name == "uniform observability"
    assert estimation.requirement.holds
    assert result.settings.estimator == {"name": "kalman_bucy"}
    assert estimation.names[: system.q] == tuple(system.unknowns)
    assert estimation.names[system.q].startswith("w_")
    # The covariance of what rotates with the kernel stays in its range.
    stated = np.concatenate([estimation.parameters_std, estimation.states_std], axis=2)
    assert np.isfinite(stated).all()


def test_states_deviations_hold_the_errors_and_the_direct_noise():
    """iv = … − y: its estimate has the noise of y itself, and says so."""
    noise = NoiseSettings(outputs=0.02, sample_time=0.05, seed=3)
    result = run(shipped("circuit"), noise=noise)
    estimation = result.estimation
    late = estimation.t > 5.0
    error = estimation.states[0] - result.simulation.states
    for i, name in enumerate(result.system.states):
        stated = estimation.states_std[0, :, i]
        share = np.mean(np.abs(error[late, i]) < 2 * stated[late])
        assert share > 0.8, name
    assert estimation.states_std[0, -1, -1] == pytest.approx(0.02, rel=0.05)


def test_what_regularises_an_exact_measurement_is_reported():
    quiet = run(shipped("circuit"), noise=NoiseSettings(outputs=0.02, sample_time=0.1))
    found = assumption(quiet, "Measurement noise")
    assert found.holds
    assert found.evidence["regularised_with"] == (
        "noise of 0.001 of each equation's own under P0 at 0.1 s")
    assert found.evidence["intensity_y"] == pytest.approx(0.02**2 * 0.1)
    assert "measurement noise regularised: 0.001 of each" in quiet.verdict
    noisy = run(shipped("circuit"), noise=NoiseSettings(outputs=0.02, inputs=0.02, sample_time=0.1))
    assert "regularised_with" not in assumption(noisy, "Measurement noise").evidence
    assert "regularised" not in noisy.verdict


@pytest.mark.parametrize(("P0", "counted"), [
    ([4.0, 0.01], [4.0, 0.01]), ([0.01, 0.0], [0.01] * 2), ([0.0, 0.01], [0.01] * 2),
    ([0.0, 0.0], [1.0, 1.0]),
])
@pytest.mark.parametrize(("unit", "noise"), [(1.0, 0.0), (1e6, 0.0), (1.0, 0.3)])
def test_what_is_known_at_the_start_regularises_as_what_is_least_known_does(
    P0, counted, unit, noise
):
    """y = 1.5 a + b of states that stand still: P in closed form, with noise or without."""
    result = api_run(
        {"name": "sum", "states": ["a", "b"], "outputs": ["y"], "E": np.eye(2).tolist(),
         "A": np.zeros((2, 2)).tolist(), "C": [[1.5, 1.0 / unit]], "initial_state": [1, 2 * unit]},
        observer={"name": "kalman_bucy", "P0": (np.array([1.0, unit**2]) * P0).tolist()},
        noise={"name": "gaussian", "outputs": noise, "sample_time": 0.1}, time={"horizon": 5.0},
    )
    c, P = np.array([1.5, 1.0]), np.diag(P0)
    V = 0.1 * (noise**2 or 1e-3**2 * c**2 @ counted)
    expected = P - 5.0 * np.outer(P @ c, P @ c) / (V + 5.0 * c @ P @ c)
    found = result.details.estimation.parameters_std[0, -1] / [1.0, unit]
    np.testing.assert_allclose(found, np.sqrt(np.diag(expected)), rtol=1e-6)


def test_quantisation_counts_as_noise():
    noise = NoiseSettings(quantisation=0.12, sample_time=0.1)
    found = assumption(run(shipped("descriptor"), noise=noise), "Measurement noise")
    assert found.evidence["intensity_y"] == pytest.approx(0.12**2 / 12 * 0.1)


def test_window_is_exciting_but_not_uniformly_observable():
    result = run(shipped("window"))
    assert result.excitation.is_ie
    requirement = result.estimation.requirement
    assert not requirement.holds
    assert requirement.evidence["lambda_min"] == 0.0
    assert 3.0 <= requirement.evidence["window_start"] <= 18.0
    assert "uniform observability not met" in result.verdict
    # Yet the filter knows the state: what it learnt in three seconds it does not forget.
    assert result.metrics.final_error_states[0] < 1e-6
    settings = replace(
        result.settings, observer={"name": "kalman_bucy"}, estimator={"name": "drem"}
    )
    failed = [a.name for a in examine(settings, result.system).assumptions if not a.holds]
    assert failed == ["uniform observability"]


@pytest.mark.parametrize("process", [0.0, 0.1])
def test_a_measured_state_is_determined_whatever_is_not(process):
    """x is measured; z, which nothing shows, does not make it unknown."""
    plant = {
        "name": "hidden", "states": ["x", "z"], "outputs": ["y"], "E": [[1, 0], [0, 1]],
        "A": [[-1, 0], [1, 0]], "C": [[1, 0]], "initial_state": {"x": 1, "z": 3},
    }
    observer = {"name": "kalman_bucy", "process": process}
    result = api_run(plant, observer=observer, time={"horizon": 5})
    assert "not determined by the data: z, e0_z;" in result.verdict


@pytest.mark.parametrize("share", [1.0, 0.01])
def test_uniform_observability_is_measured_by_P0(share):
    """Of states that stand still the Gramian is ∫CᵀV⁻¹C: one known at the start counts as others.

    λ_min is that of P0^½ M P0^½, and a state of variance 0 has the largest of the deviations. Here
    it is that of a, which is seen less and less.
    """
    result = api_run(
        {"name": "still", "states": ["a", "b", "c"], "outputs": ["y1", "y2", "y3"],
         "E": np.eye(3).tolist(), "A": np.zeros((3, 3)).tolist(),
         "C": [["exp(-t/5)", 0, 0], [0, 2, 0], [0, 0, 1]], "initial_state": [1, 2, 3]},
        observer={
            "name": "kalman_bucy", "P0": {"w_a": 4.0 * share, "w_b": 9.0 * share, "w_c": 0.0},
        },
        noise={"name": "gaussian", "outputs": 0.02, "sample_time": 0.1}, time={"horizon": 5.0},
    )
    found, unit = result.details.estimation.requirement, share / (0.02**2 * 0.1)
    first, last = (2.5 * (np.exp(-0.4 * t) - np.exp(-0.4 * t - 0.2)) for t in (0.0, 4.5))
    longer = {"largest_lambda_min": 4.0 * unit * first, "needed": 1e-8 * 9.0 * 2.0**2 * 0.5 * unit}
    for key, value in longer.items():  # of windows that end at an edge
        assert 1.0 <= found.evidence[key] / value < 1.25
    assert found.evidence == pytest.approx({
        **found.evidence, "window": 0.5, "window_start": 4.5, "lambda_min": 4.0 * unit * last,
    }, rel=1e-6)
    assert found.holds
    assert f"falls to {4.0 * unit * last:.3g} of P0⁻¹ (from t = 4.5 s on; evi" in found.text


def test_a_wandering_unknown_is_followed():
    system = shipped("descriptor", unknowns={"theta1": "1.5 + step(t - 10)", "theta2": -0.8})
    still = run(system, horizon=30.0, noise=NoiseSettings(outputs=0.01, sample_time=0.1))
    moving = run(
        system, horizon=30.0, noise=NoiseSettings(outputs=0.01, sample_time=0.1),
        process={"theta1": 0.01},
    )
    assert moving.metrics.final_error_parameters[0] < 0.1
    assert still.metrics.final_error_parameters[0] > 0.3


def test_no_word_of_noise_is_noise_of_size_zero():
    system = shipped("descriptor")
    signals = simulate(system, TimeSettings(horizon=1.0), SOLVER).signals
    none = SignalNoise(np.zeros(system.m), np.zeros(system.r), NoiseSettings().sample_time)
    t, deviations = np.linspace(0.0, 1.0, 5), []
    for noise in (None, none):
        measured = replace(seen(signals), noise=noise)
        found = observe(system, measured, SOLVER, name="kalman_bucy")
        deviations.append(np.hstack(found.state_map.deviations(t)))
    np.testing.assert_array_equal(*deviations)
    assert np.isfinite(deviations[0]).all()


def test_what_a_mesh_resolves_beside_the_filter_is_the_state_in_units(monkeypatch):
    """Of a state of 1e4 and one of 1e-3, and of an unknown of 1e5: none counts for another."""
    kept = []

    def watched(*arguments, monitor, **settings):
        kept.append(monitor)
        return filter_windows(*arguments, monitor=monitor, **settings)

    filter_windows = kalman_bucy.filter_windows
    monkeypatch.setattr(kalman_bucy, "filter_windows", watched)
    system = plant_from_mapping({
        "name": "two", "states": ["a", "b"], "inputs": {"u": "1 + sin(t)"}, "outputs": ["y"],
        "unknowns": {"k": 1e5}, "E": [[1, 0], [0, 0]], "A": [[-1, 0], [1e-7, -1]],
        "B": [[1e4], [1e-3]], "F": [["0.1*cos(3*t)"], [0]], "C": [[1e-4, 0]],
        "initial_state": [1e4, 2e-3],
    })
    signals = simulate(system, TimeSettings(horizon=4.0), SOLVER).signals
    state_map = observe(system, seen(signals), SOLVER, name="kalman_bucy").state_map
    found = state_map.filtered
    mesh = found.mesh
    _, estimate = found.at(mesh.points.ravel(), mesh.inside.ravel())
    estimate = estimate.reshape(*mesh.points.shape, -1, 1)
    extras = [np.asarray(part.values) for part in found.extras]
    (x, _), _ = kept[0](estimate, tuple(extras))
    expected = state_map.at(mesh.points[:, 2])(estimate[None, :, 2, :, 0])[0]
    sizes = np.abs(x).max(axis=(0, 1))
    assert ((sizes > 0.1) & (sizes < 10.0)).all()
    np.testing.assert_allclose(x[:, 2] / x[-1, 2], expected / expected[-1], rtol=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"P0": {"theta9": 1.0}}, "observer.P0: there is no estimate 'theta9'"),
        ({"P0": [1.0]}, "observer.P0 has 1 values"),
        ({"process": -1.0}, "observer.process: expected 0 or a positive number, got -1"),
    ],
)
def test_settings_that_do_not_fit(settings, message):
    system = shipped("descriptor")
    signals = simulate(system, TimeSettings(horizon=1.0), SOLVER).signals
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        observe(system, seen(signals), SOLVER, name="kalman_bucy", **settings)


def test_command_line(tmp_path):
    said = printed(gpebo(
        "run", "plant=descriptor", "observer=kalman_bucy", "observer.P0={theta1: 4}", *FAST,
        cwd=tmp_path,
    ))
    (folder,) = folders(tmp_path)
    assert folder.name.endswith("_descriptor_kalman_bucy")
    assert "measurement noise regularised" in said.splitlines()[-1]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["estimator"] == {"name": "kalman_bucy"}
    assert summary["estimator_requirement"]["name"] == "uniform observability"
    rows = rows_of(folder / "estimates.csv")
    assert float(rows[0]["theta1_std"]) == pytest.approx(2.0)
    assert float(rows[0]["w_x1_std"]) == pytest.approx(10**0.5)
    assert float(rows[-1]["w_x1_true"]) == pytest.approx(float(rows[-1]["w_x1_hat"]), abs=1e-6)
    assert {"x3_std", "theta2_hat", "x1_hat"} <= rows[0].keys()
    assert_repeats(folder, "estimates.csv")
    assert "kalman_bucy" in printed(gpebo("compare", folder, cwd=tmp_path))
    checked = gpebo("check", "plant=descriptor", "observer=kalman_bucy", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout
    assert "holds  uniform observability" in checked.stdout
    assert "kalman_bucy" in gpebo("list", "observers", cwd=tmp_path).stdout


@pytest.mark.parametrize("entries", [
    {"states": ["x"], "E": [[0]], "A": [[-1]], "B": [[1]], "C": [[1]], "initial_state": [0]},
    # x = u and z = u': constraints leave nothing free, though E is not zero.
    {"states": ["x", "z"], "E": [[1, 0], [0, 0]], "A": [[0, 1], [1, 0]], "B": [[0], [-1]],
     "C": [[1, 0]], "initial_state": [0, 1]},
])
def test_nothing_to_filter_is_one_line(entries):
    plant = {"name": "p", "inputs": {"u": "sin(t)"}, "outputs": ["y"], **entries}
    with pytest.raises(ConfigError, match="nothing for observer=kalman_bucy to filter"):
        api_run(plant, observer="kalman_bucy", time={"horizon": 1})
    assert api_run(plant, observer="gpebo", time={"horizon": 1}).details.metrics is not None


@pytest.mark.parametrize(("phi", "level", "said"), [
    ("cos(y)", 0.1, True), ("cos(y)", 0.0, False), ("cos(t)", 0.1, False),
])
def test_noise_in_the_matrices_is_not_in_the_deviations_and_that_is_said(phi, level, said):
    noise = {"name": "gaussian", "outputs": level} if level else "none"
    result = api_run(one_state(phi=[phi]), observer="kalman_bucy", noise=noise,
                     time={"horizon": 1.0, "samples": 11})
    told = "deviations know nothing of the noise of y in the matrices"
    assert (told in result.verdict) == said


def test_the_table_does_not_ask_since_when_a_moving_parameter_is_known():
    """The filter's w_<state> is a state: it stands at no value, and its state has the evidence."""
    made = api_run("descriptor", observer="none", time={"horizon": 5.0, "samples": 101})
    result = api_run(
        "descriptor", data={"t": made.t, "u": made["u"], "y": made["y"]}, observer="kalman_bucy",
        noise={"name": "gaussian", "outputs": 0.01},
    )
    lines = {line.split()[0]: line for line in estimate_table(result.details) if line.split()}
    assert "from" in lines["theta1"]
    assert "from" not in lines["w_x1"]
    assert not lines["w_x1"].rstrip().endswith("no")


@pytest.mark.parametrize(("level", "samples"), [
    ("given", 89), ("from the residual", 89), ("given", 9),  # few of them have long elements
])
def test_a_recording_has_its_own_sample_times_and_noise(level, samples):
    """A constant level, measured at uneven times: its deviation is that of the mean of the data."""
    plant = one_state(initial_state=[0])
    rng, sigma = np.random.default_rng(4), 0.3
    h = np.concatenate([np.full(200, 0.1), [4.0], np.full(200, 0.1)])
    t = np.concatenate([[0.0], np.cumsum(h)])
    y = 2.0 + sigma * rng.standard_normal(len(t))
    noise = {"noise": {"name": "gaussian", "outputs": sigma}} if level == "given" else {}
    result = api_run(
        plant, observer={"name": "kalman_bucy", "P0": 1e4}, data=pd.DataFrame({"t": t, "y": y}),
        time={"samples": samples}, **noise,
    )
    # By information, 1/σ²h per second: the pause has as much as one sample.
    of_mean, estimation = sigma / np.sqrt(len(h)), result.details.estimation
    first, rows = estimation.states_std[0, 1, 0], estimation.t[1] / 0.1
    assert first == pytest.approx(sigma / np.sqrt(rows), rel=1e-3 if level == "given" else 0.08)
    assert estimation.states_std[0, -1, 0] == pytest.approx(of_mean, rel=0.05)
    assert abs(result["x_hat"][0, -1] - 2.0) < 3 * of_mean
    told = "taken from the residual, 0.3" if level != "given" else "noise of the outputs"
    assert (told in result.verdict) == (level != "given")


def test_a_recording_of_one_row_more_than_nothing_has_no_level_of_noise():
    """A constant that one row, held up to the end, tells: there is nothing left to take it from."""
    data = {"frame": pd.DataFrame({"t": [0.0, 1.0], "y": [1.0, 0.4]}), "hold": "zoh"}
    found = api_run(one_state(initial_state=[0]), observer="kalman_bucy", data=data)
    assert "noise of the outputs taken from" not in found.verdict
    assert found["x_hat"][0, -1] == pytest.approx(1.0, abs=1e-5)


def test_a_recording_that_is_fitted_exactly_has_no_level_of_noise():
    """Two rows, and three states to fit them with."""
    plant = {
        "name": "p", "states": ["x", "v", "w"], "outputs": ["y"], "E": np.eye(3).tolist(),
        "A": [[0, 1, 0], [-1, -0.1, 1], [0, 0, -1]], "C": [[1, 0, 0]], "initial_state": [1, 0, 0],
    }
    data = pd.DataFrame({"t": [0.0, 1.0], "y": [1.0, 0.4]})
    found = api_run(plant, observer="kalman_bucy", data=data, time={"samples": 3})
    assert "noise of the outputs taken from" not in found.verdict
    assert np.isnan(found.details.estimation.states_std).all()


@pytest.mark.parametrize(("rate", "told"), [
    (-0.5, "explain the data up to white noise, 1.0"),
    (-0.525, "times what the sensors' noise makes, is not white"),
])
def test_a_wrong_plant_does_not_explain_a_recording(rate, told):
    """One rate is off by 5 %: estimates are 270 deviations off, which P does not tell."""
    t, sigma, leak = np.linspace(0.0, 20.0, 2001), 0.01, 0.3
    # h' = -h/2 + 1 + sin t - leak
    h = 2.0 * (1.0 - leak) + (2.0 * np.sin(t) - 4.0 * np.cos(t)) / 5.0
    y = h + sigma * np.random.default_rng(0).standard_normal(len(t))
    plant = one_state(
        A=[[rate]], B=[[1]], F=[[-1]], inputs={"u": 0}, unknowns={"leak": leak}, initial_state=[0]
    )
    noise = {"name": "gaussian", "outputs": sigma}
    data = pd.DataFrame({"t": t, "u": 1.0 + np.sin(t), "y": y})
    found = api_run(plant, data=data, observer="kalman_bucy", noise=noise)
    std = found.details.estimation.parameters_std[0, -1, 0]
    off = abs(found.estimates["leak"][0, -1] - leak) / std
    assert (off < 3.0) == (rate == -0.5)
    assert told in found.verdict


def test_what_may_drift_explains_no_data():
    """Least squares of constants say nothing of a filter that takes one of them to wander."""
    t = np.linspace(0.0, 5.0, 201)
    plant = one_state(unknowns={"leak": 1.0}, F=[[-1]], initial_state=[0])
    data = {"t": t, "y": -t + 0.01 * np.random.default_rng(0).standard_normal(201)}
    told = [
        api_run(plant, data=data, observer={"name": "kalman_bucy", "process": process}).verdict
        for process in (0.0, {"leak": 0.1})
    ]
    assert ["explain the data" in verdict for verdict in told] == [True, False]


@pytest.mark.parametrize("hold", ["linear", "zoh"])
def test_the_deviation_of_a_long_recording_is_that_of_its_uneven_rows(hold):
    """Of constant levels: each is a sum of rows, and outputs of one row each tell its weights."""
    eight, t = np.eye(8), np.random.default_rng(4).exponential(0.1, 48).cumsum()
    t[30:] += 3.0
    plant = {
        "name": "levels", "states": [f"x{k}" for k in range(8)], "initial_state": [0] * 8,
        "outputs": [f"y{k}" for k in range(8)], "E": eight, "A": 0.0 * eight, "C": eight,
    }
    noise, final = np.random.default_rng(5).standard_normal((8, 48)), np.zeros((7, 8))
    for k in range(7):
        rows = dict(zip(plant["outputs"], noise + np.eye(56)[8 * k : 8 * k + 8, :48], strict=True))
        found = api_run(
            plant, observer={"name": "kalman_bucy", "P0": 1e6}, time={"samples": 5},
            data={"frame": pd.DataFrame({"t": t, **rows}), "hold": hold},
            noise={"name": "gaussian", "outputs": 1.0},
        ).details.estimation
        final[k] = found.states[0, -1]
    weights = final[:6] - final[6]
    assert found.states_std[0, -1, 0] == pytest.approx(np.linalg.norm(weights), rel=0.03)


def test_a_figure_of_a_recording_shows_where_states_swing():
    """Not only what is near the last value."""
    t = np.linspace(0.0, 20.0, 201)
    data = pd.DataFrame({"t": t, "y": np.sin(t)})
    plant = {
        "name": "swing", "states": ["a", "b"], "outputs": ["y"], "initial_state": {"a": 0, "b": 1},
        "E": [[1, 0], [0, 1]], "A": [[0, 1], [-1, 0]], "C": [[1, 0]],
    }
    found = api_run(plant, estimator="least_squares", data=data).details
    [panels] = describe(found, ["estimates_a"]).values()
    for panel in panels:
        assert panel.limits[0] < -0.9
        assert panel.limits[1] > 0.9


@pytest.mark.parametrize("hold", ["linear", "zoh"])
def test_the_error_estimate_is_that_of_a_finer_solution(hold):
    """Along a rough recording: neither a tenth nor ten times of what a finer tolerance changes."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.02, 0.3, 60))
    data = pd.DataFrame({"t": t, "u": rng.standard_normal(60), "y": rng.standard_normal(60)})
    plant = one_state(
        inputs={"u": 0}, unknowns={"gain": 1, "leak": 1}, A=[[-1]], F=[["u", -1]], initial_state=[0]
    )
    rough, fine = (
        api_run(
            plant, observer="kalman_bucy", solver={"tol": tol}, data={"frame": data, "hold": hold},
            noise={"name": "gaussian", "outputs": 0.1}, time={"samples": 997},
        ).details for tol in (1e-2, 1e-11)
    )
    found = max(
        (np.abs(one - other) / np.abs(other).max(axis=1)).max() for one, other in (
            (rough.estimation.parameters, fine.estimation.parameters),
            (rough.estimation.parameters_std, fine.estimation.parameters_std),
        )
    )
    assert 0.1 < rough.regression.error_estimate / found < 10.0


@pytest.mark.parametrize(("observer", "start"), [
    ("kalman_bucy", 2.0**30), ({"name": "gpebo", "remedy": "output_injection"}, 5.0),
])
def test_times_far_from_zero_change_nothing(observer, start):
    """The covariance falls within 1e-9 s; times of 2^30 s are told apart to 2e-7 s."""

    def found(start):
        plant = {
            "name": "p", "states": ["a", "b"], "outputs": ["y"], "unknowns": {"k": 0.7},
            "parameters": {"T": start}, "E": [[1, 0], [0, 1]], "C": [[1, 0]], "F": [[0], [1]],
            "A": [[0, 1], [-2, "-0.3 - 0.1*cos(t - T)"]], "initial_state": [1, 0],
        }
        time = {"start": start, "horizon": 1, "samples": 11}
        result = api_run(plant, observer=observer, time=time)
        since = result.details.excitation.t_c - start
        return np.array([since, *(result.estimates[name][0, -1] for name in ("a", "b", "k"))])

    np.testing.assert_allclose(found(start), found(0.0), atol=1e-6)


@pytest.mark.parametrize(("sees", "form"), [(3, "given"), (-3, "strangeness_free")])
def test_auto_is_the_form_that_gpebo_takes(sees, form):
    """Along the other sign of C the equations as given grow until they tell nothing of v."""
    plant = {
        "name": "p", "states": ["x", "v", "z"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": np.diag([1, 1, 0]).tolist(), "A": [[-1, 0, 4], [1, -1, 0], [1, 0, 0]],
        "B": [[1], [0], [0]], "phi": [0, 0, "-cos(t)"], "C": [[sees, 1, 1]],
        "initial_state": [1, 0.5, 0],
    }
    noise = {"name": "gaussian", "outputs": 0.01, "sample_time": 0.5}
    own = {"time": {"horizon": 8, "samples": 5}, "noise": noise}
    taken = {}
    for observer in ("gpebo", "kalman_bucy"):
        found = api_run(plant, observer=observer, **own)
        (taken[observer],) = (
            a.evidence["form"] for a in found.assumptions if a.name == "Assumption 1"
        )
    assert taken == dict.fromkeys(taken, form)
    assert "not determined" not in found.verdict
    assert ("tells with more digits" in found.verdict) == (form == "strangeness_free")


def test_rounding_of_what_constraints_say_is_not_resolved():
    """c a + s b rests at 0, while the input makes −s a + c b as large as 1e8."""
    c, s = np.cos(2.0), np.sin(2.0)
    result = api_run(
        {"name": "resting", "states": ["a", "b"], "inputs": {"u": "sin(3*t)"}, "outputs": ["y"],
         "E": [[c, s], [0, 0]], "A": [[-c, -s], [-s, c]], "B": [[0], [1e8]],
         "C": [[1, 0.2]], "initial_state": [0, 0]},
        observer="kalman_bucy", solver={"max_elements": 200}, time={"horizon": 10, "samples": 51},
    )
    assert np.abs(result.details.estimation.parameters).max() < 1e-6


def test_the_mesh_of_windows_is_the_one_that_they_were_solved_on(monkeypatch):
    monkeypatch.setattr("gpebo_cli.numerics.mesh._WINDOW", 2)
    edges, rule = [[1.0, 1.5, 2.0, 3.0], [3.0, 4.0, 5.0]], radau_rule(3)
    parts = [
        SimpleNamespace(
            mesh=Mesh(np.array(own), rule), error_estimate=error, extras=(),
            at=lambda t: (t[:, None, None], 2.0 * t[:, None, None]),
        ) for own, error in zip(edges, (2e-9, 1e-9), strict=True)
    ]
    t = np.array([1.0, 2.5, 3.0, 4.5, 5.0])
    found = kalman_bucy._kept(parts, Mesh(np.arange(1.0, 6.0), rule), t)
    assert found.mesh.edges.tolist() == [1.0, 1.5, 2.0, 3.0, 4.0, 5.0]
    assert found.error_estimate == 2e-9
    P, estimate = found.at(t)
    np.testing.assert_array_equal(np.stack([P, estimate])[:, :, 0, 0], [t, 2.0 * t])
    P, _ = kalman_bucy._kept(parts, Mesh(np.arange(1.0, 6.0), rule), None).at(t[[0, -1]])
    np.testing.assert_array_equal(P[:, 0, 0], [1.0, 5.0])  # the ends, where no times are asked for
