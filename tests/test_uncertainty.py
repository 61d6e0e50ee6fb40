"""Standard deviations against closed forms, against seeds, and of recordings."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from examples import ROOT
from plants import one_state, shipped
from processes import write_table
from scipy.linalg import expm

from gpebo_cli import run
from gpebo_cli.estimators import ErrorSystem, LinearRegression
from gpebo_cli.evidence import uncertainty
from gpebo_cli.evidence.error_maps import error_maps
from gpebo_cli.evidence.metrics import settling_times
from gpebo_cli.evidence.uncertainty import _agree, _layered, _mesh, deviations, noise_level
from gpebo_cli.experiment import uncertainty as of_runs
from gpebo_cli.experiment.pipeline import stream
from gpebo_cli.experiment.result import Fit
from gpebo_cli.experiment.verdict import _explains
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.numerics.rows import Rows
from gpebo_cli.observers.remedies import reset
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.report import run_lines
from gpebo_cli.results.summary import summary
from gpebo_cli.settings import DataSettings, NoiseSettings, Settings, TimeSettings

sys.path.insert(0, str(ROOT / "docs"))
import uncertainty as page

SEEDS = 300
WHY = (
    "a missing or wrong parameter, a column of another unit or sign (data.scale, data.time_unit), "
    "a sensor that drifts or saturates, a noisy input, or a delay"
)
TIMES = " times what the sensors' noise makes"
ESTIMATORS = (
    {"name": "gradient"}, {"name": "least_squares"}, {"name": "least_squares", "beta": 0.3},
    {"name": "least_squares", "beta": 0.3, "f0": 0.1, "bound": 1e3}, {"name": "ls_drem"},
    {"name": "ls_drem", "beta": 0.2}, {"name": "drem", "gamma": 1e14}, {"name": "mre"},
    {"name": "lion", "gamma": 1e10}, {"name": "fct", "gamma": 1e14},
    {"name": "instrumental"}, {"name": "annihilator"}, {"name": "exciting"},
)


def directly(t, inside):
    """An observer that hands the error of its one output on to Y; there is no state."""
    return ErrorSystem(
        np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), np.zeros((1, 2, 1)), np.array([[[1.0], [0.0]]])
    )


def summing(f0):
    """Least squares of one parameter with ψ = 1: δη̂ = ∫e/(f₀ + t)."""
    def at(t, inside):
        return ErrorSystem(
            np.zeros((1, 1, 1)), np.ones((len(t), 1, 1)), (1.0 / (f0 + t))[:, None, None],
            np.zeros((1, 1, 1)),
        )

    return at


@pytest.mark.parametrize(("rows", "step"), [(100, 0.1), (1, 20.0)])
def test_the_mean_of_white_samples(rows, step):
    """Var = σ²T_s·t/(f₀ + t)² at the instants, and between them what the part of a sample adds."""
    sigma, f0 = 0.3, 0.5
    t = np.array([0.1, 0.25, 1.0, 7.03, 10.0])
    of_eta, of_x = deviations(
        directly, summing(f0), np.full((5, 1, 1), 2.0), np.linspace(0, 10, 5),
        Rows(np.arange(rows) * step), np.array([sigma**2]), t,
    )
    whole = np.floor(t / step + 1e-9)
    part = t - whole * step
    expected = sigma * np.sqrt(whole * step**2 + part**2) / (f0 + t)
    np.testing.assert_allclose(of_eta[:, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(of_x[:, 0], 2.0 * expected, rtol=1e-9)


@pytest.mark.parametrize("chunk", [1 << 22, 1])
def test_where_rounding_decides_at_the_start_the_first_row_alone_says_nothing(chunk, monkeypatch):
    """Though C is a number before the second row comes."""
    monkeypatch.setattr(uncertainty, "_CHUNK", chunk)

    def mean(t, inside):
        made = summing(0.0)(t, inside)
        return made._replace(C=np.where(inside[:, None, None] < 0.01, np.nan, made.C))

    t = np.array([0.005, 0.05, 0.1, 0.15, 1.0])
    of_eta, of_x = deviations(
        directly, mean, np.ones((5, 1, 1)), np.linspace(0, 1, 5), Rows(np.arange(10) * 0.1),
        np.ones(1), t,
    )
    np.testing.assert_array_equal(of_eta, of_x)
    assert np.isnan(of_eta[:3]).all()
    np.testing.assert_allclose(of_eta[3:, 0], np.sqrt([0.0125, 0.1]) / [0.15, 1.0], rtol=1e-6)


@pytest.mark.parametrize("rate", [1e-2, 1.0, 10.0, 1e2, 1e3, 1e4, 1e6, 1e10])
def test_an_estimate_that_follows_samples_at_once_does_so_between_them(rate):
    """s' = λ(e − s): of s at a sample e^{−λt} is left, and the rest is its new error."""
    sigma, step = 0.3, 0.5
    t = np.unique(np.concatenate([np.linspace(0.01, 9.99, 297), 1.5 + np.logspace(-9, -1, 9)]))
    found, _ = deviations(
        directly, lambda *_: ErrorSystem(*np.array([-rate, rate, 1.0, 0.0]).reshape(4, 1, 1, 1)),
        np.ones((len(t), 1, 1)), np.linspace(0, 10, 5), Rows(np.arange(20) * step),
        np.array([sigma**2]), t,
    )
    whole = np.floor(t / step + 1e-12)
    held, old = np.exp(-rate * step), np.exp(-rate * (t - whole * step))
    before = (1.0 - held) ** 2 * (1.0 - held ** (2.0 * whole)) / -np.expm1(-2.0 * rate * step)
    expected = sigma * np.sqrt(old**2 * before + (1.0 - old) ** 2)
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-3, atol=1e-3 * sigma)


def test_the_level_is_that_of_the_residual_less_what_the_fit_takes():
    """White samples around a constant: σ² is Σ(y − mean)²/(N − 1), which has no bias."""
    sample = np.random.default_rng(3).normal(2.0, 0.3, 5)
    regression, small = (LinearRegression.from_functions(
        lambda t, size=size: np.full((*t.shape, 1, 1), size),
        lambda t: np.repeat(sample, t.shape[1]).reshape(*t.shape, 1), ["a"], 5.0, 5,
    ) for size in (1.0, 1e-5))
    some, more = np.linspace(0.0, 5.0, 6), np.arange(-7.0, 9.0)  # with rows of others
    for about, rows in ((regression, some), (regression, more), (small, some)):
        level = noise_level(directly, about, Rows(rows), np.ones(1))
        assert level == pytest.approx(np.std(sample, ddof=1), rel=1e-9)


def test_the_level_of_segments_is_their_mean_square_over_time(monkeypatch):
    """σ = 1 for one second and σ = 2 for three; of a segment of which nobody knows it, nothing."""
    monkeypatch.setattr(of_runs, "noise_level", lambda _, own, *__: own.level)
    ends = [(2.0, 3.0, 1.0), (3.0, 6.0, 2.0), (6.0, 9.0, np.nan)]
    segments = [SimpleNamespace(mesh=SimpleNamespace(edges=(start, 0.5 + start, end)), level=level)
                for start, end, level in ends]
    found = of_runs._level(None, SimpleNamespace(segments=segments), None, np.ones(1), None)
    assert found == pytest.approx(np.sqrt((1.0 + 3.0 * 4.0) / 4.0))


