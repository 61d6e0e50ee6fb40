"""Remedies for a Φ that grows: the state stays known where without one it is lost."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from examples import gpebo
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import experiment, left_of_identities, one_state, shipped
from plants import observed as along
from processes import assert_refused, refused
from random_systems import HORIZON, random_system
from regressions import ETA, three
from regressions import regression as make_regression
from scipy.integrate import solve_ivp
from scipy.linalg import expm, sqrtm
from test_observer import ROTATING
from units import Units, in_units

from gpebo_cli import estimators
from gpebo_cli import run as api_run
from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.evidence.excitation import window_level
from gpebo_cli.experiment.assumptions import examine
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Mesh, Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import Measurements, observe
from gpebo_cli.observers.reduced.matrices import observer_matrices
from gpebo_cli.observers.remedies import reset as resetting
from gpebo_cli.observers.remedies.reset import _with_edges
from gpebo_cli.reduction.form import EquationForm
from gpebo_cli.regression import dynamics, linear
from gpebo_cli.regression.dynamics import Dynamics, filtered
from gpebo_cli.regression.resets import ExtensionState, Reset
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings, TimeSettings

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "examples"
UNBOUNDED = yaml.safe_load((EXAMPLES / "plant" / "unbounded.yaml").read_text(encoding="utf-8"))
SOLVER = SolverSettings()

# x grows itself, with the eigenvalues of the other plant's A_0: E = I, A_0 = A.
GROWING = {
    "name": "growing", "states": ["x1", "x2", "x3"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
    "E": np.eye(3).tolist(),
    "A": [[0.64, 1.01, 0], [-1.01, 0.64, 0.2], [0, 0, 0.33]],
    "B": [[0], [1], [0]], "C": [[1, 0.5, -0.3]], "initial_state": [1, -1, 0.5],
}
# One direction grows, one decays fast, and there is an unknown.
MIXED = {
    "name": "mixed", "states": ["x1", "x2", "x3"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
    "unknowns": {"theta": 0.7}, "F": [[1], [0], [0]],
    "E": np.eye(3).tolist(), "A": [[0.4, 0.3, 0], [0, -3, 0.5], [0.1, 0, -0.6]],
    "B": [[0], [1], [0]], "C": [[1, 0.5, -0.3]], "initial_state": [1, -1, 0.5],
}
WITH_UNKNOWN = {**UNBOUNDED, "unknowns": {"theta": 0.7}, "F": [[0], [0], [1], [0]]}


def run(mapping, horizon=40.0, estimator=None, samples=401, **observer):
    system = plant_from_mapping(mapping) if isinstance(mapping, dict) else mapping
    return experiment(system, estimator or {"name": "least_squares"}, horizon, samples, **observer)


def relative_error(result, case=0):
    """Of the state, at every sample."""
    states = result.simulation.states
    error = np.abs(result.estimation.states[case] - states).max(axis=1)
    return error / np.abs(states).max(axis=1)


@lru_cache(maxsize=8)
def observed(name, horizon=20.0, **observer):
    mapping = {"rotating": ROTATING, "unbounded": UNBOUNDED, "mixed": MIXED}.get(name)
    system = shipped(name) if mapping is None else plant_from_mapping(mapping)
    return system, *along(system, horizon, **observer)


def test_the_plant_is_the_one_that_needs_a_remedy():
    system = plant_from_mapping(UNBOUNDED)
    o = observer_matrices(EquationForm.given(system), np.zeros(1), np.zeros(1), 1e-10)
    eigenvalues = np.sort_complex(np.linalg.eigvals(o.dynamics[0]))
    np.testing.assert_allclose(eigenvalues, [0.33, 0.64 - 1.01j, 0.64 + 1.01j], atol=1e-12)


def test_without_a_remedy_the_state_is_lost_and_a_warning_says_so():
    assert relative_error(run(UNBOUNDED))[-1] < 1e-12  # in the form that auto takes
    result = run(UNBOUNDED, form="given")
    assert relative_error(result)[-1] > 0.05
    (warning,) = result.warnings
    assert "1/s" in warning
    assert warning in result.verdict
    assert "form=strangeness_free feeds no output back" in warning
    growth = next(a for a in result.assumptions if a.name == "Growth of Φ")
    assert not growth.holds
    assert growth.evidence["rate"] == pytest.approx(0.64, abs=0.1)


INJECTED = [
    {"name": "least_squares"}, {"name": "ls_drem"}, {"name": "drem"}, {"name": "mre"},
    {"name": "gradient"}, {"name": "lion"}, {"name": "fct"},
]
FOLLOWING = [{"name": "least_squares"}, {"name": "drem"}, {"name": "mre"}]
CASES = [
    *(("output_injection", e) for e in INJECTED),
    *(("reset", e) for e in INJECTED if e["name"] != "gradient"),  # see the test below
    *(("current_coordinates", e) for e in FOLLOWING),
]


@pytest.mark.parametrize(("remedy", "estimator"), CASES)
def test_every_remedy_keeps_the_state(remedy, estimator):
    result = run(UNBOUNDED, estimator=estimator, remedy=remedy)
    late = result.estimation.t >= 39.0
    # Of a gradient law nothing is exact: by then it has come so far.
    limit = 1e-6 if estimator["name"] == "gradient" else 1e-9
    assert relative_error(result)[late].max() < limit
    assert not result.warnings


@pytest.mark.parametrize(
    ("remedy", "estimator"),
    [
        ("output_injection", {"name": "ls_drem"}),
        ("output_injection", {"name": "drem"}),
        ("reset", {"name": "ls_drem"}),
        ("reset", {"name": "mre"}),
        ("current_coordinates", {"name": "least_squares"}),
        ("current_coordinates", {"name": "mre", "gamma": 1000}),
    ],
)
def test_a_state_that_grows_is_kept_too(remedy, estimator):
    result = run(GROWING, estimator=estimator, remedy=remedy)
    assert np.abs(result.simulation.states[-1]).max() > 1e9
    assert relative_error(result)[result.estimation.t >= 20.0].max() < 1e-9


@pytest.mark.parametrize(
    ("remedy", "estimator"),
    [
        ("output_injection", {"name": "ls_drem"}),
        ("reset", {"name": "least_squares"}),
        ("reset", {"name": "ls_drem"}),
        ("reset", {"name": "drem"}),
        ("current_coordinates", {"name": "least_squares", "f0": 1e-12}),
    ],
)
@pytest.mark.parametrize("mapping", [WITH_UNKNOWN, MIXED], ids=["unbounded", "mixed"])
def test_the_unknown_is_found_as_well(mapping, remedy, estimator):
    result = run(mapping, 30.0, estimator=estimator, remedy=remedy)
    assert relative_error(result)[-1] < 1e-9
    theta = result.estimation.parameters[0, -1, 0]
    # Beside a state of 1e5, and with filters that forget within a second, θ has fewer digits.
    assert theta == pytest.approx(0.7, abs=1e-5 if remedy == "current_coordinates" else 1e-7)


def test_a_mixed_signal_is_the_same_up_to_a_reset_and_another_one_from_there_on():
    early, late = (
        run(MIXED, 5.0, estimator={"name": "drem"}, remedy="reset", reset_times=[at]).estimation
        for at in (2.0, 4.0)
    )
    same = np.isclose(early.delta[0], late.delta[0], rtol=1e-6, atol=0.0)
    np.testing.assert_array_equal(same, early.t < 2.0)


def test_least_squares_that_follow_stay_at_their_start_until_data_tell():
    settings = {"name": "least_squares", "f0": None, "initial": 0.3}
    result = run(MIXED, 5.0, estimator=settings, remedy="current_coordinates")
    np.testing.assert_allclose(result.estimation.parameters[0, 0], 0.3, rtol=1e-9)
    assert np.abs(result.estimation.parameters[0, -1, 0] - 0.7) < 1e-4


@pytest.mark.parametrize(("remedy", "estimator"), [
    *(({"remedy": "reset", "reset_interval": 1.5}, name)
      for name in ("ls_drem", "drem", "fct", "least_squares")),
    *(({"remedy": "current_coordinates"}, name) for name in ("drem", "mre", "least_squares")),
])
@pytest.mark.parametrize("column", [0, 1])
def test_an_unknown_that_nothing_tells_keeps_no_other_from_being_estimated(
    remedy, estimator, column
):
    """One that does nothing, or one that does what another does."""
    F = np.array(MIXED["F"], dtype=float)
    twice = {**MIXED, "unknowns": {"theta": 0.7, "second": 0.0}, "F": np.hstack([F, column * F])}
    found, plain = (
        run(each, 6.0, {"name": estimator}, 31, **remedy).estimation
        for each in (twice, MIXED)
    )
    assert np.isnan(found.parameters[0, -1, :2]).tolist() == [bool(column), True]
    size = np.abs(plain.states[0]).max(axis=0)
    assert (np.abs(found.states[0] - plain.states[0])[1:] < 1e-6 * size).all()
    assert found.requirement.holds == plain.requirement.holds


@pytest.mark.parametrize("unbroken", [True, False])
@pytest.mark.parametrize("rate", [-0.5, 0.4])
def test_least_squares_that_follow_say_what_is_left_of_their_start(rate, unbroken, monkeypatch):
    """x' = a x, y = x, from x̂ = 0: without data the error would be x, and it is so much less."""
    monkeypatch.setattr(linear, "_WINDOW", 1 << 20 if unbroken else 2)
    plant = plant_from_mapping(one_state(A=[[rate]]))

    def found(f0):
        run = experiment(plant, {"name": "least_squares", "f0": f0}, horizon=2.0, samples=21,
                         remedy="current_coordinates")
        x = run.simulation.states[-1, 0]
        return run.estimation.requirement, x / abs(run.estimation.states[0, -1, 0] - x) - 1.0

    little, much = found(0.5), found(1e-6)
    assert not little[0].holds
    assert little[0].evidence["alpha_lambda_min_over_f0"] == pytest.approx(little[1], rel=1e-6)
    assert much[0].holds


