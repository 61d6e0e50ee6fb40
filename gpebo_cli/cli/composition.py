"""From the words of the command line to one configuration, by Hydra, and to Hydra's own answers.

Hydra never opens a file of gpebo's or of a ``--config-dir``: it is handed plain data that
:mod:`gpebo_cli.configs.files` has read and checked. What it composes is checked once more before
anything in it is used.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, cast

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_search_path_impl import ConfigSearchPathImpl
from hydra._internal.hydra import Hydra
from hydra._internal.sources_registry import SourcesRegistry
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from hydra.version import setbase
from omegaconf import DictConfig, OmegaConf

from gpebo_cli.cli.arguments import Arguments, quoted
from gpebo_cli.cli.hydra_errors import LIBRARY_ERRORS, explain
from gpebo_cli.configs import files
from gpebo_cli.configs.locations import GROUPS, choices, conf_folder
from gpebo_cli.errors import ConfigError
from gpebo_cli.plain_yaml import parse

_INSTANTIATED = ("hydra.launcher._target_", "hydra.sweeper._target_")
_CLOSES = {"(": ")", "[": "]", "{": "}", "'": "'", '"': '"'}
_BY_SIGNAL = re.compile(r"data\.(columns|hold|scale)\.\w+=")
_PLUGINS = ("hydra_plugins.", "hydra._internal.core_plugins.")


class GpeboSource(ConfigSource):
    """The files of a folder as Hydra's search path has them."""

    @staticmethod
    def scheme() -> str:
        """What stands before ``://``."""
        return "gpebo"

    def load_config(self, config_path: str) -> ConfigResult:
        """The content of a file, and where in the configuration it belongs."""
        content = OmegaConf.create(files.load(self.path, config_path))
        header: dict[str, str | None] = {"package": files.package(config_path)}
        return ConfigResult(self.provider, self.full_path(), content, header)

    def is_group(self, config_path: str) -> bool:
        """Whether there are files of a group."""
        return files.is_group(self.path, config_path)

    def is_config(self, config_path: str) -> bool:
        """Whether there is a file."""
        return files.is_file(self.path, config_path)

    def available(self) -> bool:
        """Whether there is the folder."""
        return True  # its name has been checked

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Names of a group's files, for ``glob(…)``."""
        if results_filter == ObjectType.GROUP or not self.is_group(config_path):
            return []
        return choices(self.path, config_path)


class Loader(ConfigLoaderImpl):
    """Hydra's, from our sources alone; a configuration that could run code is an error."""

    def __init__(self, config_dir: str | None) -> None:
        setbase("1.3")
        Plugins.instance()  # knows Hydra's own sources
        SourcesRegistry.instance().register(GpeboSource)
        path = ConfigSearchPathImpl()
        path.append("hydra", "pkg://hydra.conf")
        if config_dir is not None:  # first, so that a file with a name of ours is noticed
            path.append("command-line", f"gpebo://{config_dir}")
        path.append("main", f"gpebo://{conf_folder()}")
        path.append("schema", "structured://")
        super().__init__(path)

    def load_configuration(self, *args: Any, **kwargs: Any) -> DictConfig:
        """As Hydra's (ConfigError: something in it names code to run, or a folder to search)."""
        try:
            config = super().load_configuration(*args, **kwargs)
        except (TypeError, ValueError) as error:  # +launcher=null or [1,2], for instance
            raise ConfigError(
                f"the configuration cannot be composed: {error}; a choice is one name, a list is "
                "given as a whole, as in plant.outputs=[y]"
            ) from error
        refuse_code(cast("dict[str, Any]", OmegaConf.to_container(config, resolve=False)))
        return config


def refuse_code(config: Mapping[str, Any]) -> None:
    """The second line: only Hydra's and our own plugins are called, whatever the files were.

    A ConfigError names a callback, or a name of something to call.
    """
    hydra = config["hydra"]
    for key in ("callbacks", "searchpath"):
        if hydra.get(key):
            raise ConfigError(f"hydra.{key}: not allowed; files of yours are found by --config-dir")
    for where, value in _leaves(config, ""):
        ours = where in _INSTANTIATED and str(value).startswith(_PLUGINS)
        if "_target_" in where and not ours:
            raise ConfigError(f"{where}: `_target_` is not allowed; a configuration is data")


