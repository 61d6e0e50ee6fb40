"""Riccati equation and filter against scipy's integrator, its algebraic solution, and limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_are

from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import _riccati, _stiff_riccati
from gpebo_cli.observers._observability import window_gramians
from gpebo_cli.observers._riccati import (
    Filtered,
    StateSpace,
    _conditioning,
    _renewed,
    filter_windows,
    pair,
    quotient,
    run_filter,
)

Of = Callable[[float], Array]


@dataclass(frozen=True)
class Case:
    """A small system: functions of one time."""

    A: Of
    b: Of
    c: Of
    z: Of
    into: Of  # Γ
    D: Of
    S: Array

    def state_space(self, t: Array) -> StateSpace:
        def at(function: Of) -> Array:
            return np.array([function(float(s)) for s in t])

        into, D = at(self.into), at(self.D)
        return StateSpace(
            at(self.A), at(self.b)[..., None], at(self.c), at(self.z)[..., None],
            into @ self.S @ transpose(into), into @ self.S @ transpose(D),
            D @ self.S @ transpose(D),
        )

    def filtered(
        self, start: Array, P0: Array, horizon: float, elements: int = 20, tol: float = 1e-12
    ) -> Filtered:
        mesh = initial_mesh(0.0, horizon, [], elements, radau_rule(12))
        return run_filter(
            lambda t, inside: (self.state_space(t), ()), start[:, None], P0, mesh,
            tol=tol, max_elements=20_000,
        )

    def by_scipy(self, start: Array, P0: Array, t: Array) -> tuple[Array, Array]:
        """The equations as a textbook has them, N included, step by step."""
        n = len(start)

        def slope(s: float, v: Array) -> Array:
            x, P = v[:n], v[n:].reshape(n, n)
            A, c, into, D = self.A(s), self.c(s), self.into(s), self.D(s)
            V = D @ self.S @ D.T
            L = (P @ c.T + into @ self.S @ D.T) @ np.linalg.inv(V)
            dP = A @ P + P @ A.T + into @ self.S @ into.T - L @ V @ L.T
            return np.concatenate([A @ x + self.b(s) + L @ (self.z(s) - c @ x), dP.ravel()])

        found = solve_ivp(
            slope, (0.0, float(t[-1])), np.concatenate([start, P0.ravel()]), method="DOP853",
            rtol=1e-12, atol=1e-14, t_eval=t,
        )
        return found.y[n:].T.reshape(-1, n, n), found.y[:n].T


def varying(size: float = 1e-2) -> Case:
    """Three states, one of them an unknown that drifts, one output, correlated noise."""
    G = np.array([[0.1, -0.1, 0.6], [0.1, -0.5, 0.4], [1.3, 0.9, -0.7]])
    return Case(
        A=lambda t: np.array(
            [[-0.5, 1 + 0.3 * np.sin(t), 0], [-1, -0.2, 0.5 * np.cos(t)], [0, 0, 0]]
        ),
        b=lambda t: np.array([np.sin(t), 0.0, 0.0]),
        c=lambda t: np.array([[1.0, 0.5 * np.cos(2 * t), 0.2]]),
        z=lambda t: np.array([np.cos(t) + 0.1 * t]),
        into=lambda t: G * (1 + 0.2 * np.sin(t)),
        D=lambda t: np.array([[0.3, 0.0, 1.0]]),
        S=size * np.diag([1.0, 2.0, 1.0]),
    )


def constant(A: Array, c: Array, Q: Array, V: Array, N: Array) -> Case:
    """Constant matrices; the joint covariance is S itself."""
    n, r = len(A), len(c)
    S = np.block([[Q, N], [N.T, V]])
    into = np.concatenate([np.eye(n), np.zeros((n, r))], axis=1)
    D = np.concatenate([np.zeros((r, n)), np.eye(r)], axis=1)
    return Case(
        lambda t: A, lambda t: np.zeros(n), lambda t: c, lambda t: np.full(r, np.sin(t)),
        lambda t: into, lambda t: D, S,
    )


def relative(P: Array, expected: Array) -> float:
    """Largest error in units of the standard deviations."""
    d = np.sqrt(np.einsum("...ii->...i", expected))
    return float(np.abs((P - expected) / (d[..., :, None] * d[..., None, :])).max())


@pytest.mark.parametrize(("size", "start", "P0", "horizon", "of_P", "of_x"), [
    (1e-2, [0.5, 0.0, -1.0], [10.0, 5.0, 2.0], 20.0, 1e-9, 1e-10),
    # P(0) is 10⁷ times V: it falls within microseconds, and scipy's own error is as large.
    (1e-6, [0.0, 0.0, 0.0], [10.0, 10.0, 10.0], 4.0, 1e-6, 1e-7),
])
def test_time_varying_correlated_noise_against_scipy(size, start, P0, horizon, of_P, of_x):
    case, start, P0 = varying(size), np.array(start), np.diag(P0)
    t = np.linspace(0.0, horizon, 2 * int(horizon) + 1)
    P, x = case.filtered(start, P0, horizon).at(t)
    expected_P, expected_x = case.by_scipy(start, P0, t)
    assert relative(P[1:], expected_P[1:]) < of_P
    assert np.abs(x[..., 0] - expected_x).max() < of_x * np.abs(expected_x).max()


def test_limit_is_the_algebraic_riccati_solution():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(4, 4)) + 0.3 * np.eye(4)  # not stable
    c = rng.normal(size=(2, 4))
    root = rng.normal(size=(6, 8))
    S = 0.01 * root @ root.T
    Q, N, V = S[:4, :4], S[:4, 4:], S[4:, 4:]
    case = constant(A, c, Q, V, N)
    P, _ = case.filtered(np.zeros(4), np.eye(4), 60.0).at(np.array([60.0]))
    expected = solve_continuous_are(A.T, c.T, Q, V, s=N)
    assert relative(P[0], expected) < 1e-9


def test_unstable_system_stays_accurate_to_40_seconds():
    """Eigenvalues 0.64 ± 1.01i and 0.33: the state grows to 1e11; the estimate is right of it."""
    A = np.zeros((4, 4))
    A[:2, :2], A[2, 2] = [[0.64, 1.01], [-1.01, 0.64]], 0.33
    A[:3, 3] = [0.5, -0.2, 0.3]  # an unknown constant drives it
    c = np.array([[1.0, 0.3, 0.7, 0.0]])
    truth = np.array([1.0, -0.5, 2.0, 0.8])
    case = constant(A, c, np.zeros((4, 4)), np.array([[1e-4]]), np.zeros((4, 1)))
    case = Case(
        case.A, case.b, case.c, lambda t: c @ expm(A * t) @ truth, case.into, case.D, case.S
    )
    t = np.array([10.0, 20.0, 30.0, 40.0])
    filtered = case.filtered(np.zeros(4), 10.0 * np.eye(4), 40.0)
    P, x = filtered.at(t)
    state = np.array([expm(A * s) @ truth for s in t])
    size = np.linalg.norm(state[:, :3], axis=1)
    error = np.linalg.norm((x[..., 0] - state)[:, :3], axis=1)
    assert (error[1:] < 1e-9 * size[1:]).all()
    assert np.isfinite(P).all()
    P, _ = filtered.at(np.linspace(*filtered.mesh.edges[[0, -1]], 200))
    assert (np.linalg.eigvalsh(P)[:, 0] > -1e-9 * np.trace(P, axis1=1, axis2=2)).all()
    assert filtered.error_estimate < 1e-6


def test_result_does_not_depend_on_the_restarts():
    case, start, P0 = varying(), np.zeros(3), 10.0 * np.eye(3)
    t = np.linspace(0.5, 20.0, 40)
    coarse, fine = case.filtered(start, P0, 20.0, 10), case.filtered(start, P0, 20.0, 277)
    assert fine.mesh.size > 1.5 * coarse.mesh.size
    (P, x), (Q, y) = coarse.at(t), fine.at(t)
    assert relative(P, Q) < 1e-9
    assert np.abs(x - y).max() < 1e-9 * np.abs(y).max()


def test_the_error_estimate_is_of_the_estimate_where_the_covariance_rests():
    """P = 1 solves −2P + 3 − P² = 0; ζ̂' = −2ζ̂ + sin 40t is resolved roughly."""
    one = np.ones((1, 1))
    case = constant(-one, one, 3.0 * one, one, 0.0 * one)
    case = replace(case, z=lambda t: np.array([np.sin(40.0 * t)]))
    rough = case.filtered(np.zeros(1), one, 10.0, tol=1e-2)
    t = np.unique(rough.mesh.points)
    P, x = rough.at(t)
    np.testing.assert_allclose(P, 1.0, rtol=1e-12)
    exact = (2.0 * np.sin(40.0 * t) - 40.0 * np.cos(40.0 * t) + 40.0 * np.exp(-2.0 * t)) / 1604.0
    wrong = np.abs(x[:, 0, 0] - exact).max() / np.abs(exact).max()
    assert 0.1 < rough.error_estimate / wrong < 10.0