@pytest.mark.parametrize("remedy", ["reset", "current_coordinates"])
def test_gradient_is_too_slow_for_two_of_them_and_says_so(remedy):
    """With one output the plain gradient cannot pull as fast as errors grow, at any gain."""
    result = run(UNBOUNDED, estimator={"name": "gradient"}, remedy=remedy)
    assert relative_error(result)[-1] > 1e-9
    assert not result.estimation.requirement.holds


@pytest.mark.parametrize("estimator", ["least_squares", "ls_drem", "drem"])
def test_a_time_that_misses_a_reset_by_rounding_is_behind_it(estimator):
    """As x̂ = offset + gain η̂ is: η̂ of before it beside a state map of after it is no state."""
    kept = [
        run(shipped("descriptor"), 5.0, estimator={"name": estimator}, remedy="reset",
            reset_times=[at]).estimation
        for at in (2.0, np.nextafter(2.0, 3.0))
    ]
    one, other = (np.concatenate([e.parameters, e.true_parameters[None]]) for e in kept)
    np.testing.assert_allclose(kept[1].states, kept[0].states, atol=1e-9)
    np.testing.assert_allclose(other, one, atol=1e-9)


@pytest.mark.parametrize("estimator", [{"name": "ls_drem"}, {"name": "drem"}, {"name": "mre"}])
def test_resets_change_nothing_where_none_is_needed(estimator):
    system = shipped("circuit")
    plain = run(system, 20.0, estimator=estimator)
    reset = run(system, 20.0, estimator=estimator, remedy="reset", reset_interval=5.0)
    late = plain.estimation.t >= 18.0
    np.testing.assert_allclose(
        reset.estimation.states[:, late], plain.estimation.states[:, late], atol=1e-9
    )


def test_no_resets_where_nothing_grows():
    """Automatic resets on a stable plant: none, and every number the same."""
    plain = run(shipped("descriptor"), 20.0, estimator={"name": "drem"})
    reset = run(shipped("descriptor"), 20.0, estimator={"name": "drem"}, remedy="reset")
    np.testing.assert_array_equal(reset.estimation.states, plain.estimation.states)
    np.testing.assert_array_equal(reset.estimation.parameters, plain.estimation.parameters)


@pytest.mark.parametrize(
    ("remedy", "estimator"),
    [
        ("output_injection", {"name": "ls_drem"}),
        ("reset", {"name": "ls_drem"}),
        ("reset", {"name": "mre"}),
        ("current_coordinates", {"name": "least_squares"}),
        ("current_coordinates", {"name": "drem", "gamma": 1e12}),
    ],
)
def test_a_kernel_that_rotates(remedy, estimator):
    more = {"reset_times": [3.0, 8.0]} if remedy == "reset" else {}
    result = run(ROTATING, 20.0, estimator=estimator, remedy=remedy, **more)
    assert relative_error(result)[-1] < 1e-9


@pytest.mark.parametrize("remedy", ["none", "reset", "output_injection", "current_coordinates"])
def test_a_kernel_that_rotates_leaves_the_papers_regression_its_outputs(remedy):
    """Its last r rows are about the outputs; in current coordinates there are further rows."""
    plant = {**ROTATING, "outputs": list("klmn"), "C": np.eye(4).tolist()}
    result = run(plant, 5.0, regression="paper", remedy=remedy)
    assert result.excitation.is_ie
    assert relative_error(result)[-1] < 1e-6
    rows = 8 if remedy == "current_coordinates" else 4
    assert result.regression.psi.shape[1] == rows


