"""The Python interface: the command line's numbers, defaults and messages, without Hydra."""

from __future__ import annotations

import io
import itertools
import sys
import time
from html import escape
from types import SimpleNamespace

import inprocess
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import yaml
from examples import ROOT, assert_repeats, gpebo
from omegaconf import OmegaConf
from plants import DECAYING, one_state, shipped
from processes import assert_refused, install, printed, python, refused

import gpebo_cli
from gpebo_cli import (
    ConfigError,
    GpeboError,
    Measurements,
    ModelError,
    Result,
    SolverSettings,
    TimeSettings,
    available,
    check,
    load_plant,
    observe,
    run,
    simulate,
    system_from_functions,
)
from gpebo_cli.api.choice import choose, default
from gpebo_cli.configs import configuration
from gpebo_cli.experiment import limits
from gpebo_cli.experiment.limits import paced
from gpebo_cli.experiment.noise import noise_levels
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.findings import replaced
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import OutputSettings, Settings


@pytest.fixture(scope="module")
def circuit() -> Result:
    return run("circuit", estimator="drem", gamma=[1e8, 1e10], time={"horizon": 8, "samples": 201})


def test_every_public_name_is_there():
    assert set(gpebo_cli.__all__) == set(dir(gpebo_cli))
    for name in gpebo_cli.__all__:
        assert getattr(gpebo_cli, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'rnu'"):
        _ = gpebo_cli.rnu


def test_importing_the_package_loads_no_numbers_and_running_loads_no_hydra():
    script = (
        "import sys, gpebo_cli\n"
        "assert not {'numpy', 'yaml', 'dataclasses'} & set(sys.modules)\n"
        "result = gpebo_cli.run('descriptor', estimator='ls_drem', time={'samples': 11})\n"
        "heavy = {'hydra', 'omegaconf', 'pandas', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    printed(python("-S", "-c", f"import sys; sys.path += {sys.path!r}\n{script}"))


def test_signals_by_name(circuit):
    simulation, system = circuit.details.simulation, circuit.details.system
    column = system.states.index("il")
    np.testing.assert_array_equal(circuit["il"], simulation.states[:, column])
    np.testing.assert_array_equal(circuit.states["il"], circuit["il"])
    np.testing.assert_array_equal(circuit["V"], circuit.inputs["V"])
    np.testing.assert_array_equal(circuit["y"], circuit.outputs["y"])
    np.testing.assert_array_equal(circuit["t"], np.linspace(0, 8, 201))
    # y = il + iv, whatever is called what
    np.testing.assert_allclose(circuit["y"], circuit["il"] + circuit["iv"], atol=1e-12)


def test_estimates_have_one_row_per_case_and_errors_are_estimate_minus_truth(circuit):
    assert [case["gamma"] for case in circuit.cases] == [1e8, 1e10]
    assert circuit.estimates["e0_il"].shape == (2, 201)
    np.testing.assert_array_equal(circuit["il_hat"], circuit.estimates["il"])
    np.testing.assert_allclose(circuit.errors["il"], circuit.estimates["il"] - circuit["il"])
    truth = circuit.parameters["e0_il"]
    np.testing.assert_allclose(circuit.errors["e0_il"], circuit.estimates["e0_il"] - truth)
    assert np.abs(circuit.errors["il"][:, -1]).max() < 1e-9


def test_parameters_are_those_at_the_end():
    plant = one_state(unknowns={"k": "1 + t"}, F=[[1]])
    assert run(plant, time={"horizon": 2, "samples": 11}).parameters["k"] == 3.0


def test_a_name_that_is_not_there_is_a_key_error_with_the_nearest_one(circuit):
    with pytest.raises(KeyError, match=r"no signal 'il_ha'.*did you mean il_hat"):
        _ = circuit["il_ha"]
    with pytest.raises(ConfigError, match="states has no 'V'"):
        _ = circuit.states["V"]
    assert "V" not in circuit.states
    assert circuit.states.get("V") is None
    assert list(circuit.states) == list(circuit.details.system.states)
    assert "il_ha" not in circuit
    assert len({name: circuit[name] for name in circuit}) == 1 + 1 + 1 + 6 + 9  # t, u, y, x, hats


def test_what_is_done_to_the_plant_of_a_result_is_not_in_the_next_run():
    words = {"observer": "none", "time": {"samples": 11, "horizon": 1.0}}
    first = run("circuit", **words)
    system = first.details.system
    system.initial_state[:], system.units["e1"] = 9.0, "kV"
    second = run("circuit", **words)
    np.testing.assert_array_equal(second["e1"], first["e1"])
    assert second.details.system.units["e1"] == "V"


@pytest.mark.parametrize("sampling", [{}, {"sample_time": 0.1}])
def test_a_name_that_is_parameter_and_state_is_refused_rather_than_guessed(sampling):
    plant = {
        "name": "clash", "states": ["T", "e0_T"], "outputs": ["y"], "E": [[1, 0], [0, 0]],
        "A": [[-1, 0], [1, 1]], "C": [[1, 0]], "initial_state": [1, -1],
    }
    with refused("plant clash: e0_T is an estimated parameter and a state; every name must be"):
        run(plant, time={"samples": 11}, observer={"name": "gpebo", **sampling})


@pytest.mark.parametrize(("time", "solver", "message"), [
    ({"horizon": -1.0}, {}, "time.horizon: expected a positive number, got -1.0"),
    ({"horizon": np.inf}, {}, "time.horizon: expected a finite number, got inf"),
    ({}, {"tol": np.nan}, "solver.tol: expected a finite number, got nan"),
    ({}, {"name": "ipv"}, "solver.name: expected collocation or ivp, got 'ipv'; did you mean ivp?"),
])
def test_settings_of_a_single_step_are_checked_as_those_of_a_run(time, solver, message):
    system = load_plant("circuit")
    with refused(message):
        simulate(system, TimeSettings(**time), SolverSettings(**solver))
    if solver:
        with refused(message):
            observe(system, None, SolverSettings(**solver))


def test_what_is_printed_is_what_the_command_prints(circuit, tmp_path):
    done = gpebo(
        "run", "estimator=drem", "estimator.gamma=[1e8,1e10]", "time.horizon=8",
        "time.samples=201", "figures=none",
        "hydra.run.dir=there", cwd=tmp_path,
    )
    lines = done.stdout.splitlines()
    lines.remove("there")
    assert str(circuit).splitlines() == lines
    assert repr(circuit) == (
        "<gpebo run of circuit, t = 0 to 8 s, gpebo, 201 times, drem with 2 cases>"
    )
    system = load_plant("circuit")
    simulation = simulate(system, TimeSettings(horizon=2.0), SolverSettings())
    measured = Measurements(simulation.signals.inputs, simulation.signals.outputs)
    assert len(repr(simulation)) < 1000  # arrays over time are not printed
    assert len(repr(observe(system, measured))) < 2000
    assert "t = 0 to 2 s" in repr(simulation)
    assert repr(run("circuit", observer="none", time={"samples": 3})) == (
        "<gpebo run of circuit, t = 0 to 20 s, none, 3 times>"
    )
    shown = circuit._repr_html_()
    assert escape(circuit.verdict) in shown
    assert shown.count("<tr>") == 3


def test_the_folder_is_the_command_lines_byte_for_byte(circuit, tmp_path):
    circuit.save(tmp_path / "python", figures="gram")
    inprocess.gpebo(  # which draws its own figure
        "run", "estimator=drem", "estimator.gamma=[1e8,1e10]", "time.horizon=8",
        "time.samples=201", "figures=[gram]", "hydra.run.dir=command", cwd=tmp_path,
    )
    tables = sorted(p.name for p in (tmp_path / "command").glob("*.csv"))
    assert len(tables) == 5
    for name in [*tables, "figures/gram.png"]:
        one, other = (tmp_path / d / name for d in ("python", "command"))
        assert one.read_bytes() == other.read_bytes(), name
    one, other = (
        yaml.safe_load((tmp_path / d / "config.yaml").read_text()) for d in ("python", "command")
    )
    assert list(one) == list(other)
    # 8 is 8.0 for both; only the type of what was typed may differ
    assert one == other


def test_a_saved_folder_repeats_itself(tmp_path):
    (tmp_path / "mine.yaml").write_text(DECAYING)
    result = run(tmp_path / "mine.yaml", gamma=(1, 2.5), time={"samples": 51})
    folder = result.save(tmp_path / "first", figures=False)
    assert folder == tmp_path / "first"
    assert yaml.safe_load((folder / "config.yaml").read_text())["figures"] == "none"
    assert_repeats(folder, "signals.csv", "estimates.csv", "cases.csv")


def test_defaults_are_those_of_the_files():
    entries = yaml.safe_load((ROOT / "conf" / "gpebo.yaml").read_text())["defaults"]
    chosen = {k: v for entry in entries if isinstance(entry, dict) for k, v in entry.items()}
    for group in ("plant", "observer", "estimator", "solver"):
        assert default(group) == chosen[group]
        content, source = choose(group, None, None)
        assert content == OmegaConf.to_container(OmegaConf.load(source))  # Hydra's loader
    settings = run("circuit", solver="ivp", observer="none", time={"horizon": 0.1}).details.settings
    assert settings.solver.tol == OmegaConf.load(ROOT / "conf/solver/ivp.yaml").tol
    # a mapping without a name changes the default, not something else
    assert choose("solver", {"tol": 1e-9}, None)[0]["name"] == "collocation"


def test_tables_are_the_files_tables(circuit, tmp_path):
    folder = circuit.save(tmp_path, figures=False)
    for name in ("signals", "regression", "excitation"):
        frame = circuit.to_pandas(name)
        read = pd.read_csv(folder / f"{name}.csv", index_col="t")
        pd.testing.assert_frame_equal(frame, read, check_exact=True)
    estimates = pd.read_csv(
        folder / "estimates.csv", index_col=["case", "t"]
    )
    pd.testing.assert_frame_equal(circuit.to_pandas("estimates"), estimates, check_exact=True)
    cases = pd.read_csv(folder / "cases.csv", index_col="case")
    pd.testing.assert_frame_equal(
        circuit.to_pandas("cases"), cases.astype(float), check_exact=True, check_index_type=False
    )


def test_figures(circuit):
    assert "gains" not in circuit.figures
    figure = circuit.plot()
    assert len(figure.axes) == 3
    assert figure._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match=r"did you mean gram\?"):
        circuit.plot("grm")
    with pytest.raises(ConfigError, match="has nothing for gains; it has signals, regressor"):
        circuit.plot("gains")


def test_a_panel_on_axes_of_ones_own(circuit):
    figure, axes = plt.subplots()
    assert circuit.plot("state_error_a", ax=axes) is axes
    assert axes.get_yscale() == "log"
    _, other = plt.subplots()
    circuit.plot("error of e2", ax=other)
    for shown, name in ((axes, "e1"), (other, "e2")):
        size = np.abs(circuit.errors[name][0])
        size[size == 0.0] = np.nan  # its logarithm is none
        np.testing.assert_array_equal(shown.get_lines()[0].get_ydata(), size)
    figure.savefig(io.BytesIO())
    plt.close("all")
    with pytest.raises(ConfigError, match="no figure 'e7'"):
        circuit.plot("e7", ax=axes)


def test_without_an_observer_there_are_signals_only(tmp_path):
    result = run("circuit", observer="none", time={"horizon": 1, "samples": 11})
    assert result["il"].shape == (11,)
    assert (len(result.estimates), len(result.errors), result.cases) == (0, 0, [])
    assert (result.parameters, result.excitation, result.estimates_t.shape) == ({}, None, (0,))
    with pytest.raises(ConfigError, match="made with observer=none"):
        result.to_pandas("estimates")
    with pytest.raises(ConfigError, match=r"there is no table 'estimate'.*did you mean estimates"):
        result.to_pandas("estimate")
    assert len(result.plot().axes) >= 1
    assert [p.name for p in result.save(tmp_path / "o", figures=False).glob("*.csv")] == [
        "signals.csv"
    ]


def test_a_plant_from_functions_and_from_a_mapping(tmp_path):
    system = system_from_functions(
        "rc", E=[[1, 0], [0, 0]], A=[[-1, 1], [1, 2]], C=[[1, 0.5]], initial_state=[1, -0.5]
    )
    one = run(system, estimator="ls_drem", time={"samples": 51})
    mapping = {
        "name": "rc", "states": ["x1", "x2"], "outputs": ["y1"], "E": np.diag([1, 0]),
        "A": ((-1, 1), (1, 2)), "C": [[1, 0.5]], "initial_state": np.array([1, -0.5]),
    }
    mapping = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in mapping.items()}
    other = run(mapping, estimator="ls_drem", time={"samples": 51})
    np.testing.assert_allclose(one["x2"], other["x2"], atol=1e-13)
    np.testing.assert_allclose(one["x2"], -0.5 * one["x1"], atol=1e-12)
    arrays = run(mapping, data={"t": one.t, "y1": one["y1"]}, time={"samples": 11})
    for result, head in ((one, "The plant, the estimator or the data was a Python object"),
                         (arrays, "The plant, the estimator or the data was a Python object"),
                         (other, "Repeats the run: gpebo run --config-dir")):
        text = (result.save(tmp_path / head[:3], figures=False) / "config.yaml").read_text()
        assert text.startswith(f"# {head}")
    assert load_plant(system) is system


