"""Tracking control: forward dynamics of the plant under PD feedback from noisy encoders.

The loop is that of the feedback; closed kinematic chains are in `models/coupling`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import SimulationError, UnsupportedError, UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.compiled_steps import CompiledRun, Signals, run_steps
from sysid_bench.simulation.model_errors import plant_controller
from sysid_bench.simulation.motor_load import motor_inertia, motor_load, motor_values
from sysid_bench.simulation.plant import Plant, check_finite
from sysid_bench.simulation.plant_batch import PlantBatch, uncovered
from sysid_bench.simulation.sensors import recursive_filter
from sysid_bench.simulation.tracking_model import (
    StepChoice,
    drive_of,
    largest_damping_rate,
    motor_joints,
    tracking_model,
)
from sysid_bench.types import Array, Controller, Oracle, Trajectory
from sysid_bench.words import INTEGRATORS, SIMULATORS

EXPLICIT_DECAY: Final = 1.0
"""Largest product of control period and fastest decay rate for a torque that is held over a period,
as by a digital controller. An implicit step acts like an additional joint inertia of (kd + viscous
friction) times the step: 17 % of the torque of a UR5 at 500 Hz. Beyond this product a held torque
would oscillate."""

LEAD_IN: Final = 50
"""Control periods before the motion, which are not recorded, of robots with a transient at their
start, during which torques are not those of the motion: soft constraints of a coupled robot, and
elastic transmissions that are not yet wound up."""


@dataclass(frozen=True)
class TrackingControl:
    """Closed-loop simulation with PD control of every joint at the control rate `rate` (Hz).

    The gains give each joint, with the diagonal of the mass matrix at the reference posture, the
    natural frequency `bandwidth` (Hz) and the ratio `damping`. kp is raised where gravity and
    friction would cause a tracking error above the fraction `droop` of the joint's range. `kp` and
    `kd` (N m/rad and N m s/rad, or N/m and N s/m), one for all joints or one each, replace this
    design. The measured velocity contains the backward difference of the encoder error, through a
    first-order low-pass filter at `velocity_cutoff` (Hz).

    The plant takes `substeps` steps per control period, or more where its internal springs need
    them, with the `integrator` "euler" (semi-implicit), "implicitfast", "implicit" or "rk4";
    "auto" is "euler" where the torque is held over the period, else "implicitfast". The `simulator`
    is "mujoco", or "lanes" (lanes.c, faster; MuJoCo where that does not cover the plant).
    """

    rate: float = field(default=1000.0, metadata={"unit": "Hz"})
    bandwidth: float = field(default=10.0, metadata={"unit": "Hz"})
    damping: float = 0.7
    droop: float = field(default=0.005, metadata={"unit": "1"})
    velocity_cutoff: float = field(default=30.0, metadata={"unit": "Hz"})
    kp: float | Sequence[float] | None = None
    kd: float | Sequence[float] | None = None
    substeps: int = 4
    integrator: str = "auto"
    simulator: str = "mujoco"

    def __post_init__(self) -> None:
        if (self.kp is None) != (self.kd is None):
            raise UsageError("Give both kp and kd of the controller, or neither.")
        _check_gains("kp", self.kp)
        _check_gains("kd", self.kd)
        steps = self.substeps
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise UsageError(f"substeps = {steps!r}: give a whole number of 1 or more.")
        if self.integrator not in INTEGRATORS:
            raise unknown_name("integrator", self.integrator, INTEGRATORS)
        if self.simulator not in SIMULATORS:
            raise unknown_name("simulator", self.simulator, SIMULATORS)

    @property
    def step_choice(self) -> StepChoice:
        """Steps and integrator of the plant."""
        return StepChoice(self.substeps, self.integrator)

    def design_rate(self, recording: float) -> float:
        """Return the control rate (Hz); raises UsageError unless the recording rate divides it."""
        ratio = self.rate / recording
        if abs(ratio - round(ratio)) > 1e-9 or ratio < 1:
            raise UsageError(
                f"The rate {recording} Hz does not divide the control rate {self.rate} Hz."
            )
        return self.rate

    def run(
        self, plant: Plant, commanded: Trajectory, encoder: Array
    ) -> tuple[Oracle, Controller | None]:
        """Simulate the robot tracking the motion; return exact motion and torques, and the
        controller. `encoder` (N, n): error of each encoder reading (rad, m).

        Raises UnsupportedError for a floating base or ball joints, SimulationError if the loop
        diverges.
        """
        return self.run_many(plant, [commanded], [encoder])[0]

    def run_many(
        self, plant: Plant, commanded: Sequence[Trajectory], encoders: Sequence[Array]
    ) -> list[tuple[Oracle, Controller | None]]:
        """As `run`, along several motions with the encoder errors of each; at once in lanes. What
        comes of one does not depend on the others."""
        robot = plant.robot
        if robot.floating or any(joint.kind == "ball" for joint in robot.joints):
            raise UnsupportedError(
                f"{robot.name}: closed-loop needs a fixed base, and hinges and slides alone."
            )
        controller = self.controller(plant)
        moved = plant_controller(controller, robot)
        found = self._follow_many(plant, moved, commanded, encoders)
        return [(oracle, controller) for oracle in found]

    def follow(
        self, plant: Plant, controller: Controller, commanded: Trajectory, encoder: Array
    ) -> Oracle:
        """Simulate a plant under a given controller; return its exact motion and torques.

        Raises SimulationError if the loop diverges or loses the commanded motion.
        """
        return next(self._follow_many(plant, controller, [commanded], [encoder]))

    def _follow_many(
        self,
        plant: Plant,
        controller: Controller,
        commanded: Sequence[Trajectory],
        encoders: Sequence[Array],
    ) -> Iterator[Oracle]:
        mj = tracking_model(plant, controller, self.step_choice)
        in_lanes = self.simulator == "lanes" and not uncovered(plant, mj)
        # Lanes share the sample times: one motion after the other where these differ.
        together = in_lanes and all(np.array_equal(x.t, commanded[0].t) for x in commanded)
        size = len(commanded) if together else 1
        for first in range(0, len(commanded), size):
            part = commanded[first : first + size]
            errors = encoders[first : first + size]
            driven = [
                self.inputs(plant, controller, x, e) for x, e in zip(part, errors, strict=True)
            ]
            whole, control = driven[0]
            each: int = round((whole.t[1] - whole.t[0]) / mj.opt.timestep)
            drive = drive_of(plant, controller, self.step_choice, each)
            if in_lanes:
                q, v = (np.array([getattr(x, name)[0] for x, _ in driven]) for name in ("q", "v"))
                batch = PlantBatch(
                    mj, [plant] * len(part), drive, t=whole.t,
                    control=np.array([u for _, u in driven]), q=q, v=v, each=each,
                )  # fmt: skip
                found = batch.run()
                signals = [found.of_plant(k) for k in range(len(part))]
            else:
                data = mujoco.MjData(mj)
                data.qpos[:], data.qvel[:] = whole.q[0], whole.v[0]
                run = CompiledRun(plant, mj, data, drive, t=whole.t, control=control, each=each)
                signals = [run_steps(run)]
            for motion, own in zip(part, signals, strict=True):
                yield oracle_of(plant, motion, own, mj.opt.timestep)

    def inputs(
        self, plant: Plant, controller: Controller, commanded: Trajectory, encoder: Array
    ) -> tuple[Trajectory, Array]:
        """Return the commanded motion with its lead-in, and the motors' inputs (N, n) along it."""
        robot = plant.robot
        # MuJoCo replaces an input of NaN by zero, with only a warning.
        check_finite(robot.name, encoder, "encoder error")
        lead = 0 if robot.coupling is None and plant.transmission is None else LEAD_IN
        whole = _with_lead_in(robot, commanded, lead)
        encoder = np.pad(encoder, ((lead, 0), (0, 0)), "edge")
        return whole, commands(controller, whole, encoder, robot)

    def controller(self, plant: Plant) -> Controller:
        """Return the controller of a plant, with gains (n,), one per motor."""
        if self.kp is None or self.kd is None:
            kp, kd = self._designed(plant.robot_without_effects)
        else:
            kp, kd = _per_motor(self.kp, plant.robot), _per_motor(self.kd, plant.robot)
        return Controller(kp, kd, self.rate, self.velocity_cutoff, self._holds(plant, kd))

    def _holds(self, plant: Plant, kd: Array) -> bool:
        """True if the torque can be held over a control period. Not for a coupled robot: it takes
        several steps per period, with damping in each."""
        if plant.robot.coupling is not None:
            return False
        nominal = plant.robot_without_effects
        decay = largest_damping_rate(nominal.contact_free_model, kd + nominal.terms.viscous)
        if plant.transmission is not None:
            with np.errstate(divide="ignore"):  # a motor without inertia cannot hold a torque
                decay = max(decay, float((kd / plant.transmission.inertia).max()))
        return decay <= EXPLICIT_DECAY * self.rate

    def _designed(self, plant: Plant) -> tuple[Array, Array]:
        """Gains (n,) from the bandwidth, the damping and the load."""
        J, load = motor_inertia(plant), motor_load(plant)
        coupling = plant.robot.coupling
        low, high = plant.robot.limits.q_low, plant.robot.limits.q_high
        if coupling is not None:
            low, high = coupling.low, coupling.high
        reach = np.minimum(high - low, 2 * np.pi)
        kp = np.maximum((2 * np.pi * self.bandwidth) ** 2 * J, load / (self.droop * reach))
        viscous = motor_values(plant.robot, plant.terms.viscous, 2)
        # Sampling limit: beyond half a radian per sample, of the natural frequency or of the lag
        # due to viscous friction, the sampled loop oscillates.
        kp = np.minimum(kp, np.maximum(J * (0.5 * self.rate) ** 2, viscous * 0.5 * self.rate))
        kp = _one_digit(kp)
        return kp, _one_digit(2 * self.damping * np.sqrt(kp * J))


