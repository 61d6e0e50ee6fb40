"""The dynamic extension [ξ_a | ξ_b | Φ] on measured signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.collocation import LinearSolution, solve
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.observers._base import (
    ByName,
    Measurements,
    initial_extension,
    output_scale,
    refuse_beyond,
)
from gpebo_cli.observers._observation import largest_entry, log_norm
from gpebo_cli.observers.reduced.matrices import (
    AlgebraicEquations,
    Injection,
    ObserverMatrices,
    observer_matrices,
    weakest,
)
from gpebo_cli.observers.reduced.regression import Assembled, regression_signals, term_sizes
from gpebo_cli.observers.reduced.split import initial_basis
from gpebo_cli.settings import SolverSettings
from gpebo_cli.simulation import ivp

_LARGEST = 1e60  # entry of the dynamic extension: squares of squares are still numbers


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """w' = A_0 w + b_0 + D_0 θ and 0 = R (𝒜 w + g_y + G θ) on measured signals."""

    system: DescriptorSystem
    signals: Measurements
    solver: SolverSettings
    mesh: Mesh  # where to start integrating
    first: ObserverMatrices  # at the points of the signals' mesh, without injection
    initial_basis: Array  # (n, n_a) V1
    names: tuple[str, ...]  # of e₀'s components
    xi_a0: Array  # (n_a,) where the extension starts, in the coordinates of V1
    regression: str  # projected: all rows of the residual, paper: the last r
    injection: Injection | None = None

    @property
    def basis(self) -> Array:
        """Coordinates in which w is integrated, (n, k): n_a of them, or n if the kernel rotates."""
        return self.first.split.basis

    @property
    def rank(self) -> int:
        """n_a."""
        return int(self.first.split.rank)

    def matrices(self, t: Array, inside: Array) -> ObserverMatrices:
        """At the times t (N,), output injection included."""
        o = observer_matrices(self.system, t, inside, self.solver.rank_tol, self.first)
        return o if self.injection is None else o.injected(self.injection(o, t, inside))

    def start(self, xi_a: Array | None = None, basis: Array | None = None) -> Array:
        """[ξ_a | ξ_b | Φ] = [ξ_a | 0 | V] for ξ_a (n,) and V (n, n_a), shape (k, 1 + q + n_a).

        By default those of the start, V1 ξ_a0 and V1.
        """
        basis = self.initial_basis if basis is None else basis
        xi_a = basis @ self.xi_a0 if xi_a is None else xi_a
        still = np.zeros((len(xi_a), self.system.q))
        return np.asarray(
            self.basis.T @ np.concatenate([xi_a[:, None], still, basis], axis=1)
        )


def reduced_system(
    system: DescriptorSystem,
    signals: Measurements,
    solver: SolverSettings,
    *,
    xi_a0: Mapping[str, float] | list[float] | None = None,
    weights: ByName | None = None,
    regression: str = "projected",
) -> ReducedSystem:
    """The reduced system on measured signals.

    Args:
        system: the model.
        signals: u and y.
        solver: tolerances.
        xi_a0: ``observer.xi_a0``.
        weights: of the outputs, ``observer.weights``.
        regression: which rows of the residual to keep.

    Raises:
        ModelError: rank of E not constant, or Assumption 1 violated.
        ConfigError: no outputs, or a setting that does not fit.
    """
    refuse_beyond(system)
    if system.r == 0:
        raise ConfigError(
            f"plant {system.name}: the observer needs outputs and C; without them use observer=none"
        )
    mesh = signals.mesh
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    first = observer_matrices(
        system, t, inside, solver.rank_tol, normalise=True,
        output_scale=output_scale(weights, system),
    )
    V1, names = initial_basis(first.split.projector[0], first.split.rank, system.states)
    start = initial_extension(xi_a0, system, names)
    return ReducedSystem(system, signals, solver, mesh, first, V1, names, start, regression)


