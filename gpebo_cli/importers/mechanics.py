"""Constrained mechanics, M q'' + D q' + K q = Gᵀ λ + B u + F θ, G q = r(t), as a plant.

States are positions, velocities and constraint forces. With M symmetric positive definite and G of
full row rank the index is 3, without constraints 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.importers.draft import Entry, PlantDraft
from gpebo_cli.schema import check_keys, per_name, shown

KEYS = (
    "title", "reference", "parameters", "positions", "inputs", "unknowns", "M", "D", "K", "G", "B",
    "F", "r", "measure", "initial_positions", "initial_velocities", "units",
)
"""Keys of a mechanical model; only M is required."""
MAX_POSITIONS = 1_000


def from_mechanics(model: Mapping[str, object], name: str, source: str = "") -> PlantDraft:
    """The plant of a mechanical model.

    Args:
        model: KEYS with matrices as lists of rows, entries numbers or expressions of t and of the
            parameters: ``M``, ``D``, ``K`` (k × k), ``G`` (c × k), ``B`` (k × m), ``F`` (k × q),
            ``r`` (c), names ``positions`` (default q1, …), ``inputs`` and ``unknowns`` (name to
            value), ``measure`` (names of positions, velocities and forces).
        name: of the plant; velocities are v_<position>, forces of constraints lambda1, ….
        source: the file, for messages.

    Raises:
        ConfigError: an unknown key, or a size that does not fit; says both numbers.
    """
    where = f"{source or name}: "
    check_keys(model, KEYS, source or name)
    M = _matrix(model, "M", None, None, where)
    k = len(M)
    if k == 0:
        raise ConfigError(f"{where}M is missing; it has a row and a column for each position")
    M, D, K = (_matrix(model, key, k, k, where) for key in "MDK")
    G = _matrix(model, "G", None, k, where)
    inputs, unknowns = (_named(model, key, where) for key in ("inputs", "unknowns"))
    B = _matrix(model, "B", k, len(inputs), where)
    F = _matrix(model, "F", k, len(unknowns), where)
    given = model.get("positions")
    positions = [f"q{i + 1}" for i in range(k)] if given is None else _list(given, where)
    if len(positions) != k:
        raise ConfigError(f"{where}positions has {len(positions)} names and M has {k} rows")
    velocities = [f"v_{position}" for position in positions]
    forces = [f"lambda{i + 1}" for i in range(len(G))]

    draft = PlantDraft(
        name, str(model.get("title") or f"mechanism {name}"),
        str(model.get("reference") or source),
        comments=["M q'' + D q' + K q = G' lambda + B u + F theta,  G q = r"],
        parameters=_named(model, "parameters", where),
    )
    units = {label: str(unit) for label, unit in _mapping(model, "units", where, "texts").items()}
    start = [
        *_start(model, "initial_positions", positions, where),
        *_start(model, "initial_velocities", positions, where), *[0.0] * len(forces),
    ]
    for state, first in zip([*positions, *velocities, *forces], start, strict=True):
        draft.states[state] = (first, units.get(state, ""))
    for group, values in ((draft.inputs, inputs), (draft.unknowns, unknowns)):
        group.update({label: (value, units.get(label, "")) for label, value in values.items()})

    for position, velocity in zip(positions, velocities, strict=True):
        row = draft.equation(f"{position}' = {velocity}")
        draft.add("E", row, position, 1.0)
        draft.add("A", row, velocity, 1.0)
    terms = (
        ("E", M, velocities, 1), ("A", D, velocities, -1), ("A", K, positions, -1),
        ("B", B, list(inputs), 1), ("F", F, list(unknowns), 1),
        ("A", [[line[i] for line in G] for i in range(k)], forces, 1),
    )
    for i in range(k):
        row = draft.equation(f"balance of forces along {positions[i]}")
        for matrix, rows, columns, sign in terms:
            for entry, column in zip(rows[i], columns, strict=True):
                _put(draft, matrix, row, column, entry, sign)
    _constraints(draft, G, _right_hand_side(model, len(G), where), positions)
    measured = model.get("measure")
    draft.measure([] if measured is None else _list(measured, where), where)
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

    held = sympy.Matrix(constraints)
    reaction = held.jacobian(list(motion)).T * sympy.Matrix(multipliers)
    rest = sympy.Matrix(equations) - reaction
    return {
        "positions": [str(coordinate.func) for coordinate in motion],
        "M": derivative(rest, 2), "D": derivative(rest, 1), "K": derivative(rest, 0),
        "G": derivative(held, 0),
    }


def _constraints(
    draft: PlantDraft, G: list[list[Entry]], r: list[Entry], positions: Sequence[str]
) -> None:
    """Rows 0 = G q − r; an r that is not zero is an input."""
    for j in range(len(G)):
        row = draft.equation(f"constraint {j + 1}: G q = r")
        for entry, column in zip(G[j], positions, strict=True):
            _put(draft, "A", row, column, entry, 1)
        if r[j] != 0:
            draft.inputs[f"r{j + 1}"] = (r[j], "")
            draft.add("B", row, f"r{j + 1}", -1.0)


def _put(draft: PlantDraft, matrix: str, row: int, column: str, entry: Entry, sign: int) -> None:
    if isinstance(entry, str):
        draft.add(matrix, row, column, entry if sign > 0 else f"-({entry})")
    elif entry != 0:
        draft.add(matrix, row, column, sign * entry)


def _list(value: object, where: str) -> list[str]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise ConfigError(f"{where}expected a list of names, got {shown(value)}")
    return [str(item) for item in value]


def _named(model: Mapping[str, object], key: str, where: str) -> dict[str, Entry]:
    given = _mapping(model, key, where)
    return {label: _entry(item, f"{where}{key}.{label}") for label, item in given.items()}


def _mapping(
    model: Mapping[str, object], key: str, where: str, to: str = "values"
) -> dict[str, object]:
    value = model.get(key) or {}
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}{key} maps names to {to}, got {shown(value)}")
    return {str(label): item for label, item in value.items()}


def _entry(value: object, where: str) -> Entry:
    if isinstance(value, bool) or not isinstance(value, int | float | str | np.number):
        raise ConfigError(f"{where}: expected a number or an expression, got {shown(value)}")
    return value if isinstance(value, str) else float(value)


def _matrix(
    model: Mapping[str, object], key: str, rows: int | None, columns: int | None, where: str
) -> list[list[Entry]]:
    """A matrix as rows of entries; absent: zeros of the size asked for, or no rows."""
    value = model.get(key)
    if value is None:
        return [[0.0] * (columns or 0) for _ in range(rows or 0)]
    if hasattr(value, "toarray"):
        value = value.toarray()
    if isinstance(value, np.ndarray):
        value = np.atleast_2d(value).tolist()
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise ConfigError(f"{where}{key} must be a list of rows, got {shown(value)}")
    if max([len(value), *(len(row) for row in value if isinstance(row, Sequence))]) > MAX_POSITIONS:
        raise ConfigError(f"{where}{key} has more than {MAX_POSITIONS} rows or columns")
    out = []
    for i, row in enumerate(value):
        if not isinstance(row, Sequence) or isinstance(row, str):
            raise ConfigError(f"{where}{key}[{i}] must be a list, got {shown(row)}")
        if columns is not None and len(row) != columns:
            raise ConfigError(f"{where}{key}[{i}] has {len(row)} entries; expected {columns}")
        out.append([_entry(item, f"{where}{key}[{i}][{j}]") for j, item in enumerate(row)])
    if rows is not None and len(out) != rows:
        raise ConfigError(f"{where}{key} has {len(out)} rows; expected {rows}")
    return out


def _right_hand_side(model: Mapping[str, object], count: int, where: str) -> list[Entry]:
    value = model.get("r")
    if value is None:
        return [0.0] * count
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
        raise ConfigError(f"{where}r is a list with an entry for each of the {count} constraints")
    return [_entry(item, f"{where}r[{j}]") for j, item in enumerate(value)]


def _start(
    model: Mapping[str, object], key: str, positions: Sequence[str], where: str
) -> list[float]:
    value = model.get(key)
    if value is None:
        return [0.0] * len(positions)
    value = list(value) if isinstance(value, np.ndarray) else value
    found = per_name(value, positions, "position", f"{where}{key}", "finite", absent=0.0)
    return [float(number) for number in found]
