"""Laws of baselines: nothing is lost in the file, and every change beyond a tolerance is found."""

import json
import math
import random
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench import words
from sysid_bench.errors import UsageError
from sysid_bench.harness.comparison.baseline import (
    Baseline,
    baseline_of,
    from_text,
    to_text,
    update_of,
)
from sysid_bench.harness.comparison.run_difference import RunDifference, find_difference
from sysid_bench.harness.comparison.run_values import (
    ALL_PARAMETERS,
    METRICS_COMPARED,
    SETTING,
    CellValues,
    Kind,
    RunValues,
    Tolerance,
    label_axes,
    part_times,
    read_run,
    settings_key,
    tolerance_of,
    verdict_of,
)
from sysid_bench.harness.comparison.speed import EXPERIMENT, KERNEL, Speed
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.metrics import METRICS

NAMES = METRICS_COMPARED
SIZES = st.floats(1e-9, 1e9)
LABELS = st.sampled_from(["none", "box 1 kg | offset", 'q "1e-4" rad', "ünïcode", ""])
STATUSES = st.sampled_from(["ok", "ok", "ok", "failed", "open", "unsupported"])


def _value(name: str, share: float) -> float | None:
    """A value between 1e-9 and 1e9, or a count; none at times."""
    if share < 0.2:
        return None
    counted = tolerance_of(METRICS[name]).kind == "exact"
    return float(int(500 * share)) if counted else 10.0 ** (18.0 * share - 9.0)


@st.composite
def cells(draw: st.DrawFn) -> CellValues:
    status = draw(STATUSES)
    empty = (None,) * len(NAMES)
    rng = draw(st.randoms(use_true_random=False))
    drawn = tuple(_value(name, rng.random()) for name in NAMES)
    robot = draw(st.sampled_from(["ur5", "panda", "so100"]))
    reason = "" if status == "ok" else "because"
    return CellValues(
        robot, (draw(LABELS), "ols"), status, drawn if status == "ok" else empty, reason
    )


RUNS = st.builds(
    lambda found, masses: RunValues(
        name="suite",
        axes=("payload", "estimator"),
        metrics={name: METRICS[name] for name in NAMES},
        cells={
            "first": CellValues("ur5", ("none", "ols"), "ok", (1.0,) * len(NAMES)),
            **{f"{i:012x}": cell for i, cell in enumerate(found)},
        },
        parameters={
            ("ur5", setting): {"link.m": mass, "link.Izz": 0.1, "tool.hx": 0.3 * mass}
            for setting, mass in zip(("none robot", "box robot"), masses, strict=True)
        },
        origin={"python": "3.11.7", "versions": {"numpy": "2.0.0"}},
    ),
    st.lists(cells(), max_size=3),
    st.tuples(SIZES, SIZES),
)


def through_file(run: RunValues) -> Baseline:
    """The baseline of a run, written and read."""
    return from_text(to_text(baseline_of(run)), "b.json")


def compared(run: RunValues, later: RunValues) -> RunDifference:
    known = through_file(run)
    return find_difference(known.run, later, known.tolerances)


@given(RUNS)
def test_a_run_keeps_its_own_baseline(run: RunValues) -> None:
    changes = compared(run, run)
    assert not changes.is_failed
    assert not changes.cells
    assert not changes.parameters
    assert not changes.origin
    assert not changes.appeared
    assert not changes.vanished


@given(RUNS, st.sampled_from(NAMES), st.floats(0.02, 10.0), st.booleans())
def test_a_value_beyond_its_tolerance_is_found(
    run: RunValues, name: str, share: float, grows: bool
) -> None:
    place, tolerance = NAMES.index(name), tolerance_of(METRICS[name])
    before = 3.0 if tolerance.kind == "exact" else 0.5
    after = before + 1.0 if tolerance.kind == "exact" else before * (1.0 + share)
    pair = (before, after) if grows else (after, before)
    old, new = (_with(run, place, value) for value in pair)
    found = compared(old, new)
    assert [(change.cell, change.metric) for change in found.cells] == [("first", name)]
    better = METRICS[name].better
    assert found.is_failed == (
        (better == "lower") == grows if better else tolerance.kind == "exact"
    )


def _with(run: RunValues, place: int, value: float) -> RunValues:
    first = run.cells["first"]
    values = (*first.values[:place], value, *first.values[place + 1 :])
    return replace(run, cells={**run.cells, "first": replace(first, values=values)})