@pytest.mark.parametrize("seen", [1.0, 1e-2])
def test_the_error_estimate_of_a_covariance_is_in_deviations(seen):
    """Also where the filter has little to go by: as the state is driven so its deviations move."""
    case, t = varying(), np.linspace(0.0, 6.0, 500)
    driven = replace(
        case, c=lambda t: seen * case.c(t), z=lambda t: np.zeros(1), b=lambda t: np.zeros(3),
        into=lambda t: np.exp(1.5 * np.sin(4.0 * t)) * case.into(t),
    )
    rough, fine = (
        driven.filtered(np.zeros(3), 1e-3 * np.eye(3), 6.0, 6, tol) for tol in (1e-3, 1e-12)
    )
    wrong = relative(rough.at(t)[0], fine.at(t)[0])
    assert 0.1 < rough.error_estimate / wrong < 10.0


def test_many_elements_take_few_stages_and_lose_nothing():
    """Where samples have made elements short, a high order would be paid for nothing."""
    case, start, P0, t = varying(), np.zeros(3), 10.0 * np.eye(3), np.linspace(0.5, 20.0, 40)
    few, many = (case.filtered(start, P0, 20.0, elements) for elements in (20, 1000))
    assert (few.mesh.rule.stages, many.mesh.rule.stages) == (12, 6)
    assert many.mesh.size < 1500  # shorter ones where P falls, at the start
    assert many.error_estimate < 1e-9
    (P, x), (Q, y) = few.at(t), many.at(t)
    assert relative(P, Q) < 1e-9
    assert np.abs(x - y).max() < 1e-9 * np.abs(y).max()


