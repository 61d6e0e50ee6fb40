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

from gpebo_cli import kernels
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem

# Largest derivative array for the compiled kernels: beyond it LAPACK's blocks are worth its calls.
SMALL = 32


@dataclass(frozen=True, eq=False)
class Scaling:
    """Constant scalings under which ranks are judged: rows, states and the unit of time.

    Farads beside kiloohms would otherwise make an honest equation look like a rank deficiency.
    Powers of two, so that scaling commits no rounding error.
    """

    rows: Array  # (n,)
    columns: Array  # (n,) x = columns * x̃
    time: float  # τ, derivatives are taken with respect to t/τ


def forcing(c: Coefficients) -> Array:
    """Taylor coefficients of f = B u + F θ + φ, shape (K + 1, N, n)."""
    orders = len(c.E)
    f = c.phi.copy()
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


def who(system: DescriptorSystem) -> str:
    """The plant, as messages name it."""
    return f"plant {system.name}" + (f" ({system.source})" if system.source else "")
