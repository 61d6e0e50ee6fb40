"""How figures look: a column or a page of a journal, legible without colour.

A figure is described by :class:`Panel` and :class:`Curve`, which are its data as well, and drawn by
:func:`compose`. matplotlib is imported by the first figure, not before, and never by way of pyplot.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array
from gpebo_cli.results.files import write_file
from gpebo_cli.results.symbols import escaped, number_text, power_of_ten, with_unit
from gpebo_cli.schema import shown, unknown
from gpebo_cli.settings import OutputSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTHS = {"column": 3.5, "page": 7.16}  # inches, of a two-column journal
WIDTH, DPI = WIDTHS["column"], 200
TEXT = 8.0  # points, as in _SHEET; the labels of ticks are one point smaller
PANEL_HEIGHT, SINGLE_HEIGHT = 1.15, 2.0  # inches: one among several, one alone
MAX_PANELS = 8

ROUNDING = 1e-16  # relative to the size of a signal, errors below this say nothing
_HUGE = 1e300  # an estimate that diverges further leaves the axis; the axis itself stays finite
_PAD, _GAP = 0.05, 0.11  # inches: at the edges of a figure, and between panels
_SHEET = Path(__file__).with_name("gpebo.mplstyle")
_DRAWING = RLock()  # matplotlib's settings and its parser of formulas are those of all threads

# These hold in every style: journals refuse Type 3 fonts, the ids in an SVG file do not vary, and
# the room that is kept for a legend is that of its lines.
_ALWAYS: dict[str, Any] = {
    "text.usetex": False, "pdf.fonttype": 42, "svg.hashsalt": "gpebo",
    "legend.frameon": False, "legend.borderpad": 0.0, "legend.borderaxespad": 0.2,
}


@contextmanager
def our_rc(style: str | None = None) -> Iterator[None]:
    """Set our own style, or one of matplotlib's, for a while, in one thread at a time."""
    from matplotlib import rc_context

    ours: Any = {**(sheet() if style is None else _style(style)), **_ALWAYS}  # keys are literals
    with _DRAWING, rc_context(ours):
        yield


@cache
def sheet() -> Mapping[str, Any]:
    """Our own style: whatever a user's matplotlibrc says, the figures of a run are the same."""
    from matplotlib import rc_params_from_file

    found: Any = rc_params_from_file(_SHEET, use_default_template=False)
    return dict(found)


def check_look(style: str | None, labels: Mapping[str, str]) -> None:
    """Refuse a style or a label of a plant that matplotlib does not understand (ConfigError)."""
    if style is not None:
        _style(style)
    if labels:
        from matplotlib.mathtext import MathTextParser

        parser: Any = MathTextParser("path")
    for name, text in labels.items():
        try:
            with _DRAWING:
                parser.parse(f"${text}$")
        except ValueError:
            raise ConfigError(
                f"labels.{name}: {shown(text)} is not mathematics that matplotlib can set; "
                r"expected something like i_L, e_{0,1} or \theta_1"
            ) from None


def _style(name: str) -> dict[str, Any]:
    """A style that comes with matplotlib; a path or an address is none (ConfigError)."""
    from matplotlib import rcParamsDefault
    from matplotlib.style import available, library

    if name not in library:
        what = f"figures.style: matplotlib has no style {shown(name)}"
        raise unknown(what, name, sorted(available))
    changed: dict[str, Any] = {**library[name]}  # type: ignore[dict-item]
    return {**{key: rcParamsDefault[key] for key in sheet()}, **changed}  # type: ignore[index]


@dataclass(frozen=True)
class Line:
    """Colour, dashes (on, off, … in line widths; empty: solid) and width in points."""

    color: str
    dashes: tuple[float, ...] = ()
    width: float = 1.1
    dots: bool = False  # a dot at every point: for few points, with gaps between them perhaps

    @property
    def keywords(self) -> dict[str, Any]:
        """What a matplotlib line is made with."""
        dashes: Any = (0, self.dashes) if self.dashes else "-"
        dots = {"marker": "o", "markersize": 2.4} if self.dots else {}
        return {"color": self.color, "linestyle": dashes, "linewidth": self.width, **dots}


