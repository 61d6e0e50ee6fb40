"""Plants from where engineers have them: netlists, mechanics, matrices, models of python-control.

Everything here makes a :class:`~gpebo_cli.importers.draft.PlantDraft`; ``to_yaml()`` is the text of
a plant file as a person would write it, ``mapping()`` the same as data.
"""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from gpebo_cli.errors import ConfigError
from gpebo_cli.importers.circuit import circuit_from_netlist
from gpebo_cli.importers.draft import PlantDraft
from gpebo_cli.importers.matrices import from_control, from_matrices, read_matrices
from gpebo_cli.importers.mechanics import from_mechanics
from gpebo_cli.importers.netlist import split_names
from gpebo_cli.model.archive import MATRICES
from gpebo_cli.reading import read_text

__all__ = [
    "PlantDraft", "from_control", "from_file", "from_matrices", "from_mechanics", "from_netlist",
]

NETLISTS = (".cir", ".net", ".sp", ".spice", ".ckt")
"""Endings of SPICE netlists."""

_MAX_TEXT = 5_000_000  # bytes of a netlist or a mechanical model


def from_netlist(
    netlist: str | PathLike[str], name: str = "circuit", *,
    measure: str | Iterable[str] | None = None, unknown: str | Iterable[str] | None = None,
) -> PlantDraft:
    """A plant from a SPICE netlist by modified nodal analysis.

    The netlist is its text (more than one line) or its path. Outputs to ``measure`` are such as
    ``"v(out), y=i(L1)+i(V)"``, by default the voltages of ``.save``; ``unknown`` names constant
    sources whose values are to be estimated, ``"I5,V3"``.

    Returns:
        The plant; its comments say what the topology says of the index.

    Raises:
        ConfigError: names the line, the element, or the quantity, and what would be accepted.
    """
    text, file = fspath(netlist), f"netlist {name}"
    if "\n" not in text:
        text, file = read_text(text, _MAX_TEXT), text
    return circuit_from_netlist(text, name, file, measure, unknown)


def from_file(
    path: str | PathLike[str], name: str, *, measure: str | None = None, unknown: str | None = None
) -> PlantDraft:
    """A plant from a file: a netlist, a mechanical model in YAML, or matrices.

    Args:
        path: ``.cir .net .sp .spice .ckt`` is a netlist; ``.yaml`` a mechanical model with M, D, K,
            G; ``.mat``, ``.npz``, ``.py``, ``.m``, ``.jl`` and a folder of ``.mtx`` are matrices.
        name: of the plant.
        measure: outputs; of a netlist as for :func:`from_netlist`, else names of states.
        unknown: constant inputs whose values are to be estimated.

    Raises:
        ConfigError: names the file, the place in it, and what would be accepted.
    """
    file = Path(path)
    if file.suffix.lower() in NETLISTS:
        return from_netlist(file, name, measure=measure, unknown=unknown)
    if file.suffix.lower() in (".yaml", ".yml"):
        from gpebo_cli.plain_yaml import parse

        content = parse(read_text(path, _MAX_TEXT), str(path))
        if not isinstance(content, dict):
            raise ConfigError(f"{path}: expected a mapping with M, D, K, G")
        draft = from_mechanics(content, name, str(path))
    else:
        found: dict[str, Any] = read_matrices(file)
        matrices = {key: found.pop(key) for key in MATRICES if key in found}
        draft = from_matrices(matrices, name, reference=str(path), **found)
    if measure is not None:
        draft.measure(split_names(measure), f"{path}: ")
    draft.make_unknown(split_names(unknown))
    return draft
