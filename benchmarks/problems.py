"""The published DAE problems of ``tests/data/problems`` against the solvers a user would try.

Every peer is given more than we are: consistent initial values and derivatives, from the solution
in closed form, and exact Jacobians. Equations become scalar Python or CasADi expressions before
the clock starts. All are held to the same error at the same 21 times.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import (
    Array,
    Failed,
    Prepare,
    Row,
    Solve,
    as_new,
    compare,
    decades,
    loosest,
    say,
    seconds,
)
from gpebo_cli.model.expressions.tape import Tape
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

FOLDER = Path(__file__).parent.parent / "tests" / "data" / "problems"
TARGET = 1e-8
SAMPLES = 21
_TOLERANCES = decades(-5, -13)


@dataclass(frozen=True)
class Problem:
    """One file."""

    name: str
    data: dict[str, Any]

    @property
    def mapping(self) -> dict[str, Any]:
        """The plant as a user would write it."""
        data = self.data
        sizes = {"x": len(data["E"]), "u": len(data["u"]), "y": len(data["C"])}
        names = {key: [f"{key}{i + 1}" for i in range(size)] for key, size in sizes.items()}
        return {
            "name": data["name"], "states": names["x"], "outputs": names["y"],
            "inputs": dict(zip(names["u"], data["u"], strict=True)),
            **{key: data[key] for key in "EABC"}, "initial_state": data["x0"],
        }

    @property
    def t(self) -> Array:
        """Where errors are measured."""
        return np.linspace(*self.data["tspan"], SAMPLES)

    @cached_property
    def symbolic(self) -> dict[str, Any]:
        """E, A and f = B u as SymPy matrices, the solution and its derivative."""
        import sympy as sp

        E, A, B = (sp.Matrix(self.data[key]) for key in "EAB")
        x = sp.Matrix(self.data["solution"])
        return {
            "E": E, "A": A, "f": B * sp.Matrix(self.data["u"]), "x": x,
            "dx": x.diff(sp.Symbol("t")),
        }

    def function(self, *expressions: Any, module: Any = "math") -> Callable[[Any], Any]:
        """SymPy expressions compiled to one Python function of t."""
        import sympy as sp

        return sp.lambdify(sp.Symbol("t"), expressions, module, cse=True)  # type: ignore[no-any-return]

    @cached_property
    def solution(self) -> Array:
        """The exact states at the times (SAMPLES, n)."""
        value = self.function(*self.symbolic["x"])
        return np.array([value(t) for t in self.t])

    def error(self, values: Array) -> float:
        """Largest error of any state at the times."""
        return float(np.abs(values - self.solution).max())

    def start(self) -> tuple[Array, Array]:
        """Consistent x and x' at the start."""
        t0 = float(self.data["tspan"][0])
        return self.solution[0], np.array(self.function(*self.symbolic["dx"])(t0), dtype=float)


def problems() -> list[Problem]:
    """Those with one solution."""
    paths = sorted(FOLDER.glob("*.json"))
    found = [Problem(path.stem, json.loads(path.read_text("utf-8"))) for path in paths]
    return [problem for problem in found if problem.data.get("solution")]


def ours(problem: Problem) -> Prepare:
    """From the plant, parsed, to the states at the times; index and start are found on the way."""
    system = plant_from_mapping(problem.mapping, problem.name)
    start, stop = problem.data["tspan"]
    when, t = TimeSettings(start, stop - start), problem.t

    def prepared(tol: float) -> Solve:
        solver = SolverSettings(tol=tol)
        return lambda: simulate(as_new(system), when, solver).signals.states(t)

    return prepared


# --- peers -----------------------------------------------------------------------------------


def _sparse(matrix: Any) -> list[tuple[int, int, Any]]:
    return [
        (i, j, matrix[i, j])
        for i in range(matrix.rows) for j in range(matrix.cols) if matrix[i, j] != 0
    ]


