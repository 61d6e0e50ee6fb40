"""The tables of a run as pandas data frames: the same names and numbers as in its CSV files."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import EstimationResult, RunResult
from gpebo_cli.results import tables
from gpebo_cli.schema import nearest

if TYPE_CHECKING:
    from pandas import DataFrame

NAMES = ("signals", "regression", "excitation", "estimates", "cases")
"""Tables of a run; without an observer there is only the first."""


def frame(result: RunResult, name: str) -> DataFrame:
    """One table of a run.

    Args:
        result: the run.
        name: one of :data:`NAMES`.

    Returns:
        ``signals``, ``regression`` and ``excitation`` are indexed by ``t`` in seconds,
        ``estimates`` by ``case`` and ``t``, ``cases`` by ``case``.

    Raises:
        ConfigError: there is no table of that name, or this run does not have it.
    """
    if name not in NAMES:
        raise ConfigError(
            f"there is no table {name!r}; known: {', '.join(NAMES)}" + nearest(str(name), NAMES)
        )
    regression, estimation = result.regression, result.estimation
    builders: dict[str, Callable[[], DataFrame]] = {
        "signals": lambda: _by_time(tables.signals_table(result.system, result.signals))
    }
    if regression is not None:
        builders["regression"] = lambda: _by_time(tables.regression_table(regression))
    if (excitation := result.excitation) is not None:
        builders["excitation"] = lambda: _by_time(tables.excitation_table(excitation))
    if estimation is not None:
        builders["estimates"] = lambda: _estimates(result, estimation)
    if estimation is not None and (metrics := result.metrics) is not None:
        builders["cases"] = lambda: _cases(tables.cases_table(estimation, metrics))
    if name not in builders:
        raise ConfigError(f"this run has no table {name!r}: it was made with observer=none")
    return builders[name]()


def _by_time(table: tables.Table) -> DataFrame:
    from pandas import DataFrame, Index

    times = Index(table.rows[:, 0], name=table.header[0])
    return DataFrame(table.rows[:, 1:], columns=table.header[1:], index=times)


def _cases(table: tables.Table) -> DataFrame:
    from pandas import DataFrame, RangeIndex

    index = RangeIndex(len(table.rows), name="case")
    return DataFrame(table.rows, columns=table.header, index=index)


def _estimates(result: RunResult, estimation: EstimationResult) -> DataFrame:
    from pandas import DataFrame, MultiIndex

    names = tables.estimates_header(result.system.states, estimation)
    count = len(estimation.cases)
    index = MultiIndex.from_product([range(count), estimation.t], names=names[:2])
    values = tables.case_values(estimation, slice(None))[..., 2:]
    return DataFrame(values.reshape(len(index), -1), columns=names[2:], index=index)
