"""Plants in other units: physics that does not change."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np


class Units(NamedTuple):
    """By what states, unknowns, inputs, outputs, equations and time are multiplied."""

    states: np.ndarray
    unknowns: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    equations: np.ndarray
    time: float


def drawn(rng, system, *, decades):
    """Powers of ten between 1e-6 and 1e6, or any factors between; of either sign, but of time."""
    def factors(count):
        power = rng.integers(-6, 7, count) if decades else rng.uniform(-6, 6, count)
        return 10.0**power

    return Units(*(factors(n) * rng.choice([-1.0, 1.0], n)
                   for n in (system.n, system.q, system.m, system.r, system.n)),
                 float(factors(1)[0]))


def in_units(content, units):
    """A plant, as a mapping with matrices as lists of rows, in other units."""
    s, k, d, c, e, T = (np.asarray(part).tolist() for part in units)
    names = {"t": T, **dict(zip(content.get("inputs", {}), d, strict=True)),
             **dict(zip(content.get("outputs", []), c, strict=True))}

    def text(entry):
        found = re.sub(r"\bd\(", f"{T!r}*d(", str(entry))
        return re.sub(r"\b[A-Za-z_]\w*\b", lambda m: (
            f"({m[0]}/{names[m[0]]!r})" if m[0] in names else m[0]), found)

    def matrix(name, rows, columns):
        return [[f"({text(entry)})*{row!r}/{column!r}" if entry else 0
                 for entry, column in zip(line, columns, strict=True)]
                for line, row in zip(content[name], rows, strict=True)]

    found = dict(content)
    layout = {"E": ([T * row for row in e], s), "A": (e, s), "B": (e, d), "F": (e, k),
              "C": (c, s), "D": (c, d), "H": (c, k)}
    for name, (rows, columns) in layout.items():
        if content.get(name):
            found[name] = matrix(name, rows, columns)
    if content.get("phi"):
        found["phi"] = [f"({text(entry)})*{row!r}" for entry, row in
                        zip(content["phi"], e, strict=True)]
    found["parameters"] = {n: text(v) for n, v in content.get("parameters", {}).items()}
    for name, factors in (("inputs", d), ("unknowns", k)):
        given = content.get(name) or {}
        found[name] = {n: f"{f!r}*({text(v)})" if isinstance(v, str) else f * v
                       for (n, v), f in zip(given.items(), factors, strict=True)}
    size = dict(zip(content["states"], s, strict=True))
    found["initial_state"] = {n: f"{size[n]!r}*({text(v)})" if isinstance(v, str) else v * size[n]
                              for n, v in content["initial_state"].items()}
    start = content.get("observer_defaults", {}).get("xi_a0")
    if start:
        found["observer_defaults"] = {"xi_a0": {n: v * size[n] for n, v in start.items()}}
    return {key: value for key, value in found.items() if value}
