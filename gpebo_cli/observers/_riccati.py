"""The Kalman–Bucy filter and its Riccati equation as one linear Hamiltonian system.

    ζ' = A ζ + b + Γν,   z = c ζ + Dν,   ν white of intensity S
    Q = Γ S Γᵀ,   N = Γ S Dᵀ,   V = D S Dᵀ > 0

The noises of process and measurement are correlated (N); with Ā = A − N V⁻¹c, Q̄ = Q − N V⁻¹Nᵀ,
b̄ = b + N V⁻¹z and W = cᵀV⁻¹c they no longer are, and the filter is

    P' = ĀP + PĀᵀ + Q̄ − P W P,     ζ̂' = Āζ̂ + b̄ + P cᵀV⁻¹(z − cζ̂).

The first equation is quadratic, the second one's gain P cᵀV⁻¹ stiff. Both follow from a linear
equation (Reid; Bittanti, Laub & Willems, The Riccati Equation, 1991):

    X₁' = −ĀᵀX₁ + W X₂,            x₁' = −Āᵀx₁ + W x₂ − cᵀV⁻¹z
    X₂' =  Q̄ X₁ + Ā X₂,            x₂' =  Q̄ x₁ + Ā x₂ + b̄
    P = X₂X₁⁻¹,   ζ̂ = x₂ − P x₁,   start (X₁, X₂ | x₁, x₂) = (I, P₀ | 0, ζ̂₀).

Half of its solutions grow as fast as the filter forgets, so X₁ and X₂ soon differ by rounding only
in the directions that do not grow. At every edge of the mesh the same P and ζ̂ therefore start
anew from (I, P | 0, ζ̂). The Hamiltonian's transition of every element does not depend on them;
what is chained are linear-fractional maps P₊ = (Ψ₂₁ + Ψ₂₂P)(Ψ₁₁ + Ψ₁₂P)⁻¹. A filter that forgets
within a small part of the mesh's elements is left to :mod:`gpebo_cli.observers._stiff_riccati`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpebo_cli.errors import SolverError
from gpebo_cli.kernels.arrays import joined
from gpebo_cli.model.descriptor import Array
from gpebo_cli.numerics.collocation import solve
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import SHARE, Kind, Mesh, Trajectory, signal_scale
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem, Monitor
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers._stiff_riccati import of_covariance

_INDEFINITE = 1e-6  # of P, relative: beyond, rounding has taken over
# Standard deviations below this share of the largest one, each in its unit (see _units), are
# resolved less: P as a matrix does not hold them, for its rounding is that of its largest entry.
_SMALLEST = 3e-5
_ADVICE = "lower observer.P0, or raise observer.regularisation or the noise"
_FALL = 1e12  # of P over the horizon: beyond, a double does not hold both ends
_UNSEEN = 1e-12  # of P, by which measurements change it over the horizon: as much as none
_LEFT = 3e-3  # of the rounding of P(0): it falls as well, if less
_STAGES = 8  # at least, at first: P falls fast from where it starts, whatever a mesh was made for
_MANY, _FEW = 500, 6  # elements, short by the samples that end them; the stages that they need,
_SLOW = 0.3  # if the logarithm of X₁ grows by no more in any of them
_ROOM = 8  # times as many elements may be needed with few stages
_SETTLED = 1e2  # the same at first, where P has settled: elements are to resolve it, too
# Elements for X₁, for each one of the mesh as it is, from which on P itself costs no more: this,
_STIFF = 4  # times 1 + (n/8)³, because P has n² entries.
_GROWTH = 1e3  # of X₁ within an element, at most: as many digits of P are lost


class StateSpace(NamedTuple):
    """The linear model and its noise at N times, or 1; ``g`` columns of signals share one P."""

    A: Array  # (N, n, n)
    b: Array  # (N, n, g)
    c: Array  # (N, r, n)
    z: Array  # (N, r, g)
    Q: Array  # (N, n, n)
    N: Array  # (N, n, r)
    V: Array  # (N, r, r)


def hamiltonian(model: StateSpace) -> tuple[Array, Array]:
    """Matrix (N, 2n, 2n) and inhomogeneity (N, 2n, n + g) of the linear equation above."""
    n, g, count = model.A.shape[-1], model.b.shape[-1], max(map(len, model))
    weighted = np.linalg.solve(model.V, joined(model.c, model.z, axis=2))
    from_state, from_signal = weighted[..., :n], weighted[..., n:]  # V⁻¹c, V⁻¹z
    A = model.A - model.N @ from_state
    Q = model.Q - model.N @ np.linalg.solve(model.V, transpose(model.N))
    W = transpose(model.c) @ from_state
    H = np.empty((count, 2 * n, 2 * n))
    H[:, :n, :n], H[:, :n, n:] = -transpose(A), 0.5 * (W + transpose(W))
    H[:, n:, :n], H[:, n:, n:] = 0.5 * (Q + transpose(Q)), A
    f = np.zeros((count, 2 * n, n + g))
    f[:, :n, n:] = -transpose(model.c) @ from_signal
    f[:, n:, n:] = model.b + model.N @ from_signal
    return H, f


def quotient(X: Array) -> tuple[Array, Array]:
    """P (…, n, n), symmetric, and ζ̂ (…, n, g) from the pair (…, 2n, n + g)."""
    n = X.shape[-2] // 2
    X1, X2 = X[..., :n, :n], X[..., n:, :n]
    P = transpose(np.asarray(np.linalg.solve(transpose(X1), transpose(X2)), dtype=np.float64))
    # P x₁ is not subtracted: where X₁ is large in some rows, only the pair's own quotient is exact.
    estimate = X[..., n:, n:] - X2 @ np.linalg.solve(X1, X[..., :n, n:])
    return 0.5 * (P + transpose(P)), estimate


def pair(P: Array, estimate: Array) -> Array:
    """(I, P | 0, ζ̂), shape (2n, n + g), from P (n, n) and ζ̂ (n, g)."""
    n, g = estimate.shape
    out = np.zeros((2 * n, n + g))  # at every edge: np.block takes four times as long
    out[:n, :n].flat[:: n + 1] = 1.0
    out[n:, :n], out[n:, n:] = P, estimate
    return out


def _renewed(X: Array) -> Array:
    """``pair(*quotient(X))`` of one pair, in less than half the time: there are many edges."""
    from scipy.linalg.lapack import dgetrf, dgetrs

    n = len(X) // 2
    factors, pivots, singular = dgetrf(X[:n, :n])
    if singular:
        raise np.linalg.LinAlgError
    P = dgetrs(factors, pivots, X[n:, :n].T, trans=1)[0]
    reached = dgetrs(factors, pivots, X[:n, n:])[0]
    return pair(0.5 * (P + P.T), X[n:, n:] - X[n:, :n] @ reached)


@dataclass(frozen=True, eq=False)
class Filtered:
    """The filter's covariance and estimates on the mesh that resolves them."""

    pair: Trajectory  # (2n, n + g), see the module, in the units that follow
    variance: float  # of P
    unit: Array  # (n,) of ζ
    error_estimate: float  # relative to each signal's own size
    extras: tuple[Trajectory, ...]  # of the coefficients
    tol: float = 0.0  # with which it was resolved
    sizes: tuple[Array, ...] = ()  # (c,) so far of ζ̂ in those units, and of what follows it

    @property
    def mesh(self) -> Mesh:
        """The mesh; the filter starts anew at each of its edges."""
        return self.pair.mesh

    def at(self, t: Array, inside: Array | None = None) -> tuple[Array, Array]:
        """P (M, n, n) and ζ̂ (M, n, g) at the times t (M,); at edges see ``Mesh.sampler``."""
        P, estimate = quotient(self.pair(t, inside))
        unit = self.unit[:, None]
        return self.variance * unit * P * self.unit, unit * estimate


