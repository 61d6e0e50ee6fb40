"""Least squares in information form, with and without forgetting.

The covariance F of least squares, F' = −α F ψᵀψ F + β F with F(0) = I/f₀, is never integrated:
its inverse is linear. With the memory z = e^{−∫β} and

    G_z(t) = ∫ (z(t)/z(s)) ψᵀψ ds,      h_z(t) = ∫ (z(t)/z(s)) ψᵀY ds

    F⁻¹ = z f₀ I + α G_z,      η̂ = F (z f₀ η̂₀ + α h_z).

For β = 0, z = 1 and these are the Gram matrix and ∫ψᵀY: regularised batch least squares.

Without an f₀ nothing is known at the start. In the place of z f₀ I stands what rounding makes of
the diagonal of G_z: it depends on the data so far only, and each parameter is in its own unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gpebo_cli.errors import SolverError, check_memory
from gpebo_cli.estimators._scalar import MAX_ELEMENTS, SINGULAR, low_pass
from gpebo_cli.evidence.knowledge import own_sizes
from gpebo_cli.kernels import laws
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.errors import EPS
from gpebo_cli.numerics.linalg import determinant_and_inverse, products_of_others, transpose
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.linear import LinearRegression, interpolation_error
from gpebo_cli.regression.resets import ExtensionState, level_of

_PICARD_ROUNDS = 200
_FORGOTTEN = 1e-200  # z that makes no difference to anything any more
_LOOKED = np.geomspace(1e-4, 1.0, 86)  # of the time: there the first data that tell are sought
_HELD = 4  # arrays of the size of [G_z | h_z] with each

_OWN = 1e-2  # times λ_min/λ_max in parameters' own units: G has errors beyond rounding
_PART = 1e-12  # of what the largest part in Y is: a smaller one is rounding
_NOTHING = 1e-2  # in units of rounding: an eigenvalue that is zero
_PRIOR = 1e-3  # of what may be rounding stands for an f₀ that nobody gave
CLEAR = 1e-8  # λ_min/λ_max, from which on the units that are given cost no digits worth a word


@dataclass(frozen=True, eq=False)
class Information:
    """G_z and h_z with their memory z, on a mesh."""

    gram: Trajectory  # [G_z | h_z], shape (p, p + c)
    memory: Trajectory  # z, scalar
    level: Array  # (p,) diagonal of ∫ψᵀψ over this regression alone, or more
    began: float  # when data were first gathered
    since: float  # when all of them had begun to be
    # Units of parameters in which rounding of G_z is 1, by times (M,), its diagonal, and how wrong
    # rounding may make that (M, p); None: an f₀ says what is known at the start.
    units: Callable[[Array, Array, Array], Array] | None = None

    @property
    def reached(self) -> ExtensionState:
        """[G_z | h_z] and z at the end."""
        memory = float(self.memory.final)
        return ExtensionState(self.gram.final, self.level, memory, began=self.began)

    @cached_property
    def told(self) -> float:
        """When rounding no longer decides what G_z⁻¹h_z is, in seconds since ``since``, or ∞."""
        if self.units is None:
            return 0.0
        start, end = self.gram.mesh.edges[[0, -1]].tolist()
        start = min(max(start, self.since), end)
        t = np.append(start, start + (end - start) * _LOOKED)
        known = self.at(t).spectrum.digits > SINGULAR
        if not known.any():
            return np.inf
        return float(t[known.argmax()]) - self.since if not known[0] else 0.0

    def at(self, t: Array, inside: Array | None = None) -> InformationAt:
        """G_z, h_z and z at the times t (M,)."""
        mesh = self.gram.mesh
        sampler = mesh.sampler(t, inside)
        values, memory = sampler(self.gram.values), sampler(self.memory.values)
        if self.units is None:
            return InformationAt(values, memory)
        share = (t - mesh.edges[sampler.element]) / mesh.steps[sampler.element]
        rounding = interpolation_error(self.gram, sampler.element, share)
        energy = np.einsum("mjj->mj", values[..., : rounding.shape[1]])
        return InformationAt(values, np.ones_like(memory), self.units(t, energy, rounding))


def prior_units(
    energy: Array, terms: Array | float, elapsed: Array, rounding: Array | float = 0.0
) -> Array:
    """Units (M, p) in which about 1 of the diagonal of G_z is rounding; see ``own_sizes``."""
    sizes, share = own_sizes(energy, terms, elapsed)
    square = np.maximum(sizes**2 * share, rounding)
    return np.asarray(np.sqrt(np.where((energy > 0.0) | (terms > 0.0), _PRIOR * square, 1.0)))


@dataclass(frozen=True, eq=False)
class InformationAt:
    """G_z, h_z and z at M times."""

    values: Array  # (M, p, p + c) [G_z | h_z]
    memory: Array  # (M,); 1 in units of rounding
    units: Array | None = None  # (M, p) in which rounding is 1

    @property
    def gram(self) -> Array:
        """G_z (M, p, p), in the units of rounding where nothing is known at the start."""
        G = self.values[..., : self.values.shape[-2]]
        return G if self.units is None else G / self.units[..., None] / self.units[:, None]

    @cached_property
    def spectrum(self) -> Spectrum:
        """G_z = V diag(λ) Vᵀ, in the units of :attr:`gram`."""
        units, p = self.units, self.values.shape[-2]
        eigenvalues, vectors = np.linalg.eigh(self.gram)
        if units is None:
            rotated = transpose(vectors) @ self.values[..., p:]
            return Spectrum(np.maximum(eigenvalues, 0.0), vectors, rotated, self.memory)
        # Early in an element G_z is interpolated and may have negative eigenvalues. G_z η = h_z
        # holds all the same, and both sides may change their sign.
        size = np.abs(eigenvalues)
        order = np.argsort(size, axis=1)
        vectors = np.take_along_axis(vectors, order[:, None], 2) / units[..., None]
        sign = np.take_along_axis(np.sign(eigenvalues), order, 1)[..., None]
        rotated = sign * (transpose(vectors) @ self.values[..., p:])
        ascending = np.take_along_axis(size, order, 1)
        return Spectrum(ascending, vectors, rotated, self.memory, units)

    @cached_property
    def smallest(self) -> float:
        """The smallest eigenvalue of G_z at the last time."""
        last = self.some(slice(-1, None))
        return max(float(np.linalg.eigvalsh(last.gram)[0, 0]), 0.0)

    def solution(self, alpha: float, f0: float, start: Array) -> Array:
        """η̂ = (z f₀ I + α G_z)⁻¹ (z f₀ η̂₀ + α h_z), shape (M, p, c).

        The spectrum, which many gains share, is not needed for it, and units do not matter.
        """
        values, p = self.values, len(start)
        if start.any():
            values = values.copy()
            values[..., p:] -= values[..., :p] @ start[:, None]
        unit: Array | float = 1.0
        if self.units is not None:
            unit = self.units[..., None]
            values = values / unit
            values[..., :p] /= transpose(unit)
        _, found, _ = laws.mixed(values, self.memory * (f0 / alpha))
        return np.asarray(found / unit + start[:, None])

    def mixing(self, alpha: float, f0: float, asked: BoolArray) -> tuple[Array, Array, Array]:
        """Δ = det H (M,), adj(H) αF = Δ G_z⁻¹ (M, p, p), and digits where they may be few (M,).

        With H⁻¹ = I + z f₀ (α G_z)⁻¹, by elimination; by the spectrum where that has no digits and
        somebody ``asked`` (M,).
        """
        _, inverse, rest = determinant_and_inverse(self.gram)
        rest &= asked
        added = (self.memory * (f0 / alpha))[:, None, None] * inverse
        delta = 1.0 / np.linalg.det(np.eye(added.shape[1]) + added)
        adjugate, digits = delta[:, None, None] * inverse, np.ones(len(delta))
        if self.units is not None:
            adjugate /= self.units[..., None] * self.units[:, None]
        if rest.any():
            s = self.some(rest).spectrum
            delta[rest] = s.delta(alpha, f0)
            weighted = s.vectors * s.adjugate(alpha, f0)[:, None]
            adjugate[rest] = weighted @ transpose(s.vectors)
            digits[rest] = s.digits
        return delta, adjugate, digits

    def covariance(self, alpha: float, f0: float) -> Array:
        """αF = α (z f₀ I + α G_z)⁻¹, (M, p, p), by elimination; as in :class:`Spectrum` else."""
        G, prior = self.gram, self.memory * f0
        added = prior[:, None, None] * np.eye(G.shape[1])
        _, found, rest = determinant_and_inverse(alpha * G + added)
        if self.units is not None:
            size = np.linalg.norm(found, axis=(1, 2))
            rest |= size * (prior + alpha * _NOTHING) > 1.0  # an eigenvalue of G_z may be nothing
            found /= self.units[..., None] * self.units[:, None]
        found *= alpha
        if rest.any():
            found[rest] = self.some(rest).spectrum.covariance(alpha, f0)
        return found

    def some(self, chosen: BoolArray | slice) -> InformationAt:
        """The same at some of the times, chosen (M,) or as a slice."""
        units = None if self.units is None else self.units[chosen]
        return InformationAt(self.values[chosen], self.memory[chosen], units)

    def forgetting(self, alpha: float, f0: float, beta: float, bound: float | None) -> Array:
        """β, or β (1 − ‖F‖/M) with a bound M, (M,)."""
        if bound is None:
            return np.full(len(self.memory), beta)
        smallest = alpha * self.spectrum.eigenvalues[:, 0] + self.memory * f0
        return np.asarray(beta * (1.0 - 1.0 / (smallest * bound)))

    @cached_property
    def in_own_units(self) -> Spectrum:
        """The spectrum in units of each parameter's own size; other units may hide most digits."""
        if self.units is not None:
            return self.spectrum
        energy = np.einsum("mii->mi", self.values[..., : self.values.shape[-2]])
        units = np.sqrt(np.where(energy > 0.0, energy, 1.0))
        return replace(self, units=units).spectrum


