"""Formulas as these pages write them, in Unicode, as TeX for KaTeX.

The sources stay readable in an editor and on a terminal; only the site sets them.
"""

from __future__ import annotations

import html
import re
import unicodedata

_OPERATORS = (
    "rank", "range", "diag", "det", "adj", "ker", "min", "max", "argmin", "ln", "exp", "sin", "cos",
    "tan", "cov", "sign", "dim", "lp", "hp",
)
_ACCENTS = {"\u0302": "hat", "\u0304": "bar", "\u0307": "dot", "\u0308": "ddot", "\u0303": "tilde"}
_RAISED = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺ᵀᵏⁱⁿᵗ", "0123456789-+Tkint", strict=True))
_LOWERED = dict(zip("₀₁₂₃₄₅₆₇₈₉₊₋", "0123456789+-", strict=True))
_SIGNS = {
    "−": "-", "·": r"\cdot ", "…": r"\dots ", "→": r"\to ", "⇒": r"\Rightarrow ", "×": r"\times ",
    "⊕": r"\oplus ", "ℝ": r"\mathbb{R}", "ℂ": r"\mathbb{C}", "∏": r"\prod ", "∂": r"\partial ",
    "ℓ": r"\ell ", "𝟙": r"\mathbf{1}", "𝕓": r"\mathbf{b}", "‖": r"\|", "≤": r"\le ", "≥": r"\ge ",
    "≠": r"\ne ", "≈": r"\approx ", "∈": r"\in ", "∞": r"\infty ", "½": "1/2", "%": r"\%",
    "#": r"\#", "∫": r"\int ",
}
_MATHS = re.compile(
    r"[Α-ω⊤∫Σ∏∂‖≤≥·𝒜-𝓏𝔸-𝕫𝟙⁻⁺₀-₉²³½√−\u0302\u0304\u0307]|\^[({]|(?<!\w)[A-Za-z]_[^\W_]\b"
    r"|(?<=\w)'(?!\w)"
)
_NOT_MATHS = re.compile(r"gpebo|/\w+\.|\.(?:py|md|csv|json|yaml)|=\w+\.|\w+\.\w+=|\$ |--|\w+\(\)")
_MATRIX = re.compile(r"\[(?=[^][]*(?:\w \d\b|\b\d \w))[^][]*\]")  # with entries side by side
_WORD = re.compile(r"(?<![A-Za-z\\_^{])[a-z][A-Za-z]+(?![A-Za-z}])|[A-Z][a-z]{2,}")


def is_formula(text: str) -> bool:
    """Whether a piece of code is one."""
    return bool(_MATHS.search(unicodedata.normalize("NFD", text))) and not _NOT_MATHS.search(text)


def tex(text: str) -> str:
    """One line of Unicode as TeX."""
    notes: list[str] = []

    def note(match: re.Match[str]) -> str:
        notes.append(match[0].strip())
        return f" @{chr(0xE000 + len(notes) - 1)}@ "

    text = re.sub(r" {2,}", r" \\quad ", text.strip())
    text = _MATRIX.sub(lambda m: re.sub(r"(?<=\w) (?=\w)", r"\\ \\ ", m[0]), text)
    text = re.sub(r"\((?:eq|eqs|for|the paper|d equations|a equations)[^()]*\)", note, text)
    text = unicodedata.normalize("NFD", text.replace("≠", r"\ne "))
    text = re.sub(r"(\w)([\u0302\u0303\u0304\u0307\u0308])",
                  lambda m: rf"\{_ACCENTS[m[2]]}{{{m[1]}}}", text)
    text = re.sub(r"(\\(?:hat|bar|dot)\{\w\})(\d)", r"\1_{\2}", text)
    text = re.sub(r"Σ(?=_)", r"\\sum ", text)
    for table, mark in ((_RAISED, "^"), (_LOWERED, "_")):
        text = re.sub(f"[{''.join(table)}]+",
                      lambda m, t=table, k=mark: f"{k}{{{''.join(t[c] for c in m[0])}}}", text)
    text = text.replace("⊤", r"^{\top}")
    text = re.sub(r"\^\{([^{}]*)\}\^\{([^{}]*\\top[^{}]*)\}", r"^{\1\2}", text)
    text = re.sub(r"√\(([^()]*)\)", r"\\sqrt{\1}", text)
    text = re.sub(r"√(\w)", r"\\sqrt{\1}", text)
    text = re.sub(r"\^\(([^()]*)\)", r"^{(\1)}", text)
    text = re.sub(r"(?<![\w.{\\])([A-Za-z])(\d+)_([^\W_]+)", r"\1_{\2,\\mathrm{\3}}", text)
    text = re.sub(r"([_^])([^\W_]{2,})", r"\1{\\mathrm{\2}}", text)
    text = re.sub(r"_(\w)_\{", r"_{\1", text)
    text = re.sub(r"(?<![\w.{\\])([A-Za-z])(\d+)(?![\d.}])", r"\1_{\2}", text)
    text = _WORD.sub(_named, text)
    for sign, command in _SIGNS.items():
        text = text.replace(sign, command)
    return re.sub(r"@(.)@", lambda m: rf"\text{{{notes[ord(m[1]) - 0xE000]}}}", text)


def _named(match: re.Match[str]) -> str:
    word, before = match[0], match.string[: match.start()]
    if before.endswith("\\") or re.search(r"\\(mathrm|text|hat|bar|dot|sqrt)\{$", before):
        return word
    if word in _OPERATORS:
        return rf"\operatorname{{{word}}} "
    return rf"\text{{ {word} }}"


def typeset(page: str) -> str:
    """A page of HTML with formulas marked for KaTeX in place of code."""
    page = re.sub(
        r'<div class="highlight"><pre>(?:<span></span>)?<code>(.*?)</code></pre></div>', _block,
        page, flags=re.DOTALL,
    )
    return re.sub(r"(?<!<pre>)(?<!</span>)<code>([^<]*)</code>", _inline, page)


def _block(match: re.Match[str]) -> str:
    text = html.unescape(re.sub("<[^>]*>", "", match[1]))
    lines = [line for line in text.splitlines() if line.strip()]
    if not all(map(is_formula, lines[:1])) or any(map(_NOT_MATHS.search, lines)):
        return match[0]
    rows = r" \\ ".join(map(tex, lines))
    return f'<div class="tex">\\begin{{array}}{{l}} {html.escape(rows)} \\end{{array}}</div>'


def _inline(match: re.Match[str]) -> str:
    text = html.unescape(match[1])
    return f'<span class="tex">{html.escape(tex(text))}</span>' if is_formula(text) else match[0]
