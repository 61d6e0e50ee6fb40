"""The expression language: values and derivatives against SymPy, refusals, jumps."""

from __future__ import annotations

import math
import sys
import time
import warnings
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import refused

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions import tape as tape_module
from gpebo_cli.model.expressions.bounds import breakpoints
from gpebo_cli.model.expressions.intervals import Interval
from gpebo_cli.model.expressions.nodes import divisors_of
from gpebo_cli.model.expressions.syntax import Expression, parse, shorten, signal
from gpebo_cli.model.expressions.tape import record, taylor

WHERE = "plant mine: A[0][1]"
# Seconds of this process's own work, whatever else the machine does: what this is there to find
# grows exponentially with the text and does not end.
LIMIT = 1.0
TIME = sympy.Symbol("t", real=True)
ORACLE: dict[str, Any] = {
    "t": TIME,
    "p": 1 + TIME / 2 + sympy.cos(TIME),
    "d": lambda e: sympy.diff(e, TIME),
    "abs": sympy.Abs,
}


def read(text: object, **names: object) -> Expression:
    """Parse text that may use parameters, each given as text of its own."""
    known: dict[str, Expression] = {}
    for name, value in names.items():
        known[name] = parse(value, known, f"plant mine: parameters.{name}")
    return parse(text, known, WHERE)


def derivatives(text: object, t: object, order: int, **names: object) -> Array:
    """Plain derivatives 0..order at the times t, shape (order + 1, N)."""
    times = np.atleast_1d(np.asarray(t, dtype=float))
    values = taylor([read(text, **names)], times, order)[:, :, 0]
    return values * np.array([math.factorial(k) for k in range(order + 1)])[:, None]


def oracle(text: str, t: float, order: int) -> list[float]:
    """The same by symbolic differentiation and 30 digits."""
    expression = sympy.sympify(text, locals=ORACLE)
    result = []
    with mpmath.workdps(30):
        for _ in range(order + 1):
            result.append(float(sympy.lambdify(TIME, expression, "mpmath")(mpmath.mpf(t))))
            expression = sympy.diff(expression, TIME)
    return result


# Texts that are defined for every t: arguments of log, sqrt and / are kept away from zero.
LEAVES = st.sampled_from(["t", "p", "pi", "2", "0.75", "-1.5", "3", "(t - 1)", "1e-1"])
UNARY = st.sampled_from(
    [
        "sin({})", "cos({})", "tanh({})", "exp(sin({}))", "log(2 + sin({}))", "sqrt(2 + cos({}))",
        "sinh(cos({}))", "cosh(sin({}))", "tan(0.5*sin({}))", "-({})", "+({})", "({})**2",
        "({})**3", "(2 + cos({}))**-1", "(2 + sin({}))**-3", "(2 + sin({}))**2.5", "2**sin({})",
        "(2 - sin({}))**-0.5", "d({})", "1/(3 + cos({}))", "asin(sin({})/2)", "acos(sin({})/2)",
        "atan({})", "asinh({})", "acosh(2 + sin({}))", "atanh(sin({})/2)", "erf({})",
    ]
)  # fmt: skip
BINARY = st.sampled_from(
    [
        "({} + {})", "({} - {})", "({} * {})", "(({})/(3 + sin({})))", "(2 + sin({}))**cos({})",
        "({} - 2*{})",
    ]
)  # fmt: skip
TEXTS = st.recursive(
    LEAVES,
    lambda inner: st.builds(str.format, UNARY, inner) | st.builds(str.format, BINARY, inner, inner),
    max_leaves=4,
)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(TEXTS, st.sampled_from([0.0, 0.3, 1.0, 1.7, 2.9]))
def test_random_expressions_agree_with_symbolic_differentiation(text: str, t: float) -> None:
    want = np.array(oracle(text, t, 4))
    got = derivatives(text, t, 4, p="1 + t/2 + cos(t)")[:, 0]
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(want).max()))


@pytest.mark.parametrize(
    "text",
    [
        "tan(t)", "exp(-t**2)", "log(1 + t)", "sqrt(1 + t)", "sinh(2*t)", "cosh(t/3)", "tanh(t)",
        "t**5", "(t - 0.7)**4", "(t - 0.6)**7", "t**-2", "(1 + t)**1.5", "t**t", "2**t",
        "(1 + t)**-1.25", "1/(1 + t**2)", "exp(t)/(2 + t)", "sin(t**2)*cos(3*t)", "-2**2 + t",
        "2**-t", "t**3**2/100", "d(t**3)", "d(d(sin(t)*exp(t)))", "d(t*d(t*d(sin(t))))",
        "d(3*t + 1)*t", "d(p)*p", "1e-3*t", "t - t + 3", "log(exp(t))", "(t/2)**0.5", "p**0",
        "tanh(sin(t))", "d(tan(t/4))", "1/d(d(t**2))",
        "asin(t)", "acos(t**2)", "atan(3*t)", "asinh(t - 2)", "acosh(1 + t)", "atanh(t)", "erf(t)",
        "(t/2 + 1)**1025/9e99", "(t + 0.3)**-1025",
    ],
)  # fmt: skip
def test_selected_expressions_to_order_six(text: str) -> None:
    want = np.array(oracle(text, 0.7, 6))
    got = derivatives(text, 0.7, 6, p="1 + t/2 + cos(t)")[:, 0]
    np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-12 * np.abs(want).max())


