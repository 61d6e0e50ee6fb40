"""An observer for plants with E = I, without φ, D and H, in open loop.

ξ_a' = A ξ_a + B u,  ξ_b' = A ξ_b + F,  Φ' = A Φ,  x = ξ_a + ξ_b θ − Φ e₀,
Y = y − C ξ_a,  ψ = C [ξ_b, −Φ]
"""

from dataclasses import dataclass

import numpy as np

from gpebo_cli import ConfigError, DescriptorSystem, SolverSettings
from gpebo_cli.observers import (
    AffineStateMap,
    InitialError,
    LinearEquation,
    LinearProblem,
    LinearRegression,
    Measurements,
    Observation,
    Trajectory,
    initial_extension,
    solve,
)

Array = np.ndarray


@dataclass(frozen=True)
class Mine:
    """Attributes are the settings: xi_a0, the start of ξ_a by state."""

    xi_a0: dict[str, float] | None = None

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """The regression and the map to x (n,) from u (m,) and y (r,)."""
        n, q = system.n, system.q
        names = tuple(f"e0_{state}" for state in system.states)
        xi_a0 = initial_extension(self.xi_a0, system, names)
        start = np.concatenate([xi_a0[:, None], np.zeros((n, q)), np.eye(n)], axis=1)

        def equation(t: Array, inside: Array) -> LinearEquation:
            c = system.coefficients.taylor(t, 0, inside)
            if (c.E[0] != np.eye(n)).any() or any(part.any() for part in (c.phi, c.D, c.H)):
                raise ConfigError(f"plant {system.name}: this observer takes E = I, no φ, D or H")
            f = np.zeros((len(t), n, 1 + q + n))
            f[:, :, :1] = c.B[0] @ signals.inputs(t, inside)[:, :, None]
            f[:, :, 1 : 1 + q] = c.F[0]
            return LinearEquation(None, c.A[0], f, (c.C[0], signals.outputs(t, inside)))

        def resolved(values: Array, seen: tuple[Array, ...]) -> list[tuple[Array, float]]:
            C, y = seen
            both = C @ values
            return [(both.reshape(*both.shape[:2], -1), 1e-3), (y, 1e-3)]

        problem = LinearProblem(equation, start, resolved, "mine")
        solution = solve(problem, signals.mesh, tol=solver.tol, max_elements=solver.max_elements)
        mesh, values = solution.trajectory.mesh, solution.trajectory.values
        C, y = solution.extras
        gain = values[..., 1:] * np.where(np.arange(q + n) < q, 1.0, -1.0)  # [ξ_b | −Φ]
        psi = C @ gain
        return Observation(
            regression=LinearRegression(
                Trajectory(mesh, y - (C @ values[..., :1])[..., 0]), Trajectory(mesh, psi),
                (*system.unknowns, *names), np.abs(psi).max(axis=(0, 1, 2)),
            ),
            state_map=AffineStateMap(Trajectory(mesh, values[..., 0]), Trajectory(mesh, gain)),
            truth=InitialError(np.eye(n), xi_a0, np.eye(n), solution.trajectory),
            error_estimate=solution.error_estimate,
            assumptions=(),
            growth=float(np.abs(values[..., 1 + q :]).max()),
        )
