"""Constrained mechanics, M q'' + D q' + K q = Gᵀ λ + B u + F θ, G q = r(t), as a plant.

States are positions, velocities and constraint forces. With M symmetric positive definite and G of
full row rank the index is 3, without constraints 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.importers.draft import Entry, PlantDraft
from gpebo_cli.schema import per_name, plain, read

Matrix = list[list[Entry]]
MAX_POSITIONS = 1_000


@dataclass(frozen=True)
class Model:
    """The keys of a mechanical model with k positions, c constraints, m inputs and q unknowns.

    Entries are numbers, or expressions of t and of the parameters; matrices are lists of rows.
    """

    M: Matrix  # (k, k)
    D: Matrix = field(default_factory=list)  # (k, k)
    K: Matrix = field(default_factory=list)  # (k, k)
    G: Matrix = field(default_factory=list)  # (c, k)
    B: Matrix = field(default_factory=list)  # (k, m)
    F: Matrix = field(default_factory=list)  # (k, q)
    r: list[Entry] = field(default_factory=list)  # (c,)
    positions: list[str] = field(default_factory=list)  # (k,) by default q1, …
    inputs: Mapping[str, Entry] = field(default_factory=dict)
    unknowns: Mapping[str, Entry] = field(default_factory=dict)
    parameters: Mapping[str, Entry] = field(default_factory=dict)
    measure: list[str] = field(default_factory=list)  # positions, velocities and forces
    initial_positions: object = field(default_factory=dict)  # by position, in order, or one for all
    initial_velocities: object = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    title: str = ""
    reference: str = ""


def from_mechanics(model: Mapping[str, object], name: str, source: str = "") -> PlantDraft:
    """The plant of a mechanical model.

    Args:
        model: M and, where there are any, ``D``, ``K``, ``G``, ``B``, ``F``, ``r``, ``positions``,
            ``inputs``, ``unknowns``, ``measure`` and so on, as :class:`Model` has them; arrays and
            SciPy's sparse matrices stand for lists of rows.
        name: of the plant; velocities are v_<position>, forces of constraints lambda1, ….
        source: the file, for messages.

    Raises:
        ConfigError: an unknown key, or a size that does not fit; says both numbers.
    """
    where = source or name
    given = read(Model, plain({k: v for k, v in model.items() if v is not None}), where)
    k, c = len(given.M), len(given.G)
    if not (0 < k <= MAX_POSITIONS and c <= MAX_POSITIONS):
        raise ConfigError(f"{where}: M has {k} rows and G {c}; 1 to {MAX_POSITIONS} are read")
    sizes = {"M": (k, k), "D": (k, k), "K": (k, k), "G": (c, k), "B": (k, len(given.inputs)),
             "F": (k, len(given.unknowns))}
    M, D, K, G, B, F = (
        _sized(getattr(given, key), *size, f"{where}: {key}", needed=key in "BF")
        for key, size in sizes.items()
    )
    positions = given.positions or [f"q{i + 1}" for i in range(k)]
    if len(positions) != k:
        raise ConfigError(f"{where}: positions has {len(positions)} names and M has {k} rows")
    if len(given.r) not in (0, c):
        raise ConfigError(f"{where}: r has {len(given.r)} entries, and there are {c} constraints")
    velocities = [f"v_{position}" for position in positions]
    forces = [f"lambda{i + 1}" for i in range(c)]
    # A motion that a constraint follows is an input.
    followed = {f"r{j + 1}": entry for j, entry in enumerate(given.r) if entry != 0}
    names = [*positions, *velocities, *forces, *given.inputs, *followed, *given.unknowns]
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise ConfigError(
            f"{where}: {twice} is the name of two things; velocities are v_<position>, forces "
            "lambda1, …, and motions that constraints follow r1, …"
        )

    draft = PlantDraft(
        name, given.title or f"mechanism {name}", given.reference or source,
        comments=["M q'' + D q' + K q = G' lambda + B u + F theta,  G q = r"],
        parameters=dict(given.parameters),
    )
    start: list[float] = []
    for key in ("initial_positions", "initial_velocities"):
        start += per_name(
            getattr(given, key), positions, "position", f"{where}: {key}", "finite", absent=0.0
        ).tolist()
    start += [0.0] * c
    for state, value in zip([*positions, *velocities, *forces], start, strict=True):
        draft.states[state] = (value, given.units.get(state, ""))
    for group, values in ((draft.inputs, given.inputs), (draft.unknowns, given.unknowns)):
        group.update({
            label: (value, given.units.get(label, "")) for label, value in values.items()
        })

    for position, velocity in zip(positions, velocities, strict=True):
        draft.equation(f"{position}' = {velocity}")
    for position in positions:
        draft.equation(f"balance of forces along {position}")
    for j in range(c):  # 0 = G q − r
        row = draft.equation(f"constraint {j + 1}: G q = r")
        if (name := f"r{j + 1}") in followed:
            draft.inputs[name] = (followed[name], "")
            draft.add("B", row, name, -1.0)
    one = np.eye(k)
    draft.add_matrix("E", one, columns=positions)
    draft.add_matrix("A", one, columns=velocities)
    draft.add_matrix("E", M, k, velocities)
    draft.add_matrix("A", D, k, velocities, sign=-1)
    draft.add_matrix("A", K, k, positions, sign=-1)
    draft.add_matrix("A", [*zip(*G, strict=True)], k, forces)
    draft.add_matrix("A", G, 2 * k, positions)
    draft.add_matrix("B", B, k)
    draft.add_matrix("F", F, k)
    draft.measure(given.measure, f"{where}: ")
    return draft


def linearise(
    equations: Sequence[Any], constraints: Sequence[Any], motion: Mapping[Any, Any],
    multipliers: Sequence[Any],
) -> dict[str, object]:
    """The keys ``positions``, M, D, K and G of a multibody model about a motion, by SymPy.

    With q = q₀ + δq, λ = λ₀ + δλ in equations(q'', q', q, t) = Gᵀλ and constraints(q, t) = 0, G the
    constraints' derivative, small δ follow M δq'' + D δq' + K δq = Gᵀ δλ and G δq = 0.

    Args:
        equations: k SymPy expressions of the coordinates (functions of ``t``) and derivatives.
        constraints: c expressions of the coordinates.
        motion: each coordinate q_i(t) and the expression of ``t`` that it follows, q₀.
        multipliers: c expressions of ``t``, λ₀.

    Raises:
        ImportError: SymPy, which made the expressions, is not installed.
    """
    import sympy  # type: ignore[import-untyped]

    t = sympy.Symbol("t")
    levels = [[coordinate.diff(t, order) for coordinate in motion] for order in (2, 1, 0)]
    followed = [
        (variable, sympy.diff(path, t, order))
        for order, level in zip((2, 1, 0), levels, strict=True)
        for variable, path in zip(level, motion.values(), strict=True)
    ]
    # Derivatives stand as symbols, so that each can be differentiated by alone.
    plain = {variable: sympy.Dummy() for level in levels for variable in level}

    def derivative(what: Any, order: int) -> list[list[str]]:
        variables = [plain[variable] for variable in levels[2 - order]]
        found = what.subs(list(plain.items())).jacobian(variables)
        back = found.subs([(symbol, variable) for variable, symbol in plain.items()])
        return [[str(entry) for entry in row] for row in back.subs(followed).tolist()]

    held, forces = (sympy.Matrix(len(part), 1, list(part)) for part in (constraints, multipliers))
    reaction = held.jacobian(list(motion)).T * forces
    rest = sympy.Matrix(equations) - reaction
    return {
        "positions": [str(coordinate.func) for coordinate in motion],
        "M": derivative(rest, 2), "D": derivative(rest, 1), "K": derivative(rest, 0),
        "G": derivative(held, 0),
    }


def _sized(matrix: Matrix, rows: int, columns: int, where: str, *, needed: bool) -> Matrix:
    """A matrix of the size that is asked for, or none if it is not ``needed``."""
    if (matrix or (needed and columns)) and len(matrix) != rows:
        raise ConfigError(f"{where} has {len(matrix)} rows; expected {rows}")
    for i, row in enumerate(matrix):
        if len(row) != columns:
            raise ConfigError(f"{where}[{i}] has {len(row)} entries; expected {columns}")
    return matrix
