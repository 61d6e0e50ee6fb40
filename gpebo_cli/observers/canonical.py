"""Observers for the standard canonical form (paper, Sections III and IV).

    ż_a = A_a z_a + f_a + F_a θ,   N ż_b = z_b + f_b,   N strictly lower triangular,
    y = C_a z_a + C_b z_b

* Proposition 3: outputs k without z_b give y_k − C_k ξ_a = [C_k ξ_b, −C_k Φ_a] (θ, e₀). All of
  them are stacked.
* Proposition 4 (n_b = 3): with an output ℓ that sees z_b1 and z_b2 but not z_b3,
  y_w = y_ℓ − C^a_ℓ ẑ_a, z_w = (z_b1, z_b2), and the corrected matrices (docs/errata.md)

      ṙ = M_w r + [M_w G_w + L_w − Ġ_w] y_w + [I − G_w c⊤] d_w,      ẑ_w = r + G_w y_w
      M_w = [[ −L1 c1,          a1 − L1 c2                 ],
             [ −L2 c1 − ċ1/c2,  −L2 c2 − (ċ2 + a1 c1)/c2   ]],     G_w = (0, 1/c2).

* Algebraically z_b1 = −f_b1 and z_b2 = (y_w + c1 f_b1)/c2: shipped beside it as the check.
* z_b3 from any output that sees it, as Section II does.

f_a and f_b are B u; only the known functions c1, c2 are differentiated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gpebo_cli.errors import ConfigError, ModelError
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, BoolArray, Changed, Coefficients, DescriptorSystem
from gpebo_cli.model.expressions.bounds import with_others
from gpebo_cli.model.expressions.syntax import parse
from gpebo_cli.model.expressions.tape import taylor
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.observers._base import (
    Measurements,
    Observation,
    Reconstruction,
    StateMap,
    output_scale,
)
from gpebo_cli.observers.reduced.system import reduced_system
from gpebo_cli.observers.remedies.plain import Plain
from gpebo_cli.schema import unknown
from gpebo_cli.settings import SolverSettings

_ZERO = 1e-12  # entries below this share of their matrix are zero
_SMALL = 1e-9  # nothing is divided by entries that fall below this share of their largest value
_FINER = 4  # the observer for z_b runs on elements this many times shorter: ẑ_a may be steep,
_HALVES = 34  # and so often is the first one halved: at the start ẑ_a may be steep at any scale
_APART = 1e3  # roundings between two edges


@dataclass(frozen=True, eq=False)
class Blocks:
    """The canonical form's blocks at N times, with first derivatives where they are needed."""

    n_a: int
    B: Array  # (N, n, m)
    N: Array  # (N, n_b, n_b)
    C: Array  # (N, r, n)
    dC: Array  # (N, r, n)


def canonical_blocks(system: DescriptorSystem, t: Array, inside: Array) -> Blocks:
    """Read the blocks off E = diag(I, N), A = diag(A_a, I), F = (F_a, 0).

    ModelError: the plant is not in canonical form; names the entry and the time.
    """
    c = system.coefficients.taylor(t, 1, inside)
    E, A, F = c.E[0], c.A[0], c.F[0]
    n, ones = system.n, np.abs(np.diag(E[0]) - 1.0) <= _ZERO
    n_a = n if ones.all() else int(np.argmin(ones))  # leading ones on the diagonal of E
    one, n_b = np.eye(n), n - n_a
    expected_E, expected_A = np.diag(one[:n_a].sum(axis=0)), one
    free_E, free_A = np.zeros((n, n), bool), np.zeros((n, n), bool)
    free_E[n_a:, n_a:], free_A[:n_a, :n_a] = np.tri(n_b, k=-1, dtype=bool), True
    known = ("E", E, expected_E, free_E), ("A", A, expected_A, free_A)
    for name, matrix, expected, free in known:
        wrong = (np.abs(matrix - expected) > _ZERO) & ~free
        if wrong.any():
            k, i, j = np.argwhere(wrong)[0]
            raise ModelError(
                f"plant {system.name} is not in canonical form: {name}[{i}][{j}] is "
                f"{matrix[k, i, j]:.6g} at t = {t[k]:.6g} instead of {expected[i, j]:g} (E must be "
                f"diag(I, N) with N strictly lower triangular, A diag(A_a, I), here n_a = {n_a}); "
                "use observer=gpebo"
            )
    if np.abs(F[:, n_a:]).max(initial=0.0) > _ZERO:
        raise ModelError(
            f"plant {system.name}: observer=canonical takes unknown parameters in the equations "
            "of z_a only"
        )
    return Blocks(n_a, c.B[0], E[:, n_a:, n_a:], c.C[0], c.C[1])


