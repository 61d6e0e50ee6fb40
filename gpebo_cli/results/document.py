"""Runs and sweeps as one page: verdict, assumptions, tables, figures, configuration, versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpebo_cli.errors import GpeboError
from gpebo_cli.results import html
from gpebo_cli.results.comparison import figures
from gpebo_cli.results.finished import Found, read_columns, read_summary
from gpebo_cli.results.names import METRICS
from gpebo_cli.results.report import case_cells
from gpebo_cli.results.style import file_content
from gpebo_cli.results.symbols import number_text, with_unit

if TYPE_CHECKING:
    from gpebo_cli.results.provenance import Provenance

_PNG = b"\x89PNG\r\n\x1a\n"
_LARGEST = 20_000_000  # bytes of a picture
_MOST_CASES = 50
# Sections of the summary that are a few numbers each.
_SECTIONS = ("recording", "noise", "fit", "excitation", "error_estimate", "timings")


def document(parts: Sequence[Found], made_by: Provenance) -> str:
    """The page, complete in itself."""
    title = f"gpebo: {', '.join(part.label for part in parts)}"
    return html.document(title, "".join(map(_part, parts)) + html.footer(made_by), embedded=True)


def _part(part: Found) -> str:
    runs = [_run(name, folder) for name, folder, _ in part.runs]
    if not part.records:
        return "".join(runs)
    failed = [number for number, job in enumerate(part.records) if job.status != "done"]
    rows = [("job", "what was chosen", "status", "error")]
    rows += [
        (str(r.job), " ".join(f"{k}={v}" for k, v in r.overrides.items()), r.status, r.error)
        for r in part.records
    ]
    count = f"{len(part.records) - len(failed)} of {len(part.records)} jobs are done"
    cases = part.cases
    drawn = "".join(
        html.embedded_figure(file_content(figure, "png"), name)
        for name, figure in (figures(cases) if cases else ())
    )
    heading = (
        f"<section>\n<h2>{escape(part.label)}</h2>\n{html.paragraph(count, 'verdict')}"
        f'{html.table(rows, text=True, failed=failed)}<div class="figures">{drawn}</div>\n'
    )
    inside = "".join(
        f"<details><summary>{escape(name)}</summary>\n{run}</details>\n"
        for (name, *_), run in zip(part.runs, runs, strict=True)
    )
    return f"{heading}{inside}</section>\n"


def _run(name: str, folder: Path) -> str:
    summary = read_summary(folder)
    try:
        words = _words(summary)
        assumptions = _assumptions(summary)
        facts = [("", ""), *((key.replace("_", " "), text) for key in _SECTIONS
                             if (text := _pairs(summary.get(key))))]
        made_with = _pairs(summary.get("versions")), _pairs(summary.get("git"))
        estimates, cases = _estimates(summary), _cases(folder)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise GpeboError(f"{folder / 'summary.json'}: not the summary of a run") from error
    pictures = "".join(
        html.embedded_figure(content, path.stem)
        for path in sorted((folder / "figures").glob("*.png"))
        if (content := _picture(path))
    )
    versions, configuration = "; ".join(filter(None, made_with)), ""
    if (path := folder / "config.yaml").is_file():
        written = path.read_text(encoding="utf-8", errors="replace")
        configuration = (
            f"<details><summary>Configuration</summary>\n<pre>{escape(written)}</pre></details>\n"
        )
    return (
        f"<section>\n<h2>{escape(name)}</h2>\n{words}"
        f"{_titled('Estimates at the end', html.table(estimates))}"
        f"{_titled('Cases', html.table(cases))}"
        f"{_titled('What the result rests on', assumptions)}"
        f"{_titled('Facts', html.table(facts, text=True))}"
        f'<div class="figures">{pictures}</div>\n'
        f"{configuration}{html.paragraph(f'Made with {versions}.' if versions else '')}"
        "</section>\n"
    )


def _titled(title: str, content: str) -> str:
    return f"<h3>{escape(title)}</h3>\n{content}" if content else ""


def _words(summary: Mapping[str, Any]) -> str:
    plant = " · ".join(
        str(summary[key]) for key in ("plant", "title", "reference") if summary.get(key)
    )
    estimator = summary.get("estimator") or {}
    how = f"observer {summary.get('observer')}"
    if estimator:
        how += f", estimator {estimator.get('name')}"
    warnings = "".join(html.paragraph(f"Warning: {line}") for line in summary.get("warnings") or ())
    verdict = html.paragraph(str(summary.get("verdict", "")), "verdict")
    return html.paragraph(plant) + html.paragraph(how) + verdict + warnings


def _assumptions(summary: Mapping[str, Any]) -> str:
    found = summary.get("assumptions") or []
    rows = [("", "assumption", "statement", "evidence")] + [
        ("holds" if a["holds"] else "FAILS", str(a["name"]), str(a["statement"]),
         _pairs(a["evidence"]))
        for a in found
    ]
    failed = [number for number, a in enumerate(found) if not a["holds"]]
    return html.table(rows, text=True, failed=failed) if found else ""


def _pairs(section: object) -> str:
    if not isinstance(section, Mapping):
        return ""
    return ", ".join(f"{key} {_value(v)}" for key, v in section.items() if v is not None)


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return f"({_pairs(value)})"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return number_text(value)


def _estimates(summary: Mapping[str, Any]) -> list[list[str]]:
    """The last estimate of everything, with its deviation and the truth where they are known."""
    found = summary.get("estimates") or {}
    cases = list(found.items())[:_MOST_CASES] if "0" in found else [("0", found)]
    known = any(one["true"] is not None for one in cases[0][1].values())
    head = ["", *(f"case {number}" for number, _ in cases), *(["truth"] if known else [])]
    rows = []
    for name, first in cases[0][1].items():
        cells = [
            _text(one["value"]) + ("" if one["std"] is None else f" ± {_text(one['std'])}")
            for one in (case[name] for _, case in cases)
        ]
        truth = "" if first["true"] is None else _text(first["true"])
        rows.append([with_unit(name, first["unit"] or ""), *cells, *([truth] if known else [])])
    return [head, *rows] if rows else []


def _text(value: float | None) -> str:
    return number_text(np.nan if value is None else value)


def _cases(folder: Path) -> list[list[str]]:
    path = folder / "cases.csv"
    if not path.is_file():
        return []
    columns = read_columns(path, "case")
    count = len(columns.pop("case"))
    shown = dict.fromkeys(METRICS, np.full(count, np.nan)) | columns
    rows = [{k: float(v[i]) for k, v in shown.items()} for i in range(min(count, _MOST_CASES))]
    return case_cells([("", row) for row in rows])


def _picture(path: Path) -> bytes:
    if not path.is_file() or path.stat().st_size > _LARGEST:
        return b""
    content = path.read_bytes()
    return content if content.startswith(_PNG) else b""
