"""How good estimates are against the truth: sizes, norms, and from when on errors are small."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.evidence.metrics import NAMES as METRICS
from gpebo_cli.evidence.metrics import (
    SETTLED,
    Metrics,
    levels,
    measure_squares,
    settled,
    settling_times,
)
from gpebo_cli.experiment.result import EstimationResult, NoiseStatistics
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import reciprocals
from gpebo_cli.observers import StateMap
from gpebo_cli.observers._base import AffineStateMap
from gpebo_cli.regression.linear import LinearRegression

_LATE = 0.25  # of a run: its end, where a deviation swings
_LEAST = 1e-6  # of what would explain Y alone: a parameter smaller than that has no size of its own


def natural_sizes(regression: LinearRegression, p: int) -> Array:
    """√(∫Y²/∫ψ_j²) (p,): the size of a parameter that alone would explain Y; zeros for others."""
    energy = np.einsum("jj->j", regression.gram_final[:, : regression.p])
    if len(energy) != p:
        return np.zeros(p)
    mesh, squares = regression.mesh, (regression.Y.values[:, 1:] ** 2).sum(axis=-1)
    square = mesh.steps @ squares @ mesh.rule.integration[-1]
    return np.asarray(np.sqrt(np.divide(square, energy, out=np.zeros(p), where=energy > 0.0)))


def sizes_of(truth: Array, natural: Array, x: Array) -> tuple[Array, Array]:
    """Sizes of the parameters (p,) and states (n,): by these, errors of all kinds are compared."""
    of_eta, of_x = (np.fmax.reduce(np.abs(values), axis=0) for values in (truth, x))
    # A parameter that is zero has no size but that with which it would explain Y.
    return np.where(of_eta > _LEAST * natural, of_eta, np.fmax(of_eta, natural)), of_x


def judged_of(system: DescriptorSystem, p: int) -> BoolArray:
    """Which of the parameters (p,) are compared with the truth.

    Where θ varies e₀ makes up for it, and of what size it is says nothing: θ is what counts.
    """
    return np.arange(p) < (system.q if system.theta_varies else p)


def _weights(sizes: Array, counted: BoolArray) -> Array:
    """1/size², and 0 for what does not count or has no size."""
    return reciprocals(sizes**2, counted & (sizes > 0.0))


def told(determined: BoolArray) -> Array:
    """Factors (c,) that make NaN of what is not determined.

    Where nothing is, there is nothing to tell apart, and what an estimator does then is shown.
    """
    return np.where(determined | ~determined.any(), 1.0, np.nan)


def numbers_of(
    t: Array, of_eta: Array, of_x: Array, sizes: tuple[Array, Array], judged: BoolArray
) -> Array:
    """What ``Metrics`` are made of, (5 + p + n, g), of errors (g, M, p) and (g, M, n)."""
    seen, known = judged & ~np.isnan(of_eta[0, -1]), ~np.isnan(of_x[0, -1])
    squares = [
        np.einsum("gmj,j->gm", error[..., some] ** 2, _weights(size, some)[some])
        for error, size, some in ((of_eta, sizes[0], seen), (of_x, sizes[1], known))
    ]
    times = [
        settling_times(t, error, levels(error[:, 0], size))
        for error, size in zip((of_eta, of_x), sizes, strict=True)
    ]
    times[0][:, ~judged] = np.nan
    of_all = measure_squares(t, squares, of_eta[:, -1], of_x[:, -1], judged)
    return np.concatenate([of_all, times[0].T, times[1].T])


def metrics_of(numbers: Array, parameters: Sequence[str], system: DescriptorSystem) -> Metrics:
    """From (5, g), or (5 + p + n, g) with the time of each quantity."""
    names = [*parameters, *system.states]
    each = dict(zip(names, numbers[5:], strict=True)) if len(numbers) > len(METRICS) else {}
    return replace(Metrics(*numbers[: len(METRICS)]), seconds_to_1pct=each)


# η̂ (g, M, p) on the grid -> the numbers that ``Metrics`` are made of (c, g); η̂ (g, k, p) and
# x̂ (g, k, n) at the samples that are kept are written where the others say
_Evaluation = Callable[[Array, Array, Array], Array]


def evaluation(
    state_map: StateMap, grid: Array, truth: Array, x: Array, sizes: tuple[Array, Array],
    judged: BoolArray, chosen: IntArray, *, each: bool, alone: bool,
) -> _Evaluation:
    """How a batch of cases is measured on the grid (M,) against η (M, p) and x (M, n).

    ``each``: with the time of each quantity; ``alone``: there is one case only.
    """
    if not isinstance(state_map, AffineStateMap) or (alone and state_map.large):
        reconstruct = state_map.at(grid)

        def evaluate(eta: Array, kept: Array, seen: Array) -> Array:
            x_hat = reconstruct(eta)
            kept[:], seen[:] = eta[:, chosen], x_hat[:, chosen]
            return numbers_of(grid, eta - truth, x_hat - x, sizes, judged)

        return evaluate
    offset, gain = state_map.offset(grid), state_map.gain(grid)
    size, p = np.concatenate(sizes), truth.shape[1]
    offset_kept, gain_kept = offset[chosen], np.swapaxes(gain[chosen], 1, 2)

    def errors(eta: Array, at: IntArray) -> Array:
        """Of η̂ and x̂ (g, p + n) at a time for each quantity of each case, indices ``at``."""
        case, k, m = np.arange(len(eta))[:, None], at[:, :p], at[:, p:]
        j, i = np.arange(p), np.arange(x.shape[1])
        seen = offset[m, i] + np.einsum("gip,gip->gi", gain[m, i], eta[case, m])
        return np.concatenate([eta[case, k, j] - truth[k, j], seen - x[m, i]], axis=1)

    def errors_at(eta: Array, k: int) -> list[Array]:
        """Of η̂ (g, p) and x̂ (g, n) at one time."""
        return [eta[:, k] - truth[k], offset[k] + eta[:, k] @ gain[k].T - x[k]]

    def evaluate_affine(eta: Array, kept: Array, seen: Array) -> Array:
        """The norms, with x̂ only where it is needed: on the grid its errors are numbers."""
        eta = np.asarray(eta, dtype=np.float64)
        of_eta, of_x = errors_at(eta, -1)
        in_eta = _weights(sizes[0], judged & ~np.isnan(of_eta[0]))
        in_x = _weights(sizes[1], ~np.isnan(of_x[0]))
        level = None
        if each:
            level = levels(np.concatenate(errors_at(eta, 0), axis=1), size)
        *squares, last, of_norms = kernels.laws.squared_errors(
            eta, truth, in_eta, offset, gain, x, in_x, level, SETTLED**2
        )
        numbers = measure_squares(grid, squares, of_eta, of_x, judged, of_norms)
        if level is not None:
            times = settled(grid, last, lambda at: np.abs(errors(eta, at)), level)
            times[np.isnan(np.hstack([of_eta, of_x]))] = np.nan
            times[:, :p][:, ~judged] = np.nan
            numbers = np.concatenate([numbers, times.T])
        kept[:] = eta.take(chosen, axis=1)
        # A product per time serves all cases.
        np.matmul(kept.swapaxes(0, 1), gain_kept, out=seen.swapaxes(0, 1))
        seen += offset_kept
        return numbers

    return evaluate_affine


def standing(
    estimation: EstimationResult, metrics: Metrics, gains: Array | None, system: DescriptorSystem,
    over_seeds: NoiseStatistics | None = None,
) -> Metrics:
    """With the times from which on estimates are within ±2σ of what they are at the end.

    A state is compared with what the final parameters make of the same signals, whose noise is
    then in both: ``gains`` (G, M, n, p) of x̂ = offset + gain η̂. None: the observer estimates the
    state as it moves, by a filter; what it has still to learn has about the variance σ(t)² − σ².
    A state's σ often swings, and the largest one of the last quarter counts. Where no deviations
    are known, those of the parameters ``over_seeds`` serve.
    """
    eta, sigma, of_x = estimation.parameters, estimation.parameters_std, estimation.states_std
    away, names = np.nan_to_num(eta - eta[:, -1:]), (*estimation.names, *system.states)
    if sigma is not None and of_x is not None:
        late = estimation.t >= estimation.t[-1] - _LATE * np.ptp(estimation.t)
        moving = len(estimation.names) if gains is not None else system.q  # from there on
        every = np.concatenate([sigma, of_x], axis=2)
        at_end = np.hstack([every[:, -1, :moving], every[:, late, moving:].max(axis=1)])
        away = np.concatenate([
            away[..., :moving],
            np.sqrt(np.maximum(every[..., moving:] ** 2 - at_end[:, None, moving:] ** 2, 0.0))
            if gains is None else np.einsum("gmnp,gmp->gmn", gains, away),
        ], axis=2)
    elif over_seeds is not None:
        at_end = over_seeds.deviation[:, : eta.shape[2]]
    else:
        return replace(metrics, seconds_to_settled={})
    since = settling_times(estimation.t, away, 2.0 * at_end).T
    return replace(metrics, seconds_to_settled=dict(zip(names, since, strict=False)))
