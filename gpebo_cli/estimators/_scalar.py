"""DREM: extension of the regressor, mixing, and the law η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i) for any gains.

The extension makes a square system Ω η = 𝒴 of Y = ψη, and mixing one scalar equation for each
parameter, 𝐘 = Δ η. In the variable I = ∫Δ² and with η̄ = 𝐘/Δ the law is dη̂/dI = γ (η̄ − η̂). Without
noise η̄ is constant and the law has the closed form η̂ = η̄ + e^{−γI} (η̂(0) − η̄): exact at any gain,
one exponential per gain and time. With noise or forgetting η̄ varies, and where Δ changes sign it
has poles that the law itself does not have. Then the law itself is integrated, by the same L-stable
collocation as everything else, all gains as one batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics.linalg import (
    affine_scan,
    determinant_and_adjugate_action,
    largest_over_time,
    reciprocals,
)
from gpebo_cli.numerics.mesh import Mesh, Trajectory, legendre_tail, unresolved
from gpebo_cli.numerics.refinement import wanted_parts
from gpebo_cli.regression.linear import LinearRegression, refuse_overflow, with_realisations

Pace = Callable[[Array], Array]  # times (N,) -> what γ is multiplied by there (N,)
# (times (N,), inside (N,)) -> Δ (N,), 𝐘 (N, p), and σ_min/σ_max of Ω (N,)
MixedSignals = Callable[[Array, Array], tuple[Array, Array, Array]]

# Relative variation of η̄, weighted by what it can do: below the first η̄ counts as constant, below
# the second as linear in I between neighbouring points, which is then accurate enough.
_CONSTANT, _SMALL = 1e-13, 1e-8
_VANISHING = 1e-11  # of a parameter's largest entry in ψ: less is rounding
_TOLERANCE = 1e-10
MAX_ELEMENTS = 20_000
_ROUNDING = 1e-15  # relative error of Ω; σ_max/σ_min times that is the one of 𝐘/Δ
_UNKNOWN = 0.1  # relative error of 𝐘/Δ from which on it says nothing
_SLACK = 30.0  # how far above its mean rounding may show in a polynomial's last coefficients
_BESIDE = 1e5  # times η̂: 1e-10 of it is left of its digits beside such an η̄
_STRETCH = 2048  # elements that are refined together: memory does not grow with the horizon
_LANES = 1 << 22  # numbers in one batch of gains
# Below this reciprocal condition number of Ω the quotient 𝐘/Δ is rounding noise. It is not needed
# there, because its weight in every law is ∫Δ².
SINGULAR = 1e-14
_FILTERED = 1e-11  # tail of what a filter follows


def kreisselmeier(
    regression: LinearRegression, rates: Array, start: Array | None = None
) -> Trajectory:
    """[Ω | 𝒴] of shape (p, p + c) with Ω' = −Λ(Ω − ψᵀψ), 𝒴' = −Λ(𝒴 − ψᵀY), from ``start``.

    Λ = diag(``rates``): one filter λ_i/(p + λ_i) per row, as in the paper (Section V); all rates
    equal is the classical extension. Since Λ multiplies rows, Ω η = 𝒴 holds for any rates.
    """
    if start is not None:
        return low_pass(regression.outer, rates[:, None], start)
    made, key = regression.filtered, rates.tobytes()
    if key not in made:
        made[key] = low_pass(regression.outer, rates[:, None])
    return made[key]


def low_pass(signal: Trajectory, rate: Array, start: Array | None = None) -> Trajectory:
    """``signal.low_pass(rate)`` on a mesh fine enough for the filter's own transient.

    λ in 1/s is (p,) or whatever broadcasts against the signal. It starts at 0 or ``start``.
    """
    edges = signal.mesh.edges
    smallest = 1e-13 * float(np.abs(edges[[0, -1]]).max())
    fastest = float(np.max(rate))
    while True:
        filtered, mesh = signal.low_pass(rate, start), signal.mesh
        # Where elements are short beside the filter, the signal is what is not resolved.
        poor = (mesh.steps * fastest > 0.5) & (mesh.steps > smallest)
        if poor.any():
            flat = filtered.values.reshape(*filtered.values.shape[:2], -1)
            poor &= unresolved(flat, mesh.rule) > _FILTERED
        if not poor.any():
            return filtered
        signal = mesh.split(np.where(poor, 4, 1))[0].along(signal)


def lion(regression: LinearRegression, rates: Array, start: Array | None = None) -> Trajectory:
    """[Ω | 𝒴] of shape (p, p + c), row i being λ_i/(p + λ_i) of one row of [ψ | Y].

    Of those :func:`lion_rows`: with one output every row is a filtered copy of the same ψ, and
    rates must differ for Ω to be invertible (ConfigError).
    """
    rows = lion_rows(regression)
    refuse_equal(rows, rates)
    psi = regression.psi.values
    both = np.concatenate([psi, with_realisations(psi, regression.Y.values)], axis=-1)
    signal = Trajectory(regression.mesh, both[:, :, rows])
    return low_pass(signal, rates[:, None], start)


def refuse_equal(rows: IntArray, rates: Array) -> None:
    """Filters of equal ``rates`` (p,) for the same of ``rows`` (p,) make Δ zero (ConfigError)."""
    if len({*zip(rows.tolist(), rates.tolist(), strict=True)}) < len(rates):
        raise ConfigError(
            "estimator.lambda: filters of the same row of ψ need rates that differ, because Δ is "
            f"zero otherwise; got {', '.join(f'{rate:g}' for rate in rates)}"
        )


def lion_rows(regression: LinearRegression) -> IntArray:
    """Row i of p takes row i mod r of the r rows in which ψ does not vanish."""
    whole = regression.whole or regression
    size = largest_over_time(whole.psi.values, 2)
    rows = np.flatnonzero((size > _VANISHING * size.max(axis=0, initial=0.0)).any(axis=1))
    return np.resize(rows if len(rows) else np.arange(len(size)), regression.p)


@dataclass(frozen=True, eq=False)
class ScalarPath:
    """The mixed regression along the points of a mesh, and the times at which to report."""

    mesh: Mesh
    signals: MixedSignals
    mixed: Array  # (K, s + 1) Δ
    digits: Array  # (K, s + 1) σ_min/σ_max of Ω, or less by a factor of up to p
    quotient: Array  # (K, s + 1, p) η̄, usable everywhere
    weight: Array  # (K, s + 1) Δ², times the pace
    energy: Array  # (K, s + 1) I, its integral
    t: Array  # (M,)
    energy_at_t: Array  # (M,)
    floor: float  # size below which comparable η̂ is rounding
    pace: Pace | None = None  # None: 1

    def delta(self, t: Array) -> Array:
        """Δ at the times t (N,)."""
        return self.signals(t, t)[0]

    @property
    def clearest(self) -> Array:
        """η̄ (p,) where it is known to the most digits, or half of them, and has the most weight."""
        clear = self.digits >= 0.5 * self.digits.max()
        best = np.where(clear, self.weight, -1.0).argmax()
        return np.asarray(self.quotient.reshape(clear.size, -1)[best])

    def comparable(self, units: Array | float) -> ScalarPath:
        """The same of parameters in units (p,), in which they are comparable."""
        def signals(t: Array, inside: Array) -> tuple[Array, Array, Array]:
            delta, Y, digits = self.signals(t, inside)
            return delta, Y / units, digits

        return replace(self, signals=signals, quotient=self.quotient / units)


class _UnresolvedError(Exception):
    """What η̂ follows is rounding, which no element is short enough for."""


def scalar_law(
    path: ScalarPath, start: Array, gains: Array, units: Array | float = 1.0
) -> Array:
    """Estimates (g, M, p) at the times of the path.

    From η̂ = ``start``, (p,), or (g, p) for each gain its own, with the gains γ (g, p or 1). In
    ``units`` (p,) parameters are comparable.
    """
    start = np.broadcast_to(start, (len(gains), start.shape[-1]))
    if not (path.digits > SINGULAR).any():  # nothing is known, and η̂ does not move
        return start[:, None].repeat(len(path.t), axis=1)
    seen, own = path.comparable(units), start / units
    variation, size = _variation(seen, float(gains.max(initial=0.0)), own)
    # Beside an η̄ of no weight that is larger, such as noise over a Δ of next to nothing, the
    # closed forms would lose η̂.
    known = np.abs(seen.quotient).max(initial=0.0) <= _BESIDE * size
    if variation <= _CONSTANT * size and not _drifts(seen, float(gains.max()), size):
        return constant_law(path, start, gains)
    if variation <= _SMALL * size and known:
        return linear_law(path, start, gains)
    elements = min(path.mesh.size, _STRETCH)
    lanes = elements * path.mesh.points.shape[1] * path.quotient.shape[2] * path.mesh.rule.stages
    batch = max(1, _LANES // lanes)
    try:
        return units * np.concatenate([
            _integrate(seen, own[i : i + batch], gains[i : i + batch])
            for i in range(0, len(gains), batch)
        ])
    except _UnresolvedError:
        # Gains that make up for a Δ of rounding make η̂ follow η̄ from one rounding to the next.
        # Where that ends is compared with least squares.
        return linear_law(path, start, gains)


def _variation(path: ScalarPath, gain: float, start: Array) -> tuple[float, float]:
    """How much η̄ varies from a point to the next, weighted by what that can do, and the size of η̂.

    The weight is the share min(1, γδI) of a step of I that η̂ goes to meet η̄, and the size what
    follows |η̄| by the law. Where the variation is more than nothing, what is rounding of 𝐘/Δ does
    not count.
    """
    quotient = path.quotient
    length = np.maximum(path.energy[:, 1:] - path.energy[:, :-1], 0.0)
    going, own = np.expm1(-gain * length.ravel()), np.abs(quotient).max(axis=2)
    met = -going * np.maximum(own[:, 1:], own[:, :-1]).ravel()
    size = max(affine_scan(1.0 + going, met, np.abs(start).max()).max(), path.floor)
    weight = np.minimum(1.0, gain * length)[..., None]
    change = np.abs(quotient[:, 1:] - quotient[:, :-1])
    much = (weight * change > _CONSTANT * size).any(axis=(1, 2))
    rounding = _SLACK * _ROUNDING / np.maximum(path.digits[much], _ROUNDING)
    change[much] -= size * np.maximum(rounding[:, :-1], rounding[:, 1:])[..., None]
    return float((weight * change).max(initial=0.0)), float(size)


def _drifts(path: ScalarPath, gain: float, size: float) -> bool:
    """Whether small steps of η̄, beside η̂ of a ``size``, add up to more than its rounding."""
    weight = np.minimum(1.0, gain * path.energy)[..., None]
    rounding = _SLACK * _ROUNDING / np.maximum(path.digits, _ROUNDING)
    change = np.abs(path.quotient - path.clearest) - size * rounding[..., None]
    return bool((weight * change).max(initial=0.0) > _CONSTANT * size)


def constant_law(path: ScalarPath, start: Array, gains: Array) -> Array:
    """η̄ constant: η̂ = η̄ + e^{−γI} (η̂(0) − η̄), (g, M, p); arguments as in :func:`scalar_law`.

    That is one step of the law with η̄ linear in I, over which nothing changes. Of all η̄ it is the
    one with the most digits: what grows may leave few of them at the end.
    """
    final = path.clearest[None]
    whole = path.energy.ravel()[-1:]
    zero, count = np.zeros_like(final), len(path.t)
    return kernels.laws.stepped_law(
        whole, final, zero, zero, np.zeros(count, dtype=np.intp), path.energy_at_t,
        np.zeros(count), start, gains,
    )


def linear_law(path: ScalarPath, start: Array, gains: Array) -> Array:
    """η̄ is linear in I between neighbouring points, and its small variation is of second order.

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
    share = np.divide(partial, step, out=np.zeros_like(partial), where=partial > 0)
    return kernels.laws.stepped_law(
        length.ravel(), quotient[:, :-1].reshape(-1, p), np.diff(quotient, axis=1).reshape(-1, p),
        jump.reshape(-1, p), element * s + index, partial, share, start, gains,
    )