Model = Callable[[Array, Array], tuple[StateSpace, tuple[Array, ...]]]


def filter_windows(
    model: Model, start: Array, P0: Array, windows: Sequence[Mesh], **settings: Any
) -> Iterator[Filtered]:
    """:func:`run_filter` on one window after the other, from ζ̂ = ``start`` (n, g) with P0 (n, n).

    What one of them holds does not have to be held for the next.
    """
    before: Filtered | None = None
    horizon = windows[-1].span[1] - windows[0].span[0]
    for window in windows:
        before = run_filter(model, start, P0, window, horizon=horizon, before=before, **settings)
        yield before


def run_filter(
    model: Model, start: Array, P0: Array, mesh: Mesh, *, tol: float, max_elements: int,
    monitor: Monitor | None = None, name: str = "Kalman-Bucy filter",
    floor: Array | float = 0.0, sizes: Array | float = 1.0, horizon: float | None = None,
    before: Filtered | None = None, advice: str = _ADVICE,
) -> Filtered:
    """Solve Riccati equation and filter on ``mesh``, refined until P and ζ̂ are resolved.

    From ζ̂ = ``start`` (n, g) with the covariance ``P0`` (n, n). The model at times (N,) comes with
    whatever ``monitor`` needs, which gives further signals to resolve from that and ζ̂. ``tol`` is
    relative to each signal's own size, to that of each element for P, which so is as accurate where
    it has become small. Below ``floor`` (n,) ζ̂ is not resolved for its own sake, and it is
    comparable in ``sizes`` (n,). What is ``before`` a window of some ``horizon`` goes on in it
    (SolverError: the tolerance cannot be reached, or P is not positive semidefinite).
    """
    if before is None:
        m, _ = model(mesh.points.ravel(), mesh.inside.ravel())
        horizon = horizon or float(mesh.edges[-1] - mesh.edges[0])
        unit, variance, fastest = _scaled(m, P0, horizon, sizes, name, advice)
        # The rounding of P(0) is what is left to resolve of a P that has fallen so far.
        tol = max(tol, _LEFT * float(np.finfo(float).eps) * fastest * horizon)
        first = pair(P0 / (variance * np.outer(unit, unit)), start / unit[:, None])
    else:
        unit, variance, tol, fastest = before.unit, before.variance, before.tol, 0.0
        first = pair(*quotient(before.pair.final))
    least = float((floor / unit).max(initial=0.0))

    def coefficients(t: Array, inside: Array) -> LinearEquation:
        m, extras = model(t, inside)
        column = unit[:, None]
        H, f = hamiltonian(StateSpace(
            A=m.A * unit / column, b=m.b / column, c=m.c * unit, z=m.z,
            Q=m.Q / (variance * column * unit), N=m.N / (variance * column), V=m.V / variance,
        ))
        return LinearEquation(None, H, f, extras)

    def followed(estimate: Array, extras: tuple[Array, ...]) -> list[Kind]:
        found: list[Kind] = [(estimate.reshape(*estimate.shape[:2], -1), least)]
        found += [] if monitor is None else list(monitor(unit[:, None] * estimate, extras))
        return found if before is None else [
            (signal, np.maximum(size, max(level, SHARE * float(size.max(initial=0.0)))))
            for (signal, level), size in zip(found, before.sizes, strict=True)
        ]

    def signals(values: Array, extras: tuple[Array, ...]) -> list[Kind]:
        lost, growth = _conditioning(values, tol)
        if lost < len(values):  # what follows is no number to be resolved
            values = values.copy()
            values[lost:] = values[lost, 0]
        P, estimate = quotient(values)
        d = _deviations(P)
        own = P / (d[:, None, :, None] * d[:, None, None, :])
        return [
            (growth, 0.0), (own.reshape(*own.shape[:2], -1), 0.0), *followed(estimate, extras)
        ]

    problem = LinearProblem(coefficients, first, signals, name, renewal=_renewed)
    try:
        H = coefficients(mesh.points[:, 1], mesh.inside[:, 1]).A
        first_mesh, stiff = _first_mesh(mesh, H, 0 if before else _STAGES, fastest, max_elements)
        solved, asked = None, (problem, first_mesh, tol, max_elements, followed)
        if stiff:  # a P that is singular, and grows fast, may be beyond Newton's method
            with suppress(SolverError, np.linalg.LinAlgError):
                solved = _with_error(of_covariance, *asked)
        found, extras, error_estimate = solved or _with_error(_of_pairs, *asked)
        mesh, (P, estimate) = found.mesh, quotient(found.values)
    except np.linalg.LinAlgError as error:
        raise SolverError(f"the Riccati equation of the {name} has no finite solution") from error
    except SolverError as error:
        raise SolverError(
            f"{error}; the covariance may fall too fast from where it starts: {advice}"
        ) from error
    size = np.maximum(np.abs(np.einsum("kjii->kji", P)).sum(axis=2), np.finfo(float).tiny)
    relative = np.linalg.eigvalsh(P)[..., 0] / size
    if relative.min() < -_INDEFINITE:
        t = mesh.points.flat[np.argmax(relative < -_INDEFINITE)]
        raise SolverError(
            f"the covariance of the {name} is not positive semidefinite near t = {t:.6g} "
            f"(eigenvalue {relative.min():.1e} of its trace); {advice}"
        )
    kinds = followed(estimate, extras)
    largest = [np.abs(signal).max(axis=(0, 1)) for signal, _ in kinds]
    return Filtered(
        found, variance, unit, error_estimate,
        tuple(Trajectory(mesh, extra) for extra in extras), tol,
        tuple(map(np.maximum, largest, before.sizes) if before else largest),
    )


