"""The dynamic extension [ξ_a | ξ_b | Φ] on measured signals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.numerics import series
from gpebo_cli.numerics.collocation import LinearSolution, solve
from gpebo_cli.numerics.linalg import exact_product, largest_over_time
from gpebo_cli.numerics.mesh import Kind, Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.observers._base import (
    ByName,
    Measurements,
    initial_extension,
    largest_entry,
    log_norm,
    output_scale,
)
from gpebo_cli.observers.reduced.matrices import (
    AlgebraicEquations,
    Injection,
    NotObservableError,
    ObserverMatrices,
    observer_matrices,
    weakest,
)
from gpebo_cli.observers.reduced.partial import untouched
from gpebo_cli.observers.reduced.regression import (
    OVER_TIME,
    Assembled,
    regression_signals,
    resolve,
    term_sizes,
)
from gpebo_cli.observers.reduced.split import comparable, initial_basis, units_along
from gpebo_cli.reduction.form import EquationForm, InputDerivatives, strangeness_free
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.schema import nearest, shown
from gpebo_cli.settings import SolverSettings
from gpebo_cli.simulation import ivp

_AT_ONCE = 1 << 15  # points: what is made of all of them at once is what takes the memory
_SMALL = 8  # coordinates of w, up to which dense collocation is faster
_LARGEST = 1e60  # entry of the dynamic extension: squares of squares are still numbers


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


def measured(form: EquationForm, t: Array, inside: Array, u: Array, y: Array) -> Array:
    """[v; y] (N, v + r, 1) from u (N, m) and y (N, r) at the times t (N,), v as the form has it."""
    return np.concatenate([form.driving(t, inside, u), y], axis=1)[:, :, None]


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
    xi_a0: Mapping[str, float] | list[float] | None, system: DescriptorSystem,
    units: Array, o: ObserverMatrices, begin: Start,
) -> Array:
    """``observer.xi_a0``, of the differential states, in the coordinates of the start, (d,)."""
    P, frame = o.split.projector[0], o.split.frame
    if frame is not None:  # with what may have been given up
        P = frame.projector
    rank = int(np.rint(np.trace(P)))
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


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """w' = A_0 w + b_0 + D_0 θ and 0 = R (𝒜 w + g_y + G θ) on measured signals."""

    form: EquationForm
    signals: Measurements
    solver: SolverSettings
    mesh: Mesh  # where to start integrating
    first: ObserverMatrices  # at the points of the signals' mesh, without injection
    begin: Start  # at the start
    xi_a0: Array  # (d,) where the extension starts, in the coordinates of its basis
    regression: str  # projected: all rows of the residual, paper: the last r
    note: str = ""  # which form is used, where that was not said, and why
    lost: BoolArray | None = None  # (n,) states that a failure of Assumption 1 touches
    injection: Injection | None = None

    @property
    def system(self) -> DescriptorSystem:
        """The plant."""
        return self.form.system

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

    def matrices(self, t: Array, inside: Array) -> ObserverMatrices:
        """The matrices at the times t (N,), with output injection."""
        signals = self.signals.at(t, inside, self.system) if self.form.follows_signals else None
        o = observer_matrices(
            self.form, t, inside, self.solver.rank_tol, self.first, signals=signals
        )
        return o if self.injection is None else o.injected(self.injection(o, t, inside))

    def measured(self, t: Array, inside: Array) -> Array:
        """[v; y] (N, v + r, 1) at the times t (N,)."""
        u, y = self.signals.inputs(t, inside), self.signals.outputs(t, inside)
        return measured(self.form, t, inside, u, y)

    def start_at(self, time: float, inside: float) -> Start:
        """The start of an extension that begins at a later time."""
        t, t_in = np.array([time]), np.array([inside])
        return start_at(self.form, self.matrices(t, t_in), self.measured(t, t_in))

    def start(self) -> Array:
        """[ξ_a | ξ_b | Φ] at the start, (k, 1 + q + d)."""
        return self.begin.extension(self.first.split.dual, self.xi_a)

    @property
    def xi_a(self) -> Array:
        """ξ_a at the start, (n,)."""
        return np.asarray(self.begin.offset + self.begin.basis @ self.xi_a0)


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
    at = signals.at(t, inside, system) if system.coefficients.signals else None
    lost = None
    try:
        used, first, note = choose_form(
            system, t, inside, at, signals.derivatives, solver, form, weights, units,
            piecewise=in_part and system.n <= _SMALL and len(mesh.windows()) > 1,
        )
    except NotObservableError as error:
        used = as_given(system, t, inside, at, signals.derivatives)
        left = untouched(used, t, inside, at, solver.rank_tol) if in_part else None
        if left is None:
            raise
        frame, lost = left
        first = observer_matrices(
            used, t, inside, solver.rank_tol, output_scale=output_scale(weights, system),
            signals=at, frame=frame,
        )
        note = f"; {_reason(error)}: what it touches is not estimated"
    u, y = signals.inputs.values[0, :1], signals.outputs.values[0, :1]
    begin = start_at(used, first, measured(used, t[:1], inside[:1], u, y))
    start = begin_at(xi_a0, system, used.units.states, first, begin)
    if unknown is not None:
        begin, start = with_unknown(begin, start, unknown, xi_a0, system)
    return ReducedSystem(
        used, signals, solver, mesh, first, begin, start, regression, note, lost
    )