@pytest.mark.parametrize("sign", [1, -1])
def test_that_a_kernel_has_no_part_in_w_weighs_as_much_as_outputs_do(sign):
    """Rows c Q w = 0 of a projector Q in comparable units; c is as large as ψ is at first.

    Whatever the signs of constraints and outputs are.
    """
    plant = {**ROTATING, "initial_state": dict.fromkeys(ROTATING["states"], 0.0)}
    *moving, first, second, output = *plant["A"], *plant["C"]
    first, second, output = ([f"{sign}*({x})" for x in row] for row in (first, second, output))
    plant |= {"A": [*moving, first, second], "B": [[0], [0], [-sign], [0]], "C": [output]}
    given = Units(10.0 ** np.array([3, 0, -4, 1]), *map(np.ones, (1, 1, 1, 4)), 1.0)
    _, observation = along(
        plant_from_mapping(in_units(plant, given)), 5.0, remedy="current_coordinates"
    )
    t, regression = np.linspace(0.0, 5.0, 11), observation.regression
    psi = regression.psi(t) * regression.dynamics.units
    size = np.trace(psi[0, :4, 1:]) / 2.0
    Q = psi[:, :4, 1:] / size
    np.testing.assert_allclose(Q @ Q, Q, atol=1e-12)
    assert not psi[:, :4, 0].any()
    assert 1.0 <= size / np.abs(psi[0, 4:]).max() < 3.0


@pytest.mark.parametrize("swings", [0, 1, 2])
@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_the_dynamics_of_current_coordinates_are_resolved_in_any_unit_of_time(swings, unit):
    """D_0, A_0 or b_0 along signals that rest: nothing else asks for elements."""
    w, size = 20.0 / unit, np.array([0.02, -0.1, 0.05]) / unit
    texts = [f"{c!r}*(2 + {k == swings:d}*sin({w!r}*t))" for k, c in enumerate(size.tolist())]
    system = plant_from_mapping(one_state(
        A=[[texts[1]]], unknowns={"k": 0}, F=[[texts[0]]], inputs={"u": 1}, B=[[texts[2]]],
    ))
    mesh = initial_mesh(0.0, 2.0 * unit, [], 1, radau_rule(5))
    u, y = (Trajectory(mesh, np.full((1, 6, 1), value)) for value in (1.0, 0.0))
    found = observe(system, Measurements(u, y), remedy="current_coordinates").regression.dynamics
    t = np.linspace(0.0, 2.0 * unit, 99)[:, None]
    expected = size * (2.0 + (np.arange(3) == swings) * np.sin(w * t))
    np.testing.assert_allclose(found.rows(t[:, 0])[:, 0], expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["unbounded", "rotating", "mixed"])
def test_the_regression_holds_in_every_segment(name):
    """Y = ψη and x = offset + gain η with the true parameters of each time, and T η + τ."""
    system, signals, observation = observed(name, remedy="reset", reset_interval=4.0)
    t = np.linspace(0.0, 20.0, 401)
    assert [reset.time for reset in observation.regression.resets] == [4.0, 8.0, 12.0, 16.0]
    assert max(left_of_identities(system, signals, observation, t)) < 1e-9
    eta = observation.truth(t, system.theta_at(t), signals.states)
    for reset in observation.regression.resets:
        before = eta[np.searchsorted(t, reset.time) - 1]
        after = eta[np.searchsorted(t, reset.time)]
        np.testing.assert_allclose(reset.parameters(before), after, atol=1e-8)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_reset_starts_from_what_all_segments_before_it_have_shown(sign):
    """One of a hundredth of a second shows little: the state is what those before it tell."""
    system = plant_from_mapping({
        **MIXED, "inputs": {"u": f"{sign}*(2 + sin(t))"}, "unknowns": {"theta": 0.7 * sign},
        "initial_state": [sign, sign, 0.5 * sign],
    })
    signals, observation = along(system, 20.0, remedy="reset", reset_times=[6.0, 6.01])
    eta = observation.truth(np.array([6.02]), system.theta[None], signals.states)
    assert eta[0, 0] == 0.7 * sign
    np.testing.assert_allclose(eta[0, 1:], 0.0, atol=1e-7)  # errors of the new start
    for reset in observation.regression.resets:  # what is rounding beside the largest of θ and w
        size = np.abs(np.append(signals.states(np.array([reset.time])), system.theta)).max()
        assert 1e-4 < reset.floor / size < 1e-2


@pytest.mark.parametrize("plant", [one_state(A=[[1]]), one_state(
    states=["a", "b"], E=[[1, 0], [0, 1]], A=[[0.6, 2], [0, 0.3]], C=[[1, 0]], initial_state=[1, 1],
)], ids=["one", "two"])
def test_resets_come_at_the_last_edge_before_the_extension_exceeds_a_hundred(plant):
    """‖Φ‖₂ of Φ = e^{At}, from one reset to the next."""
    system = plant_from_mapping(plant)
    signals, found = along(system, 15.0, remedy="reset")
    times, edges = [0.0], signals.inputs.mesh.edges
    times += [reset.time for reset in found.regression.resets]
    assert len(times) > 2
    for before, time in pairwise(times):
        after = edges[np.searchsorted(edges, time + 1e-9)]
        there, too_late = (
            np.linalg.norm(expm(np.array(plant["A"]) * (t - before)), 2) for t in (time, after)
        )
        assert there <= 100.0 * (1.0 + 1e-5)
        assert too_late > 100.0 * (1.0 - 1e-5)


def test_growth_is_that_of_the_longest_segment():
    """Of e^t over one, two and one seconds; the rate is that of the norms of all three."""
    plant = plant_from_mapping(one_state(
        states=["a", "b"], E=[[1, 0], [0, 1]], A=[[1, 0], [1, 0]], C=[[0, 1]], initial_state=[1, 0]
    ))
    found = along(plant, 4.0, remedy="reset", reset_times=[1.0, 3.0])[1]
    assert found.growth == pytest.approx(np.exp(2.0), rel=1e-8)
    norms = [np.linalg.norm(expm(np.array([[1, 0], [1, 0]]) * t), 2) for t in (1.0, 2.0, 1.0)]
    assert found.growth_rate == pytest.approx(np.log(norms).sum() / 4.0, rel=1e-8)


def test_the_gram_matrix_goes_on_through_a_reset():
    system, signals, observation = observed("mixed", remedy="reset", reset_interval=4.0)
    regression = observation.regression
    start = np.array([r.time for r in regression.resets])
    theta = np.broadcast_to(system.theta, (len(start), 1))
    eta = observation.truth(start, theta, signals.states)
    values = regression.gram(start)  # of the segment that begins
    residual = np.einsum("mij,mj->mi", values[..., :-1], eta) - values[..., -1]
    assert np.abs(residual).max() < 1e-9 * np.abs(values[..., :-1]).max()
    assert np.linalg.eigvalsh(values[..., :-1]).min() > 0.0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 5), st.booleans())
