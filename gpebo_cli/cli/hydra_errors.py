"""What Hydra and OmegaConf raise, as one line with the nearest name."""

from __future__ import annotations

import os
import re

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gpebo_cli.cli.arguments import Arguments
from gpebo_cli.configs.files import is_group
from gpebo_cli.configs.locations import GROUPS, choices, conf_folder
from gpebo_cli.registry import installed
from gpebo_cli.schema import nearest, shown

LIBRARY_ERRORS = (HydraException, OmegaConfBaseException)
"""What composing a configuration can raise because of what a user wrote."""

_QUOTED = re.compile(r"^Could not (?:override|append to config)[^']*'([^']+)'")
_SEVERAL = re.compile(r"^Ambiguous value for argument '([^']+)'")
_TWICE = re.compile(r"^(?:Multiple values for )?([\w/]+)(?:\.| appears more than once)")
_NO_MATCH = re.compile(r"^Could not override '([^']+)'\.\s+No match in the defaults list")
_MISSING_IN = re.compile(r"^In '([^']+)'")
_EXTRAS = {"joblib": "parallel", "ray": "ray", "submitit_slurm": "slurm", "submitit_local": "slurm"}
_LONGEST = 400
_AS_A_WHOLE = "a list is given as a whole, as in plant.outputs=[y]"
_OF_LISTS = {
    "list index out of range": _AS_A_WHOLE, "is not an int": _AS_A_WHOLE,
    "Cannot merge DictConfig with ListConfig": "it has keys and is no list",
    "is not a subclass of": "it has keys and is no value",
}
_OF_NUMBERS = ("time", "solver", "excitation")  # sections without a list


def explain(error: BaseException, arguments: Arguments) -> str:
    """One sentence for an error of :data:`LIBRARY_ERRORS`: what was given, what is accepted."""
    if isinstance(error, MissingConfigException):
        return _missing(error, arguments)
    if isinstance(error, OverrideParseException):
        return _unparsable(error, arguments)
    text, cause = str(error), error.__cause__
    if match := _SEVERAL.search(text):
        key, _, values = match[1].partition("=")
        cases = " (a case for each gain in one run)" if key.startswith("estimator.") else ""
        one = key in GROUPS or key.partition(".")[0] in _OF_NUMBERS
        listed = "" if one else f"write '{key}=[{values}]' for a list{cases}, or "
        return f"{match[1]}: several values; {listed}add -m for a run for each"
    if (match := _TWICE.search(text)) and match[1] in GROUPS:
        group = match[1]
        return f"{group} is chosen twice; write {group}=NAME once, without +"
    if match := _NO_MATCH.search(text):
        key = match[1]
        return (
            f"{key}=…: this configuration has {key} written out and chooses no file for it; change "
            f"its keys ({key}.KEY=VALUE), or leave --config-name away"
        )
    if match := _QUOTED.search(text):
        return _unknown_key(match[1], cause, arguments)
    if isinstance(cause, OmegaConfBaseException):
        word, reason = text.removeprefix("Error merging override "), str(cause.msg or cause)
        for theirs, ours in _OF_LISTS.items():
            if theirs in reason:
                return f"{word}: {ours}"
        text = f"{word}: {reason}" if word else reason
    return _one_line(text)


def _missing(error: MissingConfigException, arguments: Arguments) -> str:
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    if not group:
        return _one_line(str(error))
    if group.partition("/")[0] in GROUPS and ("/" in group or name.endswith(".yaml")):
        chosen, _, path = (error.missing_cfg_file or "").partition("/")
        own = f"--config-dir {os.path.dirname(os.path.dirname(path)) or '.'}"
        return (
            f"{chosen}={path}: give the name of a file in the folder {chosen} of a --config-dir, "
            f"not its path; write {own} {chosen}={os.path.basename(path).removesuffix('.yaml')}"
        )
    if group == "hydra/launcher" and name in _EXTRAS:
        return f"{group}={name} is not installed; pip install 'gpebo[{_EXTRAS[name]}]'"
    folders = [folder for folder in arguments.folders if is_group(folder, group)]
    known = sorted({found for folder in folders for found in choices(folder, group)})
    known = known or sorted(error.options or ())
    match = _MISSING_IN.search(str(error))
    chooser = match[1] if match else arguments.config_name
    where = "" if chooser == arguments.config_name else f"{chooser}: "
    text = f"{where}{group}={name}: there is no such {group}; known: {', '.join(known)}"
    hint = installed(group, name) or nearest(name, known)
    if arguments.config_dir is None and os.path.isfile(os.path.join(group, f"{name}.yaml")):
        return f"{text}; yours, {group}/{name}.yaml, is found with --config-dir ."
    if not hint and arguments.config_dir is None and group in GROUPS:
        hint = f" (yours: --config-dir DIR with DIR/{group}/{name}.yaml)"
    return text + hint


