"""`regression=NAME`: the same commands and files as for a plant, without states."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import yaml
from examples import assert_repeats, gpebo
from plants import one_state
from processes import assert_refused, printed, refused, rows_of, write_table

from gpebo_cli import ConfigError, SolverError, check, run
from gpebo_cli.observers.regression import Given
from gpebo_cli.regression.text import regression_from_mapping
from gpebo_cli.settings import SolverSettings

SINE = {"name": "sine", "unknowns": {"a": 2.0, "b": -1.0}, "signals": {"s": "sin(t)"}}


def write(folder, mapping):
    (folder / "regression").mkdir(exist_ok=True)
    (folder / "regression" / f"{mapping['name']}.yaml").write_text(yaml.safe_dump(mapping))


def test_a_run_leaves_the_same_files_and_can_be_repeated(tmp_path):
    done = gpebo("run", "regression=filtered", "estimator=ls_drem", "hydra.run.dir=a", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("error")) == (0, 0)
    assert "interval-exciting" in done.stdout
    names = {path.name for path in (tmp_path / "a").iterdir()}
    assert {"signals.csv", "regression.csv", "estimates.csv", "cases.csv"} <= names
    last = rows_of(tmp_path / "a" / "estimates.csv")[-1]
    assert float(last["a_hat"]) == pytest.approx(2.0, abs=1e-9)
    assert float(last["b_hat"]) == pytest.approx(1.5, abs=1e-9)
    assert_repeats(tmp_path / "a", "estimates.csv")
    assert gpebo("check", "regression=filtered", cwd=tmp_path).returncode == 0


def test_it_stands_in_place_of_a_plant_and_an_observer(tmp_path):
    for word in ("plant=circuit", "observer=gpebo"):
        done = gpebo("run", "regression=filtered", word, cwd=tmp_path)
        assert_refused(done, f"{word}: regression=NAME stands in place of")
    done = gpebo("run", "regression=filtered", "regression.S=[a]", cwd=tmp_path)
    assert_refused(done, "regression.S: no such key", "'+regression.S=VALUE' adds it")
    done = gpebo("run", "plant=circuit", "regression.Y=1", cwd=tmp_path)
    assert_refused(done, "regression.Y: no regression is chosen; regression=NAME does")
    assert "adds it" not in gpebo("run", "plant.S=1", cwd=tmp_path).stderr  # a plant has no such
    done = gpebo("run", "observer=regression", cwd=tmp_path)
    assert_refused(done, "observer=regression goes with regression=NAME")
    with refused("regression sine goes with observer=regression"):  # a recipe may ask for another
        run({**SINE, "psi": [["s", 1]]}, observer="gpebo")


def test_signals_from_a_recording(tmp_path):
    t = np.linspace(0.0, 10.0, 2001)
    write(tmp_path, {**SINE, "signals": {"s": None, "y": None}, "Y": ["y"], "psi": [["s", 1]]})
    write_table(tmp_path / "r.csv", {"t": t, "s": np.sin(t), "y": 2 * np.sin(t) - 1})
    printed(gpebo("run", "--config-dir", ".", "regression=sine", "data.file=r.csv", "figures=none",
                 "estimator=ls_drem", "hydra.run.dir=a", cwd=tmp_path))
    last = rows_of(tmp_path / "a" / "estimates.csv")[-1]
    assert float(last["a_hat"]) == pytest.approx(2.0, abs=1e-9)


def test_noise_of_y_is_that_of_an_output():
    mapping = {**SINE, "psi": [["s", 1]]}
    noise = {"name": "gaussian", "outputs": 0.1, "sample_time": 0.05}
    quiet, noisy = (
        run(regression=mapping, estimator="least_squares", time={"horizon": 10}, noise=noise_)
        for noise_ in (None, noise)
    )
    assert quiet.estimates["a"][0, -1] == pytest.approx(2.0, abs=1e-3)
    assert 1e-4 < abs(noisy.estimates["a"][0, -1] - 2.0) < 0.2
    told = quiet.details.simulation  # there are no equations
    assert (told.index, told.strangeness_index, told.differential, told.algebraic) == (0, 0, 0, 0)


def test_mistakes_name_the_file(tmp_path):
    write(tmp_path, {**SINE, "psi": [["s", "lp(s)"]]})
    done = gpebo("run", "--config-dir", ".", "regression=sine", cwd=tmp_path)
    parts = "regression sine (regression/sine.yaml): ", "psi[0][1]", "lp takes two arguments"
    assert_refused(done, *parts)
    beside = {"plant": "circuit"}, {"observer": "gpebo"}, {"observer": {"name": "gpebo"}}
    for given in beside:
        with pytest.raises(ConfigError, match="stands in place of a plant and an observer"):
            run(regression=SINE, **given)


OPERATORS = {
    "name": "operators",
    "unknowns": {"a": 2.0, "b": -1.0, "c": 0.5, "k": 1.5},
    "signals": {"s": "sin(3*t) + 0.5*cos(t)"},
    "psi": [["lp(s, 2)", "hp(s, 0.7)", "integral(s*s)", "delay(lp(s, 1), 0.35)"]],
}


def test_at_samples_all_signals_have_one_hold():
    with pytest.raises(ConfigError, match="takes one word for all signals"):
        Given().at_samples(
            regression_from_mapping(OPERATORS).system, SolverSettings(), ("zoh", "linear"), 0.0,
            np.zeros(2), None,
        )


@pytest.mark.parametrize(("hold", "order"), [("zoh", 1), ("linear", 2)])
def test_at_samples_operators_are_those_of_the_held_signals(hold, order):
    exact = run(regression=OPERATORS, estimator="least_squares", time={"horizon": 6})
    error = []
    for step in (0.05, 0.025, 0.0125):
        found = run(
            regression=OPERATORS, estimator="least_squares", time={"horizon": 6},
            observer={"sample_time": step, "hold": hold},
        )
        r, true = found.details.regression, exact.details.regression
        psi = np.array([np.interp(r.t, true.t, true.psi[:, 0, j]) for j in range(4)])
        error.append(np.abs(r.psi[:, 0] - psi.T)[-1].max())
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.35)
    assert np.log2(error[1] / error[2]) == pytest.approx(order, abs=0.35)


def test_one_unknown_is_found_at_samples():
    given = {**SINE, "unknowns": {"a": 2.0}, "psi": [["s"]]}
    found = run(
        regression=given, estimator={"name": "least_squares", "f0": 1e-12}, time={"horizon": 2},
        observer={"sample_time": 0.1}, noise={"name": "gaussian", "outputs": 1e-6},
    )
    assert found.estimates["a"][0, -1] == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_samples_may_come_in_any_pieces(hold):
    text = regression_from_mapping({**OPERATORS, "signals": {"s": None}})
    t = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.1, 80))
    s = (-np.exp(-t) * np.sin(3 * t))[:, None]
    Y = np.cos(t)[:, None]
    _, whole = text.advance(hold, None, t, s, Y)
    state = None
    for part in (slice(0, 1), slice(1, 2), slice(2, 30), slice(30, 31), slice(31, 80)):
        state, piece = text.advance(hold, state, t[part], s[part], Y[part])
        rows = whole.rows[part.start : part.stop + 1]
        np.testing.assert_allclose(piece.rows, rows, rtol=1e-12, atol=1e-14)
        largest = np.maximum.accumulate(np.abs(whole.rows[1:, :, :-1]).max(axis=1))
        assert (whole.scale >= (1.0 - 1e-12) * largest).all()
        for name in ("scale", "steps", "t"):
            expected = getattr(whole, name)[part]
            np.testing.assert_allclose(getattr(piece, name), expected, rtol=1e-12)


def test_a_stream_is_the_file_at_its_samples(tmp_path):
    t = 0.02 * np.arange(400)
    given = {**OPERATORS, "signals": {"s": None, "y": None}, "unknowns": {"a": 2.0, "b": -1.0},
             "Y": ["2*lp(y, 1) - lp(s, 2)"], "psi": [["lp(y, 1)", "lp(s, 2)"]]}
    write(tmp_path, given)
    write_table(tmp_path / "r.csv", {"t": t, "s": np.sin(3 * t), "y": np.cos(t)})
    done = gpebo(
        "run", "--config-dir", ".", "regression=operators", "data.file=-", "data.hold=linear",
        "estimator=least_squares", cwd=tmp_path, text=(tmp_path / "r.csv").read_text(),
    )
    assert done.returncode == 0, done.stderr
    last = list(csv.DictReader(done.stdout.splitlines()))[-1]
    assert float(last["a_hat"]) == pytest.approx(2.0, abs=1e-4)
    assert float(last["b_hat"]) == pytest.approx(-1.0, abs=1e-4)
    assert "400 rows" in done.stderr


@pytest.mark.parametrize("psi", [[["s", 1]], [["s", 1], [1, "s"]]])
def test_deviations_of_known_noise_of_y_are_those_of_many_seeds(psi):
    noise = {"name": "gaussian", "outputs": 0.1, "sample_time": 0.05, "seeds": 400}
    given = {"regression": {**SINE, "psi": psi}, "estimator": "least_squares",
             "time": {"horizon": 10}}
    found = run(**given, noise=noise).details
    stated = found.estimation.parameters_std[0, -1]
    np.testing.assert_allclose(found.noise.deviation[0], stated, rtol=0.12)
    at_samples = run(**given, noise={**noise, "seeds": 1}, observer={"sample_time": 0.05}).details
    np.testing.assert_allclose(at_samples.estimation.parameters_std[0, -1], stated, rtol=0.02)


@pytest.mark.parametrize(("inputs", "stated"), [({}, True), ({"v": 0.1}, False)])
def test_noise_of_a_signal_in_psi_has_no_deviation_to_state(inputs, stated):
    given = {**SINE, "signals": {"s": "sin(t)", "v": "cos(3*t)"}, "psi": [["s", "v"]]}
    found = run(regression=given, estimator="least_squares", time={"horizon": 5},
                noise={"name": "gaussian", "outputs": 0.1, "inputs": inputs})
    assert (found.details.estimation.parameters_std is not None) == stated


@pytest.mark.parametrize("observer", [None, {"sample_time": 0.1}])
def test_why_there_is_no_deviation_knows_of_no_matrices(observer):
    """observer.remedy, which takes noise out of a plant's matrices, is no key of a regression."""
    t = np.linspace(0.0, 5.0, 51)
    given = {**SINE, "signals": {"s": None, "y": None}, "Y": ["lp(y, 3)"]}
    given["psi"] = [["lp(s, 3)", "lp(1, 3)"]]
    data = {"t": t, "s": np.sin(t), "y": 2 * np.sin(t) - 1}
    verdict = run(regression=given, data=data, observer=observer).verdict
    assert "no standard deviations: noise of the signals is in ψ" in verdict
    assert "remedy" not in verdict