def test_arrays_are_gains_too():
    gains = np.logspace(6, 8, 3)
    result = run("circuit", gamma=gains, time={"horizon": 1, "samples": 11})
    assert [case["gamma"] for case in result.cases] == gains.tolist()


def test_a_folder_of_ones_own(tmp_path):
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "mine.yaml").write_text(DECAYING)
    (tmp_path / "estimator").mkdir()
    (tmp_path / "estimator" / "fast.yaml").write_text("name: drem\ngamma: 1e12\n")
    assert "mine" in available("plant", tmp_path)
    with pytest.raises(ConfigError, match="there is no such folder"):
        available("plant", tmp_path / "missing")
    with refused("available('plants'): no such group", "did you mean plant?"):
        available("plants")
    with refused("regression takes a name, a path or a mapping"):
        run(regression=load_plant("circuit"))
    result = run("mine", estimator="fast", config_dir=tmp_path, time={"samples": 11})
    assert result.cases[0]["gamma"] == 1e12
    assert load_plant("mine", tmp_path).source.endswith("mine.yaml")
    with pytest.raises(ConfigError, match=r"there is no such estimator; known: [\w, ]+$"):
        run("mine", estimator="mystery", config_dir=tmp_path)  # who gives one is told of none
    (tmp_path / "plant" / "lab").mkdir()
    (tmp_path / "plant" / "lab" / "other.yaml").write_text(DECAYING)
    (tmp_path / "plant" / "loop").symlink_to(tmp_path / "plant")  # it is not followed
    names = set(available("plant", tmp_path))
    assert {"mine", "lab/other", "circuit", "published/hires"} < names
    assert not any(name.startswith("loop") for name in names)
    assert all(load_plant(name, tmp_path).states for name in names)


