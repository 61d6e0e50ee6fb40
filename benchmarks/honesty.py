"""Is the error estimate honest? Manufactured systems whose solution is known.

    E = R P(t) diag(I, N) Q(t) S⁻¹,    A = R P(t) (diag(Λ, I) Q − diag(I, N) Q') S⁻¹,    x = S Q⊤ z

with rotations P and Q, constant scalings R and S, a nilpotent N of index ν, and z in closed form.
``python -m benchmarks.honesty [FAMILY…] [--seeds 20]`` writes ``docs/honesty.md``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from math import factorial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import ModelError, SolverError
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate

PAGE = Path(__file__).parent.parent / "docs" / "honesty.md"
TOLERANCE = 1e-9
_TIMES = 1501  # at which the solution is compared with the truth

Random = np.random.Generator
Jet = Callable[[Array, int], Array]  # (times (N,), order K) -> Taylor coefficients (K + 1, N)


class Case(NamedTuple):
    """A system, its solution and what it was made of."""

    system: DescriptorSystem
    horizon: float
    exact: Callable[[Array], Array]  # times (N,) -> states (N, n)
    what: str


# --- Taylor coefficients -----------------------------------------------------------------------


def wave(size: float, rate: complex, phase: float) -> Jet:
    """``size`` Re exp(rate t + i phase)."""

    def jet(t: Array, order: int) -> Array:
        value = size * np.exp(rate * t + 1j * phase)
        return np.array([(value * rate**k).real / factorial(k) for k in range(order + 1)])

    return jet


def pulse(size: float, centre: float, width: float) -> Jet:
    """``size`` / (1 + ((t − centre)/width)²)."""

    def jet(t: Array, order: int) -> Array:
        value = size / (1.0 - 1j * (t - centre) / width)  # the wanted one is its real part
        factor = 1j / width / (1.0 - 1j * (t - centre) / width)
        return np.array([(value * factor**k).real for k in range(order + 1)])

    return jet


def product(a: Array, b: Array) -> Array:
    """Of matrices of Taylor coefficients (K + 1, N, i, j) and (K + 1, N, j, k)."""
    return np.array([sum(a[i] @ b[k - i] for i in range(k + 1)) for k in range(len(a))])


def slope(a: Array) -> Array:
    """Of the derivative, one order less."""
    return a[1:] * np.arange(1, len(a)).reshape(-1, *[1] * (a.ndim - 1))


def rotation(n: int, rng: Random, speed: float, among: Array | None = None) -> Jet:
    """Matrices (K + 1, N, n, n) of a product of plane rotations with constant speeds.

    Only the coordinates ``among`` those that are given are turned, all by default.
    """
    turned = np.arange(n) if among is None else among
    planes = [
        (*rng.choice(turned, 2, replace=False), rng.uniform(-speed, speed), rng.uniform(0, 6.3))
        for _ in range(len(turned) if len(turned) > 1 else 0)
    ]

    def jet(t: Array, order: int) -> Array:
        whole = np.zeros((order + 1, len(t), n, n))
        whole[0] = np.eye(n)
        for i, j, rate, phase in planes:
            cosine = wave(1.0, 1j * rate, phase)(t, order)[..., None]
            sine = wave(1.0, 1j * rate, phase - np.pi / 2)(t, order)[..., None]
            first, second = whole[..., i].copy(), whole[..., j].copy()

            def times(a: Array, b: Array) -> Array:
                return product(a[..., None], b[..., None])[..., 0]

            whole[..., i] = times(first, cosine) + times(second, sine)
            whole[..., j] = times(second, cosine) - times(first, sine)
        return whole

    return jet


# --- systems -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Manufactured:
    """The coefficients of a manufactured system, see the head of this module."""

    P: Jet
    Q: Jet
    nilpotent: Array  # (n, n) diag(I, N)
    dynamics: Array  # (n, n) diag(Λ, I)
    solution: tuple[Jet, ...]  # z
    rows: Array
    columns: Array
    still: bool

    @property
    def constant(self) -> frozenset[str]:
        """What does not depend on time."""
        return frozenset({"B", "C"} | self.zero | ({"E", "A"} if self.still else set()))

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        """No bounds between the nodes."""
        return edges, False

    def breakpoints(self, start: float, stop: float) -> Array:  # noqa: ARG002
        """None."""
        return np.zeros(0)

    def states(self, t: Array) -> Array:
        """x (N, n)."""
        return self.columns * (np.swapaxes(self.Q(t, 0)[0], 1, 2) @ self._z(t, 0)[0])[..., 0]

    def _z(self, t: Array, order: int) -> Array:
        return np.stack([jet(t, order) for jet in self.solution], axis=2)[..., None]

    @property
    def zero(self) -> frozenset[str]:
        """What vanishes."""
        return frozenset({"F", "theta", "phi", "D", "H"})

    @property
    def signals(self) -> dict[str, frozenset[str]]:
        """No matrix depends on one."""
        return {}

    def truth(self, t: Array) -> Array:
        """No unknowns."""
        return np.zeros((len(t), 0))

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None  # noqa: ARG002
    ) -> Coefficients:
        """See :class:`gpebo_cli.model.descriptor.CoefficientSource`."""
        n = len(self.rows)
        P, Q, z = self.P(t, order), self.Q(t, order + 1), self._z(t, order + 1)
        weight = self.rows[:, None] / self.columns
        E = product(P, self.nilpotent @ Q[:-1]) * weight
        A = product(P, self.dynamics @ Q[:-1] - self.nilpotent @ slope(Q)) * weight
        f = product(P, self.nilpotent @ slope(z) - self.dynamics @ z[:-1])[..., 0] * self.rows
        identity = np.zeros((order + 1, len(t), n, n))
        identity[0] = np.eye(n)
        zero = np.zeros_like(E)
        nothing = zero[..., :0]
        return Coefficients(
            E, A, identity, nothing, identity, f, nothing[..., 0, :], zero[..., 0], zero, nothing
        )


def canonical(rng: Random, n: int, nu: int, dynamics: Array) -> tuple[Array, Array]:
    """diag(I, N) and diag(Λ, I): as many differential states as Λ has, N of index ν."""
    d = len(dynamics)
    nilpotent, rates = np.zeros((n, n)), np.eye(n)
    nilpotent[:d, :d], rates[:d, :d] = np.eye(d), dynamics
    left, first = n - d, d
    while left:
        block = min(left, nu if first == d else int(rng.integers(1, nu + 1)))
        for k in range(first, first + block - 1):
            nilpotent[k + 1, k] = 1.0
        first, left = first + block, left - block
    return nilpotent, rates


def made(
    rng: Random, n: int, nu: int, *, dynamics: Array | None = None, horizon: float = 5.0,
    solution: list[Jet] | None = None, scale: float = 0.0, speed: float = 1.0, what: str = "",
) -> Case:
    """A manufactured case; Λ and z are moderate where not given."""
    n = max(n, nu + (dynamics is not None) * len(dynamics if dynamics is not None else []))
    if dynamics is None:
        d = n if nu == 0 else int(rng.integers(0 if n == nu else 1, n - nu + 1))
        dynamics = rng.normal(size=(d, d)) / np.sqrt(max(d, 1)) - np.eye(d)
    if nu == 0:
        n = len(dynamics)
    waves = [
        wave(rng.uniform(0.5, 2), -rng.uniform(0, 2 / horizon) + 1j * rng.uniform(0.3, 2),
             rng.uniform(0, 6.3))
        for _ in range(n)
    ]
    z = (solution or []) + waves[len(solution or []):]
    still = bool(rng.random() < 0.25)  # constant coefficients
    speed = 0.0 if still else speed
    rows, columns = 10.0 ** rng.uniform(-scale, scale, n), 10.0 ** rng.uniform(-scale, scale, n)
    source = Manufactured(
        rotation(n, rng, speed), rotation(n, rng, speed), *canonical(rng, n, nu, dynamics),
        tuple(z[:n]), rows, columns, still,
    )
    names = tuple(f"x{i + 1}" for i in range(n))
    system = DescriptorSystem(
        "manufactured", names, source, source.states(np.zeros(1))[0],
        inputs=tuple(f"u{i + 1}" for i in range(n)), outputs=names,
    )
    return Case(system, horizon, source.states, f"n={n} index={nu}{' still' * still} {what}")


def _sizes(rng: Random, most: int = 12) -> tuple[int, int]:
    nu = int(rng.integers(0, 6))
    return int(rng.integers(max(nu, 1), max(most, nu + 1) + 1)), nu


def smooth(rng: Random) -> Case:
    """Up to 12 states."""
    return made(rng, *_sizes(rng))


def large(rng: Random) -> Case:
    """13 to 30 states, index up to 3."""
    return made(rng, int(rng.integers(13, 31)), int(rng.integers(0, 4)))


def sharp(rng: Random) -> Case:
    """A pulse of width 0.3 … 0.01 in one coordinate."""
    n, nu = _sizes(rng, 8)
    width = 10.0 ** rng.uniform(-2, -0.5)
    return made(rng, n, min(nu, 3), solution=[pulse(1.0, rng.uniform(1, 4), width)],
                what=f"width={width:.2g}")


def stiff(rng: Random) -> Case:
    """One mode of rate 1 … 1e8."""
    n, nu = _sizes(rng, 8)
    rate = 10.0 ** rng.uniform(0, 8)
    d = int(rng.integers(1, 4))
    dynamics = np.diag([-rate, *(-rng.uniform(0.1, 2, d - 1))])
    return made(rng, n, min(nu, 4), dynamics=dynamics, what=f"rate={rate:.2g}")


def scaled(rng: Random) -> Case:
    """Rows and states in units of 1e±9."""
    n, nu = _sizes(rng, 8)
    return made(rng, n, min(nu, 4), scale=9.0)


def growing(rng: Random) -> Case:
    """A mode that grows, or decays, by e^25 over the horizon."""
    n, nu = _sizes(rng, 8)
    horizon = 10.0 ** rng.uniform(0, 1.3)
    rate = rng.uniform(5, 25) / horizon * rng.choice([-1, 1])
    alive = [wave(1.0, rate, 0.0)] if rng.random() < 0.5 else []
    return made(rng, n, min(nu, 4), dynamics=np.diag([rate, -1.0]), horizon=horizon,
                solution=alive, what=f"rate={rate:.2g} horizon={horizon:.2g}")


def oscillating(rng: Random) -> Case:
    """A mode that swings with 1 … 1e3 rad/s over 20 s."""
    nu = int(rng.integers(0, 4))
    omega = 10.0 ** rng.uniform(0, 3)
    dynamics = np.array([[0.0, omega], [-omega, 0.0]])
    swing = [wave(1.0, 1j * omega, 0.0), wave(1.0, 1j * omega, np.pi / 2)]
    return made(rng, 2 + nu, nu, dynamics=dynamics, solution=swing, horizon=20.0,
                what=f"omega={omega:.3g}")


def long(rng: Random) -> Case:
    """200 to 2,000 s."""
    n, nu = _sizes(rng, 4)
    horizon = 10.0 ** rng.uniform(2.3, 3.3)
    return made(rng, n, min(nu, 2), horizon=horizon, what=f"horizon={horizon:.3g}")


def pulsed(rng: Random) -> Case:
    """x' = u with u one of two values, switched by the sign of a wave: duty 1e-3 … 0.5."""
    omega, duty = 10.0 ** rng.uniform(0, 2), 10.0 ** rng.uniform(-3, -0.3)
    system = plant_from_mapping({
        "name": "pulsed", "states": ["x"], "E": [[1]], "A": [[0]], "B": [[1]],
        "inputs": {"u": f"(1 + sign(cos({omega!r}*t) - cos(pi*{duty!r})))/(2*{duty!r})"},
        "initial_state": [0],
    })

    def exact(t: Array) -> Array:
        turns, part = np.divmod(omega * t / (2 * np.pi) + 0.5, 1.0)
        inside = np.clip(part - 0.5 + duty / 2, 0.0, duty)
        return ((turns * duty + inside - duty / 2) / duty * 2 * np.pi / omega)[:, None]

    return Case(system, 20.0, exact, f"omega={omega:.3g} duty={duty:.3g}")


