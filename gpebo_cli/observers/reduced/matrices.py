"""Every matrix of the observer, and how the algebraic states are eliminated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.kernels.arrays import across, axes_of, inverses, joined
from gpebo_cli.model.descriptor import Array, DescriptorSystem, IntArray
from gpebo_cli.numerics.linalg import (
    exact_product,
    largest_over_time,
    less_product,
    orthonormal_complement,
    symmetric_eigenvalues,
    transpose,
    without_rounding,
)
from gpebo_cli.observers.reduced.split import (
    TINY,
    Frame,
    Split,
    axes_frame,
    constant_split,
    fits,
    split_by_svd,
    split_in_frame,
    units_along,
    within_frame,
)
from gpebo_cli.reduction.form import EquationForm, Equations, HiddenConstraints
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.reduction.structure import follow_dips
from gpebo_cli.regression.errors import ErrorSystem
from gpebo_cli.schema import instant

_LACKING = 1e-8  # of the largest singular value of what constraints say of w: it is rounding


class NotObservableError(ModelError):
    """Assumption 1, impulse observability, fails."""


class AlgebraicEquations(NamedTuple):
    """0 = 𝒜 w + 𝒜 v + g_y + G θ at N times, and how v = Q x is eliminated from them."""

    on_basis: Array  # (N, e + r, k) 𝒜 B
    g_y: Array  # (N, e + r) of the signals
    G: Array  # (N, e + r, q)
    range: Array  # (N, e + r, n_b) Q1 of K = H Q1ᵀ and R = I − Q1 Q1ᵀ
    elimination: Array  # (N, n, n_b) H
    injectivity: Array  # (N,) see ``ObserverMatrices``


@dataclass(frozen=True, eq=False)
class ObserverMatrices:
    """Every matrix of the observer at N times, known functions of t only.

    With 𝒜 V2 = Q1 R1 (V2 spans the kernel of E), K = H Q1ᵀ with H = V2 R1⁻¹, and the projector
    on the residual is I − Q1 Q1ᵀ. Matrices that do not depend on time have a leading axis of 1.
    """

    split: Split
    output_scale: Array  # (r,) √w, or 1 over the unit, by which rows of C and y were multiplied
    dynamics: Array  # (N, k, k) BᵀA_0 B
    from_unknowns: Array  # (N, k, q) BᵀD_0
    from_signals: Array  # (N, k, · + r) Bᵀb_0 = from_signals [v; y], v as the form has it
    algebraic: Array  # (N, e + r, n) 𝒜; e of Π and of hidden constraints
    on_basis: Array  # (N, e + r, k) 𝒜 B
    g_signals: Array  # (N, e + r, · + r) g_y = g_signals [v; y]
    G: Array  # (N, e + r, q)
    range: Array  # (N, e + r, n_b) Q1
    elimination: Array  # (N, n, n_b) H
    # At most the smallest singular value of 𝒜 on ker E relative to ‖𝒜‖, at least 1/√n_b of it.
    injectivity: Array  # (N,)
    # Units in the last place that v = Q x may be wrong by, for 1 of each state of w.
    rounding: Array | None = None  # (n, n); None: few

    @property
    def outputs(self) -> int:
        """Number of outputs r; theirs are the last rows."""
        return len(self.output_scale)

    @property
    def at_first(self) -> ObserverMatrices:
        """Those at the first time alone, split aside."""
        constant = {"split", "output_scale", "rounding"}
        own = (f.name for f in fields(self) if f.name not in constant)
        return replace(self, **{name: getattr(self, name)[:1] for name in own})

    def of_noise(self, matrix: Array, inputs: int) -> Array:
        """The columns (N, k, m + r) of a matrix of [v; y] that belong to [u; y], m inputs."""
        return np.concatenate([matrix[:, :, :inputs], matrix[:, :, -self.outputs :]], axis=2)

    @property
    def residual(self) -> Array:
        """R = I − 𝒜 Q K, (N, e + r, e + r)."""
        return orthonormal_complement(self.range)

    def _measured(self, *, alone: bool) -> Array:
        """g_signals without y of outputs that are off: whose rows of C, D and H are zero.

        At each time ``alone``, else at three in a row at least: where C passes zero, Y is smooth.
        """
        g, r = self.g_signals, self.outputs
        off = ~np.logical_or(
            g[:, -r:, :-r].any(axis=2) | self.algebraic[:, -r:].any(axis=2),
            self.G[:, -r:].any(axis=2),
        )
        if not alone and off.any():
            three = off[:-2] & off[1:-1] & off[2:]
            off[:], off[:-2] = False, three
            off[1:-1] |= three
            off[2:] |= three
        if off.any():
            g = np.array(np.broadcast_to(g, (len(off), *g.shape[1:])))
            g[:, -r:, -r:][off] = 0.0
        return g

    def errors(
        self, kept: IntArray | slice, inputs: int, *, alone: bool = False
    ) -> ErrorSystem:
        """What errors e of [u; y], m inputs, add to Y (rows ``kept`` (k,)) and to the offset.

        ζ' = A_0 ζ + b_0(e),    δY = R (𝒜 ζ + g_y(e)),    δoffset = ζ − K (𝒜 ζ + g_y(e))
        """
        R, H, Q1 = self.residual[:, kept], self.elimination, transpose(self.range)
        g = self.of_noise(self._measured(alone=alone), inputs)
        return ErrorSystem(
            self.dynamics, self.of_noise(self.from_signals, inputs),
            joined(R @ self.on_basis, self.split.basis - H @ (Q1 @ self.on_basis), axis=1),
            joined(R @ g, -H @ (Q1 @ g), axis=1),
        )

    def equations(self, signals: Array, *, alone: bool = False) -> AlgebraicEquations:
        """The algebraic equations with the signals [v; y], (N, v + r, 1)."""
        g_y = (self._measured(alone=alone) @ signals)[:, :, 0]
        return AlgebraicEquations(
            self.on_basis, g_y, self.G, self.range, self.elimination, self.injectivity
        )

    def forcing(self, signals: Array, columns: int) -> Array:
        """[b_0 | D_0 | 0] with the signals [v; y], (N, v + r, 1), shape (N, k, columns)."""
        f = np.zeros((len(signals), self.dynamics.shape[1], columns))
        f[:, :, :1] = self.from_signals @ signals
        f[:, :, 1 : 1 + self.from_unknowns.shape[2]] = self.from_unknowns
        return f

    def injected(self, gain: Array) -> ObserverMatrices:
        """The equations of w with gain · (𝒜 w + g_y + G θ) added to w', for a gain (N, k, e + r).

        The gain must be N = N R with columns in range P: R (𝒜 w + g_y + G θ) = 0 is all that w
        has to fulfil, and w must stay in range P.
        """
        return replace(
            self, dynamics=less_product(self.dynamics, gain, self.on_basis),
            from_unknowns=less_product(self.from_unknowns, gain, self.G),
            from_signals=less_product(self.from_signals, gain, self.g_signals),
        )


# (matrices at the times t (N,), t, inside) -> gain (N, k, e + r) of ``ObserverMatrices.injected``
Injection = Callable[[ObserverMatrices, Array, Array], Array]


def observer_matrices(
    form: EquationForm, t: Array, inside: Array, rank_tol: float,
    like: ObserverMatrices | None = None, *,
    output_scale: Array | None = None, signals: Array | None = None, frame: Frame | None = None,
) -> ObserverMatrices:
    """Evaluate the observer's matrices at the times t (N,), those of the start first.

    Equations count in the form's units, outputs as well or with √w = ``output_scale`` (r,), and E
    may have a known ``frame``; or all is as in ``like``, the matrices of other times, whose basis
    is kept. A plant whose matrices follow signals needs [u; y] (N, m + r).
    """
    system, model = form.system, form.equations(t, inside, signals)
    units = form.units
    if like is not None:
        scale, frame = like.output_scale, like.split.frame
    else:
        scale = 1.0 / units.outputs if output_scale is None else output_scale
    plain = model.hidden is None and {"D", "H"} <= system.coefficients.zero
    # Products with axes have no rounding that would have to be found.
    axes = axes_frame(largest_over_time(model.E)) if like is None and frame is None else frame
    if plain and axes is not None and axes.remaining is None and axes.axes:
        found = _in_frame(model, units, scale, axes, rank_tol)
        if found is not None:
            return found
    found = _by_steps(
        form, model, scale, t, rank_tol, like, frame,
        lambda: form.mass(t, inside, signals, 1)[: len(model.E)],
    )
    held = form.held and model.hidden is not None
    return _held(found, units.states, rank_tol) if held else found


def _in_frame(
    model: Equations, units: Units, scale: Array, frame: Frame, rank_tol: float
) -> ObserverMatrices | None:
    """What :func:`_by_steps` finds in the frame of E; None where singular values have to decide."""
    rows = units.equations
    found = kernels.observer.in_frame(
        *model[:5], rows, scale, frame.domain, frame.range, frame.kernel, frame.equations
    )
    if found is None:
        return None
    (sizes, pinv, algebraic, on_basis, g_signals, G, Q1, H, injectivity, dynamics, from_unknowns,
     from_signals) = found
    outside, inner, inverse = sizes.tolist()
    if H.shape[2] and (units.states != 1.0).any():  # as of states in their units
        of_inverse = np.linalg.norm(H / units.states[:, None], axis=(1, 2))
        injectivity = 1.0 / (of_inverse * np.linalg.norm(algebraic * units.states, axis=(1, 2)))
    weakest = float(injectivity.min(initial=np.inf))
    # What is outside, rounding or not, is left to _by_steps.
    within = fits(outside, 0.0, frame.domain.shape[1], inner, inverse, rank_tol)
    if not (within and weakest > rank_tol):
        return None
    return ObserverMatrices(
        within_frame(frame, pinv), scale, dynamics, from_unknowns, from_signals, algebraic,
        on_basis, g_signals, G, Q1, H, injectivity,
    )


def _by_steps(
    form: EquationForm, model: Equations, scale: Array, t: Array, rank_tol: float,
    like: ObserverMatrices | None, frame: Frame | None, slope: Callable[[], Array],
) -> ObserverMatrices:
    """The observer's matrices from those of the plant at the times t (N,) and Ė (N or 1, n, n)."""
    system, units, r = form.system, form.units, form.system.r
    E, A, B, F, C, D, H, hidden = model
    rows = units.equations[:, None]
    if (rows != 1.0).any():
        E, A, B, F = (matrix / rows for matrix in (E, A, B, F))
    C, D, H = (scale[:, None] * matrix for matrix in (C, D, H))
    split = None
    if frame is not None:
        split = split_in_frame(E, frame, units.states, rank_tol)
    elif like is None:
        split = constant_split(E, system.states, units.states, rank_tol)
    if split is None:
        known = None if like is None else like.split
        split = split_by_svd(system, E, slope() / rows, t, units.states, rank_tol, known)

    L, basis = split.equations, split.basis
    # 0 = 𝒜 x + g_y + G θ: equations without derivatives, hidden constraints, outputs.
    exact = [exact_product(L, A)], [exact_product(L, B)], [exact_product(L, F)]
    if hidden is not None:
        for part, more in zip(exact, hidden[:3], strict=True):
            part.append(more)
        C, D, H = _seen_through(hidden, split.kernel, C, D, H)
    algebraic, of_inputs, G = (
        joined(*part, last, axis=1) for part, last in zip(exact, (C, D, H), strict=True)
    )
    on_basis = across(algebraic, basis)
    if axes_of(basis) is None:
        without_rounding(on_basis, np.abs(algebraic) @ np.abs(basis))
    of_y = np.zeros((1, algebraic.shape[1], r))
    of_y[0, algebraic.shape[1] - r :] = -np.diag(scale)
    g_signals = joined(of_inputs, of_y, axis=2)
    own = without_rounding(split.kernel / units.states[:, None])
    kernel = units.states[:, None] * (own / np.linalg.norm(own, axis=1, keepdims=True))
    terms = np.abs(algebraic) @ np.abs(kernel)
    on_kernel = without_rounding(algebraic @ kernel, terms)
    size = np.maximum(np.linalg.norm(algebraic * units.states, axis=(1, 2)), TINY)
    arguments = system, on_kernel, kernel, size, t, rank_tol
    if frame is not None and frame.remaining is not None:
        Q1, K, injectivity = _eliminate_in_part(*arguments, units.states, frame.remaining.rank)
    else:
        Q1, K, injectivity = _eliminate(*arguments, terms)
    rounding = None
    if hidden is not None:
        outputs = Q1.shape[1] - r
        Q1[:, outputs:] = 0.0  # y is not in it, and neither is its rounding
        of_hidden = transpose(Q1[:, outputs - system.n : outputs])
        rounding = (np.abs(K) @ np.abs(of_hidden)).max(axis=0) @ hidden.rounding
    dynamics, from_unknowns, from_signals = _moving(split, A, F, B, Q1, K, on_basis, G, g_signals)
    return ObserverMatrices(
        split, scale, dynamics, from_unknowns, from_signals, algebraic, on_basis, g_signals, G, Q1,
        K, injectivity, rounding,
    )


