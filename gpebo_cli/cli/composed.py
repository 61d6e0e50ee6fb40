"""From the configuration that Hydra has composed to plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gpebo_cli.errors import ConfigError


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
