"""The Kalman–Bucy filter on the reduced system of the GPEBO observer.

The plant is the linear system of ``_filter_model.py``, whose state ζ = (θ, w) the filter estimates.
The state follows as x = X_w w + X_θ θ + x_y. What the signals' noise does to x_y directly is part
of the standard deviations of x̂; its correlation with ζ̂ (of order T_s) is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence.uncertainty import noise_level
from gpebo_cli.findings import Assumption, Requirement
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Samples, Trajectory
from gpebo_cli.observers._base import (
    AffineStateMap,
    Filtering,
    Measurements,
    Observation,
    Reconstruction,
    SignalNoise,
)
from gpebo_cli.observers._filter_model import (
    ROUNDING,
    FilterModel,
    NoiseModel,
    filter_model,
    inside_range,
)
from gpebo_cli.observers._observability import window_gramians
from gpebo_cli.observers._riccati import Filtered, StateSpace, filter_windows, pair
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.observers.reduced.condensed import beyond, thinned
from gpebo_cli.observers.reduced.system import SMALL, ReducedSystem, reduced_system
from gpebo_cli.observers.remedies.current_coordinates import CurrentState
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.estimator import Found
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.schema import instant, per_name
from gpebo_cli.settings import NoiseSettings, SolverSettings

_LEVEL = 1e-8  # of M's largest eigenvalue over all windows, in units of P(0)⁻¹: below, no evidence
_INITIAL_VARIANCE = 10.0  # of what observer.P0 leaves out
_HELD = 7.0  # times what a regression takes: pairs of 2 n by n + 1, and what they follow; measured
_ALIKE = 1.0 + 1e-6  # times a number: what rounding makes of it


@dataclass(frozen=True)
class KalmanBucy:
    """Unknown parameters are constant states; it estimates by itself.

    Attributes:
        form: form of the equations, as for gpebo.
        xi_a0: first estimate of the differential states, as for gpebo; of unknowns: 0.
        P0: its variance: one number, a list, or by name (theta1, w_e1; absent: 10).
        process: intensity of white noise that drives what is estimated, given as P0 is (absent: 0).
        regularisation: where the noise leaves measurements exact: standard deviation of the noise
            assumed instead, relative to each one's own under P0, at the noise's sample time.
    """

    form: Literal["auto", "given", "strangeness_free"] = "auto"
    xi_a0: Mapping[str, float] | list[float] | None = None
    P0: float | list[float] | Mapping[str, float] = 10.0
    process: float | list[float] | Mapping[str, float] = 0.0
    regularisation: float = field(default=1e-3, metadata={"range": (1e-6, 1.0)})

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """Run the filter; the regression is that of the GPEBO observer, as evidence of excitation.

        ConfigError: settings that do not fit the plant.
        """
        if signals.asked is None or system.n > SMALL or solver.name == "ivp":
            signals = replace(signals, asked=None)
            signals.check_memory(system, _HELD)

        evidence = Gpebo(form=self.form, xi_a0=self.xi_a0).observe(system, signals, solver)
        form = next(str(a.evidence["form"]) for a in evidence.assumptions if "form" in a.evidence)
        few = thinned(system, _with_pauses(signals), solver)
        known = reduced_system(
            system, replace(few or signals, wanted=None), solver, xi_a0=self.xi_a0, form=form
        )
        names = (*system.unknowns, *known.labels)
        if not (system.unknowns or known.begin.names):
            raise ConfigError(
                f"plant {system.name} has neither unknowns nor states that its constraints leave "
                "free: there is nothing for observer=kalman_bucy to filter; observer=gpebo takes it"
            )
        mesh = known.mesh
        windows = [mesh] if few or signals.asked is None else mesh.windows()
        noise, level = _noise(signals, system, evidence)
        variances = per_name(self.P0, names, "estimate", "observer.P0", absent=_INITIAL_VARIANCE)
        # What is known at the start counts as what is least known.
        sizes = np.concatenate([known.form.units.unknowns, known.units])
        varies = np.where(variances > 0.0, variances, sizes**2 * (variances / sizes**2).max())
        followed = _Followed(known, _steps(noise, mesh), sizes, NoiseModel(
            noise.variances * noise.sample_time,
            per_name(self.process, names, "estimate", "observer.process", absent=0.0),
            self.regularisation**2 * noise.sample_time * varies,
        ))
        start = np.append(np.zeros(system.q), known.first.split.dual @ known.xi_a)
        P0, (floor, regularised) = _initial_covariance(variances, known), followed.rounding(windows)
        parts = filter_windows(
            followed.model, start[:, None], P0, windows, tol=solver.tol,
            max_elements=solver.max_elements, monitor=followed.monitor, floor=floor / solver.tol,
            sizes=sizes, name=f"Kalman-Bucy filter of plant {system.name}",
        )
        filtered = next(parts) if len(windows) == 1 else _kept(parts, mesh, signals.wanted)
        if few is not None:
            filtered = _along_all(filtered, signals, few, solver, followed.errors(filtered))
        gramians = window_gramians(
            followed.information, len(start), filtered.mesh, tol=max(solver.tol, 1e-9),
            max_elements=solver.max_elements,
        )
        observability = _uniform_observability(*gramians, P0, known, sizes)
        note = evidence.note + _told(level, known.form.noise_enters(noise.variances > 0.0))
        intensities = (f"intensity_{name}" for name in (*system.inputs, *system.outputs))
        used: dict[str, float | int | str | None] = dict(
            zip(intensities, followed.noise.signals.tolist(), strict=True)
        )
        if regularised:
            share = f"{self.regularisation:g} of each equation's own under P0"
            used["regularised_with"] = f"noise of {share} at {noise.sample_time:g} s"
            note += f"; measurement noise regularised: {share} (observer.regularisation)"
        unknown = noise.rows is not None and not noise.variances.any()
        return Observation(
            regression=evidence.regression,
            state_map=FilterStateMap(filtered, noise.variances + (np.nan if unknown else 0.0)),
            truth=CurrentState(known),
            error_estimate=filtered.error_estimate,
            assumptions=(
                *evidence.assumptions,
                Assumption(
                    "Measurement noise", "its covariance V(t) is positive definite, regularised "
                    "where the noise leaves it singular", True, used,
                ),
                Assumption(
                    observability.name,
                    "the observability Gramian over windows of a tenth of the horizon stays away "
                    "from singular", observability.holds, observability.evidence,
                ),
            ),
            growth=None,
            estimator=Filter(filtered, observability),
            names=names,
            evidence=evidence, drifts=bool(followed.noise.process.any()),
            note=note,
        )


@dataclass(frozen=True, eq=False)
class _Followed:
    """What the filter follows, as functions of time t (N,); see :class:`FilterModel`."""

    known: ReducedSystem
    steps: Callable[[Array], Array | float]
    sizes: Array  # (n,) of ζ
    noise: NoiseModel

    def at(self, t: Array, inside: Array) -> FilterModel:
        """The linear system along the measured signals."""
        o, driving = self.known.matrices(t, inside), self.known.measured(t, inside)
        return filter_model(o, driving, self.known.form, self.steps(inside))

    def model(self, t: Array, inside: Array) -> tuple[StateSpace, tuple[Array, ...]]:
        """That with its covariances, and how the state follows from ζ."""
        s = self.at(t, inside)
        return self.noise.state_space(s), (s.offset, s.gain, s.direct)

    def monitor(self, estimate: Array, extras: tuple[Array, ...]) -> list[tuple[Array, float]]:
        """What the mesh resolves, too: x̂ and the state's gain, in units of the states."""
        units, sizes = self.known.form.units.states, self.sizes
        offset, gain = extras[0] / units, extras[1] / (units[:, None] / sizes)
        x = offset + np.einsum("ksij,ksj->ksi", gain, estimate[..., 0] / sizes)
        return [(x, 0.0), (gain.reshape(*gain.shape[:2], -1), 0.0)]

    def information(self, t: Array, inside: Array) -> tuple[Array, Array]:
        """A and cᵀV⁻¹c, of ζ in units of its sizes."""
        m, sizes = self.noise.state_space(self.at(t, inside)), self.sizes
        return m.A * sizes / sizes[:, None], sizes[:, None] * sizes * (
            transpose(m.c) @ np.linalg.solve(m.V, m.c)
        )

    def rounding(self, windows: Sequence[Mesh]) -> tuple[Array, bool]:
        """What of ζ (n,) may be rounding of the known part of x, and if V is regularised."""
        fastest, offsets, regularised = 0.0, np.zeros(1), False
        for window in windows:
            s = self.at(window.points.ravel(), window.inside.ravel())
            fastest = max(fastest, float(np.abs(s.A * self.sizes / self.sizes[:, None]).max()))
            offsets = np.maximum(offsets, np.abs(s.offset).max(axis=0))
            regularised |= bool(self.noise.measured(s)[2].any())
        # It adds up.
        turns = 1.0 + fastest * float(np.diff(self.known.mesh.edges[[0, -1]])[0])
        beside = turns * np.abs(self.known.first.split.dual) @ offsets
        return ROUNDING * np.append(np.zeros(self.known.system.q), beside), regularised

    def errors(self, found: Filtered) -> ErrorsAt:
        """What errors of the signals do to ζ̂ and to the state's offset, with P as ``found``."""
        def at(t: Array, inside: Array) -> ErrorSystem:
            s, (P, _) = self.at(t, inside), found.at(t, inside)
            m, n = self.noise.state_space(s), P.shape[-1]
            transposed = np.linalg.solve(m.V, transpose(np.asarray(P @ transpose(m.c) + m.N)))
            L = transpose(np.asarray(transposed, dtype=np.float64))
            inward = L @ transpose(s.rows) @ s.in_measurement - s.from_noise
            C = np.eye(n + s.direct.shape[1], n)[None]
            D = np.concatenate([np.zeros_like(inward), s.direct], axis=1)
            return ErrorSystem(m.A - L @ m.c, inward, C, D)

        return at


