"""Functions of time as small immutable trees, built by constructors that fold what they can.

A node may be used in many places: together the nodes of a plant form a graph that grows only with
the length of its text. Nothing is ever differentiated symbolically (repeated derivatives of a
product grow exponentially); ``d`` is one more node, resolved by Taylor arithmetic.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass

MAX_DERIVATIVES = 16  # nested d(.); each raises the Taylor order of everything inside it by one


class FoldError(ValueError):
    """An expression that has no value for any t, or that the language excludes; one clause."""


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """One operation. Compared by identity; equal work is found when a tape is recorded.

    ``value`` is the number itself, the exponent of ``power``, the instant of ``step`` or the
    place of ``signal`` among the signals.
    ``affine`` is (c, s) where the node is c + s t. ``derivatives`` is how deep d(.) is nested
    inside. ``smooth`` is how often the node may be differentiated before it jumps: 0 for
    something that jumps itself, 1 for something with a kink. ``signals`` are the names of the
    inputs and outputs inside.
    """

    operation: str
    arguments: tuple[Node, ...] = ()
    value: float = 0.0
    affine: tuple[float, float] | None = None
    derivatives: int = 0
    smooth: float = math.inf
    signals: frozenset[str] = frozenset()

    @property
    def is_number(self) -> bool:
        """Whether the node is one number for all t."""
        return self.operation == "number"


TIME = Node("t", affine=(0.0, 1.0))


def signal(name: str, place: int) -> Node:
    """An input or output by its place among the signals, inputs first."""
    return Node("signal", value=float(place), signals=frozenset([name]))


def number(value: float) -> Node:
    """A finite constant. Raises FoldError for nan and infinity."""
    if not math.isfinite(value):
        raise FoldError("a number in it is not finite")
    value += 0.0  # -0.0 becomes 0.0, so that equal constants are one constant
    return Node("number", value=value, affine=(value, 0.0))


ONE = number(1.0)


def _node(
    operation: str,
    *arguments: Node,
    value: float = 0.0,
    affine: tuple[float, float] | None = None,
    smooth: float = math.inf,
) -> Node:
    if affine is not None:
        if not (math.isfinite(affine[0]) and math.isfinite(affine[1])):
            affine = None
        elif affine[1] == 0.0:  # t - t + 3: affine expressions are defined for every t
            return number(affine[0])
    return Node(
        operation,
        arguments,
        value,
        affine,
        max((argument.derivatives for argument in arguments), default=0),
        min((smooth, *(argument.smooth for argument in arguments))),
        frozenset().union(*(argument.signals for argument in arguments)),
    )


def _fold(function: Callable[..., float], *values: float) -> Node:
    try:
        result = function(*values)
    except ZeroDivisionError:
        raise FoldError("it divides by zero") from None
    except OverflowError:
        raise FoldError("a number in it is too large") from None
    except ValueError:
        raise FoldError("a function in it is undefined at its argument") from None
    if isinstance(result, complex):
        raise FoldError("it takes a fractional power of a negative number")
    if not math.isfinite(result):
        raise FoldError("a number in it is too large")
    return number(result)


def _is(a: Node, value: float) -> bool:
    return a.is_number and a.value == value


def add(a: Node, b: Node) -> Node:
    """a + b."""
    if a.is_number and b.is_number:
        return _fold(operator.add, a.value, b.value)
    if _is(a, 0.0):
        return b
    if _is(b, 0.0):
        return a
    affine = a.affine and b.affine and (a.affine[0] + b.affine[0], a.affine[1] + b.affine[1])
    return _node("add", a, b, affine=affine)


def negative(a: Node) -> Node:
    """-a."""
    if a.is_number:
        return number(-a.value)
    if a.operation == "negative":
        return a.arguments[0]
    return _node("negative", a, affine=(-a.affine[0], -a.affine[1]) if a.affine else None)


def subtract(a: Node, b: Node) -> Node:
    """a - b."""
    return add(a, negative(b))


def multiply(a: Node, b: Node) -> Node:
    """a b. A factor 0 is not folded: 0 log(t) must keep failing where log(t) does."""
    if a.is_number and b.is_number:
        return _fold(operator.mul, a.value, b.value)
    if _is(a, 1.0):
        return b
    if _is(b, 1.0):
        return a
    factor, other = (a, b) if a.is_number else (b, a)
    if factor.is_number and other.operation == "multiply":
        for one, rest in (other.arguments, other.arguments[::-1]):
            if one.is_number and one.value * factor.value == 1.0:
                return rest
    affine = None
    if factor.is_number and other.affine:
        affine = (factor.value * other.affine[0], factor.value * other.affine[1])
    return _node("multiply", a, b, affine=affine)


def divide(a: Node, b: Node) -> Node:
    """a / b."""
    if _is(b, 0.0):
        raise FoldError("it divides by zero")
    if a.is_number and b.is_number:
        return _fold(operator.truediv, a.value, b.value)
    if _is(b, 1.0):
        return a
    affine = (a.affine[0] / b.value, a.affine[1] / b.value) if b.is_number and a.affine else None
    return _node("divide", a, b, affine=affine)


def power(a: Node, b: Node) -> Node:
    """a ** b: a power with a constant exponent, else exp(b log a), which needs a > 0."""
    if a.is_number and b.is_number:
        return _fold(operator.pow, a.value, b.value)
    if not b.is_number:
        return function("exp", multiply(b, function("log", a)))
    if b.value == 0.0:
        return ONE
    if b.value == 1.0:
        return a
    if b.value == 0.5 and (root := _known_root(a)):
        return root
    return _node("power", a, value=b.value)


def _known_root(a: Node) -> Node | None:
    """|b| where a is b², |cos b| where it is 1 - sin²b: √a has the slope 0/0 where it is zero."""
    if a.operation == "power" and a.value == 2.0:
        return function("abs", a.arguments[0])
    one, other = a.arguments if a.operation == "add" else (a, a)
    one, other = (one, other) if one.is_number else (other, one)
    square = other.arguments[0] if other.operation == "negative" else a
    if _is(one, 1.0) and square.operation == "power" and square.value == 2.0:
        wave = square.arguments[0]
        if wave.operation in _OTHER_WAVE:
            return function("abs", function(_OTHER_WAVE[wave.operation], wave.arguments[0]))
    return None


FUNCTIONS: dict[str, Callable[[float], float]] = {
    **{name: getattr(math, name) for name in (
        "sin", "cos", "tan", "exp", "log", "sqrt", "sinh", "cosh", "tanh", "asin", "acos", "atan",
        "asinh", "acosh", "atanh", "erf",
    )},
    "abs": abs, "sign": lambda x: float((x > 0) - (x < 0)),
}
_OTHER_WAVE = {"sin": "cos", "cos": "sin"}


def function(name: str, a: Node) -> Node:
    """One of FUNCTIONS of a."""
    if a.is_number:
        return _fold(FUNCTIONS[name], a.value)
    if name == "sqrt":
        return power(a, number(0.5))
    if name in ("asin", "acos") and a.operation in _OTHER_WAVE:
        # The root of 1 - a² is known: no derivative is 0/0 where the wave turns around.
        root = function("abs", function(_OTHER_WAVE[a.operation], a.arguments[0]))
        arc = multiply(number(2.0), function("atan", divide(a, add(ONE, root))))
        return arc if name == "asin" else subtract(number(0.5 * math.pi), arc)
    if name == "atan" and a.operation == "tan":
        sine, cosine = (function(wave, a.arguments[0]) for wave in ("sin", "cos"))
        return multiply(function("asin", sine), function("sign", cosine))
    return _node(name, a, smooth={"sign": 0.0, "abs": 1.0}.get(name, math.inf))


def extremum(name: str, a: Node, b: Node) -> Node:
    """``min`` or ``max`` of two: a where the sign of a - b says so, else b, with a kink between."""
    difference = subtract(a, b)
    if difference.is_number:
        return a if (difference.value < 0) == (name == "min") else b
    return _node(name, a, b, difference, smooth=1.0)


def step(a: Node) -> Node:
    """0 where the argument is negative, 1 where it is positive: step(t1 - t) = 1 - step(t - t1)."""
    if a.is_number:
        raise FoldError("the argument of step does not depend on t")
    if a.affine is None:
        return multiply(number(0.5), add(ONE, function("sign", a)))
    offset, slope = a.affine
    rising = _node("step", value=_fold(lambda c, s: -c / s, offset, slope).value, smooth=0.0)
    return rising if slope > 0 else subtract(ONE, rising)


def derivative(a: Node) -> Node:
    """da/dt."""
    if a.affine:
        return number(a.affine[1])
    if a.signals:
        raise FoldError(
            f"d(.) of something with {min(a.signals)} in it: signals are measured, and nothing "
            "measured is differentiated"
        )
    if a.smooth < 1:
        raise FoldError("d(.) of something that jumps (step or sign) is an impulse, no function")
    if a.derivatives >= MAX_DERIVATIVES:
        raise FoldError(f"more than {MAX_DERIVATIVES} d(.) inside each other")
    return Node("derivative", (a,), 0.0, None, a.derivatives + 1, a.smooth - 1)


def divisors_of(a: Node) -> list[Node]:
    """What a divides by, directly or by a negative power; only what does not jump."""
    found: dict[int, Node] = {}
    seen: set[int] = set()
    stack = [a]
    while stack:
        node = stack.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        stack.extend(node.arguments)
        if node.operation == "divide" or (node.operation == "power" and node.value < 0.0):
            found[id(node.arguments[-1])] = node.arguments[-1]
    return [node for node in found.values() if node.smooth > 0]
