"""Regenerate the tables and the figures of ``docs/howto/noise.md``: ``python docs/noise.py``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pages import put, table

from gpebo_cli import load_plant
from gpebo_cli.configs.files import shipped
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.results.figures import describe
from gpebo_cli.results.files import make_folder
from gpebo_cli.results.style import Axis, Curve, Panel, compose, line, save
from gpebo_cli.settings import NoiseSettings, Settings, TimeSettings

HERE = Path(__file__).parent
PAGE = HERE / "howto" / "noise.md"
IMAGES = HERE / "img"

LEVELS = (1e-4, 1e-3, 1e-2, 1e-1)
SEEDS, SAMPLE_TIME = 200, 0.02

# The default gains, but those of drem and fct on the descriptor plant, where Δ is small.
ESTIMATORS: Mapping[str, Mapping[str, Mapping[str, object]]] = {
    "circuit": {
        "gradient": {"gamma": 10.0},
        "least_squares": {},
        "drem": {"gamma": 1e10},
        "ls_drem": {"gamma": 10.0},
        "fct": {"gamma": 1e10},
    },
    "descriptor": {
        "gradient": {"gamma": 10.0},
        "least_squares": {},
        "drem": {"gamma": 1e14},
        "ls_drem": {"gamma": 10.0},
        "fct": {"gamma": 1e14},
    },
}

# Noise in the matrices: an unknown, its plant, horizon, sample time, and levels of its noise.
MATRICES = (
    ("line", "generator", 5.0, 0.02, (0.01, 0.03, 0.1)),
    ("rho", "lorenz", 5.0, 0.02, (0.1, 0.3, 1.0)),
)


def plant(name: str, **changes: object) -> DescriptorSystem:
    """A shipped plant, with some of its keys replaced."""
    return load_plant({**shipped(f"plant/{name}"), **changes})


def run(system: DescriptorSystem, estimator: Mapping[str, object], level: float) -> RunResult:
    """One run; over all seeds where there is noise."""
    noise = NoiseSettings(
        name="gaussian", outputs=level, sample_time=SAMPLE_TIME, seeds=SEEDS if level else 1
    )
    settings = Settings(estimator=estimator, time=TimeSettings(samples=51), noise=noise)
    return run_experiment(settings, system)


def rms(result: RunResult, chosen: list[int]) -> float:
    """√E‖error‖² of the chosen parameters at the horizon."""
    if result.noise is not None:
        return float(np.linalg.norm(result.noise.rms[0, chosen]))
    estimation = result.estimation
    if estimation is None:
        raise RuntimeError("nothing was estimated")
    error = estimation.parameters[0, -1] - estimation.true_parameters[-1]
    return float(np.linalg.norm(error[chosen]))


def errors() -> dict[str, dict[str, Array]]:
    """RMS errors by plant and estimator, shape (1 + levels,): without noise first."""
    found: dict[str, dict[str, Array]] = {}
    for name, estimators in ESTIMATORS.items():
        system = plant(name)
        chosen = list(range(system.q)) if system.q else [0, 1, 2]
        found[name] = {
            label: np.array([
                rms(run(system, {"name": label, **gains}, level), chosen)
                for level in (0.0, *LEVELS)
            ])
            for label, gains in estimators.items()
        }
    return found


def levels_table(found: Mapping[str, Mapping[str, Array]]) -> str:
    """The table of every plant, in Markdown."""
    text = "\n"
    for name, rows in found.items():
        what = "e₀ (3 parameters)" if name == "circuit" else "θ (2 parameters)"
        lines = []
        for label, values in rows.items():
            gains = ", ".join(f"γ = {g:g}" for g in ESTIMATORS[name][label].values())
            title = f"{label}, {gains}" if gains else label
            lines.append([title, *(f"{v:.1e}" for v in values)])
        head = ["estimator", "0", *(f"{level:g}" for level in LEVELS)]
        text += (
            f"`plant={name}`: error of {what} at 20 s, by standard deviation σ of the output\n\n"
            f"{table(head, lines)}\n"
        )
    return text


def level_figure(found: Mapping[str, Mapping[str, Array]], path: Path) -> None:
    """RMS error over the noise level, a panel per plant."""
    x = np.array(LEVELS)
    axis = Axis("sigma", "standard deviation σ of the output", log=True)
    panels = [
        Panel(
            "error of e₀" if name == "circuit" else "error of θ",
            tuple(Curve(x, v[1:], label, line(k)) for k, (label, v) in enumerate(rows.items())),
            log=True, axis=axis, legend=number == 0,
        )
        for number, (name, rows) in enumerate(found.items())
    ]
    save(compose(panels), path)


def step_figure(path: Path) -> None:
    """The recipe theta_step: estimates of an unknown that steps; and with a reset at the step."""
    recipe = shipped("experiment/theta_step")
    settings = Settings(
        estimator={"name": "least_squares", **recipe["estimator"]},
        time=TimeSettings(horizon=float(recipe["time"]["horizon"])),
        noise=NoiseSettings(name="gaussian", outputs=0.01),
    )
    system = plant("descriptor", **recipe["plant"])
    [panels] = describe(run_experiment(settings, system), ["parameters"]).values()
    renewed = replace(
        settings, estimator={"name": "least_squares", "beta": 0.0},
        observer={"name": "gpebo", "remedy": "reset", "reset_times": [10.0], "reset_keep": 0.0},
    )
    [again] = describe(run_experiment(renewed, system), ["parameters"]).values()
    style = line(len(panels[0].curves) + 1)  # the next one looks like the truth
    both = [
        replace(panel, curves=(
            *panel.curves[:-1],
            replace(other.curves[0], label="reset at 10 s", style=style),
            panel.curves[-1],
        ))
        for panel, other in zip(panels, again, strict=True)
    ]
    save(compose(both), path)


def matrices_table() -> str:
    """Bias and deviation of least squares along measured signals and along a noise-free copy."""
    head = ["unknown", "σ", "σ over the signal"]
    head += ["bias", "deviation", "bias, `noise_free`", "deviation"]
    lines = []
    for unknown, name, horizon, sample_time, levels in MATRICES:
        system = plant(name)
        j = system.unknowns.index(unknown)
        for level in levels:
            cells = []
            for remedy in ("none", "noise_free"):
                result = run_experiment(Settings(
                    estimator={"name": "least_squares", "f0": 1e-12},
                    observer={"name": "gpebo", "remedy": remedy},
                    time=TimeSettings(horizon=horizon, samples=51),
                    noise=NoiseSettings("gaussian", sample_time, level, seeds=SEEDS),
                ), system)
                if result.noise is None or result.simulation is None:
                    raise RuntimeError("there is no noise")
                cells += [result.noise.bias[0, j], result.noise.deviation[0, j]]
            share = level / np.sqrt((result.simulation.outputs**2).mean())
            title = f"`{unknown}` = {system.theta[j]:g} of `{name}`"
            numbers = (f"{cell:.2g}" for cell in cells)
            lines.append([title, f"{level:g}", f"{100 * share:.1f} %", *numbers])
    return table(head, lines)


if __name__ == "__main__":
    make_folder(IMAGES)
    step_figure(IMAGES / "theta_step.png")
    results = errors()
    level_figure(results, IMAGES / "noise_levels.png")
    put(PAGE, "table", levels_table(results))
    put(PAGE, "matrices", f"\n{matrices_table()}\n")
