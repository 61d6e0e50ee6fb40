"""How figures look: one column of a two-column paper, legible without colour.

A figure is described by :class:`Panel` and :class:`Curve` and laid out by :func:`compose`, in
inches: matplotlib's own layout engines draw every text once more to measure it, which makes a
figure take half as long again. For the same reason ticks are computed here and labelled in Unicode,
without mathtext. matplotlib is imported by the first figure, not before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.results.files import write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

WIDTH = 3.5  # inches, one column
DPI = 200
TEXT = 8.0  # points; the labels of ticks are one point smaller
PANEL_HEIGHT = 1.05  # inches, of one among several
SINGLE_HEIGHT = 1.9  # inches, of a panel that is alone
MAX_PANELS = 8

ROUNDING = 1e-16  # relative to the size of a signal, errors below this say nothing
_HUGE = 1e300  # an estimate that diverges further leaves the axis; the axis itself stays finite

_RIGHT, _BOTTOM, _EDGE, _GAP = 0.10, 0.38, 0.07, 0.11  # inches
_LABEL = 0.13  # inches from the left edge to the middle of the names of vertical axes
_LEFT = 0.52  # inches, enough for tick labels of four characters; more make it wider
_LEGEND_ROW = 0.145  # inches
_CHARACTER = 0.62 * TEXT / 72  # inches; mean advance of DejaVu Sans is 0.58 em
_HANDLE = 3.0 * TEXT / 72  # inches; handle and its padding in a legend
_COLUMN_GAP = 1.2 * TEXT / 72  # inches

# Whatever a user's matplotlibrc says, the figures of a run are the same.
RC: dict[str, Any] = {
    "text.usetex": False,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": TEXT,
    "axes.labelsize": TEXT,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#333333",
    "axes.facecolor": "white",
    "figure.facecolor": "white",
    "axes.labelpad": 2.0,
    "axes.grid": False,
    "xtick.labelsize": TEXT - 1,
    "ytick.labelsize": TEXT - 1,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.pad": 2.0,
    "ytick.major.pad": 2.0,
    "legend.fontsize": TEXT,
    "legend.title_fontsize": TEXT,
    "path.simplify": True,
    "path.simplify_threshold": 0.111,
    "agg.path.chunksize": 20000,
    "pdf.fonttype": 42,  # journals refuse matplotlib's default, Type 3
    "svg.hashsalt": "gpebo",  # ids within the file are the same every time
}


@contextmanager
def our_rc() -> Iterator[None]:
    """Set :data:`RC` for a while; ``matplotlib.rc_context`` copies all 300 entries, deeply."""
    import matplotlib as mpl

    settings: Any = mpl.rcParams  # its keys are typed as literals
    theirs = {key: settings[key] for key in RC}
    try:
        settings.update(RC)
        yield
    finally:
        settings.update(theirs)


@dataclass(frozen=True)
class Line:
    """Colour, dashes (on, off, … in line widths; empty: solid) and width in points."""

    color: str
    dashes: tuple[float, ...] = ()
    width: float = 1.1
    dots: bool = False  # a dot at every point: for few points, with gaps between them perhaps


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
VARYING = Line("#000000", (4, 2), 0.9)  # a truth that varies, over what follows it
SPREAD = Line("#0072B2", (2.0, 1.5), 0.8)  # what an estimator says of its own error
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
    label: str
    style: Line


@dataclass(frozen=True)
class Axis:
    """The horizontal axis, which all panels of a figure share."""

    name: str  # of its column in a table
    label: str
    unit: str = ""
    log: bool = False


TIME = Axis("t", "time t", "s")


@dataclass(frozen=True)
class Panel:
    """One pair of axes: ``curves``, the vertical axis called ``label``.

    On a ``log`` axis, values that are not positive are left out, and the axis ends at rounding,
    1e-16 of ``size``. ``limits`` bounds a linear axis (default: the range of the curves).
    """

    label: str
    curves: tuple[Curve, ...]
    log: bool = False
    size: float = 0.0  # of the signal whose error this is; 0: not known
    limits: tuple[float, float] | None = None
    axis: Axis = TIME
    vertical: tuple[float, str] | None = None  # a time worth marking, and its legend entry
    legend: bool = False
    note: str = ""  # above the legend


def drawn(panel: Panel, curve: Curve) -> Array:
    """The values of ``curve`` that ``panel`` shows, (N,); NaN where it has a gap."""
    keep = np.isfinite(curve.y)
    if panel.log:
        keep &= curve.y > 0
    return np.where(keep, curve.y, np.nan)


def with_unit(name: str, unit: str) -> str:
    """Name of an axis: ``e1 (V)``, or the bare name where no unit is known."""
    return f"{name} ({unit})" if unit else name


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_SUBSCRIPT = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_GREEK = {
    "alpha": "α",
    "beta": "β",
    "gamma": "γ",
    "delta": "δ",
    "lambda": "λ",
    "mu": "μ",
    "rho": "ρ",
}


def power_of_ten(exponent: int) -> str:
    """``10⁻³`` in Unicode."""
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def number_text(value: float) -> str:
    """A few digits, in powers of ten where that is shorter: ``0.5``, ``10¹⁰``, ``2.5·10⁻⁷``."""
    if not math.isfinite(value) or value == 0.0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.4g}".replace("-", "−")
    mantissa, exponent = f"{value:.2e}".split("e")
    mantissa = mantissa.rstrip("0").rstrip(".").replace("-", "−")
    power = power_of_ten(int(exponent))
    return {"1": power, "−1": f"−{power}"}.get(mantissa, f"{mantissa}·{power}")


def subscript(number: int) -> str:
    """``₁₂`` for 12."""
    return str(number).translate(_SUBSCRIPT)


def symbol(gain: str) -> str:
    """Symbol of a gain as a paper prints it: ``gamma`` is γ, ``gamma_2`` is γ₂, ``f0`` is f₀."""
    word = gain.rstrip("0123456789").rstrip("_")
    digits = gain[len(word) :].lstrip("_").translate(_SUBSCRIPT)
    if word in _GREEK:
        return _GREEK[word] + digits
    return word + digits if len(word) == 1 else gain


def linear_ticks(low: float, high: float, most: int) -> tuple[Array, int]:
    """Multiples of 1, 2 or 5 times a power of ten within [low, high], at most ``most`` of them.

    Returns:
        The ticks (K,) and the number of decimals that tell them apart.
    """
    span = high - low
    decade = math.floor(math.log10(span / most))
    for factor in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0):
        step = factor * 10.0**decade
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first < most:
            break
    ticks = np.arange(first, last + 1, dtype=np.float64) * step
    return ticks, max(0, -math.floor(math.log10(step) + 1e-9))


def log_ticks(low: int, high: int, most: int) -> list[int]:
    """Exponents of the decades to label within [low, high], at most ``most`` and evenly spaced."""
    step = max(1, math.ceil((high - low + 1) / most))
    return [exponent for exponent in range(low, high + 1) if exponent % step == 0]


@dataclass(frozen=True)
class _Scale:
    """Limits and ticks of an axis, and the power of ten its labels leave out."""

    low: float
    high: float
    ticks: Sequence[float]
    labels: Sequence[str]
    exponent: int = 0


def _scale(low: float, high: float, most: int) -> _Scale:
    """Limits as given, at most ``most`` ticks, labels short even for large and small values."""
    exponent = math.floor(math.log10(max(abs(low), abs(high))))
    if -3 < exponent < 4:
        exponent = 0
    unit = 10.0**exponent
    ticks, decimals = linear_ticks(low / unit, high / unit, most)
    labels = [f"{tick:.{decimals}f}".replace("-", "−") for tick in ticks + 0.0]  # no "−0"
    return _Scale(low, high, (ticks * unit).tolist(), labels, exponent)


def _linear_scale(panel: Panel, most: int) -> _Scale:
    if panel.limits is not None:
        low, high = panel.limits
    else:
        values = np.concatenate([c.y[np.isfinite(c.y)] for c in panel.curves] or [np.zeros(0)])
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    low, high = max(low, -_HUGE), min(high, _HUGE)
    size = max(abs(low), abs(high))
    if size < 1.0 / _HUGE:
        low, high = -0.5, 0.5
    elif high - low <= 1e-9 * size:  # constant: show it on an axis of its own size
        low, high = low - 0.5 * size, high + 0.5 * size
    margin = 0.06 * (high - low)
    return _scale(low - margin, high + margin, most)


def _log_scale(panel: Panel, most: int) -> _Scale:
    values = np.concatenate([c.y[np.isfinite(c.y) & (c.y > 0)] for c in panel.curves])
    floor = ROUNDING * panel.size
    low, high = (float(values.min()), float(values.max())) if values.size else (0.1, 1.0)
    high = min(max(high, 1.0 / _HUGE), _HUGE)
    low = min(max(low, floor, 1.0 / _HUGE), high)
    first = math.floor(math.log10(low) + 1e-9)
    last = max(math.ceil(math.log10(high) - 1e-9), first + 1)
    exponents = log_ticks(first, last, most)
    ticks = [10.0**exponent for exponent in exponents]
    labels = [power_of_ten(exponent) for exponent in exponents]
    # A little more than whole decades, so that a curve at the very top is not half cut off.
    room = min(1.0, (last - first) * 0.04)
    return _Scale(10.0 ** (first - room), 10.0 ** (last + room), ticks, labels)


def _horizontal_scale(panels: Sequence[Panel], width: float) -> _Scale:
    """As many ticks, up to seven, as their labels leave room for."""
    ends = [curve.x[[0, -1]] for panel in panels for curve in panel.curves if curve.x.size]
    values = np.concatenate(ends or [np.ones(1)])
    start, stop = float(values.min()), float(values.max())
    log = panels[0].axis.log
    if not stop > start:
        stop = start * 10.0 if log else start + 1.0
    for most in range(7, 1, -1):
        scale = _decades(start, stop, most) if log else _scale(start, stop, most)
        room = width / max(len(scale.labels), 1)
        if max(map(_length, scale.labels), default=0) * _CHARACTER <= 0.8 * room:
            break
    return scale


def _decades(low: float, high: float, most: int) -> _Scale:
    """Limits just beyond the values; powers of ten, or the ends if there are not two of them."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    exponents = log_ticks(first, last, most) if last > first else []
    few = len(exponents) < 2
    ticks = [low, high] if few else [10.0**exponent for exponent in exponents]
    labels = [number_text(tick) for tick in ticks] if few else [*map(power_of_ten, exponents)]
    margin = (high / low) ** 0.02
    return _Scale(low / margin, high * margin, ticks, labels)


