"""Least squares with or without forgetting, in information form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators._base import ResumableEstimator, gain
from gpebo_cli.estimators._information import (
    CLEAR,
    Information,
    InformationAt,
    Spectrum,
    check_held,
    information,
    prior_units,
)
from gpebo_cli.estimators._recursive import InformationRoot, spectrum
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import reciprocals, transpose
from gpebo_cli.regression.dynamics import Dynamics, filtered, state_of
from gpebo_cli.regression.errors import ErrorRecursion, ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import Found, Lasting, SampledEstimates, Unmixed
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Known
from gpebo_cli.regression.samples import SampledRegression, integrating
from gpebo_cli.schema import number

_DIGITS = 1e-12  # reciprocal condition of Ω below which some direction is rounding
_FILTERED = 1e-11  # error of Ω that is filtered, relative
_NEEDED = 99.0  # αλ_min(G)/f₀: 1 % of the initial error is left
_FEW = 3  # gains, and
_SMALL = 8  # parameters, from which on a few systems are solved instead of taking eigenvectors


@dataclass(frozen=True, kw_only=True)
class LeastSquares(ResumableEstimator):
    """η̂' = α F ψᵀ(Y − ψη̂), F' = −α F ψᵀψ F + β F, F(0) = I/f₀.

    Without forgetting η̂ = (f₀ I + α G)⁻¹ (f₀ η̂₀ + α h): it converges as f₀/(α λ_min(G)).

    Attributes:
        alpha: α > 0.
        f0: f₀ > 0; None: nothing is known at the start, and η̂ leaves η̂₀ when data tell more than
            rounding.
        beta: forgetting rate ≥ 0; 0 remembers everything.
        bound: M ≥ 1/f₀ of β (1 − ‖F‖/M), or None for constant forgetting.
    """

    alpha: object = gain(1.0)
    f0: object = gain(1e-6, relative=1.0)
    beta: object = gain(0.0, "nonnegative")
    bound: object = None

    def axes(self) -> dict[str, Sequence[float]]:
        """The gains as axes, f₀ checked against the bound.

        ConfigError: a gain is no gain, M is below 1/f₀, or there is an M without an f₀.
        """
        axes = super().axes()
        bound = self.covariance_bound
        if bound is not None and "f0" not in axes:
            raise ConfigError(
                f"estimator.bound = {bound:g} is one of the covariance, which starts at 1/f0: give "
                "estimator.f0, too"
            )
        if bound is not None and bound < 1.0 / min(axes["f0"]):
            raise ConfigError(
                f"estimator.bound = {bound:g} is below 1/f0 = {1.0 / min(axes['f0']):g}, where the "
                "covariance starts"
            )
        return axes

    @property
    def covariance_bound(self) -> float | None:
        """M as a number, or None without a bound."""
        return None if self.bound is None else number(self.bound, "estimator.bound")

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δh_z' = −β δh_z + ψᵀδY, δη̂ = αF δh_z, of every case; after a reset η̂₀ has an error, too.

        That of η̂ contains (I − αF G_z) δη̂₀.
        """

        def at(
            case: Mapping[str, float], info: Information, t: Array, inside: Array
        ) -> ErrorSystem:
            here, into = info.at(t, inside), transpose(regression.psi(t, inside))
            rate = here.forgetting(case["alpha"], f0_of(case), case["beta"], self.covariance_bound)
            A = -rate[:, None, None] * np.eye(regression.p)
            C = here.covariance(case["alpha"], f0_of(case))
            found = ErrorSystem(A, into, C, np.zeros((1, *into.shape[1:])))
            if not known or regression.whole is not None:
                return found
            return found.with_constants(np.eye(regression.p) - C @ here.values[..., : regression.p])

        infos = self.informations(regression, known)
        return tuple(map(partial, repeat(at), self.cases, infos))

    def informations(self, regression: LinearRegression, known: Known) -> list[Information]:
        """G_z, h_z and z of every case, from what was known before; equal ones are one."""
        bound, cases = self.covariance_bound, self.cases
        bounded = bound is not None and max(case["beta"] for case in cases) > 0.0
        needed = ["alpha", "f0", "beta"] if bounded else ["beta"]
        keys = [tuple(case.get(name) for name in needed) for case in cases]
        check_held(regression, len(set(keys)))
        made: dict[tuple[float | None, ...], Information] = {}
        for key, case, before in zip(keys, cases, known or repeat(None), strict=False):
            if key not in made:
                made[key] = information(
                    regression, case["alpha"], case.get("f0"), case["beta"], bound, before
                )
        return [made[key] for key in keys]

    def recursive(self, parameters: Sequence[str]) -> RecursiveLeastSquares:
        """The estimator at samples.

        ConfigError: forgetting with a bound, which there is in continuous time only.
        """
        if self.bound is not None:
            raise ConfigError(
                "estimator.bound works in continuous time only; at samples leave it null"
            )
        return RecursiveLeastSquares(self, parameters)

    def estimate_moving(
        self, regression: LinearRegression, t: Array, known: Known, dynamics: Dynamics
    ) -> Found:
        """η̂ = F 𝒴 with F⁻¹ and 𝒴 from (f₀ I, f₀ η̂₀), at the times t (M,).

        They forget at the rate β + ρ (ConfigError: forgetting with a bound).
        """
        if self.covariance_bound is not None:
            raise ConfigError(
                "observer.remedy=current_coordinates: least squares forgets at a constant rate; "
                "accepted: estimator.bound=null"
            )
        p = regression.p
        prior = np.column_stack([np.eye(p), self.start(regression.parameters)])
        whole = regression.whole or regression
        ones, begin, last = np.ones(p), whole.mesh.edges[0], whole.mesh.edges[-1]
        reached, from_data = list[ExtensionState](), list[Array]()

        def extended(case: Mapping[str, float], before: ExtensionState | None) -> Array:
            """[F⁻¹ | 𝒴] at the times t, (M, p, p + 1)."""
            state = [before or ExtensionState(case.get("f0", 0.0) * prior, 0.0)]
            filters = regression.outer, case["beta"] * ones, case["alpha"] * ones, dynamics
            found = filtered(*filters, state)
            reached.append(state_of(found, state))
            gram = own = found(t)
            # What the prior has in F⁻¹ at the end is the rest; of windows, β > 0 has forgotten it.
            if "f0" in case and regression.mesh.edges[-1] == last:
                if not case["beta"]:
                    own = case["alpha"] * whole.gram_final[None]
                elif regression is whole:
                    own = filtered(*filters).final[None]
            from_data.append(own[-1])
            if "f0" not in case:
                energy = np.einsum("mjj->mj", gram[..., :p])
                rounding = regression.rounding_of(gram, t)
                units = prior_units(energy, regression.terms(t), t - begin, rounding)
                gram = gram + units[..., None] ** 2 * prior
            return gram

        of_cases = zip(self.cases, known or repeat(None), strict=False)
        extensions = np.array([extended(*own) for own in of_cases])
        own = np.array(from_data)[..., :p]
        found = solved(extensions, own, dynamics.units, prior=self.f0 is not None)
        return replace(found, reached=tuple(reached))

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> LeastSquaresEstimates:
        """Everything but the gains, at the times t (M,).

        After a reset the prior z f₀ I is about the new parameters, centred at the estimate there.
        """
        infos = self.informations(regression, known)
        at = {id(info): info.at(t) for info in infos}
        return LeastSquaresEstimates(
            self.cases, [at[id(info)] for info in infos], self.start(regression.parameters),
            tuple(info.reached for info in infos), regression.realisations,
            regression.whole is not None,
        )


