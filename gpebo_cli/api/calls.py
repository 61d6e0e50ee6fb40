"""``run``, ``check``, ``load_plant`` and ``available``: the command line's work, from Python."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias, overload

import numpy as np

from gpebo_cli import observers
from gpebo_cli.api.choice import choose, folders
from gpebo_cli.api.result import Result
from gpebo_cli.configs import configuration
from gpebo_cli.configs.files import is_file, shipped
from gpebo_cli.configs.locations import DATA_GROUPS, GROUPS, PRIMARY, choices, conf_folder
from gpebo_cli.errors import ConfigError
from gpebo_cli.estimators import Estimator, settings_of
from gpebo_cli.experiment import assumptions
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.recordings.drive import located
from gpebo_cli.regression.text import system_from_mapping
from gpebo_cli.schema import known_name, nearest, plain, shown
from gpebo_cli.settings import NoiseSettings, Settings, SolverSettings

if TYPE_CHECKING:
    from pandas import DataFrame

    from gpebo_cli.importers.draft import PlantDraft

Plant: TypeAlias = "str | os.PathLike[str] | Mapping[str, object] | PlantDraft | DescriptorSystem"
Choice = str | Mapping[str, object]
EstimatorChoice = Choice | Estimator
Folder = str | os.PathLike[str]

_SECTIONS = {"time": '{"horizon": 10}', "excitation": '{"window": 1}'}  # with examples
_CHOSEN = tuple(group for group in DATA_GROUPS if group != "plant")


def run(
    plant: Plant | None = None,
    *,
    regression: Plant | None = None,
    estimator: EstimatorChoice | None = None,
    observer: Choice | None = None,
    solver: Choice | None = None,
    noise: Choice | None = None,
    data: Choice | os.PathLike[str] | DataFrame | None = None,
    time: Mapping[str, object] | None = None,
    excitation: Mapping[str, object] | None = None,
    uncertainty: bool = True,
    config_dir: Folder | None = None,
    progress: Callable[[str], None] | None = None,
    **gains: object,
) -> Result:
    """Simulate a plant, observe it, estimate its parameters and state, collect the evidence.

    What ``gpebo run`` does, without writing anything; what is left out has the same default, from
    the same files.

    Args:
        plant: a name (``gpebo list plants``), the path of a YAML file, the content of one, or a
            system from :func:`system_from_functions` or :func:`load_plant`, or what
            :func:`from_netlist` and the like make.
        regression: Y = ψη in place of a plant and an observer: a name, the path of a YAML file, or
            the content of one (docs/howto/regression.md).
        estimator: a name, a mapping with ``name`` and its settings, or an object of your own
            with ``cases`` and ``estimate`` (see :class:`gpebo_cli.estimators.Estimator`).
        observer: a name, or a mapping; ``"none"`` simulates only.
        solver: a name, or a mapping such as ``{"tol": 1e-9}``.
        noise: a name, or a mapping such as ``{"name": "gaussian", "outputs": 0.01, "seed": 1}``.
        data: a recording: the path of a file (CSV, Parquet, MAT), a ``pandas.DataFrame`` with
            columns ``t`` and those of the signals, a mapping of such arrays (N,), or one with a
            ``file`` or ``frame`` and how to read it (``hold``, ``columns``, ``scale``,
            ``time_unit``, …); by default the plant is simulated.
        time: ``start`` and ``horizon`` in seconds, ``samples`` of the output grid.
        excitation: ``rho`` and ``window`` (seconds) of the evidence.
        uncertainty: whether estimates of noisy signals get standard deviations.
        config_dir: a folder of yours, with ``plant/NAME.yaml``, ``estimator/NAME.yaml``, …
        progress: called with the name of each stage as it begins; of a long one again, with an
            attribute ``share`` of 0 to 1, as it gets on.
        gains: settings of the estimator, as in ``gamma=[1e8, 1e10]``; every combination of
            lists is one case. ``lambda`` is a word of Python's: ``**{"lambda": 0.2}``.

    Returns:
        What the run found, by name: ``result["il"]`` (N,), ``result.estimates["il"]`` (cases, M),
        ``result.parameters``, ``result.verdict``; see :class:`Result`.

    Raises:
        ConfigError: a wrong name, key, value or plant; the texts are the command line's.
        ModelError: the plant cannot be simulated, or an assumption of the observer fails.
        SolverError: a tolerance cannot be reached.

    Examples:
        >>> from gpebo_cli import run
        >>> result = run("circuit", estimator="drem", gamma=[1e8, 1e10], time={"horizon": 8})
        >>> result["il"].shape, result.estimates["il"].shape
        ((1001,), (2, 1001))
        >>> bool(abs(result.errors["il"][1, -1]) < 1e-6)
        True
    """
    own = None if isinstance(estimator, str | Mapping) else estimator
    has = all(hasattr(own, name) for name in ("cases", "estimate"))
    if own is not None and (isinstance(own, type) or not has):
        raise ConfigError(
            "estimator: expected a name, a mapping or an object with cases and estimate, got "
            f"{shown(estimator)}"
        )
    config, system, settings = _configure(
        plant, regression, config_dir, {} if own else gains, observer=observer,
        estimator=None if own else estimator, solver=solver, noise=noise, data=_recording(data),
        time=time, excitation=excitation, uncertainty=uncertainty,
    )
    if own is not None:
        if gains:
            raise ConfigError(
                f"run: {', '.join(gains)} given beside an estimator object; give them to "
                f"{type(own).__name__}(…)"
            )
        config["estimator"] = {"name": type(own).__name__}
        settings = replace(settings, estimator=config["estimator"])
    return Result(run_experiment(settings, system, progress or (lambda _: None), own), config)


def check(
    plant: Plant | None = None,
    *,
    regression: Plant | None = None,
    observer: Choice | None = None,
    solver: Choice | None = None,
    noise: Choice | None = None,
    data: Choice | os.PathLike[str] | DataFrame | None = None,
    time: Mapping[str, object] | None = None,
    excitation: Mapping[str, object] | None = None,
    config_dir: Folder | None = None,
) -> tuple[Assumption, ...]:
    """Every assumption that a run would rest on, with its evidence, as ``gpebo check`` has them.

    The arguments are those of :func:`run`, with the same meaning.

    Raises:
        ConfigError: a wrong name, key, value or plant.
        SolverError: a tolerance cannot be reached.

    Examples:
        >>> from gpebo_cli import check
        >>> [a.name for a in check("circuit", observer={"regression": "paper"}) if not a.holds]
        ['Assumption 2']
    """
    _, system, settings = _configure(
        plant, regression, config_dir, {}, observer=observer, solver=solver, noise=noise,
        data=_recording(data), time=time, excitation=excitation,
    )
    return assumptions.examine(settings, system).assumptions


def _in_place(
    regression: Plant, plant: object, observer: object, config_dir: Folder | None
) -> tuple[Plant, Choice]:
    """What stands in place of a plant and an observer (ConfigError: they are given, too)."""
    named = isinstance(observer, str) or (isinstance(observer, Mapping) and "name" in observer)
    if plant is not None or named:
        raise ConfigError("a regression stands in place of a plant and an observer")
    if isinstance(regression, DescriptorSystem):
        raise ConfigError("regression takes a name, a path or a mapping")
    settings = observer if isinstance(observer, Mapping) else {}
    return choose("regression", regression, config_dir)[0], {"name": "regression", **settings}


def load_plant(plant: Plant, config_dir: Folder | None = None) -> DescriptorSystem:
    """A plant by name, from the path of a YAML file, or from the content of one.

    Raises:
        ConfigError: there is none of that name, or something is wrong in it.

    Examples:
        >>> from gpebo_cli import load_plant
        >>> load_plant("circuit").states
        ('e1', 'e2', 'il', 'ir1', 'ir2', 'iv')
    """
    if isinstance(plant, DescriptorSystem):
        return plant
    content, source = choose("plant", plant, config_dir)
    return system_from_mapping(content, source)


@overload
def available(group: str, config_dir: Folder | None = None) -> list[str]: ...
@overload
def available(group: None = None, config_dir: Folder | None = None) -> dict[str, list[str]]: ...
def available(
    group: str | None = None, config_dir: Folder | None = None
) -> list[str] | dict[str, list[str]]:
    """Names that a group can have, those in its folders included (``published/lorenz``).

    Args:
        group: ``plant``, ``observer``, ``estimator``, ``solver``, …; without it, all by group.
        config_dir: a folder of yours, with ``GROUP/NAME.yaml``.

    Raises:
        ConfigError: there is no such group, or no such folder.

    Examples:
        >>> from gpebo_cli import available
        >>> "circuit" in available("plant")
        True
        >>> "drem" in available()["estimator"]
        True
        >>> "published/lorenz" in available("experiment")
        True
    """
    if group is None:
        return {name: available(name, config_dir) for name in GROUPS}
    known_name(group, GROUPS, f"available({shown(group)}): no such group")
    return sorted({
        name for folder in folders(config_dir) for name in choices(folder, group, inside=True)
    })


def _configure(
    plant: Plant | None, regression: Plant | None, config_dir: Folder | None,
    gains: Mapping[str, object], **sections: object,
) -> tuple[dict[str, Any], DescriptorSystem, Settings]:
    """The configuration as ``config.yaml`` has it, the plant, and the settings."""
    if regression is not None:
        plant, sections["observer"] = _in_place(regression, plant, sections["observer"], config_dir)
    config = {k: v for k, v in shipped(PRIMARY).items() if k not in ("defaults", "hydra")}
    for name, example in _SECTIONS.items():
        given = sections[name]
        if given is not None and not isinstance(given, Mapping):
            raise ConfigError(
                f"{name}: expected a mapping such as {example}, got {shown(given)}"
            )
        config[name] = {**config[name], **plain(given or {})}
    config["uncertainty"] = sections.get("uncertainty", True)
    if isinstance(plant, DescriptorSystem):
        config["plant"], system = {}, plant
    else:
        content, source = choose("plant", plant, config_dir)
        config["plant"] = plain(located(content, source))
        named = config_dir is None and isinstance(plant, str)
        ours = named and is_file(conf_folder(), f"plant/{plant}")
        system = _shipped(str(plant)) if ours else system_from_mapping(content, source)
    for name in _CHOSEN:
        config[name], _ = choose(name, sections.get(name), config_dir)
    _check_gains(gains, config["estimator"])
    config["estimator"] |= plain(gains)
    settings = configuration.settings(config, draw=True)
    config["data"].pop("frame", None)  # no data of a configuration
    return configuration.complete(config, settings), system, settings


_parsed = cache(load_plant)


def _shipped(name: str) -> DescriptorSystem:
    """A plant that comes with gpebo: it is parsed once, and what is recorded of it is kept."""
    system = _parsed(name)  # what a result has of it may be changed
    return deepcopy(system, {id(system.coefficients): system.coefficients})


def _recording(data: Choice | os.PathLike[str] | DataFrame | None) -> object:
    """``data`` as the group has it: a path, a frame, arrays by name, or a mapping with one."""
    if isinstance(data, Mapping):
        given: dict[str, object] = {"frame": data} if "t" in data else dict(data)
        if isinstance(frame := given.get("frame"), Mapping):
            given["frame"] = _framed(frame)
        return {"name": "csv", **given}
    if data is None or (isinstance(data, str) and data == "none"):
        return data
    if isinstance(data, list | tuple) and all(isinstance(f, str | os.PathLike) for f in data):
        return {"name": "csv", "file": [os.fspath(each) for each in data]}
    if not isinstance(data, str | os.PathLike):
        return {"name": "csv", "frame": data}
    return {"name": "csv", "file": os.fspath(data)}


def _framed(columns: Mapping[str, Any]) -> DataFrame:
    """Arrays by name as a frame (ConfigError: something else is among them, or lengths differ)."""
    from pandas import DataFrame  # a third of a second to import

    for name, column in columns.items():
        if isinstance(column, str | Mapping):
            raise ConfigError(
                f"data: {shown(name)} is no array; how rows are read stands beside all of them, as "
                'in data={"frame": {"t": …, …}, "hold": "zoh"}'
            )
    try:
        return DataFrame(dict(columns))
    except ValueError as error:
        sizes = ", ".join(f"{name} {np.shape(column)}" for name, column in columns.items())
        raise ConfigError(f"data: arrays of the shapes {sizes}: {error}") from error


def _check_gains(gains: Mapping[str, object], estimator: Mapping[str, object]) -> None:
    """Refuse a keyword that the estimator does not have, with where it may belong."""
    known = settings_of(estimator)
    words = (*_CHOSEN, *_SECTIONS, "config_dir", "progress")
    for key in [key for key in gains if key not in known]:
        sections = {
            **{name: tuple(shipped(PRIMARY)[name]) for name in _SECTIONS},
            "solver": tuple(field.name for field in fields(SolverSettings)),
            "observer": tuple(observers.settings_of({"name": "gpebo"})),
            "noise": tuple(field.name for field in fields(NoiseSettings)),
        }
        belongs = next((name for name, keys in sections.items() if key in keys), None)
        hint = f'; did you mean {belongs}={{"{key}": …}}?' if belongs else ""
        raise ConfigError(
            f"run: no such keyword {key}; estimator {estimator['name']} has {', '.join(known)}"
            + (hint or nearest(key, (*words, *known)))
        )