def _legend_entries(panel: Panel, width: float) -> list[tuple[str, Line]]:
    entries = [(curve.label, curve.style) for curve in panel.curves if curve.label]
    if panel.vertical is not None:
        entries.append((panel.vertical[1], INSTANT))
    return [(shorten(label, width - _HANDLE), style) for label, style in entries]


def _length(text: str) -> float:
    """Length of ``text`` in characters of mean width; superscripts are narrower."""
    narrow = sum(text.count(letter) for letter in "⁻⁰¹²³⁴⁵⁶⁷⁸⁹₀₁₂₃₄₅₆₇₈₉.,· ")
    return len(text) - 0.4 * narrow


def legend_columns(labels: Sequence[str], width: float) -> int:
    """Most columns in which a legend is no wider than ``width`` inches, but one at least.

    matplotlib fills column after column, the first ones with one entry more.
    """
    for columns in range(len(labels), 1, -1):
        short, longer = divmod(len(labels), columns)
        ends = [short * k + min(k, longer) for k in range(columns + 1)]
        widths = [
            max(map(_length, labels[start:end])) * _CHARACTER + _HANDLE
            for start, end in pairwise(ends)
        ]
        if sum(widths) + _COLUMN_GAP * (columns - 1) <= width:
            return columns
    return 1