def choose_form(
    system: DescriptorSystem, t: Array, inside: Array, signals: Array | None,
    derivatives: InputDerivatives | None, solver: SolverSettings, form: str,
    weights: ByName | None, units: Units | None = None, *, piecewise: bool = False,
) -> tuple[EquationForm, ObserverMatrices, str]:
    """The form of the equations, its matrices at the times t (N,), and why it is this one.

    The first time is that of the start. A plant whose matrices follow signals needs [u; y]
    (N, m + r) there, and hidden constraints the derivatives of inputs, as far as they are known.
    ``units`` are those in which everything counts; None: of the plant at the start. ``piecewise``
    the matrices are looked at piece by piece, and those of the first times do, unless E moves
    (ConfigError: no outputs, wrong weights, a derivative of an input that is not known).
    """
    if system.r == 0:
        raise ConfigError(
            f"plant {system.name}: the observer needs outputs and C; without them use observer=none"
        )
    scale = output_scale(weights, system)

    def matrices(chosen: EquationForm) -> ObserverMatrices:
        def at(part: slice, like: ObserverMatrices | None = None) -> ObserverMatrices:
            return observer_matrices(
                chosen, t[part], inside[part], solver.rank_tol, like, output_scale=scale,
                signals=None if signals is None else signals[part],
            )

        if not piecewise or chosen.structure or "E" not in system.coefficients.constant:
            return at(slice(None))
        first = at(slice(_AT_ONCE))
        for k in range(_AT_ONCE, len(t), _AT_ONCE):
            at(slice(k, k + _AT_ONCE), first)
        return first

    note, given = "", as_given(system, t, inside, signals, derivatives)
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
        max_mu=solver.max_strangeness_index, rank_tol=solver.rank_tol,
    )
    for j in hidden.interpolated:
        name = system.inputs[j]
        note += f"; derivatives of {name} are its interpolant's, which amplify its noise"
    return hidden, matrices(hidden), note


def as_given(
    system: DescriptorSystem, t: Array, inside: Array, signals: Array | None,
    derivatives: InputDerivatives | None,
) -> EquationForm:
    """The form as given in the units of the first of the times t (N,)."""
    at = t[:1], inside[:1], None if signals is None else signals[:1]
    return EquationForm.given(system, derivatives, at)


def _reason(error: NotObservableError) -> str:
    """What fails and where; the name of the plant and advice are left out."""
    return str(error).rpartition("; ")[0].partition(": ")[2]


