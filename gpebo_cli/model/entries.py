"""The matrices of a model by their entries that are not zero: what large plants are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from gpebo_cli.model.descriptor import (
    MATRIX_NAMES,
    Array,
    BoolArray,
    Coefficients,
    CoefficientSource,
    IntArray,
)

Places = tuple[IntArray, ...]  # rows, and columns of a matrix, (e,) each


class Entries(NamedTuple):
    """Taylor coefficients at N times of every entry that is not always zero."""

    values: Coefficients  # (orders, N or 1, v) each; 1 for a matrix that is constant
    places: Mapping[str, Places]  # of the entries, by the names of the matrices
    shared: Mapping[str, IntArray] = MappingProxyType({})  # (e,) which value, if not its own
    # Of a matrix of which ``values`` has order 0 only: where each one is, or −1, in (orders, N, w).
    moved: Mapping[str, tuple[IntArray, Array]] = MappingProxyType({})

    def jets(self, name: str, some: IntArray) -> Array:
        """Some of the values (w,) of a matrix (orders, N or 1, w), to the order that all have."""
        found: Array = getattr(self.values, name)
        if name in self.moved and (self.moved[name][0][some] >= 0).all():
            some, found = self.moved[name][0][some], self.moved[name][1]
        return found[:, :, some]

    def which(self, name: str) -> IntArray:
        """Which of the values each entry of a matrix has, (e,)."""
        return self.shared.get(name, np.arange(len(self.places[name][0])))

    def of(self, name: str) -> dict[tuple[int, ...], Array]:
        """Coefficients (orders, N or 1) by the place of an entry."""
        values = getattr(self.values, name).transpose(2, 0, 1)[self.which(name)]
        places = [place.tolist() for place in self.places[name]]
        return dict(zip(zip(*places, strict=True), values, strict=True))


def is_sparse(value: object) -> TypeGuard[Any]:
    """Whether a matrix is one of SciPy's sparse ones, which nobody has to import to know that."""
    return hasattr(value, "tocoo")


def entries(
    source: CoefficientSource, t: Array, order: int, inside: Array | None = None,
    moved: Mapping[str, BoolArray] = MappingProxyType({}),
) -> Entries:
    """Those of a source at the times t (N,), see ``CoefficientSource.taylor``.

    A source that has its entries apart gives them by a method of this name. Of matrices that are
    in ``moved`` (v,) derivatives of other values than those are not needed.
    """
    own: Callable[..., Entries] | None = getattr(source, "entries", None)
    if own is not None:
        return own(t, order, inside, moved)
    return entries_of(source.taylor(t, order, inside), source.constant)


def entries_of(c: Coefficients, constant: frozenset[str]) -> Entries:
    """Those of full matrices, of which some are constant."""
    found = {
        name: not_zero(getattr(c, name)[:, :1] if name in constant else getattr(c, name))
        for name in MATRIX_NAMES
    }
    return Entries(
        Coefficients(**{name: values for name, (_, values) in found.items()}),
        {name: places for name, (places, _) in found.items()},
    )


def not_zero(whole: Array) -> tuple[Places, Array]:
    """Places of the entries of (orders, N, ...) that are not always zero, and these."""
    places = np.nonzero((whole != 0.0).any(axis=(0, 1)))
    flat = whole.reshape(*whole.shape[:2], -1)
    return places, flat[:, :, np.ravel_multi_index(places, whole.shape[2:])]
