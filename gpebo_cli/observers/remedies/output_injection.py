"""Output injection: a dynamic extension that forgets, for a plant whose A_0 does not.

The residual c w = y_c of the regression, c = R𝒜 and y_c = −R (g_y + G θ), holds at every time. So

    w' = (A_0 − K_o c) w + (b_0 − K_o R g_y) + (D_0 − K_o R G) θ

for any K_o(t) whose columns lie in range P. Only A_0, b_0 and D_0 change, and w is still exactly
ξ_a + ξ_b θ − Φ e₀. K_o decides how fast Φ decays, and does not change what is true.

By default K_o is that of a Kalman–Bucy filter with unit weights,

    K_o = S cᵀ/c₀²,     S' = A_0 S + S A_0ᵀ + κ² P − S cᵀc S/c₀²,     S(start) = κ P

with c₀ the root mean square of ‖c‖ over the horizon and κ twice that of the largest real part of
A_0's eigenvalues where it is positive (at least four per horizon), so that neither the unit of
time nor that of the outputs matters. Φ then decays about as fast as it would grow, or twice as
fast. It is not made faster, because with Φ the excitation of e₀ fades, too. S is the covariance
of that filter (``_riccati``). It need not be accurate: what counts is that it is one and the same
smooth function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.model.expressions import parse, taylor
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory, joined
from gpebo_cli.numerics.radau import RadauRule
from gpebo_cli.observers._base import Observation
from gpebo_cli.observers._riccati import Filtered, StateSpace, filter_windows
from gpebo_cli.observers.reduced.matrices import Injection, ObserverMatrices
from gpebo_cli.observers.reduced.split import units_along
from gpebo_cli.observers.reduced.system import ReducedSystem
from gpebo_cli.observers.remedies.plain import Plain

_TOLERANCE = 1e-6  # of S
_PER_HORIZON = 4.0  # rate of the injection where A_0 is stable


@dataclass(frozen=True)
class OutputInjection:
    """A dynamic extension that forgets.

    Attributes:
        injection: K_o, n rows of as many entries as there are outputs, numbers or expressions of
            t; None: from a Riccati equation.
    """

    injection: list[list[float | str]] | None = None

    def observe(self, reduced: ReducedSystem) -> Observation:
        """The observer without a remedy, with A_0 − K_o c in place of A_0."""
        if not reduced.basis.shape[1]:  # nothing moves by itself
            return Plain().observe(reduced)
        if self.injection is None:
            injection, mesh = riccati_injection(reduced)
        else:
            injection, mesh = given_injection(reduced.system, self.injection), reduced.mesh
        return Plain().observe(replace(reduced, injection=injection, mesh=mesh))


def given_injection(system: DescriptorSystem, entries: list[list[float | str]]) -> Injection:
    """K_o as the user has it, a number or an expression of t for each entry.

    It takes the outputs' rows of the residual, as L does in L (y − C x̂). What points out of range
    P is left out (ConfigError: the wrong size, or text that is no expression).
    """
    n, r = system.n, system.r
    sizes = {len(row) for row in entries}
    if len(entries) != n or sizes != {r}:
        raise ConfigError(
            f"observer.injection has {len(entries)} rows of "
            f"{' or '.join(map(str, sorted(sizes)))} entries; plant {system.name} needs {n} "
            f"(states) of {r} (outputs)"
        )
    parsed = [
        parse(entry, {}, f"observer.injection[{i}][{j}]")
        for i, row in enumerate(entries)
        for j, entry in enumerate(row)
    ]

    def gain(o: ObserverMatrices, t: Array, inside: Array) -> Array:
        values = taylor(parsed, t, 0, inside)[0].reshape(-1, n, r)
        return np.asarray(o.split.dual @ o.split.projector @ values @ o.residual[:, -r:])

    return gain


def riccati_injection(reduced: ReducedSystem) -> tuple[Injection, Mesh]:
    """K_o R of the Riccati equation above, for a reduced system without injection.

    Returns:
        The gain, and the mesh in whose elements it is smooth.

    Raises:
        SolverError: S cannot be resolved.
    """
    mesh, basis, dual = reduced.mesh, reduced.basis, reduced.first.split.dual
    variances = reduced.units**2
    horizon = float(mesh.edges[-1] - mesh.edges[0])
    n, squares, windows = basis.shape[1], np.zeros(2), mesh.windows()
    for window in windows:
        o = reduced.matrices(window.points.ravel(), window.inside.ravel())
        unstable = np.maximum(np.linalg.eigvals(o.dynamics).real.max(axis=1, initial=0.0), 0.0)
        norms = np.linalg.norm(o.residual @ o.algebraic @ basis * reduced.units, 2, axis=(1, 2))
        means = (unstable**2).mean(), (norms**2).mean()
        squares += np.multiply(means, window.points.size / mesh.points.size)
    kappa = max(2.0 * float(np.sqrt(squares[0])), _PER_HORIZON / horizon)
    size = max(float(np.sqrt(squares[1])), np.finfo(float).tiny)

    def model(t: Array, inside: Array) -> tuple[StateSpace, tuple[Array, ...]]:
        o = reduced.matrices(t, inside)
        c = o.residual @ o.algebraic @ basis / size
        rows = c.shape[1]
        inside = dual @ o.split.projector @ basis
        Q = kappa**2 * (inside * variances) @ transpose(inside)
        return StateSpace(
            A=np.broadcast_to(o.dynamics, (len(t), n, n)), b=np.zeros((len(t), n, 0)),
            c=np.broadcast_to(c, (len(t), rows, n)), z=np.zeros((len(t), rows, 0)),
            Q=np.broadcast_to(Q, (len(t), n, n)), N=np.zeros((len(t), n, rows)),
            V=np.broadcast_to(np.eye(rows), (len(t), rows, rows)),
        ), ()

    V = dual @ reduced.begin.basis
    V = V * units_along(V, reduced.units)
    S0 = kappa * V @ V.T
    parts = filter_windows(
        model, np.zeros((n, 0)), S0, windows, tol=_TOLERANCE,
        max_elements=reduced.solver.max_elements,
        name=f"output injection for plant {reduced.system.name}", sizes=reduced.units,
    )
    S = joined([_covariance(part, mesh.rule) for part in parts])

    def gain(o: ObserverMatrices, t: Array, inside: Array) -> Array:
        weight = dual @ o.split.projector @ basis @ S(t, inside) / size**2
        return np.asarray(weight @ transpose(o.algebraic @ basis) @ o.residual)

    return gain, S.mesh


def _covariance(found: Filtered, rule: RadauRule) -> Trajectory:
    """S on the elements that resolve it, by a rule that may have fewer stages than were needed."""
    mesh = Mesh(found.mesh.origin + found.mesh.edges, rule)
    return mesh.along(lambda t, inside: found.at(t, inside)[0])
