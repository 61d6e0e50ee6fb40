"""What a simulation of E x' = A x + f, y = C x + D u returns."""

from __future__ import annotations

from dataclasses import dataclass

from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.reduction.consistency import Jump
from gpebo_cli.reduction.structure import Structure
from gpebo_cli.simulation.newton import Effort


@dataclass(frozen=True, eq=False)
class Signals:
    """What the observer may see (u, y) and, in a simulation, the truth (x)."""

    inputs: Trajectory  # (m,)
    outputs: Trajectory  # (r,)
    states: Trajectory  # (n,)

    @property
    def mesh(self) -> Mesh:
        """The mesh all three live on."""
        return self.states.mesh


@dataclass(frozen=True, eq=False)
class Simulation:
    """Signals with the evidence of how they were computed."""

    signals: Signals
    structure: Structure
    initial_state: Array  # (n,) consistent
    jumps: tuple[tuple[float, Array, Jump], ...]  # (time, limit from the left, jump)
    error_estimate: float  # relative to each signal's own size, the largest
    bounded: bool  # known functions are bounded between the nodes: nothing narrow was missed
    effort: Effort | None = None  # of Newton's method, where the plant is not linear
    state_errors: Array | None = None  # (n,) of each state relative to its own largest value
    lost: float | None = None  # from when on rounding errors exceed a state
    vague: BoolArray | None = None  # (n,) states of which few digits are known
