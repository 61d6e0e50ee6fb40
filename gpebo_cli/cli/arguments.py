"""The words after ``gpebo run``, sorted before Hydra sees them.

Hydra's own parser answers a wrong flag with several lines, and refuses overrides on both sides
of a flag (``plant=circuit -m gain=1,2``). Here flags are checked, and handed on after all
overrides.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from gpebo_cli.cli import options
from gpebo_cli.cli.options import PLAIN, Options
from gpebo_cli.configs.locations import GROUPS, LOOK, PRIMARY, choices, conf_folder
from gpebo_cli.errors import ConfigError
from gpebo_cli.schema import convert, known_name, shown

VALUES = {
    "--cfg": ("job", "hydra", "all"),
    "--info": ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath"),
}
"""What an option that has few values accepts."""

_WITH_VALUE = {
    **{flag: f"one of {', '.join(accepted)}" for flag, accepted in VALUES.items()},
    **dict.fromkeys(("--config-dir", "--config-name"), "a value"),
}
_SWITCHES = ("--multirun", "--dry-run", "--quiet", "--verbose", "--resolve", "--hydra-help")
OPTIONS = (*_SWITCHES, *_WITH_VALUE)
"""Long names of all options of ``gpebo run``."""

_ONE_OF = ("--multirun", "--cfg", "--info", "--hydra-help")

_LOGSPACE = re.compile(r"^([^=]+)=(logspace\([^()'\"]*\))$")
# What Hydra's grammar reads as a number, a truth value or nothing.
_NOT_TEXT = re.compile(
    r"[+-]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(e[+-]?\d+)?|[+-]?(inf|nan)|true|false|null", re.IGNORECASE
)

_SWEEP_WORDS = ("resume", "fail_fast")  # of a sweep, not of the configuration
_KEYS = (
    *GROUPS, "launcher", "time", "excitation", "figures", "output", "uncertainty", *_SWEEP_WORDS,
)


@dataclass(frozen=True)
class Arguments:
    """What ``gpebo run`` was asked to do."""

    given: Options = PLAIN
    overrides: tuple[str, ...] = ()
    config_dir: str | None = None  # absolute
    config_name: str = PRIMARY
    resume: str | None = None  # absolute folder of a sweep to go on with
    fail_fast: str = ""  # as given; empty: not given

    @property
    def of_a_sweep(self) -> str:
        """A word that only a sweep understands, or nothing."""
        if "--dry-run" in self.given.switches:
            return "--dry-run"
        return "resume" if self.resume else "fail_fast" if self.fail_fast else ""

    @property
    def for_hydra(self) -> list[str]:
        """The overrides that Hydra composes."""
        # Chosen here rather than in conf/gpebo.yaml: other primary configurations sweep, too.
        words = [*self.overrides, "hydra/sweeper=gpebo"]
        if self.resume is not None:
            folder = quoted(self.resume)
            words += [f"hydra.sweeper.resume={folder}", f"hydra.sweep.dir={folder}"]
        if self.fail_fast:
            words.append(f"hydra.sweeper.fail_fast={self.fail_fast}")
        orders = {"dry_run": "--dry-run" in self.given.switches, "quiet": self.given.quiet}
        return words + [f"hydra.sweeper.{key}=true" for key, given in orders.items() if given]

    @property
    def folders(self) -> list[str]:
        """Where configuration is looked for, in this order."""
        return [conf_folder(), *([] if self.config_dir is None else [self.config_dir])]

    def known(self, group: str) -> list[str]:
        """Names of the files of a group there."""
        return [name for folder in self.folders for name in choices(folder, group)]


NO_WORDS = Arguments()


def parse(words: list[str], command: str = "run", more: Sequence[str] = ()) -> Arguments:
    """Sort the words behind a command that takes those of ``gpebo run``, and ``more`` switches.

    A ConfigError tells of an unknown flag, a flag without its value, a folder or a primary
    configuration that does not exist.
    """
    for word in words:
        if any("\ud800" <= character <= "\udfff" for character in word):
            raise ConfigError(f"{shown(word)} is not text in UTF-8")
        key, _, value = word.partition("=")
        if word.startswith("-") and (key := key.lstrip("-")).partition(".")[0] in _KEYS:
            raise ConfigError(
                f"{shown(word)} is no option; {key} is written without dashes, as in "
                f"{key}={value or 'VALUE'}"
            )
    given = options.parse(command, words, _WITH_VALUE, (*_SWITCHES, *more))
    _check_questions(given)
    sweep = {key: text for key, _, text in (word.partition("=") for word in given.words)}
    overrides = [_stored(w) for w in given.words if w.partition("=")[0] not in _SWEEP_WORDS]
    config_dir, fail_fast = given.config_dir, sweep.get("fail_fast")
    config_name = _config_name(given.values.get("--config-name"), config_dir)
    recorded = any(re.match(r"data\.file=(?!null$)", word) for word in overrides)
    if recorded and config_name == PRIMARY and not any(w.startswith("data=") for w in overrides):
        overrides.insert(0, "data=csv")  # a file says that there is a recording
    multirun = "--multirun" in given.switches
    return Arguments(
        given,
        _with_regression([_override(word, multirun=multirun) for word in overrides]),
        config_dir,
        config_name,
        _resume(sweep.get("resume")),
        "" if fail_fast is None else convert(
            fail_fast.lower(), Literal["true", "false"], "fail_fast"
        ),
    )


def _check_questions(given: Options) -> None:
    """Hydra answers one question at a time."""
    for flag, accepted in VALUES.items():
        if (value := given.values.get(flag, accepted[0])) not in accepted:
            raise ConfigError(f"{flag} needs {_WITH_VALUE[flag]}, got {shown(value)}")
    asked = [flag for flag in _ONE_OF if flag in given.switches or flag in given.values]
    if len(asked) > 1:
        raise ConfigError(f"only one of {', '.join(asked)} at a time")
    if given.quiet and given.loud:
        raise ConfigError("-q and -v: one of them")
    if "--resolve" in given.switches and "--cfg" not in given.values:
        raise ConfigError("--resolve is for what --cfg prints; add --cfg job")


def _stored(word: str) -> str:
    """``figures.dpi=300``, ``regression.S=…`` where it is stored: in ``output``, as a plant's."""
    word = re.sub(r"^([+~]*)regression\.", r"\1plant.", word)
    match = re.match(r"\+*figures\.([^=]*)=", word)
    if match is None:
        return word
    known_name(match[1], LOOK, f"figures.{match[1]}: no such key", "figures has")
    return word.replace("figures.", "output.", 1)


