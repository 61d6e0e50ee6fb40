"""Observer and estimators at samples: their order, their algebra, and streams."""

from __future__ import annotations

import os
import pickle
import signal
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from examples import gpebo
from plants import experiment, one_state, shipped
from processes import assert_refused, begin, refused
from scipy.integrate import solve_ivp
from test_estimators import FROM_ZERO
from test_observer import ROTATING
from test_remedies import MIXED
from units import Units, in_units

import gpebo_cli
from gpebo_cli import estimators
from gpebo_cli.errors import ConfigError, ModelError, SolverError
from gpebo_cli.estimators import InformationRoot
from gpebo_cli.estimators._recursive import (
    KreisselmeierFilter,
    ScalarLaw,
    mix_sampled,
    quotient_of,
    spectrum,
)
from gpebo_cli.estimators.lion import _RowFilter
from gpebo_cli.experiment.online import Online
from gpebo_cli.experiment.pipeline import run_experiment, stream
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers import build
from gpebo_cli.regression.linear import outer_products
from gpebo_cli.regression.samples import SampledRegression, delayed
from gpebo_cli.regression.text import regression_from_mapping
from gpebo_cli.settings import DataSettings, Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

RNG = np.random.default_rng(7)


def run(system, estimator, horizon=5.0, **observer):
    return experiment(system, estimator, horizon, 2001, **observer)


def online_of(settings, *arguments):
    return Online(settings, *arguments, estimators.build(settings.estimator))


def signals(system, t):
    found = simulate(system, TimeSettings(0.0, float(t[-1]), 11), SolverSettings()).signals
    return found.inputs(t), found.outputs(t)


def regression(K=40, r=2, p=3, hold="zoh", steps=None):
    rows = RNG.normal(size=(K + 1, r, p + 1))
    rows[0] = rows[1]
    steps = RNG.uniform(0.1, 0.5, K) if steps is None else steps
    steps[0] = 0.0
    return SampledRegression(np.cumsum(steps), steps, rows, hold)


def in_parts(block, cuts):
    return [
        replace(block, t=block.t[a:b], steps=block.steps[a:b], rows=block.rows[a : b + 1])
        for a, b in pairwise(cuts)
    ]


@pytest.mark.parametrize("name", ["gradient", "mre"])
def test_what_is_left_of_an_error_is_told_in_no_units(name):
    made, size = regression(), np.array([1.0, 1e3, 1e-2])
    other = replace(made, rows=made.rows * np.append(size, 1.0))

    def left(regression, gains):
        gamma = dict(zip("abc", gains.tolist(), strict=True))
        law = estimators.build({"name": name, "gamma": gamma}).recursive(["a", "b", "c"])
        law.update(regression)
        return law.requirement.evidence["left_of_the_initial_error"]

    gains = np.array([0.02, 0.01, 0.03])
    assert 1e-6 < left(made, gains) < 0.999
    assert left(other, gains / size**2) == pytest.approx(left(made, gains), rel=1e-6)


# Against the observer in continuous time ------------------------------------------------------


