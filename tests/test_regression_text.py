"""Regressions given as text: operators against closed forms and direct integration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import refused
from scipy.integrate import solve_ivp

from gpebo_cli import ConfigError, estimators, run
from gpebo_cli.model.expressions.syntax import parse, signal
from gpebo_cli.model.expressions.tape import record
from gpebo_cli.numerics.mesh import Trajectory, initial_mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.regression.text import regression_from_mapping, signals_of_time
from gpebo_cli.settings import SolverSettings, TimeSettings

T = np.linspace(0.0, 10.0, 201)


def on_mesh(mapping, tol=1e-12, start=0.0):
    model = regression_from_mapping({"name": "r", **mapping})
    solver = SolverSettings(tol=tol)
    signals = signals_of_time(model.system, model, TimeSettings(start, 10.0), solver)
    regression, error = model.on(signals[0], None, tol, 100_000)
    assert error <= 1e-10
    return regression


def values(*texts, **signals):
    """Each text at the times T."""
    mapping = {"unknowns": {"a": 1.0}, "signals": signals, "Y": list(texts)}
    return on_mesh({**mapping, "psi": [[1.0]] * len(texts)}).Y(T).T


def test_operators_of_a_sine_have_closed_forms():
    low, high, total, late = values("lp(u, 2)", "hp(u, 2)", "integral(u)", "delay(u, 1.5)",
                                    u="sin(t)")
    expected = (4 * np.sin(T) - 2 * np.cos(T) + 2 * np.exp(-2 * T)) / 5
    np.testing.assert_allclose(low, expected, atol=1e-11)
    np.testing.assert_allclose(high, 2 * (np.sin(T) - expected), atol=1e-11)
    np.testing.assert_allclose(total, 1 - np.cos(T), atol=1e-12)
    np.testing.assert_allclose(late, np.where(T > 1.5, np.sin(T - 1.5), 0.0), atol=1e-12)


def test_operators_may_be_nested_and_multiplied():
    found = values("hp(lp(u*u, 1), 3)", "integral(u*lp(u, 2))", u="sin(t)")

    def slope(t, z):
        u = np.sin(t)
        return [u * u - z[0], 3 * (z[0] - z[1]), 2 * (u - z[2]), u * z[2]]

    z = solve_ivp(slope, (0, 10), np.zeros(4), "DOP853", T, rtol=1e-13, atol=1e-15).y
    np.testing.assert_allclose(found, [3 * (z[0] - z[1]), z[3]], atol=1e-10)


def test_a_column_is_as_well_resolved_in_a_small_unit_as_in_another():
    """That of b is, beside it."""
    plain, other = (
        on_mesh({"unknowns": {"a": 1.0, "b": 2.0}, "signals": {"u": "t"}, "Y": ["u"],
                 "psi": [[f"{unit}*sin(20*u)", "cos(u)"]]}) for unit in (1.0, 1e-9)
    )
    np.testing.assert_array_equal(other.mesh.edges, plain.mesh.edges)
    np.testing.assert_allclose(other.psi.values, plain.psi.values * [1e-9, 1.0], rtol=1e-12)


def test_signs_do_not_change_what_is_resolved():
    """Of ψᵀY what is left where rows cancel is measured by the size of Y, even if that is < 0."""
    plain, other = (
        on_mesh({"unknowns": {"a": 1.0}, "signals": {"u": "t"}, "Y": [sign, sign],
                 "psi": [["sin(u)"], ["-sin(u) + 1e-12*sin(31*u)"]]}) for sign in (1.0, -1.0)
    )
    np.testing.assert_array_equal(other.mesh.edges, plain.mesh.edges)


def test_equal_operators_are_one():
    texts = ["lp(u*u, 2)", "lp(u*v, 2)", "lp(u*u, 2) + lp(lp(u*u, 2), 2)", "hp(u*v, 2)"]
    found = regression_from_mapping({
        "name": "r", "unknowns": {"a": 1}, "signals": {"u": None, "v": None},
        "Y": texts, "psi": [[1]] * len(texts),
    })
    assert [operator.name for operator in found.operators] == ["lp", "lp", "lp", "hp"]


def test_a_delay_moves_jumps_exactly():
    (found,) = values("delay(delay(w, 0.7), 1.1)*t", w="step(t - 3.3)*exp(-t)")
    shifted = T - 1.8
    expected = np.where(shifted > 3.3, np.exp(-shifted), 0.0) * T
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize(("along", "of_time"), [
    ("integral(sign(u))", "integral(sign(sin(t)))"),
    ("1e9*integral(1e-9*sign(u))", "integral(sign(sin(t)))"),
    ("integral(sign((u - 0.3)*(u - 0.3001)))", "integral(sign((sin(t) - 0.3)*(sin(t) - 0.3001)))"),
    ("lp(sign(lp(u, 2)), 5)", "lp(sign(4*sin(t) - 2*cos(t) + 2*exp(-2*t)), 5)"),
    ("integral(delay(sign(u - 0.5), 1))", "integral(sign(sin(t - 1) - 0.5)*step(t - 1))"),
    ("sign(u - 0.2) + sign(delay(u, 1) - 0.2)",
     "sign(sin(t) - 0.2) + sign(sin(t - 1)*step(t - 1) - 0.2)"),
    ("integral(sign(lp(u, 2)*lp(u, 2)*lp(u, 2)))",
     "integral(sign(4*sin(t) - 2*cos(t) + 2*exp(-2*t)))"),
])
def test_what_signals_switch_is_as_exact_as_what_time_does(along, of_time):
    found, expected = values(along, u="sin(t)"), values(of_time, u="sin(t)")  # each on its own mesh
    np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("start", [-7.0, 3.0])
def test_it_does_not_matter_when_a_run_starts(start):
    texts = ["integral(sign(u - 0.3))", "lp(sign(lp(u, 2)), 5)", "delay(sign(u), 1.25)*u"]
    rest = {"unknowns": {"a": 1.0}, "Y": texts, "psi": [["hp(u, 3)"], ["integral(u)"], [1]]}
    found, expected = (
        on_mesh({**rest, "signals": {"u": f"sin(t - ({at}))"}}, start=at) for at in (start, 0.0)
    )
    assert found.mesh.size == expected.mesh.size
    inside = T[1:] - 1e-3
    for part in ("Y", "psi"):
        np.testing.assert_allclose(
            getattr(found, part)(inside + start), getattr(expected, part)(inside), atol=1e-10
        )


def test_columns_in_any_unit_take_the_same_elements():
    texts = ["1e-12/(1.01 - u)", "1/(1.01 - u)", "1e9/(1.01 - u)"]
    rest = {"unknowns": {"a": 1.0}, "signals": {"u": "sin(t)"}, "Y": [1]}
    small, one, large = (on_mesh({**rest, "psi": [[text]]}) for text in texts)
    assert small.mesh.size == one.mesh.size == large.mesh.size
    np.testing.assert_allclose(one.psi(T)[:, 0, 0], 1.0 / (1.01 - np.sin(T)), rtol=1e-9)


@pytest.mark.parametrize("step", [1.0, -1.0])
def test_jumps_of_a_recorded_signal_come_out_of_delays_exactly(step):
    """At an edge of its elements, up or down, while another signal is smooth."""
    model = regression_from_mapping({
        "name": "r", "unknowns": {"a": 1.0}, "signals": {"u": None, "v": None},
        "Y": ["integral(delay(u, 0.35))", "v"], "psi": [[1], [1]],
    })
    mesh = initial_mesh(0.0, 10.0, [], 10, radau_rule(9))
    both = np.stack([np.where(mesh.inside > 3.0, step, 0.0), np.sin(mesh.points)], axis=2)
    found, _ = model.on(Trajectory(mesh, both), None, 1e-12, 1_000)
    assert np.isin([3.35, 1.35, 7.35], found.mesh.edges).tolist() == [True, False, False]
    assert found.mesh.size < 40
    expected = np.stack([step * np.maximum(T - 3.35, 0.0), np.sin(T)], axis=1)
    np.testing.assert_allclose(found.Y(T), expected, atol=1e-10)
    alone = regression_from_mapping({
        "name": "r", "unknowns": {"a": 1.0}, "signals": {"u": None},
        "Y": ["integral(delay(u, 0.35))"], "psi": [[1]],
    })
    found, _ = alone.on(Trajectory(mesh, both[..., :1]), None, 1e-12, 1_000)
    assert np.isin([3.35, 4.35], found.mesh.edges).tolist() == [True, False]


def test_delays_that_make_too_many_corners_are_refused():
    text = "w"
    for k in range(14):  # 2^14 sums of these
        text = f"delay({text}, {0.1 + 0.7**k})"
    with pytest.raises(ConfigError, match="corners in the horizon; at most 10000 are followed"):
        values(text, w="step(t - 0.5)")


@given(rate=st.floats(1e-3, 1e6), frequency=st.floats(0.1, 30.0))
@settings(max_examples=15, deadline=None)
def test_low_and_high_pass_add_up_to_the_signal(rate, frequency):
    """lp + hp/λ = 1, and λ/(p + λ) of an exponential is known, at any rate."""
    total, low = values(
        f"lp(u, {rate!r}) + hp(u, {rate!r})/{rate!r}", f"lp(v, {rate!r})",
        u=f"cos({frequency!r}*t)", v="exp(-t)",
    )
    np.testing.assert_allclose(total, np.cos(frequency * T), atol=1e-10)
    if abs(rate - 1.0) > 0.1:
        expected = rate / (rate - 1.0) * (np.exp(-T) - np.exp(-rate * T))
        np.testing.assert_allclose(low, expected, atol=1e-9)


@pytest.mark.parametrize("name", ["ls_drem", "least_squares"])
def test_estimators_find_the_parameters(name):
    """y' = a y + b u, filtered by λ/(p + λ) so that y is not differentiated."""
    regression = on_mesh({
        "unknowns": {"a": -0.5, "b": 2.0},
        "signals": {"u": "1", "y": "4*(1 - exp(-t/2))"},
        "Y": ["hp(y, 3)"], "psi": [["lp(y, 3)", "lp(u, 3)"]],
    })
    so_far = np.maximum.accumulate(np.abs(regression.psi.values).max(axis=(1, 2)))
    assert (regression.scale >= so_far).all()
    np.testing.assert_allclose(regression.scale[-1], so_far[-1], rtol=0.01)
    estimator = estimators.build({"name": name})
    found = estimators.estimate(estimator, regression, T).parameters(slice(0, 1))
    np.testing.assert_allclose(found[0, -1], [-0.5, 2.0], atol=1e-5)  # f₀ is in it