def _integrate(path: ScalarPath, start: Array, gains: Array) -> Array:
    """The law itself is integrated, (g, M, p), one stretch of elements after the other."""
    mesh, rule = path.mesh, path.mesh.rule
    out = np.empty((len(gains), len(path.t), path.quotient.shape[2]))
    element = mesh.sampler(path.t).element
    eta, size = start, path.floor
    for first in range(0, mesh.size, _STRETCH):
        piece = Mesh(mesh.edges[first : first + _STRETCH + 1], rule)
        ends = path.quotient[first : first + _STRETCH, -1]
        piece, values = _resolved(path, piece, ends, eta, gains, size)
        eta, size = values[-1, -1], max(size, float(np.abs(values).max()))
        within = (element >= first) & (element < first + _STRETCH)
        sampled = piece.sampler(path.t[within])(values)
        out[:, within] = np.swapaxes(sampled, 0, 1)
    return out


def _resolved(
    path: ScalarPath, mesh: Mesh, ends: Array, start: Array, gains: Array, size: float
) -> tuple[Mesh, Array]:
    """Point values (K, s + 1, g, p) on a stretch of the path's mesh, refined for every gain.

    From η̂ at its start (g, p), with η̄ at the end of each of its elements (K, p).
    """
    maps, noise = _element_maps(path, mesh, ends, gains)
    while True:
        values = _values(maps, start)
        tail = unresolved(values.reshape(*values.shape[:2], -1), mesh.rule, size)
        so_far = np.maximum.accumulate(np.abs(values).max(axis=(1, 2, 3)))
        poor = tail * np.maximum(so_far, size) > np.maximum(_TOLERANCE * so_far, noise)
        # The signals themselves are known to about 1e-12 of their size; nothing is gained below
        # steps at which they do not change.
        poor &= mesh.steps > 1e-12 * np.maximum(np.abs(mesh.edges[1:]), path.mesh.steps.max())
        if not poor.any():
            return mesh, values
        parts = wanted_parts(tail, poor, _TOLERANCE, mesh.rule.stages)
        if parts.sum() > MAX_ELEMENTS:
            raise _UnresolvedError
        finer, kept = mesh.split(parts)
        ends, new = np.repeat(ends, parts, axis=0), kept < 0
        made, made_noise = _element_maps(path, finer, ends, gains, new)
        maps, noise = maps[kept], noise[kept]
        maps[new], noise[new] = made, made_noise
        mesh = finer


