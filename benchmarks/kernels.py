"""What each compiled kernel is worth: switched off in turn, its NumPy twin does its work.

A kernel that no workload needs by ADMITTED is not worth its lines of C. ``python -m benchmarks
kernels`` prints the table; CPU time, with and without alternating, the shortest of several runs.
Run it with one BLAS thread (``OPENBLAS_NUM_THREADS=1``) on a machine that does nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from gpebo_cli import kernels

ADMITTED = 0.05  # share of a workload's time
_AGAIN, _ENOUGH = 25, 2.0  # most pairs of runs, and seconds of them


def twins() -> dict[str, tuple[Any, Any, str]]:
    """Compiled and NumPy module of every kernel, and its name, by ``subject.name``."""
    found = {}
    for subject in kernels.SUBJECTS:
        numpy = import_module(f"gpebo_cli.kernels.{subject}_numpy")
        bound = getattr(kernels, subject)
        for name in import_module(f"gpebo_cli.kernels.{subject}_compiled").__dict__:
            if not name.startswith("_") and name in vars(numpy) and name not in _NOT_KERNELS:
                found[f"{subject}.{name}"] = bound, numpy, name
    return found


_NOT_KERNELS = {"np", "annotations", "Array", "IntArray", "BoolArray", "Callable"}


@contextmanager
def without(*names: str) -> Iterator[None]:
    """NumPy for these kernels; without names for all, as where nothing could be compiled."""
    changed = []
    for name, (bound, numpy, attribute) in twins().items():
        if not names or name in names:
            changed.append((bound, attribute, getattr(bound, attribute)))
            setattr(bound, attribute, getattr(numpy, attribute))
    try:
        yield
    finally:
        for bound, attribute, function in changed:
            setattr(bound, attribute, function)


def workloads() -> dict[str, Callable[[], object]]:
    """The circuit, many gains, a long horizon, published problems, and ladders."""
    from benchmarks import circuit, growth, problems

    published = [problems.ours(problem)(1e-9) for problem in problems.problems()]

    def all_published() -> None:
        for solve in published:
            solve()

    return {
        "circuit": circuit.ours(1e-9),
        "5,000 gains": growth.experiment(gains=5_000),
        "1,000 s": growth.experiment(1_000.0),
        "published": all_published,
        "ladder 25": growth.chain(25, varying=True),
        "ladder 101": growth.chain(101, varying=False),
    }


def loss(solve: Callable[[], object], name: str) -> float:
    """By which share a workload is slower without a kernel."""
    best = [float("inf"), float("inf")]
    spent = 0.0
    for _ in range(_AGAIN):
        for i, off in enumerate((False, True)):
            begin = time.process_time()
            if off:
                with without(name):
                    solve()
            else:
                solve()
            taken = time.process_time() - begin
            best[i], spent = min(best[i], taken), spent + taken
        if spent > _ENOUGH:
            break
    return best[1] / best[0] - 1.0


def table() -> str:
    """One row per kernel: percent by which each workload is slower without it."""
    work = workloads()
    for solve in work.values():
        solve()
    lines = ["| kernel | " + " | ".join(work) + " |", "|---|" + "---|" * len(work)]
    for name, (_, _, attribute) in twins().items():
        if attribute.isupper():  # says what a module can do
            continue
        losses = [loss(solve, name) for solve in work.values()]
        cells = [f"{100 * x:.0f}" if x >= ADMITTED else "" for x in losses]
        lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    return "\n".join(lines)
