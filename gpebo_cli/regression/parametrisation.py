"""η = S(θ): fewer unknowns θ than a regression that is linear in η has parameters.

Estimators work on Y = ψη as on any regression. At every time θ̂ is then what fits η̂ best,

    θ̂ = argmin (η̂ − S(θ))ᵀ G (η̂ − S(θ)),      G = ∫ψᵀψ,

in a box that the user gives. For the least-squares η̂ = G⁻¹h that is the minimum of ∫|Y − ψS(θ)|²,
that is, nonlinear least squares on the data themselves, whose sums are all in G and h.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions.bounds import Bounds
from gpebo_cli.model.expressions.intervals import Interval
from gpebo_cli.model.expressions.tape import Tape
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.schema import number, shown

_ROUNDS = 60  # of Levenberg and Marquardt
_STILL = 1e-15  # a step of this share of the box changes nothing
_STUCK = 1e3  # damping from which on no shorter step helps: what is left is rounding
_UNSEEN = 1e-14  # relative weight of directions without excitation
_SHARP = 0.5  # of an eigenvalue, by which intervals may spread
_CELLS = 1 << 14  # boxes that are looked at at once
_DAMPING = 1e-3  # at first, relative to the largest singular value squared


@dataclass(frozen=True, eq=False)
class Parametrisation:
    """S on a box."""

    names: tuple[str, ...]  # of θ
    tape: Tape  # k outputs, of q signals that stand for θ
    low: Array  # (q,)
    high: Array  # (q,)

    def values(self, theta: Array) -> Array:
        """S(θ) (N, k) of θ (N, q)."""
        return self._taylor(0, theta[None])

    def jacobian(self, theta: Array) -> Array:
        """∂S/∂θ (N, k, q) at θ (N, q): along each axis the first Taylor coefficient, exactly."""
        along = np.eye(theta.shape[1])[:, None] + np.zeros_like(theta)
        return np.stack([self._taylor(1, np.stack([theta, v])) for v in along], axis=2)

    def _taylor(self, order: int, along: Array) -> Array:
        """The last coefficient of S (N, k) along those of θ (order + 1, N, q)."""
        try:
            return np.asarray(self.tape.taylor(np.zeros(along.shape[1]), order, None, along)[order])
        except ConfigError as error:
            if along.shape[1] > 1:  # which of them is it?
                for n in range(along.shape[1]):
                    self._taylor(order, along[:, n : n + 1])
            what = str(error).removesuffix(" at t = 0")
            raise ConfigError(f"{what} at {self._place(along[0, 0])}, in the box") from None

    def _place(self, theta: Array) -> str:
        return ", ".join(f"{n} = {x:.4g}" for n, x in zip(self.names, theta, strict=True))

    def slopes(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Bounds of ∂S/∂θ (N, k, q) over boxes from ``low`` to ``high`` (N, q), by intervals."""
        t, box = np.zeros(len(low)), [*map(Interval, low.T, high.T)]

        def along(axis: Array) -> tuple[Array, Array]:
            theta: list[list[Any] | None] = [[*each] for each in zip(box, axis, strict=True)]
            return Bounds(self.tape, lambda *_: theta).of(t, t, 1)

        least, most = zip(*map(along, np.eye(len(box))), strict=True)
        return np.stack(least, axis=3)[1], np.stack(most, axis=3)[1]

    def monotone(self, T: Array) -> float:
        """A number that λ_min(T∇S + (T∇S)ᵀ) is nowhere below in the box, for T (q, k).

        The box is halved until intervals say so everywhere (ConfigError: at some θ, which is named,
        it is not positive; or no end is in sight).
        """
        low, high, least, axis = self.low[None], self.high[None], np.inf, 0
        while True:
            ends = np.stack(self.slopes(low, high))
            with np.errstate(invalid="ignore"):  # ends may be infinite
                middle, radius = T @ ends.mean(axis=0), np.abs(T) @ (0.5 * np.ptp(ends, axis=0))
            known = np.isfinite(radius).all(axis=(1, 2))
            symmetric = np.where(known[:, None, None], middle + transpose(middle), 0.0)
            spread = (radius + transpose(radius)).sum(axis=2).max(axis=1)
            eigenvalue = np.linalg.eigvalsh(symmetric)[:, 0]
            done = known & (spread < _SHARP * eigenvalue)
            least = min(least, float((eigenvalue - spread)[done].min(initial=np.inf)))
            low, high = low[~done], high[~done]
            if done.all():
                break
            theta = 0.5 * (low + high)
            slope = T @ self.jacobian(theta)
            poor = np.linalg.eigvalsh(slope + transpose(slope))[:, 0] <= 0.0
            if poor.any() or len(low) > _CELLS:
                text = self._place(theta[np.argmax(poor)])
                what = "is not positive" if poor.any() else "cannot be shown to be positive"
                raise ConfigError(
                    f"estimator.T: T∇S + (T∇S)ᵀ {what} at {text}; give another T or a smaller box"
                )
            upper, lower = high.copy(), low.copy()
            upper[:, axis] = lower[:, axis] = theta[:, axis]
            low, high = np.concatenate([low, lower]), np.concatenate([upper, high])
            axis = (axis + 1) % len(self.low)
        return least

    def fitted(self, eta: Array, weight: Array) -> Array:
        """θ̂ (N, q) of η̂ (N, k) with the weights G (N, k, k); NaN where η̂ is.

        From the middle of the box, by damped Gauss–Newton steps that do not leave it.
        """
        found = np.full((len(eta), len(self.low)), np.nan)
        left = np.flatnonzero(np.isfinite(eta).all(axis=1))  # those that still move
        width = self.high - self.low
        eta, L = eta[left], _root(weight[left])

        def rest_at(z: Array) -> Array:
            return np.asarray((L @ (eta - self.values(self.low + width * z))[..., None])[..., 0])

        z = np.full((len(left), len(width)), 0.5)
        damping = np.full(len(left), _DAMPING)
        rest = rest_at(z)
        for _ in range(_ROUNDS):
            J = L @ (self.jacobian(self.low + width * z) * width)
            down = np.einsum("nji,nj->ni", J, rest)
            held = ((z == 0.0) & (down < 0.0)) | ((z == 1.0) & (down > 0.0))
            U, sigma, Vt = np.linalg.svd(np.where(held[:, None], 0.0, J), full_matrices=False)
            size = np.maximum(sigma[:, :1], 1e-100)  # without excitation all are zero
            filtered = sigma / (sigma**2 + damping[:, None] * size**2)
            tried = np.clip(z + np.einsum("nji,nj,nkj,nk->ni", Vt, filtered, U, rest), 0.0, 1.0)
            new = rest_at(tried)
            better = (new**2).sum(axis=1) < (rest**2).sum(axis=1)
            moves = np.where(better, np.abs(tried - z).max(axis=1) > _STILL, damping < _STUCK)
            z[better], rest[better] = tried[better], new[better]
            damping = np.maximum(np.where(better, 0.1, 10.0) * damping, 1e-15)
            found[left] = self.low + width * z
            if not moves.any():
                break
            left, eta, L = left[moves], eta[moves], L[moves]
            z, rest, damping = z[moves], rest[moves], damping[moves]
        return found

    def fit(self, eta: Array, weight: Array) -> tuple[Array, Array]:
        """θ̂ (g, N, q) and ∂θ̂/∂η̂ of the η̂ (g, N, k) of every case, with weights (N, k, k)."""
        theta = np.array([self.fitted(of_case, weight) for of_case in eta])
        return theta, np.array([self.gain(of_case, weight) for of_case in theta])

    def gain(self, theta: Array, weight: Array) -> Array:
        """∂θ̂/∂η̂ (N, q, k) at θ̂ (N, q): what errors of η̂ make of θ̂."""
        L = _root(weight)
        return np.asarray(np.linalg.pinv(L @ self.jacobian(theta)) @ L)