def shorten(text: str, width: float) -> str:
    """Leave out the middle of ``text`` if it is wider than ``width`` inches."""
    room = max(5, int(width / _CHARACTER))
    if _length(text) <= width / _CHARACTER or len(text) <= room:
        return text
    tail = room // 2
    return f"{text[: room - tail - 1]}…{text[-tail:]}"


@dataclass(frozen=True)
class _Name:
    """Where the name of a vertical axis goes: beside it or, too long for that, above it."""

    beside: str
    size: float = TEXT  # of what is beside, in points
    above: str = ""


def _place_name(label: str, exponent: int, panel_height: float) -> _Name:
    head, bracket, tail = label.rpartition(" (")
    unit = bracket.strip() + tail if bracket else ""
    if exponent:
        power = power_of_ten(exponent)
        unit = f"({power} {unit[1:]}" if unit else f"({power})"
    name = head if bracket else label
    whole = f"{name} {unit}".strip()
    fits = TEXT * (panel_height + _GAP / 2) / (_length(whole) * _CHARACTER)
    if fits >= TEXT - 1:
        return _Name(whole, min(TEXT, fits))
    return _Name(unit or "value", TEXT, shorten(name, WIDTH - 2 * _EDGE))


def compose(panels: Sequence[Panel]) -> Figure:
    """Draw ``panels`` below each other over one axis, each below its own legend, if any.

    The horizontal axis is the first panel's. At most :data:`MAX_PANELS` are drawn; a line at the
    bottom says how many were left out.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    shown = panels[:MAX_PANELS]
    panel_height = SINGLE_HEIGHT if len(shown) == 1 else PANEL_HEIGHT
    most = 6 if len(shown) == 1 else 5
    scales = [_log_scale(p, most) if p.log else _linear_scale(p, most) for p in shown]
    longest = max(_length(label) for scale in scales for label in scale.labels or [""])
    left = _LEFT + max(0.0, longest - 4.0) * _CHARACTER
    inner = WIDTH - left - _RIGHT
    legends = [_legend_entries(p, inner) if p.legend else [] for p in shown]
    columns = [legend_columns([label for label, _ in e], inner) if e else 0 for e in legends]
    names = [
        _place_name(p.label, scale.exponent, panel_height)
        for p, scale in zip(shown, scales, strict=True)
    ]
    headers = [  # inches above each panel
        _LEGEND_ROW * ((math.ceil(len(e) / c) if c else 0) + bool(p.note) + bool(name.above))
        for p, e, c, name in zip(shown, legends, columns, names, strict=True)
    ]
    height = _EDGE + sum(headers) + len(shown) * (panel_height + _GAP) - _GAP + _BOTTOM
    across, axis = _horizontal_scale(shown, inner), shown[0].axis
    power = f"{power_of_ten(across.exponent)} " if across.exponent else ""

    with our_rc():
        figure = _figure_class()(figsize=(WIDTH, height), dpi=DPI)
        FigureCanvasAgg(figure)
        top = height - _EDGE
        for number, (panel, scale, name) in enumerate(zip(shown, scales, names, strict=True)):
            if name.above:
                figure.text(_EDGE / WIDTH, top / height, name.above, va="top")
            top -= headers[number]
            last = number == len(shown) - 1
            box = (
                left / WIDTH,
                (top - panel_height) / height,
                inner / WIDTH,
                panel_height / height,
            )
            axes = figure.add_axes(box)
            _set_scales(axes, across, scale, log=(axis.log, panel.log))
            _draw_curves(axes, panel)
            if last:
                axes.set_xticks(across.ticks, across.labels)
            else:
                _mark_ticks(axes, across.ticks)
            axes.set_yticks(scale.ticks, scale.labels)
            axes.set_ylabel(name.beside, fontsize=name.size, va="center")
            axes.yaxis.set_label_coords((_LABEL - left) / inner, 0.5)
            if last:
                axes.set_xlabel(with_unit(axis.label, f"{power}{axis.unit}".strip()))
                axes.xaxis.set_label_coords(0.5, -0.21 / panel_height)
            if legends[number]:
                _draw_legend(axes, legends[number], columns[number], panel.note, panel_height)
            top -= panel_height + _GAP
        if len(panels) > len(shown):
            note = f"{len(shown)} of {len(panels)} shown"
            figure.text(0.02, 0.03 / height, note, size=TEXT - 1, va="bottom")
    return figure


@cache
def _figure_class() -> type[Figure]:
    """matplotlib's figure, which in addition shows itself in a notebook, without pyplot."""
    from matplotlib import figure

    class Drawing(figure.Figure):
        """A figure with its picture."""

        def _repr_png_(self) -> bytes:
            stream = BytesIO()
            with our_rc():
                self.savefig(stream, format="png", pil_kwargs={"optimize": True})
            return stream.getvalue()

    return Drawing


