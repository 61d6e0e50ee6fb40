"""Series in time: x' = A x + f on one element after the other, without a factorisation.

With A and f in powers of the time, as their values at points say, terms
``(k + 1) X_{k+1} = h (Σ A_j X_{k−j} + f_k)`` fall like (h‖A‖)^k/k! where h‖A‖ is modest, and one
costs as much as the entries of A.
"""

from __future__ import annotations

from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.errors import EPS, TINY
from gpebo_cli.numerics.linalg import largest_over_time, largest_within
from gpebo_cli.numerics.mesh import SHARE, Mesh
from gpebo_cli.numerics.radau import RadauRule

LENGTH = 4.0  # h‖A‖ of an element, or a part of it, at most
DENSE = 0.3  # share of entries, from which on a matrix counts as full
_MOST_PARTS = 16  # of an element, each with its series, where coefficients
_DECAY = 1.6  # are to decay like powers of 1 over this
_LOOKED_AT = 1 << 25  # times by states³, at which growth is looked at
_WORTH = 0.5  # columns times that share, from which on it is multiplied as if it were
_TERMS = 24  # of a series, about


class Sparse(NamedTuple):
    """Matrices (N or 1, d, d) by their rows."""

    rows: IntArray  # (d + 1,) where each begins
    columns: IntArray  # (e,) of the entries
    entries: Array  # (N or 1, e)

    def sizes(self, elements: int) -> Array:
        """The largest of each entry in each of so many elements, (K or 1, e)."""
        count = min(elements, len(self.entries))
        return largest_within(self.entries.reshape(count, len(self.entries) // count, -1))

    def full(self) -> Array:
        """With every entry, (N or 1, d, d)."""
        d = len(self.rows) - 1
        out = np.zeros((len(self.entries), d, d))
        out[:, np.repeat(np.arange(d), np.diff(self.rows)), self.columns] = self.entries
        return out

    def growth(self, units: Array, enough: float) -> float:
        """How fast x' = A x may grow at any of the times, at most; or what is below ``enough``.

        Gershgorin's discs, in ``units`` of the states (d,), say so without eigenvalues, if these
        are needed for nothing else; eigenvalues are of a few times.
        """
        d, N = len(units), len(self.entries)
        of_row = np.repeat(np.arange(d), np.diff(self.rows))
        own = np.zeros((N, d))
        own[:, of_row[of_row == self.columns]] = self.entries[:, of_row == self.columns]
        discs = own - np.abs(own)
        discs += self.row_sums(np.abs(self.entries) * (units[self.columns] / units[of_row]))
        if discs.max(initial=0.0) <= enough:
            return float(discs.max(initial=0.0))
        some = np.linspace(0, N - 1, int(np.clip(_LOOKED_AT // d**3, 1, 32)), dtype=np.intp)
        full = self._replace(entries=self.entries[some]).full()
        return float(np.linalg.eigvals(full).real.max(initial=0.0))

    def product(self, entries: Array, x: Array) -> Array:
        """Products (K, d, c) of matrices with these entries (K or 1, e) and x (K, d, c)."""
        share = len(self.columns) / max(x.shape[1], 1) ** 2
        if share > (DENSE if len(entries) == 1 else 1.0) or x.shape[2] * share > _WORTH:
            return self._replace(entries=entries).full() @ x
        return self.row_sums(entries[:, None] * x.swapaxes(1, 2)[..., self.columns]).swapaxes(1, 2)

    def row_sums(self, terms: Array) -> Array:
        """Sums (…, d) of terms (…, e), one of each entry, over the entries of rows."""
        there, out = np.diff(self.rows) > 0, np.zeros((*terms.shape[:-1], len(self.rows) - 1))
        if len(self.columns):
            out[..., there] = np.add.reduceat(terms, self.rows[:-1][there], axis=-1)
        return out

    def norms(self, entries: Array, units: Array) -> Array:
        """Bounds (K,) of the spectral radius: norms, in units of the states (d,) and without."""
        K, d = len(entries), len(units)
        of_row, first = np.repeat(np.arange(d), np.diff(self.rows)), d * np.arange(K)[:, None]
        sums = [
            np.bincount((first + place).ravel(), scaled.ravel(), K * d).reshape(K, d)
            for scaled in (entries, entries * (units[self.columns] / units[of_row]))
            for place in (of_row, self.columns)
        ]
        return np.asarray(np.max(sums, axis=2, initial=0.0).min(axis=0))


def by_entries(A: Array) -> Sparse:
    """Matrices (N or 1, d, d) by those entries that are not always zero."""
    i, j = np.nonzero((A != 0.0).any(axis=0))
    return Sparse(np.searchsorted(i, np.arange(A.shape[1] + 1)), j, A[:, i, j])


def march(
    weights: Array, mesh: Mesh, A: Sparse, f: Array, kicks: Array | None, start: Array, tol: float
) -> tuple[Array, Array]:
    """Series in time over one element after the other, with weights (d,) of the states.

    With kicks only values at both ends of each element.
    """
    of_f, rule = f.reshape(len(f), -1), mesh.rule
    size, largest = (np.maximum(largest_over_time(x), TINY) for x in (A.entries, of_f))
    terms = _powers(_degrees(A.entries, size, rule, tol))
    decay = _largest_shares(terms, size)
    parts = np.broadcast_to(_parts(decay, tol), mesh.size)
    nodes, pieces = rule.nodes if kicks is None else rule.nodes[-1:], []
    # So many elements at once that they have no more parts than there are elements.
    count = -(-mesh.size // int(parts.max()))
    for first in range(0, mesh.size, count):
        some, forced = slice(first, first + count), np.zeros(0)
        at = slice(len(rule.points) * first, len(rule.points) * (first + count))
        if count < mesh.size:
            terms = np.zeros(0)  # what was there goes before there is more
            terms = _powers(_degrees(A.entries[at], size, rule, tol), parts[some])
            decay = _largest_shares(terms, size)
        there = of_f if len(f) == 1 else of_f[at]
        forced = _powers(_degrees(there, largest, rule, tol), parts[some])
        pieces.append(elements.series(
            nodes, mesh.steps[some], parts[some], A.rows, A.columns, terms.swapaxes(1, 2),
            _from_each_on(decay), forced.reshape(*forced.shape[:2], *f.shape[1:]),
            None if kicks is None else kicks[some], start, weights, tol, SHARE,
        ))
        start = pieces[-1][0][-1, -1] + (0.0 if kicks is None else kicks[some][-1])
    if len(pieces) == 1:
        return pieces[0]
    del terms, forced
    values, change = (np.concatenate(each) for each in zip(*pieces, strict=True))
    return values, change


def _parts(decay: Array, tol: float) -> IntArray:
    """Of how many parts an element is whose coefficients are so much smaller (K, g), at most."""
    later = decay[:, 1:] * (decay[:, 1:] > tol)
    rates = (later ** (1.0 / np.arange(1, decay.shape[1]))).max(axis=1, initial=0.0)
    parts: IntArray = np.ceil(np.clip(_DECAY * rates, 1.0, _MOST_PARTS)).astype(np.intp)
    return parts


def _from_each_on(decay: Array) -> Array:
    """The largest (K, g) of values (K, g) from each one on."""
    return np.maximum.accumulate(decay[:, ::-1], axis=1)[:, ::-1]


def element_maps(rule: RadauRule, h: Array, A: Array, f: Array) -> tuple[Array, Array] | None:
    """What a solution of x' = A x + f is at the nodes of elements of lengths h (K,).

    As :func:`gpebo_cli.kernels.elements_numpy.element_maps`, for A (K (s + 1), n, n) that varies;
    None where systems of equations cost less.
    """
    (K, s), (n, columns) = (len(h), rule.stages), f.shape[1:]
    matrix, forcing = by_entries(A), np.flatnonzero(f.any(axis=(0, 1)))
    tol, c, of_rows = 8.0 * EPS, len(forcing), np.ones(n)
    rates = matrix.norms(matrix.sizes(K), of_rows)
    size = np.maximum(largest_over_time(matrix.entries), TINY)
    degrees = _degrees(matrix.entries, size, rule, tol)
    parts = _parts(_largest_shares(_powers(degrees), size), tol)
    parts = np.maximum(np.ceil(h * rates / LENGTH), parts)
    unknowns, work = s * n, _TERMS * degrees.shape[1] * len(size) * (n + c) * parts.sum()
    if not work < K * unknowns**2 * (unknowns / 3 + n + columns):
        return None
    parts = parts.astype(np.intp)
    # Columns of f count as they are, and not beside others.
    scale = np.abs(f[:, :, forcing]).max(axis=(0, 1))
    of_f = (f[:, :, forcing] / scale).reshape(len(f), -1)
    forced = _powers(_degrees(of_f, np.maximum(largest_over_time(of_f), TINY), rule, tol), parts)
    forced = forced.reshape(*forced.shape[:2], n, c)
    terms = _powers(degrees, parts)
    decay = _from_each_on(_largest_shares(terms, size))
    homogeneous, particular = np.empty((K, s, n, n)), np.zeros((K, s, n, columns))
    start, last = np.eye(n, c + n, c), 0
    for k, count in enumerate(parts):
        some, last = slice(last, last + count), last + count
        values, change = elements.series(
            rule.nodes, h[k : k + 1], parts[k : k + 1], matrix.rows, matrix.columns,
            terms[some].swapaxes(1, 2), decay[some], forced if len(f) == 1 else forced[some],
            None, start, of_rows, tol, SHARE,
        )
        if not np.isfinite(change).all():
            return None
        homogeneous[k] = values[0, 1:, :, c:]
        particular[k][:, :, forcing] = values[0, 1:, :, :c] * scale
    return homogeneous, particular


def _degrees(values: Array, size: Array, rule: RadauRule, tol: float) -> Array:
    """Legendre coefficients (K or 1, g, w) of functions (N or 1, w) in each element.

    Degrees that are smaller than ``tol`` of the size (w,) are left out.
    """
    if len(values) == 1:
        return values[None]
    points = len(rule.points)
    found = rule.to_legendre @ values.reshape(len(values) // points, points, -1)
    counts = (largest_over_time(found) > tol * size).any(axis=1)
    return found[:, : 1 + int(np.flatnonzero(counts).max(initial=0))]


def _powers(degrees: Array, parts: IntArray | None = None) -> Array:
    """From :func:`_degrees` to powers of the time in each part of elements, (P or 1, g, w).

    How many ``parts`` each element has, (K,); None: one.
    """
    g, w = degrees.shape[1:]
    if parts is None or parts.max() == 1:
        return np.asarray(_legendre_powers(g, 1) @ degrees)
    if len(degrees) == g == 1:
        return degrees
    # Powers of one function follow each other, as series take them.
    found, first = np.empty((parts.sum(), w, g)).swapaxes(1, 2), parts.cumsum() - parts
    for count in set(parts.tolist()):
        some = parts == count
        for k, changed in enumerate(_legendre_powers(g, count)):
            found[first[some] + k] = changed @ degrees[some]
    return found


def _largest_shares(values: Array, size: Array) -> Array:
    """Largest sizes (K, g) of values (K, g, w) in units of a size (w,)."""
    of_powers = values.swapaxes(0, 1)
    return np.stack([np.abs(one / size).max(axis=1, initial=0.0) for one in of_powers], axis=1)


@lru_cache
def _legendre_powers(degrees: int, parts: int) -> Array:
    """Legendre polynomials on [0, 1] in powers of time in each part, (parts, powers, degrees)."""
    left = 2.0 * np.arange(parts) / parts - 1.0
    slopes = [legendre.legval(left, legendre.legder(np.eye(degrees), m)) for m in range(degrees)]
    each = [(2.0 / parts) ** m / factorial(m) * slope for m, slope in enumerate(slopes)]
    return np.array(each).transpose(2, 0, 1)