def test_without_noise_on_the_state_it_is_recursive_least_squares():
    """Q = 0: P⁻¹ = P₀⁻¹ + ∫cᵀV⁻¹c, ζ̂ = P (P₀⁻¹ζ̂₀ + ∫cᵀV⁻¹z) for constant ζ."""
    case = Case(
        A=lambda t: np.zeros((2, 2)), b=lambda t: np.zeros(2),
        c=lambda t: np.array([[1.0, t]]), z=lambda t: np.array([2.0 - 3.0 * t + np.sin(t)]),
        into=lambda t: np.zeros((2, 1)), D=lambda t: np.ones((1, 1)), S=np.array([[0.1]]),
    )
    T = 3.0
    P0, start = np.diag([4.0, 9.0]), np.array([1.0, 1.0])
    G = np.array([[T, T**2 / 2], [T**2 / 2, T**3 / 3]]) / 0.1
    ends = [
        2 * T - 1.5 * T**2 + 1 - np.cos(T), T**2 - T**3 + np.sin(T) - T * np.cos(T)
    ]
    information = np.linalg.inv(P0) + G
    expected = np.linalg.solve(information, np.linalg.solve(P0, start) + np.array(ends) / 0.1)
    P, x = case.filtered(start, P0, T).at(np.array([T]))
    np.testing.assert_allclose(P[0], np.linalg.inv(information), rtol=1e-10)
    np.testing.assert_allclose(x[0, :, 0], expected, rtol=1e-10)


