"""Both twins of every kernel: the same numbers, and the compiled one really answers."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kernel_paths import needs_kernels

from gpebo_cli import kernels
from gpebo_cli.kernels import laws_numpy, signals_numpy, structure_numpy
from gpebo_cli.numerics.elimination import steps_of
from gpebo_cli.numerics.linalg import affine_scan
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers.reduced import matrices
from gpebo_cli.observers.reduced.split import Frame
from gpebo_cli.reduction.form import Equations
from gpebo_cli.reduction.scaling import Units
from gpebo_cli.reduction.strangeness_free import forcing

EPS = float(np.finfo(float).eps)
Case = Callable[[np.random.Generator], tuple[Any, ...]]


def _mixed(rng, count=37, p=3, c=2):
    extended = rng.normal(size=(count, p, p + c))
    extended[: count // 4] *= 1e-40  # squares of determinants would underflow
    extended[count // 2 :] *= 1e40
    return extended, None


def _regularised(rng, count=19, p=7, c=2):
    """In units of many sizes."""
    units = 10.0 ** rng.integers(-6, 7, size=p)
    rows = rng.normal(size=(count, 2 * p, p)) * units
    gram = np.swapaxes(rows, 1, 2) @ rows
    right = gram @ (rng.normal(size=(count, p, c)) / units[:, None])
    added = np.where(np.arange(count) % 10 == 0, 1e-3, 0.0) * gram[:, 0, 0]
    return np.concatenate([gram, right], axis=2), added


def _law(rng, cases=11, gains=1, p=3):
    steps, times = 30, 40
    return (
        rng.exponential(size=steps), *rng.normal(size=(3, steps, p)),
        rng.integers(0, steps, times), rng.exponential(size=times), rng.uniform(size=times),
        rng.normal(size=(1, p)), 10 ** rng.uniform(-8, 4, size=(cases, gains)),
    )


def _errors(rng, cases=11, times=70, p=3, n=4, constant=False, levels=True):
    of_time = 1 if constant else times
    truth, x = rng.normal(size=(of_time, p)), rng.normal(size=(of_time, n))
    truth[:, 1] = np.nan  # has no weight
    return (
        rng.normal(size=(cases, times, p)), truth, np.array([2.0, 0.0, 1.0]),
        rng.normal(size=(of_time, n)), rng.normal(size=(of_time, n, p)), x,
        rng.uniform(0.5, 2.0, size=n),
        rng.uniform(0.5, 9.0, size=(cases, p + n)) if levels else None, 0.3,
    )


def _equation(rng, k=9, s=5, n=3, c=2, *, identity=False, constrained=False, constant=False):
    rule = radau_rule(s)
    points = 1 if constant else k * (s + 1)
    d = n - 1 if constrained else n
    E = None if identity else rng.normal(size=(points, d, n)) + 2.0 * np.eye(d, n)
    basis = rng.normal(size=(points, n, d)) + np.eye(n, d) if constrained else None
    offset = rng.normal(size=(k * (s + 1), n, c)) if constrained else None
    group = np.arange(k) if not constant else np.arange(k) % 2
    h = np.where(group == 0, 0.1, 0.2) if constant else rng.uniform(0.1, 0.2, size=k)
    return (
        rule.differentiation, h, E, rng.normal(size=(points, d, n)),
        rng.normal(size=(k * (s + 1), d, c)), basis, offset, group, int(group.max()) + 1,
    )


def _maps(rng, k=7, s=4, n=3, c=2, one=False):
    return (
        rng.normal(size=(1 if one else k, s, n, n)) / 2, rng.normal(size=(k, s, n, c)),
        rng.normal(size=(n, c)),
    )


def _carried(rng, k=6, s=5, n=3, c=2, constant=False, still=False, unit=1.0):
    rule, maps = radau_rule(s), 1 if constant else k
    noise = rng.uniform(size=(1, n, n + c)) * np.ones((k, 1, 1)) if constant else (
        rng.uniform(size=(k, n, n + c))
    )
    t = rng.uniform(size=(k, s + 1, n, c))  # some components are smooth, and one is zero
    values = np.where(rng.uniform(size=(n, c)) < 0.5, np.cos(0.01 * t), rng.normal(size=t.shape))
    values[:, :, :: 1 if still else n, :: 1 if still else c] = 0.0  # rounding alone is left
    used = min(4, s - 1)
    return (
        unit * values, rule.to_legendre, (s + 1) / np.arange(s + 1 - used, s + 1),
        rng.normal(size=(maps, n, n)), unit * rng.normal(size=(k, n, c)), noise,
        rng.choice([-1.0, 1.0], size=(k + 1, n, 6)), 0.3, 8.0, np.inf if constant else 4.0,
    )


def _series(
    rng, k=5, s=4, d=6, c=2, constant=False, forced=1, kicked=True, most=4, degrees=3, unit=1.0,
    rate=1.0,
):
    """x' = A x + f with a third of the entries, none of them in one row."""
    i, j = np.nonzero(rng.uniform(size=(d, d)) < 0.35 * (np.arange(d) != 1)[:, None])
    parts = rng.integers(1, most, size=k)
    count, degrees = (1, 1) if constant else (parts.sum(), degrees)
    there = rng.integers(0, 2, size=(count, degrees))
    return (
        radau_rule(s).nodes, rng.uniform(0.1, 0.3, size=k), parts,
        np.searchsorted(i, np.arange(d + 1)), j,
        rate * rng.normal(size=(count, len(i), degrees)) * there[:, None] / degrees,
        1.0 * np.maximum.accumulate(there[:, ::-1], axis=1)[:, ::-1],
        unit * rng.normal(size=(parts.sum(), 2, d, forced)),
        unit * rng.normal(size=(k, d, c)) if kicked else None, unit * rng.normal(size=(d, c)),
        np.exp(rng.normal(size=d)), 1e-15, 1e-3,
    )


