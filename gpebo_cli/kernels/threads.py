"""Threads of BLAS: where matrices are small they mostly wait for each other."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, wraps
from typing import Any, TypeVar, cast

_Work = TypeVar("_Work", bound=Callable[..., Any])
_LARGE = 200  # states, up to which one thread is as fast as several


def single() -> Any:
    """A context with one thread of BLAS."""
    # SciPy brings a BLAS of its own when it is needed; others are not called here.
    return _pools("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas")


def one_thread(work: _Work) -> _Work:
    """``work(settings, system, …)`` with one thread of BLAS, unless the plant is large."""

    @wraps(work)
    def limited(settings: Any, system: Any, *args: Any, **kwargs: Any) -> Any:
        with nullcontext() if system.n > _LARGE else single():
            return work(settings, system, *args, **kwargs)

    return cast(_Work, limited)


@cache
def _pools(_with_scipy: bool) -> Any:
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

    return ThreadpoolController()
