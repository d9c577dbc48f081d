"""Signals of the measured joints along a recording, and the torque of all but their friction."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import Filter
from sysid_bench.simulation.inverse import Inverse, joint_positions, rigid_torque
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.types import Array, Recording, Trajectory

FRICTION: Final = ("viscous", "coulomb", "offset")
"""Joint terms that are fitted again beside the effects."""


@dataclass(frozen=True, eq=False)
class JointSignals:
    """Motion and torque of n joints at N samples, filtered as for a test: positions `q` and rates
    `v`, the torque on the links `load`, the torque `rest` of all but the joints' own FRICTION, and
    the measured torque `tau`, (N, n) each. `filter` is that of the torque."""

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    load: Array
    rest: Array
    tau: Array
    rate: float  # Hz
    filter: Filter

    def smooth(self, x: Array) -> Array:
        """Return columns x (N, k) through the filter of the torque."""
        return self.filter.smooth(x, self.rate)


def processed_recording(log: ProcessedLog, preprocessing: LogProcessing) -> Recording:
    """Return a recording with the motion and torque that a test on it would have."""
    found = preprocessing.signals(log.log.recording, log.robot.joints, training=False).recording
    motion = log.robot.completed(found.motion)
    return replace(found, q=motion.q, v=motion.v, a=motion.a)


def joint_signals(robot: RobotModel, recording: Recording, filter: Filter) -> JointSignals:
    """Return the signals of a processed recording along which a robot with these inertias moved."""
    dofs, motion = robot.torque_dofs, recording.motion
    terms = robot.joint_terms
    none = {name: _without(getattr(terms, name), dofs) for name in FRICTION}
    full = plant_of(robot)
    plant = Plant(robot, replace(full.terms, **none), full.laws)
    oracle, _ = Inverse().run(plant, motion, np.zeros((len(motion), len(dofs))))
    return JointSignals(
        joints=robot.torque_rows,
        t=motion.t - motion.t[0],
        q=joint_positions(robot, motion)[:, dofs],
        v=motion.v[:, dofs],
        load=_load(robot, plant, motion)[:, dofs],
        rest=oracle.tau,
        tau=recording.tau,
        rate=recording.rate,
        filter=filter,
    )


def _own_friction(robot: RobotModel) -> dict[str, Mapping[str, float]]:
    """Return the FRICTION of each measured joint."""
    terms = robot.joint_terms
    return {
        name: {term: float(getattr(terms, term)[dof]) for term in FRICTION}
        for name, dof in zip(robot.torque_rows, robot.torque_dofs, strict=True)
    }


def _load(robot: RobotModel, plant: Plant, motion: Trajectory) -> Array:
    """Torque (N, nv) on the links: M a + bias without armature."""
    rigid = rigid_torque(plant.contact_free_model, motion)
    return np.asarray(rigid - robot.joint_terms.armature * motion.a)


def _without(values: Array, dofs: Array) -> Array:
    left = values.copy()
    left[dofs] = 0.0
    return left
