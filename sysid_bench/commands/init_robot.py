"""Verb `init robot`: a robot folder from a URDF or MJCF file, with what is doubtful in it, or from
a Denavit-Hartenberg table."""

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, cast

from sysid_bench.commands.init import relative_to, toml_value, write_new
from sysid_bench.commands.request import Request, model, option
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import parse_names
from sysid_bench.errors import ModelError, UsageError, first_names

if TYPE_CHECKING:
    from sysid_bench.models.dh_table import DhRow
    from sysid_bench.models.robot import RobotModel

_HEAVIEST: Final = 5_000.0
_LIGHTEST: Final = 1e-3
"""kg of a whole robot."""
_LONGEST: Final = 30.0
"""m from joint to joint."""
_WIDEST: Final = 40.0
"""rad between the limits of a hinge; some drives turn six times."""


class InitRobot(Request["InitRobotResult"]):
    """Write a robot folder from a URDF or MJCF file, or from a Denavit-Hartenberg table."""

    model: str | Path | None = model("MODEL", default=None)
    table: Path | None = option(
        "Denavit-Hartenberg table: link, joint, prev, a, alpha, d, theta, ...",
        default=None, flags="--dh", metavar="TABLE.csv", complete="files",
    )  # fmt: skip
    out: Path | None = option(
        "Folder of the robot; default: its name.", default=None, flags="-o --out", complete="files"
    )
    name: str | None = option("Name of the robot. Default: that of the file.", default=None)
    modified: bool = option("Craig's convention; default: the standard one.", default=False)
    frames: str = option(
        "Where parameters are taken: at the joint before the link, or in its DH frame.",
        default="joint", shown=True, choices=("joint", "link"),
    )  # fmt: skip
    base: str = option("Roll pitch yaw of frame 0.", default="0 0 0", shown=True)
    massless: tuple[str, ...] = option(
        "Links without mass.", default=(), metavar="4,5,6", parse=parse_names
    )

    def run(self) -> "InitRobotResult":
        """Write robot.toml for a model file, or robot.toml and MJCF for a table."""
        if self.model is not None and self.table is None:
            return init_model(self.model, self.out, self.name)
        if self.table is None or self.model is not None:
            raise UsageError(
                "Which robot? Name its model file, sysid-bench init robot my.urdf, or its table of "
                "Denavit-Hartenberg parameters: sysid-bench init robot --dh my.csv."
            )
        return init_robot(
            self.table,
            self.out,
            self.name,
            modified=self.modified,
            frames=self.frames,
            base=self.base,
            massless=self.massless,
        )


@dataclass(frozen=True, eq=False, repr=False)
class InitRobotResult(Result):
    """Written robot: its folder and files, its actuated joints and those that follow them."""

    robot: str
    folder: str
    files: list[str]
    joints: list[str]
    following: list[str]
    warnings: list[str]

    def summary(self) -> str:
        """Joints, warnings, and the command to run next."""
        follows = f"; {', '.join(self.following)} follow" if self.following else ""
        lines = [
            f"{self.robot} in {self.folder}: joints {', '.join(self.joints)}{follows}",
            *(f"  warning: {warning}" for warning in self.warnings),
            f"  next: sysid-bench crosscheck {self.folder}/robot.toml",
        ]
        return "\n".join(lines)


# --- From a model file --------------------------------------------------------------------------


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
    from sysid_bench.input_files import is_file
    from sysid_bench.models.sources import source_settings

    source, settings = source_settings(str(model))
    path = Path(source)
    robot = _loaded(source, settings)
    robot_name = name or Path(source.rpartition(":")[2]).stem
    folder = Path(robot_name if out is None else out)
    manifest = folder / "robot.toml"
    file = relative_to(path, folder) if is_file(path) else source
    doubts = [*robot.repairs, *_doubts(robot, path)]
    write_new(manifest, _text(robot, robot_name, file, doubts, settings), force)
    return _result(robot_name, [manifest], doubts)


def _result(name: str, files: Sequence[Path], warnings: list[str]) -> InitRobotResult:
    """Load the written robot, whose manifest is the first file, and report its joints."""
    from sysid_bench.models.load import load_robot

    robot = load_robot(files[0])
    return InitRobotResult(
        robot=name,
        folder=str(files[0].parent),
        files=[str(file) for file in files],
        joints=list(robot.torque_rows),
        following=[row for row in robot.rows if row not in robot.torque_rows],
        warnings=warnings,
    )


