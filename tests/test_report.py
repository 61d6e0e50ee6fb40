"""``gpebo report``: one page with everything in it; and what is compared with what."""

from __future__ import annotations

import base64
import json
import math
import os
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from examples import gpebo
from factories import make_result, with_figures
from processes import assert_refused, refused

from gpebo_cli import run
from gpebo_cli.cli import check, compare, report
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.experiment.result import Fit, NoiseStatistics
from gpebo_cli.findings import Assumption
from gpebo_cli.results import comparison, document, html
from gpebo_cli.results.comparison import figures
from gpebo_cli.results.finished import find
from gpebo_cli.results.folder import write_run
from gpebo_cli.results.names import METRICS, SETTLED, ranking, shown_metrics
from gpebo_cli.results.provenance import GitState, Provenance
from gpebo_cli.results.report import case_table, estimate_table, loud_lines, noise_table
from gpebo_cli.results.symbols import number_text, with_unit
from gpebo_cli.results.tables import write_noise
from gpebo_cli.schema import instant

FAST = ("time.samples=51", "time.horizon=8")


class Page(HTMLParser):
    """Collects what a page is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [str(value) for key, value in attrs if key in ("src", "href")]

    def handle_data(self, data):
        self.text.append(data)


def done(*words, cwd):
    made = gpebo(*words, cwd=cwd)
    assert made.returncode == 0, made.stderr
    return made


def test_an_estimate_stands_since_it_is_within_a_hundredth_of_its_end():
    """1 − e^(−2t) at whole seconds: e⁻⁴ is more, e⁻⁶ is less."""
    plant = {"name": "still", "states": ["x"], "outputs": ["y"], "E": [[1]], "A": [[0]],
             "C": [[1]], "initial_state": [1]}
    found = run(plant, estimator="gradient", gamma=2, time={"horizon": 10, "samples": 11})
    (row,) = [line for line in estimate_table(found.details) if "e0_x" in line]
    assert "  3 s  " in row


def test_times_of_a_clock_are_told_to_hundredths_of_a_second():
    start = 1764259200.0
    t = start + np.arange(0.0, 10.01, 0.05)
    plant = {"name": "still", "states": ["x"], "outputs": ["y"], "E": [[1]], "A": [[0]],
             "C": [[1]], "initial_state": [1]}
    found = run(plant, estimator="least_squares", data={"t": t, "y": np.cos(t)})
    since = [found.excitation.t_c, found.excitation.determined]
    assert f"interval-exciting from t = {round(since[0], 2):.15g} s on" in found.verdict
    assert f"well determined from t = {round(since[1], 2):.15g} s on" in found.verdict
    (row,) = [line for line in estimate_table(found.details) if "e0_x" in line]
    assert row.count("  1764259") + row.count("from 1764259") == 2
    evidence = {"at": found.excitation.t_c, "condition": 123456.0}
    told = check._table("", [Assumption("A", "s", True, evidence)], [])
    assert f"at {round(since[0], 2):.15g}, condition 1.235e+05" in told
    assert [instant(x) for x in (0.0496249, 9999.4, 20000.0)] == ["0.04962", "9999", "20000"]


def test_every_cell_of_the_table_of_estimates():
    """Of the case that explains most: ±2σ where they are known, 1 % elsewhere, or not moved."""
    made = make_result((1.0, 2.0), samples=11, parameters=("e0_e1", "e0_e2", "w_il"))
    states, eta = np.ones((2, 11, 6)), np.ones((2, 11, 3))
    states[1] = [0.5, np.nan, np.nan, 3.0, 4.0, 5.0]
    eta[1] = [7.0, 8.0, 9.0]
    eta[1, :4, 0] = [7.0, 6.0, 7.01, 6.8]  # since the fifth time, 8 s, within 1 % of the end
    found = replace(
        made.estimation, states=states, parameters=eta,
        states_std=np.full((2, 11, 6), 0.125), parameters_std=np.full((2, 11, 3), np.nan),
    )
    made = replace(
        made, estimation=found, fit=Fit(np.array([2.0, 1.0]), 1.0, 1.0), left_out=("il",),
        estimable={"e1": 0.0, "e2": None, "il": None, "e0_e1": 2.5, "e0_e2": None},
    )
    known = [
        ["e0_e1", "7", "V", "8 s", "from 2.5 s"], ["e0_e2", "8", "V", "0 s", "no"],
        ["w_il", "9"], ["e1", "0.5", "0.12", "V", "from 0 s"], ["e2", "not determined", "V", "no"],
        ["il", "left out", "A", "no"], ["ir1", "3", "0.12", "A"], ["ir2", "4", "0.12", "A"],
        ["iv", "5", "0.12", "A"],
    ]

    def cells(result):
        return [re.split(" {2,}", line.strip()) for line in estimate_table(result)]

    head, *rows = cells(made)
    assert head == ["estimate", "± std", "unit", "within 1 % of the end since", "estimable"]
    assert rows == known
    settled = {"e0_e1": np.array([1.0, 6.0]), "e0_e2": np.full(2, np.nan)}
    made = replace(made, metrics=replace(made.metrics, seconds_to_settled=settled))
    head, *rows = cells(made)
    assert head[3] == "within ±2σ of the end since"
    known[:2] = ["e0_e1", "7", "V", "6 s", "from 2.5 s"], ["e0_e2", "8", "V", "no"]
    assert rows == known
    eta[1, :, 2] = np.nan
    assert cells(made)[3] == ["w_il", "not determined"]
    eta[1, 1:, 0] = 7.0 + 1e-5  # by rounding
    made = replace(made, estimation=replace(found, still=np.array([False, True])))
    assert cells(made)[1] == ["e0_e1", "not moved from 7", "V", "from 2.5 s"]


@pytest.mark.parametrize(("count", "shown"), [(12, 12), (13, 12), (30, 12)])
def test_of_many_cases_the_first_and_the_last_are_printed(count, shown):
    head, *rows = case_table(make_result(gammas=tuple(range(1, count + 1)), samples=5))
    told = [row.split()[0] for row in rows if "…" not in row]
    assert re.split(" {2,}", head.strip())[1:] == list(METRICS.values())[:4]
    assert head.split()[0] == "gamma"
    assert told == [str(k) for k in (*range(1, 7), *range(count - 5, count + 1))]
    assert rows[6:7] == ([f"… {count - 12} more in cases.csv"] if count > 12 else rows[6:7])
    assert len(told) == shown


def test_verbose_runs_say_what_solvers_did():
    numbers, versions = loud_lines(make_result(samples=5))
    assert numbers == "index 2, 40 elements, error estimates states 3e-13, regression 2e-13"
    assert f", numpy {np.__version__}, scipy " in versions


@pytest.mark.parametrize(("cases", "shown", "first"), [
    ([{}, {}], [*METRICS], "seconds_to_1pct_parameters"),
    ([{SETTLED: 1.0}], [SETTLED, *list(METRICS)[2:]], "rms_error_states"),
    ([{SETTLED: 1.0}, {}], [SETTLED, *METRICS], "rms_error_states"),
])
def test_under_noise_cases_are_ranked_by_their_error_over_the_whole_run(cases, shown, first):
    assert list(shown_metrics(cases)) == shown
    assert ranking(cases) == first


@pytest.mark.parametrize("count", [40, 41, 45])
def test_of_many_cases_a_comparison_prints_the_best(tmp_path, capsys, count):
    gains = tuple(1e8 * (k + 1) for k in range(count))
    write_run(with_figures(make_result(gammas=gains, samples=5), False), tmp_path / "run", "")
    assert compare.main([str(tmp_path / "run"), "--no-figures"]) == 0
    _, *rows = capsys.readouterr().out.splitlines()
    column = [float(row.split()[2]) for row in rows[:40]]
    assert column == sorted(gains, reverse=True)[:40]  # larger ones are faster
    assert rows[40:] == ([f"… {count - 40} more; --csv FILE has all"] if count > 40 else [])
    assert compare.main([str(tmp_path / "run"), "--no-figures", "--sort", "plant"]) == 0
    assert capsys.readouterr().out.split()[:2] == ["run", "plant"]  # though it is the same for all


def test_errors_over_seeds_are_told_by_case_and_parameter(tmp_path):
    result = make_result(gammas=tuple(range(1, 6)), samples=5)
    bias = np.arange(1.0, 16.0).reshape(5, 3)
    noise = NoiseStatistics(7, 1.0, ("a", "b", "c"), np.array([4.0, 5.0, 6.0]), bias, 2 * bias,
                            3 * bias)
    head, *rows, more = noise_table(noise)
    assert "over 7 seeds" in head
    assert [row.split() for row in rows] == [
        [str(k), name, *(f"{n * bias[k, i]:.2e}" for n in (1, 2, 3))]
        for k in range(4) for i, name in enumerate(noise.names)
    ]
    assert more == "… 1 more cases in noise.csv"
    write_noise(tmp_path / "noise.csv", result.estimation, noise)
    table = pd.read_csv(tmp_path / "noise.csv")
    assert table["case"].tolist() == np.repeat(range(5), 3).tolist()
    assert (table["gamma"] == table["case"] + 1).all()
    assert table["parameter"].tolist() == ["a", "b", "c"] * 5
    assert table["truth"].tolist() == [4.0, 5.0, 6.0] * 5
    for n, name in enumerate(("bias", "deviation", "rms"), start=1):
        assert table[name].tolist() == (n * bias).ravel().tolist()
    assert set(table["seeds"]) == {7}
    few = replace(noise, bias=bias[:4])
    assert len(noise_table(few)) == 13
    many = replace(noise, names=[f"p{k}" for k in range(13)], bias=np.ones((2, 13)),
                   deviation=np.ones((2, 13)), rms=np.ones((2, 13)))
    assert len(noise_table(many)) == 1 + 13 + 1  # one case at least, and no more


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run, a recording, a sweep with a job that fails, and a run of another plant."""
    path = tmp_path_factory.mktemp("report")
    done("run", "estimator.gamma=[1e8,1e10]", "figures=[gram,states]", "figures.formats=[png,svg]",
         *FAST, "hydra.run.dir=circuit", cwd=path)
    done("run", "plant=descriptor", "estimator=ls_drem", "figures=none", *FAST,
         "hydra.run.dir=other", cwd=path)
    table = pd.read_csv(path / "circuit" / "signals.csv")
    table[["t", "V", "y"]].to_csv(path / "r.csv", index=False)
    done("run", "data.file=r.csv", "estimator=ls_drem", "figures=none", "hydra.run.dir=recorded",
         cwd=path)
    gpebo("run", "-m", "estimator.gamma=1e6,1e8,1e10", *FAST, "hydra.sweep.dir=sweep",
          "plant=circuit", cwd=path)
    return path


