"""How small errors go through an observer or an estimator: a linear system of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.problem import LinearEquation


class ErrorSystem(NamedTuple):
    """s' = A s + B i, o = C s + D i at N times; a leading axis of 1 means constant in time.

    Of an observer i are the errors of u and y, and o those of Y and of the state's offset. Of an
    estimator i are those of Y, and o those of η̂ (mathematics: ζ' = A_0 ζ + B_e e,
    δY = R(𝒜ζ + E e)).
    """

    A: Array  # (N, S, S)
    B: Array  # (N, S, I)
    C: Array  # (N, O, S)
    D: Array  # (N, O, I)


    def driven(self, errors: Array, rows: int | None = None) -> LinearEquation:
        """s' and as extras C and D i, for errors i (N, I, c), perhaps of the first outputs only."""
        return LinearEquation(
            None, self.A, self.B @ errors, (self.C[:, :rows], self.D[:, :rows] @ errors)
        )


# (times (N,), inside (N,)) -> the system there
ErrorsAt = Callable[[Array, Array], ErrorSystem]


class ErrorSteps(NamedTuple):
    """The same of an observer at K samples, with the errors e before and e' after each step.

    ζ' = step [ζ; e; e'], o = C ζ' + D e'.
    """

    step: Array  # (K, S, S + 2 I)
    C: Array  # (K, O, S)
    D: Array  # (K, O, I)


class ErrorRecursion(NamedTuple):
    """The same of an estimator: s' = A s + old δY + new δY', δη̂ = C s'."""

    A: Array  # (K, S, S)
    old: Array  # (K, S, rows)
    new: Array  # (K, S, rows)
    C: Array  # (K, p, S)
