"""Plants from netlists, mechanics and matrices, against other derivations of the same equations."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import zipfile
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
import yaml
from examples import assert_repeats, blocks, gpebo, python
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plants import one_state
from processes import assert_refused, printed, refused
from scipy import sparse
from scipy.integrate import solve_ivp
from scipy.io import loadmat, mmwrite, savemat
from scipy.linalg import eigh, expm, null_space

from gpebo_cli import ConfigError, load_plant, run
from gpebo_cli.api.choice import plain
from gpebo_cli.cli.listing import described
from gpebo_cli.importers import from_control, from_file, from_matrices, from_mechanics, from_netlist
from gpebo_cli.importers.circuit import circuit_from_netlist
from gpebo_cli.importers.matrices import _identifiers
from gpebo_cli.importers.mechanics import linearise
from gpebo_cli.importers.netlist import number, read_netlist
from gpebo_cli.model.archive import read_mat
from gpebo_cli.model.expressions.syntax import parse
from gpebo_cli.model.plant import plant_from_mapping

PAPER = """electrical circuit of the paper
C1 e1 0 {3+cos(time/3)} ic=0
C2 e2 0 {2-cos(2*time)} ic=1
L e2 0 {2-exp(-time)} ic=2
R1 e2 e1 {4+2*sin(time)}
R2 e1 0 {-(2+sin(time))}
V 0 e1 {4*cos(2*time)*sin(time/5)}
.save i(R1) i(R2)
"""


def plant_of(text, **options):
    draft = from_netlist(text, "test", **options)
    plant = draft.mapping()
    assert yaml.safe_load(draft.to_yaml()) == plain(plant)  # the file says the same as the data
    return plant


def simulated(plant, horizon=10.0):
    return run(plant, observer="none", time={"horizon": horizon})


@pytest.mark.parametrize("title", [
    "John's: a \"filter\"", "null", "'quoted'", 'a "b" \\ c', "12", "yes", "- a # b", "$ {HOME}: x",
])
def test_a_title_of_a_netlist_is_that_of_the_plant_and_of_its_line_in_a_list(title, tmp_path):
    draft = from_netlist(f"{title.replace('$ ', '$')}\nR1 a 0 1\nC1 a 0 1\n", "p")
    path = tmp_path / "p.yaml"
    path.write_text(draft.to_yaml())
    assert load_plant(path).title == described(path)[0] == title


def test_what_is_read_is_run_as_it_is():
    draft = from_netlist(PAPER, "test", measure="v(e1), i(L)")
    found = run(draft, estimator="drem", time={"horizon": 2, "samples": 5})
    expected = run(draft.mapping(), estimator="drem", time={"horizon": 2, "samples": 5})
    for name in draft.states:
        np.testing.assert_array_equal(found.estimates[name], expected.estimates[name])
    assert load_plant(draft).states == tuple(draft.states)


@given(order=st.permutations(PAPER.splitlines()[1:]))
@settings(max_examples=5, deadline=None)
@example(order=PAPER.splitlines()[1:])
def test_the_papers_circuit(order):
    """To the last bit of every table, in whatever order the elements stand."""
    text = "\n".join(["electrical circuit of the paper", *order, ""])
    plant = plant_of(text, measure="y=i(L)+i(V)")
    plant["observer_defaults"] = {"xi_a0": {"e1": 1, "e2": 0, "il": 0}}
    ours, shipped = run(plant, estimator="drem"), run("circuit", estimator="drem")
    assert ours.details.simulation.index == shipped.details.simulation.index == 2
    topology, coupled = (
        circuit_from_netlist(each, "c").comments[-1] for each in (text, NETLISTS["coupled"][0])
    )
    assert "index 2 by topology" in topology
    more = "controlled sources and couplings may change it"
    assert (more in topology, more in coupled) == (False, True)
    for table in ("signals", "regression", "excitation", "estimates", "cases"):
        assert ours.to_pandas(table).equals(shipped.to_pandas(table)), table


def test_one_pair_of_a_time_and_a_value_is_a_constant():
    assert plant_of("one\nV1 a 0 PWL(0 2)\nR1 a 0 1\n")["inputs"] == {"V1": "2.0"}


NETLISTS = {  # name: (netlist, what is measured, index)
    "rc": ("rc\nV1 in 0 SIN(0 1 0.5)\nR1 in out 2\nC1 out 0 0.5 ic=0.3\n", "v(out)", 1),
    "rlc": (
        ("rlc\nV1 in 0 PWL(0 0 1 1 3 -1 5 0)\nR1 in a 1\nL1 a b 0.7 ic=0.2\nC1 b 0 0.4 ic=0\n"
        "R2 b 0 5\n"), "v(b),i(L1)", 1,
    ),
    "coupled": (
        "coils\nV1 in 0 SIN(0 1 0.3)\nR1 in a 1\nL1 a 0 1\nL2 b 0 2\nK1 L1 L2 0.8\nR2 b 0 3\n",
        "v(b)", 1,
    ),
    "controlled voltage": (
        ("e and g\nV1 in 0 SIN(0 1 0.2)\nR1 in a 1\nC1 a 0 1 ic=0\nE1 b 0 a 0 3\nR2 b c 2\n"
        "C2 c 0 0.5 ic=0\nG1 d 0 c 0 0.7\nR3 d 0 2\nC3 d 0 1 ic=0\n"), "v(c),v(d)", 1,
    ),
    "controlled by current": (
        ("f and h\nV1 in 0 SIN(0 1 0.2)\nR1 in a 1\nVs a b 0\nC1 b 0 1 ic=0\nF1 c 0 Vs 2\n"
        "R2 c 0 1\nC2 c 0 1 ic=0\nH1 d 0 Vs 1.5\nR3 d e 1\nC3 e 0 1 ic=0\n"), "v(c),v(e)", 1,
    ),
    "subcircuits": (
        ("sub\n.param rr=2\n.subckt filt in out PARAMS: r=1 c=1\nR1 in out {r*rr}\nC1 out 0 {c}\n"
        ".ic v(out)=0.4\n.ends\nV1 in 0 SIN(0 1 0.3)\nX1 in m filt r=0.5\n"
        "X2 m o filt c=0.3\n"), "v(o)", 1,
    ),
    "bridge": (
        ("bridge\nI1 0 a SIN(0 1 0.25)\nR1 a b 1\nR2 a c 2\nC1 b 0 1 ic=0\nC2 c 0 500m ic=0\n"
        "R3 b c 3\n"), "v(b),v(c)", 1,
    ),
    "pulse": (
        "pulse\nV1 a 0 PULSE(0 2 1 0.5 0.25 2)\nR1 a b 1k\nC1 b 0 1m ic=0\n", "v(b)", 1,
    ),
    "damped sine": (
        "sin\nV1 a 0 SIN(0.5 1 0.4 1 0.2)\nR1 a b 1\nC1 b 0 1 ic=0\n", "v(b)", 1,
    ),
    "late sine that is damped at once": (
        "sin\nV1 a 0 SIN(0.5 1 0.4 4 200 30)\nR1 a b 1\nC1 b 0 1 ic=0\n", "v(b)", 1,
    ),
    "exp": ("exp\nI1 0 b EXP(0 1 1 0.5 4 2)\nR1 b 0 1\nC1 b 0 1 ic=0\n", "v(b)", 0),
    "cv loop": (
        "cv\nV1 a 0 SIN(0 1 0.3)\nC1 a b 1 ic=0\nC2 b 0 2 ic=0\nR1 b 0 1\n", "v(b),i(V1)", 2,
    ),
    "li cutset": (
        "li\nI1 0 a SIN(0 1 0.3)\nL1 a b 1\nR1 b 0 2\nC1 b 0 1 ic=0\n", "v(b),v(a)", 2,
    ),
    "two coils in a row": (
        "ll\nV1 in 0 SIN(0 1 0.3)\nR1 in a 1\nL1 a b 1\nL2 b c 2\nR2 c 0 1\n", "v(b),i(L1)", 2,
    ),
}


@pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is not installed")
@pytest.mark.parametrize("name", NETLISTS)
def test_against_ngspice(name, tmp_path):
    text, measure, index = NETLISTS[name]
    result = simulated(plant_of(text, measure=measure))
    assert result.details.simulation.index == index
    out = tmp_path / "out.txt"
    (tmp_path / "a.cir").write_text(
        f"{text}.options reltol=1e-9 abstol=1e-15 vntol=1e-12 chgtol=1e-18 method=gear maxord=6\n"
        f".control\ntran 1m 10 0 1m uic\nset wr_singlescale\noption numdgt=12\n"
        f"wrdata {out} {measure.replace(',', ' ')}\nquit\n.endc\n.end\n"
    )
    subprocess.run(["ngspice", "-b", "a.cir"], cwd=tmp_path, check=True, capture_output=True)
    theirs = np.loadtxt(out)
    late = result["t"] > 0.05  # the first steps of ngspice are of low order
    for k, output in enumerate(from_netlist(text, measure=measure).outputs, start=1):
        expected = np.interp(result["t"], theirs[:, 0], theirs[:, k])
        size = np.abs(expected).max()
        assert np.abs(result[output] - expected)[late].max() < 2e-4 * size, output


def ladder(cells, more=""):
    """Coils and resistors in a row, capacitors to ground, driven by a current."""
    lines, nodes = ["ladder", "I1 0 n0 1"], [f"n{k}" for k in range(cells + 1)]
    lines += [f"C{k} {node} 0 {1 + 0.1 * k:g} ic=0" for k, node in enumerate(nodes)]
    lines += [f"L{k} n{k} m{k} {0.5 + 0.05 * k:g}" for k in range(cells)]
    lines += [f"R{k} m{k} n{k + 1} {1 + 0.2 * k:g}" for k in range(cells)]
    return "\n".join([*lines, more, ""])


@pytest.mark.parametrize("cells", [3, 20, 36])
def test_a_ladder_of_coils_and_capacitors(cells):
    """Against the matrix exponential of its state equations, with currents first."""
    result = simulated(plant_of(ladder(cells), measure="v(n3)"), 5.0)
    C, L = 1 + 0.1 * np.arange(cells + 1), 0.5 + 0.05 * np.arange(cells)
    R, D = 1 + 0.2 * np.arange(cells), np.eye(cells, cells + 1) - np.eye(cells, cells + 1, 1)
    A = np.block([
        [-np.diag(R / L), D / L[:, None]], [-(D.T / C[:, None]), np.zeros((cells + 1, cells + 1))]
    ])
    b = np.zeros(2 * cells + 1)
    b[cells] = 1 / C[0]
    augmented = np.zeros((len(b) + 1, len(b) + 1))
    augmented[:-1, :-1], augmented[:-1, -1] = A, b
    expected = expm(5.0 * augmented)[cells + 3, -1]
    assert result["y_n3"][-1] == pytest.approx(expected, rel=1e-10)


# In these some state is nothing but rounding of the others, or integrates such a state.
@example([("C", 0, 1), ("R", 2, 1), ("R", 4, 2), ("V", 2, 4), ("C", 1, 4), ("I", 4, 1)])
@example([("C", 1, 4), ("C", 4, 0), ("C", 2, 4), ("C", 3, 0), ("I", 2, 4), ("L", 1, 0)])
@example([("R", 1, 2), ("C", 0, 1), ("V", 1, 2)])
@given(st.lists(
    st.tuples(st.sampled_from("RRRLCCVI"), st.integers(0, 4), st.integers(0, 4)),
    min_size=2, max_size=9,
))
@settings(max_examples=60, deadline=None)
def test_the_index_is_what_topology_says(branches):
    """Passive elements and independent sources: Estévez Schwarz and Tischendorf's theorem."""
    lines = ["random"]
    lines += [
        f"{kind}{k} {a} {b} {1 + 0.3 * k:g}" for k, (kind, a, b) in enumerate(branches) if a != b
    ]
    try:
        draft = circuit_from_netlist("\n".join(lines) + "\n", "random")
    except ConfigError:
        return
    index = simulated(draft.mapping(), 1.0).details.simulation.index
    topology = draft.comments[-1]
    assert topology.startswith("index 2 by topology" if index == 2 else "index 1 by topology")
    assert ("no loop of capacitors" in topology) == (index < 2)


