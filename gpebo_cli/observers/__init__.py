"""Observers: from measured signals to a regression and a map from its parameters to the state.

An observer is a module here with a dataclass exported as ``OBSERVER``, which carries its
settings and has ``observe``, and one file in ``conf/observer``. Another package adds one as an
entry point in the group ``gpebo.observers``. All that an author needs is imported from here
(docs/howto/observer.md); modules that begin with an underscore may change.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.observers._base import (
    AffineStateMap,
    AtSamples,
    InitialError,
    Measurements,
    Observation,
    Observer,
    Reached,
    Recursion,
    Responding,
    Sampling,
    SignalNoise,
    StateMap,
    Truth,
    initial_extension,
    output_scale,
)
from gpebo_cli.registry import Registry
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.schema import checked
from gpebo_cli.settings import SolverSettings

__all__ = [
    "AffineStateMap", "Assumption", "AtSamples", "InitialError", "LinearEquation",
    "LinearProblem", "LinearRegression", "Measurements", "Mesh", "Observation", "Observer",
    "Reached", "Recursion", "Responding", "Sampling", "SignalNoise", "SolverSettings", "StateMap",
    "Trajectory", "Truth", "able", "build", "initial_extension", "names", "observe", "output_scale",
    "sampling", "settings_of", "solve",
]

_OBSERVERS: Registry[Observer] = Registry("observer")
names, settings_of, able = _OBSERVERS.names, _OBSERVERS.settings_of, _OBSERVERS.able
_NONE = "none"  # simulate only


def build(settings: Mapping[str, object]) -> Observer | None:
    """The observer that ``settings["name"]`` asks for, with the remaining keys as its settings.

    It is None for the name none: there is a simulation, and nobody observes it.
    """
    return None if settings.get("name") == _NONE else _OBSERVERS.build(settings)


def sampling(observer: Observer | None) -> Sampling | None:
    """The samples at which an observer was asked to run; None if it runs in continuous time."""
    at_samples = issubclass(type(observer), AtSamples)  # of types Python keeps the answer
    return cast(AtSamples, observer).sampling() if at_samples else None


def observe(
    system: DescriptorSystem, signals: Measurements, solver: SolverSettings | None = None,
    **settings: object,
) -> Observation:
    """Run an observer on measured signals.

    The true θ and initial state of ``system`` are not looked at; ``settings`` are ``name`` of the
    observer (default: gpebo) and its own settings.

    Raises:
        ModelError: an assumption of the observer fails; names the time and the evidence.
        ConfigError: settings that do not fit the plant.
        SolverError: the tolerance cannot be reached.
    """
    observer = _OBSERVERS.build({"name": "gpebo", **settings})
    return observer.observe(system, signals, checked(solver or SolverSettings(), "solver"))
