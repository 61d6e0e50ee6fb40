"""The observer of a time-invariant plant as one linear system with constant matrices.

Theory 4 with ŵ = ξ_a + ξ_b θ − Φ e₀, in which e₀ is the start of the state alone:

    ŵ' = A_0 ŵ + b_0 + D_0 θ,      x̂ = (I − K𝒜) ŵ − K (g_y + G θ)

where b_0 and g_y are linear in u and y.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.descriptor import Array, DescriptorSystem
from gpebo_cli.observers._base import ByName
from gpebo_cli.observers.reduced.system import choose_form
from gpebo_cli.reduction.form import InputDerivatives
from gpebo_cli.settings import SolverSettings


class Invariant(NamedTuple):
    """ŵ' = A ŵ + B [u; y; θ], x̂ = C ŵ + D [u; y; θ]."""

    A: Array  # (k, k)
    B: Array  # (k, m + r + q)
    C: Array  # (n, k)
    D: Array  # (n, m + r + q)
    states: tuple[str, ...]  # (k,)


def invariant_observer(
    system: DescriptorSystem, solver: SolverSettings, form: str, weights: ByName | None,
    start: float,
) -> Invariant:
    """The observer's matrices, with ``observer.form`` and ``.weights``, at ``start`` seconds.

    ConfigError: a plant that varies with time, or an observer that needs derivatives of inputs.
    """
    moving = [key for key in "EABFCDH" if key not in system.coefficients.constant]
    if moving or "phi" not in system.coefficients.zero:
        raise ConfigError(
            f"plant {system.name} is not time-invariant: {moving[0] if moving else 'phi'} "
            + ("depends on time or on signals" if moving else "is not zero")
            + ", and a state-space model has constant matrices alone"
        )
    t = np.array([start])
    derivatives = InputDerivatives.of_plant(system, np.ones(system.m, dtype=bool))
    used, o, _ = choose_form(system, t, t, None, derivatives, solver, form, weights)
    if used.derivatives:
        raise ConfigError(
            f"plant {system.name}: its observer needs derivatives of inputs, which no state-space "
            "model has"
        )
    K = o.elimination[0] @ o.range[0].T
    basis: Array = o.split.basis
    return Invariant(
        o.dynamics[0],
        np.concatenate([o.from_signals[0], o.from_unknowns[0]], axis=1),
        basis - K @ o.on_basis[0],
        -K @ np.concatenate([o.g_signals[0], o.G[0]], axis=1),
        o.split.coordinates(system.states, used.units.states),
    )
