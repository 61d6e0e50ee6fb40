"""Observer and estimator over a source, in continuous time or at samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial

import numpy as np

from gpebo_cli import estimators
from gpebo_cli.errors import ConfigError, SolverError
from gpebo_cli.evidence.excitation import (
    WINDOWS,
    Excitation,
    assess,
    estimable,
    sampled_window_level,
)
from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.evidence.metrics import NAMES as METRICS
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.experiment import accuracy, doubts
from gpebo_cli.experiment.assumptions import Observed, needed, of_observation, visible, warnings
from gpebo_cli.experiment.bounds import bounded, sides
from gpebo_cli.experiment.fit import fit_of
from gpebo_cli.experiment.limits import Pace, check_at_samples
from gpebo_cli.experiment.noise import signal_noise
from gpebo_cli.experiment.online import Online, OnlineEstimates, joined
from gpebo_cli.experiment.result import (
    EstimationResult,
    RegressionResult,
    RunResult,
    told_apart,
)
from gpebo_cli.experiment.seeds import over_seeds, refuse_seeds
from gpebo_cli.experiment.several import joined_observation
from gpebo_cli.experiment.sources import Source, kept_samples, sample_times
from gpebo_cli.experiment.uncertainty import (
    none_at_samples,
    residual_ratio,
    sampled_deviations,
    standard_deviations,
)
from gpebo_cli.experiment.verdict import functions_note, simulation_note, verdict
from gpebo_cli.findings import replaced
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem, IntArray
from gpebo_cli.observers import Measurements, Observation, Observer, Sampling
from gpebo_cli.observers._base import Differentiable, Filtering
from gpebo_cli.settings import Settings
from gpebo_cli.simulation.signals import Signals

_SAMPLES_AT_ONCE = 2048
_HIDING = 10.0  # growth of Φ, from which on the end may hide what data told before
_PER_QUANTITY = 1000  # cases up to which each quantity's own time is told
_BATCH = 1 << 21  # numbers held at once while cases are evaluated: beyond it calls cost little

# name of a stage of the run -> what measures it
Stage = Callable[[str], AbstractContextManager[Pace]]


def continuous(
    result: RunResult, source: Source, observer: Observer, estimator: estimators.Estimator,
    stage: Stage,
) -> RunResult:
    """The result with observer and estimator as differential equations (SolverError)."""
    settings, system = result.settings, result.system
    t, goes_on = source.t, estimators.goes_on(estimator)
    begins = system
    if source.simulation is not None:  # what is known of the start is what constraints leave of it
        begins = replace(system, initial_state=source.simulation.initial_state)

    def observe(signals: Source | Signals) -> Observation:
        known = signals if isinstance(signals, Source) else source
        asked = None
        if _blind(known) and known.samples is not None and goes_on:
            inside = (known.samples > known.t[0]) & (known.samples < known.t[-1])
            asked = np.union1d(known.t, known.samples[inside])
        seen = Measurements(
            signals.inputs, signals.outputs, signal_noise(source.levels, known.rows),
            known.derivatives, known.t if known.recording else None, asked,
            [
                (each.inputs.mesh.size, each.inputs.mesh.points.size)
                for each in source.pieces if each is not known
            ],
            Measurements(source.pieces[0].inputs, source.pieces[0].outputs)
            if source.pieces else None,
        )
        return observer.observe(begins, seen, settings.solver)

    with stage("observe"):
        observation = (
            joined_observation([observe(each) for each in source.pieces], source.pieces, system.q)
            if source.pieces else observe(source)
        )
        regression = observation.regression
        told_apart(observation.parameters, system)
        sampler = regression.mesh.sampler(t)
        sampled = RegressionResult(
            t, sampler(regression.Y.values), sampler(regression.psi.values),
            regression.parameters, observation.error_estimate,
        )
    with stage("excitation"):
        excitation = assess(regression, t, settings.excitation, settings.solver.tol)
    with stage("estimate") as pace:
        known, seen_at = excitation.final, visible(observation, t, system.states)
        if not known.parameters.all() and (observation.growth or np.inf) > _HIDING:
            known = excitation.known
        seen, names = seen_at(known), (regression.parameters, system.states)
        told = dict(zip(system.states, seen[-1], strict=True))
        told |= dict(zip(regression.parameters, known.parameters[-1], strict=True))
        observation, of_bounds = _bounded_where_known(observation, system, told)
        estimator = estimators.tuned(estimator, regression)
        try:
            estimation, metrics = _estimate(
                settings, system, observation.estimator or estimator, observation, source, known,
                seen[-1], pace,
            )
        except SolverError as error:
            raise SolverError("; ".join([str(error), *warnings(observation)])) from error
    why = ""
    if source.noisy or observation.estimator is not None:
        with stage("uncertainty"):
            estimation, why = _with_deviations(
                settings, observation, estimator, source, known, estimation, system
            )
    fit = fit_of(observation, estimation, system, source) if source.recording else None
    if fit is not None and settings.uncertainty:
        fit = replace(fit, ratio=residual_ratio(observation.evidence or observation, source))
    noise = None
    if settings.noise.seeds > 1 and source.true is not None and observation.parameters:
        with stage("seeds") as pace:
            noise = over_seeds(
                observation, observe, source.true, source.theta, estimator, source.levels,
                pace, known.independent, np.isfinite(estimation.parameters[0, -1]), system,
            )
    unknown = [
        name for name, is_known in told.items() if not (is_known or name in observation.unseen)
    ]
    if observation.estimator is not None:  # what the result is labelled with is what estimated
        settings = replace(settings, estimator={"name": settings.observer["name"]})
    found = replaced(
        result, regression=sampled, fit=fit, noise=noise, left_out=observation.unseen,
        estimable=lambda: estimable(excitation.known, t, *names, seen_at(excitation.known)),
        settings=settings,
    )
    return _completed(
        found, source, observation, unknown, excitation, estimation, metrics,
        _gains(observation, estimation), _no_deviations(why) + of_bounds,
    )


def _completed(
    found: RunResult, source: Source, observed: Observed, unknown: Sequence[str],
    excitation: Excitation, estimation: EstimationResult, metrics: Metrics, gains: Array | None,
    note: str,
) -> RunResult:
    """What was ``found`` with the rest that observer and estimator made of a source, and its words.

    Nothing is known of the ``unknown`` parameters and states, ``gains`` are as of
    ``accuracy.standing``, and the ``note`` is for the last line of a run, from "; " on.
    """
    system, simulation, recording = found.system, found.simulation, found.recording
    if source.noisy:
        metrics = accuracy.standing(estimation, metrics, gains, system, found.noise)
    # A result that is kept for what it has to tell must not keep what the observer made.
    of_source, growth = source.assumptions, (observed.growth, observed.growth_rate)
    of_observer = partial(of_observation, observed.assumptions, growth, excitation, system)
    warned, told = warnings(observed), partial(
        verdict, excitation, estimation.cases, estimation.requirement, metrics, found.fit, unknown,
        found.left_out, estimation.active,
    )
    notes = observed.note + note + simulation_note(simulation, found.settings.solver.tol)
    notes += functions_note(system, found.signals)
    notes += recording.note if recording else ""
    return replaced(
        found, excitation=excitation, estimation=estimation, metrics=metrics,
        assumptions=lambda: needed((*of_source(), *of_observer())),
        verdict=lambda: "; ".join([told() + notes, *warned, *estimation.warnings]),
        warnings=lambda: (*warned, *estimation.warnings),
    )


def _bounded_where_known(
    observation: Observation, system: DescriptorSystem, told: Mapping[str, bool]
) -> tuple[Observation, str]:
    """With the bounds of what the data determine, and what the last line says of the others."""
    given = observation.bounds or {}
    of_unknowns, of_states = sides(given, system)
    names = dict.fromkeys(side.name for side in (*of_unknowns, *of_states))
    idle = [name for name in names if not told.get(name, True)]
    if not idle:
        return observation, ""
    kept = {
        kind: {name: pair for name, pair in pairs.items() if name not in idle}
        for kind, pairs in given.items()
    }
    why = f"; without effect, for want of data: observer.bounds of {', '.join(idle)}"
    return replace(observation, bounds=kept), why


def _with_deviations(
    settings: Settings, observation: Observation, estimator: estimators.Estimator, source: Source,
    known: Knowledge, estimation: EstimationResult, system: DescriptorSystem,
) -> tuple[EstimationResult, str]:
    """With standard deviations, or why there are none (not, if nobody asked)."""
    if isinstance(observation.state_map, Filtering):
        of_eta, of_x = observation.state_map.deviations(estimation.t)
        std = np.concatenate([of_eta, of_x], axis=1)[None]
        return estimation.with_deviations(std), ""
    if not settings.uncertainty or observation.estimator is not None:
        return estimation, ""
    found, columns = observation.about(known.independent, lambda some, columns: standard_deviations(
        replace(observation, regression=some), estimator, source, estimation.t, estimation.states,
        system, columns,
    ))
    if isinstance(found, str):
        return estimation, found
    p = estimation.parameters.shape[2]
    std = np.full((*found[1].shape[:2], p + found[1].shape[2]), np.nan)
    std[..., columns], std[..., p:] = found
    std[np.isnan(np.concatenate([estimation.parameters, estimation.states], axis=2))] = np.nan
    std[estimation.still] = np.nan
    regression, final = observation.regression, estimation.explaining
    if regression.resets or final is None or not _one_fit(observation):
        return estimation.with_deviations(std), ""
    told, why = doubts.finished(std, regression.root, final, estimation.requirement, columns)
    return estimation.with_deviations(told), why


def _blind(source: Source) -> bool:
    """Whether nobody knows the true states."""
    return source.recording is not None and not source.recording.known_states


def _one_fit(observation: Observation) -> bool:
    """Whether there is one η for all of the data since a reset, and one Y."""
    regression = observation.regression
    return not (
        regression.dynamics or regression.parametrisation or regression.realisations
        or observation.bounds
    )


def _gains(observation: Observation, estimation: EstimationResult) -> Array | None:
    """∂x̂/∂η̂ (G, M, n, p) where deviations are known, and the state rests on constant η."""
    state_map = observation.state_map
    if estimation.states_std is None or not isinstance(state_map, Differentiable):
        return None
    return state_map.gains(estimation.t, estimation.states)


def at_samples(
    result: RunResult, source: Source, samples: Sampling, estimator: estimators.Estimator,
    stage: Stage,
) -> RunResult:
    """The same at samples of the signals, ``samples.step`` apart (ConfigError)."""
    settings, system = result.settings, result.system
    refuse_seeds(settings.noise)
    if source.pieces:
        raise ConfigError("data.file: several files need an observer in continuous time")
    start, stop = source.inputs.mesh.edges[[0, -1]].tolist()
    with stage("observe and estimate") as pace:
        t = sample_times(samples.step, start, stop)
        check_at_samples(len(estimator.cases), len(t), system)
        u, y = source.inputs(t), source.outputs(t)
        if source.recording is not None:  # nothing is held from the last row on, but it is a sample
            u[-1], y[-1] = source.recording.inputs[-1], source.recording.outputs[-1]

        def fed(
            by: estimators.Estimator, columns: IntArray | None, *, last: bool
        ) -> tuple[Online, list[OnlineEstimates]]:
            wanted = settings.uncertainty and last
            online = Online(
                settings, system, samples.hold, start, np.append(u[0], y[0]), by,
                sampled_deviations(source.levels, source, t) if wanted else None,
                source.derivatives, columns,
            )
            made = []
            done = pace(len(t), f"samples with {len(estimator.cases)} cases")
            for i in range(0, len(t), _SAMPLES_AT_ONCE):
                part = slice(i, i + _SAMPLES_AT_ONCE)
                found = online.feed(t[part], u[part], y[part])
                made += [found] if last else []
                done(min(part.stop, len(t)))
            return online, made

        def estimated(columns: IntArray | None) -> tuple[Online, OnlineEstimates]:
            by = estimators.tuned_for(
                estimator, lambda one: fed(one, columns, last=False)[0].requirement
            )
            online, made = fed(by, columns, last=True)
            return online, joined(made)

        online, made = estimated(None)
        columns = made.known.independent
        if 0 < len(columns) < len(online.parameters) and not online.fits:
            # As many numbers in its settings as parameters: all are estimated.
            with suppress(ConfigError):
                online, made = estimated(columns)
        truth, x = online.truth(made.extension)(t, source.theta(t), source.states), source.states(t)
        parameters = made.parameters * accuracy.told(made.known.parameters[-1])
        states = made.states * accuracy.told(made.seen[-1])
        sizes = accuracy.sizes_of(truth, online.natural_sizes, x)
        metrics = accuracy.metrics_of(accuracy.numbers_of(
            t, parameters - truth, states - x, sizes, accuracy.judged_of(system, truth.shape[1])
        ), online.parameters, system)
    chosen = kept_samples(1, len(t), settings.time.samples)
    kept = chosen[kept_samples(len(online.cases), len(chosen), settings.output.max_rows)]
    still = doubts.still(parameters, online.requirement, online.natural_sizes)
    told = np.concatenate([parameters, states], axis=2)[:, kept]
    std, gains, why = made.at(kept, ~np.isnan(told), still)
    if settings.uncertainty and parameters.size and std is None:
        why = why or none_at_samples(len(online.cases), system)
    estimation = EstimationResult(
        cases=online.cases, t=t[kept], names=online.parameters, parameters=parameters[:, kept],
        true_parameters=truth[kept], states=states[:, kept],
        delta=None if made.delta is None else made.delta[:, kept],
        checks={}, requirement=online.requirement, still=still,
        doubts=online.doubts(
            np.append(sizes[0], np.where(np.isnan(sizes[1]), online.largest, sizes[1])), columns
        ),
    ).with_deviations(std)
    with stage("excitation"):
        window = settings.excitation.window or (t[-1] - t[0]) / WINDOWS
        excitation = online.excitation(
            made, chosen, sampled_window_level(made.regression, window)[chosen], window
        )
    times = estimable(
        excitation.known, excitation.t, online.parameters, system.states, made.seen[chosen]
    )
    rows = made.regression.rows[1 + chosen]
    sampled = RegressionResult(
        t[chosen], rows[..., -1], rows[..., :-1], online.parameters, online.error_estimate
    )
    found = replaced(
        result, regression=sampled, fit=online.fit() if source.recording else None,
        estimable=lambda: times,
    )
    return _completed(
        found, source, online, [name for name, since in times.items() if since is None],
        excitation, estimation, metrics, gains,
        _no_deviations(why) if source.noisy else _held(samples, metrics),
    )


def _no_deviations(why: str) -> str:
    return f"; no standard deviations: {why}" if why else ""


def _held(samples: Sampling, metrics: Metrics) -> str:
    """What the hold has to do with estimates that did not get as close as 1 %."""
    if np.isfinite(metrics.seconds_to_1pct_states).any() or not np.isfinite(
        metrics.final_error_states
    ).any():
        return ""
    if samples.hold == "zoh":
        return (
            "; the error of signals that are held between samples falls with "
            "observer.sample_time, and faster with observer.hold=linear"
        )
    return "; the error of straight lines between samples falls with observer.sample_time squared"


def _estimate(
    settings: Settings, system: DescriptorSystem, estimator: estimators.Estimator,
    observation: Observation, source: Source, known: Knowledge, seen: BoolArray, pace: Pace,
) -> tuple[EstimationResult, Metrics]:
    """Run every case on the mesh and the samples that are kept; measure on both.

    What is not determined at the end is NaN. If the estimator is not the observer's own, the
    parameters that others can stand for are left out.
    """
    regression, state_map = observation.regression, observation.state_map
    cases, t = estimator.cases, source.t
    kept = t[kept_samples(len(cases), len(t), settings.output.max_rows)]
    # Where nobody knows the truth there is nothing to measure between the samples that are kept;
    # and each time with bounds is a programme of its own.
    at_kept = bool(observation.bounds) or _blind(source)
    points = kept if at_kept else regression.mesh.points.ravel()
    grid = np.unique(np.concatenate([points, state_map.times, kept]))
    chosen = np.searchsorted(grid, kept)

    x = source.states(grid)
    truth = observation.truth(grid, source.theta(grid), source.states)
    size, p, n = len(cases), truth.shape[1], x.shape[1]
    each = size <= _PER_QUANTITY
    about_own = observation.names is None and observation.estimator is None
    determined = known.parameters[-1] if about_own else np.ones(p, dtype=bool)
    seen = seen if about_own else np.ones(n, dtype=bool)
    plain, columns = observation.about(
        known.independent, lambda some, _: estimators.estimate(estimator, some, grid, kept)
    )
    requirement, held = plain.requirement, None
    if observation.bounds:
        held = bounded(observation.bounds, system, observation, columns, plain, grid)
    estimates = held or plain
    told = accuracy.told(determined), accuracy.told(seen)
    natural = accuracy.natural_sizes(regression, p)
    sizes = accuracy.sizes_of(truth, natural, x)
    evaluate = accuracy.evaluation(
        state_map, grid, truth * told[0], x * told[1], sizes, accuracy.judged_of(system, p), chosen,
        each=each, alone=size == 1,
    )
    parameters, estimated = np.empty((size, len(kept), p)), np.empty((size, len(kept), n))
    numbers = np.empty((len(METRICS) + each * (p + n), size))
    batch = max(1, _BATCH // (len(grid) * (2 * p + n)))
    done = pace(size, "cases")
    for first in range(0, size, batch):
        part = slice(first, min(first + batch, size))
        eta = estimates.parameters(part)
        if len(columns) < p:
            whole = np.zeros((*eta.shape[:2], p))
            whole[..., columns] = eta
            eta = whole
        numbers[:, part] = evaluate(eta, parameters[part], estimated[part])[: len(numbers)]
        done(part.stop)
    explaining = parameters[:, -1].copy()
    parameters[..., np.isnan(told[0])] = np.nan
    estimated[..., np.isnan(told[1])] = np.nan

    def doubted() -> tuple[Mapping[str, float], tuple[str, ...]]:
        """Those of the final estimates; after resets, by the data since the last of them."""
        since, by, visibly, end = regression.segments[-1], known, seen, kept[-1:]
        if regression.resets:
            by = assess(since, end, settings.excitation, settings.solver.tol).final
            visibly = visible(replace(observation, regression=since), end, system.states)(by)[-1]
        states, last = (
            lambda eta, t=t: state_map.at(t)(eta[:, None].repeat(len(t), axis=1))
            for t in (kept, end)
        )
        return doubts.of_estimates(
            since.root, explaining, states, last, [*since.parameters, *system.states],
            np.concatenate(sizes), by, visibly, columns, requirement,
        )

    result = EstimationResult(
        cases=estimator.cases, t=kept, names=observation.parameters, parameters=parameters,
        true_parameters=truth[chosen], states=estimated, delta=lambda: plain.delta(kept),
        checks=state_map.checks(kept, estimated), requirement=requirement, explaining=explaining,
        active=held.active if held else {},
        doubts=doubted if about_own and _one_fit(observation) else ({}, ()),
        still=doubts.still(parameters, requirement, natural),
    )
    return result, accuracy.metrics_of(numbers, observation.parameters, system)
