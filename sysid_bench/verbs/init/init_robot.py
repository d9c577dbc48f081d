"""New robot folder from a Denavit-Hartenberg table."""

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError
from sysid_bench.input_files import is_file
from sysid_bench.models.dh_robot import mjcf_of
from sysid_bench.models.dh_table import DhRow, read_expression, read_table
from sysid_bench.models.load import load_robot


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


@dataclass(frozen=True)
class _Conventions:
    """[dh] of a manifest: convention, frames of the parameters, base frame, massless links."""

    convention: Literal["standard", "modified"]
    frames: Literal["joint", "link"]
    base: tuple[float, ...]
    massless: tuple[str, ...]


class _Files(NamedTuple):
    manifest: Path
    model: Path
    table: Path


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
    source = Path(table)
    rows = read_table(source)
    robot_name = name or source.stem
    conventions = _conventions(modified, frames, base, massless)
    text = mjcf_of(
        rows,
        robot_name,
        conventions.convention,
        conventions.frames,
        base=conventions.base,
        gravity=_three_numbers(gravity, "gravity"),
        massless=massless,
    )
    links = [row for row in rows.rows if row.kind != "F"]
    files = _new_files(Path(robot_name if out is None else out), robot_name)
    files.model.write_text(text, encoding="utf-8")
    _copy(source, files.table)
    files.manifest.write_text(_manifest(robot_name, conventions, links), encoding="utf-8")
    return _result(robot_name, files, _mass_warnings(links, massless))


def _copy(table: Path, target: Path) -> None:
    # The table may already lie in the folder: copying a file onto itself is an error.
    if table.resolve() != target.resolve():
        shutil.copyfile(table, target)


def _result(name: str, files: _Files, warnings: list[str]) -> InitRobotResult:
    """Load the written robot, and report its joints."""
    robot = load_robot(files.manifest)
    return InitRobotResult(
        robot=name,
        folder=str(files.manifest.parent),
        files=[str(file) for file in files],
        joints=list(robot.torque_rows),
        following=[row for row in robot.rows if row not in robot.torque_rows],
        warnings=warnings,
    )


def _conventions(
    modified: bool, frames: str, base: Sequence[float] | str, massless: Sequence[str]
) -> _Conventions:
    """Conventions as [dh] has them; raise UsageError for unknown frames."""
    if frames not in ("joint", "link"):
        raise UsageError(f"frames must be 'joint' or 'link'; got {frames!r}.")
    return _Conventions(
        "modified" if modified else "standard",
        "joint" if frames == "joint" else "link",
        _three_numbers(base, "base"),
        tuple(massless),
    )


def _new_files(folder: Path, name: str) -> _Files:
    """Files of a new robot in a folder, which is made; raise UsageError where it holds a robot."""
    files = _Files(folder / "robot.toml", folder / f"{name}.xml", folder / "dh.csv")
    if is_file(files.manifest):
        raise UsageError(f"{str(folder)!r} already holds a robot; name another folder with -o.")
    folder.mkdir(parents=True, exist_ok=True)
    return files


def _mass_warnings(links: Sequence[DhRow], massless: Sequence[str]) -> list[str]:
    """Warn about links whose mass the table leaves out."""
    invented = [f"link{row.link}" for row in links if row.mass is None and row.link not in massless]
    return [f"masses made up: {', '.join(invented)}"] if invented else []


def _three_numbers(given: Sequence[float] | str, option: str) -> tuple[float, ...]:
    """Numbers of a text like "0 pi/2 0"; raise UsageError for another count."""
    if not isinstance(given, str):
        return tuple(given)
    words = given.replace(",", " ").split()
    if len(words) != 3:
        raise UsageError(f"--{option}: write three numbers, as '0 pi/2 0'; got {given!r}.")
    return tuple(read_expression(word, {}, frozenset(), f"--{option}").constant for word in words)


def _manifest(name: str, conventions: _Conventions, links: Sequence[DhRow]) -> str:
    """Text of robot.toml; lines of defaults are left out."""
    massless = base = ""
    if conventions.massless:
        massless = f"massless = [{_bodies(conventions.massless)}]  # not asked for\n"
    if any(conventions.base):
        base = f"base       = [{', '.join(f'{x:.17g}' for x in conventions.base)}]\n"
    return (
        f'name  = "{name}"\nfile  = "{name}.xml"\nterms = ["viscous", "coulomb"]\n{massless}'
        f'[dh]\ntable      = "dh.csv"\nconvention = "{conventions.convention}"\n'
        f'frames     = "{conventions.frames}"\n{base}'
        f"[paper]\norder = [{_bodies(row.link for row in links)}]\n"
        f"[limits.all]\nv = {2.0}\na = {5.0}\n"
    )


def _bodies(links: Iterable[str]) -> str:
    """Names of the bodies of links, as the entries of a TOML list."""
    return ", ".join(f'"link{link}"' for link in links)
