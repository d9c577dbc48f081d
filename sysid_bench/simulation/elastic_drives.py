"""Elastic transmissions between motors and joints: rotors as states of the simulation.

Two-mass model (Spong 1987) with backlash, theta the motor's position referred to its joint:
tau_e = K dz(theta - q, b) + D (theta' - q') acts on the link, B theta'' = tau_m - tau_e on the
rotor; dz(x, b) = x - clip(x, -b, b). Friction acts at the link's side.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class ElasticDrives:
    """Elastic transmissions of all motors (n,): stiffness K (N m/rad, N/m), damping D (N m s/rad,
    N s/m), half gap b (rad, m) and rotor inertia B (kg m^2, kg), referred to the joints."""

    stiffness: Array
    damping: Array
    gap: Array
    inertia: Array
    motor_side: bool = True  # encoders measure theta; else q

    def torque(self, x: Array, rate: Array) -> Array:
        """Return tau_e (n,) at the deflections theta - q (n,) and their rates (n,)."""
        inside = np.clip(x, -self.gap, self.gap)
        return np.asarray(self.stiffness * (x - inside) + self.damping * rate)

    def resonance(self, link_inertia: Array) -> Array:
        """Return the angular frequency (n,), rad/s, with the inertias (n,) of the links:
        omega^2 = K (1/B + 1/M); without rotor inertia that of the link alone."""
        return np.asarray(np.sqrt(self.stiffness * self._mobility(link_inertia)))

    def damping_rate(self, link_inertia: Array) -> Array:
        """Return the rate D (1/B + 1/M) (n,), 1/s, at which the damper stops a relative motion."""
        return np.asarray(self.damping * self._mobility(link_inertia))

    def _mobility(self, link_inertia: Array) -> Array:
        with np.errstate(divide="ignore"):
            rotor = np.where(self.inertia > 0, 1.0 / self.inertia, 0.0)
        return np.asarray(rotor + 1.0 / link_inertia)


@dataclass(frozen=True, eq=False)
class MotorState:
    """Positions and velocities (n,) of the motors, referred to the joints."""

    theta: Array
    rate: Array


@dataclass(frozen=True, eq=False)
class Drive:
    """Motors of a simulation: their degrees of freedom (n,), PD gains (n,), torque limits (n,), and
    the elastic transmission, if there is one.

    With `held` the torque is that of the state at the start of the control period; else the
    feedback is continuous, on inputs that are interpolated linearly (`smooth`) or held.
    """

    dofs: Array
    kp: Array
    kd: Array
    limit: Array
    held: bool
    smooth: bool
    transmission: ElasticDrives | None = None

    @cached_property
    def input(self) -> str:
        """Kind of input, as steps.c has it."""
        return "held" if self.held else "interpolated" if self.smooth else "feedback"

    def control_torque(self, u: Array, q: Array, v: Array) -> Array:
        """Return the limited torque kp (u - q) - kd v (n,)."""
        return np.asarray(np.clip(self.kp * (u - q) - self.kd * v, -self.limit, self.limit))

    def step(
        self, rotors: MotorState, u: Array, q: Array, v: Array, h: float
    ) -> tuple[Array, Array, MotorState]:
        """Return the motors' torque (n,) and the links' tau_e (n,) over a step of h (s) from the
        links' q, v (n,) on, and the rotors after it.

        `u` (n,) is the torque if it is held, else the input of the feedback.
        """
        massless = self._elastic.inertia == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            heavy = self._with_inertia(rotors, u, q, v, h)
            light = self._without_inertia(rotors, u, q, v, h)
        torque, load, w = (np.where(massless, x, y) for x, y in zip(light, heavy, strict=True))
        return torque, load, MotorState(rotors.theta + h * w, w)

    def _with_inertia(
        self, rotors: MotorState, u: Array, q: Array, v: Array, h: float
    ) -> tuple[Array, Array, Array]:
        """Torque, tau_e and the rotors' next rate (n,), symplectic in the spring; the damping of a
        feedback is implicit, since a light rotor would otherwise oscillate."""
        own = self._elastic
        B, torque = own.inertia, u
        load = own.torque(rotors.theta - q, rotors.rate - v)
        if not self.held:
            e = u - rotors.theta
            w = (B * rotors.rate + h * (self.kp * e - load)) / (B + h * self.kd + h * h * self.kp)
            torque = np.clip(self.kp * (e - h * w) - self.kd * w, -self.limit, self.limit)
        return torque, load, rotors.rate + h / B * (torque - load)

    def _without_inertia(
        self, rotors: MotorState, u: Array, q: Array, v: Array, h: float
    ) -> tuple[Array, Array, Array]:
        """The same of motors without inertia: kd w + kp (theta - u) + K dz(theta - q) + D (w - v) =
        0 at the end of the step, or the torque limit in place of the feedback."""
        own = self._elastic
        x = rotors.theta - q
        x = x - np.clip(x, -own.gap, own.gap)
        K, D = np.where((own.gap > 0) & (x == 0), 0.0, own.stiffness), own.damping
        e, rest = u - rotors.theta, D * v - K * x
        w = (self.kp * e + rest) / (self.kd + D + h * (self.kp + K))
        free = self.kp * (e - h * w) - self.kd * w
        torque = np.clip(free, -self.limit, self.limit)
        limited = (torque != free) & (D + h * K > 0)
        w = np.where(limited, (torque + rest) / (D + h * K), w)
        return torque, K * (x + h * w) + D * (w - v), w

    @property
    def _elastic(self) -> ElasticDrives:
        assert self.transmission is not None
        return self.transmission
