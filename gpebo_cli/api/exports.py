"""A run for other tools: its tables for xarray, its observer for python-control."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

from gpebo_cli import observers
from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.observers.reduced.invariant import invariant_observer
from gpebo_cli.observers.remedies.plain import Plain
from gpebo_cli.results.symbols import unit_of
from gpebo_cli.results.tables import frame


def to_xarray(result: RunResult, table: str) -> Any:
    """A table of a run as an ``xarray.Dataset``, with the plant's units.

    ConfigError: no such table, or xarray is not installed.
    """
    _package("xarray")
    found = frame(result, table).to_xarray()
    units = result.system.units
    for name in map(str, found.variables):
        quantity = name if name in units else re.sub("_(hat|std|true|measured)$", "", name)
        if unit := "s" if name == "t" else unit_of(quantity, units):
            found[name].attrs["units"] = unit
    return found.assign_attrs(title=result.system.title, verdict=result.verdict)


def to_control(result: RunResult) -> Any:
    """The observer of a time-invariant plant as a ``control.StateSpace`` from [u; y; θ] to x̂.

    ConfigError: another observer, a plant that varies with time, or python-control is missing.
    """
    control = _package("control")
    system, settings = result.system, result.settings
    observer = observers.build(settings.observer)
    if not (
        isinstance(observer, Gpebo) and isinstance(observer.remedy, Plain)
        and observer.sample_time is None
    ):
        raise ConfigError(
            "to_control takes observer=gpebo in continuous time without a remedy, and this run has "
            f"observer={settings.observer.get('name')}, sample_time "
            f"{settings.observer.get('sample_time')}, remedy {settings.observer.get('remedy')}"
        )
    *matrices, states = invariant_observer(
        system, settings.solver, observer.form, observer.weights, float(result.signals.t[0])
    )
    return control.StateSpace(
        *matrices, name=system.name, states=list(states),
        inputs=[*system.inputs, *system.outputs, *system.unknowns],
        outputs=[f"{state}_hat" for state in system.states],
    )


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise ConfigError(f"to_{name} needs {name}: pip install {name}") from None
