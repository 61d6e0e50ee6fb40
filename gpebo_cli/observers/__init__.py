"""Observers: from the signals u and y to a regression and a map from parameters to states."""

from __future__ import annotations

from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.observers import canonical, gpebo
from gpebo_cli.observers.observation import Observation, StateMap
from gpebo_cli.settings import ObserverSettings, SolverSettings
from gpebo_cli.systems.descriptor import DescriptorSystem

__all__ = ["Observation", "StateMap", "observe"]

_OBSERVERS = {"gpebo": gpebo.observe, "canonical": canonical.observe}


def observe(
    system: DescriptorSystem,
    inputs: Trajectory,
    outputs: Trajectory,
    settings: ObserverSettings,
    solver: SolverSettings,
) -> Observation:
    """Run the observer that ``settings.name`` asks for on the signals of one mesh.

    Args:
        system: the plant; its true θ and initial state are not looked at.
        inputs: u, values (K, s + 1, m).
        outputs: y, values (K, s + 1, r).
        settings: which observer, and what it is free to choose.
        solver: tolerances.

    Raises:
        ModelError: an assumption of the observer fails; names the time and the evidence.
        ConfigError: settings that do not fit the plant.
        SolverError: the tolerance cannot be reached.
    """
    return _OBSERVERS[settings.name](system, inputs, outputs, settings, solver)
