"""Quantities: the same amount in any unit is the same number, and junk is refused."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench import units
from sysid_bench.errors import UsageError
from sysid_bench.signals import log_samples
from sysid_bench.units import check_unit, interval, parse_quantity, quantity

# What one of each unit is in SI, written out again: a wrong factor in the package shows here.
DIMENSIONS: list[dict[str, float]] = [
    {"s": 1, "ms": 0.001, "us": 0.000001, "min": 60, "h": 3600},
    {"Hz": 1, "kHz": 1000, "MHz": 1000000},
    {"rad": 1, "mrad": 0.001, "deg": 0.017453292519943295},
    {"rad/s": 1, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    {"m": 1, "cm": 0.01, "mm": 0.001, "um": 0.000001},
    {"kg": 1, "g": 0.001},
    {"N m": 1, "Nm": 1, "N·m": 1, "mN m": 0.001},
    {"N": 1, "kN": 1000},
    {"B": 1, "kB": 1000, "MB": 1e6, "GB": 1e9, "MiB": 1048576, "GiB": 1073741824},
    {"1": 1, "%": 0.01},
]
SI = {unit: scale for table in DIMENSIONS for unit, scale in table.items()}
PAIRS = [(u, w) for table in DIMENSIONS for u in table for w in table]
UNLIKE = [(u, w) for a in DIMENSIONS for b in DIMENSIONS if a is not b for u in a for w in b]

# Far from overflow: a conversion multiplies by 1e9 at most (kHz and MHz, h and us).
NUMBERS = st.floats(-1e290, 1e290)
UNITS = st.sampled_from(sorted(SI))


@given(x=NUMBERS, pair=st.sampled_from(PAIRS))
def test_a_written_unit_decides_whatever_unit_was_wanted(x: float, pair: tuple[str, str]) -> None:
    written, wanted = pair
    assert quantity(f"{x!r} {written}", wanted) == pytest.approx(x * SI[written], rel=1e-12)


def test_the_table_above_names_every_unit_of_the_package() -> None:
    assert [*map(set, units._DIMENSIONS)] == [*map(set, DIMENSIONS)]


@pytest.mark.parametrize("unit", SI)
def test_one_of_each_unit_is_its_size(unit: str) -> None:
    """Each of them, which random draws need not meet."""
    assert quantity(1, unit) == quantity(f"1 {unit}", unit) == pytest.approx(SI[unit], rel=1e-15)


@pytest.mark.parametrize(
    ("text", "ends"),
    [("10 s to 25 s", (10, 25)), ("500 ms to 1 min", (0.5, 60)), ("-1 to 0", (-1, 0))],
)
def test_a_period_is_two_times_in_seconds(text: str, ends: tuple[float, float]) -> None:
    assert interval(text) == ends


@pytest.mark.parametrize(
    "text",
    ["5 s", "5 s to", "to 5 s", "5 s to 5 s", "6 s to 5 s", "1 m to 2 m", "1 - 2 s", 5, None],
)
def test_what_is_no_period_is_refused(text: Any) -> None:
    with pytest.raises(UsageError):
        interval(text)


# Of recordings, beside those above.
LOG_SI = SI | {
    "cm/s": 0.01,
    "mm/s": 0.001,
    "m/s": 1,
    "mrad/s": 0.001,
    "A": 1,
    "mA": 0.001,
    "mNm": 0.001,
}


@pytest.mark.parametrize("signal", log_samples.UNITS)
@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_units_of_recordings_have_the_same_size(signal: str, kind: str) -> None:
    table = log_samples.UNITS[signal][kind]
    assert dict(table) == pytest.approx({unit: LOG_SI[unit] for unit in table}, rel=1e-12)


@given(x=NUMBERS, pair=st.sampled_from(PAIRS))
def test_there_and_back_is_the_same_amount(x: float, pair: tuple[str, str]) -> None:
    here, there = pair
    amount = quantity(f"{x!r} {here}", there)
    back = quantity(f"{amount / quantity(1, there)!r} {there}", here)
    assert back == pytest.approx(amount, rel=1e-12, abs=1e-300)


@given(x=NUMBERS | st.integers(-(10**15), 10**15), unit=UNITS)
def test_a_bare_number_is_in_the_wanted_unit(x: float, unit: str) -> None:
    assert quantity(x, unit) == quantity(repr(x), unit) == quantity(f"{x!r} {unit}", unit)


@given(x=NUMBERS, unit=UNITS, before=st.text(" \t"), between=st.text(" \t"), after=st.text(" \t"))
def test_blanks_do_not_matter(x: float, unit: str, before: str, between: str, after: str) -> None:
    if unit == "1":
        between += " "  # "5" and "1" would read as 51
    text = f"{before}{x!r}{between}{unit}{after}"
    assert parse_quantity(text) == (x, unit)


@given(x=NUMBERS, pair=st.sampled_from(UNLIKE))
def test_another_dimension_is_refused_with_the_units_that_fit(
    x: float, pair: tuple[str, str]
) -> None:
    written, wanted = pair
    with pytest.raises(UsageError) as error:
        quantity(f"{x!r} {written}", wanted)
    assert repr(written) in str(error.value)
    assert wanted in str(error.value)


@given(x=NUMBERS)
def test_of_alternatives_the_one_that_fits_is_taken(x: float) -> None:
    assert quantity(f"{x!r} mm", "rad|m") == quantity(f"{x!r} mm", "m")
    assert quantity(f"{x!r} deg", "rad|m") == quantity(f"{x!r} deg", "rad")
    assert quantity(x, "deg|mm") == quantity(repr(x), "deg|mm") == quantity(x, "deg")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused_as_number_and_as_text(value: float) -> None:
    for written in (value, repr(value), f"{value!r} s"):
        with pytest.raises(UsageError):
            quantity(written, "s")


@pytest.mark.parametrize("text", ["1e400", "1e308 h", "-1e308 h"])
def test_what_overflows_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        quantity(text, "s")


def test_an_integer_beyond_all_floats_is_refused() -> None:
    with pytest.raises(UsageError):
        quantity(10**400, "s")


@pytest.mark.parametrize("value", [True, False, None, [], {}, (5, "s"), b"5 s", 1j])
def test_what_is_no_quantity_is_refused_with_what_came(value: Any) -> None:
    with pytest.raises(UsageError) as error:
        quantity(value, "s")
    assert repr(value) in str(error.value)


@given(text=st.text().filter(lambda text: not any(c.isdigit() for c in text)))
def test_text_without_a_digit_is_no_quantity(text: str) -> None:
    with pytest.raises(UsageError) as error:
        quantity(text, "s")
    assert repr(text) in str(error.value)


@pytest.mark.parametrize("text", ["5 parsec", "5 S", "1_000 s", "1 2 s", "0x10 s", "5,5 s", "--5"])
def test_nearly_right_text_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        quantity(text, "s")


@given(text=st.text(max_size=12), unit=UNITS)
def test_any_text_becomes_a_finite_number_or_a_usage_error(text: str, unit: str) -> None:
    try:
        number = quantity(text, unit)
    except UsageError:
        return
    assert math.isfinite(number)


def test_a_unit_that_the_package_does_not_know_is_named() -> None:
    with pytest.raises(UsageError, match="furlong"):
        quantity(5, "furlong")


@given(number=st.floats(1e-9, 1e9), table=st.sampled_from(DIMENSIONS))
def test_a_number_without_a_unit_is_refused_with_those_there_are(
    number: float, table: dict[str, float]
) -> None:
    first = next(iter(table))
    for unit in table:
        check_unit("x", f"{number!r} {unit}", first)
    if first == "1":
        check_unit("x", f"{number!r}", first)
        return
    with pytest.raises(UsageError) as refused:
        check_unit("x", f"{number!r}", first, is_share=True)
    assert all(unit in str(refused.value) for unit in (*table, "%"))
    check_unit("x", "0", first)  # nothing, in every unit
