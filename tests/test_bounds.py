"""Bounds of functions over cells of time: they hold, and nothing narrow is missed."""

from __future__ import annotations

import copy
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from kernel_paths import by_both
from processes import refused
from scipy.integrate import quad
from scipy.special import gammaln
from test_kernels_jets import tape_of, texts

from gpebo_cli import run
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.model.expressions.bounds import Bounds, _refuse_poles, breakpoints, resolved
from gpebo_cli.model.expressions.intervals import Interval, polynomials
from gpebo_cli.model.expressions.syntax import parse, signal
from gpebo_cli.model.expressions.tape import record
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import SolverSettings, TimeSettings
from gpebo_cli.simulation.simulate import simulate


def integrated(text, E=1, horizon=20.0, states=1):
    """What x' = text adds to x, by simulation."""
    system = plant_from_mapping({
        "name": "p", "states": ["x"], "inputs": {"u": text}, "outputs": ["y"], "E": [[E]],
        "A": [[0]], "B": [[1]], "C": [[1]], "initial_state": [0],
    })  # fmt: skip
    found = simulate(system, TimeSettings(horizon=horizon), SolverSettings())
    return found.signals.states.final[0]


def found(text, start=0.0, stop=20.0):
    return breakpoints(record([parse(text, {}, "here")]), start, stop)


@given(
    texts(), st.integers(0, 3), st.floats(-1, 1), st.sampled_from([1e-9, 1e-3, 0.1, 1.0]),
    st.booleans(),
)  # fmt: skip
@example("1/t", 0, -0.5, 0.5, False)  # ends at the pole
def test_bounds_hold_for_all_times_of_a_cell(line, order, start, width, decided):
    """With jumps decided in the cell's middle, or none decided and values only."""
    tape = tape_of(line)
    low, high = np.array([start]), np.array([start + width])
    middle = 0.5 * (low + high)
    t = np.linspace(start, start + width, 33)[1:-1]
    try:
        truth = tape.taylor(t, order, np.full_like(t, middle) if decided else None)
    except ConfigError:  # nothing to hold
        return
    if not decided and tape.jumps:
        truth = truth[:1]
    for least, most in by_both(
        lambda: Bounds(tape).of(low, high, order, middle if decided else None)
    ):
        slack = 1e-13 * np.maximum(1.0, np.abs(truth))
        assert (least[: len(truth)] <= truth + slack).all()
        assert (most[: len(truth)] >= truth - slack).all()


