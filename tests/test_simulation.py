"""Simulation: structure, consistent starts, jumps, references, honesty of the error estimate."""

from __future__ import annotations

import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_paths import by_both
from plants import one_state, reference, shipped
from processes import refused
from scipy.integrate import solve_ivp
from scipy.optimize import OptimizeResult
from scipy.special import beta

from gpebo_cli import GpeboError, run
from gpebo_cli.errors import ModelError, SolverError
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics import collocation
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.refinement import RoundingError
from gpebo_cli.reduction import structure
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation import ivp
from gpebo_cli.simulation.known import few_elements, known_resolved
from gpebo_cli.simulation.large import dense_structure
from gpebo_cli.simulation.simulate import _growth_resolved, _missed, simulate

SOLVER = SolverSettings()


def plant(**mapping):
    mapping.setdefault("name", "p")
    return plant_from_mapping(mapping, "p.yaml")


@pytest.mark.parametrize("name", ["circuit", "descriptor", "canonical"])
def test_states_match_the_reference(name):
    expected = reference(name)
    system = shipped(name)
    result = simulate(system, TimeSettings(), SOLVER)
    assert result.structure.index == expected["index"]
    np.testing.assert_allclose(
        result.initial_state, expected["consistent_initial_state"], atol=1e-12
    )
    t = np.array([row["t"] for row in expected["at"]])
    x = np.array([row["x"] for row in expected["at"]])
    error = np.abs(result.signals.states(t) - x)
    assert error.max() < 1e-10
    assert error.max() <= 10 * SOLVER.tol * np.abs(x).max()


def test_only_the_inconsistent_state_of_the_circuit_moves():
    system = shipped("circuit")
    result = simulate(system, TimeSettings(horizon=1.0), SOLVER)
    moved = dict(zip(system.states, result.initial_state - system.initial_state, strict=True))
    assert moved.pop("iv") == pytest.approx(-3.2, abs=1e-12)
    assert max(map(abs, moved.values())) < 1e-12


@pytest.mark.parametrize(("E", "A", "start", "consistent"), [
    # 0 = x1 + x2 − x3: only x3 may move, whatever was asked for.
    ([1, 4, 0], [[-1, 0, 0], [0, -1, 0], [1, 1, -1]], [1, 2, 50], [1, 2, 3]),
    # 0 = x1 − x2 ties two differential states: x1 + 2 x2 does not change.
    ([1, 2, 0], [[0, 0, 1], [0, 0, -1], [1, -1, 0]], [0, 5, 0], [10 / 3, 10 / 3]),
])
def test_a_consistent_start_keeps_what_may_be_kept(E, A, start, consistent):
    system = plant(states=["x1", "x2", "x3"], E=np.diag(E).tolist(), A=A, initial_state=start)
    result = simulate(system, TimeSettings(horizon=1.0), SOLVER)
    np.testing.assert_allclose(result.initial_state[: len(consistent)], consistent, atol=1e-12)


SCALES = [1.0, 1e-6, 1e6]


@pytest.mark.parametrize("farad", SCALES)
@pytest.mark.parametrize("ohm", SCALES)
def test_units_do_not_change_the_structure(farad, ohm):
    """An RC circuit behind an ideal source, index 2, in any units."""
    system = plant(
        states=["v", "i"],
        inputs={"V": "sin(t)"},
        E=[[farad, 0], [0, 0]],
        A=[[-1 / ohm, 1], [-1, 0]],
        B=[[0], [1]],
        initial_state=[0, 0],
    )
    result = simulate(system, TimeSettings(horizon=3.0), SOLVER)
    assert (result.structure.index, result.structure.d) == (2, 0)
    t = np.linspace(0, 3, 50)
    truth = np.stack([np.sin(t), farad * np.cos(t) + np.sin(t) / ohm], axis=1)
    error = np.abs(result.signals.states(t) - truth) / np.abs(truth).max(axis=0)
    assert error.max() < 1e-10


def test_an_explicit_ode_has_index_zero():
    system = plant(states=["x"], E=[["2 + t"]], A=[[-1]], initial_state=[1])
    result = simulate(system, TimeSettings(horizon=2.0), SOLVER)
    assert result.structure.index == 0
    assert result.signals.states(np.array([2.0]))[0, 0] == pytest.approx(0.5, abs=1e-12)


def test_pivots_of_one_time_may_vanish_at_others():
    """(max(0, t − 1) + max(0, 3.5 − t)) a' = −a, b = a; the second factor of E is the pivot."""
    E = [["max(0, t - 1)", "max(0, 3.5 - t)"], [0, 0]]

    def final():
        system = plant(states=["a", "b"], E=E, A=[[-1, 0], [1, -1]], initial_state=[1, 1])
        return simulate(system, TimeSettings(horizon=4.0), SOLVER).signals.states.final

    for found in by_both(final):
        np.testing.assert_allclose(found, 2.5 / 3.5 * np.exp(-1.0) * 2.5 / 3.0, rtol=1e-9)


def test_a_constant_singular_value_that_is_rounding_leaves_a_constraint():
    """What elimination leaves of E is nothing by its rank: 0 = 2 a − 3 b + u and s = a + b."""
    system = plant(
        states=["a", "b"], inputs={"u": "sin(t)"}, E=[[1, 1], [1, 1 + 1e-11]],
        A=[[-1, 1], [1, -2]], B=[[0], [1]], initial_state=[1, 1],
    )
    result, t = simulate(system, TimeSettings(horizon=2.0), SOLVER), np.linspace(0.0, 2.0, 21)
    found = result.signals.states(t)
    whole = 2.48 / 1.04 * np.exp(-0.2 * t) + 0.4 * (0.2 * np.sin(t) - np.cos(t)) / 1.04
    truth = np.stack([(3 * whole - np.sin(t)) / 5, (2 * whole + np.sin(t)) / 5], axis=1)
    np.testing.assert_allclose(found, truth, rtol=1e-8)


