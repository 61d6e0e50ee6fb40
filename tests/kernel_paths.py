"""For tests that compare a whole computation with the compiled kernels and without."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from typing import Any

import pytest

from benchmarks.kernels import without
from gpebo_cli import kernels

needs_kernels = pytest.mark.skipif(
    kernels.kind() == "numpy" and os.environ.get("GPEBO_KERNELS") != "compiled",
    reason="the kernels are not compiled",
)
COMPILED: Any = None
if kernels.kind() == "compiled":
    COMPILED = import_module("gpebo_cli.kernels._compiled")


def by_both(compute: Callable[[], Any]) -> tuple[Any, Any]:
    """What ``compute`` returns with the kernels, and without."""
    with_kernels = compute()
    with without():
        return with_kernels, compute()
