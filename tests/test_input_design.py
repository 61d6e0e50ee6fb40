"""ψ depends on the input where matrices do: what is known follows from the experiment."""

from __future__ import annotations

import numpy as np
import pytest
from plants import shipped

from gpebo_cli.experiment.assumptions import designable, examine
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.settings import NoiseSettings, Settings, TimeSettings

CONSTANT, RIPPLE, CYCLE = "2.5", "2.5 + 0.1*sin(t/20)", "2.5 + 1.5*sin(t/20) + sin(t/7)"


@pytest.mark.parametrize(("name", "signals"), [
    ("battery", "current"), ("boost", "duty, y"), ("lorenz", "y"), ("motor", "yd, yq"),
    ("circuit", "time alone"), ("bioreactor", "dilution, s"),
])  # fmt: skip
def test_what_psi_depends_on_is_said(name, signals):
    assert designable(shipped(name)) == signals


def test_an_input_in_B_alone_cannot_be_designed():
    """ψ has no part of B, φ and D, whatever stands in them."""
    system = shipped("circuit", B=[[0], [0], [0], [0], [0], ["-1 + V"]])
    assert designable(system) == "time alone"


@pytest.mark.parametrize(("current", "holds"), [(CONSTANT, False), (CYCLE, True)])
def test_the_check_says_whether_the_input_excites(current, holds):
    settings = Settings(estimator={}, observer={"name": "gpebo"}, time=TimeSettings(horizon=600.0))
    examined = examine(settings, shipped("battery", inputs={"current": current}))
    found = {a.name: a for a in examined.assumptions}
    assert found["Assumption 2"].evidence["psi_depends_on"] == "current"
    assert found["Assumption 2"].holds is holds


def test_a_better_input_gives_a_better_estimate():
    """Against the seeds, and by the ratio of the current's variation: 0.1 to about 1.3 A."""
    found = {}
    for current in (RIPPLE, CYCLE):
        system = shipped("battery", inputs={"current": current})
        result = run_experiment(Settings(
            estimator={"name": "ls_drem"}, observer={"name": "gpebo"},
            time=TimeSettings(horizon=600.0, samples=11),
            noise=NoiseSettings("gaussian", sample_time=2.0, outputs=0.002, seeds=50),
        ), system)  # fmt: skip
        found[current] = result.noise.deviation[0, 1]
        np.testing.assert_allclose(
            result.estimation.parameters_std[0, -1, 1], found[current], rtol=0.4
        )
    assert 10 < found[RIPPLE] / found[CYCLE] < 25