@given(texts(), st.integers(0, 3))
@example("sin(sin(sign(step(0.6 - t))))", 0)  # 1 − 1 is zero, and so is its sign
@example("sin(min(sin(t), sin(t)))", 0)
@settings(max_examples=30)
def test_both_paths_bound_alike(line, order):
    tape, edges = tape_of(line), np.linspace(-1, 1, 5)
    one, other = by_both(lambda: Bounds(tape).of(edges[:-1], edges[1:], order, edges[:-1] + 0.25))
    for a, b in zip(one, other, strict=True):
        assert (np.isfinite(a) == np.isfinite(b)).all()
        some = np.isfinite(a)
        np.testing.assert_allclose(a[some], b[some], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("text", [
    "t**2", "t*t", "t**4", "abs(t)", "cosh(t)", "sinh(t)", "(t + 4)**-1", "1/(t + 4)",
    "(t + 4)**-2", "(t + 4)**1.5", "sqrt(t + 4)", "(t + 4)**-0.5", "log(t + 4)", "exp(t)", "erf(t)",
    "sin(t)", "cos(t)", "sin(2*t)", "tan(t/3)", "tanh(t)", "atan(t)", "asin(t/4)", "acos(t/4)",
    "asinh(t)", "acosh(t + 5)", "atanh(t/4)", "max(t, -2)", "min(t, -2)", "sign(t)", "step(t + 2)",
])
def test_bounds_of_one_function_are_what_it_reaches(text):
    low, high = np.array([-3.0, -2.5, 0.25]), np.array([1.0, -0.5, 1.0])
    tape = record([parse(text, {}, "here")])
    t = np.linspace(low, high, 4001)
    reached = tape.taylor(t.ravel(), 0)[0, :, 0].reshape(t.shape)
    for least, most in by_both(lambda: Bounds(tape).of(low, high, 0)):
        np.testing.assert_allclose(least[0, :, 0], reached.min(axis=0), atol=1e-5)
        np.testing.assert_allclose(most[0, :, 0], reached.max(axis=0), atol=1e-5)


def test_bounds_are_not_much_wider_than_they_must_be():
    edges = np.linspace(0, 20, 4001)
    tape = record([parse("4*cos(2*t)*sin(t/5) + exp(-t)/(2 + t)", {}, "here")])
    least, most = Bounds(tape).of(edges[:-1], edges[1:], 0, edges[1:])
    exact = tape.taylor(edges, 0)[0, :, 0]
    assert np.abs(most[0, :, 0] - least[0, :, 0]).max() < 4 * np.abs(np.diff(exact)).max()


@pytest.mark.parametrize(("w", "duty"), [(10, 1e-3), (100, 1e-2), (37, 1e-5)])
@pytest.mark.parametrize("pulses", ["(1 + sign({}))/2", "step({})"])
def test_pulse_width_modulation(w, duty, pulses):
    """Every pulse has the area 2π/w, the first one starts in its middle."""
    text = f"{pulses.format(f'cos({w}*t) - cos(pi*{duty})')}/{duty}"
    periods = np.floor(20 * w / (2 * np.pi))
    rounding = max(1e-9, 1e-16 / duty**2)  # of the argument, against its slope where it is zero
    np.testing.assert_allclose(integrated(text), (0.5 + periods) * 2 * np.pi / w, rtol=rounding)
    k = np.arange(1, periods + 1)
    edges = (2 * np.pi * k[:, None] + np.pi * duty * np.array([-1, 1])) / w
    expected = np.append(np.pi * duty / w, edges.ravel())
    np.testing.assert_allclose(found(text), expected[expected < 20], rtol=rounding)


@given(st.lists(st.floats(0.01, 19.99), min_size=1, max_size=6, unique=True),
       st.sampled_from(["sign", "abs"]), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_roots_of_polynomials_that_change_sign_are_all_found(places, function, power):
    """Also where two are near each other, and roots of higher order."""
    places = sorted(round(place, 4) for place in places)
    places = [a for a, b in zip(places, [*places[1:], 99.0], strict=True) if b - a > 1e-4]
    product = "*".join(f"(t - {place})**{power if k == 0 else 1}" for k, place in enumerate(places))
    expected = places[power % 2 == 0 :]
    times = found(f"{function}(sin(t)*0 + {product})")
    assert len(times) == len(expected)
    # Rounding of a product moves a threefold root by the cube root of it.
    np.testing.assert_allclose(times, expected, atol=1e-3 if power == 3 else 1e-9)


@pytest.mark.parametrize(
    ("text", "times"),
    [
        ("abs(-(t - 3))", [3]), ("step(-(t - 5))", [5]), ("sign(-(-(t - 2)))", [2]),
        ("abs(-(t**2 - 4))", [2]), ("abs((t - 5)**2)", []), ("abs((t - 5)**3)", [5]),
        ("abs(sin(t) - sin(t))", []), ("sign(sign(t - 7) + 0.5)", [7]), ("abs(cos(t) - 1)", []),
        ("max(t**2, 9)", [3]),
        ("min(exp(-((t - 7.1)/1e-4)**2), 0.5)", 7.1 + 1e-4 * np.log(2) ** 0.5 * np.array([-1, 1])),
        ("sign(sin(3.1415926535*t) + 1e9)", []), ("abs((t - 10)*(t + 1))", [10]),
        ("step(t + 3*t - 8)", [2]), ("abs(4 - t - t)", [2]),
    ],
)  # fmt: skip
def test_selected_breakpoints(text, times):
    np.testing.assert_allclose(found(text), times, rtol=1e-9)


@given(st.floats(-15.5, -6.0), st.floats(0.5, 20.0), st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_threshold_that_is_hardly_passed_is_passed_twice_within_the_estimate(digits, w, square):
    """Each maximum has a pulse, down to some roundings of the argument.

    From 2e-14 on that was refused, and errors of instants were up to 3,000 times the estimate.
    """
    least = 1.0 - 10.0**digits
    text = f"sin({w}*t)**2 - {least}" if square else f"sin({w}*t) - {least}"
    plant = plant_from_mapping({
        "name": "p", "states": ["x"], "inputs": {"u": f"sign({text})"}, "E": [[1]], "A": [[0]],
        "B": [[1]], "initial_state": [0],
    })
    result = simulate(plant, TimeSettings(horizon=20.0), SolverSettings())
    at = np.sqrt(1.0 - least if square else (1.0 - least) * (1.0 + least))
    half = np.arcsin(at) / w  # of the width of a pulse
    maxima = np.arange(0.5, 20.0 * w / np.pi, 1.0 if square else 2.0) * np.pi / w
    assume(np.abs(maxima - 20.0).min() > half)
    pulses = int((maxima < 20.0).sum())
    assert len(result.jumps) == 2 * pulses
    error = np.abs(result.signals.states.final[0] + 20.0 - 4.0 * half * pulses) / 20.0
    assert error < 2.0 * result.error_estimate
    assert result.error_estimate < 3e-8


def switching(rng):
    """The text of a function that jumps or has kinks, and its integral from 0 to times."""
    w, p, a = rng.uniform(0.5, 30.0), rng.uniform(0.0, 6.0), rng.uniform(0.0, 20.0)
    phase = f"{w!r}*t + {p!r}"

    def of_abs(theta):
        turns, part = np.divmod(theta, np.pi)
        return 2.0 * turns + 1.0 - np.cos(part)

    def of_max(theta):
        return 0.5 * (np.sin(theta) - np.cos(theta) + np.sqrt(2) * of_abs(theta - np.pi / 4))

    text, whole = {
        "sign": (f"sign(sin({phase}))", lambda theta: np.arccos(np.cos(theta))),
        "abs": (f"abs(sin({phase}))", of_abs),
        "max": (f"max(sin({phase}), cos({phase}))", of_max),
    }[rng.choice(["sign", "abs", "max"])]

    def integral(t):
        return (whole(w * t + p) - whole(p)) / w + np.maximum(t - a, 0.0)

    return f"{text} + step(t - {a!r})", integral


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_plants_with_many_switching_inputs_are_as_wrong_as_they_say(seed):
    """Up to 12 states and four inputs; no element is spent on what the instants make smooth."""
    rng = np.random.default_rng(seed)
    n, inputs = int(rng.integers(1, 13)), [switching(rng) for _ in range(int(rng.integers(1, 5)))]
    B = rng.normal(size=(n, len(inputs)))
    plant = plant_from_mapping({
        "name": "switched", "states": [f"x{k}" for k in range(n)], "E": np.eye(n).tolist(),
        "A": np.zeros((n, n)).tolist(), "B": B.tolist(), "initial_state": [0.0] * n,
        "inputs": {f"u{k}": text for k, (text, _) in enumerate(inputs)},
    })
    result = simulate(plant, TimeSettings(horizon=20.0), SolverSettings(tol=1e-9))
    t = np.linspace(0.0, 20.0, 2001)
    exact = np.stack([integral(t) for _, integral in inputs], axis=1) @ B.T
    wrong = np.abs(result.signals.states(t) - exact).max(axis=0) / np.abs(exact).max(axis=0)
    assert (wrong < 3.0 * result.state_errors).all()
    assert result.error_estimate < 1e-8
    assert result.signals.mesh.size <= len(result.jumps) + 25 * len(inputs)


@pytest.mark.parametrize(("text", "function"), [
    ("max(sign(cos(7*t)), 0.4*sin(t))", lambda s, t: np.maximum(s, 0.4 * np.sin(t))),
    ("min(sign(cos(7*t)), 0.3 + 0.1*t)", lambda s, t: np.minimum(s, 0.3 + 0.1 * t)),
    ("abs(sign(cos(7*t)) + 2*sin(t))", lambda s, t: np.abs(s + 2 * np.sin(t))),
])
def test_a_jump_within_what_switches_is_no_rounding_of_it(text, function):
    """Its instant was said to be vague by as long as it takes to level such a jump."""
    system = plant_from_mapping({
        "name": "p", "states": ["x"], "inputs": {"u": text}, "E": [[1]], "A": [[0]], "B": [[1]],
        "initial_state": [0],
    })
    result = simulate(system, TimeSettings(horizon=4.0), SolverSettings())
    cuts = np.concatenate([[0.0], found(text, 0.0, 4.0), [4.0]])
    x, weights = np.polynomial.legendre.leggauss(40)
    whole = 0.0
    for a, b in pairwise(cuts):
        t = 0.5 * (a + b) + 0.5 * (b - a) * x
        whole += 0.5 * (b - a) * (weights @ function(np.sign(np.cos(3.5 * (a + b))), t))
    assert abs(result.signals.states.final[0] - whole) < 1e-13
    assert result.error_estimate < 1e-12


@pytest.mark.parametrize(("text", "whole"), [
    ("sign(max(0, sin(t)))", 3 * np.pi), ("abs(max(0, sin(t)))", 6.0),
    ("max(0, max(0, sin(t)))", 6.0), ("sign(asin(sin(t))*step(t - 2*pi))", np.pi),
])
def test_what_is_zero_for_a_while_switches_nothing_then(text, whole):
    assert integrated(text, horizon=5 * np.pi) == pytest.approx(whole, rel=1e-12)


@pytest.mark.parametrize("start", [1e6, -1e6])
def test_the_rounding_of_an_instant_far_from_zero_is_in_the_estimate(start):
    plant = plant_from_mapping({
        "name": "p", "states": ["x"], "inputs": {"u": f"sign(t - ({start} + 3.3))"}, "E": [[1]],
        "A": [[0]], "B": [[1]], "initial_state": [0],
    })
    result = simulate(plant, TimeSettings(start=start, horizon=10.0), SolverSettings())
    error = abs(result.signals.states.final[0] - 3.4) / 3.4
    assert 1e-12 < error < result.error_estimate < 1e-9


def test_falling_arguments_switch_the_right_way():
    assert integrated("step(-(t - 5))") == pytest.approx(5.0, rel=1e-12)
    assert integrated("abs(-(t - 3))", horizon=5.0) == pytest.approx(6.5, rel=1e-12)


def test_more_switching_than_can_be_followed_is_refused():
    with pytest.raises(ConfigError, match="more changes of sign than can be followed, near t = "):
        found("sign(sin(1e5*t))")


@given(st.floats(0.01, 0.99), st.sampled_from([1e-2, 1e-3, 3e-4, 1e-5]))
@settings(max_examples=40, deadline=None)
def test_one_narrow_pulse_anywhere_is_integrated(place, width):
    """By itself, and over a divisor that no bound of a long cell keeps away from zero."""
    pulse = f"exp(-((t - {20 * place})/{width})**2)"
    np.testing.assert_allclose(integrated(pulse), width * np.sqrt(np.pi), rtol=1e-8)
    s, weights = np.polynomial.hermite.hermgauss(40)
    mean = weights @ (1.0 / ((20 * place + width * s - 10) ** 2 + 0.1))
    np.testing.assert_allclose(
        integrated(f"{pulse}/(t**2 - 20*t + 100.1)"), width * mean, rtol=1e-8
    )


@pytest.mark.parametrize("pole", [
    "1/(t - 3.3)", "1e-9/(exp(t) - exp(3.3))", "(t - 3.3)**(-2)", "tan(pi*t/6.6)",
    "1/sin(200*(t - 3.3))",
])
@pytest.mark.parametrize("place", [("A", 1, 0), ("B", 0, 0), ("C", 0, 0), ("phi", 0)])
def test_a_pole_is_refused_wherever_it_stands(pole, place):
    """Nothing grows with it in a chain, where no error of a state would tell."""
    plant = {
        "name": "chain", "states": ["a", "b"], "inputs": {"u": 1}, "outputs": ["y"],
        "E": [[1, 0], [0, 1]], "A": [[-1, 0], [0, -1]], "B": [[1], [0]], "C": [[0, 1]],
        "phi": [0, 0], "initial_state": [1, 0],
    }
    key, row, *column = place
    plant[key] = copy.deepcopy(plant[key])
    if column:
        plant[key][row][column[0]] = pole
    else:
        plant[key][row] = pole
    with pytest.raises(GpeboError, match=r"grows beyond all numbers near t = (3\.3;|0.0)"):
        run(plant, observer="none", time={"horizon": 5.03})


def test_a_pole_is_no_jump_and_may_stand_in_the_last_element():
    functions = "1", "9*step(1.5 - t)", "9*step(t - 1.5)", "1/(t - 1.5)"
    tape, edges = record([parse(text, {}, "here") for text in functions]), np.array([0.0, 1.0, 2.0])
    alone = np.array([[True, True, True, False]])
    _refuse_poles(tape, np.array([1.5]), edges, alone)
    with refused("here = '1/(t - 1.5)' grows beyond all numbers near t = 1.5; choose a horizon"):
        _refuse_poles(tape, np.array([1.5]), edges, ~alone)
    for text in ("step(t - 1.5)/(t - 1.5)", "step(1.5 - t)/(t - 1.5)"):  # of one side alone
        with refused(f"here = '{text}' grows beyond all numbers near t = 1.5"):
            _refuse_poles(record([parse(text, {}, "here")]), np.array([1.5]), edges, alone[:, :1])


def test_nothing_is_looked_at_before_the_start():
    tape, whole = record([parse("log(t)", {}, "here")]), np.array([0.0, 1.0])
    with refused("here = 'log(t)' has no finite value at t = 0"):  # and not at −4e-13
        _refuse_poles(tape, np.array([1e-15]), whole, np.array([[True]]))


@pytest.mark.parametrize(("text", "truth"), [
    ("1/(1 + (t - 3.3)**(-2))", lambda t: (t - 3.3) ** 2 / (1 + (t - 3.3) ** 2)),
    ("sin(t - 3.3)/(t - 3.3)", lambda t: np.sinc((t - 3.3) / np.pi)),
    ("1/((t - 3.3)**2 + 1e-8)", lambda t: 1 / ((t - 3.3) ** 2 + 1e-8)),
])
def test_what_has_no_bound_in_a_cell_may_be_finite(text, truth):
    exact = quad(truth, 0.0, 5.03, points=[3.2999, 3.3, 3.3001], limit=500, epsabs=1e-11)[0]
    assert integrated(text, horizon=5.03) == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("text", ["exp(1000*t)", "log(d(d(1 - t**2)))", "exp(999*d(d(t**2)))"])
def test_what_has_no_value_for_long_is_refused_in_one_line(text):
    """Bounds of the last are infinite both; no program is made of it and of the second."""
    for found in by_both(lambda: one_line(text)):
        assert f"here = '{text}' has no finite value at t = 0." in found


def one_line(text):
    with pytest.raises(ConfigError) as caught:
        resolved(Bounds(tape_of(text)), np.linspace(0.0, 5.0, 6))
    return str(caught.value)


def slit(width):
    """A run of q' = −1000 exp(−((y − a)/w)²) q with y' = 0.1: ln q falls by 10⁴ w √π."""
    return run({
        "name": "slit", "states": ["p", "q"], "inputs": {"u": 0.1}, "outputs": ["y"],
        "E": [[1, 0], [0, 1]], "A": [[0, 0], [0, f"-1000*exp(-((y - 0.46371)/{width})**2)"]],
        "B": [[1], [0]], "C": [[1, 0]], "initial_state": [0, 1],
    }, observer="none", time={"horizon": 10})


@pytest.mark.parametrize("width", [1e-4, 1e-5])
def test_a_narrow_pulse_along_an_output_is_seen(width):
    found = slit(width)
    assert found["q"][-1] == pytest.approx(np.exp(-1e4 * width * np.sqrt(np.pi)), rel=1e-6)
    assert "nothing bounds" not in found.verdict


def test_a_pulse_along_an_output_that_another_pulse_moves_is_seen():
    """The first one takes √π/10 from an output, which the second one follows 1.8 s later then."""
    at = {"y": 0.2134, "z": 0.3071}
    first, second = (f"1e3*exp(-(({y} - {place})/1e-4)**2)" for y, place in at.items())
    found = run({
        "name": "slits", "states": ["c", "p", "q"], "inputs": {"u": 0.1}, "outputs": [*at],
        "E": np.eye(3).tolist(), "A": [[0, 0, 0], [0, 0, 0], [0, 0, f"-{second}"]],
        "B": [[1], [f"1 - {first}"], [0]], "C": [[1, 0, 0], [0, 1, 0]], "initial_state": [0, 0, 1],
    }, observer="none", time={"horizon": 10}, solver={"tol": 1e-9})
    assert found["p"][-1] == pytest.approx(1 - 0.1 * np.sqrt(np.pi), rel=1e-6)
    assert found["q"][-1] == pytest.approx(np.exp(-np.sqrt(np.pi)), rel=1e-6)


@pytest.mark.parametrize("least", [
    {"model.expressions.bounds._MOST_ALONG": 2, "model.expressions.bounds._FOR_EACH": 0},
    {"simulation.simulate._LOOKS": 1},
])
def test_a_pulse_along_an_output_that_is_not_followed_far_enough_is_said(least, monkeypatch):
    for name, value in least.items():
        monkeypatch.setattr(f"gpebo_cli.{name}", value)
    said = slit(1e-5).verdict
    assert "nothing bounds what functions that change so often do between" in said


def test_what_follows_a_signal_is_not_looked_at_without_it():
    """Nothing bounds sin(y)/y where y = t passes zero, which is no pole."""
    tape = record([parse("sin(y)/y", {"y": signal("y", 0, "output")}, "here")])
    bounds = Bounds(tape, lambda low, high: [[Interval(low, high), 1.0]])
    found, short = resolved(bounds, np.array([-1.0, 0.5, 2.0]), 200)
    assert not short
    assert {-1.0, 0.5, 2.0} < set(found)


@pytest.mark.parametrize(("w", "power"), [("25*pi", 2000), ("2.5*pi", 20000)])
def test_many_narrow_pulses_are_integrated(w, power):
    mean = np.exp(gammaln((power + 1) / 2) - gammaln(power / 2 + 1)) / np.sqrt(np.pi)
    np.testing.assert_allclose(integrated(f"cos({w}*t)**{power}"), 20 * mean, rtol=1e-7)


def test_more_pulses_than_cells_is_said(monkeypatch):
    monkeypatch.setattr("gpebo_cli.model.expressions.bounds._MOST_VALUES", 1)
    monkeypatch.setattr("gpebo_cli.model.expressions.bounds._MOST_CELLS", 1000)
    plant = {"name": "p", "states": ["x"], "inputs": {"u": "cos(50*t)**2000"}, "E": [[1]],
             "A": [[0]], "B": [[1]], "initial_state": [0]}
    told = run(plant, observer="none", time={"horizon": 20}).verdict
    assert "nothing bounds what functions that change so often do between" in told


def test_the_derivative_of_a_steep_step_is_integrated():
    np.testing.assert_allclose(integrated("d(tanh(1e4*(t - 7.1234)))"), 2.0, rtol=1e-8)


@given(st.floats(0.05, 0.95), st.sampled_from([1e-2, 1e-3, 3e-5]))
@settings(max_examples=20, deadline=None)
def test_a_coefficient_that_passes_zero_twice_in_no_time_is_refused(place, width):
    with pytest.raises(GpeboError, match="changes at t = ") as caught:
        integrated("1", f"1 - 2*exp(-((t - {20 * place})/{width})**2)")
    said = float(str(caught.value).split(" t = ")[1].split()[0])
    assert abs(abs(said - 20 * place) - width * np.sqrt(np.log(2))) < 1e-6


def test_smooth_functions_cost_no_cells():
    tape = record([parse(text, {}, "here") for text in ("sin(t)", "exp(-t)", "1/(2 - cos(2*t))")])
    edges = np.linspace(0, 20, 25)
    found, short = resolved(Bounds(tape), edges)
    assert short
    np.testing.assert_array_equal(found, edges)


@pytest.mark.parametrize("half", [0.1, 3.0])
def test_coefficients_of_a_polynomial_anywhere_in_a_cell_are_within_its_bounds(half):
    """Of ±(1 + x + … + x³) about the middle of the cell: at its right end they are the bounds."""
    c = np.array([[1.0, -1.0]] * 4)
    found = polynomials(c, np.full(2, half))
    exact = [1 + half + half**2 + half**3, 1 + 2 * half + 3 * half**2, 1 + 3 * half, 1.0]
    np.testing.assert_allclose([each.high[0] for each in found], exact)
    np.testing.assert_allclose([each.low[1] for each in found], np.negative(exact))
