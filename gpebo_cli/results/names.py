"""Names that the shell completes: of figures and metrics, without importing what makes them."""

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

FORMATS = ("png", "pdf", "svg")
"""Formats of the files of figures."""
