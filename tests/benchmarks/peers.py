"""Other ways to the same regressor, each as its users would write it.

A peer that is not there skips with its reason: `pip install cmeel-eigen idyntree` and a C++
compiler bring most of them.
"""

import ctypes
import hashlib
import shutil
import subprocess
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.plant import contact_free
from sysid_bench.types import Array, Trajectory

Run = Callable[[], Any]

SOURCE: Final = Path(__file__).parent / "pinocchio_loop.cpp"
KINDS: Final = {
    "RX": 0,
    "RY": 1,
    "RZ": 2,
    "RevoluteUnaligned": 3,
    "PX": 4,
    "PY": 5,
    "PZ": 6,
    "PrismaticUnaligned": 7,
    "FreeFlyer": 8,
}


def own_columns(robot: RobotModel) -> tuple[str, ...]:
    """Ten columns of each body that has joints: what the peers compute, too."""
    moving = {robot.body_names[link.body] for link in robot.tree.links}
    return tuple(c for c in robot.inertial_columns if c.rpartition(".")[0] in moving)


def quickest_model(robot: RobotModel) -> pin.Model:
    """Pinocchio's model of the robot: its own parser's, whose joints about x, y and z are quicker,
    where that has the same coordinates."""
    if robot.format == "urdf":
        root = [pin.JointModelFreeFlyer()] if robot.floating else []
        parsed = pin.buildModelFromXML(robot.text.decode(), *root)
        if (parsed.nq, parsed.nv) == (robot.tree.nq, robot.nv):
            return parsed
    return robot.pairing.model


def in_pinocchios_coordinates(robot: RobotModel, motion: Trajectory) -> tuple[Array, Array, Array]:
    q = robot.pairing.positions_to_pinocchio(motion.q)
    v, a = robot.pairing.rates(motion.q, motion.v, motion.a)
    return tuple(np.ascontiguousarray(x) for x in (q, v, a))  # type: ignore[return-value]


# --- Pinocchio -----------------------------------------------------------------------------------


def pinocchio_in_python(robot: RobotModel, motion: Trajectory) -> Run:
    """`computeJointTorqueRegressor` sample by sample into one array."""
    model = quickest_model(robot)
    data = model.createData()
    q, v, a = in_pinocchios_coordinates(robot, motion)
    Y = np.empty((len(motion), model.nv, 10 * (model.njoints - 1)))

    def run() -> Array:
        for k in range(len(q)):
            Y[k] = pin.computeJointTorqueRegressor(model, data, q[k], v[k], a[k])
        return Y

    return run


def pinocchio_in_cpp(robot: RobotModel, motion: Trajectory, folder: Path) -> Run:
    """The same in C++, optimised for this machine."""
    library = ctypes.CDLL(str(_compiled_loop(folder)))
    library.loop_make.restype = ctypes.c_void_p
    model = quickest_model(robot)
    handle = library.loop_make(ctypes.c_int64(model.njoints - 1), *_flat(model))
    q, v, a = in_pinocchios_coordinates(robot, motion)
    Y = np.empty((len(motion), model.nv, 10 * (model.njoints - 1)))
    where = [ctypes.c_void_p(x.ctypes.data) for x in (q, v, a, Y)]

    def run() -> Array:
        library.loop_run(ctypes.c_void_p(handle), ctypes.c_int64(len(q)), *where)
        return Y

    run.keeps = (q, v, a)  # type: ignore[attr-defined]
    return run


_KEPT: list[Array] = []


def _flat(model: pin.Model) -> list[ctypes.c_void_p]:
    joints = range(1, model.njoints)
    names = [model.joints[i].shortname().removeprefix("JointModel") for i in joints]
    unknown = sorted(set(names) - set(KINDS))
    if unknown:
        pytest.skip(f"the C++ loop has no joints {', '.join(unknown)}")
    axes = [
        model.joints[i].extract().axis if name.endswith("Unaligned") else np.zeros(3)
        for i, name in zip(joints, names, strict=True)
    ]
    at = [model.jointPlacements[i] for i in joints]
    arrays = [
        np.array([KINDS[name] for name in names], dtype=np.int64),
        np.array([model.parents[i] for i in joints], dtype=np.int64),
        np.array(axes, dtype=float),
        np.array([np.r_[M.rotation.ravel(), M.translation] for M in at]),
        np.array(model.gravity.linear),
    ]
    _KEPT.extend(arrays)
    return [ctypes.c_void_p(x.ctypes.data) for x in arrays]


