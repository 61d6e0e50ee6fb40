"""The process ``gpebo`` from its first moment: Ctrl-C is obeyed before anything else is loaded.

Importing this takes the signal over, so only what starts the process imports it.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # signal, whose enumerations take long to load
import os

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def _leave(*_: object) -> NoReturn:
    os.write(2, b"gpebo: error: interrupted\n")
    os._exit(130)


_signal.signal(_signal.SIGINT, _leave)


def entry() -> None:
    """The command line, see :func:`gpebo_cli.cli.app.entry`."""
    from gpebo_cli.cli import app

    app.entry()
