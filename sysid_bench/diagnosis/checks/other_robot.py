"""A recording of another robot than the model: the nearest one of the library."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis, first_hypothesis
from sysid_bench.errors import SysidBenchError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import read_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.package_folders import robots
from sysid_bench.types import Recording

BLIND: Final = "robots that are not in the library, and scaled twins"
SCALAR: Final = ("hinge", "slide")


def other_robot(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with each robot of the library that has as many joints, in their order."""
    evidence = before.evidence
    for name, manifest in robots().items():
        robot = _like(evidence, manifest)
        if robot is None or robot.name == evidence.robot.name:
            continue
        yield Candidate(
            name="robot",
            joints=tuple(range(evidence.count)),
            hypothesis=first_hypothesis(_on(evidence, robot)),
            message=f"the recording fits {robot.manifest.title or name} better than the model",
            edit=f"--model {name}",
            blind=BLIND,
        )


def _like(evidence: DiagnoseInput, file: Path) -> RobotModel | None:
    """A robot of the library, None where it has other joints or cannot be loaded."""
    try:
        robot = load_robot(read_manifest(file))
    except (SysidBenchError, OSError):
        return None
    kinds = tuple(joint.kind for joint in robot.joints)
    return robot if kinds == evidence.kinds and robot.coupling is None else None


def _on(evidence: DiagnoseInput, robot: RobotModel) -> DiagnoseInput:
    """The recording taken as that of another robot, joint by joint."""
    recording = evidence.log.recording
    N, k = len(recording), [joint.qadr for joint in robot.joints]
    q = np.tile(robot.mj.qpos0, (N, 1))
    q[:, k] = recording.q[:, evidence.position_columns]
    tau = np.zeros((N, len(robot.torque_rows)))
    tau[:] = evidence.torque_samples
    other = Recording(recording.t, q, tau, recording.rate, robot.torque_rows)
    # Cures look for the joints by name in the description, which is then one of that robot.
    name_of = dict(zip(evidence.joints, robot.rows, strict=True))
    log = evidence.log
    renamed = tuple(name_of.get(joint, joint) for joint in log.description.joints)
    description = replace(log.description, joints=renamed)
    log = replace(log, description=description, recording=other, joints=robot.rows)
    return DiagnoseInput(log, robot)
