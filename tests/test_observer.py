"""The GPEBO observer: the identity Y = ψη, the paper's block formulas, rotating kernels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import observed, reference, seen, shipped
from units import in_units

from gpebo_cli import estimators
from gpebo_cli import run as experiment
from gpebo_cli.errors import ConfigError, ModelError
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import Measurements, observe
from gpebo_cli.observers.reduced.matrices import AlgebraicEquations, observer_matrices, weakest
from gpebo_cli.observers.reduced.regression import Assembled, regression_signals, term_sizes
from gpebo_cli.observers.reduced.split import axes_frame, constant_split, split_in_frame
from gpebo_cli.reduction.form import EquationForm
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

SOLVER = SolverSettings()
T = np.linspace(0, 20, 801)

# Four states, index 2, one unknown: the kernel of E(t) rotates in the (x1, x3) and (x2, x4)
# planes at different speeds. x = R(t) z with z from a system in diagonal form.
ROTATING = {
    "name": "rotating",
    "parameters": {
        "c": "cos(t)", "s": "sin(t)", "C": "cos(t/2)", "S": "sin(t/2)",
    },
    "states": ["x1", "x2", "x3", "x4"],
    "inputs": {"u": "sin(2*t)"},
    "unknowns": {"theta": 0.7},
    "outputs": ["y"],
    # E = E_z Rᵀ with E_z = diag(1, 1, 0, 0), Rᵀ x = z
    "E": [["c", 0, "s", 0], [0, "C", 0, "S"], [0, 0, 0, 0], [0, 0, 0, 0]],
    # z1' = −z1 + z3 + θ, z2' = z1 − z2 + z4, 0 = z1 + z2 (fixes z3: index 2) − u, 0 = z2 + 2 z4
    # A = A_z Rᵀ − E_z (Rᵀ)', because z' = Rᵀ x' + (Rᵀ)' x
    "A": [
        ["-c - s + s", 0, "-s + c - c", 0],
        ["c", "-C - S + S/2", "s", "-S + C - C/2"],
        ["c", "C", "s", "S"],
        [0, "C - 2*S", 0, "S + 2*C"],
    ],
    "B": [[0], [0], [-1], [0]],
    "F": [[1], [0], [0], [0]],
    "C": [["-s", 0, "c", "1"]],
    "initial_state": [0.5, -0.5, 0, 0],
}


def run(system, **settings):
    simulation = simulate(system, TimeSettings(), SOLVER)
    signals = simulation.signals
    observation = observe(system, seen(signals), SOLVER, **settings)
    truth = observation.truth(T[:1], system.theta[None], signals.states)[0]
    return simulation, observation, truth


def assert_identity(simulation, observation, truth, tolerance=1e-9, t=T):
    regression = observation.regression
    residual = regression.Y(t) - regression.psi(t) @ truth
    assert np.abs(residual).max() < tolerance
    states = observation.state_map.at(t)(np.tile(truth, (1, len(t), 1)))[0]
    assert np.abs(states - simulation.signals.states(t)).max() < tolerance


@pytest.mark.parametrize("name", ["circuit", "descriptor"])
def test_regression_holds_with_the_true_parameters(name):
    simulation, observation, truth = run(shipped(name))
    assert_identity(simulation, observation, truth)
    expected = reference(name)
    e0 = truth[len(shipped(name).unknowns):]
    np.testing.assert_allclose(e0, expected["e0"], atol=1e-12)


def test_only_what_constraints_leave_free_at_the_start_is_unknown():
    """The voltage e1 is that of the source, which E does not know: its rank is 3."""
    found = experiment(
        "circuit", observer={"name": "gpebo", "form": "strangeness_free"},
        estimator="least_squares", time={"horizon": 5.0, "samples": 101},
    ).details
    regression, estimation = found.regression, found.estimation
    assert estimation.names == ("e0_e2", "e0_il")
    residual = regression.Y - regression.psi @ estimation.true_parameters[-1]
    assert np.abs(residual).max() < 1e-9
    off = estimation.states[0, -1] - found.simulation.states[-1]
    assert np.abs(off).max() < 1e-5


def test_what_a_reset_takes_for_rounding_is_the_same_in_any_units():
    """A share of the largest unknown or state, whichever of them is large in its unit."""
    content = {
        "name": "two", "states": ["a", "b"], "outputs": ["y"], "inputs": {"u": "sin(2*t)"},
        "unknowns": {"k": 0.7}, "E": [[1, 0], [0, 1]], "A": [[-0.1, 1], [-1, -0.2]],
        "B": [[1], [0]], "F": [[0], [1]], "C": [[1, 0.5]], "initial_state": {"a": 3, "b": -1},
    }
    floors = []
    for states, unknown in ((1.0, 1.0), (1e6, 1.0), (1.0, 1e6), (1e-6, 1e-6)):
        units = np.full(2, states), np.full(1, unknown), np.ones(1), np.ones(1), np.ones(2), 1.0
        system = plant_from_mapping(in_units(content, units))
        regression = run(system, remedy="reset", reset_interval=5.0)[1].regression
        floors.append([reset.floor for reset in regression.resets])
    assert len(floors[0]) == 3
    np.testing.assert_allclose(floors[1:], [floors[0]] * 3, rtol=1e-6)


def test_what_an_observer_estimates_itself_is_no_affine_map_of_the_regression():
    _, observation, _ = run(shipped("descriptor"))
    assert observation.of_constants is observation.state_map
    assert replace(observation, estimator=estimators.build({"name": "drem"})).of_constants is None
    assert replace(observation, names=("a",)).of_constants is None
    for observer in ({"remedy": "reset", "reset_interval": 5.0}, {"remedy": "current_coordinates"}):
        assert run(shipped("descriptor"), **observer)[1].of_constants is None


def test_circuit_regressor_matches_the_reference_up_to_sign():
    _, observation, _ = run(shipped("circuit"))
    for row in reference("circuit")["at"]:
        psi = observation.regression.psi(np.array([row["t"]]))[0, 0]
        expected = np.array(row["psi_up_to_sign"])
        np.testing.assert_allclose(psi * np.sign(psi[0] * expected[0]), expected, atol=1e-10)
    assert observation.regression.parameters == ("e0_e1", "e0_e2", "e0_il")


def test_kept_row_of_the_circuit_is_the_source_equation():
    """0 = −e1 − u gives u + ξ_a1 = [1 0 0] Φ e₀, the row the paper's choice throws away."""
    system = shipped("circuit")
    simulation, observation, _ = run(system)
    u = simulation.signals.inputs(T)[:, 0]
    xi_a1 = observation.state_map.offset(T)[:, 0]
    Y = observation.regression.Y(T)
    assert Y.shape[1] == 1
    np.testing.assert_allclose(np.abs(Y[:, 0]), np.abs(u + xi_a1), atol=1e-9)


