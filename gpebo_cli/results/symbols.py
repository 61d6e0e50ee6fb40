"""Names and numbers as people write them: in plain Unicode for tables, as mathtext for figures."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_SUBSCRIPT = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_LETTERS = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η",
    "theta": "θ", "iota": "ι", "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ",
    "pi": "π", "rho": "ρ", "sigma": "σ", "tau": "τ", "upsilon": "υ", "phi": "φ", "chi": "χ",
    "psi": "ψ", "omega": "ω", "Gamma": "Γ", "Delta": "Δ", "Theta": "Θ", "Lambda": "Λ", "Xi": "Ξ",
    "Pi": "Π", "Sigma": "Σ", "Phi": "Φ", "Psi": "Ψ", "Omega": "Ω",
}
_INDEXED = re.compile(r"((?:\\.|\{[^{}]*\}|[^\\{}_^])+)(?:([_^])(.*))?", re.DOTALL)
_WORD = re.compile(r"([A-Za-z]+)(\d*)")


def with_unit(name: str, unit: str, between: str = " ") -> str:
    """Name of an axis: ``e1 (V)``, ``load (N·m)``, or the bare name where no unit is known."""
    return f"{name}{between}({unit.replace('*', '·')})" if unit else name


def unit_of(name: str, units: Mapping[str, str]) -> str:
    """Unit of a quantity, empty if unknown: ``e0_<state>`` has that of the state.

    So has ``e0_<state>_2``, of a second file.
    """
    of_state = re.fullmatch(r"e0_(.+?)(_\d+)?", name)
    state, number = of_state.groups("") if of_state else (name, "")
    return units.get(name) or units.get(state + number) or units.get(state, "")


def power_of_ten(exponent: int) -> str:
    """``10⁻³`` in Unicode."""
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def number_text(value: float) -> str:
    """A few digits, in powers of ten where that is shorter: ``0.5``, ``10¹⁰``, ``2.5·10⁻⁷``."""
    if not math.isfinite(value) or value == 0.0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.4g}".replace("-", "−")
    mantissa, exponent = f"{value:.2e}".split("e")
    mantissa = mantissa.rstrip("0").rstrip(".").replace("-", "−")
    power = power_of_ten(int(exponent))
    return {"1": power, "−1": f"−{power}"}.get(mantissa, f"{mantissa}·{power}")


def symbol(gain: str) -> str:
    """Symbol of a gain as a paper prints it: ``gamma`` is γ, ``gamma_2`` is γ₂, ``f0`` is f₀."""
    word = gain.rstrip("0123456789").rstrip("_")
    digits = gain[len(word) :].lstrip("_").translate(_SUBSCRIPT)
    if word in _LETTERS:
        return _LETTERS[word] + digits
    return word + digits if len(word) == 1 else gain


def math_of(name: str, labels: Mapping[str, str]) -> str:
    r"""A name as mathtext without its dollars; empty where it is a phrase and no symbol.

    ``x1`` becomes ``x_{1}``, ``theta`` becomes ``\theta``, and ``e0_il`` becomes ``e_{0,i_L}`` if
    ``i_L`` is the label of ``il``: ``labels`` are what the plant's author writes, by name.
    """
    if name in labels:
        return labels[name]
    head, *rest = name.split("_")
    match = _WORD.fullmatch(head)
    if match is None or len(name) > 12 or not all(rest):
        return ""
    letters, digits = match.groups()
    below = [digits] if digits else []
    below += [math_of(part, labels) or f"\\mathrm{{{part}}}" for part in rest]
    if letters in _LETTERS:
        letters = f"\\{letters}"
    elif len(letters) > 1:
        letters = f"\\mathrm{{{letters}}}"
    return f"{letters}_{{{','.join(below)}}}" if below else letters


def typeset(name: str, labels: Mapping[str, str]) -> str:
    """A name for a figure: in math where :func:`math_of` knows it as a symbol."""
    math = math_of(name, labels)
    return f"${math}$" if math else escaped(name)


def error_of(name: str, labels: Mapping[str, str], *, signed: bool) -> str:
    """``|x̂ − x|``, or ``x̂ − x`` if ``signed``, for a figure."""
    math = math_of(name, labels)
    if not math:
        return f"error of {escaped(name)}"
    # The hat stands on the letter, and not on its index, or on all within \left( … \right).
    match = None if "\\left" in math else _INDEXED.fullmatch(math)
    letter, mark, index = match.groups("") if match else (math, "", "")
    hat = f"\\widehat{{{letter}}}" if letter.startswith("\\mathrm") else f"\\hat{{{letter}}}"
    difference = f"{hat}{mark}{index} - {math}"
    return f"${difference}$" if signed else f"$|{difference}|$"


def escaped(text: str) -> str:
    """Text that matplotlib does not take for math."""
    return text.replace("$", r"\$")
