"""Large sparse plants: elimination and series against derivative array and dense collocation."""

import os
import subprocess
import sys
import tracemalloc
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from kernel_paths import needs_kernels
from scipy.linalg import eigh, expm, null_space
from scipy.sparse import csr_matrix
from threadpoolctl import threadpool_info, threadpool_limits

from benchmarks import ladders
from gpebo_cli import from_matrices, load_plant, run, system_from_functions
from gpebo_cli.errors import ConfigError, ModelError
from gpebo_cli.findings import OnDemand
from gpebo_cli.kernels.threads import single
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics import series, taylor
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import SHARE, Mesh, Trajectory, initial_mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import AffineStateMap
from gpebo_cli.observers.reduced import extension
from gpebo_cli.reduction import scaling
from gpebo_cli.reduction.constant import constant_form
from gpebo_cli.reduction.explicit import UndecidedError, _Equations
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation import large, simulate

CELLS = 6
TIME = TimeSettings(horizon=8.0)


def ladder(cells):
    """E, A, B, C of an RLC ladder of index 1: voltages, currents, and the source's current."""
    n = 2 * cells + 1
    E, A, B, C = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 1)), np.zeros((2, n))
    E[range(n - 1), range(n - 1)] = 1.0
    for k in range(cells):
        A[k, cells + k], A[cells + k, k], A[cells + k, cells + k] = 1.0, -1.0, -0.1
        if k + 1 < cells:
            A[k, cells + k + 1], A[cells + k + 1, k] = -1.0, 1.0
    A[cells - 1, cells - 1] = A[-1, -1] = -1.0
    B[cells, 0] = A[-1, cells] = C[0, -1] = C[1, cells - 1] = 1.0
    return E, A, B, C


def source_on_a_node(cells):
    """Index 2: a capacitor in a loop with the source."""
    E, A, B, C = ladder(cells)
    A[-1], B[:] = 0.0, 0.0
    A[-1, 0], B[-1, 0], A[0, -1] = 1.0, -1.0, 1.0
    return E, A, B, C


def current_source(cells):
    """Index 2: an inductor in series with a source of current."""
    E, A, B, C = ladder(cells)
    A[-1], B[:] = 0.0, 0.0
    A[-1, cells + 1], B[-1, 0], A[cells + 1, -1] = 1.0, -1.0, 1.0
    return E, A, B, C


def floating(cells):
    """Capacitors between nodes, too: E is no diagonal."""
    E, A, B, C = ladder(cells)
    for k in range(cells - 1):
        E[k : k + 2, k : k + 2] += [[0.5, -0.5], [-0.5, 0.5]]
    return E, A, B, C


def ungrounded(cells):
    """A singular block of E: only the difference of two states is differentiated."""
    E, A, B, C = ladder(cells)
    E[:2, :2] = [[0.5, -0.5], [-0.5, 0.5]]
    return E, A, B, C


def tied(cells):
    """Index 2: two capacitors side by side, of which the second is twice as large."""
    E, A, B, C = ladder(cells)
    E[1, 1], A[-1], B[:], A[0, -1], A[1, -1] = 2.0, 0.0, 0.0, 1.0, -1.0
    A[-1, 0], A[-1, 1], B[cells, 0] = 1.0, -1.0, 1.0
    return E, A, B, C


def chain(cells):
    """Index 3: masses and springs, of which the last has its position prescribed."""
    n = 2 * cells + 1
    E, A, B, C = np.eye(n), np.zeros((n, n)), np.zeros((n, 1)), np.zeros((2, n))
    E[-1, -1] = 0.0
    for k in range(cells):
        A[k, cells + k], A[cells + k, cells + k], A[cells + k, k] = 1.0, -0.1, -2.0
        if k + 1 < cells:
            A[cells + k, k + 1] = A[cells + k + 1, k] = 1.0
    A[-2, -1] = A[-1, cells - 1] = C[0, 0] = C[1, -1] = 1.0
    B[-1, 0] = -1.0
    return E, A, B, C


def grid(cells):
    """Heat on cells × 3 nodes: loops, which elimination fills; conductances over four decades."""
    n = 3 * cells
    E, A, B, C = np.eye(n), np.zeros((n, n)), np.zeros((n, 1)), np.zeros((2, n))
    for i in range(n):
        for j in {i + 1, i + 3} & set(range(n)):
            g = 10.0 ** (4 * (i * 7 % n) / n)
            A[np.ix_([i, j], [i, j])] += g * np.array([[-1.0, 1.0], [1.0, -1.0]])
    A[0, 0] -= 1.0
    B[0, 0] = C[0, 0] = C[1, -1] = 1.0
    return E, A, B, C


PLANTS = [ladder, source_on_a_node, current_source, floating, ungrounded, tied, chain]


def plant(build, *, varying=False, cells=CELLS, u="sin(t)", rate=1.0, swing=1, inputs=1, **more):
    E, A, B, C = build(cells)
    n = len(E)

    def text(matrix, factor):
        return [[f"{v}*({factor.format(i)})" if v and varying else v for v in row]
                for i, row in enumerate(matrix.tolist())]

    return load_plant({
        "name": build.__name__, "states": [f"x{k}" for k in range(n)],
        "inputs": {f"u{k}": u for k in range(inputs)},
        "outputs": ["y1", "y2"], "E": text(E, "1 + 0.3*cos(t + {})"),
        "A": text(rate * A, f"1 + 0.2*sin({swing}*t + {{}})"),
        "B": np.repeat(B / inputs, inputs, axis=1).tolist(), "C": C.tolist(),
        "initial_state": [1.0, 0.5, *[0.1] * (n - 2)], **more,
    })


def both(system, tol=1e-9):
    solver = SolverSettings(tol=tol)
    found = large.large_simulation(system, TIME, solver)
    assert found is not None
    return found, simulate._simulate_linear(system, TIME, SolverSettings(tol=1e-11))


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("build", PLANTS)
def test_structure_start_and_solution_are_those_of_the_derivative_array(build, varying):
    known = np.arange(len(build(CELLS)[0])) == CELLS + 1  # further terms, in one equation
    found, dense = both(plant(
        build, varying=varying, unknowns={"w": 0.3, "v": -2.0}, D=[[0.5], ["cos(t)"]],
        F=[["1 + sin(t)", 0.2] if here else [0, 0] for here in known], H=[[0, 2], ["t", 0]],
        phi=["cos(2*t)" if here else 0 for here in known],
    ))
    one, other = found.structure, dense.structure
    assert (one.index, one.mu, one.a, one.d) == (other.index, other.mu, other.a, other.d)
    np.testing.assert_allclose(found.initial_state, dense.initial_state, atol=1e-13)
    t = np.linspace(0.0, TIME.horizon, 41)
    x, true = found.signals.states(t), dense.signals.states(t)
    size = np.abs(true).max(axis=0)
    wrong = np.abs(x - true).max(axis=0) / np.maximum(size, SHARE * size.max())
    assert (wrong < 10.0 * found.state_errors + 1e-12).all()
    assert found.state_errors.max() < 1e-8
    np.testing.assert_allclose(found.signals.outputs(t), dense.signals.outputs(t), atol=1e-8)


@pytest.mark.parametrize("build", PLANTS)
def test_the_structure_alone_is_that_of_the_derivative_array(build):
    """By elimination; of few states by the array itself."""
    system, settings = plant(build, varying=True), (TIME, SolverSettings())
    one, other = large.structure_of(system, *settings), large.dense_structure(system, *settings)
    assert (one.mu, one.a, one.d, one.time_invariant) == (other.mu, other.a, other.d, False)
    assert one.reference.rank == 0 < other.reference.rank
    assert large.structure_of(plant(build, cells=3), *settings).reference.rank > 0


