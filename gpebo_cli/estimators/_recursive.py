"""Estimators in discrete time: one update per sample, memory that does not grow.

Least squares is kept as a triangular factor S of [G_z | h_z] (square-root information form),

    SᵀS = ∫ (z(t)/z(s)) [ψ | Y]ᵀ[ψ | Y] ds,

updated by an orthogonal transformation of [√(z₊/z) S; √h [ψ | Y]]: no squares are formed, so G_z
may have the square of the condition number that normal equations survive. All gains of least
squares and of LS+DREM share S. The scalar law is a closed form over each sample, stable for any
gain and any sample time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from gpebo_cli.estimators._information import Spectrum
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.kernels.laws_numpy import mean_decay
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import (
    affine_scan,
    determinant_and_adjugate_action,
    reciprocals,
    transpose,
)
from gpebo_cli.regression.errors import ErrorRecursion
from gpebo_cli.regression.estimator import SampledEstimates
from gpebo_cli.regression.samples import Filter, SampledRegression

_SINGULAR = 1e-10  # below this ratio of singular values of S the quotient 𝐘/Δ is rounding
_SINGULAR_FILTER = 1e-14  # the same for Ω, where squares have been formed
_TINY = float(np.finfo(np.float64).tiny)


class InformationRoot:
    """S, one for each forgetting rate β."""

    def __init__(self, p: int, beta: Array) -> None:
        self._beta = beta  # (D,)
        self._root = np.zeros((len(beta), p + 1, p + 1))
        self.memory = np.ones(len(beta))  # z

    def update(self, regression: SampledRegression) -> tuple[Array, Array]:
        """S (K, D, p + 1, p + 1) and z (K, D) at the samples."""
        decay = np.exp(-0.5 * regression.steps[:, None] * self._beta)  # √(z₊/z)
        rows = regression.weighted()
        K, D = decay.shape
        size = self._root.shape[-1]
        out = np.empty((K, D, size, size))
        stacked = np.empty((D, size + rows.shape[1], size))
        for k in range(K):
            stacked[:, :size] = decay[k][:, None, None] * self._root
            stacked[:, size:] = rows[k]
            out[k] = np.linalg.qr(stacked, mode="r")
            self._root = out[k]
        self._root = out[-1].copy()  # not a view that keeps all of them
        memory = np.maximum(self.memory * np.cumprod(decay**2, axis=0), _TINY)
        self.memory = memory[-1]
        return out, memory


def spectrum(root: Array, memory: Array, units: Array | None = None) -> Spectrum:
    """G_z = V diag(σ²) Vᵀ and Vᵀh_z = σ c from S = [U diag(σ) Vᵀ | U c], shape (K, …).

    With units (K, p) it is about the parameters in these.
    """
    p = root.shape[-1] - 1
    own = root[..., :p, :p] if units is None else root[..., :p, :p] / units[:, None]
    U, sigma, Vt = np.linalg.svd(own)
    order = np.arange(p)[::-1]  # ascending, as of eigenvalues
    U, sigma, vectors = U[..., order], sigma[..., order], transpose(Vt[..., order, :])
    if units is not None:
        vectors = vectors / units[..., None]
    coordinates = np.swapaxes(U, -1, -2) @ root[..., :p, p:]
    return Spectrum(sigma**2, vectors, sigma[..., None] * coordinates, memory, units)


def quotient_of(s: Spectrum) -> tuple[Array, BoolArray, Array]:
    """𝐘/Δ = G_z⁻¹ h_z (K, p), where it is more than rounding (K,), and G_z⁻¹ there (K, p, p)."""
    largest = s.eigenvalues.max(axis=1, initial=0.0)
    usable = (s.eigenvalues > _SINGULAR**2 * largest[:, None]).all(axis=1) & (largest > 0.0)
    inverse = reciprocals(s.eigenvalues, usable[:, None])
    whole = (s.vectors * inverse[:, None]) @ transpose(s.vectors)
    quotient = s.without_rounding(s.vectors @ (inverse[..., None] * s.rotated))
    return quotient[..., 0], usable, whole


class ScalarLaw:
    """η̂' = γΔ(𝐘 − Δη̂) over each sample, for D mixed regressions with g gains each.

    With μ < 1 its estimates are (η̂ − w_c η̂(0))/(1 − w_c), w_c = min(e^{−γ∫Δ²}, 1 − μ).
    """

    def __init__(
        self, start: Array, gains: Array, groups: int, mu: float = 1.0, needed: float = DECAY
    ) -> None:
        self._start, self.mu, self._needed = start, mu, needed  # of γ∫Δ²
        self.gains = gains  # (g, 1 or p)
        self._eta = np.broadcast_to(start, (groups, len(gains), len(start))).copy()
        self._steps = Steps()
        self.energy = np.zeros(groups)  # ∫Δ² so far, (D,)
        self._inverse: list[Array] | None = None  # Q of the last sample of each group

    def update(
        self, regression: SampledRegression, delta: Array, quotient: Array, usable: BoolArray,
        behind: Callable[[], tuple[Sequence[Filter], Sequence[Array]]] | None = None,
        pace: Array | float = 1.0,
    ) -> SampledEstimates:
        """One closed-form step per sample, for what :class:`Mixed` has, (K, D) and (K, D, p).

        Where η̄ is rounding its weight Δ² is nothing.
        """
        energy, previous, had = self._steps.update(
            regression, pace * delta**2, quotient, usable
        )
        x = self.gains * energy[:, :, None, None]  # (K, D, g, 1 or p)
        decay = np.exp(-x)
        new, old = quotient[:, :, None], np.where(had[..., None], previous, quotient)[:, :, None]
        # η̄ is that of the new sample, or linear in ∫Δ² between both.
        of_new, of_old = _shares(x, decay, regression.hold)
        eta = affine_scan(decay, of_new * new + of_old * old, self._eta)[1:]  # (K, D, g, p)
        self._eta = eta[-1]
        so_far = self.energy + np.cumsum(energy, axis=0)
        self.energy = so_far[-1]
        met = self.gains.min() * so_far.min(axis=1) >= self._needed
        w_c = np.minimum(np.exp(-self.gains * so_far[:, :, None, None]), 1.0 - self.mu)
        eta = (eta - w_c * self._start) / (1.0 - w_c)
        K, D, g, p = eta.shape
        parameters = np.moveaxis(eta.reshape(K, D * g, p), 0, 1)
        shown = delta.T if D == 1 else np.repeat(delta.T, g, axis=0)
        return SampledEstimates(
            parameters, shown,
            behind and (lambda: self._errors(*behind(), decay, of_new, of_old, had, 1.0 - w_c)),
            met,
        )

    def _errors(
        self, filters: Sequence[Filter], quotients: Sequence[Array],
        decay: Array, of_new: Array, of_old: Array, had: BoolArray, share: Array,
    ) -> tuple[ErrorRecursion, ...]:
        """The systems of the filters' errors and of η̂ behind them, for each case of an update."""
        out = []
        before, self._inverse = self._inverse, [Q[-1:] for Q in quotients]
        for d, (own, Q) in enumerate(zip(filters, quotients, strict=True)):
            previous = np.concatenate([Q[:1] if before is None else before[d], Q[:-1]])
            K, p, s = Q.shape
            for g in range(decay.shape[2]):
                keep, new, old, by = (
                    np.broadcast_to(each[:, d, g], (K, p))[:, :, None]
                    for each in (decay, of_new, of_old, share)
                )
                both = had[:, d, None, None]
                on_new, on_old = (new + np.where(both, 0.0, old)) * Q, np.where(both, old, 0.0)
                whole = in_series(own, keep * np.eye(p), on_new, on_old * previous)
                out.append(ErrorRecursion(*whole, np.eye(p, s + p, s) / by))
        return tuple(out)