# Columns of each row: a ring of five states, which elimination fills, one row of it empty; and a
# pattern in which it fills the place of the very first entry.
RING = (0, 1, 4), (0, 1, 2), (1, 2, 3), (), (0, 3, 4)
FILLED = (1, 2, 3), (2, 3), (1, 2), (0, 1, 3)


def _stiff(rng, k=5, s=4, c=2, forced=1, kicked=True, one=False, pattern=RING):
    columns, d = np.concatenate(pattern).astype(np.intp), len(pattern)
    rows = np.cumsum([0, *map(len, pattern)])
    points = 1 if one else k * (s + 1)
    return (
        radau_rule(s).differentiation, np.full(k, 0.3) if one else rng.uniform(0.1, 0.3, size=k),
        *steps_of(rows.tobytes(), columns.tobytes()), rng.normal(size=(points, len(columns))),
        rng.normal(size=(points, d, forced)), rng.normal(size=(k, d, c)) if kicked else None,
        rng.normal(size=(d, c)),
    )


def _signal(rng, k=8, s=6, c=5, least=False):
    values = rng.normal(size=(k, s + 1, c)) * 10.0 ** rng.integers(-12, 3, size=c)
    values += 10.0 * np.abs(values).max(axis=(0, 1))  # so that what is left out is not everything
    sizes = 10.0 ** rng.integers(-12, 3, size=c) if least else None
    return values, radau_rule(s).to_legendre, min(4, s - 1), 1e-8, 1e-3, 1e-5, sizes


def _samples(rng, k=6, points=5, c=4, count=50):
    weights, values = rng.normal(size=(count, points)), rng.normal(size=(k, points, c))
    return rng.integers(0, k, count), weights, values


def _places(rng, k=6, s=5, count=50):
    rule, edges = radau_rule(s), np.cumsum(rng.uniform(0.1, 1.0, size=k + 1))
    at_points = (edges[:-1, None] + np.diff(edges)[:, None] * rule.points).ravel()
    t = np.concatenate([rng.uniform(edges[0] - 0.1, edges[-1] + 0.1, count), at_points])
    return edges, rule.points, rule.barycentric, t, t + rng.choice([0.0, 0.01], len(t)), 4.0 * EPS


def _model(rng, times=19, n=3, constant=False, turned=False, steady=False):
    """E x' = A x of index 2: x1' = … , 0 = x1-like, perhaps turned; and its scales.

    E and A are ``constant``, or E alone is ``steady``.
    """
    orders, count = 2, 1 if constant else times
    E, A = 0.1 * rng.normal(size=(2, orders, count, n, n))
    E[:, :, -1] = 0.0
    E[:, :, :, -1] = 0.0
    E[0, :, :-1, :-1] += np.eye(n - 1)
    A[:, :, -1, -1] = 0.0
    A[0, :, -1, 0], A[0, :, 0, -1] = 1.0, 1.0
    if turned:  # then rows and columns differ in nothing but their numbers
        left, right = np.linalg.qr(rng.normal(size=(2, n, n)))[0]
        E, A = left @ E @ right, left @ A @ right
    E = E[:, :1] if steady else E
    return E, A, 2.0 ** rng.integers(-2, 3, size=n), 2.0 ** rng.integers(-2, 3, size=n), 0.5, orders


