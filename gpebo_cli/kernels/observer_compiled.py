"""As :mod:`observer_numpy`, in C for few states."""

from __future__ import annotations

from typing import Any

from gpebo_cli.kernels import _compiled, observer_numpy
from gpebo_cli.kernels.arrays import Array

_SMALL = 24  # states, up to which NumPy's calls cost more than plain loops


def in_frame(*arguments: Array) -> tuple[Array, ...] | None:
    """In C."""
    E, A, B, F, C, rows, *_ = arguments
    if len(rows) > _SMALL:
        return None
    of_A = max(len(A), len(C))
    found: tuple[Array, ...] = _compiled.in_frame(
        *arguments, len(E), of_A, max(len(B), len(F)), max(len(E), of_A)
    )
    return found


def regression_signals(z: Array, q: int, basis: Array, *equations: Array) -> Any:
    """In C."""
    either = _compiled if len(basis) <= _SMALL else observer_numpy
    return either.regression_signals(z, q, basis, *equations)