def test_coefficients_are_normalised_and_time_stands_before_the_expression() -> None:
    t = np.array([0.0, 1.0, 2.0])
    values = taylor([read("exp(t)"), read("7"), read("t")], t, 3)
    assert values.shape == (4, 3, 3)
    np.testing.assert_allclose(values[3, :, 0], np.exp(t) / 6, rtol=1e-14)
    np.testing.assert_array_equal(values[:, :, 1], [[7, 7, 7], [0] * 3, [0] * 3, [0] * 3])
    np.testing.assert_array_equal(values[:2, :, 2], [t, [1, 1, 1]])


def test_no_expressions_and_no_times() -> None:
    assert taylor([], np.arange(3.0), 2).shape == (3, 3, 0)
    assert taylor([read("sin(t)")], np.zeros(0), 1).shape == (2, 0, 1)


def test_whole_numbers_as_times() -> None:
    times: Any = np.array([1, 2])
    np.testing.assert_array_equal(taylor([read("1/t")], times, 0)[0, :, 0], [1.0, 0.5])


def test_long_arrays_are_evaluated_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    expressions = [read("sin(t)*d(cos(t)) + step(t - 1) + abs(t - 2)"), read("exp(-t)")]
    t = np.linspace(0, 4, 301)
    inside = t + 1e-3
    whole = taylor(expressions, t, 2, inside)
    monkeypatch.setattr(tape_module, "MAX_NUMBERS", 1)
    np.testing.assert_array_equal(taylor(expressions, t, 2, inside), whole)


@pytest.mark.parametrize(
    ("text", "side"),
    [("min(t, 0.5)*t", "0.5*t"), ("max(sin(t), t**2)", "sin(t)"), ("min(cos(t), exp(t))", "cos(t)"),
     ("max(t, max(1 + t**2, 0))", "1 + t**2"), ("sqrt((t - 1)**2)", "1 - t"),
     ("sqrt(1 - cos(t)**2)", "sin(t)")],
)  # fmt: skip
def test_derivatives_of_roots_min_and_max_are_those_of_their_side(text: str, side: str) -> None:
    want = derivatives(side, 0.7, 6)
    np.testing.assert_allclose(derivatives(text, 0.7, 6), want, rtol=1e-14, atol=1e-14)


def test_roots_of_other_powers_are_no_sizes() -> None:
    cube = 0.7**1.5, 1.5 * 0.7**0.5, 0.75 * 0.7**-0.5
    for text, exact in (("sqrt(t**4)", (0.49, 1.4, 2.0)), ("sqrt(t**3)", cube)):
        np.testing.assert_allclose(derivatives(text, 0.7, 2)[:, 0], exact, rtol=1e-13)


@pytest.mark.parametrize("order", [0, 2])
def test_min_and_max_take_the_side_that_is_asked_for(order: int) -> None:
    texts = ["min(t, 1)", "max(1, t)", "min(sin(t), cos(t))"]
    expressions = [read(text) for text in texts]
    middle = math.pi / 4
    cuts = breakpoints(record(expressions), 0.0, 2.0)
    np.testing.assert_allclose(cuts, [middle, 1.0], rtol=1e-14)
    t = np.array([1.0, 1.0, middle, middle])
    values = taylor(expressions, t, order, t + np.array([-1e-3, 1e-3] * 2))
    if order:
        np.testing.assert_array_equal(values[1, :2, :2], [[1, 0], [0, 1]])
        np.testing.assert_allclose(values[1, 2:, 2], [math.sqrt(0.5), -math.sqrt(0.5)])
    np.testing.assert_array_equal(values[0, :2, :2], 1.0)


