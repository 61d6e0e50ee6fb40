"""Several recordings of one plant as one experiment: the same θ, an initial state of each its own.

On the time axis they follow one another. The regression is about η = (θ, e₀, e₀ of the second, …);
rows of a recording have zeros in the columns of the others' initial errors. Each is observed by
itself, at its own times, which the plant's matrices are functions of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment.sources import Source
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import triangular
from gpebo_cli.numerics.mesh import Mesh, Samples, Trajectory, joined
from gpebo_cli.observers import AffineStateMap, Observation
from gpebo_cli.regression.errors import ErrorSystem, one_after_another
from gpebo_cli.regression.linear import LinearRegression


def joined_source(sources: Sequence[Source]) -> Source:
    """Recordings one after the other; of each the last sample gives way to the next one's first."""
    recordings = [source.recording for source in sources if source.recording is not None]
    if len(recordings) < 2:
        return sources[0]
    shifts = _shifts(sources)

    def together(parts: Sequence[Array], by: Sequence[float] | None = None) -> Array:
        """Of each but the last all but the last sample, in the time of all where they are times."""
        moved = parts if by is None else list(map(np.add, parts, by))
        return np.concatenate([*(part[:-1] for part in moved[:-1]), moved[-1]])

    t = together([source.t for source in sources], shifts)
    rows = [source.rows for source in sources if source.rows is not None]
    recording = replace(
        recordings[0], t=t,
        inputs=together([each.inputs for each in recordings]),
        outputs=together([each.outputs for each in recordings]),
        states=together([each.states for each in recordings]),
        file=", ".join(each.file for each in recordings),
        sha256=", ".join(each.sha256 for each in recordings),
        rows=sum(each.rows for each in recordings), last=recordings[-1].last + shifts[-1],
        known_states=tuple(
            name for name in recordings[0].known_states
            if all(name in each.known_states for each in recordings)
        ),
        elements=sum(each.elements for each in recordings),
        bounded=all(each.bounded for each in recordings),
        note="".join(dict.fromkeys(each.note for each in recordings)),
    )
    return replace(
        sources[0], t=t, recording=recording, derivatives=None, pieces=tuple(sources),
        own_t=together([source.t for source in sources]),
        rows=rows[0]._replace(t=together([each.t for each in rows], shifts)),
        states=_joined([each.states for each in sources], shifts),
    )


def joined_observation(
    observations: Sequence[Observation], sources: Sequence[Source], q: int
) -> Observation:
    """One regression about θ (q,) and every initial error, of observations of each recording.

    ConfigError: an observer or a remedy whose parameters are others.
    """
    affine = [own for own in (each.of_constants for each in observations) if own is not None]
    if len(affine) < len(observations):
        raise ConfigError(
            "data.file: several files need an observer whose parameters are θ and the initial "
            "error; accepted is observer=gpebo with remedy none, output_injection or noise_free"
        )
    shifts, regressions = _shifts(sources), [each.regression for each in observations]
    places = list(accumulate((each.p - q for each in regressions), initial=q))
    p = places[-1]

    def wide(values: Array, k: int) -> Array:
        """Columns (…, p_k) of one recording among those of all, (…, p)."""
        out = np.zeros((*values.shape[:-1], p))
        out[..., :q], out[..., places[k] : places[k + 1]] = values[..., :q], values[..., q:]
        return out

    names = [
        name if not k else f"{name}_{k + 1}"
        for k, each in enumerate(regressions) for name in each.parameters[q:]
    ]
    condensed = any(each.factor is not None for each in regressions)
    factors = list(map(_factor, regressions, sources)) if condensed else []
    rows = max(each.psi.values.shape[2] for each in regressions)
    psi = _joined([
        Trajectory(each.mesh, wide(_filled(each.psi.values, rows), k))
        for k, each in enumerate(regressions)
    ], shifts)
    scale = np.concatenate([
        wide(np.broadcast_to(each.scale, (each.mesh.size, each.p)), k)
        for k, each in enumerate(regressions)
    ])
    same = all(each.psi.values.shape[2] == rows for each in regressions)
    errors = [each.errors for each in observations if each.errors is not None]
    # Where one ends, which the next one's first row may miss by rounding.
    sizes = [0, *(each.mesh.size for each in regressions[:-1])]
    starts = psi.mesh.edges[np.cumsum(sizes)]

    def errors_at(k: int, t: Array, inside: Array) -> ErrorSystem:
        return errors[k](t - shifts[k], inside - shifts[k])

    def truth(t: Array, theta: Array, states: Trajectory) -> Array:  # noqa: ARG001  of each its own
        eta = np.concatenate([
            theta[0], *(
                each.truth(source.t[:1], theta[:1], source.states)[0, q:]
                for each, source in zip(observations, sources, strict=True)
            ),
        ])
        return np.broadcast_to(eta, (len(t), p))

    growth = [each.growth for each in observations if each.growth is not None]
    rates = [each.growth_rate for each in observations if each.growth_rate is not None]
    return replace(
        observations[0],
        regression=LinearRegression(
            _joined([
                Trajectory(each.mesh, _filled(each.Y.values, rows)) for each in regressions
            ], shifts),
            psi, (*regressions[0].parameters[:q], *names), np.maximum.accumulate(scale, axis=0),
            factor=np.concatenate([
                np.column_stack([wide(factor[:, :-1], k), factor[:, -1]])
                for k, factor in enumerate(factors)
            ]) if condensed else None,
            since=float(starts[-1]),
        ),
        state_map=AffineStateMap(
            _joined([each.offset for each in affine], shifts),
            _joined([
                replace(each.gain, values=wide(each.gain.values, k))
                for k, each in enumerate(affine)
            ], shifts),
            affine[0].units,
        ),
        truth=truth, error_estimate=max(each.error_estimate for each in observations),
        assumptions=_weakest([each.assumptions for each in observations], shifts),
        growth=max(growth, default=None), growth_rate=max(rates, default=None), respond=None,
        errors=one_after_another(starts, errors_at)
        if same and len(errors) == len(observations) else None,
        starts=starts,
    )


