"""Where the configuration lives, and the names it offers."""

from __future__ import annotations

import os
from functools import cache

GROUPS = ("plant", "regression", "data", "observer", "estimator", "solver", "noise", "experiment")

DATA_GROUPS = ("plant", "data", "observer", "estimator", "solver", "noise")
"""Groups whose files are values only; an experiment may choose from groups and set anything."""

LOOK = ("formats", "width", "dpi", "style", "error")
"""Keys of ``output`` that are ``figures.…`` for a person; ``figures`` alone says which ones."""

PRIMARY = "gpebo"
"""The primary configuration, conf/gpebo.yaml; another name than a run's own config.yaml."""


_HEAD = 1 << 16  # characters of a file that :func:`outline` looks at


@cache
def conf_folder() -> str:
    """The folder of configuration files: inside the installed package, else the checkout's.

    A wheel carries it as ``gpebo_cli/conf``. An editable installation has no such copy (it
    ignores what a wheel is told to include), and a checkout keeps it at the top.
    """
    package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    shipped = os.path.join(package, "conf")
    return shipped if os.path.isdir(shipped) else os.path.join(os.path.dirname(package), "conf")


def choices(folder: str, group: str, *, inside: bool = False) -> list[str]:
    """Names of the files of a group in ``folder``, sorted; none if there is no such group.

    With ``inside`` those in folders of the group follow, such as ``published/lorenz``.
    """
    home = os.path.join(folder, group)
    try:
        names = sorted(os.listdir(home))
    except (FileNotFoundError, NotADirectoryError):
        return []
    found = [name.removesuffix(".yaml") for name in names if name.endswith(".yaml")]
    for name in names if inside else ():
        path = os.path.join(home, name)
        if os.path.isdir(path) and not os.path.islink(path):
            found += [f"{name}/{one}" for one in choices(home, name, inside=True)]
    return found


def outline(path: str, section: str = "") -> dict[str, str]:
    """Keys of a YAML file, or of one of its sections, with the texts behind them on their lines.

    Reads lines, not YAML: a parser takes longer to import than everything that needs this takes,
    and a file that is hostile, or half-written, costs nothing. What is no file has no keys.
    """
    if not os.path.isfile(path):  # a pipe would block
        return {}
    with open(path, encoding="utf-8", errors="replace") as stream:
        lines = stream.read(_HEAD).splitlines()
    found: dict[str, str] = {}
    inside = not section
    for line in lines:
        key, colon, value = line.strip().partition(":")
        indent = len(line) - len(line.lstrip())
        if not colon or key.startswith("#"):
            continue
        if section and not indent:
            inside = key == section
        elif inside and (0 < indent <= 2 if section else not indent):
            found.setdefault(key, value)
    return found


def default(group: str) -> str:
    """The file of ``group`` that the primary configuration chooses; nothing if it chooses none."""
    chosen = outline(os.path.join(conf_folder(), f"{PRIMARY}.yaml"), "defaults")
    return chosen.get(f"- {group}", "").partition("#")[0].strip()