def _start(rng, **options):
    return (*_model(rng, **options), 7, 1e-10)


def _levels(rng, constraints=-1, **options):
    return (*_model(rng, **options), 1e-10, constraints)


def _pivots(model):
    from gpebo_cli.kernels.structure_numpy import reference

    a, _, rows, columns, Z1 = reference(*model, 0, 1e-10)
    return rows, columns, len(rows) - a, Z1


def _bounds(rng, **options):
    model = _model(rng, **options)
    return *model, *_pivots(model)


def _eliminated(rng, times=19, q=1, growth=3e2, **options):
    model = _model(rng, times=times, **options)
    orders, n = model[5], len(model[2])
    inputs = (
        rng.normal(size=(orders, 1, n, 2)), rng.normal(size=(orders, times, n, q)),
        rng.normal(size=(orders, times, 2)), rng.normal(size=(orders, 1, q)),
    )
    return *model, *inputs, *_pivots(model), 4, growth, 1e-13


def _in_two_steps(numpy, E, A, rows, columns, time, orders, B, F, u, theta, *pivots_and_limits):
    e, a = numpy.scaled(E, A, rows, columns, time, orders)
    M, N = numpy.derivative_array(e, a, orders - 1)
    phi = np.zeros((*u.shape[:2], len(rows)))
    f = forcing(SimpleNamespace(B=B, F=F, u=u, theta=theta, phi=phi))
    g = np.moveaxis(f * (time ** np.arange(orders))[:, None, None] * rows, 0, 1)
    *pivots, Z1, every, growth, residual = pivots_and_limits
    A2, f2, size, inverse, poor = numpy.by_elimination(
        e[0], M, N, g.reshape(len(g), -1, 1), *pivots, Z1, every, growth, residual
    )
    return None if poor.any() else numpy.in_own_states(
        E[0], A[0], f[0], A2, f2, size, inverse, rows, columns, every
    )


def _in_frame(rng, times=11, n=4, m=1, q=2, r=2, d=2, constant=()):
    def varying(name, rows, columns):
        return rng.normal(size=(1 if name in constant else times, rows, columns))

    axes = np.eye(n)
    E = varying("E", n, n)
    E[:, d:] = E[:, :, d:] = 0.0
    E[:, :d, :d] += 3.0 * np.eye(d)
    return (
        E, varying("A", n, n), varying("B", n, m), varying("F", n, q), varying("C", r, n),
        2.0 ** rng.integers(-2, 3, size=n), rng.uniform(1, 2, size=r), axes[:, :d], axes[:, :d],
        axes[:, d:], axes[d:],
    )


def _by_steps(E, A, B, F, C, rows, scale, domain, range_, kernel, equations):
    """What ``in_frame`` returns by the way that does without it."""
    (n, q), (r, m) = F.shape[1:], (len(scale), B.shape[2])
    units = Units(np.ones(n), rows, np.ones(r), np.ones(q))
    model = Equations(E, A, B, F, C, np.zeros((1, r, m)), np.zeros((1, r, q)), None)
    plant = SimpleNamespace(r=r, states=tuple("abcdefgh")[:n])
    o = matrices._by_steps(
        SimpleNamespace(system=plant, units=units), model, scale, np.zeros(1), 1e-10, None,
        Frame(domain, domain.T, range_, kernel, equations), lambda: E,
    )
    inner = range_.T @ (E / rows[:, None]) @ domain
    norms = [np.linalg.norm(x, axis=(1, 2)).max() for x in (inner, np.linalg.inv(inner))]
    times = max(map(len, (E, A, B, F, C)))
    driven = (np.broadcast_to(x, (times, *x.shape[1:])) for x in (o.from_unknowns, o.from_signals))
    return (
        np.array([0.0, *norms]), o.split.pinv, o.algebraic, o.on_basis, o.g_signals, o.G, o.range,
        o.elimination, o.injectivity, o.dynamics, *driven,
    )


