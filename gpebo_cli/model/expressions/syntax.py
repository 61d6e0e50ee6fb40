"""Text to expression: a walk over Python's syntax tree that knows only a short list of shapes.

A plant file may come from a stranger. Its text is parsed, never compiled or run; whatever is not
listed here is refused, and limits on length, depth and the size of numbers keep the refusal quick.
``sympify`` was rejected: it runs ``eval`` on the text. SymPy as such was rejected too: 0.25 s to
import, and repeated symbolic derivatives that grow without bound.
"""

from __future__ import annotations

import ast
import keyword
import math
import numbers
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.expressions import nodes
from gpebo_cli.model.expressions.nodes import FoldError, Node
from gpebo_cli.schema import nearest

MAX_LENGTH = 300_000  # characters of one expression
MAX_DEPTH = 200  # nesting; a sum or product of many terms is one level

_CALLS: dict[str, tuple[int, Callable[..., Node]]] = {
    **{name: (1, partial(nodes.function, name)) for name in nodes.FUNCTIONS},
    **{name: (2, partial(nodes.extremum, name)) for name in ("min", "max")},
    "d": (1, nodes.derivative),
    "step": (1, nodes.step),
}
"""How many arguments each function takes, and what it makes of their nodes."""

RESERVED = frozenset({"t", "pi", *_CALLS})
"""Names that mean something in every expression."""

_BINARY: dict[type[ast.operator], Callable[[Node, Node], Node]] = {
    ast.Add: nodes.add,
    ast.Sub: nodes.subtract,
    ast.Mult: nodes.multiply,
    ast.Div: nodes.divide,
    ast.Pow: nodes.power,
}
_ACCEPTED = "accepted: numbers, names, + - * / **, t, pi, " + ", ".join(
    [*nodes.FUNCTIONS, "min(., .), max(., .), d(.), step(.)"]
)
_FOREIGN = re.compile(r"[^A-Za-z0-9_.+\-*/(), \t\r\n]")
# Python warns of "1if t", and what it warns of can only be ignored in all threads.
_GLUED = re.compile(r"\b(\d\w*?(?:\.\w*?)?)(and|else|for|if|in|is|not|or)")


@dataclass(frozen=True, slots=True, eq=False)
class Expression:
    """A function of time, with the text it came from; made by :func:`parse`."""

    node: Node
    text: str
    where: str
    uses: tuple[Expression, ...] = ()  # the named expressions in the text, for messages

    @property
    def is_constant(self) -> bool:
        """Whether it is the same number at all times."""
        return self.node.is_number

    @property
    def value(self) -> float:
        """The constant. Raises ConfigError where the expression depends on time."""
        if not self.is_constant:
            raise ConfigError(f"{self.where} = {shorten(self.text)} must not depend on t")
        return self.node.value


def signal(name: str, place: int, kind: str) -> Expression:
    """An input or output (its ``kind``) by its place among the signals, inputs first."""
    return Expression(nodes.signal(name, place), name, kind)


def parse(
    value: object,
    names: Mapping[str, Expression],
    where: str,
    elsewhere: Mapping[str, str] | None = None,
    calls: Mapping[str, tuple[int, Callable[..., Node]]] | None = None,
) -> Expression:
    """Read one entry of a plant.

    Args:
        value: a number, or text in the language of the module docstring of ``expressions``.
        names: what names in the text stand for, besides the RESERVED ones.
        where: what the entry is, such as ``"plant circuit: A[0][1]"``; starts every message.
        elsewhere: names that exist but may not be used here, with what they are ("an input").
        calls: more functions, by name how many arguments they take and what makes their node.

    ConfigError: anything else than an expression of the language, or one without a value.
    """
    if isinstance(value, bool):
        raise ConfigError(
            f"{where} is the boolean {str(value).lower()}; "
            "write a number or an expression (YAML reads on, off, yes and no as booleans)"
        )
    if isinstance(value, numbers.Real):
        text = _number_text(value)
        try:
            return Expression(_number(value), text, where)
        except FoldError:
            raise ConfigError(f"{where} is {text}; write a finite number") from None
    if not isinstance(value, str):
        kind = "empty" if value is None else f"a {type(value).__name__}"
        raise ConfigError(f"{where} is {kind}; write a number or an expression")

    reader = _Reader(names, elsewhere or {}, {**_CALLS, **(calls or {})})
    try:
        node = reader.read(_syntax_tree(value), 0)
    except FoldError as error:
        words = (word for word in re.findall(r"\w+", value) if word in {*names, *reader.elsewhere})
        said = next((f"{w} is {no_word(w)}" for w in words if keyword.iskeyword(w)), error)
        raise ConfigError(f"{where} = {shorten(value)}: {said}") from None
    except (MemoryError, RecursionError):  # MemoryError: the parser says so
        raise ConfigError(f"{where} = {shorten(value)}: it is nested too deeply") from None
    return Expression(node, value, where, tuple(reader.used.values()))


def no_word(name: str) -> str:
    """Why a name that is a word of Python's, such as ``in``, is refused."""
    return f"a word of Python that cannot stand in an expression; write {name}_ or another name"


