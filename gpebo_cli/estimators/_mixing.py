"""Mixing: from Ω η = 𝒴 to one scalar equation per parameter, 𝐘 = Δ η."""

from __future__ import annotations

import numpy as np

from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.estimators._scalar import ScalarPath, scalar_path
from gpebo_cli.linalg import determinant_and_adjugate_action
from gpebo_cli.systems.descriptor import Array, BoolArray

# Below this reciprocal condition number of Ω the quotient 𝐘/Δ is rounding noise. It is not
# needed there either: its weight in every law is ∫Δ².
SINGULAR = 1e-14


def mix(extended: Trajectory, t: Array) -> ScalarPath:
    """Mix [Ω | 𝒴] (p, p + 1): the path that the scalar law takes, reported at the times t (M,)."""

    def signals(t: Array, inside: Array) -> tuple[Array, Array]:
        values = extended(t, inside)
        return determinant_and_adjugate_action(values[..., :-1], values[..., -1])[:2]

    values = extended.values
    delta, Y, reciprocal = determinant_and_adjugate_action(values[..., :-1], values[..., -1])
    usable = (reciprocal > SINGULAR) & (delta != 0.0)
    quotient = np.divide(Y, delta[..., None], out=np.zeros_like(Y), where=usable[..., None])
    quotient = filled(quotient, usable)
    return scalar_path(extended.mesh, signals, delta, quotient, t)


def filled(quotient: Array, usable: BoolArray) -> Array:
    """Replace unusable rows of η̄ (K, s + 1, p) by the next usable one (the last, at the end)."""
    flat, index = usable.ravel(), np.arange(usable.size)
    if not flat.any():
        return np.zeros_like(quotient)
    following = np.minimum.accumulate(np.where(flat, index, usable.size)[::-1])[::-1]
    chosen = np.minimum(following, np.flatnonzero(flat)[-1])
    return np.asarray(quotient.reshape(usable.size, -1)[chosen].reshape(quotient.shape))