@dataclass(frozen=True, eq=False)
class Extension:
    """The dynamic extension on the mesh that resolves it and everything computed from it."""

    trajectory: Trajectory  # [ξ_a | ξ_b | Φ] (k, 1 + q + n_a)
    error_estimate: float  # relative to each signal's own size, the largest
    assembled: Assembled
    scale: Array  # (K, p) size of the terms of each column of ψ so far, element by element
    units: Array  # (k,) of the coordinates
    weakest: tuple[float, float]  # smallest singular value behind Assumption 1, and its time

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return self.trajectory.mesh

    def growth(self, q: int) -> tuple[float, float]:
        """Largest entry of Φ in comparable units, in which its columns start at size 1.

        And ln ‖Φ(end)‖₂, which is 0 at the start.
        """
        values = self.trajectory.values
        some = np.stack([values[0, 0], self.assembled.largest, values[-1, -1]])
        Phi = comparable(some[..., 1 + q :], self.units)
        return largest_entry(Phi), log_norm(Phi[-1])


def extend(reduced: ReducedSystem, mesh: Mesh, start: Array) -> Extension:
    """Integrate [ξ_a | ξ_b | Φ] from ``start`` (k, 1 + q + n_a) over ``mesh``, refined."""
    system, solver, basis = reduced.system, reduced.solver, reduced.basis
    q, columns = system.q, start.shape[1]
    large = len(start) > _SMALL and solver.name != "ivp"

    # What is integrated is in comparable units, as written where these are.
    of_rows, of_columns = reduced.units, np.ones(columns)
    of_columns[1 : 1 + q] = reduced.form.units.unknowns
    of_columns[1 + q :] = units_along(start[:, 1 + q :], of_rows)
    units = of_rows[:, None] / of_columns
    plain = bool((units == 1.0).all())

    def equations(o: ObserverMatrices, signals: Array) -> LinearEquation:
        f, seen = o.forcing(signals, 1 + q if large else columns), o.equations(signals)
        if plain:
            return LinearEquation(None, o.dynamics, f, seen)
        A = o.dynamics * of_rows / of_rows[:, None]
        return LinearEquation(None, A, f / units[:, : f.shape[2]], seen)

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        return equations(reduced.matrices(t, inside), reduced.measured(t, inside))

    name = f"observer of plant {system.name}"
    # Along axes offset and gain are these components, each compared with its own state's size.
    on_axes = bool((np.abs(basis).sum(axis=0) == np.abs(basis).max(axis=0)).all())
    on_axes &= basis.shape[1] == reduced.first.split.rank  # else they lose what is eliminated
    axes = basis if on_axes and large and (basis.max(axis=0) == 1.0).all() else None
    monitor = _Monitor(system, basis, units, axes)
    problem = LinearProblem(coefficients, start / units, monitor, name, told=on_axes)
    known, signals = None, reduced.signals
    limits: dict[str, Any] = {"tol": solver.tol, "max_elements": solver.max_elements}
    windows = [mesh] if large or solver.name == "ivp" else mesh.windows()
    if windows[0] is signals.mesh and reduced.injection is None and solver.name != "ivp":
        u, y = _over_time(signals.inputs.values), _over_time(signals.outputs.values)
        points, inside = _over_time(mesh.points), _over_time(mesh.inside)
        known = equations(reduced.first, measured(reduced.form, points, inside, u, y))
    marched = series.solve_dense(problem, mesh, **limits, known=known) if large else None
    if marched is not None:
        return _assembled(reduced, _in_units(marched, units), monitor.latest, as_found=True)
    known, large, monitor.axes = None if large else known, False, None
    if len(windows) > 1:
        return joined(_over(windows, reduced, problem, monitor))
    own = ivp.solve if solver.name == "ivp" else partial(solve, known=known)
    solution = own(problem, mesh, **limits)
    return _assembled(reduced, _in_units(solution, units), monitor.latest, as_found=False)


