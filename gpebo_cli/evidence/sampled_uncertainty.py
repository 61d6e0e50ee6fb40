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
        self, variances: Array, row: Callable[[Array], tuple[Array, Array]] | None, *,
        relative: bool, between: bool = False,
    ) -> None:
        """Prepare for the first sample.

        With variances of each row of [u; y], (m + r,), and the number of the ``row`` whose errors
        times (K,) have, with the shares (K,) of the next one, where some are ``between`` rows;
        None: each its own. If ``relative``, what :meth:`update` finds is a factor.
        """
        self._alive = 1 + between  # rows e whose errors a sample has
        self._deviations, self._row = np.tile(np.sqrt(variances), self._alive), row
        self.noisy, self._relative = variances > 0.0, relative  # (m + r,)
        self._factors: list[tuple[Array, int]] = []  # L of [ζ; e; s] of each case, how wide
        # C and D of the last sample, and what it makes of e.
        self._before: tuple[Array, Array, Array] | None = None
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
        k, rows, signals = observer.step.shape[1], observer.C.shape[1] - n, len(self.noisy)
        C, D = observer.C, observer.D
        row, share = self._row(regression.t) if self._row else (regression.t, np.zeros(count))
        passed = np.ceil(np.diff(row, prepend=self._last)).clip(0, self._alive).astype(np.intp)
        self._last, errors = float(row[-1]), len(self._deviations)
        shares = np.stack([1.0 - share, share][: self._alive], axis=1)
        W = np.einsum("ka,ij->kiaj", shares, np.eye(signals)).reshape(count, signals, errors)
        before = (C[:1], D[:1], W[:1]) if self._before is None else self._before
        self._before = C[-1:], D[-1:], W[-1:]
        C_old, D_old, W_old = (
            np.concatenate([old, new[:-1]]) for old, new in zip(before, (C, D, W), strict=True)
        )
        C_old, D_old = C_old[:, :rows], D_old[:, :rows]
        # What e and new errors make of e, and of the errors of the last sample and of this one.
        kept = np.stack([np.eye(errors, k=j * signals) for j in range(self._alive + 1)])[passed]
        drawn = np.eye(errors) * (1.0 - kept.sum(axis=2))[:, :, None]
        turned = np.concatenate([kept, drawn], axis=2)
        both = np.concatenate([np.pad(W_old, ((0, 0), (0, 0), (0, errors))), W @ turned], axis=1)
        Y_new = C[:, :rows] @ observer.step  # δY' of [ζ; e; e'], but for D e'
        Y_new[:, :, k + signals :] += D[:, :rows]
        Y_old = np.concatenate([C_old, D_old, np.zeros((count, rows, signals))], axis=2)
        if self._relative:  # with h as of least squares
            plain = integrating(regression)
            cases = [_beside(ErrorRecursion(*plain, plain.A), cases[0]), *cases[1:]]
        out = np.empty((len(cases), count, p + n))
        for g, case in enumerate(cases):
            law = slice(k + errors, k + errors + case.A.shape[1])
            size, into_law = law.stop, case.old @ Y_old + case.new @ Y_new
            M = np.zeros((count, size, size + errors))
            into = np.r_[k : k + errors, size : size + errors]
            for part, of_both in ((slice(k), observer.step), (law, into_law)):
                M[:, part, :k], M[:, part, into] = of_both[:, :, :k], of_both[:, :, k:] @ both
            M[:, k : k + errors, into], M[:, law, law] = turned, case.A
            if len(self._factors) <= g:
                self._factors.append((np.zeros((size, size)), size))
            L = self._recursion(g, M, passed > 0)
            eta, e = case.C @ L[:, law], W @ L[:, k : k + errors]
            own = eta[:, -p:]
            x = gains[g] @ own + C[:, rows:] @ L[:, :k] + D[:, rows:] @ e
            out[g] = np.linalg.norm(np.concatenate([own, x], axis=1), axis=2)
            if g == 0 and self._relative:
                of_Y = C[:, :rows] @ L[:, :k] + D[:, :rows] @ e
                level = self._level(regression, (of_Y**2).sum(axis=(1, 2)), eta[:, :p], roots)
        return out, level if self._relative else np.ones(count)

    def _recursion(self, g: int, M: Array, fresh: BoolArray) -> Array:
        """L of one case at the samples, (K, d, ·), from z and new errors to z' (K, d, d + errors).

        The errors of several samples stand side by side, before it is made triangular again.
        """
        size, signals = M.shape[1], len(self._deviations)
        A, new = M[:, :, :size], M[:, :, size:] * self._deviations
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
