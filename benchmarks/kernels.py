"""What each compiled kernel is worth: switched off in turn, its NumPy twin does its work.

A kernel that no workload needs by ADMITTED is not worth its lines of C. ``python -m benchmarks
kernels`` prints the table and writes it into ``docs/decisions.md``; CPU time, with and without
alternating, the shortest of several runs. Run it with one BLAS thread
(``OPENBLAS_NUM_THREADS=1``) on a machine that does nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.measure import say
from gpebo_cli import kernels

ADMITTED = 0.05  # share of a workload's time
_AGAIN, _ENOUGH = 25, 2.0  # most pairs of runs, and seconds of them
DECISIONS = Path(__file__).parent.parent / "docs" / "decisions.md"
BEGIN, END = "<!-- made by `python -m benchmarks kernels` -->\n", "\n<!-- to here -->"


def twins() -> dict[str, tuple[Any, Any, str]]:
    """Compiled and NumPy module of every kernel, and its name, by ``subject.name``."""
    found = {}
    for subject in kernels.SUBJECTS:
        numpy = import_module(f"gpebo_cli.kernels.{subject}_numpy")
        bound = getattr(kernels, subject)
        for name in import_module(f"gpebo_cli.kernels.{subject}_compiled").__dict__:
            function = name.islower() or name.isupper()  # no type
            if function and name[0] != "_" and name in vars(numpy) and name not in _NOT_KERNELS:
                found[f"{subject}.{name}"] = bound, numpy, name
    return found


_NOT_KERNELS = {"np", "annotations"}


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
    """The circuit, published problems, their text read anew, many gains, long horizons, ladders."""
    from benchmarks import circuit, growth, ladders, problems
    from gpebo_cli import run

    published = [problems.ours(problem)(1e-9) for problem in problems.problems()]

    def all_published() -> None:
        for solve in published:
            solve()

    def new_plants() -> None:
        for problem in problems.problems():
            problems.ours(problem)(1e-9)()

    return {
        "circuit": circuit.ours(1e-9),
        "`run`, 1,001 samples": partial(run, "circuit", estimator="drem"),
        "published problems": all_published,
        "new plants": new_plants,
        "5,000 gains": growth.experiment(gains=5_000),
        "1,000 s": growth.experiment(1_000.0),
        "ladder, n = 25": ladders.simulation(25, "capacitor loop", varying=True),
        "ladder, n = 101": ladders.simulation(101, "capacitor loop", varying=False),
        "stiff ladder, n = 41": ladders.simulation(41, "stiff", varying=True),
        "200,000 gains": growth.experiment(gains=200_000),
        "20,000 s": growth.experiment(20_000.0),
    }


def shares(solve: Callable[[], object]) -> tuple[float, dict[str, float]]:
    """Seconds of one run of a workload, and which share of them each kernel takes."""
    spent = dict.fromkeys(twins(), 0.0)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            begin = time.process_time()
            try:
                return function(*arguments, **named)
            finally:
                spent[name] += time.process_time() - begin

        return call

    kernels_of = twins().items()
    functions = {name: getattr(bound, attribute) for name, (bound, _, attribute) in kernels_of}
    for name, (bound, _, attribute) in kernels_of:
        if not attribute.isupper():
            setattr(bound, attribute, timed(name, functions[name]))
    begin = time.process_time()
    try:
        solve()
    finally:
        for name, (bound, _, attribute) in kernels_of:
            setattr(bound, attribute, functions[name])
    whole = time.process_time() - begin
    return whole, {name: seconds / whole for name, seconds in spent.items()}


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


def table() -> Iterator[str]:
    """One row per kernel: percent by which each workload is slower without it; column by column.

    Long workloads come last, and only kernels that no shorter one has admitted are tried on them.
    """
    cells: dict[str, list[str]] = {
        name: [] for name, (_, _, attribute) in twins().items()
        if not attribute.isupper()  # that says what a module can do
    }
    lines = ["| kernel |", "|---|"]
    for what, solve in workloads().items():
        say(f"kernels: {what}")
        solve()
        seconds, share = shares(solve)
        lines = [f"{lines[0]} {what} |", f"{lines[1]}---|"]
        for name, row in cells.items():
            if 2.0 * seconds > _ENOUGH and any(cell not in ("", "–") for cell in row):
                row.append("–")
                continue
            lost = loss(solve, name) if share[name] > 0.0 else 0.0
            row.append(f"{100 * lost:.0f}" if lost >= ADMITTED else "")
        rows = [f"| `{name}` | {' | '.join(row)} |" for name, row in cells.items()]
        yield "\n".join([*lines, *rows])


def write(found: str) -> None:
    """The table into its place in ``docs/decisions.md``."""
    before, _, rest = DECISIONS.read_text("utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    DECISIONS.write_text(before + BEGIN + "\n" + found + "\n" + END + after, "utf-8")
