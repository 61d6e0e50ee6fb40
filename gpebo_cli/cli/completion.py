"""``gpebo completion SHELL``: the script a shell loads, and the candidates it asks for.

The scripts are short: they hand over the words before the cursor (``gpebo __complete``) and get
back one candidate a line. So all shells offer the same, files of a ``--config-dir`` included, and
a new plant needs no new script. Files are read line by line: the answer takes as long as
``gpebo list``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress

from gpebo_cli.cli.app import COMMANDS
from gpebo_cli.cli.arguments import OPTIONS, VALUES
from gpebo_cli.cli.listing import KINDS, described
from gpebo_cli.cli.options import SHORT, VOLUME
from gpebo_cli.cli.usage import help_of
from gpebo_cli.configs.locations import DATA_GROUPS, GROUPS, choices, conf_folder, default, outline
from gpebo_cli.errors import ConfigError
from gpebo_cli.results.names import FIGURE_NAMES, FORMATS, METRICS
from gpebo_cli.schema import nearest, shown

_LAUNCHER = "launcher"
_SWEEP_FOLDERS = ("resume", "hydra.run.dir", "hydra.sweep.dir")
_FIXED = {
    "fail_fast": ("true", "false"),
    "observer.regression": ("projected", "paper"),
    "observer.L_w": ("diagonal", "remark4"),
    "figures": ("all", "none", "["),
}
_FOLDER_OPTIONS = ("--config-dir", "-cd", "--output", "--check", "--update")
_WITH_KEYS = tuple(group for group in DATA_GROUPS if group != "plant")
_NOT_KEYS = ("name", "title", "reference", "defaults", "hydra")

SHELLS = ("bash", "zsh", "fish")
"""The shells there are scripts for, in the folder ``shells``."""


def main(words: list[str]) -> int:
    """Print the script of a shell; the exit code (ConfigError)."""
    if len(words) != 1 or words[0] not in SHELLS:
        given = shown(" ".join(words)) if words else "nothing"
        raise ConfigError(
            f"gpebo completion needs one of {', '.join(SHELLS)}; got {given}"
            + nearest(" ".join(words), SHELLS)
        )
    path = os.path.join(os.path.dirname(__file__), "shells", f"gpebo.{words[0]}")
    with open(path, encoding="utf-8") as stream:
        sys.stdout.write(stream.read())
    return 0


def answer(words: list[str]) -> int:
    """Print the candidates for the last of ``words`` (perhaps empty), one a line; 0."""
    if words[:1] == ["--line"]:
        words = _split(" ".join(words[1:]))
    for candidate in candidates(words or [""]):
        sys.stdout.write(f"{candidate}\n")
    return 0


def _split(line: str) -> list[str]:
    """The words after ``gpebo`` in a line as typed so far; the last one is being typed."""
    words = [word.strip("'\"") for word in line.split()]
    if line[-1:].isspace():
        words.append("")
    named = [i for i, word in enumerate(words) if os.path.basename(word) == "gpebo"]
    return words[(named[0] if named else 0) + 1 :]


def candidates(words: Sequence[str]) -> list[str]:
    """What the last of the words after ``gpebo`` can become, with a description behind a tab."""
    *before, word = words
    found = dict.fromkeys(_in_place(before, word))
    return [candidate for candidate in found if candidate.startswith(word)]


def _in_place(before: Sequence[str], word: str) -> Iterable[str]:
    """All that can stand in the place of ``word``, some of it with another beginning."""
    if not before:
        return [*COMMANDS, "--help", "--version"]
    command, *before = before
    last, (key, equals, _) = "".join(before[-1:]), word.partition("=")
    if last in _FOLDER_OPTIONS or (equals and key in (*_FOLDER_OPTIONS, *_SWEEP_FOLDERS)):
        return _folders(word)
    if command in ("run", "check"):
        return _of_run(command, before, word)
    if key == "figures.formats" and equals:
        return _listed(word, FORMATS)
    if command in ("compare", "report") and last != "--sort" and not word.startswith("-"):
        return _folders(word)
    found: dict[str, Iterable[str]] = {
        "list": KINDS,
        "figures": [*choices(conf_folder(), "experiment"), "figures.formats=", *VOLUME],
        "new": [] if before else ["plant", "estimator", "observer", "recipe", "recording"],
        "reproduce": [*choices(conf_folder(), "experiment/published"), *VOLUME],
        "completion": SHELLS,
        "compare": METRICS if last == "--sort" else (),
    }
    return [*found.get(command, ()), *(_options(command) if command in COMMANDS else ())]


def _options(command: str) -> list[str]:
    """The options that the help of a command names."""
    text = "" if command == "completion" else help_of(command)  # that one names those of others
    words = [word.strip("[],") for word in text.split()]
    return [*(word for word in words if word.startswith("--")), "--help"]


def _of_run(command: str, before: Sequence[str], word: str) -> Iterable[str]:
    """Options, groups and keys, and the values of those that have a few."""
    folders = [conf_folder(), *_config_dir(before)]
    last = "".join(before[-1:])
    last = SHORT.get(last, last)
    if last == "--config-name":
        return [name for folder in folders for name in choices(folder, "")]
    if last in VALUES:
        return VALUES[last]
    if word.startswith("-"):
        return ["--json" if command == "check" else "-m", "--help", *OPTIONS]
    key, equals, _ = word.partition("=")
    if equals:
        return _values(key, word, folders)
    return [*(f"{group}=" for group in (*GROUPS, _LAUNCHER)), *_keys(word, before, folders)]


def _values(key: str, word: str, folders: Sequence[str]) -> list[str]:
    if key == "figures" and "[" in word:
        return _listed(word, FIGURE_NAMES)
    if key not in (*GROUPS, _LAUNCHER):
        return [f"{key}={value}" for value in _FIXED.get(key, ())]
    # Of a sweep, plant=a,b: what stands before the last comma stays.
    head, comma, _ = word.rpartition(",")
    stem = head + comma if comma else f"{key}="
    taken = head.partition("=")[2].split(",")
    titles: dict[str, str] = {}
    for folder in folders:
        for name in choices(folder, key, inside=True):
            if name not in taken:
                path = os.path.join(folder, key, f"{name}.yaml")
                titles.setdefault(f"{stem}{name}", described(path)[0])
    return [f"{text}\t{title}".rstrip() for text, title in titles.items()]


def _keys(word: str, before: Sequence[str], folders: Sequence[str]) -> list[str]:
    """Keys of the configuration: sections, and with a section typed, what is in it."""
    primary = os.path.join(conf_folder(), "gpebo.yaml")
    section, dot, _ = word.partition(".")
    if not dot:
        top = [key for key in _outline(primary) if key not in (*_NOT_KEYS, "figures")]
        inside = [f"{name}." for name in (*_WITH_KEYS, *top)]
        return ["figures=", "fail_fast=", *(f"{key}=" for key in _SWEEP_FOLDERS), *inside]
    if section == "hydra":
        return [f"{key}=" for key in _SWEEP_FOLDERS]
    if section in _WITH_KEYS:
        chosen = [w.partition("=")[2] for w in before if w.startswith(f"{section}=")]
        name = chosen[-1] if chosen else default(section)
        paths = [os.path.join(folder, section, f"{name}.yaml") for folder in folders]
        keys = [key for path in paths for key in _outline(path) if key not in _NOT_KEYS]
    else:
        keys = _outline(primary, section)
    return [f"{section}.{key}=" for key in keys]


def _outline(path: str, section: str = "") -> list[str]:
    """Keys of a file of ours, or of a section, that are set by name."""
    with suppress(OSError):
        return [key for key in outline(path, section) if key[:1].isalpha()]
    return []


def _config_dir(words: Sequence[str]) -> list[str]:
    """The folder that ``--config-dir`` names among the words, if it does."""
    for position, word in enumerate(words):
        flag, equals, value = word.partition("=")
        if flag in ("--config-dir", "-cd"):
            folder = value if equals else "".join(words[position + 1 : position + 2])
            return [os.path.expanduser(folder)] if folder else []
    return []


def _folders(word: str) -> list[str]:
    """Folders that what stands behind an option's ``=`` can become, with a slash at the end."""
    key, equals, path = word.rpartition("=")
    stem = key + equals + path[: path.rfind("/") + 1]
    try:
        inside = os.scandir(os.path.expanduser(os.path.dirname(path)) or ".")
    except OSError:
        return []
    hidden = os.path.basename(path).startswith(".")
    found = [one.name for one in inside if one.is_dir() and (hidden or one.name[0] != ".")]
    return [f"{stem}{name}/" for name in sorted(found)]


def _listed(word: str, names: Iterable[str]) -> list[str]:
    """``[a,b`` with one more name."""
    head, separator, _ = word.rpartition("," if "," in word else "[")
    given = head.partition("[")[2].split(",")
    begun = head + separator if separator else f"{word.partition('=')[0]}=["
    return [f"{begun}{name}" for name in names if name not in given]
