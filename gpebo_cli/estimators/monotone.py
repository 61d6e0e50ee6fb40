"""DREM for fewer unknowns than the regression has parameters: the gradient of a monotone map.

With η = S(θ) mixing leaves 𝐘_i = Δ S_i(θ), and

    θ̂' = γ Δ T (𝐘 − Δ S(θ̂)),      T∇S + (T∇S)ᵀ ≥ 2μI > 0 on a box,

shrinks |θ̂ − θ| by e^{−γμ∫Δ²} where θ̂ stays in the box (Aranovskiy, Bobtsov, Ortega and Pyrkin,
Performance enhancement of parameter estimators via dynamic regressor extension and mixing,
arXiv:1509.02763, whose second part are such nonlinear regressions).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.estimators._base import GainEstimator, filtered_errors, gain
from gpebo_cli.estimators._extension import kreisselmeier
from gpebo_cli.estimators._mixed import energy_requirement, filter_rates
from gpebo_cli.estimators._mixing import mix
from gpebo_cli.estimators._scalar import ScalarPath
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action, transpose
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.parametrisation import Parametrisation
from gpebo_cli.schema import per_name, shown

_TOLERANCE = 1e-11

Theta = Callable[[Array], Array]  # times (N,) -> θ̂ (N, c, q)


@dataclass(frozen=True, kw_only=True)
class Monotone(GainEstimator):
    """Kreisselmeier filters, mixing, and the gradient law of the unknowns θ themselves.

    Attributes:
        gamma: γ; a number, a list (one case each), or ``logspace(a, b, n)``.
        T: a row for each unknown, an entry for each of S; None: the pseudoinverse of ∇S in the
            middle of the box.
        rates: λ of the filters, as of ``drem``.
        initial: θ̂ at the start, a number, one per unknown, or a mapping; None: the middle.
    """

    gamma: object = gain(10.0)
    T: list[list[float]] | None = None
    rates: object = field(default=None, metadata={"key": "lambda"})
    initial: object = None

    def estimate(self, regression: LinearRegression, t: Array) -> MonotoneEstimates:
        """Verify T, extend and mix, for the times t (M,).

        Raises:
            ConfigError: the regression has no S, or T does not fit it or does not make it monotone.
        """
        S = regression.parametrisation
        if S is None:
            raise ConfigError("estimator=monotone is for a regression with S and box; it has none")
        middle = 0.5 * (S.low + S.high)
        T = np.linalg.pinv(S.jacobian(middle[None])[0]) if self.T is None else self._matrix(S)
        start = middle
        if self.initial is not None:
            start = per_name(self.initial, S.names, "unknown", "estimator.initial", "finite")
        extended = kreisselmeier(regression, filter_rates(self.rates, regression.parameters))
        return MonotoneEstimates(
            S, T, 0.5 * S.monotone(T), mix(extended, np.asarray(t), regression.floor), start,
            self.gains("gamma", regression.parameters)[:, 0], regression.realisations,
        )

    def _matrix(self, S: Parametrisation) -> Array:
        shape = (len(S.names), len(S.tape.outputs))
        rows = self.T or []
        if [len(row) for row in rows] != [shape[1]] * shape[0]:
            raise ConfigError(
                f"estimator.T must have {shape[0]} rows of {shape[1]} numbers, not {shown(self.T)}"
            )
        return np.array(rows)

    def errors(self, regression: LinearRegression) -> tuple[ErrorsAt, ...]:
        """δ𝒴' = −Λ(δ𝒴 − ψᵀδY), δθ̂' = γΔT(adj(Ω) δ𝒴 − Δ∇S δθ̂), δη̂ = ∇S δθ̂, of every case."""
        k, names = regression.p, regression.parameters
        rates = filter_rates(self.rates, names)
        extended = kreisselmeier(regression, rates)
        made = self.estimate(regression, regression.mesh.edges[-1:])
        S, T = made.S, made.T

        def at(gamma: float, path: Theta, t: Array, inside: Array) -> ErrorSystem:
            omega = extended(t, inside)[..., :k]
            delta, adjugate, _ = determinant_and_adjugate_action(omega)
            slope, weighted = S.jacobian(path(t)[:, 0]), gamma * delta[:, None, None] * T
            law = delta[:, None, None] * (weighted @ slope)
            into = rates[:, None] * transpose(regression.psi(t, inside))
            return filtered_errors(rates, into, law, weighted @ adjugate, slope)

        gains = made.gains.tolist()
        return tuple(partial(at, gamma, made.solution(gamma)) for gamma in gains)


@dataclass(frozen=True, eq=False)
class MonotoneEstimates:
    """The law of every case, integrated when it is asked for."""

    S: Parametrisation
    T: Array  # (q, k)
    mu: float  # μ
    path: ScalarPath
    start: Array  # (q,)
    gains: Array  # (g,)
    realisations: tuple[int, ...]

    def solution(self, gamma: float) -> Theta:
        """θ̂ (N, c, q) at times (N,), for c realisations of Y.

        Raises:
            SolverError: the law cannot be integrated.
        """
        path, (q, k), count = self.path, self.T.shape, int(np.prod(self.realisations))

        def rates(t: float, theta: Array) -> Array:
            delta, Y, _ = path.signals(np.array([t]), np.array([t]))
            rest = Y.reshape(k, count).T - delta[0] * self.S.values(theta.reshape(count, q))
            return np.asarray(gamma * delta[0] * (rest @ self.T.T)).ravel()

        edges, size = path.mesh.edges, np.abs(self.S.high - self.S.low)
        found = solve_ivp(  # no realisation acts on another: the Jacobian is banded
            rates, (edges[0], edges[-1]), np.tile(self.start, count), method="LSODA",
            rtol=_TOLERANCE, atol=np.tile(_TOLERANCE * size, count), dense_output=True,
            max_step=float(path.mesh.steps.max()), lband=q - 1, uband=q - 1,
        )
        if not found.success or found.sol is None:
            raise SolverError(f"the monotone law cannot be integrated: {found.message}")
        sol = found.sol
        return lambda t: np.asarray(sol(t).T).reshape(len(t), count, q)

    def parameters(self, cases: slice) -> Array:
        """η̂ = S(θ̂) of some cases, (g, M, k), or (g, M, k, c) for c realisations."""
        theta = np.array([self.solution(float(gamma))(self.path.t) for gamma in self.gains[cases]])
        eta = self.S.values(theta.reshape(-1, theta.shape[-1])).reshape(*theta.shape[:3], -1)
        shape = (*theta.shape[:2], eta.shape[-1], *self.realisations)
        return np.asarray(np.moveaxis(eta, 2, 3).reshape(shape))

    def delta(self, t: Array) -> Array:
        """Δ at the times t (M,), (1, M)."""
        return self.path.delta(t)[None]

    @property
    def requirement(self) -> Requirement:
        """γμ∫Δ² over the horizon: the error has shrunk by its exponential."""
        energy = float(self.path.energy_at_t[-1])
        return energy_requirement("Δ not in L2", float(self.gains.min()), energy, DECAY / self.mu)


ESTIMATOR = Monotone
