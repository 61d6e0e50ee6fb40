"""A regression Y = ψη given as text: functions of time and of named signals, filters among them.

Besides the language of plants there are the operators that regressions are built with,

    lp(x, λ)      λ/(p + λ) x:      z' = λ (x − z),  z(start) = 0
    hp(x, λ)      p λ/(p + λ) x  =  λ (x − lp(x, λ))
    integral(x)   ∫ x from the start
    delay(x, d)   x(t − d), zero before the start

which may be nested. Elements of a mesh end where a text or a delay jumps or has a kink. From one
sample to the next signals are what the hold makes of them, and what is kept does not grow.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.model.expressions import nodes
from gpebo_cli.model.expressions.bounds import (
    Bounds,
    breakpoints,
    resolved,
    resolved_along,
    switched,
)
from gpebo_cli.model.expressions.nodes import Node
from gpebo_cli.model.expressions.syntax import Expression, parse, signal
from gpebo_cli.model.expressions.tape import UNKNOWN, Tape, aside, record
from gpebo_cli.model.plant import named_values, plant_from_mapping, read_parameters
from gpebo_cli.numerics.errors import EPS, ROUNDING
from gpebo_cli.numerics.linalg import largest_over_time
from gpebo_cli.numerics.mesh import SHARE, Kind, Mesh, Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.refinement import resolve
from gpebo_cli.recordings.drive import driven, tables
from gpebo_cli.reduction.structure import Structure
from gpebo_cli.regression.linear import LinearRegression, outer_products
from gpebo_cli.regression.operators import Operator, OperatorState
from gpebo_cli.regression.parametrisation import Parametrisation, read_box
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import check_keys, number, quoting, shown
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.signals import Signals, Simulation
from gpebo_cli.simulation.simulate import simulate

KEYS = (
    "name", "title", "reference", "parameters", "unknowns", "signals", "Y", "psi", "S", "box",
    "units", "labels",
)
"""Keys of a regression file; name, unknowns and psi are required."""

_FIRST_ELEMENTS = 16
_MAX_DELAYED = 10_000  # edges that delays may ask for
_AT_ONCE = 4096  # elements whose terms are looked at together
_LOOKS = 3  # at where signals pass jumps
_APART = 1e-13  # of a time: an edge nearer than that is there already
_JUMPED = 1e-6  # of its size: what changes by more beside an end of an element jumps there


@dataclass(frozen=True, eq=False)
class TextState:
    """Where a recursion stands, after a sample at ``t``."""

    t: float
    operators: tuple[OperatorState, ...]
    row: Array  # (rows, p + 1) [ψ | Y]
    terms: Array  # (m + operators + p,) as of :meth:`TextRegression._terms`
    start: float
    growth: None = field(default=None, init=False)  # there is no Φ
    log_norm: None = field(default=None, init=False)
    error_estimate: float = field(default=0.0, init=False)  # nothing is approximated but the hold


@dataclass(frozen=True, eq=False)
class TextRegression:
    """Y = ψη as text; ``Y`` is None where it is ψ times the true η."""

    system: DescriptorSystem  # without states; its inputs are the signals, its θ is η
    operators: tuple[Operator, ...]
    psi: Tape  # rows · p outputs
    Y: Tape | None  # rows outputs
    recorded: tuple[str, ...]  # signals that are no functions of time
    parametrisation: Parametrisation | None = None  # θ are the system's states then

    @property
    def rows(self) -> int:
        """Number of rows of ψ."""
        return len(self.psi.outputs) // self.system.q

    @property
    def tapes(self) -> list[Tape]:
        """Those of psi, of Y if it has a text, and of the operators' arguments."""
        of_operators = [operator.argument for operator in self.operators]
        return [self.psi, *([] if self.Y is None else [self.Y]), *of_operators]

    def on(
        self, signals: Trajectory, Y: Trajectory | None, tol: float, max_elements: int
    ) -> tuple[LinearRegression, float]:
        """The regression along signals (m,), on a mesh that resolves all that it is made of.

        Y (rows,) is needed where the text has none. ``tol`` is relative to each signal's own size;
        beside the regression comes the error estimate of its signals.
        """
        p, noise = self.system.q, list[Array]()

        def terms(mesh: Mesh, columns: Array) -> Array:
            t, points = mesh.points.ravel(), mesh.points.shape[1]
            so_far, found = np.zeros((1, columns.shape[1] + p)), list[Array]()
            for first in range(0, len(t), _AT_ONCE * points):
                part = slice(first, first + _AT_ONCE * points)
                so_far, sizes = self._terms(t[part], t[part] - t[0], columns[part], so_far[-1])
                found.append(sizes[points - 1 :: points])
            return np.concatenate(found)

        def evaluated(mesh: Mesh) -> tuple[tuple[Array, Array, Array], list[Kind]]:
            columns, psi, right = self._on_mesh(signals, mesh)
            if not noise:  # what may cancel on a first mesh is not smaller on another one
                noise.append(ROUNDING * EPS / tol * terms(mesh, columns[0])[-1])
            if right is None:
                assert Y is not None  # noqa: S101  a source gives it
                right = Y(mesh.points.ravel(), mesh.inside.ravel())
            # Each column has the unit of its parameter.
            sizes = np.maximum(largest_over_time(psi, 2), noise[0][-p:])
            sizes = np.append(np.where(sizes > 0.0, sizes, 1.0), np.abs(right).max(initial=0.0))
            products = outer_products(psi, right)
            kinds: list[Kind] = [
                *zip(columns[0].T[..., None], noise[0][:-p, None], strict=True), (right, 0.0),
                (psi, np.tile(SHARE * sizes[:-1], self.rows)),
                (products, SHARE * np.outer(sizes[:-1], sizes).ravel()),
            ]
            shape = mesh.points.shape
            found = psi.reshape(*shape, self.rows, p), right.reshape(*shape, self.rows), columns[0]
            return found, [(each.reshape(*shape, -1), floor) for each, floor in kinds]

        mesh, (psi, right, columns), error = resolve(
            evaluated, self._mesh(signals), tol=tol, max_elements=max_elements,
            name=f"regression {self.system.name}",
        )
        regression = LinearRegression(
            Trajectory(mesh, right), Trajectory(mesh, psi), self.system.unknowns,
            terms(mesh, columns)[:, -p:], parametrisation=self.parametrisation,
        )
        return regression, error

    def _terms(
        self, t: Array, elapsed: Array, columns: Array, before: Array
    ) -> tuple[Array, Array]:
        """Sizes so far of signals and of what operators act on, and of the terms of each column.

        The columns are those of ψ. At times t (N,), ``elapsed`` (N,) since the start, of signals
        and operators (N, m + operators), after what was ``before`` (m + operators + p,), as what
        comes (N, m + operators + p); beside it stand the sizes of the operators' own terms instead.
        """
        count = columns.shape[1]
        so_far = np.maximum.accumulate(np.maximum(np.abs(columns), before[:count]), axis=0)
        sizes = so_far.copy()
        for k, operator in enumerate(self.operators, count - len(self.operators)):
            argument = operator.argument.terms(t, columns, sizes)[:, 0]
            so_far[:, k] = np.maximum.accumulate(np.maximum(argument, before[k]))
            sizes[:, k] = operator.most(elapsed) * so_far[:, k]
        psi = self.psi.terms(t, columns, sizes).reshape(len(t), self.rows, -1).max(axis=1)
        psi = np.maximum.accumulate(np.maximum(psi, before[count:]), axis=0)
        return np.hstack([so_far, psi]), np.hstack([sizes, psi])

    def _mesh(self, signals: Trajectory) -> Mesh:
        """The signals' mesh with an edge wherever something jumps or has a kink, or did before."""
        mesh = signals.mesh
        start, stop = float(mesh.edges[0]), float(mesh.edges[-1])
        jumps, size = signals.values[1:, 0] - signals.values[:-1, -1], signals.values
        jumped = (np.abs(jumps) > 1e-9 * largest_over_time(size, 2)).any(axis=1)
        found = [self.system.coefficients.breakpoints(start, stop), mesh.edges[1:-1][jumped]]
        cuts = np.concatenate(found + [breakpoints(tape, start, stop) for tape in self.tapes])
        for _ in range(_LOOKS):  # integrals of what jumps are known where elements end there
            fine = Mesh(np.union1d(mesh.edges, self._delayed(cuts, start, stop)), mesh.rule)
            known = fine.trajectory(self._on_mesh(signals, fine)[0][0])
            edges = fine.edges
            for tape in self.tapes:
                followers = tape.following(range(known.values.shape[2]))
                edges, _ = resolved_along(tape, followers, known.cells, edges)
            passed = self._passed(known, edges)
            k = fine.edges.searchsorted(passed)
            gap = np.minimum(fine.edges[k] - passed, passed - fine.edges[k - 1])
            passed = passed[gap > _APART * np.abs(passed)]
            if not len(passed):
                break
            cuts = np.union1d(cuts, passed)
        return Mesh(edges, mesh.rule)

    def _delayed(self, cuts: Array, start: float, stop: float) -> Array:
        """Cuts (C,) and when they come out of delays, (number,) seconds (ConfigError: too many)."""
        for operator in self.operators:
            if operator.name == "delay":
                later = np.concatenate([[start], cuts]) + operator.number
                cuts = np.unique(np.concatenate([cuts, later[later < stop]]))
                if len(cuts) > _MAX_DELAYED:
                    raise ConfigError(
                        f"regression {self.system.name}: its delays make {len(cuts)} corners in "
                        f"the horizon; at most {_MAX_DELAYED} are followed"
                    )
        return cuts

    def _passed(self, known: Trajectory, edges: Array) -> Array:
        """Times (number,) at which operators and recorded signals pass a jump or kink of a text."""
        mesh = Mesh(edges, known.mesh.rule)
        t, found = aside(mesh.points, mesh.inside).ravel(), [np.zeros(0)]
        for tape in self.tapes:  # breakpoints are there of what is of time alone
            places = {switch.argument for switch in tape.switches} - tape.of_time
            if places:
                arguments = tape.of(sorted(places))
                found.append(switched(arguments, t, lambda t, order: known.taylor(t, order, t)))
        return np.unique(np.concatenate(found))

    def _on_mesh(self, signals: Trajectory, mesh: Mesh) -> tuple[Array, Array, Array | None]:
        """:meth:`_evaluated` at the points of a mesh, K (s + 1) of them."""
        t, inside = mesh.points.ravel(), mesh.inside.ravel()

        def outputs(tape: Tape, columns: Array) -> Array:
            found = np.asarray(tape.taylor(t, 0, inside, columns)[0])
            if tape.switches:  # at an end of an element, what jumps there is as it is within
                within = mesh.trajectory(columns[0])(aside(t, inside), inside)[None]
                other = np.asarray(tape.taylor(t, 0, inside, within)[0])
                jumped = np.abs(other - found) > _JUMPED * np.abs(found).max(axis=0, initial=0.0)
                found = np.where(jumped, other, found)
            return found

        return self._evaluated(
            signals(t, inside), outputs,
            lambda _, operator, x: operator(mesh.trajectory(x)).ravel(),
        )

    def _evaluated(
        self, signals: Array, outputs: Callable[[Tape, Array], Array],
        operate: Callable[[int, Operator, Array], Array],
    ) -> tuple[Array, Array, Array | None]:
        """Signals and operators (1, N, m + operators), ψ (N, rows, p), and Y (N, rows) of a text.

        From signals (N, m); ``outputs`` makes those of a tape (N, outputs) of the first of these,
        ``operate`` the values of an operator, of this number, of those of its argument (N,).
        """
        count, m = signals.shape
        columns = np.zeros((1, count, m + len(self.operators)))
        columns[0, :, :m] = signals
        for k, operator in enumerate(self.operators):
            x = outputs(operator.argument, columns)[:, 0]
            columns[0, :, m + k] = operate(k, operator, x)
        psi = outputs(self.psi, columns).reshape(count, self.rows, -1)
        return columns, psi, None if self.Y is None else outputs(self.Y, columns)

    def advance(
        self, hold: str, state: TextState | None, t: Array, signals: Array, Y: Array
    ) -> tuple[TextState, SampledRegression]:
        """Carry the operators over the samples at the times t (K,), ascending, after ``state.t``.

        The state is None before the first sample; signals are (K, m), and Y (K, rows), which is not
        looked at where the text has one. What comes is where it stands, and the regression
        at the samples.
        """
        reached: list[OperatorState] = []

        def operate(k: int, operator: Operator, x: Array) -> Array:
            known = OperatorState(t[:1], x[:1]) if state is None else state.operators[k]
            values, after = operator.carried(hold, known, t, x)
            reached.append(after)
            return values

        def outputs(tape: Tape, columns: Array) -> Array:
            return np.asarray(tape.taylor(t, 0, t, columns)[0])

        columns, psi, right = self._evaluated(signals, outputs, operate)
        right = Y if right is None else right
        rows = np.concatenate([psi, right.reshape(len(t), self.rows, 1)], axis=2)
        last, row = (t[0], rows[0]) if state is None else (state.t, state.row)
        start, count = last if state is None else state.start, columns.shape[2]
        before = np.zeros(count + self.system.q) if state is None else state.terms
        terms = self._terms(t, t - start, columns[0], before)[0]
        regression = SampledRegression(
            t, np.diff(t, prepend=last), np.concatenate([row[None], rows]), hold,
            self.parametrisation, terms[:, count:],
        )
        state = TextState(float(t[-1]), tuple(reached), rows[-1], terms[-1], float(start))
        return state, regression


