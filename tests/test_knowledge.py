"""What can be known of parameters and states, against observability matrices."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from examples import gpebo
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import one_state, shipped
from processes import assert_refused, printed, refused, rows_of, write_table
from random_systems import largest_error, random_system, run_system
from units import Units, in_units

from gpebo_cli import from_mechanics, from_netlist, run
from gpebo_cli.evidence.knowledge import knowledge
from gpebo_cli.experiment.assumptions import examine
from gpebo_cli.experiment.sensors import _fall, candidates
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.results import style
from gpebo_cli.results.figures import describe
from gpebo_cli.results.report import noise_table
from gpebo_cli.settings import DataSettings, Settings, TimeSettings


# The last ones: an A_0 that hides something or leaves no digits, columns that are rounding, and
# states that no parameter has part in.
@pytest.mark.parametrize("seed", [*range(20), 98, 123, 143, 158, 170, 1028, 1074, 1172, 1193])
def test_what_is_estimable_is_what_the_observability_matrix_says(seed):
    """Index 0 to 4, kernels that rotate; ``python -m tests.random_systems 200`` tries more."""
    plant, expected = random_system(seed)
    result = run_system(plant)
    assert {name: result.estimable[name] is not None for name in expected} == expected
    # What is not determined is not a number.
    told = dict(zip(plant["states"], result.estimation.states[0, -1], strict=True))
    if any(expected[name] for name in told):
        assert all(np.isnan(told[name]) != expected[name] for name in told)
    assert largest_error(result) < 1e-6


@pytest.mark.parametrize("settings", [{}, {"sample_time": 0.01, "hold": "linear"}])
@pytest.mark.parametrize(
    ("seed", "horizon", "told"), [(14, 3, 0), (14, 8, 0), (3029, 3, 0), (9, 3, 6)]
)
def test_states_that_are_rounding_of_a_grown_extension_are_not_told(seed, horizon, told, settings):
    """Φ of 4e7: 1e-6 of a direction that the data leave open is more than the whole state."""
    plant, _ = random_system(seed)
    result = run_system(plant, float(horizon), form="given", **settings)
    assert sum(result.estimable[name] is not None for name in plant["states"]) == told
    assert largest_error(result) < 1e-2  # lines between samples have an error of 3e-3


@settings(deadline=None, max_examples=30)
@given(st.floats(-5.2, -3.0), st.lists(st.floats(-6, 6), min_size=3, max_size=3),
       st.permutations(range(3)))
def test_of_columns_that_are_nearly_equal_one_is_estimated(small, sizes, order):
    """A, A + ε B and B: two of them suffice, but not the first two, which leave no digits."""
    psi = np.array([[1.0, 0.0], [1.0, 10.0**small], [0.0, 1.0]])[order] * 10.0 ** np.c_[sizes]
    found = knowledge((psi @ psi.T)[None], np.linalg.norm(psi, axis=1), np.ones(1))
    assert len(found.independent) == 2
    assert order.index(2) in found.independent


NEURON = {
    "name": "neuron", "states": ["V", "W"], "unknowns": {"a": 0.7, "gI": 1}, "outputs": ["v"],
    "E": [[1, 0], [0, 12.5]], "A": [["1 - v**2/3", -1], [1, -0.8]],
    "F": [[0, 0.5], [1, 0]], "C": [[1, 0]], "initial_state": [-1, 1],
}


@pytest.mark.parametrize("estimator", ["least_squares", "drem"])
def test_what_grows_hides_no_parameters_that_were_told_before(estimator):
    """FitzHugh and Nagumo's neuron: a, gI and e0_W stand for one another, and Φ grows to 1e7.

    V is measured. Where none but e0_V was estimated, for that was all that the Gram matrix still
    showed at the end, it was off by 1.
    """
    found = run(NEURON, estimator=estimator, time={"horizon": 60, "samples": 61})
    assert np.abs(found.errors["V"])[..., 10:].max() < 2e-3


def test_estimates_far_from_least_squares_are_told_at_samples():
    """The law stops learning, and Φ makes ten times V of 1e-4 of e0_V."""
    found = run(NEURON, estimator="exciting", time={"horizon": 20, "samples": 21},
                observer={"sample_time": 0.01})
    assert np.abs(found.errors["V"])[..., -1].max() > 5.0
    assert "V are up to" in "".join(found.details.warnings)


def test_an_unknown_without_effect_is_not_told_after_resets():
    """Its column of the Gram matrix is nothing, until a reset leaves rounding there."""
    plant = {
        "name": "idle", "states": ["x1", "x2"], "unknowns": {"k": 1.4, "idle": 1.2},
        "outputs": ["y"], "E": [[1, 0], [0, "2+sin(t)"]], "A": [[0.3, "1-t"], ["cos(t)", -0.7]],
        "F": [["cos(3*t)", 0], [0.3, 0]], "C": [[1.1, 0.7]], "initial_state": [1, -2],
    }
    result = run(plant, time={"horizon": 4, "samples": 11},
                 observer={"remedy": "reset", "reset_interval": 0.7}).details
    assert result.estimable["idle"] is None
    assert result.estimable["k"] is not None
    assert result.excitation.final.sizes[-1, 1] < 1e-90  # of the column of "idle"


def test_unknowns_that_only_their_sum_is_told_of_do_not_spoil_the_rest():
    """Recovery and death of an epidemic, and the recovered, whom nobody counts."""
    plant = {
        "name": "sird", "states": ["S", "I", "R"], "outputs": ["seen"],
        "unknowns": {"gamma": 0.2, "mu": 0.03}, "E": np.eye(3).tolist(),
        "A": [["-0.6*seen", 0, 0], ["0.6*seen", 0, 0], [0, 0, 0]],
        "F": [[0, 0], ["-seen", "-seen"], ["seen", 0]], "C": [[0, 1, 0]],
        "initial_state": [0.95, 0.05, 0],
    }
    for observer, tol in ({}, 1e-9), ({"sample_time": 0.05, "hold": "linear"}, 1e-5):
        result = run(plant, time={"horizon": 20}, observer={"name": "gpebo", **observer})
        told = result.details.estimable
        assert {name for name in told if told[name] is None} == {"gamma", "mu", "R", "e0_R"}
        assert all(np.abs(result.errors[name][0, -1]) < tol for name in ("S", "I"))


def test_units_of_parameters_do_not_matter():
    rng = np.random.default_rng(3)
    half = rng.normal(size=(40, 6, 4))
    half[..., 3] = half[..., 0] - 2.0 * half[..., 1]
    gain = rng.normal(size=(40, 5, 4))
    gain[:, 0] = [1.0, -2.0, 0.0, 0.0]
    G, terms = np.swapaxes(half, 1, 2) @ half, np.ones(4)
    gain[:, 1] = half[:, 0]
    units = 10.0 ** np.array([-6.0, 5.0, 0.0, 3.0])
    one = knowledge(G, terms, np.ones(40))
    other = knowledge(G * units[:, None] * units, terms * units, np.ones(40))
    np.testing.assert_allclose(one.smallest, other.smallest, atol=1e-14)
    np.testing.assert_array_equal(one.parameters, other.parameters)
    np.testing.assert_array_equal(one.states(gain), other.states(gain * units))
    np.testing.assert_array_equal(one.parameters, np.tile([False, False, True, False], (40, 1)))
    assert one.states(gain)[:, 1].all()
    assert not one.states(gain)[:, 2:].any()


@pytest.mark.parametrize(("kernel", "growth"), [(True, None), (True, 1e6), (False, 1e6)])
def test_what_is_left_of_a_state_has_no_unit_and_no_sign(kernel, growth):
    """Neither that of a state nor of a parameter; of a kernel's part too much must not be in it.

    In the kernel may stand ten times what is seen of η. Without growth a state is no smaller than
    a thousandth of its terms, whatever they add up to.
    """
    rng = np.random.default_rng(5)
    psi = rng.normal(size=(60, 4))
    if kernel:
        psi[:, 3] = 0.0
    eta = np.array([1.0, -2.0, 0.5, 3.0])
    G, h = (psi.T @ psi)[None], psi.T @ psi @ eta
    gain = rng.normal(size=(2, 80, 4))
    gain[..., 3] *= 10.0 ** rng.uniform(-8.0, 1.0, 80)
    offset = rng.normal(size=(2, 80))
    offset[:, ::2] = -gain[:, ::2] @ eta  # which leaves nothing, or little
    offset[:, ::2] += 10.0 ** rng.uniform(-9.0, 0.0, 40)
    known = knowledge(G, np.ones(4), np.ones(1))
    found = known.resolved(h, offset, gain, growth)
    z = np.linalg.pinv(G[0]) @ h
    hidden = 10.0 * np.linalg.norm(z * np.sqrt(np.diag(G[0]))) if kernel else 0.0
    sizes = known.sizes[-1]
    unseen = hidden * np.abs(gain[-1, :, 3]) / sizes[3]
    size = np.abs(offset + gain @ z).max(axis=0)
    if growth is None:
        size = np.maximum(size, 1e-3 * np.abs(gain[-1]) @ np.abs(z))
    error = known.doubt(h, gain[-1])[0]
    np.testing.assert_allclose(error, unseen, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(found, error <= 1e-3 * size)
    assert 0.1 < found.mean() < 0.97
    of_states = 10.0 ** rng.integers(-6, 6, 80) * rng.choice([-1.0, 1.0], 80)
    of_eta = 10.0 ** np.array([-5.0, 4.0, 0.0, 2.0]) * [1.0, -1.0, -1.0, 1.0]
    other = knowledge(G * of_eta * of_eta[:, None], np.abs(of_eta), np.ones(1))
    turned = gain * of_states[:, None] * of_eta
    np.testing.assert_array_equal(
        other.resolved(h * of_eta, offset * of_states, turned, growth), found
    )
    if growth:  # what grew may be all that is left, whatever is beside it
        units = np.where(np.arange(80) == 1, 1e-6, 1.0)
        np.testing.assert_array_equal(known.resolved(h, offset, gain, growth, units), found)


def test_a_state_that_nothing_is_known_of_is_not_told_by_parameters_that_are():
    known = knowledge(np.eye(2)[None], np.ones(2), np.ones(1))
    gain = np.array([[[1.0, 0.0], [np.nan, np.nan], [0.0, 0.0]]])
    assert known.states(gain).tolist() == [[True, False, True]]


def test_rounding_of_Y_is_larger_in_what_is_told_less():
    """G = [1 c; c 1] and η = (1, 1): (η_1 − η_2)/√2 is off by |Y|/√(1 − c) and its own terms."""
    shares, across = np.array([0.0, 0.5, 0.99]), np.array([[1.0, -1.0]]) / np.sqrt(2.0)
    found = [
        knowledge(G[None], np.ones(2), np.ones(1)).doubt(G @ np.ones(2), across)[0][0]
        for G in (np.array([[1.0, c], [c, 1.0]]) for c in shares)
    ]
    turned, sign = [], np.array([-1.0, 1.0])
    for G in (np.array([[1.0, -c], [-c, 1.0]]) for c in shares):
        known = knowledge(G[None], np.ones(2), np.ones(1))
        turned.append(known.doubt(G @ sign, across * sign)[0][0])
    np.testing.assert_allclose(turned, found, rtol=1e-9)
    expected = np.sqrt(2.0 * (1.0 + shares) / (1.0 - shares)) + np.sqrt(2.0)
    np.testing.assert_allclose(found / found[0], expected / expected[0], rtol=1e-9)
    alone = knowledge(np.eye(2)[None], np.ones(2), np.ones(1))
    assert alone.doubt(np.array([1.0, 0.0]), np.array([[0.0, 1.0]]))[0] == 0.0  # it meets no Y


CONF = Path(__file__).parents[1] / "conf"

HALF_SEEN = """
name: half_seen
title: one unknown and one state that the output does not see
states: [a, b, c]
inputs: {u: sin(t)}
unknowns: {k1: 2.0, k2: -1.5}
outputs: [y]
E: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
A: [[-1, 1, 0], [0, -0.5, 0], [0, 0, -2]]
B: [[1], [0], [1]]
F: [[1, 0], [0, 0], [0, 1]]
C: [[1, 0, 0]]
initial_state: {a: 1, b: 0.5, c: 2}
"""
WHOLE = yaml.safe_load(HALF_SEEN)
ALONE = {  # what the output sees of it
    **WHOLE, "states": ["a", "b"], "unknowns": {"k1": 2.0}, "E": [[1, 0], [0, 1]],
    "A": [[-1, 1], [0, -0.5]], "B": [[1], [0]], "F": [[1], [0]], "C": [[1, 0]],
    "initial_state": {"a": 1, "b": 0.5},
}
SEEN, UNSEEN = {"a", "b", "k1", "e0_a", "e0_b"}, {"c", "k2", "e0_c"}


@pytest.fixture
def half_seen(tmp_path):
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "half_seen.yaml").write_text(HALF_SEEN)
    return tmp_path


def test_a_run_goes_on_without_what_is_not_determined(half_seen):
    said = printed(gpebo("run", "--config-dir", ".", "plant=half_seen", "estimator=ls_drem",
                 "hydra.run.dir=out", cwd=half_seen))
    assert "not determined by the data: c, k2, e0_c" in said.splitlines()[-1]
    column = {line.split()[0]: line.split()[-1] for line in said.splitlines()[3:]}
    assert {name: column[name] for name in UNSEEN} == dict.fromkeys(UNSEEN, "no")
    assert all(column[name] == "s" for name in SEEN)  # from … s
    summary = json.loads((half_seen / "out" / "summary.json").read_text())
    assert {name for name, known in summary["estimable"].items() if known} == SEEN
    for name, told in summary["estimates"].items():
        if name in UNSEEN:
            assert told["value"] is None
        else:
            assert told["value"] == pytest.approx(told["true"], rel=1e-9)
    rows = rows_of(half_seen / "out" / "cases.csv")
    times = {name: rows[0][f"seconds_to_1pct_{name}"] for name in SEEN | UNSEEN}
    assert {name for name, time in times.items() if time} == SEEN


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.1}])
def test_what_is_seen_is_estimated_as_if_there_were_nothing_else(observer):
    """The same deviations as of a, b and k1 alone; a gain for each parameter is that of all."""
    noise = {"name": "gaussian", "outputs": 0.01, "sample_time": 0.1}
    given = {"observer": observer, "noise": noise, "time": {"horizon": 5.0, "samples": 51}}
    gains = dict.fromkeys(("k1", "k2", "e0_a", "e0_b", "e0_c"), 100.0)
    for of, one, other in (
        (("hat", "std"), run(WHOLE, estimator="ls_drem", **given),
         run(ALONE, estimator="ls_drem", **given)),
        (("hat",), *(run(plant, estimator="drem", gamma=1e6, **given) for plant in (WHOLE, ALONE))),
        (("hat",), run(WHOLE, estimator="gradient", gamma=gains, **given),
         run(WHOLE, estimator="gradient", gamma=100.0, **given)),
    ):
        mine, theirs = (result.to_pandas("estimates") for result in (one, other))
        names = [f"{name}_{kind}" for name in sorted(SEEN) for kind in of]
        np.testing.assert_allclose(mine[names], theirs[names], rtol=1e-6, atol=1e-9)


def test_statistics_over_seeds_are_those_of_the_parameters_that_are_seen():
    """As of a, b and k1 alone; of what is not determined there are none."""
    noise = {"name": "gaussian", "outputs": 0.01, "sample_time": 0.1, "seeds": 3}
    given = {"estimator": "ls_drem", "noise": noise, "time": {"horizon": 5.0, "samples": 51}}
    mine, theirs = (run(plant, **given).details.noise for plant in (WHOLE, ALONE))
    seen = [name in SEEN for name in mine.names]
    assert tuple(compress(mine.names, seen)) == theirs.names
    for name in ("truth", "bias", "deviation", "rms"):
        np.testing.assert_allclose(getattr(mine, name)[..., seen], getattr(theirs, name), rtol=1e-5)
    assert (mine.deviation[:, seen] > 0.0).all()
    for name in ("bias", "deviation", "rms"):
        assert np.isnan(getattr(mine, name)[:, ~np.array(seen)]).all()
    told = {row.split()[1]: row.split()[2:] for row in noise_table(mine)}
    assert {name for name in mine.names if told[name] == ["unknown"] * 3} == UNSEEN - {"c"}


def test_what_is_not_determined_is_dashed_in_the_figures():
    result = run(yaml.safe_load(HALF_SEEN)).details
    described = describe(result, ["estimates_a", "parameters"])
    panels = [panel for found in described.values() for panel in found]
    assert {panel.name for panel in panels} == SEEN | UNSEEN
    for panel in panels:
        drawn = {curve.label for curve in panel.curves if np.isfinite(curve.y).any()}
        dashed = any(curve.style is style.UNKNOWN for curve in panel.curves)
        assert dashed == (panel.name in UNSEEN)
        assert ("ls_drem" in drawn) == (panel.name in SEEN)


def test_check_tells_what_can_be_known_and_which_sensor_is_next(half_seen):
    words = ("check", "--config-dir", ".", "plant=half_seen", "sensors=all")
    done = gpebo(*words, cwd=half_seen)
    assert (done.returncode, done.stderr) == (1, "")
    all_known = ["c", str(len(SEEN | UNSEEN))]
    assert all_known in [line.split()[:2] for line in done.stdout.splitlines()]
    assert "k2    cannot be known" in done.stdout
    assert "k1    estimable from" in done.stdout
    content = json.loads(gpebo(*words, "--json", cwd=half_seen).stdout)
    assert {name for name, since in content["estimable"].items() if since is None} == UNSEEN
    told = {line.split()[0]: line for line in done.stdout.splitlines() if "deviation " in line}
    assert set(told) == set(content["deviations"]) == SEEN
    for name, value in content["deviations"].items():
        assert told[name].endswith(f" on, deviation {value:.3g} per unit of noise of the outputs")
    said = " ".join(done.stdout.split())
    for found in content["assumptions"]:
        holds = "holds" if found["holds"] else "FAILS"
        assert f" {holds} {found['name']} {found['statement']}" in said
        for key, value in found["evidence"].items():
            if value is not None:  # nothing, or a number that JSON does not have
                assert f"{key} {f'{value:.4g}' if isinstance(value, float) else value}" in said
    for sensor in content["sensors"]:
        state, count = sensor["state"], len(sensor["estimable"])
        gained = ", ".join(sensor["gained"]) or "nothing"
        falls = f"{sensor['fall']:.3g} {sensor['fall_together']:.3g}"
        assert f" {state} {count} {gained} {falls}" in said
    first = content["sensors"][0]
    assert first["state"] == "c"
    assert set(first["gained"]) == UNSEEN
    assert all(not sensor["gained"] for sensor in content["sensors"][1:])
    assert all(sensor["fall"] >= 1.0 for sensor in content["sensors"])


def test_deviations_fall_by_the_mean_of_what_both_know():
    """4 and, as no row takes information away, 1: √(4·1); of nothing that both know, 1."""
    before = {"a": 4.0, "b": 1.0, "c": 0.0}
    assert _fall(before, {"a": 1.0, "b": 2.0, "c": 1.0}) == pytest.approx(2.0)
    assert _fall(before, {"c": 1.0}) == 1.0


def test_what_sensors_are_worth_does_not_depend_on_units_of_states():
    """Of states that are known without any output there is nothing to fall."""
    plant = yaml.safe_load((CONF / "plant" / "circuit.yaml").read_text())
    observer = {"name": "gpebo", "form": "strangeness_free"}
    settings = Settings({"name": "ls_drem"}, TimeSettings(horizon=5.0), observer=observer)
    one, states = np.ones(6), 10.0 ** np.array([6, 0, -6, 6, 0, -6])
    other = in_units(plant, Units(states, one[:0], one[:1], one[:1], one, 1.0))
    falls = [
        {s.state: s.fall for s in candidates(settings, plant_from_mapping(each))}
        for each in (plant, other)
    ]
    assert falls[1] == pytest.approx(falls[0], rel=1e-4)


def test_a_sensor_of_a_state_that_is_zero_is_one_of_a_state_as_large_as_outputs():
    plant = one_state(states=["x", "z"], E=[[1, 0], [0, 1]], A=[[-1, 1], [0, -2]], C=[[1, 0]],
                      initial_state=[1, 0])
    both = plant | {"outputs": ["y", "w"], "C": [[1, 0], [0, 1]]}
    observer = {"name": "gpebo", "form": "strangeness_free"}
    settings = Settings({"name": "ls_drem"}, TimeSettings(horizon=3.0), observer=observer)
    alone, more = (examine(settings, plant_from_mapping(p)).deviations for p in (plant, both))
    (best, *_) = candidates(settings, plant_from_mapping(plant))
    falls = [np.log(alone[k] / more[k]) for k in alone]
    assert (best.state, best.fall) == ("z", pytest.approx(np.exp(np.mean(falls)), rel=1e-2))


def test_deviations_for_noise_of_one_are_by_the_rows_of_a_recording():
    """A constant that is measured 20 times, each row held up to the next one."""
    t = np.arange(21.0)
    data = DataSettings("csv", frame=pd.DataFrame({"t": t, "y": np.ones(21)}), hold="zoh")
    settings = Settings({"name": "drem"}, TimeSettings(-np.inf, np.inf, 11), data=data)
    found = examine(settings, plant_from_mapping(one_state())).deviations
    assert found["x"] == pytest.approx(1.0 / np.sqrt(20.0), rel=1e-3)


@pytest.mark.parametrize(("plant_name", "count"), [("descriptor", 3), ("circuit", 2)])
def test_the_next_sensors_make_deviations_fall_as_runs_with_them_say(plant_name, count):
    """By the covariance of a run with one more row of C; the best first, beside those above.

    Of weights of the further rows the best ones count, which are those of white noise.
    """
    plant = yaml.safe_load((CONF / "plant" / f"{plant_name}.yaml").read_text())
    observer = {"name": "gpebo", "form": "strangeness_free"}
    settings = Settings({"name": "ls_drem"}, TimeSettings(horizon=5.0), observer=observer)
    tried = candidates(settings, plant_from_mapping(plant))
    x = run(plant, observer="none", time={"horizon": 5})
    size = max(np.abs(x[name]).max() for name in plant["outputs"])

    def deviations(states, weight=1.0):
        rows = [[f"{size / np.abs(x[name]).max()}*{float(name == own)}" for own in plant["states"]]
                for name in states]
        larger = {**plant, "C": [*plant["C"], *rows],
                  "outputs": [*plant["outputs"], *(f"{name}_seen" for name in states)]}
        weights = dict.fromkeys(larger["outputs"][len(plant["outputs"]):], weight)
        own = replace(settings, observer={**observer, "weights": weights})
        return examine(own, plant_from_mapping(larger)).deviations

    alone = deviations([])
    for k, sensor in enumerate(tried[:count]):  # others tell nothing more of the circuit
        for states, fall in (
            ([sensor.state], sensor.fall), ([s.state for s in tried[: k + 1]], sensor.fall_together)
        ):
            ratios = [
                np.exp(np.mean([np.log(alone[k] / now[k]) for k in alone if alone[k] > 1e-12]))
                for now in (deviations(states, weight) for weight in (1.0, 100.0))
            ]
            assert fall == pytest.approx(max(ratios), rel=1e-2)
    assert len({s.state for s in tried}) == len(plant["states"])
    assert all(np.diff([s.fall_together for s in tried[:count]]) > 0.0)
    assert all(np.diff([s.log_det for s in tried[:count]]) > 0.0)


def test_a_state_that_is_known_without_outputs_has_no_part_in_how_deviations_fall():
    """w = u: of y = a once more all other deviations fall by √2, and w itself tells nothing."""
    plant = {
        "name": "given", "states": ["a", "w"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-1, 0], [0, 1]], "B": [[1], [-1]], "C": [[1, 0]],
        "initial_state": [1, 0],
    }
    found = candidates(Settings({}, TimeSettings(horizon=5.0)), plant_from_mapping(plant))
    assert [sensor.state for sensor in found] == ["a", "w"]
    falls = [(sensor.fall, sensor.fall_together) for sensor in found]
    np.testing.assert_allclose(falls, np.sqrt([[2.0, 2.0], [1.0, 2.0]]), rtol=1e-9)
    assert [sensor.gained for sensor in found] == [(), ()]
    twice = plant | {"states": ["a"], "inputs": {}, "outputs": ["y", "z"], "E": [[1]], "A": [[-1]],
                     "B": [], "C": [[1], [1]], "initial_state": [1]}
    (third,) = candidates(Settings({}, TimeSettings(horizon=5.0)), plant_from_mapping(twice))
    assert third.fall == pytest.approx(np.sqrt(1.5))
    for other in (Settings({}, observer={"name": "none"}), Settings({}, data=DataSettings("csv"))):
        with refused("sensors=all needs a simulation of a plant"):
            candidates(other, plant_from_mapping(plant))


def test_only_all_sensors_can_be_asked_for(half_seen):
    done = gpebo("check", "plant=circuit", "sensors=il", cwd=half_seen)
    assert_refused(done, "sensors=il: the only choice is sensors=all")


def recorded(folder, plant=None, noise=0.01):
    """The command's lines and summary for a recording of the plant, estimated with another one."""
    rng = np.random.default_rng(0)
    made = run(folder / "plant" / "half_seen.yaml", observer="none",
               time={"horizon": 20, "samples": 2001})
    y = made["y"] + noise * rng.normal(size=2001)
    write_table(folder / "r.csv", {"t": made.t, "u": made["u"], "y": y})
    done = gpebo("run", "--config-dir", ".", "plant=half_seen", "data=csv", "data.file=r.csv",
                 "estimator=ls_drem", "hydra.run.dir=out", *(plant or []), cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), json.loads((folder / "out" / "summary.json").read_text())


