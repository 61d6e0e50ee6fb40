"""What is done where Φ grows, or where matrices have noise in them; one module each.

If Φ grows, θ̂ → θ no longer implies x̂ → x.
"""

from __future__ import annotations

from typing import Protocol

from gpebo_cli.observers._base import Observation
from gpebo_cli.observers.reduced.system import ReducedSystem
from gpebo_cli.observers.remedies.current_coordinates import CurrentCoordinates
from gpebo_cli.observers.remedies.noise_free import NoiseFree
from gpebo_cli.observers.remedies.output_injection import OutputInjection
from gpebo_cli.observers.remedies.plain import Plain
from gpebo_cli.observers.remedies.reset import Resets


class Remedy(Protocol):
    """How the GPEBO observer runs its dynamic extension."""

    def observe(self, reduced: ReducedSystem) -> Observation:
        """The regression and the state map of a reduced system on measured signals."""


REMEDIES = {
    "none": Plain,
    "output_injection": OutputInjection,
    "reset": Resets,
    "current_coordinates": CurrentCoordinates,
    "noise_free": NoiseFree,
}
"""By the value of ``observer.remedy``."""