@pytest.mark.parametrize("where", [0.3712, 0.5001, 0.50003, 0.7, 0.123456, 0.0011, 0.9989])
def test_a_rank_drop_is_found_wherever_the_probes_happen_to_be(where):
    """A probe next to the zero may lie lower than all times of the first closer look."""
    row = [0, f"t - {where}"]
    for of, E, A in (
        ("derivative array", [[1, 0], row], [[-1, 0], [0, -1]]),
        ("constraints", [[1, 0], [0, 0]], [[-1, 0], row]),
    ):
        singular = plant(states=["a", "b"], E=E, A=A, initial_state=[1, 1])
        said = rf"rank of the {of} changes at t = ([\d.]+) "
        with pytest.raises(ModelError, match=said) as refusal:
            simulate(singular, TimeSettings(horizon=1.0), SOLVER)
        told = float(re.search(said, str(refusal.value))[1])
        assert told == pytest.approx(where, abs=1e-8)


def test_a_derivative_array_that_vanishes_at_the_start_is_told_as_such():
    E, A = [["t", 0], [0, 0]], [[-1, 1], [1, 2]]
    singular = plant(states=["a", "b"], E=E, A=A, initial_state=[1, 0])
    said = r"rank of the derivative array changes near t = 0 \(singular value 0.0e\+00\)"
    with pytest.raises(ModelError, match=said):
        simulate(singular, TimeSettings(horizon=1.0), SOLVER)


@pytest.mark.parametrize("bottom", [2e-10, 0.0])
def test_singular_values_that_are_small_everywhere_are_followed_to_the_bottom(bottom):
    """Of many hidden constraints in units far apart they are 5e-8 at most: 2e-10 is no zero."""

    def values(t):
        return np.stack([np.ones_like(t), bottom + 1e-7 * np.abs(t - 0.3712), np.ones_like(t)], -1)

    def lines(t, column):
        return values(t).reshape(-1, structure._DIP_POINTS, 3)[range(len(column)), :, column]

    t = np.linspace(0.0, 1.0, 65)
    one = plant(states=["a"], E=[[1]], A=[["sin(t)"]], initial_state=[1])
    changes = partial(structure._rank_changes, one)
    if bottom:
        assert not structure.follow_dips(t, values(t), 1e-10, lines, changes)
    else:
        with pytest.raises(ModelError, match=r"rank of the constraints changes at t = 0\.371"):
            structure.follow_dips(t, values(t), 1e-10, lines, changes)


def test_a_rank_drop_is_found_beside_a_fast_rate():
    """Where the derivative array tells nothing clear, it is differentiated once at a time."""
    singular = plant(
        states=["a", "b", "c"], inputs={"u": "sin(t)"}, E=np.diag([1, 1, 0]).tolist(),
        A=[[-1e5, 1, 0.3], [0.2, -1, 1], [0, "t - 0.3712", 0]], B=[[1]] * 3, initial_state=[0] * 3,
    )
    with pytest.raises(ModelError, match=r"rank of the constraints changes at t = 0\.3712 "):
        simulate(singular, TimeSettings(horizon=2.0), SOLVER)


def test_a_rank_drop_between_two_breakpoints_that_no_other_probe_sees_is_found():
    """The longest piece in which no probe would be otherwise; E is 0 in it."""
    places = structure._PLACES
    k = int(np.argmax(np.diff(places)))
    a, b = (places[k] + share * (places[k + 1] - places[k]) for share in (0.05, 0.95))
    off = f"step(t - {float(a)}) - step(t - {float(b)})"
    singular = plant(states=["x"], E=[[f"1 - ({off})"]], A=[[-1]], initial_state=[1])
    with pytest.raises(ModelError, match=r"a rank changes near t = ") as refusal:
        simulate(singular, TimeSettings(horizon=1.0), SOLVER)
    named = float(re.search(r"t = ([\d.]+);", str(refusal.value))[1])
    assert named == pytest.approx(a, abs=1e-9)  # the jump, and not the probe behind it


def _pulsed(bottom, width=3e-4):
    """1, and in one of many pulses ``bottom``; where that is negative, it is zero there twice."""
    centres = [0.5 + 0.373 * k for k in range(25)]
    sizes = [1 - bottom if k == 6 else 0.4 for k in range(25)]
    pulses = "".join(
        f" - {size!r}*exp(-((t - {c!r})/{width!r})**2)"
        for c, size in zip(centres, sizes, strict=True)
    )
    there = centres[6] + width * np.sqrt(np.log(2.0)) * np.array([-1, 1]) if bottom == -1 else None
    return f"(1{pulses})", there


def _turned(g, index):
    """A chain of this index in turned states, one coupling of which is g; solution sin t, cos t."""
    E, A = (np.zeros((4, 4), dtype=object) for _ in range(2))
    A[0, 0], E[0, 0] = "-1", "1"
    for k in range(1, index):
        E[k, k], A[k, k + 1] = "1", "1"
    A[index, 1] = g
    for k in range(index + 1, 4):
        A[k, k] = "1"
    c, s = "cos(0.7*t + 1)", "sin(0.7*t + 1)"
    # z = Q x turns states 0 and the last one of the chain; x' enters as Q x' + Q' x.
    Q, slope = np.where(np.eye(4) == 1, "1", "0").astype(object), np.zeros((4, 4), dtype=object)
    ends = np.ix_([0, index], [0, index])
    Q[ends] = [[c, s], [f"-{s}", c]]
    slope[ends] = [[f"-0.7*{s}", f"0.7*{c}"], [f"-0.7*{c}", f"-0.7*{s}"]]

    def product(a, b):
        return [["+".join(f"({p})*({q})" for p, q in zip(row, column, strict=True)
                          if str(p) != "0" and str(q) != "0") or "0" for column in b.T]
                for row in a]

    AQ, EQ = product(A, Q), product(E, slope)
    return plant(
        states=["p", "q", "v", "w"], inputs={"u": "sin(t)"}, outputs=["y"],
        E=product(E, Q), A=[[f"({x}) - ({y})" for x, y in zip(*rows, strict=True)]
                            for rows in zip(AQ, EQ, strict=True)],
        B=[["-" + g if k == index else "1" if k == 0 else "0"] for k in range(4)],
        C=[[1, 0, 0, 0]], initial_state=[0] * 4,
    )


@pytest.mark.parametrize("index", [1, 2, 3])
def test_a_rank_that_changes_within_one_of_many_pulses_is_named_with_its_time(index):
    """Other pulses have dips of their own, and fast entries stand beside those that vanish."""
    g, zeros = _pulsed(-1)
    with pytest.raises(ModelError, match=r"rank .*changes (at|near) t = ") as refusal:
        simulate(_turned(g, index), TimeSettings(horizon=10.0), SOLVER)
    told = float(re.search(r"t = ([\d.]+)[ ;]", str(refusal.value))[1])
    assert np.abs(told - zeros).min() < 1e-4


