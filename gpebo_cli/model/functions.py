"""Plants given as NumPy arrays and functions from Python, without any text.

A matrix may be an array (constant) or a function of an array of times. Derivatives, which plants
of higher index need, are taken from functions given for them, or else computed from the function
itself at complex times: for an analytic f the Taylor coefficients at t are a discrete Fourier
transform over a small circle around t,

    f^(k)(t)/k! ≈ 1/(J ρ^k) Σ_j f(t + ρ e^{2πij/J}) e^{−2πijk/J}

(Lyness & Moler, SIAM J. Numer. Anal. 4, 1967), accurate to rounding over ρ^k. Finite differences
were rejected: they lose half the digits with every order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import MATRIX_NAMES, Array, Coefficients, DescriptorSystem

Function = Callable[[Any], Any]  # times (N,), real or complex -> (N, rows, columns) or (N, m)
Entry = Array | Sequence[Any] | Function | Sequence[Function]

_POINTS = 32  # on the circle
_NOT_ANALYTIC = 1e-8  # difference between the circle's mean and the value at its centre


@dataclass(frozen=True, eq=False)
class FunctionCoefficients:
    """Coefficients from arrays and functions, see :func:`system_from_functions`."""

    shapes: Mapping[str, tuple[int, ...]]
    fixed: Mapping[str, Array]  # constant matrices, (rows, columns)
    functions: Mapping[str, tuple[Function, ...]]  # f, and its derivatives as far as given
    radius: float
    name: str = ""

    @property
    def constant(self) -> frozenset[str]:
        """Names of the matrices that are arrays."""
        return frozenset(self.fixed)

    def taylor(self, t: Array, order: int, inside: Array | None = None) -> Coefficients:  # noqa: ARG002
        """Taylor coefficients up to ``order`` at the times t (N,); these functions do not jump.

        Constant matrices come as read-only broadcast arrays.

        Raises:
            ConfigError: a function returns the wrong shape, something not finite, or is not
                analytic where a derivative of it is needed.
        """
        out = {}
        for name in MATRIX_NAMES:
            shape = self.shapes[name]
            if name in self.fixed:
                once = np.zeros((order + 1, 1, *shape))
                once[0] = self.fixed[name]
                out[name] = np.broadcast_to(once, (order + 1, len(t), *shape))
            else:
                values = np.zeros((order + 1, len(t), *shape))
                self._fill(name, values, t)
                out[name] = values
        return Coefficients(**out)

    def breakpoints(self, start: float, stop: float) -> Array:  # noqa: ARG002
        """None: functions are taken to be smooth."""
        return np.zeros(0)

    def _fill(self, name: str, values: Array, t: Array) -> None:
        given = self.functions[name]
        factorial = 1.0
        for k in range(min(len(given), len(values))):
            factorial *= max(k, 1)
            values[k] = self._call(name, given[k], t).real / factorial
        if len(given) >= len(values):
            return
        circle = np.exp(2j * np.pi * np.arange(_POINTS) / _POINTS)
        times = (t[:, None] + self.radius * circle).ravel()
        around = self._call(name, given[0], times).reshape(len(t), _POINTS, *values.shape[2:])
        spectrum = np.fft.fft(around, axis=1) / _POINTS
        size = max(float(np.abs(around).max(initial=0.0)), np.finfo(float).tiny)
        if np.abs(spectrum[:, 0] - values[0]).max(initial=0.0) > _NOT_ANALYTIC * size:
            raise ConfigError(
                f"plant {self.name}: {name} needs derivatives but is not analytic (or changes "
                f"faster than the radius {self.radius:g} resolves); give a list "
                f"[{name}, its derivative, …]"
            )
        for k in range(len(given), len(values)):
            values[k] = spectrum[:, k].real / self.radius**k

    def _call(self, name: str, function: Function, t: Any) -> Any:
        try:
            value = np.asarray(function(t))
        except TypeError as error:
            if not np.iscomplexobj(t):
                raise
            raise ConfigError(
                f"plant {self.name}: {name} needs derivatives and does not take complex times "
                f"({error}); give a list [{name}, its derivative, …]"
            ) from error
        shape = (len(t), *self.shapes[name])
        if value.shape != shape:
            raise ConfigError(
                f"plant {self.name}: {name} returned shape {value.shape} for {len(t)} times, "
                f"expected {shape}"
            )
        if not np.isfinite(value).all():
            k = int(np.argmin(np.isfinite(value).reshape(len(t), -1).all(axis=1)))
            raise ConfigError(f"plant {self.name}: {name} is not finite at t = {t[k].real:.6g}")
        return value


@dataclass(frozen=True)
class Names:
    """Names of a plant given by functions; by default x1 …, u1 …, theta1 …, y1 …"""

    states: Sequence[str] = field(default_factory=tuple)
    inputs: Sequence[str] = field(default_factory=tuple)
    unknowns: Sequence[str] = field(default_factory=tuple)
    outputs: Sequence[str] = field(default_factory=tuple)


def system_from_functions(
    name: str,
    E: Entry,
    A: Entry,
    *,
    initial_state: Array | Sequence[float],
    B: Entry | None = None,
    u: Entry | None = None,
    F: Entry | None = None,
    theta: Array | Sequence[float] | Function | Sequence[Function] = (),
    C: Entry | None = None,
    names: Names | None = None,
    radius: float = 0.1,
) -> DescriptorSystem:
    """A descriptor system E x' = A x + B u + F θ, y = C x from arrays and functions.

    Args:
        name: of the plant, for messages and folders.
        E: an array (n, n), a function of times (N,) returning (N, n, n), or a list of such
            functions: E, its first derivative, its second, … Likewise for the others.
        A: (n, n).
        initial_state: (n,), perhaps inconsistent.
        B: (n, m).
        u: (m,), functions return (N, m).
        F: (n, q).
        theta: true values (q,) of the unknown parameters; functions return (N, q).
        C: (r, n).
        names: of states, inputs, unknowns and outputs.
        radius: of the circle of complex times for derivatives that are not given; a tenth of the
            time in which the functions change.

    Raises:
        ConfigError: shapes that disagree, with both numbers.

    Examples:
        >>> import numpy as np
        >>> def A(t):
        ...     out = np.zeros((len(t), 2, 2), dtype=t.dtype)
        ...     out[:, 0], out[:, 1, 0], out[:, 1, 1] = [-1, 1], 1, 2 + np.cos(t)
        ...     return out
        >>> plant = system_from_functions(
        ...     "mine", E=[[1, 0], [0, 0]], A=A, C=[[1, 0]], initial_state=[1, 0]
        ... )
        >>> plant.states, plant.outputs
        (('x1', 'x2'), ('y1',))
    """
    x0 = np.asarray(initial_state, dtype=np.float64)
    n = len(x0)
    q, m, r = _rows(theta), _columns(B, "B"), _rows(C)
    if (u is None) != (B is None):
        raise ConfigError(f"plant {name}: B and u go together; one of them is missing")
    names = names or Names()
    shapes = {"E": (n, n), "A": (n, n), "B": (n, m), "F": (n, q), "C": (r, n), "u": (m,)}
    shapes["theta"] = (q,)
    fixed: dict[str, Array] = {}
    functions: dict[str, tuple[Function, ...]] = {}
    entries = {"E": E, "A": A, "B": B, "F": F, "C": C, "u": u, "theta": theta}
    for key, entry in entries.items():
        listed: list[Any] = list(entry) if isinstance(entry, list | tuple) else [entry]
        if entry is None:
            fixed[key] = np.zeros(shapes[key])
        elif listed and all(callable(item) for item in listed):
            functions[key] = tuple(listed)
        else:
            value = np.asarray(entry, dtype=np.float64)
            if value.shape != shapes[key]:
                raise ConfigError(
                    f"plant {name}: {key} has shape {value.shape}, expected {shapes[key]} "
                    f"(the initial state has {n} entries)"
                )
            fixed[key] = value
    return DescriptorSystem(
        name=name,
        coefficients=FunctionCoefficients(shapes, fixed, functions, radius, name),
        initial_state=x0,
        theta=fixed.get("theta", np.full(q, np.nan)),
        states=_labels(names.states, "x", n, name),
        inputs=_labels(names.inputs, "u", m, name),
        unknowns=_labels(names.unknowns, "theta", q, name),
        outputs=_labels(names.outputs, "y", r, name),
    )


def _first(entry: Entry | None) -> Any:
    """The entry's value at one time, to read its shape from."""
    if entry is None:
        return None
    first: Any = entry
    if isinstance(first, list | tuple) and len(first) and callable(first[0]):
        first = first[0]
    return np.asarray(first(np.zeros(1)))[0] if callable(first) else np.asarray(first)


def _columns(entry: Entry | None, name: str) -> int:
    value = _first(entry)
    if value is None:
        return 0
    if value.ndim != 2:
        raise ConfigError(f"{name} has {value.ndim} axes, expected rows and columns")
    return int(value.shape[1])


def _rows(entry: Entry | None) -> int:
    value = _first(entry)
    return 0 if value is None else int(value.shape[0])


def _labels(given: Sequence[str], letter: str, count: int, plant: str) -> tuple[str, ...]:
    if given and len(given) != count:
        raise ConfigError(f"plant {plant}: {len(given)} names given for {count} of {letter}1 …")
    return tuple(given) if given else tuple(f"{letter}{i + 1}" for i in range(count))
