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

import numpy as np

from gpebo_cli.kernels.structure_numpy import forcing as kernel_forcing
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem

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


def balance(c: Coefficients) -> Scaling:
    """Scalings that bring the entries of E/τ and A to comparable size, in any units.

    The logarithms of the factors minimise Σ (ln|E_ij| + r_i + c_j − τ)² + Σ (ln|A_ij| + r_i + c_j)²
    over all entries that are not zero, |·| being the largest over time: multiplying an equation, a
    state or the time by a number changes its factor alone.
    """
    n = c.E.shape[2]
    sizes = np.array([np.abs(c.E[0]).max(axis=0), np.abs(c.A[0]).max(axis=0)])
    logs = np.log(np.maximum(sizes, np.finfo(float).tiny))
    factors, there = np.zeros(2 * n + 1), sizes > 0.0
    normal = np.zeros((2 * n + 1, 2 * n + 1))
    while True:
        both, of_E = there.sum(axis=0), there[0]
        known = np.where(there, logs, 0.0)
        normal[:n, n:-1], normal[n:-1, :n] = both, both.T
        normal[:n, -1], normal[n:-1, -1] = -of_E.sum(axis=1), -of_E.sum(axis=0)
        normal[-1] = normal[:, -1]
        diagonal = [both.sum(axis=1), both.sum(axis=0), of_E.sum(keepdims=True)[0]]
        np.fill_diagonal(normal, np.concatenate(diagonal))
        sums = known.sum(axis=0)
        right = np.concatenate([-sums.sum(axis=1), -sums.sum(axis=0), [known[0].sum()]])
        factors = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        r, columns, tau = factors[:n], factors[n:-1], factors[-1]
        scaled_sizes = sizes * np.exp(r[:, None] + columns - np.array([tau, 0.0])[:, None, None])
        rest = there & (scaled_sizes > _NOTHING * np.sqrt(
            scaled_sizes.max(axis=(0, 2))[:, None] * scaled_sizes.max(axis=(0, 1))
        ))
        if (rest == there).all():
            break
        there = rest  # once more without what turned out to be rounding
    # A factor of all rows is left open, and means nothing.
    weights = 10.0 ** np.rint((r - r[0]) / np.log(10.0)) if n else np.zeros(0)
    return Scaling(
        _power_of_two(r), _power_of_two(columns), float(_power_of_two(tau)), np.asarray(weights)
    )


def _power_of_two(logarithm: Array) -> Array:
    return np.asarray(np.exp2(np.rint(logarithm / np.log(2.0))))


def who(system: DescriptorSystem) -> str:
    """The plant, as messages name it."""
    return f"plant {system.name}" + (f" ({system.source})" if system.source else "")
