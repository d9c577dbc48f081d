"""Actuators of a robot whose base moves as a log says: a trunk with two legs, simulated by
accelerations of the joints alone, of MuJoCo's M and bias along the motion of the trunk."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators import rollout
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.errors import UsageError
from sysid_bench.signals.log_data import log_of
from sysid_bench.types import Array

RATE, EACH = 200.0, 4
"""Hz of the recording, and points of the plant's grid in a sample: two for each midpoint step."""

KP, KD = 30.0, 0.8
JOINTS = ("left_hip", "left_knee", "right_hip", "right_knee")
LEG = """<body name="{0}_upper" pos="0 {1} 0">
  <inertial pos="0 .02 -.08" mass="1.1" diaginertia=".006 .006 .001"/>
  <joint name="{0}_hip" axis="{2} 1 0"/>
  <body name="{0}_lower" pos="0 0 -.21">
    <inertial pos=".01 0 -.14" mass=".3" diaginertia=".002 .002 .0001"/>
    <joint name="{0}_knee" axis="0 1 0"/>
  </body></body>"""
MODEL = """<mujoco><worldbody><body name="trunk">{}
  <inertial pos="0 0 .02" mass="5" diaginertia=".05 .1 .1"/>
  {}{}</body></worldbody></mujoco>"""
LEGS = LEG.format("left", 0.1, 0), LEG.format("right", -0.1, 0.5)
FREE = '<freejoint name="float"/>'


def turning(rates: Array, step: float) -> Array:
    """Quaternions (N, 4) after turning at rates (N, 3) in the body's own axes."""
    q = np.empty((len(rates), 4))
    now = np.array([1.0, 0.0, 0.0, 0.0])
    for k, rate in enumerate(rates):
        q[k] = now
        mujoco.mju_quatIntegrate(now, rate, step)
    return q