def _first_mesh(
    mesh: Mesh, H: Array, least: int, fastest: float, max_elements: int
) -> tuple[Mesh, bool]:
    """A mesh that may resolve P, of ``least`` stages or more, from H (K or 1, 2n, 2n) by element.

    And whether that is one for P itself. At first P falls as fast as ``fastest``, in 1/s. How fast
    X₁ grows where P has settled is known beforehand, too: cuts by one round after the other would
    go through many meshes.
    """
    growth = mesh.steps * np.linalg.eigvals(H).real.max(axis=1)
    stages = max(mesh.rule.stages, least)
    if _MANY < mesh.size < max_elements / _ROOM and growth.max() < _SLOW:
        stages = min(stages, _FEW)
    parts = np.ceil(growth / np.log(_SETTLED)).clip(1.0)
    stiff = bool(parts.sum() > _STIFF * (1.0 + (H.shape[1] / 16) ** 3) * mesh.size)
    if not stiff and parts.sum() <= max_elements:
        mesh, _ = mesh.split(parts.astype(np.intp))
    # P falls as 1/t: what is not resolved first spoils all that follows. It may fall in less than
    # times far from zero are told apart.
    begin = mesh.edges[0]
    edges, halves = mesh.edges - begin, int(np.log2(max(fastest * mesh.steps[0], 1.0)))
    edges = np.insert(edges, 1, edges[1] * np.exp2(np.arange(-halves, 0)))
    return Mesh(edges, radau_rule(stages), mesh.origin + begin), stiff