def _regression(rng, times=11, n=4, k=2, q=1, rows=3, b=2, one=False, axes=None, unit=1.0):
    of_time = 1 if one else times
    basis = rng.normal(size=(n, k)) if axes is None else np.eye(n)[:, axes]
    return (
        unit * rng.normal(size=(times, k, 1 + q + k)), q, basis,
        rng.normal(size=(of_time, rows, k)), unit * rng.normal(size=(times, rows)),
        unit * rng.normal(size=(of_time, rows, q)),
        np.linalg.qr(rng.normal(size=(of_time, rows, b)))[0], rng.normal(size=(of_time, n, b)),
    )


CASES: list[tuple[str, str, Case]] = [
    ("observer", "in_frame", _in_frame),
    ("observer", "in_frame", partial(_in_frame, times=1)),
    ("observer", "in_frame", partial(_in_frame, constant=("E", "A", "B", "F", "C"))),
    ("observer", "in_frame", partial(_in_frame, m=0, q=0, constant=("A", "C"))),
    ("observer", "in_frame", partial(_in_frame, n=6, r=3)),
    ("observer", "regression_signals", _regression),
    ("observer", "regression_signals", partial(_regression, q=0, one=True)),
    ("observer", "regression_signals", partial(_regression, axes=[1, 2], unit=1e-6)),
    ("observer", "regression_signals", partial(_regression, q=2, axes=[0, 3])),
    ("structure", "reference", _start),
    ("structure", "reference", partial(_start, n=5)),
    ("structure", "reference", partial(_start, n=4, turned=True)),
    ("structure", "reference", partial(_start, steady=True)),
    ("structure", "levels", _levels),
    ("structure", "levels", partial(_levels, constraints=2, times=2)),
    ("structure", "levels", partial(_levels, steady=True)),
    ("structure", "bounds", _bounds),
    ("structure", "bounds", partial(_bounds, n=5, times=1)),
    ("structure", "bounds", partial(_bounds, steady=True)),
    ("structure", "eliminated", _eliminated),
    ("structure", "eliminated", partial(_eliminated, n=6, q=0)),
    ("structure", "eliminated", partial(_eliminated, times=9, constant=True)),
    ("structure", "eliminated", partial(_eliminated, steady=True)),
    *(("elements", "element_maps", partial(_equation, **options)) for options in (
        {}, {"identity": True}, {"constrained": True}, {"constant": True},
        {"constant": True, "constrained": True}, {"constant": True, "identity": True},
        {"k": 1, "s": 2, "n": 1, "c": 1}, {"n": 7, "s": 14}, {"n": 1, "c": 20},
    )),
    ("elements", "chain", _maps),
    ("elements", "chain", partial(_maps, one=True)),
    ("elements", "chain", partial(_maps, k=1, n=16, c=9)),
    *(("elements", "carried_errors", partial(_carried, **options)) for options in (
        {}, {"k": 2}, {"k": 9, "constant": True}, {"k": 1, "s": 2, "n": 1, "c": 1},
        {"s": 14, "n": 5}, {"still": True}, {"unit": 1e-6}, {"unit": 4e307},
    )),
    *(("elements", "series", partial(_series, **options)) for options in (
        {}, {"constant": True, "forced": 0}, {"s": 14, "c": 13, "kicked": False},
        {"k": 1, "d": 1, "c": 3, "forced": 3}, {"c": 17}, {"most": 9},
        {"c": 1, "degrees": 6, "s": 14}, {"c": 1, "constant": True, "forced": 0}, {"unit": 1e-6},
        {"rate": 30.0},  # no series converges
    )),
    *(("elements", "stiff", partial(_stiff, **options)) for options in (
        {}, {"s": 14, "c": 1, "one": True}, {"forced": 0, "kicked": False}, {"pattern": FILLED},
    )),
    ("signals", "tails", _signal),
    ("signals", "tails", partial(_signal, k=1, s=2, c=17)),
    ("signals", "tails", partial(_signal, least=True)),
    ("signals", "tails", partial(_signal, c=0)),
    ("signals", "largest", lambda rng: (1e-3 * rng.normal(size=(4, 7, 21)),)),
    ("signals", "largest", lambda rng: (np.swapaxes(rng.normal(size=(3, 2, 30)), 0, 1),)),
    ("signals", "sample", _samples),
    ("signals", "sample", partial(_samples, c=33)),
    ("signals", "interpolation", _places),
    ("signals", "interpolation", partial(_places, k=1, s=2)),
    ("laws", "mixed", _mixed),
    ("laws", "mixed", lambda rng: _mixed(rng, 8, 1, 1)),
    ("laws", "mixed", lambda rng: _mixed(rng, 1, 6, 1)),
    ("laws", "mixed", _regularised),
    ("laws", "mixed", partial(_regularised, p=30, c=40)),
    ("laws", "stepped_law", _law),
    ("laws", "stepped_law", lambda rng: _law(rng, 1)),
    ("laws", "stepped_law", lambda rng: _law(rng, 17, 3)),
    ("laws", "squared_errors", _errors),
    ("laws", "squared_errors", lambda rng: _errors(rng, 1, 5, constant=True)),
    ("laws", "squared_errors", lambda rng: _errors(rng, levels=False)),
    ("laws", "squared_errors", lambda rng: (*_errors(rng)[:2], np.zeros(3), *_errors(rng)[3:])),
]
NAMES = [f"{subject}-{name}-{i}" for i, (subject, name, _) in enumerate(CASES)]


