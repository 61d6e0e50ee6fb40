"""Estimators, found by name: a module here with a dataclass is an estimator.

Adding one is one module (whose dataclass carries the settings and has ``cases`` and
``estimate``), exported as ``ESTIMATOR``, and one config in ``conf/estimator``.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import cast

from gpebo_cli.errors import ConfigError
from gpebo_cli.reading import nearest, read
from gpebo_cli.regression import Estimates, Estimator

__all__ = ["Estimates", "Estimator", "build", "names"]


def names() -> list[str]:
    """Every estimator there is."""
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem[0] != "_")


def build(settings: Mapping[str, object]) -> Estimator:
    """The estimator that ``settings["name"]`` asks for, with the remaining keys as its settings.

    Raises:
        ConfigError: unknown name or key, with the nearest known one.
    """
    name = settings.get("name")
    if name not in names():
        raise ConfigError(
            f"estimator.name: {name!r} is not an estimator; known: {', '.join(names())}"
            + nearest(str(name), names())
        )
    estimator = import_module(f"{__name__}.{name}").ESTIMATOR
    rest = {k: v for k, v in settings.items() if k not in ("name", "title", "reference")}
    built = cast(Estimator, read(estimator, rest, "estimator"))
    _ = built.cases  # gains are read here, so that a wrong one is found before anything is run
    return built
