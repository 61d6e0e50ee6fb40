"""From what a caller gives to the configuration of one run, with the files' own defaults.

``conf/gpebo.yaml`` and the files of its groups are read as for the command line, so that a default
is written in one place.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from typing import Any

from gpebo_cli.configs import files, locations
from gpebo_cli.configs.locations import choices, conf_folder
from gpebo_cli.errors import ConfigError
from gpebo_cli.reading import as_seen_from_here
from gpebo_cli.registry import installed
from gpebo_cli.schema import nearest, plain, shown

_WHOLE = ("plant", "regression")  # a mapping or a file of these is all of it


default = cache(locations.default)  # a run asks for every group


def choose(
    group: str, given: object, config_dir: str | os.PathLike[str] | None
) -> tuple[dict[str, Any], str]:
    """The content of a group and the file that it is from.

    ``given`` is None (the default), the name of a file of the group, or a mapping: its ``name`` is
    that of a file, whose values hold where the mapping says nothing. Of a plant, it is also the
    path of a file, or a mapping or draft that is the whole of it (ConfigError: nothing has that
    name).
    """
    if group in _WHOLE and hasattr(given, "mapping"):
        given = given.mapping()
    if group in _WHOLE and isinstance(given, Mapping):
        return dict(given), ""
    if isinstance(given, Mapping):
        name = given.get("name", default(group))
        base, source = choose(group, name, config_dir)
        return {**base, **plain(given), "name": base.get("name", name)}, source
    if given is None:
        given = default(group)
    if group in _WHOLE and (path := _as_path(given)) is not None:
        path = os.path.expanduser(path)
        if not os.path.exists(path):
            raise ConfigError(f"{path}: there is no such file")
        return files.load_path(path, group), as_seen_from_here(path)
    if not isinstance(given, str):
        wanted = "a name, a path, a mapping or a DescriptorSystem" if group in _WHOLE else (
            "a name or a mapping"
        )
        raise ConfigError(f"{group}: expected {wanted}, got {shown(given)}")
    return _named(group, given, config_dir)


def _as_path(given: object) -> str | None:
    """``given`` as the path of a file, or None if it is no path."""
    if isinstance(given, os.PathLike):
        return str(os.fspath(given))
    own = isinstance(given, str) and given.startswith((os.sep, ".", "~"))
    return str(given) if own or str(given).endswith((".yaml", ".yml")) else None


def _named(
    group: str, name: str, config_dir: str | os.PathLike[str] | None
) -> tuple[dict[str, Any], str]:
    inside, home = f"{group}/{name}", folders(config_dir)
    for folder in home:
        if files.is_file(folder, inside):
            path = os.path.join(folder, f"{inside}.yaml")
            return files.load(folder, inside), as_seen_from_here(path)
    names = sorted(known for folder in home for known in choices(folder, group))
    text = f"{group}={name}: there is no such {group}; known: {', '.join(names)}"
    hint = installed(group, name) or nearest(name, names)
    if not hint and config_dir is None:
        hint = f" (yours: config_dir=DIR with DIR/{group}/{name}.yaml)"
    raise ConfigError(text + hint)


def folders(config_dir: str | os.PathLike[str] | None) -> list[str]:
    """Where files are looked for: ours and, if there is one, a folder of the caller's.

    That one comes first, so that a file in it with a name of ours is noticed (ConfigError: there
    is no such folder).
    """
    if config_dir is None:
        return [conf_folder()]
    own = os.path.abspath(os.path.expanduser(os.fspath(config_dir)))
    if not os.path.isdir(own):
        raise ConfigError(f"config_dir {config_dir}: there is no such folder")
    return [own, conf_folder()]
