"""Estimates of samples as they come: the observer at samples, one row out for each row in."""

from __future__ import annotations

import math

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.noise import noise_levels
from gpebo_cli.experiment.sampled import SampledRun
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.recordings.table import Samples
from gpebo_cli.settings import Settings


class Stream:
    """From samples to estimates; what it remembers does not grow with their number."""

    def __init__(self, settings: Settings, system: DescriptorSystem) -> None:
        """Check what a stream asks of the settings.

        Raises:
            ConfigError: a setting that needs to know how a recording goes on.
        """
        if not noise_levels(settings.noise, system).silent:
            raise ConfigError("noise is for simulations; what is streamed has its own")
        if settings.data.hold == "cubic":
            raise ConfigError(
                "data.hold=cubic needs to know the samples to come; a stream takes zoh or linear"
            )
        if settings.observer.sample_time is not None:
            raise ConfigError(
                "observer.sample_time: the rows of a stream are the samples; leave it null"
            )
        if not (math.isinf(settings.time.start) and math.isinf(settings.time.horizon)):
            raise ConfigError(
                "a stream begins with its first row and ends with its last; leave time.start and "
                "time.horizon null"
            )
        self._settings, self._system = settings, system
        self._run: SampledRun | None = None
        self._rows = 0
        self._span = (0.0, 0.0)
        self._final = np.zeros((1, 0))

    @property
    def columns(self) -> list[str]:
        """Names of the columns that :meth:`feed` returns, known with the first row."""
        names = [*self._running.parameters, *self._system.states]
        return ["t", *(f"{name}_hat" for name in names), "lambda_min"]

    def feed(self, samples: Samples) -> Array:
        """One row of estimates for each sample, (K, columns).

        Raises:
            ConfigError: the settings make several cases, or do not fit.
            ModelError: an assumption of the observer fails.
            SolverError: a step between samples cannot be resolved.
        """
        if self._run is None:
            first = float(samples.t[0])
            hold = self._settings.data.hold
            self._run = SampledRun(self._settings, self._system, hold, first)
            if len(self._run.cases) > 1:
                raise ConfigError(
                    f"the gains of the estimator make {len(self._run.cases)} cases; a stream has "
                    "room for one"
                )
            self._span = (first, first)
        made = self._run.feed(samples.t, samples.inputs, samples.outputs)
        self._rows += len(samples.t)
        self._span = (self._span[0], float(samples.t[-1]))
        self._final = made.parameters[:, -1]
        level = made.gram_eigenvalues[:, :1]
        return np.column_stack([samples.t, made.parameters[0], made.states[0], level])

    @property
    def verdict(self) -> str:
        """The last line: how much came, whether it excites, how well the estimates explain it."""
        run = self._running
        direction, smallest, _ = run.weakest_direction
        rho = run.rho
        if smallest >= rho > 0:
            excited = f"interval-exciting (λ_min(G) = {smallest:.3g}, ρ = {rho:.2g})"
        else:
            excited = (
                f"NOT interval-exciting: λ_min(G) = {smallest:.3g} < ρ = {rho:.2g}; not excited: "
                f"{direction}"
            )
        fit = run.fit(self._final)
        line = (
            f"{self._rows} rows, t = {self._span[0]:.6g} to {self._span[1]:.6g}; {excited}; "
            f"|Y − ψη̂| with the final estimates is {fit.residual[0]:.2g}, |Y| is {fit.size:.2g} "
            "(root mean squares)"
        )
        requirement = run.requirement
        if not requirement.holds:
            line += f"; {requirement.name} not met: {requirement.text}"
        return line

    @property
    def _running(self) -> SampledRun:
        if self._run is None:
            raise ValueError("there have been no samples")
        return self._run
