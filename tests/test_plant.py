"""Plant files: the shipped ones against hand formulas, and everything that is refused."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from plants import shipped
from processes import refused

from gpebo_cli import run
from gpebo_cli.configs import files
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.model.descriptor import MATRIX_NAMES, CoefficientSource, check_sizes
from gpebo_cli.model.plant import KEYS, plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

TIMES = np.array([0.0, 0.4, 1.7, 6.3, 19.5])

Plain = dict[str, Any]


def mine(**changes: object) -> Plain:
    """Two states, two inputs, an unknown and an output; ``None`` removes a key."""
    plain: Plain = {
        "name": "mine",
        "parameters": {"R": "2 + sin(t)", "k": 3},
        "states": ["x1", "x2"],
        "inputs": {"V": "cos(t)", "I": "k*step(t - 1)"},
        "unknowns": {"theta": 1.5},
        "outputs": ["y"],
        "E": [[1, 0], [0, 0]],
        "A": [["-d(R)", 1], ["k", "R"]],
        "B": [[1, 0], [0, "t"]],
        "F": [[0], [1]],
        "C": [[1, "k/2"]],
        "initial_state": {"x1": 1, "x2": "-k/2"},
    }
    plain.update(changes)
    return {key: value for key, value in plain.items() if value is not None}


def without(*keys: str, **changes: object) -> Plain:
    """The same with keys removed."""
    return {key: value for key, value in mine(**changes).items() if key not in keys}


# The shipped plants


def test_circuit_matrices() -> None:
    t = TIMES
    system = shipped("circuit")
    c = system.coefficients.taylor(t, 2)
    zero, one = np.zeros_like(t), np.ones_like(t)
    capacity = np.array([3 + np.cos(t / 3), 2 - np.cos(2 * t), 2 - np.exp(-t)])
    slopes = np.array([-np.sin(t / 3) / 3, 2 * np.sin(2 * t), np.exp(-t)])
    curvatures = np.array([-np.cos(t / 3) / 9, 4 * np.cos(2 * t), -np.exp(-t)])
    E = np.zeros((len(t), 6, 6))
    for k in range(3):
        E[:, k, k] = capacity[k]
    np.testing.assert_allclose(c.E[0], E, rtol=1e-14)
    for k in range(3):
        np.testing.assert_allclose(c.E[1, :, k, k], slopes[k], rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(c.E[2, :, k, k], curvatures[k] / 2, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(c.A[1, :, k, k], -curvatures[k], rtol=1e-13, atol=1e-15)
    R1, R2 = -(4 + 2 * np.sin(t)), -(2 + np.sin(t))
    A = np.array(
        [
            [-slopes[0], zero, zero, one, -one, one],
            [zero, -slopes[1], -one, -one, zero, zero],
            [zero, one, -slopes[2], zero, zero, zero],
            [-one, one, zero, R1, zero, zero],
            [-one, zero, zero, zero, R2, zero],
            [-one, zero, zero, zero, zero, zero],
        ]
    )
    np.testing.assert_allclose(c.A[0], np.moveaxis(A, 2, 0), rtol=1e-14, atol=1e-15)
    np.testing.assert_array_equal(c.B[0, 0, :, 0], [0, 0, 0, 0, 0, -1])
    np.testing.assert_array_equal(c.C[0, 0], [[0, 0, 1, 0, 0, 1]])
    np.testing.assert_allclose(c.u[0, :, 0], 4 * np.cos(2 * t) * np.sin(t / 5), rtol=1e-14)
    assert c.F.shape == (3, len(t), 6, 0)


def test_circuit_names_and_values() -> None:
    system = shipped("circuit")
    assert (system.name, system.source) == ("circuit", "circuit.yaml")
    assert system.states == ("e1", "e2", "il", "ir1", "ir2", "iv")
    assert (system.inputs, system.outputs, system.unknowns) == (("V",), ("y",), ())
    assert system.initial_state.tolist() == [0, 1, 2, 0.25, 0, -0.25]
    assert system.units["e2"] == system.units["V"] == "V"
    assert system.units["il"] == system.units["y"] == "A"
    assert system.observer_defaults == {"xi_a0": {"e1": 1, "e2": 0, "il": 0}}
    assert system.coefficients.constant == {"B", "C", "F", "theta", "phi", "D", "H"}
    assert "2407.14373" in system.reference


def test_descriptor() -> None:
    t = TIMES
    system = shipped("descriptor")
    c = system.coefficients.taylor(t, 0)
    k = 2
    s, cosine = np.sin(t[k]), np.cos(t[k])
    np.testing.assert_array_equal(c.E[0, k], np.diag([1, 1, 0]))
    np.testing.assert_allclose(
        c.A[0, k],
        [[-1, 0.5 + s / 4, 1], [-0.5, -0.5 - cosine / 4, 0.5], [0.5, -1, 2 + s]],
        rtol=1e-15,
    )
    np.testing.assert_array_equal(c.B[0, k], [[0], [1], [0.5]])
    np.testing.assert_allclose(c.F[0, k], [[1, 0], [0, cosine], [0.5, 0]], rtol=1e-15)
    np.testing.assert_array_equal(c.C[0, k], [[1, 0, 0.5]])
    np.testing.assert_allclose(c.u[0, :, 0], np.sin(t) + np.cos(2 * t) / 2, rtol=1e-14)
    assert system.theta.tolist() == [1.5, -0.8]
    assert system.unknowns == ("theta1", "theta2")
    assert system.initial_state[:2].tolist() == [1, -1]
    assert system.observer_defaults == {"xi_a0": {"x1": 0, "x2": 0}}


def test_canonical() -> None:
    t = TIMES
    system = shipped("canonical")
    c = system.coefficients.taylor(t, 0)
    assert system.states == ("za1", "za2", "zb1", "zb2", "zb3")
    N = c.E[0, :, 2:, 2:]
    np.testing.assert_array_equal(c.E[0, :, :2, :2], np.broadcast_to(np.eye(2), (5, 2, 2)))
    np.testing.assert_allclose(N[:, 1, 0], 1 + 0.3 * np.sin(t), rtol=1e-15)
    np.testing.assert_allclose(N[:, 2, 0], 0.5 + 0.2 * np.cos(t), rtol=1e-15)
    np.testing.assert_allclose(N[:, 2, 1], 1.5 + 0.5 * np.sin(2 * t), rtol=1e-15)
    assert not np.triu(N).any()
    assert not c.E[0, :, :2, 2:].any()
    assert not c.E[0, :, 2:, :2].any()
    np.testing.assert_allclose(c.A[0, :, 1, 0], -2 - np.sin(t), rtol=1e-15)
    np.testing.assert_array_equal(c.A[0, 0, 1, 1], -0.5)
    np.testing.assert_array_equal(c.A[0, :, 0], np.broadcast_to([0, 1, 0, 0, 0], (5, 5)))
    np.testing.assert_array_equal(c.A[0, :, 2:], np.broadcast_to(np.eye(5)[2:], (5, 3, 5)))
    forcing = np.einsum("tij,tj->ti", c.B[0], c.u[0])
    want = [np.zeros(5), np.sin(t), np.sin(t), np.cos(2 * t), np.sin(t / 2)]
    np.testing.assert_allclose(forcing, np.array(want).T, rtol=1e-15)
    np.testing.assert_array_equal(c.C[0, :, 0], np.broadcast_to([1, 0, 0, 0, 0], (5, 5)))
    np.testing.assert_allclose(
        c.C[0, 2, 1], [0.5, 0, 1 + 0.3 * np.cos(t[2]), 2 + 0.5 * np.sin(t[2]), 0], rtol=1e-15
    )
    assert system.initial_state[:2].tolist() == [1, 0]


@pytest.mark.parametrize("name", ["circuit", "descriptor", "canonical"])
def test_shipped_plants_use_documented_keys_only(name: str) -> None:
    plain = files.shipped(f"plant/{name}")
    assert set(plain) <= set(KEYS)
    assert plain["title"]
    assert plain["reference"]
    assert plain["name"] == name


# The coefficient source


def test_shapes_and_broadcast_constants() -> None:
    system = plant_from_mapping(mine())
    source: CoefficientSource = system.coefficients
    c = source.taylor(TIMES, 3)
    shapes = {"E": (2, 2), "A": (2, 2), "B": (2, 2), "F": (2, 1), "C": (1, 2), "u": (2,)}
    shapes |= {"theta": (1,), "phi": (2,), "D": (1, 2), "H": (1, 1)}
    for key in MATRIX_NAMES:
        assert getattr(c, key).shape == (4, 5, *shapes[key])
    assert source.constant == {"E", "F", "C", "theta", "phi", "D", "H"}
    assert source.zero == {"phi", "D", "H"}
    assert not source.signals
    np.testing.assert_array_equal(c.C[:, 3], [[[1, 1.5]], [[0, 0]], [[0, 0]], [[0, 0]]])
    np.testing.assert_array_equal(c.B[:2, 2], [[[1, 0], [0, 1.7]], [[0, 0], [0, 1]]])
    np.testing.assert_allclose(c.A[0, :, 0, 0], -np.cos(TIMES), rtol=1e-15)
    np.testing.assert_allclose(c.A[3, :, 1, 1], -np.cos(TIMES) / 6, rtol=1e-15)
    np.testing.assert_array_equal(c.A[1:, :, 1, 0], 0)


def test_breakpoints_and_inside_reach_the_expressions() -> None:
    source = plant_from_mapping(mine()).coefficients
    assert source.breakpoints(0.0, 5.0).tolist() == [1.0]
    assert source.breakpoints(1.0, 5.0).tolist() == []
    t = np.array([1.0, 1.0])
    assert source.taylor(t, 0, np.array([0.5, 1.5])).u[0, :, 1].tolist() == [0.0, 3.0]
    assert source.taylor(t, 0).u[0, :, 1].tolist() == [3.0, 3.0]


def test_a_value_that_is_not_finite_names_the_entry() -> None:
    plain = mine(A=[["-d(R)", 1], ["k", "1/(t - 2)"]])
    source = plant_from_mapping(plain, "mine.yaml").coefficients
    with pytest.raises(ConfigError) as caught:
        source.taylor(np.array([1.0, 2.0]), 1)
    says = "A[1][1] = '1/(t - 2)' has no finite value at t = 2"
    assert str(caught.value) == f"plant mine (mine.yaml): {says}"


def test_a_plant_copies_to_other_processes() -> None:
    system = shipped("circuit")
    copied = pickle.loads(pickle.dumps(system))  # noqa: S301  our own bytes
    np.testing.assert_array_equal(
        copied.coefficients.taylor(TIMES, 1).A, system.coefficients.taylor(TIMES, 1).A
    )


# What may be left out


def test_a_plant_without_inputs_unknowns_or_outputs() -> None:
    plain = without(
        "inputs", "unknowns", "outputs", "B", "F", "C", "parameters", A=[[1, 0], [0, 1]]
    )
    plain["initial_state"] = [1, "2*pi"]
    system = plant_from_mapping(plain)
    assert (system.n, system.m, system.q, system.r) == (2, 0, 0, 0)
    c = system.coefficients.taylor(TIMES, 1)
    assert c.B.shape == (2, 5, 2, 0)
    assert c.C.shape == (2, 5, 0, 2)
    assert c.u.shape == (2, 5, 0)
    assert system.coefficients.constant == set(MATRIX_NAMES)
    assert system.initial_state.tolist() == [1, 2 * np.pi]
    assert system.theta.shape == (0,)


@pytest.mark.parametrize("nothing", [None, [], {}])
def test_empty_keys_are_as_good_as_absent_ones(nothing: object) -> None:
    plain = without("inputs", "B")
    plain |= {"inputs": nothing, "B": None if nothing == {} else nothing, "units": None}
    assert plant_from_mapping(plain).m == 0


@pytest.mark.parametrize("changes", [{"D": [["t", 0]]}, {"A": [["V", 1], [1, 0]]}])
def test_inputs_may_be_in_the_outputs_or_in_another_matrix_only(changes: Plain) -> None:
    c = plant_from_mapping(without("B", **changes)).coefficients.taylor(TIMES, 1)
    assert (c.B.shape, c.B.any()) == ((2, 5, 2, 2), False)
    assert c.u[0, 0].tolist() == [1, 0]


def test_texts_become_one_line() -> None:
    system = plant_from_mapping(mine(title="two\n  lines", reference=2024), source="f.yaml")
    assert (system.title, system.reference, system.source) == ("two lines", "2024", "f.yaml")


def test_values_may_use_parameters_and_unknowns_keep_their_order() -> None:
    plain = mine(unknowns={"b": "k/2", "a": 2}, F=[[0, 1], [1, 0]])
    system = plant_from_mapping(plain)
    assert system.unknowns == ("b", "a")
    assert system.theta.tolist() == [1.5, 2.0]
    assert system.initial_state.tolist() == [1.0, -1.5]


def test_initial_state_by_name_in_any_order() -> None:
    system = plant_from_mapping(mine(initial_state={"x2": 5, "x1": 4}))
    assert system.initial_state.tolist() == [4.0, 5.0]


def test_a_parameter_may_share_the_name_of_an_input() -> None:
    plain = mine(parameters={"V": "cos(t)", "R": "t", "k": 1}, inputs={"V": "V", "I": "2*V"})
    u = plant_from_mapping(plain).coefficients.taylor(TIMES, 0).u[0]
    np.testing.assert_allclose(u[:, 1], 2 * np.cos(TIMES), rtol=1e-15)


# Refusals

REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "not a mapping": (lambda: ["name"], "must be a mapping"),
    "no name": (lambda: without("name"), "name is missing"),
    "name is a number": (lambda: mine(name=12), "name is '12'"),
    "name is a path": (lambda: mine(name="../../etc"), "name is '../../etc'"),
    "name is empty": (lambda: mine(name=""), "name is ''"),
    "name of two lines": (lambda: mine(name="a\nb"), "name is"),
    "unknown key": (lambda: mine(paramters={}), "'paramters'; did you mean parameters?"),
    "boolean key": (lambda: {**mine(), True: 1}, "unknown key 'True'"),
    "no states": (lambda: without("states"), "states is missing"),
    "empty states": (lambda: mine(states=[]), "states is empty"),
    "states is text": (lambda: mine(states="x1"), "states must be a list of names"),
    "states are booleans": (lambda: mine(states=[True, False]), "boolean true as a name; quote it"),
    "states are numbers": (lambda: mine(states=[1, 2]), "the name '1'"),
    "state is reserved": (lambda: mine(states=["t", "x2"]), "t, which is reserved"),
    "state is a sum": (lambda: mine(states=["states", "x2"]), "a state cannot be called states;"),
    "state is a function": (lambda: mine(states=["sin", "x2"]), "sin, which is reserved"),
    "state is no identifier": (lambda: mine(states=["x-1", "x2"]), "the name 'x-1'"),
    "state is not ASCII": (lambda: mine(states=["θ", "x2"]), "the name"),
    "state twice": (lambda: mine(states=["x1", "x1"]), "x1 is a state twice"),
    "state and input": (
        lambda: mine(inputs={"V": 1, "x1": 2}),
        "x1 is a state and an input; every name must be used once",
    ),
    "state and output": (lambda: mine(outputs=["x2"]), "x2 is a state and an output"),
    "input and unknown": (lambda: mine(unknowns={"V": 1}), "V is an input and an unknown"),
    "unknown and initial error": (lambda: mine(unknowns={"e0_x1": 1}), "the unknown e0_x1 has"),
    "inputs is a list": (lambda: mine(inputs=["V", "I"]), "inputs must map names to values"),
    "unknowns is a list": (lambda: mine(unknowns=["a"]), "unknowns must map names to values"),
    "inputs is an array": (lambda: mine(inputs=np.eye(2)), "inputs must map names to values"),
    "outputs is a mapping": (lambda: mine(outputs={"y": 1}), "outputs must be a list"),
    "input is a boolean": (lambda: mine(inputs={"V": True, "I": 0}), "inputs.V is the boolean"),
    "input name is a boolean": (lambda: mine(inputs={False: 1, "I": 0}), "boolean false as a name"),
    "half of a call, which a comma ended": (
        lambda: mine(parameters={"k": "max(t", "1)": None}), "quote what has a comma"),
    "a call in a row, which a comma ended": (
        lambda: mine(A=[["max(t", "1)", 1], [0, 1]]), "length 2; within brackets and"),
    "a call in each row": (
        lambda: mine(A=[[0, "max(t", "1)*t"]] * 2), "x2); within brackets and braces"),
    "a call in a list": (lambda: mine(phi=["max(t", "1)", 1]), "x2); within brackets and braces"),
    "parameters is text": (lambda: mine(parameters="R"), "parameters must map names"),
    "parameter is reserved": (lambda: mine(parameters={"exp": 1}), "exp, which is reserved"),
    "parameter is a keyword": (lambda: mine(parameters={"lambda": 1}), "write lambda_"),
    "input is a keyword": (
        lambda: mine(inputs={"is": "t", "I": 1}, phi=["is", 0]), "phi[0] = 'is': is is a word of",
    ),
    "output is a keyword": (lambda: mine(outputs=["in"], A=[["2*in", 1], [0, 1]]), "write in_ or"),
    "unknown is a keyword": (
        lambda: mine(unknowns={"None": 1}, F=[["None"], [0]]), "None is a word of Python",
    ),
    "parameter of a state": (
        lambda: mine(parameters={"R": "x1", "k": 3}),
        "parameters.R = 'x1': x1 is a state and cannot be used here",
    ),
    "parameter used early": (
        lambda: mine(parameters={"R": "k", "k": 3}),
        "k is a parameter defined further down",
    ),
    "parameter of itself": (
        lambda: mine(parameters={"R": "R + 1", "k": 3}),
        "R is this parameter itself",
    ),
    "parameter not defined": (lambda: mine(parameters={"k": "1/0"}), "parameters.k = '1/0'"),
    "matrix of a state": (lambda: mine(A=[["x1", 1], [0, 1]]), "A[0][0] = 'x1': x1 is a state"),
    "input in E": (
        lambda: mine(E=[[1, "V"], [0, 1]]),
        "E[0][1] = 'V': V is an input and may not stand in E: its derivative would be needed",
    ),
    "output in E": (
        lambda: mine(parameters={"R": 1, "k": 2, "z": "1 + y"}, E=[["2*z", 0], [0, 1]]),
        "E[0][0] = '2*z': y is an output and may not stand in E: its derivative would be needed",
    ),
    "output in C": (
        lambda: mine(C=[["y", 1]]), "C[0][0] = 'y': y is an output and may not stand in C",
    ),
    "output in D": (lambda: mine(D=[["y", 1]]), "y is an output and may not stand in D"),
    "signal in an input": (
        lambda: mine(parameters={"k": "1 + y"}, inputs={"V": "k", "I": 1}),
        "inputs.V = 'k': y is an output and may not stand in inputs.V",
    ),
    "d of a signal": (lambda: mine(A=[["d(V*t)", 0], [0, 1]]), "d(.) of something with V in it"),
    "state in phi": (lambda: mine(phi=["x1", 0]), "phi[0] = 'x1': x1 is a state and cannot"),
    "short phi": (lambda: mine(phi=[1]), "phi has 1 entry but there are 2 states (x1, x2)"),
    "phi of text": (lambda: mine(phi="t"), "phi must be a list of 2 entries, one for each row"),
    "wide D": (lambda: mine(D=[[1]]), "D has 1 column but there are 2 inputs (V, I)"),
    "tall H": (lambda: mine(H=[[1], [2]]), "H has 2 rows but there is 1 output (y)"),
    "matrix of an unknown": (lambda: mine(A=[[0, 1], ["theta", 1]]), "theta is an unknown"),
    "input of an input": (lambda: mine(inputs={"V": 1, "I": "V"}), "inputs.I = 'V': V is an input"),
    "unknown of a state": (lambda: mine(unknowns={"a": "t + x1"}), "x1 is a state"),
    "no E": (lambda: without("E"), "E is missing; there are 2 states (x1, x2)"),
    "no A": (lambda: without("A"), "A is missing"),
    "no B": (lambda: without("B"), "B is missing; there are 2 inputs (V, I), so it needs 2 rows"),
    "no F": (lambda: without("F"), "F is missing; there is 1 unknown (theta)"),
    "no C": (lambda: without("C"), "C is missing; there is 1 output (y), so it needs 1 row of 2"),
    "A is a number": (lambda: mine(A=0), "A must be a list of 2 rows, not '0'"),
    "A is text": (lambda: mine(A="R"), "A must be a list of 2 rows, not 'R'"),
    "A is an array of another size": (lambda: mine(A=np.eye(3)), "A is 3 × 3, and"),
    "an entry twice": (
        lambda: mine(A={"x1,x2": 1, "x1": {"x2": 2}}), "A has the entry x1,x2 twice"
    ),
    "an entry of a row": (
        lambda: mine(A={"x1": 3}), "A has 'x1': '3'; write entries as 'row,column': value ("
    ),
    "an entry of no state": (
        lambda: mine(A={"x1,q": 3}), "A: column 'q' is no state, and no number from 0 to 1; "
    ),
    "A has too few rows": (lambda: mine(A=[[0, 1]]), "A has 1 row but there are 2 states (x1, x2)"),
    "A has too many columns": (
        lambda: mine(A=[[0, 1, 2], [0, 1, 2]]),
        "A has 3 columns but there are 2 states (x1, x2)",
    ),
    "A is ragged": (
        lambda: mine(A=[[0, 1], [0]]),
        "the rows of A differ: A[0] has length 2, A[1] has length 1",
    ),
    "a row is a number": (lambda: mine(F=[0, 1]), "F[0] must be a list, one entry per unknown"),
    "B has too many columns": (
        lambda: mine(B=[[1, 0, 0], [0, 1, 0]]),
        "plant mine: B has 3 columns but there are 2 inputs (V, I)",
    ),
    "B without inputs": (lambda: without("inputs"), "B has 2 columns but there are 0 inputs"),
    "F without unknowns": (lambda: without("unknowns"), "F has 1 column but there are 0 unknowns"),
    "C without outputs": (lambda: without("outputs"), "C has 1 row but there are 0 outputs"),
    "unknown is empty": (
        lambda: mine(unknowns={"a": None}, F=[[0], [0]]), "unknowns.a is empty; write its true"
    ),
    "entry is empty": (lambda: mine(E=[[1, None], [0, 0]]), "E[0][1] is empty; write a number or"),
    "entry is infinite": (
        lambda: mine(E=[[1, float("inf")], [0, 0]]), "E[0][1] is inf; write a finite number"),
    "entry is a list": (lambda: mine(E=[[1, [0]], [0, 0]]), "E[0][1] is a list; write a number"),
    "entry is hostile": (lambda: mine(E=[[1, "__import__('os')"], [0, 0]]), "E[0][1] = "),
    "no initial state": (lambda: without("initial_state"), "initial_state is missing"),
    "initial state lacks": (lambda: mine(initial_state={"x1": 1}), "initial_state lacks x2"),
    "more than eight names": (
        lambda: mine(states=[f"x{k}" for k in range(9)]),
        "E has 2 rows but there are 9 states (x0, x1, x2, x3, x4, x5, x6, x7, ...)",
    ),
    "initial state unknown": (
        lambda: mine(initial_state={"x1": 1, "x3": 0}),
        "initial_state has 'x3', which is not a state; did you mean",
    ),
    "initial state too long": (
        lambda: mine(initial_state=[1, 2, 3]),
        "initial_state has 3 values but there are 2 states (x1, x2)",
    ),
    "initial state a number": (lambda: mine(initial_state=0), "must map states to numbers or list"),
    "initial state of time": (
        lambda: mine(initial_state={"x1": "1 + t", "x2": 0}),
        "initial_state.x1 = '1 + t' must not depend on t",
    ),
    "initial state too short": (lambda: mine(initial_state=[0]), "initial_state has 1 value but"),
    "label with a formula's end": (
        lambda: mine(labels={"x1": "$x$"}), "labels.x1: expected 1 to 80 characters"
    ),
    "label of nothing": (
        lambda: mine(labels={"q": "x"}), "labels has 'q', which is no state, input, output or unk"
    ),
    "matrices is a number": (lambda: mine(matrices=3), "matrices is the name of an .npz file, not"),
    "units of nothing": (lambda: mine(units={"x3": "V"}), "units has 'x3'"),
    "units is text": (lambda: mine(units="V"), "units must be a mapping"),
    "unit is a list": (lambda: mine(units={"x1": ["V"]}), "units.x1 must be one line of text"),
    "title is a list": (lambda: mine(title=["a"]), "title must be one line of text"),
    "title is a boolean": (lambda: mine(title=True), "title must be one line of text"),
    "defaults is a list": (lambda: mine(observer_defaults=[1]), "observer_defaults must be"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(case: str) -> None:
    make, says = REFUSED[case]
    mapping: Any = make()
    with refused(says, begins="plant"):
        plant_from_mapping(mapping)


def test_a_name_that_is_no_half_of_a_function_is_not_asked_to_be_quoted() -> None:
    with pytest.raises(ConfigError, match=r"and starts with no digit$"):
        plant_from_mapping(mine(states=["x-1", "x2"]))


def test_messages_name_the_file() -> None:
    with pytest.raises(ConfigError, match=r"^plant mine \(dir/mine.yaml\): A is missing"):
        plant_from_mapping(without("A"), "dir/mine.yaml")
    with pytest.raises(ConfigError, match=r"^plant \(dir/mine.yaml\): name is missing"):
        plant_from_mapping({}, "dir/mine.yaml")


def test_an_expanding_yaml_file_is_refused_with_a_short_message() -> None:
    bomb: list[Any] = ["x"] * 9
    for _ in range(12):
        bomb = [bomb] * 9
    for changes in ({"states": bomb}, {"A": bomb[:2]}, {"initial_state": bomb[:2]}):
        with pytest.raises(ConfigError) as caught:
            plant_from_mapping(mine(**changes))
        assert len(str(caught.value)) < 400


def test_a_chain_of_parameters_is_read_in_proportion_to_its_length() -> None:
    names = {"k": "1", "p0": "t"} | {f"p{i}": f"p{i - 1} + 1" for i in range(1, 4000)}
    system = plant_from_mapping(mine(parameters=names, A=[["p3999", 0], [0, 1]]))
    assert system.coefficients.taylor(np.array([2.0]), 0).A[0, 0, 0, 0] == 4001.0
    with pytest.raises(ConfigError, match="10001 parameters; at most 10000 are read"):
        plant_from_mapping(mine(parameters={f"p{i}": 1 for i in range(10_001)}))


def test_entries_beyond_all_numbers_are_an_error_and_no_endless_decomposition() -> None:
    system = plant_from_mapping(mine(E=[["exp(20*t)", 0], [0, 1]]))
    with pytest.raises(ConfigError, match=r"E\[0\]\[0\] is .*at t = 7\.5; numbers go up to 1e\+50"):
        simulate(system, TimeSettings(horizon=20.0), SolverSettings())


@pytest.mark.parametrize(("changes", "says"), [
    ({"E": [["-1e-60*(1 + t)", 0], [0, 1]]},
     "E[0][0] is -1e-60 at t = 0; numbers of E go down to 1e-50, quotients by smaller ones"),
    ({"A": [[1, 0], ["-1e60*step(t - 1)", 1]]}, "A[1][0] is -1e+60 at t = 1; numbers go up to"),
    ({"initial_state": [0, 1e60]}, "initial_state.x2 is 1e+60; numbers go up to 1e+50, product"),
    ({"inputs": {"V": 1, "I": "-1e60"}}, "inputs.I is -1e+60 at t = 0; numbers go up to"),
    ({"unknowns": {"theta": 1e60}}, "unknowns.theta is 1e+60 at t = 0; numbers go up to 1e+50"),
])
def test_numbers_that_would_overflow_are_named_with_their_time(changes: Plain, says: str) -> None:
    with refused(says):
        check_sizes(plant_from_mapping(mine(**changes)), np.array([0.0, 1.0]))


@pytest.mark.parametrize("value", [1e-300, 1e45, 1e200, "1e-300*sin(t)", "exp(300*t)"])
@pytest.mark.parametrize("key", ["E", "A"])
def test_numbers_of_any_size_are_a_result_or_one_reason(key: str, value: object) -> None:
    changed = mine(**{key: [[value, 0], [0, 1]]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with suppress(GpeboError):
            run(changed, observer="none", time={"horizon": 1, "samples": 3})


@pytest.mark.parametrize("name", ["E", "A"])
def test_some_entries_of_a_matrix_are_those_of_the_whole_and_the_others_stay(name):
    whole, t = shipped("circuit").coefficients.assembly, np.linspace(0.0, 2.0, 5)
    every = dict(zip(MATRIX_NAMES, whole.taylor(t, 1), strict=True))
    own = np.arange(every[name][0, 0].size) % 3 == 0
    part = whole.of(MATRIX_NAMES, {name: own}).taylor(t, 1)
    for key, found in zip(MATRIX_NAMES, part, strict=True):
        matrix = every[key]
        expected = matrix.reshape(*matrix.shape[:2], -1)[..., own] if key == name else matrix
        np.testing.assert_array_equal(found, np.broadcast_to(expected, found.shape))
