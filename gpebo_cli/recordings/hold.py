"""From samples to signals: what is assumed between samples, as piecewise polynomials on a mesh.

* zoh: the last sample is held; order 1 in the time between samples. It is right for what a digital
  controller put out.
* linear: samples are joined by straight lines; order 2.
* cubic: the C² spline through the samples (not-a-knot ends); order 4. It is wrong for noise and
  jumps.

A signal each may have its own: an input that a controller puts out is held, measured outputs are
joined by lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from gpebo_cli.errors import printable
from gpebo_cli.model.descriptor import Array, BoolArray, CoefficientSource, DescriptorSystem
from gpebo_cli.model.expressions.bounds import with_others
from gpebo_cli.numerics.mesh import FIRST_ELEMENTS, Mesh, legendre_tail, signal_scale
from gpebo_cli.numerics.radau import RadauRule, radau_rule
from gpebo_cli.schema import known_name

# (times (N,), where it is decided which samples they are between (N,)) -> values (N, c)
Held = Callable[[Array, Array], Array]
Hold = str | tuple[str, ...]  # of all signals, or of each its own

_STAGES = (3, 4, 6, 9, 12, 16)  # candidates for the mesh of a recording
_PROBED = 64  # elements on which the plant's matrices are looked at
_FASTEST = 8.0  # of a mode, per element, that decides how many nodes one has
_SAME = 1e-13  # slopes that differ by less than this share of the signal's size are the same
_SMALLEST = 1e-9  # an edge nearer than this share of a step to a sample is that sample


def holds(given: str | Mapping[str, str], system: DescriptorSystem) -> Hold:
    """That of [u; y] (m + r,), lines where ``data.hold`` says nothing (ConfigError: no signal)."""
    if isinstance(given, str):
        return given
    names = (*system.inputs, *system.outputs)
    for name in given:
        what = f"data.hold.{printable(name)}: plant {system.name} has no such signal"
        known_name(name, names, what, "those are")
    words = tuple(given.get(name, "linear") for name in names)
    return words if len(set(words)) > 1 else words[0]


def each_of(hold: Hold, count: int) -> tuple[str, ...]:
    """That of each of so many signals."""
    return (hold,) * count if isinstance(hold, str) else hold


def of_outputs(hold: Hold, m: int) -> str:
    """What is assumed of outputs behind m inputs; linear, if that is not the same of all."""
    found = {hold} if isinstance(hold, str) else set(hold[m:])
    return found.pop() if len(found) == 1 else "linear"


def _kinds(hold: Hold, count: int) -> dict[str, list[int]]:
    """Which of so many signals are held how."""
    words = each_of(hold, count)
    return {word: [j for j in range(count) if words[j] == word] for word in dict.fromkeys(words)}


def held(t: Array, values: Array, hold: Hold) -> Held:
    """The signals between the samples ``values`` (N, c) at the times ``t`` (N,)."""
    if not isinstance(hold, str):
        parts = [(own, held(t, values[:, own], word))
                 for word, own in _kinds(hold, values.shape[1]).items()]

        def each(at: Array, inside: Array) -> Array:
            out = np.empty((len(at), len(hold)))
            for own, signal in parts:
                out[:, own] = signal(at, inside)
            return out

        return each
    if hold == "cubic":
        from scipy.interpolate import CubicSpline  # a quarter of a second to import

        spline = CubicSpline(t, values, axis=0)
        return lambda at, _inside: np.asarray(spline(at), dtype=np.float64)
    if hold == "zoh":
        return lambda _at, inside: np.asarray(values[np.searchsorted(t, inside, side="right") - 1])
    slope = np.diff(values, axis=0) / np.diff(t)[:, None]

    def line(at: Array, inside: Array) -> Array:
        k = np.clip(np.searchsorted(t, inside, side="right") - 1, 0, len(t) - 2)
        return np.asarray(values[k] + (at - t[k])[:, None] * slope[k])

    return line


def edges(t: Array, cuts: Array) -> Array:
    """Sample times ``t`` (N,) and ``cuts`` (C,) between them, in order.

    A cut on a sample is that sample.
    """
    if not len(cuts):
        return t
    k = np.clip(np.searchsorted(t, cuts), 1, len(t) - 1)
    return with_others(t, cuts, _SMALLEST * (t[k] - t[k - 1]))


def recording_mesh(
    t: Array, values: Array, hold: Hold, span: tuple[float, float], source: CoefficientSource,
    tol: float,
) -> Mesh:
    """A mesh on which held samples (N, c) at t (N,) and the plant's matrices are resolved.

    Every sample where the held signal is not smooth is an edge, and every jump of the matrices.
    Many samples make short elements on which a few nodes do; few make long ones that want more: of
    several rules the one that needs the fewest points in all is taken.
    """
    start, stop = span
    inner = (t > start) & (t < stop)
    cuts = source.breakpoints(start, stop)
    signal, kinds = held(t, values, hold), _kinds(hold, values.shape[1])
    smooth, bent = values[:, kinds.pop("cubic", [])], np.zeros(len(t), dtype=bool)
    for word, own in kinds.items():
        bent |= bends(t, values[:, own], word)
    corners = np.concatenate([[start], t[inner & bent], [stop]])
    spline = held(t, smooth, "cubic") if smooth.size else None
    candidates = []
    for rule in map(radau_rule, _STAGES):
        knots = corners
        if spline is not None:
            every = np.concatenate([[start], t[inner], [stop]])
            knots = np.union1d(knots, _merged(spline, every, rule, tol))
        coarse = Mesh(edges(knots, cuts), rule)
        equal = np.rint(FIRST_ELEMENTS * coarse.steps / (stop - start)).astype(np.intp)
        mesh, _ = coarse.split(np.maximum(1, equal))
        parts = _parts(source, signal, mesh, tol)
        candidates.append((mesh.size * (rule.stages + 1) * parts, mesh))
    return min(candidates, key=lambda candidate: candidate[0])[1]


def bends(t: Array, values: Array, hold: str) -> BoolArray:
    """Samples at which the held signal, zoh or linear, jumps or has a kink, (N,)."""
    change = np.diff(values, axis=0)
    if hold == "linear":
        step = np.diff(t)[:, None]
        change = np.diff(change / step, axis=0) * np.minimum(step[1:], step[:-1])
    size = np.maximum(np.abs(values).max(axis=0, initial=0.0), np.finfo(float).tiny)
    bends = np.zeros(len(t), dtype=bool)
    bends[1 : 1 + len(change)] = (np.abs(change) > _SAME * size).any(axis=1)
    return bends


def _merged(signal: Held, knots: Array, rule: RadauRule, tol: float) -> Array:
    """Those of the spline's ``knots`` that have to be edges, for polynomials of degree s.

    Over neighbouring samples that are close enough the spline is as good as one polynomial. Whole
    blocks of 2^j samples are tried, the longest first.
    """
    count = len(knots) - 1
    wanted = np.ones(count + 1, dtype=bool)
    done = np.zeros(count, dtype=bool)  # samples whose block is decided
    level = int(np.log2(max(count // FIRST_ELEMENTS, 1)))
    for length in 2 ** np.arange(level, 0, -1):
        first = np.arange(0, count - length + 1, length)
        first = first[~done[first]]
        if len(first) == 0:
            continue
        left, right = knots[first], knots[first + length]
        points = left[:, None] + (right - left)[:, None] * rule.points
        values = signal(points.ravel(), points.ravel()).reshape(*points.shape, -1)
        scale = signal_scale(values)
        smooth = (legendre_tail(values, rule, scale) <= 0.1 * tol * scale).all(axis=1)
        for k in first[smooth]:
            wanted[k + 1 : k + length] = False
            done[k : k + length] = True
    return knots[wanted]


def _parts(source: CoefficientSource, signal: Held, mesh: Mesh, tol: float) -> float:
    """Into how many parts elements will be cut, as far as a few of them tell.

    What has to be resolved are the plant's matrices, and products of two held signals and of two
    solutions, because the observer makes products of everything with everything.
    """
    chosen = np.unique(np.linspace(0, mesh.size - 1, _PROBED).round().astype(np.intp))
    left, step = mesh.edges[chosen, None], mesh.steps[chosen, None]
    t, margin = left + step * mesh.rule.points, 1e-3 * step  # all points of all: too much memory
    inside = t.clip(left + margin, left + step - margin)
    samples = signal(t.ravel(), inside.ravel())
    c = source.taylor(t.ravel(), 1, inside.ravel(), samples[None] if source.signals else None)
    matrices = (c.A, c.B, c.F, c.C, c.phi, c.D, c.H)
    kinds = (c.E[0], c.E[1], *(matrix[0] for matrix in matrices), samples, samples**2)
    longest = int(step.argmax())
    E, A = (matrix[0, longest * t.shape[1]] for matrix in (c.E, c.A))
    modes = np.exp(2.0 * mesh.rule.points[:, None] * _rates(E, step[longest] * A))
    of_plant = np.broadcast_to(np.hstack([modes.real, modes.imag]), (*t.shape, 2 * modes.shape[1]))
    values = np.concatenate([*(kind.reshape(*t.shape, -1) for kind in kinds), of_plant], axis=2)
    scale = signal_scale(values)
    tail = float((legendre_tail(values, mesh.rule, scale) / scale).max(initial=0.0))
    return max(1.0, float((tail / tol) ** (1.0 / (mesh.rule.stages + 1))))


def _rates(E: Array, A: Array) -> NDArray[np.complex128]:
    """Finite eigenvalues of a pencil, by those of (E − A)⁻¹E = 1/(1 − λ), if that is regular.

    Without those of modes so fast that they are gone within part of an element.
    """
    if len(E) <= _PROBED:  # beyond it takes seconds
        with suppress(np.linalg.LinAlgError):
            kept = np.linalg.eigvals(np.linalg.solve(E - A, E)).astype(complex)
            return np.asarray(1.0 - 1.0 / kept[np.abs(kept) > 1.0 / _FASTEST])
    return np.zeros(0, dtype=complex)
