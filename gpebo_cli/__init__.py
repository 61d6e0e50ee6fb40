"""gpebo: adaptive state observers for linear time-varying descriptor systems."""

__version__ = "0.1.0"