@dataclass(frozen=True)
class Canonical:
    """Propositions 3 and 4.

    Attributes:
        xi_a0: where the extension starts: by state name, or a list; None: what the plant proposes.
        output: the one that Proposition 4 rests on; None for the first that fits.
        L_w: its gain: diagonal, remark4, or two expressions of t.
        r0: start of its state.
        weights: how much each output counts, by order or name (absent: 1). None: equally.
    """

    xi_a0: Mapping[str, float] | list[float] | None = None
    output: str | None = None
    L_w: str | list[str] = "diagonal"
    r0: list[float] = field(default_factory=lambda: [0.0, 0.0])
    weights: Mapping[str, float] | list[float] | None = None

    def observe(
        self, system: DescriptorSystem, signals: Measurements, solver: SolverSettings
    ) -> Observation:
        """The regression of Proposition 3, and z_b by Proposition 4 where it applies."""
        _refuse_beyond(system)
        mesh = signals.mesh
        blocks = canonical_blocks(system, mesh.points.ravel(), mesh.inside.ravel())
        n_a, suitable = blocks.n_a, _outputs_without_zb(system, blocks)
        scale = output_scale(self.weights, system)
        scale = None if scale is None else scale[suitable]
        of_za = replace(
            system, states=system.states[:n_a], initial_state=system.initial_state[:n_a],
            outputs=tuple(system.outputs[k] for k in suitable),
            coefficients=Changed(
                system.coefficients, partial(_of_differential, system, n_a, suitable)
            ),
        )
        own = Trajectory(mesh, signals.outputs.values[:, :, suitable])
        found = Plain().observe(reduced_system(
            of_za, replace(signals, outputs=own, asked=None), solver, form="given",
            xi_a0=self.xi_a0, weights=None if scale is None else (scale**2).tolist(),
        ))
        # The general observer has 0 = C ξ_a − y + …, and the paper's y = …: signs are the paper's.
        # Weights are relative to those of all outputs, not of these alone.
        regression, size = found.regression, 1.0 if scale is None else scale.max()
        Y, psi = (Trajectory(x.mesh, -size * x.values) for x in (regression.Y, regression.psi))
        zb = _unknown_input_observer(self, system, regression.mesh, signals, n_a)

        def truth(t: Array, theta: Array, states: Trajectory) -> Array:
            return found.truth(t, theta, Trajectory(states.mesh, states.values[..., :n_a]))

        return replace(
            found, regression=replace(regression, Y=Y, psi=psi, scale=size * regression.scale),
            state_map=CanonicalStateMap(found.state_map, zb=zb, n_a=n_a, n_b=system.n - n_a),
            truth=truth,
            assumptions=(
                Assumption(
                    "Assumption 3", "at least one output does not see z_b", True,
                    {"outputs": ", ".join(of_za.outputs)},
                ),
                *(zb.assumptions if zb is not None else ()),
            ),
            unseen=system.states[n_a if zb is None else system.n - (zb.third is None) :],
            errors=None, respond=None, note="",
        )


OBSERVER = Canonical


def _of_differential(
    system: DescriptorSystem, n_a: int, outputs: list[int], t: Array, order: int, inside: Array
) -> Coefficients:
    """The equations of z_a at times t (N,), with some of the outputs, which see nothing else.

    ModelError: the plant is not in canonical form.
    """
    canonical_blocks(system, t, inside)
    c, own = system.coefficients.taylor(t, order, inside), slice(n_a)
    return c._replace(
        E=c.E[:, :, own, own], A=c.A[:, :, own, own], B=c.B[:, :, own], F=c.F[:, :, own],
        C=c.C[:, :, outputs, own], phi=c.phi[:, :, own], D=c.D[:, :, outputs],
        H=c.H[:, :, outputs],
    )


def _refuse_beyond(system: DescriptorSystem) -> None:
    """The canonical form has no further terms."""
    source = system.coefficients
    beyond = [key for key in ("phi", "D", "H") if key not in source.zero]
    beyond += [f"{key} of {', '.join(sorted(names))}" for key, names in source.signals.items()]
    if beyond:
        raise ConfigError(
            f"plant {system.name}: observer=canonical takes E x' = A x + B u + F θ, y = C x with "
            f"functions of t alone, and it has {beyond[0]}; use observer=gpebo"
        )


