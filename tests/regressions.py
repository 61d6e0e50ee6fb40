"""Regressions with known answers, and independent integrations of every estimator's ODEs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from gpebo_cli.regression.linear import LinearRegression

Row = Callable[[np.ndarray], np.ndarray]  # times (…) -> ψ (…, p)


def regression(
    psi: Row, eta: np.ndarray, horizon: float = 10.0, elements: int = 80,
    disturbance: Callable[[np.ndarray], np.ndarray] | None = None,
) -> LinearRegression:
    """One-row regression Y = ψη (+ disturbance) on a uniform mesh."""
    def Y(t: np.ndarray) -> np.ndarray:
        return (psi(t) @ eta + (0.0 if disturbance is None else disturbance(t)))[..., None]

    names = [f"p{i + 1}" for i in range(len(eta))]
    return LinearRegression.from_functions(
        lambda t: psi(t)[..., None, :], Y, names, horizon, elements
    )


def three(t: np.ndarray) -> np.ndarray:
    """A persistently exciting regressor with three parameters."""
    t = np.asarray(t)
    return np.stack([np.ones_like(t), np.sin(t), np.cos(1.7 * t)], axis=-1)


def fading(t: np.ndarray) -> np.ndarray:
    """Exciting until about t = 3, then gone: IE, not PE."""
    return three(t) * np.exp(-np.asarray(t)[..., None] ** 4 / 40.0)


ETA = np.array([1.0, -2.0, 0.5])


def integrate(f: Callable[[float, np.ndarray], np.ndarray], x0: np.ndarray, t: np.ndarray):
    """DOP853 at rtol 1e-11, sampled at t; shape (M, len(x0))."""
    result = solve_ivp(
        f, (t[0], t[-1]), x0, method="DOP853", rtol=1e-11, atol=1e-13, t_eval=t
    )
    assert result.success
    return result.y.T


def adjugate(omega: np.ndarray) -> np.ndarray:
    """By cofactors."""
    p = len(omega)
    if p == 1:
        return np.ones((1, 1))
    return np.array([
        [(-1) ** (i + j) * np.linalg.det(np.delete(np.delete(omega, j, 0), i, 1))
         for j in range(p)]
        for i in range(p)
    ])