class _Operators:
    """Collects the operators that are met while texts are parsed; equal ones are one."""

    def __init__(self, signals: Sequence[Expression]) -> None:
        self.found: dict[tuple[object, ...], Operator] = {}
        self._signals = signals
        self.calls: dict[str, tuple[int, Callable[..., Node]]] = {
            name: (2, partial(self._node, name)) for name in ("lp", "hp", "delay")
        }
        self.calls["integral"] = 1, lambda x: self._node("integral", x, nodes.number(0.0))

    def _node(self, name: str, argument: Node, number: Node) -> Node:
        what = "its rate λ" if name in ("lp", "hp") else "the delay"
        if not number.is_number or (name != "integral" and number.value <= 0.0):
            raise nodes.FoldError(f"{name}: {what} must be a positive number")
        if argument.derivatives:
            raise nodes.FoldError(
                f"{name}: d(.) cannot stand inside; make what has it a signal, or use hp, whose "
                "derivative is filtered"
            )
        tape = record([Expression(argument, name, f"argument of {name}")], self._signals)
        key = (name, tape.instructions, number.value)
        self.found.setdefault(key, Operator(name, tape, number.value))
        place = len(self._signals) + list(self.found).index(key)
        return nodes.signal(f"{name}(…)", place)


def regression_from_mapping(mapping: Mapping[str, object], source: str = "") -> TextRegression:
    """Build a regression from the plain data of its file.

    Args:
        mapping: KEYS; ``unknowns`` maps names to true values, ``signals`` names to expressions of
            t (or null: they come from a recording), ``Y`` is a list of expressions of t and the
            signals (absent: ψ times the truth), ``psi`` has one row for each. With ``S``, a list of
            expressions of the unknowns, ψ has a column for each of them, and ``box`` maps the
            unknowns to where they may lie.
        source: the file, for messages.

    Raises:
        ConfigError: anything that is missing, unknown, of the wrong size, or not an expression.
    """
    file = f" ({source})" if source else ""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"regression{file} must be a mapping with the keys {', '.join(KEYS)}")
    where = f"regression {mapping.get('name')}{file}"
    check_keys(mapping, KEYS, where)
    signals = mapping.get("signals") or {}
    if not isinstance(signals, Mapping):
        raise ConfigError(f"{where}: signals must map names to expressions, such as {{u: sin(t)}}")
    psi_rows, right = _list(mapping, "psi", where), mapping.get("Y")
    count = len(psi_rows)
    outputs = [f"Y_{i + 1}" for i in range(count)] if right is None else []
    if measured := _measured(mapping, signals):
        signals = {name: value for name, value in signals.items() if name not in measured}
        mapping, right, outputs = {**mapping, "Y": None}, None, measured
    recorded = tuple(name for name, value in signals.items() if value is None)
    signals = {name: 0 if value is None else value for name, value in signals.items()}
    unknowns = named_values(where, "unknowns", mapping.get("unknowns"), "{theta1: 1.5}")
    if not unknowns:
        raise ConfigError(f"{where}: unknowns is missing; it maps each parameter to its true value")
    parametrisation, own = _parametrisation(mapping, unknowns, len(signals), count, where)
    system = plant_from_mapping(
        {
            "states": [], "E": [], "A": [], "initial_state": [],
            **{k: v for k, v in mapping.items() if k not in ("signals", "Y", "psi", "S", "box")},
            "inputs": signals,
            "outputs": outputs,
            **own,
        },
        source, "regression",
    )
    named = {name: signal(name, k, "a signal") for k, name in enumerate(system.inputs)}
    elsewhere = dict.fromkeys((*system.unknowns, *system.states), "an unknown")
    known = named | read_parameters(where, mapping.get("parameters"), named, elsewhere)
    functions = [parse(value, known, f"{where}: signals") for value in signals.values()]
    # A number may stand for a recording or for a table, of which nobody knows here.
    of_time = [replace(one, node=UNKNOWN) if one.is_constant else one for one in functions]
    operators = _Operators(of_time)

    def read(value: object, what: str) -> Expression:
        return parse(value, known, f"{where}: {what}", elsewhere, operators.calls)

    psi: list[Expression] = []
    for i, row in enumerate(psi_rows):
        if not isinstance(row, Sequence) or isinstance(row, str) or len(row) != system.q:
            raise ConfigError(
                f"{where}: psi[{i}] must be a list with an entry for each of the {system.q} "
                f"unknowns ({', '.join(system.unknowns)}), not {shown(row)}{quoting(row)}"
            )
        psi += [read(value, f"psi[{i}][{j}]") for j, value in enumerate(row)]
    Y = None
    if right is not None:
        texts = _list(mapping, "Y", where)
        if len(texts) != count:
            raise ConfigError(
                f"{where}: Y has {len(texts)} entries and psi has {count} rows{quoting(texts)}"
            )
        Y = record([read(value, f"Y[{i}]") for i, value in enumerate(texts)], of_time)
    found = tuple(operators.found.values())
    return TextRegression(system, found, record(psi, of_time), Y, recorded, parametrisation)


