"""The kernels of observers, excitation and regression against the NumPy that they stand for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_paths import COMPILED, by_both, needs_kernels
from regressions import ETA, fading, regression, three

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.evidence import excitation
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers import observe
from gpebo_cli.observers.observation import AffineStateMap, largest_entry, log_norm
from gpebo_cli.observers.reduced import extension, matrices
from gpebo_cli.observers.reduced.regression import regression_signals
from gpebo_cli.regression import linear as regressions
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.settings import (
    ExcitationSettings,
    ObserverSettings,
    SolverSettings,
    TimeSettings,
)
from gpebo_cli.simulation.simulate import simulate

pytestmark = needs_kernels
seeds = st.integers(0, 2**32 - 1)
EPS = float(np.finfo(float).eps)
RANK_TOL = 1e-10


def close(one, other, size=1.0, rounding=1e3):
    """Equal to rounding in numbers of a size; NaN and infinite at the same places."""
    one, other = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    assert one.shape == other.shape
    np.testing.assert_allclose(one, other, rtol=rounding * EPS, atol=rounding * EPS * size)


@dataclass(frozen=True)
class Drawn:
    """A plant of drawn matrices: constant ones of one time, others of N, whatever t is."""

    matrices: dict[str, Array]
    dE: Array

    @property
    def constant(self) -> frozenset[str]:
        """Those of one time."""
        return frozenset(name for name, matrix in self.matrices.items() if len(matrix) == 1)

    def taylor(self, t: Array, order: int, inside: Array | None = None) -> Coefficients:
        """The matrices, and Ė."""
        out = {}
        for name, matrix in self.matrices.items():
            values = np.zeros((order + 1, len(t), *matrix.shape[1:]))
            values[0] = matrix
            if name == "E" and order:
                values[1] = self.dE
            out[name] = values
        return Coefficients(**out)

    def breakpoints(self, start: float, stop: float) -> Array:
        """None."""
        return np.zeros(0)


@st.composite
def plants(draw):
    """(plant, times): E in a frame of axes or a turned one, matrices constant or not."""
    rng = np.random.default_rng(draw(seeds))
    n, rank = draw(st.integers(1, 7)), draw(st.integers(0, 7))
    m, q, r = draw(st.integers(0, 2)), draw(st.integers(0, 2)), draw(st.integers(1, 3))
    rank = min(rank, n)
    count = draw(st.sampled_from([1, 3, 8, 19]))
    lasting = [1 if draw(st.booleans()) else count for _ in "EABFC"]
    inner = rng.normal(size=(lasting[0], rank, rank)) + 4 * np.eye(rank)
    E = np.zeros((lasting[0], n, n))
    E[:, :rank, :rank] = inner
    order = rng.permutation(n)
    E = E[:, order][:, :, rng.permutation(n)]
    if draw(st.booleans()):
        left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
        E = left @ E @ right
    E *= draw(st.sampled_from([1.0, 1e-12, 1e9]))
    shapes = {"A": (n, n), "B": (n, m), "F": (n, q), "C": (r, n)}
    matrices = {"E": E}
    for (name, shape), times in zip(shapes.items(), lasting[1:], strict=True):
        matrices[name] = rng.normal(size=(times, *shape))
        if draw(st.booleans()):
            matrices[name] *= rng.random(shape) < 0.4
    matrices |= {"u": np.zeros((1, m)), "theta": np.zeros((1, q))}
    system = DescriptorSystem(
        name="drawn", states=tuple(f"x{i}" for i in range(n)),
        coefficients=Drawn(matrices, np.zeros_like(E)), initial_state=np.zeros(n),
        inputs=tuple("ab"[:m]), unknowns=tuple("cd"[:q]), outputs=tuple("efg"[:r]),
    )
    return system, np.linspace(0.0, 1.0, count)


def found_or_refused(compute):
    """What is found, or what the refusal says apart from digits."""
    try:
        return compute()
    except ModelError as error:
        return "".join(c for c in str(error) if not c.isdigit())


@settings(deadline=None)
@given(plants(), st.booleans(), st.booleans())
def test_observer_matrices(drawn, normalise, weighted):
    system, t = drawn
    scale = np.linspace(0.5, 1.0, system.r) if weighted else None
    one, other = by_both(lambda: found_or_refused(lambda: matrices.observer_matrices(
        system, t, t, RANK_TOL, normalise=normalise, output_scale=scale
    )))
    if isinstance(one, str) or isinstance(other, str):
        assert one == other
        return
    same_matrices(one, other)
    again, expected = by_both(lambda: found_or_refused(
        lambda: matrices.observer_matrices(system, t, t, RANK_TOL, one)
    ))
    if isinstance(again, str):
        assert again == expected
    else:
        same_matrices(again, expected)


def same_matrices(one, other):
    assert one.split.rank == other.split.rank
    assert (one.split.frame is None) == (other.split.frame is None)
    close(one.split.basis, other.split.basis)
    close(one.split.projector, other.split.projector)
    close(one.rows, other.rows)
    close(one.output_scale, other.output_scale)
    size = np.abs(other.algebraic).max(initial=1.0)
    lost = 1e4 * size * np.linalg.norm(other.elimination, axis=(1, 2)).max(initial=1.0)
    of_E = np.abs(other.split.pinv).max(initial=1e-300)
    close(one.split.pinv, other.split.pinv, of_E, rounding=1e5)
    for name in ("algebraic", "on_basis", "g_signals", "G"):
        close(getattr(one, name), getattr(other, name), size)
    for name in ("dynamics", "from_unknowns", "from_signals"):
        expected = getattr(other, name)
        own = np.abs(expected).max(initial=0.0)  # with full rank it is E⁺A that is large
        close(getattr(one, name), expected, max(of_E * size**2, size**2, own), rounding=lost)
    # Q1 and H have free signs.
    close(one.residual, other.residual, rounding=lost)
    K = (o.elimination @ np.swapaxes(o.range, 1, 2) for o in (one, other))
    close(*K, size=np.abs(other.elimination).max(initial=1.0), rounding=lost)
    close(one.injectivity, other.injectivity, rounding=lost)


def test_a_change_of_rank_is_refused_by_the_same_words():
    E = np.diag([1.0, 1.0, 0.0])[None].repeat(9, axis=0)
    E[5, 1, 1] = 0.0
    fixed = {"E": E, "A": np.eye(3)[None], "B": np.zeros((1, 3, 0)), "F": np.zeros((1, 3, 0)),
             "C": np.ones((1, 1, 3)), "u": np.zeros((1, 0)), "theta": np.zeros((1, 0))}
    system = DescriptorSystem(
        "drawn", ("a", "b", "c"), Drawn(fixed, np.zeros_like(E)), np.zeros(3), outputs=("y",)
    )
    t = np.arange(9.0)

    def text():
        with pytest.raises(ModelError, match=r"rank of E changes from 2 .* at t = 5") as caught:
            matrices.observer_matrices(system, t, t, RANK_TOL)
        return str(caught.value)

    one, other = by_both(text)
    assert one == other


def test_assumption_1_is_refused_by_the_same_words():
    A = np.diag([1.0, 1.0, 0.0])[None]
    C = np.zeros((12, 1, 3))
    C[:, 0, 2] = np.linspace(1.0, 0.0, 12)
    fixed = {"E": np.diag([1.0, 1.0, 0.0])[None], "A": A, "B": np.zeros((1, 3, 0)),
             "F": np.zeros((1, 3, 0)), "C": C, "u": np.zeros((1, 0)), "theta": np.zeros((1, 0))}
    system = DescriptorSystem(
        "drawn", ("a", "b", "c"), Drawn(fixed, np.zeros((1, 3, 3))), np.zeros(3), outputs=("y",)
    )

    def text():
        with pytest.raises(ModelError, match=r"Assumption 1 .* fails at t = 11:") as caught:
            matrices.observer_matrices(system, np.arange(12.0), np.arange(12.0), RANK_TOL)
        return str(caught.value)

    one, other = by_both(text)
    assert one == other


shapes = st.tuples(*[st.integers(0, 4)] * 6)


@settings(deadline=None)
@given(shapes, st.sampled_from([0, 1, 7, 8, 9, 30]), st.booleans(), seeds)
def test_signals_of_the_regression(shape, count, constant, seed):
    rng = np.random.default_rng(seed)
    k, q, more, rows, n, b = shape
    p, N = q + more, 1 if constant else count
    z, basis = rng.normal(size=(count, k, 1 + p)), rng.normal(size=(n, k))
    A, G = rng.normal(size=(N, rows, k)), rng.normal(size=(N, rows, q))
    g_y, Q1 = rng.normal(size=(count, rows)), rng.normal(size=(N, rows, b))
    H = rng.normal(size=(N, n, b))
    one, other = by_both(lambda: regression_signals(
        z, q, basis, matrices.AlgebraicEquations(A, g_y, G, Q1, H, np.ones(N))
    ))
    for name in ("Y", "psi", "offset", "gain", "Y_scale", "psi_scale"):
        close(getattr(one, name), getattr(other, name), 100.0)
    if not count or not p:
        return
    for (signal, floor), (expected, other_floor) in zip(*by_both(one.kinds), strict=True):
        close(signal.reshape(expected.shape), expected, 100.0)
        assert floor == other_floor
    for found, expected in zip(*by_both(one._row_sizes), strict=True):
        close(found, expected)


@given(st.integers(0, 3), st.integers(0, 3), st.integers(0, 3), st.integers(0, 4),
       st.integers(0, 20), st.booleans(), seeds)
def test_what_drives_the_extension(m, r, q, k, count, constant, seed):
    rng = np.random.default_rng(seed)
    N = 1 if constant else count
    made = matrices.ObserverMatrices(
        split=None, rows=None, output_scale=None, dynamics=np.zeros((1, k, k)),
        from_unknowns=rng.normal(size=(N, k, q)), from_signals=rng.normal(size=(N, k, m + r)),
        algebraic=None, on_basis=None, g_signals=rng.normal(size=(N, 5, m + r)), G=None,
        range=None, elimination=None, injectivity=None,
    )
    u, y = rng.normal(size=(count, m)), rng.normal(size=(count, r))
    one, other = by_both(lambda: extension._driven(made, u, y, 1 + q + k))
    for found, expected in zip(one, other, strict=True):
        close(found, expected, 10.0)


@given(st.integers(1, 30), st.integers(1, 6), st.integers(1, 6), st.booleans(), seeds)
def test_the_weakest_time(count, n, b, constant, seed):
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(1 if constant else count, n, b))
    injectivity = rng.uniform(0.5, 1.0, count)
    one, other = by_both(lambda: matrices.weakest(injectivity, H))
    close(one[0], other[0])
    assert one[1] == other[1] or abs(one[0] - other[0]) < 10 * EPS
    for bad in (np.inf, np.nan):
        injectivity[count // 2] = bad
        assert by_both(lambda: matrices.weakest(injectivity, H)) == ((np.inf, 0), (np.inf, 0))


@given(st.integers(0, 20), st.integers(1, 16), st.integers(0, 2), st.integers(0, 2), seeds)
def test_eigenvalues(count, p, more, missing, seed):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(count, p, p)) * 10.0 ** rng.uniform(-12, 3, (count, p, 1))
    half[:, :missing] = 0.0
    A = np.swapaxes(half, 1, 2) @ half
    A = np.concatenate([A, rng.normal(size=(count, p, more))], axis=2)
    one, other = by_both(lambda: excitation.eigenvalues(A))
    size = np.abs(A).max(axis=(1, 2), initial=0.0)[:, None]
    assert (np.abs(one - other) <= 20 * p * EPS * size).all()
    assert (np.diff(one, axis=1) >= 0).all()


@given(st.integers(1, 16), st.booleans(), seeds)
def test_the_weakest_direction(p, flat, seed):
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(p, p)))[0]
    values = 10.0 ** rng.uniform(-6, 3, p)
    if flat:
        values[: p // 2 + 1] = 0.0
    A = np.concatenate([vectors * values @ vectors.T, np.ones((p, 1))], axis=1)
    (one, direction), (other, expected) = by_both(lambda: excitation._weakest(A))
    close(one, other, max(other), rounding=200)
    assert abs(np.dot(direction, expected)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("A", [
    np.zeros((4, 4)), np.eye(5), np.diag([3.0, 1.0, 2.0]), np.ones((6, 6)), -np.ones((3, 3)),
    np.eye(4) + np.eye(4, k=1) + np.eye(4, k=-1), np.eye(4, k=3) + np.eye(4, k=-3),
    np.diag([1.0, 1e-8, 1e-16]) + 1e-12, [[0.0, 1.0], [1.0, 0.0]],
])
def test_eigenvalues_of_matrices_with_structure(A):
    one, other = by_both(lambda: excitation.eigenvalues(np.array([A])))
    close(one, other, np.abs(A).max(), rounding=20)


def test_eigenvalues_of_numbers_beyond_squares():
    base = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 1.0, 2.0]])
    for size in (1e-310, 1e-200, 1e300):
        one, other = by_both(lambda size=size: excitation.eigenvalues(size * base[None]))
        np.testing.assert_allclose(one, other, rtol=1e-10)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_spectra_of_what_is_not_finite_are_those_of_numpy(bad):
    A = np.tile(np.eye(3), (4, 1, 1))
    A[2, 1, 1] = bad

    def either(compute):
        try:
            return np.asarray(compute()).tolist()
        except np.linalg.LinAlgError as error:
            return str(error)

    for compute in (
        lambda: excitation.eigenvalues(A), lambda: regressions.spectral_norm(A, 3),
    ):
        one, other = by_both(lambda compute=compute: either(compute))
        np.testing.assert_equal(one, other)


@given(st.integers(0, 40), st.integers(0, 5), st.integers(1, 7), st.floats(-200, 200), seeds)
def test_spectral_norm(count, a, b, exponent, seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, a, b)) * 10.0 ** rng.uniform(-3, 0, (count, 1, 1))
    A *= 10.0**exponent
    for columns in (b, b - 1):
        if not columns or not a:
            continue
        one, other = by_both(lambda columns=columns: regressions.spectral_norm(A, columns))
        assert abs(one - other) <= 100 * EPS * other
    if count and a:
        one, other = by_both(lambda: log_norm(A[0]))
        assert abs(one - other) <= 1e-12


@given(st.integers(0, 5), st.integers(0, 5), st.integers(0, 4), st.integers(0, 5), seeds)
def test_largest_entry(a, b, c, first, seed):
    values = np.random.default_rng(seed).normal(size=(a, b, c, 5))
    one, other = by_both(lambda: largest_entry(values, first))
    assert one == other
    if values.size:
        values[-1, -1, -1, -1] = np.nan
        one, other = by_both(lambda: largest_entry(values, min(first, 4)))
        assert np.isnan([one, other]).all()


@given(st.integers(0, 3), st.integers(0, 4), st.integers(0, 3), st.integers(0, 3),
       st.integers(1, 3), st.booleans(), seeds)
def test_outer_products(elements, points, rows, p, c, several, seed):
    rng = np.random.default_rng(seed)
    psi = rng.normal(size=(elements, points, rows, p))
    Y = rng.normal(size=(elements, points, rows, c) if several else (elements, points, rows))
    close(*by_both(lambda: regressions.outer_products(psi, Y)), 10.0)


@given(st.integers(0, 4), st.integers(0, 12), st.integers(1, 10), st.integers(0, 4), seeds)
def test_affine_map(cases, times, n, p, seed):
    rng = np.random.default_rng(seed)
    mesh = Mesh(np.linspace(0.0, 1.0, 4), radau_rule(3))
    offset, gain = rng.normal(size=(3, 4, n)), rng.normal(size=(3, 4, n, p))
    state_map = AffineStateMap(Trajectory(mesh, offset), Trajectory(mesh, gain))
    eta = rng.normal(size=(cases, times, p))
    t = np.sort(rng.uniform(0.0, 1.0, times))
    close(*by_both(lambda: state_map.at(t)(eta)), 100.0)


@pytest.mark.parametrize("rho", [None, 1e-300, 1e-3, 1e9])
@pytest.mark.parametrize("row", [three, fading, lambda t: 1e-9 * three(t) * t[..., None] ** 3])
def test_excitation(row, rho):
    found = regression(row, ETA, elements=40)
    t = np.linspace(0.0, 10.0, 67)
    one, other = by_both(lambda: excitation.assess(found, t, ExcitationSettings(rho=rho)))
    size = float(np.abs(found.gram.final).max())
    close(one.gram_eigenvalues, other.gram_eigenvalues, size)
    close(one.pe_level, other.pe_level, size)
    assert (one.rho, one.window, one.is_ie) == (other.rho, other.window, other.is_ie)
    expected = pytest.approx(dict(other.weakest_direction.components), abs=1e-7)
    assert dict(one.weakest_direction.components) == expected
    assert (one.t_c is None) == (other.t_c is None)
    if rho is None and one.t_c is not None:
        assert abs(one.t_c - other.t_c) < 1e-6  # λ_min is flat where it starts
    if rho == 1e-3 and one.t_c is not None:
        assert abs(one.t_c - other.t_c) < 1e-11


@given(st.integers(1, 6), st.integers(2, 5), st.integers(1, 3), st.integers(0, 12), seeds)
def test_windows(elements, stages, rows, count, seed):
    rng = np.random.default_rng(seed)
    mesh = Mesh(np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1.0, elements))]),
                radau_rule(stages))
    signal = Trajectory(mesh, rng.normal(size=(elements, stages + 1, rows, rows + 1)))
    at = np.concatenate([rng.uniform(0.0, mesh.edges[-1], (count, 2)), [mesh.edges[[0, -1]]],
                         mesh.edges[[[1, 1]]]])
    a, b = np.sort(at, axis=1).T
    close(*by_both(lambda: excitation.between(signal, a, b)), 10.0 * elements)


def test_windows_of_a_regression_with_realisations():
    plain = regression(three, ETA, elements=30)
    Y = Trajectory(plain.mesh, np.stack([plain.Y.values, 2 * plain.Y.values], axis=-1))
    several = LinearRegression(Y, plain.psi, plain.parameters, plain.scale)
    t = np.linspace(0.0, 10.0, 31)
    one, other = by_both(lambda: excitation.assess(several, t, ExcitationSettings()))
    close(one.pe_level, other.pe_level)
    expected = excitation.assess(plain, t, ExcitationSettings())
    close(one.gram_eigenvalues, expected.gram_eigenvalues, 10.0)
    assert one.t_c == pytest.approx(expected.t_c, abs=1e-9)
    # Ω is p × p, however many realisations of 𝒴 stand beside it.
    size = regressions.largest(plain.gram.values)
    assert regressions.largest(several.gram.values) == pytest.approx(size, rel=1e-13)


def test_a_plant_without_inputs_is_observed():
    system = plant_from_mapping({
        "name": "free", "states": ["a", "b"], "E": [[1, 0], [0, 0]],
        "A": [["-1 - t/9", 1], [1, 1]], "C": [[0, 1]], "outputs": ["y"], "initial_state": [1, -1],
    })
    signals = simulate(system, TimeSettings(horizon=3.0), SolverSettings()).signals
    one, other = by_both(lambda: observe(
        system, signals.inputs, signals.outputs, ObserverSettings(), SolverSettings()
    ))
    close(one.regression.psi.values, other.regression.psi.values)
    close(one.regression.Y.values, other.regression.Y.values)


A3, Z = np.zeros((4, 2, 3)), np.zeros
# kernel, arguments that fit, and for each argument one that does not
FITTING = {
    "entry_sizes": (A3,),
    "largest_entry": (A3, 0),
    "in_frame": (Z((4, 3, 3)), Z((1, 3, 3)), Z((4, 3, 1)), Z((4, 3, 2)), Z((1, 2, 3)), np.ones(3),
                 np.ones(2), Z((3, 2)), Z((3, 2)), Z((3, 1)), Z((1, 3))),
    "driven": (Z((4, 3, 1)), Z((1, 3, 3)), Z((4, 5, 3)), Z((4, 1)), Z((4, 2)), 4),
    "regression_signals": (Z((4, 2, 4)), 1, Z((3, 2)), Z((1, 5, 2)), Z((4, 5)), Z((4, 5, 1)),
                           Z((1, 5, 2)), Z((4, 3, 2))),
    "products": (Z((4, 2, 3)), Z((4, 2))),
    "outer_products": (Z((2, 4, 2, 3)), Z((2, 4, 2, 1))),
    "residual_sizes": (Z((4, 2, 3)), Z((4, 2))),
    "eigenvalues": (Z((4, 2, 3)),),
    "eigenvector": (Z((2, 3)),),
    "sampled_eigenvalues": (Z((4, 5, 2, 3)), Z(6, dtype=np.intp), Z((6, 5))),
    "spectral_norm": (A3, 2),
    "weakest": (np.ones(4), Z((4, 3, 2))),
    "first_time": (Z((4, 5, 2, 3)), np.arange(5.0), Z(5), Z(5), Z(7), 1.0, 3, 1e-12),
    "window_sums": (Z((4, 5, 2, 3)), np.ones(4), Z((4, 4)), 2, Z(6, dtype=np.intp), Z((6, 5)),
                    Z(6, dtype=np.intp), Z((6, 5))),
    "affine_map": (Z((4, 2)), Z((4, 2, 3)), Z((5, 4, 3))),
}


def longer(array, axis):
    """One more along an axis, with zeros; what is there stays."""
    return np.concatenate([array, np.zeros_like(array.take([0], axis))], axis)


# Axes that may be of any length: nothing else has to agree with them.
FREE = {
    "entry_sizes": {(0, 0), (0, 1), (0, 2)}, "largest_entry": {(0, 0), (0, 1), (0, 2)},
    "in_frame": {(2, 2), (3, 2), (9, 1), (10, 0)}, "driven": {(0, 2), (2, 1)},
    "eigenvalues": {(0, 0), (0, 1), (0, 2)}, "eigenvector": {(0, 0), (0, 1)},
    "products": {(0, 2)}, "outer_products": {(0, 3), (1, 3)}, "residual_sizes": {(0, 2)},
    "regression_signals": {(0, 2)}, "sampled_eigenvalues": {(0, 0), (0, 2), (0, 3)},
    "spectral_norm": {(0, 0), (0, 1), (0, 2)}, "weakest": {(1, 1), (1, 2)},
    "first_time": {(0, 2), (0, 3), (4, 0)}, "window_sums": {(0, 2), (0, 3)}, "affine_map": {(2, 0)},
}


@pytest.mark.parametrize("name", FITTING)
def test_a_kernel_refuses_arrays_that_do_not_fit(name):
    kernel, fitting = getattr(COMPILED, name), FITTING[name]
    kernel(*fitting)
    with pytest.raises(TypeError, match="arguments, expected"):
        kernel(*fitting, 1)
    for place, argument in enumerate(fitting):
        if not isinstance(argument, np.ndarray):
            continue
        wrong = [*fitting]
        wrong[place] = argument.astype(np.float32)
        with pytest.raises(TypeError, match=f"argument {place} must be an array"):
            kernel(*wrong)
        for axis in range(argument.ndim):
            wrong[place] = longer(argument, axis)
            if (place, axis) in FREE[name]:
                kernel(*wrong)
            else:
                with pytest.raises(ValueError, match=r": \d+ and \d+|narrower|columns"):
                    kernel(*wrong)


def test_kernels_refuse_what_is_out_of_range():
    for name, place, value, message in (
        ("sampled_eigenvalues", 1, np.full(6, 4, dtype=np.intp), "no such element"),
        ("window_sums", 4, np.full(6, -1, dtype=np.intp), "no such element"),
        ("window_sums", 6, np.full(6, 4, dtype=np.intp), "no such element"),
        ("window_sums", 3, 4, "more columns"),
        ("spectral_norm", 1, 4, "more columns"),
        ("largest_entry", 1, -1, "negative"),
        ("driven", 5, 1, "too few columns"),
        ("regression_signals", 1, 2, "unknowns of G"),
    ):
        wrong = [*FITTING[name]]
        wrong[place] = value
        with pytest.raises(ValueError, match=message):
            getattr(COMPILED, name)(*wrong)
    with pytest.raises(TypeError):
        COMPILED.first_time(*FITTING["first_time"][:5], "x", 3, 1e-12)
    with pytest.raises(ValueError, match="fewer rows than"):
        COMPILED.in_frame(*FITTING["in_frame"][:9], np.zeros((3, 4)), np.zeros((1, 3)))


def test_large_systems_stay_with_numpy(monkeypatch):
    class Refusing:
        def __getattr__(self, name):
            raise AssertionError(name)

    monkeypatch.setattr(kernels, "compiled", Refusing())
    p = regressions.SMALL_SPECTRUM + 1
    assert excitation.eigenvalues(np.eye(p)[None]).tolist() == [[1.0] * p]
    assert regressions.spectral_norm(np.eye(p), p) == 1.0
