"""Excitation of a regressor, as evidence: how strongly, from when on, and in which direction.

Interval excitation, as the paper's Assumption 2 means it, is G(t_c) = ∫ψᵀψ ≥ ρ I_p for some t_c
(p × p; the paper prints ∫ψψᵀ ≥ ρ I_r, which is necessary only if r = p).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.polynomial import legendre

from gpebo_cli.evidence.knowledge import Knowledge, knowledge
from gpebo_cli.evidence.metrics import DECAY
from gpebo_cli.findings import Direction, OnDemand, Requirement, evaluated
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import symmetric_eigenvalues
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.regression.linear import LinearRegression, interpolation_error
from gpebo_cli.regression.resets import ExtensionState, Reset, level_of
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.settings import ExcitationSettings

WELL = 1e-4  # share of a column's energy: an error in Y comes out at most a hundredfold
_TINY = float(np.finfo(float).tiny)
_PLACES, _SAME_TIME = 17, 1e-14  # in a bracket; of the horizon
_SOON = np.logspace(-7.0, -2.0, 11)  # of the first element
WINDOWS = 10  # default PE window: this many per horizon


@dataclass(frozen=True)
class Excitation:
    """Interval and persistent excitation, as evidence and not a bare yes.

    The verdict rests on what is known (:class:`Knowledge`) and on no unit, unless a level ρ of
    λ_min(G) is asked for. ``gram_eigenvalues[i]`` are those of G(t_i), ascending. Spectra, and when
    they were reached, may be most of a run: they are computed when they are looked at.
    """

    t: Array  # (N,)
    window: float
    rho: float | None  # level asked of lambda_min(G); None: the verdict is free of units
    parameters: tuple[str, ...]
    final: Knowledge  # at the last of the times
    t_c: OnDemand[float | None] = OnDemand()  # first time at which all can be told apart
    lambda_min: OnDemand[float] = OnDemand()  # at the horizon
    known: OnDemand[Knowledge] = OnDemand()
    gram_eigenvalues: OnDemand[Array] = OnDemand()  # (N, p)
    # (N,) smallest eigenvalue of the Gram matrix over the trailing window
    pe_level: OnDemand[Array] = OnDemand()

    __getstate__ = evaluated

    @property
    def is_ie(self) -> bool:
        """Whether ψ is interval-exciting."""
        return self.t_c is not None

    @property
    def condition(self) -> float:
        """Largest over smallest eigenvalue of G with unit diagonal, at the horizon."""
        spectrum = self.final.eigenvalues[-1]
        smallest = float(spectrum.min(initial=1.0))
        return float(spectrum.max(initial=0.0)) / smallest if smallest > 0.0 else np.inf

    @property
    def weakest_direction(self) -> Direction:
        """What ψ shows least, in units of each parameter's own size."""
        v = self.final.vectors[-1, :, :1].ravel()
        sign = 1.0 if max(v, key=abs, default=1.0) >= 0.0 else -1.0
        return Direction(dict(zip(self.parameters, (sign * v).tolist(), strict=True)))

    @property
    def normalised_min(self) -> Array:
        """Smallest eigenvalue of G with unit diagonal, (N,)."""
        return self.known.smallest

    @property
    def level(self) -> float:
        """The last of ``normalised_min``."""
        return float(self.final.smallest[-1])

    @property
    def determined_at(self) -> dict[str, float | None]:
        """From when on each parameter is well determined."""
        return dict(zip(self.parameters, since(self.t, self.known.share >= WELL), strict=True))

    @property
    def determined(self) -> float | None:
        """From when on all parameters are well determined."""
        if not self.parameters or not (self.final.share >= WELL).all():
            return None
        return since(self.t, self.known.share.min(axis=1)[:, None] >= WELL)[0]