@given(RUNS, st.sampled_from([n for n in NAMES if tolerance_of(METRICS[n]).kind != "exact"]))
def test_a_value_within_its_tolerance_is_kept(run: RunValues, name: str) -> None:
    tolerance, place = tolerance_of(METRICS[name]), NAMES.index(name)
    step = 0.9 * tolerance.size if tolerance.kind == "absolute" else 0.5 * 0.9 * 0.01
    old, new = _with(run, place, 0.5), _with(run, place, 0.5 + step)
    assert not compared(old, new).cells
    assert not compared(new, old).cells


@given(RUNS, st.sampled_from(["ok", "failed"]), st.sampled_from(["timeout", "unsupported"]))
def test_another_status_fails_in_both_directions(run: RunValues, one: str, other: str) -> None:
    cell = run.cells["first"]
    old, new = (
        replace(run, cells={**run.cells, "first": replace(cell, status=status, reason=status)})
        for status in (one, other)
    )
    for pair in ((old, new), (new, old)):
        assert [change.metric for change in compared(*pair).failed_cells] == ["status"]


@given(RUNS, st.sampled_from(["link.m", "link.Izz", "tool.hx"]))
def test_a_base_parameter_that_moves_by_a_percent_is_named(run: RunValues, name: str) -> None:
    key = ("ur5", "box robot")
    was = run.parameters[key]
    if was[name] < 1e-6 * max(was.values()):
        return  # below what a share of 1e-9 of the largest can show
    moved = {**was, name: 1.01 * was[name]}
    found = compared(run, replace(run, parameters={**run.parameters, key: moved}))
    assert [(change.robot, change.parameter) for change in found.parameters] == [("ur5", name)]
    gone = {other: value for other, value in was.items() if other != name}
    found = compared(run, replace(run, parameters={**run.parameters, key: gone}))
    assert [change.after for change in found.parameters] == [None]


@given(RUNS)
def test_cells_that_are_gone_or_have_not_run_fail_unless_partial(run: RunValues) -> None:
    without = replace(run, cells={key: c for key, c in run.cells.items() if key != "first"})
    unrun = replace(run.cells["first"], status="open", values=(None,) * len(NAMES))
    unrun_run = replace(run, cells={**run.cells, "first": unrun})
    known = through_file(run)
    gone = find_difference(known.run, without, known.tolerances)
    not_run = find_difference(known.run, unrun_run, known.tolerances)
    assert gone.vanished == ("first",)
    assert gone.is_failed
    assert not_run.open == ("first",)
    assert not_run.is_failed
    for later in (without, unrun_run):
        assert not find_difference(known.run, later, known.tolerances, partial=True).is_failed
    if without.cells and any(cell.status != "open" for cell in without.cells.values()):
        assert compared(without, run).appeared == ("first",)


@given(RUNS, st.sampled_from(["ur5", "panda"]))
def test_a_change_of_one_robot_changes_its_lines_alone(run: RunValues, robot: str) -> None:
    changed = {
        key: replace(cell, values=tuple(None if v is None else 2.0 * v + 1.0 for v in cell.values))
        if cell.robot == robot
        else cell
        for key, cell in run.cells.items()
    }
    old = to_text(baseline_of(run)).splitlines()
    new = to_text(baseline_of(replace(run, cells=changed))).splitlines()
    assert len(old) == len(new)
    differing = [a for a, b in zip(old, new, strict=True) if a != b]
    mine = [f'"{key}"' for key, cell in run.cells.items() if cell.robot == robot]
    assert all(any(line.strip().startswith(key) for key in mine) for line in differing)


def test_versions_are_named_and_do_not_fail() -> None:
    run = RunValues(
        "suite", (), {"rank": METRICS["rank"]}, {"c": CellValues("ur5", (), "ok", (48.0,))}, {},
        {"versions": {"numpy": "2.0.0"}, "git": {"commit": "a" * 40, "dirty": False}},
    )  # fmt: skip
    later = replace(run, origin={"versions": {"numpy": "2.1.0"}, "git": None})
    changes = compared(run, later)
    assert not changes.is_failed
    assert {name for name, _, _ in changes.origin} == {"numpy", "commit"}


@pytest.mark.parametrize(
    "broken",
    ["", "{", "[]", "{}", '{"schema": 2}', '{"schema": 1, "metrics": [1]}', "nul\0l"],
)
def test_a_file_that_is_not_a_baseline_is_one_sentence(broken: str) -> None:
    with pytest.raises(UsageError, match="baseline"):
        from_text(broken, "b.json")


@given(RUNS, st.data())
def test_a_damaged_baseline_is_refused_or_read(run: RunValues, data: st.DataObject) -> None:
    values = json.loads(to_text(baseline_of(run)))
    key = data.draw(st.sampled_from([*values]))
    values[key] = data.draw(st.sampled_from([None, 3, "x", [], {}, [1], {"ur5": 1}, {"x": None}]))
    with suppress(UsageError):
        from_text(json.dumps(values), "b.json")


