"""Plants used by several tests, and the published problems as plants."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.problems import Problem
from gpebo_cli.configs import files
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers import Measurements, observe
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

DATA = Path(__file__).parent / "data"
CONF = Path(__file__).parent.parent / "conf"
DECAYING = """\
name: mine
states: [x]
outputs: [y]
E: [[1]]
A: [[-1]]
C: [[1]]
initial_state: {x: 1}
"""
BOOST = {
    "name": "boost", "states": ["i", "v"], "inputs": {"duty": "0.5 + 0.1*sin(3*t)"},
    "unknowns": {"power": 8}, "outputs": ["y"], "E": [[0.5, 0], [0, 0.2]],
    "A": [[-0.1, "-(1-duty)"], ["1-duty", -0.05]], "F": [[0], ["-1/y"]], "phi": [10, 0],
    "B": [[0], [0]], "C": [[0, 1]], "initial_state": [3, 18],
}
LORENZ = {
    "name": "lorenz", "states": ["x1", "x2", "x3"], "unknowns": {"rho": 28}, "outputs": ["y"],
    "E": np.eye(3).tolist(), "A": [[-10, 10, 0], [0, -1, "-y"], [0, "y", "-8/3"]],
    "F": [[0], ["y"], [0]], "C": [[1, 0, 0]], "initial_state": [1, 1, 20],
}


def shipped(name: str, **changes: Any) -> DescriptorSystem:
    """A plant from ``conf/plant``, with some of its keys replaced."""
    return plant_from_mapping({**files.shipped(f"plant/{name}"), **changes}, f"{name}.yaml")


def one_state(**entries: Any) -> dict[str, Any]:
    """x' = 0 with y = x from 1, and what else is said of it."""
    return {
        "name": "p", "states": ["x"], "outputs": ["y"], "E": [[1]], "A": [[0]], "C": [[1]],
        "initial_state": [1], **entries,
    }  # fmt: skip


def reference(name: str) -> dict[str, Any]:
    """Reference values computed by another method and another code."""
    return json.loads((DATA / "reference" / f"{name}.json").read_text(encoding="utf-8"))


def problem(path: Path) -> tuple[dict[str, Any], DescriptorSystem]:
    """A published problem: its description and the plant."""
    found = Problem(path.stem, json.loads(path.read_text(encoding="utf-8")))
    return found.data, plant_from_mapping(found.mapping, path.name)


def experiment(system, estimator, horizon=20.0, samples=1001, noise=None, **observer):
    """A run of an observer, of gpebo where no name is given."""
    return run_experiment(Settings(
        estimator=estimator, time=TimeSettings(0.0, horizon, samples),
        observer={"name": "gpebo", **observer}, noise=noise or NoiseSettings(),
    ), system)  # fmt: skip


def seen(signals):
    """What an observer gets to see of a simulation."""
    return Measurements(signals.inputs, signals.outputs)


def observed(system, horizon=20.0, solver=None, **settings):
    """The signals of a simulation, and what an observer makes of them."""
    solver = solver or SolverSettings()
    signals = simulate(system, TimeSettings(horizon=horizon), solver).signals
    return signals, observe(system, seen(signals), solver, **settings)


def left_of_identities(system, signals, observation, t):
    """max |Y − ψη| and max |x̂ − x| at times t (M,) with the true parameters."""
    eta = observation.truth(t, system.theta_at(t), signals.states)
    left = observation.regression.Y(t) - np.einsum(
        "mij,mj->mi", observation.regression.psi(t), eta
    )
    x = observation.state_map.at(t)(eta[None])[0]
    return np.abs(left).max(), np.abs(x - signals.states(t)).max()
