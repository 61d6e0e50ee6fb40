"""The kernels of derivative arrays and consistent states against the NumPy they stand for."""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from kernel_paths import COMPILED, by_both, needs_kernels
from plants import DATA, problem, shipped

from gpebo_cli import kernels
from gpebo_cli.errors import ModelError
from gpebo_cli.model.descriptor import Coefficients, DescriptorSystem
from gpebo_cli.reduction import derivative_array, strangeness_free
from gpebo_cli.reduction import structure as structures
from gpebo_cli.reduction.derivative_array import balance
from gpebo_cli.reduction.strangeness_free import strangeness_free_form
from gpebo_cli.reduction.structure import Structure, analyse

pytestmark = needs_kernels

SEEDS = st.integers(0, 2**32 - 1)
FILES = sorted((DATA / "problems").glob("*.json"))


class Polynomials:
    """Matrices Σ_k c_k t^k, given as (K + 1, rows, columns)."""

    def __init__(self, **given):
        self.given = given

    @property
    def constant(self):
        return frozenset(name for name, c in self.given.items() if len(c) == 1)

    @property
    def zero(self):
        return frozenset({"phi", "D", "H"})

    def breakpoints(self, start, stop):
        return np.zeros(0)

    def taylor(self, t, order, inside=None):
        out = {}
        for name, c in self.given.items():
            at = 1 if len(c) == 1 else len(t)
            values = np.zeros((order + 1, at, *c.shape[1:]))
            for k in range(order + 1):
                for j in range(k, len(c)):
                    powers = (t[:at] ** (j - k)).reshape(-1, *[1] * (c.ndim - 1))
                    values[k] += comb(j, k) * powers * c[j]
            out[name] = np.broadcast_to(values, (order + 1, len(t), *c.shape[1:]))
        n, m, q, r = *(out[name].shape[3] for name in "EBF"), out["C"].shape[2]
        return without_terms(order, len(t), n, m, q, r)._replace(**out)


def without_terms(order, times, n, m=0, q=0, r=0):
    """Coefficients that are all zero."""
    shapes = {"E": (n, n), "A": (n, n), "B": (n, m), "F": (n, q), "C": (r, n), "u": (m,),
              "theta": (q,), "phi": (n,), "D": (r, m), "H": (r, q)}
    return Coefficients(*[np.zeros((order + 1, times, *shape)) for shape in shapes.values()])


def product(x, y):
    """Coefficients of the product of two matrix polynomials."""
    out = np.zeros((len(x) + len(y) - 1, *(x[0] @ y[0]).shape))
    for i, a in enumerate(x):
        for j, b in enumerate(y):
            out[i + j] += a @ b
    return out


def random_system(seed, d, blocks, varying=True, m=1, q=2):
    """A system with d differential states and nilpotent blocks of these sizes, mixed over time."""
    rng = np.random.default_rng(seed)
    n = d + sum(blocks)
    E, A = np.eye(n)[None], np.eye(n)[None].copy()
    A[0, :d, :d] = rng.normal(size=(d, d))
    at = d
    for size in blocks:
        E[0, at : at + size, at : at + size] = np.eye(size, k=1)
        at += size
    P, Q = (np.eye(n) + 0.4 * rng.normal(size=(2 if varying else 1, n, n)) for _ in range(2))
    P[1:] *= 0.2
    Q[1:] -= np.eye(n)
    Q[1:] *= 0.2
    # x = Q z: E z' = A z becomes E Q⁻¹ x' = …; with Q as the inverse, (E Q) x' = (A Q − E Q') x.
    dQ = Q[1:]
    left = product(P, product(E, Q))
    right = product(P, product(A, Q))
    if varying:
        change = product(P, product(E, dQ))
        right[: len(change)] -= change
    source = Polynomials(
        E=left, A=right, B=rng.normal(size=(2, n, m)), F=rng.normal(size=(1, n, q)),
        C=np.ones((1, 1, n)), u=rng.normal(size=(3, m)), theta=rng.normal(size=(1, q)),
    )
    names = tuple(f"x{i}" for i in range(n))
    return DescriptorSystem("random", names, source, rng.normal(size=n))