@pytest.mark.parametrize("compiled", [True, False])
def test_roots_of_max_are_numbers_where_its_sides_meet(compiled: bool) -> None:
    """Rounding of the side that is asked for may be negative; what stays zero has derivatives."""
    texts = ["sqrt(max(sin(w*t), 0))", "max(sin(w*t), 0)**1.2", "sqrt(0.3 - min(0.3, cos(w*t)))"]
    tape = record([read(text.replace("w", w)) for text in texts for w in ("1.3", "3.7", "7.1")])
    t = np.repeat(breakpoints(tape, 0.0, 20.0), 2)
    evaluate = tape.taylor if compiled else tape.interpreted
    inside = t + np.tile([-1e-3, 1e-3], len(t) // 2)
    values = evaluate(t, 0, inside, None)[0]
    wave = np.array([1.3, 3.7, 7.1]) * t[:, None]
    exact = np.maximum(np.sin(wave), 0.0)
    other = np.maximum(0.3 - np.cos(wave), 0.0)
    exact = np.hstack([np.sqrt(exact), exact**1.2, np.sqrt(other)])
    np.testing.assert_allclose(values, exact, atol=1e-6)
    flat = evaluate(np.full(3, 4.6), 4, None, None)[:, :, [0, 3]]  # sin(1.3 t) < 0
    np.testing.assert_array_equal(flat, 0.0)


def test_min_and_max_are_one_of_the_two_to_the_last_bit() -> None:
    t = np.linspace(-3, 3, 1001)
    low, high, a, b = taylor(
        [read("min(1e9*t, sin(7*t))"), read("max(1e9*t, sin(7*t))"), read("1e9*t"),
         read("sin(7*t)")], t, 0,
    )[0].T  # fmt: skip
    np.testing.assert_array_equal(low, np.minimum(a, b))
    np.testing.assert_array_equal(high, np.maximum(a, b))


# Constants


@pytest.mark.parametrize(
    ("value", "want"),
    [
        (3, 3.0), (-0.5, -0.5), ("3", 3.0), ("1e-3", 1e-3), ("-2**2", -4.0), ("2**3**2", 512.0),
        ("pi/2", math.pi / 2), ("sin(pi/6)", 0.5), ("2*(1 + 3)/4 - 1", 1.0), (" 1\n + 2 ", 3.0),
        ("d(7)", 0.0), ("d(2*t + 1)", 2.0), ("d(d(t))", 0.0), ("t - t + 3", 3.0), ("0*t", 0.0),
        ("min(2, 3)", 2.0), ("max(2, 3)", 3.0), ("max(t, t + 2) - t", 2.0),
        *((f"{name}(t + {a}, t) - t", want) for a in (0.5, -0.5) for name, want in
          (("min", min(a, 0.0)), ("max", max(a, 0.0)))),
        ("atan(1)", math.pi / 4),
        ("abs(-2)", 2.0), ("sign(-3)", -1.0), ("sign(0)", 0.0), ("log(exp(2))", 2.0),
        ("t**0", 1.0), ("0**0", 1.0), ("a*2", 6.0), ("sqrt(16)", 4.0), (Fraction(1, 4), 0.25),
        (np.int64(4), 4.0), (np.float32(0.5), 0.5), ("-(-(3))", 3.0), ("0x10", 16.0),
    ],
)  # fmt: skip
def test_constants_are_folded(value: object, want: float) -> None:
    expression = read(value, a=3)
    assert expression.is_constant
    assert expression.value == pytest.approx(want, rel=1e-15, abs=1e-15)


@pytest.mark.parametrize("text", ["t", "0*log(t)", "sin(t)", "step(t - 1)", "d(t**2)"])
def test_what_depends_on_time_is_not_constant(text: str) -> None:
    expression = read(text)
    assert not expression.is_constant
    with pytest.raises(ConfigError, match="must not depend on t"):
        _ = expression.value


def test_equal_work_is_recorded_once() -> None:
    names = {"C": "3 + cos(t/3)"}
    tape = record([read("C", **names), read("d(C)", **names), read("2*(3 + cos(t/3))")])
    operations = [i.operation for i in tape.instructions]
    assert operations.count("cos") == 1
    assert operations.count("add") == 1


@pytest.mark.parametrize("text", ["sin(t**2) + d(cos(t**2))", "cosh(p) - d(d(sinh(p)))*cosh(p)"])
def test_sine_and_cosine_of_one_argument_at_different_orders(text: str) -> None:
    got = derivatives(text, 0.7, 2, p="1 + t/2 + cos(t)")[:, 0]
    np.testing.assert_allclose(got, oracle(text, 0.7, 2), rtol=1e-12)


def test_doubling_names_costs_one_operation_each() -> None:
    names = {"p0": "sin(t)"} | {f"p{k}": f"p{k - 1}*p{k - 1}" for k in range(1, 60)}
    started = time.process_time()
    values = derivatives("d(p59)", np.linspace(0, 1, 50), 1, **names)
    assert np.isfinite(values).all()
    assert not divisors_of(read("p59", **names).node)
    assert time.process_time() - started < LIMIT


def test_a_tape_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tape_module, "MAX_INSTRUCTIONS", 3)
    with pytest.raises(ConfigError, match="more than 3 operations"):
        record([read("sin(t) + cos(t) + exp(t)")])


