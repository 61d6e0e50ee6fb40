"""Consistent states: at the start, from any state, in any units; and what jumps may not do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import one_state
from processes import refused
from random_systems import random_system
from units import Units, drawn, in_units

from benchmarks.honesty import made
from gpebo_cli import load_plant
from gpebo_cli.errors import ModelError
from gpebo_cli.kernels.structure_numpy import scaled
from gpebo_cli.model.descriptor import Coefficients
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.reduction import strangeness_free as reductions
from gpebo_cli.reduction.consistency import consistent_state, jumps
from gpebo_cli.reduction.scaling import _Terms, balance, balance_entries, scales_of, units_at
from gpebo_cli.reduction.stages import UnclearError, _Rounding, _without_dust, in_stages
from gpebo_cli.reduction.strangeness_free import (
    _by_singular_vectors,
    _refuse_undetermined,
    forcing,
    strangeness_free_form,
)
from gpebo_cli.reduction.structure import (
    Structure,
    _dips,
    _probe_times,
    _refuse_crossing,
    _why_not,
    analyse,
)
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.ivp import consistent_start
from gpebo_cli.simulation.simulate import simulate

SEEDS = st.integers(0, 2**32 - 1)
ZERO = np.zeros(1)


def case(seed, nu, extra, scale=0.0):
    """A manufactured system, its structure, and its equations at t = 0."""
    found = made(np.random.default_rng(seed), nu + extra, nu, scale=scale)
    structure = analyse(found.system, 0.0, 5.0, max_mu=6, rank_tol=1e-10)
    return found, structure, strangeness_free_form(found.system, structure, ZERO, ZERO)


def test_the_structure_of_a_text_is_found_once_for_a_horizon_and_a_tolerance():
    """A plant from Python is analysed each time: its functions may have changed."""
    def found(system, stop=5.0, rank_tol=1e-10):
        return analyse(system, 0.0, stop, max_mu=6, rank_tol=rank_tol)

    text = load_plant("circuit")
    assert found(text) is found(text)
    assert found(text, 4.0) is not found(text)
    assert found(text, rank_tol=1e-9).rank_tol == 1e-9
    made_here = made(np.random.default_rng(0), 3, 1).system
    assert found(made_here) is not found(made_here)


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.integers(1, 4), st.integers(0, 4), st.sampled_from([0.0, 3.0, 8.0]))
def test_a_consistent_state_is_returned_as_it_is(seed, nu, extra, scale):
    """The truth at the start satisfies the constraints to rounding, whatever the units."""
    found, _, form = case(seed, nu, extra, scale)
    x0 = found.exact(ZERO)[0]
    same = consistent_state(form, x0, lambda _: pytest.fail("nothing has to be solved"))
    assert same.tolist() == x0.tolist()


def first_state(system, structure, form):
    """The start of the collocation."""
    step = jumps(system, structure, ZERO, ZERO, ZERO, form)
    return consistent_state(form, system.initial_state, lambda x: step(0, x).after)


def test_a_start_that_numbers_do_not_tell_is_none():
    found, structure, form = case(3, 2, 2)
    x0 = found.system.initial_state + np.arange(1.0, found.system.n + 1.0)
    system = replace(found.system, initial_state=x0)
    assert np.isfinite(first_state(system, structure, form)).all()
    assert np.isnan(first_state(system, structure, replace(form, f2=np.inf * form.f2))).all()


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.integers(1, 4), st.integers(0, 4), st.sampled_from([0, 1, 6]))
def test_both_paths_start_from_the_same_state(seed, nu, extra, spread):
    """By impulses and by what the adjoint equation conserves, with equations in any units."""
    found, structure, form = case(seed, nu, extra)
    rng = np.random.default_rng(seed)
    x0 = found.system.initial_state + rng.normal(size=found.system.n)
    expected = first_state(replace(found.system, initial_state=x0), structure, form)
    rows = 10.0 ** rng.uniform(-spread, spread, found.system.n)
    source = replace(found.system.coefficients, rows=rows)
    system = replace(found.system, coefficients=source, initial_state=x0)
    structure = analyse(system, 0.0, 5.0, max_mu=6, rank_tol=1e-10)
    form = strangeness_free_form(system, structure, ZERO, ZERO)
    size = np.abs(expected).max()
    same = first_state(system, structure, form)
    np.testing.assert_allclose(same, expected, atol=1e-8 * size)
    alone = consistent_start(system, structure, ZERO, ZERO)
    np.testing.assert_allclose(alone, expected, atol=1e-8 * size)
    assert np.abs(form.A2[0] @ alone + form.f2[0]).max() < 1e-7 * size * np.abs(form.A2[0]).max()


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.integers(1, 4), st.integers(0, 4))
def test_stages_find_the_constraints_of_the_derivative_array(seed, nu, extra):
    """One differentiation at a time or all of them at once."""
    found, structure, form = case(seed, nu, extra)
    c = found.system.coefficients.taylor(ZERO, structure.mu)
    s = structure.scaling
    e, a = scaled(c.E, c.A, s.rows, s.columns, s.time, structure.mu + 1)
    weights = (s.time ** np.arange(structure.mu + 1))[:, None, None] * s.rows
    stages = in_stages(e, a, (forcing(c) * weights)[..., None], 1e-10, 1)
    assert stages.A2.shape[1] == structure.a
    assert len(stages.ranks) == structure.index
    x = found.exact(ZERO)[0] / s.columns
    off = np.abs(stages.A2[0] @ x + stages.f2[0, :, 0])
    size = stages.size[0] @ np.append(np.abs(x), 1.0)
    assert (off <= 20 * np.finfo(float).eps * (size + 1.0)).all()
    if structure.a:  # the directions that the constraints leave
        assert np.abs(stages.A2[0] @ (form.basis[0] / s.columns[:, None])).max(initial=0.0) < (
            1e-7 * np.abs(form.basis[0] / s.columns[:, None]).max(initial=1.0))


def test_rows_in_other_units_move_no_consistent_start():
    """Index 2 with rows in units of 1e-8 and 1e8, both paths against the closed form."""
    cos, sin = np.cos(0.7), np.sin(0.7)
    rows = np.diag([1e-8, 1.0, 1e8]) @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    columns = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    E = rows @ np.array([[1.0, 0, 0], [0, 0, 0], [0, 1, 0]]) @ columns
    A = rows @ np.diag([-1.0, 1, 1]) @ columns

    def truth(t):
        return np.array([np.cos(t), np.sin(2 * t) + 1, np.cos(3 * t)]).T @ columns

    plant = plant_from_mapping({
        "name": "rows", "states": ["a", "b", "c"], "E": E.tolist(), "A": A.tolist(),
        "B": rows.tolist(), "initial_state": truth(0.0).tolist(),
        "inputs": {"u": "cos(t) - sin(t)", "v": "-sin(2*t) - 1", "w": "2*cos(2*t) - cos(3*t)"},
    })
    times = np.linspace(0, 5, 101)
    for solver, most in (("collocation", 1e-12), ("ivp", 1e-6)):
        found = simulate(plant, TimeSettings(horizon=5.0), SolverSettings(name=solver, tol=1e-10))
        assert np.abs(found.signals.states(times) - truth(times)).max() < most


@pytest.mark.parametrize("sign", [1, -1])
def test_a_jump_of_E_times_a_jump_of_the_state_is_refused(sign):
    """E jumps where a state does: their product means nothing, whichever sign it has."""
    plant = plant_from_mapping({
        "name": "jumps", "states": ["a", "b"], "inputs": {"u": f"{sign}*step(t - 1)"},
        "E": [[f"1 + {sign}*step(t - 1)/2", 0], [0, 0]], "A": [[0, 1], [1, 0]], "B": [[0], [1]],
        "initial_state": {"a": 0, "b": 0},
    })
    with pytest.raises(ModelError, match=r"E jumps at t = 1 .* take the conserved quantity"):
        simulate(plant, TimeSettings(horizon=2.0), SolverSettings())


@settings(deadline=None)
@given(SEEDS, st.integers(1, 7), st.booleans())
def test_scalings_undo_units(seed, n, of_E):
    """Equations, states and time in other units change the factors and nothing that is scaled."""
    rng = np.random.default_rng(seed)
    E, A = rng.normal(size=(2, 1, 3, n, n)) * (rng.random((2, 1, 1, n, n)) < 0.7)
    E *= of_E

    def scaled(rows, columns, time):
        nothing = np.zeros((1, 3, n, 0)), np.zeros((1, 3, 0))
        weight = rows[:, None] * columns
        c = Coefficients(E * weight * time, A * weight, *[nothing[0]] * 3, *[nothing[1]] * 2,
                         nothing[1], *[nothing[0]] * 2)
        s = balance(c)
        assert all((np.log2(part) % 1 == 0).all() for part in (s.rows, s.columns, s.time))
        both = s.rows[:, None] * s.columns
        return c.E * both / s.time, c.A * both

    plain = scaled(np.ones(n), np.ones(n), 1.0)
    rows, columns = 2.0 ** rng.integers(-30, 30, n), 2.0 ** rng.integers(-30, 30, n)
    changed = scaled(rows, columns, 2.0 ** rng.integers(-30, 30))
    for one, other in zip(plain, changed, strict=True):
        np.testing.assert_allclose(other, one, rtol=3.1, atol=0.0)


@settings(deadline=None, max_examples=8)
@given(SEEDS, st.integers(2, 6), st.sampled_from([1.0, 1e3]))
def test_scales_are_those_of_weighted_least_squares(seed, n, mass):
    """Entries of E/τ and A have the size that the best factors give them, up to their rounding."""
    sizes = 2.0 ** np.random.default_rng(seed).uniform(-20.0, 20.0, (2, n, n))
    (E, A), none, empty = sizes[:, None, None], np.zeros((1, 1, n, 0)), np.zeros((1, 1, 0))
    s = balance(Coefficients(
        E, A, none, none, none, empty, empty, np.zeros((1, 1, n)), none, none
    ), mass)
    kind, i, j = np.indices(sizes.shape).reshape(3, -1)
    terms = np.hstack([np.eye(n)[i], np.eye(n)[j], kind[:, None] - 1.0])
    weights, logs = np.sqrt(np.where(kind == 0, mass, 1.0)), np.log2(sizes.ravel())
    best = terms @ np.linalg.lstsq(weights[:, None] * terms, -weights * logs)[0]
    found = terms @ np.log2([*s.rows, *s.columns, s.time])
    assert np.abs(found - best).max() <= 1.5 + 1e-9


@pytest.mark.parametrize("mass", [1.0, 1e3])
def test_a_factor_that_entries_leave_open_is_no_rounding(mass):
    """Rows times a number, columns over it, are the same: of such factors the least are found."""
    rng, n = np.random.default_rng(0), 12
    there = rng.random((2, n, n)) < 0.25
    there[1, range(n), range(n)] = there[1, :, 0] = True  # all of them hang together
    kind, i, j = there.nonzero()
    logs = rng.uniform(-30.0, 30.0, len(kind))
    factors = _Terms(i, n + j, kind - 1.0, 2 * n + 1).nearest(np.where(kind, 1.0, mass), logs)
    assert abs(factors[:n].sum() - factors[n:-1].sum()) < 1e-3


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.integers(2, 4))
def test_no_order_of_outputs_decides_in_which_units_they_count(seed, r):
    """But by a factor that states, equations and outputs have in common."""
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(3, 3)), 10.0 ** rng.uniform(-2.0, 2.0, r)[:, None]
    C = C * rng.normal(size=(r, 3))

    def units(C):
        none, empty = np.zeros((1, 1, 3, 0)), np.zeros((1, 1, 0))
        return units_at(Coefficients(
            np.eye(3)[None, None], A[None, None], none, none, C[None, None], empty, empty,
            np.zeros((1, 1, 3)), none, np.zeros((1, 1, r, 0)),
        ))

    plain, order = units(C), rng.permutation(r)
    other = units(C[order])
    assert plain.outputs[0] == other.outputs[0] == 1.0
    common = other.states / plain.states
    np.testing.assert_allclose(common, common[0])
    np.testing.assert_allclose(other.equations, common[0] * plain.equations)
    np.testing.assert_allclose(other.outputs, common[0] * plain.outputs[order])


def test_no_piece_between_jumps_goes_unprobed():
    """A rank may be lost in one of many short pieces alone."""
    plant = plant_from_mapping(one_state(A=[["sign(sin(150*t)) - 2"]]))
    pieces = np.arange(int(20.0 * 150.0 / np.pi) + 1) * np.pi / 150.0
    probed = np.searchsorted(pieces, _probe_times(plant, 0.0, 20.0))
    assert np.unique(probed).tolist() == list(range(1, len(pieces) + 1))
    late = _probe_times(plant, 7.0, 8.0)
    assert 7.0 < late.min() < 7.01
    assert 7.99 < late.max() < 8.0


@pytest.mark.parametrize(("E", "A", "message"), [
    # Zero at the first probe alone, where of six equations five are left.
    ([[1, 0], [0, "t - 1e-3"]], [[-1, 1], [1, -1]], r"from 5 at t = 0\.001 to 6 at t = 0\.01"),
    ([["exp(680*t)", 0], [0, 0]], [["exp(-680*t)", 1], ["exp(680*t)", 0]], "than numbers hold"),
])
def test_why_a_structure_cannot_be_told(E, A, message):
    plant = plant_from_mapping({
        "name": "p", "states": ["a", "b"], "E": E, "A": A, "initial_state": [1, 1],
    })
    with pytest.raises(ModelError, match=message):
        analyse(plant, 0.0, 1.0, max_mu=2, rank_tol=1e-10)


@pytest.mark.parametrize("solver", ["collocation", "ivp"])
@pytest.mark.parametrize("row", [1.0, 4.0, 1e7])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_start_keeps_what_no_impulse_moves(sign, row, solver):
    """a' = l, b' = 3l − b, 0 = a + b: l moves a and b, 3a − b it does not, in any units."""
    plant = plant_from_mapping({
        "name": "pair", "states": ["a", "b", "l"], "E": [[row, 0, 0], [0, 1, 0], [0, 0, 0]],
        "A": [[0, 0, row], [0, -1, 3], [1, 1, 0]], "initial_state": [sign, 0, 0],
    })
    x0 = simulate(plant, TimeSettings(horizon=1.0), SolverSettings(name=solver)).initial_state
    np.testing.assert_allclose(x0, [3 * sign / 4, -3 * sign / 4, -3 * sign / 16], rtol=1e-12)


@settings(deadline=None, max_examples=15)
@given(SEEDS, st.integers(1, 3))
def test_a_run_from_the_state_before_a_jump_goes_on_as_the_run_that_jumps(seed, nu):
    """In any units of equations, states and time, which the jump does not depend on either."""
    rng = np.random.default_rng(seed)
    n = nu + 2
    E, A = np.diag([1.0] * (n - 1), 1), np.eye(n)
    E[: n - nu, : n - nu], E[n - nu - 1, n - nu] = np.eye(n - nu), 0.0
    A[: n - nu, : n - nu] = rng.normal(size=(n - nu, n - nu))
    left, right = np.eye(n) + 0.3 * rng.normal(size=(2, n, n))
    B = rng.normal(size=(n, 1))

    def found(rows, columns, time, initial, start=0.0, level="step(t - {})"):
        weight = rows[:, None] * columns
        system = plant_from_mapping({
            "name": "jumps", "states": [f"x{k}" for k in range(n)],
            "inputs": {"u": level.format(repr(time))},
            "E": (left @ E @ right * weight * time).tolist(),
            "A": (left @ A @ right * weight).tolist(), "B": (rows[:, None] * B).tolist(),
            "initial_state": (initial / columns).tolist(),
        })
        when = TimeSettings(start=start * time, horizon=(1.5 - start) * time)
        return simulate(system, when, SolverSettings()), columns

    ones = np.ones(n)
    whole, _ = found(ones, ones, 1.0, np.zeros(n))
    ((_, before, jump),) = whole.jumps
    size = np.abs(jump.after).max()
    again, _ = found(ones, ones, 1.0, before, start=1.0, level="1")
    np.testing.assert_allclose(again.initial_state, jump.after, atol=1e-8 * size)
    rows, columns = 10.0 ** rng.uniform(-6, 6, (2, n))
    time = 10.0 ** rng.uniform(-6, 6)
    other, _ = found(rows, columns, time, np.zeros(n))
    ((_, _, same),) = other.jumps
    np.testing.assert_allclose(same.after * columns, jump.after, atol=1e-7 * size)
    turned = same.impulses * columns / time ** np.arange(1.0, len(same.impulses) + 1)[:, None]
    np.testing.assert_allclose(turned, jump.impulses, atol=1e-7 * size)


@settings(max_examples=8)
@given(SEEDS, st.integers(3, 11))
def test_scales_by_entries_are_those_of_matrices_and_rounding_changes_neither(seed, n):
    """An entry of 1e-25 beside entries of one is not there."""
    rng = np.random.default_rng(seed)
    both = rng.normal(size=(2, n, n)) * (rng.random((2, n, n)) < 0.4)
    both[1, range(n), range(n)] = both[1, :, 0] = both[1, -1] = 1.0  # all of them hang together
    found = []
    for nothing in (0.0, 1e-25):
        both[:, 0, 1] = 0.0, nothing
        (E, A), none, empty = both[:, None, None], np.zeros((1, 1, n, 0)), np.zeros((1, 1, 0))
        found.append(balance(Coefficients(
            E, A, none, none, none, empty, empty, np.zeros((1, 1, n)), none, none
        )))
        places = tuple(np.argwhere(both).T)
        found.append(balance_entries(np.abs(both[places]), places, n))
    there = np.abs(both) > 1e-20
    scaled = [(both * s.rows[:, None] * s.columns / np.array([[[s.time]], [[1.0]]]))[there]
              for s in found]
    for one in scaled[1:]:  # factors are rounded to powers of two
        assert (np.abs(np.log2(one / scaled[0])) <= 1.01).all()


@settings(max_examples=20)
@given(SEEDS, st.integers(2, 30))
def test_scales_of_full_matrices_make_largest_entries_one(seed, n):
    """Of rows, of columns, and of E/τ beside A, in any units."""
    rng = np.random.default_rng(seed)
    E, A = rng.normal(size=(2, n, n))
    E[n // 2 :] = A[: n // 4] = 0.0  # rows without one of them say nothing of time
    x, of_rows, T = 10.0 ** rng.integers(-6, 7, n), 10.0 ** rng.integers(-6, 7, n), 1e3
    E, A = T * of_rows[:, None] * E / x, of_rows[:, None] * A / x
    rows, columns, time = scales_of(E, A)
    e, a = (np.abs(rows[:, None] * matrix * columns) for matrix in (E / time, A))
    for axis in (0, 1):
        np.testing.assert_allclose(np.log2(np.maximum(e, a).max(axis=axis)), 0.0, atol=1.5)
    both = slice(n // 4, n // 2)
    beside = np.median(e[both].max(axis=1) / a[both].max(axis=1))
    assert abs(np.log2(beside)) < 1.5


@pytest.mark.parametrize(("usual", "where", "rounding", "sudden"), [
    (1.0, [3], False, True), (1e-12, [3], True, True), (1.0, [1, 3, 4], True, False),
])
def test_why_a_rank_is_unclear_at_some_times(usual, where, rounding, sudden):
    """The constraint is what 1e-12 of large terms leaves: just there, or at most or all times."""
    turned = np.array([[0.8, -0.6], [0.6, 0.8]])
    row = np.tile([usual, usual], (5, 1))
    row[where] = 1e-12, 1e-15
    A = turned @ np.stack([np.ones((5, 2)), row], axis=1)
    model = np.zeros((2, 2, 5, 2, 2))
    model[0, 0], model[1, 0] = turned @ np.diag([1.0, 0.0]), A
    with pytest.raises(UnclearError) as unclear:
        in_stages(*model, np.zeros((2, 5, 2, 0)), 1e-10, 1)
    assert (unclear.value.place, unclear.value.rounding, unclear.value.sudden) == (
        where[0], rounding, sudden)


@pytest.mark.parametrize(("singular", "value"), [((2.0, 2e-3, 0.0), "1.0e-03"),
                                                 ((2.0, 2e-12, 0.0), "1.0e-12")])
def test_a_rank_that_is_another_than_at_the_reference_is_named_with_its_time(singular, value):
    """Of three, two singular values are zero at first: one of them is not, or a third one is."""
    a = 2 if value == "1.0e-03" else 1
    structure = Structure(0, a, 0, np.inf, time_invariant=False, rank_tol=1e-10)
    M = np.zeros((4, 3, 3))
    M[:, 0, 0] = 1.0
    M[:, 1, 1] = 1.0 * (structure.a == 1)
    M[2] = np.diag(singular)
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    M = 1e6 * Q @ M @ Q
    system, N = made(np.random.default_rng(0), 3, 1).system, np.broadcast_to(np.eye(3), M.shape)
    t = np.array([0.5, 1.0, 1.5, 2.0])
    said = rf"derivative array changes near t = 1\.5 \(singular value {value}\)"
    with pytest.raises(ModelError, match=said):
        _by_singular_vectors(system, structure, N, M, N, t)
    some = t != 1.5
    Z1, Z2 = _by_singular_vectors(system, structure, N[some], M[some], N[some], t[some])
    assert Z1.shape == (3, 3, 3 - structure.a)
    assert np.abs(np.swapaxes(Z2, 1, 2) @ M[some]).max() < 1e-9


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_terms_of_equations_are_the_sizes_of_what_they_are_the_sum_of(seed):
    """With large ones of either sign that cancel, at the last of each three times."""
    rng = np.random.default_rng(seed)
    A, B, F = rng.normal(size=(3, 3)), 1e6 * rng.normal(size=(3, 2)), rng.normal(size=(3, 1))
    phi, t = rng.normal(size=3), np.linspace(0.5, 2.0, 6)
    system = plant_from_mapping({
        "name": "terms", "states": ["a", "b", "c"], "inputs": {"u": "1 + t", "v": "cos(t)"},
        "E": np.diag([1, -2, 4]).tolist(), "A": [[f"({x})*t" for x in row] for row in A.tolist()],
        "B": B.tolist(), "F": F.tolist(), "unknowns": {"w": -3.0}, "phi": phi.tolist(),
        "initial_state": [0, 0, 0],
    })
    structure = analyse(system, 0.0, 2.0, max_mu=2, rank_tol=1e-10)
    form = strangeness_free_form(system, structure, t, t, points=3)
    t = t[2::3, None, None]
    signals = np.abs(np.concatenate([1.0 + t, np.cos(t)], axis=1))
    known = np.abs(B) @ signals + 3.0 * np.abs(F) + np.abs(phi)[:, None]
    rows = np.abs(np.broadcast_to(form.E1, (6, 3, 3))[2::3]) / [1, 2, 4]
    sizes = np.concatenate([np.abs(A) * t, known], axis=2)
    np.testing.assert_allclose(form.terms, rows @ sizes, rtol=1e-12)


@pytest.mark.parametrize("unit", [1.0, 1e3])
@pytest.mark.parametrize("moves", ["", "*(sin(t)**2 + cos(t)**2)", "*(1 + t/{})"])
@pytest.mark.parametrize("fast", [3.0, 1e5])
def test_rates_of_the_differential_part_are_those_of_the_plant(fast, moves, unit):
    """Index 3 in turned rows and states, by the derivative array or one stage after the other."""
    rng = np.random.default_rng(1)
    P, Q = (np.linalg.qr(rng.normal(size=(5, 5)))[0] for _ in "PQ")
    E, A = np.diag([1.0, 1, 0, 0, 0]), np.diag([-fast, 0.7, 1, 1, 1])
    E[2, 3] = E[3, 4] = 1.0
    moves = moves.format(100.0 * unit)
    structure = analyse(plant_from_mapping({
        "name": "turned", "states": list("abcmn"), "E": (unit * P @ E @ Q).tolist(),
        "A": [[f"{x!r}{moves}" for x in row] for row in (P @ A @ Q).tolist()],
        "initial_state": [0] * 5,
    }), 0.0, unit, max_mu=4, rank_tol=1e-10)
    assert (structure.mu, structure.a, structure.d) == (2, 3, 2)
    assert (len(structure.stages) > 0) == (fast > 100.0)
    assert structure.growth * unit == pytest.approx(0.7, rel=0.011)
    assert 1.0 < structure.rate * unit / fast < 1.2
    assert structure.smallest_singular_value > 0.01
    assert structure.steady or "100" in moves


def test_singular_values_of_a_stage_are_those_of_its_matrices():
    """Of E, of orthonormal constraints, of E on their kernel; and a constraint's size."""
    E, A = np.diag([2.0, 0.5, 0.0]), np.array([[1.0, 2, 3], [4, 5, 6], [0.3, 0, 0.4]])
    found = in_stages(E[None, None], A[None, None], np.zeros((1, 1, 3, 0)), 1e-10, 1)
    kernel = np.array([[0.8, 0.0], [0.0, 1.0], [-0.6, 0.0]])
    least = np.linalg.svd(E @ kernel, compute_uv=False)[-1] / np.linalg.norm(E)
    np.testing.assert_allclose(found.smallest, [[0.25, 1.0, least, 0.5]], rtol=1e-12)
    np.testing.assert_allclose(np.abs(found.A2), [[[0.6, 0.0, 0.8]]], atol=1e-15)


