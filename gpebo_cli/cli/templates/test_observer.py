"""mine on a plant with a known answer, and its settings file."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from mine import Mine

from gpebo_cli import ConfigError, SolverSettings, TimeSettings, estimators, load_plant, simulate
from gpebo_cli.observers import Measurements

PLANT = {
    "name": "oscillator", "states": ["x1", "x2"], "inputs": {"u": "sin(2*t)"},
    "unknowns": {"load": 0.7}, "outputs": ["y"], "E": [[1, 0], [0, 1]],
    "A": [[0, 1], [-2, -0.3]], "B": [[0], [1]], "F": [[0], [1]], "C": [[1, 0]],
    "initial_state": {"x1": 1, "x2": -1},
}


def test_it_finds_the_unknown_and_the_start() -> None:
    """e₀ = ξ_a(0) − x(0), so with ξ_a(0) = 0 it is −x(0)."""
    system, solver = load_plant(PLANT), SolverSettings()
    signals = simulate(system, TimeSettings(), solver).signals
    seen = Measurements(signals.inputs, signals.outputs)
    observation = Mine().observe(system, seen, solver)
    t = np.linspace(0.0, 20.0, 21)
    estimator = estimators.build({"name": "ls_drem"})
    estimates = estimators.estimate(estimator, observation.regression, t)
    found = estimates.parameters(slice(None))[0, -1]
    np.testing.assert_allclose(found, [0.7, -1.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("other", [{"E": [[1, 0], [0, 2]]}, {"phi": ["t", 0]}, {"D": [[1]]}])
def test_other_plants_are_refused(other: dict[str, object]) -> None:
    system = load_plant({**PLANT, **other})
    signals = simulate(system, TimeSettings(), SolverSettings()).signals
    seen = Measurements(signals.inputs, signals.outputs)
    with pytest.raises(ConfigError, match="E = I"):
        Mine().observe(system, seen, SolverSettings())


def test_the_settings_file_says_what_the_class_says() -> None:
    file = Path(__file__).parent / "observer" / "mine.yaml"
    settings = yaml.safe_load(file.read_text("utf-8"))
    del settings["name"], settings["title"]
    assert settings == {field.name: field.default for field in fields(Mine)}
