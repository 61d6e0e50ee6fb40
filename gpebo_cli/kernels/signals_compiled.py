"""As :mod:`signals_numpy`, in C."""

from __future__ import annotations

from gpebo_cli.kernels import _compiled

tails = _compiled.tails
largest = _compiled.largest
interpolation = _compiled.interpolation
sample = _compiled.sample
