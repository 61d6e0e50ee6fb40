"""The structure of a descriptor system: its index, and how many constraints it has.

Kunkel & Mehrmann, Differential-Algebraic Equations, Hypothesis 3.48: ranks of the derivative array
(``derivative_array.py``) that have to be the same at every time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import frobenius_norm, transpose
from gpebo_cli.numerics.mesh import FIRST_ELEMENTS, initial_edges
from gpebo_cli.reduction.derivative_array import (
    SMALL,
    Scaling,
    balance,
    derivative_array,
    scaled,
    who,
)

RESIDUAL = 1e-13  # rows that should vanish after elimination, relative to the array
_PROBES = 65  # times at which the structure is established before anything is integrated
_DIP = 0.2  # a singular value that falls below this share of its maximum is followed down
_DIP_ROUNDS = 14
_FALL = 1e-2  # towards an end of the horizon, singular values may fall to this share
_DIP_POINTS = 17
_MOST_DIPS = 6  # of each kind


@dataclass(frozen=True, eq=False)
class Pivots:
    """Rows and columns of M that carry its rank at one time, for cheap elimination at others.

    Z2 and Z1 are only needed up to scalings of rows, so any basis will do: M[rest] − X M[rows]
    with X = M[rest, columns] M[rows, columns]⁻¹ costs one LU where an SVD costs thirty.
    """

    rank: int  # r
    rows: IntArray  # (rows,) all of them, the r pivots first
    columns: IntArray  # (columns,) likewise
    Z1: Array  # (n, d) orthonormal, completes the constraints at that time


@dataclass(frozen=True, eq=False)
class Structure:
    """The characteristic values of the system and how they were judged."""

    mu: int  # strangeness index μ
    a: int  # number of constraints
    d: int  # number of differential equations, n − a
    scaling: Scaling
    rank_tol: float
    # Smallest one counted as nonzero, relative, at the probes where a bound of it is smallest.
    smallest_singular_value: float
    time_invariant: bool  # E and A are constant
    reference: Pivots  # of one time, to start from at the others
    steady: bool  # no singular value behind the ranks comes near zero between the ends
    # z' = this z + … with z = Z1ᵀE x: Z1ᵀA T, [Z1ᵀE; Â2] T = [I; 0]; None where not determined
    dynamics: Array | None  # (N or 1, d, d) at the probes, 1/s

    @property
    def index(self) -> int:
        """Differentiation index: 0 for an explicit ODE, else μ + 1."""
        return self.mu + 1 if self.a else 0

    @property
    def rate(self) -> float:
        """How fast the differential part may change by itself at the probes, at most, 1/s."""
        return np.inf if self.dynamics is None else float(frobenius_norm(self.dynamics).max())

    @property
    def growth(self) -> float:
        """Largest real part of its eigenvalues at the probes, 1/s, or zero."""
        if self.dynamics is None or not self.d:
            return 0.0
        return max(0.0, float(_largest_real_parts(self.dynamics).max()))


def without_equations() -> Structure:
    """That of a system without states: there is nothing to reduce."""
    none, ones = np.zeros(0, dtype=np.intp), np.ones(0)
    return Structure(
        mu=0, a=0, d=0, scaling=Scaling(ones, ones, 1.0, ones), rank_tol=0.0,
        smallest_singular_value=np.inf, time_invariant=True,
        reference=Pivots(0, none, none, np.zeros((0, 0))), steady=True, dynamics=None,
    )


def _largest_real_parts(matrices: Array) -> Array:
    """Largest real parts (N,) of the eigenvalues of matrices (N, d, d), d > 0."""
    if matrices.shape[1] == 1:
        return matrices[:, 0, 0]
    if matrices.shape[1] == 2:
        first, last = matrices[:, 0, 0], matrices[:, 1, 1]
        squared = (0.5 * (first - last)) ** 2 + matrices[:, 0, 1] * matrices[:, 1, 0]
        return np.asarray(0.5 * (first + last) + np.sqrt(np.maximum(squared, 0.0)))
    return np.asarray(np.linalg.eigvals(matrices).real.max(axis=1))


def analyse(
    system: DescriptorSystem, start: float, stop: float, *, max_mu: int, rank_tol: float
) -> Structure:
    """Find the smallest μ for which the system is strangeness-free after μ differentiations.

    Three ranks decide (Kunkel & Mehrmann, Hypothesis 3.48): that of M, that of the constraints
    Â2 = Z2ᵀN, and that of E on their kernel. Each must be the same at every time; between the
    probes, singular values that dip are followed to the bottom.

    Raises:
        ModelError: no μ ≤ ``max_mu`` does it, or a rank changes; names the time and the values.
    """
    t = _probe_times(system, start, stop)
    c = system.coefficients.taylor(t, 0)
    scaling = balance(c)
    invariant = {"E", "A"} <= system.coefficients.constant
    if invariant:
        t = t[:1]
    reason = ""
    for mu in range(max_mu + 1):
        if mu:
            c = system.coefficients.taylor(t, mu)
        levels, reference = _judged(t, c, mu, scaling, rank_tol, invariant)
        if reference is None:
            reason = levels.failure
            continue
        steady, dips = (True, []) if invariant else _dips(levels.smallest)
        _follow_dips(system, t, levels, dips, mu, scaling, rank_tol)
        if not levels.a and "E" not in system.coefficients.constant:
            _refuse_crossing(system, t, c.E[0])
        return Structure(
            mu=mu, a=levels.a, d=system.n - levels.a, scaling=scaling, rank_tol=rank_tol,
            smallest_singular_value=levels.least, time_invariant=invariant,
            reference=reference, steady=steady,
            dynamics=None if levels.dynamics is None else levels.dynamics / scaling.time,
        )
    raise ModelError(
        f"{who(system)} is not uniquely solvable, or its index is above {max_mu + 1}: with "
        f"{max_mu} differentiations {reason}; is an equation missing, or there twice?"
    )


_BISECTIONS = 60
_NARROW = 16  # probes in a cell in which something is narrow
_MOST_PROBES = 1 << 13
_PLACES = np.sort([1e-3, 1.0 - 1e-3, *(np.arange(1, _PROBES + 1) * 0.6180339887498949 % 1.0)])


def _probe_times(system: DescriptorSystem, start: float, stop: float) -> Array:
    """Interior times, none of them special: equal spacing would hit the zeros of sin(k π t)."""
    t = start + (stop - start) * _PLACES
    jumps = system.coefficients.breakpoints(start, stop)
    edges = None
    if not {"E", "A"} <= system.coefficients.constant:
        edges = system.coefficients.resolved(initial_edges(start, stop, jumps))
    if edges is not None:  # where something is narrow
        steps = np.diff(edges)
        narrow = np.flatnonzero(steps < 0.4 * (stop - start) / FIRST_ELEMENTS)
        narrow = narrow[:: 1 + len(narrow) * _NARROW // _MOST_PROBES]
        places = (np.arange(_NARROW) + 0.5) / _NARROW
        looks = edges[narrow, None] + steps[narrow, None] * places
        t = np.unique(np.concatenate([t, looks.ravel()]))
    if not len(jumps):
        return t
    cuts = np.concatenate([[start], jumps, [stop]])
    middles = 0.5 * (cuts[:-1] + cuts[1:])  # no piece between jumps goes unprobed
    return np.unique(np.concatenate([t, middles]))


def _judged(
    t: Array, c: Coefficients, mu: int, scaling: Scaling, rank_tol: float, invariant: bool
) -> tuple[_Levels, Pivots | None]:
    """Levels at all times, or at one that says why this μ will not do; and where to start from.

    ``c`` may have more times than t where E and A are constant.
    """
    if kernels.compiled is not None and (mu + 1) * c.E.shape[2] <= SMALL:
        found = _judged_compiled(t, c, mu, scaling, rank_tol, invariant)
        if found is not None:
            return found
    e, aa = scaled(c, scaling)
    e, aa = e[:, : len(t)], aa[:, : len(t)]
    # A μ that will not do fails at one time already.
    middle = slice(len(t) // 2, len(t) // 2 + 1)
    one = _levels(t[middle], e[:, middle], aa[:, middle], mu, rank_tol)
    if one.failure:
        return one, None
    reference = _reference(e[:, middle], aa[:, middle], mu, one)
    levels = _all_levels(t, e, aa, mu, rank_tol, one, reference)
    return levels, None if levels.failure else reference


def _judged_compiled(
    t: Array, c: Coefficients, mu: int, scaling: Scaling, rank_tol: float, invariant: bool
) -> tuple[_Levels, Pivots | None] | None:
    """:func:`_judged`; None where it takes LAPACK to tell, or to say what is wrong."""
    compiled: Any = kernels.compiled
    n, middle = c.E.shape[2], len(t) // 2
    model = (c.E, c.A, scaling.rows, scaling.columns, scaling.time, mu)
    known, smallest, rows, columns, Z1, dynamics = compiled.start(*model, middle, rank_tol)
    trusted, counted = known.tolist()
    a = int(counted)
    if not trusted:
        return None
    at = t[middle : middle + 1]
    failure = _too_many(a, n, at) if a > n else _why_not(at, smallest, rank_tol)
    if failure:
        return _Levels(a, smallest, failure), None
    r = (mu + 1) * n - a
    if invariant:
        finite: Array | None = dynamics if np.isfinite(dynamics).all() else None
        least = float(smallest.min())
        return _Levels(a, smallest, "", least, dynamics=finite), Pivots(r, rows, columns, Z1)
    known, smallest, dynamics = compiled.all_levels(
        *model, rows, columns, r, Z1, rank_tol, max(_PLAIN, 10.0 * rank_tol), RESIDUAL
    )
    trusted, least, is_finite = known.tolist()
    if not trusted:
        return None
    levels = _Levels(a, smallest, "", least, dynamics=dynamics if is_finite else None)
    return levels, Pivots(r, rows, columns, Z1)


def _too_many(a: int, n: int, t: Array) -> str:
    return f"{a} constraints appear for {n} states (t = {t[0]:.6g})"


@dataclass(frozen=True, eq=False)
class _Levels:
    """Singular values that must stay away from zero, or why this μ will not do."""

    a: int
    smallest: Array  # (N, 3) of M, Â2 and E T2, relative to the size of their factors; or bounds
    failure: str
    least: float = np.inf  # of those that were computed
    T2: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))  # (N, n, d)
    dynamics: Array | None = None  # (N or 1, d, d) in scaled time, see ``Structure``


def _levels(
    t: Array, e: Array, aa: Array, mu: int, rank_tol: float, a: int | None = None
) -> _Levels:
    """Ranks at the times t; with ``a`` given, the singular values that belong to that rank.

    ``e`` and ``aa`` are the scaled Taylor coefficients of E and A, (μ + 1, N, n, n).
    """
    n = e.shape[-1]
    M, N = derivative_array(e, aa, mu)
    U, sigma, _ = np.linalg.svd(M)
    relative = sigma / _array_size(sigma[:, 0], aa)[:, None]
    smallest = np.full((len(t), 3), np.inf)
    if a is None:
        ranks = (relative > rank_tol).sum(axis=1)
        if (ranks != ranks[0]).any():
            k = int(np.argmax(ranks != ranks[0]))
            return _Levels(0, smallest, _changes("the derivative array", ranks, k, t, relative[k]))
        a = (mu + 1) * n - int(ranks[0])
    if a > n:
        return _Levels(a, smallest, _too_many(a, n, t))
    r = M.shape[1] - a
    if r:
        smallest[:, 0] = relative[:, r - 1]
    Z2 = U[:, :, r:]
    A2 = transpose(Z2) @ N
    _, s2, V2 = np.linalg.svd(A2)
    s2 = s2 / frobenius_norm(N)[:, None]
    if a:
        smallest[:, 1] = s2[:, -1]
    T2 = transpose(V2)[:, :, a:]
    s3 = np.linalg.svd(e[0] @ T2, compute_uv=False)
    s3 = s3 / frobenius_norm(e[0])[:, None]
    if a < n:
        smallest[:, 2] = s3[:, -1]
    failure = _why_not(t, smallest, rank_tol)
    if failure:
        return _Levels(a, smallest, failure)
    return _Levels(a, smallest, "", float(smallest.min(initial=np.inf)), T2)


def _why_not(t: Array, smallest: Array, rank_tol: float) -> str:
    """What the singular values of Â2 or E T2 (N, 3) say against this μ, or nothing."""
    for column, what in ((1, "constraints are linearly dependent"),
                         (2, "some states are in no equation's derivative and in no constraint")):
        bad = smallest[:, column] <= rank_tol
        if bad.any():
            k = int(np.argmax(bad))
            return f"{what} at t = {t[k]:.6g} (singular value {smallest[k, column]:.1e})"
    return ""


def _array_size(M: Array, aa: Array) -> Array:
    """Size of what the derivative array was made from: with E = 0 it is still judged against A."""
    size = np.maximum(M, np.abs(aa).max(axis=(0, 2, 3)))
    return np.asarray(np.maximum(size, np.finfo(float).tiny))  # a plant of zeros has none


_PLAIN = 1e-5  # bounds of singular values above this need no closer look


def _all_levels(
    t: Array, e: Array, aa: Array, mu: int, rank_tol: float, one: _Levels,
    reference: Pivots,
) -> _Levels:
    """:func:`_levels` at all times t, given those of one time, ``one``.

    Away from rank changes bounds serve as well as singular values, and the elimination that
    :func:`reduce` does anyway gives them for a fraction of the price. With W = [Z1ᵀE; A2] and
    A2 = Z2ᵀN, Z2ᵀ = [−X I],

        σ_r(M) ≥ 1/‖M11⁻¹‖,      σ_min(Â2) ≥ 1/(‖W⁻¹‖ ‖Z2‖),      σ_min(E T2) ≥ 1/‖W⁻¹‖.

    Singular values are computed where a bound is small, or smallest.
    """
    M, N = derivative_array(e, aa, mu)
    r = reference.rank
    dynamics: Array | None = None
    M = M[:, reference.rows[:, None], reference.columns]
    N = N[:, reference.rows]
    bounds = np.full((len(t), 3), np.inf)
    try:
        inverse = np.asarray(np.linalg.inv(M[:, :r, :r]), dtype=np.float64)
        X = M[:, r:, :r] @ inverse
        whole = np.concatenate([reference.Z1.T @ e[0], N[:, r:] - X @ N[:, :r]], axis=1)
        states = np.asarray(np.linalg.inv(whole), dtype=np.float64)
        determined, dynamics = frobenius_norm(states), _dynamics(reference.Z1, aa[0], states)
        size = _array_size(frobenius_norm(M), aa)
        left = frobenius_norm(M[:, r:, r:] - X @ M[:, :r, r:])
        if r:
            bounds[:, 0] = 1.0 / (frobenius_norm(inverse) * size)
        if one.a:
            spread = np.sqrt(one.a + frobenius_norm(X) ** 2)
            bounds[:, 1] = 1.0 / (determined * spread * frobenius_norm(N))
        if one.a < len(e[0, 0]):
            bounds[:, 2] = 1.0 / (determined * frobenius_norm(e[0]))
        plain = (bounds > max(_PLAIN, 10.0 * rank_tol)).all(axis=1) & (left <= RESIDUAL * size)
    except np.linalg.LinAlgError:  # a pivot block that is exactly singular somewhere
        plain = np.zeros(len(t), dtype=bool)
    closer = ~plain
    closer[np.argmin(bounds, axis=0)] = True
    closer[len(t) // 2] = True  # of the reference, whose ranks the others must have
    exact = _levels(t[closer], e[:, closer], aa[:, closer], mu, rank_tol)
    bounds[closer] = exact.smallest
    return _Levels(exact.a, bounds, exact.failure, float(exact.smallest.min()), dynamics=dynamics)


def _dynamics(Z1: Array, A: Array, inverse: Array) -> Array | None:
    """Z1ᵀA T (N, d, d), T being the first columns of the inverses (N, n, n), if it is finite."""
    found = np.asarray(Z1.T @ A @ inverse[:, :, : Z1.shape[1]])
    return found if np.isfinite(found).all() else None


def _dips(smallest: Array) -> tuple[bool, list[tuple[int, int]]]:
    """Dips of the singular values or bounds (N, 3), and whether there is none between the ends.

    A dip is a local minimum far below the column's maximum, given as its column and its place;
    the deepest of each column come first. There is none in columns that are not finite.
    """
    if kernels.compiled is not None:
        calm, found = kernels.compiled.dips(smallest, _DIP, _FALL, _MOST_DIPS)
        return bool(calm[0]), [(int(column), int(k)) for column, k in found.tolist()]
    steady, dips = True, []
    for column in range(3):
        values = smallest[:, column]
        if not np.isfinite(values).all():
            continue
        padded = np.concatenate([[np.inf], values, [np.inf]])
        is_minimum = (values <= padded[:-2]) & (values <= padded[2:])
        deep = np.flatnonzero(is_minimum & (values < _DIP * values.max()))
        inner = (deep > 0) & (deep < len(values) - 1)
        steady &= not inner.any() and bool((values >= _FALL * values.max()).all())
        dips += [(column, int(k)) for k in deep[np.argsort(values[deep])][:_MOST_DIPS]]
    return steady, dips


def _changes(what: str, ranks: Array, k: int, t: Array, sigma: Array) -> str:
    border = min(int(ranks[k]), int(ranks[0]))
    return (
        f"the rank of {what} changes from {ranks[0]} at t = {t[0]:.6g} to {ranks[k]} at "
        f"t = {t[k]:.6g} (singular value {sigma[border]:.1e})"
    )


def _refuse_crossing(system: DescriptorSystem, t: Array, E: Array) -> None:
    """Without constraints E has to be regular: its determinant keeps its sign from probe to probe.

    A singular value that passes zero faster than the probes are dense shows in this only.
    """
    sign = np.linalg.slogdet(E)[0]
    changes = np.flatnonzero(sign[1:] != sign[:-1])
    if not len(changes):
        return
    low, high = t[changes[0]], t[changes[0] + 1]
    for _ in range(_BISECTIONS):
        half = np.array([0.5 * (low + high)])
        same = np.linalg.slogdet(system.coefficients.taylor(half, 0).E[0])[0] == sign[changes[0]]
        low, high = (half[0], high) if same else (low, half[0])
    raise ModelError(
        f"{who(system)}: the rank of the differential part changes at t = {high:.9g} (det E "
        "changes its sign); choose a horizon that avoids this time"
    )


def _follow_dips(
    system: DescriptorSystem, t: Array, levels: _Levels, dips: list[tuple[int, int]], mu: int,
    scaling: Scaling, rank_tol: float,
) -> None:
    """Follow local minima of the decisive singular values between the probes.

    A rank that drops at an isolated time is never hit by a grid: |sin t| is 1e-2 at the nearest
    probe and looks harmless. Each deep local minimum is bracketed and cut by 8 per round, for as
    long as the value is far below those at the ends of its bracket: so it is on the way to zero,
    and not at the flat bottom of a harmless dip. Comparing with the round before would not do: a
    probe may by luck be nearer to the zero than the times of the first round.
    """
    names = ("derivative array", "constraints", "differential part")
    for column, k in dips:
        left, right = t[max(k - 1, 0)], t[min(k + 1, len(t) - 1)]
        lowest, where = float(levels.smallest[k, column]), t[k]
        for _ in range(_DIP_ROUNDS):
            grid = left + (right - left) * _CUTS
            grid[-1] = right
            c = system.coefficients.taylor(grid, mu)
            line = _line(grid, c, mu, scaling, rank_tol, levels.a, column)
            best = int(line.argmin())
            value = float(line[best])
            lowest, where = min(lowest, value), grid[best]
            before, after = max(best - 1, 0), min(best + 1, len(grid) - 1)
            left, right = grid[before], grid[after]
            flat = value >= 0.5 * max(line[before], line[after])
            if lowest <= rank_tol or flat:
                break
        if lowest <= max(rank_tol, 1e-9):
            raise ModelError(
                f"{who(system)}: the rank of the {names[column]} changes at t = {where:.9g} "
                f"(singular value {lowest:.1e}); choose a horizon that avoids this time"
            )


_CUTS = np.linspace(0.0, 1.0, _DIP_POINTS)


def _line(
    t: Array, c: Coefficients, mu: int, scaling: Scaling, rank_tol: float, a: int, column: int
) -> Array:
    """One column (N,) of the levels that belong to ``a`` constraints, at the times t."""
    if kernels.compiled is not None and (mu + 1) * c.E.shape[2] <= SMALL:
        known, line = kernels.compiled.levels(
            c.E, c.A, scaling.rows, scaling.columns, scaling.time, mu, a, column
        )
        if known[0]:
            return np.asarray(line)
    e, aa = scaled(c, scaling)
    return _levels(t, e, aa, mu, rank_tol, a).smallest[:, column]


def _reference(e: Array, aa: Array, mu: int, one: _Levels) -> Pivots:
    """Where to start from at other times, from the coefficients and the levels of one."""
    Z1 = np.linalg.svd(e[0, 0] @ one.T2[0], full_matrices=False)[0]
    M = derivative_array(e, aa, mu)[0][0]
    r = len(M) - one.a
    return Pivots(r, *_pivots(M, r), Z1)


def _pivots(matrix: Array, count: int) -> tuple[IntArray, IntArray]:
    """All rows and columns, ``count`` that carry the rank first: elimination, complete pivoting."""
    left = matrix.copy()
    chosen = np.zeros((2, len(matrix)), dtype=bool)
    for _ in range(count):
        i, j = divmod(int(np.abs(left).argmax()), len(left))
        chosen[0, i] = chosen[1, j] = True
        left -= left[:, j, None] * (left[i] / left[i, j])
        left[i], left[:, j] = 0.0, 0.0
    rows, columns = np.argsort(~chosen, axis=1, kind="stable")
    return rows, columns
