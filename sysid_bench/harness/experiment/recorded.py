"""Recordings of a real robot made ready: one problem of all training logs, one of each test log.

Nothing here knows a truth. Joints that no log lists are locked, so that base parameters and rows
are those of what really moved.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.identifiability.base import base_map
from sysid_bench.identifiability.structural import structural_factor
from sysid_bench.identification.compressed import spread
from sysid_bench.identification.selection import FoldedRow, choose
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, is_term
from sysid_bench.models.payload import PAYLOADS, Payload, parse_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.task import asked_bodies
from sysid_bench.naming import build
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.features import JointFeatures, features_of
from sysid_bench.regressors.fold import triangle
from sysid_bench.signals.folds import parts_of
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.process import Processing
from sysid_bench.types import (
    Array,
    BaseMap,
    Body,
    Experiment,
    Factor,
    Problem,
    Recording,
    RowBlock,
    Trajectory,
)

FOLDS: Final = 5
"""Parts of a motion for cross-validation."""


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
    posing: "_Posing"
    training: tuple[Processed, ...]
    selection: "Selection | None" = None


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
    candidates: tuple[str, ...] = (),
    position_given: bool = False,
) -> Posed:
    """The problem of all training logs together, and one of each test log.

    `robot`: links and terms, with the payloads that the logs state taken as known. `payload`: the
    same and ten more of the load that some logs state and others do not carry. `candidates`: more
    joint terms, and features by name ("play"), of which cross-validation inside of the training
    logs chooses. `position_given`: of the load the mass alone is unknown, what the logs say of its
    centre of mass (and of its inertia per mass) is taken as known.
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
    ask = _Question(
        robot, loaded if task == "payload" else None, bodies, robot.term_columns(terms),
        training[0].log.joints, extra=(MASS,) if position_given else (), given=position_given,
    )  # fmt: skip
    selection = None
    if candidates:
        ask, selection = _selected(ask, candidates, training, treatment)
    base = ask.base()
    posing = _Posing(ask, base.names, treatment)
    problem = posing.pose(training, base)
    experiment = Experiment(
        problem,
        training[0].recording,
        training[0].log.recording,
        partial(_regress, posing),
        _no_simulation,
        _no_simulation,
    )
    posed = {name: posing.pose([test], base) for name, test in tests.items()}
    return Posed(robot, problem, posed, experiment, posing, tuple(training), selection)


def without_parts(posed: Posed, count: int = FOLDS) -> list[Problem]:
    """The training problem again and again, each time without one part of every motion: what
    estimates differ by when other stretches had been recorded."""
    parts = _parts(posed.posing, posed.training, count)
    return [
        replace(
            posed.problem,
            factors=tuple(
                _together([own for f in range(count) if f != part for own in parts[f][k]])
                for k in range(len(posed.problem.rows))
            ),
        )
        for part in range(count)
    ]


def _parts(
    posing: "_Posing", logs: Sequence[Processed], count: int
) -> list[list[tuple[Factor, ...]]]:
    """For each part and each joint the factors of all logs."""
    of_logs = [posing.factors(log, parts_of(log.recording.motion, count)[0], count) for log in logs]
    rows = range(len(posing.ask.rows))
    return [[tuple(own[f][k] for own in of_logs) for k in rows] for f in range(count)]


@dataclass(frozen=True)
class Selection:
    """What cross-validation added: the error (mean relative, on left-out parts) before, and after
    each column; how the parts were made."""

    added: tuple[tuple[str, float], ...]
    error_before: float
    error_after: float
    parts: str


