"""Vector laws η̂' = Γ Mᵀ (b − N η̂), integrated, or stepped, so that no gain is too large."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.estimators._base import GainEstimator
from gpebo_cli.evidence.excitation import persistent
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import Trajectory, joined
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.estimator import Lasting, WindowEstimates
from gpebo_cli.regression.linear import LinearRegression, with_realisations
from gpebo_cli.regression.resets import ExtensionState

_LEFT = float(np.exp(-DECAY))  # of the initial error
_MAX_ELEMENTS = 200_000
_TOLERANCE = 1e-11
_ANY = 1e200  # size of a signal that need not be resolved


@dataclass(frozen=True, eq=False)
class VectorLaw:
    """The signals M (k, p), N (k, p) and b (k,) or (k, c) of a law on one mesh."""

    M: Trajectory | None  # None: the identity, or as ``mixed`` says
    N: Trajectory
    b: Trajectory
    floor: Array | float = 0.0  # (p,) size below which η̂ is rounding
    dynamics: Dynamics | None = None  # η̂' = 𝔸η̂ + 𝕓 + Γ Mᵀ (b − N η̂) for parameters that move
    mixed: bool = False  # M and N are ΔI, and Δ (p, 1), the same in all rows, takes the place of N

    def solve(self, gains: Array, start: Array) -> Trajectory:
        """η̂ (p, c) for one gain vector Γ = diag(``gains``), shape (p,).

        The residual ν = b − N η̂ is an unknown of its own:

            η̂' = Γ Mᵀ ν,      0 = b − N η̂ − ν.

        Eliminating it puts γ MᵀN into the matrix, whose rounding errors then drive the slow
        directions: at γ = 1e14 they would be lost. In this form the limit γ → ∞ is an
        ordinary differential-algebraic equation. Where b jumps (a sample, a step of the input), ν
        does, too, and η̂ does not. Where M is the identity or diagonal, ν is not needed.
        """
        b = with_realisations(self.N.values, self.b.values)
        signals = [self.N.values, b] if self.M is None else [self.M.values, self.N.values, b]
        first, eta, found = 0, start, list[Trajectory]()
        # So far: later, η̂ may have decayed. Where Y bends, at each sample of a recording, ν has
        # layers that are nothing in η̂, and alone they would take most of the elements.
        sizes = np.broadcast_to(self.floor, len(start))[:, None]
        if self.M is not None:
            sizes = np.append(sizes, np.full((b.shape[2], 1), _ANY), axis=0)
        for window in self.N.mesh.windows():
            part = slice(first, first + window.size)
            packed = np.concatenate([values[part] for values in signals], axis=-1)
            solution = self._over(Trajectory(window, packed), gains, eta, sizes)
            sizes = np.maximum(sizes, np.abs(solution.values).max(axis=(0, 1)))
            found.append(Trajectory(solution.mesh, solution.values[:, :, : len(start)]))
            first, eta = part.stop, found[-1].final
        return joined(found)

    def _over(
        self, packed: Trajectory, gains: Array, start: Array, sizes: Array
    ) -> Trajectory:
        """(η̂, ν) for [M | N | b] over a window, from η̂ (p,) or (p, c); rounding is below sizes."""
        p, residual = len(start), self.M is not None
        k, first = (self.b.values.shape[2], p) if residual else (0, 0)
        last = first + self.N.values.shape[-1]
        c = packed.values.shape[-1] - last
        E = np.zeros((1, p + k, p + k))
        E[0, :p, :p] = np.eye(p)

        def coefficients(t: Array, inside: Array) -> LinearEquation:
            M, N, b = np.split(packed(t, inside), [first, last], axis=2)
            A, f = np.zeros((len(t), p + k, p + k)), np.zeros((len(t), p + k, c))
            if self.dynamics is not None:
                A[:, :p, :p], f[:, :p, 0] = self.dynamics.at(t, inside)
            if residual:
                A[:, :p, p:] = gains[:, None] * np.swapaxes(M, 1, 2)
                A[:, p:, :p], A[:, p:, p:], f[:, p:] = -N, -np.eye(k), b
            elif self.mixed:
                A -= gains[:, None] * N**2 * np.eye(p)
                f += gains[:, None] * N * b
            else:
                A -= gains[:, None] * N
                f += gains[:, None] * b
            return LinearEquation(E if residual else None, A, f)

        starts = np.zeros((p + k, c))  # of ν any
        starts[:p] = start.reshape(p, -1)
        problem = LinearProblem(
            coefficients, starts, name="estimator", floor=sizes,
            advice="lower its gain, or use estimator=least_squares",
        )
        return solve(
            problem, packed.mesh, tol=_TOLERANCE, max_elements=_MAX_ELEMENTS
        ).trajectory


@dataclass(frozen=True, eq=False)
class VectorEstimates(Lasting):
    """Estimates of a vector law, one integration per case when it is asked for."""

    law: VectorLaw
    start: Array  # (p,)
    gains: Array  # (cases, p or 1)
    t: Array  # (M,)
    information: Trajectory  # MᵀN, or its mean (p, p)
    told: Requirement | None = None  # what is needed, where that is another than excitation
    realisations: tuple[int, ...] = ()
    reached: tuple[ExtensionState, ...] = ()
    mixed: Trajectory | None = None  # Δ, where the law is that of a mixed regression

    @property
    def requirement(self) -> Requirement:
        """Persistent excitation."""
        return self.told or self.over([self], self.information.mesh.span)

    def over(self, parts: Iterable[WindowEstimates], span: tuple[float, float]) -> Requirement:
        """Persistent excitation by the information of all ``parts`` of a span, or what is told."""
        if self.told is not None:
            return super().over(parts, span)
        least = self.gains.min(axis=0)
        gain = float(least.min())
        root = np.sqrt(least / gain)[:, None]  # in such units of the parameters gains are alike
        each = (
            replace(part.information, values=part.information.values * root * root.T)
            for part in parts if isinstance(part, VectorEstimates)
        )
        return persistent(self.information, gain, each, span)

    def delta(self, t: Array) -> Array | None:
        """Δ at the times t (M,), shape (1, M); None where nothing is mixed."""
        return None if self.mixed is None else self.mixed(t)[None]

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases, shape (g, M, p) or (g, M, p, c), from ``start`` (g, p) if given."""
        gains, p = self.gains[cases], len(self.start)
        starts = np.broadcast_to(self.start if start is None else start, (len(gains), p))
        eta = np.array([
            self.law.solve(np.broadcast_to(gain, (p,)), own)(self.t)
            for gain, own in zip(gains, starts, strict=True)
        ])
        return eta.reshape(*eta.shape[:3], *self.realisations)


