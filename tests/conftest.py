"""Compare pictures in every run of the tests, where pytest-mpl is installed."""

from __future__ import annotations

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    # As if --mpl had been given; in addopts it would be an error without the plugin.
    if hasattr(config.option, "mpl"):
        config.option.mpl = True
