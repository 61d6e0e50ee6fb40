"""The model: a descriptor system affine in its state, its names and its known functions.

    E(t) x' = A x + B u + F θ + φ,      y = C x + D u + H θ                (paper, eq. 1, and more)

with n states, m inputs, q unknown parameters and r outputs. A, B, F and φ may depend on (t, u, y),
C, D and H on (t, u): on what is measured. The paper has functions of t alone, and neither φ nor
D nor H. θ is constant to whoever estimates it; in a simulation it may vary all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from gpebo_cli.errors import ConfigError
from gpebo_cli.schema import LARGEST

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_FEW = 100  # states: matrices of more are never made dense
MATRIX_NAMES = ("E", "A", "B", "F", "C", "u", "theta", "phi", "D", "H")


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
    phi: Array  # (K + 1, N, n)
    D: Array  # (K + 1, N, r, m)
    H: Array  # (K + 1, N, r, q)

    def along(self, signals: Array) -> Coefficients:
        """These with u as it was measured; signals (J + 1, N, m + r) as for ``taylor``."""
        u: Array = np.zeros(self.u.shape)
        given = signals[: len(u), :, : u.shape[2]]
        u[: len(given)] = given
        return self._replace(u=u)


def distinct(matrix: Array) -> Array:
    """Taylor coefficients (K + 1, N, …) at one time, where they are the same at all."""
    return matrix[:, :1] if matrix.strides[1] == 0 else matrix


class CoefficientSource(Protocol):
    """Where the matrices of a model come from: text (``plant.py``), arrays, or Python functions."""

    @property
    def constant(self) -> frozenset[str]:
        """Those of ``MATRIX_NAMES`` that do not depend on time."""

    @property
    def zero(self) -> frozenset[str]:
        """Those of ``constant`` that vanish: nothing needs to be computed with them."""

    @property
    def signals(self) -> Mapping[str, frozenset[str]]:
        """Names of the inputs and outputs that a matrix depends on, by matrix; most have none."""

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        """Evaluate everything at the times ``t`` (shape (N,)) with derivatives up to ``order``.

        Functions that jump are decided at the times ``inside`` (default: ``t``), so that the end
        point of an interval can be given the limit from within that interval.

        Matrices that depend on signals are evaluated along ``signals``: Taylor coefficients of
        [u, y] at t, shape (J + 1, N, m + r). Coefficients beyond J count as zero, so J = 0 will
        do for values (E depends on no signal, so its derivatives are right whatever J is).
        ``u`` of the result is then that of the signals. None: u is the plant's own function of
        time, and nothing may depend on y.
        """

    @property
    def of_time(self) -> CoefficientSource:
        """The same with zero for what depends on outputs, to be evaluated without signals."""

    def truth(self, t: Array) -> Array:
        """True values of the unknowns at the times ``t`` (N,), shape (N, q)."""

    def breakpoints(self, start: float, stop: float) -> Array:
        """Times strictly between ``start`` and ``stop`` where some entry jumps or has a kink."""

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        """Edges of cells in which every known function is nearly a polynomial of low degree.

        They are ``edges`` (K + 1,), sorted, jumps and kinks among them, and more: nothing that is
        looked at between them hides a pulse. But where the second value is False nothing says so:
        functions come from Python, or need too many cells. What depends on outputs does not count
        here: it is looked at along a solution.
        """


@dataclass(frozen=True, eq=False)
class Changed:
    """A source whose matrices are another's in part, or along known signals."""

    source: CoefficientSource
    evaluate: Callable[[Array, int, Array], Coefficients]  # times, order, inside
    kept: dict[object, object] = field(default_factory=dict)  # what is found out about these

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None  # noqa: ARG002
    ) -> Coefficients:
        """Evaluate them at the times t (N,); signals do not count."""
        return self.evaluate(t, order, t if inside is None else inside)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)


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
    labels: dict[str, str] = field(default_factory=dict)  # mathtext, by those and by parameters
    observer_defaults: dict[str, object] = field(default_factory=dict)
    # Y = ψθ in place of equations: a ``regression.text.TextRegression`` of the inputs; no states
    regression: object = None

    @property
    def followed(self) -> frozenset[str]:
        """Names of the inputs and outputs that matrices depend on."""
        return frozenset[str]().union(*self.coefficients.signals.values())

    @property
    def depends_on_outputs(self) -> bool:
        """Whether some matrix depends on an output: the plant is not linear in its state."""
        return not self.followed.isdisjoint(self.outputs)

    @property
    def theta_varies(self) -> bool:
        """Whether some unknown is not constant."""
        return bool(np.isnan(self.theta).any())

    def theta_at(self, t: Array) -> Array:
        """True values of the unknowns at the times t (M,), shape (M, q); after a jump at one."""
        if self.theta_varies:
            return self.coefficients.truth(t)
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


def differential_order(system: DescriptorSystem, start: float) -> int:
    """The rank of E at the ``start``."""
    if not system.n:
        return 0
    E = system.coefficients.of_time.taylor(np.array([start]), 0).E[0, 0]
    return int(np.linalg.matrix_rank(E))


def check_sizes(system: DescriptorSystem, t: Array) -> None:
    """Refuse numbers whose squares and products overflow: all that came of them would be wrong.

    At times t (N,); an entry that is not finite there is reported by others. Of matrices that
    depend on outputs only values without signals are seen.

    Raises:
        ConfigError: names the entry, its value and the time.
    """
    initial = np.atleast_1d(system.initial_state)
    entries: dict[str, Array] = {"initial_state": initial[None, None]}
    source = system.coefficients
    with np.errstate(all="ignore"):
        with suppress(ConfigError):
            source = source.of_time if system.depends_on_outputs else source
            if system.n <= _FEW:
                entries |= source.taylor(t, 0)._asdict()
        some = (distinct(values)[0].ravel() for values in entries.values() if values.size)
        whole = np.concatenate([initial, *some])
        E = np.abs(distinct(entries["E"])[0]) if "E" in entries else initial[:0]
        if whole.dot(whole) <= LARGEST and E[E > 0.0].min(initial=1.0) >= 1.0 / LARGEST:
            return  # no need to look at each
    named = {"initial_state": ("initial_state", system.states), "u": ("inputs", system.inputs),
             "theta": ("unknowns", system.unknowns)}
    for name, values in entries.items():
        sizes = np.abs(distinct(values)[0])
        wrong = np.isfinite(sizes) & (sizes > LARGEST)
        if name == "E":  # by which rates are divided
            wrong |= (sizes > 0.0) & (sizes < 1.0 / LARGEST)
        for at, *place in np.argwhere(wrong)[:1].tolist():
            where = name + "".join(f"[{k}]" for k in place)
            if name in named:
                where = f"{named[name][0]}.{named[name][1][place[0]]}"
            when = "" if name == "initial_state" else f" at t = {t[at]:.6g}"
            value = values[0][(at, *place)]
            limit = f"go up to {LARGEST:g}, products of larger ones overflow"
            if abs(value) < 1.0:
                limit = f"of E go down to {1.0 / LARGEST:g}, quotients by smaller ones overflow"
            raise ConfigError(
                f"plant {system.name}: {where} is {value:.3g}{when}; numbers {limit}; use other "
                "units"
            )
