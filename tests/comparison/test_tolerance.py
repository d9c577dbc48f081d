"""Laws of tolerances: what counts as a change beside a floor, across zero and near a factor."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.harness.comparison.baseline import baseline_of, from_text, to_text
from sysid_bench.harness.comparison.run_difference import find_difference, moved_values
from sysid_bench.harness.comparison.run_values import (
    DEFAULTS,
    CellValues,
    RunValues,
    Tolerance,
    tolerance_of,
    verdict_of,
)
from sysid_bench.metrics import METRICS

ERROR = METRICS["torque_error"]
SIZE, FLOOR = tolerance_of(ERROR).size, tolerance_of(ERROR).floor
BELOW = st.floats(1e-300, FLOOR)
BEYOND = st.floats(1.0001 * SIZE, 1e6).map(lambda factor: factor * FLOOR)
ABOVE = st.floats(1e-9, 1e9)


def run_of(error: float, mass: float = 1.0) -> RunValues:
    """A run of one cell with an error, of a robot with two true parameters."""
    cell = CellValues("ur5", (), "ok", (error,))
    parameters = {("ur5", "none"): {"link.m": 1.0, "link.hx": mass}}
    return RunValues("s", (), {ERROR.name: ERROR}, {"c": cell}, parameters, {})


@given(BELOW, BEYOND)
def test_an_error_that_grows_out_of_rounding_is_worse(before: float, after: float) -> None:
    for near in (before, -before, 0.0):
        assert verdict_of("lower", tolerance_of(ERROR), near, after) == "worse"
        assert verdict_of("lower", tolerance_of(ERROR), after, near) == "better"


@pytest.mark.parametrize("before", [0.0, 5e-12, FLOOR])
def test_a_gate_finds_an_error_that_grows_out_of_rounding(before: float) -> None:
    known = from_text(to_text(baseline_of(run_of(before))), "b.json")
    found = find_difference(known.run, run_of(0.5), known.tolerances)
    assert [change.verdict for change in found.failed_cells] == ["worse"]
    assert not find_difference(known.run, run_of(0.9 * FLOOR), known.tolerances).is_failed


@given(BELOW, BELOW, st.sampled_from([1.0, -1.0]))
def test_two_values_within_rounding_are_the_same(a: float, b: float, sign: float) -> None:
    assert tolerance_of(ERROR).holds(a, sign * b)


@given(st.just(0.0) | BELOW, st.floats(0.0, 0.99))
def test_a_value_near_the_floor_is_compared_with_the_floor(before: float, share: float) -> None:
    after = FLOOR * (1.0 + share * (SIZE - 1.0))
    assert tolerance_of(ERROR).holds(before, after)
    assert tolerance_of(ERROR).holds(after, before)


@given(ABOVE, st.floats(0.5, 2.0))
def test_values_of_opposite_sign_are_never_the_same(value: float, factor: float) -> None:
    for tolerance in (tolerance_of(ERROR), Tolerance("ratio", 3.0), DEFAULTS["min_eigenvalue"]):
        if value > tolerance.floor:
            assert not tolerance.holds(value, -factor * value)
            assert not tolerance.holds(-value, factor * value)
            assert tolerance.holds(-value, -value)


@pytest.mark.parametrize("mass", [1.0, 0.02])
def test_a_true_parameter_that_changes_its_sign_is_named(mass: float) -> None:
    (found,) = find_difference(run_of(0.1, mass), run_of(0.1, -mass)).parameters
    assert (found.parameter, found.before, found.after) == ("link.hx", mass, -mass)


def test_a_true_parameter_within_the_rounding_of_the_largest_is_not_compared() -> None:
    assert not find_difference(run_of(0.1, 1e-15), run_of(0.1, -9e-10)).parameters


def test_a_true_parameter_that_grows_out_of_rounding_is_named() -> None:
    (found,) = find_difference(run_of(0.1, 5e-10), run_of(0.1, 0.1)).parameters
    assert (found.parameter, found.after) == ("link.hx", 0.1)


@given(ABOVE, st.floats(1.0, 3.0))
def test_a_factor_up_to_the_size_holds_and_one_beyond_does_not(value: float, size: float) -> None:
    tolerance = Tolerance("ratio", size, FLOOR)
    for sign in (1.0, -1.0):
        within, beyond = value * (size * (1 - 1e-12)), value * size * (1 + 1e-9)
        assert tolerance.holds(sign * value, sign * max(within, value))
        assert not tolerance.holds(sign * value, sign * beyond)
        assert not tolerance.holds(sign * beyond, sign * value)


@given(st.floats(1.001, 1e6))
def test_a_baseline_keeps_what_its_tolerance_can_see(factor: float) -> None:
    """And nothing below: a value just above the floor is stored, one just below it is 0."""
    for name in ("torque_error", "min_eigenvalue", "gap"):
        tolerance = tolerance_of(METRICS[name])
        smallest = tolerance.size if tolerance.kind == "absolute" else tolerance.floor
        for sign in (1.0, -1.0):
            assert tolerance.stored_value(sign * factor * smallest) == sign * factor * smallest
            assert tolerance.stored_value(sign * smallest / factor) == 0.0
    run = run_of(factor * FLOOR)
    known = from_text(to_text(baseline_of(run)), "b.json").run
    (stored,) = known.cells["c"].values
    assert stored == pytest.approx(factor * FLOOR, rel=1e-6)


@given(st.floats(2e-9, 1e-3), st.sampled_from([1.0, -1.0]))
def test_a_baseline_keeps_small_true_parameters(share: float, sign: float) -> None:
    """Down to 1e-9 of the largest of their robot."""
    known = from_text(to_text(baseline_of(run_of(0.1, sign * share))), "b.json").run
    assert known.parameters["ur5", "none"]["link.hx"] == pytest.approx(sign * share, rel=1e-6)


@given(BELOW | ABOVE, BELOW | ABOVE)
def test_an_infinite_or_missing_number_is_never_within_a_tolerance(a: float, b: float) -> None:
    for tolerance in (tolerance_of(ERROR), Tolerance("absolute", 1.0), Tolerance("exact")):
        for other in (math.inf, -math.inf, math.nan):
            assert not tolerance.holds(a, other)
            assert not tolerance.holds(other, b)


def test_a_run_without_a_change_has_none() -> None:
    run = run_of(0.1, -0.02)
    assert not find_difference(run, replace(run)).is_failed


@pytest.mark.parametrize(
    ("names", "kind", "size", "floor"),
    [
        (("gap", "closure", "native_gap"), "absolute", 1e-12, 0.0),
        (("rank_gap",), "ratio", 1e3, 0.0),
        (("min_eigenvalue",), "ratio", 1.01, 1e-9),
        (("torque_error", "parameter_error", "condition"), "ratio", 1.01, 1e-11),
        (("rank", "data_rank", "feasible"), "exact", 0.0, 0.0),
    ],
)
def test_each_kind_of_metric_has_its_limit(
    names: tuple[str, ...], kind: str, size: float, floor: float
) -> None:
    """Just within it nothing has changed, just beyond it there is a change."""
    for tolerance in (tolerance_of(METRICS[name]) for name in names):
        assert (tolerance.kind, tolerance.size, tolerance.floor) == (kind, size, floor)
        for share, is_same in ((0.999, True), (1.001, False)):
            if kind == "absolute":
                assert tolerance.holds(0.0, share * size) == is_same
            if kind == "ratio":
                assert tolerance.holds(1.0, 1.0 + share * (size - 1.0)) == is_same
                assert tolerance.holds(0.0, share * floor * size) == (is_same or not floor)
        assert tolerance.holds(3.0, 4.0) == (kind == "ratio" and size > 2.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_size_itself_belongs_to_a_tolerance(sign: float) -> None:
    """A factor, a difference and the floor of what is kept: up to the last bit, and no further."""
    beyond = float(np.nextafter(1.5, 2.0))
    for allowed, before in ((Tolerance("ratio", 1.5), 1.0), (Tolerance("absolute", 0.5), 1.0)):
        for a, b in ((before, 1.5), (1.5, before)):
            assert allowed.holds(sign * a, sign * b)
        assert not allowed.holds(sign * before, sign * beyond)
        assert not allowed.holds(sign * beyond, sign * before)
    for allowed in (Tolerance("absolute", 0.5), Tolerance("ratio", 1.1, 0.5)):
        assert allowed.stored_value(sign * 0.5) == 0.0
        above = sign * float(np.nextafter(0.5, 1.0))
        assert allowed.stored_value(above) == above
    assert Tolerance("exact").stored_value(5e-324) == 5e-324


@pytest.mark.parametrize("allowed", [
    Tolerance("exact"), Tolerance("absolute", 0.25), Tolerance("absolute", 3.0),
    Tolerance("ratio", 1.0), Tolerance("ratio", 1.1), Tolerance("ratio", 7.0, 0.5),
])  # fmt: skip
def test_a_tolerance_is_the_same_through_json(allowed: Tolerance) -> None:
    written = json.loads(json.dumps(allowed.to_json()))
    assert Tolerance.from_json(written) == allowed
    assert allowed.floor or list(written) == [allowed.kind]


@pytest.mark.parametrize("share", [3e-6, 1e-5, 1e-3])
def test_a_true_parameter_is_named_from_a_millionth_on(share: float) -> None:
    for factor, count in ((1 + share, 1), (1 - share, 1), (1 + 5e-7, 0), (1 - 5e-7, 0)):
        for size in (1.0, 1e-12, 1e6):
            before, after = (
                replace(run_of(1.0), parameters={("ur5", "none"): {"a.m": size, "b.m": moved}})
                for moved in (0.3 * size, 0.3 * size * factor)
            )
            assert len(find_difference(before, after).parameters) == count


@given(st.floats(1e-6, 1e6), st.floats(1.02, 1e3), st.booleans())
def test_the_direction_of_a_metric_decides(value: float, factor: float, grows: bool) -> None:
    before, after = (value, value * factor) if grows else (value * factor, value)
    lower, higher = (verdict_of(way, Tolerance("ratio", 1.01), before, after)
                     for way in ("lower", "higher"))  # fmt: skip
    assert {lower, higher} == {"better", "worse"}
    assert (lower == "worse") == grows
    assert verdict_of(None, Tolerance("ratio", 1.01), before, after) == "changed"


def test_metrics_of_one_run_and_those_of_the_machine_are_not_compared() -> None:
    names = ("torque_error", "seconds", "rank")
    cells = {"c": CellValues("ur5", (), "ok", (0.5, 1.0, 9.0))}
    whole = RunValues("s", (), {name: METRICS[name] for name in names}, cells, {}, {})
    other = replace(
        whole,
        metrics={name: METRICS[name] for name in ("seconds", "torque_error")},
        cells={"c": CellValues("ur5", (), "ok", (900.0, 0.7))},
    )
    for before, after in ((whole, other), (other, whole)):
        found = find_difference(before, after)
        assert [change.metric for change in found.cells] == ["torque_error"]
        assert [change.metric for change in moved_values(before, after, {})] == ["torque_error"]


def test_values_of_cells_that_one_run_lacks_have_not_moved() -> None:
    one = run_of(0.5)
    more = replace(one, cells={**one.cells, "d": CellValues("ur5", ("x",), "ok", (0.7,))})
    assert moved_values(one, more, {}) == moved_values(more, one, {}) == ()


def test_an_answer_that_is_gone_is_worse_and_another_status_a_change() -> None:
    def with_status(status: str) -> RunValues:
        cell = CellValues("ur5", (), status, (0.5 if status == "ok" else None,))
        return replace(run_of(0.5), cells={"c": cell})

    for before, after, verdict in (
        ("ok", "failed", "worse"), ("failed", "ok", "changed"), ("failed", "timeout", "changed"),
    ):  # fmt: skip
        (change,) = find_difference(with_status(before), with_status(after)).cells
        assert (change.verdict, change.is_failed) == (verdict, True)
