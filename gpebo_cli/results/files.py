"""Files that appear complete or not at all: written beside under another name, then renamed."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from math import isnan
from pathlib import Path

from gpebo_cli.errors import GpeboError


def write_file(path: Path, chunks: Iterable[bytes]) -> None:
    """Write ``chunks`` to ``path``; a reader sees the old file, or none, until it is complete.

    There is no fsync: the promise is against interruption and a full disk, not a power cut, and
    waiting for the disk would cost more than computing what is written (GpeboError: the file cannot
    be written; its name and the system's reason are given).
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with open(beside, "wb") as stream:
                stream.writelines(chunks)
            os.replace(beside, path)
        except BaseException:  # KeyboardInterrupt too: nothing half-written stays behind
            beside.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise GpeboError(f"cannot write {path}: {error.strerror or error}") from error


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Whoever else enters this for ``folder`` waits, in other processes, too, until these end."""
    number = None
    try:
        with suppress(ImportError, OSError):  # Windows and some file systems have no such locks
            from fcntl import LOCK_EX, flock

            number = os.open(folder, os.O_RDONLY)
            flock(number, LOCK_EX)
        yield
    finally:
        if number is not None:
            os.close(number)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8; see :func:`write_file`."""
    write_file(path, [text.encode()])


def csv_text(rows: Iterable[Iterable[str]]) -> str:
    """Rows as CSV; the cells that need it are quoted."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def cell(value: float | None, digits: int = 17) -> str:
    """A number as CSV has it; nothing is known of None and NaN."""
    return "" if value is None or isnan(value) else f"{value:.{digits}g}"


def make_folder(path: Path) -> None:
    """Create the folder ``path`` and its parents; one that exists is kept (GpeboError)."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GpeboError(f"cannot create the folder {path}: {error.strerror or error}") from error


def remove_files(paths: Iterable[Path]) -> None:
    """Remove those of ``paths`` that exist (GpeboError: one of them cannot be removed)."""
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise GpeboError(f"cannot remove {path}: {error.strerror or error}") from error
