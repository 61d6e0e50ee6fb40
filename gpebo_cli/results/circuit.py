"""Fig. 1 of the paper (arXiv:2407.14373): the circuit, drawn from a netlist with schemdraw.

The paper takes the circuit from Bobinyec and prints its equations; the directions of the currents
below are those that make Kirchhoff's laws give the printed E(t) and A(t), signs included. A test
compares the two.
"""

from __future__ import annotations

from importlib import import_module, util
from typing import TYPE_CHECKING, Any, NamedTuple

from gpebo_cli.results.files import csv_text
from gpebo_cli.results.style import TEXT, WIDTH, new_figure, our_rc
from gpebo_cli.results.symbols import typeset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GROUND = "0"

_Point = tuple[float, float]


class Branch(NamedTuple):
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
    return csv_text([("element", "from", "to", "current"), *BRANCHES])


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
            start, end = _ends(branch)
            if branch.element == "V":  # schemdraw's + stands at the end, this one's at ground
                start, end = end, start
            shape = shapes[branch.element[0]]().endpoints(start, end)
            side = "top" if start[1] > end[1] else "bottom"  # left of an upright element
            drawing.add(shape.label(typeset(branch.element, {}), loc=side))
            if branch.current:
                arrow = elements.CurrentLabel(
                    ofst=0.2, length=0.84, top=side == "top", reverse=branch.element == "V"
                )
                drawing.add(arrow.at(shape).label(rf"$i_{{{branch.element}}}$", ofst=0.1))
        _add_wires(drawing, elements)
        drawing.draw(show=False)
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


def _add_wires(drawing: Any, elements: Any) -> None:
    """The rails, dots where more than two wires meet, and ground."""
    for first, last, height in (("V", "C1", _TOP), ("C2", "L", _TOP), ("V", "L", 0.0)):
        drawing.add(elements.Line().at((_AT[first], height)).to((_AT[last], height)))
    for element, node in (("R2", ""), ("C1", "$e_1$"), ("C2", "$e_2$")):
        drawing.add(elements.Dot(radius=0.09).at((_AT[element], _TOP)).label(node, loc="top"))
        drawing.add(elements.Dot(radius=0.09).at((_AT[element], 0.0)))
    drawing.add(elements.Ground().at(((_AT["C1"] + _AT["C2"]) / 2, 0.0)))
