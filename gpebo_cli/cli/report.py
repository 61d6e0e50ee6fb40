"""``gpebo report``: runs, sweeps and recordings as one page that stands alone."""

from __future__ import annotations

import sys
from pathlib import Path

from gpebo_cli.cli.options import parse
from gpebo_cli.errors import ConfigError


def main(words: list[str]) -> int:
    """Write the page; the exit code (ConfigError)."""
    arguments = parse("report", words, {"--output": "a file"})
    if not arguments.words:
        raise ConfigError("gpebo report needs folders of runs or sweeps; see gpebo report --help")
    path = Path(arguments.values.get("--output", "report.html"))
    if path.is_dir():
        raise ConfigError(f"--output {path}: that is a folder; give the name of a file")
    from gpebo_cli.results.document import document
    from gpebo_cli.results.files import make_folder, write_text
    from gpebo_cli.results.finished import find
    from gpebo_cli.results.provenance import provenance

    found = [one for name in arguments.words for one in find(name)]
    make_folder(path.parent)
    write_text(path, document(found, provenance()))
    sys.stdout.write(f"{path}\n")
    return 0