def _element_maps(
    path: ScalarPath, mesh: Mesh, ends: Array, gains: Array, chosen: BoolArray | slice = slice(None)
) -> tuple[Array, Array]:
    """What η̂ at the left end makes of it at each node, and to how many digits that is known.

    By collocation of η̂' = γΔ𝐘 − γΔ²η̂. Where the directions of Ω are so unequal that 𝐘/Δ is
    rounding, the law has its closed form with the next η̄ that is known, which has no more error.

    They are (K, g, l, s, 1 + p/l), factor and shifts, l being 1 or p, and the error of η̂ that the
    rounding of 𝐘/Δ makes is (K,).
    """
    points, inside = mesh.points[chosen], mesh.inside[chosen]
    rule, h, (g, lanes), p = mesh.rule, mesh.steps[chosen], gains.shape, ends.shape[1]
    delta, Y, digits = path.signals(points.ravel(), inside.ravel())
    delta, Y = delta.reshape(points.shape)[:, 1:], Y.reshape(*points.shape, p)[:, 1:]
    size, per_lane = len(h), p // lanes  # parameters that share a gain
    scaled = h[:, None] * delta
    if path.pace is not None:
        scaled *= path.pace(points.ravel()).reshape(points.shape)[:, 1:]
    energy = scaled * delta
    rate = energy[:, None, None] * gains[None, :, :, None]  # (K, g, l, s)
    operator = np.broadcast_to(
        rule.differentiation, (size, g, lanes, rule.stages, rule.stages)
    ).copy()
    diagonal = np.arange(rule.stages)
    operator[..., diagonal, diagonal] += rate
    forcing = scaled[..., None] * Y
    right = np.empty((size, g, lanes, rule.stages, 1 + per_lane))
    right[..., 0] = rule.differentiation.sum(axis=1)
    by_lane = np.moveaxis(forcing.reshape(size, rule.stages, lanes, per_lane), 1, 2)
    right[..., 1:] = by_lane[:, None] * gains[None, :, :, None, None]
    maps = np.asarray(np.linalg.solve(operator, right), dtype=np.float64)

    weights = energy * rule.integration[-1]
    total = weights.sum(axis=1)
    rounding = _ROUNDING / np.maximum(digits.reshape(points.shape)[:, 1:], _ROUNDING)
    some = total > 0.0
    mean = np.divide((weights * rounding).sum(axis=1), total, out=np.ones(size), where=some)
    unknown = mean > _UNKNOWN
    passed = np.maximum(np.maximum.accumulate(energy[unknown] @ rule.integration.T, axis=1), 0.0)
    decay = np.exp(-passed[:, None, None] * gains[None, :, :, None])
    maps[unknown, ..., 0] = decay
    maps[unknown, ..., 1:] = (1.0 - decay)[..., None] * ends[chosen][unknown].reshape(
        -1, 1, lanes, 1, per_lane
    )
    quotient = np.abs(Y).max(axis=2) / np.where(delta, np.abs(delta), 1.0)
    error = (weights * rounding * quotient).sum(axis=1)
    stiff = gains.max() / (1.0 + gains.max() * total)
    return maps, np.where(unknown, np.inf, _SLACK * error * stiff)


