"""The algebraic equations without v, Y = ψη, and the state, x = offset + gain η."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.errors import EPS
from gpebo_cli.numerics.linalg import largest_over_time, orthonormal_complement, transpose
from gpebo_cli.numerics.mesh import Kind
from gpebo_cli.observers.reduced.matrices import AlgebraicEquations
from gpebo_cli.reduction.form import EquationForm

_ROUNDING = 1e-3  # of a projection, in terms of what is resolved
_LITTLE = 1e-9  # of the largest state: a smaller one may be rounding
_NOISE = 1e-11  # of the terms of a gain: beyond what extensions are resolved to
VANISHING = 1e-11  # rows of Y and ψ below this share of the terms they are made of are zero
OVER_TIME = ("Y", "psi", "offset", "gain")  # of what is assembled


@dataclass(frozen=True, eq=False)
class Assembled:
    """Everything algebraic in ξ_a, ξ_b, Φ, u and y at N times, all rows of the residual."""

    Y: Array  # (N, e + r)
    psi: Array  # (N, e + r, p)
    offset: Array  # (N, n)
    gain: Array  # (N, n, p)
    Y_scale: float  # size of the terms of Y before they cancel
    column_scale: Array  # (p,) and of the columns of ψ: each has the unit of its parameter
    largest: Array  # (k, 1 + p) sizes of z over time
    moving: Array  # (n, p) of the gain of w = P x, which the eliminated part may cancel

    def kinds(
        self, units: Array | float = 1.0, rounding: Array | None = None,
        equations: AlgebraicEquations | None = None,
    ) -> Iterator[Kind]:
        """Everything the mesh has to resolve, with the size below which it is rounding.

        States have ``units`` (n,), in which they are comparable. Signals come one after the other,
        because all of a long recording take much memory. What ``rounding`` (n, n) of w leaves of a
        state is no signal to resolve, nor is what is left of a state whose terms cancel, those of
        the ``equations`` that all of this comes from.
        """
        columns = self._columns
        rows, Y, psi = self._rows, self.Y, self.psi
        if len(rows) < Y.shape[1]:
            Y, psi = Y[:, rows], psi[:, rows]
        psi = psi / columns[None].repeat(psi.shape[1], axis=0)
        largest = largest_over_time(self.gain)
        states = (largest / columns).max(axis=1, initial=0.0)
        if self.Y_scale > 0.0:  # a state that no parameter has part in is no signal to resolve
            own = largest_over_time(self.offset) / self.Y_scale
            states = np.maximum(states, 1e-3 * own)
        states = np.maximum(states, 1e-3 * (self.moving / columns).max(axis=1, initial=0.0))
        if rounding is not None:
            states = np.maximum(states, self._through(rounding))
        beside = states / units
        if equations and beside.min(initial=np.inf) < _LITTLE * beside.max(initial=0.0):
            each = np.broadcast_to(units, len(states))[:, None]
            others_leave = 64 * EPS * each * (largest / each).max(axis=0)
            nothing = largest <= np.maximum(_NOISE * self._terms(equations), others_leave)
            states[nothing.all(axis=1)] = np.inf
        yield Y, 1e-3 * self.Y_scale
        yield psi, 1e-3
        yield self.offset / units, 0.0
        units = np.where(states > 0.0, states, 1.0)[:, None] * columns
        yield self.gain / units, 0.0
        # Of ψᵀψ the diagonal: a product of two columns that are resolved shows no more than theirs.
        yield (psi**2).sum(axis=1), 1e-3
        yield np.einsum("nrp,nr->np", psi, Y), 1e-3 * self.Y_scale

    @property
    def _columns(self) -> Array:
        """Sizes of the columns of ψ (p,), 1 for those that vanish."""
        return np.where(self.column_scale > 0.0, self.column_scale, 1.0)

    def _terms(self, equations: AlgebraicEquations) -> Array:
        """Sizes (n, p) of all that the gain is made of."""
        on_basis, _, G, Q1, H, _ = map(largest_over_time, equations)
        seen = on_basis @ self.largest[:, 1:]
        seen[:, : G.shape[1]] += G
        return np.asarray(self.moving + H @ (Q1.T @ seen))

    def _through(self, rounding: Array) -> Array:
        """What ``rounding`` (n, n) of w leaves of each state (n,), with columns of size 1."""
        return np.asarray((rounding @ (self.moving / self._columns)).max(axis=1, initial=0.0))

    def lost(self, rounding: Array) -> float:
        """Share of a state's size that ``rounding`` (n, n) of w is, at most."""
        own = (largest_over_time(self.gain) / self._columns).max(axis=1, initial=0.0)
        if self.Y_scale > 0.0:
            own = np.maximum(own, largest_over_time(self.offset) / self.Y_scale)
        return float((self._through(rounding) / np.where(own > 0.0, own, np.inf)).max(initial=0.0))

    def after(self, first: int) -> Assembled:
        """The same without so many of the first times; sizes are still those of all of them."""
        return replace(self, **{name: getattr(self, name)[first:] for name in OVER_TIME})

    def kept_rows(self, system: DescriptorSystem, regression: str) -> IntArray:
        """Rows of the residual that make up the regression."""
        if regression != "paper" and len(self._rows):
            return self._rows
        rows = self.Y.shape[1]
        return np.arange(rows - system.r, rows)  # eq. (regpsi)

    @cached_property
    def _rows(self) -> IntArray:
        """Rows of the residual that are more than rounding of their terms."""
        in_psi, in_Y = largest_over_time(self.psi), largest_over_time(self.Y)
        large = (in_psi > VANISHING * self.column_scale).any(axis=1)
        return np.flatnonzero(large | (in_Y > VANISHING * self.Y_scale))


