"""Estimates within bounds: x̂ is affine in η̂, so a quadratic programme has p unknowns.

At each time t the bounded estimate is the nearest one to η̂ in the metric of what is known,

    min (η − η̂)ᵀ M (η − η̂)    s.t.    low ≤ offset(s) + gain(s) η ≤ high  for all s ≤ t,

and the same for the unknowns. M is z f₀I + αG_z of least squares, which makes it full-information
estimation with bounds, and G of the other estimators. In z = M^½ (η − η̂) it is a problem of
least distance, which SciPy's ``nnls`` solves by its active set (Lawson & Hanson, chapter 23). It
begins with the unknowns' bounds; those of states are added where they are violated, between the
nodes of the mesh, too, until none is. Of a long recording they are looked at in its rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.result import ActiveBound
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.mesh import SNAP, Samples, Trajectory
from gpebo_cli.observers import AffineStateMap, Observation
from gpebo_cli.regression.estimator import Estimates, Weighing
from gpebo_cli.schema import check_keys, known_name, number

_TOLERANCE = 1e-10  # of a quantity's size: by less no bound is violated
_UNMOVED = 1e-12  # share of a state's largest gain, below which no estimate moves it
_FLOOR = 1e-14  # of G at the end: what counts as known where nothing has been excited yet
_BEFORE = 1e-9  # of an element: where a state is looked at that jumps at its end
_AT_ONCE = 4  # violated minima of one bound that are added together
_STILL = 1e-5  # share of a bracket by which a minimum may be off the row that holds it
_PLACES = np.linspace(0.0, 1.0, 9)  # in the bracket of a minimum, of which a round leaves an eighth
_ZOOMS, _ROUNDS = 8, 200  # to find a minimum; of adding bounds
_NEAR = 1e-4  # of the horizon: what is as near is told once
_GROUP = 256  # rows that are looked at only where one of them may be below its bound
_INFEASIBLE = 1e-9  # residual of the dual problem, whose right-hand side is 1


class _Side(NamedTuple):
    """sign · quantity ≥ sign · value."""

    name: str
    place: int  # among the states or the parameters
    sign: float
    value: float


class _Row(NamedTuple):
    """normal · η ≥ level: one side at one time; an unknown's has none."""

    side: _Side
    time: float | None
    normal: Array  # (p,)
    level: float


class _Groups(NamedTuple):
    """Of rows that follow each other, what is extreme of the normals and levels of each side."""

    low: Array  # (B, groups, p)
    high: Array
    level: Array  # (B, groups) the highest

    @classmethod
    def of(cls, normals: Array, levels: Array) -> _Groups:
        """Of all rows, (B, M, p) and (B, M)."""
        starts = np.arange(0, levels.shape[1], _GROUP)
        return cls(
            np.minimum.reduceat(normals, starts, axis=1),
            np.maximum.reduceat(normals, starts, axis=1),
            np.maximum.reduceat(levels, starts, axis=1),
        )

    def near(self, eta: Array, size: Array, end: int) -> IntArray:
        """Rows before the ``end`` in whose groups η (p,) may be below a bound, of sizes (B,)."""
        least = np.minimum(self.low * eta, self.high * eta).sum(axis=2) - self.level
        groups = np.flatnonzero((least < _TOLERANCE * size[:, None]).any(axis=0))
        rows = (groups[:, None] * _GROUP + np.arange(_GROUP)).ravel()
        return np.asarray(rows[rows < end])


def bounded(
    given: Mapping[str, Mapping[str, Sequence[float | None]]], system: DescriptorSystem,
    observation: Observation, columns: IntArray, estimates: Estimates, t: Array,
) -> BoundedEstimates:
    """The estimates of some parameters, moved to where they respect ``observer.bounds``.

    ``given`` is the setting: of ``states`` and ``unknowns``, by name [low, high]. The observation
    has no resets; the estimates of some ``columns`` of its parameters are at ascending times t
    (M,) (ConfigError: an unknown name, or a pair that is no range).
    """
    state_map, p = observation.state_map, observation.regression.p
    if not isinstance(state_map, AffineStateMap):
        raise ConfigError("observer.bounds: the state of this observer is not affine in parameters")
    eye = np.eye(p)[:, columns]
    unknowns, states = sides(given, system)
    gram = observation.regression.gram_at(t)[:, columns][:, :, columns]
    least = _FLOOR * np.diag(np.diag(gram[-1]) + np.finfo(float).tiny)
    return BoundedEstimates(
        estimates, gram + least, state_map, columns, t, states,
        [
            _Row(side, None, side.sign * eye[side.place], side.sign * side.value)
            for side in unknowns
            if eye[side.place].any()
        ],
    )


def sides(
    given: Mapping[str, Mapping[str, Sequence[float | None]]], system: DescriptorSystem
) -> tuple[list[_Side], list[_Side]]:
    """Of ``observer.bounds``, those of unknowns and of states (ConfigError as :func:`bounded`)."""
    check_keys(given, ("states", "unknowns"), "observer.bounds")
    return (
        _sides(given.get("unknowns", {}), system.unknowns, "observer.bounds.unknowns"),
        _sides(given.get("states", {}), system.states, "observer.bounds.states"),
    )


