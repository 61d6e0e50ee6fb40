"""A run for other tools: its tables for xarray, its observer for python-control."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from gpebo_cli import observers
from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.model.descriptor import Array
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.observers.reduced.extension import choose_form
from gpebo_cli.observers.reduced.split import initial_basis
from gpebo_cli.observers.remedies.plain import Plain
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.results.frames import frame


def to_xarray(result: RunResult, table: str) -> Any:
    """A table of a run as an ``xarray.Dataset``, with the plant's units.

    Raises:
        ConfigError: no such table, or xarray is not installed.
    """
    _package("xarray")
    found = frame(result, table).to_xarray()
    units = result.system.units
    for name in found.variables:
        unit = "s" if name == "t" else units.get(str(name).removesuffix("_hat"))
        if unit:
            found[name].attrs["units"] = unit
    return found.assign_attrs(title=result.system.title, verdict=result.verdict)


def to_control(result: RunResult) -> Any:
    """The observer of a time-invariant plant as a ``control.StateSpace`` from [u; y; θ] to x̂.

    Theory 4 with ŵ = ξ_a + ξ_b θ − Φ e₀, in which e₀ is the start of the state alone:

        ŵ' = A_0 ŵ + b_0 + D_0 θ,      x̂ = (I − K𝒜) ŵ − K (g_y + G θ)

    where b_0 and g_y are linear in u and y.

    Raises:
        ConfigError: another observer, a plant that varies with time, or python-control is not
            installed.
    """
    control = _package("control")
    system, settings = result.system, result.settings
    observer = observers.build(settings.observer)
    plain = isinstance(observer, Gpebo) and isinstance(observer.remedy, Plain)
    if not isinstance(observer, Gpebo) or not plain or observer.sample_time is not None:
        raise ConfigError(
            "to_control takes observer=gpebo in continuous time without a remedy, and this run has "
            f"observer={settings.observer.get('name')}, sample_time "
            f"{settings.observer.get('sample_time')}, remedy {settings.observer.get('remedy')}"
        )
    moving = [key for key in "EABFCDH" if key not in system.coefficients.constant]
    if moving or "phi" not in system.coefficients.zero:
        raise ConfigError(
            f"plant {system.name} is not time-invariant: {moving[0] if moving else 'phi'} "
            + ("depends on time or on signals" if moving else "is not zero")
            + ", and a state-space model of python-control has constant matrices alone"
        )
    t = np.array([float(result.signals.t[0])])
    derivatives = InputDerivatives.of_plant(system, np.ones(system.m, dtype=bool))
    form, o, _ = choose_form(
        system, t, t, None, derivatives, settings.solver, observer.form, observer.weights
    )
    if form.derivatives:
        raise ConfigError(
            f"plant {system.name}: its observer needs derivatives of inputs, which no state-space "
            "model has"
        )
    K = o.elimination[0] @ o.range[0].T
    basis: Array = o.split.basis
    _, names = initial_basis(o.split.projector[0], o.split.rank, system.states)
    if basis.shape[1] > o.split.rank:
        names = system.states
    return control.StateSpace(
        o.dynamics[0],
        np.concatenate([o.from_signals[0], o.from_unknowns[0]], axis=1),
        basis - K @ o.on_basis[0],
        -K @ np.concatenate([o.g_signals[0], o.G[0]], axis=1),
        name=system.name,
        states=[f"w_{name.removeprefix('e0_')}" for name in names],
        inputs=[*system.inputs, *system.outputs, *system.unknowns],
        outputs=[f"{state}_hat" for state in system.states],
    )


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise ConfigError(f"to_{name} needs {name}: pip install {name}") from None