def test_dust_is_what_is_far_below_the_largest_entry_of_its_matrix():
    """Singular values of what underflows beside others may have no end."""
    E = np.array([[[1.0, 1e-280], [-2.0, 0.5]], [[1e-280, -1e-290], [0.0, 1e-285]]])
    kept = np.array([[[1.0, 0.0], [-2.0, 0.5]], [[1e-280, -1e-290], [0.0, 1e-285]]])
    np.testing.assert_array_equal(_without_dust(E), kept)


def test_how_fast_coefficients_move_is_the_largest_slope_beside_its_size():
    model = np.zeros((3, 2, 4, 2, 2))
    model[:, 0], model[0, 1], model[1, 1] = 2.0, 6.0, -4.0
    assert _Rounding(*model, 1).rate == 3.0
    assert _Rounding(*model[:, :1], 1).rate == 0.0  # no slopes are known


@pytest.mark.parametrize("most", [1.0, 5.0, 1e6])
def test_constraints_at_a_time_hang_on_no_other_time(most, monkeypatch):
    """By pivots or, where these make entries grow, by singular vectors; as some or all times do."""
    monkeypatch.setattr(reductions, "MAX_GROWTH", most)
    of, structure, _ = case(2, 3, 4)
    t = np.linspace(0.0, 5.0, 9)
    c = of.system.coefficients.taylor(t, structure.mu)
    E, A, f = c.E, c.A, forcing(c)[..., None]
    whole = reductions.reduced(of.system, structure, E, A, f, t, 1)
    some = reductions.reduced(of.system, structure, E, A, f, t, 2)
    np.testing.assert_array_equal(some.size, whole.size[::2])
    for k in range(len(t)):
        at = slice(k, k + 1)
        one = reductions.reduced(
            of.system, structure, E[:, at], A[:, at], f[:, at], t[at], 1
        )
        for all_of_them, alone in zip(whole, one, strict=True):
            np.testing.assert_allclose(all_of_them[at], alone, rtol=1e-9, atol=1e-12)