def _sides(
    given: Mapping[str, Sequence[float | None]], known: tuple[str, ...], where: str
) -> list[_Side]:
    sides = []
    for name, pair in given.items():
        known_name(name, known, f"{where}: there is no {name!r}", "there are")
        ends = [v if v is None else number(v, f"{where}.{name}", "finite") for v in pair]
        low, high = ends if len(ends) == 2 else (1.0, 0.0)
        if low is not None and high is not None and low > high:
            raise ConfigError(
                f"{where}.{name}: expected [low, high], null where there is no bound, got {pair}"
            )
        sides += [
            _Side(name, known.index(name), sign, value)
            for sign, value in ((1.0, low), (-1.0, high)) if value is not None
        ]
    return sides


@dataclass(frozen=True, eq=False)
class BoundedEstimates:
    """Estimates that respect bounds; ``active`` says at the end of each case which ones hold it."""

    plain: Estimates
    gram: Array  # (M, p, p)
    state_map: AffineStateMap
    columns: IntArray  # (p,) of the state map's gain
    t: Array  # (M,)
    states: list[_Side]
    unknowns: list[_Row]
    active: dict[int, tuple[ActiveBound, ...]] = field(default_factory=dict)

    def parameters(self, cases: slice) -> Array:
        """η̂ of some cases at the times, (g, M, p)."""
        found = np.array(self.plain.parameters(cases))
        for i, eta in enumerate(found, cases.start or 0):
            metric = self.plain.weights(i) if isinstance(self.plain, Weighing) else self.gram
            self.active[i] = self._move(eta, metric)
        return found

    def _move(self, eta: Array, metric: Array) -> tuple[ActiveBound, ...]:
        """Move η̂ (M, p) of one case in place, and say which bounds are active at the end."""
        grid = self.t
        normals, levels = np.zeros((0, len(grid), eta.shape[1])), np.zeros((0, len(grid)))
        if self.states:
            mesh, known = self.state_map.offset.mesh, self._rows
            if known is None:
                known = np.union1d(np.append(mesh.points.ravel(), self._before_jumps), grid)
            grid = known
            normals, levels = self._of_states(grid)
        moving = np.linalg.norm(normals, axis=2)
        most = moving.max(axis=1, initial=0.0)
        size = np.abs(levels).max(axis=1, initial=0.0) + most * np.abs(eta).max(initial=0.0)
        # Where the gain is nothing the state is what was measured, and no estimate changes it.
        levels[moving <= _UNMOVED * most[:, None]] = -np.inf
        groups = None if self._rows is None else _Groups.of(normals, levels)
        working: list[_Row] = []
        active: list[_Row] = []
        squares, bases = np.linalg.eigh(metric)
        roots = np.sqrt(np.maximum(squares, np.finfo(float).tiny))
        for k, end in enumerate(np.searchsorted(grid, self.t) + 1):
            root, vectors = roots[k], bases[k]
            free = eta[k].copy()
            for _ in range(_ROUNDS):
                rows = [*self.unknowns, *working]
                z, used = _least_distance(
                    np.array([row.normal @ vectors / root for row in rows]),
                    np.array([row.level - row.normal @ free for row in rows]),
                )
                if z is None:
                    names = ", ".join(dict.fromkeys(row.side.name for row in rows))
                    raise ConfigError(
                        f"observer.bounds: no estimate respects those of {names} together with "
                        f"the data up to t = {self.t[k]:.6g}"
                    )
                active = [rows[i] for i in used]
                eta[k] = free + vectors @ (z / root)
                some = slice(end) if groups is None else groups.near(eta[k], size, end)
                new = self._violated(
                    normals[:, some], levels[:, some], grid[some], eta[k], size, active
                )
                working = [row for row in active if row.time is not None] + new
                if not new:
                    break
        told: list[ActiveBound] = []
        near = _NEAR * (grid[-1] - grid[0])
        # Unknowns first, then by time: in which order they were found depends on the units.
        for row in sorted(active, key=lambda row: (row.time is not None, row.time or 0.0)):
            bound = ActiveBound(row.side.name, row.side.value, row.time)
            if not any(bound.near(other, near) for other in told):
                told.append(bound)
        return tuple(told)

    @property
    def _rows(self) -> Array | None:
        """Times (M,) at which alone the states are known, of a long recording; else None."""
        offset = self.state_map.offset
        return offset.t if isinstance(offset, Samples) else None

    @cached_property
    def _signals(self) -> tuple[Trajectory, Trajectory]:
        """Gain and offset of what is bounded."""
        index = [side.place for side in self.states]
        gain, offset = self.state_map.gain, self.state_map.offset
        return (
            replace(gain, values=gain.values[:, :, index][..., self.columns]),
            replace(offset, values=offset.values[:, :, index]),
        )

    @cached_property
    def _before_jumps(self) -> Array:
        """Times next to those where a state jumps, at which it is what it was before."""
        mesh = self.state_map.offset.mesh
        gain, offset = (signal.values for signal in self._signals)
        both = np.concatenate([gain, offset[..., None]], axis=3)
        jump = np.abs(both[1:, 0] - both[:-1, -1]).max(axis=(1, 2), initial=0.0)
        some = np.flatnonzero(jump > _TOLERANCE * np.abs(both).max(initial=0.0))
        edges, steps = mesh.edges[some + 1], mesh.steps[some]
        return np.asarray(edges - np.maximum(_BEFORE * steps, 4.0 * SNAP * np.abs(edges)))

    @cached_property
    def _slopes(self) -> tuple[Trajectory, Trajectory]:
        gain, offset = self._signals
        return gain.derivative(), offset.derivative()

    def _of_states(self, t: Array, order: int = 0) -> tuple[Array, Array]:
        """Normals (B, M, p) and levels (B, M) of each side at the times t (M,), or their slopes."""
        gain, offset = (signal(t) for signal in (self._slopes if order else self._signals))
        sign = np.array([side.sign for side in self.states])
        value = 0.0 if order else np.array([side.value for side in self.states])
        return (
            np.moveaxis(sign[:, None] * gain, 1, 0),
            np.ascontiguousarray((sign * (value - offset)).T),
        )

    def _violated(
        self, normals: Array, levels: Array, t: Array, eta: Array, size: Array,
        active: Sequence[_Row],
    ) -> list[_Row]:
        """The lowest minima of every side over the times t (M,), of those that are below its bound.

        And those that have moved away from where an active row is: between the two, which are
        valid both, the error of the estimate is of second order.
        """
        margin = normals @ eta - levels  # (B, M)
        wall = np.full((len(margin), 1), np.inf)
        before = np.hstack([wall, margin[:, :-1]])
        after = np.hstack([margin[:, 1:], wall])
        # A minimum between nodes is not deeper below the lowest than its neighbours are above it.
        height = np.fmax(*(np.where(np.isfinite(side), side, -np.inf) for side in (before, after)))
        least = margin - (np.maximum(height - margin, 0.0) if self._rows is None else 0.0)
        lowest = (margin <= before) & (margin <= after) & (least < _TOLERANCE * size[:, None])
        side, at = np.nonzero(lowest)
        if not len(at):
            return []
        found, width, N, d = t[at], np.zeros(len(at)), normals[side, at], levels[side, at]
        if self._rows is None:
            low, high = t[np.maximum(at - 1, 0)], t[np.minimum(at + 1, len(t) - 1)]
            width, which = high - low, (side, np.arange(len(at)))
            for _ in range(_ZOOMS):  # to where the slope turns positive
                places = low[:, None] + (high - low)[:, None] * _PLACES
                N, d = self._of_states(places.ravel(), 1)
                slope = (N @ eta - d).reshape(len(self.states), *places.shape)[which]
                first = np.clip((slope < 0.0).sum(axis=1), 1, len(_PLACES) - 1)
                low, high = (places[which[1], first + step] for step in (-1, 0))
            found = 0.5 * (low + high)
            N, d = (each[which] for each in self._of_states(found))
        below = N @ eta - d
        # At a jump the lowest is where it was seen.
        here = margin[side, at] < below
        below[here], found[here] = margin[side, at][here], t[at][here]
        N[here], d[here] = normals[side, at][here], levels[side, at][here]
        rows: list[_Row] = []
        for i in np.argsort(below):
            b = self.states[side[i]]
            times = [row.time for row in active if row.side == b and row.time is not None]
            off = [abs(time - found[i]) for time in times]
            moved = _STILL * width[i] < min(off, default=0.0) < width[i]
            more = sum(row.side == b for row in rows) < _AT_ONCE
            if more and (moved or below[i] < -_TOLERANCE * size[side[i]]):
                rows.append(_Row(b, float(found[i]), N[i], float(d[i])))
        return rows


def _least_distance(A: Array, b: Array) -> tuple[Array | None, IntArray]:
    """The shortest z with A z ≥ b (N, p), and which rows hold it; None if there is no z at all."""
    from scipy.optimize import nnls

    scale = np.linalg.norm(A, axis=1) if len(A) else np.ones(0)
    scale[scale == 0.0] = 1.0
    A, b = A / scale[:, None], b / scale
    largest = b.max(initial=0.0)
    if largest <= 0.0:
        return np.zeros(A.shape[1] if len(A) else 1), np.zeros(0, dtype=np.intp)
    dual = np.vstack([A.T, b / largest])
    target = np.append(np.zeros(A.shape[1]), 1.0)
    multipliers, residual = nnls(dual, target)
    if residual < _INFEASIBLE:
        return None, np.zeros(0, dtype=np.intp)
    used = np.flatnonzero(multipliers > 0.0)
    # Again from the rows that hold it, to all digits.
    z = np.asarray(np.linalg.lstsq(A[used], b[used], rcond=None)[0], dtype=np.float64)
    return z, used
