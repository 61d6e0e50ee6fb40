"""Observer and estimator fed with samples as they come: from a run, a file or a stream.

What is kept between two calls has a fixed size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gpebo_cli import estimators, observers
from gpebo_cli.estimators import InformationRoot
from gpebo_cli.evidence.excitation import WELL, Excitation
from gpebo_cli.evidence.knowledge import Knowledge, knowledge_of_roots
from gpebo_cli.evidence.sampled_uncertainty import SampledDeviations
from gpebo_cli.experiment import doubts as doubted
from gpebo_cli.experiment.result import Fit, told_apart
from gpebo_cli.experiment.uncertainty import MOST_CASES
from gpebo_cli.findings import Assumption, Requirement
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.observers.reduced.sampled import TOLERANCE
from gpebo_cli.recordings.hold import Hold
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression.linear import least_squares
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import Settings

_NEWEST, _UNKNOWN = np.array([-1]), np.full(1, np.nan)


@dataclass(frozen=True, eq=False)
class OnlineEstimates:
    """Everything at K samples, all cases."""

    regression: SampledRegression
    parameters: Array  # (G, K, p)
    states: Array  # (G, K, n)
    delta: Array | None  # (1 or G, K)
    gram_eigenvalues: Array  # (K, p) of ∫ψᵀψ so far, ascending
    known: Knowledge  # from all samples so far
    seen: BoolArray  # (K, n) which states are determined
    extension: Array  # (K, k, 1 + p) [ξ_a | ξ_b | Φ]
    std: Array | None = None  # (G, K, p + n) deviations, to be multiplied by
    level: Array | None = None  # (K,) that of the noise so far, 1 where it is known
    gain: Array | None = None  # ∂x̂/∂η̂ (K, n, p), or of each case (G, K, n, p), where std is
    by_noise: BoolArray | None = None  # (G, K) whether noise may have brought η̂ where it is

    def at(
        self, kept: IntArray, told: BoolArray, still: BoolArray
    ) -> tuple[Array | None, Array | None, str]:
        """Deviations at some samples (M,), ∂x̂/∂η̂ there, and why there are none at the end.

        The first (G, M, p + n) are NaN where not ``told``, and of cases (G,) that stand ``still``,
        the second are (G, M, n, p).
        """
        if self.std is None or self.level is None or self.gain is None or self.by_noise is None:
            return None, None, ""
        told = told & (self.by_noise[:, kept] & ~still[:, None])[..., None]
        why = "" if (self.by_noise[:, -1] | still).all() else doubted.UNFINISHED
        std = np.where(told, self.std[:, kept] * self.level[-1], np.nan)
        gain = self.gain[..., kept, :, :]
        gain = np.broadcast_to(gain, (len(std), *gain.shape[-3:]))
        return None if why and not told.any() else std, gain, why


def joined(parts: Sequence[OnlineEstimates]) -> OnlineEstimates:
    """What consecutive samples gave, as if they had come at once."""
    regressions = [part.regression for part in parts]
    axes = {"parameters": 1, "states": 1, "delta": 1, "gram_eigenvalues": 0, "seen": 0,
            "extension": 0, "std": 1, "level": 0, "gain": -3, "by_noise": 1}
    known = {name: [getattr(part, name) for part in parts] for name in axes}
    whole: dict[str, Any] = {
        name: None if any(part is None for part in found) else np.concatenate(found, axes[name])
        for name, found in known.items()
    }
    regression = SampledRegression(
        np.concatenate([r.t for r in regressions]), np.concatenate([r.steps for r in regressions]),
        np.concatenate([regressions[0].rows[:1], *(r.rows[1:] for r in regressions)]),
        regressions[0].hold,
    )
    return OnlineEstimates(
        regression=regression, known=Knowledge.joined([part.known for part in parts]), **whole
    )


class Online:
    """An observer with its estimator, from one sample to the next."""

    def __init__(
        self, settings: Settings, system: DescriptorSystem, hold: Hold, start: float, sample: Array,
        estimator: estimators.Estimator, deviations: SampledDeviations | None = None,
        derivatives: InputDerivatives | None = None, columns: IntArray | None = None,
    ) -> None:
        """Prepare for samples of which the first, [u; y] (m + r,), is at ``start``.

        With ``deviations`` None nobody asks for them; ``derivatives`` are of the inputs, as far as
        they are known; of the parameters ``columns`` (k,) are estimated, the others being zero;
        None: all.
        """
        self._observer = observers.able(
            observers.build(settings.observer), observers.AtSamples,
            "observer.sample_time and streams need an observer that runs at samples",
        ).at_samples(system, settings.solver, hold, start, sample, derivatives)
        self.cases: tuple[Mapping[str, float], ...] = estimator.cases
        self.parameters = told_apart(self._observer.parameters, system)
        self._columns = np.arange(len(self.parameters)) if columns is None else columns
        own = tuple(self.parameters[j] for j in self._columns)
        self._recursion = estimators.at_samples(estimator, own)
        self._gram = InformationRoot(len(self.parameters), np.zeros(1))
        self._tol = max(settings.solver.tol, TOLERANCE)
        self._rho = settings.excitation.rho
        self.start = start
        self._state: observers.Reached | None = None
        # When parameters could first be told apart, and when well.
        self._t_c: list[float | None] = [None, None]
        self._system = system
        self.largest = np.zeros(system.n)  # |x̂| so far
        self._deviations = None if len(self.cases) > MOST_CASES else deviations
        if self._deviations is not None and isinstance(self._observer, observers.Responding):
            self._observer = self._observer.responding(self._deviations.noisy)
        self.count = 0

    def feed(self, t: Array, u: Array, y: Array) -> OnlineEstimates:
        """Take the samples u (K, m) and y (K, r) at the times t (K,), after all earlier ones."""
        self._state, block = self._observer.advance(self._state, t, u, y)
        self.fits = block.fit is not None
        columns, p = self._columns, len(self.parameters)
        rows = block.regression.rows[..., [*columns, p]]
        scale = np.asarray(block.regression.scale)
        some = replace(block.regression, rows=rows, scale=scale[..., columns])
        made = self._recursion.update(some)
        eta = np.zeros((*made.parameters.shape[:2], p))
        eta[..., columns] = made.parameters
        whole, _ = self._gram.update(block.regression)
        roots = whole[:, 0]
        # S of all data: |S[−η; 1]|² = ∫‖Y − ψη‖²
        self.root, self.count = roots[-1], self.count + len(t)
        S = roots[:, :p, :p]
        sigma: Array = np.linalg.svd(S, compute_uv=False).astype(np.float64)
        known = knowledge_of_roots(S, scale, t - self.start, self._tol)
        smallest = sigma.min(axis=1, initial=np.inf) ** 2
        if self._rho is None:
            exciting = known.margin >= 1.0
            reached = exciting, exciting & (known.smallest >= WELL)
        else:
            reached = smallest >= self._rho, smallest >= self._rho
        for k, holds in enumerate(reached):
            if self._t_c[k] is None and holds.any():
                self._t_c[k] = float(t[np.argmax(holds)])
        gain = block.gain
        states = block.offset + np.einsum("knp,gkp->gkn", gain, eta)
        if block.fit is not None:
            states, gain = block.fit(eta, transpose(S) @ S)
        std, level, by_noise = None, None, None
        if self._deviations is not None and block.errors is not None and made.errors is not None:
            own = roots
            if len(columns) < p:
                own = np.asarray(np.linalg.qr(roots[..., [*columns, p]], mode="r"))
            found, level = self._deviations.update(
                block.errors, made.errors(), some, gain[..., columns], own
            )
            by_noise = doubted.moved_by_noise(
                found * level[:, None], made.parameters, own, made.met
            )
            std = np.zeros((*eta.shape[:2], p + gain.shape[-2]))
            std[..., [*columns, *range(p, std.shape[2])]] = found
        eigenvalues = sigma[:, ::-1] ** 2
        seen = known.states(gain if gain.ndim == 3 else gain[0], block.units)
        self._last = block.offset[-1], block.gain[-1], block.fit
        if block.fit is None:
            h = self.root[:, :p].T @ self.root[:, p]
            seen &= known.resolved(h, block.offset, gain, self.growth, block.units)
        self._final, self._seen = eta[:, -1].copy(), seen[-1].copy()
        self.largest = np.fmax(self.largest, np.abs(states).max(axis=(0, 1)))
        self._newest = t[_NEWEST], known.at(_NEWEST), eigenvalues[_NEWEST]
        return OnlineEstimates(
            block.regression, eta, states, made.delta, eigenvalues, known, seen,
            block.extension, std, level, None if std is None else gain, by_noise,
        )

    def truth(self, extension: Array) -> observers.Truth:
        """What the parameters really are, from [ξ_a | ξ_b | Φ] (K, n_w, 1 + q + n_a)."""
        return self._observer.truth(extension)

    def last_states(self, eta: Array) -> Array:
        """x̂ (g, 1, n) at the newest sample that parameters η (g, p) say."""
        (offset, gain, fit), S = self._last, self.root[:, :-1]
        if fit is not None:
            return fit(eta[:, None], (S.T @ S)[None])[0]
        return np.asarray(offset + eta @ gain.T)[:, None]

    @property
    def requirement(self) -> Requirement:
        """What the estimator needs, and what it got so far."""
        return self._recursion.requirement

    @property
    def growth(self) -> float | None:
        """Largest entry of Φ so far; None: there is no Φ."""
        return self.reached.growth

    @property
    def growth_rate(self) -> float | None:
        """In 1/s, ln ‖Φ‖₂ over the time so far."""
        elapsed, logarithm = self.reached.t - self.start, self.reached.log_norm
        return logarithm / elapsed if elapsed > 0 and logarithm is not None else None

    @property
    def error_estimate(self) -> float:
        """Error estimate of the integration between samples; the hold's own error is not in it."""
        return self.reached.error_estimate

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """Those of the observer, as far as it got."""
        return self._observer.assumptions(self.reached)

    @property
    def note(self) -> str:
        """What the last line has to say of the equations, from "; " on."""
        evidence = [each.evidence for each in self.assumptions]
        return "".join(f"; {each['because']}" for each in evidence if "because" in each)

    def excitation(
        self, made: OnlineEstimates | None = None, shown: IntArray = _NEWEST,
        pe_level: Array = _UNKNOWN, window: float = np.nan,
    ) -> Excitation:
        """The evidence of all samples so far, with what is remembered of their way.

        It is shown at some samples (M,) of what ``made`` has, with the ``pe_level`` (M,) over
        ``window`` seconds; without it, at the newest.
        """
        t, known, eigenvalues = self._newest if made is None else (
            made.regression.t, made.known, made.gram_eigenvalues
        )
        known, eigenvalues = known.at(shown), eigenvalues[shown]
        return Excitation(
            t[shown], window, self._rho, tuple(self.parameters), known.at(_NEWEST),
            self._t_c[0] if self._t_c[1] is None else self._t_c[1],
            float(eigenvalues[-1, 0]) if self.parameters else 0.0,
            known, eigenvalues, pe_level,
        )

    @property
    def natural_sizes(self) -> Array:
        """√(∫Y²/∫ψ_j²) so far, (p,): the size of a parameter that alone would explain Y."""
        *own, of_Y = np.linalg.norm(self.root, axis=0)
        return np.array([of_Y / size if size > 0.0 else 0.0 for size in own])

    def doubts(
        self, sizes: Array | None = None, columns: IntArray | None = None
    ) -> tuple[Mapping[str, float], tuple[str, ...]]:
        """How far the newest estimates may be off beside ``sizes`` (p + n,), and warnings of that.

        They are compared with least squares about some ``columns`` (k,).
        """
        _, known, _ = self._newest
        return doubted.of_estimates(
            self.root, self._final, self.last_states, self.last_states,
            [*self.parameters, *self._system.states],
            np.append(self.natural_sizes, self.largest) if sizes is None else sizes,
            known, self._seen, known.independent if columns is None else columns, self.requirement,
        )

    def fit(self) -> Fit:
        """How the last estimates explain all data, from S alone: |Y − ψη̂|² = |S[−η̂; 1]|²."""
        final, root = self._final, self.root
        duration = max(self.reached.t - self.start, float(np.finfo(float).tiny))
        each = np.stack([*final, np.zeros(root.shape[1] - 1), least_squares(root)])
        vectors = np.concatenate([-each, np.ones((len(each), 1))], axis=1)
        *residual, size, least = np.linalg.norm(vectors @ root.T, axis=1) / np.sqrt(duration)
        return Fit(np.array(residual), float(size), float(least))

    @property
    def reached(self) -> observers.Reached:
        """Where the observer stands."""
        if self._state is None:
            raise ValueError("there have been no samples")
        return self._state
