"""Change of units and signs: physics stays the same, and all that is said about it does."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from plants import CONF
from random_systems import HORIZON, random_system
from test_observer import ROTATING
from test_remedies import MIXED
from units import Units, drawn, in_units

from gpebo_cli import estimators, run
from gpebo_cli.evidence.excitation import WELL
from gpebo_cli.experiment.sensors import candidates
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.regression.linear import LinearRegression
from gpebo_cli.regression.resets import level_of
from gpebo_cli.settings import Settings, TimeSettings

SHIPPED = sorted(
    path.relative_to(CONF / "plant").as_posix().removesuffix(".yaml")
    for path in (CONF / "plant").rglob("*.yaml") if path.stem != "none"
)
RANDOM = [seed for seed in range(13) if seed % 5 < 4]  # of index 0 to 3
SHORT = {"lorenz": 1.0, "motor": 0.5, "duffing": 4.0, "generator": 2.0,
         "published/ascher_petzold": 1.0, "published/transistor": 2e-4,
         "published/akzo": 2.0, "published/robertson": 2.0, "published/hires": 3.0}
TURNING = {
    plant["name"]: {**plant, "initial_state": dict(zip(
        plant["states"], plant["initial_state"], strict=True))} for plant in (ROTATING, MIXED)
}
# Matrices follow outputs that are zero at the start, where the observer's units are found.
FROM_ZERO = ("motor", "published/akzo", "published/hires", "published/robertson")
EPS = float(np.finfo(float).eps)
LAST = {}


def both(name, decades, kept=(), seed=5, **settings):
    """Details of a run of a plant, of one in other units but for those kept, and the units.

    Settings that have units are functions of them.
    """
    if isinstance(name, int):
        content, horizon = random_system(name)[0], HORIZON
    elif name in TURNING:
        content, horizon = TURNING[name], 10.0
    else:
        content = yaml.safe_load((CONF / "plant" / f"{name}.yaml").read_text(encoding="utf-8"))
        content = {key: content[key] for key in content if key not in ("units", "labels")}
        horizon = SHORT.get(name, 10.0)
    units = drawn(np.random.default_rng(seed), plant_from_mapping(content), decades=decades)
    units = units._replace(**{kind: np.ones_like(getattr(units, kind)) for kind in kept})
    units = units._replace(time=float(units.time))

    def made(content, by):
        return run(content, time={"horizon": horizon * float(by.time), "samples": 101}, **{
            key: value(by) if callable(value) else value for key, value in settings.items()
        }).details

    key = repr((name, sorted(settings.items())))
    if key != LAST.get("key"):  # of a plant in its own units there is one run for several others
        LAST.update(key=key, one=made(content, Units(*map(np.ones_like, units))))
    return LAST["one"], made(in_units(content, units), units), units


@pytest.mark.parametrize("name", [*SHIPPED, *RANDOM])
def test_a_simulation_is_the_same_in_any_units(name):
    """States, unknowns, inputs, outputs, equations and time, each by a factor of its own.

    In powers of ten: where evidence is.
    """
    assert_same_simulation(*both(name, False, observer="none"))


def assert_same_simulation(one, other, units):
    a, b = one.simulation, other.simulation
    assert (a.index, a.differential, a.algebraic) == (b.index, b.differential, b.algebraic)
    assert [change.state for change in a.moved] == [change.state for change in b.moved]
    size = np.abs(a.states).max(axis=0)
    size = np.where(size > 0.0, size, 1e-6 * size.max())
    assert (np.abs(b.states / units.states - a.states) <= 1e-9 * size).all()
    assert [x.holds for x in one.assumptions] == [x.holds for x in other.assumptions]
    # Rounding of other numbers is other rounding, but as large; so are elements.
    heard = np.abs(a.states).max(axis=0) > 1e-9 * size.max()
    apart = np.log(b.state_errors[heard] / a.state_errors[heard])
    assert np.abs(apart).max() < np.log(15.0)
    assert b.elements <= 1.5 * a.elements


def doubt_of_t_c(a):
    """What rounding leaves open of t_c, in seconds.

    Eigenvalues of a p × p matrix with unit diagonal are rounded by p ε: this over their slope at
    the level that t_c asks for, half the last one where that is small. A column of ψ that begins
    as zero counts from ten of its errors on: there it is known to a tenth. Twice, for two runs.
    """
    if a.t_c is None or a.t_c <= a.t[0]:
        return 0.0
    if a.normalised_min[1] >= WELL:
        return 2.0 * 0.1 * a.t_c
    i = int(np.searchsorted(a.t, a.t_c))
    slope = (a.normalised_min[i] - a.normalised_min[i - 1]) / (a.t[i] - a.t[i - 1])
    return 2.0 * len(a.parameters) * EPS / slope


@pytest.mark.parametrize("decades", [True, False])
@pytest.mark.parametrize("name", [*SHIPPED, *RANDOM])
def test_evidence_is_the_same_in_any_units(name, decades):
    """States, unknowns, inputs, outputs, equations and time, in powers of ten.

    By any factor only unknowns, inputs and, for the shipped plants, time: the observer's units are
    powers of ten.
    """
    kept = ()
    if not decades or name in FROM_ZERO:
        rotates = ["time"] if isinstance(name, int) else []
        kept = ("states", "equations", "outputs", *rotates)
    one, other, units = both(name, decades, kept, estimator="least_squares")
    assert_same_simulation(one, other, units)
    a, b, T = one.excitation, other.excitation, units.time
    assert a.is_ie == b.is_ie
    assert b.level == pytest.approx(a.level, rel=1e-9, abs=100 * EPS)
    if name in ("circuit", "descriptor", "strangeness_free"):  # others come near two directions
        of_a, of_b = (np.abs(list(x.weakest_direction.components.values())) for x in (a, b))
        np.testing.assert_allclose(of_b, of_a, atol=1e-9)
    for x, y, doubt in ((a.t_c, b.t_c, doubt_of_t_c(a)), *(
            (a.determined_at[p], b.determined_at[p], 0.0) for p in a.parameters)):
        assert (x is None) == (y is None)
        assert x is None or abs(y / T - x) <= 1e-9 * a.t[-1] + doubt
    known, again = ({name for name, since in run.estimable.items() if since is not None}
                    for run in (one, other))
    assert known == again
    assert [x.holds for x in one.assumptions] == [x.holds for x in other.assumptions]
    of_a, of_b = (x.evidence for run in (one, other) for x in run.assumptions
                  if x.name == "Growth of Φ")
    assert of_b["largest_entry"] == pytest.approx(of_a["largest_entry"], rel=2e-3)
    assert of_b["rate"] * T == pytest.approx(of_a["rate"], rel=1e-6, abs=1e-9)
    # The observer's units are those of the plant to a power of ten.
    x, y = (
        [x.evidence.get("smallest_singular_value") for x in run.assumptions
         if x.name == "Assumption 1"] for run in (one, other)
    )
    if name != "published/gelda":  # whose entries are zero where the observer looks for units
        assert y == x or 0.1 < y[0] / x[0] < 10.0


@pytest.mark.parametrize("name", ["boost", "canonical", "circuit", "descriptor", "window", 2, 3])
def test_estimates_with_no_gain_given_are_the_same_in_any_units(name):
    """No gain of the default estimator has a unit: from when on a state is known it is the same."""
    one, other, units = both(name, True, seed=[5, 1], estimator="ls_drem")
    assert one.estimation.requirement.holds == other.estimation.requirement.holds
    since = [one.estimable[state] for state in one.system.states]
    known = one.estimation.t[:, None] >= np.array([np.inf if s is None else s for s in since])
    size = np.abs(one.simulation.states).max(axis=0)
    away = np.abs(other.estimation.states[0] / units.states - one.estimation.states[0])
    assert (np.where(known, away, 0.0) <= 1e-8 * np.where(size > 0.0, size, size.max())).all()


UNDER = {
    "reset": ["boost", "circuit", "published/gear_petzold", 8, "mixed", "rotating"],
    "current_coordinates": ["boost", "canonical", "circuit", "descriptor", "published/gear_petzold",
                            "strangeness_free", 0, 2, 3, "mixed", "rotating"],
    "output_injection": ["boost", "circuit", "published/ascher_petzold", "published/gear_petzold",
                         5, "mixed", "rotating"],
}


@pytest.mark.parametrize(("remedy", "name"), [(r, name) for r in UNDER for name in UNDER[r]])
def test_remedies_are_the_same_in_any_units(remedy, name):
    """What is small in its unit only is no rounding, and what is large there is not all there is.

    What is known is in both cases, and from the middle of the horizon on it is the same.
    """
    one, other, units = both(
        name, True, seed=[5, 1], estimator={"name": "least_squares", "f0": 1e-200},
        observer=lambda by: {"name": "gpebo", "remedy": remedy, **(
            {"reset_interval": 2.0 * float(by.time)} if (remedy, name) == ("reset", "mixed") else {}
        )},
    )
    known = {name for name, since in one.estimable.items() if since is not None}
    assert known == {name for name, since in other.estimable.items() if since is not None}
    assert one.excitation.is_ie == other.excitation.is_ie
    assert [x.holds for x in one.assumptions] == [x.holds for x in other.assumptions]
    size = np.abs(one.simulation.states).max(axis=0)
    size = np.where(size > 0.0, size, size.max())
    told = [k for k, state in enumerate(one.system.states) if state in known]
    a, b = (run.estimation.states[0, 50:, told] for run in (one, other))
    away = np.abs(b / units.states[told, None] - a) / size[told, None]
    assert away.max(initial=0.0) <= 1e-8


@pytest.mark.parametrize("name", ["circuit", "descriptor", "rotating", "mixed"])
@pytest.mark.parametrize("observer", [
    {}, {"remedy": "output_injection"}, {"remedy": "reset", "reset_interval": 3.5},
    {"sample_time": 0.1}, {"sample_time": 0.1, "hold": "linear"},
], ids=lambda o: "-".join(map(str, o.values())))
def test_deviations_are_the_same_in_any_units(name, observer):
    """Noise of an output is in its unit, and the time of a sample in that of time."""
    def in_time(by):
        scaled = {k: v * float(by.time) for k, v in observer.items() if isinstance(v, float)}
        return {"name": "gpebo", **observer, **scaled}

    one, other, units = both(
        name, True, seed=[5, 1], estimator={"name": "least_squares", "f0": None}, observer=in_time,
        noise=lambda by: {"name": "gaussian", "outputs": np.abs(0.01 * by.outputs).tolist(),
                          "sample_time": 0.1 * float(by.time)},
    )
    q = one.system.q
    for part, of in (("parameters_std", units.unknowns), ("states_std", units.states)):
        a, b = (getattr(run.estimation, part)[0, 50:] for run in (one, other))
        a, b = (a[:, :q], b[:, :q]) if part == "parameters_std" else (a, b)
        np.testing.assert_allclose(b / np.abs(of), a, rtol=1e-5)


def test_what_filters_leave_of_a_column_is_rounding():
    """No output sees x1 here: squares of it were 3e-16 of the others, and counted as excitation."""
    result = run(random_system(0)[0], time={"horizon": HORIZON, "samples": 101},
                 estimator="least_squares",
                 observer={"name": "gpebo", "remedy": "current_coordinates"})
    assert result.details.estimable["w_x1"] is None


def test_what_stands_for_no_prior_is_no_data():
    """No output sees what b acts on; in units in which it is small, F⁻¹ of rounding was regular."""
    found = run({
        "name": "half", "states": ["x1", "x2"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
        "unknowns": {"a": 2.0, "b": 1.0}, "E": [[1, 0], [0, 1]], "A": [[-1, 0], [0, -2]],
        "B": [[1], [0]], "F": [[1, 0], [0, 1]], "C": [[1, 0]], "initial_state": [1, 1],
    }, observer={"name": "gpebo", "remedy": "current_coordinates"},
        estimator={"name": "least_squares", "f0": None}, time={"horizon": 3, "samples": 5}).details
    assert found.estimable["a"] is not None
    assert found.estimable["b"] is None
    assert not found.estimation.requirement.holds


@pytest.mark.parametrize(
    ("name", "moving"), [("window", [0, 1]), (1, [0, 1]), ("rotating", [0, 1, 2, 3])]
)
def test_a_kalman_filter_is_the_same_in_any_units(name, moving):
    """Variances have units, and so has what regularises: a variance times a sample time."""
    def observer(by):
        units = np.concatenate([by.unknowns, by.states[moving]])
        return {"name": "kalman_bucy", "regularisation": 1e-3 * float(by.time) ** 0.5,
                "P0": (10.0 * units**2).tolist()}

    one, other, units = both(name, True, seed=[5, 1], observer=observer)
    assert [x.holds for x in one.assumptions] == [x.holds for x in other.assumptions]
    a, b = (run.estimation.states[0] for run in (one, other))
    assert (np.abs(b / units.states - a) <= 1e-8 * np.abs(a).max(axis=0)).all()
    x, y = (dict(run.estimation.requirement.evidence) for run in (one, other))
    for key in ("window", "window_start"):
        y[key] /= units.time
    assert y == pytest.approx(x, rel=1e-6)
    errors = [run.regression.error_estimate for run in (one, other)]
    assert errors[0] / 10 < errors[1] < 10 * errors[0]
    # Of 1 nothing is seen: 0 is no evidence of 0.
    assert one.estimation.requirement.holds == (name in TURNING)


def test_sensors_are_as_good_in_any_units():
    """Two outputs in units of their own: a row of ψ counts beside the others in comparable ones."""
    content = yaml.safe_load((CONF / "plant" / "published/oregonator.yaml").read_text())
    units = drawn(np.random.default_rng(8), plant_from_mapping(content), decades=True)
    one, other = (
        candidates(Settings({"name": "ls_drem"}, TimeSettings(horizon=5.0 * float(unit))),
                   plant_from_mapping(made))
        for made, unit in ((content, 1.0), (in_units(content, units), units.time))
    )
    assert [sensor.state for sensor in one] == [sensor.state for sensor in other]
    for a, b in zip(one, other, strict=True):
        assert (a.fall, a.fall_together) == pytest.approx((b.fall, b.fall_together), rel=1e-9)


@pytest.mark.parametrize("seed", [102, 123])
def test_what_no_sample_tells_is_unknown_in_any_units(seed):
    """Kernels of E turn: ψ of a parameter that acts on nothing measured is rounding of z."""
    content = random_system(seed)[0]
    units = drawn(np.random.default_rng(7 * seed + 1001), plant_from_mapping(content), decades=True)
    one, other = (
        run(made, time={"horizon": HORIZON * unit, "samples": 11}, estimator="least_squares",
            observer={"name": "gpebo", "sample_time": 0.1 * unit}).details
        for made, unit in ((content, 1.0), (in_units(content, units), float(units.time)))
    )
    assert one.excitation.is_ie == other.excitation.is_ie
    known, again = ({name for name, since in run.estimable.items() if since is not None}
                    for run in (one, other))
    assert known == again


@pytest.mark.parametrize("name", ["least_squares", "ls_drem"])
def test_least_squares_keeps_its_digits_in_any_units(name):
    """G, in these units, has eigenvalues from 1e-22 to 100, and 1e-5 of its largest in others."""
    unit = np.array([1e-11, 1e-8, 1.0, 10.0])
    truth = np.array([1.0, 2.0, -1.0, 3.0])

    def psi(t):
        return np.stack([1 + 0 * t, np.cos(t), np.sin(t), t], axis=-1)[..., None, :] * unit

    regression = LinearRegression.from_functions(
        psi, lambda t: psi(t) @ (truth / unit), list("abcd"), 2.0
    )
    more = {"gamma": 1e3} if name == "ls_drem" else {}
    estimator = estimators.build({"name": name, "f0": 1e-200, **more})
    found = estimator.estimate(regression, np.array([0.0, 2.0])).parameters(slice(None))[0, -1]
    assert found * unit == pytest.approx(truth, rel=1e-9)


@pytest.mark.parametrize("sampling", [{}, {"sample_time": 0.05}])
@pytest.mark.parametrize("name", ["drem", "instrumental"])
def test_mixing_keeps_its_digits_in_any_units(name, sampling):
    """In these units Ω has singular values 1e-20 of its largest, and estimates stood still."""
    content, one = yaml.safe_load((CONF / "plant/descriptor.yaml").read_text("utf-8")), np.ones(1)
    found = [
        run(in_units(content, Units(np.ones(3), factors, one, one, np.ones(3), 1.0)),
            estimator=name, gamma=1e14, observer={"name": "gpebo", **sampling},
            time={"horizon": 10, "samples": 3}).details.estimation
        for factors in (np.ones(2), np.array([1e-5, 1e5]))
    ]
    plain, other = (each.parameters[0, -1] / each.true_parameters[-1] for each in found)
    np.testing.assert_allclose(plain, 1.0, atol=0.05 if sampling else 1e-6)
    np.testing.assert_allclose(other, plain, rtol=1e-9)


@pytest.mark.parametrize("name", ["gradient", "mre"])
def test_units_of_unknowns_do_not_decide_whether_gains_are_enough(name):
    """A gain of its own for each parameter is in its unit, squared."""
    found = [
        run({
            "name": "ramps", "states": ["x", "z"], "outputs": ["y", "w"], "A": [[0, 0], [0, 0]],
            "unknowns": {"a": 2.0 * k, "b": -1.0 / k}, "E": [[1, 0], [0, 1]],
            "F": [[1 / k, 0], [0, k]], "C": [[1, 0], [0, 1]], "initial_state": [1, 1],
        }, estimator=name, time={"horizon": 10, "samples": 3},
            gamma={"a": 3.0 * k**2, "b": 4.0 / k**2, "e0_x": 10.0, "e0_z": 20.0},
            ).details.estimation.requirement.evidence["gamma_times_level"]
        for k in (1.0, 1e-3)
    ]
    assert found[0] > 1e-3
    assert found[1] == pytest.approx(found[0], rel=1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_a_regression_of_functions_and_its_data_have_sizes_in_their_units(unit):
    regression = LinearRegression.from_functions(
        lambda t: unit * np.stack([np.cos(t), -0.5 + 0.0 * t], axis=-1)[..., None, :],
        lambda t: 0.0 * t[..., None], ["a", "b"], np.pi,
    )
    assert regression.scale == pytest.approx(unit)
    ends = [np.pi / 2.0 * unit**2, np.pi / 4.0 * unit**2]
    np.testing.assert_allclose(level_of(regression.gram.values), ends, rtol=1e-9)


def ladder(ampere):
    """Three RC sections behind a source, with an unknown leakage current at the last node."""
    g, C = 1e-3, 2e-6  # siemens, farads
    return {
        "name": "ladder", "states": ["v1", "v2", "v3"], "inputs": {"V": "5 + sin(900*t)"},
        "unknowns": {"leak": 2e-6 * ampere}, "outputs": ["y"],
        "E": (C * np.eye(3)).tolist(), "B": [[g], [0], [0]], "F": [[0], [0], [-1 / ampere]],
        "A": [[-2 * g, g, 0], [g, -2 * g, g], [0, g, -g]], "C": [[1, 0, 0]],
        "initial_state": [1.0, 0.5, 0.0],
    }


def test_a_leakage_current_is_as_well_seen_in_amperes_as_in_milliamperes():
    one, other = (run(ladder(unit), time={"horizon": 0.1, "samples": 101}).details
                  for unit in (1.0, 1e3))
    assert one.excitation.is_ie
    assert other.excitation.is_ie
    assert other.excitation.t_c == pytest.approx(one.excitation.t_c, abs=1e-7)
    assert None not in (*one.estimable.values(), *other.estimable.values())


def test_three_tanks_in_SI_units_pass_every_check():
    """Levels in metres, flows in m³/s, an unknown leak of some 1e-5 m³/s."""
    area, k = 0.0154, 2.3e-4
    result = run({
        "name": "tanks", "states": ["h1", "h2", "h3"], "unknowns": {"leak": 2e-5},
        "inputs": {"Q": "1e-4*(1 + sin(0.02*t)/2)"}, "outputs": ["h1m"],
        "E": (area * np.eye(3)).tolist(), "B": [[1], [0], [0]], "F": [[0], [-1], [0]],
        "A": [[-k, k, 0], [k, -2 * k, k], [0, k, -2 * k]], "C": [[1, 0, 0]],
        "initial_state": [0.4, 0.3, 0.2],
    }, time={"horizon": 2000, "samples": 201}, estimator={"name": "least_squares", "f0": 1e-30})
    assert result.details.excitation.is_ie
    assert all(assumption.holds for assumption in result.details.assumptions)
    assert result.estimates["leak"].ravel()[-1] == pytest.approx(2e-5, rel=1e-6)


@pytest.mark.parametrize("settings", [
    {}, {"observer": "kalman_bucy"}, {"observer": {"name": "gpebo", "form": "strangeness_free"}},
])
def test_a_plant_without_derivatives_has_observers(settings):
    """E = 0: nothing is integrated, and sizes of nothing are empty."""
    result = run({
        "name": "algebraic", "states": ["a", "b"], "unknowns": {"th": 2.0}, "outputs": ["y"],
        "inputs": {"u": "sin(t)"}, "E": [[0, 0], [0, 0]], "A": [[1, "sin(t)/2"], [0.3, 2]],
        "B": [[1], [0]], "F": [[0], ["cos(t)"]], "C": [[1, 0]], "initial_state": [0, -1],
    }, time={"horizon": 20, "samples": 51}, **settings)
    assert result.estimates["th"].ravel()[-1] == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("given", [
    {"estimator": {"name": "ls_drem"}},
    {"estimator": {"name": "least_squares"}, "remedy": "reset", "reset_times": [1.5]},
    {"estimator": {"name": "drem", "gamma": 1e4}, "remedy": "current_coordinates"},
    {"estimator": {"name": "least_squares", "f0": None}, "remedy": "current_coordinates"},
    {"estimator": {"name": "least_squares", "f0": None}, "sample_time": 0.125},
    {"estimator": {"name": "least_squares"}, "recorded": True}, {"name": "kalman_bucy"},
], ids=str)
def test_nothing_depends_on_when_the_clock_began(given):
    """Of a plant with constant matrices: estimates, deviations, evidence, and times since then."""
    more = {key: value for key, value in given.items() if key not in {"estimator", "recorded"}}
    noise = {"name": "gaussian", "outputs": 0.05, "sample_time": 0.25}

    def found(start):
        plant = {
            "name": "two", "states": ["x", "z"], "inputs": {"u": f"sin(3*(t - {start}))"},
            "unknowns": {"a": 2.0}, "outputs": ["y"], "E": [[1, 0], [0, 0]],
            "A": [[-0.5, 1], [1, 1]], "B": [[1], [0]], "F": [[1], [0]], "C": [[1, 0]],
            "initial_state": [1, -1],
        }
        time = {"start": start, "horizon": 4.0, "samples": 33}
        own = {"name": "gpebo", **more}
        if "reset_times" in own:
            own["reset_times"] = [start + t for t in own["reset_times"]]
        settings = {"time": time, "noise": noise}
        if "recorded" in given:
            made = run(plant, observer="none", time=time)
            y = made["y"] + 0.05 * np.cos(40.0 * np.arange(33) ** 2)
            y[20] += 9.0
            settings = {"data": {"t": made.t, "u": made["u"], "y": y}}
        estimator = given.get("estimator", "gradient")
        details = run(plant, estimator=estimator, observer=own, **settings).details
        of, seen = details.estimation, details.excitation
        times = [seen.t_c, seen.determined, *details.estimable.values()]
        evidence = [
            value - start * (key in {"t_c", "at", "window_start"})
            for a in (*details.assumptions, of.requirement) for key, value in a.evidence.items()
            if isinstance(value, float)
        ]
        fit = details.fit
        ours = [] if fit is None else [
            fit.residual, fit.size, fit.least, fit.correlation, fit.lag, fit.outputs,
            [t - start for *_, t in fit.far],
        ]
        return [
            of.t - start, of.parameters, of.states, *details.metrics.columns.values(),
            *(x for x in (of.parameters_std, of.states_std, of.delta) if x is not None),
            *of.doubts[0].values(), evidence, *ours,
            [np.nan if each is None else each - start for each in times], seen.pe_level,
            seen.gram_eigenvalues, seen.level, seen.condition,
        ]

    for one, other in zip(found(0.0), found(-8.0), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("F", ["exp(-((t - 4)/0.3)**2)", "exp(20*(t - 8))"])
def test_what_an_unknown_does_at_the_start_says_little_of_its_unit(F):
    """1e-77 of what it does later was its unit, and 1e77 was an extension beyond all bounds."""
    plant = {"name": "late", "states": ["x"], "inputs": {"u": "sin(t)"}, "outputs": ["y"],
             "unknowns": {"theta": 2.0}, "initial_state": [1.0],
             "E": [[1]], "A": [[-1]], "B": [[1]], "F": [[F]], "C": [[1]]}
    found = run(plant, estimator="least_squares", f0=1e-9, time={"horizon": 8, "samples": 5})
    assert found.parameters["theta"] == pytest.approx(2.0, rel=1e-6)
