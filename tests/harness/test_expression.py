"""Laws of the expression grammar: it reads what it says, and never evaluates or raises."""

import contextlib
import operator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.harness.suite.expression import Expression

CELL: dict[str, Any] = {
    "robot": ("panda", "file:panda.urdf"),
    "robot.free_base": False,
    "noise.tau": 0.005,
    "repeat": 2,
    "excitation.period": "5 s",
    "estimator": "ols",
    "seconds": None,
}
TRUE = (
    'robot == "panda" and noise.tau < 0.01',
    'robot == "file:panda.urdf"',
    'estimator in ["ols", "wls"]',
    'estimator not in ["wls"]',
    "not robot.free_base",
    'noise.tau == "0.5 %"',
    'noise.tau <= "0.5 %" and noise.tau > "1e-3"',
    'excitation.period == "5000 ms"',
    "excitation.period < 10",
    "0.001 < noise.tau < 0.01",
    "repeat >= 2 or nothing",
    '("ols" == estimator)',
    "seconds == none",
    "estimator != none",
    "repeat > -1",
    "robot.free_base == false",
    "true",
)
FALSE = (
    'robot != "panda"',
    "robot.free_base",
    "seconds < 1",
    "seconds >= 1",
    "seconds != 1",
    "seconds in [1]",
    "seconds not in [1]",
    "seconds != none",
    'noise.tau == "0.5 m"',
    'estimator < "z"',
    "estimator > 1",
    "nothing",
    "none",
)


@pytest.mark.parametrize("text", TRUE)
def test_true_of_the_cell(text: str) -> None:
    assert Expression.parse(text).holds(CELL)
    assert not Expression.parse(f"not ({text})").holds(CELL)


@pytest.mark.parametrize("text", FALSE)
def test_false_of_the_cell(text: str) -> None:
    assert not Expression.parse(text).holds(CELL)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "robot = 'panda'",
        "robot == panda",
        "1 == 1",
        "__import__('os').system('true')",
        "robot()",
        "robot[0] == 1",
        "robot + 1 == 2",
        "repeat is 2",
        "lambda: 1",
        "[r for r in robot]",
        "robot == f'{1}'",
        "robot in 'panda'",
        "'a' in robot",
        "'panda'",
        "3",
        "robot == b'x'",
        "robot == 1j",
        "(" * 5000 + "robot" + ")" * 5000,
        "not " * 20000 + "robot",
        "robot == 'a\0b'\0",
    ],
    ids=lambda text: text[:20],
)
def test_what_is_outside_the_grammar_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        Expression.parse(text)


def test_an_unknown_field_is_named_with_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"'robot\.free_bas'.*Did you mean 'robot\.free_base'"):
        Expression.parse("robot.free_bas and repeat < 3", CELL)


def test_fields_are_what_is_read() -> None:
    text = 'robot.free_base and (noise.tau < 1 or estimator in ["x"]) and "a" == robot'
    assert Expression.parse(text).fields == {"robot.free_base", "noise.tau", "estimator", "robot"}


@given(st.text())
def test_any_text_is_read_or_refused(text: str) -> None:
    with contextlib.suppress(UsageError):
        assert Expression.parse(text).holds({}) in (True, False)


anything = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.tuples(st.text(), st.text())
)
signs = ("==", "!=", "<", "<=", ">", ">=")
comparisons = st.sampled_from([*(f"x {s} {{}}" for s in signs), "x in [{}]", "x not in [{}]", "x"])
literals = st.sampled_from(["1", "-2.5", "'a'", "'5 s'", "'1e999'", "true", "none", "10" * 200])


@given(comparisons, literals, anything)
def test_no_cell_makes_an_expression_raise(form: str, literal: str, value: Any) -> None:
    assert Expression.parse(form.format(literal)).holds({"x": value}) in (True, False)


@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False))
def test_order_of_numbers_is_that_of_python(x: float, y: float) -> None:
    for sign, compare in (("<", operator.lt), (">=", operator.ge)):
        assert Expression.parse(f"y {sign} {x!r}").holds({"y": y}) == compare(y, x)
