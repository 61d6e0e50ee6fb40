"""The GPEBO observer for any E(t) of constant rank: one formula (paper, Proposition 1, D1, D5).

With P = E⁺E, Q = I − P, Π = I − E E⁺, the algebraic equations and the outputs are

    𝒜 x + g_y + G θ = 0,      𝒜 = [Π A; C],  g_y = [Π B u; −y],  G = [Π F; 0].

If 𝒜 Q has the rank of Q (Assumption 1, impulse observability), v = Q x follows from w = P x:

    x = X_w w + x_y + X_θ θ,     X_w = I − K 𝒜,  x_y = −K g_y,  X_θ = −K G,   K = (𝒜 Q)⁺
    ẇ = A_0 w + b_0 + D_0 θ,     A_0 = Λ X_w,  b_0 = Λ x_y + E⁺B u,  D_0 = Λ X_θ + E⁺F

with Λ = E⁺A + Ṗ and Ṗ = S + Sᵀ, S = E⁺ Ė Q. The dynamic extension integrates ξ_a, ξ_b, Φ with
this A_0, so that w = ξ_a + ξ_b θ − Φ e₀, and what is left of the algebraic equations after
eliminating v is the regression:

    Y = R (𝒜 ξ_a + g_y),   ψ = [ −R (𝒜 ξ_b + G),  R 𝒜 Φ ],   R = I − 𝒜 Q K,   Y = ψ η.

With weights w of the outputs, rows of C and y are multiplied by √w: K and R become the weighted
elimination K = (W^½ 𝒜 Q)⁺ W^½ and the weighted residual, whose squares ψᵀψ and ψᵀY hold. An output
with noise of variance σ² is worth w = 1/σ².

Only known functions of time are differentiated (Ė); no signal ever is. For E = diag(I, 0) this is
the paper's observer exactly, except that R keeps all rows of the residual: the paper keeps the
last r, which loses everything in its own circuit (``regression: paper`` shows it).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ConfigError, ModelError, SolverError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.collocation import Coefficients, LinearProblem, LinearSolution, solve
from gpebo_cli.numerics.linalg import joined, orthonormal_complement, transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.observers.extension import initial_extension, output_scale
from gpebo_cli.observers.observation import (
    AffineStateMap,
    InitialError,
    Observation,
    largest_entry,
    log_norm,
)
from gpebo_cli.regression.linear import SMALL_SPECTRUM, LinearRegression, outer_products
from gpebo_cli.settings import ObserverSettings, SolverSettings
from gpebo_cli.simulation import ivp

_TURNED = 8 * float(np.finfo(float).eps)  # of E outside the frame, relative: rounding
_PROJECTOR_TURNED = 1e-13
_TINY = float(np.finfo(float).tiny)
_RESPONSE = 1e-6  # error of the response to noise, which is known to no more digits than that
_LARGEST = 1e60  # entry of the dynamic extension: squares of squares are still numbers
_SMALL = 24  # states, up to which NumPy's calls cost more than the kernels' plain loops
_VANISHING = 1e-11  # rows of Y and ψ below this share of the terms they are made of are zero


@dataclass(frozen=True, eq=False)
class Split:
    """E⁺ and the subspaces of E at N times; a leading axis of 1 means constant in time."""

    rank: int  # n_a
    basis: Array  # (n, k) orthonormal B with w = B z: range P where that is constant, else I
    pinv: Array  # (N, k, n) BᵀE⁺
    turn: Array | None  # (N, k, n) BᵀṖ, None for zero
    equations: Array  # (N, e, n) L: Π itself, or the e = n_b equations without derivatives
    kernel: Array  # (N, n, n_b) orthonormal
    projector: Array  # (N, n, n) P
    frame: Frame | None  # None where kernel or range turn


@dataclass(frozen=True, eq=False)
class Frame:
    """Kernel and range of an E(t) in which neither depends on time."""

    domain: Array  # (n, n_a) orthonormal, of range P
    range: Array  # (n, n_a) orthonormal, of range E
    kernel: Array  # (n, n_b)
    equations: Array  # (e, n)

    @cached_property
    def projector(self) -> Array:
        """P, (n, n)."""
        return np.asarray(self.domain @ self.domain.T)


@dataclass(frozen=True, eq=False)
class ObserverMatrices:
    """Every matrix of the observer at N times, known functions of t only.

    With 𝒜 V2 = Q1 R1 (V2 spans the kernel of E), K = H Q1ᵀ with H = V2 R1⁻¹, and the projector
    on the residual is I − Q1 Q1ᵀ. Matrices that do not depend on time have a leading axis of 1.
    """

    split: Split
    rows: Array  # (n,) constants by which the equations were divided
    output_scale: Array  # (r,) √w, by which rows of C and y were multiplied
    dynamics: Array  # (N, k, k) BᵀA_0 B
    from_unknowns: Array  # (N, k, q) BᵀD_0
    from_signals: Array  # (N, k, m + r) Bᵀb_0 = from_signals [u; y]
    algebraic: Array  # (N, e + r, n) 𝒜
    on_basis: Array  # (N, e + r, k) 𝒜 B
    g_signals: Array  # (N, e + r, m + r) g_y = g_signals [u; y]
    G: Array  # (N, e + r, q)
    range: Array  # (N, e + r, n_b) Q1
    elimination: Array  # (N, n, n_b) H
    # At most the smallest singular value of 𝒜 on ker E relative to ‖𝒜‖, at least 1/√n_b of it.
    injectivity: Array  # (N,)

    @property
    def A0(self) -> Array:
        """A_0 in all n coordinates, (N, n, n)."""
        B = self.split.basis
        return np.asarray(B @ self.dynamics @ B.T)

    @property
    def D0(self) -> Array:
        """D_0, (N, n, q)."""
        return np.asarray(self.split.basis @ self.from_unknowns)

    @property
    def from_inputs(self) -> Array:
        """(N, n, m); b_0 = from_inputs u + from_outputs y."""
        m = self.from_signals.shape[2] - self.outputs
        return np.asarray(self.split.basis @ self.from_signals[:, :, :m])

    @property
    def from_outputs(self) -> Array:
        """(N, n, r)."""
        m = self.from_signals.shape[2] - self.outputs
        return np.asarray(self.split.basis @ self.from_signals[:, :, m:])

    @property
    def outputs(self) -> int:
        """Number of outputs r."""
        return int(self.algebraic.shape[1] - self.split.equations.shape[1])

    @property
    def projector(self) -> Array:
        """P = E⁺E, (N, n, n)."""
        return self.split.projector

    @property
    def residual(self) -> Array:
        """R = I − 𝒜 Q K, (N, e + r, e + r)."""
        return orthonormal_complement(self.range)

    def injected(self, gain: Array) -> ObserverMatrices:
        """The same w, driven by gain · (𝒜 w + g_y + G θ) too, for a gain (N, k, e + r).

        The gain must be N = N R with columns in range P: R (𝒜 w + g_y + G θ) = 0 is all that w
        has to fulfil, and w must stay in range P.
        """
        return replace(
            self,
            dynamics=self.dynamics - gain @ self.on_basis,
            from_unknowns=self.from_unknowns - gain @ self.G,
            from_signals=self.from_signals - gain @ self.g_signals,
        )


# (matrices at the times t (N,), t, inside) -> gain (N, k, e + r) of ``ObserverMatrices.injected``
Injection = Callable[[ObserverMatrices, Array, Array], Array]


def row_sizes(entries: Array) -> Array:
    """Size of each row of E over the times, shape (n,), one for rows that are zero.

    Dividing equations by constants changes nothing, but an equation in picofarads would else look
    like a rank deficiency of E. Powers of two: no rounding.

    Args:
        entries: the size of each entry of E over the times, (n, n).
    """
    size = entries.max(axis=1, initial=0.0)
    return np.asarray(np.exp2(np.rint(np.log2(np.where(size > 0, size, 1.0)))))


def _entry_sizes(E: Array) -> Array:
    """Largest size of each entry of E (N, n, n) over the times, (n, n)."""
    if kernels.compiled is not None:
        sizes: Array = kernels.compiled.entry_sizes(E)
        return sizes
    return np.asarray(np.abs(E).max(axis=0))


def observer_matrices(
    system: DescriptorSystem, t: Array, inside: Array, rank_tol: float,
    like: ObserverMatrices | None = None, *, normalise: bool = False,
    output_scale: Array | None = None,
) -> ObserverMatrices:
    """Evaluate the observer's matrices at the times t (N,).

    Args:
        system: the model.
        t: times.
        inside: where functions that jump are decided.
        rank_tol: singular values below this, relative, are zero.
        like: those of other times, whose basis and scaling of the equations are kept.
        normalise: divide the equations by their sizes first, see :func:`row_sizes`.
        output_scale: √w (r,) of the outputs' weights; default: that of ``like``, else ones.

    Raises:
        ModelError: the rank of E is not constant, or Assumption 1 fails; names the time and the
            singular value.
    """
    turning = like is not None and like.split.frame is None
    c = system.coefficients.taylor(t, 1 if turning else 0, inside)
    constant = system.coefficients.constant

    def value(name: str) -> Array:
        matrix: Array = getattr(c, name)[0]
        return matrix[:1] if name in constant else matrix

    model = _Model(value("E"), value("A"), value("B"), value("F"), value("C"))
    if like is not None:
        rows, scale = like.rows, like.output_scale
    else:
        entries = _entry_sizes(model.E)
        rows = row_sizes(entries) if normalise else np.ones(system.n)
        scale = np.ones(system.r)
    if output_scale is not None:
        scale = output_scale
    if kernels.compiled is not None and system.n <= _SMALL:
        frame = _axes_frame(entries) if like is None else like.split.frame
        found = None if frame is None else _in_frame(model, rows, scale, frame, rank_tol)
        if found is not None:
            return found

    def slope() -> Array:
        known = c if turning else system.coefficients.taylor(t, 1, inside)
        return np.asarray(known.E[1][: len(model.E)])

    return _by_steps(system, model, rows, scale, t, rank_tol, like, slope)


class _Model(NamedTuple):
    """The plant's matrices at N times; a leading axis of 1 means constant in time."""

    E: Array
    A: Array
    B: Array
    F: Array
    C: Array


