"""The circuit experiment as one monolithic ODE for scipy, the way a script would do it.

e1 = −V is substituted by hand; what is left are e2 and il, the dynamic extension ξ_a and Φ, the
row-wise Kreisselmeier filters and the gradient law: 2 + 3 + 9 + 9 + 3 + 3 = 29 states.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from gpebo_cli.experiment import run_experiment
from gpebo_cli.result import RunResult
from gpebo_cli.settings import Settings, SolverSettings, TimeSettings
from gpebo_cli.systems.descriptor import Array, DescriptorSystem

RATES = np.array([0.1, 0.2, 0.3])
E0 = np.array([1.0, -1.0, -2.0])
HORIZON = 20.0


def monolith(t: float, x: Array, gamma: float) -> Array:
    """Right-hand side of everything at once."""
    C1, dC1 = 3 + np.cos(t / 3), -np.sin(t / 3) / 3
    C2, dC2 = 2 - np.cos(2 * t), 2 * np.sin(2 * t)
    L, dL = 2 - np.exp(-t), np.exp(-t)
    R1, R2 = -(4 + 2 * np.sin(t)), -(2 + np.sin(t))
    V = 4 * np.cos(2 * t) * np.sin(t / 5)
    dV = -8 * np.sin(2 * t) * np.sin(t / 5) + 0.8 * np.cos(2 * t) * np.cos(t / 5)
    e2, il, xi, Phi = x[0], x[1], x[2:5], x[5:14].reshape(3, 3)
    Omega, calY, eta = x[14:23].reshape(3, 3), x[23:26], x[26:29]
    e1 = -V
    ir1, ir2 = (e1 - e2) / R1, e1 / R2
    iv = -C1 * dV + dC1 * e1 - ir1 + ir2  # (C1 e1)' = ir1 − ir2 + iv
    y = il + iv
    # A_0: ir1 and ir2 from the resistors, iv = y − il
    A0 = np.array([
        [(-dC1 + 1 / R1 - 1 / R2) / C1, -1 / (R1 * C1), -1 / C1],
        [-1 / (R1 * C2), (-dC2 + 1 / R1) / C2, -1 / C2],
        [0.0, 1 / L, -dL / L],
    ])
    d_xi = A0 @ xi + np.array([y / C1, 0.0, 0.0])
    psi, Y = Phi[0], V + xi[0]
    d_Omega = -RATES[:, None] * (Omega - np.outer(psi, psi))
    d_calY = -RATES * (calY - psi * Y)
    delta = np.linalg.det(Omega)
    cofactors = np.array([
        [Omega[1, 1] * Omega[2, 2] - Omega[1, 2] * Omega[2, 1],
         Omega[0, 2] * Omega[2, 1] - Omega[0, 1] * Omega[2, 2],
         Omega[0, 1] * Omega[1, 2] - Omega[0, 2] * Omega[1, 1]],
        [Omega[1, 2] * Omega[2, 0] - Omega[1, 0] * Omega[2, 2],
         Omega[0, 0] * Omega[2, 2] - Omega[0, 2] * Omega[2, 0],
         Omega[0, 2] * Omega[1, 0] - Omega[0, 0] * Omega[1, 2]],
        [Omega[1, 0] * Omega[2, 1] - Omega[1, 1] * Omega[2, 0],
         Omega[0, 1] * Omega[2, 0] - Omega[0, 0] * Omega[2, 1],
         Omega[0, 0] * Omega[1, 1] - Omega[0, 1] * Omega[1, 0]],
    ])
    d_eta = gamma * delta * (cofactors @ calY - delta * eta)
    return np.concatenate([
        [(-dC2 * e2 - il - ir1) / C2, (e2 - dL * il) / L],
        d_xi, (A0 @ Phi).ravel(), d_Omega.ravel(), d_calY, d_eta,
    ])


def scipy_run(method: str, rtol: float, gamma: float = 1e10) -> tuple[float, Array]:
    """Largest error of e2, il at the horizon and of η̂ there, and the solution's last column."""
    x0 = np.concatenate([[1.0, 2.0], [1.0, 0.0, 0.0], np.eye(3).ravel(), np.zeros(15)])
    done = solve_ivp(
        monolith, (0.0, HORIZON), x0, method=method, args=(gamma,), rtol=rtol, atol=rtol * 1e-2
    )
    end = done.y[:, -1]
    return float(np.abs(end[26:29] - E0).max()), end


def ours(system: DescriptorSystem, tol: float, gamma: object = 1e10, samples: int = 2) -> RunResult:
    """The same experiment, numerical part only."""
    settings = Settings(
        plant={},
        estimator={"name": "drem", "gamma": gamma},
        time=TimeSettings(horizon=HORIZON, samples=samples),
        solver=SolverSettings(tol=tol),
    )
    return run_experiment(settings, system)