SYSTEMS = st.tuples(
    SEEDS, st.integers(0, 3), st.lists(st.integers(1, 3), max_size=2), st.booleans(),
    st.integers(0, 2), st.integers(0, 2),
).filter(lambda s: s[1] + sum(s[2]) > 0)


def outcome(system, start=0.0, stop=1.0):
    """Its structure, or what is said against it."""
    try:
        return analyse(system, start, stop, max_mu=3, rank_tol=1e-10)
    except ModelError as error:
        return str(error)


def assert_same_structure(one, other):
    if isinstance(one, str) or isinstance(other, str):
        assert isinstance(one, str)
        assert isinstance(other, str)
        assert one.split("singular value")[0] == other.split("singular value")[0]
        return
    assert (one.mu, one.a, one.d, one.time_invariant, one.steady) == (
        other.mu, other.a, other.d, other.time_invariant, other.steady
    )
    assert one.scaling.time == other.scaling.time
    np.testing.assert_array_equal(one.scaling.rows, other.scaling.rows)
    np.testing.assert_array_equal(one.scaling.columns, other.scaling.columns)
    assert one.smallest_singular_value == pytest.approx(
        other.smallest_singular_value, rel=1e-6, abs=1e-13
    )
    assert one.reference.rank == other.reference.rank
    projectors = [s.reference.Z1 @ np.swapaxes(s.reference.Z1, -1, -2) for s in (one, other)]
    np.testing.assert_allclose(*projectors, atol=1e-7)
    assert (one.dynamics is None) == (other.dynamics is None)
    assert one.rate == pytest.approx(other.rate, rel=1e-6)
    assert one.growth == pytest.approx(other.growth, rel=1e-5, abs=1e-5 * max(1.0, one.rate))


@settings(max_examples=150, deadline=None)
@given(SYSTEMS)
def test_the_same_structure(drawn):
    assert_same_structure(*by_both(lambda: outcome(random_system(*drawn))))


@settings(max_examples=100, deadline=None)
@given(SYSTEMS)
def test_the_same_bounds(drawn):
    """Not only those that decide."""
    system = random_system(*drawn)
    structure = outcome(system)
    assume(isinstance(structure, Structure))
    assume(not structure.time_invariant)
    t = np.linspace(0.1, 0.9, 23)
    c = system.coefficients.taylor(t, structure.mu)
    (one, first), (other, second) = by_both(
        lambda: structures._judged(t, c, structure.mu, structure.scaling, 1e-10, False)
    )
    assert (first is None) == (second is None)
    assert (one.a, one.failure) == (other.a, other.failure)
    np.testing.assert_allclose(one.smallest, other.smallest, rtol=1e-6, atol=1e-13)
    sizes = [np.linalg.norm(levels.dynamics, axis=(1, 2)) for levels in (one, other)]
    np.testing.assert_allclose(*sizes, rtol=1e-6, atol=1e-9 * sizes[0].max(initial=1.0))


def alone(E, A):
    """Coefficients of order 0 without inputs, E and A (N, n, n)."""
    times, n = E.shape[:2]
    return without_terms(0, times, n)._replace(E=E[None], A=A[None])


@pytest.mark.parametrize("where", [0, 3, 9])
def test_what_is_wrong_at_one_time_is_said_of_that_time(where):
    E, A = np.zeros((10, 2, 2)) + np.diag([1.0, 0.0]), np.zeros((10, 2, 2)) + np.eye(2)
    A[where, 1, 1] = 0.0
    one, other = by_both(lambda: structures._judged(
        np.arange(10.0), alone(E, A), 0, balance(alone(E, A)), 1e-10, False
    ))
    assert one[1] is other[1] is None
    assert one[0].failure == other[0].failure
    assert f"constraints are linearly dependent at t = {where}" in one[0].failure


