"""Propositions 3 and 4: the canonical-form observer."""

from __future__ import annotations

import numpy as np
import pytest
from plants import experiment, observed, one_state, reference, shipped
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from units import Units, in_units

import gpebo_cli
from gpebo_cli.configs import files
from gpebo_cli.errors import ConfigError, ModelError
from gpebo_cli.model.plant import plant_from_mapping
from gpebo_cli.observers.canonical import (
    canonical_blocks,
    remark_4_gain,
    unknown_input_matrices,
)
from gpebo_cli.settings import SolverSettings

SOLVER = SolverSettings()


LS_DREM = {"name": "ls_drem", "gamma": 100.0, "f0": 1e-6}


def run(system, estimator=LS_DREM, samples=2001, **observer):
    return experiment(system, estimator, samples=samples, name="canonical", **observer)


def test_za_is_recovered():
    result = run(shipped("canonical"))
    truth = result.simulation.states[:, :2]
    error = np.abs(result.estimation.states[0, :, :2] - truth)
    assert error[-1].max() < 1e-10
    assert result.metrics.final_error_parameters[0] < 1e-6


def test_zw_error_decays_as_the_reference_says():
    """From the time z_a is known on, the error of ẑ_w follows the reference's decay."""
    system = shipped("canonical")
    result = run(system)
    t = result.simulation.t
    error = result.estimation.states[0, :, 2:4] - result.simulation.states[:, 2:4]
    rows = reference("canonical")["at"]
    decay = {row["t"]: np.array(row["unknown_input_observer_error_over_initial_error"])
             for row in rows}
    at = {when: error[int(np.argmin(np.abs(t - when)))] for when in decay}
    for when in (10.0, 15.0, 20.0):
        np.testing.assert_allclose(at[when] / at[5.0], decay[when] / decay[5.0], rtol=2e-3)


def test_zw_error_with_za_known_matches_the_reference_at_every_time():
    """With ξ_a(0) = z_a(0) there is nothing to estimate in z_a: the decay is the reference's."""
    system = shipped("canonical")
    result = run(system, xi_a0={"za1": 1.0}, r0=[1.0, 3.0])
    t = result.simulation.t
    error = result.estimation.states[0, :, 2:4] - result.simulation.states[:, 2:4]
    for row in reference("canonical")["at"]:
        k = int(np.argmin(np.abs(t - row["t"])))
        expected = row["unknown_input_observer_error_over_initial_error"]
        np.testing.assert_allclose(error[k] / error[0], expected, atol=1e-8)


def test_algebraic_zb_is_exact_once_za_is():
    result = run(shipped("canonical"))
    checks = result.estimation.checks
    truth = result.simulation.states
    late = result.simulation.t > 5
    np.testing.assert_allclose(checks["zb1_algebraic"][0], truth[:, 2], atol=1e-9)
    np.testing.assert_allclose(checks["zb2_algebraic"][0, late], truth[late, 3], atol=1e-9)


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (1, 1, -1)])
def test_zb3_is_not_invented_and_evidence_has_no_sign(signs):
    """Signs of z_b1, z_b2 and the outputs are anybody's choice: so are those of N21, c1 and c2."""
    first, second, outputs = signs
    states, one = np.array([1, 1, first, second, 1]), np.ones
    system = plant_from_mapping(in_units(files.shipped("plant/canonical"), Units(
        states, one(0), one(4), np.full(2, outputs), states, 1.0)))
    result = run(system, samples=11)
    found = {a.name: a.evidence for a in result.assumptions}
    assert found["Assumption 4"]["smallest"] == pytest.approx(0.7, rel=1e-3)  # of N21
    of_c = [found["Assumption 6"][name] for name in ("smallest_c1", "smallest_c2")]
    assert of_c == pytest.approx([0.7, 1.5], rel=1e-3)
    assert found["Assumption 6"]["output"] == "y2"
    # ∫−a1 c1/c2 dt by scipy; the diagonal gain adds ln(c1/c2) to the second.
    integrals = [found["Assumption 7"][name] for name in ("integral_M11", "integral_M22")]
    assert integrals == pytest.approx([-11.166597, -11.519049], rel=1e-6)
    assert found["Assumption 7"]["transition_norm"] == pytest.approx(np.exp(integrals[0]), rel=1e-4)
    assert all(a.holds for a in result.assumptions)
    assert np.isnan(result.estimation.states[..., 4]).all()
    assert np.isfinite(result.metrics.final_error_states).all()