def _moving(
    split: Split, A: Array, F: Array, B: Array, Q1: Array, K: Array, *equations: Array
) -> list[Array]:
    """[BᵀA_0 B, BᵀD_0, of u and y] = [Λ B, E⁺F, [E⁺B 0]] − Λ K [𝒜 B, G, g_signals].

    Λ = E⁺A + Ṗ, K = ``K`` Q1ᵀ; the last three matrices are the ``equations``. Times (N or 1).
    """
    Lambda, of_F, of_B = (exact_product(split.pinv, matrix) for matrix in (A, F, B))
    if split.turn is not None:
        Lambda = Lambda + split.turn
    none = np.zeros((1, of_B.shape[1], equations[2].shape[2] - B.shape[2]))
    direct = [across(Lambda, split.basis), of_F, joined(of_B, none, axis=2)]
    given = K.any(axis=(0, 2))
    back = Lambda[:, :, given] @ K[:, given]
    moved = back.any(axis=(0, 2))  # of many states few are moved by those that are eliminated
    if not moved.any():
        return direct
    back, found = back[:, moved], list[Array]()
    for own, seen in zip(direct, equations, strict=True):
        after = less_product(own[:, moved], back, transpose(Q1) @ seen)
        found.append(np.array(np.broadcast_to(own, (len(after), *own.shape[1:]))))
        found[-1][:, moved] = after
    return found