def assess(
    regression: LinearRegression, t: Array, settings: ExcitationSettings, tol: float = 1e-12
) -> Excitation:
    """Interval and persistent excitation of ψ, resolved to ``tol``, at the times t (N,)."""
    mesh = regression.mesh
    horizon = float(mesh.edges[-1] - mesh.edges[0])
    window = settings.window if settings.window is not None else horizon / WINDOWS
    # What is looked at later must not keep what is known of this regression by now.
    later, ends = replace(regression), list[tuple[Array, Array]]()

    def parts() -> Iterator[Trajectory]:
        for part in regression.gram_parts():
            at = part.mesh.edges[1:], part.values[:, -1]
            ends.append(_told(regression, settings.rho, tol, *at))
            yield part

    # Of parameters that move one pass of filters serves all of the times.
    first = regression.gram_with_rounding(t, parts()) if regression.dynamics else None
    seen = cache(lambda: first or later.gram_with_rounding(t))
    end = regression.gram_with_rounding(t[-1:])

    def eigenvalues(gram: Array) -> Array:
        return np.maximum(symmetric_eigenvalues(gram), 0.0)

    return Excitation(
        t, window, settings.rho, regression.parameters, known_at(regression, t[-1:], tol, end),
        t_c=partial(_t_c, later, settings.rho, tol, ends),
        lambda_min=lambda: float(eigenvalues(end[0])[0, 0]) if later.p else 0.0,
        known=lambda: known_at(later, t, tol, seen()),
        gram_eigenvalues=lambda: eigenvalues(seen()[0]),
        pe_level=lambda: window_level(
            ((part.outer for part in segment.windows()) for segment in later.segments), t, window,
            later.resets,
        ),
    )


def known_at(
    regression: LinearRegression, at: Array, tol: float,
    seen: tuple[Array, Array | float] | None = None,
) -> Knowledge:
    """What is known at some times (N,) from ψ, resolved to ``tol``.

    ``seen`` are [G | h] and its rounding there, where they are at hand.
    """
    gram, rounding = seen or regression.gram_with_rounding(at)
    rounding = rounding + regression.rounding_of(gram, at)
    elapsed = at - regression.mesh.edges[0]
    return knowledge(gram, regression.terms(at), elapsed, tol, rounding)


def _told(
    regression: LinearRegression, rho: float | None, tol: float, at: Array, matrices: Array,
    rounding: Array | float = 0.0,
) -> tuple[Array, Array]:
    """How well all are told apart, or λ_min over ρ, and what of that may be rounding, (M,) each."""
    if rho is not None:
        level = (rounding + regression.rounding_of(matrices, at)).max(axis=1, initial=_TINY)
        return symmetric_eigenvalues(matrices)[:, 0] / rho, level / rho
    known = known_at(regression, at, tol, (matrices, rounding))
    return known.smallest, known.rounding


def _t_c(
    regression: LinearRegression, rho: float | None, tol: float, ends: list[tuple[Array, Array]],
) -> float | None:
    """First time at which all parameters can be told apart, or at which λ_min(G) is ``rho``.

    What is :func:`_told` at the right ends of elements is in ``ends``, part by part, or nothing.
    """
    seen = partial(_told, regression, rho, tol)
    smallest, level = (np.concatenate(each) for each in zip(*(
        ends or (seen(part.mesh.edges[1:], part.values[:, -1]) for part in regression.gram_parts())
    ), strict=True))
    # Early on G is rounding beside what it becomes: t_c is when parameters are told apart well,
    # or half as well as they ever are.
    told = smallest[smallest >= level]
    enough = min(WELL, 0.5 * float(told.max(initial=0.0))) if rho is None else 1.0

    def judged(smallest: Array, level: Array) -> tuple[BoolArray, BoolArray]:
        """Where ψ is exciting, and where rounding lets one know whether it is."""
        there = smallest >= np.maximum(enough, level)
        return there, there | (level <= enough)

    return _first_time(
        regression.gram_parts(), regression.mesh.span, judged(smallest, level)[0],
        lambda at, matrices, rounding: judged(*seen(at, matrices, rounding)),
        None if regression.dynamics else partial(_early, regression),
    )


def _early(regression: LinearRegression, t: Array) -> Array:
    """G (M, p, p) at times t (M,) of the first element, by Gauss's rule.

    Within an element ψᵀψ is resolved beside what it grows to, and of that early ones may be little.
    """
    mesh, (places, weights) = regression.mesh, legendre.leggauss(regression.mesh.rule.stages)
    half = 0.5 * (t - mesh.edges[0])
    first = Trajectory(Mesh(mesh.edges[:2], mesh.rule), regression.psi.values[:1])
    psi = first((mesh.edges[0] + half[:, None] * (places + 1.0)).ravel())
    products = np.swapaxes(psi, 1, 2) @ psi
    products = products.reshape(len(t), len(places), regression.p, regression.p)
    return np.asarray(np.einsum("m,n,mnij->mij", half, weights, products))