@given(SIZES, SIZES)
def test_a_verdict_is_the_reverse_of_the_way_back(before: float, after: float) -> None:
    reverse = {"same": "same", "better": "worse", "worse": "better"}
    tolerance = Tolerance("ratio", 1.01, 1e-11)
    there = verdict_of("lower", tolerance, before, after)
    assert verdict_of("lower", tolerance, after, before) == reverse[there]
    assert verdict_of("higher", tolerance, after, before) == there
    assert verdict_of(None, tolerance, after, before) == ("same" if there == "same" else "changed")


@pytest.mark.parametrize("values", [{"ratio": 0.5}, {"exact": "x"}, {"ratio": 2, "low": 1}, 3, {}])
def test_a_tolerance_that_is_none_is_refused(values: object) -> None:
    with pytest.raises(UsageError, match="tolerance"):
        Tolerance.from_json(values)


def test_the_size_of_a_large_baseline(tmp_path: Path) -> None:
    """5,000 cells of 40 robots with nine metrics stay below a megabyte."""
    found = {
        f"{i:012x}": CellValues(
            f"robot{i % 40}", ("sphere-1kg", "robot", "q 1e-4 rad, tau 0.5 %", "wls", str(i % 3)),
            "ok", (48.0, 48.0, 3e-16, 5e-16, 109.79 + i, 0.0123 + i, 0.0114 + i, 0.001 * i, 1.0),
        )
        for i in range(5000)
    }  # fmt: skip
    parameters = {
        (f"robot{i}", f"{payload} robot default matched"): {
            f"link{j}.Ixx": 0.1234567 * j + (payload == "box") * (j > 50) for j in range(60)
        }
        for i in range(40)
        for payload in ("none", "box", "sphere")
    }
    axes = ("payload", "task", "noise", "estimator", "repeat")
    metrics = {name: METRICS[name] for name in NAMES}
    text = to_text(baseline_of(RunValues("large", axes, metrics, found, parameters, {})))
    assert len(text.encode()) < 1_000_000


STATUS_PAIRS = [
    ("unsupported", "ok"), ("ok", "unsupported"), ("failed", "ok"), ("skipped", "failed"),
]  # fmt: skip


@pytest.mark.parametrize("pair", STATUS_PAIRS)
@pytest.mark.parametrize("place", [0, 5, -1])
def test_a_refusal_that_becomes_an_answer_is_found_wherever_it_stands(
    pair: tuple[str, str], place: int
) -> None:
    """First, in the middle and last of a run; its cell alone is named, with the reason."""
    names = [f"{i:012x}" for i in range(11)]
    chosen = names[place]

    def run(status: str) -> RunValues:
        cells = {name: CellValues("ur5", (name,), "ok", (48.0,)) for name in names}
        answer = (48.0,) if status == "ok" else (None,)
        reason = "" if status == "ok" else "a loop that does not close"
        cells[chosen] = CellValues("ur5", (chosen,), status, answer, reason)
        return RunValues("s", ("estimator",), {"rank": METRICS["rank"]}, cells, {}, {})

    before, after = map(run, pair)
    (change,) = compared(before, after).failed_cells
    assert (change.cell, change.metric, change.before, change.after) == (chosen, "status", *pair)
    assert change.reason == "a loop that does not close"
    assert not compared(after, after).failed_cells


@given(RUNS)
def test_an_update_takes_over_nothing_that_a_comparison_does_not_find(run: RunValues) -> None:
    """Errors that grow by less than their tolerance, again and again, fail in the end."""
    place = NAMES.index("torque_error")
    worse = 1.0099
    known = through_file(_with(run, place, 0.5))
    grown = _with(run, place, worse * 0.5)
    update = update_of(find_difference(known.run, grown, known.tolerances))
    assert update.taken == 0
    assert to_text(replace(known, run=update.run)) == to_text(known)
    twice = _with(run, place, worse**2 * 0.5)
    assert find_difference(update.run, twice, known.tolerances).is_failed


