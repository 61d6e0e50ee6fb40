"""Bookkeeping of the benchmarks: medians, ratios, lost rows, the page. Nothing is timed."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from factories import make_result, with_figures

from benchmarks import __main__ as program
from benchmarks import circuit, gains, growth, measure, plain_figures, problems
from benchmarks.measure import Failed, Found, Row, compare, loosest
from benchmarks.page import PARTS, duration, page, table
from gpebo_cli.results.figures import describe
from gpebo_cli.results.folder import write_run

KEYS = {"name", "ours_seconds", "ours_error", "peer", "peer_seconds", "peer_error", "ratio"}


def row(**changes):
    values = {
        "name": "n", "ours_seconds": 2.0, "ours_error": 1e-12, "peer": "p", "peer_seconds": 6.0,
        "peer_error": 1e-10, "target": 1e-9,
    }
    return Row(**{**values, **changes})


class Clock:
    """Instead of the machine's: each call of a solver takes what the test says."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(measure.time, "perf_counter", lambda: self.now)

    def call(self, *durations, value=0.0):
        left = list(durations)

        def run():
            self.now += left.pop(0) if len(left) > 1 else left[0]
            return np.array(value)

        return run


def test_a_wrong_answer_loses_whatever_its_time():
    assert row().verdict == "ours faster"
    assert row(peer_seconds=1.0).verdict == "peer faster"
    assert row(peer_seconds=1.0, peer_error=2e-9).verdict == "larger error"
    assert row(peer_seconds=1.0, peer_error=math.nan).verdict == "larger error"
    assert row(ours_error=2e-9).verdict == "our error too large"
    assert row(peer_seconds=None, peer_error=None).verdict == "no result"


def test_a_row_has_the_keys_that_are_promised():
    record = row().record()
    assert set(record) >= KEYS
    assert record["ratio"] == 3.0
    assert row(peer_seconds=None).record()["ratio"] is None
    json.dumps(record, allow_nan=False)


def test_times_are_medians_of_alternating_runs(monkeypatch):
    clock = Clock(monkeypatch)
    order = []
    ours, peer = clock.call(9.0, 1.0, 5.0, 2.0), clock.call(30.0, 10.0, 20.0)
    taken = measure.alternate(
        lambda: (order.append("ours"), ours()), lambda: (order.append("peer"), peer()), 0.0, 3
    )
    assert taken == (2.0, 20.0)  # the first run of ours, 9, is not counted
    assert order == ["ours", "ours", "peer", "ours", "peer", "ours", "peer"]


def test_the_loosest_tolerance_that_meets_the_target():
    tried = []

    def prepare(tol):
        tried.append(tol)
        return lambda: np.array(tol)

    found = loosest(prepare, [1e-2, 1e-4, 1e-6, 1e-8], lambda x: 10 * float(x), 1e-4)
    assert found.tolerance == 1e-6
    assert tried == [1e-2, 1e-4, 1e-6]
    missed = loosest(prepare, [1e-2, 1e-4], lambda x: 10 * float(x), 1e-9)
    assert (missed.tolerance, missed.error) == (1e-4, 1e-3)


def test_failures_are_rows_in_the_solvers_own_words():
    ours = Found(lambda: np.array(0.0), 1e-12, 1e-6, 0.0)

    def missing(tol):
        raise ImportError("No module named 'peer'")

    def singular(tol):
        def solve():
            raise ArithmeticError("banner\n/far/away/source.cpp:62: corrector failed")

        return solve

    for prepare, words in (
        (missing, "cannot be imported: No module named 'peer'"), (singular, "corrector failed")
    ):
        found = compare("n", ours, "p", prepare, [1e-3], float, 1e-9, budget=0.0)
        assert found.verdict == "no result"
        assert (found.peer_seconds, found.ratio, found.note) == (None, None, words)
    with pytest.raises(Failed, match="no finite solution"):
        loosest(lambda tol: lambda: np.array(np.nan), [1e-3], float, 1e-9)


