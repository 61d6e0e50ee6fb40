"""What ``gpebo figures`` shows, and the words that go with each figure.

Figure numbers are those of the paper, arXiv:2407.14373.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Caption:
    """A figure's number in the paper, if it is there, and what it shows."""

    text: str
    number: int | None = None


STUDIES = (
    "paper_circuit", "paper_descriptor", "paper_canonical", "gain_sweep", "estimators_compared",
    "literal_regressor",
)
"""The recipes, in the order in which they are shown."""
PAPERS = "paper_circuit"
"""The one whose figures carry the paper's numbers."""

CAPTIONS: Mapping[str, Caption] = {
    "circuit": Caption(
        "the circuit. Arrows and signs are those that give the printed E(t) and A(t). With them "
        "e2 − e1 = −R₁ ir1, and R₁ is printed negative: a resistor of −R₁ > 0. But e1 = R₂ ir2, "
        "and R₂ is printed negative as well: taken literally, that branch delivers power. All "
        "elements vary with time.",
        1,
    ),
    "signals": Caption("inputs and outputs"),
    "regressor": Caption("the regressor ψ", 2),
    "states": Caption("the states", 3),
    "estimates": Caption("the states and their estimates"),
    "estimates_a": Caption("the differential states x_a and their estimates", 4),
    "estimates_b": Caption("the other states x_b and their estimates", 5),
    "parameter_error": Caption("size of the error of each parameter, for each gain", 6),
    "state_error": Caption("size of the error of each state, for each gain"),
    "state_error_a": Caption("size of the errors of x_a, for each gain", 7),
    "state_error_b": Caption("size of the errors of x_b, for each gain", 8),
    "gram": Caption(
        "eigenvalues of the Gram matrix of the regressor: it is interval-exciting from the time "
        "at which the smallest one passes ρ"
    ),
    "delta": Caption("Δ, the determinant that mixing leaves as a scalar regressor"),
    "gains": Caption("final errors, and the time after which errors stay below 1 %, by gain"),
    "error_norms": Caption("norms of the errors of all parameters and all states, for a few gains"),
    "estimators": Caption("norms of the errors of all parameters and all states, by estimator"),
}

# What a committed reference is compared with: the paper's figures and those over gains and
# estimators. Of Δ and the Gram matrix the early part, 1e-20, is rounding.
REFERENCE = (
    "regressor", "states", "estimates_a", "estimates_b", "parameter_error", "state_error_a",
    "state_error_b", "gains", "error_norms", "estimators",
)


def stem(figure: str) -> str:
    """Name of a figure's files: with the paper's number where it has one."""
    number = CAPTIONS[figure].number
    return f"fig_{figure}" if number is None else f"fig{number}_{figure}"


def heading(figure: str, recipe: str) -> str:
    """What a caption begins with."""
    number = CAPTIONS[figure].number
    if number is None:
        return "Not in the paper"
    return f"Fig. {number} of the paper" if recipe == PAPERS else f"As Fig. {number}"
