"""Output injection: a dynamic extension that forgets, for a plant whose A_0 does not.

The residual c w = y_c of the regression, c = R𝒜 and y_c = −R (g_y + G θ), holds at every time. So

    w' = (A_0 − K_o c) w + (b_0 − K_o R g_y) + (D_0 − K_o R G) θ

for any K_o(t) whose columns lie in range P. Only A_0, b_0 and D_0 change, and w is still exactly
ξ_a + ξ_b θ − Φ e₀. K_o decides how fast Φ decays, and does not change what is true.

By default K_o is that of a Kalman–Bucy filter with small weights,

    K_o = S cᵀ,     S' = A_0 S + S A_0ᵀ + 0.01 P (A_0 A_0ᵀ + 0.01‖A_0‖² I) P − S cᵀc S

from S = P (A_0 A_0ᵀ)^½ P, in comparable units, which are found at the start. Any such weights make
Φ bounded and let it decay where outputs see what grows (Kalman & Bucy 1961). These hardly touch
what decays by itself, and what grows decays about as fast as it would grow. It is not made faster,
because with Φ the excitation of e₀ fades, too. Nothing is weighed over the horizon: S follows from
A_0 and c until then. It is the covariance of that filter (``_riccati``), and need not be accurate:
what counts is that it is one and the same smooth function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.model.expressions.syntax import parse
from gpebo_cli.model.expressions.tape import taylor
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory, joined
from gpebo_cli.numerics.radau import RadauRule
from gpebo_cli.observers._base import Observation
from gpebo_cli.observers._riccati import Filtered, StateSpace, filter_windows
from gpebo_cli.observers.reduced.matrices import Injection, ObserverMatrices
from gpebo_cli.observers.reduced.system import ReducedSystem
from gpebo_cli.observers.remedies.plain import Plain

_TOLERANCE = 1e-8  # of S
_SHARE = 0.01  # of A_0 A_0ᵀ, and
_LEAST = 1e-2  # of its trace in all directions


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
    basis, dual, units = reduced.basis, reduced.first.split.dual, reduced.units
    n = basis.shape[1]

    A_0 = reduced.first.at_first.dynamics[0] * units / units[:, None]
    U, sizes, _ = np.linalg.svd(A_0)
    inward = dual @ reduced.begin.basis @ reduced.begin.dual @ basis @ (units[:, None] * U)

    def model(t: Array, inside: Array) -> tuple[StateSpace, tuple[Array, ...]]:
        o = reduced.matrices(t, inside)
        c = o.residual @ o.algebraic @ basis
        rows = c.shape[1]
        inside, A_0 = dual @ o.split.projector @ basis * units, o.dynamics * units / units[:, None]
        size = _LEAST * np.einsum("nij,nij->n", A_0, A_0)[:, None, None]
        Q = _SHARE * inside @ (A_0 @ transpose(A_0) + size * np.eye(n)) @ transpose(inside)
        return StateSpace(
            A=o.dynamics, b=np.zeros((1, n, 0)), c=c, z=np.zeros((1, rows, 0)), Q=Q,
            N=np.zeros((1, n, rows)), V=np.eye(rows)[None],
        ), ()

    parts = filter_windows(
        model, np.zeros((n, 0)), (inward * sizes) @ inward.T, reduced.mesh.windows(),
        tol=_TOLERANCE, max_elements=reduced.solver.max_elements,
        name=f"output injection for plant {reduced.system.name}", sizes=units,
        advice="give the gain, observer.injection, or choose another remedy",
    )
    S = joined([_covariance(part, reduced.mesh.rule) for part in parts])

    def gain(o: ObserverMatrices, t: Array, inside: Array) -> Array:
        weighted = dual @ o.split.projector @ basis @ S(t, inside)
        return np.asarray(weighted @ transpose(o.algebraic @ basis) @ o.residual)

    return gain, S.mesh


def _covariance(found: Filtered, rule: RadauRule) -> Trajectory:
    """S on the elements that resolve it, by a rule that may have fewer stages than were needed."""
    mesh = Mesh(found.mesh.origin + found.mesh.edges, rule)
    return mesh.along(lambda t, inside: found.at(t, inside)[0])