def test_plants_and_regressions_in_folders_of_their_group_are_found():
    assert run("published/hires", observer="none", time={"samples": 11}).details.system.n == 8
    found = run(regression="published/sdu_drem", time={"samples": 11})
    assert found.details.system.name == "sdu_drem"


def test_check_is_the_commands():
    assert all(a.holds for a in check("circuit"))
    failed = [a.name for a in check("circuit", observer={"regression": "paper"}) if not a.holds]
    assert failed == ["Assumption 2"]


WRONG = [
    ({"gama": 1}, "run: no such keyword gama; estimator ls_drem has initial, alpha, f0"),
    ({"gama": 1}, "did you mean gamma?"),
    ({"horizon": 3}, 'did you mean time={"horizon": …}?'),
    ({"remedy": "reset"}, 'did you mean observer={"remedy": …}?'),
    ({"estimtor": "drem"}, "did you mean estimator?"),
    ({"estimator": "drm"}, "estimator=drm: there is no such estimator"),
    ({"estimator": "mystery"}, "(yours: config_dir=DIR with DIR/estimator/mystery.yaml)"),
    ({"estimator": "./drem.yaml"}, "estimator=./drem.yaml: there is no such estimator; known: "),
    ({"estimator": {"name": "drem", "gama": 1}}, "estimator.gama: no such key"),
    ({"plant": "circut"}, "did you mean circuit?"),
    ({"plant": "nowhere.yaml"}, "nowhere.yaml: there is no such file"),
    ({"plant": "./nowhere"}, "./nowhere: there is no such file"),
    ({"plant": "published/nowhere"}, "plant=published/nowhere: there is no such plant"),
    ({"plant": 3}, "plant: expected a name, a path, a mapping or a DescriptorSystem, got 3"),
    ({"plant": {"name": "a"}}, "plant a: states is missing"),
    ({"time": 3}, 'time: expected a mapping such as {"horizon": 10}, got 3'),
    ({"time": {"horizn": 3}}, "did you mean horizon?"),
    ({"time": {"samples": 1}}, "time.samples: expected 2 to"),
    ({"solver": "euler"}, "solver=euler: there is no such solver"),
    ({"solver": {"tol": 1}}, "solver.tol: expected 1e-15 to 0.1"),
    ({"gamma": -1}, "estimator.gamma"),
    ({"config_dir": "nowhere", "plant": "mine"}, "config_dir nowhere: there is no such folder"),
]