def solved(extended: Array, from_data: Array, units: Array, *, prior: bool = True) -> Found:
    """η̂ = F 𝒴 from [F⁻¹ | 𝒴] of every case (cases, M, p, p + 1), where that is more than rounding.

    It is solved in units of each parameter's own size; directions of rounding are left at zero.
    Whether it is regular at the end is judged in ``units`` (p,) in which they are comparable. What
    is there of F⁻¹ ``from_data`` (cases, p, p) has to be more than what is left of the prior.
    """
    square = np.einsum("cmii->cmi", extended[..., :-1])
    size = np.sqrt(np.where(square > 0.0, square, 1.0))[..., None]
    eigenvalues, V = np.linalg.eigh(extended[..., :-1] / size / transpose(size))
    told = eigenvalues > _DIGITS * eigenvalues[..., -1:]
    share = reciprocals(eigenvalues, told)[..., None]
    eta = V @ (share * (transpose(V) @ (extended[..., -1:] / size))) / size
    final = np.linalg.svd(extended[:, -1, :, :-1] * units * units[:, None], compute_uv=False)
    worst = float((final[:, -1] / final[:, 0]).min())
    root = V[:, -1] * np.sqrt(reciprocals(eigenvalues[:, -1], told[:, -1]))[:, None]
    own = from_data / size[:, -1] / transpose(size[:, -1])
    # Rounding of F⁻¹ in its weakest direction may look like a prior of so much.
    rounding = _FILTERED / np.maximum(eigenvalues[:, -1, 0] / eigenvalues[:, -1, -1], _FILTERED)
    left = 1.0 - np.linalg.eigvalsh(transpose(root) @ own @ root)[:, 0] - rounding
    reached = float((1.0 / np.maximum(left, _DIGITS) - 1.0).min())
    if worst >= _DIGITS and reached < _NEEDED:
        return Found(np.asarray(eta[..., 0]), ratio_requirement(reached, prior))
    return Found(np.asarray(eta[..., 0]), Requirement(
        name="F⁻¹ regular", holds=worst >= _DIGITS,
        evidence={"reciprocal_condition": worst, "needed": _DIGITS},
        text=f"σ_min/σ_max of F⁻¹ is {worst:.2g} at the end; needed is {_DIGITS:.0e}",
    ))


