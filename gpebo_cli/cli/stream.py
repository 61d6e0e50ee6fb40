"""``gpebo run data.file=-``: rows from standard input, estimates to standard output.

Whatever has arrived is one batch: a row never waits for the next one, and rows that come faster
than they can be treated one by one are treated together. A batch is a bounded piece of input.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.stream import Stream
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.recordings.table import LineReader, samples
from gpebo_cli.settings import Settings

_PIECE = 1 << 15  # bytes read at once, some 600 rows: as fast as larger ones
_SOURCE = "standard input"


def run(settings: Settings, system: DescriptorSystem) -> int:
    """Treat rows until standard input ends; the verdict goes to stderr.

    Raises:
        ConfigError: a row is wrong, or there is none; estimates of the rows before it are out.
        ModelError: an assumption fails.
    """
    stream = Stream(settings, system)
    reader = LineReader(_SOURCE, system)
    started = False
    while True:
        piece = os.read(0, _PIECE)
        rows, wrong = reader.feed(piece, last=not piece)
        if rows and reader.header is not None:
            table = stream.feed(samples(reader.header, np.array(rows), system))
            _write(_text(table) if started else _line(stream.columns) + _text(table))
            started = True
        if wrong:
            raise ConfigError(wrong)
        if not piece:
            break
    if not started:
        what = "is empty" if reader.header is None else "has no rows below its header"
        raise ConfigError(f"{_SOURCE} {what}")
    sys.stderr.write(f"{stream.verdict}\n")
    return 0


def _line(names: list[str]) -> str:
    return ",".join(names) + "\n"


def _text(table: Array) -> str:
    line = ",".join(["%.17g"] * table.shape[1]) + "\n"
    text = line * len(table) % tuple(table.ravel().tolist())
    return text.replace("nan", "") if np.isnan(table).any() else text


def _write(text: str) -> None:
    with _uninterrupted():  # Ctrl-C leaves whole rows behind
        sys.stdout.write(text)
        sys.stdout.flush()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C waits for the end of the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
