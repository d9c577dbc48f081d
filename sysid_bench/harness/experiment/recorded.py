"""Recordings of a real robot made ready: one problem of all training logs, one of each test log.

Nothing here knows a truth. Joints that no log lists are locked, so that base parameters and rows
are those of what really moved.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.identifiability.base import base_map
from sysid_bench.identifiability.structural import structural_factor
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import PAYLOADS, Payload, parse_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.task import asked_bodies
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.fold import fold, triangle
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.process import Processing
from sysid_bench.types import (
    Array,
    Body,
    Experiment,
    Factor,
    Problem,
    Recording,
    RowBlock,
    Trajectory,
)


@dataclass(frozen=True)
class Treatment:
    """What is done to every log alike: `processing` makes motion and torque; rows whose joint moves
    slower than `moving` (rad/s, m/s) are left out, as static friction is no model's business."""

    processing: Processing
    moving: float = 0.0
    filter: str = ""  # as written
    derivatives: str = ""


@dataclass(frozen=True, eq=False)
class Processed:
    """A log after its treatment, with the robot that carried what it carried."""

    log: Log
    robot: RobotModel
    recording: Recording

    @property
    def payload(self) -> Payload:
        """What was mounted."""
        return self.robot.payload


@dataclass(frozen=True, eq=False)
class Posed:
    """All that methods and scores need of some logs."""

    robot: RobotModel
    problem: Problem
    tests: dict[str, Problem]
    experiment: Experiment


def locked_manifest(
    manifest: Manifest, robot: RobotModel, logs: Sequence[LogDescription]
) -> Manifest:
    """The manifest with every joint locked that the logs do not list and that follows none of them.

    Raises UsageError where the logs differ in their joints or in where the others stand.
    """
    first = logs[0]
    moving = {joint for joint in first.joints if joint != NO_JOINT}
    for log in logs[1:]:
        if {joint for joint in log.joints if joint != NO_JOINT} != moving:
            raise UsageError(
                f"{log.source} lists other joints than {first.source}; logs that are used together "
                "have to move the same ones."
            )
        if dict(log.locked or {}) != dict(first.locked or {}):
            raise UsageError(
                f"{log.source} locks joints elsewhere than {first.source}; identify them apart."
            )
    followers = moving | _followers(robot, moving, first)
    stand = {j.name: 0.0 for j in robot.joints if not followers.intersection(j.dofs)}
    for joint in robot.joints:
        if joint.name in stand and joint.kind in ("hinge", "slide"):
            stand[joint.name] = float(robot.mj.qpos0[joint.qadr])
    for name, position in (first.locked or {}).items():
        if name not in stand:
            known = ", ".join(stand) or "none"
            raise UsageError(
                f"{first.source}: locked names {name!r}, which is recorded or does not exist; "
                f"joints that stand still are: {known}."
            )
        stand[name] = position
    return replace(manifest, locked={**manifest.locked, **stand})


def _followers(robot: RobotModel, moving: set[str], log: LogDescription) -> set[str]:
    """The joints that follow the moving ones; UsageError for a moving one that follows others."""
    if robot.coupling is None:
        return set()
    coupling, rows = robot.coupling, robot.rows
    dependent = {rows[dof]: int(dof) for dof in coupling.dependent}
    wrong = sorted(moving.intersection(dependent))
    if wrong:
        drivers = [rows[dof] for dof in coupling.drivers(dependent[wrong[0]])]
        raise UsageError(
            f"{log.source}: joint {wrong[0]!r} follows {', '.join(drivers)}; list that one in its "
            "place, or choose the joints that move in a manifest: [coupling] independent = [...]."
        )
    return {
        name
        for name, dof in dependent.items()
        if moving.intersection(rows[driver] for driver in coupling.drivers(dof))
    }


def processed(log: LogDescription, manifest: Manifest, treatment: Treatment) -> Processed:
    """A log read and treated; its contradictions are still to be refused."""
    payload = PAYLOADS["none"] if log.payload is None else parse_payload(_payload_of(log))
    robot = load_robot(manifest, payload)
    read = read_log(log, robot)
    recording = treatment.processing.apply(read.recording, robot.joints)
    motion = robot.completed(recording.motion)
    return Processed(read, robot, replace(recording, q=motion.q, v=motion.v, a=motion.a))


