"""Elements of stiff systems with few entries, against one dense system for each element."""

import numpy as np
import pytest

from gpebo_cli.numerics.elimination import StiffError, by_elimination
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.series import sparse

S, D = 5, 12
RULE = radau_rule(S)
H = np.array([0.3, 0.3, 0.01, 0.7])


def system(rng, count, varying=True):
    """A ring with rates over six decades, at all points of so many elements."""
    A = np.zeros((count * (S + 1) if varying else 1, D, D))
    for i in range(D):
        A[:, i, i] = -(10.0 ** rng.uniform(0, 6)) * rng.uniform(1, 2, len(A))
        A[:, i, (i + 1) % D], A[:, i, i - 1] = rng.normal(size=(2, len(A)))
    return A, sparse(A)


def solved(matrix, f, kicks, start, h=H):
    return by_elimination(Mesh(np.append(0.0, np.cumsum(h)), RULE), matrix, f, kicks, start, 0.0)


def dense(A, f, kicks, start, h=H):
    """(D/h ⊗ I − A) X = D𝟙/h x_0 + f."""
    derivative, found, state = np.linalg.inv(RULE.integration), [], start
    for k, step in enumerate(h):
        points = np.arange(S) + k * (S + 1) + 1
        whole = np.kron(derivative / step, np.eye(D))
        right = (derivative.sum(axis=1) / step)[:, None, None] * state
        right[:, :, : f.shape[2]] += f[points]
        for i, point in enumerate(points):
            whole[i * D : (i + 1) * D, i * D : (i + 1) * D] -= A[point if len(A) > 1 else 0]
        X = np.linalg.solve(whole, right.reshape(S * D, -1)).reshape(S, D, -1)
        found.append(np.concatenate([state[None], X]))
        state = X[-1] if kicks is None else X[-1] + kicks[k]
    return np.array(found)


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("kicked", [False, True])
def test_the_solution_is_that_of_dense_systems(varying, kicked):
    rng = np.random.default_rng(1)
    h = np.tile(H, 5)
    A, matrix = system(rng, len(h), varying)
    f, start = rng.normal(size=(len(h) * (S + 1), D, 1)), rng.normal(size=(D, 2))
    kicks = rng.normal(size=(len(h), D, 2)) if kicked else None
    values, left = solved(matrix, f, kicks, start, h)
    exact = dense(A, f, kicks, start, h)[:, -1:] if kicked else dense(A, f, kicks, start, h)
    np.testing.assert_allclose(values, exact, rtol=1e-10, atol=1e-13)
    assert left.max() < 1e-14


def test_pivots_that_harm_are_seen():
    """A state that is pivoted first has a pivot of 1e-13: the equations are not satisfied."""
    largest = np.linalg.eigvals(np.linalg.inv(RULE.integration))
    real = float(largest[np.abs(largest.imag) < 1e-9].real[0])
    A = -np.eye(D)[None]
    A[0, 0, 0], A[0, 0, 1], A[0, 1, 0] = real / H[0] * (1.0 + 1e-13), 1.0, -1.0
    _, left = solved(sparse(A), np.zeros((1, D, 0)), None, np.ones((D, 1)), H[:1])
    assert left.max() > 1e-13


def test_what_elimination_fills_is_refused():
    A = np.random.default_rng(3).normal(size=(1, 60, 60))
    A[0][np.random.default_rng(4).uniform(size=(60, 60)) < 0.75] = 0.0
    with pytest.raises(StiffError):
        solved(sparse(A), np.zeros((1, 60, 0)), None, np.ones((60, 1)))
