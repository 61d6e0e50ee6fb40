"""The equations as an observer takes them: as given, or with all hidden constraints beside them.

    E x' = A x + B v + F θ,     0 = M x + M_v v + M_θ θ,     y = C x + D v + H θ

v are the inputs, one where there is a known term φ, and the derivatives of inputs that hidden
constraints contain. M = Â2⁺Â2 comes from the derivative array: whatever basis Z2 of its left kernel
is taken, M is the same, and as smooth as the plant. [Z1ᵀE; Â2] is nonsingular (theory 1), so M is
injective on the kernel of E: the observer needs no output to see the algebraic states, whatever the
index. No output is differentiated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import ConfigError, ModelError
from gpebo_cli.kernels.arrays import joined
from gpebo_cli.model.descriptor import Array, BoolArray, Changed, Coefficients, DescriptorSystem
from gpebo_cli.model.functions import FunctionCoefficients
from gpebo_cli.numerics.linalg import exact_product, transpose, without_rounding
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.reduction.scaling import Units, units_at
from gpebo_cli.reduction.strangeness_free import LOOKS, reduced
from gpebo_cli.reduction.structure import Structure, analyse
from gpebo_cli.schema import listed

_AHEAD = np.linspace(0.0, 1.0, 17)  # of what of the plant is looked at before its samples come
_SEEN = 2  # derivatives at the start by which an entry that is zero there is known
_MOVED = 1e-8  # of hidden constraints: what derivatives of an output may change by rounding
_ABSENT = 1e-10  # of the largest coefficient of an input: a derivative with less is not there


class HiddenConstraints(NamedTuple):
    """0 = M x + M_v v + M_θ θ at N times."""

    states: Array  # (N, n, n) M
    driving: Array  # (N, n, driving signals)
    unknowns: Array  # (N, n, q)
    # (n, n) units in the last place that entries of M may be wrong by, the most at some times
    rounding: Array


class Equations(NamedTuple):
    """A plant's matrices at N times; a leading axis of 1 means constant in time."""

    E: Array  # (N, n, n)
    A: Array  # (N, n, n)
    B: Array  # (N, n, v) of the driving signals
    F: Array  # (N, n, q)
    C: Array  # (N, r, n)
    D: Array  # (N, r, v) of the driving signals
    H: Array  # (N, r, q)
    hidden: HiddenConstraints | None


@dataclass(frozen=True, eq=False)
class InputDerivatives:
    """What is known of the derivatives of the inputs."""

    known: BoolArray  # (m,) of which inputs they are
    # times (N,), where functions that jump are decided, order -> Taylor coefficients
    taylor: Callable[[Array, Array, int], Array]  # (order + 1, N, m)
    exact: bool = True  # whether they are those of the inputs, not of what stands for their samples

    @classmethod
    def of_plant(cls, system: DescriptorSystem, known: BoolArray) -> InputDerivatives:
        """Exact ones, of the inputs (m,) that are the plant's own functions of time."""
        source = system.coefficients.of_time
        return cls(known, lambda t, inside, order: source.taylor(t, order, inside).u)

    @classmethod
    def of_signal(cls, inputs: Trajectory, known: BoolArray) -> InputDerivatives:
        """Those of the polynomials that stand for the ``known`` ones of measured inputs (m,)."""
        return cls(known, lambda t, inside, k: inputs.taylor(t, k, inside), exact=False)