def test_literal_regressor_is_lossless_where_A22_is_invertible():
    _, ours, truth = run(shipped("descriptor"))
    _, paper, _ = run(shipped("descriptor"), regression="paper")
    np.testing.assert_allclose(paper.regression.Y(T), paper.regression.psi(T) @ truth, atol=1e-9)
    rank = [np.linalg.matrix_rank(o.regression.gram.final[:, :-1], tol=1e-9) for o in (ours, paper)]
    assert rank == [4, 4]


@pytest.mark.parametrize("of_states", [np.ones(5), 10.0 ** np.array([3, -4, 0, 5, -2])])
@pytest.mark.parametrize("of_parameters", [np.ones(3), np.array([1e-3, 1e5, 1.0])])
@pytest.mark.parametrize("offset", [True, False])
def test_signals_are_resolved_in_sizes_of_their_own_in_any_units(of_states, of_parameters, offset):
    """Each state's gain beside the largest of itself and small shares of what it is made of.

    That is itself, the offset, what the gain of w is and what rounding leaves of it; the last state
    has no size. ψ has a column that vanishes.
    """
    rng, t = np.random.default_rng(0), np.linspace(0.0, 3.0, 7)
    unit = of_states[:, None] / of_parameters
    wave = np.cos(t[:, None, None] + np.arange(3.0))
    gain = np.array([2.0, 1e-9, 1e-9, 1e-9, 0.0])[:, None] * wave * [1.0, 3.0, 0.0]
    moving = np.array([[1.0, 1, 0], [1, 0, 0], [50, 0, 0], [0, 0, 0], [0, 0, 0]])
    rounding = np.zeros((5, 5))
    rounding[3, 2] = 0.1
    psi, columns = rng.normal(size=(7, 2, 3)) * [1.0, 5.0, 0.0], np.array([1.0, 5.0, 0.0])
    x = np.array([0.0, 40.0, 0.0, 0.0, 0.0]) * np.cos(t)[:, None] * offset
    Y = (4.0 * np.sin(t)[:, None] + np.zeros(2)) * offset
    found = Assembled(
        Y, psi / of_parameters, x * of_states, gain * unit, 4.0 * offset, columns / of_parameters,
        np.ones((5, 4)), moving * unit,
    )
    by = rounding * of_states[:, None] / of_states
    rows, regressor, states, gains, squares, products = found.kinds(of_states, by)
    each = np.array([1.0, 5.0, 1.0])
    largest = (np.abs(gain).max(axis=0) / each).max(axis=1)
    sizes = np.array([largest[0], 1e-3 * (10.0 if offset else 1.0), 0.05, 5.0, 1.0])
    for (value, floor), exact, least in (
        (rows, Y, 4e-3 * offset), (regressor, psi / each, 1e-3), (states, x, 0.0),
        (gains, gain / sizes[:, None] / each, 0.0),
        (squares, ((psi / each) ** 2).sum(axis=1), 1e-3),
        (products, np.einsum("nrp,nr->np", psi / each, Y), 4e-3 * offset),
    ):
        np.testing.assert_allclose(value, exact, rtol=1e-12, atol=1e-300)
        assert floor == pytest.approx(least)
    assert found.lost(by) == pytest.approx(5.0 / largest[3])
    rounding[1, 2], rounding[3, 2] = 1e-3, 0.0  # of the state that is an offset
    by = rounding * of_states[:, None] / of_states
    assert found.lost(by) == pytest.approx(0.05 / (10.0 if offset else largest[1]))


