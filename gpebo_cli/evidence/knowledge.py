"""What a Gram matrix tells, whatever the units: which parameters and states can be known.

G(t) = ∫ψᵀψ mixes the units of the parameters. N_ij = G_ij/√(G_ii G_jj) does not: it is the Gram
matrix of parameters in units of their own size, and its smallest eigenvalue says how well they can
be told apart. A column of ψ that is zero but for rounding, beside the terms it is made of, has
no such size: its parameter is not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from gpebo_cli.model.descriptor import Array, BoolArray, IntArray

LARGE = 1e3  # of Φ: above it, states may be differences of terms that leave nothing of them
_UNRESOLVED = 10.0  # tolerances of the terms of a column of ψ: what is smaller says nothing
_SINGULAR = 1e-12  # eigenvalues of N below this are rounding of products of float64 numbers
_DIGITS = 6  # of what a column has to say, by which one is preferred to another
_SURE = 1e6  # times its level: an eigenvalue that decides which parameters are estimated
_SEEN = 1e-6  # part in the kernel of N beyond which a direction is not known
_NOISE = 1e-12  # of a column of a gain in the states' own units: beyond what extensions are good to
_CLEARED = 1e-11  # of its terms, what an observer clears of a gain
_MIXED = 1e-14  # over an eigenvalue of N: how far its vector may turn into the kernel's
_LOST = 1e-3  # of a state: a larger error leaves nothing of it that one would call known
_REST = 1e-9  # in the states' own units, of the largest: a state that is smaller is nothing
_HIDDEN = 10.0  # times what is seen of η is what may be hidden in the kernel of N
_TINY = 1e-100  # squares of its reciprocal are numbers


@dataclass(frozen=True, eq=False)
class Knowledge:
    """Spectra of N at M times: λ ascending and V."""

    sizes: Array  # (M, p) √G_jj, or the size of its terms for a column that is rounding
    eigenvalues: Array  # (M, p)
    vectors: Array  # (M, p, p) columns
    level: Array  # (M, p) share below which each parameter is rounding

    def at(self, chosen: slice | IntArray) -> Knowledge:
        """The spectra at some of the times, a slice or indices (M,)."""
        return Knowledge(*(getattr(self, f.name)[chosen] for f in fields(self)))

    @staticmethod
    def joined(parts: Sequence[Knowledge]) -> Knowledge:
        """The spectra of one, and after them those of the other."""
        return Knowledge(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Knowledge))
        )

    @property
    def smallest(self) -> Array:
        """The smallest eigenvalue of N, (M,); 1 if there is nothing to estimate."""
        return np.asarray(np.maximum(self.eigenvalues.min(axis=1, initial=1.0), 0.0))

    @property
    def rounding(self) -> Array:
        """What of that eigenvalue may be rounding, (M,)."""
        return np.asarray(self.level.max(axis=1, initial=_SINGULAR))

    @property
    def margin(self) -> Array:
        """That eigenvalue over what may be rounding, (M,): from 1 on ψ is exciting."""
        return np.asarray(self.smallest / self.rounding)

    @property
    def share(self) -> Array:
        """1/(N⁻¹)_jj (M, p): the part of a column's energy that the others do not explain."""
        spectrum = np.maximum(self.eigenvalues, 1e-4 * _SINGULAR)
        return np.asarray(1.0 / np.einsum("mjk,mk->mj", self.vectors**2, 1.0 / spectrum))

    @cached_property
    def clarity(self) -> Array:
        """The eigenvalues over the levels of their vectors, (M, p): below 1 they are rounding."""
        return np.asarray(self.eigenvalues / np.einsum("mjk,mj->mk", self.vectors**2, self.level))

    @cached_property
    def _kernel(self) -> tuple[Array, Array]:
        """V with zeros for the eigenvalues that are not zero, and how far it may be off (M,)."""
        unknown = self.clarity < 1.0
        next_one = np.where(unknown, 1.0, self.eigenvalues).min(axis=1, initial=1.0)
        return self.vectors * unknown[:, None, :], _SEEN + _MIXED / next_one

    @cached_property
    def parameters(self) -> BoolArray:
        """Which parameters are determined, (M, p)."""
        kernel, slack = self._kernel
        return np.asarray(np.linalg.norm(kernel, axis=2) <= slack[:, None])

    @cached_property
    def independent(self) -> IntArray:
        """Parameters that can be estimated together, the determined ones included.

        The others, set to zero, change nothing that is determined: along the kernel of N the
        regression is the same. The first time counts at which as many as ever can be told apart for
        sure: what data say later must not change estimates of the past, and beside what grows
        their Gram matrix shows it no longer.
        """
        if self.parameters[-1].all():
            return np.arange(self.parameters.shape[1])
        clear = self.clarity >= 1.0
        rank, least = clear.sum(axis=1), np.where(clear, self.clarity, _SURE).min(axis=1)
        m = int(np.argmax(np.where(rank == rank.max(), np.minimum(least, _SURE), -1.0)))
        known, level = self.parameters[m], self.level[m]
        normalised = (self.vectors[m] * np.maximum(self.eigenvalues[m], 0.0)) @ self.vectors[m].T
        first = np.flatnonzero(known | self.parameters[-1]).tolist()
        rest, chosen = [j for j in range(len(known)) if j not in first], list[int]()
        left = normalised.copy()  # what those that are chosen do not explain of the others
        while first or rest:
            # Of those that may stand for one another the one with the most to say comes first, and
            # rounding does not decide which: alone, each has the size one.
            j = max(first or rest, key=left.diagonal().round(_DIGITS).__getitem__)
            (first or rest).remove(j)
            more = [*chosen, j]
            if not known[j]:  # no eigenvalue is above what is left of a column
                if not left[j, j] >= 0.5 * level[j]:
                    continue
                if np.linalg.eigvalsh(normalised[np.ix_(more, more)])[0] < level[more].max():
                    continue
            chosen = more
            left -= np.outer(left[:, j], left[j] / left[j, j])
        return np.sort(np.array(chosen, dtype=np.intp))

    def states(self, gain: Array, units: Array | None = None) -> BoolArray:
        """Which states x = offset + gain η are determined, shape (M, n).

        The gain is at ascending times, the last M of which are those (M or more, n, p); NaN for a
        state that nothing is known of. Errors of a gain are of one size in ``units`` of the states
        (n,), if known.
        """
        kernel, slack = self._kernel
        if not kernel.any() and np.isfinite(gain).all():
            return np.ones((len(kernel), gain.shape[1]), dtype=bool)
        own = gain
        if units is not None:  # the row of a state that no parameter has part in is rounding
            size = np.abs(gain) / units[:, None]
            whole = np.maximum.accumulate(np.fmax.reduce(size, axis=1, initial=0.0))
            own = np.where(size <= _NOISE * whole[:, None], 0.0, gain)
        scaled, past = (
            x[len(gain) - len(kernel) :] / self.sizes[:, None, :]
            for x in (own, np.maximum.accumulate(np.abs(own)))
        )
        left, size = (np.einsum("mnp,mnp->mn", x, x) for x in (scaled @ kernel, scaled))
        # What is left of a difference of terms that were larger may be what observers clear.
        off = _CLEARED * np.linalg.norm(past @ np.abs(kernel), axis=2)
        return np.asarray(np.sqrt(left) <= slack[:, None] * np.sqrt(size) + off)

    def resolved(
        self, h: Array, offset: Array, gain: Array, growth: float | None,
        units: Array | None = None,
    ) -> BoolArray:
        """Of which states (n,) x = offset + gain η something is left beside errors, at the end.

        Neither what the kernel of N leaves open, nor rounding, may amount to more than a thousandth
        of them. Of what is nothing beside the largest, which may be at rest, more may, and a small
        ``growth`` of Φ explains no state that is smaller still beside its terms. Of h = ∫ψᵀY at the
        end (p,), and the offset (N, n) and gain (N, n, p) at all times, NaN where nothing is known;
        ``units`` as for :meth:`states`.
        """
        small = (growth or 0.0) < LARGE
        if small and (self.clarity[-1] >= 1.0).all():
            return np.ones(gain.shape[1], dtype=bool)
        error, z = self.doubt(h, gain[-1])
        size = np.abs(offset + gain @ z).max(axis=0)
        if small and units is not None:
            size = np.maximum(size, _REST * units * np.fmax.reduce(size / units, initial=0.0))
        if small:
            size = np.maximum(size, np.abs(gain[-1]) @ np.abs(z) / LARGE)
        return np.asarray(error <= _LOST * size)

    def doubt(self, h: Array, gain: Array) -> tuple[Array, Array]:
        """How far gain η (n,) may be off at the end, of a gain (n, p), and the least η (p,).

        By what the kernel of N leaves open and by rounding; h = ∫ψᵀY (p,).
        """
        V, spectrum, clear = self.vectors[-1], self.eigenvalues[-1], self.clarity[-1] >= 1.0
        root = np.sqrt(spectrum[clear])
        seen = V[:, clear].T @ (h / self.sizes[-1]) / root  # its norm is that of Y
        z = V[:, clear] @ (seen / root)
        row = gain / self.sizes[-1]
        unseen = np.linalg.norm(row @ V[:, ~clear], axis=1) * _HIDDEN * np.linalg.norm(z)
        # Rounding is relative to all of Y, or to what each column of ψ meets of it, if less.
        told = V[:, clear]
        of_all = np.linalg.norm(row @ told / root, axis=1) * np.linalg.norm(seen)
        met = np.abs((told * spectrum[clear]) @ told.T) @ np.abs(z)
        of_each = np.abs(row @ (told / spectrum[clear]) @ told.T) @ met
        error = unseen + _NOISE * (np.minimum(of_all, of_each) + np.abs(row) @ np.abs(z))
        return np.asarray(error), z / self.sizes[-1]


