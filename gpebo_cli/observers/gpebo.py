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

Only known functions of time are differentiated (Ė); no signal ever is. For E = diag(I, 0) this is
the paper's observer exactly, except that R keeps all rows of the residual: the paper keeps the
last r, which loses everything in its own circuit (``regression: paper`` shows it).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpebo_cli.collocation.linear import Coefficients, LinearProblem, solve
from gpebo_cli.collocation.mesh import Trajectory
from gpebo_cli.errors import ConfigError, ModelError
from gpebo_cli.linalg import orthonormal_complement, transpose
from gpebo_cli.observers.extension import initial_extension
from gpebo_cli.observers.observation import AffineStateMap, InitialError, Observation
from gpebo_cli.regression import LinearRegression, outer_products
from gpebo_cli.result import Assumption
from gpebo_cli.settings import ObserverSettings, SolverSettings
from gpebo_cli.simulation import ivp
from gpebo_cli.systems.descriptor import Array, DescriptorSystem, IntArray

_VANISHING = 1e-11  # rows of Y and ψ below this share of the terms they are made of are zero


@dataclass(frozen=True, eq=False)
class ObserverMatrices:
    """Every matrix of the observer at N times, known functions of t only."""

    A0: Array  # (N, n, n)
    D0: Array  # (N, n, q)
    from_inputs: Array  # (N, n, m) b_0 = from_inputs u + from_outputs y
    from_outputs: Array  # (N, n, r)
    projector: Array  # (N, n, n) P
    residual: Array  # (N, n + r, n + r) R
    algebraic: Array  # (N, n + r, n) 𝒜
    g_inputs: Array  # (N, n + r, m) g_y = g_inputs u − [0; y]
    G: Array  # (N, n + r, q)
    X_w: Array  # (N, n, n)
    K: Array  # (N, n, n + r)
    complement: Array  # (N, n, n) Π
    rank: int  # n_a
    smallest_singular_value: Array  # (N,) of 𝒜 on ker E, relative to ‖𝒜‖; inf if n_b = 0

    def g_y(self, u: Array, y: Array) -> Array:
        """g_y = [Π B u; −y] for u (N, m) and y (N, r), shape (N, n + r)."""
        g = np.einsum("nij,nj->ni", self.g_inputs, u)
        g[:, self.X_w.shape[1] :] -= y
        return np.asarray(g)


def row_sizes(system: DescriptorSystem, t: Array, inside: Array) -> Array:
    """Size of each row of E over the times t, shape (n,), one for rows that are zero.

    Dividing equations by constants changes nothing, but an equation in picofarads would else look
    like a rank deficiency of E. Powers of two: no rounding.
    """
    size = np.abs(system.coefficients.taylor(t, 0, inside).E[0]).max(axis=(0, 2))
    return np.asarray(np.exp2(np.rint(np.log2(np.where(size > 0, size, 1.0)))))


