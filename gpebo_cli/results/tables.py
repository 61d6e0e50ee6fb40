"""The five CSV tables of a run. Floats are written ``%.17g``, so reading them gives them back.

A table is a header and an array, formatted a chunk of rows at a time by one ``%`` operation: some
0.35 µs per number, three quarters of what ``numpy.savetxt`` takes. pandas is for data frames
alone: importing it takes longer than most runs.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import EstimationResult, NoiseStatistics, RunResult
from gpebo_cli.model.descriptor import Array
from gpebo_cli.results.files import cell, csv_text, write_file, write_text
from gpebo_cli.schema import known_name

if TYPE_CHECKING:
    from pandas import DataFrame

_CHUNK_ROWS = 2048  # large enough to amortise the call, small enough to stay in cache


@dataclass(frozen=True)
class Table:
    """Names of columns and their values; the first one is ``case`` or ``t``."""

    header: list[str]
    pieces: Iterable[Array]  # (rows, columns) each, one below the other


def _signals(result: RunResult) -> Table:
    """``t``, inputs, outputs and true states that are known; what was measured, if it differs."""
    system, signals = result.system, result.signals
    known = np.flatnonzero(~np.isnan(signals.states).all(axis=0))
    header = ["t", *system.inputs, *system.outputs, *(system.states[i] for i in known)]
    columns = [signals.t, signals.inputs, signals.outputs, signals.states[:, known]]
    for names, seen in (
        (system.inputs, signals.measured_inputs),
        (system.outputs, signals.measured_outputs),
    ):
        if seen is not None:
            header += [f"{name}_measured" for name in names]
            columns.append(seen)
    return Table(header, [np.column_stack(columns)])


def _regression(result: RunResult) -> Table | None:
    """``t``, ``Y_1…``, then ``psi_<row>_<parameter>`` row by row."""
    regression = result.regression
    if regression is None:
        return None
    count = regression.Y.shape[1]
    rows = range(1, count + 1)
    header = ["t", *(f"Y_{i}" for i in rows)]
    header += [f"psi_{i}_{name}" for i in rows for name in regression.parameters]
    width = count * len(regression.parameters)  # spelled out: -1 is ambiguous if there are none
    psi = regression.psi.reshape(len(regression.t), width)
    return Table(header, [np.column_stack([regression.t, regression.Y, psi])])


def _excitation(result: RunResult) -> Table | None:
    """``t``, the eigenvalues of G in ascending order, ``pe_level`` and ``normalised_min``."""
    e = result.excitation
    if e is None:
        return None
    count = e.gram_eigenvalues.shape[1]
    header = ["t", *(f"gram_eig_{i}" for i in range(1, count + 1)), "pe_level", "normalised_min"]
    columns = [e.t, e.gram_eigenvalues, e.pe_level, e.normalised_min]
    return Table(header, [np.column_stack(columns)])


def _estimates(result: RunResult) -> Table | None:
    """``case, t, <parameter>_hat…, <state>_hat…``, ``delta`` if mixed, deviations, checks.

    Deviations ``<parameter>_std…, <state>_std…`` are there where the noise is known. Then
    ``<parameter>_true`` of what varies; of what does not, ``summary.json`` has the value. Columns
    of states that the observer does not see are empty.
    """
    e = result.estimation
    if e is None:
        return None
    # Names, and values of every case (G, M, c), or the same of all.
    kinds: list[tuple[Iterable[str], Array]] = [
        (["case"], np.arange(len(e.parameters), dtype=float)[:, None, None]),
        (["t"], e.t[None, :, None]),
    ]
    states, delta = result.system.states, e.delta
    for suffix, of_eta, of_x in (
        ("hat", e.parameters, e.states), ("std", e.parameters_std, e.states_std)
    ):
        if of_eta is not None and of_x is not None:
            kinds.append(([f"{name}_{suffix}" for name in e.names], of_eta))
            kinds.append(([f"{name}_{suffix}" for name in states], of_x))
        if suffix == "hat" and delta is not None:
            kinds.append((["delta"], delta[..., None]))
    kinds += [([name], check[..., None]) for name, check in e.checks.items()]
    for name, truth in zip(e.names, e.true_parameters.T, strict=True):
        if not np.isnan(truth).any() and np.ptp(truth) > 0.0:
            kinds.append(([f"{name}_true"], truth[None, :, None]))
    cases, at_once = len(e.cases), max(1, _CHUNK_ROWS // max(len(e.t), 1))

    def rows(part: slice) -> Array:
        wide = [np.broadcast_to(x, (cases, len(e.t), x.shape[2]))[part] for _, x in kinds]
        return np.concatenate(wide, axis=2).reshape(-1, sum(x.shape[2] for x in wide))

    return Table(
        [name for names, _ in kinds for name in names],
        (rows(slice(first, first + at_once)) for first in range(0, cases, at_once)),
    )


def check_parquet() -> None:
    """Refuse Parquet files where nothing can write them, before a long run (ConfigError)."""
    if find_spec("pyarrow") is None:
        raise ConfigError("output.parquet needs pyarrow: pip install 'gpebo[parquet]'")


def write_parquet(made: Iterable[Path]) -> None:
    """Those of the tables ``made`` that exist once more, as Parquet files of the same numbers."""
    reader, parquet = import_module("pyarrow.csv"), import_module("pyarrow.parquet")
    for path in made:
        if path.exists():
            buffer = io.BytesIO()
            parquet.write_table(reader.read_csv(path), buffer)
            write_file(path.with_suffix(".parquet"), [buffer.getvalue()])


def _cases(result: RunResult) -> Table | None:
    """One row per case: its gains (NaN: it has no such gain), its metrics."""
    estimation, metrics = result.estimation, result.metrics
    if estimation is None or metrics is None:
        return None
    columns = {**estimation.gains, **metrics.columns}
    rows = np.column_stack([np.arange(len(estimation.cases)), *columns.values()])
    return Table(["case", *columns], [rows])


TABLES: dict[str, Callable[[RunResult], Table | None]] = {
    "signals": _signals, "regression": _regression, "excitation": _excitation,
    "estimates": _estimates, "cases": _cases,
}
"""What makes each table of a run; None where the run has nothing for it."""


def frame(result: RunResult, name: str) -> DataFrame:
    """One of the :data:`TABLES` of a run (ConfigError: it is none, or this run does not have it).

    ``signals``, ``regression`` and ``excitation`` are indexed by ``t`` in seconds, ``estimates`` by
    ``case`` and ``t``, ``cases`` by ``case``.
    """
    table = TABLES[known_name(name, TABLES, f"there is no table {name!r}")](result)
    if table is None:
        raise ConfigError(f"this run has no table {name!r}: it was made with observer=none")
    from pandas import DataFrame

    found = DataFrame(np.concatenate(list(table.pieces)), columns=table.header)
    keys = table.header[:2] if name == "estimates" else table.header[:1]
    return found.astype({key: int for key in keys if key == "case"}).set_index(keys)


def write_table(path: Path, table: Table) -> None:
    """Write a table as CSV; NaN is an empty cell."""
    pieces = (text for piece in table.pieces for text in rows_text(piece))
    head = csv_text([table.header]).encode()  # a name may need quotes; numbers never do
    write_file(path, chain([head], pieces))


def write_noise(path: Path, estimation: EstimationResult, noise: NoiseStatistics) -> None:
    """Write one row per case and parameter: its gains, the truth, and errors over the seeds."""
    names = list(estimation.gains)
    rows = [["case", *names, "parameter", "truth", "bias", "deviation", "rms", "seeds"]]
    for case, values in enumerate(estimation.cases):
        own = [cell(values.get(gain)) for gain in names]
        for i, name in enumerate(noise.names):
            errors = (each[case, i] for each in (noise.bias, noise.deviation, noise.rms))
            numbers = map(cell, (noise.truth[i], *errors))
            rows.append([str(case), *own, name, *numbers, str(noise.seeds)])
    write_text(path, csv_text(rows))


def rows_text(table: Array) -> Iterator[bytes]:
    """A table (rows, columns) as CSV; NaN is empty."""
    line = ",".join(["%.17g"] * table.shape[1]) + "\n"
    for start in range(0, len(table), _CHUNK_ROWS):
        chunk = table[start : start + _CHUNK_ROWS]
        text = (line * len(chunk) % tuple(chunk.ravel().tolist())).encode()
        yield text.replace(b"nan", b"") if np.isnan(chunk).any() else text
