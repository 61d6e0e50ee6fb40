"""One standard deviation of every estimate, from the noise of the signals."""

from __future__ import annotations

import numpy as np

from gpebo_cli.estimators import ResumableEstimator
from gpebo_cli.estimators import errors as behind
from gpebo_cli.evidence.sampled_uncertainty import SampledDeviations
from gpebo_cli.evidence.uncertainty import deviations, noise_level
from gpebo_cli.experiment.noise import NoiseLevels, signal_noise
from gpebo_cli.experiment.sources import Source
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.observers._base import Differentiable, Observation
from gpebo_cli.regression.errors import ErrorsAt
from gpebo_cli.regression.estimator import Affine, Estimator
from gpebo_cli.regression.linear import LinearRegression

_AT_ROW = 1e-6  # of a step: what is no farther from a row is there
MOST_CASES = 32  # each takes a pass of its own; more are a study of gains, not of a measurement
# Why there are no deviations.
_MANY = f"each of {{}} cases would take a pass of its own, which up to {MOST_CASES} do"
_FEW = "the samples are so few that the estimates leave nothing of them to tell their noise"
_ROUNDING = (
    "the gain is so large, or the samples tell so little, that in double precision rounding moves "
    "the estimate"
)
_NOT_SAID = "the estimator does not say what errors of Y do to it"
_IN_MATRICES = (
    "noise of the signals is in the matrices (of outputs observer.remedy=noise_free takes it out) "
    "or differentiated, or this observer or its remedy cannot tell what it does"
)


def sampled_deviations(
    levels: NoiseLevels, source: Source | None, t: Array | None = None
) -> SampledDeviations | None:
    """Deviations of an observer at samples of times t (N,); None if there is no noise.

    Levels that are zero are unknown but for a simulation. Without a source the samples are a
    stream, each of whose rows has errors of its own.
    """
    recorded = source is None or source.rows is not None
    if levels.silent and not recorded:
        return None
    variances = _variances(levels)
    if source is None:
        return SampledDeviations(variances, None, relative=levels.silent)
    rows = _rows(source)
    instants = rows.t
    if not recorded and not rows.lines:  # noise that is held has no other value at the end
        instants = instants[: np.searchsorted(instants, source.inputs.mesh.edges[-1])]
    near = 1e-6 * float(np.diff(instants).min(initial=np.inf))

    def row(t: Array) -> tuple[Array, Array]:
        number = np.searchsorted(instants, t + near, side="right").astype(np.float64)
        share = np.interp(t, instants, np.arange(1.0, len(instants) + 1)) - number
        return number, np.where(rows.lines & (share > _AT_ROW), share, 0.0)

    between = t is not None and bool(row(t)[1].any())
    return SampledDeviations(variances, row, relative=levels.silent, between=between)


def none_at_samples(cases: int, system: DescriptorSystem) -> str:
    """Why an observer and an estimator at samples have no deviations."""
    return _MANY.format(cases) if cases > MOST_CASES else f"{_unclear(system)}, or {_NOT_SAID}"


def _unclear(system: DescriptorSystem) -> str:
    """Why nobody knows what noise does; a regression has no matrices and no remedies."""
    return _IN_MATRICES if system.regression is None else "noise of the signals is in ψ"


def residual_ratio(observation: Observation, source: Source) -> float | None:
    """√(χ² per degree of freedom) of a recording's residual, for levels that are given.

    One where the sensors' noise is all that the estimates leave; None: nobody can tell.
    """
    if observation.errors is None or source.levels.silent or source.rows is None:
        return None
    if observation.regression.resets or observation.regression.dynamics is not None:
        return None
    found = noise_level(
        observation.errors, observation.regression, source.rows, _variances(source.levels),
        observation.starts,
    )
    return None if np.isnan(found) else found


def _rows(source: Source) -> Rows:
    """What the signals are samples of."""
    if source.rows is not None:
        return source.rows
    start, stop = source.inputs.mesh.edges[[0, -1]].tolist()
    return Rows(np.arange(start, stop, source.levels.settings.sample_time))


def _variances(levels: NoiseLevels) -> Array:
    """Of [u; y], (m + r,); of a recording without levels relative to that of all outputs."""
    if levels.silent:
        return np.concatenate([np.zeros(len(levels.inputs)), np.ones(len(levels.outputs))])
    return signal_noise(levels).variances


def standard_deviations(
    observation: Observation, estimator: Estimator, source: Source, t: Array, states: Array,
    system: DescriptorSystem, columns: IntArray | slice = slice(None),
) -> tuple[Array, Array] | str:
    """Deviations of parameters (G, M, p) and ``states`` (G, M, n) at t (M,), or why there are none.

    The regression may be about some ``columns`` of the parameters that the state map takes.

    No reason is given, and none is needed, where there is nothing to estimate. Rounding to steps q
    counts as noise of variance q²/12. Of a recording without levels, the one level that all outputs
    share is that of the residual.
    """
    state_map, errors, regression = (
        observation.state_map, observation.errors, observation.regression
    )
    if not regression.p:
        return ""
    if errors is None or not isinstance(state_map, Differentiable) or any(
        reset.errors is None for reset in regression.resets
    ):
        return _unclear(system)
    needed = ResumableEstimator if regression.resets else Affine
    if not isinstance(estimator, Affine) or not isinstance(estimator, needed):
        return _NOT_SAID
    if len(estimator.cases) > MOST_CASES:
        return _MANY.format(len(estimator.cases))
    edges, rows, variances = regression.mesh.edges, _rows(source), _variances(source.levels)
    if source.levels.silent:
        level = _level(errors, regression, rows, variances, observation.starts)
        if np.isnan(level):
            return _FEW
        variances *= level**2
    gains = state_map.gains(t, states)[..., columns]
    found = [
        deviations(
            errors, of_case, gain, edges, rows, variances, t, observation.starts, resets
        )
        for (of_case, resets), gain in zip(behind(estimator, regression), gains, strict=True)
    ]
    of_eta, of_x = (np.array(each) for each in zip(*found, strict=True))
    return _ROUNDING if np.isnan(of_eta).all() else (of_eta, of_x)


def _level(
    errors: ErrorsAt, regression: LinearRegression, rows: Rows, variances: Array,
    starts: Array | None,
) -> float:
    """σ of a recording; with resets the mean square of what each segment says."""
    segments = regression.segments
    squares = [noise_level(errors, own, rows, variances, starts) ** 2 for own in segments]
    lengths = np.array([own.mesh.edges[-1] - own.mesh.edges[0] for own in segments])
    told = np.isfinite(squares)
    weights = lengths * told
    return float(np.sqrt(np.nansum(weights * squares) / weights.sum())) if told.any() else np.nan
