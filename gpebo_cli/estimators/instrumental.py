"""DREM with an instrumental variable and averaging: unbiased behind coloured disturbances.

After the idea of Glushchenko and Lastochkin, Instrumental variables based DREM for online
asymptotic identification of perturbed linear systems, arXiv:2312.15631. Y = ψη + w, and an
instrument ζ that has nothing in common with w: the mean of ζY goes to the mean of ζψ times η. Here
ζ is ψ itself as it was d seconds ago, which needs w to forget within d:

    Ω' = (ζψ − Ω)/(T₀ + t),   𝒴' = (ζY − 𝒴)/(T₀ + t),   ζ(t) = ψ(t − d)ᵀ,   then mixing, as in drem.

The instrument is ours, because an estimator sees ψ and no reference signal. Of the paper only the
abstract and introduction were at hand, so these equations need not be its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import WindowedEstimator, gain
from gpebo_cli.estimators._mixed import (
    MixedEstimates,
    RecursiveMixed,
    determinant_and_adjugate,
    mixed_estimates,
    scalar_errors,
)
from gpebo_cli.estimators._recursive import Mixed, mix_sampled
from gpebo_cli.estimators._scalar import mix
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression, with_realisations
from gpebo_cli.regression.resets import ExtensionState, Known
from gpebo_cli.regression.samples import Filter, Past, SampledRegression, ago, delayed


def lagged(regression: LinearRegression, delay: float, t: Array, inside: Array) -> Array:
    """[ψ(t) ; ψ(t − d)]ᵀ (N, 2p, rows) at times t (N,), d in seconds, zero before the start."""
    whole = regression.whole or regression
    start = whole.mesh.edges[0]
    before = whole.psi(np.maximum(t - delay, start), inside - delay)
    before[inside - delay < start] = 0.0
    return np.swapaxes(np.concatenate([regression.psi(t, inside), before], axis=-1), -1, -2)


@dataclass(frozen=True, kw_only=True)
class Instrumental(WindowedEstimator):
    """Means of products with a delayed ψ, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Attributes:
        gamma: γ, also by parameter.
        delay: d of the instrument in seconds.
        settle: T₀ of the means in seconds.
    """

    gamma: object = gain(1e10, by_parameter=True, auto=True)
    delay: float = field(default=0.5, metadata={"positive": True})
    settle: float = field(default=1.0, metadata={"positive": True})

    def means(self, regression: LinearRegression, known: Known) -> Trajectory:
        """Of [ψ(t) ; ψ(t − d)]ᵀ [ψ | Y], shape (2p, p + c): Z' = (product − Z)/(T₀ + t), Z = 0.

        What a disturbance of Y has in common with a factor stays in the mean of that row; the rest
        vanishes as the mean is taken over longer and longer times. The mesh has edges where the
        delayed ψ has. Of a window t counts from the start of the first one, and Z from what is
        ``known``.
        """
        edges, every = regression.mesh.edges, (regression.whole or regression).mesh.edges
        later = every + self.delay
        later = later[slice(*np.searchsorted(later, edges[[0, -1]]))]
        after = np.searchsorted(edges, later)
        apart = np.minimum(edges[after] - later, later - edges[after - 1])
        cuts = np.union1d(edges, later[apart > 1e-12 * (every[-1] - every[0])])
        mesh = Mesh(cuts, regression.mesh.rule)
        t, inside = mesh.points.ravel(), mesh.inside.ravel()
        psi, Y = regression.psi(t, inside), regression.Y(t, inside)
        both = np.concatenate([psi, with_realisations(psi, Y)], axis=-1)
        product = lagged(regression, self.delay, t, inside) @ both
        sums = mesh.trajectory(product).integral().values
        span = (self.settle + mesh.points - every[0])[..., None, None]
        before = known[0].values if known else 0.0
        return Trajectory(mesh, (sums + before * span[0, 0]) / span)

    def recursive(self, parameters: Sequence[str]) -> RecursiveMixed:
        """The estimator at samples."""
        return RecursiveMixed(self, parameters, SampledMeans(self, parameters).update)

    def left(self, means: Array, names: Sequence[str]) -> Array:  # noqa: ARG002
        """What makes p equations of the 2p means (N, 2p, p + c), (N or 1, p, 2p)."""
        return np.eye(2 * len(names))[None, len(names) :]

    def go_on(self, regression: LinearRegression, t: Array, known: Known) -> MixedEstimates:
        """Extend, mix, and keep what the closed form needs at the times t (M,)."""
        names, means = regression.parameters, self.means(regression, known)
        rows = means.values.reshape(-1, *means.values.shape[2:])
        square = (self.left(rows, names) @ rows).reshape(*means.values.shape[:2], len(names), -1)
        extended = Trajectory(means.mesh, square)
        path = mix(extended, np.asarray(t), regression.floor, regression.units)
        return mixed_estimates(
            self, regression, (path,), lambda: (ExtensionState(means.final, 0.0),), known
        )

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δ𝒴' = (ζδY − δ𝒴)/(T₀ + t) of all means, δη̂' = γΔ(adj(Ω) δ𝒴 − Δ δη̂), of every case."""
        names, p = regression.parameters, regression.p
        means = self.means(regression, known)
        began = (regression.whole or regression).mesh.edges[0]

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            rows = means(t, inside)
            left = self.left(rows, names)
            delta, adjugate = determinant_and_adjugate(left @ rows[..., :p])
            rate = 1.0 / (self.settle + t - began)
            rates = np.repeat(rate[:, None], 2 * p, axis=1)
            into = rates[..., None] * lagged(regression, self.delay, t, inside)
            return scalar_errors(rates, into, delta, adjugate @ left, gain)

        return tuple(partial(at, gain) for gain in self.gains("gamma", names))