@dataclass(frozen=True, eq=False)
class Extension:
    """The dynamic extension on the mesh that resolves it and everything computed from it."""

    solution: LinearSolution  # [ξ_a | ξ_b | Φ] (k, 1 + q + n_a)
    assembled: Assembled

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return self.solution.trajectory.mesh

    def scale(self, q: int) -> Array:
        """Size of the terms of each column of ψ so far, element by element, (K, p)."""
        trajectory = self.solution.trajectory
        z, *seen = map(_over_time, (trajectory.values, *self.solution.extras))
        sizes = term_sizes(z, q, AlgebraicEquations(*seen))
        largest = sizes.reshape(*trajectory.values.shape[:2], -1).max(axis=1)
        return np.maximum.accumulate(largest, axis=0)

    def growth(self, q: int) -> float:
        """Largest entry of Φ."""
        return largest_entry(self.solution.trajectory.values, 1 + q)

    def logarithm(self, q: int) -> float:
        """ln ‖Φ(end)‖₂, which is 0 at the start."""
        return log_norm(self.solution.trajectory.final[:, 1 + q :])


def extend(reduced: ReducedSystem, mesh: Mesh, start: Array) -> Extension:
    """Integrate [ξ_a | ξ_b | Φ] from ``start`` (k, 1 + q + n_a) over ``mesh``, refined.

    Raises:
        ModelError: rank of E not constant, Assumption 1 violated.
        SolverError: the tolerance cannot be reached, or the extension grows beyond all bounds.
    """
    system, solver, basis = reduced.system, reduced.solver, reduced.basis
    q, n_a = system.q, reduced.rank

    def equations(o: ObserverMatrices, u: Array, y: Array) -> LinearEquation:
        f, g_y = _driven(o, u, y, 1 + q + n_a)
        seen = AlgebraicEquations(
            o.on_basis, g_y, o.G, o.range, o.elimination, o.injectivity
        )
        return LinearEquation(None, o.dynamics, f, seen)

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        u, y = reduced.signals.inputs(t, inside), reduced.signals.outputs(t, inside)
        return equations(reduced.matrices(t, inside), u, y)

    latest: list[Assembled] = []

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[tuple[Array, float]]:
        """Everything to resolve; SolverError if the extension is beyond all bounds."""
        if largest_entry(values) > _LARGEST:
            raise SolverError(
                f"the dynamic extension of plant {system.name} grows beyond {_LARGEST:.0e}: A_0 is "
                "unstable; use observer.remedy=output_injection, reset or current_coordinates, or "
                "a shorter time.horizon"
            )
        z, *seen = map(_over_time, (values, *extras))
        assembled = regression_signals(z, q, basis, AlgebraicEquations(*seen))
        latest[:] = [assembled]
        return [
            (signal.reshape(*values.shape[:2], -1), floor) for signal, floor in assembled.kinds()
        ]

    problem = LinearProblem(coefficients, start, monitor, f"observer of plant {system.name}")
    if solver.name == "ivp":
        solution = ivp.solve(problem, mesh, tol=solver.tol, max_elements=solver.max_elements)
    else:
        known = None
        signals = reduced.signals
        if mesh is signals.mesh and reduced.injection is None:
            u, y = _over_time(signals.inputs.values), _over_time(signals.outputs.values)
            known = equations(reduced.first, u, y)
        solution = solve(
            problem, mesh, tol=solver.tol, max_elements=solver.max_elements, known=known
        )
    return Extension(solution, latest[0])


def _driven(o: ObserverMatrices, u: Array, y: Array, columns: int) -> tuple[Array, Array]:
    """[b_0 | D_0 | 0], shape (N, k, columns), and g_y (N, e + r), of u (N, m) and y (N, r)."""
    signals = np.concatenate([u, y], axis=1)[:, :, None]
    f = np.zeros((len(u), o.dynamics.shape[1], columns))
    f[:, :, :1] = o.from_signals @ signals
    f[:, :, 1 : 1 + o.from_unknowns.shape[2]] = o.from_unknowns
    return f, (o.g_signals @ signals)[:, :, 0]


def _over_time(signal: Array) -> Array:
    """Values (K, s + 1, …) one point after the other, (K (s + 1), …)."""
    return signal.reshape(signal.shape[0] * signal.shape[1], *signal.shape[2:])


def assumptions(
    reduced: ReducedSystem, mesh: Mesh, found: Assembled
) -> tuple[Assumption, ...]:
    """Rank of E and Assumption 1, with their evidence at the points of the mesh."""
    smallest, where = weakest(found.injectivity, found.elimination)
    return (
        Assumption(
            "Rank of E", "rank E(t) is constant", True,
            {"rank": reduced.rank, "states": reduced.system.n},
        ),
        Assumption(
            "Assumption 1",
            "impulse observability: [ΠA; C] is injective on the kernel of E(t)",
            True,
            {"smallest_singular_value": smallest, "at": float(mesh.points.ravel()[where])},
        ),
    )
