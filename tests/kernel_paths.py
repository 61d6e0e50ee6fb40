"""For tests that compare the compiled kernels with the NumPy they stand for.

Where nothing could be compiled such tests are skipped, unless ``GPEBO_KERNELS=compiled`` asks for
the kernels.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import pytest

from gpebo_cli import kernels

needs_kernels = pytest.mark.skipif(
    kernels.compiled is None and os.environ.get("GPEBO_KERNELS") != "compiled",
    reason="the kernels are not compiled",
)
COMPILED: Any = kernels.compiled


def by_both(compute: Callable[[], Any]) -> tuple[Any, Any]:
    """What ``compute`` returns with the kernels, and without."""
    with_kernels = compute()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "compiled", None)
        return with_kernels, compute()
