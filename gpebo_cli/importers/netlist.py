"""SPICE netlists as data: lines of text to elements with nodes, values and places.

What is read: R L C K V I E G F H, switches S with given instants, ideal transformers T with a
ratio, subcircuits, ``.param``, ``.ic``, ``.save``, ``.probe``. Values are numbers with SPICE's
suffixes, or expressions of ``time`` in braces, in the language of plant files. Nothing is
executed and no other file is read. As in SPICE the first line is a title, names do not depend on
case, and node 0 (or gnd) is ground.
"""

from __future__ import annotations

import itertools
import keyword
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.expressions.syntax import RESERVED
from gpebo_cli.schema import nearest, shown

GROUND = "0"
MAX_LINES = 20_000
MAX_ELEMENTS = 5_000  # with those of subcircuits
MAX_DEPTH = 20  # of subcircuits in subcircuits
_GROUP = 100  # terms of a sum

NODES = {"R": 2, "L": 2, "C": 2, "V": 2, "I": 2, "E": 4, "G": 4, "F": 2, "H": 2, "S": 2, "T": 4}
"""Kinds of elements with the number of their nodes; K couples two inductors and has none."""

_NUMBER = re.compile(
    r"([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)"
    r"(meg|mil|[tgxkmu\u00b5\u03bcnpf]?)[a-z]*", re.IGNORECASE
)
_SUFFIXES = {
    "t": 1e12, "g": 1e9, "meg": 1e6, "x": 1e6, "k": 1e3, "mil": 25.4e-6, "m": 1e-3, "u": 1e-6,
    "\u00b5": 1e-6, "\u03bc": 1e-6, "n": 1e-9, "p": 1e-12, "f": 1e-15,
}
_WORD = re.compile(r"[A-Za-z_]\w*")
_IN_EXPRESSION = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\w*)|(?P<word>[A-Za-z_]\w*)"
)
_REFUSED = {
    ".global": "is not read; give each subcircuit a node of its own for it, and hand it on",
    **dict.fromkeys((".include", ".inc", ".lib"), "would read another file, and a netlist is read "
                    "alone; put its lines here"),
    **dict.fromkeys((".model", ".func"), "is not read: elements are linear, "
                    "R L C K V I E G F H S T X, and expressions stand in braces"),
}


@dataclass(frozen=True)
class Place:
    """Where something stands in a file, for messages."""

    file: str
    line: int

    def error(self, what: str) -> ConfigError:
        """What is wrong there, as one line."""
        return ConfigError(f"{self.file}, line {self.line}: {what}")


@dataclass(frozen=True)
class Element:
    """One element; ``value`` is a number or an expression in ``t`` and in parameters."""

    kind: str
    name: str  # as written; of a subcircuit's element the instances and the name, with _
    nodes: tuple[str, ...]
    value: float | str
    place: Place
    controls: tuple[str, ...] = ()  # names of the elements it is controlled by or couples
    initial: float | None = None


@dataclass
class _Block:
    """Lines between .subckt and .ends, or those outside."""

    name: str = ""
    ports: tuple[str, ...] = ()
    defaults: dict[str, str] = field(default_factory=dict)
    lines: list[tuple[Place, str]] = field(default_factory=list)


class _Scope(NamedTuple):
    """What names mean in a line of a block."""

    nodes: Mapping[str, str]  # what its ports are called outside
    known: Mapping[str, str]  # parameters by lower-case name, with what they are in the plant
    prefix: str = ""  # of names inside, ``x1_``
    depth: int = 0  # of nesting
    place: Place = Place("", 0)  # of the line

    def node(self, word: str) -> str:
        """A node as the plant has it."""
        node = _node(word)
        return node if node == GROUND else self.nodes.get(node, self.prefix + node)

    def quantity(self, text: str) -> str:
        """``v(node)`` or ``i(element)`` as the plant has them, anything else as it stands."""
        match = re.fullmatch(r"([vi])\(([^,]+)\)", text.replace(" ", ""))
        if match is None:
            return text
        name = self.node(match[2]) if match[1] == "v" else self.prefix + match[2]
        return f"{match[1]}({name})"


