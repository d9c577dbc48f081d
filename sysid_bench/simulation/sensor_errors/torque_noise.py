"""Coloured noise of torque sensing: a first-order process with a time constant in seconds."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy.signal import lfilter

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.sensor_chain import TorqueSignal
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class TorqueNoise:
    """Noise of each joint's torque reading with the standard deviation `std` plus the fraction
    `share` of the joint's RMS torque, and the correlation exp(-|s| / `time_constant`) over s
    seconds, whatever the rate.

    Residuals of six recorded arms lose their correlation (to 1/e) in 0.03 to 2.8 s, most of it
    unmodelled torque; that of the sensors alone is shorter.
    """

    std: Size = field(default=0.0, metadata={"unit": "N m|N"})
    share: Size = field(default=0.01, metadata={"unit": "%"})
    time_constant: Size = field(default=0.05, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("std", "share")

    def __post_init__(self) -> None:
        """Raise UsageError for negative deviations, and time constants that are not positive."""
        check_size("std of the sensor error 'torque-noise'", self.std)
        check_size("share of the sensor error 'torque-noise'", self.share)
        if not (np.asarray(self.time_constant, dtype=float) > 0).all():
            raise UsageError(
                f"time_constant = {self.time_constant!r} of the sensor error 'torque-noise': give "
                "more than 0 s; white noise is noise.tau."
            )

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Noise | None":
        """Return the stage; None where the deviations are zero."""
        rows = robot.torque_rows
        std, share = joint_size(self.std, rows, "std"), joint_size(self.share, rows, "share")
        constant = joint_size(self.time_constant, rows, "time_constant")
        return _Noise(std, share, constant) if std.any() or share.any() else None


@dataclass(frozen=True, eq=False)
class _Noise:
    std: Array
    share: Array
    time_constant: Array

    def torque_reading(self, signal: TorqueSignal, rng: np.random.Generator) -> Array:
        """Return tau + e (N, n): e_(k+1) = rho e_k + sqrt(1 - rho^2) s w_k from its stationary
        state, rho = exp(-h / T)."""
        white = rng.normal(size=signal.tau.shape)
        rho = np.exp(-(signal.t[1] - signal.t[0]) / self.time_constant)
        noise = np.empty_like(white)
        for j, c in enumerate(rho):
            b = np.sqrt(1 - c**2)
            start = np.array([(1 - b) * white[0, j]])
            noise[:, j], _ = lfilter([b], [1.0, -c], white[:, j], zi=start)
        return np.asarray(signal.tau + (self.std + self.share * signal.rms) * noise)