def _outputs_without_zb(system: DescriptorSystem, blocks: Blocks) -> list[int]:
    n_a = blocks.n_a
    in_zb = np.abs(blocks.C[:, :, n_a:]).max(axis=(0, 2), initial=0.0)
    size = np.abs(blocks.C).max(axis=(0, 2), initial=0.0)
    suitable = [k for k in range(system.r) if in_zb[k] <= _ZERO * size[k] and size[k] > 0]
    if not suitable:
        raise ModelError(
            f"plant {system.name}: Assumption 3 fails: every output sees z_b "
            f"({', '.join(system.states[n_a:])}); observer=canonical needs one that does not"
        )
    return suitable


@dataclass(frozen=True, eq=False)
class UnknownInputObserver:
    """Proposition 4's matrices on a mesh, everything but the estimate of z_a."""

    M: Trajectory  # (2, 2) M_w
    from_y: Trajectory  # (2,) M_w G_w + L_w − Ġ_w
    forcing: Trajectory  # (2,) [I − G_w c⊤] d_w
    G2: Trajectory  # () 1/c2
    y: Trajectory  # () y_ℓ
    C_a: Trajectory  # (n_a,) C^a_ℓ
    algebraic: Trajectory  # (2,) (−f_b1, c1 f_b1/c2), to which (0, y_w/c2) is added
    third: Trajectory | None  # (n,) [C_j row without z_b3, y_j] / C^b_j3 of an output j
    start: Array  # (2,) r(start)
    names: tuple[str, str]  # of z_b1 and z_b2
    assumptions: tuple[Assumption, ...]


def unknown_input_matrices(
    c: Array, dc: Array, N: Array, f_b: Array, L: Array
) -> tuple[Array, Array, Array]:
    """M_w (…, 2, 2), M_w G_w + L_w − Ġ_w (…, 2) and [I − G_w c⊤] d_w (…, 2).

    From c = (c1, c2) and ċ (…, 2), N (…, 3, 3), f_b (…, 3) and L_w (…, 2).
    """
    c1, c2, dc1, dc2 = c[..., 0], c[..., 1], dc[..., 0], dc[..., 1]
    a1 = 1.0 / N[..., 1, 0]
    L1, L2 = L[..., 0], L[..., 1]
    M = np.empty((*c1.shape, 2, 2))
    M[..., 0, 0], M[..., 0, 1] = -L1 * c1, a1 - L1 * c2
    M[..., 1, 0], M[..., 1, 1] = -L2 * c1 - dc1 / c2, -L2 * c2 - (dc2 + a1 * c1) / c2
    G2, dG2 = 1.0 / c2, -dc2 / c2**2
    from_y = M[..., :, 1] * G2[..., None] + L
    from_y[..., 1] -= dG2
    d1 = f_b[..., 1] / N[..., 1, 0]
    # [I − G_w c⊤] d_w = (d1, −c1 d1/c2) does not contain d2, and therefore not f_b3.
    return M, from_y, np.stack([d1, -c1 * d1 / c2], axis=-1)


def diagonalising_gain(c: Array, dc: Array, N: Array) -> Array:
    """L_w = (a1/c2, −ċ1/(c1 c2)): M_w = diag(−a1c1/c2, −a1c1/c2 + d/dt ln(c1/c2)), (…, 2)."""
    a1 = 1.0 / N[..., 1, 0]
    return np.stack([a1 / c[..., 1], -dc[..., 0] / (c[..., 0] * c[..., 1])], axis=-1)


def remark_4_gain(c: Array, N: Array) -> Array:
    """L_w = a1 c1 (c1/c2, 1), the paper's choice for constant coefficients (Remark 4), (…, 2)."""
    first = 1.0 / N[..., 1, 0] * c[..., 0]  # a1 c1
    return np.stack([first * (c[..., 0] / c[..., 1]), first], axis=-1)


