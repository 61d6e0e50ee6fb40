"""A long recording: its many short elements become the few that ψ and the state's gain need.

ψ does not follow the signals here, so long elements resolve it. Y, rough as measured, enters every
estimator through integrals with ψ. Over each long element it is replaced by its projection on
polynomials, Ỹ = Σ_j (2j + 1)/h P_j ∫ P_j Y dt, which leaves these integrals as they are: at the
ends of long elements the estimates are those of Y itself. The offset is exact at all points.

Y and offset are affine in the signals. Those of a thinned copy of the signals are at hand, and the
difference, ζ' = A_0 ζ + B_e e of theory 12, is added window by window: what is held at a time does
not depend on the number of samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import prod

import numpy as np
from numpy.polynomial import legendre

from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.linalg import transpose, triangular
from gpebo_cli.numerics.mesh import Mesh, Trajectory, unresolved
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers._base import AffineStateMap, InitialError, Measurements, Observation
from gpebo_cli.recordings.hold import edges
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem, driven
from gpebo_cli.settings import SolverSettings

_MANY = 8  # elements of the signals for each of those that they are thinned to
_LARGE = 1000  # numbers in the system of errors, which then are not kept
_AT_ONCE = 1 << 13  # elements of the signals, about
_INSIDE = 1e-3  # of a step: on which side of an edge a point is
_NEAR = 1e-9  # of a step: an edge that is nearer to a sample is that sample


def lean(
    observe: Callable[[Measurements], Observation], system: DescriptorSystem,
    signals: Measurements, solver: SolverSettings, *, rows: bool = False,
) -> Observation:
    """What ``observe`` finds along the signals, by way of :func:`thinned` ones if there are any.

    The regression found along these has no resets and is affine in the signals, and so is the
    state, which then is known at the long elements' points, or instead at their ends and at all
    ``rows`` of the signals.
    """
    few = thinned(system, signals, solver)
    if few is None:
        return observe(signals)
    found = observe(few)
    regression, state_map, errors = found.regression, found.state_map, found.errors
    extension = found.truth.extension if isinstance(found.truth, InitialError) else None
    if errors is None or not (
        isinstance(state_map, AffineStateMap) and isinstance(extension, Trajectory)
    ):
        raise TypeError("an observation that says what errors of the signals do to it")
    size = np.abs(extension.values[..., :1]).max(axis=(0, 1))  # of ξ_a, (k, 1)
    mesh, (r, p) = regression.mesh, regression.psi.values.shape[2:]
    Y, offset = regression.Y.values.copy(), state_map.offset.values.copy()
    estimate, count, factor = found.error_estimate, 0, np.zeros((0, p + 1))
    at_rows: list[tuple[Array, Array]] = []  # times, and the offset there
    for part, added, at_points, t, error in beyond(errors, mesh, signals, few, size, solver):
        estimate = max(estimate, error)
        Y[part] += _projected(Trajectory(added.mesh, added.values[:, :, :r, 0]), mesh, part)
        offset[part] += at_points[:, :, r:]
        t_in = t + _INSIDE * added.mesh.steps.min()
        beside = added(t, t_in)[:, :, 0]
        full = regression.Y(t, t_in) + beside[:, :r]
        own = np.concatenate([regression.psi(t, t_in), full[:, :, None]], axis=2)
        factor = triangular([np.concatenate([factor, own.reshape(-1, p + 1)])])
        count += len(t)
        if rows:
            at_rows += [
                (t, state_map.offset(t, t_in) + beside[:, r:]),
                (mesh.edges[part], offset[part, 0]),
            ]
    duration = float(mesh.edges[-1] - mesh.edges[0])
    state_map = replace(state_map, offset=Trajectory(mesh, offset))
    if rows:
        times, offsets = zip(*at_rows, (mesh.edges[-1:], offset[-1, -1:]), strict=True)
        t, first = np.unique(np.concatenate(times), return_index=True)
        state_map = replace(
            state_map, offset=mesh.sampled(t, np.concatenate(offsets)[first]),
            gain=mesh.sampled(t, state_map.gain(t)),
        )
    return replace(
        found, error_estimate=estimate, respond=None,
        regression=replace(
            regression, Y=Trajectory(mesh, Y), factor=np.sqrt(duration / count) * factor
        ),
        state_map=state_map,
    )


def thinned(
    system: DescriptorSystem, signals: Measurements, solver: SolverSettings
) -> Measurements | None:
    """Straight lines between the signals at the wanted times, and where the plant's matrices jump.

    None: there are hardly more samples than that, or Y is not affine in them.
    """
    wanted = signals.wanted
    if wanted is None or signals.mesh.size < _MANY * len(wanted):
        return None
    if system.coefficients.signals or signals.derivatives is not None:
        return None
    start, stop = signals.span
    ends = np.unique(np.concatenate([[start], wanted, [stop]]))
    cuts = system.coefficients.breakpoints(start, stop)
    mesh = Mesh(edges(ends, cuts), radau_rule(solver.stages))
    at = signals.at(mesh.edges)
    both = at[:-1, None] + mesh.rule.points[:, None] * np.diff(at, axis=0)[:, None]
    u, y = (Trajectory(mesh, part) for part in np.split(both, [system.m], axis=2))
    return replace(signals, inputs=u, outputs=y, wanted=None, asked=None)


def beyond(
    errors: ErrorsAt, mesh: Mesh, signals: Measurements, few: Measurements, size: Array,
    solver: SolverSettings,
) -> Iterator[tuple[slice, Trajectory, Array, Array, float]]:
    """What signals beyond ``few`` of them do by a system of errors, whose ζ is of a size (k, 1).

    Window by window of some elements of the mesh: which ones, the outputs (O, 1), their values
    (K, s + 1, O) at the mesh's points, the samples (N,) there, and an error estimate.
    """
    fine = edges(signals.mesh.edges, mesh.edges)
    cuts = np.searchsorted(fine, mesh.edges - 0.5 * _NEAR * mesh.steps.min())
    first, zeta, noise = 0, np.zeros((len(size), 1)), signals.noise
    samples = signals.mesh.edges if noise is None or noise.rows is None else noise.rows.t
    errors = _interpolated(errors, mesh, solver.tol)

    def difference(t: Array, inside: Array) -> Array:
        """[u; y] beyond the thinned ones at the times t (N,), (N, m + r, 1)."""
        return (signals.at(t, inside) - few.at(t, inside))[:, :, None]

    while first < mesh.size:
        last = max(first + 1, int(np.searchsorted(cuts, cuts[first] + _AT_ONCE, side="right")) - 1)
        window = Mesh(fine[cuts[first] : cuts[last] + 1], signals.mesh.rule)
        part, own = slice(first, last), slice(*samples.searchsorted(window.edges[[0, -1]]))
        added, zeta, error = driven(
            errors, difference, window, zeta, tol=solver.tol, max_elements=solver.max_elements,
            floor=size,
        )
        points, near = mesh.points[part], _INSIDE * added.mesh.steps.min()
        inside = points.clip(points[:, :1] + near, points[:, -1:] - near)  # of a short element
        at_points = added(points.ravel(), inside.ravel()).reshape(*points.shape, -1)
        yield part, added, at_points, samples[own], error
        first = last


def _interpolated(errors: ErrorsAt, mesh: Mesh, tol: float) -> ErrorsAt:
    """The same system from its values at the points of a mesh, if that resolves them."""
    system = errors(mesh.points.ravel(), mesh.inside.ravel())
    if all(len(part) == 1 for part in system) or sum(part[0].size for part in system) > _LARGE:
        return errors
    shapes = [part.shape[1:] for part in system]
    values = np.concatenate([
        np.broadcast_to(part, (mesh.points.size, *shape)).reshape(*mesh.points.shape, -1)
        for part, shape in zip(system, shapes, strict=True)
    ], axis=2)
    if unresolved(values, mesh.rule).max() > tol:
        return errors
    known, ends = Trajectory(mesh, values), np.cumsum([prod(shape) for shape in shapes])

    def at(t: Array, inside: Array) -> ErrorSystem:
        parts = np.split(known(t, inside), ends[:-1], axis=1)
        return ErrorSystem(*(
            part.reshape(len(t), *shape) for part, shape in zip(parts, shapes, strict=True)
        ))

    return at


def _projected(signal: Trajectory, mesh: Mesh, part: slice) -> Array:
    """Ỹ of a signal at the points of some elements of another mesh, (K, s + 1, rows)."""
    fine, s = signal.mesh, mesh.rule.stages
    whole = np.searchsorted(mesh.edges, fine.edges[:-1] + 0.5 * fine.steps) - 1
    place = (fine.points[:, 1:] - mesh.edges[whole, None]) / mesh.steps[whole, None]
    weights = fine.steps[:, None] * fine.rule.integration[-1]
    by_degree = weights[..., None] * legendre.legvander(2.0 * place - 1.0, s - 1)
    moments = transpose(by_degree) @ signal.values[:, 1:]
    firsts = np.searchsorted(whole, np.arange(part.start, part.stop))
    moments = np.add.reduceat(moments, firsts) / mesh.steps[part, None, None]
    basis = legendre.legvander(2.0 * mesh.rule.points - 1.0, s - 1)
    return np.asarray(basis * (2.0 * np.arange(s) + 1.0) @ moments)