def test_transport_of_an_extension(seed, p, gram):
    """Ωη = 𝒴 stays true under any T and τ; a Gram matrix becomes T⁻ᵀGT⁻¹."""
    rng = np.random.default_rng(seed)
    eta, shift = rng.normal(size=(2, p))
    transform = rng.normal(size=(p, p)) + 3 * np.eye(p)
    omega = rng.normal(size=(p, p)) + 2 * np.eye(p)
    if gram:
        omega = omega.T @ omega
    reset = Reset(1.0, transform, shift, 0.0)
    state = ExtensionState(np.column_stack([omega, omega @ eta]), 1e12)
    after = state.after(reset).values
    inverse = np.linalg.inv(transform)
    expected = inverse.T @ omega @ inverse
    scale = np.abs(expected).max() * np.linalg.cond(transform) * np.linalg.cond(omega)
    np.testing.assert_allclose(after[:, :-1], expected, atol=1e-13 * scale)
    residual = after[:, :-1] @ reset.parameters(eta) - after[:, -1]
    assert np.abs(residual).max() < 1e-12 * scale * (1 + np.abs(reset.parameters(eta)).max())


def test_what_a_reset_mixes_with_others_does_not_go_on_as_it_is():
    transform = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]])
    reset = Reset(1.0, transform, np.zeros(3), 0.0)
    assert reset.leaves(np.array([True, True, False]))
    assert not reset.leaves(np.array([False, True, True]))


@pytest.mark.parametrize("gram", [True, False])
def test_knowledge_of_what_has_decayed_is_bounded(gram):
    """T shrinks one direction to nothing: it is known as well as the limit allows, no better."""
    transform = np.diag([50.0, 1.0, 1e-30])
    eta = np.array([1.0, -2.0, 0.5])
    omega = np.array([[2.0, 0.5, 0.0], [0.5 + 1e-15, 1.0, 0.3], [0.0, 0.3, 1.0]])  # with rounding
    omega[2, 1] *= 1.0 if gram else -2.0
    known, level = np.column_stack([omega, omega @ eta]), np.full(3, 2.0 / 3.0)
    state = ExtensionState(known, level, surplus=10.0)
    reset = Reset(1.0, transform, np.array([0.1, 0.2, 0.3]), 0.0)
    after = state.after(reset).values
    assert np.linalg.norm(after[:, :-1], 2) <= 20.0 * np.sqrt(3)
    if gram:
        assert np.linalg.eigvalsh(after[:, :-1]).min() > 1e-5  # and the others are still known
        np.testing.assert_allclose(after[:, :-1], after[:, :-1].T, rtol=1e-12)
    np.testing.assert_allclose(
        np.linalg.solve(after[:, :-1], after[:, -1]), reset.parameters(eta),
        atol=1e-10 if gram else 1e-3,
    )


def test_what_nothing_is_known_of_stays_unknown_through_a_reset():
    """Rounding of the other parameters is no knowledge of one that stands alone."""
    omega = np.array([[2e6, 0.0, 1e6], [0.0, 0.0, 0.0], [1e6, 0.0, 3e6]])
    state = ExtensionState(np.column_stack([omega, omega @ [1.0, 5.0, -2.0]]), np.full(3, 1e7))
    transform = np.array([[1.1, 0.0, 0.3], [0.0, 1.0, 0.0], [-0.7, 0.0, 0.9]])
    after = state.after(Reset(1.0, transform, np.array([0.1, 0.2, 0.3]), 0.0)).values
    assert not after[1].any()
    assert not after[:, 1].any()


def with_a_reset_to_the_same():
    """A regression, and the same with T = I, τ = 0 on the way."""
    plain = make_regression(three, ETA)
    resets = (Reset(float(plain.mesh.edges[30]), np.eye(3), np.zeros(3), 0.0),)
    return plain, type(plain)(plain.Y, plain.psi, plain.parameters, plain.scale, resets)


@pytest.mark.parametrize("p", [3, 17])
@pytest.mark.parametrize("factor", [None, 1.0, 2.0])
def test_what_is_known_at_the_end_is_that_of_every_time_there(p, factor):
    """Of many parameters it is made without that of all times, unless there are resets."""
    made = make_regression(
        lambda t: np.cos(np.asarray(t)[..., None] * np.arange(1.0, p + 1.0)), np.ones(p)
    )
    if factor is not None:
        at = float(made.mesh.edges[30])
        made = replace(made, resets=(Reset(at, factor * np.eye(p), np.zeros(p), 0.0),))
    final = made.gram_final
    np.testing.assert_allclose(final, made.gram.final, atol=1e-10)
    np.testing.assert_allclose(made.gram_at(np.array([10.0]))[0], final, atol=1e-10)


def test_a_long_regression_with_resets_or_many_seeds_is_taken_as_a_whole(monkeypatch):
    monkeypatch.setattr(linear, "_WINDOW", 16)
    plain, cut = with_a_reset_to_the_same()
    seeds = replace(plain, Y=Trajectory(plain.mesh, plain.Y.values[..., None] * np.ones(2)))
    assert [len(list(each.windows())) for each in (plain, cut, seeds)] == [5, 1, 1]
    edges = plain.mesh.edges
    whole = replace(plain).gram(edges)
    np.testing.assert_allclose(plain.gram_at(edges), whole, atol=1e-10)


def test_windows_of_excitation_run_through_resets():
    """Behind each reset to η₊ = Tη a level is that of the plain regression's T⁻ᵀGT⁻¹."""
    plain = make_regression(three, ETA)
    edges, at = plain.mesh.edges, (16, 40, 41)
    transform = np.array([[1.2, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.3, 0.8]])
    resets = tuple(Reset(float(edges[k]), transform, np.zeros(3), 0.0) for k in at)
    before = np.array([np.linalg.matrix_power(np.linalg.inv(transform), k) for k in range(4)])
    psi = plain.psi.values @ before[np.searchsorted(at, np.arange(len(edges) - 1), "right"), None]
    cut = type(plain)(
        plain.Y, Trajectory(plain.mesh, psi), plain.parameters, plain.scale, resets
    )
    t = np.linspace(0.0, 10.0, 57)
    whole = t >= 3.0
    G = (plain.gram(t[whole]) - plain.gram(t[whole] - 3.0))[..., :3]
    inverse = before[(t[whole, None] > edges[list(at)]).sum(axis=1)]
    expected = np.linalg.eigvalsh(np.swapaxes(inverse, 1, 2) @ G @ inverse)[:, 0]
    level = window_level([[segment.outer] for segment in cut.segments], t, 3.0, cut.resets)
    assert np.isnan(level[~whole]).all()
    np.testing.assert_allclose(level[whole], expected, rtol=1e-9)
    final = before[3].T @ plain.gram.final[:, :3] @ before[3]
    np.testing.assert_allclose(cut.gram.final[:, :3], final, atol=1e-11)


