"""Which final estimates are not what the data say, against least squares of the same rows."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from gpebo_cli.evidence.knowledge import knowledge
from gpebo_cli.experiment import doubts
from gpebo_cli.experiment.online import OnlineEstimates
from gpebo_cli.findings import Requirement

RNG = np.random.default_rng(7)
PSI = RNG.normal(size=(200, 3)) * [1.0, 30.0, 0.2]
TRUTH = np.array([2.0, -0.1, 5.0])
Y = PSI @ TRUTH + 1e-4 * RNG.normal(size=200)
ROOT = np.column_stack([PSI, Y])  # or what is left of it by orthogonal transformations
LEAST = np.linalg.lstsq(PSI, Y)[0]
KNOWN = knowledge(np.array([np.ones((3, 3)), PSI.T @ PSI]), np.ones(3), np.ones(2))
GAIN = np.array([
    [[1.0, 0.0, 0.5], [0.0, 10.0, 0.0]], [[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]],
    [[2.0, 0.0, 0.3], [1.0, 4.0, -0.2]],
])
OFFSET = np.array([[3.0, -1.0], [0.0, 0.0], [1.0, 0.5]])
NAMES = ("a", "b", "c", "x", "y")


def required(holds, **evidence):
    return Requirement("enough", holds, evidence, "")


def states(eta):
    """x̂ (g, 3, 2) at three times."""
    return OFFSET + np.einsum("mnp,gp->gmn", GAIN, eta)


def about(final, sizes, requirement=None, seen=(True, True), columns=(0, 1, 2), root=ROOT,
          known=KNOWN):
    return doubts.of_estimates(
        root, np.array(final), states, lambda eta: states(eta)[:, -1:], NAMES, np.array(sizes),
        known, np.array(seen), np.array(columns), requirement or required(True),
    )


def test_how_far_estimates_are_off_least_squares_is_told_in_their_sizes():
    """Of the case that explains most; what least squares have is the size of who has none."""
    off = np.array([0.3, -0.2, 0.7])
    worse, broken = LEAST + 2.0 * off, np.array([np.nan, 0.0, 0.0])
    told, (warning,) = about([worse, LEAST + off, broken], [4.0, np.nan, np.nan, 20.0, np.nan])
    x, last = states(LEAST[None])[0], GAIN[-1] @ off
    sizes = [4.0, *np.abs(LEAST[1:]), 20.0, np.abs(x[:, 1]).max()]
    share = np.abs(np.append(off, last)) / sizes
    assert told == pytest.approx(dict(zip(NAMES, share, strict=True)), rel=1e-6)
    assert warning.startswith(
        f"estimates.csv: at the end a, b, c, x, y are up to {share.max():.2g} of their size away "
    )
    assert warning.endswith(", or it forgets, as it has to where an unknown changes")
    leaves = [np.linalg.norm(Y - PSI @ eta) / np.linalg.norm(Y) for eta in (LEAST, LEAST + off)]
    of_least, of_them = re.findall(r"leaves (\S+) of Y and they (\S+):", warning)[0]
    assert (of_least, of_them) == tuple(f"{share:.1g}" for share in leaves)
    # A size that is less than what least squares have is none, nor does what is not seen count.
    told, (warning,) = about([LEAST + off], [1.0, 1.0, 1.0, 20.0, 0.0], seen=(True, False))
    assert told == pytest.approx({
        "a": 0.3 / LEAST[0], "b": 0.2, "c": 0.7 / LEAST[2], "x": share[3],
    }, rel=1e-6)
    assert ("a, b, c, x are up to 0.2 " in warning) == (told["x"] < 0.2)
    told, _ = about([LEAST + off], [1.0, 0.05, 1.0, 20.0, 1.0])  # b is negative
    assert told["b"] == pytest.approx(-0.2 / LEAST[1])


@pytest.mark.parametrize(("size", "warned"), [(1e-12, False), (1e-3, True)])
def test_a_state_that_is_zero_has_the_size_of_its_terms(size, warned):
    """x = 2a + c/2 − that of least squares, with an error of 1e-3 in a: not 1e9."""
    gain = np.array([2.0, 0.0, 0.5])

    def zero(eta):
        return (eta @ gain - gain @ LEAST + size)[:, None, None]

    told, warnings = doubts.of_estimates(
        ROOT, LEAST[None] + [1e-3, 0.0, 0.0], zero, zero, NAMES[:4],
        np.array([2.0, 0.1, 5.0, size]), KNOWN, np.array([True]), np.arange(3),
        required(True, gamma_times_integral=30.0),
    )
    assert (len(warnings), told["x"] < 1e-3) == (warned, not warned)


@pytest.mark.parametrize(("left", "limit"), [
    (0.0, 0.02), (7.0, 0.02), (9.0, 30.0 * np.exp(-9.0)), (30.0, 1e-3),
])
def test_a_law_that_is_known_to_be_done_is_held_to_less(left, limit):
    sizes = [2.0, 0.1, 5.0, 1e6, 1e6]
    enough = required(True, **({"gamma_times_integral": left} if left else {}))
    for share, warned in ((1.02, True), (0.98, False)):
        final = [LEAST * [1.0, 1.0, 1.0 - share * limit]]
        _, found = about(final, sizes, enough)
        assert len(found) == warned
        assert not warned or "at the end c are up to" in found[0]
        assert about(final, sizes, required(False))[1] == ()


def test_estimates_that_explain_the_data_nearly_as_well_are_not_warned_of():
    """Noise makes such a difference, too: up to three times what least squares leave."""
    slope = np.linalg.norm(PSI[:, 2])
    noisy = np.vstack([ROOT, [0.0, 0.0, 0.0, 30.0]])  # which least squares leave
    for times, count in ((2.9, 0), (3.1, 1)):
        final = [LEAST + times * 30.0 / slope * np.eye(3)[2]]
        assert len(about(final, [2.0, 0.1, 5.0, 1e6, 1e6], root=noisy)[1]) == count


def test_of_some_parameters_least_squares_are_about_these_alone():
    eta = np.append(np.linalg.lstsq(PSI[:, :2], Y)[0], 0.0)
    told, _ = about([eta + 0.5 * np.eye(3)[0]], [9.0, 9.0, 9.0, 9.0, 99.0], columns=(0, 1))
    assert [told[name] for name in "abc"] == pytest.approx([0.5 / 9.0, 0.0, 0.0], abs=1e-6)
    assert about([eta], [1.0] * 5, columns=()) == ({}, ())
    assert about([eta * np.nan], [1.0] * 5) == ({}, ())


def test_what_the_data_leave_open_is_told_as_well():
    """Of c they say nothing, which is in x: its doubt is that of the gain at the end."""
    off, blind = np.array([0.1, 0.0, 0.0]), ROOT * [1.0, 1.0, 0.0, 1.0]
    known = knowledge((blind[:, :3].T @ blind[:, :3])[None], np.ones(3), np.ones(1))
    least = np.append(np.linalg.lstsq(blind[:, :2], Y)[0], 0.0)
    told, _ = about([least + off], [1e2] * 5, root=blind, known=known)
    open_, _ = known.doubt(blind[:, :3].T @ Y, GAIN[-1])
    assert (open_ > 0.01).all()
    assert set(told) == {"a", "b", "x", "y"}
    assert [told["x"], told["y"]] == pytest.approx((GAIN[-1] @ off + open_) / 1e2, rel=1e-9)
    assert told["a"] == pytest.approx(1e-3, rel=1e-6)


def test_what_is_unfinished_has_no_deviations():
    """Where what is required is not met, and the end is over four deviations from least squares."""
    std = np.full((3, 3, 5), 0.1)
    std[:, :2] = 9.0  # early on
    final = LEAST + 0.1 * np.array([[0.0, 3.9, 0.0], [0.0, 0.0, -4.1], [-3.9, 3.9, 3.9]])
    columns = np.arange(3)
    same, why = doubts.finished(std.copy(), ROOT, final, required(True), columns)
    np.testing.assert_array_equal(same, std)
    assert why == ""
    found, why = doubts.finished(std.copy(), ROOT, final, required(False), columns)
    assert np.isnan(found[1]).all()
    np.testing.assert_array_equal(found[[0, 2]], std[[0, 2]])
    assert why == doubts.UNFINISHED
    assert doubts.finished(std[:1].copy(), ROOT, final[1:2], required(False), columns) == (
        None, doubts.UNFINISHED
    )
    near, why = doubts.finished(std[:1].copy(), ROOT, final[:1], required(False), columns)
    np.testing.assert_array_equal(near, std[:1])
    assert why == ""
    none = doubts.finished(std, ROOT, final, required(False), columns[:0])
    assert (none[0] is std, none[1]) == (True, "")


def test_deviations_at_samples_are_those_of_each_case_that_has_some():
    """Of four cases the second one is not done at the end, and the last one did not move at all."""
    std, by_noise = np.full((4, 3, 5), 0.1), np.ones((4, 3), dtype=bool)
    by_noise[1:, 2], by_noise[2, 2], by_noise[3, 1] = False, True, False
    made = OnlineEstimates(*[None] * 8, std, np.array([9.0, 9.0, 2.0]), GAIN, by_noise)
    kept, told = np.array([0, 2]), np.ones((4, 2, 5), dtype=bool)
    told[2, 0, 3:] = False

    def at(*cases):
        some = replace(made, std=std[[*cases]], by_noise=by_noise[[*cases]])
        still = np.array([case == 3 for case in cases])
        return some.at(kept, told[[*cases]], still)

    found, gain, why = at(0, 1, 2, 3)
    expected = np.full((4, 2, 5), 0.2)
    expected[1, 1], expected[2, 0, 3:], expected[3] = np.nan, np.nan, np.nan
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(gain, np.stack([GAIN[kept]] * 4))
    assert why == doubts.UNFINISHED
    assert at(0, 3)[2] == at(3)[2] == ""  # that it stands still is said elsewhere
    assert np.isnan(at(3)[0]).all()
    kept, told = kept[1:], told[:, 1:]
    found, _, why = at(1, 3)
    assert (found, why) == (None, doubts.UNFINISHED)


def test_estimates_moved_by_noise_are_near_least_squares_until_the_requirement_is_met():
    std = np.full((2, 4, 5), 0.1)
    std[0, 0, :3] = 0.0  # nothing has moved the first case yet,
    roots = np.stack([ROOT, ROOT, ROOT, np.zeros_like(ROOT)])
    away = [[0.0, 0.0, 0.0], [0.0, -4.1, 0.0], [-3.9, 3.9, 0.0], [9.0, 9.0, 9.0]]
    eta = LEAST + 0.1 * np.array([away, np.zeros((4, 3))])
    met = np.array([False, False, False, True])
    found = doubts.moved_by_noise(std, eta, roots, met)
    np.testing.assert_array_equal(found, [[False, False, True, True], [True] * 4])
    std[0, :, 2] = 0.0  # and one of its parameters never
    for known in (None, np.ones(4, dtype=bool)):
        found = doubts.moved_by_noise(std, eta, roots, known)
        np.testing.assert_array_equal(found, [[False, True, True, True], [True] * 4])


def test_a_case_that_is_where_it_began_is_still():
    """Beside the size of a parameter that alone would explain Y, and only for want of something."""
    eta = np.zeros((3, 2, 2))
    eta[:, 1] = [[0.9e-9, 0.9e-3], [1.1e-9, 0.0], [0.0, 1.1e-3]]
    natural = np.array([1.0, 1e6])
    assert doubts.still(eta, required(False), natural).tolist() == [True, False, False]
    assert not doubts.still(eta, required(True), natural).any()
    assert not doubts.still(eta[..., :0], required(False), natural[:0]).any()