def _in_frame(
    model: _Model, rows: Array, scale: Array, frame: Frame, rank_tol: float
) -> ObserverMatrices | None:
    """What :func:`_by_steps` finds if the frame is that of E at all times, in one call.

    None where it is not, and where singular values have to tell.
    """
    (sizes, pinv, algebraic, on_basis, g_signals, G, Q1, H, injectivity, dynamics, from_unknowns,
     from_signals) = kernels.compiled.in_frame(  # type: ignore[union-attr]
        *model, rows, scale, frame.domain, frame.range, frame.kernel, frame.equations
    )
    rank = frame.domain.shape[1]
    outside, size, inner, inverse, weakest = sizes.tolist()
    if not (_fits(outside, size, rank, inner, inverse, rank_tol) and weakest > rank_tol):
        return None
    return ObserverMatrices(
        _split(frame, pinv), rows, scale, dynamics, from_unknowns, from_signals, algebraic,
        on_basis, g_signals, G, Q1, H, injectivity,
    )


def _by_steps(
    system: DescriptorSystem, model: _Model, rows: Array, scale: Array, t: Array, rank_tol: float,
    like: ObserverMatrices | None, slope: Callable[[], Array],
) -> ObserverMatrices:
    """The observer's matrices from those of the plant at the times t (N,) and Ė (N or 1, n, n)."""
    m, q, r = system.m, system.q, system.r
    E, A, B, F, C = model
    if (rows != 1.0).any():
        E, A, B, F = (matrix / rows[:, None] for matrix in (E, A, B, F))
    C = scale[:, None] * C
    if like is None:
        split = _constant_split(E, system.states, rank_tol)
    else:
        frame = like.split.frame
        split = None if frame is None else split_in_frame(E, frame, rank_tol)
    if split is None:
        known = None if like is None else like.split.basis
        split = _split_by_svd(system, E, slope() / rows[:, None], t, rank_tol, known)

    L, pinv, basis = split.equations, split.pinv, split.basis
    algebraic = joined(L @ A, C, axis=1)  # 𝒜 = [Π A; C]
    on_basis = algebraic @ basis
    e = L.shape[1]
    of_y = np.zeros((1, e + r, r))
    of_y[0, e:] = -np.diag(scale)
    below = np.zeros((1, r, m + q))
    of_u_theta = joined(joined(L @ B, L @ F, axis=2), below, axis=1)
    # g_y = [Π B u; −y] and G = [Π F; 0]
    g_signals, G = joined(of_u_theta[:, :, :m], of_y, axis=2), of_u_theta[:, :, m:]
    Q1, H, injectivity = _eliminate(system, algebraic, split.kernel, t, rank_tol)
    Lambda = pinv @ A if split.turn is None else pinv @ A + split.turn  # Λ = E⁺A + Ṗ
    # [A_0 | D_0 | of u and y] = [Λ | E⁺F | E⁺B, 0] − Λ K [𝒜 | G | g_signals]
    direct = joined(
        Lambda @ basis, pinv @ F, pinv @ B, np.zeros((1, len(basis.T), r)), axis=2
    )
    through = joined(on_basis, G, g_signals, axis=2)
    whole = direct - (Lambda @ H) @ (transpose(Q1) @ through)
    k = basis.shape[1]
    dynamics = whole[:, :, :k]
    return ObserverMatrices(
        split=split,
        rows=rows,
        output_scale=scale,
        dynamics=dynamics[:1] if len(E) == len(A) == len(C) == 1 else dynamics,
        from_unknowns=whole[:, :, k : k + q],
        from_signals=whole[:, :, k + q :],
        algebraic=algebraic,
        on_basis=on_basis,
        g_signals=g_signals,
        G=G,
        range=Q1,
        elimination=H,
        injectivity=injectivity,
    )