def test_a_loop_of_many_capacitors_is_one():
    """V = v1 + v2 + v3 of capacitors in a row: i_V is C of all in series times V'."""
    text = "t\nV1 a 0 SIN(0 1 1)\nC1 a b 1\nC2 b c 2\nC3 c 0 2\nR1 b 0 1\nR2 c 0 1\n"
    said = circuit_from_netlist(text, "c").comments[-1]
    assert said == (
        "index 2 by topology (loop of capacitors and voltage sources: V1, C1, C2, C3)"
    )


def test_a_cutset_is_what_crosses_its_border():
    """Node a has inductors and a source alone; L3 and R1 do not touch it."""
    text = "t\nI1 0 a SIN(0 1 1)\nL1 a b 1\nL2 a c 1\nL3 b c 1\nR1 b 0 1\nR2 c 0 1\n"
    assert circuit_from_netlist(text, "c").comments[-1] == (
        "index 2 by topology (cutset of inductors and current sources: I1, L1, L2)"
    )


def test_names_that_are_there_twice():
    """Element, parameter and node of one name, and words of Python, stay apart."""
    same = "names\n.param r1=2 lambda={r1/2}\nv1 v1 0 1\nr1 v1 c1 {r1}\nc1 c1 0 {lambda}\n"
    other = "names\nVs a 0 1\nRs a b 2\nCs b 0 1\n"
    ours, theirs = (
        simulated(plant_of(text, measure=measure))
        for text, measure in ((same, "y=v(c1)"), (other, "y=v(b)"))
    )
    np.testing.assert_array_equal(ours["y"], theirs["y"])


def test_a_switch_at_given_instants():
    text = "switch\nV1 a 0 1\nS1 a b on=1 off=3 ron=1 roff=1meg\nC1 b 0 1 ic=0\nR1 b 0 1g\n"
    result = simulated(plant_of(text, measure="v(b),i(S1)"), 5.0)
    t, v, i = result["t"], result["y_b"], result["y_is1"]
    assert np.abs(v[t < 1]).max() < 2e-6
    closed = (t > 1) & (t < 3)
    np.testing.assert_allclose(i[closed], np.exp(-(t[closed] - 1)), atol=2e-6)
    np.testing.assert_allclose(i[(t < 1) | (t > 3)], 0.0, atol=2e-6)
    np.testing.assert_allclose(v[closed], 1 - np.exp(-(t[closed] - 1)), atol=2e-6)
    np.testing.assert_allclose(v[t > 3], 1 - np.exp(-2.0), atol=2e-6)


@pytest.mark.parametrize(("words", "closed"), [
    ("off=1,3 on=2", [True, False, True, False]), ("on=1,3 off=2", [False, True, False, True]),
])
def test_a_switch_is_closed_before_it_opens_first(words, closed):
    plant = plant_of(f"switch\nS1 a 0 {words} ron=2 roff=5\nC1 a 0 1\n")
    c = plant_from_mapping(plant).coefficients.taylor(np.array([0.5, 1.5, 2.5, 3.5]), 0)
    np.testing.assert_allclose(c.A[0, :, 0, 0], np.where(closed, -1 / 2, -1 / 5), rtol=1e-15)


def damped(t, since):
    """SPICE's sine of an amplitude of 2 V and 0.4 Hz about 0.5 V, from 30 degrees on."""
    wave = np.sin(0.8 * np.pi * (t - since).clip(0) + np.pi / 6)
    return 0.5 + 2 * wave * np.exp(-0.2 * (t - since).clip(0))


