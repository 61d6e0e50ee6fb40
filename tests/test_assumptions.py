"""``gpebo check``: every assumption with its evidence, as a table and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from examples import gpebo
from plants import one_state, reference, shipped
from processes import printed
from scipy.integrate import quad

from gpebo_cli import check, run
from gpebo_cli.experiment.assumptions import examine, warnings
from gpebo_cli.experiment.pipeline import run_experiment
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.settings import Settings, TimeSettings

ROOT = Path(__file__).parent.parent


def found(system, **observer):
    settings = Settings(estimator={}, observer={"name": "gpebo", **observer})
    return {a.name: a for a in examine(settings, system).assumptions}


def test_the_circuit_satisfies_everything():
    names = found(shipped("circuit"))
    assert all(a.holds for a in names.values())
    assert names["Solvability"].evidence["index"] == 2
    assert names["Solvability"].evidence["strangeness_index"] == 1
    assert names["Consistent start"].evidence["largest_change"] == pytest.approx(3.2)  # iv falls
    excitation = names["Assumption 2"].evidence
    values = np.array(reference("circuit")["at"][-1]["gram_eigenvalues"])
    assert excitation["t_c"] > 0
    assert excitation["lambda_min"] == pytest.approx(values[0], rel=1e-6)
    assert "Regularity" not in names  # a notion for constant coefficients


def test_the_literal_regressor_fails_the_excitation_assumption():
    names = found(shipped("circuit"), regression="paper")
    assert not names["Assumption 2"].holds
    assert [name for name, a in names.items() if not a.holds] == ["Assumption 2"]


def test_the_canonical_form_has_its_own_assumptions():
    names = found(shipped("canonical"), name="canonical")
    assert {f"Assumption {k}" for k in (3, 4, 5, 6, 7)} <= set(names)
    assert all(a.holds for a in names.values())


def test_a_plant_without_differential_equations_is_examined():
    """0 = v − x = x + v and y = x + e are three equations for x, of which it takes a third of e."""
    settings = Settings(estimator={}, observer={"name": "gpebo", "form": "given"})
    found = examine(settings, lti(E=[[0, 0], [0, 0]]))
    assert found.deviations == pytest.approx({"x": 1.0 / 3.0, "v": 0.0})
    rank = next(a for a in found.assumptions if a.name == "Rank condition D2")
    assert rank.evidence == {"rank": 2, "needed": 2}


def test_an_unstable_unknown_input_observer_is_seen():
    """c1 < 0 turns the sign of a1 c1/c2: M_w is unstable for every gain (errata, Remark 4)."""
    names = found(
        shipped("canonical", C=[[1, 0, 0, 0, 0], [0.5, 0, "-c1", "c2", 0]]), name="canonical"
    )
    assert not names["Assumption 7"].holds
    assert names["Assumption 7"].evidence["transition_norm"] > 1e3


def lti(**changes):
    return plant_from_mapping({
        "name": "lti", "states": ["x", "v"], "outputs": ["y"],
        "E": [[1, 0], [0, 0]], "A": [[-1, 1], [1, 1]], "C": [[1, 0]],
        "initial_state": [1, -1], **changes,
    })


def test_constant_coefficients_get_regularity_and_the_rank_condition():
    names = found(lti())
    assert names["Regularity"].holds
    assert names["Rank condition D2"].holds
    assert names["Rank condition D2"].evidence == {"rank": 3, "needed": 3}
    blind = found(lti(A=[[-1, 1], [1, 0]]), form="given")  # neither A22 nor C sees v
    assert not blind["Rank condition D2"].holds
    assert blind["Rank condition D2"].evidence == {"rank": 2, "needed": 3}
    assert not blind["Assumption 1"].holds


@pytest.mark.parametrize("copies", [1, 9])
def test_a_pencil_is_as_regular_as_where_it_is_most_so(copies):
    """σ_min(λE − A)/‖A‖ at λ that are roots of one; of many states a bound of it at λ = ±1."""
    E, A, C = (np.kron(np.eye(copies), block) for block in (
        [[1.0, 0.0], [0.0, 0.0]], [[-1.0, 1.0], [1.0, 1.0]], [[1.0, 0.0]]
    ))
    n = len(A)
    names = found(lti(
        E=E.tolist(), A=A.tolist(), C=C.tolist(), states=[f"x{k}" for k in range(n)],
        outputs=[f"y{k}" for k in range(copies)], initial_state=n * [0],
    ))
    if copies == 1:
        smallest = [np.linalg.svd(np.exp(2j * np.pi * k / 3.0) * E - A)[1][-1] for k in range(3)]
    else:
        smallest = [1.0 / np.linalg.norm(np.linalg.inv(sign * E - A)) for sign in (1.0, -1.0)]
    told = names["Regularity"].evidence["largest_smallest_singular_value"]
    assert told == pytest.approx(max(smallest) / np.linalg.norm(A))
    assert names["Rank condition D2"].evidence == dict.fromkeys(("rank", "needed"), 3 * copies)


@pytest.mark.parametrize("C", [[1, 0, 0], [0, 1, 1]])
def test_the_rank_condition_has_the_rank_of_its_matrix(C):
    E, A = np.diag([1, 1, 0]), np.array([[-1, 0, 0], [0, 0, 1], [1, -1, 0]])
    whole = np.block([[E, A], [np.zeros(3), np.array(C)], [np.zeros((3, 3)), E]])
    told = found(lti(
        states=["a", "b", "c"], E=E.tolist(), A=A.tolist(), C=[C], initial_state=[1, 1, 0],
    ), form="given")["Rank condition D2"]
    assert told.evidence == {"rank": np.linalg.matrix_rank(whole), "needed": 2 + 3}


@pytest.mark.parametrize(("observer", "told"), [
    ({"name": "gpebo"}, False), ({"name": "gpebo", "form": "given"}, True),
    ({"name": "kalman_bucy"}, False), ({"name": "none"}, False),
])
def test_the_rank_condition_is_that_of_the_form_as_given(observer, told):
    """0 = a − b, b' = c: no output sees c, which the strangeness-free form has from b' = a'."""
    blind = lti(
        states=["a", "b", "c"], E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        A=[[-1, 0, 0], [0, 0, 1], [1, -1, 0]], C=[[1, 0, 0]], initial_state=[1, 1, 0],
    )
    failed = [name for name, a in found(blind, **observer).items() if not a.holds]
    assert failed == ["Rank condition D2", "Assumption 1"] * told