def both(subject: str, name: str, arguments: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    """What the twins return, as tuples; the compiled one must not have left it to NumPy."""
    found = []
    for kind in ("numpy", "compiled"):
        module = import_module(f"gpebo_cli.kernels.{subject}_{kind}")
        with pytest.MonkeyPatch.context() as patch:
            if kind == "compiled":
                refuse = SimpleNamespace()  # without the NumPy twin
                patch.setattr(module, f"{subject}_numpy", refuse, raising=False)
            answer = getattr(module, name)(*arguments)
        if name == "eliminated" and kind == "numpy":
            answer = _in_two_steps(module, *arguments)
        if name == "in_frame" and kind == "numpy":
            answer = _by_steps(*arguments)
        found.append(answer if isinstance(answer, tuple) else (answer,))
    return found


@needs_kernels
@pytest.mark.parametrize(("subject", "name", "case"), CASES, ids=NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_twins_agree(subject, name, case, seed):
    arguments = case(np.random.default_rng(seed))
    for one, other in zip(*both(subject, name, arguments), strict=True):
        expected, found = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
        if name == "in_frame" and expected.ndim == 3:  # columns of Q1 and H are up to a sign
            expected, found = np.abs(np.broadcast_to(expected, found.shape)), np.abs(found)
        assert expected.shape == found.shape
        if name == "reference" and expected.ndim == 2:  # a basis: its span counts
            expected, found = expected @ expected.T, found @ found.T
        size = np.abs(expected).max(axis=-1, keepdims=True, initial=0.0)
        if name == "bounds":  # what elimination leaves is rounding
            size = np.maximum(size, 1e-5)
        # Relative to a vector's largest component; where both are not finite they are the same.
        with np.errstate(invalid="ignore"):
            same = np.abs(found - expected) <= 1e-9 * size
        assert (same | (expected == found) | (np.isnan(expected) & np.isnan(found))).all()


@needs_kernels
@pytest.mark.parametrize(("subject", "name", "case"), CASES, ids=NAMES)
def test_arguments_that_are_no_such_arrays_are_refused(subject, name, case):
    del subject
    compiled = getattr(import_module("gpebo_cli.kernels._compiled"), name)
    arguments = case(np.random.default_rng(0))
    for place, value in enumerate(arguments):
        if isinstance(value, np.ndarray):
            for wrong in (value.astype(complex), value[None], value.tolist()):
                with pytest.raises(TypeError, match=f"argument {place} must be"):
                    compiled(*arguments[:place], wrong, *arguments[place + 1 :])
    with pytest.raises(TypeError, match="expected"):
        compiled(*arguments[:-1])
    with pytest.raises(TypeError, match=r"expected|real|integer"):
        compiled(*arguments, "x")


@needs_kernels
@pytest.mark.parametrize(("name", "case", "place", "cut"), [
    ("stepped_law", _law, 1, np.s_[:-1]),
    ("stepped_law", _law, 2, np.s_[:, :-1]),
    ("stepped_law", _law, 5, np.s_[:-1]),
    ("stepped_law", _law, 7, np.s_[:, :-1]),
    ("stepped_law", lambda rng: _law(rng, 4, 3), 8, np.s_[:, :-1]),
    ("squared_errors", _errors, 1, np.s_[:-1]),
    ("squared_errors", _errors, 2, np.s_[:-1]),
    ("squared_errors", _errors, 4, np.s_[:, :, :-1]),
    ("squared_errors", _errors, 5, np.s_[:, :-1]),
    ("squared_errors", _errors, 7, np.s_[:, :-1]),
    ("squared_errors", _errors, 7, np.s_[:-1]),
    ("mixed", _mixed, 0, np.s_[:, :, :2]),
    *(("element_maps", partial(_equation, constrained=True), place, np.s_[:-1])
      for place in range(8)),
    ("chain", _maps, 0, np.s_[:-1]),
    ("chain", _maps, 1, np.s_[:, :-1]),
    ("chain", _maps, 2, np.s_[:-1]),
    *(("carried_errors", _carried, place, np.s_[:-1]) for place in (1, 3, 4, 5, 6)),
    *(("carried_errors", _carried, place, np.s_[:, :-1]) for place in (0, 3, 4, 5, 6)),
    *(("stiff", _stiff, place, np.s_[:-1]) for place in (0, 1, 2, 5, 6, 7, 8)),
    ("tails", _signal, 1, np.s_[:-1]),
    ("tails", partial(_signal, least=True), 6, np.s_[:-1]),
    ("sample", _samples, 1, np.s_[:-1]),
    ("sample", _samples, 2, np.s_[:2]),
    ("interpolation", _places, 2, np.s_[:-1]),
    ("interpolation", _places, 4, np.s_[:-1]),
    *(("bounds", _bounds, place, np.s_[:-1]) for place in (2, 3, 6, 7, 9)),
    ("levels", _levels, 1, np.s_[:, :, :, :-1]),
    ("levels", _levels, 0, np.s_[:1]),
    ("reference", _start, 1, np.s_[:, :-1]),
    *(("regression_signals", _regression, place, np.s_[:-1]) for place in (0, 2, 3, 4, 5, 6, 7)),
    *(("regression_signals", _regression, place, np.s_[..., :-1]) for place in (2, 3, 4, 5, 6, 7)),
    *(("eliminated", _eliminated, place, np.s_[:, :-1]) for place in (1, 7, 8)),
    *(("eliminated", _eliminated, place, np.s_[..., :-1]) for place in (6, 8, 9, 13)),
])  # fmt: skip
def test_arrays_that_do_not_fit_each_other_are_refused(name, case, place, cut):
    """What would lead out of an array is never read."""
    arguments = case(np.random.default_rng(0))
    wrong = (*arguments[:place], arguments[place][cut], *arguments[place + 1 :])
    with pytest.raises(ValueError, match=r"expected|will not do"):
        getattr(import_module("gpebo_cli.kernels._compiled"), name)(*wrong)


@pytest.mark.parametrize("scale", [0.0, 1e-310])
def test_a_matrix_of_zeros_among_others_has_the_determinant_zero(scale):
    extended, _ = _mixed(np.random.default_rng(0))
    extended[11:22] *= scale
    delta = kernels.laws.mixed(extended, None)[0]
    assert not delta[11:22].any()
    assert delta[:11].all()
    assert delta[22:].all()


def test_a_matrix_whose_inverse_has_no_finite_norm_is_singular_without_a_warning():
    extended = np.array([[[1e-160, 0.0, 1.0], [0.0, 1.0, 2.0]]])
    for twin in kernels.laws, laws_numpy:
        delta, quotient, condition = twin.mixed(extended, None)
        np.testing.assert_allclose(delta, [1e-160], rtol=1e-13)
        np.testing.assert_allclose(quotient[0, :, 0], [1e160, 2.0], rtol=1e-13)
        assert not condition[0] < 1e160


@needs_kernels
def test_what_is_large_is_left_to_numpy():
    rng = np.random.default_rng(0)
    for subject, name, arguments in (
        ("elements", "element_maps", _equation(rng, n=30)),
        ("structure", "bounds", _bounds(rng, n=20)),
    ):
        for one, other in zip(*both_kinds_answer(subject, name, *arguments), strict=True):
            np.testing.assert_array_equal(one, other)


def both_kinds_answer(subject: str, name: str, *arguments: Any) -> tuple[Any, Any]:
    """What the twins return where the compiled one may ask the other."""
    one, other = (
        getattr(import_module(f"gpebo_cli.kernels.{subject}_{kind}"), name)
        for kind in ("numpy", "compiled")
    )
    return one(*arguments), other(*arguments)


@needs_kernels
def test_entries_outside_of_a_frame_are_seen():
    arguments = _in_frame(np.random.default_rng(0))
    E, rows = arguments[0], arguments[5]
    E[3, -1, 0] = 0.1 * rows[-1]
    assert kernels.observer.in_frame(*arguments)[0][0] == pytest.approx(0.1)


@needs_kernels
def test_columns_that_are_nearly_alike_become_orthogonal():
    rng = np.random.default_rng(0)
    arguments = _in_frame(rng)
    for matrix in (arguments[1][:, 2:], arguments[4]):
        matrix[..., 3] = matrix[..., 2] + 1e-6 * rng.normal(size=matrix.shape[:2])
    Q1 = kernels.observer.in_frame(*arguments)[6]
    products = np.swapaxes(Q1, 1, 2) @ Q1
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(2), products.shape), atol=1e-14)


