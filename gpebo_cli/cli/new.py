"""``gpebo new KIND NAME``: commented files that run, or pass their test, as they stand."""

from __future__ import annotations

import keyword
import os
import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

from gpebo_cli.cli.options import CONFIG_DIR, Options, parse
from gpebo_cli.configs.locations import choices, conf_folder
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.schema import nearest, shown

_PACKAGE = {"{name}.py": "{kind}.py", "{kind}/{name}.yaml": "{kind}.yaml",
            "test_{name}.py": "test_{kind}.py", "pyproject.toml": "pyproject.toml"}
KINDS = {"plant": {"plant/{name}.yaml": "plant.yaml"}, "estimator": _PACKAGE,
         "observer": _PACKAGE, "recipe": {"experiment/{name}.yaml": "recipe.yaml"}}
"""For each kind the files that are written, and the template of each."""
RECORDING = "recording"
"""The kind that is made from a look at a file, and has no template."""
_KINDS = (*KINDS, RECORDING)
FROM_FILE = {
    "--from": "a netlist, a mechanical model or matrices",
    "--measure": "what is measured, as v(out),y=i(L1)+i(V)",
    "--unknown": "names of constant sources",
}

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,79}")
_WORDS = ("null", "true", "false", "yes", "no", "on", "off", "nan", "inf")  # mean more in YAML
_GROUPS = {"recipe": "experiment"}  # of kinds that are not called as their group
_UNSEEN = "nothing is measured: an observer needs outputs, as in --measure STATE,STATE"
_RUNS = """\
it runs as it stands:      gpebo run --config-dir {folder} {kind}={name}
when you have changed it:  gpebo check --config-dir {folder} {kind}={name}
"""
_INSTALLED = """\
its test passes as it stands:       python -m pytest {folder}
to use it, install it, then run it: pip install -e {folder}
                                    gpebo run --config-dir {folder} {kind}={name} plant=window
"""


def main(words: list[str]) -> int:
    """Write the file; the exit code."""
    kind, name, options = _parse(words)
    folder = os.path.expanduser(options.values.get("--config-dir", "."))
    if kind == RECORDING:
        from gpebo_cli.cli.new_recording import write

        return write(name, options.values["--plant"], folder)
    paths = {Path(folder, path): text for path, text in files(kind, name, folder).items()}
    _check_name(kind, name, list(paths))
    said, told = _RUNS if len(paths) == 1 else _INSTALLED, ""
    contents = {path: text.encode() for path, text in paths.items()}
    if "--from" in options.values:
        ((path, _),) = paths.items()
        found, told = _from_file(name, options)
        contents = {path.with_name(file): content for file, content in found.items()}
        _check_name(kind, name, list(contents))
        if _UNSEEN in told:
            name += " observer=none"

    from gpebo_cli.results.files import make_folder, write_file

    for path, content in contents.items():
        make_folder(path.parent)
        write_file(path, [content])
        sys.stdout.write(f"{path}\n")
    group = _GROUPS.get(kind, kind)
    sys.stdout.write(told + said.format(folder=shlex.quote(folder), kind=group, name=name))
    return 0


def files(kind: str, name: str, folder: str = ".") -> dict[str, str]:
    """The text of every file that is written, by its path below the folder."""
    classname = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
    words = {"mine": name, "Mine": classname, "KIND": kind, "FOLDER": shlex.quote(folder)}
    pattern = re.compile(rf"\b({'|'.join(words)})(?=\b|s\b)")
    home = Path(__file__).parent / "templates"
    return {
        path.format(kind=kind, name=name): pattern.sub(
            lambda match: words[match[1]],
            (home / template.format(kind=kind)).read_text(encoding="utf-8"),
        )
        for path, template in KINDS[kind].items()
    }


def _from_file(name: str, options: Options) -> tuple[dict[str, bytes], str]:
    """The files of a plant made from a file, and what there is to say of it."""
    from gpebo_cli.importers import from_file
    from gpebo_cli.model.plant import plant_from_mapping
    from gpebo_cli.settings import SolverSettings, TimeSettings
    from gpebo_cli.simulation.large import structure_of

    given = options.values
    draft = from_file(given["--from"], name, measure=given.get("--measure"),
                      unknown=given.get("--unknown"))
    system = plant_from_mapping(draft.mapping())
    said = [*draft.comments[1:]]
    try:
        structure = structure_of(system, TimeSettings(), SolverSettings())
        said.append(f"index {structure.index} as computed")
        if not system.outputs:
            said.append(_UNSEEN)
    except GpeboError as error:
        said.append(f"it is written, but cannot be simulated yet: {error}")
    return draft.files(), "".join(f"{line}\n" for line in said)


def _parse(words: list[str]) -> tuple[str, str, Options]:
    """Kind, name and options."""
    options = parse("new", words, {**CONFIG_DIR, **FROM_FILE, "--plant": "the name of one"})
    given = options.words
    if not given or given[0] not in _KINDS:
        what = f"gpebo new: {shown(given[0])} cannot be made" if given else "gpebo new needs a kind"
        raise ConfigError(
            f"{what}; known: {', '.join(_KINDS)}, as in gpebo new plant tank"
            + (nearest(given[0], _KINDS) if given else "")
        )
    if len(given) != 2:
        got = "none" if len(given) == 1 else ", ".join(map(shown, given[1:]))
        raise ConfigError(
            f"gpebo new {given[0]} needs one name, as in gpebo new {given[0]} tank; got {got}"
        )
    if (given[0] == RECORDING) != ("--plant" in options.values):
        raise ConfigError(
            "gpebo new recording FILE.csv --plant NAME looks for the signals of that plant; other "
            "kinds have no --plant"
        )
    if given[0] == RECORDING:
        return given[0], given[1], options
    if given[0] != "plant" and "--from" in options.values:
        raise ConfigError(f"--from makes a plant; gpebo new {given[0]} has a template of its own")
    for option in ("--measure", "--unknown"):
        if option in options.values and "--from" not in options.values:
            raise ConfigError(f"{option} is for a plant from a file: --from FILE {option} …")
    return given[0], given[1].removesuffix(".yaml"), options


def _check_name(kind: str, name: str, paths: list[Path]) -> None:
    if not _NAME.fullmatch(name) or name.lower() in _WORDS:
        raise ConfigError(
            f"gpebo new {kind}: {shown(name)} cannot be a name; it is a letter, then letters, "
            f"digits, _ and - (80 at most), and none of {', '.join(_WORDS)}"
        )
    module = KINDS[kind] is _PACKAGE
    for path in paths:
        if path.exists() or path.is_symlink():
            where = "another folder (--config-dir)" if module else "another name"
            raise ConfigError(f"{path} exists already; remove it, or choose {where}")
    # A module of the same name beside the test would hide one that is installed, even NumPy.
    taken = keyword.iskeyword(name) or getattr(find_spec(name), "origin", None) is not None
    if module and (taken or not name.isidentifier()):
        raise ConfigError(
            f"gpebo new {kind}: {name} cannot be the name of a new Python module; it is a letter, "
            "then letters, digits and _, no word of Python's and no module that is installed"
        )
    if name in choices(conf_folder(), _GROUPS.get(kind, kind)):
        raise ConfigError(
            f"gpebo new {kind}: {name} comes with gpebo, and yours would be ignored; choose "
            "another name"
        )
