"""Consistent values: at the start, and after a jump of the input.

These are two different questions. At the start the user's x0 may break constraints, and the
differential part of it is kept. At a jump the solution is already running and what happens to it
is decided by the equation itself, in the sense of distributions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import perm

import numpy as np

from gpebo_cli.errors import ModelError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.reduction.strangeness_free import StrangenessFree, strangeness_free_form
from gpebo_cli.reduction.structure import Structure

_EPS = float(np.finfo(float).eps)
_ROUNDING = 16  # units in the last place of everything that a value is made of
_IMPULSE = 1e-9  # impulses below this share of the state's size are rounding


def consistent_state(form: StrangenessFree, x0: Array, weights: Array) -> Array:
    """The consistent x nearest to x0 in its differential part, shape (n,).

    Minimises ‖W E (x − x0)‖ subject to A2 x + f2 = 0 at the first time of ``form``, where the
    weights W (n,) make the rows of E comparable, see :class:`.scaling.Scaling`. Unique,
    because E has full column rank on the kernel of A2; NaN where numbers are so large or so small
    that it has not. A state that satisfies the constraints to rounding is returned as it is.
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
    if (np.abs(E @ moved) > _ROUNDING * _EPS * (np.abs(E) @ (through + terms))).any():
        image = weights[:, None] * (E @ T)
        norms = np.linalg.norm(image, axis=0)
        if not (np.isfinite(norms) & (norms > 0.0)).all():
            return np.full(len(x0), np.nan)
        moved -= T @ (np.linalg.lstsq(image / norms, weights * (E @ moved), rcond=None)[0] / norms)
    x = x0 + moved
    # What did not move keeps the digits it was given.
    return np.where(np.abs(moved) <= 2 * _ROUNDING * _EPS * (terms + np.abs(x)), x0, x)


@dataclass(frozen=True, eq=False)
class Jump:
    """What a jump of the input does at one time."""

    after: Array  # (n,) the state just after
    impulses: Array  # (μ, n) coefficients of δ, δ', … in x


def jumps(
    system: DescriptorSystem, structure: Structure, times: Array, widths: Array
) -> Callable[[int, Array], Jump]:
    """The jump k at times[k] (N,), a function of k and of the state's limit from the left (n,).

    ``widths`` (N,) tell how far beside the times the sides of a jump are looked at.

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
    levels, n, beside = structure.mu + 1, system.n, times + widths
    after = system.coefficients.taylor(times, structure.mu, beside)
    left = system.coefficients.taylor(times, 0, times - widths)
    form = strangeness_free_form(system, structure, times, beside, after)

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
                blocks[j, :, i] += sign * after.E[i - j, k]
                if i + 1 < levels:
                    blocks[j, :, i + 1] -= sign * after.A[i - j, k]
        whole[levels * n :, 0] = A2
        matrix, right = whole.reshape(len(whole), -1), np.zeros(len(whole))
        right[levels * n :] = -(form.f2[k] + A2 @ before)
        # Rows by their own size: an equation in microfarads weighs as much as one in ohms.
        size = np.abs(matrix).max(axis=1)
        size[size == 0] = 1.0
        w, *_ = np.linalg.lstsq(matrix / size[:, None], right / size, rcond=1e-12)
        residual = np.abs(matrix @ w - right) / size
        scale = max(float(x.max(initial=1e-300)) for x in (np.abs(right / size), np.abs(before)))
        if residual.max(initial=0.0) > 1e-7 * scale:
            raise ModelError(
                f"plant {system.name}: the jump at t = {t:.6g} has no solution "
                f"(residual {residual.max() / scale:.1e}): no state after it satisfies the "
                "equations; use an input without it, or a horizon that ends before"
            )
        w = w.reshape(levels, n)
        impulses = np.where(np.abs(w[1:]) > _IMPULSE * scale, w[1:], 0.0)
        # E or A may jump only where it is not multiplied by an impulse.
        for name, (before_it, after_it), factors in (
            ("E", (left.E[0, k], after.E[0, k]), [w[0], *impulses]),
            ("A", (left.A[0, k], after.A[0, k]), [*impulses]),
        ):
            change = after_it - before_it
            most = max((np.abs(change @ factor).max() for factor in factors), default=0.0)
            if most > 1e-9 * scale * max(1.0, float(np.abs(change).max())):
                raise ModelError(
                    f"plant {system.name}: {name} jumps at t = {t:.6g} where the state has an "
                    "impulse or a jump of its own, and their product is undefined; take the "
                    "conserved quantity (charge, momentum) as the state"
                )
        # On the constraints to the last digit: a component that they make zero is zero.
        state = at(form.basis, k) @ (at(form.E1, k) @ (before + w[0])) + form.offset[k]
        return Jump(state, impulses)

    return jump
