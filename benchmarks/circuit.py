"""The circuit experiment against one monolithic ODE, the way a script would do it.

e1 = −V is substituted by hand; what is left are e2 and il, the dynamic extension ξ_a and Φ, the
row-wise Kreisselmeier filters and the gradient law: 2 + 3 + 9 + 9 + 3 + 3 = 29 states. Two
right-hand sides: a script's, with matrices built at every call (jax compiles the same lines), and
one without arrays, every product with a zero left out.

Truth are values of another method and another code (``tests/data/reference``), at eleven times;
that of η̂ is (1 − exp(−γ ∫Δ²)) e0, with that code's ∫Δ².
"""

from __future__ import annotations

import json
from functools import cache, partial
from math import cos, exp, sin
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Array, Prepare, Row, Solve, as_new, compare, decades, loosest
from gpebo_cli import load_plant
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.settings import Settings, SolverSettings, TimeSettings

ROOT = Path(__file__).parent.parent
RATES = np.array([0.1, 0.2, 0.3])
GAMMA = 1e10
HORIZON = 20.0
TARGET = 1e-9
STATES = 29
SCIPY = ("LSODA", "BDF", "Radau")
OURS = decades(-4, -13)
PEERS = decades(-7, -13)
_GRID = 41  # samples of ours; the reference's times are among them


@cache
def _reference() -> tuple[Array, Array, Array, Array]:
    """Times, e2 and il there, ∫Δ² there, e0."""
    path = ROOT / "tests" / "data" / "reference" / "circuit.json"
    data = json.loads(path.read_text("utf-8"))
    t = np.array([row["t"] for row in data["at"]])
    states = np.array([row["x"][1:3] for row in data["at"]])
    integral = np.array([row["integral_delta_squared_rows"] for row in data["at"]])
    return t, states, integral, np.array(data["e0"])


def truth(gamma: float = GAMMA) -> Array:
    """e2, il and η̂ at the reference's times, shape (T, 5)."""
    _, states, integral, e0 = _reference()
    eta = -np.expm1(-gamma * integral)[:, None] * e0
    return np.concatenate([states, eta], axis=1)


def error(values: Array) -> float:
    """Largest error of e2, il and η̂ over the reference's times."""
    return float(np.abs(values - truth()).max())


def ours(tol: float, gammas: list[float] | None = None) -> Solve:
    """The whole experiment, evidence at the end and metrics included; what it returns is compared.

    What only a reader asks for, such as t_c and the last line, is not computed.
    """
    settings = Settings(
        estimator={"name": "drem", "gamma": gammas or GAMMA},
        time=TimeSettings(horizon=HORIZON, samples=_GRID),
        solver=SolverSettings(tol=tol),
    )
    chosen = np.rint(_reference()[0] / HORIZON * (_GRID - 1)).astype(int)
    system = load_plant("circuit")

    def solve() -> Array:
        result = run_experiment(settings, as_new(system))
        if result.estimation is None:
            raise TypeError("drem estimates")
        states = result.simulation.states[chosen, 1:3]
        eta = np.asarray(result.estimation.parameters)[:, chosen]
        states = np.broadcast_to(states, (len(eta), *states.shape))
        values = np.concatenate([states, eta], axis=2)
        return values if gammas else values[0]

    return solve


def start() -> Array:
    """Initial values of the monolith."""
    return np.concatenate([[1.0, 2.0], [1.0, 0.0, 0.0], np.eye(3).ravel(), np.zeros(15)])


