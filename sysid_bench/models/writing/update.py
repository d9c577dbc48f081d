"""Checked updates of a model: unidentified parameters and impossible bodies are refused by name.

A model file carries no verdicts, so that its readers would rely on every number in it.
"""

import contextlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, UsageError, first_names, unknown_name
from sysid_bench.models.load import ALIGNED, SAME, load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.xml_text import Edit, Element, edit_text, element_tree
from sysid_bench.models.xml_file import read_file
from sysid_bench.spatial import body_mass_inertia, feasible_margins, inertia_matrix, phi_of
from sysid_bench.types import Array, Trajectory

JOINT_KEYS: Final = ("damping", "frictionloss", "armature", "stiffness", "springref")
"""Joint terms in MuJoCo's words: N m s/rad, N m, kg m^2, N m/rad, rad (or N s/m, N, kg, N/m, m)."""

POSSIBLE: Final = 1e-12
"""Share of the largest number of a body; rounding may take a pseudo-inertia this far below zero."""

BodyValue = Array | Sequence[Any]
Bodies = Mapping[str, BodyValue]
Joints = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, eq=False)
class Update:
    """A model and its new values: `phi` (10,) by body name, terms by joint name."""

    robot: RobotModel
    phi: dict[str, Array]
    joints: dict[str, dict[str, float]]


def update_of(
    path: Path, bodies: Bodies, joints: Joints, verdicts: Mapping[str, str] | None
) -> Update:
    """Return the checked update of a model file; raises UsageError for unknown names and invalid
    numbers, ModelError for impossible bodies and parameters that were not identified.

    A body is phi (10,) or (m, com (3,), inertia about it (3, 3) or six numbers).
    """
    verdicts = verdicts or {}
    unidentified = [name for name, verdict in verdicts.items() if verdict != "identifiable"]
    if unidentified:
        raise ModelError(
            f"Not written: {len(unidentified)} of {len(verdicts)} parameters were not identified: "
            f"{first_names(unidentified)}. Use a task that identifies them (link: all joint "
            "torques), or --complete entropic, which takes what the data do not determine from the "
            "bodies nearest to the prior."
        )
    robot = load_robot(Manifest(path.stem, path, couplings=False))
    scalar = [joint.name for joint in robot.joints if joint.kind in ("hinge", "slide")]
    for kind, wanted, known in (("body", bodies, robot.body_names), ("joint", joints, scalar)):
        for name in wanted:
            if name not in known:
                raise unknown_name(kind, name, known, f"({path.name})")
    phi = {name: _phi(name, value) for name, value in bodies.items()}
    terms = {name: _terms(name, values) for name, values in joints.items()}
    _check_possible(phi)
    return Update(robot, phi, terms)


def _check_possible(phi: Mapping[str, Array]) -> None:
    impossible = []
    for name, values in phi.items():
        smallest = float(feasible_margins(values))
        # Negated, so that NaN is refused as well.
        if not smallest >= -POSSIBLE * float(np.abs(values).max()):
            impossible.append(f"{name} (m = {values[0]:.4g} kg, {smallest:.2g})")
    if impossible:
        raise ModelError(
            f"Not written: no body can have the parameters of {', '.join(impossible)}; the "
            "pseudo-inertia must be positive semidefinite: use an estimator with that constraint."
        )


def _phi(name: str, value: BodyValue) -> Array:
    try:
        if len(value) == 3:
            mass, com, inertia = value
            centre, moments = np.asarray(com, dtype=float), np.asarray(inertia, dtype=float)
            moments = inertia_matrix(moments) if moments.shape == (6,) else moments
            fits = centre.shape == (3,) and moments.shape == (3, 3)
            phi = phi_of(float(mass), centre, moments) if fits else np.zeros(0)
        else:
            phi = np.array(value, dtype=float)
    except (TypeError, ValueError):  # texts, and lists of unequal length
        phi = np.zeros(0)
    if phi.shape != (10,) or not np.isfinite(phi).all():
        raise UsageError(
            f"The body {name!r} cannot have {value!r}; it needs ten finite numbers "
            "m hx hy hz Ixx Ixy Ixz Iyy Iyz Izz, or (m, com, inertia about it as six numbers or "
            "(3, 3))."
        )
    return phi


