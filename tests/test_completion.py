"""Completion as a shell asks for it, and in the shells themselves where they are installed."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import time
from typing import get_args, get_type_hints

import pytest
from examples import ROOT, environment, gpebo
from processes import assert_refused

from gpebo_cli.cli.app import COMMANDS
from gpebo_cli.cli.completion import SHELLS, answer, candidates
from gpebo_cli.configs.locations import GROUPS, outline
from gpebo_cli.evidence.metrics import NAMES
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.results.figures import FIGURES
from gpebo_cli.results.names import FIGURE_NAMES, METRICS


def names(*words):
    return [line.partition("\t")[0] for line in candidates(words)]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a plant, and with `gpebo` on the PATH."""
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "mine.yaml").write_text("name: mine\ntitle: a decaying state\n")
    monkeypatch.chdir(tmp_path)
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


# Candidates -----------------------------------------------------------------------------------


def test_commands():
    assert set(COMMANDS) < set(names(""))
    assert names("co") == ["compare", "completion"]
    assert names("__c") == []


def test_groups_and_their_values():
    assert {f"{group}=" for group in (*GROUPS, "launcher")} < set(names("run", ""))
    for group in GROUPS:
        home = (ROOT / "conf" / group).resolve()
        files = (path.relative_to(home).with_suffix("") for path in home.rglob("*.yaml"))
        on_disk = {f"{group}={path.as_posix()}" for path in files}
        assert set(names("run", f"{group}=")) == on_disk
    assert names("check", "plant=cir") == ["plant=circuit"]
    (line,) = candidates(["run", "plant=cir"])
    assert line == "plant=circuit\telectrical circuit with time-varying elements, index 2"


@pytest.mark.parametrize("command", ["gpebo", "/usr/bin/gpebo", "x=1 gpebo", "another_name"])
def test_a_line_begins_with_the_command_whatever_its_name(command, capsys):
    assert answer(["--line", f"{command} compl"]) == 0
    assert capsys.readouterr().out.split("\t")[0].strip() == "completion"


def test_values_of_ones_own_folder(here):
    assert "plant=mine" not in names("run", "plant=")
    for words in (["--config-dir", "."], ["--config-dir=."], ["-cd", str(here)],
                  ["-m", "time.samples=11", "-cd", "."]):
        assert names("run", *words, "plant=mi") == ["plant=mine"]


def test_several_values_of_a_sweep():
    assert names("run", "-m", "estimator=drem,ls") == ["estimator=drem,ls_drem"]
    assert "estimator=drem,drem" not in names("run", "-m", "estimator=drem,")


def test_keys_are_those_of_the_chosen_file():
    assert set(names("run", "time.")) == {"time.start=", "time.horizon=", "time.samples="}
    assert "estimator.gamma=" in names("run", "estimator.")
    assert "estimator.lambda=" not in names("run", "estimator.")
    assert "estimator.lambda=" in names("run", "estimator=drem", "estimator.")
    assert "observer.output=" in names("run", "observer=canonical", "observer.")
    assert "solver.tol=" in names("run", "solver.")


def test_an_outline_has_keys_and_those_of_a_section_but_none_below(tmp_path):
    """Of what is read for completion: sections indented by one blank or by two, and comments."""
    file = tmp_path / "a.yaml"
    file.write_text("a: 1\n# b: 2\ns:\n c: 3\n # d: 4\n c: 5\n   e: 6\nu:\n  f: 7\n   g: 8\n  h\n")
    assert outline(str(file)) == {"a": " 1", "s": "", "u": ""}
    assert outline(str(file), "s") == {"c": " 3"}
    assert outline(str(file), "u") == {"f": " 7"}
    assert outline(str(tmp_path)) == {}


def test_figures_list_topics_recipes_and_columns():
    assert names("run", "figures=[gram,del") == ["figures=[gram,delta"]
    assert set(names("run", "figures=[")) == {f"figures=[{name}" for name in FIGURES}
    assert names("list", "e") == ["estimators", "experiments"]
    assert "paper_circuit" in names("figures", "paper")
    assert names("figures", "figures.formats=[png,p") == ["figures.formats=[png,pdf"]
    assert names("compare", "--sort", "rms") == ["rms_error_states"]
    assert names("new", "p") == ["plant"]
    assert names("completion", "") == [*SHELLS, "--help"]
    assert names("run", "--cfg", "j") == names("run", "-m", "--cfg", "j") == ["job"]
    assert names("run", "hydra.") == ["hydra.run.dir=", "hydra.sweep.dir="]


def test_folders(here):
    (here / "plant" / "inner").mkdir()
    (here / "plant" / ".hidden").mkdir()
    assert names("run", "--config-dir", "pl") == ["plant/"]
    assert names("run", "--config-dir=pl") == ["--config-dir=plant/"]
    assert names("run", "plant=mine", "--config-dir", "pl") == ["plant/"]
    assert names("run", "resume=plant/") == ["resume=plant/inner/"]
    assert names("run", "resume=plant/.") == ["resume=plant/.hidden/"]
    assert names("compare", "~/pl") == ["~/plant/"]
    assert names("compare", "nothing/x") == []


