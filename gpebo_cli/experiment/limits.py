"""What a run may take, of memory and of time: refused before it is spent, not after.

Memory is estimated before it is allocated, for a machine that swaps stands still; how long a loop
will take follows from how long it took so far.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from time import process_time

import numpy as np

from gpebo_cli.errors import ConfigError, check_memory
from gpebo_cli.experiment.noise import NoiseLevels
from gpebo_cli.experiment.sources import kept_samples
from gpebo_cli.model.descriptor import DescriptorSystem, differential_order
from gpebo_cli.settings import Settings

Loop = Callable[[int], None]  # told how many rounds of a loop are done
Pace = Callable[[int, str], Loop]  # how many rounds there are, and of what

_LOOK = 1.0  # seconds after which a loop is known well enough
_HELD = 4  # arrays of every kind that are alive at once; measured


def check(settings: Settings, system: DescriptorSystem, levels: NoiseLevels, cases: int) -> None:
    """Refuse a run that would need more memory than one run may."""
    for what, numbers in _needs(settings, system, levels, cases, system.n).items():
        try:
            check_memory(what, numbers)
        except ConfigError:
            # The rank of E, which takes a while to find, makes it less.
            start = settings.time.start
            start = start if np.isfinite(start) else 0.0  # of a recording: its own
            rank = differential_order(system, start)
            check_memory(what, _needs(settings, system, levels, cases, rank)[what])


def check_at_samples(cases: int, samples: int, system: DescriptorSystem) -> None:
    """The same of estimates at samples."""
    numbers = 2 * _HELD * cases * samples * (system.q + 2 * system.n)
    check_memory(f"{cases} cases at {samples} samples", numbers)


def _needs(
    settings: Settings, system: DescriptorSystem, levels: NoiseLevels, cases: int, rank: int
) -> dict[str, float]:
    """Numbers held by the setting that asks for them, where E has so large a rank."""
    time, n, signals = settings.time, system.n, system.m + system.r
    p = system.q + rank
    regression = (p + 1) * (n + p) if cases else n
    kept = len(kept_samples(cases, time.samples, settings.output.max_rows))
    needs: dict[str, tuple[float, ...]] = {
        f"time.samples = {time.samples}": (time.samples, regression + signals),
        f"{cases} cases with {kept} samples each (output.max_rows)": (cases, kept, n + p),
    }
    if settings.data.name != "csv" and not levels.silent:
        elements = time.horizon / settings.noise.sample_time
        needs[f"noise.sample_time = {settings.noise.sample_time:g} s"] = (
            elements, settings.solver.stages + 1, n**2 + regression + signals * (p + 1),
        )
    return {what: _HELD * prod(numbers) for what, numbers in needs.items()}


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