def read_netlist(text: str, file: str = "netlist") -> Netlist:
    """Read a netlist, whose first line is the title; a ConfigError names line and element."""
    title, lines = _logical_lines(text, file)
    outside, blocks = _blocks(lines)
    netlist = Netlist(title, blocks)
    netlist.expand(outside, _Scope({}, {}))
    if not netlist.elements:
        raise ConfigError(f"{file}: there is no element in it (the first line is a title)")
    return netlist


def number(text: str) -> float | None:
    """A number with a SPICE suffix (4.7k, 10uF, 1meg), or None."""
    match = _NUMBER.fullmatch(text)
    return None if match is None else float(match[1]) * _SUFFIXES.get(match[2].lower(), 1.0)


def _logical_lines(text: str, file: str) -> tuple[str, list[tuple[Place, str]]]:
    """The title, and lines without comments, with those that ``+`` continues."""
    raw = text.splitlines()
    if len(raw) > MAX_LINES:
        raise ConfigError(f"{file} has {len(raw)} lines; at most {MAX_LINES} are read")
    lines: list[tuple[Place, str]] = []
    for k, line in enumerate(raw[1:], start=2):
        content = re.split(r";|\$ |//", line)[0].strip()
        if not content or content.startswith("*"):
            continue
        if content.startswith("+"):
            if not lines:
                raise Place(file, k).error("there is no line that + continues")
            place, before = lines[-1]
            lines[-1] = (place, f"{before} {content[1:]}")
        else:
            lines.append((Place(file, k), content))
    return (raw[0].strip().lstrip("*").strip() if raw else ""), lines


def _blocks(lines: list[tuple[Place, str]]) -> tuple[_Block, dict[str, _Block]]:
    outside, blocks, current = _Block(), {}, None
    for place, line in lines:
        words = line.split()
        head = words[0].lower()
        if head == ".subckt":
            if current is not None:
                raise place.error(f".subckt inside .subckt {current.name}; close that with .ends")
            if len(words) < 3:
                raise place.error(".subckt needs a name and nodes, as in .subckt filter in out")
            plain, options = _options(" ".join(words[2:]), place)
            current = _Block(words[1], tuple(map(_node, plain)), options)
            blocks[words[1].lower()] = current
        elif head == ".ends":
            if current is None:
                raise place.error(".ends without .subckt")
            current = None
        elif head == ".end":
            break
        else:
            (outside if current is None else current).lines.append((place, line))
    if current is not None:
        raise ConfigError(f"{lines[-1][0].file}: .subckt {current.name} has no .ends")
    return outside, blocks


def _node(word: str) -> str:
    lower = word.lower()
    return GROUND if lower in ("0", "gnd") else lower


def _tokens(text: str, place: Place) -> list[str]:
    """Words; what stands in braces, quotes or parentheses stays together, = is a word."""
    words: list[str] = []
    depth, current = 0, ""
    quoted = False
    for letter in text:
        if letter == "'":
            quoted = not quoted
            current += "{" if quoted else "}"
            continue
        depth += (letter in "{(") - (letter in "})")
        if depth == 0 and not quoted and (letter.isspace() or letter in ",="):
            if current:
                words.append(current)
            current = ""
            if letter == "=":
                words.append("=")
        else:
            current += letter
    if depth or quoted:
        raise place.error("a brace, a quote or a parenthesis is not closed")
    return [*words, current] if current else words


def _options(text: str, place: Place) -> tuple[list[str], dict[str, str]]:
    """Plain words but ``params:``, and ``key=value`` pairs by lower-case key."""
    words, plain, options, k = [*_tokens(text, place), "", ""], list[str](), dict[str, str](), 0
    while key := words[k]:
        equals, value = words[k + 1 : k + 3]
        if key == "=" or (equals == "=" and value in ("", "=")):
            raise place.error("= needs a name before it and a value behind it")
        if equals != "=":
            plain += [key] * (key.lower() != "params:")
            k += 1
            continue
        stop = k + 3  # on=1,3,5: more numbers belong to the key
        while number(words[stop]) is not None:
            stop += 1
        options[key.lower()] = " ".join(words[k + 2 : stop])
        k = stop
    return plain, options