@pytest.mark.parametrize(("name", "remedy", "chosen"), [
    ("descriptor", "none", ESTIMATORS), ("circuit", "none", ESTIMATORS[1:2]),
    ("descriptor", "output_injection", ESTIMATORS[1:2]),
])
def test_deviations_are_those_of_the_seeds(name, remedy, chosen):
    observer = {"name": "gpebo", "remedy": remedy}
    found = page.errors_over_seeds(
        shipped(name), chosen, SEEDS, np.array([8.0, 14.0, 20.0]), observer
    )
    for settings, one in zip(chosen, found, strict=True):
        seen = one.errors.std(axis=2, ddof=1)
        known = seen > 1e-12
        assert known.sum() > 10
        ratio = one.predicted[known] / seen[known]
        # A deviation from 300 seeds has a deviation of 4.1 % of its own; thirty numbers here.
        assert np.abs(np.log(ratio)).max() < 0.18, settings
        assert abs(np.log(ratio).mean()) < 0.08, settings
        assert one.predicted[~known].max(initial=0.0) < 1e-6


def fed(system, estimator, t, u, y, hold="linear", noise=None, cut=0):
    """Every estimate, deviation and level of a stream, the rows in one batch or in two."""
    settings = Settings(
        estimator=estimator, data=DataSettings("csv", "-", hold),
        time=TimeSettings(-np.inf, np.inf, 11), noise=noise or NoiseSettings(),
    )
    online = stream(settings, system)(float(t[0]), np.append(u[0], y[0]))
    parts = [part for part in (slice(0, cut), slice(cut, None)) if len(t[part])]
    made = [online.feed(t[part], u[part], y[part]) for part in parts]
    return [
        np.concatenate([np.concatenate([m.parameters, m.states], axis=2)[0] for m in made]),
        np.concatenate([m.std[0] for m in made]), np.concatenate([m.level for m in made]),
    ]


@pytest.mark.parametrize(("hold", "estimator"), [
    ("zoh", {"name": "least_squares"}), ("linear", {"name": "least_squares", "beta": 0.3}),
    ("linear", {"name": "ls_drem", "beta": 0.2}), ("zoh", {"name": "drem", "gamma": 1e8}),
    ("linear", {"name": "drem", "gamma": 1e8}),
    ("zoh", {"name": "gradient"}), ("linear", {"name": "gradient"}), ("zoh", {"name": "mre"}),
    ("linear", {"name": "mre"}), ("linear", {"name": "fct", "gamma": 1e8}),
    ("zoh", {"name": "exciting"}), ("linear", {"name": "exciting", "kappa": 1e7}),
    ("linear", {"name": "lion", "gamma": 1e6}),
    ("zoh", {"name": "instrumental", "gamma": 1e6}),
    ("linear", {"name": "annihilator", "gamma": 1e6, "perturbed": ["theta1"]}),
])
def test_at_samples_they_are_what_each_error_by_itself_does(hold, estimator):
    t = np.cumsum(np.random.default_rng(1).uniform(0.2, 0.6, 10))
    u, y = np.sin(t)[:, None], np.cos(2 * t)[:, None]
    assert_responses_add_up(shipped("descriptor"), estimator, t, u, y, hold, (0.3, 0.2))


def assert_responses_add_up(system, estimator, t, u, y, hold, sigmas):
    """Estimates are affine in every sample: the variances of the responses add up, to rounding."""
    noise = NoiseSettings(name="gaussian", outputs=sigmas[0], inputs=sigmas[1])
    base, std, level = fed(system, estimator, t, u, y, hold, noise, cut=4)
    np.testing.assert_array_equal(level, 1.0)
    variance = np.zeros_like(std)
    for one in np.eye(len(t))[:, :, None]:
        for sigma, signals in zip(sigmas, ((u, y + one), (u + one, y)), strict=True):
            if sigma:
                variance += (sigma * (fed(system, estimator, t, *signals, hold)[0] - base)) ** 2
    np.testing.assert_allclose(std, np.sqrt(variance), rtol=1e-5, atol=1e-7)


def test_a_stream_of_a_law_whose_errors_nobody_knows_has_no_deviations():
    settings = Settings(
        estimator={"name": "power"}, noise=NoiseSettings(name="gaussian", outputs=0.1),
        data=DataSettings("csv", "-", "linear"), time=TimeSettings(-np.inf, np.inf, 11),
    )
    t = np.linspace(0.0, 2.0, 11)
    made = stream(settings, shipped("descriptor"))(0.0, np.array([0.0, 1.0])).feed(
        t, np.sin(t)[:, None], np.cos(t)[:, None]
    )
    assert np.isfinite(made.states).all()
    assert made.std is None


TANK = one_state(
    states=["h"], inputs={"u": 0}, unknowns={"gain": 1, "leak": 1}, A=[["-1 - 0.3*u"]],
    F=[["u", -1]], initial_state=[0],
)


# z = h is measured: what estimates say of it and h has errors of y in it at once.
SEEN_TANK = {
    **TANK, "states": ["h", "z"], "E": [[1, 0], [0, 0]], "A": [["-1 - 0.3*u", 0], [1, -1]],
    "F": [["u", -1], [0, 0]], "C": [[0, 1]], "initial_state": [0, 0],
}


def noisy_rows(folder, noise, samples):
    """A file of what was measured of the descriptor plant, with noise."""
    made = run("descriptor", noise=noise, time={"samples": samples}).to_pandas("signals")
    measured = made.filter(regex="measured").rename(columns=lambda c: c.removesuffix("_measured"))
    measured.to_csv(folder / "rows.csv")
    return str(folder / "rows.csv")


PAUSE = np.array([0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 4.0, 4.2, 4.4, 4.6])  # most of the horizon
UNEVEN = np.cumsum(np.random.default_rng(0).uniform(0.1, 1.0, 8))


