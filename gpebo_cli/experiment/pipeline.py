"""One experiment from settings to result; the way of the data in one function.

source (simulated, recorded) → estimation (continuous, at samples) → result; a stream feeds the
estimation at samples as its rows come.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np

from gpebo_cli import estimators
from gpebo_cli.errors import ConfigError
from gpebo_cli.experiment import limits, several, sources
from gpebo_cli.experiment.assumptions import needed
from gpebo_cli.experiment.estimation import at_samples, continuous
from gpebo_cli.experiment.limits import Pace, paced
from gpebo_cli.experiment.noise import noise_levels
from gpebo_cli.experiment.online import Online
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.experiment.seeds import check_seeds, refuse_seeds
from gpebo_cli.experiment.uncertainty import sampled_deviations
from gpebo_cli.experiment.verdict import verdict
from gpebo_cli.kernels.threads import one_thread
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.model.text import driven_from_outside
from gpebo_cli.observers import build, sampling
from gpebo_cli.recordings.hold import holds
from gpebo_cli.regression.text import TextRegression
from gpebo_cli.schema import instant
from gpebo_cli.settings import Settings


class Stage(str):
    """The name of a stage that has got on."""

    __slots__ = ("share",)
    share: float  # of it that is done, 0 to 1


@contextmanager
def _timed(
    seconds: dict[str, float], progress: Callable[[str], None], limit: float, name: str
) -> Iterator[Pace]:
    """A stage that tells how it gets on; how long it took goes to ``seconds``, by its name."""
    since = perf_counter()
    progress(name)

    def getting_on(share: float) -> None:
        if share < 1.0:
            stage = Stage(name)
            stage.share = share
            progress(stage)

    yield lambda count, what: paced(count, what, limit, getting_on)
    seconds[name] = perf_counter() - since


@one_thread
@np.errstate(all="ignore")  # what is not finite is found where it matters, with reason and time
def run_experiment(
    settings: Settings,
    system: DescriptorSystem,
    progress: Callable[[str], None] = lambda _stage: None,
    estimator: estimators.Estimator | None = None,
) -> RunResult:
    """Simulate the plant, observe it, estimate, and collect the evidence.

    Progress is called with the name of each stage as it starts, and of a long one again with its
    ``share`` (:class:`Stage`) as it gets on. The ``estimator`` is used instead of the one that the
    settings name (ConfigError: settings that do not fit the plant; ModelError: the plant cannot be
    simulated, or Assumption 1 fails; SolverError: a tolerance cannot be reached).
    """
    levels = noise_levels(settings.noise, system)
    sources.check(settings, levels)
    observer = build(settings.observer)
    if observer is not None and estimator is None:
        estimator = estimators.build(settings.estimator)
    check_seeds(levels, settings.time.horizon)
    limits.check(settings, system, levels, 0 if estimator is None else len(estimator.cases))
    if isinstance(estimator, estimators.Fitting):
        given = system.regression
        estimator.law(given.parametrisation if isinstance(given, TextRegression) else None)
    seconds: dict[str, float] = {}
    stage = partial(_timed, seconds, progress, settings.solver.max_seconds)
    recorded, samples = settings.data.name == "csv", sampling(observer)
    system = driven_from_outside(system) if recorded else system
    with stage("read" if recorded else "simulate"):
        read = sources.recorded if recorded else sources.simulated
        file = settings.data.file
        each = [settings] if not file or isinstance(file, str) else [
            replace(settings, data=replace(settings.data, file=one)) for one in file
        ]
        source = several.joined_source([read(one, system, levels, samples) for one in each])
    of_source = source.assumptions
    result = RunResult(
        settings=settings, system=system, simulation=source.simulation,
        recording=source.recording, timings=seconds, assumptions=lambda: needed(of_source()),
        verdict=source.verdict,
    )
    if observer is None or estimator is None:
        refuse_seeds(settings.noise)
        return result
    if samples is None:
        return continuous(result, source, observer, estimator, stage)
    return at_samples(result, source, samples, estimator, stage)


def stream(settings: Settings, system: DescriptorSystem) -> Callable[[float, Array], Online]:
    """The estimation of rows that come one after the other, from the time of the first one on.

    ConfigError: a setting that needs to know how a recording goes on.
    """
    levels = noise_levels(settings.noise, system)
    sources.check_stream(settings, system, levels)
    estimator = estimators.build(settings.estimator)
    if len(estimator.cases) > 1:
        raise ConfigError(
            f"the gains of the estimator make {len(estimator.cases)} cases; a stream has room for "
            "one"
        )
    deviations = sampled_deviations(levels, None) if settings.uncertainty else None
    system = driven_from_outside(system)
    return lambda start, sample: Online(
        settings, system, holds(settings.data.hold, system), start, sample, estimator, deviations
    )


def stream_verdict(online: Online) -> str:
    """The last line of a stream: how much came, and what the one of a run says."""
    excitation, fit = online.excitation(), online.fit()
    return "; ".join([
        f"{online.count} rows, t = {instant(online.start, 6)} to {instant(online.reached.t, 6)}",
        verdict(excitation, online.cases, online.requirement, fit=fit) + online.note,
        *online.doubts()[1],
    ])
