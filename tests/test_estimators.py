"""Every estimator against its defining ODEs, its limits, and its identities."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import CONF, observed, one_state, reference, shipped
from processes import write_table
from random_systems import HORIZON, random_system
from regressions import ETA, adjugate, fading, integrate, regression, three
from scipy.integrate import cumulative_trapezoid, quad, quad_vec, solve_ivp, trapezoid

import gpebo_cli
from gpebo_cli import estimators, observers
from gpebo_cli import run as api_run
from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.estimators import LinearRegression, Trajectory, _segments
from gpebo_cli.estimators._information import InformationAt, information, prior_units
from gpebo_cli.estimators._mixed import energy_requirement
from gpebo_cli.estimators._registry import SeveralEstimates
from gpebo_cli.estimators._scalar import (
    _element_maps,
    kreisselmeier,
    lion,
    lion_rows,
    low_pass,
    mix,
    resolved_for,
    scalar_law,
    scalar_path,
)
from gpebo_cli.estimators.drem import Drem, follow
from gpebo_cli.estimators.fct import FiniteTime
from gpebo_cli.estimators.least_squares import solved
from gpebo_cli.estimators.ls_drem import LsDrem, mix_least_squares, one_over_memory
from gpebo_cli.estimators.power import PowerEstimates, _resolved
from gpebo_cli.experiment import accuracy
from gpebo_cli.experiment.pipeline import stream, stream_verdict
from gpebo_cli.findings import would_do
from gpebo_cli.numerics.mesh import Mesh, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.plain_yaml import parse
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import DataSettings, Settings, TimeSettings

T = np.linspace(0, 10, 101)
START = [0.3, 0.1, -0.2]


def wobble(t):
    return 0.2 * np.sin(3.0 * np.asarray(t))


NOISY = regression(three, ETA, disturbance=wobble)
CLEAN = regression(three, ETA)


def estimate(name, regression, t=T, **gains):
    built = estimators.build({"name": name, **gains})
    return built.estimate(regression, t)


def run(name, regression, t=T, **gains):
    return estimate(name, regression, t, **gains).parameters(slice(None))


def signals(t):
    psi = three(t)
    return psi, float(psi @ ETA + wobble(t))


def gradient_ode(gamma):
    def f(t, x):
        psi, Y = signals(t)
        return gamma * psi * (Y - psi @ x)

    return f, np.array(START), slice(None)


def least_squares_ode(alpha, f0, beta, bound=None):
    def f(t, x):
        psi, Y = signals(t)
        F = x[:9].reshape(3, 3)
        b = beta * (1 - np.linalg.norm(F, 2) / bound) if bound else beta
        return np.concatenate([
            (-alpha * F @ np.outer(psi, psi) @ F + b * F).ravel(),
            alpha * F @ psi * (Y - psi @ x[9:12]),
        ])

    return f, np.concatenate([(np.eye(3) / f0).ravel(), START]), slice(9, 12)


def drem_ode(gamma, lam, kind):
    lam = np.asarray(lam)

    def f(t, x):
        psi, Y = signals(t)
        omega, calY, eta = x[:9].reshape(3, 3), x[9:12], x[12:]
        if kind == "kreisselmeier":
            d_omega = -lam[:, None] * (omega - np.outer(psi, psi))
            d_calY = -lam * (calY - psi * Y)
        else:
            d_omega, d_calY = -lam[:, None] * (omega - psi), -lam * (calY - Y)
        delta = np.linalg.det(omega)
        law = gamma * delta * (adjugate(omega) @ calY - delta * eta)
        return np.concatenate([d_omega.ravel(), d_calY, law])

    return f, np.concatenate([np.zeros(12), START]), slice(12, 15)


def ls_drem_ode(gamma, alpha, f0, beta, bound=None):
    start = np.array(START)

    def f(t, x):
        psi, Y = signals(t)
        F, g, z, eta = x[:9].reshape(3, 3), x[9:12], x[12], x[13:]
        b = beta * (1 - np.linalg.norm(F, 2) / bound) if bound else beta
        H = np.eye(3) - z * f0 * F
        delta = np.linalg.det(H)
        mixed = adjugate(H) @ (g - z * f0 * F @ start)
        return np.concatenate([
            (-alpha * F @ np.outer(psi, psi) @ F + b * F).ravel(),
            alpha * F @ psi * (Y - psi @ g),
            [-b * z],
            gamma * delta * (mixed - delta * eta),
        ])

    return (
        f,
        np.concatenate([(np.eye(3) / f0).ravel(), START, [1.0], START]),
        slice(13, 16),
    )


def mre_ode(gamma, lam):
    def f(t, x):
        psi, Y = signals(t)
        omega, calY, eta = x[:9].reshape(3, 3), x[9:12], x[12:]
        return np.concatenate([
            (-lam * (omega - np.outer(psi, psi))).ravel(),
            -lam * (calY - psi * Y),
            gamma * (calY - omega @ eta),
        ])

    return f, np.concatenate([np.zeros(12), START]), slice(12, 15)


def power_ode(gamma, alpha, gamma2, beta, lam):
    inner, x0, columns = drem_ode(1.0, lam, "kreisselmeier")

    def f(t, x):
        omega = x[:9].reshape(3, 3)
        delta = np.linalg.det(omega)
        r = adjugate(omega) @ x[9:12] - delta * x[12:]
        law = gamma * np.abs(r) ** alpha + gamma2 * np.abs(r) ** beta
        return np.append(inner(t, x)[:12], delta * np.sign(r) * law)

    return f, x0, columns


def exciting_ode(gamma, kappa, lam):
    """The observer of (η_i, z) with u1 = −φ', u2 = φ'/Δ, u3 = 0, literally; ∫Δ² beside it."""
    inner, x0, columns = drem_ode(1.0, lam, "kreisselmeier")

    def f(t, x):
        omega, eta, Phi = x[:9].reshape(3, 3), x[12:15], x[24:28].reshape(2, 2)
        delta = np.linalg.det(omega)
        z, xi1, xi2 = x[15:18], x[18:21], x[21:24]
        u2 = 0.5 * np.pi * kappa * np.exp(-kappa * x[28]) * delta
        u1 = -u2 * delta
        law = gamma * Phi[1, 0] * (z - xi2 - Phi[1, 0] * eta)
        Phi_t = np.array([[0.0, u1], [u2 * delta, 0.0]]) @ Phi
        mixed = adjugate(omega) @ x[9:12]
        return np.concatenate([
            inner(t, x[:15])[:12], law, u2 * mixed, u1 * xi2 - u1 * z, u2 * delta * xi1,
            Phi_t.ravel(), [delta**2],
        ])

    return f, np.concatenate([x0, np.zeros(9), np.eye(2).ravel(), [0.0]]), columns


def means_ode(gamma, delay, settle, rows):
    """Means of [ψ(t) ; ψ(t − d)]ᵀ[ψ | Y]: of rows K that are named; Δ² is det KᵀK where many."""
    def f(t, x):
        psi, Y = signals(t)
        before = three(t - delay) * (t >= delay)
        means = x[:24].reshape(6, 4)
        product = np.outer(np.concatenate([psi, before]), np.append(psi, Y))
        kept = means[rows]
        square = kept[:, :3].T @ kept if len(rows) > 3 else kept
        delta = np.linalg.det(square[:, :3])
        law = gamma * (adjugate(square[:, :3]) @ square[:, 3] - delta * x[24:])
        law *= 1.0 if len(rows) > 3 else delta
        return np.concatenate([((product - means) / (settle + t)).ravel(), law])

    return f, np.concatenate([np.zeros(24), START]), slice(24, 27)


@pytest.mark.parametrize(
    ("name", "gains", "ode", "tolerance"),
    [
        ("gradient", {"gamma": 3}, gradient_ode(3), 1e-9),
        ("least_squares", {"alpha": 2, "f0": 0.5}, least_squares_ode(2, 0.5, 0), 1e-9),
        ("least_squares", {"alpha": 2, "f0": 0.5, "beta": 0.3},
         least_squares_ode(2, 0.5, 0.3), 1e-9),
        ("least_squares", {"alpha": 2, "f0": 0.5, "beta": 0.3, "bound": 5},
         least_squares_ode(2, 0.5, 0.3, 5), 1e-8),
        ("least_squares", {"alpha": 2, "f0": 0.5, "beta": 10, "bound": 5},  # β of several elements
         least_squares_ode(2, 0.5, 10, 5), 1e-9),
        ("drem", {"gamma": 100, "lambda": [0.1, 0.2, 0.3]},
         drem_ode(100, [0.1, 0.2, 0.3], "kreisselmeier"), 1e-7),
        ("drem", {"gamma": 1e4, "lambda": 0.5}, drem_ode(1e4, [0.5] * 3, "kreisselmeier"), 1e-7),
        ("lion", {"gamma": 1e4, "lambda": [0.5, 1, 2]}, drem_ode(1e4, [0.5, 1, 2], "lion"), 1e-7),
        ("ls_drem", {"gamma": 10, "alpha": 2, "f0": 0.5}, ls_drem_ode(10, 2, 0.5, 0), 1e-7),
        ("ls_drem", {"gamma": 10, "alpha": 2, "f0": 0.5, "beta": 0.3},
         ls_drem_ode(10, 2, 0.5, 0.3), 1e-7),
        ("ls_drem", {"gamma": 10, "alpha": 2, "f0": 0.5, "beta": 0.3, "bound": 5},
         ls_drem_ode(10, 2, 0.5, 0.3, 5), 1e-7),
        ("mre", {"gamma": 5, "lambda": 0.2}, mre_ode(5, 0.2), 1e-9),
        ("power", {"gamma": 100, "lambda": [0.3, 0.5, 0.7]},
         power_ode(100, 0.5, 0, 1.5, [0.3, 0.5, 0.7]), 1e-9),
        ("power", {"gamma": 300, "alpha": 0.7, "gamma2": 1e3, "beta": 2, "lambda": 0.5},
         power_ode(300, 0.7, 1e3, 2, [0.5] * 3), 1e-9),
        ("exciting", {"gamma": 10, "kappa": 100, "lambda": [0.3, 0.5, 0.7]},
         exciting_ode(10, 100, [0.3, 0.5, 0.7]), 1e-9),
        ("instrumental", {"gamma": 100, "delay": 1, "settle": 0.5},
         means_ode(100, 1, 0.5, [3, 4, 5]), 1e-9),
        ("annihilator", {"gamma": 100, "delay": 1, "settle": 0.5, "perturbed": ["p3"]},
         means_ode(100, 1, 0.5, [0, 1, 3, 4, 5]), 1e-9),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_against_an_integration_of_the_defining_odes(name, gains, ode, tolerance):
    f, x0, columns = ode
    tiny = name in ("power", "exciting") or (name, gains.get("gamma")) == ("drem", 1e4)
    t = T[:41] if tiny else T  # DOP853's steps get tiny later
    cut = 10 if "delay" in gains else 40  # f jumps at t[10] = 1
    first = integrate(f, x0, t[: cut + 1])
    rest = integrate(f, first[-1], t[cut:])[1:] if t[cut:][1:].size else first[:0]
    expected = np.concatenate([first, rest])[:, columns]
    found = run(name, NOISY, t, initial=START, **gains)[0]
    assert np.abs(found - expected).max() < tolerance


@pytest.mark.parametrize("name", ["drem", "lion", "mre"])
def test_a_row_that_no_parameter_is_in_changes_no_estimate(name):
    """An output that sees inputs only, with noise, has Y that is not zero and ψ that is."""
    known = LinearRegression.from_functions(
        lambda t: np.stack([0.0 * three(t), three(t)], axis=-2),
        lambda t: np.stack([wobble(t), three(t) @ ETA + wobble(t)], axis=-1),
        NOISY.parameters, 10.0,
    )
    np.testing.assert_allclose(run(name, known), run(name, NOISY), rtol=1e-9, atol=1e-12)


FROM_ZERO = [
    {"name": "least_squares"}, {"name": "least_squares", "beta": 0.3}, {"name": "gradient"},
    {"name": "gradient", "gamma": 1e3}, {"name": "ls_drem"}, {"name": "ls_drem", "gamma": 1e4},
    {"name": "drem", "gamma": [1e2, 1e6]}, {"name": "mre"}, {"name": "lion"},
    {"name": "fct", "gamma": 1e4}, {"name": "fct", "extension": "least_squares"},
    {"name": "power", "gamma": 10.0, "gamma2": 0.0}, {"name": "exciting", "kappa": 1e3},
    {"name": "power", "gamma": 10.0, "gamma2": 1e3},
    {"name": "instrumental", "gamma": 1e3}, {"name": "annihilator", "perturbed": ["p1"]},
]


@pytest.mark.parametrize("given", FROM_ZERO, ids=str)
def test_estimates_follow_the_sign_and_the_unit_of_what_is_measured(given):
    """To the last digit: −Y and 2³⁰ Y make −η̂ and 2³⁰ η̂ of estimates from 0, on equal elements.

    The residual's powers 1/2 and 3/2 want other gains.
    """
    found, power = [], given["name"] == "power"
    for unit in (1.0, -(2.0**30)) if power else (1.0, -1.0, 2.0**30, -(2.0**-30)):
        made = regression(three, unit * np.abs(ETA), disturbance=lambda t, by=unit: by * wobble(t))
        own, root = dict(given), abs(unit) ** 0.5
        if power:
            own |= {"gamma": given["gamma"] * root, "gamma2": given["gamma2"] / root}
        found.append(estimators.build(own).estimate(made, T).parameters(slice(None)) / unit)
    for other in found[1:]:
        digits = 1e-9 if power or given["name"] == "exciting" else 0.0
        np.testing.assert_allclose(other, found[0], rtol=0.0, atol=digits)


def test_a_bound_is_reached_and_forgetting_that_is_too_fast_for_it_is_refused():
    """‖F‖ of what is not excited is logistic, and z = 1/(f₀‖F‖) its reciprocal."""
    row, f0, bound = np.array([0.6, 0.8]), 1e-4, 1e6
    constant = regression(lambda t: np.broadcast_to(row, (*np.shape(t), 2)), ETA[:2])
    found = information(constant, 1.0, f0, 10.0, bound)
    points = found.memory.mesh.points
    exact = (1.0 + (bound * f0 - 1.0) * np.exp(-10.0 * points)) / (bound * f0)
    assert np.abs(found.memory.values / exact - 1.0).max() < 1e-6
    with pytest.raises(SolverError, match=r"estimator\.beta = 1e\+15 .*; lower it"):
        information(constant, 1.0, f0, 1e15, bound)
    large = regression(lambda t: np.broadcast_to(1e3 * row, (*np.shape(t), 2)), ETA[:2])
    with pytest.raises(SolverError, match=r"does not settle near t = .*; lower estimator\.beta"):
        information(large, 1.0, f0, 10.0, bound)  # of 1e6 by 1e-6 rounding leaves nothing


def test_what_follows_knows_when_data_were_first_gathered():
    early = Mesh(np.linspace(-5.0, 0.0, 6), CLEAN.mesh.rule)
    first = information(replace(
        CLEAN, Y=Trajectory(early, CLEAN.Y.values[:5]), psi=Trajectory(early, CLEAN.psi.values[:5])
    ), 1.0, None, 0.0, None)
    second = information(CLEAN, 1.0, None, 0.0, None, first.reached)
    assert first.reached.began == second.began == second.reached.began == -5.0


def test_an_error_of_what_is_measured_is_forgotten_as_data_are():
    """δh' = −β δh + δY and δη̂ = αF δh, where ψ = 1 makes G_z = (1 − e^−βt)/β."""
    beta, f0, alpha = 0.3, 0.5, 2.0
    one = regression(lambda t: np.ones((*t.shape, 1)), [1.0], 10.0)
    gains = {"alpha": alpha, "beta": beta, "f0": f0}
    (at,) = estimators.build({"name": "least_squares", **gains}).errors(one)
    t = np.array([1.0, 4.0])
    found = at(t, t)
    assert (-beta == found.A).all()
    z = np.exp(-beta * t)
    expected = alpha / (z * f0 + alpha * (1.0 - z) / beta)
    np.testing.assert_allclose(found.C[:, 0, 0], expected, rtol=1e-9)


