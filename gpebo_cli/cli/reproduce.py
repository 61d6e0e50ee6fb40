"""``gpebo reproduce``: published numbers beside ours, with a verdict for each."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gpebo_cli.cli.arguments import NO_WORDS, Arguments
from gpebo_cli.cli.figures import recipe_jobs, run_recipe_job
from gpebo_cli.cli.options import PLAIN, VOLUME, Options, parse
from gpebo_cli.configs.locations import choices, conf_folder
from gpebo_cli.errors import ConfigError
from gpebo_cli.schema import counted, known_name, read, shown

if TYPE_CHECKING:
    from gpebo_cli.experiment.result import RunResult

FOLDER = "experiment/published"
_PAGE = {"--page": "a Markdown file"}
_NOTES = {"theirs": "Their figure", "differs": "What differs", "erratum": "Erratum"}
_PICTURES = Path("img", "atlas")  # beside the page
_KINDS = ("case", "final", "last", "first", "max", "min")


@dataclass(frozen=True)
class Expected:
    """One number of a publication, as a recipe's ``expected`` has it."""

    quantity: str  # case.COLUMN of cases.csv, final.ESTIMATE; last., first., max. or min.SIGNAL
    value: float | list[float]  # a list has one for each case
    tolerance: float  # absolute
    where: str  # it is printed


@dataclass(frozen=True)
class Finding:
    """A published number beside ours."""

    recipe: str
    title: str
    reference: str
    quantity: str
    published: float
    ours: float | None  # None: not run, its data are not here
    tolerance: float
    where: str
    notes: Mapping[str, str] = field(default_factory=dict)  # what the recipe says besides

    @property
    def holds(self) -> bool:
        """Whether they agree, as far as is known."""
        return self.ours is None or abs(self.ours - self.published) <= self.tolerance


def main(words: list[str]) -> int:
    """Run the recipes; the exit code: 1 if a number is off."""
    options = parse("reproduce", words, _PAGE, VOLUME)
    page = options.values.get("--page")
    pictures = None if page is None else Path(page).parent / _PICTURES
    known = choices(conf_folder(), FOLDER)
    for name in options.words:
        known_name(name, known, f"gpebo reproduce: there is no recipe {shown(name)}")
    findings = [f for name in options.words or known for f in reproduced(name, options, pictures)]
    if not options.quiet:
        sys.stdout.writelines(f"{line}\n" for line in table(findings))
    if page is not None:
        from gpebo_cli.results.files import write_text

        write_text(Path(page), atlas(findings, Path(page).parent))
    findings = [finding for finding in findings if finding.ours is not None]
    off = [finding for finding in findings if not finding.holds]
    count = len({finding.recipe for finding in findings})
    if off or not options.quiet:
        numbers = counted(len(findings), "number")
        sys.stdout.write(f"{counted(count, 'recipe')}, {numbers}, {len(off)} off\n")
    return 1 if off else 0


def reproduced(
    name: str, options: Options = PLAIN, pictures: Path | None = None
) -> Iterator[Finding]:
    """Run a recipe of ``experiments/published`` and compare, where its data are here.

    A small figure of the run goes to the folder ``pictures`` (ConfigError: ``expected`` names no
    quantity of the run; GpeboError: the run failed).
    """
    from omegaconf import OmegaConf

    from gpebo_cli.cli.composition import session

    where = f"experiment published/{name}"
    with session(NO_WORDS) as hydra:
        ((_, config),) = recipe_jobs(f"published/{name}", hydra.config_loader)
    file, result = OmegaConf.select(config, "data.file"), None
    if file is not None and not Path(file).exists():
        sys.stderr.write(f"{name}: not run, there is no {file} here; see {config.reference}\n")
    else:
        result = run_recipe_job(config, Arguments(options), where)
        if pictures is not None:
            _draw(result, pictures / f"{name}.png")
    notes = {key: str(config[key]).strip() for key in _NOTES if config.get(key)}
    title, reference = (str(OmegaConf.select(config, key) or "") for key in ("title", "reference"))
    entries = OmegaConf.to_container(config.expected)
    for entry in entries if isinstance(entries, list) else []:
        expected = read(Expected, entry, f"{where}: expected")
        values = expected.value if isinstance(expected.value, list) else [expected.value]
        ours: list[float] | list[None] = [None] * len(values)
        if result is not None:
            ours = quantity(result, expected.quantity, where)
        if not isinstance(expected.value, list):
            values *= len(ours)  # the same of every case
        if len(values) != len(ours):
            raise ConfigError(
                f"{where}: {expected.quantity} has {len(ours)} values, one for each case, and "
                f"{len(values)} are expected"
            )
        for value, own in zip(values, ours, strict=True):
            yield Finding(
                name, title, reference, expected.quantity, value, own, expected.tolerance,
                expected.where, notes,
            )


