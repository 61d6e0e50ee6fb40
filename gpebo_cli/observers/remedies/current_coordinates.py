"""The state itself is the parameter, without Φ, for a plant whose A_0 does not forget.

With V an orthonormal basis of range P, ζ = (θ, Vᵀw) moves by known dynamics and is measured by
the algebraic equations without v:

    ζ' = 𝔸 ζ + 𝕓,      𝔸 = [[0, 0], [Vᵀ D_0, Vᵀ A_0 V]],  𝕓 = (0, Vᵀ b_0)
    Y = ψ ζ,           ψ = [R G, R𝒜 V],  Y = −R g_y

Nothing is integrated here. Estimators that can follow ζ work with it (``estimate_moving``): their
filters carry ψᵀψ along with the current ζ. Where the kernel of E rotates, w is taken in all n
coordinates, V = I, and Q w = 0 is measured, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import prod
from typing import TypeAlias

import numpy as np

from gpebo_cli.kernels import arrays
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.errors import EPS, ROUNDING
from gpebo_cli.numerics.mesh import Kind, Mesh, Trajectory
from gpebo_cli.numerics.refinement import resolve
from gpebo_cli.observers._base import AffineStateMap, Observation
from gpebo_cli.observers.reduced.extension import Extension, joined, kept_of
from gpebo_cli.observers.reduced.matrices import weakest
from gpebo_cli.observers.reduced.regression import Assembled, largest_at, regression_signals
from gpebo_cli.observers.reduced.system import ReducedSystem
from gpebo_cli.regression.dynamics import Dynamics
from gpebo_cli.regression.linear import LinearRegression

_APART = 1e4  # times what w does to itself: beside more float64 numbers lose it
# Times and where jumps are decided, (2, K, s + 1); the rest at these; what the mesh has to resolve.
_Evaluated: TypeAlias = tuple[Array, Assembled, Array, tuple[float, float], list[Kind]]


@dataclass(frozen=True, eq=False)
class CurrentState:
    """ζ = (θ, Vᵀw) with w = V Vᵀx, or w = P(t) x for V = I."""

    reduced: ReducedSystem

    def __call__(self, t: Array, theta: Array, states: Trajectory) -> Array:
        """ζ at the times t (M,), shape (M, q + d)."""
        dual, x = self.reduced.first.split.dual, states(t)
        if len(dual) > self.reduced.first.split.rank:
            x = np.einsum("mij,mj->mi", self.reduced.matrices(t, t).split.projector, x)
        return np.concatenate([theta, x @ dual.T], axis=1)


@dataclass(frozen=True)
class CurrentCoordinates:
    """No Φ: what is estimated moves along with the state."""

    def observe(self, reduced: ReducedSystem) -> Observation:
        """The regression about ζ and its dynamics.

        Hidden constraints are measured. w need not be held on them: filters would have to forget as
        fast as that is done.
        """
        reduced = replace(reduced, form=replace(reduced.form, held=False))
        system, solver = reduced.system, reduced.solver
        q, n, basis = system.q, system.n, reduced.basis
        rotates = basis.shape[1] > reduced.first.split.rank
        k = basis.shape[1]
        # [ξ_a | ξ_b | Φ] = [0 | 0 | −I] is the identity map from ζ to w.
        identity = np.concatenate([np.zeros((k, 1 + q)), -np.eye(k)], axis=1)
        p = q + k
        reduced.signals.check_memory(system, more=k * (p + 1))
        units = np.concatenate([reduced.form.units.unknowns, reduced.units])
        duration = float(reduced.mesh.edges[-1] - reduced.mesh.edges[0])
        # What an unknown does at the start is no unit of it where it does much more later on.
        first, of_w = reduced.first, units[q:]
        rate = max(np.abs(first.dynamics * of_w / of_w[:, None]).max(initial=0.0), 1.0 / duration)
        does = np.abs(first.from_unknowns / of_w[:, None]).max(axis=(0, 1), initial=0.0)
        units[:q] = np.minimum(units[:q], _APART * rate / np.maximum(does, np.finfo(float).tiny))
        start = first.at_first
        size = np.abs(np.concatenate([start.G, start.on_basis], axis=2) * units).max(initial=0.0)
        past = np.zeros((2, 0, len(reduced.mesh.rule.points)))

        def evaluate(mesh: Mesh) -> tuple[_Evaluated, list[Kind]]:
            times = np.concatenate([past, [mesh.points, mesh.inside]], axis=1)
            t, inside = times.reshape(2, -1)
            o = reduced.matrices(t, inside)
            signals = reduced.measured(t, inside)
            rows = arrays.joined(o.from_unknowns, o.dynamics, o.from_signals @ signals, axis=2)
            z = np.broadcast_to(identity, (len(t), *identity.shape))
            a = regression_signals(z, basis, o.equations(signals))
            a = replace(a, Y=-a.Y, psi=-a.psi)  # as measurements of ζ: ψ = [R G, R𝒜V]
            if rotates:
                # Further rows 0 = Q w, of the size of ψ; those of the outputs remain the last ones.
                kernel = size / reduced.units[:, None] * (np.eye(n) - o.split.projector)
                more = np.pad(np.broadcast_to(kernel, (len(t), n, n)), ((0, 0), (0, 0), (q, 0)))
                a = replace(a, Y=np.pad(a.Y, ((0, 0), (n, 0))), psi=np.hstack([more, a.psi]))
            own = rows * np.append(units, 1.0) / units[q:, None]
            # Rates that do nothing over the horizon may be rough, and what is rounding beside them.
            of_state, of_known = own[..., :p], own[..., p]
            fastest = max(float(np.abs(of_state).max(initial=0.0)), 1.0 / duration)
            rounding = ROUNDING * EPS / solver.tol * fastest
            kinds = (
                *a.kinds(reduced.form.units.states), (of_state, 1.0 / duration),
                (of_known, rounding),
            )
            seen = [(v.reshape(*times.shape[1:], prod(v.shape[1:])), floor) for v, floor in kinds]
            smallest, where = weakest(o.injectivity, o.elimination)
            return (times, a, rows, (smallest, float(t[where])), seen), seen

        def parts() -> Iterator[Extension]:
            """What is made of one window after the other, [D_0 | A_0 | b_0] as its trajectory.

            Those elements of windows before in which something was largest stand in front.
            """
            nonlocal past
            for window in reduced.mesh.windows():
                mesh, (times, a, rows, smallest, seen), error = resolve(
                    evaluate, window, tol=solver.tol, max_elements=solver.max_elements,
                    name=f"observer of plant {system.name}",
                )
                front = past[0].size
                past = times[:, largest_at(v for v, _ in seen)]
                yield Extension(
                    mesh.trajectory(rows[front:]), error, a.after(front),
                    np.broadcast_to(a.column_scale, (mesh.size, p)), smallest,
                )

        found = joined(kept_of(parts(), reduced.mesh, reduced.signals.asked))
        kept = found.assembled.kept_rows(system, reduced.regression)
        if rotates:
            kept = np.union1d(np.arange(n), kept)
        return Observation(
            regression=LinearRegression(
                *found.rows(kept), parameters=(*system.unknowns, *reduced.labels),
                scale=found.scale, dynamics=Dynamics(found.trajectory, units),
            ),
            state_map=AffineStateMap(*found.state_map, reduced.form.units.states),
            truth=CurrentState(reduced),
            error_estimate=found.error_estimate,
            assumptions=reduced.assumptions(found.weakest),
            growth=None,
            note=reduced.note,
        )
