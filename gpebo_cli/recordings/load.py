"""A recording as signals on the time span of an experiment."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem, check_sizes
from gpebo_cli.model.expressions.bounds import switched, with_others
from gpebo_cli.model.expressions.tape import aside
from gpebo_cli.model.text import TextCoefficients, sided
from gpebo_cli.numerics.mesh import Mesh, Trajectory, beside_edges
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.recordings.hold import Hold, each_of, held, holds, of_outputs, recording_mesh
from gpebo_cli.recordings.lines import Samples
from gpebo_cli.recordings.table import Table, read_table
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.schema import instant
from gpebo_cli.settings import DataSettings, TimeSettings

_ROUNDING = 1e-12  # of the largest time: by how much a span may miss the samples
_SHORTEST = 1e-14  # of the largest time: elements of a shorter span are not told apart


@dataclass(frozen=True, eq=False)
class Recording:
    """Signals of a recording: inputs and outputs share a mesh, states are the truth if known."""

    table: Table
    hold: Hold
    span: tuple[float, float]  # start and end of the experiment
    inputs: Trajectory  # (m,)
    outputs: Trajectory  # (r,)
    states: Trajectory  # (n,), NaN for a state that was not recorded
    bounded: bool  # known functions are, between the times at which they are evaluated

    @property
    def derivatives(self) -> InputDerivatives | None:
        """Derivatives of the inputs: only a cubic interpolant has any."""
        m = self.inputs.values.shape[2]
        known = np.array([word == "cubic" for word in each_of(self.hold, m)[:m]], dtype=bool)
        return InputDerivatives.of_signal(self.inputs, known) if known.any() else None

    @property
    def rows(self) -> Rows:
        """Those of the span with an output, whose ends count as rows."""
        t, (start, stop) = self.table.samples.t[self.table.measured], self.span
        inner = t[(t > start) & (t < stop)]
        hold = of_outputs(self.hold, self.inputs.values.shape[2])
        return Rows(np.concatenate([[start], inner, [stop]]), hold)

    def sampled(self, t: Array) -> Samples:
        """All signals at the times t (N,) of the span.

        A held input has at a sample the value of that sample, at the last one too; states are
        never held but interpolated, since they are what estimates are compared with.
        """
        samples, m = self.table.samples, self.inputs.values.shape[2]
        signal = held(samples.t, np.hstack([samples.inputs, samples.outputs]), self.hold)
        both = signal(t, beside_edges(t))
        return Samples(t, both[:, :m], both[:, m:], self.states(t))


def load(
    system: DescriptorSystem, data: DataSettings, time: TimeSettings, tol: float
) -> Recording:
    """Read ``data.file`` and make signals of it on the time span asked for.

    A start of −∞ is the first sample, a horizon of ∞ lasts to the last one (ConfigError: the file
    is not a recording of this plant, or shorter than the span).
    """
    if data.file == "-":
        raise ConfigError(
            "data.file=-: standard input is for gpebo run, once and without a sweep; give a file"
        )
    table = read_table(data, system)
    span = _span(table, time)
    samples = table.samples
    check_sizes(system, np.array(span))
    m, hold = system.m, holds(data.hold, system)
    values = np.concatenate([samples.inputs, samples.outputs], axis=1)
    mesh = recording_mesh(samples.t, values, hold, span, system.coefficients, tol)
    both = mesh.along(held(samples.t, values, hold))
    # What is narrow between samples: functions of time, then those of signals.
    edges, bounded = system.coefficients.of_time.resolved(mesh.edges)
    if isinstance(system.coefficients, TextCoefficients):
        edges, also = system.coefficients.along(both.cells, range(m + system.r), edges)
        bounded = bounded and also
    arguments = sided(system.coefficients)
    if arguments is not None:  # signals pass what jumps, as step does in C, between samples, too
        t = aside(mesh.points, mesh.inside).ravel()
        passed = switched(arguments, t, lambda t, order: both.taylor(t, order, t))
        edges = with_others(edges, passed)
    if len(edges) > len(mesh.edges):
        mesh = Mesh(edges, mesh.rule)
        both = mesh.along(both)
    return Recording(
        table=table,
        hold=hold,
        span=span,
        # Copies: each call of a kernel would make one of a part of all, as long as that is.
        inputs=Trajectory(mesh, both.values[..., :m].copy()),
        outputs=Trajectory(mesh, both.values[..., m:].copy()),
        states=_states(samples, span, smooth=of_outputs(hold, m) == "cubic"),
        bounded=bounded,
    )


def _span(table: Table, time: TimeSettings) -> tuple[float, float]:
    """Start and end of the experiment, both within the recording."""
    path, t = table.header.source, table.samples.t
    first, last = float(t[0]), float(t[-1])
    slack = _ROUNDING * max(abs(first), abs(last))
    start = first if math.isinf(time.start) else time.start
    stop = last if math.isinf(time.horizon) else start + time.horizon
    whole = "time.start=null time.horizon=null take the whole file"
    if not first - slack <= start < last:
        raise ConfigError(
            f"{path}, line {table.lines[0]}, column t: the recording is of t = {instant(first, 6)} "
            f"to {instant(last, 6)}, which does not have time.start = {instant(start, 6)}; {whole}"
        )
    if stop > last + slack:
        raise ConfigError(
            f"{path}, line {table.lines[1]}, column t: the recording ends at t = "
            f"{instant(last, 6)}, before time.start + time.horizon = {instant(start, 6)} + "
            f"{time.horizon:g}; {whole}"
        )
    start, stop = max(start, first), min(stop, last)
    if not stop - start > _SHORTEST * max(abs(start), abs(stop)):
        raise ConfigError(
            f"{path}: a span of {stop - start:g} s is too short to be resolved beside its start, "
            f"t = {start:.10g}"
        )
    return start, stop


def _states(samples: Samples, span: tuple[float, float], *, smooth: bool) -> Trajectory:
    """True states between samples: a spline, or straight lines; NaN where nobody knows."""
    t, states = samples.t, samples.states
    known = ~np.isnan(states[0])
    inner = t[(t > span[0]) & (t < span[1])] if known.any() else t[:0]
    mesh = Mesh(np.concatenate([[span[0]], inner, [span[1]]]), radau_rule(3 if smooth else 2))
    values = np.full((*mesh.points.shape, states.shape[1]), np.nan)
    if known.any():
        signal = held(t, states[:, known], "cubic" if smooth else "linear")
        values[..., known] = mesh.along(signal).values
    return Trajectory(mesh, values)
