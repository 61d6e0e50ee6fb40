"""Look at the files of a ``--config-dir`` before Hydra loads them: they may be a stranger's.

Hydra and OmegaConf build what a file says before anybody can object. So the text itself is
checked first, by parsing events, which build nothing:

* size, nesting and aliases (a few lines of ``[*a, *a]`` can expand to billions of entries);
* a plant is data: no ``${…}``, which can read environment variables, and no package or defaults
  list, with which a file could place itself anywhere in the configuration;
* a recipe or a saved configuration says of Hydra only where to write and what to sweep: other
  parts of Hydra's own section name Python objects to call.

Text that is not YAML passes: Hydra says so if the file is used.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping
from typing import Any

import yaml

from gpebo_cli.cli.locations import DATA_GROUPS, GROUPS
from gpebo_cli.errors import ConfigError

_MAX_BYTES = 2_000_000
_MAX_DEPTH = 50
_MAX_ENTRIES = 200_000  # aliases expanded; OmegaConf builds some 20,000 a second
_MAX_FILES = 10_000

_PACKAGE = re.compile(r"^\s*#\s*@package\s+(\S+)", re.MULTILINE)
_PLANT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]{0,79}")  # it becomes part of a folder's name
_HYDRA_KEYS = {
    "run": None,
    "sweep": None,
    "mode": None,
    "output_subdir": None,
    "verbose": None,
    "job": {"chdir", "name"},
    "sweeper": {"params", "max_batch_size", "fail_fast"},
}
_DEFAULTS_ENTRY = re.compile(
    rf"(optional\s+|override\s+)*/?({'|'.join(GROUPS)}|hydra/(launcher|sweeper|\w+_logging))"
)
_DEFAULTS_VALUE = re.compile(r"[\w.-]+")

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml is 10 times as fast


def check_folder(folder: str, config_name: str) -> None:
    """Check the primary configuration in ``folder``, if there, and every file of its groups.

    Raises:
        ConfigError: a file is too large, too deep, or asks for what its kind may not.
    """
    if os.path.isdir(os.path.join(folder, "launcher")):
        raise ConfigError(
            f"{folder}: a folder of yours cannot bring launchers, which name code to run; rename "
            "its folder launcher, and set hydra.launcher.… on the command line"
        )
    for path, group in _files(folder, config_name):
        check_file(path, group, folder)


def _files(folder: str, config_name: str) -> Iterator[tuple[str, str | None]]:
    primary = os.path.join(folder, f"{config_name}.yaml")
    if os.path.exists(primary):
        yield primary, None
    count = 0
    for group in GROUPS:
        for parent, _, names in os.walk(os.path.join(folder, group)):
            for name in sorted(names):
                if not name.endswith((".yaml", ".yml")):
                    continue
                count += 1
                if count > _MAX_FILES:
                    raise ConfigError(f"{folder}: more than {_MAX_FILES} configuration files")
                yield os.path.join(parent, name), group


def check_file(path: str, group: str | None, folder: str) -> None:
    """Check one file; ``group`` is None for a primary configuration.

    Raises:
        ConfigError: it is too large, too deep, or asks for what its kind may not.
    """
    text = _read(path)
    if text is None:
        return
    try:
        _check_size(path, text)
        node = yaml.compose(text, Loader=_Loader)  # aliases stay shared: nothing is expanded
    except yaml.YAMLError:
        return
    package = _PACKAGE.search(text)
    placed = "" if package is None else package[1]
    if not isinstance(node, yaml.MappingNode):
        return
    for inner in _nodes(node):
        if isinstance(inner, yaml.ScalarNode) and inner.value == "_target_":
            raise ConfigError(f"{path}, line {_line(inner)}: `_target_` is not allowed")
    top = _entries(node)
    if group in DATA_GROUPS:
        if placed:
            raise ConfigError(f"{path}: `# @package` is not allowed in a file of {group}/")
        if "defaults" in top:
            raise ConfigError(f"{path}: a file of {group}/ has no defaults list")
    else:
        _check_recipe(path, top, placed, folder)
    plant = node if group == "plant" else top.get("plant")
    if isinstance(plant, yaml.MappingNode):
        _check_plant(path, plant, named=group in ("plant", None))


def _read(path: str) -> str | None:
    """The text of a file, or None if it is not text."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"{path} is not a regular file")
        if status.st_size > _MAX_BYTES:
            raise ConfigError(f"{path} has {status.st_size} bytes; at most {_MAX_BYTES} are read")
        with open(path, encoding="utf-8") as stream:
            return stream.read()
    except UnicodeDecodeError:
        return None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error