def shorten(text: str) -> str:
    """The text in quotes, on one line, with its middle left out where it is long."""
    if len(text) > 60:
        text = f"{text[:30]}...{text[-15:]}"
    return repr(text)


def _number(value: numbers.Real | float) -> Node:
    try:
        return nodes.number(float(value))
    except OverflowError:
        raise FoldError("a number in it is too large") from None


def _number_text(value: numbers.Real) -> str:
    try:
        return str(value)[:60]
    except ValueError:  # integers beyond what Python converts to decimal
        return "an integer too large"


def _syntax_tree(text: str) -> ast.expr:
    """The syntax tree of text that holds no characters foreign to the language."""
    text = text.strip()
    if not text:
        raise FoldError("it is empty; write a number or an expression")
    if len(text) > MAX_LENGTH:
        raise FoldError(f"it has {len(text)} characters, more than {MAX_LENGTH}")
    if foreign := _FOREIGN.search(text):
        hint = "write ** for powers" if foreign[0] == "^" else _ACCEPTED
        raise FoldError(f"the character {foreign[0]!a} has no meaning here; {hint}")
    try:
        # Line breaks (folded YAML text) would end the expression for Python.
        return ast.parse(_GLUED.sub(r"\1 \2", " ".join(text.split())), mode="eval").body
    except (SyntaxError, ValueError) as error:
        reason = str(error)
        if "nested parentheses" in reason:
            reason = "it is nested too deeply"
        elif "integer string conversion" in reason:
            reason = "a number in it is too large"
        elif "decimal literal" in reason:
            reason = "write * between a number and a name, as in 2*t"
        else:
            reason = "it is not an expression (" + reason.split(" (<")[0].rstrip(".") + ")"
        raise FoldError(reason) from None


@dataclass(frozen=True, slots=True)
class _Reader:
    """One text's walk; collects the named expressions it meets."""

    names: Mapping[str, Expression]
    elsewhere: Mapping[str, str]
    calls: Mapping[str, tuple[int, Callable[..., Node]]]
    used: dict[str, Expression] = field(default_factory=dict)

    def read(self, tree: ast.expr, depth: int) -> Node:
        """The node of a syntax tree; raises FoldError for whatever the language lacks."""
        if depth > MAX_DEPTH:
            raise FoldError(f"it is nested more than {MAX_DEPTH} deep")
        match tree:
            case ast.Constant(value=value):
                if isinstance(value, bool) or not isinstance(value, int | float):
                    raise FoldError(f"{shorten(str(value))} is not a real number")
                return _number(value)
            case ast.Name(id=name):
                return self._name(name)
            case ast.BinOp():
                return self._binary(tree, depth)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return nodes.negative(self.read(operand, depth + 1))
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.read(operand, depth + 1)
            case ast.Call(func=ast.Name(id=name)):
                return self._call(name, tree, depth)
        what = _DESCRIBED.get(type(tree), f"this kind of expression ({type(tree).__name__})")
        raise FoldError(f"{what} has no meaning here; {_ACCEPTED}")

    def _binary(self, tree: ast.BinOp, depth: int) -> Node:
        # a + b + c + ... leans to the left, one level per term: walk it down without recursion.
        spine: list[tuple[Callable[[Node, Node], Node], ast.expr]] = []
        left: ast.expr = tree
        while isinstance(left, ast.BinOp):
            operation = _BINARY.get(type(left.op))
            if operation is None:
                raise FoldError(f"the operator {type(left.op).__name__} has no meaning here")
            spine.append((operation, left.right))
            left = left.left
        node = self.read(left, depth + 1)
        for operation, right in reversed(spine):
            node = operation(node, self.read(right, depth + 1))
        return node

    def _call(self, name: str, tree: ast.Call, depth: int) -> Node:
        if name not in self.calls:
            hint = nearest(name, self.calls)
            raise FoldError(
                f"there is no function {shorten(name)}{hint} (accepted: {', '.join(self.calls)})"
            )
        count, made = self.calls[name]
        if len(tree.args) != count or tree.keywords:
            given = "keywords" if tree.keywords else len(tree.args)
            wanted = "one argument" if count == 1 else "two arguments"
            raise FoldError(f"{name} takes {wanted}, not {given}")
        return made(*(self.read(argument, depth + 1) for argument in tree.args))

    def _name(self, name: str) -> Node:
        if name == "t":
            return nodes.TIME
        if name == "pi":
            return nodes.number(math.pi)
        if name in self.names:
            self.used[name] = self.names[name]
            return self.names[name].node
        if name in RESERVED:
            raise FoldError(f"{name} is a function and needs an argument, {name}(...)")
        if name in self.elsewhere:
            raise FoldError(f"{name} is {self.elsewhere[name]} and cannot be used here")
        known = [*self.names, "t", "pi"]
        listed = ", ".join(known[-12:])
        raise FoldError(
            f"the name {shorten(name)} is not defined{nearest(name, known)} (defined: {listed})"
        )


_DESCRIBED = {
    ast.Attribute: "a dot after a name (attribute)", ast.UnaryOp: "this unary operator",
    ast.Call: "a call of something that is not a name",
}
