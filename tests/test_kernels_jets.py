"""The kernels for known functions of time against NumPy: values, and the mesh they ask for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_paths import COMPILED, by_both, needs_kernels

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import MATRIX_NAMES
from gpebo_cli.model.expressions.syntax import parse
from gpebo_cli.model.expressions.tape import record
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Mesh, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.simulation import known as at_known
from gpebo_cli.simulation import simulate

pytestmark = needs_kernels

ATOMS = ["t", "2", "0.5", "pi", "-1", "step(t - 0.3)", "step(0.6 - t)"]
UNARY = ["sin({})", "cos({})", "exp({})", "tanh({})", "sinh({})", "cosh({})", "-({})", "d({})",
         "abs({})", "sign({})", "log(3 + tanh({}))", "sqrt(2 + sin({}))", "tan(tanh({})/2)",
         "(2 + cos({}))**-3", "(2 + cos({}))**1.7", "({})**3", "asin(tanh({})/2)",
         "acos(tanh({})/2)", "atan({})", "asinh({})", "acosh(2 + cos({}))", "atanh(cos({})/2)",
         "erf({})"]  # fmt: skip
BINARY = ["min({}, {})", "max({}, {})", "({}) + ({})", "({}) - ({})", "({})*({})",
          "({})/(2 + sin({}))", "tanh({})*cos({})"]


@st.composite
def texts(draw, depth=3):
    """Text of an expression that is finite nearly everywhere."""
    kind = draw(st.integers(0, 2)) if depth else 0
    if kind == 0:
        return draw(st.sampled_from(ATOMS))
    if kind == 1:
        return draw(st.sampled_from(UNARY)).format(draw(texts(depth - 1)))
    left, right = draw(texts(depth - 1)), draw(texts(depth - 1))
    return draw(st.sampled_from(BINARY)).format(left, right)


def tape_of(*lines):
    """Their tape; text that is refused (d of a step) counts as a number."""
    expressions = []
    for line in lines:
        try:
            expressions.append(parse(line, {}, "here"))
        except ConfigError:
            expressions.append(parse("1", {}, "here"))
    return record(expressions)


def answer(compute):
    """What is returned, or the message with which it is refused."""
    try:
        return compute()
    except ConfigError as error:
        return str(error)


@given(
    st.lists(texts(), min_size=0, max_size=4), st.integers(0, 4),
    st.sampled_from([0, 1, 2, 37, 700]), st.sampled_from([None, 0.0, 0.01, -0.02]),
)  # fmt: skip
def test_taylor_coefficients(lines, order, count, off):
    tape = tape_of(*lines)
    t = np.linspace(-1.0, 1.0, count)
    inside = None if off is None else t + off
    one, other = by_both(lambda: answer(lambda: tape.taylor(t, order, inside)))
    if isinstance(one, str):
        assert one == other
        return
    assert one.shape == other.shape == (order + 1, count, len(lines))
    size = np.abs(other).max(initial=1.0)
    np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * size)


@pytest.mark.parametrize("order", [0, 3])
def test_each_function(order):
    """Where all others are finite, too: what is not finite is left to NumPy."""
    tape = tape_of(*(text.replace("{}", "t/2") for text in (*UNARY, *BINARY)))
    one, other = by_both(lambda: tape.taylor(np.linspace(0.1, 1.5, 8), order))
    np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("size", [1e-300, 1e-9, 1.0, 30.0, 1e3, 9e4, 1e6, 1e15])
def test_sine_and_cosine_to_the_last_place(size):
    """Also next to multiples of π/2, where a sloppy reduction of the angle leaves nothing."""
    rng = np.random.default_rng(0)
    t = rng.uniform(-size, size, 20_000)
    t[::2] = np.rint(t[::2] / (np.pi / 2)) * (np.pi / 2)
    t[::4] = np.nextafter(t[::4], np.inf)
    t[0] = 0.0
    sine = tape_of("sin(t)").taylor(t, 1)[..., 0]
    cosine = tape_of("cos(t)").taylor(t, 0)[0, :, 0]
    both = tape_of("cos(t)", "sin(t)").taylor(t, 1)
    exact = np.sin(t.astype(np.longdouble)), np.cos(t.astype(np.longdouble))
    units = 1.01 if np.finfo(np.longdouble).eps < np.finfo(float).eps else 2.01
    for value, truth in zip([sine[0], cosine], exact, strict=True):
        close = units * np.finfo(float).eps
        np.testing.assert_allclose(value, truth.astype(float), rtol=close, atol=0)
    np.testing.assert_array_equal(both[0], np.stack([cosine, sine[0]], axis=1))
    np.testing.assert_array_equal(both[1], np.stack([-sine[0], cosine], axis=1))
    np.testing.assert_array_equal(sine[1], cosine)


@pytest.mark.parametrize("text", [
    "1/t", "log(t)", "sqrt(t)", "1/(1 + exp(500*t))", "d(log(t))", "exp(exp(10*t))", "t**-2",
    "asin(t)", "acosh(1 + t)", "atanh(t)", "abs(t)/t", "t**0.5",
    "sinh(800*t)", "sign(log(t))", "1e308*t*10", "log(t - abs(t) - 1)",
])  # fmt: skip
@pytest.mark.parametrize("order", [0, 1, 3])
def test_what_is_refused_is_refused_with_the_same_words(text, order):
    tape = tape_of("sin(t)", text)
    t = np.linspace(-1.0, 1.0, 41) * 3.0
    one, other = by_both(lambda: answer(lambda: tape.taylor(t, order)))
    assert isinstance(one, str)
    assert one == other


def test_times_that_are_no_numbers_are_refused():
    tape = tape_of("sin(t)")
    one, other = by_both(lambda: answer(lambda: tape.taylor(np.array([0.0, np.nan]), 0)))
    assert one == other == "here = 'sin(t)' has no finite value at t = nan"


def plant(**entries):
    """Three states, with these entries."""
    data = {
        "name": "p", "states": ["a", "b", "c"], "inputs": {"u": "sin(t)"}, "unknowns": {"q": "2"},
        "outputs": ["y"], "E": [[1, 0, 0], [0, "2 + cos(t)", 0], [0, 0, 0]],
        "A": [["-t", 1, 0], [0, -1, 0], [0, "cos(t)", 1]], "B": [[1], [0], [0]],
        "F": [["sin(t)*cos(t)"], [0], [0]], "C": [[1, 0, 0]], "initial_state": [1, 0, 0],
    }  # fmt: skip
    return plant_from_mapping({**data, **entries})


@pytest.mark.parametrize("count", [0, 1, 67, 1000])
@pytest.mark.parametrize("order", [0, 1, 3])
def test_matrices_of_a_plant(count, order):
    system = plant(C=[[1, "step(t - 1)", 0]], inputs={"u": "abs(t - 0.5)"})
    t = np.linspace(0.0, 2.0, count)
    one, other = by_both(lambda: system.coefficients.taylor(t, order, t + 1e-3))
    for name in MATRIX_NAMES:
        a, b = getattr(one, name), getattr(other, name)
        assert a.shape == b.shape
        many = [axis for axis in range(a.ndim) if a.shape[axis] > 1]
        assert [a.strides[k] for k in many] == [b.strides[k] for k in many] or not a.size
        assert a.flags.writeable == b.flags.writeable
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)


def test_the_kernel_is_what_evaluates_a_plant():
    coefficients = plant().coefficients
    t = np.linspace(0.0, 1.0, 5)
    none = np.zeros((0, 5))
    assert COMPILED.jets(t, t, none, *coefficients.assembly._plan(2, apart=False)) is not None


def test_jets_refuses_programs_that_lead_out_of_the_arrays():
    t, none = np.zeros(3), np.zeros((0, 3))
    good = list(plant().coefficients.assembly._plan(1, apart=False))

    def changed(place, index, value):
        other = [array.copy() for array in good]
        other[place][index] = value
        return other

    assert COMPILED.jets(t, t, none, *good) is not None
    for place, index, value, what in [
        (0, (0, 0), 99, "operations: 99 will not do"),
        (0, (0, 1), 50, "left operands"),
        (0, (0, 1), -50, "left operands"),
        (2, (0, 0), 50, "rows of results"),
        (2, (0, 0), -50, "rows of results"),
        (3, (0, 0), 10, "matrices: 10 will not do"),
        (3, (0, 1), 9, "entries: "),
    ]:
        with pytest.raises(ValueError, match=what):
            COMPILED.jets(t, t, none, *changed(place, index, value))
    with pytest.raises(ValueError, match="expected 3"):
        COMPILED.jets(t, t[:2], none, *good)
    with pytest.raises(ValueError, match="expected 3"):
        COMPILED.jets(t, t, np.zeros((1, 2)), *good)
    with pytest.raises(ValueError, match="in a matrix"):
        COMPILED.jets(t, t, none, *good[:4], *(matrix[:1] for matrix in good[4:]))
    with pytest.raises(ValueError, match="in a matrix"):
        COMPILED.jets(t, t, none, *good[:4], *(np.repeat(matrix, 2, axis=1) for matrix in good[4:]))
    with pytest.raises(TypeError, match="arguments"):
        COMPILED.jets(t, t, none, *good[:4])
    with pytest.raises(TypeError, match="argument 7 must be an array"):
        COMPILED.jets(t, t, none, *good[:4], None)


def test_intervals_refuses_programs_that_lead_out_of_the_arrays():
    t = np.zeros(3)
    good = record([parse("t*sin(t)", {}, "f")]).program(1, apart=True)
    assert COMPILED.intervals(t, t, t, *good) is not None
    for place, index, value in [(0, (0, 0), 99), (0, (0, 1), 50), (2, 0, 50), (2, 0, -50)]:
        other = [array.copy() for array in good]
        other[place][index] = value
        with pytest.raises(ValueError, match="will not do"):
            COMPILED.intervals(t, t, t, *other)


# --- the mesh ---


SIGNALS = ["sin(t)", "exp(-t)", "3", "t", "2 + exp(-((t - 1.31)/{})**2)", "-1 + 2*step(t - 0.7)",
           "sin(30*t)", "0.005 + t", "1e-6*sin(30*t)"]  # fmt: skip


@st.composite
def known_functions(draw):
    """A plant, a mesh, and the plant's functions at its points."""
    width = draw(st.sampled_from([0.002, 0.01, 0.1]))
    pick = st.sampled_from(SIGNALS).map(lambda text: text.format(width))
    system = plant(
        E=[[draw(pick), 0, 0], [0, draw(pick), 0], [0, 0, 0]],
        A=[[draw(pick), draw(pick), 0], [0, -1, 0], [0, draw(pick), 1]], F=[[1], [0], [0]],
        inputs={"u": draw(pick)},
    )  # fmt: skip
    cuts = draw(st.sampled_from([[], [0.7], [0.4, 1.5]]))
    rule = radau_rule(draw(st.integers(3, 14)))
    mesh = initial_mesh(0.0, 2.0, cuts, draw(st.integers(1, 24)), rule)
    c = system.coefficients.taylor(mesh.points.ravel(), 2, mesh.inside.ravel())
    return system, mesh, c, np.array(cuts)