@pytest.mark.parametrize(("hold", "order"), [("zoh", 1), ("linear", 2)])
@pytest.mark.parametrize(
    ("plant", "estimator"),
    [
        ("circuit", {"name": "least_squares"}),
        ("circuit", {"name": "ls_drem", "gamma": 10}),
        ("circuit", {"name": "ls_drem", "gamma": 10, "beta": 0.2}),
        ("circuit", {"name": "drem"}),
        ("circuit", {"name": "lion"}),
        ("descriptor", {"name": "ls_drem", "gamma": 5}),
        ("circuit", {"name": "fct", "gamma": 1e8}),
        ("circuit", {"name": "fct", "extension": "least_squares", "gamma": 1}),
        ("circuit", {"name": "power", "gamma": 1e4}),
        ("circuit", {"name": "exciting", "kappa": 1e8}),
        ("circuit", {"name": "gradient", "gamma": 5}),
        ("circuit", {"name": "mre", "gamma": 20}),
        ("circuit", {"name": "instrumental", "gamma": 2e9}),
        ("circuit", {"name": "annihilator", "gamma": 7e13}),
    ],
)
def test_estimates_converge_to_those_in_continuous_time(plant, estimator, hold, order):
    system = shipped(plant)
    # Early, while an estimate is still on its way: the whole path has to agree, not its end.
    horizon = 5.0
    reference = run(system, estimator, horizon).estimation
    errors = []
    for step in (0.04, 0.02, 0.01):
        sampled = run(system, estimator, horizon, sample_time=step, hold=hold).estimation
        rows = np.searchsorted(reference.t, sampled.t - 1e-9)
        errors.append([
            np.abs(sampled.parameters[0] - reference.parameters[0, rows])[len(rows) // 2 :].max(),
            np.abs(sampled.states[0] - reference.states[0, rows])[len(rows) // 2 :].max(),
        ])
    rates = np.log2(np.array(errors)[1] / np.array(errors)[2])
    assert np.all(np.abs(rates - order) < 0.3), errors


def test_the_regression_of_the_paper_has_the_last_rows_at_samples_too():
    whole, last = (
        run(shipped("circuit"), {"name": "least_squares"}, 1.0, sample_time=0.1, regression=rows)
        for rows in ("projected", "paper")
    )
    np.testing.assert_array_equal(last.regression.psi, whole.regression.psi[:, -1:])
    np.testing.assert_array_equal(last.regression.Y, whole.regression.Y[:, -1:])


def test_a_turning_kernel_of_e():
    """Of unknowns in small units, too: what is excited is told without any."""
    system = plant_from_mapping({
        **ROTATING, "F": [[f"1e-6*({x})" for x in row] for row in ROTATING["F"]],
        "unknowns": {name: 1e6 * value for name, value in ROTATING["unknowns"].items()},
    })
    reference = run(system, {"name": "least_squares"})
    found = [
        run(system, {"name": "least_squares"}, sample_time=step, hold="linear")
        for step in (0.02, 0.01)
    ]
    exact, *ends = (one.estimation.parameters[0, -1] for one in (reference, *found))
    errors = [np.abs(end / exact - 1.0).max() for end in ends]
    assert errors[1] < 0.35 * errors[0]
    assert found[1].excitation.level == pytest.approx(reference.excitation.level, rel=1e-3)


def test_a_kernel_of_e_that_turns_later():
    """At rest at first: what turns within a second is noticed at the start, else it is refused."""
    for start in (0.5, 1.5):
        # ROTATING with the angle w in the place of t; v = w'.
        angle = {
            "w": f"max(0, t - {start})**6", "v": "d(w)",
            "c": "cos(w)", "s": "sin(w)", "C": "cos(w/2)", "S": "sin(w/2)",
        }
        system = plant_from_mapping({**ROTATING, "parameters": angle, "A": [
            ["-c - s + v*s", 0, "-s + c - v*c", 0],
            ["c", "-C - S + v*S/2", "s", "-S + C - v*C/2"], *ROTATING["A"][2:],
        ]})
        settings = {"sample_time": 0.02, "hold": "linear"}
        if start < 1.0:
            found = run(system, {"name": "least_squares"}, 3.0, **settings).estimation
            assert found.parameters[0, -1] == pytest.approx(found.true_parameters[-1], rel=0.01)
        else:
            with pytest.raises(ModelError, match=r"the kernel of E turns from t = 1\.5\d* on"):
                run(system, {"name": "least_squares"}, 3.0, **settings)


def test_the_sampled_run_tells_what_the_continuous_one_tells():
    system = shipped("circuit")
    ours = run(system, {"name": "ls_drem"}, 20.0, sample_time=0.01, hold="linear")
    theirs = run(system, {"name": "ls_drem"}, 20.0)
    assert ours.excitation.is_ie
    assert ours.excitation.window == pytest.approx(theirs.excitation.window)
    assert ours.excitation.t_c == pytest.approx(theirs.excitation.t_c, abs=0.021)
    assert ours.excitation.determined == pytest.approx(theirs.excitation.determined, abs=0.021)
    assert ours.excitation.lambda_min == pytest.approx(theirs.excitation.lambda_min, rel=1e-3)
    rows = np.searchsorted(theirs.excitation.t, ours.excitation.t[::50] - 1e-9)
    late = ours.excitation.t[::50] > 3.0
    np.testing.assert_allclose(
        ours.excitation.pe_level[::50][late], theirs.excitation.pe_level[rows][late], rtol=0.05
    )
    assert ours.metrics.seconds_to_1pct_states[0] == pytest.approx(
        theirs.metrics.seconds_to_1pct_states[0], abs=0.02
    )
    np.testing.assert_array_equal(ours.signals.t, ours.estimation.t)
    assert [a.name for a in ours.assumptions] == [a.name for a in theirs.assumptions]


@pytest.mark.parametrize(("hold", "step", "said"), [
    ("zoh", 0.2, ("; the error of signals that are held between samples falls with "
                  "observer.sample_time, and faster with observer.hold=linear")),
    ("linear", 0.5, ("; the error of straight lines between samples falls with "
                     "observer.sample_time squared")),
    ("linear", 0.01, " s (alpha = 1, beta = 0)"),
])
def test_what_the_hold_costs_is_said_where_it_costs_one_percent(hold, step, said):
    found = run(shipped("descriptor"), {"name": "ls_drem"}, 10.0, sample_time=step, hold=hold)
    assert found.verdict.endswith(said)


def test_a_gain_at_samples_is_the_one_in_continuous_time():
    auto = {"name": "ls_drem", "gamma": "auto"}
    made = [run(shipped("boost"), auto, 3.0, **observer) for observer in (
        {}, {"sample_time": 0.003, "hold": "linear"}
    )]
    chosen = [each.estimation.cases[0]["gamma"] for each in made]
    assert chosen[1] == pytest.approx(chosen[0], rel=2e-3)
    assert made[1].estimation.requirement.holds


@pytest.mark.parametrize("f0", [[1e-2, 1.0], [1.0, 1e-2]])
def test_what_is_required_at_samples_is_of_the_group_that_has_the_least(f0):
    """Of several f₀ the integral of Δ² is the least of those that each has alone."""
    block = regression()

    def integral(f0):
        law = estimators.build({"name": "ls_drem", "f0": f0, "gamma": 1.0}).recursive("abc")
        law.update(block)
        return law.requirement.evidence["integral_delta_squared"]

    each = [integral(one) for one in f0]
    assert integral(f0) == pytest.approx(min(each), rel=1e-9)
    assert max(each) > 1.1 * min(each)


def test_at_most_as_many_samples_are_kept_as_are_asked_for():
    system = shipped("circuit")
    settings = Settings(
        estimator={"name": "ls_drem"}, time=TimeSettings(0.0, 2.0, 21),
        observer={"name": "gpebo", "sample_time": 0.01},
    )
    few = run_experiment(settings, system)
    many = run_experiment(replace(settings, time=TimeSettings(0.0, 2.0, 1001)), system)
    assert (len(few.signals.t), len(many.signals.t)) == (21, 201)
    np.testing.assert_array_equal(few.estimation.parameters, many.estimation.parameters[:, ::10])
    assert few.metrics.final_error_states == many.metrics.final_error_states


def test_it_does_not_matter_how_samples_are_grouped():
    system = shipped("descriptor")
    t = np.cumsum(RNG.uniform(0.005, 0.05, 60))  # steps may vary
    u, y = signals(system, t)
    able = ("fct", "power", "exciting", "gradient", "mre", "instrumental", "annihilator")
    for name in ("ls_drem", "least_squares", "drem", *able):
        settings = Settings(estimator={"name": name})
        at_once, parts = (
            online_of(settings, system, "linear", t[0], np.append(u[0], y[0])) for _ in range(2)
        )
        whole = at_once.feed(t, u, y)
        cuts = [0, 1, 2, 9, 40, 60]
        made = [
            parts.feed(t[a:b], u[a:b], y[a:b]) for a, b in pairwise(cuts)
        ]
        for field in ("parameters", "states"):
            joined, expected = (
                np.concatenate([getattr(part, field) for part in some], axis=1)
                for some in (made, [whole])
            )
            np.testing.assert_allclose(joined[:, 8:], expected[:, 8:], rtol=1e-8, atol=1e-9)
            # Few samples leave few digits.
            np.testing.assert_allclose(joined, expected, rtol=1e-5, atol=1e-6)
        for field in ("growth", "growth_rate"):
            assert getattr(parts, field) == pytest.approx(getattr(at_once, field), rel=1e-6)
        assert parts.assumptions == at_once.assumptions


@pytest.mark.parametrize("power", [0.0, 6.0])
def test_the_extension_has_the_coordinates_that_an_E_without_turns_leaves(power):
    """Of E = [e 0 0; 0 g 0; 0 0 0] two of three, whatever the units of the equations are."""
    rows = 10.0 ** (power * np.array([1.0, -1.0, 1.0]))
    E = np.diag([1.0, 1.0, 0.0])
    A = np.array([[-1.0, 1.0, 1.0], [0.0, -2.0, 1.0], [1.0, 0.0, -1.0]])
    system = plant_from_mapping({
        "name": "fixed", "states": ["a", "b", "c"], "inputs": {"u": "cos(t)"}, "outputs": ["y"],
        "E": [[f"{x!r}*(2 + sin(t))" for x in row] for row in (rows[:, None] * E).tolist()],
        "A": (rows[:, None] * A).tolist(), "B": (rows[:, None] * [[1.0], [0.0], [1.0]]).tolist(),
        "C": [[1, 0, 1]], "initial_state": [1, 1, 2],
    })
    t = np.linspace(0.0, 0.5, 6)
    u, y = signals(system, t)
    online = online_of(Settings({"name": "ls_drem"}), system, "zoh", t[0], np.append(u[0], y[0]))
    assert online.feed(t, u, y).extension.shape[1] == 2


def test_sizes_of_terms_have_no_sign_where_a_kernel_turns():
    plant = {**ROTATING, "initial_state": dict(zip(
        ROTATING["states"], ROTATING["initial_state"], strict=True))}
    t, sizes = np.linspace(0.0, 2.0, 21), []
    for signs in ([1, 1, 1, 1], [1, -1, -1, 1]):
        one = np.ones(1)
        units = Units(np.array(signs), one, one, one, np.ones(4), 1.0)
        system = plant_from_mapping(in_units(plant, units))
        u, y = signals(system, t)
        made = build({"name": "gpebo"}).at_samples(
            system, SolverSettings(), "linear", t[0], np.append(u[0], y[0]), None
        )
        sizes.append(made.advance(None, t, u, y)[1].regression.scale)
    np.testing.assert_allclose(*sizes, rtol=1e-9)


@pytest.mark.parametrize("name", ["descriptor", "rotating", "mixed"])
def test_blocks_of_an_observer_may_be_of_any_size(name):
    """All that is handed on from one to the next: times, rows, sizes, growth, errors."""
    plants = {"rotating": ROTATING, "mixed": MIXED}
    system = plant_from_mapping(plants[name]) if name in plants else shipped(name)
    t = np.cumsum(np.random.default_rng(2).uniform(0.05, 0.5, 30))
    u, y = signals(system, t)
    made = build({"name": "gpebo"}).at_samples(
        system, SolverSettings(), "linear", t[0], np.append(u[0], y[0]), None
    ).responding(np.arange(system.m + system.r) >= system.m)
    at_once, whole = made.advance(None, t, u, y)
    state, errors = None, []
    for part in (slice(0, 1), slice(1, 4), slice(4, 29), slice(29, 30)):
        state, block = made.advance(state, t[part], u[part], y[part])
        errors.append(state.error_estimate)
        rows = whole.regression.rows[part.start : part.stop + 1]
        np.testing.assert_allclose(block.regression.rows, rows, rtol=1e-6, atol=1e-8)
        for field in ("t", "steps", "scale"):
            ours, theirs = (getattr(b.regression, field) for b in (block, whole))
            np.testing.assert_allclose(ours, theirs[part], rtol=1e-6, atol=1e-12)
        for field in ("offset", "gain", "extension"):
            theirs = getattr(whole, field)[part]
            np.testing.assert_allclose(getattr(block, field), theirs, rtol=1e-6, atol=1e-7)
        for ours, theirs in zip(block.errors, whole.errors, strict=True):
            np.testing.assert_allclose(ours, theirs[part], rtol=1e-6, atol=1e-7)
    for field in ("growth", "log_norm", "injectivity"):
        assert getattr(state, field) == pytest.approx(getattr(at_once, field), rel=1e-6)
    assert 0.0 < max(errors) == errors[-1]
    assert errors == sorted(errors)


def test_every_case_is_what_it_is_alone():
    """Two extensions with two gains each: estimates, and Δ, which gains share."""
    system, t = shipped("descriptor"), np.arange(0.0, 1.0, 0.02)
    u, y = signals(system, t)

    def found(f0, gamma):
        estimator = {"name": "ls_drem", "f0": f0, "gamma": gamma}
        first = np.append(u[0], y[0])
        return online_of(Settings(estimator), system, "zoh", t[0], first).feed(t, u, y)

    together = found([1e-4, 1.0], [1.0, 10.0])
    alone = [found(f0, gamma) for f0 in (1e-4, 1.0) for gamma in (1.0, 10.0)]
    for field in ("parameters", "delta"):
        expected = np.concatenate([getattr(each, field) for each in alone])
        np.testing.assert_allclose(getattr(together, field), expected, rtol=1e-12)


def test_assumption_1_is_judged_by_its_weakest_sample():
    """𝒜 = [1 0; 0 c] on the kernel of E is c: of all |c|/‖𝒜‖ the smallest, at t = π."""
    system = plant_from_mapping({
        "name": "p", "states": ["a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, 0]], "B": [[0], [1]],
        "C": [[0, "1 + cos(t)/2"]], "initial_state": [0, 0],
    })
    found = run(system, {"name": "least_squares"}, sample_time=0.01, form="given")
    (one,) = (a for a in found.assumptions if a.name == "Assumption 1")
    smallest = one.evidence["smallest_singular_value_at_least"]
    assert smallest == pytest.approx(0.5 / np.sqrt(1.25), rel=1e-4)
    t = np.arange(0.0, 6.0, 0.01)
    u, y = signals(system, t)
    online = online_of(Settings(estimator={"name": "least_squares"},
                                observer={"name": "gpebo", "form": "given"}),
                       system, "zoh", 0.0, np.append(u[0], y[0]))
    for part in (slice(0, 200), slice(200, 400), slice(400, 600)):  # π is in the second one
        online.feed(t[part], u[part], y[part])
    (one,) = (a for a in online.assumptions if a.name == "Assumption 1")
    assert one.evidence["smallest_singular_value_at_least"] == pytest.approx(smallest, rel=1e-4)


def test_a_parameter_alone_would_explain_the_data_at_samples_with_its_size():
    system, t = shipped("circuit"), np.arange(0.0, 0.05, 0.01)
    u, y = signals(system, t)
    online = online_of(Settings(estimator={"name": "ls_drem"}), system, "zoh", 0.0,
                       np.append(u[0], y[0]))
    rows = online.feed(t, u, y).regression.weighted()
    *of_psi, of_Y = np.linalg.norm(rows.reshape(-1, rows.shape[-1]), axis=0)
    assert 0.0 < min(of_psi) < max(of_psi) < 1.0
    np.testing.assert_allclose(online.natural_sizes, of_Y / of_psi)


def test_what_is_remembered_does_not_grow():
    system = shipped("circuit")
    t = np.arange(0.0, 4.0, 0.01)
    u, y = signals(system, t)
    online = online_of(Settings(estimator={"name": "ls_drem"}), system, "zoh", 0.0,
                       np.append(u[0], y[0]))
    sizes = []
    for part in (slice(0, 100), slice(100, 200), slice(200, 400)):
        online.feed(t[part], u[part], y[part])
        kept = {k: v for k, v in vars(online).items() if k not in ("_system", "_observer")}
        sizes.append(len(pickle.dumps(kept)))
    assert max(sizes) < 1.1 * min(sizes)


# The algebra ----------------------------------------------------------------------------------


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_least_squares_at_samples_is_a_batch_solution(hold):
    block = regression(hold=hold)
    f0, alpha, beta = 0.3, 2.0, 0.4
    settings = {"name": "least_squares", "f0": f0, "beta": beta, "initial": 0.7}
    both = [alpha, 3.0 * alpha]  # the weaker one has to be enough
    recursion = estimators.build({**settings, "alpha": both}).recursive(["a", "b", "c"])
    made = recursion.update(block)
    estimate = made.parameters[0, -1]
    assert recursion.requirement.holds
    assert made.met[-1]
    assert not made.met[0]  # two rows for three parameters
    age = block.t[-1] - block.t
    weight = np.exp(-beta * age)
    rows = block.weighted() * np.sqrt(alpha * weight)[:, None, None]
    prior = np.sqrt(f0 * np.exp(-beta * block.t[-1]))
    left = np.concatenate([rows[..., :3].reshape(-1, 3), prior * np.eye(3)])
    right = np.concatenate([rows[..., 3].ravel(), prior * np.full(3, 0.7)])
    np.testing.assert_allclose(estimate, np.linalg.lstsq(left, right, rcond=None)[0], rtol=1e-11)
    squares = np.linalg.eigvalsh(np.einsum("kri,krj->ij", rows[..., :3], rows[..., :3]))
    reached = recursion.requirement.evidence["alpha_lambda_min_over_f0"]
    assert reached == pytest.approx(squares[0] / prior**2, rel=1e-9)


@pytest.mark.parametrize("given", [one for one in FROM_ZERO if not one.get("gamma2")], ids=str)
def test_estimates_at_samples_follow_the_sign_and_the_unit_of_what_is_measured(given):
    """To the last digit, as in continuous time."""
    block, found = regression(), []
    for unit in (1.0, -1.0, 2.0**30, -(2.0**-30)):
        rows, own = block.rows.copy(), {**given}
        rows[..., -1] *= unit
        if given["name"] == "power":
            own["gamma"] *= abs(unit) ** 0.5
        recursion = estimators.build(own).recursive(["p1", "p2", "p3"])
        found.append(recursion.update(replace(block, rows=rows)).parameters / unit)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_the_square_root_form_survives_what_normal_equations_do_not():
    block = regression(K=30, r=1, p=2)
    block.rows[..., 1] = block.rows[..., 0] * (1 + 1e-9 * RNG.normal(size=block.rows.shape[:2]))
    eta = np.array([1.0, -2.0])
    block.rows[..., 2] = block.rows[..., :2] @ eta
    roots, memory = InformationRoot(2, np.zeros(1)).update(block)
    quotient, usable, _ = quotient_of(spectrum(roots[:, 0], memory[:, 0]))
    assert usable[-1]
    np.testing.assert_allclose(quotient[-1], eta, atol=1e-5)
    small = quotient_of(spectrum(1e-20 * roots[:, 0], memory[:, 0]))  # in other units of Y
    np.testing.assert_array_equal(small[1], usable)
    np.testing.assert_allclose(small[0], quotient, rtol=1e-4)
    rows = block.weighted().reshape(-1, 3)
    normal = rows.T @ rows  # its condition is 1e18
    assert np.linalg.eigvalsh(normal[:2, :2])[0] < 1e-15 * normal[0, 0]


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_the_factor_is_that_of_the_gram_matrix(hold):
    block = regression(hold=hold)
    roots, _ = InformationRoot(3, np.zeros(1)).update(block)
    outer = outer_products(block.rows[..., :3], block.rows[..., 3])
    mean = outer[1:] if hold == "zoh" else 0.5 * (outer[1:] + outer[:-1])
    gram = np.cumsum(block.steps[:, None, None] * mean, axis=0)
    S = roots[:, 0]
    np.testing.assert_allclose(
        np.swapaxes(S, 1, 2)[:, :3] @ S, gram, atol=1e-12 * np.abs(gram).max()
    )
    found, expected = spectrum(S, np.ones(len(S))), np.linalg.eigvalsh(gram[..., :3])  # ascending
    np.testing.assert_allclose(found.eigenvalues, expected, atol=1e-12 * expected.max())


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_filters_of_a_constant_are_exact_at_any_steps(hold):
    block = regression(K=20, hold=hold)
    block.rows[:] = block.rows[:1]
    rates = np.array([0.1, 1.0, 50.0])
    values = KreisselmeierFilter(rates).update(block)
    outer = outer_products(block.rows[1:, :, :3], block.rows[1:, :, 3])
    expected = -np.expm1(-rates[:, None] * block.t[:, None, None]) * outer
    np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-14)


def test_rows_that_were_zero_so_far_are_not_taken():
    """Two rows alone, then three: from the sample on which the third wakes, all start anew."""
    block, rates = regression(K=40, r=3, hold="linear"), np.array([0.5, 1.0, 2.0])
    block.rows[:, 2] = 0.0
    block.rows[:, 0, 1] = 0.0  # one of its numbers is not the row
    two = replace(block, rows=block.rows[:, :2])
    own, alone = (estimators.build({"name": "lion"}).at_samples(rates) for _ in range(2))
    np.testing.assert_array_equal(own.update(block), alone.update(two))
    assert (alone.seen(two)[1] == np.eye(2)[[0, 1, 0]]).all()
    block.rows[20:] = regression(K=20, r=3, hold="linear").rows
    part = replace(block, t=block.t[19:], steps=block.steps[19:], rows=block.rows[19:])
    own, late = (estimators.build({"name": "lion"}).at_samples(rates) for _ in range(2))
    whole = own.update(block)
    np.testing.assert_array_equal(whole[19:], late.update(part))
    for cut in (25, 20):  # the third row wakes within a part, or at its end and is silent behind it
        block.rows[21, 2] *= cut != 20
        whole = estimators.build({"name": "lion"}).at_samples(rates).update(block)
        own = estimators.build({"name": "lion"}).at_samples(rates)
        found = [own.update(part) for part in in_parts(block, [0, 1, 10, cut, 40])]
        np.testing.assert_allclose(np.concatenate(found), whole, atol=1e-13)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
@pytest.mark.parametrize("gain", [1e-3, 1.0, 1e6, 1e14])
def test_the_scalar_law_is_stable_for_any_gain_and_any_sample_time(hold, gain):
    block = regression(K=50, p=2, steps=RNG.uniform(0.5, 30.0, 50), hold=hold)
    eta = np.array([3.0, -1.0])
    delta = RNG.normal(size=(50, 1))
    quotient = np.broadcast_to(eta, (50, 1, 2))
    law = ScalarLaw(np.zeros(2), np.array([[gain]]), 1)
    made = law.update(block, delta, quotient, np.ones((50, 1), dtype=bool)).parameters[0]
    error = np.abs(made - eta) / np.abs(eta)
    assert np.isfinite(made).all()
    assert (np.diff(error, axis=0) <= 1e-15).all()  # it never grows
    np.testing.assert_allclose(
        error[-1], np.exp(-gain * law.energy[0]) * np.ones(2), rtol=1e-9, atol=1e-15
    )


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_the_scalar_law_in_parts_is_that_of_the_whole(hold):
    block, usable = regression(K=40, p=2, hold=hold), np.arange(40)[:, None] != 19
    delta, quotient = RNG.normal(size=(40, 1)), RNG.normal(size=(40, 1, 2))
    whole, own = (ScalarLaw(np.ones(2), np.array([[0.1]]), 1, 0.5) for _ in range(2))
    expected = whole.update(block, delta, quotient, usable).parameters
    made = [own.update(
        replace(block, t=block.t[k : k + 10], steps=block.steps[k : k + 10],
                rows=block.rows[k : k + 11]),
        *(each[k : k + 10] for each in (delta, quotient, usable)),
    ).parameters for k in range(0, 40, 10)]
    np.testing.assert_allclose(np.concatenate(made, axis=1), expected, rtol=1e-12, atol=1e-14)


def test_a_quotient_that_is_rounding_moves_nothing():
    block = regression(K=3, p=1)
    law = ScalarLaw(np.array([5.0]), np.array([[1e10]]), 1)
    quotient = np.array([[[np.inf]], [[2.0]], [[2.0]]])
    quotient[0] = 1e300
    usable = np.array([[False], [True], [True]])
    made = law.update(block, np.ones((3, 1)), quotient, usable).parameters[0, :, 0]
    np.testing.assert_allclose(made, [5.0, 2.0, 2.0])


@pytest.mark.parametrize("gain", [1e-2, 1.0, 1e14])
@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_the_gradient_law_is_solved_exactly_over_each_sample(gain, hold):
    block, eta = regression(K=30, hold=hold), np.array([1.0, -2.0, 3.0])
    block.rows[..., 3] = block.rows[..., :3] @ eta
    Gamma = gain * np.array([0.5, 2.0, 3.0])
    settings = {"name": "gradient", "gamma": dict(zip("abc", Gamma.tolist(), strict=True))}
    recursion = estimators.build(settings).recursive(["a", "b", "c"])
    made, error = recursion.update(block).parameters[0], -eta
    for k, rows in enumerate(block.weighted()[..., :3]):
        values, vectors = np.linalg.eigh(rows.T @ rows * np.sqrt(np.outer(Gamma, Gamma)))
        turned = vectors * np.sqrt(Gamma)[:, None]
        error = turned @ (np.exp(-values) * np.linalg.solve(turned, error))
        if gain <= 1.0:  # the rounding of ψᵀψ, which the law itself does not form, is too large
            np.testing.assert_allclose(made[k] - eta, error, rtol=0.0, atol=1e-11)
    scaled = np.linalg.norm((made[-1] - eta) / np.sqrt(Gamma))
    left = recursion.requirement.evidence["left_of_the_initial_error"]
    assert scaled <= (left + 1e-9) * np.linalg.norm(eta / np.sqrt(Gamma))
    assert recursion.requirement.holds == (left <= 0.01)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_the_new_regressor_is_rotated_over_each_sample(hold):
    """By φ' = κΔ²(π/2 − φ) in all, about −𝐘/Δ as it is there or in the middle."""
    block = regression(K=25, hold=hold)
    mixed = mix_sampled(KreisselmeierFilter(np.ones(3)).update(block), None, 1.0)
    weight, eta = mixed.delta[:, 0] ** 2, mixed.quotient[:, 0]
    kappa = 1.0 / float(block.steps @ weight)
    made = estimators.build({"name": "exciting", "kappa": kappa, "lambda": 1.0}).recursive("abc")
    found = made._mixing(block)  # Φ_21 and e_2/Φ_21
    phi, c = 0.0, np.zeros((2, 3))
    for k, step in enumerate(block.steps):
        if not mixed.usable[k]:
            continue
        both = hold == "linear" and k and mixed.usable[k - 1]
        energy = step * (0.5 * (weight[k] + weight[k - 1] * (k > 0)) if hold == "linear"
                         else weight[k])
        towards = 0.5 * (eta[k] + eta[k - 1]) if both else eta[k]
        delta = (0.5 * np.pi - phi) * -np.expm1(-kappa * energy)
        phi += delta
        turn = np.array([[np.cos(delta), -np.sin(delta)], [np.sin(delta), np.cos(delta)]])
        about = np.stack([towards, 0.0 * towards])
        c = turn @ (c + about) - about
        assert found.delta[k, 0] == pytest.approx(np.sin(phi), abs=1e-12)
        np.testing.assert_allclose(found.quotient[k, 0] * np.sin(phi), c[1], atol=1e-10)
    assert 0.1 < phi < 1.57
    own = estimators.build({"name": "exciting", "kappa": kappa, "lambda": 1.0}).recursive("abc")
    made = [own._mixing(each) for each in in_parts(block, [0, 1, 2, 12, 25])]
    for field in ("delta", "quotient"):
        joined = np.concatenate([getattr(part, field) for part in made])
        np.testing.assert_allclose(joined, getattr(found, field), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["mre", "gradient"])
def test_errors_never_grow_beside_a_regressor_that_does(name):
    """Of ψ that grows to e^80 few digits are known in most directions: there nothing is learned."""
    growing = {
        "name": "growing", "states": ["x1", "x2", "x3"], "outputs": ["y"],
        "E": np.eye(3).tolist(), "A": [[4, 1, 0], ["sin(t)", 3, 1], [0, 0, 1]],
        "C": [[1, 0, 0]], "initial_state": [1, -1, 2],
    }
    found = gpebo_cli.run(
        growing, estimator=name, observer={"name": "gpebo", "sample_time": 0.05},
        time={"horizon": 20, "samples": 101},
    ).details.estimation
    assert 0.0 < found.requirement.evidence["left_of_the_initial_error"] < 1.0
    error = np.linalg.norm(found.parameters - found.true_parameters, axis=-1)
    assert error.max() < 1.01 * error[0, 0]


@pytest.mark.parametrize("perturbed", [None, ["b"]])
def test_means_at_samples_are_sums_over_the_samples(perturbed):
    block, delay, settle, gain = regression(K=50), 0.7, 0.4, 3.0
    rows, t = block.rows[1:], block.t
    settings = {"name": "instrumental", "delay": delay, "settle": settle, "gamma": gain}
    if perturbed:
        settings |= {"name": "annihilator", "perturbed": perturbed}
    made = estimators.build(settings).recursive(["a", "b", "c"]).update(block)
    eta, Z, expected = np.zeros(3), np.zeros((6, 4)), []
    for k, now in enumerate(t):
        before = np.zeros_like(rows[k][:, :3])
        if now >= delay:
            before = rows[np.flatnonzero(t <= now - delay)[-1]][:, :3]
        since = min(max(now - delay, 0.0), block.steps[k])  # of the step, with the delayed ψ
        lengths = np.repeat([block.steps[k], since], 3)[:, None]
        Z += lengths * np.hstack([rows[k][:, :3], before]).T @ rows[k]
        means = Z / (settle + now)
        kept = np.delete(means, 1, axis=0) if perturbed else means[3:]
        delta = np.linalg.det(kept[:, :3]) if not perturbed else np.prod(
            np.linalg.svd(kept[:, :3], compute_uv=False)
        )
        assert made.delta[0, k] == pytest.approx(delta, rel=1e-9, abs=1e-12)
        if abs(delta) > 1e-12:
            goal = np.linalg.lstsq(kept[:, :3], kept[:, 3])[0]
            eta = goal + np.exp(-gain * delta**2 * block.steps[k]) * (eta - goal)
        expected.append(eta)
    np.testing.assert_allclose(made.parameters[0], expected, atol=1e-9)


def test_what_is_rounding_of_mixing_is_not_used():
    """Neither of rows that are one but for rounding, nor where Δ is too small for a number."""
    one = np.ones((2, 2)) + np.diag([0.0, 3e-16])
    extended = np.array([
        np.column_stack([omega, omega @ [2.0, -1.0]])
        for omega in (np.eye(2), one, 1e-170 * np.eye(2), -np.eye(2))
    ])
    found = mix_sampled(extended, None, 1.0)
    np.testing.assert_array_equal(found.usable[:, 0], [True, False, False, True])
    np.testing.assert_array_equal(
        found.quotient[:, 0], [[2.0, -1.0], [0.0, 0.0], [0.0, 0.0], [2.0, -1.0]]
    )


MONOTONE = {
    "name": "monotone", "unknowns": {"a": -2.0, "b": 8.0}, "box": {"a": [-3, 3], "b": [0.01, 9]},
    "S": ["a", "sqrt(b)", "a + b"], "psi": [[1, 1, 1]],
}


@pytest.mark.parametrize("gain", [5.0, [1e2, 1e14]])
def test_the_monotone_law_at_samples(gain):
    """The flow of the law over each sample; with large gains the error never grows."""
    S = regression_from_mapping(MONOTONE).parametrisation
    block, truth = regression(K=25, steps=RNG.uniform(0.02, 0.05, 25)), np.array([-2.0, 8.0])
    block.rows[..., 3] = block.rows[..., :3] @ S.values(truth[None])[0]
    built = estimators.build({"name": "monotone", "gamma": gain, "lambda": 1.0})
    recursion, (_, T, mu, theta) = built.recursive(["e", "f", "g"]), built.law(S)
    with pytest.raises(ConfigError, match="is for a regression with S"):
        built.recursive(["e", "f", "g"]).update(block)
    beyond = replace(block, parametrisation=S, rows=block.rows.copy())
    beyond.rows[..., 3] = block.rows[..., :3] @ [-2.0, -99.0, -99.0]  # no √b and no b
    with pytest.raises(SolverError, match="cannot be followed at samples; lower its gain"):
        built.recursive(["e", "f", "g"]).update(beyond)
    made = recursion.update(replace(block, parametrisation=S))
    eta = made.parameters  # (a, √b, a + b), from which θ̂ is read off
    found = np.stack([eta[..., 0], eta[..., 1] ** 2], axis=2)
    assert (np.diff(np.linalg.norm(found - truth, axis=2), axis=1) <= 1e-9).all()
    extended = KreisselmeierFilter(np.ones(3)).update(block)
    energy = block.steps @ np.linalg.det(extended[..., :3]) ** 2
    assert recursion.requirement.evidence == pytest.approx({
        "integral_delta_squared": energy, "gamma_times_integral": np.min(gain) * energy,
        "needed": np.log(100.0) / mu,
    }, rel=1e-9)
    own = built.recursive(["e", "f", "g"])
    parts = [own.update(part) for part in in_parts(replace(block, parametrisation=S), [0, 9, 25])]
    joined = np.concatenate([part.parameters for part in parts], axis=1)
    np.testing.assert_allclose(joined, eta, rtol=1e-9)
    if gain == 5.0:
        for k, omega in enumerate(extended[..., :3]):
            x = gain * np.linalg.det(omega) ** 2 * block.steps[k]
            flow = solve_ivp(
                lambda _, theta: T @ (S.values(truth[None]) - S.values(theta[None]))[0],
                (0.0, x), theta, method="DOP853", rtol=1e-12, atol=1e-12,
            )
            theta = flow.y[:, -1]
            np.testing.assert_allclose(found[0, k], theta, atol=1e-7)
    else:
        np.testing.assert_allclose(found[1, -1], truth, atol=1e-9)


# What there is not ----------------------------------------------------------------------------


NOT_ALONG_RESETS = ["exciting", "instrumental", "annihilator", "monotone"]


def test_what_the_last_sample_determines_is_told():
    """x and v by two samples of x that are held up to a third one."""
    plant = one_state(states=["x", "v"], E=[[1, 0], [0, 1]], A=[[0, 1], [-1, 0]], C=[[1, 0]])
    found = gpebo_cli.run(
        plant | {"initial_state": [1, 0.5]}, estimator="least_squares",
        observer={"sample_time": 1.0}, time={"horizon": 2.0},
    )
    assert np.isfinite(list(found.estimates.values())).all()
    assert found.parameters == pytest.approx({"e0_x": -1.0, "e0_v": -0.5}, abs=0.01)


def test_the_power_law_at_samples_needs_what_its_start_is_off():
    """|e|^½ falls by γ/2 ∫|Δ|^{3/2}, and with twice the needed γ e is zero at the end."""
    block, eta = regression(K=25), np.array([1.0, -2.0, 1.5])
    block.rows[..., 3] = block.rows[..., :3] @ eta
    omega = KreisselmeierFilter(np.ones(3)).update(block)[..., :3]
    known = np.linalg.cond(omega) < 1e12
    energy = np.cumsum(known * block.steps * np.abs(np.linalg.det(omega)) ** 1.5)
    settings = {"name": "power", "lambda": 1.0, "initial": 0.5}
    needed = 2.0 * np.sqrt(2.5)
    for share in (0.5, 2.0):
        gamma = share * needed / energy[-1]
        recursion = estimators.build(settings | {"gamma": gamma}).recursive(["a", "b", "c"])
        error = recursion.update(block).parameters[0] - eta
        left = np.sqrt(np.abs(0.5 - eta)) - 0.5 * gamma * energy[:, None]
        np.testing.assert_allclose(np.abs(error), np.maximum(left, 0.0) ** 2, atol=1e-9)
        assert recursion.requirement.holds == (share > 1.0)
        assert recursion.requirement.evidence == pytest.approx({
            "integral_delta_squared": energy[-1], "gamma_times_integral": share * needed,
            "needed": needed,
        })


def test_filters_take_rows_in_turn_however_many_there_are():
    """Row i of the extension is row i mod r of the r that are not zero so far: of 40 the third."""
    rows = np.ones((4, 40, 4))
    rows[:, [0, 2]] = 0.0
    block = SampledRegression(np.arange(3.0), np.array([0.0, 1.0, 1.0]), rows, "zoh")
    _, taken, _ = _RowFilter(np.array([1.0, 2.0, 3.0])).seen(block)
    np.testing.assert_array_equal(taken, np.broadcast_to(np.eye(40)[[1, 3, 4]], taken.shape))


def test_the_level_that_is_asked_for_is_reached_at_a_sample():
    found = gpebo_cli.run(
        "circuit", observer={"sample_time": 0.1}, excitation={"rho": 1e-3}, estimator="ls_drem",
        time={"samples": 201},
    ).details.excitation
    reached = found.t[found.gram_eigenvalues[:, 0] >= 1e-3]
    assert found.t_c == reached[0] > found.t[1]
    never = gpebo_cli.run(
        "circuit", observer={"sample_time": 0.1}, excitation={"rho": 1e9}, estimator="ls_drem",
        time={"horizon": 1.0, "samples": 11},
    ).details.excitation
    assert never.t_c is None


def test_what_is_told_apart_but_never_well_is_exciting_since_then():
    """N12 = 1 − 2e-7 at the end: from the third sample on that is no rounding."""
    found = gpebo_cli.run(
        regression={"name": "x", "unknowns": {"a": 1.0, "b": 2.0}, "psi": [["1", "1 + 1e-3*t"]]},
        estimator="least_squares", observer={"sample_time": 0.1}, time={"horizon": 2, "samples": 5},
    ).details.excitation
    assert found.known.smallest[-1] < 1e-6
    assert found.t_c == pytest.approx(0.2)


def test_every_estimator_runs_at_samples_and_one_that_cannot_says_which_can():
    """Before the first sample none of them has what it requires."""
    for name in estimators.names():
        built = estimators.build({"name": name})
        assert isinstance(built, estimators.Recursive)
        requirement = built.recursive(["a", "b", "c"]).requirement
        assert not requirement.holds, name
        (reached,) = {"left_of_the_initial_error", "gamma_times_integral",
                      "alpha_lambda_min_over_f0"} & set(requirement.evidence)
        assert requirement.evidence[reached] == float(reached.startswith("left"))
    bounded = estimators.build({"name": "least_squares", "f0": 1.0, "beta": 1.0, "bound": 9.0})
    with pytest.raises(ConfigError, match=r"^estimator\.bound works in continuous time only; at "):
        bounded.recursive(["a"])
    with pytest.raises(ConfigError, match=r"these can: annihilator, drem, exciting, .*, lion"):
        estimators.able(object(), estimators.Recursive, "samples")
    several = estimators.build({"name": "instrumental", "delay": [0.2, 0.4]})
    with pytest.raises(ConfigError, match=r"^samples; a list for estimator\.delay makes several: "):
        estimators.able(several, estimators.Recursive, "samples")


@pytest.mark.parametrize("name", [n for n in estimators.names() if n != "monotone"])
def test_without_parameters_constraints_determine_the_states_at_samples_too(name):
    """x1 = (1 + t) e⁻ᵗ and x2 = e⁻ᵗ follow from the input alone."""
    time = {"horizon": 2, "samples": 5}
    result = gpebo_cli.run(
        "published/gelda", estimator=name, observer={"sample_time": 0.1}, time=time
    )
    t = result.t
    assert result.details.estimation.requirement.text == "there is nothing to estimate"
    np.testing.assert_allclose(result["x1_hat"][0], (1.0 + t) * np.exp(-t), rtol=1e-9)
    np.testing.assert_allclose(result["x2_hat"][0], np.exp(-t), rtol=1e-9)
    noise = {"name": "gaussian", "seeds": 3}
    assert gpebo_cli.run("published/gelda", estimator=name, noise=noise, time=time).verdict


@pytest.mark.parametrize("name", NOT_ALONG_RESETS)
def test_estimators_that_cannot_go_on_after_a_reset_say_which_can(name):
    built = estimators.build({"name": name})
    assert not isinstance(built, estimators.Resumable)
    with pytest.raises(ConfigError, match=r"reset needs .* these can: drem, fct, .*, power"):
        estimators.able(built, estimators.Resumable, "observer.remedy=reset needs one that can")


def test_forgetting_with_a_bound_is_refused():
    settings = {"name": "ls_drem", "beta": 1, "bound": 1e6}
    with pytest.raises(ConfigError, match=r"estimator\.bound"):
        estimators.build(settings).recursive(["a"])
    with pytest.raises(ConfigError, match=r"estimator\.gamma2"):
        estimators.build({"name": "power", "gamma2": 1.0}).recursive(["a"])


@pytest.mark.parametrize(
    ("plant", "observer", "part"),
    [
        ("canonical", {"name": "canonical", "sample_time": 0.1}, "sample_time: no such key"),
        ("circuit", {"sample_time": 30.0}, "longer than the horizon"),
        ("circuit", {"sample_time": 1e-9}, "at most"),
    ],
)
def test_settings_that_make_no_samples(plant, observer, part):
    with pytest.raises(ConfigError, match=part):
        run(shipped(plant), {"name": "ls_drem"}, **observer)


STREAM = Settings(
    estimator={"name": "ls_drem"}, data=DataSettings("csv", "-"),
    time=TimeSettings(-np.inf, np.inf, 11),
)


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"data": DataSettings("csv", "-", "cubic")}, "cubic"),
        ({"observer": {"name": "gpebo", "sample_time": 0.1}}, "sample_time"),
        (
            {"time": TimeSettings(0.0, 5.0, 11)},
            "ends with its last; leave time.start and time.horizon",
        ),
        (
            {"estimator": {"name": "drem", "gamma": [1, 2]}},
            "make 2 cases; a stream has room for one",
        ),
    ],
)
def test_what_a_stream_cannot_do(changes, part):
    with refused(part):
        stream(replace(STREAM, **changes), shipped("circuit"))