@dataclass(frozen=True, eq=False)
class EquationForm:
    """A plant in the form that an observer takes."""

    system: DescriptorSystem
    units: Units
    structure: Structure | None = None  # of the strangeness-free form; None: as given
    # Derivatives that hidden constraints contain: (order, input); of each from ``inputs``.
    derivatives: tuple[tuple[int, int], ...] = ()
    inputs: InputDerivatives | None = None
    held: bool = True  # a term of the observer pulls w onto hidden constraints

    @classmethod
    def given(
        cls, system: DescriptorSystem, inputs: InputDerivatives | None = None,
        t: Array = np.zeros(1), inside: Array | None = None, signals: Array | None = None,  # noqa: B008
    ) -> EquationForm:
        """As given, in the units of the plant at its start: what comes later changes no unit.

        With what is known of derivatives of ``inputs``; the start is the first of the times t (N,),
        functions that jump are decided at ``inside``, and [u; y] (N, m + r) are for matrices that
        follow them.
        """
        t, inside = t[:1], (t if inside is None else inside)[:1]
        plain = cls(system, Units.plain(system), inputs=inputs)
        along = plain.along(t, inside, None if signals is None else signals[:1], 0)
        # Functions from Python need have no derivatives.
        order = 0 if isinstance(system.coefficients, FunctionCoefficients) else _SEEN
        units = units_at(system.coefficients.taylor(t, order, inside, along))
        return cls(system, units, inputs=inputs)

    @property
    def known_term(self) -> bool:
        """Whether there is a φ."""
        return "phi" not in self.system.coefficients.zero

    @property
    def interpolated(self) -> tuple[int, ...]:
        """Inputs whose derivatives in hidden constraints are those of an interpolant."""
        if self.inputs is None or self.inputs.exact:
            return ()
        used, names = {j for _, j in self.derivatives}, self.system.inputs
        if self.structure is not None and self.structure.mu:
            used |= {j for j, name in enumerate(names) if name in self.system.followed}
        return tuple(sorted(used))

    def noise_enters(self, noisy: BoolArray) -> tuple[str, ...]:
        """Which of the ``noisy`` ones of [u; y] (m + r,) have their noise in matrices or slopes."""
        names = self.system.followed.union(self.system.inputs[j] for j in self.interpolated)
        both = compress((*self.system.inputs, *self.system.outputs), noisy)
        return tuple(name for name in both if name in names)

    def driving(self, t: Array, inside: Array, signals: Array) -> Array:
        """[v; y] (N, v + r, 1) at the times t (N,), from the measured [u; y] (N, m + r)."""
        if not (self.derivatives or self.known_term):
            return signals[:, :, None]
        m = self.system.m
        parts = [signals[:, :m]]
        if self.derivatives and self.inputs is not None:
            order = max(k for k, _ in self.derivatives)
            taylor = self.inputs.taylor(t, inside, order)
            parts += [taylor[k, :, j : j + 1] for k, j in self.derivatives]
        if self.known_term:
            parts.append(np.ones((len(signals), 1)))
        return np.concatenate([*parts, signals[:, m:]], axis=1)[:, :, None]

    def equations(
        self, t: Array, inside: Array, signals: Array | None, slopes: Array | float = 0.0
    ) -> Equations:
        """The matrices at the times t (N,), along the signals [u; y] (N, m + r) if they follow any.

        Derivatives of y count as ``slopes`` (μ, 1, r), which :func:`strangeness_free` shows to be
        without effect.
        """
        system, source = self.system, self.system.coefficients
        order = 0 if self.structure is None else self.structure.mu
        along = self.along(t, inside, signals, order)
        if along is not None:
            along[1:, :, system.m :] = slopes
        c = source.taylor(t, order, inside, along)

        def value(name: str) -> Array:
            matrix: Array = getattr(c, name)[0]
            return matrix[:1] if name in source.constant else matrix

        extra = len(self.derivatives)
        B, D = value("B"), value("D")
        if extra or self.known_term:
            phi = value("phi")[:, :, None] if self.known_term else np.zeros((1, system.n, 0))
            B = joined(B, np.zeros((1, system.n, extra)), phi, axis=2)
            D = joined(D, np.zeros((1, system.r, extra + phi.shape[2])), axis=2)
        hidden = None
        if self.structure is not None:
            hidden = hidden_constraints(system, self.structure, self.units.states, t, c)
            # Of all driving signals [u_0 … u_μ, 1] those that this form has.
            chosen = [*range(system.m), *(k * system.m + j for k, j in self.derivatives)]
            if self.known_term:
                chosen.append(hidden.driving.shape[2] - 1)
            hidden = hidden._replace(driving=hidden.driving[:, :, chosen])
        return Equations(
            value("E"), value("A"), B, value("F"), value("C"), D, value("H"), hidden
        )

    def mass(
        self, t: Array, inside: Array, signals: Array | None, order: int = 0
    ) -> Array:
        """E or its derivative Ė (order 1) at the times t (N,), (N, n, n).

        They follow no signal; any at which the other matrices have values will do.
        """
        along = self.along(t, inside, signals, 0)
        return np.asarray(self.system.coefficients.taylor(t, order, inside, along).E[order])

    def along(
        self, t: Array, inside: Array, signals: Array | None, order: int
    ) -> Array | None:
        """Taylor coefficients of [u, y] (order + 1, N, m + r), of y and unknown u's values only."""
        if not self.system.followed:
            return None
        if signals is None:
            raise ValueError("the matrices follow signals, and none are given")
        along = np.zeros((order + 1, *signals.shape))
        if order and self.inputs is not None:
            along[:, :, : self.system.m] = self.inputs.taylor(t, inside, order)
        along[0] = signals
        return along


