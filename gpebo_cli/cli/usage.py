"""What `--help` prints: a text of the folder ``help``, shown without importing anything."""

from __future__ import annotations

import os

from gpebo_cli.configs.locations import GROUPS, choices, conf_folder, default

_NOTES = {"experiment": "   (a recipe; none by default)"}


def help_of(command: str = "gpebo") -> str:
    """The help of a command, by default of all; ``run`` has groups with what is on disk."""
    path = os.path.join(os.path.dirname(__file__), "help", f"{command}.txt")
    with open(path, encoding="utf-8") as stream:
        text = stream.read()
    return text.replace("{groups}", "".join(map(_choices, GROUPS))) if command == "run" else text


def _choices(group: str) -> str:
    """The lines of a group: the default first, the rest by name."""
    first = default(group)
    names = sorted(choices(conf_folder(), group), key=lambda name: name != first)  # it is stable
    return _wrapped(f"  {group + '=':<12} ", f"{' '.join(names)}{_NOTES.get(group, '')}")


def _wrapped(head: str, text: str) -> str:
    """Lines of at most 100 characters; ``textwrap`` takes longer to load than all of this."""
    lines = [head]
    for word in text.split(" "):
        if len(lines[-1]) + len(word) >= 100:
            lines.append(" " * len(head))
        lines[-1] += f"{word} "
    return "".join(f"{line.rstrip()}\n" for line in lines)
