"""Products of unknowns as new unknowns, and the physical ones from a plant with their tangent."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest
from plants import one_state

from gpebo_cli import check, run

PAGE = Path(__file__).parent.parent / "docs" / "howto" / "products.md"


@pytest.fixture(scope="module")
def page():
    """Names of the page's program, and what it printed."""
    blocks = re.compile(r"```(?:python|text)\n(.*?)```", re.DOTALL)
    program, printed = blocks.findall(PAGE.read_text("utf-8"))
    names, out = {}, io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(program, names)  # noqa: S102  our own page
    return names, out.getvalue(), printed


def test_the_page_prints_what_it_says(page):
    _, found, printed = page
    assert found == printed


def test_the_deviation_of_what_is_recovered_is_that_of_the_seeds(page):
    names, *_ = page
    settings = names["SETTINGS"]
    system = {**names["MOTOR"], **names["tangent"](0.3, 0.5)}
    noise = {**settings["noise"], "sample_time": 0.01, "seeds": 16}
    found = run(system, **{**settings, "noise": noise}).details
    std = found.estimation.parameters_std[0, -1, :2]
    np.testing.assert_allclose(std, found.noise.deviation[0, :2], rtol=0.5)
    assert (np.abs(found.noise.bias[0, :2]) < 4 * std / np.sqrt(16)).all()


def leak(u, unknowns, F, phi=0):
    """x' = −θ₁ y + θ₂ u + θ₁ θ₂ with θ = (0.5, 2)."""
    return one_state(inputs={"u": u}, unknowns=unknowns, B=[[0]], F=[F], phi=[phi])


PRODUCTS = ({"p": 0.5, "q": 2, "pq": 1}, ["-y", "u", 1])
TANGENT = ({"p": 0.5, "q": 2}, ["-y + 2", "u + 0.5"], -1)


def test_the_price_is_excitation():
    settings = {"time": {"horizon": 5}}
    failed = [a.name for a in check(leak("1", *PRODUCTS), **settings) if not a.holds]
    assert failed == ["Assumption 2"]
    assert all(a.holds for a in check(leak("1", *TANGENT), **settings))


def test_the_price_is_deviation():
    settings = {
        "estimator": {"name": "least_squares", "f0": 1e-12}, "observer": {"remedy": "noise_free"},
        "time": {"horizon": 5, "samples": 11},
        "noise": {"name": "gaussian", "outputs": 0.01, "sample_time": 0.05},
    }
    products, tangent = (
        run(leak("1 + 0.1*sin(t)", *form), **settings).details.estimation.parameters_std[0, -1, :2]
        for form in (PRODUCTS, TANGENT)
    )
    assert tangent[1] < 0.5 * products[1]
    assert tangent[0] < products[0]
