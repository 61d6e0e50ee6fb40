"""Estimators, found by name: a module here with a dataclass is an estimator.

Adding one is one module (whose dataclass carries the settings and has ``cases`` and
``estimate``), exported as ``ESTIMATOR``, and one config in ``conf/estimator``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import cast

from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators._base import Estimates, Estimator
from gpebo_cli.reading import nearest, read

__all__ = ["Estimates", "Estimator", "build", "names", "settings_of"]


def names() -> list[str]:
    """Every estimator there is."""
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem[0] != "_")


def build(settings: Mapping[str, object]) -> Estimator:
    """The estimator that ``settings["name"]`` asks for, with the remaining keys as its settings.

    Raises:
        ConfigError: unknown name or key, with the nearest known one.
    """
    estimator = _find(settings)
    rest = {k: v for k, v in settings.items() if k not in ("name", "title", "reference")}
    built = cast(Estimator, read(estimator, rest, "estimator"))
    _ = built.cases  # gains are read here, so that a wrong one is found before anything is run
    return built


def settings_of(settings: Mapping[str, object]) -> list[str]:
    """The settings that the estimator called ``settings["name"]`` has.

    Raises:
        ConfigError: unknown name, with the nearest known one.
    """
    return [field.metadata.get("key", field.name) for field in fields(_find(settings))]


def _find(settings: Mapping[str, object]) -> type:
    name = settings.get("name")
    if name not in names():
        raise ConfigError(
            f"estimator.name: {name!r} is not an estimator; known: {', '.join(names())}"
            + nearest(str(name), names())
        )
    return cast("type", import_module(f"{__name__}.{name}").ESTIMATOR)