# Okabe & Ito (2008) without their yellow, too light for a line. No two dashes are alike, so that
# a black-and-white print still tells the curves apart.
LINES = (
    Line("#0072B2"),
    Line("#D55E00", (5, 1.6)),
    Line("#009E73", (1.2, 1.2)),
    Line("#CC79A7", (6, 1.5, 1.2, 1.5)),
    Line("#000000", (2.6, 1.3)),
    Line("#E69F00", (9, 2)),
    Line("#56B4E9", (5, 1.3, 1.2, 1.3, 1.2, 1.3)),
)
TRUTH = Line("#B4B4B4", (), 2.6)  # wide and pale: an estimate that has converged lies on it
MEASURED = Line("#9A9A9A", (), 0.5)  # thin and pale: noise fills an area
RESIDUAL = Line("#D55E00", (), 0.5)  # thin: noise, whose dashes would be its own
VARYING = Line("#000000", (4, 2), 0.9)  # a truth that varies, over what follows it
SPREAD = Line("#0072B2", (2.0, 1.5), 0.8)  # what an estimator says of its own error
UNKNOWN = Line("#777777", (4, 2), 1.1)  # the truth of what the data do not determine
LIMIT = Line("#000000", (1.0, 1.5), 0.9)  # a level
INSTANT = Line("#777777", (), 0.8)  # a time