def test_the_output_that_is_asked_for_is_the_one_of_zw():
    """The third one sees z_b1 and z_b2 three times as well as the second, which comes first."""
    system = shipped("canonical", outputs=["y1", "y2", "y3"], C=[
        [1, 0, 0, 0, 0], [0.5, 0, "c1", "c2", 0], [0, 0, "3*c1", "-3*c2", 0],
    ])
    found = [
        {a.name: a.evidence for a in run(system, samples=11, **asked).assumptions}["Assumption 6"]
        for asked in ({}, {"output": "y2"}, {"output": "y3"})
    ]
    assert [each["output"] for each in found] == ["y2", "y2", "y3"]
    for name in ("smallest_c1", "smallest_c2"):
        assert found[2][name] == pytest.approx(3.0 * found[0][name], rel=1e-12)


@pytest.mark.parametrize("sign", ["", "-"])
@pytest.mark.parametrize(
    ("sees", "known"), [("(2 + sin(t))", True), ("cos(t)", False), ("step(t - 1)", False)]
)
def test_zb3_is_estimated_where_an_output_sees_it_at_every_time(sign, sees, known):
    system = shipped(
        "canonical", outputs=["y1", "y2", "y3"],
        C=[[0, 1, 0, 0, sign + sees], [1, 0, 0, 0, 0], [0.5, 0, f"{sign}c1", f"{sign}c2", 0]],
    )
    result = run(system)
    error = result.estimation.states[0, -1] - result.simulation.states[-1]
    assert np.isfinite(error).tolist() == [True] * 4 + [known]
    assert np.nanmax(np.abs(error)) < 1e-4  # limited by ẑ_w, which decays with M_w


def test_all_suitable_outputs_are_stacked():
    system = shipped(
        "canonical", outputs=["y1", "y2", "y3"],
        C=[[1, 0, 0, 0, 0], [0.5, 0, "c1", "c2", 0], [0, "cos(t)", 0, 0, 0]],
    )
    _, observation = observed(system, name="canonical")
    assert observation.regression.psi.values.shape[2] == 2
    assert observation.regression.parameters == ("e0_za1", "e0_za2")


def test_regression_identity_with_unknown_parameters():
    """Proposition 2: strangeness-free canonical form with θ."""
    system = shipped("strangeness_free", C=[[1, 0, 0, 0]])
    result = run(system)
    regression = result.regression
    residual = regression.Y - regression.psi @ result.estimation.true_parameters[0]
    assert np.abs(residual).max() < 1e-9
    assert result.metrics.final_error_parameters[0] < 1e-6


def test_strangeness_free_with_the_general_observer():
    result = experiment(shipped("strangeness_free"), LS_DREM)
    assert result.simulation.strangeness_index == 0
    assert result.excitation.is_ie
    assert result.metrics.final_error_parameters[0] < 1e-6
    assert result.metrics.final_error_states[0] < 1e-6


@pytest.mark.parametrize("L_w", ["diagonal", ["1 + 0.1*sin(t)", "0.5"]])
def test_any_gain_gives_the_same_limit(L_w):
    result = run(shipped("canonical"), L_w=L_w)
    error = result.estimation.states[0, -1, 2:4] - result.simulation.states[-1, 2:4]
    decays = {a.name: a for a in result.assumptions}["Assumption 7"]
    assert decays.holds
    assert np.abs(error).max() < 10 * decays.evidence["transition_norm"] + 1e-9


