"""What can go wrong, as values a person can read.

Every error the program raises on purpose is a :class:`GpeboError`: one sentence that names the
file, key, entry or time, and what would be accepted. The command line prints it as one line and
returns :attr:`GpeboError.exit_code`; anything else that escapes is a bug.
"""

from __future__ import annotations

from collections.abc import Callable

_MOST = 2.0  # GB


def printable(text: str) -> str:
    """The text on one line; what would command a terminal in it is written as it is in Python."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class GpeboError(Exception):
    """A run or a check that failed for a reason its user can act on (exit code 1)."""

    exit_code = 1

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))  # it may repeat names of somebody else's file


class ConfigError(GpeboError):
    """Wrong usage or configuration: unknown key, wrong type or shape, hostile text (exit 2)."""

    exit_code = 2


class ModelError(GpeboError):
    """The model itself cannot be used: index too high, not uniquely solvable, rank of E changes."""


class SolverError(GpeboError):
    """The solver cannot reach the tolerance it was asked for."""


def check_memory(
    what: str, numbers: float, accepted: Callable[[float], str] | None = None
) -> None:
    """Refuse what would hold more than a run may: a machine that swaps stands still.

    ``what`` asks for it, the setting and its value; it would hold so many ``numbers`` of 8 bytes
    each, estimated. ``accepted`` says what would be, of the share of them that a run may hold.

    Raises:
        ConfigError: names the setting, what it would need, and the limit.
    """
    size = 8e-9 * numbers
    if size > _MOST:
        told = f"; {accepted(_MOST / size)}" if accepted else ""
        raise ConfigError(
            f"{what} would take some {size:.3g} GB of memory; a run may take {_MOST:g} GB{told}"
        )
