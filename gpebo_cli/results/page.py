"""``index.html``: figures with captions and the numbers under them, one static file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from gpebo_cli.evidence.metrics import is_metric
from gpebo_cli.results.html import document, footer, paragraph
from gpebo_cli.results.names import known_by, shown_metrics
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.symbols import number_text, symbol


class Section(NamedTuple):
    """A recipe on the page; all texts are HTML."""

    name: str
    title: str
    content: str
    pictures: int


def page(sections: Sequence[Section], made_by: Provenance) -> str:
    """Render the page; it refers to files in a folder per section and to nothing else."""
    contents = "".join(
        f'<li><a href="#{s.name}"><code>{s.name}</code></a>: {s.title}</li>\n'
        for s in sections
    )
    text = paragraph(
        "Ortega, Bobtsov, Castaños, Nikolaev, arXiv:2407.14373. Everything here was computed and "
        "drawn by gpebo figures. Beside every picture is a CSV file with exactly what is drawn."
    )
    body = "".join(
        f'<section id="{s.name}">\n<h2>{s.title}</h2>\n'
        f"<p><code>gpebo run experiment={s.name}</code></p>\n{s.content}</section>\n"
        for s in sections
    )
    nav = f"<nav><ul>\n{contents}</ul></nav>\n"
    title = "The paper’s figures, regenerated"
    return document(title, text + nav + body + footer(made_by), embedded=False)


def case_table(named: Sequence[tuple[str, dict[str, float]]]) -> list[list[str]]:
    """Header and rows of what distinguishes cases, and their metrics.

    Each has the name of its run, empty if there is only one, and gains and metrics by the names
    of ``cases.csv``.
    """
    if not named:
        return []
    gains = list(dict.fromkeys(key for _, row in named for key in row if not is_metric(key)))
    several = any(name for name, _ in named)
    # Gains that are the same everywhere tell nothing; those of other estimators are not theirs.
    shown = [g for g in gains if len({row.get(g) for _, row in named}) > 1] or gains
    # Without the truth nothing is known of errors, nor from when on they are small.
    known = {
        key: words for key, words in shown_metrics([row for _, row in named]).items()
        if any(math.isfinite(row.get(known_by(key), math.nan)) for _, row in named)
    }
    head = [*(["estimator"] if several else []), *map(symbol, shown), *known.values()]
    rows = [
        [
            *([name] if several else []),
            *(number_text(row[gain]) if gain in row else "" for gain in shown),
            *(_metric(key, row.get(key, math.nan)) for key in known),
        ]
        for name, row in named
    ]
    return [head, *rows]


def _metric(name: str, value: float) -> str:
    if name.startswith("seconds"):
        return f"{value:.3f} s" if math.isfinite(value) else "never"
    return number_text(value) if math.isfinite(value) else "unknown"