def test_what_of_G_is_rounding_early_in_an_element_is_no_question_of_the_unit_of_time():
    """G is ∫ψᵀψ, in which the unit of time stands once, and in units of parameters by its root."""
    found = []
    for unit in 1e-6, 1.0, 1e6:
        made = regression(lambda t, unit=unit: three(t / unit), ETA, 10.0 * unit)
        told = information(made, 1.0, None, 0.0, None).at(np.array([1e-3, 0.01, 0.06]) * unit)
        found.append(told.units / np.sqrt(unit))
    np.testing.assert_allclose(found, np.broadcast_to(found[1], np.shape(found)), rtol=1e-6)


def test_what_is_mixed_keeps_the_digits_of_small_columns():
    """Of Y = ψη without noise 𝐘/Δ is η, though eigenvectors of G hide the small column's share."""
    units, t = np.array([1.0, 1e-6, 1.0]), np.array([5.0, 9.0])
    made = regression(lambda t: three(t) * units, ETA / units)
    path = mix_least_squares(information(made, 1.0, 1.0, 0.0, None), 1.0, 1.0, t)
    delta, Y, _ = path.signals(t, t)
    np.testing.assert_allclose(Y / delta[:, None], [ETA / units] * 2, rtol=1e-12)


def test_behind_an_f0_a_large_column_hides_nothing_of_the_others():
    """F and Δ = det(I − z f₀F) are those that units give in which columns are of one size."""
    units, t, f0 = np.array([1.0, 1e9, 1.0]), np.array([5.0, 9.0]), 1e-3
    known = information(regression(lambda t: three(t) * units, ETA / units), 1.0, f0, 0.0, None)
    gram = regression(three, ETA).gram(t)[..., :3]
    F = np.linalg.inv(gram + f0 * np.diag(units**-2.0))
    found = known.at(t, t).covariance(1.0, f0) * units * units[:, None]
    np.testing.assert_allclose(found, F, rtol=1e-9)
    delta, _, _ = mix_least_squares(known, 1.0, f0, t).signals(t, t)
    np.testing.assert_allclose(delta, np.linalg.det(F @ gram), rtol=1e-9)


@pytest.mark.parametrize("name", ["least_squares", "ls_drem", "fct"])
def test_what_is_not_excited_stays_where_it_was_however_fast_it_is_forgotten(name):
    blind = regression(lambda t: np.zeros((*np.shape(t), 3)), ETA, elements=4)
    extension = {"extension": "least_squares"} if name == "fct" else {}
    found = run(name, blind, beta=[0, 1, 1e8], initial=START, **extension)
    assert np.abs(found - START).max() < 1e-14


@pytest.mark.parametrize(("alpha", "gamma2"), [(0.3, 0.0), (0.5, 0.0), (0.8, 0.0), (0.5, 1e6)])
def test_the_power_law_is_exact_after_a_finite_time_and_not_before(alpha, gamma2):
    """|e|^{1−α} = |e(0)|^{1−α} − γ(1 − α)∫|Δ|^{1+α}; the second power only hurries."""
    gamma, rates = 1e4, {"lambda": [0.3, 0.5, 0.7]}
    path = kreisselmeier(CLEAN, np.array(rates["lambda"]))
    powers = np.abs(np.linalg.det(path.values[..., :3])) ** (1.0 + alpha)
    spent = gamma * (1.0 - alpha) * Trajectory(path.mesh, powers).integral()(T)
    left = np.maximum(np.abs(ETA) ** (1.0 - alpha) - spent[:, None], 0.0) ** (1.0 / (1.0 - alpha))
    error = np.abs(run("power", CLEAN, gamma=gamma, alpha=alpha, gamma2=gamma2, **rates)[0] - ETA)
    if gamma2:
        assert (error <= left + 1e-12).all()
        assert (error < 0.99 * left).any()
    else:
        np.testing.assert_allclose(error, left, atol=1e-10)
    requirement = estimate("power", CLEAN, gamma=gamma, alpha=alpha, **rates).requirement
    assert requirement.holds == (left[-1].max() == 0.0)
    start = [1.1, -2.05, 0.48]
    near = estimate("power", CLEAN, gamma=gamma, alpha=alpha, initial=start, **rates)
    needed = 0.1 ** (1.0 - alpha) / (1.0 - alpha)
    assert near.requirement.evidence["needed"] == pytest.approx(needed)


def test_what_the_power_law_needs_is_told_by_the_last_quotient():
    path = SimpleNamespace(quotient=np.array([[[9.0, 7.0], [8.0, 6.0]], [[5.0, 4.0], [3.0, 1.0]]]))
    made = SimpleNamespace(
        groups=[path], energies=[1.0], start=np.ones(1), alpha=0.5, gains=np.ones((1, 1)),
    )
    found = PowerEstimates.requirement.fget(made)  # |3 − 1|^½ / ½
    assert found.evidence["needed"] == pytest.approx(2.0 * np.sqrt(2.0))


def test_what_the_power_law_needs_counts_a_delta_below_zero():
    """With rates of its own in each row Ω is not symmetric: here Δ changes its sign."""
    def psi(t):
        return np.stack([np.ones_like(t), 1.0 + 9.0 * np.exp(-t)], axis=-1)[..., None, :]

    def delta(t):  # Ω_ij = λ_i ∫ e^{−λ_i(t − s)} ψ_i ψ_j ds, of powers of e^{−s}
        def of(rate, *terms):
            return rate * sum(
                c * (np.exp(-k * t) - np.exp(-rate * t)) / (rate - k) for k, c in terms
            )

        two, square = ((0, 1), (1, 9)), ((0, 1), (1, 18), (2, 81))
        return of(0.1, (0, 1)) * of(5.0, *square) - of(0.1, *two) * of(5.0, *two)

    made = LinearRegression.from_functions(
        psi, lambda t: psi(t) @ np.ones(2), ["p1", "p2"], 10.0, 40
    )
    found = estimate("power", made, **{"lambda": [0.1, 5.0]}).requirement.evidence
    energy = quad(lambda t: abs(delta(t)) ** 1.5, 0.0, 10.0, limit=200)[0]
    assert delta(T).min() < -0.1
    assert found["integral_delta_squared"] == pytest.approx(energy, rel=1e-5)


