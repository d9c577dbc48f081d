"""Recorded experiments of the task `actuators`: links known, values of the actuators unknown."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.drive_estimate import identify_drives
from sysid_bench.apps.actuators.drive_rows import DriveRows, drive_rows, pooled_rows
from sysid_bench.apps.actuators.rollout import FITTED
from sysid_bench.errors import UnsupportedError, unknown_name
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.drive_part import (
    DrivePart,
    drive_manifest,
    known_delay,
    read_part,
)
from sysid_bench.experiments.recorded.drive_problem import drive_problem
from sysid_bench.experiments.recorded.drive_source import DriveSource
from sysid_bench.experiments.recorded.published_drives import PublishedDrives, published_drives
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array, Experiment, Prior, Problem
from sysid_bench.words import PUBLISHED

WIDE: Final = 1.0
"""Relative deviation of values of a model file, and of published ones, as a prior."""


def prepare_drives(
    manifest: Manifest,
    training: Sequence[LogDescription],
    tests: Mapping[str, LogDescription],
    accept: Sequence[str],
    prior: str,
) -> ExperimentData[DriveSource]:
    """The problem of the actuators in training logs at the delay that fits best, or is stated.

    The first `share` of each training log is fitted, FITTED of a whole one without tests; judged is
    what follows it in the tests, else in the training logs. `prior`: "model", "none", or
    "published:NAME" of the file beside the first recording.
    Raises UsageError for files, names and contradictions in the data, as `prepare_recordings`.
    """
    share = training[0].share if training[0].share < 1.0 or tests else FITTED
    logs = [replace(log, share=1.0) for log in training]
    others = dict(tests) or {log.source.stem: log for log in logs}
    manifest = drive_manifest(manifest, [*logs, *others.values()])
    fits = [read_part(log, manifest, accept).fit_part(share) for log in logs]
    judged = {
        name: read_part(log, manifest, accept).test_part(share) for name, log in others.items()
    }
    joints = fits[0].log.joints
    pooled = pooled_rows([_rows(p, joints) for p in fits])
    found = identify_drives(pooled, delay=known_delay(fits))
    kinds = _kinds(fits[0].robot, joints)
    problem = drive_problem(found.rows, found.delay, kinds)
    values, published = _prior_values(prior, fits[0], logs[0], joints)
    if values is not None:
        problem = replace(problem, prior=_prior(values, problem))
    test_rows = {name: _rows(part, joints) for name, part in judged.items()}
    held_out = {name: drive_problem(x, found.delay, kinds) for name, x in test_rows.items()}
    source = DriveSource(fits, judged, found, published)
    return ExperimentData(fits[0].robot, problem, _experiment(problem, fits[0]), held_out, source)


def _rows(part: DrivePart, joints: Sequence[str]) -> DriveRows:
    return drive_rows(part.robot, part.log, joints, part.rows)


def _kinds(robot: RobotModel, joints: Sequence[str]) -> tuple[str, ...]:
    return tuple(robot.torque_units[robot.torque_rows.index(joint)] for joint in joints)


def _prior_values(
    prior: str, part: DrivePart, log: LogDescription, joints: Sequence[str]
) -> tuple[Array | None, PublishedDrives | None]:
    """Values (k, 4) of a prior, None without one; published ones besides."""
    if prior.startswith(PUBLISHED):
        place: Path = log.files[0]
        given = published_drives(prior.removeprefix(PUBLISHED), place, joints)
        return given.values, given
    if prior == "none":
        return None, None
    if prior != "model":
        raise unknown_name("prior of actuators", prior, ("model", "none", f"{PUBLISHED}NAME"))
    terms, rows = part.robot.joint_terms, part.robot.rows
    dofs = [rows.index(joint) for joint in joints]
    stated = [terms.armature, terms.viscous, terms.coulomb, terms.offset]
    return np.stack([x[dofs] for x in stated], axis=1), None


def _prior(values: Array, problem: Problem) -> Prior:
    theta = values.ravel()
    least = 1e-3 * np.tile(np.maximum(np.abs(values).max(axis=0), 1e-3), len(values))
    return Prior(theta, np.maximum(WIDE * np.abs(theta), least))


def _experiment(problem: Problem, part: DrivePart) -> Experiment:
    """The problem alone: methods that simulate have no model of delayed commands."""
    recording = part.log.recording

    def refused(*arguments: Any) -> Any:
        raise UnsupportedError(
            "recordings of position-commanded robots are for methods of the linear problem"
        )

    return Experiment(
        problem=problem, recording=recording, raw=recording,
        regress=refused, simulate=refused, known=refused,
    )  # fmt: skip