@pytest.mark.parametrize(("source", "expected"), [
    ("SIN(0.5 2 0.4)", lambda t: 0.5 + 2 * np.sin(0.8 * np.pi * t)),
    ("SIN(0.5 2 0.4 1 0.2 30)", lambda t: damped(t, 1)),
    ("SIN(0.5 2 0.4 0 0.2 30)", lambda t: damped(t, 0)),
    ("SIN(0.5 2 0.4 4 300)", lambda t: 0.5 + 2 * np.exp(-300 * (t - 4).clip(0))
     * np.sin(0.8 * np.pi * (t - 4).clip(0))),
    ("EXP(1 3 0.5 0.7 2 0.3)", lambda t: 1 + 2 * -np.expm1(-(t - 0.5).clip(0) / 0.7)
     - 2 * -np.expm1(-(t - 2).clip(0) / 0.3)),
    ("PWL(0.5 1 1 3 1 -1 2 4)", lambda t: np.interp(
        t, [0.5, 1, np.nextafter(1, 2), 2], [1, 3, -1, 4])),
    ("PULSE(0 1 0 0.5 0.5 0.5 1.5 2)", lambda t: np.interp(  # one right after the other
        t, [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0], [0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0])),
    ("PULSE(1 3 0.5 0.25 0.5 0.75 2 2)", lambda t: np.interp(
        t, [0.5, 0.75, 1.5, 2, 2.5, 2.75, 3.5, 4], [1, 3, 3, 1, 1, 3, 3, 1])),
    ("PULSE(0 2 1 0.5 0.25 2)", lambda t: np.interp(t, [1, 1.5, 3.5, 3.75], [0, 2, 2, 0])),
    ("DC 0 AC 1 SIN(0 1 1)", lambda t: np.sin(2 * np.pi * t)),
    ("AC {1} 0 DC 5", lambda t: 5 + 0 * t), ("AC '1*1' 0 DC '2*3'", lambda t: 6 + 0 * t),
    ("DC 2 AC 1", lambda t: 2 + 0 * t), ("", lambda t: 0 * t),
])
def test_sources_are_those_of_spice(source, expected):
    plant = plant_of(f"source\nV1 a 0 {source}\nR1 a 0 1\n")
    t = np.linspace(0.01, 4.99, 84)
    u = plant_from_mapping(plant).coefficients.taylor(t, 0).u[0, :, 0]
    np.testing.assert_allclose(u, expected(t), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("edge", [0.0, 1e-9, 1e-4])
def test_steep_edges_of_pulses_leave_all_digits(edge):
    """Some pulses are over at t = 0."""
    plant = plant_of(f"t\nV1 a 0 PULSE(1 6 -3m {edge} {edge} 0.3m 1m 9)\nR1 a 0 1\n")
    starts = 1e-3 * np.arange(6)
    for away, value in ((1.7e-4, 6), (7e-4, 1)):
        found = plant_from_mapping(plant).coefficients.taylor(starts + away, 0).u
        np.testing.assert_allclose(found.ravel(), value, rtol=1e-15)


def test_as_many_pulses_are_read_as_is_said():
    text = from_netlist("t\nV1 a 0 PULSE(0 1 0 1n 1n 0.3m 1m 1000)\nR1 a 0 1\n").inputs["V1"][0]
    assert parse(text, {}, "V1").text.count("step") == 6000


def test_coupled_coils_are_three_that_are_not():
    coils = "t\nV1 in 0 SIN(0 1 0.3)\nR1 in a 1\nR2 b 0 3\n"
    M = 0.5 * np.sqrt(2)
    pair = simulated(plant_of(f"{coils}L1 a 0 1\nL2 b 0 2\nK1 L1 L2 0.5\n", measure="y=v(b)"))
    tee = simulated(plant_of(
        f"{coils}L1 a m {1 - M}\nL2 b m {2 - M}\nL3 m 0 {M}\n", measure="y=v(b)"
    ))
    np.testing.assert_allclose(pair["y"], tee["y"], atol=1e-9)


@pytest.mark.parametrize(("text", "value"), [
    ("Va a 0 2\nE1 b 0 a 0 3", 6.0), ("Ra a c 1\nVa a 0 1\nVc c 0 3\nG1 b 0 a c 2", 4.0),
    ("Ia 0 a 1\nVs a 0 0\nF1 0 b Vs 2", 2.0), ("Ia 0 a 1\nVs a 0 0\nH1 b 0 Vs 5", 5.0),
    ("Ib 0 b 1\nE1 b c b 0 3\nRc c 0 1", -1.0),  # v_c = -2 v_b
])
def test_what_is_controlled_follows_with_its_sign(text, value):
    result = simulated(plant_of(f"t\n{text}\nRb b 0 1\n", measure="y=v(b)"), 1.0)
    assert result["y"][-1] == pytest.approx(value, rel=1e-12)


def test_subcircuits_are_what_stands_in_them():
    inside, outside = (simulated(plant_of(text, measure=["y=v(o)"]), 3.0) for text in (
        NETLISTS["subcircuits"][0].replace("{r*rr}", "'r*rr'"),
        "flat\nV1 in 0 SIN(0 1 0.3)\nR1 in m 1\nC1 m 0 1 ic=0.4\nR2 m o 2\nC2 o 0 0.3 ic=0.4\n",
    ))
    np.testing.assert_allclose(inside["y"], outside["y"], atol=1e-11)


def test_a_circuit_starts_from_what_is_said_of_it():
    """Voltages along chains of capacitors, and what currents follow from them."""
    text = (
        "t\nC1 a 0 1 ic=3\nC2 a b 1 ic=1\nR1 a b {2+time}\nL1 b c 1 ic=0.5\nL2 c 0 1\nR2 c 0 1\n"
        "R3 0 a 2\n.ic i(L2)=0.25 i(R2)=0.125\n.save i(R1) i(R3)\n"
    )
    assert plant_of(text)["initial_state"] == {
        "a": 3, "b": 2, "c": 0, "ir1": 0.5, "ir2": 0.125, "ir3": -1.5, "il1": 0.5, "il2": 0.25
    }


def test_a_capacitor_that_is_not_at_ground_starts_as_is_said_of_it():
    """0.7 V on 1 F, which two resistors of 1 ohm and a source of 5 V discharge to -5 V."""
    plant = plant_of("t\nV1 a 0 5\nR1 a m 1\nC1 n m 1 ic=0.7\nR2 n 0 1\n", measure="v(n,m)")
    result = run(plant, observer="none", time={"horizon": 2.0, "samples": 21})
    np.testing.assert_allclose(result.outputs["y_n"], 5.7 * np.exp(-result.t / 2) - 5, atol=1e-11)


def test_outputs_have_names_units_and_rows():
    plant = plant_of(
        "t\nV1 a 0 1\nR1 a b 1\nC1 b 0 1\n",
        measure="v(a),v(a,b),s=i(R1)-2*i(V1),v(a)+i(R1),-3*v(b)",
    )
    assert plant["states"] == ["a", "b", "ir1", "iv1"]
    assert plant["outputs"] == ["y_a", "y_a_", "s", "y", "y_b"]
    assert [plant["units"].get(name) for name in plant["outputs"]] == ["V", "V", "A", None, "V"]
    assert plant["C"] == [[1, 0, 0, 0], [1, -1, 0, 0], [0, 0, 1, -2], [1, 0, 1, 0], [0, -3, 0, 0]]


def test_nodes_are_ordered_by_numbers_and_may_be_called_as_elements():
    plant = plant_of("t\nV1 n1 0 1\nR1 n1 n10 1\nR2 n10 n2 1\nC10 n10 0 1\nC2 n2 0 1\n")
    assert plant["states"] == ["n1", "n2", "n10", "iv1"]
    plant = plant_of("t\nV1 r1 0 1\nR1 r1 b 1\nC1 b 0 1\n", measure="v(r1)")
    assert plant["states"] == ["b", "r1", "iv1"]  # and no current of R1


def test_what_is_constant_has_no_derivative_and_a_resistor_may_start_from_nothing():
    plant = plant_of("t\nV1 a 0 1\nL1 a b 1u\nR1 b 0 {t}\n", measure="i(R1),i(L1)")
    assert "d(" not in str(plant["A"])
    assert plant["initial_state"].get("ir1", 0) == 0


def test_comments_of_equations_stand_in_one_column():
    for matrix in from_netlist(PAPER).to_yaml().split("\n\n")[1:]:
        rows = [line for line in matrix.splitlines() if line.startswith("  - [")]
        assert len({line.index("  # ") for line in rows}) <= 1, matrix


@given(names=st.permutations("pqrsu"))
@settings(max_examples=6, deadline=None)
@example(names="qrpsu")
def test_capacitors_that_cannot_start_as_said_do_not_mind_how_nodes_are_called(names):
    """C4 and C9, joined by a source, share their charge; C8, behind resistors, keeps its own."""
    a, b, c, d, e = names
    text = (
        f"t\nV1 {a} 0 0.336\nR2 {b} {a} 0.39\nR3 {c} 0 2.7\nC4 {d} 0 0.2367\nR5 {e} {a} 3.5\n"
        f"R6 {a} 0 4.1\nR7 {b} 0 4.2\nC8 {b} 0 0.6369\nC9 {c} 0 0.3527\nR10 {d} 0 1.07\n"
        f"R11 {e} 0 0.57\nL12 {c} {e} 0.75\nE14 {c} {d} {a} {b} -0.259\nT15 {a} {e} {e} {a} n=1.5\n"
    )
    result = run(from_netlist(text), observer="none", time={"horizon": 1.0, "samples": 3})
    start, apart = [result[name][0] for name in names], -0.259 * 0.336
    shared = [0.2367 * apart / (0.2367 + 0.3527), -0.3527 * apart / (0.2367 + 0.3527)]
    np.testing.assert_allclose(start, [0.336, 0.0, *shared, 0.336], atol=1e-12)


def test_a_switched_capacitor():
    """C1 is charged, and then shares its charge with C2, again and again."""
    text = (
        "packets\nV1 a 0 1\nS1 a b on=0,4 off=1,5 ron=10m\nS2 b c on=2,6 off=3,7 ron=10m\n"
        "C1 b 0 1 ic=0\nC2 c 0 2 ic=0\n"
    )
    result = simulated(plant_of(text, measure="v(c)"), 8.0)
    after = [np.interp(time, result["t"], result["y_c"]) for time in (1.5, 3.5, 7.5)]
    np.testing.assert_allclose(after, [0, 1 / 3, 5 / 9], atol=1e-7)


def test_an_ideal_transformer():
    text = "t\nV1 a 0 2\nT1 a 0 b 0 n=4\nR1 b 0 1\nC1 c 0 1\nR2 b c 1\n"
    result = simulated(plant_of(text, measure="v(b),i(T1)"), 40.0)
    assert result["y_b"][-1] == pytest.approx(0.5)
    assert result["y_it1"][-1] == pytest.approx(0.125)  # 0.5 A through R1, divided by the ratio


def test_a_line_between_two_transformers_is_grounded_by_these():
    text = "t\nV1 a 0 2\nT1 a 0 b 0 n=4\nR1 b c 1\nT2 e 0 c 0 n=4\nR2 e 0 1\n"
    result = simulated(plant_of(text, measure="v(e)"), 1.0)  # R2 is 1/16 Ω at c, beside 1 Ω
    assert result["y_e"][-1] == pytest.approx(2.0 / 17.0)


@pytest.mark.parametrize(("text", "measure", "value"), [
    ("V1 a 0 2\nR1 a 0 1\nH1 a 0 V1 -5", "i(V1)", -0.4),
    ("I1 0 a 1m\nG1 a b a b 1m\nG2 b 0 b 0 2m", "v(a)", 1.5),
], ids=["across a source", "conductances"])
def test_what_is_controlled_may_determine_a_loop_or_a_cutset(text, measure, value):
    plant = plant_of(f"t\n{text}\n", measure=measure)
    assert simulated(plant)[plant["outputs"][0]][-1] == pytest.approx(value, rel=1e-12)


@given(words=st.permutations(
    ["/in", "net-(r1-pad1)", "1.2", "n$1", "out+", "in", "vin", "a_b", "a-b"]
))
@settings(max_examples=5, deadline=None)
def test_nodes_may_be_called_anything(words):
    """A chain of resistors with 9 V across nine of them, and a source that is called as a node."""
    chain = "\n".join(f"R{k} {a} {b} 1" for k, (a, b) in enumerate(pairwise([*words, "0"])))
    text = f"t\nvin {words[0]} 0 9\n{chain}\nC1 {words[-1]} 0 1\n.ic v({words[-1]})=2\n"
    plant = plant_of(text, measure=[f"v({word.upper()})" for word in words], unknown="VIN")
    assert list(plant["initial_state"].values()).count(2.0) == 1
    assert len(plant["unknowns"]) == 1
    result = simulated(plant, 40.0)
    np.testing.assert_allclose([result[y][-1] for y in plant["outputs"]], range(9, 0, -1))


def test_an_unknown_source_is_estimated():
    text = "leak\nV1 a 0 SIN(0 1 0.5)\nR1 a b 1k\nC1 b 0 1m ic=0.2\nI5 b 0 2u\n"
    result = run(plant_of(text, measure="v(b)", unknown="I5"), estimator="ls_drem")
    assert result.estimates["I5"][0, -1] == pytest.approx(2e-6, rel=1e-6)


@pytest.mark.parametrize(("text", "value"), [
    ("4.7k", 4700.0), ("10uF", 1e-5), ("1meg", 1e6), ("1MEG", 1e6), ("2m", 2e-3), ("1e-3", 1e-3),
    ("5V", 5.0), ("3mil", 76.2e-6), (".5n", 5e-10), ("2\u00b5F", 2e-6), ("2\u03bc", 2e-6),
])
def test_suffixes(text, value):
    assert number(text) == pytest.approx(value, rel=1e-15)


@given(digits=st.integers(1, 99), suffix=st.sampled_from("kmunpx"), behind=st.integers(0, 9))
@settings(max_examples=20, deadline=None)
def test_digits_behind_a_suffix_are_not_put_behind_the_number(digits, suffix, behind):
    """4k7 is 4.7k to some, and was 4000.07 here."""
    word = f"{digits}{suffix}{behind}"
    for value in (word, f"{{2*{word}}}"):
        with refused(f"line 2: R1: {word} is no number"):
            from_netlist(f"t\nR1 a 0 {value}\n")


@given(name=st.sampled_from(["t", "T", "time", "d", "step", "pi", "lambda", "r", "v1"]))
@settings(max_examples=9, deadline=None)
def test_a_parameter_is_what_is_said_of_it_whatever_it_is_called(name):
    plant = plant_of(f"t\n.param {name}=0.25\nV1 a 0 {{8*{name}}}\nR1 a 0 {{{name.upper()}}}\n")
    found = plant_from_mapping(plant).coefficients.taylor(np.array([3.0]), 0)
    assert found.u.ravel() == 2
    assert -1 / found.A[0, 0, 0, 0] == 0.25


def test_voltages_that_are_saved_are_outputs_where_nothing_else_is_measured():
    text = "t\nV1 a 0 {sin(t)}\nR1 a b 2\nC1 b 0 1\n.save v(b) i(R1)\n"
    names = [plant_of(text, measure=measure)["outputs"] for measure in (None, "v(a)")]
    assert names == [["y_b"], ["y_a"]]


def test_what_continues_and_what_is_a_comment():
    text = "* a title\n* no\nC1 a 0 1 $ farad\nR1 a 0\n+ 5 ; ohms\n.save\n.end\nR1 a 0 2\n"
    netlist = read_netlist(text)
    assert netlist.saved == []
    assert [(e.name, e.value) for e in netlist.elements.values()] == [("C1", 1.0), ("R1", 5.0)]
    assert netlist.title == "a title"


@pytest.mark.parametrize(("lines", "message"), [
    ("R1 a b 1\nC1 a b 1", "no element is connected to ground"),
    ("R1 a 0 1\nR2 b c 1", "no path leads from node b to ground"),
    ("V1 a 0 1\nV2 a 0 2", "line 3: V2 closes a loop of voltage sources"),
    ("V1 a a 1\nR1 a 0 1", "line 2: V1 closes a loop of voltage sources, or is shorted"),
    ("I1 0 a 1\nI2 a 0 1\nR1 b 0 1", "line 2: I1 drives a current"),
    ("R1 a 0 0", "line 2: R1 has the value 0"),
    ("R1 a 0", "R1 needs one value, a number or {expression}; got none"),
    ("R1 a 0 1 k", "R1 needs one value, a number or {expression}; got 1 k"),
    ("R1 a 0 {foo*2}", "R1 uses foo, which is neither a parameter nor a function"),
    ("R1 a 0 1\nR1 a 0 2", "line 3: R1 stands in line 2 already"),
    ("D1 a 0 mod", "elements are R, L, C"),
    ("X1 a 0 filter", "ends with the name of a subcircuit, and 'filter' is none"),
    ("X1", "X1 ends with the name of a subcircuit, and nothing is none"),
    (".subckt filter a\nR1 a 0 1\n.ends\nX1 a filtre", "'filtre' is none; did you mean filter?"),
    ("T1 a 0 b 0 z0=50 td=1n", "T is an ideal transformer with n=RATIO"),
    (".include /etc/passwd\nR1 a 0 1", "would read another file"),
    ("V1 a 0 PULSE(0 1 0 1n 1n 1u 2u)\nR1 a 0 1", "needs the number of pulses"),
    ("K1 L1 L2 0.5\nL1 a 0 1\nR2 b 0 1", "K1 couples l2, which is no inductor"),
    ("K1 L1 L2\x1b[31m 0.5\nL1 a 0 1", r"K1 couples l2\x1b[31m, which is no inductor"),
    ("L1 a 0 1\nL2 b 0 1\nK1 L1 L2 1.5", "a coupling is at most 1, got 1.5"),
    ("L1 a 0 1\nL2 b 0 1\nK1 L1 L2 -1.5", "a coupling is at most 1, got -1.5"),
    ("V1 a 0 PWL()\nR1 a 0 1", "needs pairs of a time and a value"),
    ("R1 a 0 {1", "is not closed"),
    (".subckt s a\nR1 a 0 1\nX1 a s\n.ends\nX1 b s\nR2 b 0 1", "nested more than 20 deep (s)"),
    ("R1=5", "'R1=5' is no element: a name comes first"), ("X1=s", "a name comes first"),
    ("R1 a", "R1 needs 2 nodes and has 1"),
    ("= R1 a 0 1", "= needs a name before it"), (".param\nR1 a 0 1", ".param needs name=value"),
    (".subckt s a b\n.subckt r a b", ".subckt inside .subckt s"),
    (".subckt s", "needs a name and nodes"), (".ends", ".ends without .subckt"),
    (".subckt s a b\nR1 a b 1", ".subckt s has no .ends"),
    (".subckt s a b\nR1 a b 1\n.ends\nX1 a s", "X1 has 1 nodes and the subcircuit s has 2"),
    (".subckt s a r=1\nR1 a 0 {r}\n.ends\nX1 a s rr=2", "s has no parameter rr; did you mean r"),
    (".model d d\nR1 a 0 1", ".model is not read"),
    ("K1 L1 L2", "two inductors and a coefficient"), ("K1 L1 l1 1", "K1 needs two inductors"),
    (".global vdd", "line 2: .global is not read; give each subcircuit a node"),
    (".subckt s gnd\nR1 gnd 0 1\n.ends\nX1 a s\nV1 a 0 1", "a node of the subcircuit s, cannot"),
    (".subckt s a\nR1 a m 1\nC1 m 0 1\n.ends\nX1 b s\nR1 b x1_m 1", "line 7: the node x1_m and"),
    (".subckt s a\nR1 a m 1\nR2 m 0 1\n.ends\nX2 x1_m s\nX1 x1_m s", "line 3: the node m and one"),
    ("R1 a 0 1 ic=2", "R1: ic= is not read here"), ("R1 a 0 1 tc1=2", "tc1= changes the value"),
    ("T1 a 0 b 0 2", "T1 needs n=RATIO"), ("F1 a 0", "needs the voltage source whose current"),
    ("S1 a 0", "S1 needs its instants"), ("S1 a 0 on=x", "on=x has to be times in seconds"),
    ("S1 a 0 on=1,2 off=3", "on and off have to take turns"),
    ("V1 a 0 SIN(0 1 f)", "SIN(…) takes numbers"), ("V1 a 0 SIN(0 1)", "needs at least 3 numbers"),
    ("V1 a 0 SIN(0 1 1 0 0 0 0)", "has 7 numbers; at most 6"),
    ("V1 a 0 EXP(0 1 0 0 1 1)", "needs positive time constants"),
    ("V1 a 0 PWL(0 1 2)", "pairs of a time and a value"),
    ("V1 a 0 PWL(1 1 0 2)", "times that do not fall"),
    ("V1 a 0 PULSE(0 1 0 1n 1n 2u 1u 3)", "longer than their period"),
    ("V1 a 0 PULSE(0 1 0 1n 1n 1u 2u 2000)", "at most 1000 are read"),
    ("R1 out 0 1\n.ic v(aut)=1", ".ic v(aut) is neither the voltage of a node"),
    ("R1 a 0 1\nC1 a 0 1\n.ic i(C1)=1", ".ic i(c1) is neither"),
    ("+ R1 a 0 1", "line 2: there is no line that + continues"),
    ("R1 a 0 1\n.ic v(a)=x", "line 3: .ic v(a) = 'x' is not a number"),
    ("C1 a 0 1 ic=x", "C1: ic=x is not a number"), ("R-1 a 0 1", "'R-1' cannot be a name; use"),
    ("R1 a 0 1\nF1 a 0 R1 2", "line 3: F1 is controlled by the current of r1, which has to be"),
    ("V1 a 0 1 2", "is no source"), ("R1 a 0 1\n" * 20001, "lines; at most"),
    ("\n".join(f"R{k} a 0 1" for k in range(5001)), "more than 5000 elements"),
    ("* only a comment\n.param r=1", "bad: there is no element in it (the first line is a title)"),
])
def test_mistakes_in_netlists(lines, message):
    with refused(message):
        from_netlist(f"title\n{lines}\n", "bad")


@pytest.mark.parametrize(("measure", "unknown", "message"), [
    ("v(q)", None, "there is no node q"), ("i(C1)", None, "whose current"),
    ("sqrt(2)", None, "cannot measure"), (None, "R1", "it is no source"),
    ("y=1e*v(a)", None, "cannot measure 'y=1e*v(a)'"), ("v(0)", None, "ground has no voltage"),
    ("y=", None, "cannot measure 'y='; write v(node)"),
    (None, "V1", "V1 is '0.0 + 1.0*sin(2*pi*1.0*t)', and an unknown is a constant"),
])
def test_mistakes_in_what_is_asked(measure, unknown, message):
    text = "t\nV1 a 0 SIN(0 1 1)\nR1 a b 1\nC1 b 0 1\n"
    with refused(message):
        from_netlist(text, measure=measure, unknown=unknown)


SLIDER_CRANK = {  # linearised about a slow turn: two positions on a line that a rod connects
    "M": [[2.0, 0.0], [0.0, 1.0]], "D": [[0.3, 0], [0, 0.1]], "K": [[4, 0], [0, "1 + 0.5*sin(t)"]],
    "G": [[1, -1]], "inputs": {"force": "sin(t)"}, "B": [[1], [0]], "unknowns": {"load": -0.5},
    "F": [[0], [1]], "measure": ["q1"],
    "initial_positions": [0.2, 0.2], "initial_velocities": {"q1": 0.1, "q2": 0.1},
}


def test_mechanics_of_index_3():
    """Both masses move as one; the force in the rod is what is left of a balance."""
    draft = from_mechanics(SLIDER_CRANK, "rod")
    assert draft.title == "mechanism rod"
    assert from_mechanics({**SLIDER_CRANK, "title": "a rod"}, "rod").title == "a rod"
    book = from_mechanics({**SLIDER_CRANK, "reference": "a book"}, "rod", "rod.yaml")
    assert book.mapping()["reference"] == "a book"
    result = simulated(draft.mapping())
    assert result.details.simulation.index == 3

    def slope(t, z):
        force = np.sin(t) - 0.5 - 0.4 * z[1] - (5 + 0.5 * np.sin(t)) * z[0]
        return [z[1], force / 3]

    t = result["t"]
    z = solve_ivp(slope, (0, t[-1]), [0.2, 0.1], "DOP853", t, rtol=1e-12, atol=1e-14).y
    np.testing.assert_allclose(result["q1"], z[0], atol=1e-9)
    np.testing.assert_allclose(result["v_q2"], z[1], atol=1e-9)
    acceleration = np.array(slope(t, z)[1])
    rod = 2 * acceleration + 0.3 * z[1] + 4 * z[0] - np.sin(t)
    np.testing.assert_allclose(result["lambda1"], rod, atol=1e-8)


def test_a_position_that_is_prescribed_needs_a_force():
    model = {"M": [[2]], "G": [[1]], "r": ["sin(t)"], "inputs": {"u": 3}, "B": [[1]]}
    result = simulated(from_mechanics(model, "driven").mapping(), 3.0)
    np.testing.assert_allclose(result["q1"], np.sin(result["t"]), atol=1e-10)
    np.testing.assert_allclose(result["lambda1"], -2 * np.sin(result["t"]) - 3, atol=1e-8)


def slider_crank():
    """Crank, rod and slider that turn evenly, and what of their equations is left nearby."""
    t = sp.Symbol("t")
    phi, psi, x = (sp.Function(name)(t) for name in ("phi", "psi", "x"))
    r, length = sp.Rational(3, 10), 1
    angle = sp.Rational(3, 2) * t + sp.Rational(1, 2)
    rod = sp.asin(r / length * sp.sin(angle))
    motion = {phi: angle, psi: rod, x: r * sp.cos(angle) + length * sp.cos(rod)}
    equations = [
        phi.diff(t, 2) / 5 + phi.diff(t) / 10, psi.diff(t, 2) / 20,
        2 * x.diff(t, 2) + x.diff(t) / 2 + 3 * (x - 1),
    ]
    constraints = [
        r * sp.sin(phi) - length * sp.sin(psi), r * sp.cos(phi) + length * sp.cos(psi) - x
    ]
    on_rod, on_slider = (e.subs(list(motion.items())).doit() for e in equations[1:])
    # The balances of rod and slider say what the joints carry on the way.
    along = -on_slider
    across = -(on_rod + length * sp.sin(rod) * along) / (length * sp.cos(rod))
    return linearise(equations, constraints, motion, [across, along])


def test_a_hanging_pendulum_swings_by_the_force_of_its_rod():
    """m (x'', y'' + g) = λ (x, y) on a circle of the radius l: m δx'' = −(m g/l) δx."""
    t = sp.Symbol("t")
    x, y = (sp.Function(name)(t) for name in "xy")
    m, g, length = sp.Integer(2), sp.Integer(10), sp.Integer(4)
    model = linearise(
        [m * x.diff(t, 2), m * y.diff(t, 2) + m * g], [(x**2 + y**2 - length**2) / 2],
        {x: sp.Integer(0), y: -length}, [-m * g / length],
    )
    assert model == {
        "positions": ["x", "y"], "M": [["2", "0"], ["0", "2"]], "D": [["0", "0"], ["0", "0"]],
        "K": [["5", "0"], ["0", "5"]], "G": [["0", "-4"]],
    }


def test_drag_that_grows_with_speed_damps_by_the_speed_on_the_way():
    """x'' + (x')² on a belt y = x with x₀ = t²/2: 2 x₀' δx', and the belt's force is not moved."""
    t = sp.Symbol("t")
    x, y = (sp.Function(name)(t) for name in "xy")
    model = linearise(
        [x.diff(t, 2) + x.diff(t) ** 2, y.diff(t, 2) * x], [y - x],
        {x: t**2 / 2, y: t**2 / 2}, [t],
    )
    assert model == {
        "positions": ["x", "y"],
        "M": [["1", "0"], ["0", "t**2/2"]], "D": [["2*t", "0"], ["0", "0"]],
        "K": [["0", "0"], ["1", "0"]], "G": [["-1", "1"]],
    }


def test_equations_without_constraints_and_of_first_order_are_linearised():
    """100 T' + 2 (T − 290) + T⁴ by T = 3: no mass, and 4 T³ beside the conductance."""
    t = sp.Symbol("t")
    T = sp.Function("T")(t)
    model = linearise([100 * T.diff(t) + 2 * (T - 290) + T**4], [], {T: sp.Integer(3)}, [])
    assert model == {
        "positions": ["T"], "M": [["0"]], "D": [["100"]], "K": [["110"]], "G": [],
    }
    states = from_mechanics({**model, "measure": ["T"]}, "m").mapping()["states"]
    assert states == ["T", "v_T"]


def test_entries_of_a_mechanism_may_be_numbers_and_text_of_either_sign():
    """M q'' + D q' + K q = B u."""
    draft = from_mechanics({
        "M": [["m", 0], [0, 3]], "D": [["-c", "2*c"], [0.5, -4]], "K": [["1 + t", -7], [0, "k"]],
        "B": [["m"], [-2]], "inputs": {"u": "sin(t)"}, "measure": ["q1"],
        "parameters": {"m": 2, "c": 0.25, "k": 9},
    }, "m")
    found = plant_from_mapping(draft.mapping()).coefficients.taylor(np.array([0.5]), 0)
    D, K = np.array([[-0.25, 0.5], [0.5, -4.0]]), np.array([[1.5, -7.0], [0.0, 9.0]])
    none, one = np.zeros((2, 2)), np.eye(2)
    np.testing.assert_allclose(found.E[0, 0], np.block([[one, none], [none, np.diag([2.0, 3.0])]]))
    np.testing.assert_allclose(found.A[0, 0], np.block([[none, one], [-K, -D]]))
    np.testing.assert_allclose(found.B[0, 0].ravel(), [0.0, 0.0, 2.0, -2.0])
    alone = plant_from_mapping(from_mechanics({"M": [[2]], "measure": ["q1"]}, "m").mapping())
    np.testing.assert_array_equal(alone.coefficients.taylor(np.zeros(1), 0).A[0, 0], np.eye(2, k=1))


def test_a_slider_crank_about_its_motion_is_observed_from_one_position():
    """Index 3, against the equation of the crank's angle alone, which has no constraints."""
    model = {
        **slider_crank(), "inputs": {"torque": "sin(2*t)"}, "B": [[1], [0], [0]],
        "measure": ["x"], "initial_positions": {"phi": 0.1},
    }
    plant = from_mechanics(model, "crank").mapping()
    result = run(plant, time={"horizon": 3.0, "samples": 100})
    assert result.details.simulation.index == 3
    # δq = N δφ with N the change of q with φ on the way; forces in joints do no work along N.
    t = sp.Symbol("t")
    sine, cosine = (sp.Rational(3, 10) * f(1.5 * t + 0.5) for f in (sp.sin, sp.cos))
    slant = cosine / sp.sqrt(1 - sine**2)
    N = sp.Matrix([1, slant, -sine * (1 + slant)])
    known = [sp.Matrix([[sp.sympify(entry) for entry in row] for row in model[key]])
             for key in "MDK"]
    terms = sp.lambdify(t, [*known, N, N.diff(t), N.diff(t, 2)])

    def slope(t, z):
        M, D, K, N, dN, ddN = terms(t)
        force = np.sin(2 * t) - N.T @ (
            (2 * M @ dN + D @ N) * z[1] + (M @ ddN + D @ dN + K @ N) * z[0]
        )
        return [z[1], (force / (N.T @ M @ N)).item()]

    t = result["t"]
    start = [result["phi"][0], result["v_phi"][0]]
    z = solve_ivp(slope, (0, t[-1]), start, "DOP853", t, rtol=1e-11, atol=1e-13).y
    for k, name in enumerate(("phi", "psi", "x")):
        expected = [terms(time)[3][k, 0] * angle for time, angle in zip(t, z[0], strict=True)]
        np.testing.assert_allclose(result[name], expected, atol=1e-9)
    for name in plant["states"]:
        assert abs(result.errors[name][0, -1]) < 1e-9 * np.abs(result[name]).max(), name


@pytest.mark.parametrize(("change", "message"), [
    ({"M": None}, "M is missing"), ({"K": [[1, 0]]}, "K has 1 rows; expected 2"),
    ({"G": [[1, 2, 3]]}, "G[0] has 3 entries; expected 2"),
    ({"stiffness": 1}, "stiffness: no such key"), ({"r": [1, 2]}, "r has 2 entries"),
    ({"measure": ["q3"]}, "did you mean"), ({"M": [[1, True], [0, 1]]}, "M[0][1]"),
    ({"positions": ["a"]}, "positions has 1 names and M has 2 rows"),
    ({"measure": "q1"}, "measure: expected a list"),
    ({"inputs": ["u"]}, "inputs: expected a mapping of names"),
    ({"K": 3}, "K: expected a list"), ({"K": [1, 2]}, "K[0]: expected a list"),
    ({"M": [[0]] * 1001}, "M has 1001 rows and G 1; 1 to 1000 are read"),
    ({"M": []}, "M has 0 rows"), ({"G": [[1, -1]] * 1001}, "M has 2 rows and G 1001;"),
    ({"units": "m"}, "units: expected a mapping"),
    ({"B": None}, "B has 0 rows; expected 2"), ({"F": []}, "F has 0 rows; expected 2"),
    *(({"positions": ["q1", name], "r": [1]}, f"{name} is the name of two things; velocities are")
      for name in ("q1", "v_q1", "lambda1", "r1", "force", "load")),
    ({"inputs": {"r1": "sin(t)"}, "r": ["cos(t)"]}, "r1 is the name of two things"),
])
def test_mistakes_in_mechanics(change, message):
    with refused(message):
        from_mechanics({**SLIDER_CRANK, **change}, "rod", "rod.yaml")
    with refused(begins="rod"):  # what is no file has a name
        from_mechanics({**SLIDER_CRANK, **change}, "rod")


def test_a_measured_position_has_its_unit():
    units = {"q1": "rad", "v_q2": "m/s", "force": "N"}
    plant = from_mechanics({**SLIDER_CRANK, "measure": ["q1"], "units": units}, "rod").mapping()
    assert plant["units"] == {**units, "y_q1": "rad"}


MARKET = "%%MatrixMarket matrix array real general\n1 1\n-1\n"
A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B, C = np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])


