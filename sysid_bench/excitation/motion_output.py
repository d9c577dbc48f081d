"""Files of motions: exports for controllers, and recorded motions read again."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.csv_text import cell_text
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.excitation import export
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.export import Commands
from sysid_bench.excitation.information import torque_model
from sysid_bench.excitation.optimised import Optimised
from sysid_bench.input_files import check_replaceable, is_file, is_folder, read_text
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Trajectory

if TYPE_CHECKING:
    import pandas as pd

EXPORTS: Final = ("csv", "ros2", "damiao", "can")
STARTS: Final = ("t,", "header:", '{"header"', "# Damiao", "(0.0")
"""Beginnings of the files of the exports."""
RESTING: Final = "fourier-polynomial"
"""Family of curves for exports to hardware: it starts and ends at rest."""

MOVING_START: Final = (
    "the motion starts and ends at speed; a motion for hardware should start and end at rest: "
    f"--family {RESTING}"
)

Drives = tuple[export.DamiaoDrive, ...]


@dataclass(frozen=True)
class MotionOutput:
    """Warnings about a written motion; `drives`: scaling and clamping of each Damiao motor."""

    warnings: list[str]
    drives: list[dict[str, Any]] | None


def check_output(export: str | None, out: str | Path | None) -> str:
    """Return the kind of export; raise UsageError for an unknown one or a file without folder."""
    kind = export or "csv"
    if kind not in EXPORTS:
        raise unknown_name("export", kind, EXPORTS)
    if out is None and export is not None:
        raise UsageError("Where does the export go? Give a file: -o FILE.")
    if out is not None and not is_folder(Path(out).parent):
        raise UsageError(f"The folder {str(Path(out).parent)!r} of the motion does not exist.")
    if out is not None:
        check_replaceable(Path(out), STARTS, "a motion that excite wrote")
    if out is not None and export is None and Path(out).suffix not in ("", ".csv"):
        raise UsageError(
            f"{str(out)!r} would hold CSV: name it *.csv, or give --export {' or '.join(EXPORTS)}."
        )
    return kind


def joint_motors(
    kind: str, joints: tuple[str, ...], motors: Mapping[str, Mapping[str, Any]] | None
) -> Drives:
    """Drives of the joints for Damiao exports; none for the others. `motors` by the names of the
    joints, or by their numbers from 1."""
    if kind not in ("damiao", "can"):
        return ()
    if not motors:
        raise UsageError(
            f"Which motors drive {', '.join(joints)}? Name them in this order, as --motors "
            f"DM4340,DM4310,..., or in a TOML file; there are: {', '.join(export.MOTORS)}."
        )
    by_number = {str(k): name for k, name in enumerate(joints, 1)}
    if set(motors) <= by_number.keys() - set(joints):
        if len(motors) != len(joints):
            raise UsageError(
                f"{len(motors)} motor(s) for {len(joints)} joints: {', '.join(joints)}; name one "
                "each."
            )
        motors = {by_number[k]: motor for k, motor in motors.items()}
    return export.damiao_motors(joints, motors)


def read_motion(
    file: Path, problem: DesignProblem, joints: tuple[str, ...], method: Optimised
) -> Trajectory:
    """Read a recorded motion: columns t, <joint>.q, .v, .a, as a CSV export has them."""
    table = _read_table(file, [f"{joint}.{key}" for joint in joints for key in "qva"])
    space = method.space(problem)
    # Joints that the design does not move stand at the reference configuration.
    q = np.tile(problem.q0, (len(table), 1))
    v, a = np.zeros((2, len(table), sum(len(joint.dofs) for joint in problem.joints)))
    moving = space.v_indices
    for array, columns, key in ((q, space.q_indices, "q"), (v, moving, "v"), (a, moving, "a")):
        array[:, columns] = table[[f"{joint}.{key}" for joint in joints]].to_numpy()
    t = table["t"].to_numpy() if "t" in table else np.arange(len(table)) / problem.rate
    return problem.completed(Trajectory(t, q, v, a, file.name))


def _read_table(file: Path, columns: Sequence[str]) -> "pd.DataFrame":
    """Table of a CSV file; raise UsageError where the file or columns of it are absent."""
    import pandas as pd

    if not is_file(file):
        raise UsageError(f"The file {str(file)!r} of a recorded motion does not exist.")
    try:
        # Before 3.1 pandas is by default inexact in the last digit.
        old = tuple(map(int, pd.__version__.split(".")[:2])) < (3, 1)
        exact: dict[str, Any] = {"float_precision": "round_trip"} if old else {}
        table = pd.read_csv(io.StringIO(read_text(file)), **exact)
        table = table.rename(columns=cell_text)
    except (OSError, ValueError) as error:  # those of pandas are ValueErrors
        raise UsageError(f"{file} is not a table of a recorded motion: {error}.") from error
    missing = [column for column in columns if column not in table]
    if missing:
        raise UsageError(
            f"{file.name} has no columns {', '.join(missing[:8])}; a recorded motion is a CSV file "
            "as excite writes it."
        )
    table = table[[*columns, *{"t"}.intersection(table)]]
    numbers: pd.DataFrame = table.apply(pd.to_numeric, errors="coerce").astype(float)
    wrong = np.argwhere(~np.isfinite(numbers.to_numpy()))
    if len(wrong):
        row, column = wrong[0]
        raise UsageError(
            f"{file}, row {row + 1}, column {table.columns[column]!r}: "
            f"{str(table.iloc[row, column])!r} is not a finite number; record the motion again, or "
            "correct the row."
        )
    return numbers


def joint_commands(robot: RobotModel, motion: Trajectory, joints: tuple[str, ...]) -> Commands:
    """Return positions, rates and feed-forward torques of the joints along a motion."""
    named = {joint.name: joint for joint in robot.joints}
    qadr, dofs = [named[name].qadr for name in joints], [named[name].vadr for name in joints]
    rows = [robot.torque_rows.index(name) for name in joints]
    tau = torque_model(robot).of(motion)[:, rows]
    return Commands(joints, motion.t, motion.q[:, qadr], motion.v[:, dofs], motion.a[:, dofs], tau)


def write_motion(
    file: Path, kind: str, commands: Commands, drives: Drives, clamp: float
) -> MotionOutput:
    """Write commands in the format of an export; at most the share `clamp` of a motor's samples may
    be clamped to its range."""
    warnings = [] if commands.is_at_standstill else [MOVING_START]
    entries = None
    if kind == "csv":
        text = export.commands_csv(commands)
    elif kind == "ros2":
        text = (export.json_text if file.suffix == ".json" else export.ros2_text)(commands)
    else:
        # Clamping changes the commands, so that table and report describe what the motors receive.
        commands, report = export.limit_commands(commands, drives, clamp)
        if kind == "can":
            text = export.log_text(commands, drives)
        else:
            text = export.table_text(commands, drives, report)
        entries = [drive.to_json() | entry for drive, entry in zip(drives, report, strict=True)]
        # These motors overheat in the long run.
        warnings += [
            f"{entry['joint']}: RMS torque {entry['rms_torque']:.3g} N m is above the rated "
            f"{entry['rated_torque']:.3g} N m of its motor"
            for entry in report
            if entry["hot"]
        ]
    file.write_text(text, encoding="utf-8")
    return MotionOutput(warnings, entries)