@pytest.mark.parametrize(("times", "hold", "estimator", "more"), [
    ([PAUSE], "linear", {"name": "least_squares"}, {}),
    ([PAUSE], "zoh", {"name": "least_squares"}, {}),
    ([PAUSE], "zoh", {"name": "least_squares"}, {"sample_time": 0.1, "hold": "zoh"}),
    ([PAUSE], "linear", {"name": "least_squares"}, {"sample_time": 0.3, "hold": "linear"}),
    ([UNEVEN], "linear", {"name": "ls_drem"}, {"sample_time": 0.1, "hold": "zoh"}),
    ([UNEVEN], "linear", {"name": "least_squares", "beta": 0.3}, {}),
    ([UNEVEN], "linear", {"name": "gradient"}, {"remedy": "reset", "reset_times": [2.0, 3.0]}),
    ([UNEVEN], "linear", {"name": "least_squares", "f0": 0.1, "beta": 0.3},
     {"remedy": "reset", "reset_times": [2.0, 3.0], "reset_keep": 0.5}),
    ([PAUSE[4:9], UNEVEN[:5]], "linear", {"name": "least_squares"}, {}),
    ([PAUSE[:4], PAUSE[:8] + 3.0], "zoh", {"name": "least_squares"}, {}),  # 3 + (0.6 - 3) > 0.6
    ([PAUSE], "cubic", {"name": "least_squares"}, {}),
    ([PAUSE[4:9], UNEVEN[:5]], "cubic", {"name": "least_squares", "beta": 0.3}, {}),
    ([UNEVEN[:5], PAUSE[:3], UNEVEN[:2]], "cubic", {"name": "least_squares"}, {}),
    ([UNEVEN], "cubic", {"name": "gradient"}, {"remedy": "reset", "reset_times": [2.0, 3.0]}),
])
def test_of_a_recording_every_row_counts_as_one_error(times, hold, estimator, more, tmp_path):
    """Variances of what each row's error does by itself add up, in pauses, too; of two files."""
    noise = {"name": "gaussian", "outputs": 0.1}
    files = [tmp_path / f"{k}.csv" for k in range(len(times))]

    def found(rows=-1):
        """With an error in one of all rows."""
        for t, file in zip(times, files, strict=True):
            y = np.cos(t) + 0.1 * (np.arange(len(t)) == rows)
            rows -= len(t)
            table = np.column_stack([t, 1.0 + np.sin(3 * t), y])
            np.savetxt(file, table, delimiter=",", header="t,u,y", comments="")
        of = run(
            SEEN_TANK, data={"file": list(map(str, files)), "hold": hold}, noise=noise,
            estimator=estimator, time={"samples": 7}, observer={"name": "gpebo", **more},
        ).details.estimation
        return (
            np.concatenate([of.parameters[0], of.states[0]], axis=1),
            np.concatenate([of.parameters_std[0], of.states_std[0]], axis=1),
        )

    base, std = found()
    each = [found(row)[0] - base for row in range(sum(map(len, times)))]
    known = np.isfinite(base)
    assert known[2:].all()
    known[:, 2] &= "remedy" not in more  # e₀ since a reset is about an estimate
    known[0] &= "sample_time" not in more  # of the first sample nothing is told
    std = np.nan_to_num(std[known])  # of what no row has moved
    np.testing.assert_allclose(std, np.linalg.norm(each, axis=0)[known], rtol=1e-3)


@pytest.mark.parametrize("unknowns", [{"k": 1}, {"k": 1, "without_effect": 1}])
def test_what_errors_of_an_input_did_before_a_reset_stays_in_the_estimate(unknowns):
    """Of each row by itself; e₀ since a reset is about an estimate."""
    plant = one_state(inputs={"u": 0}, unknowns=unknowns, A=[[-1]], B=[[1]],
                      F=[[-1, 0][: len(unknowns)]])
    t = np.array([0.0, 0.7, 1.5, 3.0])

    def found(error):
        of = run(
            plant, data={"t": t, "u": 1.0 + np.sin(t) + error, "y": np.cos(2 * t)},
            noise={"name": "gaussian", "outputs": 0, "inputs": 0.3},
            estimator={"name": "gradient", "gamma": 2},
            observer={"name": "gpebo", "remedy": "reset", "reset_times": [1.2]},
            time={"samples": 4}, solver={"tol": 1e-8},
        ).details.estimation
        return (np.stack([of.parameters[0, 2:, 0], of.states[0, 2:, 0]]),
                np.stack([of.parameters_std[0, 2:, 0], of.states_std[0, 2:, 0]]))

    base, std = found(0.0)
    each = [found(error)[0] - base for error in 0.3 * np.eye(4)]
    np.testing.assert_allclose(std, np.linalg.norm(each, axis=0), rtol=1e-9)


def test_the_level_of_a_recording_with_a_pause_has_no_bias(tmp_path):
    """E σ̂² = σ²: the squares of what each row's error by itself would be taken for."""
    def deviation(y, noise="none"):
        table = np.column_stack([PAUSE, 1.0 + np.sin(3 * PAUSE), y])
        np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="t,u,y", comments="")
        of = run(
            TANK, data=str(tmp_path / "r.csv"), time={"samples": 3},
            estimator="least_squares", noise=noise,
        ).details.estimation
        return of.parameters_std[0, -1, 0]

    one = deviation(PAUSE, {"name": "gaussian", "outputs": 1.0})
    found = sum((deviation(row) / one) ** 2 for row in np.eye(len(PAUSE)))
    assert found == pytest.approx(1.0, abs=0.06)  # four rows of eleven are what is fitted


@pytest.mark.parametrize("rows", [2, 3])
def test_rows_that_any_estimates_explain_do_not_tell_their_noise(rows):
    t = np.linspace(0.0, 1.0, rows)
    data = {"t": t, "u": 1.0 + np.sin(3 * t), "y": np.cos(t)}
    found = run(TANK, data=data, estimator="least_squares")
    assert found.details.estimation.parameters_std is None
    assert "no standard deviations: the samples are so few" in found.verdict


@pytest.mark.parametrize(("change", "told"), [
    (lambda y: np.where(np.arange(len(y)) % 50 == 7, 9999.0, y), "24 of y (first at t = 0.14"),
    (lambda y: np.round(y / 0.05) * 0.05, "rounding (y to steps of 0.05)"),
    (lambda y: y, "explain the data up to white noise"),
    (lambda y: np.round(y, 2), "explain the data up to white noise"),  # below the noise
])
def test_gaps_written_as_numbers_and_rounding_are_told(change, told):
    """9999 leaves a white residual, too: it is as large as Y, and explains nothing."""
    t = np.linspace(0.0, 24.0, 1201)
    plant = TANK | {"A": [[-1]], "F": [["1", "sin(t)"]], "inputs": {}}
    clean = 1.0 - np.exp(-t) + 0.5 * (np.sin(t) - np.cos(t) + np.exp(-t))
    noise = 0.02 if told.startswith("explain") else 0.0
    y = change(clean + noise * np.random.default_rng(3).standard_normal(len(t)))
    assert told in run(plant, data={"t": t, "y": y}).verdict


COARSE = "rows too far apart for what y does between them (data.hold)"
NOTHING = np.zeros(5)
WHITE = ": the estimates explain the data up to white noise"
NOT = " is not white (its correlation is "
FAR = (": some samples are far from what explains the others, 24 of y (first at t = 0.14), which "
       "suggests gaps that are written as numbers (data.gaps), a sensor that fails, or rows too "
       "far apart for what moves there")


