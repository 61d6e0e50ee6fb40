"""Known functions of time: programs of elementary operations on rows of times.

A program (``gpebo_cli/model/expressions/program.py``) is what an interpreter of the tape does,
written down once. In NumPy the interpreter itself is as fast and says what is wrong; so these two
leave the work to it.
"""

from __future__ import annotations

from gpebo_cli.kernels.arrays import Array, IntArray

RUNS_PROGRAMS = False


def jets(
    t: Array, inside: Array | None, signals: Array, code: IntArray, constants: Array,
    results: IntArray, targets: IntArray, *matrices: Array,
) -> tuple[Array, ...] | None:
    """Matrices (orders, N, ...) of which some entries are the results of a program.

    Args:
        t: times (N,).
        inside: where jumps are decided (N,).
        signals: further rows (rows, N).
        code: operations (number, 4).
        constants: of the program.
        results: rows of the coefficients (orders, outputs).
        targets: the matrix and the entry of each output (outputs, 2).
        matrices: (orders, 1, ...) what they are elsewhere.

    Returns:
        None: the interpreter has to do it, or an operation may have to be refused.
    """
    del t, inside, signals, code, constants, results, targets, matrices
    return None


def intervals(
    low: Array, high: Array, inside: Array, code: IntArray, constants: Array, results: IntArray
) -> tuple[Array, Array] | None:
    """Bounds (orders, N, outputs) of the results of a program over cells of time; None: see above.

    Args:
        low: where cells begin (N,).
        high: where they end (N,).
        inside: where jumps are decided (N,).
        code: operations (number, 4).
        constants: of the program.
        results: rows of the coefficients (orders, outputs).
    """
    del low, high, inside, code, constants, results
    return None
