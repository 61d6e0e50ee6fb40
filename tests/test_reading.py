"""Plain mappings become dataclasses, or one line says why not."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import refused

from gpebo_cli.errors import ConfigError
from gpebo_cli.observers.gpebo import Gpebo
from gpebo_cli.reading import as_seen_from_here, beside, read_bytes
from gpebo_cli.schema import LARGEST, nearest, number, per_name, plain, read
from gpebo_cli.settings import OutputSettings, SolverSettings, TimeSettings


@dataclass(frozen=True)
class Filter:
    """A field whose key is a Python keyword, one that is nested, one that takes anything."""

    rate: float = field(metadata={"key": "lambda"})
    time: TimeSettings = field(default_factory=TimeSettings)
    anything: object = None
    by_name: Mapping[str, int] = field(default_factory=dict)


ACCEPTED = [  # what is read as a field, with its type
    *((SolverSettings, "tol", value, 1e-9) for value in (1e-9, "1e-9", "1E-9", " 1e-9 ")),
    *((SolverSettings, "max_elements", value, 7) for value in (7, 7.0, "7")),
    (SolverSettings, "max_elements", "1e3", 1000),
    (SolverSettings, "max_elements", 2**53 + 1, 2**53 + 1),  # not by way of float
    (TimeSettings, "horizon", 5, 5.0),
    *((Gpebo, "xi_a0", value, value) for value in (None, [1.0, 0.0], {"e1": 1.0})),
]


@pytest.mark.parametrize(("kind", "key", "value", "expected"), ACCEPTED)
def test_what_is_contentbecomes_what_is_wanted(kind, key, value, expected):
    found = getattr(read(kind, {key: value}, "section"), key)
    assert (found, type(found)) == (expected, type(expected))


REFUSED = [
    *((SolverSettings, {"tol": value}, r"^f\.tol: expected a finite number, got")
      for value in (True, "abc", None, [1.0], {}, float("nan"), "inf", 10**400)),
    *((SolverSettings, {"stages": value}, r"^f\.stages: expected a whole number, got")
      for value in (1.5, "1.5", False, "x", float("inf"))),
    *((SolverSettings, value, r"^f: expected a mapping") for value in (None, 3, "x", [1])),
    (SolverSettings, {"tool": 1}, r"f\.tool: no such key; .*did you mean tol\?"),
    (Gpebo, {"regression": "papre"}, r"projected or paper, got 'papre'; did you mean"),
    (OutputSettings, {"figures": [1]}, r"true or false or a list \(each text\), got \[1\]"),
    (Filter, {"lambda": 1, "time": {"begin": 0}}, r"^f\.time\.begin: no such key"),
    (Filter, {"lambda": 1, "by_name": {"a": 2.5}}, r"^f\.by_name\.a: expected a whole number"),
    (Filter, {"lambda": 1, "by_name": {1: 2}}, r"^f\.by_name: names must be text, got 1"),
    (Filter, {"rate": 1}, r"^f\.rate: no such key"),
    (Filter, {}, r"^f\.lambda is missing"),
    (SolverSettings, {"tol": "x" * 10_000}, r"^.{,200}$"),
]


@pytest.mark.parametrize(("kind", "content", "said"), REFUSED)
def test_what_does_not_fit_is_refused_with_what_is_accepted(kind, content, said):
    with pytest.raises(ConfigError, match=said):
        read(kind, content, "f")


def test_absent_renamed_nested_and_untyped_fields():
    assert read(SolverSettings, {}, "solver") == SolverSettings()
    built = read(
        Filter, {"lambda": 1, "time": {"start": 1}, "anything": "x", "by_name": {"a": 2}}, "f"
    )
    assert built == Filter(1.0, TimeSettings(start=1.0), "x", {"a": 2})


def test_a_file_is_read_up_to_as_many_bytes_as_it_may_have(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with refused("has 5 bytes; at most 4 are read"):
        read_bytes(tmp_path / "a", 4)


@pytest.mark.parametrize("value", [2, "2", 2.0, np.int64(2), np.array(2.0)])
def test_a_number_may_come_in_many_ways(value):
    assert number(value, "x") == 2.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_numbers_of_either_sign_may_be_as_large_as_is_said(sign):
    assert number(sign * LARGEST, "x", "finite") == sign * LARGEST
    with refused(f"x: {2.0 * sign * LARGEST:g} is too large; numbers go up to {LARGEST:g} here"):
        number(2.0 * sign * LARGEST, "x", "finite")


def test_a_path_is_told_as_it_is_seen_from_here_where_that_is_shorter(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert as_seen_from_here(str(tmp_path / "a" / "b.csv")) == os.path.join("a", "b.csv")
    monkeypatch.chdir(tmp_path.anchor)
    assert as_seen_from_here("b.csv") == "b.csv"
    deep = tmp_path / "/".join(["a"] * 9)
    deep.mkdir(parents=True)
    monkeypatch.chdir(deep)
    assert as_seen_from_here(tmp_path.anchor) == tmp_path.anchor


def test_content_from_python_is_what_a_file_would_say(tmp_path):
    content = {"word": np.str_("ab"), "rows": (np.arange(2), range(2)), "size": np.float32(0.5),
               "file": tmp_path, "raw": b"ab", "own": type("Word", (str,), {})("cd")}
    found = plain(content)
    assert found == {"word": "ab", "rows": [[0, 1], [0, 1]], "size": 0.5, "file": str(tmp_path),
                     "raw": b"ab", "own": "cd"}
    assert type(found["rows"][0][0]) is int


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
def test_whatever_is_contentthe_answer_is_settings_or_one_config_error(mapping):
    try:
        built = read(SolverSettings, mapping, "solver")
    except ConfigError:
        return
    assert type(built.tol) is float
    assert type(built.stages) is int


def test_a_plant_from_python_may_name_any_file_and_one_of_a_configuration_may_not(tmp_path):
    source = str(tmp_path / "plant" / "mine.yaml")
    assert beside(os.devnull, "", "inputs.u") == os.devnull
    with pytest.raises(ConfigError, match=rf"inputs\.u: {os.devnull} lies outside of "):
        beside(os.devnull, source, "inputs.u")


@pytest.mark.parametrize("given", ["10", 10, [10, "10"], {"a": "10", "b": 10}])
def test_a_number_for_every_name_may_come_as_text(given):
    assert per_name(given, ["a", "b"], "thing", "here").tolist() == [10.0, 10.0]