def knowledge(
    gram: Array, terms: Array, elapsed: Array, tol: float = 1e-12, rounding: Array | float = 0.0,
) -> Knowledge:
    """What is known from G (M, p, p) at M times; further columns are not looked at.

    ``terms`` (M, p) or (p,) are sizes of the terms that the columns of ψ are made of, ``elapsed``
    (M,) the seconds that G has been gathered for. ψ is resolved to ``tol``, relative to its terms,
    and the diagonal of G is good to a ``rounding`` (M, p).
    """
    p = gram.shape[1]
    energy = np.einsum("mjj->mj", gram[..., :p])
    sizes, level = own_sizes(energy, terms, elapsed, tol, rounding)
    factors = np.where(level < 1.0, 1.0 / sizes, 0.0)
    spectrum, vectors = np.linalg.eigh(
        gram[..., :p] * factors[:, :, None] * factors[:, None, :]
    )
    return Knowledge(sizes, spectrum, vectors, level)


def knowledge_of_roots(root: Array, terms: Array, elapsed: Array, tol: float = 1e-12) -> Knowledge:
    """The same from S (M, p, p) with SᵀS = G: no squares are formed."""
    sizes, level = own_sizes(np.square(root).sum(axis=1), terms, elapsed, tol)
    scaled = root / sizes[:, None, :] * np.where(level < 1.0, 1.0, 0.0)[:, None, :]
    _, sigma, Vt = np.linalg.svd(scaled)
    return Knowledge(sizes, sigma[:, ::-1] ** 2, np.swapaxes(Vt, 1, 2)[:, :, ::-1], level)


def own_sizes(
    energy: Array, terms: Array | float, elapsed: Array, tol: float = 1e-12,
    rounding: Array | float = 0.0,
) -> tuple[Array, Array]:
    """√G_jj (M, p), or the size of its terms where a column is rounding; which share is rounding.

    The ``energy`` is G_jj (M, p); the other arguments are those of :func:`knowledge`. What is small
    beside the terms of a column is so in x, too.
    """
    energy = np.maximum(energy, _TINY**2)
    sizes, whole = np.sqrt(energy), terms * np.sqrt(np.maximum(elapsed, 0.0))[:, None]
    least = np.maximum(_UNRESOLVED * tol * whole, _TINY)
    level = np.maximum(np.square(least / np.maximum(sizes, least)), _SINGULAR)
    seen = np.where(sizes > least, sizes, whole)
    seen = np.maximum(seen, np.sqrt(np.maximum(rounding, _TINY**2)))
    return seen, np.maximum(level, np.minimum(rounding / energy, 1.0))
