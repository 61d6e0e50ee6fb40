"""Bias and variance of an estimator over many seeds of the noise, in one pass.

ψ does not depend on the signals, and Y and all estimators are affine in them. So all seeds share
the simulation, the mesh, the observer's matrices, ψ and whatever an estimator makes of it (Gram
matrices, filters, mixing); a seed is one more right-hand side of the same linear systems.
"""

from __future__ import annotations

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.noise import (
    NoiseLevels,
    SampledMesh,
    between,
    draw_errors,
    noise_grid,
    on_mesh,
    sampled_mesh,
)
from gpebo_cli.experiment.result import NoiseStatistics
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers._observation import Observation, Response
from gpebo_cli.regression.estimator import Estimator
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import NoiseSettings
from gpebo_cli.simulation.simulate import Signals

_NUMBERS = 1 << 20  # in Y of one batch of seeds; estimators hold tens of times that


def check_seeds(settings: NoiseSettings, levels: NoiseLevels) -> None:
    """Refuse many seeds of nothing.

    Raises:
        ConfigError: says what is needed.
    """
    if settings.seeds < 1:
        raise ConfigError(f"noise.seeds: expected 1 or more, got {settings.seeds}")
    if settings.seeds > 1 and levels.silent:
        raise ConfigError(f"noise.seeds = {settings.seeds}, but there is no noise; set its levels")


def check_response(settings: NoiseSettings, respond: Response | None) -> Response:
    """How the observer responds to noise; many seeds are refused where it cannot tell.

    Raises:
        ConfigError: says what is possible.
    """
    if settings.seeds > 1 and respond is None:
        raise ConfigError(
            f"noise.seeds = {settings.seeds} needs observer=gpebo in continuous time, with "
            "observer.remedy=none or output_injection; with others, run one job per seed: "
            "-m noise.seed=0,1,2"
        )
    return respond or _no_response


def _no_response(of_inputs: Array, of_outputs: Array) -> Array:  # noqa: ARG001  a response
    raise ValueError("nobody asked how this observer responds to noise")


def over_seeds(
    observation: Observation, signals: Signals, estimator: Estimator, truth: Array,
    settings: NoiseSettings, levels: NoiseLevels,
) -> NoiseStatistics:
    """Statistics at the horizon over the seeds ``seed``, ``seed + 1``, …

    Args:
        observation: made from the noisy signals of ``seed``.
        signals: the true ones.
        estimator: all of its cases are assessed.
        truth: of the parameters at the horizon, (p,).
        settings: of the noise.
        levels: of the noise.

    Raises:
        ConfigError: the observer cannot tell how it responds to noise.
        SolverError: a tolerance cannot be reached.
    """
    respond = check_response(settings, observation.respond)
    regression = observation.regression
    mesh = regression.mesh
    samples = noise_grid(signals.mesh, settings)
    outputs = on_mesh(signals.outputs, samples.mesh)
    grid = sampled_mesh(mesh, settings.sample_time)  # every instant is an edge of it already
    horizon = mesh.edges[-1:]
    first = draw_errors(outputs, samples, levels, settings.seed)
    batch = max(1, _NUMBERS // regression.Y.values.size)
    errors = []
    for start in range(0, settings.seeds, batch):
        seeds = range(settings.seed + start, settings.seed + min(start + batch, settings.seeds))
        drawn = [draw_errors(outputs, samples, levels, seed) for seed in seeds]
        of_outputs, of_inputs = (
            _columns([e[kind] - first[kind] for e in drawn], grid, mesh, settings.shape)
            for kind in (0, 1)
        )
        added = respond(of_inputs, of_outputs)
        many = LinearRegression(
            Trajectory(mesh, regression.Y.values[..., None] + added),
            regression.psi, regression.parameters, regression.scale,
        )
        final = estimator.estimate(many, horizon).parameters(slice(None))[:, 0]  # (G, p, c)
        errors.append(final - truth[:, None])
    error = np.concatenate(errors, axis=-1)
    return NoiseStatistics(
        seeds=settings.seeds,
        t=float(horizon[0]),
        names=regression.parameters,
        truth=truth,
        bias=error.mean(axis=-1),
        deviation=error.std(axis=-1, ddof=1),
        rms=np.sqrt(np.mean(error**2, axis=-1)),
    )


def _columns(errors: list[Array], grid: SampledMesh, mesh: Mesh, shape: str) -> Array:
    """e(t) at the points of the mesh, (K, s + 1, signals, c), from c arrays e_k (N, signals)."""
    samples = np.stack(errors, axis=-1)
    values = between(samples.reshape(len(samples), -1), grid, shape)
    points = (mesh.size, mesh.rule.stages + 1, *samples.shape[1:])
    return np.broadcast_to(values.reshape(*values.shape[:2], *samples.shape[1:]), points)