def test_the_pencil_is_judged_in_no_units():
    """Equations times 1e-12 and 1e9, v in units of 1e-15, the output in units of 1e14, t in ns."""
    plain = found(lti())
    other = found(lti(E=[[1e-21, 0], [0, 0]], A=[[-1e-12, 1e-27], [1e9, 1e-6]], C=[[1e-14, 0]],
                      initial_state=[1, -1e15]))
    for name in ("Regularity", "Rank condition D2"):
        assert other[name].holds
        for key, value in plain[name].evidence.items():
            assert other[name].evidence[key] == pytest.approx(value, rel=0.3)


def test_without_an_observer_there_are_the_assumptions_of_the_simulation():
    names = found(lti(), name="none")
    assert list(names) == ["Solvability", "Consistent start", "Regularity", "Rank condition D2"]
    kept = found(lti(C=[], outputs=[]), name="none")
    assert list(kept) == ["Solvability", "Consistent start"]


def test_an_unsolvable_plant_stops_at_the_first_assumption():
    names = found(lti(E=[[1, 0], [0, 0]], A=[[-1, 1], [0, 0]]))
    assert list(names) == ["Solvability"]
    assert not names["Solvability"].holds
    assert "not uniquely solvable" in names["Solvability"].evidence["found"]


def test_growth_of_the_fundamental_matrix_is_reported():
    names = found(plant_from_mapping(one_state(A=[[1]])))
    assert names["Growth of Φ"].evidence["largest_entry"] == pytest.approx(np.exp(20), rel=1e-9)
    assert names["Growth of Φ"].evidence["rate"] == pytest.approx(1.0, rel=1e-9)
    assert not names["Growth of Φ"].holds
    assert names["Regularity"].holds, "though λ = 1, which is tried, is an eigenvalue"
    (warning,) = run(one_state(A=[[1]]), observer={"form": "given"}).details.warnings
    assert warning.startswith(
        "Φ has grown to 4.9e+08, at 1 1/s: of its 16 digits the state estimate loses 9; a remedy"
    )
    assert "of observer=gpebo in continuous time is needed" in warning
    assert "strangeness_free" not in warning, "no output is fed back where E is regular"
    falls = plant_from_mapping(one_state(A=[[-1]]))
    equal = found(plant_from_mapping(one_state(
        states=["a", "b", "c"], E=np.diag([1, 1, 0]).tolist(), C=[[1, 0, 0]],
        A=[[-1, 0, 0], [0, 0, 1], [1, -1, 0]], initial_state=[1, 1, 0],
    )), form="strangeness_free")
    exact = np.sqrt(0.5)  # that of (1, 1)/√2, and it falls
    assert equal["Growth of Φ"].evidence["largest_entry"] == pytest.approx(exact, rel=1e-9)
    # Of λ at roots of one that of λ + 1 which is largest, at λ = 1.
    assert found(falls)["Regularity"].evidence["largest_smallest_singular_value"] == 2.0
    assert found(falls)["Growth of Φ"].evidence["rate"] == pytest.approx(-1.0, rel=1e-9)
    short = run(falls, observer={"name": "gpebo", "sample_time": 0.1}, time={"horizon": 0.5})
    (at_samples,) = [each for each in short.details.assumptions if each.name == "Growth of Φ"]
    assert at_samples.evidence["rate"] == pytest.approx(-1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("words", "code", "last"),
    [
        (["plant=circuit"], 0, "everything that is needed holds"),
        (["plant=circuit", "observer.regression=paper"], 1, "Assumption 2 failed"),
        (["plant=canonical", "observer.form=given"], 1, "Assumption 1 failed"),
    ],
)
def test_gpebo(words, code, last, tmp_path):
    done = gpebo("check", *words, cwd=tmp_path)
    assert done.returncode == code
    assert done.stdout.splitlines()[-1] == last
    assert not any(tmp_path.iterdir())  # a check leaves nothing behind