def test_long_sums_and_products() -> None:
    assert derivatives(" + ".join(["t"] * 1000), 2.0, 1)[:, 0].tolist() == [2000.0, 1000.0]
    assert derivatives(" - ".join(["t"] * 1000), 1.0, 0)[0, 0] == -998.0
    assert derivatives("*".join(["1.0"] * 900 + ["t"]), 2.0, 0)[0, 0] == 2.0
    assert derivatives("(" * 150 + "t" + ")" * 150, 2.0, 0)[0, 0] == 2.0
    assert np.isfinite(derivatives("sin(" * 150 + "t" + ")" * 150, 2.0, 0)).all()


# Refusals


@pytest.mark.parametrize("text", ["1if t else 2", "1.or 2", "2.e5in t", "t - 0x1and 2"])
def test_python_does_not_warn_of_text_that_is_refused(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Filters are those of all threads: one that puts them back undoes what another one has set.
        monkeypatch.delattr(warnings, "catch_warnings")
        with pytest.raises(ConfigError, match="has no meaning here"):
            read(text)


HOSTILE = {
    "import": "__import__('os').system('true')",
    "attribute": "t.__class__",
    "attribute of a call": "sin(t).real",
    "method": "(1).bit_length()",
    "lambda": "(lambda: 1)()",
    "lambda word": "lambda t",
    "unknown function": "eval(t)",
    "call of a call": "sin(t)(t)",
    "call of a number": "3(t)",
    "subscript": "t[0]",
    "list": "[t]",
    "set": "{t}",
    "tuple": "(t, t)",
    "comprehension": "[t for t in (1, 2)]",
    "generator": "sin(t for t in t)",
    "string": "'t'",
    "f-string": "f'{t}'",
    "bytes": "b'1'",
    "walrus": "(t := 1)",
    "keyword argument": "sin(x=t)",
    "star argument": "sin(*t)",
    "double star argument": "sin(**t)",
    "no argument": "sin()",
    "two arguments": "sin(t, t)",
    "function as a value": "sin + 1",
    "d as a value": "d*2",
    "parentheses": "(" * 10_000 + ")" * 10_000,
    "parentheses below the limit": "(" * 4_999 + "1" + ")" * 4_999,
    "calls": "sin(" * 1_900 + "t" + ")" * 1_900,
    "calls that parse": "sin(" * 199 + "-sin(t)" + ")" * 199,
    "minuses": "-" * 9_999 + "1",
    "minuses that parse": "-" * 500 + "t",
    "tildes": "~" * 9_999 + "1",
    "nots": "not " * 2_000 + "1",
    "power tower": "9**9**9**9",
    "long power tower": "**".join(["9"] * 3_000),
    "power tower that parses": "**".join(["1.0"] * 400),
    "large power": "10.0**10**10",
    "large integer power": "10**400",
    # Python 3.13 and later take it.
    **({"long sum": "+".join(["t"] * 5_000)} if sys.version_info < (3, 13) else {}),
    "large integer": "9" * 5_000,
    "large integer below the limit": "9" * 4_000,
    "large float": "1e400",
    "large product": "1e300*1e300",
    "large exponential": "exp(1000)",
    "large sinh": "sinh(1e4)",
    "large difference": "-1e308 - 1e308",
    "large quotient": "1e300/1e-300",
    "division": "1/0",
    "division of t": "t/0",
    "division by what is zero": "1/(t - t)",
    "zero to a negative power": "0**-1",
    "complex power": "(-1)**0.5",
    "complex general power": "(-2)**t",
    "complex number": "1j",
    "complex sum": "t + 2J",
    "log": "log(-1)",
    "log of zero": "log(0)",
    "sqrt": "sqrt(-1)",
    "boolean": "True",
    "none": "None",
    "ellipsis": "...",
    "comparison": "t > 1",
    "comparison chain": "1 < t < 2",
    "boolean operator": "t and 1",
    "conditional": "1 if t else 2",
    "conditional without blanks": "1if t else 2",
    "not": "not t",
    "bit inversion": "~t",
    "bit or": "t | 1",
    "caret": "t^2",
    "floor division": "t // 2",
    "remainder": "t % 2",
    "shift": "1 << 999999999",
    "matrix product": "t @ t",
    "interpolation": "${oc.env:HOME}",
    "interpolation of a key": "${plant.name}",
    "template": "{{t}}",
    "assignment": "t = 1",
    "statement": "import os",
    "two statements": "t; t",
    "await": "await t",
    "yield": "(yield t)",
    "comment": "t # comment",
    "continuation": "t \\",
    "null byte": "t\0",
    "null byte in front": "\0" * 100,
    "non-ASCII name": "\u03b8 + 1",
    "non-ASCII digit": "\u0663",
    "look-alike": "\uff54",
    "minus sign of typography": "1 \u2212 t",
    "right-to-left": "\u202et",
    "emoji": "\U0001f600",
    "surrogate": "\ud800",
    "unknown name": "C1 + 1",
    "dunder name": "__builtins__",
    "nan": "nan",
    "inf": "inf",
    "empty": "",
    "blank": " \n\t ",
    "unclosed": "(t",
    "unopened": "t)",
    "two names": "t t",
    "leading zeros": "007",
    "too long": "t" + " + t" * 10_000,
    "long name": "x" * 9_999,
    "long unknown function": "x" * 9_000 + "(t)",
    "step of a constant": "step(3)",
    "step of t - t": "step(t - t + 1)",
    "d of step": "d(step(t - 1))",
    "d of something with a step": "d(t*step(t - 1) + 1)",
    "d of sign": "d(sign(t - 1))",
    "d of d of abs": "d(d(abs(t - 1)))",
    "d of d of min": "d(d(min(t, 1)))",
    "d of the sine of a sign": "d(sin(sign(t)))",
    "d of abs of a step": "d(abs(step(t - 1) - 0.5))",
    "d nested": "d(" * 17 + "sin(t)" + ")" * 17,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_text_is_refused_quickly_in_one_line(name: str) -> None:
    text = HOSTILE[name]
    started = time.process_time()
    with pytest.raises(ConfigError) as caught:
        parse(text, {}, WHERE)
    assert time.process_time() - started < LIMIT
    message = str(caught.value)
    assert message.startswith(WHERE)
    assert len(message.splitlines()) == 1
    assert len(message) < 500
    assert message.isprintable()


@pytest.mark.parametrize(
    "value",
    [
        True, False, None, float("nan"), float("inf"), -float("inf"), 1j, 10**400, 10**5000, [1],
        {"t": 1}, b"t", object(), np.float64("nan"), np.bool_(True), ("t",),
    ],
    ids=lambda value: shorten(type(value).__name__),
)  # fmt: skip
def test_values_that_are_no_expressions_are_refused(value: object) -> None:
    with refused(begins=WHERE):
        parse(value, {}, WHERE)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("Cl + 1", "did you mean C1?"),
        ("sine(t)", "did you mean sin?"),
        ("t^2", "write ** for powers"),
        ("t & 2", "the character '&' has no meaning here; accepted: numbers, names, +"),
        ("1/0", "divides by zero"),
        ("sin", "needs an argument"),
        ("sin(t, t)", "takes one argument, not 2"),
        ("V + 1", "V is an input and cannot be used here"),
        ("9**9**9", "a number in it is too large"),
        ("(-1)**0.5", "fractional power of a negative number"),
        ("d(step(t))", "impulse"),
        ("step(2)", "does not depend on t"),
        (" ", "it is empty; write a number"),
        ("t.x", "attribute"),
        ("t > 1", "'>'"),
        ("C1 +", "not an expression"),
        ("t" + " " * 99_998 + "+", "not an expression"),
        ("(" * 300 + "t" + ")" * 300, "it is nested too deeply"),
        ("-" * 3000 + "t", "it is nested "),  # too deeply for Python, or more than 200 deep
        ("3*(2t)", "write * between a number and a name, as in 2*t"),
        ("-" * 201 + "t", "it is nested more than 200 deep"),
        ("t" + " " * 10**6 + "t", "it has 1000002 characters, more than"),
        ("d(" * 99 + "sin(t)" + ")" * 99, "d(.) inside each other"),
        ("d(d(abs(sin(t))))", "d(.) of something that jumps"),
        ("log(-1)", "a function in it is undefined at its argument"),
        ("1e400", "a number in it is not finite"),
        ("t // 2", "the operator FloorDiv has no meaning here"),
        ("step(3)", "the argument of step does not depend on t"),
        ("max(t)", "max takes two arguments, not 1"),
        ("sin(t, **t)", "takes one argument, not keywords"),
        ("True", "not a real number"),
    ],
)
def test_messages_say_what_would_be_accepted(text: str, says: str) -> None:
    with refused(says):
        parse(text, {"C1": read("t")}, WHERE, {"V": "an input"})