def _values(maps: Array, start: Array) -> Array:
    """Point values (K, s + 1, g, p) from ``start`` (g, p)."""
    size, g, lanes, stages, columns = maps.shape
    last = maps[:, :, :, -1]
    starts = affine_scan(last[..., :1], last[..., 1:], start.reshape(g, lanes, columns - 1))[:-1]
    values = np.empty((size, stages + 1, g, lanes, columns - 1))
    values[:, 0] = starts
    values[:, 1:] = np.moveaxis(maps[..., :1] * starts[:, :, :, None] + maps[..., 1:], 3, 1)
    return values.reshape(size, stages + 1, g, -1)


def scalar_path(
    mesh: Mesh, signals: MixedSignals, delta: Array, digits: Array, quotient: Array, t: Array,
    floor: float, pace: Pace | None = None,
) -> ScalarPath:
    """Prepare the law for Δ, digits (K, s + 1) and η̄ (K, s + 1, p), reported at times t (M,)."""
    weight = delta**2
    if pace is not None:
        weight *= pace(mesh.points.ravel()).reshape(delta.shape)
    energy = np.maximum.accumulate(Trajectory(mesh, weight).integral().values.ravel())
    energy = energy.reshape(delta.shape)  # ∫Δ² never falls
    at_t = np.maximum.accumulate(mesh.sampler(t)(energy))
    return ScalarPath(
        mesh, signals, delta, digits, quotient, weight, energy, t, at_t, floor, pace
    )