def test_a_part_is_replaced_and_the_others_are_kept():
    old = program.merged({}, "sweeps", [], {"rows": [1]}, {"date": "then"})
    old = program.merged(old, "cold", [row(name="old")], {}, {"date": "then"})
    new = program.merged(old, "cold", [row(name="new")], {}, {"date": "now"})
    new = program.merged(new, "circuit", [row()], {}, {"date": "now"})
    assert [r["name"] for r in new["rows"]] == ["n", "new"]  # in the order of the page
    assert new["parts"]["cold"]["measured"] == {"date": "now"}
    assert new["parts"]["sweeps"] == {"measured": {"date": "then"}, "rows": [1]}


def test_the_committed_page_is_made_from_the_committed_numbers():
    data = json.loads(program.JSON.read_text("utf-8"))
    assert program.PAGE.read_text("utf-8") == page(data)
    assert set(data["parts"]) <= set(PARTS)
    for record in data["rows"]:
        assert set(record) >= KEYS
        if record["peer_seconds"] is not None:
            assert record["ratio"] == record["peer_seconds"] / record["ours_seconds"]
        bare = {k: v for k, v in record.items() if k not in ("ratio", "verdict", "part")}
        assert Row(**bare).verdict == record["verdict"]


def test_cells():
    assert [duration(s) for s in (None, 12345.6, 1.5, 0.0123, 4e-6)] == [
        "–", "12,300 s", "1.5 s", "12.3 ms", "4 µs"
    ]
    assert table(["a"], [["x|y"]]).splitlines()[-1] == "| x\\|y |"


def test_an_exponent_is_the_slope_beyond_the_fixed_costs():
    points = [{"value": v, "seconds": max(5.0, 3.0 * v**2)} for v in (1, 10, 100, 1000)]
    assert growth.exponent(points, "seconds") == pytest.approx(2.0)
    assert growth.exponent(points[:1], "seconds") is None


def test_both_right_hand_sides_are_the_same_function():
    rng = np.random.default_rng(1)
    for t in rng.uniform(0, 20, 5):
        x = rng.normal(size=circuit.STATES)
        assert np.allclose(circuit.script(t, x, 2.0), circuit.optimised(t, x, 2.0), atol=1e-12)


def test_ours_and_the_monolith_solve_the_same_experiment():
    assert circuit.error(circuit.ours(1e-9)()) < 1e-9
    peer = circuit.scipy_peer("LSODA", circuit.optimised)(1e-9)()
    assert circuit.error(peer) < 1e-6
    assert gains.error(circuit.ours(1e-9, gains.some(10))()) < 1e-9


@pytest.mark.parametrize("name", sorted(problems.BY_HAND))
def test_reductions_by_hand_are_right(name):
    [problem] = [p for p in problems.problems() if p.name == name]
    assert problem.error(problems.by_hand(problem)(1e-10)()) < 1e-7


def test_parts_are_known_to_the_program_and_unknown_ones_refused(capsys):
    assert set(program.MEASURE) == set(PARTS)
    assert program.main(["circut"]) == 2
    assert "circut" in capsys.readouterr().err


def test_a_part_that_fails_keeps_its_old_numbers_and_stops_no_other(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(program, "JSON", tmp_path / "benchmarks.json")
    monkeypatch.setattr(program, "PAGE", tmp_path / "benchmarks.md")
    monkeypatch.setattr(program, "MEASURE", {
        "circuit": lambda: ([row(name="first")], {}), "cold": lambda: ([row(name="old")], {}),
    })
    assert program.main(["cold"]) == 0
    program.MEASURE["cold"] = lambda: 1 / 0
    assert program.main(["cold", "circuit"]) == 1
    data = json.loads(program.JSON.read_text("utf-8"))
    assert [r["name"] for r in data["rows"]] == ["first", "old"]
    assert program.PAGE.read_text("utf-8") == page(data)
    assert "old numbers kept: cold" in capsys.readouterr().err


def test_the_peer_of_the_cold_run_draws_the_same_figures(tmp_path, monkeypatch):
    result = make_result(gammas=(1e10,))
    write_run(with_figures(result, False), tmp_path, "")
    drawn = {}
    monkeypatch.setattr(
        plain_figures, "draw", lambda path, panels, **_: drawn.update({path.stem: len(panels)})
    )
    plain_figures.main(tmp_path, tmp_path)
    assert drawn == {name: len(panels) for name, panels in describe(result).items()}