def script(t: Any, x: Any, gamma: Any, xp: Any = np) -> Any:
    """Right-hand side as one writes it down; ``xp`` is NumPy or jax.numpy."""
    C1, dC1 = 3 + xp.cos(t / 3), -xp.sin(t / 3) / 3
    C2, dC2 = 2 - xp.cos(2 * t), 2 * xp.sin(2 * t)
    L, dL = 2 - xp.exp(-t), xp.exp(-t)
    R1, R2 = -(4 + 2 * xp.sin(t)), -(2 + xp.sin(t))
    V = 4 * xp.cos(2 * t) * xp.sin(t / 5)
    dV = -8 * xp.sin(2 * t) * xp.sin(t / 5) + 0.8 * xp.cos(2 * t) * xp.cos(t / 5)
    e2, il, xi, Phi = x[0], x[1], x[2:5], x[5:14].reshape(3, 3)
    Omega, calY, eta = x[14:23].reshape(3, 3), x[23:26], x[26:29]
    e1 = -V
    ir1, ir2 = (e1 - e2) / R1, e1 / R2
    iv = -C1 * dV + dC1 * e1 - ir1 + ir2  # (C1 e1)' = ir1 − ir2 + iv
    y = il + iv
    # A_0: ir1 and ir2 from the resistors, iv = y − il
    A0 = xp.array([
        [(-dC1 + 1 / R1 - 1 / R2) / C1, -1 / (R1 * C1), -1 / C1],
        [-1 / (R1 * C2), (-dC2 + 1 / R1) / C2, -1 / C2],
        [0.0, 1 / L, -dL / L],
    ])
    d_xi = A0 @ xi + xp.array([y / C1, 0.0, 0.0])
    psi, Y = Phi[0], V + xi[0]
    d_Omega = -RATES[:, None] * (Omega - xp.outer(psi, psi))
    d_calY = -RATES * (calY - psi * Y)
    first, second, third = Omega
    adjugate = xp.stack(
        [xp.cross(second, third), xp.cross(third, first), xp.cross(first, second)], axis=1
    )
    delta = first @ adjugate[:, 0]
    d_eta = gamma * delta * (adjugate @ calY - delta * eta)
    return xp.concatenate([
        xp.array([(-dC2 * e2 - il - ir1) / C2, (e2 - dL * il) / L]),
        d_xi, (A0 @ Phi).ravel(), d_Omega.ravel(), d_calY, d_eta,
    ])


def optimised(t: float, x: Array, gamma: float) -> list[float]:
    """The same with numbers only: arrays of three cost more than what is in them."""
    (e2, il, x1, x2, x3, p11, p12, p13, p21, p22, p23, p31, p32, p33,
     o11, o12, o13, o21, o22, o23, o31, o32, o33, y1, y2, y3, n1, n2, n3) = x.tolist()
    s3, c3 = sin(t / 3), cos(t / 3)
    s2, c2 = sin(2 * t), cos(2 * t)
    s5, c5 = sin(t / 5), cos(t / 5)
    s1, dL = sin(t), exp(-t)
    iC1, dC1 = 1 / (3 + c3), -s3 / 3
    iC2, dC2 = 1 / (2 - c2), 2 * s2
    iL = 1 / (2 - dL)
    iR2 = -1 / (2 + s1)
    iR1 = 0.5 * iR2
    V = 4 * c2 * s5
    dV = -8 * s2 * s5 + 0.8 * c2 * c5
    ir1 = (-V - e2) * iR1
    y = il - dV * (3 + c3) - dC1 * V - ir1 - V * iR2
    a11, a12 = (iR1 - iR2 - dC1) * iC1, -iR1 * iC1
    a21, a22 = -iR1 * iC2, (iR1 - dC2) * iC2
    a33 = -dL * iL
    Y = V + x1
    c11, c12, c13 = o22 * o33 - o23 * o32, o13 * o32 - o12 * o33, o12 * o23 - o13 * o22
    c21, c22, c23 = o23 * o31 - o21 * o33, o11 * o33 - o13 * o31, o13 * o21 - o11 * o23
    c31, c32, c33 = o21 * o32 - o22 * o31, o12 * o31 - o11 * o32, o11 * o22 - o12 * o21
    delta = o11 * c11 + o12 * c21 + o13 * c31
    g = gamma * delta
    q11, q12, q13, q22, q23, q33 = p11 * p11, p11 * p12, p11 * p13, p12 * p12, p12 * p13, p13 * p13
    return [
        (-dC2 * e2 - il - ir1) * iC2, (e2 - dL * il) * iL,
        a11 * x1 + a12 * x2 + (y - x3) * iC1, a21 * x1 + a22 * x2 - x3 * iC2, iL * x2 + a33 * x3,
        a11 * p11 + a12 * p21 - iC1 * p31, a11 * p12 + a12 * p22 - iC1 * p32,
        a11 * p13 + a12 * p23 - iC1 * p33,
        a21 * p11 + a22 * p21 - iC2 * p31, a21 * p12 + a22 * p22 - iC2 * p32,
        a21 * p13 + a22 * p23 - iC2 * p33,
        iL * p21 + a33 * p31, iL * p22 + a33 * p32, iL * p23 + a33 * p33,
        -0.1 * (o11 - q11), -0.1 * (o12 - q12), -0.1 * (o13 - q13),
        -0.2 * (o21 - q12), -0.2 * (o22 - q22), -0.2 * (o23 - q23),
        -0.3 * (o31 - q13), -0.3 * (o32 - q23), -0.3 * (o33 - q33),
        -0.1 * (y1 - p11 * Y), -0.2 * (y2 - p12 * Y), -0.3 * (y3 - p13 * Y),
        g * (c11 * y1 + c12 * y2 + c13 * y3 - delta * n1),
        g * (c21 * y1 + c22 * y2 + c23 * y3 - delta * n2),
        g * (c31 * y1 + c32 * y2 + c33 * y3 - delta * n3),
    ]


