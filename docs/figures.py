"""Regenerate the figures of the documentation: ``python docs/figures.py``."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gpebo_cli import load_plant
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import Trajectory, initial_mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers.canonical import (
    canonical_blocks,
    diagonalising_gain,
    unknown_input_matrices,
)
from gpebo_cli.results.files import make_folder
from gpebo_cli.results.style import Axis, Curve, Panel, compose, line, save
from gpebo_cli.settings import Settings, TimeSettings

IMAGES = Path(__file__).parent / "img"
HORIZON = 20.0
ELEMENTS = 200


def error_matrices(t: Array, inside: Array) -> tuple[Array, Array]:
    """M_w and the matrix that Assumption 7 prints, (N, 2, 2), with one gain that diagonalises M_w.

    The plant is the shipped canonical one, its second output is y_ℓ.
    """
    blocks = canonical_blocks(load_plant("canonical"), t, inside)
    c, dc, N = blocks.C[:, 1, 2:4], blocks.dC[:, 1, 2:4], blocks.N
    L = diagonalising_gain(c, dc, N)
    M_w, _, _ = unknown_input_matrices(c, dc, N, np.zeros((len(t), 3)), L)

    a1 = 1.0 / N[:, 1, 0]
    printed = np.empty_like(M_w)
    printed[:, 0, 0], printed[:, 0, 1] = L[:, 0] * c[:, 0], L[:, 0] * c[:, 1] - a1
    printed[:, 1, 0] = L[:, 1] * c[:, 0] + dc[:, 0] / c[:, 0]
    printed[:, 1, 1] = L[:, 1] * c[:, 1] + (dc[:, 1] + c[:, 0] * a1) / c[:, 1]
    return M_w, printed


def transition_norm(M: Trajectory, t: Array) -> Array:
    """‖Φ_w(t)‖₂ of φ̇ = M φ from the identity at the start, shape (N,)."""
    problem = LinearProblem(
        lambda t, inside: LinearEquation(None, M(t, inside), np.zeros((len(t), 2, 2))),
        np.eye(2), name="M_w",
    )
    solution = solve(problem, M.mesh, tol=1e-11, max_elements=10_000)
    return np.asarray(np.linalg.norm(solution.trajectory(t), 2, axis=(1, 2)))


def errata_assumption7(path: Path) -> None:
    """Draw the error of Proposition 4's observer: corrected, and with the printed matrix."""
    mesh = initial_mesh(0.0, HORIZON, [], ELEMENTS, radau_rule(9))
    t = np.linspace(0.0, HORIZON, 1001)
    shape = (*mesh.points.shape, 2, 2)
    norms = [
        transition_norm(Trajectory(mesh, M.reshape(shape)), t)
        for M in error_matrices(mesh.points.ravel(), mesh.inside.ravel())
    ]
    labels = ("corrected M_w", "as printed in Assumption 7")
    curves = tuple(
        Curve(t, norm, label, line(k))
        for k, (norm, label) in enumerate(zip(norms, labels, strict=True))
    )
    save(compose([Panel("‖Φ_w(t)‖", curves, log=True, legend=True)]), path)


def sampled_orders(path: Path) -> None:
    """Draw how far the circuit's observer at samples is from the one in continuous time."""
    plant = load_plant("circuit")
    time = TimeSettings(0.0, HORIZON, 20_001)

    def estimates(observer: dict[str, object]) -> tuple[Array, Array]:
        settings = Settings({"name": "ls_drem", "gamma": 10}, time=time, observer=observer)
        estimation = run_experiment(settings, plant).estimation
        assert estimation is not None  # noqa: S101  an observer was asked for
        return estimation.t, estimation.states[0]

    t, continuous = estimates({"name": "gpebo"})
    steps = np.array([0.2, 0.1, 0.05, 0.02, 0.01, 0.005])
    curves = []
    for k, hold in enumerate(("zoh", "linear")):
        errors = []
        for step in steps:
            at, sampled = estimates({"name": "gpebo", "sample_time": float(step), "hold": hold})
            same = np.searchsorted(t, at - 1e-9)
            errors.append(np.abs(sampled - continuous[same]).max())
        curves.append(Curve(steps, np.array(errors), hold, replace(line(k), dots=True)))
    axis = Axis("sample_time", "sample time (s)", log=True)
    panel = Panel("largest difference of x̂", tuple(curves), log=True, axis=axis, legend=True)
    save(compose([panel]), path)


def unbounded(path: Path) -> None:
    """Draw the relative error of the state on the plant of docs/howto/unstable.md, by remedy."""
    system = load_plant(Path(__file__).parent / "examples" / "plant" / "unbounded.yaml")
    curves = []
    for k, remedy in enumerate(("none", "output_injection", "reset", "current_coordinates")):
        result = run_experiment(
            Settings(
                estimator={"name": "least_squares", "f0": 1e-8},
                time=TimeSettings(horizon=40.0),
                observer={"name": "gpebo", "form": "given", "remedy": remedy},
            ),
            system,
        )
        states, estimation = result.simulation.states, result.estimation
        error = np.abs(estimation.states[0] - states).max(axis=1) / np.abs(states).max(axis=1)
        curves.append(Curve(estimation.t, error, remedy, line(k)))
    save(compose([Panel("relative error of x", tuple(curves), log=True, legend=True)]), path)


def leakage(images: Path) -> None:
    """Copy the figures of the run of docs/howto/leakage.md, whose blocks are run one by one."""
    page = (Path(__file__).parent / "howto" / "leakage.md").read_text("utf-8")
    runners = {"sh": ["bash", "-e", "-c"], "python": [sys.executable, "-c"]}
    with TemporaryDirectory() as folder:
        for language, block in re.findall(r"(?ms)^```(sh|python)\n(.*?)^```", page):
            subprocess.run([*runners[language], block], cwd=folder, check=True)  # noqa: S603
        for name in ("fit", "parameters"):
            figure = Path(folder, "found", "figures", f"{name}.png")
            shutil.copy(figure, images / f"leakage_{name}.png")


if __name__ == "__main__":
    make_folder(IMAGES)
    leakage(IMAGES)
    unbounded(IMAGES / "unbounded.png")
    errata_assumption7(IMAGES / "errata_assumption7.png")
    sampled_orders(IMAGES / "sampled.png")