def test_the_least_pivot_is_the_smallest_coefficient_of_what_is_solved_for():
    """Relative to the largest that it is; of full matrices to the largest singular value."""
    A = ladder(CELLS)[1].tolist()
    A[-1][-1] = "-1 - t/8"
    found = large.structure_of(plant(ladder, A=A), TIME, SolverSettings())
    assert found.smallest_singular_value == pytest.approx(0.5)
    full = constant_form(np.array([[2.0, 0.6], [0.6, 2.0]]), -np.eye(2), 5)
    assert full.pivot == pytest.approx((2.0 - 0.6) / (2.0 + 0.6))
    assert full.mu == 0


def test_what_cancels_now_and_moves_is_not_taken_for_nothing():
    def added(*more):
        of_row = {3: np.array([[1.0], [2.0]])}
        equations = SimpleNamespace(row=lambda _: of_row, where=lambda _: {0}, units=np.ones(4))
        _Equations.add(equations, 0, np.eye(2, 1), {3: np.array(more)[:, None]}, None)
        return of_row

    assert not added(-1.0, -2.0)
    with pytest.raises(UndecidedError):
        added(-1.0, 5.0)


def test_what_is_tiny_beside_another_state_is_not_solved_for():
    """Though it is in fewer rows: of 1e-9 a + (2 - t) b = ... b is taken, which is 1 at least."""
    row = {0: np.full((1, 2), 1e-9), 1: np.array([[2.0, 1.0]])}
    equations = SimpleNamespace(
        row=lambda _: row, where=lambda k: range(1 + k), units=np.ones(2), least=1.0
    )
    assert _Equations.pivot(equations, 0, [0, 1]) == 1
    assert equations.least == 0.5


def star(cells):
    """One algebraic state that is the sum of all others, and drives them."""
    E, A, C = np.eye(cells + 1), -np.eye(cells + 1), np.eye(2, cells + 1)
    A[:, -1], A[-1, :-1], E[-1, -1], A[-1, -1] = 1.0, 1.0, 0.0, -2.0
    return E, A, np.eye(cells + 1, 1), C


@pytest.mark.parametrize(("system", "most"), [
    (lambda: plant(source_on_a_node, u="sin(t) + step(t - 3)"), 999),  # a jump has an impulse
    (lambda: plant(chain, u="abs(sin(t))"), 999),
    (lambda: plant(ladder), 7),  # elements
    (lambda: plant(star, varying=True, cells=60), 999),  # elimination fills what is sparse
])
def test_what_series_are_not_made_for_is_left_to_the_derivative_array(system, most):
    assert large.large_simulation(system(), TIME, SolverSettings(max_elements=most)) is None


def test_indices_of_full_matrices_have_the_limit_of_differentiations():
    E, A, *_ = chain(10)
    assert constant_form(E, A, 2).mu == 2
    with pytest.raises(UndecidedError):
        constant_form(E, A, 1)


def test_inputs_may_be_the_same_function():
    one, two = (large.large_simulation(plant(ladder, inputs=count), TIME, SolverSettings())
                for count in (1, 2))
    np.testing.assert_allclose(two.signals.states.final, one.signals.states.final, atol=1e-12)


def test_an_input_that_is_zero_drives_nothing():
    found, dense = both(plant(ladder, u=0))
    final = dense.signals.states.final
    np.testing.assert_allclose(found.signals.states.final, final, atol=1e-9)


def test_a_full_E_that_moves_is_no_constant_one():
    """(1 + 0.3 cos t) M x' = −M x leaves every state what it was times one function of time."""
    M = np.eye(14) + 0.05
    E = [[f"{v}*(1 + 0.3*cos(t))" for v in row] for row in M.tolist()]
    system = plant(lambda n: (M, -M, 0.0 * M[:, :1], M[:2]), cells=14, E=E, name="full")
    found = large.large_simulation(system, TimeSettings(horizon=1.0), SolverSettings(tol=1e-9))
    t = 0.5 * np.arange(3)
    ways = np.arctan(np.sqrt(0.7 / 1.3) * np.tan(0.5 * t)) * 2.0 / np.sqrt(0.91)
    true = np.exp(-ways)[:, None] * system.initial_state
    np.testing.assert_allclose(found.signals.states(t), true, rtol=1e-8)


def test_a_jump_of_the_input_moves_algebraic_states_only():
    found, dense = both(plant(ladder, varying=True, u="sin(t) + step(t - 3)"))
    (t, before, jump), (when, _, other) = found.jumps[0], dense.jumps[0]
    assert t == when == 3.0
    np.testing.assert_allclose(jump.after, other.after, atol=1e-9)
    np.testing.assert_allclose(jump.after[:-1], before[:-1], atol=1e-12)


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize(("build", "u"), [
    (source_on_a_node, "abs(sin(t))"), (current_source, "sin(t) + step(t - 3)*(t - 3)"),
    (tied, "max(sin(t), 0.3)"), (chain, "sin(t) + step(t - 3)*(t - 3)**2"),
])
def test_a_derivative_that_jumps_at_the_end_of_hidden_constraints_moves_no_other_state(
    build, u, varying
):
    found, dense = both(plant(build, u=u, varying=varying))
    t = np.linspace(0.05, TIME.horizon, 40)
    x, true = found.signals.states(t), dense.signals.states(t)
    np.testing.assert_allclose(x, true, atol=1e-9 * np.abs(true).max())
    for (when, _, jump), (same, _, other) in zip(found.jumps, dense.jumps, strict=True):
        assert when == pytest.approx(same)
        np.testing.assert_allclose(jump.after, other.after, atol=1e-8)
        np.testing.assert_array_equal(jump.impulses, 0.0 * other.impulses)


def test_a_narrow_pulse_is_not_overlooked():
    found, dense = both(plant(ladder, u="exp(-((t - 4)/0.01)**2)"))
    end = found.signals.states.final
    np.testing.assert_allclose(end, dense.signals.states.final, atol=1e-8)


@pytest.mark.parametrize("build", PLANTS)
def test_errors_are_not_larger_than_they_are_said_to_be(build):
    system = plant(build, varying=True)
    fine = large.large_simulation(system, TIME, SolverSettings(tol=1e-12))
    t = np.linspace(0.0, TIME.horizon, 41)
    true = fine.signals.states(t)
    for tol in (1e-4, 1e-7):
        found = large.large_simulation(system, TIME, SolverSettings(tol=tol))
        off = np.abs(found.signals.states(t) - true).max(axis=0)
        assert (off <= 10.0 * found.state_errors * np.abs(true).max(axis=0)).all()


def test_a_state_that_cancels_is_measured_by_what_it_is_made_of():
    """a and b are the same and c = a − b is none; e = a + b counts by its own size."""
    system = load_plant({
        "name": "alike", "states": list("abce"), "inputs": {"u": "1 + sin(t)"},
        "E": np.diag([1.0, 1.0, 0.0, 0.0]).tolist(), "B": [[1], [1], [0], [0]],
        "A": [[-1, 0, 0, 0], [0, -1, 0, 0], [1, -1, -1, 0], [1, 1, 0, -1]],
        "initial_state": [0.3, 0.3, 0.0, 0.6],
    })
    found = large.large_simulation(system, TIME, SolverSettings(tol=1e-9))
    assert np.abs(found.signals.states.values[..., 2]).max() < 1e-15
    assert 0.0 < found.state_errors[2] < 1e-8
    assert found.state_errors[2:] == pytest.approx(found.state_errors[:2].max(), rel=0.5)


