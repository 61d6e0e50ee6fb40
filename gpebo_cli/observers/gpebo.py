"""The GPEBO observer for any E(t) of constant rank: Y = ψη and x = offset + gain η.

The equations are those of :mod:`gpebo_cli.observers.reduced`.
"""

from __future__ import annotations

from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers.extension import initial_extension
from gpebo_cli.observers.observation import AffineStateMap, InitialError, Observation
from gpebo_cli.observers.reduced.extension import ReducedSystem, extend, reduced_system
from gpebo_cli.observers.reduced.matrices import weakest
from gpebo_cli.observers.reduced.regression import Assembled, on_mesh
from gpebo_cli.observers.reduced.response import respond
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import ObserverSettings, SolverSettings


def observe(
    system: DescriptorSystem,
    inputs: Trajectory,
    outputs: Trajectory,
    settings: ObserverSettings,
    solver: SolverSettings,
) -> Observation:
    """Run the dynamic extension on the signals u and y and form the regression.

    Args:
        system: the model; its ``theta`` and ``initial_state`` are not used.
        inputs: u (m,) and
        outputs: y (r,), on the same mesh.
        settings: ξ_a(start) and which rows of the residual to keep.
        solver: tolerance and limits.

    Raises:
        ModelError: rank of E not constant, Assumption 1 violated, no outputs.
        ConfigError: ``xi_a0`` does not fit.
        SolverError: the tolerance cannot be reached.
    """
    return observe_reduced(reduced_system(system, inputs, outputs, settings, solver), settings)


def observe_reduced(reduced: ReducedSystem, settings: ObserverSettings) -> Observation:
    """:func:`observe` for a reduced system, perhaps with output injection."""
    system, q, V1 = reduced.system, reduced.system.q, reduced.initial_basis
    xi_a0 = initial_extension(settings, system, reduced.names)
    extension = extend(reduced, reduced.mesh, reduced.start(V1 @ xi_a0, V1))
    mesh, final = extension.mesh, extension.assembled
    kept = final.kept_rows(system, settings.regression)
    all_kept = len(kept) == final.Y.shape[1]
    return Observation(
        regression=LinearRegression(
            Y=on_mesh(mesh, final.Y if all_kept else final.Y[:, kept]),
            psi=on_mesh(mesh, final.psi if all_kept else final.psi[:, kept]),
            parameters=(*system.unknowns, *reduced.names),
            scale=final.psi_scale,
        ),
        state_map=AffineStateMap(on_mesh(mesh, final.offset), on_mesh(mesh, final.gain)),
        truth=InitialError(V1, xi_a0, reduced.basis, extension.solution.trajectory),
        error_estimate=extension.solution.error_estimate,
        assumptions=assumptions(reduced, mesh, final),
        growth=extension.growth(q),
        growth_rate=extension.logarithm(q) / float(mesh.edges[-1] - mesh.edges[0]),
        respond=lambda e_u, e_y: respond(mesh, reduced.matrices, kept, e_u, e_y),
    )


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
