"""Matrices that depend on inputs and outputs, known terms, feedthrough: along any signals."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_paths import by_both

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import MATRIX_NAMES
from gpebo_cli.model.functions import system_from_functions
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

TIMES = np.linspace(0.1, 3.0, 17)
U, Y = "2 + sin(t)", "cos(2*t) - t/5"


def plant(**entries):
    """Two states; V and y may stand nearly everywhere."""
    data = {
        "name": "p", "states": ["a", "b"], "inputs": {"V": U}, "unknowns": {"q": "2"},
        "outputs": ["y"], "E": [[1, 0], [0, "2 + cos(t)"]], "A": [["-t*y", "sin(V)"], [0, -1]],
        "B": [["y**2"], [0]], "F": [["exp(-y*V)"], ["t"]], "C": [["V", 1]],
        "phi": ["atan(y)", "3"], "D": [["V"]], "H": [["1/V"]], "initial_state": [1, 0],
    }  # fmt: skip
    return plant_from_mapping({**data, **entries})


def substituted():
    """The same with functions of time in the place of V and y."""
    return plant(
        A=[[f"-t*({Y})", f"sin({U})"], [0, -1]], B=[[f"({Y})**2"], [0]],
        F=[[f"exp(-({Y})*({U}))"], ["t"]], C=[[U, 1]], phi=[f"atan({Y})", "3"],
        D=[[U]], H=[[f"1/({U})"]],
    )  # fmt: skip


def signals(t, order):
    """Taylor coefficients (order + 1, N, 2) of V and y."""
    of_time = plant(A=[[U, 1], [Y, 0]], B=[[0], [0]], F=[[0], [0]], phi=None)
    return of_time.coefficients.taylor(t, order).A[..., 0]


@pytest.mark.parametrize("order", [0, 1, 4])
def test_along_signals_matrices_are_what_substitution_gives(order):
    source, known = plant().coefficients, signals(TIMES, order)
    for found in by_both(lambda: source.taylor(TIMES, order, None, known)):
        expected = substituted().coefficients.taylor(TIMES, order)
        for name in MATRIX_NAMES:
            np.testing.assert_allclose(
                getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-12
            )


def test_a_plant_says_which_matrix_depends_on_what():
    source = plant().coefficients
    y, V = {"y"}, {"V"}
    expected = {"A": y | V, "B": y, "F": y | V, "C": V, "phi": y, "D": V, "H": V}
    assert source.signals == expected
    assert source.constant == {"theta"}
    assert plant().depends_on_outputs
    assert not plant(A=[["V", 0], [0, 0]], B=[[1], [0]], F=[[1], [0]], phi=None).depends_on_outputs
    with pytest.raises(ConfigError, match="plant p: A depends on the output y, which is not known"):
        source.taylor(TIMES, 0)


def test_inputs_are_their_own_functions_where_nobody_measured_them():
    entries = {"A": [["V*t", 0], [0, 0]], "B": [[1], [0]], "F": [[1], [0]], "phi": ["V", 0]}
    source = plant(**entries).coefficients
    exact = plant(**{**entries, "A": [[f"({U})*t", 0], [0, 0]], "phi": [U, 0]}).coefficients
    for found in by_both(lambda: source.taylor(TIMES, 3)):
        np.testing.assert_allclose(found.A, exact.taylor(TIMES, 3).A, rtol=1e-14, atol=1e-14)
        np.testing.assert_allclose(found.phi, exact.taylor(TIMES, 3).phi, rtol=1e-14, atol=1e-14)


def test_values_need_no_derivatives_of_signals():
    source, known = plant().coefficients, signals(TIMES, 1)
    once, twice = (source.taylor(TIMES, 1, None, given) for given in (known[:1], known))
    np.testing.assert_array_equal(once.A[0], twice.A[0])
    np.testing.assert_array_equal(once.E, twice.E)
    np.testing.assert_array_equal(once.u[0], known[0, :, :1])
    assert not once.u[1].any()


def test_a_value_that_is_not_finite_along_the_signals_is_named_with_its_time():
    source = plant(F=[["1/y"], [0]]).coefficients
    known = np.stack([1.0 + 0 * TIMES, TIMES - TIMES[5]], axis=1)[None]
    with pytest.raises(ConfigError, match=r"F\[0\]\[0\] = '1/y' has no finite value at t = "):
        source.taylor(TIMES, 0, None, known)
    own = plant(inputs={"V": "1/(t - 1)"}, A=[["2*V", 0], [0, 0]], B=[[1], [0]], F=[[1], [0]],
                phi=None).coefficients  # fmt: skip
    with pytest.raises(ConfigError, match=r"inputs.V = '1/\(t - 1\)' has no finite value at t = 1"):
        own.taylor(np.array([0.5, 1.0]), 0)


@pytest.mark.parametrize("order", [0, 1, 3])
def test_functions_from_python_are_evaluated_along_signals_too(order):
    def A(t, u, y):
        out = np.zeros((len(t), 2, 2), dtype=y.dtype)
        out[:, 0, 0], out[:, 0, 1], out[:, 1, 1] = -t * y[:, 0], np.sin(u[:, 0]), -1
        return out

    def C(t, u):
        return np.stack([u[:, 0], np.ones_like(u[:, 0])], axis=1)[:, None]

    system = system_from_functions(
        "p", E=np.eye(2), A=A, B=[[0], [0]], u=lambda t: 2 + np.sin(t)[:, None], C=C,
        phi=lambda t, u, y: np.concatenate([np.arctan(y), 3 + 0 * y], axis=1),
        D=lambda t, u: u[:, :, None], initial_state=[1, 0],
    )
    found = system.coefficients.taylor(TIMES, order, None, signals(TIMES, order))
    expected = substituted().coefficients.taylor(TIMES, order)
    for name in ("A", "C", "D", "phi", "u"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9
        )
    assert system.coefficients.signals["C"] == {"u1"}
    assert system.coefficients.signals["A"] == {"u1", "y1"}
    with pytest.raises(ConfigError, match="A depends on the outputs"):
        system.coefficients.taylor(TIMES, 0)


def test_functions_may_not_depend_on_what_the_format_excludes():
    with pytest.raises(ConfigError, match="C takes 3 arguments, but may depend on t, u only"):
        system_from_functions("p", [[1.0]], [[-1.0]], initial_state=[1], C=lambda t, u, y: t*u*y)
    with pytest.raises(ConfigError, match="A takes 4 arguments, but may depend on t, u, y only"):
        system_from_functions("p", [[1.0]], lambda t, u, y, x: t * x, initial_state=[1])


@pytest.mark.parametrize("name", ["collocation", "ivp"])
@pytest.mark.parametrize("E", [[[1, 0], [0, "2 + cos(t)"]], [[1, 0], [0, 0]]])
def test_known_terms_and_feedthrough_are_simulated(name, E):
    """Against a plant that has them as inputs and as a state of its own."""
    same = {"name": "p", "unknowns": {"q": 2}, "outputs": ["y"], "B": [["t"], [0]]}
    ours = plant_from_mapping({
        **same, "states": ["a", "b"], "inputs": {"V": U}, "E": E,
        "A": [["-V", 0.5], [0.3, -1]], "F": [["cos(t)"], [1]], "initial_state": [1, 0.5],
        "phi": ["sin(3*t)", "V**2"], "C": [["V", 1]], "D": [["t"]], "H": [["exp(-t)"]],
    })  # fmt: skip
    other = plant_from_mapping({
        **same, "states": ["a", "b", "c"], "inputs": {"V": U, "one": 1},
        "E": [[*E[0], 0], [*E[1], 0], [0, 0, 0]],
        "A": [[f"-({U})", 0.5, 0], [0.3, -1, 0], [U, 1, -1]],
        "B": [["t", "sin(3*t)"], [0, f"({U})**2"], ["t", 0]], "F": [["cos(t)"], [1], ["exp(-t)"]],
        "C": [[0, 0, 1]], "initial_state": [1, 0.5, 0],
    })  # fmt: skip
    solver = SolverSettings(name=name, tol=1e-10)
    t = np.linspace(0, 4, 50)
    one, two = (simulate(s, TimeSettings(horizon=4.0), solver).signals for s in (ours, other))
    np.testing.assert_allclose(one.states(t), two.states(t)[:, :2], atol=1e-8)
    np.testing.assert_allclose(one.outputs(t), two.outputs(t), atol=1e-8)