def test_the_integrals_of_a_diagonal_M_differ_by_what_c1_and_c2_do():
    """M_w = diag(−a1 c1/c2, −a1 c1/c2 + d/dt ln(c1/c2)): they were good to 6 digits."""
    system = shipped("canonical")
    seen = {a.name: a.evidence for a in run(system).assumptions}["Assumption 7"]
    C = system.coefficients.taylor(np.array([0.0, 20.0]), 0).C[0]
    change = np.log(C[1, 1, 2] / C[1, 1, 3]) - np.log(C[0, 1, 2] / C[0, 1, 3])
    assert seen["integral_M22"] - seen["integral_M11"] == pytest.approx(change, rel=1e-10)


def test_an_entry_that_is_rounding_shows_no_state():
    """Beside 1 it is nothing; divided by it a state would be any number."""
    mapping = {"N21": 1, "N31": 0.5, "N32": -0.75, "c1": 1, "c2": 2}
    A = np.diag([0.05, -0.5, 1.0, 1.0, 1.0]).tolist()
    found = [
        run(shipped("canonical", parameters=mapping, A=A, outputs=["y0", "y1", "y2"], C=[
            [1, 0, 0, 0, tiny], [1, 1, 0, 0, 0], [0.5, 0, "c1", "c2", 0],
        ])).estimation.states for tiny in (0, 1e-15)
    ]
    np.testing.assert_allclose(*found, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("N32", [-0.75, 0, -1e-15])
def test_remark_4_gain_for_constant_coefficients(N32):
    """a1 c1/c2 > 0 and constant: Remark 4's L_w gives a stable M_w, and all evidence is closed."""
    mapping = {"N21": -1, "N31": -0.5, "N32": N32, "c1": -1, "c2": 2}
    A = np.diag([0.05, -0.5, 1.0, 1.0, 1.0]).tolist()
    C = [[0, 0, 0, 0, 0], [1, 1, 0, 0, 0], [0.5, 0, "c1", "c2", 0]]
    system = shipped("canonical", parameters=mapping, A=A, C=C, outputs=["none", "y1", "y2"])
    result = run(system, L_w="remark4")
    found = {a.name: a for a in result.assumptions}
    assert found["Assumption 3"].evidence["outputs"] == "y1"
    assert found["Assumption 4"].holds == (N32 == -0.75)
    assert found["Assumption 4"].evidence == {"smallest": abs(N32)}
    assert found["Growth of Φ"].evidence["rate"] == pytest.approx(0.05)
    seven = found["Assumption 7"]
    assert seven.holds
    assert seven.evidence["integral_M11"] == pytest.approx(-0.5 * 20)
    assert seven.evidence["integral_M22"] == pytest.approx(-2.5 * 20)
    decay = np.linalg.norm(expm([[-10, 0], [40, -50]]), 2)  # in units of c1 = −1 and c2 = 2
    assert seven.evidence["transition_norm"] == pytest.approx(decay, rel=1e-5)
    error = result.estimation.states[0, -1, 2:4] - result.simulation.states[-1, 2:4]
    assert np.abs(error).max() < 1e-3


def test_remark_4_gain_is_that_of_the_paper():
    """a1 c1 (c1/c2, 1) with a1 = 1/N21."""
    N = np.zeros((1, 3, 3))
    N[0, 1, 0] = 5.0
    np.testing.assert_allclose(remark_4_gain(np.array([[3.0, 2.0]]), N), [[0.9, 0.6]], rtol=1e-15)


@pytest.mark.parametrize("first", [1e-6, 1e6])
@pytest.mark.parametrize("second", [1e-5, 1.0, 1e5])
def test_units_of_zb_decide_no_assumption(first, second):
    """z_b1 and z_b2 in units that are decades apart from that of z_a, and from each other."""
    states, one = np.array([1, 1, first, first * second, first]), np.ones
    content = files.shipped("plant/canonical")
    found, plain = (
        run(plant_from_mapping(in_units(content, Units(by, one(0), one(4), one(2), by, 1.0))),
            samples=11, xi_a0={"za1": 1.0}, r0=[by[2], 3.0 * by[3]],
            L_w=[f"{by[2]} + 0.1*{by[2]}*sin(t)", f"0.5*{by[3]}"])
        for by in (states, one(5))
    )
    np.testing.assert_allclose(found.estimation.states[..., :4] / states[:4],
                               plain.estimation.states[..., :4], rtol=1e-7, atol=1e-9)
    norms = [{a.name: a for a in each.assumptions}["Assumption 7"].evidence["transition_norm"]
             for each in (found, plain)]
    assert norms[0] == pytest.approx(norms[1], rel=1e-4)
    assert [a.holds for a in found.assumptions] == [a.holds for a in plain.assumptions]


def test_zb_follows_an_estimate_that_is_steep_at_the_start():
    """ẑ_a − z_a = e₀ f₀/(f₀ + t) of least squares, and what eq. 22 makes of it, by scipy."""
    f0 = 1e-3
    system = shipped(
        "canonical", inputs={"u": 0}, B=[[0]] * 5, parameters={}, outputs=["y1", "y2", "y3"],
        E=np.diag([1, 1, 0, 0, 0]) + np.eye(5, k=-1) * [0, 0, 1, 1, 0], A=np.diag([0, 0, 1, 1, 1]),
        C=[[1, 0, 0, 0, 0], [1, 0, 1, 1, 0], [0, 1, 0, 0, 0]], initial_state=[1, 0, 0, 0, 0],
    )
    result = run(system, {"name": "least_squares", "f0": f0}, samples=21)
    t = result.simulation.t
    exact = solve_ivp(
        lambda t, r: [-r[0] + f0 / (f0 + t), -r[1] - f0 / (f0 + t)], (0.0, t[-1]), [0.0, 0.0],
        "DOP853", t, rtol=1e-11, atol=1e-14,
    ).y[0]
    np.testing.assert_allclose(result.estimation.states[0, 1:, 2], exact[1:], rtol=1e-8)


def test_matrices_against_their_definition():
    """M_w = [I − G c⊤] A_w − L c⊤ − G ċ⊤ and the rest, straight from the paper's (sysobs)."""
    rng = np.random.default_rng(3)
    c, dc, L, f_b = (rng.uniform(0.5, 2, (5, k)) for k in (2, 2, 2, 3))
    N = np.zeros((5, 3, 3))
    N[:, 1, 0], N[:, 2, 0], N[:, 2, 1] = rng.uniform(0.5, 2, (3, 5))
    M, from_y, forcing = unknown_input_matrices(c, dc, N, f_b, L)
    for k in range(5):
        a1, a2 = 1 / N[k, 1, 0], -N[k, 2, 0] / (N[k, 2, 1] * N[k, 1, 0])
        A_w = np.array([[0, a1], [0, a2]])
        G, dG = np.array([0, 1 / c[k, 1]]), np.array([0, -dc[k, 1] / c[k, 1] ** 2])
        keep = np.eye(2) - np.outer(G, c[k])
        M_w = keep @ A_w - np.outer(L[k], c[k]) - np.outer(G, dc[k])
        np.testing.assert_allclose(M[k], M_w, atol=1e-12)
        np.testing.assert_allclose(from_y[k], M_w @ G + L[k] - dG, atol=1e-12)
        d_w = np.array([
            f_b[k, 1] / N[k, 1, 0],
            f_b[k, 2] / N[k, 2, 1] - N[k, 2, 0] * f_b[k, 1] / (N[k, 2, 1] * N[k, 1, 0]),
        ])
        np.testing.assert_allclose(forcing[k], keep @ d_w, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "settings", "error", "message"),
    [
        ({"C": [[1, 0, 0, 0, 1], [0.5, 0, "c1", "c2", 0]]}, {}, ModelError, "Assumption 3 fails"),
        ({"C": [[1, 0, 0, 0, 0], [0.5, 0, 0, "c2", 0]]}, {}, ModelError, "Assumption 6 fails"),
        *(
            ({"C": [[1, 0, 0, 0, 0], [0.5, 0, *row]]}, {}, ModelError, "Assumption 6 fails: no")
            for row in (["c1", "c2", "sin(t)"], ["c1", "c2", -0.1], ["c1", "cos(t)", 0],
                        ["cos(t)", "c2", 0], [1e-13, "c2", 0])
        ),
        *((
            {"A": (np.diag([-1.0, -2, 1, 1, 1]) + entry * np.eye(5, k=-2)).tolist()}, {},
            ModelError, rf"A\[2\]\[0\] is {entry} at t = 0 instead of 0",
        ) for entry in (0.2, -0.2)),
        (
            {"E": [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, -2, 0], [0, 0, "N21", 0, 0],
                   [0, 0, "N31", 0, 0]]}, {},
            ModelError, r"E\[2\]\[3\] is -2 at t = 0 instead of 0 .* here n_a = 2\)",
        ),
        (
            {"unknowns": {"a": 1}, "F": [[0], [0], [0], [-1], [0]]}, {},
            ModelError, "takes unknown parameters in the equations of z_a only",
        ),
        ({}, {"output": "y1"}, ModelError, "Assumption 6 fails: output y1"),
        ({}, {"output": "y9"}, ConfigError, "'y9' is not an output"),
        ({}, {"L_w": ["t", "x"]}, ConfigError, r"observer.L_w\[1\]"),
        ({}, {"L_w": ["t"]}, ConfigError, r"observer.L_w: got \['t'\]; accepted: diagonal"),
        ({}, {"L_w": "ab"}, ConfigError, "observer.L_w: got 'ab'; accepted: diagonal"),
        ({}, {"r0": [1.0]}, ConfigError, "two finite numbers"),
    ],
)
def test_what_does_not_fit_is_named(changes, settings, error, message):
    with pytest.raises(error, match=message):
        run(shipped("canonical", **changes), **settings)