def _loaded(source: str, settings: Mapping[str, Any]) -> "RobotModel":
    """Load the model; for an xacro file or absent meshes, raise UsageError with what to do."""
    from sysid_bench.input_files import is_file
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.manifest import find_manifest

    path = Path(source)
    try:
        if path.suffix == ".xacro" and is_file(path):
            raise ModelError(f"{path} is an xacro file.")
        return load_robot(replace(find_manifest(source), **settings))
    except ModelError as error:
        if path.suffix == ".xacro" or "<xacro:" in _text_of(path):
            advice = (
                "An xacro file is a macro, which is not yet a robot: write it out with ROS, xacro "
                f"{path.name} > plain.urdf, and name that."
            )
        elif "mesh" in str(error).lower():
            advice = (
                "Shapes matter only where inertias are made from them: put the mesh files beside "
                "the model, or remove the mesh geoms (URDF meshes are never needed)."
            )
        else:
            raise
        raise UsageError(f"{error} {advice}") from error


def _text_of(path: Path) -> str:
    from sysid_bench.input_files import read_text

    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError):
        return ""


def _doubts(robot: "RobotModel", path: Path) -> Iterator[str]:
    """Yield what the user should look at."""
    import numpy as np

    from sysid_bench.models.model_checks import placeholder_reason

    yield from _torque_limit_doubts(robot, path)
    # Units: models in g, mm or degrees load without any error.
    mass = float(robot.mj.body_mass.sum())
    if not _LIGHTEST < mass < _HEAVIEST:
        yield f"the whole robot weighs {mass:.3g} kg: are its masses in kg?"
    longest = float(np.abs(robot.mj.body_pos).max(initial=0.0))
    if longest > _LONGEST:
        yield f"joints are up to {longest:.3g} m apart: are its lengths in m?"
    kinds = {joint.dofs[0]: joint.kind for joint in robot.joints}
    spans = zip(robot.rows, robot.limits.q_high - robot.limits.q_low, strict=True)
    wide = [row for row, span in spans if kinds.get(row) == "hinge" and _WIDEST < span < np.inf]
    if wide:
        yield f"the limits of {first_names(wide)} span more than six turns: are they in degrees?"
    placeholders = placeholder_reason(robot)
    if placeholders:
        yield f"its inertias are placeholders, on which no prior is built: {placeholders}"


def _torque_limit_doubts(robot: "RobotModel", path: Path) -> Iterator[str]:
    import numpy as np

    limits = zip(robot.rows, robot.limits.tau, strict=True)
    without = [row for row, limit in limits if not 0 < limit < np.inf]
    if without:
        zero = 'effort="0' in _text_of(path)
        reason = 'effort="0" stands for an absent limit; ' if zero else ""
        yield (
            f"no torque limit of {first_names(without)}: {reason}give [limits.JOINT] tau = ... for "
            "motions to keep"
        )


