"""A regression given as text, from one sample to the next: its operators on held signals.

Between samples every signal, and every argument of an operator, is what the hold makes of it. The
operators are exact for that. What is kept between two calls does not grow: one number for a filter
or an integral, and the samples of the last d seconds for a delay.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gpebo_cli.kernels.laws_numpy import mean_decay
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.linalg import affine_scan
from gpebo_cli.regression.samples import SampledRegression, delayed
from gpebo_cli.regression.text import Operator, TextRegression


@dataclass(frozen=True, eq=False)
class OperatorState:
    """The argument of an operator at the samples that still count, and what was made of it."""

    t: Array  # (N,) at least the last sample
    x: Array  # (N,)
    z: float = 0.0  # of a filter or an integral


@dataclass(frozen=True, eq=False)
class TextState:
    """Where the recursion stands, after a sample at ``t``."""

    t: float
    operators: tuple[OperatorState, ...]
    row: Array  # (rows, p + 1) [ψ | Y]
    scale: Array  # (p,) largest entry of each column of ψ so far
    growth: None = field(default=None, init=False)  # there is no Φ
    error_estimate: float = field(default=0.0, init=False)  # nothing is approximated but the hold


def advance(
    text: TextRegression, hold: str, state: TextState | None, t: Array, signals: Array, Y: Array
) -> tuple[TextState, SampledRegression, Array]:
    """Carry the operators over the samples at the times t (K,), ascending, after ``state.t``.

    The state is None before the first sample; signals are (K, m), and Y (K, rows), which is not
    looked at where the text has one.

    Returns:
        Where it stands, the regression at the samples, and the scale of ψ's columns (K, p) so far.

    Raises:
        ConfigError: an expression without a finite value; names it and the time.
    """
    count, m, p = len(t), signals.shape[1], text.system.q
    columns = np.zeros((1, count, m + len(text.operators)))
    columns[0, :, :m] = signals
    reached = []
    for k, operator in enumerate(text.operators):
        x = operator.argument.taylor(t, 0, t, columns)[0][:, 0]
        known = OperatorState(t[:1], x[:1]) if state is None else state.operators[k]
        columns[0, :, m + k], after = _operate(operator, hold, known, t, x)
        reached.append(after)
    psi = text.psi.taylor(t, 0, t, columns)[0].reshape(count, text.rows, p)
    right = Y if text.Y is None else text.Y.taylor(t, 0, t, columns)[0]
    rows = np.concatenate([psi, right.reshape(count, text.rows, 1)], axis=2)
    scale = np.maximum.accumulate(np.abs(psi).max(axis=1, initial=0.0), axis=0)
    if state is not None:
        scale = np.maximum(scale, state.scale)
    last, row = (t[0], rows[0]) if state is None else (state.t, state.row)
    regression = SampledRegression(
        t, np.diff(t, prepend=last), np.concatenate([row[None], rows]), hold, text.parametrisation
    )
    return TextState(float(t[-1]), tuple(reached), rows[-1], scale[-1]), regression, scale


def _operate(
    operator: Operator, hold: str, known: OperatorState, t: Array, x: Array
) -> tuple[Array, OperatorState]:
    """The operator's values (K,) at the samples, and its state after them."""
    if operator.name == "delay":
        past = known.t, known.x[:, None]
        out, (times, values) = delayed(past, t, x[:, None], operator.number, hold)
        return out[:, 0], OperatorState(times, values[:, 0])
    steps = np.diff(t, prepend=known.t[-1])
    before = np.append(known.x[-1], x[:-1])
    after = before if hold == "zoh" else x  # at both ends of the step to a sample
    if operator.name == "integral":
        z = known.z + np.cumsum(0.5 * steps * (before + after))
        return z, OperatorState(t[-1:], x[-1:], float(z[-1]))
    decay, mean = np.exp(-operator.number * steps), mean_decay(operator.number * steps)
    shift = (1.0 - mean) * after + (mean - decay) * before
    z = affine_scan(decay, shift, np.asarray(known.z))[1:]
    out = z if operator.name == "lp" else operator.number * (x - z)
    return out, OperatorState(t[-1:], x[-1:], float(z[-1]))
