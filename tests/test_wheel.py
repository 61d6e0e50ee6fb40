"""The wheel, alone, in an empty folder: configuration and recipes are inside it."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from processes import printed, wait_for

from gpebo_cli import __version__, kernels

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the wheel and with `site`, made once for all workers of these tests."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder = folder / "wheel"
    try:
        folder.mkdir()
    except FileExistsError:
        wait_for(folder, "unpacked")
        return folder
    quick = folder / "cc"  # code that is not optimised is compiled in a tenth of the time
    quick.write_text('#!/bin/sh\nexec cc "$@" -O0\n')
    quick.chmod(0o755)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT],
        check=True, capture_output=True,
        env=os.environ | ({} if os.name == "nt" else {"CC": str(quick)}),
    )
    subprocess.run(
        [
            sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index",
            "--disable-pip-version-check", "--target", folder / "site", *folder.glob("*.whl"),
        ],
        check=True, capture_output=True,
    )
    (folder / "unpacked").touch()
    return folder


@pytest.fixture(scope="module")
def wheel(made):
    (path,) = made.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(made):
    """The wheel unpacked as pip would, without its dependencies, which are here already."""
    return made / "site"


@pytest.fixture
def gpebo(installed, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "HYDRA_FULL_ERROR"}
    environment |= {"PYTHONPATH": str(installed), "MPLBACKEND": "Agg"}

    def call(*words, **variables):
        return subprocess.run(
            [sys.executable, "-m", "gpebo_cli", *words], cwd=tmp_path, env=environment | variables,
            capture_output=True, text=True, check=False, timeout=120,
        )

    return call


def test_what_is_in_it(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert len(names) == len(set(names))
    for path in (ROOT / "conf").rglob("*.yaml"):
        assert f"gpebo_cli/conf/{path.relative_to(ROOT / 'conf').as_posix()}" in names
    for path in (ROOT / "experiments").glob("*.yaml"):
        assert f"gpebo_cli/conf/experiment/{path.name}" in names
    tops = {name.split("/")[0] for name in names}
    # hydra_plugins is a namespace package, of all who have plugins for Hydra
    assert "hydra_plugins/__init__.py" not in names
    metadata = next(top for top in tops if top.endswith(".dist-info"))
    assert tops == {"gpebo_cli", "hydra_plugins", metadata}


def test_kernels_are_compiled_or_left_out(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    compiled = [name for name in names if name.startswith("gpebo_cli/kernels/_compiled.")
                and not name.endswith(".pyi")]
    assert len(compiled) == (kernels.kind() == "compiled")
    assert ("abi3" in wheel.name) == ("-any" not in wheel.name) == bool(compiled)
    assert not [name for name in names if name.endswith((".c", ".h"))]


def test_it_is_the_installed_package_that_runs(installed, gpebo):
    assert str(installed / "gpebo_cli" / "conf") in printed(gpebo("run", "--info", "searchpath"))


def test_the_main_job(gpebo, tmp_path):
    said = printed(gpebo("run", "plant=circuit", "estimator=drem", "hydra.run.dir=here"))
    assert said.splitlines()[-1].startswith("interval-exciting from t = ")
    assert len(list((tmp_path / "here" / "figures").glob("*.png"))) >= 7
    tables = {"signals", "regression", "excitation", "estimates", "cases"}
    assert {path.stem for path in (tmp_path / "here").glob("*.csv")} == tables


@pytest.mark.skipif(kernels.kind() == "numpy", reason="the kernels are not compiled")
def test_a_run_without_kernels_says_so_and_finds_the_same(gpebo, tmp_path):
    found = {}
    for kind in ("compiled", "numpy"):
        words = ["plant=circuit", "figures=none", f"hydra.run.dir={kind}"]
        printed(gpebo("run", *words, GPEBO_KERNELS=kind))
        summary = json.loads((tmp_path / kind / "summary.json").read_text())
        assert summary["versions"]["kernels"] == kind
        with (tmp_path / kind / "estimates.csv").open() as rows:
            found[kind] = [[float(cell) for cell in row] for row in list(csv.reader(rows))[1:]]
    for one, other in zip(found["compiled"], found["numpy"], strict=True):
        assert one == pytest.approx(other, rel=1e-9, abs=1e-9)


def test_a_recipe_a_plant_of_ones_own_and_a_repetition(gpebo, tmp_path):
    listed = gpebo("list", "experiments")
    assert "paper_circuit" in listed.stdout
    assert gpebo("run", "experiment=paper_circuit", "figures=none").returncode == 0

    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "mine.yaml").write_text(
        "name: mine\nstates: [x]\noutputs: [y]\nE: [[1]]\nA: [[-1]]\nC: [[1]]\n"
        "initial_state: {x: 1}\n"
    )
    words = ["--config-dir", ".", "plant=mine", "figures=none", "hydra.run.dir=mine"]
    assert gpebo("run", *words).returncode == 0
    printed(gpebo("run", "--config-dir", "mine", "--config-name", "config"))


def test_a_sweep_finds_its_sweeper(gpebo, tmp_path):
    words = ["time.samples=51", "figures=none", "hydra.sweep.dir=sweep"]
    printed(gpebo("run", "-m", "estimator.gamma=1e6,1e8", *words))
    assert (tmp_path / "sweep" / "sweep.json").is_file()


def test_errors_are_one_line(gpebo):
    done = gpebo("run", "plant=circut")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "did you mean circuit?" in done.stderr


# What is published ----------------------------------------------------------------------------


def test_metadata_names_pages_versions_and_licence(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (path,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        metadata = archive.read(path).decode()
    for url in ("Homepage", "Documentation", "Source", "Issues", "Changelog"):
        assert f"Project-URL: {url}, https://" in metadata
    stated = set(re.findall(r"Python :: (3\.\d+)$", metadata, re.MULTILINE))
    ci = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    assert stated == set(ci["jobs"]["check"]["strategy"]["matrix"]["python"])
    assert min(stated, key=lambda v: int(v[2:])) in metadata.partition("Requires-Python: >=")[2]


def test_lowest_versions_are_those_that_are_tested():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    script = (ROOT / ".ci/lowest").read_text()
    tested = dict(re.findall(r"'?([a-z-]+)==([\d.]+?)(?:\.\*)?'? ", script))
    for requirement in project["dependencies"]:
        name, lowest = re.match(r"([a-z-]+)>=([\d.]+)", requirement).groups()
        assert tested[name] == lowest


def test_recipes_of_other_packagers_have_the_same_dependencies_and_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text())
    needed = {line.replace("matplotlib-base", "matplotlib").replace(" ", "")
              for line in recipe["requirements"]["run"]}
    assert needed == {*project["dependencies"], f"python{project['requires-python']}"}
    assert recipe["context"]["version"] == __version__