def _check_gains(name: str, gains: object) -> None:
    values = gains if isinstance(gains, (list, tuple)) else [gains]
    if gains is not None and not (values and all(map(_is_positive, values))):
        raise UsageError(f"{name} = {gains!r}: give a positive number, or a list of them.")


def _is_positive(x: object) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and 0 < x < np.inf


def _per_motor(gains: float | Sequence[float], robot: RobotModel) -> Array:
    """Declared gains (n,); raises UsageError if their number is not that of the motors."""
    values, n = np.atleast_1d(np.asarray(gains, dtype=float)), len(robot.torque_dofs)
    if len(values) not in (1, n):
        raise UsageError(
            f"{robot.name} has {n} motors, but the controller {len(values)} gains; give one for "
            "all motors, or one each."
        )
    return np.broadcast_to(values, (n,)).copy()


def _one_digit(gains: Array) -> Array:
    """Gains (n,) rounded to one significant digit, as in manual tuning. More digits would reveal
    the true inertia to identification methods, which know the controller."""
    size = 10.0 ** np.floor(np.log10(gains))
    return np.asarray(np.round(gains / size) * size)


def oracle_of(plant: Plant, commanded: Trajectory, signals: Signals, step: float) -> Oracle:
    """Return the exact motion and torques of a plant's signals, which may begin with a lead-in.

    Raises SimulationError for signals that are not finite, or have lost the commanded motion.
    """
    robot, lead = plant.robot, len(signals.q) - len(commanded)
    if signals.unsolved:
        raise SimulationError(
            f"{robot.name}: friction that sticks was not solved in {int(signals.unsolved)} steps; "
            'simulate the plant with simulator = "mujoco", candidates with friction = "smooth".'
        )
    q, v, a, tau = (x[lead:] for x in (signals.q, signals.v, signals.a, signals.tau))
    motion = Trajectory(commanded.t, q, v, a, "closed loop", commanded.period)
    for name, array in (("position", motion.q), ("acceleration", motion.a)):
        check_finite(robot.name, array, f"{name} in closed loop")
    _check_tracking(robot, commanded, motion, tau)
    # Motion as encoders on the motors measure it; None where they measure that of the links
    if plant.transmission is None or not plant.transmission.motor_side:
        encoders = None
    else:
        q, v, a = motion.q.copy(), motion.v.copy(), motion.a.copy()
        dofs = plant.robot.torque_dofs
        for x, motor in ((q, signals.motor_q), (v, signals.motor_v), (a, signals.motor_a)):
            x[:, dofs] = motor[lead:]
        encoders = Trajectory(motion.t, q, v, a, motion.name, motion.period)
    return Oracle(motion, tau[:, robot.torque_dofs], encoders, step)