@pytest.mark.parametrize("tiny", [1e-3, 1e-13, 0.0])
@pytest.mark.parametrize("where", [0, 5, 8])
def test_times_beside_one_that_needs_other_pivots(tiny, where):
    """Rows are exchanged alike at neighbouring times, which does not suit this one."""
    E = np.random.default_rng(3).normal(size=(11, 4, 4)) + 9.0 * np.eye(4)
    E[where] = np.roll(E[where], 1, axis=0)
    E[where, 0, 0] = tiny
    c, ones = alone(E, E), np.ones(4)
    pivots = (np.arange(4), np.arange(4), 4, np.eye(4))
    known, *_, basis, _, _ = COMPILED.reduced(
        c.E, c.A, ones, ones, 1.0, 0, c.B, c.F, c.u, c.theta, *pivots, 1, 300.0, 1e-13
    )
    assert known[0]
    np.testing.assert_allclose(basis, np.linalg.inv(E), atol=1e-14)
    E[where] = np.roll(E[where], -1, axis=0) * np.array([1.0, 0.0, 1.0, 1.0])  # singular
    known, *_ = COMPILED.reduced(
        c.E, c.A, ones, ones, 1.0, 0, c.B, c.F, c.u, c.theta, *pivots, 1, 300.0, 1e-13
    )
    assert not known[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_same_structure_of_published_problems(path):
    data, system = problem(path)
    assert_same_structure(*by_both(lambda: outcome(system, *data["tspan"])))


@pytest.mark.parametrize("name", ["circuit", "descriptor", "canonical"])
def test_the_same_structure_of_shipped_plants(name):
    assert_same_structure(*by_both(lambda: outcome(shipped(name), 0.0, 20.0)))


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("where", [0.3712, 0.5001, 0.7, 0.123456])
@pytest.mark.parametrize("kind", ["array", "constraints", "differential"])
def test_the_same_is_said_of_a_rank_that_drops(power, where, kind):
    zero = np.poly1d([1.0, -where]) ** power
    c = np.zeros((power + 1, 2, 2))
    c[:, 0, 0] = zero.coeffs[::-1]
    c[0, 1, 1] = 1.0
    fixed = np.diag([1.0, 0.0])[None] if kind == "constraints" else np.eye(2)[None]
    E, A = {
        "array": (c, -np.eye(2)[None]),  # a differential equation is lost
        "differential": (product(c, np.ones((1, 2, 2)) + np.eye(2)[None]), -np.eye(2)[None]),
        "constraints": (fixed, c[:, ::-1, ::-1].copy()),
    }[kind]
    nothing = {"B": np.zeros((1, 2, 0)), "F": np.zeros((1, 2, 0)), "C": np.zeros((1, 0, 2)),
               "u": np.zeros((1, 0)), "theta": np.zeros((1, 0))}
    source = Polynomials(E=E, A=A, **nothing)
    system = DescriptorSystem("singular", ("x", "z"), source, np.zeros(2))
    one, other = by_both(lambda: outcome(system))
    assert isinstance(one, str)
    assert_same_structure(one, other)


@settings(max_examples=150, deadline=None)
@given(SYSTEMS, st.integers(1, 80))
def test_the_same_equations(drawn, count):
    system = random_system(*drawn)
    structure = outcome(system)
    assume(isinstance(structure, Structure))
    t = np.linspace(0.0, 1.0, count)
    one, other = by_both(lambda: strangeness_free_form(system, structure, t, t))
    assert_same_equations(one, other)


def assert_same_equations(one, other):
    for name, value in vars(other).items():
        found = getattr(one, name)
        if value is None:
            assert found is None
            continue
        assert found.shape == value.shape, name
        size = max(1e-300, np.abs(value).max(initial=0.0))
        np.testing.assert_allclose(found, value, rtol=0, atol=1e-10 * size, err_msg=name)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_same_equations_of_published_problems(path):
    data, system = problem(path)
    structure = outcome(system, *data["tspan"])
    if isinstance(structure, str):
        return
    t = np.linspace(*data["tspan"], 101)
    one, other = by_both(lambda: strangeness_free_form(system, structure, t, t))
    assert_same_equations(one, other)


def test_small_plants_need_no_lapack(monkeypatch):
    """What the kernels leave to NumPy they leave to it everywhere; so they must not, here."""
    for module, name in (
        (structures, "_levels"), (structures, "_all_levels"),
        (strangeness_free, "_by_elimination"), (strangeness_free, "forcing"),
        (strangeness_free, "inverse_or_none"),
    ):
        monkeypatch.setattr(module, name, None)
    monkeypatch.setattr(np.linalg, "svd", None)
    for path in FILES:
        data, system = problem(path)
        structure = outcome(system, *data["tspan"])
        if isinstance(structure, Structure):
            t = np.zeros(3) + data["tspan"][0]
            reduced = strangeness_free_form(system, structure, t, t)
            assert np.isfinite(reduced.E1).all()


def test_large_plants_use_lapack(monkeypatch):
    system = random_system(8, 3, [2, 1])
    expected = outcome(system)
    assert isinstance(expected, Structure)
    monkeypatch.setattr(structures, "SMALL", 5)
    monkeypatch.setattr(strangeness_free, "SMALL", 5)
    monkeypatch.setattr(kernels, "compiled", Without("start", "all_levels", "levels", "reduced"))
    structure = outcome(system)
    assert_same_structure(structure, expected)
    t = np.linspace(0, 1, 9)
    assert np.isfinite(strangeness_free_form(system, structure, t, t).A2).all()


class Without:
    """The kernels without some of them."""

    def __init__(self, *names):
        self.names = names

    def __getattr__(self, name):
        assert name not in self.names
        return getattr(COMPILED, name)


def test_times_at_which_the_pivots_will_not_do():
    """Near t = 0.98 the pivot of the middle vanishes: there, singular vectors take over."""
    nothing = {"B": np.ones((1, 2, 1)), "F": np.zeros((1, 2, 0)), "C": np.zeros((1, 0, 2)),
               "u": np.ones((3, 1)), "theta": np.zeros((1, 0))}
    turn = np.array([[[0.98, -0.02], [0.02, 0.98]], [[-1.0, -1.0], [1.0, -1.0]]])
    E = product(turn, np.array([[[1.0, 0.0], [0.0, 0.0]]]))
    A = product(turn, np.array([[[-1.0, 2.0], [0.5, 1.0]], [[0.0, 0.0], [1.0, 0.0]]]))
    system = DescriptorSystem("turning", ("x", "z"), Polynomials(E=E, A=A, **nothing), np.ones(2))
    structure = outcome(system, 0.0, 0.9)
    assert isinstance(structure, Structure)
    for t in (np.linspace(0.08, 1.08, 51), np.linspace(0.9801, 0.981, 20)):
        one, other = by_both(lambda t=t: strangeness_free_form(system, structure, t, t))
        assert_same_equations(one, other)
        x, E, f = one.offset, one.E, np.einsum("nij,nj->ni", np.ones((len(t), 2, 1)), one.u)
        lost = np.linalg.svd(E)[0][:, :, 1:]
        A = system.coefficients.taylor(t, 0).A[0]
        left = np.einsum("nia,ni->na", lost, np.einsum("nij,nj->ni", A, x) + f)
        np.testing.assert_allclose(left, 0.0, atol=1e-11)
    near = np.array([0.5, 0.97, 0.98, 0.98 + 1e-5])
    model = system.coefficients.taylor(near, 0)
    s, pivots = structure.scaling, structure.reference
    for t, trusted in ((0, True), (1, True), (2, False), (3, False)):
        c = {name: value[:, t : t + 1] for name, value in model._asdict().items()}
        known = COMPILED.reduced(
            c["E"], c["A"], s.rows, s.columns, s.time, 0, c["B"], c["F"], c["u"], c["theta"],
            pivots.rows, pivots.columns, pivots.rank, pivots.Z1, 1, 300.0, 1e-13,
        )[0]
        assert bool(known[0]) == trusted


@given(SEEDS, st.integers(1, 40), st.booleans())
def test_dips(seed, count, infinite):
    rng = np.random.default_rng(seed)
    values = np.round(10.0 ** rng.uniform(-4, 0, (count, 3)), 3)
    if infinite:
        values[:, rng.integers(3)] = np.inf
    one, other = by_both(lambda: structures._dips(values))
    assert one[0] == other[0]
    # Equal ones may come in any order, and the last of them may be another.
    assert [(c, values[k, c]) for c, k in one[1]] == [(c, values[k, c]) for c, k in other[1]]


@given(SEEDS, st.integers(1, 3), st.integers(1, 5))
def test_growth_in_closed_form(seed, d, count):
    matrices = np.random.default_rng(seed).normal(size=(count, d, d))
    expected = np.linalg.eigvals(matrices).real.max(axis=1)
    found = structures._largest_real_parts(matrices)
    np.testing.assert_allclose(found, expected, atol=1e-7)


@settings(deadline=None)
@given(SEEDS, st.integers(1, 6), st.integers(0, 2), st.integers(0, 3))
def test_singular_values(seed, n, mu, lost):
    """Of any matrices, also where the rank of E is not full; LAPACK says what they are."""
    rng = np.random.default_rng(seed)
    E, A = rng.normal(size=(2, mu + 1, 5, n, n))
    E[..., : min(lost, n)] = 0.0
    E *= 10.0 ** rng.uniform(-3, 0, n)
    c = without_terms(mu, 5, n)._replace(E=E, A=A)
    plain = derivative_array.Scaling(np.ones(n), np.ones(n), 0.5, np.ones(n))
    t = np.arange(5.0)
    for a in range(n + 1):
        for column in range(3):
            one, other = by_both(
                lambda a=a, k=column: structures._line(t, c, mu, plain, 1e-10, a, k)
            )
            if column == 0:
                known = other > 1e-6  # else the left kernel is not, and its constraints are not
            np.testing.assert_allclose(
                one[known | (column == 0)], other[known | (column == 0)], rtol=1e-6, atol=1e-13
            )


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_numbers_too_large_for_squares_are_left_to_lapack(value):
    E, A = np.zeros((1, 3, 2, 2)) + np.eye(2), np.zeros((1, 3, 2, 2)) + np.eye(2)
    A[0, 1, 0, 0] = value
    model = (E, A, np.ones(2), np.ones(2), 1.0, 0)
    assert COMPILED.start(*model, 0, 1e-10)[0][0]
    assert not COMPILED.start(*model, 1, 1e-10)[0][0]
    assert not COMPILED.levels(*model, 0, 2)[0][0]
    _, _, rows, columns, Z1, *_ = COMPILED.start(*model, 0, 1e-10)
    pivots = (rows, columns, 2, Z1)
    assert not COMPILED.all_levels(*model, *pivots, 1e-10, 1e-5, 1e-13)[0][0]
    forces = (np.zeros((1, 3, 2, 0)),) * 2 + (np.zeros((1, 3, 0)),) * 2
    assert COMPILED.reduced(*model, *forces, *pivots, 1, 300.0, 1e-13)[0][0]
    E[0, 1, 0, 0] = value
    found = COMPILED.reduced(*model, *forces, *pivots, 1, 300.0, 1e-13)
    assert found[0][0] == np.isfinite(value)


def fitting():
    """Arguments that fit: one model, then forces, pivots."""
    model = [np.zeros((2, 3, 2, 2)), np.zeros((2, 1, 2, 2)), np.ones(2), np.ones(2), 1.0, 1]
    forces = [np.zeros((2, 3, 2, 1)), np.zeros((2, 1, 2, 2)), np.zeros((2, 3, 1)),
              np.zeros((2, 1, 2))]
    pivots = [np.arange(4), np.arange(4), 3, np.zeros((2, 1))]
    return model, forces, pivots


KERNELS = {
    "start": lambda m, f, p: [*m, 0, 1e-10],
    "levels": lambda m, f, p: [*m, 1, 0],
    "all_levels": lambda m, f, p: [*m, *p, 1e-10, 1e-5, 1e-13],
    "reduced": lambda m, f, p: [*m, *f, *p, 1, 300.0, 1e-13],
    "dips": lambda m, f, p: [np.ones((4, 3)), 0.2, 0.01, 6],
}


@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_refuses_what_does_not_fit(name):
    """Every array with another length of any axis, or one axis less; every number out of range."""
    kernel = getattr(COMPILED, name)
    given = KERNELS[name](*fitting())
    kernel(*given)
    with pytest.raises(TypeError):
        kernel(*given[:-1])
    for i, value in enumerate(given):
        if not isinstance(value, np.ndarray):
            continue
        with pytest.raises(TypeError):
            kernel(*given[:i], value.astype(np.float32), *given[i + 1 :])
        for axis in range(value.ndim):
            for longer in (True, False):
                if (name, i, axis) in FREE:
                    continue
                shape = list(value.shape)
                shape[axis] = shape[axis] + 7 if longer else shape[axis] - 1
                fits_anyway = axis == 0 and value.ndim > 2 and longer and value.shape[0] == 2
                if fits_anyway:  # more Taylor coefficients than needed
                    continue
                other = np.zeros(shape, dtype=value.dtype)
                with pytest.raises(ValueError, match=r".+"):
                    kernel(*given[:i], other, *given[i + 1 :])


# Lengths of axes that nothing else says: numbers of times.
FREE = {("dips", 0, 0)}
FREE |= {(name, 0, 1) for name in ("start", "levels", "all_levels", "reduced")}


def test_numbers_out_of_range_are_refused():
    model, forces, pivots = fitting()
    wrong = {
        "start": [[*model, 3, 1e-10], [*model, -1, 1e-10], [*model[:5], 2, 0, 1e-10]],
        "levels": [[*model, 3, 0], [*model, -1, 0], [*model, 1, 3], [*model, 1, -1]],
        "all_levels": [[*model, *pivots[:2], r, pivots[3], 1e-10, 1e-5, 1e-13] for r in (1, 2, 5)],
        "reduced": [
            [*model, *forces, *pivots, 0, 300.0, 1e-13],
            [*model, *forces, np.arange(1, 5), *pivots[1:], 1, 300.0, 1e-13],
            [*model, *forces, pivots[0], np.arange(-1, 3), *pivots[2:], 1, 300.0, 1e-13],
        ],
    }
    for name, calls in wrong.items():
        for given_arguments in calls:
            with pytest.raises(ValueError, match=r".+"):
                getattr(COMPILED, name)(*given_arguments)


def test_matrices_may_lie_anywhere(monkeypatch):
    """Transposed, reversed in time, every other one: strides are no kernel's excuse."""
    system = random_system(8, 2, [2])
    structure = outcome(system)
    assert isinstance(structure, Structure)
    t = np.linspace(0, 1, 21)
    c = system.coefficients.taylor(t, structure.mu)
    expected = strangeness_free_form(system, structure, t, t, c)
    monkeypatch.setattr(strangeness_free, "forcing", None)  # nor a reason to leave it to NumPy
    turned = {name: np.asfortranarray(value) for name, value in c._asdict().items()}
    assert_same_equations(
        strangeness_free_form(system, structure, t, t, Coefficients(**turned)), expected
    )
    twice = {name: np.repeat(value, 2, axis=1)[:, ::2] for name, value in c._asdict().items()}
    assert_same_equations(
        strangeness_free_form(system, structure, t, t, Coefficients(**twice)), expected
    )
    back = {name: value[:, ::-1].copy()[:, ::-1] for name, value in c._asdict().items()}
    assert_same_equations(
        strangeness_free_form(system, replace(structure), t, t, Coefficients(**back)), expected
    )
