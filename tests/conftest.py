"""Pictures are compared in every run of the tests; how slow the machine is says nothing of us."""

from __future__ import annotations

import os

import hypothesis
import pytest

# The workers that start after this have one thread of BLAS each: two on a core wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The same examples everywhere, so that a change is what makes a test fail. New ones are looked for
# with `pytest --hypothesis-profile=explore`.
_ANY_MACHINE = {"deadline": None, "suppress_health_check": [hypothesis.HealthCheck.too_slow]}
hypothesis.settings.register_profile("any machine", derandomize=True, **_ANY_MACHINE)
hypothesis.settings.register_profile("explore", **_ANY_MACHINE)
hypothesis.settings.load_profile("any machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--kills", type=int, default=5, help="how often tests/faults kills a command")


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    # As if --mpl had been given; in addopts it would be an error without the plugin.
    if hasattr(config.option, "mpl"):
        config.option.mpl = True
