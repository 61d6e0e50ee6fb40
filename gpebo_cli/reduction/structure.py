"""The structure of a descriptor system: its index, and how many constraints it has.

Kunkel & Mehrmann, Differential-Algebraic Equations, Hypothesis 3.48: ranks of the derivative array
(``kernels/structure_numpy.py``) that have to be the same at every time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.kernels.structure_numpy import frobenius_norm, scaled
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem, IntArray, distinct
from gpebo_cli.model.expressions.bounds import halved
from gpebo_cli.numerics.linalg import inverse_or_none, transpose
from gpebo_cli.numerics.mesh import FIRST_ELEMENTS, initial_edges
from gpebo_cli.reduction.scaling import Scaling, balance
from gpebo_cli.reduction.stages import Stages, UnclearError, in_stages

RESIDUAL = 1e-13  # rows that should vanish after elimination, relative to the array
_PROBES = 65  # times at which the structure is established before anything is integrated
_DIP = 0.2  # a singular value that falls below this share of its maximum is followed down
_DIP_ROUNDS = 14
_FALL = 1e-2  # towards an end of the horizon, singular values may fall to this share
_DIP_POINTS = 17
_MOST_DIPS = 32  # of each kind: bounds have some of their own, where pivots fail
_LOOKED_AHEAD = 400  # rows of a derivative array beyond the limit of differentiations


class Pivots(NamedTuple):
    """Rows and columns of M that carry its rank at one time, for cheap elimination at others.

    Z2 and Z1 are only needed up to scalings of rows, so any basis will do: M[rest] − X M[rows]
    with X = M[rest, columns] M[rows, columns]⁻¹ costs one LU where an SVD costs thirty.
    """

    rows: IntArray  # (rows,) all of them, the r pivots first
    columns: IntArray  # (columns,) likewise
    rank: int  # r
    Z1: Array  # (n, d) orthonormal, completes the constraints at that time


_NO_PIVOTS = Pivots(np.zeros(0, np.intp), np.zeros(0, np.intp), 0, np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class Structure:
    """The characteristic values of the system and how they were judged."""

    mu: int  # strangeness index μ
    a: int  # number of constraints
    d: int  # number of differential equations, n − a
    # Smallest one counted as nonzero, relative, at the probes where a bound of it is smallest.
    smallest_singular_value: float
    time_invariant: bool  # E and A are constant
    # What follows is of derivative arrays and stages alone.
    scaling: Scaling = field(default=Scaling(np.ones(0), np.ones(0), 1.0), repr=False)
    rank_tol: float = 0.0
    reference: Pivots = field(default=_NO_PIVOTS, repr=False)  # of one time, for all the others
    steady: bool = True  # no singular value behind the ranks comes near zero between the ends
    # z' = this z + … with z = Z1ᵀE x: Z1ᵀA T, [Z1ᵀE; Â2] T = [I; 0]; None where not determined
    dynamics: Array | None = field(default=None, repr=False)  # (N or 1, d, d) at the probes, 1/s
    # Ranks of E, see ``stages.py``, where the derivative array does not tell them clearly.
    stages: tuple[int, ...] = ()

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
        return 0.0 if self.dynamics is None else float(growth_rates(self.dynamics).max())


def who(system: DescriptorSystem) -> str:
    """The plant, as messages name it."""
    return f"plant {system.name}" + (f" ({system.source})" if system.source else "")


def growth_rates(matrices: Array) -> Array:
    """Largest real parts (N,) of the eigenvalues of matrices (N, d, d) in 1/s, or zero."""
    return np.asarray(np.linalg.eigvals(matrices).real.max(axis=1, initial=0.0))


def analyse(
    system: DescriptorSystem, start: float, stop: float, *, max_mu: int, rank_tol: float
) -> Structure:
    """Find the smallest μ for which the system is strangeness-free after μ differentiations.

    Three ranks decide (Kunkel & Mehrmann, Hypothesis 3.48): that of M, that of the constraints
    Â2 = Z2ᵀN, and that of E on their kernel. Each must be the same at every time; between the
    probes, singular values that dip are followed to the bottom. What is found out about a plant
    given as text is kept with its matrices, for its next run.
    """
    kept: dict[object, Structure] = getattr(system.coefficients, "kept", {})
    asked = start, stop, max_mu, rank_tol
    if asked not in kept:
        kept[asked] = _analysed(system, *asked)
    return kept[asked]


def _analysed(
    system: DescriptorSystem, start: float, stop: float, max_mu: int, rank_tol: float
) -> Structure:
    """:func:`analyse` for the first time."""
    invariant = {"E", "A"} <= system.coefficients.constant
    t = _probe_times(system, start, stop)[: 1 if invariant else None]
    c = system.coefficients.taylor(t, 0)
    scaling = balance(c)
    reason = ""
    for mu in range(max_mu + 1):
        if mu:
            c = system.coefficients.taylor(t, mu)
        _refuse_overflow(system, c, scaling)
        levels = _judged(t, c, scaling, rank_tol)
        if levels.reference is None:
            reason = levels.failure
            continue
        if mu and (levels.least < _UNCLEAR or _differs(t, c, scaling, rank_tol, levels.a)):
            staged = _in_stages(system, t, max_mu, rank_tol, levels.least)
            if staged is not None:
                return staged
            # The right μ is followed by others that find the same number of constraints.
            more = system.coefficients.taylor(t, mu + 1)
            if _judged(t, more, scaling, rank_tol).a != levels.a:
                raise unclear_ranks(system, t, UnclearError(0, rounding=True))
        found = Structure(
            mu=mu, a=levels.a, d=system.n - levels.a, scaling=scaling, rank_tol=rank_tol,
            smallest_singular_value=levels.least, time_invariant=invariant,
            reference=levels.reference,
            dynamics=None if levels.dynamics is None else levels.dynamics / scaling.time,
        )
        if not invariant:
            steady = follow_dips(
                t, levels.smallest, rank_tol, partial(_lines, system, found),
                partial(_rank_changes, system),
            )
            found = replace(found, steady=steady)
        if not levels.a and "E" not in system.coefficients.constant:
            _refuse_crossing(system, t, c.E[0])
        return found
    staged = _in_stages(system, t, max_mu, rank_tol)
    if staged is not None:
        return staged
    _refuse_limit(system, t[len(t) // 2 :][:1], scaling, max_mu, rank_tol)
    raise ModelError(
        f"{who(system)} is not uniquely solvable, or its index is above {max_mu + 1} (solver."
        f"max_strangeness_index = {max_mu}): with {max_mu} differentiations {reason}; is an "
        "equation missing, or there twice?"
    )


def _refuse_limit(
    system: DescriptorSystem, t: Array, scaling: Scaling, max_mu: int, rank_tol: float
) -> None:
    """Refuse by the name of the limit if at a time t (1,) a higher one would do."""
    constraints = -1
    for mu in range(max_mu + 1, min(system.n + 1, 20, _LOOKED_AHEAD // system.n) + 1):
        c = system.coefficients.taylor(t, mu)
        levels = _judged(t, c, scaling, rank_tol)
        if levels.reference is None:
            continue
        if levels.a == constraints:  # two in a row: rounding does not find the same ones
            raise index_above(system, max_mu, mu)
        constraints = levels.a


def index_above(system: DescriptorSystem, max_mu: int, index: int) -> ModelError:
    """The refusal of a plant of this index, where μ may be ``max_mu`` at most."""
    return ModelError(
        f"the index of {who(system)} is above {max_mu + 1}, for solver.max_strangeness_index = "
        f"{max_mu}; it seems to be {index}: raise that to {index - 1}"
    )


def _in_stages(
    system: DescriptorSystem, t: Array, max_mu: int, rank_tol: float, least: float = 0.0
) -> Structure | None:
    """What :mod:`.stages` find at the times t (N,), if that is clearer than a singular value."""
    # Nothing of A stands beside E here, and rates in A say nothing about it.
    s = balance(system.coefficients.taylor(t, 0), _MASS)
    mu, ranks = 0, None

    def found(c: Coefficients) -> Stages:
        e, a = scaled(c.E, c.A, s.rows, s.columns, s.time, mu + 1)
        return in_stages(e, a, np.zeros((mu + 1, 1, system.n, 0)), rank_tol, 1, ranks)

    def lines(t: Array, column: IntArray) -> Array:
        try:
            smallest = found(system.coefficients.taylor(t, mu)).smallest
        except UnclearError as unclear:  # everything is clear away from there
            raise unclear_ranks(system, t, UnclearError(unclear.place)) from unclear
        lines = smallest.reshape(-1, _DIP_POINTS, 4)[range(len(column)), :, column]
        return np.where(column[:, None] == 3, lines / largest, lines)

    while True:
        c = system.coefficients.taylor(t, mu)
        try:
            stages = found(c)
        except UnclearError as error:
            unclear = error
        else:
            unclear = UnclearError(0, rounding=True)
            values = stages.smallest[:, :3].min(axis=1)
            # What is blurred at a few times only is on its way to zero, or is seen not to be.
            if np.median(values) > _BLURRED and values.min() > least:
                break
        if mu == max_mu:
            if (unclear.rounding or unclear.sudden) and not least:
                raise unclear_ranks(system, t, unclear)
            return None
        mu += 1
    ranks, largest = stages.ranks, float(stages.smallest[:, 3].max())
    stages.smallest[:, 3] /= largest
    steady = len(t) == 1 or follow_dips(
        t, stages.smallest, rank_tol, lines, partial(_rank_changes, system)
    )
    n, a = system.n, stages.A2.shape[1]
    E, A = (matrix[0] * (s.rows[:, None] * s.columns) for matrix in (c.E, c.A))
    W1 = transpose(stages.Z1)
    inverse, singular = inverse_or_none(np.concatenate([W1 @ E / s.time, stages.A2], axis=1))
    return Structure(
        mu=mu, a=a, d=n - a, scaling=s, rank_tol=rank_tol,
        smallest_singular_value=float(stages.smallest[:, :3].min()), time_invariant=len(t) == 1,
        steady=steady,
        dynamics=None if singular.any() else W1 @ A @ inverse[:, :, : n - a] / s.time,
        stages=ranks,
    )


def _differs(t: Array, c: Coefficients, scaling: Scaling, rank_tol: float, a: int) -> bool:
    """Whether stages find another number of constraints at one time.

    A rate λ has singular values of λ^−2μ, which may count as zero. In E, [E A] or [E; A] it has
    some of 1/λ: stages are looked at only where there are any.
    """
    middle, of = len(t) // 2, scaling
    there, n = slice(middle, middle + 1), len(of.rows)
    E, A = (x if x.shape[1] == 1 else x[:, there] for x in (c.E, c.A))
    e, aa = scaled(E, A, of.rows, of.columns, of.time, len(E))
    now = e[0, 0], aa[0, 0]
    beside = now[0], np.hstack(now), np.vstack(now)
    spread = [np.linalg.svd(x, compute_uv=False).tolist() for x in beside]
    if not any(rank_tol * s[0] < value < _APART * s[0] for s in spread for value in s):
        return False
    try:
        stages = in_stages(e, aa, np.zeros((len(e), 1, n, 0)), rank_tol, 1)
    except UnclearError:
        return False
    return bool(stages.A2.shape[1] != a)


def unclear_ranks(system: DescriptorSystem, t: Array, unclear: UnclearError) -> ModelError:
    """What :mod:`.stages` could not tell at one of the times t (N,)."""
    before, when = t[max(unclear.place - 1, 0)], t[unclear.place]
    if before < when:
        when = [when, *system.coefficients.breakpoints(before, when)][-1]
    why = f"a rank changes near t = {when:.9g}; choose a horizon that avoids this time"
    if unclear.rounding:
        why = (
            "rounding of its largest entries leaves no digit of its hidden constraints: rates or "
            "units in one equation are too far apart for its index; leave out what is fastest"
        )
    return ModelError(f"{who(system)}: {why}")


def _refuse_overflow(system: DescriptorSystem, c: Coefficients, scaling: Scaling) -> None:
    """LAPACK's singular values of what is not finite may take for ever."""
    with np.errstate(all="ignore"):
        weight = scaling.rows[:, None] * scaling.columns * scaling.time ** (len(c.E) - 1)
        finite = all(np.isfinite(distinct(x) * weight).all() for x in (c.E, c.A))
    if not finite:
        raise ModelError(
            f"{who(system)}: E and A change by more powers of ten than numbers hold; shorten "
            "time.horizon, or is a sign or a unit wrong?"
        )