def test_a_boolean_is_explained() -> None:
    with pytest.raises(ConfigError, match="YAML reads on, off"):
        parse(True, {}, WHERE)


# Values that are not finite


@pytest.mark.parametrize(
    ("text", "at"),
    [
        ("log(t - 2)", "0"),
        ("1/(t - 2)", "2"),
        ("(t - 2)**-1", "2"),
        ("sqrt(1 - t)", "2"),
        ("(1 - t)**1.5", "2"),
        ("t**(t - 1)", "0"),
        ("exp(500*t)", "2"),
        ("1/(1 + exp(500*t))", "2"),  # would be 0 again, but its derivative would not
        ("exp(-1/t**2)", "0"),
        ("1e200*t*1e200", "1"),
        ("1/d(d(t**2 - t**2))", "0"),
        ("sign(1/(t - 1))", "1"),
        ("abs(log(t - 0.5))", "0"),
    ],
)
def test_a_value_that_is_not_finite_names_entry_text_and_time(text: str, at: str) -> None:
    t = np.array([0.0, 1.0, 2.0])
    with pytest.raises(ConfigError) as caught:
        taylor([read("t"), read(text)], t, 0)
    assert str(caught.value) == f"{WHERE} = '{text}' has no finite value at t = {at}"


def test_a_derivative_that_is_not_finite_says_so() -> None:
    np.testing.assert_array_equal(derivatives("sqrt(t)", [0.0, 4.0], 0), [[0, 2]])
    with pytest.raises(ConfigError, match=r"'sqrt\(t\)' has no finite derivative at t = 0"):
        derivatives("sqrt(t)", [0.0, 4.0], 1)