def _check_size(path: str, text: str) -> None:
    """Count entries, as they would be with aliases expanded, and levels, from events alone."""
    sizes: dict[str, int | None] = {}  # of anchored nodes; None while one is still open
    open_nodes: list[tuple[str | None, int]] = []  # anchor and the count where it began
    count = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            size = sizes.get(str(event.anchor), 1)
            if size is None:
                raise ConfigError(f"{path}, line {_line(event)}: *{event.anchor} contains itself")
            count += size
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            if len(open_nodes) >= _MAX_DEPTH:
                raise ConfigError(
                    f"{path}, line {_line(event)}: nested more than {_MAX_DEPTH} levels deep"
                )
            if event.anchor is not None:
                sizes[event.anchor] = None
            open_nodes.append((event.anchor, count))
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = count - before
        if count > _MAX_ENTRIES:
            raise ConfigError(
                f"{path}, line {_line(event)}: more than {_MAX_ENTRIES} entries, aliases expanded"
            )


def _entries(node: yaml.MappingNode) -> dict[str, yaml.Node]:
    return {key.value: value for key, value in node.value if isinstance(key, yaml.ScalarNode)}


def _check_recipe(path: str, top: Mapping[str, yaml.Node], placed: str, folder: str) -> None:
    """An experiment or a primary configuration; ``placed`` is what ``# @package`` says."""
    if placed not in ("", "_global_"):
        raise ConfigError(f"{path}: only `# @package _global_` is allowed, got {placed!r}")
    defaults = top.get("defaults")
    entries = defaults.value if isinstance(defaults, yaml.SequenceNode) else []
    for entry in entries:
        if isinstance(entry, yaml.ScalarNode) and entry.value == "_self_":
            continue
        pairs = entry.value if isinstance(entry, yaml.MappingNode) else [(entry, entry)]
        for key, value in pairs:
            if not _may_choose(key, value, folder):
                raise ConfigError(
                    f"{path}, line {_line(entry)}: a defaults list may choose a file of "
                    f"{', '.join(GROUPS)}, as in `- override /plant: circuit`"
                )
    section = top.get("hydra")
    if section is None:
        return
    if not isinstance(section, yaml.MappingNode):
        raise ConfigError(f"{path}, line {_line(section)}: hydra must be a mapping")
    for key, value in section.value:
        inner = _HYDRA_KEYS.get(key.value)
        given = value.value if isinstance(value, yaml.MappingNode) else []
        excess = [k.value for k, _ in given if inner is not None and k.value not in inner]
        if key.value not in _HYDRA_KEYS or excess:
            name = ".".join(["hydra", str(key.value), *map(str, excess[:1])])
            raise ConfigError(
                f"{path}, line {_line(key)}: {name} is not allowed in a file of a --config-dir; "
                f"allowed: {', '.join(_HYDRA_KEYS)}"
            )


def _may_choose(key: yaml.Node, value: yaml.Node, folder: str) -> bool:
    """Whether a defaults list may have this entry: of Hydra's own groups, only Hydra's files."""
    if not (isinstance(key, yaml.ScalarNode) and isinstance(value, yaml.ScalarNode)):
        return False
    group = _DEFAULTS_ENTRY.fullmatch(key.value)
    if group is None or _DEFAULTS_VALUE.fullmatch(value.value) is None:
        return False
    mine = os.path.join(folder, group[2], f"{value.value}.yaml")
    return group[2] in GROUPS or not os.path.exists(mine)


def _check_plant(path: str, node: yaml.MappingNode, *, named: bool) -> None:
    """A plant, in its own file or in another; ``named`` if it must have a name itself."""
    for inner in _nodes(node):
        if isinstance(inner, yaml.ScalarNode) and "${" in inner.value:
            raise ConfigError(
                f"{path}, line {_line(inner)}: ${{…}} is not allowed in a plant; write the value"
            )
    name = _entries(node).get("name")
    if name is None and not named:
        return
    if not isinstance(name, yaml.ScalarNode) or not name.value:
        raise ConfigError(f"{path}: name is missing; every plant has one, as in `name: mine`")
    if not _PLANT_NAME.fullmatch(name.value):
        raise ConfigError(
            f"{path}, line {_line(name)}: name must be letters, digits, spaces and _ . - "
            "(80 at most), for it becomes part of a folder's name"
        )


def _nodes(root: yaml.Node) -> Iterator[yaml.Node]:
    """Every node once, keys included, however often aliases repeat it."""
    seen: set[int] = set()
    waiting: list[yaml.Node] = [root]
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        yield node
        if isinstance(node, yaml.SequenceNode):
            waiting.extend(node.value)
        elif isinstance(node, yaml.MappingNode):
            for pair in node.value:
                waiting.extend(pair)


def _line(item: Any) -> int:
    return int(item.start_mark.line) + 1