@pytest.mark.parametrize("size", [1e-70, 1e-77, 1e-81])
def test_the_power_law_stands_still_where_nothing_is_left_of_the_regressor(size):
    """Δ is of size⁴, next to the smallest number, and the residual is zero."""
    def psi(t):
        rows = [[1.0 + 0.0 * t, np.sin(t)], [np.cos(t), 1.0 + 0.0 * t]]
        return size * np.moveaxis(np.array(rows), (0, 1), (-2, -1))

    eta = np.array([1.0, 2.0])
    faint = LinearRegression.from_functions(psi, lambda t: psi(t) @ eta, ["a", "b"], 10.0, 8)
    found = run("power", faint, np.linspace(0.0, 10.0, 5), initial=eta.tolist())
    np.testing.assert_allclose(found[0], np.broadcast_to(eta, (5, 2)), rtol=1e-14)


def test_a_regressor_that_stays_exciting_when_the_excitation_ends():
    """Behind the Δ of drem nothing arrives any more; behind the new one the rest does."""
    ends, t = regression(fading, ETA, horizon=40.0), np.linspace(0.0, 40.0, 81)
    rates = {"lambda": [0.3, 0.5, 0.7]}
    assert np.abs(run("drem", ends, t, gamma=1e4, **rates)[0, -1] - ETA).max() > 1.0
    energy = np.interp(t, ends.mesh.points.ravel(), mix_energy(ends, rates["lambda"]))
    for kappa in (1.0 / energy[-1], 1e3 / energy[-1]):
        made = estimate("exciting", ends, t, kappa=kappa, **rates)
        assert np.abs(made.parameters(slice(None))[0, -1] - ETA).max() < 1e-11
        angle = 0.5 * np.pi * (1.0 - np.exp(-kappa * energy))
        np.testing.assert_allclose(made.delta(t)[0], np.sin(angle), atol=2e-3)
        assert made.requirement.holds


def test_what_comes_later_does_not_change_the_estimates_of_exciting():
    """It is causal: over the first half of the data it says the same as over all of them."""
    t, half = np.linspace(0.0, 4.0, 21), regression(three, ETA, horizon=4.0, elements=20)
    gains = {"kappa": 100.0, "lambda": [0.3, 0.5, 0.7]}
    whole = run("exciting", CLEAN, t, **gains)[0]
    assert np.abs(whole - run("exciting", half, t, **gains)[0]).max() < 1e-10
    assert np.abs(whole[-1] - ETA).max() > 1e-6


def mix_energy(regression, rates):
    path = kreisselmeier(regression, np.array(rates))
    squares = np.linalg.det(path.values[..., :3]) ** 2
    return Trajectory(path.mesh, squares).integral().values.ravel()


def test_instruments_and_annihilators_take_the_bias_away():
    """w is in Y and in the first column, and is uncorrelated with itself a quarter period ago."""
    def w(t):
        return np.sin(7.0 * np.asarray(t))

    def psi(t):
        return np.stack([np.sin(t) + 0.5 * w(t), np.cos(2.0 * t), np.ones_like(t)], axis=-1)

    biased, t = regression(psi, ETA, horizon=400.0, elements=1500, disturbance=w), np.array([400.0])
    error = {
        name: np.abs(run(name, biased, t, **more)[0, -1] - ETA).max() for name, more in {
            "least_squares": {}, "instrumental": {"delay": np.pi / 14},
            "annihilator": {"delay": np.pi / 14, "perturbed": ["p1"]},
        }.items()
    }
    assert error["least_squares"] > 0.3
    assert error["instrumental"] < 0.01
    assert error["annihilator"] < 0.01


def test_an_annihilator_does_not_square_the_condition():
    """Columns of ψ over ten decades: normal equations, whose condition is 1e20, lose η."""
    units = np.array([1e5, 1.0, 1e-5])
    scaled = regression(lambda t: three(t) * units, ETA / units)
    found = run("annihilator", scaled, np.array([T[-1]]), gamma=1e20)[0, -1]
    np.testing.assert_allclose(found * units, ETA, rtol=1e-4)


def test_nothing_delayed_has_arrived_before_the_delay():
    """Ω is zero until then, and so is Δ; ∫Δ² is a number."""
    made = estimate("instrumental", CLEAN, delay=3.0)
    assert np.isfinite(made.groups[0].energy).all()
    assert not made.delta(T[T < 3.0]).any()
    assert made.delta(T[T > 3.5]).all()


def test_finite_time_law_against_an_integration_with_its_energy():
    """The DREM ODEs with I' = Δ² beside them, then w_c and η̂_f from their definitions."""
    gamma, mu, lam = 1e3, 0.2, [0.3, 0.5, 0.7]
    inner, x0, columns = drem_ode(gamma, lam, "kreisselmeier")

    def f(t, x):
        delta = np.linalg.det(x[:9].reshape(3, 3))
        return np.append(inner(t, x[:-1]), delta**2)

    found = integrate(f, np.append(x0, 0.0), T)
    w_c = np.minimum(np.exp(-gamma * found[:, -1]), 1 - mu)[:, None]
    expected = (found[:, columns] - w_c * START) / (1 - w_c)
    ours = run("fct", NOISY, gamma=gamma, mu=mu, initial=START, **{"lambda": lam})[0]
    assert np.abs(ours - expected).max() < 1e-6


def test_least_squares_without_forgetting_is_regularised_batch_least_squares():
    alpha, f0 = 3.0, 0.7
    gram = NOISY.gram(T)
    expected = [
        np.linalg.solve(f0 * np.eye(3) + alpha * g[:, :3], f0 * np.array(START) + alpha * g[:, 3])
        for g in gram
    ]
    found = run("least_squares", NOISY, alpha=alpha, f0=f0, initial=START)[0]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_drem_with_one_parameter_is_the_gradient_law_on_omega():
    """p = 1: Δ = Ω, 𝐘 = 𝒴."""
    one = regression(lambda t: (1.0 + 0.5 * np.sin(t))[..., None], np.array([2.0]))
    omega = kreisselmeier(one, np.array([0.4]))

    def f(t, x):
        O, calY = omega(np.array([t]))[0, 0]
        return [50.0 * O * (calY - O * x[0])]

    expected = integrate(f, np.zeros(1), T)
    np.testing.assert_allclose(run("drem", one, gamma=50, **{"lambda": 0.4})[0], expected,
                               atol=1e-9)


@pytest.mark.parametrize("gamma", [1e2, 1e6, 1e10, 1e14])
def test_noise_free_error_is_the_exponential_of_the_energy(gamma):
    answer = estimate("drem", CLEAN, gamma=gamma)
    energy = answer.groups[0].energy_at_t
    error = answer.parameters(slice(None))[0] - ETA
    np.testing.assert_allclose(
        error, -np.exp(-gamma * energy)[:, None] * ETA, atol=1e-12, rtol=1e-9
    )


@pytest.mark.parametrize("make", [kreisselmeier, lion])
def test_mixed_regression_holds(make):
    """𝐘 = Δ η to 1e-11 of their size, at every time, Ω = 0 at the start included."""
    from gpebo_cli.numerics.linalg import determinant_and_adjugate_action

    values = make(CLEAN, np.array([0.1, 0.2, 0.3]))(T)
    delta, Y, _ = determinant_and_adjugate_action(values[..., :3], values[..., 3:])
    assert delta[0] == 0.0
    np.testing.assert_allclose(Y[..., 0], delta[:, None] * ETA, atol=1e-11 * np.abs(delta).max())


@pytest.mark.parametrize(("sizes", "taken"), [
    ((1e-14, 1.0), [1, 1, 1]), ((1e-26, 1e-12), [1, 1, 1]), ((1e-10, 1.0), [0, 1, 0]),
    ((0.0, 0.0), [0, 1, 0]),
])
def test_lion_takes_rows_in_turn_but_those_of_rounding(sizes, taken):
    made = LinearRegression.from_functions(
        lambda t: np.stack([size * three(t) for size in sizes], axis=-2),
        lambda t: np.stack([size * three(t) @ ETA for size in sizes], axis=-1),
        ["p1", "p2", "p3"], 10.0, 5,
    )
    assert lion_rows(made).tolist() == taken
    at, inside = T[:2], T[:2]
    rows = estimators.build({"name": "lion"}).seen(made)(at, inside)
    np.testing.assert_array_equal(rows @ made.psi(at), made.psi(at)[:, taken])


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.1}])
def test_lion_refuses_equal_filters_of_one_row(observer):
    """Two rows of Ω would be the same, and Δ rounding, for which no γ is large enough."""
    sine = {"name": "sine", "unknowns": {"a": 1, "b": 2}, "signals": {"s": "sin(t)"}}
    law, settings = {"name": "lion", "lambda": 1}, {"time": {"horizon": 2}, "observer": observer}
    with pytest.raises(ConfigError, match="need rates that differ, because Δ is zero otherwise"):
        api_run(regression={**sine, "psi": [["s", "1"]]}, estimator=law, **settings)
    api_run(regression={**sine, "psi": [["s", "1"], ["1", "s"]]}, estimator=law, **settings)


def test_ls_drem_delta_is_the_reference_one():
    _, observation = observed(shipped("circuit"))
    rows = reference("circuit")["at"]
    t = np.array([row["t"] for row in rows])
    found = estimate("ls_drem", observation.regression, t, alpha=1, f0=1).delta(t)[0]
    expected = [row["delta_ls_alpha1_f01"] for row in rows]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    gram = observation.regression.gram(t)[..., :-1]
    literal = [np.linalg.det(g @ np.linalg.inv(np.eye(3) + g)) for g in gram]
    np.testing.assert_allclose(found, literal, rtol=1e-6, atol=1e-15)
    mixed = estimate("drem", observation.regression, t)
    key = "delta_kreisselmeier_rows_0.1_0.2_0.3"
    np.testing.assert_allclose(mixed.delta(t)[0], [row[key] for row in rows], rtol=1e-9)
    np.testing.assert_allclose(
        mixed.groups[0].energy_at_t, [row["integral_delta_squared_rows"] for row in rows], rtol=1e-6
    )
    same = estimate("drem", observation.regression, t, **{"lambda": 0.2})
    np.testing.assert_allclose(
        same.delta(t)[0], [row["delta_kreisselmeier_0.2"] for row in rows], rtol=1e-9
    )


def test_ls_drem_delta_is_between_0_and_1_and_never_falls():
    delta = estimate("ls_drem", CLEAN, alpha=1, f0=1e-3).delta(T)[0]
    assert (np.diff(delta) >= -1e-14).all()
    assert delta[0] == 0.0
    assert delta[-1] < 1.0


