"""Regenerate the tables of ``docs/howto/uncertainty.md``: ``python docs/uncertainty.py``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pages import put, table

from gpebo_cli import estimators, load_plant
from gpebo_cli.experiment import sources
from gpebo_cli.experiment.noise import (
    draw_errors,
    noise_grid,
    noise_levels,
    sampled_mesh,
)
from gpebo_cli.experiment.seeds import _columns
from gpebo_cli.experiment.uncertainty import standard_deviations
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Measurements, build
from gpebo_cli.regression.errors import respond
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings, TimeSettings

PAGE = Path(__file__).parent / "howto" / "uncertainty.md"

SEEDS, BATCH = 2000, 100
LEVEL, SAMPLE_TIME = 0.05, 0.1
PLANTS = ("circuit", "descriptor", "strangeness_free", "battery")
ESTIMATORS: tuple[Mapping[str, object], ...] = (
    {"name": "least_squares"}, {"name": "least_squares", "beta": 0.3}, {"name": "ls_drem"},
    {"name": "drem", "gamma": 1e14}, {"name": "fct", "gamma": 1e14}, {"name": "gradient"},
)
TIMES = np.linspace(2.0, 20.0, 10)


class Errors(NamedTuple):
    """Errors over the seeds at some times, and the deviations that were predicted."""

    names: tuple[str, ...]
    errors: Array  # (M, p + n, seeds)
    predicted: Array  # (M, p + n)


def errors_over_seeds(
    system: DescriptorSystem, chosen: tuple[Mapping[str, object], ...], seeds: int = SEEDS,
    t: Array = TIMES, observer: Mapping[str, object] | None = None,
) -> Iterator[Errors]:
    """Of each estimator: what the noise of every seed adds to its estimates, and its deviation.

    All errors of the estimates are affine in the signals': one response serves all estimators.
    """
    noise = NoiseSettings(name="gaussian", outputs=LEVEL, sample_time=SAMPLE_TIME)
    settings = Settings(estimator={}, noise=noise, time=TimeSettings(horizon=20.0))
    levels = noise_levels(noise, system)
    source = sources.simulated(settings, system, levels, None)
    made = build(observer or {"name": "gpebo"})
    if made is None:
        raise ValueError("there has to be an observer")
    observation = made.observe(
        system, Measurements(source.inputs, source.outputs), SolverSettings()
    )
    regression, mesh = observation.regression, observation.regression.mesh
    if source.true is None or observation.errors is None:
        raise ValueError("the observer cannot tell how it responds to noise")
    samples = noise_grid(source.true.mesh, noise)
    outputs = samples.mesh.along(source.true.outputs)
    grid = sampled_mesh(mesh, SAMPLE_TIME)
    rows, n = regression.psi.values.shape[2], system.n
    gain = observation.state_map.gain(t)  # type: ignore[attr-defined]
    built = [estimators.build(each) for each in chosen]
    found: list[list[Array]] = [[] for _ in built]
    for first in range(0, seeds, BATCH):
        drawn = [
            draw_errors(outputs, samples, levels, seed)
            for seed in range(first, min(first + BATCH, seeds))
        ]
        e_y, e_u = (
            _columns([each[kind] for each in drawn], grid, mesh, noise.shape) for kind in (0, 1)
        )
        added = respond(mesh, observation.errors, rows + n, e_u, e_y)
        offset = Trajectory(mesh, added[:, :, rows:])(t)
        only_noise = LinearRegression(
            Trajectory(mesh, added[:, :, :rows]), regression.psi, regression.parameters,
            regression.scale,
        )
        for own, estimator in zip(found, built, strict=True):
            eta = estimator.estimate(only_noise, t).parameters(slice(0, 1))[0]
            own.append(np.concatenate([eta, offset + gain @ eta], axis=1))
    for own, estimator in zip(found, built, strict=True):
        deviations = standard_deviations(
            observation, estimator, source, t, source.states(t)[None], system
        )
        if isinstance(deviations, str):
            raise TypeError(f"{estimator} has no deviations: {deviations}")
        predicted = np.concatenate([each[0] for each in deviations], axis=1)
        names = (*regression.parameters, *system.states)
        yield Errors(names, np.concatenate(own, axis=2), predicted)


def coverage() -> str:
    """Coverage of ±1.96 σ and the ratio of deviations, over all times, parameters and states."""
    head = ["plant", "estimator", "95 % intervals cover", f"predicted over found, {SEEDS} seeds"]
    lines = []
    for name in PLANTS:
        for settings, found in zip(
            ESTIMATORS, errors_over_seeds(load_plant(name), ESTIMATORS), strict=True
        ):
            known = found.predicted > 1e-9
            within = np.abs(found.errors) <= 1.96 * found.predicted[..., None]
            share = 100.0 * within.mean(axis=2)[known]
            ratio = found.predicted[known] / found.errors.std(axis=2, ddof=1)[known]
            own = ", ".join(f"{k}={v:g}" for k, v in settings.items() if not isinstance(v, str))
            label = f"{settings['name']}" + (f" ({own})" if own else "")
            covered = f"{share.min():.1f} … {share.max():.1f} %"
            lines.append([name, label, covered, f"{ratio.min():.3f} … {ratio.max():.3f}"])
    return table(head, lines)


if __name__ == "__main__":
    put(PAGE, "table", coverage())
