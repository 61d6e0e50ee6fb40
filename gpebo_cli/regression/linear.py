"""The linear regression Y = ψ η: what an observer hands to any estimator (paper, eq. lre)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from math import prod

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.linalg import transpose, triangular
from gpebo_cli.numerics.mesh import Mesh, Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.regression.dynamics import TOLERANCE, Dynamics, filtered, state_of
from gpebo_cli.regression.parametrisation import Parametrisation
from gpebo_cli.regression.resets import ExtensionState, Known, Reset, level_of

_MANY = 16  # parameters, from which on G at the end is made without those at all other points
_SINGULAR = 1e-10  # singular values of ψ with columns of equal size that count as zero, relatively
_WINDOW = 1 << 12  # elements of a window at most, and
_ROUNDING = 100.0 * float(np.finfo(float).eps)  # times s²: what rounding at nodes is between them
_AT_ONCE = 1 << 22  # numbers of [ψᵀψ | ψᵀY] at most, that are made at once of a long regression


@dataclass(frozen=True, eq=False)
class LinearRegression:
    """Y (rows,) and ψ (rows, p) on one mesh, with the parameters' names.

    ``scale`` is the size of the terms that the columns of ψ were formed from, before they
    cancelled: a column of 1e-16 beside a scale of 1 is zero, whatever else there is.

    Y may have a second axis, (rows, c): c realisations of its noise over one ψ, which noise does
    not reach. All estimators are affine in Y and carry the axis through to their estimates.
    """

    Y: Trajectory
    psi: Trajectory
    parameters: tuple[str, ...]
    scale: Array | float = field(repr=False)  # (p,), or (K, p): so far, element by element
    resets: tuple[Reset, ...] = ()  # at edges of the mesh, in the order of time
    floor: float = 0.0  # size below which comparable parameters are rounding
    units: Array | float = 1.0  # (p,) in which they are comparable
    dynamics: Dynamics | None = None  # of parameters that move; then there are no resets
    parametrisation: Parametrisation | None = None  # η = S(θ)
    # Where Y is the projection of what was measured, |factor [−η; 1]|² is ∫‖Y − ψη‖² of that.
    factor: Array | None = None  # (k, p + 1)
    whole: LinearRegression | None = None  # a long one, of which this is a window
    since: float = -np.inf  # when the last of several experiments begins: before not all is seen

    @classmethod
    def from_functions(
        cls, psi: Callable[[Array], Array], Y: Callable[[Array], Array],
        parameters: Sequence[str], horizon: float, elements: int = 80,
    ) -> LinearRegression:
        """A regression whose ψ and Y are given as smooth functions of time, without a plant.

        They make ψ (K, s + 1, rows, p) and Y (K, s + 1, rows) of times (K, s + 1) from 0 to the
        horizon, in seconds. On each of the elements ψ and Y are polynomials of degree 9.
        """
        mesh = initial_mesh(0.0, horizon, [], elements, radau_rule(9))
        rows = Trajectory(mesh, psi(mesh.points))
        return cls(Trajectory(mesh, Y(mesh.points)), rows, tuple(parameters),
                   float(np.abs(rows.values).max(initial=0.0)))

    @property
    def mesh(self) -> Mesh:
        """The mesh of all signals."""
        return self.psi.mesh

    def leaves(self, columns: IntArray) -> bool:
        """Whether parameters other than these (k,) go on as they are, through resets as well."""
        others = ~np.isin(np.arange(self.p), columns)
        moving = () if self.dynamics is None else (self.dynamics,)
        return all(part.leaves(others) for part in (*self.resets, *moving))

    def about(self, columns: IntArray) -> LinearRegression:
        """The same about some of its parameters (k,), the others being zero."""
        K, p = self.mesh.size, self.p
        return replace(
            self, psi=Trajectory(self.mesh, self.psi.values[..., columns]),
            resets=tuple(reset.about(columns) for reset in self.resets),
            dynamics=self.dynamics and self.dynamics.about(columns),
            parameters=tuple(self.parameters[j] for j in columns),
            factor=None if self.factor is None else self.factor[:, [*columns, p]],
            scale=np.broadcast_to(self.scale, (K, p))[:, columns],
            units=np.broadcast_to(self.units, p)[columns],
        )

    @property
    def realisations(self) -> tuple[int, ...]:
        """(c,) if Y has that axis, else ()."""
        return self.Y.values.shape[3:]

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @cached_property
    def outer(self) -> Trajectory:
        """[ψᵀψ | ψᵀY], shape (p, p + c): everything an estimator needs of the regression."""
        return Trajectory(self.mesh, outer_products(self.psi.values, self.Y.values))

    @cached_property
    def filtered(self) -> dict[bytes, Trajectory]:
        """:attr:`outer` behind filters that start at zero, by their rates: deviations ask again."""
        return {}

    @cached_property
    def gram(self) -> Trajectory:
        """[G | h] with G(t) = ∫ψᵀψ, h(t) = ∫ψᵀY from the start, shape (p, p + c).

        After a reset it is about the new parameters, so that Gη = h stays true. If parameters
        move, it is about the current ones and forgets at their rate ρ: a lower bound of what is
        known.
        """
        if self.dynamics is not None:
            return self._moving(self.dynamics, ())
        if not self.resets:
            held = self.p < _MANY or "outer" in vars(self)
            return (self if held else replace(self)).outer.integral()
        pieces, known = [], np.zeros((self.p, self.p + 1))
        level: Array | float = 0.0
        for segment, reset in zip(self.segments, (*self.resets, None), strict=True):
            own = segment.outer.integral()
            pieces.append(own.values + known)
            level = np.maximum(level, level_of(own.final))
            if reset is not None:
                known = ExtensionState(pieces[-1][-1, -1], level).after(reset).values
        return Trajectory(self.mesh, np.concatenate(pieces))

    def gram_parts(self) -> Iterator[Trajectory]:
        """[G | h] one window after the other, so that little of it is held.

        Who comes to the end has found ``gram_final`` (SolverError: squares are too large for
        numbers).
        """
        known, state = np.zeros((self.p, 1)), list[ExtensionState]()
        for window in self.windows():
            if window is self:
                part = self.gram
            elif window.dynamics is not None:
                part = window._moving(window.dynamics, state)  # noqa: SLF001
                state = [state_of(part, state)]
            else:
                part = window.gram  # what it holds is its own
                np.add(part.values, known, out=part.values)
                known = part.final
            refuse_overflow("∫ψᵀψ", part.mesh, part.values[:, -1])
            yield part
        vars(self).setdefault("gram_final", part.final)

    def _moving(self, dynamics: Dynamics, known: Known) -> Trajectory:
        """[G | h] of parameters that move, from what was ``known`` before."""
        ones = np.ones(self.p)
        return filtered(self.outer, 0.0 * ones, ones, dynamics, known)

    @cached_property
    def gram_final(self) -> Array:
        """[G | h] at the end, (p, p + c) (SolverError: as of :meth:`gram_parts`)."""
        if self.p >= _MANY and not (self.resets or self.dynamics or "gram" in vars(self)):
            rows = (window._weighted() for window in self.windows())  # noqa: SLF001
            return np.asarray(sum(own[:, : self.p].T @ own for own in rows))
        return deque(self.gram_parts(), maxlen=1)[0].final

    def gram_at(self, t: Array) -> Array:
        """[G | h] at the times t (M,), (M, p, p + c)."""
        return self.gram_with_rounding(t)[0]

    def gram_with_rounding(
        self, t: Array, parts: Iterable[Trajectory] | None = None
    ) -> tuple[Array, Array]:
        """The same, and how wrong rounding may make the diagonal of G, (M, p).

        Early in an element, G is interpolated from what it grows to, and takes part in the rounding
        of that. The ``parts`` are those of :meth:`gram_parts`, for who looks at them, too.
        """
        start, stop = self.mesh.span
        if parts is None and (t == stop).all():
            return np.repeat(self.gram_final[None], len(t), axis=0), np.zeros((len(t), self.p))
        columns = self.p + prod(self.realisations)
        found, rounding = np.empty((len(t), self.p, columns)), np.empty((len(t), self.p))
        for part in self.gram_parts() if parts is None else parts:
            mesh, (first, last) = part.mesh, part.mesh.span
            some = ((t >= first) | (first == start)) & ((t < last) | (last == stop))
            sampler = mesh.sampler(t[some])
            found[some], k = sampler(part.values), sampler.element
            share = (t[some] - mesh.edges[k]) / mesh.steps[k]
            rounding[some] = interpolation_error(part, k, share)
        return found, rounding

    def terms(self, t: Array) -> Array:
        """The ``scale`` so far at the times t (N,), (N, p)."""
        sizes = np.broadcast_to(self.scale, (self.mesh.size, self.p))
        return np.asarray(sizes[self.mesh.edges[1:-1].searchsorted(t, side="left")])

    def rounding_of(self, gram: Array, t: Array) -> Array:
        """What rounding leaves of the diagonal of G (M, p, p + c) at the times t (M,), (M, p).

        Filters of moving parameters are good to a share of the largest entry, in units in which
        parameters are comparable; resets make all of G a part of what it was before them.
        """
        energy = np.einsum("mjj->mj", gram[..., : self.p])
        if self.dynamics is None:
            since = np.searchsorted([reset.time for reset in self.resets], t, side="right")
            return np.where(energy > 0.0, self._carried[since], 0.0)
        squares = self.dynamics.units**2
        largest = (energy * squares).max(axis=1, initial=0.0)
        return np.asarray(TOLERANCE * largest[:, None] / squares)

    @cached_property
    def _carried(self) -> Array:
        """What rounding of what was known before leaves in each segment, (segments, p)."""
        cuts = self.mesh.edges.searchsorted([reset.time for reset in self.resets])
        return np.array([np.zeros(self.p), *(
            reset.rounding(self.gram.values[cut - 1, -1])
            for cut, reset in zip(cuts, self.resets, strict=True)
        )])

    @cached_property
    def root(self) -> Array:
        """R (k, p + 1) with |R [−η; 1]|² = ∫‖Y − ψη‖²; of one realisation, without resets."""
        if self.factor is not None:
            return self.factor
        return triangular(window._weighted() for window in self.windows())  # noqa: SLF001

    def _weighted(self) -> Array:
        """Rows √w [ψ | Y] at all nodes, (K s rows, p + c), w being their weights in an integral."""
        psi, mesh = self.psi.values, self.mesh
        weights = np.sqrt(mesh.steps[:, None] * mesh.rule.integration[-1])[..., None, None]
        both = np.concatenate([psi, with_realisations(psi, self.Y.values)], axis=3)[:, 1:]
        both *= weights
        return both.reshape(-1, both.shape[3])

    def misfit(self, eta: Array) -> float:
        """∫‖Y − ψη‖² for parameters η (p,)."""
        return float(((self.root @ np.append(-eta, 1.0)) ** 2).sum())

    def least_squares(self) -> Array:
        """η̂ (p,) that makes ∫‖Y − ψη̂‖² least; the smallest one where many do. Without resets."""
        return least_squares(self.root)

    @cached_property
    def segments(self) -> tuple[LinearRegression, ...]:
        """The regression between one reset and the next, each about its own parameters."""
        if not self.resets:
            return (self,)
        cuts = np.searchsorted(self.mesh.edges, [reset.time for reset in self.resets])
        about = [(self.floor, self.units), *((own.floor, own.units) for own in self.resets)]
        return tuple(
            replace(self._part(first, last), floor=floor, units=units)
            for (first, last), (floor, units) in zip(
                pairwise([0, *cuts.tolist(), self.mesh.size]), about, strict=True
            )
        )

    def windows(self) -> Iterator[LinearRegression]:
        """The regression, or parts of a long one, one after the other, about the same parameters.

        What is made of one of them does not have to be held for the next.
        """
        if not self.long:
            yield self
            return
        each = max(1, len(self.mesh.rule.points) * self.p * (self.p + 1))
        count = max(1, min(_WINDOW, _AT_ONCE // each))
        for first in range(0, self.mesh.size, count):
            last = min(first + count, self.mesh.size)
            yield replace(self._part(first, last), whole=self)

    @property
    def long(self) -> bool:
        """Whether there are several windows."""
        plain = not (self.resets or self.realisations)
        return plain and self.mesh.size > _WINDOW

    def _part(self, first: int, last: int) -> LinearRegression:
        """The elements from one number to another, without what was before."""
        piece, own = Mesh(self.mesh.edges[first : last + 1], self.mesh.rule), slice(first, last)
        scale = np.broadcast_to(self.scale, (self.mesh.size, self.p))
        return replace(
            self, Y=Trajectory(piece, self.Y.values[own]),
            psi=Trajectory(piece, self.psi.values[own]), resets=(), scale=scale[own], factor=None,
        )


def interpolation_error(gram: Trajectory, element: IntArray, share: Array) -> Array:
    """Rounding (M, p) of the diagonal of G (p, p + c), at a share (M,) of some elements (M,).

    ∑|l_j(s)| ≤ 1.4 stages² s for all nodes but the first, and values at nodes are good to some
    units in the last place of the right end's.
    """
    ends = gram.values[:, -1, :, : gram.values.shape[2]]
    level = _ROUNDING * gram.mesh.rule.stages**2 * share
    return np.asarray(level[:, None] * np.abs(np.einsum("kjj->kj", ends))[element])


def least_squares(root: Array) -> Array:
    """η̂ (…, p) that makes |R [−η̂; 1]| least, R (…, k, p + 1); the smallest one where many do."""
    size = np.linalg.norm(root[..., :-1], axis=-2)
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(root[..., :-1] / size[..., None, :], rcond=_SINGULAR)
    return np.asarray((inverse @ root[..., -1:])[..., 0] / size)


def refuse_overflow(what: str, mesh: Mesh, values: Array) -> None:
    """SolverError if ``what``, of values (K, …) in elements, is not finite; names the time."""
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        raise SolverError(
            f"{what} is too large for a number near t = {mesh.edges[np.argmin(finite)]:.4g}; write "
            "Y and ψ in larger units"
        )


def outer_products(psi: Array, Y: Array) -> Array:
    """[ψᵀψ | ψᵀY] of shape (..., p, p + c) from ψ (..., rows, p) and Y (..., rows[, c])."""
    Y = with_realisations(psi, Y)
    both = np.concatenate([psi, Y], axis=-1)
    return np.asarray(transpose(psi) @ both)


def with_realisations(psi: Array, Y: Array) -> Array:
    """Y (..., rows, c), with c = 1 where it has one realisation only."""
    return Y if Y.ndim == psi.ndim else Y[..., None]
