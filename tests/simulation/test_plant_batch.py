"""Batched steps are MuJoCo's, on any tree; no plant of a batch depends on another."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sysid_bench.instruction_sets import LEVELS, usable_levels
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.simulation import compiled_steps, plant_batch
from sysid_bench.simulation.compiled_steps import CompiledRun, Signals, run_steps
from sysid_bench.simulation.elastic_drives import Drive
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.simulation.plant_batch import PlantBatch, lanes_library, uncovered
from sysid_bench.simulation.tracking_model import STIFF_FRICTION
from sysid_bench.types import Array, Trajectory
from tests.robots import named_robot, random_robot, urdf_files, urdf_robot

INTEGRATORS = ("euler", "euler with dampers", "implicitfast")
RATE = 1000.0


@pytest.fixture(autouse=True)
def compiled() -> None:
    if isinstance(lanes_library(), str):
        pytest.skip(lanes_library())


def model_of(plant: Plant, integrator: str, each: int = 1) -> mujoco.MjModel:
    """A compiled model with a servo of about 5 Hz on every hinge and slide."""
    robot = plant.robot
    spec = robot.spec.copy()
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            motor = spec.add_actuator(name=f"motor of {joint.name}", target=joint.name)
            motor.trntype, motor.biastype = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtBias.mjBIAS_AFFINE
    for joint in spec.joints:
        joint.solref_friction, joint.solimp_friction = STIFF_FRICTION
    mj = plant.compiled(spec)
    if not plant.terms.coulomb.any():  # of ball joints, too, which have no joint terms
        mj.dof_frictionloss[:] = 0.0
    M = np.zeros((mj.nv, mj.nv))
    data = mujoco.MjData(mj)
    mujoco.mj_forward(mj, data)
    mujoco.mj_fullM(mj, data, M)
    J = np.diag(M)[robot.scalar_dofs]
    kp, kd = 1e3 * J, 40.0 * J
    mj.actuator_gainprm[:, 0], mj.actuator_biasprm[:, 1], mj.actuator_biasprm[:, 2] = kp, -kp, -kd
    mj.actuator_forcelimited[:], mj.actuator_forcerange[:] = 1, np.outer(300 * J, [-1, 1])
    implicit = integrator == "implicitfast"
    kinds = mujoco.mjtIntegrator
    mj.opt.integrator = int(kinds.mjINT_IMPLICITFAST if implicit else kinds.mjINT_EULER)
    if integrator == "euler":
        mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    mj.opt.timestep = 1 / RATE / each
    return mj


def batch_of(plants: Sequence[Plant], integrator: str, seconds: float, each: int = 1) -> PlantBatch:
    """Plants that follow sines about their reference posture."""
    robot, K = plants[0].robot, len(plants)
    mj = model_of(plants[0], integrator, each)
    dofs, (kp, kd) = robot.scalar_dofs, -mj.actuator_biasprm[:, 1:3].T
    drive = Drive(dofs, kp, kd, mj.actuator_forcerange[:, 1], held=False, smooth=each > 1)
    t = np.arange(round(seconds * RATE)) / RATE
    places = mj.jnt_qposadr[mj.dof_jntid[dofs]]
    slide = mj.jnt_type[mj.dof_jntid[dofs]] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    size = np.where(slide, 0.05, 0.4)
    control = mj.qpos0[places] + size * np.sin(np.outer(t, 2 + np.arange(len(dofs)) % 3))
    rng = np.random.default_rng(0)
    v = 0.1 * rng.normal(size=(K, mj.nv))
    q = np.tile(mj.qpos0, (K, 1))
    return PlantBatch(mj, plants, drive, t=t, control=control, q=q, v=v, each=each)


def by_mujoco(batch: PlantBatch, k: int, integrator: str) -> Signals:
    """Signals of plant k of a batch by MuJoCo's steps."""
    mj = model_of(batch.plants[k], integrator, batch.each)
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        getattr(mj, name)[:] = getattr(batch.mj, name)  # gains of the first plant
    data = mujoco.MjData(mj)
    data.qpos[:], data.qvel[:] = batch.q[k], batch.v[k]
    run = CompiledRun(batch.plants[k], mj, data, batch.drive, batch.t, batch.control, batch.each)
    return run_steps(run)