def test_rounding_at_some_of_the_times_stands_for_that_at_all():
    """At every second of four: the largest of theirs, and lost is what is lost at one of them."""
    rng = np.random.default_rng(0)
    sizes = np.array([1.0, 1e9, 30.0, 1e9])[:, None, None]
    E, A, f = (rng.normal(size=(2, 4, 3, k)) * sizes for k in (3, 3, 1))
    shapes = (4, 2, 3), (4, 1, 3), (4, 1, 1), (4, 3, 2), (2, 4, 1, 2), (2, 4, 2, 3)
    *factors, mass = (rng.normal(size=shape) for shape in shapes)
    for terms, lost in ((1.0, False), (1e16 * (sizes == 30.0), True)):
        each, some = _Rounding(E, A, f, 1), _Rounding(E, A, f, 2)
        for one in (each, some):
            one.of_constraints((*factors, mass, mass * terms), [])
        np.testing.assert_allclose(some.noise, each.noise[::2].max(), rtol=1e-12)
        assert some.lost.tolist() == [lost]
        assert each.lost[2] == lost


@pytest.mark.parametrize(("values", "steady", "dips"), [
    ([1.0, 0.5, 0.3, 0.5, 1.0], True, []),  # far above zero,
    ([1.0, 0.5, 0.05, 0.5, 1.0], False, [2]),  # and not, between the ends:
    ([1.0, 0.03, 0.02, 0.03, 0.05, 0.04, 1.0], False, [5, 2]),  # the sharpest one first
    ([1.0, 0.5, 0.2, 0.1, 0.05], True, [4]),  # towards an end,
    ([0.05, 0.1, 0.2, 0.5, 1.0], True, [0]),
    ([1.0, 0.5, 0.1, 0.05, 5e-3], False, [4]),  # where it is little
])
def test_dips_of_singular_values_are_local_minima_far_below_the_largest(values, steady, dips):
    """In any units, and beside columns without any, or with values that are not finite."""
    column = 3e5 * np.array(values)[:, None]
    beside = np.where(np.arange(len(values)) == 2, [[0.5], [0.01]], [[1.0], [np.inf]]).T
    found = _dips(np.hstack([beside, column]))
    assert found == (steady, [(2, k) for k in dips])