def test_a_recording_gives_numbers_with_deviations_and_says_what_is_left(half_seen):
    lines, summary = recorded(half_seen)
    k1 = summary["estimates"]["k1"]
    assert abs(k1["value"] - 2.0) < 4 * k1["std"] < 0.004
    assert summary["estimates"]["k2"] == {"value": None, "std": None, "unit": None, "true": None}
    assert any("k1" in line and "1.999" in line and "s" in line for line in lines)
    assert any("k2" in line and "not determined" in line for line in lines)
    assert "up to white noise" in lines[-1]
    figures = {path.stem for path in (half_seen / "out/figures").iterdir()}
    assert {"fit", "parameters", "whiteness"} <= figures


def test_a_wrong_plant_is_noticed(half_seen):
    lines, summary = recorded(half_seen, ["plant.A=[[-1.05,1,0],[0,-0.6,0],[0,0,-2]]"])
    assert summary["fit"]["white"] is False
    assert "the residual is not white" in lines[-1]


@pytest.mark.parametrize("plant", ["battery", "bioreactor", "boost", "descriptor", "window"])
def test_a_run_without_any_choice_converges_where_psi_is_exciting(plant):
    """Also where parameters of very different size are hardly told apart, as in the bioreactor."""
    result = run(plant).details
    assert result.excitation.is_ie
    assert np.isfinite(result.metrics.seconds_to_1pct_parameters).all()