def observer_matrices(
    system: DescriptorSystem, t: Array, inside: Array, rank_tol: float, rows: Array | None = None
) -> ObserverMatrices:
    """Evaluate the observer's matrices at the times t (N,).

    Args:
        system: the model.
        t: times.
        inside: where functions that jump are decided.
        rank_tol: singular values below this, relative, are zero.
        rows: constants (n,) by which the equations are divided first, see :func:`row_sizes`.

    Raises:
        ModelError: the rank of E is not constant, or Assumption 1 fails; names the time and the
            singular value.
    """
    n, m, q, r = system.n, system.m, system.q, system.r
    c = system.coefficients.taylor(t, 1, inside)
    E, dE, A, B, F, C = c.E[0], c.E[1], c.A[0], c.B[0], c.F[0], c.C[0]
    if rows is not None and (rows != 1.0).any():
        E, dE, A, B, F = (matrix / rows[:, None] for matrix in (E, dE, A, B, F))
    U, sigma, Vt = _svd(E, "E" in system.coefficients.constant)
    size = np.maximum(sigma.max(initial=0.0), np.finfo(float).tiny)
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
    Pi = orthonormal_complement(U1)  # Π = I − E E⁺
    P = V1 @ transpose(V1)
    S = pinv_E @ dE @ (V2 @ transpose(V2))  # E⁺ Ė Q
    Lambda = pinv_E @ A + S + transpose(S)  # Λ = E⁺A + Ṗ

    algebraic = np.concatenate([Pi @ A, C], axis=1)  # 𝒜 = [Π A; C]
    g_inputs = np.concatenate([Pi @ B, np.zeros((len(t), r, m))], axis=1)
    G = np.concatenate([Pi @ F, np.zeros((len(t), r, q))], axis=1)
    K, residual, smallest = _eliminate(system, algebraic, V2, t, rank_tol)
    X_w = np.eye(n) - K @ algebraic
    X_theta = -K @ G
    K_y = K[:, :, n:]  # x_y = −K g_y = −K g_inputs u + K_y y
    return ObserverMatrices(
        A0=Lambda @ X_w,
        D0=Lambda @ X_theta + pinv_E @ F,
        from_inputs=pinv_E @ B - Lambda @ (K @ g_inputs),
        from_outputs=Lambda @ K_y,
        projector=P,
        residual=residual,
        algebraic=algebraic,
        g_inputs=g_inputs,
        G=G,
        X_w=X_w,
        K=K,
        complement=Pi,
        rank=n_a,
        smallest_singular_value=smallest,
    )


def _svd(E: Array, constant: bool) -> tuple[Array, Array, Array]:
    """Singular vectors of E at N times, computed once if E is constant."""
    if constant:
        U, sigma, Vt = np.linalg.svd(E[:1])
        count = len(E)
        return (
            np.broadcast_to(U, (count, *U.shape[1:])),
            np.broadcast_to(sigma, (count, sigma.shape[1])),
            np.broadcast_to(Vt, (count, *Vt.shape[1:])),
        )
    return np.linalg.svd(E)


