"""What the documentation says: examples run, links lead somewhere, names exist."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from examples import ROOT, blocks, commands, gpebo, python, shell

from gpebo_cli import __all__ as public
from gpebo_cli import __version__, estimators
from gpebo_cli.cli.app import COMMANDS
from gpebo_cli.cli.usage import help_of

README = ROOT / "README.md"
sys.path.insert(0, str(ROOT / "docs"))
import messages  # noqa: E402  in docs, of which the site is made
import tex  # noqa: E402
import tutorials  # noqa: E402

NOTEBOOK = ROOT / "docs" / "first_run.ipynb"
MADE = ("notebook.md", "commands.md", "messages.md")  # with the site
# That of completion is for a shell's start-up file.
HELP = {"": help_of(), **{name: help_of(name) for name in (*COMMANDS[1:-1], "run")}}

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")


# Help -----------------------------------------------------------------------------------------


def test_every_example_in_help_runs(tmp_path):
    """Each once, in the order of the texts and in one folder: some use what others wrote."""
    examples = [example for text in HELP.values() for example in commands(text)]
    assert len(commands(HELP["run"])) >= 5
    assert all(len(commands(text)) >= 3 for text in HELP.values())
    for example in dict.fromkeys(examples):
        assert re.match(r"gpebo [a-z]", example), example
        if "regression=paper" in example:  # not exciting: the check fails, as it says
            assert gpebo(*shlex.split(example)[1:], cwd=tmp_path).returncode == 1
        else:
            shell(example, tmp_path)


def test_help_names_every_command_and_group():
    assert all(f"\n  {name} " in HELP[""] for name in COMMANDS)
    for name, text in HELP.items():
        assert text.startswith(("usage: gpebo " + name, "gpebo: ")), name
        assert max(map(len, text.splitlines())) <= 100, name


# README and pages -----------------------------------------------------------------------------


def test_the_readme_runs(tmp_path):
    text = README.read_text()
    (script,) = blocks(text, "sh")
    said = shell(script, tmp_path)
    assert "interval-exciting from t = 0.04962 s on" in said
    (source,) = blocks(text, "python")
    python(source, tmp_path)
    assert (tmp_path / "from_python" / "summary.json").is_file()
    (plant,) = blocks(text, "yaml")
    (tmp_path / "plant" / "mine.yaml").write_text(plant)
    assert "interval-exciting" in shell("gpebo run --config-dir . plant=mine", tmp_path)


@pytest.mark.parametrize("page", tutorials.PAGES)
def test_a_tutorial_runs_as_it_stands(page, tmp_path):
    """Its commands, Python and edits in their order; its figures are made by them."""
    text = (ROOT / "docs" / f"{page}.md").read_text()
    said = ""
    for kind, body in tutorials.parts(text):
        words = body.replace("python -m pytest", f"{shlex.quote(sys.executable)} -m pytest")
        said += {"sh": shell, "python": python, "text": lambda *_: ""}[kind](words, tmp_path)
    for shown in re.findall(r"^```text\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        assert not page.startswith("howto/") or shown in said
        for line in shown.splitlines()[1:]:
            if "gpebo: error" in line or "FAILS" in line or "exit code" in line:
                assert line in said
    assert page != "tutorial_paper" or blocks(text, "text")[0] in said
    figures = tutorials.figures(text)
    assert figures
    for name, (run, figure) in figures.items():
        assert list((tmp_path / run).rglob(figure)), name
        assert (ROOT / "docs" / "img" / "tutorial" / name).read_bytes().startswith(b"\x89PNG")


def test_words_are_defined_where_they_are_met_first():
    text = (ROOT / "docs" / "tutorial.md").read_text()
    for word in ("**case**", "**recipe**", "**remedy**", "γ (`gamma`)", '"To 1 %" is',
                 "`e0_x` always means", "d is the number", "a is the number", "μ says"):
        assert word in text, word


def test_every_refusal_of_the_program_is_on_the_page_of_messages():
    page = messages.page()
    assert page.count("\n| `") > 200
    assert "was given no meaning" not in page
    for path in messages.PACKAGE.rglob("*.py"):
        for message in messages.messages(path):
            assert message.meaning, f"{path.name}: {message.text}"
    assert "there is no such folder" in page
    assert all(f"| {name} |" in page for name in messages._ADVICE)


@pytest.mark.parametrize(("text", "expected"), [
    ("Z2⊤M = 0", r"Z_{2}^{\top}M = 0"),
    ("η̂' = Γ", r"\hat{η}' = Γ"),
    ("Σ_{k≥j} (−1)^{k−j} C(k, k−j)", r"\sum _{k\ge j} (-1)^{k-j} C(k, k-j)"),
    ("w_{μ+1} = 0      (eq. 7, xa)", r"w_{μ+1} = 0 \quad  \text{(eq. 7, xa)} "),
    ("Γ = [R1 0; 0 1]", r"Γ = [R_{1}\ \ 0; 0\ \ 1]"),
    ("rank(𝒜Q) = n_b", r"\operatorname{rank} (𝒜Q) = n_b"),
    ("e0_T = ξ_a(0)", r"e_{0,\mathrm{T}} = ξ_a(0)"),
])
def test_formulas_become_tex(text, expected):
    assert tex.is_formula(text)
    assert " ".join(tex.tex(text).split()) == " ".join(expected.split())


def test_no_formula_of_a_page_has_an_index_below_an_index():
    """KaTeX sets none of these, and shows red text instead."""
    for page in (ROOT / "docs").rglob("*.md"):
        for text in filter(tex.is_formula, re.findall("`([^`\n]+)`", page.read_text())):
            found = re.search(r"([_^])(\{[^{}]*\}|\w)\1", tex.tex(text))
            assert not found, f"{page.name}: {text}"


def test_commands_and_names_are_no_formulas():
    for text in ("gpebo run plant=circuit", "estimator.gamma=1e8", "summary.json", "e0_e1", "a-b"):
        assert not tex.is_formula(text), text


def test_the_plant_page_runs(tmp_path):
    text = (ROOT / "docs" / "howto" / "plant.md").read_text()
    plant = next(block for block in blocks(text, "yaml") if "name: heater" in block)
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "heater.yaml").write_text(plant)
    (source,) = blocks(text, "python")
    (shown,) = blocks(text, "text")
    assert python(source, tmp_path) == shown


def test_the_leakage_page_runs(tmp_path):
    """From a netlist and an oscilloscope's file to a current with its deviation."""
    text = (ROOT / "docs" / "howto" / "leakage.md").read_text()
    said = ""
    for language, body in re.findall(r"^```(sh|python)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        said += (shell if language == "sh" else python)(body, tmp_path)
    shown = blocks(text, "text")
    assert len(shown) == 2
    assert all(line.strip() in said for line in shown)
    assert "the estimates explain the data up to white noise" in said
    assert "the residual is not white" in said


def test_the_estimator_page_runs(tmp_path):
    text = (ROOT / "docs" / "howto" / "estimator.md").read_text()
    (script,) = blocks(text, "sh")
    module = f"exec {shlex.quote(sys.executable)} -m pytest -p no:xdist"
    assert "3 passed" in shell(script.replace("python -m pytest", module), tmp_path)
    (shown,) = blocks(text, "python")
    assert shown == (tmp_path / "ridge" / "ridge.py").read_text()
    for name in set(re.findall(r"`(\w+)`", text.partition("## What there is")[2])):
        if re.match(r"[A-Z]\w+[a-z]", name):
            assert name in estimators.__all__, name


def test_the_session_from_a_loggers_file_to_deviations(tmp_path):
    """The page's three commands, on fewer rows; what the file was made with is within 4σ."""
    sys.path.insert(0, str(ROOT / "docs"))
    import recording

    page = (ROOT / "docs" / "howto" / "recording.md").read_text(encoding="utf-8")
    for command in recording.COMMANDS:
        assert f"$ {command}\n" in page
    assert recording.PLANT in page
    recording.session(tmp_path, 800, ("figures=false",))
    summary = json.loads((tmp_path / "result" / "summary.json").read_text())
    for name, true in recording.TRUE.items():
        found = summary["estimates"][name]
        assert abs(found["value"] - true) < 4.0 * found["std"] < 2.0 * true
    assert "up to white noise" in summary["verdict"]


VANADIUM = os.environ.get("GPEBO_VANADIUM", "")  # where crossover_data.mat is


@pytest.mark.skipif(not os.path.isdir(VANADIUM), reason="GPEBO_VANADIUM names no folder with data")
def test_the_vanadium_battery():
    page = (ROOT / "docs" / "howto" / "recording.md").read_text(encoding="utf-8")
    (source,) = blocks(page, "python")
    said = python(source, VANADIUM)
    assert said.startswith("k_mt = 3.434e-06 l/s\n")
    assert "not white" in said


def test_the_notebook_runs_and_its_outputs_are_real(tmp_path):
    """Code cells one after the other, without Jupyter; `make docs` runs them with it."""
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    sources = ["".join(cell["source"]) for cell in cells]
    said = python("\n".join(sources), tmp_path)
    assert all(cell["outputs"] for cell in cells)
    outputs = [output for cell in cells for output in cell["outputs"]]
    printed = "".join("".join(o["text"]) for o in outputs if o["output_type"] == "stream")
    # rounding differs between machines: numbers below 1e-6 are left out of the comparison
    small = re.compile(r"\d(\.\d+)?e-(0[6-9]|[1-9]\d)")
    assert small.sub("small", said) == small.sub("small", printed)
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
    assert NOTEBOOK.stat().st_size < 500_000


def test_links_between_files_lead_somewhere():
    for page in [README, *sorted((ROOT / "docs").rglob("*.md")), ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            if target.startswith(("http", *MADE)):
                continue
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_names_in_the_glossary_exist():
    """`module.Class` and `module.Class.attribute`, below gpebo_cli."""
    from importlib import import_module

    text = (ROOT / "docs" / "glossary.md").read_text()
    names = set(re.findall(r"`((?:[a-z_]+\.)+[A-Za-z_]\w*(?:\.\w+)*)`", text)) - {"summary.json"}
    assert len(names) > 50
    for name in names:
        parts = name.split(".")
        for cut in range(len(parts) - 1, 0, -1):
            try:
                found = import_module("gpebo_cli." + ".".join(parts[:cut]))
            except ModuleNotFoundError:
                continue
            break
        else:
            pytest.fail(f"no module for {name}")
        for part in parts[cut:]:
            fields = getattr(found, "__dataclass_fields__", {})
            annotations = getattr(found, "__annotations__", {})
            assert hasattr(found, part) or part in fields or part in annotations, name
            found = getattr(found, part, None)


def test_the_reference_has_every_public_name():
    text = (ROOT / "docs" / "api.md").read_text()
    modules = re.findall(r"^::: (\S+)", text, re.MULTILINE)
    covered = " ".join(modules)
    for name in public:
        if name == "__version__":
            continue
        home = __import__("gpebo_cli", fromlist=[name]).__dict__.get(name) or getattr(
            __import__("gpebo_cli"), name
        )
        assert f"{home.__module__}.{name}" in covered or f"{home.__module__}" in modules, name


# Citation -------------------------------------------------------------------------------------


def test_the_citation_file_is_complete_and_of_this_version():
    cff = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(cff)  # what the format requires
    assert cff["cff-version"] == "1.2.0"
    assert cff["type"] == "software"
    assert cff["version"] == __version__
    assert cff["license"] == "MIT"
    assert all(set(author) <= {"name"} or "family-names" in author for author in cff["authors"])
    (paper,) = cff["references"]
    assert {"type", "title", "authors"} <= set(paper)
    assert [a["family-names"] for a in paper["authors"]] == [
        "Ortega", "Bobtsov", "Castaños", "Nikolaev",
    ]
    assert paper["doi"] == "10.48550/arXiv.2407.14373"


def test_the_navigation_names_pages_that_exist():
    text = (ROOT / "mkdocs.yml").read_text()
    for page in re.findall(r": (\S+\.md)$", text, re.MULTILINE):
        made = page in MADE
        assert made or (ROOT / "docs" / page).is_file(), page
    assert "font: false" in text
    assert "polyfills: [iframe-worker.js]" in text, "a search from a file, without a network"


def test_the_figure_of_the_readme_is_a_picture():
    for name in re.findall(r"\((docs/img/[^)]+)\)", README.read_text()):
        assert Path(ROOT / name).read_bytes().startswith(b"\x89PNG")
