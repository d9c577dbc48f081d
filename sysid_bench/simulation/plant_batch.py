"""Many plants of one robot at once: the steps of lanes.c, a plant in each lane of a register.

The plants share the compiled model's tree, motors, integrator and step; inertias, joint terms,
numbers of force laws and inputs are their own. Written from the equations of motion, without
MuJoCo, which simulates what is not covered; `uncovered` says why."""

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.instruction_sets import LEVELS, levelled_library
from sysid_bench.models.tree import BALL, FREE, Tree, TreeJoint
from sysid_bench.simulation.compiled_steps import INPUTS, KINDS, SIGNALS, Signals, torque_range
from sysid_bench.simulation.elastic_drives import Drive
from sysid_bench.simulation.plant import Plant, set_inertia, start_states
from sysid_bench.spatial import inertia_transform
from sysid_bench.types import Array

SOURCE: Final = Path(__file__).with_name("lanes.c")

EXPLICIT, DAMPERS, ALL_DAMPERS = range(3)
"""Rates that an integrator takes at the end of a step: none, those of dampers of joints, or of
these and of the feedback of motors; the codes of lanes.c."""

MOST_PIECES: Final = 50
"""Pieces of friction that sticks which a step may try; far above what was met: 12."""

_DISABLED: Final = ("SPRING", "DAMPER", "FRICTIONLOSS", "CONSTRAINT", "ACTUATION", "REFSAFE")
"""Parts of a step that a model may switch off, and lanes.c does not."""


@cache
def lanes_library() -> Any:
    """Return the compiled steps and their instruction set; or the reason, as text, why there are
    none."""
    try:
        return levelled_library(SOURCE, "liblanes", "lanes_source")
    except OSError as error:
        return str(error)


def uncovered(plant: Plant, mj: mujoco.MjModel, integrator: int | None = None) -> str:
    """Return the reason why lanes.c does not simulate a plant with its compiled model and the
    integrator of that, or another; empty where it does."""
    robot, library = plant.robot, lanes_library()
    integrator = int(mj.opt.integrator) if integrator is None else integrator
    if isinstance(library, str):
        return library
    kinds, bits = mujoco.mjtIntegrator, mujoco.mjtDisableBit
    explicit, implicit = (
        integrator == int(x) for x in (kinds.mjINT_EULER, kinds.mjINT_IMPLICITFAST)
    )
    parents = {link.parent for link in robot.tree.links}
    free_bodies = [
        link
        for i, link in enumerate(robot.tree.links)
        if link.joints[0].kind == FREE and len(link.joints) == 1 and i not in parents
    ]
    springs = np.isin(mj.jnt_type, (FREE, BALL)) & (mj.jnt_stiffness != 0)
    off = [x for x in _DISABLED if mj.opt.disableflags & int(getattr(bits, f"mjDSBL_{x}"))]
    strange = [law for law in plant.laws if getattr(law, "kind", None) not in KINDS]
    reasons = (
        (robot.coupling is not None, "the robot has coupled joints"),
        (not explicit and not implicit, "the integrator is not euler, nor implicitfast"),
        (springs.any(), "a ball or free joint has a spring"),
        (off, f"the model switches off {', '.join(off).lower()}"),
        (mj.nplugin > 0, "the model has plug-ins of MuJoCo"),
        (mj.opt.noslip_iterations > 0, "the model's solver takes steps against slip"),
        # MuJoCo takes their gyroscopic forces at the end of the step.
        (implicit and free_bodies, "implicitfast moves a free body without joints"),
        (strange, "a force law is that of a plug-in"),
        (plant.laws and mj.nq != mj.nv, "force laws act beside ball or free joints"),
    )
    return next((reason for holds, reason in reasons if holds), "")


