"""What the final estimates explain of a recording, and what their residual looks like."""

from __future__ import annotations

from dataclasses import replace
from itertools import compress

import numpy as np

from gpebo_cli.experiment.result import EstimationResult, Fit
from gpebo_cli.experiment.sources import Source
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.numerics.linalg import reciprocals
from gpebo_cli.observers import Observation

_LAGS = 20  # of the residual's autocorrelation
_SLOW = 8  # one in so many of a residual's cosines is slow
_AT_MOST = 1 << 12  # means of samples that are compared with inputs,
_FAINT = 1e-3  # of whose past smaller directions than that are their own noise
_RARE = 0.005  # chance of each sum below which they are not those of white noise
_SILENT = 1e-9  # of an output: a residual below that is rounding
_FAR = 7.0  # deviations of most samples: what is farther away is no noise of theirs
_ROUNDS = 4
_ROUNDING = 0.35  # steps: rounding alone leaves 0.29
_ROUNDED = 0.95  # share of an output's changes that are whole steps, if it is rounded to these


def fit_of(
    observation: Observation, estimation: EstimationResult, system: DescriptorSystem,
    source: Source,
) -> Fit | None:
    """Root mean squares over time of Y − ψη̂ with the final estimates, and of Y; the fitted ŷ.

    Of an observer that estimates by itself η̂ are least squares of its evidence.
    """
    about = observation.evidence or observation
    regression = about.regression
    final = estimation.explaining if about is observation else regression.least_squares()[None]
    if final is None or observation.drifts:
        return None
    if about is observation and estimation.names != regression.parameters:
        return None
    duration = float(regression.mesh.edges[-1] - regression.mesh.edges[0])

    def rms(eta: Array) -> float:
        return float(np.sqrt(regression.misfit(eta) / duration))

    changing = bool(regression.resets) or regression.dynamics is not None
    least = np.nan if changing else rms(regression.least_squares())
    fit = Fit(np.array([rms(eta) for eta in final]), rms(np.zeros(regression.p)), least)
    if changing:
        return fit
    found = _explained(fit, final[fit.best], about, system, source)
    if found.white is None or (found.white and not found.far):
        return found
    # Estimates that forget, or that weigh a noisy output as a good one, leave more than noise.
    again = _explained(fit, final[fit.best], about, system, source, fitted_again=True)
    return replace(found, least_white=bool(again.white and not again.far))


def _varies_slowly(residual: Array) -> bool:
    """Whether a residual (N, r) has more in its slowest cosines than white noise.

    In its mean, and in its slowest 4, 8, 16, …: what is small and slow hides from single lags.
    """
    from scipy.fft import dct  # as long to import as a small run takes
    from scipy.special import fdtrc

    spectrum = dct(residual, axis=0, norm="ortho") ** 2
    (count, outputs), slow = spectrum.shape, len(spectrum) // _SLOW
    some = np.append(1, 2 ** np.arange(2, slow.bit_length()))
    sums = (spectrum / spectrum[slow:].mean(axis=0)).sum(axis=1).cumsum()[some - 1]
    chances = fdtrc(some * outputs, (count - slow) * outputs, sums / (some * outputs))
    return bool(chances.min(initial=1.0) < _RARE)


