"""What noise does to an estimate: one standard deviation, without any seeds.

ψ contains no noise, so the errors of everything between the samples of u and y and the estimates
are linear in those samples' errors (theory 12). With the errors ζ of the observer and s of the
estimator, and e constant from one sample to the next,

    [ζ; s]' = 𝔽 [ζ; s] + 𝔹 e,      δη̂ = C s,      δx̂ = gain C s + X ζ + W e.

A factor L of the covariance, L Lᵀ = cov [ζ; s; e], goes from sample to sample by orthogonal
transformations: no variance can become negative, whatever the rounding.
"""

from __future__ import annotations

import numpy as np

from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.regression.errors import ErrorsAt, ErrorSystem
from gpebo_cli.regression.linear import LinearRegression

_STAGES = 4  # order 7: a deviation needs three digits, and elements end at the samples
_ELEMENTS = 1000  # about so many at least
_MOST_PARTS = 8
_CHUNK = 1 << 22  # numbers in the systems that are solved at once
_TIMES = 2001  # at which the size of the errors of Y is looked at
_SINGULAR = 1e-12  # share of the largest eigenvalue of G below which a direction is not fitted


def deviations(
    observer: ErrorsAt, estimator: ErrorsAt, gain: Array, edges: Array, instants: Array,
    variances: Array, t: Array,
) -> tuple[Array, Array]:
    """One standard deviation of η̂ (M, p) and of x̂ (M, n) at the times t (M,).

    Args:
        observer: errors of [u; y] to those of Y and of the state's offset.
        estimator: errors of Y to those of η̂.
        gain: of x = offset + gain η at the times, (M, n, p).
        edges: of the regression's mesh, (K + 1,) seconds; ψ is smooth between them.
        instants: times of the samples; errors are held from one to the next.
        variances: of each sample of [u; y], (m + r,).
        t: ascending.
    """
    n, p = gain.shape[1:]
    mesh, fresh = _mesh(edges, instants)
    sampler = mesh.sampler(t)
    of_eta, of_x = np.empty((len(t), p)), np.empty((len(t), n))
    L: Array | None = None
    stretch = _stretch(observer, estimator, mesh, n)
    for first in range(0, mesh.size, stretch):
        part = slice(first, first + stretch)
        maps = _element_maps(observer, estimator, mesh, part, n)
        size = maps.shape[2]
        factors, L = _factors(maps[:, -1], fresh[part], np.sqrt(variances), L)
        chosen = (sampler.element >= first) & (sampler.element < first + stretch)
        if not chosen.any():
            continue
        element, weights = sampler.element[chosen], sampler.weights[chosen]
        own = element - first
        here = np.einsum("ms,msij->mij", weights[:, 1:], maps[own])
        here[:, :, :size] += weights[:, 0, None, None] * np.eye(size)
        reached = here @ factors[own]  # of [ζ; s] (M, size, size + signals)
        inside = mesh.inside[element, 1]
        o, e = observer(t[chosen], inside), estimator(t[chosen], inside)
        zeta = o.A.shape[1]
        eta = e.C @ reached[:, zeta:]
        x = gain[chosen] @ eta + o.C[:, -n:] @ reached[:, :zeta] + o.D[:, -n:] @ factors[own, size:]
        of_eta[chosen], of_x[chosen] = np.linalg.norm(eta, axis=2), np.linalg.norm(x, axis=2)
    return of_eta, of_x


def noise_level(
    observer: ErrorsAt, regression: LinearRegression, instants: Array, outputs: Array,
) -> float:
    """σ of recorded outputs from the residual of least squares; ``outputs`` are their ratios.

    With r = Y − ψ G⁻¹h, and P_h the covariance of h for σ = 1,

        E ∫|r|² dt = σ² (∫ E|δY|² dt − tr(G⁻¹ P_h)):

    the second term is what the fit of p parameters takes away, the noise being coloured by ζ.

    Args:
        observer: errors of [u; y] to those of Y and more.
        regression: of the recording, without resets.
        instants: times of its samples.
        outputs: variance of each signal [u; y] relative to σ², (m + r,).
    """
    mesh, rows, p = regression.mesh, regression.psi.values.shape[2], regression.p
    final = regression.gram.final
    values, vectors = np.linalg.eigh(final[:, :p])
    known = values > _SINGULAR * values.max(initial=0.0)
    root = np.where(known, 1.0 / np.sqrt(np.where(known, values, 1.0)), 0.0)[:, None] * vectors.T

    def of_Y(t: Array, inside: Array) -> ErrorSystem:
        o = observer(t, inside)
        C, D = o.C[:, :rows], o.D[:, :rows]
        return ErrorSystem(
            o.A, o.B, np.concatenate([C, C], axis=1), np.concatenate([D, D], axis=1)
        )

    def of_h(t: Array, inside: Array) -> ErrorSystem:
        into = transpose(regression.psi(t, inside))
        return ErrorSystem(np.zeros((1, p, p)), into, root[None], np.zeros((1, *into.shape[1:])))

    t = np.linspace(mesh.edges[0], mesh.edges[-1], _TIMES)
    of_fit, of_rows = deviations(
        of_Y, of_h, np.zeros((len(t), rows, p)), mesh.edges, instants, outputs, t
    )
    duration = float(mesh.edges[-1] - mesh.edges[0])
    expected = duration * float((of_rows**2).sum(axis=1).mean()) - float((of_fit[-1] ** 2).sum())
    eta = root.T @ (root @ final[:, p])
    # At the instants: whatever is assumed between samples, there the noise is all there.
    residual = regression.Y(instants) - regression.psi(instants) @ eta
    square = duration * float((residual**2).sum(axis=-1).mean())
    return float(np.sqrt(square / expected)) if expected > 0.0 else np.nan