@dataclass(frozen=True, eq=False)
class PlantBatch:
    """Plants (K) of one robot with force laws of the same kinds, the compiled model `mj` of the
    first, its motors, sample times t (N,), inputs (N, nu) of all or (K, N, nu), starts q (K, nq)
    and v (K, nv), and `each` steps per sample."""

    mj: mujoco.MjModel
    plants: Sequence[Plant]
    drive: Drive
    t: Array
    control: Array
    q: Array
    v: Array
    each: int

    def run(self) -> Signals:
        """Return the signals of all plants, (K, N, ...) each; those of a plant that diverges are
        not finite."""
        dll, level = lanes_library()
        suffix, mj, tree = LEVELS[level], self.mj, self._tree
        K, N, nu = len(self.plants), len(self.t), len(self.drive.dofs)
        motors = nu if self.drive.transmission is not None else 0
        signals = Signals.of_size(N, mj, motors, K)
        lanes, work = (getattr(dll, f"{name}_{suffix}") for name in ("lanes", "work"))
        lanes.restype = work.restype = ctypes.c_int64
        numbers = _in_lanes(self._numbers(), lanes())
        starts = [np.ascontiguousarray(x, float) for x in (self.q, self.v)]
        states = np.zeros(0)
        if tree.arrays["law_states"].any():
            states = np.array(
                [np.concatenate(start_states(plant.laws, q[: mj.nv], v).states)
                 for plant, q, v in zip(self.plants, *starts, strict=True)]
            )  # fmt: skip
        inputs, reference = np.ascontiguousarray(self.control, float), np.array(mj.qpos0)
        arrays = (numbers, reference, *starts, states, inputs)
        call = _Call(
            plants=K, samples=N, each=self.each, own_inputs=inputs.ndim == 3,
            h=mj.opt.timestep, time=float(self.t[0]),
            **{name: x.ctypes.data for name, x in zip(_CALL, arrays, strict=True)},
        )  # fmt: skip
        record = _Record(*(x.ctypes.data for x in vars(signals).values()))
        memory = np.empty(work(ctypes.byref(tree)), dtype=np.uint8)
        run = getattr(dll, f"run_{suffix}")
        run.restype = None
        run(ctypes.byref(tree), ctypes.byref(call), ctypes.byref(record),
            ctypes.c_void_p(memory.ctypes.data))  # fmt: skip
        return signals

    @cached_property
    def _tree(self) -> "_Tree":
        """C struct of the tree, motors and options that all plants share."""
        mj, drive, laws = self.mj, self.drive, self.plants[0].laws
        implicit = mj.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        damps = not mj.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        at_end = ALL_DAMPERS if implicit else DAMPERS if damps else EXPLICIT
        elastic = drive.transmission is not None
        # As `damping_at_end`: of an implicit integrator, and not of elastic joints.
        records_end = implicit and not elastic
        rates, shares = _stick(mj)
        states = start_states(laws, np.zeros(mj.nv), np.zeros(mj.nv)).states
        whole = {
            "motor": drive.dofs,
            "motor_place": mj.jnt_qposadr[mj.dof_jntid[drive.dofs]],
            "law_kind": [KINDS[law.kind] for law in laws],
            "law_numbers": [np.size(law.numbers) for law in laws],
            "law_states": [len(state) for state in states],
        }
        loaded = any(law.kind in ("friction", "periodic") for law in laws)
        # At the reference of MuJoCo's springs, by degree of freedom
        springs = mj.qpos_spring[mj.jnt_qposadr[mj.dof_jntid]]
        return tree_in_c(
            self.plants[0].robot.tree, springs, whole, {"stick_rate": rates, "stick_share": shares},
            nu=len(drive.dofs), laws=len(laws), input=INPUTS[drive.input], elastic=elastic,
            at_end=at_end, records_end=records_end, most_pieces=MOST_PIECES,
            needs_start=at_end != EXPLICIT and (loaded or not records_end),
        )  # fmt: skip

    def _numbers(self) -> Array:
        """Numbers of each plant (K, ...) in the order of lanes.c."""
        mj, drive, K = self.mj, self.drive, len(self.plants)
        frames, robot = frames_of(self.plants[0].robot.tree), self.plants[0].robot
        phi = np.array([robot.phi if x.phi is None else x.phi for x in self.plants])
        # Plant by plant: BLAS rounds a product of matrices otherwise than one row of it.
        X = frames.X.reshape(-1, phi[0].size)
        inertia = np.array([X @ one.ravel() for one in phi])
        stiffness = np.array(mj.jnt_stiffness[mj.dof_jntid])
        own = [mj.dof_armature, mj.dof_damping, mj.dof_frictionloss, stiffness]
        terms = [np.tile(x, (K, 1)) for x in (*own, np.zeros(mj.nv))]
        scalar = robot.scalar_dofs
        names = ("armature", "viscous", "coulomb", "spring", "offset")
        for k, plant in enumerate(self.plants):
            terms[-1][k] = plant.terms.offset
            # Else the compiled model keeps the terms of the file, as in `Plant.compiled`.
            if plant.phi is not None or plant.terms is not robot.joint_terms:
                for name, values in zip(names[:-1], terms, strict=False):
                    values[k, scalar] = getattr(plant.terms, name)[scalar]
        terms[:3] = [np.maximum(x, 0.0) for x in terms[:3]]  # as `_not_negative`
        motors = [drive.kp, drive.kd, drive.limit, *torque_range(mj, drive)]
        if drive.transmission is not None:
            x = drive.transmission
            motors += [x.stiffness, x.damping, x.gap, x.inertia]
        shared = np.tile(np.concatenate([np.zeros(0), *motors]), (K, 1))
        laws = [np.concatenate([np.zeros(0), *(np.ravel(law.numbers) for law in plant.laws)])
                for plant in self.plants]  # fmt: skip
        return np.hstack([inertia, *terms, shared, np.array(laws)])


