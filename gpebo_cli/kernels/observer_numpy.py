"""The observer's matrices where kernel and range of E do not turn, and its regression."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels.arrays import Array, IntArray, inverses, joined

_TINY = float(np.finfo(float).tiny)


@np.errstate(invalid="ignore", divide="ignore")  # where E⁺ or K does not exist; the caller looks
def in_frame(
    E: Array, A: Array, B: Array, F: Array, C: Array, rows: Array, scale: Array, domain: Array,
    range_: Array, kernel: Array, equations: Array,
) -> tuple[Array, ...]:
    """The matrices of the observer at N times, those of the plant being (N or 1, ...).

    E and A are (n, n), B (n, m), F (n, q) and C (r, n); equations are divided by ``rows`` (n,),
    outputs multiplied by ``scale`` (r,). Orthonormal bases are those of range E⁺E (n, d), of range
    E (n, d) and of the kernel of E (n, b); ``equations`` are those without derivatives, as rows (e,
    n).

    Returns:
        the largest entry of E outside the frame, the largest norm of UᵀE B and of its inverse (3,);
        then BᵀE⁺ (d, n), 𝒜 (e + r, n), 𝒜 B, g_signals (e + r, m + r), G (e + r, q), Q1 (e + r, b)
        and H (n, b) of (𝒜 Q)⁺ = H Q1ᵀ, at most the smallest singular value of 𝒜 on the kernel
        relative to ‖𝒜‖, BᵀA_0 B (d, d), BᵀD_0 (d, q) and Bᵀb_0's from_signals (d, m + r): with a
        leading axis of N, or 1 where all that they are made of is constant, but for the last two.
        What is singular is not finite.
    """
    if (rows != 1.0).any():
        E, A, B, F = (matrix / rows[:, None] for matrix in (E, A, B, F))
    C = scale[:, None] * C
    m, q, d, e, r = B.shape[2], F.shape[2], domain.shape[1], len(equations), len(scale)
    inner = _across(_down(range_.T, E), domain)
    diagonal = np.einsum("nii->ni", inner)
    alone = np.count_nonzero(inner) == np.count_nonzero(diagonal)
    same = alone and bool((diagonal == 1.0).all())
    inverse = (1.0 / diagonal)[:, :, None] * np.eye(d) if alone else inverses(inner)
    sizes = np.array([
        max(float(np.abs(part).max(initial=0.0))
            for part in (_across(E, kernel), _down(equations, E))),
        *(float(np.sqrt((x**2).sum(axis=(1, 2)).max())) for x in (inner, inverse)),
    ])

    def from_left(matrix: Array) -> Array:
        """BᵀE⁺ times a matrix."""
        part = _down(range_.T, matrix)
        if same:
            return part
        return part / diagonal[:, :, None] if alone else inverse @ part

    pinv = from_left(np.eye(E.shape[1])[None])
    algebraic = joined(_down(equations, A), C, axis=1)  # 𝒜 = [Π A; C]
    of_y = np.zeros((1, e + r, r))
    of_y[0, e:] = -np.diag(scale)
    below = np.zeros((1, r, m + q))
    of_u_theta = joined(
        joined(_down(equations, B), _down(equations, F), axis=2), below, axis=1
    )
    g_signals, G = joined(of_u_theta[:, :, :m], of_y, axis=2), of_u_theta[:, :, m:]
    Q1, R1 = np.linalg.qr(_across(algebraic, kernel))
    X1 = inverses(R1)
    size = np.maximum(np.sqrt((algebraic**2).sum(axis=(1, 2))), _TINY)
    with np.errstate(divide="ignore"):
        injectivity = 1.0 / (np.sqrt((X1**2).sum(axis=(1, 2))) * size)
    H = kernel @ X1
    Lambda, on_basis = from_left(A), _across(algebraic, domain)
    # [A_0 | D_0 | of u and y] = [Λ B | E⁺F | E⁺B, 0] − Λ H Q1ᵀ [𝒜 B | G | g_signals]
    times = max(map(len, (E, A, B, F, C)))
    back = _across(Lambda, kernel) @ X1
    touched = back.any(axis=(0, 2))  # of many states few are moved by those that are eliminated
    found = []
    for direct, through in (
        (_across(Lambda, domain), on_basis), (from_left(F), G),
        (joined(from_left(B), np.zeros((1, d, r)), axis=2), g_signals),
    ):
        whole = np.broadcast_to(direct, (times, *direct.shape[1:]))
        if touched.any():
            whole = whole.copy()
            whole[:, touched] -= back[:, touched] @ (np.swapaxes(Q1, 1, 2) @ through)
        found.append(whole)
    if len(E) == len(A) == len(C) == 1:
        found[0] = found[0][:1]
    return sizes, pinv, algebraic, on_basis, g_signals, G, Q1, H, injectivity, *found


def _axes(columns: Array) -> IntArray | slice | None:
    """Which coordinate axes columns (n, d) are, None where they are something else."""
    if np.count_nonzero(columns) != columns.shape[1] or not (columns.sum(axis=0) == 1.0).all():
        return None
    axes = columns.argmax(axis=0)
    one_by_one = len(axes) > 0 and (np.diff(axes) == 1).all()  # then nothing is copied
    return slice(axes[0], axes[-1] + 1) if one_by_one else axes


def _across(matrix: Array, columns: Array) -> Array:
    """The product with columns (n, d), of which coordinate axes only choose."""
    axes = _axes(columns)
    return matrix @ columns if axes is None else matrix[:, :, axes]


def _down(rows: Array, matrix: Array) -> Array:
    """The product of rows (d, n) with a matrix, in the same way."""
    axes = _axes(rows.T)
    return rows @ matrix if axes is None else matrix[:, axes]


def regression_signals(
    z: Array, q: int, basis: Array, algebraic: Array, g_y: Array, G: Array, range_: Array,
    elimination: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Y (N, rows), ψ (N, rows, p), and the state's offset (N, n) and gain (N, n, p), at N times.

    And the size of the terms of Y and of each column of ψ before they cancel (1 + p,). They come
    from ``z``, [ξ_a | ξ_b | Φ] in the coordinates of the basis B (n, k), (N, k, 1 + p), with q
    unknown parameters, 𝒜 B (N or 1, rows, k), g_y of the signals (N, rows), G of θ (N or 1, rows,
    q), and Q1 (N or 1, rows, b) and H (N or 1, n, b) of K = H Q1ᵀ and R = I − Q1 Q1ᵀ.
    """
    signs = np.ones(z.shape[2])
    signs[1 : 1 + q] = -1.0  # w = ξ_a + ξ_b θ − Φ e₀ and ψ has −ξ_b, +Φ
    used = algebraic.any(axis=(0, 1))  # of many coordinates few are seen
    some, algebraic = z[:, used] * signs, algebraic[:, :, used]
    terms = algebraic @ some  # [𝒜 ξ_a + g_y | −𝒜 ξ_b − G | 𝒜 Φ]
    whole = np.abs(algebraic) @ np.abs(some)
    whole[:, :, 0] += np.abs(g_y)
    whole[:, :, 1 : 1 + q] += np.abs(G)
    sizes = whole.max(axis=(0, 1), initial=0.0)
    terms[:, :, 0] += g_y
    terms[:, :, 1 : 1 + q] -= G
    seen = np.swapaxes(range_, 1, 2) @ terms
    left = terms - range_ @ seen  # R (…)
    axes = _axes(basis)
    # The state w − K (…) is the offset and minus the gain [X_w ξ_b + X_θ | −X_w Φ], signed likewise
    if axes is None:
        gain = basis @ (z[:, :, 1:] * -signs[1:])
        offset = z[:, :, 0] @ basis.T
    else:
        offset = np.zeros((len(z), len(basis)))
        gain = np.empty((len(z), len(basis), z.shape[2] - 1))
        gain[:, ~basis.any(axis=1)] = 0.0
        offset[:, axes] = z[:, :, 0]
        if isinstance(axes, slice):  # at once: another copy is as large
            np.multiply(z[:, :, 1:], -signs[1:], out=gain[:, axes])
        else:
            gain[:, axes] = z[:, :, 1:] * -signs[1:]
    given = elimination.any(axis=(0, 2))
    through = elimination[:, given] @ seen
    offset[:, given] -= through[:, :, 0]
    gain[:, given] += through[:, :, 1:]
    return left[:, :, 0], left[:, :, 1:], offset, gain, sizes
