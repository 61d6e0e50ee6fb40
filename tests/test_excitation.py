"""Excitation evidence against closed forms."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plants import observed, one_state, reference, shipped
from regressions import ETA, fading, regression, three
from scipy.integrate import quad_vec, trapezoid
from scipy.optimize import brentq

from gpebo_cli import run
from gpebo_cli.evidence.excitation import (
    assess,
    persistent,
    sampled_window_level,
    window_level,
)
from gpebo_cli.evidence.metrics import SETTLED, measure_squares, settling_times, time_rms
from gpebo_cli.findings import Direction
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import ExcitationSettings

T = np.linspace(0, 10, 201)
CLEAN = regression(three, ETA)


def gram(psi, a, b):
    return quad_vec(lambda t: np.outer(psi(t), psi(t)), a, b, epsabs=1e-13)[0]


def outer(regression):
    return type(regression.outer)(regression.mesh, regression.outer.values[..., :3])


def test_eigenvalues_of_the_circuit_match_the_reference():
    system = shipped("circuit")
    regression = observed(system)[1].regression
    rows = reference("circuit")["at"]
    t = np.array([row["t"] for row in rows])
    found = assess(regression, t, ExcitationSettings())
    np.testing.assert_allclose(
        found.gram_eigenvalues, [row["gram_eigenvalues"] for row in rows], rtol=1e-7
    )
    assert found.is_ie


@pytest.mark.parametrize("share", [0.001, 0.5, 0.998, 1.0])
def test_t_c_within_an_element_is_where_a_constant_reaches_rho(share):
    """∫1 dt = ρ at t = ρ, before the first node of an element and behind the last but one, too."""
    made = regression(lambda t: np.ones((*np.shape(t), 1)), [1.0], 10.0)
    rho = float(made.mesh.edges[2] + share * made.mesh.steps[2])
    found = assess(made, np.array([0.0, 10.0]), ExcitationSettings(rho=rho))
    assert found.t_c == pytest.approx(rho, rel=1e-12)


@pytest.mark.parametrize("horizon", [0.5, 80.0])
def test_a_window_is_a_tenth_of_the_horizon_or_what_is_said(horizon):
    made = regression(lambda t: np.stack([1 + 0 * t, t], axis=-1), [1.0, 2.0], horizon)
    t = np.array([0.0, horizon])
    assert assess(made, t, ExcitationSettings()).window == pytest.approx(horizon / 10, rel=1e-15)
    assert assess(made, t, ExcitationSettings(window=3.0)).window == 3.0


def test_eigenvalues_and_window_against_quadrature():
    found = assess(CLEAN, T, ExcitationSettings(rho=0.5, window=2.5))
    for k in (40, 120, 200):
        np.testing.assert_allclose(
            found.gram_eigenvalues[k], np.linalg.eigvalsh(gram(three, 0, T[k])), atol=1e-11
        )
    assert found.lambda_min == pytest.approx(found.gram_eigenvalues[200, 0], rel=1e-12)
    G = gram(three, 0, 10.0)
    values, vectors = np.linalg.eigh(G / np.sqrt(np.outer(*[np.diag(G)] * 2)))
    assert (found.level, found.condition) == pytest.approx((values[0], values[-1] / values[0]))
    weakest = vectors[:, 0] * np.sign(vectors[np.abs(vectors[:, 0]).argmax(), 0])
    for sign in (1.0, -1.0):  # which of the two an eigenvector has is chance
        final = replace(found.final, vectors=sign * found.final.vectors)
        direction = replace(found, final=final).weakest_direction.components
        assert list(direction.values()) == pytest.approx(weakest)
    assert np.isnan(found.pe_level[T < 2.5]).all()
    for k in (50, 111, 200):
        expected = np.linalg.eigvalsh(gram(three, T[k] - 2.5, T[k]))[0]
        assert found.pe_level[k] == pytest.approx(expected, abs=1e-12)


def test_a_window_is_whole_in_any_unit_of_time():
    """In picoseconds a hundredth of a window once counted as rounding."""
    signal, tiny = outer(CLEAN), 1e-12
    mesh = Mesh(tiny * signal.mesh.edges, signal.mesh.rule)
    one = window_level([[signal]], T, 2.5)
    other = window_level([[Trajectory(mesh, signal.values)]], tiny * T, tiny * 2.5)
    np.testing.assert_allclose(other / tiny, one, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_a_window_of_samples_of_a_circle(hold):
    """ψ = [cos t, sin t]: the integral over a window w has the eigenvalues (w ± sin w)/2."""
    t, w = np.linspace(-1.0, 5.0, 601), 1.5
    rows = np.stack([np.cos(t), np.sin(t), t], axis=1)[:, None]
    sampled = SampledRegression(t, np.diff(t, prepend=-1.0), np.vstack([rows[:1], rows]), hold)
    level = sampled_window_level(sampled, w)
    assert np.isnan(level[t < -1.0 + w - 1e-6]).all()
    np.testing.assert_allclose(level[t > -1.0 + w - 1e-6], 0.5 * (w - np.sin(w)), rtol=1e-3)


def test_t_c_of_a_state_that_grows_is_that_of_what_is_known_of_it_by_then():
    """x' = a x and ψ = 1: G = (1 − e^(−2 a t))/(2 a) of the x of now, from the first element on.

    Just before the end, too.
    """
    for rho, a in (5e-3, 10.0), (0.1, 1.0), (0.5 * -np.expm1(-2.0 * 0.9999), 1.0):
        observer = {"name": "gpebo", "remedy": "current_coordinates"}
        found = run(
            one_state(A=[[a]]), observer=observer, estimator="least_squares",
            excitation={"rho": rho}, time={"horizon": 1, "samples": 3},
        ).details.excitation
        assert found.t_c == pytest.approx(-np.log1p(-2 * a * rho) / (2 * a), rel=1e-9)


@pytest.mark.parametrize("window", [4096, 3])  # elements that are looked at together
def test_t_c_is_the_first_time_the_level_is_reached(window, monkeypatch):
    monkeypatch.setattr("gpebo_cli.regression.linear._WINDOW", window)
    found = assess(CLEAN, T, ExcitationSettings(rho=0.5))
    assert np.linalg.eigvalsh(gram(three, 0, found.t_c))[0] == pytest.approx(0.5, rel=1e-6)
    never = assess(CLEAN, T, ExcitationSettings(rho=1e6))
    assert never.t_c is None
    assert not never.is_ie


@pytest.mark.parametrize(("bend", "horizon"), [(1.0, 8.0), (1.0, 80.0), (0.03, 80.0)])
def test_t_c_is_no_rounding_of_what_g_grows_to(bend, horizon):
    """ψ = (t, t + b t²): both grow from zero, and are told apart later by the bend of one only."""
    bent = regression(
        lambda t: np.stack([t, t + bend * t**2], axis=-1), [1.0, 2.0], horizon
    )
    found = assess(bent, np.linspace(0.0, horizon, 101), ExcitationSettings())
    x = brentq(  # = b t_c: 1 − N12 by the moments of both columns, in x = b t
        lambda x: 1.0 - (1 / 3 + x / 4) / np.sqrt((1 / 3 + x / 2 + x**2 / 5) / 3) - 1e-4, 0.01, 1.0
    )
    assert found.t_c == pytest.approx(x / bend, rel=1e-6)
    for begin in (-1e6, 1e10):  # which is not known to 1e-14 of a horizon
        mesh = Mesh(bent.mesh.edges + begin, bent.mesh.rule)
        moved = replace(
            bent, Y=Trajectory(mesh, bent.Y.values), psi=Trajectory(mesh, bent.psi.values)
        )
        seen = assess(moved, np.linspace(begin, horizon + begin, 101), ExcitationSettings())
        assert seen.t_c == pytest.approx(found.t_c + begin, abs=1e-13 * abs(begin), rel=0.0)
    first = assess(bent, 1e-5 * np.arange(3.0), ExcitationSettings()).known
    assert (first.margin[1:] < 1.0).all()  # one cannot know there, and it is said


@settings(max_examples=10)
@given(
    power=st.integers(1, 3), rate=st.floats(0.5, 2.0), bend=st.floats(0.02, 0.5),
    elements=st.integers(4, 12),
)
@example(power=3, rate=1.0, bend=0.5, elements=4)
def test_t_c_does_not_depend_on_the_elements(power, rate, bend, elements):
    """ψ = tⁿ e^(−rate t) (1, 1 + bend t²): early in an element it is nothing beside its end."""
    def found(elements):
        mesh = Mesh(np.linspace(0.0, 8.0, elements + 1), radau_rule(14))
        t = mesh.points[..., None]
        both = np.concatenate([np.ones_like(t), 1.0 + bend * t**2], axis=-1)
        psi = (t**power * np.exp(-rate * t) * both)[..., None, :]
        made = LinearRegression(
            Trajectory(mesh, t), Trajectory(mesh, psi), ("a", "b"), np.abs(psi).max(axis=(0, 1, 2))
        )
        return assess(made, mesh.edges, ExcitationSettings()).t_c

    assert found(elements) == pytest.approx(found(40), rel=1e-4)


def test_what_is_told_apart_from_the_start_on_is_so_at_once():
    """Gram matrices of 1, t, t² with unit diagonal are the same at all times."""
    powers = regression(lambda t: t[..., None] ** np.arange(3), ETA, 80.0)
    assert assess(powers, T, ExcitationSettings()).t_c == 0.0


def test_the_weakest_direction_is_named():
    blind = regression(
        lambda t: np.stack([np.sin(t), np.sin(t), np.cos(t)], axis=-1), ETA
    )  # p1 and p2 cannot be told apart
    found = assess(blind, T, ExcitationSettings())
    assert not found.is_ie
    direction = found.weakest_direction.components
    assert abs(direction["p1"]) == pytest.approx(np.sqrt(0.5), abs=1e-9)
    assert direction["p1"] == pytest.approx(-direction["p2"], abs=1e-9)
    assert str(found.weakest_direction).replace("+", "-") == "-0.707 p1 -0.707 p2"
    assert str(Direction({"a": -1.0, "b": -0.01, "c": -0.1})) == "-1 a -0.1 c"


def test_rounding_is_not_excitation():
    small = regression(lambda t: 1e-16 * three(t), ETA)
    assert assess(small, T, ExcitationSettings()).is_ie  # perhaps it has large units
    zero = replace(small, scale=1.0)  # it is what is left of terms of size 1
    assert not assess(zero, T, ExcitationSettings()).is_ie


def test_a_fading_regressor_is_ie_and_not_pe():
    faded = regression(fading, ETA, horizon=40.0, elements=160)
    t = np.linspace(0, 40, 101)
    found = assess(faded, t, ExcitationSettings())
    assert found.is_ie
    assert found.pe_level[-1] == pytest.approx(0.0, abs=1e-30)  # no cancellation noise
    assert not persistent(outer(faded), 100.0).holds
    assert persistent(outer(CLEAN), 1e5).holds
    assert not persistent(outer(CLEAN), 1e-3).holds


def test_a_gain_is_enough_by_the_window_that_has_least():
    """Windows of a tenth of the horizon, which begin at hundredths of it, by quadrature."""
    cuts = np.linspace(0.0, 10.0, 101)
    parts = np.array([gram(three, *ends) for ends in pairwise(cuts)])
    level = min(np.linalg.eigvalsh(parts[k : k + 10].sum(axis=0))[0] for k in range(91))
    for share, holds in ((1.01, True), (0.99, False)):
        gain = share * np.log(100.0) / 10.0 / level
        found = persistent(outer(CLEAN), gain)
        assert found.holds == holds
        assert found.evidence == pytest.approx({
            "pe_level": level, "window": 1.0, "gamma_times_level": gain * level,
            "needed": np.log(100.0) / 10.0,
        }, rel=1e-8)


def test_settling_time_of_an_exponential_is_exact():
    t = np.linspace(2.0, 12.0, 37)
    error = np.array([np.exp(-0.8 * (t - 2.0)), np.ones_like(t), np.zeros_like(t)])
    found = settling_times(t, error[..., None], SETTLED * error[:, :1])[:, 0]
    assert found[0] == pytest.approx(np.log(100) / 0.8, rel=1e-12)
    assert np.isnan(found[1])
    assert found[2] == 0.0


def test_settling_time_counts_the_last_excursion():
    t = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    error = np.array([[1.0, 1e-3, 0.5, 1e-3, 1e-3]])
    assert 2.0 < settling_times(t, error[..., None], SETTLED * error[:, :1])[0, 0] < 3.0


def test_an_error_that_falls_within_the_first_step_has_settled_there():
    """e^(−1000t), of which 1 % is left at ln(100)/1000, before the second node."""
    plant = {"name": "still", "states": ["x"], "outputs": ["y"], "E": [[1]], "A": [[0]],
             "C": [[1]], "initial_state": [1]}
    time = {"horizon": 10, "samples": 11}
    case = run(plant, estimator="gradient", gamma=1e3, time=time).cases[0]
    for name in ("e0_x", "x", "parameters", "states"):
        assert case[f"seconds_to_1pct_{name}"] == pytest.approx(np.log(100.0) / 1e3, rel=1e-6)


def test_norms_that_start_at_rounding_have_settled_at_once():
    """A plant that starts where the observer does: its errors are rounding at all times."""
    t = np.linspace(0.0, 4.0, 5)
    squares = np.array([[0.0, 1e-30, 1e-32, 0.0, 1e-31], [0.0, 1.0, 1e-3, 1e-9, 1e-9]])
    found = measure_squares(
        t, (squares, squares), np.zeros((2, 1)), np.zeros((2, 1)), np.ones(1, dtype=bool)
    )
    np.testing.assert_array_equal(found[:2, 0], 0.0)
    assert (found[:2, 1] > 2.0).all()
    assert (found[:2, 1] < 3.0).all()
    unknown = np.full((2, 1), np.nan)
    found = measure_squares(
        t, (squares, squares), unknown, np.zeros((2, 1)), np.ones(1, dtype=bool)
    )
    assert np.isnan(found[[0, 2]]).all()


def test_metrics_are_those_of_the_errors_of_parameters_and_states():
    """Each in units of its size where they are added up; times to within 5 ms."""
    time = {"horizon": 4.0, "samples": 801}
    details = run("descriptor", estimator="ls_drem", gamma=[30.0, 90.0], time=time).details
    found, of, x = details.metrics, details.estimation, details.simulation.states
    assert len(of.t) == 801
    errors = [of.parameters - of.true_parameters, of.states - x]
    sizes = [np.abs(of.true_parameters).max(axis=0), np.abs(x).max(axis=0)]
    squares = [((e / size) ** 2).sum(axis=2) for e, size in zip(errors, sizes, strict=True)]
    rms = np.sqrt(trapezoid(squares[1], of.t, axis=1) / 4.0)
    np.testing.assert_allclose(found.rms_error_states, rms, rtol=0.01)
    names = (*of.names, *details.system.states)
    each = np.concatenate(errors, axis=2) ** 2
    told = [found.seconds_to_1pct_parameters, found.seconds_to_1pct_states,
            *(found.seconds_to_1pct[name] for name in names)]
    for seconds, values in zip(told, [*squares, *np.moveaxis(each, 2, 0)], strict=True):
        above = values > 1e-4 * values[:, :1]
        last = [of.t[row.nonzero()[0][-1]] for row in above]
        np.testing.assert_allclose(seconds, last, atol=0.005 + 1e-9)
    for final, error in zip((found.final_error_parameters, found.final_error_states), errors,
                            strict=True):
        np.testing.assert_allclose(final, np.abs(error[:, -1]).max(axis=1), rtol=1e-6)


def test_time_rms():
    t = np.linspace(0, 2 * np.pi, 20_001)
    assert time_rms(t, np.sin(t)[None] ** 2)[0] == pytest.approx(np.sqrt(0.5), rel=1e-6)


def test_evidence_at_all_times_is_computed_when_it_is_read_and_pickled_as_numbers():
    found = assess(CLEAN, T, ExcitationSettings())
    assert callable(vars(found)["_pe_level"])
    back = pickle.loads(pickle.dumps(found))  # noqa: S301  our own
    assert callable(vars(found)["_pe_level"])
    np.testing.assert_array_equal(back.pe_level, found.pe_level)
    assert vars(found)["_pe_level"] is found.pe_level
    assert back.level == found.normalised_min[-1] == found.known.smallest[-1]


def test_sizes_of_terms_are_those_of_the_element_of_each_time():
    scale = np.arange(12.0).reshape(4, 3)
    made = replace(regression(three, ETA, elements=4), scale=scale)
    assert (made.terms(np.array([1.0, 4.0, 6.0, 9.0])) == scale).all()


@pytest.mark.parametrize(("rho", "said"), [
    (None, "interval-exciting from t = {0.t_c:.4g} s on (λ_min(G) = {0.level:.3g} with unit diag"),
    (0.01, "interval-exciting from t = {0.t_c:.4g} s on (λ_min(G) = {0.lambda_min:.3g}, ρ = 0.01"),
    (0.5, "NOT interval-exciting: λ_min(G) = {0.lambda_min:.3g}, ρ = 0.5; not excited: "),
])
def test_the_last_line_of_a_run_says_what_was_found(rho, said):
    """Of the case whose state error falls below 1 % first."""
    given = {"excitation": {"rho": rho}, "time": {"samples": 81}}
    details = run("descriptor", estimator="ls_drem", gamma=[1.0, 5.0], **given).details
    found, error = details.metrics, np.abs(details.estimation.states - details.simulation.states)
    assert details.verdict.startswith(said.format(details.excitation))
    more = ("not excited: {0.weakest_direction}" if rho == 0.5 else
            "), parameters well determined from t = {0.determined:.4g} s on")
    assert details.verdict.endswith(more.format(details.excitation) + (
        f"; state error {error[1, -1].max():.2g} at the end, below 1 % after "
        f"{found.seconds_to_1pct_states[1]:.4g} s (alpha = 1, f0 = 0.0001, beta = 0, gamma = 5)"
    ))
    slow = run("descriptor", estimator="gradient", gamma=[1e-3, 1e-2], **given).details
    error = np.abs(slow.estimation.states[:, -1] - slow.simulation.states[-1]).max(axis=1)
    case = int(error.argmin())
    assert (f"state error {error[case]:.2g} at the end, never below 1 % "
            f"(gamma = {slow.estimation.cases[case]['gamma']:g}); PE not met: ") in slow.verdict
    assert ", times γ = 0.001 is " in slow.verdict


def test_the_last_line_says_how_much_of_a_recording_is_explained():
    """Root mean squares over time, by the trapezoidal rule, and correlations of 20 lags."""
    time = {"samples": 201}
    made = run("descriptor", observer="none", time=time)
    noise = 0.05 * np.random.default_rng(1).standard_normal(201)
    data = {"t": made.t, **made.inputs, "y": made["y"] + noise}
    laws = {"name": "ls_drem", "gamma": [1.0, 0.01]}
    details = run("descriptor", data=data, estimator=laws).details
    r, fit, final = details.regression, details.fit, details.estimation.parameters[:, -1]
    for eta, told in zip((*final, 0.0 * final[0]), (*fit.residual, fit.size), strict=True):
        square = trapezoid(((r.Y - r.psi @ eta) ** 2).sum(axis=1), r.t) / np.ptp(r.t)
        assert told == pytest.approx(np.sqrt(square), rel=0.02)
    assert fit.residual.argmin() == 0
    assert (f"; |Y − ψη̂| with the final estimates is {fit.residual[0]:.2g}, |Y| is {fit.size:.2g} "
            "(root mean squares)") in details.verdict
    fit = run("descriptor", data=data, estimator=laws, time=time).details.fit
    left = data["y"] - fit.outputs[:, 0]
    power = [(left[k:] * left[: len(left) - k]).sum() for k in range(21)]
    np.testing.assert_allclose(fit.correlation, np.array(power[1:]) / power[0], atol=1e-6)
    assert (fit.lag, fit.band) == pytest.approx((0.1, 1.96 / np.sqrt(201.0)))


def test_integrals_early_in_an_element_are_no_more_wrong_than_is_said():
    """∫ψᵀψ of ψ = (1, t) beside its closed form, from 1e-15 of the first element on."""
    made = LinearRegression.from_functions(
        lambda t: np.stack([np.ones_like(t), t], axis=-1)[..., None, :],
        lambda t: t[..., None], ["a", "b"], 8.0, 4,
    )
    t = np.concatenate([np.geomspace(2e-15, 1.9, 40), 2.0 + np.geomspace(1e-9, 1.9, 9)])
    gram, rounding = made.gram_with_rounding(t)
    exact = np.stack([t, t**3 / 3.0], axis=1)
    wrong = np.abs(np.einsum("mjj->mj", gram[..., :2]) - exact)
    assert (wrong <= rounding + 1e-15 * exact).all()
    end = np.floor(t / 2.0 + 1.0) * 2.0  # of its element
    size = np.stack([end, end**3 / 3.0], axis=1) * (t % 2.0 / 2.0)[:, None]
    assert (rounding <= 1e-11 * size).all()


def test_terms_are_the_largest_so_far_and_at_an_edge_those_before_it():
    made = LinearRegression.from_functions(
        lambda t: t[..., None, None], lambda t: t[..., None], ["a"], 4.0, 4
    )
    assert made.scale == 4.0  # the largest entry of ψ
    made = replace(made, scale=np.array([[1.0], [2.0], [5.0], [7.0]]))
    assert made.terms(np.array([0.0, 0.5, 1.0, 1.5, 3.0, 3.5, 4.0]))[:, 0].tolist() == [
        1.0, 1.0, 1.0, 2.0, 5.0, 7.0, 7.0,
    ]


def test_least_squares_leave_a_parameter_that_nothing_depends_on_at_zero():
    made = LinearRegression.from_functions(
        lambda t: np.stack([np.cos(t), 0.0 * t], axis=-1)[..., None, :],
        lambda t: 3.0 * np.cos(t)[..., None], ["a", "b"], 4.0, 4,
    )
    np.testing.assert_allclose(made.least_squares(), [3.0, 0.0], atol=1e-12)
    assert made.misfit(np.array([1.0, 7.0])) == pytest.approx(4.0 * (2.0 + np.sin(8.0) / 4.0))
