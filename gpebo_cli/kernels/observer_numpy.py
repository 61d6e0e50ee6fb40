"""The observer's matrices where kernel and range of E do not turn, and its regression."""

from __future__ import annotations

import numpy as np

from gpebo_cli.kernels.arrays import Array, axes_of


def in_frame(*_: Array) -> tuple[Array, ...] | None:
    """The matrices of the observer at N times, those of the plant being (N or 1, ...).

    E and A are (n, n), B (n, m), F (n, q) and C (r, n); equations are divided by ``rows`` (n,),
    outputs multiplied by ``scale`` (r,). Orthonormal bases are those of range E⁺E (n, d), of range
    E (n, d) and of the kernel of E (n, b); ``equations`` are those without derivatives, as rows (e,
    n). All of these are coordinate axes.

    Returns:
        the largest entry of E outside the frame, the largest norm of UᵀE B and of its inverse (3,);
        then BᵀE⁺ (d, n), 𝒜 (e + r, n), 𝒜 B, g_signals (e + r, m + r), G (e + r, q), Q1 (e + r, b)
        and H (n, b) of (𝒜 Q)⁺ = H Q1ᵀ, at most the smallest singular value of 𝒜 on the kernel
        relative to ‖𝒜‖, BᵀA_0 B (d, d), BᵀD_0 (d, q) and Bᵀb_0's from_signals (d, m + r): with a
        leading axis of N, or 1 where all that they are made of is constant, but for the last two.
        What is singular is not finite. None for many states, and without C: the caller has a way
        that does without frames.
    """
    return None


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
    axes = axes_of(basis)
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