def residual(problem: Problem) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """F(t, x, x') = E x' − A x − f and (∂F/∂x, ∂F/∂x'), as straight-line Python."""
    import sympy as sp

    s, n = problem.symbolic, len(problem.data["E"])
    x, dx = sp.symbols(f"x:{n}"), sp.symbols(f"dx:{n}")
    F = s["E"] * sp.Matrix(dx) - s["A"] * sp.Matrix(x) - s["f"]
    t = sp.Symbol("t")
    value = sp.lambdify((t, x, dx), list(F), "math", cse=True)
    E = sp.lambdify(t, s["E"].tolist(), "math", cse=True)
    A = sp.lambdify(t, (-s["A"]).tolist(), "math", cse=True)
    return value, lambda t: (np.array(A(t), dtype=float), np.array(E(t), dtype=float))


def sundials_ida(problem: Problem) -> Prepare:
    """scikit-sundae's IDA."""
    from sksundae.ida import IDA

    value, jacobian = residual(problem)
    x0, dx0 = problem.start()
    algebraic = [j for j in range(len(x0)) if all(row[j] == "0" for row in problem.data["E"])]

    def fill(t: float, x: Array, dx: Array, out: Array) -> None:
        out[:] = value(t, x.tolist(), dx.tolist())

    def jac(t: float, _x: Array, _dx: Array, _res: Array, cj: float, out: Array) -> None:
        A, E = jacobian(t)
        out[:] = A + cj * E

    def prepare(tol: float) -> Solve:
        def solve() -> Array:
            solver = IDA(
                fill, rtol=tol, atol=tol, jacfn=jac, max_num_steps=20_000,
                algebraic_idx=algebraic or None,
            )
            done = solver.solve(problem.t, x0, dx0)
            if not done.success:
                raise Failed(f"IDA: {done.message}")
            return np.asarray(done.y)

        return solve

    return prepare


def solve_dae_peer(method: str) -> Callable[[Problem], Prepare]:
    """solve_dae's Radau or BDF."""

    def peer(problem: Problem) -> Prepare:
        from solve_dae.integrate import solve_dae

        value, jacobian = residual(problem)
        x0, dx0 = problem.start()

        def prepare(tol: float) -> Solve:
            def solve() -> Array:
                done = solve_dae(
                    lambda t, x, dx: np.array(value(t, x, dx)), tuple(problem.data["tspan"]),
                    x0, dx0, method=method, t_eval=problem.t, rtol=tol, atol=tol,
                    jac=lambda t, _x, _dx: jacobian(t),
                )
                if not done.success:
                    raise Failed(f"{method}: {done.message}")
                return np.asarray(done.y.T)

            return solve

        return prepare

    return peer


def _casadi_dae(problem: Problem) -> tuple[dict[str, Any], Array, Array, Array, list[int]]:
    """The problem as CasADi's semi-explicit DAE, initial x, x' and z, and where the states stand.

    Where E is constant with at most one entry in each row and column, those states are x and the
    others z. Else x' = v and 0 = E v − A x − f with v among z: the only form that CasADi takes
    without a change of variables by hand.
    """
    import casadi as ca
    import sympy as sp

    s, n = problem.symbolic, len(problem.data["E"])
    x0, dx0 = problem.start()
    t = ca.SX.sym("t")
    modules = [{name: getattr(ca, name) for name in ("sin", "cos", "exp", "sqrt")}, "math"]

    def matrix(expression: Any) -> Any:
        values = sp.lambdify(sp.Symbol("t"), expression.tolist(), modules)(t)
        return ca.vertcat(*[ca.horzcat(*row) for row in values])

    E, A, f = matrix(s["E"]), matrix(s["A"]), matrix(s["f"])
    entries = _sparse(s["E"])
    rows, columns = [i for i, _, _ in entries], [j for _, j, _ in entries]
    x = ca.SX.sym("x", n)
    right = A @ x + f
    if not s["E"].free_symbols and len(set(rows)) == len(rows) == len(set(columns)):
        order = columns + [j for j in range(n) if j not in columns]
        z = [j for j in range(n) if j not in columns]
        dae = {
            "t": t, "x": x[columns], "z": x[z],
            "ode": ca.vertcat(*[right[i] / float(e) for i, _, e in entries]),
            "alg": ca.vertcat(*[right[i] for i in range(n) if i not in rows]),
        }
        return dae, x0[columns], dx0[columns], x0[z], [order.index(j) for j in range(n)]
    v = ca.SX.sym("v", n)
    return {"t": t, "x": x, "z": v, "ode": v, "alg": E @ v - right}, x0, dx0, dx0, list(range(n))


