"""What the scripts put into pages: tables in Markdown, between two marks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from gpebo_cli.results.files import write_text


def table(head: Sequence[str], rows: Iterable[Sequence[str]], rule: Sequence[str] = ()) -> str:
    """A table in Markdown; the ``rule`` below the head says how columns are aligned."""
    lines = [head, rule or ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in lines)


def put(page: Path, name: str, text: str) -> None:
    """Text into its place on a page, from ``<!-- NAME: … -->`` to ``<!-- end of NAME -->``."""
    place = re.compile(rf"(<!-- {name}: [^\n]*-->\n).*?(<!-- end of {name} -->\n)", re.DOTALL)
    old = page.read_text(encoding="utf-8")
    new, count = place.subn(lambda marks: marks[1] + text + marks[2], old)
    if count != 1:
        raise ValueError(f"{page} has {count} places for {name}")
    write_text(page, new)