GOOD = {"name": "r", "unknowns": {"a": 1.0}, "signals": {"u": "sin(t)"}, "Y": ["u"], "psi": [["u"]]}


@pytest.mark.parametrize(("change", "message"), [
    ({"unknowns": {}}, "unknowns is missing"),
    ({"unknowns": 3}, "unknowns must map names to values"),
    ({"psi": [["u", "u"]]}, "psi[0] must be a list with an entry for each of the 1 unknowns (a)"),
    ({"psi": []}, "psi must be a list"), ({"psi": [3]}, "psi[0] must be a list with an entry"),
    ({"psi": [["max(u", "0)"]]}, "0)']; within brackets and braces, quote what has a comma"),
    ({"Y": ["u", "u"]}, "Y has 2 entries and psi has 1 rows"),
    ({"Y": ["max(u", "0)"]}, "psi has 1 rows; within brackets and braces, quote"),
    ({"Y": ["lp(u)"]}, "lp takes two arguments, not 1"),
    ({"Y": ["lp(u, u)"]}, "its rate λ must be a positive number"),
    ({"Y": ["lp(u, u**3)"]}, "its rate λ must be a positive number"),
    ({"Y": ["delay(u, -1)"]}, "the delay must be a positive number"),
    ({"Y": ["lp(d(t*t), 1)"]}, "d(.) cannot stand inside; make what has it a signal"),
    ({"Y": ["a*u"]}, "a is an unknown and cannot be used here"),
    ({"Y": ["lpp(u, 1)"]}, "there is no function 'lpp'; did you mean lp?"),
    ({"Phi": 1}, "unknown key 'Phi'; did you mean"),
    ({"signals": {"u": "sin("}}, "regression r: signals.u"),
])
def test_mistakes(change, message):
    with refused(message):
        regression_from_mapping({**GOOD, **change})


