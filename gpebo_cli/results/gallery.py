"""The folder that ``gpebo figures`` writes: pictures, their tables, and a page of all of them.

Figure numbers are those of the paper, arXiv:2407.14373.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from gpebo_cli.experiment.result import RunResult
from gpebo_cli.results import circuit, html
from gpebo_cli.results.figures import describe, overlay
from gpebo_cli.results.files import make_folder, remove_files, write_text
from gpebo_cli.results.names import FORMATS
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.report import case_cells, case_rows
from gpebo_cli.results.series import blocks, blocks_text, differences, reference_text
from gpebo_cli.results.style import Panel, compose, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure


STUDIES = (
    "paper_circuit", "paper_descriptor", "paper_canonical", "gain_sweep", "estimators_compared",
    "literal_regressor",
)
"""The recipes, in the order in which they are shown."""
PAPERS = "paper_circuit"
"""The one whose figures carry the paper's numbers."""

CAPTIONS = {
    "circuit": "the circuit. Arrows and signs are those that give the printed E(t) and A(t). With "
    "them e2 − e1 = −R₁ ir1, and R₁ is printed negative: a resistor of −R₁ > 0. But e1 = R₂ ir2, "
    "and R₂ is printed negative as well: taken literally, that branch delivers power. All "
    "elements vary with time.",
    "signals": "inputs and outputs",
    "regressor": "the regressor ψ",
    "states": "the states",
    "estimates": "the states and their estimates",
    "estimates_a": "the differential states x_a and their estimates",
    "estimates_b": "the other states x_b and their estimates",
    "parameter_error": "size of the error of each parameter, for each gain",
    "state_error": "size of the error of each state, for each gain",
    "state_error_a": "size of the errors of x_a, for each gain",
    "state_error_b": "size of the errors of x_b, for each gain",
    "gram": "eigenvalues of the Gram matrix of the regressor: it is interval-exciting from the "
    "time at which the smallest one passes ρ",
    "delta": "Δ, the determinant that mixing leaves as a scalar regressor",
    "gains": "final errors, and the time after which errors stay below 1 %, by gain",
    "error_norms": "norms of the errors of all parameters and all states, for a few gains",
    "estimators": "norms of the errors of all parameters and all states, by estimator",
}
"""What each figure shows."""
_NUMBERS = {name: number for number, name in enumerate((
    "circuit", "regressor", "states", "estimates_a", "estimates_b", "parameter_error",
    "state_error_a", "state_error_b",
), 1)}
"""Figures of the paper, by what they show."""

# What a committed reference is compared with: the paper's figures and those over gains and
# estimators. Of Δ and the Gram matrix the early part, 1e-20, is rounding.
REFERENCE = {*_NUMBERS, "gains", "error_norms", "estimators"}


@dataclass(frozen=True)
class Recipe:
    """A recipe that has been run: once (under the name ``""``), or once per name of a sweep."""

    name: str
    title: str
    reference: str
    note: str  # whose the settings are
    runs: Mapping[str, RunResult]
    drawn: list[str] | None = None  # figures; None: all that its run has


class Section(NamedTuple):
    """A recipe on the page; all texts are HTML."""

    name: str
    title: str
    content: str
    pictures: int


def figures_of(recipe: Recipe) -> dict[str, list[Panel]]:
    """Panels of all figures of a recipe, in the order in which they are shown."""
    if "" in recipe.runs:
        return describe(recipe.runs[""], recipe.drawn)
    return {"estimators": panels} if (panels := overlay(recipe.runs)) else {}


def write_recipe(
    folder: Path, recipe: Recipe, figures: Mapping[str, list[Panel]], formats: Sequence[str]
) -> Section:
    """Draw ``figures`` into ``folder``, a CSV file beside each; earlier ones are removed."""
    make_folder(folder)
    remove_files(p for s in (*FORMATS, "csv") for p in sorted(folder.glob(f"fig*.{s}")))
    pictures = []
    if recipe.name == PAPERS and circuit.available():
        write_text(folder / f"{stem('circuit')}.csv", circuit.netlist())
        alt = "Circuit diagram: " + "; ".join(map(_branch_text, circuit.BRANCHES)) + "."
        pictures.append(_save(folder, "circuit", circuit.circuit(), alt, formats))
    for name, panels in figures.items():
        write_text(folder / f"{stem(name)}.csv", blocks_text(blocks(panels)))
        pictures.append(_save(folder, name, compose(panels), _alt(name, panels), formats))
    runs = recipe.runs
    verdicts = [f"{_sentence(run.verdict)}." for run in runs.values()] if len(runs) == 1 else []
    words = "".join(map(html.paragraph, (recipe.reference, recipe.note, *verdicts)))
    cases = case_cells([(name, row) for name, run in runs.items() for row in case_rows(run)])
    drawn = f'<div class="figures">\n{"".join(pictures)}</div>\n'
    name, title = escape(recipe.name), escape(_sentence(recipe.title))
    return Section(name, title, words + html.table(cases) + drawn, len(pictures))


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def write_references(folder: Path, recipe: str, figures: Mapping[str, list[Panel]]) -> None:
    """Write the reference tables of a recipe to ``folder``/recipe."""
    make_folder(folder / recipe)
    for name, panels in figures.items():
        if name in REFERENCE:
            write_text(folder / recipe / f"{stem(name)}.csv", reference_text(panels))


