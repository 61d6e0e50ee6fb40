"""There is no observer: Y = ψη is given, as text over signals (config group ``regression``)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers._base import (
    AffineStateMap,
    Measurements,
    Observation,
    Reconstruction,
    SampledBlock,
    Sampling,
    StateMap,
    Truth,
)
from gpebo_cli.recordings.hold import Hold
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression.errors import ErrorsAt, ErrorSteps, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.parametrisation import Parametrisation
from gpebo_cli.regression.text import TextRegression, TextState
from gpebo_cli.settings import SolverSettings


@dataclass(frozen=True)
class Given:
    """Evaluate Y and ψ along the signals; there is no state to estimate.

    Attributes:
        sample_time: seconds between samples of a recursion in discrete time; None: continuous.
        hold: what it assumes between samples.
    """

    sample_time: float | None = field(default=None, metadata={"positive": True})  # seconds
    hold: Literal["zoh", "linear"] = "zoh"

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """The regression of the system's text; there is no state."""
        given = _text_of(system)
        replace(signals, asked=None).check_memory(system)
        regression, error = given.on(
            signals.inputs, signals.outputs if given.Y is None else None, solver.tol,
            solver.max_elements,
        )
        points, errors = regression.mesh.points.shape, None
        if given.Y is None and (signals.noise is None or not signals.noise.inputs.any()):
            errors = _errors_of_outputs(system, given.rows)
        state_map: StateMap = AffineStateMap(
            Trajectory(regression.mesh, np.zeros((*points, 0))),
            Trajectory(regression.mesh, np.zeros((*points, 0, regression.p))),
        )
        if given.parametrisation is not None:
            state_map = FittedMap(given.parametrisation, regression)
        return Observation(
            regression=regression,
            state_map=state_map,
            truth=_constant_truth,
            error_estimate=error,
            assumptions=(),
            growth=None,
            errors=errors,
            respond=None if errors is None else lambda _u, of_outputs: of_outputs,
        )

    def sampling(self) -> Sampling | None:
        """The samples that ``sample_time`` asks for."""
        return None if self.sample_time is None else Sampling(self.sample_time, self.hold)

    def at_samples(
        self, system: DescriptorSystem, solver: SolverSettings, hold: Hold, start: float,  # noqa: ARG002  protocol
        sample: Array, derivatives: InputDerivatives | None,  # noqa: ARG002
    ) -> GivenAtSamples:
        """The regression's recursion, whose first sample [u; y] (m + r,) is at ``start``.

        Its operators know one hold (ConfigError: several).
        """
        if not isinstance(hold, str):
            raise ConfigError(
                "data.hold: in a stream a regression without a plant takes one word for all signals"
            )
        return GivenAtSamples(_text_of(system), hold)


@dataclass(frozen=True, eq=False)
class FittedMap(StateMap):
    """θ̂ of η̂ = S(θ̂), see :mod:`gpebo_cli.regression.parametrisation`."""

    parametrisation: Parametrisation
    regression: LinearRegression

    def gains(self, t: Array, states: Array) -> Array:
        """∂θ̂/∂η̂ (g, M, q, k) at the times t (M,) and estimates θ̂ (g, M, q)."""
        weight = self.regression.gram_at(t)[..., : self.regression.p]
        return np.array([self.parametrisation.gain(of_case, weight) for of_case in states])

    def at(self, t: Array) -> Reconstruction:
        """θ̂ (g, M, q) of η̂ (g, M, k) at the times t (M,)."""
        weight, S = self.regression.gram_at(t)[..., : self.regression.p], self.parametrisation
        return lambda eta: np.array([S.fitted(of_case, weight) for of_case in eta])


@dataclass(frozen=True, eq=False)
class GivenAtSamples:
    """A regression's text from one sample to the next."""

    text: TextRegression
    hold: str

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the components of η."""
        return self.text.system.unknowns

    def advance(
        self, state: TextState | None, t: Array, u: Array, y: Array
    ) -> tuple[TextState, SampledBlock]:
        """Regression at the samples t (K,) of u (K, m), and y (K, rows) where the text has no Y."""
        state, regression = self.text.advance(self.hold, state, t, u, y)
        count, S = len(t), self.text.parametrisation
        none = np.zeros((count, self.text.system.n, len(self.parameters)))
        errors = None
        if self.text.Y is None:
            of_outputs = _errors_of_outputs(self.text.system, self.text.rows)(t, t)
            errors = ErrorSteps.at(np.zeros((count, 0, 2 * (u.shape[1] + y.shape[1]))), of_outputs)
        return state, SampledBlock(
            regression, none[:, :, 0], none, none[:, :0], errors,
            fit=None if S is None else S.fit,
        )

    def assumptions(self, reached: TextState) -> tuple[Assumption, ...]:  # noqa: ARG002  protocol
        """No assumption is made."""
        return ()

    def truth(self, extension: Array) -> Truth:  # noqa: ARG002  protocol
        """η is θ; the extension (K, 0, p) is empty."""
        return _constant_truth


def _text_of(system: DescriptorSystem) -> TextRegression:
    given = system.regression
    if not isinstance(given, TextRegression):
        raise ConfigError(
            "observer=regression goes with regression=NAME; for a plant choose observer=gpebo"
        )
    return given


def _errors_of_outputs(system: DescriptorSystem, rows: int) -> ErrorsAt:
    """Errors of [signals; Y] as a linear system without a state: what they add to Y."""
    D = np.eye(rows + system.n, system.m + rows, system.m)[None]
    none = np.zeros((1, 0, 0))
    found = ErrorSystem(none, np.zeros((1, 0, D.shape[2])), np.zeros((1, D.shape[1], 0)), D)
    return lambda _t, _inside: found


def _constant_truth(t: Array, theta: Array, states: Trajectory) -> Array:  # noqa: ARG001  protocol
    """η is θ."""
    return theta


OBSERVER = Given
