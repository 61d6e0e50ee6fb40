"""The numbers of a figure: its panels as a CSV table, and their comparison with a reference.

Tolerances of the comparison, for a curve ``y`` and its reference ``r``:

    |y − r| ≤ RELATIVE |r| + ABSOLUTE · max(size, max |r|)

``ABSOLUTE`` = 1e-9 is 100 times the solver's tolerance of 1e-11 of each signal's size: two
machines that round differently may choose other elements, and what each is allowed adds up over a
run. Errors below that share of the signal are the solver's, not the estimator's; they are 1e-14
here and 1e-13 there, and no one should be told.

``RELATIVE`` = 1e-3 is for the logarithmic figures. An error decays as e^(−I), I = γ∫Δ², so what
changes Δ by a share δ changes it by 2Iδ, and I is 21 where it reaches the level above. Of Δ, a
determinant, the tolerance of 1e-11 grows by the condition of its matrix, 3e4 when the parameters
begin to move: 1e-5; other nodes of the scalar laws add some 5e-5, as they do to the time to 1 %,
which is interpolated between them; the path through solve_ivp, another method, is off by 7e-4.
All of that passes, and none of it could be seen: a thousandth of a value is less than a tenth of a
line's width. A gain that is off by 2e-4 does not pass.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.results import files
from gpebo_cli.results.finished import read_columns
from gpebo_cli.results.style import MAX_PANELS, Panel, drawn

RELATIVE = 1e-3
ABSOLUTE = 1e-9

_REFERENCE_ROWS = 41


@dataclass(frozen=True)
class Column:
    """One curve: ``values`` (N,), NaN where nothing is drawn, and what they are judged by."""

    name: str
    values: Array
    log: bool = False
    size: float = 0.0


def blocks(panels: Sequence[Panel]) -> list[list[Column]]:
    """Everything that is drawn of ``panels``, curves over the same points behind these."""
    found: list[list[Column]] = []
    for panel in panels[:MAX_PANELS]:
        for curve in panel.curves:
            name = f"{panel.label}: {curve.label}" if curve.label else panel.label
            columns = [Column(name, drawn(panel, curve), panel.log, panel.size)]
            if curve.down_to is not None:
                columns.append(Column(f"{name}, lower edge", curve.down_to, panel.log, panel.size))
            for block in found:
                if np.array_equal(block[0].values, curve.x):
                    block.extend(columns)
                    break
            else:
                x = panel.axis.name
                found.append([Column(f"{x} of {name}" if found else x, curve.x), *columns])
        if panel.vertical is not None:
            time, name = panel.vertical
            found.append([Column(name, np.array([time]))])
    return found


def blocks_text(table: Sequence[Sequence[Column]], digits: int = 17) -> str:
    """A header and rows; blocks stand side by side, the shorter ones end in empty cells."""
    columns = [column for block in table for column in block]
    cells = ([files.cell(value, digits) for value in c.values.tolist()] for c in columns)
    return files.csv_text([[c.name for c in columns], *zip_longest(*cells, fillvalue="")])


def reference_text(panels: Sequence[Panel]) -> str:
    """The first block in 41 rows and 10 digits: small enough to be committed."""
    first = blocks(panels)[0]
    last = len(first[0].values) - 1
    rows = np.unique(np.linspace(0, last, _REFERENCE_ROWS).round().astype(np.intp))
    return blocks_text([[replace(c, values=c.values[rows]) for c in first]], digits=10)


def differences(panels: Sequence[Panel], reference: Path) -> Iterator[str]:
    """Curves of ``panels`` that differ from those in a file that :func:`reference_text` made.

    One line per curve: which one, where it differs most and by how much.
    """
    over, *columns = blocks(panels)[0]
    table = read_columns(reference, over.name)
    x, ours = table.pop(over.name), {column.name: column for column in columns}
    for name in ours.keys() - table.keys():
        yield f"{name}: there is no such curve in the reference"
    near = np.abs(over.values[:, None] - x).argmin(axis=0)
    if not np.allclose(over.values[near], x, rtol=1e-9, atol=1e-9 * float(np.ptp(over.values))):
        yield f"{over.name} does not have the values of the reference among its own"
        return
    for name, expected in table.items():
        column = ours.get(name)
        if column is None:
            yield f"{name}: there is no such curve any more"
        elif found := _difference(column, near, expected):
            k, text = found
            yield f"{name}: at {over.name} = {x[k]:.6g} {text}"


def _difference(column: Column, rows: Array, reference: Array) -> tuple[int, str] | None:
    """Row of the largest difference, in tolerances, and a text; None if all is within."""
    values = column.values[rows]
    if column.log:  # what is not drawn there is zero, and zero or 1e-17 is the same to us
        values, reference = np.nan_to_num(values), np.nan_to_num(reference)
    size = max(column.size, float(np.nanmax(np.abs(reference), initial=0.0)))
    allowed = RELATIVE * np.abs(reference) + ABSOLUTE * size
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.abs(values - reference) / allowed
    excess = np.where(np.isnan(values) == np.isnan(reference), np.nan_to_num(excess), np.inf)
    k = int(excess.argmax())
    if excess[k] <= 1.0:
        return None
    return k, (
        f"it is {values[k]:.6g}, the reference {reference[k]:.6g}; they differ by "
        f"{abs(values[k] - reference[k]):.2g}, {allowed[k]:.2g} is allowed"
    )
