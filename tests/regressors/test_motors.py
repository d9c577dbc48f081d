"""Laws of what acts in motors: no power is lost in a transmission, and a name has its place."""

import numpy as np
import pytest

from sysid_bench.plugin_names import build
from sysid_bench.regressors.joint_features import MotorColumns, features_of, motor_names
from sysid_bench.types import Trajectory


def columns_of(G: np.ndarray, motors: Trajectory) -> MotorColumns:
    k = len(G)
    table = features_of([build("term", "play")], motor_names(k), [(i, i) for i in range(k)],
                        [motors])  # fmt: skip
    joints = tuple(f"j{i}" for i in range(k))
    return MotorColumns(np.linalg.inv(G), joints, ("fv", "fc", "Ia"), table)


@pytest.mark.parametrize("seed", range(5))
def test_what_motors_pay_is_what_joints_feel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    k, N = 3, 200
    G = rng.normal(size=(k, k)) + 2 * np.eye(k)
    t = np.linspace(0, 5, N)
    q = np.sin(np.outer(t, rng.uniform(0.5, 3, k)))
    v = np.gradient(q, t, axis=0)
    motors = Trajectory(t, q, v, np.gradient(v, t, axis=0))
    columns = columns_of(G, motors)
    assert columns.coupled == columns.columns
    for name in columns.columns:
        power = sum(
            columns.on_row(joint, [name], motors)[:, 0] * (v @ G.T)[:, i]
            for i, joint in enumerate(columns.coordinates)
        )
        motor = columns.names.index(name.partition(".")[0])
        paid = {"fv": v, "fc": np.sign(v), "Ia": motors.a}.get(name.partition(".")[2])
        own = columns.features.of_joint(columns.names[motor], motors, [name])
        torque = own[:, 0] if paid is None else paid[:, motor]
        np.testing.assert_allclose(power, torque * v[:, motor], atol=1e-9)


def test_a_motor_alone_is_its_joint() -> None:
    G = np.array([[2.0, 0, 0], [0, 1, 0], [0, -1, 1]])
    t = np.linspace(0, 1, 20)
    motion = Trajectory(t, np.outer(t, [1, 2, 3]), np.ones((20, 3)), np.zeros((20, 3)))
    columns = columns_of(G, motion)
    assert {name.partition(".")[0] for name in columns.coupled} == {"motor2", "motor3"}
    assert columns.rows_of("motor1.fv") == ("j0",)
    assert columns.rows_of("motor2.fv") == ("j1",)
    assert columns.rows_of("motor3.fv") == ("j1", "j2")