def resolved_for(path: ScalarPath, gains: Array) -> ScalarPath:
    """The path with elements within which e^{−γI} is known, for all of the gains (g, 1 or p).

    Δ may grow by orders of magnitude within an element that resolves Ω, and what a large gain
    makes of I is decided where Δ is smallest.
    """
    least, most = float(gains.min(initial=np.inf)), float(gains.max(initial=0.0))
    before: Array | float = np.inf  # what was lost in the element that each one was cut from
    while True:
        mesh, begin = path.mesh, path.energy[:, 0]
        size = np.maximum(path.weight.max(axis=1), np.finfo(float).tiny)[:, None]
        tail = mesh.steps * legendre_tail(path.weight[..., None], mesh.rule, size)[:, 0]
        gain = np.clip(1.0 / np.maximum(begin, np.finfo(float).tiny), least, most)
        lost = gain * tail * np.exp(-gain * begin)
        # A quarter of an element has a quarter of what is rounding, and much less of what is not.
        poor = (lost > _TOLERANCE) & (lost < 0.05 * before)
        if not poor.any() or mesh.size > MAX_ELEMENTS:
            return path
        parts = np.where(poor, 4, 1)
        mesh, kept = mesh.split(parts)
        before, new = np.where(poor, lost, before).repeat(parts), kept < 0
        delta, digits, quotient = path.mixed[kept], path.digits[kept], path.quotient[kept]
        found, Y, digits[new] = (
            x.reshape(-1, *delta.shape[1:], *x.shape[1:])
            for x in path.signals(mesh.points[new].ravel(), mesh.inside[new].ravel())
        )
        delta[new] = found
        quotient[new] = Y / np.where(found, found, 1.0)[..., None]
        quotient = filled(quotient, digits > SINGULAR)
        path = scalar_path(
            mesh, path.signals, delta, digits, quotient, path.t, path.floor, path.pace
        )


