"""Tables and figure of ``docs/howto/kalman.md``: ``python docs/kalman.py``.

GPEBO against the Kalman-Bucy filter, with and without noise, with uniform observability and
without it. Errors are those of the differential states over the last quarter of the horizon, root
mean square over time, states and seeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pages import put, table

from gpebo_cli import load_plant
from gpebo_cli.configs.files import shipped
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.results.style import Curve, Panel, compose, line, save
from gpebo_cli.settings import NoiseSettings, Settings

DOCS = Path(__file__).parent
PAGE = DOCS / "howto" / "kalman.md"
SEEDS = 20
SAMPLE_TIME = 0.1


@dataclass(frozen=True)
class Method:
    """A column of the table."""

    label: str
    observer: dict[str, Any]
    estimator: dict[str, Any]


def methods(process: float) -> tuple[Method, ...]:
    """GPEBO with two estimators, the filter without and with noise that drives what it estimates.

    Least squares starts from the variance the filter starts from, α = 1/V apart; the filter with
    V as the only noise is then the same estimate in other coordinates.
    """
    kalman = {"name": "kalman_bucy"}
    driven = {"name": "kalman_bucy", "process": process}
    return (
        Method("gpebo, least_squares", {"name": "gpebo"}, {"name": "least_squares", "f0": 1e-6}),
        Method("gpebo, ls_drem", {"name": "gpebo"}, {"name": "ls_drem", "gamma": 10}),
        Method("kalman_bucy", kalman, {"name": "drem"}),
        Method(f"kalman_bucy, process {process:g}", driven, {"name": "drem"}),
    )


def run(system: DescriptorSystem, method: Method, level: float, seed: int) -> RunResult:
    """One run; ``level`` is the standard deviation of the outputs' noise."""
    noise = NoiseSettings(sample_time=SAMPLE_TIME, outputs=level, seed=seed)
    return run_experiment(
        Settings(estimator=method.estimator, observer=method.observer, noise=noise),
        system,
    )


def errors(result: RunResult) -> tuple[Array, Array]:
    """Errors (M, states) of the differential states, and the deviations stated, NaN if none."""
    system, estimation = result.system, result.estimation
    if estimation is None:
        raise ValueError("a run without an observer has no errors")
    E = system.coefficients.taylor(np.zeros(1), 0).E[0, 0]
    chosen = np.flatnonzero(np.abs(E).max(axis=0) > 0)
    error = estimation.states[0][:, chosen] - result.simulation.states[:, chosen]
    stated = estimation.states_std
    return error, np.full(error.shape, np.nan) if stated is None else stated[0][:, chosen]


def compared(rows: list[tuple[str, DescriptorSystem, float]]) -> str:
    """Markdown: a row per plant and level of noise, RMS errors per method."""
    head: list[str] = []
    lines = []
    for label, system, process in rows:
        for level in (0.0, 0.05):
            cells = [label, f"{level:g}"]
            stated = np.nan
            for method in methods(process):
                results = [run(system, method, level, s) for s in range(SEEDS if level else 1)]
                pairs = [errors(result) for result in results]
                last = results[0].simulation.t >= 15.0
                squares = [np.mean(error[last] ** 2) for error, _ in pairs]
                cells.append(f"{np.sqrt(np.mean(squares)):.2g}")
                if method.label == "kalman_bucy":
                    requirement = results[0].estimation.requirement  # type: ignore[union-attr]
                    observable = "yes" if requirement.holds else "no"
                    stated = float(np.sqrt(np.mean([np.mean(s[last] ** 2) for _, s in pairs])))
            cells += [f"{stated:.2g}", observable]
            lines.append(cells)
            print(cells, flush=True)  # noqa: T201  progress
        head = ["plant", "σ of y", *(m.label.partition(", process")[0] for m in methods(process))]
        head[-1] += ", driven"
    head += ["stated σ of kalman_bucy", "uniformly observable"]
    return table(head, lines, ["---"] + ["---:"] * (len(head) - 2) + ["---"])


def over_time() -> str:
    """Markdown: what the table's last quarter hides, errors of e1 and stated deviations."""
    level, spans = 0.05, ((2.0, 5.0), (15.0, 20.0))
    head = ["plant", "", *(f"{a:g} to {b:g} s" for a, b in spans)]
    lines = []
    circuit = load_plant("circuit")
    for method in (methods(1e-4)[0], methods(1e-4)[2]):
        results = [run(circuit, method, level, seed) for seed in range(SEEDS)]
        t = results[0].simulation.t
        e1 = np.array([errors(result)[0][:, 0] for result in results])
        lines.append(["circuit", f"error of e1, {method.label}"])
        lines[-1] += [f"{_rms(e1[:, (t >= a) & (t <= b)]):.2g}" for a, b in spans]
    window = load_plant("window")
    result = run(window, methods(1e-3)[3], level, 0)
    stated, t = errors(result)[1], result.simulation.t
    for name, column in zip(window.states, stated.T, strict=True):
        lines.append(["window", f"stated σ of {name}, {methods(1e-3)[3].label}"])
        lines[-1] += [f"{_rms(column[(t >= a) & (t <= b)]):.2g}" for a, b in spans]
    return table(head, lines, ["---", "---", "---:", "---:"])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def picture(path: Path) -> None:
    """Errors on the oscillator that is seen for three seconds, without and with noise."""
    system = load_plant("window")
    panels = []
    for level in (0.0, 0.05):
        curves = []
        for k, method in enumerate(methods(1e-3)):
            result = run(system, method, level, 1)
            error, _ = errors(result)
            label = method.label.replace(" 0.001", " 10⁻³")
            curves.append(
                Curve(result.simulation.t, np.linalg.norm(error, axis=1), label, line(k))
            )
        name = f"error, σ = {level:g}" if level else "error, no noise"
        panels.append(Panel(name, tuple(curves), log=True, size=1.4, legend=not panels))
    save(compose(panels), path)


def main() -> None:
    """Write the picture, and the tables into the page."""
    picture(DOCS / "img" / "kalman.png")
    growing = load_plant({**shipped("plant/window"), "A": [[0, 1], [-1, 0.3]]})
    put(PAGE, "table", compared([
        ("circuit", load_plant("circuit"), 1e-4),
        ("descriptor", load_plant("descriptor"), 1e-4),
        ("window", load_plant("window"), 1e-3),
        ("window, growing", growing, 1e-3),
    ]))
    put(PAGE, "over time", over_time())


if __name__ == "__main__":
    main()