def _scaled(
    m: StateSpace, P0: Array, horizon: float, sizes: Array | float, name: str, advice: str,
) -> tuple[Array, float, float]:
    """Units (n,) of ζ, a factor of all covariances, and how fast P falls at first, in 1/s."""
    deviation = np.sqrt(np.diag(P0))
    unit = _units(m.A, deviation, horizon, sizes)
    W = (transpose(m.c) @ np.linalg.solve(m.V, m.c)).max(axis=0)
    # A common factor of all covariances changes nothing. It is chosen so that W is of order 1 over
    # the horizon: entries of 1e7 would be taken as pivots, and mix the equations. A W that moves P
    # by nothing is rounding, and is not made larger.
    seen = float((W * np.outer(unit, unit)).max(initial=0.0)) * horizon
    variance = 1.0 / max(seen, _UNSEEN)
    fastest = float((W * np.outer(deviation, deviation)).max(initial=0.0))
    if fastest * horizon > _FALL:
        raise SolverError(
            f"the covariance of the {name} would fall to {1 / (fastest * horizon):.1e} of where it "
            f"starts, beyond the digits of a double; {advice}"
        )
    return unit, variance, fastest


def _conditioning(values: Array, tol: float) -> tuple[int, Array]:
    """The first element in which X₁ grows too much, and a signal (K, s + 1, 1) that tells where.

    It leaves out as much as cuts each element into as many parts as its growth asks for.
    """
    n, (_, points) = values.shape[2] // 2, values.shape[:2]
    grown = np.abs(values[..., :n, :n]).max(axis=(1, 2, 3), initial=1.0)
    parts = np.log(grown) / np.log(_GROWTH)
    left_out = np.minimum(tol * (1.5 * np.maximum(parts, 1.0)) ** (points - 1), 1.0)
    shown = np.where(parts > 1.0, left_out, 0.0)[:, None, None]
    first = int(np.argmax(parts > 1.0)) if shown.any() else len(values)
    return first, 1.0 + shown * np.resize([1.0, -1.0], (points, 1))