def in_series(own: Filter, keep: Array, of_new: Array, of_old: Array) -> Filter:
    """A filter of f (s,) and what is behind it, z' = keep z + of_new f' + of_old f with z (q,)."""
    (K, s), q = own.A.shape[:2], keep.shape[-1]
    A = np.zeros((K, s + q, s + q))
    A[:, :s, :s], A[:, s:, :s], A[:, s:, s:] = own.A, of_new @ own.A + of_old, keep
    return Filter(A, *(np.concatenate([x, of_new @ x], axis=1) for x in (own.old, own.new)))


class Mixed(NamedTuple):
    """𝐘 = Δη at K samples, as :class:`ScalarLaw` takes it, in D groups."""

    delta: Array  # Δ (K, D)
    quotient: Array  # η̄ = 𝐘/Δ (K, D, p)
    usable: BoolArray  # where η̄ is more than rounding (K, D)
    # Of each group the filter of 𝒴, and what η̄ is of 𝒴 (K, p, p), zero where it is rounding.
    behind: Callable[[], tuple[Sequence[Filter], Sequence[Array]]]
    pace: Array | float = 1.0  # what γ is multiplied by (K, D)


def over_steps(regression: SampledRegression, values: Array, before: Array) -> Array:
    """Integrals over the steps (K, …) of values at the samples, (1, …) the one ``before`` them."""
    old, new = (share.reshape(-1, *[1] * (values.ndim - 1)) for share in regression.shares)
    return np.asarray(old * np.concatenate([before, values[:-1]]) + new * values)