def test_a_state_that_an_input_gives_is_as_wrong_as_polynomials_leave_it():
    """x0 = u: nothing is integrated for it."""
    system = plant(source_on_a_node, u="exp(-((t - 4)/0.3)**2)")
    found = large.large_simulation(system, TIME, SolverSettings(tol=1e-4, stages=5))
    t = np.linspace(0.0, TIME.horizon, 2001)
    wrong = np.abs(found.signals.states(t)[:, 0] - np.exp(-(((t - 4) / 0.3) ** 2))).max()
    assert 1e-7 < wrong < found.state_errors[0] < 1e-3


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize(("build", "rate"), [
    *((build, 1.0) for build in (ladder, current_source, floating, tied, chain, grid)),
    (ladder, 1e5),
])
def test_a_change_of_units_and_signs_changes_nothing(build, rate, varying):
    """States, equations, time and the input: structure, start, solution, its errors, elements."""
    E, A, B, C = build(CELLS)
    n, rng, found = len(E), np.random.default_rng(1), []
    start = np.array([1.0, 0.5, *[0.1] * (n - 2)])
    for power in (0.0, 1.0):
        x, rows = (10.0 ** (power * rng.integers(-6, 7, n)) * rng.choice([-1.0, 1.0], n) ** power
                   for _ in range(2))
        T, d = 10.0 ** (power * 3), -10.0 ** (power * 2) if power else 1.0

        def text(matrix, factor, x=x, rows=rows, T=T):
            scaled = (rows[:, None] * matrix / x).tolist()
            return [[f"{v!r}*({factor.format(f't/{T!r}')})" if v and varying else v for v in row]
                    for row in scaled]

        one = large.large_simulation(load_plant({
            "name": "units", "states": [f"x{k}" for k in range(n)], "outputs": ["y1", "y2"],
            "inputs": {"u": f"{d!r}*sin(t/{T!r})"}, "E": text(T * E, "1 + 0.3*cos({})"),
            "A": text(rate * A, "1 + 0.2*sin({})"), "B": (rows[:, None] * B / d).tolist(),
            "C": (C / x).tolist(), "initial_state": (start * x).tolist(),
        }), TimeSettings(horizon=8.0 * T), SolverSettings(tol=1e-9))
        found.append((one, one.initial_state / x, one.signals.states.values / x))
    (one, start, x), (other, again, y) = found
    size, parts = np.abs(x).max(axis=(0, 1)), ("mu", "a", "d")
    assert [getattr(one.structure, p) for p in parts] == [
        getattr(other.structure, p) for p in parts]
    assert (np.abs(again - start) < 1e-14 * size).all()
    assert (np.abs(y[-1, -1] - x[-1, -1]) < 1e-10 * size).all()
    assert np.abs(np.log(other.state_errors / one.state_errors)).max() < np.log(8.0)
    assert len(x) / 3 < len(y) < 3 * len(x)


@pytest.mark.parametrize("seed", range(4))
def test_units_of_unconnected_states_do_not_lend_each_other_rounding(seed):
    """Oscillators and N x' = x + u; a derivative of u jumps, so that the derivative array is used.

    Units are powers of two: what nothing mixes has the same digits in all of them.
    """
    n = 18
    E, A, B = np.eye(n), np.diag(np.linspace(-2.0, 0.0, n)), np.ones((n, 1))
    E[16:, 16:], A[16:, 16:] = [[0.0, 1.0], [0.0, 0.0]], np.eye(2)
    for k in range(0, 16, 2):
        A[k, k + 1], A[k + 1, k] = 2.0, -1.0
    rng, start = np.random.default_rng(seed), np.append(np.ones(16), [0.0, -1.0])
    order, spread = rng.permutation(n), 2.0 ** rng.integers(-20, 21, n // 2).repeat(2)

    def found(units):
        system = plant_from_mapping({
            "name": "apart", "states": [f"x{k}" for k in range(n)], "B": B[order],
            "inputs": {"u": "sin(t) + step(t - 1)*(t - 1)"}, "E": (E * units)[order],
            "A": (A * units)[order], "initial_state": (start / units).tolist(),
        }, "apart")
        x = simulate.simulate(system, TimeSettings(horizon=2.0), SolverSettings()).signals.states
        return x(np.linspace(0.0, 2.0, 9)) * units

    x = found(np.ones(n))
    np.testing.assert_allclose(found(spread), x, rtol=1e-13, atol=1e-14 * np.abs(x).max())


@pytest.mark.parametrize(("matrix", "k"), [("E", 2), ("A", -1)])
@pytest.mark.parametrize("factor", ["sin(t - 4)", "(0.01 + (t - 4)**2)"])
def test_pivots_that_come_near_zero_are_left_to_the_derivative_array(matrix, k, factor):
    E, A, B, C = ladder(CELLS)
    rows = {"E": E.tolist(), "A": A.tolist()}
    rows[matrix][k][k] = factor
    system = load_plant({
        "name": "near", "states": [f"x{k}" for k in range(len(E))], "inputs": {"u": "sin(t)"},
        "outputs": ["y1", "y2"], **rows, "B": B.tolist(), "C": C.tolist(),
        "initial_state": [0.0] * len(E),
    })
    assert large.large_simulation(system, TIME, SolverSettings()) is None


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize(("build", "rate"), [(grid, 1.0), (ladder, 1e5)])
def test_a_stiff_sparse_plant_is_as_wrong_as_it_says(build, rate, varying):
    system, settings = plant(build, varying=varying, rate=rate), (TIME, SolverSettings(tol=1e-9))
    found = large.large_simulation(system, *settings)
    exact = large.large_simulation(system, TIME, SolverSettings(tol=1e-12))
    dense = simulate._simulate_linear(system, *settings)
    t = np.concatenate([np.geomspace(1e-7, TIME.horizon, 50)])
    true = exact.signals.states(t)
    for one in (found, dense):
        wrong = np.abs(one.signals.states(t) - true).max(axis=0) / np.abs(true).max(axis=0)
        assert (wrong <= 3.0 * (one.state_errors + exact.state_errors)).all()
        assert wrong.max() < 1e-8
    ratio = found.state_errors / dense.state_errors
    assert 0.1 < ratio.min() <= ratio.max() < 2e3


@pytest.mark.parametrize(("n", "varying"), [(41, True), (41, False), (101, True)])
def test_a_ladder_with_rates_over_six_decades_has_an_estimate_of_use(n, varying):
    """It was 5e32 and more: rounding that fast modes forget was carried on through all of them."""
    start = np.zeros(n)
    start[1:3] = 1.0
    system = ladders.plant(ladders.ladder(n, "stiff"), start, varying=varying)
    found = simulate.simulate(system, TIME, SolverSettings(tol=1e-9))
    other = simulate.simulate(system, TIME, SolverSettings(tol=1e-12, stages=10))
    t = np.linspace(0.0, TIME.horizon, 401)
    true = other.signals.states(t)
    wrong = np.abs(found.signals.states(t) - true).max(axis=0) / np.abs(true).max(axis=0)
    assert (wrong < found.state_errors + other.state_errors).all()
    assert found.error_estimate < 1e-8


def test_a_stiff_varying_plant_that_elimination_would_fill_is_left_to_dense_collocation():
    def full(cells):
        A = -1e5 * (np.eye(cells) + np.random.default_rng(0).uniform(0, 0.1, (cells, cells)))
        return np.eye(cells), A, np.ones((cells, 1)), np.ones((2, cells))

    system = plant(full, varying=True, cells=12)
    assert large.large_simulation(system, TIME, SolverSettings()) is None


def test_kicks_are_added_at_right_ends():
    rng, mesh = np.random.default_rng(0), Mesh(np.linspace(0.0, 1.0, 4), radau_rule(4))
    A, kicks, start = (rng.normal(size=shape) for shape in ((3, 3), (3, 3, 2), (3, 2)))
    matrix = series.Sparse(np.array([0, 3, 6, 9]), np.tile(np.arange(3), 3), A.reshape(1, 9))
    values, _ = series.by_factors(matrix)(mesh, matrix, np.zeros((1, 3, 0)), kicks, start, 1e-9)
    np.testing.assert_allclose(values[1:, 0], (values[:, -1] + kicks)[:-1], rtol=1e-12)
    np.testing.assert_allclose(values[0, -1], expm(A / 3.0) @ start, rtol=1e-6)


@pytest.mark.parametrize("rate", [1, 4, 20])
def test_what_decays_and_comes_back_is_resolved_or_refused(rate):
    """x' = rate (t − 10) x falls to e^(−50 rate), and is 1 again; e^−1000 is nothing in float64."""
    system = load_plant({
        "name": "back", "states": ["a", "b"], "outputs": ["y"], "E": [[1, 0], [0, 1]],
        "A": [[f"{rate}*(t - 10)", 0], [0, f"{rate}*(t - 10)"]], "C": [[1, 0]],
        "initial_state": [1, 2],
    })
    found = large.large_simulation(system, TimeSettings(horizon=20.0), SolverSettings())
    assert (found.lost is None) == (rate < 20)
    if rate < 20:
        np.testing.assert_allclose(found.signals.states.final, [1.0, 2.0], rtol=1e-11)
    else:
        assert found.lost == pytest.approx(10.0 + np.sqrt(70.8), abs=0.1)


def test_coefficients_that_swing_are_resolved_before_anything_is_solved(monkeypatch):
    """Elements are solved on one mesh, and as well as they are by other elements."""
    solved, terms = [], series._terms

    def counted(A, f, mesh, *others):
        solved.append(mesh.size)
        return terms(A, f, mesh, *others)

    monkeypatch.setattr(series, "_terms", counted)
    system, time = plant(ladder, varying=True, swing=200), TimeSettings(horizon=2.0)
    found = large.large_simulation(system, time, SolverSettings(tol=1e-9))
    assert len(solved) == 1
    true = large.large_simulation(system, time, SolverSettings(tol=1e-11, stages=11)).signals.states
    off = np.abs(found.signals.states.final - true.final)
    assert (off <= found.state_errors * np.abs(true.values).max(axis=(0, 1))).all()


def test_a_matrix_is_resolved_in_units_of_its_states():
    mesh, places = Mesh(np.linspace(0.0, 4.0, 9), radau_rule(4)), np.array([0, 1, 0, 1])
    entries = np.sin(mesh.points.reshape(-1, 1) * [1.0, 2.0, 3.0, 4.0])
    plain, other = (
        large._Plant.matrix_tail(None, mesh, SimpleNamespace(
            d=2, units=units, matrix=SimpleNamespace(
                entries=entries * (units[[0, 0, 1, 1]] / units[places]), columns=places,
                rows=np.array([0, 2, 4]),
            ),
        )) for units in (np.ones(2), np.array([1e6, 1e-3]))
    )
    assert plain.min() > 0.0
    np.testing.assert_allclose(other, plain, rtol=1e-9)


def by_place(matrix, rows, columns):
    return {f"{rows[i]},{columns[j]}": float(matrix[i, j]) for i, j in zip(*np.nonzero(matrix),
                                                                           strict=True)}


def test_entries_by_name_are_those_of_rows():
    E, A, B, C = ladder(CELLS)
    states, outputs = [f"x{k}" for k in range(len(E))], ["y1", "y2"]
    common = {"name": "l", "states": states, "inputs": {"u": "sin(t)"}, "outputs": outputs,
              "initial_state": [0.0] * len(E)}
    rows = {"E": E.tolist(), "A": A.tolist(), "B": B.tolist(), "C": C.tolist()}
    named = {"E": by_place(E, states, states), "A": by_place(A, range(len(A)), states),
             "B": {states[CELLS]: {"u": 1.0}}, "C": by_place(C, outputs, states)}
    one, other = (load_plant(common | m).coefficients.taylor(np.zeros(1), 0) for m in (rows, named))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("A", "says"), [
    ({"x1,x2": 1, "x9,x1": 2}, "row 'x9' is no state"),
    ({"x1": None, "x2": -1}, "in braces with quotation marks"),
    ({"x1,x2": 1, "0": {"x2": 3}}, "twice"),
    ({"x1,7": 1}, "number from 0 to 1"),
])
def test_entries_that_are_nowhere(A, says):
    with pytest.raises(ConfigError, match=says):
        load_plant({"name": "p", "states": ["x1", "x2"], "E": {"x1,x1": 1, "x2,x2": 1}, "A": A,
                    "initial_state": [0, 0]})