def test_the_innermost_name_is_blamed() -> None:
    with pytest.raises(ConfigError) as caught:
        derivatives("2*b + t", [0.0, 3.0], 0, c="1 + t", a="1/(t - 3)", b="c + sin(a)")
    says = "parameters.a = '1/(t - 3)' has no finite value at t = 3"
    assert str(caught.value) == f"plant mine: {says}"


def test_a_value_that_is_not_finite_inside_an_interval() -> None:
    with pytest.raises(ConfigError, match="no finite value at t = 2"):
        taylor([read("sign(1/(t - 2))")], np.array([1.0]), 0, inside=np.array([2.0]))


@pytest.mark.parametrize(("function", "low", "high", "least", "most"), [
    (np.sin, 0.0, np.pi, 0.0, 1.0), (np.sin, 3.0, 6.0, -1.0, np.sin(3.0)),
    (np.sin, -np.inf, 0.0, -1.0, 1.0), (np.sin, 2.0, 3.0, np.sin(3.0), np.sin(2.0)),
    (np.cos, -1.0, 2.0, np.cos(2.0), 1.0), (np.tan, 1.0, 2.0, -np.inf, np.inf),
    (np.tan, -1.0, 1.0, np.tan(-1.0), np.tan(1.0)),
    (lambda x: x**2, -1.0, 2.0, 0.0, 4.0), (lambda x: x**3, -2.0, 1.0, -8.0, 1.0),
    (lambda x: x**1, -2.0, 1.0, -2.0, 1.0),
    (lambda x: x**1026, -1.0, 0.5, 0.0, 1.0), (lambda x: x**1027, -1.0, 0.5, -1.0, 0.0),
    (lambda x: x**1.5, 1.0, 4.0, 1.0, 8.0), (lambda x: x**1.5, -2.0, -1.0, -np.inf, np.inf),
    (lambda x: x**1.5, -1.0, 4.0, 0.0, 8.0),
    (lambda x: x**-2.5, 1.0, 4.0, 1 / 32, 1.0), (lambda x: x**-2.5, -1.0, 4.0, -np.inf, np.inf),
])
def test_bounds_of_waves_and_powers_hold_their_crests_and_poles(function, low, high, least, most):
    found = function(Interval(np.array([low]), np.array([high])))
    np.testing.assert_allclose([found.low[0], found.high[0]], [least, most], atol=1e-14)


@pytest.mark.parametrize("end", [-3.0, 3.0])
def test_every_bound_is_wider_than_its_rounding(end):
    found = Interval(np.array([end]), np.array([end])) + 0.0
    assert found.low < end < found.high


def test_an_operation_without_a_value_along_a_signal_is_refused():
    """Though what comes of it is a number again."""
    tape = record([parse("1/(1 + 1/y)", {"y": signal("y", 0, "output")}, "here")])
    with pytest.raises(ConfigError, match=r"here = '1/\(1 \+ 1/y\)' has no finite value at t = 2"):
        tape.taylor(np.array([1.0, 2.0]), 0, None, np.array([[[1.0], [0.0]]]))


# Jumps and kinks


