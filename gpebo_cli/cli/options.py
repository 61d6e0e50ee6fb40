"""Words of the commands that Hydra does not run: options with a value, switches, and the rest."""

from __future__ import annotations

from gpebo_cli.errors import ConfigError

TYPE_CHECKING = False
if TYPE_CHECKING:  # `gpebo list` loads nothing that Python has not loaded
    from collections.abc import Mapping, Sequence

VOLUME = ("--quiet", "-q", "--verbose", "-v")
"""Switches of commands that take long: nothing but errors, or how long each stage took."""

CONFIG_DIR = {"--config-dir": "a folder", "-cd": "a folder"}
"""Where files of one's own are, for those commands that look for some."""


class Options:
    """The words of a command, sorted.

    Attributes:
        values: by option, the last one where it was given twice.
        switches: those that were given.
        words: the rest, in order.
    """

    def __init__(
        self, values: Mapping[str, str], switches: frozenset[str], words: tuple[str, ...]
    ) -> None:
        self.values = values
        self.switches = switches
        self.words = words

    @property
    def config_dir(self) -> str | None:
        """The folder given with ``--config-dir`` or ``-cd``."""
        return self.values.get("--config-dir", self.values.get("-cd"))

    @property
    def quiet(self) -> bool:
        """Whether only errors are wanted."""
        return not {"--quiet", "-q"}.isdisjoint(self.switches)

    @property
    def loud(self) -> bool:
        """Whether stages are wanted, too."""
        return not {"--verbose", "-v"}.isdisjoint(self.switches)


PLAIN = Options({}, frozenset(), ())
"""No words."""


def parse(
    command: str, words: Sequence[str], values: Mapping[str, str], switches: Sequence[str] = ()
) -> Options:
    """Sort the words of ``gpebo <command>``.

    Args:
        command: its name, for messages.
        words: what follows it.
        values: options that have a value, ``--option VALUE`` or ``--option=VALUE``, and what the
            value is: "a folder".
        switches: options that have none.

    Raises:
        ConfigError: an unknown option, or one without its value.
    """
    given: dict[str, str] = {}
    switched: set[str] = set()
    others: list[str] = []
    rest = iter(words)
    for word in rest:
        key, equals, value = word.partition("=")
        if key in values:
            value = value if equals else next(rest, "")
            if not value or value.startswith("--"):
                raise ConfigError(f"{key} needs {values[key]}; see gpebo {command} --help")
            given[key] = value
        elif word in switches:
            switched.add(word)
        elif word.startswith("-"):
            raise no_option(command, key, (*values, *switches, "--help"))
        else:
            others.append(word)
    return Options(given, frozenset(switched), tuple(others))


def no_option(command: str, key: str, known: Sequence[str]) -> ConfigError:
    """The error for an option that the command does not have."""
    from gpebo_cli.schema import nearest, shown

    long = [name for name in known if name.startswith("--") or len(name) > 3]
    return ConfigError(
        f"gpebo {command}: {shown(key)} is no option; known: {', '.join(long)}"
        + nearest(key, long)
    )
