"""Changes between two runs as lines of a table and of JSON."""

import math
import shlex
from collections.abc import Sequence
from typing import Any, Final

from sysid_bench.harness.comparison.run_difference import Change, ParameterChange, RunDifference
from sysid_bench.harness.comparison.run_values import Value
from sysid_bench.harness.comparison.speed import (
    FEWEST_PARTS,
    LIMIT,
    SIGMAS,
    SIGMAS_POOLED,
    SpeedChange,
)
from sysid_bench.reporting.text_table import TextTable, to_markdown

WORST_SHOWN: Final = 10


def largest_first(changes: tuple[Change, ...]) -> list[Change]:
    """Changes of status, then those of values by their factor, the largest first."""
    return sorted(changes, key=_size, reverse=True)


def _size(change: Change) -> float:
    """|ln(after / before)|; infinite for a status, and for a value that was zero or is gone."""
    before, after = change.before, change.after
    if isinstance(before, str) or isinstance(after, str) or not (before and after):
        return math.inf
    return abs(math.log(abs(after) / abs(before)))


def change_json(changes: RunDifference, change: Change) -> dict[str, Any]:
    """A change with the labels of its cell."""
    return {
        "id": change.cell,
        "cell": changes.before.label(change.cell),
        "metric": change.metric,
        "before": change.before,
        "after": change.after,
        "verdict": change.verdict,
        "tolerance": change.tolerance,
    } | ({"reason": change.reason} if change.reason else {})


def parameter_json(change: ParameterChange) -> dict[str, Any]:
    """A changed base parameter of a robot."""
    return {
        "robot": change.robot,
        "setting": change.setting,
        "parameter": change.parameter,
        "before": change.before,
        "after": change.after,
    }


def change_table(
    name: str, title: str, changes: RunDifference, of: list[Change], count: int | None = WORST_SHOWN
) -> TextTable:
    """The first `count` of some changes as a table; None: all."""
    shown = of[:count]
    rows = tuple(
        (
            changes.before.label(change.cell), change.metric, text(change.before),
            text(change.after), change.tolerance, change.cell,
        )
        for change in shown
    )  # fmt: skip
    reasons = [f"{c.cell}: {c.reason}" for c in shown if c.reason]
    hidden = len(of) - len(shown)
    more = [f"{hidden} more are in --json."] if hidden else []
    head = ("cell", "metric", "before", "after", "tolerance", "id")
    return TextTable(name, title, head, rows, (*reasons, *more))


def parameter_table(changes: RunDifference, count: int | None = WORST_SHOWN) -> TextTable:
    """The first `count` of the changed base parameters as a table; None: all."""
    shown = changes.parameters[:count]
    rows = tuple(
        (change.robot, change.setting, change.parameter, text(change.before), text(change.after))
        for change in shown
    )
    hidden = len(changes.parameters) - len(shown)
    more = (f"{hidden} more are in --json.",) if hidden else ()
    head = ("robot", "setting", "base parameter", "before", "after")
    return TextTable("parameters", "True base parameters that changed", head, rows, more)


def speed_json(change: SpeedChange) -> dict[str, Any]:
    """A changed speed; `noise` as a share."""
    return {
        "robot": change.robot,
        "part": change.part,
        "factor": change.factor,
        "noise": math.expm1(change.noise),
        "verdict": change.verdict,
    }


def speed_text(changes: RunDifference) -> list[str]:
    """Table of the parts whose speed changed, and a sentence on the noise; none without times."""
    if not changes.speeds:
        return []
    gone = changes.without_time
    lost = [f"{len(gone)} parts have times in the baseline alone: {first_names(gone)}"]
    return [*_moved(changes.speeds), _noise_sentence(changes.speeds), *(lost if gone else [])]


def _moved(speeds: Sequence[SpeedChange]) -> list[str]:
    """Table of the parts that are slower or faster; nothing without any."""
    rows = tuple(
        (change.robot, change.part, text(change.factor), _noise(change), change.verdict)
        for change in speeds
        if change.verdict in ("slower", "faster")
    )
    if not rows:
        return []
    head = ("robot", "part", "time after / before", "noise", "verdict")
    table = TextTable("speeds", "Speeds that changed, relative to the other parts", head, rows)
    return [to_markdown(table).rstrip()]


def _noise_sentence(speeds: Sequence[SpeedChange]) -> str:
    noise = sorted(speeds, key=lambda change: change.noise)[len(speeds) // 2]
    unseen = sum(change.verdict == "undecided" for change in speeds)
    return (
        f"times: {len(speeds)} ratios within the runs compared, noise {_noise(noise)} "
        f"(median); a factor counts beyond {LIMIT:g} and {SIGMAS_POOLED:g} times its noise of all "
        f"robots, {SIGMAS:g} times of one; in {unseen} nothing is decided: noise that would hide a "
        f"factor of two (more repeats lower it), fewer than {FEWEST_PARTS} parts, or other cells."
    )


def _noise(change: SpeedChange) -> str:
    return f"{math.expm1(change.noise):.0%}"


def first_names(names: Sequence[str]) -> str:
    """The first three of some names, as "ur5 ols; ur5 wls; panda ols ..."."""
    return "; ".join(names[:3]) + (" ..." if len(names) > 3 else "")


def cells_text(changes: RunDifference) -> list[str]:
    """Sentences on cells that only one of the runs has, and on those that have not run."""
    named = (
        ("appeared", changes.appeared, changes.after),
        ("vanished", changes.vanished, changes.before),
        ("have not run", changes.open, changes.before),
    )
    return [
        f"{len(cells)} cells {what}: {first_names([run.label(cell) for cell in cells])}"
        for what, cells, run in named
        if cells
    ]


def origin_text(changes: RunDifference) -> list[str]:
    """Sentence on what differs in code, libraries and machine."""
    parts = [f"{name} {was} -> {now}" for name, was, now in changes.origin]
    return [f"differs: {', '.join(parts)}"] if parts else []


def tables_text(changes: RunDifference, title: str, of: list[Change]) -> list[str]:
    """Tables of some changes and of the parameters, where there are any."""
    listings = [change_table("changes", title, changes, of)] if of else []
    listings += [parameter_table(changes)] if changes.parameters else []
    return [to_markdown(listing).rstrip() for listing in listings]


def cell_command(folder: str, cell: str) -> str:
    """Command that computes a cell again."""
    return f"sysid-bench run {shlex.quote(folder)} --select 'id == \"{cell}\"' --rerun all"


def text(value: Value | str) -> str:
    """Six digits of a value; \"-\" where it is not there."""
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.6g}"
