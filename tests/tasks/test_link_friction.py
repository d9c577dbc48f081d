"""The task `link` with friction of all joints unknown, and tools of grippers."""

from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.errors import ModelError
from sysid_bench.models.load import load_robot
from tests.coupling.mechanisms import chain, mjcf
from tests.experiments.experiment_world import executed, spec

SHORT = {"use": "fourier", "period": "2 s", "cycles": 1, "harmonics": 4}
FRICTION = ["viscous", "coulomb"]


@pytest.mark.parametrize(
    "robot",
    ["ur5", *(pytest.param(name, marks=pytest.mark.long) for name in ("panda", "random:7", "z1"))],
)
def test_link_and_friction_of_all_joints_are_exact_without_noise(robot: str) -> None:
    (row,) = executed(spec(robot=robot, task="link", terms=FRICTION, excitation=SHORT), "ols")
    assert row["status"] == "ok", row["reason"]
    assert row["torque_error"] <= 1e-8
    (alone,) = executed(spec(robot=robot, task="link", excitation=SHORT), "ols")
    joints = len(load_robot(robot).scalar_dofs)
    assert row["rank"] == alone["rank"] + 2 * joints


def test_completed_models_state_what_the_data_do_not_determine(tmp_path: Path) -> None:
    file, out = tmp_path / "arm.xml", tmp_path / "out.xml"
    file.write_text(mjcf(chain("a", 3, "0 0 0", np.random.default_rng(0)), ""))
    with pytest.raises(ModelError, match=r"not identified.*--complete entropic"):
        sysid_bench.identify(file, "terminal", simulate=True, model_out=out)
    result = sysid_bench.identify(
        file, "terminal", simulate=True, model_out=out, complete="entropic"
    )
    left = result["parameters"] - result["rank"]
    assert left > 0
    assert f"the other {left} are those of the bodies nearest to the prior" in result.summary()
    assert load_robot(out).nv == 3


def test_terminal_takes_the_tool_of_a_gripper() -> None:
    hand = sysid_bench.basis("panda?tool=panda_hand", "terminal")
    finger = sysid_bench.basis("panda?tool=panda_leftfinger", "terminal")
    assert hand["rows"] == ["panda_joint7"]
    assert finger["rows"] == ["panda_finger_joint1"]
    assert (hand["base_parameters"], finger["base_parameters"]) == (7, 4)
