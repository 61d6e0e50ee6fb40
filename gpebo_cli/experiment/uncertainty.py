"""One standard deviation of every estimate, from the noise of the signals."""

from __future__ import annotations

import numpy as np

from gpebo_cli.evidence.uncertainty import SampledDeviations, deviations, noise_level
from gpebo_cli.experiment.noise import NoiseLevels, signal_noise
from gpebo_cli.experiment.sources import Source
from gpebo_cli.model.descriptor import Array
from gpebo_cli.observers._observation import Differentiable, Observation
from gpebo_cli.regression.estimator import Affine, Estimator
from gpebo_cli.settings import NoiseSettings

MOST_CASES = 32  # each takes a pass of its own; more are a study of gains, not of a measurement


def sampled_deviations(
    noise: NoiseSettings, levels: NoiseLevels, source: Source | None
) -> SampledDeviations | None:
    """Of an observer at samples; None: there is no noise.

    Args:
        noise: its settings.
        levels: its levels; zeros mean unknown but for a simulation.
        source: of the signals; None: a stream, each of whose rows has errors of its own.
    """
    recorded = source is None or source.recording is not None
    if levels.silent and not recorded:
        return None
    variances = _variances(noise, levels)
    if source is None:
        return SampledDeviations(variances, None, relative=levels.silent)
    edges = source.inputs.mesh.edges
    instants = edges[:-1] if recorded else np.arange(edges[0], edges[-1], noise.sample_time)
    near = 1e-6 * float(np.diff(instants).min(initial=np.inf))

    def number(t: Array) -> Array:
        return np.searchsorted(instants, t + near, side="right").astype(np.float64)

    return SampledDeviations(variances, number, relative=levels.silent)


def residual_ratio(
    observation: Observation, source: Source, noise: NoiseSettings, levels: NoiseLevels
) -> float | None:
    """√(χ² per degree of freedom) of a recording's residual, for levels that are given.

    One where the sensors' noise is all that the estimates leave; None: nobody can tell.
    """
    if observation.errors is None or levels.silent or source.recording is None:
        return None
    if observation.regression.resets or observation.regression.dynamics is not None:
        return None
    return noise_level(
        observation.errors, observation.regression, source.inputs.mesh.edges[:-1],
        _variances(noise, levels), observation.starts,
    )


def _variances(noise: NoiseSettings, levels: NoiseLevels) -> Array:
    """Of [u; y], (m + r,); of a recording without levels relative to that of all outputs."""
    if levels.silent:
        return np.concatenate([np.zeros(len(levels.inputs)), np.ones(len(levels.outputs))])
    return signal_noise(noise, levels).variances


def standard_deviations(
    observation: Observation, estimator: Estimator, source: Source, noise: NoiseSettings,
    levels: NoiseLevels, t: Array, states: Array,
) -> tuple[Array, Array] | None:
    """Of parameters (G, M, p) and ``states`` (G, M, n) at the times t (M,).

    None where they are not known: an observer that cannot tell how it responds to noise, an
    estimator that is not ``Affine``, more than 32 cases, a simulation without noise, and where
    there is nothing to estimate. Rounding to
    steps q counts as noise of variance q²/12. Of a recording without levels, the one level that
    all outputs share is that of the residual.
    """
    state_map, errors = observation.state_map, observation.errors
    if levels.silent and not source.recording:
        return None
    if errors is None or not isinstance(state_map, Differentiable) or not observation.regression.p:
        return None
    if not isinstance(estimator, Affine) or len(estimator.cases) > MOST_CASES:
        return None
    regression = observation.regression
    edges = regression.mesh.edges
    instants = (
        source.inputs.mesh.edges[:-1] if source.recording
        else np.arange(edges[0], edges[-1], noise.sample_time)
    )
    variances = _variances(noise, levels)
    if levels.silent:
        variances *= noise_level(
            errors, regression, instants, variances, observation.starts
        ) ** 2
    found = [
        deviations(errors, of_case, gain, edges, instants, variances, t, observation.starts)
        for of_case, gain in zip(
            estimator.errors(regression), state_map.gains(t, states), strict=True
        )
    ]
    return np.array([eta for eta, _ in found]), np.array([x for _, x in found])