def _held(found: ObserverMatrices, units: Array, rank_tol: float) -> ObserverMatrices:
    """The same with a term that pulls w onto the hidden constraints, which w then never leaves.

    Of more constraints than E leaves room for, rounding may grow as no solution does. What they
    lack comes back at twice the rate at which anything grows, −2‖A_0‖ (R𝒜)⁺R(𝒜w + g_y + Gθ).
    """
    own = units_along(found.split.basis, units)
    hidden = found.algebraic.shape[1] - found.outputs
    lacking = (found.residual @ found.on_basis)[:, :hidden] * own
    if not (np.abs(lacking) > rank_tol).any():
        return found
    rate = 2.0 * np.linalg.norm(found.dynamics * own / own[:, None], axis=(1, 2))
    gain = np.zeros((len(lacking), len(own), hidden + found.outputs))
    inverse = np.asarray(np.linalg.pinv(lacking, rcond=_LACKING), dtype=np.float64)
    gain[:, :, :hidden] = own[:, None] * without_rounding(inverse)
    through = without_rounding(gain @ found.residual, np.abs(gain) @ np.abs(found.residual))
    return found.injected(rate[:, None, None] * through)


def _seen_through(
    hidden: HiddenConstraints, kernel: Array, C: Array, D: Array, H: Array
) -> tuple[Array, Array, Array]:
    """The outputs with v = Q x put in from the constraints: C − C J M, D − C J M_v, H − C J M_θ.

    J = V2 (M V2)⁺ with V2 (N, n, n_b) of the kernel of E. C − C J M vanishes on that kernel, so no
    output takes part in the elimination, and the regression has all of them.
    """
    through = C @ kernel @ np.linalg.pinv(hidden.states @ kernel)
    of_x, of_v, of_theta = (
        less_product(part, through, more)
        for part, more in zip((C, D, H), hidden[:3], strict=True)
    )
    return of_x, of_v, of_theta