def _payload_of(log: LogDescription) -> Any:
    """A payload as parse_payload reads it; { use = "box-2kg" } is its name."""
    written = log.payload
    if isinstance(written, Mapping) and set(written) == {"use"}:
        return written["use"]
    return written


def pose_logs(
    task: str,
    terms: tuple[str, ...],
    training: Sequence[Processed],
    tests: Mapping[str, Processed],
    treatment: Treatment,
) -> Posed:
    """The problem of all training logs together, and one of each test log.

    `robot`: links and terms, with the payloads that the logs state taken as known. `payload`: the
    same and ten more of the load that some logs state and others do not carry.
    """
    if task not in ("robot", "payload"):
        raise UnsupportedError(
            f"The task {task!r} needs a robot that is known; with recordings there are 'robot' and "
            "'payload'."
        )
    unloaded = next((p.robot for p in training if not p.payload), None)
    loaded = next((p.robot for p in training if p.payload), None)
    if task == "payload" and (unloaded is None or loaded is None):
        raise UsageError(
            "The task 'payload' compares recordings with and without the load: give one --log of "
            "each, and the loaded one a payload."
        )
    robot = load_robot(training[0].robot.manifest) if unloaded is None else unloaded
    bodies = tuple(column for body in asked_bodies(robot) for column in body.columns)
    own = bodies + robot.term_columns(terms)
    ask = _Question(robot, loaded if task == "payload" else None, own, training[0].log.joints)
    base = base_map(ask.structure(), ask.parameters)
    posing = _Posing(ask, base.names, treatment)
    problem = posing.pose(training, base)
    experiment = Experiment(
        problem,
        training[0].recording,
        training[0].log.recording,
        partial(_regress, posing),
        _no_simulation,
    )
    posed = {name: posing.pose([test], base) for name, test in tests.items()}
    return Posed(robot, problem, posed, experiment)


