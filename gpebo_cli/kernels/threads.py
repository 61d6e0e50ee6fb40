"""Threads of BLAS: where matrices are small they mostly wait for each other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache, wraps
from threading import Lock
from typing import Any, TypeVar, cast

_Work = TypeVar("_Work", bound=Callable[..., Any])
_TURN = Lock()
_ENTERED: list[Any] = []  # the limit, once for each thread that is within
_LARGE = 200  # states, up to which one thread is as fast as several


@contextmanager
def single() -> Iterator[None]:
    """A context with one thread of BLAS; what was before is back when the last thread has left."""
    with _TURN:
        # SciPy brings a BLAS of its own when it is needed; others are not called here.
        pools = _pools("scipy.linalg" in sys.modules)
        limit = _ENTERED[0] if _ENTERED else pools.limit(limits=1, user_api="blas")
        _ENTERED.append(limit)
    try:
        yield
    finally:
        with _TURN:
            _ENTERED.pop()
            if not _ENTERED:
                limit.restore_original_limits()


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
