"""How wrong a solution may be: errors of elements, carried through the maps of the elements.

Each element adds what its polynomial leaves out, and rounding of everything its values are made
of. Whether these errors help or harm each other nobody knows, so they are added with random signs
several times over: the root mean square at an edge estimates (Σ_j ‖Φ_j l_j‖²)^½, where Φ_j leads
from element j to the edge. What is left out, and rounding where the matrices are constant, may be
wrong in the same direction each time: (Σ_j |Φ_j l_j|)² ≤ k Σ_j |Φ_j l_j|² (Cauchy, Schwarz) bounds
every choice of signs at the k-th edge. Rounding of times never is. So errors decay where the system
forgets, grow where it grows and add up where it swings. Absolute values of the maps were rejected:
a rotation would grow. Signs all equal were rejected: a rotation cancels them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.mesh import SHARE, Mesh
from gpebo_cli.numerics.problem import LinearProblem

EPS = float(np.finfo(float).eps)
TINY = float(np.finfo(float).tiny)
_SIGNS = 3  # choices of them for each kind of error
CHANCE = 4.0  # by how much a sum of independent errors may exceed its root mean square
END = 8.0  # units in the last place of what an end value is made of, lost in solving an element
VALUE = 32.0  # likewise of any value, which are not carried on
ROUNDING = 8.0  # units in the last place that cannot be resolved
LEVEL = 0.3  # coefficients that fall by less than this over two degrees are noise
_SHOWN = 8.0  # times the noise of coefficients: the most that rounding of constraints may be
_SAME = 1e-9  # relative difference of rates that are constant
_FAINT = 1e-6  # of the largest state: errors below that do not end a solution
_FEW = 1e-3  # of a component: beyond that an error leaves less than three digits
NOTHING = 8.0 * EPS  # of what it is made of: a component that is smaller is rounding itself


class Errors(NamedTuple):
    """Estimated errors of each component, and where they exceed it."""

    largest: Array  # (n, columns) over time
    own: Array  # (n, columns) the component's largest value, or what it is made of
    beside: Array  # (n, columns) the same, or the largest component in units of this one
    lost: int  # first element at whose end a component is lost, or their number
    last: Array  # (n, columns) of the right end

    @property
    def relative(self) -> Array:
        """To each component's own size."""
        relative = self.largest / self.own
        return np.where(np.isfinite(relative), relative, np.inf)

    @property
    def estimate(self) -> float:
        """The largest; what has too few digits counts beside the others: it may be zero."""
        known = np.where(self.largest < _FEW * self.own, self.own, self.beside)
        return float(self._replace(own=known).relative.max(initial=0.0))

    def vague(self, tol: float) -> BoolArray:
        """Which have too few digits, and may be more than ``tol`` of what is beside them."""
        few = self.largest >= _FEW * self.own
        return np.asarray(few & (self.largest > tol * self.beside))


def estimated_errors(
    problem: LinearProblem, mesh: Mesh, last: Array, particular: Array, noise: Array, values: Array,
    kept: Array | float = 1.0, instants: Array | float = 0.0,
) -> Errors:
    """Errors of the point values (K, s + 1, n, columns) of a solution.

    Of maps from left ends to right ends, ``last`` (K or 1, n, n), right ends from zero,
    ``particular`` (K, n, columns), and ``noise`` (K, n, n + 2 columns): what the terms of the
    equation, [of each component, alone, and alone by rounding of the time], can bring about in an
    element; relative rounding of them is an error. A share of it is ``kept`` (K, n, 1), and that of
    ``instants`` (K, n, columns) is added.
    """
    rule, (n, columns), most = mesh.rule, problem.start.shape, CHANCE**2
    rates = noise[..., :n] / mesh.steps[:, None, None]
    noise = kept * noise
    of_all, of_time = noise[..., : n + columns], noise[..., n + columns :]
    of_all[..., n:] += instants + TINY / EPS * values[:, 0].any(axis=0)  # what underflows
    if (np.abs(rates - rates[0]) <= _SAME * rates[0]).all():
        # Rounding of what is constant may be wrong in the same direction each time; that of times
        # is not, and comes with the share that the bound for all elements before has of this.
        before = np.arange(2.0, len(noise) + 2.0)
        of_time, most = of_time * np.sqrt(np.minimum(most / before, 1.0))[:, None, None], np.inf
    of_all[..., n:] += of_time
    carried, largest = elements.carried_errors(
        values, rule.to_legendre, rule.to_next, last, particular, of_all,
        random_signs(len(values), n, 2), LEVEL, END, most,
    )
    if problem.uncertain is not None:
        of_start = np.zeros((len(values), 1, *last.shape[1:]))
        of_start = elements.chain(last[:, None], of_start, np.eye(values.shape[2]))[0][:, 1]
        carried = np.sqrt(carried**2 + of_start**2 @ np.square(problem.uncertain))
        largest[0] = carried.max(axis=0)
    errors = judged_errors(problem, carried, *largest)
    if errors.lost == mesh.size:
        return errors
    # What has grown since is error, and nothing to compare with.
    known = np.maximum.accumulate(np.abs(values[:, -1]), axis=0)
    known = np.maximum(known, _FAINT * known.max(axis=(1, 2), keepdims=True))
    return errors._replace(lost=int(np.argmin((carried < known).all(axis=(1, 2)))))