@pytest.mark.parametrize("extension", ["kreisselmeier", "least_squares"])
def test_finite_time_estimate_is_exact_after_its_threshold_and_not_before(extension):
    gains = {"gamma": 2e3 if extension == "kreisselmeier" else 3.0, "mu": 0.3, "f0": 0.1}
    answer = estimate("fct", CLEAN, extension=extension, **gains)
    energy = gains["gamma"] * answer.groups[0].energy_at_t
    error = np.abs(answer.parameters(slice(None))[0] - ETA).max(axis=1)
    threshold = -np.log1p(-0.3)
    assert (error[energy > threshold + 1e-9] < 1e-11).all()
    assert (error[energy < 0.9 * threshold] > 1e-2).all()
    assert (energy > threshold).any()


def test_a_regressor_that_dies_out_separates_the_estimators():
    """IE, not PE: fading filters and a gradient stall, LS+DREM converges."""
    faded = regression(fading, ETA, horizon=60.0, elements=240)
    t = np.array([0.0, 20.0, 60.0])
    stalled = estimate("drem", faded, t, gamma=100.0)
    error = np.abs(stalled.parameters(slice(None))[0] - ETA).max(axis=1)
    assert error[2] > 0.5 * error[0]
    assert error[2] > 0.99 * error[1]
    assert not stalled.requirement.holds
    gradient = estimate("gradient", faded, t, gamma=0.5)
    assert np.abs(gradient.parameters(slice(None))[0, 2] - ETA).max() > 0.05
    assert not gradient.requirement.holds
    converged = estimate("ls_drem", faded, t, gamma=5.0)
    assert np.abs(converged.parameters(slice(None))[0, 2] - ETA).max() < 1e-9
    assert converged.requirement.holds


