"""Interval arithmetic over arrays of cells: what a function can do anywhere in a cell.

An :class:`Interval` stands where the rules of :mod:`~gpebo_cli.model.expressions.jets` expect an
array of times: they then give Taylor coefficients that hold for all t of each cell at once. Every
result is widened by a few units in the last place, and by the functions' own error. What is not
defined in a part of a cell, or not at all, may have any value there.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from gpebo_cli.model.descriptor import Array

_WIDER = 4 * float(np.finfo(float).eps)
_TINY = float(np.finfo(float).tiny)
_HALF_PI = 0.5 * np.pi
# The functions that grow all over where they are defined, and where that is.
_RISING = {
    "exp": (-np.inf, np.inf), "sinh": (-np.inf, np.inf), "tanh": (-np.inf, np.inf),
    "arctan": (-np.inf, np.inf), "arcsinh": (-np.inf, np.inf), "erf": (-np.inf, np.inf),
    "sign": (-np.inf, np.inf), "log": (0.0, np.inf), "sqrt": (0.0, np.inf),
    "arcsin": (-1.0, 1.0), "arctanh": (-1.0, 1.0), "arccosh": (1.0, np.inf),
}  # fmt: skip


class Interval(NDArrayOperatorsMixin):
    """All numbers between ``low`` and ``high``, arrays (N,)."""

    __slots__ = ("high", "low")

    def __init__(self, low: Array, high: Array) -> None:
        unknown = np.isnan(low) | np.isnan(high)
        self.low = np.where(unknown, -np.inf, low)
        self.high = np.where(unknown, np.inf, high)

    def __array_ufunc__(self, ufunc: np.ufunc, _method: str, *inputs: Any, **_options: Any) -> Any:
        """All values that a function can have."""
        with np.errstate(all="ignore"):
            low, high = _image(ufunc, *inputs)
            if ufunc.__name__ in ("maximum", "negative", "absolute", "sign", "greater_equal"):
                return Interval(low, high)
            slack = _WIDER * np.abs(low) + _TINY, _WIDER * np.abs(high) + _TINY
            return Interval(low - slack[0], high + slack[1])

    def astype(self, _type: type) -> Interval:
        """This interval: truth is 0 or 1 in it."""
        return self


def _ends(value: Any) -> tuple[Any, Any]:
    return (value.low, value.high) if isinstance(value, Interval) else (value, value)


def _image(ufunc: np.ufunc, a: Any, b: Any = 0.0) -> tuple[Array, Array]:
    name = ufunc.__name__
    (low, high), (least, most) = _ends(a), _ends(b)
    if name in _RISING:
        first, last = _RISING[name]
        inside = (high >= first) & (low <= last)
        image = ufunc(np.clip(low, first, last)), ufunc(np.clip(high, first, last))
        return np.where(inside, image[0], np.nan), np.where(inside, image[1], np.nan)
    if a is b and name == "multiply":
        return _even(np.square, low, high)
    image = _OTHERS[name](low, high, least, most)
    return image[0], image[1]


def _product(low: Any, high: Any, least: Any, most: Any) -> tuple[Array, Array]:
    """0 · ∞ is 0: the bound is never reached."""
    ends = [np.where((x == 0) | (y == 0), 0.0, x * y) for x in (low, high) for y in (least, most)]
    return np.minimum.reduce(ends), np.maximum.reduce(ends)


def _quotient(low: Any, high: Any, least: Any, most: Any) -> Array:
    image = _product(low, high, 1.0 / np.asarray(most), 1.0 / np.asarray(least))
    return np.where((least <= 0) & (most >= 0), np.nan, image)


def _even(function: Callable[[Any], Any], low: Any, high: Any) -> tuple[Array, Array]:
    """Bounds of a function that falls up to 0 and grows from there."""
    nearest = np.maximum(np.maximum(low, -np.asarray(high)), 0.0)
    return function(nearest), function(np.maximum(np.abs(low), np.abs(high)))


def _power(low: Any, high: Any, exponent: Any, _: Any) -> Any:
    r = float(exponent)  # exponents are constant
    if r.is_integer() and r > 0:
        if r % 2 == 0:
            return _even(lambda x: np.power(x, r), low, high)
        return np.power(low, r), np.power(high, r)
    if r > 0:
        return np.where(high < 0, np.nan, np.power(np.maximum(low, 0.0), r)), np.power(high, r)
    return np.where(low > 0, (np.power(high, r), np.power(low, r)), np.nan)


def _reached(low: Any, high: Any, at: float, period: float) -> Any:
    """Whether cells hold ``at`` + k ``period``; what rounding might move into them counts, too."""
    slack = 4e-16 * np.maximum(-low, high) + 1e-15
    first, last = (low - at - slack) / period, (high - at + slack) / period
    return (np.ceil(first) <= np.floor(last)) | ~np.isfinite(last - first)


def _wave(function: np.ufunc, low: Any, high: Any, to: float) -> Any:
    """Bounds of sin(x + to)."""
    ends = function(low), function(high)
    return tuple(
        np.where(_reached(low, high, side * _HALF_PI - to, 4.0 * _HALF_PI), side, end)
        for side, end in ((-1.0, np.minimum(*ends)), (1.0, np.maximum(*ends)))
    )


def _tan(low: Any, high: Any, *_: Any) -> Any:
    return np.where(_reached(low, high, _HALF_PI, np.pi), np.nan, (np.tan(low), np.tan(high)))


# Bounds of functions of what is between low and high, and least and most.
_OTHERS: dict[str, Callable[..., Any]] = {
    "add": lambda low, high, least, most: (low + least, high + most),
    "subtract": lambda low, high, least, most: (low - most, high - least),
    "multiply": _product,
    "divide": _quotient,
    "maximum": lambda low, high, least, most: (np.maximum(low, least), np.maximum(high, most)),
    "negative": lambda low, high, *_: (-high, -low),
    "power": _power,
    "absolute": lambda low, high, *_: _even(np.absolute, low, high),
    "cosh": lambda low, high, *_: _even(np.cosh, low, high),
    "sin": lambda low, high, *_: _wave(np.sin, low, high, 0.0),
    "cos": lambda low, high, *_: _wave(np.cos, low, high, _HALF_PI),
    "tan": _tan,
    "arccos": lambda low, high, *_: (
        np.arccos(np.clip(high, -1.0, 1.0)), np.arccos(np.clip(low, -1.0, 1.0)),
    ),
    "greater_equal": lambda low, high, least, _: (1.0 * (low >= least), 1.0 * (high >= least)),
}  # fmt: skip


def polynomials(c: Array, half: Array) -> list[Interval]:
    """Taylor coefficients anywhere in cells that are 2 ``half`` (N,) long, of polynomials there.

    Those have coefficients c (K, N) around the middle m of each cell: Σ_j c_j (t − m)^j is moved to
    any time of the cell.
    """
    found = []
    for k in range(len(c)):
        later = range(k + 1, len(c))
        away = sum((comb(j, k) * np.abs(c[j]) * half ** (j - k) for j in later), np.zeros(1))
        found.append(Interval(c[k] - away, c[k] + away))
    return found
