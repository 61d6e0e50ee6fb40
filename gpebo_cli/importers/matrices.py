"""Constant matrices as a plant: arrays, python-control, MATLAB, Matrix Market, Modelica.

Files are data: ``.mat`` is read by SciPy, ``.mtx`` by SciPy, a Modelica linearisation is parsed
as text; no code in them is run.
"""

from __future__ import annotations

import ast
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.importers.draft import PlantDraft
from gpebo_cli.model.archive import MATRICES, MAX_BYTES, read_archive, read_mat
from gpebo_cli.model.entries import is_sparse
from gpebo_cli.model.expressions.syntax import RESERVED
from gpebo_cli.model.functions import names_of
from gpebo_cli.reading import open_regular, read_text
from gpebo_cli.schema import shown

MAX_STATES = 2_000
_MAX_TEXT = 20_000_000  # bytes of a linearisation

_NAMES = "EABCD"
_KINDS = {"state": "x", "input": "u", "output": "y"}  # and what begins a name that is taken
_VARIABLES = {"stateVars": "states", "inputVars": "inputs", "outputVars": "outputs"}
_ASSIGNED = re.compile(rf"(?m)^\s*(?:local\s+)?([{_NAMES}]|x0|{'|'.join(_VARIABLES)})\s*=(?!=)\s*")
_VALUE = re.compile(  # up to the end of a line, on which a comment may stand
    r"(?ms)(?:np\.array\()?\s*([\[{].*?[\]}])\s*\)?\s*;?[^\S\n]*(?:[%#][^\n]*)?$"
)


def from_matrices(
    matrices: Mapping[str, Any], name: str, *, states: Sequence[str] | None = None,
    inputs: Mapping[str, float | str] | Sequence[str] | None = None,
    outputs: Sequence[str] | None = None, initial_state: Sequence[float] | None = None,
    title: str = "", reference: str = "",
) -> PlantDraft:
    """E x' = A x + B u + F θ, y = C x + D u + H θ with constant matrices.

    The matrices are A (n, n), and E (n, n; default: identity), B (n, m), F (n, q), C (r, n),
    D (r, m), H (r, q), dense or sparse. There are n states (default x1, x2, …) from
    ``initial_state`` (n,) or zeros, m inputs with their signals, or names alone (their signals are
    0; default u1, …), r outputs (default y1, …), and q unknowns theta1, … whose truth is 0.

    Raises:
        ConfigError: A is missing, sizes that do not fit (says both), or entries that are not real.
    """
    present = [key for key in MATRICES if matrices.get(key) is not None]
    given = {key: _real(key, matrices[key], name) for key in present}
    if "A" not in given:
        raise ConfigError(f"plant {name}: the matrix A is missing")
    n = given["A"].shape[0]
    if n > MAX_STATES:
        raise ConfigError(f"plant {name}: A has {n} states; at most {MAX_STATES} are read")
    m, q, r = (
        next((given[key].shape[axis] for key in keys if key in given), 0)
        for axis, keys in ((1, "BD"), (1, "FH"), (0, "CDH"))
    )
    sizes = {"E": (n, n), "A": (n, n), "B": (n, m), "F": (n, q), "C": (r, n), "D": (r, m),
             "H": (r, q)}
    for key, matrix in given.items():
        if matrix.shape != sizes[key]:
            got, expected = (" × ".join(map(str, size)) for size in (matrix.shape, sizes[key]))
            raise ConfigError(f"plant {name}: {key} is {got}; expected {expected}")
    draft = PlantDraft(name, title or f"matrices {name}", reference)
    start = np.zeros(n) if initial_state is None else np.asarray(initial_state, dtype=float)
    labels = names_of("states", states, "x", n, name)
    if start.shape != (n,):
        raise ConfigError(f"plant {name}: initial_state has {start.size} values for {n} states")
    draft.states.update({s: (float(v), "") for s, v in zip(labels, start, strict=True)})
    signals = inputs if isinstance(inputs, Mapping) else {}
    columns = names_of("inputs", None if inputs is None else list(inputs), "u", m, name)
    draft.inputs.update({u: (signals.get(u, 0.0), "") for u in columns})
    draft.unknowns.update({f"theta{j + 1}": (0.0, "") for j in range(q)})
    draft.outputs.update(dict.fromkeys(names_of("outputs", outputs, "y", r, name), ""))
    for i in range(n):
        draft.equation(f"equation {i + 1}")
    for key, matrix in {"E": np.eye(n), **given}.items():
        draft.add_matrix(key, matrix)
    return draft


def from_control(system: Any, name: str, **options: Any) -> PlantDraft:
    """A state-space model of python-control or SciPy, or anything with A, B, C, D (and E).

    Args:
        system: with attributes ``A, B, C, D``, perhaps ``E``, ``dt`` and labels.
        name: of the plant.
        options: as in :func:`from_matrices`; labels of the model are kept.

    Raises:
        ConfigError: a discrete-time model, or one without A.
    """
    dt = getattr(system, "dt", None)
    if dt not in (None, 0):
        raise ConfigError(
            f"plant {name}: the model is in discrete time (dt = {dt}), and gpebo's plants are "
            "differential equations; convert it to continuous time first"
        )
    if not hasattr(system, "A"):
        kind = type(system).__name__
        raise ConfigError(f"plant {name}: {kind} has no A; give a state-space model")
    matrices = {key: getattr(system, key, None) for key in _NAMES}
    labels = {f"{kind}s": getattr(system, f"{kind}_labels", None) for kind in _KINDS}
    return from_matrices(matrices, name, **{**_identifiers(labels), **options})