@pytest.mark.parametrize(("fit", "said"), [
    ({"least": 0.01}, (", where least squares of the same data leave 0.01: what is left says more "
                       "of these estimates than of the model")),
    ({"least": 0.02}, WHITE),
    ({"residual": [5e-5], "least": 1e-9}, ": the estimates explain the data"),
    ({"residual": [5e-4], "least": 1e-9, "size": 10.0}, ": the estimates explain the data"),
    ({"residual": [5e-6], "least": 5e-6, "size": 0.01}, WHITE),
    ({"correlation": None}, ""), ({"correlation": None, "ratio": 3.9}, f", 3.90{TIMES}"),
    ({"correlation": None, "ratio": 4.1}, f", 4.10{TIMES}, which suggests {WHY}"),
    ({"ratio": 0.05, "slow": True}, f": the residual is far below the noise, 0.05{TIMES}"),
    ({"ratio": 1.1}, f"{WHITE}, 1.10{TIMES}"),
    ({"ratio": 1.3}, (f": the residual is white, 1.30{TIMES}, which suggests a noisier sensor than "
                      "was said")),
    ({"correlation": [0.0, -0.5, 0.0, 0.0, 0.0]}, WHITE),
    ({"correlation": [0.1, -0.5, 0.0, 0.3, 0.0], "ratio": 1.0},
     f": the residual, 1.00{TIMES},{NOT}0.50), which suggests {WHY}"),
    ({"slow": True}, f": the residual{NOT}0.00, and a part of it is slow), which suggests {WHY}"),
    ({"follows": True, "in_matrices": ("y", "z")}, (
        f": the residual{NOT}0.00, and it follows the inputs), which noise of y, z in the matrices "
        f"does (observer.remedy=noise_free takes it out); or it suggests {WHY}")),
    ({"slow": True, "of_inputs": ("u",)}, (f": the residual{NOT}0.00, and a part of it is slow), "
                                           f"which noise of u does; or it suggests {WHY}")),
    ({"slow": True, "fed_back": ("y",)}, (
        f": the residual{NOT}0.00, and a part of it is slow), which noise of y does, which the "
        "observer feeds back (observer.form=strangeness_free without a remedy does not); or it "
        f"suggests {WHY}")),
    ({"slow": True, "least_white": True, "ratio": 1.0, "far": [("y", 1, 0.0)]}, (
        f": the residual, 1.00{TIMES}, is not white, that of least squares that weigh each output "
        "by its noise is: what is left says more of these estimates than of the model")),
    ({"slow": True, "least_white": True, "coarse": ["y"]}, (
        ": the residual is not white, that of least squares that weigh each output by its noise "
        f"is: what is left says more of these estimates than of the model, or of {COARSE}")),
    ({"slow": True, "coarse": ["y"]}, (f": the residual{NOT}0.00, and a part of it is slow), which "
                                       f"suggests {COARSE}, or {WHY}")),
    ({"coarse": ["y"]}, WHITE),
    ({"slow": True, "rounded": [("y", 0.05)]}, (
        f": the residual{NOT}0.00, and a part of it is slow), which suggests that it is rounding "
        f"(y to steps of 0.05), for which deviations are too small, or {WHY}")),
    ({"far": [("y", 24, 0.14)], "ratio": 2.0}, f"{FAR}, 2.00{TIMES}"),
    ({"far": [("y", 24, 0.14)], "slow": True},
     f"{FAR}; without them the residual is not white, which they may have made, or {WHY}"),
])
def test_what_a_residual_says_of_the_model(fit, said):
    """Of five correlations one may be beyond the band of 0.2."""
    made = {"residual": [0.05], "size": 1.0, "least": 0.05, "correlation": NOTHING, "band": 0.2}
    assert _explains(Fit(**made | fit), 0) == said


@pytest.mark.parametrize(("hold", "rows", "wrong", "told"), [
    ("linear", 61, 0.0, True), ("zoh", 61, 0.0, True), ("linear", 601, 0.3, False),
    ("zoh", 601, 0.3, False),
])
def test_rows_too_far_apart_for_the_hold_are_told(hold, rows, wrong, told, tmp_path):
    """Of exact data and the right plant, not of a wrong one with rows that are close enough."""
    t = np.linspace(0.0, 24.0, rows)
    y = 1.0 + 0.5 * (np.sin(t) - np.cos(t)) + wrong / 3.0 * np.cos(2.0 * t)
    plant = one_state(A=[[-1]], F=[["1", "sin(t)"]], unknowns={"a": 1, "b": 1})
    data = {"file": write_table(tmp_path / "r.csv", {"t": t, "y": y}), "hold": hold}
    said = run(plant, data=data, estimator="least_squares", time={"samples": 101}).verdict
    assert "the residual is not white" in said
    assert (COARSE in said) == told


def test_what_the_residual_of_a_right_plant_is_coloured_by_is_said():
    """Estimates that forget most of the data, and an input that is measured with noise."""
    plant = one_state(A=[[-1]], B=[[1]], inputs={"u": "sin(t)"}, unknowns={"k": 1.0}, F=[[1]])
    made = run(plant, observer="none", time={"horizon": 40, "samples": 401})
    noise = np.random.default_rng(2).standard_normal((2, 401))
    right = {"t": made.t, "u": made["u"], "y": made["y"] + 0.05 * noise[0]}
    said = run(plant, data=right, estimator="ls_drem", beta=1.0).verdict
    assert "not white, that of least squares that weigh each output by its noise is:" in said
    two = plant | {"outputs": ["y", "z"], "C": [[1], [1]]}
    seen = right | {"y": made["y"] + 0.02 * noise[0], "z": made["y"] + 0.5 * noise[1]}
    said = run(two, data=seen, estimator="least_squares").verdict
    assert "not white, that of least squares that weigh each output by its noise is:" in said
    levels = {"name": "gaussian", "outputs": 0.05, "inputs": 1.0}
    seen = right | {"u": made["u"] + noise[1]}
    assert "which noise of u does; or it suggests" in run(plant, data=seen, noise=levels).verdict


def test_of_a_recording_whose_noise_is_in_the_matrices_no_residual_is_judged():
    t = np.linspace(0.0, 3.0, 31)
    plant = one_state(A=[["-1 - 0.3*y"]], B=[[1]], inputs={"u": 0})
    data = {"t": t, "u": np.sin(t), "y": np.exp(-t)}
    said = run(plant, data=data, noise={"name": "gaussian", "outputs": 0.1}).verdict
    assert "no standard deviations: noise of the signals is in the matrices" in said
    assert "white noise" not in said


def test_at_samples_matrices_may_follow_an_input_without_noise():
    """A pump's gain: F follows u, whose samples are exact; y alone is noisy."""
    system = plant_from_mapping(TANK, "tank")
    t = np.linspace(0.0, 4.0, 12)
    u, y = np.sin(3 * t)[:, None] + 1.0, np.cos(t)[:, None]
    law = {"name": "least_squares"}
    assert_responses_add_up(system, law, t, u, y, "linear", (0.3, 0.0))
    noisy = NoiseSettings(name="gaussian", outputs=0.3, inputs=0.1)
    with pytest.raises(TypeError):  # there are none
        fed(system, law, t, u, y, "linear", noisy)


@pytest.mark.parametrize(("form", "white"), [("auto", False), ("strangeness_free", True)])
def test_noise_that_the_observer_feeds_back_is_no_fault_of_the_plant(form, white):
    """v sees z, which is algebraic: the form as given takes z from its equation and from v."""
    plant = {
        "name": "fed", "states": ["x", "z"], "inputs": {"u": "sin(3*t)"}, "outputs": ["y", "v"],
        "unknowns": {"b": 0.3}, "E": [[1, 0], [0, 0]], "A": [[-0.05, -1], [0.5, -1]],
        "B": [[0], [1]], "F": [[1], [0]], "C": [[1, 0], [0, 1]], "initial_state": [1, 0],
    }
    made = run(plant, observer="none", time={"horizon": 20, "samples": 501})
    random = np.random.default_rng(0)
    noise = {name: made[name] + 0.05 * random.standard_normal(501) for name in ("y", "v")}
    told = run(
        plant, data={"t": made.t, "u": made["u"], **noise}, observer={"form": form},
        estimator="least_squares",
    ).verdict
    assert ("up to white noise" in told) == white
    assert ("noise of v does, which the observer feeds back" in told) != white