def _casadi(problem: Problem, plugin: str, options: dict[str, Any]) -> Solve:
    import casadi as ca

    dae, x0, dx0, z0, order = _casadi_dae(problem)
    t = problem.t
    if plugin == "idas":
        options = {**options, "init_xdot": dx0.tolist()}
    integrator = ca.integrator("peer", plugin, dae, float(t[0]), list(t[1:]), options)

    def solve() -> Array:
        done = integrator(x0=x0, z0=z0)
        values = np.concatenate([np.array(done["xf"]), np.array(done["zf"])]).T
        return np.vstack([np.concatenate([x0, z0]), values])[:, order]

    return solve


def casadi_idas(problem: Problem) -> Prepare:
    """CasADi's interface to IDAS; initial values are given, so it need not correct them.

    Above index 1 algebraic variables are left out of the error test, as SUNDIALS recommends.
    """

    def prepare(tol: float) -> Solve:
        options = {
            "reltol": tol, "abstol": tol, "calc_ic": False, "max_num_steps": 20_000,
            "suppress_algebraic": problem.data["index"] > 1,
        }
        return _casadi(problem, "idas", options)

    return prepare


def casadi_collocation(problem: Problem) -> Prepare:
    """CasADi's Radau collocation of order 5; ``tol`` is one over the number of elements."""

    def prepare(tol: float) -> Solve:
        options = {
            "number_of_finite_elements": round(1 / tol), "interpolation_order": 5,
            "rootfinder_options": {"error_on_fail": True},
        }
        return _casadi(problem, "collocation", options)

    return prepare


# Reduced by hand: the ODE that is left (names of its states, derivatives) and all states from it.
BY_HAND: dict[str, tuple[str, Sequence[str], Sequence[str]]] = {
    "ascher_petzold_index2": (  # x1 = (2 − t) x2 + (t − 1) e^t, differentiated once for x3
        "b",
        ["9/(2 - t)*x1 - b + 9*x3 + 2*exp(t)"],
        ["x1", "b", "x3"],
    ),
    "berger_ilchmann_hom": ("r", ["r"], ["r*sin(t)", "r*cos(t)", "0"]),
    "brenan_index1": ("a", ["-a + (t + 1)*sin(t) + t*cos(t)"], ["a", "sin(t)"]),
    "daev_cart_pendulum": (
        "a b c d",
        ["c", "d", "(9.81*(b - a) + sin(t))/2", "9.81*(a - b)"],
        ["a", "b", "0", "c", "d", "0", "0"],
    ),
    "daev_rlc": ("a c", ["exp(-2*t) - c - 2*a", "a"], ["a", "exp(-2*t) - c - 2*a", "c", "2*a"]),
    "him_3d_a": ("a", ["-a"], ["a", "(t/2 - 1)*a", "(1 - t/2)*a"]),
    "sciml_two_masses": (
        "a", ["(1 + sin(2*pi*t)/2)/2"], ["a", "a", "sin(2*pi*t)/4 - 0.5", "0.5 - sin(2*pi*t)/4"]
    ),
}
_ASCHER = {  # what the text above abbreviates
    "x1": "((2 - t)*b + (t - 1)*exp(t))",
    "x3": (
        "((t*exp(t) - (3 - t)*exp(t)/(2 - t) + (2 - t)*2*exp(t)"
        " - (1 - 1/(2 - t))*x1 - (3 - t)*b)/(2 - t))"
    ),
}


