"""An observer of another package: one module, one file; the example of the how-to is the module."""

from __future__ import annotations

import re
from pathlib import Path

from inprocess import gpebo
from processes import assert_refused, install, printed

ROOT = Path(__file__).parent.parent
PLANT = """
name: oscillator
states: [x, v]
inputs: {u: sin(3*t)}
unknowns: {load: 0.4}
outputs: [y]
E: [[1, 0], [0, 1]]
A: [[0, 1], [-2, "-0.3 - 0.1*sin(t)"]]
B: [[0], [1]]
F: [[0], [1]]
C: [[1, 0]]
initial_state: [1, 0]
"""


def test_an_observer_of_another_package(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "howto" / "observer.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "mine.py").write_text(code, encoding="utf-8")
    install(tmp_path, "mine", "gpebo.observers", open_loop="OpenLoop")
    for group, name, text in (("observer", "open_loop", "name: open_loop\n"),
                              ("plant", "oscillator", PLANT)):
        (tmp_path / group).mkdir()
        (tmp_path / group / f"{name}.yaml").write_text(text)

    monkeypatch.syspath_prepend(tmp_path)

    def command(*words):
        return gpebo(
            "run", "--config-dir", ".", "plant=oscillator", "observer=open_loop",
            "estimator=ls_drem", "figures=none", "hydra.run.dir=out", *words, cwd=tmp_path,
        )

    error = re.search(r"state error (\S+) at the end", printed(command()))
    assert error is not None
    assert float(error[1]) < 1e-9
    assert_refused(command("+plant.phi=[t,0]"), "this observer takes E = I, no φ, D or H")
    said = "observer.gain: no such key; observer has xi_a0"
    assert_refused(command("+observer.gain=1"), said)