def mix(
    extended: Trajectory, t: Array, floor: float = 0.0, units: Array | float = 1.0
) -> ScalarPath:
    """Mix [Ω | 𝒴] (p, p + c): the path that the scalar law takes, reported at the times t (M,).

    The law takes c realisations as p·c parameters, in the order of (p, c). Whether Ω is singular is
    judged in ``units`` (p,) in which parameters are comparable (SolverError: Ω or Δ² is beyond what
    a number can be; names the time).
    """
    p, mesh = extended.values.shape[-2], extended.mesh
    refuse_overflow("Ω, which is made of squares of ψ,", mesh, extended.values)
    units = np.broadcast_to(units, p)[:, None]
    size = float(np.prod(units))
    if (units != 1.0).any():
        columns = np.append(units, np.ones(extended.values.shape[-1] - p))
        extended = Trajectory(mesh, extended.values * units * columns)

    def signals(t: Array, inside: Array) -> tuple[Array, Array, Array]:
        values = extended(t, inside)
        delta, Y, digits = determinant_and_adjugate_action(values[..., :p], values[..., p:])
        return delta / size / size, (units * Y / size / size).reshape(len(t), -1), digits

    whole, points = extended.values, extended.values.shape[:2]
    # 𝐘 = adj(Ω) 𝒴 itself is not needed for the quotient: where Δ ≠ 0 it solves Ω η̄ = 𝒴.
    delta, quotient, condition = kernels.laws.mixed(whole.reshape(-1, *whole.shape[2:]), None)
    delta, quotient = delta / size / size, units * quotient
    usable = (delta != 0.0) & (condition * SINGULAR < 1.0)  # False for nan, too
    digits = reciprocals(condition, usable)
    refuse_overflow("Δ² of Δ = det(Ω)", mesh, delta.reshape(points) ** 2)
    return scalar_path(
        mesh, signals, delta.reshape(points), digits.reshape(points),
        filled(quotient.reshape(*points, -1), usable), t, floor,
    )


def filled(quotient: Array, usable: BoolArray) -> Array:
    """Replace unusable rows of η̄ (K, s + 1, p) by the next usable one (the last, at the end)."""
    flat, index = usable.ravel(), np.arange(usable.size)
    if not flat.any():
        return np.zeros_like(quotient)
    following = np.minimum.accumulate(np.where(flat, index, usable.size)[::-1])[::-1]
    chosen = np.minimum(following, np.flatnonzero(flat)[-1])
    return np.asarray(quotient.reshape(usable.size, -1)[chosen].reshape(quotient.shape))
