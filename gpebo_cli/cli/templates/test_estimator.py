"""mine against a closed form, its settings file, and a plant."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import yaml
from mine import Mine

from gpebo_cli import run
from gpebo_cli.estimators import LinearRegression


def test_one_constant_parameter() -> None:
    """ψ = 1 and Y = 2: η̂ = 2t/(f₀ + t)."""
    regression = LinearRegression.from_functions(
        psi=lambda t: np.ones((*t.shape, 1, 1)), Y=lambda t: np.full((*t.shape, 1), 2.0),
        parameters=["a"], horizon=10.0,
    )
    t = np.linspace(0.0, 10.0, 21)
    estimator = Mine(f0=[0.1, 1.0])
    estimates = estimator.estimate(regression, t)
    for case, eta in zip(estimator.cases, estimates.parameters(slice(None)), strict=True):
        np.testing.assert_allclose(eta[:, 0], 2.0 * t / (case["f0"] + t), rtol=1e-12)
    assert not estimates.requirement.holds  # λ_min(G)/f₀ is 10 at the end


def test_the_settings_file_says_what_the_class_says() -> None:
    file = Path(__file__).parent / "estimator" / "mine.yaml"
    settings = yaml.safe_load(file.read_text("utf-8"))
    del settings["name"], settings["title"]
    assert {key: float(value) for key, value in settings.items()} == {
        field.name: field.default for field in fields(Mine)
    }


def test_it_finds_the_unknowns_of_a_plant() -> None:
    result = run("descriptor", estimator=Mine())
    truth = result.config["plant"]["unknowns"]
    for name, value in truth.items():
        np.testing.assert_allclose(result.estimates[name][0, -1], value, rtol=1e-5)