@needs_kernels
def test_what_is_rounding_is_regularised_with_pivots():
    extended, added = _regularised(np.random.default_rng(0))
    extended[4:6, :, :3] = extended[4:6, :3] = 0.0
    (_, one, _), (_, other, _) = both_kinds_answer("laws", "mixed", extended, 0.0 * added)
    np.testing.assert_array_equal(one[4:6], other[4:6])
    assert not other[4:6, :3].any()


def test_least_squares_of_less_than_everything_is_the_shortest():
    """x + y = 2 alone; and zero of zeros."""
    extended = np.zeros((2, 2, 3))
    extended[0] = [[1.0, 1.0, 2.0], [1.0, 1.0, 2.0]]
    found = laws_numpy.regularised(extended, np.zeros(2))
    np.testing.assert_allclose(found[..., 0], [[1.0, 1.0], [0.0, 0.0]], atol=1e-14)


def test_what_is_left_out_counts_beside_the_floor():
    """Of 1e-9 P_3 beside a floor of 1e-3 that is 1e-6 to the power of 4/3; of zeros nothing."""
    rule = radau_rule(3)
    x = 2.0 * rule.points - 1.0
    cubic = 1e-9 * 0.5 * (5.0 * x**3 - 3.0 * x)
    for values, floor, left in ((cubic, 1e-3, 1e-6), (cubic, 0.0, 1.0), (0.0 * cubic, 0.0, 0.0)):
        found = signals_numpy.tails(
            values[None, :, None], rule.to_legendre, 1, 0.0, 0.0, floor, None
        )
        assert found == pytest.approx(left ** (4 / 3), rel=1e-6)


