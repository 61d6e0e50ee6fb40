"""Execute the notebooks: ``python docs/notebook.py``.

``first_run.ipynb`` is kept, with its outputs where ``--write`` is given. The tutorials are made
into notebooks below ``docs/notebooks``; the site offers them beside the pages.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from tutorials import DOCS, PAGES, parts

NOTEBOOK = DOCS / "first_run.ipynb"
TUTORIALS = DOCS / "notebooks"


def main() -> None:
    """Run every cell in a fresh kernel; an error of a cell ends this with an error."""
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    if "--write" in sys.argv[1:]:
        nbformat.write(_plain(notebook), NOTEBOOK)
    for page in PAGES:
        made = of_page((DOCS / f"{page}.md").read_text(encoding="utf-8"))
        with tempfile.TemporaryDirectory() as folder:
            resources = {"metadata": {"path": folder}}
            NotebookClient(made, timeout=300, kernel_name="python3", resources=resources).execute()
        target = TUTORIALS / f"{page}.ipynb"
        target.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(_plain(made), target)


def of_page(text: str) -> nbformat.NotebookNode:
    """A tutorial as a notebook: its commands are cells."""
    cells = []
    for kind, body in parts(text):
        if kind == "text" and body:
            cells.append(new_markdown_cell(body.replace("](img/", "](../img/")))
        elif kind != "text":
            cells.append(new_code_cell(f"%%bash -e\n{body}" if kind == "sh" else body.rstrip()))
    for k, cell in enumerate(cells):
        cell.id = f"cell-{k}"
    return new_notebook(cells=cells)


def _plain(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Without times of execution, which would change with every run."""
    for cell in notebook.cells:
        cell.metadata = {}
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


if __name__ == "__main__":
    main()