def test_what_says_against_an_index_is_named_with_its_time():
    """The singular value, and of which: dependent constraints first, then states without any."""
    t, smallest = np.array([1.0, 2.5, 4.0]), np.ones((3, 3))
    smallest[0, 0] = 0.0  # of the derivative array itself: its rank says what there is
    assert _why_not(t, smallest, 1e-10) == ""
    smallest[2, 2] = 1e-12
    assert _why_not(t, smallest, 1e-10) == (
        "some states are in no equation's derivative and in no constraint at t = 4 (singular "
        "value 1.0e-12)")
    smallest[1, 1] = 1e-11
    said = "constraints are linearly dependent at t = 2.5 (singular value 1.0e-11)"
    assert _why_not(t, smallest, 1e-10) == said


@pytest.mark.parametrize(("entry", "max_mu", "said"), [
    (-1, 0, "0 differentiations constraints are linearly dependent at t = 0.001"),
    (-1, 2, "2 differentiations 4 constraints appear for 3 states (t = 0.001)"),
    ("-1 - t", 0, "0 differentiations constraints are linearly dependent at t = 0.50"),
    ("-1 - t", 2, "2 differentiations 4 constraints appear for 3 states (t = 0.50"),  # the middle
])
def test_an_equation_that_is_there_twice_is_refused_with_what_it_leads_to(entry, max_mu, said):
    plant = plant_from_mapping({
        "name": "p", "states": ["a", "b", "c"], "E": np.diag([1, 0, 0]).tolist(),
        "A": [[entry, 1, 1], [0, 1, 1], [0, 1, 1]], "initial_state": [1, 1, 1],
    })
    with refused(said, by=ModelError):
        analyse(plant, 0.0, 1.0, max_mu=max_mu, rank_tol=1e-10)


