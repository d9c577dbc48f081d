"""Identification of actuators from recordings of a robot with known links."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import holds
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate, identify_recordings
from sysid_bench.apps.actuators.drive_part import (
    DrivePart,
    drive_manifest,
    known_delay,
    read_part,
)
from sysid_bench.apps.actuators.drive_rows import (
    MORE,
    UNKNOWNS,
    DriveRows,
    drive_rows,
    pooled_rows,
)
from sysid_bench.apps.actuators.rollout import FITTED, missing_simulation, simulated_positions
from sysid_bench.apps.actuators.written_model import (
    JointSettings,
    largest_difference,
    replay_positions,
    settings_text,
    written_mjcf,
)
from sysid_bench.commands.actuators_result import (
    LIMITS,
    ActuatorsResult,
    covariance_fields,
    delay_fields,
    file_fields,
    joint_fields,
    motor_fields,
)
from sysid_bench.commands.identify import Identify
from sysid_bench.commands.identify_recorded import (
    log_summary,
    read_files,
)
from sysid_bench.commands.result import file_text
from sysid_bench.commands.write_model import check_files, check_output_files
from sysid_bench.errors import EstimationError, UnsupportedError, UsageError, unknown_name
from sysid_bench.evaluation.torque_errors import known_rms, loaded_joints, rms
from sysid_bench.experiments.recorded.model_prior import MODEL
from sysid_bench.experiments.recorded.prepare import TERMS_TOO
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_samples import scalar_kinds
from sysid_bench.signals.position_control import DELAY
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class DriveErrors:
    """Errors (k,) of identified actuators on parts that were not fitted."""

    found: DriveEstimate
    parts: Sequence[DrivePart]

    @property
    def reason(self) -> str:
        """Reason for which the robot is not simulated; empty if it is."""
        return missing_simulation(self.parts[0].robot)

    @cached_property
    def position_errors(self) -> list[Array]:
        """Squared errors (n, k) of the simulated positions of each part; none of a measured torque,
        whose commands are not known, and of robots that are not simulated."""
        if self.reason:
            return []
        joints = self.found.rows.joints
        return [
            (simulated_positions(part.robot, self.found.drives, commands, part.rows)
             - commands.q[part.rows]) ** 2
            for part in self.parts
            if part.log.commands is not None
            for commands in [part.log.commands.of(joints)]
        ]  # fmt: skip

    @cached_property
    def torque_rms(self) -> tuple[Array, Array]:
        """RMS of the torque, filtered, and of its error (k,)."""
        of = self.found.rows
        rows = pooled_rows([
            drive_rows(p.robot, p.log, of.joints, p.rows, of.more, of.bias) for p in self.parts
        ])  # fmt: skip
        tau = rows.torque(self.found.delay)
        error = tau - np.einsum("nkc,kc->nk", rows.features, self.found.fit.factors)
        return _rms(tau + rows.links), _rms(error)

    @cached_property
    def torque_ratio(self) -> Array:
        """RMS error of the torque over its RMS (k,); NaN for joints with hardly any torque."""
        robot, (torque, error) = self.parts[0].robot, self.torque_rms
        kind = scalar_kinds(robot)
        loaded = loaded_joints(torque, [kind[name] for name in self.found.rows.joints])
        return np.asarray(np.divide(error, torque, out=np.full_like(error, np.nan), where=loaded))


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def part_errors(judged: DriveErrors) -> list[dict[str, Any]]:
    """Return recording, first and last time (s) and RMS error (rad, m) of each simulated part."""
    parts = [part for part in judged.parts if part.log.commands is not None and not judged.reason]
    return [
        {
            "log": part.name,
            "from": part.times[0],
            "to": part.times[1],
            "rollout": float(np.sqrt(squares.mean())),
        }
        for part, squares in zip(parts, judged.position_errors, strict=True)
    ]


def base_warnings(robot: RobotModel, log: LogDescription) -> list[str]:
    """Sentence about a floating base, with or without its recorded motion."""
    if log.base is not None:
        return ["the base moves as recorded: feet must not touch the ground"]
    if not robot.floating:
        return []
    return ["the base is held fixed: feet must not touch the ground, and the trunk must not move"]


def rollout_warnings(judged: DriveErrors) -> list[str]:
    """Sentence about a robot whose values are not judged by a simulation."""
    return [f"no rollout: {judged.reason}"] if judged.reason else []


def delay_warnings(found: DriveEstimate) -> list[str]:
    """Sentence about a delay at the end of those that were tried."""
    if found.profile is None:
        return []
    if found.profile.ahead:
        return [
            "a delay below zero would fit better: q_des is stamped later than it acts; check its "
            "times"
        ]
    if not found.profile.on_edge:
        return []
    return [
        f"the delay is the longest that was tried, {1e3 * found.delay:.3g} ms: check the times of "
        "q_des, or state a delay"
    ]


def log_findings(parts: Sequence[DrivePart]) -> list[str]:
    """Repairs of the model, and findings in the recordings, but for the delay that is found."""
    found = [
        f"{part.name}: {one.text}"
        for part in parts
        for one in part.log.findings
        if one.name != DELAY
    ]
    return list(dict.fromkeys([*parts[0].robot.repairs, *found]))


REPEATED: Final = 1e-6
"""rad, m; a written file whose simulated positions differ by more is not the identified robot."""


def write_actuators(target: Path, found: DriveEstimate, judged: DrivePart) -> dict[str, Any]:
    """Write the model, read it again by MuJoCo alone, and repeat the judged simulation.

    Raises UsageError where the torque was measured, so that gains are not known.
    """
    commands = judged.log.commands
    if commands is None:
        raise UsageError(
            "A model with position actuators needs their gains: describe the torque by tau = { pd "
            "= { q_des = ..., kp = ..., kd = ... } }, or use the values of --json."
        )
    commands = commands.of(found.rows.joints)
    text = written_mjcf(judged.robot, found.drives, commands)
    target.write_text(text, encoding="utf-8")
    written: dict[str, Any] = {"file": str(target), "gap": None, "reason": _no_replay(judged.robot)}
    if not written["reason"]:
        again = replay_positions(target, found.drives.apply(commands), judged.rows)
        simulated = simulated_positions(judged.robot, found.drives, commands, judged.rows)
        bias = found.drives.more.get("bias", np.zeros(len(commands.joints)))
        written["gap"] = largest_difference(again, simulated + bias)
    return {"model_out": file_text(target), "written": written}


def _no_replay(robot: RobotModel) -> str:
    """Reason for which a written file is not the robot that was simulated; empty if it is."""
    if robot.manifest.locked:
        return "joints are locked"
    if robot.manifest.free_base:
        return "the file may hold the base"
    return "" if robot.payload_body is None else "the file has no payload"


def replay_warnings(written: Mapping[str, Any]) -> list[str]:
    """Sentence about a written file that does not repeat the simulation."""
    gap = written["gap"]
    if gap is None or gap <= REPEATED:
        return []
    return [
        f"{written['file']} does not repeat the simulation: positions differ by up to {gap:.1e} "
        "rad (m); other actuators, tendons or options of the file may act"
    ]


METHOD: Final = "bounded least squares"

LARGEST_GAIN: Final = 1e3
"""A torque further above that of the stated gains is not a matter of their values."""

_OTHERS: Final = (
    *("estimator", "terms", "pipeline", "complete", "filter", "derivatives", "moving"),
    *("choose", "position_given", "figure", "prior", "feasible"),
)
"""Options of an identification that bounded least squares of actuators does not have."""


def identify_actuators(request: Identify) -> ActuatorsResult:
    """Identify armature, friction, offset and, where it is unknown, the delay of commands.

    Raises UsageError for descriptions, files, names or options that cannot be used and for
    contradictions in the data that `accept` does not name, EstimationError for gains that are not
    positive.
    """
    _check_options(request)
    training, tests = log_summary(request)
    manifest = find_manifest(str(request.model), request.robots_dir)
    whole = load_robot(manifest)
    manifest = drive_manifest(manifest, [*training, *tests.values()])
    _check_targets(request, load_robot(manifest))
    check_output_files(request.files, None, read_files([*training, *tests.values()]))
    parts, judged = _parts(request, manifest, training, tests)
    joints = parts[0].log.joints
    for word in request.share:
        if not any(holds(joint, word) for joint in joints):
            advice = "Give words that the names of joints hold, or patterns such as '*_knee'."
            raise unknown_name("word of --share", word, joints, advice)
    delay, more = known_delay(parts), _more(request)

    def single_rows(bias: Array | None) -> list[DriveRows]:
        return [drive_rows(p.robot, p.log, joints, p.rows, more, bias) for p in parts]

    found = identify_recordings(lambda b: pooled_rows(single_rows(b)), request.share, delay)
    _check_gains(found)
    singles = single_rows(found.rows.bias) if len(parts) > 1 else []
    result = _result(request, manifest, parts, DriveErrors(found, judged))
    result = replace(result, warnings=[*base_warnings(whole, training[0]), *result.warnings])
    result = replace(result, **file_fields(singles, request.share, delay, result.joints))
    result = replace(result, configurations=_configurations(result, judged[0]))
    model_out = request.files[0]
    if model_out is None:
        return result
    written = write_actuators(model_out, found, judged[0])
    doubts = replay_warnings(written["written"])
    return replace(result, **written, warnings=[*result.warnings, *doubts])


def _check_gains(found: DriveEstimate) -> None:
    """Raise EstimationError for gains of no drive: a drive pulls towards its command, by a torque
    that is not far larger than the stated one."""
    gains = found.other_values.get("gain", np.ones(len(found.rows.joints)))
    wrong = [
        f"{joint} {gain:.3g}"
        for joint, gain in zip(found.rows.joints, gains, strict=True)
        if not 0.0 < gain < LARGEST_GAIN
    ]
    if wrong:
        raise EstimationError(
            f"--also gain: the gains that fit are not those of a drive ({', '.join(wrong)}): these "
            "torques do not follow from the stated commands, kp and kd. Leave gain out, share it "
            "between joints (--share), or check the signs of q and q_des."
        )


def _parts(
    request: Identify,
    manifest: Manifest,
    training: Sequence[LogDescription],
    tests: Mapping[str, LogDescription],
) -> tuple[list[DrivePart], list[DrivePart]]:
    """Parts of the recordings to fit and to judge on; without tests the end of those fitted."""
    logs = [read_part(log, manifest, request.accept) for log in training]
    others = [read_part(log, manifest, request.accept) for log in tests.values()]
    share = 1.0 if others else FITTED
    return (
        [part.fit_part(share) for part in logs],
        [part.test_part(share) for part in (others or logs)],
    )


def _check_options(request: Identify) -> None:
    usual: dict[str, list[Any]] = {one.name: [one.default, []] for one in fields(request)}
    usual["prior"] += [MODEL]
    usual["feasible"] += [TERMS_TOO]
    given = [
        f"--{name.replace('_', '-')}"
        for name in _OTHERS
        if getattr(request, name) not in usual[name]
    ]
    if given:
        raise UsageError(
            f"{', '.join(given)}: not for the task {request.task!r}, which has its own bounded "
            "least squares and signals; leave it out, or use the task 'robot'."
        )


def _more(request: Identify) -> tuple[str, ...]:
    """Further unknowns in the order of their columns; raise UsageError for an unknown name."""
    for name in request.also:
        if name not in MORE:
            raise unknown_name("unknown of --also", name, MORE)
    return tuple(name for name in MORE if name in request.also)


def _check_targets(request: Identify, robot: RobotModel) -> None:
    """Raise UsageError or UnsupportedError, before the fit, for files that cannot be written."""
    check_files(robot, request.task, *request.files[:2])
    reason = missing_simulation(robot)
    if request.model_out is not None and reason:
        raise UnsupportedError(
            f"--model-out: {reason}, so that a written file could not be checked; take the values "
            "from --json."
        )


def _configurations(result: ActuatorsResult, part: DrivePart) -> dict[str, str]:
    """Configurations of simulators for the gains of the last sample; none of a measured torque."""
    commands = part.log.commands
    if commands is None:
        return {}
    commands = commands.of(result.rows)
    settings = {
        name: JointSettings(
            kp=joint.get("gain", 1.0) * float(commands.kp[-1, j]),
            kd=joint.get("gain", 1.0) * float(commands.kd[-1, j]),
            limit=float(commands.limit[j]),
            armature=joint["Ia"],
            damping=joint["fv"],
            friction=joint["fc"],
        )
        for j, (name, joint) in enumerate(result.joints.items())
    }
    low, high = _delay_range(result)
    return settings_text(settings, (max(low, 0.0), max(high, 0.0)))


def _delay_range(result: ActuatorsResult) -> tuple[float, float]:
    """Lowest and highest delay (s), between files where these give the deviations."""
    if result.std_from == "files" and result.files is not None:
        return result.files["delay"]["low"], result.files["delay"]["high"]
    low, high = result.delay_interval or (result.delay, result.delay)
    return low, high


def _result(
    request: Identify, manifest: Manifest, parts: Sequence[DrivePart], judged: DriveErrors
) -> ActuatorsResult:
    found = judged.found
    error = judged.torque_rms[1]
    rollouts = judged.position_errors
    names = list(found.rows.joints)
    pooled = np.concatenate(rollouts) if rollouts else None
    return ActuatorsResult(
        model=manifest.name,
        file=str(manifest.path),
        task=request.task,
        terms=[*UNKNOWNS, *found.rows.more],
        rows=names,
        estimator=METHOD,
        rank=found.rank,
        data_rank=None,
        parameters=found.parameters,
        rmse_train=rms(found.fit.errors),
        rmse_test=rms(error),
        torque_error=known_rms(x if np.isfinite(x) else None for x in judged.torque_ratio.tolist()),
        rollout_error=None if pooled is None else float(np.sqrt(pooled.mean())),
        **delay_fields(found),
        joints=joint_fields(found, pooled, judged.torque_ratio),
        covariance=covariance_fields(names, found.covariance),
        configurations={},
        shared=list(request.share),
        files=None,
        judged=part_errors(judged),
        seconds=sum(part.times[1] - part.times[0] for part in parts),
        std_from="residuals",
        std_limit=LIMITS["residuals"],
        motors=motor_fields(parts[0].log, found) or None,
        warnings=[*log_findings(parts), *rollout_warnings(judged), *delay_warnings(found)],
    )