def _draw(result: RunResult, path: Path) -> None:
    """The first panel of the first figure that there is, small."""
    from gpebo_cli.results.figures import describe
    from gpebo_cli.results.style import compose, save
    from gpebo_cli.settings import OutputSettings

    path.parent.mkdir(parents=True, exist_ok=True)
    panels = next(iter(describe(result, ("parameter_error", "parameters", "states")).values()))
    save(compose(panels[:1], OutputSettings(width=2.0, dpi=72)), path)


def quantity(result: RunResult, name: str, where: str) -> list[float]:
    """One value of a run, of ``case.`` and ``final.`` one for each case (ConfigError)."""
    import numpy as np

    kind, _, of = name.partition(".")
    signals, system = result.signals, result.system
    columns = {
        "case": {} if result.metrics is None else vars(result.metrics),
        "final": {} if result.estimation is None else dict(zip(
            (*result.system.states, *result.estimation.names),
            (*result.estimation.states[:, -1].T, *result.estimation.parameters[:, -1].T),
            strict=True,
        )),
    }
    every = np.column_stack([signals.inputs, signals.outputs, signals.states])
    named = dict(zip((*system.inputs, *system.outputs, *system.states), every.T, strict=True))
    known = columns.get(kind, named if kind in _KINDS else {})
    if of not in known:
        raise ConfigError(
            f"{where}: there is no quantity {shown(name)}; there are "
            f"{', '.join(f'{k}.NAME' for k in _KINDS)}, and of {kind} the names {', '.join(known)}"
        )
    values = np.atleast_1d(known[of])
    if kind in columns:
        return [float(value) for value in values]
    pick = {"last": values[-1], "first": values[0], "max": values.max(), "min": values.min()}
    return [float(pick[kind])]


def table(findings: Sequence[Finding]) -> list[str]:
    """One line for each number."""
    from gpebo_cli.results.report import columns

    rows = [("recipe", "quantity", "published", "ours", "tolerance", "")]
    rows += [
        (f.recipe, f.quantity, f"{f.published:.7g}", f"{f.ours:.7g}", f"{f.tolerance:.1g}",
         "agrees" if f.holds else f"OFF by {abs(f.ours - f.published):.3g}")
        for f in findings if f.ours is not None
    ]
    return [line.rstrip() for line in columns(rows, str.ljust)]


def atlas(findings: Sequence[Finding], folder: Path) -> str:
    """The page of published results, for a folder with pictures of those that were run."""
    lines = [
        "# Published results, reproduced", "",
        "Made by `gpebo reproduce --page docs/atlas.md`. Each recipe is a file of",
        "`experiments/published`, and runs alone as `gpebo run experiment=published/NAME`.", "",
        "| recipe | ours | quantity | published | ours | tolerance | where it is from |",
        "|---|---|---|---|---|---|---|",
    ]
    notes, previous = [], ""
    for f in findings:
        name = picture = ""
        if f.recipe != previous:
            marked = " **erratum**" if "erratum" in f.notes else ""
            name = f"`{f.recipe}`: {f.title}; {f.reference}{marked}"
            file = _PICTURES / f"{f.recipe}.png"
            picture = f"![{f.title}]({file.as_posix()})" if (folder / file).exists() else ""
            notes += [f"| `{f.recipe}` | {_NOTES[key]} | {text} |" for key, text in f.notes.items()]
        previous = f.recipe
        ours = "needs their data" if f.ours is None else f"{f.ours:.7g}"
        lines.append(
            f"| {name} | {picture} | {f.quantity} | {f.published:.7g} | "
            f"{ours}{'' if f.holds else ' **off**'} | {f.tolerance:.1g} | {f.where} |"
        )
    return "\n".join([
        *lines, "", "## What stands in the publications", "", "| recipe | | |", "|---|---|---|",
        *notes, "",
    ])
