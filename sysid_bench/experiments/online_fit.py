"""Payload and joint friction from samples of a moving robot, one after the other."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.models.robot import RobotModel
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.regression import regression
from sysid_bench.signals.stream import Sample
from sysid_bench.types import Array, Trajectory

WINDOW: Final = 0.1
"""s, of the polynomials of degree 4 that give q, v, a and torque at their middle. Two windows share
half of their samples, so that the noise of what is fitted is almost white."""

LEAST: Final = 7
"""Samples of a window: two more than the coefficients."""

TERMS: Final = ("fv", "fc", "offset")
PRIOR: Final = (20.0, *[10.0] * 3, *[5.0] * 6)
"""Standard deviations about zero of the ten parameters of a payload (kg, kg m, kg m^2): no arm
carries more, so that data decide wherever the motion excites."""

FRICTION: Final = 1000.0
"""The same of each friction term, N m."""


def windows(samples: Iterable[Sample]) -> Iterator[tuple[Trajectory, Array, Array]]:
    """Yield one-sample motions and torques (n,), in the middle of windows of the samples, and which
    joints (n,) do not change their direction within it."""
    buffer: list[Sample] = []
    for sample in samples:
        if buffer and sample[0] - buffer[-1][0] > WINDOW:  # lost samples
            buffer = []
        buffer.append(sample)
        if sample[0] - buffer[0][0] < WINDOW or len(buffer) < LEAST:
            continue
        t = np.array([s[0] for s in buffer])
        middle, half = 0.5 * (t[0] + t[-1]), 0.5 * (t[-1] - t[0])
        x = np.vander((t - middle) / half, 5, increasing=True)
        c = np.linalg.lstsq(x, np.array([(*s[1], *s[2]) for s in buffer]), rcond=None)[0]
        q, tau = np.split(c, 2, axis=1)
        rates = np.array([[0, 1, 2 * s, 3 * s**2, 4 * s**3] for s in (-1, 0, 1)]) @ q / half
        motion = Trajectory(np.array([middle]), q[:1], rates[1:2], 2.0 * q[2:3] / half**2, "stream")
        yield motion, tau[0], np.abs(np.sign(rates).sum(axis=0)) == len(rates)
        buffer = [s for s in buffer if s[0] >= middle]


@dataclass(frozen=True, eq=False)
class OnlineEstimate:
    """Mass (kg) and centre (m, tool frame) of the payload with standard deviations, and value and
    deviation of each of TERMS (joints, 3, 2), from `samples` windows."""

    samples: int
    mass: float
    mass_std: float
    com: Array
    com_std: Array
    joints: Array


class OnlineFit:
    """Least squares of a payload and joint friction, one R factor per joint, weighted by the noise
    of each, with the prior of no payload."""

    def __init__(self, robot: RobotModel) -> None:
        assert robot.payload_body is not None
        load = robot.bodies[robot.payload_body]
        self.rows, n = robot.rows, robot.nv
        terms = [f"{row}.{term}" for row in robot.rows for term in TERMS]
        self.unknown = regression(robot, [*load.columns, *terms])
        others = [b for i, b in enumerate(robot.bodies) if i != robot.payload_body]
        self.known = regression(robot, [name for body in others for name in body.columns])
        phi = np.delete(robot.phi, robot.payload_body, axis=0)
        self.theta, self.armature = phi.ravel(), robot.joint_terms.armature
        self.R = [np.zeros((0, len(self.unknown.columns) + 1))] * n
        self.counts = np.zeros(n)

    def add(self, motion: Trajectory, tau: Array, moving: Array) -> None:
        """Take in one sample of the joints that are `moving` (n,)."""
        Y = self.unknown.dense(motion).Y[0]
        b = tau - self.known.torque(motion, self.theta)[0] - self.armature * motion.a[0]
        for j in np.flatnonzero(moving):
            self.R[j] = qr_factor([self.R[j], np.append(Y[j], b[j])[None]])
            self.counts[j] += 1

    def estimate(self) -> "OnlineEstimate":
        """The estimate of all samples so far."""
        prior = np.array([*PRIOR, *[FRICTION] * (len(TERMS) * len(self.rows))])
        start = np.column_stack([np.diag(1.0 / prior), np.zeros(len(prior))])
        sigma = np.ones(len(self.rows))
        for _ in range(4):  # weights from residuals: they are steady after two or three
            scaled = [R / s for R, s in zip(self.R, sigma, strict=True)]
            R = qr_factor([start, *scaled])[: len(prior)]
            beta = solve_triangular(R[:, :-1], R[:, -1])
            rest = np.array([np.linalg.norm(part @ np.append(beta, -1.0)) for part in self.R])
            # Each joint has its friction, and a share of the payload.
            freedom = self.counts - len(TERMS) - len(PRIOR) / len(self.rows)
            sigma = np.where(freedom > 0, rest / np.sqrt(np.maximum(freedom, 1.0)), 1.0)
            sigma = np.maximum(sigma, 1e-9)
        root = solve_triangular(R[:, :-1], np.eye(len(prior)))
        std = np.linalg.norm(root, axis=1)
        mass = beta[0] if beta[0] != 0.0 else np.nan  # without a sample no load has a centre
        com = beta[1:4] / mass
        # d com = (d h - com d m) / m.
        slope = np.column_stack([-com, np.eye(3)]) / mass
        joints = np.stack([beta, std], axis=1)[10:].reshape(-1, len(TERMS), 2)
        com_std = np.linalg.norm(slope @ root[:4], axis=1)
        return OnlineEstimate(int(self.counts.max()), beta[0], std[0], com, com_std, joints)