@given(RUNS, st.sampled_from(NAMES), SIZES)
def test_an_update_takes_over_what_a_comparison_finds(
    run: RunValues, name: str, size: float
) -> None:
    """After it the run keeps the baseline, whose other values are those of before."""
    known = through_file(run)
    near = _with(run, NAMES.index("torque_error"), 1.005)  # within its tolerance
    later = _with(near, NAMES.index(name), float(int(size)) + 2.0)
    first = later.cells["first"]
    later = replace(
        later,
        cells={**later.cells, "new": first},
        parameters={**later.parameters, ("ur5", "another robot"): {"link.m": size}},
    )
    changes = find_difference(known.run, later, known.tolerances)
    update = update_of(changes)
    assert update.taken == len(changes.cells) + 2
    again = find_difference(update.run, later, known.tolerances)
    assert not any((again.cells, again.parameters, again.appeared, again.vanished))
    kept = update.run.cells["first"].values
    assert {NAMES[i] for i, v in enumerate(kept) if v != known.run.cells["first"].values[i]} == {
        change.metric for change in changes.cells if change.cell == "first"
    }


@given(RUNS)
def test_an_update_keeps_cells_that_have_not_run(run: RunValues) -> None:
    known = through_file(run)
    unrun = replace(run.cells["first"], status="open", values=(None,) * len(NAMES))
    without = replace(run, cells={**run.cells, "first": unrun})
    changes = find_difference(known.run, without, known.tolerances)
    update = update_of(changes)
    assert (update.taken, changes.open) == (0, ("first",))
    assert to_text(replace(known, run=update.run)) == to_text(known)
    before = through_file(replace(without, cells={**without.cells, "other": run.cells["first"]}))
    back = update_of(find_difference(before.run, run, before.tolerances))
    assert back.taken == 2  # it has run, and "other" is gone
    assert back.run.cells["first"].is_ok
    assert "other" not in back.run.cells


# --- Files by hand, and what they must hold ------------------------------------------------------

KEPT = RunValues(
    name="s",
    axes=("estimator",),
    metrics={"torque_error": METRICS["torque_error"]},
    cells={"a": CellValues("ur5", ("ols",), "ok", (0.25,))},
    parameters={},
    origin={"git": {"commit": "0123456789abcdef", "dirty": False}},
    models={"ur5": {"": {"gravity": [0.0, 0.0, -9.81]}, "j": {"axis": [1.0], "gear": [50.0]}}},
)


def test_a_model_is_the_same_through_its_file() -> None:
    assert through_file(KEPT).run.models == KEPT.models


@pytest.mark.parametrize(
    "model",
    [{"j": {"axis": 3.0, "gear": [1.0]}}, {"j": {"axis": [1.0], "gear": "x"}}, {"j": [1.0]}, []],
)
def test_a_model_that_is_not_lists_of_values_is_refused(model: object) -> None:
    values = json.loads(to_text(baseline_of(KEPT)))
    values["robots"]["ur5"]["model"] = model
    with pytest.raises(UsageError, match="not a baseline"):
        from_text(json.dumps(values), "b.json")


@pytest.mark.parametrize("name", ["smoke", "terminal"])
def test_a_kept_baseline_is_read_and_written_as_it_is(name: str) -> None:
    file = Path(__file__).parents[1] / "baselines" / f"{name}.json"
    assert to_text(from_text(file.read_text(), file.name)) == file.read_text()


def test_a_robot_without_a_cell_is_no_reason_to_refuse_a_file() -> None:
    values = json.loads(to_text(baseline_of(KEPT)))
    values["robots"]["other"] = {"parameters": {}, "cells": {}}
    assert from_text(json.dumps(values), "b.json").run.cells == KEPT.cells
    del values["robots"]["ur5"]
    with pytest.raises(UsageError, match="it holds no cell"):
        from_text(json.dumps(values), "b.json")


@pytest.mark.parametrize(
    "written",
    [{"ratio": 1.1, "floor": "x"}, {"ratio": "x", "floor": 0.1}, {"ratio": 1.1, "other": 2.0},
     {"floor": 1.0}, {}, 3, {"ratio": 1.1, "absolute": 1.0}],
)  # fmt: skip
def test_a_damaged_tolerance_is_refused(written: object) -> None:
    with pytest.raises(UsageError, match="is not a tolerance"):
        Tolerance.from_json(written)


@pytest.mark.parametrize(("kind", "size"), [("ratio", 0.99), ("absolute", -1e-9), ("exact", -1.0)])
def test_a_tolerance_below_the_least_of_its_kind_is_refused(kind: Kind, size: float) -> None:
    with pytest.raises(UsageError, match="is not a tolerance"):
        Tolerance(kind, size)
    assert Tolerance("absolute", 0.0).holds(1.0, 1.0)
    assert Tolerance("absolute", 1e-6).size == 1e-6
    assert Tolerance("exact").floor == 0.0
    assert Tolerance("exact").to_json() == {"exact": 0.0}