def save(figure: Figure, path: Path) -> None:
    """Write ``figure`` in the format of the path's suffix, complete or not at all.

    A PNG has ``WIDTH * DPI`` pixels across. No format records when it was written.

    Args:
        figure: what :func:`compose` returned.
        path: ends with one of :data:`gpebo_cli.results.names.FORMATS`.

    Raises:
        GpeboError: the file cannot be written.
    """
    buffer = BytesIO()
    with our_rc():
        if path.suffix == ".png":
            from matplotlib.backends.backend_agg import FigureCanvasAgg

            # Level 1: flat drawings gain nothing from more, and level 6 takes twice the time.
            FigureCanvasAgg(figure).print_png(  # type: ignore[no-untyped-call]
            buffer, pil_kwargs={"compress_level": 1}
        )
        else:
            date = {".pdf": "CreationDate", ".svg": "Date"}[path.suffix]
            figure.savefig(buffer, format=path.suffix[1:], metadata={date: None})
    write_file(path, [buffer.getvalue()])


def _artist(x: Array, y: Array, style: Line) -> Line2D:
    from matplotlib.lines import Line2D

    dashes = (0, style.dashes) if style.dashes else "-"
    cap = {"dash_capstyle": "butt", "solid_capstyle": "butt", "solid_joinstyle": "round"}
    artist = Line2D(x, y, color=style.color, linestyle=dashes, linewidth=style.width, **cap)  # type: ignore[arg-type]
    if style.dots:
        artist.set(marker="o", markersize=2.4)
    return artist


