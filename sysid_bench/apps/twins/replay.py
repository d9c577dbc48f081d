"""Replays: a simulated plant that moves along a recorded motion, as a recording of its own."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.simulated.noise_free import noise_free_part
from sysid_bench.experiments.simulated.record import record
from sysid_bench.experiments.spec import ExperimentSpec, normal_noise
from sysid_bench.models.model_record import seed_content
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array, Recording

FASTEST: Final = 1000.0
"""Hz: rate of the controllers of plants, which the rate of a replay divides."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A plant file's keys on a robot: what moves in a replay."""

    robot: RobotModel
    plant: Mapping[str, Any]
    has_rates: bool = True  # the log has v

    def along(self, recording: Recording, rate: float, seed: int) -> LogDescription:
        """Return the log (q, v, tau) of the plant along a processed recording, at a rate (Hz).

        Raises SimulationError, UsageError or UnsupportedError where the plant cannot follow it.
        """
        spec = self.spec(rate, seed)
        with tempfile.TemporaryDirectory() as folder:
            # The way over a file is that of a suite: what is compared here can be repeated there.
            motion = _motion_text(self.robot, recording)
            Path(folder, MOTION).write_text(motion, encoding="utf-8")
            part = noise_free_part(spec, LoadedRobot(self.robot, Path(folder)))
            raw = record(spec, part.simulated).raw
        # As a log in memory, with the exact rates of the motion.
        places = {joint.dofs[0]: joint.qadr for joint in self.robot.joints if len(joint.dofs) == 1}
        names, dofs = self.robot.torque_rows, self.robot.torque_dofs
        q: Array = raw.q[:, [places[name] for name in names]]
        arrays = {"q": q, "tau": raw.tau}
        if raw.v is not None and self.has_rates:
            arrays["v"] = raw.v[:, dofs]
        return log_of(arrays, {"joints": list(names), "rate": f"{raw.rate} Hz"}, "replay")

    def spec(self, rate: float, seed: int) -> ExperimentSpec:
        """Return the experiment of a replay at a rate (Hz), whose fields give its seeds."""
        written = self.plant.get("simulation", "inverse")
        keys = {key: value for key, value in self.plant.items() if key in PARTS}
        return ExperimentSpec(
            seed=seed,
            robot=self.robot.name,
            content=seed_content(self.robot.manifest),
            payload="none",
            task="robot",
            terms=(),
            plant={"use": "composed", **keys},
            prior="none",
            excitation={"use": "file", "file": MOTION, "limits": "mark"},
            held_out=(),
            simulation={"use": written} if isinstance(written, str) else written,
            rate=rate,
            noise=normal_noise(self.plant.get("noise", {})),
            signals={"derivatives": "exact"},
            repeat=0,
        )


MOTION: Final = "motion.csv"
"""File of a replay's motion; its folder is no part of the specification, which gives the seeds."""

DENSEST: Final = 125.0
"""Hz: rate of the rows of a motion, which has been filtered at some 10 Hz."""

PARTS: Final = ("effects", "errors", "sensors")
"""Keys of a plant file that list its parts."""


def replay_rate(rate: float) -> float:
    """Return the rate (Hz) nearest to that of a log that divides FASTEST."""
    return FASTEST / max(1, round(FASTEST / rate))


def _motion_text(robot: RobotModel, recording: Recording) -> str:
    """CSV of the positions of the independent joints on an even grid of time."""
    joints = {joint.dofs[0]: joint for joint in robot.joints if joint.kind in ("hinge", "slide")}
    names = robot.torque_rows
    # Between closer rows a spline would turn the rounding of the file into accelerations.
    step = max(1, int(recording.rate / DENSEST))
    t = np.arange(len(recording)) / recording.rate
    table = np.column_stack([t, *(recording.q[:, joints[name].qadr] for name in names)])[::step]
    rows = [",".join(f"{x:.15g}" for x in row) for row in table]
    return "\n".join([",".join(["t", *(joints[name].name for name in names)]), *rows]) + "\n"