@pytest.mark.parametrize("slow", [1.0, 1e6])
def test_a_constant_that_pushes_hard_takes_no_more_elements(slow):
    """x' = 10⁶θ: by least squares, P = Ψ (P₀⁻¹ + ∫ΨᵀWΨ)⁻¹ Ψᵀ with Ψ = [1 0; 10⁶t 1].

    In other units of time, too.
    """
    push, P0, V, T = 1e6 / slow, np.diag([10.0, 10.0]), 1e5 * slow, 20.0 * slow
    A, c = np.array([[0.0, 0.0], [push, 0.0]]), np.array([[0.0, 1.0]])
    case = constant(A, c, np.zeros((2, 2)), np.array([[V]]), np.zeros((2, 1)))
    case = replace(case, z=lambda t: np.array([np.sin(t / slow)]))
    filtered = case.filtered(np.zeros(2), P0, T)
    G = np.array([[push**2 * T**3 / 3, push * T**2 / 2], [push * T**2 / 2, T]]) / V
    reached = np.array([[1.0, 0.0], [push * T, 1.0]])
    expected = reached @ np.linalg.inv(np.linalg.inv(P0) + G) @ reached.T
    assert relative(filtered.at(np.array([T]))[0], expected[None]) < 1e-6
    assert filtered.mesh.size < 1000  # it was in proportion to the push: more than 50,000


def test_known_states_stay_known():
    """P(0) = 0 and no process noise: nothing is learnt, nothing is divided by zero."""
    case, start = varying(), np.array([0.5, 0.0, -1.0])
    case = Case(case.A, case.b, case.c, case.z, lambda t: np.zeros((3, 3)), case.D, case.S)
    P, x = case.filtered(start, np.zeros((3, 3)), 5.0).at(np.array([5.0]))
    free = solve_ivp(
        lambda t, v: case.A(t) @ v + case.b(t), (0.0, 5.0), start, rtol=1e-11, atol=1e-13
    )
    assert not P.any()
    np.testing.assert_allclose(x[0, :, 0], free.y[:, -1], rtol=1e-9)


def test_pair_and_quotient_are_inverse():
    P, x = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    mixed = pair(P, x) @ np.block([
        [np.array([[1.0, 5.0], [2.0, -1.0]]), np.ones((2, 3))], [np.zeros((3, 2)), np.eye(3)]
    ])
    back, estimate = quotient(mixed)
    np.testing.assert_allclose(back, P, rtol=1e-13)
    np.testing.assert_allclose(estimate, x, rtol=1e-13)


@pytest.mark.parametrize(("variance", "message"), [
    (1e6, r"fall to 5\.[45]e-20 of .* beyond the digits of a double; give a gain"),
    (1e-2, "may fall too fast from where it starts: give a gain"),
])
def test_a_covariance_that_cannot_be_resolved_is_refused_with_what_to_change(variance, message):
    case = varying(1e-12)
    mesh = initial_mesh(0.0, 20.0, [], 20, radau_rule(12))
    with pytest.raises(SolverError, match=message):
        run_filter(
            lambda t, inside: (case.state_space(t), ()), np.zeros((3, 1)), variance * np.eye(3),
            mesh, tol=1e-12, max_elements=100, advice="give a gain",
        )


def test_elements_in_which_conditioning_is_lost_are_cut():
    """ζ' = −50 ζ + noise is at rest, but X₁ grows by e⁵⁰ in one second."""

    def model(t, inside):
        one = np.ones((len(t), 1, 1))
        return StateSpace(-50.0 * one, 0.0 * one, one, 0.0 * one, 100.0 * one, 0.0 * one, one), ()

    mesh = initial_mesh(0.0, 2.0, [], 2, radau_rule(12))
    found = run_filter(
        model, np.zeros((1, 1)), np.ones((1, 1)), mesh, tol=1e-3, max_elements=1_000
    )
    assert np.abs(found.pair.values[:, :, 0, 0]).max() <= 1e3


def test_conditioning_is_lost_in_the_first_element_that_grows_though_others_do_not():
    X = np.tile(pair(np.eye(2), np.ones((2, 1))), (4, 6, 1, 1))
    X[2, 3:, 0, 0] = 1e7
    lost, signal = _conditioning(X, 1e-9)
    assert lost == 2
    assert (np.ptp(signal, axis=1) > 0.0).ravel().tolist() == [False, False, True, False]


def test_what_follows_the_estimate_is_resolved_too():
    """cos 50 t, of which elements of a second would see nothing."""
    case = constant(*(value * np.eye(1) for value in (-1.0, 1.0, 1.0, 1.0, 0.0)))
    found = run_filter(
        lambda t, inside: (case.state_space(t), (np.cos(50.0 * t),)), np.zeros((1, 1)), np.eye(1),
        initial_mesh(0.0, 2.0, [], 2, radau_rule(12)), tol=1e-9, max_elements=1_000,
        monitor=lambda estimate, extras: [(extras[0][..., None] * np.ones(1), 0.0)],
    )
    t = np.linspace(0.0, 2.0, 101)
    np.testing.assert_allclose(found.extras[0](t), np.cos(50.0 * t), atol=1e-8)