@pytest.mark.parametrize(("text", "t", "want"), [  # of which the rows are orders
    ("step(t - 1.5)", [1, 1.5, 2], [[0, 1, 1], [0, 0, 0]]),
    ("step(1.5 - t)", [1, 1.5, 2], [[1, 0, 0]]),
    ("step(2*t - 3)", [1, 1.5, 2], [[0, 1, 1]]),
    ("step((t - a)/2)", [1, 1.5, 2], [[0, 1, 1]]),
    ("t*step(t - 1.5)", [1, 1.5, 2], [[0, 1.5, 2], [0, 1, 1]]),
    ("abs(t - 1)", [0, 1, 3], [[1, 0, 2], [-1, 0, 1]]),
    ("sign(t - 1)", [0, 1, 3], [[-1, 0, 1], [0, 0, 0]]),
    ("d(abs(t - 1))", [0, 1, 3], [[-1, 0, 1]]),
    ("d(max(1, t))", [0, 3], [[0, 1]]), ("d(min(1, t))", [0, 3], [[1, 0]]),
    ("abs(t**2 - 4)", [0], [[4], [0], [-2]]),
    ("t**3", [0], [[0], [0], [0], [6], [0]]),
    ("(t - 1)**2", [1], [[0], [0], [2]]),
    ("t**1", [0], [[0], [1], [0]]),
    ("b**0 + t", [0], [[1], [1]]),  # a name that is folded away is never evaluated
    ("exp(-1000*t**2)", [0, 3], [[1, 0], [0, 0]]),  # underflow is zero
    ("asin(tanh(40*sign(t - 2)))", [0, 3], [[-np.pi / 2, np.pi / 2], [0, 0]]),  # no 0/0
])
def test_values_and_derivatives_are_exact(text: str, t: list[float], want: list[Any]) -> None:
    found = derivatives(text, [float(time) for time in t], len(want) - 1, a="3/2", b="1/t")
    np.testing.assert_array_equal(found, want)


@pytest.mark.parametrize(("outer", "inner", "turn"), [
    ("asin", "sin", 0.5), ("acos", "sin", 0.5), ("asin", "cos", 0.0), ("acos", "cos", 0.0),
    ("atan", "tan", 0.5),
])
def test_inverse_functions_of_waves_are_triangles_and_saws(
    outer: str, inner: str, turn: float
) -> None:
    """asin(a) has no derivative where a = ±1, which waves reach at every turn."""
    text, t = f"{outer}({inner}(3*t - 0.4))", np.linspace(0.0, 7.0, 401)
    turns = breakpoints(record([read(text)]), 0.0, 7.0)
    at = np.pi * (np.arange(-1, 8) + turn)
    wanted = (at + 0.4)[(at > -0.4) & (at < 20.6)] / 3.0
    np.testing.assert_allclose(turns, wanted, rtol=1e-12)
    value, slope = derivatives(text, t, 1)
    wave = getattr(np, inner)(3.0 * t - 0.4)
    np.testing.assert_allclose(value, getattr(np, "arc" + outer[1:])(wave), atol=3e-8)
    side = 1 if outer == "atan" else (-1.0) ** np.searchsorted(turns, t)
    np.testing.assert_allclose(slope, slope[0] * side, rtol=1e-14)
    assert abs(slope[0]) == pytest.approx(3.0)


