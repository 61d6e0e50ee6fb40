"""RLC ladders of 7 to 1,001 states beside the script that one would write instead.

The script reduces the plant by hand, integrates x (and ξ_a, Φ, ∫ψᵀψ, ∫ψᵀY) by DOP853 at 1e-9 and
solves the normal equations. Where the index is above 1 or resistances lie six decades apart, it is
the faster one of Radau and BDF with sparse Jacobians; for 1,001 states it is BDF. CPU time, the
best of a few calls, one BLAS thread.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.sparse import csr_matrix

from benchmarks.measure import as_new, say
from gpebo_cli import load_plant, run
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

HORIZON, TOL = 20.0, 1e-9
STATES = (7, 11, 17, 25, 41, 101)
FEWER = (11, 25, 41, 101)  # of the kinds whose peers are slow
MANY = 1_001
FEW = 0.5  # seconds, after which a call is not repeated


class Ladder(NamedTuple):
    """E x' = a(t) A x + B sin t, y = C x, and x' = a(t) (M x + g sin t) + h sin t by hand."""

    E: Array
    A: Array
    B: Array
    C: Array
    M: Array
    g: Array
    h: Array
    kept: Array  # which states M is about


def ladder(n: int, kind: str) -> Ladder:
    """States v_1 … v_N, i_1 … i_N and the source's current; see ``KINDS``."""
    cells = (n - 1) // 2
    E, A, B, C = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 1)), np.zeros((2, n))
    E[range(n - 1), range(n - 1)] = 1.0
    for k in range(cells):
        A[k, cells + k], A[cells + k, k] = 1.0, -1.0
        A[cells + k, cells + k] = -(10.0 ** (6.0 * k / cells)) if kind == "stiff" else -0.1
        if k + 1 < cells:
            A[k, cells + k + 1], A[cells + k + 1, k] = -1.0, 1.0
    A[cells - 1, cells - 1] = A[-1, -1] = -1.0
    C[0, -1] = C[1, cells - 1] = 1.0
    kept = np.arange(n - 1)
    if kind in HELD:  # the source's current or voltage is such that some state is u
        held, driven = (cells * at for at in HELD[kind])
        A[-1], A[-1, held], A[driven, -1], B[-1, 0] = 0.0, 1.0, 1.0, -1.0
        kept = np.setdiff1d(np.arange(n - 1), [held, driven])
        return Ladder(
            E, A, B, C, A[np.ix_(kept, kept)], A[kept, held], np.zeros(len(kept)), kept
        )
    A[-1, cells], B[cells, 0] = 1.0, 1.0
    return Ladder(
        E, A, B, C, A[:-1, :-1], np.zeros(n - 1), B[:-1, 0], kept
    )


# Which of v_1 (0) and i_1 (1) is held, and whose equation the source is in: v_1 by a current into
# its node (a loop of capacitors, index 2), i_1 by a voltage (a cutset of inductors, index 2), and
# v_1 by the voltage before i_1 (index 3).
HELD = {"capacitor loop": (0, 0), "inductor cutset": (1, 1), "index 3": (0, 1)}
KINDS = ("index 1", *HELD, "stiff")


def plant(
    given: Ladder, start: Array, *, varying: bool, unlike: bool = False
) -> DescriptorSystem:
    """As a file would have it, by the entries that are not zero; ``unlike``: no two are equal."""
    n = len(given.E)
    states = [f"x{k}" for k in range(n)]

    def entries(matrix: Array, rows: list[str], columns: list[str], by: str = "") -> dict[str, Any]:
        return {
            f"{rows[i]},{columns[j]}": f"{matrix[i, j]}{by.format(k + 1)}" if by else
            float(matrix[i, j]) for k, (i, j) in enumerate(np.argwhere(matrix))
        }

    own = "*(1 + 0.1*sin(t + {0}))" if unlike else ""
    # The factor of an equation 0 = … changes nothing, but stands there as in the others.
    return load_plant({
        "name": "ladder", "states": states, "inputs": {"u": "sin(t)"}, "outputs": ["y1", "y2"],
        "E": entries(given.E, states, states, own), "C": entries(given.C, ["y1", "y2"], states),
        "A": entries(given.A, states, states, own or "*(1 + 0.1*sin(t))" if varying else ""),
        "B": {f"{states[i]},u": f"{v}*(1 + 0.1*sin(t))" if varying and not given.E[i].any() else v
              for i, v in enumerate(given.B[:, 0].tolist()) if v},
        "initial_state": start.tolist(),
    })


def simulation(
    n: int, kind: str, *, varying: bool, unlike: bool = False
) -> Callable[[], Any]:
    """One simulation, with two capacitors loaded."""
    start = np.zeros(n)
    start[1:3] = 1.0
    system = plant(ladder(n, kind), start, varying=varying, unlike=unlike)
    settings = TimeSettings(horizon=HORIZON, samples=101), SolverSettings(tol=TOL)
    return lambda: simulate(as_new(system), *settings)


def by_hand(given: Ladder, start: Array, *, varying: bool, method: str, rtol: float) -> Any:
    """What one would write instead, of the plant alone."""
    M: Any = csr_matrix(given.M) if method != "DOP853" else given.M
    factor = 0.1 * varying

    def f(t: float, x: Array) -> Array:
        a, u = 1.0 + factor * np.sin(t), np.sin(t)
        found: Array = a * (M @ x + given.g * u) + given.h * u
        return found

    more: dict[str, Any] = {}
    if method != "DOP853":
        more["jac"] = lambda t, _x: (1.0 + factor * np.sin(t)) * M
    return solve_ivp(
        f, (0.0, HORIZON), start[given.kept], method=method, rtol=rtol, atol=1e-2 * rtol, **more
    )


