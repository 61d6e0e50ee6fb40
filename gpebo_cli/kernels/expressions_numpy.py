"""Known functions of time: programs of elementary operations on rows of times.

A program (``gpebo_cli/model/expressions/program.py``) is what an interpreter of the tape does,
written down once. In NumPy the interpreter itself is as fast and says what is wrong; so these two
leave the work to it.
"""

from __future__ import annotations

from typing import Any

from gpebo_cli.kernels.arrays import Array

RUNS_PROGRAMS = False


def jets(_t: Array, _at: Array | None, _signals: Array, *_: Any) -> tuple[Array, ...] | None:
    """Matrices (orders, N, ...) of which some entries are the results of a program.

    Of times (N,), where jumps are decided (N,), further rows (rows, N), the program, the matrix
    and the entry of each output (outputs, 2) and the matrices (orders, 1, ...) as they are
    elsewhere. None: the interpreter has to do it, or an operation may have to be refused.
    """
    return None


def intervals(_low: Array, _high: Array, _at: Array, *_: Any) -> tuple[Array, Array] | None:
    """Bounds (orders, N, outputs) of the results of a program over cells of time (N,), or None."""
    return None