def _stretch(observer: ErrorsAt, estimator: ErrorsAt, mesh: Mesh, n: int) -> int:
    """How many elements are taken at once."""
    width = _joint(observer, estimator, mesh, slice(0, 1), n).A.shape[-1] * mesh.rule.stages
    return max(1, _CHUNK // int(width) ** 2)


def _mesh(edges: Array, instants: Array) -> tuple[Mesh, Array]:
    """Elements between all edges and instants, and whether a sample is new at each one's start."""
    near = 1e-9 * float(np.diff(edges).min())
    own = instants[np.abs(edges[np.searchsorted(edges, instants).clip(0, len(edges) - 1)]
                          - instants) > near]
    own = own[(own > edges[0]) & (own < edges[-1])]
    mesh = Mesh(np.union1d(edges, own), radau_rule(_STAGES))
    parts = int(np.clip(np.ceil(_ELEMENTS / mesh.size), 1, _MOST_PARTS))
    mesh, _ = mesh.split(np.full(mesh.size, parts, dtype=np.intp))
    at = np.searchsorted(mesh.edges, instants - near)
    fresh = np.zeros(mesh.size + 1, dtype=bool)
    fresh[at.clip(0, mesh.size)] = True
    fresh[0] = True
    return mesh, fresh[:-1]


def _element_maps(
    observer: ErrorsAt, estimator: ErrorsAt, mesh: Mesh, part: slice, n: int
) -> Array:
    """[ζ; s] at each node from that at the left end and from e, (K, stages, d, d + m + r)."""
    rule, s = mesh.rule, mesh.rule.stages
    joint = _joint(observer, estimator, mesh, part, n)
    h = mesh.steps[part, None, None, None]
    count, (d, signals) = len(h), joint.B.shape[-2:]
    eye, nodes = np.eye(d), np.arange(s)
    operator = np.broadcast_to(
        np.einsum("ij,kl->ikjl", rule.differentiation, eye), (count, s, d, s, d)
    ).copy()
    operator[:, nodes, :, nodes, :] -= np.swapaxes(h * joint.A, 0, 1)
    right = np.empty((count, s, d, d + signals))
    right[..., :d] = rule.differentiation.sum(axis=1)[:, None, None] * eye
    right[..., d:] = h * joint.B
    solved = np.linalg.solve(
        operator.reshape(count, s * d, s * d), right.reshape(count, s * d, d + signals)
    )
    return np.asarray(solved.reshape(right.shape))


def _joint(
    observer: ErrorsAt, estimator: ErrorsAt, mesh: Mesh, part: slice, n: int
) -> ErrorSystem:
    """A (K, s, d, d) and B (K, s, d, m + r) of [ζ; s] at the nodes of some elements."""
    points, inside = mesh.points[part, 1:].ravel(), mesh.inside[part, 1:].ravel()
    o, e = observer(points, inside), estimator(points, inside)
    zeta, own, signals = o.A.shape[1], e.A.shape[1], o.B.shape[2]
    rows = o.C.shape[1] - n
    A = np.zeros((len(points), zeta + own, zeta + own))
    A[:, :zeta, :zeta] = o.A
    A[:, zeta:, :zeta] = e.B @ o.C[:, :rows]
    A[:, zeta:, zeta:] = e.A
    B = np.zeros((len(points), zeta + own, signals))
    B[:, :zeta] = o.B
    B[:, zeta:] = e.B @ o.D[:, :rows]
    shape = (-1, mesh.rule.stages, zeta + own)
    return ErrorSystem(A.reshape(*shape, zeta + own), B.reshape(*shape, signals), o.C, o.D)


def _factors(
    ends: Array, fresh: Array, deviations: Array, L: Array | None
) -> tuple[Array, Array]:
    """L of [ζ; s; e] at the left end of every element (K, d + m + r, d + m + r), and at the end.

    Args:
        ends: what an element makes of it, (K, d, d + m + r).
        fresh: where another e begins, (K,).
        deviations: of e, (m + r,).
        L: at the start; None: everything is known there.
    """
    size, signals = ends.shape[1], len(deviations)
    L = np.zeros((size + signals, size + signals)) if L is None else L
    out = np.empty((len(ends), *L.shape))
    for k, end in enumerate(ends):
        if fresh[k]:  # another e, independent of all before
            L[:size, :size] = np.asarray(np.linalg.qr(L[:size].T, mode="r")).T
            L[:size, size:] = 0.0
            L[size:] = 0.0
            L[size:, size:] = np.diag(deviations)
        out[k] = L
        L[:size] = end @ L
    return out, L