def _unknown_input_observer(
    settings: Canonical, system: DescriptorSystem, mesh: Mesh, signals: Measurements, n_a: int
) -> UnknownInputObserver | None:
    """Proposition 4 where it applies: n_b = 3 and some output sees z_b1, z_b2 and not z_b3."""
    if system.n - n_a != 3:
        return None
    mesh, _ = mesh.split(np.full(mesh.size, _FINER))
    begin, end = mesh.edges[:2]
    near = _APART * float(np.spacing(np.abs(mesh.edges).max()))
    graded = with_others(mesh.edges, begin + (end - begin) * 0.5 ** np.arange(1, _HALVES), near)
    mesh = Mesh(graded, mesh.rule)
    t, inside = mesh.points.ravel(), mesh.inside.ravel()
    b = canonical_blocks(system, t, inside)
    f_b = np.einsum("nij,nj->ni", b.B[:, n_a:], signals.inputs(t, inside))
    y = signals.outputs(t, inside)
    start, ell = np.array(settings.r0, dtype=np.float64), _output_for_zw(system, settings, b)
    if start.shape != (2,) or not np.isfinite(start).all():
        raise ConfigError(f"observer.r0: got {settings.r0}; accepted: two finite numbers")
    c, dc = b.C[:, ell, n_a : n_a + 2], b.dC[:, ell, n_a : n_a + 2]
    L = _gain(settings, c, dc, b.N, t, inside)
    M, from_y, forcing = unknown_input_matrices(c, dc, b.N, f_b, L)

    size = np.abs(b.C).max(axis=(0, 2))
    third = None
    if (seen := _apart_from_zero(b.C[:, :, n_a + 2], size)).any():
        j = int(np.argmax(seen))
        row = np.concatenate([b.C[:, j, : n_a + 2], y[:, j : j + 1]], axis=1)
        third = mesh.trajectory(row / b.C[:, j, n_a + 2 : n_a + 3])
    algebraic = np.stack([-f_b[:, 0], c[:, 0] * f_b[:, 0] / c[:, 1]], axis=1)
    on_mesh = mesh.trajectory
    return UnknownInputObserver(
        on_mesh(M), on_mesh(from_y), on_mesh(forcing), on_mesh(1.0 / c[:, 1]), on_mesh(y[:, ell]),
        on_mesh(b.C[:, ell, :n_a]), on_mesh(algebraic), third, start,
        (system.states[n_a], system.states[n_a + 1]),
        _assumptions(system, b.N, c, on_mesh(M), ell),
    )


def _apart_from_zero(entries: Array, size: Array) -> BoolArray:
    """Which entries (N, …) keep their sign, are never small, and are no rounding of a ``size``."""
    least, most = np.maximum(entries.min(axis=0), -entries.max(axis=0)), np.abs(entries).max(axis=0)
    return np.asarray((least > _SMALL * most) & (most > _ZERO * size))


def _output_for_zw(system: DescriptorSystem, settings: Canonical, b: Blocks) -> int:
    """ℓ of Assumption 6: asked for by name, or the first output that satisfies it."""
    row, size = b.C[:, :, b.n_a :], np.abs(b.C).max(axis=(0, 2))
    fits = _apart_from_zero(row[:, :, :2], size[:, None]).all(axis=1)
    fits &= np.abs(row[:, :, 2]).max(axis=0) <= _ZERO * size
    if settings.output is not None:
        if settings.output not in system.outputs:
            what = f"observer.output: {settings.output!r} is not an output"
            raise unknown(what, settings.output, system.outputs)
        ell = system.outputs.index(settings.output)
        if fits[ell]:
            return ell
    elif fits.any():
        return int(np.argmax(fits))
    b1, b2, b3 = system.states[b.n_a :]
    raise ModelError(
        f"plant {system.name}: Assumption 6 fails: "
        + (f"output {settings.output}" if settings.output else "no output")
        + f" sees {b1} and {b2} at every time and {b3} at none"
    )


def _gain(
    settings: Canonical, c: Array, dc: Array, N: Array, t: Array, inside: Array
) -> Array:
    """L_w (N, 2) as asked for: diagonal, remark4, or two expressions of t."""
    if settings.L_w == "diagonal":
        return diagonalising_gain(c, dc, N)
    if settings.L_w == "remark4":
        return remark_4_gain(c, N)
    if isinstance(settings.L_w, str) or len(settings.L_w) != 2:
        raise ConfigError(
            f"observer.L_w: got {settings.L_w!r}; accepted: diagonal, remark4, or a list of two "
            "expressions of t"
        )
    parsed = [parse(text, {}, f"observer.L_w[{i}]") for i, text in enumerate(settings.L_w)]
    return np.asarray(taylor(parsed, t, 0, inside)[0])


def _assumptions(
    system: DescriptorSystem, N: Array, c: Array, M: Trajectory, ell: int
) -> tuple[Assumption, ...]:
    """Assumptions 4, 6 and 7 with their evidence."""
    divided, integral = N[:, [1, 2], [0, 1]], M.integral().final
    # z_b1 and z_b2 count by what the output sees of them at the start, in whatever units they are.
    decay = transition_decay(Trajectory(M.mesh, M.values * c[0, :, None] / c[0]))
    return (
        Assumption(
            "Assumption 4",
            "N21 and N32, which are divided by, have no zero (the other entries may)",
            bool(_apart_from_zero(divided, np.abs(N).max()).all()),
            {"smallest": float(np.abs(divided).min())},
        ),
        Assumption(
            "Assumption 6", "an output sees z_b1 and z_b2 but not z_b3", True,
            {"output": system.outputs[ell], "smallest_c1": float(np.abs(c[:, 0]).min()),
             "smallest_c2": float(np.abs(c[:, 1]).min())},
        ),
        Assumption(
            "Assumption 7", "M_w is stable over the horizon: its transition matrix decays",
            decay < 1.0,
            {"transition_norm": decay, "integral_M11": float(integral[0, 0]),
             "integral_M22": float(integral[1, 1])},
        ),
    )