@dataclass(frozen=True, eq=False)
class Spectrum:
    """G_z = V diag(λ) Vᵀ and Vᵀh_z at M times, or U G_z U = V diag(λ) Vᵀ, with units U and UV."""

    eigenvalues: Array  # (M, p) ascending
    vectors: Array  # (M, p, p) V, or U V
    rotated: Array  # (M, p, c) that transposed, times h_z
    memory: Array  # (M,) z
    units: Array | None = None  # (M, p) reciprocals of U

    @property
    def digits(self) -> Array:
        """Smallest eigenvalue over the largest, (M,); 0 where G_z = 0."""
        smallest, largest = self.eigenvalues[:, 0], self.eigenvalues[:, -1]
        found = np.divide(smallest, largest, out=np.zeros_like(largest), where=largest > 0.0)
        return found if self.units is None else _OWN * found

    @property
    def covectors(self) -> Array:
        """The vectors' inverse, transposed, (M, p, p)."""
        return self.vectors if self.units is None else self.units[..., None] ** 2 * self.vectors

    def solution(self, alpha: float, f0: float, start: Array) -> Array:
        """η̂ = (z f₀ I + α G_z)⁻¹ (z f₀ η̂₀ + α h_z), shape (M, p, c)."""
        kept = (self.memory * f0)[:, None] * np.einsum("mji,j->mi", self.covectors, start)
        coordinates = kept[..., None] / alpha + self.rotated
        return np.asarray(self.vectors @ (self.share(alpha, f0)[..., None] * coordinates))

    def share(self, alpha: float, f0: float) -> Array:
        """Eigenvalues of αF, (M, p); times those of G_z, what the data decide of each direction."""
        return np.asarray(alpha / (alpha * self.eigenvalues + (self.memory * f0)[:, None]))

    def delta(self, alpha: float, f0: float) -> Array:
        """Δ = det H (M,)."""
        return np.asarray(np.prod(self.eigenvalues * self.share(alpha, f0), axis=1))

    def adjugate(self, alpha: float, f0: float) -> Array:
        """Of adj(H) αF in the eigenbasis of G_z the diagonal (M, p)."""
        share = self.share(alpha, f0)
        return products_of_others(self.eigenvalues * share) * share

    def quotient(self) -> tuple[Array, Array]:
        """G_z⁻¹ h_z (M, p, c), zero where it is rounding, and to how many digits (M,)."""
        known = (self.digits > SINGULAR)[:, None, None]
        eigenvalues, zero = self.eigenvalues[..., None], np.zeros_like(self.rotated)
        inverse = np.divide(self.rotated, eigenvalues, out=zero, where=known)
        return self.without_rounding(self.vectors @ inverse), self.digits

    def without_rounding(self, eta: Array) -> Array:
        """η (M, p, c), zero where its part in Y is rounding beside those of the others.

        What is next to nothing in Y says nothing of its parameter, if it will grow or not.
        """
        if self.units is None:
            return eta
        part = np.abs(eta) * self.units[..., None]
        share = np.maximum(_PART, _OWN * EPS / np.maximum(self.digits, EPS))[:, None, None]
        return np.where(part > share * part.max(axis=1, initial=0.0, keepdims=True), eta, 0.0)

    def covariance(self, alpha: float, f0: float) -> Array:
        """αF = α (z f₀ I + α G_z)⁻¹, (M, p, p); 0 where rounding alone gives data a part."""
        share = self.share(alpha, f0)
        if self.units is not None:
            share = np.where(self.eigenvalues > _NOTHING, share, 0.0)
        return np.asarray((self.vectors * share[:, None]) @ transpose(self.vectors))


