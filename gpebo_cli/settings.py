"""Everything a run can be told, as frozen dataclasses with their defaults.

These are the only description of a run below the command layer: no Hydra, no files. The reader
in ``schema.py`` builds them from a plain mapping and refuses keys that are not fields here.
The plant, the observer and the estimator are described by their own modules, found by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, Literal

Between = Literal["zoh", "linear", "cubic"]  # what is assumed between samples


def within(default: float, low: float, high: float = inf) -> Any:
    """A field whose number is refused outside of a range: beyond it nothing sensible happens."""
    return field(default=default, metadata={"range": (low, high)})


def positive(default: float | None) -> Any:
    """A field whose number is refused unless it is positive."""
    return field(default=default, metadata={"positive": True})


@dataclass(frozen=True)
class TimeSettings:
    """The experiment runs on [start, start + horizon], in seconds; ``samples`` is the output grid.

    With a recording, a start of −∞ is its first sample and a horizon of ∞ lasts to its last one.
    """

    start: float = 0.0  # seconds
    horizon: float = positive(20.0)  # seconds
    samples: int = within(1001, 2, 1_000_000)


@dataclass(frozen=True, kw_only=True)
class TableFormat:
    """How a file has its samples."""

    time_unit: Literal["s", "ms", "min", "h", "datetime"] = "s"  # of t in the file
    separator: str = ","  # between cells: a character, or comma, semicolon, tab, space
    decimal: Literal[".", ","] = "."
    missing: Literal["refuse", "hold", "interpolate", "drop"] = "refuse"  # of empty cells and nan
    gaps: list[float] | None = None  # numbers in the file that mean the same as an empty cell


@dataclass(frozen=True)
class DataSettings(TableFormat):
    """Where u and y come from: the simulated plant, or a recording."""

    name: Literal["none", "csv"] = "none"
    # CSV, Parquet or MAT; "-" is standard input, as CSV; several are experiments with the same θ.
    file: str | list[str] | None = None
    # What is assumed between samples, of all signals or by name; without one, lines.
    hold: Between | Mapping[str, Between] = "linear"
    columns: Mapping[str, str] | None = None  # what a signal (t, V, y) is called in the file
    scale: Mapping[str, float] | None = None  # by signal: from the file's unit to ours
    frame: object = None  # from Python: a pandas.DataFrame in place of a file


@dataclass(frozen=True)
class SolverSettings:
    """How differential equations are integrated; ``tol`` is relative to each signal's own size."""

    name: Literal["collocation", "ivp"] = "collocation"
    tol: float = within(1e-12, 1e-15, 0.1)
    stages: int = within(14, 2, 16)  # Radau IIA stages per element, order 2 * stages - 1
    max_elements: int = within(200_000, 1)
    max_seconds: float = within(90.0, 1)  # of computing: cases, seeds, samples, windows
    max_strangeness_index: int = within(6, 0, 20)
    # Singular values below rank_tol * (size of the factors) are zero.
    rank_tol: float = within(1e-10, 1e-15, 0.1)


@dataclass(frozen=True)
class NoiseSettings:
    """Sampled noise on what the observer sees; the plant does not feel it."""

    name: str = "none"
    sample_time: float = positive(0.01)  # seconds; elements end at the sample instants
    # Standard deviation of every sample: one for all, by order, or by name (absent: zero).
    outputs: float | list[float] | Mapping[str, float] = 0.0
    inputs: float | list[float] | Mapping[str, float] = 0.0
    # Step to which a noisy output is rounded, likewise; zero: not rounded.
    quantisation: float | list[float] | Mapping[str, float] = 0.0
    # Between samples: the last one, or the one signal without frequencies above 1/(2 sample_time).
    shape: Literal["hold", "band_limited"] = "hold"
    seed: int = within(0, 0)
    # More than one: statistics of the estimates over seed, seed + 1, ….
    seeds: int = within(1, 1, 10_000)


@dataclass(frozen=True)
class ExcitationSettings:
    """Level and window of the excitation evidence."""

    # Level asked of lambda_min(G); None: none, the verdict knows no unit.
    rho: float | None = positive(None)
    window: float | None = positive(None)  # of the PE level, in seconds; None: horizon / 10


@dataclass(frozen=True)
class OutputSettings:
    """What is drawn, how it looks and how much is written."""

    figures: bool | list[str] = True  # True: all, False: none, or names of figures
    formats: list[Literal["png", "pdf", "svg"]] = field(default_factory=lambda: ["png"])
    width: Literal["column", "page"] | float = "column"  # of a two-column journal, or inches
    dpi: int = within(200, 30, 1200)
    style: str | None = None  # one that comes with matplotlib; None: ours
    error: Literal["log", "linear"] = "log"  # |error| on a logarithmic axis, or with its sign
    max_rows: int = within(100_000, 2)  # of estimates.csv; many cases keep fewer samples each
    parquet: bool = False  # each table also as a Parquet file


@dataclass(frozen=True)
class Settings:
    """One run, complete but for its plant."""

    estimator: Mapping[str, object]
    time: TimeSettings = field(default_factory=TimeSettings)
    solver: SolverSettings = field(default_factory=SolverSettings)
    observer: Mapping[str, object] = field(default_factory=lambda: {"name": "gpebo"})
    excitation: ExcitationSettings = field(default_factory=ExcitationSettings)
    output: OutputSettings = field(default_factory=OutputSettings)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    data: DataSettings = field(default_factory=DataSettings)
    uncertainty: bool = True  # one standard deviation of every estimate, where noise is known
