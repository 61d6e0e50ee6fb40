"""From a descriptor system of any index to an equivalent strangeness-free one.

Kunkel & Mehrmann, Differential-Algebraic Equations (EMS 2006), chapter 3: differentiate the model
μ times and read off, at every time, all constraints (hidden ones too) and the differential
equations that are left. In Taylor coefficients e_k = E^(k)/k!, x_k = x^(k)/k!, … the i-th
derivative of E x' = A x + f is, free of binomials,

    Σ_j (j + 1) e_{i−j} x_{j+1} = Σ_j a_{i−j} x_j + f_i            i = 0 … μ

or M (x_1, …, x_{μ+1}) = N x_0 + g with M_ij = (j + 1) e_{i−j} − a_{i−j−1}, N_i = a_i, g_i = f_i.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.model.descriptor import Array, BoolArray, Coefficients, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import transpose

_PROBES = 65  # times at which the structure is established before anything is integrated
_DIP = 0.2  # a singular value that falls below this share of its maximum is followed down
_DIP_ROUNDS = 14
_FALL = 1e-2  # towards an end of the horizon, singular values may fall to this share
_DIP_POINTS = 17
_MOST_DIPS = 6  # of each kind
# Largest derivative array for the compiled kernels: beyond it LAPACK's blocks are worth its calls.
_SMALL = 32


@dataclass(frozen=True, eq=False)
class Scaling:
    """Constant scalings under which ranks are judged: rows, states and the unit of time.

    Farads beside kiloohms would otherwise make an honest equation look like a rank deficiency.
    Powers of two, so that scaling commits no rounding error.
    """

    rows: Array  # (n,)
    columns: Array  # (n,) x = columns * x̃
    time: float  # τ, derivatives are taken with respect to t/τ


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
class Bases:
    """Z1 and Z2 themselves, where E and A are constant."""

    Z1: Array  # (1, n, d) orthonormal
    Z2: Array  # (1, (μ+1) n, a) orthonormal


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
    reference: Pivots | Bases  # of one time, to start from at the others
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
        return np.inf if self.dynamics is None else float(_norm(self.dynamics).max())

    @property
    def growth(self) -> float:
        """Largest real part of its eigenvalues at the probes, 1/s, or zero."""
        if self.dynamics is None or not self.d:
            return 0.0
        return max(0.0, float(_largest_real_parts(self.dynamics).max()))


@dataclass(frozen=True, eq=False)
class StrangenessFree:
    """E1 x' = A1 x + f1 (d rows) and 0 = A2 x + f2 (a rows) at N times.

    Where there are constraints, the consistent states are x = T z + offset with z = E1 x. The
    matrices have a leading axis of 1 when E and A are constant.
    """

    E1: Array  # (N or 1, d, n)
    A1: Array  # (N or 1, d, n)
    f1: Array  # (N, d)
    A2: Array  # (N or 1, a, n)
    f2: Array  # (N, a)
    basis: Array | None  # (N, n, d) T, of the kernel of A2, with E1 T = I; None if a = 0
    offset: Array | None  # (N, n)
    # By how much relative rounding of each state and of f2 reaches each state through the
    # constraints, the most at some of the times.
    amplification: Array  # (n, n + 1)
    E: Array  # (N, n, n) the model's own
    u: Array  # (N, m) the inputs and
    C: Array  # (N, r, n) the output matrix at the same times


def _largest_real_parts(matrices: Array) -> Array:
    """Largest real parts (N,) of the eigenvalues of matrices (N, d, d), d > 0."""
    if matrices.shape[1] == 1:
        return matrices[:, 0, 0]
    if matrices.shape[1] == 2:
        first, last = matrices[:, 0, 0], matrices[:, 1, 1]
        squared = (0.5 * (first - last)) ** 2 + matrices[:, 0, 1] * matrices[:, 1, 0]
        return np.asarray(0.5 * (first + last) + np.sqrt(np.maximum(squared, 0.0)))
    return np.asarray(np.linalg.eigvals(matrices).real.max(axis=1))


def forcing(c: Coefficients) -> Array:
    """Taylor coefficients of f = B u + F θ, shape (K + 1, N, n)."""
    orders = len(c.E)
    f = np.zeros(c.E.shape[:3])
    for k in range(orders):
        for i in range(k + 1):
            f[k] += np.einsum("nij,nj->ni", c.F[i], c.theta[k - i])
            f[k] += np.einsum("nij,nj->ni", c.B[i], c.u[k - i])
    return np.asarray(f)


def scaled(c: Coefficients, s: Scaling) -> tuple[Array, Array]:
    """Taylor coefficients of E and A in scaled rows, states and time."""
    powers = s.time ** np.arange(len(c.E), dtype=np.float64)[:, None, None, None]
    weight = s.rows[:, None] * s.columns
    return c.E * weight * powers / s.time, c.A * weight * powers


def derivative_array(e: Array, a: Array, mu: int) -> tuple[Array, Array]:
    """M (N, (μ+1) n, (μ+1) n) and N (N, (μ+1) n, n) from Taylor coefficients (K + 1, N, n, n)."""
    count, n = e.shape[1], e.shape[2]
    M = np.zeros((count, mu + 1, n, mu + 1, n))
    for i in range(mu + 1):
        for j in range(i + 1):
            M[:, i, :, j] = (j + 1) * e[i - j]
            if i - j - 1 >= 0:
                M[:, i, :, j] -= a[i - j - 1]
    N = np.moveaxis(a[: mu + 1], 0, 1).reshape(count, (mu + 1) * n, n)
    return M.reshape(count, (mu + 1) * n, (mu + 1) * n), N


def balance(c: Coefficients) -> Scaling:
    """Scalings that bring the rows and columns of E/τ and A to comparable size over time."""
    if kernels.compiled is not None:
        rows, columns, time = kernels.compiled.balance(c.E, c.A)
        return Scaling(rows, columns, float(time[0]))
    E, A = np.abs(c.E[0]).max(axis=0), np.abs(c.A[0]).max(axis=0)
    rows, columns, tau = np.ones(len(E)), np.ones(len(E)), 1.0
    both = bool(E.any() and A.any())
    for _ in range(4):
        if both:
            scaled_E, scaled_A = rows[:, None] * E * columns, rows[:, None] * A * columns
            tau = float(np.sqrt(np.vdot(scaled_E, scaled_E) / np.vdot(scaled_A, scaled_A)))
        W = E / tau + A
        rows = _reciprocal((W * columns).max(axis=1))
        columns = _reciprocal((W * rows[:, None]).max(axis=0))
    return Scaling(_power_of_two(rows), _power_of_two(columns), float(_power_of_two(np.array(tau))))


def _reciprocal(x: Array) -> Array:
    return 1.0 / np.where(x > 0, x, 1.0)


def _power_of_two(x: Array) -> Array:
    return np.asarray(np.exp2(np.rint(np.log2(x))))


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
        return Structure(
            mu=mu, a=levels.a, d=system.n - levels.a, scaling=scaling, rank_tol=rank_tol,
            smallest_singular_value=levels.least, time_invariant=invariant,
            reference=reference, steady=steady,
            dynamics=None if levels.dynamics is None else levels.dynamics / scaling.time,
        )
    raise ModelError(
        f"{_who(system)} is not uniquely solvable, or its index is above {max_mu + 1}: with "
        f"{max_mu} differentiations {reason}; is an equation missing, or there twice?"
    )


def _who(system: DescriptorSystem) -> str:
    return f"plant {system.name}" + (f" ({system.source})" if system.source else "")


_PLACES = np.sort([1e-3, 1.0 - 1e-3, *(np.arange(1, _PROBES + 1) * 0.6180339887498949 % 1.0)])


def _probe_times(system: DescriptorSystem, start: float, stop: float) -> Array:
    """Interior times, none of them special: equal spacing would hit the zeros of sin(k π t)."""
    t = start + (stop - start) * _PLACES
    jumps = system.coefficients.breakpoints(start, stop)
    if not len(jumps):
        return t
    cuts = np.concatenate([[start], jumps, [stop]])
    middles = 0.5 * (cuts[:-1] + cuts[1:])  # no piece between jumps goes unprobed
    return np.unique(np.concatenate([t, middles]))


def _judged(
    t: Array, c: Coefficients, mu: int, scaling: Scaling, rank_tol: float, invariant: bool
) -> tuple[_Levels, Pivots | Bases | None]:
    """Levels at all times, or at one that says why this μ will not do; and where to start from.

    ``c`` may have more times than t where E and A are constant.
    """
    if kernels.compiled is not None and (mu + 1) * c.E.shape[2] <= _SMALL:
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
    reference = _reference(e[:, middle], aa[:, middle], mu, one, invariant)
    levels = _all_levels(t, e, aa, mu, rank_tol, one, reference)
    return levels, None if levels.failure else reference


def _judged_compiled(
    t: Array, c: Coefficients, mu: int, scaling: Scaling, rank_tol: float, invariant: bool
) -> tuple[_Levels, Pivots | Bases | None] | None:
    """:func:`_judged`; None where it takes LAPACK to tell, or to say what is wrong."""
    compiled: Any = kernels.compiled
    n, middle = c.E.shape[2], len(t) // 2
    model = (c.E, c.A, scaling.rows, scaling.columns, scaling.time, mu)
    known, smallest, rows, columns, Z1, Z2, dynamics = compiled.start(*model, middle, rank_tol)
    trusted, counted = known.tolist()
    a = int(counted)
    if not trusted:
        return None
    at = t[middle : middle + 1]
    failure = _too_many(a, n, at) if a > n else _why_not(at, smallest, rank_tol)
    if failure:
        return _Levels(a, smallest, failure), None
    if invariant:
        finite: Array | None = dynamics if np.isfinite(dynamics).all() else None
        least = float(smallest.min())
        return _Levels(a, smallest, "", least, dynamics=finite), Bases(Z1[None], Z2[None])
    r = (mu + 1) * n - a
    known, smallest, dynamics = compiled.all_levels(
        *model, rows, columns, r, Z1, rank_tol, max(_PLAIN, 10.0 * rank_tol), _RESIDUAL
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
    Z2: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))  # (N, (μ+1) n, a)
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
    s2 = s2 / _norm(N)[:, None]
    if a:
        smallest[:, 1] = s2[:, -1]
    T2 = transpose(V2)[:, :, a:]
    s3 = np.linalg.svd(e[0] @ T2, compute_uv=False)
    s3 = s3 / _norm(e[0])[:, None]
    if a < n:
        smallest[:, 2] = s3[:, -1]
    failure = _why_not(t, smallest, rank_tol)
    if failure:
        return _Levels(a, smallest, failure)
    return _Levels(a, smallest, "", float(smallest.min(initial=np.inf)), Z2, T2)


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
    reference: Pivots | Bases,
) -> _Levels:
    """:func:`_levels` at all times t, given those of one time, ``one``.

    Away from rank changes bounds serve as well as singular values, and the elimination that
    :func:`reduce` does anyway gives them for a fraction of the price. With W = [Z1ᵀE; A2] and
    A2 = Z2ᵀN, Z2ᵀ = [−X I],

        σ_r(M) ≥ 1/‖M11⁻¹‖,      σ_min(Â2) ≥ 1/(‖W⁻¹‖ ‖Z2‖),      σ_min(E T2) ≥ 1/‖W⁻¹‖.

    Singular values are computed where a bound is small, or smallest.
    """
    if isinstance(reference, Bases):
        A2 = transpose(reference.Z2) @ derivative_array(e[:, :1], aa[:, :1], mu)[1]
        whole = np.concatenate([transpose(reference.Z1) @ e[0, :1], A2], axis=1)
        return replace(one, dynamics=_dynamics(reference.Z1[0], aa[0, :1], _inverse(whole)[0]))
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
        determined, dynamics = _norm(states), _dynamics(reference.Z1, aa[0], states)
        size = _array_size(_norm(M), aa)
        left = _norm(M[:, r:, r:] - X @ M[:, :r, r:])
        if r:
            bounds[:, 0] = 1.0 / (_norm(inverse) * size)
        if one.a:
            bounds[:, 1] = 1.0 / (determined * np.sqrt(one.a + _norm(X) ** 2) * _norm(N))
        if one.a < len(e[0, 0]):
            bounds[:, 2] = 1.0 / (determined * _norm(e[0]))
        plain = (bounds > max(_PLAIN, 10.0 * rank_tol)).all(axis=1) & (left <= _RESIDUAL * size)
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


def _norm(matrix: Array) -> Array:
    """Frobenius norms (N,), at least the smallest positive number."""
    return np.asarray(np.sqrt(np.einsum("nij,nij->n", matrix, matrix)) + np.finfo(float).tiny)


def _changes(what: str, ranks: Array, k: int, t: Array, sigma: Array) -> str:
    border = min(int(ranks[k]), int(ranks[0]))
    return (
        f"the rank of {what} changes from {ranks[0]} at t = {t[0]:.6g} to {ranks[k]} at "
        f"t = {t[k]:.6g} (singular value {sigma[border]:.1e})"
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
                f"{_who(system)}: the rank of the {names[column]} changes at t = {where:.9g} "
                f"(singular value {lowest:.1e}); choose a horizon that avoids this time"
            )


_CUTS = np.linspace(0.0, 1.0, _DIP_POINTS)


def _line(
    t: Array, c: Coefficients, mu: int, scaling: Scaling, rank_tol: float, a: int, column: int
) -> Array:
    """One column (N,) of the levels that belong to ``a`` constraints, at the times t."""
    if kernels.compiled is not None and (mu + 1) * c.E.shape[2] <= _SMALL:
        known, line = kernels.compiled.levels(
            c.E, c.A, scaling.rows, scaling.columns, scaling.time, mu, a, column
        )
        if known[0]:
            return np.asarray(line)
    e, aa = scaled(c, scaling)
    return _levels(t, e, aa, mu, rank_tol, a).smallest[:, column]


def _reference(
    e: Array, aa: Array, mu: int, one: _Levels, invariant: bool
) -> Pivots | Bases:
    """Where to start from at other times, from the coefficients and the levels of one."""
    Z1 = np.linalg.svd(e[0, 0] @ one.T2[0], full_matrices=False)[0]
    if invariant:
        return Bases(Z1[None], one.Z2[:1])
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


_MAX_GROWTH = 3e2  # of the elimination; beyond it singular vectors are computed instead
_LOOKS = 32  # times at which the sensitivity to rounding is looked at
_RESIDUAL = 1e-13  # rows that should vanish after elimination, relative to the array


def reduce(
    system: DescriptorSystem, structure: Structure, t: Array, inside: Array,
    c: Coefficients | None = None,
) -> StrangenessFree:
    """The strangeness-free equations at the times t (N,), one sweep over all of them.

    ``c`` are the model's coefficients there to the order μ, where they are at hand.

    Elimination on the pivots of one reference time where that is well conditioned, singular
    vectors at the times where it is not.

    Raises:
        ModelError: a rank differs from that of ``structure``; names the time.
    """
    mu, scaling = structure.mu, structure.scaling
    if c is None:
        c = system.coefficients.taylor(t, mu, inside)
    if kernels.compiled is not None and (mu + 1) * system.n <= _SMALL:
        found = _reduced_compiled(structure, len(t), c)
        if found is not None:
            return found
    f = forcing(c)
    count = slice(0, 1) if structure.time_invariant else slice(None)
    E, A = c.E[:, count], c.A[:, count]
    e, aa = scaled(Coefficients(E, A, c.B, c.F, c.C, c.u, c.theta), scaling)
    M, N = derivative_array(e, aa, mu)
    # [Â2 | f2] = Z2ᵀ [N | g] with g = (f_0, …, f_μ)
    weights = (scaling.time ** np.arange(mu + 1))[:, None] * scaling.rows
    g = np.moveaxis(f[: mu + 1] * weights[:, None, :], 0, 1).reshape(len(t), -1, 1)
    reference = structure.reference
    some = slice(0, None, _every(len(t)))
    if isinstance(reference, Bases):
        Z1 = reference.Z1
        A2, f2 = transpose(reference.Z2) @ N, transpose(reference.Z2) @ g
        size = np.abs(transpose(reference.Z2)) @ np.abs(np.concatenate(
            [np.broadcast_to(N, (len(g), *N.shape[1:]))[some], g[some]], axis=2
        ))
        inverse, poor = _inverse(np.concatenate([transpose(Z1) @ e[0], A2], axis=1))
    else:
        Z1, A2, f2, size, inverse, poor = _by_elimination(reference, e[0], M, N, g, some)
        if poor.any():
            Z1 = np.repeat(Z1, len(t), axis=0)
            Z1[poor], Z2 = _by_singular_vectors(
                system, structure, e[0][poor], M[poor], N[poor], t[poor]
            )
            A2[poor], f2[poor] = transpose(Z2) @ N[poor], transpose(Z2) @ g[poor]
            # What the elimination made grow there is not used, and amplifies nothing.
            looked = np.arange(len(t))[some]
            again = poor[looked]
            terms = np.abs(np.concatenate([N[poor], g[poor]], axis=2))
            size[again] = (np.abs(transpose(Z2)) @ terms)[(np.cumsum(poor) - 1)[looked[again]]]
            whole = np.concatenate([transpose(Z1[poor]) @ e[0][poor], A2[poor]], axis=1)
            inverse[poor], poor[poor] = _inverse(whole)
    if poor.any():
        raise ModelError(
            f"{_who(system)}: the equations do not determine the state near "
            f"t = {t[int(np.argmax(poor))]:.9g}"
        )
    # Back to the model's own states: only rows stay scaled, and row scalings do not matter.
    W1 = transpose(Z1) * scaling.rows
    inverse = scaling.columns[:, None] * inverse
    d = structure.d
    sensitivity = np.abs(inverse[some if len(inverse) > 1 else slice(None), :, d:])
    amplification = (sensitivity @ size).max(axis=0)
    amplification[:, :-1] /= scaling.columns
    return StrangenessFree(
        E1=W1 @ E[0],
        A1=W1 @ A[0],
        f1=_apply(W1, f[0]),
        A2=A2 / scaling.columns,
        f2=f2[:, :, 0],
        basis=inverse[:, :, :d] / scaling.time if structure.a else None,  # the scaled E is E/τ
        offset=-(inverse[:, :, d:] @ f2)[:, :, 0] if structure.a else None,
        amplification=amplification,
        E=E[0],
        u=c.u[0],
        C=c.C[0],
    )


def _every(count: int) -> int:
    """At every how many of so many times the sensitivity to rounding is looked at."""
    return max(1, count // _LOOKS)


def _reduced_compiled(
    structure: Structure, count: int, c: Coefficients
) -> StrangenessFree | None:
    """:func:`reduce`; None where the reference will not do at some time."""
    compiled: Any = kernels.compiled
    s, reference, E = structure.scaling, structure.reference, c.E[0]
    model = (c.E, c.A, s.rows, s.columns, s.time, structure.mu, c.B, c.F, c.u, c.theta)
    if isinstance(reference, Bases):
        E = E[:1]
        found = compiled.reduced_constant(*model, reference.Z1, reference.Z2, _every(count))
    else:
        found = compiled.reduced(
            *model, reference.rows, reference.columns, reference.rank, reference.Z1,
            _every(count), _MAX_GROWTH, _RESIDUAL,
        )
    known, E1, A1, f1, A2, f2, basis, offset, amplification = found
    if not known[0]:
        return None
    if not structure.a:
        basis = offset = None
    return StrangenessFree(
        E1, A1, f1, A2, f2, basis, offset, amplification, E, c.u[0], c.C[0]
    )


def _inverse(whole: Array) -> tuple[Array, BoolArray]:
    """Inverses, and where there is none."""
    try:
        inverse = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    except np.linalg.LinAlgError:
        inverse = np.full_like(whole, np.inf)
        for k, one in enumerate(whole):
            with suppress(np.linalg.LinAlgError):
                inverse[k] = np.linalg.inv(one)
    finite = np.isfinite(inverse)
    if finite.all():
        return inverse, np.zeros(len(inverse), dtype=bool)
    return inverse, np.asarray(~finite.all(axis=(1, 2)))


def _by_elimination(
    pivots: Pivots, E: Array, M: Array, N: Array, g: Array, some: slice
) -> tuple[Array, Array, Array, Array, Array, BoolArray]:
    """Z1 (1, n, d), Â2 (N, a, n), f2 (N, a, 1) on the reference pivots, [Z1ᵀE; Â2]⁻¹.

    Before the inverse, the size of the terms of [Â2 | f2] at ``some`` times; the last one says
    where the pivots will not do.
    """
    count, n, r = len(M), E.shape[1], pivots.rank
    right = np.concatenate([N, g], axis=2)[:, pivots.rows]
    poor = np.zeros(count, dtype=bool)
    if r < len(pivots.rows):
        M = M[:, pivots.rows[:, None], pivots.columns]
        try:
            X = transpose(np.asarray(
                np.linalg.solve(transpose(M[:, :r, :r]), transpose(M[:, r:, :r])),
                dtype=np.float64,
            ))
        except np.linalg.LinAlgError:
            everywhere = np.ones(count, dtype=bool)
            left = right[:, r:]
            size = np.abs(left[some])
            A2, f2 = left[:, :, :n], left[:, :, n:]
            return pivots.Z1[None], A2, f2, size, np.zeros_like(E), everywhere
        residual = _norm(M[:, r:, r:] - X @ M[:, :r, r:])
        poor = (residual > _RESIDUAL * _norm(M)) | (_norm(X) > _MAX_GROWTH)
        constraints = right[:, r:] - X @ right[:, :r]
        size = np.abs(right[some, r:]) + np.abs(X[some]) @ np.abs(right[some, :r])
    else:
        constraints = right[:, r:]
        size = np.abs(constraints[some])
    A2 = constraints[:, :, :n]
    whole = np.concatenate([pivots.Z1.T @ E, A2], axis=1)
    scale = np.maximum(np.abs(whole).max(axis=2), np.finfo(float).tiny)
    inverse, singular = _inverse(whole / scale[:, :, None])
    poor |= singular | (_norm(inverse) > _MAX_GROWTH)
    return pivots.Z1[None], A2, constraints[:, :, n:], size, inverse / scale[:, None, :], poor


def _by_singular_vectors(
    system: DescriptorSystem, structure: Structure, E: Array, M: Array, N: Array, t: Array
) -> tuple[Array, Array]:
    """Orthonormal Z1 and Z2 at times where the reference pivots will not do."""
    a = structure.a
    r = M.shape[1] - a
    U, sigma, _ = np.linalg.svd(M)
    _check_gap(system, structure, sigma, r, t)
    Z2 = U[:, :, r:]
    T2 = transpose(np.linalg.svd(transpose(Z2) @ N)[2])[:, :, a:]
    return np.linalg.svd(E @ T2, full_matrices=False)[0], Z2


def _apply(matrix: Array, vectors: Array) -> Array:
    """matrix (N or 1, i, j) times vectors (N, j)."""
    return np.asarray(np.matmul(matrix, vectors[:, :, None])[:, :, 0])


def _check_gap(
    system: DescriptorSystem, structure: Structure, sigma: Array, r: int, t: Array
) -> None:
    size = sigma[:, 0]
    zero = sigma[:, r:].max(axis=1, initial=0.0) > 1e3 * structure.rank_tol * size
    lost = sigma[:, r - 1] <= structure.rank_tol * size if r else np.zeros(len(sigma), bool)
    bad = zero | lost
    if bad.any():
        k = int(np.argmax(bad))
        value = sigma[k, r] if zero[k] else sigma[k, r - 1]
        raise ModelError(
            f"{_who(system)}: the rank of the derivative array changes near t = {t[k]:.9g} "
            f"(singular value {value / size[k]:.1e}); choose a horizon that avoids this time"
        )
