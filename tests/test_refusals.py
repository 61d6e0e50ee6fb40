"""What cannot be done is refused in one line that says what is wrong and what would be accepted."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from inprocess import gpebo
from plants import one_state, shipped
from processes import assert_refused, refused
from test_remedies import UNBOUNDED

from gpebo_cli import run, system_from_functions
from gpebo_cli.errors import ConfigError, GpeboError, ModelError
from gpebo_cli.estimators import build
from gpebo_cli.experiment.online import Online
from gpebo_cli.importers.matrices import from_control
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers.reduced.invariant import invariant_observer
from gpebo_cli.regression.text import regression_from_mapping
from gpebo_cli.results.files import remove_files
from gpebo_cli.settings import Settings, SolverSettings

# a' = b with 0 = a + u: b = −u'.
HIDDEN = {
    "name": "hidden", "states": ["a", "b"], "inputs": {"u": "step(t - 1)"}, "outputs": ["y"],
    "E": [[1, 0], [0, 0]], "A": [[0, 1], [1, 0]], "B": [[0], [1]], "C": [[1, 0]],
    "initial_state": [0, 0],
}
ROWS = pd.DataFrame({"t": [0.0, 1.0, 2.0], "V": [0.0, 1.0, 0.0], "y": [0.0, 1.0, 0.0]})


def canonical(**changes):
    return {"plant": shipped("canonical", **changes), "observer": "canonical"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({"time": {"start": start, "horizon": 1e-9}}, "too short to be resolved beside time.sta")
          for start in (1e9, -1e9)),
        ({"time": {"horizon": 1e-310}}, "1e-310 s is too short to be resolved"),
        ({"plant": plant_from_mapping(HIDDEN)}, "t = 1 puts an impulse into b; an observer cannot"),
        *(({"data": {"name": "csv", "file": file}}, "data=csv needs data.file=FILE")
          for file in (None, "", [])),
        ({"data": {"name": "csv", "frame": 3}}, "a list of files or one pandas.DataFrame, got 3"),
        ({"data": {"name": "csv", "file": "-"}}, "standard input is for gpebo run"),
        ({"data": ROWS[:1]}, "data has 1 rows; at least 2"),
        (
            {"data": {"frame": ROWS[:0].astype({"t": object}), "time_unit": "datetime"}},
            "data has 0 rows; at least 2",
        ),
        (
            {"data": {"name": "csv", "frame": ROWS.where(ROWS > 0.5), "missing": "drop"}},
            "data has 1 rows without gaps; 2",
        ),
        (
            {
                "plant": plant_from_mapping(UNBOUNDED),
                "observer": {"name": "gpebo", "remedy": "current_coordinates"},
                "estimator": {"name": "least_squares", "f0": 1e-6, "beta": 1, "bound": 1e9},
            },
            "forgets at a constant rate; accepted: estimator.bound=null",
        ),
        (canonical(unknowns={"q": 1}, F=[[0], [0], [1], [0], [0]]), "in the equations of z_a only"),
        (canonical(D=[[1, 0, 0, 0], [0, 0, 0, 0]]), "and it has D; use observer=gpebo"),
        (
            {"estimator": {"name": "least_squares", **dict.fromkeys(
                ("alpha", "f0"), "logspace(0, 9, 1001)")}},
            "the gains make 1002001 cases; at most",
        ),
        (
            {"observer": {"name": "gpebo", "remedy": "output_injection", "injection": [[1.0], []]}},
            "observer.injection has 2 rows of 0 or 1 entries; plant circuit needs 6 (states) of 1",
        ),
        (
            {"observer": {"name": "gpebo", "remedy": "reset", "reset_interval": 1e-6}},
            "observer.reset_interval = 1e-06 makes 20000000 resets; at most",
        ),
        ({"noise": {"name": "none", "outputs": 0.1}}, "noise.outputs: noise=none has no noise"),
        ({"data": ROWS.assign(V=[True, False, True])}, "data, column V: bool is not numbers"),
        (
            {"plant": {**HIDDEN, "inputs": {"u": 0}, "outputs": [], "C": []}},
            "the observer needs outputs and C; without",
        ),
        (
            {"observer": {"name": "gpebo", "remedy": "reset", "unknown_initial": ["il"]}},
            "observer.unknown_initial: with this remedy the parameters are about later states",
        ),
        (
            {"time": {"start": 1.0, "horizon": 2.0}, "observer": {"sample_time": 2.5}},
            "observer.sample_time = 2.5 is longer than the horizon of 2 s",
        ),
        (
            {"time": {"start": 1.0, "horizon": 2.0}, "observer": {"sample_time": 1.999e-6}},
            "observer.sample_time = 1.999e-06 makes 1000500 samples; at most 1000000",
        ),
        (
            {"noise": {"name": "gaussian", "outputs": 0.1, "sample_time": 1e-5}},
            "noise.sample_time = 1e-05 s makes 2e+06 samples over 20 s, and each needs an element",
        ),
        (
            {"estimator": {"name": "least_squares", "f0": None, "bound": 0.5}},
            "estimator.bound = 0.5 is one of the covariance, which starts at 1/f0: give",
        ),
        (
            {"noise": {"name": "gaussian", "outputs": 0.1, "sample_time": 1e-3, "seeds": 101}},
            "noise.seeds = 101: with noise.sample_time = 0.001 s they have 2.02e+06 samples",
        ),
    ],
)
def test_of_runs(settings, message):
    with refused(message, by=GpeboError):
        run(settings.pop("plant", "circuit"), **settings)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": [[1e155, 1], [1, 0]]}, "A[0][0] is 1e+155 at t = 0; numbers go up to 1e+"),
        ({"E": [[1e-155, 0], [0, 0]]}, "E[0][0] is 1e-155 at t = 0; numbers of E go down to 1e-"),
        ({"initial_state": [1e155, 0]}, "initial_state.a is 1e+155; numbers go up to"),
    ],
)
def test_of_numbers_whose_products_or_quotients_overflow(changes, message):
    with refused("use other units", message):
        run({**HIDDEN, **changes}, observer="none")


def constant(**matrices):
    """A plant of functions: x' = −x, y = x, with other matrices."""
    given = {"E": [[1.0]], "A": [[-1.0]], "C": [[1.0]], **matrices}
    return system_from_functions("constant", initial_state=[1.0], **given)


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        ({"A": [[1.0, 2.0]]}, "A has shape (1, 2), expected (1, 1) (the initial state has 1 entr"),
        ({"A": lambda t: np.ones((len(t), 2, 1))}, "A returned shape ("),
    ],
)
def test_of_functions(matrices, message):
    with refused(message):
        run(constant(**matrices), time={"horizon": 1.0})