def test_before_its_first_sample_a_stream_has_reached_no_time():
    online = online_of(STREAM, shipped("circuit"), "zoh", 0.0, np.zeros(2))
    with pytest.raises(ValueError, match="there have been no samples"):
        _ = online.reached


# Streams as processes -------------------------------------------------------------------------

COMMAND = ["run", "data.file=-", "estimator=ls_drem"]


@pytest.fixture(scope="module")
def rows():
    t = np.arange(0.0, 20.0, 0.01)
    u, y = signals(shipped("circuit"), t)
    table = np.column_stack([t, u, y]).tolist()
    return ["t,V,y\n", *(",".join(map(repr, row)) + "\n" for row in table)]


def test_every_row_is_answered_before_the_next_one_is_there(tmp_path, rows):
    with begin(*COMMAND, cwd=tmp_path) as process:
        process.stdin.write(rows[0] + rows[1])
        process.stdin.flush()
        header = process.stdout.readline().strip().split(",")
        assert header == [
            "t", "e0_e1_hat", "e0_e2_hat", "e0_il_hat",
            *(f"{s}_hat" for s in ("e1", "e2", "il", "ir1", "ir2", "iv")), "lambda_min",
            *(f"{name}_std" for name in ("e0_e1", "e0_e2", "e0_il")),
            *(f"{s}_std" for s in ("e1", "e2", "il", "ir1", "ir2", "iv")),
        ]
        assert process.stdout.readline().startswith("0,")
        for row in rows[2:12]:
            process.stdin.write(row)
            process.stdin.flush()
            answer = process.stdout.readline().split(",")  # would wait for ever if it were kept
            assert float(answer[0]) == float(row.split(",")[0])
            assert len(answer) == len(header)
        process.stdin.close()
        assert process.stdout.read() == ""
        verdict = process.stderr.read()
        assert "11 rows" in verdict
        assert verdict.count("\n") == 1
    assert process.returncode == 0
    assert list(tmp_path.iterdir()) == []  # no folder


