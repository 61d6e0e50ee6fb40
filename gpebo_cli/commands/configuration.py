"""From Hydra's configuration to :class:`Settings`, and to the ``config.yaml`` of a run."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gpebo_cli.errors import ConfigError
from gpebo_cli.reading import convert, nearest, read, shown
from gpebo_cli.settings import (
    ExcitationSettings,
    NoiseSettings,
    ObserverSettings,
    OutputSettings,
    Settings,
    SolverSettings,
    TimeSettings,
)

_KEYS = (
    "plant",
    "observer",
    "estimator",
    "solver",
    "noise",
    "time",
    "excitation",
    "figures",
    "output",
    "title",
    "reference",
)
_DESCRIPTIVE = ("title", "reference")  # of files in the groups; for people
_FOLDER = "estimator"  # of an observer that estimates by itself; its runs are called after it

# Accepted ranges, ends included. What a type cannot say; beyond them nothing sensible happens.
_RANGES = {
    "time.samples": (2, 10_000_000),
    "solver.tol": (1e-15, 0.1),
    "solver.stages": (2, 16),
    "solver.max_elements": (1, math.inf),
    "solver.max_strangeness_index": (0, 20),
    "solver.rank_tol": (1e-15, 0.1),
    "output.max_rows": (2, math.inf),
    "observer.regularisation": (1e-6, 1.0),
    "noise.seed": (0, math.inf),
}
_POSITIVE = ("time.horizon", "excitation.rho", "excitation.window", "noise.sample_time")


def plain(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as plain data, interpolations resolved, everywhere but in the plant.

    A plant is text that may come from a stranger; an interpolation in it could read environment
    variables or other parts of the configuration.

    Raises:
        ConfigError: an interpolation in the plant, or a value that is still missing (``???``).
    """
    plant = cfg.get("plant")
    if not isinstance(plant, DictConfig):
        raise ConfigError("plant is missing; choose one with plant=NAME (see gpebo list plants)")
    _refuse_interpolations(OmegaConf.to_container(plant, resolve=False), "plant")
    try:
        missing = sorted(OmegaConf.missing_keys(cfg))
        if missing:
            raise ConfigError(f"{missing[0]} has no value yet (???); give it one")
        return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key or 'configuration'}: {error.msg}") from error


def _refuse_interpolations(value: object, where: str) -> None:
    if isinstance(value, str) and "${" in value:
        raise ConfigError(f"{where}: ${{…}} is not allowed in a plant; write the value")
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _refuse_interpolations(key, where)
            _refuse_interpolations(inner, f"{where}.{key}")
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for position, inner in enumerate(value):
            _refuse_interpolations(inner, f"{where}[{position}]")


def settings(config: Mapping[str, Any], *, draw: bool) -> Settings:
    """The settings of one run.

    Args:
        config: plain data, as :func:`plain` returns it.
        draw: whether ``figures: null`` means all figures or none.

    Raises:
        ConfigError: an unknown key, a wrong type, or a value out of range.
    """
    for key in config:
        if key not in _KEYS:
            raise ConfigError(
                f"{key}: no such key; the configuration has {', '.join(_KEYS)}"
                + nearest(str(key), _KEYS)
            )
    built = Settings(
        plant=config["plant"],
        estimator=_group(config, "estimator"),
        time=read(TimeSettings, _group(config, "time"), "time"),
        solver=read(SolverSettings, _group(config, "solver"), "solver"),
        observer=read(
            ObserverSettings,
            {k: v for k, v in _group(config, "observer").items() if k != _FOLDER},
            "observer",
        ),
        excitation=read(ExcitationSettings, _group(config, "excitation"), "excitation"),
        output=_output(config, draw=draw),
        noise=read(NoiseSettings, _group(config, "noise"), "noise"),
    )
    _check_ranges(built)
    _check_no_noise(built.noise)
    return built


def _check_no_noise(noise: NoiseSettings) -> None:
    """A recipe may set levels of a file that the command line then replaces by none."""
    if noise.name == "none" and noise != NoiseSettings():
        keys = [key for key, value in vars(noise).items() if value != getattr(NoiseSettings, key)]
        raise ConfigError(
            f"noise.{keys[0]}: noise=none has no noise; leave it out, or choose noise=gaussian"
        )


def _group(config: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A section without what is for people only."""
    section = config.get(name)
    if section is None:
        return {}
    if not isinstance(section, Mapping):
        raise ConfigError(f"{name}: expected a mapping of keys to values, got {shown(section)}")
    return {str(k): v for k, v in section.items() if k not in _DESCRIPTIVE}


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
    return read(OutputSettings, {**section, "figures": chosen}, "output")


def _check_ranges(built: Settings) -> None:
    for name, (low, high) in _RANGES.items():
        value = _value(built, name)
        if not low <= value <= high:
            upto = f"to {high:g}" if math.isfinite(high) else "or more"
            raise ConfigError(f"{name}: expected {low:g} {upto}, got {value:g}")
    for name in _POSITIVE:
        value = _value(built, name)
        if value is not None and value <= 0:
            raise ConfigError(f"{name}: expected a positive number, got {value:g}")


def _value(built: Settings, name: str) -> Any:
    group, _, key = name.partition(".")
    return getattr(getattr(built, group), key)


@dataclass(frozen=True)
class RunPatterns:
    """Where a run and a sweep are written, before ``${now:…}`` and names are filled in."""

    run: str
    sweep: str
    subdir: str


def config_text(config: Mapping[str, Any], patterns: RunPatterns) -> str:
    """The ``config.yaml`` of a run: complete, and good to repeat it into a new folder."""
    hydra = {
        "output_subdir": None,
        "job": {"chdir": False},
        "run": {"dir": patterns.run},
        "sweep": {"dir": patterns.sweep, "subdir": patterns.subdir},
    }
    defaults: list[Any] = [
        "_self_",
        {"override hydra/job_logging": "none"},
        {"override hydra/hydra_logging": "none"},
    ]
    head = "# Repeats the run: gpebo run --config-dir <this folder> --config-name config\n"
    return head + yaml.dump(
        {"defaults": defaults, **config, "hydra": hydra},
        Dumper=_Dumper,
        allow_unicode=True,
        default_flow_style=None,  # rows of a matrix on one line each
        sort_keys=False,
        width=100,
    )


class _Dumper(yaml.SafeDumper):
    """Quotes text that OmegaConf would read as a number, and repeats what occurs twice."""

    def ignore_aliases(self, data: object) -> bool:  # noqa: ARG002
        """A matrix that stands in two places is written twice; there is nothing to follow."""
        return True


# As in omegaconf's loader; PyYAML alone takes 1e9, without a point, for text.
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d[\d_]*\.?[\d_]*|\.[\d_]+)(e[-+]?\d+)?$|[-+]?\.?(inf|nan)$", re.IGNORECASE),
    list("-+0123456789.inIN"),
)
