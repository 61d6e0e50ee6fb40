"""What every observer is told: where its extension starts, and how much each output counts.

ξ_a(start) = V1 ξ_a0, and with weights w the outputs are √(w/max w) y = √(w/max w) C x.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.schema import nearest, per_name
from gpebo_cli.settings import ObserverSettings


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
        out = [float(v) for v in values]
    except (TypeError, ValueError):
        out = [np.nan]
    if not all(map(isfinite, out)):
        raise ConfigError(f"{where}: every value must be a finite number, got {values}")
    return np.array(out, dtype=np.float64)


def output_scale(settings: ObserverSettings, system: DescriptorSystem) -> Array:
    """√(w/max w) of the weights w, shape (r,): exactly one for outputs that count equally.

    Raises:
        ConfigError: the wrong number of weights, an unknown output, or no positive one.
    """
    if settings.weights is None:
        return np.ones(system.r)
    weights = per_name(settings.weights, system.outputs, "output", "observer.weights", absent=1.0)
    if not weights.any():
        raise ConfigError("observer.weights: at least one output must have a positive weight")
    return np.asarray(np.sqrt(weights / weights.max()))
