"""YAML as gpebo reads and writes it: one document of plain data.

A file may be a stranger's, so its meaning must not depend on who reads it. Data is built from
libyaml's events directly, and what could say more than data says is refused: tags, directives,
merge keys, a key that stands twice or is no text, and anchors that expand to more than a limit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NoReturn

import yaml

from gpebo_cli.errors import ConfigError

_MAX_DEPTH = 50
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
        raise ConfigError(f"{where}: not valid YAML: {problem}") from error


class _Builder:
    def __init__(self, path: str, *, ours: bool) -> None:
        self._path = path
        self._ours = ours
        self._documents: list[Any] = []
        # Collections that are open: what is in them, anchor, entries before, key of the next value.
        self._open: list[list[Any]] = []
        self._anchors: dict[str, tuple[Any, int]] = {}  # values, and how many entries they are
        self._count = 0

    def build(self, text: str) -> Any:
        for event in yaml.parse(text, Loader=_Parser):
            if tag := getattr(event, "tag", None):
                self._refuse(event, f"the tag {tag} is not allowed; a file is plain data")
            if isinstance(event, yaml.DocumentStartEvent):
                self._begin_document(event)
            elif isinstance(event, yaml.ScalarEvent):
                value = self._scalar(event)
                self._count += 1
                self._keep(event.anchor, value, 1)
                self._add(event, value)
            elif isinstance(event, yaml.AliasEvent):
                if event.anchor not in self._anchors:
                    self._refuse(event, f"*{event.anchor} contains itself, or stands for nothing")
                value, size = self._anchors[event.anchor]
                self._count += size
                self._add(event, value)
            elif isinstance(event, yaml.CollectionStartEvent):
                self._begin(event)
            elif isinstance(event, yaml.CollectionEndEvent):
                value, anchor, before, _ = self._open.pop()
                self._keep(anchor, value, self._count - before)
            if self._count > _MAX_ENTRIES:
                self._refuse(event, f"more than {_MAX_ENTRIES} entries, aliases expanded")
        return self._documents[0] if self._documents else None

    def _begin_document(self, event: yaml.DocumentStartEvent) -> None:
        if event.version or event.tags:
            self._refuse(event, "a directive (%…) is not allowed")
        if self._documents:
            self._refuse(event, "a second document (---) is not allowed")

    def _begin(self, event: yaml.CollectionStartEvent) -> None:
        if len(self._open) >= _MAX_DEPTH:
            self._refuse(event, f"nested more than {_MAX_DEPTH} levels deep")
        value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
        self._add(event, value)
        self._open.append([value, event.anchor, self._count, None])
        self._anchors.pop(str(event.anchor), None)  # until it ends, the name means nothing
        self._count += 1

    def _keep(self, anchor: str | None, value: Any, size: int) -> None:
        if anchor is not None:
            self._anchors[anchor] = value, size

    def _add(self, event: yaml.NodeEvent, value: Any) -> None:
        if not self._open:
            self._documents.append(value)
            return
        inside, _, _, key = self._open[-1]
        if isinstance(inside, list):
            inside.append(value)
        elif key is not None:
            inside[key] = value
            self._open[-1][3] = None
        elif not isinstance(value, str):
            self._refuse(event, "a key must be text; write it in quotes")
        elif value == "<<":
            self._refuse(event, "a merge key (<<) is not allowed; write the keys out")
        elif value in inside:
            self._refuse(event, f"the key {value[:60]} stands twice")
        else:
            self._open[-1][3] = value

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
