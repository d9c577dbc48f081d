"""Recorded experiments of the task `actuators`: links known, values of the actuators unknown."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_drives
from sysid_bench.apps.actuators.drive_part import DrivePart, drive_manifest, known_delay, read_part
from sysid_bench.apps.actuators.drive_rows import (
    UNKNOWNS,
    DriveRows,
    drive_rows,
    model_values,
    pooled_rows,
)
from sysid_bench.apps.actuators.position_baselines import position_baselines, rollout_fields
from sysid_bench.apps.actuators.rollout import FITTED, Drives, missing_simulation, rollout_error
from sysid_bench.errors import (
    SimulationError,
    UnsupportedError,
    UsageError,
    first_names,
    unknown_name,
)
from sysid_bench.evaluation.baselines import Baselines
from sysid_bench.evaluation.score import base_parameters, data_figures, score_recorded
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.input_files import read_text
from sysid_bench.models.manifest import Manifest
from sysid_bench.numerics import qr_factor
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import (
    Array,
    BaseMap,
    Estimate,
    Experiment,
    Factor,
    Prior,
    Problem,
    Row,
    RowBlock,
)
from sysid_bench.words import AT_BOUND, PUBLISHED

VALUES_FILE: Final = "published.json"
_WORDS: Final = ("armature", "damping", "frictionloss")


@dataclass(frozen=True, eq=False)
class PublishedDrives:
    """Values (k, 4) in the order of UNKNOWNS, and the bias (k,) of the encoders (rad, m), of which
    a publication may have the opposite sign."""

    values: Array
    bias: Array


def published_drives(name: str, recording: Path, joints: Sequence[str]) -> PublishedDrives:
    """Return the values `name` of the file beside a recording: {name: {"joints": {joint: {armature,
    damping, frictionloss, bias}}}}, without a bias zero.

    Raises UsageError for a file, name, joint or value that is not there.
    """
    file = recording.parent / VALUES_FILE
    try:
        written = json.loads(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} has no published values: {error}.") from error
    known = {
        key: one["joints"]
        for key, one in written.items()
        if isinstance(one, Mapping) and isinstance(one.get("joints"), Mapping)
    }
    if name not in known:
        raise unknown_name(f"set of values in {file.name}", name, known)
    try:
        terms = [[known[name][joint][word] for word in _WORDS] + [0.0] for joint in joints]
        bias = [known[name][joint].get("bias", 0.0) for joint in joints]
    except KeyError as error:
        raise UsageError(
            f"{file}: {name} has no {error} for each of {', '.join(joints)}."
        ) from error
    return PublishedDrives(np.array(terms, dtype=float), np.array(bias, dtype=float))


def drive_problem(rows: DriveRows, delay: float, kinds: tuple[str, ...]) -> Problem:
    """Return the problem of the values of all joints ("knee.Ia", ...) at a delay (s) of the
    commands; `kinds` of the rows, as in `Problem`."""
    tau, count = rows.torque(delay), len(UNKNOWNS)
    names = tuple(f"{joint}.{term}" for joint in rows.joints for term in UNKNOWNS)
    factors = []
    for j, joint in enumerate(rows.joints):
        # Rows of a joint hold the values of that joint alone: the problem falls apart into small
        # factors.
        R = qr_factor([np.column_stack([rows.features[:, j], tau[:, j]])])
        columns = np.arange(count * j, count * j + rows.features.shape[2])
        factors.append(Factor(joint, columns, R, len(tau)))

    def blocks() -> Iterator[RowBlock]:
        N, k, c = rows.features.shape
        W = np.zeros((N, k, k * c))
        for j in range(k):
            W[:, j, c * j : c * (j + 1)] = rows.features[:, j]
        yield W, tau

    # Values of single joints: each is identifiable by itself.
    every = np.eye(len(names))
    return Problem(
        parameters=names,
        base=BaseMap(every, np.arange(len(names)), names, np.inf, 0, np.ones(len(names))),
        rows=rows.joints,
        factors=tuple(factors),
        bodies=(),
        blocks=blocks,
        samples=len(tau),
        kinds=kinds,
        torque=np.sqrt(np.mean((tau + rows.links) ** 2, axis=0)),
        mean=np.mean(tau + rows.links, axis=0),
    )


DELAYS: Final = 1e-3 * np.arange(0.0, 21.0, 2.5)
"""s, of values that were published without one in seconds: the best on the judged samples."""

NEAR: Final = 1e-3
"""Share of the largest value of all joints within which one is on its bound of zero."""


@dataclass(frozen=True, eq=False)
class DriveSource:
    """Recordings of a robot with known links: `found` are the actuators of the training, whose
    delay the estimators are given. The values of an estimator that uses no data have the delay of
    DELAYS that fits the judged samples best, and the better sign of the bias of `published`
    ones."""

    training: Sequence[DrivePart]
    tests: Mapping[str, DrivePart]
    found: DriveEstimate
    published: PublishedDrives | None = None

    @property
    def warning(self) -> str:
        """Empty: recordings have no structure to compare their excitation with."""
        return ""

    def figures(self, problem: Problem, held_out: Mapping[str, Problem]) -> dict[str, Any]:
        """Rank and conditioning of the training data."""
        return data_figures(problem, {})

    def fields(self) -> Row:
        """Delay of the training with what it leaves open, and findings, as the field `log`."""
        apart, profile = self.found.separation, self.found.profile
        low, high = (self.found.delay,) * 2 if profile is None else profile.interval
        findings = dict.fromkeys(
            f"{part.name}: {finding.text}"
            for part in (*self.training, *self.tests.values())
            for finding in part.log.findings
        )
        return rollout_fields(self.position_baselines) | {
            "log": {
                "delay": self.found.delay,
                "delay_low": low,
                "delay_high": high,
                "delay_open": None if apart is None or apart.is_static else apart.open,
                "findings": "; ".join(findings),
            }
        }

    def score(
        self, prepared: ExperimentData["DriveSource"], method: Any, estimate: Estimate
    ) -> Row:
        """Torque errors, the error of the simulated positions of the tests, and all values."""
        scores = score_recorded(estimate, prepared.problem, prepared.held_out, prepared.figures)
        beta = base_parameters(estimate)
        if beta is None:
            return vars(scores)
        values = beta.reshape(-1, len(UNKNOWNS))
        scores = replace(scores, rollout_error=self._rollout(method, values))
        positions: Row = {}
        if scores.rollout_error is not None:
            beaten = self.position_baselines.beaten_by(scores.rollout_error)
            positions = {"beaten_by": ", ".join(beaten)}
        at_bound = values[:, :SIGNED] <= NEAR * values[:, :SIGNED].max(axis=0)
        table = [
            {
                "body": joint,
                "name": term,
                "true": None,
                "estimate": float(values[j, i]),
                "std": None,
                "identifiable": AT_BOUND if i < SIGNED and at_bound[j, i] else "identifiable",
                "expression": f"{joint}.{term}",
            }
            for j, joint in enumerate(self.found.rows.joints)
            for i, term in enumerate(UNKNOWNS)
        ]
        return vars(scores) | positions | {"parameters_table": table}

    @cached_property
    def position_baselines(self) -> Baselines:
        """Errors of positions without an identification."""
        return position_baselines(list(self.tests.values()), self.found, self.training).baselines

    def _rollout(self, method: Any, values: Array) -> float | None:
        """RMS error (rad, m) of the simulated positions of all tests; None of measured torques and
        of robots that are not simulated."""
        tests = [part for part in self.tests.values() if part.log.commands is not None]
        if not tests or missing_simulation(tests[0].robot):
            return None
        joints = self.found.rows.joints
        if getattr(method, "uses_data", True):
            return _error(tests, Drives(joints, values, self.found.delay))
        # Published values state neither delay nor the sign of bias.
        bias = np.zeros(len(joints)) if self.published is None else self.published.bias
        errors = []
        for sign in (-1.0, 1.0) if bias.any() else (1.0,):
            for delay in DELAYS:
                drives = Drives(joints, values, float(delay), {"bias": sign * bias})
                # A publication without a delay gets the best one: its values are judged, not what
                # it leaves out.
                with suppress(SimulationError):
                    errors.append(_error(tests, drives))
        return min(errors, default=None)


def _error(tests: Sequence[DrivePart], drives: Drives) -> float:
    """Raise SimulationError, with the values that no actuator has, where the robot diverges."""
    squares = []
    try:
        for part in tests:
            if part.log.commands is not None:
                commands = part.log.commands.of(drives.joints)
                squares.append(rollout_error(part.robot, drives, commands, part.rows) ** 2)
    except SimulationError as error:
        wrong = np.argwhere(drives.values[:, :SIGNED] < 0.0)
        names = [f"{drives.joints[j]}.{UNKNOWNS[i]}" for j, i in wrong]
        reason = f"; negative are {first_names(names)}" if names else ""
        raise SimulationError(f"The simulation with these values diverges{reason}.") from error
    return float(np.sqrt(np.mean(squares)))


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

    def rows_of(part: DrivePart) -> DriveRows:
        return drive_rows(part.robot, part.log, joints, part.rows)

    pooled = pooled_rows(list(map(rows_of, fits)))
    # The delay is found once, and given to all methods: they differ by their fit alone.
    found = identify_drives(pooled, delay=known_delay(fits))
    robot = fits[0].robot
    kinds = tuple(robot.torque_units[robot.torque_rows.index(joint)] for joint in joints)
    problem = drive_problem(found.rows, found.delay, kinds)
    values, published = _prior_values(prior, fits[0], logs[0], joints)
    if values is not None:
        # Prior around values (k, 4) of drives
        theta = values.ravel()
        # A value of zero is not known exactly: a deviation of zero would exclude all others.
        least = 1e-3 * np.tile(np.maximum(np.abs(values).max(axis=0), 1e-3), len(values))
        problem = replace(problem, prior=Prior(theta, np.maximum(WIDE * np.abs(theta), least)))
    test_rows = {name: rows_of(part) for name, part in judged.items()}
    held_out = {name: drive_problem(x, found.delay, kinds) for name, x in test_rows.items()}
    source = DriveSource(fits, judged, found, published)
    return ExperimentData(robot, problem, _experiment(problem, fits[0]), held_out, source)


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
    return model_values(part.robot, joints), None


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
