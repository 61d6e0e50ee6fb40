"""As :mod:`observer_numpy`, in C for few states."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled, observer_numpy
from gpebo_cli.kernels.arrays import Array

_SMALL = 24  # states, up to which NumPy's calls cost more than plain loops


def in_frame(
    E: Array, A: Array, B: Array, F: Array, C: Array, rows: Array, scale: Array, domain: Array,
    range_: Array, kernel: Array, equations: Array,
) -> tuple[Array, ...]:
    """In C."""
    arguments = E, A, B, F, C, rows, scale, domain, range_, kernel, equations
    if len(rows) > _SMALL or len(equations) + len(scale) < kernel.shape[1]:
        return observer_numpy.in_frame(*arguments)
    of_A = max(len(A), len(C))
    found: tuple[Array, ...] = _compiled.in_frame(
        *arguments, len(E), of_A, max(len(B), len(F)), max(len(E), of_A)
    )
    return found


def regression_signals(
    z: Array, q: int, basis: Array, algebraic: Array, g_y: Array, G: Array, range_: Array,
    elimination: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """In C."""
    small = len(basis) <= _SMALL
    found: tuple[Array, Array, Array, Array, Array] = (
        _compiled if small else observer_numpy
    ).regression_signals(z, q, basis, algebraic, g_y, G, range_, elimination)
    return found
