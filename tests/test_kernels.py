"""The compiled kernels against the NumPy that they stand for: linalg, and what all share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_paths import COMPILED, by_both, needs_kernels

from gpebo_cli import kernels
from gpebo_cli.numerics.linalg import affine_scan

pytestmark = needs_kernels


def test_kernels_are_there_where_they_were_asked_for():
    assert kernels.compiled is not None


@given(st.integers(0, 40), st.integers(1, 4), st.booleans(), st.integers(0, 2**32 - 1))
def test_affine_scan(steps, lanes, shared, seed):
    rng = np.random.default_rng(seed)
    factor = rng.uniform(0, 1, (steps, 1 if shared else lanes))
    shift, start = rng.normal(size=(steps, lanes)), rng.normal(size=lanes)
    one, other = by_both(lambda: affine_scan(factor, shift, start))
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_a_kernel_refuses_arrays_that_do_not_fit():
    with pytest.raises(TypeError, match="argument 0 must be an array of float64 with 2 axes"):
        COMPILED.affine_scan(np.zeros(3), np.zeros((3, 1)), np.zeros(1))
    with pytest.raises(ValueError, match="steps of factor and shift: 2 and 3"):
        COMPILED.affine_scan(np.zeros((2, 1)), np.zeros((3, 1)), np.zeros(1))
    with pytest.raises(TypeError, match="2 arguments, expected 3"):
        COMPILED.affine_scan(np.zeros((2, 1)), np.zeros((3, 1)))
