"""Pages that stand alone: one file, no script, nothing from another machine."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape

from gpebo_cli.results.provenance import Provenance

_STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 84rem; padding: 1rem 1.25rem 3rem; color: #1b1b1b;
  background: #fff; font: 1rem/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.25rem; line-height: 1.3; margin: 0; padding-top: 1rem;
  border-top: 1px solid #bbb; }
h3 { font-size: 1rem; margin: 1.25rem 0 0; }
p { max-width: 46rem; margin: .5rem 0; }
nav ul { padding-left: 1.2rem; }
a { color: #0b5394; }
section { margin-top: 2.5rem; }
.figures { display: grid; gap: 1.5rem 2rem; align-items: start; margin-top: 1rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr)); }
figure { margin: 0; }
img { display: block; width: 100%; max-width: 26rem; height: auto; }
label input { position: absolute; opacity: 0; }
label img { cursor: zoom-in; }
label input:focus-visible + img { outline: 2px solid #0b5394; }
label input:checked + img { cursor: zoom-out; max-width: none; }
.figures figure:has(input:checked) { grid-column: 1 / -1; }
figcaption { max-width: 26rem; font-size: .9rem; margin-top: .35rem; color: #333; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; margin-top: .75rem; }
th, td { padding: .2rem .8rem .2rem 0; text-align: right; border-bottom: 1px solid #ddd;
  white-space: nowrap; font-variant-numeric: tabular-nums; }
th { vertical-align: bottom; font-weight: 600; white-space: normal; min-width: 4.5rem; }
th:first-child, td:first-child, .text th, .text td { text-align: left; }
.text td { white-space: normal; vertical-align: top; }
.verdict { font-weight: 600; }
.fails td { color: #a40000; }
pre { overflow-x: auto; background: #f5f5f5; padding: .75rem; font-size: .8rem; line-height: 1.4; }
@media (max-width: 40rem) {  /* on a telephone rows of text stand one cell below the other */
  table { font-size: .75rem; }
  th { min-width: 0; }
  th, td { padding-right: .5rem; }
  .text thead { display: none; }
  .text tr { display: block; padding: .3rem 0; border-bottom: 1px solid #ddd; }
  .text td { display: block; padding: 0; border: 0; overflow-wrap: anywhere; }
}
summary { cursor: pointer; margin-top: .75rem; }
footer { margin-top: 3rem; padding-top: .75rem; border-top: 1px solid #bbb; font-size: .85rem; }
code { font-size: .92em; overflow-wrap: anywhere; }
"""


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
<style>{_STYLE}</style>
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


def folded(title: str, text: str) -> str:
    """Text as it stands, behind its title until somebody opens it."""
    return f"<details><summary>{escape(title)}</summary>\n<pre>{escape(text)}</pre></details>\n"


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
