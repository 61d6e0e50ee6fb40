"""Modified nodal analysis: from a netlist to a descriptor system, and what its graph says of it.

Unknowns are the node voltages and the currents of elements that are defined by their voltage.
Charges and fluxes are conserved: i = (C v)' = C v' + C' v and v = (L i)' = L i' + L' i.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterable, Sequence
from itertools import chain, count
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.importers.draft import Entry, PlantDraft
from gpebo_cli.importers.netlist import GROUND, Element, Netlist, read_netlist, split_names
from gpebo_cli.model.expressions.syntax import RESERVED
from gpebo_cli.model.expressions.tape import record
from gpebo_cli.model.plant import read_parameters
from gpebo_cli.schema import nearest, shown

_NO_NAMES = {*RESERVED, *keyword.kwlist}
_WITH_CURRENT = "LVEHT"  # kinds whose current is an unknown
_QUANTITY = re.compile(r"([vi])\(([^,]+?)(?:,([^,]+))?\)", re.IGNORECASE)
_ORDER = "CLKRSVEHTIGF"  # of the kinds in a plant: what is differentiated first, what drives last
_TERM = re.compile(
    r"([+-]?)(?:((?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\*)?"
    r"([vi]\((?:[^()]|\([^()]*\))+\))", re.IGNORECASE
)


def circuit_from_netlist(
    text: str, name: str, file: str = "netlist", measure: str | Iterable[str] | None = None,
    unknown: str | Iterable[str] | None = None,
) -> PlantDraft:
    """The descriptor system of a netlist, see ``from_netlist``."""
    netlist = read_netlist(text, file)
    topology = examine(netlist, file)
    measured = split_names(measure)
    builder = _Builder(netlist, name, file, measured)
    draft = builder.build()
    for output in measured or [q for q in netlist.saved if q.startswith("v(")]:
        builder.output(output)
    draft.make_unknown(builder.called.get(word.lower(), word) for word in split_names(unknown))
    draft.comments.append(topology)
    return draft


def examine(netlist: Netlist, file: str) -> str:
    """What the graph says of the index (Estévez Schwarz and Tischendorf, 2000), in words.

    It is 2 where there is a loop or a cutset, else at most 1; with controlled sources, couplings or
    transformers that is a bound no more (ConfigError: a floating node, a loop or a cutset of
    independent sources alone).
    """
    from scipy.cluster.hierarchy import DisjointSet  # a third of a second to import

    branches = [e for e in netlist.elements.values() if e.kind != "K"]
    nodes = {node for e in branches for node in e.nodes}
    if GROUND not in nodes:
        raise ConfigError(f"{file}: no element is connected to ground, which is the node 0")

    def joined(without: str) -> Any:
        """Nodes that are connected by elements of other kinds than ``without``."""
        sets = DisjointSet(nodes)
        for e in branches:
            if e.kind not in without:
                sets.merge(*e.nodes[:2])
                if e.kind == "T":  # both sides of a transformer carry a current
                    sets.merge(*e.nodes[2:])
        return sets

    connected = joined("")
    floating = sorted(node for node in nodes if not connected.connected(node, GROUND))
    if floating:
        raise ConfigError(
            f"{file}: no path leads from node {floating[0]} to ground; connect it, through a large "
            "resistor for instance"
        )
    # What is controlled may still be determined by what controls it: the plant's analysis decides.
    fixed = DisjointSet(nodes)  # by sources alone: their loops have no unique current
    for e in branches:
        if e.kind == "V" and not fixed.merge(*e.nodes):
            raise e.place.error(
                f"{e.name} closes a loop of voltage sources, or is shorted; its current would be "
                "anything"
            )
    carried = joined("I")
    for e in branches:
        if e.kind == "I" and not carried.connected(*e.nodes):
            raise e.place.error(
                f"{e.name} drives a current that can flow back through current sources only; its "
                "voltage would be anything"
            )
    cutsets = _cutsets(branches, joined("LIGF").subsets())
    found = [f"loop of capacitors and voltage sources: {', '.join(x)}" for x in _loops(branches)]
    found += [f"cutset of inductors and current sources: {', '.join(x)}" for x in cutsets]
    why = "; ".join(found) or (
        "no loop of capacitors with voltage sources, no cutset of inductors and current sources"
    )
    if not all(e.kind in "RLCVIS" for e in netlist.elements.values()):
        why += "; controlled sources and couplings may change it"
    return f"index {2 if found else 1} by topology ({why})"


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A key by which n2 comes before n10."""
    parts = re.findall(r"\d+|\D+", name.lower())
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def _loops(branches: Sequence[Element]) -> Iterable[tuple[str, ...]]:
    """One loop of capacitors and sources for every voltage source that is in one."""
    inside = [e for e in branches if e.kind in "CVEH"]
    for source in (e for e in inside if e.kind != "C"):
        path = _path([e for e in inside if e is not source], *source.nodes[:2])
        if path is not None:
            yield (source.name, *path)