def variants(robot: RobotModel, count: int, **changes: Array) -> list[Plant]:
    """Plants of a robot whose masses and terms differ by 20 %; `changes` of joint terms."""
    rng = np.random.default_rng(1)
    plant = plant_of(replace(robot, coupling=None))
    plants = [plant] if not changes else []
    while len(plants) < count:
        names = ("viscous", "coulomb", "armature", "spring")
        terms = {n: getattr(robot.joint_terms, n) * rng.uniform(0.8, 1.2) for n in names} | changes
        phi = robot.phi * rng.uniform(0.8, 1.2, (len(robot.phi), 1))
        plants.append(replace(plant, phi=phi, terms=replace(robot.joint_terms, **terms)))
    return plants


def gap(batch: PlantBatch, integrator: str, count: int = 2) -> tuple[float, float]:
    """Largest difference of positions, and of torques and accelerations relative to their largest,
    from MuJoCo's."""
    ours, worst = batch.run(), np.zeros(2)
    for k in range(count):
        theirs = by_mujoco(batch, k, integrator)
        assert np.isfinite(theirs.q).all()
        others = [
            np.abs(getattr(ours, name)[k] - getattr(theirs, name)).max()
            / np.abs(getattr(theirs, name)).max()
            for name in ("a", "tau")
            if np.abs(getattr(theirs, name)).max() > 0
        ]
        worst = np.maximum(worst, [np.abs(ours.q[k] - theirs.q).max(), max(others, default=0.0)])
    return float(worst[0]), float(worst[1])


def sensitivity(batch: PlantBatch, integrator: str) -> float:
    """Difference of MuJoCo's positions after rates and masses that differ by 1e-14: explicit steps,
    light links and robots that lean on no controller amplify rounding errors."""
    first, rng = batch.plants[0], np.random.default_rng(0)
    phi = first.robot.phi if first.phi is None else first.phi
    other = replace(first, phi=phi * (1 + 1e-14 * rng.uniform(-1, 1, (len(phi), 1))))
    changed = replace(batch, plants=[other], v=batch.v + 1e-14)
    apart = [by_mujoco(one, 0, integrator).q for one in (batch, changed)]
    return float(np.abs(apart[0] - apart[1]).max())


def check(robot: RobotModel, integrator: str, seconds: float, exact: float = 1e-12) -> None:
    """Positions within `exact` (rad, m) of MuJoCo's, or what it amplifies of rounding errors."""
    plants = variants(robot, 2, coulomb=np.zeros(robot.nv))
    batch = batch_of(plants, integrator, seconds)
    reason = uncovered(plants[0], batch.mj)
    if reason:
        assert "free body" in reason or "spring" in reason
        pytest.skip(reason)
    theirs = by_mujoco(batch, 0, integrator).q
    if not np.isfinite(theirs).all():
        # Explicit dampers diverge where a joint moves little; so do ours.
        assert not np.isfinite(batch.run().q[0]).all()
        return
    apart = gap(batch, integrator, 1)[0]
    # A base that falls for ten seconds is 490 m away, where numbers are that much coarser.
    exact *= max(1.0, float(np.abs(theirs).max()))
    assert apart <= exact or apart <= 10 * sensitivity(batch, integrator)