def test_the_bound_of_what_has_decayed_is_in_units_of_the_data():
    """T shrinks a direction, and ψ and Y are in units of one and of 1e-6."""
    plain = make_regression(three, ETA)
    resets = (Reset(float(plain.mesh.edges[30]), np.diag([1.0, 2.0, 1e-9]), np.zeros(3), 0.0),)
    grams = []
    for unit in (1.0, 1e6):
        Y, psi = (Trajectory(plain.mesh, x.values / unit) for x in (plain.Y, plain.psi))
        cut = type(plain)(Y, psi, plain.parameters, plain.scale / unit, resets)
        grams.append(cut.gram.final * unit**2)
    np.testing.assert_allclose(*grams, rtol=1e-9)


def test_an_unknown_whose_value_nobody_knows_spoils_no_other():
    """The errors of the extension behind resets do not need θ, as long as it is constant."""
    two = {**MIXED, "unknowns": {"a": 0.7, "b": 0.2}, "F": [[1, 0], [0, 1], [0, 0]]}
    system = plant_from_mapping(two)
    signals, found = along(system, 10.0, remedy="reset", reset_interval=4.0)
    truth = found.truth
    t = np.linspace(0.0, 10.0, 11)
    known, partly = (np.tile(theta, (11, 1)) for theta in ([0.7, 0.2], [0.7, np.nan]))
    found = truth(t, partly, signals.states)[:, 2:]
    np.testing.assert_array_equal(found, truth(t, known, signals.states)[:, 2:])
    assert np.isfinite(found).all()


@pytest.mark.parametrize(
    "name", ["drem", "mre", "lion", "gradient", "least_squares", "ls_drem", "fct", "power"]
)
def test_a_reset_to_the_same_parameters_changes_nothing(name):
    """Every estimator goes on where it was, but for its prior."""
    plain, cut = with_a_reset_to_the_same()
    estimator = estimators.build({"name": name})
    t = np.linspace(0.0, 10.0, 41)
    expected = estimators.estimate(estimator, plain, t).parameters(slice(None))
    found = estimators.estimate(estimator, cut, t).parameters(slice(None))
    late = t >= 8.0 if name in ("least_squares", "fct") else t >= 0.0
    np.testing.assert_allclose(found[:, late], expected[:, late], atol=1e-5)


@pytest.mark.parametrize(
    "settings_of_estimator",
    [{"beta": 0.3}, {"beta": 0.3, "f0": 0.01, "bound": 1e3}, {"beta": 0.0}],
)
def test_memory_is_carried_through_a_reset(settings_of_estimator):
    plain, cut = with_a_reset_to_the_same()
    estimator = estimators.build({"name": "least_squares", **settings_of_estimator})
    t = np.array([0.0, 10.0])
    expected = estimators.estimate(estimator, plain, t).reached[0]
    found = estimators.estimate(estimator, cut, t).reached[0]
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-9, atol=1e-9)
    assert found.memory == pytest.approx(expected.memory, rel=1e-9)


@pytest.mark.parametrize(("beta", "f0"), [(0.1, 1e3), (0.5, 1.0), (0.5, 1e-2)])
def test_what_is_left_of_the_prior_of_a_state_is_told_where_data_are_forgotten(beta, f0):
    """x' = 0 and ψ = 1: α G_z = (1 − e^(−β t))/β beside e^(−β t) f0."""
    observer = {"name": "gpebo", "remedy": "current_coordinates"}
    found = api_run(
        one_state(A=[[0]]), observer=observer, estimator="least_squares", beta=beta, f0=f0,
        time={"horizon": 3, "samples": 3},
    ).details.estimation.requirement
    ratio = np.expm1(3 * beta) / (beta * f0)
    assert found.holds == (ratio > 99.0)
    if not found.holds:
        assert found.evidence["alpha_lambda_min_over_f0"] == pytest.approx(ratio, rel=1e-6)


def test_what_cancels_but_for_rounding_is_not_resolved():
    """The kernel of E rotates, and b_0, which vanishes, is what products of the matrices leave."""
    observer = {"name": "gpebo", "remedy": "current_coordinates"}
    result = api_run("published/brenan", observer=observer, estimator="least_squares")
    assert result.details.regression.error_estimate < 1e-10
    np.testing.assert_allclose(result["x2_hat"][0, -1], np.sin(20.0), atol=1e-10)


def test_filters_in_current_coordinates_hold_the_state():
    """Ωζ = 𝒴 for the true ζ, at every point, with rates that differ by row."""
    system, signals, observation = observed("mixed", remedy="current_coordinates")
    regression = observation.regression
    rates = np.array([0.1, 0.2, 0.3, 0.4])
    both = filtered(regression.outer, rates, rates, regression.dynamics)
    t = np.linspace(0.0, 20.0, 201)
    zeta = observation.truth(t, np.broadcast_to(system.theta, (201, 1)), signals.states)
    values = both(t)
    residual = np.einsum("mij,mj->mi", values[..., :-1], zeta) - values[..., -1]
    gram = regression.gram(t[1:])
    np.testing.assert_allclose(  # rounding is a share of what there is, however little that is
        regression.rounding_of(1e-9 * gram, t[1:]), 1e-9 * regression.rounding_of(gram, t[1:]),
        rtol=1e-12,
    )
    units = np.array([1.0, 10.0, 0.1, 5.0])
    other = replace(regression, dynamics=replace(regression.dynamics, units=units))
    largest = (np.einsum("mjj->mj", gram[..., :4]) * units**2).max(axis=1)
    expected = 1e-12 * np.outer(largest, units**-2)
    np.testing.assert_allclose(other.rounding_of(gram, t[1:]), expected, rtol=1e-12)
    size = np.linalg.norm(values[..., :-1], axis=(1, 2)) * np.linalg.norm(zeta, axis=1)
    assert (np.abs(residual).max(axis=1) <= 1e-10 * size.max()).all()
    expected = (*system.unknowns, "w_x1", "w_x2", "w_x3")
    assert observation.parameters == expected


def test_resets_are_at_the_last_edges_before_too_much_growth():
    """Of x' = (12 − 2 t) x, whose logarithm grows by 12 t − t², in the first element too much."""
    edges, one = np.linspace(0.0, 6.0, 13), np.eye(1)
    reduced = SimpleNamespace(
        mesh=Mesh(edges, radau_rule(5)), units=np.ones(1), system=SimpleNamespace(name="p"),
        matrices=lambda t, _: SimpleNamespace(dynamics=12.0 - 2.0 * t[:, None, None]),
        solver=SolverSettings(), begin=SimpleNamespace(basis=one),
        first=SimpleNamespace(split=SimpleNamespace(dual=one)),
    )
    expected, last = [], 0.0
    for before, after in pairwise(edges.tolist()):
        if before > 0.0 and (12.0 - after - last) * (after - last) > np.log(resetting._GROWTH):
            last = before
            expected.append(last)
    assert expected[:2] == [0.5, 1.0]
    assert np.ptp(np.diff(expected)) > 0.4
    assert resetting.growth_times(reduced).tolist() == expected