@pytest.mark.parametrize("index", [1, 2, 3])
def test_pulses_without_a_rank_change_are_no_reason_to_refuse(index):
    """Derivatives of g are 1e10 beside g, but only in what earlier constraints say already."""
    g, _ = _pulsed(0.2, 1e-4)
    found = simulate(_turned(g, index), TimeSettings(horizon=10.0), SOLVER)
    t = np.linspace(0.0, 10.0, 1001)
    x = found.signals.states(t)
    z = x.copy()
    c, s = np.cos(0.7 * t + 1), np.sin(0.7 * t + 1)
    z[:, 0], z[:, index] = c * x[:, 0] + s * x[:, index], c * x[:, index] - s * x[:, 0]
    exact = [np.sin(t), np.cos(t), -np.sin(t)][:index]
    np.testing.assert_allclose(z[:, 1 : index + 1], np.transpose(exact), atol=1e-7)


def test_index_above_the_limit_is_refused():
    n = 6  # a chain of 6: index 6
    E = [[1 if j == i + 1 else 0 for j in range(n)] for i in range(n)]
    A = [[1 if i == j else 0 for j in range(n)] for i in range(n)]
    chain = plant(
        states=[f"x{i}" for i in range(n)], inputs={"u": "sin(t)"}, E=E, A=A,
        B=[[0]] * (n - 1) + [[1]], initial_state=[0] * n,
    )
    solved = simulate(chain, TimeSettings(horizon=1.0), SolverSettings(max_strangeness_index=5))
    assert solved.structure.index == 6
    assert not solved.structure.stages  # the derivative array says so: the limit itself will do
    with pytest.raises(ModelError, match=r"solver\.max_strangeness_index = 3; .* raise that to 5"):
        simulate(chain, TimeSettings(horizon=1.0), SolverSettings(max_strangeness_index=3))


# --- jumps ----------------------------------------------------------------------------------


def test_a_step_of_the_input_of_an_ode():
    system = plant(
        states=["x"], inputs={"u": "step(t - 0.7)"}, E=[[1]], A=[[-1]], B=[[1]], initial_state=[0]
    )
    result = simulate(system, TimeSettings(horizon=2.0), SOLVER)
    t = np.linspace(0, 2, 401)
    truth = np.where(t >= 0.7, 1 - np.exp(-(t - 0.7)), 0.0)
    np.testing.assert_allclose(result.signals.states(t)[:, 0], truth, atol=1e-12)
    np.testing.assert_allclose(result.signals.inputs(t)[:, 0], t >= 0.7, atol=1e-14)


def test_a_step_through_a_constraint_restarts_the_algebraic_part_only():
    """x' = z, 0 = x + z − u: z jumps with u, x does not."""
    system = plant(
        states=["x", "z"], inputs={"u": "1 + 2*step(t - 1)"}, E=[[1, 0], [0, 0]],
        A=[[0, 1], [-1, -1]], B=[[0], [1]], initial_state=[0, 1],
    )
    result = simulate(system, TimeSettings(horizon=2.0), SOLVER)
    (when, before, jump), = result.jumps
    assert when == 1.0
    assert jump.after - before == pytest.approx([0.0, 2.0], abs=1e-12)
    assert not jump.impulses.any()


def behind(E, A, B, start, u):
    """A plant behind an input u."""
    states = [f"x{k + 1}" for k in range(len(start))]
    system = plant(states=states, inputs={"u": u}, E=E, A=A, B=B, initial_state=start)
    return simulate(system, TimeSettings(horizon=2.0), SolverSettings(tol=1e-9))


def test_an_impulse_that_drives_a_differential_state_moves_it():
    """x1' = x3, x2' = 2 x3, 0 = x1 − u: a step of u moves x2 by twice as much.

    Keeping E x as near as possible would leave x2 where it is. Checked against smooth
    approximations of the step, whose solutions converge to this one.
    """
    E, A = np.diag([1, 1, 0]).tolist(), [[0, 0, 1], [0, "-t", 2], [1, 0, 0]]
    after = partial(behind, E, A, [[0], [0], [-1]], [0, 1, 0])
    exact = after("step(t - 1)")
    (_, before, jump), = exact.jumps
    assert jump.after - before == pytest.approx([1.0, 2.0, 0.0], abs=1e-9)
    assert jump.impulses[0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    end = np.array([2.0])
    for width, bound in ((0.05, 0.06), (0.005, 0.006)):
        smooth = after(f"0.5 + 0.5*tanh((t - 1)/{width})")
        difference = smooth.signals.states(end)[0, 1] - exact.signals.states(end)[0, 1]
        assert abs(difference) < bound


def test_a_jump_of_the_third_order():
    """Index 3 chain with time-varying coefficients, step input: distributional solution."""
    # 0 = x1 − u, x1' (1 + t) = x2, x2' = x3 + x4', written without x4: E rows below.
    system = plant(
        states=["x1", "x2", "x3", "x4"], inputs={"u": "step(t - 1)"},
        E=[[0, 0, 0, 0], ["1 + t", 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
        A=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 1, 0]],
        B=[[-1], [0], [0], [0]], initial_state=[0, 0, 0, 0],
    )
    # x2 = (1 + t) δ(t − 1) = 2 δ, x3 = 2 δ', so x4' = 2 δ + 2 δ': x4 jumps by 2 (and has 2 δ).
    result = simulate(system, TimeSettings(horizon=2.0), SOLVER)
    (_, before, jump), = result.jumps
    assert jump.after - before == pytest.approx([1.0, 0.0, 0.0, 2.0], abs=1e-9)
    assert jump.impulses[0] == pytest.approx([0.0, 2.0, 0.0, 2.0], abs=1e-9)
    assert jump.impulses[1] == pytest.approx([0.0, 0.0, 2.0, 0.0], abs=1e-9)


def test_a_coefficient_that_moves_while_an_impulse_passes():
    """(1 + t) δ'(t − 1) = 2 δ' − δ: the derivative of the coefficient makes an impulse of its own.

    0 = x1 − u, x1' = x2, (1 + t) x2' = x3, x4' = x3, u a unit step at 1: x4 = ∫(1 + t) u'' falls
    by 1, for any rise of u from 0 to 1, however smooth.
    """
    E = [[0, 0, 0, 0], [1, 0, 0, 0], [0, "1 + t", 0, 0], [0, 0, 0, 1]]
    A = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 0]]
    after = partial(behind, E, A, [[-1], [0], [0], [0]], [0, 0, 0, 0])
    exact = after("step(t - 1)")
    ((_, before, jump),) = exact.jumps
    assert jump.after - before == pytest.approx([1.0, 0.0, 0.0, -1.0], abs=1e-9)
    assert jump.impulses[0] == pytest.approx([0.0, 1.0, -1.0, 2.0], abs=1e-9)
    assert jump.impulses[1] == pytest.approx([0.0, 0.0, 2.0, 0.0], abs=1e-9)
    smooth = after("0.5 + 0.5*tanh(20*(t - 1))")
    end = np.array([2.0])
    assert smooth.signals.states(end)[0, 3] == pytest.approx(-1.0, abs=1e-6)