class Steps:
    """The steps between samples of a mixed regression; it remembers the last sample."""

    def __init__(self) -> None:
        self._last: tuple[Array, Array, BoolArray] | None = None

    def update(
        self, regression: SampledRegression, weight: Array, quotient: Array, usable: BoolArray
    ) -> tuple[Array, Array, BoolArray]:
        """∫ weight (K, D), and of the sample before each η̄ (K, D, p) and whether it was usable.

        Arguments are weight (K, D), η̄ (K, D, p), and where that is more than rounding (K, D).
        """
        known = np.zeros_like(weight[:1]), quotient[:1], np.zeros_like(usable[:1])
        before, previous, was = known if self._last is None else self._last
        self._last = weight[-1:], quotient[-1:], usable[-1:]
        energy = np.where(usable, over_steps(regression, weight, before), 0.0)
        return (
            energy, np.concatenate([previous, quotient[:-1]]), np.concatenate([was, usable[:-1]])
        )

    def means(
        self, regression: SampledRegression, weight: Array, mixed: Mixed
    ) -> tuple[Array, Array, BoolArray]:
        """∫ weight (K,), η̄ (K, p) of the steps, and where that is of both ends; in one group.

        It is that of the new sample, or with lines between samples the mean.
        """
        energy, previous, had = self.update(regression, weight, mixed.quotient, mixed.usable)
        both = had & mixed.usable & (regression.hold != "zoh")
        mean = 0.5 * (mixed.quotient + previous)
        return energy[:, 0], np.where(both[..., None], mean, mixed.quotient)[:, 0], both[:, 0]


def _shares(x: Array, decay: Array, hold: str) -> tuple[Array, Array]:
    """What a first-order lag over x time constants takes of its input's new and old end."""
    if hold == "zoh":
        return -np.expm1(-x), np.zeros_like(x)
    mean = mean_decay(x)
    return 1.0 - mean, mean - decay


class KreisselmeierFilter:
    """Ω' = −Λ(Ω − ζψ) over each sample, exact for ζψ as the hold rule has it between samples."""

    def __init__(self, rates: Array) -> None:
        self._rates = rates[:, None]  # one per row
        self._value = np.zeros((len(rates), len(rates) + 1))

    def update(self, regression: SampledRegression) -> Array:
        """[Ω | 𝒴] (K, p, p + 1) at the samples."""
        x = self._rates * regression.steps[:, None, None]  # (K, p, 1)
        decay = np.exp(-x)
        of_new, of_old = _shares(x, decay, regression.hold)
        kept, old, new = self.seen(regression)
        self._last = decay, old, new = kept * decay, of_old * old, of_new * new
        taken = new @ regression.rows[1:] + old @ regression.rows[:-1]
        values = affine_scan(decay, taken, self._value)[1:]
        self._value = values[-1]
        return values

    def seen(self, regression: SampledRegression) -> tuple[Array | float, Array, Array]:
        """0 where a step starts anew, else 1, and ζ = ψᵀ at its ends, (K, p, rows) each."""
        zeta = transpose(regression.rows[..., : regression.p])
        return 1.0, zeta[:-1], zeta[1:]

    def errors(self) -> Filter:
        """What the filter of 𝒴 does to errors of Y, over the steps of the last update."""
        decay, old, new = self._last
        return Filter(decay * np.eye(len(self._rates)), old, new)


def mix_sampled(
    extended: Array, behind: Callable[[], Filter], scale: Array | float, left: Array | float = 1.0
) -> Mixed:
    """Of one group, from [Ω | 𝒴] (K, p, p + 1), 𝒴 being what filters ``behind`` have, or ``left``.

    That is a matrix (K or 1, p, s) times what they have. Whether Ω is singular is judged beside the
    ``scale`` (K, p) of the columns of ψ.
    """
    p = extended.shape[1]
    units = np.where(np.greater(scale, 0.0), scale, 1.0) * np.ones((len(extended), p))
    units = np.exp2(-np.rint(np.log2(units)))  # no digit changes
    omega, size = units[:, :, None] * extended[..., :-1] * units[:, None], units.prod(axis=1)

    def solved(rhs: Array) -> tuple[Array, Array, BoolArray]:
        """Δ (K,), Ω⁻¹b (K, p, c), zero where that is rounding, and where it is not (K,)."""
        own = units[:, :, None]
        delta, action, reciprocal = determinant_and_adjugate_action(omega, own * rhs)
        usable = np.asarray((reciprocal > _SINGULAR_FILTER) & (delta != 0.0))
        zero, where = np.zeros_like(action), usable[:, None, None]
        found = own * np.divide(action, delta[:, None, None], out=zero, where=where)
        return delta / size / size, found, usable

    def errors() -> tuple[list[Filter], list[Array]]:
        inverse = solved(np.broadcast_to(np.eye(p), omega.shape))[1]
        return [behind()], [inverse if isinstance(left, float) else inverse @ left]

    delta, quotient, usable = solved(extended[..., -1:])
    return Mixed(delta[:, None], quotient[:, None, :, 0], usable[:, None], errors)
