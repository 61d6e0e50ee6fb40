"""Files from strangers: whatever they say, no code runs, nothing is written elsewhere, one line.

Every attack is made in a recipe and, by turns, in one of the other kinds of files that gpebo reads
from a ``--config-dir``, and tried on the command line and from Python. A file that an attack would
make is called ``MARKER``.
"""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest
from hydra.core.hydra_config import HydraConfig
from hypothesis import given, settings
from hypothesis import strategies as st
from inprocess import gpebo
from omegaconf import OmegaConf
from plants import DECAYING
from processes import assert_refused, refused

from gpebo_cli import run
from gpebo_cli.configs.configuration import KEYS
from gpebo_cli.errors import ConfigError
from gpebo_cli.plain_yaml import dump, parse

REGRESSION = "name: mine\nunknowns: {a: 1}\nsignals: {u: sin(t), y: sin(t)}\nY: [y]\npsi: [[u]]\n"
RECIPE = "time: {horizon: 0.1, samples: 3}\nfigures: none\n"
SHORT = ["observer=none", "figures=none", "time.horizon=0.1", "time.samples=3"]

CALL = "{_target_: os.mkdir, _args_: [MARKER]}"
PAYLOADS = {
    "callback": "hydra: {callbacks: {x: CALL}}",
    "launcher": "hydra: {launcher: CALL}",
    "sweeper": "hydra: {sweeper: CALL}",
    "sweep": "hydra: {mode: MULTIRUN, sweeper: {params: {+hydra.callbacks.x: 'CALL'}}}",
    "sweep of hydra": "hydra: {mode: MULTIRUN, sweeper: {params: {hydra.sweep.dir: MARKER}}}",
    "logging": "hydra: {job_logging: {version: 1, formatters: {a: {(): os.mkdir, path: MARKER}}}}",
    "environment": "hydra: {job: {env_set: {OWNED: 'yes'}}}",
    "folder": "hydra: {run: {dir: MARKER}}",
    "chdir": "hydra: {job: {chdir: true}}",
    "search path": "hydra: {searchpath: ['file://FOLDER/docs']}",
    "dotted": "hydra.callbacks.x._target_: os.mkdir",
    "another case": "Hydra: {callbacks: {x: CALL}}",
    "value": "title: CALL",
    "sweep of an interpolation":
        r"hydra: {mode: MULTIRUN, sweeper: {params: {title: '$\{oc.env\:SECRET\}'}}}",
    "deep": "time: {horizon: CALL}",
    "interpolation": "title: '${oc.env:SECRET}'",
    "escaped interpolation": 'title: "\\x24{oc.env:SECRET}"',
    "key": "'${oc.env:SECRET}': 1",
    "defaults": "defaults: [{/docs@_global_.hydra.callbacks.x: extra}]",
    "defaults of hydra": "defaults: [{override /hydra/launcher: mine}]",
    "defaults elsewhere": "defaults: [{/plant@hydra.callbacks: circuit}]",
    "defaults of docs": "defaults: [/docs/extra]",
    "defaults above": "defaults: [{/experiment: ../docs/extra}]",
    "defaults of itself": "defaults: [{/experiment: x}]",
}
FORMS = {
    "plain": "P",
    "global": "# @package _global_\nP",
    "elsewhere": "# @package hydra.callbacks\nP",
    "directive": "%YAML 1.3\n---\n# @package _global_\nP",
    "directive 1.1": "# @package _global_\n%YAML 1.1\n---\nP",
    "tag directive": "%TAG ! tag:yaml.org,2002:python/\n---\nP",
    "line separator": "# a\u2028# @package _global_\nP",
    "next line": "# a\x85# @package _global_\nP",
    "byte order mark": "\ufeff# @package _global_\nP",
    "merge": "# @package _global_\n<<: {P}",
    "merges": "# @package _global_\n<<: [{P}, {a: 1}]",
    "merged anchor": "# @package _global_\ntitle: &a {P}\n<<: *a",
    "quoted merge": "# @package _global_\n'<<': {P}",
    "tagged merge": "# @package _global_\n!!merge <<: {P}",
    "tag": "# @package _global_\n!!map\nP",
    "second document": "# @package _global_\ntitle: a\n---\nP",
    "twice": "# @package _global_\nhydra: {mode: RUN}\ndefaults: [_self_]\ntitle: a\nP",
}
KINDS = {
    "plant": ("plant/x.yaml", DECAYING, ["plant=x", *SHORT]),
    "regression": ("regression/x.yaml", REGRESSION, ["regression=x", "figures=none"]),
    "estimator": ("estimator/x.yaml", "name: drem\n", ["estimator=x", *SHORT]),
    "experiment": ("experiment/x.yaml", RECIPE, ["experiment=x", *SHORT]),
    "primary": ("x.yaml", RECIPE + "observer: {name: none}\n", ["--config-name", "x"]),
}
OTHERS = [kind for kind in KINDS if kind != "experiment"]