def check_held(regression: LinearRegression, count: int) -> None:
    """Refuse so many :func:`information` at once, where they would hold too much memory."""
    what = f"{count} combinations of alpha, f0 and beta, each with matrices of its own,"
    each = regression.gram_final.size * regression.mesh.points.size
    check_memory(what, _HELD * each * count)


def information(
    regression: LinearRegression, alpha: float, f0: float | None, beta: float,
    bound: float | None, known: ExtensionState | None = None,
) -> Information:
    """G_z, h_z and z for one set of gains, from those ``known`` at the start; None: 0, 0 and 1.

    With a bound M ≥ 1/f₀ forgetting is β = β₀ (1 − ‖F‖/M), else β = β₀ ≥ 0, where α and the size of
    f₀ do not matter.
    """
    final = regression.gram.final
    if known is None:
        began = float(regression.mesh.edges[0])
        known = ExtensionState(np.zeros_like(final), 0.0, began=began)
    level, began = np.maximum(level_of(final), known.level), known.began

    def units(t: Array, energy: Array, rounding: Array) -> Array:
        return prior_units(energy, regression.terms(t), t - began, rounding)

    def made(gram: Trajectory, memory: Trajectory) -> Information:
        since = max(began, regression.since)
        return Information(gram, memory, level, began, since, units if f0 is None else None)

    if beta == 0.0:
        gram = regression.gram
        if known.values.any():  # else it is the regression's own, which is held anyway
            gram = Trajectory(gram.mesh, gram.values + known.values)
        memory = np.full(regression.mesh.points.shape, known.memory)
        return made(gram, Trajectory(regression.mesh, memory))
    if bound is None:
        # β ∫ e^{−β(t−s)} (·) ds
        filtered = low_pass(regression.outer, np.array(beta), beta * known.values)
        mesh = filtered.mesh
        memory = known.memory * np.exp(-beta * (mesh.points - mesh.edges[0]))
        # Never 0, beside which what is not excited has a share of 0/0.
        memory = np.maximum(memory, _FORGOTTEN)
        return made(Trajectory(mesh, filtered.values / beta), Trajectory(mesh, memory))
    return made(*_bounded(regression, alpha, f0 or 0.0, beta, bound, known))


