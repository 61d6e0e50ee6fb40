"""The scalar law η̂' = Δ (γ ⌈r⌋^α + γ₂ ⌈r⌋^β), r = 𝐘 − Δη̂, where neither power is smooth at 0."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.estimators._mixing import SINGULAR
from gpebo_cli.estimators._scalar import ScalarPath
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.mesh import legendre_tail

_TOLERANCE, _ROUNDING = 1e-11, 1e-15
_AT_ONCE = 1024  # elements
_INSIDE = 1e-3  # of a step: which element a node belongs to
_ITERATIONS = 12  # of Newton's method
_NOTHING = 1e-290  # next to the smallest number
_SHORTEST = 1e-11  # steps, relative to the element


@dataclass(frozen=True, eq=False)
class PowerLaw:
    """The law along a mixed regression."""

    path: ScalarPath
    alpha: float
    gamma2: float
    beta: float

    def solve(self, start: Array, gains: Array) -> Array:
        """η̂ (g, M, P) at the path's times, from ``start`` (P,) or (g, P), for gains (g, P or 1).

        Every gain and parameter has steps of its own, because errors reach zero at different times
        (SolverError: steps become too short).
        """
        path = self.path
        P = path.quotient.shape[-1]
        shape = (len(gains), P)
        eta, gamma = (np.broadcast_to(x, shape).ravel().copy() for x in (start, gains))
        column = np.tile(np.arange(P), len(gains))
        out = np.empty((len(eta), len(path.t)))
        out[:, : np.searchsorted(path.t, path.mesh.edges[0], side="right")] = eta[:, None]
        step = np.ones(len(eta))  # of the element, as it turned out to be good
        for number, (left, right) in enumerate(pairwise(path.mesh.edges.tolist())):
            if number % _AT_ONCE == 0:  # signals of many elements at once cost little
                edges = path.mesh.edges[number : number + _AT_ONCE + 1]
                whole = self._signals(edges[:-1], edges[1:])
            at = np.zeros(len(eta))  # share of the element that is done
            wanted = np.flatnonzero((path.t > left) & (path.t <= right))
            places = (path.t[wanted] - left) / (right - left)
            while (lanes := np.flatnonzero(at < 1.0)).size:
                end = at[lanes] + step[lanes]
                end = np.where(end > 1.0 - 1e-9, 1.0, end)
                from_, to = (left + (right - left) * share for share in (at[lanes], end))
                if at.any() or (end < 1.0).any():
                    pairs, of = np.unique(np.stack([from_, to]), axis=1, return_inverse=True)
                    delta, Y, digits = (x[of] for x in self._signals(*pairs))
                else:
                    same = np.full(len(lanes), number % _AT_ONCE)
                    delta, Y, digits = (x[same] for x in whole)
                Y = Y[np.arange(len(lanes)), :, column[lanes]]
                values, good = self._step(to - from_, eta[lanes], gamma[lanes], delta, Y, digits)
                step[lanes] *= np.where(good, np.where(step[lanes] < 1.0, 2.0, 1.0), 0.25)
                if step.min() < _SHORTEST:
                    raise SolverError(f"the power law is not resolved near t = {left:.6g}")
                lane, k = np.nonzero(
                    good[:, None] & (places > at[lanes, None]) & (places <= end[:, None])
                )
                share = (places[k] - at[lanes][lane]) / (end - at[lanes])[lane]
                weights = path.mesh.rule.interpolation(share)
                out[lanes[lane], wanted[k]] = np.einsum("ni,ni->n", weights, values[lane])
                eta[lanes] = np.where(good, values[:, -1], eta[lanes])
                at[lanes] = np.where(good, end, at[lanes])
        return np.moveaxis(out.reshape(*shape, -1), 1, 2)

    def _signals(self, left: Array, right: Array) -> tuple[Array, Array, Array]:
        """Δ (n, s), 𝐘 (n, s, P) and digits (n, s) at the nodes of steps (n,)."""
        rule = self.path.mesh.rule
        h = (right - left)[:, None]
        places = left[:, None] + h * rule.points
        places[:, -1] = right
        inside = places.clip(places[:, :1] + _INSIDE * h, places[:, -1:] - _INSIDE * h)
        delta, Y, digits = self.path.signals(places[:, 1:].ravel(), inside[:, 1:].ravel())
        shape = len(left), rule.stages
        return delta.reshape(shape), Y.reshape(*shape, -1), digits.reshape(shape)

    def _step(
        self, h: Array, eta: Array, gamma: Array, delta: Array, Y: Array, digits: Array
    ) -> tuple[Array, BoolArray]:
        """η̂ (n, s + 1) of n laws over steps h (n,) along signals (n, s), and which are resolved.

        Unknown are w = ⌈r⌋^α at the nodes: ⌈w_i⌋^{1/α} = 𝐘_i − Δ_i η̂_i is smooth in them where a
        power of r is not, and η̂ follows by integration.
        """
        path, rule = self.path, self.path.mesh.rule
        # Where 𝐘/Δ is rounding nothing is known, and the estimate does not move.
        known = (digits > SINGULAR) & (delta != 0.0)
        rest = np.where(known, Y - delta * eta[:, None], 0.0)
        integral = h[:, None, None] * rule.integration * delta[:, None]
        coupling, diagonal = delta[:, :, None] * integral, np.arange(rule.stages)
        w, before = np.sign(rest) * np.abs(rest) ** self.alpha, np.full_like(rest, np.inf)
        ratio, root = self.beta / self.alpha, 1.0 / self.alpha
        scale = np.maximum(np.abs(eta), max(np.abs(path.quotient[-1]).max(), path.floor, 1e-300))
        for _ in range(_ITERATIONS):
            size = np.abs(w)
            speed = gamma[:, None] * w + self.gamma2 * np.sign(w) * size**ratio
            moved = (integral @ speed[..., None])[..., 0]
            change = np.abs(moved - before).max(axis=1) / scale
            if (change < 1e-3 * _TOLERANCE).all():
                break
            slope = gamma[:, None] + self.gamma2 * ratio * size ** (ratio - 1.0)
            J = coupling * slope[:, None]
            J[:, diagonal, diagonal] += np.where(delta, root * size ** (root - 1.0), 1.0)
            # Where nothing is left of Δ and r nothing moves.
            J[:, diagonal, diagonal] += np.where(np.abs(J).max(axis=2) > _NOTHING, 0.0, 1.0)
            F = np.sign(w) * size**root + delta * moved - rest
            w, before = w - np.linalg.solve(J, F[..., None])[..., 0], moved
        values = np.concatenate([eta[:, None], eta[:, None] + moved], axis=1)
        tail = legendre_tail(values[..., None], rule, scale[:, None])[:, 0] / scale
        worst = np.where(known, digits, 1.0).min(axis=1)
        allowed = np.maximum(_TOLERANCE, 30.0 * _ROUNDING / worst)
        return values, (tail < allowed) & (change < allowed)
