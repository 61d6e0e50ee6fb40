"""How good estimates are: their errors against the truth, and what of a recording they explain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.evidence.metrics import NAMES as METRICS
from gpebo_cli.evidence.metrics import (
    SETTLED,
    Metrics,
    levels,
    measure_squares,
    settled,
    settling_times,
)
from gpebo_cli.experiment.result import EstimationResult, Fit, NoiseStatistics
from gpebo_cli.experiment.sources import Source
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, IntArray
from gpebo_cli.observers import Observation, StateMap
from gpebo_cli.observers._base import AffineStateMap
from gpebo_cli.regression.linear import LinearRegression, least_squares

_LATE = 0.25  # of a run: its end, where a deviation swings
_LAGS = 20  # of the residual's autocorrelation
_SLOW = 8  # one in so many of a residual's cosines is slow
_RARE = 0.005  # chance of each sum below which they are not those of white noise
_SILENT = 1e-9  # of an output: a residual below that is rounding
_LEAST = 1e-6  # of what would explain Y alone: a parameter smaller than that has no size of its own
_ASTRAY = 0.02  # of a quantity's size: estimates that differ by more are different
_EXACT = 1e-3  # of it: so do those of a law that is done, if less than
_DONE = 30.0  # times this is what it has left of the errors it began with
_BEYOND = 4.0  # deviations: noise does not bring estimates farther away
_UNFINISHED = (  # why there are no deviations
    "what the estimator needs is not met, and estimates are farther from least squares over the "
    "same data than noise brings them; use estimator=least_squares or other gains"
)
_WORSE = 3.0  # times the residual of least squares: more than that is not the noise of the data
_FAR = 7.0  # deviations of most samples: what is farther away is no noise of theirs
_ROUNDING = 0.35  # steps: rounding alone leaves 0.29
_ROUNDED = 0.95  # share of an output's changes that are whole steps, if it is rounded to these
_TINY = float(np.finfo(float).tiny)
_STILL = 1e-9  # of the same: an estimate that moved by less than that was not moved by data


def natural_sizes(regression: LinearRegression, p: int) -> Array:
    """√(∫Y²/∫ψ_j²) (p,): the size of a parameter that alone would explain Y; zeros for others."""
    energy = np.einsum("jj->j", regression.gram.final[:, : regression.p])
    if len(energy) != p:
        return np.zeros(p)
    mesh, squares = regression.mesh, (regression.Y.values[:, 1:] ** 2).sum(axis=-1)
    square = mesh.steps @ squares @ mesh.rule.integration[-1]
    return np.asarray(np.sqrt(np.divide(square, energy, out=np.zeros(p), where=energy > 0.0)))


def still(parameters: Array, requirement: Requirement, natural: Array) -> BoolArray:
    """Which cases (G,) of η̂ (G, M, p) are where they began, for want of what is required.

    Noise did not move them either, and a deviation of zero would claim that nothing is uncertain.
    """
    if requirement.holds or not len(natural):
        return np.zeros(len(parameters), dtype=bool)
    return np.asarray(~(np.ptp(parameters, axis=1) > _STILL * natural).any(axis=1))


def sizes_of(truth: Array, natural: Array, x: Array) -> tuple[Array, Array]:
    """Sizes of the parameters (p,) and states (n,): by these, errors of all kinds are compared."""
    of_eta, of_x = (np.fmax.reduce(np.abs(values), axis=0) for values in (truth, x))
    # A parameter that is zero has no size but that with which it would explain Y.
    return np.where(of_eta > _LEAST * natural, of_eta, np.fmax(of_eta, natural)), of_x


def judged_of(source: Source, p: int) -> BoolArray:
    """Which of the parameters (p,) are compared with the truth."""
    judged = np.zeros(p, dtype=bool)
    judged[source.judged] = True
    return judged


def _weights(sizes: Array, counted: BoolArray) -> Array:
    """1/size², and 0 for what does not count or has no size."""
    counted = counted & (sizes > 0.0)
    return np.divide(1.0, sizes**2, out=np.zeros(len(sizes)), where=counted)


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


# η̂ (g, M, p) on the grid -> the numbers that ``Metrics`` are made of (c, g), and η̂ (g, k, p) and
# x̂ (g, k, n) at the samples that are kept
_Evaluation = Callable[[Array], tuple[Array, Array, Array]]


def evaluation(
    state_map: StateMap, grid: Array, truth: Array, x: Array, sizes: tuple[Array, Array],
    judged: BoolArray, chosen: IntArray, *, each: bool, alone: bool,
) -> _Evaluation:
    """How a batch of cases is measured on the grid (M,) against η (M, p) and x (M, n).

    ``each``: with the time of each quantity; ``alone``: there is one case only.
    """
    if not isinstance(state_map, AffineStateMap) or (alone and state_map.large):
        reconstruct = state_map.at(grid)

        def evaluate(eta: Array) -> tuple[Array, Array, Array]:
            x_hat = reconstruct(eta)
            numbers = numbers_of(grid, eta - truth, x_hat - x, sizes, judged)
            return numbers, eta[:, chosen], x_hat[:, chosen]

        return evaluate
    sampler = state_map.offset.mesh.sampler(grid)
    offset, gain = sampler(state_map.offset.values), sampler(state_map.gain.values)
    size, p = np.concatenate(sizes), truth.shape[1]
    offset_kept, gain_kept = offset[chosen], np.swapaxes(gain[chosen], 1, 2)

    def errors(eta: Array, at: IntArray) -> Array:
        """Of η̂ and x̂ (2, g, p + n) at two times for each quantity of each case, indices ``at``."""
        place = len(grid) * np.arange(len(eta))[:, None] + at  # in all cases, one after the other
        j, m, i = np.arange(p), at[..., p:], np.arange(at.shape[2] - p)
        of_eta = eta.ravel().take(place[..., :p] * p + j) - truth[at[..., :p], j]
        flat = eta.reshape(eta.shape[0] * eta.shape[1], p)  # spelled out: p may be 0
        gains = gain.reshape(len(gain) * len(i), p).take(m * len(i) + i, axis=0)
        seen = np.einsum("tgip,tgip->tgi", gains, flat.take(place[..., p:], axis=0))
        return np.concatenate([of_eta, offset[m, i] + seen - x[m, i]], axis=2)

    def errors_at(eta: Array, k: int) -> list[Array]:
        """Of η̂ (g, p) and x̂ (g, n) at one time."""
        return [eta[:, k] - truth[k], offset[k] + eta[:, k] @ gain[k].T - x[k]]

    def evaluate_affine(eta: Array) -> tuple[Array, Array, Array]:
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
            k = np.clip(last, 0, max(len(grid) - 2, 0)).astype(np.intp)
            before, after = np.abs(errors(eta, np.array([k, np.minimum(k + 1, len(grid) - 1)])))
            times = settled(grid, last, before, after, level)
            times[np.isnan(np.hstack([of_eta, of_x]))] = np.nan
            times[:, :p][:, ~judged] = np.nan
            numbers = np.concatenate([numbers, times.T])
        kept = eta.take(chosen, axis=1)
        x_hat = np.empty((len(eta), *offset_kept.shape))  # a product per time serves all cases
        np.matmul(kept.swapaxes(0, 1), gain_kept, out=x_hat.swapaxes(0, 1))
        x_hat += offset_kept
        return numbers, kept, x_hat

    return evaluate_affine


def finished(
    std: Array | None, why: str, root: Array, final: Array, requirement: Requirement,
    columns: IntArray,
) -> tuple[Array | None, str]:
    """Deviations (G, M, p + n) of what noise alone may have brought where it is, and why not all.

    Those of the others are NaN: what they require is not met, and their ``final`` estimates (G, p)
    are far from least squares over the same data. None, if there are no others. The root and the
    columns are as of :func:`doubts`.
    """
    if std is None or requirement.holds or not len(columns):
        return std, why
    eta = _about(root, columns)
    far = (np.abs(final - eta) > _BEYOND * std[:, -1, : len(eta)]).any(axis=1)
    if not far.any():
        return std, why
    std[far] = np.nan
    return None if far.all() else std, _UNFINISHED


def _about(root: Array, columns: IntArray) -> Array:
    """η (p,) of least squares about some of the parameters, the others being zero."""
    eta = np.zeros(root.shape[1] - 1)
    eta[columns] = least_squares(root[:, [*columns, -1]])
    return eta


def doubts(
    root: Array, final: Array, states: Callable[[Array], Array], last: Callable[[Array], Array],
    quantities: Sequence[str], sizes: Array, known: Knowledge, seen: BoolArray, columns: IntArray,
    requirement: Requirement,
) -> tuple[Mapping[str, float], tuple[str, ...]]:
    """How far final estimates may be off, relative to each one's size, and warnings of that.

    Off least squares over the same data, because of gains or rounding, and by what the data leave
    open. There is no warning of the first if the ``requirement`` is not met, or if the estimates
    explain the data nearly as well, because noise makes such a difference too. ``root`` R (k, p +
    1) has |R [−η; 1]|² = ∫‖Y − ψη‖², ``final`` are η̂ of all cases at the end (G, p), ``states``
    makes x̂ (g, M, n) of parameters (g, p), at times of which the last is the end, and ``last`` at
    the end alone. Of ``quantities``, names of parameters and states (p + n,), a size that is NaN
    counts as least squares' own one. ``seen`` (n,) states are determined. Only ``columns`` (k,) are
    estimated.
    """
    final, p = final[np.isfinite(final).all(axis=1)], final.shape[1]
    if not len(final) or not len(columns):
        return {}, ()
    eta = _about(root, columns)
    least = np.linalg.norm(root @ np.append(-eta, 1.0))
    more = np.linalg.norm((final - eta) @ root[:, :-1].T, axis=1)
    best = int(np.argmin(more))
    both = np.stack([final[best], eta])
    x, rows = states(both), last(np.eye(p + 1, p))[:, -1]
    one, other = np.hstack([both, x[:, -1]])
    own = np.append(np.abs(eta), np.abs(x[1]).max(axis=0, initial=0.0))
    own = np.maximum(np.fmax(sizes, own), _TINY)
    gain = np.concatenate([np.eye(p), (rows[:-1] - rows[-1]).T])
    away, open_ = np.abs(one - other), known.doubt(root[:, :-1].T @ root[:, -1], gain)[0]
    determined = np.append(known.parameters[-1], seen)
    found = dict(zip(quantities, ((away + open_) / own).tolist(), strict=True))
    # A law that is known to be done is not as far from least squares as one that may not be.
    rest = np.exp(-requirement.evidence.get("gamma_times_integral", 0.0))
    limit = min(_ASTRAY, max(_EXACT, _DONE * rest))
    far = determined & (away > limit * own)
    far &= requirement.holds and bool(more[best] > _WORSE * least)
    told = {name: found[name] for name in compress(quantities, determined)}
    if not far.any():
        return told, ()
    size = np.linalg.norm(root[:, -1])
    text = (
        f"estimates.csv: at the end {', '.join(compress(quantities, far))} are up to "
        f"{(away / own)[far].max():.2g} of their size away from least squares over the same data, "
        f"which leaves {least / size:.1g} of Y and they {np.hypot(least, more[best]) / size:.1g}: "
        "the estimator has lost digits or is not done; use estimator=least_squares or other gains"
    )
    return told, (text,)


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


def fit_of(
    observation: Observation, estimation: EstimationResult, system: DescriptorSystem,
    source: Source,
) -> Fit | None:
    """Root mean squares over time of Y − ψη̂ with the final estimates, and of Y; the fitted ŷ."""
    regression = observation.regression
    final = estimation.explaining
    if final is None or estimation.names != regression.parameters:
        return None
    duration = float(regression.mesh.edges[-1] - regression.mesh.edges[0])

    def rms(eta: Array) -> float:
        return float(np.sqrt(regression.misfit(eta) / duration))

    fit = Fit(np.array([rms(eta) for eta in final]), rms(np.zeros(regression.p)))
    if regression.resets or regression.dynamics is not None:
        return fit
    return _explained(
        fit, final[fit.best], observation, system, source,
        every=regression.factor is None and not source.pieces,
    )


def _varies_slowly(residual: Array) -> bool:
    """Whether a residual (N, r) has more in its slowest cosines than white noise.

    In its slowest 4, 8, 16, …: what is small and slow hides from single lags.
    """
    from scipy.fft import dct  # as long to import as a small run takes
    from scipy.special import fdtrc

    spectrum = dct(residual, axis=0, norm="ortho")[1:] ** 2
    (count, outputs), slow = spectrum.shape, len(spectrum) // _SLOW
    some = 2 ** np.arange(2, slow.bit_length())
    sums = (spectrum / spectrum[slow:].mean(axis=0)).sum(axis=1).cumsum()[some - 1]
    chances = fdtrc(some * outputs, (count - slow) * outputs, sums / (some * outputs))
    return bool(chances.min(initial=1.0) < _RARE)


def _step(y: Array) -> float:
    """What an output (N,) is rounded to; 0.0 where most changes are no multiples of one step."""
    change = np.abs(np.diff(y))
    change = change[change > _SILENT * np.abs(y).max()]
    step = float(np.median(change)) if len(change) else 0.0
    whole = np.abs(change - step * np.rint(change / step)) < _SILENT**0.5 * step if step else change
    return step if len(change) and whole.mean() >= _ROUNDED else 0.0


def _explained(
    fit: Fit, eta: Array, observation: Observation, system: DescriptorSystem, source: Source, *,
    every: bool,
) -> Fit:
    """With ŷ of the final estimates η̂ (p,), and how white y − ŷ is.

    ŷ is C x̂ + D u + H θ̂ of a plant, and ψη̂ of a regression whose Y is measured. Whiteness is
    looked at at ``every`` sample, or at the output times if x̂ is known there only.
    """
    t, recording, state_map = source.t, source.recording, observation.state_map
    if recording is None or len(state_map.times):
        return fit

    def outputs(t: Array, own_t: Array, u: Array, y: Array) -> Array:
        if system.regression is not None:
            return np.asarray(observation.regression.psi(t) @ eta)[:, : system.r]
        x = state_map.at(t)(np.broadcast_to(eta, (1, len(t), len(eta))))[0]
        c = system.coefficients.taylor(own_t, 0, signals=np.hstack([u, y])[None])
        terms = (c.C, x), (c.D, u), (c.H, np.tile(eta[: system.q], (len(t), 1)))
        return np.asarray(sum(
            np.matmul(matrix[0], signal[..., None])[..., 0] for matrix, signal in terms
        ))

    u, y = recording.inputs, recording.outputs
    fitted = outputs(t, t if source.own_t is None else source.own_t, u, y)
    fit = replace(fit, outputs=fitted)
    samples = t if source.samples is None else source.samples
    samples = samples[(samples >= t[0]) & (samples <= t[-1])]
    if every:
        u, y = source.inputs(samples), source.outputs(samples)
        t, fitted = samples, outputs(samples, samples, u, y)
    # Two samples apart: between samples the signals are interpolated and no noise is white.
    apart = 2.0 * (recording.last - recording.first) / max(recording.rows - 1, 1)
    step = float(t[-1] - t[0]) / (len(t) - 1)
    stride = 1 if t is samples else max(1, int(np.ceil(apart / step)))
    residual = (y - fitted)[::stride]
    residual = residual - residual.mean(axis=0)
    power = (residual**2).sum(axis=0)
    # What an output is used up for leaves rounding, which is no noise.
    count, seen = len(residual), power > _SILENT**2 * (y[::stride] ** 2).sum(axis=0)
    lags = range(1, min(_LAGS, count // 4) + 1)
    if not seen.any() or not lags:
        return fit
    correlation = np.array([
        ((residual[lag:] * residual[:-lag]).sum(axis=0)[seen] / power[seen]).mean() for lag in lags
    ])
    names = frozenset[str]().union(*system.coefficients.signals.values())
    typical = np.median(np.abs(residual), axis=0) / 0.6745  # σ of normal noise, whatever few do
    far = (np.abs(residual) > _FAR * typical) & seen & (typical > 0.0)
    return replace(
        fit, far=[
            (name, int(own.sum()), float(t[::stride][np.argmax(own)]))
            for name, own in zip(system.outputs, far.T, strict=True) if own.any()
        ],
        rounded=[
            (name, step) for name, step, own in zip(
                system.outputs, map(_step, y.T), np.sqrt(power / count), strict=True
            ) if own < _ROUNDING * step
        ],
        correlation=correlation, slow=_varies_slowly(residual[:, seen]), lag=stride * step,
        in_matrices=tuple(name for name in system.outputs if name in names),
        band=1.96 / np.sqrt(count * seen.sum()),
    )