@pytest.mark.parametrize(("Y", "psi", "measured"), [
    (["y", "z"], [["u"], [1]], True), (["y", "u"], [[1], [1]], False),
    (["y", "y"], [[1], [1]], False), (["y", "2*z"], [[1], [1]], False),
    (["y", "z"], [["y"], [1]], False),
])
def test_recorded_signals_that_stand_in_Y_alone_are_outputs(Y, psi, measured):
    given = {"name": "r", "unknowns": {"a": 1}, "signals": {"y": None, "z": None, "u": "sin(t)"}}
    found = regression_from_mapping({**given, "Y": Y, "psi": psi})
    assert found.system.outputs == (tuple(Y) if measured else ())
    assert found.system.inputs == (("u",) if measured else ("y", "z", "u"))
    assert (found.Y is None) == measured


def test_an_expression_without_a_value_is_named_with_its_time():
    with pytest.raises(ConfigError, match="1/u"):
        on_mesh({**GOOD, "psi": [["1/u"]]})


def test_signals_are_made_of_parameters():
    given = {**GOOD, "parameters": {"w": 3, "twice": "2*u"}, "psi": [["u + 0*twice"]]}
    t = np.linspace(0.0, 2.0, 9)
    with_name, with_number = (
        regression_from_mapping({**given, "signals": {"u": text}}).system.coefficients.taylor(t, 0)
        for text in ("sin(w*t)", "sin(3*t)")
    )
    np.testing.assert_array_equal(with_name.u, with_number.u)


