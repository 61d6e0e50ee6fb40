"""Adjugates, scans."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from regressions import adjugate

from gpebo_cli.estimators._mixed import determinant_and_adjugate
from gpebo_cli.numerics.linalg import (
    affine_scan,
    determinant_and_adjugate_action,
    determinant_and_inverse,
    exact_product,
    inverse_or_none,
    largest_over_time,
    less_product,
    products_of_others,
    without_rounding,
)
from gpebo_cli.reduction.scaling import _first_of_each_part


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_adjugate_of_any_rank(p, rank, seed):
    rng = np.random.default_rng(seed)
    rank = min(rank, p)
    omega = rng.normal(size=(p, rank)) @ rng.normal(size=(rank, p))
    b = rng.normal(size=p)
    det, action, _ = determinant_and_adjugate_action(omega[None], b[None, :, None])
    size = max(1.0, np.linalg.norm(omega, 2)) ** p
    assert det[0] == pytest.approx(np.linalg.det(omega), abs=1e-12 * size)
    np.testing.assert_allclose(action[0, :, 0], adjugate(omega) @ b, atol=1e-11 * size)


def test_mixing_identity():
    """adj(Ω) Ω η = det(Ω) η."""
    rng = np.random.default_rng(1)
    omega, eta = rng.normal(size=(50, 4, 4)), rng.normal(size=4)
    det, action, _ = determinant_and_adjugate_action(omega, omega @ eta[:, None])
    np.testing.assert_allclose(action[..., 0], det[:, None] * eta, atol=1e-12 * np.abs(det).max())


def test_what_elimination_leaves_few_digits_of_is_left_to_singular_values():
    rng = np.random.default_rng(3)
    (U, _, V), sizes = np.linalg.svd(rng.normal(size=(5, 5))), np.ones((4, 5))
    sizes[:, -1] = [1.0, 1e-9, 1e-14, 0.0]
    omega = U * sizes[:, None] @ V
    det, inverse, unclear = determinant_and_inverse(omega)
    np.testing.assert_array_equal(unclear, [False, False, True, True])
    assert not inverse[2:].any()
    np.testing.assert_allclose(inverse[:2] @ omega[:2], [np.eye(5)] * 2, atol=1e-6)
    np.testing.assert_allclose(det[:2], np.linalg.det(omega[:2]), rtol=1e-6)
    det, found = determinant_and_adjugate(omega)
    exact, action, _ = determinant_and_adjugate_action(omega)
    np.testing.assert_allclose(det, exact, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found, action, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("width", [3, 3000])  # prefix scan and plain recurrence
def test_affine_scan_is_the_recurrence(width):
    rng = np.random.default_rng(2)
    a, b, z = rng.uniform(0, 1, (77, width)), rng.normal(size=(77, width)), rng.normal(size=width)
    out = affine_scan(a, b, z)
    expected = [z]
    for k in range(77):
        expected.append(a[k] * expected[-1] + b[k])
    np.testing.assert_allclose(out, expected, rtol=1e-13, atol=1e-13)


def test_affine_scan_of_nothing_is_the_start():
    assert affine_scan(np.zeros((0, 2)), np.zeros((0, 2)), np.ones(2)).tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize("shape", [(0, 3), (1, 2), (525, 4, 3), (64, 0), (300, 1), (70, 20, 20)])
def test_the_largest_sizes_over_time_are_those_of_the_times_one_by_one(shape):
    values = 1e-3 * np.random.default_rng(0).normal(size=shape)
    expected = np.array([np.abs(one) for one in values]).reshape(shape).max(axis=0, initial=0.0)
    assert np.array_equal(largest_over_time(values), expected)
    assert np.array_equal(largest_over_time(values[None].swapaxes(0, 1), 2), expected)
    if values.size:
        values[-1] = np.nan
        assert np.isnan(largest_over_time(values)).all()


def test_one_singular_matrix_of_several_is_named():
    inverse, singular = inverse_or_none(np.array([2.0 * np.eye(2), np.zeros((2, 2)), np.eye(2)]))
    assert singular.tolist() == [False, True, False]
    assert (inverse[[0, 2]] == [0.5 * np.eye(2), np.eye(2)]).all()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_rows_that_columns_link_in_long_chains_are_one_part(seed, count):
    """Rows 0 to 8 in chains, shuffled, against the components that a search finds."""
    rng = np.random.default_rng(seed)
    rows, order = rng.permutation(9), rng.permutation(9)
    linked = np.zeros((9, 9), dtype=bool)
    for column, (i, j) in enumerate(pairwise(rows[:count])):
        linked[[i, j], column] = True
    parts = [sorted(rows[:count].tolist()), *([row] for row in rows[count:].tolist())]
    first = {row: min(part, key=order.tolist().index) for part in parts for row in part}
    assert _first_of_each_part(linked, order).tolist() == [first[row] for row in range(9)]


def test_products_of_others_are_those_without_one():
    factors = np.random.default_rng(3).normal(size=(2, 3, 5))
    found = products_of_others(factors)
    for i in range(5):
        np.testing.assert_allclose(found[..., i], np.delete(factors, i, axis=-1).prod(axis=-1))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_what_counts_as_rounding_is_in_proportion_to_the_terms(unit):
    """1e-14 of the largest entry or of its own terms; in a row, of what chooses."""
    found = unit * np.array([[[1.0, 1e-14], [1e-12, 0.5]], [[0.0, 1e-14], [1e-12, 0.5]]])
    kept = found * np.array([[1, 0], [1, 1]])
    np.testing.assert_array_equal(without_rounding(found.copy()), kept)
    terms = unit * np.array([[[1.0, 1e-14], [100.0, 1.0]]])
    np.testing.assert_array_equal(
        without_rounding(found.copy(), terms), found * np.array([[1, 1], [0, 1]])
    )
    left, right = np.array([[[1.0, 1.0], [1e-3, 0.0]]]), np.array([[[1.0], [-1.0 + 1e-14]]])
    product = exact_product(unit * left, unit * right)
    np.testing.assert_allclose(product, unit**2 * np.array([[[0.0], [1e-3]]]), rtol=1e-12)


@pytest.mark.parametrize("one", [1.0, -1.0])
@pytest.mark.parametrize("other", [1.0, -1.0])
def test_a_difference_that_is_rounding_is_nothing_whatever_its_signs(one, other):
    factor, last, own = (np.array([[[x]]]) for x in (3.0 * one, 0.1 * other, 0.3 * one * other))
    assert own != factor * last
    assert less_product(own, factor, last) == 0.0