def test_a_switch_in_A_is_an_element_boundary():
    system = plant(
        states=["x"], E=[[1]], A=[["-1 - 3*step(t - 0.5)"]], initial_state=[1]
    )
    result = simulate(system, TimeSettings(horizon=1.0), SOLVER)
    end = result.signals.states(np.array([1.0]))[0, 0]
    assert end == pytest.approx(np.exp(-0.5 - 2.0), abs=1e-13)


def test_A_that_jumps_where_the_state_has_an_impulse_is_refused():
    """0 = x1 − u and x1' = a x2: a step of u makes an impulse of x2, by which a is multiplied."""
    system = plant(
        states=["x1", "x2"], inputs={"u": "step(t - 1)"}, E=[[0, 0], [1, 0]],
        A=[[1, 0], [0, "1 + step(t - 1)"]], B=[[-1], [0]], initial_state=[0, 0],
    )
    with pytest.raises(ModelError, match=r"A jumps at t = 1 where the state has an impulse"):
        simulate(system, TimeSettings(horizon=2.0), SOLVER)


@pytest.mark.parametrize("size", [1.0, 1e12])
def test_a_jump_that_is_large_hides_no_impulse_beside_it(size):
    """x1' = x3, x2' = 2 x3, 0 = x1 − u; of w, which follows another input, they know nothing."""
    system = plant(
        states=["x1", "x2", "x3", "w"], inputs={"u": "step(t - 1)", "v": f"{size}*step(t - 1)"},
        E=np.diag([1, 1, 0, 0]).tolist(),
        A=[[0, 0, 1, 0], [0, 0, 2, 0], [1, 0, 0, 0], [0, 0, 0, 1]],
        B=[[0, 0], [0, 0], [-1, 0], [0, -1]], initial_state=[0] * 4,
    )
    ((_, _, jump),) = simulate(system, TimeSettings(horizon=2.0), SOLVER).jumps
    np.testing.assert_allclose(jump.after, [1, 2, 0, size], atol=1e-12)
    np.testing.assert_allclose(jump.impulses, [[0, 0, 1, 0]], atol=1e-12)


@pytest.mark.parametrize(("seed", "slow"), [
    (5, 3), (8, 3), (59, 3), (117, 3), (70, 4), (105, 5), (122, 7),
])
def test_what_constraints_make_zero_has_no_impulse(seed, slow):
    """N x' = x is zero; mixed with other states, in all equations, it is their rounding."""
    rng, n = np.random.default_rng(seed), slow + 2
    left, right = np.eye(n), np.eye(n)
    for mixed in (left, right):
        for _ in range(2 * n):
            i, j = rng.choice(n, 2, replace=False)
            mixed[i] += rng.choice([-1.0, 1.0, 0.5]) * mixed[j]
    E, A = np.diag([1.0] * slow + [0.0, 0.0]), np.eye(n)
    E[slow, slow + 1], A[:slow, :slow] = 1.0, np.diag(-rng.integers(1, 9, slow) / 4)
    start = np.append(rng.integers(-3, 4, slow), [0, 0])
    system = plant(
        states=[f"x{k}" for k in range(n)], inputs={"u": "sin(t) + step(t - 1)*(t - 1)"},
        E=left @ E @ right, A=left @ A @ right, B=left[:, :slow].sum(axis=1, keepdims=True),
        initial_state=np.linalg.solve(right, start).tolist(),
    )
    ((_, _, jump),) = simulate(system, TimeSettings(horizon=2.0), SOLVER).jumps
    assert not jump.impulses.any()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_jump_whose_equations_stay_unsolved_is_refused(sign, monkeypatch):
    system = plant(states=["x", "z"], inputs={"u": f"1 + {2 * sign}*step(t - 1.5)"},
                   E=[[1, 0], [0, 0]], A=[[0, 1], [-1, -1]], B=[[0], [1]], initial_state=[0, 1])
    whole = np.linalg.pinv  # which finds the units of the plant, too
    monkeypatch.setattr("numpy.linalg.pinv", lambda A, rcond, hermitian=False: (
        whole(A, rcond=rcond, hermitian=True) if hermitian else np.zeros(A.shape[::-1])))
    said = r"the jump at t = 1\.5 has no solution \(residual 1\.0e\+00\)"  # 2 beside a state of 2
    with pytest.raises(ModelError, match=said):
        simulate(system, TimeSettings(horizon=2.0), SOLVER)


def test_a_start_without_finite_numbers_is_refused(monkeypatch):
    where = "gpebo_cli.simulation.simulate.consistent_state"
    monkeypatch.setattr(where, lambda form, x0, weights: np.full(len(x0), np.nan))
    with pytest.raises(ModelError, match="plant p: no finite consistent state at the start"):
        simulate(plant(states=["x"], E=[[1]], A=[[-1]], initial_state=[1]), TimeSettings(), SOLVER)


def test_E_that_jumps_where_the_state_jumps_is_refused():
    system = plant(
        states=["v", "i"], inputs={"V": "step(t - 1)"},
        E=[["1 + step(t - 1)", 0], [0, 0]], A=[[0, 1], [-1, 0]], B=[[0], [1]],
        initial_state=[0, 0],
    )
    with pytest.raises(ModelError, match="E jumps at t = 1"):
        simulate(system, TimeSettings(horizon=2.0), SOLVER)


