"""What a run gives back in Python: signals by name, tables, figures, and the folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpebo_cli import estimators
from gpebo_cli.api import exports
from gpebo_cli.configs import configuration
from gpebo_cli.errors import ConfigError
from gpebo_cli.evidence.excitation import Excitation
from gpebo_cli.experiment.result import RunResult
from gpebo_cli.findings import Assumption, replaced
from gpebo_cli.model.descriptor import Array
from gpebo_cli.results import figures, html
from gpebo_cli.results.figures import truth_at
from gpebo_cli.results.folder import write_run
from gpebo_cli.results.report import case_cells, case_rows, run_lines
from gpebo_cli.results.style import draw_on
from gpebo_cli.results.tables import frame
from gpebo_cli.schema import counted, shown, unknown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

_SHOWN_CASES = 12  # in a notebook
_HAT = "_hat"  # of the names of estimates, as in estimates.csv


class UnknownNameError(ConfigError, KeyError):
    """A signal was asked for by a name that the run does not have."""

    __str__ = Exception.__str__  # KeyError's quotes the whole sentence


class NamedArrays(Mapping[str, Array]):
    """Arrays by name; an unknown name is answered with the nearest known one."""

    def __init__(self, what: str, names: Sequence[str], values: Array) -> None:
        self._what = what
        self._values: dict[str, Array] = dict(zip(names, np.moveaxis(values, -1, 0), strict=True))

    def __getitem__(self, name: str) -> Array:
        if name not in self._values:
            what = f"{self._what} has no {shown(name)}"
            raise UnknownNameError(str(unknown(what, name, self._values)))
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"<{self._what}: {', '.join(self._values) or 'none'}>"


@dataclass(frozen=True, eq=False)
class Result:
    """One run. N output times, G cases (combinations of gains), M times of estimates.

    ``result["il"]`` is a true signal (N,), ``result["il_hat"]`` its estimates (G, M).

    Attributes:
        details: everything, as arrays by position; see
            :class:`gpebo_cli.experiment.result.RunResult`.
        config: the configuration, complete, as ``config.yaml`` has it.

    Examples:
        >>> from gpebo_cli import run
        >>> result = run("descriptor", estimator="ls_drem", time={"horizon": 10})
        >>> result.parameters["theta1"]
        1.5
        >>> round(float(result.estimates["theta1"][0, -1]), 6)
        1.5
        >>> list(result.to_pandas("estimates").columns[:2])
        ['theta1_hat', 'theta2_hat']
    """

    details: RunResult
    config: Mapping[str, Any]

    @property
    def t(self) -> Array:
        """Output times in seconds, (N,)."""
        return self.details.signals.t

    @cached_property
    def inputs(self) -> NamedArrays:
        """Inputs u by name, without noise, (N,) each; ``to_pandas`` has them as measured."""
        return NamedArrays("inputs", self.details.system.inputs, self.details.signals.inputs)

    @cached_property
    def outputs(self) -> NamedArrays:
        """Outputs y by name, without noise, (N,) each; ``to_pandas`` has them as measured."""
        return NamedArrays("outputs", self.details.system.outputs, self.details.signals.outputs)

    @cached_property
    def states(self) -> NamedArrays:
        """True states x by name, (N,) each."""
        return NamedArrays("states", self.details.system.states, self.details.signals.states)

    @property
    def estimates_t(self) -> Array:
        """Times of the estimates in seconds, (M,); M < N where cases are very many."""
        estimation = self.details.estimation
        return np.zeros(0) if estimation is None else estimation.t

    @cached_property
    def estimates(self) -> NamedArrays:
        """Estimates of parameters and states by name, (G, M) each; NaN: a state not seen.

        Without an observer there are none.
        """
        return self._estimated("estimates")

    @cached_property
    def errors(self) -> NamedArrays:
        """Estimate minus truth by name, (G, M) each."""
        return self._estimated("errors")

    def _estimated(self, what: str) -> NamedArrays:
        """Estimates or their errors, by name; none without an observer."""
        estimation = self.details.estimation
        if estimation is None:
            return NamedArrays(what, (), np.zeros((0, 0, 0)))
        values = np.concatenate([estimation.parameters, estimation.states], axis=-1)
        if what == "errors":
            x = truth_at(self.details, estimation.t)
            values -= np.concatenate([estimation.true_parameters, x], axis=-1)
        return NamedArrays(what, (*estimation.names, *self.details.system.states), values)

    @property
    def parameters(self) -> dict[str, float]:
        """θ and e₀ by name, at the end: true values, or the estimates where nobody knows them.

        Of a recording those of the case that explains it best; without an observer there are none.
        """
        estimation, fit = self.details.estimation, self.details.fit
        if estimation is None:
            return {}
        found = estimation.parameters[0 if fit is None else fit.best, -1]
        truth = estimation.true_parameters[-1]
        pairs = zip(estimation.names, np.where(np.isnan(truth), found, truth), strict=True)
        return {name: float(value) for name, value in pairs}

    @property
    def cases(self) -> list[dict[str, float]]:
        """Gains and metrics of each case, as in ``cases.csv``; NaN: never."""
        return case_rows(self.details)

    @property
    def excitation(self) -> Excitation | None:
        """Evidence of excitation; None without an observer."""
        return self.details.excitation

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What the run rests on, with evidence."""
        return self.details.assumptions

    @property
    def verdict(self) -> str:
        """The last line that ``gpebo run`` prints."""
        return self.details.verdict

    def __getitem__(self, name: str) -> Array:
        """A true signal or an estimate by its name in the CSV files: ``t``, ``il``, ``il_hat``."""
        everything = {"t": self.t, **self.inputs, **self.outputs, **self.states}
        if name in everything:
            return everything[name]
        if name in self:
            return self.estimates[name.removesuffix(_HAT)]
        raise UnknownNameError(str(unknown(f"this run has no signal {shown(name)}", name, self)))

    def __iter__(self) -> Iterator[str]:
        """Names that ``result[name]`` takes, so that ``name in result`` can be asked."""
        hats = (estimate + _HAT for estimate in self.estimates)
        return iter(("t", *self.inputs, *self.outputs, *self.states, *hats))

    def __str__(self) -> str:
        return "\n".join(run_lines(self.details))

    def __repr__(self) -> str:
        """Short: :attr:`verdict` says how it went."""
        details = self.details
        first, last = float(self.t[0]), float(self.t[-1])
        what = f"{details.settings.observer.get('name')}, {len(self.t)} times"
        if details.estimation is not None:
            cases = counted(len(details.estimation.cases), "case")
            what += f", {details.settings.estimator.get('name')} with {cases}"
        return f"<gpebo run of {details.system.name}, t = {first:g} to {last:g} s, {what}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: the verdict and the cases."""
        table = html.table(case_cells([("", row) for row in self.cases[:_SHOWN_CASES]]))
        return html.paragraph(repr(self)) + html.paragraph(self.verdict) + table

    def to_pandas(self, table: str = "signals") -> DataFrame:
        """One of the run's tables as a data frame, with the names of the CSV files.

        Args:
            table: ``signals``, ``regression`` or ``excitation``, indexed by ``t`` in seconds;
                ``estimates``, indexed by ``case`` and ``t``; ``cases``, one row each.

        Raises:
            ConfigError: no table has that name, or a run without an observer lacks it.
        """
        return frame(self.details, table)

    def to_xarray(self, table: str = "signals") -> Any:
        """One of the run's tables as an ``xarray.Dataset``, with names as :meth:`to_pandas` has.

        Args:
            table: as of :meth:`to_pandas`; ``estimates`` has the dimensions ``case`` and ``t``.

        Raises:
            ConfigError: no table has that name, or xarray is not installed.
        """
        return exports.to_xarray(self.details, table)

    def to_control(self) -> Any:
        """The observer as a ``control.StateSpace``, where plant and observer are time-invariant.

        Its inputs are u, y and the unknowns, by name; its states are those of the observer, and
        its outputs ``<state>_hat``.

        Raises:
            ConfigError: another observer than gpebo, a plant that varies with time, or
                python-control is not installed.
        """
        return exports.to_control(self.details)

    @property
    def figures(self) -> list[str]:
        """Names of the figures that :meth:`plot` can draw of this run."""
        return list(figures.describe(self.details, figures.FIGURES))

    def plot(self, figure: str | None = None, *, ax: Axes | None = None) -> Figure | Axes:
        """A figure of the run, as ``gpebo run`` draws it; a notebook shows it.

        Args:
            figure: one of :attr:`figures`; by default the states and their estimates. With ``ax``
                also the name of one of its panels, as in ``error of e1``.
            ax: axes of a figure of yours to draw one panel on: the one named, or the first.

        Returns:
            The figure, or ``ax``.

        Raises:
            ConfigError: no figure has that name, or this run has nothing for it.
        """
        found = figures.describe(self.details, figures.FIGURES)
        if figure is None:
            figure = next(n for n in ("estimates_a", "estimates", "states") if n in found)
        if ax is None:
            return dict(figures.draw(self.details, [figure]))[figure]
        panels = {panel.name: panel for of_one in found.values() for panel in of_one}
        if figure not in panels:
            panels[figure] = figures.describe(self.details, [figure], strict=True)[figure][0]
        draw_on(ax, panels[figure])
        return ax

    def save(self, folder: str | os.PathLike[str], figures: bool | Sequence[str] = True) -> Path:
        """Write the folder that ``gpebo run`` writes: tables, summary, configuration, figures.

        Args:
            folder: where to; it is created where needed.
            figures: True for all, False for none, or names of some, or one name.

        Returns:
            The folder.

        Raises:
            ConfigError: a figure does not exist.
            GpeboError: a file cannot be written.
        """
        figures = [figures] if isinstance(figures, str) else figures
        chosen = figures if isinstance(figures, bool) else list(figures)
        settings = self.details.settings
        output = replace(settings.output, figures=chosen)
        details = replaced(self.details, settings=replace(settings, output=output))
        word = (None if chosen else "none") if isinstance(chosen, bool) else chosen
        name = str(self.config["estimator"]["name"])
        own = self.details.settings.data.frame is not None
        repeats = bool(self.config["plant"]) and name in estimators.names() and not own
        head = configuration.REPEATS if repeats else _NOT_REPEATED
        text = configuration.config_text({**self.config, "figures": word}, head)
        write_run(details, Path(folder), text)
        return Path(folder)


_NOT_REPEATED = (
    "The plant, the estimator or the data was a Python object; this file does not repeat the run"
)