def test_squares_that_are_no_numbers_are_refused():
    large = {"name": "large", "unknowns": {"a": 1.0}, "psi": [["1e160*cos(t)"]]}
    with pytest.raises(SolverError, match=r"ψᵀψ is too large for a number near t = 0; write Y and"):
        run(regression=large, estimator="least_squares", time={"horizon": 2, "samples": 5})


def test_arrays_by_name_and_what_can_be_checked(tmp_path):
    t = np.linspace(0.0, 10.0, 1001)
    measured = {**SINE, "signals": {"s": None, "y": None}, "Y": ["y"], "psi": [["s", 1]]}
    arrays = {"t": t, "s": np.sin(t), "y": 2 * np.sin(t) - 1}
    found = run(regression=measured, data=arrays, estimator="ls_drem")
    assert found.estimates["a"][0, -1] == pytest.approx(2.0, abs=1e-9)
    assert all(a.holds for a in check(regression=measured, data=arrays))
    constant = {**SINE, "signals": {"s": "1"}, "psi": [["s", 1]]}
    assert [a.name for a in check(regression=constant) if not a.holds] == ["Assumption 2"]
    files = [write_table(tmp_path / f"{k}.csv", arrays) for k in range(2)]
    both = run(regression=measured, data=files, estimator="least_squares", f0=None)
    assert both.parameters["a"] == pytest.approx(2.0, abs=1e-9)
    with pytest.raises(ConfigError, match="a regression stands in place of a plant and an observ"):
        run(regression=measured, data=arrays, observer="gpebo")
    with pytest.raises(ConfigError, match=r"s is null, a column of a recording; give data\.file"):
        run(regression=measured)
    with pytest.raises(ConfigError, match=r"t \(1001,\), s \(1001,\), y \(7,\)"):
        run(regression=measured, data={**arrays, "y": np.zeros(7)})
    made = {**measured, "Y": ["lp(y, 9)"], "psi": [["lp(s, 9)", "lp(1, 9)"]]}
    with pytest.raises(ConfigError, match="has no outputs; noise of the signals is noise"):
        run(regression=made, data=arrays, noise={"name": "gaussian", "outputs": 0.1})
    run(regression=made, data=arrays, noise={"name": "gaussian", "inputs": {"y": 0.1}})