OBSERVER = KalmanBucy


def _told(level: float, inside: Sequence[str]) -> str:
    """A ``level`` of noise from the residual, and whose noise is ``inside`` matrices, with "; "."""
    told = f"; noise of the outputs taken from the residual, {level:.2g}" if level > 0.0 else ""
    if inside:
        told += f"; deviations know nothing of the noise of {', '.join(inside)} in the matrices"
    return told


def _noise(
    signals: Measurements, system: DescriptorSystem, evidence: Observation
) -> tuple[SignalNoise, float]:
    """The noise of the signals, and the level that was taken from the residual, or 0."""
    noise = signals.noise or SignalNoise(
        np.zeros(system.m), np.zeros(system.r), NoiseSettings().sample_time
    )
    if noise.rows is None or noise.variances.any() or evidence.errors is None:
        return noise, 0.0
    alike = np.concatenate([np.zeros(system.m), np.ones(system.r)])
    level = noise_level(evidence.errors, evidence.regression, noise.rows, alike)
    level = float(np.nan_to_num(level))
    return replace(noise, outputs=np.full(system.r, level)), level


def _with_pauses(signals: Measurements) -> Measurements:
    """With the ends of pauses among the wanted times: rows beside one do not count as it does."""
    rows = None if signals.noise is None else signals.noise.rows
    if rows is None or signals.wanted is None:
        return signals
    first, (start, stop) = np.flatnonzero(rows.pauses), signals.span
    ends = rows.t[np.concatenate([first, first + 1])].clip(start, stop)
    return replace(signals, wanted=np.union1d(signals.wanted, ends))


