"""Each erratum of docs/errata.md: the printed version fails, the corrected one holds."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from plants import CONF, observed, seen, shipped
from regressions import ETA, fading, regression
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from gpebo_cli import estimators
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import observe
from gpebo_cli.observers.canonical import (
    canonical_blocks,
    diagonalising_gain,
    transition_decay,
    unknown_input_matrices,
)
from gpebo_cli.observers.reduced.matrices import observer_matrices
from gpebo_cli.reduction.form import EquationForm
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

SOLVER = SolverSettings()
T = np.linspace(0.0, 20.0, 401)


def test_circuit_regressor_is_identically_zero_as_printed():
    printed = observed(shipped("circuit"), regression="paper")[1].regression
    assert np.abs(printed.psi(T)).max() < 1e-12
    assert np.abs(printed.Y(T)).max() < 1e-10
    corrected = observed(shipped("circuit"))[1].regression
    assert np.linalg.eigvalsh(corrected.gram.final[:, :3])[0] > 0.5


@pytest.mark.parametrize("singular", [False, True])
def test_last_rows_are_lossless_if_and_only_if_A22_is_invertible(singular):
    """The rows that the paper drops carry information exactly where A22 is singular."""
    A = [["-1", "0.5", "1", "0"], ["0", "-2", "0.3*cos(t)", "1"],
         ["1", "0.2", "1.5 + sin(t)", "0.4"],
         ["0.7", "1", "0", "0"] if singular else ["0.7", "1", "0.3", "2"]]
    system = plant_from_mapping({
        "name": "p", "states": ["a", "b", "v", "w"], "outputs": ["y"],
        "E": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]], "A": A,
        "C": [["0.3", "1", "0.2", "1"]], "initial_state": [1, 0, 0, 0],
    })
    o = observer_matrices(EquationForm(system, Units.plain(system)), T, T, 1e-10)
    full = o.residual @ o.algebraic[:, :, :2]
    last = full[:, -1:]
    def rank(x):
        return [np.linalg.matrix_rank(x[k], tol=1e-9) for k in (0, 100, 300)]
    if singular:
        assert max(rank(last)) < max(rank(full)) or np.abs(last).max() < 1e-12
    else:
        assert rank(last) == rank(full)


def test_consistent_start_of_the_circuit():
    """iv(0) = −0.25 breaks a hidden constraint; −3.45 satisfies the differentiated one."""
    result = simulate(shipped("circuit"), TimeSettings(), SOLVER)
    assert result.initial_state[5] == pytest.approx(-3.45, abs=1e-12)
    # e1 = −V for all t, so e1(0) = 0 and the first entry of e₀ = ξ_a1 − e1 is known beforehand.
    x = result.signals.states(T)
    np.testing.assert_allclose(x[:, 0], -4 * np.cos(2 * T) * np.sin(T / 5), atol=1e-9)
    # KCL at node 1: (C1 e1)' = ir1 − ir2 + iv at t = 0 with e1 = −V, V'(0) = 4/5.
    C1, de1, e1, dC1 = 4.0, -0.8, 0.0, 0.0
    ir1, ir2 = result.initial_state[3:5]
    for iv, holds in ((-0.25, False), (-3.45, True)):
        residual = C1 * de1 + dC1 * e1 - (ir1 - ir2 + iv)
        assert bool(abs(residual) < 1e-9) is holds


def test_printed_excitation_condition_is_too_weak():
    """∫ψψᵀ ≥ ρ I_r holds for ψ = [1, 0], ∫ψᵀψ ≥ ρ I_p does not, and p2 cannot be known."""
    psi = np.array([[1.0, 0.0]])
    printed, corrected = psi @ psi.T * 10, psi.T @ psi * 10
    assert np.linalg.eigvalsh(printed)[0] > 1
    assert np.linalg.eigvalsh(corrected)[0] == 0
    np.testing.assert_array_equal(psi @ [1.0, 0.0], psi @ [1.0, 5.0])


def test_interval_excitation_is_not_enough_for_fading_filters():
    faded = regression(fading, ETA, horizon=200.0, elements=800)
    t = np.array([0.0, 100.0, 200.0])
    drem = estimators.build({"name": "drem", "gamma": 100.0}).estimate(faded, t)
    error = np.abs(drem.parameters(slice(None))[0] - ETA).max(axis=1)
    assert error[2] == pytest.approx(error[1], rel=1e-6)  # stalled
    assert error[2] > 0.1
    ls_drem = estimators.build({"name": "ls_drem", "gamma": 1.0}).estimate(faded, t)
    assert np.abs(ls_drem.parameters(slice(None))[0, 2] - ETA).max() < 1e-9


def canonical_matrices(t, printed_remark_3=False):
    system = shipped("canonical")
    b = canonical_blocks(system, t, t)
    c, dc = b.C[:, 1, 2:4], b.dC[:, 1, 2:4]
    L = diagonalising_gain(c, dc, b.N)
    if printed_remark_3:
        L[:, 1] = -dc[:, 0] / c[:, 0] ** 2
    M, _, _ = unknown_input_matrices(c, dc, b.N, np.zeros((len(t), 3)), L)
    return M, c, dc, b.N, L


def test_opposite_sign_of_M_w_diverges():
    """Assumption 7's φ is −M_w (up to a misprint): errors grow as fast as they should fall."""
    mesh = simulate(shipped("canonical"), TimeSettings(), SOLVER).signals.mesh
    M, c, dc, N, L = canonical_matrices(mesh.points.ravel())
    shape = (*mesh.points.shape, 2, 2)
    assert transition_decay(Trajectory(mesh, M.reshape(shape))) < 1e-4
    a1 = 1 / N[:, 1, 0]
    printed = np.empty_like(M)
    printed[:, 0, 0], printed[:, 0, 1] = L[:, 0] * c[:, 0], L[:, 0] * c[:, 1] - a1
    printed[:, 1, 0] = L[:, 1] * c[:, 0] + dc[:, 0] / c[:, 0]
    printed[:, 1, 1] = L[:, 1] * c[:, 1] + (dc[:, 1] + c[:, 0] * a1) / c[:, 1]
    assert transition_decay(Trajectory(mesh, printed.reshape(shape))) > 1e3