def test_a_window_measures_what_is_small_by_what_was_large_before():
    """Of ζ = (e^−50t, 1e-14 sin 300 t) the second one is no signal, though the first has gone."""

    def model(t, inside):
        zero, one, b = np.zeros((1, 2, 2)), np.ones((1, 1, 1)), np.zeros((len(t), 2, 1))
        b[:, 1, 0] = 3e-12 * np.cos(300.0 * t)
        c = np.zeros((1, 1, 2))
        return StateSpace(
            np.diag([-50.0, 0.0])[None], b, c, 0.0 * b[:, :1], zero, np.zeros((1, 2, 1)), one
        ), ()

    windows = [initial_mesh(*span, [], 4, radau_rule(8)) for span in ((0.0, 1.0), (1.0, 2.0))]
    start = np.array([[1.0], [0.0]])
    first, second = filter_windows(
        model, start, np.eye(2), windows, tol=1e-9, max_elements=1_000, sizes=np.ones(2)
    )
    assert second.mesh.size < 1.5 * first.mesh.size


def test_a_covariance_that_becomes_indefinite_is_refused():
    """A 'noise' of negative intensity: P = (1 − t/2) I."""
    one, none = np.ones((1, 1)), np.zeros((2, 2))
    case = constant(none, np.zeros((1, 2)), -0.5 * np.eye(2), one, np.zeros((2, 1)))
    P, _ = case.filtered(np.zeros(2), np.eye(2), 1.5).at(np.ones(1))
    np.testing.assert_allclose(P[0], 0.5 * np.eye(2), atol=1e-14)
    near, told = r"semidefinite near t = 2\.00\d*", r"-5\.0e-01 of its trace\); lower observer\.P0"
    with pytest.raises(SolverError, match=rf"{near} \(eigenvalue {told}"):
        case.filtered(np.zeros(2), np.eye(2), 3.0)


def test_window_gramians_are_resolved_in_any_units_of_the_outputs():
    """x' = 0 seen with W = ε(1 + cos 20t), in elements of one and a half of its periods."""
    small, window = 1e-9, 2.0

    def model(t: Array, inside: Array) -> tuple[Array, Array]:
        return np.zeros((1, 1, 1)), small * (1.0 + np.cos(20.0 * t))[:, None, None]

    mesh = initial_mesh(0.0, 20.0, [], 40, radau_rule(5))
    gramians, starts, _ = window_gramians(model, 1, mesh, tol=1e-8, max_elements=5000)
    whole = np.isin(starts, mesh.edges)  # there, windows end at edges
    t, M = starts[whole], gramians[whole, 0, 0]
    expected = window + (np.sin(20.0 * (t + window)) - np.sin(20.0 * t)) / 20.0
    np.testing.assert_allclose(M / small, expected, rtol=1e-8)


@pytest.mark.parametrize("stages", [12, 3])
def test_window_gramians_of_a_constant_system(stages):
    """M = ∫₀ᵀ e^{Aᵀs} cᵀc e^{As} ds, by the block exponential, for windows that start anywhere."""
    A, c = np.array([[0.3, 1.0], [-2.0, 0.1]]), np.array([[1.0, 0.5]])
    W = c.T @ c
    mesh = initial_mesh(1.0, 21.0, [], 40, radau_rule(stages))

    def model(t: Array, inside: Array) -> tuple[Array, Array]:
        return np.broadcast_to(A, (len(t), 2, 2)), np.broadcast_to(W, (len(t), 2, 2))

    gramians, starts, window = window_gramians(model, 2, mesh, tol=1e-11, max_elements=1000)
    big = expm(np.block([[-A.T, W], [np.zeros((2, 2)), A]]) * window)
    expected = big[2:, 2:].T @ big[:2, 2:]
    assert window == pytest.approx(2.0)
    assert starts[[0, -1]] == pytest.approx([1.0, 19.0])
    np.testing.assert_allclose(gramians, np.broadcast_to(expected, gramians.shape), rtol=1e-9)


