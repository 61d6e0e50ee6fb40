"""Which sensor next: every state as one more output, and what the data would then determine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence.excitation import Excitation
from gpebo_cli.experiment.assumptions import examine
from gpebo_cli.model.descriptor import Array, Coefficients, CoefficientSource, DescriptorSystem
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Measurements, build
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression.text import simulation_of
from gpebo_cli.settings import Settings

_TINY = 1e-16  # eigenvalue of G with unit diagonal that is rounding


@dataclass(frozen=True)
class Sensor:
    """One state as a further output, as noisy as the others relative to its size."""

    state: str
    problem: str  # why the observer cannot use it; empty: it can
    estimable: tuple[str, ...]  # parameters and states that the data would determine
    gained: tuple[str, ...]  # those of them that they do not determine without it
    log_det: float  # of G in units common to all candidates; −∞ if it cannot be used
    fall: float  # by how much deviations of determined parameters fall, geometric mean


def candidates(settings: Settings, system: DescriptorSystem) -> list[Sensor]:
    """Every state as a further output, the best first: by what is determined, then by log det G.

    Raises:
        ConfigError: there is no simulation or no observer.
        ModelError: the plant cannot be simulated.
    """
    observer = build(settings.observer)
    if observer is None or settings.data.name == "csv":
        raise ConfigError("sensors=all needs a simulation (data=none) and an observer")
    signals = simulation_of(system, settings.time, settings.solver).signals
    sizes = np.abs(signals.states.values).max(axis=(0, 1), initial=0.0)
    size = np.abs(signals.outputs.values).max(initial=0.0) or 1.0
    without = examine(settings, system)
    known = {name for name, since in without.estimable.items() if since is not None}
    found: dict[str, tuple[Excitation, Mapping[str, float | None]] | str] = {}
    for i, state in enumerate(system.states):
        row = np.zeros(system.n)
        row[i] = size / sizes[i] if sizes[i] > 0.0 else 1.0
        y = signals.outputs.values
        more = signals.states.values[..., i : i + 1] * row[i]
        outputs = Trajectory(signals.mesh, np.concatenate([y, more], axis=-1))
        larger = replace(
            system, outputs=(*system.outputs, f"{state} measured"),
            coefficients=_WithOutput(system.coefficients, row),
        )
        examined = examine(settings, larger, Measurements(
            signals.inputs, outputs,
            derivatives=InputDerivatives.of_plant(larger, np.ones(larger.m, dtype=bool)),
        ))
        found[state] = (
            (examined.excitation, examined.estimable) if examined.excitation is not None
            else next(str(a.evidence.get("found")) for a in examined.assumptions if not a.holds)
        )
    usable = [one[0] for one in found.values() if not isinstance(one, str)]
    unit = np.max([e.known.sizes[-1] for e in usable], axis=0) if usable else np.ones(0)
    base = without.excitation
    out = []
    for state, one in found.items():
        if isinstance(one, str):
            out.append(Sensor(state, one, (), (), -np.inf, 1.0))
            continue
        excitation, times = one
        seen = tuple(name for name, since in times.items() if since is not None)
        had = np.zeros(len(unit), dtype=bool) if base is None else base.known.parameters[-1]
        fall = 1.0
        if base is not None and had.any():
            ratio = _information(excitation)[had] / _information(base)[had]
            fall = float(np.exp(0.5 * np.log(ratio).mean()))
        out.append(Sensor(
            state, "", seen, tuple(name for name in seen if name not in known),
            _log_det(excitation, unit), fall,
        ))
    return sorted(out, key=lambda s: (-len(s.estimable), -s.log_det))


def _information(excitation: Excitation) -> Array:
    """1/(G⁻¹)_jj (p,): one over the variance per unit of white noise."""
    known = excitation.known
    return np.asarray(known.share[-1] * known.sizes[-1] ** 2)


def _log_det(excitation: Excitation, unit: Array) -> float:
    """Of G in the units given (p,)."""
    known = excitation.known
    spectrum = np.log(np.maximum(known.eigenvalues[-1], _TINY)).sum()
    return float(spectrum + 2.0 * np.log(known.sizes[-1] / unit).sum())


@dataclass(frozen=True, eq=False)
class _WithOutput:
    """A model with one more constant row of C."""

    source: CoefficientSource
    row: Array  # (n,)

    @property
    def constant(self) -> frozenset[str]:
        return self.source.constant

    @property
    def zero(self) -> frozenset[str]:
        return self.source.zero - {"C"}

    @property
    def of_time(self) -> CoefficientSource:
        return _WithOutput(self.source.of_time, self.row)

    @property
    def signals(self) -> Mapping[str, frozenset[str]]:
        return self.source.signals

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        known = self.source.taylor(
            t, order, inside, None if signals is None else signals[..., :-1]
        )

        def extended(matrix: Array, row: Array | float) -> Array:
            last = np.zeros((*matrix.shape[:2], 1, matrix.shape[3]))
            last[0, :, 0] = row
            return np.concatenate([matrix, last], axis=2)

        return known._replace(
            C=extended(known.C, self.row), D=extended(known.D, 0.0), H=extended(known.H, 0.0)
        )

    def breakpoints(self, start: float, stop: float) -> Array:
        return self.source.breakpoints(start, stop)

    def truth(self, t: Array) -> Array:
        return self.source.truth(t)

    def resolved(self, edges: Array) -> Array | None:
        return self.source.resolved(edges)
