"""The dynamic extension [ξ_a | ξ_b | Φ] on measured signals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics import series
from gpebo_cli.numerics.collocation import LinearSolution, solve
from gpebo_cli.numerics.errors import EPS, ROUNDING
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import Kind, Mesh, Samples, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.observers._base import log_norm
from gpebo_cli.observers.reduced.matrices import AlgebraicEquations, ObserverMatrices, weakest
from gpebo_cli.observers.reduced.regression import (
    OVER_TIME,
    Assembled,
    largest_at,
    regression_signals,
    resolve,
    term_sizes,
)
from gpebo_cli.observers.reduced.split import comparable, units_along
from gpebo_cli.observers.reduced.system import AT_ONCE, SMALL, ReducedSystem
from gpebo_cli.simulation import ivp

_LARGEST = 1e60  # entry of the dynamic extension: squares of squares are still numbers


@dataclass(frozen=True, eq=False)
class Extension:
    """The dynamic extension on the mesh that resolves it and everything computed from it."""

    trajectory: Trajectory  # [ξ_a | ξ_b | Φ] (k, 1 + q + n_a), perhaps at both ends only
    error_estimate: float  # relative to each signal's own size, the largest
    assembled: Assembled
    scale: Array  # (K, p) size of the terms of each column of ψ so far, element by element
    weakest: tuple[float, float]  # smallest singular value behind Assumption 1, and its time
    asked: Array | None = None  # (M,) times of the assembled offset and gain; None: all points

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return self.trajectory.mesh

    @property
    def state_map(self) -> tuple[Trajectory, Trajectory]:
        """Offset (n,) and gain (n, p) of the state."""
        mesh, found = self.mesh, self.assembled
        signal = mesh.trajectory if self.asked is None else partial(mesh.sampled, self.asked)
        return signal(found.offset), signal(found.gain)

    def rows(self, kept: IntArray) -> tuple[Trajectory, Trajectory]:
        """Y (rows,) and ψ (rows, p) of the rows that are ``kept`` (rows,)."""
        found = self.assembled
        some = slice(None) if len(kept) == found.Y.shape[1] else kept  # a slice copies nothing
        return self.mesh.trajectory(found.Y[:, some]), self.mesh.trajectory(found.psi[:, some])

    def kept_at(self, t: Array) -> Extension:
        """The same with the state's offset and gain at the times t (M,) only."""
        offset, gain = (signal(t) for signal in self.state_map)
        return replace(
            self, asked=t, assembled=replace(self.assembled, offset=offset, gain=gain)
        )

    def growth(self, reduced: ReducedSystem) -> tuple[float, float]:
        """Largest entry of Φ in comparable units, in which its columns start at size 1.

        And ln ‖Φ(end)‖₂, which is 0 at the start.
        """
        values = self.trajectory.values
        some = np.stack([values[0, 0], self.assembled.largest, values[-1, -1]])
        Phi = comparable(some[..., 1 + reduced.system.q :], reduced.units)
        return float(np.abs(Phi).max(initial=0.0)), log_norm(Phi[-1])


