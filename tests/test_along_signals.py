"""The observer along measured signals: simulated, recorded, at samples, with every remedy."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from plants import DATA, one_state, seen
from processes import write_table

from gpebo_cli import run
from gpebo_cli.errors import ConfigError, GpeboError, ModelError
from gpebo_cli.experiment.pipeline import stream
from gpebo_cli.model.functions import Names, system_from_functions
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers import SignalNoise, observe
from gpebo_cli.settings import DataSettings, Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

PROBLEMS = ("boost", "lorenz")


def problem(name):
    return json.loads((DATA / "state_affine" / f"{name}.json").read_text("utf-8"))


def of(result, system):
    """Largest error of θ and x(0) at the end; ξ_a starts at zero, so e₀ = −x(0)."""
    truth = np.concatenate([system.theta, -system.initial_state])
    return np.abs(result.details.estimation.parameters[0, -1] - truth).max()


def signals_of(name, horizon):
    system = plant_from_mapping(problem(name)["plant"])
    return system, simulate(system, TimeSettings(horizon=horizon), SolverSettings()).signals


def recording(path, system, signals, horizon, rate):
    """A CSV of the signals, ``rate`` rows per second."""
    t = np.arange(round(horizon * rate) + 1) / rate
    columns = [t, *signals.inputs(t).T, *signals.outputs(t).T]
    return write_table(
        path, dict(zip(["t", *system.inputs, *system.outputs], columns, strict=True))
    )


@pytest.mark.parametrize("name", PROBLEMS)
def test_states_are_those_of_the_reference(name):
    given = problem(name)
    until = given["judge_until"]
    _, signals = signals_of(name, until)
    for point in given["at"]:
        if point["t"] <= until:
            found = signals.states(np.array([point["t"]]))[0]
            np.testing.assert_allclose(found, point["x"], rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", PROBLEMS)
def test_unknowns_and_start_are_found_with_nothing_tuned(name):
    given = problem(name)
    until = given["judge_until"]
    found = run(given["plant"], estimator="ls_drem", time={"horizon": until, "samples": 11})
    assert of(found, plant_from_mapping(given["plant"])) < 1e-9
    expected = given["check"][str(until)]["lambda_min"]  # of the same regressor, by DOP853
    assert found.excitation.lambda_min == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "hold", "rate", "order"),
    [("boost", "zoh", 100, 1), ("boost", "linear", 100, 2), ("boost", "cubic", 50, 4),
     ("lorenz", "cubic", 250, 4)],
)  # fmt: skip
def test_a_recording_is_as_good_as_its_hold(name, hold, rate, order, tmp_path):
    """Four times as many rows, and errors fall by 4 to the order of the hold."""
    horizon = problem(name)["judge_until"]
    system, signals = signals_of(name, horizon)
    errors = []
    for k in (rate, 4 * rate):
        file = recording(tmp_path / f"{k}.csv", system, signals, horizon, k)
        data = {"name": "csv", "file": file, "hold": hold}
        found = run(problem(name)["plant"], estimator="ls_drem", data=data, time={"samples": 11})
        errors.append(of(found, system))
    assert errors[1] < errors[0] / (0.5 * 4**order)
    if (hold, 4 * rate) == ("cubic", 1000):
        assert errors[1] < 1e-8


@pytest.mark.parametrize(("hold", "order"), [("zoh", 1), ("linear", 2)])
def test_at_samples_estimates_converge_with_the_order_of_the_hold(hold, order):
    given = problem("boost")
    errors = [
        of(run(given["plant"], estimator="ls_drem", time={"horizon": 3.0, "samples": 11},
               observer={"sample_time": step, "hold": hold}), plant_from_mapping(given["plant"]))
        for step in (0.02, 0.005)
    ]  # fmt: skip
    assert errors[1] < errors[0] / (0.5 * 4**order)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_a_stream_gives_what_a_run_at_samples_gives(hold):
    system, signals = signals_of("lorenz", 1.0)
    t = np.arange(101) / 100
    u, y = signals.inputs(t), signals.outputs(t)
    estimator = {"name": "least_squares", "f0": 1e-9}
    online = stream(Settings(
        estimator=estimator, observer={"name": "gpebo"}, data=DataSettings(hold=hold),
        time=TimeSettings(np.nan, np.nan),
    ), system)(0.0, np.append(u[0], y[0]))  # fmt: skip
    rows = [online.feed(t[k : k + 1], u[k : k + 1], y[k : k + 1]).parameters for k in range(101)]
    batch = run(
        problem("lorenz")["plant"], estimator=estimator, time={"horizon": 1.0, "samples": 101},
        observer={"sample_time": 0.01, "hold": hold},
    ).details.estimation.parameters
    np.testing.assert_allclose(np.concatenate(rows, axis=1)[:, 5:], batch[:, 5:], rtol=1e-6)


@pytest.mark.parametrize(
    ("remedy", "estimator"),
    [("output_injection", "ls_drem"), ("reset", "ls_drem"), ("current_coordinates", "mre"),
     ("noise_free", "ls_drem")],
)  # fmt: skip
@pytest.mark.parametrize(("name", "horizon"), [("lorenz", 1.0), ("generator", 3.0)])
def test_every_remedy_is_exact_along_signals(name, horizon, remedy, estimator):
    more = {"reset_interval": horizon / 5} if remedy == "reset" else {}
    found = run(
        name, observer={"remedy": remedy, **more}, time={"horizon": horizon, "samples": 11},
        estimator={"name": estimator, **({"gamma": 1e8} if estimator == "mre" else {})},
    ).details
    of_states = np.abs(found.estimation.states[0, -1] - found.simulation.states[-1])
    size = np.abs(found.simulation.states).max(axis=0)
    assert (of_states < 1e-7 * size).all()
    q = found.system.q
    of_theta = found.estimation.parameters[0, -1, :q] - found.system.theta
    assert (np.abs(of_theta) < 1e-6 * np.abs(found.system.theta)).all()


@pytest.mark.parametrize("followed", ["0", "y"])
@pytest.mark.parametrize("what", [
    "sign(@ + 0.38)", "sign(abs(@) - 0.38)", "max(@, -0.38)", "0.9*min(@, 0.2)*sign(@ - 0.1)",
])
def test_what_switches_by_an_input_is_as_exact_as_its_text_in_time(what, followed):
    """Where an element ends with a jump, rounding of the input decided on which side that was."""
    text, found = "(1.2*cos(0.91*t))", []
    for name in (text, "u"):
        entry = what.replace("@", name)
        found.append(run({
            "name": "relay", "states": ["x", "v"], "unknowns": {"load": 0.7}, "outputs": ["y"],
            "inputs": {"u": text}, "E": [[1, 0], [0, 1]], "B": [[followed], [0]], "C": [[1, 0]],
            "A": [[-1.5, f"0.9*({entry})"], [0.4, f"-1 - {followed}**2"]], "phi": [entry, 0],
            "F": [[1], [0]], "initial_state": [-0.4, 1],
        }, estimator="ls_drem", time={"horizon": 4.0, "samples": 41}))
    ours, theirs = found
    for name in ("x", "v"):
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-12)
    np.testing.assert_allclose(ours.estimates["load"], theirs.estimates["load"], atol=1e-10)
    elements = [each.details.simulation.elements for each in found]
    assert elements[1] <= elements[0] + 4


def test_a_kink_of_an_input_in_a_constraint_is_passed_where_an_output_is_followed():
    text = "(1.2*cos(0.91*t))"
    found = [
        run({
            "name": "kink", "states": ["x", "z", "w"], "outputs": ["y"], "inputs": {"u": text},
            "E": [[1, 0, 0], [0, 0, 0], [0, 0, 1]], "B": [[0], [0], ["0.5*y"]], "C": [[0, 0, 1]],
            "A": [[0, 1, 0], [1, 0, 0], [0, 1, "-1 - 0.3*y**2"]],
            "phi": [0, f"-0.1*abs({name} + 0.38)", 0], "initial_state": [0, 0, 1],
        }, observer="none", time={"horizon": 4.0, "samples": 41}) for name in (text, "u")
    ]
    for name in "xzw":
        np.testing.assert_allclose(found[1][name], found[0][name], atol=1e-9)


@pytest.mark.parametrize(("start", "level"), [(0.0, 0.3), (1e6, 0.999)])  # near a row, late
def test_a_recorded_input_switches_an_output_between_rows(start, level):
    # x = 1 + t/2 and the gate are straight lines between rows, so that nothing is interpolated.
    t = np.arange(0.0, 12.01, 0.1)
    gate = (np.sin(1.1 * t) > 0.0) * 1.0
    plant = {
        "name": "gated", "states": ["x"], "inputs": {"gate": 1}, "unknowns": {"a": 0.5},
        "outputs": ["y"], "E": [[1]], "A": [[0]], "B": [[0]], "F": [[1]],
        "C": [[f"step(gate - {level})"]], "initial_state": {"x": 1},
    }
    data = {"t": start + t, "gate": gate, "y": 1.0 + 0.5 * t}
    found = run(plant, data=data, estimator="ls_drem", gamma=1e3, time={"samples": 13})
    np.testing.assert_allclose(found.estimates["a"][0, -1], 0.5, rtol=1e-9)
    assert "errors of the observer" not in found.verdict


def test_the_kalman_bucy_filter_is_that_of_the_linear_plant_along_the_signals():
    """The same estimates as for a plant whose A and F are those functions of time."""
    system, signals = signals_of("lorenz", 2.0)

    def A(t):
        y, zero, one = signals.outputs(t)[:, 0], 0 * t, 1 + 0 * t
        return np.moveaxis(np.array([
            [-10 * one, 10 * one, zero], [zero, -one, -y], [zero, y, -8 / 3 * one]
        ]), 2, 0)  # fmt: skip

    def F(t):
        y = signals.outputs(t)[:, 0]
        return np.stack([0 * y, y, 0 * y], axis=1)[:, :, None]

    linear = system_from_functions(
        "linear", np.eye(3), A, F=F, theta=[28.0], C=[[1.0, 0, 0]], initial_state=[1, 1, 20],
        names=Names(outputs=["y"]),
    )
    t = np.linspace(0.0, 2.0, 21)
    noise = SignalNoise(np.zeros(0), np.array([0.1]), 0.01)
    measured = replace(seen(signals), noise=noise)
    estimates = []
    for plant in (system, linear):
        found = observe(plant, measured, SolverSettings(tol=1e-8), name="kalman_bucy")
        estimates.append(found.estimator.estimate(found.regression, t).parameters(slice(None)))
    np.testing.assert_allclose(estimates[0], estimates[1], rtol=1e-6, atol=1e-6)
    truth = np.concatenate([[28.0], signals.states(t[-1:])[0]])
    assert np.abs(estimates[0][0, -1] - truth).max() < 0.01 * 28


@pytest.mark.parametrize("hold", ["zoh", "linear", "cubic"])
@pytest.mark.parametrize("sample_time", [None, 0.05])
def test_a_divisor_that_passes_through_zero_is_named_with_its_time(hold, sample_time, tmp_path):
    """Also where no sample is zero; simulations end there (test_state_affine)."""
    t = np.arange(41) / 20
    columns = {"t": t, "duty": 0.5 + 0.1 * np.sin(3 * t), "y": 18 * (1.021 - t)}
    data = {"name": "csv", "file": write_table(tmp_path / "r.csv", columns), "hold": hold}
    entry = r"F\[1\]\[0\] = '-1/y' divides by something that passes through zero near t = 1\.0"
    with pytest.raises(ConfigError, match=entry):
        run(problem("boost")["plant"], data=data, observer={"sample_time": sample_time})


@pytest.mark.parametrize("entry", ["1/y**2", "log(y)", "y**(-0.5)"])
def test_an_output_that_touches_zero_is_named_with_its_time(entry, tmp_path):
    """y = 1 + cos t, simulated, recorded and at samples."""
    plant = {
        "name": "touching", "states": ["x", "z"], "inputs": {"u": "-sin(t)"}, "outputs": ["y"],
        "unknowns": {"k": 1}, "E": [[1, 0], [0, 1]], "A": [[0, 0], [0, -1]], "B": [[1], [0]],
        "F": [[0], [entry]], "C": [[1, 0]], "initial_state": [2, 1],
    }
    if entry != "1/y**2":  # whose elements are cut for half a minute before it is refused
        with pytest.raises(GpeboError, match=r"t = 3\.14"):
            run(plant, time={"horizon": 4})
    t = np.linspace(0.0, np.pi + 1.0, 51)
    t[38] = np.pi
    file = write_table(tmp_path / "r.csv", {"t": t, "u": -np.sin(t), "y": 1 + np.cos(t)})
    source = plant_from_mapping(plant).coefficients
    near = np.array([3.0, np.pi - 1e-7, 3.3])  # never exactly zero
    if "/" in entry:
        with pytest.raises(ConfigError, match=r"passes through zero near t = 3\.14"):
            source.taylor(near, 0, near, np.column_stack([-np.sin(near), 1 + np.cos(near)])[None])
    for observer in ({}, {"sample_time": 0.1, "hold": "linear"}):
        data = {"name": "csv", "file": file, "hold": "zoh"}
        with pytest.raises(GpeboError, match=re.escape(f"F[1][0] = '{entry}' has no finite value")):
            run(plant, data=data, observer={"name": "gpebo", **observer})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"E": [["0.5", 0], [0, "y"]]}, r"E\[1\]\[1\] = 'y': y is an output and may not"),
        ({"A": [["-power", -1], [1, 0]]}, r"A\[0\]\[0\] = '-power': power is an unknown"),
        ({"A": [["-i", -1], [1, 0]]}, r"A\[0\]\[0\] = '-i': i is a state"),
        ({"C": [[0, "y"]]}, r"C\[0\]\[1\] = 'y': y is an output and may not stand in C"),
    ],
)
def test_names_that_may_not_stand_there_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        plant_from_mapping({**problem("boost")["plant"], **change})


def test_a_recording_without_a_column_is_refused_by_its_name(tmp_path):
    (tmp_path / "r.csv").write_text("t,duty\n0,1\n1,1\n", "utf-8")
    with pytest.raises(ConfigError, match="there is no column y; plant boost needs t, duty, y"):
        run(problem("boost")["plant"], data={"name": "csv", "file": str(tmp_path / "r.csv")})


def test_a_plant_that_amplifies_errors_says_how_accurate_it_is():
    """Lorenz, exponent 0.9/s: after 12 s fifty thousand times the error of a step."""
    long, short = (
        run("lorenz", estimator="least_squares", time={"horizon": horizon, "samples": 11}).details
        for horizon in (12.0, 8.0)
    )
    assert "the simulation is not as good as solver.tol" in long.verdict
    assert "not as good" not in short.verdict


@pytest.mark.parametrize(("deviation", "stated"), [(0.0, True), (0.1, False)])
def test_noise_of_an_input_that_stands_in_the_matrices_has_no_linear_response(deviation, stated):
    system = plant_from_mapping(one_state(inputs={"u": "sin(t)"}, A=[["-1 - u"]], B=[[1]]))
    signals = simulate(system, TimeSettings(horizon=1.0), SolverSettings()).signals
    noise = SignalNoise(np.array([deviation]), np.ones(1), 0.01)
    found = observe(system, replace(seen(signals), noise=noise), SolverSettings())
    assert (found.errors is not None) == stated


@pytest.mark.parametrize("observer", [
    {"name": "gpebo"}, {"name": "gpebo", "remedy": "output_injection"},
])
@pytest.mark.parametrize(("follows", "levels", "linear"), [
    ("y", None, False), ("y", [0, 0, 0], False), ("y", [0.1, 0, 0], True),
    ("y", [0, 0.1, 0], False), ("y", [0, 0, 0.1], True), ("u", None, True),
    ("u", [0, 0, 0], True), ("u", [0.1, 0, 0], False), ("u", [0, 0.1, 0], True),
    ("t", [0.1, 0.1, 0.1], True),
])
def test_errors_are_linear_unless_matrices_follow_what_is_noisy(follows, levels, linear, observer):
    """Where no level is said, or all are zero, the outputs are."""
    system = plant_from_mapping(one_state(
        A=[[f"-1 - {follows}**2"]], inputs={"u": "sin(t)"}, B=[[1]], outputs=["y", "z"],
        C=[[1], [2]],
    ))
    signals = simulate(system, TimeSettings(horizon=1.0), SolverSettings()).signals
    noise = None if levels is None else SignalNoise(np.array(levels[:1]), np.array(levels[1:]), 0.1)
    found = observe(system, replace(seen(signals), noise=noise), SolverSettings(), **observer)
    assert (found.errors is not None, found.respond is not None) == (linear, linear)


def test_what_is_found_along_one_recording_is_not_believed_along_another():
    """A rank of the same plant, in the same process, that the measured signal decides."""
    plant = plant_from_mapping({
        "name": "along", "states": ["x", "z"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, "y"]], "B": [[1], [0]], "C": [[0, 1]],
        "initial_state": {"x": 1, "z": 1},
    })
    t = np.linspace(0.0, 2.0, 201)
    observer = {"name": "gpebo", "form": "strangeness_free"}

    def recorded(y):
        return run(plant, data={"t": t, "u": np.sin(t), "y": y}, observer=observer)

    recorded(1.0 + 0.1 * t)
    with pytest.raises(ModelError, match="the rank of the differential part changes at t = 1 "):
        recorded(1.0 - t)
