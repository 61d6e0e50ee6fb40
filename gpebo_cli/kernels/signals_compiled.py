"""As :mod:`signals_numpy`, in C."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled

tails = _compiled.tails
interpolation = _compiled.interpolation
largest = _compiled.largest
sample = _compiled.sample
