"""Random plants, regressions, recordings, models, run folders: `python -m tests.fuzz --seconds 60`.

Everything runs in this process. Whatever is given, there is a result or one line; no traceback, no
answer that takes longer than 20 s, no more than 2 GB.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

from tests.inprocess import gpebo

_SECONDS = 20.0
_BYTES = 2 * 1024**3
_SHORT = ["figures=none", "time.samples=11"]

NUMBERS = [0, 1, -1, 2.5, 1e-9, 1e9, -1e300, 1e-300, True, "1e-3", "0x10", "١", float("inf")]
EXPRESSIONS = [
    "t", "sin(t)", "2 + cos(3*t)", "exp(-t)", "exp(700*t)", "1/t", "t**-1", "sqrt(t - 1)", "log(t)",
    "abs(t - 0.5)", "step(t - 0.3)", "d(k)", "k", "k*u", "u", "y", "y*sin(t)", "th", "x1",
    "9**9**9", "2**1023*t", "tan(t)", "1e308*10", "(" * 60 + "t" + ")" * 60, "__import__('os')",
    "t.real", "", "min(t, 1)", "max(u, 0)", "erf(t)", "acos(t)", "5 % 2", "lambda: 1", "a" * 300,
    "t t",
]
STRANGE = [None, "x", [], {}, [[]], [["t"], ["t", "t"]], {"a": {"b": 1}}, "\x00", "é\u2028",
           10**400]
CHOICES = {
    "estimator": ["drem", "gradient", "least_squares", "ls_drem", "lion", "fct", "mre", "power",
                  "exciting", "instrumental", "annihilator", "monotone", "no"],
    "observer": ["gpebo", "canonical", "kalman_bucy", "none", "no"],
    "solver": ["collocation", "ivp", "no"],
    "noise": ["none", "gaussian", "no"],
    "plant": ["circuit", "window", "descriptor", "canonical", "no"],
}
KEYS = [
    "estimator.gamma", "estimator.lambda", "estimator.initial", "estimator.f0", "estimator.beta",
    "time.start", "time.horizon", "time", "excitation.rho", "excitation.window", "noise.seed",
    "noise.seeds", "noise.outputs", "noise.sample_time", "solver.tol", "solver.stages",
    "observer.xi_a0", "observer.weights", "observer.remedy", "observer.sample_time", "figures",
    "plant.title", "plant.states", "plant.E", "data.file", "data.hold", "output.max_rows", "title",
    "hydra.run.dir", "hydra.callbacks", "nothing", "plant.nothing", "launcher", "experiment",
]
VALUES = [
    "1", "-1", "0", "1e9", "1e-300", "null", "nan", "inf", "true", "[1,2]", "[]", "{}", "{e1: 1}",
    "{e1: {a: 1}}", "abc", "logspace(1,3,3)", "logspace(1,1e9,2)", "'a b'", "${oc.env:HOME}", "???",
    "[1,[2]]", "all", "none", "reset", "output_injection", "linear", "1,2", "range(1,3)", "glob(*)",
    "/dev/null", "/dev/zero", ".", "out", "\\", "'", "(", "é",
]
CELLS = [
    "0", "1", "0.1", "0.2", "-1e300", "1e400", "nan", "", " ", "1,5", "１.５", "\xa01", "1.2x3",
    "inf", "t", "V", "y", "e1", "\x0b", "\x0c", "\x00", '"', '"1"', "#", "1e-3", "\ufeff",
    "2024-01-01",
]


def pick(r: random.Random, values):
    return values[r.randrange(len(values))]


def entry(r):
    return pick(r, NUMBERS if r.random() < 0.5 else EXPRESSIONS)


def plain_entry(r):
    return pick(r, [0, 0, 1, -1, 0.5, "sin(t)", "2 + cos(t)", "k", "exp(-t)", "step(t - 0.3)"])


def plant(r):
    """A plant that would run, with a few things about it changed."""
    n, m, q, outputs = r.randint(1, 4), r.randint(0, 2), r.randint(0, 2), r.randint(0, 2)
    one = entry if r.random() < 0.3 else plain_entry

    def matrix(rows, columns):
        return [[one(r) for _ in range(columns)] for _ in range(rows)]

    content = {
        "name": "mine", "parameters": {"k": "1 + t/10"}, "states": [f"x{i}" for i in range(n)],
        "inputs": {("u", "v")[i]: "sin(t)" for i in range(m)},
        "unknowns": {("th", "ph")[i]: 1.5 for i in range(q)},
        "outputs": ["y", "z"][:outputs], "E": matrix(n, n), "A": matrix(n, n), "B": matrix(n, m),
        "F": matrix(n, q), "C": matrix(outputs, n), "initial_state": {f"x{i}": 1 for i in range(n)},
    }
    for i in range(n):
        content["E"][i][i] = pick(r, [1, 1, 0, one(r)])
        content["A"][i][i] = pick(r, [-1, 1, one(r)])
    while r.random() < 0.3:
        key = pick(r, [*content, "D", "H", "phi", "units", "labels",
                        "observer_defaults", "titel"])
        grid = matrix(r.randint(0, 3), r.randint(0, 3))
        content[key] = pick(r, [pick(r, STRANGE), entry(r), grid])
    return content


def run_plant(r, folder):
    from gpebo_cli import GpeboError, run

    content = plant(r)
    chosen = {k: pick(r, v[:-1]) for k, v in CHOICES.items() if k != "plant" and r.random() < 0.4}
    yield content, chosen
    try:
        run(content, **chosen, time={"horizon": pick(r, [0.1, 1, 5]), "samples": 11})
    except GpeboError as error:
        yield from one_line(str(error) + "\n")


def run_regression(r, folder):
    """A regression that would run, with a few things about it changed."""
    from gpebo_cli import GpeboError, run

    p, rows = r.randint(1, 3), r.randint(1, 2)
    one = entry if r.random() < 0.3 else plain_entry
    names = [f"a{i}" for i in range(p)]
    content = {
        "name": "mine", "parameters": {"k": "1 + t/10"}, "unknowns": dict.fromkeys(names, 1.5),
        "signals": {"u": "sin(t)", "y": entry(r)},
        "Y": [pick(r, ["u", "y", one(r)]) for _ in range(rows)],
        "psi": [[pick(r, ["u", one(r)]) for _ in range(p)] for _ in range(rows)],
    }
    while r.random() < 0.3:
        content[pick(r, [*content, "S", "box", "theta"])] = pick(r, [pick(r, STRANGE), entry(r)])
    estimator = pick(r, CHOICES["estimator"][:-1])
    yield content, estimator
    try:
        run(regression=content, estimator=estimator, time={"horizon": 1, "samples": 11})
    except GpeboError as error:
        yield from one_line(str(error) + "\n")


MODELS = {
    "a.cir": "a circuit\nV1 in 0 SIN(0 1 1k)\nR1 in out 1k\nC1 out 0 1u IC=0\nL1 out 0 1m\n",
    "a.yaml": "coordinates: [q]\nM: [[1]]\nD: [[0.1]]\nK: [[2]]\nforces: [[1]]\ninputs: [F]\n",
    "a.m": "A = [-1 0; 0 -2];\nB = [1; 1];\nC = [1 1];\n",
    "a.mo": "model a\nend a;\n",
}
SNIPPETS = ["\n", " ", "1e400", "-", "(", ")", "{", "R2 in in 0\n", ".subckt a b\n", "X1 in a\n",
            "\x00", "K1 L1 L1 2\n", "E1 out 0 in 0 1e30\n", ".param a={a}\n", "M: [[0]]\n", "[",
            "]", "é", ";"]


def altered(r, text):
    while r.random() < 0.7:
        i = r.randrange(len(text) + 1)
        j = min(len(text), i + r.choice([0, 0, 1, 5, 20]))
        text = text[:i] + pick(r, SNIPPETS) + text[j:]
    return text


def run_import(r, folder):
    """A model of another program, with a few things about its text changed; and its plant."""
    name = pick(r, list(MODELS))
    text = altered(r, MODELS[name])
    (folder / name).write_text(text)
    yield name, text
    made = gpebo("new", "plant", "mine", "--from", name, cwd=folder)
    yield from judged(made)
    if made.returncode == 0:
        words = ["--config-dir", ".", "plant=mine", "time.horizon=1e-3", *_SHORT]
        yield from judged(gpebo("run", *words, cwd=folder))


def run_folder(r, folder):
    """The folder of a run, with a file changed; what shows and repeats it."""
    words = ["run", "time.horizon=0.1", *_SHORT, "hydra.run.dir=out"]
    gpebo(*words, cwd=folder)
    path = pick(r, sorted((folder / "out").glob("*.*")))
    text = altered(r, path.read_text())
    path.write_text(text)
    words = pick(r, [["compare", "out"], ["report", "out"],
                     ["run", "--config-dir", "out", "--config-name", "config", *_SHORT]])
    yield path.name, text, words
    yield from judged(gpebo(*words, cwd=folder))


def run_words(r, folder):
    words = [f"{k}={pick(r, v)}" for k, v in CHOICES.items() if r.random() < 0.3]
    words += [f"{pick(r, ['', '', '', '+', '~'])}{pick(r, KEYS)}={pick(r, VALUES)}"
              for _ in range(r.randint(0, 3))]
    words += [pick(r, ["-m", "--cfg", "job", "--info", "-x", "--resolve", "--dry-run", "--cfg=all"])
              for _ in range(r.randint(0, 2) * (r.random() < 0.3))]
    r.shuffle(words)
    command = pick(r, ["run", "run", "run", "check"])
    words = [command, "time.horizon=0.5", *_SHORT, *words]
    yield words
    yield from judged(gpebo(*words, cwd=folder))


def recording(r):
    lines = [["t", "V", "y"]] + [[f"{k / 10}", "1", f"{k}"] for k in range(r.randint(0, 12))]
    while r.random() < 0.6:
        line = pick(r, lines)
        change = r.randrange(3)
        if change == 0 and line:
            line[r.randrange(len(line))] = pick(r, CELLS)
        elif change == 1:
            line.append(pick(r, CELLS))
        else:
            cells = [pick(r, CELLS) for _ in range(r.randint(0, 4))]
            lines.insert(r.randrange(len(lines) + 1), cells)
    separator, end = pick(r, [",", ",", ";", "\t"]), pick(r, ["\n", "\n", "\r\n", "\r"])
    content = end.join(separator.join(line) for line in lines).encode()
    if r.random() < 0.2:
        content += pick(r, [b"\xff", b"\x00", b"\n\n", b'"'])
    return content


FIRST_ORDER = """\
name: mine
states: [x]
inputs: {V: 0}
outputs: [y]
E: [[1]]
A: [[-1]]
B: [[1]]
C: [[1]]
initial_state: {x: 1}
"""


def run_recording(r, folder):
    content = recording(r)
    (folder / "plant").mkdir(exist_ok=True)
    (folder / "plant" / "mine.yaml").write_text(FIRST_ORDER)
    (folder / "data.csv").write_bytes(content)
    words = ["run", "--config-dir", ".", "plant=mine", "figures=none"]
    words += pick(r, [[], [f"data.hold={pick(r, ['zoh', 'linear', 'cubic'])}"], ["time.start=0.1"]])
    streamed = r.random() < 0.5
    yield content, words, streamed
    if not streamed:
        yield from judged(gpebo(*words, "data.file=data.csv", cwd=folder))
        return
    before = os.dup(0)
    try:
        with (folder / "data.csv").open("rb") as stream:
            os.dup2(stream.fileno(), 0)
        yield from judged(gpebo(*words, "data.file=-", "observer.sample_time=0.1", cwd=folder))
    finally:
        os.dup2(before, 0)
        os.close(before)


def judged(done):
    """What is wrong with what a command printed, if anything."""
    if done.returncode not in (0, 1, 2):
        yield f"exit code {done.returncode}"
    if done.returncode:
        lines = [line for line in done.stderr.splitlines(keepends=True) if "warning: " not in line]
        errors = [line for line in lines if line.startswith("gpebo: error: ")]
        if len(errors) != len(lines) and "Traceback" in done.stderr:
            yield done.stderr
        if errors:
            yield from one_line(errors[-1])
        elif "FAILS" not in done.stdout:
            yield f"exit code {done.returncode} without a reason: {done.stderr!r}"


def one_line(text):
    if "internal error" in text or text.count("\n") != 1:
        yield text


KINDS = [run_plant, run_plant, run_words, run_words, run_recording, run_recording, run_regression,
         run_import, run_folder]


def case(seed: int, folder: Path) -> str:
    """What is wrong with the case of this seed, or nothing."""
    r = random.Random(seed)  # noqa: S311
    steps = pick(r, KINDS)(r, folder)
    given = next(steps)
    begin = time.process_time()
    try:
        problem = next(steps, "")
    except Exception:  # noqa: BLE001
        problem = traceback.format_exc()
    seconds = time.process_time() - begin
    if not problem and seconds > _SECONDS:
        problem = f"took {seconds:.0f} s"
    return f"seed {seed}: {given!r}\n{problem}" if problem else ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=int(time.time()) * 1000, help="of the first")
    parser.add_argument("--cases", type=int, default=sys.maxsize, help="at most")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    end = time.monotonic() + arguments.seconds
    seed, failures = arguments.seed, []
    last = arguments.seed + arguments.cases
    while time.monotonic() < end and seed < last and len(failures) < 10:
        faulthandler.dump_traceback_later(10 * _SECONDS, exit=True)  # other work slows us down
        with tempfile.TemporaryDirectory() as folder:
            failures += [problem] if (problem := case(seed, Path(folder))) else []
        seed += 1
    faulthandler.cancel_dump_traceback_later()
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if size > _BYTES:
        failures.append(f"{size} bytes of memory")
    for failure in failures:
        sys.stdout.write(f"{failure}\n\n")
    passed = seed - arguments.seed - len(failures)
    sys.stdout.write(f"{passed} passed, {len(failures)} failed, first seed {arguments.seed}\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
