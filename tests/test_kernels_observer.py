"""The kernels of observers, excitation and regression against the NumPy that they stand for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_paths import by_both, needs_kernels
from plants import seen

from gpebo_cli.errors import ModelError
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers import observe
from gpebo_cli.observers.reduced import matrices
from gpebo_cli.observers.reduced.regression import regression_signals
from gpebo_cli.settings import (
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
    for name in ("Y", "psi", "offset", "gain", "Y_scale", "column_scale"):
        close(getattr(one, name), getattr(other, name), 100.0)
    if not count or not p:
        return
    for (signal, floor), (expected, other_floor) in zip(*by_both(one.kinds), strict=True):
        close(signal.reshape(expected.shape), expected, 100.0)
        assert floor == other_floor


def test_a_plant_without_inputs_is_observed():
    system = plant_from_mapping({
        "name": "free", "states": ["a", "b"], "E": [[1, 0], [0, 0]],
        "A": [["-1 - t/9", 1], [1, 1]], "C": [[0, 1]], "outputs": ["y"], "initial_state": [1, -1],
    })
    signals = simulate(system, TimeSettings(horizon=3.0), SolverSettings()).signals
    one, other = by_both(lambda: observe(system, seen(signals), SolverSettings()))
    close(one.regression.psi.values, other.regression.psi.values)
    close(one.regression.Y.values, other.regression.Y.values)
