"""Stiff elements with few entries: (D/h ⊗ I − A) X = D𝟙/h x_0 + f, state by state.

The s unknowns of one state in an element are coupled by D/h − a_ii. With another state they are
coupled node by node, by a diagonal matrix. So a state is eliminated by one inverse of size s, for
all elements at once; where the pattern of A is a tree, nothing but such inverses is kept. Elements
follow one after the other only when the right-hand sides are known.
"""

from __future__ import annotations

from hashlib import blake2b
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np

from gpebo_cli.kernels import elements
from gpebo_cli.kernels.elements_numpy import at_nodes
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.mesh import Mesh

_SMALL = 1e-280  # terms below it have lost digits
_FILL = 4  # blocks of size s × s per state that elimination may couple; with more A is not sparse


class StiffError(Exception):
    """Series do not converge, or elimination fills what is sparse."""


class Factors(NamedTuple):
    """What elimination does to the right-hand side of an element, see ``elements.substituted``."""

    # Target, source and block of each step, (S,)
    steps: tuple[IntArray, IntArray, IntArray]
    full: Array  # (G, F, s, s)
    diagonal: Array  # (G, T, s)


class Eliminated:
    """A march, see :mod:`.series`, by elimination; factors of the last elements are kept."""

    def __init__(self) -> None:
        self._known = dict[bytes, int]()  # where the factors of each matrix are, by its digest
        self._factors: Factors | None = None

    def __call__(
        self, mesh: Mesh, A: tuple[IntArray, IntArray, Array], f: Array, kicks: Array | None,
        start: Array, _tol: float,
    ) -> tuple[Array, Array]:
        """Values (K, s + 1, d, c), and what is left of the equations (K,) if nothing is added."""
        h, D, (rows, columns, entries) = mesh.steps, mesh.rule.differentiation, A
        entries = at_nodes(entries, len(h), len(D))
        pattern = rows.tobytes() + columns.tobytes()
        keys = [
            blake2b(pattern + f"{step:.12e}".encode() + each.tobytes()).digest()
            for step, each in zip(h.tolist(), entries, strict=True)
        ]
        fresh = {key: k for k, key in enumerate(keys) if key not in self._known}
        if fresh or self._factors is None:
            some = list(fresh.values())
            factors = eliminated(D, h[some], rows, columns, entries[some])
            kept = {key: self._known[key] for key in keys if key in self._known}
            if kept and self._factors is not None:
                old = list(kept.values())
                factors = Factors(factors.steps, *(
                    np.concatenate([a[old], b])
                    for a, b in zip(self._factors[1:], factors[1:], strict=True)
                ))
            self._known = {key: g for g, key in enumerate([*kept, *fresh])}
            self._factors = factors
        place = np.array([self._known[key] for key in keys])
        values = elements.substituted(
            D.sum(axis=1) / h[:, None], place, *self._factors.steps,
            self._factors.full, self._factors.diagonal, f, kicks, start,
        )
        if kicks is not None:
            return values, np.zeros(len(h))
        return values, _residual(D / h[:, None, None], rows, columns, entries, f, values)


def _residual(
    Dh: Array, rows: IntArray, columns: IntArray, entries: Array, f: Array, values: Array
) -> Array:
    """What is left of each element's equations, relative to their terms (K,).

    No pivots are sought beyond the states' own unknowns: this says whether that did harm.
    """
    K, points, _, _ = values.shape
    left, X, there = values[:, :1], values[:, 1:], np.diff(rows) > 0
    f = at_nodes(f, K, points - 1)

    def total(Dh: Array, slopes: Array, entries: Array, X: Array, f: Array) -> Array:
        found = np.einsum("kij,kjdc->kidc", Dh, slopes)
        terms = entries[..., None] * X[:, :, columns]
        found[:, :, there] += np.add.reduceat(terms, rows[:-1][there], axis=2)
        found[..., : f.shape[-1]] += f
        return np.asarray(np.abs(found))

    size = total(np.abs(Dh), np.abs(X) + np.abs(left), np.abs(entries), np.abs(X), np.abs(f))
    left_over = total(Dh, X - left, -entries, X, -f) / np.maximum(size, _SMALL)
    return np.asarray(left_over.max(axis=(1, 2, 3), initial=0.0))


def eliminated(D: Array, h: Array, rows: IntArray, columns: IntArray, entries: Array) -> Factors:
    """Of G elements of lengths ``h`` (G,), entries (G, s, e) of A at their nodes, or StiffError."""
    s, d = len(D), len(rows) - 1
    own = dict.fromkeys(range(d), D / h[:, None, None])
    # Beyond the own ones, with the sign that they have on the right: (G, s, 1) if diagonal.
    coupled: list[dict[int, Array]] = [{} for _ in range(d)]
    of_row = np.repeat(np.arange(d), np.diff(rows)).tolist()
    for e, (i, j) in enumerate(zip(of_row, columns.tolist(), strict=True)):
        a = entries[:, :, e, None]
        if i == j:
            own[i] = own[i] - a * np.eye(s)
        else:
            coupled[i][j] = a
    beside = [set(row) for row in coupled]
    for i, row in enumerate(coupled):
        for j in row:
            beside[j].add(i)
    forward, backward = list[tuple[int, int, Array]](), list[tuple[int, int, Array]]()
    filled = 0
    order = [(len(near), i) for i, near in enumerate(beside)]
    heapify(order)
    while own:
        near, i = heappop(order)
        if i not in own or near != len(beside[i]):
            continue
        try:
            inverse = np.asarray(np.linalg.inv(own.pop(i)), dtype=np.float64)
        except np.linalg.LinAlgError:
            raise StiffError from None
        forward.append((i, i, inverse))
        backward.append((i, i, inverse))
        backward += [(i, c, a) for c, a in coupled[i].items()]
        for r in beside[i]:
            beside[r] = (beside[r] | beside[i]) - {i, r}
            heappush(order, (len(beside[r]), r))
            if i not in coupled[r]:
                continue
            a = coupled[r].pop(i)
            forward.append((r, i, a))
            through = a * inverse if a.shape[2] == 1 else a @ inverse
            for c, b in coupled[i].items():
                more = through * np.swapaxes(b, 1, 2) if b.shape[2] == 1 else through @ b
                if r == c:
                    own[r] = own[r] - more
                else:
                    before = coupled[r].get(c, np.zeros((1, 1, 1)))
                    filled += before.shape[2] == 1
                    coupled[r][c] = more + (before * np.eye(s) if before.shape[2] == 1 else before)
        if filled > _FILL * d:
            raise StiffError
    target, source, blocks = zip(*forward, *backward[::-1], strict=True)
    full, diagonal = ([b for b in {id(b): b for b in blocks}.values() if (b.shape[2] > 1) == wanted]
                      for wanted in (True, False))
    place = {id(b): k for k, b in enumerate(full + diagonal)}
    return Factors(
        (np.array(target), np.array(source), np.array([place[id(b)] for b in blocks])),
        np.stack([b.swapaxes(1, 2) for b in full], axis=1),
        np.concatenate([full[0][:, :0], *(b.swapaxes(1, 2) for b in diagonal)], axis=1),
    )
