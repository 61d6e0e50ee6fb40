"""Inputs given as tables of samples, so that what was recorded drives a simulation.

    inputs: {u: {file: u.csv, column: u, hold: linear}}

Between samples an input is a polynomial of t, with the derivatives that a plant of higher index
needs. Elements end at the samples where it jumps or bends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.archive import ARCHIVE
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.model.text import Piecewise, TextCoefficients
from gpebo_cli.reading import beside
from gpebo_cli.recordings.hold import bends
from gpebo_cli.recordings.lines import TIME
from gpebo_cli.recordings.table import read_table
from gpebo_cli.schema import keys, read
from gpebo_cli.settings import Between, DataSettings, TableFormat


@dataclass(frozen=True)
class _Given(TableFormat):
    """What a plant's file says of such an input; keys as of ``data``."""

    file: str
    column: str | None = None  # by default the input's name
    time: str = TIME  # the column of times
    hold: Between = "linear"
    scale: float = 1.0


def tables(
    inputs: object, where: str, source: str = ""
) -> tuple[object, dict[str, Piecewise]]:
    """The inputs of a plant's file ``source`` with zero for each table, and the tables by name."""
    if not isinstance(inputs, Mapping):
        return inputs, {}
    found = {
        str(name): _piecewise(str(name), given, f"{where}.{name}", source)
        for name, given in inputs.items() if isinstance(given, Mapping)
    }
    return {name: 0 if str(name) in found else value for name, value in inputs.items()}, found


def driven(system: DescriptorSystem, found: Mapping[str, Piecewise]) -> DescriptorSystem:
    """The system with tables in place of the inputs of their names."""
    text = cast(TextCoefficients, system.coefficients)  # a plant of a file is text
    numbers = {system.inputs.index(name): table for name, table in found.items()}
    return replace(system, coefficients=text.with_tables(numbers))


def located(mapping: Mapping[str, object], source: str) -> Mapping[str, object]:
    """A plant's mapping with the paths of its other files as they are from here."""
    if isinstance(mapping.get(ARCHIVE), str):
        mapping = {**mapping, ARCHIVE: beside(str(mapping[ARCHIVE]), source, ARCHIVE)}
    key = "signals" if "psi" in mapping else "inputs"
    inputs = mapping.get(key)
    if not isinstance(inputs, Mapping):
        return mapping
    return {**mapping, key: {
        name: {**given, "file": beside(given["file"], source, f"{key}.{name}.file")}
        if isinstance(given, Mapping) and isinstance(given.get("file"), str) else given
        for name, given in inputs.items()
    }}


def _piecewise(name: str, content: Mapping[str, object], where: str, source: str) -> Piecewise:
    given = read(_Given, content, where)
    path = beside(given.file, source, f"{where}.file")
    column = given.column or name
    data = DataSettings(
        file=path, columns={TIME: given.time, name: column}, scale={name: given.scale},
        **{key: getattr(given, key) for key in keys(TableFormat)},
    )
    alone = DescriptorSystem(  # of which the table is a recording; its matrices are not read
        where, (), None, np.zeros(0), inputs=(name,),  # type: ignore[arg-type]
    )
    try:
        samples = read_table(data, alone).samples
    except ConfigError as error:
        text = str(error).removeprefix("data.file: ").partition("; plant ")[0]
        raise ConfigError(f"{where}: {text}") from error
    t, values = samples.t, samples.inputs[:, 0]
    if given.hold == "cubic":
        from scipy.interpolate import CubicSpline

        pieces, corners = CubicSpline(t, values).c[::-1], t[1:-1]
    else:
        pieces = values[None, :-1]
        if given.hold == "linear":
            pieces = np.stack([pieces[0], np.diff(values) / np.diff(t)])
        corners = t[bends(t, values[:, None], given.hold)]
    return Piecewise(f"{where}: {path}", t, np.asarray(pieces), corners)
