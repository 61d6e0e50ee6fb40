"""What the equations as given still tell where Assumption 1 fails: the states it does not touch.

With 𝒜 V2 of a rank below n_b, v = V2 ζ is known up to V2 N s, where N spans the kernel of 𝒜 V2 and
s(t) is any function. It drives w through Λ V2 N. What it drives, a subspace S of range P, is given
up as an unknown: it counts as algebraic, V2 becomes [V2, S], and rows of 𝒜 that see it may give it
back. This is repeated until nothing more is driven; the w left obey an equation of their own, and
all that is lost of x lies in the range of [V2, S] N (theory 5).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gpebo_cli.kernels.arrays import joined
from gpebo_cli.model.descriptor import Array, BoolArray
from gpebo_cli.numerics.linalg import exact_product, transpose
from gpebo_cli.observers.reduced.split import (
    TINY,
    Frame,
    Remaining,
    constant_split,
    initial_basis,
    within_frame,
)
from gpebo_cli.reduction.form import EquationForm

_DRIVEN = 1e-9  # of the largest entry of Λ V2 N: less is rounding
_DIP = 1e-3  # of the largest of a singular value over time: where less, it may be zero in between


def untouched(
    form: EquationForm, t: Array, inside: Array, signals: Array | None, rank_tol: float
) -> tuple[Frame, BoolArray] | None:
    """The frame of E without what is given up, and which states are lost (n,).

    At the times t (N,), for matrices that follow [u; y] (N, m + r) there. None where no state is
    left, where the kernel of E turns, or where a rank changes or may.
    """
    model, states = form.equations(t, inside, signals), form.system.states
    units, plain = form.units, np.ones(len(states))
    own = units.states / units.equations[:, None]
    E, A = model.E * own, model.A * own
    split = constant_split(E, states, plain, rank_tol)
    if split is None or split.frame is None:
        return None
    frame = split.frame
    C = model.C * units.states / units.outputs[:, None]
    algebraic = joined(exact_product(split.equations, A), C, axis=1)
    size = np.maximum(np.linalg.norm(algebraic, axis=(1, 2)), TINY)
    given_up = np.zeros((len(states), 0))
    while given_up.shape[1] < split.rank:
        rank = split.rank - given_up.shape[1]
        left_over = frame.projector - given_up @ given_up.T
        kept, dual, _ = initial_basis(left_over, rank, states, plain)
        kernel = np.hstack([frame.kernel, given_up])
        _, sigma, Vt = np.linalg.svd(algebraic @ kernel)
        ranks = (sigma > rank_tol * size[:, None]).sum(axis=1)
        if (ranks != ranks[0]).any():
            return None
        weakest = sigma[:, : ranks[0]].min(axis=1, initial=np.inf)
        if weakest.min() < _DIP * weakest.max():
            return None
        left = replace(frame, remaining=Remaining(kept, dual, given_up, int(ranks[0])))
        free = kernel @ transpose(Vt[:, ranks[0] :])
        drive = exact_product(within_frame(left, split.pinv).pinv, A)
        into = exact_product(drive, free)
        U, sizes, _ = np.linalg.svd(np.moveaxis(into, 1, 0).reshape(len(kept.T), -1), False)
        driven = sizes > _DRIVEN * max(float(np.linalg.norm(drive @ kernel)), TINY)
        if not driven.any():
            lost = (np.linalg.norm(free, axis=2) > _DRIVEN).any(axis=0)
            if lost.all() or not lost.any():
                return None
            return _as_written(left, left_over, states, units.states), lost
        given_up = np.hstack([given_up, kept @ U[:, driven]])
    return None


def _as_written(frame: Frame, left_over: Array, states: tuple[str, ...], units: Array) -> Frame:
    """A frame of states in comparable units, with the projector on what is left, in their own."""
    remaining = frame.remaining
    assert remaining is not None  # noqa: S101  that is what it was made for
    domain, dual, _ = initial_basis(frame.projector, frame.domain.shape[1], states, units)
    kept, of_kept, _ = initial_basis(left_over, remaining.kept.shape[1], states, units)
    own = units[:, None]
    return replace(
        frame, domain=domain, dual=dual, kernel=own * frame.kernel,
        remaining=replace(
            remaining, kept=kept, dual=of_kept, given_up=own * remaining.given_up
        ),
    )
