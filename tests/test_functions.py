"""Plants from NumPy arrays and functions, the same ones as text, and large ones."""

from __future__ import annotations

import numpy as np
import pytest
from plants import shipped
from scipy import sparse

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.functions import Names, system_from_functions
from gpebo_cli.settings import Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

SOLVER = SolverSettings()


def circuit_E(t):
    E = np.zeros((len(t), 6, 6), dtype=t.dtype)
    E[:, 0, 0], E[:, 1, 1] = 3 + np.cos(t / 3), 2 - np.cos(2 * t)
    E[:, 2, 2] = 2 - np.exp(-t)
    return E


def circuit_A(t):
    A = np.zeros((len(t), 6, 6), dtype=t.dtype)
    A[:, 0, 0], A[:, 1, 1], A[:, 2, 2] = np.sin(t / 3) / 3, -2 * np.sin(2 * t), -np.exp(-t)
    A[:, 0, 3], A[:, 0, 4], A[:, 0, 5] = 1, -1, 1
    A[:, 1, 2], A[:, 1, 3], A[:, 2, 1] = -1, -1, 1
    A[:, 3, 0], A[:, 3, 1], A[:, 3, 3] = -1, 1, -(4 + 2 * np.sin(t))
    A[:, 4, 0], A[:, 4, 4], A[:, 5, 0] = -1, -(2 + np.sin(t)), -1
    return A


def circuit(**changes):
    entries = {
        "E": circuit_E, "A": circuit_A, "B": [[0], [0], [0], [0], [0], [-1]],
        "u": lambda t: (4 * np.cos(2 * t) * np.sin(t / 5))[:, None],
        "C": [[0, 0, 1, 0, 0, 1]], "initial_state": [0, 1, 2, 0.25, 0, -0.25],
        "names": Names(states=("e1", "e2", "il", "ir1", "ir2", "iv")),
    }
    return system_from_functions("circuit", **{**entries, **changes})


def test_taylor_coefficients_agree_with_those_of_the_text():
    t = np.linspace(0.1, 9, 23)
    ours, text = (s.coefficients.taylor(t, 3) for s in (circuit(), shipped("circuit")))
    for name in ("E", "A", "B", "F", "C", "u"):
        np.testing.assert_allclose(getattr(ours, name), getattr(text, name), atol=1e-11)


@pytest.mark.parametrize("changes", [{}, {"A": lambda t: circuit_A(t) * [1, 1, 1, 1, 0, 1]}])
def test_entries_of_arrays_are_those_that_are_not_always_zero(changes):
    t, source = np.linspace(0.0, 9, 23), circuit(**changes).coefficients
    found, full = source.entries(t, 3), source.taylor(t, 3)
    for name in ("E", "A", "B", "C"):
        whole = np.zeros_like(getattr(full, name))
        for (i, j), values in found.of(name).items():
            assert values.any()
            whole[:, :, i, j] = values
        np.testing.assert_array_equal(whole, getattr(full, name))


def test_the_experiment_does_not_see_where_a_plant_comes_from():
    settings = Settings(estimator={"name": "drem"}, time=TimeSettings(horizon=8.0))
    ours = run_experiment(settings, circuit())
    text = run_experiment(settings, shipped("circuit"))
    assert ours.simulation.index == 2
    np.testing.assert_allclose(ours.simulation.states, text.simulation.states, atol=1e-10)


def test_the_result_says_that_nothing_bounds_functions_from_python():
    for system, bounded in ((circuit(), False), (shipped("circuit"), True)):
        found = simulate(system, TimeSettings(horizon=2.0), SOLVER)
        assert found.bounded is bounded
    for observer in ("none", "gpebo"):
        settings = Settings(
            observer={"name": observer}, estimator={"name": "drem"},
            time=TimeSettings(horizon=2.0),
        )
        told = run_experiment(settings, circuit()).verdict
        assert "nothing bounds what functions from Python (E, A, u) do between" in told
        assert "nothing bounds" not in run_experiment(settings, shipped("circuit")).verdict


