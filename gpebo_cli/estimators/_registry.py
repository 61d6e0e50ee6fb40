"""Estimators by name: the modules beside this one, and those that installed packages bring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeVar, cast

from gpebo_cli.errors import ConfigError
from gpebo_cli.regression.estimator import Estimator
from gpebo_cli.schema import nearest, read

GROUP = "gpebo.estimators"
"""The entry points under which other packages offer estimators."""

Capability = TypeVar("Capability")


def names() -> list[str]:
    """Every estimator there is, those of other packages included."""
    return sorted({*_ours(), *_theirs()})


@cache
def _ours() -> tuple[str, ...]:
    return tuple(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem[0] != "_")


def _theirs() -> dict[str, EntryPoint]:
    """Estimators that installed packages bring. A name of ours is ours."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


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
    if name not in _ours() and name in (theirs := _theirs()):
        return _load(theirs[str(name)])
    if name not in _ours():
        raise ConfigError(
            f"estimator.name: {name!r} is not an estimator; known: {', '.join(names())}"
            + nearest(str(name), names())
        )
    return cast("type", import_module(f"gpebo_cli.estimators.{name}").ESTIMATOR)


def _load(entry: EntryPoint) -> type:
    """The dataclass that another package's entry point names."""
    where = f"estimator.name: {entry.name} of {entry.dist.name if entry.dist else entry.value}"
    try:
        found = entry.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{where} cannot be imported: {error}") from error
    if not (isinstance(found, type) and is_dataclass(found)):
        raise ConfigError(f"{where} is not a dataclass; {entry.value} must name one")
    return found


def able(estimator: Estimator, capability: type[Capability], asked: str) -> Capability:
    """The estimator as one that has a capability: ``Resumable``, ``Moving`` or ``Recursive``.

    Args:
        estimator: any.
        capability: its protocol.
        asked: what is asked for and by which setting, for the message.

    Raises:
        ConfigError: it has not; names those that have.
    """
    if isinstance(estimator, capability):
        return estimator
    there = [name for name in names() if issubclass(_find({"name": name}), capability)]
    raise ConfigError(f"{asked}; this one cannot, these can: {', '.join(there)}")
