"""What a reset does to a regression's parameters, and to what is known of them (theory 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.numerics.linalg import reciprocals

_SINGULAR = 1e-14  # share of the largest singular value below which one is rounding
_SYMMETRIC = 1e-8  # below this share of Ω, what is not symmetric is rounding
SURPLUS = 1e4  # integrals: what is known may outweigh what one segment teaches by this factor


@dataclass(frozen=True, eq=False)
class Reset:
    """From ``time`` on the regression is about η₊ = T η + τ (observer.remedy: reset)."""

    time: float
    transform: Array  # (p, p) T, invertible
    shift: Array  # (p,) τ
    floor: float  # size of comparable η₊ that is rounding: it may be a difference of known numbers
    keep: float = 1.0  # share of what is known that still counts
    errors: Array | None = None  # (p, k) what an error ζ of w adds to η₊; None: nobody knows
    before: Array | float = 1.0  # (p,) units in which η is comparable, and
    units: Array | float = 1.0  # (p,) those of η₊

    def parameters(self, eta: Array) -> Array:
        """η₊ of η (..., p)."""
        return np.asarray(eta @ self.transform.T + self.shift)

    def leaves(self, some: BoolArray) -> bool:
        """Whether some of η (p,) go on as they are, as unknowns do."""
        return bool((self.transform[some] == np.eye(len(some))[some]).all())

    def rounding(self, gram: Array) -> Array:
        """What rounding of a root of G (p, p + c) makes of the diagonal (p,) of that of η₊."""
        before, units = (np.broadcast_to(u, len(self.shift)) for u in (self.before, self.units))
        U, sigma, _ = np.linalg.svd(self.transform * before / units[:, None])
        sigma = np.maximum(sigma, _SINGULAR * sigma[0])
        error = np.square(_SINGULAR * sigma[0] / sigma[-1]) * (np.diagonal(gram) * before**2).sum()
        return np.asarray(self.keep * error * np.square(U / sigma).sum(axis=1) / units**2)

    def about(self, columns: IntArray) -> Reset:
        """The same for η at ``columns`` (k,), where the others are zero and go on as they are."""
        before, units = (np.broadcast_to(u, len(self.shift)) for u in (self.before, self.units))
        return replace(
            self, transform=self.transform[np.ix_(columns, columns)], shift=self.shift[columns],
            errors=None if self.errors is None else self.errors[columns],
            before=before[columns], units=units[columns],
        )


@dataclass(frozen=True, eq=False)
class ExtensionState:
    """What is known of η at one time: Ω η = 𝒴, and how much of it is new."""

    values: Array  # [Ω | 𝒴] (p, p + 1)
    # (p,) the diagonal of Ω from one segment's data alone, the largest so far; where parameters
    level: Array | float  # move, the largest of all of [Ω | 𝒴] so far, (p, p + 1)
    memory: float = 1.0  # z of least squares with forgetting
    surplus: float = SURPLUS  # how many times ``level`` a reset may make of Ω
    energy: float = 0.0  # ∫Δ² of a law behind it since it began
    began: float = 0.0  # when data were first gathered
    turned: Array = field(default_factory=lambda: np.zeros((2, 0)))  # (2, 1 + p) [Φ | e]

    def after(self, reset: Reset) -> ExtensionState:
        """The same knowledge of η₊ = T η + τ.

        S Ω T⁻¹ η₊ = S (𝒴 + Ω T⁻¹ τ) holds for any S. S = T⁻ᵀ, Ω₊ = T⁻ᵀ Ω T⁻¹, keeps a Gram matrix
        one. Directions that T shrinks are those in which η₊ is known the better, without bound.
        What exceeds ``surplus`` times that which a segment's data amount to is cut down to it by
        a row of S: float64 holds 16 digits, and those of the other directions are needed. It is
        1e4 for integrals, which add up over segments, and 1 for filters, which do not.

        With Ω = KᵀL, equal factors for a Gram matrix, the columns of L T⁻¹ are of very different
        sizes; QR with the largest first keeps them apart, and a row of R is cut as a whole.
        """
        p = len(self.values)
        before, units = (np.broadcast_to(u, p) for u in (reset.before, reset.units))
        omega, rhs = self.values[:, :-1] * before * before[:, None], before * self.values[:, -1]
        transform, level = reset.transform * before / units[:, None], self.level * before**2
        symmetric = bool(np.abs(omega - omega.T).max() <= _SYMMETRIC * np.abs(omega).max())
        u, size, vt = np.linalg.svd(0.5 * (omega + omega.T) if symmetric else omega)
        known = size > max(_SINGULAR * size[0], np.finfo(float).tiny)
        root = np.sqrt(np.where(known, size, 0.0))  # of nothing that is not known
        rhs = u.T @ rhs * reciprocals(root, known)  # of L η
        U, sigma, Vt = np.linalg.svd(transform)
        inverse = Vt.T / np.maximum(sigma, _SINGULAR * sigma[0])  # T⁻¹ = inverse Uᵀ
        left, right = root[:, None] * (u.T @ inverse), root[:, None] * (vt @ inverse)
        order = np.argsort(-np.linalg.norm(right, axis=0), kind="stable")
        q, r = np.linalg.qr(right[:, order])
        limit = np.sqrt(self.surplus * level.sum())
        share = _share(r, limit)
        right[:, order] = share * r
        rhs = share[:, 0] * (q.T @ rhs) + right @ (U.T @ (reset.shift / units))
        if symmetric:
            left = right.T  # equal but for rounding, which would add up from reset to reset
        else:
            left = (share * (q.T @ left)).T
            left *= _share(left, limit * np.sqrt(len(left)))
        values = (U / units[:, None]) @ left @ np.column_stack([right @ (U.T / units), rhs])
        # What nothing was known of, and what no other one has become, is no rounding of others.
        idle = ~omega.any(axis=0) & (reset.transform == np.eye(len(omega))).all(axis=0)
        values[idle], values[:, :-1][:, idle] = 0.0, 0.0
        return replace(self, values=reset.keep * values, energy=0.0, level=level / units**2)

    def carries(self, reset: Reset) -> Array:
        """S (p, p) of :meth:`after`: what it makes of an error of 𝒴."""
        omega, plain = self.values[:, :-1], replace(reset, shift=np.zeros_like(reset.shift))
        return np.column_stack([
            replace(self, values=np.column_stack([omega, one])).after(plain).values[:, -1]
            for one in np.eye(len(omega))
        ])


Known = Sequence[ExtensionState]
"""Extensions that are known at the start of a segment; none: they start at zero."""


def level_of(values: Array) -> Array:
    """Size of the diagonal (p,) of matrices (…, p, p + c)."""
    diagonal = np.abs(np.diagonal(values, axis1=-2, axis2=-1))
    return np.asarray(diagonal.reshape(-1, diagonal.shape[-1]).max(axis=0, initial=0.0))


def _share(rows: Array, limit: float) -> Array:
    """Factors (m, 1) ≤ 1 that bring rows (m, p) down to a length."""
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.divide(limit, length, out=np.ones_like(length), where=length > limit))
