"""From a descriptor system of any index to an equivalent strangeness-free one.

Kunkel & Mehrmann, Differential-Algebraic Equations (EMS 2006), chapter 3: differentiate the model
μ times and read off, at every time, all constraints (hidden ones too) and the differential
equations that are left. In Taylor coefficients e_k = E^(k)/k!, x_k = x^(k)/k!, … the i-th
derivative of E x' = A x + f is, free of binomials,

    Σ_j (j + 1) e_{i−j} x_{j+1} = Σ_j a_{i−j} x_j + f_i            i = 0 … μ

or M (x_1, …, x_{μ+1}) = N x_0 + g with M_ij = (j + 1) e_{i−j} − a_{i−j−1}, N_i = a_i, g_i = f_i.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gpebo_cli.kernels.structure_numpy import forcing as kernel_forcing
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem, distinct
from gpebo_cli.numerics.linalg import largest_over_time

_KEPT = 40  # states, up to which what the pattern of E and A alone decides is kept
_NOTHING = 1e-13  # entries below this, after scaling, are rounding


@dataclass(frozen=True, eq=False)
class Scaling:
    """Constant scalings under which ranks are judged: rows, states and the unit of time.

    Farads beside kiloohms would otherwise make an honest equation look like a rank deficiency.
    Powers of two, so that scaling commits no rounding error.
    """

    rows: Array  # (n,)
    columns: Array  # (n,) x = columns * x̃
    time: float  # τ, derivatives are taken with respect to t/τ
    # Powers of ten by which the rows of E are of comparable size: equations within a decade of
    # each other count as they were written.
    weights: Array  # (n,)


def forcing(c: Coefficients) -> Array:
    """Taylor coefficients of f = B u + F θ + φ, shape (K + 1, N, n)."""
    return np.asarray(c.phi + kernel_forcing(c.B, c.F, c.u, c.theta, len(c.E)))


def balance(c: Coefficients, mass: float = 1.0) -> Scaling:
    """Scalings that bring the entries of E/τ and A to comparable size, in any units.

    The logarithms of the factors minimise Σ (ln|E_ij| + r_i + c_j − τ)² + Σ (ln|A_ij| + r_i + c_j)²
    over all entries that are not zero, |·| being the largest over time: multiplying an equation, a
    state or the time by a number changes its factor alone. Terms of E count ``mass`` times.
    """
    n = c.E.shape[2]
    sizes = np.array([largest_over_time(distinct(matrix)[0]) for matrix in (c.E, c.A)])
    there = sizes > 0.0
    while True:
        balancing = _balancing if n <= _KEPT else _balancing.__wrapped__
        terms, least_squares, counts = balancing(there.tobytes(), n, mass)
        logs = np.log(sizes[there])
        factors = -(least_squares @ ((logs * counts) @ terms))
        entries = np.exp(terms @ factors + logs)
        if entries.min(initial=1.0) > _NOTHING * entries.max(initial=1.0):
            break
        scaled_sizes = np.zeros_like(sizes)
        scaled_sizes[there] = entries
        rest = scaled_sizes > _NOTHING * np.sqrt(
            scaled_sizes.max(axis=(0, 2))[:, None] * scaled_sizes.max(axis=(0, 1))
        )
        if (rest == there).all():
            break
        there = rest  # once more without what turned out to be rounding
    r = factors[:n]
    # A factor of all rows is left open, and means nothing.
    weights = 10.0 ** np.rint((r - r[0]) / np.log(10.0)) if n else np.zeros(0)
    powers = np.exp2(np.rint(factors / np.log(2.0)))
    return Scaling(powers[:n], powers[n:-1], float(powers[-1]), np.asarray(weights))


@lru_cache(maxsize=64)
def _balancing(there: bytes, n: int, mass: float) -> tuple[Array, Array, Array]:
    """What r, c and τ contribute to the logarithm of each entry that is there; (terms⊤terms)⁺.

    And how much each entry counts.
    """
    kind, i, j = np.frombuffer(there, dtype=np.bool_).reshape(2, n, n).nonzero()
    every, terms = np.arange(len(i)), np.zeros((len(i), 2 * n + 1))
    terms[every, i] = terms[every, n + j] = 1.0
    terms[:, -1] = kind - 1.0
    counts = np.where(kind, 1.0, mass)
    inverse = np.linalg.pinv((counts * terms.T) @ terms, rcond=1e-12, hermitian=True)
    return terms, np.asarray(inverse), counts


def who(system: DescriptorSystem) -> str:
    """The plant, as messages name it."""
    return f"plant {system.name}" + (f" ({system.source})" if system.source else "")
