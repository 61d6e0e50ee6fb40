"""Estimates from mixed regressions: groups of cases that share an extension, one γ each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from gpebo_cli.estimators._base import axis, number, per_parameter
from gpebo_cli.estimators._mixing import mix
from gpebo_cli.estimators._scalar import ScalarPath, scalar_law
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.linear import ExtensionState, LinearRegression, largest

ONE_PERCENT = float(np.log(100.0))


def gain_axis(gamma: object, where: str) -> dict[str, Sequence[float]]:
    """Axes of γ: one axis, or for a gain per parameter one axis of length one each."""
    if isinstance(gamma, Mapping):
        return {
            f"gamma_{key}": (number(value, f"{where}.{key}"),) for key, value in gamma.items()
        }
    return {"gamma": axis(gamma, where)}


def gain_matrix(gamma: object, parameters: Sequence[str], where: str) -> Array:
    """γ of every value of the axis, shape (g, 1), or (1, p) for a gain per parameter."""
    if isinstance(gamma, Mapping):
        return per_parameter(gamma, parameters, where, positive=True)[None]
    return np.array(axis(gamma, where))[:, None]


def filter_rates(rates: object, parameters: tuple[str, ...]) -> Array:
    """One λ per parameter, shape (p,); by default 0.1, 0.2, 0.3, …"""
    if rates is None:
        return 0.1 * np.arange(1.0, len(parameters) + 1.0)
    return per_parameter(rates, parameters, "estimator.lambda", positive=True)


# (regression, rates, start) -> [Ω | 𝒴]
Extension = Callable[[LinearRegression, Array, Array | None], Trajectory]


def estimate_mixed(
    regression: LinearRegression, t: Array, extend: Extension, settings: MixedSettings,
    known: Sequence[ExtensionState], *, linear: bool = False,
) -> MixedEstimates:
    """Extend by filters, mix, and keep what the closed form needs at the times t (M,)."""
    names = regression.parameters
    extended = extend(
        regression, filter_rates(settings.rates, names), known[0].values if known else None
    )
    return MixedEstimates(
        groups=(mix(extended, t, regression.floor),),
        at_end=lambda: (reached(regression, extended, known, linear=linear),),
        start=per_parameter(settings.initial, names, "estimator.initial"),
        gains=gain_matrix(settings.gamma, names, "estimator.gamma"),
        condition="Δ not in L2",
        realisations=regression.realisations,
    )


def reached(
    regression: LinearRegression, extended: Trajectory, known: Sequence[ExtensionState],
    *, linear: bool = False,
) -> ExtensionState:
    """[Ω | 𝒴] (p, p + 1) at the end.

    No filter exceeds the largest ψᵀψ, or for Lion's filters ψ, that went in.
    """
    level = largest(regression.outer.values)
    if linear:
        level = np.sqrt(regression.p * level)
    level = max(level, known[0].level) if known else level
    return ExtensionState(extended.final, level, surplus=1.0)


class MixedSettings(Protocol):
    """What every filtered and mixed estimator is set by."""

    @property
    def gamma(self) -> object:
        """γ of the scalar laws."""
        ...

    @property
    def rates(self) -> object:
        """λ of the filters."""
        ...

    @property
    def initial(self) -> object:
        """η̂ at the start."""
        ...


def energy_requirement(
    condition: str, gain: float, energy: float, needed: float = ONE_PERCENT,
    needed_for: str = "1 % of the initial error",
) -> Requirement:
    """Whether ∫Δ² is enough at the smallest gain: the error shrinks by e^{−γ∫Δ²}."""
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
            f"γ∫Δ² = {reached:.3g} at the smallest gain {gain:.3g}; "
            f"{needed_for} needs {needed:.3g}"
        ),
    )


# (η̂ (g, M, P), γ∫Δ² (g, M, P or 1), η̂ at the start (1 or g, 1, P)) -> estimates
Transform = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True, eq=False)
class MixedEstimates:
    """One mixed regression per group; case i belongs to group i // g and has gain i % g."""

    groups: tuple[ScalarPath, ...]
    start: Array  # (p,)
    gains: Array  # (g, p or 1)
    condition: str
    at_end: Callable[[], tuple[ExtensionState, ...]]  # of each group; asked for at resets only
    needed: float = ONE_PERCENT  # of γ∫Δ²
    needed_for: str = "1 % of the initial error"
    transform: Transform | None = None
    realisations: tuple[int, ...] = ()

    @cached_property
    def reached(self) -> tuple[ExtensionState, ...]:
        """The extension of each group at the end."""
        return self.at_end()

    def delta(self, t: Array) -> Array:
        """Δ at the times t (M,), one row if it is the same for every case, else one per case."""
        rows = [path.delta(t) for path in self.groups]
        return np.array(rows) if len(rows) == 1 else np.repeat(rows, len(self.gains), axis=0)

    @property
    def requirement(self) -> Requirement:
        """γ∫Δ² over the horizon: the error has shrunk by its exponential."""
        energies = [float(path.energy_at_t[-1]) for path in self.groups]
        return energy_requirement(
            self.condition, float(self.gains.min()), min(energies), self.needed, self.needed_for
        )

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases, shape (g, M, p) or (g, M, p, c), from ``start`` (g, p) if given."""
        g, c = len(self.gains), self.groups[0].quotient.shape[-1] // len(self.start)
        usual = np.repeat(self.start, c)
        first, last, _ = cases.indices(g * len(self.groups))
        pieces: list[Array] = []
        done = 0
        for group in range(first // g, (max(last, 1) - 1) // g + 1):
            path = self.groups[group]
            gains = self.gains[max(first - group * g, 0) : min(last - group * g, g)]
            if gains.shape[1] > 1:  # one for each parameter, and for each of its realisations
                gains = np.repeat(gains, c, axis=1)
            own = usual
            if start is not None:
                own = np.repeat(start[done : done + len(gains)], c, axis=1)
            done += len(gains)
            eta = scalar_law(path, own, gains)
            if self.transform is not None:
                energy = gains[:, None, :] * path.energy_at_t[:, None]
                eta = self.transform(eta, energy, np.atleast_2d(own)[:, None])
            pieces.append(eta)
        estimates = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
        return estimates.reshape(*estimates.shape[:2], len(self.start), *self.realisations)