def test_what_moves_with_a_parameter_adds_up_over_coordinates_of_either_sign():
    """Of x = B z with B = [1 −1; 1 2; 0 1], where one equation sees z₁."""
    rng, basis = np.random.default_rng(2), np.array([[1.0, -1.0], [1.0, 2.0], [0.0, 1.0]])
    z, nothing = rng.normal(size=(5, 2, 4)), np.zeros((1, 1, 0))
    found = regression_signals(z, basis, AlgebraicEquations(
        np.array([[[1.0, 0.0]]]), np.zeros((5, 1)), np.zeros((1, 1, 1)), nothing,
        np.zeros((1, 3, 0)), np.ones(1),
    ))
    first, second = np.abs(z[:, :, 1:]).max(axis=0)
    np.testing.assert_allclose(found.moving, [first + second, first + 2.0 * second, second])


@pytest.mark.parametrize("size", [1.0, 1e-20])
def test_a_state_that_is_little_beside_another_one_is_resolved(size):
    """z = size cos(40 t) x of x' = z − x, along what is smooth: of 1e-20, z counts as 1e-10.

    What begins in w has no part in it.
    """
    system = plant_from_mapping({
        "name": "little", "states": ["x", "z", "w"], "outputs": ["y"], "C": [[1, 0, 0]],
        "E": np.diag([1, 0, 1]).tolist(), "initial_state": [1, size, 0],
        "A": [[-1, 1, 0], [f"{size}*cos(40*t)", -1, 0], [0, 0, -1]],
    })
    mesh = initial_mesh(0.0, 2.0, [], 2, radau_rule(14))
    y = Trajectory(mesh, np.exp(-mesh.points)[..., None])
    t = np.linspace(0.0, 2.0, 77)
    observation = observe(system, Measurements(Trajectory(mesh, np.zeros((2, 15, 0))), y))
    x, z, _ = observation.state_map.gain(t)[:, :, 0].T
    np.testing.assert_allclose(z / size, np.cos(40.0 * t) * x, atol=1e-11)


