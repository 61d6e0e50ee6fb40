"""What errors of samples make of the errors in filters and laws, from element to element."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from gpebo_cli.kernels import elements
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.mesh import Mesh

_STIFF = 1e6  # rates times steps, from which on rows count alike
_SMALL = 15  # errors, up to which one system costs less than its blocks


def error_maps(mesh: Mesh, steps: Array, A: Array, B: Array) -> Array:
    """z at each node from that at the left end and from e, z' = A z + B e; (K, s, d, d + c).

    A (K, s, d, d) and B (K, s, d, c) are at the nodes of elements with these ``steps`` (K,). Errors
    go from ζ to filters and from there to the law: a large A is solved by its triangle of blocks.
    """
    d, c = B.shape[2:]
    size = 1.0 + steps[:, None] * np.abs(A).max(axis=(1, 3), initial=0.0)
    # Beside the rows of a law with a large gain those of its filters would be rounding.
    weights = 1.0 / size[:, None, :, None] if size.max(initial=0.0) > _STIFF else None
    if 0 < d <= _SMALL:
        return np.concatenate(_solved(mesh, steps, weights, A, B, 1), axis=3)
    out = np.zeros((*B.shape[:3], c + d))  # from e first
    for first, count, width in _blocks((A != 0.0).any(axis=(0, 1))):
        part = slice(first, first + count * width)
        f = A[:, :, part, :first] @ out[:, :, :first, : c + first]
        f[..., :c] += B[:, :, part]
        within, own = slice(c + part.start, c + part.stop), A[:, :, part, part]
        out[:, :, part, within], out[:, :, part, : c + first] = _solved(
            mesh, steps, weights if weights is None else weights[:, :, part], own, f, count
        )
    return np.concatenate([out[..., c:], out[..., :c]], axis=3)


def _solved(
    mesh: Mesh, steps: Array, weights: Array | None, A: Array, f: Array, count: int
) -> tuple[Array, Array]:
    """z at each node from that at the left end (K, s, m, m), and from zero (K, s, m, c).

    z' = A z + f, its rows multiplied by ``weights`` (K, 1, m, 1), None: 1. A (K, s, m, m) consists
    of ``count`` diagonal blocks.
    """
    K, s, m, c = f.shape
    width, own, E = m // count, np.zeros(A.shape), None
    if weights is not None:
        A, f = weights * A, weights * f
        E = (weights.reshape(-1, 1, width, 1) * np.eye(width)).repeat(1 + s, axis=1)
        E = E.reshape(-1, width, width)
    by_block = K, s, count, width, count, width
    apart = np.einsum("ksgvgw->kgsvw", A.reshape(by_block))
    given = f.reshape(*by_block[:4], c).swapaxes(1, 2)
    # At the left ends nothing is looked at.
    apart, given = (
        np.concatenate([x[:, :, :1], x], axis=2).reshape(-1, *x.shape[3:]) for x in (apart, given)
    )
    homogeneous, particular = elements.element_maps(
        mesh.rule.differentiation, steps.repeat(count), E, apart, given, None, None,
        np.arange(K * count), K * count,
    )
    np.einsum("ksgvgw->kgsvw", own.reshape(by_block))[...] = homogeneous.reshape(
        K, count, s, width, width
    )
    return own, particular.reshape(K, count, s, width, c).swapaxes(1, 2).reshape(f.shape)


def _blocks(reaches: BoolArray) -> list[tuple[int, int, int]]:
    """Where the diagonal blocks of a triangular matrix begin, how many stand there, how wide.

    What ``reaches`` (d, d) a row is true in it. Rows that do not reach each other are blocks of
    width 1.
    """
    d = len(reaches)
    last = np.maximum.accumulate(np.where(reaches, np.arange(d), 0).max(axis=1, initial=0))
    ends = np.flatnonzero(last <= np.arange(d)) + 1
    found: list[tuple[int, int, int]] = []
    for first, end in pairwise([0, *ends.tolist()]):
        if found and end == first + 1 and found[-1][2] == 1:
            begun, groups, _ = found[-1]
            if not reaches[first, begun:first].any():
                found[-1] = begun, groups + 1, 1
                continue
        found.append((first, 1, end - first))
    return found


def error_steps(mesh: Mesh, times: Array, lines: BoolArray, A: Array, B: Array) -> Array:
    """ζ at each time but the first from that before and from the errors e at both, (K, k, k + 2 c).

    Of elements between the times (K + 1,) of samples; between them e is linear where ``lines``
    (c,), else held. Of ζ' = A ζ + B e, A (elements or 1, s + 1 or 1, k, k) and B (…, k, c) are at
    the points of the mesh.
    """
    points = mesh.points[:, 1:]
    after = np.searchsorted(times, mesh.edges[1:] - 0.5 * mesh.steps)  # whose step it is part of
    # Of the newer of both errors.
    share = (points - times[after - 1, None]) / (times[after] - times[after - 1])[:, None]
    A, B = (
        np.broadcast_to(each[:, -mesh.rule.stages :], (*points.shape, *each.shape[2:]))
        for each in (A, B)
    )
    share = share[..., None, None] * lines
    B = np.concatenate([(1.0 - share) * B, share * B], axis=3)
    ends = error_maps(mesh, mesh.steps, A, B)[:, -1]
    if len(ends) == len(times) - 1:
        return ends
    k = ends.shape[1]
    out = np.zeros((len(times) - 1, *ends.shape[1:]))
    out[:, :, :k] = np.eye(k)
    for end, step in zip(ends, after - 1, strict=True):
        out[step] = end[:, :k] @ out[step]
        out[step, :, k:] += end[:, k:]
    return out
