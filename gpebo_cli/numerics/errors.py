"""How wrong a solution may be: errors of elements, carried through the maps of the elements.

Each element adds what its polynomial leaves out, and rounding of everything its values are made
of. Whether these errors help or harm each other nobody knows, so they are added with random signs
several times over: the root mean square at an edge estimates (Σ_j ‖Φ_j l_j‖²)^½, where Φ_j leads
from element j to the edge. What is left out, and rounding where the matrices are constant, may be
wrong in the same direction each time: (Σ_j |Φ_j l_j|)² ≤ k Σ_j |Φ_j l_j|² (Cauchy, Schwarz) bounds
every choice of signs at the k-th edge. So errors decay where the system forgets, grow where it
grows and add up where it swings. Absolute values of the maps were rejected: a rotation would grow.
Signs all equal were rejected: a rotation cancels them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import SHARE, Mesh, legendre_tail
from gpebo_cli.numerics.problem import LinearProblem
from gpebo_cli.numerics.radau import RadauRule

EPS = float(np.finfo(float).eps)
_TINY = float(np.finfo(float).tiny)
_SIGNS = 3  # choices of them for each kind of error
_CHANCE = 4.0  # by how much a sum of independent errors may exceed its root mean square
_END = 8.0  # units in the last place of what an end value is made of, lost in solving an element
_VALUE = 32.0  # likewise of any value, which are not carried on
_ROUNDING = 8.0  # units in the last place that cannot be resolved
_LEVEL = 0.3  # coefficients that fall by less than this over two degrees are noise
_SAME = 1e-9  # relative difference of rates that are constant
_FAINT = 1e-6  # of the largest state: errors below that do not end a solution
_NOTHING = 8.0 * EPS  # of what it is made of: a component that is smaller is rounding itself


class Errors(NamedTuple):
    """Estimated errors of each component, and where they exceed it."""

    relative: Array  # (n, columns) to the component's largest value
    lost: int  # first element at whose end a component is lost, or their number


def estimated_errors(
    problem: LinearProblem, mesh: Mesh, last: Array, particular: Array, noise: Array, values: Array
) -> Errors:
    """Errors of the point values (K, s + 1, n, columns) of a solution.

    Args:
        problem: the equation.
        mesh: of K elements.
        last: maps from left ends to right ends (K or 1, n, n).
        particular: right ends from zero (K, n, columns).
        noise: what the terms of the equation, [of each component, and alone], can bring about in an
            element (K or 1, n, n + columns); relative rounding of them is an error.
        values: the solution.
    """
    K, points, n, columns = values.shape
    rule = mesh.rule
    flat = values.reshape(K, points, n * columns)
    sizes = np.abs(values).max(axis=1)  # (K, n, columns)
    own = sizes.max(axis=0)
    rates = noise[..., :n] / mesh.steps[: len(noise), None, None]
    constant = bool((np.abs(rates - rates[0]) <= _SAME * rates[0]).all())
    with np.errstate(over="ignore", invalid="ignore"):
        made_of = np.abs(last) @ np.abs(values[:, 0]) + np.abs(particular)
        tail = legendre_tail(flat, rule, np.maximum(sizes.reshape(K, -1), _TINY))
        tail = tail.reshape(sizes.shape)
        # End points are superconvergent, of order 2s − 1 against s + 1 inside: with ρ the decay per
        # coefficient their error is about ρ^(s−1) times the tail. Half that exponent is used.
        decay = np.minimum(tail / np.maximum(sizes, _TINY), 1.0) ** (0.5 - 0.5 / rule.stages)
        rounded = _END * made_of + noise[..., :n] @ sizes + noise[..., n:]
        carried = _carried(problem, last, tail * decay, EPS * rounded, values, constant)
        total = carried.max(axis=0) + tail.max(axis=0) + _visible_noise(flat, rule, own)
        through = _through_constraints(problem, own)
        total += EPS * (_VALUE * own + through)
        coupled = np.maximum(np.maximum(made_of.max(axis=0), through), problem.floor)
        if problem.apart:
            scale = np.where(own > _NOTHING * coupled, own, coupled)
        else:
            scale = np.maximum(np.maximum(own, problem.floor), SHARE * own.max(initial=0.0))
        scale = np.maximum(scale, _TINY)
        # A state that is nothing beside the others is not lost: there is nothing to be known of it.
        lost = ~((carried < scale) | (carried < _FAINT * own.max(initial=0.0))).all(axis=(1, 2))
        relative = np.where(total > 0.0, total / scale, 0.0)
    return Errors(np.where(np.isfinite(relative), relative, np.inf),
                  int(np.argmax(lost)) if lost.any() else K)


def _carried(
    problem: LinearProblem, last: Array, left_out: Array, rounded: Array, values: Array,
    constant: bool,
) -> Array:
    """Bounds (K, n, columns) at right ends of the errors of both kinds that right ends add."""
    K, n, columns = left_out.shape
    signs, width = _signs(K, n), 2 * _SIGNS * columns
    kinds = np.empty((K, n, 2, _SIGNS, columns))
    np.multiply(signs[1:, :, 0], left_out[:, :, None], out=kinds[:, :, 0])
    np.multiply(signs[1:, :, 1], rounded[:, :, None], out=kinds[:, :, 1])
    added = kinds.reshape(K, n, width)
    at_start = np.zeros((n, 2, _SIGNS, columns))
    at_start[:, 1] = EPS * np.abs(values[0, 0])[:, None]
    start: Array = (signs[0] * at_start).reshape(n, width)
    if problem.renewal is None:
        ends = elements.chain(last[:, None], added[:, None], start)[0][:, 1]
    else:
        ends, error = np.empty_like(added), start
        for k in range(K):
            if k:
                apart = np.moveaxis(error.reshape(n, 2 * _SIGNS, columns), 1, 0)
                renewed = problem.renewal.error(values[k - 1, -1], apart)
                error = np.moveaxis(renewed, 0, 1).reshape(n, width)
            error = last[k if len(last) > 1 else 0] @ error + added[k]
            ends[k] = error
    squares = ends.reshape(K, n, 2, _SIGNS, columns) ** 2
    rms = np.sqrt(sum(squares[:, :, :, k] for k in range(_SIGNS)) / _SIGNS)
    systematic = np.sqrt(np.arange(2, K + 2))[:, None, None]
    chance = systematic if constant else np.minimum(systematic, _CHANCE)
    return np.asarray(systematic * rms[:, :, 0] + chance * rms[:, :, 1])


@lru_cache(maxsize=8)
def _signs(K: int, n: int) -> Array:
    """For each kind of error at the start and the ends of K elements, (K + 1, n, 2, _SIGNS, 1)."""
    bits = np.random.default_rng(0).integers(0, 2, (K + 1, n, 2, _SIGNS, 1), dtype=np.int8)
    signs: Array = np.where(bits == 1, 1.0, -1.0)
    signs.flags.writeable = False
    return signs


def least_sizes(problem: LinearProblem, made_of: Array, tol: float) -> Array:
    """Sizes (n, columns) below which components are not resolved for their own sake.

    A share of what they are ``made_of``, and where ``tol`` of them is rounding that constraints let
    through.
    """
    if not problem.apart:
        made_of = np.full_like(made_of, made_of.max(initial=0.0))
    least = np.maximum(SHARE * made_of, problem.floor)
    return np.maximum(least, _ROUNDING * EPS / tol * _through_constraints(problem, made_of))


def _through_constraints(problem: LinearProblem, sizes: Array) -> Array:
    """What relative rounding of components of these ``sizes`` (n, columns) amounts to in each."""
    if problem.amplification is None:
        return np.zeros_like(sizes)
    sizes = np.maximum(sizes, problem.floor)
    return np.asarray(problem.amplification[:, :-1] @ sizes + problem.amplification[:, -1:])


def _visible_noise(flat: Array, rule: RadauRule, own: Array) -> Array:
    """Rounding as the last coefficients show it: those of a signal fall, those of noise do not."""
    if rule.stages < 4:
        return np.zeros_like(own)
    last = np.abs(np.matmul(rule.to_legendre[-4:], flat))  # degrees s − 3 … s
    before, after = last[:, :2].max(axis=1), last[:, 2:].max(axis=1)
    noise = np.where(after >= _LEVEL * before, after, 0.0)
    return np.asarray(noise.max(axis=0).reshape(own.shape))
