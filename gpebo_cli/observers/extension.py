"""Where the dynamic extension starts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.reading import nearest
from gpebo_cli.settings import ObserverSettings
from gpebo_cli.systems.descriptor import Array, DescriptorSystem


def initial_extension(
    settings: ObserverSettings, system: DescriptorSystem, names: tuple[str, ...]
) -> Array:
    """ξ_a(start) in the coordinates of V1, shape (n_a,): the settings, else the plant's, else 0.

    Raises:
        ConfigError: unknown state, or the wrong number of values.
    """
    given = settings.xi_a0
    where = "observer.xi_a0"
    if given is None:
        given = system.observer_defaults.get("xi_a0")  # type: ignore[assignment]
        where = f"plant {system.name}: observer_defaults.xi_a0"
    if given is None:
        return np.zeros(len(names))
    labels = [name.removeprefix("e0_") for name in names]
    if isinstance(given, Mapping):
        unknown = [key for key in given if key not in labels]
        if unknown:
            raise ConfigError(
                f"{where}: {unknown[0]!r} is not a differential state; accepted: "
                f"{', '.join(labels)}" + nearest(str(unknown[0]), labels)
            )
        values = [given.get(label, 0.0) for label in labels]
    else:
        values = list(given)
        if len(values) != len(labels):
            raise ConfigError(
                f"{where} has {len(values)} values but there are {len(labels)} differential "
                f"states ({', '.join(labels)})"
            )
    try:
        out = np.array([float(v) for v in values])
    except (TypeError, ValueError):
        out = np.array([np.nan])
    if not np.isfinite(out).all():
        raise ConfigError(f"{where}: every value must be a finite number, got {values}")
    return out