def _steps(noise: SignalNoise, mesh: Mesh) -> Callable[[Array], Array | float]:
    """Seconds for each row at times (N,) over the sample time, the same in each element of a mesh.

    Several rows there count by how long each is held: the mean of what moves an integral over all.
    """
    rows = noise.rows
    if rows is None:
        return lambda _inside: 1.0
    variances = np.append(0.0, (rows.intensities(rows.t[:-1]) * np.diff(rows.t)).cumsum())
    seconds = np.diff(np.interp(mesh.edges, rows.t, variances)) / mesh.steps / noise.sample_time
    return lambda inside: seconds[
        np.searchsorted(mesh.edges, inside, side="right").clip(1, mesh.size) - 1
    ]


def _along_all(
    found: Filtered, signals: Measurements, few: Measurements, solver: SolverSettings,
    errors: ErrorsAt,
) -> Filtered:
    """What was ``found`` along few signals, along all of them; P does not depend on them."""
    mesh = Mesh(found.mesh.origin + found.mesh.edges, found.mesh.rule)
    pairs, offset, n = found.pair.values.copy(), found.extras[0].values.copy(), len(found.unit)
    size, estimate = (found.unit * found.sizes[0])[:, None], found.error_estimate
    for part, _, added, _, error in beyond(errors, mesh, signals, few, size, solver):
        pairs[part, :, n:, n:] += (added[:, :, :n] / found.unit)[..., None]
        offset[part] += added[:, :, n:]
        estimate = max(estimate, error)
    return replace(
        found, pair=Trajectory(found.mesh, pairs), error_estimate=estimate,
        extras=(Trajectory(found.mesh, offset), *found.extras[1:]),
    )