def _leaves(value: object, where: str) -> Iterator[tuple[str, object]]:
    """Everything in a configuration that holds nothing else, and where it stands."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _leaves(inner, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list) and value:
        for position, inner in enumerate(value):
            yield from _leaves(inner, f"{where}[{position}]")
    else:
        yield where, value


@contextmanager
def session(arguments: Arguments) -> Iterator[Hydra]:
    """Hydra, for one command; its errors as ours (ConfigError)."""
    before = os.environ.get("HYDRA_FULL_ERROR", "")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # without it Hydra prints its errors and exits with 1
    logging.raiseExceptions = False  # a reader may close the pipe
    hydra = Hydra("gpebo", Loader(arguments.config_dir))
    try:
        yield hydra
    except LIBRARY_ERRORS as error:
        raise ConfigError(explain(error, arguments)) from error
    except RecursionError as error:
        raise ConfigError("a file chooses itself, by way of its defaults list") from error
    finally:
        os.environ["HYDRA_FULL_ERROR"] = before


def _words(arguments: Arguments) -> list[str]:
    """The overrides, quoted where Hydra's grammar would not read them.

    A value that it cannot read is text, such as a formula (``plant.inputs.V=2*sin(t)``) or a single
    comma; in brackets it is YAML. Signals of a recording need not be in its file before.
    """
    parser = OverridesParser.create()
    swept = "--multirun" in arguments.given.switches
    words = [_readable(parser, word, swept=swept) for word in arguments.for_hydra]
    return [f"++{word}" if _BY_SIGNAL.match(word) else word for word in words]


def _readable(parser: OverridesParser, word: str, *, swept: bool) -> str:
    try:
        parser.parse_override(word)
    except HydraException:
        key, _, value = word.partition("=")
        if swept and len(pieces := _pieces(value)) > 1:
            each = (_readable(parser, f"{key}={piece}", swept=False) for piece in pieces)
            return f"{key}={','.join(one.removeprefix(f'{key}=') for one in each)}"
        if value.startswith(("[", "{")):
            with suppress(ConfigError):
                return f"{key}={_quoted_within(parse(value, key))}"
        elif key and key not in GROUPS and value and value[0] not in "'\"":
            return f"{key}={quoted(value)}"
    return word


def _pieces(value: str) -> list[str]:
    """What a sweep gives one after the other: between commas that no brackets and quotes hold."""
    pieces, ends = [""], ""
    for letter in value:
        if letter == "," and not ends:
            pieces.append("")
            continue
        if letter == ends[-1:]:
            ends = ends[:-1]
        elif ends[-1:] not in ("'", '"') and (letter in "([{" or not pieces[-1]):
            ends += _CLOSES.get(letter, "")  # quotes count in front alone: it's
        pieces[-1] += letter
    return pieces


def _quoted_within(value: object) -> str:
    if isinstance(value, dict):
        return f"{{{','.join(f'{key}:{_quoted_within(inner)}' for key, inner in value.items())}}}"
    if isinstance(value, list):
        return f"[{','.join(map(_quoted_within, value))}]"
    return quoted(value) if isinstance(value, str) else json.dumps(value)


def compose(hydra: Hydra, arguments: Arguments) -> tuple[DictConfig, bool]:
    """The configuration, and whether it is of a sweep: a recipe may say so, too."""
    words = _words(arguments)
    config = hydra.config_loader.load_configuration(
        arguments.config_name, words, RunMode.MULTIRUN, validate_sweep_overrides=False
    )
    swept = "--multirun" in arguments.given.switches or config.hydra.mode == RunMode.MULTIRUN
    mode = RunMode.MULTIRUN if swept else RunMode.RUN
    loader = cast("Loader", hydra.config_loader)
    loader.validate_sweep_overrides_legal(
        OverridesParser.create().parse_overrides(words), mode, from_shell=True
    )
    config.hydra.mode = mode
    config.hydra.overrides.hydra.append(f"hydra.mode={mode.name}")  # for the jobs of a sweep
    HydraConfig.instance().set_config(config)
    return config, swept


def show(hydra: Hydra, arguments: Arguments) -> bool:
    """Answer ``--cfg``, ``--info`` and the like; whether there was such a question."""
    name, words = arguments.config_name, _words(arguments)
    options = arguments.given.values
    if "--hydra-help" in arguments.given.switches:
        sys.argv = [f"{os.path.basename(sys.argv[0])} run", *words]  # the parser is called after it
        parser = get_args_parser()
        hydra.hydra_help(name, parser, parser.parse_args(words))
    elif "--cfg" in options:
        hydra.show_cfg(name, words, options["--cfg"], None, "--resolve" in arguments.given.switches)
    elif "--info" in options:
        hydra.show_info(options["--info"], name, words)
    else:
        return False
    return True


def plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain data, without Hydra's section and what a page of figures says.

    There are no interpolations in it: a stranger's sweep can give values that Hydra's grammar turns
    into one, and it could read environment variables or other parts of the configuration
    (ConfigError: an interpolation, or a value that is still missing).
    """
    content = cast("dict[str, Any]", OmegaConf.to_container(config, resolve=False))
    content.pop("hydra", None)
    if not isinstance(content.get("plant"), dict):
        raise ConfigError("plant.name is missing; choose a file with plant=NAME")
    for where, value in _leaves(content, ""):
        if "${" in f"{where}{value}":
            raise ConfigError(f"{where}: ${{…}} is not allowed; write the value")
        if value == "???":
            raise ConfigError(f"{where} has no value yet (???); give it one")
    return {key: value for key, value in content.items() if key not in ("drawn", "note")}