def test_a_state_space_model():
    system = SimpleNamespace(
        A=A, B=B, C=C, D=np.zeros((1, 1)), dt=0, state_labels=["x[0]", "1"],
        input_labels=["u"], output_labels=["y"],
    )
    plant = from_control(system, "oscillator", initial_state=[1, 0]).mapping()
    assert plant["states"] == ["x_0", "x_1"]
    np.testing.assert_allclose(simulated(plant)["x_0"][-1], (expm(10 * A) @ [1, 0])[0], atol=1e-11)
    system.dt = 0.1
    with pytest.raises(ConfigError, match="discrete time"):
        from_control(system, "oscillator")


@pytest.mark.parametrize(("n", "names"), [(50, {".yaml"}), (51, {".yaml", ".npz"})])
def test_more_than_fifty_states_are_in_an_archive(n, names, tmp_path):
    system = SimpleNamespace(A=-np.eye(n), B=np.ones((n, 1)), C=np.eye(1, n), D=[[0]], dt=0)
    files = from_control(system, "many", initial_state=[1] * n).files()
    assert {Path(name).suffix for name in files} == names
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    found = load_plant(tmp_path / "many.yaml").coefficients.taylor(np.zeros(1), 0)
    for name in "ABC":
        np.testing.assert_array_equal(getattr(found, name)[0, 0], getattr(system, name))