def _path(branches: Sequence[Element], start: str, stop: str) -> list[str] | None:
    """Names of elements on a shortest path, or None."""
    near: dict[str, list[tuple[str, str]]] = {}
    for e in branches:
        a, b = e.nodes[:2]
        near.setdefault(a, []).append((b, e.name))
        near.setdefault(b, []).append((a, e.name))
    reached: dict[str, list[str]] = {start: []}
    queue = [start]
    for node in queue:  # it grows meanwhile
        for other, name in near.get(node, []):
            if other not in reached:
                reached[other] = [*reached[node], name]
                queue.append(other)
    return reached.get(stop)


def _cutsets(
    branches: Sequence[Element], parts: Iterable[set[str]]
) -> Iterable[tuple[str, ...]]:
    """Inductors and current sources around each part that nothing else connects to ground."""
    crossing = [e for e in branches if e.kind in "LIGF"]
    for part in sorted(parts, key=min):
        if GROUND not in part:
            yield tuple(e.name for e in crossing if (e.nodes[0] in part) != (e.nodes[1] in part))


class _Builder:
    """Stamps of the elements, row by row."""

    def __init__(self, netlist: Netlist, name: str, file: str, measured: Sequence[str]) -> None:
        self.file, self.netlist = file, netlist
        # The plant does not depend on the order of the lines, nor do roundings of its solution.
        self.elements = dict(sorted(
            netlist.elements.items(), key=lambda e: (_ORDER.index(e[1].kind), _natural(e[0]))
        ))
        self.draft = PlantDraft(name, title=netlist.title or f"circuit {name}", reference=file)
        self.draft.comments.append(f"Modified nodal analysis of {file}.")
        self._taken: set[str] = set()
        self.called: dict[str, str] = {}  # parameter or input of an element, by lower-case name
        self._node: dict[str, str] = {}  # state of a node's voltage
        self._row: dict[str, int] = {}  # of a node's balance of currents
        self._current: dict[str, str] = {}  # state of an element's current, by lower-case name
        self._wanted = {
            match[2].lower()
            for quantity in (*netlist.saved, *netlist.initial, *measured)
            for match in _QUANTITY.finditer(quantity)
            if match[1].lower() == "i"
        }

    def build(self) -> PlantDraft:
        """The draft without outputs (ConfigError: .ic names no state)."""
        draft = self.draft
        for key, value in self.netlist.parameters.items():
            draft.parameters[self._claim(key, key)] = value
        nodes = {node for e in self.elements.values() for node in e.nodes} - {GROUND}
        for node in sorted(nodes, key=_natural):
            word = re.sub(r"\W", "_", node, flags=re.ASCII)
            plain = word == node and not word[0].isdigit() and word not in _NO_NAMES
            label = self._claim(word if plain else f"v{word}", f"v_{word}")
            self._node[node] = label
            self._row[node] = draft.equation(f"currents at node {node}")
            draft.states[label] = (self.netlist.initial.get(f"v({node})", 0.0), "V")
        for name, e in self.elements.items():
            if e.kind in _WITH_CURRENT or (e.kind in "RS" and name in self._wanted):
                label = self._current[name] = self._claim(f"i{name}", f"i_{e.name}")
                start = e.initial if e.kind == "L" else None
                given = self.netlist.initial.get(f"i({name})", 0.0)
                draft.states[label] = (given if start is None else start, "A")
        known = [f"v({node})" for node in self._node] + [f"i({name})" for name in self._current]
        for quantity in self.netlist.initial:
            if quantity not in known:
                raise ConfigError(
                    f"{self.file}: .ic {quantity} is neither the voltage of a node nor a current "
                    "that is a state" + nearest(quantity, known)
                )
        for e in self.elements.values():
            getattr(self, f"_stamp_{e.kind}")(e)
        self._start_of_capacitors()
        self._start_of_resistors()
        return draft

    def output(self, text: str) -> None:
        """Add an output, ``v(a)``, ``v(a,b)``, ``i(R1)`` or a sum, named or not (ConfigError)."""
        *label, body = text.split("=", 1)
        body = body.replace(" ", "")
        terms = list(_TERM.finditer(body))
        if not terms or "".join(match[0] for match in terms) != body:
            raise ConfigError(
                f"{self.file}: cannot measure {shown(text)}; write v(node), v(a,b), i(element) or "
                "a sum such as y=i(L1)+2*v(out)"
            )
        row = len(self.draft.outputs)
        parts = [
            (column, sign * float(match[2] or 1.0) * (-1.0 if match[1] == "-" else 1.0))
            for match in terms for column, sign in self._quantity(match[3])
        ]
        if not parts:
            raise ConfigError(f"{self.file}: cannot measure {shown(text)}: ground has no voltage")
        units = {"V" if match[3][0].lower() == "v" else "A" for match in terms}
        name = "".join(label).strip() or ("y" if len(terms) > 1 else f"y_{parts[0][0]}")
        self.draft.outputs[self._claim(name, f"{name}_")] = units.pop() if len(units) == 1 else ""
        for column, factor in parts:
            self.draft.add("C", row, column, factor)

    def _quantity(self, text: str) -> list[tuple[str, float]]:
        """States that make up a quantity, with their signs."""
        match = _QUANTITY.fullmatch(text)
        if match is None:
            raise ConfigError(f"{self.file}: {shown(text)} is neither v(node) nor i(element)")
        if match[1].lower() == "i":
            name = match[2].lower()
            if name not in self.elements:
                raise ConfigError(
                    f"{self.file}: i({match[2]}): there is no element {match[2]}"
                    + nearest(name, self.elements)
                )
            if name not in self._current:
                raise ConfigError(
                    f"{self.file}: i({match[2]}): there is an element whose current is not an "
                    "unknown; measure that of a resistor, inductor or source"
                )
            return [(self._current[name], 1.0)]
        ends = [(match[2], 1.0), (match[3] or GROUND, -1.0)]
        ends = [(node, sign) for node, sign in ends if node.lower() not in (GROUND, "gnd")]
        for node, _ in ends:
            if node.lower() not in self._node:
                raise ConfigError(
                    f"{self.file}: there is no node {node}" + nearest(node.lower(), self._node)
                )
        return [(self._node[node.lower()], sign) for node, sign in ends]

    def _claim(self, name: str, otherwise: str) -> str:
        """A name nobody has yet; names differ in more than case, for the reader's sake."""
        others = chain((name, otherwise), (f"{otherwise}_{k}" for k in count(2)))
        free = next(each for each in others if each not in self._taken and each not in _NO_NAMES)
        self._taken.add(free)
        return free

    def _value(self, e: Element) -> str:
        """A parameter that stands for the element's value."""
        name = self.called[e.name.lower()] = self._claim(e.name, f"{e.name}_")
        self.draft.parameters[name] = e.value
        return name

    def _varies(self, value: Entry) -> bool:
        """Whether a value depends on time, by itself or by way of parameters."""
        words = set(re.findall(r"\b[A-Za-z_]\w*", str(value)))
        known = self.draft.parameters
        return "t" in words or any(self._varies(known[w]) for w in words & known.keys())

    def _between(self, matrix: str, row: int | None, a: str, b: str, text: str) -> None:
        """Add text · (v_a − v_b) to a row."""
        for node, sign in ((a, ""), (b, "-")):
            if node != GROUND and row is not None:
                self.draft.add(matrix, row, self._node[node], sign + text)

    def _admittance(
        self, matrix: str, ends: Sequence[str], text: str, across: Sequence[str]
    ) -> None:
        """text · (v_c − v_d) in the balance of a, its negative in that of b, across c and d."""
        (a, b), (c, d) = ends[:2], across
        self._between(matrix, self._row.get(a), c, d, text)
        self._between(matrix, self._row.get(b), d, c, text)

    def _branch(
        self, nodes: Sequence[str], column: str, factor: str = "", matrix: str = "A"
    ) -> None:
        """A current that leaves its first node and enters its second."""
        for node, sign in zip(nodes, ("-", ""), strict=False):
            if node != GROUND:
                term = f"{sign}{factor}" if factor else float(f"{sign}1")
                self.draft.add(matrix, self._row[node], column, term)

    def _stamp_R(self, e: Element) -> None:
        name = self._value(e)
        if e.name.lower() not in self._current:
            self._admittance("A", e.nodes, f"1/{name}", e.nodes[::-1])
            return
        row, column = self._voltage_row(e, "Ohm's law")
        self.draft.add("A", row, column, f"-{name}")

    _stamp_S = _stamp_R

    def _stamp_C(self, e: Element) -> None:
        name = self._value(e)
        self._admittance("E", e.nodes, name, e.nodes)
        if self._varies(e.value):
            self._admittance("A", e.nodes, f"d({name})", e.nodes[::-1])

    def _stamp_L(self, e: Element) -> None:
        row, column = self._voltage_row(e, "voltage is the change of flux")
        self._row[f"coil {e.name.lower()}"] = row
        self._change_of_flux(row, column, self._value(e))

    def _change_of_flux(self, row: int, column: str, name: str) -> None:
        """(L i)' = L i' + L' i of an inductance."""
        self.draft.add("E", row, column, name)
        if self._varies(self.draft.parameters[name]):
            self.draft.add("A", row, column, f"-d({name})")

    def _stamp_K(self, e: Element) -> None:
        for name in e.controls:
            if name not in self.elements or self.elements[name].kind != "L":
                raise e.place.error(f"{e.name} couples {name}, which is no inductor")
        value, (first, second) = self._value(e), e.controls
        mutual = self._claim(f"M_{e.name}", f"M_{e.name}_")
        own, other = self.called[first], self.called[second]
        self.draft.parameters[mutual] = f"{value}*sqrt({own}*{other})"
        for coil, by in ((first, second), (second, first)):
            self._change_of_flux(self._row[f"coil {coil}"], self._current[by], mutual)

    def _stamp_V(self, e: Element) -> None:
        row, _ = self._voltage_row(e, "voltage of the source")
        self.draft.add("B", row, self._input(e, "V"), -1.0)

    def _stamp_I(self, e: Element) -> None:
        self._branch(e.nodes, self._input(e, "A"), matrix="B")

    def _stamp_E(self, e: Element) -> None:
        row, _ = self._voltage_row(e, "controlled voltage")
        self._between("A", row, e.nodes[3], e.nodes[2], self._value(e))

    def _stamp_H(self, e: Element) -> None:
        row, _ = self._voltage_row(e, "voltage controlled by a current")
        self.draft.add("A", row, self._controlling(e), f"-{self._value(e)}")

    def _stamp_G(self, e: Element) -> None:
        self._admittance("A", e.nodes, self._value(e), (e.nodes[3], e.nodes[2]))

    def _stamp_F(self, e: Element) -> None:
        self._branch(e.nodes, self._controlling(e), self._value(e))

    def _stamp_T(self, e: Element) -> None:
        row, column = self._voltage_row(e, "ideal transformer, v_1 = n v_2")
        name, back = self._value(e), (e.nodes[3], e.nodes[2])
        self._between("A", row, *back, name)
        self._branch(back, column, name)

    def _voltage_row(self, e: Element, says: str) -> tuple[int, str]:
        """A row that begins with v_a − v_b, and its current."""
        row, column = self.draft.equation(f"{e.name}: {says}"), self._current[e.name.lower()]
        for node, sign in zip(e.nodes, (1.0, -1.0), strict=False):
            if node != GROUND and e.nodes[0] != e.nodes[1]:
                self.draft.add("A", row, self._node[node], sign)
        self._branch(e.nodes, column)
        return row, column

    def _input(self, e: Element, unit: str) -> str:
        name = self.called[e.name.lower()] = self._claim(e.name, f"{e.name}_source")
        self.draft.inputs[name] = (e.value, unit)
        return name

    def _controlling(self, e: Element) -> str:
        column = self._current.get(e.controls[0])
        if column is None:
            raise e.place.error(
                f"{e.name} is controlled by the current of {e.controls[0]}, which has to be a "
                "voltage source or an inductor"
            )
        return column

    def _start_of_capacitors(self) -> None:
        """Node voltages from ``ic=`` of capacitors: those at ground first, then along chains.

        Of a chain that is not at ground one end starts at 0: what counts is the difference.
        """
        voltages = {node: self.netlist.initial.get(f"v({node})") for node in self._node}
        known = {node: v for node, v in voltages.items() if v is not None}
        given = [(e.nodes, e.initial) for e in self.elements.values()
                 if e.kind == "C" and e.initial is not None]
        for start in (GROUND, *(nodes[1] for nodes, _ in given)):
            before = len(known)
            known.setdefault(start, 0.0)
            while len(known) > before:
                before = len(known)
                for (a, b), across in given:
                    if b in known:
                        known.setdefault(a, known[b] + across)
                    elif a in known:
                        known[b] = known[a] - across
        for node, label in self._node.items():
            if node in known:
                self.draft.states[label] = (known[node], "V")

    def _start_of_resistors(self) -> None:
        """Currents of resistors that nothing is said of, from the voltages that they start with."""
        states, parameters = self.draft.states, self.draft.parameters
        found = [
            e for e in self.elements.values() if e.kind in "RS" and e.name.lower() in self._current
            and f"i({e.name.lower()})" not in self.netlist.initial
        ]
        if not found:
            return
        known = read_parameters(f"circuit {self.draft.name}", parameters, {}, {})
        tape = record([known[self.called[e.name.lower()]] for e in found])
        for e, value in zip(found, tape.taylor(np.zeros(1), 0)[0, 0], strict=True):
            first, second = (
                float(states[self._node[node]][0]) if node != GROUND else 0.0 for node in e.nodes
            )
            if value and np.isfinite(value):
                current = (first - second) / float(value)
                states[self._current[e.name.lower()]] = (current + 0.0, "A")  # no minus zero
