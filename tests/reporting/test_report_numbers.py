"""Laws of printed numbers: true to three digits, ordered, never a negative zero."""

import math

from hypothesis import assume, given
from hypothesis import strategies as st

from sysid_bench.reporting.tables import notation

SIZES = st.floats(1e-300, 1e300)
COLUMNS = st.lists(st.one_of(SIZES, SIZES.map(lambda v: -v), st.just(0.0)), min_size=1)
ANY_FLOAT = st.floats(allow_nan=False, allow_infinity=False, width=64)


@given(COLUMNS)
def test_a_printed_number_is_true_to_three_digits(column: list[float]) -> None:
    style = notation(column, 3)
    for value in column:
        assert math.isclose(float(style.text(value)), value, rel_tol=0.00501)


@given(COLUMNS, ANY_FLOAT, ANY_FLOAT)
def test_printing_keeps_the_order(column: list[float], one: float, two: float) -> None:
    style = notation(column, 3)
    assert float(style.text(min(one, two))) <= float(style.text(max(one, two)))


@given(COLUMNS, ANY_FLOAT)
def test_zero_has_no_sign(column: list[float], value: float) -> None:
    text = notation(column, 3).text(value)
    assert float(text) != 0 or text == "0"


@given(st.lists(st.floats(1e-3, 9e4), min_size=1))
def test_a_column_is_scientific_only_where_it_spans_decades(column: list[float]) -> None:
    assume(max(column) / min(column) <= 1e4)
    assert not any("e" in notation(column, 3).text(value) for value in column)
    wide = notation([*column, 3e-13], 3)
    assert all("e" in wide.text(value) for value in column)


@given(st.lists(st.integers(0, 10**8), min_size=1))
def test_whole_numbers_are_printed_whole(column: list[int]) -> None:
    style = notation([float(v) for v in column], 0)
    assert [style.text(float(v)) for v in column] == [str(v) for v in column]


@given(COLUMNS)
def test_the_screen_shows_the_digits_of_the_file(column: list[float]) -> None:
    style = notation(column, 3)
    for value in column:
        assert style.html_text(value).startswith(style.text(value).partition("e")[0])
