"""Exported files rolled out by a program of its own, which shares no code with the package."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult

STEPS = {200.0: 5, 50.0: 20}
"""Steps of 1 ms in a sample."""


def rolled_out(file: Path, data: dict[str, Any], rate: float, first: int, end: int) -> float:
    """RMS position error (rad) of a file under commands: contacts and limits off, held commands,
    and the delay of the file, whose buffer holds the commands before."""
    model = mujoco.MjModel.from_xml_path(str(file))
    model.opt.timestep = 1.0 / (rate * STEPS[rate])
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    simulated = mujoco.MjData(model)
    q, v, q_des = data["q"], data["v"], data["q_des"]
    drives = {model.joint(model.actuator(i).trnid[0]).name: i for i in range(model.nu)}
    at = [model.joint(name).qposadr[0] for name in data["joints"]]
    motors = [drives[name] for name in data["joints"]]
    simulated.qpos[at] = q[first]
    simulated.qvel[[model.joint(name).dofadr[0] for name in data["joints"]]] = v[first]
    for j, motor in enumerate(motors):
        if past := int(model.actuator_history[motor, 0]):
            ago = np.arange(-past, 0)
            samples = np.maximum(first + ago // STEPS[rate], 0)
            values = np.ascontiguousarray(q_des[samples, j])
            mujoco.mj_initCtrlHistory(model, simulated, motor, ago * model.opt.timestep, values)
    squares = []
    for k in range(first, end):
        squares.append((simulated.qpos[at] - q[k]) ** 2)
        simulated.ctrl[motors] = q_des[k]
        mujoco.mj_step(model, simulated, STEPS[rate])
    return float(np.sqrt(np.mean(squares)))


def exported(model: Path, log: Path, target: Path, also: list[str]) -> ActuatorsResult:
    result = sysid_bench.identify(
        model, task="actuators", log=log, also=also, model_out=target, accept=["worse", "velocity"]
    )
    assert isinstance(result, ActuatorsResult)
    return result


def check_attributes(before: Path, after: Path, joints: list[str]) -> None:
    """Armature, damping and limits of torque are positive where they were."""
    own, written = (mujoco.MjModel.from_xml_path(str(file)) for file in (before, after))
    for name in joints:
        old, new = own.joint(name).dofadr[0], written.joint(name).dofadr[0]
        for field in ("dof_armature", "dof_damping"):
            if np.any(getattr(own, field)[old] > 0.0):
                assert np.all(getattr(written, field)[new] > 0.0), (name, field)
        drives = []
        for m in (own, written):
            every = map(m.actuator, range(m.nu))
            drives.append([x for x in every if m.joint(x.trnid[0]).name == name])
        assert len(drives[1]) == 1
        if drives[0] and drives[0][0].forcelimited[0]:
            assert drives[1][0].forcelimited[0]
            assert np.ptp(drives[1][0].forcerange) == pytest.approx(np.ptp(drives[0][0].forcerange))


@pytest.mark.data
@pytest.mark.parametrize(
    ("robot", "run"),
    [("go2", 0), *(pytest.param(*x, marks=pytest.mark.long) for x in (("go2", 4), ("aliengo", 0)))],
)
def test_an_exported_leg_errs_as_is_printed(
    data_folder: Path, tmp_path: Path, robot: str, run: int
) -> None:
    folder = data_folder / robot
    with np.load(folder / f"run_{run}.npz") as found:
        data = {name: found[name].astype(float) for name in ("q", "v", "q_des")}
        data |= {name: found[name].tolist() for name in ("joints", "kp", "kd")}
    log = tmp_path / "run.toml"
    log.write_text(
        f'file = {json.dumps(str(folder / f"run_{run}.npz"))}\nrate = "200 Hz"\n'
        f'joints = {json.dumps(data["joints"])}\nq = {{ columns = "q" }}\nv = {{ columns = "v" }}\n'
        f'tau = {{ pd = {{ q_des = "q_des", kp = {data["kp"]}, kd = {data["kd"]}, '
        'delay = "profile" } }\n',
        encoding="utf-8",
    )
    target = tmp_path / "out.xml"
    result = exported(folder / f"{robot}.xml", log, target, [])
    first, count = int(0.6 * len(data["q"])), len(data["q"])
    error = rolled_out(target, data, 200.0, first, count - 60)
    assert error == pytest.approx(result.rollout_error, rel=0.05)
    check_attributes(folder / f"{robot}.xml", target, data["joints"])


@pytest.mark.data
@pytest.mark.long
@pytest.mark.parametrize("motion", ["multisine", "large_amplitude", "friction_gravity"])
def test_an_exported_servo_arm_errs_as_is_printed(
    data_folder: Path, tmp_path: Path, motion: str
) -> None:
    model = data_folder / "robots" / "robotstudio_so101__so101.xml"
    log, tables = tmp_path / "arm.toml", []
    files = [data_folder / "so101_sage" / motion / f"{x}.csv" for x in ("state_motor", "control")]
    for file in files:
        rows = [line.split(",", 2) for line in file.read_text(encoding="utf-8").splitlines()[1:]]
        stamps = np.array([float(row[1]) for row in rows]) * 1e-6
        tables.append((stamps, np.array([json.loads(row[2].split('"')[1]) for row in rows])))
    sysid_bench.init_log(files, model, log)
    lines = [x for x in log.read_text(encoding="utf-8").splitlines() if not x.startswith("v = ")]
    log.write_text("\n".join(lines), encoding="utf-8")
    result = exported(model, log, tmp_path / "out.xml", ["gain"])
    # Of a program that takes 50 Hz for granted, on a grid of its own.
    (t, q), (t_des, q_des) = tables
    grid = np.arange(t[0], t[-1], 0.02)
    held = np.maximum(np.searchsorted(t_des, grid, side="right") - 1, 0)
    data: dict[str, Any] = {
        "q": np.stack([np.interp(grid, t, x) for x in q.T], axis=1),
        "q_des": q_des[held],
        "joints": result.rows,
    }
    data["v"] = np.gradient(data["q"], 0.02, axis=0)
    first, end = (round(result.judged[0][x] / 0.02) for x in ("from", "to"))
    error = rolled_out(tmp_path / "out.xml", data, 50.0, first, min(end, len(grid)))
    assert error == pytest.approx(result.rollout_error, rel=0.05)
    check_attributes(model, tmp_path / "out.xml", list(result.rows))