@dataclass
class Netlist:
    """A circuit, in which subcircuits are put in place while it is read."""

    title: str
    blocks: Mapping[str, _Block]  # the subcircuits
    elements: dict[str, Element] = field(default_factory=dict)  # by lower-case name
    parameters: dict[str, float | str] = field(default_factory=dict)
    initial: dict[str, float] = field(default_factory=dict)  # by ``v(out)`` or ``i(l1)``
    saved: list[str] = field(default_factory=list)  # quantities
    _inside: dict[str, str] = field(default_factory=dict)  # in what, by prefix, a node is

    def expand(self, block: _Block, scope: _Scope) -> None:
        """Read the lines of a block, in which its own parameters are known, too."""
        known = dict(scope.known)
        scope = scope._replace(known=known)
        lines = [
            (scope._replace(place=place), line, line.split()[0].lower())
            for place, line in block.lines
        ]
        for here, line, head in lines:
            if head in (".param", ".params"):
                _, given = _options(line[len(head) :], here.place)
                if not given:
                    raise here.place.error(".param needs name=value")
                for name, value in given.items():
                    known[name] = self._parameter(scope.prefix + name, value, here)
        for here, line, head in lines:
            if head.startswith("."):
                self._command(head, line[len(head) :], here)
                continue
            plain, options = _options(line, here.place)
            if not plain:
                raise here.place.error(
                    f"{shown(line)} is no element: a name comes first, then its nodes"
                )
            add = self._instance if head.startswith("x") else self._element
            add(plain, options, here)

    def _parameter(self, name: str, value: str, scope: _Scope) -> str:
        taken = {key.lower() for key in self.parameters}.union(RESERVED, keyword.kwlist)
        while name.lower() in taken:
            name += "_"
        self.parameters[name] = self.value(value, scope, name)
        return name

    def value(self, text: str, scope: _Scope, what: str) -> float | str:
        """A number, or an expression translated into the language of plants."""
        inner = text[1:-1] if text.startswith("{") and text.endswith("}") else text
        plain = number(inner.strip())
        if plain is not None:
            return plain
        known = {**{name: name for name in RESERVED}, "time": "t", **scope.known}

        def translated(match: re.Match[str]) -> str:
            if match["number"]:
                digits = str(match["number"])
                found = number(digits)
                if found is None:
                    raise scope.place.error(
                        f"{what}: {digits} is no number; its suffix stands behind it, as in 4.7k"
                    )
                return digits if digits[-1].isdigit() or digits[-1] == "." else repr(found)
            word = match["word"].lower()
            if word not in known:
                raise scope.place.error(
                    f"{what} uses {match['word']}, which is neither a parameter nor a function"
                    + nearest(word, [*scope.known, *RESERVED])
                )
            return known[word]

        return _IN_EXPRESSION.sub(translated, inner.replace("^", "**")).strip()

    def _command(self, head: str, rest: str, scope: _Scope) -> None:
        place = scope.place
        if head == ".ic":
            _, given = _options(rest, place)
            for quantity, value in given.items():
                found = number(value)
                if found is None:
                    raise place.error(f".ic {quantity} = {shown(value)} is not a number")
                self.initial[scope.quantity(quantity)] = found
        elif head in (".save", ".probe", ".print"):
            for quantity in _tokens(rest, place):
                if quantity.lower() not in ("tran", "all"):
                    self.saved.append(scope.quantity(quantity.lower()))
        elif head in _REFUSED:
            raise place.error(f"{head} {_REFUSED[head]}")
        # .param has been read. Others ask for analyses, which gpebo's own settings describe.

    def _instance(self, plain: list[str], given: dict[str, str], scope: _Scope) -> None:
        place = scope.place
        last = plain[-1] if len(plain) > 1 else ""
        block = self.blocks.get(last.lower())
        if block is None:
            raise place.error(
                f"{plain[0]} ends with the name of a subcircuit, and "
                f"{shown(last) if last else 'nothing'} is none" + nearest(last.lower(), self.blocks)
            )
        if scope.depth >= MAX_DEPTH:
            raise place.error(f"subcircuits are nested more than {MAX_DEPTH} deep ({block.name})")
        ends = plain[1:-1]
        if len(ends) != len(block.ports):
            raise place.error(
                f"{plain[0]} has {len(ends)} nodes and the subcircuit {block.name} has "
                f"{len(block.ports)}"
            )
        for key in given:
            if key not in block.defaults:
                raise place.error(
                    f"{plain[0]}: {block.name} has no parameter {key}"
                    + nearest(key, block.defaults)
                )
        inside = scope.prefix + plain[0].lower() + "_"
        ports = dict(zip(block.ports, self._nodes(ends, scope), strict=True))
        if ports.get(GROUND, GROUND) != GROUND:
            raise place.error(
                f"{plain[0]}: ground, a node of the subcircuit {block.name}, cannot be "
                f"{ports[GROUND]} outside; call it otherwise inside"
            )
        inner = dict(scope.known)
        for key, default in block.defaults.items():
            inner[key] = self._parameter(inside + key, given.get(key, default), scope)
        self.expand(block, _Scope(ports, inner, inside, scope.depth + 1))

    def _nodes(self, words: Sequence[str], scope: _Scope) -> tuple[str, ...]:
        """Nodes as the plant has them (ConfigError: one in something else is called the same)."""
        found = tuple(map(scope.node, words))
        for word, node in zip(words, found, strict=True):
            own = scope.prefix if node != GROUND and _node(word) not in scope.nodes else None
            if own is not None and self._inside.setdefault(node, own) != own:
                raise scope.place.error(
                    f"the node {word} and one of another (sub)circuit are both {node} in the "
                    "plant; call one otherwise"
                )
        return found

    def _element(self, plain: list[str], options: dict[str, str], scope: _Scope) -> None:
        name, kind, place = plain[0], plain[0][0].upper(), scope.place
        if kind == "K":
            element = self._coupling(plain, scope)
        elif kind not in NODES:
            raise place.error(
                f"{shown(name)}: elements are {', '.join([*NODES, 'K', 'X'])} by their first letter"
            )
        else:
            count = NODES[kind]
            ends, rest = plain[1 : 1 + count], plain[1 + count :]
            if len(ends) < count:
                raise place.error(f"{name} needs {count} nodes and has {len(ends)}")
            where = self._nodes(ends, scope)
            element = self._valued(kind, name, where, rest, options, scope)
        full = scope.prefix + name
        if not _WORD.fullmatch(full):
            raise place.error(f"{shown(name)} cannot be a name; use letters, digits and _")
        if full.lower() in self.elements:
            raise place.error(
                f"{name} stands in line {self.elements[full.lower()].place.line} already"
            )
        if len(self.elements) == MAX_ELEMENTS:
            raise place.error(f"there are more than {MAX_ELEMENTS} elements")
        self.elements[full.lower()] = replace(element, name=full)

    def _coupling(self, plain: Sequence[str], scope: _Scope) -> Element:
        name, place = plain[0], scope.place
        if len(plain) != 4 or plain[1].lower() == plain[2].lower():
            raise place.error(f"{name} needs two inductors and a coefficient, as K1 L1 L2 0.9")
        value = self.value(plain[3], scope, name)
        if isinstance(value, float) and not abs(value) <= 1.0:
            raise place.error(f"{name}: a coupling is at most 1, got {value:g}")
        coils = tuple(scope.prefix + word.lower() for word in plain[1:3])
        return Element("K", name, (), value, place, coils)

    def _valued(
        self, kind: str, name: str, where: tuple[str, ...], rest: list[str],
        options: dict[str, str], scope: _Scope,
    ) -> Element:
        place = scope.place
        controls: tuple[str, ...] = ()
        allowed = {"C": ("ic",), "L": ("ic",), "S": ("on", "off", "ron", "roff"), "T": ("n",)}
        wrong = [key for key in options if key not in allowed.get(kind, ())]
        if wrong and kind == "T":
            raise place.error(f"{name}: T is an ideal transformer with n=RATIO; lines are not read")
        if wrong and wrong[0] not in ("tc1", "tc2", "tc", "temp", "m"):
            raise place.error(f"{name}: {wrong[0]}= is not read here")
        if wrong:
            raise place.error(f"{name}: {wrong[0]}= changes the value; write the value itself")
        value: float | str
        if kind in "VI":
            value = self._source(rest, scope, name)
        elif kind == "S":
            value = self._switch(options, scope, name)
        elif kind == "T":
            if rest or "n" not in options:
                raise place.error(f"{name} needs n=RATIO, as in T1 a 0 b 0 n=2")
            value = self.value(options["n"], scope, name)
        else:
            if kind in "FH":
                if not rest:
                    raise place.error(f"{name} needs the voltage source whose current controls it")
                controls, rest = (scope.prefix + rest[0].lower(),), rest[1:]
            if len(rest) != 1:
                got = "none" if not rest else " ".join(rest)
                raise place.error(f"{name} needs one value, a number or {{expression}}; got {got}")
            value = self.value(rest[0], scope, name)
        if kind in "RLCST" and isinstance(value, float) and value == 0.0:
            raise place.error(f"{name} has the value 0")
        initial = number(options["ic"]) if "ic" in options else None
        if "ic" in options and initial is None:
            raise place.error(f"{name}: ic={options['ic']} is not a number")
        return Element(kind, name, where, value, place, controls, initial)

    def _switch(self, options: Mapping[str, str], scope: _Scope, name: str) -> str:
        """The resistance of a switch that closes and opens at given instants."""
        place = scope.place
        if "on" not in options and "off" not in options:
            raise place.error(f"{name} needs its instants, as in S1 a b on=1,3 off=2 ron=1m")
        events: list[tuple[float, int]] = []
        for key, sign in (("on", 1), ("off", -1)):
            for word in options.get(key, "").split():
                if (time := number(word)) is None:
                    raise place.error(f"{name}: {key}={options[key]} has to be times in seconds")
                events.append((time, sign))
        events.sort()
        if any(a == b for (_, a), (_, b) in itertools.pairwise(events)):
            raise place.error(f"{name}: on and off have to take turns")
        closed = "1" if events[0][1] < 0 else "0"
        for time, sign in events:
            closed += f" {'+' if sign > 0 else '-'} step(t - {time!r})"
        ron = self.value(options.get("ron", "1m"), scope, name)
        roff = self.value(options.get("roff", "1g"), scope, name)
        return f"1/(1/({roff}) + (1/({ron}) - 1/({roff}))*({closed}))"

    def _source(self, rest: list[str], scope: _Scope, name: str) -> float | str:
        place = scope.place
        # A size and a phase behind AC are for another analysis.
        at = next((k for k, word in enumerate(rest) if word.lower() == "ac"), len(rest))
        sizes = itertools.takewhile(
            lambda word: word.startswith("{") or number(word) is not None, rest[at + 1 : at + 3]
        )
        words = rest[:at] + rest[at + 1 + len([*sizes]) :]
        words = words[1:] if words and words[0].lower() == "dc" else words
        text = " ".join(words)
        shape = re.fullmatch(r"(?is)(?:\S+\s+)?(sin|pulse|pwl|exp)\s*\((.*)\)", text)
        if shape is not None:
            given = [number(word) for word in shape[2].replace(",", " ").split()]
            numbers = [value for value in given if value is not None]
            if len(numbers) < len(given):
                raise place.error(f"{name}: {shape[1]}(…) takes numbers")
            try:
                return _SHAPES[shape[1].lower()](numbers)
            except ValueError as error:
                raise place.error(f"{name}: {shape[1]}(…) {error}") from None
        if not words:
            return 0.0
        if len(words) != 1:
            raise place.error(
                f"{name}: {shown(text)} is no source; write a number, {{expression}}, SIN(…), "
                "PULSE(…), PWL(…) or EXP(…)"
            )
        return self.value(words[0], scope, name)


