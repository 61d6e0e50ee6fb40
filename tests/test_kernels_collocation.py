"""The kernels of the collocation engine against the lines of NumPy that they stand for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_paths import COMPILED, by_both, needs_kernels

from gpebo_cli.errors import SolverError
from gpebo_cli.numerics import collocation as linear
from gpebo_cli.numerics.collocation import Constraints, LinearEquation, LinearProblem, solve
from gpebo_cli.numerics.mesh import Mesh, Trajectory, initial_mesh, unresolved_kinds
from gpebo_cli.numerics.radau import radau_rule

pytestmark = needs_kernels

seeds = st.integers(0, 2**32 - 1)


def assert_close(one, other, rtol=1e-9):
    """Relative to the largest; what is not finite stands in the same places."""
    one, other = np.asarray(one), np.asarray(other)
    assert one.shape == other.shape
    np.testing.assert_array_equal(np.isfinite(one), np.isfinite(other))
    size = np.abs(other[np.isfinite(other)]).max(initial=0.0)
    np.testing.assert_allclose(one, other, rtol=rtol, atol=rtol * size)


def random_equation(rng, points, n, d, columns, varies, *, identity=False):
    """E, A, f, and with d < n constraints, each constant in time or not as ``varies`` says."""
    def values(kind, *shape):
        return rng.normal(size=(points if varies[kind] else 1, *shape))

    if identity:
        return LinearEquation(None, values(1, n, n), values(2, n, columns))
    basis = values(3, n, d)
    E = 0.2 * values(0, d, n) + np.eye(d, n)
    if d == n:
        return LinearEquation(E, values(1, n, n), values(2, n, columns))
    constraints = Constraints(basis + 3.0 * np.eye(n, d), values(4, n, columns))
    return LinearEquation(E, values(1, d, n), values(2, d, columns), (), constraints)


@st.composite
def equations(draw):
    """A mesh, an equation on it, and a start."""
    rng = np.random.default_rng(draw(seeds))
    rule = radau_rule(draw(st.integers(2, 9)))
    lengths = draw(st.lists(st.sampled_from([0.1, 0.1 + 1e-14, 0.2]), min_size=1, max_size=5))
    mesh = Mesh(np.cumsum([0.5, *lengths]), rule)
    n, columns = draw(st.integers(1, 4)), draw(st.integers(1, 9))
    identity = draw(st.booleans())
    c = random_equation(
        rng, mesh.points.size, n, n if identity else draw(st.integers(0, n)), columns,
        draw(st.lists(st.booleans(), min_size=5, max_size=5)), identity=identity,
    )
    problem = LinearProblem(lambda t, inside: c, rng.normal(size=(n, columns)))
    return problem, mesh, c


@given(equations())
def test_element_maps(equation):
    problem, mesh, c = equation
    one, other = by_both(lambda: linear._element_maps(problem, mesh, None, c))
    shape = (mesh.size, *one.homogeneous.shape[1:])
    assert_close(
        np.broadcast_to(one.homogeneous, shape), np.broadcast_to(other.homogeneous, shape)
    )
    assert_close(one.particular, other.particular)


@given(equations(), st.integers(0, 3))
def test_chain_and_estimates(equation, cut):
    """The values, and what the end of :func:`solve` makes of them."""
    problem, mesh, c = equation
    maps = linear._element_maps(problem, mesh, None, c)
    restarts = {float(mesh.edges[min(cut, mesh.size)]): lambda left: 2.0 * left - 1.0}
    one, other = by_both(lambda: linear._chain(maps, problem, mesh, restarts))
    assert_close(one[0], other[0])
    assert one[1] == other[1] == mesh.size
    rng = np.random.default_rng(1)
    values = one[0] * 10.0 ** rng.integers(-9, 1, (1, 1, *problem.start.shape))
    for amplification in (None, rng.random((len(problem.start), len(problem.start) + 1))):
        ending = LinearProblem(
            problem.coefficients, problem.start, floor=0.1, amplification=amplification
        )
        one, other = by_both(lambda p=ending: linear._estimates(p, maps, values, mesh))
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-15)


@given(seeds, st.integers(1, 6), st.integers(4, 15))
def test_noise_is_seen_alike(seed, columns, stages):
    rng = np.random.default_rng(seed)
    mesh = initial_mesh(0.0, 2.0, [], 5, radau_rule(stages))
    signal = np.sin(mesh.points)[:, :, None, None] + rng.normal(size=columns) * 1e-6
    values = signal + 10.0 ** rng.integers(-16, -3) * rng.normal(size=(*mesh.points.shape, 1, 1))
    values[..., 0] *= rng.integers(0, 2)
    problem = LinearProblem(lambda t, inside: None, values[0, 0])
    maps = linear._ElementMaps(rng.normal(size=(1, stages, 1, 1)), values[:, 1:], ())
    one, other = by_both(lambda: linear._estimates(problem, maps, values, mesh))
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-15)


def test_growth_beyond_all_numbers_is_noticed_at_the_same_element():
    mesh = initial_mesh(0.0, 1000.0, [], 100, radau_rule(9))
    c = LinearEquation(None, np.array([[[1.0]]]), np.zeros((1, 1, 1)))
    problem = LinearProblem(lambda t, inside: c, np.ones((1, 1)))
    maps = linear._element_maps(problem, mesh, None, c)
    one, other = by_both(lambda: linear._chain(maps, problem, mesh, {})[1])
    assert 0 < one == other < mesh.size


@pytest.mark.parametrize("constant", [True, False])
def test_a_singular_system_is_the_same_error(constant):
    mesh = initial_mesh(0.0, 1.0, [], 3, radau_rule(5))
    zeros = np.zeros((1 if constant else mesh.points.size, 2, 2))
    c = LinearEquation(zeros, zeros, np.ones((1, 2, 1)))
    problem = LinearProblem(lambda t, inside: c, np.ones((2, 1)), name="toy")

    def message():
        with pytest.raises(SolverError, match="toy has a singular collocation system") as error:
            linear._element_maps(problem, mesh, None, c)
        return str(error.value)

    one, other = by_both(message)
    assert one == other


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_a_number_stays(bad):
    mesh = initial_mesh(0.0, 1.0, [], 3, radau_rule(5))
    f = np.ones((mesh.points.size, 2, 1))
    f[8] = bad  # in the second element
    c = LinearEquation(None, np.full((1, 2, 2), 0.3), f)
    problem = LinearProblem(lambda t, inside: c, np.ones((2, 1)))

    def finite():
        maps = linear._element_maps(problem, mesh, None, c)
        return np.isfinite(maps.particular[[0, 2]]).all(), linear._chain(maps, problem, mesh, {})[1]

    assert by_both(finite) == ((True, 1), (True, 1))


def test_refinement_takes_the_same_way():
    def pulse(t, inside):
        f = np.exp(-2500.0 * (t - 6.1) ** 2)
        return LinearEquation(None, -np.ones((1, 1, 1)), f[:, None, None])

    def result():
        mesh = initial_mesh(0.0, 10.0, [], 24, radau_rule(9))
        return solve(LinearProblem(pulse, np.zeros((1, 1))), mesh, tol=1e-9, max_elements=10_000)

    one, other = by_both(result)
    np.testing.assert_array_equal(one.trajectory.mesh.edges, other.trajectory.mesh.edges)
    assert_close(one.trajectory.values, other.trajectory.values)
    assert one.rounds == other.rounds > 1
    assert one.error_estimate == pytest.approx(other.error_estimate, rel=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 20])
@pytest.mark.parametrize("columns", [1, 7, 8, 9])
@pytest.mark.parametrize("stages", [2, 3, 5])
def test_elimination_swaps_rows(n, columns, stages):
    """With the equations in reverse order the diagonal of the first node is zero."""
    rng = np.random.default_rng(n)
    mesh = Mesh(np.array([0.0, 0.3, 0.5]), radau_rule(stages))
    points = mesh.points.size
    c = LinearEquation(
        np.eye(n)[None, ::-1].copy(), 1e-3 * rng.normal(size=(points, n, n)),
        rng.normal(size=(points, n, columns)),
    )
    problem = LinearProblem(lambda t, inside: c, rng.normal(size=(n, columns)))
    one, other = by_both(lambda: linear._element_maps(problem, mesh, None, c))
    assert_close(one.homogeneous, other.homogeneous, rtol=1e-11)
    assert_close(one.particular, other.particular, rtol=1e-11)


# --- signals on a mesh -----------------------------------------------------------------------


def signal(rng, mesh, *shape):
    sizes = 10.0 ** rng.integers(-12, 3, shape)
    t = mesh.points.reshape(*mesh.points.shape, *(1 for _ in shape))
    return sizes * np.sin(rng.uniform(0.1, 8.0, shape) * t + rng.normal(size=shape))


@given(seeds, st.integers(2, 14), st.lists(st.integers(0, 13), min_size=1, max_size=30))
def test_tails(seed, stages, counts):
    rng = np.random.default_rng(seed)
    mesh = initial_mesh(0.0, 4.0, [], int(rng.integers(1, 9)), radau_rule(stages))
    kinds = [(signal(rng, mesh, c), float(rng.choice([0.0, 1e-3, 10.0]))) for c in counts]
    kinds[0] = (kinds[0][0] * 0.0, 0.0)
    one, other = by_both(lambda: unresolved_kinds(kinds, mesh.rule))
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-17)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_tails_of_what_is_not_a_number(bad):
    rng = np.random.default_rng(3)
    mesh = initial_mesh(0.0, 4.0, [], 4, radau_rule(7))
    values = signal(rng, mesh, 3)
    values[1, 2, 1] = bad
    with np.errstate(invalid="ignore"):
        one, other = by_both(lambda: unresolved_kinds([(values, 0.0)], mesh.rule))
    np.testing.assert_array_equal(np.isnan(one), np.isnan(other))
    assert np.isnan(one).any()


@given(seeds, st.integers(1, 9), st.integers(2, 9))
def test_points_of_a_mesh_and_sampling(seed, size, stages):
    rng = np.random.default_rng(seed)
    edges = np.cumsum(rng.uniform(0.01, 1.0, size + 1)) - 2.0

    def places():
        mesh = Mesh(edges, radau_rule(stages))
        return mesh.points, mesh.inside

    (points, inside), (others, decided) = by_both(places)
    np.testing.assert_array_equal(points, others)
    np.testing.assert_array_equal(inside, decided)
    t = np.concatenate([
        rng.uniform(edges[0], edges[-1], 9), edges, np.nextafter(edges, -9),
        [edges[0] - 0.01, edges[-1] + 0.01], points.ravel(),
    ])
    at = np.concatenate([t[:-points.size], inside.ravel()])
    for order in (np.arange(len(t)), np.argsort(t)):
        for decide in (None, at[order]):
            def sampler(t=t[order], decide=decide):
                chosen = Mesh(edges, radau_rule(stages)).sampler(t, decide)
                return chosen.element, chosen.weights

            one, other = by_both(sampler)
            np.testing.assert_array_equal(one[0], other[0])
            np.testing.assert_allclose(one[1], other[1], rtol=1e-9, atol=1e-12)


@given(st.lists(st.integers(0, 9), max_size=9), seeds)
def test_splitting(parts, seed):
    rng = np.random.default_rng(seed)
    mesh = Mesh(np.cumsum(rng.uniform(0.01, 1.0, len(parts) + 1)), radau_rule(3))

    def split():
        finer, kept = mesh.split(np.array(parts, dtype=np.intp))
        return finer.edges, kept

    (edges, kept), (others, equal) = by_both(split)
    np.testing.assert_array_equal(edges, others)
    np.testing.assert_array_equal(kept, equal)


@given(st.lists(st.booleans(), min_size=1, max_size=12), st.booleans(), st.booleans(), seeds)
def test_merging(fresh, one_before, one_after, seed):
    """Old elements in their order, some left out, new ones in between; one may stand for all."""
    rng = np.random.default_rng(seed)
    fresh = np.array(fresh)
    old = np.sort(rng.choice(30, size=int((~fresh).sum()), replace=False))
    kept = np.full(len(fresh), -1)
    kept[~fresh] = old

    def maps(size, alone):
        homogeneous = rng.normal(size=(1 if alone else size, 2, 3, 3))
        extras = (rng.normal(size=(size, 3, 0)), rng.normal(size=(1, 1, 2)))
        return linear._ElementMaps(homogeneous, rng.normal(size=(size, 2, 3, 1)), extras)

    before, after = maps(30, one_before), maps(int(fresh.sum()), one_after)
    merged, expected = by_both(lambda: linear._merge(before, after, kept, fresh))
    np.testing.assert_array_equal(merged.homogeneous, expected.homogeneous)
    np.testing.assert_array_equal(merged.particular, expected.particular)
    for one, other in zip(merged.extras, expected.extras, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("before", "after", "kept"), [
    ((2, 3), (2, 3), [0, 1, -1]), ((2, 3), (1, 3), [0, 2]), ((0, 3), (1, 3), [0]),
    ((2, 3), (1, 2), [0, -1]),
])  # fmt: skip
def test_what_cannot_be_merged_is_refused(before, after, kept):
    with pytest.raises(ValueError, match=r"elements?: |element \d of|numbers of an element"):
        COMPILED.merged(np.zeros(before), np.zeros(after), np.array(kept))


def test_parts_less_than_none_are_refused():
    for parts in (-1, np.iinfo(np.intp).max):
        with pytest.raises(ValueError, match=f"{parts} parts"):
            COMPILED.split(z(2), np.array([parts]))


@given(seeds, st.lists(st.integers(0, 9), max_size=2), st.sampled_from([0, 1, 21, 2500]))
def test_samples_integrals_and_filters(seed, shape, count):
    rng = np.random.default_rng(seed)
    mesh = initial_mesh(0.5, 4.5, [1.3], int(rng.integers(1, 9)), radau_rule(9))
    values = signal(rng, mesh, *shape)
    if len(shape) == 2 and seed % 2:
        values = np.swapaxes(values, 2, 3)  # not contiguous
    trajectory = Trajectory(mesh, values)
    t = np.linspace(0.5, 4.5, count)
    rates = rng.choice([0.0, 0.3, 2.0, 1e4], values.shape[2:])
    start = rng.normal(size=values.shape[2:]) if seed % 3 else None
    for compute in (
        lambda: Trajectory(mesh, values)(t),
        lambda: trajectory.integral().values,
        lambda: trajectory.local_integral().values,
        lambda: trajectory.low_pass(rates, start).values,
        lambda: trajectory.low_pass(0.7).values,
    ):
        one, other = by_both(compute)
        assert_close(one, other, rtol=1e-11)


# --- arrays that do not fit ------------------------------------------------------------------

z = np.zeros


def given_arguments():
    """Arguments of each kernel that fit: s = 3, K = 2, n = 2, d = 1, four columns."""
    k, s, n, d, c = 2, 3, 2, 1, 4
    points = k * (s + 1)
    values = z((k, s + 1, c))
    return {
        "element_maps": [
            z((s, s)), np.ones(k), z((points, d, n)), z((points, d, n)), z((points, d, c)),
            z((points, n, d)), z((points, n, c)), 0.0,
        ],
        "chain": [z((k, s, n, n)), z((k, s, n, c)), z((n, c))],
        "estimates": [
            z((k, s, n, n)), z((k, s + 1, n, c)), z((s + 1, s + 1)), 2, z((n, n + 1)), 0.0, 0.0, 0.3
        ],
        "tails": [z((s + 1, s + 1)), 2, 0.0, 0.0, values, 0.0, values, 0.0],
        "mesh_points": [z(k + 1), z(s + 1), 0.0],
        "split": [z(k + 1), np.ones(k, dtype=np.intp)],
        "sampler": [np.arange(k + 1.0), z(s + 1), z(s + 1), z(5), z(5), 0.0, 0.0],
        "sample": [z(5, dtype=np.intp), z((5, s + 1)), values],
        "integral": [z((s, s)), z(k), values, True],
        "low_pass": [np.eye(s), np.ones(k), values, z(c), z(c)],
    }


@pytest.mark.parametrize("name", given_arguments())
def test_a_kernel_refuses_arrays_that_do_not_fit(name):
    """Whatever argument is longer along whatever axis, or no array at all."""
    kernel, arguments = getattr(COMPILED, name), given_arguments()[name]
    kernel(*arguments)
    with pytest.raises(TypeError):
        kernel(*arguments[:-1])
    for place, argument in enumerate(arguments):
        wrong = [*arguments[:place], "text", *arguments[place + 1 :]]
        if isinstance(argument, bool):
            continue
        with pytest.raises(TypeError):
            kernel(*wrong)
        if not isinstance(argument, np.ndarray):
            continue
        for axis in range(argument.ndim):
            shape = list(argument.shape)
            shape[axis] += 1
            longer = z(shape, dtype=argument.dtype)
            if _is_another_size(name, place, axis):
                continue
            with pytest.raises(ValueError):  # noqa: PT011  as many texts as arguments
                kernel(*arguments[:place], longer, *arguments[place + 1 :])


def _is_another_size(name, place, axis):
    """Lengths that nothing else depends on."""
    return (name, place, axis) in {("mesh_points", 0, 0), ("mesh_points", 1, 0), ("sampler", 0, 0),
                                   ("sample", 2, 0), ("sample", 2, 2), ("integral", 2, 2),
                                   ("estimates", 1, 3), ("tails", 4, 2), ("tails", 6, 2)}


def test_a_sample_of_no_element_is_refused():
    for element in (-1, 2):
        with pytest.raises(ValueError, match=f"element {element} of 2"):
            COMPILED.sample(np.array([element]), z((1, 4)), z((2, 4, 1)))


def test_constraints_come_with_an_offset_and_with_E():
    arguments = given_arguments()["element_maps"]
    for missing in (2, 5, 6):
        with pytest.raises(ValueError, match=r"constraints|rows and columns of A"):
            COMPILED.element_maps(*(None if i == missing else a for i, a in enumerate(arguments)))


def test_coefficients_more_than_there_are_are_refused():
    for name, place in (("tails", 1), ("estimates", 3)):
        arguments = given_arguments()[name]
        for used in (-1, 5):
            with pytest.raises(ValueError, match="more Legendre coefficients"):
                getattr(COMPILED, name)(*arguments[:place], used, *arguments[place + 1 :])


def test_a_mesh_without_elements_is_refused():
    with pytest.raises(ValueError, match="no element"):
        COMPILED.sampler(z(1), z(4), z(4), z(5), None, 0.0, 0.0)
    with pytest.raises(ValueError, match="no edge"):
        COMPILED.mesh_points(z(0), z(4), 0.0)


def test_equal_elements_share_a_map_and_others_do_not():
    rule = radau_rule(4)
    A, f = np.array([[[0.3]]]), np.ones((1, 1, 1))
    for edges, count in (([0.0, 1.0, 2.0], 1), ([0.0, 1.0, 3.0], 2)):
        h = np.array([b - a for a, b in pairwise(edges)])
        maps, _ = COMPILED.element_maps(rule.differentiation, h, None, A, f, None, None, 1e-11)
        assert len(maps) == count