@settings(max_examples=40, deadline=None)
@given(p=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_random_regressors(p, seed):
    """Noise-free, any p: each exact law moves from its start towards η and never beyond."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 3, p), rng.uniform(0, 6, p)
    eta = rng.normal(size=p)
    drawn = regression(lambda t: np.sin(np.asarray(t)[..., None] * frequency + phase), eta,
                       elements=60)
    for name in ("drem", "ls_drem"):
        answer = estimate(name, drawn, gamma=1e3)
        error = answer.parameters(slice(None))[0] - eta
        size = np.abs(eta).max()
        assert (np.abs(error) <= np.abs(eta) * (1 + 1e-9) + 1e-9 * size).all()
        assert (np.diff(np.abs(error), axis=0) <= 1e-7 * size).all()
        assert (np.diff(answer.groups[0].energy_at_t) >= 0).all()
    ls = run("least_squares", drawn, alpha=1, f0=1e-3)[0] - eta
    information = 1e-3 * np.eye(p) + drawn.gram(T)[..., :p]
    level = np.einsum("mi,mij,mj->m", ls, information, ls)  # η̃ᵀF⁻¹η̃ never grows
    assert (np.diff(level) <= 1e-9 * level[0]).all()


@pytest.mark.parametrize("gamma", [1.0, 1e4, 1e8, 1e14])
def test_gradient_is_as_accurate_at_any_gain(gamma):
    """Two parameters in two rows: η̂ = η at once for γ → ∞; and the limit is approached as 1/γ."""
    square = regression(three, ETA)
    psi = np.stack([three(square.mesh.points), three(square.mesh.points + 1.0),
                    three(2.0 * square.mesh.points + 2.0)], axis=-2)
    square = replace(
        square,
        psi=type(square.psi)(square.mesh, psi),
        Y=type(square.Y)(square.mesh, psi @ ETA),
    )
    error = run("gradient", square, gamma=gamma)[0] - ETA
    if gamma >= 1e4:
        assert np.abs(error[50:]).max() < 1e-9
    assert np.abs(error).max() <= 2 * np.abs(ETA).max()


def test_stiff_gradient_matches_its_limit():
    """γ = 1e14 against γ = 1e10 with one row: both are the limit of the fast direction."""
    high = run("gradient", CLEAN, gamma=1e14)[0]
    low = run("gradient", CLEAN, gamma=1e10)[0]
    np.testing.assert_allclose(high, low, atol=1e-8)


def cosines(p):
    """p exciting functions of time, nearly dependent over short times."""
    def psi(t):
        return np.stack([np.cos((0.3 + 0.7 * k) * t + 0.3 * k) for k in range(p)], axis=-1)

    return psi


@settings(max_examples=25, deadline=None)
@given(
    p=st.integers(1, 8), gamma=st.floats(-2, 18), alpha=st.floats(-4, 8), f0=st.floats(-12, 2),
    noise=st.sampled_from([0.0, 1e-9, 1e-3, 0.3]),
)
def test_no_gain_breaks_ls_drem(p, gamma, alpha, f0, noise):
    """At the end: the exponential of its energy, or where it is fast, least squares itself."""
    eta = np.arange(1.0, p + 1) * (-1.0) ** np.arange(p)
    made = regression(cosines(p), eta, disturbance=lambda t: noise * np.sin(3.0 * t))
    gains = {"gamma": 10.0**gamma, "alpha": 10.0**alpha, "f0": 10.0**f0}
    estimates = estimate("ls_drem", made, **gains)
    final = estimates.parameters(slice(None))[0, -1]
    energy = estimates.requirement.evidence["gamma_times_integral"]
    if noise == 0.0:
        np.testing.assert_allclose(final, eta * -np.expm1(-energy), rtol=1e-5, atol=1e-8)
        return
    G = made.gram(T)
    best = np.linalg.solve(G[-1, :, :p], G[-1, :, p])
    late = estimates.delta(T)[0, 50:]
    lag = 1.0 / (gains["gamma"] * late.min() ** 2)  # seconds behind the batch solution
    if lag < 1e-3:
        assert np.abs(final - best).max() <= (lag + 1e-6) * p * 10.0


def test_a_closed_form_takes_a_gain_that_resolves_nothing_early():
    """The law against quadrature in the variable ∫Δ², where G is known to all digits."""
    made, gamma = regression(three, ETA, disturbance=wobble), 1e5
    t = np.linspace(0, 10, 40_001)
    G = made.gram(t)
    share = np.linalg.eigvalsh(G[..., :3])
    delta = np.prod(share / (share + 1e-4), axis=1)
    rate = gamma * delta**2
    known = np.flatnonzero(share[:, 0] > 1e-9 * share[:, 2])[0]
    best = np.linalg.solve(G[known:, :, :3], G[known:, :, 3:])[..., 0]
    ours = run("ls_drem", made, t=t, gamma=gamma, f0=1e-4)[0]
    # η̂ = η̄ − η̄'/(γΔ²) + …, where the law is fast
    lagging = best - np.gradient(best, t[known:], axis=0) / rate[known:, None]
    late = t[known:] > 2.0
    np.testing.assert_allclose(ours[known:][late], lagging[late], atol=1e-7)


@pytest.mark.parametrize("name", ["ls_drem", "drem", "fct"])
def test_many_rows_of_rough_data(name):
    """Every element of its own, as of a recording: refined a stretch at a time."""
    mesh = initial_mesh(0.0, 300.0, [], 30_000, radau_rule(3))
    psi = three(mesh.points)[..., None, :]
    rough = 0.1 * np.random.default_rng(0).standard_normal((mesh.size, 1, 1))
    made = LinearRegression(
        Trajectory(mesh, psi @ ETA + rough), Trajectory(mesh, psi), ("a", "b", "c"), 2.0
    )
    final = run(name, made, t=np.array([0.0, 300.0]))[0, -1]
    np.testing.assert_allclose(final, ETA, atol=0.02)


@pytest.mark.parametrize(("name", "size"), [
    ("drem", 1.0), ("drem", 0.3), ("lion", 1.0), ("ls_drem", 1.0), ("fct", 1.0), ("fct", 0.3),
    ("power", 1.0),
])
def test_a_gain_that_is_auto_settles_before_the_end(name, size):
    made = regression(lambda t: size * three(t), ETA)
    built = estimators.tuned(estimators.build({"name": name, "gamma": "auto"}), made)
    (case,) = built.cases
    error = np.linalg.norm(built.estimate(made, T).parameters(slice(None))[0] - ETA, axis=1)
    assert error[-1] < 0.01 * error[0]
    least = built.estimate(made, T).requirement.gain
    assert case["gamma"] == pytest.approx(10.0 * least, rel=1e-6)
    # What the text of a gain that is too small says would do, does; half of it does not.
    said = estimate(name, made, gamma=least / 100).requirement
    assert not said.holds
    assert f"γ ≥ {least:.2g}" in said.text
    assert estimate(name, made, gamma=1.01 * least).requirement.holds
    assert not estimate(name, made, gamma=0.5 * least).requirement.holds


@pytest.mark.parametrize("beta", [0.0, 0.4])
def test_least_squares_needs_the_weakest_direction_to_outweigh_the_prior(beta):
    """α λ_min(G)/(z f₀) by quadrature, of the case that has the least of it."""
    G = quad_vec(lambda s: np.exp(-beta * (10.0 - s)) * np.outer(three(s), three(s)), 0.0, 10.0)[0]
    least = np.linalg.eigvalsh(G)[0] / np.exp(-10.0 * beta)
    cases = {"alpha": [0.5, 2.0], "f0": [1e-4, 1e-3], "beta": beta}
    reached = estimate("least_squares", CLEAN, **cases).requirement.evidence
    assert reached["alpha_lambda_min_over_f0"] == pytest.approx(0.5 * least / 1e-3, rel=1e-9)
    for share, holds in ((1.01, True), (0.99, False)):
        gains = {"alpha": 2.0, "f0": 2.0 * least / (share * 99.0), "beta": beta}
        said = estimate("least_squares", CLEAN, **gains).requirement
        assert said.holds == holds
        assert f"is {share * 99.0:.3g} times f₀; 1 % of the initial error needs 99" in said.text


ROWS = np.column_stack([three(T), three(T) @ ETA])[:, None]
SAMPLED = SampledRegression(
    T, np.diff(T, prepend=T[0]), np.concatenate([ROWS[:1], ROWS]), "zoh"
)


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("gains", [{"gamma": [3e9, 5e9]}, {"gamma": [0.07, 0.5]}, {}])
@pytest.mark.parametrize("name", [name for name in estimators.names() if name != "monotone"])
def test_what_is_required_is_told_with_the_numbers_of_its_evidence(name, gains, sampled):
    if name == "least_squares":
        gains = {"f0": [1e-3, 1e-4]} if gains else {}
    if sampled:
        law = estimators.build({"name": name, **gains}).recursive(["p1", "p2", "p3"])
        law.update(SAMPLED)
        found = law.requirement
    else:
        found = estimate(name, CLEAN, **gains).requirement
    evidence = dict(found.evidence)
    whole = evidence.pop("integral_delta_squared", None)
    rounded = [f"{value:.3g}" for value in evidence.values()]
    assert [number for number in rounded if number not in found.text] == []
    *_, needed = evidence.values()
    if "left_of_the_initial_error" in evidence:
        assert found.holds == (evidence["left_of_the_initial_error"] <= needed)
    elif "reciprocal_condition" not in evidence:
        reached = max(value for key, value in evidence.items() if "_times_" in key or "over" in key)
        assert found.holds == (reached >= needed)
    if gains.get("gamma"):
        assert f"gain {min(gains['gamma']):.3g}" in found.text.replace("γ =", "gain")
        if whole is not None:
            product = evidence["gamma_times_integral"]
            assert product == pytest.approx(min(gains["gamma"]) * whole)
            assert found.gain == pytest.approx(needed / whole)
            assert found.text.endswith("" if found.holds else f": γ ≥ {needed / whole:.2g}")
    elif name == "ls_drem":  # without a gain
        assert "∫Δ²/T" in found.text


@pytest.mark.parametrize(("gamma", "first", "segment"), [
    (10.0, 6.0, 1), (3.0, 1.0, 2), (0.1, 6.0, 3),
])
def test_what_is_required_is_that_of_the_first_segment_that_has_it(gamma, first, segment):
    """Or of the last one, where none has; the first one has it as a run until then."""
    def required(horizon, **observer):
        return gpebo_cli.run(
            "descriptor", estimator={"name": "ls_drem", "gamma": gamma, "f0": 1e-3},
            observer={"name": "gpebo", **observer}, time={"horizon": horizon, "samples": 11},
        ).details.estimation.requirement

    found = required(20.0, remedy="reset", reset_times=[first, 14.0])
    assert found.text.startswith(f"in segment {segment} of the 3 between resets, γ∫Δ² = ")
    assert found.holds == (segment < 3)
    if segment == 1:
        assert found.evidence == pytest.approx(required(6.0).evidence, rel=1e-6)


def test_a_gain_that_is_auto_is_not_for_samples_and_resets():
    with pytest.raises(ConfigError, match="auto needs to know the signals to their end"):
        estimators.build({"name": "drem", "gamma": "auto"}).recursive(["a"])
    for own in ({"remedy": "reset", "reset_times": [5.0]}, {"remedy": "current_coordinates"}):
        with pytest.raises(ConfigError, match=r"auto needs to know .*; give a number with resets"):
            gpebo_cli.run("descriptor", estimator="drem", gamma="auto", observer=own)


# --- gains ----------------------------------------------------------------------------------


def test_cases_are_the_product_of_the_lists():
    built = estimators.build(
        {"name": "ls_drem", "gamma": [1, 10, 100], "f0": "logspace(-3, -1, 2)"}
    )
    assert len(built.cases) == 6
    assert [case["gamma"] for case in built.cases[:3]] == [1, 10, 100]
    assert built.cases[3]["f0"] == pytest.approx(0.1)
    together = built.estimate(NOISY, T)
    all_cases = together.parameters(slice(None))
    for i, case in enumerate(built.cases):
        alone = run("ls_drem", NOISY, gamma=case["gamma"], f0=case["f0"])[0]
        np.testing.assert_allclose(all_cases[i], alone, atol=1e-9)
    np.testing.assert_allclose(together.parameters(slice(2, 5)), all_cases[2:5], atol=1e-9)
    assert together.delta(T).shape == (6, len(T))


def test_a_number_that_yaml_leaves_a_text_is_one_gain_and_no_list():
    """1e-1 is one; a list of them makes several estimators, which samples do not take."""
    text, plain = (
        estimators.build({"name": "instrumental", "delay": value}) for value in ("1e-1", 0.1)
    )
    assert text == plain


def test_many_gains_are_the_same_as_one_at_a_time():
    """Above the limit of the prefix scan another path is taken; the numbers stay."""
    gains = np.logspace(2, 12, 1000)
    many = estimate("drem", NOISY, T[::10], gamma=gains.tolist()).parameters(slice(None))
    for i in (0, 333, 999):
        one = run("drem", NOISY, T[::10], gamma=float(gains[i]))[0]
        np.testing.assert_allclose(many[i], one, rtol=1e-9, atol=1e-12)


def test_a_gain_per_parameter_by_name():
    gains = {"p1": 10.0, "p2": 100.0, "p3": 1000.0}
    answer = run("drem", NOISY, gamma=gains)
    assert len(answer) == 1
    for i, gamma in enumerate(gains.values()):
        np.testing.assert_allclose(
            answer[0, :, i], run("drem", NOISY, gamma=gamma)[0, :, i], atol=1e-12
        )
    for name in ("exciting", "fct", "gradient", "instrumental", "ls_drem", "mre", "power"):
        assert len(estimators.build({"name": name, "gamma": gains}).cases) == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "dream"}, "'dream' is not an estimator"),
        ({"name": ["drem"]}, r"\['drem'\].* is not an estimator"),
        ({"name": "drem", "gamma": -1}, "positive number"),
        ({"name": "instrumental", "delay": 0.0}, "delay: expected a positive number, got 0"),
        ({"name": "drem", "gamma": []}, "empty list"),
        ({"name": "gradient", "gamma": "auto"}, "'auto' is not a positive number"),
        ({"name": "drem", "gamma": "logspace(0, 301, 5)"}, r"\(0, 301, 5\) needs .* ±300"),
        ({"name": "drem", "gamma": "logspace(0, -301, 5)"}, "±300"),
        ({"name": "drem", "gamma": "logspace(-301, 0, 5)"}, "±300"),
        ({"name": "drem", "gamma": "logspace(0, 1, 2.5)"}, r"\(0, 1, 2\.5\) needs .* whole num"),
        ({"name": "drem", "gamma": "import os"}, "not a positive number"),
        ({"name": "drem", "gamma": float("nan")}, "positive number"),
        ({"name": "drem", "gama": 1}, "gama"),
        ({"name": "drem", "lambda": [0.1, 0.2]}, r"2 values but there are 3 parameters \(p1, p2"),
        ({"name": "drem", "initial": {"p9": 1}}, "no parameter 'p9'; the parameters are p1, p2"),
        ({"name": "drem", "gamma": {"p1": 1.0}}, "no value for 'p2'"),
        ({"name": "least_squares", "beta": -1}, "estimator.beta: expected 0 or a positive"),
        ({"name": "least_squares", "bound": 1, "f0": 0.1}, r"below 1/f0 = 10"),
        *[({"name": "least_squares", "beta": [1e60] * k}, r"1e\+60 is too large") for k in (1, 9)],
        ({"name": "fct", "mu": 1.5}, "between 0 and 1"),
        ({"name": "power", "alpha": 1.5, "gamma2": 2},
         "0 < alpha < 1 < beta .* got alpha=1.5, beta=1.5, gamma2=2"),
        ({"name": "instrumental", "delay": 0}, r"estimator\.delay: expected a positive"),
        ({"name": "annihilator", "perturbed": ["p9"]}, r"estimator\.perturbed: .*'p9'"),
        ({"name": "ls_drem", "gamma": "logspace(0,9,10000)", "alpha": "logspace(0,9,10000)"},
         "cases"),
    ],
)
def test_wrong_settings_are_refused_with_one_line(settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        estimators.build(settings).estimate(CLEAN, T)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "gains", "more"), [
    ("least_squares", {"f0": 0.5}, {"bound": 2.0}),  # without forgetting none is above 1/f₀
    ("ls_drem", {"gamma": 1.0}, {"f0": 1e-4}),  # the default
])
def test_what_is_the_same_with_one_more_setting(name, gains, more):
    np.testing.assert_array_equal(run(name, CLEAN, **gains), run(name, CLEAN, **gains, **more))


def test_units_of_a_prior_are_those_of_terms_that_cancel():
    """√(10⁻³) of √∫ of what the terms are, for 4 s; of no terms there is nothing to measure."""
    units = prior_units(np.zeros((1, 2)), np.array([[3.0, 0.0]]), np.array([4.0]))
    np.testing.assert_allclose(units, [[np.sqrt(1e-3) * 6.0, 1.0]])


def test_every_estimator_has_a_config():
    from plants import CONF

    assert estimators.names() == sorted(path.stem for path in (CONF / "estimator").glob("*.yaml"))


def test_estimates_do_not_depend_on_the_elements_of_the_regression():
    """Where a gain is fast beside them they are cut, also where η̄ moves."""
    few, many = (
        run("drem", regression(three, ETA, disturbance=wobble, elements=elements), gamma=1e8)
        for elements in (20, 320)
    )
    np.testing.assert_allclose(few, many, atol=1e-7)


def test_a_large_gain_acts_while_the_regressor_is_still_small():
    """Ω' = −λ(Ω − ψ²) with ψ = t³ grows by many orders of magnitude within one element.

    On that η̂ = η (1 − e^{−γ∫Δ²}) of drem, and φ(κ∫Δ²) by which exciting turns.
    """
    slow = regression(lambda t: np.asarray(t)[..., None] ** 3, np.array([3.0]), elements=10)
    fine, rate, gain = np.linspace(0.0, 1.0, 100_001), 0.1, 1e12
    series = [rate / 7.0]  # of ∫ λ e^{−λ(t − s)} s⁶ ds
    for k in range(8, 20):
        series.append(-series[-1] * rate / k)
    delta = fine**7 * np.polynomial.Polynomial(series)(fine)
    energy = np.concatenate([[0.0], cumulative_trapezoid(delta**2, fine)])[2500::2500]
    share = -np.expm1(-gain * energy)
    assert share[5] < 0.01
    assert share[20] > 0.9
    t, settings = fine[2500::2500], {"lambda": rate}
    np.testing.assert_allclose(
        run("drem", slow, t, gamma=gain, **settings)[0, :, 0], 3.0 * share, atol=1e-6
    )
    turned = estimate("exciting", slow, t, kappa=gain, **settings).delta(t)[0]
    np.testing.assert_allclose(turned, np.sin(0.5 * np.pi * share), atol=1e-6)


@pytest.mark.parametrize("second", [1.0, 1e-13])
def test_elements_are_cut_where_a_filter_is_faster_than_they_are(second):
    """Z = 1 − e^{−300t} on elements of a second; a rough signal is no reason to cut."""
    mesh = initial_mesh(0.0, 4.0 * second, [], 4, radau_rule(9))
    filtered = low_pass(Trajectory(mesh, np.ones(mesh.points.shape)), np.array(300.0 / second))
    t = np.linspace(0.0, 0.1, 101)
    np.testing.assert_allclose(filtered(second * t), 1.0 - np.exp(-300.0 * t), atol=1e-10)
    assert filtered.mesh.size < 100
    rough = Trajectory(mesh, np.random.default_rng(0).normal(size=mesh.points.shape))
    assert low_pass(rough, np.array(0.1 / second)).mesh is mesh


@pytest.mark.parametrize(("share", "holds"), [(0.99, False), (1.01, True)])
def test_a_gain_has_to_beat_the_growth_of_what_moves(share, holds):
    """η' = diag(0.1, −1) η and Ω = 2I over 10 s: ∫Δ² = 160, which stands against e^1."""
    mesh = CLEAN.mesh

    def always(value):
        return Trajectory(mesh, np.broadcast_to(value, (*mesh.points.shape, *np.shape(value))))

    dynamics = Dynamics(always([[0.1, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.ones(2))
    least = (1.0 + np.log(100.0)) / 160.0
    gains = share * least * np.array([[1.0], [5.0]])
    found = follow(always(2.0 * np.eye(2, 3)), dynamics, np.zeros(2), gains, T).requirement
    assert found.holds == holds
    assert found.evidence["gamma_times_integral"] == pytest.approx(share * (1.0 + np.log(100.0)))
    assert "of a state that may grow by e^1 needs 5.61" in found.text
    # And where η̂ = Ω⁻¹𝒴, the last Ω of every case has to be regular.
    ends = [np.diag([1.0, 4.0]), np.diag([1e-11 if holds else 1e-13, 1.0])]
    extended = np.tile(np.eye(2, 3), (2, 3, 1, 1))
    extended[:, -1, :, :2] = ends
    assert solved(extended, extended[:, -1, :, :2], np.ones(2)).requirement.holds == holds
    # Units do not matter.
    unit = np.array([1e-9, 1e4])
    extended[..., :2] /= unit * unit[:, None]
    assert solved(extended, extended[:, -1, :, :2], unit).requirement.holds == holds
    # Nor do they where a fast law is followed.
    large, small = (
        follow(
            always([[2.0, 0.0, 0.0], [0.0, 2.0, one]]), dynamics, np.array([one, 0.0]),
            1e4 * gains, T,
        ).parameters(slice(None)) / one
        for one in (1.0, 1e-12)
    )
    np.testing.assert_allclose(small, large, rtol=1e-7, atol=1e-12)


def test_without_a_gain_an_estimate_moves_as_what_it_estimates():
    """η' = diag(0, 0.1, −1) η."""
    mesh, rows = CLEAN.mesh, np.array([[0.0, 0.1, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]])
    rows = Trajectory(mesh, np.broadcast_to(rows, (*mesh.points.shape, 2, 4)))
    made = estimators.build({"name": "gradient", "gamma": 1e-15, "initial": START})
    found = made.estimate_moving(CLEAN, T, (), Dynamics(rows, np.ones(3)))
    expected = np.array(START) * np.exp(T[:, None] * [0.0, 0.1, -1.0])
    np.testing.assert_allclose(found.parameters(slice(None))[0], expected, atol=1e-9)


@pytest.mark.parametrize(("weak", "holds"), [(1e-10, True), (1e-8, False)])
def test_a_prior_in_a_direction_of_rounding_is_not_told_from_rounding(weak, holds):
    """A tenth of F⁻¹ in its weakest direction is not from data, which filters know to 1e-11."""
    extended = np.zeros((1, 3, 2, 3))
    extended[..., :2] = [[1.0, 1.0 - weak], [1.0 - weak, 1.0]]
    from_data = extended[:, -1, :, :2] - 0.1 * weak * np.array([[0.5, -0.5], [-0.5, 0.5]])
    assert solved(extended, from_data, np.ones(2)).requirement.holds == holds


# A plain field as an axis -----------------------------------------------------------------------


def test_a_plain_field_is_an_axis_of_separate_estimators():
    gains = {"gamma": [1.0, 10.0, 100.0]}
    both = estimators.build({"name": "fct", "mu": "logspace(-2, -1, 2)", **gains})
    assert [(c["mu"], c["gamma"]) for c in both.cases] == [
        (mu, gamma) for mu in (0.01, 0.1) for gamma in gains["gamma"]
    ]
    found = both.estimate(CLEAN, T)
    whole = np.concatenate([run("fct", CLEAN, mu=mu, **gains) for mu in (0.01, 0.1)])
    assert np.array_equal(found.parameters(slice(None)), whole)
    assert np.array_equal(found.parameters(slice(2, 5)), whole[2:5])
    assert found.delta(T).shape == (6, len(T))
    with pytest.raises(ConfigError, match=r"estimator\.mu: expected .*, got 'x'"):
        estimators.build({"name": "fct", "mu": [0.1, "x"]})


@pytest.mark.parametrize("mu", [[0.01, 0.9], [0.9, 0.01]])
def test_separate_estimators_require_what_one_of_them_lacks(mu):
    """w_c = 1 − μ is reached when γ∫Δ² = −ln(1 − μ): 0.3 here, enough for one of them."""
    both = estimators.build({"name": "fct", "mu": mu, "gamma": 10.0})
    required = both.estimate(CLEAN, T).requirement
    assert not required.holds
    assert required.evidence["gamma_times_integral"] == pytest.approx(0.3, abs=0.1)
    assert required.evidence["needed"] == pytest.approx(-np.log(0.1))
    met = estimators.build({"name": "fct", "mu": mu, "gamma": 1e4}).estimate(CLEAN, T).requirement
    assert met.holds
    assert met.evidence["needed"] == pytest.approx(-np.log(1.0 - mu[0]))  # of the first, then


@pytest.mark.parametrize(("beta", "more"), [
    (0.0, np.sin), (0.4, np.sin), (0.0, lambda t: 2.0 * np.expm1(-3.0 * t)),
])
def test_the_gain_that_nobody_set_is_one_over_the_length_of_the_memory(beta, more):
    """Of Y = 2 + sin(t), or a Y that falls, and ψ = 1: T η̂' = 50 (x/T − η̂), x' = Y − βx."""
    T = np.linspace(0.5, 6.0, 12)
    signal = regression(lambda t: np.ones((*t.shape, 1)), np.array([2.0]), 6.0, disturbance=more)
    found = estimate("ls_drem", signal, T, beta=beta).parameters(slice(None))[0, :, 0]

    def rates(t, x):
        memory = -np.expm1(-beta * t) / beta if beta else t
        return [2.0 + more(t) - beta * x[0], 50.0 / memory * (x[0] / memory - x[1])]

    first = [1e-3 * (2.0 + more(5e-4)), 2.0]
    exact = integrate(rates, first, np.append(1e-3, T))[1:, 1]
    np.testing.assert_allclose(found, exact, rtol=1e-6)


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.05, "hold": "linear"}])
@pytest.mark.parametrize("name", ["ls_drem", "least_squares"])
def test_without_gains_there_are_no_units(name, observer):
    """The same plant in milliseconds and tiny units has the same estimates, which are right."""
    chosen = {"name": name, "f0": None}

    def found(time, size):
        plant = one_state(unknowns={"a": 2}, E=[[time]], A=[[-1]], F=[[size]], initial_state=[size])
        own = observer | {"sample_time": 0.05 * time} if observer else {}
        return gpebo_cli.run(plant, estimator=chosen, observer={"name": "gpebo"} | own,
                             time={"horizon": 5 * time, "samples": 51})

    one, other = found(1.0, 1.0), found(1e-3, 1e-5)
    assert one.details.estimation.requirement.holds
    assert other.details.estimation.requirement.holds
    np.testing.assert_allclose(other.estimates["a"], one.estimates["a"], rtol=1e-9)
    np.testing.assert_allclose(one.estimates["a"][0, -1], 2.0, rtol=2e-3 if observer else 1e-9)


def test_what_is_rounding_in_Y_is_no_estimate():
    """A parameter that is zero, in a tiny unit, and two whose columns differ by a millionth."""
    small = regression(lambda t: three(t) * [1.0, 1.0, 1e-9], np.array([1.5, -0.7, 0.0]))
    (found,) = run("ls_drem", small, f0=None)
    np.testing.assert_allclose(found[-1, :2], [1.5, -0.7], rtol=1e-9)
    assert not found[:, 2].any()
    alike = regression(lambda t: np.stack(
        [np.sin(t) + 1.5, np.sin(t) + 1.5 + 1e-6 * np.cos(3 * t)], axis=-1
    ), np.array([1.5, -0.7]))
    assert not run("ls_drem", alike, f0=None).any()


@pytest.mark.parametrize("began", [0.0, 1e8])
@pytest.mark.parametrize("beta", [0.0, 0.1])
def test_what_is_rounding_in_Y_does_not_hang_on_when_time_began(began, beta):
    """A column of 1e-8 that is what terms of 1 leave: far above their rounding."""
    made = regression(lambda t: three(t) * [1.0, 1.0, 1e-8], np.array([1.5, -0.7, 2e8]))
    mesh = Mesh(began + made.mesh.edges, made.mesh.rule)
    made = replace(made, Y=Trajectory(mesh, made.Y.values), psi=Trajectory(mesh, made.psi.values))
    for name in ("least_squares", "ls_drem"):
        (found,) = run(name, made, began + T, f0=None, beta=beta)
        np.testing.assert_allclose(found[-1], [1.5, -0.7, 2e8], rtol=1e-5)


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.05, "hold": "linear"}])
def test_estimates_that_are_not_what_the_data_say_are_told(observer):
    """From 1e5, e^-6 of which is left: 1 % of the start, as was required, and far from the truth.

    A gain that does leaves no warning, and an estimator that lacks what it needs says that.
    """
    def warned(**estimator):
        chosen = {"name": "gpebo", **observer}
        result = gpebo_cli.run("descriptor", estimator=estimator, observer=chosen)
        return result.details.warnings, result.details.estimation.requirement.holds

    slow = {"gamma": 0.5, "f0": 0.01, "initial": 1e5}
    (warning,), holds = warned(name="ls_drem", **slow)
    assert holds
    assert "theta1, theta2, e0_x1, e0_x2, x1, x2, x3 are up to" in warning
    assert warned(name="ls_drem", **slow | {"gamma": 10.0}) == ((), True)
    assert warned(name="least_squares", f0=0.01, initial=1e5) == ((), False)