@pytest.fixture
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def page_of(*words: str) -> tuple[Page, str]:
    assert report.main([*words, "--output", "page.html"]) == 0
    text = Path("page.html").read_text(encoding="utf-8")
    return Page(text), text


@pytest.mark.parametrize(("git", "said"), [
    (GitState("c0ffee", True), "Commit <code>c0ffee</code>, with changes that are not committed."),
    (GitState("c0ffee", False), "Commit <code>c0ffee</code>."), (None, None),
])
def test_a_page_says_what_made_it(git, said):
    foot = html.footer(Provenance({"gpebo": "0.1.0", "numpy": None, "scipy": "1.2"}, git))
    assert "<p>gpebo 0.1.0, scipy 1.2.</p>" in foot
    assert ("Commit" in foot) == (git is not None)
    assert said is None or said in foot
    assert html.table([]) == ""


def test_rows_that_fail_are_marked_by_their_numbers_below_the_header():
    written = html.table([["name"], ["a"], ["b"]], failed=[1])
    assert [line for line in written.splitlines() if "class=fails" in line] == [
        "<tr class=fails><td>b</td></tr>"
    ]


def test_a_run_is_on_the_page_with_all_that_it_rests_on(inside):
    page, _ = page_of("circuit")
    summary = json.loads((inside / "circuit" / "summary.json").read_text())
    words = " ".join(page.text)
    assert summary["verdict"] in words
    assert " · ".join(summary[key] for key in ("plant", "title", "reference")) in words
    assert f"observer gpebo, estimator {summary['estimator']['name']}" in words
    for assumption in summary["assumptions"]:
        assert assumption["statement"] in words
    assert (inside / "circuit" / "config.yaml").read_text() in words
    assert f"numpy {summary['versions']['numpy']}" in words
    assert f"{float(pd.read_csv('circuit/signals.csv')['il'].iloc[-1]):.4g}".lstrip("-") in words
    pictures = [source for source in page.sources if source.startswith("data:image/png;base64,")]
    files = sorted((inside / "circuit" / "figures").glob("*.png"))
    assert [base64.b64decode(p.partition(",")[2]) for p in pictures] == [
        path.read_bytes() for path in files
    ]
    assert len(files) == 2