@needs_kernels
def test_bounds_do_not_depend_on_the_units_of_all_equations():
    E, A, *others = _bounds(np.random.default_rng(0), turned=True)
    arguments = [("structure", "bounds", 8.0**k * E, 8.0**k * A, *others) for k in (0, 3)]
    for one, other in zip(*(both_kinds_answer(*each) for each in arguments), strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-300)


@needs_kernels
def test_where_the_pivots_will_not_do_both_say_so():
    arguments = _eliminated(np.random.default_rng(0), growth=1e-3)
    assert both_kinds_answer("structure", "eliminated", *arguments) == (None, None)


@needs_kernels
@pytest.mark.parametrize(("scale", "value", "constraints"), [
    *((1.0, value, -1) for value in (np.inf, np.nan, 1e200, 1e100)),  # their squares overflow
    (1e-70, 0.0, -1),  # squares vanish
    (1.0, 0.0, 1),  # the rank contradicts this number
])
def test_what_pivots_cannot_decide_is_left_to_lapack(scale, value, constraints):
    E, A, *others = _levels(np.random.default_rng(0), times=2, constraints=constraints)
    A[0, 1, 0, 0] += value
    compiled = import_module("gpebo_cli.kernels._compiled")
    assert compiled.levels(scale * E, scale * A, *others) is None


@needs_kernels
def test_a_time_beyond_the_last_one_is_refused():
    *model, _, rank_tol = _start(np.random.default_rng(0), times=2)
    with pytest.raises(ValueError, match="will not do"):
        import_module("gpebo_cli.kernels._compiled").reference(*model, 2, rank_tol)
    element, weights, values = _samples(np.random.default_rng(0), k=6)
    element[-1] = 6
    with pytest.raises(ValueError, match="will not do"):
        kernels.signals.sample(element, weights, values)