def test_what_follows_time_stays_in_the_text_of_a_large_plant():
    states = "".join(f"R{k} n{k - 1} n{k} 1\nC{k} n{k} 0 1\n" for k in range(1, 60))
    text = f"many\nV1 n0 0 1\n{states}L1 n9 n0 {{2 + sin(time)}}\n"
    draft = from_netlist(text, "many")
    assert "E" not in draft.archived()
    t = np.array([0.0, 1.0])
    E = plant_from_mapping(draft.mapping()).coefficients.taylor(t, 0).E[0]
    assert (E[0] != E[1]).any()


LEAK = (
    "leak\nV1 a 0 SIN(0 1 0.5)\nR1 a b 1\nC1 b 0 1 ic=0.2\nL1 b c 1\nR2 c 0 2\nI5 b 0 0.3\n"
)


def test_to_python_control_and_back():
    """The observer as a state-space model gives the state from measurements, θ and its start."""
    control = pytest.importorskip("control")
    plant = plant_of(LEAK, measure="v(b),i(V1)", unknown="I5")
    result = run(plant, time={"horizon": 1.0})
    observer = result.to_control()
    assert observer.input_labels == ["V1", "y_b", "y_iv1", "I5"]
    given = [*(result[name] for name in observer.input_labels[:-1]), np.full_like(result.t, 0.3)]
    start = [result[name.removeprefix("w_")][0] for name in observer.state_labels]
    found = control.forced_response(observer, result.t, np.array(given), start).outputs
    for name, values in zip(observer.output_labels, found, strict=True):
        np.testing.assert_allclose(values, result[name.removesuffix("_hat")], atol=2e-6)
    again = from_control(observer, "again").mapping()
    assert (again["states"], again["outputs"]) == (["w_b", "w_il1"], observer.output_labels)
    np.testing.assert_array_equal(again["A"], observer.A)