def test_a_commit_is_shown_with_twelve_digits() -> None:
    later = replace(KEPT, origin={"git": {"commit": "f" * 40, "dirty": True}})
    changed = ("commit", "0123456789ab", f"{'f' * 12} with changes")
    assert compared(KEPT, later).origin == (changed,)


@pytest.mark.parametrize(
    ("errors", "end"),
    [
        ((), ""), ((0.1,), ""), ((None,), ""), ((0.1, 0.2), ""), ((None, None), ""),
        ((0.1, None), ALL_PARAMETERS), ((None, None, 0.1), ALL_PARAMETERS),
        ((math.nan, 0.1, 0.2), ALL_PARAMETERS),
    ],
)  # fmt: skip
def test_settings_of_all_parameters_are_apart(errors: tuple[float | None, ...], end: str) -> None:
    cell = {"robot": "ur5", **dict.fromkeys(SETTING, "x")}
    entries = [{"base_error": error} for error in errors]
    assert settings_key(cell, entries) == ("ur5", "x x x x" + end)


@given(
    st.lists(st.tuples(*[st.sampled_from("ab")] * 4), min_size=1, max_size=6, unique=True),
    st.integers(0, 3),
)
def test_axes_tell_the_cells_of_a_robot_apart(drawn: list[tuple[str, ...]], other: int) -> None:
    """As all their labels do, and no axis says what those before it do."""
    names = ("robot", "payload", "noise", "repeat")
    cells = [
        {**dict.fromkeys(words.LABELS, "x"), **dict(zip(names, labels, strict=True))}
        for labels in drawn
    ]
    kept = label_axes(cells)
    assert "robot" not in kept

    def groups(axes: tuple[str, ...]) -> int:
        return len({tuple(cell[axis] for axis in ("robot", *axes)) for cell in cells})

    assert groups(kept) == len(cells)
    assert all(groups(kept[: n + 1]) > groups(kept[:n]) for n in range(len(kept)))


def test_cells_of_a_run_that_have_no_row_and_true_values_of_those_that_have(tmp_path: Path) -> None:
    """True values are those of answers, of the base where one has these alone."""
    text = 'schema = 1\nname = "s"\n[[robot]]\nuse = ["ur5", "scara"]\n'
    names = ("ols", "wls", "lmi", "ridge")
    suite = parse_suite(text + "".join(f'[[estimator]]\nuse = "{name}"\n' for name in names))
    plan = cells_of_suite(suite)
    folder = RunFolder.new(tmp_path / "run", suite, plan, {})
    first = [cell for cell in plan.cells if cell.first_fields["robot"] == "ur5"]
    rest = [cell for cell in plan.cells if cell.first_fields["robot"] == "scara"]

    def entries(*true: tuple[float | None, float | None]) -> list[dict[str, object]]:
        return [
            {"body": "a", "name": f"p{n}", "true": value, "value": 1.0, "base_error": error}
            for n, (value, error) in enumerate(true)
        ]

    def write(row: Mapping[str, Any], **fields: Any) -> None:
        writer.write({**row, "reason": "", "rank": 36, "torque_error": 0.25, **fields})

    with folder.new_writer("w") as writer:
        head = [cell.first_fields for cell in first]
        write(head[0], status="failed", reason="why", parameters_table=entries((9.0, 0.1)))
        write(head[1], status="ok", parameters_table=entries((2.0, 0.1), (3.0, None)))
        write(head[2], status="ok", parameters_table=entries((4.0, 0.1), (5.0, 0.2), (None, 0.1)))
        write(rest[0].first_fields, status="ok", parameters_table=[])
    found = read_run(folder, ("torque_error",))
    assert found.cells[first[0].id].reason == "why"
    assert found.cells[first[0].id].values == (0.25,)
    for cell in (first[3], *rest[1:]):
        assert found.cells[cell.id].status == "open"
        assert found.cells[cell.id].values == (None,)
        assert found.cells[cell.id].reason == "has not run yet"
    ((key, true),) = found.parameters.items()
    assert key[0] == "ur5"
    assert not key[1].endswith(ALL_PARAMETERS)
    assert true == {"a.p0": 4.0, "a.p1": 5.0}


def test_repeats_of_one_cell_are_one_group_of_times() -> None:
    rows, heads = [], {}
    for payload, repeat in product(("a", "b"), range(3)):
        name = f"{payload}{repeat}"
        rows.append({"id": name, "seconds_cpu": 1.0 + repeat, "seconds_experiment_cpu": 5.0})
        heads[name] = {**dict.fromkeys(words.LABELS, "x"), "robot": "ur5", "payload": payload,
                       "estimator": "ols", "experiment": name}  # fmt: skip
    assert part_times(rows, heads)["ur5", "ols"] == [[1.0, 2.0, 3.0]] * 2


