"""From plain data to :class:`Settings`, and to the ``config.yaml`` of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from gpebo_cli.configs.locations import LOOK
from gpebo_cli.errors import ConfigError
from gpebo_cli.plain_yaml import dump
from gpebo_cli.schema import convert, known_name, read, shown
from gpebo_cli.settings import (
    DataSettings,
    ExcitationSettings,
    NoiseSettings,
    OutputSettings,
    Settings,
    SolverSettings,
    TimeSettings,
)

KEYS = (
    "plant", "data", "observer", "estimator", "solver", "noise", "time", "excitation", "figures",
    "output", "uncertainty", "title", "reference", "expected", "theirs", "differs", "erratum",
    "drawn", "note",
)
"""Keys of a configuration, from which everything about a run follows."""

_DESCRIPTIVE = ("title", "reference")  # of files in the groups; for people
_FOLDER = "estimator"  # an observer that estimates by itself: its name again, for its folders

_INCHES = (1.5, 40.0)  # how wide a figure may be
# Of time: null where a default decides, or where a recording does, and what stands for that.
_OPEN: Mapping[str, Any] = {"start": -math.inf, "horizon": math.inf}


def settings(config: Mapping[str, Any], *, draw: bool) -> Settings:
    """The settings of one run, from plain data of the keys in :data:`KEYS`.

    ``draw``: whether ``figures: null`` means all figures or none (ConfigError: an unknown key, a
    wrong type, or a value out of range).
    """
    for key in config:
        known_name(key, KEYS, f"{key}: no such key", "the configuration has")
    data = read(DataSettings, _group(config, "data"), "data")
    built = Settings(
        data=data,
        estimator=_group(config, "estimator"),
        time=_time(config, recorded=data.name == "csv"),
        solver=read(SolverSettings, _group(config, "solver"), "solver"),
        observer=_observer(config),
        excitation=read(ExcitationSettings, _group(config, "excitation"), "excitation"),
        output=_output(config, draw=draw),
        noise=read(NoiseSettings, _group(config, "noise"), "noise"),
        uncertainty=convert(config.get("uncertainty", True), bool, "uncertainty"),
    )
    noise = built.noise
    if noise.name == "none" and noise != NoiseSettings():  # a recipe sets a level, another none
        keys = [key for key, value in vars(noise).items() if value != getattr(NoiseSettings, key)]
        raise ConfigError(
            f"noise.{keys[0]}: noise=none has no noise; leave it out, or choose noise=gaussian"
        )
    return built


def _group(config: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A section without what is for people only."""
    section = config.get(name)
    if section is None:
        return {}
    if not isinstance(section, Mapping):
        raise ConfigError(f"{name}: expected a mapping of keys to values, got {shown(section)}")
    for key in _DESCRIPTIVE:
        if isinstance(section.get(key), Mapping | list):
            raise ConfigError(f"{name}.{key}: expected text, got {shown(section[key])}")
    return {str(k): v for k, v in section.items() if k not in _DESCRIPTIVE}


def complete(config: Mapping[str, Any], built: Settings) -> dict[str, Any]:
    """The configuration with the span of time that ``null`` stands for, where a default decides."""
    decided = {key: getattr(built.time, key) for key in _OPEN}
    span = {key: value for key, value in decided.items() if math.isfinite(value)}
    return {**config, "time": {**(config.get("time") or {}), **span}}


def _time(config: Mapping[str, Any], *, recorded: bool) -> TimeSettings:
    """The span of the experiment; ``null`` is the default, or where a recording begins or ends."""
    section = {key: value for key, value in _group(config, "time").items()
               if value is not None or key not in _OPEN}
    left = {key: end for key, end in _OPEN.items() if recorded and key not in section}
    return replace(read(TimeSettings, section, "time"), **left)


def _observer(config: Mapping[str, Any]) -> dict[str, Any]:
    section = _group(config, "observer")
    if section.get(_FOLDER) == section.get("name"):
        section.pop(_FOLDER, None)
    return section


def _output(config: Mapping[str, Any], *, draw: bool) -> OutputSettings:
    section = _group(config, "output")
    if "figures" in section:
        raise ConfigError("output.figures: no such key; did you mean figures?")
    words = {None: draw, "all": True, "none": False}
    figures = config.get("figures")
    if figures is None or isinstance(figures, str):
        if figures not in words:
            raise ConfigError(
                f"figures: expected all, none or a list of names, got {shown(figures)}; did you "
                f"mean figures=[{figures}]?"
            )
        figures = words[figures]
    chosen = convert(figures, bool | list[str], "figures")
    # First those that messages have another name for.
    read(OutputSettings, {key: section[key] for key in LOOK if key in section}, "figures")
    built = read(OutputSettings, {**section, "figures": chosen}, "output")
    low, high = _INCHES
    if isinstance(built.width, float) and not low <= built.width <= high:
        raise ConfigError(
            f"figures.width: expected column, page or {low:g} to {high:g} inches, got "
            f"{built.width:g}"
        )
    if not built.formats:
        raise ConfigError("figures.formats: expected some of png, pdf and svg, got an empty list")
    return built


REPEATS = "Repeats the run: gpebo run --config-dir <this folder> --config-name config"
"""What the first line of a ``config.yaml`` says."""


def config_text(config: Mapping[str, Any], head: str = REPEATS) -> str:
    """The ``config.yaml`` of a run: complete, and good to repeat it into a new folder."""
    return f"# {head}\n{dump(config)}"
