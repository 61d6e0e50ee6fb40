"""DREM with power laws: one below 1 gives a finite time, one above 1 beside it a fixed time.

    η̂_i' = Δ (γ ⌈r_i⌋^α + γ₂ ⌈r_i⌋^β),   r = 𝐘 − Δ η̂,   ⌈r⌋^α = sign(r) |r|^α,   0 < α < 1 < β

after Wang, Efimov and Bobtsov, On robust parameter estimation in finite-time without persistence
of excitation, IEEE TAC 65(4), 2020; this form is that of drem.hpp in SDU-Robotics/sdu_estimators.
Without noise and with γ₂ = 0 an error e is zero from γ(1 − α)∫|Δ|^{1+α} = |e(0)|^{1−α} on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.estimators._base import ResumableEstimator, gain
from gpebo_cli.estimators._mixed import MixedEstimates, energy_requirement
from gpebo_cli.estimators._recursive import Steps
from gpebo_cli.estimators._scalar import SINGULAR, ScalarPath
from gpebo_cli.estimators.drem import Drem
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics.mesh import Trajectory, legendre_tail
from gpebo_cli.regression.estimator import SampledEstimates
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known
from gpebo_cli.regression.samples import SampledRegression

_TOLERANCE, _ROUNDING = 1e-11, 1e-15
_INSIDE = 1e-3  # of a step: which element a node belongs to
_ITERATIONS = 12  # of Newton's method
_NOTHING = 1e-290  # next to the smallest number
_STRETCH = 2048  # elements whose signals are held
_SHORTEST = 1e-11  # steps, relative to the element


@dataclass(frozen=True, kw_only=True)
class Power(ResumableEstimator):
    """Kreisselmeier filters, mixing, and a power of each scalar residual.

    Attributes:
        gamma: γ, also by parameter.
        alpha: α, between 0 and 1.
        gamma2: γ₂; 0 is the finite-time law, more than 0 the fixed-time one.
        beta: β, above 1.
        rates: λ of the filters, as of ``drem``.
    """

    gamma: object = gain(1e10, by_parameter=True, auto=True)
    alpha: float = 0.5
    gamma2: float = 0.0
    beta: float = 1.5
    rates: object = field(default=None, metadata={"key": "lambda"})

    def axes(self) -> dict[str, Sequence[float]]:
        """The gain γ (ConfigError: a power or γ₂ is out of its range)."""
        if not (0.0 < self.alpha < 1.0 < self.beta and self.gamma2 >= 0.0):
            raise ConfigError(
                "estimator: it takes 0 < alpha < 1 < beta and gamma2 of 0 or more, got "
                f"alpha={self.alpha:g}, beta={self.beta:g}, gamma2={self.gamma2:g}"
            )
        return super().axes()

    def recursive(self, parameters: Sequence[str]) -> RecursivePower:
        """The finite-time law at samples.

        ConfigError: γ₂ is not zero; the fixed-time law has no closed form.
        """
        if self.gamma2:
            raise ConfigError(
                "estimator.gamma2 works in continuous time only; at samples leave it 0"
            )
        return RecursivePower(self, parameters)

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> PowerEstimates:
        """Extend and mix as ``drem``, for the times t (M,)."""
        inner = vars(self.part(Drem).resume(regression, t, known))
        return PowerEstimates(**inner, alpha=self.alpha, beta=self.beta, gamma2=self.gamma2)


@dataclass(frozen=True, eq=False, kw_only=True)
class PowerEstimates(MixedEstimates):
    """The errors of ``drem``, with the power law."""

    alpha: float
    beta: float
    gamma2: float

    @cached_property
    def energies(self) -> list[float]:
        """∫|Δ|^{1+α}, with what was known before."""
        (path,), (before,) = self.groups, self.before
        powers = Trajectory(path.mesh, np.abs(path.mixed) ** (1.0 + self.alpha))
        return [before + float(powers.integral().final)]

    @property
    def requirement(self) -> Requirement:
        """γ∫|Δ|^{1+α} at the end, against what the errors of the start need to be zero."""
        (path,), (energy,) = self.groups, self.energies
        start = np.repeat(self.start, path.quotient.shape[-1] // len(self.start))
        error = float(np.abs(path.quotient[-1, -1] - start).max(initial=0.0))
        return power_requirement(self.alpha, self.gains, energy, error)

    def law(self, path: ScalarPath, start: Array, gains: Array) -> Array:
        """η̂ (g, M, P) at the path's times, from ``start`` (P,) or (g, P), for gains (g, P or 1).

        Elements are steps, one after the other; whether they resolve the law is looked at for many
        at once. In one that does not every gain and parameter has steps of its own, because errors
        reach zero at different times (SolverError: steps become too short).
        """
        mesh, P = path.mesh, path.quotient.shape[-1]
        shape = (len(gains), P)
        eta, gamma = (np.broadcast_to(x, shape).ravel().copy() for x in (start, gains))
        column = np.tile(np.arange(P), len(gains))
        out = np.empty((len(eta), len(path.t)))
        stops = np.searchsorted(path.t, mesh.edges, side="right")
        out[:, : stops[0]] = eta[:, None]
        first, count = 0, 1
        while first < mesh.size:
            part = slice(first, min(first + count, mesh.size))
            values, good = self._whole(path, part, eta, gamma, column)
            done = len(good) if good.all() else int(np.argmin(good))
            at = np.arange(done).repeat(np.diff(stops[first : first + done + 1]))
            some = slice(stops[first], stops[first + done])
            share = (path.t[some] - mesh.edges[first + at]) / mesh.steps[first + at]
            weights = mesh.rule.interpolation(share)
            out[:, some] = np.einsum("mi,mni->nm", weights, values[at])
            eta = values[done - 1, :, -1] if done else eta
            first, count = first + done, min(2 * count, _STRETCH)
            if done < len(good):
                some = slice(stops[first], stops[first + 1])
                eta = self._in_parts(path, first, eta, gamma, column, path.t[some], out[:, some])
                first, count = first + 1, 1
        return np.moveaxis(out.reshape(*shape, -1), 1, 2)

    def _whole(
        self, path: ScalarPath, part: slice, eta: Array, gamma: Array, column: IntArray
    ) -> tuple[Array, BoolArray]:
        """η̂ (K, n, s + 1) of n laws over some elements, and which of these are resolved (K,)."""
        delta, h = path.mixed[part, None, 1:], path.mesh.steps[part, None]
        digits = path.digits[part, None, 1:]
        goal = np.moveaxis(path.quotient[part, 1:, column], -1, 1)
        values, change = np.empty((*goal.shape[:2], goal.shape[2] + 1)), np.empty(goal.shape[:2])
        for k, Y in enumerate(delta * goal):
            values[k], change[k] = self._step(path, h[k], eta, gamma, delta[k], Y, digits[k])
            eta = values[k, :, -1]
        good = _resolved(path, values, change, delta, digits)
        return values, np.asarray(good.all(axis=1))

    def _in_parts(
        self, path: ScalarPath, k: int, eta: Array, gamma: Array, column: IntArray, t: Array,
        out: Array,
    ) -> Array:
        """η̂ (n,) of n laws at the end of an element, from its start; at the times t in ``out``."""
        left, length = path.mesh.edges[k], path.mesh.steps[k]
        places = (t - left) / length
        at, step = np.zeros(len(eta)), np.full(len(eta), 0.25)  # shares of the element
        while (lanes := np.flatnonzero(at < 1.0)).size:
            begin = at[lanes]
            end = begin + step[lanes]
            end = np.where(end > 1.0 - 1e-9, 1.0, end)
            pairs, of = np.unique(left + length * np.stack([begin, end]), axis=1,
                                  return_inverse=True)
            delta, Y, digits = (x[of] for x in _signals(path, *pairs))
            Y = Y[np.arange(len(lanes)), :, column[lanes]]
            h = length * (end - begin)
            values, change = self._step(path, h, eta[lanes], gamma[lanes], delta, Y, digits)
            good = _resolved(path, values, change, delta, digits)
            step[lanes] *= np.where(good, 2.0, 0.25)
            if step.min() < _SHORTEST:
                raise SolverError(f"the power law is not resolved near t = {left:.6g}")
            within = (places > begin[:, None]) & (places <= end[:, None])
            lane, j = np.nonzero(good[:, None] & within)
            weights = path.mesh.rule.interpolation((places[j] - begin[lane]) / (end - begin)[lane])
            out[lanes[lane], j] = np.einsum("ni,ni->n", weights, values[lane])
            eta[lanes] = np.where(good, values[:, -1], eta[lanes])
            at[lanes] = np.where(good, end, begin)
        return eta

    def _step(
        self, path: ScalarPath, h: Array, eta: Array, gamma: Array, delta: Array, Y: Array,
        digits: Array,
    ) -> tuple[Array, Array]:
        """η̂ (n, s + 1) of n laws over steps h (n,) along signals (n, s), and its last change (n,).

        Unknown are w = ⌈r⌋^α at the nodes: ⌈w_i⌋^{1/α} = 𝐘_i − Δ_i η̂_i is smooth in them where a
        power of r is not, and η̂ follows by integration. Steps and Δ may be the same for all laws.
        """
        # Where 𝐘/Δ is rounding nothing is known, and the estimate does not move.
        delta, Y = (np.where(_known(delta, digits), x, 0.0) for x in (delta, Y))
        rest = Y - delta * eta[:, None]
        integral = h[:, None, None] * path.mesh.rule.integration * delta[:, None]
        coupling, gamma = delta[:, :, None] * integral, gamma[:, None]
        w, before = np.sign(rest) * np.abs(rest) ** self.alpha, np.full_like(rest, np.inf)
        ratio, root = self.beta / self.alpha, 1.0 / self.alpha
        scale = _scale(path, eta)
        for _ in range(_ITERATIONS):
            size = np.abs(w)
            speed, slope = gamma * w, gamma
            if self.gamma2:
                speed = speed + self.gamma2 * np.sign(w) * size**ratio
                slope = slope + self.gamma2 * ratio * size ** (ratio - 1.0)
            moved = (integral @ speed[..., None])[..., 0]
            change = np.abs(moved - before).max(axis=1) / scale
            if (change < 1e-3 * _TOLERANCE).all():
                break
            J = coupling * slope[:, None]
            diagonal = np.einsum("nii->ni", J)  # a view
            diagonal += root * size ** (root - 1.0)
            # Where nothing is left of Δ and r nothing moves.
            diagonal += J.max(axis=2) <= _NOTHING
            F = np.copysign(size**root, w) + delta * moved - rest
            w, before = w - np.linalg.solve(J, F[..., None])[..., 0], moved
        return np.concatenate([eta[:, None], eta[:, None] + moved], axis=1), change


def _known(delta: Array, digits: Array) -> BoolArray:
    """Where 𝐘/Δ is more than rounding."""
    return np.asarray((digits > SINGULAR) & (delta != 0.0))


def _scale(path: ScalarPath, eta: Array) -> Array:
    """What errors of η̂ (…) are compared with."""
    return np.maximum(np.abs(eta), max(np.abs(path.quotient[-1]).max(), path.floor, 1e-300))


def _resolved(
    path: ScalarPath, values: Array, change: Array, delta: Array, digits: Array
) -> BoolArray:
    """Which steps (…) with η̂ (…, s + 1) are resolved, by their tail and the last change (…)."""
    scale, rule = _scale(path, values[..., 0]), path.mesh.rule
    flat = values.reshape(-1, values.shape[-1], 1)
    tail = legendre_tail(flat, rule, scale.reshape(-1, 1)).reshape(scale.shape) / scale
    worst = np.where(_known(delta, digits), digits, 1.0).min(axis=-1)
    allowed = np.maximum(_TOLERANCE, 30.0 * _ROUNDING / worst)
    return np.asarray((tail < allowed) & (change < allowed))


def _signals(path: ScalarPath, left: Array, right: Array) -> tuple[Array, Array, Array]:
    """Δ (n, s), 𝐘 (n, s, P) and digits (n, s) at the nodes of steps (n,)."""
    rule = path.mesh.rule
    h = (right - left)[:, None]
    places = left[:, None] + h * rule.points
    places[:, -1] = right
    inside = places.clip(places[:, :1] + _INSIDE * h, places[:, -1:] - _INSIDE * h)
    delta, Y, digits = path.signals(places[:, 1:].ravel(), inside[:, 1:].ravel())
    shape = len(left), rule.stages
    return delta.reshape(shape), Y.reshape(*shape, -1), digits.reshape(shape)


class RecursivePower:
    """The law over each sample, exact where 𝐘/Δ is constant: as it is there, or in the middle.

    The error e = 𝐘/Δ − η̂ has |e|^{1−α} = |e₀|^{1−α} − (1 − α) γ ∫|Δ|^{1+α}, until it is zero.
    """

    def __init__(self, settings: Power, parameters: Sequence[str]) -> None:
        self._mixing, self._steps = settings.part(Drem).mixing(parameters), Steps()
        self._alpha, self._gains = settings.alpha, settings.gains("gamma", parameters)
        self._start = settings.start(parameters)
        self._eta = np.broadcast_to(self._start, (len(self._gains), len(self._start)))
        self._energy, self._error = 0.0, 0.0

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each; nobody knows how errors go through."""
        mixed, rest = self._mixing(regression), 1.0 - self._alpha
        powers = np.abs(mixed.delta) ** (1.0 + self._alpha)
        energy, goal, _ = self._steps.means(regression, powers, mixed)
        out = np.empty((len(self._eta), len(goal), goal.shape[1]))
        for k, towards in enumerate(goal):
            error = towards - self._eta
            size, gone = np.abs(error), rest * self._gains * energy[k]
            share = np.minimum(gone / np.maximum(size**rest, np.maximum(gone, _NOTHING)), 1.0)
            # What is left of a large error would hide how far η̂ moves.
            with np.errstate(divide="ignore"):
                moved = error * -np.expm1(np.log1p(-share) / rest)
            self._eta = np.where(share < 1.0, self._eta + moved, towards)
            out[:, k] = self._eta
        self._energy += float(energy.sum())
        if mixed.usable.any():
            last = mixed.quotient[np.flatnonzero(mixed.usable)[-1], 0]
            self._error = float(np.abs(last - self._start).max(initial=0.0))
        return SampledEstimates(out, mixed.delta.T)

    @property
    def requirement(self) -> Requirement:
        """γ∫|Δ|^{1+α} so far."""
        return power_requirement(self._alpha, self._gains, self._energy, self._error)


def power_requirement(alpha: float, gains: Array, energy: float, error: float) -> Requirement:
    """γ∫|Δ|^{1+α}, gains (g, 1 or p), against what errors of the start so large need to be zero."""
    needed = max(error ** (1.0 - alpha) / (1.0 - alpha), 1e-300)
    return energy_requirement(
        gains, energy, "IE with enough ∫|Δ|^(1+α)", needed, "finite-time convergence", "∫|Δ|^(1+α)"
    )


ESTIMATOR = Power
