"""A form of the equations on which an observer runs, and where its dynamic extension starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.numerics.linalg import exact_product
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.observers._base import ByName, Measurements, initial_extension, output_scale
from gpebo_cli.observers.reduced.matrices import (
    Injection,
    NotObservableError,
    ObserverMatrices,
    observer_matrices,
    refuse_between,
)
from gpebo_cli.observers.reduced.partial import untouched
from gpebo_cli.observers.reduced.split import initial_basis, units_along
from gpebo_cli.reduction.form import EquationForm, InputDerivatives, strangeness_free
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.schema import nearest, shown
from gpebo_cli.settings import SolverSettings

_MADE_OF = frozenset({*"EABFCDH", "phi"})  # what the observer's matrices are made of
AT_ONCE = 1 << 15  # points: what is made of all of them at once is what takes the memory
SMALL = 8  # coordinates of w, up to which dense collocation is faster


class Start(NamedTuple):
    """Where the dynamic extension starts at some time: w = offset + from_unknowns θ − V (e − ξ_a0).

    Of the equations as given every w in the range of P may be one, and offset and from_unknowns are
    zero. Hidden constraints leave d of n_a dimensions.
    """

    basis: Array  # (n, d) V, with
    dual: Array  # (d, n)
    names: tuple[str, ...]  # of e's components
    offset: Array  # (n,)
    from_unknowns: Array  # (n, q)

    def extension(self, dual: Array, xi_a: Array) -> Array:
        """[ξ_a | ξ_b | Φ] = dual [ξ_a | from_unknowns | V], for dual (k, n), (k, 1 + q + d)."""
        whole = np.concatenate([xi_a[:, None], self.from_unknowns, self.basis], axis=1)
        return np.asarray(dual @ whole)


@dataclass(frozen=True, eq=False)
class Formulation:
    """What an observer has along signals and at samples: equations, their matrices, a start."""

    form: EquationForm
    solver: SolverSettings
    first: ObserverMatrices  # without injection, those of the start first; their basis is kept
    begin: Start  # at the start
    xi_a0: Array  # (d,) where the extension starts, in the coordinates of its basis
    regression: str  # projected: all rows of the residual, paper: the last r
    note: str  # which form is used, where that was not said, and why

    @property
    def system(self) -> DescriptorSystem:
        """The plant."""
        return self.form.system

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of what is estimated, θ and the components of e₀."""
        return (*self.system.unknowns, *self.begin.names)

    @property
    def parameter_units(self) -> Array:
        """In which these are comparable, (p,)."""
        units = self.form.units
        return np.append(units.unknowns, units_along(self.begin.basis, units.states))

    @property
    def basis(self) -> Array:
        """Coordinates in which w is integrated, (n, k): n_a of them, or n if the kernel rotates."""
        return self.first.split.basis

    @cached_property
    def units(self) -> Array:
        """Of w's coordinates, (k,)."""
        return units_along(self.basis, self.form.units.states)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of w's coordinates, (k,)."""
        return self.first.split.coordinates(self.system.states, self.form.units.states)

    @property
    def xi_a(self) -> Array:
        """ξ_a at the start, (n,)."""
        return np.asarray(self.begin.offset + self.begin.basis @ self.xi_a0)

    @cached_property
    def start(self) -> Array:
        """[ξ_a | ξ_b | Φ] at the start, (k, 1 + q + d)."""
        return self.begin.extension(self.first.split.dual, self.xi_a)

    def needed(
        self, rank: int, injective: Mapping[str, float], *, holds: bool = True
    ) -> tuple[Assumption, ...]:
        """Rank of E and Assumption 1, and which form of the equations is used, and why."""
        used: dict[str, float | int | str | None] = {
            **injective, "form": "given" if self.form.structure is None else "strangeness_free",
            **({"because": self.note.removeprefix("; ")} if self.note else {}),
        }
        return (
            Assumption(
                "Rank of E", "rank E(t) is constant", True, {"rank": rank, "states": self.system.n}
            ),
            Assumption(
                "Assumption 1", "impulse observability: [ΠA; C] is injective on the kernel of E(t)",
                holds, used,
            ),
        )


