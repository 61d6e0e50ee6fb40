"""Resets of the dynamic extension, for a plant whose A_0 does not forget.

At times t_k the extension starts again, from [ξ_a₊ | 0 | V₊] with V₊ a basis of
range P(t_k), and the regression has other parameters from then on. From
w = ξ_a + ξ_b θ − Φ e₀ = ξ_a₊ − V₊ e₊,

    η₊ = T η + τ,    T = [[I, 0], [−V₊ᵀξ_b, V₊ᵀΦ]],    τ = (0, V₊ᵀ(ξ_a₊ − ξ_a)),

which is exact whatever ξ_a₊ is. It is the least-squares estimate of w(t_k) by all that the
regression has shown. A ξ_a that is not replaced would grow as Φ does, and so would e₊: w would
become the difference of large numbers, which is the loss that resets are for.

Φ has size 1 after each reset. If no times are given, it is reset before it exceeds 100.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.model.expressions.bounds import with_others
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.observers._base import Observation, log_norm
from gpebo_cli.observers.reduced.extension import Extension, extend, joined
from gpebo_cli.observers.reduced.split import comparable, units_along
from gpebo_cli.observers.reduced.system import ReducedSystem, Start
from gpebo_cli.observers.remedies.plain import observation
from gpebo_cli.regression.linear import outer_products
from gpebo_cli.regression.resets import ExtensionState, Reset, level_of

_GROWTH = 100.0  # of Φ between resets: two digits
_TOLERANCE = 1e-6  # of Φ, where only its size matters
_MOST = 10_000  # resets in one run
_FLOOR = 1e-3  # of the size of w and θ: parameters are resolved to so much, relatively
_APART = 1e8  # times the energy of a state's error: beside more float64 numbers lose it
_KNOWN = 1e-10  # eigenvalues of G below this share of the largest say nothing about w


@dataclass(frozen=True)
class Resets:
    """The extension starts again, at intervals and at given times.

    Attributes:
        interval: seconds; without it and without ``times``: before Φ exceeds 100.
        times: further ones, seconds.
        keep: share of what is known that counts after a reset; 0 forgets everything.
    """

    interval: float | None = field(
        default=None, metadata={"key": "reset_interval", "positive": True}
    )  # seconds
    times: list[float] = field(default_factory=list, metadata={"key": "reset_times"})
    keep: float = field(default=1.0, metadata={"key": "reset_keep", "range": (0.0, 1.0)})

    def observe(self, reduced: ReducedSystem) -> Observation:
        """One regression over all segments, with the maps from each to the next."""
        p = len(reduced.parameters)
        times = reset_times(reduced, self)[: None if p else 0]  # of nothing nothing starts again
        mesh, times = _with_edges(reduced.mesh, times)
        cuts = [0, *np.searchsorted(mesh.edges, times).tolist(), mesh.size]
        begin, xi_a, dual = reduced.begin, reduced.xi_a, reduced.first.split.dual
        later: list[tuple[float, Array, Array]] = []
        extensions: list[Extension] = []
        resets: list[Reset] = []
        known = ExtensionState(np.zeros((p, p + 1)), 0.0)
        for first, last in pairwise(cuts):
            piece = Mesh(mesh.edges[first : last + 1], mesh.rule) if len(times) else mesh
            extensions.append(extend(reduced, piece, begin.extension(dual, xi_a)))
            if last == mesh.size:
                break
            shown = extensions[-1].assembled
            learned = extensions[-1].mesh.trajectory(outer_products(shown.psi, shown.Y))
            own = learned.integral().final
            known = ExtensionState(known.values + own, np.maximum(known.level, level_of(own)))
            time = float(mesh.edges[last])
            begin = reduced.start_at(time, float(mesh.inside[last, 0]))
            units = resets[-1].units if resets else reduced.parameter_units
            reset, xi_a = _restart(reduced, extensions[-1], known, time, begin, units)
            resets.append(replace(reset, keep=self.keep))
            known = known.after(resets[-1])
            later.append((time, begin.dual, begin.dual @ xi_a))
        segments = joined(extensions)
        growth, logarithms = zip(*(e.growth(reduced) for e in extensions), strict=True)
        return observation(reduced, segments, max(growth), sum(logarithms), resets, later)


def _restart(
    reduced: ReducedSystem, extension: Extension, known: ExtensionState, time: float, begin: Start,
    units: Array | float,
) -> tuple[Reset, Array]:
    """T and τ from [ξ_a | ξ_b | Φ] at the end, and ξ_a (n,) where the next segment begins."""
    q, dual = reduced.system.q, begin.dual
    end = reduced.basis @ extension.trajectory.final
    xi_a, xi_b, Phi = end[:, 0], end[:, 1 : 1 + q], end[:, 1 + q :]
    units = np.array(np.broadcast_to(units, len(known.values)))
    # What an unknown does at the start is no unit of it where it does much more by now.
    energy = np.maximum(known.values.diagonal(), np.finfo(float).tiny)
    if (most := _APART * (units**2 * energy)[q:].max(initial=0.0)) > 0.0:
        units[:q] = np.minimum(units[:q], np.sqrt(most / energy[:q]))
    own = units[:, None] * known.values * np.append(units, 1.0)
    eta = units * (np.linalg.pinv(own[:, :-1], rcond=_KNOWN, hermitian=True) @ own[:, -1])
    reached = xi_a + xi_b @ eta[:q] - Phi @ eta[q:]
    after = begin.offset + begin.basis @ (dual @ reached)
    p = q + len(dual)
    transform = np.eye(p)
    transform[q:, :q], transform[q:, q:] = -dual @ xi_b, dual @ Phi
    shift = np.concatenate([np.zeros(q), dual @ (after - xi_a)])
    of_states, of_unknowns = reduced.form.units.states, units[:q]
    floor = _FLOOR * max(
        float(np.abs(part).max(initial=0.0)) for part in (eta[:q] / of_unknowns, after / of_states)
    )
    new = np.append(of_unknowns, units_along(begin.basis, of_states))
    errors = np.concatenate([np.zeros((q, reduced.basis.shape[1])), dual @ reduced.basis])
    return Reset(time, transform, shift, floor, errors=errors, before=units, units=new), after


def reset_times(reduced: ReducedSystem, settings: Resets) -> Array:
    """When to reset, ascending, strictly inside the horizon.

    ConfigError: a time outside, or too many.
    """
    start, stop = reduced.signals.span
    outside = [t for t in settings.times if not start < t < stop]
    if outside:
        raise ConfigError(
            f"observer.reset_times: {outside[0]:g} is not between start and end, {start:g} and "
            f"{stop:g}"
        )
    times, interval = list(settings.times), settings.interval
    if interval is not None:
        count = (stop - start) / interval
        if count > _MOST:
            raise ConfigError(
                f"observer.reset_interval = {interval:g} makes {count:.0f} resets; at most {_MOST}"
            )
        times += [start + k * interval for k in range(1, int(np.ceil(count * (1 - 1e-12))))]
    elif not times:
        return growth_times(reduced)
    return np.unique(times)


def growth_times(reduced: ReducedSystem) -> Array:
    """The last edges of the signals' mesh before ‖Φ‖ exceeds its limit, from reset to reset."""
    mesh, units = reduced.mesh, reduced.units
    d = len(units)
    eye = np.eye(d)

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        return LinearEquation(
            None, reduced.matrices(t, inside).dynamics, np.zeros((len(t), d, d))
        )

    restarts: dict[float, Callable[[Array], Array]] = {
        float(edge): lambda _: eye for edge in mesh.edges[1:-1]
    }
    problem = LinearProblem(coefficients, eye, name=f"growth of plant {reduced.system.name}")
    with np.errstate(over="ignore", invalid="ignore"):  # of the error estimate, which is not used
        solution = solve(
            problem, mesh, tol=_TOLERANCE, max_elements=reduced.solver.max_elements,
            restarts=restarts,
        )
    finer = solution.trajectory
    last = np.searchsorted(finer.mesh.edges, mesh.edges[1:]) - 1  # its last part, of each element
    Phi = comparable(reduced.first.split.dual @ reduced.begin.basis, units)
    times = []
    for k, step in enumerate(finer.values[last, -1]):
        step = step * units / units[:, None]  # noqa: PLW2901
        if k > 0 and log_norm(step @ Phi) > np.log(_GROWTH):
            times.append(float(mesh.edges[k]))
            Phi = np.linalg.svd(Phi, full_matrices=False)[0]  # orthonormal, of the same range
        Phi = step @ Phi
    return np.array(times)


def _with_edges(mesh: Mesh, times: Array) -> tuple[Mesh, Array]:
    """The mesh with edges at the times, and the times as edges; near ones fall together."""
    if not len(times):
        return mesh, times
    near = 1e-9 * float(mesh.edges[-1] - mesh.edges[0])
    finer = Mesh(with_others(mesh.edges, times, near), mesh.rule)
    k = np.unique([int(np.abs(finer.edges - t).argmin()) for t in times])
    return finer, finer.edges[k[(k > 0) & (k < finer.size)]]