@dataclass(frozen=True, eq=False)
class _Question:
    """What is unknown: `own` parameters of the robot, and those of the load where `loaded` carries
    an unknown one; `rows`: the joints that were recorded."""

    robot: RobotModel
    loaded: RobotModel | None
    own: tuple[str, ...]
    rows: tuple[str, ...]

    @property
    def load(self) -> tuple[str, ...]:
        """Names of the load's ten parameters, or none."""
        if self.loaded is None or self.loaded.payload_body is None:
            return ()
        return self.loaded.bodies[self.loaded.payload_body].columns

    @property
    def parameters(self) -> tuple[str, ...]:
        """All unknowns (p,)."""
        return self.own + self.load

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies whose ten numbers are unknown."""
        if self.loaded is None or self.loaded.payload_body is None:
            return asked_bodies(self.robot)
        return (*asked_bodies(self.robot), self.loaded.bodies[self.loaded.payload_body])

    def structure(self) -> Array:
        """R (m, p) over random states with and, where there is one, without the load."""
        bare = structural_factor(self.robot, self.own, self.rows)
        if self.loaded is None:
            return bare
        carried = structural_factor(self.loaded, self.parameters, self.rows)
        return triangle([np.pad(bare, ((0, 0), (0, len(self.load)))), carried])


@dataclass(frozen=True, eq=False)
class _Posing:
    """Logs become problems in the base parameters named `columns`."""

    ask: _Question
    columns: tuple[str, ...]
    treatment: Treatment

    def pose(self, logs: Sequence[Processed], base: Any) -> Problem:
        """W beta = b of all rows of some logs."""
        rows = self.ask.rows
        names = self.ask.robot.torque_rows
        kinds = tuple(self.ask.robot.torque_kinds[names.index(row)] for row in rows)
        parts = [self._factors(log) for log in logs]
        factors = tuple(_together(own) for own in zip(*parts, strict=True))
        return Problem(
            parameters=self.ask.parameters,
            base=base,
            rows=rows,
            factors=factors,
            bodies=self.ask.bodies,
            blocks=partial(_blocks, self, tuple(logs)),
            samples=sum(len(log.recording) for log in logs),
            kinds=kinds,
        )

    def regression(self, log: Processed) -> tuple[AnyRegression, Array]:
        """The regression of the columns that a log knows, and their places among all (k,)."""
        known = set(self.ask.own) | (set(self.ask.load) if log.payload else set())
        places = [i for i, name in enumerate(self.columns) if name in known]
        robot = log.robot if self.ask.loaded is not None and log.payload else self.ask.robot
        return torque_regression(robot, [self.columns[i] for i in places]), np.array(places)

    def torque(self, log: Processed) -> Array:
        """Measured torque (N, n) less that of a known payload."""
        tau, load = log.recording.tau, log.robot.payload_body
        if load is None or self.ask.loaded is not None:
            return tau
        columns = torque_regression(log.robot, log.robot.bodies[load].columns)
        return tau - columns.torque(log.recording.motion, log.robot.phi[load])

    def _factors(self, log: Processed) -> list[Factor]:
        columns, places = self.regression(log)
        tau, motion = self.torque(log), log.recording.motion
        found = []
        for row in self.ask.rows:
            i = columns.rows.index(row)
            moving = self.moving(log, row)
            (factor,) = fold(columns, _at(motion, moving), tau[moving], [i])
            found.append(replace(factor, columns=places[factor.columns]))
        return found

    def moving(self, log: Processed, row: str) -> Array:
        """Samples (N,) at which a joint moves fast enough."""
        v = log.recording.motion.v[:, log.robot.rows.index(row)]
        return np.abs(v) >= self.treatment.moving


def _at(motion: Trajectory, chosen: Array) -> Trajectory:
    if chosen.all():
        return motion
    return replace(
        motion, t=motion.t[chosen], q=motion.q[chosen], v=motion.v[chosen], a=motion.a[chosen]
    )


def _together(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several logs, which may touch different columns."""
    if len(factors) == 1:
        return factors[0]
    columns = np.unique(np.concatenate([factor.columns for factor in factors]))
    wide = []
    for factor in factors:
        R = np.zeros((len(factor.R), len(columns) + 1))
        R[:, np.searchsorted(columns, factor.columns)] = factor.R[:, :-1]
        R[:, -1] = factor.R[:, -1]
        wide.append(R)
    return Factor(factors[0].row, columns, triangle(wide), sum(f.samples for f in factors))


def _blocks(posing: _Posing, logs: tuple[Processed, ...]) -> Iterator[RowBlock]:
    """The rows themselves; those of joints that hardly move are zero."""
    for log in logs:
        columns, places = posing.regression(log)
        tau, motion = posing.torque(log), log.recording.motion
        at = [columns.rows.index(row) for row in posing.ask.rows]
        moving = np.stack([posing.moving(log, row) for row in posing.ask.rows], axis=1)
        for block in columns.blocks(motion):
            W = np.zeros((block.count, len(at), len(posing.columns)))
            W[:, :, places] = block.dense()[:, at]
            kept = moving[block.samples]
            yield W * kept[:, :, None], tau[block.samples][:, at] * kept


def _regress(posing: _Posing, motion: Trajectory) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion of the unloaded robot."""
    known = [i for i, name in enumerate(posing.columns) if name in posing.ask.own]
    columns = torque_regression(posing.ask.robot, [posing.columns[i] for i in known])
    at = [columns.rows.index(row) for row in posing.ask.rows]
    for block in columns.blocks(motion):
        W = np.zeros((block.count, len(at), len(posing.columns)))
        W[:, :, known] = block.dense()[:, at]
        yield W


def _no_simulation(theta: Array) -> Recording:
    raise UnsupportedError("This recording declares no controller: nothing to simulate with.")


def predicted(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Measured and predicted torque (N, rows) of a problem's rows."""
    pairs = [(b, W @ beta) for W, b in problem.blocks()]
    return np.concatenate([b for b, _ in pairs]), np.concatenate([w for _, w in pairs])
