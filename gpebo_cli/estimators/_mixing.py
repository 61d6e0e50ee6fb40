"""Mixing: from Ω η = 𝒴 to one scalar equation per parameter, 𝐘 = Δ η."""

from __future__ import annotations

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import SolverError
from gpebo_cli.estimators._scalar import ScalarPath, scalar_path
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Trajectory

# Below this reciprocal condition number of Ω the quotient 𝐘/Δ is rounding noise. It is not needed
# there, because its weight in every law is ∫Δ².
SINGULAR = 1e-14


def mix(extended: Trajectory, t: Array, floor: float = 0.0) -> ScalarPath:
    """Mix [Ω | 𝒴] (p, p + c): the path that the scalar law takes, reported at the times t (M,).

    The law takes c realisations as p·c parameters, in the order of (p, c) (SolverError: Ω is beyond
    what a number can be; names the time).
    """
    p = extended.values.shape[-2]
    finite = np.isfinite(extended.values).all(axis=(1, 2, 3))
    if not finite.all():
        raise SolverError(
            "Ω, which is made of squares of ψ, is too large for a number near t = "
            f"{extended.mesh.edges[int(np.argmin(finite))]:.4g}; write Y and ψ in larger units"
        )

    def signals(t: Array, inside: Array) -> tuple[Array, Array, Array]:
        values = extended(t, inside)
        delta, Y, digits = determinant_and_adjugate_action(values[..., :p], values[..., p:])
        return delta, Y.reshape(len(t), -1), digits

    whole, points = extended.values, extended.values.shape[:2]
    # 𝐘 = adj(Ω) 𝒴 itself is not needed for the quotient: where Δ ≠ 0 it solves Ω η̄ = 𝒴.
    delta, quotient, condition = kernels.laws.mixed(whole.reshape(-1, *whole.shape[2:]))
    usable = (delta != 0.0) & (condition * SINGULAR < 1.0)  # False for nan, too
    digits = np.divide(1.0, condition, out=np.zeros(len(condition)), where=usable)
    return scalar_path(
        extended.mesh, signals, delta.reshape(points), digits.reshape(points),
        filled(quotient.reshape(*points, -1), usable), t, floor,
    )


def filled(quotient: Array, usable: BoolArray) -> Array:
    """Replace unusable rows of η̄ (K, s + 1, p) by the next usable one (the last, at the end)."""
    flat, index = usable.ravel(), np.arange(usable.size)
    if not flat.any():
        return np.zeros_like(quotient)
    following = np.minimum.accumulate(np.where(flat, index, usable.size)[::-1])[::-1]
    chosen = np.minimum(following, np.flatnonzero(flat)[-1])
    return np.asarray(quotient.reshape(usable.size, -1)[chosen].reshape(quotient.shape))