def _root(weight: Array) -> Array:
    """L with LᵀL = G/‖G‖ (N, k, k)."""
    values, vectors = np.linalg.eigh(weight)
    size = np.maximum(values[:, -1:], np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(values / size, _UNSEEN))  # η̂ says at least something
    return np.asarray(scale[..., None] * transpose(vectors))


def read_box(given: object, names: tuple[str, ...], where: str) -> tuple[Array, Array]:
    """Ends (q,) and (q,) of the box: ``{name: [low, high]}`` for every unknown.

    ConfigError: a name without two ends, or that is not an unknown.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(
            f"{where}: S needs a box, for each unknown where it may lie: "
            f"{{{names[0] if names else 'a'}: [0, 10]}}"
        )
    ends = np.zeros((2, len(names)))
    for name in given:
        if name not in names:
            raise ConfigError(f"{where}: box.{name} is not an unknown ({', '.join(names)})")
    for i, name in enumerate(names):
        pair = given.get(name)
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise ConfigError(f"{where}: box.{name} must be [low, high], not {shown(pair)}")
        ends[:, i] = [number(end, f"{where}: box.{name}", "finite") for end in pair]
        if not ends[0, i] < ends[1, i]:
            raise ConfigError(f"{where}: box.{name} must be [low, high] with low < high")
    return ends[0], ends[1]