def extend(reduced: ReducedSystem, mesh: Mesh, start: Array) -> Extension:
    """Integrate [ξ_a | ξ_b | Φ] from ``start`` (k, 1 + q + n_a) over ``mesh``, refined."""
    system, solver, basis = reduced.system, reduced.solver, reduced.basis
    q, columns = system.q, start.shape[1]
    large = len(start) > SMALL and solver.name != "ivp"

    # What is integrated is in comparable units, as written where these are.
    of_rows, of_unknowns = reduced.units, reduced.form.units.unknowns
    of_columns = np.concatenate([[1.0], of_unknowns, units_along(start[:, 1 + q :], of_rows)])
    units = of_rows[:, None] / of_columns
    plain = bool((units == 1.0).all())

    def equations(o: ObserverMatrices, signals: Array) -> LinearEquation:
        A, f = o.dynamics, o.forcing(signals, 1 + q if large else columns)
        if not plain:
            A, f = A * of_rows / of_rows[:, None], f / units[:, : f.shape[2]]
        return LinearEquation(None, A, f, o.equations(signals))

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        return equations(reduced.matrices(t, inside), reduced.measured(t, inside))

    name = f"observer of plant {system.name}"
    # Along axes offset and gain are these components, each compared with its own state's size.
    # Where the kernel turns, they lose what is eliminated.
    on_axes = bool(np.count_nonzero(basis) == basis.shape[1] == reduced.first.split.rank)
    monitor = _Monitor(reduced, units)
    problem = LinearProblem(coefficients, start / units, monitor, name, told=on_axes)
    known, signals = None, reduced.signals
    limits: dict[str, Any] = {"tol": solver.tol, "max_elements": solver.max_elements}
    windows = [mesh] if large or solver.name == "ivp" else mesh.windows()
    if windows[0] is signals.mesh and reduced.injection is None and solver.name != "ivp":
        both = np.concatenate([signals.inputs.values, signals.outputs.values], axis=2)
        driving = reduced.form.driving(*map(_over_time, (mesh.points, mesh.inside, both)))
        known = equations(reduced.first, driving)
    marched = series.solve_dense(problem, mesh, **limits, known=known) if large else None
    if marched is not None:
        return _assembled(reduced, units, marched, monitor.latest, as_found=True)
    known, large = None if large else known, False
    if len(windows) > 1:
        return joined(kept_of(_over(mesh, reduced, problem, monitor), mesh, signals.asked))
    own = ivp.solve if solver.name == "ivp" else partial(solve, known=known)
    solution = own(problem, mesh, **limits)
    return _assembled(reduced, units, solution, monitor.latest, as_found=False)


class _Monitor:
    """Everything made of [ξ_a | ξ_b | Φ] that a mesh has to resolve.

    In front of a window stand those elements of windows before where something was largest: what
    has decayed is still measured by the size it had.
    """

    def __init__(self, reduced: ReducedSystem, units: Array) -> None:
        """For coordinates in units (k, 1 + p)."""
        self._reduced, self.units = reduced, units
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
        equations = AlgebraicEquations(*seen)
        self.latest = regression_signals(z, self._reduced.basis, equations)
        if (self.latest.largest / self.units).max(initial=0.0) > _LARGEST:
            raise SolverError(
                f"the dynamic extension of plant {self._reduced.system.name} grows beyond "
                f"{_LARGEST:.0e}: A_0 is unstable; use observer.remedy=output_injection, reset or "
                "current_coordinates of observer=gpebo, or a shorter time.horizon"
            )
        reduced, rounding = self._reduced, self._reduced.first.rounding
        if rounding is not None:
            rounding = ROUNDING * EPS / reduced.solver.tol * rounding
        for signal, floor in self.latest.kinds(reduced.form.units.states, rounding, equations):
            yield signal.reshape(*self._whole[0].shape[:2], -1), floor

    def next_window(self, size: int) -> Assembled:
        """What is made of the window of that size, which comes to stand before the next one."""
        K, points = self._whole[0].shape[:2]
        where = largest_at(v.reshape(K, points, v[0].size) for v, _ in self.latest.kinds())
        self._past = [e if e.shape[:2] == (1, 1) else e[where] for e in self._whole]
        return self.latest.after((K - size) * points)


def _over(
    mesh: Mesh, reduced: ReducedSystem, problem: LinearProblem, monitor: _Monitor
) -> Iterator[Extension]:
    """The extension on one window after the other, so that little is held beside the result."""
    solver = reduced.solver
    for window in mesh.windows():
        solution = solve(problem, window, tol=solver.tol, max_elements=solver.max_elements)
        values = solution.trajectory.values
        problem = replace(
            problem, start=values[-1, -1], uncertain=solution.uncertain,
            floor=np.maximum(problem.floor, largest_over_time(values, 2)),
        )
        found = monitor.next_window(len(values))
        part = _assembled(reduced, monitor.units, solution, found, as_found=False)
        everywhere = reduced.signals.asked is None
        yield part if everywhere else replace(part, trajectory=_ends(part.trajectory))


def _ends(signal: Trajectory) -> Samples:
    """The signal of which nothing but both ends is kept."""
    first, last = signal.values[0, 0], signal.values[-1, -1]
    return signal.mesh.sampled(np.array(signal.mesh.span), np.stack([first, last]))


