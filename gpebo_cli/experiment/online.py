"""Observer and estimator fed with samples as they come: from a run, a file or a stream.

What is kept between two calls has a fixed size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gpebo_cli import estimators, observers
from gpebo_cli.estimators import InformationRoot
from gpebo_cli.evidence.excitation import RELATIVE_LEVEL, Excitation
from gpebo_cli.experiment.result import Fit
from gpebo_cli.findings import Assumption, Direction, Requirement
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.observers._observation import InitialError
from gpebo_cli.observers.reduced.sampled import SampledState
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import Settings

_NONE, _ALL = np.zeros(0), slice(None)


@dataclass(frozen=True, eq=False)
class OnlineEstimates:
    """Everything at K samples, all cases."""

    regression: SampledRegression
    parameters: Array  # (G, K, p)
    states: Array  # (G, K, n)
    delta: Array | None  # (1 or G, K)
    gram_eigenvalues: Array  # (K, p) of ∫ψᵀψ so far, ascending
    extension: Array  # (K, k, 1 + p) [ξ_a | ξ_b | Φ]


def joined(parts: Sequence[OnlineEstimates]) -> OnlineEstimates:
    """What consecutive samples gave, as if they had come at once."""
    regressions = [part.regression for part in parts]
    deltas = [part.delta for part in parts if part.delta is not None]
    return OnlineEstimates(
        SampledRegression(
            np.concatenate([r.t for r in regressions]),
            np.concatenate([r.steps for r in regressions]),
            np.concatenate([regressions[0].rows[:1], *(r.rows[1:] for r in regressions)]),
            regressions[0].hold,
        ),
        np.concatenate([part.parameters for part in parts], axis=1),
        np.concatenate([part.states for part in parts], axis=1),
        np.concatenate(deltas, axis=1) if deltas else None,
        np.concatenate([part.gram_eigenvalues for part in parts]),
        np.concatenate([part.extension for part in parts]),
    )


class Online:
    """An observer with its estimator, from one sample to the next."""

    def __init__(
        self, settings: Settings, system: DescriptorSystem, hold: str, start: float,
        estimator: estimators.Estimator | None = None,
    ) -> None:
        """Prepare for samples of which the first is at ``start``.

        Args:
            settings: observer, estimator, solver and level of excitation.
            system: the plant.
            hold: what is assumed between samples, zoh or linear.
            start: time of the first sample.
            estimator: used instead of the one that the settings name.

        Raises:
            ConfigError: the observer or the estimator works in continuous time only.
            ModelError: Assumption 1 fails at the start.
        """
        self._observer = observers.able(
            observers.build(settings.observer), observers.AtSamples,
            "observer.sample_time and streams need an observer that runs at samples",
        ).at_samples(system, settings.solver, hold, start)
        if estimator is None:
            estimator = estimators.build(settings.estimator)
        self.cases: tuple[Mapping[str, float], ...] = estimator.cases
        self.parameters = self._observer.parameters
        self._recursion = estimators.able(
            estimator, estimators.Recursive,
            "observer.sample_time needs an estimator that works at samples",
        ).recursive(self.parameters)
        self._gram = InformationRoot(len(self.parameters), np.zeros(1))
        self._rho = settings.excitation.rho
        self.start = start
        self._state: SampledState | None = None
        self._last: Array | None = None  # S of all data, (p + 1, p + 1)
        self._final = np.zeros((len(self.cases), len(self.parameters)))
        self._system = system
        self.count = 0

    def feed(self, t: Array, u: Array, y: Array) -> OnlineEstimates:
        """Take the samples u (K, m) and y (K, r) at the times t (K,), after all earlier ones.

        Raises:
            ModelError: an assumption of the observer fails.
            SolverError: a step between samples cannot be resolved.
        """
        self._state, block = self._observer.advance(self._state, t, u, y)
        made = self._recursion.update(block.regression)
        roots, _ = self._gram.update(block.regression)
        self._last = roots[-1, 0]
        self._final, self.count = made.parameters[:, -1], self.count + len(t)
        p = len(self.parameters)
        sigma: Array = np.linalg.svd(roots[:, 0, :p, :p], compute_uv=False).astype(np.float64)
        gain = np.einsum("knp,gkp->gkn", block.gain, made.parameters)
        return OnlineEstimates(
            block.regression, made.parameters, block.offset + gain, made.delta,
            sigma[:, ::-1] ** 2, block.extension,
        )

    def truth(self, extension: Array) -> InitialError:
        """What the parameters really are at samples, for those who know the states.

        Args:
            extension: [ξ_a | ξ_b | Φ] at the samples it will be asked about, (K, n_w, 1 + q + n_a).
        """
        o = self._observer
        return InitialError(o.initial_basis, o.xi_a0, o.basis, lambda _t: extension)

    @property
    def requirement(self) -> Requirement:
        """What the estimator needs, and what it got so far."""
        return self._recursion.requirement

    @property
    def growth(self) -> float:
        """Largest entry of Φ so far."""
        return self.reached.growth

    @property
    def growth_rate(self) -> float | None:
        """In 1/s, the logarithm of the largest entry of Φ over the time so far."""
        elapsed = self.reached.t - self.start
        return float(np.log(self.growth)) / elapsed if elapsed > 0 and self.growth > 0 else None

    @property
    def error_estimate(self) -> float:
        """Of the integration between samples; the hold's own error is not in it."""
        return self.reached.error_estimate

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """Those of the observer, as far as it got."""
        return (
            Assumption(
                "Rank of E", "rank E(t) is constant", True,
                {"rank": self._observer.like.split.rank, "states": self._system.n},
            ),
            Assumption(
                "Assumption 1", "impulse observability: [ΠA; C] is injective on the kernel of E(t)",
                True, {"smallest_singular_value_at_least": self.reached.injectivity},
            ),
        )

    @property
    def rho(self) -> float:
        """The level asked of λ_min(G): the one set, or a share of the regressor's own energy."""
        if self._rho is not None:
            return self._rho
        return RELATIVE_LEVEL * self.reached.scale**2 * (self.reached.t - self.start)

    def excitation(
        self, t: Array = _NONE, eigenvalues: Array = _NONE[:, None], shown: IntArray | slice = _ALL,
        pe_level: Array = _NONE, window: float = np.nan,
    ) -> Excitation:
        """The evidence of all samples so far, with what is remembered of their way (perhaps none).

        Args:
            t: their times (N,).
            eigenvalues: of G at them, ascending (N, p).
            shown: which of them are (M,).
            pe_level: at those (M,).
            window: of it, seconds.
        """
        p, rho = len(self.parameters), self.rho
        root = np.zeros((p, p)) if self._last is None else self._last[:p, :p]
        _, sigma, Vt = np.linalg.svd(root)
        v = Vt[-1] * np.sign(Vt[-1, np.argmax(np.abs(Vt[-1]))])
        smallest, largest = float(sigma[-1] ** 2), float(sigma[0] ** 2)
        reached = np.flatnonzero(eigenvalues[:, 0] >= rho)
        return Excitation(
            t=t[shown], gram_eigenvalues=eigenvalues[shown], pe_level=pe_level, window=window,
            is_ie=smallest >= rho > 0,
            t_c=float(t[reached[0]]) if len(reached) else None,
            rho=rho,
            lambda_min=smallest,
            condition=largest / smallest if smallest > 0 else float("inf"),
            weakest_direction=Direction(dict(zip(self.parameters, map(float, v), strict=True))),
        )

    def fit(self) -> Fit:
        """How the last estimates explain all data, from S alone: |Y − ψη̂|² = |S[−η̂; 1]|²."""
        root = np.zeros((1, 1)) if self._last is None else self._last
        duration = max(self.reached.t - self.start, float(np.finfo(float).tiny))
        vectors = np.concatenate([-self._final, np.ones((len(self._final), 1))], axis=1)
        residual = np.linalg.norm(vectors @ root.T, axis=1) / np.sqrt(duration)
        return Fit(residual, float(np.linalg.norm(root[:, -1]) / np.sqrt(duration)))

    @property
    def reached(self) -> SampledState:
        """Where the observer stands."""
        if self._state is None:
            raise ValueError("there have been no samples")
        return self._state