def test_command_as_json(tmp_path):
    said = printed(gpebo("check", "plant=canonical", "observer=canonical", "--json", cwd=tmp_path))
    answer = json.loads(said)
    assert answer["holds"] is True
    assert {"name", "statement", "holds", "evidence"} == set(answer["assumptions"][0])


def test_nothing_to_estimate_is_exciting_and_gives_the_states():
    """Hidden constraints alone determine the state: x = 0, v = −u (strangeness-free, d = 0)."""
    names = found(lti(A=[[-1, 1], [1, 0]]))
    assert names["Assumption 1"].holds
    assert names["Assumption 2"].holds
    for estimator in ("ls_drem", "drem", "gradient"):
        details = run(lti(A=[[-1, 1], [1, 0]]), estimator=estimator).details
        assert details.verdict.startswith("interval-exciting from t = 0 s on (")
        assert details.excitation.determined is None  # there are no parameters
        assert details.simulation.states.shape == details.estimation.states[0].shape
        np.testing.assert_allclose(
            details.estimation.states[0], details.simulation.states, atol=1e-12
        )


@pytest.mark.parametrize("growth", [None, 1e20])  # at a rate that nobody says
@pytest.mark.parametrize(("error", "count"), [(1e-9, 0), (2.0, 1)])
def test_an_observer_that_its_own_errors_spoil_says_so(error, count, growth):
    """An estimate of the error is never larger than the signals without a word."""
    class Spoilt:
        assumptions, growth_rate, error_estimate = (), None, error

    Spoilt.growth = growth

    assert len(warnings(Spoilt())) == count
    assert all("2.0e+00 of their size" in line for line in warnings(Spoilt()))


def test_an_impulse_ends_the_check_by_its_name():
    """v = x' and x = u, which jumps."""
    system = lti(
        A=[[0, 1], [1, 0]], inputs={"u": "step(t - 1)"}, B=[[0], [-1]], initial_state=[0, 0]
    )
    names = found(system)
    assert not names["No impulses"].holds
    assert list(names)[-1] == "No impulses"


def test_what_is_zero_but_for_rounding_does_not_jump():
    """x3 follows x1 + x2, and x4 = x1 + x2 − x3."""
    decay = np.diag([-1, -1, -1, -1])
    decay[3, :3] = [1, 1, -1]
    system = lti(
        A=decay.tolist(), E=np.diag([1, 1, 1, 0]).tolist(), states=["x1", "x2", "x3", "x4"],
        inputs={"u": "step(t - 1)"}, B=[[1], [2], [3], [0]], C=[[1, 0, 0, 0]],
        initial_state=[100, 200, 300, 0],
    )
    simulated = run_experiment(Settings({}, observer={"name": "none"}), system).simulation
    assert simulated.jumps == ()
    assert 0.0 < np.abs(simulated.states[:, 3]).max() < 1e-9