def vector_estimates(
    settings: GainEstimator, regression: LinearRegression, law: VectorLaw, information: Trajectory,
    t: Array,
) -> VectorEstimates:
    """A law with the gains γ of the settings at the times t (M,), for MᵀN or its mean (p, p)."""
    names = regression.parameters
    return VectorEstimates(
        law, settings.start(names), settings.gains("gamma", names), np.asarray(t), information,
        realisations=regression.realisations,
    )


class VectorRecursion:
    """η̂ + L (b − N η̂) from sample to sample, for g gains; it remembers how errors shrank."""

    def __init__(self, start: Array, gains: Array) -> None:
        self._smallest = float(gains.min())
        self.roots = np.sqrt(np.broadcast_to(gains, (len(gains), len(start))))  # Γ^½
        self._eta = np.broadcast_to(start, self.roots.shape).copy()
        self._left = np.broadcast_to(np.eye(len(start)), (*self._eta.shape, len(start)))
        self._most = 1.0

    def advance(self, L: Array, shrunk: Array, b: Array) -> tuple[Array, BoolArray]:
        """η̂ (g, K, p) at K samples, for L (g, K, p, m), I − L N (g, K, p, p) and b = Nη (K, m).

        The second result is whether enough of an error has gone by then, (K,).
        """
        out, left = np.empty(shrunk.shape[:3]), np.empty(len(b))
        scale = self.roots[:, None] / self.roots[:, :, None]
        for k in range(len(b)):
            # Of b − N η̂ rounding would be left where N is large, and grow from sample to sample.
            self._eta = (shrunk[:, k] @ self._eta[..., None])[..., 0] + L[:, k] @ b[k]
            self._left = shrunk[:, k] @ self._left
            out[:, k] = self._eta
            left[k] = np.linalg.norm(self._left * scale, 2, axis=(1, 2)).max()
        self._most = float(left[-1])
        return out, left <= _LEFT

    @property
    def requirement(self) -> Requirement:
        """How much of an error of the start is left, at most, measured in the units of Γ^½."""
        left = self._most
        return Requirement(
            "PE", left <= _LEFT, {"left_of_the_initial_error": left, "needed": _LEFT},
            f"{left:.3g} of the initial error is left, at the smallest gain {self._smallest:.3g}; "
            f"the aim is {_LEFT:.2g}",
        )