@pytest.mark.parametrize(("name", "cases"), [("circuit", ["0", "1"]), ("other", [])])
def test_estimates_of_every_case_stand_beside_their_truth(inside, name, cases):
    page, _ = page_of(name)
    cells = [text for text in page.text if text.strip()]
    found = json.loads((inside / name / "summary.json").read_text())["estimates"]
    each = [found[case] for case in cases] or [found]
    for key, first in each[0].items():
        row = [with_unit(key, first["unit"] or ""), *(one[key]["value"] for one in each)]
        row = [x if isinstance(x, str) else number_text(x) for x in (*row, first["true"])]
        start = cells.index(row[0])
        assert cells[start : start + len(row)] == row


def test_a_picture_that_is_none_or_too_large_is_left_out(inside, tmp_path, monkeypatch):
    shutil.copytree("circuit", tmp_path / "run")
    (tmp_path / "run" / "figures" / "gram.png").write_text("no picture")
    assert len(page_of(str(tmp_path / "run"))[0].sources) == 1
    monkeypatch.setattr(document, "_LARGEST", 10)
    assert not page_of(str(tmp_path / "run"))[0].sources


def test_the_page_needs_nothing_else(inside):
    page, text = page_of("circuit", "sweep", "recorded")
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert all(source.startswith("data:") for source in page.sources)
    assert "default-src 'none'" in text