def _bounded(
    regression: LinearRegression, alpha: float, f0: float, beta0: float, bound: float,
    known: ExtensionState,
) -> tuple[Trajectory, Trajectory]:
    """[G_z | h_z] and z with forgetting that stops where ‖F‖ reaches the bound: β = β₀ (1 − ‖F‖/M).

    ‖F‖ = 1/λ_min(F⁻¹) depends on the past of β, so elements are solved one after the other, each
    by fixed-point iteration on β at its nodes; the map contracts with the element's length.
    """
    outer = regression.outer
    mesh = outer.mesh
    longest = 0.25 / beta0
    parts = np.maximum(1.0, np.ceil(mesh.steps / longest))
    if parts.sum() > MAX_ELEMENTS:
        raise SolverError(
            f"estimator.beta = {beta0:.6g} 1/s with a bound asks for {parts.sum():.3g} elements of "
            f"{longest:.3g} s, and at most {MAX_ELEMENTS} are made; lower it"
        )
    parts = parts.astype(np.intp)
    if (parts > 1).any():
        mesh, _ = mesh.split(parts)
        outer = mesh.along(outer)
    R, p = mesh.rule.integration, regression.p
    gram, memory = np.empty_like(outer.values), np.empty(outer.values.shape[:2])
    G, z, eye = known.values, known.memory, f0 * np.eye(p)
    for k, h in enumerate(mesh.steps):
        gram[k, 0], memory[k, 0] = G, z
        added = outer.values[k, 1:]
        beta = np.zeros(len(R))
        for _ in range(_PICARD_ROUNDS):
            decay = np.exp(-h * (R @ beta))[:, None, None]  # z(t_i)/z(left)
            nodes = decay * (G + h * np.tensordot(R, added / decay, axes=1))
            inverse = z * decay * eye + alpha * nodes[..., :p]
            eigenvalues = np.linalg.eigvalsh(inverse)
            update = beta0 * (1.0 - 1.0 / (bound * eigenvalues[:, 0]))
            change, beta = np.abs(update - beta) / beta0, update
            # What is not excited is forgotten down to the bound, beside what is.
            rounding = 4.0 * EPS * eigenvalues[:, -1] / eigenvalues[:, 0]
            if (change <= np.clip(rounding, 1e-13, 1e-6)).all():
                break
        else:
            raise SolverError(
                f"least squares with forgetting does not settle near t = {mesh.edges[k]:.6g}; "
                "lower estimator.beta"
            )
        decay = np.exp(-h * (R @ beta))
        gram[k, 1:], memory[k, 1:] = nodes, z * decay
        G, z = nodes[-1], z * decay[-1]
    return Trajectory(mesh, gram), Trajectory(mesh, memory)