@pytest.mark.parametrize(("words", "expected"), WRONG)
def test_wrong_usage_is_a_config_error_on_one_line(words, expected):
    with refused(expected):
        run(**{"plant": "circuit", **words})


@pytest.mark.parametrize(("section", "key", "low", "high"), [
    ("time", "samples", 2, 1_000_000), ("solver", "tol", 1e-15, 0.1), ("solver", "stages", 2, 16),
    ("solver", "max_elements", 1, np.inf), ("solver", "max_seconds", 1, np.inf),
    ("solver", "max_strangeness_index", 0, 20), ("solver", "rank_tol", 1e-15, 0.1),
    ("noise", "seed", 0, np.inf), ("noise", "seeds", 1, 10_000), ("output", "dpi", 30, 1200),
    ("output", "width", 1.5, 40.0), ("output", "max_rows", 2, np.inf),
    ("time", "horizon", 5e-324, np.inf), ("noise", "sample_time", 5e-324, np.inf),
    ("excitation", "rho", 5e-324, np.inf), ("excitation", "window", 5e-324, np.inf),
])
def test_numbers_are_accepted_up_to_their_limits(section, key, low, high):
    def built(value):
        words = {"name": "gaussian", key: value} if section == "noise" else {key: value}
        made = configuration.settings({section: words}, draw=False)
        return getattr(getattr(made, section), key)

    usual = getattr(getattr(Settings({}), section), key)
    assert usual in {None, "column"} or low <= usual <= high
    whole = not isinstance(low, float)
    for end, step in ((low, -1), (high, 1)):
        if np.isfinite(end):
            assert built(end) == end
            with refused(f"{key}: expected ", f"{low:g} or more" if whole and high > 1e9 else ""):
                built(end + step if whole else end * 2.0**step)