def _compiled_loop(folder: Path) -> Path:
    """The library, compiled once per source and version of Pinocchio (about a minute)."""
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        pytest.skip("Pinocchio in C++ needs a C++ compiler")
    include = Path(pin.__file__).parents[4] / "include"
    if not (include / "eigen3").is_dir():
        pytest.skip("Pinocchio in C++ needs Eigen: pip install cmeel-eigen")
    name = hashlib.sha256(SOURCE.read_bytes() + pin.__version__.encode()).hexdigest()[:16]
    library = folder / f"pinocchio_loop_{name}.so"
    if not library.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        unfinished = library.with_suffix(".part")
        flags = ["-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-w", "-shared", "-fPIC"]
        # What Pinocchio's own build defines for Boost.
        flags += ["-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"]
        flags += ["-DBOOST_FUSION_INVOKE_MAX_ARITY=10", f"-I{include}", f"-I{include / 'eigen3'}"]
        done = subprocess.run(
            [compiler, *flags, str(SOURCE), "-o", str(unfinished)], text=True, capture_output=True
        )
        if done.returncode != 0:
            first = next((x for x in done.stderr.splitlines() if "error" in x), done.stderr[:200])
            pytest.skip(f"Pinocchio in C++ does not compile here: {first[:300]}")
        unfinished.rename(library)
    return library


# --- Others --------------------------------------------------------------------------------------


def per_sample_mujoco(robot: RobotModel, motion: Trajectory) -> Run:
    """Sample by sample in Python from MuJoCo's velocities, accelerations and Jacobians of bodies,
    Y = sum of J' A: the way of mujoco-sysid and of most scripts."""
    mj = contact_free(robot.spec.copy().compile())
    data = mujoco.MjData(mj)
    bodies = [link.body + 1 for link in robot.tree.links]
    Y = np.zeros((len(motion), mj.nv, 10 * len(bodies)))
    kind = mujoco.mjtObj.mjOBJ_XBODY

    def run() -> Array:
        for k in range(len(motion)):
            data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
            mujoco.mj_inverse(mj, data)
            mujoco.mj_rnePostConstraint(mj, data)
            for place, body in enumerate(bodies):
                twist, rate, J = np.zeros(6), np.zeros(6), np.zeros((6, mj.nv))
                mujoco.mj_objectVelocity(mj, data, kind, body, twist, 1)
                mujoco.mj_objectAcceleration(mj, data, kind, body, rate, 1)
                mujoco.mj_jacBody(mj, data, J[3:], J[:3], body)
                R = data.xmat[body].reshape(3, 3)
                local = np.vstack([R.T @ J[:3], R.T @ J[3:]])
                A = _body_regressor(twist[:3], rate[:3], rate[3:])
                Y[k, :, 10 * place : 10 * place + 10] = local.T @ A
        return Y

    return run


def _body_regressor(w: Array, alpha: Array, d: Array) -> Array:
    """A (6, 10) of one body, the textbook's blocks (Atkeson, An, Hollerbach 1986)."""

    def skew(x: Array) -> Array:
        return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])

    def dot(x: Array) -> Array:
        return np.array(
            [[x[0], x[1], x[2], 0, 0, 0], [0, x[0], 0, x[1], x[2], 0], [0, 0, x[0], 0, x[1], x[2]]]
        )

    A = np.zeros((6, 10))
    A[:3, 1:4] = -skew(d)
    A[:3, 4:] = dot(alpha) + skew(w) @ dot(w)
    A[3:, 0] = d
    A[3:, 1:4] = skew(alpha) + skew(w) @ skew(w)
    return A


def idyntree(robot: RobotModel, motion: Trajectory) -> Run:
    """iDynTree from Python, sample by sample."""
    idt = _imported("idyntree.swig")
    loader, kinematics = idt.ModelLoader(), idt.KinDynComputations()
    names = [joint.name for joint in robot.joints if joint.kind != "free"]
    loader.loadReducedModelFromString(robot.text.decode(), idt.StringVector(names), "urdf")
    model = loader.model()
    kinematics.loadRobotModel(model)
    base = 6 if robot.floating else 0
    skip = 7 if robot.floating else 0
    Y = idt.MatrixDynSize(6 + len(names), 10 * model.getNrOfLinks())
    gravity, still = np.array(robot.tree.gravity), np.zeros(6)
    every = np.empty((len(motion), 6 + len(names), 10 * model.getNrOfLinks()))

    def run() -> Any:
        for k in range(len(motion)):
            kinematics.setRobotState(motion.q[k, skip:], motion.v[k, base:], gravity)
            kinematics.inverseDynamicsInertialParametersRegressor(still, motion.a[k, base:], Y)
            every[k] = Y.toNumPy()
        return every

    return run


def figaroh(robot: RobotModel, motion: Trajectory) -> Run:
    """figaroh's basic regressor of joint torques; fixed base, one joint per body."""
    tools = _imported("figaroh.tools.regressor")
    model = quickest_model(robot)
    q, v, a = in_pinocchios_coordinates(robot, motion)
    seen = SimpleNamespace(model=model, data=model.createData())
    wanted = {"is_joint_torques": True, "is_external_wrench": False}
    wanted["act_idxv"] = list(range(model.nv))  # type: ignore[assignment]
    return lambda: tools.build_regressor_basic(seen, q, v, a, wanted)


def _imported(module: str) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a warning that becomes an error crashes SWIG's modules
        try:
            return import_module(module)
        except Exception as error:  # a broken peer must not end the run
            pytest.skip(f"{module.partition('.')[0]} cannot be imported: {error}")
