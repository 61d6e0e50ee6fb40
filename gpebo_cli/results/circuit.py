"""Fig. 1 of the paper (arXiv:2407.14373): the circuit, drawn from a netlist with schemdraw.

The paper takes the circuit from Bobinyec and prints its equations; the directions of the currents
below are those that make Kirchhoff's laws give the printed E(t) and A(t), signs included. A test
compares the two.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module, util
from typing import TYPE_CHECKING, Any

from gpebo_cli.results.files import csv_text
from gpebo_cli.results.style import TEXT, WIDTH, new_figure, our_rc
from gpebo_cli.results.symbols import typeset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GROUND = "0"

_Point = tuple[float, float]


@dataclass(frozen=True)
class Branch:
    """An element; its ``current`` (a state, or empty if it is none) flows from start to end."""

    element: str
    start: str
    end: str
    current: str = ""


BRANCHES = (
    Branch("V", GROUND, "e1", "iv"),  # e1 = −V: the positive pole is grounded
    Branch("C1", "e1", GROUND),
    Branch("R2", "e1", GROUND, "ir2"),  # e1 = R2 ir2
    Branch("R1", "e2", "e1", "ir1"),  # e2 − e1 = −R1 ir1
    Branch("C2", "e2", GROUND),
    Branch("L", "e2", GROUND, "il"),  # (L il)' = e2
)

# In units of the drawing, of which _ACROSS fill one column; elements are 3 long.
_AT = {"V": 0.0, "R2": 2.6, "C1": 5.2, "C2": 8.2, "L": 10.4}
_TOP, _ACROSS, _LEFT, _LOW, _HIGH = 3.0, 12.8, -1.1, -0.95, 4.2
_LINE = 0.9  # points


def available() -> bool:
    """Whether schemdraw is installed (``pip install 'gpebo[figures]'``)."""
    return util.find_spec("schemdraw") is not None


def netlist() -> str:
    """What is drawn, as CSV: element, nodes it connects, and the current between them."""
    head = ("element", "from", "to", "current")
    return csv_text([head, *((b.element, b.start, b.end, b.current) for b in BRANCHES)])


def circuit() -> Figure:
    """Draw the circuit, one column wide."""
    # Untyped, and an extra: nothing else needs it.
    schemdraw: Any = import_module("schemdraw")
    elements: Any = import_module("schemdraw.elements")
    with our_rc():
        figure = new_figure(WIDTH, WIDTH * (_HIGH - _LOW) / _ACROSS)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        drawing = schemdraw.Drawing(canvas=axes)
        drawing.config(unit=_TOP, fontsize=TEXT, lw=_LINE, font="DejaVu Sans")
        shapes = {
            "V": elements.SourceV,
            "R": elements.Resistor,
            "C": elements.Capacitor,
            "L": elements.Inductor,
        }
        for branch in BRANCHES:
            shape = shapes[branch.element[0]]
            start, end = _ends(branch)
            if branch.element == "V":  # schemdraw's + stands at the end, this one's at ground
                start, end = end, start
            drawing.add(shape().endpoints(start, end))
            if branch.current:
                tail, head, _ = _arrow(branch)
                drawing.add(elements.Arrow(headwidth=0.18, headlength=0.25).at(tail).to(head))
        _add_wires(drawing, elements)
        drawing.draw(show=False)
        for text, (x, y), side in _texts():
            axes.text(x, y, text, ha=side, va="center_baseline", fontsize=TEXT)
        axes.set_aspect("equal")
        axes.set_xlim(_LEFT, _LEFT + _ACROSS)
        axes.set_ylim(_LOW, _HIGH)
    return figure


def _ends(branch: Branch) -> tuple[_Point, _Point]:
    places = {
        GROUND: (_AT.get(branch.element, 0.0), 0.0),
        "e1": (_AT.get(branch.element, _AT["C1"]), _TOP),
        "e2": (_AT.get(branch.element, _AT["C2"]), _TOP),
    }
    return places[branch.start], places[branch.end]


def _arrow(branch: Branch) -> tuple[_Point, _Point, _Point]:
    """Tail and head of the arrow beside a branch, and where its name goes."""
    (x0, y0), (x1, y1) = _ends(branch)
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    if x0 == x1:
        half = 0.42 if y1 > y0 else -0.42
        x += 0.85 if branch.element == "V" else 0.6
        return (x, y - half), (x, y + half), (x + 0.18, y)
    half = 0.42 if x1 > x0 else -0.42
    return (x - half, y + 0.5), (x + half, y + 0.5), (x, y + 0.85)


def _texts() -> Iterator[tuple[str, _Point, str]]:
    """Names of elements, currents and nodes, where they stand and how they are aligned."""
    for branch in BRANCHES:
        (x0, y0), (x1, y1) = _ends(branch)
        name = typeset(branch.element, {})
        if x0 == x1:
            gap = 0.66 if branch.element == "V" else 0.55
            yield name, (x0 - gap, (y0 + y1) / 2), "right"
        else:
            yield name, ((x0 + x1) / 2, y0 - 0.62), "center"
        if branch.current:
            current = rf"$i_{{{branch.element}}}$"
            yield current, _arrow(branch)[2], "left" if x0 == x1 else "center"
    yield "$e_1$", (_AT["C1"], _TOP + 0.45), "center"
    yield "$e_2$", (_AT["C2"], _TOP + 0.45), "center"


def _add_wires(drawing: Any, elements: Any) -> None:
    """The rails, dots where more than two wires meet, and ground."""
    drawing.add(elements.Line().at((_AT["V"], _TOP)).to((_AT["C1"], _TOP)))
    drawing.add(elements.Line().at((_AT["C2"], _TOP)).to((_AT["L"], _TOP)))
    drawing.add(elements.Line().at((_AT["V"], 0.0)).to((_AT["L"], 0.0)))
    for x in (_AT["R2"], _AT["C1"], _AT["C2"]):
        drawing.add(elements.Dot(radius=0.09).at((x, _TOP)))
        drawing.add(elements.Dot(radius=0.09).at((x, 0.0)))
    drawing.add(elements.Ground().at(((_AT["C1"] + _AT["C2"]) / 2, 0.0)))
