"""The tables of a run as pandas data frames: the same names and numbers as in its CSV files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.results.tables import TABLES
from gpebo_cli.schema import unknown

if TYPE_CHECKING:
    from pandas import DataFrame


def frame(result: RunResult, name: str) -> DataFrame:
    """One table of a run.

    Args:
        result: the run.
        name: one of :data:`gpebo_cli.results.tables.TABLES`.

    Returns:
        ``signals``, ``regression`` and ``excitation`` are indexed by ``t`` in seconds,
        ``estimates`` by ``case`` and ``t``, ``cases`` by ``case``.

    Raises:
        ConfigError: there is no table of that name, or this run does not have it.
    """
    if name not in TABLES:
        raise unknown(f"there is no table {name!r}", name, TABLES)
    table = TABLES[name](result)
    if table is None:
        raise ConfigError(f"this run has no table {name!r}: it was made with observer=none")
    from pandas import DataFrame

    found = DataFrame(np.concatenate(list(table.pieces)), columns=table.header)
    keys = table.header[:2] if name == "estimates" else table.header[:1]
    return found.astype({key: int for key in keys if key == "case"}).set_index(keys)