def random_block_system(rng, n_a, n_b, r, q, varying):
    """E = diag(E_a(t), 0) with E_a = I or diagonal and time-varying; A22 singular on purpose."""
    n = n_a + n_b

    def entries(rows, columns):
        values = rng.normal(size=(rows, columns)).round(3)
        return [[f"{v} + {w}*sin({k}*t)" for v, w, k in zip(
            row, rng.normal(size=columns).round(3), rng.integers(1, 4, columns), strict=True)]
            for row in values]

    E = [["0"] * n for _ in range(n)]
    for i in range(n_a):
        E[i][i] = f"2 + cos({i + 1}*t)" if varying else "1"
    A = entries(n, n)
    for j in range(n_a, n):
        A[n - 1][j] = "0"  # last row of A22 vanishes
    return plant_from_mapping({
        "name": "random", "states": [f"x{i}" for i in range(n)],
        "inputs": {"u1": "sin(t)", "u2": "cos(3*t)"},
        "unknowns": {f"th{i}": 1 for i in range(q)},
        "outputs": [f"y{i}" for i in range(r)],
        "E": E, "A": A, "B": entries(n, 2), "C": entries(r, n),
        **({"F": entries(n, q)} if q else {}),
        "initial_state": [0] * n,
    })


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("q", [0, 2])
def test_equal_to_the_papers_block_formulas(varying, q):
    """A_0, B_0, D_0 and the output gain of Proposition 1, typed in from the paper."""
    rng = np.random.default_rng(7 + q)
    n_a, n_b, r = 3, 2, 2
    system = random_block_system(rng, n_a, n_b, r, q, varying)
    t = np.linspace(0, 3, 11)
    ours = observer_matrices(EquationForm(system, Units.plain(system)), t, t, 1e-10)
    c = system.coefficients.taylor(t, 0)
    for k in range(len(t)):
        E, A, B, F, C = c.E[0, k], c.A[0, k], c.B[0, k], c.F[0, k], c.C[0, k]
        inverse = np.linalg.inv(E[:n_a, :n_a])
        A11, A12 = inverse @ A[:n_a, :n_a], inverse @ A[:n_a, n_a:]
        B1, F1 = inverse @ B[:n_a], inverse @ F[:n_a]
        calA = np.vstack([A[n_a:, n_a:], C[:, n_a:]])
        dagger = np.linalg.inv(calA.T @ calA) @ calA.T
        rest = np.vstack([A[n_a:, :n_a], C[:, :n_a]])
        B2, F2 = np.vstack([B[n_a:], np.zeros((r, 2))]), np.vstack([F[n_a:], np.zeros((r, q))])
        y = np.vstack([np.zeros((n_b, r)), np.eye(r)])
        np.testing.assert_allclose(
            ours.dynamics[k], A11 - A12 @ dagger @ rest, atol=1e-11)
        np.testing.assert_allclose(ours.from_signals[k, :, :2], B1 - A12 @ dagger @ B2, atol=1e-11)
        np.testing.assert_allclose(ours.from_signals[k, :, 2:], A12 @ dagger @ y, atol=1e-11)
        np.testing.assert_allclose(ours.from_unknowns[k], F1 - A12 @ dagger @ F2, atol=1e-11)
        # the paper's ψ_1 and ψ_2 are the last r rows of the residual
        psi_2 = C[:, n_a:] @ dagger @ rest - C[:, :n_a]
        literal = (ours.residual[k] @ ours.algebraic[k])[-r:, :n_a]
        np.testing.assert_allclose(literal, -psi_2, atol=1e-11)


def test_residual_is_a_projector_and_annihilates_the_algebraic_states():
    system = plant_from_mapping(ROTATING)
    t = np.linspace(0, 5, 23)
    o = observer_matrices(EquationForm(system, Units.plain(system)), t, t, 1e-10)
    R, P = o.residual, o.split.projector
    np.testing.assert_allclose(R @ R, R, atol=1e-13)
    np.testing.assert_allclose(R @ o.algebraic @ (np.eye(4) - P), 0, atol=1e-13)


