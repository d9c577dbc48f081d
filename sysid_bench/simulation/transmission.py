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
class Transmission:
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

    def decay(self, link_inertia: Array) -> Array:
        """Return the rate D (1/B + 1/M) (n,), 1/s, at which the damper stops a relative motion."""
        return np.asarray(self.damping * self._mobility(link_inertia))

    def _mobility(self, link_inertia: Array) -> Array:
        with np.errstate(divide="ignore"):
            rotor = np.where(self.inertia > 0, 1.0 / self.inertia, 0.0)
        return np.asarray(rotor + 1.0 / link_inertia)


@dataclass(frozen=True, eq=False)
class Rotors:
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
    transmission: Transmission | None = None

    @cached_property
    def input(self) -> str:
        """Kind of input, as steps.c has it."""
        return "held" if self.held else "interpolated" if self.smooth else "feedback"

    def feedback(self, u: Array, q: Array, v: Array) -> Array:
        """Return the limited torque kp (u - q) - kd v (n,)."""
        return np.asarray(np.clip(self.kp * (u - q) - self.kd * v, -self.limit, self.limit))

    def turn(self, rotors: Rotors, u: Array, load: Array, h: float) -> tuple[Array, Rotors]:
        """Return the motors' torque (n,) over a step of h (s), and the rotors after it.

        `u` (n,) is the torque if it is held, else the input of the feedback, whose damping is
        implicit: a light rotor would otherwise oscillate. `load` (n,) is tau_e.
        """
        assert self.transmission is not None
        B, w0 = self.transmission.inertia, rotors.rate
        if self.held:
            torque, w = u, w0 + h / B * (u - load)
        else:
            e = u - rotors.theta
            w = (B * w0 + h * (self.kp * e - load)) / (B + h * self.kd + h * h * self.kp)
            free = self.kp * (e - h * w) - self.kd * w
            torque = np.clip(free, -self.limit, self.limit)
            limited = (B > 0) & (np.abs(torque) == self.limit)
            w = np.where(limited, w0 + h / np.where(B > 0, B, 1.0) * (torque - load), w)
        return torque, Rotors(rotors.theta + h * w, w)
