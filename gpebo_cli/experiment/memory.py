"""What a run will hold, estimated before it is allocated: a machine that swaps stands still."""

from __future__ import annotations

from math import prod

import numpy as np

from gpebo_cli.errors import ConfigError, check_memory
from gpebo_cli.experiment.noise import NoiseLevels
from gpebo_cli.experiment.sources import kept_samples
from gpebo_cli.model.descriptor import DescriptorSystem, differential_order
from gpebo_cli.settings import Settings

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