@cache
def recording(seed: int) -> dict[str, Array]:
    """Exact samples of a trunk that is carried about, and of legs that follow commands."""
    rng = np.random.default_rng(seed)
    n, step = int(8.0 * RATE), 1.0 / (RATE * EACH)
    t = np.arange(n * EACH) * step
    phase = rng.uniform(0.0, 6.0, (4, 4))

    def waves(size: float, low: float, high: float, row: int, order: int = 0) -> Array:
        w = 2.0 * np.pi * np.linspace(low, high, 4)[:3]
        arc = t[:, None] * w + phase[row, :3] + 0.5 * np.pi * order
        return np.asarray(size * np.cos(arc) * w**order)

    position, velocity, acceleration = (waves(0.08, 0.7, 1.7, 0, k) for k in range(3))
    turn, turned = (waves(1.2, 0.4, 1.3, 1, k) for k in range(2))
    rotation = turning(turn + 0.5 * step * turned, step)
    w = 2.0 * np.pi * rng.uniform(0.4, 2.0, 4)
    q_des = 0.4 * np.sin(t[::EACH, None] * w + phase[2]) * np.ones(4)
    model = mujoco.MjModel.from_xml_string(MODEL.format(FREE, *LEGS))
    data, q = mujoco.MjData(model), np.empty((n, 4))
    M = np.empty((model.nv, model.nv))
    Ia, fv, offset = truth(seed)

    def rate(k: int, state: Array) -> Array:
        """Rates of joints and speeds at the point k of the grid."""
        joint, speed = state
        data.qpos[:] = [*position[k], *rotation[k], *joint]
        data.qvel[:] = [*velocity[k], *turn[k], *speed]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fullM(model, data, M)
        given = np.array([*acceleration[k], *turned[k]])
        # A command is held until the next one.
        torque = KP * (q_des[k // EACH] - joint) - KD * speed - fv * speed - offset
        rest = torque - data.qfrc_bias[6:] - M[6:, :6] @ given
        return np.array([speed, np.linalg.solve(M[6:, 6:] + np.diag(Ia), rest)])

    state = np.array([q_des[0], np.zeros(4)])
    for k in range(0, n * EACH, 2):
        if k % EACH == 0:
            q[k // EACH] = state[0]
        middle = state + step * rate(k, state)
        state = state + 2.0 * step * rate(k + 1, middle)
    every = slice(None, None, EACH)
    return {
        "q": q, "q_des": q_des, "at": position[every], "rotation": rotation[every],
        "speed": velocity[every], "gyroscope": turn[every], "acceleration": acceleration[every],
    }  # fmt: skip


def truth(seed: int) -> tuple[Array, Array, Array]:
    """Armature, viscous friction and offset of the joints."""
    rng = np.random.default_rng([seed, 1])
    return rng.uniform(0.01, 0.04, 4), rng.uniform(0.05, 0.2, 4), rng.uniform(-0.3, 0.3, 4)


POSE = {"position": "at", "orientation": "rotation"}
ALL = {**POSE, "velocity": "speed", "angular_velocity": "gyroscope"}
IMU = {"orientation": "xyzw", "order": "xyzw", "angular_velocity": "gyroscope"}


def identified(
    folder: Path, base: dict[str, Any] | None, seed: int = 0, model: str = FREE, **more: Any
) -> ActuatorsResult:
    """The answer to a recording whose log describes the base."""
    file = folder / "robot.xml"
    file.write_text(MODEL.format(model, *LEGS), encoding="utf-8")
    data = dict(recording(seed))
    data["xyzw"] = np.roll(data["rotation"], -1, axis=1)
    data["xyzw"][500:900] *= -1.0  # the same rotations
    R = np.empty((len(data["q"]), 9))
    for k, q in enumerate(data["rotation"]):
        mujoco.mju_quat2Mat(R[k], q)
    felt = data["acceleration"] + [0.0, 0.0, 9.81]
    data["accelerometer"] = np.einsum("nji,nj->ni", R.reshape(-1, 3, 3), felt)
    pd = {"q_des": "q_des", "kp": KP, "kd": KD, "delay": 0.0}
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
    log = log_of(data, keys if base is None else {**keys, "base": base})
    result = sysid_bench.identify(file, task="actuators", log=log, **more)
    assert isinstance(result, ActuatorsResult)
    return result


@pytest.mark.parametrize(
    ("seed", "base"),
    [
        (0, POSE),
        (0, {**IMU, "accelerometer": "accelerometer"}),
        pytest.param(1, ALL, marks=pytest.mark.long),
        pytest.param(2, {**IMU, "acceleration": "acceleration"}, marks=pytest.mark.long),
        *(pytest.param(seed, POSE, marks=pytest.mark.long) for seed in range(3, 8)),
    ],
)
def test_exact_data_of_a_moving_base_give_its_actuators(
    tmp_path: Path, seed: int, base: dict[str, Any]
) -> None:
    result = identified(tmp_path, base, seed)
    for j, joint in enumerate(result.joints.values()):
        found = [joint[term] for term in ("Ia", "fv", "offset")]
        np.testing.assert_allclose(found, [x[j] for x in truth(seed)], rtol=0.02, atol=2e-3)
    ignored = identified(tmp_path, None, seed)
    errors, with_none = (
        np.array([one.rollout_error, one.torque_error], dtype=float) for one in (result, ignored)
    )
    assert (with_none > errors * [5.0, 20.0]).all()


def test_the_simulation_along_a_moving_base_errs_by_its_steps_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = []
    for step in (1e-3, 1.25e-4):
        monkeypatch.setattr(rollout, "STEP", step)
        errors.append(identified(tmp_path, POSE).rollout_error or np.inf)
    assert errors[1] < 0.2 * errors[0] < 5e-4


def test_a_model_with_a_held_base_moves_as_recorded(tmp_path: Path) -> None:
    free = identified(tmp_path, POSE, model_out=tmp_path / "out.xml")
    held = identified(tmp_path, POSE, model="")
    assert held.rollout_error == pytest.approx(free.rollout_error, rel=1e-6)
    assert free.written is not None
    assert free.written["gap"] < 1e-6


@pytest.mark.parametrize(
    ("base", "words"),
    [
        ({"orientation": "at"}, "write 4"),
        ({**POSE, "orientation": {"columns": "rotation", "gain": 2.0}}, "of length 1"),
        ({**POSE, "position": {"columns": "at", "unit": "deg"}}, "No unit is called 'deg'"),
        ({**IMU, "acceleration": "q", "accelerometer": "q"}, "not both"),
        ({**POSE, "velocty": "speed"}, "base.velocity"),
    ],
)
def test_bases_that_cannot_be_read_are_refused(
    tmp_path: Path, base: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        identified(tmp_path, base)


def test_other_tasks_do_not_ignore_a_moving_base(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="task actuators"):
        sysid_bench.identify(_files(tmp_path), log=tmp_path / "run.toml")


def test_a_base_in_a_file_of_its_own_is_joined_by_time(tmp_path: Path) -> None:
    model = _files(tmp_path)
    result = sysid_bench.identify(model, task="actuators", log=tmp_path / "run.toml")
    assert isinstance(result, ActuatorsResult)
    for j, joint in enumerate(result.joints.values()):
        assert joint["Ia"] == pytest.approx(truth(0)[0][j], rel=0.05)


def _files(folder: Path) -> Path:
    """A recording in two files, that of the base at another rate."""
    data, file = recording(0), folder / "robot.xml"
    file.write_text(MODEL.format(FREE, *LEGS), encoding="utf-8")
    t = np.arange(len(data["q"])) / RATE
    _csv(folder / "legs.csv", {"t": t, "q": data["q"], "c": data["q_des"]})
    pose = {name: data[name][::2] for name in ("at", "rotation")}
    _csv(folder / "base.csv", {"stamp": t[::2] + 3.0, **pose})
    (folder / "run.toml").write_text(
        'file = ["legs.csv", { file = "base.csv", offset = "-3 s", time = "stamp" }]\ntime = "t"\n'
        f"joints = {json.dumps(JOINTS)}\nq = {{ columns = {_names('q', 4)} }}\n"
        f"base = {{ position = {_names('at', 3)}, orientation = {_names('rotation', 4)} }}"
        f"\ntau = {{ pd = {{ q_des = {_names('c', 4)}, kp = {KP}, kd = {KD} }} }}\n",
        encoding="utf-8",
    )
    return file


def _names(name: str, count: int) -> str:
    return json.dumps([f"{name}{i}" for i in range(count)])


def _csv(file: Path, columns: dict[str, Array]) -> None:
    names = [
        n if x.ndim == 1 else f"{n}{i}"
        for n, x in columns.items()
        for i in range(1 if x.ndim == 1 else x.shape[1])
    ]
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, delimiter=",", header=",".join(names), comments="")