@dataclass(frozen=True, eq=False)
class ReducedSystem(Formulation):
    """w' = A_0 w + b_0 + D_0 θ and 0 = R (𝒜 w + g_y + G θ) on measured signals."""

    signals: Measurements
    mesh: Mesh  # where to start integrating
    lost: BoolArray | None = None  # (n,) states that a failure of Assumption 1 touches
    injection: Injection | None = None

    def matrices(self, t: Array, inside: Array) -> ObserverMatrices:
        """The matrices at the times t (N,), with output injection."""
        o = self._constant or self._moving(t, inside)
        return o if self.injection is None else o.injected(self.injection(o, t, inside))

    @cached_property
    def _constant(self) -> ObserverMatrices | None:
        held = self.form.held  # as the first ones are
        if not held or self.system.followed or _MADE_OF - self.system.coefficients.constant:
            return None
        return self.first.at_first

    def _moving(self, t: Array, inside: Array) -> ObserverMatrices:
        signals = self.signals.at(t, inside, self.system) if self.system.followed else None
        return observer_matrices(
            self.form, t, inside, self.solver.rank_tol, self.first, signals=signals
        )

    def measured(self, t: Array, inside: Array) -> Array:
        """[v; y] (N, v + r, 1) at the times t (N,)."""
        return self.form.driving(t, inside, self.signals.at(t, inside))

    def start_at(self, time: float, inside: float) -> Start:
        """The start of an extension that begins at a later time."""
        t, t_in = np.array([time]), np.array([inside])
        return start_at(self.form, self.matrices(t, t_in), self.measured(t, t_in))

    def assumptions(self, weakest: tuple[float, float]) -> tuple[Assumption, ...]:
        """Rank of E and Assumption 1: the ``weakest`` singular value, and its time."""
        split = self.first.split
        rank = split.rank if split.frame is None else split.frame.domain.shape[1]
        of = "smallest_singular_value" + ("" if self.lost is None else "_of_the_rest")
        evidence = dict(zip((of, "at"), weakest, strict=True))
        return self.needed(rank, evidence, holds=self.lost is None)


def reduced_system(
    system: DescriptorSystem, signals: Measurements, solver: SolverSettings, *,
    xi_a0: Mapping[str, float] | list[float] | None = None, weights: ByName | None = None,
    regression: str = "projected", form: str = "auto", unknown: Sequence[str] | None = None,
    in_part: bool = False, units: Units | None = None,
) -> ReducedSystem:
    """The reduced system on measured signals, with settings of the observer.

    ``unknown`` is ``observer.unknown_initial``. ``in_part`` asks for what is left without that
    which a failure of Assumption 1 touches.
    """
    mesh = signals.mesh
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    signals.check_memory(system)
    along = partial(signals.at, system=system) if system.coefficients.signals else None
    at, lost = along(t, inside) if along else None, None
    if units is None and (like := signals.like):
        begin_t, within = like.mesh.points.ravel()[:1], like.mesh.inside.ravel()[:1]
        seen = like.at(begin_t, within, system) if along else None
        units = EquationForm.given(system, None, begin_t, within, seen).units
    try:
        used, first, note = choose_form(
            system, t, inside, at, signals.derivatives, solver, form, weights, units,
            piecewise=system.n <= SMALL and len(mesh.windows()) > 1, along=along,
        )
    except NotObservableError as error:
        used = EquationForm.given(system, signals.derivatives, t, inside, at)
        used = used if units is None else replace(used, units=units)
        left = untouched(used, t, inside, at, solver.rank_tol) if in_part else None
        if left is None:
            raise
        frame, lost = left
        first = observer_matrices(
            used, t, inside, solver.rank_tol, output_scale=output_scale(weights, system),
            signals=at, frame=frame,
        )
        note = f"; {_reason(error)}: what it touches is not estimated"
    now = np.concatenate([part.values[0, :1] for part in (signals.inputs, signals.outputs)], axis=1)
    begin = start_at(used, first, used.driving(t[:1], inside[:1], now))
    start = begin_at(xi_a0, used, first, begin)
    if unknown is not None:
        begin, start = with_unknown(begin, start, unknown, xi_a0, system)
    return ReducedSystem(
        used, solver, first, begin, start, regression, note, signals, mesh, lost
    )


def choose_form(
    system: DescriptorSystem, t: Array, inside: Array, signals: Array | None,
    derivatives: InputDerivatives | None, solver: SolverSettings, form: str,
    weights: ByName | None, units: Units | None = None, *, piecewise: bool = False,
    ahead: float = 1.0, along: Callable[[Array, Array], Array] | None = None,
) -> tuple[EquationForm, ObserverMatrices, str]:
    """The form of the equations, its matrices at the times t (N,), and why it is this one.

    The first time is that of the start. A plant whose matrices follow signals needs [u; y]
    (N, m + r) there, which ``along`` knows in between, and hidden constraints the derivatives of
    inputs, as far as they are known; of a single time the structure is judged by the plant over the
    seconds ``ahead``. ``units`` are those in which everything counts; None: of the plant at the
    start. ``piecewise`` the matrices are looked at piece by piece, and those of the first times do,
    unless E moves (ConfigError: a regression, no outputs, wrong weights, a derivative of an input
    that is not known).
    """
    if system.regression is not None:
        raise ConfigError(
            f"regression {system.name} goes with observer=regression (`- override /observer: "
            "regression` in a recipe); this observer is for plants"
        )
    if system.r == 0:
        raise ConfigError(
            f"plant {system.name}: the observer needs outputs and C; without them use observer=none"
        )
    scale = output_scale(weights, system)

    def matrices(chosen: EquationForm) -> ObserverMatrices:
        def at(part: slice, like: ObserverMatrices | None = None) -> ObserverMatrices:
            found = observer_matrices(
                chosen, t[part], inside[part], solver.rank_tol, like, output_scale=scale,
                signals=None if signals is None else signals[part],
            )
            if chosen.structure is None:
                refuse_between(chosen, found, t[part], solver.rank_tol, along)
            return found

        if not piecewise or chosen.structure or "E" not in system.coefficients.constant:
            return at(slice(None))
        first = at(slice(AT_ONCE))
        for k in range(AT_ONCE, len(t), AT_ONCE):
            at(slice(k, k + AT_ONCE), first)
        return first

    note, given = "", EquationForm.given(system, derivatives, t, inside, signals)
    given = given if units is None else replace(given, units=units)
    if form != "strangeness_free":
        try:
            return given, matrices(given), note
        except NotObservableError as error:
            if form == "given":
                raise
            note = f"; observer on the strangeness-free form, for as given {_reason(error)}"
    hidden = strangeness_free(
        given, t, inside, signals,
        max_mu=solver.max_strangeness_index, rank_tol=solver.rank_tol, ahead=ahead,
    )
    for j in hidden.interpolated:
        name = system.inputs[j]
        note += f"; derivatives of {name} are its interpolant's, which amplify its noise"
    return hidden, matrices(hidden), note


