"""Elements of stiff systems with few entries, against one dense system for each element."""

import numpy as np
import pytest

from gpebo_cli.kernels import elements_numpy
from gpebo_cli.numerics import series, taylor
from gpebo_cli.numerics.elimination import StiffError, _residual, by_elimination
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.taylor import by_entries

S, D = 5, 12
RULE = radau_rule(S)
H = np.array([0.3, 0.3, 0.01, 0.7])


def system(rng, count, varying=True):
    """A ring with rates over six decades, at all points of so many elements."""
    A = np.zeros((count * (S + 1) if varying else 1, D, D))
    for i in range(D):
        A[:, i, i] = -(10.0 ** rng.uniform(0, 6)) * rng.uniform(1, 2, len(A))
        A[:, i, (i + 1) % D], A[:, i, i - 1] = rng.normal(size=(2, len(A)))
    return A, by_entries(A)


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
    _, left = solved(by_entries(A), np.zeros((1, D, 0)), None, np.ones((D, 1)), H[:1])
    assert left.max() > 1e-13

    def equation(mesh):
        return by_entries(A), np.zeros((1, D, 1)), ()

    problem, mesh = LinearProblem(None, np.ones((D, 1))), Mesh(np.array([0.0, H[0]]), RULE)
    limits = {"units": np.ones(D), "tol": 1e-9, "max_elements": 99, "stiff": True}
    assert series.solve(problem, equation, mesh, **limits | {"tol": 1e-13}) is None
    A[0, 0, 0] *= 1.1
    assert series.solve(problem, equation, mesh, **limits).error_estimate < 1e-6


def test_series_rest_where_nothing_moves_and_are_cut_elsewhere():
    def equation(mesh):
        moves = np.where(mesh.inside.ravel() < 1.0, 0.0, -6.0)
        return by_entries(moves[:, None, None] * np.eye(D)), np.zeros((1, D, 1)), ()

    problem, mesh = LinearProblem(None, np.ones((D, 1))), Mesh(np.arange(3.0), RULE)
    found = series.solve(problem, equation, mesh, units=np.ones(D), tol=1e-6, max_elements=99)
    x, edges = found.trajectory.values[..., 0, 0], found.trajectory.mesh.edges
    np.testing.assert_array_equal(edges[:2], [0.0, 1.0])
    np.testing.assert_allclose(x[:, -1], np.exp(-6.0 * (edges[1:] - 1.0)), atol=1e-4)


def test_what_elimination_fills_is_refused():
    A = np.random.default_rng(3).normal(size=(1, 60, 60))
    A[0][np.random.default_rng(4).uniform(size=(60, 60)) < 0.75] = 0.0
    with pytest.raises(StiffError):
        solved(by_entries(A), np.zeros((1, 60, 0)), None, np.ones((60, 1)))


@pytest.mark.parametrize("varying", [False, True])
def test_what_is_left_of_equations_is_relative_to_their_terms(varying):
    """Of values that solve nothing, against dense matrices."""
    rng = np.random.default_rng(7)
    h, start = H[1:3], np.zeros((D, 2))
    A, matrix = system(rng, len(h), varying)
    f = rng.normal(size=(len(h) * (S + 1), D, 1))
    values = rng.normal(size=(len(h), S + 1, D, 2))
    derivative = np.linalg.inv(RULE.integration)
    found = _residual(derivative, h, matrix.rows, matrix.columns, matrix.entries, f, values)
    for k, step in enumerate(h):
        points = slice(k * (S + 1), (k + 1) * (S + 1)) if varying else slice(None)
        here, known = values[k], np.zeros((S + 1, D, 2))
        known[:, :, :1] = f[k * (S + 1) : (k + 1) * (S + 1)]
        slopes = np.tensordot(derivative, here[1:] - start - here[0], axes=1) / step
        left = np.abs(slopes - (A[points] @ here + known)[1:]).max(axis=0)
        largest = np.abs(here).max(axis=0)
        size = np.abs(derivative).sum(axis=1).max() / step * largest + np.abs(known).max(axis=0)
        size += np.abs(A[points]).max(axis=0) @ largest
        assert found[k] == pytest.approx((left / size).max(), rel=1e-12)


