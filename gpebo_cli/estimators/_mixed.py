"""Estimates from mixed regressions: groups of cases that share an extension, one γ each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from gpebo_cli.estimators._base import GainEstimator, ResumableEstimator, filtered_errors, gain
from gpebo_cli.estimators._recursive import KreisselmeierFilter, Mixed, ScalarLaw, mix_sampled
from gpebo_cli.estimators._scalar import ScalarPath, kreisselmeier, mix, resolved_for, scalar_law
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Requirement, would_do
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import (
    determinant_and_adjugate_action,
    determinant_and_inverse,
    transpose,
)
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import Lasting, SampledEstimates
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import ExtensionState, Known, level_of
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import per_name

_ONE_PERCENT = "1 % of the initial error"


def filter_rates(rates: object, parameters: Sequence[str]) -> Array:
    """One λ per parameter, shape (p,); by default 0.1, 0.2, 0.3, …"""
    if rates is None:
        return 0.1 * np.arange(1.0, len(parameters) + 1.0)
    return per_name(rates, parameters, "parameter", "estimator.lambda", "positive")


@dataclass(frozen=True, kw_only=True)
class FilteredEstimator(ResumableEstimator):
    """Filters as the extension (by default Kreisselmeier's), then mixing and the scalar law.

    Attributes:
        gamma: γ, also by parameter.
        rates: λ of the filters, a number, one per parameter, or a mapping by parameter; None is
            0.1, 0.2, 0.3, …, for three parameters the paper's choice.
    """

    gamma: object = gain(1e10, by_parameter=True, auto=True)
    rates: object = field(default=None, metadata={"key": "lambda"})

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> MixedEstimates:
        """Extend, mix, and keep what the closed form needs at the times t (M,)."""
        before = known[0].values if known else None
        extended = self.extend(regression, filter_rates(self.rates, regression.parameters), before)
        return mixed_estimates(
            self, regression, (mix(extended, t, regression.floor, regression.units),),
            lambda: (reached(self.size(regression), extended, known),), known,
        )

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δ𝒴 behind the filters, δη̂' = γΔ(adj(Ω) δ𝒴 − Δ δη̂), of every case."""
        rates, mixed = self.behind(regression, known)

        def at(gain: Array, t: Array, inside: Array) -> ErrorSystem:
            return scalar_errors(rates, *mixed(t, inside), gain)

        return tuple(partial(at, gain) for gain in self.gains("gamma", regression.parameters))

    def behind(
        self, regression: LinearRegression, known: Known = ()
    ) -> tuple[Array, Callable[[Array, Array], tuple[Array, Array, Array]]]:
        """Rates (p,) of the filters behind Y; what they take of it (N, p, rows), Δ and adj(Ω).

        The latter at times (N,) and where jumps are decided.
        """
        p, rates = regression.p, filter_rates(self.rates, regression.parameters)
        extended = self.extend(regression, rates, known[0].values if known else None)
        seen = self.seen(regression)

        def at(t: Array, inside: Array) -> tuple[Array, Array, Array]:
            delta, adjugate = determinant_and_adjugate(extended(t, inside)[..., :p])
            return rates[:, None] * seen(t, inside), delta, adjugate

        return rates, at

    def at_samples(self, rates: Array) -> KreisselmeierFilter:
        """The filters in discrete time, with rates of shape (p,)."""
        return KreisselmeierFilter(rates)

    def mixing(self, parameters: Sequence[str]) -> Mixing:
        """The filters at samples, and mixing; one group."""
        filters = self.at_samples(filter_rates(self.rates, parameters))
        return lambda regression: mix_sampled(
            filters.update(regression), filters.errors, regression.scale
        )

    def recursive(self, parameters: Sequence[str], mu: float = 1.0) -> RecursiveMixed:
        """The estimator at samples, for parameters of these names; ``mu`` as of the scalar law."""
        return RecursiveMixed(self, parameters, self.mixing(parameters), mu=mu)

    def seen(self, regression: LinearRegression) -> Callable[[Array, Array], Array]:
        """What the filters of 𝒴 take of Y at times (N,): ψᵀ (N, p, rows)."""
        return lambda t, inside: transpose(regression.psi(t, inside))

    def extend(self, regression: LinearRegression, rates: Array, start: Array | None) -> Trajectory:
        """Filtered [ψᵀψ | ψᵀY] (p, p + c), with the ``rates`` (p,), from ``start`` or 0."""
        return kreisselmeier(regression, rates, start)

    def size(self, regression: LinearRegression) -> Array:
        """What no filter's diagonal (p,) exceeds."""
        return level_of(regression.outer.values)


def determinant_and_adjugate(omega: Array) -> tuple[Array, Array]:
    """det(Ω) (N,) and adj(Ω) of Ω (N, p, p) by elimination, or its SVD where that is rounding."""
    delta, inverse, rest = determinant_and_inverse(omega)
    adjugate = delta[:, None, None] * inverse
    delta[rest], adjugate[rest], _ = determinant_and_adjugate_action(omega[rest])
    return delta, adjugate


def scalar_errors(
    filters: Array, into: Array, delta: Array, adjugate: Array, gain: Array
) -> ErrorSystem:
    """Errors of filters behind Y and of the scalar law behind them, δη̂' = γΔ(adj δf − Δ δη̂).

    The filters are as of ``filtered_errors``, with s states; Δ is (N,), γ (1,) or (p,), or at each
    time (N, …), and what makes δ𝐘 of the filters' errors (N, p, s).
    """
    weighted = delta[:, None, None] * gain[..., None]
    law = weighted * delta[:, None, None] * np.eye(adjugate.shape[1])
    return filtered_errors(filters, into, law, weighted * adjugate)


def reached(size: Array, extended: Trajectory, known: Known) -> ExtensionState:
    """[Ω | 𝒴] (p, p + 1) at the end, of filters whose input is of that ``size``."""
    level = np.maximum(size, known[0].level) if known else size
    return ExtensionState(extended.final, level, surplus=1.0)


def energy_requirement(
    gains: Array, energy: float, condition: str, needed: float,
    needed_for: str = _ONE_PERCENT, of: str = "∫Δ²", *, paced: bool = False,
) -> Requirement:
    """Whether ∫Δ² is enough at the smallest gain of (g, 1 or p): the error shrinks by e^{−γ∫Δ²}.

    If it is ``paced``, γ is one over the length T of the memory.
    """
    gain, least = float(gains.min()), needed / energy if energy > 0.0 else float("inf")
    reached = gain * energy
    return Requirement(
        name=condition,
        holds=reached >= needed,
        evidence={
            "integral_delta_squared": energy,
            "gamma_times_integral": reached,
            "needed": needed,
        },
        text=(
            (f"{gain:g} ∫Δ²/T = {reached:.3g}, T being the length of the memory; " if paced
             else f"γ{of} = {reached:.3g} at the smallest gain {gain:.3g}; ")
            + f"{needed_for} needs {needed:.3g}{'' if paced else would_do(gain, least)}"
        ),
        gain=least,
    )


def aim(condition: str, mu: float) -> tuple[str, float, str]:
    """The condition's name, how much γ∫Δ² is needed, and what for; with μ < 1 e^{−γ∫Δ²} ≤ 1 − μ."""
    if mu == 1.0:
        return condition, DECAY, _ONE_PERCENT
    return "IE with enough ∫Δ²", float(-np.log1p(-mu)), "finite-time convergence"


Mixing = Callable[[SampledRegression], Mixed]  # an extension, and Δ and η̄ at K samples


class RecursiveMixed:
    """An extension of held signals, mixing, a closed-form step of the scalar law."""

    def __init__(
        self, settings: GainEstimator, parameters: Sequence[str], mixing: Mixing,
        condition: str = "Δ not in L2", groups: int = 1, mu: float = 1.0, *, paced: bool = False,
    ) -> None:
        self._mixing, self._paced = mixing, paced
        self._aim = aim(condition, mu)
        gains = settings.gains("gamma", parameters)
        self._law = ScalarLaw(settings.start(parameters), gains, groups, mu, self._aim[1])

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each."""
        return self._law.update(regression, *self._mixing(regression))

    @property
    def requirement(self) -> Requirement:
        """γ∫Δ² so far, at the smallest gain and in the group that has the least."""
        law = self._law
        return energy_requirement(
            law.gains, float(law.energy.min()), *self._aim, paced=self._paced
        )


@dataclass(frozen=True, eq=False)
class MixedEstimates(Lasting):
    """One mixed regression per group; case i belongs to group i // g and has gain i % g."""

    groups: tuple[ScalarPath, ...]
    start: Array  # (p,)
    gains: Array  # (g, p or 1)
    condition: str
    at_end: Callable[[], tuple[ExtensionState, ...]]  # of each group; asked for at resets only
    mu: float = 1.0  # of finite time: w_c = min(e^{−γ∫Δ²}, 1 − μ) of the start is taken out
    realisations: tuple[int, ...] = ()
    known: Known = ()  # of each group at the start
    units: Array | float = 1.0  # (p,) in which parameters are comparable

    @cached_property
    def reached(self) -> tuple[ExtensionState, ...]:
        """The extension of each group at the end."""
        return tuple(
            replace(state, energy=energy)
            for state, energy in zip(self.at_end(), self.energies, strict=True)
        )

    @property
    def energies(self) -> list[float]:
        """∫Δ² of each group, with what was known before."""
        return [
            before + float(path.energy_at_t[-1])
            for before, path in zip(self.before, self.groups, strict=True)
        ]

    @property
    def before(self) -> list[float]:
        """∫Δ² of each group before the start."""
        return [state.energy for state in self.known] or [0.0] * len(self.groups)

    def delta(self, t: Array) -> Array:
        """Δ at the times t (M,), one row if it is the same for every case, else one per case."""
        rows = [path.delta(t) for path in self.groups]
        return np.array(rows) if len(rows) == 1 else np.repeat(rows, len(self.gains), axis=0)

    @property
    def requirement(self) -> Requirement:
        """γ∫Δ² over the horizon: the error has shrunk by its exponential."""
        aimed, paced = aim(self.condition, self.mu), self.groups[0].pace is not None
        return energy_requirement(self.gains, min(self.energies), *aimed, paced=paced)

    def law(self, path: ScalarPath, start: Array, gains: Array) -> Array:
        """η̂ (g, M, P) from ``start`` (P,) or (g, P) with ``gains`` (g, P or 1)."""
        each = np.broadcast_to(self.units, len(self.start))
        units = np.repeat(each, path.quotient.shape[-1] // len(each))
        return scalar_law(path, start, gains, units)

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases, shape (g, M, p) or (g, M, p, c), from ``start`` (g, p) if given."""
        g, c = len(self.gains), self.groups[0].quotient.shape[-1] // len(self.start)
        first, last, _ = cases.indices(g * len(self.groups))
        usual = self.start[None].repeat(c, axis=1)
        starts = usual.repeat(last - first, axis=0) if start is None else start.repeat(c, axis=1)
        pieces: list[Array] = []
        for group in range(first // g, (max(last, 1) - 1) // g + 1):
            path, before = self.groups[group], self.before[group]
            gains = self.gains[max(first - group * g, 0) : min(last - group * g, g)]
            if gains.shape[1] > 1:  # one for each parameter, and for each of its realisations
                gains = np.repeat(gains, c, axis=1)
            own, starts = starts[: len(gains)], starts[len(gains) :]
            if self.mu == 1.0:
                pieces.append(self.law(path, own, gains))
                continue
            # The law goes on from what it had, and not from what was made of it.
            first_one = usual if before else own
            w_c = np.minimum(np.exp(-gains * before), 1.0 - self.mu)
            eta = self.law(path, own + w_c * (first_one - own), gains)
            energy = gains[:, None] * (before + path.energy_at_t[:, None])
            w_c = np.minimum(np.exp(-energy), 1.0 - self.mu)
            pieces.append((eta - w_c * first_one[:, None]) / (1.0 - w_c))
        estimates = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
        return estimates.reshape(*estimates.shape[:2], len(self.start), *self.realisations)


def mixed_estimates(
    settings: GainEstimator, regression: LinearRegression, groups: tuple[ScalarPath, ...],
    at_end: Callable[[], tuple[ExtensionState, ...]], known: Known, condition: str = "Δ not in L2",
) -> MixedEstimates:
    """The estimates with the gains γ of some settings, of mixed regressions."""
    names, gains = regression.parameters, settings.gains("gamma", regression.parameters)
    groups = tuple(resolved_for(path, gains) for path in groups)
    return MixedEstimates(
        groups, settings.start(names), gains, condition, at_end,
        realisations=regression.realisations, known=known, units=regression.units,
    )