class SampledMeans:
    """The means at samples, with integrals as the hold has them, and mixing."""

    def __init__(self, settings: Instrumental, parameters: Sequence[str]) -> None:
        self._settings, self._names = settings, parameters
        self._span = settings.settle  # T₀ + t − t₀
        p = len(parameters)
        self._sums = np.zeros((2 * p, p + 1))
        self._past: Past | None = None
        self._late: Array | None = None  # ψ(t − d) at the last sample
        self._start: float | None = None

    def update(self, regression: SampledRegression) -> Mixed:
        """Δ and η̄ at K samples."""
        t, p, rows = regression.t, regression.p, regression.rows
        psi, delay = rows[..., :p], self._settings.delay
        flat = psi[1:].reshape(len(t), -1)
        past = (t[:1], flat[:1]) if self._past is None else self._past
        late, self._past = delayed(past, t, flat, delay, regression.hold)
        self._start = t[0] if self._start is None else self._start
        old, new = regression.shares
        since = ago(t, delay) - self._start  # ψ(t − d) sets in within a step
        of_late = np.where((since >= 0.0) & (since < regression.steps), since, new)
        old, new = old[:, None, None], np.repeat(np.stack([new, of_late], 1), p, axis=1)[..., None]
        before = np.zeros_like(late[:1]) if self._late is None else self._late
        self._late = late[-1:]
        lags = np.concatenate([before, late]).reshape(psi.shape)
        seen = transpose(np.concatenate([psi, lags], axis=-1))  # (K + 1, 2p, rows)
        products = seen @ rows
        sums = self._sums + np.cumsum(old * products[:-1] + new * products[1:], axis=0)
        spans = np.append(self._span, self._span + np.cumsum(regression.steps))[:, None, None]
        self._sums, self._span = sums[-1], float(spans[-1, 0, 0])
        means = sums / spans[1:]
        left = self._settings.left(means, self._names)

        def behind() -> Filter:
            keep = spans[:-1] * np.eye(2 * p)
            return Filter(*(x / spans[1:] for x in (keep, old * seen[:-1], new * seen[1:])))

        return mix_sampled(left @ means, behind, regression.scale, left)


ESTIMATOR = Instrumental