@needs_kernels
def test_a_chain_says_how_far_it_is_finite():
    maps, *others = _maps(np.random.default_rng(0))
    with np.errstate(over="ignore", invalid="ignore"):
        one, other = both("elements", "chain", (1e200 * maps, *others))
    assert one[1] == other[1] == 1


def test_nothing_is_renewed_that_is_not_finite():
    maps, *others = _maps(np.random.default_rng(0))

    def renew(reached):
        assert np.isfinite(reached).all()
        return reached

    assert kernels.elements.chain(1e200 * maps, *others, renew)[1] == 1


def test_kernels_are_there_where_they_were_asked_for():
    assert kernels.kind() == os.environ.get("GPEBO_KERNELS", kernels.kind())


def test_decays_are_accurate_to_the_last_digits():
    gains = 10.0 ** np.arange(-12.0, 4.0)[:, None]
    zero, one = np.zeros((1, 1)), np.ones((1, 1))
    eta = kernels.laws.stepped_law(
        np.ones(1), zero, one, zero, np.zeros(1, dtype=np.intp), np.ones(1), np.ones(1), zero,
        gains,
    )[:, 0, 0]
    mean = np.array([1 - x / 2 + x**2 / 6 if x < 1e-4 else -np.expm1(-x) / x for x in gains[:, 0]])
    np.testing.assert_allclose(eta, 1.0 - mean, rtol=1e-9, atol=2e-16)
    left = kernels.laws.stepped_law(  # e^{−x} of what it is about at the start, and nothing else
        np.ones(1), zero, zero, zero, np.zeros(1, dtype=np.intp), np.ones(1), np.ones(1), one, gains
    )[:, 0, 0]
    np.testing.assert_allclose(left, np.exp(-gains[:, 0]), rtol=1e-12)


@pytest.mark.parametrize("lanes", [1, 3, 3000])
def test_affine_scan(lanes):
    rng = np.random.default_rng(lanes)
    factor, shift = rng.uniform(0, 1, (40, lanes)), rng.normal(size=(40, lanes))
    z = affine_scan(factor, shift, np.ones(lanes))
    np.testing.assert_allclose(z[1:], factor * z[:-1] + shift, rtol=1e-12, atol=1e-12)


def test_the_largest_pivot_may_be_negative():
    """Where other pivots are taken, digits are lost."""
    arguments = list(_equation(np.random.default_rng(0), n=12))
    arguments[3] = arguments[3] + 1e9 * np.eye(12)
    one, other = both_kinds_answer("elements", "element_maps", *arguments)
    for mine, reference in zip(one, other, strict=True):
        np.testing.assert_allclose(mine, reference, rtol=1e-9, atol=1e-13 * np.abs(reference).max())


@pytest.mark.parametrize("twin", [kernels.structure, structure_numpy])
@pytest.mark.parametrize("rest", [2e-16, 1e-15])
def test_elimination_fails_where_its_pivots_are_singular_to_rounding(twin, rest):
    """M22 − X M12 is zero there, and M21 − X M11 is not: constraints would be wrong by as much."""
    M = np.array([[[0.3, 0.1, 0.0], [0.9, 0.3 + rest, 0.0], [0.6, 0.2, 0.0]]])
    order, one, scale = np.arange(3), np.eye(3)[None], np.ones(3)
    pivots = order, order, 2, np.eye(3)[:, :2].copy()
    assert twin.bounds(M[None], one[None], scale, scale, 1.0, 1, *pivots)[1][0] > 1e-3
    *_, poor = structure_numpy.by_elimination(
        one, M, one, np.ones((1, 3, 1)), *pivots, 1, 3e2, 1e-13
    )
    assert poor.all()


def test_elimination_that_overflows_fails_and_warns_of_nothing():
    M, one, order = np.diag([1e-300, 1.0])[None], np.eye(2)[None], np.arange(2)
    M[0, 1, 0] = 1e10
    *_, poor = structure_numpy.by_elimination(
        one, M, one, np.ones((1, 2, 1)), order, order, 1, np.eye(2)[:, :1].copy(), 1, 3e2, 1e-13
    )
    assert poor.all()
