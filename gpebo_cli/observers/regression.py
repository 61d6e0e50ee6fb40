"""No observer at all: Y = ψη is given, as text over signals (config group ``regression``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers._base import Measurements
from gpebo_cli.observers._observation import AffineStateMap, Observation
from gpebo_cli.regression.text import TextRegression
from gpebo_cli.settings import SolverSettings


@dataclass(frozen=True)
class Given:
    """Evaluate Y and ψ along the signals; there is no state to estimate."""

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """The regression of the system's text; no state is mapped to.

        Raises:
            ConfigError: the system is a plant, or an expression has no finite value at some time.
            SolverError: the tolerance cannot be reached.
        """
        given = system.regression
        if not isinstance(given, TextRegression):
            raise ConfigError(
                "observer=regression goes with regression=NAME; for a plant choose observer=gpebo"
            )
        regression, error = given.on(
            signals.inputs, signals.outputs if given.Y is None else None, solver.tol,
            solver.max_elements,
        )
        points = regression.mesh.points.shape
        return Observation(
            regression=regression,
            state_map=AffineStateMap(
                Trajectory(regression.mesh, np.zeros((*points, 0))),
                Trajectory(regression.mesh, np.zeros((*points, 0, regression.p))),
            ),
            truth=_constant_truth,
            error_estimate=error,
            assumptions=(),
            growth=None,
        )


def _constant_truth(t: Array, theta: Array, states: Trajectory) -> Array:  # noqa: ARG001  protocol
    """η is θ."""
    return theta


OBSERVER = Given
