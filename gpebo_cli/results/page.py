"""``index.html``: figures with captions and the numbers under them, one static file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from gpebo_cli.results.names import FORMATS
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.symbols import number_text, symbol

_STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 84rem; padding: 1rem 1.25rem 3rem; color: #1b1b1b;
  background: #fff; font: 1rem/1.5 system-ui, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.25rem; line-height: 1.3; margin: 0; padding-top: 1rem;
  border-top: 1px solid #bbb; }
p { max-width: 46rem; margin: .5rem 0; }
nav ul { padding-left: 1.2rem; }
a { color: #0b5394; }
section { margin-top: 2.5rem; }
.figures { display: grid; gap: 1.5rem 2rem; align-items: start; margin-top: 1rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr)); }
figure { margin: 0; }
img { display: block; width: 100%; max-width: 26rem; height: auto; }
figcaption { max-width: 26rem; font-size: .9rem; margin-top: .35rem; color: #333; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; margin-top: .75rem; }
th, td { padding: .2rem .8rem .2rem 0; text-align: right; border-bottom: 1px solid #ddd;
  white-space: nowrap; font-variant-numeric: tabular-nums; }
th { vertical-align: bottom; font-weight: 600; white-space: normal; min-width: 4.5rem; }
th:first-child, td:first-child { text-align: left; }
footer { margin-top: 3rem; padding-top: .75rem; border-top: 1px solid #bbb; font-size: .85rem; }
code { font-size: .92em; overflow-wrap: anywhere; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure's files, ``<stem>.png`` and so on, and its words."""

    stem: str
    heading: str
    text: str
    alt: str
    size: tuple[int, int]  # pixels
    formats: tuple[str, ...]


@dataclass(frozen=True)
class Section:
    """A recipe: its words, its numbers (a header and rows), its pictures."""

    name: str
    title: str
    reference: str
    note: str
    verdicts: tuple[str, ...]
    table: Sequence[Sequence[str]]
    pictures: tuple[Picture, ...]


def page(sections: Sequence[Section], made_by: Provenance) -> str:
    """Render the page; it refers to files in a folder per section and to nothing else."""
    contents = "".join(
        f'<li><a href="#{escape(s.name)}"><code>{escape(s.name)}</code></a>: '
        f"{escape(_sentence(s.title))}</li>\n"
        for s in sections
    )
    body = "".join(map(_section, sections))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>The paper’s figures, regenerated</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>The paper’s figures, regenerated</h1>
<p>Ortega, Bobtsov, Castaños, Nikolaev, arXiv:2407.14373. Everything here was computed and drawn
by <code>gpebo figures</code>. Beside every picture is a CSV file with exactly what is drawn.</p>
<nav><ul>
{contents}</ul></nav>
{body}{_footer(made_by)}
</body>
</html>
"""


def _section(section: Section) -> str:
    name = escape(section.name)
    reference = f"<p>{escape(section.reference)}</p>\n" if section.reference else ""
    note = f"<p>{escape(section.note)}</p>\n" if section.note else ""
    verdicts = "".join(f"<p>{escape(_sentence(verdict))}.</p>\n" for verdict in section.verdicts)
    pictures = "".join(_figure(section.name, picture) for picture in section.pictures)
    return f"""<section id="{name}">
<h2>{escape(_sentence(section.title))}</h2>
<p><code>gpebo run experiment={name}</code></p>
{reference}{note}{verdicts}{_table(section.table)}<div class="figures">
{pictures}</div>
</section>
"""


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _figure(folder: str, picture: Picture) -> str:
    base = escape(f"{folder}/{picture.stem}")
    files = ["csv", *(name for name in FORMATS if name in picture.formats)]
    links = ", ".join(f'<a href="{base}.{name}">{name.upper()}</a>' for name in files)
    width, height = picture.size
    text = escape(picture.text.rstrip("."))
    return f"""<figure>
<img src="{base}.png" width="{width}" height="{height}" alt="{escape(picture.alt)}">
<figcaption><b>{escape(picture.heading)}:</b> {text}. {links}</figcaption>
</figure>
"""


def _table(table: Sequence[Sequence[str]]) -> str:
    if not table:
        return ""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table[0])
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n"
        for row in table[1:]
    )
    return (
        f'<div class="scroll"><table>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}</tbody>\n</table></div>\n"
    )


def _footer(made_by: Provenance) -> str:
    versions = ", ".join(
        f"{name} {version}" for name, version in made_by.versions.items() if version is not None
    )
    commit = ""
    if made_by.git is not None and made_by.git.commit is not None:
        dirty = ", with changes that are not committed" if made_by.git.dirty else ""
        commit = f"<p>Commit <code>{escape(made_by.git.commit)}</code>{dirty}.</p>\n"
    return f"<footer>\n<p>{escape(versions)}.</p>\n{commit}</footer>"


_METRICS = {
    "seconds_to_1pct_parameters": "parameters below 1 % after",
    "seconds_to_1pct_states": "states below 1 % after",
    "final_error_parameters": "largest final error, parameters",
    "final_error_states": "largest final error, states",
    "rms_error_states": "RMS error, states",
}


def case_table(named: Sequence[tuple[str, dict[str, float]]]) -> list[list[str]]:
    """Header and rows of what distinguishes cases, and their metrics.

    Args:
        named: name of the run (empty if there is only one) and the case's gains and metrics,
            named as in ``cases.csv``.
    """
    if not named:
        return []
    gains = list(dict.fromkeys(key for _, row in named for key in row if key not in _METRICS))
    several = any(name for name, _ in named)
    # Gains that are the same everywhere tell nothing; those of other estimators are not theirs.
    shown = [g for g in gains if len({row.get(g) for _, row in named}) > 1] or gains[:1]
    head = [*(["estimator"] if several else []), *map(symbol, shown), *_METRICS.values()]
    rows = [
        [
            *([name] if several else []),
            *(number_text(row[gain]) if gain in row else "" for gain in shown),
            *(_metric(key, row[key]) for key in _METRICS),
        ]
        for name, row in named
    ]
    return [head, *rows]


def _metric(name: str, value: float) -> str:
    if name.startswith("seconds"):
        return f"{value:.3f} s" if math.isfinite(value) else "never"
    return number_text(value)