def test_a_gain_of_ones_own_moves_the_eigenvalues():
    """E = I: w' = (A − L C) w + …, so Φ(T) = exp((A − L C) T)."""
    gain = [[2.5], ["1 + 0*t"], [0.3]]
    system = plant_from_mapping(GROWING)
    _, observation = along(system, 5.0, remedy="output_injection", injection=gain)
    Phi = expm(5.0 * (np.array(GROWING["A"]) - np.array([[2.5], [1], [0.3]]) @ GROWING["C"]))
    np.testing.assert_allclose(
        observation.state_map.gain(np.array([5.0]))[0], -Phi, atol=1e-10
    )


def test_the_automatic_gain_is_that_of_its_riccati_equation():
    """E = I: Φ' = (A − S CᵀWC) Φ with W of the weights, by scipy together with S."""
    turning, rows = "1 + 0.5*sin(2*t)", np.array([[1.0, 0.5], [0.0, 1.0]])
    system = plant_from_mapping({
        "name": "turning", "states": ["a", "b"], "outputs": ["y", "z"], "E": [[1, 0], [0, 1]],
        "A": [[0.3, turning], [-1, 0.2]], "C": rows.tolist(), "initial_state": [1, 1],
    })
    W = rows.T @ np.diag([1.0, 0.25]) @ rows

    def A(t):
        return np.array([[0.3, 1.0 + 0.5 * np.sin(2.0 * t)], [-1.0, 0.2]])

    def slope(t, v):
        S, Phi = v.reshape(2, 2, 2)
        driven = 0.01 * (A(t) @ A(t).T + 0.01 * (A(t) ** 2).sum() * np.eye(2))
        dS = A(t) @ S + S @ A(t).T + driven - S @ W @ S
        return np.concatenate([dS, (A(t) - S @ W) @ Phi]).ravel()

    start = np.concatenate([np.real(sqrtm(A(0.0) @ A(0.0).T)), np.eye(2)]).ravel()
    t = np.linspace(0.0, 6.0, 13)
    expected = solve_ivp(slope, (0.0, 6.0), start, t_eval=t, rtol=1e-10, atol=1e-13).y[4:].T
    _, found = along(system, 6.0, remedy="output_injection", weights={"z": 0.5, "y": 2})
    gain = found.state_map.gain(t).reshape(-1, 4)
    np.testing.assert_allclose(gain, -expected, atol=1e-6 * np.abs(expected[-1]).max())


def test_the_automatic_gain_does_not_depend_on_units():
    """Time in milliseconds and the output in other units: Φ decays as much over the horizon."""
    slow = observed("unbounded", 10.0, remedy="output_injection")[2]
    A = [[1000 * x for x in row] for row in UNBOUNDED["A"]]
    fast = plant_from_mapping({
        **UNBOUNDED, "A": A, "B": [[0], [0], [0], [1000]],
        "inputs": {"u": "sin(1000*t) + cos(2300*t)/2"},
        "C": [[x * 1e6 for x in UNBOUNDED["C"][0][:3]] + [1e6]],
    })
    system = plant_from_mapping(UNBOUNDED)
    ratio = []
    for plant, horizon in ((system, 10.0), (fast, 0.01)):
        _, o = along(plant, horizon, remedy="output_injection")
        ratio.append(o.growth_rate * horizon)
    assert ratio[0] < 0.0
    assert slow.growth_rate * 10.0 == pytest.approx(ratio[0], rel=1e-6)
    assert ratio[1] == pytest.approx(ratio[0], rel=1e-6)


def test_a_fundamental_matrix_beyond_all_bounds_ends_in_one_line():
    plant = plant_from_mapping({**GROWING, "A": [[9, 1, 0], [-1, 9, 0.2], [0, 0, 8]]})
    said = r"A_0 is unstable; use observer\.remedy=.* of observer=gpebo, or a shorter"
    with pytest.raises(SolverError, match=said):
        along(plant)


@pytest.mark.parametrize(
    ("observer", "message"),
    [
        ({"name": "canonical", "remedy": "reset"}, "observer.remedy: no such key"),
        ({"reset_interval": 5.0}, "observer.reset_interval is of observer.remedy=reset"),
        ({"remedy": "reset", "sample_time": 0.1}, "works in continuous time only"),
        ({"name": "kalman_bucy", "remedy": "reset"}, "observer.remedy: no such key"),
        ({"reset_keep": 0.5}, "observer.reset_keep is of observer.remedy=reset"),
        ({"remedy": "reset", "injection": [[1.0]]}, "of observer.remedy=output_injection"),
        ({"remedy": "reset", "reset_times": [0.0]}, "not between start and end, 0 and 20"),
        ({"remedy": "reset", "reset_interval": 1e-5}, "at most 10000"),
        ({"remedy": "output_injection", "injection": [[1.0]]}, "needs 4 (states) of 1 (outputs)"),
        ({"remedy": "output_injection", "injection": [["a"], [0.0], [0.0], [0.0]]},
         "observer.injection[0][0]"),
    ],
)
def test_settings_that_do_not_fit(observer, message):
    system = plant_from_mapping(UNBOUNDED)
    with refused(message):
        examine(Settings(estimator={}, observer={"name": "gpebo", **observer}), system)