def in_files(attacks):
    """Each attack in a recipe and in one of the other kinds of files."""
    pairs = enumerate(attacks)
    return [(name, kind) for k, name in pairs for kind in ("experiment", OTHERS[k % len(OTHERS)])]


@pytest.fixture(autouse=True)
def secret(monkeypatch):
    monkeypatch.setenv("SECRET", "5ecret")


def prepared(tmp_path, path, text):
    """A folder with a stranger's file in it, and bait around it."""
    folder, marker = tmp_path / "evil", tmp_path / "marker"
    filled = text.replace("CALL", CALL).replace("MARKER", str(marker))
    bait = CALL.replace("MARKER", str(marker))
    for name in ("docs/extra.yaml", "hydra/launcher/mine.yaml", "hydra/callbacks/x.yaml",
                 "launcher/mine.yaml"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(bait)
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    filled = filled.replace("FOLDER", str(folder))
    (folder / path).write_bytes(filled.encode(errors="surrogateescape"))
    return folder, marker


def assert_harmless(done, tmp_path, marker):
    assert not marker.exists()
    assert not (tmp_path / "docs").exists()
    assert "5ecret" not in done.stdout + done.stderr
    assert "OWNED" not in os.environ
    if done.returncode:
        assert_refused(done)
        assert "internal" not in done.stderr
        assert not (tmp_path / "outputs").exists()
        return
    config = HydraConfig.instance().cfg
    assert set(config) <= {*KEYS, "hydra"}
    hydra = OmegaConf.to_container(config.hydra, resolve=False)
    assert not hydra["callbacks"]
    assert not hydra["job"]["env_set"]
    assert hydra["run"]["dir"].startswith("outputs/runs/${now:")
    assert [path.name for path in tmp_path.iterdir() if path.name != "evil"] == ["outputs"]


@pytest.mark.parametrize(("form", "kind"), in_files(FORMS))
def test_no_syntax_hides_a_key(tmp_path, kind, form):
    """Every syntax around the worst key, and around a value that would be replaced."""
    path, body, words = KINDS[kind]
    for payload in ("callback", "interpolation"):
        text = FORMS[form].replace("P", PAYLOADS[payload])
        # A header stands first, so what is hidden stands before the rest.
        folder, marker = prepared(tmp_path / payload, path, f"{text}\n{body}")
        done = gpebo("run", "--config-dir", folder, *words, cwd=folder.parent)
        assert_refused(done)
        assert_harmless(done, folder.parent, marker)


@pytest.mark.parametrize(("payload", "kind"), in_files(PAYLOADS))
def test_nothing_of_hydra_can_be_reached(tmp_path, kind, payload):
    path, body, words = KINDS[kind]
    folder, marker = prepared(tmp_path, path, f"{body}{PAYLOADS[payload]}\n")
    done = gpebo("run", "--config-dir", folder, *words, cwd=tmp_path)
    assert_refused(done)
    assert_harmless(done, tmp_path, marker)


@pytest.mark.parametrize("payload", PAYLOADS)
@pytest.mark.parametrize("group", ["plant", "estimator"])
def test_nor_from_python(tmp_path, payload, group):
    path, body, _ = KINDS[group]
    folder, marker = prepared(tmp_path, path, f"{body}{PAYLOADS[payload]}\n")
    time = {"horizon": 0.1, "samples": 3}
    for name in ("x", folder / path) if group == "plant" else ("x",):
        with refused():
            run(**{"plant": "circuit", group: name}, time=time, config_dir=folder)
        assert not marker.exists()


def test_what_stands_in_two_places_is_written_twice():
    rows = [[1, 2]]
    assert dump({"A": rows, "B": rows}) == "A:\n- [1, 2]\nB:\n- [1, 2]\n"


def test_a_recipe_may_sweep_and_nothing_else(tmp_path):
    recipe = RECIPE + "hydra: {mode: MULTIRUN, sweeper: {params: {time.horizon: '0.1,0.2'}}}\n"
    folder, marker = prepared(tmp_path, "experiment/x.yaml", recipe)
    done = gpebo("run", "--config-dir", folder, "experiment=x", "observer=none", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "2 jobs, 2 done" in done.stdout
    assert not marker.exists()


@pytest.mark.parametrize("override", [
    f"+hydra.callbacks.x={CALL}", "hydra.launcher._target_=os.mkdir",
    "+plant.parameters={_target_: os.mkdir}", "hydra.searchpath=[file:///tmp]",
    "title=${oc.env:SECRET}", r"title=$\{oc.env\:SECRET\}", "title=[{a: '${plant.name}'}]",
])
def test_the_second_line_holds_without_the_first(tmp_path, override):
    """What is composed is checked, too, whoever wrote it."""
    override = override.replace("MARKER", str(tmp_path / "marker"))
    assert_refused(gpebo("run", override, *SHORT, cwd=tmp_path), "not allowed")
    assert list(tmp_path.iterdir()) == []


# Names and places ---------------------------------------------------------------------------


@pytest.mark.parametrize(("group", "text"), [
    ("plant", DECAYING.replace("mine", "../../marker")),
    ("plant", DECAYING.replace("mine", "a/../../../marker")),
    ("estimator", "name: ../../../marker\n"),
    ("observer", "name: kalman_bucy\nestimator: x/../../../../marker\n"),
    ("observer", "name: gpebo\nestimator: x/../../../../marker\n"),
])
def test_a_name_cannot_lead_elsewhere(tmp_path, group, text):
    """Names of plants and estimators are parts of a folder's name."""
    folder, marker = prepared(tmp_path, f"{group}/x.yaml", text)
    done = gpebo("run", "--config-dir", folder, f"{group}=x", "figures=none", cwd=tmp_path)
    assert_refused(done)
    assert_harmless(done, tmp_path, marker)


@pytest.mark.parametrize("choice", ["../x", "../../x", "lab/../../x", "/etc/x", "lab", "x/", "."])
def test_a_choice_cannot_lead_elsewhere(tmp_path, choice):
    folder, _ = prepared(tmp_path, "plant/lab/y.yaml", DECAYING)
    for place in (tmp_path / "x.yaml", folder / "x.yaml"):
        place.write_text(DECAYING)
    assert_refused(
        gpebo("run", "--config-dir", folder, f"plant={choice}", *SHORT, cwd=tmp_path)
    )
    assert not (tmp_path / "outputs").exists()


def test_links_lead_nowhere_but_inside(tmp_path):
    folder, marker = prepared(tmp_path, "plant/mine.yaml", DECAYING)
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "x.yaml").write_text(DECAYING)
    (folder / "plant" / "file.yaml").symlink_to(outside / "x.yaml")
    (folder / "plant" / "lab").symlink_to(outside)
    (folder / "plant" / "inside.yaml").symlink_to("mine.yaml")
    (folder / "plant" / "round.yaml").symlink_to("round.yaml")
    (folder / "plant" / "zero.yaml").symlink_to("/dev/zero")
    (folder / "plant" / "folder.yaml").mkdir()
    os.mkfifo(folder / "plant" / "pipe.yaml")
    for name in ("file", "lab/x", "round", "zero", "folder", "pipe"):
        done = gpebo("run", "--config-dir", folder, f"plant={name}", *SHORT, cwd=tmp_path)
        assert_refused(done)
        assert "did you mean" not in done.stderr
        with refused():
            run(folder / "plant" / f"{name}.yaml" if name in ("pipe", "zero") else name,
                config_dir=folder)
    assert gpebo(
        "run", "--config-dir", folder, "plant=inside", *SHORT, "hydra.run.dir=out", cwd=tmp_path
    ).returncode == 0
    assert not marker.exists()


@pytest.mark.parametrize(("link", "target", "words"), [
    ("x.yaml", "x.yaml", ["--config-name", "x"]),
    ("experiment/x.yaml", "x.yaml", ["experiment=x"]),
    ("experiment/lab", ".", ["experiment=lab/x"]),
    ("estimator", ".", ["estimator=x"]),
])
def test_recipes_and_groups_are_not_found_by_links_either(tmp_path, link, target, words):
    outside, folder = tmp_path / "outside", tmp_path / "evil"
    for place in (outside, folder / "experiment"):
        place.mkdir(parents=True)
    (outside / "x.yaml").write_text("name: drem\n" if link == "estimator" else RECIPE)
    (folder / link).symlink_to(outside / target)
    done = gpebo("run", "--config-dir", folder, *words, *SHORT, cwd=tmp_path)
    assert_refused(done, f"outside {folder}")


class Call:
    """What makes a folder when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_pickles_are_not_opened(tmp_path):
    text = DECAYING.replace("A: [[-1]]", "matrices: m.npz")
    folder, marker = prepared(tmp_path, "plant/x.yaml", text)
    np.savez(folder / "plant" / "m.npz", A=np.array([[Call(marker)]], dtype=object))
    (folder / "a.npz").write_bytes((folder / "plant" / "m.npz").read_bytes())
    (folder / "b.mat").write_bytes(pickle.dumps(Call(marker)))
    for words in (["run", "--config-dir", folder, "plant=x", *SHORT],
                  *(["new", "plant", "p", "--from", folder / name] for name in ("a.npz", "b.mat"))):
        assert_refused(gpebo(*words, cwd=tmp_path))
        assert not marker.exists()


@pytest.mark.skipif(not os.path.exists("/proc/self/mem"), reason="needs /proc")
def test_a_file_that_cannot_be_read_is_named(tmp_path):
    done = gpebo("run", "data.file=/proc/self/mem", "figures=none", cwd=tmp_path)
    assert_refused(done, "/proc/self/mem cannot be read")


BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(("text", "expected"), [
    (BOMB, "entries, aliases expanded"),
    ("a: &a [*a]\n", "*a contains itself"),
    ("a: *b\n", "stands for nothing"),
    ("a: " + "[" * 60, "levels deep"),
    ("a: " + "[" * 100_000, "levels deep"),
    ("? " * 60 + "a", "levels deep"),
    ("{a: " * 60, "levels deep"),
    ("#" * 2_000_001, "bytes; at most"),
    (DECAYING.replace("name: mine\n", ""), "name is missing"),
    (DECAYING + "name: other\n", "the key name stands twice"),
    (DECAYING + "1: 2\n", "a key must be text"),
    (DECAYING + "[1, 2]: 2\n", "a key must be text"),
    (DECAYING + "title: !!binary aGFsbG8=\n", "a file is plain data"),
    (DECAYING + "n: 0x_\n", "a number that cannot be read"),
    (DECAYING + f"n: {'9' * 5000}\n", "a number that cannot be read"),
    *[(DECAYING + f"n: {x}\n", f"{x} is a number of base 8") for x in ("-010", "0_7", "1:30")],
    ("name: [", "not valid YAML"),
    ("name: a\0b\n", "not valid YAML"),
    ("- 1\n", "expected a mapping"),
    ("", "expected a mapping"),
    (DECAYING + "title: \udcff\n", "not text in UTF-8"),
    (DECAYING + "title: ${oc.env:HOME}\n", "${…} is not allowed"),
])
def test_a_file_that_is_no_data_is_one_line(tmp_path, text, expected):
    folder, _ = prepared(tmp_path, "plant/x.yaml", text)
    done = gpebo("run", "--config-dir", folder, "plant=x", *SHORT, cwd=tmp_path)
    assert_refused(done, expected)
    with refused("x.yaml", expected):
        run(folder / "plant" / "x.yaml")


# Any text ------------------------------------------------------------------------------------

PIECES = st.sampled_from([
    "%YAML 1.3\n", "%YAML 1.1\n", "%TAG ! !x\n", "---\n", "...\n", "# @package _global_\n",
    "# @package hydra\n", "\u2028", "\x85", "\r", "\x0b", "\x0c", "\ufeff", "\t", " ", "\n", "  ",
    "hydra: ", "Hydra: ", "callbacks: ", "defaults: ", "_target_: os.mkdir", "title: ", "time: ",
    "<<: ", "'<<': ", "? ", ": ", "- ", "{", "}", "[", "]", ", ", "&a ", "*a", "*b ", "!!map ",
    "!x ", "!!python/name:os.system ", "${oc.env:SECRET}", "'", '"', "\\x24{now:}", "|\n  ",
    ">-\n ", "null", "1e9", "0x_", "mode: MULTIRUN", "experiment: x", "a: ", "a",
    "plant: circuit", "#",
])
TEXTS = st.lists(PIECES, max_size=14).map("".join)


def only_data(value):
    if isinstance(value, dict):
        assert "<<" not in value
        return all(isinstance(key, str) and only_data(inner) for key, inner in value.items())
    if isinstance(value, list):
        return all(map(only_data, value))
    return value is None or (type(value) in (bool, int, float, str) and "${" not in str(value))


@given(TEXTS)
@settings(max_examples=200, deadline=None)
def test_any_text_is_data_or_one_line(text):
    problem = ""
    try:
        assert only_data(parse(text, "x.yaml"))
    except ConfigError as error:
        problem = str(error)
    assert len(problem.splitlines()) <= 1


@given(st.sampled_from(sorted(KINDS)), TEXTS)
@settings(max_examples=20, deadline=None)
def test_any_file_is_composed_within_the_schema_or_one_line(tmp_path_factory, kind, text):
    path, body, words = KINDS[kind]
    tmp_path = tmp_path_factory.mktemp("any")
    folder, marker = prepared(tmp_path, path, f"{text}\n{body}")
    assert_harmless(gpebo("run", "--config-dir", folder, *words, cwd=tmp_path), tmp_path, marker)