@pytest.mark.parametrize(("plant", "options", "message"), [
    ("circuit", {}, "E depends on time"),
    ("motor", {"observer": "kalman_bucy"}, "this run has observer=kalman_bucy"),
    ("motor", {"observer": {"sample_time": 0.1}}, "sample_time 0.1"),
])
def test_what_is_no_state_space_model(plant, options, message):
    pytest.importorskip("control")
    with pytest.raises(ConfigError, match=message):
        run(plant, **options, time={"horizon": 1.0}).to_control()


def test_to_xarray():
    pytest.importorskip("xarray")
    result = run(plant_of(LEAK, measure="v(b),i(V1)", unknown="I5"), time={"horizon": 1.0})
    estimates, table = result.to_xarray("estimates"), result.to_pandas("estimates")
    assert estimates["b_hat"].dims == ("case", "t")
    np.testing.assert_array_equal(estimates["b_hat"].to_numpy()[0], table["b_hat"])
    assert result.to_xarray()["b"].attrs == {"units": "V"}
    assert estimates["e0_b_hat"].attrs == {"units": "V"}  # an initial error has its state's
    plant = one_state(states=["v_true"], outputs=["v"], units={"v_true": "m", "v": "mm"})
    signals = run(plant, observer="none", time={"horizon": 1.0}).to_xarray()
    assert [signals[name].attrs["units"] for name in ("v_true", "v", "t")] == ["m", "mm", "s"]


