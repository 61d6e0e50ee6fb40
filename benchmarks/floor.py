"""How close the numerical part is to its floor: the time of its LAPACK calls alone.

Every call of ``numpy.linalg`` and ``scipy.linalg`` that a solve without the compiled kernels makes
is recorded with its arrays; then the same calls on the same arrays are timed with nothing in
between. The kernels do most of that linear algebra themselves: the floor is that of NumPy's way.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks import circuit, gains, problems
from benchmarks.kernels import without
from benchmarks.measure import alternate, decades, loosest, say, seconds

LAPACK = (
    "cholesky", "cond", "det", "eig", "eigh", "eigvals", "eigvalsh", "inv", "lstsq", "lu_factor",
    "lu_solve", "matrix_rank", "pinv", "qr", "slogdet", "solve", "solve_banded", "solve_triangular",
    "svd", "svdvals",
)  # norm is not among them: it is a sum of squares unless asked for a singular value
Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


@contextmanager
def recorded() -> Iterator[list[Call]]:
    """Calls made meanwhile, outermost only: what ``pinv`` calls is part of ``pinv``."""
    calls: list[Call] = []
    inside = [False]

    def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
        def recording(*args: Any, **kwargs: Any) -> Any:
            if inside[0]:
                return function(*args, **kwargs)
            copies = tuple(np.copy(a) if isinstance(a, np.ndarray) else a for a in args)
            calls.append((function, copies, kwargs))
            inside[0] = True
            try:
                return function(*args, **kwargs)
            finally:
                inside[0] = False

        return recording

    modules = [np.linalg, *(m for name, m in list(sys.modules.items()) if name == "scipy.linalg")]
    originals = {
        getattr(module, name): None
        for module in modules for name in LAPACK if hasattr(module, name)
    }
    # By name where they live, and wherever our modules have imported them by name.
    places = [*modules, *(m for name, m in sys.modules.items() if name.startswith("gpebo_cli"))]
    patched = []
    for module in places:
        for name, value in list(vars(module).items()):
            if callable(value) and _hashable(value) and value in originals:
                patched.append((module, name, value))
                setattr(module, name, wrap(value))
    try:
        yield calls
    finally:
        for module, name, value in patched:
            setattr(module, name, value)


def _hashable(value: object) -> bool:
    return type(value).__hash__ is not None


def measure(name: str, solve: Callable[[], object]) -> dict[str, Any]:
    """Times of a solve, of one without kernels, of the LAPACK calls of that; and which they are."""
    say(f"{name}: floor")

    def in_numpy() -> None:
        with without():
            solve()

    in_numpy()
    with recorded() as calls:
        in_numpy()

    def replay() -> None:
        for function, args, kwargs in calls:
            function(*args, **kwargs)

    counts = Counter(function.__name__ for function, _, _ in calls)
    whole, numpy = alternate(solve, in_numpy, 2.0)
    alone = seconds(replay, 1.0)
    return {
        "name": name, "seconds": whole, "numpy_seconds": numpy, "lapack_seconds": alone,
        "share": alone / numpy, "over_floor": whole / alone,
        "calls": dict(sorted(counts.items())),
    }


def table() -> list[dict[str, Any]]:
    """The circuit with one gain and with a thousand, and two of the published problems."""
    one = loosest(circuit.ours, circuit.OURS, circuit.error, circuit.TARGET)
    many = loosest(
        lambda tol: circuit.ours(tol, gains.GAINS), circuit.OURS, gains.error, circuit.TARGET
    )
    rows = [
        measure("circuit, γ = 1e10", one.solve), measure("circuit, 1,000 gains", many.solve)
    ]
    for problem in problems.problems():
        found = loosest(
            problems.ours(problem), decades(-6, -13), problem.error, problems.TARGET
        )
        rows.append(measure(problem.name, found.solve))
    return rows