def test_what_cannot_be_completed_is_nothing():
    assert names("run", "time.horizon=") == []
    assert names("rnu", "plant=") == []
    assert names("run", "estimator=nothing", "estimator.") == []


def test_names_that_are_written_twice_agree():
    assert tuple(FIGURES) == FIGURE_NAMES
    assert tuple(METRICS) == NAMES
    regressions = get_args(get_type_hints(Gpebo)["regression"])
    offered = set(names("run", "observer.regression="))
    assert offered == {f"observer.regression={name}" for name in regressions}


# Shells ---------------------------------------------------------------------------------------

LINES = [
    ("gpebo com", {"compare", "completion"}),
    ("gpebo run obs", {"observer=", "observer."}),
    ("gpebo run plant=c", {"plant=circuit", "plant=canonical"}),
    ("gpebo run --config-dir . plant=mi", {"plant=mine"}),
    ("gpebo run time.h", {"time.horizon="}),
    ("gpebo run -m estimator=drem,ls", {"estimator=drem,ls_drem"}),
    ("gpebo list pl", {"plants"}),
    ("gpebo run --config-dir pla", {"plant/"}),
]


def pieces(line, breaks):
    """The words of a line as bash cuts them, and what of the last one it keeps."""
    *words, last = line.split()
    cut = last.rfind("=") + 1 if "=" in breaks else 0
    return [*words, *([last[: cut - 1], "=", last[cut:]] if cut else [last])], last[:cut]


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize("breaks", ["=:", ":"])
def test_bash(here, breaks):
    """The function is called as readline calls it, with words cut at COMP_WORDBREAKS."""
    calls = "".join(
        f"COMP_LINE='{line}'; COMP_POINT={len(line)}; COMP_WORDS=({' '.join(words)}); "
        f'COMP_CWORD={len(words) - 1}; _gpebo; echo "${{COMPREPLY[*]}}"\n'
        for line, words in ((line, pieces(line, breaks)[0]) for line, _ in LINES)
    )
    done = subprocess.run(
        ["bash", "-c", f'eval "$(gpebo completion bash)"\n{calls}'], capture_output=True,
        text=True, check=True, stdin=subprocess.DEVNULL,
    )
    for (line, expected), replies in zip(LINES, done.stdout.splitlines(), strict=True):
        kept = pieces(line, breaks)[1]  # bash replaces the last piece only
        assert {kept + reply for reply in replies.split()} == expected, line


def typed(command, start, line, wait):
    """What a shell's screen shows after ``line`` and a tab."""
    child, terminal = pty.fork()
    if child == 0:
        os.environ["TERM"] = "dumb"
        os.execvp(command[0], command)  # noqa: S606
    screen = b""

    def read(until, seconds=20.0):
        nonlocal screen
        end = time.monotonic() + seconds
        while time.monotonic() < end and until not in screen:
            if select.select([terminal], [], [], 0.1)[0]:
                try:
                    screen += os.read(terminal, 4096).replace(b"\a", b"")
                except OSError:
                    break
        return until in screen

    try:
        os.write(terminal, (start + "; echo rea''dy\n").encode())
        assert read(b"ready"), screen
        screen = b""
        os.write(terminal, line.encode() + b"\t")
        read(wait.encode())
    finally:
        os.write(terminal, b"\x03exit\n")
        os.close(terminal)
        os.waitpid(child, 0)
    return screen.decode(errors="replace")


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_at_a_terminal(here):
    start = "PS1='> '; eval \"$(gpebo completion bash)\""
    shell = ["bash", "--norc", "--noprofile", "-i"]
    assert "plant=circuit" in typed(shell, start, "gpebo run plant=ci", "plant=circuit")


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("gpebo compl", "gpebo completion"),
        ("gpebo run plant=ci", "plant=circuit"),
        ("gpebo run --config-dir . plant=mi", "plant=mine"),
        ("gpebo run --config-dir pla", "plant/"),
        ("gpebo run resume=pla", "resume=plant/"),
        ("gpebo run time.ho", "time.horizon="),
    ],
)
def test_zsh_at_a_terminal(here, line, expected):
    start = "PS1='> '; autoload -U compinit; compinit -u -D; eval \"$(gpebo completion zsh)\""
    assert expected in typed(["zsh", "-f", "-i"], start, line, expected)


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish(here):
    asked = "".join(f"; complete -C '{line}'; echo ==" for line, _ in LINES)
    done = subprocess.run(
        ["fish", "--no-config", "-c", f"gpebo completion fish | source{asked}"],
        capture_output=True, text=True, check=True,
    )
    answers = done.stdout.split("==\n")[:-1]
    for (line, expected), replies in zip(LINES, answers, strict=True):
        found = {reply.partition("\t")[0] for reply in replies.splitlines()}
        assert found == expected, line


def test_an_unknown_shell_is_refused(here):
    for words, expected in ((["bsh"], "did you mean bash?"), ([], "needs one of bash, zsh, fish")):
        assert_refused(gpebo("completion", *words, cwd=here), expected)