def estimable(
    known: Knowledge, t: Array, parameters: Sequence[str], states: Sequence[str], seen: BoolArray
) -> dict[str, float | None]:
    """From when on each parameter and state can be known; None where it cannot be.

    ``known`` and which states are ``seen`` (M, n) are at the times t (M,), the last of which is the
    end. A parameter with the name of a state comes first.
    """
    times = since(t, np.concatenate([known.parameters, seen], axis=1))
    of_states = dict(zip(states, times[len(parameters) :], strict=True))
    return of_states | dict(zip(parameters, times, strict=False))


def since(t: Array, holds: BoolArray) -> list[float | None]:
    """The first of the times t (N,) from which on each column (N, c) holds, None for never."""
    held = np.logical_and.accumulate(holds[::-1], axis=0).sum(axis=0)
    return [float(t[len(t) - k]) if k else None for k in held.tolist()]


def _first_time(
    parts: Iterable[Trajectory], span: tuple[float, float], at_ends: BoolArray,
    reached: Callable[[Array, Array, Array], tuple[BoolArray, BoolArray]],
    early: Callable[[Array], Array] | None = None,
) -> float | None:
    """First time at which something is ``reached``: bracketed on the mesh, then narrowed.

    Each round looks at equally many times within the bracket. G is given part by part over a span
    of time, by ``early`` in the first element, and ``at_ends`` (K,) is whether it is reached at the
    right ends of all elements.
    """
    if not at_ends.any():
        return None
    left = int(np.argmax(at_ends)) + 1  # elements up to the first at whose end it is reached
    for part in parts:
        mesh, gram, rule = part.mesh, part.values[:left], part.mesh.rule
        points, element = mesh.points[:left], np.arange(len(gram)).repeat(len(rule.points))
        there, _ = reached(
            points.ravel(), gram.reshape(points.size, *gram.shape[2:]),
            interpolation_error(part, element, np.tile(rule.points, len(gram))),
        )
        there = there.reshape(points.shape)
        if early and mesh.edges[0] == span[0]:
            there[0, :-1] = reached(points[0, :-1], early(points[0, :-1]), np.zeros(()))[0]
        left -= mesh.size
        if left <= 0:
            there[-1, -1] = True
        if there.any():
            break
    k = int(np.argmax(there.any(axis=1)))
    points, there = points[k], there[k]
    piece = Trajectory(Mesh(mesh.edges[k : k + 2], rule), gram[k : k + 1])
    (start, stop), length = span, float(mesh.steps[k])

    def looked(at: Array) -> tuple[BoolArray, BoolArray]:
        if early and mesh.edges[k] == start:
            return reached(at, early(at), np.zeros(()))
        share, alone = (at - mesh.edges[k]) / length, np.zeros(len(at), dtype=np.intp)
        return reached(at, piece(at), interpolation_error(piece, alone, share))

    if mesh.edges[k] == start:  # at once is what is reached as soon as rounding lets one know
        found, known = looked(start + length * _SOON)
        if known.any() and found[np.argmax(known)]:
            return start
    while True:
        j = int(np.argmax(there))
        low, high = float(points[max(j - 1, 0)]), float(points[j])
        if high - low <= _SAME_TIME * max(abs(high), stop - start):
            return high
        points = np.linspace(low, high, _PLACES)
        there = looked(points)[0]
        there[-1] = True