def test_a_plant_that_cannot_be_used_is_a_model_error():
    singular = {**yaml.safe_load(DECAYING), "E": [[0]], "A": [[0]]}
    with pytest.raises(ModelError) as caught:
        run(singular)
    assert isinstance(caught.value, GpeboError)


RIDGE = """\
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from gpebo_cli.findings import Requirement


@dataclass(frozen=True)
class Estimates:
    values: Any
    requirement: Requirement

    def delta(self, t):
        return None

    def parameters(self, cases):
        return self.values[cases]


@dataclass(frozen=True)
class Ridge:
    f: float = 1e-9

    @property
    def cases(self):
        return ({"f": self.f},)

    def estimate(self, regression, t):
        both = regression.gram(t)
        G = both[..., :-1] + self.f * np.eye(regression.p)
        values = np.linalg.solve(G, both[..., -1:])[None, ..., 0]
        return Estimates(values, Requirement("IE", True, {}, "all data at once"))
"""


def test_an_estimator_of_ones_own(tmp_path):
    names = {}
    exec(RIDGE, names)  # noqa: S102  the text below is a package's
    result = run("descriptor", estimator=names["Ridge"](1e-6), time={"horizon": 10})
    assert result.cases[0]["f"] == 1e-6
    assert abs(result.errors["theta1"][0, -1]) < 1e-5
    text = (result.save(tmp_path, figures=["states"]) / "config.yaml").read_text()
    assert "does not repeat the run" in text
    with pytest.raises(ConfigError, match=r"gamma given beside an estimator object"):
        run("descriptor", estimator=names["Ridge"](), gamma=1)
    halves = SimpleNamespace(cases=({},)), SimpleNamespace(estimate=print)
    for wrong in (3, names["Ridge"], *halves):
        with pytest.raises(ConfigError, match="an object with cases and estimate"):
            run("descriptor", estimator=wrong)