def test_window_gramians_are_not_resolved_for_what_is_small_in_elements():
    """The last of five states is measured, the first one acts on it by s⁴ in each short element."""
    n, mesh = 5, initial_mesh(0.0, 20.0, [], 2000, radau_rule(6))
    A = 10.0 * np.diag(np.ones(n - 1), -1)

    def model(t: Array, inside: Array) -> tuple[Array, Array]:
        return A[None], (1.0 + 0.5 * np.sin(t))[:, None, None] * np.diag(np.eye(n)[-1])

    gramians, starts, window = window_gramians(model, n, mesh, tol=1e-9, max_elements=2100)
    s, weights = np.polynomial.legendre.leggauss(40)
    s = 0.5 * window * (s + 1.0)
    row = (10.0 * s[:, None]) ** np.arange(n)[::-1] / [24, 6, 2, 1, 1]  # of e^{As}
    W = 0.5 * window * weights * (1.0 + 0.5 * np.sin(starts[:, None] + s))
    expected = np.einsum("ws,si,sj->wij", W, row, row)
    np.testing.assert_allclose(gramians, expected, rtol=1e-9)


@pytest.mark.parametrize("origin", [0.0, 1e6])
def test_window_gramians_do_not_hang_on_the_mesh(origin):
    """A system that is seen less and less, on elements longer and shorter than windows."""
    A, found = np.array([[0.0, 1.0], [-4.0, -0.1]]), []

    def model(t: Array, inside: Array) -> tuple[Array, Array]:
        W = np.exp(-(t - origin)) * (1.0 + np.cos(3.0 * (t - origin)))
        return A[None], W[:, None, None] * np.diag([1.0, 0.0])

    for edges in (np.linspace(0.0, 10.0, 8), np.array([0.0, 0.3, *np.geomspace(0.7, 10.0, 60)])):
        mesh = Mesh(edges, radau_rule(8), origin)
        found.append(window_gramians(model, 2, mesh, tol=1e-12, max_elements=2000))
    (one, starts, _), (other, other_starts, _) = found
    np.testing.assert_allclose(starts - origin, other_starts - origin, atol=1e-8)
    assert starts[[0, -1]] - origin == pytest.approx([0.0, 9.0])
    size = np.abs(one).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(one / size, other / size, atol=1e-8)


def test_a_chain_of_many_states_needs_few_elements():
    """The first of 12 states is measured: rates of the filter fall from 1e5 to 1 in 1/s."""
    n = 12
    A = np.diag(np.ones(n - 1), 1) - np.diag(np.ones(n - 1), -1)
    case = Case(
        lambda t: (1.0 + 0.1 * np.sin(t)) * A, lambda t: np.eye(n)[1] * np.sin(t),
        lambda t: np.eye(1, n), lambda t: np.array([np.cos(t)]),
        lambda t: np.eye(n, n + 1), lambda t: np.eye(1, n + 1, n),
        np.diag([1e-3] * n + [1e-4]),
    )
    start, P0, t = np.zeros(n), 10.0 * np.eye(n), np.array([1e-5, 0.01, 1.0, 8.0])
    found = case.filtered(start, P0, 8.0)
    expected, estimates = case.by_scipy(start, P0, t)
    P, estimate = found.at(t)
    assert relative(P, expected) < 1e-8
    np.testing.assert_allclose(estimate[..., 0], estimates, atol=1e-8)
    assert found.error_estimate < 1e-8
    assert found.mesh.size < 150