@pytest.mark.parametrize(("text", "same"), [
    ("sqrt(1 - cos(3*t)**2)", "abs(sin(3*t))"), ("sqrt(-sin(t)**2 + 1)", "abs(cos(t))"),
    ("sqrt(sin(t)**2)", "abs(sin(t))"), ("acos(0.5*cos(t)*2)", "acos(cos(t))"),
])
def test_roots_whose_slope_would_be_nothing_over_nothing_are_known(text: str, same: str) -> None:
    t = np.linspace(0.0, 7.0, 401)
    for one, other in zip(derivatives(text, t, 1), derivatives(same, t, 1), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(*(breakpoints(record([read(x)]), 0.0, 7.0) for x in (text, same)))


def test_a_root_of_one_less_another_square_is_none_of_these() -> None:
    value, slope = derivatives("sqrt(1 - exp(-t)**2)", np.array([1.0]), 1)
    root = np.sqrt(1 - np.exp(-2.0))
    assert (value[0], slope[0]) == pytest.approx((root, np.exp(-2.0) / root), rel=1e-14)


@pytest.mark.parametrize(
    ("text", "before", "after"),
    [
        ("step(t - 1)", [0, 0], [1, 0]),
        ("step(1 - t)", [1, 0], [0, 0]),
        ("sign(t - 1)", [-1, 0], [1, 0]),
        ("sign(1 - t**2)", [1, 0], [-1, 0]),
        ("abs(t - 1)", [0, -1], [0, 1]),
        ("d(abs(t - 1))", [-1, 0], [1, 0]),
        ("abs(step(t - 1) - 3)", [3, 0], [2, 0]),
        ("abs(abs(t - 1) - 1)", [1, 1], [1, -1]),
        ("sign(step(t - 1) - 0.5)*t", [-1, -1], [1, 1]),
    ],
)
def test_limits_at_a_breakpoint_come_from_inside(
    text: str, before: list[float], after: list[float]
) -> None:
    t = np.array([1.0, 1.0])
    values = taylor([read(text)], t, 1, inside=np.array([0.9, 1.1]))[:, :, 0]
    np.testing.assert_array_equal(values, np.array([before, after]).T)


def test_inside_decides_only_what_jumps() -> None:
    t = np.linspace(0, 1, 5)
    smooth = [read("sin(t)*exp(t)")]
    np.testing.assert_array_equal(taylor(smooth, t, 2, inside=t + 9), taylor(smooth, t, 2))


INSIDE = "step(t) + step(t - 1) + step(t - 2) + step(t + 1) + abs(t - 5)"


@pytest.mark.parametrize(("texts", "span", "want", "rtol"), [
    (["step(t - 0.1)", "step(7 - t)*sin(t)", "abs(3*t - 1)", "sign(2 - t)", "step(t - 7)"],
     (0, 10), [0.1, 1 / 3, 2.0, 7.0], 0.0),
    # They lie strictly inside.
    ([INSIDE], (0, 2), [1.0], 0.0), ([INSIDE], (1, 1), [], 0.0),
    (["abs(sin(pi*t))"], (0, 1), [], 0.0), (["abs(sin(t))"], (1, 1), [], 0.0),
    (["sin(t)", "2"], (0, 10), [], 0.0),
    ([], (0, 10), [], 0.0),
    # They are found, on the grid of the search, too.
    (["abs(sin(t)) + sign(2*sin(t))*exp(t)"], (0.5, 10), np.pi * np.arange(1, 4), 1e-15),
    (["abs(t**3 - 2)"], (0, 3), [2 ** (1 / 3)], 1e-15),
    (["sign((t - 5)*(t + 1))"], (0, 10), [5.0], 0.0),
    (["abs((t - 5)**2)"], (0, 10), [], 0.0), (["abs(t**2*0)"], (0, 10), [], 0.0),
    # At 4 the argument of abs jumps over zero: one breakpoint, exactly there, not two.
    (["abs(step(t - 4) - 0.5 + 0*t**2)"], (0, 10), [4.0], 0.0),
    (["abs(abs(t - 4) - 1)"], (0, 10), [3.0, 4.0, 5.0], 1e-15),
    (["abs(sin(t) + 5*step(t - 4))"], (0, 10), [np.pi, 4.0], 1e-15),
    # Both are within one cell of the grid.
    (["abs(t**2 - 3.9991**2 + 100*step(t - 3.9995))"], (0, 10), [3.9991, 3.9995], 1e-14),
])
def test_breakpoints(
    texts: list[str], span: tuple[float, float], want: list[float], rtol: float
) -> None:
    found = breakpoints(record([read(text) for text in texts]), *map(float, span))
    np.testing.assert_allclose(found, want, rtol=rtol, atol=0.0)


def test_breakpoints_of_an_argument_without_a_value() -> None:
    with pytest.raises(ConfigError, match="no finite value at t = 0"):
        breakpoints(record([read("abs(log(t - 1))")]), 0.0, 10.0)


def test_an_inverse_step_is_the_complement() -> None:
    t = np.linspace(0, 3, 31)
    up, down = (taylor([read(text)], t, 0)[0, :, 0] for text in ("step(t - 1)", "step(1 - t)"))
    np.testing.assert_array_equal(up + down, np.ones(31))


@pytest.mark.parametrize("function", [
    taylor, lambda expressions, *span: breakpoints(record(expressions), *span),
], ids=["taylor", "breakpoints"])
def test_nothing_warns(function: Callable[..., Array]) -> None:
    expressions = [read("abs(sin(t))**3/(1 + exp(-t)) + step(t - 1)")]
    with np.errstate(all="warn"):
        arguments = (np.linspace(0.1, 3, 9), 2) if function is taylor else (0.0, 3.0)
        assert np.isfinite(function(expressions, *arguments)).all()


def test_a_part_of_a_tape_keeps_what_switches_in_it():
    texts = ("max(sin(t), cos(t))", "abs(sin(t) - 0.5)", "sign(cos(t)) + min(t, 1)", "exp(t)")
    nodes = [parse(text, {}, "x") for text in texts]
    whole = record(nodes)
    for place, node in zip(whole.outputs, nodes, strict=True):
        part, alone = whole.of([place]), record([node])
        np.testing.assert_array_equal(*(breakpoints(tape, 0.0, 7.0) for tape in (part, alone)))
        assert len(part.switches) == len(alone.switches)
        assert sorted(i.operation for i in part.instructions) == sorted(
            i.operation for i in alone.instructions
        )
