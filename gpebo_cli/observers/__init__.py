"""Observers: from the signals u and y to a regression and a map from parameters to states."""

from __future__ import annotations

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import canonical, current, gpebo, injection, kalman_bucy, resets
from gpebo_cli.observers.kalman_bucy import SignalNoise
from gpebo_cli.observers.observation import Observation, StateMap
from gpebo_cli.settings import NoiseSettings, ObserverSettings, SolverSettings

__all__ = ["Observation", "SignalNoise", "StateMap", "check_remedy", "observe"]

_OBSERVERS = {"gpebo": gpebo.observe, "canonical": canonical.observe}
_REMEDIES = {
    "none": gpebo.observe,
    "output_injection": injection.observe,
    "reset": resets.observe,
    "current_coordinates": current.observe,
}
_DEFAULT = ObserverSettings()
# Keys of the remedies, and which of them each belongs to.
_KEYS = {
    "injection": "output_injection", "reset_interval": "reset", "reset_times": "reset",
    "reset_keep": "reset",
}


def observe(
    system: DescriptorSystem,
    inputs: Trajectory,
    outputs: Trajectory,
    settings: ObserverSettings,
    solver: SolverSettings,
    noise: SignalNoise | None = None,
) -> Observation:
    """Run the observer that ``settings.name`` asks for on the signals of one mesh.

    Args:
        system: the plant; its true θ and initial state are not looked at.
        inputs: u, values (K, s + 1, m).
        outputs: y, values (K, s + 1, r).
        settings: which observer, and what it is free to choose.
        solver: tolerances.
        noise: of u and y, for an observer that weighs by it; None: there is none.

    Raises:
        ModelError: an assumption of the observer fails; names the time and the evidence.
        ConfigError: settings that do not fit the plant.
        SolverError: the tolerance cannot be reached.
    """
    refuse_beyond(system)
    check_remedy(settings)
    if settings.name == "kalman_bucy":
        if noise is None:
            noise = SignalNoise(np.zeros(system.m), np.zeros(system.r), NoiseSettings().sample_time)
        return kalman_bucy.observe(system, inputs, outputs, settings, solver, noise)
    run = _OBSERVERS[settings.name] if settings.remedy == "none" else _REMEDIES[settings.remedy]
    return run(system, inputs, outputs, settings, solver)


def refuse_beyond(system: DescriptorSystem) -> None:
    """Refuse a plant with terms that no observer here makes use of.

    Raises:
        ConfigError: names them.
    """
    source = system.coefficients
    beyond = [key for key in ("phi", "D", "H") if key not in source.zero]
    beyond += [f"{key} of {', '.join(sorted(names))}" for key, names in source.signals.items()]
    if beyond:
        raise ConfigError(
            f"plant {system.name}: observers take E x' = A x + B u + F θ, y = C x with functions "
            f"of t alone, and it has {beyond[0]}; use observer=none"
        )


def check_remedy(settings: ObserverSettings) -> None:
    """Refuse a remedy for an observer that has none, and keys of another remedy.

    Args:
        settings: of the observer.

    Raises:
        ConfigError: names the key.
    """
    if settings.remedy != "none" and settings.name != "gpebo":
        raise ConfigError(
            f"observer.remedy={settings.remedy} is for observer=gpebo; observer={settings.name} "
            "accepts none"
        )
    if settings.remedy != "none" and settings.sample_time is not None:
        raise ConfigError(
            f"observer.remedy={settings.remedy} works in continuous time only; at samples "
            "(observer.sample_time) there is none"
        )
    for key, remedy in _KEYS.items():
        if settings.remedy != remedy and getattr(settings, key) != getattr(_DEFAULT, key):
            raise ConfigError(
                f"observer.{key} is of observer.remedy={remedy}, but the remedy is "
                f"{settings.remedy}"
            )