def _padded(numbers: Sequence[float], least: int, defaults: Sequence[float]) -> list[float]:
    if len(numbers) < least:
        raise ValueError(f"needs at least {least} numbers and has {len(numbers)}")
    if len(numbers) > len(defaults):
        raise ValueError(f"has {len(numbers)} numbers; at most {len(defaults)} are read")
    return [*numbers, *defaults[len(numbers) :]]


def _sin(numbers: Sequence[float]) -> str:
    offset, amplitude, frequency, delay, damping, phase = _padded(numbers, 3, [0.0] * 6)
    since = f"(t - {delay!r})" if delay else "t"
    wave = f"sin(2*pi*{frequency!r}*{since}" + (f" + {phase!r}*pi/180)" if phase else ")")
    if damping:  # abs: before the delay it would grow beyond all numbers, and step times that
        wave += f"*exp(-{damping!r}*{f'abs{since}' if delay else since})"
    if delay:  # before it the source stands at its first value
        first = f"sin({phase!r}*pi/180)" if phase else "0"
        wave = f"({first} + ({wave} - {first})*step(t - {delay!r}))"
    return f"{offset!r} + {amplitude!r}*{wave}"


def _exp(numbers: Sequence[float]) -> str:
    low, high, rise, tau1, fall, tau2 = _padded(numbers, 6, [0.0] * 6)
    if not (tau1 > 0 and tau2 > 0):
        raise ValueError("needs positive time constants")
    return (
        f"{low!r} + {high - low!r}*(1 - exp(-abs(t - {rise!r})/{tau1!r}))*step(t - {rise!r})"
        f" + {low - high!r}*(1 - exp(-abs(t - {fall!r})/{tau2!r}))*step(t - {fall!r})"
    )