class _Monitor:
    """Everything made of [ξ_a | ξ_b | Φ] that a mesh has to resolve.

    In front of a window stand those elements of windows before where something was largest: what
    has decayed is still measured by the size it had.
    """

    def __init__(
        self, system: DescriptorSystem, basis: Array, units: Array, axes: Array | None
    ) -> None:
        """For coordinates along a basis (n, k), in units (k, 1 + p); axes as of ``kinds``."""
        self._system, self._basis, self.units, self.axes = system, basis, units, axes
        self._past: Sequence[Array] = ()
        self._whole: Sequence[Array] = ()
        self.latest: Assembled  # with what stands in front

    def __call__(self, values: Array, extras: tuple[Array, ...]) -> Iterator[Kind]:
        """All signals with their floors; SolverError if the extension is beyond all bounds."""
        plain = bool((self.units == 1.0).all())
        self._whole = values if plain else values * self.units, *extras
        if self._past:
            self._whole = [
                own if own.shape[:2] == (1, 1) else np.concatenate([before, own])
                for before, own in zip(self._past, self._whole, strict=True)
            ]
        z, *seen = map(_over_time, self._whole)
        self.latest = regression_signals(
            z, self._system.q, self._basis, AlgebraicEquations(*seen)
        )
        if (self.latest.largest / self.units).max(initial=0.0) > _LARGEST:
            raise SolverError(
                f"the dynamic extension of plant {self._system.name} grows beyond {_LARGEST:.0e}: "
                "A_0 is unstable; use observer.remedy=output_injection, reset or "
                "current_coordinates, or a shorter time.horizon"
            )
        for signal, floor in self.latest.kinds(self.axes):
            if signal is not None:
                yield signal.reshape(*self._whole[0].shape[:2], -1), floor
            else:
                yield None, np.insert(floor / self.units[:, 1:], 0, np.inf, axis=1).ravel()

    def next_window(self, size: int) -> Assembled:
        """What is made of the window of that size, which comes to stand before the next one."""
        K, points = self._whole[0].shape[:2]
        where = self.latest.largest_at(points)
        self._past = [e if e.shape[:2] == (1, 1) else e[where] for e in self._whole]
        return self.latest.after((K - size) * points)


def _over(
    windows: Iterable[Mesh], reduced: ReducedSystem, problem: LinearProblem, monitor: _Monitor
) -> Iterator[Extension]:
    """The extension on one window after the other, so that little is held beside the result."""
    solver, units = reduced.solver, monitor.units
    for window in windows:
        solution = solve(problem, window, tol=solver.tol, max_elements=solver.max_elements)
        values = solution.trajectory.values
        problem = replace(
            problem, start=values[-1, -1], uncertain=solution.uncertain,
            floor=np.maximum(problem.floor, largest_over_time(values, 2)),
        )
        found = monitor.next_window(len(values))
        yield _assembled(reduced, _in_units(solution, units), found, as_found=False)


def joined(parts: Iterable[Extension]) -> Extension:
    """One extension of those on neighbouring meshes."""
    whole, rest = defaultdict[str, list[Array]](list), list[tuple[Any, ...]]()
    for part in parts:
        found = part.assembled
        whole["edges"].append(part.mesh.edges[:-1])
        whole["scale"].append(part.scale)
        whole["z"].append(part.trajectory.values)
        for name in OVER_TIME:
            whole[name].append(getattr(found, name))
        rest.append((part.error_estimate, part.weakest, found.Y_scale, found.column_scale,
                     found.largest, found.moving))
    whole["edges"].append(part.mesh.edges[-1:])
    errors, weak, of_Y, of_columns, largest, moving = zip(*rest, strict=True)
    # One after the other, so that no two of them are held twice.
    over_time: dict[str, Any] = {name: np.concatenate(whole.pop(name)) for name in [*whole]}
    mesh = Mesh(over_time.pop("edges"), part.mesh.rule)
    z, scale = over_time.pop("z"), over_time.pop("scale")
    return Extension(
        Trajectory(mesh, z), max(errors),
        replace(
            found, **over_time, Y_scale=max(of_Y), column_scale=np.max(of_columns, axis=0),
            largest=np.max(largest, axis=0), moving=np.max(moving, axis=0),
        ),
        np.maximum.accumulate(scale, axis=0), part.units, min(weak),
    )


