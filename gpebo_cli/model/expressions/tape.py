"""Many expressions, recorded as one list of instructions and evaluated together.

Equal work is done once, also across expressions: two nodes with the same operation, arguments
and value get the same place on the tape. A tape is flat, so it copies to other processes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.model.expressions import jets
from gpebo_cli.model.expressions.jets import Jet
from gpebo_cli.model.expressions.nodes import Node
from gpebo_cli.model.expressions.program import Program, Recorder, finished
from gpebo_cli.model.expressions.syntax import Expression, shorten

MAX_INSTRUCTIONS = 200_000
MAX_NUMBERS = 2**24  # held at once; longer arrays of times are evaluated in parts
_SWITCHES = ("abs", "sign", "min", "max")
_ASIDE = 1e-6  # of a way that is itself 1e-3 of an element: a signal hardly moves there
_TOLD = 4.0  # times the distance of two numbers: times that are told apart
_CLEAR = 0.5  # of an argument of a switch: one that moves by less on that way is decided anywhere
UNKNOWN = Node("number", value=math.nan)  # a signal that nobody has told

# Order, whether jumps are decided at other times, how many coefficients of how many signals.
_Key = tuple[int, bool, tuple[int, int] | None]


class Instruction(NamedTuple):
    """One operation on earlier places of the tape."""

    operation: str
    arguments: tuple[int, ...]
    value: float


class Switch(NamedTuple):
    """The place of an argument of abs or sign, and (c, s) where that argument is c + s t.

    Of min and max it is the difference of the two.
    """

    argument: int
    affine: tuple[float, float] | None


class Label(NamedTuple):
    """A named piece of text: its place, and the labels of the names in it."""

    place: int
    text: str
    where: str
    uses: tuple[int, ...]


@dataclass(frozen=True)
class Tape:
    """Instructions in an order in which arguments come first; made by :func:`record`."""

    instructions: tuple[Instruction, ...]
    extra: tuple[int, ...]  # orders needed beyond the one asked for, by the d(.) around a place
    outputs: tuple[int, ...]  # places of the expressions
    switches: tuple[Switch, ...]
    labels: tuple[Label, ...]  # those of the expressions first

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> Array:
        """Taylor coefficients of all expressions, shape (order + 1, N, number of expressions).

        At times t (N,), in seconds, where step, abs and sign are decided at ``inside`` (N,), by
        default t. ``signals`` are Taylor coefficients of the signals at t, (J + 1, N, number of
        signals), those beyond J being zero; what depends on one is decided :func:`aside`. None:
        inputs are the functions of time that the tape has for them, and outputs are unknown.
        """
        return self._in_a_row.taylor(np.asarray(t, dtype=np.float64), order, inside, signals)[0]

    def interpreted(
        self, t: Array, order: int, inside: Array | None, signals: Array | None
    ) -> Array:
        """:meth:`taylor` of float64 times (N,) without the compiled kernel."""
        result = np.zeros((order + 1, len(self.outputs), len(t)))
        held = max(1, len(self.instructions)) * (order + 1 + max(self.extra, default=0))
        part = max(64, MAX_NUMBERS // held)
        for first in range(0, len(t), part):
            here = slice(first, first + part)
            times = t[here]
            decided = times if inside is None else inside[here]
            jets_of_signals: list[Jet] | None = None
            if signals is not None:
                jets_of_signals = [list(each) for each in np.moveaxis(signals[:, here], 2, 0)]
            known = times, order, decided, jets_of_signals
            try:  # every invalid operation is refused, even one whose result is finite again
                with np.errstate(divide="raise", over="raise", invalid="raise", under="ignore"):
                    places = self.run(*known)
            except FloatingPointError:
                # Only a second, slower run can tell whose fault it was and when; or that it was
                # nobody's: vectorised loops may raise flags for lanes that they do not return.
                self._refuse(*known)
                with np.errstate(all="ignore"):
                    places = self.run(*known)
            for column, place in enumerate(self.outputs):
                for k, coefficient in enumerate(places[place][: order + 1]):
                    result[k, column, here] = coefficient
            # Arithmetic of plain floats (coefficients equal at all times) raises no flags.
            if not np.isfinite(result[:, :, here]).all():
                self._refuse(*known)
        return np.moveaxis(result, 1, 2)

    @cached_property
    def jumps(self) -> bool:
        """Whether there is any step, abs, sign, min or max."""
        return bool(self.switches) or any(i.operation == "step" for i in self.instructions)

    def program(
        self, order: int, apart: bool, signals: tuple[int, int] | None = None
    ) -> Program | None:
        """What :meth:`taylor` does, for the compiled kernel; None where it is refused at any time.

        Jumps are decided at other times if ``apart``. With ``signals``, so many coefficients of so
        many are given.
        """
        recorder = Recorder(signals)
        inside = recorder.inside if apart else recorder.t
        try:
            with np.errstate(divide="raise", over="raise", invalid="raise", under="ignore"):
                places = self.run(recorder.t, order, inside, recorder.signals)
        except FloatingPointError:
            return None
        return finished(recorder, places, self.outputs, order)

    @cached_property
    def _in_a_row(self) -> Assembly:
        targets = np.array([(0, j) for j in range(len(self.outputs))], dtype=np.intp)
        return Assembly(self, targets.reshape(-1, 2), (np.zeros(len(self.outputs)),))

    @cached_property
    def of_time(self) -> frozenset[int]:
        """Places whose value time alone decides: no signal is in them that nobody told."""
        known: set[int] = set()
        for place, instruction in enumerate(self.instructions):
            if not math.isnan(instruction.value) and known.issuperset(instruction.arguments):
                known.add(place)
        return frozenset(known)

    @cached_property
    def _followers(self) -> frozenset[int]:
        told = {int(i.value) for i in self.instructions if i.operation == "signal"}
        return self.following(told).intersection(switch.argument for switch in self.switches)

    def following(self, numbers: Container[int]) -> frozenset[int]:
        """Places in which a signal of these numbers is."""
        found: set[int] = set()
        for place, (operation, arguments, value) in enumerate(self.instructions):
            if not found.isdisjoint(arguments) or (operation == "signal" and int(value) in numbers):
                found.add(place)
        return frozenset(found)

    def of(self, places: Sequence[int]) -> Tape:
        """The tape with other places as outputs, and nothing on it that these do not need."""
        last = max(places, default=-1) + 1
        needed = [False] * last
        for place in places:
            needed[place] = True
        for place in reversed(range(last)):
            if needed[place]:
                for argument in self.instructions[place].arguments:
                    needed[argument] = True
        new = {place: k for k, place in enumerate(k for k in range(last) if needed[k])}
        kept = [self.instructions[place] for place in new]
        decided = {i.arguments[-1] for i in kept if i.operation in _SWITCHES}
        named = {label.place: label for label in reversed(self.labels)}
        return Tape(
            tuple(i._replace(arguments=tuple(new[a] for a in i.arguments)) for i in kept),
            tuple(self.extra[place] for place in new),
            tuple(new[place] for place in places),
            tuple(
                s._replace(argument=new[s.argument])
                for s in self.switches if s.argument in decided
            ),
            tuple(
                named.get(place, Label(place, "…", "an argument", ()))._replace(
                    place=new[place], uses=()
                ) for place in places
            ),
        )

    def run(
        self, t: Any, order: int, inside: Any, signals: Any = None, stop: int | None = None,
        deciding: list[Jet] | None = None,
    ) -> list[Jet]:
        """Jets of all places before ``stop``, those that jump decided at ``inside``.

        The times and signals are arrays (N,), symbols for them that record what is done, or cells
        of time. A signal that is None is what the tape has for it. ``deciding`` are jets at
        ``inside``, if known. What follows a signal is decided where that is told, by all of its
        argument.
        """
        followers: frozenset[int] = frozenset()
        beside: list[Jet] | None = None
        if self.switches and inside is not t:
            if signals is not None and isinstance(t, type(inside)):  # no cells
                followers = self._followers
            if deciding is None:
                last = max(switch.argument for switch in self.switches) + 1
                deciding = self.run(inside, 0, inside, signals, last)
                if followers:  # as ``aside`` has it, of symbols, too
                    near = t + _ASIDE * (inside - t)
                    beside = self.run(near, 0, inside, signals, last, deciding)
        places: list[Jet] = []
        for (operation, arguments, value), extra in zip(
            self.instructions[:stop], self.extra[:stop], strict=True
        ):
            wanted = order + extra
            jet: Jet
            if operation in jets.BINARY:
                left, right = arguments
                jet = jets.BINARY[operation](places[left], places[right], wanted)
            elif operation in jets.UNARY:
                jet = jets.UNARY[operation](places[arguments[0]], wanted)
            elif operation == "power":
                jet = jets.power(places[arguments[0]], value, wanted)
            elif operation == "number":
                jet = [value]
            elif operation == "t":
                jet = [t, 1.0]
            elif operation == "step":
                jet = [(inside >= value).astype(np.float64)]
            elif operation == "signal":
                told = None if signals is None else signals[int(value)]
                jet = places[arguments[0]] if told is None else told
            else:
                known = beside if arguments[-1] in followers else deciding
                decided = (places if known is None else known)[arguments[-1]][0]
                jet = jets.switched(operation, decided, [places[a] for a in arguments], wanted)
            places.append(jet)
        return places

    def terms(self, t: Array, signals: Array, sizes: Array) -> Array:
        """Sizes of the terms that make up each expression at times t (N,), (N, expressions).

        Signals (N, m) may be sums themselves, of terms of these ``sizes`` (N, m).
        """
        places, found = self.run(t, 0, t, [[each] for each in signals.T]), list[Array]()
        for (operation, arguments, value), jet in zip(self.instructions, places, strict=True):
            of = [found[argument] for argument in arguments]
            if operation == "signal":
                found.append(sizes[:, int(value)])
            elif operation == "add":
                found.append(np.maximum(*of))
            elif operation in ("multiply", "negative"):
                found.append(np.prod(np.broadcast_arrays(*of), axis=0))
            elif operation == "divide":
                found.append(of[0] / np.abs(places[arguments[1]][0]))
            else:
                found.append(np.abs(jet[0]))
        return np.stack([np.broadcast_to(found[k], len(t)) for k in self.outputs], axis=1)

    def _refuse(self, t: Array, order: int, inside: Array, signals: list[Jet] | None) -> None:
        """Raise the error for the first entry, and in it the innermost name, that is not finite."""
        for times in (t,) if inside is t else (t, inside):
            with np.errstate(all="ignore"):
                places = self.run(times, order if times is t else 0, inside, signals)
            # First index of a time at which a place, or something it is made of, is not finite.
            bad: list[float] = []
            for (operation, arguments, _), jet in zip(self.instructions, places, strict=True):
                wrong = [np.atleast_1d(~np.isfinite(coefficient)) for coefficient in jet]
                own = [float(np.argmax(flags)) if flags.any() else math.inf for flags in wrong]
                told = operation == "signal" and signals is not None
                bad.append(min([*own, *(bad[argument] for argument in arguments if not told)]))
            for label in self.labels[: len(self.outputs)]:
                if bad[label.place] < math.inf:
                    while inner := [k for k in label.uses if bad[self.labels[k].place] < math.inf]:
                        label = self.labels[inner[0]]  # noqa: PLW2901  down to the culprit
                    index = int(bad[label.place])
                    value = np.broadcast_to(places[label.place][0], times.shape)[index]
                    late = times is t and order > 0 and np.isfinite(value)
                    what = "no finite derivative" if late else "no finite value"
                    raise ConfigError(
                        f"{label.where} = {shorten(label.text)} has {what} "
                        f"at t = {times[index]:.10g}"
                    )


@dataclass(frozen=True, eq=False)
class Assembly:
    """Matrices in which some entries are outputs of a tape, and all others constants."""

    tape: Tape
    targets: IntArray  # (outputs, 2) the matrix and the entry in it, counted by rows
    fixed: tuple[Array, ...]  # the matrices, zero at the targets
    # What the kernel is given besides times and signals.
    _plans: dict[_Key, tuple[Any, ...] | None] = field(default_factory=dict, init=False)
    _parts: dict[object, Assembly] = field(default_factory=dict, init=False)  # see ``of``

    def taylor(
        self, t: Array, order: int, inside: Array | None = None, signals: Array | None = None
    ) -> tuple[Array, ...]:
        """As :meth:`Tape.taylor` at the times t (N,), of the matrices, (order + 1, N, ...) each.

        Those that are constant in time are read-only. The interpreter computes what no program is
        worth or runs on, and what the kernel met an operation in that may have to be refused.
        """
        found = None
        if kernels.expressions.RUNS_PROGRAMS:
            apart = inside is not None and inside is not t and self.tape.jumps
            key = order, apart, None if signals is None else (len(signals), signals.shape[2])
            if key not in self._plans:
                self._plans[key] = self._plan(*key)
            plan = self._plans[key]
            if plan is not None:
                given = np.empty((0, len(t), 0)) if signals is None else signals
                rows = np.swapaxes(given, 1, 2).reshape(len(given) * given.shape[2], len(t))
                found = kernels.expressions.jets(t, inside if apart else t, rows, *plan)
        return found or self._placed(self.tape.interpreted(t, order, inside, signals))

    def of(self, names: Sequence[str], some: Mapping[str, BoolArray]) -> Assembly:
        """With ``some`` entries (v,) of matrices that have these names, and the others as here."""
        if not some:
            return self
        key = tuple((name, own.tobytes()) for name, own in some.items())
        if key not in self._parts:
            targets, fixed, there = self.targets.copy(), list(self.fixed), self.targets[:, 0] >= 0
            for name, own in some.items():
                k = names.index(name)
                here, fixed[k] = targets[:, 0] == k, fixed[k].ravel()[own]
                there[here] = own[targets[here, 1]]
                targets[here, 1] = (own.cumsum() - 1)[targets[here, 1]]
            tape = self.tape.of([self.tape.outputs[j] for j in there.nonzero()[0].tolist()])
            self._parts[key] = Assembly(tape, targets[there], tuple(fixed))
        return self._parts[key]

    def _plan(
        self, order: int, apart: bool, signals: tuple[int, int] | None = None
    ) -> tuple[Any, ...] | None:
        program = self.tape.program(order, apart, signals)
        return None if program is None else (*program, self.targets, *self._constants(order + 1))

    def _constants(self, orders: int) -> list[Array]:
        """The matrices with nothing at the targets, (orders, 1, ...)."""
        matrices = [np.zeros((orders, 1, *fixed.shape)) for fixed in self.fixed]
        for once, fixed in zip(matrices, self.fixed, strict=True):
            once[0, 0] = fixed
            once.flags.writeable = False
        return matrices

    def _placed(self, values: Array) -> tuple[Array, ...]:
        """The matrices with what the tape gives (orders, N, outputs)."""
        found = []
        for matrix, once in enumerate(self._constants(len(values))):
            whole = np.broadcast_to(once, (*values.shape[:2], *once.shape[2:]))
            which = self.targets[:, 0] == matrix
            if which.any():
                whole = whole.copy()
                flat = whole.reshape(*values.shape[:2], self.fixed[matrix].size)
                flat[:, :, self.targets[which, 1]] = values[:, :, which]
            found.append(whole)
        return tuple(found)


def record(expressions: Sequence[Expression], inputs: Sequence[Expression] = ()) -> Tape:
    """Record expressions on one tape; ``inputs`` stand for signals that nobody has told.

    ConfigError: more than MAX_INSTRUCTIONS different operations.
    """
    instructions: dict[Instruction, int] = {}
    place_of: dict[int, int] = {}  # by id of the node; the expressions keep the nodes alive
    switches: dict[int, Switch] = {}
    for expression in expressions:
        stack = [expression.node]
        while stack:
            node = stack[-1]
            children = node.arguments
            if node.operation == "signal":
                k = int(node.value)
                children = (inputs[k].node if k < len(inputs) else UNKNOWN,)
            missing = [a for a in children if id(a) not in place_of]
            if missing:
                stack.extend(missing)
                continue
            stack.pop()
            arguments = tuple(place_of[id(a)] for a in children)
            instruction = Instruction(node.operation, arguments, node.value)
            place_of[id(node)] = instructions.setdefault(instruction, len(instructions))
            if node.operation in _SWITCHES:
                switches[arguments[-1]] = Switch(arguments[-1], children[-1].affine)
        if len(instructions) > MAX_INSTRUCTIONS:
            raise ConfigError(
                f"{expression.where}: the expressions up to here need more than "
                f"{MAX_INSTRUCTIONS} operations"
            )

    extra = [0] * len(instructions)
    for instruction, place in reversed(instructions.items()):
        for argument in instruction.arguments:
            needed = extra[place] + (instruction.operation == "derivative")
            extra[argument] = max(extra[argument], needed)
    return Tape(
        instructions=tuple(instructions),
        extra=tuple(extra),
        outputs=tuple(place_of[id(expression.node)] for expression in expressions),
        switches=tuple(switches.values()),
        labels=_labels(expressions, inputs, place_of),
    )


def _labels(
    expressions: Sequence[Expression], inputs: Sequence[Expression], place_of: dict[int, int]
) -> tuple[Label, ...]:
    """Labels of the expressions and of the names they use, as far as those are on the tape."""
    listed = list(expressions)
    index = {id(expression): k for k, expression in enumerate(listed)}
    uses: list[tuple[int, ...]] = []
    for expression in listed:  # grows as it is walked
        used_here = [
            inputs[int(used.node.value)]
            if used.node.operation == "signal" and used.node.value < len(inputs) else used
            for used in expression.uses
        ]
        kept = [used for used in used_here if id(used.node) in place_of]
        for used in kept:
            if id(used) not in index:
                index[id(used)] = len(listed)
                listed.append(used)
        uses.append(tuple(index[id(used)] for used in kept))
    return tuple(
        Label(place_of[id(e.node)], e.text, e.where, used)
        for e, used in zip(listed, uses, strict=True)
    )


def aside(t: Array, inside: Array) -> Array:
    """Times (N,) so little from t towards ``inside`` that only what jumps there is another one."""
    way = inside - t
    least = _TOLD * np.spacing(np.abs(t))  # so near may be no other number in a short element
    return np.asarray(t + np.sign(way) * np.maximum(_ASIDE * np.abs(way), least))


def on_their_side(
    arguments: Tape | None, t: Array, inside: Array | None,
    signals: Callable[[Array, Array], Array],
) -> Array:
    """Where signals are looked at for the times t (N,): :func:`aside` where ``arguments`` switch.

    Elsewhere that would be an error of first order. ``signals`` gives values (M, number of
    signals) at times (M,) at which what jumps is decided at others (M,).
    """
    if arguments is None or inside is None or inside is t:
        return t
    moved = np.flatnonzero(inside != t)
    within, there = inside[moved], aside(t[moved], inside[moved])
    at, beside = (
        arguments.taylor(there, 0, within, signals(times, within)[None])[0]
        for times in (t[moved], there)
    )
    near = (np.abs(beside - at) > _CLEAR * np.abs(beside)).any(axis=1)
    found = t.copy()
    found[moved[near]] = there[near]
    return found


def taylor(
    expressions: Sequence[Expression], t: Array, order: int, inside: Array | None = None
) -> Array:
    """Taylor coefficients of expressions at times t (N,); :meth:`Tape.taylor` of their tape."""
    return record(expressions).taylor(t, order, inside)