@pytest.mark.parametrize("observer", [
    {"name": "gpebo"}, {"name": "gpebo", "sample_time": 0.05}, {"name": "kalman_bucy"},
    {"name": "gpebo", "form": "strangeness_free", "remedy": "output_injection"},
])
def test_what_a_recording_has_of_an_output_that_is_off_tells_no_level(observer):
    """It is on for 3 of 10 s: what it shows then is all there is, zeros afterwards or not."""
    t = 0.05 * np.arange(201)
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(t))
    y = np.where(t < 2.99, 4.0 - 3.0 * np.exp(-0.1 * t) + noise, 0.0)
    plant = one_state(unknowns={"b": 0.4}, A=[[-0.1]], F=[[1]], C=[["1 - step(t - 3)"]])
    found = {
        horizon: run(
            plant, data={"frame": {"t": t, "y": y}, "hold": "zoh"}, observer=observer,
            estimator="least_squares", time={"horizon": horizon},
        ) for horizon in (3, 10)
    }
    short, long = (
        each.details.estimation.parameters_std[0, -1, 0] for each in found.values()
    )
    np.testing.assert_allclose(long, short, rtol=0.02)
    if "sample_time" not in observer:
        assert "white noise" in found[10].verdict
        assert np.isnan(found[10].details.fit.outputs[found[10].t > 3.01]).all()  # no curve


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_the_level_at_samples_has_no_bias(hold):
    """E σ̂² = σ² at every row: the squares of what each error by itself would be taken for."""
    system = shipped("descriptor")
    t = np.linspace(0.0, 6.0, 11)
    nothing = np.zeros((len(t), 1))
    found = sum(
        fed(system, {"name": "ls_drem"}, t, nothing, y, hold, cut=5)[2] ** 2
        for y in np.eye(len(t))[:, :, None]
    )
    assert np.isnan(found[:4]).all()  # four parameters explain four rows
    np.testing.assert_allclose(found[6:], 1.0, rtol=1e-6)


def test_they_are_in_tables_and_summary_unless_switched_off(tmp_path):
    noise = {"name": "gaussian", "outputs": 0.01, "sample_time": 0.1}
    result = run("descriptor", estimator="ls_drem", noise=noise, time={"horizon": 5})
    table = result.to_pandas("estimates")
    assert {"theta1_std", "e0_x1_std", "x3_std"} <= set(table.columns)
    std = table["theta1_std"].to_numpy()
    assert (std[result.t > 0.3] >= 0).all()  # before, nobody knows it
    result.save(tmp_path / "run", figures=False)
    summary = __import__("json").loads((tmp_path / "run" / "summary.json").read_text())
    theta = summary["estimates"]["theta1"]
    assert theta["true"] == 1.5
    assert abs(theta["value"] - 1.5) < 6 * theta["std"]
    double = run(
        "descriptor", estimator="ls_drem", noise={**noise, "outputs": 0.02}, time={"horizon": 5}
    ).to_pandas("estimates")
    np.testing.assert_allclose(double["x3_std"], 2.0 * table["x3_std"], rtol=1e-6)
    silent = run("descriptor", estimator="ls_drem", time={"horizon": 5})
    assert "theta1_std" not in silent.to_pandas("estimates").columns


def test_of_a_recording_with_levels_and_without(tmp_path):
    noise = {"name": "gaussian", "outputs": 0.02, "sample_time": 0.02}
    data = {"file": noisy_rows(tmp_path, noise, 1001), "hold": "linear"}
    std = [
        run("descriptor", estimator="ls_drem", data=data, noise=own).to_pandas("estimates")
        ["theta1_std"].iloc[-1]
        for own in ("none", noise)
    ]
    assert std[0] == pytest.approx(std[1], rel=0.15)
    with pytest.raises(Exception, match=r"noise\.seeds and noise\.quantisation are for simul"):
        run("descriptor", data=data, noise={**noise, "seeds": 3})


def test_settled_is_within_two_deviations_of_the_end_from_then_on():
    """Not when an error happens to be small; other samples of the noise say nearly the same."""
    found = []
    for seed in range(3):
        result = run(
            "descriptor", estimator="ls_drem", time={"samples": 401},
            noise={"name": "gaussian", "outputs": 0.05, "sample_time": 0.2, "seed": seed},
        )
        metrics, estimation = result.details.metrics, result.details.estimation
        for i, name in enumerate(estimation.names):
            since = metrics.seconds_to_settled[name][0]
            away = np.abs(estimation.parameters[0, :, i] - estimation.parameters[0, -1, i])
            late = estimation.t > since + 1e-9
            assert (away[late] <= 2.0 * estimation.parameters_std[0, -1, i]).all()
            assert away[~late][-1] > 2.0 * estimation.parameters_std[0, -1, i] * 0.5
        found.append(max(times[0] for times in metrics.seconds_to_settled.values()))
        assert f"all within ±2σ of the end after {found[-1]:.4g} s" in result.verdict
    assert max(found) < 19.0
    silent = run("descriptor", estimator="ls_drem", time={"horizon": 5}).details.metrics
    assert silent.seconds_to_settled is None
    assert settling_times(
        np.array([0.0, 1.0, 2.0]), np.array([[[5.0], [1.0], [0.5]]]), np.array([[1.0]])
    )[0, 0] == 1.0


@pytest.mark.parametrize("seed", [0, 1])
def test_a_state_of_constants_has_settled_as_they_have(seed):
    """Of y = x = const least squares is a mean, σ = 0.05/√(10 t), and all that moves x̂ is ê₀."""
    found = run(
        one_state(), estimator="least_squares", time={"horizon": 10, "samples": 201},
        noise={"name": "gaussian", "outputs": 0.05, "sample_time": 0.1, "seed": seed},
    ).details
    away = np.abs(found.estimation.parameters[0, :, 0] - found.estimation.parameters[0, -1, 0])
    for name, at in ("e0_x", 10.0), ("x", 7.5):  # of states the largest of the last quarter
        last = found.estimation.t[away > 0.1 / np.sqrt(10.0 * at)][-1]
        assert last <= found.metrics.seconds_to_settled[name][0] <= last + 0.05 + 1e-9


NOISE = {"name": "gaussian", "outputs": 0.05}