def _eliminate(
    system: DescriptorSystem, on_kernel: Array, kernel: Array, size: Array, t: Array,
    rank_tol: float, terms: Array,
) -> tuple[Array, Array, Array]:
    """Q1 and H of K = (𝒜 Q)⁺ = H Q1ᵀ, and a bound of the singular value behind Assumption 1.

    From 𝒜 V2 on a basis V2 of the kernel of E (N, n, n_b), and the size (N,) of 𝒜. σ_min(R1) ≥
    1/‖R1⁻¹‖_F; where that bound leaves a doubt, it is computed, of rows beside the sizes of their
    ``terms``, those of 𝒜 V2: some may be small, but what is rounding sees nothing.
    """
    if kernel.shape[2] == 0:
        return on_kernel, kernel[:1], np.full(len(size), np.inf)
    Q1, R1 = np.linalg.qr(on_kernel)
    inverse = inverses(R1)
    bound = 1.0 / (np.linalg.norm(inverse, axis=(1, 2)) * size)
    doubtful = np.flatnonzero(~(bound > rank_tol))
    if len(doubtful):
        rows = np.maximum(terms[doubtful].max(axis=2, keepdims=True), TINY)
        smallest = np.linalg.svd(on_kernel[doubtful] / rows, compute_uv=False)[:, -1]
        bound[doubtful] = smallest
        if (smallest <= rank_tol).any():
            k = int(np.argmax(smallest <= rank_tol))
            raise _not_observable(system, 0, t[doubtful[k]], smallest[k])
    return Q1, kernel @ inverse, bound