def read_matrices(path: Path) -> dict[str, Any]:
    """Matrices and names in a file or folder.

    A ``.mat`` or ``.npz`` file with E, A, B, C, D; a folder of Matrix Market files whose names end
    in ``.E.mtx``, ``_A.mtx`` or are ``B.mtx``; a linearisation by OpenModelica as Python (``.py``),
    MATLAB (``.m``) or Julia (``.jl``) text with ``A = [...]`` (ConfigError: nothing that can be
    read; names the file and what was expected).
    """
    if path.is_dir():
        return _matrix_market(path)
    ending = path.suffix.lower()
    if ending == ".mat":
        return _matlab(path)
    if ending == ".npz":
        return read_archive(str(path))
    if ending in (".py", ".m", ".jl"):
        return _modelica(path)
    raise ConfigError(
        f"{path}: expected a netlist (.cir .net .sp .spice .ckt), a mechanism (.yaml), or matrices "
        "(a .mat, .npz, .py, .m or .jl file, or a folder of .mtx files)"
    )


def _matlab(path: Path) -> dict[str, Any]:
    content = read_mat(str(path), [*_NAMES, "M", "K"])
    found = {key: content[key] for key in _NAMES if key in content}
    if {"M", "K"} <= content.keys():  # of a second-order system beside it, whose damping is D
        found.pop("D", None)
    if "A" not in found:
        raise ConfigError(f"{path} has no matrix A; expected A and, if there are any, E, B, C, D")
    return found


def _matrix_market(folder: Path) -> dict[str, Any]:
    from scipy.io import mminfo, mmread

    found: dict[str, Any] = {}
    for path in sorted(folder.glob("*.mtx")):
        match = re.search(r"(?:^|[._-])([EABCD])\.mtx$", path.name)
        if match is None:
            continue
        if match[1] in found:
            raise ConfigError(f"{folder} has two files for {match[1]}; give a folder of one system")
        with open_regular(path) as stream:
            size = os.fstat(stream.fileno()).st_size
        try:
            rows, columns, entries, *_ = mminfo(path)
            if size > MAX_BYTES or max(rows, columns) > MAX_STATES or entries > size:
                raise ConfigError(
                    f"{path} has {size} bytes with {rows} × {columns} entries; at most {MAX_BYTES} "
                    f"bytes and {MAX_STATES} rows and columns are read"
                )
            with warnings.catch_warnings(action="ignore"):  # any of SciPy's two kinds of sparse
                found[match[1]] = mmread(path)
        except (ValueError, OverflowError) as error:
            raise ConfigError(f"{path} is no Matrix Market file ({error})") from None
    if "A" not in found:
        raise ConfigError(f"{folder} has no file A.mtx or NAME.A.mtx")
    return found


def _modelica(path: Path) -> dict[str, Any]:
    """``A = [1, 2; 3, 4]`` of MATLAB or Julia text, or ``A = [[1, 2], [3, 4]]`` of Python text."""
    text = read_text(path, _MAX_TEXT)
    found: dict[str, Any] = {}
    for match in _ASSIGNED.finditer(text):
        word, value = match[1], _VALUE.match(text, match.end())
        where = f"{path}: {word}"
        if value is None and text.startswith(("zeros(", "np.zeros("), match.end()):
            continue  # without inputs, B is zeros(2, 0)
        if value is None:
            raise ConfigError(f"{where} is not read; expected numbers in brackets, or zeros(…)")
        if word == "x0":
            items = re.split(r"[,;\s]+", value[1][1:-1].strip())
            found["initial_state"] = [_float(item, where) for item in items]
        elif word in _VARIABLES:
            found[_VARIABLES[word]] = [x for _, x in re.findall(r"(['\"])(.*?)\1", value[1])]
        else:
            matrix = _bracketed(value[1], where)
            if matrix.size:  # or B is []
                found[word] = matrix
    if "A" not in found:
        raise ConfigError(f"{path} has no line A = [...]; expected the text of a linear model")
    return found | _identifiers(found)


def _bracketed(text: str, where: str) -> np.ndarray[Any, Any]:
    try:
        value = ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        rows = [row for row in text.strip("[]").split(";") if row.strip()]
        value = [
            [_float(item, where) for item in row.replace(",", " ").split()] for row in rows
        ]
    try:
        return np.atleast_2d(np.asarray(value, dtype=np.float64))
    except (ValueError, TypeError):
        raise ConfigError(f"{where} has rows of different lengths") from None


def _float(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{where}: {shown(text)} is not a number") from None


def _identifiers(labels: Mapping[str, Any]) -> dict[str, list[str]]:
    """Names that can stand in a plant, each once: other characters become _, and y_x is not x."""
    taken, found = set(RESERVED), dict[str, list[str]]()
    for kind, letter in _KINDS.items():
        for label in labels.get(f"{kind}s") or ():
            name = re.sub(r"\W+", "_", str(label), flags=re.ASCII).strip("_")
            while not name or name[0].isdigit() or name in taken:
                name = f"{letter}_{name}"
            taken.add(name)
            found.setdefault(f"{kind}s", []).append(name)
    return found


def _real(key: str, value: Any, plant: str) -> Any:
    """A matrix of finite real numbers, sparse ones as they are."""
    matrix = value if is_sparse(value) else np.atleast_2d(np.asarray(value))
    data = matrix.tocoo().data if is_sparse(matrix) else matrix
    if not np.issubdtype(data.dtype, np.number) or (np.iscomplexobj(data) and data.imag.any()):
        raise ConfigError(f"plant {plant}: {key} is not a matrix of real numbers")
    if not np.isfinite(data).all():
        raise ConfigError(f"plant {plant}: {key} has an entry that is not finite")
    return matrix.real if np.iscomplexobj(data) else matrix
