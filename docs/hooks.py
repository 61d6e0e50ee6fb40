"""What mkdocs cannot do by itself: pages made from the program's help and from the notebook.

Run by ``mkdocs build`` (see mkdocs.yml), which imports this file; nothing here needs a network.
"""

from __future__ import annotations

import base64
import re
import sys
from importlib.metadata import files as files_of
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from gpebo_cli.cli.app import COMMANDS
from gpebo_cli.cli.usage import help_of

sys.path.insert(0, str(Path(__file__).parent))
import messages
from tex import typeset

DOCS = Path(__file__).parent
NOTEBOOK = DOCS / "first_run.ipynb"

_TYPESET = ("index", "theory", "errata", "glossary", "decisions", "howto/", "tutorial")

# Sphinx's roles in docstrings, which mkdocstrings shows as they stand.
_ROLE = re.compile(r":(?:func|class|data|meth|attr|mod):(?=<code>)")
_CELL_CODE = re.compile(r"(?<=<td>).*?(?=</td>)")
_DOT = re.compile(r"(?<=\w)\.(?=\w+[^<>]*</code>)")
_CODE_PATH = re.compile(r"<code>~?gpebo_cli\.(?:\w+\.)*(\w+)</code>")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put pages of howto/ that the navigation does not name at its end of the how-tos."""
    for entry in config.nav or []:
        if isinstance(entry, dict) and "How to" in entry:
            named = {path for item in entry["How to"] for path in item.values()}
            found = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.glob("howto/*.md"))
            entry["How to"] += [path for path in found if path not in named]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here."""
    files.append(File.generated(config, "commands.md", content=commands_page()))
    files.append(File.generated(config, "messages.md", content=messages.page()))
    katex = next(p for p in files_of("sphinxcontrib-katex") or [] if p.name == "katex.min.js")
    files.append(File.generated(config, "katex.min.js", abs_src_path=str(katex.locate())))
    text, pictures = notebook_page()
    files.append(File.generated(config, "notebook.md", content=text))
    for name, content in pictures.items():
        files.append(File.generated(config, f"img/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Offer a tutorial as a notebook, too, where that has been made."""
    path = f"notebooks/{Path(page.file.src_uri).stem}.ipynb"
    told = f"\n\nThis page as a notebook with its outputs: [{path}]({path}).\n"
    return markdown + (told if (DOCS / path).is_file() else "")


def on_page_content(html: str, page: Page, **_: Any) -> str:
    """Set formulas, take roles out of what mkdocstrings has rendered, let names break at dots."""
    html = typeset(html) if page.url.startswith(_TYPESET) else html
    html = _CODE_PATH.sub(r"<code>\1</code>", _ROLE.sub("", html))
    return _CELL_CODE.sub(lambda match: _DOT.sub(".<wbr>", match[0]), html)


def commands_page() -> str:
    """The help of every command, as it is printed."""
    texts = {
        "gpebo": help_of(), **{f"gpebo {command}": help_of(command) for command in COMMANDS},
    }
    parts = [f"## {name}\n\n```text\n{text.rstrip()}\n```\n" for name, text in texts.items()]
    return "\n".join(["# Commands\n\nWhat `--help` prints.\n", *parts])


def notebook_page() -> tuple[str, dict[str, bytes]]:
    """The notebook as Markdown with its outputs, and its pictures by file name."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"notebook_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![{_alt(cell.source)}](img/{name})")
            else:
                text = output.get("text") or data.get("text/plain", "")
                parts.append(f"```text\n{text.rstrip()}\n```")
    where = "This page is the notebook `docs/first_run.ipynb`, with the outputs it has there."
    return "\n\n".join([*parts, where]) + "\n", pictures


def _alt(source: str) -> str:
    return f"figure drawn by {source.splitlines()[-1]}".replace("[", "(").replace("]", ")")
