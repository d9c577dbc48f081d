"""Recordings made fit for their task: sensors calibrated in place, contact periods left out."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.experiments.robot_cache import LoadedRobot
from sysid_bench.experiments.simulated.ft_sensors import SensorMeasurement
from sysid_bench.experiments.simulated.problem import ProblemBuilder, measured_signals
from sysid_bench.experiments.simulated.record import SimulatedRobot, record
from sysid_bench.experiments.spec import (
    ExperimentSpec,
)
from sysid_bench.identification.contact_detection import free_samples
from sysid_bench.identification.linear.online_estimation import rows_of
from sysid_bench.identification.sensor_calibration import Calibration, calibrate
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.sensor import cut_at, instruments_of
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.simulation.plant import plant_of
from sysid_bench.tasks.task import Task
from sysid_bench.types import (
    Recording,
)
from sysid_bench.units import interval


def estimate_calibration(spec: ExperimentSpec, subject: LoadedRobot, task: Task) -> Calibration:
    """What the measured sensor tells of itself with known payloads, on the same motion."""
    readings, known = [], []
    for run, load in enumerate(spec.signals["calibration"], 1):
        robot = load_robot(subject.robot.manifest, parse_payload(load), spec.free_base)
        cuts = tuple(cut_at(robot, cut.at, ()) for cut in task.cuts)
        plant = plant_of(robot, [subject.build_plugin("plant", spec.plant)])
        sensing = SensorMeasurement(spec, plant, replace(task, cuts=cuts), run)
        take = SimulatedRobot(
            spec, replace(subject, robot=robot), plant, partial(design_problem, robot)
        )
        recording = record(spec, take, sensing).recording
        instruments = instruments_of(robot, cuts)
        motion = instruments.motion(recording.motion)
        model = newton_euler(instruments.tree, instruments.tree.composite_links(robot.phi), motion)
        assert recording.wrench is not None
        readings.append(recording.wrench[:, :6])
        known.append(model[:, robot.nv : robot.nv + 6])
    return calibrate(np.concatenate(readings), np.concatenate(known))


def apply_calibration(recording: Recording, calibration: Calibration) -> Recording:
    """The recording with the first sensor's reading corrected."""
    assert recording.wrench is not None
    wrench = recording.wrench.copy()
    wrench[:, :6] = calibration.apply(wrench[:, :6])
    return replace(recording, wrench=wrench)


def remove_contact(
    contacts: Any, recording: Recording, posing: ProblemBuilder
) -> tuple[Recording, float]:
    """The recording without contact periods, declared or found, and the share that is left out."""
    if not contacts:
        return recording, 0.0
    if contacts == "detect":
        free = free_samples(*rows_of(posing.build(recording.motion, measured_signals(recording))))
    else:
        t, free = recording.t, np.ones(len(recording), dtype=bool)
        for start, end in map(interval, contacts):
            free &= ~((t >= start) & (t < end))
        if not free.any():
            raise UsageError(
                f"The contact periods {', '.join(contacts)} leave nothing of a recording from "
                f"{t[0]:g} s to {t[-1]:g} s."
            )
    motion = recording.motion
    kept = replace(
        recording, t=motion.t[free], q=motion.q[free], v=motion.v[free], a=motion.a[free],
        tau=recording.tau[free], period=None,
        wrench=None if recording.wrench is None else recording.wrench[free],
    )  # fmt: skip
    return kept, 1.0 - float(free.mean())
