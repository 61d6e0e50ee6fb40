"""Names that the shell completes: of figures and metrics, without importing what makes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

FIGURE_NAMES = (
    "signals", "regressor", "states", "estimates", "estimates_a", "estimates_b", "parameters",
    "fit", "whiteness", "parameter_error", "state_error", "state_error_a", "state_error_b", "gram",
    "delta", "gains", "error_norms",
)
"""Every figure of a run, a function of that name in ``results/figures.py``, in this order."""

METRICS = {
    "seconds_to_1pct_parameters": "parameters to 1 %",
    "seconds_to_1pct_states": "states to 1 %",
    "final_error_parameters": "final error, parameters",
    "final_error_states": "final error, states",
    "rms_error_states": "RMS error, states",
}
"""What is measured of every case, in words: :class:`gpebo_cli.evidence.metrics.Metrics`."""

SETTLED = "seconds_to_settled"
"""From when on all is within ±2σ of the end; cases of runs with noise have it."""

WORDS = {SETTLED: "within ±2σ of the end", **METRICS}
"""Of both."""


def shown_metrics(cases: Iterable[Mapping[str, object]]) -> dict[str, str]:
    """Those that say something of the cases, by their columns of ``cases.csv``, in words.

    Under noise it is chance when an error falls below 1 %, and :data:`SETTLED` stands for that.
    """
    noisy = {SETTLED in case for case in cases}
    without = [*([] if True in noisy else [SETTLED]), *list(METRICS)[: 2 * (noisy == {True})]]
    return {name: words for name, words in WORDS.items() if name not in without}


def ranking(cases: Iterable[Mapping[str, object]]) -> str:
    """The metric by which the best case is the first one."""
    return list(METRICS)[-1 if SETTLED in shown_metrics(cases) else 0]


def known_by(metric: str) -> str:
    """The metric that is not a number where this one is not known; a time may be: never."""
    return metric.replace("seconds_to_1pct", "final_error")


FORMATS = ("png", "pdf", "svg")
"""Formats of the files of figures."""