def check_references(
    folder: Path, recipe: str, figures: Mapping[str, list[Panel]]
) -> Iterator[str]:
    """Compare a recipe with its tables in ``folder``/recipe; a line per curve that differs."""
    by_file = {stem(name): panels for name, panels in figures.items()}
    for path in sorted((folder / recipe).glob("*.csv")):
        where = f"{recipe}/{path.stem}"
        panels = by_file.get(path.stem)
        if panels is None:
            yield f"{where}: there is a reference, but no such figure any more"
        else:
            yield from (f"{where}, {text}" for text in differences(panels, path))


def page(sections: Sequence[Section], made_by: Provenance) -> str:
    """``index.html``: figures in a folder per section, with captions and the numbers under them."""
    contents = "".join(
        f'<li><a href="#{s.name}"><code>{s.name}</code></a>: {s.title}</li>\n'
        for s in sections
    )
    papers = {section.name for section in sections} & {*STUDIES}  # and not of one's own alone
    authors = "Ortega, Bobtsov, Castaños, Nikolaev, arXiv:2407.14373. " if papers else ""
    text = html.paragraph(
        f"{authors}Everything here was computed and drawn by gpebo figures. Beside every picture "
        "is a CSV file with exactly what is drawn."
    )
    body = "".join(
        f'<section id="{s.name}">\n<h2>{s.title}</h2>\n'
        f"<p><code>gpebo run experiment={s.name}</code></p>\n{s.content}</section>\n"
        for s in sections
    )
    nav = f"<nav><ul>\n{contents}</ul></nav>\n"
    title = "The paper’s figures, regenerated" if papers else "Figures of recipes"
    return html.document(title, text + nav + body + html.footer(made_by), embedded=False)


def _save(
    folder: Path, name: str, figure: Figure, alt: str, formats: Sequence[str]
) -> str:
    """Write a picture; how the page shows it, with links to its files."""
    for suffix in formats:
        save(figure, folder / f"{stem(name)}.{suffix}")
    base = escape(f"{folder.name}/{stem(name)}")
    links = ", ".join(f'<a href="{base}.{s}">{s.upper()}</a>' for s in ("csv", *formats))
    width, height = figure.canvas.get_width_height()
    text = escape(CAPTIONS[name].rstrip("."))
    return f"""<figure>
<img src="{base}.png" width="{width}" height="{height}" alt="{escape(alt)}">
<figcaption><b>{heading(name, folder.name)}:</b> {text}. {links}</figcaption>
</figure>
"""


def _alt(name: str, panels: Sequence[Panel]) -> str:
    """What a picture shows, for those who do not see it; the numbers are in its table."""
    curves = dict.fromkeys(curve.label for panel in panels for curve in panel.curves)
    axes = ", ".join(panel.label + (" (logarithmic)" if panel.log else "") for panel in panels)
    legend = ", ".join(label for label in curves if label)
    text = f"Line chart of {CAPTIONS[name]} over {panels[0].axis.label}: {axes}."
    return f"{text} Curves: {legend}." if legend else text


def _branch_text(branch: circuit.Branch) -> str:
    ends = ("ground" if node == circuit.GROUND else node for node in (branch.start, branch.end))
    current = f" with current {branch.current}" if branch.current else ""
    return f"{branch.element} from {' to '.join(ends)}{current}"


def stem(figure: str) -> str:
    """Name of a figure's files: with the paper's number where it has one."""
    return f"fig{_NUMBERS.get(figure, '')}_{figure}"


def heading(figure: str, recipe: str) -> str:
    """What a caption begins with."""
    if (number := _NUMBERS.get(figure)) is None:
        return "Not in the paper"
    return f"Fig. {number} of the paper" if recipe == PAPERS else f"As Fig. {number}"