def _unparsable(error: OverrideParseException, arguments: Arguments) -> str:
    given = str(error.override)
    if "=" not in given and not given.startswith("~"):
        known = ", ".join(f"{group}=" for group in GROUPS)
        named = [
            f"{group}={given}"
            for group in GROUPS
            if any(given in choices(folder, group) for folder in (*arguments.folders, "."))
        ]
        hint = f"; did you mean {named[0]}?" if named else " (see gpebo run --help)"
        return f"{shown(given)} is not key=value; groups are {known}{hint}"
    reason = str(error.message).splitlines()[0] if error.message else "cannot be read"
    return _one_line(
        f"{shown(given)} cannot be read as key=value: {reason}; "
        "quote values with special characters, as in 'plant.title=\"a, b\"'"
    )


def _unknown_key(key: str, cause: BaseException | None, arguments: Arguments) -> str:
    """The message for a key that does not exist; OmegaConf's error still knows its neighbours."""
    parent = getattr(cause, "parent_node", None)
    if not isinstance(parent, DictConfig):
        return _one_line(f"{key}: {getattr(cause, 'msg', None) or 'it cannot be set'}")
    # There is no public way to ask where a node stands.
    path = str(parent._get_full_key(None) or "")  # noqa: SLF001
    known = [str(name) for name in parent if name != "hydra"]
    if not path:
        known += [group for group in GROUPS if group not in known]
    missing = key.removeprefix(path).lstrip(".").partition(".")[0]
    if any(word.lstrip("+~").startswith("regression.") for word in arguments.given.words):
        path = re.sub("^plant", "regression", path)  # as which it is stored
        if path == "regression" and "psi" not in parent:
            return f"{key.replace('plant', path, 1)}: no regression is chosen; regression=NAME does"
    missing = missing or str(getattr(cause, "key", ""))  # of a mapping that was given as a whole
    full = f"{path}.{missing}" if path else missing
    if not known:
        if path.startswith("hydra."):  # its mappings take no new keys, in whichever way they come
            return f"{full}: no such key; '+{full}=VALUE' adds one"
        return (
            f"{full}: {path} has no keys; give it as a whole, where it takes names as in "
            f"'{path}={{{missing}: VALUE}}'"
        )
    inside = path or "the configuration"
    deeper = [
        f"{section}.{missing}"
        for section in (known if not path else ())
        if isinstance(child := parent.get(section), DictConfig)
        and missing in child
    ]
    hint = f"; did you mean {deeper[0]}?" if deeper else nearest(missing, known)
    if path in {"plant", "regression"}:
        from gpebo_cli.model import plant
        from gpebo_cli.regression import text

        if missing in (text.KEYS if "psi" in parent else plant.KEYS):
            hint = f"; '+{full}=VALUE' adds it"
    if path in GROUPS and parent.get("name") == "none":
        others = [name for name in choices(conf_folder(), path) if name != "none"]
        hint = f"; choose {' or '.join(f'{path}={name}' for name in others)} first"
    return f"{full}: no such key; {inside} has {', '.join(known)}{hint}"


def _one_line(text: str) -> str:
    line = "; ".join(part.strip() for part in text.splitlines() if part.strip(" \t^"))
    return line if len(line) <= _LONGEST else line[: _LONGEST - 1] + "…"
