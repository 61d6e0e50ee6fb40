"""What the observer gets to see: the true signals, sampled, noisy and rounded.

At the sample instants t_k = start + k T_s the error of an output is

    e_k = Q(y(t_k) + n_k) − y(t_k),      n_k ~ N(0, σ²),

with Q rounding to the step of the converter, and the observer sees y(t) + e(t). Inputs likewise,
without rounding; the plant is driven by the true u. Between the instants e is held, or it is the
trigonometric interpolant of the samples, which has no frequency above 1/(2 T_s):

    e(t) = Σ_k e_k D((t − t_k)/T_s),      D(x) = sin(πx)/(N sin(πx/N)),  N odd.

It is the sinc series of samples that are continued periodically, and its variance is σ² at every
time. Sinc itself was rejected: cut off at the ends of the horizon its variance falls there; so were
cubic splines, which pass a part of what lies above 1/(2 T_s) and have less variance in between.

Samples are boundaries of elements, so that what is held jumps between elements only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil, factorial, pi

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.model.expressions.bounds import with_others
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.observers import SignalNoise
from gpebo_cli.schema import per_name
from gpebo_cli.settings import NoiseSettings
from gpebo_cli.simulation.signals import Signals

_SAME = 1e-6  # of T_s: an edge this near to an instant takes its place
_RESOLVED = 1e-10  # of a sample: what a polynomial may miss of the interpolant


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Standard deviations and steps per signal, zeros where there is no noise."""

    settings: NoiseSettings  # which say when it is sampled, too
    outputs: Array  # (r,) σ
    inputs: Array  # (m,) σ
    steps: Array  # (r,) of quantisation

    @cached_property
    def silent(self) -> bool:
        """Whether what is measured is what is there."""
        return not (self.inputs.any() or self.outputs.any() or self.steps.any())


def noise_levels(settings: NoiseSettings, system: DescriptorSystem) -> NoiseLevels:
    """The levels by output and input of a plant, checked (ConfigError)."""
    outputs, inputs = system.outputs, system.inputs
    levels = NoiseLevels(
        settings,
        per_name(settings.outputs, outputs, "output", "noise.outputs", absent=0.0),
        per_name(settings.inputs, inputs, "input", "noise.inputs", absent=0.0),
        per_name(settings.quantisation, outputs, "output", "noise.quantisation", absent=0.0),
    )
    if settings.outputs and levels.silent and system.regression is not None and not outputs:
        raise ConfigError(
            f"noise.outputs: regression {system.name} makes Y of its signals and has no outputs; "
            "noise of the signals is noise.inputs"
        )
    return levels


def signal_noise(levels: NoiseLevels, rows: Rows | None = None) -> SignalNoise:
    """What an observer is told of the noise: rounding to steps of Δ has a variance of Δ²/12.

    A recording has ``rows`` of its own.
    """
    outputs = np.sqrt(levels.outputs**2 + levels.steps**2 / 12.0)
    step = levels.settings.sample_time if rows is None else float(np.diff(rows.t).mean())
    return SignalNoise(levels.inputs, outputs, step, rows)


@dataclass(frozen=True, eq=False)
class SampledMesh:
    """A mesh whose elements end at the sample instants, and the sample that each follows."""

    mesh: Mesh
    sample: IntArray  # (K,) number of the last instant at or before the element
    sample_time: float

    @property
    def first(self) -> IntArray:
        """The element that starts at each instant within the horizon, shape (samples,)."""
        return np.searchsorted(self.sample, np.arange(self.sample[-1] + 1))


def sampled_mesh(mesh: Mesh, sample_time: float, parts: int = 1) -> SampledMesh:
    """``mesh`` with every sample instant an edge; its own edges stay.

    ``parts``: into how many elements an interval between instants is cut.
    """
    start, stop = mesh.edges[0], mesh.edges[-1]
    count = ceil((stop - start) / sample_time - _SAME)
    wanted = start + np.arange(count * parts) * (sample_time / parts)
    wanted = wanted[wanted < stop - _SAME * sample_time]
    # Where both kinds of edges (nearly) meet, the mesh's own stays: a jump stands there.
    edges = with_others(mesh.edges, wanted, _SAME * sample_time)
    sample = np.floor((edges[:-1] - start) / sample_time + _SAME).astype(np.intp)
    return SampledMesh(Mesh(edges, mesh.rule), sample, sample_time)


