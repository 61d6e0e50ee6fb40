"""What cannot be done is refused in one line that says what is wrong and what would be accepted."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from plants import shipped
from test_remedies import UNBOUNDED

from gpebo_cli import run
from gpebo_cli.errors import ConfigError, GpeboError, ModelError
from gpebo_cli.experiment.online import Online
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers.reduced.invariant import invariant_observer
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
        ({"time": {"start": 1e9, "horizon": 1e-9}}, "too short to be resolved beside time.start"),
        ({"plant": plant_from_mapping(HIDDEN)}, "t = 1 puts an impulse into b; an observer cannot"),
        ({"data": {"name": "csv"}}, "data=csv needs data.file=FILE"),
        ({"data": {"name": "csv", "frame": 3}}, "expected a file or a pandas.DataFrame, got 3"),
        ({"data": {"name": "csv", "file": "-"}}, "standard input is for gpebo run"),
        ({"data": ROWS[:1]}, "data has 1 rows; at least 2"),
        (
            {"data": {"name": "csv", "frame": ROWS.where(ROWS > 0.5), "missing": "drop"}},
            "data has 1 rows without gaps; 2",
        ),
        (
            {
                "plant": plant_from_mapping(UNBOUNDED),
                "observer": {"name": "gpebo", "remedy": "current_coordinates"},
                "estimator": {"name": "least_squares", "beta": 1.0, "bound": 1e9},
            },
            "forgets at a constant rate; accepted: estimator.bound=null",
        ),
        (canonical(unknowns={"q": 1}, F=[[0], [0], [1], [0], [0]]), "in the equations of z_a only"),
        (canonical(D=[[1, 0, 0, 0], [0, 0, 0, 0]]), "and it has D; use observer=gpebo"),
    ],
)
def test_of_runs(settings, message):
    with pytest.raises(GpeboError) as caught:
        run(settings.pop("plant", "circuit"), **settings)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": {"a": "$x$"}}, "labels.a: expected 1 to 80 characters"),
        ({"labels": {"q": "x"}}, "labels has 'q', which is no state, input, output or unknown"),
        ({"matrices": 3}, "matrices is the name of an .npz file, not 3"),
        ({"A": [["(" * 300 + "t" + ")" * 300, 1], [1, 0]]}, "it is nested too deeply"),
        ({"A": [["-" * 3000 + "t", 1], [1, 0]]}, "it is nested too deeply"),
    ],
)
def test_of_plants(changes, message):
    with pytest.raises(ConfigError) as caught:
        plant_from_mapping({**HIDDEN, **changes})
    assert message in str(caught.value)


def test_of_several_recordings_with_an_observer_of_later_states(tmp_path):
    files = [str(tmp_path / name) for name in ("a.csv", "b.csv")]
    for file in files:
        ROWS.to_csv(file, index=False)
    observer = {"name": "gpebo", "remedy": "reset", "reset_interval": 1.0}
    with pytest.raises(ConfigError, match="several files need an observer whose parameters are θ"):
        run("circuit", data={"name": "csv", "file": files}, observer=observer)


def test_of_a_state_space_model_that_would_need_derivatives():
    system = plant_from_mapping({**HIDDEN, "inputs": {"u": "sin(t)"}})
    with pytest.raises(ConfigError, match="needs derivatives of inputs"):
        invariant_observer(system, SolverSettings(), "strangeness_free", None, 0.0)


def test_of_a_rank_of_E_that_changes_between_two_parts_of_a_stream():
    switched = plant_from_mapping({
        **HIDDEN, "E": [[1, 0], [0, "step(t - 1)"]], "A": [[-1, 1], [1, -1]], "C": [[1, 1]],
        "inputs": {"u": 0},
    })
    settings = Settings({}, {"name": "least_squares"}, observer={"name": "gpebo", "form": "given"})
    online = Online(settings, switched, "zoh", 0.0, np.zeros(2))
    online.feed(np.array([0.0, 0.5]), np.zeros((2, 1)), np.zeros((2, 1)))
    with pytest.raises(ModelError, match=r"rank of E changes from 1 to 2 before t = 1;"):
        online.feed(np.array([1.0]), np.zeros((1, 1)), np.zeros((1, 1)))
