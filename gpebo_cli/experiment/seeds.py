"""Bias and variance of an estimator over many seeds of the noise.

Where ψ does not depend on the signals, Y and all estimators are affine in them. Then all seeds
share the simulation, the mesh, the observer's matrices, ψ and whatever an estimator makes of it
(Gram matrices, filters, mixing); a seed is one more right-hand side of the same linear systems.
Where it does (matrices along noisy signals, resets at estimates), and with bounds, every seed is
observed by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators import estimate
from gpebo_cli.experiment.bounds import bounded
from gpebo_cli.experiment.limits import Pace
from gpebo_cli.experiment.noise import (
    NoiseLevels,
    SampledMesh,
    between,
    draw_errors,
    measure,
    noise_grid,
    sampled_mesh,
)
from gpebo_cli.experiment.result import NoiseStatistics
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, IntArray
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers._base import Observation, Response
from gpebo_cli.regression.estimator import Estimator
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import NoiseSettings
from gpebo_cli.simulation.signals import Signals

_NUMBERS = 1 << 20  # in Y of one batch of seeds; estimators hold tens of times that
_MOST_SAMPLES = 2e6  # of all seeds: some twenty seconds


def check_seeds(levels: NoiseLevels, horizon: float) -> None:
    """Refuse many seeds of nothing, and more samples than can be computed soon (ConfigError)."""
    settings = levels.settings
    if settings.seeds > 1 and levels.silent:
        raise ConfigError(f"noise.seeds = {settings.seeds}, but there is no noise; set its levels")
    samples = settings.seeds * horizon / settings.sample_time
    if settings.seeds > 1 and samples > _MOST_SAMPLES:
        raise ConfigError(
            f"noise.seeds = {settings.seeds}: with noise.sample_time = {settings.sample_time:g} s "
            f"they have {samples:.3g} samples; at most {_MOST_SAMPLES:.3g} are computed"
        )


def refuse_seeds(settings: NoiseSettings) -> None:
    """Refuse many seeds where there is no observer in continuous time (ConfigError)."""
    if settings.seeds > 1:
        raise ConfigError(
            f"noise.seeds = {settings.seeds} needs an observer in continuous time; otherwise run "
            "one job per seed: -m noise.seed=0,1,2"
        )


def over_seeds(
    observation: Observation, observe: Callable[[Signals], Observation], signals: Signals,
    theta: Callable[[Array], Array], estimator: Estimator, levels: NoiseLevels, pace: Pace,
    columns: IntArray, told: BoolArray, system: DescriptorSystem,
) -> NoiseStatistics:
    """Statistics at the horizon over the seeds ``seed``, ``seed + 1``, … of all cases.

    The observation is of the noisy signals of ``seed``, ``observe`` makes others, ``signals`` are
    the true ones, and ``theta`` is what the unknowns really are at times (M,), (M, q). As in the
    run, of parameters that others can stand for those of some ``columns`` are estimated, and of
    those that are not ``told`` (p,) nothing is.
    """
    horizon = observation.regression.mesh.edges[-1:]
    settings = levels.settings
    seeds = range(settings.seed, settings.seed + settings.seeds)
    done = pace(len(seeds), f"noise.seeds with {len(estimator.cases)} cases")

    def observed() -> Iterator[Observation]:
        if observation.respond is not None and not observation.bounds:
            for many in _added(observation, observation.respond, signals, levels):
                yield replace(observation, regression=many)
            return
        for seed in seeds:
            yield replace(observe(measure(signals, levels, seed)), bounds=observation.bounds)

    found = list[Array]()
    for own in observed():
        each = _at(horizon, own, estimator, columns, system)
        truth = _truth(own, theta, signals)
        found.append(_with_unknowns(each, own.regression, horizon) - truth[:, None])
        done(sum(part.shape[-1] for part in found))
    error, S = np.concatenate(found, axis=-1), observation.regression.parametrisation
    error[:, : len(told)][:, ~told] = np.nan
    return NoiseStatistics(
        seeds=settings.seeds,
        t=float(horizon[0]),
        names=(*observation.parameters, *(() if S is None else S.names)),
        truth=_truth(observation, theta, signals),
        bias=error.mean(axis=-1),
        deviation=error.std(axis=-1, ddof=1),
        rms=np.sqrt(np.mean(error**2, axis=-1)),
    )


def _at(
    horizon: Array, own: Observation, estimator: Estimator, columns: IntArray,
    system: DescriptorSystem,
) -> Array:
    """η̂ (g, p, c) at the horizon, of several seeds at once or of one."""
    by = own.estimator or estimator
    made = by.estimate if own.regression.realisations else partial(estimate, by)
    found, some = own.about(columns, lambda about, _: made(about, horizon))
    held = bounded(own.bounds, system, own, some, found, horizon) if own.bounds else found
    values = held.parameters(slice(None))[:, 0]
    values = values if values.ndim == 3 else values[..., None]
    eta = np.zeros((len(values), len(own.parameters), values.shape[2]))
    eta[:, some] = values
    return eta


def _with_unknowns(eta: Array, regression: LinearRegression, horizon: Array) -> Array:
    """η̂ (g, p, c) at the horizon, and the θ̂ that fit it where η = S(θ), (g, p + q, c)."""
    S = regression.parametrisation
    if S is None:
        return eta
    each = np.moveaxis(eta, 1, 2)
    weight = regression.gram_at(horizon)[..., : eta.shape[1]]
    flat = each.reshape(-1, eta.shape[1])
    theta = S.fitted(flat, np.repeat(weight, len(flat), axis=0))
    whole = np.concatenate([each, theta.reshape(*each.shape[:2], -1)], axis=2)
    return np.asarray(np.moveaxis(whole, 2, 1))


def _truth(
    observation: Observation, theta: Callable[[Array], Array], signals: Signals
) -> Array:
    """True η at the horizon, after all that θ did, and θ where η = S(θ), which is the states."""
    t = observation.regression.mesh.edges
    truth = np.asarray(observation.truth(t, theta(t), signals.states)[-1])
    if observation.regression.parametrisation is None:
        return truth
    return np.concatenate([truth, signals.states(t[-1:])[0]])


def _added(
    observation: Observation, respond: Response, signals: Signals, levels: NoiseLevels,
) -> Iterator[LinearRegression]:
    """The regression with the noise of many seeds at once, batch by batch."""
    regression, settings = observation.regression, levels.settings
    mesh = regression.mesh
    samples = noise_grid(signals.mesh, settings)
    outputs = samples.mesh.along(signals.outputs)
    grid = sampled_mesh(mesh, settings.sample_time)  # every instant is an edge of it already
    first = draw_errors(outputs, samples, levels, settings.seed)
    batch = max(1, _NUMBERS // regression.Y.values.size)
    for start in range(0, settings.seeds, batch):
        seeds = range(settings.seed + start, settings.seed + min(start + batch, settings.seeds))
        drawn = [draw_errors(outputs, samples, levels, seed) for seed in seeds]
        of_outputs, of_inputs = (
            _columns([e[kind] - first[kind] for e in drawn], grid, mesh, settings.shape)
            for kind in (0, 1)
        )
        added = respond(of_inputs, of_outputs)
        yield LinearRegression(
            Trajectory(mesh, regression.Y.values[..., None] + added),
            regression.psi, regression.parameters, regression.scale,
            parametrisation=regression.parametrisation,
        )


def _columns(errors: list[Array], grid: SampledMesh, mesh: Mesh, shape: str) -> Array:
    """e(t) at the points of the mesh, (K, s + 1, signals, c), from c arrays e_k (N, signals)."""
    samples = np.stack(errors, axis=-1)
    values = between(samples.reshape(len(samples), -1), grid, shape)
    points = (mesh.size, mesh.rule.stages + 1, *samples.shape[1:])
    return np.broadcast_to(values.reshape(*values.shape[:2], *samples.shape[1:]), points)