@pytest.mark.parametrize("kernel", [0.25, None])
def test_times_of_older_rows_have_the_whole_alone(kernel: float | None) -> None:
    row = {
        "id": "a", "seconds_cpu": 0.5, "seconds_experiment_cpu": 1.0, "seconds_kernel_cpu": kernel,
    }  # fmt: skip
    head = {**dict.fromkeys(words.LABELS, "x"), "robot": "ur5", "experiment": "e"}
    found = {part: groups for (_, part), groups in part_times([row], {"a": head}).items()}
    whole = {EXPERIMENT: [[1.0]]} if kernel is None else {EXPERIMENT: [[0.75]], KERNEL: [[0.25]]}
    assert found == {"x": [[0.5]], **whole}
    missing = part_times([{**row, "seconds_experiment_cpu": None}], {"a": head})
    assert {part for _, part in missing} == {"x"}


def test_an_update_keeps_the_times_of_robots_that_stay_and_counts_those_that_go() -> None:
    cells = {name: CellValues(name, ("ols",), "ok", (0.25,)) for name in ("a", "b")}
    parts = {
        "ols": Speed(1.0, 0.01, 9),
        EXPERIMENT: Speed(2.0, 0.01, 9),
        "wls": Speed(3.0, 0.01, 9),
    }
    speeds = {(robot, part): speed for robot in "ab" for part, speed in parts.items()}
    before = replace(KEPT, cells=cells, models={}, speeds=speeds)
    fewer = {key: speed for key, speed in speeds.items() if key != ("a", "wls")}
    update = update_of(find_difference(before, replace(before, speeds=fewer)))
    assert update.run.speeds == fewer
    assert update.counts == {"times": 3}  # two of robot a, and one that is gone
    assert update_of(find_difference(before, replace(before, speeds={}))).run.speeds == speeds


def test_rows_of_a_run_are_read_for_the_metrics_asked_for(tmp_path: Path) -> None:
    text = 'schema = 1\nname = "s"\n[[robot]]\nuse = "ur5"\n[[estimator]]\nuse = "ols"\n'
    suite = parse_suite(text)
    plan = cells_of_suite(suite)
    folder = RunFolder.new(tmp_path / "run", suite, plan, {})
    (cell,) = plan.cells
    with folder.new_writer("w") as writer:
        row = {**cell.first_fields, "status": "ok", "reason": "", "rank": 36, "torque_error": 0.25}
        writer.write(row)
    for names, metrics in (((), METRICS_COMPARED), (("torque_error",), ("torque_error",))):
        found = read_run(folder, names)
        assert tuple(found.metrics) == metrics
        values = dict(zip(found.metrics, found.cells[cell.id].values, strict=True))
        assert values["torque_error"] == 0.25
    assert found.models.keys() == {"ur5"}
    assert found.parameters == {}  # no row has any
    with pytest.raises(UsageError, match="torque_eror"):
        read_run(folder, ("torque_eror",))


def test_cells_are_matched_by_labels_where_these_are_of_one_cell() -> None:
    one, other = (CellValues("ur5", (name,), "ok", (0.25,)) for name in ("ols", "wls"))
    before = replace(KEPT, cells={"a": one, "b": other})
    after = replace(KEPT, cells={"c": replace(one, values=(0.5,)), "b": other})
    found = compared(before, after)
    assert [(change.cell, change.before, change.after) for change in found.cells] == [
        ("c", 0.25, 0.5)
    ]
    assert (found.appeared, found.vanished) == ((), ())
    assert before.has_cell({"id": "x", "robot": "ur5", "estimator": "ols"})
    assert not before.has_cell({"id": "x", "robot": "ur5", "estimator": "didim"})
    twice = replace(KEPT, cells={"c": one, "d": one, "b": other})
    unclear = compared(before, twice)
    assert (unclear.appeared, unclear.vanished) == (("c", "d"), ("a",))
    elsewhere = compared(before, replace(after, name="another suite"))
    assert (elsewhere.appeared, elsewhere.vanished) == (("c",), ("a",))


# --- An update takes over every kind of change ---------------------------------------------------

TWO = replace(
    KEPT,
    cells={
        "a": CellValues("ur5", ("ols",), "ok", (0.25,)),
        "b": CellValues("ur5", ("wls",), "failed", (None,), "no answer"),
        "c": CellValues("panda", ("ols",), "ok", (0.5,)),
    },
    parameters={
        ("ur5", "none"): {"link.m": 2.0, "link.hx": -0.5},
        ("ur5", "box"): {"link.m": 3.0, "link.hx": -0.5},
        ("panda", "none"): {"link.m": 1.0},
    },
    models=dict.fromkeys(("ur5", "panda"), KEPT.models["ur5"]),
)


