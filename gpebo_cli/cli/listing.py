"""``gpebo list``: what can be chosen, one line each, without a YAML parser or numbers."""

from __future__ import annotations

import os
import sys

from gpebo_cli.cli.options import CONFIG_DIR, parse
from gpebo_cli.configs.locations import choices, conf_folder, outline
from gpebo_cli.errors import printable

KINDS = {
    "plants": "plant",
    "regressions": "regression",
    "observers": "observer",
    "estimators": "estimator",
    "noise": "noise",
    "experiments": "experiment",
}
# What stands within quotation marks for what.
_ESCAPED = {"'": {"''": "'"}, '"': {"\\\\": "\\", '\\"': '"'}}


def main(words: list[str]) -> int:
    """Print names, titles and references of the kinds asked for, by default all (ConfigError)."""
    options = parse("list", words, CONFIG_DIR)
    folders = list(filter(None, (conf_folder(), options.config_dir)))
    kinds = list(dict.fromkeys(map(_kind, options.words))) or list(KINDS)
    for position, kind in enumerate(kinds):
        if len(kinds) > 1:
            sys.stdout.write(f"{'' if position == 0 else chr(10)}{kind}\n")
        sys.stdout.writelines(_lines(KINDS[kind], folders, indent="  " * (len(kinds) > 1)))
    return 0


def _kind(word: str) -> str:
    for kind, group in KINDS.items():
        if word in (kind, group):
            return kind
    from gpebo_cli.schema import shown, unknown

    raise unknown(f"gpebo list {shown(word)}: nothing of that kind", word, KINDS)


def _lines(group: str, folders: list[str], indent: str) -> list[str]:
    entries: dict[str, str] = {}
    for folder in folders:
        for name in choices(folder, group, inside=True):
            # The first folder wins, as it does in Hydra's search path.
            title, reference = described(os.path.join(folder, group, f"{name}.yaml"))
            entries.setdefault(name, f"{title} [{reference}]" if reference else title)
    width = max(map(len, entries), default=0)
    return [f"{indent}{name:<{width}}  {text}".rstrip() + "\n" for name, text in entries.items()]


def described(path: str) -> tuple[str, str]:
    """Title and reference from the top level of a YAML file, empty where there is none."""
    try:
        found = outline(path)
    except OSError as error:
        return f"(cannot be read: {error.strerror})", ""
    return _scalar(found.get("title", "")), _scalar(found.get("reference", ""))


def _scalar(text: str) -> str:
    text = text.strip()
    quote = text[:1]
    if quote in _ESCAPED:
        text = text[1:]
        for k, mark in enumerate(_ESCAPED[quote]):
            text = text.replace(mark, chr(k))
        text = text.partition(quote)[0]
        for k, meant in enumerate(_ESCAPED[quote].values()):
            text = text.replace(chr(k), meant)
    else:
        text = text.partition(" #")[0].rstrip()
        text = "" if text in ("null", "~") else text
    return printable(text)  # titles come from other people's files