def _pwl(numbers: Sequence[float]) -> str:
    if len(numbers) < 2 or len(numbers) % 2:
        raise ValueError("needs pairs of a time and a value")
    times, values = list(numbers[::2]), list(numbers[1::2])
    if any(b < a for a, b in itertools.pairwise(times)):
        raise ValueError("needs times that do not fall")
    return _corners(times, values)


def _pulse(numbers: Sequence[float]) -> str:
    low, high, delay, rise, fall, width, period, count = _padded(numbers, 6, [0.0] * 8)
    if period and not count:
        raise ValueError(
            "with a period needs the number of pulses as its eighth value; a plant has no end"
        )
    if count > 1_000:
        raise ValueError(f"has {count:g} pulses; at most 1000 are read")
    times, values = list[float](), list[float]()
    for k in range(int(count) or 1):
        start = delay + k * period
        times += [start, start + rise, start + rise + width, start + rise + width + fall]
        values += [low, high, high, low]
    if any(b < a for a, b in itertools.pairwise(times)):
        raise ValueError("has pulses that are longer than their period")
    return _corners(times, values)


def _corners(times: Sequence[float], values: Sequence[float]) -> str:
    """A piecewise linear function, constant outside: what it is on each piece, on that piece only.

    A sum of ramps would lose digits behind each steep one. Terms stand in groups, because Python's
    parser nests them.
    """
    terms, points = [repr(values[0])], [*zip(times, values, strict=True)]
    for (t, value), (until, end) in itertools.pairwise(points):
        if until > t and (end != value or value != values[0]):
            slope = f" + {(end - value) / (until - t)!r}*(t - {t!r})" if end != value else ""
            terms.append(f"({value - values[0]!r}{slope})*(step(t - {t!r}) - step(t - {until!r}))")
    if values[-1] != values[0]:
        terms.append(f"{values[-1] - values[0]!r}*step(t - {times[-1]!r})")
    groups = [" + ".join(terms[k : k + _GROUP]) for k in range(0, len(terms), _GROUP)]
    return groups[0] if len(groups) == 1 else f"({') + ('.join(groups)})"


_SHAPES = {"sin": _sin, "exp": _exp, "pwl": _pwl, "pulse": _pulse}


def split_names(text: str | Iterable[str] | None) -> list[str]:
    """Names from ``"a,b"`` or a list; nothing from None. Commas in parentheses do not divide."""
    if text is None:
        return []
    if not isinstance(text, str):
        return list(text)
    return [part.strip() for part in re.split(r",(?![^(]*\))", text) if part.strip()]
