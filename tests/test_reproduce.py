"""`gpebo reproduce`: published numbers, and what is said where one is off."""

from __future__ import annotations

from dataclasses import replace

import pytest
import yaml
from examples import ROOT, gpebo
from processes import assert_refused, printed

from gpebo_cli import ConfigError
from gpebo_cli.cli import reproduce
from gpebo_cli.configs.locations import choices, conf_folder

NAMES = choices(conf_folder(), reproduce.FOLDER)


def test_every_recipe_says_what_it_reproduces_and_from_where():
    assert len(NAMES) >= 10
    for name in NAMES:
        path = ROOT / "experiments" / "published" / f"{name}.yaml"
        recipe = yaml.safe_load(path.read_text())
        assert recipe["title"]
        assert recipe["reference"]
        assert all(entry["where"] for entry in recipe["expected"])
        assert len(path.read_text().splitlines()) <= 40


# One needs data, and those that take long do so in `gpebo reproduce` of CI.
LONG = {"transistor", "oregonator", "akzo", "hires", "robertson"}


@pytest.mark.parametrize("name", sorted({*NAMES} - {"vanadium", *LONG}))
def test_published_numbers_are_ours(name):
    found = list(reproduce.reproduced(name))
    assert found
    assert [f for f in found if not f.holds] == []


def test_the_page_is_that_of_the_recipes():
    page = (ROOT / "docs" / "atlas.md").read_text()
    assert all(f"`{name}`" in page for name in NAMES)
    assert "**off**" not in page
    assert page.count("**erratum**") == 2
    for name in NAMES:
        recipe = yaml.safe_load((ROOT / "experiments" / "published" / f"{name}.yaml").read_text())
        for entry in recipe["expected"]:
            assert f" | {float(entry['tolerance']):.1g} | {entry['where']} |\n" in page, name
        picture = f"img/atlas/{name}.png"
        assert f"({picture})" in page
        assert (ROOT / "docs" / picture).stat().st_size < 40_000


def test_a_page_and_its_pictures_are_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert reproduce.main(["fct_agent2", "gelda", "vanadium", "--page", "page/a.md"]) == 0
    page = (tmp_path / "page" / "a.md").read_text()
    assert "fct_agent2`: " in page
    assert "| Erratum | The text says 1.7 s." in page
    assert "| 3.3685e-06 | needs their data |" in page
    assert page.count("![") == 2
    for name in ("fct_agent2", "gelda"):
        picture = tmp_path / "page" / "img" / "atlas" / f"{name}.png"
        content = picture.read_bytes()
        assert (content[1:4], int.from_bytes(content[16:20])) == (b"PNG", 144)  # two inches of 72
    # what needs a download says from where, and is no failure
    said = capsys.readouterr().err
    assert "vanadium: not run, there is no crossover_data.mat here" in said
    assert "davidhowey/ACC2019" in said


def test_a_number_that_is_off_is_an_exit_code(tmp_path, monkeypatch, capsys):
    found = reproduce.Finding("r", "t", "s", "last.x", 1.0, 1.1, 0.05, "page 3")
    monkeypatch.setattr(reproduce, "reproduced", lambda name, options, pictures: [found])
    near = [replace(found, ours=ours).holds for ours in (None, 0.94, 0.96, 1.04, 1.06)]
    assert near == [True, False, True, True, False]
    assert reproduce.main(["gelda"]) == 1
    out = capsys.readouterr().out
    assert "OFF by 0.1" in out
    assert out.endswith("1 recipe, 1 number, 1 off\n")
    assert_refused(gpebo("reproduce", "geldaa", cwd=tmp_path), "did you mean gelda?")


def test_quantities_are_those_of_signals_estimates_and_cases():
    from gpebo_cli import run

    result = run("circuit", estimator="drem", gamma=[1e8, 1e10],
                 time={"horizon": 1, "samples": 11}).details
    x, found = result.signals.states[:, 1], result.estimation
    for name, values in (
        ("first.e2", [x[0]]), ("last.e2", [x[-1]]), ("max.e2", [x.max()]), ("min.e2", [x.min()]),
        ("final.e2", found.states[:, -1, 1]), ("final.e0_e2", found.parameters[:, -1, 1]),
        ("case.final_error_states", result.metrics.final_error_states),
    ):
        assert reproduce.quantity(result, name, "recipe") == list(values), name


def test_a_quantity_that_is_none_names_those_there_are():
    from gpebo_cli import run

    result = run("circuit", observer="none", time={"horizon": 1}).details
    with pytest.raises(ConfigError, match="of last the names V, y, e1"):
        reproduce.quantity(result, "last.q", "recipe")


def test_a_recipe_runs_alone(tmp_path):
    said = printed(gpebo("run", "experiment=published/fct_agent1", "figures=none", cwd=tmp_path))
    assert "interval-exciting" in said