@pytest.mark.parametrize(("text", "power", "within"), [
    ("abs(sin(3*t))", 1.0, 1e-11), ("sqrt(abs(sin(3*t)))", 0.5, 1e-8),
])  # fmt: skip
def test_a_kink_costs_no_accuracy(text, power, within):
    system = plant(states=["x"], inputs={"u": text}, E=[[1]], A=[[0]], B=[[1]], initial_state=[0])
    result = simulate(system, TimeSettings(horizon=np.pi), SOLVER)
    truth = beta((power + 1) / 2, 0.5)  # ∫ sin^r over half a wave, three of them at three times
    assert result.signals.states(np.array([np.pi]))[0, 0] == pytest.approx(truth, abs=within)


@pytest.mark.parametrize(("text", "power", "within"), [
    ("max(sin(4.7*t + 6), 0)**1.2", 1.2, 1e-12), ("sqrt(max(sin(4.7*t + 6), 0))", 0.5, 1e-10),
    ("sqrt(abs(sin(4.7*t + 6))) + 2.2*sign(sin(2.8*t + 3*cos(4.1*t + 2.8)))", None, 3e-13),
])  # fmt: skip
def test_inputs_may_begin_like_a_root(text, power, within):
    """They were refused, or took 200,000 elements; short elements had one another's length."""
    def integral(u):
        data = {"states": ["x"], "E": [[1]], "A": [[0]], "B": [[1]], "initial_state": [0]}
        system = plant(inputs={"u": u}, **data)
        return simulate(system, TimeSettings(horizon=10.0), SolverSettings())

    found = integral(text)
    zeros = (np.arange(2, 17) * np.pi - 6) / 4.7
    x = found.signals.states(zeros)[:, 0]
    if power is None:
        other = integral("2.2" + text.split("2.2", 1)[1])
        x = x - other.signals.states(zeros)[:, 0]
    arch = beta(0.5 * (power or 0.5) + 0.5, 0.5) / 4.7
    want = np.full(14, arch) if power is None else arch * (np.arange(14) % 2 == 0)
    error = np.abs(np.diff(x) - want).max() / np.abs(x).max()
    assert error < 10 * found.error_estimate + 1e-14
    assert error < within
    assert found.signals.mesh.size < 2_000


@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("name", ["circuit", "descriptor", "canonical"])
def test_true_error_is_within_ten_tolerances_and_ten_estimates(name, tol):
    system = shipped(name)
    best = simulate(system, TimeSettings(), SolverSettings(tol=1e-13, stages=12))
    result = simulate(system, TimeSettings(), SolverSettings(tol=tol))
    t = np.linspace(0, 20, 1501)
    truth = best.signals.states(t)
    size = np.maximum(np.abs(truth).max(axis=0), 1e-3 * np.abs(truth).max())
    error = (np.abs(result.signals.states(t) - truth) / size).max()
    assert error <= max(10 * tol, 2e-13)
    assert error <= 10 * result.error_estimate


@pytest.mark.parametrize("rate", [-1.0, 1.0, 2.0])
def test_the_independent_path_knows_how_far_its_errors_have_grown(rate):
    plant = one_state(
        inputs={"u": f"cos(t) - ({rate})*sin(t)"}, A=[[rate]], B=[[1]], initial_state=[0]
    )
    found = run(plant, time={"horizon": 9, "samples": 91}, solver="ivp",
                observer="none").details.simulation
    error = np.abs(found.states[:, 0] - np.sin(found.t)).max()
    assert error <= 3.0 * found.error_estimate
    assert found.error_estimate <= max(1e-6, 1e3 * error)


def test_an_independent_integration_of_the_hand_reduced_circuit():
    """e1 = −V is algebraic; e2 and il are a plain ODE that a student would write down."""

    def rhs(t, x):
        V, C2, L = 4 * np.cos(2 * t) * np.sin(t / 5), 2 - np.cos(2 * t), 2 - np.exp(-t)
        e1, R1 = -V, -(4 + 2 * np.sin(t))
        ir1 = (e1 - x[0]) / R1
        return [
            (-2 * np.sin(2 * t) * x[0] - x[1] - ir1) / C2,
            (x[0] - np.exp(-t) * x[1]) / L,
        ]

    t = np.linspace(0, 20, 301)
    truth = solve_ivp(rhs, (0, 20), [1, 2], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t).y.T
    ours = simulate(shipped("circuit"), TimeSettings(), SOLVER).signals.states(t)
    np.testing.assert_allclose(ours[:, 1:3], truth, atol=1e-10)


def test_start_need_not_be_zero():
    system = plant(
        states=["x"], inputs={"u": "cos(t)"}, E=[[1]], A=[[0]], B=[[1]], initial_state=["sin(3)"]
    )
    result = simulate(system, TimeSettings(start=3.0, horizon=5.0), SOLVER)
    t = np.linspace(3, 8, 77)
    np.testing.assert_allclose(result.signals.states(t)[:, 0], np.sin(t), atol=1e-12)


@settings(deadline=None, max_examples=12)
@given(
    st.sampled_from([1e6, 1e9, 1.7e9, -1e9]), st.floats(0.5, 100.0), st.floats(1.0, 3000.0),
    st.sampled_from(["sin({w}*{t})", "sign(sin({w}*{t}))", "exp(-(({t} - 1.3)*{w})**2)"]),
)
def test_a_start_far_from_zero_changes_no_more_than_times_are_rounded(start, w, rate, text):
    """Refused before, or 15,000 elements, some of them of no length."""
    def told(t):
        hidden = int(text.startswith("sin("))  # its derivative is asked for, too
        system = plant(
            states=["x", "w", "z"], E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]],
            A=[[-rate, 1, 0], [0, f"-1 - 0.5*sin({w}*{t})", hidden], [0, hidden, 1 - hidden]],
            B=[[rate], [1], [1]], inputs={"u": text.format(w=w, t=t)}, initial_state=[1, 0, 0],
        )
        began = 0.0 if t == "t" else start
        return simulate(system, TimeSettings(start=began, horizon=3.0), SolverSettings())

    there, here = told(f"(t - {start!r})"), told("t")
    assert there.signals.mesh.size <= here.signals.mesh.size + 100
    t = np.linspace(0.0, 3.0, 301)
    x, true = there.signals.states(np.clip(start + t, start, start + 3.0)), here.signals.states(t)
    # The grid itself is rounded: by that, a state moves as fast as it moves at all.
    slope = np.gradient(here.signals.states(np.linspace(0.0, 3.0, 3001)), 1e-3, axis=0)
    rounded = np.spacing(abs(start)) * np.abs(slope).max(axis=0)
    size = np.abs(true).max(axis=0)
    assert (np.abs(x - true).max(axis=0) <= 10 * there.state_errors * size + rounded).all()