def scipy_peer(method: str, right: Any, gammas: list[float] | None = None) -> Prepare:
    """``solve_ivp`` on one of the right-hand sides, for each gain anew."""
    from scipy.integrate import solve_ivp

    def prepare(rtol: float) -> Solve:
        t = _reference()[0]

        def one(gamma: float) -> Array:
            done = solve_ivp(
                right, (0.0, HORIZON), start(), method=method, args=(gamma,), t_eval=t,
                rtol=max(rtol, 1e-13), atol=1e-3 * rtol,
            )
            if not done.success:
                raise ArithmeticError(done.message)
            return np.asarray(done.y[[0, 1, 26, 27, 28]].T)

        if gammas is None:
            return lambda: one(GAMMA)
        return lambda: np.array([one(gamma) for gamma in gammas])

    return prepare


class DiffraxPeer:
    """A solver of diffrax on the script's right-hand side, jitted, in double precision.

    With gains the same compiled function is called for each. The first call compiles, for every
    tolerance, and is not timed. Implicit solvers get Newton's
    method with tolerances of its own: with diffrax's default, the controller's tolerances and a
    chord iteration, steps are rejected without end.
    """

    def __init__(self, solver: str, gammas: list[float] | None = None) -> None:
        self.solver, self.gammas = solver, gammas
        self.run: Any = None

    def __call__(self, rtol: float) -> Solve:
        """What to time at ``rtol``."""
        if self.run is None:
            self.run = self._compiled()
        gammas = self.gammas
        if gammas is None:
            return lambda: np.asarray(self.run(rtol, GAMMA))
        return lambda: np.array([self.run(rtol, gamma) for gamma in gammas])

    def _compiled(self) -> Any:
        import jax

        jax.config.update("jax_enable_x64", True)
        import diffrax
        import jax.numpy as jnp
        import optimistix

        kind = getattr(diffrax, self.solver)
        implicit = issubclass(kind, diffrax.AbstractImplicitSolver)
        newton = optimistix.Newton(rtol=1e-6, atol=1e-8)
        solver = kind(root_finder=newton) if implicit else kind()
        term = diffrax.ODETerm(lambda t, x, gamma: script(t, x, gamma, jnp))
        times = diffrax.SaveAt(ts=jnp.array(_reference()[0]))

        def run(rtol: Any, gamma: Any) -> Any:
            done = diffrax.diffeqsolve(
                term, solver, 0.0, HORIZON, None, jnp.array(start()), gamma, saveat=times,
                stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol),
                max_steps=1_000_000, throw=False,
            )
            return done.ys[:, jnp.array([0, 1, 26, 27, 28])]

        compiled = jax.jit(run)
        np.asarray(compiled(1e-3, GAMMA))
        return compiled


def rows() -> list[Row]:
    """One gain, γ = 1e10."""
    mine = loosest(ours, OURS, error, TARGET)
    row = partial(compare, "circuit, γ = 1e10", mine, error=error, target=TARGET, budget=6.0)
    return [
        *(
            row(peer=f"scipy {method}, {how}", prepare=scipy_peer(method, right),
                tolerances=PEERS, patience=40.0)
            for method in SCIPY
            for how, right in (("script", script), ("optimised", optimised))
        ),
        row(peer="diffrax Kvaerno5", prepare=DiffraxPeer("Kvaerno5"), tolerances=PEERS,
            patience=90.0),
        # Explicit: its steps are as small as stability asks, whatever the tolerance.
        row(peer="diffrax Dopri8", prepare=DiffraxPeer("Dopri8"), tolerances=[1e-11],
            patience=90.0),
    ]