def largest_at(signals: Iterable[Array]) -> IntArray:
    """Elements (W,) in which something of the signals (K, s + 1, c) is largest."""
    return np.unique(np.concatenate([np.abs(v).max(axis=1).argmax(axis=0) for v in signals]))


def regression_signals(z: Array, basis: Array, equations: AlgebraicEquations) -> Assembled:
    """All rows of Y and ψ, and the state's offset and gain, at N times.

    From z = [ξ_a | ξ_b | Φ] (N, k, 1 + q + n_a) in the coordinates of the basis B (n, k).
    """
    algebraic, g_y, G, Q1, H, _ = equations
    Y, psi, offset, gain, sizes = kernels.observer.regression_signals(
        z, G.shape[2], basis, algebraic, g_y, G, Q1, H
    )
    if basis.shape[0] == basis.shape[1]:  # the kernel of E turns: products with w cancel, too
        sizes = np.maximum(sizes, (np.abs(algebraic) @ np.abs(z)).max(axis=(0, 1), initial=0.0))
        nothing = np.abs(psi).max(axis=(0, 1), initial=0.0) <= VANISHING * sizes[1:]
        psi = np.where(nothing, 0.0, psi)
    largest = largest_over_time(z)
    moving = np.abs(basis) @ largest[:, 1:]
    return Assembled(Y, psi, offset, gain, float(sizes[0]), sizes[1:], largest, moving)


def resolve(found: Assembled, some: slice, terms: Array, form: EquationForm) -> None:
    """Bring the state's offset and gain at some times onto hidden constraints, without noise.

    Hidden constraints 0 = M x + … hold but for what has gathered in z, which is taken from the
    state; entries of the gain that are rounding of their terms are zero. Whether a state is
    determined must not hang on noise. The sizes of the gain's terms there are (N, n, p).
    """
    n, r, gain = form.system.n, form.system.r, found.gain[some]
    if form.structure is not None:
        scales = form.units.states  # M is a projector in these
        rows = slice(-(n + r), -r)
        found.offset[some] -= scales * found.Y[some, rows]
        gain += scales[:, None] * found.psi[some, rows]
    np.copyto(gain, 0.0, where=np.abs(gain) <= _NOISE * terms)


def term_sizes(
    z: Array, basis: Array, equations: AlgebraicEquations
) -> tuple[Callable[[], Array], Array]:
    """Sizes of the terms of the gain (N, n, p), and of those of each column of ψ (N, p).

    An equation of large numbers counts as much as its projection can add to a residual, or as
    much as the rounding of the projection does. Arguments are those of :func:`regression_signals`.
    """
    z, inward = np.abs(z[:, :, 1:]), transpose(equations.range)
    seen = np.abs(equations.on_basis) @ z
    seen[:, :, : equations.G.shape[2]] += np.abs(equations.G)

    def of_gain() -> Array:
        through = np.abs(equations.elimination) @ (np.abs(inward) @ seen)
        return np.asarray(np.abs(basis) @ z + through)

    projected = np.abs(orthonormal_complement(equations.range)) @ seen
    return of_gain, np.maximum(projected, _ROUNDING * seen).max(axis=1)

