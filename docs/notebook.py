"""Execute the notebook: ``python docs/notebook.py`` checks, ``--write`` keeps the outputs."""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).with_name("first_run.ipynb")


def main() -> None:
    """Run every cell in a fresh kernel; an error of a cell ends this with an error."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    if "--write" in sys.argv[1:]:
        for cell in notebook.cells:
            cell.metadata = {}  # times of execution would change with every run
        notebook.metadata = {
            "kernelspec": {
                "display_name": "Python 3", "language": "python", "name": "python3"
            },
            "language_info": {"name": "python"},
        }
        nbformat.write(notebook, NOTEBOOK)


if __name__ == "__main__":
    main()