@given(known_functions(), st.sampled_from([1e-3, 1e-6, 1e-10]))
def test_what_is_overlooked(known, tol):
    system, mesh, c, _ = known
    one, other = by_both(lambda: at_known._overlooked(
        system, c, lambda t: system.coefficients.taylor(t, 0), mesh, tol, np.zeros(system.m)
    ))
    np.testing.assert_array_equal(one, other)


def test_a_pulse_between_the_nodes_is_seen():
    system, mesh = plant(), initial_mesh(0.0, 1.0, [], 3, radau_rule(5))
    c = system.coefficients.taylor(mesh.points.ravel(), 0)

    def overlooked(pulse):
        def looked_at(t):
            found = system.coefficients.taylor(t, 0)
            return found._replace(u=found.u + pulse * (np.arange(len(t)) == len(t) // 2)[:, None])

        return at_known._overlooked(system, c, looked_at, mesh, 1e-9, np.zeros(1)).tolist()

    assert overlooked(0.0) == [False, False, False]
    assert overlooked(0.1) == [False, True, False]


def test_growth_and_jumps_leave_the_mesh_as_it_was():
    """A plant that jumps, simulated by both paths: the same mesh, the same values."""
    from gpebo_cli.settings import SolverSettings, TimeSettings

    system = plant(inputs={"u": "step(t - 0.7) + exp(-((t - 1.31)/0.004)**2)"})
    settings = replace(SolverSettings(), tol=1e-7)
    one, other = by_both(lambda: simulate.simulate(system, TimeSettings(0.0, 2.0), settings))
    np.testing.assert_array_equal(one.signals.mesh.edges, other.signals.mesh.edges)
    np.testing.assert_allclose(one.signals.states.values, other.signals.states.values, atol=1e-10)


def test_a_mesh_without_breakpoints_has_the_edges_of_one_with_them():
    """The short way and the general one round alike."""
    for start, stop, elements in [(0.0, 1.0, 24), (0.1, 7.3, 24), (-2.0, 1e-3, 7), (3.0, 4.0, 1)]:
        mesh = initial_mesh(start, stop, [], elements, radau_rule(3))
        general = initial_mesh(start, stop, [start], elements, radau_rule(3))
        assert isinstance(mesh, Mesh)
        np.testing.assert_array_equal(mesh.edges, general.edges)


def test_a_tape_without_jumps_has_no_breakpoints():
    coefficients = SimpleNamespace(tape=tape_of("sin(t)", "t**2"))
    assert not coefficients.tape.jumps
    assert tape_of("abs(t)").jumps
    assert tape_of("step(t - 1)").jumps