def by_hand(problem: Problem) -> Prepare:
    """The ODE left after reduction by hand, DOP853."""
    import sympy as sp
    from scipy.integrate import solve_ivp

    names, derivatives, states = BY_HAND[problem.name]
    t, symbols = sp.Symbol("t"), sp.symbols(names, seq=True)
    x1 = sp.sympify(_ASCHER["x1"])
    known = {"x1": x1, "x3": sp.sympify(_ASCHER["x3"], {"x1": x1})}
    derive = sp.lambdify((t, *symbols), [sp.sympify(d, known) for d in derivatives], "math",
                         cse=True)
    recover = sp.lambdify((t, *symbols), [sp.sympify(x, known) for x in states], "numpy", cse=True)
    start = _reduced_start(problem, recover, len(symbols))

    def prepare(tol: float) -> Solve:
        def solve() -> Array:
            done = solve_ivp(
                lambda t, x: derive(t, *x.tolist()), problem.data["tspan"], start,
                method="DOP853", t_eval=problem.t, rtol=max(tol, 1e-13), atol=tol,
            )
            return np.array([x + 0.0 * done.t for x in recover(done.t, *done.y)]).T

        return solve

    return prepare


def _reduced_start(problem: Problem, recover: Callable[..., Any], size: int) -> Array:
    """The initial values of the reduced states: ``recover`` is affine in them."""
    t0 = float(problem.data["tspan"][0])
    offset = np.array(recover(t0, *np.zeros(size)), dtype=float)
    columns = [np.array(recover(t0, *unit), dtype=float) - offset for unit in np.eye(size)]
    return np.linalg.lstsq(np.array(columns).T, problem.solution[0] - offset)[0]


PEERS: dict[str, tuple[Callable[[Problem], Prepare], Sequence[float]]] = {
    "casadi collocation": (casadi_collocation, [1 / (20 * 2**k) for k in range(8)]),
    "casadi idas": (casadi_idas, _TOLERANCES),
    "scikit-sundae IDA": (sundials_ida, _TOLERANCES),
    "solve-dae Radau": (solve_dae_peer("Radau"), _TOLERANCES),
    "solve-dae BDF": (solve_dae_peer("BDF"), _TOLERANCES),
    "reduced by hand, DOP853": (by_hand, _TOLERANCES),
}


def rows() -> list[Row]:
    """Every problem against every peer."""
    table = []
    for problem in problems():
        mine = loosest(ours(problem), decades(-6, -13), problem.error, TARGET)
        for peer, (build, tolerances) in PEERS.items():
            if build is by_hand and problem.name not in BY_HAND:
                continue  # no ODE is left to integrate: the reduction is the solution

            def prepare(tol: float, build: Any = build, problem: Problem = problem) -> Solve:
                return build(problem)(tol)  # type: ignore[no-any-return]  # imports, too

            table.append(
                compare(problem.name, mine, peer, prepare, tolerances, problem.error, TARGET,
                        budget=0.8, patience=4.0)
            )
    return table


def deriving() -> list[dict[str, Any]]:
    """Seconds to read the text of each problem, and to take all derivatives that are needed.

    The latter, at all points of the final mesh at once, are part of the time to solve. The program
    that takes them is recorded once for each order up to μ; ``first`` begins with the text.
    """
    table = []
    for problem in problems():
        say(f"{problem.name}: deriving")
        solve = loosest(ours(problem), decades(-6, -13), problem.error, TARGET)
        system = plant_from_mapping(problem.mapping, problem.name)
        start, stop = problem.data["tspan"]
        tol = solve.tolerance
        result = simulate(system, TimeSettings(start, stop - start), SolverSettings(tol=tol))
        points, order = result.signals.mesh.points.ravel(), result.structure.mu
        tape = system.coefficients.tape  # type: ignore[attr-defined]

        def record(tape: Tape = tape, order: int = order) -> None:
            for k in range(order + 1):
                tape.program(k, apart=tape.jumps)

        def first(problem: Problem = problem, tol: float = tol) -> None:
            ours(problem)(tol)()

        table.append({
            "name": problem.name, "index": result.structure.index, "n": system.n,
            "tolerance": tol, "error": solve.error,
            "reading": seconds(lambda p=problem: plant_from_mapping(p.mapping, p.name), 0.2),  # type: ignore[misc]
            "recording": seconds(record, 0.2),
            "taylor": seconds(lambda s=system, t=points, k=order: s.coefficients.taylor(t, k), 0.2),  # type: ignore[misc]
            "solving": seconds(solve.solve, 0.3),
            "first": seconds(first, 0.3),
            "points": len(points),
        })
    return table
