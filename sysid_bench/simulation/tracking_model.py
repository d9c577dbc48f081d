"""Compiled models of plants under tracking control: motors, integrator and time step."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.simulation.elastic_drives import Drive
from sysid_bench.simulation.motor_load import mass_matrix, motor_inertia, motor_values
from sysid_bench.simulation.plant import Plant, law_values
from sysid_bench.types import Array, Controller

STIFF_FRICTION: Final = ([0.002, 1.0], [0.99, 0.9999, 0.001, 0.5, 2.0])
"""solref and solimp of friction loss. MuJoCo's soft default causes torque errors of 12 % in a joint
with Coulomb friction; these settings 0.03 % while the joint moves."""

STIFF_EQUALITY: Final = ([0.002, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0])
"""solref and solimp of couplings. MuJoCo's default causes torque errors of 1 %, these settings less
than 0.01 %."""

EXPLICIT_DAMPING: Final = 0.25
"""Largest fraction of a coupled joint's velocity that dampers and controller take in one step."""

EXPLICIT_SPRING: Final = 0.2
"""Largest product of step and natural frequency (rad/s) of internal springs: symplectic steps are
stable up to 2, and shift a frequency by 0.2 % at this product."""

EXPLICIT_DAMPER: Final = 0.5
"""Largest product of step and decay rate (1/s) of internal dampers: explicit ones are stable up to
2, and free of oscillation up to 1."""

SHORT_DAMPER: Final = 1.0
"""The same where EXPLICIT_DAMPER would need more steps than the limit: explicit dampers are free of
oscillation up to here, and a rate that is so far above those of motions has settled at each."""

STABLE: Final = 2.0
"""Product of step and rate (1/s) from which explicit dampers diverge."""

MOST_STEPS: Final = 20
"""Maximal number of simulation steps of a coupled robot per control period."""

MOST_SPRING_STEPS: Final = 200
"""Maximal number of simulation steps per control period for internal springs."""

INTEGRATORS: Final = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
}


@dataclass(frozen=True)
class StepChoice:
    """Steps of the plant per control period, at least, and its integrator (`words`)."""

    substeps: int = 1
    integrator: str = "auto"


def tracking_model(
    plant: Plant, controller: Controller, choice: StepChoice = StepChoice()
) -> mujoco.MjModel:
    """Return the plant's model with one motor per independent joint.

    Its affine bias is the PD feedback tau = kp (u - q) - kd v, limited to the joint's torque limit;
    where `drive_of` evaluates the feedback, the motor gives its input. Raises UnsupportedError for
    internal springs that need too many steps, and for implicit integrators of coupled robots.
    """
    spec = plant.robot.spec.copy()
    plain = _has_plain_motors(plant, controller, choice)
    motors = motor_joints(plant.robot)
    for joint, kp, kd in zip(motors, controller.kp, controller.kd, strict=True):
        gains = None if plain else (kp, kd)
        _add_motor(spec, joint.name, gains, plant.robot.limits.tau[joint.vadr])
    for joint in spec.joints:
        joint.solref_friction, joint.solimp_friction = STIFF_FRICTION
    for equality in spec.equalities:
        equality.solref, equality.solimp = STIFF_EQUALITY
    mj = plant.compiled(spec)
    coupled = plant.robot.coupling is not None
    explicit, name = controller.held or coupled, choice.integrator
    if name == "auto":
        name = "euler" if explicit else "implicitfast"
    # An implicit integrator violates couplings: torque errors of a gripper are 7 %, with an
    # explicit one 0.01 %.
    if coupled and name.startswith("implicit"):
        raise UnsupportedError(
            f"{plant.robot.name} has coupled joints, whose couplings the integrator {name!r} "
            "violates; use 'euler' or 'rk4'."
        )
    mj.opt.integrator = int(INTEGRATORS[name])
    if explicit:
        mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    if coupled:
        mj.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    mj.opt.timestep = 1.0 / controller.rate / _steps(plant, mj, controller, choice)
    return mj


def drive_of(plant: Plant, controller: Controller, choice: StepChoice, each: int) -> Drive:
    """Return the motors of a simulation with `each` steps per control period."""
    robot = plant.robot
    plain = _has_plain_motors(plant, controller, choice)
    return Drive(
        dofs=np.asarray(robot.torque_dofs),
        kp=controller.kp,
        kd=controller.kd,
        limit=robot.limits.tau[robot.torque_dofs],
        held=plain and controller.held,
        smooth=each > 1,
        transmission=plant.transmission,
    )


