"""Small experiments: short specifications, robots of this folder and shipped ones, made once."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench import package_folders
from sysid_bench.evaluation.score import score
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.job_channel import JobChannel, Method, ProcessEnd
from sysid_bench.experiments.loaded_robot import LoadedRobot, loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.third_party import third_party_parts
from sysid_bench.harness.work.blind_process import blind_method
from sysid_bench.identification.identify import identify
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import build
from sysid_bench.types import Array, Row, Trajectory

MODELS: Final = Path(__file__).parent / "models"
SHIPPED: Final = tuple(package_folders.robots())
RICH: Final = "rich/robot.toml"
"""Two hinges and a slide with every joint term but Coulomb friction."""
SMOOTH: Final = "smooth/robot.toml"
"""A UR5 without Coulomb friction."""
OWN: Final = ("file:arm.xml", "file:ball.xml", "file:free.xml", RICH)
LOADS: Final = tuple(name for name in PAYLOADS if name != "none")
CLOSED_LOOP: Final = {"use": "closed-loop", "rate": "500 Hz", "substeps": 1}

BASE: Final = ExperimentSpec(
    seed=1,
    robot="ur5",
    payload="none",
    task="robot",
    terms=None,
    plant={"use": "matched"},
    prior={"mass": 0.2, "com": 0.015, "inertia": 0.3},
    excitation={"use": "fourier", "period": "4 s", "cycles": 1},
    held_out=({"use": "ptp", "moves": 2},),
    simulation={"use": "inverse"},
    rate=50.0,
    noise={},
    signals={"filter": "none", "derivatives": "exact"},
    repeat=0,
)


@dataclass(frozen=True)
class Law:
    """The effect of a plug-in author: the same law for every robot."""

    law: Any

    def prepare(self, robot: RobotModel) -> Any:
        return self.law


def robot_of(source: str, payload: str | Mapping[str, Any] = "none") -> RobotModel:
    """A robot by name or by its file in the folder `models`."""
    return subject_of(source, payload).robot


def subject_of(source: str, payload: str | Mapping[str, Any] = "none") -> LoadedRobot:
    return loaded_robot(source, payload, None, str(MODELS))


def spec(**changes: Any) -> ExperimentSpec:
    """BASE with some fields changed."""
    return replace(BASE, **changes)


def ready(**changes: Any) -> ExperimentData[SimulatedSource]:
    """The experiment of `spec(**changes)`, prepared again."""
    made = spec(**changes)
    return prepare_simulated(made, subject_of(made.robot, made.payload))


@cache
def ready_once(
    robot: str, payload: str = "none", task: str = "robot"
) -> ExperimentData[SimulatedSource]:
    """An exact experiment that tests share and must not change."""
    return ready(robot=robot, payload=payload, task=task)


@cache
def smooth_loop() -> ExperimentData[SimulatedSource]:
    """A noise-free closed-loop experiment of the UR5 without Coulomb friction, with a payload."""
    return ready(robot=SMOOTH, payload="box-2kg", simulation=CLOSED_LOOP)


def motion_of(
    robot: RobotModel, excitation: str | Mapping[str, Any], rate: float, seed: int = 0
) -> Trajectory:
    """A motion of a registered excitation."""
    made: Trajectory = build("excitation", excitation).design(
        design_problem(robot, rate), np.random.default_rng(seed)
    )
    return made


def argument(
    made: ExperimentSpec,
    *estimators: str | Mapping[str, Any],
    tolerance: float = 1e-12,
    on_fail: str = "skip-robot",
) -> dict[str, Any]:
    """The argument of `execute`, as from the harness: one cell per estimator, named by index."""
    specs = [{"use": e} if isinstance(e, str) else dict(e) for e in estimators]
    made_argument: dict[str, Any] = {
        "experiment": made.to_json(),
        "seed": made.seed,
        "estimators": [
            {**e, "cell": f"cell{i}", "label": str(e["use"])} for i, e in enumerate(specs)
        ],
        "labels": {"experiment": made.id, "robot": made.robot},
        "crosscheck": {"tolerance": tolerance, "on_fail": on_fail},
        "folder": str(MODELS),
        "robots_dir": None,
        "fingerprints": {},
    }
    return made_argument | {"third_party": third_party_parts(made_argument)}


@dataclass
class Collected:
    """Channel that collects rows in this process, third-party code included."""

    cells: frozenset[str]
    rows: list[Row] = field(default_factory=list)

    def start_cell(self, cell: str) -> None:
        assert cell in self.cells

    def write(self, row: Row) -> None:
        assert row["id"] in self.cells
        self.rows.append(row)

    def progress(self, value: Any) -> None:
        raise AssertionError("an experiment reports rows alone")

    def blind_method(
        self, estimator: Mapping[str, Any], *, simulated: bool, sealed: bool
    ) -> AbstractContextManager[Method]:
        return blind_method(estimator, MODELS / "no run", simulated=simulated, sealed=sealed)

    def run_process(
        self, function: Callable[[JobChannel], Any], heads: Mapping[str, Row]
    ) -> ProcessEnd | None:
        function(self)
        return None


def rows_of(argument: Mapping[str, Any]) -> list[Row]:
    """The rows that an argument of `execute` gives."""
    from sysid_bench.experiments.execute import execute

    channel = Collected(frozenset(entry["cell"] for entry in argument["estimators"]))
    execute(argument, channel)
    return channel.rows


def executed(
    made: ExperimentSpec, *estimators: str | Mapping[str, Any], tolerance: float = 1e-12
) -> list[Row]:
    """The rows of one experiment."""
    return rows_of(argument(made, *estimators, tolerance=tolerance))


def dense(problem: Any) -> tuple[Array, Array]:
    """W (N, rows, r) and b (N, rows) of a problem, from its blocks."""
    parts = list(problem.blocks())
    return np.concatenate([Y for Y, _ in parts]), np.concatenate([b for _, b in parts])


def solved(made: ExperimentData[Any], method: Any) -> tuple[Any, Any]:
    """The estimate of a method and its scores, typed loosely: what should be a number may be None,
    and then fails where it is compared."""
    estimate = identify(method, made.problem)
    return estimate, score(estimate, made.problem, made.held_out, made.source.truth)
