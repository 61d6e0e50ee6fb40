"""What an estimator is to the rest: settings that make estimates from a regression.

``Estimator`` and ``Estimates`` are the least there must be. What more an estimator can do it shows
by a method: :class:`Windowed` takes a long regression in parts, :class:`Resumable` can continue
after a reset, :class:`Moving` follows parameters that move, :class:`Recursive` works at samples.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.errors import ErrorRecursion, ErrorsAt
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.parametrisation import Parametrisation
from gpebo_cli.regression.resets import ExtensionState, Known
from gpebo_cli.regression.samples import SampledRegression


class Estimates(Protocol):
    """The answer of one estimator on fixed times, for any of its cases."""

    def delta(self, t: Array) -> Array | None:
        """Δ at the times t (M,), shape (1 or cases, M), or None where nothing is mixed."""

    @property
    def requirement(self) -> Requirement:
        """What the estimator needs of the regressor, and what it got."""

    def parameters(self, cases: slice) -> Array:
        """η̂ of some cases at the times, shape (g, M, p), or (g, M, p, c) as Y has it."""


class Unmixed:
    """Estimates of a law in which nothing is mixed."""

    def delta(self, t: Array) -> None:
        """There is no Δ at any of the times t (M,)."""


class Lasting:
    """Estimates that know what was got before them."""

    def over(self, parts: Iterable[WindowEstimates], span: tuple[float, float]) -> Requirement:  # noqa: ARG002
        """What the last of the ``parts`` says."""
        return deque(parts, maxlen=1)[0].requirement


@dataclass(frozen=True, eq=False)
class Found(Lasting):
    """Estimates of every case that are at hand, with what was mixed."""

    values: Array  # (cases, M, p)
    requirement: Requirement
    mixed: Array | None = None  # Δ (1 or cases, k); None: nothing is mixed
    shown: Array = field(default_factory=lambda: np.zeros(0))  # (k,) the times of that
    reached: tuple[ExtensionState, ...] = ()  # of each case, where a window of them is found

    def delta(self, t: Array) -> Array | None:
        """Δ (1 or cases, j) at some of the times that were to be shown, (j,)."""
        return None if self.mixed is None else self.mixed[:, np.searchsorted(self.shown, t)]

    def parameters(self, cases: slice, start: Array | None = None) -> Array:  # noqa: ARG002
        """η̂ of some cases, (g, M, p), wherever they ``start``."""
        return self.values[cases]


class Estimator(Protocol):
    """Settings of one estimator; immutable."""

    @property
    def cases(self) -> tuple[Mapping[str, float], ...]:
        """Every combination of gains, by name."""

    def estimate(self, regression: LinearRegression, t: Array) -> Estimates:
        """Prepare the estimates at the times t (M,), ascending.

        Raises:
            ConfigError: a setting's length does not match the parameters.
        """


class ResumableEstimates(Estimates, Protocol):
    """Estimates from which the next segment can go on."""

    @property
    def reached(self) -> tuple[ExtensionState, ...]:
        """The extensions at the end of the regression: what ``resume`` takes as ``known``."""

    def parameters(self, cases: slice, start: Array | None = None) -> Array:
        """η̂ of some cases (g, M, p) at the times, from ``start`` (g, p); None: the settings'."""


class WindowEstimates(ResumableEstimates, Protocol):
    """Estimates in one window of a long regression."""

    def over(self, parts: Iterable[WindowEstimates], span: tuple[float, float]) -> Requirement:
        """What is needed and was got in all of the ``parts`` of a span, this the first of them."""


@runtime_checkable
class Weighing(Protocol):
    """Estimates that are the least of a sum of squares, and that say how it weighs errors."""

    def weights(self, case: int) -> Array:
        """M (M, p, p) of (η − η̂)ᵀ M (η − η̂), by which the sum grows beside η̂, at the times."""


@runtime_checkable
class Windowed(Estimator, Protocol):
    """An estimator that takes a long regression window by window."""

    def go_on(self, regression: LinearRegression, t: Array, known: Known) -> WindowEstimates:
        """As ``Estimator.estimate`` at the times t (M,) of a window, about the same parameters.

        From what was ``reached`` in the window before; none: it is the first one.
        """


@runtime_checkable
class Resumable(Protocol):
    """An estimator that can go on after a reset."""

    def resume(self, regression: LinearRegression, t: Array, known: Known) -> ResumableEstimates:
        """As ``Estimator.estimate`` at the times t (M,), for Y = ψη without resets.

        From extensions that are known at its start; none: they start at zero.
        """


@runtime_checkable
class Moving(Protocol):
    """An estimator that can follow parameters that move."""

    def estimate_moving(
        self, regression: LinearRegression, t: Array, known: Known, dynamics: Dynamics
    ) -> WindowEstimates:
        """Prepare the estimates of η' = 𝔸η + 𝕓 from Y = ψη at the times t (M,), ascending.

        From what was ``reached`` in the window before; none: it is the first one.
        """


@runtime_checkable
class Fitting(Protocol):
    """An estimator of θ in η = S(θ)."""

    def law(self, S: Parametrisation | None) -> object:
        """What it makes of S (ConfigError: there is none, or one that it cannot take)."""


@runtime_checkable
class Affine(Protocol):
    """An estimator whose estimates are affine in Y, and that says how: for their deviations."""

    def errors(self, regression: LinearRegression) -> Sequence[ErrorsAt]:
        """For each case how errors of Y become errors of η̂, in continuous time, without resets.

        One that is ``Windowed`` takes what was ``known`` before as a second argument.
        """


@dataclass(frozen=True, eq=False)
class SampledEstimates:
    """η̂ of every case at K samples."""

    parameters: Array  # (G, K, p)
    delta: Array | None  # (1 or G, K), None where nothing is mixed
    # Of every case how errors of Y become errors of η̂, to be asked at every update or never; None:
    # nobody knows.
    errors: Callable[[], Sequence[ErrorRecursion]] | None = None
    met: BoolArray | None = None  # (K,) whether what is required had come by then, where errors are


class Recursion(Protocol):
    """An estimator that takes samples as they come; it changes as it does so."""

    def update(self, regression: SampledRegression) -> SampledEstimates:
        """Take K samples and give the estimates at each."""

    @property
    def requirement(self) -> Requirement:
        """What the estimator needs of the regressor, and what it got so far."""


@runtime_checkable
class Recursive(Protocol):
    """An estimator that works at samples, too."""

    def recursive(self, parameters: Sequence[str]) -> Recursion:
        """The same at samples, for parameters of these names.

        Raises:
            ConfigError: a setting that there is in continuous time only.
        """