def test_a_stream_gives_what_a_run_at_samples_gives(tmp_path, rows):
    done = gpebo(*COMMAND, cwd=tmp_path, text="".join(rows))
    assert done.returncode == 0, done.stderr
    assert "interval-exciting" in done.stderr
    assert "parameters well determined at the end" in done.stderr
    table = np.array([line.split(",") for line in done.stdout.splitlines()[1:]], dtype=float)
    assert len(table) == len(rows) - 1
    ours = run(shipped("circuit"), {"name": "ls_drem"}, 19.99, sample_time=0.01, hold="linear")
    np.testing.assert_allclose(table[:, 1:4], ours.estimation.parameters[0], atol=1e-8)
    np.testing.assert_allclose(table[:, 4:10], ours.estimation.states[0], atol=1e-7)
    np.testing.assert_allclose(
        table[:, 10], ours.excitation.gram_eigenvalues[:, 0], rtol=1e-6, atol=1e-12
    )


def test_a_bad_row_ends_a_stream_after_the_rows_before_it(tmp_path, rows):
    text = "".join(rows[:8]) + "0.5,,1\n" + rows[60]
    done = gpebo(*COMMAND, cwd=tmp_path, text=text)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "standard input, line 9, column V" in done.stderr
    assert len(done.stdout.splitlines()) == 8