@dataclass(frozen=True, eq=False)
class LeastSquaresEstimates(Unmixed, Lasting):
    """The regularised solution of every case."""

    cases: tuple[Mapping[str, float], ...]
    known: list[InformationAt]
    start: Array  # (p,)
    reached: tuple[ExtensionState, ...]  # of each case
    realisations: tuple[int, ...] = ()
    window: bool = False  # of a long regression, whose prior is about the start of the first one

    @property
    def requirement(self) -> Requirement:
        """α λ_min(G)/f₀ at the horizon: the slowest direction's error has shrunk by 1 + that."""
        ratios = [
            case["alpha"] * own.smallest / (f0_of(case) * float(own.memory[-1]))
            if own.memory[-1] > 0
            else np.inf
            for case, own in zip(self.cases, self.known, strict=True)
        ]
        return ratio_requirement(float(min(ratios)), self.known[0].units is None)

    def weights(self, case: int) -> Array:
        """z f₀I + αG_z (M, p, p)."""
        s, gains = self.known[case].spectrum, self.cases[case]
        values = gains["alpha"] / s.share(gains["alpha"], f0_of(gains))
        return np.asarray((s.covectors * values[:, None]) @ transpose(s.covectors))

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases, shape (g, M, p) or (g, M, p, c), from ``start`` (g, p) if given."""
        chosen, known = self.cases[cases], self.known[cases]
        starts = np.broadcast_to(
            self.start if start is None or self.window else start, (len(chosen), len(self.start))
        )
        few = len(self.cases) <= _FEW and len(self.start) > _SMALL
        eta = []
        for case, at, own in zip(chosen, known, starts, strict=True):
            gains = case["alpha"], f0_of(case), own
            alone = few or (at.units is None and at.spectrum.digits[-1] < CLEAR)
            eta.append(at.solution(*gains) if alone else at.spectrum.solution(*gains))
        found = np.array(eta)
        return found.reshape(*found.shape[:3], *self.realisations)


def ratio_requirement(reached: float, prior: bool) -> Requirement:
    """Whether α λ_min(G) is enough beside f₀ or, without such a ``prior``, beside rounding."""
    beside = "f₀" if prior else "what is rounding"
    return Requirement(
        name="λ_min(G) → ∞", holds=reached >= _NEEDED,
        evidence={"alpha_lambda_min_over_f0": reached, "needed": _NEEDED},
        text=f"α λ_min(G) is {reached:.3g} times {beside}; 1 % of the initial error needs "
        f"{_NEEDED:g}",
    )


class RecursiveLeastSquares:
    """Least squares at samples, every case from one factor per forgetting rate."""

    def __init__(self, settings: LeastSquares, parameters: Sequence[str]) -> None:
        self._cases = settings.cases
        self._start = settings.start(parameters)
        betas, self._which = np.unique([c["beta"] for c in self._cases], return_inverse=True)
        self._root = InformationRoot(len(parameters), betas)
        self._own, self._elapsed = settings.f0 is None, 0.0
        self._ratio = 0.0

    def spectra(self, regression: SampledRegression) -> tuple[list[Spectrum], Array]:
        """The spectrum of G_z at the samples, of every case, and the seconds of data (K,)."""
        (roots, memory), p = self._root.update(regression), regression.p
        elapsed, found = self._elapsed + np.cumsum(regression.steps), []
        self._elapsed = float(elapsed[-1])
        for d in range(roots.shape[1]):
            root, z, units = roots[:, d], memory[:, d], None
            if self._own:
                energy = (root[..., :p] ** 2).sum(axis=1)
                z, units = np.ones_like(z), prior_units(energy, regression.scale, elapsed)
            found.append(spectrum(root, z, units))
        return [found[d] for d in self._which], elapsed

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each."""
        pairs = list(zip(self._cases, self.spectra(regression)[0], strict=True))
        ratios = np.min([
            case["alpha"] * s.eigenvalues.min(axis=1, initial=np.inf) / (f0_of(case) * s.memory)
            for case, s in pairs
        ], axis=0)
        self._ratio = float(ratios[-1])
        eta = np.array([s.solution(case["alpha"], f0_of(case), self._start) for case, s in pairs])

        def errors() -> tuple[ErrorRecursion, ...]:
            """δη̂ = αF δh_z."""
            return tuple(
                ErrorRecursion(
                    *integrating(regression, case["beta"]), s.covariance(case["alpha"], f0_of(case))
                )
                for case, s in pairs
            )

        return SampledEstimates(eta[..., 0], None, errors, ratios >= _NEEDED)

    @property
    def requirement(self) -> Requirement:
        """α λ_min(G)/f₀ so far."""
        return ratio_requirement(self._ratio, not self._own)


def f0_of(case: Mapping[str, float]) -> float:
    """f₀, or 1 in the units of rounding where there is none."""
    return case.get("f0", 1.0)


ESTIMATOR = LeastSquares