def test_a_plant_that_is_not_canonical_is_refused_by_entry():
    with pytest.raises(ModelError, match=r"canonical form: E\[0\]\[0\] is 4 at t = 0 .* n_a = 0"):
        run(shipped("circuit"))
    rows = [[0, 1, 0, 0, 0], [-2, -0.5, 0, 0, 0], [0, 0, 1, 0, "0.7*step(t - 3)"],
            [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]
    t = np.array([0.0, 2.0, 3.0, 4.0])
    said = r"A\[2\]\[4\] is 0\.7 at t = 3 instead of 0 \(E .* diag\(A_a, I\), here n_a = 2\)"
    with pytest.raises(ModelError, match=said):
        canonical_blocks(shipped("canonical", A=rows), t, t)


def test_a_plant_without_zb_is_canonical():
    """ż = −0.5 z + u, y = z."""
    system = plant_from_mapping(one_state(A=[[-0.5]]))
    assert canonical_blocks(system, np.zeros(1), np.zeros(1)).n_a == 1
    states = run(system).estimation.states[0, -1]
    assert states == pytest.approx(run(system).simulation.states[-1], abs=1e-8)


def test_a_recording_is_explained_by_the_evidence_alone():
    """ẑ_b moves by a law of its own, and has no output at the samples that a fit could look at."""
    time = {"horizon": 2.0, "samples": 61}
    made = gpebo_cli.run("canonical", observer="canonical", estimator="ls_drem", time=time)
    data = {"t": made.t, **made.inputs, **made.outputs}
    found = gpebo_cli.run(
        "canonical", observer="canonical", estimator="ls_drem", time={"samples": 11},
        data={"frame": data, "hold": "cubic"},
    )
    fit = found.details.fit
    assert (fit.outputs, fit.white) == (None, None)
    assert fit.residual[0] < 1e-4 * fit.size
    name = made.details.estimation.names[0]
    assert found.parameters[name] == pytest.approx(made.parameters[name], rel=1e-3)