def _weakest(
    found: Sequence[Sequence[Assumption]], shifts: Sequence[float]
) -> tuple[Assumption, ...]:
    """Of each assumption the one of the recording in which it holds least, at the time of all."""
    def moved(a: Assumption, by: float) -> Assumption:
        at = a.evidence.get("at")
        return replace(a, evidence={**a.evidence, "at": at + by}) if isinstance(at, float) else a

    def margin(a: Assumption) -> tuple[bool, float]:
        return a.holds, float(a.evidence.get("smallest_singular_value") or 0.0)

    every = [moved(a, by) for each, by in zip(found, shifts, strict=True) for a in each]
    names = dict.fromkeys(a.name for a in every)
    return tuple(min((a for a in every if a.name == name), key=margin) for name in names)


def _factor(regression: LinearRegression, source: Source) -> Array:
    """That of [ψ, Y] of a recording, where another one keeps no more of its rows than this."""
    if regression.factor is not None or source.samples is None:
        return regression.root
    start, stop = regression.mesh.edges[[0, -1]]
    t = source.samples[(source.samples >= start) & (source.samples <= stop)]
    rows = np.concatenate([regression.psi(t), regression.Y(t)[..., None]], axis=2)
    of_rows = triangular([rows.reshape(-1, regression.p + 1)])
    return np.asarray(np.sqrt((stop - start) / max(len(t), 1)) * of_rows)


def _shifts(sources: Sequence[Source]) -> list[float]:
    """What makes of each one's own time that of all."""
    shifts, end = [], float(sources[0].inputs.mesh.edges[0])
    for source in sources:
        edges = source.inputs.mesh.edges
        shifts.append(end - float(edges[0]))
        end += float(edges[-1] - edges[0])
    return shifts


def _filled(values: Array, rows: int) -> Array:
    """Values (K, s + 1, rows_k, …) with rows of zeros below."""
    missing = rows - values.shape[2]
    return np.pad(values, [(0, 0), (0, 0), (0, missing), *[(0, 0)] * (values.ndim - 3)])


def _joined(signals: Sequence[Trajectory], shifts: Sequence[float]) -> Trajectory:
    """One after the other, all by the rule with the most stages, in which each is exact.

    Of samples the last of each gives way to the next one's first.
    """
    rule = max((each.mesh.rule for each in signals), key=lambda each: each.stages)
    samples = [each for each in signals if isinstance(each, Samples)]
    if len(samples) == len(signals):
        pieces = [
            (each.mesh.edges[:last] + by, each.t[:last] + by, each.values[0, :last])
            for each, by, last in zip(
                samples, shifts, [-1] * (len(signals) - 1) + [None], strict=True
            )
        ]
        edges, t, values = map(np.concatenate, zip(*pieces, strict=True))
        return Mesh(edges, rule).sampled(t, values)
    same = (
        each if each.mesh.rule.stages == rule.stages else Mesh(each.mesh.edges, rule).along(each)
        for each in signals
    )
    return joined([
        Trajectory(Mesh(each.mesh.edges + by, rule), each.values)
        for each, by in zip(same, shifts, strict=True)
    ])