def line(number: int) -> Line:
    """Line number ``number`` of :data:`LINES`; after 49 they start again."""
    count = len(LINES)
    # Each round pairs the colours with other dashes.
    dashes = LINES[(number + number // count) % count].dashes
    return Line(LINES[number % count].color, dashes)


@dataclass(frozen=True)
class Curve:
    """A line through ``(x, y)``, both (N,); an empty label keeps it out of the legend."""

    x: Array
    y: Array
    label: str  # in tables
    style: Line
    text: str = ""  # in the legend; default: the label
    down_to: Array | None = None  # (N,) the other edge of a band


@dataclass(frozen=True)
class Axis:
    """The horizontal axis, which all panels of a figure share."""

    name: str  # of its column in a table
    label: str
    unit: str = ""
    log: bool = False
    text: str = ""  # in the figure; default: the label


TIME = Axis("t", "time t", "s", text="time $t$")


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its ``curves``.

    On a ``log`` axis, values that are not positive are left out, and the axis ends at rounding,
    1e-16 of ``size``. ``limits`` bounds a linear axis (default: the range of the curves).
    """

    name: str  # of the vertical axis, in tables
    curves: tuple[Curve, ...]
    unit: str = ""
    text: str = ""  # the name in the figure; default: as in tables
    log: bool = False
    size: float = 0.0  # of the signal whose error this is; 0: not known
    limits: tuple[float, float] | None = None
    axis: Axis = TIME
    vertical: tuple[float, str] | None = None  # a time worth marking, and its legend entry
    legend: bool = False
    note: str = ""  # above the legend

    @property
    def label(self) -> str:
        """Name and unit, as tables have them."""
        return with_unit(self.name, self.unit)


def drawn(panel: Panel, curve: Curve) -> Array:
    """The values of ``curve`` that ``panel`` shows, (N,); NaN where it has a gap."""
    keep = np.isfinite(curve.y)
    if panel.log:
        keep &= curve.y > 0
    return np.where(keep, curve.y, np.nan)


def compose(panels: Sequence[Panel], look: OutputSettings | None = None) -> Figure:
    """Draw ``panels`` below each other over the first one's axis, each below its own legend.

    At most :data:`MAX_PANELS` are drawn; a line at the bottom says how many were left out. By
    default it is a column at 200 dpi in our own style.
    """
    look = look or OutputSettings()
    shown = panels[:MAX_PANELS]
    width = WIDTHS[look.width] if isinstance(look.width, str) else look.width
    tall = SINGLE_HEIGHT if len(shown) == 1 else PANEL_HEIGHT
    with our_rc(look.style):
        figure = new_figure(width, 1.5 * tall * len(shown), look.dpi)
        rows = [figure.add_axes((0.2, 0.2, 0.7, 1 / 1.5 / len(shown))) for _ in shown]
        for axes, panel in zip(rows, shown, strict=True):
            _fill(axes, panel, tall)
            _set_across(axes, shown)
        for axes in rows[:-1]:
            axes.tick_params(labelbottom=False)
            axes.set_xlabel("")
        _arrange(figure, rows, shown, tall)
        if len(panels) > len(shown):
            note = f"{len(shown)} of {len(panels)} shown"
            figure.text(_PAD / width, 0.0, note, size=TEXT - 1, va="bottom")
    return figure


def draw_on(axes: Axes, panel: Panel) -> None:
    """Draw one panel on axes of somebody else's figure, in the settings that hold there."""
    with _DRAWING:
        _fill(axes, panel, axes.bbox.height / axes.figure.dpi)
        _set_across(axes, [panel])
        if panel.legend:
            _set_legend(axes, panel, axes.bbox.width)


def new_figure(width: float, height: float, dpi: int = DPI) -> Figure:
    """An empty figure, in inches."""
    figure_class, canvas_class = _classes()
    figure = figure_class(figsize=(width, height), dpi=dpi)
    canvas_class(figure)
    return figure


def _arrange(figure: Figure, rows: Sequence[Axes], panels: Sequence[Panel], tall: float) -> None:
    """Put panels of the height ``tall`` below each other, as wide as names and ticks allow.

    matplotlib's layout engines would fit the panels to the figure, not the figure to them, and
    measure every text four times, which takes longer than drawing.
    """
    dpi, width = figure.dpi, figure.get_figwidth()
    names: list[Any] = [axes.yaxis.get_tightbbox() for axes in rows]
    labels = [axes.yaxis.label.get_window_extent().width for axes in rows]
    thick = max(labels) / dpi
    # All names stand in one column, beside the widest ticks: these may be another panel's.
    ticks = [a.bbox.x0 - box.x0 - own for a, box, own in zip(rows, names, labels, strict=True)]
    left = _PAD + thick + max(ticks) / dpi
    across: Any = rows[-1].xaxis.get_tightbbox()
    right = _PAD + max(0.0, across.x1 - rows[-1].bbox.x1) / dpi
    inner = width - left - right
    heads = [
        _set_legend(axes, panel, inner * dpi) / dpi if panel.legend else 0.0
        for axes, panel in zip(rows, panels, strict=True)
    ]
    bottom = _PAD + (rows[-1].bbox.y0 - across.y0) / dpi
    height = _PAD + sum(heads) + len(rows) * (tall + _GAP) - _GAP + bottom
    figure.set_size_inches(width, height)
    top = height - _PAD
    for axes, head in zip(rows, heads, strict=True):
        top -= head + tall
        axes.set_position((left / width, top / height, inner / width, tall / height))
        axes.yaxis.set_label_coords((_PAD + thick - left) / inner, 0.5)
        top -= _GAP


@cache
def _classes() -> tuple[type[Figure], Any]:
    """matplotlib's figure and canvas with what they lack, without pyplot.

    The figure shows itself in a notebook. The canvases share a parser of formulas and thereby its
    memory: most of a run's figures have the same names on them, and each takes milliseconds.
    """
    from matplotlib import figure
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    first: dict[str, Any] = {}

    class Drawing(figure.Figure):
        def _repr_png_(self) -> bytes:
            return file_content(self, "png")

    class Canvas(FigureCanvasAgg):
        def get_renderer(self) -> Any:
            renderer: Any = super().get_renderer()  # type: ignore[no-untyped-call]
            renderer.mathtext_parser = first.setdefault("parser", renderer.mathtext_parser)
            return renderer

    return Drawing, Canvas


def file_content(figure: Figure, suffix: str) -> bytes:
    """``figure`` as a PNG, PDF or SVG file, which does not record when it was written."""
    buffer = BytesIO()
    date = {"pdf": "CreationDate", "svg": "Date"}.get(suffix)
    # Level 1: flat drawings gain nothing from more, and level 6 takes twice the time.
    more: Any = {"metadata": {date: None}} if date else {"pil_kwargs": {"compress_level": 1}}
    with our_rc():
        # The default, "figure", would replace what a style has set.
        figure.savefig(buffer, format=suffix, dpi="figure", facecolor="auto", **more)
    return buffer.getvalue()


def save(figure: Figure, path: Path) -> None:
    """Write ``figure`` in the format of the path's suffix, complete or not at all."""
    write_file(path, [file_content(figure, path.suffix[1:])])


def _fill(axes: Axes, panel: Panel, height: float) -> None:
    """Draw a panel that is ``height`` inches high, all but its legend and what panels share."""
    if panel.log:
        axes.set_yscale("log")
    axes.set_ylim(*(_log_limits(panel) if panel.log else _limits(panel)))
    for curve in panel.curves:
        axes.plot(curve.x, drawn(panel, curve), label=curve.text or escaped(curve.label) or "_",
                  **curve.style.keywords)
        if curve.down_to is not None:
            axes.plot(curve.x, curve.down_to, **curve.style.keywords)
            axes.fill_between(curve.x, curve.down_to, curve.y, color=curve.style.color,
                              alpha=0.15, linewidth=0.0)
    if not any(_is_seen(drawn(panel, curve), curve.style) for curve in panel.curves):
        alone = any(np.isfinite(drawn(panel, curve)).any() for curve in panel.curves)
        finite = any(np.isfinite(curve.y).any() for curve in panel.curves)
        said = "zero" if finite and panel.log else "no finite values"
        said += " but at single times" if alone else " throughout" * (said == "zero")
        axes.text(0.5, 0.5, said, transform=axes.transAxes, ha="center", va="center")
    if panel.vertical is not None:
        time, label = panel.vertical
        axes.axvline(time, label=label.replace("t_c", "$t_c$"), **INSTANT.keywords)
    unit = _set_ticks(axes.yaxis, 5, panel.unit, log=panel.log)
    _set_name(axes, panel.text or escaped(panel.name), unit, height)


def _is_seen(values: Array, style: Line) -> bool:
    """Whether a curve (N,) leaves a mark: a point of a line between gaps does not."""
    there = np.isfinite(values)
    return bool(there.any() if style.dots else (there[1:] & there[:-1]).any())


def _set_across(axes: Axes, panels: Sequence[Panel]) -> None:
    """Scale, limits, ticks and name of the horizontal axis."""
    axis = panels[0].axis
    ends = [curve.x[[0, -1]] for panel in panels for curve in panel.curves]
    low, high = float(np.min(ends)), float(np.max(ends))
    if not high > low:
        high = low * 10.0 if axis.log else low + 1.0
    if axis.log:
        axes.set_xscale("log")
        margin = (high / low) ** 0.02
        axes.set_xlim(low / margin, high * margin)
    else:
        dots = any(curve.style.dots for panel in panels for curve in panel.curves)
        margin = 0.02 * (high - low) if dots else 0.0  # half a dot at either end would be cut
        axes.set_xlim(low - margin, high + margin)
    unit = _set_ticks(axes.xaxis, 7, axis.unit, log=axis.log)
    if axis.log and np.ceil(np.log10(low)) + 1 > np.floor(np.log10(high) + 1e-9):
        # There are less than two whole decades to label: the ends are.
        axes.set_xticks([low, high], [number_text(low), number_text(high)])
    axes.set_xlabel(with_unit(axis.text or escaped(axis.label), unit))


def _ends(panel: Panel, low: float, high: float) -> tuple[float, float]:
    """The smallest and the largest value that is drawn; ``low`` and ``high`` if nothing is."""
    bands = [] if panel.log else [c.down_to for c in panel.curves if c.down_to is not None]
    values = np.concatenate([*(drawn(panel, c) for c in panel.curves), *bands])
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else (low, high)


def _limits(panel: Panel) -> tuple[float, float]:
    """Ends of a linear axis: finite and apart, whatever the values."""
    low, high = panel.limits or _ends(panel, 0.0, 0.0)
    low, high = max(low, -_HUGE), min(high, _HUGE)
    size = max(abs(low), abs(high))
    if size < 1.0 / _HUGE:
        low, high = -0.5, 0.5
    elif high - low <= 1e-9 * size:  # constant: show it on an axis of its own size
        low, high = low - 0.5 * size, high + 0.5 * size
    margin = 0.06 * (high - low)
    return low - margin, high + margin


def _log_limits(panel: Panel) -> tuple[float, float]:
    """Ends of a logarithmic axis: whole decades, and a little more so that no curve is cut."""
    low, high = _ends(panel, 0.1, 1.0)
    high = min(max(high, 1.0 / _HUGE), _HUGE)
    low = min(max(low, ROUNDING * panel.size, 1.0 / _HUGE), high)
    first = math.floor(math.log10(low) + 1e-9)
    last = max(math.ceil(math.log10(high) - 1e-9), first + 1)
    room = min(1.0, (last - first) * 0.04)
    return 10.0 ** (first - room), 10.0 ** (last + room)


def _set_ticks(axis: Any, most: int, unit: str, *, log: bool) -> str:
    """At most ``most`` + 1 ticks; the unit with the power of ten that their labels leave out."""
    from matplotlib.ticker import MaxNLocator

    ends = axis.get_view_interval()
    if log:
        first, last = math.ceil(math.log10(ends[0])), math.floor(math.log10(ends[1]))
        step = -(-(last - first + 1) // most)
        exponents = [k for k in range(first, last + 1) if k % step == 0]
        # A text with superscripts: setting a formula takes twenty times as long.
        axis.set_ticks([10.0**k for k in exponents], [power_of_ten(k) for k in exponents])
        axis.set_ticks([], minor=True)
        return escaped(unit)
    ticks = MaxNLocator(most, steps=[1, 2, 5, 10]).tick_values(*ends)
    ticks = ticks[(ticks >= ends[0]) & (ticks <= ends[1])]
    exponent = math.floor(math.log10(np.abs(ends).max()))
    if -3 < exponent < 4:
        exponent = 0
    size = 10.0**exponent
    apart = float(np.diff(ticks).min(initial=np.inf) / size)
    decimals = max(0, -math.floor(math.log10(apart) + 1e-9)) if math.isfinite(apart) else 1
    labels = [f"{tick / size + 0.0:.{decimals}f}".replace("-", "−") for tick in ticks]
    axis.set_ticks(ticks, labels)
    return " ".join(filter(None, (power_of_ten(exponent) if exponent else "", escaped(unit))))


def _set_name(axes: Axes, name: str, unit: str, height: float) -> None:
    """Name the vertical axis, on several lines or in smaller letters if it is a long one."""
    if "$" in name:  # mathematics is broken at a minus sign, or not at all
        head, _, tail = name.partition(" - ")
        broken = f"{head}$\n$- {tail}" if tail and head.count("{") == head.count("}") else name
    else:
        broken = "\n".join(textwrap.wrap(name.replace("_", "_ "), 22)).replace("_ ", "_")
    for words, between in ((name, " "), (name, "\n"), (broken, "\n")):
        text = with_unit(words, unit, between)
        axes.set_ylabel(text)
        if len(text) < 12:
            return
        length = axes.yaxis.label.get_window_extent().height / axes.figure.dpi
        if length <= height:
            return
    axes.yaxis.label.set_fontsize(TEXT * height / length)


def _set_legend(axes: Axes, panel: Panel, room: float) -> float:
    """Put the legend above the panel, in as many columns as ``room`` has; its height in pixels."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return 0.0
    for columns in range(min(len(handles), 6), 0, -1):
        legend = axes.legend(
            handles, labels, title=panel.note or None, alignment="left",
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns,
        )
        if legend.get_window_extent().width <= room:
            break
    else:
        share = room / legend.get_window_extent().width
        for text in legend.get_texts():
            whole = text.get_text().replace(" = ", "\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")
            text.set_text(textwrap.fill(whole, int(0.9 * share * len(whole)),
                                        break_long_words=False, break_on_hyphens=False))
    return float(legend.get_window_extent().height) + 2.0