def _measured(mapping: Mapping[str, object], signals: Mapping[str, object]) -> list[str]:
    """The names in Y, if it is made of recorded signals that stand nowhere else: outputs."""
    right = mapping.get("Y")
    if not isinstance(right, list) or len(right) != len(_list(mapping, "psi", "")):
        return []
    names = [str(entry).strip() for entry in right]
    elsewhere = set(re.findall(r"\w+", f"{mapping['psi']} {mapping.get('parameters')}"))
    own = all(name in signals and signals[name] is None for name in names)
    return names if own and len({*names} - elsewhere) == len(names) else []


def _parametrisation(
    mapping: Mapping[str, object], unknowns: Mapping[str, object], inputs: int, rows: int,
    where: str,
) -> tuple[Parametrisation | None, dict[str, object]]:
    """S on its box, and the keys of a system whose states are θ, which do not move: θ' = 0."""
    if mapping.get("S") is None:
        if mapping.get("box") is not None:
            raise ConfigError(f"{where}: box is for S, and there is none")
        return None, {}
    names = tuple(unknowns)
    truth = np.array([number(unknowns[k], f"{where}: unknowns.{k}", "finite") for k in names])
    low, high = read_box(mapping.get("box"), names, where)
    for name, value, ends in zip(names, truth.tolist(), np.c_[low, high].tolist(), strict=True):
        if not ends[0] <= value <= ends[1]:
            raise ConfigError(
                f"{where}: unknowns.{name} = {value:g} is not within its box, {shown(ends)}"
            )
    known = {name: signal(name, k, "an unknown") for k, name in enumerate(names)}
    entries = _list(mapping, "S", where)
    tape = record([parse(text, known, f"{where}: S[{j}]") for j, text in enumerate(entries)])
    parametrisation = Parametrisation(names, tape, low, high)
    size = len(names)
    eta = parametrisation.values(truth[None])[0]
    return parametrisation, {
        "unknowns": {f"eta_{j + 1}": float(value) for j, value in enumerate(eta)},
        "states": list(names), "initial_state": dict(zip(names, truth.tolist(), strict=True)),
        "E": np.eye(size).tolist(), "A": np.zeros((size, size)).tolist(),
        "B": np.zeros((size, inputs)).tolist(), "F": np.zeros((size, len(eta))).tolist(),
        "C": [] if mapping.get("Y") is not None else np.zeros((rows, size)).tolist(),
    }


