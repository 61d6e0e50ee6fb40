"""Known functions of time: programs of elementary operations on rows of times.

A program (``gpebo_cli/model/expressions/program.py``) is what an interpreter of the tape does,
written down once. In NumPy the interpreter itself is as fast and says what is wrong; so these two
leave the work to it.
"""

from __future__ import annotations

import numpy as np

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


def missed_between(between: Array, *pairs: Array) -> Array:
    """How far functions are from the polynomials through their nodes, (pairs, K), relative.

    Args:
        between: the polynomial at the places between, from its points (s + 1, looks).
        pairs: values (orders, K (s + 1), ...) at the points and (orders, K looks, ...) between, of
            one function after the other; the first order counts, of entries that move the worst.
    """
    points, looks = between.shape
    found = []
    for nodal, seen in zip(pairs[::2], pairs[1::2], strict=True):
        nodes = nodal[0].reshape(nodal.shape[1] // points, points, -1)
        actual = seen[0].reshape(len(nodes), looks, -1)
        first = nodes[:1, :1]
        moves = (nodes != first).any(axis=(0, 1)) | (actual != first).any(axis=(0, 1))
        nodes, actual = nodes[..., moves], actual[..., moves]
        size = np.maximum(np.abs(actual).max(axis=(0, 1)), np.abs(nodes).max(axis=(0, 1)))
        far = np.abs(between.T @ nodes - actual).max(axis=1) / size
        found.append(far.max(axis=1, initial=0.0))
    return np.array(found)