@pytest.mark.parametrize(("wrong", "name"), [(0.0, "Y_1"), (0.2, "Y_1"), (0.0, "y")])
def test_a_measured_Y_is_compared_with_the_fitted_one(wrong, name):
    """Y left out, or a recorded signal that stands nowhere else."""
    t, level = np.linspace(0.0, 20.0, 801), 0.05
    noise = level * np.random.default_rng(5).standard_normal(len(t))
    given = {**SINE, "signals": {"s": None}, "psi": [["s", 1]]}
    if name == "y":
        given |= {"signals": {"s": None, "y": None}, "Y": ["y"]}
    data = {"t": t, "s": np.sin(t), name: 2 * np.sin(t) - 1 + wrong * np.sin(3 * t) + noise}
    found = run(regression=given, data=data, estimator="least_squares",
                noise={"name": "gaussian", "outputs": level, "sample_time": t[1]})
    fit = found.details.fit
    fitted = np.interp(found.t, t, 2 * np.sin(t) - 1)[:, None]
    np.testing.assert_allclose(fit.outputs, fitted, atol=4 * level / np.sqrt(len(t) / 3))
    assert fit.white is (wrong == 0.0)
    assert ("explain the data up to white noise" in found.verdict) is (wrong == 0.0)
    assert "fit" in found.figures
    if not wrong:
        assert fit.ratio == pytest.approx(1.0, abs=0.1)
        std = level * np.sqrt(t[1] / 10.0)  # ∫ sin² is 10 to a few percent
        assert found.to_pandas("estimates")["a_std"].iloc[-1] == pytest.approx(std, rel=0.1)


