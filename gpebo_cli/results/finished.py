"""Runs that are done, read back from their folders: cases with gains and metrics, error curves."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from gpebo_cli.errors import GpeboError
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.model.descriptor import Array

METRICS = tuple(field.name for field in fields(Metrics))


@dataclass(frozen=True)
class Case:
    """One case of a finished run: where it is, what was chosen, how it went."""

    run: str  # the folder, as a person named it
    folder: Path
    number: int  # of the case in that folder
    settings: Mapping[str, str]  # plant, estimator, overrides
    gains: Mapping[str, float]
    metrics: Mapping[str, float]  # by METRICS; NaN: never


@dataclass(frozen=True)
class ErrorCurves:
    """Norms of the errors of one case, (M,) each, and the size of what they are errors of."""

    t: Array
    parameters: Array  # (M,)
    states: Array  # (M,)
    parameter_size: float
    state_size: float


def is_run(folder: Path) -> bool:
    """Whether ``folder`` is one that a run has completed."""
    return (folder / "summary.json").is_file()


def read_run(run: str, folder: Path, overrides: Mapping[str, str]) -> list[Case]:
    """All cases of a finished run; none if it had no estimator.

    Args:
        run: what to call it.
        folder: its folder.
        overrides: what distinguishes it from others, where that is known (a job of a sweep).

    Raises:
        GpeboError: a file is missing or cannot be understood; it is named.
    """
    summary = _summary(folder)
    if summary.get("estimator") is None:
        return []
    chosen = {"plant": str(summary.get("plant")), "estimator": _estimator(summary)}
    cases = []
    for row in _rows(folder / "cases.csv"):
        numbers = {k: _number(v) for k, v in row.items() if k != "case"}
        gains = {k: v for k, v in numbers.items() if k not in METRICS}
        # estimator.gamma=… is in the table already, as the gain.
        told = {k: v for k, v in overrides.items() if k.removeprefix("estimator.") not in gains}
        metrics = {name: numbers.get(name, np.nan) for name in METRICS}
        cases.append(Case(run, folder, int(row["case"]), chosen | told, gains, metrics))
    return cases


def read_errors(cases: Sequence[Case]) -> list[ErrorCurves]:
    """Error norms over time of ``cases``, each folder being read once.

    Raises:
        GpeboError: a file is missing or cannot be understood; it is named.
    """
    by_folder: dict[Path, set[int]] = {}
    for case in cases:
        by_folder.setdefault(case.folder, set()).add(case.number)
    read = {
        (folder, number): curves
        for folder, numbers in by_folder.items()
        for number, curves in _read_errors(folder, numbers).items()
    }
    return [read[case.folder, case.number] for case in cases]


def _read_errors(folder: Path, numbers: set[int]) -> dict[int, ErrorCurves]:
    truth: Mapping[str, float | None] = _summary(folder).get("parameters") or {}
    path = folder / "estimates.csv"
    kept: dict[int, list[dict[str, str]]] = {number: [] for number in sorted(numbers)}
    for row in _rows(path):
        number = int(row["case"])
        if number in kept:
            kept[number].append(row)
    signals = _columns(_rows(folder / "signals.csv"))
    middles = 0.5 * (signals["t"][1:] + signals["t"][:-1])
    out = {}
    for number, rows in kept.items():
        if not rows:
            raise GpeboError(f"{path}: there is no case {number}")
        columns = _columns(rows)
        t = columns["t"]
        nearest = np.searchsorted(middles, t)  # the estimates are on some of the signals' times
        names = [name.removesuffix("_hat") for name in columns if name.endswith("_hat")]
        # Parameters stand first; a state may have the name of one.
        states = [
            s for s in names[len(truth) :]
            if s in signals and not np.isnan(columns[f"{s}_hat"]).all()
        ]
        # Of a recording, not every true value is known.
        known = {name: float(value) for name, value in truth.items() if value is not None}
        of_parameters = [
            columns[f"{name}_hat"] - columns.get(f"{name}_true", value)
            for name, value in known.items()
        ]
        true_states = [signals[name][nearest] for name in states]
        of_states = [
            columns[f"{s}_hat"] - true for s, true in zip(states, true_states, strict=True)
        ]
        out[number] = ErrorCurves(
            t,
            _norm(of_parameters, len(t)),
            _norm(of_states, len(t)),
            float(np.linalg.norm(list(known.values()))),
            float(_norm(true_states, len(t)).max(initial=0.0)),
        )
    return out


def _norm(columns: Sequence[Array], count: int) -> Array:
    if not columns:
        return np.zeros(count)
    return np.asarray(np.linalg.norm(np.stack(columns), axis=0))


def _summary(folder: Path) -> dict[str, Any]:
    path = folder / "summary.json"
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise GpeboError(f"{path}: {error.strerror or error}") from error
    except ValueError:
        raise GpeboError(f"{path}: not JSON") from None
    if not isinstance(content, dict):
        raise GpeboError(f"{path}: not the summary of a run")
    return content


def _estimator(summary: Mapping[str, Any]) -> str:
    estimator = summary["estimator"]
    return str(estimator.get("name")) if isinstance(estimator, Mapping) else str(estimator)


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))
    except OSError as error:
        raise GpeboError(f"{path}: {error.strerror or error}") from error


def _columns(rows: Sequence[Mapping[str, str]]) -> dict[str, Array]:
    names = rows[0].keys() if rows else ()
    return {name: np.array([_number(row[name]) for row in rows]) for name in names}


def _number(text: str | None) -> float:
    try:
        return float(text) if text else np.nan
    except ValueError:
        return np.nan