def test_an_estimator_of_another_package(tmp_path, monkeypatch):
    """What `pip install` leaves of a package with an entry point, and a file with its settings."""
    entries = {"ridge": "Ridge", "broken": "Gone", "odd": "RIDGE"}
    install(tmp_path, "theirs", "gpebo.estimators", **entries)
    (tmp_path / "theirs.py").write_text(RIDGE + "\n\nclass RIDGE:\n    pass\n")
    (tmp_path / "estimator").mkdir()
    for name in ("ridge", "broken", "odd"):
        (tmp_path / "estimator" / f"{name}.yaml").write_text(f"name: {name}\n")

    monkeypatch.syspath_prepend(tmp_path)

    def command(*words):
        return inprocess.gpebo(
            "run", "--config-dir", ".", "plant=descriptor", "figures=none", "hydra.run.dir=out",
            *words, cwd=tmp_path,
        )

    assert printed(command("estimator=ridge", "+estimator.f=1e-6")).split()[0] == "f"
    for words, expected in (
        (["estimator=ridge", "+estimator.g=1"], "estimator.g: no such key; estimator has f"),
        (["estimator=broken"], "estimator.name: broken of theirs cannot be imported"),
        (["estimator=odd"], "estimator.name: odd of theirs is not a dataclass"),
        (["estimator.name=ridgee"], "did you mean ridge?"),
    ):
        assert_refused(command(*words), expected)


def test_the_span_that_a_default_decides_is_written_down():
    result = run("circuit", observer="none", time={"samples": 11})
    assert result.config["time"] == {"start": 0.0, "horizon": 20.0, "samples": 11}


NOISY = {"name": "gaussian", "outputs": 0.1, "sample_time": 1.0, "seeds": 3}


@pytest.mark.parametrize(("settings", "what"), [
    ({"estimator": "gradient", "gamma": [1, 10, 100]}, "3 cases"),
    ({"observer": {"sample_time": 0.1}}, "201 samples with 1 cases"),
    ({"observer": "kalman_bucy", "noise": NOISY}, "3 noise.seeds with 1 cases"),
    ({"noise": NOISY}, "3 noise.seeds with 1 cases"),
])
def test_what_would_take_minutes_is_refused_when_that_is_known(monkeypatch, settings, what):
    """With a clock that is 100 s later at every look, and one thing at a time."""
    experiment = "gpebo_cli.experiment"
    monkeypatch.setattr(f"{experiment}.limits.process_time", itertools.count(0, 100).__next__)
    for name in ("estimation._BATCH", "estimation._SAMPLES_AT_ONCE", "seeds._NUMBERS"):
        monkeypatch.setattr(f"{experiment}.{name}", 1)
    whole = f"{100 * int(what.split()[0])} s of computing time (the first 1 took 100.0 s), and a "
    with refused(f"{what} would take some {whole}", ": solver.max_seconds=", by=GpeboError):
        run("window", **settings)


