"""DREM for fewer unknowns than the regression has parameters: the gradient of a monotone map.

With η = S(θ) mixing leaves 𝐘_i = Δ S_i(θ), and

    θ̂' = γ Δ T (𝐘 − Δ S(θ̂)),      T∇S + (T∇S)ᵀ ≥ 2μI > 0 on a box,

shrinks |θ̂ − θ| by e^{−γμ∫Δ²} where θ̂ stays in the box (Aranovskiy, Bobtsov, Ortega and Pyrkin,
Performance enhancement of parameter estimators via dynamic regressor extension and mixing,
arXiv:1509.02763, whose second part are such nonlinear regressions).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.estimators._base import GainEstimator, filtered_errors, gain
from gpebo_cli.estimators._mixed import energy_requirement
from gpebo_cli.estimators._recursive import Steps
from gpebo_cli.estimators._scalar import ScalarPath
from gpebo_cli.estimators.drem import Drem
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import SampledEstimates
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.parametrisation import Parametrisation
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import per_name, shown

_TOLERANCE = 1e-11
_NODES = 5  # of an implicit step at samples
_ROUNDS = 12  # of Newton's method
_STILL = 1e-12  # of the box: a change that is none
_PARTS = 200  # of a step that Newton's method does not find as a whole

Theta = Callable[[Array], Array]  # times (N,) -> θ̂ (N, c, q)


@dataclass(frozen=True, kw_only=True)
class Monotone(GainEstimator):
    """Kreisselmeier filters, mixing, and the gradient law of the unknowns θ themselves.

    Attributes:
        gamma: γ.
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
        """Verify T, extend and mix, for the times t (M,)."""
        (path,) = Drem(rates=self.rates).resume(regression, t, ()).groups
        return MonotoneEstimates(
            *self.law(regression.parametrisation), path,
            self.gains("gamma", regression.parameters)[:, 0], regression.realisations,
        )

    def recursive(self, parameters: Sequence[str]) -> RecursiveMonotone:
        """The estimator at samples."""
        return RecursiveMonotone(self, parameters)

    def law(self, S: Parametrisation | None) -> tuple[Parametrisation, Array, float, Array]:
        """S, T (q, k), μ, and θ̂ at the start (q,).

        ConfigError: the regression has no S, or T does not fit it or does not make it monotone.
        """
        if S is None:
            raise ConfigError("estimator=monotone is for a regression with S and box; it has none")
        start = 0.5 * (S.low + S.high)
        if self.T is None:
            T = np.linalg.pinv(S.jacobian(start[None])[0])
        elif [len(row) for row in self.T] == [len(S.tape.outputs)] * len(S.names):
            T = np.array(self.T)
        else:
            raise ConfigError(
                f"estimator.T must have {len(S.names)} rows of {len(S.tape.outputs)} numbers, not "
                f"{shown(self.T)}"
            )
        if self.initial is not None:
            start = per_name(self.initial, S.names, "unknown", "estimator.initial", "finite")
        return S, T, 0.5 * S.monotone(T), start

    def errors(self, regression: LinearRegression) -> tuple[ErrorsAt, ...]:
        """δ𝒴' = −Λ(δ𝒴 − ψᵀδY), δθ̂' = γΔT(adj(Ω) δ𝒴 − Δ∇S δθ̂), δη̂ = ∇S δθ̂, of every case."""
        rates, mixed = Drem(rates=self.rates).behind(regression)
        made = self.estimate(regression, regression.mesh.edges[-1:])
        S, T = made.S, made.T

        def at(gamma: float, path: Theta, t: Array, inside: Array) -> ErrorSystem:
            into, delta, adjugate = mixed(t, inside)
            slope, weighted = S.jacobian(path(t)[:, 0]), gamma * delta[:, None, None] * T
            law = delta[:, None, None] * (weighted @ slope)
            return filtered_errors(rates, into, law, weighted @ adjugate, slope)

        gains = made.gains.tolist()
        return tuple(partial(at, gamma, made.solution(gamma)) for gamma in gains)


