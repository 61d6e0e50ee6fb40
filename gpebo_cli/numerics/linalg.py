"""Small dense linear algebra over a batch of matrices (leading axis: time).

Ranks are judged against the size of what a matrix was made from, never against its own largest
singular value: a one-column product of size 1e-17 has rank 0, not 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import prod

import numpy as np

from gpebo_cli.kernels import laws, signals
from gpebo_cli.kernels.arrays import axes_of, inverses
from gpebo_cli.model.descriptor import Array, BoolArray

_CLEAR = 1e11  # ‖Ω‖‖Ω⁻¹‖, up to which elimination leaves more than three digits
_CANCELLED = 1e-13  # of the terms of an entry: what is left is rounding


def without_rounding(found: Array, terms: Array | None = None) -> Array:
    """``found`` (N, i, j) with zeros for entries that are the rounding of their terms at all times.

    An equation that says nothing of a quantity must not seem to say a little: what is computed from
    it would be noise, which no mesh resolves. ``found`` is overwritten. ``terms`` (N or 1, i, j)
    are the sizes of what each entry is the sum of; None: that of the largest entry.
    """
    size = largest_over_time(found)
    whole = size.max(initial=0.0) if terms is None else largest_over_time(terms)
    found[:, size <= _CANCELLED * whole] = 0.0
    return found


def less_product(own: Array, factor: Array, other: Array) -> Array:
    """``own`` − ``factor`` @ ``other`` (N, i, j), :func:`without_rounding` of their terms."""
    return without_rounding(own - factor @ other, np.abs(own) + np.abs(factor) @ np.abs(other))


def transpose(a: Array) -> Array:
    """Of the last two axes, (…, a, b) to (…, b, a)."""
    return np.swapaxes(a, -1, -2)


def reciprocals(values: Array, known: BoolArray) -> Array:
    """1/values (…,) where they are ``known``, a mask that broadcasts to them, and 0 elsewhere."""
    return np.divide(1.0, values, out=np.zeros_like(values), where=known)


def largest_within(values: Array) -> Array:
    """Largest sizes (K, …) of values (K, points, …)."""
    found = signals.largest(values.reshape(*values.shape[:2], prod(values.shape[2:])))
    return found.reshape(len(values), *values.shape[2:])


def largest_over_time(values: Array, axes: int = 1) -> Array:
    """Largest sizes (…) of values (N, …), or of (K, points, …) with two axes of time; 0 of none."""
    shape = values.shape[axes:]
    return signals.largest(values.reshape(1, prod(values.shape[:axes]), prod(shape))).reshape(shape)


def taylor_product(a: Array, b: Array) -> Array:
    """Of Taylor coefficients of matrices (K + 1, N or 1, i, j) with those of others, or of vectors.

    To the orders that both have.
    """
    if b.ndim < a.ndim:
        return taylor_product(a, b[..., None])[..., 0]
    return np.array([
        sum(a[j] @ b[k - j] for j in range(k + 1)) for k in range(min(len(a), len(b)))
    ])


def exact_product(left: Array, right: Array) -> Array:
    """left @ right (N, i, k), for matrices (N or 1, i, j) and (N or 1, j, k), without rounding.

    What is not zero in a row of ``left`` counts as being of that row's size; axes only choose.
    """
    if len(left) == 1 and (axes := axes_of(left[0].T)) is not None:
        return right[:, axes]
    size = largest_over_time(left).max(axis=1, initial=0.0)[:, None]
    return without_rounding(left @ right, size * ((left != 0.0) @ np.abs(right)))


def inverse_or_none(whole: Array) -> tuple[Array, BoolArray]:
    """Inverses (N, n, n), and at which of the N there is none."""
    inverse = inverses(whole)
    return inverse, np.asarray(~np.isfinite(inverse).all(axis=(1, 2)))


def orthonormal_complement(basis: Array) -> Array:
    """Projector onto the orthogonal complement of orthonormal columns, shape (..., n, n)."""
    return np.eye(basis.shape[-2]) - basis @ transpose(basis)


def products_of_others(factors: Array) -> Array:
    """∏_{j≠i} of factors (…, p), for each i, by prefix and suffix products: no division."""
    ones = np.ones((*factors.shape[:-1], 1))
    before = np.concatenate([ones, np.cumprod(factors[..., :-1], axis=-1)], axis=-1)
    after = np.concatenate([np.cumprod(factors[..., :0:-1], axis=-1)[..., ::-1], ones], axis=-1)
    return np.asarray(before * after)


def determinant_and_adjugate_action(
    omega: Array, rhs: Array | None = None
) -> tuple[Array, Array, Array]:
    """det(Ω) and adj(Ω) b for square Ω (..., p, p) and b (..., p, c), singular Ω too.

    Without b it is adj(Ω) itself. With Ω = U Σ Vᵀ, adj(Ω) = det(U) det(V) V diag(∏_{j≠i} σ_j) Uᵀ.
    The usual det(Ω)·inv(Ω) is rejected: it is undefined at the start, where every extension begins
    at Ω = 0. Beside both stands the reciprocal condition number σ_min/σ_max (...,), zero where Ω =
    0.
    """
    if rhs is None:
        rhs = np.broadcast_to(np.eye(omega.shape[-1]), omega.shape)
    u, sigma, vt = np.linalg.svd(omega)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    others = products_of_others(sigma)
    determinant = sign * others[..., -1] * sigma[..., -1]
    action = sign[..., None, None] * (transpose(vt) @ ((transpose(u) @ rhs) * others[..., None]))
    largest = sigma[..., 0]
    reciprocal = np.divide(sigma[..., -1], largest, out=np.zeros_like(largest), where=largest > 0)
    return determinant, action, reciprocal


def determinant_and_inverse(omega: Array) -> tuple[Array, Array, BoolArray]:
    """det(Ω) (N,) and Ω⁻¹ of Ω (N, p, p) by elimination, and where it leaves too few digits (N,).

    There Ω⁻¹ is zero. It is for deviations, of which three digits do, and saves most of the time
    that singular values take. Digits are those in units in which the diagonal is 1.
    """
    size = np.sqrt(np.abs(np.einsum("nii->ni", omega)))[..., None]
    size[size == 0.0] = 1.0
    both = size * transpose(size)
    one = np.broadcast_to(np.eye(omega.shape[1]), omega.shape)
    extended = np.concatenate([omega / both, one], axis=2)
    determinant, inverse, condition = laws.mixed(extended, None)
    unclear = ~(condition < _CLEAR)
    inverse[unclear] = 0.0
    return determinant * np.prod(size[..., 0] ** 2, axis=1), inverse / both, unclear


_SCAN_LIMIT = 1 << 11  # above this many parallel recurrences a plain loop over k moves less memory


def symmetric_eigenvalues(matrices: Array) -> Array:
    """Eigenvalues (N, p), ascending, of symmetric matrices (N, p, p + c), of p columns of them."""
    return np.asarray(np.linalg.eigvalsh(matrices[..., : matrices.shape[1]]), dtype=np.float64)


def affine_scan(factor: Array, shift: Array, start: Array) -> Array:
    """All z_k of z_{k+1} = a_k z_k + b_k, shape (K + 1, ...), with a and b (K, ...).

    Few recurrences are found by a parallel prefix scan: it composes neighbouring affine maps in
    log2(K) vectorised steps and never divides, so with 0 ≤ a ≤ 1 it is as stable as the recurrence.
    Many are followed step by step, each step vectorised over all of them.
    """
    shape = np.broadcast_shapes(factor.shape, shift.shape)
    out = np.empty((shape[0] + 1, *shape[1:]))
    out[0] = start
    if np.prod(shape[1:], dtype=np.int64) > _SCAN_LIMIT:
        for k in range(shape[0]):
            np.multiply(factor[k], out[k], out=out[k + 1])
            out[k + 1] += shift[k]
        return out
    a, b = np.broadcast_to(factor, shape).copy(), np.broadcast_to(shift, shape).copy()
    step = 1
    while step < len(b):
        # Right-hand sides are formed before they are stored: the two slices overlap.
        b[step:] = b[step:] + a[step:] * b[:-step]
        a[step:] = a[step:] * a[:-step]
        step *= 2
    out[1:] = a * out[0] + b
    return out


def triangular(pieces: Iterable[Array]) -> Array:
    """R (k, c) with RᵀR = ΣAᵀA of rows A (N, c) that come piece by piece."""
    found: Array = np.zeros(0)
    for rows in pieces:
        whole = np.concatenate([found.reshape(-1, rows.shape[1]), rows])
        found = np.asarray(np.linalg.qr(whole, mode="r"))
    return found
