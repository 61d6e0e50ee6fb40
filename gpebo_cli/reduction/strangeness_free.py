"""The strangeness-free equations at many times, once the structure is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.kernels.arrays import joined
from gpebo_cli.kernels.structure_numpy import (
    by_elimination,
    derivative_array,
    in_own_states,
    scaled,
)
from gpebo_cli.model.descriptor import Array, BoolArray, Coefficients, DescriptorSystem, distinct
from gpebo_cli.numerics.linalg import inverse_or_none, taylor_product, transpose
from gpebo_cli.reduction.stages import UnclearError, in_stages
from gpebo_cli.reduction.structure import RESIDUAL, Structure, unclear_ranks, who

MAX_GROWTH = 3e2  # of the elimination; beyond it singular vectors are computed instead
_EPS = float(np.finfo(float).eps)
_MOVED = ("E", "A", "B", "F", "u", "theta", "phi")
LOOKS = 32  # times at which the sensitivity to rounding is looked at


def forcing(c: Coefficients) -> Array:
    """Taylor coefficients of f = B u + F θ + φ, shape (K + 1, N, n)."""
    return np.asarray(c.phi + taylor_product(c.F, c.theta) + taylor_product(c.B, c.u))


@dataclass(frozen=True, eq=False)
class StrangenessFree:
    """E1 x' = A1 x + f1 (d rows) and 0 = A2 x + f2 (a rows) at N times.

    The consistent states are x = T z + offset with z = E1 x. The matrices have a leading axis of 1
    when E and A are constant.
    """

    E1: Array  # (N or 1, d, n)
    A1: Array  # (N or 1, d, n)
    f1: Array  # (N, d)
    A2: Array  # (N or 1, a, n)
    f2: Array  # (N, a)
    basis: Array  # (N or 1, n, d) T, of the kernel of A2, with E1 T = I
    offset: Array  # (N, n)
    # By how much relative rounding of each state and of f2 reaches each state through the
    # constraints, the most at some of the times.
    amplification: Array  # (n, n + 1)
    E: Array  # (N or 1, n, n) the model's own
    u: Array  # (N, m) the inputs and
    C: Array  # (N or 1, r, n) the output matrix at the same times
    direct: Array  # (N or 1, r) D u + H θ, what the state has no part in
    # What A1 and f1 are the sum of, at the last of so many times as were asked for.
    terms: Array | None  # (M, d, n + 1) sizes; None: none were asked for


def strangeness_free_form(
    system: DescriptorSystem, structure: Structure, t: Array, inside: Array,
    c: Coefficients | None = None, points: int = 0,
) -> StrangenessFree:
    """The strangeness-free equations at the times t (N,), one sweep over all of them.

    ``c`` are the model's coefficients there to the order μ, where they are at hand; at the last of
    so many ``points`` each, terms are looked at.

    Elimination on the pivots of one reference time where that is well conditioned, singular
    vectors at the times where it is not.
    """
    mu, scaling = structure.mu, structure.scaling
    if c is None:
        c = system.coefficients.taylor(t, mu, inside)
    zero, direct = system.coefficients.zero, direct_part(c, system.coefficients.zero)
    F, theta = c.F, c.theta
    if "phi" not in zero:  # one more unknown, whose value is known to be 1
        F = np.concatenate([F, c.phi[..., None]], axis=3)
        theta = np.pad(theta, ((0, 0), (0, 0), (0, 1)))
        theta[0, :, -1] = 1.0
    count = slice(0, 1) if structure.time_invariant else slice(None)
    E, A = c.E[:, count], c.A[:, count]
    model = (scaling.rows, scaling.columns, scaling.time, mu + 1)
    every = max(1, len(t) // LOOKS)
    found = None if structure.stages else kernels.structure.eliminated(
        E, A, *model, c.B, F, c.u, theta, *structure.reference, every, MAX_GROWTH, RESIDUAL
    )
    if found is None:
        f = forcing(c)
        found = in_own_states(
            E[0], A[0], f[0], *reduced(system, structure, E, A, f[..., None], t, every),
            *model[:2], every,
        )
    E1, A1, f1, A2, f2, basis, offset, amplification = found
    terms = None
    if points:
        e, T, a, b, f, u, v = (
            x if len(x) == 1 else x[points - 1 :: points]
            for x in (E[0], basis, A[0], c.B[0], F[0], c.u[0], theta[0])
        )
        # The equations are those of the rows (E T)ᵀ, because it has orthonormal columns.
        W1 = np.abs(transpose(e @ T) * scaling.rows**2)
        f = np.abs(b) @ np.abs(u)[:, :, None] + np.abs(f) @ np.abs(v)[:, :, None]
        terms = W1 @ joined(np.abs(a), f, axis=2)
    return StrangenessFree(
        E1, A1, f1, A2, f2, basis, offset, amplification, E[0], c.u[0], distinct(c.C)[0], direct,
        terms,
    )


def shown_rounding(
    system: DescriptorSystem, structure: Structure, t: Array, inside: Array, x: Array
) -> Array:
    """By how much states x (N, n, 1) at times t (N,) miss the constraints, at most, (n, 1).

    How rounding of one stage shows in the next depends on how fast the states move, and no bound
    tells it closely. It is seen instead: the equations, multiplied by factors, keep their
    solutions, and what they say of these ones is different rounding; so do entries that are moved
    by what rounding of them and of the time may be.
    """
    c, rng = system.coefficients.taylor(t, structure.mu + 1, inside), np.random.default_rng(0)
    factors = rng.uniform(1.0, 1.1, (len(t), system.n, 1))

    def moved(x: Array) -> Array:
        """Coefficients, one order less, moved by rounding of their own and of the time."""
        slope = x[1:] * np.arange(1.0, len(x)).reshape(-1, *[1] * (x.ndim - 1))
        wrong = np.abs(x[:-1]) + np.abs(t.reshape(-1, *[1] * (x.ndim - 2)) * slope)
        return np.asarray(x[:-1] + _EPS * rng.uniform(-1.0, 1.0, wrong.shape) * wrong)

    c = c._replace(**{name: moved(getattr(c, name)) for name in _MOVED})
    E, A, f = c.E * factors, c.A * factors, forcing(c)[..., None] * factors
    found, units = reduced(system, structure, E, A, f, t, 1), structure.scaling.columns[:, None]
    missed = found.inverse[:, :, structure.d :] @ (found.A2 @ (x / units) + found.f2)
    return np.asarray((units * np.abs(missed)).max(axis=0))


class Reduced(NamedTuple):
    """0 = Â2 x + f2 in scaled rows and states, and what completes it, at N times."""

    A2: Array  # (N or 1, a, n)
    f2: Array  # (N, a, c)
    size: Array  # (·, a, n + c) of the terms of [Â2 f2], at every so many of the times
    inverse: Array  # (N or 1, n, n) of [Z1ᵀE; Â2], with any Z1 (n, d) with which there is one


def reduced(
    system: DescriptorSystem, structure: Structure, E: Array, A: Array, f: Array, t: Array,
    every: int,
) -> Reduced:
    """The constraints at the times t (N,), by stages, or by elimination from the reference.

    Singular vectors are taken at times where the pivots of the reference will not do. E and A are
    Taylor coefficients to the order μ (μ + 1, N or 1, n, n), f those of each column (μ + 1, N, n,
    c); at ``every`` so many times sizes are looked at.
    """
    mu, s = structure.mu, structure.scaling
    e, a = scaled(E, A, s.rows, s.columns, s.time, mu + 1)
    weights = (s.time ** np.arange(mu + 1))[:, None] * s.rows
    g = f[: mu + 1] * weights[:, None, :, None]
    if structure.stages:
        try:
            found = in_stages(e, a, g, structure.rank_tol, every, structure.stages)
        except UnclearError as unclear:
            raise unclear_ranks(system, t, unclear) from unclear
        whole = np.concatenate([transpose(found.Z1) @ e[0], found.A2], axis=1)
        inverse, poor = inverse_or_none(whole)
        _refuse_undetermined(system, poor, t)
        return Reduced(found.A2, found.f2, found.size, inverse)
    M, N = derivative_array(e, a, mu)
    # [Â2 | f2] = Z2ᵀ [N | g] with g = (f_0, …, f_μ)
    g = np.moveaxis(g, 0, 1).reshape(len(t), -1, g.shape[3])
    A2, f2, size, inverse, poor = by_elimination(
        e[0], M, N, g, *structure.reference, every, MAX_GROWTH, RESIDUAL
    )
    if not poor.any():
        return Reduced(A2, f2, size, inverse)
    Z1, Z2 = _by_singular_vectors(
        system, structure, e[0][poor], M[poor], N[poor], t[: len(M)][poor]
    )
    # What the elimination made grow there is not used, and amplifies nothing.
    A2[poor] = transpose(Z2) @ N[poor]
    everywhere, some = np.broadcast_to(poor, len(t)), slice(0, None, every)
    f2[everywhere] = transpose(Z2) @ g[everywhere]
    terms = np.abs(joined(N, g, axis=2))
    again = np.arange(len(t))[some][everywhere[some]]
    which = again if len(M) > 1 else np.zeros_like(again)
    size[everywhere[some]] = np.abs(transpose(Z2))[np.cumsum(poor)[which] - 1] @ terms[again]
    whole = np.concatenate([transpose(Z1) @ e[0][poor], A2[poor]], axis=1)
    inverse[poor], poor[poor] = inverse_or_none(whole)
    _refuse_undetermined(system, poor, t)
    return Reduced(A2, f2, size, inverse)


def _refuse_undetermined(system: DescriptorSystem, poor: BoolArray, t: Array) -> None:
    if poor.any():
        raise ModelError(
            f"{who(system)}: the equations do not determine the state near "
            f"t = {t[int(np.argmax(poor))]:.9g}"
        )


def direct_part(c: Coefficients, zero: frozenset[str]) -> Array:
    """D u + H θ at N times, (N, r), or at one where both vanish: what no state has part in."""
    if {"D", "H"} <= zero:
        return np.zeros((1, c.C.shape[2]))
    of_input, of_unknowns = taylor_product(c.D[:1], c.u[:1]), taylor_product(c.H[:1], c.theta[:1])
    return np.asarray(of_input[0] + of_unknowns[0])


def _by_singular_vectors(
    system: DescriptorSystem, structure: Structure, E: Array, M: Array, N: Array, t: Array
) -> tuple[Array, Array]:
    """Orthonormal Z1 (N, n, d) and Z2 (N, ·, a) where the reference pivots will not do."""
    a, tol = structure.a, structure.rank_tol
    r = M.shape[1] - a
    U, sigma, _ = np.linalg.svd(M)
    size = sigma[:, 0]
    zero = sigma[:, r:].max(axis=1, initial=0.0) > 1e3 * tol * size
    bad = zero | (sigma[:, r - 1] <= tol * size) if r else zero
    if bad.any():
        k = int(np.argmax(bad))
        value = (sigma[k, r] if zero[k] else sigma[k, r - 1]) / (size[k] or 1.0)
        raise ModelError(
            f"{who(system)}: the rank of the derivative array changes near t = {t[k]:.9g} "
            f"(singular value {value:.1e}); choose a horizon that avoids this time"
        )
    Z2 = U[:, :, r:]
    T2 = transpose(np.linalg.svd(transpose(Z2) @ N)[2])[:, :, a:]
    return np.linalg.svd(E @ T2, full_matrices=False)[0], Z2