@dataclass(frozen=True, eq=False)
class _Question:
    """What is unknown: `inertial` parameters of the robot and its joint `terms`, those of the load
    where `loaded` carries an unknown one, and `extra` columns of `features`; `rows`: the joints
    that were recorded."""

    robot: RobotModel
    loaded: RobotModel | None
    inertial: tuple[str, ...]
    terms: tuple[str, ...]
    rows: tuple[str, ...]
    features: JointFeatures | None = None
    extra: tuple[str, ...] = ()
    given: bool = False  # the load's shape is, and its mass one of the extra columns

    @property
    def own(self) -> tuple[str, ...]:
        """Parameters of the robot itself."""
        return self.inertial + self.terms

    @property
    def load(self) -> tuple[str, ...]:
        """Names of the load's ten parameters, or none."""
        if self.loaded is None or self.loaded.payload_body is None or self.given:
            return ()
        return self.loaded.bodies[self.loaded.payload_body].columns

    @property
    def parameters(self) -> tuple[str, ...]:
        """All unknowns (p,)."""
        return self.own + self.load + self.extra

    def base(self) -> BaseMap:
        """The base parameters; extra columns stand for themselves."""
        base = base_map(self.structure(), self.own + self.load)
        if not self.extra:
            return base
        r, p, k = base.rank, len(base.parameters), len(self.extra)
        K = np.zeros((r + k, p + k))
        K[:r, :p], K[r:, p:] = base.K, np.eye(k)
        return replace(
            base, row_space=None, K=K, pivots=np.append(base.pivots, np.arange(p, p + k)),
            parameters=self.parameters,
        )  # fmt: skip

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies whose ten numbers are unknown."""
        if self.loaded is None or self.loaded.payload_body is None or self.given:
            return asked_bodies(self.robot)
        return (*asked_bodies(self.robot), self.loaded.bodies[self.loaded.payload_body])

    def structure(self) -> Array:
        """R (m, p) over random states with and, where there is one, without the load."""
        bare = structural_factor(self.robot, self.own, self.rows)
        if self.loaded is None:
            return bare
        carried = structural_factor(self.loaded, self.own + self.load, self.rows)
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
            # Motions of several logs differ: their spread is more than that of the noise.
            period=logs[0].recording.motion.period_samples if len(logs) == 1 else 0,
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
        (factors,) = self.factors(log, np.zeros(len(log.recording), dtype=int), 1)
        return factors

    def factors(self, log: Processed, labels: Array, count: int) -> list[list[Factor]]:
        """For each label 0 ... count - 1 the factors of all joints at samples that have it (N,),
        in one pass over the motion."""
        columns, places = self.regression(log)
        motion, tau = log.recording.motion, self.torque(log)
        at = [columns.rows.index(row) for row in self.ask.rows]
        extra = [self.extra(log, row) for row in self.ask.rows]
        moving = [self.moving(log, row) for row in self.ask.rows]
        widths = [len(columns.touched[i]) + len(x[1]) + 1 for i, x in zip(at, extra, strict=True)]
        Rs = [[np.zeros((0, width)) for width in widths] for _ in range(count)]
        for block in columns.blocks(motion):
            part = block.samples
            for k, i in enumerate(at):
                both = np.column_stack([block.row(i).T, extra[k][0][part], tau[part, i]])
                for label in range(count):
                    chosen = moving[k][part] & (labels[part] == label)
                    if chosen.any():
                        Rs[label][k] = triangle([Rs[label][k], both[chosen]])
        touched = [
            np.concatenate([places[columns.touched[i]], own])
            for i, (_, own) in zip(at, extra, strict=True)
        ]
        return [
            [
                Factor(row, touched[k], Rs[label][k], int((moving[k] & (labels == label)).sum()))
                for k, row in enumerate(self.ask.rows)
            ]
            for label in range(count)
        ]

    def extra(self, log: Processed, row: str) -> tuple[Array, Array]:
        """Feature columns (N, k) of one joint, and their places among all."""
        names = [name for name in self.ask.extra if name.rpartition(".")[0] == row]
        values = np.zeros((len(log.recording), 0))
        if names and self.ask.features is not None:
            values = self.ask.features.of_joint(row, log.recording.motion, names)
        if self.ask.given and log.payload:
            i = log.robot.torque_rows.index(row)
            values = np.column_stack([values, _torque_of_a_kilogram(log)[:, i]])
            names = [*names, MASS]
        return values, np.array([self.columns.index(name) for name in names], dtype=int)

    def moving(self, log: Processed, row: str) -> Array:
        """Samples (N,) at which a joint moves fast enough."""
        v = log.recording.motion.v[:, log.robot.rows.index(row)]
        return np.abs(v) >= self.treatment.moving


MASS: Final = "payload.m"
"""The load's mass where it is its only unknown."""

WIDTHS: Final = (0.003, 0.01, 0.03)
"""Shares of a joint's reach that play may have: backlash of cables is of this order."""

