"""Every assumption a run rests on, as evidence: what holds, what does not, and by how much.

``gpebo run`` writes this into ``summary.json``; ``gpebo check`` prints it. A check stops at the
first stage that cannot be carried out and reports that stage as the failed assumption.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from gpebo_cli.errors import GpeboError, ModelError
from gpebo_cli.evidence.excitation import Excitation, assess, estimable
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.evidence.uncertainty import of_least_squares
from gpebo_cli.experiment.noise import noise_levels, signal_noise
from gpebo_cli.findings import Assumption
from gpebo_cli.kernels.threads import one_thread
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.model.text import driven_from_outside
from gpebo_cli.numerics.linalg import inverse_or_none
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.observers import Measurements, Observation, Observer, build
from gpebo_cli.observers._base import AffineStateMap
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.recordings.load import load
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.reduction.scaling import scales_of
from gpebo_cli.regression.text import simulation_of
from gpebo_cli.settings import Settings
from gpebo_cli.simulation.signals import Simulation

if TYPE_CHECKING:  # that is made of what is here
    from gpebo_cli.experiment.online import Online

_EVERY_POINT = 16  # states, up to which a pencil is looked at where all is decided
_SPOILT = 1e-3  # of the observer's signals: a larger error is worth a warning
_GROWTH = 1e6  # of Φ: above it, the state loses six digits of what the parameters know


@dataclass(frozen=True)
class Examination:
    """Assumptions with their evidence, and what can be known if the observer gets that far."""

    assumptions: tuple[Assumption, ...]
    estimable: Mapping[str, float | None] = field(default_factory=dict)  # since when; None: never
    excitation: Excitation | None = None
    # At the end, of what is estimable, for noise of one unit at every output.
    deviations: Mapping[str, float] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()  # states that the observer does not estimate


@one_thread
@np.errstate(all="ignore")  # as in a run
def examine(settings: Settings, system: DescriptorSystem) -> Examination:
    """All assumptions of the plant and the observer, with what can be known; never a ModelError.

    They are about ψ, which noise does not reach: signals are taken without it. Of a recording they
    are those of the observer only. Where that may choose, there is evidence of the other form, too.
    """
    levels, observer = noise_levels(settings.noise, system), build(settings.observer)
    if settings.data.name == "csv":
        system = driven_from_outside(system)
        recording = load(system, settings.data, settings.time, settings.solver.tol)
        noise = signal_noise(levels, recording.rows)
        seen = Measurements(recording.inputs, recording.outputs, noise, recording.derivatives)
        return Examination(()) if observer is None else _of_observer(
            observer, settings, system, seen, []
        )
    try:
        simulation = simulation_of(system, settings.time, settings.solver)
    except ModelError as error:
        return Examination((Assumption("Solvability", _SOLVABILITY, False, {"found": str(error)}),))
    found = of_simulation(system, simulation)
    if observer is None:
        return Examination(needed(found))
    if any(jump.impulses.any() for _, _, jump in simulation.jumps):
        found.append(
            Assumption("No impulses", "jumps of the input put no impulse into the state", False, {})
        )
        return Examination(tuple(found))
    signals = simulation.signals
    derivatives = InputDerivatives.of_plant(system, levels.inputs == 0.0)
    seen = Measurements(signals.inputs, signals.outputs, signal_noise(levels), derivatives)
    return _of_observer(observer, settings, system, seen, found)


def _of_observer(
    observer: Observer, settings: Settings, system: DescriptorSystem, seen: Measurements,
    found: list[Assumption],
) -> Examination:
    """What the observer needs of the plant, and of the signals it gets to see."""
    try:
        observation = observer.observe(system, seen, settings.solver)
    except ModelError as error:
        failed = Assumption(_named(error), "needed by the observer", False, {"found": str(error)})
        return Examination((*found, failed))
    t = np.linspace(*seen.span, 101)
    excitation = assess(observation.regression, t, settings.excitation, settings.solver.tol)
    times = estimable(
        excitation.known, t, observation.regression.parameters, system.states,
        visible(observation, t, system.states)(excitation.known),
    )
    growth = observation.growth, observation.growth_rate
    found += of_observation(observation.assumptions, growth, excitation, system)
    if isinstance(observer, Gpebo) and observer.form == "auto":
        found = [_with_other_form(a, observer, system, seen, settings) for a in found]
    return Examination(
        needed(found), times, excitation,
        _per_unit(observation, excitation.known, settings, system, seen, times),
        observation.unseen,
    )


def _with_other_form(
    found: Assumption, observer: Gpebo, system: DescriptorSystem, seen: Measurements,
    settings: Settings,
) -> Assumption:
    """Assumption 1 as given, with what the strangeness-free form would say; others as they are."""
    if found.evidence.get("form") != "given":  # of the other one it says why that was not taken
        return found
    try:
        other = replace(observer, form="strangeness_free").observe(system, seen, settings.solver)
        text = next(
            f"holds, too, with singular value {a.evidence['smallest_singular_value']:.4g}"
            for a in other.assumptions if a.name == found.name
        )
    except GpeboError as error:
        text = str(error)
    return replace(found, evidence={**found.evidence, "strangeness_free": text})


def _per_unit(
    observation: Observation, known: Knowledge, settings: Settings, system: DescriptorSystem,
    seen: Measurements, estimable: Mapping[str, float | None],
) -> dict[str, float]:
    """Deviations of what is estimable, by name; none where the observer cannot tell."""
    state_map, regression = observation.of_constants, observation.regression
    if observation.errors is None or state_map is None:
        return {}
    (start, stop), rows = seen.span, None if seen.noise is None else seen.noise.rows
    rows = rows or Rows(np.arange(start, stop, settings.noise.sample_time))
    of_eta, of_x = of_least_squares(
        observation.errors, regression, known, state_map.gain(np.array([stop]))[0], rows,
        np.concatenate([np.zeros(system.m), np.ones(system.r)]),
    )
    found = dict(zip(system.states, of_x.tolist(), strict=True))
    found |= dict(zip(regression.parameters, of_eta.tolist(), strict=True))
    return {name: found[name] for name, since in estimable.items() if since is not None}


def visible(
    observation: Observation, t: Array, states: Sequence[str]
) -> Callable[[Knowledge], BoolArray]:
    """From what is known at the last M of the times t (N,) to which states are known, (M, n)."""
    observation = observation.evidence or observation
    state_map = observation.state_map
    if isinstance(state_map, AffineStateMap) and observation.names is None:
        gain, offset, growth = state_map.gain(t), state_map.offset(t), observation.growth
        h = observation.regression.gram_final[:, observation.regression.p]
        return lambda known: (
            known.states(gain, state_map.units)
            & known.resolved(h, offset, gain, growth, state_map.units)
        )
    # What it needs of the parameters is not known: all of them.
    given = np.array([name not in observation.unseen for name in states], dtype=bool)
    return lambda known: known.parameters.all(axis=1, keepdims=True) & given


def _named(error: GpeboError) -> str:
    found = re.search(r"Assumption \d", str(error))
    return found[0] if found else "Rank of E" if "rank of E" in str(error) else "Observer"


_RANK_CONDITION = "Rank condition D2"
_SOLVABILITY = "uniquely solvable, with constant characteristic values (μ, d, a)"


def needed(found: Sequence[Assumption]) -> tuple[Assumption, ...]:
    """Without a rank condition that fails where no observer takes the equations as given."""
    given = any(a.evidence.get("form") == "given" for a in found)
    return tuple(a for a in found if a.holds or given or a.name != _RANK_CONDITION)


def of_simulation(system: DescriptorSystem, simulation: Simulation) -> list[Assumption]:
    """Solvability, the consistent start, and for constant systems regularity and D2."""
    if system.regression is not None:
        return []
    s = simulation.structure
    moved = float(np.abs(simulation.initial_state - system.initial_state).max(initial=0.0))
    found = [
        Assumption(
            "Solvability", _SOLVABILITY, True,
            {
                "strangeness_index": s.mu, "index": s.index, "d": s.d, "a": s.a,
                "smallest_singular_value": s.smallest_singular_value,
                # Functions from Python are looked at between the nodes, but nothing bounds them.
                "bounded_between_nodes": simulation.bounded,
                **({} if simulation.effort is None else asdict(simulation.effort)),
            },
        ),
        Assumption(
            "Consistent start", "a consistent initial state follows from the one given", True,
            {"largest_change": moved},
        ),
    ]
    if {"E", "A", "C"} <= system.coefficients.constant and system.r:
        found += _of_constant_system(system, simulation)
    return found


def _of_constant_system(system: DescriptorSystem, simulation: Simulation) -> list[Assumption]:
    """For constant E, A, C: regularity of the pencil and the rank condition of point D2.

    D2: rank [E A; 0 C; 0 E] = rank E + n is impulse observability, equivalent to Assumption 1.
    """
    t = simulation.signals.mesh.edges[:1]
    c = system.coefficients.of_time.taylor(t, 0)
    E, A, C = c.E[0, 0], c.A[0, 0], c.C[0, 0]
    rows, columns, time = scales_of(E, A)
    E, A, C = rows[:, None] * E * columns / time, rows[:, None] * A * columns, C * columns
    C = C / np.maximum(np.abs(C).max(axis=1, keepdims=True), np.finfo(float).tiny)
    n = system.n
    # det(λE − A) is a polynomial of degree ≤ n: it vanishes identically if it does at n + 1 points.
    # Those with Im λ < 0 say nothing new; of many states one point where it does not will do.
    if n <= _EVERY_POINT:
        points = np.exp(2j * np.pi * np.arange((n + 1) // 2 + 1) / (n + 1))
        smallest = np.linalg.svd(points[:, None, None] * E - A, compute_uv=False)[:, -1]
    else:
        inverse, _ = inverse_or_none(np.array([1.0, -1.0])[:, None, None] * E - A)
        smallest = 1.0 / np.linalg.norm(inverse, axis=(1, 2))
    regular = float(smallest.max() / max(np.linalg.norm(A), np.finfo(float).tiny))
    # Where the rows of E have ended, rank [E A; 0 C; 0 E] = rank E + rank [ZᵀA; C; E], and the
    # latter is rank E and that of [ZᵀA; C] on the kernel of E.
    U, sigma, Vt = np.linalg.svd(E)
    eps = n * np.finfo(float).eps
    rank = int((sigma > sigma[0] * eps).sum())
    rest = np.concatenate([U[:, rank:].T @ A, C])
    seen = np.linalg.svd(rest @ Vt[rank:].T, compute_uv=False)
    whole = 2 * rank + int((seen > np.linalg.norm(rest) * eps).sum())
    return [
        Assumption(
            "Regularity", "the pencil λE − A is regular (constant coefficients)", regular > 1e-12,
            {"largest_smallest_singular_value": regular},
        ),
        Assumption(
            _RANK_CONDITION, "rank [E A; 0 C; 0 E] = rank E + n (constant coefficients)",
            whole == rank + n,
            {"rank": whole, "needed": rank + n},
        ),
    ]


Observed: TypeAlias = "Observation | Online"
"""What an observer says about itself, in continuous time or at samples."""


def designable(system: DescriptorSystem) -> str:
    """What ψ depends on beside time: inputs and outputs in A, F, C and H, or in none of them."""
    depends = system.coefficients.signals
    names = frozenset[str]().union(*(depends.get(name, ()) for name in "AFCH"))
    return ", ".join(s for s in (*system.inputs, *system.outputs) if s in names) or "time alone"


def of_observation(
    own: Sequence[Assumption], growth: tuple[float | None, float | None], excitation: Excitation,
    system: DescriptorSystem,
) -> list[Assumption]:
    """The observer's ``own`` assumptions, excitation, and the growth of Φ and its rate."""
    number = 5 if any(a.name == "Assumption 3" for a in own) else 2
    found = [
        *own,
        Assumption(
            f"Assumption {number}",
            "interval excitation: ∫ψᵀψ ≥ ρ I at some t_c",
            excitation.is_ie,
            {
                "psi_depends_on": designable(system),
                "t_c": excitation.t_c,
                "normalised_min": excitation.level,
                "lambda_min": excitation.lambda_min,
                "condition": excitation.condition,
                "weakest_direction": str(excitation.weakest_direction),
            },
        ),
    ]
    largest, rate = growth
    if largest is not None:
        found.append(
            Assumption(
                "Growth of Φ",
                "Φ stays bounded, so that θ̂ → θ implies x̂ → x",
                largest < _GROWTH,
                {"largest_entry": largest, "rate": rate},
            )
        )
    return found