def _eliminate(
    system: DescriptorSystem, algebraic: Array, kernel: Array, t: Array, rank_tol: float
) -> tuple[Array, Array, Array]:
    """K = (𝒜 Q)⁺, R = I − 𝒜 Q K, and the singular value that Assumption 1 rests on.

    With Q = V2 V2ᵀ, (𝒜 Q)⁺ = V2 (𝒜 V2)⁺, a full-rank pseudoinverse.
    """
    count, rows = algebraic.shape[:2]
    n_b = kernel.shape[2]
    if n_b == 0:
        return (
            np.zeros((count, system.n, rows)),
            np.broadcast_to(np.eye(rows), (count, rows, rows)),
            np.full(count, np.inf),
        )
    U, sigma, Vt = np.linalg.svd(algebraic @ kernel, full_matrices=False)
    size = np.maximum(np.linalg.norm(algebraic, axis=(1, 2)), np.finfo(float).tiny)
    smallest = sigma[:, -1] / size
    bad = smallest <= rank_tol
    if bad.any():
        k = int(np.argmax(bad))
        raise ModelError(
            f"plant {system.name}: Assumption 1 (impulse observability) fails at t = {t[k]:.6g}: "
            f"[ΠA; C] has singular value {smallest[k]:.1e} on the kernel of E; an output that "
            f"sees the algebraic states is needed"
        )
    K = kernel @ (transpose(Vt) / sigma[:, None, :]) @ transpose(U)
    return K, orthonormal_complement(U), smallest


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
    if system.r == 0:
        raise ConfigError(
            f"plant {system.name}: the observer needs outputs and C; without them use observer=none"
        )
    mesh = inputs.mesh
    starts, inside = mesh.points[:, 0], mesh.inside[:, 0]
    rows = row_sizes(system, starts, inside)
    first = observer_matrices(system, starts, inside, solver.rank_tol, rows)
    constant_basis = is_constant(first.projector)
    V1, names = initial_basis(first.projector[0], first.rank, system.states)
    # Where the kernel of E rotates, w is integrated in all n coordinates; else in its own n_a.
    basis = V1 if constant_basis else np.eye(system.n)
    xi_a0 = initial_extension(settings, system, names)
    q, n_a = system.q, first.rank
    start = np.concatenate(
        [(basis.T @ V1 @ xi_a0)[:, None], np.zeros((basis.shape[1], q)), basis.T @ V1], axis=1
    )

    def coefficients(t: Array, inside: Array) -> Coefficients:
        o = observer_matrices(system, t, inside, solver.rank_tol, rows)
        u, y = inputs(t, inside), outputs(t, inside)
        b_0 = np.einsum("nij,nj->ni", o.from_inputs, u) + np.einsum("nij,nj->ni", o.from_outputs, y)
        f = np.concatenate([b_0[:, :, None], o.D0, np.zeros((len(t), system.n, n_a))], axis=2)
        extras = (o.residual, o.algebraic, o.g_y(u, y), o.G, o.X_w, o.K, o.smallest_singular_value)
        return Coefficients(None, basis.T @ o.A0 @ basis, basis.T @ f, extras)

    latest: list[_Assembled] = []

    def monitor(values: Array, extras: tuple[Array, ...]) -> list[tuple[Array, float]]:
        count = values.shape[0] * values.shape[1]
        flat = [extra.reshape(count, *extra.shape[2:]) for extra in extras]
        W = basis @ values.reshape(count, *values.shape[2:])
        assembled = regression_signals(W, q, *flat)
        latest[:] = [assembled]
        return [
            (signal.reshape(*values.shape[:2], -1), floor) for signal, floor in assembled.kinds()
        ]

    problem = LinearProblem(coefficients, start, monitor, f"observer of plant {system.name}")
    integrate = ivp.solve if solver.name == "ivp" else solve
    solution = integrate(problem, mesh, tol=solver.tol, max_elements=solver.max_elements)
    mesh, values = solution.trajectory.mesh, solution.trajectory.values

    def on_mesh(signal: Array) -> Trajectory:
        return Trajectory(mesh, signal.reshape(*values.shape[:2], *signal.shape[1:]))

    final = latest[0]
    kept = final.kept_rows(system, settings.regression)
    weakest = int(np.argmin(final.smallest_singular_value))
    return Observation(
        regression=LinearRegression(
            Y=on_mesh(final.Y[:, kept]),
            psi=on_mesh(final.psi[:, kept]),
            parameters=(*system.unknowns, *names),
            scale=final.psi_scale,
        ),
        state_map=AffineStateMap(on_mesh(final.offset), on_mesh(final.gain)),
        truth=InitialError(V1, xi_a0, basis, solution.trajectory),
        error_estimate=solution.error_estimate,
        assumptions=(
            Assumption(
                "Rank of E", "rank E(t) is constant", True, {"rank": n_a, "states": system.n}
            ),
            Assumption(
                "Assumption 1",
                "impulse observability: [ΠA; C] is injective on the kernel of E(t)",
                True,
                {
                    "smallest_singular_value": float(final.smallest_singular_value[weakest]),
                    "at": float(mesh.points.ravel()[weakest]),
                },
            ),
        ),
        growth=float(np.abs(values[..., 1 + q :]).max(initial=0.0)),
    )


