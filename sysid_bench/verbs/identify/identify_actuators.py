"""Identification of actuators from recordings of a robot with known links."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Final

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
from sysid_bench.apps.actuators.rollout import FITTED, missing_simulation
from sysid_bench.apps.actuators.settings_text import JointSettings, settings_text
from sysid_bench.errors import EstimationError, UnsupportedError, UsageError, unknown_name
from sysid_bench.evaluation.torque_errors import known_rms, rms
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array
from sysid_bench.verbs.identify.actuators_errors import DriveErrors, part_errors
from sysid_bench.verbs.identify.actuators_fields import (
    LIMITS,
    covariance_fields,
    delay_fields,
    file_fields,
    joint_fields,
    motor_fields,
)
from sysid_bench.verbs.identify.actuators_model import replay_warnings, write_actuators
from sysid_bench.verbs.identify.actuators_result import ActuatorsResult
from sysid_bench.verbs.identify.actuators_warnings import (
    base_warnings,
    delay_warnings,
    log_findings,
    rollout_warnings,
)
from sysid_bench.verbs.identify.identify_recorded import (
    RecordedRequest,
    log_summary,
    read_files,
    written_files,
)
from sysid_bench.verbs.identify.write_model import check_files, check_output_files

METHOD: Final = "bounded least squares"

LARGEST_GAIN: Final = 1e3
"""A torque further above that of the stated gains is not a matter of their values."""

_OTHERS: Final = (
    *("estimator", "terms", "pipeline", "complete", "filter", "derivatives", "moving"),
    *("choose", "position_given", "figure", "prior", "feasible"),
)
"""Options of an identification that bounded least squares of actuators does not have."""


def identify_actuators(request: RecordedRequest) -> ActuatorsResult:
    """Identify armature, friction, offset and, where it is unknown, the delay of commands.

    Raises UsageError for descriptions, files, names or options that cannot be used and for
    contradictions in the data that `accept` does not name, EstimationError for gains that are not
    positive.
    """
    _check_options(request)
    training, tests = log_summary(request)
    manifest = find_manifest(request.model, request.robots_dir)
    whole = load_robot(manifest)
    manifest = drive_manifest(manifest, [*training, *tests.values()])
    _check_targets(request, load_robot(manifest))
    check_output_files(written_files(request), None, read_files([*training, *tests.values()]))
    parts, judged = _parts(request, manifest, training, tests)
    joints = parts[0].log.joints
    _check_words(request.share, joints)
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
    if request.model_out is None:
        return result
    written = write_actuators(request.model_out, found, judged[0])
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
    request: RecordedRequest,
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


def _check_options(request: RecordedRequest) -> None:
    usual = {one.name: one.default for one in fields(request)}
    given = [
        f"--{name.replace('_', '-')}" for name in _OTHERS if getattr(request, name) != usual[name]
    ]
    if given:
        raise UsageError(
            f"{', '.join(given)}: not for the task {request.task!r}, which has its own bounded "
            "least squares and signals; leave it out, or use the task 'robot'."
        )


def _check_words(words: Sequence[str], joints: Sequence[str]) -> None:
    """Raise UsageError for a word of --share that no joint holds."""
    for word in words:
        if not any(holds(joint, word) for joint in joints):
            advice = "Give words that the names of joints hold, or patterns such as '*_knee'."
            raise unknown_name("word of --share", word, joints, advice)


def _more(request: RecordedRequest) -> tuple[str, ...]:
    """Further unknowns in the order of their columns; raise UsageError for an unknown name."""
    for name in request.also:
        if name not in MORE:
            raise unknown_name("unknown of --also", name, MORE)
    return tuple(name for name in MORE if name in request.also)


def _check_targets(request: RecordedRequest, robot: RobotModel) -> None:
    """Raise UsageError or UnsupportedError, before the fit, for files that cannot be written."""
    check_files(robot, request.task, request.model_out, request.json_out)
    reason = missing_simulation(robot)
    if request.model_out is not None and reason:
        raise UnsupportedError(
            f"--model-out: {reason}, so that a written file could not be checked; take the values "
            "from --json-out."
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
    request: RecordedRequest, manifest: Manifest, parts: Sequence[DrivePart], judged: DriveErrors
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
