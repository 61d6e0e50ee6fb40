"""Mixing, the scalar law of DREM for many gains, and how far estimates are from the truth."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels.arrays import Array, IntArray

_EPS, _IN_CACHE = float(np.finfo(float).eps), 1 << 16  # numbers that are solved with at once


def mixed(extended: Array, added: Array | None) -> tuple[Array, Array, Array]:
    """Δ = det Ω (N,), Ω⁻¹𝒴 (N, p, c) and ‖Ω‖‖Ω⁻¹‖ (N,) of [Ω | 𝒴] (N, p, p + c).

    Where Δ = 0 the second one is not finite. With r (N,) it is that of :func:`regularised`, and
    there are no others.
    """
    p = extended.shape[1]
    if added is not None:
        nothing = np.full(len(extended), np.nan)
        return nothing, regularised(extended, added), nothing
    omega = extended[:, :, :p]
    delta = np.linalg.det(omega)
    solved = np.full((*extended.shape[:2], extended.shape[2]), np.nan)
    regular = delta != 0.0  # by elimination, an exact zero is a pivot that is zero
    unit = np.broadcast_to(np.eye(p), (int(np.count_nonzero(regular)), p, p))
    both = np.concatenate([unit, extended[regular, :, p:]], axis=2)
    solved[regular] = np.linalg.solve(omega[regular], both)
    with np.errstate(over="ignore", invalid="ignore"):  # where Ω is 1e-160, that is singular
        inverse = np.linalg.norm(solved[:, :, :p], axis=(1, 2))
        condition = np.linalg.norm(omega, axis=(1, 2)) * inverse
    return delta, solved[:, :, p:], condition


def regularised(extended: Array, added: Array) -> Array:
    """(Ω + r)⁻¹𝒴 (N, p, c) of [Ω | 𝒴] (N, p, p + c), Ω symmetric and not negative, and r (N,) ≥ 0.

    It is solved in units in which the matrix has ones on its diagonal; directions in which it is
    rounding come to nothing.
    """
    p, found = extended.shape[1], extended[..., extended.shape[1] :].copy()
    diagonal = np.einsum("nii->ni", extended[..., :p]) + added[:, None]
    unit = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))[..., None]
    some = max(1, _IN_CACHE // max(p * p, 1))
    for first in range(0, len(found), some):
        part = slice(first, first + some)
        left = extended[part, :, :p] * unit[part]
        left *= np.swapaxes(unit[part], 1, 2)
        np.einsum("nii->ni", left)[:] = diagonal[part] * unit[part, :, 0] ** 2
        right = found[part] * unit[part]
        try:
            found[part] = np.linalg.solve(left, right) * unit[part]
        except np.linalg.LinAlgError:
            found[part] = np.linalg.pinv(left, p * _EPS, hermitian=True) @ right * unit[part]
    return found


def stepped_law(
    length: Array, left: Array, change: Array, jump: Array, step: IntArray, partial: Array,
    share: Array, start: Array, gains: Array,
) -> Array:
    """η̂ (g, M, p) where η̄ is linear in I over each step, and η̂ is continuous where η̄ jumps.

    A step x = γ δI of the distance ε = η̂ − η̄, which stays accurate after convergence, is ε₊ =
    e^{−x} ε − (1 − e^{−x})/x · (η̄₊ − η̄). Of steps in I of a ``length`` δI ≥ 0 (S,), η̄ at their
    left ends, its change over each and its jump at the end of each (S, p), in which ``step`` each
    time lies (M,), how far I is from its left end there and the share of the step that is (M,), η̂
    at the start (1 or g, p), and the gains γ (g, 1 or p).
    """
    count, p = left.shape
    distance = np.empty((count, len(gains), p))
    distance[0] = start - left[0]
    for k in range(count - 1):
        x = gains * length[k]
        distance[k + 1] = np.exp(-x) * distance[k] - mean_decay(x) * change[k] - jump[k]
    x = gains * partial[:, None, None]
    eta = np.exp(-x) * distance[step]
    eta += left[step, None] + (1.0 - mean_decay(x)) * (share[:, None] * change[step])[:, None]
    return np.ascontiguousarray(np.swapaxes(eta, 0, 1))


def mean_decay(x: Array) -> Array:
    """(1 − e^{−x})/x and its limit 1, of each entry of x (...,)."""
    return np.divide(-np.expm1(-x), x, out=np.ones_like(x), where=x > 0.0)


def squared_errors(
    eta: Array, truth: Array, in_eta: Array, offset: Array, gain: Array, x: Array, in_x: Array,
    levels: Array | None, share: float,
) -> tuple[Array, Array, Array, Array]:
    """Weighted squares of η̂ − η and of x̂ − x, x̂ = offset + gain η̂, both (g, M).

    And when each error is above its level for the last time, as an index, −1 for never (g, p + n),
    and each sum of squares above a ``share`` of its beginning (g, 2). Of η̂ (g, M, p), η (M or 1,
    p) and the weights of its components (p,), with the weight 0 of which one may be NaN; of the
    offset (M or 1, n) and gain (M or 1, n, p), x (M or 1, n) and its weights (n,). ``levels`` are
    those of the errors (g, p + n); None: nobody asks when they are above them.
    """
    some, seen = in_eta != 0.0, in_x != 0.0
    in_all = [eta - truth, np.matmul(gain, eta[..., None])[..., 0] + (offset - x)]
    of_eta = np.einsum("gmj,j->gm", in_all[0][..., some] ** 2, in_eta[some])
    of_x = np.einsum("gmi,i->gm", in_all[1][..., seen] ** 2, in_x[seen])
    last = np.full((len(eta), len(in_eta) + len(in_x)), -1.0)
    if levels is not None:
        last = last_above(np.abs(np.concatenate(in_all, axis=2)), levels[:, None])
    sums = np.stack([of_eta, of_x], axis=2)
    return of_eta, of_x, last, last_above(sums, share * sums[:, :1])


def last_above(courses: Array, levels: Array) -> Array:
    """The last index at which courses (g, M, c) are above levels (g, 1, c), −1 for none."""
    above = courses > levels
    latest = above.shape[1] - 1 - np.argmax(above[:, ::-1], axis=1)
    return np.where(above.any(axis=1), latest, -1.0)