@pytest.mark.parametrize("varying", [False, True])
def test_sparse_matrices_from_python(varying):
    E, A, B, C = ladder(CELLS)
    given = {"B": B, "u": lambda t: np.sin(t)[:, None], "initial_state": np.eye(len(E))[0]}

    def full(t):
        return np.cos(t)[:, None, None] * A

    def few(t):
        return [csr_matrix(np.cos(x) * A) for x in t]

    plants = [
        system_from_functions("full", E, full if varying else A, C=C, **given),
        system_from_functions("few", csr_matrix(E), few if varying else csr_matrix(A),
                              C=csr_matrix(C), **given),
    ]
    one, other = (simulate.simulate(plant, TIME, SolverSettings()) for plant in plants)
    np.testing.assert_allclose(one.signals.states.final, other.signals.states.final, atol=1e-12)
    c, d = (plant.coefficients.taylor(np.ones(2), 1) for plant in plants)
    np.testing.assert_allclose(c.A, d.A, atol=1e-13)


def test_a_thousand_states_take_no_square_of_memory():
    n = 1201
    states = [f"x{k}" for k in range(n)]
    A = {f"x{k},x{j}": "0.1*cos(t)" if j == k else 1.0 if j < k else -1.0
         for k in range(n - 1) for j in (k - 1, k, k + 1) if 0 <= j < n - 1}
    plant = load_plant({
        "name": "wave", "states": states, "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "E": {f"x{k},x{k}": 1.0 for k in range(n - 1)}, "B": {"x0,u": 1.0},
        "A": A | {f"x{n - 1},x{n - 1}": -1.0, f"x{n - 1},x0": 1.0}, "C": {"y,x0": 1.0},
        "initial_state": [0.0] * n,
    })
    tracemalloc.start()
    found = simulate.simulate(plant, TimeSettings(horizon=2.0), SolverSettings(tol=1e-9))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * n * n * 20  # one matrix at all points would be ten times as much
    x = found.signals.states.values
    np.testing.assert_allclose(x[..., -1], x[..., 0], atol=1e-12)


@needs_kernels
@pytest.mark.parametrize(("varying", "states", "experiment"), [(False, 6, 4), (True, 10, 4.5)])
def test_little_more_than_the_result_is_held(varying, states, experiment):
    """Of 41 states over all elements, and of Φ and G, which are 41 times as much each."""
    system = ladders.plant(ladders.ladder(41, "index 1"), np.ones(41), varying=varying)
    time, solver = {"horizon": 20.0, "samples": 101}, {"tol": 1e-9}

    def simulated():
        return simulate.simulate(system, TimeSettings(**time), SolverSettings(**solver))

    def observed():
        least_squares = {"name": "least_squares", "f0": 1e-12}
        return run(system, estimator=least_squares, time=time, solver=solver)

    for work, most in ((simulated, states), (observed, experiment * 2 * 41)):
        size = simulated().signals.states.values.nbytes
        work()  # what is kept for good is there then
        assert ladders._peak(work) < most * size


@needs_kernels
@pytest.mark.parametrize(
    ("n", "kind", "varying", "unlike"),
    [(7, "index 1", False, False), (25, "capacitor loop", True, True), (25, "index 3", True, True),
     *((n, kind, True, False) for n in (11, 41) for kind in ladders.KINDS)],
)
def test_ladders_hold_less_than_ten_times_their_result(n, kind, varying, unlike):
    work = ladders.simulation(n, kind, varying=varying, unlike=unlike)
    size = work().signals.states.values.nbytes  # what is kept for good is there then
    assert ladders._peak(work) < 10 * size