def test_a_filter_that_forgets_fast_is_cut_for_it_at_once():
    """Nearly exact measurements and process noise: rates of 100/s, of which P shows nothing."""
    A, c = np.array([[-0.2, 1.0], [-1.0, -0.2]]), np.array([[0.0, 1.0]])
    V, asked = np.array([[1e-5]]), []

    def model(t, inside):
        asked.append(len(t))
        b, z = np.sin(t)[:, None, None] * np.ones((2, 1)), np.cos(t)[:, None, None]
        return StateSpace(
            A[None], b, c[None], z, 0.1 * np.eye(2)[None], np.zeros((1, 2, 1)), V[None]
        ), ()

    mesh = initial_mesh(0.0, 2.0, [], 20, radau_rule(14))
    found = run_filter(model, np.zeros((2, 1)), np.eye(2), mesh, tol=1e-9, max_elements=20_000)
    expected, steps = np.eye(2), 10_000
    over = expm(np.block([[-A.T, c.T @ c / V], [0.1 * np.eye(2), A]]) * 2.0 / steps)
    for _ in range(steps):
        X1, X2 = np.split(over @ np.concatenate([np.eye(2), expected]), 2)
        expected = X2 @ np.linalg.inv(X1)
    P, _ = found.at(np.array([2.0]))
    d = np.sqrt(np.diag(expected))
    assert np.abs((P[0] - expected) / np.outer(d, d)).max() < found.error_estimate < 1e-4
    assert sum(asked) < 15_000  # times, of all meshes that it went through


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
@pytest.mark.parametrize("size", [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0]])
def test_a_frame_has_all_directions_in_any_unit(size, unit):
    """P = T X Tᵀ, and T is regular, also where there is no variance."""
    frame = _stiff_riccati._Frame.of(np.diag(size), unit * np.array([[1.0, 0.5], [0.0, 1.0]]))
    basis = np.array([[1.0, 0.5], [0.0, 1.0]])
    found = frame.basis @ frame.left @ frame.basis.T / unit**2
    np.testing.assert_allclose(found, basis @ np.diag(size) @ basis.T, atol=1e-14)
    assert np.linalg.cond(frame.basis) < 1e5
    assert 1e-3 <= np.linalg.norm(frame.basis, axis=0).max() / unit <= 4.0


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_an_element_of_a_covariance_is_the_same_in_any_unit(unit):
    """P' = 1 - P² from tanh(1/2) is tanh(t + 1/2), and ζ' = -P ζ is 1/cosh of that."""
    rule = radau_rule(14)
    H = np.broadcast_to([[0.0, unit**-2.0], [unit**2, 0.0]], (14, 2, 2))
    left, estimate = np.full((1, 1), unit**2 * np.tanh(0.5)), np.full((1, 1), unit / np.cosh(0.5))
    P, found = _stiff_riccati._element(rule, 1.0, H, np.zeros((14, 2, 1)), left, estimate)
    np.testing.assert_allclose(P.ravel(), unit**2 * np.tanh(rule.nodes + 0.5), rtol=1e-9)
    np.testing.assert_allclose(found.ravel(), unit / np.cosh(rule.nodes + 0.5), rtol=1e-9)


@pytest.mark.parametrize(("elements", "longest"), [
    (1, np.inf), (20, np.inf), (20, 0.05), (20, 0.0),
])
def test_a_filter_that_is_very_fast_follows_on_few_elements(elements, longest, monkeypatch):
    """P' = 2aP + q − P²/V has two roots, P₊ and P₋; (P − P₊)/(P − P₋) decays like exp(−2λt).

    Elements in which Newton's method finds nothing are cut, whatever stands behind them; and so is
    the first one, once, where that is all that there is (0.0).
    """
    element, first = _stiff_riccati._element, [None]
    monkeypatch.setattr(_stiff_riccati, "_element", lambda rule, h, *given: (
        element(rule, h, *given) if h <= longest or not (longest or first) else first.clear()
    ))
    if np.isfinite(longest):
        monkeypatch.setattr(_stiff_riccati, "_POINTS", 30)  # two elements at once
    a, q, V = -0.3, 0.1, 1e-10

    def model(t, inside):
        one = np.ones((1, 1, 1))
        z = 1.0 + 0.0 * t[:, None, None]
        return StateSpace(a * one, 0.5 * one, one, z, q * one, 0.0 * one, V * one), (z,)

    mesh = initial_mesh(0.0, 2.0, [], elements, radau_rule(14))
    found = run_filter(
        model, np.zeros((1, 1)), np.ones((1, 1)), mesh, tol=1e-9, max_elements=1000,
        monitor=lambda estimate, extras: [((estimate * extras[0])[..., 0], 0.0)],
    )
    fast = np.sqrt(a * a + q / V)
    upper, lower = V * (a + fast), V * (a - fast)
    t = np.geomspace(1e-11, 2.0, 50)
    left = (1.0 - upper) / (1.0 - lower) * np.exp(-2.0 * fast * t)
    beside = -np.expm1(-2.0 * fast * t) + np.exp(-2.0 * fast * t) * (upper - lower) / (1.0 - lower)
    expected = (upper - left * lower) / beside
    P, estimate = found.at(t)
    assert np.abs(P[:, 0, 0] / expected - 1.0).max() < 2.0 * found.error_estimate < 1e-8
    settled = (0.5 + upper / V) / (upper / V - a)
    np.testing.assert_allclose(estimate[-1, 0, 0], settled, rtol=1e-9)
    assert found.mesh.size < 150  # X₁ grows by exp(60,000)


