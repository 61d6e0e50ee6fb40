"""Systems of index 2 to 4 with known solutions, made by mixing a canonical form in time."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from hypothesis import example, given, settings
from hypothesis import strategies as st

from benchmarks.honesty import made
from gpebo_cli.errors import ModelError
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

t = sp.Symbol("t", real=True)  # of which less is asked


def triangular(n, rng, density, varying, lower):
    """Unit triangular: its inverse is a polynomial, so every entry stays simple."""
    M = sp.eye(n)
    for i in range(n):
        for j in range(n):
            if (j < i) == lower and i != j and rng.random() < density:
                entry = sp.Rational(int(rng.integers(-9, 10)), 10)
                if varying and rng.random() < 0.5:
                    amplitude = sp.Rational(int(rng.integers(-5, 6)), 10)
                    entry += amplitude * sp.sin(int(rng.integers(1, 3)) * t)
                M[i, j] = entry
    return M


def manufactured(n, d, blocks, seed, varying):
    """E = Q diag(I, N) T, A = Q (diag(A_d, I) T − diag(I, N) T'), f = E x' − A x for a given x."""
    rng = np.random.default_rng(seed)
    N = sp.zeros(n - d, n - d)
    first = 0
    for size in blocks:  # nilpotent Jordan blocks: the index is the largest
        for k in range(size - 1):
            N[first + k + 1, first + k] = 1
        first += size
    E_c = sp.diag(sp.eye(d), N)
    A_d = sp.Matrix(np.round(rng.normal(size=(d, d)) * 0.5 - np.eye(d), 2))
    A_c = sp.diag(A_d, sp.eye(n - d))
    density = min(0.3, 3 / n)
    T = triangular(n, rng, density, varying, True) * triangular(n, rng, density, varying, False)
    Q = triangular(n, rng, density, varying, True)
    E, A = Q * E_c * T, Q * (A_c * T - E_c * T.diff(t))
    x = sp.Matrix([
        sp.sin((1 + k % 3) * t + k) * (1 if k % 2 else sp.exp(-t / 5)) for k in range(n)
    ])
    f = E * x.diff(t) - A * x

    def text(matrix):
        return [[str(entry) for entry in matrix.row(i)] for i in range(matrix.rows)]

    plant = plant_from_mapping({
        "name": "manufactured", "states": [f"x{i}" for i in range(n)],
        "inputs": {f"u{i}": str(f[i]) for i in range(n)},
        "E": text(E), "A": text(A), "B": np.eye(n).tolist(),
        "initial_state": [float(entry.subs(t, 0)) for entry in x],
    })
    return plant, [sp.lambdify(t, entry, "numpy") for entry in x]


def simulated(plant, exact):
    """A simulation, and the largest error of its states beside the largest state."""
    result = simulate(plant, TimeSettings(horizon=5.0), SolverSettings())
    times = np.linspace(0, 5, 201)
    truth = np.array([entry(times) for entry in exact]).T
    return result, np.abs(result.signals.states(times) - truth).max() / np.abs(truth).max()


@pytest.mark.parametrize(
    ("n", "d", "blocks", "varying", "seeds"),
    [
        (4, 2, [2], True, 2),
        (6, 2, [3, 1], True, 2),
        (8, 3, [4, 1], True, 1),
        (8, 3, [4, 1], False, 1),
        (12, 4, [4, 2, 2], True, 1),
        (17, 8, [4, 3, 2], False, 1),
    ],
)
def test_manufactured_solution_is_found(n, d, blocks, varying, seeds):
    for seed in range(seeds):
        plant, exact = manufactured(n, d, blocks, seed, varying)
        result, error = simulated(plant, exact)
        assert result.structure.index == max(blocks)
        assert result.structure.d == d
        assert error < 1e-9
        assert error < 10 * result.error_estimate


def test_any_start_of_a_manufactured_system_ends_on_its_constraints():
    """From an inconsistent start the constraints hold at every time, hidden ones included."""
    plant, _ = manufactured(8, 3, [4, 1], 3, True)
    moved = type(plant)(**{**vars(plant), "initial_state": plant.initial_state + 1.0})
    result = simulate(moved, TimeSettings(horizon=3.0), SolverSettings())
    h = 1e-4  # E x' − A x − f, with x' by a fourth-order difference
    times = np.linspace(0.1, 2.9, 15)
    x = result.signals.states
    slope = (8 * (x(times + h) - x(times - h)) - (x(times + 2 * h) - x(times - 2 * h))) / (12 * h)
    c = plant.coefficients.taylor(times, 0)
    residual = np.einsum("nij,nj->ni", c.E[0], slope) - np.einsum("nij,nj->ni", c.A[0], x(times))
    residual -= np.einsum("nij,nj->ni", c.B[0], c.u[0])
    assert np.abs(residual).max() < 1e-7


def test_the_estimate_forgets_an_elimination_that_was_not_used():
    """Where pivots will not do singular vectors do, and only their rounding counts."""
    result, error = simulated(*manufactured(20, 12, [4, 2, 2], 11, True))
    assert error < result.error_estimate < 1e3 * error


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.floats(0.0, 8.0))
@example(49, 3, 20.0 / 3.0)  # the derivative array has one constraint too many, and it looks clear
def test_a_stiff_mode_hides_no_constraint(seed, nu, decades):
    """One rate of up to 1e8 (index 3: 1e5), turned into all equations and states."""
    rate = 10.0 ** (decades if nu < 3 else decades * 0.6)
    case = made(np.random.default_rng(seed), nu + 3, nu, dynamics=np.diag([-rate, -1.0]))
    result = simulate(case.system, TimeSettings(horizon=case.horizon), SolverSettings())
    assert (result.structure.index, result.structure.d) == (nu, 2)
    times = np.linspace(0, case.horizon, 201)
    truth = case.exact(times)
    error = np.abs(result.signals.states(times) - truth).max(axis=0) / np.abs(truth).max(axis=0)
    assert error.max() < 1e-6
    assert (error < 10 * result.state_errors).all()


def test_what_rounding_leaves_nothing_of_is_refused_for_that():
    """Index 4 needs powers of the rate that doubles do not hold."""
    case = made(np.random.default_rng(5), 6, 4, dynamics=np.diag([-1e7, -1.0]))
    rng = np.random.default_rng(0)
    Q, T = rng.normal(size=(2, 5, 5))
    E, A = np.diag([1.0, 1.0, 0.0, 0.0, 0.0]) + np.diag([0.0, 0.0, 1.0, 1.0], -1), np.eye(5)
    A[0, 0], A[1, 1] = -1e7, -1.0
    constant = plant_from_mapping({
        "name": "constant", "states": [f"x{i}" for i in range(5)], "inputs": {"u": "sin(t)"},
        "E": (Q @ E @ T).tolist(), "A": (Q @ A @ T).tolist(), "B": np.ones((5, 1)).tolist(),
        "initial_state": [0.0] * 5,
    })
    for system in (case.system, constant):
        with pytest.raises(ModelError, match="leaves no digit of its hidden constraints"):
            simulate(system, TimeSettings(horizon=5.0), SolverSettings())