@pytest.mark.parametrize("estimator", ["ls_drem", "least_squares", "gradient"])
def test_where_nothing_can_be_known_what_is_required_is_not_met(estimator):
    """y = u: the state and the unknown have no part in it."""
    plant = one_state(inputs={"u": "sin(t)"}, unknowns={"k": 1}, A=[[-1]], B=[[1]], F=[[1]],
                      C=[[0]], D=[[1]])
    said = run(plant, estimator=estimator, time={"horizon": 2.0, "samples": 5}).verdict
    assert "not determined by the data: x, k, e0_x; " in said
    assert " not met: " in said


def test_check_tells_the_deviation_that_a_run_with_noise_has():
    """Per unit of noise: times σ it is that of least squares in a run."""
    settings = Settings({"name": "least_squares", "f0": 1e-12})
    examined = examine(settings, shipped("descriptor"))
    assert set(examined.deviations) == {n for n, at in examined.estimable.items() if at is not None}
    result = run("descriptor", estimator={"name": "least_squares", "f0": 1e-12},
                 noise={"name": "gaussian", "outputs": 0.02}).details.estimation
    names = [*shipped("descriptor").states, *result.names]
    stds = np.concatenate([result.states_std[0, -1], result.parameters_std[0, -1]])
    for name, std in zip(names, stds, strict=True):
        assert 0.02 * examined.deviations[name] == pytest.approx(std, rel=1e-3)


