"""New robot folder from a URDF or MJCF file, with what is doubtful in it: init robot."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import ModelError, UsageError, first_names
from sysid_bench.input_files import is_file, read_text
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import DRIVE_TERMS, find_manifest
from sysid_bench.models.model_checks import placeholder_reason
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sources import source_settings
from sysid_bench.verbs.init.init_log import toml_value
from sysid_bench.verbs.init.init_robot import InitRobotResult
from sysid_bench.verbs.init.new_file import relative_to, write_new

_HEAVIEST: Final = 5_000.0
_LIGHTEST: Final = 1e-3
"""kg of a whole robot."""
_LONGEST: Final = 30.0
"""m from joint to joint."""
_WIDEST: Final = 40.0
"""rad between the limits of a hinge; some drives turn six times."""


def init_model(
    model: str | Path,
    out: str | Path | None = None,
    name: str | None = None,
    *,
    force: bool = False,
) -> InitRobotResult:
    """Write robot.toml for a model file to the folder `out` (default: the name).

    What is guessed and what is doubtful stands in comments. Raises UsageError for an xacro file, a
    missing file or an existing robot without `force`, ModelError for a model that cannot be used.
    """
    source, settings = source_settings(str(model))
    path = Path(source)
    robot = _loaded(source, settings)
    robot_name = name or Path(source.rpartition(":")[2]).stem
    folder = Path(robot_name if out is None else out)
    manifest = folder / "robot.toml"
    file = relative_to(path, folder) if is_file(path) else source
    doubts = [*robot.repairs, *_doubts(robot, path)]
    write_new(manifest, _text(robot, robot_name, file, doubts, settings), force)
    written = load_robot(manifest)
    return InitRobotResult(
        robot=robot_name,
        folder=str(folder),
        files=[str(manifest)],
        joints=list(written.torque_rows),
        following=[row for row in written.rows if row not in written.torque_rows],
        warnings=doubts,
    )


def _loaded(source: str, settings: Mapping[str, Any]) -> RobotModel:
    """Load the model; for an xacro file or absent meshes, raise UsageError with what to do."""
    path = Path(source)
    try:
        if path.suffix == ".xacro" and is_file(path):
            raise ModelError(f"{path} is an xacro file.")
        return load_robot(replace(find_manifest(source), **settings))
    except ModelError as error:
        advice = _advice(path, str(error))
        if not advice:
            raise
        raise UsageError(f"{error} {advice}") from error


def _advice(path: Path, error: str) -> str:
    """Remedy for a model that cannot be loaded, "" where the error says it."""
    if path.suffix == ".xacro" or "<xacro:" in _text_of(path):
        return (
            "An xacro file is a macro, which is not yet a robot: write it out with ROS, xacro "
            f"{path.name} > plain.urdf, and name that."
        )
    if "mesh" in error.lower():
        return (
            "Shapes matter only where inertias are made from them: put the mesh files beside the "
            "model, or remove the mesh geoms (URDF meshes are never needed)."
        )
    return ""


def _text_of(path: Path) -> str:
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError):
        return ""


def _doubts(robot: RobotModel, path: Path) -> Iterator[str]:
    """Yield what the user should look at."""
    yield from _limit_doubts(robot, path)
    yield from _unit_doubts(robot)
    placeholders = placeholder_reason(robot)
    if placeholders:
        yield f"its inertias are placeholders, on which no prior is built: {placeholders}"


def _limit_doubts(robot: RobotModel, path: Path) -> Iterator[str]:
    limits = zip(robot.rows, robot.limits.tau, strict=True)
    without = [row for row, limit in limits if not 0 < limit < np.inf]
    if without:
        zero = 'effort="0' in _text_of(path)
        reason = 'effort="0" stands for an absent limit; ' if zero else ""
        yield (
            f"no torque limit of {first_names(without)}: {reason}give [limits.JOINT] tau = ... for "
            "motions to keep"
        )


def _unit_doubts(robot: RobotModel) -> Iterator[str]:
    mass = float(robot.mj.body_mass.sum())
    if not _LIGHTEST < mass < _HEAVIEST:
        yield f"the whole robot weighs {mass:.3g} kg: are its masses in kg?"
    longest = float(np.abs(robot.mj.body_pos).max(initial=0.0))
    if longest > _LONGEST:
        yield f"joints are up to {longest:.3g} m apart: are its lengths in m?"
    wide = _wide_hinges(robot)
    if wide:
        yield f"the limits of {first_names(wide)} span more than six turns: are they in degrees?"


def _wide_hinges(robot: RobotModel) -> list[str]:
    """Rows of the hinges whose limits are finite and far apart."""
    kinds = {joint.dofs[0]: joint.kind for joint in robot.joints}
    spans = zip(robot.rows, robot.limits.q_high - robot.limits.q_low, strict=True)
    return [row for row, span in spans if kinds.get(row) == "hinge" and _WIDEST < span < np.inf]


def _setting_lines(robot: RobotModel, settings: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys that the settings stand for, and the tool where none is given."""
    for key, value in settings.items():
        yield f"{key} = {toml_value(str(value) if isinstance(value, Path) else value)}"
    if "tool" not in settings:
        yield "# The last body of the longest chain carries payloads; name another body or frame."
        yield f"# tool = {toml_value(robot.body_names[robot.tool_body])}"


def _text(
    robot: RobotModel, name: str, file: str, doubts: list[str], settings: Mapping[str, Any]
) -> str:
    """Text of robot.toml with the settings given; what may be changed stands as a comment."""
    v = robot.limits.v[np.isfinite(robot.limits.v) & (robot.limits.v > 0)]
    lines = [
        "# Written by sysid-bench init robot; check what it guessed.",
        *(f"# DOUBT: {' '.join(doubt.split())}" for doubt in doubts),
        f"name  = {toml_value(name)}",
        f"file  = {toml_value(file)}",
        *_setting_lines(robot, settings),
        "# Joint terms identified besides inertia: guessed, as drives with gears have them.",
        f"terms = {toml_value(DRIVE_TERMS)}",
        "# Gravity in the base frame: a robot on a wall or under a ceiling has another one.",
        "# gravity = [0, 0, -9.81]",
        "# Limits of test motions; what is absent comes from the model.",
        "# [limits.all]",
        f"# v = {v.min(initial=2.0):.3g}    # rad/s, m/s",
        "# a = 10.0   # rad/s^2, m/s^2: models have none",
    ]
    return "\n".join(lines) + "\n"