def _with_regression(overrides: list[str]) -> tuple[str, ...]:
    """``regression=NAME`` stands in place of a plant and of an observer (ConfigError)."""
    if not any(re.match(r"regression=(?!null$)", word) for word in overrides):
        return tuple(overrides)
    for word in overrides:
        if re.match(r"(plant|observer)=", word):
            raise ConfigError(f"{word}: regression=NAME stands in place of a plant and an observer")
    return ("~plant", "observer=regression", *overrides)


def quoted(text: str) -> str:
    """``text`` as a quoted value that Hydra's grammar reads back as it is."""
    # Backslashes count only before a quote and at the end.
    escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), text)
    return f"'{escaped}'"


def logspace(text: str, where: str) -> str | None:
    """``logspace(a,b,n)`` as the values of a sweep, ``1e6,1e7,…``; None for any other text."""
    if not _LOGSPACE.match(f"{where}={text}"):
        return None
    from gpebo_cli.estimators import axis  # the same numbers as in one run, to the last bit

    return ",".join(f"{value:g}" if float(f"{value:g}") == value else repr(value)
                    for value in axis(text, where))


def _override(word: str, *, multirun: bool) -> str:
    """One override as Hydra takes it: ``logspace`` is a sweep with -m, else an axis of one run."""
    if multirun and (match := _LOGSPACE.match(word)):
        return f"{match[1]}={logspace(match[2], match[1])}"
    key, equals, value = word.partition("=")
    if key.lstrip("+") == "hydra/sweeper" and equals:
        raise ConfigError(f"{word}: gpebo has a sweeper of its own; leave this away")
    if key.lstrip("+") in GROUPS and value.startswith("["):
        swept = ",".join(name.strip() for name in value.strip("[]").split(","))
        raise ConfigError(f"{word}: one {key} for a run; for a run for each: -m {key}={swept}")
    if key.lstrip("+") in GROUPS and equals and (multirun or "," not in value):
        # Names of files that Hydra would read as numbers or truth (``plant=2024``) are quoted.
        names = [quoted(n) if _NOT_TEXT.fullmatch(n) else n for n in value.split(",")]
        return f"{key}={','.join(names)}"
    return word


def _resume(given: str | None) -> str | None:
    if given is None:
        return None
    folder = os.path.abspath(os.path.expanduser(given))
    if not given or not os.path.isdir(folder):
        what = given or "(nothing)"
        raise ConfigError(f"resume={what}: there is no such folder; give that of a sweep")
    return folder


def _config_name(given: str | None, config_dir: str | None) -> str:
    name = PRIMARY if given is None else given.removesuffix(".yaml")
    where = "" if config_dir is None else f" in {config_dir}"
    what = f"--config-name {name}: there is no {name}.yaml{where}"
    return known_name(name, Arguments(config_dir=config_dir).known(""), what)