FAMILIES: dict[str, Callable[[Random], Case]] = {
    maker.__name__: maker
    for maker in (smooth, large, sharp, stiff, scaled, growing, oscillating, long, pulsed)
}


# --- measurement -------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came of one case."""

    what: str
    seconds: float
    refused: str
    error: float  # largest over the states, relative to each one's own size
    ratio: float  # largest error over estimate, state by state


def case_of(family: str, seed: int) -> Case:
    """One of a family; a seed means the same case at any time."""
    return FAMILIES[family](np.random.default_rng([list(FAMILIES).index(family), seed]))


def measure(case: Case) -> Outcome:
    """Simulate a case and compare it with the truth."""
    before = time.process_time()
    try:
        result = simulate(
            case.system, TimeSettings(horizon=case.horizon), SolverSettings(tol=TOLERANCE)
        )
    except (ModelError, SolverError) as refusal:
        return Outcome(case.what, time.process_time() - before, str(refusal), 0.0, 0.0)
    seconds = time.process_time() - before
    times = np.linspace(0.0, case.horizon, _TIMES)
    truth = case.exact(times)
    error = np.abs(result.signals.states(times) - truth).max(axis=0) / np.abs(truth).max(axis=0)
    # What the truth itself cannot be known better than.
    rounding = 4 * np.finfo(float).eps
    ratio = float((np.maximum(error - rounding, 0.0) / result.state_errors).max())
    return Outcome(case.what, seconds, "", float(error.max()), ratio)