@pytest.mark.parametrize("where", [3.21, 9.99, 13.37, 17.08])
@pytest.mark.parametrize("place", ["u", "A", "E"])
def test_a_narrow_feature_of_an_otherwise_smooth_plant_is_noticed(place, where):
    """Elements are few only where nothing narrow can hide in them."""
    pulse = f"exp(-(({where} - t)/0.12)**2)"
    entries = {"u": "1", "A": "-1/10", "E": "1"}
    entries[place] += f" + 3*{pulse}" if place != "A" else f" - 3*{pulse}"
    system = plant(
        states=["x", "v", "w", "z"], inputs={"u": entries["u"]},
        E=[[entries["E"], 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]],
        A=[[entries["A"], 0, 0, 0], [0, "-1/10", 0, 0], [0, 0, "-1/10", 0], [1, 0, 0, -1]],
        B=[[1], [0], [0], [1]], initial_state=[1, 1, 1, 2],
    )

    def right(t, x):
        bump = 3 * np.exp(-(((where - t) / 0.12) ** 2))
        u, a, e = np.array([1, 0.1, 1]) + bump * np.array([place == name for name in "uAE"])
        return (-a * x + u) / e

    exact = solve_ivp(right, (0, 20), [1.0], rtol=1e-11, atol=1e-12, max_step=0.05).y[0, -1]
    result = simulate(system, TimeSettings(horizon=20.0), SolverSettings(tol=1e-6))
    assert result.signals.states.final[0] == pytest.approx(exact, abs=1e-5)
    assert result.signals.mesh.steps.min() < 0.5


def test_smooth_plants_are_solved_on_few_elements():
    one = np.eye(3, dtype=int)
    system = plant(
        states=["x", "y", "z"], inputs={"u": "sin(t)"}, A=(-one).tolist(), B=[["t"]] * 3,
        E=[["2 + t" if same else 0 for same in row] for row in one], initial_state=[1, 2, 3],
    )
    few = simulate(system, TimeSettings(horizon=2.0), SolverSettings(tol=1e-6))
    many = simulate(system, TimeSettings(horizon=2.0), SolverSettings(tol=1e-13))
    assert few.signals.mesh.size == 6
    t = np.linspace(0, 2, 50)
    np.testing.assert_allclose(few.signals.states(t), many.signals.states(t), atol=1e-6)


@pytest.mark.parametrize("horizon", [10.0, 100.0, 2000.0])
@pytest.mark.parametrize("tol", [1e-5, 1e-8])
def test_a_state_that_almost_vanishes_is_seen_to_return(horizon, tol):
    """x' = 10 cos(t) x is exp(10 sin t): from 2e4 to 5e-5 and back, over and over."""
    system = plant(states=["x"], E=[["1"]], A=[["10*cos(t)"]], initial_state=[1])
    result = simulate(system, TimeSettings(horizon=horizon), SolverSettings(tol=tol))
    t = np.linspace(0, horizon, 5001)
    error = np.abs(result.signals.states(t)[:, 0] - np.exp(10 * np.sin(t))).max() / np.exp(10)
    assert error < tol
    assert error < 10 * max(result.error_estimate, tol)


@pytest.mark.parametrize("width", [0.003, 0.01])
@pytest.mark.parametrize("when", [0.777, 9.31, 17.123])
def test_what_stands_between_the_nodes_is_seen(when, width):
    """Pulses much narrower than the distance of the first nodes, of an input and of a matrix."""
    pulse = f"exp(-((t - {when})/{width})**2)"
    system = plant_from_mapping({
        "name": "pulses", "states": ["x1", "x2"], "inputs": {"u": f"1e-3*sin(t) + {pulse}"},
        "E": [[1, 0], [0, 1]], "A": [[0, 0], [0, f"-100*{pulse}"]], "B": [[1], [0]],
        "initial_state": [0, 1],
    })
    result = simulate(system, TimeSettings(horizon=20.0), SolverSettings())
    area = width * np.sqrt(np.pi)
    x1, x2 = result.signals.states(np.array([20.0]))[0]
    assert x1 == pytest.approx(area + 1e-3 * (1 - np.cos(20.0)), rel=1e-10)
    assert x2 == pytest.approx(np.exp(-100 * area), rel=1e-10)


