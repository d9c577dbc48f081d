"""Errors: one root, and a message that says what came, what there is, what to do."""

import inspect
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench import errors
from sysid_bench.errors import SysidBenchError, unknown_name

CLASSES = [
    thing
    for _, thing in inspect.getmembers(errors, inspect.isclass)
    if thing.__module__ == errors.__name__
]
WORDS = st.text(string.ascii_lowercase + string.digits + "-_", min_size=1, max_size=12)


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_error_has_the_one_root_and_prints_its_paragraph(kind: type[Exception]) -> None:
    assert issubclass(kind, SysidBenchError)
    assert str(kind("one readable paragraph")) == "one readable paragraph"
    assert kind.__doc__


@given(name=WORDS, known=st.lists(WORDS, min_size=1, max_size=6))
def test_an_unknown_name_is_answered_with_every_known_one(name: str, known: list[str]) -> None:
    message = str(unknown_name("robot", name, known, "Or give a path."))
    assert message.startswith(f"No robot is called {name!r}.")
    assert f"There are: {', '.join(sorted(set(known)))}." in message
    assert message.endswith("Or give a path.")


@given(name=WORDS, known=st.lists(WORDS, max_size=6))
def test_a_hint_is_a_name_that_exists(name: str, known: list[str]) -> None:
    message = str(unknown_name("robot", name, known))
    if "Did you mean" in message:
        hint = message.split("Did you mean ")[1].split("?")[0]
        assert hint.strip("'") in known


@given(name=st.text(string.ascii_lowercase, min_size=4, max_size=10), known=st.lists(WORDS))
def test_a_slip_of_one_letter_is_recognised(name: str, known: list[str]) -> None:
    # Digits keep the other names far from the name, so that the slip has one nearest name.
    others = [f"{i}{'0' * len(name)}" for i in range(len(known))]
    message = str(unknown_name("robot", name[:-1], [*others, name]))
    assert f"Did you mean {name!r}?" in message


def test_where_nothing_exists_the_message_says_so() -> None:
    message = str(unknown_name("suite", "smoke", []))
    assert message == "No suite is called 'smoke'. There is no suite at all."
