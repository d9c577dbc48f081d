"""Identification of actuators from recordings of a robot with known links, and what their fit says
of the time of commands."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import holds
from sysid_bench.apps.actuators.commands.actuators_result import (
    ActuatorsResult,
    baseline_scores,
    delay_fields,
    joint_fields,
    judged_result,
    motor_fields,
)
from sysid_bench.apps.actuators.commands.file_ranges import LIMITS, covariance_fields, file_fields
from sysid_bench.apps.actuators.commands.servo_result import (
    gain_fields,
    limit_fields,
    lost_motion_fields,
    magnitude_fields,
    resolution_fields,
)
from sysid_bench.apps.actuators.drive_estimate import (
    DriveEstimate,
    identify_drives,
    identify_recordings,
)
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
    model_values,
    pooled_rows,
)
from sysid_bench.apps.actuators.gain_profile import stated_gains
from sysid_bench.apps.actuators.position_baselines import PositionBaselines, position_baselines
from sysid_bench.apps.actuators.rollout import FITTED, missing_simulation, simulated_positions
from sysid_bench.apps.actuators.servo_limits import LimitTest, servo_values, tested_limits
from sysid_bench.apps.actuators.written_model import (
    JointSettings,
    largest_difference,
    replay_positions,
    settings_text,
    torque_limits,
    written_mjcf,
)
from sysid_bench.commands.identify import WORSE, Identify
from sysid_bench.commands.identify_result import REPORTED
from sysid_bench.commands.result import file_text
from sysid_bench.commands.write_model import check_files, check_output_files, format_of
from sysid_bench.diagnosis.finding import WARNING, Finding
from sysid_bench.errors import UnsupportedError, UsageError, first_names, unknown_name
from sysid_bench.evaluation.baselines import FILE, ZERO, ZERO_TORQUE, Baselines
from sysid_bench.evaluation.torque_errors import known_rms, loaded_joints, rms
from sysid_bench.experiments.recorded.model_prior import MODEL
from sysid_bench.experiments.recorded.prepare import TERMS_TOO
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log
from sysid_bench.signals.log_samples import scalar_kinds
from sysid_bench.signals.position_control import DELAY
from sysid_bench.types import Array

METHOD: Final = "bounded least squares"
MISSTATED: Final = 2.0
"""Factor by which stated gains are named wrong: within it torque constants and links may be."""
SERVO_LIMITS: Final = "limits"
"""Word of --also for limits of position controllers, which data keep or drop."""
REPEATED: Final = 1e-6
"""rad, m; a written file whose simulated positions differ by more is not the identified robot."""
NO_USE: Final = (
    *("estimator", "terms", "pipeline", "complete", "filter", "derivatives", "moving", "seed"),
    *("choose", "position_given", "figure", "prior", "feasible"),
)
"""Options of an identification that bounded least squares of actuators does not have."""


def identify_actuators(request: Identify) -> ActuatorsResult:
    """Identify armature, friction, offset and, where it is unknown, the delay of commands.

    Raises UsageError for descriptions, files, names or options that cannot be used and for
    contradictions in the data that `accept` does not name, EstimationError for unknown gains of
    joints that move against their commands.
    """
    _check_options(request)
    training, tests = request.recordings()
    logs = [*training, *tests.values()]
    manifest = find_manifest(str(request.model), request.robots_dir)
    is_floating = load_robot(manifest).floating
    # Joints without a log are locked: nothing is known of their motion.
    manifest = drive_manifest(manifest, logs)
    model_out = _check_targets(request, load_robot(manifest))
    check_output_files(request.files, None, logs)
    # Without tests the end of each recording is judged, and not fitted.
    share = 1.0 if tests else FITTED
    fits = [read_part(log, manifest, request.findings) for log in training]
    others = [read_part(log, manifest, request.findings) for log in tests.values()] or fits
    parts = [part.fit_part(share) for part in fits]
    judged = [part.test_part(share) for part in others]
    joints, delay = parts[0].log.joints, known_delay(parts)
    more = _unknowns(request, joints)

    def single_rows(bias: Array | None) -> list[DriveRows]:
        return [drive_rows(p.robot, p.log, joints, p.rows, more, bias) for p in parts]

    found = identify_recordings(lambda b: pooled_rows(single_rows(b)), request.share, delay)
    limits: tuple[LimitTest, ...] = ()
    if SERVO_LIMITS in request.also:
        _check_simulated(parts[0])
        limits = tested_limits(parts, found, request.share)
        rows = replace(found.rows, servo=servo_values(limits))
        found = identify_drives(rows, request.share, delay)
    # Judged on what was not fitted: residuals of the fit say little of a rollout.
    errors = _DriveErrors(found, judged, parts)
    result = ActuatorsResult(
        model=manifest.name,
        file=str(manifest.path),
        task=request.task,
        shared=list(request.share),
        warnings=[*_base_warnings(training[0].base is not None, is_floating),
                  *_warnings(parts, errors)],
        **_fields(parts, errors),
        limits=limit_fields(limits, found) or None,
    )  # fmt: skip
    result = judged_result(result, errors.baselines, WORSE in request.accept)
    # At the bias of all files: their values then differ by the recordings alone.
    singles = single_rows(found.rows.bias) if len(parts) > 1 else []
    singles = [replace(rows, servo=found.rows.servo) for rows in singles]
    serials = [part.log.description.serial for part in parts]
    result = replace(result, **file_fields(singles, request.share, delay, result.joints, serials))
    result = replace(result, configurations=_configurations(result, found, judged[0]))
    return result if model_out is None else _with_model(result, model_out, found, judged[0])


def _check_options(request: Identify) -> None:
    """Raise UsageError for options that have no use here."""
    usual: dict[str, list[Any]] = {one.name: [one.default, []] for one in fields(request)}
    usual["prior"].append(MODEL)
    usual["feasible"].append(TERMS_TOO)
    given = [name for name in NO_USE if getattr(request, name) not in usual[name]]
    if given:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError(
            f"{options}: not for the task {request.task!r}, which has its own bounded least "
            "squares and signals; leave it out, or use the task 'robot'."
        )


def _unknowns(request: Identify, joints: Sequence[str]) -> tuple[str, ...]:
    """Further unknowns in the order of their columns; raise UsageError for an unknown name, and for
    words of --share that no joint holds."""
    for word in request.share:
        if not any(holds(joint, word) for joint in joints):
            advice = "Give words that the names of joints hold, or patterns such as '*_knee'."
            raise unknown_name("word of --share", word, joints, advice)
    for name in request.also:
        if name not in (*MORE, SERVO_LIMITS):
            raise unknown_name("unknown of --also", name, (*MORE, SERVO_LIMITS))
    return tuple(name for name in MORE if name in request.also)


def _check_simulated(part: DrivePart) -> None:
    """Raise UsageError where no positions are simulated, by which limits are judged."""
    reason = missing_simulation(part.robot)
    if part.log.commands is None:
        reason = "the torque was measured, so that no commands are known"
    if reason:
        raise UsageError(
            f"--also {SERVO_LIMITS}: limits are judged by simulated positions, but {reason}."
        )


def _check_targets(request: Identify, robot: RobotModel) -> Path | None:
    """Return the model file to write; raise UsageError or UnsupportedError, before the fit, for
    files that cannot be written."""
    model_out, json_out, _ = request.files
    check_files(robot, request.task, model_out, json_out)
    reason = missing_simulation(robot)
    if model_out is not None and format_of(model_out) != robot.format:
        raise UsageError(
            f"{str(model_out)!r}: the task 'actuators' writes {robot.manifest.path.name} in its "
            "own format, with the drives; name it with that suffix."
        )
    if model_out is not None and reason:
        raise UnsupportedError(
            f"--model-out: {reason}, so that a written file could not be checked; take the values "
            "from --json."
        )
    return model_out


# --- Errors on what was not fitted --------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _DriveErrors:
    """Errors (k,) of identified actuators on parts that were not fitted, beside those of
    `training`."""

    found: DriveEstimate
    parts: Sequence[DrivePart]
    training: Sequence[DrivePart]

    @property
    def reason(self) -> str:
        """Reason for which the robot is not simulated; empty if it is."""
        return missing_simulation(self.parts[0].robot)

    @cached_property
    def position_errors(self) -> dict[DrivePart, Array]:
        """Squared errors (n, k) of the simulated positions of each part; none of a measured torque,
        whose commands are not known, and of robots that are not simulated."""
        errors = {}
        for part in () if self.reason else self.parts:
            if part.log.commands is not None:
                commands = part.log.commands.of(self.found.rows.joints)
                q = simulated_positions(part.robot, self.found.drives, commands, part.rows)
                errors[part] = (q - commands.q[part.rows]) ** 2
        return errors

    @cached_property
    def _rows(self) -> DriveRows:
        """Rows of all parts."""
        of = self.found.rows
        return pooled_rows([
            replace(drive_rows(p.robot, p.log, of.joints, p.rows, of.more, of.bias), servo=of.servo)
            for p in self.parts
        ])  # fmt: skip

    def torque_rms(self, factors: Array) -> tuple[Array, Array]:
        """RMS of the torque, filtered, and of its error with some factors of the columns (k,)."""
        rows = self._rows
        tau = rows.torque(self.found.delay)
        error = tau - np.einsum("nkc,kc->nk", rows.features[..., : factors.shape[1]], factors)
        torque, error = (np.sqrt(np.mean(x**2, axis=0)) for x in (tau + rows.links, error))
        return torque, error

    def torque_ratio(self, factors: Array) -> Array:
        """RMS error of the torque over its RMS (k,); NaN for joints with hardly any torque."""
        kind, (torque, error) = scalar_kinds(self.parts[0].robot), self.torque_rms(factors)
        # A share of hardly any torque is that of noise.
        loaded = loaded_joints(torque, [kind[name] for name in self.found.rows.joints])
        return np.asarray(np.divide(error, torque, out=np.full_like(error, np.nan), where=loaded))

    @cached_property
    def positions(self) -> PositionBaselines:
        """Errors of positions without an identification, joint by joint."""
        return position_baselines(list(self.position_errors), self.found, self.training)

    @cached_property
    def baselines(self) -> Baselines:
        """Baselines that an answer has to beat: of positions, or of torques where none are
        simulated."""
        if self.position_errors:
            return self.positions.baselines
        own = model_values(self.parts[0].robot, self.found.rows.joints)
        null = known_rms(x if np.isfinite(x) else None for x in self.torque_ratio(own).tolist())
        return Baselines(({} if null is None else {FILE: null}) | {ZERO: ZERO_TORQUE})


# --- Fields -------------------------------------------------------------------------------------


def _fields(parts: Sequence[DrivePart], judged: _DriveErrors) -> dict[str, Any]:
    """Fields of the fit and of its errors."""
    found, errors = judged.found, judged.position_errors
    ratio = judged.torque_ratio(found.fit.factors)
    names = list(found.rows.joints)
    commands = None if parts[0].log.commands is None else parts[0].log.commands.of(names)
    squares = np.concatenate(list(errors.values())) if errors else None
    scores = dict.fromkeys(REPORTED) | {
        "rank": found.rank,
        "parameters": found.parameters,
        "rmse_train": rms(found.fit.errors),
        "rmse_test": rms(judged.torque_rms(found.fit.factors)[1]),
        "torque_error": known_rms(x if np.isfinite(x) else None for x in ratio.tolist()),
        "rollout_error": None if squares is None else float(np.sqrt(squares.mean())),
        # Bounded least squares always ends, with values that can exist.
        "feasible": True,
        "converged": True,
        "stop": "",
    }
    scores |= baseline_scores(judged.baselines, scores)
    return {
        "terms": [*UNKNOWNS, *found.rows.more],
        "rows": names,
        "estimator": METHOD,
        "scores": scores,
        **delay_fields(found),
        "joints": joint_fields(found, squares, judged.positions, ratio),
        "covariance": covariance_fields(names, found.covariance),
        "judged": [
            {
                "log": part.name,
                "from": part.times[0],
                "to": part.times[1],
                "rollout": float(np.sqrt(of_part.mean())),
            }
            for part, of_part in errors.items()
        ],
        "seconds": sum(part.times[1] - part.times[0] for part in parts),
        "std_from": "residuals",
        "std_limit": LIMITS["residuals"],
        "motors": motor_fields(parts[0].log, found) or None,
        "gains": gain_fields(found.gains, names) or None,
        "lost_motion": None if commands is None else lost_motion_fields(found, commands.kp[-1]),
        "resolution": resolution_fields(parts[0].log) or None,
        "magnitude": magnitude_fields(found, parts) or None,
    }


def _configurations(
    result: ActuatorsResult, found: DriveEstimate, part: DrivePart
) -> dict[str, str]:
    """Configurations of simulators for the gains and limits that act on the last sample, as in a
    written model; none of a measured torque."""
    if part.log.commands is None:
        return {}
    commands = found.drives.apply(part.log.commands.of(result.rows))
    limits, kinds = torque_limits(part.robot, commands), scalar_kinds(part.robot)
    speeds = found.rows.servo.get("speed-limit", np.full(len(limits), np.inf))
    settings = {
        name: JointSettings(
            kp=float(commands.kp[-1, j]),
            kd=float(commands.kd[-1, j]),
            limit=float(limits[j]),
            armature=joint["Ia"],
            damping=joint["fv"],
            friction=joint["fc"],
            slides=kinds[name] == "slide",
            speed=float(speeds[j]),
        )
        for j, (name, joint) in enumerate(result.joints.items())
    }
    # Between files where there are several: the interval of one profile holds for an exact model
    # alone.
    low, high = result.delay_interval or (result.delay, result.delay)
    if result.std_from == "files" and result.files is not None:
        low, high = result.files["delay"]["low"], result.files["delay"]["high"]
    return settings_text(settings, (max(low, 0.0), max(high, 0.0)))


def _base_warnings(is_recorded: bool, is_floating: bool) -> list[str]:
    """Sentence about a floating base, with or without its recorded motion."""
    if is_recorded:
        return ["the base moves as recorded: feet must not touch the ground"]
    if not is_floating:
        return []
    return ["the base is held fixed: feet must not touch the ground, and the trunk must not move"]


def _warnings(parts: Sequence[DrivePart], judged: _DriveErrors) -> Iterator[str]:
    """Repairs of the model and findings in the recordings, but for the delay that is found; a
    missing simulation; a delay at the end of those that were tried."""
    findings = [
        f"{part.name}: {one.text}"
        for part in parts
        for one in part.log.findings
        if one.name != DELAY
    ]
    yield from dict.fromkeys([*parts[0].robot.repairs, *findings])
    if judged.reason:
        yield f"no rollout: {judged.reason}"
    found = judged.found
    if parts[0].log.commands is not None and not found.gains:
        for one in stated_gains(found.rows, found.groups, found.delay):
            low, high = one.interval
            if not one.is_open and (low > MISSTATED or high < 1.0 / MISSTATED):
                names = first_names([found.rows.joints[j] for j in one.joints])
                yield (
                    f"the gains that fit are {one.gain:.3g} ({low:.3g} to {high:.3g}) times the "
                    f"stated kp and kd of {names}; armature, friction and offset are wrong by that "
                    "factor. Correct tau.pd, or take the stated gains as a start: --also gain"
                )
    profile = found.profile
    if profile is not None and profile.ahead:
        yield (
            "a delay below zero would fit better: q_des is stamped later than it acts; check its "
            "times"
        )
    elif profile is not None and profile.on_edge:
        yield (
            f"the delay is the longest that was tried, {1e3 * found.delay:.3g} ms: check "
            "the times of q_des, or state a delay"
        )


# --- The written model --------------------------------------------------------------------------


def _with_model(
    result: ActuatorsResult, target: Path, found: DriveEstimate, judged: DrivePart
) -> ActuatorsResult:
    """Write the model, read it again by MuJoCo alone, and repeat the judged simulation.

    Raises UsageError where the torque was measured, so that gains are not known.
    """
    if judged.log.commands is None:
        raise UsageError(
            "A model with position actuators needs their gains: describe the torque by tau = { pd "
            "= { q_des = ..., kp = ..., kd = ... } }, or use the values of --json."
        )
    robot, commands = judged.robot, judged.log.commands.of(found.rows.joints)
    target.write_text(written_mjcf(robot, found.drives, commands), encoding="utf-8")
    # Reason for which a written file is not the robot that was simulated.
    reason = ""
    if robot.manifest.locked:
        reason = "joints are locked"
    elif robot.manifest.free_base:
        reason = "the file may hold the base"
    elif robot.payload_body is not None:
        reason = "the file has no payload"
    elif lacking := [x for x in ("speed-limit", "dead-band") if x in found.rows.servo]:
        reason = f"MJCF has no {' and no '.join(lacking)} of position controllers"
    gap, warnings = None, result.warnings
    if not reason:
        again = replay_positions(target, found.drives.apply(commands), judged.rows)
        simulated = simulated_positions(robot, found.drives, commands, judged.rows)
        bias = found.drives.more.get("bias", np.zeros(len(commands.joints)))
        # Both simulate the same drives: beyond rounding they may differ by what else stands in the
        # file.
        gap = largest_difference(again, simulated + bias)
        if gap > REPEATED:
            warning = (
                f"{target} does not repeat the simulation: positions differ by up to {gap:.1e} "
                "rad (m); other actuators, tendons or options of the file may act"
            )
            warnings = [*warnings, warning]
    written = {"file": str(target), "gap": gap, "reason": reason}
    return replace(result, model_out=file_text(target), written=written, warnings=warnings)


# --- Diagnosis ----------------------------------------------------------------------------------


def command_delay(robot: RobotModel, log: Log, findings: Sequence[Finding]) -> list[Finding]:
    """Return a finding where a delay below zero fits the commands of a position controller better;
    none behind contradictions, which a fit would inherit."""
    if log.commands is None or log.commands.delay is not None:
        return []
    if any(one.is_error for one in findings):
        return []
    profile = identify_drives(drive_rows(robot, log, log.joints)).profile
    if profile is None or not profile.ahead:
        return []
    return [
        Finding(
            name="delay",
            severity=WARNING,
            message="commands act before they are stamped: a delay below zero fits better",
            joints=log.joints,
            blind="a delay of the drive that is longer than the stamps are late",
            edit="check when the controller stores q_des, and shift its column by a sample",
        )
    ]
