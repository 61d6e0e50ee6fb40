"""A plant whose matrices depend on its outputs, linearised along a guess of its solution.

With F(t, x) = A x + B u + F θ + φ at (t, u, y), y = C x + D u + H θ, and a guess x̄ with outputs ȳ,

    E x' = (A + G C) x + B u + (F + G H) θ + φ − G (C x̄ + H θ̄),
    G_j = ∂(A x̄ + B u + F θ̄ + φ)/∂y_j,

everything at (t, u, ȳ): one step of Newton's method for the whole trajectory (quasilinearisation;
Bellman & Kalaba 1965). It is a plant of the paper's class, for which index, consistent start and
solution are found as for any other. Where x = x̄ and θ = θ̄, it says what the plant says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem, IntArray
from gpebo_cli.model.expressions.bounds import switched, with_others
from gpebo_cli.model.expressions.tape import Tape, aside, on_their_side
from gpebo_cli.model.text import TextCoefficients, sided, switching
from gpebo_cli.numerics.linalg import taylor_product
from gpebo_cli.numerics.mesh import Trajectory, signal_scale
from gpebo_cli.reduction.strangeness_free import forcing

# Share of an output by which it is moved to see what depends on it: G is wrong by the square of it
# and by rounding over it. Without derivatives that costs Newton's method nothing that could be
# seen.
_SHIFT = 6e-6
_NOT_ZERO = 1e-3  # of an output's largest value: below it the share is one of this, or of 1e-200
_SAME = 1e-2  # of the longer element beside it: an edge so near to another one is that one
_SHORT = 1e-4  # of the longer element beside it: derivatives on a shorter one are rounding
# Of the states, and of the longer element beside it: a shorter one may have ended at a jump of an
# iterate before the last one, which moves the next one by the square of that.
_FITS, _SHORTER = 1e-10, 0.25
_LARGE = 1e60  # beside it, coefficients of a right side itself are nothing
_NO_MORE = 1e-15  # of a right side: what an output moves it by is rounding up to that


@dataclass(frozen=True, eq=False)
class Linearised:
    """The coefficients of the linearised plant; a ``CoefficientSource``."""

    system: DescriptorSystem
    guess: Trajectory  # x̄ (n,)
    theta: Array | None = None  # θ̄ (q,); None: the true one

    @cached_property
    def _moved(self) -> frozenset[str]:
        no_H = "H" in self.system.coefficients.zero
        return frozenset({"A", "phi"} if no_H else {"A", "F", "phi"})

    @cached_property
    def constant(self) -> frozenset[str]:
        """Those that do not depend on time."""
        return self.system.coefficients.constant - self._moved

    @cached_property
    def zero(self) -> frozenset[str]:
        """Those that vanish."""
        return self.system.coefficients.zero - self._moved

    @cached_property
    def signals(self) -> Mapping[str, frozenset[str]]:
        """Inputs only: the guess says what y is. Without signals u is the plant's own."""
        kept = self.system.coefficients.signals
        of_inputs = frozenset(self.system.inputs) & frozenset[str]().union(*kept.values())
        found = {name: names & of_inputs for name, names in kept.items()}
        found |= dict.fromkeys(self._moved, of_inputs)
        return {name: names for name, names in found.items() if names}

    @property
    def of_time(self) -> Linearised:
        """All of it."""
        return self

    def truth(self, t: Array) -> Array:
        """True values of the unknowns at the times t (N,), shape (N, q)."""
        return self.system.coefficients.truth(t)

    def breakpoints(self, start: float, stop: float) -> Array:
        """Those of functions of time, and where outputs of the guess pass a jump or a kink."""
        found = self.system.coefficients.breakpoints(start, stop)
        inner = self.switched[(self.switched > start) & (self.switched < stop)]
        inner = with_others(np.array([start, stop]), inner)
        # Functions of time are decided well inside of elements, and outputs beside their ends.
        return with_others(inner, found)[1:-1]

    @cached_property
    def switched(self) -> Array:
        """Times (number,) at which outputs of the guess pass a jump or a kink."""
        mesh = self.guess.mesh
        if self._switching is None or mesh.size == 1:
            return np.zeros(0)
        t = mesh.points.ravel()
        return switched(self._switching, t, lambda t, order: self._along(t, order, t)[2])

    @property
    def sided(self) -> tuple[Tape, Tape] | None:
        """Arguments that follow signals, of what jumps and of what switches: those of the plant."""
        source = self.system.coefficients
        return source.sided if isinstance(source, TextCoefficients) else None

    @cached_property
    def _switching(self) -> Tape | None:
        return switching(self.system.coefficients)

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        """Cells for what depends on time alone, from edges (K + 1,); the guess has its own."""
        found, bounded = self.system.coefficients.of_time.resolved(edges)
        if not bounded or len(self.guess.mesh.edges) == 2:
            return found, bounded
        # Where an iterate before passed a jump that this one passes a little later is no edge, and
        # where an even earlier one did, the polynomial of the longer element goes on.
        mesh, k = self.guess.mesh, np.arange(self.guess.mesh.size - 1)
        steps, scale = mesh.steps, signal_scale(self.guess.values)
        long = np.where(steps[:-1] > steps[1:], k, k + 1)
        short = 2 * k + 1 - long
        t, of_long = mesh.points[short], mesh.edges[long] + 0.5 * steps[long]
        goes_on = self.guess(t.ravel(), of_long.repeat(t.shape[1])).reshape(*t.shape, -1)
        apart = np.abs(goes_on - self.guess.values[short]).max(axis=1)
        edge = (apart > _FITS * scale).any(axis=1) | (steps[short] > _SHORTER * steps[long])
        return with_others(found, mesh.edges[1:-1][edge], _SAME * steps[long[edge]]), bounded

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        """Taylor coefficients of the linearised plant at the times t (N,); of signals u counts."""
        source = self.system.coefficients
        known, x, along = self._along(t, order, inside, signals)
        c = source.taylor(t, order, inside, along)
        G = self._slopes(t, inside, known, x, along) if order else None
        G = self._differences(t, inside, known, x, along) if G is None else G
        GC, GH = taylor_product(G, c.C), taylor_product(G, c.H)
        phi = c.phi - taylor_product(GC, x) - taylor_product(GH, known.theta)
        return c._replace(A=c.A + GC, F=c.F + GH, phi=phi, u=known.u)

    def _slopes(
        self, t: Array, inside: Array | None, known: Coefficients, x: Array, along: Array
    ) -> Array | None:
        """G (order + 1, N, n, r), if more derivatives than asked for are known: else None.

        With y_j(τ) + c τ^(k+1), the Taylor coefficients k + 1 to 2k + 1 of a right side are
        those of its derivative to order k, times c: no difference is taken. Rounding of these
        hides the rank of rows that cancel.
        """
        source, orders = self.system.coefficients, len(x)
        if not isinstance(source, TextCoefficients):
            return None
        G = np.empty((*x.shape, self.system.r))
        x, u, theta, along = (
            np.concatenate([v, np.zeros_like(v)]) for v in (x, known.u, known.theta, along)
        )
        for j in range(self.system.r):
            along[orders, :, self.system.m + j] = _LARGE
            try:
                m = source.taylor(t, 2 * orders - 1, inside, along)
            except ConfigError:
                return None
            along[orders, :, self.system.m + j] = 0.0
            f = forcing(m._replace(u=u, theta=theta)) + taylor_product(m.A, x)
            G[..., j] = f[orders:] / _LARGE
        return G

    def _differences(
        self, t: Array, inside: Array | None, known: Coefficients, x: Array, along: Array
    ) -> Array:
        """The same to rounding over a small share of y, and to the square of that."""
        source, order = self.system.coefficients, len(x) - 1
        y = along[0, :, self.system.m :].copy()
        there = t if inside is None else aside(t, inside)
        size = np.abs(y)
        shift = _SHIFT * np.maximum(size, np.maximum(_NOT_ZERO * size.max(axis=0), 1e-200))

        def right_side() -> tuple[Array, Array]:
            """A x̄ + B u + F θ̄ + φ (order + 1, N, n), and which side of a jump y is on (N, ·)."""
            m = source.taylor(t, order, inside, along)
            f = forcing(m._replace(u=known.u, theta=known.theta))
            return f + taylor_product(m.A, x), self._sides(there, along)

        here, side = right_side() if self._switching else (np.zeros(()), np.zeros((len(t), 0)))
        G = np.empty((*x.shape, self.system.r))
        for j in range(self.system.r):
            ends, width = [], np.zeros(len(t))
            for by in (shift[:, j], -shift[:, j]):
                along[0, :, self.system.m + j] = y[:, j] + by
                moved, its_side = right_side()
                same = (its_side == side).all(axis=1)  # a difference does not pass a jump
                ends.append(moved if same.all() else np.where(same[:, None], moved, here))
                width += same * np.abs(by)
            along[0, :, self.system.m + j] = y[:, j]
            apart = ends[0] - ends[1]
            apart[np.abs(apart) <= _NO_MORE * np.abs(ends[0])] = 0.0
            G[..., j] = apart / np.maximum(width, 1e-300)[:, None]
        return G

    def _sides(self, t: Array, along: Array) -> Array:
        """Side of each jump or kink (N, number) where [u; y] (order + 1, N, m + r) is; 0: on it."""
        if self._switching is None:
            return np.zeros((len(t), 0))
        return np.asarray(np.sign(self._switching.taylor(t, 0, None, along[:1])[0]))

    def _along(
        self, t: Array, order: int, inside: Array | None, signals: Array | None = None
    ) -> tuple[Coefficients, Array, Array]:
        """What time says, the guess (order + 1, N, n) and [u; y] along it (order + 1, N, m + r).

        Where something switches, the guess is on its side of that.
        """
        there = on_their_side(
            sided(self.system.coefficients, order), t, inside,
            lambda t, inside: self._seen(t, 0, inside)[2][0],
        )
        known, x, along = self._seen(t, order, inside, signals)
        if there is not t:
            _, x, along = self._seen(there, order, inside, signals)
        return known, x, along

    def _seen(
        self, t: Array, order: int, inside: Array | None, signals: Array | None = None
    ) -> tuple[Coefficients, Array, Array]:
        """As :meth:`_along` at the times t (N,) themselves."""
        known = self.system.coefficients.of_time.taylor(t, order, inside, signals)
        if self.theta is not None:
            known = known._replace(theta=np.zeros((order + 1, len(t), self.system.q)))
            known.theta[0] = self.theta
        x = self.guess.taylor(t, order, inside)
        if order:
            # Derivatives within a very short element are rounding. Those beside it do as well: an
            # error of the guess's derivatives is of second order where its values are right.
            mesh = self.guess.mesh
            k, beside = mesh.sampler(t, inside).element, _beside(mesh.steps)
            some = np.flatnonzero(beside[k] != k)
            if len(some):
                other = beside[k[some]]
                x[1:, some] = self.guess.taylor(
                    mesh.edges[np.maximum(other, k[some])], order,
                    mesh.edges[other] + 0.5 * mesh.steps[other],
                )[1:]
        y = taylor_product(known.C, x) + taylor_product(known.D, known.u)
        y += taylor_product(known.H, known.theta)
        return known, x, np.concatenate([known.u, y], axis=2)


def _beside(steps: Array) -> IntArray:
    """For each element, of lengths (K,), the one whose derivatives tell its own: mostly itself."""
    found = np.arange(len(steps))
    after, before = (steps[:-1] < _SHORT * steps[1:]), (steps[1:] < _SHORT * steps[:-1])
    found[:-1] += after
    found[1:] -= before & (found[1:] == np.arange(1, len(steps)))
    return found


def looked_along(system: DescriptorSystem, known: Trajectory) -> tuple[Array, bool]:
    """Edges of cells in which what follows outputs hides nothing, and whether they are enough.

    ``known`` are inputs and outputs (m + r,); the edges are those of its mesh and more.
    """
    source, mesh = system.coefficients, known.mesh
    if not isinstance(source, TextCoefficients):
        return mesh.edges, True
    return source.along(known.cells, range(system.m, system.m + system.r), mesh.edges)
