"""The run folder: tables, summary, configuration and figures of one run."""

from __future__ import annotations

from pathlib import Path

from gpebo_cli.experiment.result import RunResult
from gpebo_cli.results.figures import FIGURES, draw
from gpebo_cli.results.files import alone, make_folder, remove_files, write_text
from gpebo_cli.results.names import FORMATS
from gpebo_cli.results.provenance import Provenance, provenance
from gpebo_cli.results.style import save
from gpebo_cli.results.summary import summary_text
from gpebo_cli.results.tables import TABLES, write_noise, write_parquet, write_table

_FILES = (*(f"{name}.csv" for name in TABLES), "noise.csv")  # that: of more than one seed only


def write_run(
    result: RunResult, folder: Path, config_text: str, made_by: Provenance | None = None
) -> None:
    """Write everything a run leaves behind to ``folder``, which is created where needed.

    What the run does not have (without an observer: all but the plant's signals) is not written,
    and files of the same names from an earlier run in the same folder are removed: none of
    them tells of another run than the others, and two runs that end at once write one after the
    other. ``summary.json`` comes last, so that a folder that has one is complete. Figures that do
    not exist are refused before anything is written.
    """
    wanted = result.settings.output.figures
    figures = draw(result, None if wanted is True else wanted or [])
    make_folder(folder)
    with alone(folder):
        # What an earlier run left, by name: a folder may hold files that are not ours.
        made = [folder / name for name in ("summary.json", *_FILES)]
        remove_files(path.with_suffix(s) for path in made for s in (path.suffix, ".parquet"))
        remove_files(folder / "figures" / f"{name}.{s}" for name in FIGURES for s in FORMATS)

        write_text(folder / "config.yaml", config_text)
        for name, make in TABLES.items():
            if (table := make(result)) is not None:
                write_table(folder / f"{name}.csv", table)
        if result.estimation is not None and result.noise is not None:
            write_noise(folder / "noise.csv", result.estimation, result.noise)
        if result.settings.output.parquet:
            write_parquet(folder / name for name in _FILES)
        for name, figure in figures:
            make_folder(folder / "figures")
            for suffix in result.settings.output.formats:
                save(figure, folder / "figures" / f"{name}.{suffix}")
        write_text(folder / "summary.json", summary_text(result, made_by or provenance()))