def test_a_parameter_that_another_can_stand_for_does_not_look_like_a_wrong_model():
    """Of a + b only the sum is known; the fit of the recording has it, and says so."""
    plant = one_state(
        inputs={"u": "sin(t)"}, unknowns={"a": 0.5, "b": 0.3}, A=[[-1]], B=[[1]], F=[[1, 1]]
    )
    truth = run(plant, observer="none")
    data = {"t": truth.t, "u": truth["u"], "y": truth["y"]}
    result = run(plant, data=data, noise={"name": "gaussian", "outputs": 0.01})
    assert np.isnan([result.parameters["a"], result.parameters["b"]]).all()
    fit = result.details.fit
    assert fit.residual[0] < 1e-3 * fit.size
    assert "missing or wrong parameter" not in result.verdict


def test_a_position_that_a_constraint_holds_is_known_whatever_is_measured():
    """All that is there of it is rounding; another constraint has it in it, too."""
    names = ["left", "still", "right", "far", "on"]
    mechanism = from_mechanics({
        "M": np.diag([1.7, 0.33, 1.1, 2.5, 1.9]), "K": np.diag([12.3, 16.1, 8, 0.83, 11.5]),
        "G": [[0, 0.82, 0, 0, 0], [-0.39, 0.8, -0.61, 0, 0]], "unknowns": {"a": 1.5, "b": 0.5},
        "F": [[0.94, -1.06], [1.11, -0.62], [-1.01, 0.94], [-0.22, -0.39], [0.46, -0.1]],
        "positions": names, "measure": ["v_far"],
    }, "held")
    found = run(mechanism.mapping(), time={"horizon": 4, "samples": 21}).details.estimable
    assert {name for name in names if found[name] is not None} == {"still"}
    assert found["v_still"] == 0.0


