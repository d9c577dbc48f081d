"""Laws of joint terms: chosen joint by joint, and what couples two of them."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.errors import ModelError, UsageError
from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms, find_manifest
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.regressors.regression import regression
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from tests.robots import NAMED, named_robot, states


def coupled(name: str, seed: int) -> tuple[RobotModel, tuple[str, ...]]:
    """A robot whose last two hinges cost one another friction, unsymmetrically, and the names."""
    rng = np.random.default_rng(seed)
    manifest = replace(find_manifest(name), couplings=False, massless=())
    rows = [robot.rows[dof] for robot in (load_robot(manifest),) for dof in robot.scalar_dofs]
    one, other = rows[-2:]
    b, c, d = rng.normal(size=3)
    joints = {
        one: JointTerms(viscous=2.0, viscous_coupling={other: b}, offset=0.1),
        other: JointTerms(viscous=1.0, viscous_coupling={one: c}, spring=abs(d)),
    }
    robot = load_robot(replace(manifest, joints=joints))
    return robot, (f"{one}.fv.{other}", f"{other}.fv.{one}", f"{other}.k")


@pytest.mark.parametrize("name", [n for n in NAMED if n != "solo12"])
def test_torque_is_linear_in_every_term(name: str) -> None:
    robot, extra = coupled(name, 1)
    terms = ("viscous", "coulomb", *extra)
    asked = task_of(robot, "robot", terms)
    motion = states(robot)
    rest = asked.known_terms["offset"] + asked.known_terms["armature"] * motion.a
    tau = regression(robot, asked.parameters).torque(motion, asked.truth.theta) + rest
    oracle, _ = Inverse().run(plant_of(robot), motion, np.zeros_like(motion.v))
    known = sum(
        bool(values.any()) for term, values in asked.known_terms.items() if term not in ("offset",)
    )
    if known == asked.known_terms["armature"].any():
        np.testing.assert_allclose(tau, oracle.tau, rtol=0, atol=1e-9 * np.abs(tau).max())
    for terms, known in ((extra, False), ((), True)):
        coupling = task_of(robot, "robot", terms).known_coupling
        assert coupling is not None
        assert coupling.any() == known


def test_names_of_terms() -> None:
    robot = named_robot("ur5")
    everywhere = robot.term_columns(("viscous",))
    assert everywhere == tuple(f"{row}.fv" for row in robot.rows)
    assert robot.term_columns(("elbow_joint.fv", "viscous"))[0] == "elbow_joint.fv"
    assert len(robot.term_columns(("elbow_joint.fv", "viscous"))) == 6
    for term, suffix in SUFFIX.items():
        assert robot.resolve_term(f"elbow_joint.{suffix}") == (term, 2, None)
    assert robot.resolve_term("elbow_joint.fv.wrist_1_joint") == ("viscous_coupling", 2, 3)
    for wrong in ("viscos", "elbow.fv", "elbow_joint.q", "elbow_joint.fv.elbow_joint", "a.fv.b"):
        with pytest.raises(UsageError, match="joint term"):
            robot.term_columns((wrong,))


def test_a_coupling_with_a_joint_that_is_not_there() -> None:
    manifest = find_manifest("ur5")
    for other in ("elbow_joint", "elbw"):
        joints = {"elbow_joint": JointTerms(viscous_coupling={other: 1.0})}
        with pytest.raises(ModelError, match="viscous_coupling"):
            load_robot(replace(manifest, joints=joints))
