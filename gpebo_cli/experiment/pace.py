"""How long a loop will take, from how long it took so far: nobody waits for what never ends."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time

from gpebo_cli.errors import ConfigError

Loop = Callable[[int], None]  # told how many rounds of a loop are done
Pace = Callable[[int, str], Loop]  # how many rounds there are, and of what

_LOOK = 1.0  # seconds after which a loop is known well enough


def paced(count: int, what: str, limit: float, share: Callable[[float], None]) -> Loop:
    """What a loop of ``count`` rounds calls after each part of them, with how many are done.

    It refuses the loop if all of it would take longer than ``limit`` seconds of computing time
    (ConfigError), and hands on the share that is done.
    """
    begin = process_time()

    def _loop(done: int) -> None:
        spent = process_time() - begin
        needed = spent * count / done
        if done < count and spent > _LOOK and needed > limit:
            raise ConfigError(
                f"{count} {what} would take some {needed:.0f} s of computing time (the first "
                f"{done} took {spent:.1f} s), and a run may take {limit:g} s; to wait for them: "
                f"solver.max_seconds={float(f'{2 * needed:.1g}'):.0f}"
            )
        share(done / count)

    return _loop
