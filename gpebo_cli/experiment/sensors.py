"""Which sensor next: every state as one more output, and what the data would then determine.

On the strangeness-free form no output is fed back: Φ, ξ_a and ξ_b are the same whatever is
measured, and every output adds a row to ψ. With x = offset + gain η a state that is measured adds
its row of the gain: G = G_0 + Σ G_k over those chosen, and as noise is white there, cov η̂ ~ G⁻¹.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence.knowledge import Knowledge, knowledge
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.observers import Measurements, build
from gpebo_cli.observers.reduced.extension import extend
from gpebo_cli.observers.reduced.system import reduced_system
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
    (base, _), n = rows.found(()), system.n
    chosen: list[int] = []
    out = []
    while len(chosen) < n:
        tried = {i: rows.found((*chosen, i)) for i in range(n) if i not in chosen}
        best = max(tried, key=lambda i: (len(tried[i][0]), tried[i][1]))
        chosen.append(best)
        (alone, _), (together, log_det) = rows.found((best,)), tried[best]
        out.append(Sensor(
            system.states[best], tuple(alone), tuple(name for name in alone if name not in base),
            log_det, _fall(base, alone), _fall(base, together),
        ))
    return out


def _fall(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    """By how much deviations fall."""
    ratios = [before[name] / after[name] for name in before
              if min(before[name], after.get(name, 0.0)) > 0.0]
    # No row takes information away: what is less than 1 is rounding.
    return float(np.exp(np.log(np.maximum(ratios, 1.0)).mean())) if ratios else 1.0


class _Rows:
    """G of what is measured now, and what each state adds to it."""

    def __init__(self, settings: Settings, system: DescriptorSystem) -> None:
        signals = simulation_of(system, settings.time, settings.solver).signals
        self._solver, self._system = settings.solver, system
        reduced = reduced_system(system, Measurements(
            signals.inputs, signals.outputs,
            derivatives=InputDerivatives.of_plant(system, np.ones(system.m, dtype=bool)),
        ), settings.solver, form="strangeness_free")
        extension = extend(reduced, reduced.mesh, reduced.start)
        mesh, final = extension.mesh, extension.assembled
        # ψ of an output that is a state is its gain, here of a state as large as the outputs are.
        sizes = largest_over_time(signals.states.values, 2)
        outputs = signals.outputs.values * reduced.first.output_scale
        size = np.abs(outputs).max(initial=0.0) or 1.0
        gain = final.gain * (size / np.where(sizes > 0.0, sizes, size))[:, None]
        more = mesh.trajectory(gain[..., None] * gain[..., None, :])
        psi = final.psi[:, -system.r :]
        own = mesh.trajectory(np.swapaxes(psi, 1, 2) @ psi)
        self._gram, self._more = own.integral().final, more.integral().final
        self._terms = np.maximum(extension.scale[-1], np.abs(gain).max(axis=(0, 1), initial=0.0))
        start, stop = mesh.edges[[0, -1]]
        self._elapsed = np.array([stop - start])
        self._parameters = (*system.unknowns, *reduced.begin.names)
        self._gain = mesh.trajectory(final.gain)(np.linspace(start, stop, _TIMES))
        self._units = reduced.form.units.states
        self._common = self._known(range(system.n)).sizes[0]

    def _known(self, chosen: Sequence[int]) -> Knowledge:
        gram = self._gram + self._more[list(chosen)].sum(axis=0)
        return knowledge(gram[None], self._terms, self._elapsed, self._solver.tol)

    def found(self, chosen: Sequence[int]) -> tuple[Mapping[str, float], float]:
        """Deviations of what is determined with some states as further outputs, and log det G.

        They are in one unit for all choices of states, which come by their places.
        """
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
        each = zip(names, deviations.tolist(), strict=True)
        return dict(compress(each, which)), log_det