def test_a_range_of_E_that_turns_alone_leaves_as_many_coordinates_as_E_has_rank():
    """Of E = [cos t; sin t] [1 1] the kernel stays."""
    system = plant_from_mapping({
        "name": "turning", "states": ["a", "b"], "outputs": ["y"], "initial_state": [0, 0],
        "E": [["cos(t)", "cos(t)"], ["sin(t)", "sin(t)"]], "A": [[-1, 0], [0, 1]], "C": [[1, 0]],
    })
    t = np.linspace(0, 5, 23)
    split = observer_matrices(EquationForm(system, Units.plain(system)), t, t, 1e-10).split
    np.testing.assert_allclose(np.abs(split.basis), np.full((2, 1), np.sqrt(0.5)), rtol=1e-14)


@pytest.mark.parametrize("through", [0, 1])
def test_an_input_in_an_output_is_in_no_dynamics(through):
    """x' = −x + z, where 0 = x − 2 z + u and y − D u = z leave z = 0.4 (x + u) + 0.2 (y − D u)."""
    system = plant_from_mapping({
        "name": "seen", "states": ["x", "z"], "inputs": {"u": 1}, "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, -2]], "B": [[0], [1]], "C": [[0, 1]],
        "D": [[through]], "initial_state": [1, 1],
    })
    t, form = np.zeros(1), EquationForm(system, Units.plain(system))
    o = observer_matrices(form, t, t, 1e-10)
    np.testing.assert_allclose(o.dynamics, [[[-0.6]]], rtol=1e-14)


@pytest.mark.parametrize("name", ["on_basis", "G", "range", "elimination"])
def test_sizes_of_terms_have_no_signs(name):
    rng = np.random.default_rng(0)
    z, basis = rng.normal(size=(2, 2, 4)), rng.normal(size=(3, 2))
    shapes = (2, 4, 2), (2, 4), (2, 4, 1), (2, 4, 2), (2, 3, 2), (2,)
    equations = AlgebraicEquations(*(rng.normal(size=shape) for shape in shapes))
    other = equations._replace(**{name: -getattr(equations, name)})
    one, same = term_sizes(z, basis, equations), term_sizes(-z, -basis, other)
    np.testing.assert_array_equal(one[0](), same[0]())
    np.testing.assert_array_equal(one[1], same[1])


def test_the_weakest_singular_value_is_found_among_bounds_of_it():
    H = np.random.default_rng(0).normal(size=(40, 5, 3))
    H *= np.array([1.0, 1e-3, 1e-3])
    H[:, :, 0] *= np.linspace(1.0, 3.0, 40)[:, None]
    smallest = 1.0 / np.linalg.norm(H, 2, axis=(1, 2))
    value, place = weakest(1.0 / np.linalg.norm(H, axis=(1, 2)), H)
    assert (value, place) == (pytest.approx(smallest.min()), smallest.argmin())
    assert weakest(np.full(3, np.inf), H[:3, :, :0]) == (np.inf, 0)  # nothing is eliminated


def test_rotating_kernel_with_unknown_parameter():
    simulation, observation, truth = run(plant_from_mapping(ROTATING))
    assert simulation.structure.index == 2
    assert observation.truth.initial_dual.shape == (2, 4)
    assert_identity(simulation, observation, truth)
    gram = observation.regression.gram.final
    estimate = np.linalg.solve(gram[:, :-1], gram[:, -1])
    np.testing.assert_allclose(estimate, truth, atol=1e-9)


def test_solver_ivp_is_an_independent_check_of_the_observer():
    system = shipped("descriptor")
    t = np.linspace(0, 4, 101)
    results = [
        observed(system, 4.0, solver)[1].regression.psi(t)
        for solver in (SOLVER, SolverSettings(name="ivp"))
    ]
    np.testing.assert_allclose(results[0], results[1], atol=1e-8)


