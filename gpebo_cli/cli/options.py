"""Words of a command: options with a value, switches, and the rest."""

from __future__ import annotations

import os

from gpebo_cli.errors import ConfigError

TYPE_CHECKING = False
if TYPE_CHECKING:  # `gpebo list` loads nothing that Python has not loaded
    from collections.abc import Collection, Mapping, Sequence

VOLUME = ("--quiet", "--verbose")
"""Switches of commands that take long: nothing but errors, or how long each stage took."""

CONFIG_DIR = {"--config-dir": "a folder"}
"""Where files of one's own are, for those commands that look for some."""

SHORT = {
    "-m": "--multirun", "-q": "--quiet", "-v": "--verbose", "-c": "--cfg",
    "-cd": "--config-dir", "-cn": "--config-name", "-i": "--info",
}
"""The long names of short options."""


class Options:
    """The words of a command, sorted.

    Attributes:
        values: by the long name of an option, the last one where it was given twice.
        switches: those that were given, by their long names.
        words: the rest, in order.
        quiet: whether only errors and warnings are wanted.
        loud: whether stages and what the solvers did are wanted, too.
    """

    def __init__(
        self, values: Mapping[str, str], switches: frozenset[str], words: tuple[str, ...]
    ) -> None:
        self.values = values
        self.switches = switches
        self.words = words
        self.quiet = "--quiet" in switches
        self.loud = "--verbose" in switches

    @property
    def config_dir(self) -> str | None:
        """The folder given with ``--config-dir``, absolute (ConfigError: there is none)."""
        if (given := self.values.get("--config-dir")) is None:
            return None
        folder = os.path.abspath(os.path.expanduser(given))
        if not os.path.isdir(folder):
            raise ConfigError(f"--config-dir {given}: there is no such folder")
        return folder


PLAIN = Options({}, frozenset(), ())
"""No words."""


def parse(
    command: str, words: Sequence[str], values: Mapping[str, str], switches: Collection[str] = ()
) -> Options:
    """Sort the words of ``gpebo <command>``, all options by their long names.

    Those with a value, ``--option VALUE`` or ``--option=VALUE``, come with what it is: "a folder"
    (ConfigError: an unknown option, or one without its value).
    """
    given: dict[str, str] = {}
    switched: set[str] = set()
    others: list[str] = []
    rest = iter(words)
    for word in rest:
        key, equals, value = word.partition("=")
        key = SHORT.get(key, key)
        if key in values:
            value = value if equals else next(rest, "")
            if not value or value.startswith("--"):
                raise ConfigError(f"{key} needs {values[key]}; see gpebo {command} --help")
            given[key] = value
        elif key in switches:
            if equals:
                raise ConfigError(f"{key} takes no value, got {value!r}")
            switched.add(key)
        elif word.startswith("-"):
            raise no_option(command, key, (*values, *switches, "--help"))
        else:
            others.append(word)
    return Options(given, frozenset(switched), tuple(others))


def no_option(command: str, key: str, known: Sequence[str]) -> ConfigError:
    """The error for an option that the command does not have."""
    from gpebo_cli.schema import nearest, shown

    return ConfigError(
        f"gpebo {command}: {shown(key)} is no option; see gpebo {command} --help"
        + nearest(key, known)
    )
