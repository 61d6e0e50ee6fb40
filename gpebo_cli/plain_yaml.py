"""YAML as gpebo reads and writes it: one document of plain data.

A file may be a stranger's, so its meaning must not depend on who reads it. Data is built from
libyaml's events directly, and what could say more than data says is refused: tags, directives,
merge keys, a key that stands twice or is no text, and anchors that expand to more than a limit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import yaml

from gpebo_cli.errors import ConfigError

_MAX_DEPTH = 50
_OLD = re.compile(r"[-+]?(0[0-7_]+$|\d[\d_]*:)")
_DEEP = f"nested more than {_MAX_DEPTH} levels deep"
_MAX_ENTRIES = 200_000  # aliases expanded; OmegaConf builds some 20,000 a second

_Parser: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml is 10 times as fast


def parse(text: str, path: str, *, ours: bool = False) -> Any:
    """The plain data in a YAML text of the file ``path`` (ConfigError: it is more, or not YAML).

    Only in one of ``ours``, that come with gpebo, may ``${`` stand, which OmegaConf replaces.
    """
    try:
        return _Builder(path, ours=ours).build(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = path if mark is None else f"{path}, line {mark.line + 1}"
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or error
        if "nesting depth" in str(problem):  # libyaml looks ahead, and has a limit of its own
            raise ConfigError(f"{where}: {_DEEP}") from error
        raise ConfigError(f"{where}: not valid YAML: {problem}") from error


class _Builder:
    def __init__(self, path: str, *, ours: bool) -> None:
        self._path = path
        self._ours = ours
        self._events: Iterator[Any] = iter(())
        self._anchors: dict[str, tuple[Any, int]] = {}  # values, and how many entries they are
        self._count = 0

    def build(self, text: str) -> Any:
        documents: list[Any] = []
        self._events = yaml.parse(text, Loader=_Parser)
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent):
                if event.version or event.tags:
                    self._refuse(event, "a directive (%…) is not allowed")
                if documents:
                    self._refuse(event, "a second document (---) is not allowed")
                documents.append(self._value(next(self._events), 0))
        return documents[0] if documents else None

    def _value(self, event: Any, depth: int) -> Any:
        """What begins with an event, ``depth`` collections deep."""
        if tag := getattr(event, "tag", None):
            self._refuse(event, f"the tag {tag} is not allowed; a file is plain data")
        before = self._count
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchors:
                self._refuse(event, f"*{event.anchor} contains itself, or stands for nothing")
            value, size = self._anchors[event.anchor]
            self._count += size
        else:
            self._count += 1
            self._anchors.pop(event.anchor, None)  # until its value ends, the name means nothing
            if isinstance(event, yaml.ScalarEvent):
                value = self._scalar(event)
            elif isinstance(event, yaml.MappingStartEvent):
                value = self._mapping(event, depth)
            else:
                value = [self._value(inner, depth + 1) for inner in self._inside(event, depth)]
            if event.anchor is not None:
                self._anchors[event.anchor] = value, self._count - before
        if self._count > _MAX_ENTRIES:
            self._refuse(event, f"more than {_MAX_ENTRIES} entries, aliases expanded")
        return value

    def _inside(self, event: yaml.NodeEvent, depth: int) -> Iterator[Any]:
        """The events with which begins what a collection holds."""
        if depth >= _MAX_DEPTH:
            self._refuse(event, _DEEP)
        while not isinstance(inner := next(self._events), yaml.CollectionEndEvent):
            yield inner

    def _mapping(self, event: yaml.NodeEvent, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for inner in self._inside(event, depth):
            key = self._value(inner, depth + 1)
            if not isinstance(key, str):
                self._refuse(inner, "a key must be text; write it in quotes")
            if key == "<<":
                self._refuse(inner, "a merge key (<<) is not allowed; write the keys out")
            if key in found:
                self._refuse(inner, f"the key {key[:60]} stands twice")
            found[key] = self._value(next(self._events), depth + 1)
        return found

    def _scalar(self, event: yaml.ScalarEvent) -> Any:
        text = event.value
        if "${" in text and not self._ours:
            self._refuse(event, "${…} is not allowed; write the value")
        if not event.implicit[0]:  # quoted, or a block
            return text
        tag = _SCALARS.resolve(yaml.ScalarNode, text, (True, False))
        make = _PLAIN.get(tag)
        if make is None:
            return text
        if _OLD.match(text):
            self._refuse(event, f"{text[:60]} is a number of base 8 or 60 to some readers of YAML; "
                                "write it without a 0 in front and colons, or in quotes")
        try:
            return make(yaml.ScalarNode(tag, text))
        except ValueError:  # digits of 0x_, or too many
            self._refuse(event, "a number that cannot be read")

    def _refuse(self, event: yaml.Event, problem: str) -> NoReturn:
        line = event.start_mark.line + 1 if event.start_mark else 0
        raise ConfigError(f"{self._path}, line {line}: {problem}")


def dump(content: Mapping[str, Any]) -> str:
    """``content`` as YAML that :func:`parse` reads back."""
    return yaml.dump(
        dict(content),
        Dumper=_Dumper,
        allow_unicode=True,
        default_flow_style=None,  # rows of a matrix on one line each
        sort_keys=False,
        width=100,
    )


class _Dumper(yaml.SafeDumper):
    """Quotes text that would be read as a number, and repeats what occurs twice."""

    def ignore_aliases(self, data: object) -> bool:  # noqa: ARG002
        """A matrix that stands in two places is written twice; there is nothing to follow."""
        return True


class _Scalars(yaml.SafeLoader):
    """Knows which plain scalars are numbers, truth values or nothing."""


_FLOAT = "tag:yaml.org,2002:float"

# PyYAML alone takes 1e9, without a point, for text. OmegaConf reads more as numbers than that.
_Scalars.add_implicit_resolver(
    _FLOAT, re.compile(r"[-+]?([0-9][0-9_]*\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+0123456789."),
)
_Dumper.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r"[-+]?([0-9][0-9_]*\.?[0-9_]*|\.[0-9_]+)(e[-+]?[0-9]+)?$|[-+]?\.?(inf|nan)$", re.IGNORECASE
    ),
    list("-+0123456789.inIN"),
)
_SCALARS: Any = _Scalars("")
_PLAIN = {
    f"tag:yaml.org,2002:{kind}": getattr(_SCALARS, f"construct_yaml_{kind}")
    for kind in ("null", "bool", "int", "float")
}