def test_assumption_1_violated_names_the_time_and_the_singular_value():
    signals = simulate(shipped("circuit"), TimeSettings(), SOLVER).signals
    blind = shipped("circuit", C=[[0, 0, 1, 0, 0, 0]])
    with pytest.raises(ModelError, match=r"Assumption 1 .* t = .* singular value"):
        observer_matrices(
            EquationForm.given(blind), signals.mesh.edges, signals.mesh.edges, 1e-10
        )
    found = observe(blind, seen(signals), SOLVER, form="given")
    (failed,) = [a for a in found.assumptions if not a.holds]
    assert failed.name == "Assumption 1"
    lost = np.isnan(found.state_map.offset.final)
    assert [blind.states[i] for i in np.flatnonzero(lost)] == ["iv"]


def test_rank_of_E_that_changes_is_an_error_of_the_observer():
    system = shipped(
        "descriptor", E=[[1, 0, 0], [0, 1, 0], [0, 0, "1e-3*step(t - 3)"]]
    )
    t = np.array([1.0, 5.0])
    with pytest.raises(ModelError, match="rank of E changes from 2 at t = 1 to 3 at t = 5"):
        observer_matrices(EquationForm(system, Units.plain(system)), t, t, 1e-10)


@pytest.mark.parametrize(
    ("xi_a0", "message"),
    [
        ([1.0, 2.0], "has 2 values but there are 3 differential states"),
        ({"iv": 1.0}, "there is no differential state 'iv'"),
        ({"e1": float("nan")}, "finite number"),
    ],
)
def test_xi_a0_that_does_not_fit(xi_a0, message):
    with pytest.raises(ConfigError, match=message):
        run(shipped("circuit"), xi_a0=xi_a0)


def test_starting_value_of_the_extension_is_free():
    """Another ξ_a(0) changes e₀ and nothing else."""
    _, _, truth = run(shipped("circuit"), xi_a0=[0.0, 0.0, 0.0])
    np.testing.assert_allclose(truth, [0, -1, -2], atol=1e-12)


