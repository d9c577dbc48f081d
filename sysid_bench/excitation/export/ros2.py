"""Export as a ROS 2 message trajectory_msgs/JointTrajectory, in YAML or JSON."""

import json
from typing import Any

from sysid_bench.excitation.export.commands import Commands


def _message(commands: Commands) -> dict[str, Any]:
    """Return the message as nested values; `effort` is the feed-forward torque (N m, N)."""
    points = [
        {
            "positions": commands.q[k].tolist(),
            "velocities": commands.v[k].tolist(),
            "accelerations": commands.a[k].tolist(),
            "effort": commands.tau[k].tolist(),
            "time_from_start": _duration(float(commands.t[k])),
        }
        for k in range(len(commands))
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": list(commands.joints), "points": points}


def json_text(commands: Commands) -> str:
    """Return the message as JSON."""
    return json.dumps(_message(commands)) + "\n"


def ros2_text(commands: Commands) -> str:
    """Return the message as YAML, one line per point in the JSON subset of YAML."""
    whole = _message(commands)
    lines = [
        f"header: {json.dumps(whole['header'])}",
        f"joint_names: {json.dumps(whole['joint_names'])}",
        "points:",
        *(f"- {json.dumps(point)}" for point in whole["points"]),
    ]
    return "\n".join(lines) + "\n"


def _duration(t: float) -> dict[str, int]:
    nanoseconds = round(t * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