def system_from_mapping(mapping: Mapping[str, object], source: str = "") -> DescriptorSystem:
    """The plant, or with ``psi`` the regression in place of one, that a file describes."""
    kind, key = ("regression", "signals") if "psi" in mapping else ("plant", "inputs")
    inputs, found = tables(mapping.get(key), f"{kind} {mapping.get('name')}: {key}", source)
    mapping = {**mapping, key: inputs} if found else mapping
    if key == "inputs":
        return driven(plant_from_mapping(mapping, source), found)
    regression = regression_from_mapping(mapping, source)
    regression = replace(regression, system=driven(regression.system, found))
    return replace(regression.system, regression=regression)


def _list(mapping: Mapping[str, object], key: str, where: str) -> Sequence[object]:
    value = mapping.get(key)
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ConfigError(f"{where}: {key} must be a list, one entry for each row of Y = ψη")
    return value


def simulation_of(
    system: DescriptorSystem, time: TimeSettings, solver: SolverSettings
) -> Simulation:
    """The plant's solution; of a regression its signals, with Y = ψθ where the text has none.

    ConfigError: a signal without a finite value, or one that has to be recorded.
    """
    given = system.regression
    if not isinstance(given, TextRegression):
        return simulate(system, time, solver)
    if given.recorded:
        raise ConfigError(
            f"regression {system.name}: signals.{given.recorded[0]} is null, a column of a "
            "recording; give data.file, or a function of t"
        )
    signals, bounded = signals_of_time(system, given, time, solver)
    mesh, outputs = signals.mesh, np.zeros((*signals.mesh.points.shape, 0))
    if given.Y is None:
        zero = Trajectory(mesh, np.zeros((*mesh.points.shape, given.rows)))
        regression, _ = given.on(signals, zero, solver.tol, solver.max_elements)
        mesh, outputs = regression.mesh, regression.psi.values @ system.theta
        signals = mesh.along(signals)
    theta = np.broadcast_to(system.initial_state, (*mesh.points.shape, system.n))
    return Simulation(
        Signals(signals, Trajectory(mesh, outputs), Trajectory(mesh, theta)),
        Structure(0, 0, 0, np.inf, time_invariant=True), system.initial_state, (), solver.tol,
        bounded=bounded,
    )


