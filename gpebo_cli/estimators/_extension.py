"""Dynamic regressor extension: from one row of ψ to a square system Ω η = 𝒴."""

from __future__ import annotations

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Mesh, Trajectory, unresolved
from gpebo_cli.regression.linear import LinearRegression, with_realisations

_TOLERANCE = 1e-11
_ROUNDS = 30


def kreisselmeier(
    regression: LinearRegression, rates: Array, start: Array | None = None
) -> Trajectory:
    """[Ω | 𝒴] of shape (p, p + c) with Ω' = −Λ(Ω − ψᵀψ), 𝒴' = −Λ(𝒴 − ψᵀY), from ``start``.

    Λ = diag(``rates``): one filter λ_i/(p + λ_i) per row, as in the paper (Section V); all rates
    equal is the classical extension. Since Λ multiplies rows, Ω η = 𝒴 holds for any rates.
    """
    return low_pass(regression.outer, rates[:, None], start)


def low_pass(signal: Trajectory, rate: Array, start: Array | None = None) -> Trajectory:
    """``signal.low_pass(rate)`` on a mesh fine enough for the filter's own transient.

    λ in 1/s is (p,) or whatever broadcasts against the signal. It starts at 0 or ``start``.
    """
    edges = signal.mesh.edges
    smallest = 1e-13 * max(1.0, abs(float(edges[0])), abs(float(edges[-1])))
    fastest = float(np.max(rate))
    for _ in range(_ROUNDS):
        filtered, mesh = signal.low_pass(rate, start), signal.mesh
        # Where elements are short beside the filter, the signal is what is not resolved.
        poor = (mesh.steps * fastest > 0.5) & (mesh.steps > smallest)
        if poor.any():
            flat = filtered.values.reshape(*filtered.values.shape[:2], -1)
            poor &= unresolved(flat, mesh.rule) > _TOLERANCE
        if not poor.any():
            break
        signal = mesh.split(np.where(poor, 4, 1))[0].along(signal)
    return filtered


def lion(regression: LinearRegression, rates: Array, start: Array | None = None) -> Trajectory:
    """[Ω | 𝒴] of shape (p, p + c), row i being λ_i/(p + λ_i) of one row of [ψ | Y].

    Row i takes row i mod r of the regression: with one output every row is a filtered copy of the
    same ψ, and rates must differ for Ω to be invertible.
    """
    psi = regression.psi.values
    both = np.concatenate([psi, with_realisations(psi, regression.Y.values)], axis=-1)
    rows = np.arange(regression.p) % both.shape[2]
    signal = Trajectory(regression.mesh, both[:, :, rows])
    return low_pass(signal, rates[:, None], start)


def lagged(regression: LinearRegression, delay: float, t: Array, inside: Array) -> Array:
    """[ψ(t) ; ψ(t − d)]ᵀ (N, 2p, rows) at times t (N,), d in seconds, zero before the start."""
    start = regression.mesh.edges[0]
    before = regression.psi(np.maximum(t - delay, start), inside - delay)
    before[inside - delay < start] = 0.0
    return np.swapaxes(np.concatenate([regression.psi(t, inside), before], axis=-1), -1, -2)


def averaged(regression: LinearRegression, delay: float, settle: float) -> Trajectory:
    """Means of [ψ(t) ; ψ(t − d)]ᵀ [ψ | Y], shape (2p, p + c): Z' = (product − Z)/(T₀ + t), Z = 0.

    What a disturbance of Y has in common with a factor stays in the mean of that row; the rest
    vanishes as the mean is taken over longer and longer times. The mesh has edges where the delayed
    ψ has; d and T₀ are in seconds.
    """
    edges = regression.mesh.edges
    later = edges[edges + delay < edges[-1]] + delay
    after = np.searchsorted(edges, later)
    apart = np.minimum(edges[after] - later, later - edges[after - 1])
    cuts = np.union1d(edges, later[apart > 1e-12 * (edges[-1] - edges[0])])
    mesh = Mesh(cuts, regression.mesh.rule)
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    psi, Y = regression.psi(t, inside), regression.Y(t, inside)
    both = np.concatenate([psi, with_realisations(psi, Y)], axis=-1)
    product = lagged(regression, delay, t, inside) @ both
    whole = mesh.trajectory(product).integral()
    span = (settle + mesh.points - edges[0])[..., None, None]
    return Trajectory(mesh, whole.values / span)
