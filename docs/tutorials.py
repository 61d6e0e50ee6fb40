"""The tutorials as they are run: ``python docs/tutorials.py [PAGE …]`` makes their figures again.

A tutorial's blocks in ``sh``, ``python`` and ``diff`` are run in their order in one folder. A
figure ``img/tutorial/RUN-NAME.png`` is ``RUN/figures/NAME.png`` or ``RUN/NAME.png`` of that folder.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parent
PAGES = (
    "tutorial", "tutorial_recording", "tutorial_estimator", "tutorial_paper", "howto/mechanism",
)
_BLOCK = re.compile(
    r'^```(sh|python|diff)(?: title="([^"]*)")?\n(.*?)^```', re.MULTILINE | re.DOTALL
)


def parts(text: str) -> list[tuple[str, str]]:
    """The text of a page in its order: (``text``, Markdown), (``sh``, script), (``python``, code).

    A ``diff`` is Python that changes the file.
    """
    found, end = [], 0
    for match in _BLOCK.finditer(text):
        found.append(("text", text[end : match.start()].strip()))
        language, file, body = match.groups()
        if language == "diff":
            language, body = "python", _edit(file, body)
        found.append((language, body))
        end = match.end()
    return [*found, ("text", text[end:].strip())]


def _edit(file: str, diff: str) -> str:
    lines = diff.splitlines()
    old, new = ("\n".join(x[1:] for x in lines if x[0] in kept) for kept in (" -", " +"))
    return (
        f"from pathlib import Path\n\nfile = Path({file!r})\ntext = file.read_text()\n"
        f"assert text.count({old!r}) == 1\nfile.write_text(text.replace({old!r}, {new!r}))\n"
    )


def figures(text: str) -> dict[str, tuple[str, str]]:
    """By the name of a figure on a page the folder of the run, and its name there."""
    found = re.findall(r"\((?:\.\./)?img/tutorial/((\w+)-(\w+)\.png)\)", text)
    return {name: (run, f"{figure}.png") for name, run, figure in found}


def main() -> None:
    """Run the tutorials and keep their figures."""
    target = DOCS / "img" / "tutorial"
    target.mkdir(exist_ok=True)
    for page in sys.argv[1:] or PAGES:
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder:
            for kind, body in parts(text):
                if kind != "text":
                    program = ["bash", "-e", "-c"] if kind == "sh" else [sys.executable, "-c"]
                    subprocess.run([*program, body], cwd=folder, check=True)  # noqa: S603
            for name, (run, figure) in figures(text).items():
                there = [Path(folder, run, "figures", figure), Path(folder, run, figure)]
                shutil.copy(next(path for path in there if path.is_file()), target / name)


if __name__ == "__main__":
    main()