def test_a_recording_and_a_sweep_are_told(inside):
    words = " ".join(page_of("recorded")[0].text)
    assert "file r.csv" in words
    assert "e0_il (A)" in words
    assert "truth" not in words  # nobody knows it, nor when the error was small
    assert "never" not in words
    assert " α " in words  # with one case its gains are told, though nothing differs
    page, _ = page_of("sweep")
    words = " ".join(page.text)
    assert "3 of 3 jobs are done" in words
    assert words.count("estimator.gamma=") >= 3
    assert len([s for s in page.sources if s.startswith("data:image")]) >= 2


def test_a_job_that_failed_is_named_with_its_error(inside, tmp_path):
    shutil.copytree("sweep", tmp_path / "sweep")
    path = tmp_path / "sweep" / "1" / "result.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"status": "failed", "error": "<b>no</b> & never"}))
    page, _ = page_of(str(tmp_path / "sweep"))
    assert "2 of 3 jobs are done" in " ".join(page.text)
    assert "<b>no</b> & never" in " ".join(page.text)
    assert "b" not in page.tags


def test_the_same_page_every_time(inside):
    assert page_of("circuit", "sweep")[1] == page_of("circuit", "sweep")[1]


@pytest.mark.parametrize("content", [b"[]", b"{", b"\xff", b'{"assumptions": 3}',
                                     b'{"estimator": {}, "versions": [1], "warnings": 3}',
                                     b'{"assumptions": [{}]}'])