@pytest.mark.parametrize(("xi_a0", "starts"), [
    (None, [0.0, 1.0, 5.0]), ({"b": 2.0}, [0.0, 2.0, 5.0]), ({"a": 0.3, "c": 4}, [0.3, 1.0, 4.0]),
    ([0.1, 0.2, 0.3], [0.1, 0.2, 0.3]),
])
def test_known_initial_values_are_those_said_or_the_plants(xi_a0, starts):
    plant = plant_from_mapping({
        "name": "p", "states": ["a", "b", "c"], "outputs": ["y"], "E": np.eye(3).tolist(),
        "A": np.diag([-1, -2, -3]).tolist(), "C": [[1, 1, 1]], "initial_state": [7, 1, 5],
    })
    _, found = observed(plant, 1.0, unknown_initial=["a"], xi_a0=xi_a0)
    assert found.regression.parameters == ("e0_a",)
    np.testing.assert_allclose(found.state_map.offset(np.zeros(1))[0], starts, atol=1e-12)
    np.testing.assert_allclose(found.state_map.gain(np.zeros(1))[0, :, 0], [-1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("unknown", [["w"], ["v1"], ["v2", "w"]])
def test_known_initial_values_are_those_that_constraints_leave(unknown):
    """Two capacitors are joined at the start; their charge stays, and both voltages jump."""
    result = experiment({
        "name": "joined", "states": ["v1", "v2", "i", "w"], "inputs": {"u": "sin(t)"},
        "outputs": ["y"], "E": np.diag([1.0, 2.0, 0.0, 1.0]),
        "A": [[-0.1, 0, 1, 0], [0, -0.3, -1, 0], [1, -1, 0, 0], [1, 0, 0, -1]],
        "B": [[1], [0], [0], [0]], "C": [[0, 0, 1, 1]], "initial_state": [1.0, 0.4, 0.0, 0.5],
    }, observer={"form": "given", "unknown_initial": unknown}, time={"horizon": 5.0})
    moved = result.details.simulation.moved
    assert [change.used for change in moved[:2]] == pytest.approx([0.6, 0.6])
    for name in ("v1", "v2", "i", "w"):
        np.testing.assert_allclose(result.estimates[name][0, -1], result[name][-1], atol=1e-11)


@pytest.mark.parametrize("observer", ["gpebo", "kalman_bucy"])
@pytest.mark.parametrize("speed", [1.0, 7.3])
def test_an_output_that_sees_nothing_is_not_exciting_though_the_kernel_of_E_turns(speed, observer):
    """z1' = −z1, 0 = z2 − u, y = z2 for x = R(t)ᵀz: 𝒜w is zero by cancelling, and so is ψ."""
    c, s = f"cos({speed}*t)", f"sin({speed}*t)"
    result = experiment({
        "name": "turning", "states": ["a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[c, s], [0, 0]], "B": [[0], [-1]], "C": [[f"-{s}", c]],
        "A": [[f"-{c} + {speed}*{s}", f"-{s} - {speed}*{c}"], [f"-{s}", c]],
        "initial_state": {"a": 1, "b": 0},
    }, observer=observer).details
    assert not result.regression.psi.any()
    assert not result.excitation.is_ie
    assert "not determined by the data: a, b, e0_a" in result.verdict


@pytest.mark.parametrize("g", [1 / 9000, 0.3, 1 / 7])
def test_what_no_output_sees_is_not_excited_by_rounding(g):
    """A capacitor between two nodes that nothing else depends on: 𝒜 B cancels, to 1e-17."""
    found = experiment({
        "name": "p", "states": ["p", "a", "b"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": [[1, 0, 0], [0, 1, -1], [0, -1, 1]], "B": [[1], [0], [0]], "C": [[1, 0, 0]],
        "A": [["-1 - 0.2*sin(t)", 0, 0], [1, -g, 0], [0, 0, -g]], "initial_state": [1, 1, 0],
    }, time={"horizon": 5, "samples": 11}).details
    assert not found.excitation.is_ie
    unknown = {name for name, since in found.estimable.items() if since is None}
    assert unknown == {"a", "b", "e0_2"}


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("units", [np.ones(4), 10.0 ** np.array([3, -4, 0, 5])])
def test_a_kernel_that_stays_is_told_from_one_that_turns_in_any_units(units, size):
    rng, t = np.random.default_rng(3), np.linspace(0.0, 2.0, 5)
    E = rng.normal(size=(4, 2)) @ np.diag([size, 1e-7 * size]) @ rng.normal(size=(2, 4))
    moving = (1.0 + 0.5 * np.sin(t))[:, None, None] * E
    found = constant_split(moving / units, tuple("abcd"), units, 1e-10)
    assert found.rank == 2
    assert found.frame is not None
    assert not found.frame.axes
    P = found.projector[0] * units / units[:, None]
    np.testing.assert_allclose(P @ P, P, atol=1e-12)
    np.testing.assert_allclose(P, P.T, atol=1e-12)
    np.testing.assert_allclose(E @ P, E, atol=1e-12)
    np.testing.assert_allclose(found.pinv @ (moving / units) - found.dual @ found.projector, 0.0,
                               atol=1e-6 * np.abs(found.dual).max())
    turn = np.eye(4) + 1e-12 * t[:, None, None] * rng.normal(size=(4, 4))
    assert constant_split(moving @ turn / units, tuple("abcd"), units, 1e-10) is None
    small = constant_split(moving / units, tuple("abcd"), units, 1e-6)
    assert small is None or small.rank == 1


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("place", [(0, 1), (1, 0)])
def test_a_frame_is_left_in_either_direction(place, sign):
    """Of E = diag(2, 0): an entry in its kernel, or an equation outside of its range."""
    E = np.broadcast_to(np.diag([2.0, 0.0]), (3, 2, 2)).copy()
    frame, units = axes_frame(E[0]), np.ones(2)
    assert split_in_frame(E, frame, units, 1e-10).rank == 1
    E[1][place] = sign * 1e-3
    assert split_in_frame(E, frame, units, 1e-10) is None


def test_axes_of_what_is_differentiated_are_exact():
    frame = axes_frame(np.diag([2.0, 0.0, 3.0]))
    assert frame.axes
    assert frame.domain.tolist() == [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
    assert frame.kernel.tolist() == [[0.0], [1.0], [0.0]]