def test_given_derivatives_are_used_instead_of_complex_times():
    def real_only(t):
        if np.iscomplexobj(t):
            raise TypeError("no complex times")
        return circuit_E(t)

    with pytest.raises(ConfigError, match="E needs derivatives and does not take complex times"):
        circuit(E=real_only).coefficients.taylor(np.array([1.0]), 1)

    def derivative(t):
        dE = np.zeros((len(t), 6, 6))
        dE[:, 0, 0], dE[:, 1, 1], dE[:, 2, 2] = -np.sin(t / 3) / 3, 2 * np.sin(2 * t), np.exp(-t)
        return dE

    found = circuit(E=[real_only, derivative]).coefficients.taylor(np.array([1.0]), 1)
    expected = shipped("circuit").coefficients.taylor(np.array([1.0]), 1)
    np.testing.assert_allclose(found.E, expected.E, atol=1e-14)


def test_a_function_that_is_not_analytic_is_refused_where_it_matters():
    def kinked(t):
        return circuit_E(t) * (1 + np.abs(t))[:, None, None]

    with pytest.raises(ConfigError, match=r"is not analytic \(.* the radius [0-9.e-]+ resolves"):
        circuit(E=kinked).coefficients.taylor(np.array([0.5]), 1)
    circuit(E=kinked).coefficients.taylor(np.array([0.5]), 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"E": np.eye(5)}, r"E has shape \(5, 5\), expected \(6, 6\)"),
        ({"E": 1j * np.eye(6)}, "E is not an array of real numbers"),
        ({"E": [[1.0], [1.0, 2.0]]}, "E is not an array of real numbers"),
        ({"E": lambda t: [sparse.eye(7)] * len(t)}, r"E returned a matrix \(7, 7\), expected \(6"),
        ({"initial_state": [np.zeros(6)]}, r"initial_state has shape \(1, 6\), expected \(6,\)"),
        ({"theta": 1.0}, r"theta has shape \(\), expected \(1,\)"),
        ({"u": None}, "B and u go together"),
        ({"names": Names(states=("a", "b"))}, "2 names of states for 6 of them"),
        ({"names": Names(states="aacdef")}, "a is a state twice"),
        ({"names": Names(states="abcdef", outputs="a")}, "a is a state and an output"),
        ({"names": Names(inputs="t")}, "'t' cannot be a name of inputs; a name is made of letters"),
        ({"names": Names(outputs=[3])}, "3 cannot be a name of outputs"),
        ({"names": Names(states=["a", "$x$", *"cdef"])}, r"'\$x\$' cannot be a name of states"),
        ({"names": Names(states=["parameters", *"bcdef"])}, "a state cannot be called parameters"),
        ({"E": np.full((6, 6), np.nan)}, "E has an entry that is not finite"),
        ({"E": [[10**400] * 6] * 6}, "E is not an array of real numbers"),
        ({"A": lambda t: circuit_A(t)[:, :5]}, r"A returned shape \(3, 5, 6\)"),
        ({"A": lambda t: circuit_A(t) / 0.0}, "A is not finite at t = 1$"),
        ({"A": lambda t: circuit_A(t) / (t < 2)[:, None, None]}, "A is not finite at t = 2$"),
        ({"A": lambda t: circuit_A(t) / np.where(np.eye(6), (t < 2)[:, None, None], 1)},
         "A is not finite at t = 2$"),
    ],
)
def test_what_does_not_fit_is_named(changes, message):
    with np.errstate(all="ignore"), pytest.raises(ConfigError, match=message):
        circuit(**changes).coefficients.taylor(np.array([1.0, 2.0, 3.0]), 0)


def test_entries_of_functions_of_inputs_are_those_along_the_plants_own():
    found = system_from_functions(
        "known", E=[[1]], A=lambda t, u: u[:, :, None] ** 2, C=[[1]], B=[[1]],
        u=lambda t: np.cos(t)[:, None], initial_state=[0],
    ).coefficients.entries(np.array([0.5]), 1).of("A")[0, 0]
    np.testing.assert_allclose(found[:, 0], [np.cos(0.5) ** 2, -np.sin(1.0)], atol=1e-12)