_NARROW = 16  # probes in a cell in which something is narrow
_MOST_PROBES = 1 << 13
_PLACES = np.sort([1e-3, 1.0 - 1e-3, *(np.arange(1, _PROBES + 1) * 0.6180339887498949 % 1.0)])


def _probe_times(system: DescriptorSystem, start: float, stop: float) -> Array:
    """Interior times, none of them special: equal spacing would hit the zeros of sin(k π t)."""
    t = start + (stop - start) * _PLACES
    jumps = system.coefficients.breakpoints(start, stop)
    if not {"E", "A"} <= system.coefficients.constant:
        edges, _ = system.coefficients.resolved(initial_edges(start, stop, jumps))
        steps = edges[1:] - edges[:-1]
        narrow = (steps < 0.4 * (stop - start) / FIRST_ELEMENTS).nonzero()[0]
        if len(narrow):
            narrow = narrow[:: 1 + len(narrow) * _NARROW // _MOST_PROBES]
            places = (np.arange(_NARROW) + 0.5) / _NARROW
            looks = edges[narrow, None] + steps[narrow, None] * places
            t = np.union1d(t, looks)
    if not len(jumps):
        return t
    cuts = np.concatenate([[start], jumps, [stop]])
    middles = 0.5 * (cuts[:-1] + cuts[1:])  # no piece between jumps goes unprobed
    return np.union1d(t, middles)


def _judged(t: Array, c: Coefficients, scaling: Scaling, rank_tol: float) -> _Levels:
    """Levels at all times, or at one that says why this μ will not do."""
    model = (c.E, c.A, scaling.rows, scaling.columns, scaling.time, len(c.E))
    middle, n, height = len(t) // 2, c.E.shape[2], len(c.E) * c.E.shape[2]
    at = t[middle : middle + 1]
    # A μ that will not do fails at one time already.
    a, smallest, rows, columns, Z1 = kernels.structure.reference(*model, middle, rank_tol)
    smallest = smallest[None]
    failure = _why_not(at, smallest, rank_tol) if a <= n else (
        f"{a} constraints appear for {n} states (t = {at[0]:.6g})"
    )
    if failure:
        return _Levels(a, smallest, failure)
    reference = Pivots(rows, columns, height - a, Z1)
    bounds, left, dynamics = kernels.structure.bounds(*model, *reference)
    finite: Array | None = dynamics if np.isfinite(dynamics).all() else None
    if len(t) == 1:
        return _Levels(a, smallest, "", reference, float(smallest.min()), finite)
    # Away from rank changes bounds serve as well as singular values, and the elimination that
    # the reduction does anyway gives them for a fraction of the price. Singular values are computed
    # where a bound is small, or smallest.
    plain = (bounds > max(_PLAIN, 10.0 * rank_tol)).all(axis=1) & (left <= RESIDUAL)
    closer = ~plain
    closer[bounds.argmin(axis=0)] = True
    closer[middle] = True  # of the reference, whose ranks the others must have
    which = closer.nonzero()[0]
    E, A = (x if x.shape[1] == 1 else x[:, which] for x in (c.E, c.A))
    counts, exact = kernels.structure.levels(E, A, *model[2:], rank_tol, -1)
    if (counts != a).any():
        times, k = t[which], int(np.argmax(counts != counts[0]))
        first, then = (height - int(counts[i]) for i in (0, k))
        lost = min(height - min(first, then) - 1, n)  # constraints, were it not zero
        value = kernels.structure.levels(E, A, *model[2:], rank_tol, lost)[1][:, 0]
        return _Levels(a, bounds, (
            f"the rank of the derivative array changes from {first} at t = {times[0]:.6g} to "
            f"{then} at t = {times[k]:.6g} (singular value {value[min(k, len(value) - 1)]:.1e})"
        ))
    # Beside a bound, the singular value itself would make dips of all the times around it.
    bounds[~plain] = exact[~plain[which]]
    if failure := _why_not(t[which], exact, rank_tol):
        return _Levels(a, bounds, failure)
    return _Levels(a, bounds, "", reference, float(exact.min()), finite)


class _Levels(NamedTuple):
    """Singular values that must stay away from zero, or why this μ will not do."""

    a: int
    smallest: Array  # (N, 3) of M, Â2 and E T2, relative to the size of their factors; or bounds
    failure: str
    reference: Pivots | None = None  # where to start from
    least: float = np.inf  # of those that were computed
    dynamics: Array | None = None  # (N or 1, d, d) in scaled time, see ``Structure``


def _why_not(t: Array, smallest: Array, rank_tol: float) -> str:
    """What the singular values of Â2 or E T2 (N, 3) say against this μ, or nothing."""
    bad = smallest[:, 1:] <= rank_tol
    if not bad.any():
        return ""
    column = int(np.argmax(bad.any(axis=0)))
    k = int(np.argmax(bad[:, column]))
    what = ("constraints are linearly dependent",
            "some states are in no equation's derivative and in no constraint")[column]
    return f"{what} at t = {t[k]:.6g} (singular value {smallest[k, column + 1]:.1e})"


_MASS = 1e3  # by how much more entries of E than those of A decide about scales in stages
_BLURRED = 1e-4  # singular values below this are no structure in stages, whose rows are orthonormal
_APART = 0.05  # singular values of the scaled E and A that say of no rate beside others
_UNCLEAR = 1e-3  # with singular values below this, stages may be clearer
_PLAIN = 1e-5  # bounds of singular values above this need no closer look


def _dips(smallest: Array) -> tuple[bool, list[tuple[int, int]]]:
    """Dips of the singular values or bounds (N, 3), and whether there is none between the ends.

    A dip is a local minimum far below the column's maximum, given as its column and its place;
    the sharpest of each column come first, because beside a zero between two probes, however fast
    it is passed, one is at most a third of the next. There is none in columns that are not finite.
    """
    steady, dips, size, least = True, [], smallest.max(axis=0), smallest.min(axis=0)
    for column in ((least < _DIP * size) & np.isfinite(size)).nonzero()[0].tolist():
        values, last = smallest[:, column], len(smallest) - 1
        rises = values[1:] >= values[:-1]
        deep = values < _DIP * size[column]
        deep[:-1] &= rises
        deep[1:] &= values[1:] <= values[:-1]
        places = deep.nonzero()[0]
        before, after = np.maximum(places - 1, 0), np.minimum(places + 1, last)
        sharp = (values[places] / np.maximum(values[before], values[after])).argsort()
        steady &= not deep[1:last].any() and bool(least[column] >= _FALL * size[column])
        dips += [(column, k) for k in places[sharp][:_MOST_DIPS].tolist()]
    return steady, dips


def _refuse_crossing(system: DescriptorSystem, t: Array, E: Array) -> None:
    """Without constraints E has to be regular: its determinant keeps its sign from probe to probe.

    A singular value that passes zero faster than the probes are dense shows in this only.
    """
    sign = np.linalg.slogdet(E)[0]
    changes = np.flatnonzero(sign[1:] != sign[:-1])
    if not len(changes):
        return
    at = halved(
        lambda t: np.linalg.slogdet(system.coefficients.taylor(t, 0).E[0])[0], sign[changes],
        t[changes], t[changes + 1],
    )
    raise ModelError(
        f"{who(system)}: the rank of the differential part changes at t = {at[0]:.9g} (det E "
        "changes its sign); choose a horizon that avoids this time"
    )


def _rank_changes(system: DescriptorSystem, column: int, t: float, value: float) -> ModelError:
    """What is said of a decisive singular value that ends at zero."""
    name = ("derivative array", "constraints", "differential part", "constraints")[column]
    return ModelError(
        f"{who(system)}: the rank of the {name} changes at t = {t:.9g} (singular value "
        f"{value:.1e}); choose a horizon that avoids this time"
    )


def follow_dips(
    t: Array, smallest: Array, rank_tol: float, lines: Callable[[Array, IntArray], Array],
    refusal: Callable[[int, float, float], ModelError],
) -> bool:
    """Follow local minima of decisive singular values (N, columns); whether there is none inside.

    ``lines`` are those of the columns (D,) at times one grid for each after the other, (D, points);
    the ``refusal`` is of a column, at a time, with a value that is zero.

    A rank that drops at an isolated time is never hit by a grid: |sin t| is 1e-2 at the nearest
    probe and looks harmless. Each deep local minimum is bracketed and cut by 8 per round, for as
    long as the value is far below those at the ends of its bracket: so it is on the way to zero,
    and not at the flat bottom of a harmless dip. Comparing with the round before would not do: a
    probe may by luck be nearer to the zero than the times of the first round.
    """
    steady, dips = _dips(smallest)
    column, k = np.array(dips, dtype=np.intp).reshape(-1, 2).T
    left, right = t[np.maximum(k - 1, 0)], t[np.minimum(k + 1, len(t) - 1)]
    lowest, zero = smallest[k, column], np.maximum(rank_tol, 1e-9 * smallest.max(axis=0))
    for _ in range(_DIP_ROUNDS):
        if not len(column):
            break
        grid = left[:, None] + (right - left)[:, None] * _CUTS
        grid[:, -1] = right
        values = lines(grid.ravel(), column)
        dip, best = np.arange(len(values)), values.argmin(axis=1)
        before, after = np.maximum(best - 1, 0), np.minimum(best + 1, _DIP_POINTS - 1)
        value = values[dip, best]
        lowest = np.minimum(lowest, value)
        lost = lowest <= zero[column]
        if lost.any():
            i = int(np.argmax(lost))
            raise refusal(int(column[i]), float(grid[i, best[i]]), float(lowest[i]))
        falls = value < 0.5 * np.maximum(values[dip, before], values[dip, after])
        left, right = grid[dip, before][falls], grid[dip, after][falls]
        column, lowest = column[falls], lowest[falls]
    return steady


_CUTS = np.linspace(0.0, 1.0, _DIP_POINTS)


def _lines(
    system: DescriptorSystem, structure: Structure, t: Array, column: IntArray
) -> Array:
    """Columns (D,) of the levels that belong to the constraints there are, (D, points).

    Bounds of them from below serve as well, where none of them comes near zero.
    """
    s, rank_tol = structure.scaling, structure.rank_tol
    c = system.coefficients.taylor(t, structure.mu)
    model = s.rows, s.columns, s.time, structure.mu + 1
    bounds, left, _ = kernels.structure.bounds(c.E, c.A, *model, *structure.reference)
    lines = bounds.reshape(-1, _DIP_POINTS, 3)[range(len(column)), :, column]
    sound = (lines > max(_PLAIN, 10.0 * rank_tol)).all(axis=1)
    sound &= (left.reshape(-1, _DIP_POINTS) <= RESIDUAL).all(axis=1)
    for i in np.flatnonzero(~sound).tolist():
        some = slice(i * _DIP_POINTS, (i + 1) * _DIP_POINTS)
        E, A = (x if x.shape[1] == 1 else x[:, some] for x in (c.E, c.A))
        levels = kernels.structure.levels(E, A, *model, rank_tol, structure.a)[1]
        lines[i] = levels[:, column[i]]
    return np.asarray(lines)