@pytest.mark.parametrize("remedy", ["output_injection", "reset"])
def test_many_seeds_are_one_run_per_seed_with_every_remedy(remedy):
    """With output injection they are one more right-hand side, with resets a run each."""
    def settings_of(seed, seeds):
        return Settings(
            estimator={"name": "ls_drem"}, time=TimeSettings(horizon=10.0),
            observer={"name": "gpebo", "remedy": remedy},
            noise=NoiseSettings(outputs=0.01, sample_time=0.1, seed=seed, seeds=seeds),
        )

    system = plant_from_mapping(UNBOUNDED)
    found = run_experiment(settings_of(0, 3), system).noise
    single = [run_experiment(settings_of(seed, 1), system).estimation for seed in range(3)]
    errors = np.array([e.parameters[:, -1] - e.true_parameters[-1] for e in single])
    np.testing.assert_allclose(found.bias, errors.mean(axis=0), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found.deviation, errors.std(axis=0, ddof=1), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("remedy", ["output_injection", "reset", "current_coordinates"])
def test_remedies_bear_noise_and_weights(remedy):
    """The error of the state stays near the noise, where without a remedy it grows with Φ."""
    noise = NoiseSettings(outputs=1e-4, sample_time=0.05)
    results = [
        run_experiment(
            Settings(
                estimator={"name": "least_squares"}, noise=noise,
                time=TimeSettings(horizon=40.0, samples=201),
                observer={"name": "gpebo", "form": "given", "remedy": kind, "weights": [2.0]},
            ),
            plant_from_mapping(UNBOUNDED),
        )
        for kind in (remedy, "none")
    ]
    kept, lost = (relative_error(result)[-1] for result in results)
    assert kept < 0.05
    assert lost > 1e3 * kept


def test_filters_forget_as_fast_as_the_plant_and_not_as_w_is_held_on_constraints():
    """Of index 3, with noise: the force and the load were lost, as windows were too short."""
    arm = {
        "name": "arm", "states": ["q1", "q2", "w1", "w2", "force"], "unknowns": {"load": 0.7},
        "E": np.diag([1, 1, 3, 1, 0]).tolist(), "F": [[0], [0], [1], [0.5], [0]],
        "A": [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [-5, 0, -1, 0, 1], [0, -5, 0, -1, 2],
              [1, 2, 0, 0, 0]],
        "phi": [0, 0, "sin(2*t)", "cos(3*t)", 0], "outputs": ["a", "b"],
        "C": [[1, 0, 0, 0, 0], [0, 0, 1, 0.2, 0]], "initial_state": [0.5, -0.25, 0, 0, 0],
    }
    noise = NoiseSettings(outputs=1e-3, sample_time=0.1)
    result = run_experiment(Settings(
        estimator={"name": "least_squares"}, noise=noise, time=TimeSettings(0.0, 3.0, 41),
        observer={"name": "gpebo", "remedy": "current_coordinates"},
    ), plant_from_mapping(arm))
    assert relative_error(result)[20:].max() < 0.03
    assert result.estimation.parameters[0, -1, 0] == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize("more", [
    {"phi": ["2 + sin(t)"]}, {"unknowns": {"a": 2.0}, "F": [["2 + sin(t)"]]},
])
def test_states_without_derivatives_leave_nothing_that_moves(more):
    """ζ = θ, or nothing at all."""
    plant = one_state(E=[[0]], A=[[-1]], **more)
    result = run(plant, 5.0, estimator={"name": "drem"}, remedy="current_coordinates")
    assert relative_error(result)[100:].max() < 1e-6


class Outsider:
    """An estimator of another package, with no more than the protocol."""

    cases = ({},)

    def estimate(self, regression, t):
        return estimators.build({"name": "ls_drem"}).estimate(regression, t)


@pytest.mark.parametrize(
    ("remedy", "message"),
    [("reset", "go on after a reset"), ("current_coordinates", "follow a state")],
)
def test_estimators_of_other_packages_are_refused_where_they_cannot_go_on(remedy, message):
    settings_of = Settings(
        estimator={}, time=TimeSettings(horizon=20.0),
        observer={"name": "gpebo", "remedy": remedy},
    )
    with pytest.raises(ConfigError, match=message):
        run_experiment(settings_of, plant_from_mapping(UNBOUNDED), estimator=Outsider())


def test_without_an_observer_an_estimator_that_is_given_is_not_asked():
    found = run_experiment(
        Settings(estimator={}, time=TimeSettings(horizon=1.0), observer={"name": "none"}),
        plant_from_mapping(UNBOUNDED), estimator=Outsider(),
    )
    assert found.simulation.t[-1] == 1.0
    assert found.estimation is None


@pytest.mark.parametrize("name", ["ls_drem", "lion", "fct"])
def test_estimators_that_cannot_follow_are_refused(name):
    with pytest.raises(ConfigError, match="these can: drem, gradient, least_squares, mre"):
        run(UNBOUNDED, 5.0, estimator={"name": name}, remedy="current_coordinates")


@pytest.mark.parametrize("name", ["drem", "ls_drem", "power"])
def test_between_two_resets_there_may_be_no_output_time(name):
    """Δ at 0 and 1 s is that of a run with more output times; both resets are between these."""
    few, many = (
        api_run(
            "descriptor", estimator=name, time={"horizon": 2, "samples": samples},
            observer={"remedy": "reset", "reset_times": [1.2, 1.4]},
        ).details.estimation.delta for samples in (3, 21)
    )
    assert few[0] == pytest.approx(many[0, ::10], rel=1e-9, abs=1e-300)


@pytest.mark.parametrize("name", ["least_squares", "ls_drem", "drem", "mre"])
def test_a_reset_that_keeps_nothing_follows_a_step_of_an_unknown(name):
    """θ steps at 10; learnt anew from there on it is exact, and without that it is not."""
    system = shipped("descriptor", unknowns={"theta1": "1.5 + step(t - 10)", "theta2": -0.8})
    gain = {"drem": {"gamma": 1e16}, "mre": {"gamma": 1e3}}.get(name, {})
    estimator = {"name": name, **gain}
    anew = {"remedy": "reset", "reset_times": [10.0], "reset_keep": 0.0}
    followed = run(system, 30.0, estimator=estimator, **anew)
    kept = run(system, 30.0, estimator=estimator)
    assert followed.estimation.true_parameters[-1, 0] == 2.5
    assert followed.estimation.parameters[0, -1, 0] == pytest.approx(2.5, abs=1e-4)
    assert relative_error(followed)[-1] < 1e-4
    assert relative_error(kept)[-1] > 100 * relative_error(followed)[-1]


def test_command_warns_on_stderr_and_in_the_summary(tmp_path):
    words = [
        "run", "--config-dir", str(EXAMPLES), "plant=unbounded", "time.horizon=40", "figures=none",
        "estimator=least_squares", "observer.form=given", "hydra.run.dir=out",
    ]
    done = gpebo(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("gpebo: warning: Φ has grown to ")
    warning = line.removeprefix("gpebo: warning: ")
    assert warning in done.stdout.splitlines()[-1]
    page = Path(__file__).parents[1] / "docs" / "howto" / "unstable.md"
    assert warning in " ".join(page.read_text(encoding="utf-8").split())
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["warnings"] == [warning]
    done = gpebo(*words, "observer.remedy=reset", cwd=tmp_path)
    assert done.returncode == 0
    assert not done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["warnings"] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["observer.remedy=resets"], "did you mean reset?"),
        (["observer.remedy=reset", "observer.reset_interval=-1"], "expected a positive number"),
        (["observer.remedy=current_coordinates", "estimator=lion"], "estimator that can follow"),
        (["observer.remedy=output_injection", "observer.injection=[[1,2],[3]]"], "6 (states)"),
    ],
)
def test_command_refuses_in_one_line(words, message, tmp_path):
    done = gpebo("run", "plant=circuit", "figures=none", *words, cwd=tmp_path)
    assert_refused(done, message)


def test_resets_are_at_edges_between_the_start_and_the_end():
    """Near an edge that is there, they are at that one."""
    times = np.array([0.0, 0.5, 1.0 + 1e-12, 2.0])
    mesh, times = _with_edges(initial_mesh(0.0, 2.0, [], 2, radau_rule(3)), times)
    assert (mesh.edges.tolist(), times.tolist()) == ([0.0, 0.5, 1.0, 2.0], [0.5, 1.0])


def test_an_injection_that_is_not_found_asks_for_one(monkeypatch):
    """It named settings of the Kalman-Bucy filter."""
    monkeypatch.setattr("gpebo_cli.observers._riccati._FALL", 0.0)
    with pytest.raises(SolverError, match=r"a double; give the gain, observer\.injection, or"):
        run(GROWING, 1.0, remedy="output_injection")