def signals_of_time(
    system: DescriptorSystem, given: TextRegression, time: TimeSettings, solver: SolverSettings
) -> tuple[Trajectory, bool]:
    """The signals on a mesh that resolves them, and whether nothing narrow can hide on it.

    That is said of the signals, of psi, Y and the operators' arguments as functions of time.
    """
    start, stop = time.start, time.start + time.horizon
    cuts = system.coefficients.breakpoints(start, stop)
    first = initial_mesh(start, stop, cuts, _FIRST_ELEMENTS, radau_rule(solver.stages))
    edges, bounded = system.coefficients.resolved(first.edges)
    for tape in given.tapes:
        of_time = tape.of([place for place in tape.outputs if place in tape.of_time])
        edges, short = resolved(Bounds(of_time), edges)
        bounded &= short
    for operator in given.operators:
        if operator.name == "delay":  # what is narrow comes once more
            later = np.setdiff1d(edges, first.edges) + operator.number
            edges = np.union1d(edges, later[later < stop])
    mesh = Mesh(edges, first.rule)

    def evaluated(mesh: Mesh) -> tuple[Array, list[tuple[Array, float]]]:
        u = system.coefficients.taylor(mesh.points.ravel(), 0, mesh.inside.ravel()).u[0]
        values = u.reshape(*mesh.points.shape, system.m)
        kinds = [(values[..., k : k + 1], 0.0) for k in range(system.m)]
        return values, kinds or [(np.zeros((*mesh.points.shape, 1)), 0.0)]

    mesh, values, _ = resolve(
        evaluated, mesh, tol=solver.tol, max_elements=solver.max_elements,
        name=f"regression {system.name}",
    )
    return Trajectory(mesh, values), bounded