@pytest.mark.parametrize(("estimator", "rate"), [
    *((name, 700) for name in (
        "drem", "annihilator", "instrumental", "power", "least_squares", "ls_drem",
    )),
    ("drem", 250), ("power", 250),
])
def test_squares_that_no_number_holds_are_refused_with_their_time(estimator, rate):
    """ψ ends at e^700, which is a number, and its square is none; from e^250 on that of Δ is."""
    given = {
        "name": "huge", "unknowns": {"a": 1.5}, "signals": {"u": "sin(t)"}, "Y": [0, "u"],
        "psi": [[f"exp({rate}*t)"], [0]],
    }
    with pytest.raises(SolverError, match=r"is too large for a number near t = 0\.\d+; write"):
        run(regression=given, estimator=estimator, time={"horizon": 1, "samples": 11})


@pytest.mark.parametrize("psi", [
    "p", "exp(-((q - 3.3127)/1e-4)**2)", "delay(p, 2)", "hp(p, 3)", "abs(sin(t) - 0.3)*p",
])
def test_a_narrow_pulse_is_seen_wherever_it_stands(psi):
    given = {
        "name": "pulse", "signals": {"p": "exp(-((t - 3.3127)/1e-4)**2)", "q": "t"},
        "psi": [[1, psi]], "unknowns": {"a": 1, "b": 2},
    }
    found = run(regression=given, estimator={"name": "least_squares", "f0": 1e-12},
                time={"horizon": 10})
    assert found.details.excitation.is_ie
    assert found.estimates["b"].ravel()[-1] == pytest.approx(2.0, rel=1e-4)


def test_a_start_beyond_all_numbers_is_refused_in_one_line():
    content = one_state(
        inputs={"u": "sin(t)"}, unknowns={"th": 1.5}, outputs=["y", "z"], A=[[1]], B=[[16]],
        F=[[2.5]], C=[[1e-300], [1]],
    )
    with pytest.raises(SolverError, match="beyond all numbers at t = 0"):
        run(content, solver="ivp", time={"horizon": 1, "samples": 11})


def test_terms_that_filters_have_of_the_past_are_unknowns_of_their_own():
    """Two sines behind four filters of rate 5; and the same mixed by hand with a delay."""
    past = [f"t**{k}*exp(-5*t)" for k in range(4)]
    chains = ("hhhh", "hhll", "llll")
    Y, a, b = ("".join(f"{op}p(" for op in ops) + "y" + ", 5)" * 4 for ops in chains)
    common = {"name": "two", "signals": {"y": "1.2*sin(2*t + pi/3) + 2*sin(3*t + pi/4)"}}
    made = run(regression={
        **common, "unknowns": {"th1": 13, "th2": 36, **{f"c{k}": 0 for k in range(4)}},
        "Y": [Y], "psi": [[f"-{a}", f"-{b}", *past]],
    }, time={"horizon": 4})
    found = [made.estimates[name][0, -1] for name in ("th1", "th2")]
    assert found == pytest.approx([13, 36], rel=1e-9)
    Y_d, a_d, b_d = (f"delay({text}, 0.3)" for text in (Y, a, b))
    delta = f"{a}*{b_d} - {b}*{a_d}"
    made = run(regression={
        **common, "unknowns": {"th1": 13, "th2": 36},
        "Y": [f"{b}*{Y_d} - {b_d}*{Y}", f"{a_d}*{Y} - {a}*{Y_d}"],
        "psi": [[delta, 0], [0, delta]],
    }, estimator={"name": "gradient", "gamma": 10}, time={"horizon": 7})
    found = [made.estimates[name][0, -1] for name in ("th1", "th2")]
    assert found == pytest.approx([13, 36], rel=1e-8)