@pytest.mark.parametrize("observer", [
    {"form": "given"}, {"form": "strangeness_free"}, {"sample_time": 0.05},
])
def test_what_has_decayed_and_is_determined_stays_so(observer):
    """Of v = x' a known combination of the unknown ones is left, a difference of large terms."""
    mapping = {
        "name": "settling", "states": ["x", "v", "z"], "outputs": ["y"], "unknowns": {"load": 1.0},
        "E": np.diag([1.0, 0, 1]), "A": [[0, 1, 0], [-6, -1, 0], [0, 1, -1]],
        "F": [[0], [0.3], [0]], "C": [[0, 0, 1]], "initial_state": [1, 0, 0.3],
    }
    for horizon in (2, 3.5, 4.25, 5, 8):
        result = run(mapping, observer=observer, time={"horizon": horizon, "samples": 21})
        found = result.details.estimable
        assert found["x"] is None
        assert 0.0 < found["v"] <= horizon / 20 + 0.05 + 1e-9
        assert abs(result.errors["v"][0, -1]) < 1e-9


def test_a_voltage_that_is_given_tells_nothing_of_what_it_drives():
    """Columns of psi are zero, and one of them is made of nothing at all."""
    circuit = from_netlist(
        "two parts\nV1 a 0 0.47\nR2 b a 0.6\nR3 c b 1.15\nR4 d 0 356\nR5 b 0 0.5\nR6 c 0 0.53\n"
        "C7 c 0 0.58\nC8 d 0 0.96\n", measure="v(a)",
    )
    found = run(circuit.mapping(), time={"horizon": 4, "samples": 11}).details.estimable
    assert [name for name, since in found.items() if since is not None] == ["a"]


