"""``gpebo figures``: run the recipes of the paper and write their figures, tables and a page."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpebo_cli.cli.arguments import NO_WORDS, Arguments
from gpebo_cli.cli.options import CONFIG_DIR, VOLUME, no_option, parse
from gpebo_cli.configs.locations import PRIMARY
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.results.names import FORMATS
from gpebo_cli.schema import convert, counted, known_name, read, shown
from gpebo_cli.settings import OutputSettings

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader
    from omegaconf import DictConfig

    from gpebo_cli.experiment.result import RunResult
    from gpebo_cli.results.gallery import Recipe, Section

_OUTPUT = "outputs/paper"
_FORMATS = "figures.formats"
_FOLDERS = {"--output": "a folder", "--check": "a folder", "--update": "a folder"}


def main(words: list[str]) -> int:
    """Regenerate the figures; the exit code (ConfigError, GpeboError)."""
    options = parse("figures", words, {**_FOLDERS, **CONFIG_DIR}, VOLUME)
    arguments = Arguments(options, config_dir=options.config_dir)
    names, formats = _asked(arguments)
    update, check = options.values.get("--update"), options.values.get("--check")
    if check is not None and not os.path.isdir(check):
        raise ConfigError(f"--check {check}: there is no such folder")

    # Only now, when the words are known to be good: half a second of imports.
    from gpebo_cli.results import circuit, gallery
    from gpebo_cli.results.files import make_folder, write_text
    from gpebo_cli.results.provenance import provenance

    folder = Path(options.values.get("--output", _OUTPUT))
    names = names or list(gallery.STUDIES)
    if gallery.PAPERS in names and not circuit.available():
        sys.stderr.write("Fig. 1 is left out: it needs schemdraw, pip install 'gpebo[figures]'\n")
    make_folder(folder)
    sections: list[Section] = []
    differences: list[str] = []
    for recipe in run_recipes(names, arguments):
        figures = gallery.figures_of(recipe)
        section = gallery.write_recipe(folder / recipe.name, recipe, figures, formats)
        sections.append(section)
        if not options.quiet:
            sys.stdout.write(f"{recipe.name}: {counted(section.pictures, 'figure')}\n")
        if update is not None:
            gallery.write_references(Path(update), recipe.name, figures)
        if check is not None:
            differences += gallery.check_references(Path(check), recipe.name, figures)
    write_text(folder / "index.html", gallery.page(sections, provenance()))
    if not options.quiet:
        sys.stdout.write(f"{folder / 'index.html'}\n")
    if differences:
        sys.stdout.writelines(f"{line}\n" for line in differences)
        sys.stdout.flush()  # before what follows on stderr
        raise GpeboError(
            f"{len(differences)} differences from the tables in {check}; first: {differences[0]}"
        )
    return 0


def _asked(arguments: Arguments) -> tuple[list[str], list[str]]:
    """Names of recipes, and formats."""
    names: list[str] = []
    formats, known = ["png"], arguments.known("experiment")
    for word in arguments.given.words:
        key, equals, value = word.partition("=")
        if key == _FORMATS:
            formats = _formats(value)
        elif equals and key != "experiment":
            raise no_option("figures", key, (*_FOLDERS, *CONFIG_DIR, _FORMATS))
        else:
            names.append(word.removeprefix("experiment="))
            what = f"gpebo figures: there is no recipe {shown(names[-1])}"
            known_name(names[-1], known, what)
    return list(dict.fromkeys(names)), formats


def _formats(text: str) -> list[str]:
    """``[png,pdf]`` or ``pdf``; PNG is always among them, for the page shows it."""
    given = [part.strip() for part in text.strip("[] ").split(",")]
    asked = read(OutputSettings, {"formats": given}, "figures").formats
    return [name for name in FORMATS if name == "png" or name in asked]


def run_recipes(names: list[str], arguments: Arguments = NO_WORDS) -> Iterator[Recipe]:
    """Compose and run recipes, one at a time, those of a folder of one's own included."""
    from gpebo_cli.cli.composition import session
    from gpebo_cli.results.gallery import Recipe

    for name in names:
        runs: dict[str, RunResult] = {}
        with session(arguments) as hydra:
            jobs = list(recipe_jobs(name, hydra.config_loader))
        for label, cfg in jobs:
            where = f"experiment {name}" + (f", {label}" if label else "")
            runs[label] = run_recipe_job(cfg, arguments, where)
        words = {key: str(cfg.get(key) or "") for key in ("title", "reference", "note")}
        drawn = convert(cfg.get("drawn"), list[str] | None, f"experiment {name}: drawn")
        yield Recipe(name, runs=runs, drawn=drawn, **words)


def recipe_jobs(name: str, loader: ConfigLoader) -> Iterator[tuple[str, DictConfig]]:
    """Configurations of a recipe: one, or those of its ``hydra.sweeper.params`` by their values.

    A value is shown without its folder if that tells all of them apart.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.types import RunMode

    overrides = [f"experiment={name}"]
    first = loader.load_configuration(PRIMARY, overrides, RunMode.RUN)
    if first.hydra.mode != RunMode.MULTIRUN:
        yield "", first
        return
    swept: Mapping[str, Any] = first.hydra.sweeper.get("params") or {}
    stored = OverridesParser.create().parse_overrides([f"{k}={v}" for k, v in swept.items()])
    (jobs,) = BasicSweeper.split_arguments(stored, None)
    values = [[word.partition("=")[2] for word in words] for words in jobs]
    labels = [", ".join(each) for each in values]
    short = [", ".join(value.rpartition("/")[2] for value in each) for each in values]
    for label, words in zip(short if len({*short}) == len(short) else labels, jobs, strict=True):
        yield label, loader.load_configuration(PRIMARY, [*overrides, *words], RunMode.RUN)


def run_recipe_job(cfg: DictConfig, arguments: Arguments, where: str) -> RunResult:
    """Run one composed configuration, that of ``where``; nothing is written (GpeboError)."""
    from gpebo_cli.cli.job import read_job
    from gpebo_cli.cli.progress import Progress
    from gpebo_cli.experiment.pipeline import run_experiment

    given = arguments.given
    try:
        job = read_job(cfg, arguments, draw=False)
        with Progress(quiet=given.quiet, loud=given.loud) as progress:
            return run_experiment(job.settings, job.system, progress)
    except GpeboError as error:
        raise type(error)(f"{where}: {error}") from error
