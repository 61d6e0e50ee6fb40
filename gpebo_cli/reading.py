"""Files that others wrote are opened here: only regular ones, of a bounded size."""

from __future__ import annotations

import os
import stat
from math import isfinite
from typing import Any, BinaryIO

from gpebo_cli.errors import ConfigError


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading: a device has no end, and a pipe may never begin.

    ConfigError: the file cannot be opened, or is a folder, a pipe, a socket or a device.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits until somebody writes to it.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path} cannot be read: {reason}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ConfigError(f"{path} is not a regular file")
    stream = os.fdopen(descriptor, "rb")
    try:
        stream.peek(1)
    except OSError as error:  # of /proc, for instance
        stream.close()
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    return stream


def read_bytes(path: str | os.PathLike[str], limit: int) -> bytes:
    """The content of a regular file of at most ``limit`` bytes (ConfigError)."""
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        content = stream.read(limit + 1) if size <= limit else b""
    if size <= limit and len(content) <= limit:
        return content
    raise ConfigError(f"{path} has {max(size, len(content))} bytes; at most {limit} are read")


def read_text(path: str | os.PathLike[str], limit: int) -> str:
    """The same as text in UTF-8 (ConfigError)."""
    try:
        return read_bytes(path, limit).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not text in UTF-8 (byte {error.start})") from error


def strict_json(text: str | bytes) -> Any:
    """The content of JSON text in which all numbers are finite (ValueError, RecursionError)."""
    import json

    return json.loads(
        text, parse_float=finite, parse_constant=finite,
        parse_int=lambda digits: int(digits) if finite(digits) else 0,
    )


def finite(value: str | float) -> float:
    """The number that ``value`` is (ValueError: it is none that is finite)."""
    number = float(value)
    if not isfinite(number):
        raise ValueError(f"{value} is not a finite number")
    return number


def beside(file: str, source: str, where: str) -> str:
    """Where a file that a plant names is: beside the plant's, in its ``--config-dir``, or here.

    Without the plant's file as ``source`` it is from Python, which may name any file. Elsewhere it
    is refused (ConfigError): a plant's file may be a stranger's.
    """
    if not source:
        return file
    own = os.path.dirname(os.path.abspath(source))
    group = os.path.basename(own) in ("plant", "regression")
    folder = os.path.dirname(own) if group else own
    folders = [own, folder, os.getcwd()]
    paths = [os.path.normpath(os.path.join(place, file)) for place in folders]
    path = next((found for found in paths if os.path.exists(found)), paths[-1])
    real, homes = os.path.realpath(path), map(os.path.realpath, folders)
    if not any(os.path.commonpath([real, home]) == home for home in homes):
        raise ConfigError(
            f"{where}: {file} lies outside of {folder} and of the current folder; copy it there"
        )
    return as_seen_from_here(path)


def as_seen_from_here(path: str) -> str:
    """A path, relative to the current folder where that is shorter."""
    return min(path, os.path.relpath(path), key=len)