@settings(deadline=None, max_examples=8)
@given(
    st.sampled_from([{}, {"remedy": "reset", "reset_interval": 2.0}]),
    st.sampled_from(["ls_drem", "least_squares", "gradient"]), st.floats(-8, 0), st.floats(0, 5),
)
def test_how_far_estimates_may_be_off_is_how_far_they_are(observer, name, small, large):
    """Whatever is the reason: gains, the start of the estimates, what is required or not."""
    gains = {"gamma": 10.0**-small} if name == "gradient" else {"f0": 10.0**small}
    result = gpebo_cli.run(
        "descriptor", estimator={"name": name, "initial": 10.0**large, **gains},
        observer={"name": "gpebo", **observer}, time={"horizon": 5.0, "samples": 11},
    ).details
    told, x = result.estimation.doubts[0], result.simulation.states
    found = np.append(result.estimation.parameters, result.estimation.states, axis=2)[0, -1]
    truth = np.append(result.estimation.true_parameters[-1], x[-1])
    size = np.append(np.abs(result.estimation.true_parameters).max(axis=0), np.abs(x).max(axis=0))
    off = dict(zip([*result.estimation.names, *result.system.states],
                   np.abs(found - truth) / size, strict=True))
    for quantity, doubt in told.items():
        assert off[quantity] <= 3.0 * doubt + 1e-9
        assert doubt <= 10.0 * off[quantity] + 1e-9
    assert told


def test_a_parameter_has_the_size_with_which_it_alone_would_explain_the_data():
    """√(∫Y²/∫ψ_j²) by quadrature; a zero one is compared with that, and no other one is."""
    *squares, of_Y = quad_vec(
        lambda s: np.append(three(s) ** 2, (three(s) @ ETA + wobble(s)) ** 2), 0.0, 10.0
    )[0]
    natural = accuracy.natural_sizes(NOISY, 3)
    np.testing.assert_allclose(natural, np.sqrt(of_Y / squares), rtol=1e-9)
    faint = Trajectory(NOISY.mesh, NOISY.psi.values * [1e-3, 0.0, 1e3])
    other = accuracy.natural_sizes(replace(NOISY, psi=faint), 3)
    np.testing.assert_allclose(other, natural * [1e3, 0.0, 1e-3], rtol=1e-9)
    assert not accuracy.natural_sizes(NOISY, 5).any()
    truth = np.array([[0.0, 1e-3, -2.0], [0.0, -2e-3, 1.0]])
    sizes, _ = accuracy.sizes_of(truth, natural, truth)
    np.testing.assert_array_equal(sizes, [natural[0], 2e-3, 2.0])


