"""Pages that stand alone: one file, no script, nothing from another machine."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from gpebo_cli.results.provenance import Provenance

_STYLE = Path(__file__).with_name("page.css")


def document(title: str, body: str, *, embedded: bool) -> str:
    """A page; ``embedded`` says that all its pictures are in it."""
    pictures = "data:" if embedded else "'self' data: file:"
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src {pictures}"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{_STYLE.read_text("utf-8")}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{body}</body>
</html>
"""


def table(rows: Sequence[Sequence[str]], *, text: bool = False, failed: Iterable[int] = ()) -> str:
    """A header and rows; ``text`` aligns to the left, rows numbered in ``failed`` are marked."""
    if not rows:
        return ""
    marked = set(failed)
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in rows[0])
    body = "".join(
        f"<tr{' class=fails' if number in marked else ''}>"
        + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n"
        for number, row in enumerate(rows[1:])
    )
    return (
        f'<div class="scroll"><table{" class=text" if text else ""}>\n<thead><tr>{head}</tr>'
        f"</thead>\n<tbody>\n{body}</tbody>\n</table></div>\n"
    )


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph, or nothing without text."""
    return f"<p{f' class={kind}' if kind else ''}>{escape(text)}</p>\n" if text else ""


def embedded_figure(png: bytes, name: str) -> str:
    """A picture in the page itself; a click shows it as large as the page."""
    caption = escape(name.replace("_", " "))
    data = b64encode(png).decode()
    return (
        f'<figure><label><input type="checkbox" aria-label="enlarge {caption}">'
        f'<img src="data:image/png;base64,{data}" alt="{caption}"></label>'
        f"<figcaption>{caption}</figcaption></figure>\n"
    )


def footer(made_by: Provenance) -> str:
    """Versions, and the commit of a checkout."""
    versions = ", ".join(
        f"{name} {version}" for name, version in made_by.versions.items() if version is not None
    )
    commit = ""
    if made_by.git is not None and made_by.git.commit is not None:
        dirty = ", with changes that are not committed" if made_by.git.dirty else ""
        commit = f"<p>Commit <code>{escape(made_by.git.commit)}</code>{dirty}.</p>\n"
    return f"<footer>\n<p>{escape(versions)}.</p>\n{commit}</footer>\n"
