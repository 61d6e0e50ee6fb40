"""Pictures against committed ones: nothing moved, vanished or changed its colour or dashes.

The numbers drawn come from formulas, not from a run, so only drawing can make a difference. After
a change that is meant, ``pytest tests/test_layout.py --mpl-generate-path=tests/baseline``, and
look.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from factories import make_result
from matplotlib.figure import Figure
from PIL import Image

from gpebo_cli.experiment.result import RunResult
from gpebo_cli.results import circuit
from gpebo_cli.results.figures import draw

pytest.importorskip("pytest_mpl")

BASELINE = Path(__file__).parent / "baseline"


def drawn_by(path: Path) -> str:
    """Version of matplotlib, without the last number, that wrote a picture."""
    with Image.open(path) as image:
        version = str(image.info.get("Software", "")).removeprefix("Matplotlib version ")
    return ".".join(version.split(".")[:2])


def same_matplotlib() -> bool:
    """Glyphs and lines move by fractions of a pixel from one version to the next."""
    ours = ".".join(mpl.__version__.split(".")[:2])
    versions = {drawn_by(path) for path in BASELINE.glob("*.png")}
    return not versions or versions == {ours}


# Root mean square of the difference of pixels, 0 to 255. The edges of glyphs and lines, up to 9 %
# of all pixels, may be one or two of the 256 shades off on another machine: 0.4. The least that
# matters is ten times that: other dashes of one curve 4.1, the name of the time axis moved by a
# pixel 4.8, a letter more in a legend 6.8, a curve in black 6.4, a panel moved by a pixel 15.
picture = pytest.mark.mpl_image_compare(
    baseline_dir="baseline",
    style="default",
    tolerance=2.0,
    savefig_kwargs={"dpi": 100, "metadata": {"Software": f"Matplotlib version {mpl.__version__}"}},
    deterministic=False,
)
pytestmark = pytest.mark.skipif(
    not same_matplotlib(), reason="tests/baseline was drawn by another version of matplotlib"
)


def one(names: Sequence[str], result: RunResult) -> Figure:
    [(_, figure)] = draw(result, names)
    return figure


@picture
def test_regressor() -> Figure:
    return one(["regressor"], make_result())


@picture
def test_estimates() -> Figure:
    return one(["estimates_a"], make_result())


@picture
def test_errors() -> Figure:
    return one(["parameter_error"], make_result())


@picture
def test_gram() -> Figure:
    return one(["gram"], make_result())


@picture
def test_gains() -> Figure:
    return one(["gains"], make_result(gammas=tuple(np.logspace(6, 12, 25)), samples=101))


@picture
def test_circuit() -> Figure:
    if not circuit.available():
        pytest.skip("schemdraw is not installed")
    return circuit.circuit()