def observed(unknown, n=CELLS, **observer):
    system = plant(ladder, varying=True, cells=n)
    return run(
        system, observer={"name": "gpebo", "unknown_initial": unknown, **observer},
        estimator={"name": "least_squares", "f0": 1e-12}, time={"horizon": 8.0, "samples": 41},
    )


def test_only_unknown_initial_values_are_estimated():
    result = observed(["x1", "x9"], xi_a0={"x1": 0.1, "x9": 0.0})
    assert list(result.parameters) == ["e0_x1", "e0_x9"]
    np.testing.assert_allclose(list(result.parameters.values()), [0.1 - 0.5, -0.1], atol=1e-9)
    for name in ("x0", "x5", "x12"):
        np.testing.assert_allclose(result.errors[name][0, -1], 0.0, atol=1e-9)
    everything = observed(None)
    assert len(everything.parameters) == 2 * CELLS


@pytest.mark.parametrize(("observer", "says"), [
    ({"unknown_initial": ["x99"]}, "'x99' is no differential state"),
    ({"unknown_initial": ["x12"]}, r"'x12' is no differential state; .*: x0, .*, x7, …\)"),
    ({"unknown_initial": ["x1"], "remedy": "reset"}, "accepted remedies"),
    ({"unknown_initial": ["x1"], "sample_time": 0.1}, "continuous time only"),
])
def test_initial_values_that_cannot_be_the_unknown_ones(observer, says):
    with pytest.raises(ConfigError, match=says):
        observed(observer.pop("unknown_initial"), **observer)


def test_combinations_of_states_have_no_initial_value_to_name():
    """Two flows whose sum is bound: errors are of combinations."""
    bound = {
        "name": "bound", "states": ["v", "w", "p"], "outputs": ["y"],
        "E": [[1, 0, 0], [0, 1, 0], [0, 0, 0]], "A": [[-1, 0, 1], [0, -2, 1], [1, 1, 0]],
        "C": [[1, 0, 0]], "initial_state": [1, -1, 0],
    }

    def of(names):
        observer = {"name": "gpebo", "form": "strangeness_free", "unknown_initial": names}
        return run(bound, observer=observer, time={"horizon": 1.0, "samples": 5})

    with pytest.raises(ConfigError, match=r"'v' has no initial error of its own: e0_1, … are of"):
        of(["v"])
    assert not of([]).parameters


def test_the_extension_by_series_is_that_of_dense_elements(monkeypatch):
    found = observed(None)
    monkeypatch.setattr(extension.series, "solve_dense", lambda *_, **__: None)
    dense = observed(None)
    for name in ("x3", "x12"):  # before the end parameters are hardly told apart
        one, other = found.estimates[name][0, -1], dense.estimates[name][0, -1]
        np.testing.assert_allclose(one, other, atol=1e-7)
    psi, other = found.details.regression.psi, dense.details.regression.psi
    np.testing.assert_allclose(psi, other, atol=1e-9)


def saddle(velocities, pressures, rng):
    """Index 2, as finite elements of a flow give it: M v' = −K v + Jᵀp + b u, J v = 0; all full."""
    orthogonal = np.linalg.qr(rng.standard_normal((velocities, velocities)))[0]
    M = orthogonal * rng.uniform(0.5, 2.0, velocities) @ orthogonal.T
    K = orthogonal.T * np.logspace(0, 5, velocities) @ orthogonal
    J = rng.standard_normal((pressures, velocities))
    return M, K, J, rng.standard_normal(velocities)


def matrices(blocks):
    """E, A and B (n, 1) of M v' = −K v + Jᵀp + b u, J v = 0."""
    M, K, J, b = blocks
    n, count = len(M) + len(J), len(M)
    E, A, B = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 1))
    E[:count, :count], A[:count, :count], A[:count, count:], A[count:, :count] = M, -K, J.T, J
    B[:count, 0] = b
    return E, A, B


def exact_flow(blocks, t):
    """v (N, ·) and p (N, ·) for u = sin 3t from rest, by the modes of what Jᵀ does not reach."""
    M, K, J, b = blocks
    N = null_space(J)
    rates, V = eigh(N.T @ K @ N, N.T @ M @ N)
    forced = V.T @ N.T @ b / (rates**2 + 9.0)
    t = t[:, None]
    q = forced * (rates * np.sin(3 * t) - 3 * np.cos(3 * t) + 3 * np.exp(-rates * t))
    v = q @ (N @ V).T
    inward = J @ np.linalg.inv(M)
    return v, np.linalg.solve(inward @ J.T, inward @ (K @ v.T - np.outer(b, np.sin(3 * t)))).T


def full_plant(E, A, B, C=None, u="sin(3*t)"):
    C = np.eye(len(E))[:1] if C is None else C
    return load_plant(from_matrices(
        {"E": E, "A": A, "B": B, "C": C}, "full", inputs={"u": u}
    ).mapping())


def test_a_full_stiff_plant_of_index_2_agrees_with_its_modes():
    blocks = saddle(48, 11, np.random.default_rng(4))
    found = large.large_simulation(full_plant(*matrices(blocks)), TIME, SolverSettings(tol=1e-9))
    assert (found.structure.mu, found.structure.d) == (1, 37)
    states = found.signals.states
    true = np.concatenate(exact_flow(blocks, states.mesh.points.ravel()), axis=1)
    wrong = np.abs(states.values.reshape(true.shape) - true).max(axis=0) / np.abs(true).max(axis=0)
    assert wrong.max() < 1e-9
    assert (wrong <= found.state_errors).all()


@pytest.mark.parametrize(("build", "varying"), [
    *((build, varying) for build in PLANTS for varying in (False, True)), (None, False),
])
def test_states_and_what_is_integrated_of_them_belong_together(build, varying):
    """Both ways, at the first time alone, and by sizes; of a full plant, too."""
    blocks = saddle(48, 11, np.random.default_rng(4))
    system = plant(build, varying=varying) if build else full_plant(*matrices(blocks))
    mesh, rng = Mesh(np.array([0.5, 1.0, 2.0]), radau_rule(4)), np.random.default_rng(0)
    form = large._Plant(system, 7).eliminate(mesh)
    z = rng.normal(size=(mesh.points.size, form.d, 1))
    x, known = (form.states_from(y)[:, :, 0] for y in (z, 0.0 * z))
    np.testing.assert_allclose(form.reduced(x[0]) - form.reduced(known[0]), z[0, :, 0], atol=1e-13)
    first = form.at_first().states_from(z[:1])[0, :, 0]
    np.testing.assert_allclose(first, x[0], atol=1e-14 * np.abs(x).max())
    made_of, moved = form.sizes_from(np.abs(z).max(axis=0))[:, 0], np.abs(x - known).max(axis=0)
    assert (moved <= made_of * (1.0 + 1e-12) + 1e-14).all()
    assert (made_of <= 15.0 * np.maximum(moved, 0.1)).all()
    assert form.loss == (1.0 if build else pytest.approx(1.0 / form.pivot))
    if build is None:
        assert (np.abs(known) <= form.known).all()
        assert (form.known <= 15.0 * np.maximum(np.abs(known).max(axis=0), 0.1)).all()


