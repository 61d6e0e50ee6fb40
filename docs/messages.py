"""The page of messages, made from the program: what it raises, and what its docstrings say."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from gpebo_cli.cli.check import _ADVICE

PACKAGE = Path(__file__).parents[1] / "gpebo_cli"
_KINDS = {"ConfigError": 2, "ModelError": 1, "SolverError": 1, "GpeboError": 1}
_HEAD = """# Messages and what to do

A refusal is one line on stderr, `gpebo: error: …`. It names the file, the key or the time, and what
would be accepted. Exit code 2 means that the command or a file is wrong; 1 means that the model
cannot be used, or that the run failed. `HYDRA_FULL_ERROR=1` in the environment adds the traceback.
Search this page for a few words of your message; `…` stands for names and numbers of yours. The
messages that plants cause most often are explained with their remedies in
[A plant of your own](howto/plant.md#errors-you-may-meet).

## What `gpebo check` finds

| what fails | what to do |
|---|---|
"""


@dataclass(frozen=True)
class Message:
    """One refusal of the program."""

    text: str  # with … for what differs
    code: int  # the exit code
    meaning: str  # of its kind, from the docstring of the function


@cache
def messages(path: Path) -> tuple[Message, ...]:
    """What a module raises, in its order, each text once."""
    return tuple(_messages(path))


def _messages(path: Path) -> Iterator[Message]:
    seen = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    scopes: list[tuple[ast.AST, str]] = [(tree, ast.get_docstring(tree) or "")]
    while scopes:
        scope, outer = scopes.pop(0)
        for node in ast.iter_child_nodes(scope):
            own = outer
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                own = ast.get_docstring(node) or outer
            scopes.append((node, own))
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
                continue
            if node.func.id not in _KINDS or not node.args:
                continue
            text = " ".join(_text(node.args[0]).split())
            if len(re.sub(r"[^a-z]", "", text)) > 8 and text not in seen:
                seen.add(text)
                yield Message(text, _KINDS[node.func.id], _meaning(outer, node.func.id))


def _text(node: ast.expr) -> str:
    """The text that an expression makes, as far as it is written there."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return re.sub("…+", "…", _text(node.left) + _text(node.right))
    return "…"


def _meaning(docstring: str, kind: str) -> str:
    """What the docstring says of an error of this kind; else what the function does."""
    pattern = rf"(?:^\s*|\(){kind}: (.*?)(?=\s\w+Error: |\n\n|\)\.|\Z)"
    found = re.search(pattern, docstring, re.MULTILINE | re.DOTALL)
    text = found[1] if found else docstring.partition("\n\n")[0]
    text = re.sub(r" \((?:\w+Error(?:, )?)+\)", "", text)
    return " ".join(text.replace("``", "`").split())


def page() -> str:
    """The page as Markdown."""
    lines = [_HEAD.rstrip()]
    lines += [f"| {name} | {text} |" for name, text in _ADVICE.items()]
    for folder in sorted({path.parent for path in PACKAGE.rglob("*.py")}):
        rows = []
        for path in sorted(folder.glob("*.py")):
            found = messages(path)
            rows += [
                f"| `{m.text.replace('|', chr(92) + '|').replace('`', chr(39))}` | {m.code} | "
                f"{m.meaning.replace('|', chr(92) + '|')} |"
                for m in found
            ]
        if rows:
            name = folder.relative_to(PACKAGE).as_posix()
            about = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
            title = about.partition("\n")[0].partition(":")[0].rstrip(".") or name.capitalize()
            lines += ["", f"## {title if name != '.' else 'Reading and choosing'}", "",
                      "| message | exit code | meaning |", "|---|---|---|", *rows]
    return "\n".join(lines) + "\n"
