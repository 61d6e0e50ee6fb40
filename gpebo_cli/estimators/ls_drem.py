"""LS+DREM: least squares as the extension, so that interval excitation is enough.

Ortega, Romero, Aranovskiy, Systems & Control Letters 169 (2022) 105377, cited by the paper as the
estimator that Proposition 1 needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gpebo_cli.estimators._base import ResumableEstimator, gain
from gpebo_cli.estimators._information import (
    CLEAR,
    Information,
    InformationAt,
    Spectrum,
    check_held,
)
from gpebo_cli.estimators._mixed import (
    MixedEstimates,
    RecursiveMixed,
    mixed_estimates,
    scalar_errors,
)
from gpebo_cli.estimators._recursive import Mixed, quotient_of
from gpebo_cli.estimators._scalar import SINGULAR, Pace, ScalarPath, filled, scalar_path
from gpebo_cli.estimators.least_squares import LeastSquares, RecursiveLeastSquares, f0_of
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Known
from gpebo_cli.regression.samples import SampledRegression, integrating

_AT_ONCE = 4096  # elements
_NO_TIME = 1e-300  # seconds, at the start
# A law of the rate 50/t forgets what rounding made of the first data that tell anything. It is
# followed from the first of these times on, and known from the second one on, in times they took.
_WITHOUT, _FORGOTTEN = 1.25, 1.5
_F0 = 1e-4  # beside a γ that is given


@dataclass(frozen=True, kw_only=True)
class LsDrem(ResumableEstimator):
    """H = I − z f₀ F, Δ = det H, 𝐘 = adj(H)(ĝ − z f₀ F ĝ₀), then η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    ĝ and F are the estimate and the covariance of the least-squares part, z' = −βz its memory.
    Without forgetting H = αG (f₀I + αG)⁻¹, so 0 ≤ Δ < 1 never falls and, once ψ was exciting,
    Δ is not square integrable: a γ of order 1 does what 1e10 does behind fading filters.

    Attributes:
        gamma: γ, also by parameter; None: 50 over the length of the memory, ∫ e^{−β(t−s)} ds, so
            that no unit and no horizon has a part in it.
        alpha, f0, beta, bound: of the least-squares part, see ``least_squares``; beside a γ that
            is given f₀ is 1e-4 where nothing was said.
        initial: η̂ (and ĝ) at the start.
    """

    alpha: object = gain(1.0)
    f0: object = gain(None, relative=1.0)
    beta: object = gain(0.0, "nonnegative")
    bound: object = None
    gamma: object = gain(None, by_parameter=True, auto=True, relative=50.0)

    def __post_init__(self) -> None:
        """A γ has a unit, and so has the f₀ beside it."""
        if self.gamma is not None and self.f0 is None:
            object.__setattr__(self, "f0", _F0)

    @property
    def least_squares(self) -> LeastSquares:
        """The part that extends the regressor."""
        return self.part(LeastSquares)

    def axes(self) -> dict[str, Sequence[float]]:
        """α, f₀, β and γ, checked as the least-squares part checks them."""
        self.least_squares.axes()
        return super().axes()

    def errors(self, regression: LinearRegression, known: Known = ()) -> tuple[ErrorsAt, ...]:
        """δh_z as of least squares, δη̂' = γΔ(adj(H) αF δh_z − Δ δη̂), of every case.

        Without an f₀ rounding decides at first what 𝐘/Δ is, and errors are unknown until that is
        forgotten.
        """
        part = self.least_squares

        def at(
            case: Mapping[str, float], info: Information, gain: Array, t: Array, inside: Array
        ) -> ErrorSystem:
            here, into = info.at(t, inside), transpose(regression.psi(t, inside))
            rate = here.forgetting(case["alpha"], f0_of(case), case["beta"], part.covariance_bound)
            if self.gamma is None:
                gain = gain * one_over_memory(t, case["beta"], info.since)[:, None]
            elapsed = t - info.since
            followed = elapsed >= _WITHOUT * info.told
            delta, adjugate, digits = here.mixing(case["alpha"], f0_of(case), followed)
            rates = np.broadcast_to(rate[:, None], adjugate.shape[:2])
            if here.units is None:
                return scalar_errors(rates, into, delta, adjugate, gain)
            delta[(digits <= SINGULAR) | ~followed] = 0.0
            found = scalar_errors(rates, into, delta, adjugate, gain)
            unknown = (digits <= SINGULAR) | (elapsed < _FORGOTTEN * info.told)
            return found._replace(C=np.where(unknown[:, None, None], np.nan, found.C))

        pairs = zip(part.cases, part.informations(regression, known), strict=True)
        gains = self.gains("gamma", regression.parameters)
        return tuple(partial(at, case, info, gain) for case, info in pairs for gain in gains)

    def recursive(self, parameters: Sequence[str], mu: float = 1.0) -> RecursiveMixed:
        """The estimator at samples, for parameters of these names; ``mu`` as of the scalar law."""
        part, paced = self.least_squares, self.gamma is None
        mixing = partial(_mixed, part.recursive(parameters), part.cases, paced)
        return RecursiveMixed(self, parameters, mixing, "IE", len(part.cases), mu, paced=paced)

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> MixedEstimates:
        """Mix every combination of α, f₀, β at the times t (M,), each with a path of its own."""
        part = self.least_squares
        check_held(regression, len(part.cases))
        infos = part.informations(regression, known)
        groups = tuple(
            mix_least_squares(
                info, case["alpha"], f0_of(case), t, regression.floor,
                partial(one_over_memory, beta=case["beta"], began=info.since)
                if self.gamma is None else None,
            )
            for info, case in zip(infos, part.cases, strict=True)
        )
        return mixed_estimates(
            self, regression, groups, lambda: tuple(info.reached for info in infos), known, "IE"
        )


def one_over_memory(t: Array, beta: float, began: float = 0.0) -> Array:
    """1/∫ e^{−β(t−s)} ds at the times t (N,), from when data were first gathered, in 1/s."""
    elapsed = np.maximum(t - began, _NO_TIME)
    pace = beta / -np.expm1(-beta * elapsed) if beta else 1.0 / elapsed
    return np.where(t < began, 0.0, pace)


def _mixed(
    part: RecursiveLeastSquares, cases: Sequence[Mapping[str, float]], paced: bool,
    regression: SampledRegression,
) -> Mixed:
    """Least squares at samples, and mixing; a group for each of its cases."""
    spectra, elapsed = part.spectra(regression)
    delta = [
        s.delta(case["alpha"], f0_of(case)) for s, case in zip(spectra, cases, strict=True)
    ]
    quotient, usable, inverse = zip(*map(quotient_of, spectra), strict=True)
    return Mixed(
        np.stack(delta, axis=1), np.stack(quotient, axis=1), np.stack(usable, axis=1),
        lambda: ([integrating(regression, case["beta"]) for case in cases], inverse),
        np.stack([one_over_memory(elapsed, case["beta"]) for case in cases], axis=1)
        if paced else 1.0,
    )


def mix_least_squares(
    info: Information, alpha: float, f0: float, t: Array, floor: float = 0.0,
    pace: Pace | None = None,
) -> ScalarPath:
    """The path of H = I − z f₀ F that the scalar law takes, reported at the times t (M,).

    In the eigenbasis of G_z, H = diag(h_i) with h_i = αλ_i/(αλ_i + z f₀), without cancellation.
    𝐘 = adj(H) F α h_z, because ĝ − z f₀ F ĝ₀ = F α h_z, and so 𝐘/Δ = G_z⁻¹ h_z.
    """
    mesh = info.gram.mesh

    def signals(t: Array, inside: Array) -> tuple[Array, Array, Array]:
        delta, quotient, digits, s = _mixed_at(info.at(t, inside), alpha, f0)
        Y = delta[:, None, None] * quotient
        if info.units is None:
            known = (digits > SINGULAR)[:, None, None]
            Y = np.where(known, Y, s.vectors @ (s.adjugate(alpha, f0)[..., None] * s.rotated))
        return delta, Y.reshape(len(t), -1), digits

    shape = mesh.points.shape
    digits, delta = np.empty(shape), np.empty(shape)
    rows, columns = info.gram.values.shape[-2:]
    quotient = np.empty((*shape, rows * (columns - rows)))
    for first in range(0, mesh.size, _AT_ONCE):  # all spectra at once would take much memory
        part = slice(first, first + _AT_ONCE)
        at = info.at(mesh.points[part].ravel(), mesh.inside[part].ravel())
        found = _mixed_at(at, alpha, f0)[:3]
        for whole, own in zip((delta, quotient, digits), found, strict=True):
            whole[part] = own.reshape(-1, *whole.shape[1:])
    usable = digits > SINGULAR
    return scalar_path(mesh, signals, delta, digits, filled(quotient, usable), t, floor, pace)


def _mixed_at(
    at: InformationAt, alpha: float, f0: float
) -> tuple[Array, Array, Array, Spectrum]:
    """Δ (M,), 𝐘/Δ = G_z⁻¹ h_z (M, p, c), its digits (M,), and the spectrum that H is of.

    The quotient is solved in parameters' own units: others may hide most digits, and those of Δ.
    """
    (quotient, digits), s = at.in_own_units.quotient(), at.spectrum
    delta, few = s.delta(alpha, f0), s.digits < CLEAR
    if at.units is None and few.any():
        delta[few] = at.some(few).mixing(alpha, f0, few[few])[0]
    return delta, quotient, digits, s


ESTIMATOR = LsDrem