@pytest.mark.parametrize("seen", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_a_state_that_no_equation_sees_is_none_in_other_coordinates_either(seed, seen):
    """E = P diag(I, 0) Q, and of the last state in Q x outputs see ``seen``, equations nothing."""
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
    A[3, 3], C[:, 3] = 0.0, seen
    P, Q = rng.normal(size=(2, 4, 4))
    plant = {
        "name": "mixed", "states": ["x1", "x2", "x3", "x4"], "outputs": ["y1", "y2"],
        "E": (P @ np.diag([1.0, 1.0, 1.0, 0.0]) @ Q).tolist(), "A": (P @ A @ Q).tolist(),
        "C": (C @ Q).tolist(), "initial_state": [1, 0, 0, 0],
    }
    settings = Settings(
        estimator={}, observer={"name": "gpebo", "form": "given"}, time=TimeSettings(horizon=0.1)
    )
    names = {a.name: a for a in examine(settings, plant_from_mapping(plant, "mixed")).assumptions}
    assert names["Assumption 1"].holds == bool(seen)


def test_of_a_recording_what_the_observer_needs_is_named_and_without_one_there_is_nothing():
    """z' (t − 1/2) = −z: in the middle E has no rank."""
    t = np.linspace(0.0, 1.0, 21)
    plant = one_state(states=["x", "z"], E=[[1, 0], [0, "t - 1/2"]], A=[[-1, 0], [0, -1]],
                      C=[[1, 1]], initial_state=[1, 0])
    data = {"t": t, "y": np.exp(-t)}
    (failed,) = check(plant, data=data)
    assert (failed.name, failed.holds) == ("Rank of E", False)
    assert "from 2 at t = 0 to 1 at t = 0.5" in failed.evidence["found"]
    assert check(plant, data=data, observer="none") == ()


def test_where_the_form_is_free_the_other_one_is_told_beside_equations_as_given():
    one, other = (
        next(a.evidence for a in check("descriptor", observer={"form": form})
             if a.name == "Assumption 1") for form in ("auto", "strangeness_free")
    )
    value = other["smallest_singular_value"]
    assert one["strangeness_free"] == f"holds, too, with singular value {value:.4g}"


def evidence(plant, **time):
    """By names of assumptions, after a run with five samples."""
    details = run(plant, time={"samples": 5, **time}).details
    return {a.name: a.evidence for a in details.assumptions}


def test_the_evidence_of_a_state_that_decays_is_in_closed_form():
    """ψ = e^(2 − t) from t = 2 on, for one second."""
    found = evidence(one_state(A=[[-1]]), start=2.0, horizon=1.0)
    one = {"strangeness_index": 0, "index": 0, "d": 1, "a": 0, "smallest_singular_value": 1.0}
    assert found["Solvability"] == {**one, "bounded_between_nodes": True}
    assert found["Consistent start"] == {"largest_change": 0.0}
    assert found["Rank of E"] == {"rank": 1, "states": 1}
    # Nothing is algebraic: what is told of the start is told of all times.
    assert found["Assumption 1"] == {
        "smallest_singular_value": np.inf, "at": 2.0, "form": "given"}
    assert found["Assumption 2"] == {
        "psi_depends_on": "time alone", "t_c": 2.0, "weakest_direction": "+1 e0_x",
        "normalised_min": pytest.approx(1.0), "condition": pytest.approx(1.0),
        "lambda_min": pytest.approx((1.0 - np.exp(-2.0)) / 2.0, rel=1e-9),
    }
    assert found["Growth of Φ"] == {"largest_entry": 1.0, "rate": pytest.approx(-1.0)}


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e-4])
def test_the_evidence_of_an_algebraic_state_is_in_closed_form(unit):
    """x' = −x, 0 = x − z, y = x, v = c z with c = 1 + (t − 1)²: z is seen least at t = 1."""
    found = evidence(one_state(
        states=["x", "z"], E=[[1, 0], [0, 0]], A=[[-1, 0], [1, -1]], outputs=["y", "v"],
        C=[[1, 0], [0, f"{unit}*(1 + (t - 1)**2)"]], initial_state=[1, 5],
    ), horizon=2.0)
    assert found["Solvability"]["index"] == found["Solvability"]["a"] == 1
    assert found["Consistent start"] == {"largest_change": pytest.approx(4.0)}
    assert found["Rank of E"] == {"rank": 1, "states": 2}
    # (−1, 0, c) is what the kernel of E has in [[1, −1], [1, 0], [0, c]].
    assert found["Assumption 1"] == {
        "smallest_singular_value": pytest.approx(np.sqrt(2.0 / 4.0), rel=1e-9),
        "at": pytest.approx(1.0), "form": "given",
    }

    def square(t):
        """Of what (1, 1, 0) e^−t has at right angles to that."""
        return np.exp(-2.0 * t) * (2.0 - 1.0 / (1.0 + (1.0 + (t - 1.0) ** 2) ** 2))

    of_psi = found["Assumption 2"]["lambda_min"]
    assert of_psi == pytest.approx(quad(square, 0.0, 2.0, epsabs=1e-12)[0], rel=1e-9)
    assert found["Growth of Φ"] == {"largest_entry": 1.0, "rate": pytest.approx(-1.0)}