def nothing_left(name: str, t: float) -> SolverError:
    """What is said where errors have grown larger than what they are errors of, at the time t."""
    return SolverError(
        f"the {name} grows so that rounding errors are larger than a state from t = {t:.6g} on, "
        "and no digit of it is known; shorten time.horizon"
    )


def judged_errors(
    problem: LinearProblem, carried: Array, largest: Array, tail: Array, own: Array, noise: Array,
    made_of: Array,
) -> Errors:
    """Errors from bounds of them at right ends, ``carried`` (K, n, c).

    The others are the largest over time (n, c) of these, of tails, of values, of noise that shows,
    and of what right ends are made of.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        seen = np.maximum(problem.seen, _SHOWN * noise / EPS)
        through = np.minimum(through_constraints(problem, own), seen)
        total = largest + tail + noise + EPS * (VALUE * own + through)
        if problem.units is None:
            scale = np.maximum(np.maximum(own, problem.floor), SHARE * own.max(initial=0.0))
            beside = scale = np.maximum(scale, TINY)
        else:
            # Rounding that constraints amplify is no size to compare with: it is the error itself.
            coupled = np.maximum(made_of, problem.floor)
            scale = np.maximum(np.where(own > NOTHING * coupled, own, coupled), TINY)
            beside = np.maximum(scale, problem.units * (own / problem.units).max(initial=0.0))
        # A state that is nothing beside the others is not lost: there is nothing to be known of it.
        known = np.maximum(scale, _FAINT * own.max(initial=0.0))
        if problem.units is not None:
            known = np.where(scale <= NOTHING * through, np.maximum(known, through), known)
        lost = int(np.argmin(np.append((carried < known).all(axis=(1, 2)), False)))
    return Errors(total, scale, beside, lost, carried[-1])


def random_signs(K: int, n: int, kinds: int = 1) -> Array:
    """For so many kinds of error at the start and the ends of K elements, (K + 1, n, 3 kinds)."""
    return _first_signs(1 << K.bit_length(), n)[: K + 1, :, : kinds * _SIGNS]


@lru_cache(maxsize=16)
def _first_signs(count: int, n: int) -> Array:
    bits = np.random.default_rng(0).integers(0, 2, (count, n, 2 * _SIGNS), dtype=np.int8)
    signs: Array = np.where(bits == 1, 1.0, -1.0)
    signs.flags.writeable = False
    return signs


def least_sizes(problem: LinearProblem, made_of: Array, tol: float) -> Array:
    """Sizes (n, columns) below which components are not resolved for their own sake.

    A share of what they are ``made_of``, and where ``tol`` of them is rounding that constraints let
    through.
    """
    if problem.units is None:
        made_of = np.full_like(made_of, made_of.max(initial=0.0))
    least = np.maximum(SHARE * made_of, problem.floor)
    return np.maximum(least, ROUNDING * EPS / tol * through_constraints(problem, made_of))


def through_constraints(problem: LinearProblem, sizes: Array) -> Array:
    """What relative rounding of components of these ``sizes`` (n, columns) amounts to in each."""
    if problem.amplification is None:
        return np.zeros_like(sizes)
    sizes = np.maximum(sizes, problem.floor)
    return np.asarray(problem.amplification[:, :-1] @ sizes + problem.amplification[:, -1:])