@pytest.mark.parametrize(
    ("policy", "notes"),
    [("hold", ["rows left out (data.missing=hold): 1,", "cells filled (data.missing=hold): 4,"]),
     ("drop", ["rows left out (data.missing=drop): 4,"])],
)
def test_a_stream_says_what_became_of_gaps(tmp_path, rows, policy, notes):
    gaps = ["0.06,1,\n", "0.07,,\n", "0.08,2,\n"]
    text = "".join([rows[0], "-1,1,\n", *rows[1:7], *gaps])
    done = gpebo(*COMMAND, f"data.missing={policy}", cwd=tmp_path, text=text)
    assert done.returncode == 0
    assert [note for note in notes if note in done.stderr] == notes


@pytest.mark.parametrize(
    ("text", "part"),
    [("", "is empty"), ("t,V,y\n", "no rows"), ("t,V\n", "no column y"), ("t;V;y\n", "semicolons")],
)
def test_a_stream_that_is_none(tmp_path, text, part):
    assert_refused(gpebo(*COMMAND, cwd=tmp_path, text=text), part)


def test_interrupting_a_stream_leaves_whole_rows(tmp_path, rows):
    with begin(*COMMAND, cwd=tmp_path) as process:
        process.stdin.write("".join(rows[:20]))
        process.stdin.flush()
        for _ in range(20):
            assert process.stdout.readline().endswith("\n")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
        assert process.stdout.read() == ""
        assert process.stderr.read() == "gpebo: error: interrupted\n"


