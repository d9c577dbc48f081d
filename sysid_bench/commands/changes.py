"""Changes between two runs as tables, sentences and JSON, for `compare` and `gate`."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

from sysid_bench.harness.comparison import speed
from sysid_bench.harness.comparison.run_difference import Change, RunDifference
from sysid_bench.harness.comparison.run_values import RunValues, Value
from sysid_bench.reporting.text_table import TextTable, to_markdown

WORST_SHOWN: Final = 10


def largest_first(changes: Sequence[Change]) -> list[Change]:
    """Return changes of status, then those of values by their factor, the largest first."""

    def size(change: Change) -> float:
        """|ln(after / before)|; infinite for a status, and for a value that was zero or is gone."""
        before, after = change.before, change.after
        if isinstance(before, str) or isinstance(after, str) or not (before and after):
            return math.inf
        return abs(math.log(abs(after) / abs(before)))

    # By factor and not by difference: metrics have different units.
    return sorted(changes, key=size, reverse=True)


def common_fields(changes: RunDifference) -> dict[str, Any]:
    """Return the fields that answers on two runs share."""
    return {
        "parameters": [asdict(change) for change in changes.parameters],
        "models": [asdict(change) for change in changes.models],
        "drifts": [asdict(drift) for drift in changes.drifts],
        "appeared": list(changes.appeared),
        "vanished": list(changes.vanished),
        "open": list(changes.open),
        "origin": list(changes.origin),
    }


def change_json(before: RunValues, change: Change) -> dict[str, Any]:
    """Return a change from a run with the labels of its cell."""
    values = asdict(change)
    cell, reason = values.pop("cell"), values.pop("reason")
    values = {"id": cell, "cell": before.label(cell), **values}
    return values | ({"reason": reason} if reason else {})


def change_tables(
    title: str, changes: RunDifference, of: Sequence[Change], count: int | None = WORST_SHOWN
) -> list[TextTable]:
    """Return the first `count` of some changes, and of the changed base parameters, as tables where
    there are any; None: all."""

    def table(name: str, title: str, head: tuple[str, ...], rows: Sequence[tuple[str, ...]],
              reasons: tuple[str, ...] = ()) -> TextTable:  # fmt: skip
        more = len(rows) - len(rows[:count])
        hidden = (f"{more} more are in --json.",) if more else ()
        return TextTable(name, title, head, tuple(rows[:count]), (*reasons, *hidden))

    tables = []
    if of:
        head: tuple[str, ...] = ("cell", "metric", "before", "after", "tolerance", "id")
        rows: list[tuple[str, ...]] = [
            (changes.before.label(one.cell), one.metric, *_pair(one), one.tolerance, one.cell)
            for one in of
        ]
        reasons = tuple(f"{one.cell}: {one.reason}" for one in of[:count] if one.reason)
        tables.append(table("changes", title, head, rows, reasons))
    if changes.parameters:
        head = ("robot", "setting", "base parameter", "before", "after")
        rows = [(one.robot, one.setting, one.parameter, *_pair(one)) for one in changes.parameters]
        tables.append(table("parameters", "True base parameters that changed", head, rows))
    if changes.models:
        head = ("robot", "joint", "quantity", "before", "after")
        # Of a joint that is gone or new its kind stands for all quantities.
        alone = {(one.robot, one.joint) for one in changes.models if one.quantity == "kind"}
        rows = [
            (one.robot, one.joint or "(robot)", one.quantity, _list_text(one.before),
             _list_text(one.after))
            for one in changes.models
            if one.quantity == "kind" or (one.robot, one.joint) not in alone
        ]  # fmt: skip
        tables.append(table("models", "Joints that changed, in SI units", head, rows))
    return tables


def tables_text(title: str, changes: RunDifference, of: Sequence[Change]) -> list[str]:
    """Return the tables of changes as Markdown."""
    return [to_markdown(table).rstrip() for table in change_tables(title, changes, of)]


def models_text(changes: RunDifference) -> list[str]:
    """Return a sentence on the robots whose joints are not compared."""
    if not changes.without_model:
        return []
    return [
        f"Joints of {first_labels(changes.without_model)} are not compared, since not both have "
        "them; 'baseline update' adds those of a run."
    ]


def _list_text(values: Sequence[Any] | None) -> str:
    """Return numbers with six digits, of long lists the first four."""
    if values is None:
        return "-"
    texts = [value if isinstance(value, str) else f"{value:.6g}" for value in values]
    return " ".join(texts[:4] + ["..."] * (len(texts) > 4))


def drift_text(changes: RunDifference) -> list[str]:
    """Return a sentence for each metric whose cells move in common."""
    return [
        f"{drift.metric} is {drift.verdict} in common: {drift.factor:.5f} times in the mean of "
        f"{len(drift.cells)} cells within their tolerance (p {drift.p:.1g}, {drift.groups} groups)."
        for drift in changes.drifts
    ]


def moved_text(
    before: RunValues, moved: Sequence[Change], origin: Sequence[tuple[str, str, str]]
) -> str:
    """Return the table of the values that are other numbers, or that there is none."""
    # The commit is what is looked at; libraries and machines move last digits by themselves.
    others = any(name != "commit" for name, _, _ in origin)
    versions = f"between {'other' if others else 'equal'} versions"
    if not moved:
        return f"exact: no value moved by more than 1e-12 {versions}."
    rows = [
        (before.label(one.cell), one.metric, *map(repr, (one.before, one.after))) for one in moved
    ]
    hidden = len(rows) - WORST_SHOWN
    notes = (f"{hidden} more are in --json.",) if hidden > 0 else ()
    title = f"{len(rows)} values moved by more than 1e-12 {versions}"
    head = ("cell", "metric", "before", "after")
    return to_markdown(TextTable("moved", title, head, tuple(rows[:WORST_SHOWN]), notes)).rstrip()


def speed_text(changes: RunDifference) -> list[str]:
    """Return the table of the parts whose speed changed, and a sentence on the noise; nothing
    without times."""
    speeds, gone = changes.speeds, changes.without_time
    if not speeds:
        return []
    rows = tuple(
        (one.robot, one.part, value_text(one.factor), _share(one.noise), one.verdict)
        for one in speeds
        if one.verdict in ("slower", "faster")
    )
    head = ("robot", "part", "time after / before", "noise", "verdict")
    table = TextTable("speeds", "Speeds that changed, relative to the other parts", head, rows)
    median = sorted(change.noise for change in speeds)[len(speeds) // 2]
    unseen = sum(change.verdict == "undecided" for change in speeds)
    texts = [to_markdown(table).rstrip()] if rows else []
    texts.append(
        f"times: {len(speeds)} ratios within the runs compared, noise {_share(median)} "
        f"(median); a factor counts beyond {speed.LIMIT:g} and {speed.SIGMAS_POOLED:g} times its "
        f"noise of all robots, {speed.SIGMAS:g} times of one; in {unseen} nothing is decided: "
        "noise that would hide a factor of two (more repeats lower it), fewer than "
        f"{speed.FEWEST_PARTS} parts, or other cells."
    )
    if gone:
        texts.append(f"{len(gone)} parts have times in the baseline alone: {first_labels(gone)}")
    return texts


def _share(noise: float) -> str:
    """Noise of a logarithm as a share."""
    return f"{math.expm1(noise):.0%}"


def first_labels(names: Sequence[str]) -> str:
    """Return the first three of some labels, as "ur5 ols; ur5 wls; panda ols ..."."""
    return "; ".join(names[:3]) + (" ..." if len(names) > 3 else "")


def cells_text(changes: RunDifference) -> list[str]:
    """Return sentences on cells that only one of the runs has, and on those that have not run."""
    named = (
        ("appeared", changes.appeared, changes.after),
        ("vanished", changes.vanished, changes.before),
        ("have not run", changes.open, changes.before),
    )
    return [
        f"{len(cells)} cells {what}: {first_labels([run.label(cell) for cell in cells])}"
        for what, cells, run in named
        if cells
    ]


def origin_text(changes: RunDifference) -> list[str]:
    """Return a sentence on what differs in code, libraries and machine."""
    parts = [f"{name} {was} -> {now}" for name, was, now in changes.origin]
    return [f"differs: {', '.join(parts)}"] if parts else []


def _pair(change: Any) -> tuple[str, str]:
    return value_text(change.before), value_text(change.after)


def value_text(value: Value | str) -> str:
    """Return six digits of a value; \"-\" where it is not there."""
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.6g}"
