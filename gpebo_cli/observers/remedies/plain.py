"""No remedy: the dynamic extension runs from start to end, w = ξ_a + ξ_b θ − Φ e₀."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.observers._observation import AffineStateMap, InitialError, Observation
from gpebo_cli.observers.reduced.extension import ReducedSystem, assumptions, extend
from gpebo_cli.observers.reduced.response import errors_of, noisy_matrices, respond
from gpebo_cli.regression.linear import LinearRegression


@dataclass(frozen=True)
class Plain:
    """The observer as Proposition 1 has it."""

    def observe(self, reduced: ReducedSystem) -> Observation:
        """The regression, and the state from its parameters; perhaps with output injection.

        Raises:
            ModelError: rank of E not constant, Assumption 1 violated.
            SolverError: the tolerance cannot be reached.
        """
        system, q = reduced.system, reduced.system.q
        extension = extend(reduced, reduced.mesh, reduced.start())
        mesh, final = extension.mesh, extension.assembled
        if reduced.lost is not None:
            final.offset[:, reduced.lost] = final.gain[:, reduced.lost] = np.nan
        kept = final.kept_rows(system, reduced.regression)
        all_kept = len(kept) == final.Y.shape[1]
        start, stop = reduced.signals.span
        growth, logarithm = extension.growth(q)
        # Along noisy signals the matrices change, too, and Y is not affine in the noise.
        errors = None if noisy_matrices(reduced) else errors_of(reduced, kept)
        return Observation(
            regression=LinearRegression(
                Y=mesh.trajectory(final.Y if all_kept else final.Y[:, kept]),
                psi=mesh.trajectory(final.psi if all_kept else final.psi[:, kept]),
                parameters=(*system.unknowns, *reduced.begin.names),
                scale=extension.scale,
            ),
            state_map=AffineStateMap(
                mesh.trajectory(final.offset), mesh.trajectory(final.gain),
                reduced.form.units.states,
            ),
            truth=InitialError(
                reduced.begin.dual, reduced.xi_a0, reduced.first.split.dual,
                extension.trajectory, reduced.units,
            ),
            error_estimate=extension.error_estimate,
            assumptions=assumptions(reduced, extension.weakest),
            growth=growth,
            growth_rate=logarithm / (stop - start),
            errors=errors,
            respond=None if errors is None else (
                lambda e_u, e_y: respond(mesh, errors, len(kept), e_u, e_y)
            ),
            note=reduced.note if reduced.lost is None else "",  # a warning says it
        )
