"""``gpebo new recording FILE.csv --plant NAME``: how to read a file, as far as one can guess."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
from pathlib import Path

from gpebo_cli.configs import files
from gpebo_cli.configs.locations import choices, conf_folder
from gpebo_cli.errors import ConfigError, printable
from gpebo_cli.recordings.guess import Guess, guess
from gpebo_cli.regression.text import system_from_mapping
from gpebo_cli.results.files import make_folder, write_text
from gpebo_cli.schema import known_name

_WORDS = {"\t": "tab", " ": "space"}


def write(file: str, plant: str, folder: str) -> int:
    """Write ``folder/data/NAME.yaml`` for a recording of a plant; the exit code (ConfigError)."""
    names = {name: home for home in (folder, conf_folder()) for name in choices(home, "plant")}
    known_name(plant, sorted(names), f"--plant {plant}: there is no such plant")
    file_of_plant = os.path.join(names[plant], "plant", f"{plant}.yaml")
    system = system_from_mapping(files.load(names[plant], f"plant/{plant}"), file_of_plant)
    found = guess(file, system)
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", Path(file).stem).strip("_-") or "recording"
    if name in choices(conf_folder(), "data"):
        name = f"{name}_recording"
    path = Path(folder, "data", f"{name}.yaml")
    if path.exists() or path.is_symlink():
        raise ConfigError(f"{path} exists already; remove it, or rename {file}")
    make_folder(path.parent)
    write_text(path, text(file, plant, found))
    lines = [str(path), *(f"  {signal}: column {column!r} ({found.reasons[signal]})"
                          for signal, column in found.columns.items())]
    lines += [f"not understood: {doubt}" for doubt in found.doubts]
    run = f"gpebo run --config-dir {shlex.quote(folder)} plant={plant} data={name}"
    lines.append(f"look at the guesses in it, then: {run}")
    sys.stdout.write("".join(f"{printable(line)}\n" for line in lines))
    return 0


def text(file: str, plant: str, found: Guess) -> str:
    """The YAML file, each guess with its reason."""

    def line(key: str, value: object, why: str = "") -> str:
        written = value if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
        return f"{key}: {written}" + (f"    # guessed: {why}" if why else "")

    reasons = found.reasons
    head = [
        f"# How gpebo reads a recording of plant {plant}: guesses, made from its first rows.",
        *(f"# NOT UNDERSTOOD: {doubt}" for doubt in found.doubts),
        line("name", "csv"),
        line("title", f"recording of {plant}, {os.path.basename(file)}"),
        line("file", os.path.abspath(file)),
        line("hold", dict.fromkeys(found.held, "zoh") or "linear")
        + "    # between samples: zoh, linear or cubic; of those not named linear",
        line("separator", _WORDS.get(found.separator, found.separator)),
        line("decimal", found.decimal, reasons.get("decimal", "")),
        line("time_unit", found.time_unit, reasons.get("time_unit", "")),
        "columns:    # what each signal is called in the file",
        *(f"  {line(signal, name, reasons[signal])}" for signal, name in found.columns.items()),
    ]
    head += [f'  # {signal}: "…"    which column is it?' for signal in found.lacking]
    if found.scale:
        head.append("scale:      # factors from the file's units to the plant's")
        head += [f"  {line(s, v, reasons[f'scale.{s}'])}" for s, v in found.scale.items()]
    else:
        head.append("scale: null    # factors from the file's units to the plant's: {V: 0.001}")
    head.append(line("gaps", found.gaps or None, reasons.get("gaps", "")))
    gaps = f"{found.missing} cells are empty; or hold, drop, refuse" if found.missing else ""
    head.append(line("missing", "interpolate" if found.missing else "refuse", gaps))
    return "".join(f"{printable(line)}\n" for line in head)