def test_a_direction_that_is_measured_almost_exactly_stays_apart_from_the_other():
    """A, Q and c are turned by one angle, and so is P: its directions are never correlated."""
    R = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    A, Q = (R @ np.diag(each) @ R.T for each in ([-0.3, -0.5], [0.1, 0.2]))

    def model(t, inside):
        z, zero = 1.0 + 0.0 * t[:, None, None], np.zeros((1, 2, 1))
        V = np.full((1, 1, 1), 1e-10)
        return StateSpace(A[None], zero, R.T[None, :1], z, Q[None], zero, V), ()

    mesh = initial_mesh(0.0, 2.0, [], 5, radau_rule(14))
    found = run_filter(model, np.zeros((2, 1)), np.eye(2), mesh, tol=1e-9, max_elements=1000)
    own = R.T @ found.at(np.array([1.0, 2.0]))[0] @ R
    assert np.abs(own[:, 0, 1] / np.sqrt(own[:, 0, 0] * own[:, 1, 1])).max() < 1e-12
    settled = 1e-10 * (-0.3 + np.sqrt(0.09 + 0.1 / 1e-10))
    np.testing.assert_allclose(own[:, 0, 0], settled, rtol=1e-10)
    np.testing.assert_allclose(own[:, 1, 1], 0.2 + 0.8 * np.exp([-1.0, -2.0]), rtol=1e-6)


def test_a_very_fast_filter_of_many_states_is_that_of_the_linear_equation(monkeypatch):
    """States in other units, noises that are correlated, signals that jump, measured twice."""
    random = np.random.default_rng(5)
    unit = np.array([1.0, 1e4, 1e-3, 1.0])
    A, c = random.normal(size=(4, 4)) - 2.0 * np.eye(4), random.normal(size=(2, 4))
    into = 0.3 * random.normal(size=(4, 4))
    D = np.concatenate([1e-3 * random.normal(size=(2, 2)), np.zeros((2, 2))], axis=1)

    def model(t, inside):
        At = A + np.sin(2.0 * t)[:, None, None] * into
        b = np.where(inside > 0.3, 1.0, -1.0)[:, None, None] * np.ones((4, 1))
        z = np.cos(t)[:, None, None] * np.array([[1.0], [2.0]])
        column = unit[:, None]
        return StateSpace(
            At * column / unit, b * column, (c / unit)[None], z,
            (into @ into.T * column * unit)[None], (column * (into @ D.T))[None], (D @ D.T)[None],
        ), ()

    def filtered():
        mesh = initial_mesh(0.0, 0.5, [0.3], 2, radau_rule(14))
        P0 = np.diag(unit**2)
        return run_filter(model, np.zeros((4, 1)), P0, mesh, tol=1e-10, max_elements=20_000)

    directly = filtered()
    monkeypatch.setattr(_riccati, "_STIFF", np.inf)
    linear = filtered()
    t = np.linspace(0.0, 0.5, 41)[1:]
    (P, estimate), (other, same) = directly.at(t), linear.at(t)
    d = np.sqrt(np.einsum("tii->ti", P))
    assert directly.mesh.size < 0.2 * linear.mesh.size
    assert (np.abs(P - other) / (d[:, None] * d[:, :, None])).max() < linear.error_estimate < 1e-3
    np.testing.assert_allclose(estimate / unit[:, None], same / unit[:, None], atol=1e-5)
    assert directly.error_estimate < 1e-7


@pytest.mark.parametrize("n", [1, 4])
def test_what_starts_anew_at_edges_is_pair_and_quotient(n):
    X = np.random.default_rng(n).normal(size=(2 * n, n + 2))
    expected = pair(*quotient(X))
    np.testing.assert_allclose(_renewed(X), expected, atol=1e-12 * np.abs(expected).max())
    X[:, 0] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        _renewed(X)
