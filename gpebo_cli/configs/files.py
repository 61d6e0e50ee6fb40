"""Files of a configuration as plain data, checked: ours, and those of a ``--config-dir``.

A file of a ``--config-dir`` may be a stranger's. It is read here and nowhere else, and what it
may say is little: a file of a group says values of that group; a recipe, or a whole
configuration, chooses files of groups, gives values of known keys, and may sweep.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from gpebo_cli.configs.configuration import KEYS
from gpebo_cli.configs.locations import DATA_GROUPS, GROUPS, PRIMARY, conf_folder
from gpebo_cli.errors import ConfigError
from gpebo_cli.plain_yaml import parse
from gpebo_cli.reading import read_text
from gpebo_cli.schema import known_name, plain, shown

GLOBAL = "_global_"
"""Where the content of a recipe belongs: at the top."""

_MAX_BYTES = 2_000_000
_LAUNCHER = "launcher"  # our own group, of which others cannot bring files

_HEADER = re.compile(r"\s*#\s*@package\s+(\S+)")
_CHOICE = re.compile(rf"(?:(?:optional|override)\s+)*/?({'|'.join(GROUPS)}|(?:hydra/)?launcher)")
_NAME = re.compile(r"[\w -]+(\.[\w -]+)*(/[\w -]+(\.[\w -]+)*)*")
_SWEPT = re.compile(rf"(?:{'|'.join((*GROUPS, *KEYS))})(?:\.[\w-]+)*")
_SECTIONS = (*GROUPS, "time", "excitation", "output")
_SWEEPER_KEYS = ("params", "max_batch_size", "fail_fast")


def is_file(folder: str, inside: str) -> bool:
    """Whether ``folder`` has ``inside`` (``plant/mine``), of any kind, and may bring such files."""
    brings = "/" not in inside or is_group(folder, inside.partition("/")[0])
    path = os.path.join(folder, f"{inside}.yaml")
    return brings and os.path.normpath(path) == path and os.path.lexists(path)


def is_group(folder: str, group: str) -> bool:
    """Whether ``folder`` brings files of ``group``; only ours brings launchers, which are code."""
    known = group in GROUPS or (group == _LAUNCHER and folder == conf_folder())
    return known and os.path.isdir(os.path.join(folder, group))


def package(inside: str) -> str:
    """Where the content of the file ``inside`` belongs in the configuration."""
    group = inside.partition("/")[0]
    if group == "regression":
        group = "plant"  # in place of which it stands
    return group if "/" in inside and group in DATA_GROUPS else GLOBAL


def load(folder: str, inside: str) -> dict[str, Any]:
    """The content of ``folder/inside.yaml``; of a file of ours, as it is.

    ``inside`` is ``GROUP/NAME`` or the name of a primary configuration, and the folder may be a
    stranger's (ConfigError: the file cannot be read, or asks for what its kind may not).
    """
    path = os.path.join(folder, f"{inside}.yaml")
    if folder == conf_folder():
        return shipped(inside)
    real, root = os.path.realpath(path), os.path.realpath(folder)
    if os.path.commonpath([real, root]) != root:
        raise ConfigError(f"{path} is {real}, outside {root}; copy the file into the folder")
    if is_file(conf_folder(), inside):
        raise ConfigError(
            f"{path} has the name of one that comes with gpebo and would be ignored; rename it"
        )
    return _checked(real, path, inside)


def load_path(path: str, group: str) -> dict[str, Any]:
    """The content of a file that its user named by path; ``group`` says what it may say."""
    return _checked(path, path, f"{group}/file")


def shipped(inside: str) -> dict[str, Any]:
    """A file that comes with gpebo; it is parsed once, and everybody gets a copy."""
    copied: dict[str, Any] = plain(_shipped(inside))
    return copied


@cache
def _shipped(inside: str) -> dict[str, Any]:
    path = os.path.join(conf_folder(), f"{inside}.yaml")
    return _mapping(path, parse(read_text(path, _MAX_BYTES), path, ours=True))


def _mapping(path: str, content: object) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected a mapping of keys to values, got {shown(content)}")
    return content


def _checked(real: str, path: str, inside: str) -> dict[str, Any]:
    text = read_text(real, _MAX_BYTES)
    content = _mapping(path, parse(text, path))
    where = package(inside)
    for line in text.splitlines():  # a comment that Hydra would obey, and which does nothing here
        if match := _HEADER.match(line):
            if where != GLOBAL:
                raise ConfigError(f"{path}: `# @package` is not allowed in a file of a group")
            if match[1] != GLOBAL:
                raise ConfigError(
                    f"{path}: only `# @package {GLOBAL}` is allowed, got {shown(match[1])}"
                )
    if where != GLOBAL:
        if "defaults" in content:
            raise ConfigError(f"{path}: a file of {where}/ has no defaults list")
        return content
    recipe = _recipe(path, content)
    return recipe if "/" in inside else _primary(recipe)


def _recipe(path: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """A recipe or a whole configuration: choices, values of known keys, and a sweep."""
    for key, value in content.items():
        if key not in ("defaults", "hydra"):
            known_name(key, KEYS, f"{path}: {shown(key)}: no such key", "there are")
        if key in _SECTIONS and not isinstance(value, dict | None):
            choice = f"; files are chosen as in `- override /{key}: NAME`" if key in GROUPS else ""
            raise ConfigError(
                f"{path}: {key}: expected a mapping of keys to values, got {shown(value)}{choice}"
            )
    recipe = dict(content)
    defaults = recipe.pop("defaults", None)
    if defaults is not None:
        chosen = list(_choices(path, defaults))
        recipe["defaults"] = chosen if "_self_" in chosen else [*chosen, "_self_"]
    hydra = recipe.pop("hydra", None)
    if hydra is not None:
        recipe["hydra"] = _hydra(path, hydra)
    return recipe


def _choices(path: str, defaults: object) -> Iterator[Any]:
    for entry in defaults if isinstance(defaults, list) else [defaults]:
        if entry == "_self_":
            yield entry
            continue
        pair = list(entry.items()) if isinstance(entry, dict) else []
        key, name = pair[0] if len(pair) == 1 else ("", None)
        named = name is None or (isinstance(name, str) and _NAME.fullmatch(name))
        if not (named and _CHOICE.fullmatch(key)):
            raise ConfigError(
                f"{path}: {shown(entry)}: a defaults list may choose a file of "
                f"{', '.join(GROUPS)}, as in `- override /plant: circuit`"
            )
        yield entry


def _hydra(path: str, section: object) -> dict[str, Any]:
    """What a file may say of Hydra: that it sweeps, and over what."""
    if not isinstance(section, dict):
        raise ConfigError(f"{path}: hydra must be a mapping, got {shown(section)}")
    for key, value in section.items():
        sweeper = value if key == "sweeper" and isinstance(value, dict) else {}
        excess = [name for name in sweeper if name not in _SWEEPER_KEYS]
        if excess or (key != "mode" and not sweeper):
            raise ConfigError(
                f"{path}: {'.'.join(['hydra', key, *excess[:1]])} is not allowed in a file of a "
                f"--config-dir; allowed: mode, {', '.join(f'sweeper.{k}' for k in _SWEEPER_KEYS)}"
            )
        params = sweeper.get("params") or {}
        for name, values in params.items() if isinstance(params, dict) else [(params, "")]:
            # A backslash can hide ``${`` in what Hydra's grammar reads.
            if not (isinstance(name, str) and _SWEPT.fullmatch(name)) or "\\" in str(values):
                raise ConfigError(
                    f"{path}: hydra.sweeper.params: {shown(f'{name}={values}')} cannot be swept"
                )
    return section


def _primary(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """A whole configuration: what it does not say is as in ours, groups included."""
    ours = shipped(PRIMARY)
    given = recipe.get("defaults", ["_self_"])
    chosen = {_group(entry) for entry in given}
    rest = [e for e in ours["defaults"] if _group(e) not in {*chosen, *recipe, "_self_"}]
    hydra = {**ours["hydra"], **recipe.get("hydra", {})}
    return {**ours, **recipe, "defaults": [*given, *rest], "hydra": hydra}


def _group(entry: Any) -> str:
    """The group that an entry of a defaults list chooses from."""
    return str(next(iter(entry))).split()[-1].lstrip("/") if isinstance(entry, dict) else entry