@pytest.mark.parametrize("package", ["control", "xarray"])
def test_what_is_not_installed_is_named(package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    result = run("descriptor", observer="none", time={"horizon": 1.0})
    with pytest.raises(ConfigError, match=f"pip install {package}"):
        getattr(result, f"to_{package}")()


def test_names_of_models_from_elsewhere_become_names_of_a_plant():
    """An output is often called as the state that it is; t is time here, and d a derivative."""
    system = SimpleNamespace(
        A=A, B=B, C=C, D=np.zeros((1, 1)), state_labels=["theta", "t"], input_labels=["d"],
        output_labels=["theta"],
    )
    plant = from_control(system, "arm", initial_state=[1, 0]).mapping()
    names = [plant["states"], [*plant["inputs"]], plant["outputs"]]
    assert names == [["theta", "x_t"], ["u_d"], ["y_theta"]]
    np.testing.assert_array_equal(simulated(plant)["y_theta"], simulated(plant)["theta"])


@given(kept=st.sets(st.sampled_from("BFCDH")), n=st.integers(1, 3))
@settings(max_examples=10, deadline=None)
@example(kept=set("DH"), n=2)
def test_an_archive_is_read_whatever_it_has(kept, n, tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "plant.NPZ"
    sizes = {"B": (n, 2), "F": (n, 1), "C": (3, n), "D": (3, 2), "H": (3, 1)}
    given = {"A": -np.eye(n)} | {key: np.full(sizes[key], 2.0) for key in kept}
    with path.open("wb") as file:
        np.savez(file, **given)
    system = plant_from_mapping(from_file(path, "p").mapping())
    c = system.coefficients.taylor(np.zeros(1), 0)
    for key, value in given.items():
        np.testing.assert_array_equal(getattr(c, key)[0, 0], value)


def test_what_is_measured_twice_is_an_output_once():
    draft = from_matrices({"A": -np.eye(3)}, "p")
    draft.measure(["x2", "x2", "x3"], "")
    assert (draft.mapping()["outputs"], draft.mapping()["C"]) == (
        ["y_x2", "y_x3"], [[0, 1, 0], [0, 0, 1]]
    )


def test_files_of_matrices(tmp_path):
    E = sparse.diags([1.0, 2.0])
    savemat(tmp_path / "a.mat", {"E": E, "A": A, "B": B, "C": C})
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, matrix in (("E", E), ("A", A), ("B", B), ("C", C)):
        mmwrite(folder / f"plant.{name}.mtx", sparse.coo_matrix(matrix))
    (folder / "notes.mtx").write_text("what belongs to no system is passed over")
    expected = from_matrices({"E": E.toarray(), "A": A, "B": B, "C": C}, "p").mapping()
    assert {*expected["inputs"].values()} == {0.0}  # nobody has said what they are
    for path in (tmp_path / "a.mat", folder):
        assert {**from_file(path, "p").mapping(), "reference": None} == {
            **expected, "reference": None
        }
    # as OpenModelica 1.2x writes them
    savemat(tmp_path / "second.mat", {"A": A, "M": np.eye(1), "K": np.eye(1), "D": np.eye(1)})
    assert "D" not in from_file(tmp_path / "second.mat", "p").mapping()
    (tmp_path / "m.m").write_text(
        "function [A, B, C, D, stateVars, inputVars, outputVars] = linearized_model()\n"
        "% mass\n% der(x) = A * x + B * u\n  n = 2; % number of states\n\n  x0 = [1, 0];\n"
        "  u0 = [0];\n\n  A =\t[0, 1;\n\t-2, -0.3];\n\n  B =\t[0;\n\t1];\n\n  C =\t[1, 0];\n\n"
        "  stateVars  = {'mass[1,1].s','der(v)'};\n  inputVars  = {'force'};\n"
        "  outputVars = {'s'};\n  Ts = 1; % stop time\n\nend"
    )
    (tmp_path / "m.py").write_text(
        "def linearized_model():\n    # mass\n    # der(x) = A * x + B * u\n    n = 2\n\n"
        "    x0 = [1, 0]\n    u0 = [0]\n\n    A = [[0, 1], [-2, -0.3]]\n\n    B = [[0], [1]]\n\n"
        "    C = [[1, 0]]\n\n    D = []\n\n    stateVars  = ['mass[1,1].s','der(v)']\n"
        "    inputVars  = ['force']\n    outputVars = ['s']\n\n    return (n, A, B, C, D)\n"
    )
    (tmp_path / "m.jl").write_text(
        "function linearized_model()\n  # mass #\n  local n = 2 # number of states\n\n"
        "  local x0 = [1, 0]\n  local u0 = [0]\n\n  local A = [0 1; -2 -0.3]\n"
        '  local B = [0; 1]\n  local C = [1 0]\n\n  stateVars  = ["mass[1,1].s","der(v)"]\n'
        '  inputVars  = ["force"]\n  outputVars = ["s"]\n  return (n, A)\nend'
    )
    made = [from_file(tmp_path / f"m.{ending}", "p").mapping() for ending in ("m", "py", "jl")]
    for plant in made:
        plant.pop("reference")
    assert made[0] == made[1] == made[2]
    assert made[0]["states"] == ["mass_1_1_s", "der_v"]
    assert made[0]["initial_state"] == {"mass_1_1_s": 1.0, "der_v": 0.0}
    assert made[0]["A"] == [[0, 1], [-2, -0.3]]


@pytest.mark.parametrize(("matrices", "message"), [
    ({"B": B}, "the matrix A is missing"),
    ({"A": A, "B": np.ones((3, 1))}, "B is 3 × 1; expected 2 × 1"),
    ({"A": np.zeros((2, 2, 2))}, "A is 2 × 2 × 2; expected 2 × 2"),
    ({"A": [[np.nan]]}, "not finite"), ({"A": [[1j]]}, "real numbers"),
    ({"A": sparse.eye(2001)}, "A has 2001 states; at most 2000"),
])
def test_mistakes_in_matrices(matrices, message):
    with pytest.raises(ConfigError, match=message):
        from_matrices(matrices, "p")


def test_names_that_have_nothing_to_stand_in_a_plant_get_a_letter():
    assert _identifiers({"states": ["+", "2nd", "x_"], "outputs": ["2nd"]}) == {
        "states": ["x_", "x_2nd", "x"], "outputs": ["y_2nd"],
    }


def test_mistakes_in_what_belongs_to_matrices():
    with pytest.raises(ConfigError, match="initial_state has 3 values for 2 states"):
        from_matrices({"A": A}, "p", initial_state=[1, 2, 3])
    with pytest.raises(ConfigError, match="1 names of states for 2 of them"):
        from_matrices({"A": A}, "p", states=["a"])


@pytest.mark.parametrize(("files", "message"), [
    ({"b.B.mtx": "", "note.mtx": ""}, "B.mtx is no Matrix Market file"),
    ({"B.mtx": MARKET}, "has no file A.mtx or NAME.A.mtx"),
    ({"A.mtx": MARKET, "p.A.mtx": MARKET}, "two files for A; give a folder of one system"),
])
def test_mistakes_in_folders_of_matrices(files, message, tmp_path):
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(ConfigError, match=message):
        from_file(tmp_path, "p")


@pytest.mark.parametrize("line", [
    "E = [2, 0; 0, 1]", "x0 = [1; 2]", "B = [1; 0]; % force", "C = [1, 0]  # position",
])
@pytest.mark.parametrize("behind", ["", "'", " * 2", ";;"])
def test_a_line_of_a_linear_model_is_read_or_refused(line, behind, tmp_path):
    """It was left out where something stood behind it."""
    path, word = tmp_path / "m.m", line.split()[0]
    line = line.replace("]", f"]{behind}", 1)
    path.write_text(f"A = [0, 1; -2, -0.3];\n{line}\nD = zeros(0,0);\n")
    if behind:
        with refused(f"m.m: {word} is not read; expected numbers in brackets, or zeros"):
            from_file(path, "p")
    else:
        plant = from_file(path, "p").mapping()
        assert [*plant["initial_state"].values()] == ([1, 2] if word == "x0" else [0, 0])
        assert word == "x0" or plant[word][0][0] in (1, 2)


@pytest.mark.parametrize(("matrix", "message"), [
    ("[[0, 1], [2]]", "A has rows of different lengths"),
    ("[[[0]], [[1]]]", "A is 2 × 1 × 1; expected 2 × 2"),
    ("[{[]: 1}]", "A: .* is not a number"),
    (f"[{'-' * 100_000}1]", "A: '---.* is not a number"),
])
def test_text_of_a_linear_model_with_mistakes(matrix, message, tmp_path):
    (tmp_path / "m.py").write_text(f"A = {matrix}\n")
    with pytest.raises(ConfigError, match=message):
        from_file(tmp_path / "m.py", "p")


def test_files_that_are_no_models(tmp_path):
    for name, text, message in (
        ("m.txt", "", "m.txt: expected a netlist .*, a mechanism"),
        ("m.py", "B = [[1]]\n", r"m.py has no line A = \[...\]"),
        ("m.m", "A = [1];\nx0 = [a];\n", "m.m: x0: 'a' is not a number"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(ConfigError, match=message):
            from_file(tmp_path / name, "p")


def test_from_a_file_on_the_command_line(tmp_path):
    (tmp_path / "paper.cir").write_text(PAPER)
    words = ("new", "plant", "mine", "--from", "paper.cir", "--measure", "y=i(L)+i(V)")
    said = printed(gpebo(*words, cwd=tmp_path))
    assert "index 2 by topology (loop of capacitors and voltage sources: V, C1)" in said
    assert "index 2 as computed" in said
    printed(gpebo("check", "--config-dir", ".", "plant=mine", cwd=tmp_path))
    done = gpebo(*words[:2], "other", "--measure", "v(a)", cwd=tmp_path)
    assert_refused(done, "--measure is for a plant from a file")
    done = gpebo(*words[:2], "other", "--from", "nothing.cir", cwd=tmp_path)
    assert_refused(done, "error: nothing.cir cannot be read: No such file or directory\n")
    assert not (tmp_path / "plant" / "other.yaml").exists()


def test_a_plant_that_cannot_be_simulated_is_written_all_the_same(tmp_path):
    np.savez(tmp_path / "m.npz", E=np.zeros((1, 1)), A=np.zeros((1, 1)), C=np.eye(1))
    said = printed(gpebo("new", "plant", "mine", "--from", "m.npz", cwd=tmp_path))
    assert "it is written, but cannot be simulated yet: " in said
    assert (tmp_path / "plant" / "mine.yaml").is_file()


def test_a_large_plant_has_its_matrices_in_a_file_beside_it(tmp_path, monkeypatch):
    """The same numbers as in text; what varies stays there; a run is repeated from its folder."""
    monkeypatch.chdir(tmp_path)
    text = ladder(17, "R99 n5 0 {5+sin(time)}")
    Path("ladder.cir").write_text(text)
    done = gpebo("new", "plant", "ladder", "--from", "ladder.cir", cwd=tmp_path)
    assert done.stdout.splitlines()[:2] == ["plant/ladder.npz", "plant/ladder.yaml"]
    assert "nothing is measured: an observer needs outputs" in done.stdout
    assert "gpebo run --config-dir . plant=ladder observer=none\n" in done.stdout
    plant = yaml.safe_load(Path("plant/ladder.yaml").read_text())
    assert plant["matrices"] == "ladder.npz"
    assert "E" not in plant
    assert plant["parameters"]["R99"] == "5+sin(t)"
    assert "C1" not in plant["parameters"]
    short = {"observer": "none", "time": {"horizon": 0.1, "samples": 20}}
    result = run("plant/ladder.yaml", **short)
    expected = run(plant_of(text), **short).to_pandas()
    assert result.to_pandas().equals(expected)
    result.save("a", figures=False)
    assert_repeats(tmp_path / "a", "signals.csv")


@pytest.mark.parametrize(("content", "message"), [
    ({"A": np.eye(3)}, "A is 3 × 3, and there are 2 states (x1, x2) and there are 2 states"),
    ({"A": np.array([[1, "a"], [0, 1]], dtype=object)}, "not an array of real numbers"),
    ({"A": np.eye(2), "X": np.eye(2)}, "expected E, A, B, F, C, D, H"),
    ({"A.row": [0], "A.col": [0], "A.data": [1.0]}, "A.row, A.col, A.data, A.shape make no matrix"),
    ({"A.row": [5], "A.col": [0], "A.data": [1.0], "A.shape": [2, 2]}, "make no matrix"),
    ({"A": np.eye(2), "E": np.eye(2)}, "E stands in the plant and in"),
    ({"A": np.full((2, 2), np.nan)}, "A[0][0]"),
    ({"A": np.zeros((5001, 5000))}, "unpacks to more than"),
    (b"PK\x03\x04 no archive", "is no archive of matrices"),
    ((2, 0), "A is an array of version (2, 0); expected version (1, 0)"),
    ("long", "m.npz has more than 20000000 bytes"),
    (None, "cannot be read"), ("link", "lies outside of"), ("pipe", "is not a regular file"),
])
def test_mistakes_in_archives(content, message, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    path = folder / "m.npz"
    if isinstance(content, dict):
        np.savez_compressed(path, **content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, tuple):
        with zipfile.ZipFile(path, "w") as archive, archive.open("A.npy", "w") as stream:
            np.lib.format.write_array(stream, np.eye(2), content)
    elif content == "long":
        with path.open("wb") as stream:
            stream.truncate(20_000_001)
    elif content == "link":
        np.savez(tmp_path / "other.npz", A=np.eye(2))
        path.symlink_to(tmp_path / "other.npz")
    elif content == "pipe":
        os.mkfifo(path)
    plant = {"name": "p", "states": ["x1", "x2"], "E": [[1, 0], [0, 1]], "initial_state": [1, 0]}
    (folder / "p.yaml").write_text(yaml.safe_dump({**plant, "matrices": "m.npz"}))
    with refused(message):
        load_plant(folder / "p.yaml")


def test_an_array_beside_the_same_matrix_of_an_archive_is_refused(tmp_path):
    np.savez(tmp_path / "m.npz", A=np.eye(1))
    plant = one_state(A=np.eye(2), matrices="m.npz")
    with refused("A stands in the plant and in"):
        plant_from_mapping(plant, str(tmp_path / "p.yaml"))


MATLAB = {
    "t": np.arange(3.0), "i": np.array([[1, -2]], dtype=np.int8), "z": np.array([[1j], [2.0]]),
    "n": np.array([[2**60 + 1]]), "f": np.float32(0.1), "S": sparse.csc_array([[0, 2.0], [0, 1]]),
    "Z": sparse.csc_array([[0, 1j]]), "no": np.zeros((0, 2)), "yes": np.array([True, False]),
    "cube": np.arange(24.0).reshape(2, 3, 4),
}


@pytest.mark.parametrize("packed", [False, True])
def test_numbers_of_a_matlab_file(tmp_path, packed):
    savemat(tmp_path / "a.mat", MATLAB | {"text": "t", "cell": np.array([1, "a"], dtype=object)},
            do_compression=packed)
    found = read_mat(str(tmp_path / "a.mat"))
    assert [*found] == [*MATLAB]
    for name, saved in MATLAB.items():
        one, other = (x.toarray() if sparse.issparse(x) else np.asarray(x)
                      for x in (found[name], saved))
        assert one.dtype == other.dtype or name == "yes"
        np.testing.assert_array_equal(one, np.atleast_2d(other))
    assert [*read_mat(str(tmp_path / "a.mat"), ["S", "other"])] == ["S"]


def test_numbers_of_a_matlab_file_from_a_big_endian_machine(tmp_path):
    parts = struct.pack(">IIII", 6, 8, 6, 0), struct.pack(">IIii", 5, 8, 2, 1)
    body = b"".join(parts) + b"\0\1\0\1x\0\0\0" + struct.pack(">IIdd", 9, 16, 1.5, -2.0)
    content = b" " * 124 + b"\1\0MI" + struct.pack(">II", 14, len(body)) + body
    (tmp_path / "a.mat").write_bytes(content)
    np.testing.assert_array_equal(read_mat(str(tmp_path / "a.mat"))["x"], [[1.5], [-2.0]])


def test_a_damaged_matlab_file_is_refused_or_read(tmp_path):
    """SciPy's reader ends the process where a type, a flag or a length is another one."""
    path = tmp_path / "a.mat"
    savemat(path, {"z": [1j], "S": sparse.eye_array(2), "text": "t"})
    whole = path.read_bytes()
    for at in range(124, len(whole)):
        for byte in (0x0F, whole[at] ^ 8):
            path.write_bytes(whole[:at] + bytes([byte]) + whole[at + 1 :])
            with suppress(ConfigError):
                read_mat(str(path))
    real = whole.index(struct.pack("<II", 9, 8))
    path.write_bytes(whole[:real] + b"\x19" + whole[real + 1 :])
    with refused("a.mat cannot be read ('no number has the type 25'); save it with -v7"):
        read_mat(str(path))
    savemat(path, {"S": np.eye(2)}, do_compression=True)
    path.write_bytes(path.read_bytes()[:-2])  # of the sum that tells whether all was read
    with refused("a.mat cannot be read ('compressed data end too soon')"):
        read_mat(str(path))
    path.write_bytes(whole[:124] + b"\0\2" + whole[126:])  # as -v7.3 begins
    with refused("a.mat cannot be read ('it is of no version up to 7'); save it with -v7"):
        read_mat(str(path))


def test_files_that_claim_or_unpack_to_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr("gpebo_cli.model.archive.MAX_BYTES", 100_000)
    savemat(tmp_path / "bomb.mat", {"A": np.zeros((150, 150))}, do_compression=True)
    assert (tmp_path / "bomb.mat").stat().st_size < 1_000
    head = "%%MatrixMarket matrix coordinate real general\n2 1000000 1\n1 1 1\n"
    (tmp_path / "A.mtx").write_text(head)
    (tmp_path / "full").mkdir()
    full = "%%MatrixMarket matrix array real general\n2000 2000\n1\n"
    (tmp_path / "full" / "A.mtx").write_text(full)
    content = (tmp_path / "bomb.mat").read_bytes()
    savemat(tmp_path / "behind.mat", {"x": np.eye(2)})  # a bomb behind what is not packed
    (tmp_path / "behind.mat").write_bytes((tmp_path / "behind.mat").read_bytes() + content[128:])
    cell = np.array([[1.0]], dtype=object)
    savemat(tmp_path / "cell.mat", {"A": cell})
    content, size = (tmp_path / "cell.mat").read_bytes(), struct.pack("<IIii", 5, 8, 1, 1)
    assert size in content
    many = struct.pack("<IIii", 5, 8, 40000, 40000)  # an array of objects, made before it is read
    (tmp_path / "cell.mat").write_bytes(content.replace(size, many, 1))
    for path, message in (
        (tmp_path / "bomb.mat", "unpacks to more"), (tmp_path / "behind.mat", "unpacks to more"),
        (tmp_path / "cell.mat", "no matrix A"),
        (tmp_path, f"has {len(head)} bytes with 2 × 1000000 entries; .* and 2000 rows and c"),
        (tmp_path / "full", f"has {len(full)} bytes with 2000 × 2000 entries"),
    ):
        with pytest.raises(ConfigError, match=message):
            from_file(path, "p")


def test_sparse_matrices_from_python(tmp_path):
    """As lists are, also in what a run leaves behind."""
    plant = {"name": "p", "states": ["x1", "x2"], "initial_state": [1, 0]}
    lists = {**plant, "E": np.eye(2).tolist(), "A": A.tolist()}
    given = {**plant, "E": sparse.eye_array(2), "A": sparse.csr_array(A)}
    ours, theirs = simulated(given, 1.0), simulated(lists, 1.0)
    assert ours.to_pandas().equals(theirs.to_pandas())
    ours.save(tmp_path, figures=False)
    config = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert config["plant"]["A"] == A.tolist()


def test_what_is_measured_and_unknown_of_matrices(tmp_path):
    path = tmp_path / "m.npz"
    np.savez(path, A=A, B=B, C=np.ones((2, 2)), D=np.ones((2, 1)))
    plant = from_file(path, "p", measure="x2", unknown="u1").mapping()
    assert (plant["C"], plant["F"], plant["unknowns"]) == ([[0, 1]], [[0], [1]], {"u1": 0.0})
    assert "B" not in plant
    assert "D" not in plant
    with pytest.raises(ConfigError, match="measure has 'x3', which is no state"):
        from_file(path, "p", measure="x3")


BENCHMARKS = os.environ.get("GPEBO_BENCHMARKS", "")  # where g600.mat and drivencavity… are


@pytest.mark.skipif(not os.path.isdir(BENCHMARKS), reason="GPEBO_BENCHMARKS names no folder")
def test_public_benchmarks(tmp_path):
    masses = from_file(f"{BENCHMARKS}/g600.mat", "g600").mapping()
    masses["inputs"]["u1"] = "sin(t)"
    result = simulated(masses, 20.0)
    file = loadmat(f"{BENCHMARKS}/g600.mat")
    A, B, M, G = (file[name].toarray() for name in ("A", "B", "M", "G"))
    size, N = len(M), null_space(G)
    k = N.shape[1]
    reduced = np.linalg.solve(N.T @ M @ N, N.T @ np.hstack([
        A[size : 2 * size, :size] @ N, A[size : 2 * size, size : 2 * size] @ N,
        B[size : 2 * size],
    ]))
    ode = np.block([[np.zeros((k, k)), np.eye(k)], [reduced[:, :-1]]])
    forced = np.linalg.solve(1j * np.eye(2 * k) - ode, np.r_[np.zeros(k), reduced[:, -1]])
    t = result["t"]
    swinging = np.imag(forced * np.exp(1j * t)[:, None])
    states, step = [np.zeros(2 * k)], expm(ode * (t[1] - t[0]))
    for k_0, k_1 in pairwise(swinging):
        states.append(step @ (states[-1] - k_0) + k_1)
    true = np.array(states)[:, :k] @ N.T
    found = np.array([result[name] for name in masses["states"][:size]]).T
    assert np.abs(found - true).max() < 1e-12 * np.abs(true).max()

    page = (Path(__file__).parents[1] / "docs" / "howto" / "import.md").read_text(encoding="utf-8")
    (source,) = [s for s in blocks(page, "python") if "cavity" in s]
    saved = f"np.save({str(tmp_path / 'x')!r}, [result[name] for name in plant.states])"
    said = python(source + saved, BENCHMARKS)
    assert "index 2, 602 differential and 240 algebraic" in said
    file = loadmat(f"{BENCHMARKS}/drivencavity__mats_NV722_Re1.mat")
    M, K, J, B = (file[name].toarray() for name in ("M", "A", "J", "B"))
    N = null_space(J)
    rates, V = eigh(N.T @ K @ N, N.T @ M @ N)
    t = np.linspace(0.0, 1.0, 201)[:, None]
    modes = V.T @ N.T @ B[:, 0] / (rates**2 + 100.0) * (
        rates * np.sin(10 * t) - 10 * np.cos(10 * t) + 10 * np.exp(-rates * t)
    )
    true = (modes @ (N @ V).T).T
    found = np.load(tmp_path / "x.npy")
    assert np.abs(found[: len(true)] - true).max() < 1e-12 * np.abs(true).max()
