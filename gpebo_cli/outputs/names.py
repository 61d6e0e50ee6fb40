"""Names that the shell completes: of the figures, without importing what draws them."""

FIGURE_NAMES = (
    "signals",
    "regressor",
    "states",
    "estimates",
    "estimates_a",
    "estimates_b",
    "parameter_error",
    "state_error",
    "state_error_a",
    "state_error_b",
    "gram",
    "delta",
    "gains",
    "error_norms",
)
"""Every figure of a run, a function of that name in ``outputs/figures.py``, in this order."""

FORMATS = ("png", "pdf", "svg")
"""Of the files of figures."""
