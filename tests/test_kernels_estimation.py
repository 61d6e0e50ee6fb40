"""The kernels of the estimators, and of what is measured, against the NumPy they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_paths import COMPILED, by_both, needs_kernels

from gpebo_cli.estimators._mixing import SINGULAR, determinants, mixed_points
from gpebo_cli.estimators._scalar import (
    ScalarPath,
    constant_law,
    integral_of_square,
    law_variation,
    linear_law,
)
from gpebo_cli.evidence.metrics import SETTLED
from gpebo_cli.experiment.pipeline import _evaluation
from gpebo_cli.numerics.linalg import determinant_and_adjugate_action
from gpebo_cli.numerics.mesh import Mesh, Trajectory
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers.observation import AffineStateMap

pytestmark = needs_kernels
SEEDS = st.integers(0, 2**32 - 1)


def compare(compute, rtol=1e-11, atol=1e-13):
    """Both ways agree, NaN where NaN is; gives what the kernels found."""
    one, other = by_both(compute)
    if not isinstance(one, tuple):
        one, other = (one,), (other,)
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        assert np.shape(a) == np.shape(b)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)
    return one if len(one) > 1 else one[0]


@given(st.integers(1, 4), st.integers(1, 6), st.integers(1, 3), st.integers(0, 9), SEEDS)
def test_mixed_points(elements, p, c, ruined, seed):
    """Δ, and η̄ that is filled from the next usable point wherever Ω is singular."""
    rng = np.random.default_rng(seed)
    extended = rng.normal(size=(elements, 4, p, p + c))
    omega = extended[..., :p]
    flat = extended.reshape(-1, p, p + c)
    for point in rng.integers(0, len(flat), ruined):
        kind = rng.integers(0, 3)
        if kind == 0:
            flat[point] = 0.0
        elif kind == 1:
            flat[point, :, :p] = np.outer(rng.normal(size=p), rng.normal(size=p))
        else:
            flat[point, :, :p] *= 1e-120
    with np.errstate(all="ignore"):
        condition = np.linalg.cond(omega)
        worst = condition[condition < 1e13].max(initial=1e3)
        delta, quotient = compare(lambda: mixed_points(extended), rtol=1e-13 * worst)
    assert not np.isnan(quotient).any()
    assert delta.shape == (elements, 4)


def test_mixed_points_without_a_usable_one():
    _, quotient = compare(lambda: mixed_points(np.zeros((2, 3, 2, 3))))
    assert (quotient == 0.0).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_a_number_is_not_usable(bad):
    values = np.random.default_rng(0).normal(size=(1, 4, 3, 4))
    values[0, 1] = bad
    with np.errstate(invalid="ignore"):
        one, other = by_both(lambda: mixed_points(values)[1])
    np.testing.assert_allclose(one, other, rtol=1e-10)
    np.testing.assert_array_equal(one[0, 1], one[0, 2])


def test_a_determinant_neither_under_nor_overflows_on_the_way():
    sizes = np.array([1e-200, 1e-200, 1e200, 1e200, -1e-80, 1e81])
    extended = np.concatenate([np.diag(sizes), sizes[:, None]], axis=1)[None, None]
    np.testing.assert_allclose(COMPILED.mixed_points(extended, 0.0)[0], -10.0, rtol=1e-12)


@given(st.integers(0, 5), st.integers(0, 7), SEEDS)
def test_determinants(count, p, seed):
    omega = np.random.default_rng(seed).normal(size=(count, p, p + 1))
    omega[1::2] *= 1e-90
    compare(lambda: determinants(omega[..., :p]))
    compare(lambda: determinants(0.0 * omega[..., 1:]))


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 8), st.integers(0, 8), st.integers(0, 3), st.booleans(), SEEDS)
def test_adjugate_action(p, rank, count, graded, seed):
    """Of any rank: adj(Ω) b is the larger of its own digits and those that Ω leaves it."""
    rng = np.random.default_rng(seed)
    rank = min(rank, p)
    omega = rng.normal(size=(count, p, rank)) @ rng.normal(size=(count, rank, p))
    if graded:
        omega *= 10.0 ** -rng.integers(0, 8, (p, 1))
    rhs = rng.normal(size=(count, p, 2))
    (one, action, condition), (other, expected, exact) = by_both(
        lambda: determinant_and_adjugate_action(omega, rhs)
    )
    sigma = np.linalg.svd(omega, compute_uv=False)
    # A change of Ω by ε‖Ω‖ changes a minor by that times minors that are one smaller, and so on.
    minors = np.prod(np.maximum(sigma[:, : p - 1], 1e-15 * sigma[:, :1]), axis=1)
    smaller = np.prod(np.maximum(sigma[:, : max(p - 2, 0)], 1e-15 * sigma[:, :1]), axis=1)
    size = 1e-12 * (minors + sigma[:, 0] * smaller if p > 1 else minors)
    assert (np.abs(action - expected) <= 10.0 * size[:, None, None]).all()
    assert (np.abs(one - other) <= size * sigma[:, 0]).all()
    np.testing.assert_allclose(condition, exact, rtol=1e-11, atol=2e-15 * p)


@given(st.integers(1, 6), SEEDS)
def test_adjugate_action_of_one_vector(p, seed):
    rng = np.random.default_rng(seed)
    omega, b = rng.normal(size=(2, 3, p, p)), rng.normal(size=(2, 3, p))
    delta, action, _ = compare(lambda: determinant_and_adjugate_action(omega, b), 1e-8, 1e-9)
    solved = (np.linalg.inv(omega) @ b[..., None])[..., 0] * delta[..., None]
    np.testing.assert_allclose(action, solved, rtol=1e-7, atol=1e-8)


def test_reciprocal_condition_of_tiny_and_of_triangular_matrices():
    upper = np.triu(np.ones((6, 6)))
    omega = np.array([upper, 1e-180 * upper, 1e180 * upper, np.diag([1.0, 0, 0, 0, 0, 0])])
    with np.errstate(over="ignore", invalid="ignore"):
        one, other = by_both(lambda: determinant_and_adjugate_action(omega, omega)[2])
    np.testing.assert_allclose(one, other, rtol=1e-13)


def a_path(rng, *, size=3, p=2, scale=1.0, times=9, flat=False, spread=1e-9):
    """A path of random steps, some of length 0, and times of which some are points or edges."""
    mesh = Mesh(np.cumsum(rng.uniform(0.1, 1.0, size + 1)), radau_rule(3))
    steps = rng.uniform(0.0, scale, (size, 4)) * (rng.uniform(size=(size, 4)) < 0.7)
    energy = np.cumsum(steps.ravel()).reshape(size, 4)
    energy[1:, 0] = energy[:-1, -1]
    quotient = rng.normal(size=p) + spread * rng.normal(size=(size, 4, p)) * (not flat)
    t = np.sort(np.concatenate([
        rng.uniform(mesh.edges[0], mesh.edges[-1], times), rng.choice(mesh.points.ravel(), 4),
        mesh.edges[[0, -1]],
    ]))
    at_t = np.maximum.accumulate(mesh.sampler(t)(np.maximum.accumulate(energy.ravel())
                                                 .reshape(energy.shape)))
    return ScalarPath(
        mesh, lambda t, inside: (t, inside), lambda t: t, quotient, energy, t, at_t, 0.0
    )


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 3), st.integers(1, 21), st.booleans(), st.booleans(),
    st.sampled_from([1e-320, 1e-9, 0.1, 1.0, 30.0, 1e4, 1e300]), SEEDS,
)
def test_laws(p, cases, each_its_own, from_each, gain, seed):
    """The closed forms, for gains of all sizes at once, one for all parameters or one for each."""
    rng = np.random.default_rng(seed)
    path = a_path(rng, p=p, size=int(rng.integers(1, 4)))
    gains = gain * rng.uniform(0.1, 10.0, (cases, p if each_its_own else 1))
    gains[-1] = rng.choice([1e-6, 1.0, 1e6])
    start = rng.normal(size=(cases, p) if from_each else p)
    for law in (constant_law, linear_law):
        with np.errstate(over="ignore"):
            found = compare(lambda law=law: law(path, start, gains))
        assert found.shape == (cases, len(path.t), p)


def test_the_linear_law_keeps_a_small_distance():
    """What is left of e^{−γI} is known to all its digits: the parameter itself is zero."""
    path = a_path(np.random.default_rng(1), p=1, flat=True)
    path.quotient[...] = 0.0
    path.energy[...] -= path.energy[0, 0]
    path = replace(path, t=path.mesh.points.ravel(), energy_at_t=path.energy.ravel())
    gains = np.geomspace(1e-3, 100.0, 11)[:, None]
    found = compare(lambda: linear_law(path, np.ones(1), gains), rtol=1e-12, atol=0.0)
    expected = np.exp(-gains * path.energy_at_t)
    np.testing.assert_allclose(found[..., 0], expected, rtol=1e-12)


def test_decays_are_accurate_to_the_last_digits():
    """One step of the law is e^{−x} of the distance and the mean of it of the change."""
    x = np.concatenate([[0.0, 1e-310], np.geomspace(1e-17, 2000.0, 4001)])
    ones = np.array([0.0, 1.0])
    args = ones[None], ones, np.array([1.0]), np.zeros(1, dtype=np.intp), np.array([1.0])
    energy, points, t, element, at = args

    def final(quotient, start):
        eta = COMPILED.linear_law(
            energy, np.array(quotient)[None, :, None], np.array([0.0, 1.5]), points, t, element,
            0.5 * at, np.array([[start]]), x[:, None],
        )
        return eta[:, 0, 0]

    half = 0.5 * x
    np.testing.assert_allclose(final([0.0, 0.0], 1.0), np.exp(-half), rtol=1e-15, atol=1e-307)
    mean = np.divide(-np.expm1(-half), half, out=np.ones_like(half), where=half > 0)
    np.testing.assert_allclose(1.0 - 2.0 * final([0.0, 1.0], 0.0), mean, rtol=0, atol=4e-16)


@given(st.integers(1, 4), st.integers(1, 3), SEEDS)
def test_variation(size, p, seed):
    rng = np.random.default_rng(seed)
    path = a_path(rng, size=size, p=p, spread=1.0)
    gain = 10.0 ** rng.uniform(-3, 3)
    compare(lambda: law_variation(path.energy, path.quotient, gain))


def test_variation_that_is_not_a_number():
    path = a_path(np.random.default_rng(2))
    path.quotient[1, 2] = np.nan
    assert np.isnan(law_variation(path.energy, path.quotient, 1.0)[0])
    compare(lambda: law_variation(path.energy, path.quotient, 1.0))


@given(st.integers(1, 5), SEEDS)
def test_energy(size, seed):
    rng = np.random.default_rng(seed)
    mesh = Mesh(np.cumsum(rng.uniform(0.1, 1.0, size + 1)), radau_rule(4))
    delta = rng.normal(size=(size, 5))
    found = compare(lambda: integral_of_square(mesh, delta))
    assert (np.diff(found.ravel()) >= 0.0).all()
    delta[0, 2] = np.nan
    compare(lambda: integral_of_square(mesh, delta))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 4), st.integers(1, 4), st.integers(1, 20), st.sampled_from([2, 7, 31, 33, 70]),
    st.sampled_from(["", "state", "all states", "parameter", "all parameters", "a case"]), SEEDS,
)
def test_measured(p, n, cases, times, unknown, seed):
    """All five numbers and what is kept, for errors that settle, do not, or are not known."""
    rng = np.random.default_rng(seed)
    mesh = Mesh(np.array([0.0, 0.4, 1.0, 2.0]), radau_rule(3))
    t = np.sort(rng.uniform(0.0, 2.0, times))
    offset, gain = rng.normal(size=(3, 4, n)), rng.normal(size=(3, 4, n, p))
    state_map = AffineStateMap(Trajectory(mesh, offset), Trajectory(mesh, gain))
    truth = np.tile(rng.normal(size=p), (times, 1))
    x = state_map.at(t)(truth[None])[0] + 1e-3 * rng.normal(size=(times, n))
    decay = np.exp(-rng.uniform(0.0, 20.0, (cases, 1, 1)) * t[:, None])
    eta = truth + decay * rng.normal(size=(cases, 1, p)) * rng.choice([1.0, 1e-3, 0.0])
    if unknown == "state":
        x[:, 0] = np.nan
    elif unknown == "all states":
        x[:] = np.nan
    elif unknown == "parameter":
        truth[:, :1] = np.nan
    elif unknown == "all parameters":
        truth[:] = np.nan
    elif unknown == "a case":
        eta[-1] = np.nan
    judged = slice(min(1, p), None) if rng.integers(0, 2) else slice(None)
    chosen = np.unique(rng.integers(0, times, 5))
    with np.errstate(all="ignore"):
        compare(lambda: _evaluation(state_map, t, truth, x, judged, chosen)(eta), 1e-9, 1e-12)


def test_measured_of_what_is_constant_in_time():
    """A truth, an offset and a gain of one time are those of all times."""
    rng = np.random.default_rng(3)
    t, eta = np.linspace(0.0, 1.0, 40), rng.normal(size=(9, 40, 2))
    truth, offset, gain, x = (rng.normal(size=(1, *shape)) for shape in ((2,), (3,), (3, 2), (3,)))
    rest = np.arange(2), np.array([0, 39]), SETTLED

    def call(a, b, c, d):
        columns, chosen, fraction = rest
        return COMPILED.measured(t, eta, a, columns, b, c, d, chosen, fraction)

    one = call(truth, offset, gain, x)
    other = call(*(np.repeat(a, 40, axis=0) for a in (truth, offset, gain, x)))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_kernels_refuse_what_does_not_fit():
    path = a_path(np.random.default_rng(4))
    law = (path.energy, path.quotient, path.mesh.edges, path.mesh.rule.points, path.t,
           path.mesh.sampler(path.t).element, path.energy_at_t, np.zeros((1, 2)), np.ones((3, 1)))
    assert COMPILED.linear_law(*law).shape == (3, len(path.t), 2)
    bad = {
        0: path.energy[:-1], 1: path.quotient[:, :-1], 2: path.mesh.edges[1:],
        3: path.mesh.rule.points[1:], 4: path.t[1:], 6: path.energy_at_t[1:],
        5: np.full(len(path.t), 3), 7: np.zeros((2, 2)), 8: np.ones((3, 3)),
    }
    for place, value in bad.items():
        with pytest.raises(ValueError, match=" "):
            COMPILED.linear_law(*law[:place], np.ascontiguousarray(value), *law[place + 1 :])
    with pytest.raises(ValueError, match="a path needs a step"):
        COMPILED.linear_law(
            path.energy[:, :1].copy(), path.quotient[:, :1].copy(), law[2], law[3][:1], *law[4:]
        )

    start = np.zeros((1, 2))
    with pytest.raises(ValueError, match="parameters at the start: 2 and 3"):
        COMPILED.constant_law(path.energy_at_t, np.zeros(3), start, np.ones((3, 1)))
    with pytest.raises(ValueError, match="parameters with a gain: 3 and 2"):
        COMPILED.constant_law(path.energy_at_t, np.zeros(2), start, np.ones((3, 3)))
    with pytest.raises(ValueError, match="elements: 3 and 2"):
        COMPILED.law_variation(path.energy, path.quotient[1:].copy(), 1.0)
    with pytest.raises(ValueError, match="stages: 4 and 3"):
        COMPILED.energy(path.energy, path.mesh.steps, np.eye(2))
    with pytest.raises(ValueError, match="rows and columns of the extension: 3 and 2"):
        COMPILED.mixed_points(np.zeros((1, 1, 3, 2)), SINGULAR)
    with pytest.raises(ValueError, match="rows and columns: 2 and 3"):
        COMPILED.determinants(np.zeros((1, 2, 3)))
    with pytest.raises(ValueError, match="matrices and right sides: 1 and 2"):
        COMPILED.adjugate_action(np.zeros((1, 2, 2)), np.zeros((2, 2, 1)))
    with pytest.raises(ValueError, match="rows and columns: 2 and 3"):
        COMPILED.adjugate_action(np.zeros((1, 2, 3)), np.zeros((1, 2, 1)))
    with pytest.raises(ValueError, match="rows of matrices and right sides: 2 and 3"):
        COMPILED.adjugate_action(np.zeros((1, 2, 2)), np.zeros((1, 3, 1)))
    with pytest.raises(TypeError):
        COMPILED.mixed_points(np.zeros((1, 1, 2, 3)), "singular")

    t, eta = np.linspace(0.0, 1.0, 5), np.zeros((2, 5, 2))
    args = (t, eta, np.zeros((5, 2)), np.arange(2), np.zeros((5, 3)), np.zeros((5, 3, 2)),
            np.zeros((5, 3)), np.array([0, 4]), SETTLED)
    assert COMPILED.measured(*args)[0].shape == (5, 2)
    bad = {
        0: t[1:], 1: np.zeros((2, 5, 3)), 2: np.zeros((4, 2)), 3: np.array([2]),
        4: np.zeros((5, 2)), 5: np.zeros((5, 3, 1)), 6: np.zeros((2, 3)), 7: np.array([5]),
    }
    for place, value in bad.items():
        with pytest.raises(ValueError, match=" "):
            COMPILED.measured(*args[:place], np.ascontiguousarray(value), *args[place + 1 :])
    with pytest.raises(ValueError, match="that there is not"):
        COMPILED.measured(*args[:7], np.array([-1]), SETTLED)