def _text(
    robot: "RobotModel", name: str, file: str, doubts: list[str], settings: Mapping[str, Any]
) -> str:
    """Text of robot.toml with the settings given; what may be changed stands as a comment."""
    import numpy as np

    from sysid_bench.models.manifest import DRIVE_TERMS

    keys = [
        f"{key} = {toml_value(str(value) if isinstance(value, Path) else value)}"
        for key, value in settings.items()
    ]
    if "tool" not in settings:
        keys += [
            "# The last body of the longest chain carries payloads; name another body or frame.",
            f"# tool = {toml_value(robot.body_names[robot.tool_body])}",
        ]
    v = robot.limits.v[np.isfinite(robot.limits.v) & (robot.limits.v > 0)]
    lines = [
        "# Written by sysid-bench init robot; check what it guessed.",
        *(f"# DOUBT: {' '.join(doubt.split())}" for doubt in doubts),
        f"name  = {toml_value(name)}",
        f"file  = {toml_value(file)}",
        *keys,
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


# --- From a Denavit-Hartenberg table ------------------------------------------------------------


def init_robot(
    table: str | Path,
    out: str | Path | None = None,
    name: str | None = None,
    *,
    modified: bool = False,
    frames: str = "joint",
    base: Sequence[float] | str = (0.0, 0.0, 0.0),
    gravity: Sequence[float] | str = (0.0, 0.0, -9.81),
    massless: Sequence[str] = (),
) -> InitRobotResult:
    """Write robot.toml, the MJCF and a copy of the table to the folder `out` (default: the name).

    `modified`: Craig's convention. `frames`: parameters are about the "joint" before the link or
    in its DH frame ("link"). `base`: roll, pitch, yaw (rad) of frame 0; `gravity` in the world
    (m/s^2); both also as text ("0 pi/2 0"). Masses that the table leaves
    out are those of bars of water from joint to joint. Raises UsageError for a table that
    cannot be read or a folder that already holds a robot, ModelError for an impossible robot.
    """
    from sysid_bench.models.dh_robot import mjcf_of
    from sysid_bench.models.dh_table import read_table

    source = Path(table)
    rows = read_table(source)
    robot_name = name or source.stem
    if frames not in ("joint", "link"):
        raise UsageError(f"frames must be 'joint' or 'link'; got {frames!r}.")
    convention: Literal["standard", "modified"] = "modified" if modified else "standard"
    turned = _three_numbers(base, "base")
    text = mjcf_of(
        rows,
        robot_name,
        convention,
        cast(Literal["joint", "link"], frames),
        base=turned,
        gravity=_three_numbers(gravity, "gravity"),
        massless=massless,
    )
    files = _write_model(Path(robot_name if out is None else out), robot_name, text, source)
    links = [row for row in rows.rows if row.kind != "F"]
    conventions = _conventions(convention, frames, turned)
    manifest = _table_manifest(robot_name, conventions, massless, links)
    files[0].write_text(manifest, encoding="utf-8")
    invented = [f"link{row.link}" for row in links if row.mass is None and row.link not in massless]
    warnings = [f"masses made up: {', '.join(invented)}"] if invented else []
    return _result(robot_name, files, warnings)


def _write_model(folder: Path, name: str, text: str, table: Path) -> list[Path]:
    """Write the MJCF and the copy of the table to a folder without a robot; return the files of
    this one, its manifest first."""
    from sysid_bench.input_files import is_file

    files = [folder / "robot.toml", folder / f"{name}.xml", folder / "dh.csv"]
    manifest, model_file, copy = files
    if is_file(manifest):
        raise UsageError(f"{str(folder)!r} already holds a robot; name another folder with -o.")
    folder.mkdir(parents=True, exist_ok=True)
    model_file.write_text(text, encoding="utf-8")
    # The table may already lie in the folder: copying a file onto itself is an error.
    if table.resolve() != copy.resolve():
        shutil.copyfile(table, copy)
    return files


def _three_numbers(given: Sequence[float] | str, option: str) -> tuple[float, ...]:
    """Numbers of a text like "0 pi/2 0"; raise UsageError for another count."""
    if not isinstance(given, str):
        return tuple(given)
    from sysid_bench.models.dh_table import read_expression

    words = given.replace(",", " ").split()
    if len(words) != 3:
        raise UsageError(f"--{option}: write three numbers, as '0 pi/2 0'; got {given!r}.")
    return tuple(read_expression(word, {}, frozenset(), f"--{option}").constant for word in words)


def _conventions(convention: str, frames: str, base: tuple[float, ...]) -> dict[str, str]:
    """Keys of the table in a manifest, as TOML."""
    keys = {"convention": f'"{convention}"', "frames": f'"{frames}"'}
    if any(base):
        keys["base"] = f"[{', '.join(f'{x:.17g}' for x in base)}]"
    return keys


def _table_manifest(
    name: str, conventions: Mapping[str, str], massless: Sequence[str], links: "Sequence[DhRow]"
) -> str:
    """Text of robot.toml with the `conventions` of its table."""
    without = f"massless = [{_bodies(massless)}]  # not asked for\n" if massless else ""
    dh = "".join(f"{key:<10} = {value}\n" for key, value in conventions.items())
    return (
        f'name  = "{name}"\nfile  = "{name}.xml"\nterms = ["viscous", "coulomb"]\n{without}'
        f'[dh]\ntable      = "dh.csv"\n{dh}'
        f"[paper]\norder = [{_bodies(row.link for row in links)}]\n"
        "[limits.all]\nv = 2.0\na = 5.0\n"
    )


def _bodies(links: Iterable[str]) -> str:
    """Names of the bodies of links, as the entries of a TOML list."""
    return ", ".join(f'"link{link}"' for link in links)