def _assembled(
    reduced: ReducedSystem, solution: LinearSolution, found: Assembled, *, as_found: bool
) -> Extension:
    """What was found on the mesh, resolved but for ``as_found``, and sizes of its terms.

    These are looked at where each element begins, in its middle and where it ends.
    """
    system, values = reduced.system, solution.trajectory.values
    K, points = values.shape[:2]
    places = [0, (points - 1) // 2, points - 1]
    scale: list[Array] = []
    for first in range(0, K, max(1, _AT_ONCE // points)):
        part = slice(first, first + max(1, _AT_ONCE // points))
        z, *seen = (
            _over_time(e if e.shape[:2] == (1, 1) else e[part, places])
            for e in (values, *solution.extras)
        )
        of_gain, sizes = term_sizes(z, system.q, reduced.basis, AlgebraicEquations(*seen))
        elements = len(sizes) // 3
        scale.append(sizes.reshape(elements, 3, sizes.shape[1]).max(axis=1))
        if not as_found:
            terms = of_gain().reshape(elements, 3, system.n, -1).max(axis=1).repeat(points, axis=0)
            resolve(found, slice(first * points, part.stop * points), terms, reduced.form)
    sizes = np.maximum.accumulate(np.concatenate(scale), axis=0)
    *_, elimination, injectivity = map(_over_time, solution.extras)
    smallest, where = weakest(injectivity, elimination)
    at = float(solution.trajectory.mesh.points.ravel()[where])
    return Extension(
        solution.trajectory, solution.error_estimate, found, sizes, reduced.units, (smallest, at)
    )


def _in_units(solution: LinearSolution, units: Array) -> LinearSolution:
    """A solution whose components are multiplied by their units (k, columns)."""
    found = solution.trajectory
    if (units == 1.0).all():
        return solution
    return replace(solution, trajectory=Trajectory(found.mesh, found.values * units))


def _over_time(signal: Array) -> Array:
    """Values (K, s + 1, …) one point after the other, (K (s + 1), …)."""
    return signal.reshape(signal.shape[0] * signal.shape[1], *signal.shape[2:])


def assumptions(reduced: ReducedSystem, weakest: tuple[float, float]) -> tuple[Assumption, ...]:
    """Rank of E and Assumption 1, with their evidence: the ``weakest`` singular value, its time."""
    frame = reduced.first.split.frame
    left = None if frame is None else frame.remaining
    rank = reduced.first.split.rank + (0 if left is None else left.given_up.shape[1])
    of = "smallest_singular_value" + ("" if reduced.lost is None else "_of_the_rest")
    evidence = dict(zip((of, "at"), weakest, strict=True))
    return needed(reduced.form, reduced.note, rank, evidence, holds=reduced.lost is None)


def needed(
    form: EquationForm, note: str, rank: int, injective: Mapping[str, float], *, holds: bool = True
) -> tuple[Assumption, ...]:
    """Rank of E and Assumption 1, and which form of the equations is used, and why."""
    used: dict[str, float | int | str | None] = {
        **injective, "form": "given" if form.structure is None else "strangeness_free",
        **({"because": note.removeprefix("; ")} if note else {}),
    }
    return (
        Assumption(
            "Rank of E", "rank E(t) is constant", True, {"rank": rank, "states": form.system.n}
        ),
        Assumption(
            "Assumption 1", "impulse observability: [ΠA; C] is injective on the kernel of E(t)",
            holds, used,
        ),
    )
