"""Noise in the matrices: they follow a copy of the signals that has no noise.

Along measured signals ψ has the noise of y in it, and least squares is biased (errors in
variables). Here the matrices are evaluated, and linearised, along x̄, the solution that belongs to
the estimates of the moment (:mod:`gpebo_cli.simulation.linearised`):

    ȳ = C x̄ + D u + H θ̄,
    E x' = (A + G C) x + B u + (F + G H) θ + φ − G (C x̄ + H θ̄)

What is measured stands in Y only. ψ is the regressor of a noise-free auxiliary model, as in the
refined instrumental variable method (Young 2011, Recursive Estimation and Time-Series Analysis).
With least squares each round is one step of Gauss and Newton towards the outputs that fit best.
The first x̄ is that of the observer along the measured signals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.errors import GpeboError, SolverError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers._base import AffineStateMap, Observation
from gpebo_cli.observers.reduced.system import ReducedSystem, reduced_system
from gpebo_cli.observers.remedies.plain import Plain
from gpebo_cli.simulation.linearised import Linearised

_MOST_ROUNDS = 30
_LEAST_ROUNDS = 2
_STILL = 1e-3  # of the residual: what a last round may change of ψη̂


@dataclass(frozen=True)
class NoiseFree:
    """The observer on the plant linearised along a copy of its signals without noise."""

    def observe(self, reduced: ReducedSystem) -> Observation:
        """The regression along the copy that least squares fits; ``Plain``'s if no matrix has y."""
        found, system = Plain().observe(reduced), reduced.system
        if not system.depends_on_outputs:
            return found
        eta, y = found.regression.least_squares(), reduced.signals.outputs.values
        for count in range(1, _MOST_ROUNDS + 1):
            try:
                found = _round(reduced, found, eta)
            except GpeboError as error:  # along the measured signals there was none
                raise _unsettled(count, str(error)) from error
            before, eta = eta, found.regression.least_squares()
            change = _change(found, before, eta, reduced.solver.tol, float(np.abs(y).max()))
            if count >= _LEAST_ROUNDS and change <= _STILL:
                break
        else:
            raise _unsettled(_MOST_ROUNDS, "the signals that fit the data still change")
        settled = Assumption(
            "Noise-free copy", "the signals that the matrices follow have settled", True,
            {"rounds": count, "change": change},
        )
        # Other noise makes another copy: the regression is not affine in it.
        return replace(found, assumptions=(*found.assumptions, settled), respond=None)


def _round(reduced: ReducedSystem, found: Observation, eta: Array) -> Observation:
    """The observer along the solution that the estimates η̂ (p,) give."""
    system, state_map = reduced.system, found.state_map
    assert isinstance(state_map, AffineStateMap)  # noqa: S101  as it is without a remedy
    x = state_map.offset.values + state_map.gain.values @ eta
    scale, units = reduced.first.output_scale, reduced.form.units
    copy = Linearised(system, Trajectory(state_map.offset.mesh, x), eta[: system.q])
    along = reduced_system(
        replace(system, coefficients=copy), reduced.signals, reduced.solver,
        weights=None if (scale == 1.0 / units.outputs).all() else (scale**2).tolist(),
        regression=reduced.regression, units=units,
        form="strangeness_free" if reduced.form.structure else "given",
    )
    return Plain().observe(replace(along, xi_a0=reduced.xi_a0, note=reduced.note))


def _unsettled(count: int, why: str) -> SolverError:
    return SolverError(
        f"observer.remedy=noise_free does not settle; in round {count} {why}. The noise is too "
        "large for so long a horizon of this plant, or the signals are those of another one, or in "
        "other units: shorten time.horizon, or do without the remedy"
    )


def _change(
    found: Observation, before: Array, after: Array, tol: float, size: float = 0.0
) -> float:
    """Root mean square of ψ(η̂₊ − η̂) in terms of that of the residual (Bates & Watts 1981).

    Y is made of signals of a ``size``, and may be rounding of these.
    """
    Y, psi = found.regression.Y.values, found.regression.psi.values
    residual = Y - psi @ after
    floor = tol * (size + float(np.abs(Y).max() + np.abs(psi @ after).max()))
    return float(np.linalg.norm(psi @ (after - before)) / (
        np.linalg.norm(residual) + floor / _STILL * np.sqrt(residual.size)
    ))