SCALES: Final = (0.01, 0.05)
"""rad/s, m/s, below which Coulomb friction may be smooth."""


def _features(names: Sequence[str]) -> list[Any]:
    """The features that candidates name, in several widths where they have one."""
    found: list[Any] = []
    for name in names:
        if name == "play":
            found += [build("term", {"use": name, "width": width}) for width in WIDTHS]
        elif name == "tanh":
            found += [build("term", {"use": name, "scale": scale}) for scale in SCALES]
        else:
            found.append(build("term", name))
    return found


def _selected(
    ask: _Question,
    candidates: tuple[str, ...],
    training: Sequence[Processed],
    treatment: Treatment,
) -> tuple[_Question, Selection]:
    """The question with the candidates that predict parts of the training motion left out of it.

    Parts are stretches of the period where the motion repeats itself, of time otherwise: what is
    left out is never seen at another time.
    """
    robot = ask.robot
    terms = [name for name in candidates if is_term(name)]
    more = [c for c in robot.term_columns(tuple(terms)) if c.split(".")[0] in ask.rows]
    features = _features([name for name in candidates if name not in terms])
    joints = {dof: (joint.qadr, joint.vadr) for joint in robot.joints for dof in joint.dofs}
    motions = [log.recording.motion for log in training]
    table = features_of(features, ask.rows, [joints[row] for row in ask.rows], motions)
    wide = replace(
        ask,
        terms=tuple(dict.fromkeys([*ask.terms, *more])),
        features=table,
        extra=(*ask.extra, *table.columns),
    )
    names = wide.base().names
    posing = _Posing(wide, names, treatment)
    parts = [
        [triangle(spread(factor, len(names)) for factor in own) for own in part]
        for part in _parts(posing, training, FOLDS)
    ]
    folds = [
        [
            FoldedRow(
                triangle(parts[other][k] for other in range(FOLDS) if other != f), parts[f][k]
            )
            for k in range(len(ask.rows))
        ]
        for f in range(FOLDS)
    ]
    known = set(ask.inertial) | set(ask.terms) | set(ask.load) | set(ask.extra)
    start = [i for i, name in enumerate(names) if name in known]
    found = [
        (ask.rows.index(row), i)
        for i, name in enumerate(names)
        if name not in known and (row := name.partition(".")[0]) in ask.rows
    ]
    choice = choose(folds, start, found)
    added = {names[i] for i in choice.columns} - known
    selection = Selection(
        tuple((names[i], error) for i, error in choice.steps),
        choice.error_before,
        choice.error_after,
        parts_of(motions[0], FOLDS)[1],
    )
    chosen = replace(
        ask,
        terms=(*ask.terms, *(name for name in more if name in added)),
        features=table,
        extra=(*ask.extra, *(name for name in table.columns if name in added)),
    )
    return chosen, selection


def _torque_of_a_kilogram(log: Processed) -> Array:
    """Torque (N, n) of the log's payload per kg."""
    body = log.robot.payload_body
    assert body is not None
    columns = torque_regression(log.robot, log.robot.bodies[body].columns)
    return columns.torque(log.recording.motion, log.robot.phi[body] / log.payload.mass)


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
        features = [posing.extra(log, row) for row in posing.ask.rows]
        for block in columns.blocks(motion):
            W = np.zeros((block.count, len(at), len(posing.columns)))
            W[:, :, places] = block.dense()[:, at]
            for i, (values, own) in enumerate(features):
                W[:, i, own] = values[block.samples]
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
        for i, row in enumerate(posing.ask.rows):
            names = [name for name in posing.ask.extra if name.rpartition(".")[0] == row]
            if names and posing.ask.features is not None:
                values = posing.ask.features.of_joint(row, motion, names)
                own = [posing.columns.index(name) for name in names]
                W[:, i, own] = values[block.samples]
        yield W


def _no_simulation(asked: Any) -> Any:
    raise UnsupportedError("This recording declares no controller: nothing to simulate with.")


def predicted(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Measured and predicted torque (N, rows) of a problem's rows."""
    pairs = [(b, W @ beta) for W, b in problem.blocks()]
    return np.concatenate([b for b, _ in pairs]), np.concatenate([w for _, w in pairs])