def _terms(name: str, values: Mapping[str, float]) -> dict[str, float]:
    for key, value in values.items():
        if key not in JOINT_KEYS:
            raise unknown_name("term of a joint in a file", key, JOINT_KEYS)
        if not np.isfinite(value):
            raise UsageError(f"{key} of the joint {name!r} is {value!r}; it must be finite.")
        if value < 0 and key != "springref":  # the other terms would supply energy
            raise ModelError(
                f"Not written: {key} of the joint {name!r} is {value:.4g}; it must not be negative."
            )
    return {key: float(value) for key, value in values.items()}


PARAMETERS, TORQUES = 1e-12, 1e-11
"""Largest relative errors of a written model when it is read again."""

SAME_FRAME: Final = 1e-6
"""m, rad: inertial frames nearer to that of their body MuJoCo takes for it."""


def check_written(path: Path, text: str, update: Update) -> None:
    """Read the written text in the folder of the source; raises ModelError where parameters or
    torques at random states differ from those requested."""
    with _sibling_file(path, text) as copy:
        try:
            again = load_robot(Manifest(path.stem, copy, couplings=False))
        except ModelError as error:
            raise ModelError(f"{path.name} cannot be read with its new values: {error}") from error
    robot = update.robot
    if again.body_names != robot.body_names or again.rows != robot.rows:
        raise ModelError(f"{path.name} has different bodies or joints with its new values.")
    phi = _requested_phi(update, again.mj)
    apart = np.abs(again.phi - phi).max(axis=1)
    for b in np.flatnonzero(~(apart <= PARAMETERS * np.abs(phi).max(axis=1))):  # NaN, too
        raise ModelError(
            f"{path.name} gives the body {robot.body_names[b]!r} different parameters from those "
            f"written (by {apart[b]:.2g}): {_compiler_advice(robot)}"
        )
    # Torques of the text against those of the source with its arrays changed in memory: two ways to
    # the same model, one of them without any text.
    motion = random_states(robot, 10, np.random.default_rng(0))
    theirs, ours = torque_of(again.mj, motion), torque_of(updated_model(update, phi), motion)
    gap = float(np.abs(theirs - ours).max()) / (float(np.abs(ours).max()) or 1.0)
    if not gap <= TORQUES:  # true for NaN, too
        raise ModelError(
            f"{path.name} has different torques from those written (by {gap:.2g}): "
            f"{_compiler_advice(robot)}"
        )


@contextlib.contextmanager
def _sibling_file(path: Path, text: str) -> Iterator[Path]:
    """A temporary hidden file with this text in the folder of the source, so that included files
    and meshes are found. Raises ModelError where that folder is not writable."""
    try:
        file = tempfile.NamedTemporaryFile(  # noqa: SIM115 - Windows opens no file twice
            dir=path.resolve().parent, prefix=f".{path.stem}-", suffix=path.suffix, delete=False
        )
        try:
            with file:
                file.write(text.encode())
            yield Path(file.name)
        finally:
            Path(file.name).unlink(missing_ok=True)
    except PermissionError as error:
        raise ModelError(
            f"The folder of {path.name} is not writable, so the new text cannot be checked "
            "there; copy the model with its files to a folder of your own."
        ) from error


def _requested_phi(update: Update, read: mujoco.MjModel) -> Array:
    """phi (nb, 10) of all bodies with the update, as MuJoCo moves those that it has read: one whose
    inertial frame is within SAME_FRAME of the body's gets the frame of the body."""
    requested = np.array(update.robot.phi)
    for b, name in enumerate(update.robot.body_names):
        mark = int(read.body_sameframe[b + 1])  # MuJoCo counts the world as body 0
        if name not in update.phi:
            continue
        requested[b] = update.phi[name]
        if mark in ALIGNED:
            mass, com, inertia = body_mass_inertia(update.phi[name])
            principal = np.diag(np.diag(inertia))
            if np.abs(inertia - principal).max() <= SAME_FRAME * np.trace(inertia):
                inertia = principal
            if mark == SAME and np.abs(com).max() <= SAME_FRAME:
                com = np.zeros(3)
            requested[b] = phi_of(mass, com, inertia)
    return requested


