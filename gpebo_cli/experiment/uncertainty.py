"""One standard deviation of every estimate, from the noise of the signals."""

from __future__ import annotations

import numpy as np

from gpebo_cli.evidence.uncertainty import deviations, noise_level
from gpebo_cli.experiment.noise import NoiseLevels, signal_noise
from gpebo_cli.experiment.sources import Source
from gpebo_cli.model.descriptor import Array
from gpebo_cli.observers._observation import AffineStateMap, Observation
from gpebo_cli.regression.estimator import Affine, Estimator
from gpebo_cli.settings import NoiseSettings

_CASES = 32  # each takes a pass of its own; more are a study of gains, not of a measurement


def standard_deviations(
    observation: Observation, estimator: Estimator, source: Source, noise: NoiseSettings,
    levels: NoiseLevels, t: Array,
) -> tuple[Array, Array] | None:
    """Of parameters (G, M, p) and states (G, M, n) at the times t (M,).

    None where they are not known: an observer that cannot tell how it responds to noise, an
    estimator that is not ``Affine``, more than 32 cases, a simulation without noise. Rounding to
    steps q counts as noise of variance q²/12. Of a recording without levels, the one level that
    all outputs share is that of the residual.
    """
    state_map, errors = observation.state_map, observation.errors
    if errors is None or not isinstance(state_map, AffineStateMap):
        return None
    if not isinstance(estimator, Affine) or len(estimator.cases) > _CASES:
        return None
    regression = observation.regression
    edges = regression.mesh.edges
    instants = (
        source.inputs.mesh.edges[:-1] if source.recording
        else np.arange(edges[0], edges[-1], noise.sample_time)
    )
    variances = signal_noise(noise, levels).variances
    if levels.silent:
        if not source.recording:
            return None
        variances = np.concatenate([np.zeros(len(levels.inputs)), np.ones(len(levels.outputs))])
        variances *= noise_level(errors, regression, instants, variances) ** 2
    gain = state_map.gain(t)
    found = [
        deviations(errors, of_case, gain, edges, instants, variances, t)
        for of_case in estimator.errors(regression)
    ]
    return np.array([eta for eta, _ in found]), np.array([x for _, x in found])
