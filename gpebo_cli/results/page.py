"""``index.html``: figures with captions and the numbers under them, one static file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from gpebo_cli.evidence.metrics import is_metric
from gpebo_cli.results.html import document, footer, paragraph, table
from gpebo_cli.results.names import FORMATS
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.symbols import number_text, symbol


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
    text = paragraph(
        "Ortega, Bobtsov, Castaños, Nikolaev, arXiv:2407.14373. Everything here was computed and "
        "drawn by gpebo figures. Beside every picture is a CSV file with exactly what is drawn."
    )
    title = "The paper’s figures, regenerated"
    nav = f"<nav><ul>\n{contents}</ul></nav>\n"
    return document(title, text + nav + body + footer(made_by), embedded=False)


def _section(section: Section) -> str:
    name = escape(section.name)
    words = (section.reference, section.note, *(f"{_sentence(v)}." for v in section.verdicts))
    pictures = "".join(_figure(section.name, picture) for picture in section.pictures)
    return f"""<section id="{name}">
<h2>{escape(_sentence(section.title))}</h2>
<p><code>gpebo run experiment={name}</code></p>
{"".join(map(paragraph, words))}{table(section.table)}<div class="figures">
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
    gains = list(dict.fromkeys(key for _, row in named for key in row if not is_metric(key)))
    several = any(name for name, _ in named)
    # Gains that are the same everywhere tell nothing; those of other estimators are not theirs.
    shown = [g for g in gains if len({row.get(g) for _, row in named}) > 1] or gains
    # Without the truth nothing is known of errors, nor from when on they are small.
    known = [
        key for key in _METRICS
        if any(math.isfinite(row[f"final_error_{key.split('_')[-1]}"]) for _, row in named)
    ]
    head = [*(["estimator"] if several else []), *map(symbol, shown), *(_METRICS[k] for k in known)]
    rows = [
        [
            *([name] if several else []),
            *(number_text(row[gain]) if gain in row else "" for gain in shown),
            *(_metric(key, row[key]) for key in known),
        ]
        for name, row in named
    ]
    return [head, *rows]


def _metric(name: str, value: float) -> str:
    if name.startswith("seconds"):
        return f"{value:.3f} s" if math.isfinite(value) else "never"
    return number_text(value) if math.isfinite(value) else "unknown"
