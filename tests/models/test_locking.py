"""Laws of locked joints: what is left moves as the whole robot does with them at rest."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sysid_bench.errors import ModelError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from tests.robots import NAMED

SOURCES = [*NAMED, *(f"random:{seed}" for seed in range(8))]


def some_joints(robot: RobotModel, seed: int) -> dict[str, float]:
    """Half of the joints that are alone on their body, anywhere near their reference."""
    rng = np.random.default_rng(seed)
    mj = robot.mj
    free = [] if robot.coupling is None else [group.dofs for group in robot.coupling.groups]
    coupled = set(np.concatenate(free).tolist()) if free else set()
    return {
        joint.name: float(mj.qpos0[joint.qadr] + rng.uniform(-0.4, 0.4))
        for j, joint in enumerate(robot.joints)
        if joint.kind in ("hinge", "slide")
        and joint.vadr not in coupled
        and mj.body_jntnum[mj.jnt_bodyid[j]] == 1
        and rng.random() < 0.5
    }


@pytest.mark.parametrize("source", SOURCES)
def test_the_rest_moves_as_before(source: str) -> None:
    manifest = find_manifest(source)
    whole = load_robot(manifest)
    where = some_joints(whole, 1)
    if len(where) == len(whole.joints) or not where:
        pytest.skip("nothing is left to move, or nothing to lock")
    part = load_robot(replace(manifest, locked=where))
    assert set(part.rows) == {
        dof for joint in whole.joints if joint.name not in where for dof in joint.dofs
    }
    assert part.body_names == whole.body_names
    np.testing.assert_allclose(part.phi, whole.phi, rtol=0, atol=1e-12)
    assert crosscheck(part, samples=5).ok()
    rng = np.random.default_rng(0)
    one, other = mujoco.MjData(whole.mj), mujoco.MjData(part.mj)
    one.qpos[:], other.qpos[:] = whole.mj.qpos0, part.mj.qpos0
    places = {joint.name: joint for joint in whole.joints}
    for name, position in where.items():
        one.qpos[places[name].qadr] = position
    for joint in part.joints:
        twin = places[joint.name]
        rates = rng.normal(size=len(joint.dofs))
        one.qvel[twin.vadr : twin.vadr + len(rates)] = rates
        other.qvel[joint.vadr : joint.vadr + len(rates)] = rates
        if joint.kind in ("hinge", "slide"):
            one.qpos[twin.qadr] = other.qpos[joint.qadr] = rng.normal()
    mujoco.mj_forward(whole.mj, one)
    mujoco.mj_forward(part.mj, other)
    rows = [whole.rows.index(row) for row in part.rows]
    scale = max(np.abs(one.qfrc_bias).max(), 1.0)
    np.testing.assert_allclose(one.qfrc_bias[rows], other.qfrc_bias, rtol=0, atol=1e-10 * scale)


def test_a_joint_that_is_not_there() -> None:
    with pytest.raises(ModelError, match="elbow_joint"):
        load_robot(replace(find_manifest("ur5"), locked={"elbw_joint": 0.0}))


def test_a_joint_is_not_locked_while_one_coupled_to_it_moves() -> None:
    manifest = find_manifest("dvrk_mtm")
    for joint in ("j3", "j2p"):
        with pytest.raises(ModelError, match="coupled to it"):
            load_robot(replace(manifest, locked={joint: 0.0}))