@dataclass(frozen=True, eq=False)
class _Assembled:
    """Everything algebraic in ξ_a, ξ_b, Φ, u and y at N times, all rows of the residual."""

    Y: Array  # (N, n + r)
    psi: Array  # (N, n + r, p)
    offset: Array  # (N, n)
    gain: Array  # (N, n, p)
    Y_scale: float  # size of the terms of Y and ψ before they cancel
    psi_scale: float
    smallest_singular_value: Array  # (N,)

    def kinds(self) -> list[tuple[Array, float]]:
        """Everything the mesh has to resolve, with the size below which it is rounding."""
        products = outer_products(self.psi, self.Y)
        Y, psi = 1e-3 * self.Y_scale, 1e-3 * self.psi_scale
        return [
            (self.Y, Y),
            (self.psi, psi),
            (self.offset, 0.0),
            (self.gain, 0.0),
            (products[..., :-1], psi * self.psi_scale),
            (products[..., -1], psi * self.Y_scale),
        ]

    def kept_rows(self, system: DescriptorSystem, regression: str) -> IntArray:
        """Rows of the residual that make up the regression."""
        last = np.arange(system.n, system.n + system.r)
        if regression == "paper":  # eq. (regpsi)
            return last
        in_psi = np.abs(self.psi).max(axis=(0, 2)) > _VANISHING * self.psi_scale
        in_Y = np.abs(self.Y).max(axis=0) > _VANISHING * self.Y_scale
        kept = np.flatnonzero(in_psi | in_Y)
        return kept if len(kept) else last


def regression_signals(
    W: Array, q: int, residual: Array, algebraic: Array, g_y: Array, G: Array, X_w: Array, K: Array,
    smallest_singular_value: Array,
) -> _Assembled:
    """All rows of Y and ψ, and the state's offset and gain, at N times.

    Args:
        W: [ξ_a | ξ_b | Φ] of shape (N, n, 1 + q + n_a).
        q: number of unknown parameters.
        residual: R, and with the following as in ``ObserverMatrices``.
        algebraic: 𝒜.
        g_y: from the signals.
        G: of θ.
        X_w: from w to x.
        K: (𝒜 Q)⁺.
        smallest_singular_value: passed on.
    """
    signed = W.copy()
    signed[:, :, 1 : 1 + q] *= -1.0  # w = ξ_a + ξ_b θ − Φ e₀ and ψ has −ξ_b, +Φ
    terms = algebraic @ signed  # [𝒜 ξ_a | −𝒜 ξ_b | 𝒜 Φ]
    terms[:, :, 0] += g_y
    terms[:, :, 1 : 1 + q] -= G
    left = residual @ terms  # R (…)
    offset = (X_w @ W[:, :, :1])[:, :, 0] - np.einsum("nij,nj->ni", K, g_y)
    gain = -(X_w @ signed[:, :, 1:])  # [X_w ξ_b | −X_w Φ]
    gain[:, :, :q] -= K @ G
    return _Assembled(
        Y=left[:, :, 0],
        psi=left[:, :, 1:],
        offset=offset,
        gain=gain,
        Y_scale=float(np.abs(terms[:, :, 0]).max(initial=0.0)),
        psi_scale=float(np.abs(terms[:, :, 1:]).max(initial=0.0)),
        smallest_singular_value=smallest_singular_value,
    )


def is_constant(projector: Array) -> bool:
    """Whether the projector P (N, n, n) is the same at all times: the kernel of E does not turn."""
    return bool(np.abs(projector - projector[0]).max(initial=0.0) < 1e-13)


def initial_basis(P: Array, rank: int, states: tuple[str, ...]) -> tuple[Array, tuple[str, ...]]:
    """V1 (n, n_a), orthonormal basis of range P(start), and the names of e₀'s components.

    Coordinate axes where they span the range (E diagonal, or zero columns): e0_<state>. Else an
    orthonormal basis made from the columns of P in the order of the states: e0_1, e0_2, …
    """
    axes = np.flatnonzero(np.diag(P) > 0.5)
    exact = np.zeros_like(P)
    exact[axes, axes] = 1.0
    if len(axes) == rank and np.abs(P - exact).max(initial=0.0) < 1e-13:
        return np.eye(len(P))[:, axes], tuple(f"e0_{states[i]}" for i in axes)
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
