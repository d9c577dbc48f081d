"""Verb `limits`: the best error of each recorded robot beside what could be reached."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.request import Request, argument, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.words import RECORDED, REFERENCE

if TYPE_CHECKING:
    import pandas as pd

    from sysid_bench.harness.suite.model import Suite

MAKER: Final = "prior"
"""Estimator whose answers are the model file's inertias."""
HEAD: Final = (
    "| robot | test | best error | method | wls | floor | bound | maker's model |",
    "| --- | --- | ---: | --- | ---: | ---: | ---: | ---: |",
)


class Limits(Request["LimitsResult"]):
    """Print the best error of each recorded robot of a run, and how much is left to win."""

    folder: str | Path = argument("RUN", complete="runs folders")

    def run(self) -> "LimitsResult":
        """Return the limits of the robots of a run on data sets.

        Raises UsageError for a folder without rows of recorded robots.
        """
        from sysid_bench.commands.run_folder import open_run, run_origin
        from sysid_bench.reporting.error_figures import cells_of_motions, floor_of

        run = open_run(self.folder)
        cells, joints, places = run.cells, run.joints, _places(run.suite)
        is_recorded = (cells["simulation"] == RECORDED) & (cells["task"] == "robot")
        found = cells[is_recorded & (cells["status"] == "ok")]
        if found.empty:
            raise UsageError(
                f"{str(self.folder)!r} has no rows of recorded robots; run the suite 'real'."
            )
        robots = []
        for name, part in cells_of_motions(found).groupby("robot", sort=False):
            best = part.sort_values("torque_error").iloc[0]
            robots.append(
                {
                    "robot": str(name),
                    "test": best["held_out"],
                    "best": float(best["torque_error"]),
                    "method": best["estimator"],
                    "wls": _least(part, REFERENCE),
                    "floor": floor_of(part, joints),
                    "maker": _least(part, MAKER),
                    "bound": _bound(places.get(str(name))),
                }
            )
        origin = run_origin(run, len(cells))
        title = run.suite.title or run.suite.name
        return LimitsResult(origin.run, origin.suite_hash, title, robots)


limits = python_function(Limits, "limits")


@dataclass(frozen=True, eq=False, repr=False)
class LimitsResult(Result):
    """Limits of each robot of a run, torque errors on the test.

    `best` error of any `method` and pipeline on the whole training motions, that of `wls`, the
    `floor` of predicting the test torque by the training torque at the nearest state, the
    Cramer-Rao `bound` of the prediction at the noise that repetitions show, and the error of the
    `maker`'s model without joint terms; None where there is none. `suite_hash`: of all cells.
    """

    run: str
    suite_hash: str
    title: str
    robots: list[dict[str, Any]]

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Markdown table, and the suite with its hash."""
        lines = [f"{self.title} (suite {self.run}, hash of its cells {self.suite_hash})", "", *HEAD]
        for one in self.robots:
            best, wls, floor, bound, maker = (
                "–" if one[key] is None else f"{one[key]:.3g}"
                for key in ("best", "wls", "floor", "bound", "maker")
            )
            lines.append(
                f"| {one['robot']} | {one['test']} | {best} | {one['method']} | {wls} | {floor} | "
                f"{bound} | {maker} |"
            )
        return "\n".join(lines)


def _least(cells: "pd.DataFrame", estimator: str) -> float | None:
    values = cells.loc[cells["estimator"] == estimator, "torque_error"]
    return None if values.empty else float(values.min())


def _places(suite: "Suite") -> dict[str, str]:
    """Data set of each robot of a run: its name, or its description."""
    from sysid_bench.models.data_sets import SCHEME, find_dataset

    folder = None if suite.folder is None else Path(suite.folder)
    sources = {str(log.robot) for log in suite.log if str(log.robot).startswith(SCHEME)}
    places: dict[str, str] = {}
    for source in sorted(sources):
        try:
            found = find_dataset(source.removeprefix(SCHEME), folder)
        except UsageError:  # of a machine that had it
            continue
        places[found.described.name] = found.command_name
    return places


def _bound(place: str | None) -> float | None:
    """The bound of a data set whose test repeats its training; None for others, and where the
    recordings are not here."""
    from sysid_bench.apps.twins.recorded_robot import of_data_set, repeat_bound

    try:
        # Rows are stored, recordings may be elsewhere: the bound alone needs them.
        return None if place is None else repeat_bound(of_data_set(place))
    except SysidBenchError:
        return None
