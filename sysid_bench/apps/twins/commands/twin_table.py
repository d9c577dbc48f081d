"""Twins and null twins of several data sets, side by side."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest

from sysid_bench.apps.twins.agreement import Residual, residual_ratio, robot_median, torque_errors
from sysid_bench.apps.twins.commands.identify_twin import identify_twin, replay_residual, twin_share
from sysid_bench.apps.twins.commands.twin import TRUTHS
from sysid_bench.apps.twins.fit_twin import Twin
from sysid_bench.apps.twins.recorded_robot import RecordedRobot, of_data_set, residual_of, run_work
from sysid_bench.commands.result import Result
from sysid_bench.errors import SysidBenchError
from sysid_bench.models.data_sets import find_dataset

LEVEL: Final = (0.7, 1.4)
"""Level ratios that count as alike."""

MEMORY: Final = 2.0
"""Factor of autocorrelation times within which joints count as alike."""

_HEAD: Final = (
    "| set | truth | joints | error recorded | level twin | level null | memory twin | memory null "
    "| spectrum twin | spectrum null | explained twin | explained null |",
    "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
)


@dataclass(frozen=True, eq=False, repr=False)
class TwinTableResult(Result):
    """Likeness of twins to the robots of data sets, one row for each set and truth.

    `twin`, `null`: `level` of all joints, `alike`, the joints whose autocorrelation time lies
    within a factor of two, `spectrum` (dB), the median over the joints, and `explained`, the mean
    over the joints of the share of the recorded residual's power that a replay without noise has,
    too. `type`: the robot's. `reason` of rows that failed.
    """

    rows: list[dict[str, Any]]

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Markdown table, and the number of robots and joints that are alike."""
        lines = [*_HEAD, *(_line(row) for row in self.rows), ""]
        for truth in TRUTHS:
            rows = [row for row in self.rows if row["truth"] == truth and not row["reason"]]
            parts = [_count_of_kind(kind, rows) for kind in ("twin", "null")]
            lines.append(f"truth {truth}. {'; '.join(parts)}.")
            if rows:
                lines.append(_explained_text(rows))
        return "\n".join(lines)


def _line(row: Mapping[str, Any]) -> str:
    if row["reason"]:
        return f"| {row['set']} | {row['truth']} | failed: {row['reason']} |" + " |" * 9
    twin, null = row["twin"], row["null"]
    cells = [
        row["set"], row["truth"], row["joints"], f"{row['error']:.3f}",
        f"{twin['level']:.2f}", f"{null['level']:.2f}", twin["alike"], null["alike"],
        f"{twin['spectrum']:.1f}", f"{null['spectrum']:.1f}",
        *(f"{100 * one['explained']:.1f} %" for one in (twin, null)),
    ]  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


def _explained_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """On how many robots a twin explains more than its null twin; those of one type count once."""
    by_type: dict[str, list[float]] = {}
    for row in rows:
        more = row["twin"]["explained"] - row["null"]["explained"]
        by_type.setdefault(row["type"], []).append(more)
    means = [float(np.mean(values)) for values in by_type.values()]
    wins = sum(mean > 0 for mean in means)
    # A sign test over types of robot: nothing is assumed of the shares but which of two is larger.
    p = binomtest(wins, len(means)).pvalue
    found, limits = robot_median(means), ""
    if found.low is not None and found.high is not None:
        limits = f" [{100 * found.low:.1f}, {100 * found.high:.1f}]"
    return (
        f"Explained: twin above null on {wins} of {len(means)} types of robot (sign test, p = "
        f"{p:.2g}), by {100 * (found.value or 0.0):.1f}{limits} % of the power (median)."
    )


def _count_of_kind(kind: str, rows: Sequence[Mapping[str, Any]]) -> str:
    joints = sum(row["joints"] for row in rows)
    levels = sum(LEVEL[0] <= row[kind]["level"] <= LEVEL[1] for row in rows)
    alike = sum(row[kind]["alike"] for row in rows)
    return (
        f"{kind}: level within {LEVEL[0]:g} to {LEVEL[1]:g} on {levels} of {len(rows)} "
        f"robots, autocorrelation time within a factor {MEMORY:g} on {alike} of {joints} joints"
    )


def twin_table(
    sets: Sequence[str],
    *,
    truth: Sequence[str] = TRUTHS,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[str], None] | None = None,
) -> TwinTableResult:
    """Fit twins and null twins of the robots of data sets, and compare them on the test motions.

    `jobs` processes share the sets; `progress` is called with each that is done. A set that cannot
    be used has a row with the reason. Raises UsageError for an unknown set.
    """
    sets = tuple(dict.fromkeys(sets))
    robots = {name: of_data_set(name) for name in sets}
    described = {name: find_dataset(name).described for name in sets}
    types = {name: one.robot_type or one.name for name, one in described.items()}
    work = {name: partial(_rows, name, robots[name], tuple(truth), seed) for name in sets}
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, found in run_work(work, jobs):
        rows[name] = [{**row, "type": types[name]} for row in found]
        if progress is not None:
            progress(name)
    return TwinTableResult(list(chain.from_iterable(rows[name] for name in sets)))


def _rows(
    name: str, recorded: RecordedRobot, truths: Sequence[str], seed: int
) -> list[dict[str, Any]]:
    rows = []
    for truth in truths:
        row: dict[str, Any] = {"set": name, "truth": truth, "reason": ""}
        rows.append(row)
        try:
            real = residual_of(recorded.problems)
            row |= {"joints": real[0].e.shape[1], "error": torque_errors(real)}
            with tempfile.TemporaryDirectory() as folder:
                for kind in ("twin", "null"):
                    place = Path(folder) / f"{kind}.toml"
                    found = identify_twin(recorded, truth, place, null=kind == "null")
                    row[kind] = _figures(recorded, found, real, seed)
        except SysidBenchError as error:
            row["reason"] = str(error).partition(". ")[0]
    return rows


def _figures(
    recorded: RecordedRobot, found: Twin, real: Sequence[Residual], seed: int
) -> dict[str, Any]:
    drawn = replay_residual(recorded, found, seed)
    each, explained = residual_ratio(real, drawn), twin_share(recorded, found)
    alike = [1 / MEMORY <= one.memory <= MEMORY for one in each]
    error = torque_errors(list(chain.from_iterable(drawn)))
    return {
        "level": error / torque_errors(real),
        "alike": sum(alike),
        "spectrum": float(np.median([one.spectrum for one in each])),
        "levels": [one.level for one in each],
        "memories": [one.memory for one in each],
        "explained": float(explained.mean()),
        "shares": explained.tolist(),
    }