def kept_of(parts: Iterator[Extension], mesh: Mesh, asked: Array | None) -> Iterator[Extension]:
    """What is kept of parts on a mesh's windows: all, or the state map at times ``asked`` (M,)."""
    return parts if asked is None else map(Extension.kept_at, parts, mesh.shares(asked))


def joined(parts: Iterable[Extension]) -> Extension:
    """One extension of those on neighbouring meshes."""
    over_time, rest = dict[str, Any](), list[tuple[Any, ...]]()
    for part in parts:
        found = part.assembled
        for name, piece in (
            ("edges", part.mesh.edges[1:]), ("scale", part.scale), ("z", part.trajectory.values),
            ("asked", part.asked), *((name, getattr(found, name)) for name in OVER_TIME),
        ):
            if piece is not None:
                whole = over_time.setdefault(name, np.empty((0, *piece.shape[1:])))
                held = len(whole)
                # In place: pieces beside the whole would be as much again.
                whole.resize((held + len(piece), *piece.shape[1:]), refcheck=False)
                whole[held:] = piece
        rest.append((part.error_estimate, part.weakest, found.Y_scale, found.column_scale,
                     found.largest, found.moving, part.mesh.edges[0]))
    errors, weak, of_Y, of_columns, largest, moving, starts = zip(*rest, strict=True)
    mesh = Mesh(np.append(starts[0], over_time.pop("edges")), part.mesh.rule)
    z = Trajectory(mesh, over_time.pop("z"))
    scale, asked = over_time.pop("scale"), over_time.pop("asked", None)
    return Extension(
        _ends(z) if isinstance(part.trajectory, Samples) else z, max(errors),
        replace(
            found, **over_time, Y_scale=max(of_Y), column_scale=np.max(of_columns, axis=0),
            largest=np.max(largest, axis=0), moving=np.max(moving, axis=0),
        ),
        np.maximum.accumulate(scale, axis=0, out=scale), min(weak), asked,
    )


def _assembled(
    reduced: ReducedSystem, units: Array, solution: LinearSolution, found: Assembled, *,
    as_found: bool,
) -> Extension:
    """What was found on the mesh, resolved but for ``as_found``, and sizes of its terms.

    These are looked at where each element begins, in its middle and where it ends. The solution's
    components are in ``units`` (k, columns).
    """
    system, mesh, values = reduced.system, solution.trajectory.mesh, solution.trajectory.values
    if (units != 1.0).any():
        values = values * units
    K, points = values.shape[:2]
    places = [0, (points - 1) // 2, points - 1]
    scale: list[Array] = []
    for first in range(0, K, max(1, AT_ONCE // points)):
        part = slice(first, first + max(1, AT_ONCE // points))
        z, *seen = (
            _over_time(e if e.shape[:2] == (1, 1) else e[part, places])
            for e in (values, *solution.extras)
        )
        of_gain, sizes = term_sizes(z, reduced.basis, AlgebraicEquations(*seen))
        elements = len(sizes) // 3
        scale.append(sizes.reshape(elements, 3, sizes.shape[1]).max(axis=1))
        if not as_found:
            terms = of_gain().reshape(elements, 3, system.n, -1).max(axis=1).repeat(points, axis=0)
            resolve(found, slice(first * points, part.stop * points), terms, reduced.form)
    sizes = np.maximum.accumulate(np.concatenate(scale), axis=0)
    *_, elimination, injectivity = map(_over_time, solution.extras)
    smallest, where = weakest(injectivity, elimination)
    at = float(mesh.points.ravel()[where])
    error, rounding = solution.error_estimate, reduced.first.rounding
    if rounding is not None:
        error = max(error, found.lost(EPS * rounding))
    return Extension(Trajectory(mesh, values), error, found, sizes, (smallest, at))


def _over_time(signal: Array) -> Array:
    """Values (K, s + 1, …) one point after the other, (K (s + 1), …)."""
    return signal.reshape(signal.shape[0] * signal.shape[1], *signal.shape[2:])