def observed_by_hand(given: Ladder, start: Array, *, varying: bool) -> float:
    """The script with the observer: the largest error of e₀."""
    M, n = given.M, len(given.M)
    C = np.zeros((2, n))
    C[0, len(given.E) // 2], C[1, len(given.E) // 2 - 1] = 1.0, 1.0

    def f(t: float, s: Array) -> Array:
        a, drive = 1.0 + 0.1 * varying * np.sin(t), given.h * np.sin(t)
        x, xi, Phi = s[:n], s[n : 2 * n], s[2 * n : 2 * n + n * n].reshape(n, n)
        psi, Y = C @ Phi, C @ (xi - x)
        return np.concatenate([
            a * (M @ x) + drive, a * (M @ xi) + drive, (a * (M @ Phi)).ravel(),
            (psi.T @ psi).ravel(), psi.T @ Y,
        ])

    s0 = np.concatenate([start[:n], np.zeros(n), np.eye(n).ravel(), np.zeros(n * n + n)])
    last = solve_ivp(f, (0.0, HORIZON), s0, method="DOP853", rtol=TOL, atol=1e-12).y[:, -1]
    G = last[2 * n + n * n : 2 * n + 2 * n * n].reshape(n, n)
    eta = np.linalg.solve(G + 1e-12 * np.eye(n), last[-n:])
    return float(np.abs(eta + start[:n]).max())


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds, the best of up to five calls, and what the last one returned."""
    taken: list[float] = []
    found = None
    while len(taken) < 5 and sum(taken) < FEW:
        start = time.process_time()
        found = work()
        taken.append(time.process_time() - start)
    return min(taken), found


def row(n: int, kind: str, *, varying: bool) -> dict[str, Any]:
    """Both simulations, and both experiments for index 1."""
    given, start = ladder(n, kind), np.zeros(n)
    start[1:3] = 1.0
    start[n // 2] = float(kind == "index 3")  # i_1 = v_1' + i_2: there a state must fit
    system = plant(given, start, varying=varying)
    methods = ("BDF",) if n >= MANY else ("DOP853",) if kind == "index 1" else ("Radau", "BDF")
    settings = TimeSettings(horizon=HORIZON, samples=101), SolverSettings(tol=TOL)
    peer, method, theirs = min((
        (seconds, method, found) for method in methods for seconds, found in (_timed(
            lambda: by_hand(given, start, varying=varying, method=method, rtol=TOL)  # noqa: B023
        ),)
    ), key=lambda each: each[0])
    ours, found = _timed(lambda: simulate(as_new(system), *settings))
    exact = simulate(system, settings[0], SolverSettings(tol=1e-12)) if n < MANY else found
    true = exact.signals.states.final[given.kept]
    size = found.signals.states.values.nbytes
    result = {
        "n": n, "kind": kind, "varying": varying, "method": method, "peer": peer, "ours": ours,
        "peer_error": float(np.abs(theirs.y[:, -1] - true).max()),
        "our_error": float(np.abs(found.signals.states.final[given.kept] - true).max()),
        "memory": _peak(lambda: simulate(as_new(system), *settings)) / size,
    }
    if kind == "index 1" and n < MANY:
        def whole() -> Any:
            return run(
                as_new(system), estimator={"name": "least_squares", "f0": 1e-12},
                solver={"tol": TOL}, time={"horizon": HORIZON, "samples": 101},
            )

        peer, error = _timed(lambda: observed_by_hand(given, start, varying=varying))
        ours, experiment = _timed(whole)
        result |= {
            "whole_peer": peer, "whole_ours": ours, "whole_peer_error": error,
            "whole_our_error": experiment.cases[0]["final_error_parameters"],
            "whole_memory": _peak(whole) / (2 * n * size),  # Φ and G are n times as large as x
        }
    return result


def _peak(work: Callable[[], Any]) -> float:
    """The most bytes that are held."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def table() -> list[dict[str, Any]]:
    """All ladders."""
    rows = []
    for kind in KINDS:
        for varying in (False, True):
            for n in (*(STATES if kind == "index 1" else FEWER), MANY):
                say(f"ladder: {kind}, {_kind(varying)}, {n:,} states")
                rows.append(row(n, kind, varying=varying))
    return rows


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Seconds of ladders of index 1 over n, doubly logarithmic."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(8, 3.2), sharey=True, layout="constrained")
    for panel, whole in zip(panels, ("", "whole_"), strict=True):
        for varying in (False, True):
            for who, line in (("peer", ":"), ("ours", "-")):
                shown = [
                    (each["n"], each[whole + who]) for each in rows
                    if each["kind"] == "index 1" and each["varying"] == varying
                    and whole + who in each
                ]
                label = f"{'script' if who == 'peer' else 'gpebo'}, {_kind(varying)}"
                panel.loglog(*np.transpose(shown), f"o{line}", color=f"C{varying:d}", label=label)
        panel.set_xlabel("states")
        panel.set_title("experiment" if whole else "simulation")
        panel.grid(visible=True, alpha=0.3)
    panels[0].set_ylabel("CPU seconds")
    panels[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _kind(varying: bool) -> str:
    return "varying" if varying else "constant"