def test_of_several_recordings_with_an_observer_of_later_states(tmp_path):
    files = [str(tmp_path / name) for name in ("a.csv", "b.csv")]
    for file in files:
        ROWS.to_csv(file, index=False)
    observer = {"name": "gpebo", "remedy": "reset", "reset_interval": 1.0}
    with refused("several files need an observer whose parameters are θ and the initial error; "
                 "accepted is observer=gpebo with remedy none, output_injection or noise_free"):
        run("circuit", data={"name": "csv", "file": files}, observer=observer)


@pytest.mark.parametrize(("state", "observer", "message"), [
    ("x_2", {}, "plant p: e0_x_2 is an estimated parameter twice; every name must be used once"),
    ("w_x", {"name": "kalman_bucy"}, "plant p: w_x is an estimated parameter and a state; every"),
])
def test_of_parameters_that_would_share_a_name(tmp_path, state, observer, message):
    """e0_x_2 is that of x in the second file and of x_2 in the first; a filter estimates w_x."""
    plant = one_state(
        states=["x", state], E=np.eye(2), A=-np.eye(2), C=[[1, 1]], initial_state=[0, 0]
    )
    ROWS.to_csv(file := str(tmp_path / "a.csv"), index=False)
    with refused(message):
        run(plant, data=[file, file] if not observer else file, observer=observer or "gpebo")


@pytest.mark.parametrize(("changes", "message"), [
    ({"inputs": {"u": "sin(t)"}}, "needs derivatives of inputs"),
    ({"A": [["sin(t)", 1], [1, 0]]}, "not time-invariant: A depends on time or on signals, and a"),
    ({"phi": [1, 0]}, "not time-invariant: phi is not zero, and a state-space model"),
])
def test_of_state_space_models(changes, message):
    system = plant_from_mapping({**HIDDEN, **changes})
    with pytest.raises(ConfigError, match=message):
        invariant_observer(system, SolverSettings(), "strangeness_free", None, 0.0)


def test_of_a_rank_of_E_that_changes_between_two_parts_of_a_stream():
    switched = plant_from_mapping({
        **HIDDEN, "E": [[1, 0], [0, "step(t - 1)"]], "A": [[-1, 1], [1, -1]], "C": [[1, 1]],
        "inputs": {"u": 0},
    })
    settings = Settings({"name": "least_squares"}, observer={"name": "gpebo", "form": "given"})
    online = Online(settings, switched, "zoh", 0.0, np.zeros(2), build(settings.estimator))
    online.feed(np.array([0.0, 0.5]), np.zeros((2, 1)), np.zeros((2, 1)))
    with pytest.raises(ModelError, match=r"rank of E changes from 1 to 2 before t = 1;"):
        online.feed(np.array([1.0]), np.zeros((1, 1)), np.zeros((1, 1)))


CIRCUIT = "* divider\nV1 a 0 1\nR1 a b 1\nC1 b 0 1\n.end\n"