def _reason(error: NotObservableError) -> str:
    """What fails and where; the name of the plant and advice are left out."""
    return str(error).rpartition("; ")[0].partition(": ")[2]


def start_at(form: EquationForm, o: ObserverMatrices, signals: Array) -> Start:
    """The start at one time, from matrices there (and perhaps later) and [v; y] (1, v + r, 1).

    With 0 = N_c w + g_c + G_c θ the residual of the equations without outputs,
    w = −N_c⁺(g_c + G_c θ) + V z, V of the kernel of N_c.
    """
    rank, states = o.split.rank, form.system.states
    units = form.units.states
    own = o.split.projector[0] * units / units[:, None]  # P in comparable units
    n, q = form.system.n, form.system.q
    if form.structure is None or form.structure.d == rank:
        return Start(*initial_basis(own, rank, states, units), np.zeros(n), np.zeros((n, q)))
    o, V1 = o.at_first, initial_basis(own, rank, states, np.ones(n))[0]
    exact = slice(0, o.algebraic.shape[1] - o.outputs)
    seen = o.equations(signals)
    R = o.residual[0][exact]
    U, sigma, Vt = np.linalg.svd(R @ o.algebraic[0] @ (units[:, None] * V1))
    d = form.structure.d
    known = (Vt[: rank - d].T / sigma[: rank - d]) @ U[:, : rank - d].T @ R
    free = V1 @ Vt[rank - d :].T
    inward = units[:, None] * V1 @ known
    return Start(
        *initial_basis(free @ free.T, d, states, units),
        -inward @ seen.g_y[0], exact_product(inward[None], -seen.G)[0],
    )


def begin_at(
    xi_a0: Mapping[str, float] | list[float] | None, form: EquationForm, o: ObserverMatrices,
    begin: Start,
) -> Array:
    """``observer.xi_a0``, of the differential states, in the coordinates of the start, (d,)."""
    system, units = form.system, form.units.states
    P, frame = o.split.projector[0], o.split.frame
    if frame is not None:  # with what may have been given up
        P = frame.projector
    rank = int(np.rint(P.trace()))
    if rank == len(begin.names):  # then these are the differential states
        return initial_extension(xi_a0, system, begin.names)
    V1, _, names = initial_basis(P * units / units[:, None], rank, system.states, units)
    return np.asarray(begin.dual @ V1 @ initial_extension(xi_a0, system, names))


def with_unknown(
    begin: Start, xi_a0: Array, unknown: Sequence[str], given: ByName | None,
    system: DescriptorSystem,
) -> tuple[Start, Array]:
    """The start with errors of the ``unknown`` states only, and ξ_a0 of these, from those of all.

    The others start where the plant's ``initial_state`` says, or ``observer.xi_a0`` as ``given``
    (ξ_a0 (d,) of all), and e₀ has no component for them: Φ has fewer columns (ConfigError: no
    differential state, or errors that are not those of single states).
    """
    names = [name.removeprefix("e0_") for name in begin.names]
    for name in unknown:
        if name not in names:
            if name in system.states and not set(names) <= set(system.states):
                raise ConfigError(
                    f"observer.unknown_initial: {shown(name)} has no initial error of its own: "
                    f"{', '.join(begin.names[:2])}, … are of combinations of states; leave "
                    "unknown_initial away, or name none ([])"
                )
            raise ConfigError(
                f"observer.unknown_initial: {shown(name)} is no differential state"
                f"{nearest(name, names)} (differential states: {', '.join(names[:8])}"
                f"{', …' if len(names) > 8 else ''})"
            )
    chosen = np.array([name in unknown for name in names], dtype=bool)
    said = set(given) if isinstance(given, Mapping) else set(names if given is not None else ())
    own = np.array([name in said for name in names], dtype=bool)
    start = np.where(own, xi_a0, begin.dual @ system.initial_state)
    known = begin.basis[:, ~chosen] @ start[~chosen]
    return begin._replace(
        basis=begin.basis[:, chosen], dual=begin.dual[chosen], offset=begin.offset + known,
        names=tuple(name for name, used in zip(begin.names, chosen, strict=True) if used),
    ), xi_a0[chosen]
