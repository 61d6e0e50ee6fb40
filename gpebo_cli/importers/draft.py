"""A plant under construction: rows and columns by name, written as a person would write it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.archive import ARCHIVE, MATRICES, archive_of
from gpebo_cli.model.entries import is_sparse
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.schema import nearest, shown

Entry = float | str

MAX_IN_TEXT = 50
"""States of a plant whose matrices are written as text; those of larger ones are in an archive."""

_WIDTH = 96  # of a written line, where it can be broken


@dataclass
class PlantDraft:
    """Equations are added one by one, entries as sums of terms; :meth:`mapping` is the plant.

    Attributes:
        name: of the plant, and of its file.
        title: one line for people.
        reference: where it is from.
        comments: lines at the top of the file.
    """

    name: str
    title: str = ""
    reference: str = ""
    comments: list[str] = field(default_factory=list)
    parameters: dict[str, Entry] = field(default_factory=dict)
    states: dict[str, tuple[Entry, str]] = field(default_factory=dict)  # initial value, unit
    inputs: dict[str, tuple[Entry, str]] = field(default_factory=dict)  # signal, unit
    unknowns: dict[str, tuple[Entry, str]] = field(default_factory=dict)  # truth, unit
    outputs: dict[str, str] = field(default_factory=dict)  # unit
    rows: list[str] = field(default_factory=list)  # what each equation says
    _terms: dict[str, dict[tuple[int, str], list[Entry]]] = field(
        default_factory=lambda: {name: {} for name in MATRICES}
    )

    def equation(self, says: str) -> int:
        """A new row of E x' = A x + B u + F θ; its number."""
        self.rows.append(says)
        return len(self.rows) - 1

    def add(self, matrix: str, row: int, column: str, term: Entry) -> None:
        """Add a term to the entry of a matrix (E, A, B, F, C, D or H) in a row and a column."""
        self._terms[matrix].setdefault((row, column), []).append(term)

    def add_matrix(
        self, matrix: str, values: object, first: int = 0, columns: Sequence[str] = (),
        sign: int = 1,
    ) -> None:
        """Add what is not zero of ± ``values`` in rows from the first on, and columns or all."""
        columns = columns or self._columns(matrix)
        for i, j, value in _nonzero(values):
            text = isinstance(value, str) and sign < 0
            self.add(matrix, first + i, columns[j], f"-({value})" if text else sign * value)

    def measure(self, names: Iterable[str], where: str) -> None:
        """Make states the outputs, in place of those there are.

        A message begins with ``where``.

        Raises:
            ConfigError: no such state.
        """
        self.outputs.clear()
        for matrix in "CDH":
            self._terms[matrix].clear()
        for row, name in enumerate(dict.fromkeys(names)):
            if name not in self.states:
                raise ConfigError(
                    f"{where}measure has {shown(name)}, which is no state"
                    f"{nearest(name, self.states)} (there are {', '.join(self.states)})"
                )
            self.outputs[f"y_{name}"] = self.states[name][1]
            self.add("C", row, name, 1.0)

    def make_unknown(self, names: Iterable[str]) -> None:
        """Turn constant inputs into unknown parameters: their columns of B and D move to F and H.

        Raises:
            ConfigError: no such input, or one that is not constant.
        """
        for name in names:
            if name not in self.inputs:
                raise ConfigError(
                    f"plant {self.name}: {name} cannot be an unknown, it is no source; sources: "
                    f"{', '.join(self.inputs) or 'none'}"
                )
            value, unit = self.inputs[name]
            if isinstance(value, str):
                raise ConfigError(
                    f"plant {self.name}: {name} is {shown(value)}, and an unknown is a constant; "
                    "give the source one number, or leave it an input"
                )
            self.unknowns[name] = (value, unit)
            del self.inputs[name]
            for known, unknown in (("B", "F"), ("D", "H")):
                for key in [key for key in self._terms[known] if key[1] == name]:
                    self._terms[unknown][key] = self._terms[known].pop(key)

    def mapping(self) -> dict[str, object]:
        """The plant as the plain data of its file; large matrices of numbers are SciPy's sparse."""
        text: dict[str, object] = {
            "name": self.name,
            "title": self.title or None,
            "reference": self.reference or None,
            "parameters": dict(self.parameters),
            "states": list(self.states),
            "inputs": {name: value for name, (value, _) in self.inputs.items()},
            "unknowns": {name: value for name, (value, _) in self.unknowns.items()},
            "outputs": list(self.outputs),
            "E": self._grid("E"),
            "A": self._grid("A"),
        }
        for matrix in "BFCDH":
            size = self._height(matrix) * len(self._columns(matrix))
            if self._terms[matrix] or (matrix in "BFC" and size):
                text[matrix] = self._grid(matrix)
        text["initial_state"] = {name: value for name, (value, _) in self.states.items()}
        valued = {**self.states, **self.inputs, **self.unknowns}
        units = {name: unit for name, (_, unit) in valued.items()} | self.outputs
        text["units"] = {name: unit for name, unit in units.items() if unit}
        return {
            key: value for key, value in text.items()
            if value is not None and (not isinstance(value, dict | list) or value)
        }

    def to_yaml(self, archive: str = "") -> str:
        """The text of the plant's file, with a comment for every equation.

        The file ``archive`` has the matrices of :meth:`archived`; empty: the text has all.
        """
        plant, comments = self.mapping(), self.comments
        if archive:
            apart = self.archived()
            plant = {key: value for key, value in plant.items() if key not in apart}
            plant["parameters"] = self._used(plant)
            plant[ARCHIVE] = archive
            comments = [*comments, *(f"row {i}: {says}" for i, says in enumerate(self.rows, 1))]
        lines = [f"# {line}".rstrip() for line in comments]
        for key, value in plant.items():
            if key in self._terms:
                lines += ["", *self._matrix_lines(key, value)]
            elif isinstance(value, dict) and key in ("parameters", "inputs", "unknowns"):
                lines += ["", f"{key}:"]
                lines += [f"  {_scalar(label)}: {_scalar(item)}" for label, item in value.items()]
            else:
                lines += [""] * (key in ("states", "initial_state"))
                written = [f"{key}: {_scalar(value)}"]
                if isinstance(value, list | dict):
                    written = yaml.safe_dump(
                        {key: value}, default_flow_style=None, sort_keys=False, width=_WIDTH,
                        allow_unicode=True,
                    ).splitlines()
                lines += written
        return "\n".join([*lines, ""])

    def files(self) -> dict[str, bytes]:
        """What to write, by name: the plant's file, with an archive where the plant is large."""
        matrices = self.archived()
        archive = f"{self.name}.npz" if matrices else ""
        text = {f"{self.name}.yaml": self.to_yaml(archive).encode()}
        return {archive: archive_of(matrices), **text} if matrices else text

    def archived(self) -> Mapping[str, object]:
        """Matrices of a large plant that are constant, as SciPy's sparse ones, for an archive."""
        if len(self.states) <= MAX_IN_TEXT:
            return {}
        from scipy.sparse import coo_array

        given = self.mapping()
        coefficients = plant_from_mapping(given).coefficients
        found = coefficients.taylor(np.zeros(1), 0)
        constant = [key for key in MATRICES if key in given and key in coefficients.constant]
        return {key: coo_array(getattr(found, key)[0, 0]) for key in constant}

    def _used(self, plant: Mapping[str, object]) -> dict[str, Entry]:
        """Parameters that some other text of the plant needs."""
        texts = [str(value) for key, value in plant.items() if key != "parameters"]
        words = set(re.findall(r"[A-Za-z_]\w*", " ".join(texts)))
        used: dict[str, Entry] = {}
        for name, value in reversed(self.parameters.items()):  # each uses only those above it
            if name in words:
                used[name] = value
                words.update(re.findall(r"[A-Za-z_]\w*", str(value)))
        return dict(reversed(used.items()))

    def _columns(self, matrix: str) -> list[str]:
        of = {"B": self.inputs, "D": self.inputs, "F": self.unknowns, "H": self.unknowns}
        return list(of.get(matrix, self.states))

    def _height(self, matrix: str) -> int:
        return len(self.outputs) if matrix in "CDH" else len(self.rows)

    def _grid(self, matrix: str) -> object:
        terms, columns = self._terms[matrix], self._columns(matrix)
        if len(self.states) > MAX_IN_TEXT and not any(
            isinstance(term, str) for given in terms.values() for term in given
        ):
            from scipy.sparse import coo_array

            place = {name: k for k, name in enumerate(columns)}
            rows, names = zip(*terms, strict=True) if terms else ((), ())
            return coo_array(
                ([float(_sum(given)) for given in terms.values()],
                 (rows, [place[name] for name in names])),
                shape=(self._height(matrix), len(columns)),
            )
        return [
            [_sum(terms.get((row, column), [])) for column in columns]
            for row in range(self._height(matrix))
        ]

    def _matrix_lines(self, matrix: str, given: Any) -> list[str]:
        grid = given if isinstance(given, list) else given.toarray().tolist()
        notes = list(self.outputs) if matrix in "CDH" else self.rows
        written = ["  - [" + ", ".join(map(_scalar, row)) + "]" for row in grid]
        longest = max((len(line) for line in written), default=0)
        if longest > _WIDTH:  # the comment stands above a row that fills the line
            pairs = zip(written, notes, strict=True)
            body = [line for row, note in pairs for line in (f"  # {note}", row)]
        else:
            body = [f"{row:<{longest}}  # {note}" for row, note in zip(written, notes, strict=True)]
        return [f"{matrix}:", *body]


