"""`gpebo new plant`, and what `gpebo check` says of the mistakes one then makes."""

from __future__ import annotations

import os
import re
import shlex
import sys
import tomllib

import pytest
import yaml
from examples import ROOT, gpebo, shell
from processes import assert_refused, install, printed, process

from gpebo_cli.cli.check import _ADVICE
from gpebo_cli.cli.new import files
from gpebo_cli.model.plant import KEYS

PYTEST = f"{shlex.quote(sys.executable)} -m pytest -q -W error -p no:xdist"


def test_it_runs_as_it_stands_with_the_defaults_and_converges(tmp_path):
    path, run, check = printed(gpebo("new", "plant", "tank", cwd=tmp_path)).splitlines()
    assert path == "plant/tank.yaml"
    words = run.partition("gpebo ")[2].split()
    said = printed(gpebo(*words, "figures=none", cwd=tmp_path))
    assert "never" not in said
    assert "not met" not in said
    words = check.partition("gpebo ")[2].split()
    assert printed(gpebo(*words, cwd=tmp_path)).endswith("everything that is needed holds\n")
    assert "heated tank" in gpebo("list", "plants", "--config-dir", ".", cwd=tmp_path).stdout


def test_it_can_be_written_elsewhere(tmp_path):
    said = printed(gpebo("new", "plant", "tank-2.yaml", "--config-dir", "my models", cwd=tmp_path))
    assert (tmp_path / "my models" / "plant" / "tank-2.yaml").is_file()
    assert "--config-dir 'my models' plant=tank-2" in said


def test_an_observer_passes_its_test(tmp_path):
    printed(gpebo("new", "observer", "mine_too", cwd=tmp_path))
    assert "5 passed" in shell(PYTEST, tmp_path)
    entry = tomllib.loads((tmp_path / "pyproject.toml").read_text())["project"]["entry-points"]
    assert entry == {"gpebo.observers": {"mine_too": "mine_too:MineToo"}}


def test_an_estimator_passes_its_test_and_is_found_once_it_is_installed(tmp_path):
    written = printed(gpebo("new", "estimator", "two_words", cwd=tmp_path)).splitlines()[:4]
    assert written == [
        "two_words.py", "estimator/two_words.yaml", "test_two_words.py", "pyproject.toml",
    ]
    assert "3 passed" in shell(PYTEST, tmp_path)
    assert "class TwoWords(GainEstimator)" in (tmp_path / "two_words.py").read_text()
    entry = tomllib.loads((tmp_path / "pyproject.toml").read_text())["project"]["entry-points"]
    assert entry == {"gpebo.estimators": {"two_words": "two_words:TwoWords"}}
    again = gpebo("new", "estimator", "two_words", cwd=tmp_path)
    assert_refused(again, "two_words.py exists already")


def test_a_recipe_runs_and_is_drawn(tmp_path):
    said = printed(gpebo("new", "recipe", "two_gains", cwd=tmp_path))
    assert "gpebo run --config-dir . experiment=two_gains" in said
    done = gpebo("run", "--config-dir", ".", "experiment=two_gains", "figures=none", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "1e+08" in done.stdout
    listed = gpebo("list", "experiments", "--config-dir", ".", cwd=tmp_path).stdout
    assert "the circuit, fast and slow gains" in listed
    path = tmp_path / "experiment" / "two_gains.yaml"
    path.write_text(path.read_text().replace("horizon: 20, samples: 1001", "horizon: 2"))
    printed(gpebo("figures", "two_gains", "--config-dir", ".", "--output", "drawn", cwd=tmp_path))
    page = (tmp_path / "drawn" / "index.html").read_text()
    assert "fast and slow gains" in page
    assert "paper’s figures" not in page
    assert "Ortega" not in page
    sweep = re.sub("^# (?=hydra:|  )", "", path.read_text(), flags=re.MULTILINE)
    path.with_stem("sweep").write_text(sweep)
    words = ["run", "--config-dir", ".", "experiment=sweep", "--dry-run"]
    assert "4 jobs; nothing was run" in gpebo(*words, cwd=tmp_path).stdout
    assert not list((tmp_path / "drawn").rglob("*circuit*"))  # that is the paper's
    wrong = gpebo("figures", "two_gain", "--config-dir", ".", cwd=tmp_path)
    assert "did you mean two_gains?" in wrong.stderr
    path.write_text(path.read_text().replace("horizon: 2", "horizon: -2"))
    wrong = gpebo("figures", "two_gains", "--config-dir", ".", cwd=tmp_path)
    assert_refused(wrong, "two_gains: time.horizon: ")


def test_an_installed_estimator_without_its_file_is_said_to_be_one(tmp_path):
    assert gpebo("new", "estimator", "ridge_of_mine", cwd=tmp_path).returncode == 0
    install(tmp_path, "ridge_of_mine", "gpebo.estimators", ridge_of_mine="RidgeOfMine")
    (tmp_path / "estimator" / "ridge_of_mine.yaml").unlink()
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    assert_refused(
        process("run", "estimator=ridge_of_mine", cwd=tmp_path, PYTHONPATH=path),
        "estimator ridge_of_mine is installed, and estimator/ridge_of_mine.yaml is missing",
        "gpebo new estimator ridge_of_mine",
    )


def test_every_key_is_explained():
    assert set(yaml.safe_load(files("plant", "a")["plant/a.yaml"])) == set(KEYS)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["plant", "tank"], "plant/tank.yaml exists already"),
        (["plant", "circuit"], "circuit comes with gpebo"),
        (["plant", "a b"], "'a b' cannot be a name"),
        (["plant", "../a"], "'../a' cannot be a name"),
        (["plant", "null"], "cannot be a name"),
        (["plant", "2tanks"], "cannot be a name"),
        (["plant"], "needs one name, as in gpebo new plant tank; got none"),
        (["plant", "a", "b"], "got 'a', 'b'"),
        (["plnt", "a"], "did you mean plant?"),
        ([], "known: plant, estimator, observer, recipe, recording, as in gpebo new plant tank"),
        (["plant", "a", "--confg-dir", "b"], "did you mean --config-dir?"),
        (["plant", "a", "--config-dir"], "--config-dir needs a folder"),
        (["estimator", "ls_drem"], "ls_drem comes with gpebo"),
        (["estimator", "a", "--from", "a.cir"], "gpebo new estimator has a template of its own"),
        (["plant", "a", "--plant", "b"], "other kinds have no --plant"),
        (["estimator", "a-b"], "a-b cannot be the name of a new Python module"),
        (["estimator", "random"], "random cannot be the name of a new Python module"),
        (["estimator", "numpy"], "no word of Python's and no module that is installed"),
        (["observer", "pytest"], "pytest cannot be the name of a new Python module"),
        (["observer", "gpebo_cli"], "gpebo_cli cannot be the name of a new Python module"),
    ],
)
def test_what_it_refuses(tmp_path, words, expected):
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "tank.yaml").write_text("mine")
    assert_refused(gpebo("new", *words, cwd=tmp_path), expected)
    assert [p.read_text() for p in tmp_path.rglob("*.yaml")] == ["mine"]