SAMPLED = {"sample_time": 0.05, "hold": "linear"}


@pytest.mark.parametrize("observer", [{}, SAMPLED])
@pytest.mark.parametrize("unit", [1e-11, 1e9])
def test_units_of_unknowns_decide_nothing(unit, observer):
    """A column has the unit of its parameter: farads beside ohms were "not excited"."""
    def found(b, psi):
        rows = {"name": "x", "unknowns": {"a": 1.5, "b": b},
                "psi": [["cos(t)", psi], ["lp(sin(2*t), 3)", "0"]]}
        return run(regression=rows, estimator="ls_drem", observer=observer,
                   time={"horizon": 4, "samples": 81}).details

    one = found(-2.0, "lp(exp(-t), 2)")
    other = found(-2.0 / unit, f"{unit!r}*lp(exp(-t), 2)")
    known, seen = (each.excitation for each in (one, other))
    assert seen.t_c == pytest.approx(known.t_c, rel=1e-6)
    np.testing.assert_allclose(seen.known.smallest, known.known.smallest, rtol=1e-6)
    np.testing.assert_allclose(
        other.estimation.parameters * [1.0, unit], one.estimation.parameters, rtol=1e-6
    )


@pytest.mark.parametrize("observer", [{}, SAMPLED])
@pytest.mark.parametrize("nothing", [
    "(u + 1)**2 - u**2 - 2*u - 1", "lp((u + 1)**2 - u**2 - 2*u - 1, 2)",
    "lp(u, 3) + hp(u, 3)/3 - u", "integral(2*u) - 2*integral(u)",
])
def test_a_column_whose_terms_cancel_is_not_excited(nothing, observer):
    found = run(
        regression={"name": "x", "unknowns": {"a": 1.5, "b": -2.0}, "signals": {"u": "sin(3*t)"},
                    "psi": [["cos(t)", f"1e-9*({nothing})"]]},
        estimator="least_squares", observer=observer, time={"horizon": 4, "samples": 81},
    )
    assert "not excited: +1 b" in found.verdict
    assert found.parameters["a"] == pytest.approx(1.5, rel=1e-4)


@pytest.mark.parametrize("estimator", ["ls_drem", "drem", "least_squares"])
def test_what_comes_later_changes_no_estimate_of_the_past(estimator):
    """A bump that is 1e-77 of its later size at first says nothing of b, and so it is left at 0."""
    def found(horizon):
        return run(
            regression={"name": "x", "unknowns": {"a": 1.5, "b": -2.0},
                        "psi": [["cos(t)", "exp(-((t - 4)/0.3)**2)"]]},
            estimator=estimator, time={"horizon": horizon, "samples": 20 * horizon + 1},
        ).details

    one, other = found(5), found(10)
    assert one.excitation.t_c < 0.1
    past, told = other.estimation.parameters[:, :101], np.abs(np.arange(101) / 20 - 2.45) > 0.8
    np.testing.assert_allclose(
        one.estimation.parameters[:, told], past[:, told], rtol=1e-4, atol=1e-6
    )
    assert np.abs(past).max() < 2.1