def _set_scales(axes: Axes, across: _Scale, up: _Scale, log: tuple[bool, bool]) -> None:
    from matplotlib.ticker import NullLocator

    if log[0]:
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(NullLocator())
    if log[1]:
        axes.set_yscale("log")
        axes.yaxis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(across.low, across.high)
    axes.set_ylim(up.low, up.high)


def _draw_curves(axes: Axes, panel: Panel) -> None:
    visible = False
    for curve in panel.curves:
        values = drawn(panel, curve)
        visible = visible or not np.isnan(values).all()
        axes.add_line(_artist(curve.x, values, curve.style))
    if not visible:
        finite = any(np.isfinite(curve.y).any() for curve in panel.curves)
        said = "zero throughout" if finite else "no finite values"
        axes.text(0.5, 0.5, said, transform=axes.transAxes, ha="center", va="center")
    if panel.vertical is not None:
        mark = INSTANT
        axes.axvline(panel.vertical[0], color=mark.color, linewidth=mark.width)


def _mark_ticks(axes: Axes, ticks: Sequence[float]) -> None:
    """Mark ``ticks`` on a horizontal axis without labels: one artist instead of five per tick."""
    marks = _artist(np.asarray(ticks), np.zeros(len(ticks)), Line(RC["axes.edgecolor"]))
    # Marker 3 is matplotlib's TICKDOWN.
    marks.set(linestyle="none", marker=3, markersize=RC["xtick.major.size"])
    marks.set(markeredgewidth=RC["xtick.major.width"], clip_on=False)
    marks.set_transform(axes.get_xaxis_transform())
    axes.add_artist(marks)
    axes.set_xticks([])


def _draw_legend(
    axes: Axes, entries: Sequence[tuple[str, Line]], columns: int, note: str, panel_height: float
) -> None:
    nothing = np.zeros(0)
    axes.legend(
        handles=[_artist(nothing, nothing, style) for _, style in entries],
        labels=[label for label, _ in entries],
        title=note or None,
        alignment="left",
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0 + 0.025 / panel_height),
        ncols=columns,
        frameon=False,
        borderpad=0.0,
        borderaxespad=0.0,
        labelspacing=0.25,
        handlelength=2.4,
        handletextpad=0.5,
        columnspacing=1.2,
    )