@np.errstate(all="ignore")
def test_filters_forget_twice_as_fast_as_what_has_decayed_fastest_so_far():
    """In levels of which 96 are a decade; decays, once a hundredth of their time has passed."""
    mesh = initial_mesh(0.0, 4.0, [], 40, radau_rule(9))
    t = mesh.points
    rows = np.zeros((*t.shape, 2, 3))
    rows[..., 0, 0], rows[..., 1, 1] = 0.5 * np.cos(t), np.sin(1.5 * t) * (1.0 + t)
    moves = Dynamics(Trajectory(mesh, rows), np.ones(2))
    at = np.linspace(0.01, 3.99, 200)
    decay = -np.minimum(0.5 * np.cos(at), np.sin(1.5 * at) * (1.0 + at))
    fastest = np.maximum.accumulate(np.where(decay * at > 0.01, decay, 0.0))
    times, levels = moves.forgetting
    found = 0.5 * levels[np.searchsorted(times, at)]
    step, some = 10.0 ** (1.0 / 96.0), fastest > 0.0
    assert not found[~some].any()
    assert (found[some] >= fastest[some]).all()
    before = np.maximum.accumulate(np.append(fastest[1:], fastest[-1]))  # between two times
    assert (found[some] <= step * before[some]).all()
    rises = np.maximum(np.maximum(0.5 * np.cos(t), np.sin(1.5 * t) * (1.0 + t)), 0.0)
    expected = Trajectory(mesh, rises).integral().final
    assert moves.growth == pytest.approx(expected, rel=1e-12)


def test_filters_that_forget_fast_take_more_stages_than_a_recording_has():
    """Its elements are not cut for e^{−1000 t}."""
    mesh = initial_mesh(0.0, 0.2, [], 100, radau_rule(3))
    rows = Trajectory(mesh, np.full((100, 4, 1, 2), [-500.0, 0.0]))
    outer = Trajectory(mesh, np.ones((100, 4, 1, 2)))
    found = filtered(outer, np.zeros(1), np.ones(1), Dynamics(rows, np.ones(1)))
    assert found.mesh.size < 500


@pytest.mark.parametrize("growth", [0.0, 1e3])
@np.errstate(all="ignore")
def test_filters_of_parameters_that_move_are_the_same_in_short_and_in_any_elements(
    growth, monkeypatch
):
    """Ω' = −(Λ + ρI + 𝔸ᵀ)Ω − Ω𝔸 + Γψᵀψ and 𝒴 likewise, by another solver; ρ changes."""
    monkeypatch.setattr(dynamics, "_GROWTH", growth)
    rates, gains = np.array([0.1, 0.7]), np.array([2.0, 3.0])
    mesh = initial_mesh(0.0, 4.0, [], 40, radau_rule(9))

    def signals(t):
        A = np.array([[0.3 * np.cos(t), 1.0 + 0.0 * t], [-1.0 - 0.0 * t, -1.0 - 0.2 * t]])
        psi = np.array([1.0 + 0.0 * t, np.sin(3.0 * t)])
        return A, np.array([np.sin(t), np.cos(t)]), psi[:, None] * np.array([*psi, np.cos(t)])

    A, b, outer = (np.moveaxis(x, (-2, -1), (0, 1)) for x in signals(mesh.points))
    rows = Trajectory(mesh, np.concatenate([A, b[..., None]], axis=3))
    moves, outer = Dynamics(rows, np.array([1.0, 4.0])), Trajectory(mesh, outer)
    times, levels = moves.forgetting

    def slope(t, X, rho):
        (A, b, forced), X = signals(t), X.reshape(2, 3)
        moved = np.column_stack([X[:, :2] @ A, -X[:, :2] @ b])
        return (gains[:, None] * forced - (A.T + np.diag(rates + rho)) @ X - moved).ravel()

    X = np.arange(6.0)
    for start, stop, rho in zip([0.0, *times], [*times, 4.0], levels, strict=True):
        solved = solve_ivp(slope, (start, stop), X, "DOP853", args=(rho,), rtol=1e-12, atol=1e-12)
        X = solved.y[:, -1]
    begin = ExtensionState(np.arange(6.0).reshape(2, 3), 0.0)
    found = filtered(outer, rates, gains, moves, [begin]).final
    np.testing.assert_allclose(found.ravel(), X, rtol=1e-9)


@pytest.mark.parametrize(("estimator", "remedy"), [
    ("least_squares", {"remedy": "reset", "reset_interval": 1.7}),
    ("ls_drem", {"remedy": "reset", "reset_interval": 1.7}),
    ("least_squares", {"remedy": "current_coordinates"}),
])  # fmt: skip
@pytest.mark.parametrize(("centre", "sign"), [(1.0, ""), (2.0, "-"), (2.5, "-")])
def test_an_unknown_that_does_next_to_nothing_at_the_start_has_no_unit_of_it(
    estimator, remedy, centre, sign
):
    """F(0) is 1e-44 to 1e-272: that is no unit for what the pulse tells of k, and of the state."""
    plant = {
        "name": "pulse", "states": ["x"], "outputs": ["y"], "unknowns": {"k": 1.5}, "E": [[1]],
        "A": [[-1]], "F": [[f"{sign}exp(-((t - {centre})/0.1)**2)"]], "C": [[1]],
        "initial_state": [0.3],
    }
    found = api_run(
        plant, estimator=estimator, time={"horizon": 6, "samples": 31},
        observer={"name": "gpebo", **remedy},
    )
    assert all(found.details.estimable[name] is not None for name in ("x", "k"))
    assert abs(found.errors["k"][0, -1]) < 1e-4
    assert abs(found.errors["x"][0, -1]) < 1e-6


def test_resets_make_no_knowledge_of_rounding():
    """What an output does not see is named after resets, too; in 16 of 53 systems some was not."""
    plant, determined = random_system(7)
    found = api_run(plant, estimator="least_squares", time={"horizon": HORIZON, "samples": 5},
                    observer={"name": "gpebo", "form": "strangeness_free", "remedy": "reset",
                              "reset_times": [0.9, 1.8]})
    known = {name: found.details.estimable[name] is not None for name in determined}
    assert known == determined


def test_nothing_starts_again_where_there_is_nothing_to_estimate():
    """E = 0 and no unknowns: there is no parameter to transport."""
    found = api_run({
        "name": "algebraic", "states": ["a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[0, 0], [0, 0]], "A": [[1, "sin(t)/2"], [0.3, 2]], "B": [[1], [0]], "C": [[1, 0]],
        "initial_state": [0, -1],
    }, time={"horizon": 3, "samples": 5}, observer={"remedy": "reset", "reset_interval": 1.0})
    np.testing.assert_allclose(found.estimates["b"][0], found["b"], atol=1e-12)