@pytest.mark.parametrize("times", [1, 4])
def test_matrices_by_their_entries_are_what_full_ones_are(times):
    """Products by few entries and by all of them, bounds of rates in any units, largest entries."""
    rng = np.random.default_rng(times)
    A = rng.normal(size=(times, 9, 9)) * (rng.random((9, 9)) < 0.2)
    A[:, 0], A[:, :, 0], A[:, range(1, 9), range(1, 9)] = 0.0, 0.0, -2.0
    matrix, units = by_entries(A), 10.0 ** rng.integers(-3, 4, 9)
    np.testing.assert_array_equal(matrix.full(), A)
    for columns in (1, 30):
        x = rng.normal(size=(4, 9, columns))
        np.testing.assert_allclose(matrix.product(matrix.entries, x), A @ x, atol=1e-13)
    sizes = matrix.sizes(2 if times == 4 else 1)
    largest = np.abs(A).reshape(len(sizes), -1, 9, 9).max(axis=1)
    np.testing.assert_array_equal(matrix._replace(entries=sizes).full(), largest)
    turned = by_entries(A * units / units[:, None])
    rates = np.linalg.eigvals(A)
    for one, own in ((matrix, np.ones(9)), (turned, 1.0 / units)):
        norms, plain = one.norms(one.sizes(times), own), np.abs(A)
        assert (np.abs(rates).max(axis=1) <= norms * (1.0 + 1e-12)).all()
        plain = np.minimum(plain.sum(axis=1).max(axis=1), plain.sum(axis=2).max(axis=1))
        np.testing.assert_allclose(norms, plain, rtol=1e-12)
        assert one.growth(own, 0.0) == pytest.approx(max(rates.real.max(), 0.0), rel=1e-6)
        assert one.growth(own, 1e9) >= rates.real.max()
        assert one.growth(own, 1e9) == pytest.approx(matrix.growth(np.ones(9), 1e9), rel=1e-12)


def test_growth_of_many_states_is_looked_at_once_at_least(monkeypatch):
    monkeypatch.setattr("gpebo_cli.numerics.taylor._LOOKED_AT", 1)  # times by states³
    A = np.diag([0.5, -1.0, -2.0]) + np.diag([3.0, 0.0], 1)
    assert by_entries(A[None]).growth(np.ones(3), 0.0) == pytest.approx(0.5)


def test_full_matrices_are_not_solved_by_series_of_their_entries():
    def full(t, inside):
        return LinearEquation(None, -np.ones((len(t), D, D)), np.zeros((1, D, 1)))

    problem = LinearProblem(full, np.ones((D, 1)))
    mesh = Mesh(np.linspace(0.0, 1.0, 9), RULE)
    assert series.solve_dense(problem, mesh, tol=1e-6, max_elements=99) is None
    assert len(by_entries(np.eye(4)[None]).columns) == 4


@pytest.mark.parametrize("length", [0.05, 0.2, 0.6])
@pytest.mark.parametrize("constant", [False, True])
def test_maps_of_elements_by_series_are_those_of_their_systems(length, constant):
    """In full and sparse systems, in one part and several, whatever the size of what drives."""
    rng, rule, n, K = np.random.default_rng(int(100 * length)), radau_rule(14), 14, 3
    mesh = Mesh(length * np.array([0.0, 0.1, 0.5, 1.0]), rule)
    t = mesh.points.ravel()[:, None, None]
    for full in (True, False):
        one, other = rng.normal(size=(2, n, n)) * (full or rng.random((n, n)) < 0.3)
        A = one + np.sin(3.0 * t) * other
        f = np.zeros((1 if constant else len(t), n, 4))
        f[:, :, 1] = 1e-9 * np.cos((0.0 if constant else t[:, 0]) + rng.normal(size=n))
        f[:, 3, 2] = 1e5 * (1.0 if constant else t[:, 0, 0])
        found = taylor.element_maps(rule, mesh.steps, A, f)
        expected = elements_numpy.element_maps(
            rule.differentiation, mesh.steps, None, A, f, None, None, np.arange(K), K
        )
        for own, system in zip(found, expected, strict=True):
            assert (np.abs(own - system) <= 1e-11 * np.abs(system).max(axis=(0, 1, 2))).all()
    assert taylor.element_maps(rule, mesh.steps, 1e5 * A, f) is None  # stiff