def _axes_frame(entries: Array) -> Frame | None:
    """Coordinate axes where E has columns and rows that are exactly zero.

    As in E = diag(E_a(t), 0); None where there are more of the ones than of the others.

    Args:
        entries: the size of each entry of E over the times, (n, n).
    """
    used = entries != 0.0  # NaN is not zero
    rows, columns = used.any(axis=1), used.any(axis=0)
    if np.count_nonzero(rows) != np.count_nonzero(columns):
        return None
    axes = np.eye(len(entries))
    return Frame(axes[:, columns], axes[:, rows], axes[:, ~columns], axes[~rows])


def _constant_split(E: Array, states: tuple[str, ...], rank_tol: float) -> Split | None:
    """E⁺ at the times (N, n, n), if kernel and range of E are the same at all of them.

    Coordinate axes where columns and rows are exactly zero; else from the singular vectors at the
    first time.
    """
    frame = _axes_frame(_entry_sizes(E))
    if frame is not None:
        split = split_in_frame(E, frame, rank_tol)
        if split is not None:
            return split
    U, sigma, Vt = np.linalg.svd(E[0])
    rank = int((sigma > rank_tol * np.linalg.norm(E, axis=(1, 2)).max()).sum())
    U1, V2 = U[:, :rank], Vt[rank:].T
    domain, _ = initial_basis(Vt[:rank].T @ Vt[:rank], rank, states)
    return split_in_frame(E, Frame(domain, U1, V2, orthonormal_complement(U1)), rank_tol)