def test_a_reader_that_has_seen_enough_ends_a_stream_quietly(tmp_path, rows):
    with begin(*COMMAND, cwd=tmp_path) as process:
        process.stdin.write("".join(rows[:5]))
        process.stdin.flush()
        process.stdout.readline()
        process.stdout.close()
        try:
            process.stdin.write("".join(rows[5:]))
            process.stdin.close()
        except BrokenPipeError:
            pass
        assert process.wait(60) == 0
        assert process.stderr.read() == ""


def test_the_memory_of_a_stream_does_not_grow(tmp_path):
    if not os.path.exists("/proc/self/status"):
        pytest.skip("needs /proc")
    t = 0.01 * np.arange(16_000)
    table = np.column_stack([t, np.sin(t), np.cos(2 * t)]).tolist()
    text = [f"{a!r},{b!r},{c!r}\n" for a, b, c in table]
    peak = {}
    with begin("run", "data.file=-", "estimator=least_squares", cwd=tmp_path) as process:
        process.stdin.write("t,V,y\n")
        for first in range(0, len(text), 500):
            process.stdin.write("".join(text[first : first + 500]))
            process.stdin.flush()
            for _ in range(501 if first == 0 else 500):
                process.stdout.readline()
            # Not ru_maxrss, which a process inherits from the one that started it.
            status = Path(f"/proc/{process.pid}/status").read_text().splitlines()
            (line,) = (line for line in status if line.startswith("VmHWM"))
            peak[first + 500] = int(line.split()[1])
        process.stdin.close()
        assert process.wait(60) == 0
    # As text alone 12,000 more rows are 0.6 MB, as estimates 1.8 MB; in kB.
    assert peak[16_000] - peak[4_000] < 500, peak


