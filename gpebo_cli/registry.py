"""Dataclasses found by name: the modules of a package, and those that installed packages bring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Generic, TypeVar, cast

from gpebo_cli.errors import ConfigError
from gpebo_cli.schema import keys, nearest, read, shown

T = TypeVar("T")
Capability = TypeVar("Capability")

_DESCRIPTIVE = ("name", "title", "reference")


def installed(noun: str, name: str) -> str:
    """What to say of an estimator or observer that a package brings and no file describes."""
    if name not in Registry[object](noun).theirs:
        return ""
    return (
        f"; {noun} {name} is installed, and {noun}/{name}.yaml is missing: a file with "
        f"`name: {name}` and its settings, in the folder given by --config-dir (gpebo new {noun} "
        f"{name} writes one)"
    )


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Estimators or observers by name; a module whose name begins with ``_`` is none.

    A module exports its dataclass in capitals, as ``ESTIMATOR``. Another package offers one as an
    entry point of the group ``gpebo.estimators``, which names the dataclass.
    """

    noun: str  # estimator

    @cached_property
    def ours(self) -> frozenset[str]:
        """Names of the modules here."""
        modules = Path(__file__).with_name(f"{self.noun}s").glob("*.py")
        return frozenset(path.stem for path in modules if path.stem[0] != "_")

    @property
    def theirs(self) -> dict[str, EntryPoint]:
        """Those that installed packages bring. A name of ours is ours."""
        return {entry.name: entry for entry in entry_points(group=f"gpebo.{self.noun}s")}

    def names(self) -> list[str]:
        """All there are, those of other packages included."""
        return sorted({*self.ours, *self.theirs})

    def build(self, settings: Mapping[str, object]) -> T:
        """The one that ``settings["name"]`` asks for, with the remaining keys as its settings."""
        rest = {k: v for k, v in settings.items() if k not in _DESCRIPTIVE}
        return cast(T, read(self.find(settings), rest, self.noun))

    def settings_of(self, settings: Mapping[str, object]) -> list[str]:
        """The settings that the one called ``settings["name"]`` has."""
        return list(keys(self.find(settings)))

    def able(self, one: T | None, capability: type[Capability], asked: str) -> Capability:
        """``one`` as something that has a capability, a protocol.

        If it has not, a ConfigError begins with what is ``asked`` for, by which setting.
        """
        if isinstance(one, capability):
            return one
        there = [name for name in self.names() if issubclass(self.find({"name": name}), capability)]
        raise ConfigError(f"{asked}; this one cannot, these can: {', '.join(there)}")

    def find(self, settings: Mapping[str, object]) -> type:
        """The dataclass of ``settings["name"]`` (ConfigError)."""
        given = settings.get("name")
        name = given if isinstance(given, str) else shown(given)
        if name in self.ours:
            module = import_module(f"gpebo_cli.{self.noun}s.{name}")
            return cast("type", getattr(module, self.noun.upper()))
        if name in (theirs := self.theirs):
            return self._load(theirs[name])
        article = "an" if self.noun[0] in "aeiou" else "a"
        raise ConfigError(
            f"{self.noun}.name: {name!r} is not {article} {self.noun}; known: "
            f"{', '.join(self.names())}{nearest(name, self.names())}; one of your own has to "
            "be installed: pip install -e FOLDER"
        )

    def _load(self, entry: EntryPoint) -> type:
        """The dataclass that another package's entry point names."""
        package = entry.dist.name if entry.dist else entry.value
        where = f"{self.noun}.name: {entry.name} of {package}"
        try:
            found = entry.load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"{where} cannot be imported: {error}") from error
        if not (isinstance(found, type) and is_dataclass(found)):
            raise ConfigError(f"{where} is not a dataclass; {entry.value} must name one")
        return found