def _follows(residual: Array, inputs: Array) -> bool:
    """Whether a residual (N, r) follows inputs (N, m), those of now or of up to N/8 samples ago.

    White noise is independent of them, and what a wrong plant leaves is not.
    """
    from scipy.special import fdtrc

    each = -(-len(residual) // _AT_MOST)
    whole = len(residual) // each * each
    r, u = (
        x[:whole].reshape(whole // each, each, x.shape[1]).mean(axis=1) for x in (residual, inputs)
    )
    ago = np.append(0, 2 ** np.arange((len(r) // 8).bit_length()))
    past = np.hstack([u[ago[-1] - k : len(u) - k] for k in ago])
    r, moving = r[ago[-1] :] - r[ago[-1] :].mean(axis=0), past - past.mean(axis=0)
    size = np.linalg.norm(moving, axis=0)
    some = size > _SILENT * np.linalg.norm(past, axis=0)
    basis, sizes, _ = np.linalg.svd(moving[:, some] / size[some], full_matrices=False)
    basis = basis[:, sizes > _FAINT * sizes.max(initial=0.0)]
    count, free = basis.shape[1], len(r) - basis.shape[1] - 1
    if not count or free < count:
        return False
    along, all_of_it = ((basis.T @ r) ** 2).sum(axis=0), (r**2).sum(axis=0)
    ratio = (along / (all_of_it - along)).mean() * free / count
    return bool(fdtrc(count * r.shape[1], free * r.shape[1], ratio) < _RARE)


def _weighed(columns: Array, residual: Array, y: Array) -> Array:
    """What of columns (N, r, p) fits (N, r) of y best, each output by what is typical of it."""
    typical = np.nanmedian(np.abs(residual), axis=0)
    weight = reciprocals(typical, typical > _SILENT * np.nanmax(np.abs(y), axis=0))
    rows = (columns * weight[:, None]).reshape(-1, columns.shape[2])
    size = np.linalg.norm(rows, axis=0)
    scale = reciprocals(size, size > 0.0)
    found = np.linalg.lstsq(rows * scale, np.nan_to_num(residual * weight).ravel(), rcond=None)
    return np.asarray(columns @ (scale * found[0]))


def _missed(t: Array, y: Array, source: Source) -> Array:
    """How far outputs (N, r) at times t (N,) are from what is assumed between these, about, (r,).

    From a held value by 1/√3 of a step, from a line by a quarter of what a row is from its
    neighbours' one.
    """
    if source.rows is None or not source.rows.lines:
        far = np.diff(y, axis=0) / np.sqrt(3.0)
    else:
        share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
        far = 0.25 * (y[1:-1] - y[:-2] - share[:, None] * (y[2:] - y[:-2]))
    return np.asarray(np.sqrt(np.nan_to_num(far**2).mean(axis=0)))


def _step(y: Array) -> float:
    """What an output (N,) is rounded to; 0.0 where most changes are no multiples of one step."""
    change = np.abs(np.diff(y))
    change = change[change > _SILENT * np.nanmax(np.abs(y))]
    step = float(np.median(change)) if len(change) else 0.0
    whole = np.abs(change - step * np.rint(change / step)) < _SILENT**0.5 * step if step else change
    return step if len(change) and whole.mean() >= _ROUNDED else 0.0


def _on(system: DescriptorSystem, t: Array, u: Array, y: Array) -> BoolArray:
    """Which outputs are on at N times, (N or 1, r): rows of C, D and H are not all zero.

    One that never is counts as on, and so do all of a regression.
    """
    if system.regression is not None:
        return np.ones((1, system.r), dtype=bool)
    c = system.coefficients.taylor(t, 0, signals=np.hstack([u, y])[None])
    on = c.C[0].any(axis=2) | c.D[0].any(axis=2) | c.H[0].any(axis=2)
    return np.asarray(on | ~on.any(axis=0))


def _explained(
    fit: Fit, eta: Array, observation: Observation, system: DescriptorSystem, source: Source,
    *, fitted_again: bool = False,
) -> Fit:
    """With ŷ of the final estimates η̂ (p,), and how white y − ŷ is.

    ŷ is C x̂ + D u + H θ̂ of a plant, and ψη̂ of a regression whose Y is measured. Whiteness is
    looked at at every sample, or at the output times if x̂ is known there only. Where they are
    ``fitted_again`` it is that of least squares in which each output counts by its own noise.
    """
    t, recording, state_map = source.t, source.recording, observation.state_map
    if recording is None or len(state_map.times):
        return fit

    def outputs(eta: Array, t: Array, own_t: Array, u: Array, y: Array) -> Array:
        if system.regression is not None:
            return np.asarray(observation.regression.psi(t) @ eta)[:, : system.r]
        x = state_map.at(t)(np.broadcast_to(eta, (1, len(t), len(eta))))[0]
        c = system.coefficients.taylor(own_t, 0, signals=np.hstack([u, y])[None])
        terms = (c.C, x), (c.D, u), (c.H, np.tile(eta[: system.q], (len(t), 1)))
        return np.asarray(sum(
            np.matmul(matrix[0], signal[..., None])[..., 0] for matrix, signal in terms
        ))

    u, y = recording.inputs, recording.outputs
    own_t = t if source.own_t is None else source.own_t
    fitted = outputs(eta, t, own_t, u, y)
    fit = replace(fit, outputs=np.where(_on(system, own_t, u, y), fitted, np.nan))
    samples = t if source.samples is None else source.samples
    samples = samples[(samples >= t[0]) & (samples <= t[-1])]
    if len(samples) < 2:
        return fit
    if observation.regression.factor is None and not source.pieces:
        u, y = source.inputs(samples), source.outputs(samples)
        t, own_t, fitted = samples, samples, outputs(eta, samples, samples, u, y)
    y = np.where(_on(system, own_t, u, y), y, np.nan)
    if fitted_again:
        changes = np.diag(np.abs(eta) + (eta == 0.0))  # none is rounding beside η̂
        others = [outputs(eta + change, t, own_t, u, y) for change in changes]
        columns = np.stack(others, axis=-1) - fitted[..., None]
        for _ in range(_ROUNDS):  # how noisy each output is shows in what is left
            fitted = fitted + _weighed(columns, y - fitted, y)
    # Two samples apart: between samples the signals are interpolated and no noise is white.
    pieces = [piece.recording for piece in source.pieces if piece.recording] or [recording]
    apart = 2.0 * max((each.last - each.first) / (each.rows - 1) for each in pieces)
    step = float(t[-1] - t[0]) / (len(t) - 1)
    stride = 1 if t is samples else max(1, int(np.ceil(apart / step)))
    residual = (y - fitted)[::stride]
    away, off = np.abs(residual - np.nanmean(residual, axis=0)), np.isnan(residual)
    typical = np.nanmedian(away, axis=0) / 0.6745  # σ of normal noise, whatever few do
    far = (away > _FAR * typical) & (typical > 0.0)
    residual[far | off] = 0.0  # and hides nothing of the others
    power = (residual**2).sum(axis=0)
    # What an output is used up for leaves rounding, which is no noise.
    count, seen = len(residual), power > _SILENT**2 * np.nansum(y[::stride] ** 2, axis=0)
    lags = range(1, min(_LAGS, count // 4) + 1)
    if not seen.any() or not lags:
        return fit
    deviation, steps = np.sqrt(power / count), map(_step, y.T)
    correlation = np.array([
        ((residual[lag:] * residual[:-lag]).sum(axis=0)[seen] / power[seen]).mean() for lag in lags
    ])
    return replace(
        fit, far=[
            (name, int(own.sum()), float(t[::stride][np.argmax(own)]))
            for name, own in zip(system.outputs, (far & seen).T, strict=True) if own.any()
        ],
        rounded=[
            (name, step) for name, step, own in zip(system.outputs, steps, deviation, strict=True)
            if own < _ROUNDING * step
        ],
        coarse=tuple(compress(system.outputs, _missed(t, y, source) > deviation))
        if t is samples else (),
        correlation=correlation, slow=_varies_slowly(residual[:, seen]), lag=stride * step,
        follows=_follows(residual[:, seen], u[::stride]),
        in_matrices=() if observation.errors is not None else tuple(
            name for name in system.outputs if name in system.followed
        ),
        fed_back=() if observation.errors is None else tuple(compress(
            system.outputs, observation.errors(t[-1:], t[-1:]).B[0][:, system.m :].any(axis=0)
        )),
        of_inputs=tuple(compress(system.inputs, source.levels.inputs > 0.0)),
        band=1.96 / np.sqrt((~off)[:, seen].sum()),
    )
