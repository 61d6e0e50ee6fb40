"""Truncated Taylor arithmetic over arrays of times (Griewank & Walther, ch. 13).

A jet is the list of normalised Taylor coefficients ``a[k] = a^(k)(t) / k!`` of a function at N
times. Entries are arrays of shape (N,), or plain floats where they are equal at all times; a
list shorter than asked for ends in zeros, so a constant is ``[c]`` and time is ``[t, 1.0]``.
Every operation computes coefficients 0 to ``order`` and may be given longer arguments. For
``order = 0`` each is one NumPy call.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

NOTHING = 1e-290  # less is a zero, also as a bound, which is widened by 2e-308
MAX_MULTIPLIED_POWER = 1024  # larger integer exponents take the recurrence, which needs a != 0

Coefficient = NDArray[np.float64] | float
Jet = list[Coefficient]


def convolve(a: Jet, b: Jet, k: int) -> Coefficient:
    """``sum(a[j] * b[k - j])`` over ``0 <= j <= k``, where both exist."""
    total: Coefficient | None = None
    for j in range(max(0, k - len(b) + 1), min(k, len(a) - 1) + 1):
        term = a[j] * b[k - j]
        total = term if total is None else total + term
    return 0.0 if total is None else total


def weighted(a: Jet, order: int) -> Jet:
    """``k a[k]``: the coefficients of t a'(t), which every recurrence below is written in."""
    return [0.0, *(k * a[k] for k in range(1, min(order, len(a) - 1) + 1))]


def add(a: Jet, b: Jet, order: int) -> Jet:
    """a + b."""
    common = min(order + 1, len(a), len(b))
    longer = a if len(a) > len(b) else b
    return [*(a[k] + b[k] for k in range(common)), *longer[common : order + 1]]


def negative(a: Jet, order: int) -> Jet:
    """-a."""
    return [-c for c in a[: order + 1]]


def multiply(a: Jet, b: Jet, order: int) -> Jet:
    """a b."""
    return [convolve(a, b, k) for k in range(min(order, len(a) + len(b) - 2) + 1)]


def divide(a: Jet, b: Jet, order: int) -> Jet:
    """q = a / b, from q b = a."""
    q: Jet = [np.divide(a[0], b[0])]
    for k in range(1, min(order + 1, len(a) if len(b) == 1 else order + 1)):
        rest = (a[k] if k < len(a) else 0.0) - convolve(b, q, k)
        q.append(np.divide(rest, b[0]))
    return q


def derivative(a: Jet, order: int) -> Jet:
    """a'; needs a to order + 1."""
    return [k * a[k] for k in range(1, min(order + 1, len(a) - 1) + 1)] or [0.0]