def _kept(parts: Iterable[Filtered], mesh: Mesh, t: Array | None) -> Filtered:
    """What windows of a mesh give at the times t (M,); the mesh is the one that they resolve."""
    asked = np.union1d(mesh.span, mesh.span if t is None else t)
    kept: list[tuple[Array, ...]] = []
    edges, error = [mesh.edges[:1] + mesh.origin], 0.0
    for part, own in zip(parts, mesh.shares(asked), strict=True):
        kept.append((*part.at(own), *(extra(own) for extra in part.extras)))
        edges.append(part.mesh.edges[1:] + part.mesh.origin)
        error = max(error, part.error_estimate)
    P, estimate, *extras = map(np.concatenate, zip(*kept, strict=True))
    whole = Mesh(np.concatenate(edges), mesh.rule)
    pairs = np.array([pair(*each) for each in zip(P, estimate, strict=True)])
    return Filtered(
        whole.sampled(asked, pairs), 1.0, np.ones(len(P[0])), error,
        tuple(whole.sampled(asked, extra) for extra in extras),
    )


def _initial_covariance(variances: Array, known: ReducedSystem) -> Array:
    """P(start) (n, n) of what is possible: w = offset + from_unknowns θ + V z."""
    q, n, dual = known.system.q, len(variances), known.first.split.dual
    inside = np.zeros((n, n))
    inside[:q, :q], inside[q:, :q] = np.eye(q), dual @ known.begin.from_unknowns
    inside[q:, q:] = dual @ known.begin.basis @ known.begin.dual @ known.basis
    return np.asarray((inside * variances) @ inside.T)


def _uniform_observability(
    gramians: Array, starts: Array, window: float, P0: Array, known: ReducedSystem, sizes: Array
) -> Requirement:
    """λ_min of M, of ζ in units of ``sizes`` (n,), over all windows, in units of P(0)⁻¹.

    It is that in the directions that ζ has; the first three are those of :func:`window_gramians`.
    """
    n, q = len(P0), known.system.q
    split = known.matrices(starts, starts).split
    inside = inside_range(q, split) * sizes / sizes[:, None]
    scale = np.sqrt(np.diag(P0)) / sizes
    scale = np.where(scale > 0, scale, scale.max(initial=0.0) or 1.0)
    M = scale[:, None] * (inside @ gramians @ inside) * scale
    values = np.linalg.eigvalsh(M)
    rank = q + len(known.begin.names)
    smallest = np.maximum(values[:, n - rank], 0.0)
    k = int(np.argmax(smallest <= smallest.min() * _ALIKE))  # the first of those that are alike
    level, at = float(smallest[k]), float(starts[k])
    needed = _LEVEL * float(values.max(initial=0.0))
    return Requirement(
        name="uniform observability",
        holds=level >= needed > 0,
        evidence={
            "lambda_min": level, "window_start": at, "window": window,
            "largest_lambda_min": float(smallest.max()), "needed": needed,
        },
        text=(
            f"over windows of {window:.3g} s, λ_min of the observability Gramian falls to "
            f"{level:.3g} of P0⁻¹ (from t = {instant(at)} s on; evidence needs {needed:.2g})"
        ),
    )


@dataclass(frozen=True, eq=False)
class FilterStateMap(Filtering):
    """x̂ = offset + gain ζ̂, and what the filter's covariance means for the state."""

    filtered: Filtered
    variances: Array  # (m + r,) of ν

    @property
    def times(self) -> Array:
        """The points of the filter's mesh, because its errors depend on what it reached there."""
        found = self.filtered.pair
        return found.t if isinstance(found, Samples) else np.unique(found.mesh.points)

    def at(self, t: Array) -> Reconstruction:
        """The affine map at the times t (M,), ascending."""
        offset, gain, _ = self.filtered.extras
        return AffineStateMap(offset, gain).at(t)

    def deviations(self, t: Array) -> tuple[Array, Array]:
        """Standard deviations of ζ̂ (M, n) and of x̂ (M, states), NaN if nobody knows the noise."""
        P, _ = self.filtered.at(t)
        _, gain, direct = (signal(t) for signal in self.filtered.extras)
        of_state = np.einsum("mij,mjk,mik->mi", gain, P, gain)
        of_state += direct**2 @ self.variances
        own = np.einsum("mii->mi", P) + 0.0 * self.variances.sum()
        return np.sqrt(np.maximum(own, 0.0)), np.sqrt(np.maximum(of_state, 0.0))


@dataclass(frozen=True, eq=False)
class Filter:
    """The filter as an estimator with one case, which does not use the regression."""

    filtered: Filtered
    observability: Requirement
    cases: tuple[Mapping[str, float], ...] = ({},)

    def estimate(self, regression: LinearRegression, t: Array) -> Found:  # noqa: ARG002
        """ζ̂ at the times t (M,)."""
        return Found(self.filtered.at(t)[1][None, :, :, 0], self.observability)
