"""The dynamic extension [ξ_a | ξ_b | Φ] on measured signals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.collocation import LinearEquation, LinearProblem, LinearSolution, solve
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers.extension import output_scale
from gpebo_cli.observers.observation import largest_entry, log_norm
from gpebo_cli.observers.reduced.matrices import (
    AlgebraicEquations,
    Injection,
    ObserverMatrices,
    observer_matrices,
)
from gpebo_cli.observers.reduced.regression import Assembled, regression_signals
from gpebo_cli.observers.reduced.split import initial_basis
from gpebo_cli.settings import ObserverSettings, SolverSettings
from gpebo_cli.simulation import ivp

_LARGEST = 1e60  # entry of the dynamic extension: squares of squares are still numbers


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """w' = A_0 w + b_0 + D_0 θ and 0 = R (𝒜 w + g_y + G θ) on measured signals."""

    system: DescriptorSystem
    inputs: Trajectory
    outputs: Trajectory
    solver: SolverSettings
    mesh: Mesh  # where to start integrating
    first: ObserverMatrices  # at the points of the signals' mesh, without injection
    initial_basis: Array  # (n, n_a) V1
    names: tuple[str, ...]  # of e₀'s components
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

    def signals(self, t: Array, inside: Array) -> Array:
        """[u; y] at the times t (N,), shape (N, m + r, 1)."""
        both = np.concatenate([self.inputs(t, inside), self.outputs(t, inside)], axis=1)
        return both[:, :, None]

    def start(self, xi_a: Array, basis: Array) -> Array:
        """[ξ_a | ξ_b | Φ] = [ξ_a | 0 | V] for ξ_a (n,) and V (n, n_a), shape (k, 1 + q + n_a)."""
        still = np.zeros((len(xi_a), self.system.q))
        return np.asarray(
            self.basis.T @ np.concatenate([xi_a[:, None], still, basis], axis=1)
        )


def reduced_system(
    system: DescriptorSystem,
    inputs: Trajectory,
    outputs: Trajectory,
    settings: ObserverSettings,
    solver: SolverSettings,
) -> ReducedSystem:
    """The reduced system on the signals u (m,) and y (r,), which share a mesh.

    Args:
        system: the model.
        inputs: u (m,) and
        outputs: y (r,), on the same mesh.
        settings: the weights of the outputs.
        solver: tolerances.

    Raises:
        ModelError: rank of E not constant, or Assumption 1 violated.
        ConfigError: no outputs.
    """
    if system.r == 0:
        raise ConfigError(
            f"plant {system.name}: the observer needs outputs and C; without them use observer=none"
        )
    mesh = inputs.mesh
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    first = observer_matrices(
        system, t, inside, solver.rank_tol, normalise=True,
        output_scale=output_scale(settings, system),
    )
    V1, names = initial_basis(first.split.projector[0], first.split.rank, system.states)
    return ReducedSystem(system, inputs, outputs, solver, mesh, first, V1, names)


@dataclass(frozen=True, eq=False)
class Extension:
    """The dynamic extension on the mesh that resolves it and everything computed from it."""

    solution: LinearSolution  # [ξ_a | ξ_b | Φ] (k, 1 + q + n_a)
    assembled: Assembled

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return self.solution.trajectory.mesh

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
        u, y = reduced.inputs(t, inside), reduced.outputs(t, inside)
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
        if mesh is reduced.inputs.mesh and reduced.injection is None:
            u, y = _over_time(reduced.inputs.values), _over_time(reduced.outputs.values)
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
