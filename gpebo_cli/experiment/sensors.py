"""Which sensor next: every state as one more output, and what the data would then determine.

On the strangeness-free form no output is fed back: Φ, ξ_a and ξ_b are the same whatever is
measured, and every output adds a row to ψ. So one observer with all states measured has them all,
G = G_0 + Σ G_k over the outputs chosen, and as their noise is white there, cov η̂ ~ G⁻¹.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence.knowledge import Knowledge, knowledge
from gpebo_cli.model.descriptor import Array, Coefficients, CoefficientSource, DescriptorSystem
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.observers import Measurements, build
from gpebo_cli.observers.reduced.extension import extend, reduced_system
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.regression.text import simulation_of
from gpebo_cli.settings import Settings

_TINY = 1e-16  # eigenvalue of G with unit diagonal that is rounding
_EXACT = 1e-12  # of the largest deviation: rounding
_TIMES = 101  # at which the gain of the state is looked at


@dataclass(frozen=True)
class Sensor:
    """One state as a further output, as noisy as the others relative to its size.

    Deviations are those of least squares, of what the data determine without it, too; how far they
    fall is a geometric mean over parameters and states.
    """

    state: str
    estimable: tuple[str, ...]  # parameters and states that the data would determine
    gained: tuple[str, ...]  # those of them that they do not determine without it
    log_det: float  # of G with the sensors before it in the table, in units common to all
    fall: float  # by how much deviations fall with it alone
    fall_together: float  # and with the sensors before it in the table


def candidates(settings: Settings, system: DescriptorSystem) -> list[Sensor]:
    """Every state as a further output: the best, the best beside that one, and so on.

    The best is that with which most is determined, then that with the largest log det G
    (ConfigError: there is no simulation or no observer).
    """
    if build(settings.observer) is None or settings.data.name == "csv" or system.regression:
        raise ConfigError("sensors=all needs a simulation of a plant (data=none) and an observer")
    rows = _Rows(settings, system)
    base, n = rows.found(()), system.n
    chosen: list[int] = []
    out = []
    while len(chosen) < n:
        tried = {i: rows.found((*chosen, i)) for i in range(n) if i not in chosen}
        best = max(tried, key=lambda i: (len(tried[i].deviations), tried[i].log_det))
        chosen.append(best)
        alone, together = rows.found((best,)), tried[best]
        out.append(Sensor(
            system.states[best], tuple(alone.deviations),
            tuple(name for name in alone.deviations if name not in base.deviations),
            together.log_det,
            _fall(base, alone), _fall(base, together),
        ))
    return out


@dataclass(frozen=True)
class _Found:
    """What a choice of outputs determines."""

    deviations: Mapping[str, float]  # in one unit for all choices
    log_det: float


def _fall(before: _Found, after: _Found) -> float:
    """By how much deviations fall."""
    ratios = [before.deviations[name] / after.deviations[name] for name in before.deviations
              if min(before.deviations[name], after.deviations.get(name, 0.0)) > 0.0]
    # No row takes information away: what is less than 1 is rounding.
    return float(np.exp(np.log(np.maximum(ratios, 1.0)).mean())) if ratios else 1.0


class _Rows:
    """G of what is measured now, and what each state adds to it."""

    def __init__(self, settings: Settings, system: DescriptorSystem) -> None:
        signals = simulation_of(system, settings.time, settings.solver).signals
        x, y = signals.states.values, signals.outputs.values
        sizes = np.abs(x).max(axis=(0, 1), initial=0.0)
        size = np.abs(y).max(initial=0.0) or 1.0
        rows = np.diag(size / np.where(sizes > 0.0, sizes, size))
        larger = replace(
            system, outputs=(*system.outputs, *(f"{state} measured" for state in system.states)),
            coefficients=_WithOutputs(system.coefficients, rows),
        )
        self._solver, self._system = settings.solver, system
        reduced = reduced_system(larger, Measurements(
            signals.inputs, Trajectory(signals.mesh, np.concatenate([y, x @ rows.T], axis=-1)),
            derivatives=InputDerivatives.of_plant(larger, np.ones(larger.m, dtype=bool)),
        ), settings.solver, form="strangeness_free")
        extension = extend(reduced, reduced.mesh, reduced.start())
        mesh, final, n = extension.mesh, extension.assembled, system.n
        psi = final.psi[:, :, None, :]
        square = mesh.trajectory(np.swapaxes(psi, 2, 3) @ psi)  # of every row
        start, stop = mesh.edges[[0, -1]]
        whole = square.integral().final
        self._gram, self._more = whole[:-n].sum(axis=0), whole[-n:]
        self._terms = extension.scale[-1:]
        self._elapsed = np.array([stop - start])
        self._parameters = (*system.unknowns, *reduced.begin.names)
        self._gain = mesh.trajectory(final.gain)(np.linspace(start, stop, _TIMES))
        self._units = reduced.form.units.states
        self._common = self._known(range(n)).sizes[0]

    def _known(self, chosen: Sequence[int]) -> Knowledge:
        gram = self._gram + self._more[list(chosen)].sum(axis=0)
        return knowledge(gram[None], self._terms, self._elapsed, self._solver.tol)

    def found(self, chosen: Sequence[int]) -> _Found:
        """With some states as further outputs, by their places."""
        known = self._known(chosen)
        V, spectrum, sizes = known.vectors[0], known.eigenvalues[0], known.sizes[0]
        seen = spectrum >= known.level[0].max(initial=0.0)
        root = V[:, seen] / np.sqrt(spectrum[seen]) / sizes[:, None]
        which = np.concatenate([known.parameters[0], known.states(self._gain, self._units)[-1]])
        of_x = np.linalg.norm(self._gain[-1] @ root, axis=1)
        own = of_x / self._units
        of_x[own <= _EXACT * own.max(initial=0.0)] = 0.0  # known without any output
        deviations = np.concatenate([np.linalg.norm(root, axis=1), of_x])
        names = (*self._parameters, *self._system.states)
        log_det = float(np.log(np.maximum(spectrum, _TINY)).sum()
                        + 2.0 * np.log(sizes / self._common).sum())
        return _Found(
            {name: float(d) for name, d, is_known in zip(names, deviations, which, strict=True)
             if is_known}, log_det,
        )


@dataclass(frozen=True, eq=False)
class _WithOutputs:
    """A model with further constant rows of C."""

    source: CoefficientSource
    rows: Array  # (c, n)

    @property
    def constant(self) -> frozenset[str]:
        return self.source.constant

    @property
    def zero(self) -> frozenset[str]:
        return self.source.zero - {"C"}

    @property
    def of_time(self) -> CoefficientSource:
        return _WithOutputs(self.source.of_time, self.rows)

    @property
    def signals(self) -> Mapping[str, frozenset[str]]:
        return self.source.signals

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Coefficients:
        known = self.source.taylor(
            t, order, inside, None if signals is None else signals[..., : -len(self.rows)]
        )

        def extended(matrix: Array, rows: Array | float) -> Array:
            last = np.zeros((*matrix.shape[:2], len(self.rows), matrix.shape[3]))
            last[0] = rows
            return np.concatenate([matrix, last], axis=2)

        return known._replace(
            C=extended(known.C, self.rows), D=extended(known.D, 0.0), H=extended(known.H, 0.0)
        )

    def breakpoints(self, start: float, stop: float) -> Array:
        return self.source.breakpoints(start, stop)

    def truth(self, t: Array) -> Array:
        return self.source.truth(t)

    def resolved(self, edges: Array) -> tuple[Array, bool]:
        return self.source.resolved(edges)