def _nonzero(values: object) -> Iterable[tuple[int, int, Entry]]:
    """Row, column and value of what is not zero in a dense, sparse or nested matrix."""
    if is_sparse(values):
        sparse = values.tocoo()
        order = np.lexsort((sparse.col, sparse.row))
        for k in order.tolist():
            if sparse.data[k] != 0:
                yield int(sparse.row[k]), int(sparse.col[k]), float(sparse.data[k])
        return
    for i, row in enumerate(np.asarray(values, dtype=object)):
        for j, value in enumerate(row):
            if isinstance(value, str) or value != 0:
                yield i, j, value if isinstance(value, str) else float(value)


def _sum(terms: list[Entry]) -> Entry:
    """The terms as one entry: numbers are added up, texts are joined by their signs."""
    number = sum(term for term in terms if not isinstance(term, str))
    text = [term for term in terms if isinstance(term, str)]
    if not text:
        return int(number) if abs(number) < 1e15 and number == int(number) else number
    if number:
        text.insert(0, repr(float(number)))
    out = text[0]
    for term in text[1:]:
        out += f" - {term[1:]}" if term.startswith("-") else f" + {term}"
    return out


def _scalar(value: object) -> str:
    """One value as YAML writes it inside a list."""
    if isinstance(value, float) and abs(value) < 1e15 and value == int(value):
        value = int(value)
    if isinstance(value, str):
        value = value.replace("${", "$ {")  # which no plant file may have: of a netlist's title
    written = yaml.safe_dump([value], default_flow_style=True, width=10**9, allow_unicode=True)
    return written.strip()[1:-1]