def test_states_that_nothing_drives_are_no_signals():
    # Constraints leave e1 = −V = 0 and ir2 = e1/R2; rounding of the others must not be resolved.
    found = simulate(shipped("circuit", inputs={"V": 0}), TimeSettings(), SolverSettings())
    states = found.signals.states
    assert np.abs(states.values[..., [0, 4]]).max() < 1e-14
    assert states.mesh.size < 200
    x0 = found.initial_state

    def reduced(t, z):  # z = (C2 e2, L il), ir1 = e2/(4 + 2 sin t)
        e2, il = z[0] / (2 - np.cos(2 * t)), z[1] / (2 - np.exp(-t))
        return [-il - e2 / (4 + 2 * np.sin(t)), e2]

    start = [x0[1] * 1.0, x0[2] * 1.0]  # C2(0) = L(0) = 1
    end = solve_ivp(reduced, (0, 20), start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    expected = [end[0] / (2 - np.cos(40.0)), end[1] / (2 - np.exp(-20.0))]
    np.testing.assert_allclose(states.values[-1, -1, [1, 2]], expected, atol=1e-9)


HUGE = {
    "A[1][1] is -1e+300 at t = 0": {"A": [[-1, 1], [1, "-1e300"]]},
    "E[0][0] is 1e+300 at t = 0": {"E": [["1e300", 0], [0, 0]]},
    "inputs.u is 1.86e+299 at t = 0.25": {"inputs": {"u": "1e300*sin(3*t/4)"}},
    "initial_state.x is 1e+300;": {"initial_state": {"x": 1e300, "z": 0}},
    "unknowns.w is -1e+300": {"unknowns": {"w": -1e300}},
    "phi[1] is 1e+60 at t = 0": {"phi": [0, "1e60*cos(t)"]},
    "inputs.u = '2**1023*t' has no finite value": {"inputs": {"u": "2**1023*t"}},
}


@pytest.mark.parametrize("said", HUGE)
def test_numbers_whose_products_overflow_are_named(said):
    """Without a warning, and not as a plant that grows or cannot be observed."""
    plant = {
        "name": "p", "states": ["x", "z"], "inputs": {"u": "sin(t)"}, "unknowns": {"w": 1},
        "outputs": ["y"], "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, -2]], "B": [[1], [0]],
        "F": [[1], [0]], "C": [[1, 1]], "initial_state": {"x": 1, "z": 0.5}, **HUGE[said],
    }
    with refused(said):
        run(plant, time={"horizon": 2.0})


@pytest.mark.parametrize(("said", "settings"), [
    ("time.start = 1e+300", {"time": {"start": 1e300}}),
    ("time.horizon = 1e-300 s is too short", {"time": {"horizon": 1e-300}}),
    ("shorten time.horizon", {"time": {"horizon": 1e300}}),
    ("estimator.beta: 1e+300 is too large", {"beta": 1e300}),
    ("estimator.initial: 1e+300 is too large", {"initial": 1e300}),
    ("noise.outputs: 1e+300 is too large", {"noise": {"name": "gaussian", "outputs": 1e300}}),
])
def test_settings_out_of_all_proportion_are_named(said, settings):
    with pytest.raises(GpeboError, match=re.escape(said)):
        run("circuit", **settings)


@pytest.mark.parametrize(
    ("rate", "solver", "why"),
    [
        ("500*(t-10)", "collocation", r"rounding errors are larger than a state from t = 11\.6"),
        ("20*(t-10)", "collocation", r"rounding errors are larger than a state from t = 18\.[34]"),
        ("200", "collocation", r"not finite from t = 3\.5\d+ on: it grows beyond all numbers"),
        ("-1.0e5*cos(t)", "ivp", r"near t = 0\.0\d+ the plant p takes more steps"),
    ],
)
def test_growth_is_refused_with_its_time_and_its_reason(rate, solver, why):
    """A flow that decays to e^-25000 and comes back is lost; one that only grows is too large."""
    system = plant(states=["x"], E=[[1]], A=[[rate]], initial_state={"x": 1})
    with pytest.raises(GpeboError, match=why):
        simulate(system, TimeSettings(horizon=20.0), SolverSettings(name=solver))


@pytest.mark.parametrize(("coarse", "bounded", "taken"), [
    ([0.0, 4.0, 8.0], True, True), ([0.0, 4.0, 8.0], False, False), ([0.0, 1.0, 8.0], True, False),
])
def test_fewer_elements_are_taken_where_nothing_hides_in_them_and_none_is_too_long(
    coarse, bounded, taken
):
    source = SimpleNamespace(resolved=lambda _: (np.array(coarse), bounded))
    mesh = Mesh(np.linspace(0.0, 8.0, 33), radau_rule(3))
    found = few_elements(SimpleNamespace(coefficients=source), mesh, np.zeros(0), 4.0)
    np.testing.assert_array_equal(found.edges, coarse if taken else mesh.edges)


@pytest.mark.parametrize("off", [0.0, 1e-6])
def test_how_far_states_miss_constraints_is_seen_at_right_ends(off):
    """b = sin 5t; half of what it misses that by there reaches a, which has no constraint."""
    system = plant(
        states=["a", "b"], inputs={"u": "sin(5*t)"}, E=[[1, 0], [0, 0]], A=[[-1, 0], [0, -1]],
        B=[[0], [1]], initial_state=[0, 0],
    )
    mesh = Mesh(np.linspace(0.0, 1.0, 5), radau_rule(5))
    values = np.stack([0.0 * mesh.points, np.sin(5.0 * mesh.points)], axis=2)[..., None]
    values[:, -1, 1] += off
    structure = dense_structure(system, TimeSettings(horizon=1.0), SOLVER)
    within = np.array([[0.0, 0.5], [0.0, 0.0]])
    found = _missed(system, structure, within, mesh, values, np.ones((2, 1)))
    np.testing.assert_allclose(found, [[0.5 * off], [off]], atol=1e-14)


@pytest.mark.parametrize(("rate", "element"), [("500*(t-10)", 0.005), ("20*(t-10)", 0.024)])
def test_up_to_the_time_at_which_growth_is_refused_a_state_is_known(rate, element):
    system = plant(states=["x"], E=[[1]], A=[[rate]], initial_state={"x": 1})

    def refused_from(horizon):
        with pytest.raises(SolverError, match="a state from") as refusal:
            simulate(system, TimeSettings(horizon=horizon), SOLVER)
        return float(re.search(r"from t = ([\d.]+) on", str(refusal.value))[1])

    told = refused_from(20.0)
    assert refused_from(told + element) == pytest.approx(told, abs=element)
    simulate(system, TimeSettings(horizon=told - 2.0 * element), SOLVER)


@pytest.mark.parametrize(("rate", "allowed", "why"), [
    ("2000", {}, r"e\^4e\+03, at 2e\+03 1/s near t = 0, .* the 100 elements that solver\.max"),
    ("1500*t**2", {}, r"e\^4e\+03, at 6e\+03 1/s near t = 1\.999\d*, .* the 100 elements"),
    ("2000", {"_MOST_FOR_GROWTH": 2800}, r"the 50 elements that the size 2 of A allows"),
])
def test_growth_that_takes_too_many_elements_is_refused(rate, allowed, why, monkeypatch):
    """By e^∫λ, with the largest λ and its time, and what sets the limit: a setting, or memory.

    That of all elements is 2 · 2 numbers at each of 14 points.
    """
    for name, value in allowed.items():
        monkeypatch.setattr(f"gpebo_cli.simulation.simulate.{name}", value)
    system = plant(
        states=["x", "z"], E=[[1, 0], [0, 1]], A=[[rate, 0], [0, -1]], initial_state=[0, 0]
    )
    with pytest.raises(SolverError, match=why):
        simulate(system, TimeSettings(horizon=2.0), SolverSettings(max_elements=100))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-2.0, 2.0))
