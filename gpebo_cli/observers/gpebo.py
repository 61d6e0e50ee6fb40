"""The GPEBO observer for any E(t) of constant rank: Y = ψη and x = offset + gain η.

The equations are those of :mod:`gpebo_cli.observers.reduced`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gpebo_cli.errors import ConfigError, GpeboError, ModelError, SolverError
from gpebo_cli.evidence.excitation import known_at
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.observers._base import AffineStateMap, Measurements, Observation, Sampling
from gpebo_cli.observers.reduced.condensed import lean
from gpebo_cli.observers.reduced.sampled import SampledObserver, sampled_observer
from gpebo_cli.observers.reduced.system import SMALL, reduced_system
from gpebo_cli.observers.remedies import REMEDIES, Remedy
from gpebo_cli.observers.remedies.current_coordinates import CurrentCoordinates
from gpebo_cli.observers.remedies.output_injection import OutputInjection
from gpebo_cli.observers.remedies.plain import Plain
from gpebo_cli.recordings.hold import Hold
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.settings import SolverSettings

_GROWN = 2.0  # the largest entry of Φ, from which on A_0 counts as unstable
_BLOWN = 1e3  # from which on ψ, made of small differences of large terms, tells less than data do
_CLEAR = 1e4  # times what is rounding: an eigenvalue of N that tells with some digits
_SOUND = 1e-8  # relative singular values that are surely not zero
_TRIED = 2_000  # elements for the equations as given, before the other form is tried
_LONG = 10_000  # elements of a run that is not observed twice unasked: it takes gigabytes
_AHEAD = 50  # samples by which it is judged whether a plant's kernels turn; in streams a second
_NOTE = "; observer on the strangeness-free form, {}"


@dataclass(frozen=True)
class Gpebo:
    """Section II of the paper, with all rows of the residual.

    Attributes:
        form: the equations as given, or with all hidden constraints beside them, which takes any
            index and needs no output to see the algebraic states; auto: as given where that does,
            unless the data determine more on the other form, or with more digits (looked at below
            10,000 elements).
        regression: the whole residual, or its last r rows as the paper has it.
        xi_a0: where the dynamic extension starts: by state name, or a list of n_a numbers; None:
            what the plant proposes, else zero.
        unknown_initial: states whose initial values are not known; the others start where the
            plant's ``initial_state`` says, or ``xi_a0``. None: all.
        weights: how much each output counts, by order or name (absent: 1); only ratios matter.
            None: equally.
        sample_time: seconds between samples of an observer in discrete time; None: continuous.
        hold: what it assumes between samples.
        bounds: of ``states`` and ``unknowns``, by name [low, high], null for no bound; estimates
            respect them at all times so far (docs/howto/uncertainty.md).
        remedy: what is done about a Φ that grows (docs/howto/unstable.md).
    """

    form: Literal["auto", "given", "strangeness_free"] = "auto"
    regression: Literal["projected", "paper"] = "projected"
    xi_a0: Mapping[str, float] | list[float] | None = None
    unknown_initial: list[str] | None = None
    weights: Mapping[str, float] | list[float] | None = None
    sample_time: float | None = field(default=None, metadata={"positive": True})  # seconds
    hold: Literal["zoh", "linear"] = "zoh"
    bounds: Mapping[str, Mapping[str, list[float | None]]] | None = None
    remedy: Remedy = field(default=Plain(), metadata={"one_of": REMEDIES})

    def __post_init__(self) -> None:
        if self.sample_time is not None:
            self._refuse_what_needs_the_past()
        if self.bounds and not self._keeps:
            raise ConfigError(
                "observer.bounds: parameters that change on the way have none; accepted remedies "
                "are none and output_injection"
            )
        if self.unknown_initial is not None and not self._keeps:
            raise ConfigError(
                "observer.unknown_initial: with this remedy the parameters are about later states, "
                "which are all unknown; accepted remedies are none and output_injection"
            )

    @property
    def _keeps(self) -> bool:
        """Whether the parameters are about the start from beginning to end."""
        return isinstance(self.remedy, Plain | OutputInjection)

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """The regression and the state map, with the remedy."""
        lasts = self._keeps or isinstance(self.remedy, CurrentCoordinates)
        if not lasts or signals.mesh.size < _LONG or system.n > SMALL or solver.name == "ivp":
            signals = replace(signals, asked=None)
        if not self._keeps:
            return self._observe(system, signals, solver)
        return lean(
            lambda each: self._observe(system, each, solver), system, signals, solver,
            rows=bool((self.bounds or {}).get("states")),
        )

    def _observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """:meth:`observe` along the signals as they are given."""
        arguments = system, signals, solver
        if self.form != "auto" or self.regression == "paper":
            return self._on(self.form, *arguments)
        plain = isinstance(self.remedy, Plain)
        found: Observation | None
        known = everything = (True, system.q + system.n)
        short = signals.mesh.size < _LONG

        def few(elements: int) -> SolverSettings:
            return replace(solver, max_elements=min(solver.max_elements, max(_TRIED, elements)))

        # No mesh resolves Assumption 1 failing at one time, or the other form's large rounding; or
        # it is only when elements are cut that such a time is met.
        try:
            if not plain:
                return self._on("auto", *arguments)
            found = self._on("auto", system, signals, few(100 * signals.mesh.size))
            limits = few(4 * found.regression.mesh.size)
            if short and not found.note and not _same_on_both_forms(found, system, signals):
                known = _told(found, system, solver)
            why = "which determines more than the equations as given"
            if not known[0]:
                why = "which tells with more digits what the equations as given tell, or more"
        except (ModelError, SolverError):
            found, known, limits = None, (False, -1), solver
            why = "for as given its signals are not resolved"
        if known < everything and short:
            try:
                other = self._on("strangeness_free", system, signals, limits, _NOTE.format(why))
                if not plain or _told(other, system, solver) > known:
                    return other
            except GpeboError:  # the form does not exist, or not for these signals
                pass
        return self._on("auto", *arguments) if found is None else found

    def _on(
        self, form: str, system: DescriptorSystem, signals: Measurements, solver: SolverSettings,
        note: str = "",
    ) -> Observation:
        """:meth:`observe` on a form of the equations."""
        reduced = reduced_system(
            system, signals, solver,
            xi_a0=self.xi_a0, weights=self.weights, regression=self.regression, form=form,
            unknown=self.unknown_initial, in_part=isinstance(self.remedy, Plain),
        )
        reduced = replace(reduced, note=note) if note else reduced
        return replace(self.remedy.observe(reduced), bounds=self.bounds)

    def sampling(self) -> Sampling | None:
        """The samples that ``sample_time`` asks for."""
        return None if self.sample_time is None else Sampling(self.sample_time, self.hold)

    def at_samples(
        self, system: DescriptorSystem, solver: SolverSettings, hold: Hold, start: float,
        sample: Array, derivatives: InputDerivatives | None,
    ) -> SampledObserver:
        """The observer in discrete time, whose first sample [u; y] (m + r,) is at ``start``."""
        self._refuse_what_needs_the_past()
        return sampled_observer(
            system, solver, hold, start, sample, derivatives,
            xi_a0=self.xi_a0, weights=self.weights, regression=self.regression, form=self.form,
            ahead=1.0 if self.sample_time is None else _AHEAD * self.sample_time,
        )

    def _refuse_what_needs_the_past(self) -> None:
        name = next(key for key, kind in REMEDIES.items() if isinstance(self.remedy, kind))
        asked = {
            "unknown_initial": self.unknown_initial is not None, "bounds": bool(self.bounds),
            f"remedy={name}": not isinstance(self.remedy, Plain),
        }
        for key in (key for key, is_asked in asked.items() if is_asked):
            raise ConfigError(
                f"observer.{key} works in continuous time only; at samples (observer.sample_time, "
                "streams) the past is not kept"
            )


def _same_on_both_forms(
    found: Observation, system: DescriptorSystem, signals: Measurements
) -> bool:
    """Whether the equations as given hide no constraints and Φ does not grow, or all have x'."""
    t, inside = signals.mesh.points[0, :1], signals.mesh.inside[0, :1]
    follows = system.coefficients.signals
    along = signals.at(t, inside)[None] if follows else None
    c = system.coefficients.taylor(t, 0, inside, along)
    U, sigma, V = np.linalg.svd(c.E[0, 0])
    rank = int((sigma > _SOUND * sigma[0]).sum())
    if rank == system.n:
        return True
    if found.growth is None or found.growth > _GROWN or follows:
        return False
    algebraic = U[:, rank:].T @ c.A[0, 0]  # of index 1 where it is regular on the kernel of E
    size = np.linalg.norm(algebraic, axis=1, keepdims=True)
    if not (size > 0.0).all():
        return False
    left = np.linalg.svd(algebraic / size @ V[rank:].T, compute_uv=False)
    return bool(left.min(initial=1.0) > _SOUND)


def _told(
    found: Observation, system: DescriptorSystem, solver: SolverSettings
) -> tuple[bool, int]:
    """Whether it is told with some digits, and how many unknowns and states are at the end."""
    regression, state_map = found.regression, found.state_map
    assert isinstance(state_map, AffineStateMap)  # noqa: S101  as it is without a remedy
    ends = regression.mesh.edges[1:]
    last, steady = len(ends) - 1, found.growth is None or found.growth < _BLOWN
    known = known_at(regression, ends[-1:], solver.tol)

    def clear(known: Knowledge) -> bool:
        return bool(known.margin.max(initial=0.0) >= _CLEAR)

    # What was told is told for good, where later on it drowns in the rounding of a long run.
    earlier = ends[last >> np.arange(1, last.bit_length() + 1)]
    if clear(known) or clear(known_at(regression, earlier, solver.tol)):
        return steady, system.q + system.n
    sound = steady and bool(known.clarity[known.clarity >= 1.0].min(initial=np.inf) > _CLEAR)
    seen = known.states(state_map.gain(np.linspace(*regression.mesh.span, 11)), state_map.units)[-1]
    return sound, int(known.parameters[0, : system.q].sum() + seen.sum())


OBSERVER = Gpebo