def hidden_constraints(
    system: DescriptorSystem, structure: Structure, units: Array, t: Array, c: Coefficients
) -> HiddenConstraints:
    """M, M_v and M_θ at the times t (N,), with v = [u, u', …, u^(μ)/μ!, 1].

    In ``units`` of the states (n,), M is an orthogonal projector; ``c`` is the model to the order
    μ.
    """
    mu, s, n = structure.mu, structure.scaling, system.n
    count = slice(0, 1) if structure.time_invariant else slice(None)
    E, A = c.E[:, count], c.A[:, count]
    weights = (s.time ** np.arange(mu + 1))[:, None] * s.rows
    blocks = np.zeros((mu + 1, len(t), n, mu + 1, system.m))
    for i in range(mu + 1):
        for k in range(i + 1):
            blocks[i, :, :, k] = c.B[i - k]
    parts = blocks.reshape(mu + 1, len(t), n, -1), c.phi[..., None], c.F
    g = np.concatenate(
        [np.broadcast_to(part, (mu + 1, len(t), n, part.shape[3])) for part in parts], axis=3
    )
    every = max(1, len(t) // LOOKS)
    A2, f2, made_of, _ = reduced(system, structure, E, A, g, t, every)
    terms = np.abs(g * weights[:, None, :, None]).max(axis=(0, 2))[:, None, :]
    A2 = A2 * (units / s.columns)
    # Rows of equal size first: they are of any size, and the factors below are then of order one.
    size = np.maximum(np.abs(A2).max(axis=2, keepdims=True), np.finfo(float).tiny)
    f2 = without_rounding(f2 / size, terms)
    Q, R = np.linalg.qr(transpose(without_rounding(A2 / size)))  # Â2 = RᵀQᵀ
    inverse = Q @ transpose(np.linalg.inv(R))
    inward = exact_product(inverse, f2)  # Â2⁺ [f̂_v | f̂_θ]
    made_of = made_of[:, :, :n] / s.columns / size[::every]
    driving = (mu + 1) * system.m + 1
    return HiddenConstraints(
        without_rounding(Q @ transpose(Q)) / units,
        inward[:, :, :driving], inward[:, :, driving:],
        (np.abs(inverse[::every]) @ made_of).max(axis=0),
    )


def strangeness_free(
    given: EquationForm, t: Array, inside: Array, signals: Array | None, *, max_mu: int,
    rank_tol: float, ahead: float = 1.0,
) -> EquationForm:
    """The strangeness-free form, for a horizon that the times t (N,) span, or ``ahead`` seconds.

    By these times is judged which derivatives of inputs there are. ``signals`` are [u; y] there (N,
    m + r), for matrices that follow them (ConfigError: a derivative is needed of an input, or of an
    output, of which it is not known; ModelError: the equations do not determine the states).
    """
    system, inputs = given.system, given.inputs
    source = system.coefficients
    if len(t) == 1:  # of samples that are still to come nothing is known but the plant
        t = inside = t + ahead * _AHEAD
        signals = None if signals is None else np.repeat(signals, len(t), axis=0)
    known = system
    if system.depends_on_outputs and signals is not None:
        def between(at: Array, order: int, inside: Array) -> Coefficients:
            """The matrices at times (M,), with signals interpolated between known ones."""
            seen = np.stack([np.interp(at, t, signal) for signal in signals.T], axis=1)
            return source.taylor(at, order, inside, given.along(at, inside, seen, order))

        known = replace(system, coefficients=Changed(source, between))
    try:
        structure = analyse(known, float(t[0]), float(t[-1]), max_mu=max_mu, rank_tol=rank_tol)
    except ModelError as error:
        follows = [name for name in system.outputs if name in system.followed]
        known_too = f"takes {listed(follows)} as known, and " if follows else ""
        raise ModelError(
            f"{error} (observer.form=strangeness_free {known_too}leaves out the equations of the "
            "outputs, which observer.form=given takes, too)"
        ) from None
    whole = replace(given, structure=structure, derivatives=tuple(
        (k, j) for k in range(1, structure.mu + 1) for j in range(system.m)
    ))
    for j, name in enumerate(system.inputs):
        if name in system.followed and structure.mu and (inputs is None or not inputs.known[j]):
            raise ConfigError(_unknown(system, name, "the equations contain it"))
    found = whole.equations(t, inside, signals).hidden
    assert found is not None  # noqa: S101  there is a structure
    if structure.mu and signals is not None:
        _refuse_slopes(whole, found, t, inside, signals)
    m, orders = system.m, np.arange(structure.mu + 1)
    driving = np.abs(found.driving[:, :, : m * len(orders)]).max(axis=0, initial=0.0)
    of_order = driving.max(axis=0, initial=0.0).reshape(len(orders), m)
    of_order /= structure.scaling.time ** orders[:, None]
    used = [(k, j) for k, j in whole.derivatives if of_order[k, j] > _ABSENT * of_order[:, j].max()]
    for k, j in used:
        if inputs is None or not inputs.known[j]:
            # M is a projector: its rows, weighted by the column of the derivative, are that.
            weight = driving[:, m * k + j]
            of = [*compress(system.states, weight > _ABSENT * weight.max())]
            raise ConfigError(_unknown(
                system, system.inputs[j],
                f"a hidden constraint on {listed(of)} contains its derivative of order {k}",
            ))
    return replace(whole, derivatives=tuple(used))


def _refuse_slopes(
    form: EquationForm, found: HiddenConstraints, t: Array, inside: Array, signals: Array
) -> None:
    """Refuse hidden constraints that change with the derivatives of an output."""
    system, structure = form.system, form.structure
    for j, name in enumerate(system.outputs):
        if name not in system.followed or structure is None:
            continue
        slopes = np.zeros((structure.mu, 1, system.r))
        size = float(np.abs(signals[:, system.m + j]).max()) or 1.0
        slopes[..., j] = size / structure.scaling.time ** np.arange(1, structure.mu + 1)[:, None]
        try:
            moved = form.equations(t, inside, signals, slopes).hidden
            same = moved is not None and all(
                np.abs(a - b).max(initial=0.0) <= _MOVED * np.abs(a).max(initial=0.0)
                for a, b in zip(found[:3], moved[:3], strict=True)
            )
        except ModelError:  # not even its rank is the same
            same = False
        if not same:
            raise ConfigError(
                f"plant {system.name}: observer.form=strangeness_free: a hidden constraint "
                f"contains the derivative of the output {name}, which is measured only"
            )


def _unknown(system: DescriptorSystem, name: str, why: str) -> str:
    return (
        f"plant {system.name}: observer.form=strangeness_free needs the derivatives of the input "
        f"{name}, {why}; of samples and of noisy signals they are not known; of a recording, "
        "data.hold=cubic takes those of its interpolant, which amplify its noise"
    )