@pytest.mark.parametrize("driven", [False, True])
def test_a_full_plant_that_nothing_drives_or_a_constant_and_an_input(driven):
    """The latter in one equation each; with 1 and u = exp(-t) as states it is a free plant, too."""
    rng, more = np.random.default_rng(8), {}
    if driven:
        more = {"inputs": {"u": "exp(-t)"}, "phi": np.eye(51)[3].tolist(),
                "B": np.eye(51)[:, 7:8].tolist()}
    E, A = np.linalg.qr(rng.normal(size=(51, 51)))[0], rng.normal(size=(51, 51)) / 9.0
    system = load_plant({
        "name": "free", "states": [f"x{k}" for k in range(51)], "E": E.tolist(), "A": A.tolist(),
        "initial_state": [1.0] * 51, **more,
    })
    found = large.large_simulation(system, TimeSettings(horizon=2.0), SolverSettings(tol=1e-9))
    slope = np.zeros((53, 53))
    slope[:51, :51], slope[52, 52] = E.T @ A, -1.0
    slope[:51, 51:] = E.T[:, [3, 7]] * driven
    end = (expm(2.0 * slope) @ np.ones(53))[:51]
    np.testing.assert_allclose(found.signals.states.final, end, atol=1e-9)


@pytest.mark.parametrize("build", [source_on_a_node, current_source, tied, chain])
def test_a_start_does_not_depend_on_units_of_equations_and_states(build):
    rng, (E, A, B, C) = np.random.default_rng(2), build(CELLS)
    n, T = len(E), 1e-5
    rows, columns, x0 = *10.0 ** rng.uniform(-6, 6, (2, n)), rng.normal(size=n)
    both = rows[:, None] * columns
    plain = full_plant(E, A, B, C, "cos(3*t)")
    other = full_plant(T * E * both, A * both, rows[:, None] * B, C * columns, f"cos(3*t/{T})")
    starts = [
        large.large_simulation(replace(system, initial_state=x), TimeSettings(horizon=h),
                               SolverSettings()).initial_state
        for system, x, h in ((plain, x0, 1.0), (other, x0 / columns, T))
    ]
    assert np.abs(starts[0] - x0).max() > 0.1
    np.testing.assert_allclose(columns * starts[1], starts[0], atol=1e-11)


def pulled(cells):
    """Index 3, where the force that holds the last mass pulls at its neighbour, too."""
    E, A, B, C = chain(cells)
    A[-3, -1] = 0.5
    return E, A, B, C


def test_a_start_takes_the_slopes_of_what_moves_in_straight_lines():
    """Both ways, from states that the constraints do not allow."""
    E, A, _, _ = pulled(CELLS)
    masses, forces = (
        [[f"{v}*(1 + {slope * ((i + j + 1) % 3)}*t)" if v else 0 for j, v in enumerate(row)]
         for i, row in enumerate(matrix.tolist())] for matrix, slope in ((E, 0.1), (A, 0.02))
    )
    x0 = np.random.default_rng(2).normal(size=len(A))
    found, dense = both(plant(pulled, u="1 + t", E=masses, A=forces, initial_state=x0.tolist()))
    assert np.abs(found.initial_state - x0).max() > 0.1
    np.testing.assert_allclose(found.initial_state, dense.initial_state, atol=1e-11)


def test_a_full_plant_starts_from_what_constraints_leave_of_its_momenta():
    """M (v − v₀) is a combination of rows of J, J v = 0, and p follows from the derivative."""
    rng = np.random.default_rng(4)
    M, K, J, b = blocks = saddle(48, 11, rng)
    x0, system = rng.normal(size=59), full_plant(*matrices(blocks), u="cos(3*t)")
    grown = large._Plant(replace(system, initial_state=x0), 7)
    mesh = Mesh(np.array([0.0, 1.0]), radau_rule(4))
    grown.eliminate(mesh)
    x, _ = large._start(grown, mesh)
    free = null_space(J)
    v = free @ np.linalg.solve(free.T @ M @ free, free.T @ M @ x0[:48])
    p = np.linalg.solve(J @ np.linalg.solve(M, J.T), J @ np.linalg.solve(M, K @ v - b))
    np.testing.assert_allclose(x[:48], v, atol=1e-10)
    np.testing.assert_allclose(x[48:], p, atol=1e-9 * np.abs(p).max())


def test_a_full_plant_of_index_3_is_the_sparse_one_in_other_coordinates():
    rng = np.random.default_rng(5)
    E, A, B, C = chain(27)
    left, right = (np.eye(len(E)) + 0.05 * rng.standard_normal(E.shape) for _ in "lr")
    u = "sin(t)**3"  # with which rest is a consistent start in all coordinates
    mixed = full_plant(left @ E @ right, left @ A @ right, left @ B, C @ right, u)
    plain, other = (large.large_simulation(s, TIME, SolverSettings(tol=1e-10))
                    for s in (full_plant(E, A, B, C, u), mixed))
    assert other.structure.mu == plain.structure.mu == 2
    final = right @ other.signals.states.final
    np.testing.assert_allclose(final, plain.signals.states.final, atol=1e-9)


def test_a_full_plant_with_equations_that_are_there_twice_is_refused():
    """All 30 algebraic equations determine the same state: what they differ by is rounding."""
    rng = np.random.default_rng(0)
    E, A = rng.standard_normal((2, 51, 51))
    E[21:], A[21:, 1:] = 0.0, 0.0
    with pytest.raises(ModelError, match="is an equation missing, or there twice"):
        simulate.simulate(full_plant(E, A, np.ones((51, 1))), TIME, SolverSettings())


@pytest.mark.parametrize("size", [1e-6, 1e-9])
def test_singular_values_that_decide_nothing_are_left_to_the_derivative_array(size):
    E, A, B = matrices(saddle(48, 11, np.random.default_rng(6)))
    U, sigma, V = np.linalg.svd(E[:48, :48])
    sigma[-1] = size
    E[:48, :48] = U * sigma @ V
    assert large.large_simulation(full_plant(E, A, B), TIME, SolverSettings()) is None


def test_a_stiff_sparse_plant_agrees_with_dense_collocation(monkeypatch):
    system = plant(ladder, cells=26, rate=1e4)
    settings = TIME, SolverSettings(tol=1e-10)
    found = large.large_simulation(system, *settings)
    monkeypatch.setattr("gpebo_cli.simulation.simulate.large_simulation", lambda *_: None)
    dense = simulate.simulate(system, *settings)
    np.testing.assert_allclose(
        found.signals.states.final, dense.signals.states.final, rtol=1e-8, atol=1e-12
    )