def window_level(
    segments: Iterable[Iterable[Trajectory]], t: Array, window: float, resets: Sequence[Reset] = ()
) -> Array:
    """λ_min of ∫_{t−T}^{t} ψᵀψ at the times t (M,); NaN before the first whole one.

    Whole elements are summed afresh for every window T, in seconds. The difference G(t) − G(t − T)
    was rejected: once a regressor has died out, it is the rounding of two large numbers. Segments
    are [ψᵀψ | ·] (p, p + c) from one reset to the next, part by part. What was seen before a reset
    counts for the parameters after it: T⁻ᵀ G T⁻¹, as in ``ExtensionState.after``.
    """
    level, start, slack = np.full(len(t), np.nan), t - window, 1e-9 * window
    gram, whole = np.zeros((0, 0, 0)), np.zeros(0, dtype=np.intp)
    size: Array | float = 0.0
    for k, parts in enumerate(segments):
        for j, outer in enumerate(parts):
            low, high = outer.mesh.edges[[0, -1]]
            if not k + j:
                whole = (start >= low - slack).nonzero()[0]
                gram = np.zeros((len(whole), *outer.values.shape[2:]))
            if k and not j:
                for i in np.flatnonzero((start[whole] < low) & (t[whole] > low)):
                    gram[i] = ExtensionState(gram[i], size).after(resets[k - 1]).values
            size = (size if j else 0.0) + level_of(outer.integral().final) if resets else 0.0
            a, b = np.clip(start[whole], low, high), np.clip(t[whole], low, high)
            here = np.flatnonzero(b > a)
            gram[here] += between(outer, a[here], b[here])
    level[whole] = np.maximum(symmetric_eigenvalues(gram).min(axis=1, initial=np.inf), 0.0)
    return level


def between(signal: Trajectory, a: Array, b: Array) -> Array:
    """∫ of a signal (rows, c) from a to b ≥ a (N,) in its mesh, whole elements summed afresh."""
    start, stop = signal.mesh.sampler(a), signal.mesh.sampler(b)
    local = signal.integral(local=True).values
    # Sums over whole elements for every window: pairs of indices to reduceat.
    padded = np.concatenate([local[:, -1], np.zeros_like(local[:1, -1])])
    pairs = np.stack([start.element, stop.element], axis=1).ravel().astype(np.intp)
    whole = np.add.reduceat(padded, pairs, axis=0)[::2]
    several = (start.element < stop.element)[:, None, None]
    return np.asarray(np.where(several, whole, 0.0) + stop(local) - start(local))


def sampled_window_level(regression: SampledRegression, window: float) -> Array:
    """λ_min of ∫ψᵀψ over the last ``window`` seconds at every sample (K,), to a sample's length.

    It is NaN before the first whole window. Every window is summed afresh, as in
    :func:`window_level`.
    """
    t, p = regression.t, regression.p
    level = np.full(len(t), np.nan)
    slack = 1e-9 * window
    whole = np.flatnonzero(t - window >= t[0] - slack)
    rows = regression.weighted()[..., :p]
    steps = np.concatenate([np.swapaxes(rows, 1, 2) @ rows, np.zeros((1, p, p))])
    first = np.searchsorted(t, t[whole] - window + slack, side="right")
    pairs = np.stack([first, whole + 1], axis=1).ravel()
    sums = np.add.reduceat(steps, pairs, axis=0)[::2]
    level[whole] = np.maximum(symmetric_eigenvalues(sums).min(axis=1, initial=np.inf), 0.0)
    return level


def persistent(
    outer: Trajectory, gain: float, parts: Iterable[Trajectory] | None = None,
    span: tuple[float, float] | None = None,
) -> Requirement:
    """Whether ψ keeps exciting, and enough at γ = ``gain``, by ψᵀψ (p, p); or by its parts in turn.

    The evidence is the smallest λ_min of ∫ψᵀψ (or of what takes its place) over sliding windows of
    a tenth of the horizon. An error shrinks by about exp(−γ λ_min) per window while γ λ_min is
    small, so 1 % within the horizon's ten windows needs γ λ_min ≥ ln(100)/10.
    """
    span = outer.mesh.span if span is None else span
    length, parts = (span[1] - span[0]) / WINDOWS, [outer] if parts is None else parts
    level = float(np.nanmin(window_level([parts], np.linspace(*span, 10 * WINDOWS + 1), length)))
    needed = DECAY / WINDOWS
    return Requirement(
        name="PE",
        holds=gain * level >= needed,
        evidence={"pe_level": level, "window": length, "gamma_times_level": gain * level,
                  "needed": needed},
        text=(
            f"λ_min over windows of {length:.3g} s falls to {level:.3g}, times γ = {gain:.3g} is "
            f"{gain * level:.3g}; 1 % of the initial error needs {needed:.3g}"
        ),
    )
