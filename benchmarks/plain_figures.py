"""The figures of a run from its CSV files, the short way: ``python plain_figures.py RUN TARGET``.

It imports what ``gpebo run`` imports, computes nothing but differences, and draws the same nine
figures with the same curves in the same size. The lean way of matplotlib, without pyplot.
"""

import csv
import sys
from pathlib import Path

import hydra  # noqa: F401  the same libraries
import numpy as np
import omegaconf  # noqa: F401
import yaml  # noqa: F401
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

STATES_A, STATES_B = ("e1", "e2", "il"), ("ir1", "ir2", "iv")
UNITS = {"e1": "V", "e2": "V"}


def read(path):  # noqa: ANN001, ANN201
    """A table as arrays by column."""
    with path.open(newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    columns = zip(*rows, strict=True)
    return {
        name: np.array([float(x) if x else np.nan for x in column])
        for name, column in zip(head, columns, strict=True)
    }


def draw(path, panels, *, log=False):  # noqa: ANN001, ANN201
    """``panels``: (label, [(t, values, name)]) below each other."""
    height = 5.0 if len(panels) == 1 else 0.3 + 2.55 * len(panels)
    figure = Figure(figsize=(7.0, height), dpi=100)
    FigureCanvasAgg(figure)
    for number, (label, curves) in enumerate(panels):
        axes = figure.add_subplot(len(panels), 1, number + 1)
        for t, values, name in curves:
            axes.plot(t, values, label=name)
        if log:
            axes.set_yscale("log")
        axes.set_ylabel(label)
        axes.grid(visible=True)
        if number == 0 and len(curves) > 1:
            axes.legend(ncols=3)
    axes.set_xlabel("time (s)")
    figure.savefig(path)


def main(run, target):  # noqa: ANN001, ANN201
    """All nine."""
    signals, estimates = read(run / "signals.csv"), read(run / "estimates.csv")
    regression, excitation = read(run / "regression.csv"), read(run / "excitation.csv")
    t = signals["t"]
    names = [name for name in regression if name.startswith("psi_")]
    draw(target / "regressor.png", [("ψ", [(t, regression[n], n) for n in names])])
    volts = [x for x in STATES_A + STATES_B if x in UNITS]
    amperes = [x for x in STATES_A + STATES_B if x not in UNITS]
    draw(target / "states.png", [
        ("states (V)", [(t, signals[x], x) for x in volts]),
        ("states (A)", [(t, signals[x], x) for x in amperes]),
    ])
    for kind, members in (("a", STATES_A), ("b", STATES_B)):
        draw(target / f"estimates_{kind}.png", [
            (x, [(t, signals[x], "true"), (t, estimates[f"{x}_hat"], "drem")]) for x in members
        ])
        draw(target / f"state_error_{kind}.png", [
            (f"error of {x}", [(t, np.abs(estimates[f"{x}_hat"] - signals[x]), "drem")])
            for x in members
        ], log=True)
    truth = {"e0_e1": 1.0, "e0_e2": -1.0, "e0_il": -2.0}
    draw(target / "parameter_error.png", [
        (f"error of {x}", [(t, np.abs(estimates[f"{x}_hat"] - value), "drem")])
        for x, value in truth.items()
    ], log=True)
    eigenvalues = [name for name in excitation if name.startswith("gram")]
    draw(target / "gram.png", [("λ(G)", [(t, excitation[n], n) for n in eigenvalues])], log=True)
    draw(target / "delta.png", [("|Δ|", [(t, np.abs(estimates["delta"]), "Δ")])], log=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