def _stick(mj: mujoco.MjModel) -> tuple[Array, Array]:
    """Rate (1/s) at which friction loss pulls a velocity to zero, and its softness as a share of
    the inverse inertia, (nv,) each, from MuJoCo's solref and solimp at zero violation."""
    # MuJoCo takes no time constant below two steps, and impedances from 1e-4 to 0.9999.
    time = np.maximum(mj.dof_solref[:, 0], 2 * mj.opt.timestep)
    least, most = np.clip(mj.dof_solimp[:, :2], 1e-4, 0.9999).T
    return 2.0 / (most * time), (1.0 - least) / least


def _in_lanes(numbers: Array, lanes: int) -> Array:
    """Numbers (K, m) as (groups, m, lanes); the last plant fills what is left of a group."""
    groups = -(-len(numbers) // lanes)
    padded = np.pad(numbers, ((0, groups * lanes - len(numbers)), (0, 0)), "edge")
    return np.ascontiguousarray(padded.reshape(groups, lanes, -1).transpose(0, 2, 1))


def check_plants(mj: mujoco.MjModel, plants: Sequence[Plant]) -> list[EstimationError | None]:
    """Return for each plant the error with which its compilation would end, or None."""
    phi = np.array([plant.robot.phi if plant.phi is None else plant.phi for plant in plants])
    m, h = phi[..., 0], phi[..., 1:4]
    # About the centre of mass; that of a massless body is its origin.
    safe = np.where(m == 0.0, 1.0, m)
    c = np.where(m[..., None] == 0.0, 0.0, h / safe[..., None])
    J = phi[..., [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(*m.shape, 3, 3)
    square = np.einsum("...i,...i", c, c)[..., None, None] * np.eye(3)
    with np.errstate(invalid="ignore", over="ignore"):
        moments = np.linalg.eigvalsh(
            np.nan_to_num(J - m[..., None, None] * (square - c[..., :, None] * c[..., None, :]))
        )
    least, most = moments[..., 0], moments[..., -1]
    bad: Array = (m < 0) | (least < -1e-9 * np.maximum(most, 1e-12))
    errors: list[EstimationError | None] = []
    for plant, wrong in zip(plants, np.any(bad, axis=1).tolist(), strict=True):
        try:
            if wrong and plant.phi is not None:
                set_inertia(mj, plant.phi)
            plant.check_terms()
            errors.append(None)
        except EstimationError as error:
            errors.append(error)
    return errors


@dataclass(frozen=True, eq=False)
class Frames:
    """Joints as frames with their axis as z and their anchor as origin: the frame before each (-1:
    the world), the pose R0 (joints, 3, 3), p0 (joints, 3) there, and X (joints, 10, nb, 10), which
    gives the inertial parameters that each frame carries."""

    joints: tuple[TreeJoint, ...]
    before: list[int]
    R0: Array
    p0: Array
    X: Array


@lru_cache(maxsize=16)
def frames_of(tree: Tree) -> Frames:
    """Return the frames of a tree."""
    joints, before, R0, p0 = tree.joints, [], [], []
    last: list[int] = []  # frame of the last joint of each link
    X = np.zeros((len(joints), 10, len(tree.carrier), 10))
    axes: list[Array] = []
    for link in tree.links:
        # Pose of the body in the frame before it, then in that of its own last joint.
        at, R, p = -1, link.R0, link.p0
        if link.parent >= 0:
            at = last[link.parent]
            A = axes[at]
            R, p = A.T @ R, A.T @ (p - joints[at].anchor)
        for joint in link.joints:
            A = _axes(joint)
            before.append(at)
            R0.append(R @ A)
            p0.append(p + R @ joint.anchor)
            at, R, p = len(before) - 1, A.T, -A.T @ joint.anchor
            axes.append(A)
        last.append(at)
        own = inertia_transform(R, p)
        for b in np.flatnonzero(tree.carrier == len(last) - 1):
            X[at, :, b] = own @ tree.X[b]
    return Frames(joints, before, np.array(R0), np.array(p0), X)


def tree_in_c(
    tree: Tree,
    spring_reference: Array,
    whole: Mapping[str, Any] = MappingProxyType({}),
    real: Mapping[str, Any] = MappingProxyType({}),
    **numbers: int,
) -> "_Tree":
    """Return the C struct of a tree with the references of its springs (nv,), and of what moves it:
    arrays of whole and of real numbers, and numbers."""
    frames = frames_of(tree)
    joints = frames.joints
    whole = {
        "kind": [joint.kind for joint in joints],
        "before": frames.before,
        "qadr": [joint.qadr for joint in joints],
        "vadr": [joint.vadr for joint in joints],
        **whole,
    }
    real = {
        "R0": frames.R0,
        "p0": frames.p0,
        "q0": [joint.q0 for joint in joints],
        "gravity": tree.gravity,
        "spring_reference": spring_reference,
        **real,
    }
    arrays = {name: np.ascontiguousarray(x, np.int64) for name, x in whole.items()}
    arrays |= {name: np.ascontiguousarray(x, float) for name, x in real.items()}
    addresses = {name: x.ctypes.data for name, x in arrays.items()}
    made = _Tree(joints=len(joints), nq=tree.nq, nv=tree.nv, **addresses, **numbers)
    made.arrays = arrays  # C sees addresses alone
    return made


def _axes(joint: TreeJoint) -> Array:
    """Axes (3, 3) of a joint's frame in its body: z along a hinge or slide, those of the body of
    other joints."""
    if joint.kind in (FREE, BALL):
        return np.eye(3)
    z = joint.axis / np.linalg.norm(joint.axis)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


_CALL: Final = ("numbers", "reference", "q", "v", "states", "inputs")


class _Tree(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("joints", "nq", "nv", "nu", "laws")),
        *((name, ctypes.c_void_p) for name in
          ("kind", "before", "qadr", "vadr", "R0", "p0", "q0", "gravity", "motor", "motor_place",
           "spring_reference", "stick_rate", "stick_share", "law_kind", "law_numbers",
           "law_states")),
        *((name, ctypes.c_int64) for name in
          ("input", "elastic", "at_end", "needs_start", "records_end", "most_pieces")),
    )  # fmt: skip


class _Call(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("plants", "samples", "each", "own_inputs")),
        *((name, ctypes.c_double) for name in ("h", "time")),
        *((name, ctypes.c_void_p) for name in _CALL),
    )  # fmt: skip


class _Record(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in (*SIGNALS, "unsolved"))