def test_what_is_no_run_is_named(inside, tmp_path, content):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.json").write_bytes(content)
    with pytest.raises(GpeboError, match=r"summary\.json: not"):
        page_of(str(tmp_path / "run"))


def test_titles_from_strangers_are_text(inside, tmp_path):
    shutil.copytree("other", tmp_path / "run")
    path = tmp_path / "run" / "summary.json"
    bad = "<img src=http://x onerror=alert(1)>"
    summary = json.loads(path.read_text()) | {"title": bad, "verdict": bad}
    path.write_text(json.dumps(summary))
    page, _ = page_of(str(tmp_path / "run"))
    assert not page.sources
    assert " ".join(page.text).count(bad) == 2


@pytest.mark.parametrize("words", [
    ["nowhere"], ["--ouput=x", "circuit"], [], ["."], ["circuit", "--output", "sweep"],
])
def test_wrong_words_of_report(inside, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path if words == ["."] else inside)
    with pytest.raises(ConfigError):
        report.main(words)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_browser_shows_it(inside, tmp_path):
    page_of("circuit")
    shot = tmp_path / "page.png"
    subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--screenshot={shot}",
         "--window-size=1000,1400", f"--user-data-dir={tmp_path}", f"file://{inside}/page.html"],
        check=True, capture_output=True, timeout=90, env={**os.environ, "HOME": str(tmp_path)},
    )
    from PIL import Image

    with Image.open(shot) as image:
        colours = image.convert("RGB").getcolors(1 << 24)
    assert colours is not None
    assert len(colours) > 50  # curves and text, and not an empty page


# What is compared


def test_plants_and_horizons_have_figures_of_their_own(inside):
    done("run", "time.horizon=4", "time.samples=51", "figures=none", "hydra.run.dir=shorter",
         cwd=inside)
    assert compare.main(["circuit", "other", "shorter", "--output", "compared"]) == 0
    names = {path.stem for path in (inside / "compared").glob("errors*.png")}
    assert names == {"errors_circuit_1", "errors_descriptor", "errors_circuit_2"}


def test_figures_of_plants_in_subfolders_are_files_of_their_own(inside):
    """A sweep chooses published/akzo, and that is no folder to write to."""
    circuit, other = (found.cases[0] for name in ("circuit", "other") for found in find(name))
    chosen = [
        replace(case, chosen={**case.chosen, "plant": plant}) for case, plant in
        ((circuit, "published/akzo"), (other, "published_akzo"), (other, "published/hires"))
    ]
    names = [name for name, _ in figures(chosen)]
    assert names == [
        "errors_published_akzo_1", "errors_published_akzo_2", "errors_published_hires"
    ]


def test_what_is_no_run_in_a_folder_of_runs_is_passed_over(tmp_path):
    for name in ("b", "a", "empty"):
        (tmp_path / name).mkdir()
    for file in ("b/summary.json", "a/summary.json", "notes.txt"):
        (tmp_path / file).write_text("{}")
    assert [Path(found.path).name for found in find(str(tmp_path))] == ["a", "b"]