def test_M_w_printed_with_the_wrong_denominator():
    """Row 2 of M_w has ċ1/c2; with the printed ċ1/c1 it is not [I−Gc⊤]A − Lc⊤ − Gċ⊤."""
    M, c, dc, N, L = canonical_matrices(T)
    G = np.stack([np.zeros(len(T)), 1 / c[:, 1]], axis=1)
    a1, a2 = 1 / N[:, 1, 0], -N[:, 2, 0] / (N[:, 2, 1] * N[:, 1, 0])
    A_w = np.zeros((len(T), 2, 2))
    A_w[:, 0, 1], A_w[:, 1, 1] = a1, a2
    def outer(a, b):
        return a[:, :, None] * b[:, None, :]
    definition = (np.eye(2) - outer(G, c)) @ A_w - outer(L, c) - outer(G, dc)
    np.testing.assert_allclose(M, definition, atol=1e-12)
    printed = -L[:, 1] * c[:, 0] - dc[:, 0] / c[:, 0]
    assert np.abs(printed - definition[:, 1, 0]).max() > 0.05


def test_remark_3_gain_diagonalises_only_when_corrected():
    M, *_ = canonical_matrices(T)
    assert np.abs(M[:, 0, 1]).max() < 1e-12
    assert np.abs(M[:, 1, 0]).max() < 1e-12
    printed, *_ = canonical_matrices(T, printed_remark_3=True)
    assert np.abs(printed[:, 1, 0]).max() > 1e-2


def test_remark_4_eigenvalue_cannot_be_moved():
    """−a1 c1/c2 is an eigenvalue of M_w for every L_w: the sign cannot always be had."""
    rng = np.random.default_rng(5)
    c, zero = np.array([1.3, -0.7]), np.zeros(2)
    N = np.zeros((3, 3))
    N[1, 0], N[2, 0], N[2, 1] = 0.8, 0.3, 1.1
    for L in rng.normal(size=(20, 2)) * 5:
        M, _, _ = unknown_input_matrices(c, zero, N, np.zeros(3), L)
        eigenvalues = np.linalg.eigvals(M)
        assert np.abs(eigenvalues - (-c[0] / (0.8 * c[1]))).min() < 1e-9
    # Here a1 c1/c2 < 0, the paper's condition for stability, and M_w is unstable for every L_w.
    assert -c[0] / (0.8 * c[1]) > 0


def test_a2_has_both_factors_in_its_denominator():
    """Differentiate z_b from its own equations and compare with ż_w = A_w z_w + d_w + B_w ζ."""
    system = shipped("canonical")
    signals = simulate(system, TimeSettings(), SOLVER).signals
    h = 1e-5
    t = np.linspace(1, 19, 37)
    zb = signals.states(t)[:, 2:]
    dzb2 = (signals.states(t + h)[:, 3] - signals.states(t - h)[:, 3]) / (2 * h)
    N = canonical_blocks(system, t, t).N
    N21, N31, N32 = N[:, 1, 0], N[:, 2, 0], N[:, 2, 1]
    f_b2, f_b3 = np.cos(2 * t), np.sin(t / 2)
    d2 = f_b3 / N32 - N31 * f_b2 / (N32 * N21)
    zeta = zb[:, 2] / N32
    corrected = -N31 / (N32 * N21) * zb[:, 1] + d2 + zeta
    printed = -N31 / N32 * zb[:, 1] + d2 + zeta
    np.testing.assert_allclose(dzb2, corrected, atol=1e-6)
    assert np.abs(dzb2 - printed).max() > 1e-2