def updated_model(update: Update, phi: Array) -> mujoco.MjModel:
    """The compiled source with the new numbers written into its arrays, without any text."""
    robot, spec = update.robot, update.robot.spec.copy()
    for body in spec.bodies:
        body.simple = False  # else the compiler fixes zeros of the mass matrix for good
    mj = spec.compile()
    for name in update.phi:
        b = robot.body_names.index(name) + 1  # MuJoCo counts the world as body 0
        mass, com, inertia = body_mass_inertia(phi[b - 1])
        moments, axes = np.linalg.eigh(inertia)
        mj.body_mass[b], mj.body_ipos[b] = mass, com
        mj.body_inertia[b] = np.maximum(moments, 0.0)
        # det = -1 of a reflection: the opposite axes are a rotation, with the same inertia.
        mujoco.mju_mat2Quat(mj.body_iquat[b], (axes * np.linalg.det(axes)).ravel())
        mj.body_sameframe[b] = 0  # else MuJoCo takes the inertial frame for the body frame
    for joint in robot.joints:
        j = mj.joint(joint.name).id
        # Arrays of MuJoCo count joints, coordinates or degrees of freedom.
        index = {"stiffness": j, "springref": int(mj.jnt_qposadr[j])}
        arrays = {"stiffness": mj.jnt_stiffness, "springref": mj.qpos_spring}
        for key, value in update.joints.get(joint.name, {}).items():
            array = arrays[key] if key in arrays else getattr(mj, f"dof_{key}")
            array[index.get(key, int(mj.jnt_dofadr[j]))] = value
    # Constants such as the inertia at the reference follow from the new arrays.
    mujoco.mj_setConst(mj, mujoco.MjData(mj))
    return mj


def torque_of(mj: mujoco.MjModel, motion: Trajectory) -> Array:
    """MuJoCo's inverse dynamics (N, nv) with springs, dampers and armature, without contacts."""
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(mj)
    tau = np.empty_like(motion.v)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        # MuJoCo makes dry friction a constraint; its definition is explicit in sign(v).
        tau[k] = data.qfrc_inverse + mj.dof_frictionloss * np.sign(motion.v[k])
    return tau


def file_spec(robot: RobotModel) -> mujoco.MjSpec:
    """Return the spec of an MJCF as in its file: the loader resolves totals, bounds and
    polynomials."""
    if robot.format != "mjcf":
        return robot.spec
    return mujoco.MjSpec.from_file(str(robot.manifest.path))


def _compiler_advice(robot: RobotModel) -> str:
    """Compiler options that may have changed the values of the file, and the remedy."""
    compiler = file_spec(robot).compiler
    # Options that change masses and inertias of the text; negative and zero bounds do nothing.
    options = ("settotalmass", "balanceinertia", "boundmass", "boundinertia")
    found = [option for option in options if getattr(compiler, option) > 0]
    advice = [f"take {', '.join(found)} out of its <compiler>"] if found else []
    if int(compiler.inertiafromgeom) == int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE):
        # Only the user can decide this: without it all other <inertial> elements count again.
        advice.append('set inertiafromgeom="auto" in its <compiler>, so that an <inertial> counts')
    if advice:
        return f"its <compiler> overrides the written values; {', and '.join(advice)}."
    return "something in the file overrides the written values."


FORMATS: Final = {"mujoco": "an MJCF", "robot": "a URDF"}
Edits = Callable[[bytes, Element, Update], Iterable[Edit]]


def update_text(
    path: Path | str,
    bodies: Bodies,
    joints: Joints | None,
    verdicts: Mapping[str, str] | None,
    tag: str,
    edits: Edits,
) -> str:
    """Return the text of a file whose root is <tag>, changed by `edits(data, root, update)` and
    checked by reading it again.

    Raises ModelError for values that must not be written, and for a file of another format.
    """
    path = Path(path)
    update = update_of(path, bodies, joints or {}, verdicts)
    data = read_file(path)
    root = element_tree(data, path.name)
    if root.tag != tag:
        raise ModelError(
            f"{path.name} is not {FORMATS[tag]}: its root element is <{root.tag}>, not <{tag}>."
        )
    text = edit_text(data, edits(data, root, update))
    check_written(path, text, update)
    return text