@pytest.mark.parametrize(
    ("words", "files", "message"),
    [
        (["check", "-m"], {}, "gpebo check looks at one configuration; leave out -m"),
        (["compare"], {}, "gpebo compare needs folders of runs or sweeps; see gpebo compare"),
        (["report"], {}, "gpebo report needs folders of runs or sweeps; see gpebo report"),
        (["run", "plant.labels.il='^^'"], {}, "labels.il: '^^' is not mathematics that matplotlib"),
        (["new", "plant", "x", "--from", "m.yaml"], {"m.yaml": "a: ["}, "not valid YAML: "),
        (["new", "plant", "x", "--from", "m.yaml"], {"m.yaml": "M: 1\nM: 2"}, "M stands twice"),
        (["new", "plant", "x", "--from", "m.yaml"], {"m.yaml": "- 1"}, "a mapping with M, D, K, G"),
        (["new", "plant", "x", "--from", "a.cir", "--measure", "i(q)"], {"a.cir": CIRCUIT},
         "i(q): there is no element q"),
        (["new", "plant", "x", "--from", "a.cir", "--measure", "v(a,b,0)"], {"a.cir": CIRCUIT},
         "'v(a,b,0)' is neither v(node) nor i(element)"),
        (["new", "plant", "x"], {"plant/x.yaml": ""}, "x.yaml exists already; remove it, or"),
        (["run", "estimator=x"], {"estimator/x.yaml": "defaults: [a]\nname: drem\n"},
         "x.yaml: a file of estimator/ has no defaults list"),
        *((["run", "experiment=x"],
           {"experiment/x.yaml": f"# @package _global_\ndefaults: [{entry}]\ntitle: a\n"},
           "a defaults list may choose a file of plant, ")
          for entry in ("/docs/extra", "/docs: extra", "/experiment: ../docs/extra")),
        *((["run", "experiment=x"], {"experiment/x.yaml": text},
           f"x.yaml: {key}: expected a mapping of keys to values, got {rest}\n")
          for key, text, rest in (
              ("plant", "plant: circuit\n",
               "'circuit'; files are chosen as in `- override /plant: NAME`"),
              ("time", "time: [1]\n", "[1]"),
          )),
        (["run", "experiment=x"], {"experiment/x.yaml": "# @package plant\ntime: {horizon: 1}\n"},
         "x.yaml: only `# @package _global_` is allowed, got 'plant'"),
        (["run", "experiment=x"], {"experiment/x.yaml":
         "# @package _global_\nhydra: {sweeper: {params: {+a: 1}}}\n"}, "'+a=1' cannot be swept"),
        (["run", "experiment=x"], {"experiment/x.yaml":
         "# @package _global_\nhydra: {sweeper: {params: 3}}\n"}, "'3=' cannot be swept"),
    ],
)
def test_of_commands(words, files, message, tmp_path):
    """One line, exit code 2, and nothing written."""
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    folder = ["--config-dir", "."] if files and words[0] in ("run", "new") else []
    done = gpebo(*words, *folder, cwd=tmp_path)
    assert_refused(done, message)
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} == set(files)


def test_of_comparing_what_estimated_nothing(tmp_path):
    gpebo("run", "observer=none", "figures=none", "hydra.run.dir=a", cwd=tmp_path)
    said = "nothing to compare: no run in these folders has estimated anything"
    assert_refused(gpebo("compare", "a", cwd=tmp_path), said, code=1)


def test_of_calls_from_python(tmp_path):
    for call, error, message in (
        (lambda: run(data={"t": [0.0, 1.0], "y": [0.0]}), ConfigError,
         "data: arrays of the shapes t (2,), y (1,): "),
        (lambda: run(data={"t": [0.0, 1.0], "y": [0.0, 1.0], "hold": "zoh"}), ConfigError,
         "data: 'hold' is no array; how rows are read stands beside all of them"),
        (lambda: run(data={"name": "csv", "file": [["a.csv"], ["b.csv"]]}), ConfigError,
         "data.file: "),
        (lambda: from_control(SimpleNamespace(B=np.eye(1)), "p"), ConfigError,
         "plant p: SimpleNamespace has no A; give a state-space model"),
        (lambda: regression_from_mapping(3, "r.yaml"), ConfigError,
         "regression (r.yaml) must be a mapping with the keys "),
        (lambda: regression_from_mapping({"name": "r", "signals": 3}), ConfigError,
         "regression r: signals must map names to expressions"),
        (lambda: remove_files([tmp_path]), GpeboError, f"cannot remove {tmp_path}: "),
    ):
        with refused(message, by=error):
            call()


@pytest.mark.parametrize("settings", [
    {"data": {"file": "x", "missing": 10**5000}}, {"observer": {"form": 10**5000}},
    {"time": {"samples": 10**5000}}, {"time": {"samples": -10**400}}, {"gamma": 10**5000},
])
def test_of_whole_numbers_that_no_text_is_made_of(settings):
    with pytest.raises(ConfigError, match=r"^[a-z_.]+: expected .*, got (a int that cannot|-1000)"):
        run("circuit", estimator="drem", **settings)
