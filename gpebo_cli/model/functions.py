"""Plants given as NumPy arrays and functions from Python, without any text.

A matrix may be an array (constant) or a function of an array of times, and, where what is measured
may stand in it, of the inputs and outputs at these times. Derivatives, which plants
of higher index need, are taken from functions given for them, or else computed from the function
itself at complex times: for an analytic f the Taylor coefficients at t are a discrete Fourier
transform over a small circle around t,

    f^(k)(t)/k! ≈ 1/(J ρ^k) Σ_j f(t + ρ e^{2πij/J}) e^{−2πijk/J}

(Lyness & Moler, SIAM J. Numer. Anal. 4, 1967), accurate to rounding over ρ^k. Finite differences
were rejected: they lose half the digits with every order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from inspect import Parameter, signature
from math import factorial
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import MATRIX_NAMES, Array, Coefficients, DescriptorSystem
from gpebo_cli.model.entries import Entries, Places, entries_of, is_sparse, not_zero
from gpebo_cli.model.plant import kind_of_name
from gpebo_cli.schema import shown

# (t), (t, u) or (t, u, y), t (N,), u (N, m) and y (N, r), real or complex -> (N, rows, columns), or
# (N, m) for u, (N, n) for phi
Function = Callable[..., Any]
Entry = Array | Sequence[Any] | Function | Sequence[Function]

# Of t, u and y; one where not said.
_MOST_ARGUMENTS = {"A": 3, "B": 3, "F": 3, "phi": 3, "C": 2, "D": 2, "H": 2}
_POINTS = 32  # on the circle
_PROBES = np.array([0.0, 0.3819660112501051, 1.618033988749895])  # times to see what is stored
_NOT_ANALYTIC = 1e-8  # difference between the circle's mean and the value at its centre


@dataclass(frozen=True, eq=False)
class FunctionCoefficients:
    """Coefficients from arrays and functions, see :func:`system_from_functions`."""

    shapes: Mapping[str, tuple[int, ...]]
    fixed: Mapping[str, Array]  # constant matrices, (rows, columns)
    functions: Mapping[str, tuple[Function, ...]]  # f, and its derivatives as far as given
    radius: float
    signals: Mapping[str, frozenset[str]]  # what a function is a function of, by its name
    outputs: int  # r
    name: str = ""
    # Where the entries of functions are that return sparse matrices; their shape is (entries,)
    places: Mapping[str, Places] = field(default_factory=dict)
    whole: Mapping[str, tuple[int, ...]] = field(default_factory=dict)  # shapes of those matrices

    def entries(
        self, t: Array, order: int, inside: Array | None = None, _moved: object = None  # noqa: ARG002
    ) -> Entries:
        """All entries that are not zero at the times t (N,), as ``model.entries`` has them."""
        if self.signals:
            return entries_of(self.taylor(t, order), self.constant)
        values: dict[str, Array] = {}
        places: dict[str, Places] = {}
        for name in MATRIX_NAMES:
            found = self._values(name, t[:1] if name in self.fixed else t, order, None)
            if name in self.places:
                values[name], places[name] = found, self.places[name]
            else:
                places[name], values[name] = not_zero(found)
        return Entries(Coefficients(**values), places)

    @property
    def constant(self) -> frozenset[str]:
        """Names of the matrices that are arrays."""
        return frozenset(self.fixed)

    @property
    def zero(self) -> frozenset[str]:
        """Names of the arrays that vanish."""
        return frozenset(name for name, value in self.fixed.items() if not value.any())

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None  # noqa: ARG002
    ) -> Coefficients:
        """Taylor coefficients up to ``order`` at the times t (N,); these functions do not jump.

        Constant matrices come as read-only broadcast arrays. What is a function of u and y is
        evaluated along ``signals``, (J + 1, N, m + r); None: along the plant's own u (ConfigError:
        a function returns the wrong shape, something not finite, or is not analytic where a
        derivative of it is needed; or y is needed and not known).
        """
        found: dict[str, Array] = {}
        along, m = signals, self.shapes["u"][0]
        if self.signals and signals is None:
            for name in (name for name, depends in self.signals.items() if len(depends) > m):
                raise ConfigError(
                    f"plant {self.name}: {name} depends on the outputs, which are not known here"
                )
            nothing = np.zeros((order + 1, len(t), self.outputs))
            found["u"] = self._values("u", t, order, None)
            along = np.concatenate([found["u"], nothing], axis=2)
        for name in MATRIX_NAMES:
            if name not in found:
                found[name] = self._values(name, t, order, along if name in self.signals else None)
        for name, (i, j) in self.places.items():
            values = found[name]
            found[name] = np.zeros((*values.shape[:2], *self.whole[name]))
            found[name][:, :, i, j] = values
        c = Coefficients(**found)
        return c if signals is None else c.along(signals)

    @cached_property
    def of_time(self) -> FunctionCoefficients:
        """The same with zero for what is a function of outputs."""
        m = self.shapes["u"][0]
        gone = {name for name, depends in self.signals.items() if len(depends) > m}
        return replace(
            self,
            fixed={**self.fixed, **{name: np.zeros(self.shapes[name]) for name in gone}},
            signals={k: v for k, v in self.signals.items() if k not in gone},
        )

    def truth(self, t: Array) -> Array:
        """True values of the unknowns at the times t (N,), shape (N, q)."""
        return np.asarray(self._values("theta", t, 0, None)[0])

    def _values(self, name: str, t: Array, order: int, signals: Array | None) -> Array:
        """Taylor coefficients (order + 1, N, *shape) of one matrix."""
        shape = self.shapes[name]
        if name in self.fixed:
            once = np.zeros((order + 1, 1, *shape))
            once[0] = self.fixed[name]
            return np.broadcast_to(once, (order + 1, len(t), *shape))
        values = np.zeros((order + 1, len(t), *shape))
        # A derivative that is given is one of time alone, so with signals only values are.
        given = self.functions[name][: 1 if signals is not None else None]
        for k, function in enumerate(given[: order + 1]):
            found = self._call(name, function, t, signals, np.zeros((len(t), 1)))
            values[k] = found.real / factorial(k)
        if len(given) > order:
            return values
        circle = np.exp(2j * np.pi * np.arange(_POINTS) / _POINTS)
        away = np.tile(self.radius * circle, len(t))[:, None]
        if signals is not None:
            signals = np.repeat(signals[: order + 1], _POINTS, axis=1)
        around = self._call(name, given[0], np.repeat(t, _POINTS), signals, away)
        around = around.reshape(len(t), _POINTS, *shape)
        spectrum = np.fft.fft(around, axis=1) / _POINTS
        size = max(float(np.abs(around).max(initial=0.0)), np.finfo(float).tiny)
        if np.abs(spectrum[:, 0] - values[0]).max(initial=0.0) > _NOT_ANALYTIC * size:
            raise ConfigError(
                f"plant {self.name}: {name} needs derivatives but is not analytic (or changes "
                f"faster than the radius {self.radius:g} resolves); give a list "
                f"[{name}, its derivative, …]"
            )
        for k in range(len(given), order + 1):
            values[k] = spectrum[:, k].real / self.radius**k
        return values

    def breakpoints(self, start: float, stop: float) -> Array:  # noqa: ARG002
        """None: functions are taken to be smooth."""
        return np.zeros(0)

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        """The same edges (K + 1,): nothing bounds what functions do between the nodes."""
        return edges, False

    def _picked(self, name: str, matrices: Any) -> list[Any]:
        """The entries of sparse matrices, (entries,) each."""
        i, j = self.places[name]
        found = [np.asarray(matrix.tocsr()[i, j]).ravel() for matrix in matrices]
        for matrix, values in zip(matrices, found, strict=True):
            if matrix.count_nonzero() != np.count_nonzero(values):
                raise ConfigError(
                    f"plant {self.name}: {name} has entries where it had none at other times; "
                    "return them all each time, those that are zero stored as such"
                )
        return found

    def _call(self, name: str, function: Function, t: Any, signals: Array | None, away: Any) -> Any:
        """The function at times t + away (N, 1), signals being the polynomials that they are."""
        arguments: list[Any] = []
        if signals is not None:
            there = signals[-1] + 0.0 * away
            for coefficient in signals[-2::-1]:
                there = there * away + coefficient
            arguments = [there[:, : self.shapes["u"][0]], there[:, self.shapes["u"][0] :]]
        t = t + away[:, 0]
        try:
            value = function(t, *arguments[: _arguments(function) - 1])
            value = np.asarray(self._picked(name, value) if name in self.places else value)
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

    states: Sequence[str] = ()
    inputs: Sequence[str] = ()
    unknowns: Sequence[str] = ()
    outputs: Sequence[str] = ()


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
    phi: Entry | None = None,
    D: Entry | None = None,
    H: Entry | None = None,
    names: Names | None = None,
    radius: float = 0.1,
) -> DescriptorSystem:
    """E x' = A x + B u + F θ + φ, y = C x + D u + H θ from arrays and functions.

    Args:
        name: of the plant, for messages and folders.
        E: an array (n, n), a function of times (N,) returning (N, n, n), or a list of such
            functions: E, its first derivative, its second, … Likewise for the others. Matrices may
            be SciPy's sparse ones, also in a list of N that a function returns. Functions
            for A, B, F and phi may also take (t, u, y), those for C, D and H (t, u): the inputs
            (N, m) and outputs (N, r) at these times.
        A: (n, n).
        initial_state: (n,), perhaps inconsistent.
        B: (n, m).
        u: (m,), functions return (N, m).
        F: (n, q).
        theta: true values (q,) of the unknown parameters; functions return (N, q).
        C: (r, n).
        phi: (n,), functions return (N, n).
        D: (r, m).
        H: (r, q).
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
    x0 = _numbers(initial_state, f"plant {name}: initial_state")
    n = x0.size
    if x0.shape != (n,):
        raise ConfigError(f"plant {name}: initial_state has shape {x0.shape}, expected ({n},)")
    names = names or Names()
    q, m = _rows(theta), len(names.inputs) or _rows(u)
    r = len(names.outputs) or _rows(C, m)
    if (u is None) != (B is None):
        raise ConfigError(f"plant {name}: B and u go together; one of them is missing")
    inputs = names_of("inputs", names.inputs, "u", m, name)
    outputs = names_of("outputs", names.outputs, "y", r, name)
    states = names_of("states", names.states, "x", n, name)
    unknowns = names_of("unknowns", names.unknowns, "theta", q, name)
    kinds = {"a state": states, "an input": inputs, "an unknown": unknowns, "an output": outputs}
    kind_of_name(f"plant {name}", kinds)
    fixed: dict[str, Array] = {}
    functions: dict[str, tuple[Function, ...]] = {}
    signals: dict[str, frozenset[str]] = {}
    places: dict[str, Places] = {}
    whole: dict[str, tuple[int, ...]] = {}
    entries: dict[str, tuple[Any, tuple[int, ...]]] = {
        "E": (E, (n, n)), "A": (A, (n, n)), "B": (B, (n, m)), "F": (F, (n, q)), "C": (C, (r, n)),
        "u": (u, (m,)), "theta": (theta, (q,)), "phi": (phi, (n,)), "D": (D, (r, m)),
        "H": (H, (r, q)),
    }  # fmt: skip
    shapes = {key: shape for key, (_, shape) in entries.items()}
    for key, (entry, shape) in entries.items():
        listed: list[Any] = list(entry) if isinstance(entry, list | tuple) else [entry]
        if entry is None:
            fixed[key] = np.zeros(shape)
        elif listed and all(callable(item) for item in listed):
            functions[key] = tuple(listed)
            probe = listed[0](_PROBES) if _arguments(listed[0]) == 1 else None
            if isinstance(probe, list | tuple) and all(map(is_sparse, probe)):
                wrong = [matrix.shape for matrix in probe if matrix.shape != shape]
                if wrong:
                    raise ConfigError(
                        f"plant {name}: {key} returned a matrix {wrong[0]}, expected {shape}"
                    )
                stored = np.concatenate([np.ravel_multi_index(m.tocoo().coords, m.shape)
                                         for m in probe])
                places[key] = np.unravel_index(np.unique(stored), shape)
                whole[key], shapes[key] = shape, (len(places[key][0]),)
            count = max(map(_arguments, listed))
            if count > _MOST_ARGUMENTS.get(key, 1):
                raise ConfigError(
                    f"plant {name}: {key} takes {count} arguments, but may depend on "
                    f"{', '.join('tuy'[: _MOST_ARGUMENTS.get(key, 1)])} only"
                )
            if count > 1:
                signals[key] = frozenset(inputs if count == 2 else (*inputs, *outputs))
        else:
            value = _numbers(entry, f"plant {name}: {key}")
            if value.shape != shape:
                raise ConfigError(
                    f"plant {name}: {key} has shape {value.shape}, expected {shape} "
                    f"(the initial state has {n} entries)"
                )
            if key != "theta" and not np.isfinite(value).all():  # the truth need not be known
                raise ConfigError(f"plant {name}: {key} has an entry that is not finite")
            fixed[key] = value
    return DescriptorSystem(
        name=name,
        coefficients=FunctionCoefficients(
            shapes, fixed, functions, radius, signals, r, name, places, whole
        ),
        initial_state=x0,
        theta=fixed.get("theta", np.full(q, np.nan)),
        states=states,
        inputs=inputs,
        unknowns=unknowns,
        outputs=outputs,
    )