def split_in_frame(E: Array, frame: Frame, rank_tol: float) -> Split | None:
    """E⁺ = B (UᵀE B)⁻¹ Uᵀ of E (N, n, n), or None.

    None where kernel, range or rank are not those of the frame at one of the times.
    """
    B, U = frame.domain, frame.range
    size, outside = (
        float(np.abs(part).max(initial=0.0)) for part in (E, E @ frame.kernel)
    )
    outside = max(outside, float(np.abs(frame.equations @ E).max(initial=0.0)))
    inner = U.T @ E @ B
    try:
        inverse = np.asarray(np.linalg.inv(inner), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    norms = [
        float(np.linalg.norm(part, axis=(1, 2)).max(initial=0.0)) for part in (inner, inverse)
    ]
    if not _fits(outside, size, B.shape[1], norms[0], norms[1], rank_tol):
        return None
    return _split(frame, inverse @ U.T)


def _fits(
    outside: float, size: float, rank: int, inner: float, inverse: float, rank_tol: float
) -> bool:
    """Whether E has this frame and full rank in it, beyond what singular values could change.

    Args:
        outside: largest entry of E outside the frame.
        size: largest entry of E.
        rank: of the frame.
        inner: largest norm of UᵀE B over the times.
        inverse: largest norm of its inverse.
        rank_tol: singular values below this, relative, are zero.
    """
    if outside > _TURNED * size:
        return False
    return 1.0 / max(inverse, _TINY) > math.sqrt(max(rank, 1)) * rank_tol * inner


def _split(frame: Frame, pinv: Array) -> Split:
    """The split in a frame, with BᵀE⁺ (N, n_a, n)."""
    return Split(
        rank=frame.domain.shape[1], basis=frame.domain, pinv=pinv, turn=None,
        equations=frame.equations[None], kernel=frame.kernel[None],
        projector=frame.projector[None], frame=frame,
    )


def _split_by_svd(
    system: DescriptorSystem, E: Array, dE: Array, t: Array, rank_tol: float, basis: Array | None
) -> Split:
    """The general case: singular vectors at every time, and Ṗ = S + Sᵀ with S = E⁺ Ė Q."""
    U, sigma, Vt = np.linalg.svd(E)
    size = np.maximum(sigma.max(initial=0.0), _TINY)
    ranks = (sigma > rank_tol * size).sum(axis=1)
    if (ranks != ranks[0]).any():
        k = int(np.argmax(ranks != ranks[0]))
        value = sigma[k, min(ranks[k], ranks[0])]
        raise ModelError(
            f"plant {system.name}: the rank of E changes from {ranks[0]} at t = {t[0]:.6g} to "
            f"{ranks[k]} at t = {t[k]:.6g} (singular value {value:.1e}); the observer needs it "
            "constant"
        )
    n_a = int(ranks[0])
    U1, V1, V2 = U[:, :, :n_a], transpose(Vt)[:, :, :n_a], transpose(Vt)[:, :, n_a:]
    pinv_E = (V1 / sigma[:, None, :n_a]) @ transpose(U1)  # E⁺
    P = V1 @ transpose(V1)
    S = pinv_E @ dE @ (V2 @ transpose(V2))  # E⁺ Ė Q
    turned = float(np.abs(P - P[0]).max(initial=0.0)) >= _PROJECTOR_TURNED
    if basis is None:
        basis = np.eye(system.n) if turned else initial_basis(P[0], n_a, system.states)[0]
    elif basis.shape[1] < system.n:
        off = np.abs(P - basis @ basis.T).max(axis=(1, 2))
        if off.max() >= 10 * _PROJECTOR_TURNED:
            raise ModelError(
                f"plant {system.name}: the kernel of E turns near t = {t[int(np.argmax(off))]:.6g} "
                "and nowhere else; start a run there, or make E smooth"
            )
    return Split(
        rank=n_a, basis=basis, pinv=basis.T @ pinv_E, turn=basis.T @ (S + transpose(S)),
        equations=orthonormal_complement(U1), kernel=V2, projector=P, frame=None,
    )


def _eliminate(
    system: DescriptorSystem, algebraic: Array, kernel: Array, t: Array, rank_tol: float
) -> tuple[Array, Array, Array]:
    """Q1 and H of K = (𝒜 Q)⁺ = H Q1ᵀ, and a bound of the singular value behind Assumption 1.

    With Q = V2 V2ᵀ and 𝒜 V2 = Q1 R1, (𝒜 Q)⁺ = V2 R1⁻¹ Q1ᵀ. σ_min(R1) is at least 1/‖R1⁻¹‖_F;
    it is computed itself only where that bound leaves a doubt.
    """
    on_kernel = algebraic @ kernel
    size = np.maximum(np.linalg.norm(algebraic, axis=(1, 2)), _TINY)
    n_b = kernel.shape[2]
    if n_b == 0:
        return on_kernel, kernel[:1], np.full(len(size), np.inf)
    Q1, R1 = np.linalg.qr(on_kernel)
    try:
        inverse = np.asarray(np.linalg.inv(R1), dtype=np.float64)
        bound = 1.0 / (np.linalg.norm(inverse, axis=(1, 2)) * size)
    except np.linalg.LinAlgError:
        inverse, bound = R1, np.zeros(len(R1))
    doubtful = np.flatnonzero(~(bound > rank_tol))
    if len(doubtful):
        smallest = np.linalg.svd(R1[doubtful], compute_uv=False)[:, -1] / size[doubtful]
        if (smallest <= rank_tol).any():
            k = int(np.argmax(smallest <= rank_tol))
            raise ModelError(
                f"plant {system.name}: Assumption 1 (impulse observability) fails at "
                f"t = {t[doubtful[k]]:.6g}: [ΠA; C] has singular value {smallest[k]:.1e} on the "
                "kernel of E; an output that sees the algebraic states is needed"
            )
    return Q1, kernel @ inverse, bound


def _weakest(injectivity: Array, elimination: Array) -> tuple[float, int]:
    """The smallest singular value over all times, relative to ‖𝒜‖, and where it is.

    ‖H‖_F took the place of ‖H‖_2 = 1/σ_min. Only times whose bound is below the true value at
    the time of the smallest bound can be weaker.
    """
    if kernels.compiled is not None and 0 < elimination.shape[2] <= SMALL_SPECTRUM:
        found: Array | None = kernels.compiled.weakest(injectivity, elimination)
        if found is not None:  # else not all is finite
            return float(found[0]), int(found[1])
    if not np.isfinite(injectivity).all():
        return float(np.inf), 0
    H = elimination if len(elimination) > 1 else np.repeat(elimination, len(injectivity), axis=0)

    def exact(which: IntArray) -> Array:
        norms = np.linalg.norm(H[which], axis=(1, 2)) / np.linalg.norm(H[which], 2, axis=(1, 2))
        return np.asarray(injectivity[which] * norms)

    first = np.array([int(np.argmin(injectivity))])
    # Where n_b = 1 the norms are the same but for rounding, and the first remains a candidate.
    limit = max(exact(first)[0], injectivity[first[0]])
    candidates = np.flatnonzero(injectivity <= limit)
    values = exact(candidates)
    k = int(np.argmin(values))
    return float(values[k]), int(candidates[k])


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """w' = A_0 w + b_0 + D_0 θ and 0 = R (𝒜 w + g_y + G θ) on measured signals."""

    system: DescriptorSystem
    inputs: Trajectory
    outputs: Trajectory
    solver: SolverSettings
    mesh: Mesh  # where to start integrating
    first: ObserverMatrices  # at the points of the signals' mesh, without injection
    initial_basis: Array  # (n, n_a) V1
    names: tuple[str, ...]  # of e₀'s components
    injection: Injection | None = None

    @property
    def basis(self) -> Array:
        """Coordinates in which w is integrated, (n, k): n_a of them, or n if the kernel rotates."""
        return self.first.split.basis

    @property
    def rank(self) -> int:
        """n_a."""
        return int(self.first.split.rank)

    def matrices(self, t: Array, inside: Array) -> ObserverMatrices:
        """At the times t (N,), output injection included."""
        o = observer_matrices(self.system, t, inside, self.solver.rank_tol, self.first)
        return o if self.injection is None else o.injected(self.injection(o, t, inside))

    def signals(self, t: Array, inside: Array) -> Array:
        """[u; y] at the times t (N,), shape (N, m + r, 1)."""
        both = np.concatenate([self.inputs(t, inside), self.outputs(t, inside)], axis=1)
        return both[:, :, None]

    def start(self, xi_a: Array, basis: Array) -> Array:
        """[ξ_a | ξ_b | Φ] = [ξ_a | 0 | V] for ξ_a (n,) and V (n, n_a), shape (k, 1 + q + n_a)."""
        still = np.zeros((len(xi_a), self.system.q))
        return np.asarray(
            self.basis.T @ np.concatenate([xi_a[:, None], still, basis], axis=1)
        )


def reduce(
    system: DescriptorSystem,
    inputs: Trajectory,
    outputs: Trajectory,
    settings: ObserverSettings,
    solver: SolverSettings,
) -> ReducedSystem:
    """The reduced system on the signals u (m,) and y (r,), which share a mesh.

    Args:
        system: the model.
        inputs: u (m,) and
        outputs: y (r,), on the same mesh.
        settings: the weights of the outputs.
        solver: tolerances.

    Raises:
        ModelError: rank of E not constant, or Assumption 1 violated.
        ConfigError: no outputs.
    """
    if system.r == 0:
        raise ConfigError(
            f"plant {system.name}: the observer needs outputs and C; without them use observer=none"
        )
    mesh = inputs.mesh
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    first = observer_matrices(
        system, t, inside, solver.rank_tol, normalise=True,
        output_scale=output_scale(settings, system),
    )
    V1, names = initial_basis(first.split.projector[0], first.split.rank, system.states)
    return ReducedSystem(system, inputs, outputs, solver, mesh, first, V1, names)


@dataclass(frozen=True, eq=False)
class Extension:
    """The dynamic extension on the mesh that resolves it and everything computed from it."""

    solution: LinearSolution  # [ξ_a | ξ_b | Φ] (k, 1 + q + n_a)
    assembled: Assembled

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return self.solution.trajectory.mesh

    def growth(self, q: int) -> float:
        """Largest entry of Φ."""
        return largest_entry(self.solution.trajectory.values, 1 + q)

    def logarithm(self, q: int) -> float:
        """ln ‖Φ(end)‖₂, which is 0 at the start."""
        return log_norm(self.solution.trajectory.final[:, 1 + q :])


def extend(reduced: ReducedSystem, mesh: Mesh, start: Array) -> Extension:
    """Integrate [ξ_a | ξ_b | Φ] from ``start`` (k, 1 + q + n_a) over ``mesh``, refined.

    Raises:
        ModelError: rank of E not constant, Assumption 1 violated.
        SolverError: the tolerance cannot be reached, or the extension grows beyond all bounds.
    """
    system, solver, basis = reduced.system, reduced.solver, reduced.basis
    q, n_a = system.q, reduced.rank

    def equations(o: ObserverMatrices, u: Array, y: Array) -> Coefficients:
        f, g_y = _driven(o, u, y, 1 + q + n_a)
        seen = (o.on_basis, g_y, o.G, o.range, o.elimination, o.injectivity)
        return Coefficients(None, o.dynamics, f, seen)

    def coefficients(t: Array, inside: Array) -> Coefficients:
        u, y = reduced.inputs(t, inside), reduced.outputs(t, inside)
        return equations(reduced.matrices(t, inside), u, y)

    latest: list[Assembled] = []

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[tuple[Array, float]]:
        """Everything to resolve; SolverError if the extension is beyond all bounds."""
        if largest_entry(values) > _LARGEST:
            raise SolverError(
                f"the dynamic extension of plant {system.name} grows beyond {_LARGEST:.0e}: A_0 is "
                "unstable; use observer.remedy=output_injection, reset or current_coordinates, or "
                "a shorter time.horizon"
            )
        z, *flat = map(_over_time, (values, *extras))
        assembled = regression_signals(z, q, basis, *flat)
        latest[:] = [assembled]
        return [
            (signal.reshape(*values.shape[:2], -1), floor) for signal, floor in assembled.kinds()
        ]

    problem = LinearProblem(coefficients, start, monitor, f"observer of plant {system.name}")
    if solver.name == "ivp":
        solution = ivp.solve(problem, mesh, tol=solver.tol, max_elements=solver.max_elements)
    else:
        known = None
        if mesh is reduced.inputs.mesh and reduced.injection is None:
            u, y = _over_time(reduced.inputs.values), _over_time(reduced.outputs.values)
            known = equations(reduced.first, u, y)
        solution = solve(
            problem, mesh, tol=solver.tol, max_elements=solver.max_elements, known=known
        )
    return Extension(solution, latest[0])


def _driven(o: ObserverMatrices, u: Array, y: Array, columns: int) -> tuple[Array, Array]:
    """[b_0 | D_0 | 0], shape (N, k, columns), and g_y (N, e + r), of u (N, m) and y (N, r)."""
    if kernels.compiled is not None:
        driven: tuple[Array, Array] = kernels.compiled.driven(
            o.from_unknowns, o.from_signals, o.g_signals, u, y, columns
        )
        return driven
    signals = np.concatenate([u, y], axis=1)[:, :, None]
    f = np.zeros((len(u), o.dynamics.shape[1], columns))
    f[:, :, :1] = o.from_signals @ signals
    f[:, :, 1 : 1 + o.from_unknowns.shape[2]] = o.from_unknowns
    return f, (o.g_signals @ signals)[:, :, 0]


def _over_time(signal: Array) -> Array:
    """Values (K, s + 1, …) one point after the other, (K (s + 1), …)."""
    return signal.reshape(signal.shape[0] * signal.shape[1], *signal.shape[2:])


def observe(
    system: DescriptorSystem,
    inputs: Trajectory,
    outputs: Trajectory,
    settings: ObserverSettings,
    solver: SolverSettings,
) -> Observation:
    """Run the dynamic extension on the signals u and y and form the regression.

    Args:
        system: the model; its ``theta`` and ``initial_state`` are not used.
        inputs: u (m,) and
        outputs: y (r,), on the same mesh.
        settings: ξ_a(start) and which rows of the residual to keep.
        solver: tolerance and limits.

    Raises:
        ModelError: rank of E not constant, Assumption 1 violated, no outputs.
        ConfigError: ``xi_a0`` does not fit.
        SolverError: the tolerance cannot be reached.
    """
    return observe_reduced(reduce(system, inputs, outputs, settings, solver), settings)


def observe_reduced(reduced: ReducedSystem, settings: ObserverSettings) -> Observation:
    """:func:`observe` for a reduced system, perhaps with output injection."""
    system, q, V1 = reduced.system, reduced.system.q, reduced.initial_basis
    xi_a0 = initial_extension(settings, system, reduced.names)
    extension = extend(reduced, reduced.mesh, reduced.start(V1 @ xi_a0, V1))
    mesh, final = extension.mesh, extension.assembled
    kept = final.kept_rows(system, settings.regression)
    all_kept = len(kept) == final.Y.shape[1]
    return Observation(
        regression=LinearRegression(
            Y=on_mesh(mesh, final.Y if all_kept else final.Y[:, kept]),
            psi=on_mesh(mesh, final.psi if all_kept else final.psi[:, kept]),
            parameters=(*system.unknowns, *reduced.names),
            scale=final.psi_scale,
        ),
        state_map=AffineStateMap(on_mesh(mesh, final.offset), on_mesh(mesh, final.gain)),
        truth=InitialError(V1, xi_a0, reduced.basis, extension.solution.trajectory),
        error_estimate=extension.solution.error_estimate,
        assumptions=assumptions(reduced, mesh, final),
        growth=extension.growth(q),
        growth_rate=extension.logarithm(q) / float(mesh.edges[-1] - mesh.edges[0]),
        respond=lambda e_u, e_y: respond(mesh, reduced.matrices, kept, e_u, e_y),
    )


def on_mesh(mesh: Mesh, signal: Array) -> Trajectory:
    """A signal (K (s + 1), …) at the points of a mesh, as values (K, s + 1, …)."""
    return Trajectory(mesh, signal.reshape(*mesh.points.shape, *signal.shape[1:]))


def assumptions(
    reduced: ReducedSystem, mesh: Mesh, found: Assembled
) -> tuple[Assumption, ...]:
    """Rank of E and Assumption 1, with their evidence at the points of the mesh."""
    smallest, weakest = _weakest(found.injectivity, found.elimination)
    return (
        Assumption(
            "Rank of E", "rank E(t) is constant", True,
            {"rank": reduced.rank, "states": reduced.system.n},
        ),
        Assumption(
            "Assumption 1",
            "impulse observability: [ΠA; C] is injective on the kernel of E(t)",
            True,
            {"smallest_singular_value": smallest, "at": float(mesh.points.ravel()[weakest])},
        ),
    )


def respond(
    mesh: Mesh, matrices: Callable[[Array, Array], ObserverMatrices], kept: IntArray,
    e_u: Array, e_y: Array,
) -> Array:
    """What errors of the signals add to Y, all columns in one solve on the mesh as it is.

        ζ' = A_0 ζ + b_0(e_u, e_y),  ζ(start) = 0,      δY = R (𝒜 ζ + g_y(e_u, e_y))

    Args:
        mesh: of the regression; errors are smooth within its elements.
        matrices: of the observer at times.
        kept: rows of the residual that are the regression.
        e_u: of the inputs at the points of the mesh, (K, s + 1, m, c).
        e_y: of the outputs, (K, s + 1, r, c).

    Returns:
        δY (K, s + 1, rows, c).

    Raises:
        SolverError: the mesh does not resolve the response.
    """
    errors = Trajectory(mesh, np.concatenate([e_u, e_y], axis=2))

    def coefficients(t: Array, inside: Array) -> Coefficients:
        o, e = matrices(t, inside), errors(t, inside)
        R = o.residual[:, kept]
        seen = (R @ o.algebraic @ o.split.basis, (R @ o.g_signals) @ e)
        return Coefficients(None, o.dynamics, o.from_signals @ e, seen)

    size = matrices(mesh.edges[:1], mesh.inside[0, :1]).split.basis.shape[1]
    start = np.zeros((size, e_y.shape[-1]))
    problem = LinearProblem(coefficients, start, name="response to noise")
    solution = solve(problem, mesh, tol=np.inf, max_elements=mesh.size)
    if solution.error_estimate > _RESPONSE:
        raise SolverError(
            f"noise.seeds: the response to noise is resolved to {solution.error_estimate:.1e} only;"
            " lower noise.sample_time or solver.tol"
        )
    algebraic, direct = solution.extras
    return np.asarray(algebraic @ solution.trajectory.values + direct)


@dataclass(frozen=True, eq=False)
class Assembled:
    """Everything algebraic in ξ_a, ξ_b, Φ, u and y at N times, all rows of the residual."""

    Y: Array  # (N, e + r)
    psi: Array  # (N, e + r, p)
    offset: Array  # (N, n)
    gain: Array  # (N, n, p)
    Y_scale: float  # size of the terms of Y and ψ before they cancel
    psi_scale: float
    elimination: Array  # (N, n, n_b) and
    injectivity: Array  # (N,) as in ``ObserverMatrices``

    def kinds(self) -> list[tuple[Array, float]]:
        """Everything the mesh has to resolve, with the size below which it is rounding."""
        squares, right = _products(self.psi, self.Y)
        Y, psi = 1e-3 * self.Y_scale, 1e-3 * self.psi_scale
        return [
            (self.Y, Y),
            (self.psi, psi),
            (self.offset, 0.0),
            (self.gain, 0.0),
            (squares, psi * self.psi_scale),
            (right, psi * self.Y_scale),
        ]

    def kept_rows(self, system: DescriptorSystem, regression: str) -> IntArray:
        """Rows of the residual that make up the regression."""
        if regression != "paper":
            in_psi, in_Y = self._row_sizes()
            large = (in_psi > _VANISHING * self.psi_scale) | (in_Y > _VANISHING * self.Y_scale)
            kept: IntArray = large.nonzero()[0]
            if len(kept):
                return kept
        rows = self.Y.shape[1]
        return np.arange(rows - system.r, rows)  # eq. (regpsi)

    def _row_sizes(self) -> tuple[Array, Array]:
        """Largest entry of each row of ψ and of Y over the times, (e + r,) both."""
        if kernels.compiled is not None:
            sizes: tuple[Array, Array] = kernels.compiled.residual_sizes(self.psi, self.Y)
            return sizes
        return np.abs(self.psi).max(axis=(0, 2), initial=0.0), np.abs(self.Y).max(axis=0)


def _products(psi: Array, Y: Array) -> tuple[Array, Array]:
    """ψᵀψ (N, p, p) and ψᵀY (N, p) of ψ (N, rows, p) and Y (N, rows)."""
    if kernels.compiled is not None and psi.shape[2] <= _SMALL:
        products: tuple[Array, Array] = kernels.compiled.products(psi, Y)
        return products
    both = outer_products(psi, Y)
    return both[..., :-1], both[..., -1]


def regression_signals(
    z: Array, q: int, basis: Array, algebraic: Array, g_y: Array, G: Array, Q1: Array, H: Array,
    injectivity: Array,
) -> Assembled:
    """All rows of Y and ψ, and the state's offset and gain, at N times.

    Args:
        z: [ξ_a | ξ_b | Φ] in the coordinates of ``basis``, (N, k, 1 + q + n_a).
        q: number of unknown parameters.
        basis: B (n, k).
        algebraic: 𝒜 B, and with the following as in ``ObserverMatrices``.
        g_y: from the signals (N, e + r).
        G: of θ.
        Q1: of K = H Q1ᵀ and R = I − Q1 Q1ᵀ.
        H: likewise.
        injectivity: passed on.
    """
    if kernels.compiled is not None and len(basis) <= _SMALL:
        Y, psi, offset, gain, sizes = kernels.compiled.regression_signals(
            z, q, basis, algebraic, g_y, G, Q1, H
        )
        Y_scale, psi_scale = sizes.tolist()
        return Assembled(Y, psi, offset, gain, Y_scale, psi_scale, H, injectivity)
    signs = np.ones(z.shape[2])
    signs[1 : 1 + q] = -1.0  # w = ξ_a + ξ_b θ − Φ e₀ and ψ has −ξ_b, +Φ
    signed = z * signs
    terms = algebraic @ signed  # [𝒜 ξ_a + g_y | −𝒜 ξ_b − G | 𝒜 Φ]
    Y_scale = max(float(np.abs(part).max(initial=0.0)) for part in (terms[:, :, 0], g_y))
    terms[:, :, 0] += g_y
    terms[:, :, 1 : 1 + q] -= G
    seen = transpose(Q1) @ terms
    left = terms - Q1 @ seen  # R (…)
    state = basis @ signed - H @ seen  # w − K (…): the state, signed likewise
    return Assembled(
        Y=left[:, :, 0],
        psi=left[:, :, 1:],
        offset=state[:, :, 0],
        gain=-state[:, :, 1:],  # [X_w ξ_b + X_θ | −X_w Φ]
        Y_scale=Y_scale,
        psi_scale=float(np.abs(terms[:, :, 1:]).max(initial=0.0)),
        elimination=H,
        injectivity=injectivity,
    )


def initial_basis(P: Array, rank: int, states: tuple[str, ...]) -> tuple[Array, tuple[str, ...]]:
    """V1 (n, n_a), orthonormal basis of range P(start), and the names of e₀'s components.

    Coordinate axes where they span the range (E diagonal, or zero columns): e0_<state>. Else an
    orthonormal basis made from the columns of P in the order of the states: e0_1, e0_2, …
    """
    on_axes = P.diagonal() > 0.5
    exact = np.diag(on_axes.astype(np.float64))
    axes = on_axes.nonzero()[0]
    if len(axes) == rank and np.abs(P - exact).max(initial=0.0) < 1e-13:
        return exact[:, axes], tuple([f"e0_{states[i]}" for i in axes.tolist()])
    columns: list[Array] = []
    for column in P.T:  # Gram–Schmidt, twice: deterministic, unlike singular vectors
        v = column.copy()
        for _ in range(2):
            for u in columns:
                v -= (u @ v) * u
        norm = float(np.linalg.norm(v))
        if norm > 1e-6 and len(columns) < rank:
            columns.append(v / norm)
    return np.array(columns).T.reshape(len(P), -1), tuple(f"e0_{i + 1}" for i in range(rank))