@dataclass(frozen=True, eq=False)
class MonotoneEstimates:
    """The law of every case, integrated when it is asked for."""

    S: Parametrisation
    T: Array  # (q, k)
    mu: float  # μ
    start: Array  # (q,)
    path: ScalarPath
    gains: Array  # (g,)
    realisations: tuple[int, ...]

    def solution(self, gamma: float) -> Theta:
        """θ̂ (N, c, q) at times (N,), for c realisations of Y.

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
        return energy_requirement(self.gains, energy, "Δ not in L2", DECAY / self.mu)


class RecursiveMonotone:
    """The law over each sample, dθ̂/dx = T(η̄ − S(θ̂)) with x = γ∫Δ², by one step of Radau IIA.

    The rule is B-stable (Hairer & Wanner, Solving ODEs II, IV.12): two solutions of a monotone law
    never move apart, whatever x is. Up to x‖T∇S‖ = 1 a step is exact to some 1e-9.
    """

    def __init__(self, settings: Monotone, parameters: Sequence[str]) -> None:
        self._settings = settings
        self._mixing = Drem(rates=settings.rates).mixing(parameters)
        self._steps = Steps()
        self._gains = settings.gains("gamma", parameters)[:, 0]
        self._theta: Array | None = None  # (g, q)
        self._energy, self._mu = 0.0, 1.0

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each; nobody knows how errors go through."""
        if self._theta is None:
            self._S, self._T, self._mu, start = self._settings.law(regression.parametrisation)
            self._theta = np.tile(start, (len(self._gains), 1))
        mixed = self._mixing(regression)
        energy, goal, _ = self._steps.means(regression, mixed.delta**2, mixed)
        out = np.empty((len(energy), *self._theta.shape))
        for k, x in enumerate(self._gains * energy[:, None]):
            if energy[k] > 0.0:
                self._theta = self._step(self._theta, x, goal[k] @ self._T.T)
            out[k] = self._theta
        self._energy += float(energy.sum())
        eta = self._S.values(out.reshape(-1, out.shape[-1])).reshape(*out.shape[:2], -1)
        return SampledEstimates(np.moveaxis(eta, 0, 1), mixed.delta.T)

    def _step(self, theta: Array, x: Array, goal: Array) -> Array:
        """θ̂ (g, q) after x (g,) towards T η̄ (q,); in parts, where Newton's method asks for it."""
        done, part = 0.0, 1.0
        for _ in range(_PARTS):
            try:
                theta = self._newton(theta, part * x, goal)
            except (ConfigError, np.linalg.LinAlgError):  # it went where S has no value
                part *= 0.5
                continue
            done += part
            if done == 1.0:
                return theta
            part = min(2.0 * part, 1.0 - done)
        raise SolverError("the monotone law cannot be followed at samples; lower its gain")

    def _newton(self, theta: Array, x: Array, goal: Array) -> Array:
        """θ̂ (g, q) after one implicit step; LinAlgError where Newton's method does not find it."""
        (g, q), R = theta.shape, radau_rule(_NODES).integration
        rule, moved = R * x[:, None, None], np.zeros((g, _NODES, q))
        for _ in range(_ROUNDS):
            nodes = (theta[:, None] + moved).reshape(-1, q)
            rest = (goal - self._S.values(nodes) @ self._T.T).reshape(moved.shape)
            slope = (self._T @ self._S.jacobian(nodes)).reshape(g, _NODES, q, q)
            matrix = np.einsum("gij,gjab->giajb", rule, slope).reshape(g, _NODES * q, -1)
            wrong = (rule @ rest - moved).reshape(g, -1, 1)
            change = np.linalg.solve(np.eye(_NODES * q) + matrix, wrong).reshape(moved.shape)
            moved = moved + change
            if (np.abs(change) <= _STILL * (self._S.high - self._S.low)).all():
                return np.asarray(theta + moved[:, -1])
        raise np.linalg.LinAlgError

    @property
    def requirement(self) -> Requirement:
        """γμ∫Δ² so far."""
        return energy_requirement(self._gains, self._energy, "Δ not in L2", DECAY / self._mu)


ESTIMATOR = Monotone