def _deviations(P: Array) -> Array:
    """Largest standard deviations (K, n) in each element, of P (K, s + 1, n, n)."""
    d = np.sqrt(np.maximum(np.einsum("kjii->kji", P).max(axis=1), 0.0))
    least = _SMALLEST * d.max(axis=1, initial=1e-100, keepdims=True)
    return np.asarray(np.maximum(d, least))


def _of_pairs(
    problem: LinearProblem, mesh: Mesh, tol: float, max_elements: int
) -> tuple[Trajectory, tuple[Array, ...]]:
    """The solution of the linear equation and the extras, as ``of_covariance`` gives them."""
    found = solve(problem, mesh, tol=tol, max_elements=max_elements)
    return found.trajectory, found.extras


def _with_error(
    way: Callable[..., tuple[Trajectory, tuple[Array, ...]]], problem: LinearProblem, mesh: Mesh,
    tol: float, max_elements: int, followed: Callable[[Array, tuple[Array, ...]], list[Kind]],
) -> tuple[Trajectory, tuple[Array, ...], float]:
    """What one ``way`` finds, and its error, as seen by solving with halves of the elements.

    Of P beside deviations at each time, and of what follows ζ̂ beside its own size.
    """
    found, extras = way(problem, mesh, tol, max_elements)
    halves, _ = found.mesh.split(np.full(found.mesh.size, 2, dtype=np.intp))
    finer, there = way(replace(problem, monitor=None, told=True), halves, np.inf, halves.size)
    P, estimate = quotient(finer.values)
    other, same = quotient(halves.along(found).values)
    d = _deviations(P)
    error = float((np.abs(other - P) / (d[:, None, :, None] * d[:, None, None, :])).max())
    kinds = zip(followed(estimate, there), followed(same, there), strict=True)
    for (one, floor), (two, _) in kinds:
        size = np.maximum(signal_scale(one), floor)
        error = max(error, float((np.abs(one - two) / size).max(initial=0.0)))
    return found, extras, error


def _units(A: Array, deviation: Array, horizon: float, sizes: Array | float) -> Array:
    """Units (n,) of ζ: deviations at the start, or what those of constants soon make of them.

    Powers of two: nothing is rounded. What is constant, a row of zeros in A, moves the others for
    as long as these remember. By ``_GROWTH`` X₁ may be out of balance.
    """
    largest = sizes * ((deviation / sizes).max(initial=0.0) or 1.0)
    rounding = np.sqrt(np.finfo(float).eps) * largest  # of a variance beside the largest one
    unit = np.where(deviation > rounding, deviation, largest)
    pushes = np.abs(A).max(axis=0, initial=0.0) * unit / unit[:, None]
    moving = pushes.any(axis=1)
    rate = max(float(pushes[np.ix_(moving, moving)].max(initial=0.0)), 1.0 / horizon)
    pushed = np.ones(len(unit))
    for _ in unit:  # through as many others as there are
        pushed = np.maximum(pushed, (pushes * pushed).max(axis=1, initial=0.0) / rate)
    return np.asarray(np.exp2(np.rint(np.log2(unit * np.maximum(pushed / _GROWTH, 1.0)))))
