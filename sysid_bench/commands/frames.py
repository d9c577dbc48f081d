"""Verb `frames`: the frames of all bodies and of the tool at a configuration."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench.commands.request import Request, model, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import parse_numbers
from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from sysid_bench.models.robot import Joint, RobotModel
    from sysid_bench.types import Array


class Frames(Request["FramesResult"]):
    """Print the forward kinematics: origin and rotation of every body and of the tool in the world,
    and gravity there."""

    source: str | Path = model("ROBOT|FILE")
    at: Mapping[str, float] | None = option(
        "Position of a joint, rad or m; others stay at the reference. Repeat it for each.",
        default=None, metavar="JOINT=X", several=True,
        parse=lambda texts: parse_numbers("at", texts, "elbow=0.5"),
    )  # fmt: skip
    robots_dir: Path | None = None

    def run(self) -> "FramesResult":
        """Return the frames of a robot (a name, a URDF or an MJCF file) in the world.

        `at`: positions (rad, m) of joints by name; others stay at the reference configuration, and
        dependent joints follow. `robots_dir`: folder of robots of one's own. Raises UsageError for
        unknown and for dependent joints, and ModelError where a closed chain cannot be closed
        there.
        """
        from sysid_bench.models.assembly import tool_frame
        from sysid_bench.models.load import load_robot
        from sysid_bench.models.shape import body_frames

        robot = load_robot(self.source, robots_dir=self.robots_dir)
        joints = {joint.name: joint for joint in robot.joints if joint.kind in ("hinge", "slide")}
        q = _configuration(robot, joints, dict(self.at or {}))
        positions, quaternions = body_frames(robot, q)
        bodies = {
            name: _transformation(p, w)
            for name, p, w in zip(robot.body_names, positions[0], quaternions[0], strict=True)
        }
        body, (place, turn) = tool_frame(robot.mj, robot.manifest, robot.body_names)
        tool_body = robot.body_names[body]
        return FramesResult(
            robot=robot.name,
            q={name: float(q[0, joint.qadr]) for name, joint in joints.items()},
            gravity=robot.tree.gravity.tolist(),
            frames={name: T.tolist() for name, T in bodies.items()},
            tool_body=tool_body,
            tool=(bodies[tool_body] @ _transformation(place, turn)).tolist(),
        )


frames = python_function(Frames, "frames")


@dataclass(frozen=True, eq=False, repr=False)
class FramesResult(Result):
    """Homogeneous transformations from the frames of bodies, and of the tool, to the world.

    `q`: positions (rad, m) of hinges and slides, dependent joints included; `gravity` (m/s^2) in
    the world, which states how the base is mounted; `frames`: {body: (4, 4), m}; `tool`: (4, 4).
    """

    robot: str
    q: dict[str, float]
    gravity: list[float]
    frames: dict[str, Any]
    tool_body: str
    tool: Any

    def summary(self) -> str:
        """Configuration and gravity, then a line for each frame: position, and the rows of R."""
        q = "  ".join(f"{name} {value:.5g}" for name, value in self.q.items())
        gravity = " ".join(f"{x:.5g}" for x in self.gravity)
        width = max(map(len, [*self.frames, "tool"]))
        lines = [
            f"{self.robot}: {q}",
            f"gravity in the world: {gravity} m/s^2; tool: on {self.tool_body}",
            f"{'frame':<{width}}  {'origin, m':<27}  rotation by rows",
        ]
        for name, T in [*self.frames.items(), ("tool", self.tool)]:
            # Rounding errors print as zero.
            rows = [[round(float(x), 12) + 0.0 for x in row] for row in T[:3]]
            rotation = "  ".join(" ".join(f"{x:7.4f}" for x in row[:3]) for row in rows)
            origin = " ".join(f"{row[3]:8.5f}" for row in rows)
            lines.append(f"{name:<{width}}  {origin}   {rotation}")
        return "\n".join(lines)


def _configuration(
    robot: "RobotModel", joints: "Mapping[str, Joint]", at: Mapping[str, float]
) -> "Array":
    """The configuration q (1, nq) with these joints moved; dependent joints follow."""
    import numpy as np

    coupling = robot.coupling
    q = robot.mj.qpos0[None].copy()
    if coupling is not None:
        q = coupling.default_closure(q[0])[None]
    for name, value in at.items():
        if name not in joints:
            raise unknown_name("hinge or slide", name, joints)
        joint = joints[name]
        if coupling is not None and joint.vadr in coupling.dependent:
            led = ", ".join(robot.rows[d] for d in coupling.independent_of(int(joint.vadr)))
            raise UsageError(f"{name!r} is a dependent joint; it follows {led}: give these.")
        if not np.isfinite(value):
            raise UsageError(f"The position of {name!r} is {value}; give a finite number.")
        q[0, joint.qadr] = value
    if coupling is not None:
        still = np.zeros((1, robot.nv))
        q, _, _ = coupling.completed(q, still, still)
    return np.asarray(q)


def _transformation(position: "Array", quaternion: "Array") -> "Array":
    """T (4, 4) of a pose."""
    import numpy as np

    from sysid_bench.spatial import matrix_of_quaternion

    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_of_quaternion(quaternion), position
    return T