@pytest.mark.parametrize("names", ["abc", "cab", "bca", "cba"])
def test_a_part_at_rest_that_is_measured_is_known_whatever_it_is_called(names):
    """Its voltages and current are rounding, and of the other part less is known."""
    near, far, other = names
    circuit = from_netlist(
        f"two parts\nC1 {near} 0 1.33\nR1 {near} 0 1.06\nL1 {near} {far} 0.23\nC2 {far} 0 1.3\n"
        f"R2 {far} 0 0.35\nV1 s 0 1.05\nR3 {other} s 0.41\nC3 {other} 0 1\nI1 d s -0.33\n"
        f"R4 d {other} 1.36\nV2 {other} d 0.45\n", measure=f"v({near}), i(R4)", unknown="I1,V2",
    )
    found = run(circuit.mapping(), time={"horizon": 3, "samples": 11}).details.estimable
    assert (found[near], found[far], found["il1"], found[other]) == (0.3, 0.3, 0.3, None)


@pytest.mark.parametrize("seed", range(5))
def test_a_state_that_no_parameter_has_part_in_is_no_doubt_in_any_unit(seed):
    """Beside a kernel of G that leaves the others open, and zero as it is."""
    rng = np.random.default_rng(seed)
    psi, units = rng.normal(size=(9, 3)), 10.0 ** rng.uniform(-6, 6, 4)
    psi[:, 2] = psi[:, 1]
    gain = units[:, None] * rng.normal(size=(5, 4, 3))
    gain[:, 1] *= 1e-17
    offset = np.zeros((5, 4))
    known = knowledge((psi.T @ psi)[None], np.ones(3), np.ones(1))
    h = psi.T @ psi @ rng.normal(size=3)
    told = known.states(gain, units)[-1] & known.resolved(h, offset, gain, 1.0, units)
    assert told.tolist() == [False, True, False, False]


@pytest.mark.parametrize("rate", [0.5, -0.5])
def test_what_is_not_determined_at_the_end_is_told_and_nothing_else(rate):
    """Of a + b only the sum is known; where Φ grows, what was known before counts as well."""
    plant = one_state(unknowns={"a": 0.5, "b": 0.3}, A=[[rate]], F=[[1, 1]])
    result = run(plant, time={"horizon": 8.0})
    assert "; not determined by the data: a, b; state error" in result.verdict
    assert np.isnan([result.estimates["a"], result.estimates["b"]]).all()
    assert np.isfinite([result.estimates["e0_x"], result.estimates["x"]]).all()


def test_a_state_that_the_observer_leaves_out_is_not_called_estimable():
    result = run("canonical", observer="canonical", time={"horizon": 5})
    assert np.isnan(result.estimates["zb3"]).all()
    assert result.details.estimable["zb3"] is None
    assert result.details.estimable["zb2"] is not None
    assert "left out by the observer: zb3" in result.verdict
    assert "not determined" not in result.verdict
