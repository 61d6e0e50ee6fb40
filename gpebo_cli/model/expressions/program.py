"""A tape at one order as a program for the compiled kernel: elementary operations on rows of times.

The rules of :mod:`~gpebo_cli.model.expressions.jets` are not written a second time. They are run
once, with symbols for the times instead of arrays, and what they do with those is recorded: the
kernel then does the same operations in the same order. Whatever is equal at all times is a plain
float there, so it is computed while recording and costs nothing later.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from gpebo_cli.model.descriptor import Array, IntArray

# In the order of the kernel's operations; greater_equal answers 0 or 1.
_OPERATIONS = {
    name: code
    for code, name in enumerate((
        "add", "subtract", "multiply", "divide", "maximum", "power", "greater_equal", "negative",
        "sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "arcsin", "arccos",
        "arctan", "arcsinh", "arccosh", "arctanh", "erf", "absolute", "sign",
    ))
}  # fmt: skip
_GIVEN = 2  # rows that are always given: the times, and those at which jumps are decided

Key = tuple[int, int, int]  # operation and operands: rows, or constants as ~index


class Row(NDArrayOperatorsMixin):
    """A number at each of the times, of which only the origin is known."""

    __slots__ = ("index", "recorder")

    def __init__(self, recorder: Recorder, index: int) -> None:
        self.recorder = recorder
        self.index = index

    def __array_ufunc__(self, ufunc: np.ufunc, _method: str, *inputs: Any, **_options: Any) -> Any:
        """Record what NumPy was asked to compute."""
        return self.recorder.operation(ufunc.__name__, *inputs)

    def astype(self, _type: type) -> Row:
        """This row: truth is 0 or 1 in a row."""
        return self


class Recorder:
    """The operations recorded so far; equal ones once."""

    def __init__(self, signals: tuple[int, int] | None) -> None:
        self.rows: dict[Key, Row] = {}
        self.constants: dict[float, int] = {}
        self.t, self.inside = Row(self, 0), Row(self, 1)
        orders, number = signals or (0, 0)
        self.given = _GIVEN + orders * number
        self.signals = None if signals is None else [
            [Row(self, _GIVEN + k * number + j) for k in range(orders)] for j in range(number)
        ]

    def operand(self, value: Row | float) -> int:
        """A row by its index, a constant by ~index."""
        if isinstance(value, Row):
            return value.index
        return ~self.constants.setdefault(float(value), len(self.constants))

    def operation(self, name: str, left: Row | float, right: Row | float = 0.0) -> Row:
        """The row that an operation makes."""
        key = (_OPERATIONS[name], self.operand(left), self.operand(right))
        return self.rows.setdefault(key, Row(self, self.given + len(self.rows)))


class Program(NamedTuple):
    """Operations on rows; each makes one more, after those given. Constants stand as ~index."""

    code: IntArray  # (number, 3) operation, left and right operand
    constants: Array  # (number,)
    results: IntArray  # (order + 1, outputs) the rows of the coefficients


def finished(recorder: Recorder, places: Sequence[list[Any]], outputs: Iterable[int], order: int
             ) -> Program:
    """The program of a recording whose tape has these jets at its places.

    What no output needs is done as well: it may turn out not to be finite.
    """
    final = [
        [recorder.operand(jet[k] if k < len(jet) else 0.0)
         for jet in (places[place] for place in outputs)]
        for k in range(order + 1)
    ]  # fmt: skip
    return Program(
        np.array(list(recorder.rows), dtype=np.intp).reshape(-1, 3),
        np.array(list(recorder.constants), dtype=float),
        np.array(final, dtype=np.intp).reshape(order + 1, -1),
    )