def test_no_operator_is_larger_than_its_terms():
    """Right behind a step from 1 to −1 a high pass is −2 λ."""
    found = on_mesh({"unknowns": {"a": 1.0}, "signals": {"u": "1 - 2*step(t - 5)"}, "Y": ["u"],
                     "psi": [["hp(u, 3)"]]})
    assert np.abs(found.psi.values).max() == pytest.approx(6.0, rel=1e-5)
    assert (np.abs(found.psi.values) <= found.scale[:, None, None]).all()


def test_terms_are_those_of_all_elements_piece_by_piece(monkeypatch):
    given = {"unknowns": {"a": 1.0, "b": 2.0}, "signals": {"u": "exp(-t)*sin(9*t)"},
             "Y": ["u"], "psi": [["hp(u, 3) + 1e-3", "integral(lp(u, 2))"]]}
    whole = on_mesh(given)
    monkeypatch.setattr("gpebo_cli.regression.text._AT_ONCE", 3)
    pieces = on_mesh(given)
    assert whole.mesh.size > 6
    np.testing.assert_array_equal(pieces.scale, whole.scale)


def test_terms_of_an_expression_are_the_largest_that_it_adds_up():
    u, w = signal("u", 0, "a signal"), signal("w", 1, "a signal")
    tape = record([
        parse(text, {"u": u, "w": w}, "x")
        for text in ("u - w", "w - u + 1e-3", "-u*w", "(u - w)/(u + w)", "cos(u)", "2*u - u - u",
                     "u/w + 1e-3")
    ])
    t, values = np.array([0.0, 1.0]), np.array([[3.0, -1.0], [0.5, 0.25]])
    found = tape.terms(t, values, 2.0 * np.abs(values))
    np.testing.assert_allclose(found, [
        [6.0, 6.0, 12.0, 3.0, -np.cos(3.0), 12.0, 6.0],
        [1.0, 1.0, 0.5, 1.0 / 0.75, np.cos(0.5), 2.0, 4.0],
    ])


def test_sizes_of_an_operator_do_not_hang_on_when_the_clock_began():
    text = regression_from_mapping({
        "name": "x", "unknowns": {"a": 1.0}, "signals": {"u": None}, "Y": ["u"],
        "psi": [["integral(u)"]],
    })
    t, u = 0.1 * np.arange(30), np.ones((30, 1))
    found = text.advance("linear", None, 50.0 + t, u, u)[1].scale
    np.testing.assert_allclose(found, text.advance("linear", None, t, u, u)[1].scale, rtol=1e-12)


def test_sizes_so_far_are_handed_on_from_piece_to_piece():
    """A signal that decays: later pieces alone would say that nothing was ever larger."""
    text = regression_from_mapping({
        "name": "x", "unknowns": {"a": 1.0, "b": 2.0}, "signals": {"u": None}, "Y": ["u"],
        "psi": [["integral(exp(-3*t))", "exp(-3*t) + 0*u"]],
    })
    t = 0.1 * np.arange(60)
    u = np.exp(-3.0 * t)[:, None]
    whole, state = text.advance("linear", None, t, u, u)[1], None
    for part in (slice(0, 5), slice(5, 30), slice(30, 60)):
        state, piece = text.advance("linear", state, t[part], u[part], u[part])
        np.testing.assert_allclose(piece.scale, whole.scale[part], rtol=1e-12)


def test_what_a_column_switches_near_a_row_is_on_its_side_at_late_times():
    """The jump is 1e-4 s before a row, where a billionth of the element is no other number."""
    t = np.arange(0.0, 12.01, 0.1)
    gate = (np.sin(1.1 * t) > 0.0) * 1.0
    on = "step(gate - 0.999)"
    plan = {
        "name": "gated", "signals": {"gate": 1, "y": 1}, "unknowns": {"a": 2},
        "Y": [f"{on}*y"], "psi": [[on]],
    }
    found = run(
        regression=plan, data={"t": 1e6 + t, "gate": gate, "y": 2.0 + 0.0 * t},
        estimator="least_squares", time={"samples": 13},
    )
    assert found.details.regression.error_estimate < 1e-9
