"""Laws of the locator: every key that tomllib finds has the line where it was written."""

import tomllib
from typing import Any

import pytest
from harness_world import FULL
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.harness.suite.toml_text import key_lines, toml_line, toml_text

SAMPLE = '''# a comment = 1
top = 1
"quoted key" = """
[not.a.table]
x = 1
"""
a.b.c = { d = 1, "e f" = [1, { g = 2 }] }

[table]  # [comment]
list = [
  "one", # with ] and }
  { two = 2 },
  [ 3,
    4 ],
]
[[robot]]
use = 'ur5'
[robot.deep]
x = 1
[[robot]]
  use = "a#b"
[robot.deep]
y = 2024-01-01T00:00:00Z
[[robot.part]]
z = "\\"]"
'''
WHERE = {
    ("top",): 2,
    ("quoted key",): 3,
    ("a", "b"): 7,
    ("a", "b", "c", "d"): 7,
    ("a", "b", "c", "e f", 1, "g"): 7,
    ("table",): 9,
    ("table", "list", 0): 11,
    ("table", "list", 1, "two"): 12,
    ("table", "list", 2, 1): 14,
    ("robot", 0, "use"): 17,
    ("robot", 0, "deep", "x"): 19,
    ("robot", 1): 20,
    ("robot", 1, "use"): 21,
    ("robot", 1, "deep", "y"): 23,
    ("robot", 1, "part", 0, "z"): 25,
}


@pytest.mark.parametrize(("key", "line"), WHERE.items(), ids=str)
def test_a_key_stands_on_the_line_where_it_was_written(key: tuple[Any, ...], line: int) -> None:
    assert key_lines(SAMPLE)[key] == line


def test_a_key_that_is_not_there_lies_near_what_holds_it() -> None:
    lines = key_lines(SAMPLE)
    assert toml_line(lines, ("robot", 1, "missing", 3)) == 20
    assert toml_line(lines, ("nowhere",)) is None


def keys_of(value: Any, key: tuple[Any, ...] = ()) -> set[tuple[Any, ...]]:
    """Every key within a value, list elements by number."""
    inner = list(enumerate(value)) if isinstance(value, list) else []
    inner = list(value.items()) if isinstance(value, dict) else inner
    found = {key} if key else set()
    return found.union(*(keys_of(part, (*key, name)) for name, part in inner))


@pytest.mark.parametrize("text", [SAMPLE, FULL], ids=["sample", "suite"])
def test_every_key_that_tomllib_reads_is_found(text: str) -> None:
    assert keys_of(tomllib.loads(text)) == set(key_lines(text)) - {("robot", 0, "part")}


words = st.text(max_size=8)
leaves = st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False) | words
values = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3)
)


@given(st.dictionaries(words, values, max_size=5))
def test_written_toml_reads_back_and_is_located_completely(data: dict[str, Any]) -> None:
    text = toml_text(data)
    assert tomllib.loads(text) == data
    assert set(key_lines(text)) == keys_of(data)
