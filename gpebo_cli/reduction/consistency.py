"""Consistent values: at the start, and after a jump of the input.

Both are one question: which state follows, in the sense of distributions, from the one just before?
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import perm

import numpy as np

from gpebo_cli.errors import ModelError
from gpebo_cli.kernels.structure_numpy import scaled
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.reduction.strangeness_free import StrangenessFree, strangeness_free_form
from gpebo_cli.reduction.structure import Structure

_EPS = float(np.finfo(float).eps)
_ROUNDING = 16  # units in the last place of everything that a value is made of
_IMPULSE = 1e-9  # impulses below this share of what they are made of are rounding


def consistent_state(
    form: StrangenessFree, x0: Array, step: Callable[[Array], Array]
) -> Array:
    """The state (n,) that follows at once from x0, at the first time of ``form``.

    One that satisfies A2 x + f2 = 0 to rounding is returned as it is, and if some consistent state
    has the same E x, that is the one. Otherwise ``step`` tells, see :func:`jumps`: NaN where
    numbers are too large.
    """
    if not form.A2.shape[1]:
        return x0.copy()
    E, E1, T, offset = form.E[0], form.E1[0], form.basis[0], form.offset[0]
    size = np.abs(x0)
    moved = T @ (E1 @ x0) + offset - x0  # to the consistent state with the same z = E1 x
    through = form.amplification[:, :-1] @ size + form.amplification[:, -1]
    terms = np.abs(T) @ (np.abs(E1) @ size) + np.abs(offset) + size
    if (np.abs(moved) <= _ROUNDING * _EPS * (through + terms)).all():
        return x0.copy()
    x = x0 + moved
    if (np.abs(E @ moved) > _ROUNDING * _EPS * (np.abs(E) @ (through + terms))).any():
        x = step(x0)
    # What did not move keeps the digits it was given.
    return np.where(np.abs(x - x0) <= 2 * _ROUNDING * _EPS * (terms + np.abs(x)), x0, x)


@dataclass(frozen=True, eq=False)
class Jump:
    """What a jump of the input does at one time."""

    after: Array  # (n,) the state just after
    impulses: Array  # (μ, n) coefficients of δ, δ', … in x


def jumps(
    system: DescriptorSystem, structure: Structure, times: Array, before: Array, after: Array,
    form: StrangenessFree | None = None,
) -> Callable[[int, Array], Jump]:
    """The jump k at times[k] (N,), a function of k and of the state's limit from the left (n,).

    ``before`` and ``after`` (N,) tell on which sides of the times the model is looked at; at the
    start both are after it. ``form`` are the equations at the times, where they are at hand.

    With x = x_regular + Σ_k w_{k+1} δ^(k) and a step w_0 = x(t+) − x(t−), the coefficient of
    δ^(j) in E x' = A x + f (f jumps but has no impulse) gives, j = 0 … μ,

        Σ_{k≥j} (−1)^{k−j} C(k, k−j) [ E^(k−j) w_k − A^(k−j) w_{k+1} ] = 0,      w_{μ+1} = 0,

    beside the constraints after the jump. Keeping the differential part (minimal ‖E w_0‖) was
    rejected: where an input's impulse drives a differential state it is wrong. In x1' = x3, x2' = 2
    x3, 0 = x1 − u, a unit step of u moves x2 by 2, not by 0 (ModelError: E or A jumps at a time
    where the state has an impulse, so that their product means nothing, or no state after the jump
    satisfies the equations).
    """
    if structure.a == 0:  # without constraints the state follows no jump
        return lambda _, before: Jump(before, np.zeros((structure.mu, system.n)))
    levels, n, units = structure.mu + 1, system.n, structure.scaling
    c = system.coefficients.taylor(times, structure.mu, after)
    form = form or strangeness_free_form(system, structure, times, after, c)
    left = system.coefficients.taylor(times, 0, before)
    scales = units.rows, units.columns, units.time
    (e, a), (e0, a0) = scaled(c.E, c.A, *scales, levels), scaled(left.E, left.A, *scales, 1)
    changes = e[0] - e0[0], a[0] - a0[0]

    def at(part: Array, k: int) -> Array:
        """Of matrices at all times, or of one that is the same at all."""
        return np.asarray(part[k % len(part)])

    def jump(k: int, before: Array) -> Jump:
        """The jump k from the state (n,) before it (ModelError: as above)."""
        t, A2 = float(times[k]), at(form.A2, k)
        whole = np.zeros((levels * n + structure.a, levels, n))
        blocks = whole[: levels * n].reshape(levels, n, levels, n)
        for j in range(levels):
            for i in range(j, levels):
                sign = (-1.0) ** (i - j) * perm(i, i - j)
                blocks[j, :, i] += sign * at(e[i - j], k)
                if i + 1 < levels:
                    blocks[j, :, i + 1] -= sign * at(a[i - j], k)
        whole[levels * n :, 0] = A2 * units.columns
        matrix, right = whole.reshape(len(whole), -1), np.zeros(len(whole))
        right[levels * n :] = -(form.f2[k] + A2 @ before)
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            return Jump(np.full(n, np.nan), np.zeros((structure.mu, n)))
        # Rows by their own size: an equation in microfarads weighs as much as one in ohms.
        size = np.abs(matrix).max(axis=1)
        size[size == 0] = 1.0
        matrix, right = matrix / size[:, None], right / size
        inverse = np.linalg.pinv(matrix, rcond=1e-12)
        w = inverse @ right
        w += inverse @ (right - matrix @ w)  # small states beside large ones keep their digits
        residual = np.abs(matrix @ w - right)
        known = np.abs(right), np.abs(before / units.columns)
        scale = max(float(x.max(initial=1e-300)) for x in known)
        if residual.max(initial=0.0) > 1e-7 * scale:
            raise ModelError(
                f"plant {system.name}: the jump at t = {t:.6g} has no solution "
                f"(residual {residual.max() / scale:.1e}): no state after it satisfies the "
                "equations; use an input without it, or a horizon that ends before"
            )
        terms = np.abs(form.f2[k]) + np.abs(A2) @ np.abs(before)
        terms, of = terms / size[levels * n :], np.abs(inverse[n:, levels * n :])
        all_terms = terms.sum() + known[1].sum()  # a state that is made zero is rounding
        rounding = _IMPULSE * of @ terms + _ROUNDING * _EPS * of.max(initial=0.0) * all_terms
        w[n:][np.abs(w[n:]) <= rounding] = 0.0
        w = w.reshape(levels, n)
        # E or A may jump only where it is not multiplied by an impulse.
        for name, all_changes, factors in zip("EA", changes, (w, w[1:]), strict=True):
            change = at(all_changes, k)
            most = max((np.abs(change @ factor).max() for factor in factors), default=0.0)
            if most > 1e-9 * scale * max(1.0, float(np.abs(change).max())):
                raise ModelError(
                    f"plant {system.name}: {name} jumps at t = {t:.6g} where the state has an "
                    "impulse or a jump of its own, and their product is undefined; take the "
                    "conserved quantity (charge, momentum) as the state"
                )
        w *= units.columns * units.time ** np.arange(levels)[:, None]
        # On the constraints to the last digit: a component that they make zero is zero.
        state = at(form.basis, k) @ (at(form.E1, k) @ (before + w[0])) + form.offset[k]
        return Jump(state, w[1:])

    return jump