def test_no_state_grows_much_within_an_element_and_no_more_are_cut(seed, decades):
    """By e^4 at most, of elements of any lengths."""
    rng = np.random.default_rng(seed)
    A = 10.0**decades * rng.normal(size=(3, 3))
    system = plant(states=list("abc"), E=np.eye(3).tolist(), A=A.tolist(), initial_state=[1, 1, 1])
    mesh = Mesh(np.cumsum([0.0, *10.0 ** rng.uniform(-3.0, 1.0, 6)]), radau_rule(9))
    known = dense_structure(system, TimeSettings(horizon=float(mesh.edges[-1])), SOLVER)
    found = _growth_resolved(system, known, mesh, SOLVER)
    rate = max(0.0, float(np.linalg.eigvals(A).real.max()))
    assert (found.steps * rate <= 4.0 + 1e-9).all()
    assert found.size <= np.maximum(1.0, np.ceil(1.02 * mesh.steps * rate / 4.0)).sum()


def test_elements_are_short_where_a_state_grows_only():
    """By e^53 within 0.02 s: everywhere as short, they would be 7500."""
    system = plant(
        states=["x"], E=[[1]], A=[["3000*exp(-((t - 5)/0.01)**2)"]], initial_state=[1],
    )
    states = simulate(system, TimeSettings(horizon=10.0), SOLVER).signals.states
    assert np.log(states.final[0]) == pytest.approx(30.0 * np.sqrt(np.pi), rel=1e-9)
    assert states.mesh.size < 2100


def test_a_rank_that_a_step_changes_is_named_with_what_vanishes():
    """E loses its second row at t = 1: both ranks, times on both sides, and the singular value."""
    system = plant(states=["a", "b"], E=[[1, 0], [0, "1 - step(t - 1)"]], A=[[-1, 0], [0, -2]],
                   initial_state=[1, 1])
    said = r"changes from 14 at t = 0\.\d+ to 13 at t = 1\.\d+ \(singular value 0\.0e\+00\)"
    with pytest.raises(ModelError, match=said):
        simulate(system, TimeSettings(horizon=2.0), SOLVER)


def test_what_solve_ivp_says_where_it_gives_up_is_passed_on(monkeypatch):
    gone = OptimizeResult(success=False, t=np.array([0.25]), message="no step is short enough")
    monkeypatch.setattr("scipy.integrate.solve_ivp", lambda *_, **__: gone)
    system = plant(states=["x"], E=[[1]], A=[[-1]], initial_state={"x": 1})
    with refused("failed after t = 0.25: no step is short enough", by=GpeboError):
        simulate(system, TimeSettings(horizon=1.0), SolverSettings(name="ivp"))


def by_the_independent_path(rate, edges, **settings):
    def coefficients(t, inside):
        return LinearEquation(None, np.full((1, 1, 1), rate), np.zeros((1, 1, 1)))

    problem = LinearProblem(coefficients, np.ones((1, 1)), name="law")
    return ivp.solve(problem, Mesh(np.array(edges), radau_rule(5)), tol=1e-3, max_elements=9,
                     **settings)


def test_growth_beyond_all_numbers_is_refused_by_the_independent_path_without_a_warning():
    with refused("solver=ivp: the law failed after t = 3.", by=GpeboError):
        by_the_independent_path(200.0, [0.0, 1.0, 10.0])
    with refused("solver=ivp: the law failed after t = 1: ", by=GpeboError):  # in the first step
        by_the_independent_path(1e300, [1.0, 2.0, 10.0])


def test_a_restart_from_what_is_no_number_is_refused_with_its_time():
    restarts = {0.5: lambda x: x, 1.5: lambda x: np.inf * x}
    with refused("the law is beyond all numbers at t = 1.5", by=GpeboError):
        by_the_independent_path(-1.0, [0.0, 0.5, 1.5, 2.0], restarts=restarts)


def test_known_functions_are_looked_at_evenly_within_each_element():
    """Before the start and beyond the end there may be nothing to look at."""
    system = plant(states=["x"], E=[[1]], A=[[-1]], B=[[1]], inputs={"u": "sin(t)"},
                   initial_state=[0])
    meshes, seen = [], []

    def evaluated(mesh):
        meshes.append(mesh)
        return system.coefficients.taylor(mesh.points.ravel(), 0)

    def looked_at(t):
        seen.append((t, meshes[-1]))
        return system.coefficients.taylor(t, 0)

    mesh = Mesh(np.array([1.0, 2.0, 4.0]), radau_rule(9))
    known_resolved(
        system, evaluated, looked_at, mesh, evaluated(mesh), np.ones(1), SOLVER, bounded=False
    )
    (t, mesh), = seen
    place = (t.reshape(mesh.size, -1) - mesh.edges[:-1, None]) / mesh.steps[:, None]
    looks = place.shape[1]
    expected = (np.arange(looks) + 0.5) / looks
    np.testing.assert_allclose(place, np.tile(expected, (mesh.size, 1)), rtol=1e-6)


def test_a_little_state_is_compared_with_a_share_of_the_largest_by_ivp():
    """Of 1e-14 beside 1 its steps know nothing, and 1e-9 is what it is measured by."""
    plant = one_state(
        states=["a", "b"], E=[[1, 0], [0, 1]], A=[[-1, 0], [0, -20]], C=[[1, 0]],
        initial_state=[1, 1e-14],
    )
    solver = SolverSettings("ivp")
    errors = simulate(plant_from_mapping(plant), TimeSettings(horizon=0.5), solver).state_errors
    assert errors.max() < 1e-4


@pytest.mark.parametrize("unit", [1.0, 2.0**-30, 2.0**30])
def test_beside_states_of_any_unit_one_that_is_zero_is_measured_by_them(unit, monkeypatch):
    """Where everything was rounding of zero, a thousandth of the largest is what counts next."""
    asked, size = [], np.array([1.0, unit])

    def solve(problem, **rest):
        asked.append(problem.floor.ravel() / size)
        if len(asked) == 1:
            raise RoundingError("rounding", (None, np.ones((2, 3, 2, 1)) * size[:, None]))
        return collocation.solve(problem, **rest)

    monkeypatch.setattr("gpebo_cli.simulation.simulate.solve", solve)
    simulate(plant_from_mapping(one_state(
        states=["a", "b"], E=[[1, 0], [0, 1]], A=[[-2, 1 / unit], [unit, -2]], C=[[1, 0]],
        initial_state=[0, 0],
    )), TimeSettings(horizon=0.5), SolverSettings())
    np.testing.assert_array_equal(asked[0], 0.0)
    np.testing.assert_allclose(asked[1], 1e-3, rtol=0.5)
