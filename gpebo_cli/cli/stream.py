"""``gpebo run data.file=-``: rows from standard input, estimates to standard output.

Whatever has arrived is one batch: a row never waits for the next one, and rows that come faster
than they can be treated one by one are treated together. A batch is a bounded piece of input.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterable

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.pipeline import stream, stream_verdict
from gpebo_cli.experiment.verdict import rows_note
from gpebo_cli.kernels.threads import one_thread
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.recordings.lines import LineReader, samples
from gpebo_cli.results.tables import rows_text
from gpebo_cli.settings import Settings

_PIECE = 1 << 15  # bytes read at once, some 600 rows: as fast as larger ones
_SOURCE = "standard input"


@one_thread
def run(settings: Settings, system: DescriptorSystem) -> int:
    """Treat rows until standard input ends; the verdict goes to stderr (ConfigError)."""
    begin, online = stream(settings, system), None
    reader = LineReader(_SOURCE, settings.data, system)
    while True:
        piece = os.read(0, _PIECE)
        rows, wrong = reader.feed(piece, last=not piece)
        if rows and reader.header is not None:
            came = samples(reader.header, np.array(rows), system)
            first = online is None
            if online is None:
                online = begin(float(came.t[0]), np.append(came.inputs[0], came.outputs[0]))
            made = online.feed(came.t, came.inputs, came.outputs)
            names = (*online.parameters, *system.states)
            header = ["t", *(f"{name}_hat" for name in names), "lambda_min"]
            estimates = np.hstack([made.parameters[0], made.states[0]])
            columns = [came.t, estimates, made.gram_eigenvalues[:, :1]]
            if made.std is not None and made.level is not None and made.by_noise is not None:
                header += [f"{name}_std" for name in names]
                std = made.std[0] * made.level[:, None]  # NaN: the estimates explain any rows
                known = made.by_noise[0][:, None] & ~np.isnan(std)
                columns.append(np.where(known, std, np.inf))
            head = [",".join(header).encode() + b"\n"] if first else []
            _write([*head, *rows_text(np.column_stack(columns))])
        if wrong:
            raise ConfigError(wrong)
        if not piece:
            break
    if online is None:
        what = "is empty" if reader.header is None else "has no rows below its header"
        raise ConfigError(f"{_SOURCE} {what}")
    note = rows_note(reader.left_out, reader.filled, settings.data.missing)
    sys.stderr.write(f"{stream_verdict(online)}{note}\n")
    return 0


def _write(texts: Iterable[bytes]) -> None:
    """To standard output; Ctrl-C waits meanwhile, and leaves whole rows behind."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        sys.stdout.write(b"".join(texts).decode())
        sys.stdout.flush()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
