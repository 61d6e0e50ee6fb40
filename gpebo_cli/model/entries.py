"""The matrices of a model by their entries that are not zero: what large plants are made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import (
    MATRIX_NAMES,
    Array,
    Coefficients,
    CoefficientSource,
    IntArray,
)

Places = tuple[IntArray, ...]  # rows, and columns of a matrix, (e,) each


class Entries(NamedTuple):
    """Taylor coefficients at N times of every entry that is not always zero."""

    values: Coefficients  # (orders, N or 1, e) each; 1 for a matrix that is constant
    places: Mapping[str, Places]  # of the entries, by the names of the matrices

    def of(self, name: str) -> dict[tuple[int, ...], Array]:
        """Coefficients (orders, N or 1) by the place of an entry."""
        values = np.ascontiguousarray(np.moveaxis(getattr(self.values, name), 2, 0))
        places = [place.tolist() for place in self.places[name]]
        return dict(zip(zip(*places, strict=True), values, strict=True))


def entries(
    source: CoefficientSource, t: Array, order: int, inside: Array | None = None
) -> Entries:
    """Those of a source at the times t (N,), see ``CoefficientSource.taylor``.

    A source that has its entries apart says so itself.
    """
    own = getattr(source, "entries", None)
    if own is not None:
        found: Entries = own(t, order, inside)
        return found
    c = source.taylor(t, order, inside)
    places: dict[str, Places] = {}
    values: dict[str, Array] = {}
    for name in MATRIX_NAMES:
        whole = getattr(c, name)
        if name in source.constant:
            whole = whole[:, :1]
        places[name] = np.nonzero((whole != 0.0).any(axis=(0, 1)))
        values[name] = whole[:, :, *places[name]]
    return Entries(Coefficients(**values), places)