def warnings(observation: Observed) -> tuple[str, ...]:
    """What does not stop a run and spoils its result, one line each.

    Assumption 1 that fails on the form chosen, signals that errors spoil, and Φ that grows too far.
    """
    found = [
        str(a.evidence["because"]) for a in observation.assumptions
        if not a.holds and "because" in a.evidence
    ]
    if observation.error_estimate > _SPOILT:
        found.append(
            f"errors of the observer's signals grow to {observation.error_estimate:.1e} of their "
            "size: estimates are no better; use a shorter time.horizon, or another observer.form"
        )
    growth, rate = observation.growth, observation.growth_rate
    if growth is not None and rate is not None and not growth < _GROWTH:
        evidence = {a.name: a.evidence for a in observation.assumptions}
        given = evidence.get("Assumption 1", {}).get("form") == "given"
        rank, states = (evidence.get("Rank of E", {}).get(key) for key in ("rank", "states"))
        found.append(
            f"Φ has grown to {growth:.2g}, at {rate:.3g} 1/s: of its 16 digits the state estimate "
            f"loses {np.log10(growth):.0f}; a remedy of observer=gpebo in continuous time is "
            "needed, observer.remedy=output_injection, reset or current_coordinates"
            + "; observer.form=strangeness_free feeds no output back" * (given and rank != states)
        )
    return tuple(found)