def outcomes(family: str, seeds: range) -> list[Outcome]:
    """Of one family."""
    return [measure(case_of(family, seed)) for seed in seeds]


def row(family: str, found: list[Outcome]) -> list[str]:
    """One line of the table."""
    solved = [one for one in found if not one.refused]
    worst = max((one.ratio for one in solved), default=0.0)
    return [
        family, str(len(solved)), str(len(found) - len(solved)),
        str(sum(one.ratio > 10 for one in solved)), str(sum(one.ratio > 100 for one in solved)),
        f"{worst:.2g}", str(sum(one.error > 1e3 * TOLERANCE for one in solved)),
        f"{max((one.error for one in solved), default=0.0):.1e}",
        f"{max(one.seconds for one in found):.2f}",
    ]


HEAD = ("family", "solved", "refused", "over 10 x", "over 100 x", "worst", "error over 1e-6",
        "largest error", "slowest, s")


def page(rows: dict[str, list[str]], seeds: int) -> str:
    """``docs/honesty.md``."""
    from benchmarks.page import table

    families = "\n".join(f"* **{name}**: {FAMILIES[name].__doc__}" for name in rows)
    return (
        "# Honest by measurement\n\nMade by `python -m benchmarks.honesty`; not edited by hand. "
        f"{seeds} manufactured systems of each family, whose solution is known, at "
        f"`solver.tol={TOLERANCE:g}`: rotating rows and states, index 0 to 5, a quarter of them "
        "with constant coefficients. The error of each state relative to its own size is "
        "compared with its estimate: an error of more than 10 or 100 times the estimate counts "
        "as dishonest. Seconds are CPU time.\n\n"
        f"{table(HEAD, rows.values())}\n\n{families}\n"
    )


def main(words: list[str]) -> int:
    """Measure families and write the page, if all of them are."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.honesty")
    parser.add_argument("families", nargs="*", metavar="FAMILY", help=", ".join(FAMILIES))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--worst", type=int, default=0, help="cases to name, of each family")
    chosen = parser.parse_args(words)
    rows = {}
    for family in chosen.families or FAMILIES:
        found = outcomes(family, range(chosen.seeds))
        rows[family] = row(family, found)
        sys.stdout.write("  ".join(rows[family]) + "\n")
        by_ratio = sorted(enumerate(found), key=lambda one: -one[1].ratio)[: chosen.worst]
        for seed, one in [*by_ratio, *((k, o) for k, o in enumerate(found) if o.refused)]:
            if chosen.worst:
                sys.stdout.write(f"    {seed}: {one.what} error {one.error:.1e} ratio "
                                 f"{one.ratio:.2g} {one.seconds:.2f} s {one.refused}\n")
    if not chosen.families:
        PAGE.write_text(page(rows, chosen.seeds), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
