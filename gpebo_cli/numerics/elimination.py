"""Stiff elements with few entries: (D/h ⊗ I − A) X = D𝟙/h x_0 + f, state by state.

The s unknowns of one state in an element are coupled by D/h − a_ii. With another state they are
coupled node by node, by a diagonal matrix. So a state is eliminated by one inverse of size s; where
the pattern of A is a tree, nothing else is full. What is to be done follows from the pattern alone.
"""

from __future__ import annotations

from functools import lru_cache
from heapq import heappop, heappush

import numpy as np

from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.mesh import Mesh, equal_lengths
from gpebo_cli.numerics.problem import at_points

_SMALL = 1e-280  # terms below it have lost digits
_FILL = 4  # blocks of size s × s per state that elimination may couple; with more A is not sparse


class StiffError(Exception):
    """Series do not converge, or elimination fills what is sparse."""


def by_elimination(
    mesh: Mesh, A: tuple[IntArray, IntArray, Array], f: Array, kicks: Array | None, start: Array,
    _tol: float,
) -> tuple[Array, Array]:
    """A march, see :mod:`.series`: values (K, s + 1, d, c), and what is left of the equations (K,).

    With ``kicks`` that is not looked at, and values are those of right ends.
    """
    _, h = equal_lengths(mesh.steps, mesh)
    D, (rows, columns, entries) = mesh.rule.differentiation, A
    steps = steps_of(rows.tobytes(), columns.tobytes())
    values = elements.stiff(D, h, *steps, entries, f, kicks, start)
    if kicks is None:
        return values, _residual(D, h, rows, columns, entries, f, values)
    return values[:, -1:].copy(), np.zeros(len(h))  # which does not hold the others


def _residual(
    D: Array, h: Array, rows: IntArray, columns: IntArray, entries: Array, f: Array, values: Array
) -> Array:
    """What is left of each element's equations, relative to the largest of their terms (K,).

    No pivots are sought beyond the states' own unknowns: this says whether that did harm.
    """
    (K, points), h = values.shape[:2], h[:, None, None]
    values, there = values.swapaxes(2, 3), np.diff(rows) > 0  # states last: their sums are fast
    a, f, first = at_points(entries, K, points - 1), at_points(f, K, points - 1), rows[:-1][there]
    f = f.swapaxes(2, 3)

    def sums(entries: Array, values: Array) -> Array:
        terms = values.take(columns, axis=-1)
        terms *= entries  # in place: these are as much as all else
        return np.asarray(np.add.reduceat(terms, first, axis=-1))

    right = np.zeros_like(values)  # at left ends, too: parts of arrays would be copied
    right[..., there] = sums(a[:, :, None], values)
    right[:, :, : f.shape[2]] += f
    left = np.matmul(D, (values[:, 1:] - values[:, :1]).reshape(K, points - 1, -1))
    left /= h
    right[:, 1:] -= left.reshape(K, points - 1, *values.shape[2:])
    del left
    largest = np.abs(values).max(axis=1)
    size = np.abs(D).sum(axis=1).max() / h * largest
    size[..., there] += sums(np.abs(a).max(axis=1)[:, None], largest)
    size[:, : f.shape[2]] += np.abs(f).max(axis=1)
    most = np.abs(right, out=right)[:, 1:].max(axis=1)
    return np.asarray((most / np.maximum(size, _SMALL)).max(axis=(1, 2)))


@lru_cache(maxsize=16)
def steps_of(row_bytes: bytes, column_bytes: bytes) -> tuple[IntArray, IntArray, IntArray]:
    """What ``elements.stiff`` is to do with a pattern, its arguments of these names, or StiffError.

    Of intp: ``origin`` (B,), ``products`` (o, 4) and ``steps`` (m, 3).
    """
    rows, columns = (np.frombuffer(each, dtype=np.intp) for each in (row_bytes, column_bytes))
    d = len(rows) - 1
    origin = [-1] * d
    # The block of each entry beyond the own ones; diagonal ones from the end, as −1, −2, …
    coupled: list[dict[int, int]] = [{} for _ in range(d)]
    of_row = np.repeat(np.arange(d), np.diff(rows)).tolist()
    for e, (i, j) in enumerate(zip(of_row, columns.tolist(), strict=True)):
        if i == j:
            origin[i] = e
        else:
            coupled[i][j] = ~e
    beside = [set(row) for row in coupled]
    for i, row in enumerate(coupled):
        for j in row:
            beside[j].add(i)
    products: list[tuple[int, int, int, int]] = []
    forward: list[tuple[int, int, int]] = []
    backward: list[tuple[int, int, int]] = []
    order = sorted((len(near), i) for i, near in enumerate(beside))  # is a heap
    left = set(range(d))
    while left:
        near, i = heappop(order)
        if i not in left or near != len(beside[i]):
            continue
        left.remove(i)
        products.append((i, i, i, i))
        forward.append((i, i, i))
        backward.append((i, i, i))
        backward += [(i, c, block) for c, block in coupled[i].items()]
        for r in beside[i]:
            beside[r] = (beside[r] | beside[i]) - {i, r}
            heappush(order, (len(beside[r]), r))
            if i not in coupled[r]:
                continue
            through = coupled[r].pop(i)
            forward.append((r, i, through))
            for c, block in coupled[i].items():
                if r != c and coupled[r].get(c, -1) < 0:
                    origin.append(~coupled[r].get(c, 0))
                    coupled[r][c] = len(origin) - 1
                products.append((r if r == c else coupled[r][c], through, i, block))
        if len(origin) > (1 + _FILL) * d:
            raise StiffError
    found = [np.array(part, dtype=np.intp) for part in (origin, products, forward + backward[::-1])]
    for part, places in zip(found[1:], ([1, 3], [2]), strict=True):
        numbers = part[:, places]
        part[:, places] = np.where(numbers < 0, len(origin) + ~numbers, numbers)
    return found[0], found[1], found[2]
