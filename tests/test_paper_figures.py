"""``gpebo figures``: recipes become pictures, tables and a page, the same every time."""

from __future__ import annotations

import csv
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from factories import make_result
from PIL import Image
from processes import read_table

from gpebo_cli.cli import app, figures
from gpebo_cli.cli import arguments as command_line
from gpebo_cli.cli.composition import session
from gpebo_cli.configs import configuration
from gpebo_cli.configs.locations import choices, conf_folder
from gpebo_cli.errors import ConfigError, GpeboError
from gpebo_cli.results import circuit, gallery
from gpebo_cli.results.figures import describe, overlay
from gpebo_cli.results.gallery import STUDIES
from gpebo_cli.results.series import blocks, blocks_text, differences, reference_text
from gpebo_cli.results.style import TIME, Axis, Curve, Panel, compose, line
from gpebo_cli.settings import Settings

TABLES = Path(__file__).parent / "data" / "paper"
OF_THE_PAPER = {
    "fig2_regressor",
    "fig3_states",
    "fig4_estimates_a",
    "fig5_estimates_b",
    "fig6_parameter_error",
    "fig7_state_error_a",
    "fig8_state_error_b",
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything, compared with the committed tables: an error would say which curve differs."""
    folder = tmp_path_factory.mktemp("figures") / "paper"
    assert figures.main(["--output", str(folder), "--check", str(TABLES)]) == 0
    return folder


def stems(folder: Path, suffix: str) -> set[str]:
    return {path.stem for path in folder.glob(f"*.{suffix}")}


def draw_only(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Of a recipe's figures, those with these names."""
    every = gallery.figures_of
    monkeypatch.setattr(
        gallery, "figures_of", lambda recipe: {name: every(recipe)[name] for name in names}
    )


# What is written


def test_there_is_a_recipe_for_every_study() -> None:
    assert set(choices(conf_folder(), "experiment")) >= set(STUDIES)


def test_figures_of_the_paper_with_their_numbers(written: Path) -> None:
    for recipe in ("paper_circuit", "paper_descriptor", "paper_canonical"):
        assert stems(written / recipe, "png") >= OF_THE_PAPER
    assert "fig1_circuit" in stems(written / "paper_circuit", "png")
    assert stems(written / "gain_sweep", "png") == {"fig_gains", "fig_error_norms"}
    assert stems(written / "estimators_compared", "png") == {"fig_estimators"}


def test_a_table_beside_every_picture(written: Path) -> None:
    for recipe in STUDIES:
        assert stems(written / recipe, "png") == stems(written / recipe, "csv")
        for path in (written / recipe).glob("*.png"):
            with Image.open(path) as image:
                image.load()
                assert image.width == 700  # one column at 200 dpi


def test_the_paper_s_gain_is_the_faster_one(written: Path) -> None:
    header, table = read_table(written / "paper_circuit" / "fig7_state_error_a.csv")
    slow, fast = (header.index(f"error of e1 (V): γ = {gain}") for gain in ("10⁸", "10¹⁰"))
    at_6s = int(np.flatnonzero(np.isclose(table[:, 0], 6.0))[0])
    assert table[at_6s, fast] < 1e-10
    assert table[at_6s, slow] > 0.1


def test_states_that_are_not_seen_are_not_drawn(written: Path) -> None:
    header, _ = read_table(written / "paper_canonical" / "fig8_state_error_b.csv")
    assert {name.partition(":")[0] for name in header[1:]} == {"error of zb1", "error of zb2"}


def test_the_literal_regressor_is_zero_and_the_page_says_what_follows(written: Path) -> None:
    _, table = read_table(written / "literal_regressor" / "fig2_regressor.csv")
    assert not table[:, 1:].any()
    assert "NOT interval-exciting" in (written / "index.html").read_text(encoding="utf-8")


def test_times_shrink_with_the_gain(written: Path) -> None:
    header, table = read_table(written / "gain_sweep" / "fig_gains.csv")
    assert header[0] == "gamma"
    np.testing.assert_allclose(table[:, 0], np.logspace(6, 12, 25))
    assert np.all(np.diff(table[:, header.index("time to 1 % (s): states")]) < 0)


def test_estimators_are_overlaid(written: Path) -> None:
    header, _ = read_table(written / "estimators_compared" / "fig_estimators.csv")
    names = {name.partition(": ")[2] for name in header[1:]}
    assert names == {"gradient", "least_squares", "mre", "drem", "lion", "ls_drem", "fct"}


def test_a_second_time_every_byte_is_the_same(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = ["paper_circuit"]
    draw_only(monkeypatch, "regressor", "estimates_a", "gram")
    assert figures.main([*names, "--output", str(tmp_path)]) == 0
    said = capsys.readouterr()
    counts = [f"{name}: {len(stems(tmp_path / name, 'png'))} figures" for name in names]
    assert (said.out.splitlines()[:-1], said.err) == (counts, "")
    for name in names:
        for path in (tmp_path / name).iterdir():
            assert path.read_bytes() == (written / name / path.name).read_bytes(), path.name


def test_other_formats_and_no_date_in_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    earlier = tmp_path / "literal_regressor" / "fig9_gone.png"
    earlier.parent.mkdir()
    earlier.write_bytes(b"")
    words = ["literal_regressor", "figures.formats=[pdf,svg]", f"--output={tmp_path}"]
    assert figures.main(words) == 0
    folder = tmp_path / "literal_regressor"
    for suffix in ("png", "pdf", "svg", "csv"):
        assert stems(folder, suffix) == {"fig2_regressor", "fig6_parameter_error"}
    assert b"CreationDate" not in (folder / "fig2_regressor.pdf").read_bytes()
    assert "<dc:date>" not in (folder / "fig2_regressor.svg").read_text(encoding="utf-8")
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "index.html")


# The page


class _Page(HTMLParser):
    """Collects what a page refers to."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[dict[str, str | None]] = []
        self.links: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "img":
            self.images.append(dict(attrs))
        self.links += [str(value) for key, value in attrs if key in ("src", "href")]


def test_the_page_stands_alone(written: Path) -> None:
    text = (written / "index.html").read_text(encoding="utf-8")
    page = _Page()
    page.feed(text)
    assert not page.tags & {"script", "link", "iframe"}
    assert "//" not in text.replace("<!DOCTYPE", "")  # no address of another machine
    shown = {str(image["src"]) for image in page.images}
    assert shown == {str(path.relative_to(written)) for path in written.glob("*/*.png")}
    for image in page.images:
        assert len(str(image["alt"])) > 40
        with Image.open(written / str(image["src"])) as picture:
            assert (int(str(image["width"])), int(str(image["height"]))) == picture.size
    for link in page.links:
        assert link.startswith("#") or (written / link).is_file(), link
    assert 'name="viewport"' in text


def test_the_page_says_whose_the_settings_are(written: Path) -> None:
    text = (written / "index.html").read_text(encoding="utf-8")
    assert "the horizon of 20 s, of which the paper states none" in text
    assert "the second gain, γ = 10⁸" in text
    assert "numpy" in text
    for number in range(1, 9):
        assert f"Fig. {number} of the paper" in text
    assert "5.024 s" in text  # to 1 % with the paper's gain


# Tables are what is drawn


def test_a_table_has_what_the_picture_has() -> None:
    for name, panels in describe(make_result(thin=7, samples=301)).items():
        text = blocks_text(blocks(panels)).splitlines()
        header, *rows = csv.reader(text)
        table = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
        for panel, axes in zip(panels, compose(panels).axes, strict=True):
            artists = axes.get_lines()[: len(panel.curves)]  # ticks and marks come after
            for curve, artist in zip(panel.curves, artists, strict=True):
                title = f"{panel.label}: {curve.label}" if curve.label else panel.label
                drawn = np.asarray(artist.get_ydata(), dtype=float)
                column = table[: len(drawn), header.index(title)]
                np.testing.assert_array_equal(column, drawn, err_msg=f"{name}, {title}")


def test_long_names_are_quoted_and_floats_survive() -> None:
    x = np.array([0.1, 1 / 3])
    panel = Panel('error, "of" it', (Curve(x, x / 7, "γ = 1, α = 2", line(0)),))
    text = blocks_text(blocks([panel]))
    [header, *rows] = csv.reader(text.splitlines())
    assert header == ["t", 'error, "of" it: γ = 1, α = 2']
    assert [[float(cell) for cell in row] for row in rows] == [[v, v / 7] for v in x]


# Gains as an axis


def gains_of(result: Any) -> list[Panel]:
    return dict(describe(result)).get("gains", [])


def test_gains_are_drawn_in_ascending_order_on_a_logarithmic_axis() -> None:
    gammas = (1e10, 1e6, 1e12, 1e8)
    panels = gains_of(make_result(gammas=gammas, samples=51))
    assert [panel.label for panel in panels] == ["final error", "time to 1 % (s)"]
    np.testing.assert_array_equal(panels[0].curves[0].x, sorted(gammas))
    axes = compose(panels).axes[-1]
    assert axes.get_xscale() == "log"
    assert axes.get_xlabel() == "gain γ"
    labels = [text.get_text() for text in axes.get_xticklabels()]
    assert labels == ["10⁶", "10⁷", "10⁸", "10⁹", "10¹⁰", "10¹¹", "10¹²"]


@pytest.mark.parametrize("cases", [
    [{"gamma": gamma} for gamma in (1e8, 1e10)],
    [{"gamma": gamma} for gamma in (0.0, 1.0, 2.0)],
    [{"gamma": 10.0**k, "alpha": float(k)} for k in (6, 8, 10)],
    [{"gamma": 1.0}, {"gamma": 2.0}, {"alpha": 2.0}], [{"gamma": 1.0}, {"gamma": 2.0}, {}],
], ids=["two", "zero", "two that vary", "others", "one without"])
def test_no_curve_over_gains(cases: list[Mapping[str, float]]) -> None:
    result = make_result(gammas=(1.0,) * len(cases), samples=21)
    assert result.estimation is not None
    result = replace(result, estimation=replace(result.estimation, cases=tuple(cases)))
    assert gains_of(result) == []
    assert ("error_norms" in dict(describe(result))) == (len(cases) > 2)


@pytest.mark.parametrize("unknown", [[], ["parameters"], ["states"], ["parameters", "states"]])
def test_errors_are_drawn_over_gains_where_any_truth_is_known(unknown: list[str]) -> None:
    result = make_result(gammas=(1e6, 1e8, 1e10), samples=21)
    assert result.metrics is not None
    if "parameters" in unknown:
        nobody = replace(result.metrics, final_error_parameters=np.full(3, np.nan))
        result = replace(result, metrics=nobody)
    if "states" in unknown:
        lost = replace(result.simulation, states=np.nan * result.simulation.states)
        result = replace(result, simulation=lost)
    assert bool(gains_of(result)) == (len(unknown) < 2)


def test_an_axis_of_less_than_two_decades_names_its_ends() -> None:
    curve = Curve(np.array([2.0, 3.0, 5.0]), np.ones(3), "", line(0))
    axes = compose([Panel("y", (curve,), axis=Axis("g", "gain", log=True))]).axes[0]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["2", "5"]
    assert TIME.name == "t"


def test_norms_are_of_all_errors() -> None:
    result = make_result(gammas=(1e10,), samples=31)
    assert result.estimation is not None
    assert result.regression is not None
    parameters, states = overlay({"one": result})
    error = result.estimation.parameters[0] - result.estimation.true_parameters
    np.testing.assert_allclose(parameters.curves[0].y, np.sqrt((error**2).sum(axis=1)))
    assert states.curves[0].label == "one"


# The circuit


def test_currents_of_the_drawing_obey_the_plant_s_equations() -> None:
    """Kirchhoff's current law at e1 and e2, and the sign of every element's voltage."""
    plant = yaml.safe_load((Path(conf_folder()) / "plant" / "circuit.yaml").read_text())
    states, A = plant["states"], plant["A"]
    for row, node in enumerate(("e1", "e2")):
        into = {b.current: (b.end == node) - (b.start == node) for b in circuit.BRANCHES}
        for name, entry in zip(states, A[row], strict=True):
            if name not in ("e1", "e2"):
                assert entry == into[name], (node, name)

    def voltage(element: str) -> list[int]:
        [branch] = [b for b in circuit.BRANCHES if b.element == element]
        return [(branch.start == name) - (branch.end == name) for name in states]

    def entries(row: int) -> list[int]:
        return [entry if isinstance(entry, int) else 0 for entry in A[row]]

    told = [gallery._branch_text(branch) for branch in circuit.BRANCHES[:2]]
    assert told == ["V from ground to e1 with current iv", "C1 from e1 to ground"]
    assert entries(2) == voltage("L")  # (L il)' = its voltage
    assert entries(3) == voltage("R1")  # voltage + R1 ir1 = 0
    assert A[3][states.index("ir1")] == "R1"
    assert entries(4) == [-v for v in voltage("R2")]  # −voltage + R2 ir2 = 0
    assert A[4][states.index("ir2")] == "R2"
    assert entries(5) == voltage("V")  # voltage − V = 0
    assert plant["B"][5] == [-1]


def test_without_schemdraw_the_circuit_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(circuit, "available", lambda: False)
    draw_only(monkeypatch, "delta")
    assert figures.main(["paper_circuit", "--output", str(tmp_path)]) == 0
    assert stems(tmp_path / "paper_circuit", "png") == {"fig_delta"}
    assert re.fullmatch(r"Fig\. 1 is left out: .*schemdraw.*\n", capsys.readouterr().err)


# Comparison


def decaying(rate: float) -> list[Panel]:
    """e^(−rate t), which reaches 1e-9 at the end."""
    t = np.linspace(0.0, 20.0, 201)
    curve = Curve(t, np.exp(-rate * t), "γ = 1", line(0))
    return [Panel("error of e1", (curve,), log=True, size=1.0)]


def compare(panels: list[Panel], reference: list[Panel], folder: Path) -> list[str]:
    path = folder / "reference.csv"
    path.write_text(reference_text(reference), encoding="utf-8")
    return list(differences(panels, path))


def test_a_reference_goes_from_the_first_time_to_the_last() -> None:
    rows = reference_text(decaying(1.0)).splitlines()[1:]
    assert [float(row.split(",")[0]) for row in rows] == pytest.approx(np.arange(0.0, 20.1, 0.5))
    assert rows[1].split(",") == ["0.5", "0.6065306597"]  # e^(-1/2) in 10 digits


def test_a_difference_says_which_curve_where_and_by_how_much(tmp_path: Path) -> None:
    assert compare(decaying(1.0), decaying(1.0), tmp_path) == []
    assert compare(decaying(1.0 + 1e-6), decaying(1.0), tmp_path) == []
    [text] = compare(decaying(1.0 + 2e-4), decaying(1.0), tmp_path)
    assert re.fullmatch(
        r"error of e1: γ = 1: at t = [\d.]+ it is \S+, the reference \S+; they differ by \S+, "
        r"\S+ is allowed",
        text,
    )
    t = np.linspace(0.0, 1.0, 41)
    moved = np.maximum(t, 0.01)  # where the reference is zero
    one, other = ([Panel("y", (Curve(t, y, "", line(0)),))] for y in (moved, t))
    assert len(compare(one, other, tmp_path)) == 1
    one, other = ([Panel("y", (Curve(t, y, "", line(0)),))] for y in (-1.1 * t, -t))
    assert len(compare(one, other, tmp_path)) == 1


def test_rounding_is_no_difference(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    t = np.linspace(0.0, 1.0, 41)

    def noise() -> list[Panel]:
        values = np.abs(rng.standard_normal(41)) * 1e-14
        values[::5] = 0.0
        return [Panel("error", (Curve(t, values, "", line(0)),), log=True, size=3.0)]

    assert compare(noise(), noise(), tmp_path) == []
    falls = [[Panel("y", (Curve(t, y, "", line(0)),))] for y in (-1e6 * t, 5e-4 - 1e6 * t)]
    assert compare(*falls, tmp_path) == []


def test_curves_that_come_go_or_end_are_differences(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 41)
    curves = [Curve(t, t, name, line(0)) for name in "abc"]
    found = compare([Panel("y", tuple(curves[:2]))], [Panel("y", tuple(curves[1:]))], tmp_path)
    assert found == [
        "y: a: there is no such curve in the reference",
        "y: c: there is no such curve any more",
    ]
    ended = Curve(t, np.where(t > 0.5, np.nan, t), "a", line(0))
    [text] = compare([Panel("y", (ended,))], [Panel("y", (curves[0],))], tmp_path)
    assert "it is nan" in text
    other = replace(curves[0], x=t**2, y=t**2)
    assert compare([Panel("y", (other,))], [Panel("y", (curves[0],))], tmp_path) == [
        "t does not have the values of the reference among its own"
    ]


def test_a_changed_table_fails_the_check(tmp_path: Path) -> None:
    shutil.copytree(TABLES / "literal_regressor", tmp_path / "ref" / "literal_regressor")
    path = tmp_path / "ref" / "literal_regressor" / "fig6_parameter_error.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    cells = lines[11].split(",")
    lines[11] = ",".join([*cells[:-1], "2.01"])
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    shutil.copy(path, path.with_name("fig9_gone.csv"))
    words = ["literal_regressor", "--output", str(tmp_path), "--check", str(tmp_path / "ref")]
    with pytest.raises(GpeboError) as caught:
        figures.main(words)
    assert caught.value.exit_code == 1
    message = str(caught.value)
    assert "2 differences" in message
    assert (
        "literal_regressor/fig6_parameter_error, error of e0_il (A): drem: at t = 5 it is 2, "
        "the reference 2.01" in message
    )


def test_update_writes_what_check_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = str(tmp_path / "tables")
    words = ["literal_regressor", "--quiet", "--output", str(tmp_path)]
    figures.main([*words, "--update", where])
    figures.main([*words, "--check", where])
    assert capsys.readouterr().out == ""
    assert stems(tmp_path / "tables" / "literal_regressor", "csv") == stems(
        TABLES / "literal_regressor", "csv"
    )
    _, rows = read_table(tmp_path / "tables" / "literal_regressor" / "fig2_regressor.csv")
    assert (rows[0, 0], len(rows)) == (0.0, 41)


@pytest.mark.parametrize("content", ["", "t,y\n", "t,y\n1,2,3\n", "t,y\n1,x\n", "t,y\n,1\n"])
def test_what_is_no_table_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(content)
    with pytest.raises(GpeboError, match=r"table\.csv(, line|:)"):
        list(differences(decaying(1.0), path))


def test_the_tables_hold_for_another_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not merely what collocation once printed: solve_ivp gives the same."""
    read_settings = configuration.settings

    def with_ivp(config: Mapping[str, Any], *, draw: bool) -> Settings:
        built = read_settings(config, draw=draw)
        return replace(built, solver=replace(built.solver, name="ivp"))

    monkeypatch.setattr(configuration, "settings", with_ivp)
    for recipe in figures.run_recipes(["paper_descriptor"]):
        panels = gallery.figures_of(recipe)
        assert list(gallery.check_references(TABLES, recipe.name, panels)) == []


@pytest.mark.parametrize(("section", "labels"), [
    ("{}", [""]), ("{mode: MULTIRUN}", [""]),
    ("{sweeper: {params: {time.horizon: '1,2'}}}", [""]),  # one run, as `gpebo run` makes it
    ("{mode: MULTIRUN, sweeper: {params: {time.horizon: '1,2'}}}", ["1", "2"]),
    ("{mode: MULTIRUN, sweeper: {params: {plant: 'published/akzo,circuit'}}}", ["akzo", "circuit"]),
])
def test_a_recipe_is_a_sweep_where_it_says_so(
    tmp_path: Path, section: str, labels: list[str]
) -> None:
    (tmp_path / "experiment").mkdir()
    text = f"# @package _global_\ntitle: x\nhydra: {section}\n"
    (tmp_path / "experiment" / "x.yaml").write_text(text)
    with session(command_line.parse(["--config-dir", str(tmp_path)])) as hydra:
        jobs = list(figures.recipe_jobs("x", hydra.config_loader))
    assert [label for label, _ in jobs] == labels


def test_the_tables_are_small() -> None:
    sizes = [path.stat().st_size for path in TABLES.rglob("*.csv")]
    assert len(sizes) >= 24
    assert sum(sizes) < 150_000


# Words


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["paper_circut"], "no recipe 'paper_circut'; known: .*did you mean paper_circuit"),
        (["figures.formats=[jpg]"], "expected png or pdf or svg, got .jpg.; did you mean png"),
        (["--ouput=x"], "'--ouput' is no option; .*did you mean --output"),
        (["--output"], "--output needs a folder"),
        (["--check", "nowhere"], "--check nowhere: there is no such folder"),
        (["time.horizon=3"], "'time.horizon' is no option"),
    ],
)
def test_wrong_words(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        figures.main(words)


def test_help(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["gpebo", "figures", "--help"])
    assert app.main() == 0
    assert capsys.readouterr().out.startswith("usage: gpebo figures")