def test_D3_reduced_matrix():
    """C_b = 0: A_0 = A11 − A12 A22⁻¹ A21; the printed [A21; C_a] does not even have the size."""
    rng = np.random.default_rng(2)
    A = rng.normal(size=(4, 4))
    system = plant_from_mapping({
        "name": "p", "states": ["x1", "x2", "x3", "x4"], "outputs": ["y"],
        "E": np.diag([1.0, 1, 0, 0]).tolist(), "A": A.tolist(),
        "C": [[1, 2, 0, 0]], "initial_state": [0] * 4,
    })
    t = np.zeros(1)
    found = observer_matrices(EquationForm(system, Units.plain(system)), t, t, 1e-10).dynamics[0]
    expected = A[:2, :2] - A[:2, 2:] @ np.linalg.inv(A[2:, 2:]) @ A[2:, :2]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    with pytest.raises(ValueError, match="mismatch"):
        A[:2, 2:] @ np.linalg.inv(A[2:, 2:]) @ np.vstack([A[2:, :2], [[1, 2]]])


def test_observability_is_not_enough_with_unknown_parameters():
    """ż1 = z2 + θ, ż2 = 0, y = z1: (A, C) is observable, θ and z2 cannot be told apart."""
    system = plant_from_mapping({
        "name": "p", "states": ["z1", "z2"], "unknowns": {"theta": 1}, "outputs": ["y"],
        "E": [[1, 0], [0, 1]], "A": [[0, 1], [0, 0]], "F": [[1], [0]], "C": [[1, 0]],
        "initial_state": [0, 1],
    })
    assert np.linalg.matrix_rank([[1, 0], [0, 1]]) == 2  # [C; CA]
    gram = observed(system)[1].regression.gram.final[:, :3]
    assert np.linalg.matrix_rank(gram, tol=1e-9) == 2
    null = np.linalg.eigh(gram)[1][:, 0]
    assert abs(null[0]) > 0.3  # it contains θ


def test_proposition_3_regressor_is_a_transposed_product():
    """y_k − C_k ξ_a = −C_k Φ_a θ_a; the printed −C_k Φ_a with C_k a column has no meaning."""
    system = shipped("canonical")
    result = simulate(system, TimeSettings(), SOLVER)
    found = observe(system, seen(result.signals), SOLVER, name="canonical")
    eta = found.truth(T, np.broadcast_to(system.theta, (len(T), system.q)), result.signals.states)
    regression = found.regression
    np.testing.assert_allclose(regression.Y(T), regression.psi(T) @ eta[0], atol=1e-10)
    column, Phi = np.array([[1.0], [0.0]]), np.eye(2)
    with pytest.raises(ValueError, match="mismatch"):
        column @ Phi


def test_zero_entries_of_N_that_are_not_divided_by_do_no_harm():
    """Assumption 4 asks for all N_ij ≠ 0; N31 = 0 is fine."""
    system = shipped("canonical", parameters={
        "N21": "1 + 0.3*sin(t)", "N31": 0, "N32": "1.5 + 0.5*sin(2*t)",
        "c1": "1 + 0.3*cos(t)", "c2": "2 + 0.5*sin(t)",
    })
    found = observed(system, name="canonical")[1]
    names = {a.name: a for a in found.assumptions}
    assert names["Assumption 4"].holds
    assert names["Assumption 7"].holds


def test_zb1_and_zb2_are_algebraic():
    """z_b1 = −f_b1 and z_b2 = (y_w + c1 f_b1)/c2: no observer is needed for them."""
    system = shipped("canonical")
    signals = simulate(system, TimeSettings(), SOLVER).signals
    x, y = signals.states(T), signals.outputs(T)
    c1, c2, f_b1 = 1 + 0.3 * np.cos(T), 2 + 0.5 * np.sin(T), np.sin(T)
    np.testing.assert_allclose(x[:, 2], -f_b1, atol=1e-10)
    y_w = y[:, 1] - 0.5 * x[:, 0]
    np.testing.assert_allclose(x[:, 3], (y_w + c1 * f_b1) / c2, atol=1e-10)


def test_dimensions_of_C():
    """C ∈ R^{r×n} and C = [C_a C_b] in one row block; the printed n × r does not multiply x."""
    system = shipped("circuit")
    C = system.coefficients.taylor(np.zeros(1), 0).C[0, 0]
    assert C.shape == (system.r, system.n)
    with pytest.raises(ValueError, match="mismatch"):
        C.T @ np.zeros(system.n)