@pytest.mark.parametrize("observer", [
    {}, {"observer": "kalman_bucy"}, {"observer": {"name": "gpebo", "sample_time": 0.02}},
])
def test_all_observers_say_of_the_same_noise_when_estimates_have_settled(observer):
    """Nobody tells the time to 1 %, and states count, those of a filter and at samples, too."""
    result = run("descriptor", estimator="least_squares", noise=NOISE, **observer)
    metrics = result.details.metrics
    for name in ("theta1", "theta2", "x1", "x2", "x3"):
        assert 2.0 < metrics.seconds_to_settled[name][0] < 9.0
    assert result.cases[0]["seconds_to_settled"] == metrics.settled[0]
    assert f"within ±2σ of the end after {metrics.settled[0]:.4g} s" in result.verdict
    table = "\n".join(run_lines(result.details))
    assert "within ±2σ of the end" in table
    assert "1 %" not in table + result.verdict


def test_under_noise_of_unknown_effect_no_time_is_told_but_by_seeds():
    """A small error may be chance; with seeds the deviations of the parameters are known."""
    given = {"estimator": "least_squares", "time": {"horizon": 5.0, "samples": 201}}
    noise = {"name": "gaussian", "outputs": 0.03, "sample_time": 0.02}
    result = run("lorenz", noise=noise, **given)
    assert np.isnan(result.cases[0]["seconds_to_settled"])
    assert "1 %" not in result.verdict
    many = run("lorenz", noise={**noise, "seeds": 4}, **given).details
    names, deviation = many.noise.names, many.noise.deviation[0]
    for name, times in many.metrics.seconds_to_settled.items():
        i = many.estimation.names.index(name)
        away = np.abs(many.estimation.parameters[0, :, i] - many.estimation.parameters[0, -1, i])
        late = many.estimation.t > times[0] + 1e-9
        assert (away[late] <= 2.0 * deviation[names.index(name)]).all()


def test_a_recording_at_samples_is_told(tmp_path):
    """Its table has states whose time to settle nobody knows."""
    noise = {"name": "gaussian", "outputs": 0.02, "sample_time": 0.1}
    data, observer = noisy_rows(tmp_path, noise, 201), {"sample_time": 0.1, "hold": "linear"}
    result, whole = (
        run("descriptor", data=data, observer=given) for given in (observer, "gpebo")
    )
    fit, other = result.details.fit, whole.details.fit
    assert fit.size == pytest.approx(other.size, rel=0.05)
    assert fit.residual[0] == pytest.approx(other.residual[0], rel=0.5)  # lines make noise smaller
    line = next(line for line in run_lines(result.details) if line.strip().startswith("theta1"))
    value, std = (float(cell) for cell in line.split()[1:3])
    assert abs(value - 1.5) < 6 * std < 0.5


def test_the_residual_is_compared_with_the_noise_that_is_given(tmp_path):
    """χ²: one where the level is right, two where it is half of it; a wrong plant is noticed."""
    noise = {"name": "gaussian", "outputs": 0.01, "sample_time": 0.05}
    data, told = noisy_rows(tmp_path, noise, 401), []
    for level, plant in ((0.01, "descriptor"), (0.005, "descriptor"), (0.01, WRONG)):
        result = run(plant, data=data, noise={**noise, "outputs": level})
        told.append((result.details.fit.ratio, result.verdict))
    assert told[0][0] == pytest.approx(1.0, abs=0.12)
    assert told[1][0] == pytest.approx(2.0 * told[0][0], rel=1e-6)
    assert "explain the data up to white noise" in told[0][1]
    assert "noisier sensor" in told[1][1]
    assert "is not white" in told[2][1] or told[2][0] > 1.2
    written = summary(result.details, Provenance({}, None))["fit"]
    least = result.details.fit.residual.min()
    assert (written["noise_ratio"], written["least_rms_residual"]) == (told[2][0], least)
    silent = run("descriptor", time={"samples": 401}).to_pandas("signals").reset_index()
    found = run("descriptor", data=silent, noise={**noise, "outputs": 0.1})
    assert "the residual is far below the noise" in found.verdict  # though it is not white


WRONG = {
    **yaml.safe_load((ROOT / "conf" / "plant" / "descriptor.yaml").read_text()),
    "A": [["-1.05", "1/2 + sin(t)/4", 1], ["-1/2", "-1/2 - cos(t)/4", "1/2"],
          ["1/2", -1, "2 + sin(t)"]],
}


NOISE = {"name": "gaussian", "outputs": 0.05, "sample_time": 0.1}


@pytest.mark.parametrize("plant", ["descriptor", "circuit"])
def test_resets_change_no_deviation_of_least_squares(plant):
    """They carry over all that is known: θ̂ and x̂ are those without, and so is their noise."""
    def stds(**remedy):
        e = run(plant, estimator="least_squares", observer={"name": "gpebo", **remedy},
                noise=NOISE, time={"horizon": 12, "samples": 13}).details.estimation
        q = sum(not name.startswith("e0_") for name in e.names)
        return np.concatenate([e.parameters_std[0, 8:, :q], e.states_std[0, 8:]], axis=1)

    kept = stds(remedy="reset", reset_times=[3.33, 7.0])  # one of them between two samples
    np.testing.assert_allclose(kept, stds(), rtol=2e-3)
    assert (stds(remedy="reset", reset_times=[7.0], reset_keep=0.0) > 1.2 * kept).any()


@pytest.mark.parametrize("estimator", [("ls_drem", 10), ("drem", 1e14)])
def test_errors_with_resets_are_of_the_size_that_is_said(estimator):
    errors = []
    for k in range(8):
        found = run("descriptor", estimator=estimator[0], gamma=estimator[1], solver={"tol": 1e-5},
                    observer={"name": "gpebo", "remedy": "reset", "reset_interval": 2.5},
                    noise={**NOISE, "seed": k}, time={"horizon": 8, "samples": 5}).details
        e = found.estimation
        if k == 0:
            said = np.hstack([e.parameters_std[0], e.states_std[0]])[2:]
        errors.append(np.hstack([
            e.parameters[0] - e.true_parameters, e.states[0] - found.simulation.states
        ])[2:])
    size = np.sqrt(np.mean((np.array(errors) / said) ** 2, axis=0))
    assert 0.7 < np.sqrt(np.mean(size**2)) < 1.4
    assert size.max() < 2.2


def test_a_reset_moves_the_start_of_the_finite_time_law_and_what_it_takes_out_of_it():
    """γ is so small that η̂_f stays at its start: (η̂ − w_c η̂(0))/(1 − w_c), both of one error."""
    moved = []
    for k in range(12):
        e = run("descriptor", estimator="fct", gamma=1e3, solver={"tol": 1e-5},
                observer={"name": "gpebo", "remedy": "reset", "reset_times": [2.5]},
                noise={**NOISE, "seed": k}, time={"horizon": 4, "samples": 9}).details.estimation
        errors, said = (e.parameters[0] - e.true_parameters)[5:, 2:], e.parameters_std[0, 5:, 2:]
        assert (np.abs(np.diff(errors, axis=0)) < 1e-3 * said[1:]).all()
        moved.append(errors)
    spread = np.std(moved, axis=0, ddof=1) / said
    assert spread.min() > 0.5
    assert spread.max() < 1.6


