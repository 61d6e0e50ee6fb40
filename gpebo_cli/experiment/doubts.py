"""Which final estimates are not what the data say: not moved, not done, or spoilt by rounding."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import compress

import numpy as np

from gpebo_cli.evidence.knowledge import Knowledge
from gpebo_cli.findings import Requirement
from gpebo_cli.model.descriptor import Array, BoolArray, IntArray
from gpebo_cli.regression.linear import least_squares

_ASTRAY = 0.02  # of a quantity's size: estimates that differ by more are different
_EXACT = 1e-3  # of it: so do those of a law that is done, if less than
_DONE = 30.0  # times this is what it has left of the errors it began with
_BEYOND = 4.0  # deviations: noise does not bring estimates farther away
UNFINISHED = (  # why there are no deviations
    "what the estimator needs is not met, and estimates are farther from least squares over the "
    "same data than noise brings them; use estimator=least_squares with a small f0, or other gains"
)
WORSE = 3.0  # times the residual of least squares: more than that is not the noise of the data
_ZERO = 1e-9  # of its terms: a state that is less is zero, and as large as they are
_TINY = float(np.finfo(float).tiny)
_STILL = 1e-9  # of what would explain Y alone: one that moved by less was not moved by data


def still(parameters: Array, requirement: Requirement, natural: Array) -> BoolArray:
    """Which cases (G,) of η̂ (G, M, p) are where they began, for want of what is required.

    Noise did not move them either, and a deviation of zero would claim that nothing is uncertain.
    """
    if requirement.holds or not len(natural):
        return np.zeros(len(parameters), dtype=bool)
    return np.asarray(~(np.ptp(parameters, axis=1) > _STILL * natural).any(axis=1))


def finished(
    std: Array, root: Array, final: Array, requirement: Requirement, columns: IntArray
) -> tuple[Array | None, str]:
    """Deviations (G, M, p + n) of what noise alone may have brought where it is, and why not all.

    Those of the others are NaN: what they require is not met, and their ``final`` estimates (G, p)
    are far from least squares over the same data. None, if there are no others. The root and the
    columns are as of :func:`of_estimates`.
    """
    if requirement.holds or not len(columns):
        return std, ""
    eta = _least_squares_about(root, columns)
    far = (np.abs(final - eta) > _BEYOND * std[:, -1, : len(eta)]).any(axis=1)
    if not far.any():
        return std, ""
    std[far] = np.nan
    return None if far.all() else std, UNFINISHED


def moved_by_noise(
    std: Array, parameters: Array, roots: Array, met: BoolArray | None
) -> BoolArray:
    """At which of K samples (G, K) noise alone may have brought η̂ (G, K, p) where it is.

    It has moved η̂, and what is required is ``met`` (K,) by then (None: nobody knows), or η̂ is as
    near to least squares of the data so far, by their roots (K, p + 1, p + 1), as deviations (G, K,
    p + n) bring it.
    """
    own = std[..., : parameters.shape[2]]
    out: BoolArray = np.asarray(own.any(axis=2))
    if met is not None and not met.all():
        away = np.abs(parameters[:, ~met] - least_squares(roots[~met]))
        out[:, ~met] &= (away <= _BEYOND * own[:, ~met]).all(axis=2)
    return out


def _least_squares_about(root: Array, columns: IntArray) -> Array:
    """η (p,) of least squares about some of the parameters, the others being zero."""
    eta = np.zeros(root.shape[1] - 1)
    eta[columns] = least_squares(root[:, [*columns, -1]])
    return eta


def of_estimates(
    root: Array, final: Array, states: Callable[[Array], Array], last: Callable[[Array], Array],
    quantities: Sequence[str], sizes: Array, known: Knowledge, seen: BoolArray, columns: IntArray,
    requirement: Requirement,
) -> tuple[Mapping[str, float], tuple[str, ...]]:
    """How far final estimates may be off, relative to each one's size, and warnings of that.

    Off least squares over the same data, because of gains or rounding, and by what the data leave
    open. There is no warning of the first if the ``requirement`` is not met, or if the estimates
    explain the data nearly as well, because noise makes such a difference too. ``root`` R (k, p +
    1) has |R [−η; 1]|² = ∫‖Y − ψη‖², ``final`` are η̂ of all cases at the end (G, p), ``states``
    makes x̂ (g, M, n) of parameters (g, p), at times of which the last is the end, and ``last`` at
    the end alone. Of ``quantities``, names of parameters and states (p + n,), a size that is NaN
    counts as least squares' own one. ``seen`` (n,) states are determined. Only ``columns`` (k,) are
    estimated.
    """
    final, p = final[np.isfinite(final).all(axis=1)], final.shape[1]
    if not len(final) or not len(columns):
        return {}, ()
    eta = _least_squares_about(root, columns)
    least = np.linalg.norm(root @ np.append(-eta, 1.0))
    more = np.linalg.norm((final - eta) @ root[:, :-1].T, axis=1)
    best = int(np.argmin(more))
    both = np.stack([final[best], eta])
    x, rows = states(both), last(np.eye(p + 1, p))[:, -1]
    one, other = np.hstack([both, x[:, -1]])
    own = np.append(np.abs(eta), np.abs(x[1]).max(axis=0, initial=0.0))
    own = np.maximum(np.fmax(sizes, own), _TINY)
    gain = np.concatenate([np.eye(p), (rows[:-1] - rows[-1]).T])
    terms = np.abs(gain) @ np.abs(eta) + np.append(np.zeros(p), np.abs(rows[-1]))
    own = np.where(own > _ZERO * terms, own, terms)
    away, open_ = np.abs(one - other), known.doubt(root[:, :-1].T @ root[:, -1], gain)[0]
    determined = np.append(known.parameters[-1], seen)
    found = dict(zip(quantities, ((away + open_) / own).tolist(), strict=True))
    # A law that is known to be done is not as far from least squares as one that may not be.
    rest = np.exp(-requirement.evidence.get("gamma_times_integral", 0.0))
    limit = min(_ASTRAY, max(_EXACT, _DONE * rest))
    far = determined & (away > limit * own)
    far &= requirement.holds and bool(more[best] > WORSE * least)
    told = {name: found[name] for name in compress(quantities, determined)}
    if not far.any():
        return told, ()
    size = np.linalg.norm(root[:, -1])
    text = (
        f"estimates.csv: at the end {', '.join(compress(quantities, far))} are up to "
        f"{(away / own)[far].max():.2g} of their size away from least squares over the same data, "
        f"which leaves {least / size:.1g} of Y and they {np.hypot(least, more[best]) / size:.1g}: "
        "the estimator has lost digits or is not done (use estimator=least_squares with a small "
        "f0, or other gains), or it forgets, as it has to where an unknown changes"
    )
    return told, (text,)
