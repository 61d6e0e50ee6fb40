"""What noise does to an estimate, from one sample to the next: see :mod:`.uncertainty`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gpebo_cli.evidence.uncertainty import BESIDE, LEFT, SINGULAR
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import reciprocals
from gpebo_cli.regression.errors import ErrorRecursion, ErrorSteps
from gpebo_cli.regression.samples import SampledRegression, integrating


class SampledDeviations:
    """One standard deviation from one sample to the next; it remembers L and no past."""

    def __init__(
        self, variances: Array, number: Callable[[Array], Array] | None, *, relative: bool
    ) -> None:
        """Prepare for the first sample.

        With variances of each sample of [u; y], (m + r,), and the ``number`` of the sample whose
        errors times (K,) have; None: each its own. If ``relative``, what :meth:`update` finds is a
        factor.
        """
        self._deviations, self._number, self._relative = np.sqrt(variances), number, relative
        self.noisy = variances > 0.0  # (m + r,)
        self._factors: list[tuple[Array, int]] = []  # L of [ζ; e; s] of each case, how wide
        self._before: tuple[Array, Array] | None = None  # C and D of the last sample
        self._last = -np.inf
        self._expected, self._square = 0.0, 0.0  # E∫|δY|² so far, E|δY|² at the last sample

    def update(
        self, observer: ErrorSteps, cases: Sequence[ErrorRecursion],
        regression: SampledRegression, gain: Array, roots: Array,
    ) -> tuple[Array, Array]:
        """Deviations of η̂ and x̂ of every case at K samples (G, K, p + n), and their factor (K,).

        ``observer`` takes errors of [u; y] to those of Y and of the state's offset, ``cases`` those
        of Y to those of η̂. The gain of x = offset + gain η is (K, n, p), or of each case its own,
        (G, K, n, p), and ``roots`` are S of all data so far, without forgetting, (K, p + 1, p + 1).
        """
        count, n, p = gain.shape[-3:]
        gains = np.broadcast_to(gain, (len(cases), count, n, p))
        k, rows, signals = observer.step.shape[1], observer.C.shape[1] - n, len(self._deviations)
        C, D = observer.C, observer.D
        before = (C[:1], D[:1]) if self._before is None else self._before
        self._before = C[-1:], D[-1:]
        C_old, D_old = (
            np.concatenate([old, new[:-1]])[:, :rows]
            for old, new in zip(before, (C, D), strict=True)
        )
        number = regression.t if self._number is None else self._number(regression.t)
        fresh = np.diff(number, prepend=self._last) > 0
        self._last = float(number[-1])
        Y_new = C[:, :rows] @ observer.step  # δY' of [ζ; e; e'], but for D e'
        Y_new[:, :, k + signals :] += D[:, :rows]
        Y_old = np.concatenate([C_old, D_old, np.zeros((count, rows, signals))], axis=2)
        if self._relative:  # with h as of least squares
            plain = integrating(regression)
            cases = [_beside(ErrorRecursion(*plain, plain.A), cases[0]), *cases[1:]]
        out = np.empty((len(cases), count, p + n))
        for g, case in enumerate(cases):
            size = k + signals + case.A.shape[1]
            M = np.zeros((count, size, size + signals))
            both = np.r_[: k + signals, size : size + signals]  # ζ and the errors of two samples
            M[:, :k, both] = observer.step
            M[:, k : k + signals, size:] = np.eye(signals)
            M[:, k + signals :, both] = case.old @ Y_old + case.new @ Y_new
            M[:, k + signals :, k + signals : size] = case.A
            if len(self._factors) <= g:
                self._factors.append((np.zeros((size, size)), size))
            L = self._recursion(g, M, fresh, slice(k, k + signals))
            eta = case.C @ L[:, k + signals :]
            own = eta[:, -p:]
            x = gains[g] @ own + C[:, rows:] @ L[:, :k] + D[:, rows:] @ L[:, k : k + signals]
            out[g] = np.linalg.norm(np.concatenate([own, x], axis=1), axis=2)
            if g == 0 and self._relative:
                of_Y = C[:, :rows] @ L[:, :k] + D[:, :rows] @ L[:, k : k + signals]
                level = self._level(regression, (of_Y**2).sum(axis=(1, 2)), eta[:, :p], roots)
        return out, level if self._relative else np.ones(count)

    def _recursion(self, g: int, M: Array, fresh: BoolArray, errors: slice) -> Array:
        """L of one case at the samples, (K, d, ·), from [z; e'] to z' (K, d, d + signals).

        The errors of several samples stand side by side, before it is made triangular again.
        """
        size, signals = M.shape[1], len(self._deviations)
        A, new = M[:, :, :size], M[:, :, size:]
        A[~fresh, :, errors] += new[~fresh]  # the errors are those of the sample before
        new = new * self._deviations
        out = np.zeros((len(M), size, size + BESIDE * signals))
        L, used = self._factors[g]
        for k, own in enumerate(fresh.tolist()):
            if own and used == out.shape[2]:
                L, used = np.asarray(np.linalg.qr(L.T, mode="r")).T, size
            np.matmul(A[k], L[:, :used], out=out[k, :, :used])
            if own:
                out[k, :, used : used + signals] = new[k]
                used += signals
            L = out[k]
        self._factors[g] = L.copy(), used
        return out

    def _level(
        self, regression: SampledRegression, of_Y: Array, of_h: Array, roots: Array
    ) -> Array:
        """σ (K,) from the residual so far, see :func:`noise_level`; NaN where nothing is left."""
        old, new = regression.shares
        before = np.append(self._square, of_Y[:-1])
        expected = self._expected + np.cumsum(old * before + new * of_Y)
        self._expected, self._square = float(expected[-1]), float(of_Y[-1])
        _, sigma, Vt = np.linalg.svd(roots[:, :-1, :-1])
        known = sigma**2 > SINGULAR * sigma[:, :1] ** 2
        fitted = reciprocals(sigma, known)[..., None] * (Vt @ of_h)
        left = expected - (fitted**2).sum(axis=(1, 2))
        left[left <= LEFT * expected] = np.nan
        return np.asarray(np.abs(roots[:, -1, -1]) / np.sqrt(left))


def _beside(a: ErrorRecursion, b: ErrorRecursion) -> ErrorRecursion:
    """Two systems of the same errors of Y as one, one above the other."""
    def diagonal(x: Array, y: Array) -> Array:
        out = np.zeros((len(x), x.shape[1] + y.shape[1], x.shape[2] + y.shape[2]))
        out[:, : x.shape[1], : x.shape[2]], out[:, x.shape[1] :, x.shape[2] :] = x, y
        return out

    return ErrorRecursion(
        diagonal(a.A, b.A), np.concatenate([a.old, b.old], axis=1),
        np.concatenate([a.new, b.new], axis=1), diagonal(a.C, b.C),
    )
