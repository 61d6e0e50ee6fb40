"""A recording as a table: samples of a CSV, Parquet or MAT file, or of a data frame.

Of a CSV file NumPy reads the rows; where it meets anything but plain numbers they are read again
one by one, see :mod:`.lines`.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
from array import array
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.archive import read_mat
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.reading import read_bytes
from gpebo_cli.recordings.hold import each_of, holds
from gpebo_cli.recordings.lines import (
    BLANK,
    TIME,
    Header,
    RowReader,
    Samples,
    read_header,
    samples,
    seconds,
    separator,
    split_cells,
)
from gpebo_cli.schema import LARGEST, shown
from gpebo_cli.settings import DataSettings

if TYPE_CHECKING:
    from pandas import DataFrame

# Quotes, and what NumPy takes for spaces or the end of a line; or there are no rows at all.
_UNUSUAL = re.compile(rb'["\0\v\f\r\x1c-\x1f\x80-\xff]|\A\s*\Z')
_MOST_BYTES, _MOST_CELLS = 500_000_000, 25_000_000


@dataclass(frozen=True, eq=False)
class Table:
    """A whole recording: its samples and where they are from."""

    header: Header
    samples: Samples
    lines: tuple[int, int]  # of the first and of the last sample
    sha256: str
    left_out: int  # rows with gaps, or before the first sample of a column
    filled: int  # cells of inputs and outputs in rows
    measured: BoolArray  # (N,) that have a sample of an output; the others have no error of it


def read_table(data: DataSettings, system: DescriptorSystem) -> Table:
    """Read the recording that ``data`` names: CSV, Parquet, MAT, or a data frame (ConfigError)."""
    time = (data.columns or {}).get(TIME, TIME)
    if data.frame is not None:
        import pandas as pd

        if not isinstance(data.frame, pd.DataFrame):
            raise ConfigError(
                "data: expected a file, a list of files or one pandas.DataFrame, got "
                f"{shown(data.frame)}"
            )
        return _from_frame("data", _indexed(data.frame, time), data, system, "")
    if not data.file:
        raise ConfigError("data=csv needs data.file=FILE, or data.file=- for standard input")
    if not isinstance(data.file, str):
        raise ConfigError("data.file: here one file is needed, not several")
    path, content = data.file, read_file(data.file)
    sha256 = hashlib.sha256(content).hexdigest()
    frame = typed_table(path, content, time)
    if frame is not None:
        return _from_frame(path, frame, data, system, sha256)
    check_text(path, content)
    content = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n")
    end = content.find(b"\n", len(content.rstrip(BLANK + b"\n")))  # of the last line of all
    content = content if end < 0 else content[:end]
    if not content.strip(BLANK):
        raise ConfigError(f"{path} is empty; expected a header and rows")
    first, _, body = content.partition(b"\n")
    header = read_header(path, split_cells(path, 1, first.decode(), data), data, system)
    values = _read_body(header, data, body)
    if len(values) < 2:
        raise ConfigError(f"{path} has {len(values)} rows below its header; at least 2 are needed")
    return _table(header, data, values, system, sha256, first_line=2)


def read_file(path: str) -> bytes:
    """The content of a regular file: a device or a pipe might never end (ConfigError)."""
    if os.path.isdir(path):
        raise ConfigError(f"data.file: {path} is a folder, not a file")
    try:
        return read_bytes(path, _MOST_BYTES)
    except ConfigError as error:
        raise ConfigError(f"data.file: {error}") from None


def check_text(path: str, content: bytes) -> None:
    """Refuse what is not UTF-8, by its line (ConfigError: says which line it is)."""
    try:
        content.decode()
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        utf16 = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        what = " (it is UTF-16)" if utf16 else ""
        raise ConfigError(f"{path}, line {line}: not UTF-8 text{what}; save it as UTF-8") from None


def _without_gaps(data: DataSettings, values: Array, system: DescriptorSystem) -> BoolArray:
    """Fills gaps in rows (N, columns) as ``data.missing`` wants it; which rows are kept (N,).

    What is interpolated is what is assumed between samples: of a signal that is held the last one.

    Signals begin one after the other where they are of different rates: rows before the last one
    has begun are left out, and between samples those after the first one has ended.
    """
    there = ~np.isnan(values)
    if data.missing == "drop":
        return np.asarray(there.all(axis=1))
    kept = np.logical_or.accumulate(there).all(axis=1)
    if data.missing == "interpolate":
        kept &= np.logical_or.accumulate(there[::-1])[::-1].all(axis=1)
    words = ("", *each_of(holds(data.hold, system), system.m + system.r))
    for k in np.flatnonzero(~there.all(axis=0) & there.any(axis=0)):
        known = np.flatnonzero(there[:, k])
        if data.missing == "hold" or words[k : k + 1] == ("zoh",):
            last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
            values[:, k] = values[known[last], k]
        else:
            values[:, k] = np.interp(values[:, 0], values[known, 0], values[known, k])
    return np.asarray(kept)


def _table(
    header: Header, data: DataSettings, values: Array, system: DescriptorSystem, sha256: str,
    first_line: int,
) -> Table:
    count, gaps = len(values), np.isnan(values[:, 1 : 1 + system.m + system.r])
    kept = np.flatnonzero(_without_gaps(data, values, system))
    if len(kept) < 2:
        raise ConfigError(f"{header.source} has {len(kept)} rows without gaps; 2 are needed")
    if len(kept) < len(values):
        values = values[kept]
    found = samples(header, values, system)
    lines = first_line + int(kept[0]), first_line + int(kept[-1])
    gaps = gaps[kept]
    measured: BoolArray = np.asarray(~gaps[:, system.m :].all(axis=1) | (system.r == 0))
    filled = int(gaps[measured].sum())
    return Table(header, found, lines, sha256, count - len(kept), filled, measured)


def _read_body(header: Header, data: DataSettings, body: bytes) -> Array:
    """The rows below the header, (N, columns): by NumPy, or one by one."""
    if data.time_unit != "datetime" and not data.gaps and _UNUSUAL.search(body) is None:
        values = _plain_rows(header, data, body)
        if values is not None and (np.diff(values[:, 0]) > 0).all():
            return values
    reader, numbers = RowReader(header, data), array("d")
    for line, text in enumerate(body.split(b"\n") if body else (), start=2):
        cells = split_cells(header.source, line, text.decode(), data)
        numbers.extend(reader.read(line, cells))
    return np.array(numbers).reshape(-1, len(header.names))


def _plain_rows(header: Header, data: DataSettings, body: bytes) -> Array | None:
    """Rows of nothing but numbers, which are all as wide as the header, or None."""
    if data.decimal != ".":
        if b"." in body:
            return None
        body = body.replace(data.decimal.encode(), b".")
    kinds = [(str(k), "f8" if k in header.positions else "S1") for k in range(header.width)]
    try:
        rows = np.loadtxt(
            io.BytesIO(body), kinds, comments=None, delimiter=separator(data), ndmin=1
        )
    except ValueError:
        return None
    values = np.stack([rows[str(k)] for k in header.positions], axis=1) * header.scale
    whole = len(rows) == body.count(b"\n") + 1  # it passes over empty lines
    return values if whole and (np.abs(values) <= LARGEST).all() else None


def typed_table(path: str, content: bytes, time: str = TIME) -> DataFrame | None:
    """A Parquet or MAT file, as its name ends, else None (ConfigError).

    Of a MAT file the vectors that are as long as that of the ``time``, or the longest, and the
    columns of matrices as ``<name>_1``, ``<name>_2``, …
    """
    import pandas as pd

    kind = os.path.splitext(path)[1].lower()
    if kind == ".parquet":
        try:
            from pyarrow.parquet import (  # type: ignore[import-not-found,import-untyped,unused-ignore]
                read_metadata,
            )

            head = read_metadata(io.BytesIO(content))
            cells = head.num_rows * head.num_columns
            if cells <= _MOST_CELLS:
                return _indexed(pd.read_parquet(io.BytesIO(content), engine="pyarrow"), time)
        except ImportError:
            raise ConfigError(
                f"data.file: {path} needs pyarrow: pip install 'gpebo[parquet]'"
            ) from None
        except Exception as error:  # a stranger's bytes: whatever a library says of them
            raise ConfigError(f"data.file: {path} cannot be read as {kind}: {error}") from error
        raise ConfigError(f"data.file: {path} has {cells} cells; at most {_MOST_CELLS} are read")
    if kind != ".mat":
        return None
    arrays = {k: v.squeeze() for k, v in read_mat(path).items() if isinstance(v, np.ndarray)}
    sizes = [max(array.shape, default=0) for array in arrays.values()]
    rows = arrays[time].size if time in arrays else max(sizes, default=0)
    columns: dict[str, Any] = {}
    for name, found in arrays.items():
        wide = found.T if found.shape[1:] == (rows,) else found
        if wide.shape == (rows,):
            columns[name] = wide
        elif wide.shape[:1] == (rows,) and wide.ndim == 2:
            columns |= {f"{name}_{j}": column for j, column in enumerate(wide.T, start=1)}
        elif wide.ndim:  # shown, where a signal is looked for
            columns[f"{name} ({'x'.join(map(str, wide.shape))} numbers)"] = np.nan
    if not any(np.ndim(column) for column in columns.values()):
        raise ConfigError(
            f"data.file: {path} has no vectors of numbers; fields of a struct can be saved as such "
            "(save FILE -struct NAME)"
        )
    return pd.DataFrame(columns)


def _indexed(frame: DataFrame, time: str) -> DataFrame:
    """With the index as a column, if it has a name or is made of times."""
    index = frame.index
    if index.name is None and index.dtype.kind not in "mM":
        return frame
    name = time if index.name is None else str(index.name)
    return frame.rename_axis(index=name).reset_index()


def _from_frame(
    source: str, frame: Any, data: DataSettings, system: DescriptorSystem, sha256: str
) -> Table:
    """The recording in a data frame."""
    header = read_header(source, [str(name) for name in frame.columns], data, system)
    if len(frame) < 2:
        raise ConfigError(f"{source} has {len(frame)} rows; at least 2 are needed")
    columns = []
    for name, k, scale in zip(header.names, header.positions, header.scale, strict=True):
        column, of_time = frame.iloc[:, k], k == header.positions[0]
        kind = column.dtype.kind
        if kind in "mM":
            column = column - column.min() if kind == "M" else column  # the first may be no time
            values = column.dt.total_seconds().to_numpy(dtype=np.float64)
        elif kind in "iuf":
            values = column.to_numpy(dtype=np.float64, na_value=np.nan)
            if not of_time:
                values = np.where(np.isin(values, data.gaps or ()), np.nan, values)
            values = values * scale
        elif of_time and data.time_unit == "datetime":
            values, _ = seconds([str(cell) for cell in column], None)
        else:
            raise ConfigError(
                f"{source}, column {name}: {column.dtype} is not numbers"
                + "; data.time_unit=datetime reads dates" * of_time
            )
        columns.append(values)
    values = np.column_stack(columns)
    wrong = np.abs(values) > LARGEST
    if data.missing == "refuse":
        wrong |= np.isnan(values)
    if data.missing != "drop":
        wrong[:, 0] |= np.isnan(values[:, 0])
    for row, k in np.argwhere(wrong)[:1]:
        raise ConfigError(
            f"{source}, row {row}, column {header.names[k]}: {values[row, k]} is no number "
            f"within ±{LARGEST:g}"
            + "; data.missing says what to do about gaps" * bool(np.isnan(values[row, k]))
        )
    if data.missing == "drop":
        values[1:][np.diff(values[:, 0]) == 0.0] = np.nan
    t = values[~np.isnan(values[:, 0]), 0]
    for row in np.flatnonzero(np.diff(t) <= 0)[:1]:
        before, after = t[row : row + 2].tolist()
        raise ConfigError(
            f"{source}, column {header.names[0]}: {after!r} follows {before!r}; times must increase"
        )
    return _table(header, data, values, system, sha256, first_line=0)