def integer_power(a: Jet, exponent: int, order: int) -> Jet:
    """a ** n for n >= 1 by repeated squaring: valid at zeros of a, unlike the recurrence."""
    if exponent == 1:
        return a[: order + 1]
    even = integer_power(multiply(a, a, order), exponent // 2, order)
    return multiply(even, a, order) if exponent % 2 else even


def power(a: Jet, exponent: float, order: int) -> Jet:
    """p = a ** r, r constant: by multiplication for modest integers, else from a p' = r a' p."""
    if exponent.is_integer() and abs(exponent) <= MAX_MULTIPLIED_POWER:
        result = integer_power(a, abs(int(exponent)), order)
        return result if exponent > 0 else divide([1.0], result, order)
    p: Jet = [np.sqrt(a[0]) if exponent == 0.5 else np.power(a[0], exponent)]
    if len(a) == 1 or order == 0:
        return p
    # What stays zero has a root with all its derivatives, and they are not 0/0.
    size = sum(np.absolute(each) for each in a)
    flat = 1.0 - np.greater_equal(size, NOTHING).astype(np.float64)
    for k in range(1, order + 1):
        total: Coefficient = 0.0
        for j in range(1, min(k, len(a) - 1) + 1):
            total = total + (j * exponent - (k - j)) * (a[j] * p[k - j])
        p.append(np.divide(total, k * a[0] + flat))
    return p


def exp(a: Jet, order: int) -> Jet:
    """e = exp(a), from e' = a' e."""
    e: Jet = [np.exp(a[0])]
    if len(a) == 1:
        return e
    w = weighted(a, order)
    for k in range(1, order + 1):
        e.append(convolve(w, e, k) / k)
    return e


def _around_one(a: Jet, order: int) -> Jet:
    """1 - a²."""
    return multiply(add([1.0], negative(a, order), order), add([1.0], a, order), order)


# Each function whose derivative is a'/g, with what NumPy calls it and g as a function of a. Factors
# such as (1 - a)(1 + a) keep the digits that 1 - a² would lose near 1.
_PRIMITIVES: dict[str, tuple[Callable[[Coefficient], Coefficient], Callable[[Jet, int], Jet]]] = {
    "log": (np.log, lambda a, _: a),
    "atan": (np.arctan, lambda a, n: add([1.0], multiply(a, a, n), n)),
    "atanh": (np.arctanh, _around_one),
    "asin": (np.arcsin, lambda a, n: power(_around_one(a, n), 0.5, n)),
    "acos": (np.arccos, lambda a, n: negative(power(_around_one(a, n), 0.5, n), n)),
    "asinh": (np.arcsinh, lambda a, n: power(add([1.0], multiply(a, a, n), n), 0.5, n)),
    "acosh": (np.arccosh, lambda a, n: power(negative(_around_one(a, n), n), 0.5, n)),
}


def _integral(value: Coefficient, slope: Jet) -> Jet:
    """The jet with this value and this derivative."""
    return [value, *(c / k for k, c in enumerate(slope, 1))]


def primitive(name: str, a: Jet, order: int) -> Jet:
    """y = f(a) for one of ``_PRIMITIVES``, from g y' = a'."""
    function, of_argument = _PRIMITIVES[name]
    if len(a) == 1 or order == 0:
        return [function(a[0])]
    slope = divide(derivative(a, order - 1), of_argument(a, order - 1), order - 1)
    return _integral(function(a[0]), slope)


def erf(a: Jet, order: int) -> Jet:
    """y = erf(a), from y' = 2/√π exp(-a²) a'."""
    from scipy.special import erf as of_values

    if len(a) == 1 or order == 0:
        return [of_values(a[0])]
    bell = exp(negative(multiply(a, a, order - 1), order - 1), order - 1)
    slope = multiply([2.0 / math.sqrt(math.pi)], derivative(a, order - 1), order - 1)
    return _integral(of_values(a[0]), multiply(slope, bell, order - 1))


def switched(name: str, decided: Coefficient, arguments: list[Jet], order: int) -> Jet:
    """sign, abs, min or max, which of their sides being decided by the sign of ``decided``.

    Where the sides meet, rounding may have any sign, and a root of it would not be a number: values
    of abs, min and max are those of the time itself.
    """
    sign = np.sign(decided)
    if name == "sign":
        return [sign]
    if name == "abs":
        value = arguments[0]
        return [np.absolute(value[0]), *multiply([sign], value, order)[1:]]
    if name == "min":
        opposite = [negative(each, order) for each in arguments]
        return negative(switched("max", np.negative(decided), opposite, order), order)
    a, b, _ = arguments
    weight = 0.5 + 0.5 * sign
    sides = multiply([weight], a, order), multiply([1.0 - weight], b, order)
    return [np.maximum(a[0], b[0]), *add(*sides, order)[1:]]


_WAVES = {"sin": np.sin, "cos": np.cos, "sinh": np.sinh, "cosh": np.cosh}


def wave(name: str, a: Jet, order: int) -> Jet:
    """One of ``_WAVES`` of a, by sine and cosine together: each one's derivative is the other."""
    if len(a) == 1 or order == 0:
        return [_WAVES[name](a[0])]
    hyperbolic = name.endswith("h")
    s: Jet = [np.sinh(a[0]) if hyperbolic else np.sin(a[0])]
    c: Jet = [np.cosh(a[0]) if hyperbolic else np.cos(a[0])]
    w = weighted(a, order)
    for k in range(1, order + 1):
        rises, slope = (convolve(w, x, k) / k for x in (c, s))
        s.append(rises)
        c.append(slope if hyperbolic else -slope)
    return s if name.startswith("s") else c


def tangent(a: Jet, order: int, hyperbolic: bool = False) -> Jet:
    """y = tan(a), from y' = (1 + y²) a', or y = tanh(a), from y' = (1 - y²) a'."""
    y: Jet = [np.tanh(a[0]) if hyperbolic else np.tan(a[0])]
    if len(a) == 1:
        return y
    w = weighted(a, order)
    slope: Jet = []  # 1 ± y²
    for k in range(1, order + 1):
        square = convolve(y, y, k - 1)
        signed = -square if hyperbolic else square
        slope.append(signed + 1.0 if k == 1 else signed)
        y.append(convolve(w, slope, k) / k)
    return y


UNARY: dict[str, Callable[[Jet, int], Jet]] = {
    "negative": negative,
    "derivative": derivative,
    "exp": exp,
    "erf": erf,
    **{name: partial(primitive, name) for name in _PRIMITIVES},
    **{name: partial(wave, name) for name in _WAVES},
    "tan": tangent,
    "tanh": partial(tangent, hyperbolic=True),
}
BINARY: dict[str, Callable[[Jet, Jet, int], Jet]] = {
    "add": add,
    "multiply": multiply,
    "divide": divide,
}