def _has_plain_motors(plant: Plant, controller: Controller, choice: StepChoice) -> bool:
    """True if the loop evaluates the feedback: for elastic joints, and for a torque that is held
    over several steps. Over a single step MuJoCo's actuator holds it, too."""
    return plant.transmission is not None or (controller.held and choice.substeps > 1)


def motor_joints(robot: RobotModel) -> list[Joint]:
    """Return the joints with a motor: the independent ones."""
    moving = set(robot.torque_dofs.tolist())
    return [joint for joint in robot.joints if joint.vadr in moving]


def largest_damping_rate(mj: mujoco.MjModel, damping: Array) -> float:
    """Return the largest eigenvalue (1/s) of M^-1 D for damping D (nv,) at the reference
    posture."""
    root = np.sqrt(damping)
    return float(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(mass_matrix(mj)) * root)[-1])


def _add_motor(
    spec: mujoco.MjSpec, joint: str, gains: tuple[float, float] | None, limit: float
) -> None:
    """Add a motor, limited to +- `limit` if finite; its gain and affine bias are PD feedback with
    `gains`, and with None its input is the torque."""
    motor = spec.add_actuator(name=f"motor of {joint}", target=joint)
    motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    motor.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    kp, kd = (0.0, 0.0) if gains is None else gains
    motor.gainprm[:3] = [1.0 if gains is None else kp, 0.0, 0.0]
    motor.biasprm[:3] = [0.0, -kp, -kd]
    if np.isfinite(limit):
        motor.forcerange = [-limit, limit]
        motor.forcelimited = True


def _steps(plant: Plant, mj: mujoco.MjModel, controller: Controller, choice: StepChoice) -> int:
    """Steps per control period: as chosen, and as dampers of coupled joints and springs need."""
    needed = [choice.substeps, _spring_steps(plant, mj, controller.rate)]
    if plant.robot.coupling is not None:
        # Explicit damping is stable up to D dt / M = 2, and free of oscillation well below.
        damping = motor_values(plant.robot, plant.terms.viscous, 2) + controller.kd
        inertia = motor_inertia(plant)
        rates = damping / inertia / controller.rate
        if rates.max() / MOST_STEPS > STABLE:
            joint = motor_joints(plant.robot)[int(np.argmax(rates))].name
            raise UnsupportedError(
                f"{plant.robot.name}: joint {joint!r} moves {inertia[np.argmax(rates)]:.2g} kg m^2 "
                f"(kg), too little for its damper and controller at {MOST_STEPS} steps per control "
                "period. Give its links mass and inertia, or the joint rotor inertia (armature)."
            )
        needed.append(min(MOST_STEPS, int(np.ceil(rates.max() / EXPLICIT_DAMPING))))
    return max(needed)


def _spring_steps(plant: Plant, mj: mujoco.MjModel, rate: float) -> int:
    """Steps per control period for elastic joints and the springs of force laws."""
    nv, elastic = plant.robot.nv, plant.transmission
    springs, dampers = (law_values(plant.laws, name, nv) for name in ("stiffness", "damping"))
    if elastic is None and not (springs.any() or dampers.any()):
        return 1
    # The inertia that a joint's spring accelerates is that with all other joints free to move.
    mobility = np.diag(np.linalg.inv(mass_matrix(mj)))
    frequency, decay = np.sqrt(springs * mobility), dampers * mobility
    names = [joint.name for joint in plant.robot.joints for _ in joint.dofs]
    if elastic is not None:
        links = 1.0 / mobility[plant.robot.torque_dofs]
        names += [joint.name for joint in motor_joints(plant.robot)]
        frequency = np.append(frequency, elastic.resonance(links))
        decay = np.append(decay, elastic.damping_rate(links))
    spring = float(frequency.max()) / EXPLICIT_SPRING / rate
    damper = float(decay.max()) / rate
    least = int(np.ceil(max(spring, damper / SHORT_DAMPER)))
    if least > MOST_SPRING_STEPS:
        stiff = spring >= damper / SHORT_DAMPER
        joint = names[int(np.argmax(frequency if stiff else decay))]
        what = (
            f"spring of the plant oscillates with {frequency.max() / 2 / np.pi:.3g} Hz"
            if stiff
            else f"damper of the plant decays with {decay.max():.3g} 1/s"
        )
        raise UnsupportedError(
            f"{plant.robot.name}: an internal {what} at joint {joint!r}, which needs {least} steps "
            f"per control period; {MOST_SPRING_STEPS} is the limit. Use softer transmissions or a "
            "larger presliding distance, and bodies that have a mass."
        )
    wanted = int(np.ceil(max(spring, damper / EXPLICIT_DAMPER)))
    return min(wanted, MOST_SPRING_STEPS)