def test_D2_rank_equivalence_holds():
    """4,000 random constant systems: Assumption 1 and the rank condition agree."""
    rng = np.random.default_rng(11)
    agreed = 0
    for _ in range(4000):
        n_a, n_b, r = rng.integers(1, 4), rng.integers(1, 4), rng.integers(1, 3)
        n = n_a + n_b
        E = np.zeros((n, n))
        E[:n_a, :n_a] = np.eye(n_a)
        A, C = rng.integers(-1, 2, (n, n)), rng.integers(-1, 2, (r, n))
        one = np.linalg.matrix_rank(np.vstack([A[n_a:, n_a:], C[:, n_a:]])) == n_b
        stacked = np.block([[E, A], [np.zeros((r, n)), C], [np.zeros((n, n)), E]])
        agreed += one == (np.linalg.matrix_rank(stacked) == n_a + n)
    assert agreed == 4000


def test_agent_2_of_the_distributed_observer_takes_longer_and_is_not_exact():
    """Eqs. (22) to (25) of arXiv:2005.12940 in errors: Ω2, e = 𝒴2 − Ω2θ, ∫Δ2² and θ̂2 − θ."""
    A21 = np.array([[0, -1.4142], [0.7071, 0.7071], [6.3640, 4.9497], [-2.8284, -2.8284]])
    A22 = np.array([[-1, -2, 1, 1], [1, 1, 0, 0], [-1, 1, -2, 0], [0.5, -0.5, 0, -4]])
    A = np.block([[-np.eye(2), np.zeros((2, 4))], [A21, A22]])
    C, lam, gamma, mu = np.array([-1.4142, -1.4142, 5, 0, 0, 3]), 0.8, 20.0, 0.1
    theta = np.array([a := 1.4142271248762552, -2 * a, -2, 3, -1, 2])
    M = 2 * np.diag([2.1213**2, 0.7071**2])  # C11ᵀC11; Ω1 = M (e^{−t} − e^{−2t})

    def error_1(t):  # of agent 1, from θ̂ = 0: θ (1 − ω1)/μ1 − θ until it is exact
        if t >= t_c1:
            return np.zeros(2)
        return theta[:2] * ((1 - np.exp(-5 * energy_1(t))) / 0.05 - 1)

    def energy_1(t):  # ∫Δ1²
        x = np.exp(-np.array([t, 0.0]))
        return np.linalg.det(M) ** 2 * np.diff(x**4 / 4 - 4 * x**5 / 5 + x**6 - 4 * x**7 / 7
                                               + x**8 / 8)[0]

    t_c1 = brentq(lambda t: 5 * energy_1(t) + np.log(0.95), 0.01, 1.0)
    assert abs(t_c1 - 0.309) < 1e-3

    def run(until, factor=lam):
        def f(t, x):
            Phi, omega, e, rest = expm(A * t), x[:16].reshape(4, 4), x[16:20], x[21:]
            psi = C[2:] @ Phi[2:, 2:]
            eps = (C[:2] @ Phi[:2, :2] + C[2:] @ Phi[2:, :2]) @ error_1(t)
            delta, mixed, _ = determinant_and_adjugate_action(omega[None], e[None, :, None])
            law = gamma * delta[0] * (mixed[0, :, 0] - delta[0] * rest)
            return np.concatenate([
                (factor * np.outer(psi, psi) - lam * omega).ravel(),
                -lam * e - factor * psi * eps, delta**2, law,
            ])

        start, at = np.append(np.zeros(21), -theta[2:]), 0.0
        for stop in (t_c1, until):
            start = solve_ivp(
                f, (at, stop), start, method="DOP853", rtol=1e-10, atol=1e-18
            ).y[:, -1]
            at = stop
        Phi, omega_2 = expm(A * until), np.exp(-gamma * start[20])
        return omega_2, Phi[2:, 2:] @ (start[21:] + omega_2 * theta[2:]) / (1 - omega_2)

    for when, factor in ((1.979, lam), (1.691, 1.0)):
        assert run(when - 2e-3, factor)[0] > 1 - mu > run(when + 2e-3, factor)[0]
    omega_2, error = run(2.0)
    assert omega_2 < 1 - mu
    assert 0.12 < np.abs(error).max() < 0.14
    assert 0.004 < np.abs(run(5.0)[1]).max() < 0.006


def test_every_erratum_names_a_test_that_exists():
    page = (CONF.parent / "docs" / "errata.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(test_\w+)`", page))
    existing = set(re.findall(r"^def (test_\w+)", Path(__file__).read_text("utf-8"), re.MULTILINE))
    assert named
    assert named <= existing
    assert existing - named == {"test_every_erratum_names_a_test_that_exists"}