def with_cell(name: str, **fields: object) -> RunValues:
    return replace(TWO, cells={**TWO.cells, name: replace(TWO.cells["a"], **fields)})  # type: ignore[arg-type]


def with_truth(key: tuple[str, str], **values: float) -> RunValues:
    named = {f"link.{name}": value for name, value in values.items()}
    return replace(TWO, parameters={**TWO.parameters, key: named})


def with_model(robot: str, model: dict[str, dict[str, list[float]]]) -> RunValues:
    return replace(TWO, models={**TWO.models, robot: model})


def without(robot: str) -> RunValues:
    return replace(
        TWO,
        cells={name: cell for name, cell in TWO.cells.items() if cell.robot != robot},
        parameters={key: values for key, values in TWO.parameters.items() if key[0] != robot},
        models={name: model for name, model in TWO.models.items() if name != robot},
    )


SETTINGS = "new settings and robots"
J, G = {"axis": [1.0], "gear": [50.0]}, {"gravity": [0.0, 0.0, -9.81]}
CHANGES = {
    "a value": (with_cell("a", values=(0.75,)), 1),
    "a value that is gone": (with_cell("a", values=(None,)), 1),
    "a status": (with_cell("a", status="failed", values=(None,), reason="why"), 1),
    "an answer": (with_cell("b", labels=("wls",)), 1),
    "a cell": (with_cell("d", labels=("lmi",)), 1),
    "two cells of a robot": (with_cell("d", robot="scara"), 1),
    "a robot that is gone": (without("panda"), 1),
    "a parameter": (with_truth(("ur5", "box"), m=3.3, hx=-0.5), 1),
    "its sign": (with_truth(("ur5", "none"), m=2.0, hx=0.5), 1),
    "a parameter that is gone": (with_truth(("ur5", "box"), m=3.0), 1),
    "a new parameter": (with_truth(("panda", "none"), m=1.0, hy=0.1), 1),
    "a new setting": (with_truth(("panda", "box"), m=1.0, hy=0.1), 1),
    "a quantity": (with_model("ur5", {"": G, "j": {**J, "gear": [51.0]}}), 1),
    "a quantity that is gone": (with_model("ur5", {"": G, "j": {"axis": [1.0]}}), 1),
    "a joint that is gone": (with_model("panda", {"": G}), 2),
    "a new joint": (with_model("panda", {"": G, "j": J, "k": {"axis": [0.0]}}), 1),
}


@pytest.mark.parametrize(
    ("after", "kind", "count"),
    [
        (replace(TWO, parameters={**TWO.parameters, ("ur5", "x"): {"link.m": 1.0}}), SETTINGS, 1),
        (
            replace(
                without("panda"),
                parameters={**TWO.parameters, ("ur5", "x"): {}, ("ur5", "y"): {"link.m": 1.0}},
                cells={**TWO.cells, "n": CellValues("new", (), "ok", (1.0,))},
                models={**TWO.models, "new": KEPT.models["ur5"]},
            ),
            SETTINGS,
            3,
        ),
        (without("panda"), "vanished cells", 1),
    ],
)
def test_an_update_counts_each_new_setting_and_robot(
    after: RunValues, kind: str, count: int
) -> None:
    known = through_file(TWO)
    assert update_of(find_difference(known.run, after, known.tolerances)).counts[kind] == count


@given(st.floats(0.1, 1.0), SIZES)
def test_a_value_has_the_digits_that_exact_comparisons_need(value: float, size: float) -> None:
    """13 of a factor, so that a change of 1e-12 shows and rounding does not; all of a gap."""
    names = ("torque_error", "gap")
    run = replace(
        KEPT,
        metrics={name: METRICS[name] for name in names},
        cells={"a": CellValues("ur5", ("ols",), "ok", (value * size, value))},
    )
    error, gap = through_file(run).run.cells["a"].values
    assert gap == value
    exact = Decimal(value * size)
    step = Decimal(1).scaleb(exact.adjusted() - 12)
    assert error == float(exact.quantize(step))


def test_a_line_holds_the_first_120_letters_of_a_reason() -> None:
    failed = CellValues("ur5", ("ols",), "failed", (None,), "word " * 100)
    kept = through_file(replace(KEPT, cells={**KEPT.cells, "b": failed})).run.cells["b"]
    assert kept.reason == failed.reason[:120]