def _not_observable(
    system: DescriptorSystem, _: int, t: float, smallest: float
) -> NotObservableError:
    """What is said where the singular value behind Assumption 1 is zero."""
    return NotObservableError(
        f"plant {system.name}: Assumption 1 (impulse observability) fails at t = {instant(t, 6)}: "
        f"[ΠA; C] has singular value {smallest:.1e} on the kernel of E; an output that sees the "
        "algebraic states is needed, or observer.form=strangeness_free"
    )


def refuse_between(
    form: EquationForm, found: ObserverMatrices, t: Array, rank_tol: float,
    along: Callable[[Array, Array], Array] | None,
) -> None:
    """Refuse Assumption 1 that fails between the times t (N,) of the matrices found.

    ``along`` tells [u; y] (N, m + r) at any times t (N,), of those inside of elements.
    """
    def lines(times: Array, column: IntArray) -> Array:
        grid = times.reshape(len(column), -1)
        inside = (grid + 1e-3 * (grid.mean(axis=1, keepdims=True) - grid)).ravel()
        signals = along(times, inside) if along else None
        more = observer_matrices(form, times, inside, rank_tol, found, signals=signals)
        return more.injectivity.reshape(grid.shape)

    if len(found.injectivity) > 1:
        refusal = partial(_not_observable, form.system)
        follow_dips(t, found.injectivity[:, None], rank_tol, lines, refusal)


def _eliminate_in_part(
    system: DescriptorSystem, on_kernel: Array, kernel: Array, size: Array, t: Array,
    rank_tol: float, units: Array, rank: int,
) -> tuple[Array, Array, Array]:
    """:func:`_eliminate` by the pseudoinverse of a rank that has to be the same at all times."""
    U, sigma, Vt = np.linalg.svd(on_kernel)
    ranks = (sigma > rank_tol * size[:, None]).sum(axis=1)
    if (ranks != rank).any():
        raise NotObservableError(
            f"plant {system.name}: Assumption 1 fails, and the rank of [ΠA; C] on the kernel of E "
            f"changes at t = {instant(t[int(np.argmax(ranks != rank))], 6)}; use "
            "observer.form=strangeness_free"
        )
    inverse = kernel @ (transpose(Vt[:, :rank]) / sigma[:, None, :rank])
    # A state of which nothing is told must not look as if a little of it was.
    inverse = units[:, None] * without_rounding(inverse / units[:, None])
    smallest = sigma[:, :rank].min(axis=1, initial=np.inf) / size
    return U[:, :, :rank], inverse, smallest


def weakest(injectivity: Array, elimination: Array) -> tuple[float, int]:
    """The smallest singular value over all times, relative to ‖𝒜‖, and where it is.

    ‖H‖_F took the place of ‖H‖_2 = 1/σ_min in the bounds (N,), H (N or 1, n, n_b). Only times whose
    bound is below the true value at the time of the smallest bound can be weaker.
    """
    if not np.isfinite(injectivity).all():
        return float(np.inf), 0
    first, moves = int(injectivity.argmin()), len(elimination) > 1
    # No column of H is longer than ‖H‖₂. Where n_b = 1 the first remains a candidate.
    columns = np.square(elimination[first if moves else 0]).sum(axis=0)
    limit = injectivity[first] * np.sqrt(columns.sum() / columns.max())
    candidates = (injectivity <= limit).nonzero()[0]
    H = elimination[candidates] if moves else elimination
    # ‖H‖_F/‖H‖₂: the largest eigenvalue of HᵀH has all its digits, and H is of order one.
    H = H / np.maximum(np.abs(H).max(axis=(1, 2), keepdims=True), TINY)
    squares = np.maximum(symmetric_eigenvalues(transpose(H) @ H), 0.0)
    values = injectivity[candidates] * np.sqrt(squares.sum(axis=1) / squares[:, -1])
    k = int(values.argmin())
    return float(values[k]), int(candidates[k])
