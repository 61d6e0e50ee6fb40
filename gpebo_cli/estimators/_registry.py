"""Estimators by name."""

from __future__ import annotations

from collections.abc import Mapping

from gpebo_cli.estimators._several import spread
from gpebo_cli.registry import Registry
from gpebo_cli.regression.estimator import Estimator

_ESTIMATORS: Registry[Estimator] = Registry("estimator")
GROUP = _ESTIMATORS.group
names, settings_of, able = _ESTIMATORS.names, _ESTIMATORS.settings_of, _ESTIMATORS.able


def build(settings: Mapping[str, object]) -> Estimator:
    """The estimator that ``settings["name"]`` asks for, with the remaining keys as its settings.

    Raises:
        ConfigError: unknown name or key, with the nearest known one.
    """
    built = spread(_ESTIMATORS.find(settings), settings, _ESTIMATORS.build)
    _ = built.cases  # gains are read here, so that a wrong one is found before anything is run
    return built