def test_a_stream_says_which_estimates_are_far_from_least_squares():
    slow = {"name": "ls_drem", "gamma": 0.5, "f0": 0.01, "initial": 1e5}
    details = gpebo_cli.run("descriptor").details
    signals, whole = details.simulation, details.excitation
    rows = signals.t, signals.inputs, signals.outputs
    for gamma, warned in ((0.5, True), (10.0, False)):
        online = stream(Settings(
            estimator=slow | {"gamma": gamma}, observer={"name": "gpebo"},
            data=DataSettings(hold="linear"), time=TimeSettings(np.nan, np.nan),
        ), shipped("descriptor"))(0.0, np.append(rows[1][0], rows[2][0]))  # fmt: skip
        made = online.feed(*rows)
        last = online.last_states(made.parameters[:, -1])[:, 0]
        np.testing.assert_allclose(last, made.states[:, -1], rtol=1e-9)
        said, known = stream_verdict(online), online.excitation()
        assert ("least squares over the same data" in said) == warned
        assert said.startswith(f"{len(signals.t)} rows, t = 0 to 20; interval-exciting from t = ")
        assert known.t_c == pytest.approx(whole.t_c, abs=2.0 * signals.t[1])
        assert known.level == pytest.approx(whole.level, rel=1e-3)
        assert ", parameters well determined at the end; |Y − ψη̂| with the final" in said


@pytest.mark.parametrize(("delta", "digits", "error", "good"), [
    (1.0, 1.0, 2e-12, True), (1.0, 1.0, 1e-9, False), (1.0, 1e-7, 1e-9, True),
    (1.0, 1e-7, 1e-5, False), (0.0, 1e-7, 1e-9, False), (1.0, 0.0, 1e-9, False),
])
def test_a_step_of_the_power_law_is_resolved_to_its_digits(delta, digits, error, good):
    """By the last Legendre coefficient and the last change; what is not known needs no digits."""
    mesh = initial_mesh(0.0, 1.0, [], 1, radau_rule(5))
    path = SimpleNamespace(mesh=mesh, quotient=np.full((1, 6, 1), -100.0), floor=1.0)
    wave = np.polynomial.legendre.Legendre.basis(5)(2.0 * mesh.rule.points - 1.0)
    values = 3.0 + 100.0 * np.array([error, 0.0, 0.0])[:, None] * wave  # sizes are those of η̄
    change, nodes = np.array([0.0, error, 0.0]), np.ones((3, 5))
    found = _resolved(path, values, change, delta * nodes, digits * nodes)
    np.testing.assert_array_equal(found, [good, good, True])


def test_elements_that_a_large_gain_asks_for_are_no_more_than_may_be(monkeypatch):
    (path,) = estimate("drem", CLEAN, gamma=1.0).groups
    assert resolved_for(path, np.array([[1e12]])).mesh.size > path.mesh.size
    monkeypatch.setattr("gpebo_cli.estimators._scalar.MAX_ELEMENTS", path.mesh.size - 1)
    assert resolved_for(path, np.array([[1e12]])) is path


def test_a_power_law_that_no_step_resolves_ends_in_one_line():
    made, rng = estimate("power", CLEAN, gamma=1e9), np.random.default_rng(0)
    (path,) = made.groups
    rough = replace(
        path, mixed=np.ones_like(path.mixed), quotient=rng.standard_normal(path.quotient.shape),
        signals=lambda t, inside: (
            rng.standard_normal(len(t)), rng.standard_normal((len(t), 3)), np.ones(len(t)),
        ),
    )
    with pytest.raises(SolverError, match="the power law is not resolved near t = 0"):
        made.law(rough, ETA + 1.0, np.array([[1e9]]))


@pytest.mark.parametrize("gain", [1e10, 1e24, 1e30])
def test_a_gain_that_makes_up_for_rounding_does_not_break_the_scalar_law(gain):
    """Δ and η̄ jump from point to point by rounding: no element is short enough for that."""
    mesh = initial_mesh(0.0, 2.0, [], 8, radau_rule(5))

    def signals(t, inside):
        delta = 1e-12 * np.sin(1e9 * t + 1.0)
        eta = np.array([1.4, -2.0]) + 1e-6 * np.sin(np.outer(1e8 * t, [1.0, 3.0]))
        return delta, delta[:, None] * eta, np.full(len(t), 1e-6)

    delta, Y, digits = (
        x.reshape(*mesh.points.shape, *x.shape[1:]) for x in signals(mesh.points.ravel(), 0)
    )
    path = scalar_path(
        mesh, signals, delta, digits, Y / delta[..., None], np.linspace(0.0, 2.0, 5), 0.0)
    found = scalar_law(path, np.array([1.0, 1.0]), np.array([[gain]]))
    reached = np.exp(-gain * path.energy[-1, -1])
    np.testing.assert_allclose(
        found[0, -1], [1.4, -2.0] + reached * np.array([-0.4, 3.0]), atol=1e-5)


@pytest.mark.parametrize("digits", [1.0, 1e-7])
@pytest.mark.parametrize("gain", [0.3, 1e4])
def test_the_sign_of_delta_decides_nothing(gain, digits):
    """Rows of Ω in another order turn it and 𝐘; the elements are the same ones then, too."""
    mesh, t = initial_mesh(0.0, 4.0, [], 6, radau_rule(4)), np.linspace(0.0, 4.0, 9)
    found = []
    for sign in (1.0, -1.0):
        def signals(t, inside, sign=sign):
            delta = sign * (0.2 + np.sin(2.0 * t))
            eta = np.stack([1.0 + 0.1 * np.sin(t), -3.0 + digits * np.cos(40.0 * t)], axis=1)
            return delta, delta[:, None] * eta, np.full(len(t), digits)

        delta, Y, known = (
            x.reshape(*mesh.points.shape, *x.shape[1:]) for x in signals(mesh.points.ravel(), 0)
        )
        path = scalar_path(mesh, signals, delta, known, Y / delta[..., None], t, 0.0)
        found.append(scalar_law(path, np.array([2.0, 1.0]), np.array([[gain]])))
    np.testing.assert_array_equal(*found)


def test_so_they_are_of_several_recordings(tmp_path):
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    signals = gpebo_cli.run("descriptor", observer="none").details.simulation
    for file, count in zip(files, (401, 301), strict=True):
        write_table(file, {"t": signals.t[:count], "u": signals.inputs[:count, 0],
                           "y": signals.outputs[:count, 0]})
    several = {"name": "csv", "file": [str(file) for file in files], "hold": "cubic"}
    slow = {"name": "ls_drem", "gamma": 1.5, "f0": 0.01, "initial": 1e5}
    details = gpebo_cli.run("descriptor", estimator=slow, data=several).details
    assert details.estimation.requirement.holds
    assert "least squares over the same data" in "".join(details.warnings)


def test_a_warning_says_how_much_of_the_data_estimates_leave():
    slow = {"name": "ls_drem", "gamma": 1.5, "f0": 0.01, "initial": 1e5}
    details = gpebo_cli.run("descriptor", estimator=slow).details
    r, eta = details.regression, details.estimation.parameters[0, -1]
    power = [trapezoid((Y**2).sum(axis=1), r.t) for Y in (r.Y - r.psi @ eta, r.Y)]
    (said,) = re.findall(r"over the same data, which leaves (\S+) of Y and they (\S+):",
                         "".join(details.warnings))
    assert float(said[0]) < 1e-6
    assert float(said[1]) == pytest.approx(np.sqrt(power[0] / power[1]), rel=0.06)


@pytest.mark.parametrize(("group", "path"), [
    (group, path) for group in (estimators, observers)
    for path in sorted((CONF / group.__name__.split(".")[-1][:-1]).glob("*.yaml"))
], ids=lambda p: getattr(p, "stem", ""))
def test_defaults_from_python_are_those_of_the_files(group, path):
    content = parse(path.read_text(encoding="utf-8"), str(path))
    for key in ("title", "reference", "estimator"):
        content.pop(key, None)
    assert group.build(content) == group.build({"name": content["name"]})


def test_what_fct_hands_on_is_declared_as_where_it_goes():
    own = {each.name: each for each in fields(FiniteTime)}
    # Those of ls_drem may be relative.
    for inner, other in ((Drem, set()), (LsDrem, {"gamma", "f0"})):
        for each in fields(inner):
            if each.name not in other:
                mine = own[each.name]
                assert (mine.default, mine.metadata) == (each.default, each.metadata)
    assert own["gamma"].metadata["gain"].by_parameter
    assert own["gamma"].metadata["gain"].auto


@pytest.mark.parametrize("last", [np.nan, 2e300, 0.0])
def test_one_wrong_gain_of_many_is_refused(last):
    with pytest.raises(ConfigError, match=r"estimator\.gamma"):
        estimators.build({"name": "drem", "gamma": [1.0] * 9 + [last]}).cases(["a"])


def test_steps_below_rounding_that_add_up_are_followed():
    """η̄ = t/1000, of which each step is less than 𝐘/Δ is known to: η̂ lags behind by 1/γ."""
    mesh = initial_mesh(0.0, 10.0, [], 400, radau_rule(4))
    ones, t = np.ones(mesh.points.shape), np.linspace(5.0, 10.0, 6)
    path = scalar_path(mesh, None, ones, 1e-9 * ones, 1e-3 * mesh.points[..., None], t, 1.0)
    found = scalar_law(path, np.zeros(1), np.array([[10.0]]))
    np.testing.assert_allclose(found[0, :, 0], 1e-3 * (t - 0.1), atol=1e-12)
    nothing = scalar_path(mesh, None, ones, 0.0 * ones, 0.0 * mesh.points[..., None], t, 1.0)
    assert (scalar_law(nothing, np.ones(1), np.array([[10.0]])) == 1.0).all()


def test_where_there_is_nothing_to_estimate_nothing_is_needed():
    regression = LinearRegression.from_functions(
        lambda t: np.zeros((*t.shape, 1, 0)), lambda t: np.zeros((*t.shape, 1)), [], 1.0
    )
    found = _segments.estimate(Drem(gamma=[1.0, 2.0]), regression, T)
    assert found.requirement.holds
    assert found.parameters(slice(None)).shape == (2, len(T), 0)


def test_an_estimator_that_is_not_resolved_names_what_would_help(monkeypatch):
    """It advised to raise solver.max_elements, which has nothing to do with it."""
    monkeypatch.setattr("gpebo_cli.estimators._vector._MAX_ELEMENTS", 2)
    with pytest.raises(SolverError, match="lower its gain, or use estimator=least_squares"):
        gpebo_cli.run("circuit", estimator="gradient", gamma=1e4)


