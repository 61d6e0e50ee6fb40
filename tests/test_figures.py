"""Figures: named axes, legends beside the curves, nothing clipped, readable in one column."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from factories import UNITS, make_result, with_figures, without_observer
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text
from PIL import Image

from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.experiment.result import EstimationResult, Fit, RunResult
from gpebo_cli.results import figures, style, symbols
from gpebo_cli.results.figures import FIGURES, describe, draw
from gpebo_cli.results.folder import write_run
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.series import blocks
from gpebo_cli.settings import OutputSettings

CIRCUIT_FIGURES = {
    "regressor",
    "states",
    "estimates_a",
    "estimates_b",
    "parameter_error",
    "state_error_a",
    "state_error_b",
    "gram",
    "delta",
}
LONG_NAMES = {"gamma": 1e10, "alpha": 0.25, "lambda_1": 0.1, "forgetting_factor": 1e-3}


def estimation_of(result: RunResult) -> EstimationResult:
    assert result.estimation is not None
    return result.estimation


def many_gains() -> RunResult:
    """Nine cases in which four gains vary, with long names: the widest legend there can be."""
    result = make_result(gammas=tuple(np.logspace(8, 12, 9)), samples=101)
    cases = tuple({k: v * (i + 1) for k, v in LONG_NAMES.items()} for i in range(9))
    return replace(result, estimation=replace(estimation_of(result), cases=cases))


def wild() -> RunResult:
    """Estimates that blow up, turn into NaN, or are exact from the start."""
    result = make_result(samples=101)
    estimation = estimation_of(result)
    states = estimation.states.copy()
    states[0, 50:, 0] = np.nan
    states[1, :, 1] = 1e200
    states[:, :, 2] = result.simulation.states[:, 2]
    parameters = estimation.parameters.copy()
    parameters[:, :, 0] = 1.0
    return replace(result, estimation=replace(estimation, states=states, parameters=parameters))


def long_names() -> RunResult:
    """States whose names do not fit beside a panel, with values in the millions."""
    result = make_result(samples=101, parameters=())
    names = tuple(f"current_of_the_{i}th_inductor_from_left" for i in range(6))
    system = replace(result.system, states=names, units=dict.fromkeys(names, "mA"))
    states = result.simulation.states * 1e6
    simulation = replace(result.simulation, states=states)
    estimation = replace(estimation_of(result), states=estimation_of(result).states * 1e6)
    return replace(result, system=system, simulation=simulation, estimation=estimation)


def not_excited() -> RunResult:
    """The regressor that is zero throughout, in two rows."""
    result = make_result(samples=101)
    assert result.regression is not None
    assert result.excitation is not None
    regression = replace(result.regression, psi=np.zeros((101, 2, 3)))
    excitation = replace(result.excitation, gram_eigenvalues=np.zeros((101, 3)), t_c=None, rho=0.0)
    delta = np.zeros((1, 101))
    estimation = replace(estimation_of(result), delta=delta)
    return replace(result, regression=regression, excitation=excitation, estimation=estimation)


def diverging() -> RunResult:
    """Estimates at the end of the range of floats and beyond."""
    result = make_result(samples=101)
    states = np.full_like(estimation_of(result).states, 1.7e308)
    states[1] = np.inf
    states[:, :, 1] = 5e-324
    states[:, :, 2] = np.nan
    return replace(result, estimation=replace(estimation_of(result), states=states))


def at_times(start: float, stop: float) -> RunResult:
    """Other horizons: what the labels of the time axis have to cope with."""
    result = make_result(samples=101)
    assert result.regression is not None
    assert result.excitation is not None
    t = np.linspace(start, stop, 101)
    return replace(
        result,
        simulation=replace(result.simulation, t=t),
        regression=replace(result.regression, t=t),
        excitation=replace(result.excitation, t=t, t_c=float(t[10])),
        estimation=replace(estimation_of(result), t=t),
    )


RESULTS: dict[str, Callable[[], RunResult]] = {
    "circuit": make_result,
    "one case": lambda: make_result(gammas=(1e10,), samples=101),
    "many gains": many_gains,
    "wild": wild,
    "long names": long_names,
    "diverging": diverging,
    "microseconds": lambda: at_times(0.0, 2e-6),
    "days": lambda: at_times(86400.0, 1e6),
    "late": lambda: at_times(1000.0, 1000.05),
    "not excited": not_excited,
    "rotating kernel": lambda: make_result(parameters=("e0_1", "e0_2", "e0_3"), thin=7),
    "no units": lambda: make_result(units={}, samples=101),
    "no observer": lambda: without_observer(make_result(samples=101)),
}


def rendered(figure: Figure) -> Any:
    """Return the canvas of ``figure``, drawn; matplotlib gives it no types."""
    canvas: Any = figure.canvas
    canvas.draw()
    return canvas


def visible_texts(figure: Figure) -> list[Text]:
    return [
        text
        for text in figure.findobj(lambda artist: isinstance(artist, Text))
        if isinstance(text, Text) and text.get_visible() and text.get_text()
    ]


# Of results that differ from the circuit's in one thing only, the figures in which it is seen.
SEEN: dict[str, list[str]] = {
    "one case": ["state_error_a", "delta"], "many gains": ["parameter_error", "error_norms"],
    "long names": ["states", "estimates", "state_error"], "no units": ["signals", "estimates_a"],
    **{times: ["states", "gram"] for times in ("microseconds", "days", "late")},
    "not excited": ["regressor", "gram", "delta"], "rotating kernel": ["estimates", "state_error"],
    "wild": ["estimates_a", "parameter_error", "state_error_a"],
    "diverging": ["estimates_a", "state_error_a", "state_error_b"],
}


@pytest.mark.parametrize("kind", RESULTS)
def test_layout(kind: str) -> None:
    """Every axis is named; legends and texts keep clear of curves, each other and the edge."""
    for name, figure in draw(RESULTS[kind](), SEEN.get(kind)):
        page = figure.bbox
        renderer = rendered(figure).get_renderer()
        boxes = [axes.get_window_extent() for axes in figure.axes]
        for axes in figure.axes:
            assert axes.get_ylabel(), name
            assert axes.get_title() == ""
            legend = axes.get_legend()
            if legend is not None:
                extent = legend.get_window_extent(renderer)
                assert not any(extent.overlaps(box) for box in boxes), name
                assert extent.x1 <= page.x1, name
                assert extent.y1 <= page.y1, name
            ticks = [*axes.get_yticklabels()]
            extents = [label.get_window_extent(renderer) for label in ticks if label.get_text()]
            assert 1 <= len(extents) <= 6
            for low, high in pairwise(extents):
                assert low.y1 < high.y0, name
            label = axes.yaxis.label.get_window_extent(renderer)
            assert all(label.x1 < extent.x0 for extent in extents), name
        assert re.fullmatch(r"time \$t\$ \((10[⁻⁰-⁹¹²³]+ )?s\)", figure.axes[-1].get_xlabel())
        times = [label.get_window_extent(renderer) for label in figure.axes[-1].get_xticklabels()]
        assert len(times) >= 2
        for left, right in pairwise(times):
            assert left.x1 < right.x0
        for text in visible_texts(figure):
            extent = text.get_window_extent(renderer)
            assert extent.x0 >= -1, (name, text)
            assert extent.x1 <= page.x1 + 1, (name, text)
            assert extent.y0 >= -1, (name, text)
            assert extent.y1 <= page.y1 + 1, (name, text)


def test_the_circuit_has_the_figures_of_the_paper() -> None:
    assert set(describe(make_result(samples=51))) == CIRCUIT_FIGURES


def test_axes_carry_the_units_of_their_signals() -> None:
    drawn = ["states", "estimates_a", "estimates_b", "parameter_error", "state_error_a"]
    figures = dict(draw(make_result(samples=51), drawn))
    labels = {name: [axes.get_ylabel() for axes in fig.axes] for name, fig in figures.items()}
    assert labels["states"] == ["states (V)", "states (A)"]
    [(_, one_curve_each)] = draw(make_result(samples=51), ["signals"])
    assert {axes.get_legend() for axes in one_curve_each.axes} == {None}
    assert labels["estimates_a"] == ["$e_{1}$ (V)", "$e_{2}$ (V)", "$i_L$ (A)"]
    assert labels["estimates_b"] == [
        r"$\mathrm{ir}_{1}$ (A)", r"$\mathrm{ir}_{2}$ (A)", r"$\mathrm{iv}$ (A)"
    ]
    assert labels["parameter_error"] == [
        r"$|\hat{e}_{0,e_{1}} - e_{0,e_{1}}|$ (V)",
        r"$|\hat{e}_{0,e_{2}} - e_{0,e_{2}}|$ (V)",
        r"$|\hat{e}_{0,i_L} - e_{0,i_L}|$ (A)",
    ]
    assert labels["state_error_a"][2] == r"$|\hat{i}_L - i_L|$ (A)"


def test_mathematics_is_broken_at_a_minus_sign_or_not_at_all() -> None:
    result = make_result(samples=51)
    names = tuple(f"substrates_{i}" for i in range(6))
    parameters = tuple(f"e0_{name}" for name in names[:3])
    long = replace(
        result, system=replace(result.system, states=names, units=dict.fromkeys(names, "g/l")),
        estimation=replace(estimation_of(result), names=parameters),
    )
    broken = False
    for name, figure in draw(long, ["estimates_a", "parameter_error", "state_error_b"]):
        rendered(figure)  # raises for mathematics that is none
        for axes in figure.axes:
            lines = axes.get_ylabel().split("\n")
            assert all(line.count("$") % 2 == 0 for line in lines), name
            broken |= "$\n$- " in axes.get_ylabel()
    assert broken


def test_time_axis_of_other_scales() -> None:
    for result, label in ((make_result(samples=9), "s"), (at_times(0.0, 2e-6), "10⁻⁶ s")):
        [(_, figure)] = draw(result, ["states"])
        assert figure.axes[-1].get_xlabel() == f"time $t$ ({label})"


def test_a_band_has_both_its_edges_in_the_figure_and_in_the_table() -> None:
    t, edge = np.arange(3.0), np.full(3, 0.5)
    band = style.Curve(t, edge, "band", replace(style.line(0), dots=True), down_to=-edge)
    panel = style.Panel("y", (band,), vertical=(1.5, "t_c"))
    axes = style.compose([panel]).axes[0]
    assert [line.get_ydata()[0] for line in axes.lines[:2]] == [0.5, -0.5]
    low, high = axes.get_xlim()
    assert (low < t[0], high > t[-1]) == (True, True), "whole dots at either end"
    [_, *columns], [vertical] = blocks([panel])
    assert (vertical.name, *vertical.values) == ("t_c", 1.5)
    assert [c.values[0] for c in columns] == [0.5, -0.5]
    assert [c.name for c in columns] == ["y: band", "y: band, lower edge"]


def test_power_of_ten_stands_with_the_unit() -> None:
    [(_, figure)] = draw(long_names(), ["states"])
    assert figure.axes[0].get_ylabel() == "states (10⁷ mA)"
    assert all(len(label.get_text()) <= 4 for label in figure.axes[0].get_yticklabels())


def test_without_an_observer_there_are_states_and_signals() -> None:
    result = without_observer(make_result(samples=51))
    assert set(describe(result)) == {"states", "signals"}
    with pytest.raises(ConfigError, match=r"nothing for gram, delta; it has signals, states$"):
        draw(result, ["gram", "delta"])


def test_rotating_kernel_does_not_divide_the_states() -> None:
    names = set(describe(RESULTS["rotating kernel"]()))
    assert {"estimates", "state_error"} <= names
    assert not {"estimates_a", "estimates_b", "state_error_a", "state_error_b"} & names


def test_without_mixing_there_is_no_delta() -> None:
    assert "delta" not in describe(make_result(samples=51, mixing=False))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_each_parameter_has_its_eigenvalue(count: int) -> None:
    result = make_result(samples=51, parameters=("e0_e1", "e0_e2")[:count])
    (panel, *_) = describe(result, ["gram"]).get("gram", [None])
    assert (panel is None) == (count == 0)
    assert panel is None or len(panel.curves) == count + 1


EIGENVALUES = [rf"$\lambda_{{{k}}}$" for k in (1, 2, 3)]


@pytest.mark.parametrize(("name", "gammas", "title", "entries"), [
    ("parameter_error", (1e10, 1e8), "", ["γ = 10¹⁰", "γ = 10⁸"]),
    ("state_error_a", (1e6, 1e7, 1e8, 1e9), "", [f"γ = 10{power}" for power in "⁶⁷⁸⁹"]),
    ("state_error_a", tuple(np.logspace(6, 12, 25)), "4 of 25 cases:",
     ["γ = 10⁶", "γ = 10⁸", "γ = 10¹⁰", "γ = 10¹²"]),
    ("gram", (1e10, 1e8), "", [*EIGENVALUES, r"$\rho$ = 10⁻⁷", "$t_c$ = 0.24 s"]),
])
def test_legends(name: str, gammas: tuple[float, ...], title: str, entries: list[str]) -> None:
    """Cases by the gain that varies, four of many, and the level and the time of excitation."""
    [(_, figure)] = draw(make_result(gammas=gammas, samples=51), [name])
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert legend.get_title().get_text() == title
    assert [text.get_text() for text in legend.get_texts()] == entries


def test_small_errors_are_visible_and_zeros_are_not_drawn() -> None:
    result = make_result()
    estimation = estimation_of(result)
    parameters = estimation.parameters.copy()
    parameters[0, 100, 0] = 1.0  # the truth: error zero
    parameters[0, 200, 0] = 1.0 + 2.3e-16
    result = replace(result, estimation=replace(estimation, parameters=parameters))
    [(_, figure)] = draw(result, ["parameter_error"])
    axes = figure.axes[0]
    low, high = axes.get_ylim()
    assert axes.get_yscale() == "log"
    assert 1e-17 < low <= 1e-15
    assert high >= 1.0
    drawn = np.asarray(axes.get_lines()[0].get_ydata())
    assert np.isnan(drawn[100])


@pytest.mark.parametrize("name", [None, "ggplot", "dark_background", "seaborn-v0_8-talk"])
def test_a_legend_is_within_its_figure_in_every_style(name: str | None) -> None:
    curve = style.Curve(np.arange(3.0), np.arange(3.0), "drem", style.line(0))
    figure = style.compose([style.Panel("x", (curve,), legend=True)], OutputSettings(style=name))
    [legend] = [axes.get_legend() for axes in figure.axes]
    box = legend.get_window_extent()
    assert box.y1 <= figure.bbox.y1 + 1.0
    assert not legend.get_frame_on()


def test_thinned_estimates_are_compared_at_their_own_times() -> None:
    [(_, figure)] = draw(make_result(thin=7), ["state_error_b"])
    final = np.asarray(figure.axes[0].get_lines()[0].get_ydata())[-1]
    assert final < 1e-13


def test_a_name_too_long_for_its_axis_stands_on_several_lines_with_its_unit() -> None:
    figure = dict(draw(long_names(), ["state_error"]))["state_error"]
    names = ["".join(axes.get_ylabel().split("\n")) for axes in figure.axes]
    assert [name.replace(" ", "") for name in names] == [
        f"errorof{name}(mA)" for name in long_names().system.states
    ]


def test_a_formula_is_broken_before_its_sign_and_nowhere_else() -> None:
    axes = style.new_figure(3.0, 2.0).add_subplot()
    style._set_name(axes, symbols.error_of("substrate", {}, signed=False), "g/l", 0.5)
    first, second, unit = axes.get_ylabel().split("\n")
    assert first == r"$|\widehat{\mathrm{substrate}}$"
    assert (second, unit) == (r"$- \mathrm{substrate}|$", "(g/l)")


def test_one_case_that_diverges_does_not_hide_the_others() -> None:
    [(_, figure)] = draw(wild(), ["state_error_a"])
    low, high = figure.axes[1].get_ylim()
    assert low < 1e-12
    assert high > 1e199


def test_figures_may_be_drawn_in_several_threads() -> None:
    """matplotlib has one parser of formulas and one set of settings for all of them."""
    result, before = make_result(samples=5), dict(mpl.rcParams)

    def drawn(_number: int) -> bytes:
        return style.file_content(dict(draw(result, ["gram"]))["gram"], "png")

    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(drawn, range(4))) == {drawn(0)}
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize("label", ["i_{", r"\nosuch{x}", r"\frac{1}", "_"])
def test_a_label_that_cannot_be_set_is_refused(label: str) -> None:
    result = make_result(samples=5)
    result = replace(result, system=replace(result.system, labels={"il": label}))
    with pytest.raises(ConfigError, match=r"^labels\.il: "):
        draw(result, ["states"])


@pytest.mark.parametrize("label", [
    "i_L", r"a\_b", r"\mathrm{a\_b}_1", r"\frac{a_1}{b}", r"\dot{x_1}", r"\sqrt{x_2}", "{a_b}^c",
    r"\left(x_1\right)",
])
@pytest.mark.parametrize("signed", [False, True])
def test_a_label_that_can_be_set_has_a_hat_that_can(label: str, signed: bool) -> None:
    for text in (f"${label}$", symbols.error_of("il", {"il": label}, signed=signed)):
        MathTextParser("agg").parse(text)


def test_an_error_with_its_sign_on_a_linear_axis() -> None:
    result = make_result()
    output = replace(result.settings.output, error="linear")
    result = replace(result, settings=replace(result.settings, output=output))
    [(_, figure)] = draw(result, ["state_error_a"])
    axes = figure.axes[0]
    assert axes.get_yscale() == "linear"
    assert axes.get_ylabel() == r"$\hat{e}_{1} - e_{1}$ (V)"
    expected = estimation_of(result).states[0, :, 0] - result.signals.states[:, 0]
    np.testing.assert_array_equal(np.asarray(axes.get_lines()[0].get_ydata()), expected)


@pytest.mark.parametrize(("width", "inches"), [("column", 3.5), ("page", 7.16), (5.0, 5.0)])
def test_figures_are_as_wide_as_asked_for(width: float, inches: float) -> None:
    result = make_result(samples=11)
    output = replace(result.settings.output, width=width, dpi=100)
    result = replace(result, settings=replace(result.settings, output=output))
    for _, figure in draw(result, ["states", "gram"]):
        assert figure.get_figwidth() == pytest.approx(inches)


IN_MATHEMATICS = {
    "x1": "$x_{1}$", "theta": r"$\theta$", "theta1": r"$\theta_{1}$", "il": "$i_L$",
    "e0_il": "$e_{0,i_L}$", "ir2": r"$\mathrm{ir}_{2}$", "xi_a0": r"$\xi_{a_{0}}$",
    "leak": r"$\mathrm{leak}$", "flow_of_inlet": "flow_of_inlet",
    "flow_of_tank": r"$\mathrm{flow}_{\mathrm{of},\mathrm{tank}}$",
}
NUMBERS = {1e10: "10¹⁰", -1e-7: "−10⁻⁷", 2.5e-7: "2.5·10⁻⁷", 0.5: "0.5", 0.0: "0",
           9999.0: "9999", 1.5e4: "1.5·10⁴", -3.25: "−3.25", -math.inf: "−inf"}
GAINS = {"gamma": "γ", "gamma_2": "γ₂", "f0": "f₀", "lambda_1": "λ₁", "window": "window"}


def test_names_and_numbers_are_written_as_people_write_them() -> None:
    assert {x: symbols.typeset(x, {"il": "i_L"}) for x in IN_MATHEMATICS} == IN_MATHEMATICS
    assert {x: symbols.number_text(x) for x in NUMBERS} == NUMBERS
    assert {x: symbols.symbol(x) for x in GAINS} == GAINS
    assert symbols.with_unit("load", "N*m") == "load (N·m)"


def test_what_stands_for_a_state_has_its_unit():
    """In a second file, too; an unknown k_2 is no second k."""
    units = {"x": "m", "x_2": "s", "k": "A"}
    names = "x", "e0_x", "e0_x_3", "e0_x_2", "k", "k_2", "e0_1"
    found = [symbols.unit_of(name, units) for name in names]
    assert found == ["m", "m", "m", "s", "A", "", ""]


@pytest.mark.parametrize("unit", [1.0, 1e-20])
def test_a_logarithmic_axis_has_the_size_of_what_is_drawn_in_it(unit: float) -> None:
    result = make_result(samples=11)
    estimation, excitation = estimation_of(result), result.excitation
    assert estimation.delta is not None
    assert excitation is not None
    small = replace(
        result, estimation=replace(estimation, delta=unit * estimation.delta),
        excitation=replace(excitation, gram_eigenvalues=unit * excitation.gram_eigenvalues),
    )
    for name in ("delta", "gram"):
        (panel,) = describe(small, [name])[name]
        drawn = [curve.y for curve in panel.curves if curve.style is not style.LIMIT]
        assert panel.size == np.nanmax(drawn)


@pytest.mark.parametrize(("log", "high"), [(False, 3.0), (True, 20.0)])
def test_an_axis_of_one_value_has_a_length(log: bool, high: float) -> None:
    curve = style.Curve(np.array([2.0]), np.ones(1), "", style.line(0))
    panel = style.Panel("y", (curve,), axis=style.Axis("g", "gain", log=log))
    low, reached = style.compose([panel]).axes[0].get_xlim()
    assert (low, reached) == pytest.approx((2.0, high), rel=0.05)


def test_at_most_eight_panels_and_it_says_so() -> None:
    panel = style.Panel("x", (style.Curve(np.arange(3.0), np.arange(3.0), "", style.line(0)),))
    figure = style.compose([panel] * 30)
    assert len(figure.axes) == style.MAX_PANELS
    assert figure.texts[0].get_text() == "8 of 30 shown"


@pytest.mark.parametrize(("values", "log", "says"), [
    ([1.0, 0.0, 0.0, 0.0], True, "zero but at single times"),
    ([0.0, 1e-9, 0.0, 1e-9], True, "zero but at single times"),
    ([0.0, 0.0, 0.0, 0.0], True, "zero throughout"),
    ([np.nan, 0.0, np.nan, np.nan], True, "zero throughout"),
    ([np.nan, 2.0, np.nan, 3.0], False, "no finite values but at single times"),
    ([np.nan, np.nan, np.nan, np.inf], False, "no finite values"),
    ([1.0, 1e-9, 0.0, 0.0], True, ""),
    ([0.0, 0.0, 0.0, 0.0], False, ""),
])
def test_a_panel_in_which_nothing_is_seen_says_so(
    values: list[float], log: bool, says: str
) -> None:
    def said(line: style.Line) -> list[str]:
        curve = style.Curve(np.arange(4.0), np.array(values), "", line)
        (axes,) = style.compose([style.Panel("x", (curve,), log=log)]).axes
        return [text.get_text() for text in axes.texts]

    line = style.line(0)
    assert said(line) == ([says] if says else [])
    assert said(replace(line, dots=True)) == ([says] if says and "single" not in says else [])


def test_what_was_measured_is_drawn_if_any_of_it_is_not_the_truth() -> None:
    result = make_result(samples=11)
    measured = result.signals.outputs + np.eye(11)[:, :1]
    noisy = replace(result, simulation=replace(result.simulation, measured_outputs=measured))
    _, outputs = describe(noisy, ["signals"])["signals"]
    assert [curve.label for curve in outputs.curves] == ["y measured", "y"]


@pytest.mark.parametrize(("truth", "guesses", "size", "limits"), [
    ([1.0, 3.0], [2.0, np.nan], 0.0, (1.0, 3.0)), ([1.0, 3.0], [0.0, 4.0], 0.0, (0.0, 4.0)),
    ([1.0, 3.0, np.nan], [-99.0, 99.0, np.inf], 0.0, (-3.0, 7.0)),
    ([1.0, 3.0], [-99.0, 99.0], 5.0, (-9.0, 13.0)), ([-2.0], [-99.0, 99.0], 0.0, (-6.0, 2.0)),
    ([0.0], [-99.0, 99.0], 0.0, (-2.0, 2.0)), ([np.nan], [1.0], 1.0, None),
])
def test_a_wild_estimate_is_cut_at_twice_the_range_of_the_truth(
    truth: list[float], guesses: list[float], size: float, limits: tuple[float, float] | None
) -> None:
    assert figures._estimate_limits(np.array(truth), np.array([guesses]), size) == limits


def test_a_truth_that_is_known_at_some_times_is_drawn_and_a_wild_estimate_cut_by_it() -> None:
    result = make_result((1e10,), samples=11)
    states = result.signals.states.copy()
    states[:3] = np.nan
    estimation = estimation_of(result)
    wild = replace(estimation, states=np.full_like(estimation.states, 1e6))
    result = replace(result, estimation=wild, simulation=replace(result.simulation, states=states))
    panel, *_ = describe(result, ["estimates_a"])["estimates_a"]
    assert [curve.label for curve in panel.curves] == ["true", "drem"]
    assert panel.limits is not None
    assert panel.limits[1] < 100.0


def test_a_residual_is_what_was_measured_less_what_is_fitted() -> None:
    result = make_result(samples=11)
    fit = Fit(np.ones(1), 1.0, 1.0, outputs=result.signals.outputs - 0.25)
    outputs, residual = describe(replace(result, fit=fit), ["fit"])["fit"]
    assert [curve.label for curve in outputs.curves] == ["y measured", "y fitted"]
    np.testing.assert_allclose(residual.curves[0].y, 0.25)
    assert (residual.name, residual.unit) == ("residual of y", "A")


@pytest.mark.parametrize("errors", [("log", "log"), ("log", "linear"), ("linear", "log")])
def test_errors_of_several_runs_are_on_a_logarithmic_axis_if_all_of_them_are(
    errors: tuple[str, str]
) -> None:
    result = make_result(samples=11)
    outputs = [OutputSettings(error=error) for error in errors]
    runs = [replace(result, settings=replace(result.settings, output=own)) for own in outputs]
    panels = figures._norm_panels([("", own, 0) for own in runs])
    assert {panel.log for panel in panels} == {"linear" not in errors}
    assert [panel.legend for panel in panels] == [True, False]
    nobody = without_observer(result)
    assert figures._norm_panels([("", nobody, 0)]) == []


@pytest.mark.parametrize(("settled", "names"), [
    (None, ["final error", "time to 1 %"]), ({}, ["final error"]),
    ({"il": np.array([np.nan, 3.0, 2.0]), "iv": np.array([np.nan, 1.0, 4.0])},
     ["final error", "time to ±2σ"]),
])
def test_under_noise_the_time_to_settle_stands_for_that_to_one_percent(
    settled: Any, names: list[str]
) -> None:
    """Of the last quantity, over the gain; where nobody knows it there is no panel."""
    result = make_result((1e10, 1e8, 1e6), samples=11)
    assert result.metrics is not None
    result = replace(result, metrics=replace(result.metrics, seconds_to_settled=settled))
    panels = describe(result, ["gains"])["gains"]
    assert [panel.name for panel in panels] == names
    if settled:
        (curve,) = panels[1].curves
        np.testing.assert_array_equal(curve.x, [1e6, 1e8, 1e10])
        np.testing.assert_array_equal(curve.y, [4.0, 3.0, np.nan])


def test_there_is_no_panel_of_times_that_never_come() -> None:
    result = make_result((1e10, 1e8, 1e6), samples=11)
    assert result.metrics is not None
    never = {f"seconds_to_1pct_{of}": np.full(3, np.inf) for of in ("parameters", "states")}
    result = replace(result, metrics=replace(result.metrics, **never))
    assert [panel.name for panel in describe(result, ["gains"])["gains"]] == ["final error"]


@pytest.mark.parametrize(("gammas", "bands"), [((1e10,), 1), ((1e10, 1e8), 0)])
def test_deviations_are_drawn_about_a_single_case(gammas: tuple[float, ...], bands: int) -> None:
    result = make_result(gammas, samples=11)
    estimation = estimation_of(result)
    spread = replace(estimation, states_std=np.full_like(estimation.states, 3.0))
    for error in ("log", "linear"):
        output = replace(result.settings.output, error=error)
        told = replace(result, estimation=spread, settings=replace(result.settings, output=output))
        for panel in (p for own in describe(told, ["estimates_a", "state_error_a"]).values()
                      for p in own):
            found = [curve for curve in panel.curves if curve.label.endswith("2σ")]
            assert len(found) == bands
            for band in found:  # about the estimate, or about no error
                middle = panel.curves[1].y if panel.curves[0].label == "true" else 0.0
                np.testing.assert_allclose(band.y - middle, 6.0)
                assert (band.down_to is None) == panel.log
                if band.down_to is not None:
                    np.testing.assert_allclose(band.down_to - middle, -6.0)


def test_unknown_figures_are_refused_at_once() -> None:
    with pytest.raises(ConfigError, match=r"no figure 'gramm'; known: .*did you mean gram\?"):
        draw(make_result(samples=5), ["gramm"])
    with pytest.raises(ConfigError, match="known: signals, regressor"):
        draw(make_result(samples=5), ["zzz"])


def test_png_files_fill_one_column(tmp_path: Path) -> None:
    result = with_figures(make_result(), True)
    write_run(result, tmp_path, "", Provenance({}, None))
    paths = sorted((tmp_path / "figures").iterdir())
    assert {path.stem for path in paths} == CIRCUIT_FIGURES
    for path in paths:
        with Image.open(path) as image:
            image.load()  # checks every checksum
            assert image.width == 700
            assert image.info["dpi"][0] == pytest.approx(style.DPI, rel=1e-4)


def test_a_figure_that_cannot_be_written_names_its_file(tmp_path: Path) -> None:
    [(_, figure)] = draw(make_result(samples=51), ["delta"])
    with pytest.raises(GpeboError, match=r"cannot write .*nowhere/delta\.png"):
        style.save(figure, tmp_path / "nowhere" / "delta.png")


def test_drawing_leaves_the_settings_of_matplotlib_alone() -> None:
    settings: Any = mpl.rcParams
    before = {key: settings[key] for key in style.sheet()}
    for _ in draw(make_result(samples=51), ["states"]):
        assert {key: settings[key] for key in style.sheet()} == before


def test_lines_differ_without_their_colours() -> None:
    assert len({line.dashes for line in style.LINES}) == len(style.LINES)
    lines = [style.line(number) for number in range(49)]
    assert len({(line.color, line.dashes) for line in lines}) == 49


@pytest.mark.parametrize(
    ("high", "powers"), [(9e3, []), (1.2e4, [4]), (0.012, []), (1.2e-3, [-3])]
)
def test_a_power_of_ten_stands_beside_numbers_that_are_large_or_small(
    high: float, powers: list[int]
) -> None:
    t = np.array([0.0, 1.0])
    panel = style.Panel("y", (style.Curve(t, high * t, "", style.line(0)),))
    [axes] = style.compose([panel]).axes
    text = "".join(text.get_text() for text in axes.findobj(Text))
    assert [power for power in range(-9, 10) if style.power_of_ten(power) in text] == powers


@settings(max_examples=30)
@given(st.floats(-1e6, 1e6, allow_subnormal=False), st.floats(1e-3, 1e6, allow_subnormal=False))
def test_linear_ticks_are_few_inside_and_distinct(low: float, span: float) -> None:
    t = np.array([0.0, 1.0])
    panel = style.Panel("y", (style.Curve(t, np.array([low, low + span]), "", style.line(0)),))
    [axes] = style.compose([panel]).axes
    bottom, top = axes.get_ylim()
    assert 1 <= len(axes.get_yticks()) <= 6
    assert all(bottom <= tick <= top for tick in axes.get_yticks())
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert len(set(labels)) == len(labels)
    if len(labels) > 1 and "." in labels[0]:
        assert any(label[-1] != "0" for label in labels), "no more decimals than tell them apart"


@settings(max_examples=30)
@given(st.integers(-320, 300), st.integers(1, 600))
def test_log_ticks_are_few(low: int, span: int) -> None:
    ends = np.array([10.0**low, 10.0 ** min(low + span, 300)])
    panel = style.Panel("y", (style.Curve(np.arange(2.0), ends, "", style.line(0)),), log=True)
    [axes] = style.compose([panel]).axes
    assert 1 <= len(axes.get_yticks()) <= 6
    assert axes.get_ylim()[0] <= max(ends[0], 1e-300)


def test_every_figure_is_found_by_the_name_of_its_file() -> None:
    assert set(FIGURES) >= CIRCUIT_FIGURES
    assert set(UNITS) >= {"e1", "V", "y"}