def test_a_plant_has_arrays_of_its_own():
    """Whoever gave them may go on with others, as in a loop over plants."""
    A, C, theta, start = -np.eye(2), np.eye(2), np.ones(1), np.ones(2)
    system = system_from_functions(
        "two", np.eye(2), A, C=C, F=[[1.0], [0.0]], theta=theta, initial_state=start
    )
    for array in (A, C, theta, start):
        array[:] = 7.0
    found = system.coefficients.taylor(np.zeros(1), 0)
    np.testing.assert_array_equal(found.A[0, 0], -np.eye(2))
    np.testing.assert_array_equal(found.C[0, 0], np.eye(2))
    assert system.coefficients.zero == {"B", "D", "H", "phi", "u"}
    assert (system.theta, *system.initial_state) == (1.0, 1.0, 1.0)


def test_entries_that_come_later_and_outputs_that_are_not_known_are_named():
    """Where entries are stored is found at a few times; a mistake within a function is its own."""
    def later(t):
        return [sparse.csr_array([[-1.0, float(time == 5.0)], [0.0, -1.0]]) for time in t]

    def wrong(t):
        raise TypeError("a mistake of one's own")

    two = {"E": np.eye(2), "C": [[1.0, 0.0]], "initial_state": [1.0, 1.0]}
    source = system_from_functions("two", A=later, **two).coefficients
    np.testing.assert_array_equal(source.taylor(np.ones(1), 0).A[0, 0], -np.eye(2))
    with pytest.raises(ConfigError, match="plant two: A has entries where it had none at other t"):
        source.taylor(np.array([1.0, 5.0]), 0)
    fed = system_from_functions("two", A=lambda t, u, y: np.zeros((len(t), 2, 2)), **two)
    with pytest.raises(ConfigError, match="plant two: A depends on the outputs, which are not kn"):
        fed.coefficients.taylor(np.ones(1), 0)
    assert not fed.coefficients.of_time.taylor(np.ones(1), 0).A.any()
    known = {"A": -np.eye(2), "B": np.zeros((2, 1)), "u": lambda t: t[:, None]}
    along = {**two, "C": lambda t, u: np.stack([u[:, 0], 0.0 * t], axis=1)[:, None]}
    seen = system_from_functions("two", **known, **along)
    assert seen.coefficients.taylor(np.array([3.0]), 0).C.ravel().tolist() == [3.0, 0.0]
    with pytest.raises(TypeError, match="a mistake of one's own"):
        system_from_functions("two", A=wrong, **two).coefficients.taylor(np.ones(1), 0)
    rows = [lambda t: np.ones((len(t), 3, 2)), lambda t: np.zeros((len(t), 3, 2))]
    assert system_from_functions("two", A=-np.eye(2), **two | {"C": rows}).r == 3


def test_a_large_plant():
    """A chain of 40 oscillators whose ends are tied together: index 3, constant coefficients."""
    masses = 40
    n = 2 * masses + 1
    E, A = np.eye(n), np.zeros((n, n))
    E[-1, -1] = 0.0
    A[:masses, masses : 2 * masses] = np.eye(masses)
    stiffness = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    A[masses : 2 * masses, :masses] = -stiffness
    A[masses, -1], A[2 * masses - 1, -1] = 1.0, -1.0  # the force that ties the first to the last
    A[-1, 0], A[-1, masses - 1] = 1.0, -1.0
    x0 = np.zeros(n)
    x0[:masses] = np.sin(np.pi * np.arange(1, masses + 1) / (masses + 1))  # symmetric: consistent
    system = system_from_functions("chain", E, A, initial_state=x0)
    result = simulate(system, TimeSettings(horizon=10.0), SolverSettings(tol=1e-9, stages=8))
    assert result.structure.index == 3
    # The symmetric mode never strains the tie: it is the free mode of the chain.
    frequency = 2 * np.sin(np.pi / (2 * (masses + 1)))
    t = np.linspace(0, 10, 21)
    expected = np.cos(frequency * t)[:, None] * x0[:masses]
    np.testing.assert_allclose(result.signals.states(t)[:, :masses], expected, atol=1e-8)
