"""Plain mappings become dataclasses, or one line says why not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpebo_cli.errors import ConfigError
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.schema import nearest, read
from gpebo_cli.settings import OutputSettings, SolverSettings, TimeSettings


@dataclass(frozen=True)
class Filter:
    """A field whose key is a Python keyword, one that is nested, one that takes anything."""

    rate: float = field(metadata={"key": "lambda"})
    time: TimeSettings = field(default_factory=TimeSettings)
    anything: object = None
    by_name: Mapping[str, int] = field(default_factory=dict)


def test_absent_keys_have_their_defaults():
    assert read(SolverSettings, {}, "solver") == SolverSettings()


@pytest.mark.parametrize("value", [1e-9, "1e-9", "1E-9", " 1e-9 "])
def test_numbers_may_be_text(value):
    assert read(SolverSettings, {"tol": value}, "solver").tol == 1e-9


@pytest.mark.parametrize(("value", "expected"), [(7, 7), (7.0, 7), ("7", 7), ("1e3", 1000)])
def test_whole_numbers_may_be_written_as_floats(value, expected):
    found = read(SolverSettings, {"max_elements": value}, "solver").max_elements
    assert found == expected
    assert type(found) is int


def test_large_integers_are_not_rounded():
    assert read(SolverSettings, {"max_elements": 2**53 + 1}, "solver").max_elements == 2**53 + 1


def test_an_integer_becomes_a_float_where_one_is_wanted():
    horizon = read(TimeSettings, {"horizon": 5}, "time").horizon
    assert type(horizon) is float


@pytest.mark.parametrize("value", [True, "abc", None, [1.0], {}, float("nan"), "inf", 10**400])
def test_what_is_not_a_finite_number_is_refused(value):
    with pytest.raises(ConfigError, match=r"^solver\.tol: expected a finite number, got"):
        read(SolverSettings, {"tol": value}, "solver")


@pytest.mark.parametrize("value", [1.5, "1.5", False, "x", float("inf")])
def test_what_is_not_a_whole_number_is_refused(value):
    with pytest.raises(ConfigError, match=r"^solver\.stages: expected a whole number, got"):
        read(SolverSettings, {"stages": value}, "solver")


def test_an_unknown_key_is_answered_with_the_nearest():
    with pytest.raises(ConfigError, match=r"solver\.tool: no such key; .*did you mean tol\?"):
        read(SolverSettings, {"tool": 1}, "solver")


def test_a_wrong_choice_names_what_is_accepted():
    with pytest.raises(ConfigError, match=r"projected or paper, got 'papre'; did you mean"):
        read(Gpebo, {"regression": "papre"}, "observer")


@pytest.mark.parametrize("value", [None, [1.0, 0.0], {"e1": 1.0}])
def test_unions_take_each_of_their_types(value):
    assert read(Gpebo, {"xi_a0": value}, "observer").xi_a0 == value


def test_a_union_that_fits_nothing_names_all_its_types():
    with pytest.raises(ConfigError, match=r"true or false or a list \(each text\), got \[1\]"):
        read(OutputSettings, {"figures": [1]}, "output")


def test_renamed_nested_and_untyped_fields():
    built = read(
        Filter, {"lambda": 1, "time": {"start": 1}, "anything": "x", "by_name": {"a": 2}}, "f"
    )
    assert built == Filter(1.0, TimeSettings(start=1.0), "x", {"a": 2})
    with pytest.raises(ConfigError, match=r"^f\.time\.begin: no such key"):
        read(Filter, {"lambda": 1, "time": {"begin": 0}}, "f")
    with pytest.raises(ConfigError, match=r"^f\.by_name\.a: expected a whole number"):
        read(Filter, {"lambda": 1, "by_name": {"a": 2.5}}, "f")
    with pytest.raises(ConfigError, match=r"^f\.by_name: names must be text, got 1"):
        read(Filter, {"lambda": 1, "by_name": {1: 2}}, "f")


def test_the_name_of_a_renamed_field_is_not_its_key():
    with pytest.raises(ConfigError, match=r"^f\.rate: no such key"):
        read(Filter, {"rate": 1}, "f")


def test_a_key_without_default_must_be_given():
    with pytest.raises(ConfigError, match=r"^f\.lambda is missing"):
        read(Filter, {}, "f")


@pytest.mark.parametrize("value", [None, 3, "x", [1]])
def test_what_is_not_a_mapping_is_refused(value):
    with pytest.raises(ConfigError, match=r"^solver: expected a mapping"):
        read(SolverSettings, value, "solver")


def test_a_long_value_is_shortened_in_the_message():
    with pytest.raises(ConfigError) as error:
        read(SolverSettings, {"tol": "x" * 10_000}, "solver")
    assert len(str(error.value)) < 200


def test_nearest_says_nothing_when_nothing_is_near():
    assert nearest("circut", ["circuit", "descriptor"]) == "; did you mean circuit?"
    assert nearest("zzz", ["circuit", "descriptor"]) == ""


words = st.text("ae1.-_ {", max_size=6)
json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(["tol", "stages", "name", "rank_tol", "x"]), json))
def test_whatever_is_given_the_answer_is_settings_or_one_config_error(mapping):
    try:
        built = read(SolverSettings, mapping, "solver")
    except ConfigError:
        return
    assert type(built.tol) is float
    assert type(built.stages) is int
