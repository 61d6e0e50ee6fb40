"""Excitation of a regressor, as evidence: how strongly, from when on, and in which direction.

Interval excitation, as the paper's Assumption 2 means it, is G(t_c) = ∫ψᵀψ ≥ ρ I_p for some t_c
(p × p; the paper prints ∫ψψᵀ ≥ ρ I_r, which is necessary only if r = p).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Direction, Requirement
from gpebo_cli.kernels import spectra
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import largest
from gpebo_cli.numerics.mesh import Mesh, Sampler, Trajectory
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import ExcitationSettings

RELATIVE_LEVEL = 1e-8  # default ρ, of the energy a regressor of its size would have
_ROUNDS, _SAME_TIME = 30, 1e-12
_AROUND = np.concatenate([-(0.25 ** np.arange(10.0)), [0.0], 0.25 ** np.arange(9.0, -1.0, -1.0)])
WINDOWS = 10  # default PE window: this many per horizon


@dataclass(frozen=True)
class Excitation:
    """Interval and persistent excitation, as evidence and not a bare yes.

    ``gram_eigenvalues[i]`` are those of G(t_i) = ∫ψᵀψ from the start to t_i, ascending.
    """

    t: Array  # (N,)
    gram_eigenvalues: Array  # (N, p)
    pe_level: Array  # (N,) smallest eigenvalue of the Gram matrix over the trailing window
    window: float
    is_ie: bool
    t_c: float | None  # first time with lambda_min(G) >= rho
    rho: float
    lambda_min: float  # at the horizon
    condition: float  # lambda_max / lambda_min at the horizon
    weakest_direction: Direction


def assess(regression: LinearRegression, t: Array, settings: ExcitationSettings) -> Excitation:
    """Interval and persistent excitation of ψ at the times t (N,).

    Without a level asked for, ρ is 1e-8 of ``scale² · horizon``, where the scale is the size of
    the terms ψ is made of: a regressor that is zero but for rounding is never exciting.
    """
    mesh = regression.mesh
    horizon = float(mesh.edges[-1] - mesh.edges[0])
    rho = settings.rho
    if rho is None:
        rho = RELATIVE_LEVEL * regression.scale**2 * horizon
    window = settings.window if settings.window is not None else horizon / WINDOWS
    gram = regression.gram
    values, direction = _weakest(gram.final)
    sign = 1.0 if max(direction, key=abs) >= 0.0 else -1.0
    smallest, largest = max(values[0], 0.0), values[-1]
    t_c = _first_time(gram, rho)
    return Excitation(
        t=t,
        gram_eigenvalues=np.maximum(spectra.eigenvalues(gram(t)), 0.0),
        pe_level=segment_level(regression, t, window),
        window=window,
        is_ie=t_c is not None,
        t_c=t_c,
        rho=rho,
        lambda_min=smallest,
        condition=largest / smallest if smallest > 0 else float("inf"),
        weakest_direction=Direction(
            dict(zip(regression.parameters, (sign * part for part in direction), strict=True))
        ),
    )


def _weakest(matrix: Array) -> tuple[list[float], list[float]]:
    """Eigenvalues of a symmetric matrix (p, p), ascending, and the first one's eigenvector.

    Further columns are not looked at.
    """
    of_all, vectors = np.linalg.eigh(matrix[:, : len(matrix)])
    return of_all.tolist(), vectors[:, 0].tolist()


def _first_time(gram: Trajectory, rho: float) -> float | None:
    """First time with λ_min(G) ≥ ρ: bracketed on the mesh (λ_min never falls), then narrowed.

    Each round looks where the secant points, and at distances around it that fall by fours.

    Args:
        gram: [G | h], shape (p, p + c).
        rho: the level.
    """
    mesh, p = gram.mesh, gram.values.shape[2]
    if rho <= 0:
        return None
    reached = np.flatnonzero(spectra.eigenvalues(gram.values[:, -1])[:, 0] >= rho)
    if len(reached) == 0:
        return None
    k = int(reached[0])
    points = mesh.points[k]
    level = spectra.eigenvalues(gram.values[k])[:, 0] - rho
    element = Trajectory(Mesh(mesh.edges[k : k + 2], mesh.rule), gram.values[k : k + 1, :, :, :p])
    for _ in range(_ROUNDS):
        j = int(np.argmax(level >= 0.0)) if (level >= 0.0).any() else len(level) - 1
        low, high = float(points[max(j - 1, 0)]), float(points[j])
        if high - low <= _SAME_TIME * max(abs(high), mesh.edges[-1] - mesh.edges[0]):
            break
        share = level[j - 1] / (level[j - 1] - level[j])
        guess = low + (high - low) * (share if 0.0 <= share <= 1.0 else 0.5)
        points = np.unique(np.clip(guess + (high - low) * _AROUND, low, high))
        level = spectra.eigenvalues(element(points))[:, 0] - rho
        level[-1] = max(level[-1], 0.0)  # rounding; it was reached there
    return high


def segment_level(regression: LinearRegression, t: Array, window: float) -> Array:
    """:func:`window_level` at the times t (M,) where parameters may be replaced inside a window.

    What was seen before a reset counts for the parameters after it: T⁻ᵀ G T⁻¹, as in
    ``ExtensionState.after``.
    """
    p = regression.p
    if not regression.resets:
        return window_level(regression.outer, t, window)
    level = np.full(len(t), np.nan)
    start = t - window
    whole = np.flatnonzero(start >= regression.mesh.edges[0] - 1e-12 * max(1.0, window))
    gram = np.zeros((len(whole), p, p + 1))
    before: LinearRegression | None = None
    for segment, reset in zip(regression.segments, (None, *regression.resets), strict=True):
        if before is not None and reset is not None:
            size = largest(before.gram.final)
            for i in np.flatnonzero((start[whole] < reset.time) & (t[whole] > reset.time)):
                gram[i] = ExtensionState(gram[i], size).after(reset).values
        low, high = segment.mesh.edges[[0, -1]]
        a, b = np.clip(start[whole], low, high), np.clip(t[whole], low, high)
        here = np.flatnonzero(b > a)
        gram[here] += between(segment.outer, a[here], b[here])
        before = segment
    level[whole] = np.maximum(spectra.eigenvalues(gram)[:, 0], 0.0)
    return level


def window_level(outer: Trajectory, t: Array, window: float) -> Array:
    """λ_min of ∫_{t−T}^{t} ψᵀψ at the times t (M,); NaN before the first whole one.

    Whole elements are summed afresh for every window. The difference G(t) − G(t − T) was
    rejected: once a regressor has died out, it is the rounding of two large numbers.

    Args:
        outer: ψᵀψ, shape (p, p); further columns are not looked at.
        t: ends of the windows.
        window: T, in seconds.
    """
    mesh = outer.mesh
    level = np.full(len(t), np.nan)
    start = t - window
    whole = (start >= mesh.edges[0] - 1e-12 * max(1.0, window)).nonzero()[0]
    if len(whole) == 0:
        return level
    from_there = mesh.sampler(np.maximum(start[whole], mesh.edges[0]))
    to_there = mesh.sampler(t)
    to_there = Sampler(to_there.element[whole], to_there.weights[whole])
    sums = _window_sums(outer, from_there, to_there, outer.values.shape[2])
    level[whole] = np.maximum(spectra.eigenvalues(sums)[:, 0], 0.0)
    return level


def between(signal: Trajectory, a: Array, b: Array) -> Array:
    """∫ of a signal (rows, c) from a to b ≥ a (N,) within its mesh, whole elements summed afresh.

    Returns:
        shape (N, rows, c).
    """
    mesh = signal.mesh
    return _window_sums(signal, mesh.sampler(a), mesh.sampler(b), signal.values.shape[3])


def _window_sums(signal: Trajectory, start: Sampler, stop: Sampler, columns: int) -> Array:
    """:func:`between` of the first columns, with the times where these samplers look."""
    mesh = signal.mesh
    within = Trajectory(mesh, signal.values[..., :columns]).local_integral().values
    totals = within[:, -1]
    head = start(within)  # from the left end of a's element to a
    tail = stop(within)
    # Sums of totals[first:last] for every window: pairs of indices to reduceat.
    padded = np.concatenate([totals, np.zeros_like(totals[:1])])
    pairs = np.stack([start.element, stop.element], axis=1).ravel().astype(np.intp)
    whole = np.add.reduceat(padded, pairs, axis=0)[::2]
    several = (start.element < stop.element)[:, None, None]
    return np.asarray(np.where(several, whole, 0.0) + tail - head)


def sampled_window_level(regression: SampledRegression, window: float) -> Array:
    """λ_min of ∫ψᵀψ over the last ``window`` seconds at every sample (K,), to a sample's length.

    NaN before the first whole window. Every window is summed afresh, as in :func:`window_level`.
    """
    t, p = regression.t, regression.p
    level = np.full(len(t), np.nan)
    slack = 1e-9 * window
    whole = np.flatnonzero(t - window >= t[0] - slack)
    rows = regression.weighted()[..., :p]
    steps = np.concatenate([np.swapaxes(rows, 1, 2) @ rows, np.zeros((1, p, p))])
    first = np.searchsorted(t, t[whole] - window + slack, side="right")
    pairs = np.stack([first, whole + 1], axis=1).ravel()
    sums = np.add.reduceat(steps, pairs, axis=0)[::2]
    level[whole] = np.maximum(spectra.eigenvalues(sums)[:, 0], 0.0)
    return level


def persistent(outer: Trajectory, gain: float) -> Requirement:
    """Whether ψ keeps exciting, and whether that is enough at this gain.

    The evidence is the smallest λ_min of ∫ψᵀψ (or of what takes its place) over sliding windows
    of a tenth of the horizon. An error shrinks by about exp(−γ λ_min) per window while γ λ_min is
    small, so 1 % within the horizon's ten windows needs γ λ_min ≥ ln(100)/10.

    Args:
        outer: ψᵀψ, shape (p, p).
        gain: the smallest γ of the estimator.
    """
    mesh = outer.mesh
    length = float(mesh.edges[-1] - mesh.edges[0]) / WINDOWS
    t = np.linspace(mesh.edges[0], mesh.edges[-1], 10 * WINDOWS + 1)
    level = float(np.nanmin(window_level(outer, t, length)))
    needed = DECAY / WINDOWS
    return Requirement(
        name="PE",
        holds=gain * level >= needed,
        evidence={"pe_level": level, "window": length, "gamma_times_level": gain * level,
                  "needed": needed},
        text=(
            f"λ_min over windows of {length:.3g} s falls to {level:.3g}, times γ = {gain:.3g} is "
            f"{gain * level:.3g}; 1 % of the initial error needs {needed:.3g}"
        ),
    )