def test_a_determinant_that_changes_its_sign_between_two_times_is_refused_where_it_is_zero():
    plant = plant_from_mapping(one_state(E=[["(t - 0.3712)*(1 + t)"]]))
    t = np.array([0.1, 0.2, 0.7, 0.9])
    E = plant.coefficients.taylor(t, 0).E[0]
    with refused("differential part changes at t = 0.3712 (det E changes its sign)", by=ModelError):
        _refuse_crossing(plant, t, E)
    _refuse_crossing(plant, t[2:], E[2:])


def test_equations_that_leave_a_state_open_are_refused_with_the_first_time():
    plant, t = plant_from_mapping(one_state()), np.array([0.5, 1.25, 2.0])
    said = "plant p: the equations do not determine the state near t = 1.25"
    with refused(said, by=ModelError):
        _refuse_undetermined(plant, np.array([False, True, True]), t)


def test_rounding_that_constraints_show_is_some_digits_of_states_in_any_units():
    """Equations times factors keep their solutions, which miss them by rounding alone."""
    content, found = random_system(3)[0], []
    by = drawn(np.random.default_rng(5), plant_from_mapping(content), decades=True)
    for units in (Units(*map(np.ones_like, by[:-1]), 1.0), by):
        system, T = plant_from_mapping(in_units(content, units)), float(units.time)
        run = simulate(system, TimeSettings(horizon=T), SolverSettings())
        mesh, x = run.signals.states.mesh, run.signals.states.values[:, -1] / units.states
        found.append(reductions.shown_rounding(
            system, run.structure, mesh.points[:, -1], mesh.inside[:, -1],
            (x * units.states)[..., None],
        )[:, 0] / np.abs(units.states) / np.abs(x).max())
    assert (found[0] < 3e-14).all()
    seen = found[0] > 1e-17
    assert seen.sum() >= 3
    np.testing.assert_allclose(np.log10(found[1][seen]), np.log10(found[0][seen]), atol=1.0)