@pytest.mark.parametrize("largest", [1e-12, 1e-6, 1.0, 1e9])
def test_parameters_are_zero_beside_the_largest_of_a_robot_alone(largest: float) -> None:
    true = {
        "a.m": largest,
        "b.m": 1.1e-9 * largest,
        "c.m": -1.1e-9 * largest,
        "d.m": 0.9e-9 * largest,
    }
    kept = through_file(replace(TWO, parameters={("ur5", "x"): true})).run.parameters["ur5", "x"]
    assert kept == {**{k: pytest.approx(v, rel=1e-6) for k, v in true.items()}, "d.m": 0.0}
    exact = {"a.m": 1e9, "b.m": 1.0}  # a share of 1e-9 itself is rounding
    kept = through_file(replace(TWO, parameters={("ur5", "x"): exact})).run.parameters["ur5", "x"]
    assert kept == {"a.m": 1e9, "b.m": 0.0}


@pytest.mark.parametrize("name", CHANGES)
def test_an_update_takes_over_each_change_and_nothing_else(name: str) -> None:
    after, count = CHANGES[name]
    known, after = through_file(TWO), replace(after, origin={"python": "3.99"})
    found = find_difference(known.run, after, known.tolerances)
    update = update_of(found)
    assert update.taken == count
    assert update.run.origin == after.origin
    written = through_file(update.run).run
    again = find_difference(written, after, known.tolerances)
    assert not again.is_failed
    assert (again.cells, again.parameters, again.models, again.appeared) == ((), (), (), ())
    # Of what has not changed it holds what it held, and of a robot that is gone nothing.
    robots = {cell.robot for cell in after.cells.values()}
    for part in ("cells", "parameters", "models"):
        new, old, kept = (getattr(run, part) for run in (after, known.run, written))
        expected = {
            key: old[key] if new.get(key) == getattr(TWO, part).get(key) else new[key]
            for key in (new if part == "cells" else {**old, **new})
            if part == "cells" or (key if part == "models" else key[0]) in robots
        }
        assert kept == expected, part
    assert not update_of(again).taken


@pytest.mark.parametrize("seed", range(10))
def test_rounding_changes_no_line_of_a_baseline(seed: int) -> None:
    """Base parameters that are zero are numbers of 1e-12 beside the largest, other in each run."""
    rng = random.Random(seed)
    true = {f"link{i}.m": 10.0 ** rng.uniform(-1, 1) for i in range(3)}
    texts = set()
    for _ in range(3):
        zeros = {f"link{i}.hx": rng.uniform(-1e-11, 1e-11) for i in range(3)}
        texts.add(to_text(baseline_of(replace(TWO, parameters={("ur5", "none"): true | zeros}))))
    assert len(texts) == 1


def test_robots_whose_joints_are_not_compared_are_named() -> None:
    """Those of both runs whose behaviour is not known in both; of one run alone there is nothing
    to compare."""
    for before, after, named in (
        ({"ur5", "panda"}, {"ur5", "panda"}, ()),
        ({"ur5"}, {"ur5", "panda"}, ("panda",)),
        ({"ur5", "panda"}, {"panda"}, ("ur5",)),
        (set(), {"panda", "scara"}, ("panda", "ur5")),
    ):
        runs = [replace(TWO, models=dict.fromkeys(known, KEPT.models["ur5"]))
                for known in (before, after)]  # fmt: skip
        found = find_difference(runs[0], runs[1])
        assert found.without_model == named
        assert not found.is_failed
    assert find_difference(replace(TWO, models={}), without("panda")).without_model == ("ur5",)


def test_only_answers_have_a_time(tmp_path: Path) -> None:
    text = 'schema = 1\nname = "s"\n[run]\nrepeats = 4\n[defaults]\nnoise = { tau = "1 %" }\n'
    text += '[[robot]]\nuse = "ur5"\n'
    suite = parse_suite(text + '[[estimator]]\nuse = "ols"\n[[estimator]]\nuse = "wls"\n')
    plan = cells_of_suite(suite)
    folder = RunFolder.new(tmp_path / "run", suite, plan, {})
    with folder.new_writer("w") as writer:
        for cell in plan.cells:
            first = cell.first_fields
            status = "failed" if (first["estimator"], first["repeat"]) == ("wls", 0) else "ok"
            seconds = {"seconds_cpu": 1.0 + first["repeat"], "seconds_experiment_cpu": 5.0}
            writer.write({**first, "status": status, "reason": "", "rank": 36, **seconds})
    speeds = read_run(folder, times=True).speeds
    assert {part: speed.count for (_, part), speed in speeds.items()} == {
        "ols": 4, "wls": 3, EXPERIMENT: 4,
    }  # fmt: skip
    assert read_run(folder).speeds == {}
