"""No remedy: the dynamic extension runs from start to end, w = ξ_a + ξ_b θ − Φ e₀."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.observers._base import AffineStateMap, InitialError, Observation
from gpebo_cli.observers.reduced.extension import Extension, extend
from gpebo_cli.observers.reduced.system import ReducedSystem
from gpebo_cli.regression.errors import respond
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import Reset


@dataclass(frozen=True)
class Plain:
    """The observer as Proposition 1 has it."""

    def observe(self, reduced: ReducedSystem) -> Observation:
        """The regression, and the state from its parameters; perhaps with output injection."""
        extension = extend(reduced, reduced.mesh, reduced.start)
        if reduced.lost is not None:
            for signal in (extension.assembled.offset, extension.assembled.gain):
                signal[:, reduced.lost] = np.nan
        return observation(reduced, extension, *extension.growth(reduced))


def observation(
    reduced: ReducedSystem, extension: Extension, growth: float, logarithm: float,
    resets: Sequence[Reset] = (), later: Sequence[tuple[float, Array, Array]] = (),
) -> Observation:
    """What an extension gives, perhaps of several segments with resets between them.

    ``growth`` is the largest entry of Φ, and ``logarithm`` that of ‖Φ‖ over the horizon, ();
    ``later`` starts are as of :class:`InitialError`.
    """
    system, noise, (start, stop) = reduced.system, reduced.signals.noise, reduced.signals.span
    kept = extension.assembled.kept_rows(system, reduced.regression)
    # Along noisy signals the matrices change, too, and Y is not affine in the noise.
    noisy = np.arange(system.m + system.r) >= system.m  # of a recording, unless levels are said
    if noise is not None and noise.variances.any():
        noisy = noise.variances > 0.0
    errors = None if reduced.form.noise_enters(noisy) else (
        lambda t, inside: reduced.matrices(t, inside).errors(kept, system.m)
    )
    return Observation(
        regression=LinearRegression(
            *extension.rows(kept), parameters=reduced.parameters, scale=extension.scale,
            resets=tuple(resets), units=reduced.parameter_units,
        ),
        state_map=AffineStateMap(*extension.state_map, reduced.form.units.states),
        truth=InitialError(
            reduced.begin.dual, reduced.xi_a0, reduced.first.split.dual, extension.trajectory,
            reduced.units, tuple(later),
        ),
        error_estimate=extension.error_estimate,
        assumptions=reduced.assumptions(extension.weakest),
        growth=growth,
        growth_rate=logarithm / (stop - start),
        errors=errors,
        respond=None if errors is None or resets else (
            lambda e_u, e_y: respond(extension.mesh, errors, len(kept), e_u, e_y)
        ),
        note=reduced.note if reduced.lost is None else "",  # a warning says it
    )