def test_a_sweep_cannot_read_standard_input(tmp_path):
    done = gpebo("run", "-m", "data.file=-", "estimator.gamma=1,2", cwd=tmp_path)
    assert done.returncode != 0
    assert "standard input" in done.stdout + done.stderr


@pytest.mark.parametrize(("hold", "between"), [("linear", 0.75), ("zoh", 0.0)])
def test_what_is_delayed_lies_between_samples_as_the_hold_has_it(hold, between):
    """x = 3 t at t = 0 and 1, seen 0.75 s later: at first there are two samples, then three."""
    first = np.array([0.0]), np.array([[0.0]])
    found, past = delayed(first, np.array([1.0]), np.array([[3.0]]), 0.75, hold)
    assert found == pytest.approx(np.array([[between]]))
    again, past = delayed(past, np.array([2.0]), np.array([[6.0]]), 0.75, hold)
    assert again == pytest.approx(np.array([[3.0 * 1.25 if hold == "linear" else 3.0]]))
    for t in np.arange(3.0, 50.0):  # what is kept is no longer than the delay and a step
        _, past = delayed(past, np.array([t]), np.array([[3.0 * t]]), 0.75, hold)
        assert past[0].tolist() == [t - 1.0, t]


@pytest.mark.parametrize("name", ["instrumental", "annihilator"])
def test_a_delay_is_the_same_number_of_samples_whenever_the_clock_began(name):
    """Rows are 0.1 s apart, and 0.7 − 0.5 is less than 0.2 by a rounding."""
    block = regression(K=60, steps=np.full(60, 0.1))
    found = [
        estimators.build({"name": name, "delay": 0.5, "gamma": 10.0})
        .recursive(["a", "b", "c"])
        .update(replace(block, t=np.round(start + 0.1 * np.arange(60), 6)))
        .parameters
        for start in (0.0, 3.7, 1e4, -1e3)
    ]
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-6, atol=1e-9)