def _with_lead_in(robot: RobotModel, commanded: Trajectory, count: int) -> Trajectory:
    """Motion with `count` samples before it, extrapolated with its initial acceleration."""
    if count == 0:
        return commanded
    step = commanded.t[1] - commanded.t[0]
    dt = -step * np.arange(count, 0, -1.0)[:, None]
    q0, v0, a0 = commanded.q[:1], commanded.v[:1], commanded.a[:1]
    v, a = v0 + a0 * dt, np.repeat(a0, count, axis=0)
    # With hinges and slides alone, q and v have the same indices.
    q = q0 + v0 * dt + 0.5 * a0 * dt**2
    if robot.coupling is not None:
        q, v, a = robot.coupling.completed(q, v, a)
    return Trajectory(
        np.concatenate([commanded.t[0] + dt[:, 0], commanded.t]),
        np.concatenate([q, commanded.q]),
        np.concatenate([v, commanded.v]),
        np.concatenate([a, commanded.a]),
        commanded.name,
    )


def commands(
    controller: Controller, commanded: Trajectory, encoder: Array, robot: RobotModel
) -> Array:
    """Return the motor inputs u (N, n) for which kp (u - q) - kd v is PD control on noisy encoders.

    The control law is kp (q_ref - q - n) + kd (v_ref - v - s), with the encoder error n (N, n) and
    its low-pass filtered backward difference s.
    """
    difference = np.diff(encoder, axis=0, prepend=encoder[:1]) * controller.rate
    pole = float(np.exp(-2 * np.pi * controller.velocity_cutoff / controller.rate))
    slope = recursive_filter(1 - pole, pole, difference, np.zeros_like(difference[:1]))
    qadr = [joint.qadr for joint in motor_joints(robot)]
    ratio = controller.kd / controller.kp
    rates = commanded.v[:, robot.torque_dofs]
    return np.asarray(commanded.q[:, qadr] - encoder + ratio * (rates - slope))


def _check_tracking(
    robot: RobotModel, commanded: Trajectory, motion: Trajectory, tau: Array
) -> None:
    errors = np.abs(motion.q - commanded.q).max(axis=0)
    lost = [joint for joint in motor_joints(robot) if errors[joint.qadr] > 1.0]
    if not lost:
        return
    worst = max(lost, key=lambda joint: float(errors[joint.qadr]))
    name, limit = worst.name, robot.limits.tau[worst.vadr]
    saturated = float((np.abs(tau[:, worst.vadr]) >= 0.999 * limit).mean())
    if saturated > 0.01:
        raise SimulationError(
            f"{robot.name}: {name} does not track its motion, since its motor is at the limit of "
            f"{limit:.3g} N m or N in {100 * saturated:.0f} % of the samples; lower "
            f"limits.{name}.a in the robot's manifest, or the payload."
        )
    raise SimulationError(
        f"{robot.name}: the tracking error of {name} is {errors[worst.qadr]:.3g} rad or m; lower "
        "the limits of the motion, or change the controller's bandwidth."
    )
