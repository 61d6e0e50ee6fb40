"""How long a loop will take, from how long it took so far: nobody waits for what never ends."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time

from gpebo_cli.errors import ConfigError

_LOOK = 1.0  # seconds after which a loop is known well enough
_MOST = 90.0  # seconds


class Pace:
    """Told how many of so many are done, and tells ``share``; refuses what would take minutes."""

    def __init__(self, count: int, what: str, share: Callable[[float], None]) -> None:
        self._count, self._what, self._share = count, what, share
        self._begin = process_time()

    def __call__(self, done: int) -> None:
        """So many are done.

        Raises:
            ConfigError: all of them would take longer than a run may.
        """
        spent = process_time() - self._begin
        needed = spent * self._count / done
        if done < self._count and spent > _LOOK and needed > _MOST:
            raise ConfigError(
                f"{self._count} {self._what} would take some {needed:.0f} s of computing time (the "
                f"first {done} took {spent:.1f} s); a run may take {_MOST:g} s"
            )
        self._share(done / self._count)