@pytest.mark.parametrize("units", [None, 1e-3])
def test_covariance_and_solution_by_elimination_are_those_of_the_spectrum(units):
    """Of G with few digits, or none in a direction, with f₀ or without (units of rounding)."""
    vectors = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    sizes = np.array([[4.0, 2.0, 1.0], [4.0, 2.0, 1e-4], [4.0, 2.0, 1e-14], [4.0, 0.0, 0.0]])
    G = (vectors * sizes[:, None]) @ vectors.T
    of_all = None if units is None else np.full((4, 3), units)
    info = InformationAt(np.concatenate([G, G[:, :, :1]], axis=2), np.ones(4), of_all)
    own = 1.0 if units is None else units**2
    known = sizes / own > 1e-2 if units else np.ones_like(sizes, dtype=bool)
    share = np.where(known, 2.0 / (2.0 * sizes + 0.5 * own), 0.0)
    expected = (vectors * share[:, None]) @ vectors.T
    np.testing.assert_allclose(info.covariance(2.0, 0.5), expected, rtol=1e-9, atol=1e-9)
    H = 2.0 * sizes / (2.0 * sizes + 0.5 * own)  # eigenvalues of H, and of adj(H) αF by minors
    others = np.stack([H[:, [1, 2]], H[:, [0, 2]], H[:, [0, 1]]], axis=1).prod(axis=2)
    delta, mixed, _ = info.mixing(2.0, 0.5, np.ones(4, dtype=bool))
    np.testing.assert_allclose(delta, H.prod(axis=1), rtol=1e-9, atol=1e-8)
    weights = others * 2.0 / (2.0 * sizes + 0.5 * own)
    np.testing.assert_allclose(
        mixed, (vectors * weights[:, None]) @ vectors.T, rtol=1e-8, atol=1e-8 * weights.max()
    )
    found, by_spectrum = (of.solution(2.0, 0.5, np.array(START)) for of in (info, info.spectrum))
    np.testing.assert_array_equal(info.solution(2.0, 0.5, np.array(START)), found)  # of each gain
    np.testing.assert_allclose(found, by_spectrum, atol=1e-8)
    if units is None:  # ‖F‖ of F = (f₀ I + α G)⁻¹ in beside a bound of 4
        forgetting = 0.3 * (1.0 - np.linalg.norm(expected, 2, axis=(1, 2)) / 2.0 / 4.0)
        np.testing.assert_allclose(info.forgetting(2.0, 0.5, 0.3, 4.0), forgetting, rtol=1e-9)


def test_how_wrong_a_mixed_law_is_does_not_depend_on_units_of_the_regression():
    mesh, found = Mesh(np.linspace(0.0, 1.0, 4), radau_rule(4)), []
    for unit in (1.0, 1e6):
        def signals(t, _, unit=unit):
            delta = unit * (2.0 + np.sin(t))
            return delta, delta[:, None] * [3.0, -5.0], np.full(len(t), 1e-3)

        gains = np.array([[2.0], [7.0]]) / unit**2
        path = SimpleNamespace(signals=signals, pace=None)
        found.append(_element_maps(path, mesh, np.ones((3, 2)), gains))
    (maps, errors), (other_maps, other_errors) = found
    assert errors.min() > 0.0
    np.testing.assert_allclose(other_maps, maps, rtol=1e-9)
    np.testing.assert_allclose(other_errors, errors, rtol=1e-9)


def test_a_gain_that_would_do_is_named_where_the_one_in_use_is_less():
    assert would_do(4.0, 4.0) == would_do(5.0, 4.0) == ""
    assert would_do(3.0, 4.0) == ": γ ≥ 4"
    assert would_do(3.0, np.inf) == ": no γ would do"


def test_persistent_excitation_is_asked_of_the_smallest_gain():
    alone, beside = (
        estimate("gradient", CLEAN, gamma=gamma).requirement for gamma in (0.5, [3.0, 0.5, 8.0])
    )
    assert str(beside) == str(alone)  # its gain is nan
    assert str(beside) != str(estimate("gradient", CLEAN, gamma=8.0).requirement)


@pytest.mark.parametrize(("estimator", "gamma", "rate"), [
    ("lion", 0.1, 0.022), ("drem", 10.0, 120.0), ("fct", 1e4, 3.0),
])  # fmt: skip
def test_what_disturbs_a_psi_of_next_to_nothing_does_not_move_estimates(estimator, gamma, rate):
    """𝐘/Δ is 1e19 at first, and 1e40 behind the pulse, which has no weight in the law."""
    pulse = "exp(-((t - 2)/0.3)**2)"
    found = gpebo_cli.run(
        regression={"name": "pulse", "unknowns": {"k": -2}, "psi": [[pulse]],
                    "Y": [f"-2*{pulse} + 0.5*cos(5*t)"]},
        estimator={"name": estimator, "gamma": gamma, "initial": [1.5], "lambda": rate},
        time={"horizon": 5, "samples": 21},
    )

    def law(t, z):
        psi = np.exp(-(((t - 2.0) / 0.3) ** 2))
        own = 1.0 if estimator == "lion" else psi
        Y = own * (-2.0 * psi + 0.5 * np.cos(5.0 * t))
        return [rate * (own * psi - z[0]), rate * (Y - z[1]),
                gamma * z[0] * (z[1] - z[0] * z[2]), gamma * z[0] ** 2]

    z = solve_ivp(law, (0.0, 5.0), [0.0, 0.0, 1.5, 0.0], t_eval=found.t, method="LSODA",
                  rtol=1e-10, atol=1e-13, max_step=0.05).y  # fmt: skip
    expected, left = z[2], np.minimum(np.exp(-z[3]), 0.9)
    if estimator == "fct":
        expected = (expected - left * 1.5) / (1.0 - left)
    np.testing.assert_allclose(found.estimates["k"][0], expected, atol=1e-6)


@pytest.mark.parametrize("estimator", ["power", "drem", "lion"])
def test_what_disturbs_a_psi_of_next_to_nothing_does_not_move_estimates_at_samples(estimator):
    pulse = "exp(-((t - 2)/0.3)**2)"
    regression = {"name": "pulse", "unknowns": {"k": -2}, "psi": [[pulse]],
                  "Y": [f"-2*{pulse} + 0.5*cos(5*t)"]}
    both = [gpebo_cli.run(
        regression=regression, time={"horizon": 5, "samples": 11}, observer=observer,
        estimator={"name": estimator, "gamma": 10.0, "initial": [1.5], "lambda": 3.0},
    ).estimates["k"] for observer in ({}, {"sample_time": 0.005, "hold": "linear"})]
    np.testing.assert_allclose(*both, atol=2e-3)


@pytest.mark.parametrize("start", [0.0, 0.1])
def test_a_memory_that_begins_with_the_data_is_soon_resolved(monkeypatch, start):
    """One over its length has an integral that grows without end toward the start."""
    rounds, path = [], estimators._scalar.scalar_path
    monkeypatch.setattr(
        estimators._scalar, "scalar_path", lambda *given: rounds.append(1) or path(*given)
    )
    t = np.arange(4) / 10.0
    plant = {
        "name": "p", "states": ["x"], "inputs": {"V": 0}, "outputs": ["y"], "E": [[1]],
        "A": [[-1]], "B": [[1]], "C": [[1]], "initial_state": [1],
    }
    found = gpebo_cli.run(
        plant, estimator="ls_drem", data={"t": t, "V": 1.0 + 0 * t, "y": 10.0 * t},
        time={"start": start},
    )
    assert found.details.estimation.requirement.holds
    assert 0 < len(rounds) < 60


@pytest.mark.parametrize(("size", "fits"), [(1e150, True), (1e160, False)])
def test_what_is_mixed_has_squares_that_are_numbers(size, fits):
    mesh = initial_mesh(0.0, 1.0, [], 4, radau_rule(3))
    extended = Trajectory(mesh, np.broadcast_to([[size, 3.0 * size]], (4, 4, 1, 2)))
    if fits:
        np.testing.assert_allclose(mix(extended, np.array([1.0])).quotient, 3.0, rtol=1e-15)
    else:
        with np.errstate(over="ignore"), pytest.raises(
            SolverError, match=r"Δ² of Δ = det\(Ω\) is too large .* near t = 0;"
        ):
            mix(extended, np.array([1.0]))


@pytest.mark.parametrize("beta", [0.0, 0.4])
def test_the_pace_of_a_law_is_one_over_the_memory_of_its_data(beta):
    t = np.array([0.5, 1.5, 4.0])
    memory = [quad(lambda s, t=t: np.exp(-beta * (t - s)), 1.0, t)[0] for t in t[1:]]
    found = one_over_memory(t, beta, 1.0)
    np.testing.assert_allclose(found, [0.0, *np.reciprocal(memory)], rtol=1e-12)


@pytest.mark.parametrize(("paced", "text"), [
    (False, "γ∫Δ² = 1 at the smallest gain 2; a fall to 1 % needs 4: γ ≥ 8"),
    (True, "2 ∫Δ²/T = 1, T being the length of the memory; a fall to 1 % needs 4"),
])
def test_of_a_gain_that_memory_paces_no_other_one_is_told(paced, text):
    found = energy_requirement(
        np.array([[3.0, 2.0]]), 0.5, "IE", 4.0, "a fall to 1 %", paced=paced
    )
    assert (found.text, found.holds) == (text, False)


def test_each_of_several_estimators_has_a_gain_of_its_own():
    plant = one_state(A=[[-1]])

    def gains(**settings):
        found = api_run(plant, estimator={"name": "instrumental", "gamma": "auto", **settings},
                        time={"horizon": 2.0})
        return [case["gamma"] for case in found.cases]

    assert gains(delay=[0.2, 0.4]) == pytest.approx([*gains(delay=0.2), *gains(delay=0.4)])


def test_several_estimators_have_delta_of_all_or_none():
    t = np.array([0.0, 1.0, 2.0])
    one, other = (SimpleNamespace(delta=lambda t, k=k: k * t) for k in (2.0, 3.0))
    both = SeveralEstimates((one, other), (1, 2)).delta(t)
    np.testing.assert_array_equal(both, [2.0 * t, 3.0 * t, 3.0 * t])
    without = SimpleNamespace(delta=lambda _: None)
    assert SeveralEstimates((one, without), (1, 2)).delta(t) is None


def test_a_gain_that_no_data_ask_for_is_the_usual_one():
    plant = one_state(A=[[-1]], C=[["max(0, t - 8)"]])
    found = api_run(plant, estimator="drem", gamma="auto", time={"horizon": 3.0})
    assert [case["gamma"] for case in found.cases] == [1e10]


def test_power_does_not_move_where_nothing_is_known():
    """Δ is below 2e-16; where 𝐘/Δ was rounding Newton's method left for 1e21 and a step of 0.06."""
    found = api_run(
        random_system(241)[0], time={"horizon": HORIZON, "samples": 3}, initial=0.67,
        estimator="power", gamma=14, gamma2=3.13e7, alpha=0.3, **{"lambda": 1.79},
        observer={"name": "gpebo", "form": "strangeness_free"}, solver={"stages": 8, "tol": 1e-9},
    ).details.estimation
    assert np.abs(found.delta).max() < 2e-16
    np.testing.assert_allclose(found.parameters, 0.67, rtol=1e-9)
