"""The inner loops: arrays in, arrays out, each of them in NumPy and in C.

For systems so small that NumPy's calls cost more than what is in them, C is many times faster.
Each subject is two modules with the same functions: ``laws_numpy`` says what is computed,
``laws_compiled`` computes it in C, or leaves it to NumPy where sizes or numbers are not for C.
Which of the two is bound here as ``laws`` is decided once, when this package is imported. What is
computed when, and what follows from it, is decided by the callers.

``GPEBO_KERNELS=numpy`` in the environment chooses NumPy, ``compiled`` insists on C.
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

_ASKED = os.environ.get("GPEBO_KERNELS")
_COMPILED = _ASKED != "numpy" and find_spec(f"{__name__}._compiled") is not None
if _ASKED == "compiled" and not _COMPILED:
    raise ImportError("GPEBO_KERNELS=compiled, but nothing was compiled when gpebo was installed")

SUBJECTS = ("elements", "expressions", "laws", "observer", "signals", "structure")


def kind() -> str:
    """What does the inner loops of this process: ``compiled`` or ``numpy``."""
    return "compiled" if _COMPILED else "numpy"


if TYPE_CHECKING:
    from gpebo_cli.kernels import elements_numpy as elements
    from gpebo_cli.kernels import expressions_numpy as expressions
    from gpebo_cli.kernels import laws_numpy as laws
    from gpebo_cli.kernels import observer_numpy as observer
    from gpebo_cli.kernels import signals_numpy as signals
    from gpebo_cli.kernels import structure_numpy as structure

    __all__ = [
        "SUBJECTS", "elements", "expressions", "kind", "laws", "observer", "signals", "structure",
    ]
else:
    for _subject in SUBJECTS:
        globals()[_subject] = import_module(f"{__name__}.{_subject}_{kind()}")