def _numbers(entry: Any, where: str) -> Array:
    """An entry that is no function as an array."""
    with suppress(TypeError, ValueError, OverflowError):
        found = np.asarray(entry.toarray() if is_sparse(entry) else entry)
        if not np.iscomplexobj(found):
            return found.astype(np.float64)  # a copy: the caller's may change
    raise ConfigError(f"{where} is not an array of real numbers")


def _arguments(function: Function) -> int:
    """How many arguments a function has to be given."""
    given = signature(function).parameters.values()
    positional = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    return max(1, sum(p.kind in positional and p.default is Parameter.empty for p in given))


def _rows(entry: Entry | None, inputs: int = 0) -> int:
    """The first size of an entry, by its value at one time."""
    first: Any = entry
    if isinstance(first, list | tuple) and len(first) and callable(first[0]):
        first = first[0]
    if callable(first):
        signals = [np.zeros((1, inputs))] * (_arguments(first) - 1)
        first = first(np.zeros(1), *signals)[0]
    if is_sparse(first):
        return int(first.shape[0])
    return 0 if first is None else len(np.atleast_1d(first))


def names_of(
    kind: str, given: Sequence[str] | None, letter: str, count: int, plant: str
) -> tuple[str, ...]:
    """The ``given`` names, or x1, x2, … (ConfigError: not ``count`` of them, or no names)."""
    if given and len(given) != count:
        raise ConfigError(f"plant {plant}: {len(given)} names of {kind} for {count} of them")
    for one in given or ():
        if not str(one).isidentifier() or one == "t":  # the time's
            raise ConfigError(
                f"plant {plant}: {shown(one)} cannot be a name of {kind}; a name is made of "
                "letters, digits and _, starts with no digit, and is not t"
            )
    return tuple(given) if given else tuple(f"{letter}{i + 1}" for i in range(count))