def measure(signals: Signals, levels: NoiseLevels, seed: int) -> Signals:
    """u + e, y + e and the true states, on a mesh that ends elements at the sample instants.

    Without noise these are ``signals`` themselves, to the last bit.
    """
    if levels.silent:
        return signals
    grid, shape = noise_grid(signals.mesh, levels.settings), levels.settings.shape
    mesh = grid.mesh
    true = Signals(*map(mesh.along, (signals.inputs, signals.outputs, signals.states)))
    of_outputs, of_inputs = draw_errors(true.outputs, grid, levels, seed)
    return Signals(
        Trajectory(mesh, true.inputs.values + between(of_inputs, grid, shape)),
        Trajectory(mesh, true.outputs.values + between(of_outputs, grid, shape)),
        true.states,
    )


def noise_grid(mesh: Mesh, settings: NoiseSettings) -> SampledMesh:
    """The mesh on which measured signals live."""
    parts = 1
    if settings.shape == "band_limited":
        # A polynomial of degree s on h misses up to 2 (h π/(4 T_s))^(s+1)/(s + 1)! of e^{iπt/T_s}.
        degree = mesh.rule.stages + 1
        level = (_RESOLVED * factorial(degree) / 2.0) ** (1.0 / degree)
        parts = max(1, ceil(pi / (4.0 * level)))
    return sampled_mesh(mesh, settings.sample_time, parts)


def draw_errors(
    outputs: Trajectory, grid: SampledMesh, levels: NoiseLevels, seed: int
) -> tuple[Array, Array]:
    """e_k of the outputs (N, r) and inputs (N, m) at the instants.

    N is odd and there is at least one sample beyond the horizon, for the interpolant: outputs
    count as constant from its end on.
    """
    y, generator = outputs.values[grid.first, 0], np.random.default_rng(seed)
    count = len(y) + 1 + len(y) % 2
    y = np.concatenate([y, np.broadcast_to(outputs.final, (count - len(y), y.shape[1]))])
    drawn = levels.outputs * generator.standard_normal((count, len(levels.outputs)))
    of_inputs = levels.inputs * generator.standard_normal((count, len(levels.inputs)))
    steps = levels.steps
    rounded = steps > 0
    seen = y[:, rounded] + drawn[:, rounded]
    drawn[:, rounded] = steps[rounded] * np.rint(seen / steps[rounded]) - y[:, rounded]
    return drawn, of_inputs


def between(errors: Array, grid: SampledMesh, shape: str) -> Array:
    """e(t) at the points of the mesh, shape (K, s + 1, c) or (K, 1, c), from e_k (N, c)."""
    if shape == "hold":
        return errors[grid.sample][:, None]
    mesh, rule = grid.mesh, grid.mesh.rule
    out = np.empty((mesh.size, rule.stages + 1, errors.shape[1]))
    # Position of an element within its interval; equal ones of all intervals are one FFT.
    left = (mesh.edges[:-1] - mesh.edges[0]) / grid.sample_time - grid.sample
    length = mesh.steps / grid.sample_time
    rounding = 64 * np.finfo(float).eps * float(np.abs(mesh.edges).max()) / grid.sample_time
    digits = int(-np.log10(max(rounding, 1e-12)))
    _, kind = np.unique(np.round(np.stack([left, length]), digits), axis=1, return_inverse=True)
    spectrum = np.fft.rfft(errors, axis=0)
    frequencies = 2j * pi * np.arange(len(spectrum))[:, None] / len(errors)
    for number in range(int(kind.max()) + 1):
        chosen = np.flatnonzero(kind.ravel() == number)
        exact_left, exact_length = left[chosen].mean(), length[chosen].mean()
        for i, point in enumerate(rule.points):
            turned = spectrum * np.exp(frequencies * (exact_left + exact_length * point))
            shifted = np.fft.irfft(turned, n=len(errors), axis=0)
            out[chosen, i] = shifted[grid.sample[chosen]]
    return out
