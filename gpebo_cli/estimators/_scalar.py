"""The scalar law of DREM, η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i), for any number of gains at once.

In the variable I = ∫Δ² and with η̄ = 𝐘/Δ the law is dη̂/dI = γ (η̄ − η̂). Without noise η̄ is
constant and the law has the closed form η̂ = η̄ + e^{−γI} (η̂(0) − η̄): exact at any gain, one
exponential per gain and time. With noise or forgetting η̄ varies, and where Δ changes sign it has
poles that the law itself does not have; then the law is integrated as it stands, by the same
L-stable collocation as everything else, all gains as one batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import affine_scan
from gpebo_cli.numerics.mesh import Mesh, Trajectory, unresolved

# (times (N,), inside (N,)) -> Δ (N,), 𝐘 (N, p)
MixedSignals = Callable[[Array, Array], tuple[Array, Array]]

# Relative variation of η̄, weighted by what it can do: below the first η̄ counts as constant, below
# the second as linear in I between neighbouring points, which is then accurate enough.
_CONSTANT, _SMALL = 1e-13, 1e-8
_TOLERANCE = 1e-10
_MAX_ELEMENTS = 100_000
_MAX_PARTS = 8
_LANES = 1 << 22  # numbers in one batch of gains


@dataclass(frozen=True, eq=False)
class ScalarPath:
    """The mixed regression along the points of a mesh, and the times at which to report."""

    mesh: Mesh
    signals: MixedSignals
    delta: Callable[[Array], Array]  # times (N,) -> Δ (N,)
    quotient: Array  # (K, s + 1, p) η̄, usable everywhere
    energy: Array  # (K, s + 1) I
    t: Array  # (M,)
    energy_at_t: Array  # (M,)
    floor: float  # size below which η̂ is rounding


def scalar_law(path: ScalarPath, start: Array, gains: Array) -> Array:
    """Estimates at the times of the path.

    Args:
        path: the mixed regression.
        start: η̂ at the start, shape (p,), or (g, p) for each gain its own.
        gains: γ, shape (g, p) or (g, 1).

    Returns:
        η̂, shape (g, M, p).

    Raises:
        SolverError: the law cannot be resolved.
    """
    variation, last = law_variation(path.energy, path.quotient, float(gains.max(initial=0.0)))
    size = max(last, float(np.abs(start).max()), path.floor)
    if variation <= _CONSTANT * size:
        return constant_law(path, start, gains)
    if variation <= _SMALL * size:
        return linear_law(path, start, gains)
    lanes = path.mesh.points.size * path.quotient.shape[2] * path.mesh.rule.stages
    batch = max(1, _LANES // lanes)
    starts = np.broadcast_to(start, (len(gains), start.shape[-1]))
    return np.concatenate([
        _integrate(path, starts[i : i + batch], gains[i : i + batch])
        for i in range(0, len(gains), batch)
    ])


def law_variation(energy: Array, quotient: Array, gain: float) -> tuple[float, float]:
    """How much η̄ (K, s + 1, p) varies from a point to the next, weighted by what that can do.

    The weight is the share min(1, γδI) of a step of I (K, s + 1) that η̂ goes to meet η̄.

    Returns:
        the largest variation, and the largest |η̄| of the last element.
    """
    length = np.maximum(np.diff(energy, axis=1), 0.0)
    weight = np.minimum(1.0, gain * length)
    change = np.abs(np.diff(quotient, axis=1))
    return (
        float((weight[..., None] * change).max(initial=0.0)),
        float(np.abs(quotient[-1]).max(initial=0.0)),
    )


def constant_law(path: ScalarPath, start: Array, gains: Array) -> Array:
    """η̄ constant: η̂ = η̄ + e^{−γI} (η̂(0) − η̄), (g, M, p); arguments as in :func:`scalar_law`.

    That is one step of the law with η̄ linear in I, over which nothing changes.
    """
    final = path.quotient[-1, -1:]
    whole = path.energy.ravel()[-1:]
    zero, count = np.zeros_like(final), len(path.t)
    return kernels.laws.stepped_law(
        whole, final, zero, zero, np.zeros(count, dtype=np.intp), path.energy_at_t,
        np.zeros(count), np.atleast_2d(start), gains,
    )


def linear_law(path: ScalarPath, start: Array, gains: Array) -> Array:
    """η̄ linear in I between neighbouring points: what little it varies is second order.

    Arguments and result, (g, M, p), are :func:`scalar_law`'s.
    """
    energy, quotient = path.energy, path.quotient
    s, p = energy.shape[1] - 1, quotient.shape[2]
    length = np.maximum(np.diff(energy, axis=1), 0.0)
    jump = np.zeros((len(energy), s, p))  # of η̄ between elements; η̂ is continuous
    jump[:-1, -1] = quotient[1:, 0] - quotient[:-1, -1]

    element = path.mesh.sampler(path.t).element
    local = (path.t - path.mesh.edges[element]) / path.mesh.steps[element]
    index = np.clip(np.searchsorted(path.mesh.rule.points, local, side="right") - 1, 0, s - 1)
    step = length[element, index]
    partial = np.clip(path.energy_at_t - energy[element, index], 0.0, step)
    # At the next point itself there is nothing to go from there.
    there = (partial == step) & (index < s - 1)
    index, partial = index + there, np.where(there, 0.0, partial)
    share = np.divide(partial, step, out=np.zeros_like(partial), where=partial > 0)
    return kernels.laws.stepped_law(
        length.ravel(), quotient[:, :-1].reshape(-1, p), np.diff(quotient, axis=1).reshape(-1, p),
        jump.reshape(-1, p), element * s + index, partial, share, np.atleast_2d(start), gains,
    )


def _integrate(path: ScalarPath, start: Array, gains: Array) -> Array:
    """The law on a mesh refined until every gain of the batch is resolved."""
    mesh, p, g = path.mesh, path.quotient.shape[2], len(gains)
    while True:
        delta, Y = path.signals(mesh.points.ravel(), mesh.inside.ravel())
        delta, Y = delta.reshape(mesh.points.shape), Y.reshape(*mesh.points.shape, p)
        values = _solve_batch(mesh, delta, Y, start, gains)  # (K, s + 1, g, p)
        tail = unresolved(values.reshape(*values.shape[:2], g * p), mesh.rule, path.floor)
        poor = tail > _TOLERANCE
        # The signals themselves are known to about 1e-12 of their size; nothing is gained below
        # steps at which they do not change.
        poor &= mesh.steps > 1e-12 * np.maximum(np.abs(mesh.edges[1:]), mesh.steps.max())
        if not poor.any():
            sampled = mesh.sampler(path.t)(values)
            return np.ascontiguousarray(np.swapaxes(sampled, 0, 1))
        parts = np.ones(mesh.size, dtype=np.intp)
        wanted = 1.25 * (tail[poor] / _TOLERANCE) ** (1.0 / mesh.rule.stages)
        parts[poor] = np.clip(np.ceil(wanted), 2, _MAX_PARTS).astype(np.intp)
        if parts.sum() > _MAX_ELEMENTS:
            raise SolverError(
                f"the estimator is not resolved near t = {mesh.edges[int(np.argmax(tail))]:.6g} "
                f"with {_MAX_ELEMENTS} elements; lower its gain"
            )
        mesh, _ = mesh.split(parts)


def _solve_batch(mesh: Mesh, delta: Array, Y: Array, start: Array, gains: Array) -> Array:
    """Collocation of η̂' = γΔ𝐘 − γΔ²η̂ for gains (g, p or 1): point values (K, s + 1, g, p)."""
    rule, (g, lanes), p = mesh.rule, gains.shape, start.shape[-1]
    h = mesh.steps[:, None, None]
    rate = (h * (delta[:, 1:] ** 2)[:, None, :])[:, None] * gains[None, :, :, None]  # (K, g, l, s)
    operator = np.broadcast_to(
        rule.differentiation, (mesh.size, g, lanes, rule.stages, rule.stages)
    ).copy()
    diagonal = np.arange(rule.stages)
    operator[..., diagonal, diagonal] += rate
    forcing = h * delta[:, 1:, None] * Y[:, 1:]  # (K, s, p)
    per_lane = p // lanes  # parameters that share a gain
    right = np.empty((mesh.size, g, lanes, rule.stages, 1 + per_lane))
    right[..., 0] = rule.differentiation.sum(axis=1)
    by_lane = forcing.reshape(mesh.size, rule.stages, lanes, per_lane)
    right[..., 1:] = np.moveaxis(by_lane, 1, 2)[:, None] * gains[None, :, :, None, None]
    solved = np.asarray(np.linalg.solve(operator, right), dtype=np.float64)
    ends = solved[:, :, :, -1]  # (K, g, l, 1 + per_lane)
    starts = affine_scan(ends[..., :1], ends[..., 1:], start.reshape(g, lanes, per_lane))[:-1]
    values = np.empty((mesh.size, rule.stages + 1, g, lanes, per_lane))
    values[:, 0] = starts
    inner = solved[..., :1] * starts[:, :, :, None] + solved[..., 1:]  # (K, g, l, s, per_lane)
    values[:, 1:] = np.moveaxis(inner, 3, 1)
    return values.reshape(mesh.size, rule.stages + 1, g, p)


def scalar_path(
    mesh: Mesh, signals: MixedSignals, delta: Array, quotient: Array, t: Array,
    determinant: Callable[[Array], Array] | None = None, floor: float = 0.0,
) -> ScalarPath:
    """Prepare the law for Δ (K, s + 1) and η̄ (K, s + 1, p), reported at the times t (M,).

    ``determinant`` gives Δ at any times, where that is cheaper than ``signals``.
    """
    energy = integral_of_square(mesh, delta)
    at_t = np.maximum.accumulate(mesh.sampler(t)(energy))
    if determinant is None:
        def determinant(t: Array) -> Array:
            return signals(t, t)[0]
    return ScalarPath(mesh, signals, determinant, quotient, energy, t, at_t, floor)


def integral_of_square(mesh: Mesh, delta: Array) -> Array:
    """I = ∫Δ² of Δ (K, s + 1) at the points of its mesh, (K, s + 1); it never falls."""
    integral = Trajectory(mesh, delta**2).integral().values.ravel()
    return np.asarray(np.maximum.accumulate(integral).reshape(delta.shape))
