"""Docstrings: everything public has one, arrays have shapes, errors are named, examples run."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
from processes import printed

import gpebo_cli

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "gpebo_cli"
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(gpebo_cli.__path__, "gpebo_cli.")
    if not module.name.endswith("__main__") and ".templates" not in module.name
)
ARRAYS = re.compile(r"\b(Array|Trajectory|IntArray|BoolArray)\b")
SHAPE = re.compile(r"\([\w.…+*/ −-]*,[\w.…+*/, −()-]*\)|\(\)")


def public(module):
    """Functions and classes of a module, and their methods, by dotted name."""
    for name, member in vars(module).items():
        if name.startswith("_") or getattr(member, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(member):
            yield f"{module.__name__}.{name}", member
        elif inspect.isclass(member):
            yield f"{module.__name__}.{name}", member
            for inner, method in vars(member).items():
                function = getattr(method, "fget", None) or getattr(method, "func", None) or method
                if not inner.startswith("_") and inspect.isfunction(function):
                    yield f"{module.__name__}.{name}.{inner}", function


MEMBERS = dict(
    pair for name in MODULES for pair in public(importlib.import_module(name))
)


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_has_a_docstring(name):
    module = importlib.import_module(name)
    source = Path(module.__file__ or "")
    if source.suffix != ".py" or source.read_text().strip():
        assert module.__doc__, name
    missing = [member for member, found in public(module) if not inspect.getdoc(found)]
    assert missing == []


def test_functions_of_arrays_say_their_shapes():
    """In the docstring, or in that of the class or module that all of it is about."""
    missing = []
    for name, function in MEMBERS.items():
        if not inspect.isfunction(function) or "_compiled." in name:  # as its twin in NumPy
            continue
        kinds = [str(kind) for key, kind in function.__annotations__.items() if key != "return"]
        if not any(ARRAYS.search(kind) for kind in kinds):
            continue
        if not SHAPE.search(inspect.getdoc(function) or ""):
            missing.append(name)
    assert missing == []


def test_fields_that_are_arrays_say_their_shapes():
    """In a comment behind the field, or in the docstring of the class."""
    missing = []
    for path in PACKAGE.rglob("*.py"):
        lines = path.read_text().splitlines()
        for node in ast.walk(ast.parse("\n".join(lines))):
            if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
                continue
            doc = ast.get_docstring(node) or ""
            for field in node.body:
                if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
                    continue
                kind = ast.unparse(field.annotation)
                line = lines[field.lineno - 1] + lines[field.lineno - 2]
                if re.search(r"\b(Array|IntArray|BoolArray)\b", kind) and "Callable" not in kind:
                    named = f"{field.target.id}" in doc and SHAPE.search(doc)
                    if not (SHAPE.search(line.partition("#")[2]) or named):
                        missing.append(f"{path.stem}.{node.name}.{field.target.id}")
    assert missing == []


def test_functions_that_raise_say_so():
    """Whoever raises an error of ours in its own body names its kind under Raises."""
    missing = []
    for path in PACKAGE.rglob("*.py"):
        if path.parent.name == "templates":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
                continue
            own = [
                inner for child in node.body if not isinstance(child, ast.FunctionDef)
                for inner in ast.walk(child)
            ]
            kinds = {
                raised.exc.func.id
                for raised in own
                if isinstance(raised, ast.Raise) and isinstance(raised.exc, ast.Call)
                and isinstance(raised.exc.func, ast.Name)
            } & {"ConfigError", "GpeboError", "ModelError", "SolverError"}
            doc = ast.get_docstring(node) or ""
            missing += [f"{path.stem}.{node.name}: {kind}" for kind in kinds if kind not in doc]
    assert missing == []


def test_every_name_of_the_package_has_an_example_or_says_what_it_is():
    for name in gpebo_cli.__all__:
        if name != "__version__":
            assert len(inspect.getdoc(getattr(gpebo_cli, name)).split()) >= 5, name
    for name in ("run", "check", "load_plant", "available", "system_from_functions", "Result"):
        assert ">>>" in inspect.getdoc(getattr(gpebo_cli, name)), name


def test_every_example_runs():
    finder = doctest.DocTestFinder(exclude_empty=True)
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    count = 0
    for name in MODULES:
        for test in finder.find(importlib.import_module(name), name):
            count += len(test.examples)
            runner.run(test)
    assert runner.summarize(verbose=False).failed == 0
    assert count >= 15


def test_the_packages_own_example_runs(tmp_path):
    """The lines in the docstring of gpebo_cli, which are the first that a user sees."""
    doc = inspect.getdoc(gpebo_cli)
    lines = [line[4:] for line in doc.splitlines() if line.startswith("    ")]
    printed(subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(lines)], cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    ))
    assert (tmp_path / "first" / "summary.json").is_file()


MATHEMATICS = [
    name for name in MODULES
    if re.fullmatch(
        r"gpebo_cli\.(estimators\.[a-z]\w+|observers\.[a-z]\w+|simulation\.\w+|collocation\.\w+"
        r"|excitation|metrics|regression|measurement|linalg)", name,
    )
]
EQUATION = re.compile(r"\S ?[=≤≥→⇒] ?\S|∫")


@pytest.mark.parametrize("name", MATHEMATICS)
def test_mathematics_says_its_equations(name):
    """In the docstring of the module or in those of what is in it."""
    docs = [inspect.getdoc(importlib.import_module(name)) or ""]
    docs += [inspect.getdoc(found) or "" for key, found in MEMBERS.items() if key.startswith(name)]
    assert EQUATION.search("\n".join(docs)), name


def test_settings_that_are_times_say_their_unit():
    lines = (PACKAGE / "settings.py").read_text().splitlines()
    fields = [line.strip() for line in lines if re.match(r"    \w+: ", line)]
    times = [
        line for line in fields
        if re.match(r"(start|horizon|window|sample_time|\w*_(interval|times|time)):", line)
    ]
    assert len(times) >= 4
    assert [line for line in times if "seconds" not in line.partition("#")[2]] == []