QUICK = ("panda", "scara", "ur5", "solo12", "dvrk_mtm", "baxter")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", QUICK)
def test_positions_are_those_of_mujoco(name: str, integrator: str) -> None:
    check(named_robot(name), integrator, 0.5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", ["panda", "scara", "solo12", "baxter"])
def test_accelerations_and_torques_are_those_of_mujoco(name: str, integrator: str) -> None:
    robot = named_robot(name)
    batch = batch_of(variants(robot, 2, coulomb=np.zeros(robot.nv)), integrator, 0.5)
    assert gap(batch, integrator)[1] <= 1e-10


@pytest.mark.parametrize("share", [(-0.3, 0.3), (-0.2, 0.5), (-2.0, 2.0)], ids=str)
@pytest.mark.parametrize("steps", ["lanes", "compiled", "python"])
def test_recorded_torques_obey_the_equation_of_motion_at_the_limits_of_joints(
    steps: str, share: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A motor at the limit of its joint has no rate feedback, whatever its own limit is."""
    robot = named_robot("ur5")
    plant = plant_of(robot)
    plant = replace(plant, terms=replace(plant.terms, coulomb=np.zeros(robot.nv)))
    batch = batch_of([plant], "implicitfast", 0.5)
    largest = np.abs(batch.run().tau[0]).max(axis=0)
    batch.mj.jnt_actfrclimited[:], batch.mj.jnt_actfrcrange[:] = 1, np.outer(largest, share)
    if steps == "lanes":
        found = batch.run()
        q, v, a, tau = (x[0] for x in (found.q, found.v, found.a, found.tau))
    else:
        if steps == "python":
            monkeypatch.setattr(compiled_steps, "steps_library", lambda: "switched off")
        data = mujoco.MjData(batch.mj)
        data.qpos[:], data.qvel[:] = batch.q[0], batch.v[0]
        run = CompiledRun(plant, batch.mj, data, batch.drive, batch.t, batch.control, batch.each)
        one = run_steps(run)
        q, v, a, tau = one.q, one.v, one.a, one.tau
    phi = robot.tree.link_parameters(robot.phi)
    needed = newton_euler(robot.tree, phi, Trajectory(batch.t, q, v, a))
    needed += robot.joint_terms.armature * a + plant.terms.viscous * v
    assert np.abs(needed - tau).max() <= 1e-11 * np.abs(tau).max()
    at_limit = (tau >= 0.999 * share[1] * largest) | (tau <= 0.999 * share[0] * largest)
    assert at_limit.any() == (share[1] < 1.0)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("seed", range(6))
def test_positions_of_random_trees_are_those_of_mujoco(seed: int, integrator: str) -> None:
    check(random_robot(seed), integrator, 0.2)


@pytest.mark.long
@pytest.mark.parametrize("free_base", [False, True])
@pytest.mark.parametrize("file", urdf_files())
def test_positions_of_every_robot_over_ten_seconds(file: str, free_base: bool) -> None:
    check(urdf_robot(file, free_base), "implicitfast", 10.0)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(100))
def test_positions_of_many_random_trees(seed: int) -> None:
    for integrator in INTEGRATORS:
        check(random_robot(seed), integrator, 1.0)


@pytest.mark.parametrize("integrator", ["euler", "implicitfast"])
@pytest.mark.parametrize("robot", [named_robot("panda"), named_robot("solo12"), random_robot(1)],
                         ids=lambda robot: robot.name)  # fmt: skip
def test_friction_sticks_as_in_mujoco(robot: RobotModel, integrator: str) -> None:
    coulomb = np.zeros(robot.nv)
    coulomb[robot.scalar_dofs] = 0.5
    plants = variants(robot, 2, coulomb=coulomb, viscous=0.1 * (coulomb > 0))
    batch = batch_of(plants, integrator, 0.3, each=2)
    if uncovered(plants[0], batch.mj):
        pytest.skip(uncovered(plants[0], batch.mj))
    ours = batch.run()
    # A joint at rest creeps with MuJoCo's soft constraint, whose solver stops at 1e-8.
    slow = np.abs(ours.v[0][:, robot.scalar_dofs]) < 1e-3
    assert slow.any()
    assert not slow.all()
    apart = gap(batch, integrator, 1)[0]
    assert apart <= 1e-7 or apart <= 1e6 * sensitivity(batch, integrator)


def test_a_plant_does_not_depend_on_the_others() -> None:
    robot = named_robot("panda")
    plants = variants(robot, 11, coulomb=np.full(robot.nv, 0.5))
    # One diverges: its rotor is lighter than the masses that it would need to be.
    plants[3] = replace(plants[3], phi=1e-12 * robot.phi)
    batch = batch_of(plants, "euler", 0.1)
    together = batch.run()
    assert np.isfinite(together.q[np.arange(11) != 3]).all()
    for k in (0, 2, 4, 10):
        alone = replace(batch, plants=[plants[k]], q=batch.q[k : k + 1], v=batch.v[k : k + 1]).run()
        for name, value in vars(alone).items():
            np.testing.assert_array_equal(value[0], getattr(together, name)[k])


def test_instruction_sets_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    dll, _ = lanes_library()
    robot = named_robot("panda")
    batch = batch_of(variants(robot, 3, coulomb=np.zeros(robot.nv)), "implicitfast", 0.2)
    first = batch.run()
    for level in usable_levels(dll):
        monkeypatch.setattr(plant_batch, "lanes_library", lambda level=level: (dll, level))
        np.testing.assert_allclose(batch.run().q, first.q, rtol=0, atol=1e-13)
    assert set(usable_levels(dll)) <= set(LEVELS)
