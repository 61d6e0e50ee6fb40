"""`regression=NAME`: the same commands and files as for a plant, without states."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import yaml
from examples import gpebo

from gpebo_cli import ConfigError, run

SINE = {"name": "sine", "unknowns": {"a": 2.0, "b": -1.0}, "signals": {"s": "sin(t)"}}


def write(folder, mapping):
    (folder / "regression").mkdir(exist_ok=True)
    (folder / "regression" / f"{mapping['name']}.yaml").write_text(yaml.safe_dump(mapping))


def test_a_run_leaves_the_same_files_and_can_be_repeated(tmp_path):
    done = gpebo("run", "regression=filtered", "estimator=ls_drem", "hydra.run.dir=a", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("error")) == (0, 0)
    assert "interval-exciting" in done.stdout
    names = {path.name for path in (tmp_path / "a").iterdir()}
    assert {"signals.csv", "regression.csv", "estimates.csv", "cases.csv"} <= names
    last = list(csv.DictReader((tmp_path / "a" / "estimates.csv").read_text().splitlines()))[-1]
    assert float(last["a_hat"]) == pytest.approx(2.0, abs=1e-9)
    assert float(last["b_hat"]) == pytest.approx(1.5, abs=1e-9)
    again = ("--config-dir", "a", "--config-name", "config", "hydra.run.dir=b")
    assert gpebo("run", *again, cwd=tmp_path).returncode == 0
    tables = [(tmp_path / folder / "estimates.csv").read_bytes() for folder in "ab"]
    assert tables[0] == tables[1]
    assert gpebo("check", "regression=filtered", cwd=tmp_path).returncode == 0


def test_it_stands_in_place_of_a_plant_and_an_observer(tmp_path):
    for word in ("plant=circuit", "observer=gpebo"):
        done = gpebo("run", "regression=filtered", word, cwd=tmp_path)
        assert done.returncode == 2
        assert f"{word}: regression=NAME stands in place of" in done.stderr
    done = gpebo("run", "observer=regression", cwd=tmp_path)
    assert done.returncode != 0
    assert "observer=regression goes with regression=NAME" in done.stderr


def test_signals_from_a_recording(tmp_path):
    t = np.linspace(0.0, 10.0, 2001)
    write(tmp_path, {**SINE, "signals": {"s": None, "y": None}, "Y": ["y"], "psi": [["s", 1]]})
    rows = np.column_stack([t, np.sin(t), 2 * np.sin(t) - 1])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="t,s,y", comments="", fmt="%.17g")
    done = gpebo("run", "--config-dir", ".", "regression=sine", "data.file=r.csv", "figures=none",
                 "estimator=ls_drem", "hydra.run.dir=a", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    last = list(csv.DictReader((tmp_path / "a" / "estimates.csv").read_text().splitlines()))[-1]
    assert float(last["a_hat"]) == pytest.approx(2.0, abs=1e-9)


def test_noise_of_y_is_that_of_an_output():
    mapping = {**SINE, "psi": [["s", 1]]}
    noise = {"name": "gaussian", "outputs": 0.1, "sample_time": 0.05}
    quiet, noisy = (
        run(regression=mapping, estimator="least_squares", time={"horizon": 10}, noise=noise_)
        for noise_ in (None, noise)
    )
    assert quiet.estimates["a"][0, -1] == pytest.approx(2.0, abs=1e-3)
    assert 1e-4 < abs(noisy.estimates["a"][0, -1] - 2.0) < 0.2


def test_mistakes_name_the_file(tmp_path):
    write(tmp_path, {**SINE, "psi": [["s", "lp(s)"]]})
    done = gpebo("run", "--config-dir", ".", "regression=sine", cwd=tmp_path)
    assert done.returncode == 2
    assert "sine" in done.stderr
    assert "psi[0][1]" in done.stderr
    assert "lp takes two arguments" in done.stderr
    with pytest.raises(ConfigError, match="stands in place of a plant"):
        run("circuit", regression=SINE)
