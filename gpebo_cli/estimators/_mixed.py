"""Estimates from mixed regressions: groups of cases that share an extension, one γ each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.estimators._base import axis, number, per_parameter
from gpebo_cli.estimators._mixing import mix
from gpebo_cli.estimators._scalar import ScalarPath, scalar_law
from gpebo_cli.regression import LinearRegression
from gpebo_cli.result import Requirement
from gpebo_cli.systems.descriptor import Array

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


Extension = Callable[[LinearRegression, Array], Trajectory]  # (regression, rates) -> [Ω | 𝒴]


def estimate_mixed(
    regression: LinearRegression, t: Array, extend: Extension, settings: MixedSettings
) -> MixedEstimates:
    """Extend by filters, mix, and keep what the closed form needs at the times t (M,)."""
    names = regression.parameters
    return MixedEstimates(
        groups=(mix(extend(regression, filter_rates(settings.rates, names)), t),),
        start=per_parameter(settings.initial, names, "estimator.initial"),
        gains=gain_matrix(settings.gamma, names, "estimator.gamma"),
        condition="Δ not in L2",
        realisations=regression.realisations,
    )


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


# (η̂ (g, M, P), γ∫Δ² (g, M, P or 1), η̂ at the start (P,)) -> estimates
Transform = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True, eq=False)
class MixedEstimates:
    """One mixed regression per group; case i belongs to group i // g and has gain i % g."""

    groups: tuple[ScalarPath, ...]
    start: Array  # (p,)
    gains: Array  # (g, p or 1)
    condition: str
    needed: float = ONE_PERCENT  # of γ∫Δ²
    needed_for: str = "1 % of the initial error"
    transform: Transform | None = None
    realisations: tuple[int, ...] = ()

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

    def parameters(self, cases: slice) -> Array:
        """η̂ of some cases, shape (g, M, p) or (g, M, p, c)."""
        g, c = len(self.gains), self.groups[0].quotient.shape[-1] // len(self.start)
        start = np.repeat(self.start, c)
        first, last, _ = cases.indices(g * len(self.groups))
        pieces = []
        for group in range(first // g, (max(last, 1) - 1) // g + 1):
            path = self.groups[group]
            gains = self.gains[max(first - group * g, 0) : min(last - group * g, g)]
            if gains.shape[1] > 1:  # one for each parameter, and for each of its realisations
                gains = np.repeat(gains, c, axis=1)
            eta = scalar_law(path, start, gains)
            if self.transform is not None:
                eta = self.transform(eta, gains[:, None, :] * path.energy_at_t[:, None], start)
            pieces.append(eta)
        estimates = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
        return estimates.reshape(*estimates.shape[:2], len(self.start), *self.realisations)
