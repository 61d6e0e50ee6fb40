"""Inner loops in C, for systems so small that NumPy's calls cost more than what is in them.

Every kernel stands for lines of NumPy beside which it is called: those define what it computes,
are what runs where nothing could be compiled, and what the tests hold it against. A kernel takes
and returns arrays, decides nothing and raises nothing but TypeError and ValueError for arrays
that do not fit.

``GPEBO_KERNELS=numpy`` in the environment runs without them.
"""

from __future__ import annotations

import os
from importlib import import_module
from types import ModuleType

_CHOICE = "GPEBO_KERNELS"

compiled: ModuleType | None = None
"""The kernels, or None: look it up at every call, tests switch it off."""
if os.environ.get(_CHOICE, "compiled") != "numpy":
    try:
        compiled = import_module("gpebo_cli.kernels._compiled")
    except ImportError:  # nothing was compiled when the package was built
        compiled = None


def kind() -> str:
    """What does the inner loops of this process: ``compiled`` or ``numpy``."""
    return "numpy" if compiled is None else "compiled"