@pytest.mark.parametrize(("name", "gains"), [
    ("drem", {"gamma": [1e13, 5e13]}), ("ls_drem", {"gamma": [2.0, 10.0], "f0": 1e-2}),
])
def test_the_finite_time_law_is_as_uncertain_as_what_it_divides_by_makes_it(name, gains):
    """η̂_f = (η̂ − w_c η̂(0))/(1 − w_c), w_c ≤ 1 − μ: the share of the start that is left in η̂."""
    extension = {"drem": "kreisselmeier", "ls_drem": "least_squares"}[name]
    plain, corrected = (
        {"name": name, **gains}, {"name": "fct", "extension": extension, "mu": 0.2, **gains}
    )
    time = {"horizon": 10, "samples": 11}
    left = 1.0 - run("descriptor", estimator=plain, time=time).estimates["theta1"] / 1.5
    one, other = (
        run("descriptor", estimator=law, noise=NOISE, time=time).details.estimation.parameters_std
        for law in (plain, corrected)
    )
    made = one[:, 1:, 0] / (1.0 - np.minimum(left[:, 1:], 0.8))
    np.testing.assert_allclose(other[:, 1:, 0], made, rtol=1e-6)
    assert np.ptp(left[:, 2:-2]) > 0.9


def test_resets_that_do_not_say_what_errors_do_have_no_deviations(monkeypatch):
    made = reset.Reset
    monkeypatch.setattr(reset, "Reset", lambda *a, **more: replace(made(*a, **more), errors=None))
    found = run("descriptor", observer={"name": "gpebo", "remedy": "reset", "reset_times": [1.0]},
                noise=NOISE, time={"horizon": 2.0, "samples": 3})
    assert found.details.estimation.parameters_std is None
    assert "its remedy cannot tell" in found.verdict


@pytest.mark.parametrize(("plant", "more", "why"), [
    ("descriptor", {"gamma": "logspace(0,2,33)"}, "each of 33 cases would take a pass of its own"),
    ("descriptor", {"gamma": "logspace(0,2,33)", "observer": {"sample_time": 0.1}},
     "each of 33 cases would take a pass of its own"),
    ("descriptor", {"observer": {"sample_time": 0.1}, "time": {"horizon": 2.0}}, ""),
    ("descriptor", {"gamma": "logspace(0,2,33)", "observer": {"sample_time": 0.1},
                    "uncertainty": False}, ""),
    ("boost", {}, "noise of the signals is in the matrices"), ("boost", {"noise": "none"}, ""),
    ("circuit", {"estimator": "gradient", "gamma": 1e20}, "the gain is so large"),
])
def test_a_run_without_deviations_says_why(plant, more, why):
    verdict = run(plant, **{"noise": NOISE, "time": {"horizon": 0.5}, **more}).verdict
    assert (f"no standard deviations: {why}" in verdict) == bool(why)


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.01}])
@pytest.mark.parametrize("size", [1e-6, 1e-10])  # of ψ: Δ is tiny, or rounding
def test_an_estimate_that_was_not_moved_has_no_deviation(tmp_path, observer, size):
    plant = one_state(
        inputs={"u": "cos(t)"}, unknowns={"a": 1, "b": 1 / size}, A=[[-1]], B=[[1]],
        F=[["sin(3*t)", f"{size}*cos(2*t)"]],
    )
    made = run(plant, observer="none", time={"horizon": 10, "samples": 1001})
    table = np.column_stack([made.t, made["u"], made["y"]])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="t,u,y", comments="")

    def lines(**estimator):
        result = run(
            plant, data={"file": str(tmp_path / "r.csv")}, estimator=estimator, observer=observer,
            noise={"name": "gaussian", "outputs": 0.01},
        )
        return {line.split()[0]: line for line in run_lines(result.details)}, result.details

    told, result = lines(name="drem", initial=3.0)
    assert "not moved from 3 " in told["b"]
    assert np.isnan(result.estimation.parameters_std).all()
    assert np.isnan(result.estimation.states_std).all()
    assert "within ±2σ of the end after" not in result.verdict
    if size == 1e-6:  # a gain that makes up for the units
        told, result = lines(name="drem", initial=3.0, gamma=1e36)
        std = result.estimation.parameters_std[0, -1]
        assert "not moved" not in told["b"]
        assert (np.abs(result.estimation.parameters[0, -1] - [1, 1e6, -1]) < 5 * std).all()


