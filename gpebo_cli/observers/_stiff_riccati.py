"""The Riccati equation of a filter that is fast beside what it follows, by collocation of P.

    P' = ĀP + PĀᵀ + Q̄ − P W P,     ζ̂' = (Ā − P W) ζ̂ + b̄ + P cᵀV⁻¹z

The linear equation of :mod:`gpebo_cli.observers._riccati` grows as fast as the filter forgets, so
its elements are as short as that, and lose digits. P and ζ̂ themselves are smooth, but for short
times after jumps. Their equation is quadratic in P: elements are solved one after the other, by
Newton's method from the P at their left end. Its steps are Lyapunov equations (Kleinman, On an
iterative technique for Riccati equation computations, 1968). In each element they are written in
the directions T of P there: X = T⁻¹PT⁻ᵀ, Tᵀ W T and so on, a symplectic change of coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpebo_cli.model.descriptor import Array, IntArray
from gpebo_cli.numerics.linalg import transpose
from gpebo_cli.numerics.mesh import Mesh, Trajectory, unresolved_kinds
from gpebo_cli.numerics.problem import LinearProblem, at_points
from gpebo_cli.numerics.radau import RadauRule
from gpebo_cli.numerics.refinement import refine

_POINTS = 1 << 14  # at which coefficients are evaluated at once
_STEPS = 20  # of Newton's method, at most
_CLOSE = 1e-7  # of deviations: after a change by less, the error is its square, or rounding
_NONE = 1e-9  # of the largest deviation: what is below is rounding of that one's
_UNSEEN = 1e-3  # of it: the unit of what has none, but may have a moment later

# Pairs (K, s + 1, 2n, n + g) with X₁ = I, extras of the coefficients, and the frames of the
# elements in front that are solved, and of the one that follows.
_Marched = tuple[Array, tuple[Array, ...], list["_Frame"]]


class _Frame(NamedTuple):
    """Directions T (n, n) in which P = T X Tᵀ, with ones in the diagonal X, or zeros.

    As entries of one matrix, small variances are lost in the rounding of the large ones.
    """

    basis: Array  # T
    left: Array  # X (n, n) at the left end of an element

    @classmethod
    def of(cls, P: Array, basis: Array) -> _Frame:
        """That of the covariance basis P basisᵀ."""
        size, own = np.linalg.eigh(P)
        directions = basis @ own
        lengths = np.linalg.norm(directions, axis=0)
        deviations = lengths * np.sqrt(np.maximum(size, 0.0))
        largest = deviations.max() or lengths.max()
        there = deviations > _NONE * largest
        T = directions * (np.where(there, deviations, _UNSEEN * largest) / lengths)
        return cls(T, np.diag(there.astype(float)))


def of_covariance(
    problem: LinearProblem, mesh: Mesh, tol: float, max_elements: int
) -> tuple[Trajectory, tuple[Array, ...]]:
    """Pairs (I, P | 0, ζ̂) that solve the linear equation at every edge anew, and its extras.

    On the ``mesh``, refined until the problem's monitor is resolved (SolverError: it cannot be).
    """

    def evaluate(mesh: Mesh, before: _Marched | None, kept: IntArray) -> tuple[_Marched, Array]:
        found = values, extras, frames = _march(problem, mesh, before, kept)
        tail, whole = np.zeros(mesh.size), len(frames) - 1
        if whole and problem.monitor is not None:
            kinds = problem.monitor(values[:whole], tuple(extra[:whole] for extra in extras))
            tail[:whole] = unresolved_kinds(kinds, mesh.rule)
        tail[whole:][:1] = 1.0  # what follows it is not known
        return found, tail

    mesh, (values, extras, _), _ = refine(
        evaluate, mesh, tol=tol, max_elements=max_elements, name=problem.name,
        advice=problem.advice,
    )
    return Trajectory(mesh, values), extras


def _march(
    problem: LinearProblem, mesh: Mesh, before: _Marched | None, kept: IntArray
) -> _Marched:
    """One element after the other; those in front that are ``kept`` are as they were ``before``."""
    (K, points), start, n = mesh.points.shape, problem.start, len(problem.start) // 2
    values = np.broadcast_to(start, (K, points, *start.shape)).copy()
    P, none, whole, pieces = start[n:, :n], np.zeros((n, n)), 0, []
    unit = np.sqrt(np.diag(P))
    unit = np.where(unit > 0.0, unit, unit.max() or 1.0)
    frames = [_Frame.of(P / np.outer(unit, unit), np.diag(unit))]
    if before is not None:
        whole = min(int(np.append(kept != np.arange(K), True).argmax()), len(before[2]) - 1)
        values[:whole], frames = before[0][:whole], before[2][: whole + 1]
        pieces.append([extra[:whole] for extra in before[1]])
    count = max(_POINTS // points, 1)
    for first in range(whole, K, count):  # the extras are wanted of all, solved or not
        t, inside = (x[first : first + count] for x in (mesh.points, mesh.inside))
        c = problem.coefficients(t.ravel(), inside.ravel())
        signals = [at_points(x, len(t), points - 1) for x in (c.A, c.f, *c.extras)]
        H, f, *extras = (np.broadcast_to(x, (*t.shape, *x.shape[2:])) for x in signals)
        pieces.append(extras)
        for k in range(first, first + len(t) if whole == first else first):
            left = values[k, 0] = values[k - 1, -1] if k else start
            (T, there), inward = frames[k], np.linalg.inv(frames[k].basis)
            outside, back = (np.block([[x, none], [none, y]]) for x, y in
                             ((T.T, inward), (inward.T, T)))
            found = _element(
                mesh.rule, float(mesh.steps[k]), outside @ H[k - first, 1:] @ back,
                outside @ f[k - first, 1:, :, n:], there, inward @ left[n:, n:],
            )
            if found is None:
                break
            X, estimate = found
            values[k, 1:, n:, :n], values[k, 1:, n:, n:] = T @ X @ T.T, T @ estimate
            frames.append(_Frame.of(X[-1], T))
            whole += 1
    return values, tuple(np.concatenate(each) for each in zip(*pieces, strict=True)), frames


def _element(
    rule: RadauRule, h: float, H: Array, f: Array, left: Array, estimate: Array
) -> tuple[Array, Array] | None:
    """P (s, n, n) and ζ̂ (s, n, g) at the nodes from those at the left end, if there are any.

    From the matrix H (s, 2n, 2n) and inhomogeneity f (s, 2n, g) of the linear equation.
    """
    n, s, D = len(left), rule.stages, rule.differentiation / h
    A, W, Q = H[:, n:, n:], H[:, :n, n:], H[:, n:, :n]
    i, j = np.triu_indices(n)  # of the entries that P, symmetric, has
    one, node = np.eye(n), np.arange(s)
    P, derivative = np.broadcast_to(left, (s, n, n)).copy(), np.eye(len(i))[:, None, :]
    for _ in range(_STEPS):
        half, F = (A - 0.5 * P @ W) @ P, A - P @ W
        residual = half + transpose(half) + Q - np.tensordot(D, P - left, axes=1)
        # F δ + δ Fᵀ at (i, j), of entries (a, b) of δ; (a, b) and (b, a) are one unknown.
        lyapunov = F[:, i, :, None] * one[j][:, None] + F[:, j, :, None] * one[i][:, None]
        lyapunov += transpose(lyapunov) * (1.0 - one)
        system = D[:, None, :, None] * derivative
        system[node, :, node] -= lyapunov[:, :, i, j]
        try:
            step = np.linalg.solve(system.reshape(s * len(i), -1), residual[:, i, j].ravel())
        except np.linalg.LinAlgError:
            return None
        change = np.empty_like(P)
        change[:, i, j] = change[:, j, i] = step.reshape(s, -1)
        P += change
        own = np.sqrt(np.maximum(np.einsum("sii->si", P), _NONE**2))
        if (np.abs(change) <= _CLOSE * own[:, :, None] * own[:, None]).all():
            break
    else:
        return None
    system = D[:, None, :, None] * one[:, None]
    system[node, :, node] -= A - P @ W
    right = f[:, n:] - P @ f[:, :n] + D.sum(axis=1)[:, None, None] * estimate
    found = np.linalg.solve(system.reshape(s * n, s * n), right.reshape(s * n, -1))
    return P, np.asarray(found.reshape(s, n, -1), dtype=np.float64)