@pytest.mark.parametrize(("values", "drawn"), [
    ([1.0, 2.0, 3.0], ["over_x"]), ([0.0, 1.0, 2.0], []), ([1.0, 2.0, 3.0, math.inf], []),
    (["a", "b", "c"], []),
])
def test_axes_are_of_positive_numbers(inside, monkeypatch, values, drawn):
    """They are logarithmic."""
    monkeypatch.setattr(comparison, "compose", lambda panels: panels)
    case = find("circuit")[0].cases[0]
    cases = [replace(case, chosen={**case.chosen, "x": x}) for x in values]
    assert [name for name, _ in figures(cases)] == ["errors", *drawn]


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("cases.csv", lambda text: text.replace("100000000,", "1.2x3,", 1), "line 2, column gamma"),
        *(
            ("cases.csv", lambda text, cell=cell: text.replace("100000000,", f"{cell},", 1),
             "line 2, column gamma: ") for cell in ("1e999", "1_0", "１", " 1", "nan", "0x1")
        ),
        ("cases.csv", lambda text: text.replace("\n0,", "\ninf,", 1), "line 2, column case"),
        ("summary.json", lambda text: text.replace('"value": ', '"value": 1e999, "": ', 1), "JSON"),
        ("summary.json", lambda text: text.replace('"value": ', '"x": NaN, "value": ', 1), "JSON"),
        ("cases.csv", lambda text: text.replace("\n0,", "\n7,", 1), "there is no case 7"),
        ("cases.csv", lambda text: text + "1,2\n", "line 4: 2 cells; the header has"),
        ("cases.csv", lambda text: text.replace("case,", "csae,", 1), "there is no column case"),
        ("cases.csv", lambda text: text.replace("\n0,", "\n,", 1), "line 2, column case"),
        ("cases.csv", lambda text: "", "not a table with a header"),
        ("cases.csv", lambda text: text.split("\n")[0], "there are no rows below its header"),
        ("cases.csv", lambda text: text.replace("rms_error_states", "rms", 1), "no column rms_"),
        ("estimates.csv", lambda text: text.replace("_hat", "", 1), "line 1: there is no column "),
        ("summary.json", lambda text: "[" * 100_000, "not JSON"),
        ("estimates.csv", lambda text: text.replace("\n0,", "\n0,x", 1), "line 2, column t: 'x0'"),
    ],
)
def test_what_is_wrong_in_a_table_is_named(inside, tmp_path, file, change, said):
    shutil.copytree("circuit", tmp_path / "run")
    path = tmp_path / "run" / file
    path.write_text(change(path.read_text()))
    where = tmp_path / "run" / ("estimates.csv" if "no case" in said else file)
    with refused(str(where), said, by=GpeboError):
        compare.main([str(tmp_path / "run"), "--output", str(tmp_path / "out")])


def test_bytes_that_are_no_text_are_named(inside, tmp_path):
    shutil.copytree("circuit", tmp_path / "run")
    path = tmp_path / "run" / "cases.csv"
    path.write_bytes(path.read_bytes() + b"\xff\n")
    with pytest.raises(GpeboError, match=r"cases\.csv, line 4: not UTF-8"):
        compare.main([str(tmp_path / "run")])


# Figures of a run


def test_formats_are_written_and_text_in_a_pdf_is_text(inside):
    assert {p.name for p in (inside / "circuit" / "figures").iterdir()} == {
        "gram.png", "gram.svg", "states.png", "states.svg",
    }
    looks = ["formats=[pdf]", "width=page", "dpi=100", "style=ggplot", "error=linear"]
    done("run", "figures=[states]", *(f"figures.{look}" for look in looks), *FAST,
         "hydra.run.dir=styled", cwd=inside)
    content = (inside / "styled" / "figures" / "states.pdf").read_bytes()
    assert b"/Subtype /Type0" in content or b"/TrueType" in content
    assert b"/Type3" not in content


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("figures.formats=[jpg]", "png or pdf or svg"),
        ("figures.formats=[]", "figures.formats"),
        ("figures.width=colum", "column or page"),
        ("figures.width=0.1", "1.5 to 40 inches"),
        ("figures.style=nope", "matplotlib has no style 'nope'"),
        ("figures.error=lin", "log or linear"),
        ("figures.dpi=1e9", "dpi"),
        ("figures.colour=red", "colour"),
        ("figures=[gains]", "this run has nothing for gains"),
    ],
)
def test_what_figures_cannot_be_is_one_line(tmp_path, word, said):
    assert_refused(gpebo("run", word, *FAST, "hydra.run.dir=refused", cwd=tmp_path), said)
    assert not (tmp_path / "refused").exists()
