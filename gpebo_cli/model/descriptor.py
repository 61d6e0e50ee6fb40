"""The model: a linear time-varying descriptor system, its names and its known functions of time.

    E(t) x' = A(t) x + B(t) u(t) + F(t) θ,      y = C(t) x                (paper, eq. 1)

with n states, m inputs, q unknown parameters and r outputs. θ is constant to whoever
estimates it; in a simulation it may vary all the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

MATRIX_NAMES = ("E", "A", "B", "F", "C", "u", "theta")


class Coefficients(NamedTuple):
    """Taylor coefficients of every matrix of the model at N times, up to some order K.

    ``E[k, i]`` is ``E^(k)(t_i) / k!``; time stands before the matrix axes, the order before time.
    A plain derivative of order k is therefore ``factorial(k) * E[k]``, and ``E[0]`` is E itself.
    """

    E: Array  # (K + 1, N, n, n)
    A: Array  # (K + 1, N, n, n)
    B: Array  # (K + 1, N, n, m)
    F: Array  # (K + 1, N, n, q)
    C: Array  # (K + 1, N, r, n)
    u: Array  # (K + 1, N, m)
    theta: Array  # (K + 1, N, q) true values of the unknowns, for the simulation only


class CoefficientSource(Protocol):
    """Where the matrices of a model come from: text (``plant.py``), arrays, or Python functions."""

    @property
    def constant(self) -> frozenset[str]:
        """Those of ``MATRIX_NAMES`` that do not depend on time."""
        ...

    def taylor(self, t: Array, order: int, inside: Array | None = None) -> Coefficients:
        """Evaluate everything at the times ``t`` (shape (N,)) with derivatives up to ``order``.

        Functions that jump are decided at the times ``inside`` (default: ``t``), so that the end
        point of an interval can be given the limit from within that interval.
        """
        ...

    def breakpoints(self, start: float, stop: float) -> Array:
        """Times strictly between ``start`` and ``stop`` where some entry jumps or has a kink."""
        ...


@dataclass(frozen=True)
class DescriptorSystem:
    """A named descriptor system; immutable, validated by whoever builds it."""

    name: str
    states: tuple[str, ...]
    coefficients: CoefficientSource
    initial_state: Array  # (n,), perhaps inconsistent
    inputs: tuple[str, ...] = ()
    unknowns: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    # (q,) true values of the unknowns that are constant, NaN for one that varies; see theta_at
    theta: Array = field(default_factory=lambda: np.zeros(0))
    title: str = ""
    reference: str = ""
    source: str = ""  # the file it came from, for messages
    units: dict[str, str] = field(default_factory=dict)  # by state, input, output or unknown
    observer_defaults: dict[str, object] = field(default_factory=dict)

    @property
    def theta_varies(self) -> bool:
        """Whether some unknown is not constant."""
        return bool(np.isnan(self.theta).any())

    def theta_at(self, t: Array) -> Array:
        """True values of the unknowns at the times t (M,), shape (M, q); after a jump at one."""
        if self.theta_varies:
            return np.asarray(self.coefficients.taylor(t, 0).theta[0])
        return np.broadcast_to(self.theta, (len(t), self.q))

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def q(self) -> int:
        """Number of unknown parameters."""
        return len(self.unknowns)

    @property
    def r(self) -> int:
        """Number of outputs."""
        return len(self.outputs)
