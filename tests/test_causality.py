"""An observer is causal: the same run to a longer horizon has the same past."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_systems import random_system
from test_observer import ROTATING

from gpebo_cli import run

WAYS = {
    "as it comes": {},
    "at samples": {"sample_time": 0.05, "hold": "linear"},
    "reset": {"remedy": "reset", "reset_interval": 0.4},
    "current coordinates": {"remedy": "current_coordinates"},
    "strangeness-free": {"form": "strangeness_free"},
}
STEP = 0.05


def run_to(plant, count, **settings):
    """A run of so many output steps, with least squares."""
    return run(plant, time={"horizon": count * STEP, "samples": count + 1},
               estimator={"name": "least_squares", "f0": 1e-4}, **settings).details


def assert_same_past(one, other, tol=1e-8, of_estimates=None):
    """Signals, Y and ψ; and estimates to the digits that little data leave.

    At its end a run knows the limit from the left alone of what jumps there.
    """
    def same(a, b, tol):
        a = a[:-1]
        size = np.abs(a).max(axis=0, initial=0.0)
        assert (np.abs(b[: len(a)] - a) <= tol * np.where(size > 1e-9, size, 1.0)).all()

    for name in ("Y", "psi"):
        same(getattr(one.regression, name), getattr(other.regression, name), tol)
    same(one.signals.outputs, other.signals.outputs, tol)
    if one.simulation is not None:
        same(one.simulation.states, other.simulation.states, tol)
    for name in ("parameters", "states"):
        a, b = (getattr(found.estimation, name)[0] for found in (one, other))
        told = ~(np.isnan(a) | np.isnan(b[: len(a)]))  # what is determined is so at the end
        if name == "parameters":
            left_out = [~np.nan_to_num(eta).any(axis=0) for eta in (a, b)]  # nothing moves them
            if left_out[0].sum() != left_out[1].sum():
                break  # more of those that stand for one another can be told apart later
            assert (left_out[0] == left_out[1]).all()
            if not told[-1].all():
                break
        same(np.where(told, a, 0.0), np.where(told, b[: len(a)], 0.0), of_estimates or 1e3 * tol)


@pytest.mark.parametrize("seed", [79, 146])
def test_of_parameters_that_stand_for_one_another(seed):
    """Which of them are estimated is decided as soon as data tell how many, not by rounding."""
    plant, observer = random_system(seed)[0], {"name": "gpebo", "form": "strangeness_free"}
    assert_same_past(*(run_to(plant, 10 * k, observer=observer) for k in (1, 3)))


@settings(deadline=None, max_examples=3)
@given(st.integers(0, 99), st.integers(2, 4), st.sampled_from([{}, WAYS["at samples"]]))
def test_of_any_plant(seed, times, way):
    """Index 0 to 4; which form of the equations tells more depends on how long one looks."""
    observer = {"name": "gpebo", "form": "strangeness_free", **way}
    plant = random_system(seed)[0]
    assert_same_past(*(run_to(plant, 10 * k, observer=observer) for k in (1, times)))


@pytest.mark.parametrize("plant", ["circuit", "descriptor", "bioreactor"])  # the last: along y
@pytest.mark.parametrize("way", WAYS)
def test_of_shipped_plants(plant, way):
    observer = {"name": "gpebo", **WAYS[way]}
    one, other = (run_to(plant, count, observer=observer) for count in (20, 50))
    # The first reset starts from estimates of which few digits are known.
    assert_same_past(one, other, 1e-6 if way == "reset" else 1e-8)


@pytest.mark.parametrize("remedy", ["current_coordinates", "output_injection"])
@pytest.mark.parametrize("plant", ["circuit", "canonical", "descriptor", "duffing", ROTATING])
def test_of_what_remedies_choose(remedy, plant):
    """The forgetting of filters and the injection follow from what was until then."""
    one, other = (
        run_to(plant, count, observer={"name": "gpebo", "remedy": remedy}) for count in (40, 80)
    )
    # Of the descriptor plant five digits of a double are lost in what is known.
    assert_same_past(one, other, 1e-10, 1e-8)


@pytest.mark.parametrize("name", [
    "gradient", "drem", "lion", "ls_drem", "fct", "mre", "power", "exciting", "instrumental",
    "annihilator",
])
def test_of_any_estimator(name):
    one, other = (
        run("circuit", estimator={"name": name, "gamma": 1e3},
            time={"horizon": count * STEP, "samples": count + 1}).details.estimation
        for count in (40, 80)
    )
    for a, b in ((one.parameters, other.parameters), (one.states, other.states)):
        np.testing.assert_allclose(b[:, :40], a[:, :40], atol=1e-9)


@pytest.mark.parametrize("plant", ["circuit", "descriptor", "window"])
def test_of_the_kalman_bucy_filter(plant):
    """Without noise, where measurements are exact, and what regularises them is its own."""
    one, other = (run_to(plant, count, observer="kalman_bucy") for count in (20, 64))
    assert_same_past(one, other)


@pytest.mark.parametrize("name", ["ls_drem", "least_squares"])
@pytest.mark.parametrize("plant", ["circuit", "boost", "descriptor", "window", 2, 4])
def test_of_the_defaults(plant, name):
    """No gain is given, and none is taken from what comes later."""
    plant = random_system(plant)[0] if isinstance(plant, int) else plant
    one, other = (
        run(plant, estimator=name, time={"horizon": count * STEP, "samples": count + 1}).details
        for count in (20, 40)
    )
    since = [other.estimable[state] for state in other.system.states]
    known = one.estimation.t[:-1, None] >= np.array([np.inf if s is None else s for s in since])
    a, b = one.estimation.states[0, :-1], other.estimation.states[0, :20]
    away = np.where(known, np.abs(b - a) / np.nanmax(np.abs(b), axis=0), 0.0)
    assert away.max() < 1e-8


def test_with_bounds():
    observer = {"name": "gpebo", "bounds": {"states": {"x1": [-0.5, 0.9]}}}
    one, other = (run_to("descriptor", count, observer=observer) for count in (20, 50))
    assert_same_past(one, other)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
@pytest.mark.parametrize("way", ["as it comes", "at samples"])
def test_of_a_recording(hold, way):
    t = np.linspace(0.0, 3.0, 61)
    rows = pd.DataFrame({"t": t, "V": np.sin(t), "y": np.cos(3 * t) - t})
    observer = {"name": "gpebo", **WAYS[way]} if way == "as it comes" else {
        "name": "gpebo", "sample_time": 0.05, "hold": hold}
    assert_same_past(*(
        run_to("circuit", count, data={"name": "csv", "frame": rows[: count + 1], "hold": hold},
               observer=observer)
        for count in (20, 60)
    ))


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_at_samples_the_last_row_of_a_recording_is_one_as_any_other(hold):
    """Nothing is held from it on, but it is there, with an error of its own."""
    rows = run("descriptor", time={"horizon": 4, "samples": 81}).to_pandas("signals").reset_index()
    frame = rows[["t", "u", "y"]]
    one, other = (
        run("descriptor", data={"frame": frame[:count], "hold": hold},
            estimator="ls_drem", noise={"name": "gaussian", "outputs": 1e-3},
            observer={"name": "gpebo", "sample_time": 0.05}).details.estimation
        for count in (61, 81)
    )
    for name in ("parameters", "states", "parameters_std", "states_std"):
        a, b = (getattr(found, name)[0, 50:61] for found in (one, other))
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12, err_msg=name)
