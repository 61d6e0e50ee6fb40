"""The linear system that the Kalman–Bucy filter follows, and the covariances of its noise.

With w = P x and everything else as in ``observers/gpebo.py``, the plant is the linear system

    w' = A_0 w + b_0 + D_0 θ,   θ' = 0,      0 = R (𝒜 w + G θ + g_y)

whose state ζ = (θ, w) a Kalman–Bucy filter estimates: unknown parameters are constant states. Of
the residual's n + r rows r are independent; Z(t) is an orthonormal basis of them, and no result
depends on which. An observer sees u + ν_u and y + ν_y, and both enter twice:

    b_0 seen = b_0 + B_0 ν_u + B_y ν_y     so that   ζ' = 𝔸ζ + b_0 seen + Γν,  Γ = −[0; B_0  B_y]
    z = −Zᵀg_y seen = c ζ + Dν,            c = Zᵀ[G  𝒜],     D = Zᵀ[−g_inputs  E_y]

with g_y = g_inputs u − E_y y. Noise with standard deviation σ per sample of T_s seconds is, for a
filter that is slow beside T_s, white with intensity σ²T_s; process and measurement noise are
correlated. Where V = DSDᵀ is singular (a constraint that holds exactly, as e1 = −V in the circuit)
the filter has no finite gain, and V is regularised there: every equation of the residual gets
independent noise, a share of what its terms vary by under P0. Nothing of that is chosen from data,
which would come later. The covariance that the filter states is then an upper bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.kernels.arrays import joined
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.observers._riccati import StateSpace
from gpebo_cli.observers.reduced.matrices import ObserverMatrices
from gpebo_cli.observers.reduced.split import Split, units_along
from gpebo_cli.reduction.form import EquationForm

ROUNDING = 8.0 * float(np.finfo(float).eps)  # of the terms of a sum
_NOTHING = 1e-28  # of the square of the largest row: rounding
_EXACT = 1e-4  # of the variance that would regularise it: what noise leaves below is exact


@dataclass(frozen=True, eq=False)
class FilterModel:
    """The linear system above at N times, before its noise is known; ζ in coordinates of a basis.

    c, g_y and the noise's way into them are in all e + r rows of the residual; ``rows`` is Z.
    Squares ``terms`` are of what c is made of, which does not cancel.
    """

    A: Array  # (N or 1, n, n) of ζ
    b: Array  # (N, n)
    c: Array  # (N, e + r, n)
    terms: Array  # (N or 1, e + r, n)
    rows: Array  # (N, e + r, r) Z
    g_y: Array  # (N, e + r)
    from_noise: Array  # (N or 1, n, m + r) Γ
    in_measurement: Array  # (N, e + r, m + r), D = Zᵀ that
    offset: Array  # (N, states) x_y
    gain: Array  # (N, states, n) [X_θ, X_w]
    direct: Array  # (N, states, m + r) of ν in x_y
    inside: Array  # (N or 1, n, n) diag(I, P)
    steps: Array | float = 1.0  # (N,) seconds between samples over the noise's sample time


def filter_model(
    o: ObserverMatrices, signals: Array, form: EquationForm, steps: Array | float = 1.0
) -> FilterModel:
    """The linear system of the filter, w in coordinates of the observer's basis.

    Matrices are those at N times, signals are [v; y] (N, v + r, 1), and ``steps`` as in the model.
    """
    count, r, basis = len(signals), o.outputs, o.split.basis
    q, k = o.from_unknowns.shape[2], basis.shape[1]
    # w = P w. The range of P(t) turns; rounding outside of it is damped, or it would grow.
    inside = inside_range(q, o.split)
    own = units_along(basis, form.units.states)
    rate = np.linalg.norm(o.dynamics * own / own[:, None], axis=(1, 2))
    damping = rate[:, None, None] * (np.eye(k) - inside[:, q:, q:])
    moving = joined(o.from_unknowns, o.dynamics - damping, axis=2)
    A, inward = (np.pad(rows, ((0, 0), (q, 0), (0, 0))) for rows in (moving, o.from_signals))
    g = np.broadcast_to(o.g_signals, (count, *o.g_signals.shape[1:]))
    c = joined(o.G, o.on_basis, axis=2)
    c = np.broadcast_to(c, (count, *c.shape[1:]))
    terms = joined(np.abs(o.G), np.abs(o.algebraic) @ np.abs(basis), axis=2)
    K_g, K_c = (np.asarray(o.elimination @ (transpose(o.range) @ x)) for x in (g, c))
    gain = -K_c  # [X_θ, X_w B] = [−K G, B − K 𝒜 B]
    gain[:, :, q:] += basis
    if form.structure is not None:
        # Outputs take no part in the elimination, and the constraints have been used up for w.
        Z = np.eye(g.shape[1])[None, :, -r:]
    else:
        # The residual's r rows: of its n rows with Π, those in the range of E are zero.
        L = o.split.equations
        rows = -o.range @ transpose(o.range)
        rows = np.broadcast_to(rows, (max(len(rows), len(L)), *rows.shape[1:])).copy()
        e = L.shape[1]
        rows[:, :e, :e] += L @ transpose(L)
        rows[:, e:, e:] += np.eye(r)
        _, vectors = np.linalg.eigh(0.5 * (rows + transpose(rows)))
        Z = vectors[:, :, e:]
    m = form.system.m
    return FilterModel(
        A=A,
        b=(inward @ signals)[:, :, 0],
        c=c,
        terms=terms**2,
        rows=np.broadcast_to(Z, (count, *Z.shape[1:])),
        g_y=(g @ signals)[:, :, 0],
        from_noise=-o.of_noise(inward, m),
        in_measurement=-o.of_noise(g, m),
        offset=-(K_g @ signals)[:, :, 0],
        gain=gain,
        direct=-o.of_noise(K_g, m),
        inside=inside,
        steps=steps,
    )


def inside_range(q: int, split: Split) -> Array:
    """diag(I, P) in coordinates of ζ, (N, n, n)."""
    moving = split.dual @ split.projector @ split.basis
    inside = np.zeros((len(moving), q + moving.shape[1], q + moving.shape[1]))
    inside[:, :q, :q], inside[:, q:, q:] = np.eye(q), moving
    return inside


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Intensities: of the signals' noise, of what drives ζ, and of what stands for exact ζ."""

    signals: Array  # (m + r,)
    process: Array  # (n,)
    exact: Array  # (n,)

    def measured(self, s: FilterModel) -> tuple[Array, Array, BoolArray]:
        """S Dᵀ (N, m + r, r), V (N, r, r), and in which directions (N, r) V was regularised."""
        Zt = transpose(s.rows)
        D = Zt @ s.in_measurement
        SDt = self.signals[:, None] * np.reshape(s.steps, (-1, 1, 1)) * transpose(D)
        size = s.terms @ self.exact
        # A row without terms is as exact as the largest one.
        largest = size.max(axis=1, keepdims=True)
        size = np.where(size > _NOTHING * largest, size, np.where(largest > 0.0, largest, 1.0))
        L = np.linalg.cholesky((Zt * size[:, None]) @ s.rows)
        whole = np.linalg.solve(L, D @ SDt)
        values, U = np.linalg.eigh(np.linalg.solve(L, transpose(whole)))
        exact = values < _EXACT
        L = L @ U
        return SDt, (L * (values + exact)[:, None]) @ transpose(L), exact

    def state_space(self, s: FilterModel) -> StateSpace:
        """The model with its covariances, one column of signals."""
        Zt = transpose(s.rows)
        SDt, V, _ = self.measured(s)
        c = Zt @ s.c
        c[np.abs(c) <= ROUNDING * (np.abs(Zt) @ np.sqrt(s.terms))] = 0.0
        signals = self.signals * np.reshape(s.steps, (-1, 1, 1))
        Q = (s.from_noise * signals) @ transpose(s.from_noise)
        if self.process.any():
            # w stays in the range of P(t), and so does what drives it.
            Q = Q + (s.inside * self.process) @ transpose(s.inside)
        return StateSpace(
            A=s.A, b=s.b[:, :, None], c=c, z=-(Zt @ s.g_y[:, :, None]), Q=Q,
            N=s.from_noise @ SDt, V=V,
        )