@pytest.mark.parametrize(("cells", "one"), [(1, True), (5, True), (101, False)])
def test_blas_has_one_thread_where_matrices_are_small(cells, one):
    asked = []

    def looked(_stage):
        asked.append({p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"})

    with threadpool_limits(limits=2, user_api="blas"):
        before = threadpool_info()
        run(plant(ladder, cells=cells), progress=looked, time={"horizon": 1.0}, observer="none")
        assert threadpool_info() == before
    assert asked
    assert all((1 in found) == one for found in asked)


def test_what_is_estimable_at_all_times_is_looked_at_when_it_is_read(monkeypatch):
    """Spectra at all output times take as long as the rest of a run; assumptions wait, too."""
    asked = []
    for name in ("estimation.estimable", "sources.of_simulation"):
        monkeypatch.setattr(f"gpebo_cli.experiment.{name}", lambda *_: asked.append(1))
    result = run(plant(ladder, cells=4), estimator="least_squares", time={"horizon": 1.0})
    assert not asked
    assert result.details.estimable is None
    assert asked


def test_what_is_computed_when_it_is_read_has_one_thread_of_blas_too():
    @dataclass
    class Read:
        threads: OnDemand[list[int]] = OnDemand()

    with threadpool_limits(limits=2, user_api="blas"):
        found = Read(lambda: [
            p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"
        ])
        assert set(found.threads) == {1}


def test_threads_of_blas_are_what_they_were_when_the_last_of_several_runs_has_ended():
    first, second = single(), single()
    with threadpool_limits(limits=2, user_api="blas"):
        before = threadpool_info()
        first.__enter__()
        with second:
            first.__exit__(None, None, None)
            assert {p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"} == {1}
        assert threadpool_info() == before


def test_a_blas_that_is_loaded_between_two_runs_has_one_thread_too():
    code = """
from gpebo_cli import run
from threadpoolctl import threadpool_info
def look(_stage):
    asked.append(sorted(p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"))
plant = {"name": "lags", "states": [f"x{i}" for i in range(9)], "initial_state": [1] * 9,
         "E": {f"x{i},x{i}": 1 for i in range(9)}, "A": {f"x{i},x{i}": -1 for i in range(9)}}
for imported in ("math", "scipy.linalg"):
    asked = []
    __import__(imported)
    run(plant, observer="none", progress=look, time={"horizon": 1.0})
    print(asked[0])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "OPENBLAS_NUM_THREADS": "2"}, text=True,
        check=True, capture_output=True,
    )
    assert done.stdout.splitlines() == ["[1]", "[1, 1]"]


def test_elements_that_are_cut_may_have_more_entries(monkeypatch):
    """And what comes before the first of them is not solved again."""
    d, begun, march = 12, [], taylor.march
    monkeypatch.setattr(
        taylor, "march", lambda units, mesh, *rest: (begun.append(mesh.edges[0]),
                                                     march(units, mesh, *rest))[1],
    )

    def coefficients(t, inside):
        """A narrow coupling, and within it one that is zero at all points of the first mesh."""
        narrow = np.maximum(1.0 - ((t - 3.0) / 0.04) ** 2, 1e-3)
        A = np.zeros((len(t), d, d))
        A[:, range(d), range(d)] = -1.0
        A[:, range(1, d), range(d - 1)] = 1.0 + np.exp(-(((t - 3.0) / 0.2) ** 2))[:, None]
        A[:, 0, d - 1] = np.where(narrow > 1e-3, np.exp(1.0 - 1.0 / narrow), 0.0)
        return LinearEquation(None, A, np.ones((len(t), d, d)), (A[:, 0, :],))

    mesh = initial_mesh(0.0, 6.0, [], 7, radau_rule(8))
    problem = LinearProblem(coefficients, np.eye(d), name="pulse")
    first = coefficients(mesh.points.ravel(), None).A[:, 0, d - 1]
    found = series.solve_dense(problem, mesh, tol=1e-9, max_elements=500)
    last = found.trajectory.mesh
    assert last.size > mesh.size
    assert max(begun) > 2.5
    once = series.solve_dense(problem, last, tol=1e-9, max_elements=500)
    np.testing.assert_allclose(found.trajectory.values, once.trajectory.values, atol=1e-10)
    np.testing.assert_allclose(found.errors, once.errors, rtol=0.1)
    again = coefficients(last.points.ravel(), None).extras[0]
    np.testing.assert_array_equal(found.extras[0].reshape(again.shape), again)
    assert not first.any()
    assert again[:, d - 1].any()
    t = np.linspace(0.0, 6.0, 31)
    expected = solve(problem, last, tol=1e-9, max_elements=500).trajectory(t)
    np.testing.assert_allclose(found.trajectory(t), expected, atol=1e-8)


@pytest.mark.parametrize(("rate", "logarithm"), [
    (lambda t: 1.0 / (t + 0.05), lambda t: np.log(20.0 * t + 1.0)),  # powers do not fall
    (lambda t: 30.0 * np.cos(60.0 * t), lambda t: 0.5 * np.sin(60.0 * t)),  # nor converge at first
])
@pytest.mark.parametrize("elements", [6, 20])
def test_series_of_coefficients_with_poles_or_that_swing(rate, logarithm, elements):
    """On elements that are short enough, or are cut first; five are too few."""
    def coefficients(t, inside):
        A = np.zeros((len(t), 9, 9))
        A[:, range(9), range(9)] = rate(t)[:, None]
        return LinearEquation(None, A, np.zeros((len(t), 9, 0)))

    problem = LinearProblem(coefficients, np.ones((9, 2)), name="rates")
    mesh = initial_mesh(0.0, 2.0, [], elements, radau_rule(14))
    known = coefficients(mesh.points.ravel(), mesh.inside.ravel())
    found = series.solve_dense(problem, mesh, tol=1e-9, max_elements=500, known=known)
    assert series.solve_dense(problem, mesh, tol=1e-9, max_elements=5, known=known) is None
    t = np.linspace(0.0, 2.0, 31)
    error = np.abs(found.trajectory(t) / np.exp(logarithm(t))[:, None, None] - 1.0).max()
    assert error <= found.error_estimate * 10.0 <= 1e-6


@pytest.mark.parametrize("swing", [0.0, 0.5])
@pytest.mark.parametrize(("rate", "most", "late"), [
    (3.0, 6.0, 0.0), (-3.0, 1.15, 0.0), (3.0, 3.0, 1e8), (-3.0, 2.0, 1e8),
])
def test_errors_of_series_are_those_of_collocation_on_the_same_elements(rate, most, late, swing):
    """sin 20t, of which errors grow or are forgotten; what series leave out comes beside them.

    Late it is rounding of times, by random signs; polynomials leave out less than that.
    """
    def coefficients(t, inside):
        t = t - late
        rates = rate * (1.0 + swing * np.cos(t if swing else np.zeros(1)))
        f = 20.0 * np.cos(20.0 * t) - rates * np.sin(20.0 * t)
        A, f = rates[:, None, None] * np.eye(9), f[:, None, None] * np.ones((9, 1))
        return LinearEquation(None, A, f)

    one, rule = np.ones((9, 1)), radau_rule(10 if late else 6)
    problem = LinearProblem(coefficients, 0.0 * one, name="sines", units=one)
    limits = {"tol": 1e-6 if late else 1e-3, "max_elements": 500}
    found = series.solve_dense(problem, initial_mesh(late, late + 2.0, [], 20, rule), **limits)
    other = solve(problem, found.trajectory.mesh, **limits)
    assert other.trajectory.mesh.size == found.trajectory.mesh.size
    beside = replace(problem, start=np.zeros((9, 6)))  # other columns are zero
    many = series.solve_dense(beside, found.trajectory.mesh, **limits).errors[:, 0]
    np.testing.assert_allclose(many, found.errors[:, 0], rtol=1e-6)
    ratio = found.errors / other.errors
    assert (0.25 if late else 1.0) < ratio.min() <= ratio.max() < most


def test_series_that_end_where_a_component_is_lost_lose_it_there():
    """From e^−5t rounding grows with e^5t, and is larger than what the state ever was."""
    A = np.kron(np.eye(5), [[0.0, 5.0], [5.0, 0.0]])[None]
    start = np.tile([[1.0], [-1.0]], (5, 1))
    problem = LinearProblem(lambda t, inside: LinearEquation(None, A, 0.0 * A[..., :1]), start)

    def lost(horizon):
        mesh = initial_mesh(0.0, horizon, [], int(10 * horizon), radau_rule(9))
        return series.solve_dense(problem, mesh, tol=1e-12, max_elements=200).lost

    first = lost(10.0)
    assert 5.0 < first < 8.0
    assert lost(first) == pytest.approx(first)
    assert lost(first - 0.1) is None


def test_a_component_that_is_nothing_is_measured_by_the_largest_that_it_was_ever_made_of():
    """a' = −a + u and b' = −b + u of u = 0 up to t = 1 and 1 then; c' = a − b is rounding."""
    A = np.kron(np.eye(3), [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [3.0, -3.0, 0.0]])[None]
    driven, one = np.tile([[1.0], [1.0], [0.0]], (3, 1)), np.ones((9, 1))
    problem = LinearProblem(
        lambda t, inside: LinearEquation(None, A, (inside > 1.0)[:, None, None] * driven),
        0.0 * one, name="alike", units=one,
    )
    mesh = initial_mesh(0.0, 2.0, [1.0], 20, radau_rule(10))
    found = series.solve_dense(problem, mesh, tol=1e-8, max_elements=20)
    c = np.abs(found.trajectory.values[:, :, 2]).max()
    assert c < 1e-15
    assert (found.errors[2::3] < 1e-8).all()


def test_errors_of_series_see_noise_that_no_mesh_resolves():
    """x' = cos t + 1e-6 sin 1e9t: coefficients of the polynomials do not fall."""
    def coefficients(t, inside):
        f = np.cos(t) + 1e-6 * np.sin(1e9 * t)
        return LinearEquation(None, np.zeros((1, 9, 9)), f[:, None, None] * np.ones((9, 1)))

    problem = LinearProblem(coefficients, np.zeros((9, 1)), name="noise", units=np.ones((9, 1)))
    mesh = initial_mesh(0.0, 2.0, [], 20, radau_rule(10))
    found = series.solve_dense(problem, mesh, tol=1e-8, max_elements=20)
    error = np.abs(found.trajectory.values[:, :, 0, 0] - np.sin(mesh.points)).max()
    assert 1e-8 < error < 5.0 * found.errors[0, 0]


def test_rounding_adds_up_in_stiff_elements_as_in_collocation():
    """What swings forgets no rounding of right ends, and polynomials leave nothing out."""
    A, one = np.kron(np.eye(5), [[0.0, 1.0], [-1.0, 0.0]])[None], np.ones((10, 1))
    f, limits = np.zeros((1, 10, 1)), {"tol": 1e-10, "max_elements": 200}
    problem = LinearProblem(
        lambda t, inside: LinearEquation(None, A, f), one, name="turns", units=one
    )
    mesh = initial_mesh(0.0, 200.0, [], 200, radau_rule(14))
    found, other = series.solve(
        problem, lambda mesh: (taylor.by_entries(A), f, ()), mesh,
        units=np.ones(10), stiff=True, **limits,
    ), solve(problem, mesh, **limits)
    ratio = found.errors / other.errors
    assert 0.8 < ratio.min() <= ratio.max() < 2.0


def test_units_of_many_states_are_those_of_full_equations(monkeypatch):
    """A ladder in units of all sizes, by sparse factors as by dense ones."""
    rng = np.random.default_rng(3)
    for n in (3, 9, 30):
        E = np.diag(rng.random(n) < 0.8).astype(float)
        A = np.diag(rng.normal(size=n - 1), 1) - np.eye(n)
        rows, columns = 10.0 ** rng.integers(-6, 7, (2, n))
        C = (np.arange(n) < 2) * rng.normal(size=(1, n))
        system = load_plant(from_matrices({
            "E": rows[:, None] * E * columns, "A": rows[:, None] * A * columns, "C": C * columns,
        }, "units").mapping())
        found = []
        for full in (400, 0):
            monkeypatch.setattr(scaling, "_FULL", full)
            c = system.coefficients.taylor(np.zeros(1), 2)
            found.append(scaling.units_at(c))
        for dense, sparse in zip(*found, strict=True):
            np.testing.assert_array_equal(sparse, dense)
        assert len(set(found[0].states)) > 1


def test_one_case_with_many_parameters_is_measured_as_many_cases_are():
    plant = full_plant(*ladder(17), u="sin(t)")
    found = [
        run(plant, estimator={"name": "least_squares", "f0": f0}, time={"horizon": 6.0},
            observer={"xi_a0": [0.1] * 34}).cases[0]
        for f0 in (1e-9, [1e-9, 1e-8])
    ]
    assert found[0]["rms_error_states"] > 1e-3
    for name in ("seconds_to_1pct_states", "final_error_states", "rms_error_states"):
        assert found[0][name] == pytest.approx(found[1][name], rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("p", [3, 40])
def test_states_of_cases_side_by_side_are_those_of_each(p):
    """Of one case with many parameters gains are not sampled."""
    mesh = initial_mesh(0.0, 3.0, [], 4, radau_rule(5))
    wave = np.sin(mesh.points[..., None, None] + np.arange(2.0 * p).reshape(2, p))
    states = AffineStateMap(mesh.trajectory(wave[..., 0].reshape(-1, 2)), Trajectory(mesh, wave))
    t = np.linspace(0.0, 3.0, 11)
    eta = np.random.default_rng(0).normal(size=(3, 11, p))
    exact = states.offset(t) + np.einsum("mij,gmj->gmi", states.gain(t), eta)
    np.testing.assert_allclose(states.at(t)(eta), exact, rtol=1e-12, atol=1e-12)
    for k in range(3):
        found = states.at(t)(eta[k : k + 1])[0]
        np.testing.assert_allclose(found, exact[k], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("chain", [0.0, 1.0])
def test_nine_states_of_which_none_is_differential(chain):
    """x_k = x_{k+1}' where there is a chain, else zero: nothing is left to integrate."""
    n = 9
    plant = {
        "name": "algebraic", "states": [f"x{k}" for k in range(n)], "inputs": {"u": "-cos(t)"},
        "outputs": ["y"], "E": chain * np.eye(n, k=1), "A": np.eye(n),
        "B": [*([[0]] * (n - 1)), [1]], "C": np.eye(1, n), "initial_state": np.zeros(n),
    }
    solver = {"max_strangeness_index": n}
    found = run(plant, solver=solver, time={"horizon": 3, "samples": 11})
    assert found.details.simulation.index == (n if chain else 1)
    np.testing.assert_allclose(found["x8"], np.cos(found.t), atol=1e-12)
    np.testing.assert_allclose(found["x4"], chain * np.cos(found.t), atol=1e-11)
    assert abs(found.errors["x0"][0, -1]) < 1e-10


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("n", [8, 9])
def test_an_index_above_the_limit_is_refused_at_every_size(n, turned):
    """A chain of index 4 among states of their own: by singular values, and by elimination."""
    rng, chain = np.random.default_rng(2), np.arange(n) < 4
    rows, columns = (np.linalg.qr(rng.normal(size=(n, n)))[0] if turned else np.eye(n)
                     for _ in range(2))
    E = np.diag(1.0 * ~chain) + np.diag(1.0 * chain[1:], 1)
    plant = {
        "name": "chain", "states": [f"x{k}" for k in range(n)], "inputs": {"u": "sin(t)"},
        "outputs": ["y"], "E": rows @ E @ columns, "A": rows @ np.diag(2.0 * chain - 1.0) @ columns,
        "B": rows[:, 3:4], "C": np.eye(1, n), "initial_state": np.zeros(n),
    }
    short = {"observer": "none", "time": {"horizon": 1, "samples": 3}}
    found = run(plant, solver={"max_strangeness_index": 3}, **short)
    assert found.details.simulation.index == 4
    said = r"above 3, for solver\.max_strangeness_index = 2; it seems to be 4: raise that to 3"
    with pytest.raises(ModelError, match=said):
        run(plant, solver={"max_strangeness_index": 2}, **short)


def test_an_index_above_the_limit_of_a_large_full_plant_is_refused():
    n, rng = 51, np.random.default_rng(2)
    rows, columns = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    E = np.diag(np.arange(n) > 1.0) + np.eye(1, n, 1).T * np.eye(1, n)  # 0 = x0, x0' = x1
    plant = plant_from_mapping({
        "name": "full", "states": [f"x{k}" for k in range(n)], "E": rows @ E @ columns,
        "A": rows @ columns, "initial_state": np.zeros(n),
    })
    limits = TimeSettings(horizon=1.0), SolverSettings(max_strangeness_index=1)
    assert large.structure_of(plant, *limits).index == 2
    with pytest.raises(ModelError, match="it seems to be 2: raise that to 1"):
        large.structure_of(plant, limits[0], SolverSettings(max_strangeness_index=0))