def transition_decay(M: Trajectory) -> float:
    """‖Φ_w(end)‖ of φ̇ = M_w φ from the identity at the start: below 1, errors have shrunk.

    The values of M have shape (K, s + 1, 2, 2).
    """
    problem = LinearProblem(
        lambda t, inside: LinearEquation(None, M(t, inside), np.zeros((1, 2, 2))), np.eye(2),
        name="M_w",
    )
    solution = solve(problem, M.mesh, tol=1e-6, max_elements=1_000_000)
    return float(np.linalg.norm(solution.trajectory.final, 2))


@dataclass(frozen=True, eq=False)
class CanonicalStateMap(StateMap):
    """ẑ_a = ξ_a + ξ_b θ̂ − Φ_a ê₀, then ẑ_w driven by it, then ẑ_b3 where an output sees it."""

    za: StateMap
    zb: UnknownInputObserver | None
    n_a: int
    n_b: int

    @property
    def times(self) -> Array:
        """The times at which the observer for z_b needs ẑ_a."""
        return np.zeros(0) if self.zb is None else self.zb.M.mesh.points.ravel()

    def at(self, t: Array) -> Reconstruction:
        """Sample all at the times t (M,) once; each batch of cases is one integration."""
        of_za = self.za.at(t)

        def reconstruct(eta: Array) -> Array:
            za = of_za(eta)  # (g, M, n_a)
            unseen = np.full((*za.shape[:2], self.n_b), np.nan)
            zb = unseen if self.zb is None else estimate_zb(self.zb, t, za)
            return np.concatenate([za, zb], axis=2)

        return reconstruct

    def checks(self, t: Array, states: Array) -> Mapping[str, Array]:
        """Algebraic z_b1 = −f_b1 and z_b2 = (y_w + c1 f_b1)/c2, (g, M), from x̂ (g, M, n)."""
        if (zb := self.zb) is None:
            return {}
        y_w = zb.y(t) - np.sum(zb.C_a(t) * states[..., : self.n_a], axis=2)
        known, (first, second) = zb.algebraic(t), zb.names
        return {
            f"{first}_algebraic": np.broadcast_to(known[:, 0], y_w.shape),
            f"{second}_algebraic": known[:, 1] + zb.G2(t) * y_w,
        }


def estimate_zb(zb: UnknownInputObserver, t: Array, za: Array) -> Array:
    """(ẑ_b1, ẑ_b2, ẑ_b3) at the times t (M,) from ẑ_a (g, M, n_a) there, shape (g, M, 3)."""
    mesh, g = zb.M.mesh, len(za)
    where = np.searchsorted(t, mesh.points.ravel())
    points = za[:, np.clip(where, 0, len(t) - 1)].reshape(g, *mesh.points.shape, -1)
    y_w = np.moveaxis(zb.y.values - np.sum(zb.C_a.values * points, axis=-1), 0, -1)
    driven = Trajectory(
        mesh, zb.from_y.values[..., None] * y_w[:, :, None, :] + zb.forcing.values[..., None]
    )
    problem = LinearProblem(
        lambda t, inside: LinearEquation(None, zb.M(t, inside), driven(t, inside)),
        np.repeat(zb.start[:, None], g, axis=1), name="observer of z_b",
    )
    # On the given mesh: ẑ_a is known at its points only.
    r = solve(problem, mesh, tol=1e300, max_elements=mesh.size).trajectory
    zw = r.values.copy()
    zw[:, :, 1] += zb.G2.values[..., None] * y_w
    sampled = np.moveaxis(mesh.sampler(t)(zw), -1, 0)  # (g, M, 2)
    third = np.full((*sampled.shape[:2], 1), np.nan)
    if zb.third is not None:
        row = zb.third(t)
        known = np.concatenate([za, sampled], axis=2)
        third[..., 0] = row[:, -1] - np.sum(row[:, :-1] * known, axis=2)
    return np.concatenate([sampled, third], axis=2)