@pytest.mark.parametrize("c", [1e3, -1e3])
@pytest.mark.parametrize("gain", [1e8, 1e20, 1e32])
def test_a_large_gain_leaves_the_filters_in_front_of_it_alone(gain, c):
    """f' = −a f + e, s' = −g (s − c f): f as without s, and s goes to c f."""
    a, h = 1e-4, 0.4
    A, B = np.array([[-a, 0.0], [gain * c, -gain]]), np.array([[1.0], [0.0]])
    mesh = Mesh(np.array([0.0, h]), radau_rule(4))
    A, B = (np.broadcast_to(each, (1, 4, *each.shape)) for each in (A, B))
    (f, s), decayed = error_maps(mesh, mesh.steps, A, B)[0, -1], np.exp(-a * h)
    np.testing.assert_allclose(f, [decayed, 0.0, (1.0 - decayed) / a], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(s, c * f, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_elements_agree_on_deviations_in_any_unit(unit):
    fine = unit * np.array([[1.0], [1e-3], [np.nan]])
    assert _agree(1.0001 * fine, fine)
    assert not _agree(fine * [[1.0], [1.5], [1.0]], fine)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_layers_are_behind_samples_before_what_is_looked_at_in_any_unit_of_time(unit):
    """Down to a time constant, 1/20 of an element; nodes and what no sample begins need none."""
    mesh, samples = Mesh(unit * np.arange(4.0), radau_rule(6)), unit * np.array([0.0, 2.0])
    t = unit * np.array([0.5, 1.5, 3.0])
    made = _layered(mesh, samples, 20.0 / unit, t)
    np.testing.assert_allclose(made.edges / unit, [0, 1 / 27, 1 / 9, 1 / 3, 1, 2, 3], atol=1e-15)
    assert _layered(mesh, samples, 0.9 / unit, t) is mesh


@pytest.mark.parametrize("begin", [1e9, -1e9])
def test_elements_behind_a_start_are_no_rounding_of_times_before_or_after_zero(begin):
    """Halves of the first 0.01 s, down to 1e-12 of the times, which here is 1e-3 s."""
    edges = begin + np.array([0.0, 0.01, 0.02])
    made = _mesh(edges, SimpleNamespace(starts=edges, others=np.zeros(0)), edges[:1])
    expected = [0.0, 0.00125, 0.0025, 0.005, 0.01, 0.02]
    np.testing.assert_allclose(made.edges - begin, expected, atol=3e-7)


@pytest.mark.parametrize("apart", [True, False])
@pytest.mark.parametrize("widths", [[6], [2, 1, 1, 1, 2], [1] * 4, [1, 3, 1, 1], [0]])
def test_elements_solved_block_by_block_are_those_of_the_whole_system(widths, apart, monkeypatch):
    """exp of the system beside its errors; rows of width 1 that follow each other are apart."""
    monkeypatch.setattr("gpebo_cli.evidence.error_maps._SMALL", 0)
    rng, d = np.random.default_rng(len(widths)), sum(widths)
    A, ends = rng.normal(size=(d, d)), np.cumsum(widths)
    for first, width in zip(ends - widths, widths, strict=True):
        A[first : first + width, first + width :] = 0.0
    singles = np.repeat(widths, widths) == 1
    A[apart & np.outer(singles, singles) & ~np.eye(d, dtype=bool)] = 0.0
    if d == 4 and apart:  # the third row needs the second one, not the first
        A[2, 1] = 1.0
    B, mesh = rng.normal(size=(d, 2)), Mesh(np.array([0.0, 0.1, 0.3]), radau_rule(6))
    found = error_maps(mesh, mesh.steps, *(np.broadcast_to(x, (2, 6, *x.shape)) for x in (A, B)))
    whole = np.zeros((d + 2, d + 2))
    whole[:d] = np.hstack([A, B])
    for element in range(2):
        for node, t in enumerate(mesh.points[element, 1:] - mesh.edges[element]):
            exact = expm(t * whole)[:d]
            np.testing.assert_allclose(found[element, node], exact, rtol=0, atol=1e-7)


def noisy_battery():
    """A recording of 101 rows."""
    made = run("battery", observer="none", time={"horizon": 200.0, "samples": 101})
    noisy = made["v"] + 0.002 * np.random.default_rng(0).standard_normal(101)
    return {"t": made.t, "current": made["current"], "v": noisy}


@pytest.mark.parametrize("sample_time", [None, 2.0])
def test_estimates_that_noise_did_not_bring_where_they_are_have_no_deviations(sample_time):
    """Of an error of a third deviations of 1e-4 would be all that is said."""
    data = noisy_battery()
    for name, known in (("gradient", False), ("least_squares", True)):
        found = run("battery", data=data, estimator=name, observer={"sample_time": sample_time})
        assert (found.details.estimation.parameters_std is not None) == known
        assert ("farther from least squares" in found.verdict) != known


@pytest.mark.parametrize("name", ["gradient", "drem", "least_squares"])
def test_a_stream_says_deviations_where_a_run_at_samples_does(name):
    """Not while what the estimator needs is not met and it is far from least squares so far."""
    data, noise = noisy_battery(), {"name": "gaussian", "outputs": 0.002}
    found = run(
        "battery", data=data, estimator=name, observer={"sample_time": 2.0, "hold": "linear"},
        noise=noise,
    ).details
    settings = Settings(
        estimator={"name": name}, data=DataSettings("csv", "-", "linear"),
        time=TimeSettings(-np.inf, np.inf, 11), noise=NoiseSettings(**noise),
    )
    t, current, v = data["t"], data["current"][:, None], data["v"][:, None]
    online = stream(settings, found.system)(0.0, np.append(current[0], v[0]))
    parts = [online.feed(t[part], current[part], v[part]) for part in (slice(7), slice(7, 101))]
    std = np.concatenate([np.where(m.by_noise[..., None], m.std, np.nan)[0] for m in parts])
    assert np.isnan(std[0]).all()
    if name == "gradient":
        assert np.isnan(std).all()
        assert found.estimation.parameters_std is None
    else:
        ours = np.hstack([found.estimation.parameters_std[0], found.estimation.states_std[0]])
        assert np.isfinite(std[10:]).all()
        np.testing.assert_allclose(std, ours, rtol=1e-6)


@pytest.mark.parametrize("name", ["circuit", "strangeness_free"])
def test_deviations_behind_the_start_do_not_depend_on_the_elements(name, monkeypatch):
    """There the law of ls_drem goes as a power of the time, which equal elements do not follow."""
    def early():
        noise = {"name": "gaussian", "outputs": 0.05, "sample_time": 0.1}
        found = run(name, estimator="ls_drem", noise=noise, time={"horizon": 20.0})
        t = found.details.estimation.t
        return found.details.estimation.parameters_std[0, (t > 0.1) & (t < 1.0)]

    usual = early()
    assert np.isfinite(usual).all(axis=1).sum() > 35
    # More cuts would make rounding that G⁻¹ of the first data makes larger.
    monkeypatch.setattr(uncertainty, "_TOLERANCE", 1e-8)
    np.testing.assert_allclose(usual, early(), rtol=0.01)
    monkeypatch.setattr(uncertainty, "_CUTS", 0)
    assert np.nanmax(np.abs(np.log(usual / early()))) > 0.02


@pytest.mark.parametrize(("name", "first"), [("battery", 2.0), ("descriptor", 0.18)])
def test_there_are_no_deviations_while_rounding_decides_what_is_estimated(name, first):
    """Then η̂ of ls_drem is what the first data make of it that tell enough, which come later."""
    t = np.sort(np.concatenate([np.linspace(0.02, 0.1, 3), first * np.linspace(1.0, 2.0, 4)]))
    (found,) = page.errors_over_seeds(shipped(name), ({"name": "ls_drem"},), SEEDS, t)
    assert np.isnan(found.predicted[:3]).all()
    seen = found.errors.std(axis=2, ddof=1)[3:]
    assert np.abs(np.log(found.predicted[3:] / seen)).max() < 0.18


@pytest.mark.parametrize("rows", [20, 40])
@pytest.mark.parametrize("estimator", [
    {"name": "least_squares"}, {"name": "ls_drem"}, {"name": "drem", "gamma": 1e14},
    {"name": "fct", "gamma": 1e14}, {"name": "exciting"}, {"name": "mre"},
])
def test_deviations_of_few_rows_do_not_depend_on_the_elements(estimator, rows, monkeypatch):
    """There are few elements between few rows, and more where a law needs them."""
    def late():
        noise = {"name": "gaussian", "outputs": 0.05, "sample_time": 20.0 / rows}
        found = run("circuit", estimator=estimator, noise=noise, time={"horizon": 20.0})
        e = found.details.estimation
        std = np.hstack([e.parameters_std[0], e.states_std[0]])[e.t > 20.5 / rows]
        return std + 1e-9 * std.max(axis=0)

    usual = late()
    for setting, finer in (("_TOLERANCE", 1e-8), ("_CUTS", 3)):
        monkeypatch.setattr(uncertainty, setting, finer)
    np.testing.assert_allclose(usual, late(), rtol=3e-3)
    monkeypatch.setattr(uncertainty, "_CUTS", 0)
    if estimator["name"] == "exciting":
        assert np.abs(np.log(usual / late())).max() > 5e-3


@pytest.mark.parametrize("step", [0.1, 1e-4])
def test_deviations_of_a_recording_that_begins_long_after_zero(step):
    """Seconds since 1970, of which a double holds 2.4e-7: no element is as short as that."""
    rng, t = np.random.default_rng(0), step * np.arange(200)
    y = np.exp(-t / t[-1]) + 0.01 * rng.standard_normal(len(t))
    plant = one_state(A=[[-1.0 / t[-1]]], initial_state={"x": 1.0})

    def at(start):
        found = run(plant, data={"t": start + t, "y": y}, estimator="ls_drem").details.estimation
        return np.append(found.parameters_std[0, -1], found.states_std[0, -1])

    np.testing.assert_allclose(at(1.7e9), at(0.0), rtol=0.01)
