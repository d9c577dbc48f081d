"""The proof that what was written comes back: the new text, read again beside its source."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.random.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.update import Update
from sysid_bench.spatial.inertia import mass_com_inertia
from sysid_bench.types import Array, Trajectory

PARAMETERS, TORQUES = 1e-12, 1e-11
"""Relative errors that a written model may have when it is read again."""


def check_round_trip(path: Path, text: str, update: Update) -> None:
    """Reads the written text again, in the place of the source: raises ModelError where parameters
    or torques at random states differ from what was asked for."""
    with sibling_file(path, text) as copy:
        try:
            again = load_robot(Manifest(path.stem, copy, couplings=False))
        except ModelError as error:
            raise ModelError(f"{path.name} cannot be read with its new values: {error}") from error
    robot = update.robot
    if again.body_names != robot.body_names or again.rows != robot.rows:
        raise ModelError(f"{path.name} has other bodies or joints with its new values.")
    phi = _asked(update)
    scale = np.abs(phi).max(axis=1)
    apart = np.abs(again.phi - phi).max(axis=1)
    for b in np.flatnonzero(~(apart <= PARAMETERS * scale)):
        raise ModelError(
            f"{path.name} gives the body {robot.body_names[b]!r} other parameters than were "
            f"written (by {apart[b]:.2g}): {_meddling(robot)}"
        )
    motion = random_states(robot, 10, np.random.default_rng(0))
    theirs, ours = _torque(again.mj, motion), _torque(_with(update, phi), motion)
    gap = float(np.abs(theirs - ours).max()) / (float(np.abs(ours).max()) or 1.0)
    if not gap <= TORQUES:
        raise ModelError(
            f"{path.name} moves otherwise than was written (torques differ by {gap:.2g}): "
            f"{_meddling(robot)}"
        )


@contextlib.contextmanager
def sibling_file(path: Path, text: str) -> Iterator[Path]:
    """A hidden file with this text beside the source for as long as it is read, so that included
    files and meshes are found; ModelError where that folder cannot be written."""
    try:
        with tempfile.NamedTemporaryFile(
            dir=path.resolve().parent, prefix=f".{path.stem}-", suffix=path.suffix
        ) as file:
            file.write(text.encode())
            file.flush()
            yield Path(file.name)
    except PermissionError as error:
        raise ModelError(
            f"{path.name} lies where nothing can be written, so the new text cannot be proved "
            "there; copy the model with its files to a folder of your own."
        ) from error


def _asked(update: Update) -> Array:
    """phi (nb, 10) of the whole model with the update."""
    robot = update.robot
    return np.array(
        [update.phi.get(b, own) for b, own in zip(robot.body_names, robot.phi, strict=True)]
    )


def _with(update: Update, phi: Array) -> mujoco.MjModel:
    """The source's compiled model with the new numbers put into it: no text in between."""
    robot, spec = update.robot, update.robot.spec.copy()
    for body in spec.bodies:
        body.simple = False  # else the zeros of a body's mass matrix are settled for good
    mj = spec.compile()
    for name in update.phi:
        b = robot.body_names.index(name)
        mass, com, inertia = mass_com_inertia(phi[b])
        moments, axes = np.linalg.eigh(inertia)
        mj.body_mass[b + 1], mj.body_ipos[b + 1] = mass, com
        mj.body_inertia[b + 1] = np.maximum(moments, 0.0)
        mujoco.mju_mat2Quat(mj.body_iquat[b + 1], (axes * np.linalg.det(axes)).ravel())
        mj.body_sameframe[b + 1] = 0  # else the inertial frame is taken for the body's
    for joint in robot.joints:
        for key, value in update.joints.get(joint.name, {}).items():
            _put(mj, joint.name, key, value)
    mujoco.mj_setConst(mj, mujoco.MjData(mj))
    return mj


def _put(mj: mujoco.MjModel, joint: str, key: str, value: float) -> None:
    j = mj.joint(joint).id
    dof, place = int(mj.jnt_dofadr[j]), int(mj.jnt_qposadr[j])
    if key == "springref":
        mj.qpos_spring[place] = value
        return
    array, at = (mj.jnt_stiffness, j) if key == "stiffness" else (getattr(mj, f"dof_{key}"), dof)
    array[at] = value


def _torque(mj: mujoco.MjModel, motion: Trajectory) -> Array:
    """MuJoCo's inverse dynamics (N, nv) with springs, dampers and armature, without contacts."""
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(mj)
    tau = np.empty_like(motion.v)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        # Friction is a constraint in MuJoCo; by its definition it needs none.
        tau[k] = data.qfrc_inverse + mj.dof_frictionloss * np.sign(motion.v[k])
    return tau


def written_value(robot: RobotModel) -> mujoco.MjSpec:
    """The spec of an MJCF as its file has it: the loader settles totals, bounds and polynomials."""
    if robot.format != "mjcf":
        return robot.spec
    return mujoco.MjSpec.from_file(str(robot.manifest.path))


def _meddling(robot: RobotModel) -> str:
    """Which of the compiler's options may have changed what the file states, and what to do."""
    compiler = written_value(robot).compiler
    found = [
        word
        for word, on in (
            ("settotalmass", compiler.settotalmass > 0),
            ("balanceinertia", bool(compiler.balanceinertia)),
            ("boundmass", compiler.boundmass > 0),
            ("boundinertia", compiler.boundinertia > 0),
        )
        if on
    ]
    advice = [f"take {', '.join(found)} out of its <compiler>"] if found else []
    if int(compiler.inertiafromgeom) == int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE):
        # Without it every other <inertial> of the file counts again: the writer cannot decide that.
        advice.append('set inertiafromgeom="auto" in its <compiler>, so that an <inertial> counts')
    if advice:
        return f"its <compiler> overrules what is written; {', and '.join(advice)}."
    return "something in the file overrules what is written."