# Mistakes: a line of the template is changed, and the answer says where and what -----------------

MISTAKES = [
    ("A:", "a:", 2, "unknown key 'a'; did you mean A?"),
    ("[-k, -1]", "[-k, -1, 0]", 2, "A[0] has length 2, A[1] has length 3"),
    ("[-k, -1]", "[-kk, -1]", 2, "A[1][0] = '-kk': the name 'kk' is not defined; did you mean k?"),
    ("[-k, -1]", "[-k*T, -1]", 2, "T is a state and cannot be used here"),
    ("0.5*sin(t/2)", "0.5*sin(t/2", 2, "Cap = '2 + 0.5*sin(t/2': it is not an expression"),
    ("3 + 2*sin(t)", "3 + 2sin(t)", 2, "inputs.P = '3 + 2sin(t)'"),
    ("3 + 2*sin(t)", "3 + t^2", 2, "write ** for powers"),
    ("states: [T, q]", "states: [T, q, z]", 2, "has 2 entries but there are 3 states (T, q, z)"),
    ("unknowns:", "unknown:", 2, "did you mean unknowns?"),
    ("  - [1, 0.5]", "  - [1]", 2, "C has 1 column but there are 2 states"),
    ("  - [1, 0.5]", "  - [1, 0.5", 2, "tank.yaml, line"),
    ("initial_state: {T: 1, q: 0}", "initial_state: {T: 1}", 2, "initial_state lacks q"),
    ("{T: 0}", "{TT: 0}", 2, "there is no differential state 'TT'; the differential states are"),
    ("[-k, -1]", "[0, 0]", 1, "to do: every state needs an equation of its own"),
    ("  - [1, 0.5]", "  - [0, 1]", 0, "holds"),
    ("  - [1, 0.5]", "  - [0, 0]", 1, "weakest_direction +1 loss to do: the direction"),
    ("3 + 2*sin(t)", "3*step(t - 1)", 0, "everything that is needed holds"),
]


@pytest.mark.parametrize(("right", "wrong", "code", "expected"), MISTAKES)
def test_check_says_what_to_fix(tmp_path, right, wrong, code, expected):
    (tmp_path / "plant").mkdir()
    path = tmp_path / "plant" / "tank.yaml"
    text = files("plant", "tank")["plant/tank.yaml"]
    assert right in text
    path.write_text(text.replace(right, wrong, 1))
    done = gpebo("check", "--config-dir", ".", "plant=tank", cwd=tmp_path)
    said = " ".join((done.stdout + done.stderr).split())
    assert (done.returncode, expected in said) == (code, True), said
    assert done.stderr.count("\n") == (code == 2)


def test_a_refusal_that_says_what_to_do_gets_no_other_advice(tmp_path):
    (tmp_path / "plant").mkdir()
    text = files("plant", "tank")["plant/tank.yaml"].replace("[-k, -1]", "[-k, 3 - t]", 1)
    (tmp_path / "plant" / "tank.yaml").write_text(text)
    done = gpebo("check", "--config-dir", ".", "plant=tank", cwd=tmp_path)
    assert "choose a horizon that avoids this time" in " ".join(done.stdout.split())
    assert "to do" not in done.stdout
    assert done.returncode == 1


def test_every_advice_is_for_an_assumption_there_is():
    source = "".join(p.read_text() for p in (ROOT / "gpebo_cli").rglob("*.py") if p.stem != "check")
    for name in _ADVICE:
        number = name.removeprefix("Assumption ")
        assert f'"{name}"' in source or number in ("2", "5"), name
