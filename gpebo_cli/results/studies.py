"""What ``gpebo figures`` shows of each recipe, and the words that go with it.

Figure numbers are those of the paper, arXiv:2407.14373.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

_OF_THE_PAPER = (
    "regressor", "states", "estimates_a", "estimates_b", "parameter_error", "state_error_a",
    "state_error_b", "gram", "delta",
)


@dataclass(frozen=True)
class Study:
    """A recipe's figures (None: all its run has), and whose settings it uses."""

    figures: tuple[str, ...] | None = None
    note: str = ""
    is_the_papers: bool = False  # its figures carry the paper's numbers


@dataclass(frozen=True)
class Caption:
    """A figure's number in the paper, if it is there, and what it shows."""

    text: str
    number: int | None = None


STUDIES: Mapping[str, Study] = {
    "paper_circuit": Study(
        _OF_THE_PAPER,
        "The paper’s: the circuit, its input and initial values, the start of the dynamic "
        "extension, the filters 0.1, 0.2, 0.3 and the gain γ = 10¹⁰. Ours: the horizon of 20 s, "
        "of which the paper states none, and the second gain, γ = 10⁸, of which it says only that "
        "there is one. The regressor is the projected one: taken literally, the paper’s is zero "
        "(last study). The initial current iv is −3.45 A, not −0.25 A as printed: index 2 leaves "
        "no choice.",
        is_the_papers=True,
    ),
    "paper_descriptor": Study(
        _OF_THE_PAPER,
        "The paper’s: the form of the system and of the observer (Section II). Ours: all numbers, "
        "the horizon of 20 s, and the estimator, ls_drem with γ = 1 and 10. With the circuit’s "
        "filters Δ is so small here that γ would have to be 10¹⁴.",
    ),
    "paper_canonical": Study(
        _OF_THE_PAPER,
        "The paper’s: the form of the system and the observers of Propositions 3 and 4, the "
        "latter with its signs corrected. Ours: all numbers, the horizon of 20 s, and the "
        "estimator, ls_drem with γ = 1 and 10. The observer does not see zb3, so its estimate is "
        "not drawn. Those of zb1 and zb2 come from the observer of Proposition 4, whose error "
        "decays at its own rate, whatever γ.",
    ),
    "gain_sweep": Study(
        ("gains", "error_norms"),
        "The circuit with 25 gains from 10⁶ to 10¹² in one run. The paper’s: γ = 10¹⁰. Ours: all "
        "other gains and the horizon of 20 s, which is enough for all of them: the final errors "
        "are rounding.",
    ),
    "estimators_compared": Study(
        (),
        "The circuit once for every estimator, each with its own default gains, which are not "
        "comparable with each other. The paper’s: drem with γ = 10¹⁰. Ours: all others and the "
        "horizon of 20 s. The gradient needs persistent excitation, which the circuit does not "
        "have.",
    ),
    "literal_regressor": Study(
        ("regressor", "parameter_error"),
        "The circuit with the regressor as eq. (regpsi) defines it: the last r rows of the "
        "residual. They carry all of it only if A22 is nonsingular, and the circuit’s is not: ψ "
        "is zero, nothing is excited, and no estimate moves. Ours: the horizon of 20 s.",
    ),
}

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
REFERENCE = (*_OF_THE_PAPER[:7], "gains", "error_norms", "estimators")


def stem(figure: str) -> str:
    """Name of a figure's files: with the paper's number where it has one."""
    number = CAPTIONS[figure].number
    return f"fig_{figure}" if number is None else f"fig{number}_{figure}"


def heading(figure: str, study: Study) -> str:
    """What a caption begins with."""
    number = CAPTIONS[figure].number
    if number is None:
        return "Not in the paper"
    return f"Fig. {number} of the paper" if study.is_the_papers else f"As Fig. {number}"
