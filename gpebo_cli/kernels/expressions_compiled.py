"""As :mod:`expressions_numpy`, in C."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled

RUNS_PROGRAMS = True
jets = _compiled.jets
intervals = _compiled.intervals