@pytest.mark.parametrize("given", [
    {"estimator": {"name": "ls_drem", "gamma": [1e2, 1e4]}, "seeds": 2},
    {"estimator": {"name": "drem", "gamma": [1e3, 1e5]}, "sample_time": 0.1},
    {"estimator": {"name": "power", "gamma": [1e3, 1e5]}},
])
def test_how_much_is_held_at_once_changes_no_result(monkeypatch, given):
    noise = {"name": "gaussian", "outputs": 0.1, "sample_time": 0.25}
    observer = {"name": "gpebo", **{k: v for k, v in given.items() if k == "sample_time"}}

    def found():
        details = run(
            "descriptor", estimator=given["estimator"], observer=observer,
            noise=noise | {k: v for k, v in given.items() if k == "seeds"},
            time={"horizon": 1.0, "samples": 9},
        ).details
        own, seeds = details.estimation, details.noise
        return [own.parameters, own.states, own.delta, *details.metrics.columns.values(),
                *(x for x in (own.parameters_std, own.states_std) if x is not None),
                *([] if seeds is None else [seeds.bias, seeds.deviation, seeds.rms])]

    whole = found()
    for name, count in {
        "estimators._scalar._LANES": 1, "estimators._scalar._STRETCH": 3,
        "estimators.ls_drem._AT_ONCE": 3, "estimators.power._STRETCH": 3,
        "evidence.uncertainty._CHUNK": 1, "experiment.estimation._BATCH": 1,
        "experiment.estimation._SAMPLES_AT_ONCE": 7, "experiment.seeds._NUMBERS": 1,
    }.items():
        monkeypatch.setattr(f"gpebo_cli.{name}", count)
    for one, other in zip(found(), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


def test_a_result_without_signals_says_what_it_needs():
    details = run("window", time={"horizon": 1.0}).details
    with pytest.raises(ValueError, match="a result needs a simulation or a recording"):
        _ = replaced(details, simulation=None).signals


def test_stages_take_a_part_of_the_time_that_all_takes():
    since = time.perf_counter()
    timings = run("window", time={"horizon": 1.0}).details.timings
    assert 0.0 < sum(timings.values()) < time.perf_counter() - since
    assert min(timings.values()) >= 0.0


def test_memory_is_refused_by_how_many_equations_are_differential():
    """Of 40 states one has a derivative at the start, or from t = 1 on all have."""
    E = np.diag(["2 + sin(t)", *["step(t - 1)"] * 39]).tolist()
    plant = plant_from_mapping({
        "name": "many", "states": [f"x{k}" for k in range(40)], "outputs": ["y"],
        "E": [[entry or 0 for entry in row] for row in E], "A": (-np.eye(40)).tolist(),
        "C": np.ones((1, 40)).tolist(), "initial_state": [0] * 40,
    })
    for start, refusal in ((0.0, None), (np.nan, None), (2.0, "5.25 GB"), (0.9, None)):
        time = TimeSettings(start=start, samples=50_000)
        settings = Settings({}, time=time)
        levels = noise_levels(settings.noise, plant)
        limits.check(settings, plant, levels, 0)  # nothing is estimated
        if refusal is None:
            limits.check(settings, plant, levels, 1)
        else:
            with refused(f"time.samples = 50000 would take some {refusal} of memory"):
                limits.check(settings, plant, levels, 1)


def test_a_run_that_takes_too_much_memory_is_refused_before_anything_is_done(monkeypatch):
    """Of 21 samples, with a limit of some bytes."""
    monkeypatch.setattr("gpebo_cli.errors._MOST", 1e-8)
    told = []
    with refused("time.samples = 21 would take some ", "; a run may take 1e-08 GB"):
        run_experiment(Settings(
            {"name": "drem", "gamma": 1.0}, TimeSettings(0.0, 1.0, 21),
        ), shipped("window"), told.append)
    assert not told


@pytest.mark.parametrize("observer", [{}, {"sample_time": 0.05}])
@pytest.mark.parametrize(("rows", "kept"), [(303, 101), (1000, 101), (60, 20), (2, 2)])
def test_many_cases_keep_fewer_samples_each_evenly_spread(observer, rows, kept):
    estimation = run_experiment(Settings(
        {"name": "ls_drem", "gamma": [1, 10, 100]}, TimeSettings(0.0, 5.0, 101),
        observer={"name": "gpebo", **observer}, output=OutputSettings(max_rows=rows),
    ), shipped("window")).estimation
    t = estimation.t
    assert (t[0], t[-1], len(t)) == (0.0, pytest.approx(5.0), kept)
    np.testing.assert_allclose(np.diff(t), 5.0 / (kept - 1), atol=0.0501)
    assert estimation.parameters.shape[:2] == estimation.states.shape[:2] == (3, kept)


def test_a_section_of_nothing_has_the_defaults():
    assert configuration.settings({"time": None, "solver": None}, draw=False) == (
        configuration.settings({}, draw=False)
    )


def test_a_result_shows_its_names_and_what_it_rests_on(circuit):
    assert repr(circuit.inputs) == "<inputs: V>"
    assert circuit.assumptions == circuit.details.assumptions
    assert circuit.excitation is circuit.details.excitation


def test_a_loop_tells_which_share_of_it_is_done():
    shares = []
    loop = paced(4, "cases", 1e9, shares.append)
    for done in (1, 4):
        loop(done)
    assert shares == [0.25, 1.0]


def test_a_loop_is_refused_by_how_long_it_took_so_far(monkeypatch):
    """Not within its first second, and not when all of it is done."""
    clock = iter([10.0, 10.9, 15.0, 99.0])
    monkeypatch.setattr("gpebo_cli.experiment.limits.process_time", clock.__next__)
    loop = paced(10, "cases", 4.0, lambda _: None)
    loop(1)
    with refused("10 cases would take some 25 s of computing time (the first 2 took 5.0 s), and a "
                 "run may take 4 s; to wait for them: solver.max_seconds=50"):
        loop(2)
    loop(10)
