"""DREM with the LTI extension of Lion: filtered copies of the regressor itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpebo_cli.estimators._mixed import FilteredEstimator
from gpebo_cli.estimators._recursive import KreisselmeierFilter
from gpebo_cli.estimators._scalar import lion, lion_rows, refuse_equal
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.mesh import Trajectory
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.samples import SampledRegression


@dataclass(frozen=True, kw_only=True)
class Lion(FilteredEstimator):
    """Filters λ_i/(p + λ_i) of ψ and Y, mixing, and η̂_i' = γ_i Δ (𝐘_i − Δ η̂_i).

    Filters of the same row of ψ need rates that differ.
    """

    def extend(self, regression: LinearRegression, rates: Array, start: Array | None) -> Trajectory:
        """Filtered rows of [ψ | Y], shape (p, p + c)."""
        return lion(regression, rates, start)

    def seen(self, regression: LinearRegression) -> Callable[[Array, Array], Array]:
        """Rows that are taken, (N, p, rows)."""
        taken = np.eye(regression.psi.values.shape[2])[lion_rows(regression)]
        return lambda t, _: np.broadcast_to(taken, (len(t), *taken.shape))

    def at_samples(self, rates: Array) -> KreisselmeierFilter:
        """The filters, with rates of shape (p,), where no row is known before its sample."""
        return _RowFilter(rates)

    def size(self, regression: LinearRegression) -> Array:
        """The sizes (p,) of columns of p rows of ψ, which no filter exceeds."""
        return np.asarray(np.sqrt(regression.p * super().size(regression)))


class _RowFilter(KreisselmeierFilter):
    """Row i takes row i mod r of the r rows whose ψ was not zero at all samples so far.

    Where one more is not, the filters start anew.
    """

    _awake: BoolArray | bool = False

    def seen(self, regression: SampledRegression) -> tuple[Array | float, Array, Array]:
        """0 where a step starts anew, else 1, and which rows are taken (K, p, rows), twice."""
        awake = np.asarray(regression.rows[..., :-1].any(axis=2))
        awake[0] = self._awake
        awake = np.logical_or.accumulate(awake)  # (K + 1, rows)
        self._awake, kept = awake[-1], (awake[1:] == awake[:-1]).all(axis=1)
        refuse_equal(np.arange(regression.p) % awake.shape[1], self._rates[:, 0])
        order = np.argsort(~awake[1:], axis=1, kind="stable")
        place = np.arange(regression.p) % np.maximum(awake[1:].sum(axis=1), 1)[:, None]
        rows = np.eye(order.shape[1])[np.take_along_axis(order, place, axis=1)]
        return kept[:, None, None] * 1.0, rows, rows


ESTIMATOR = Lion
