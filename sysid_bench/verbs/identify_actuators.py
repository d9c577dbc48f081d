"""Identification of actuators from recordings of a robot with known links."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.actuators.bounded_fit import SIGNED
from sysid_bench.actuators.drive_rows import UNKNOWNS, drive_rows, pooled_rows
from sysid_bench.actuators.identified import Identified, identify_drives
from sysid_bench.actuators.rollout import MARGIN, simulated_positions
from sysid_bench.actuators.written_model import (
    largest_difference,
    replayed_positions,
    written_mjcf,
)
from sysid_bench.errors import UsageError
from sysid_bench.experiments.recorded.lock_manifest import lock_manifest
from sysid_bench.experiments.recorded.preprocess import payload_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_checks import check_findings
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array
from sysid_bench.verbs.actuators_fields import LIMITS, delay_fields, file_fields, joint_fields
from sysid_bench.verbs.actuators_result import ActuatorsResult
from sysid_bench.verbs.identify_recorded import RecordedRequest, described_logs
from sysid_bench.verbs.result import file_text
from sysid_bench.verbs.write_model import check_files

METHOD: Final = "bounded least squares"

FITTED: Final = 0.6
"""Share of each recording that is fitted where no test recording is given; the rest is judged."""

_OTHERS: Final = (
    *("estimator", "terms", "pipeline", "complete", "filter", "derivatives", "moving"),
    *("choose", "position_given", "figure"),
)
"""Options of an identification that bounded least squares of actuators does not have."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Samples `rows` of a log, with the robot that moved in it."""

    log: Log
    robot: RobotModel
    rows: slice

    @property
    def name(self) -> str:
        return self.log.description.source.name

    @property
    def seconds(self) -> tuple[float, float]:
        """First and last time (s)."""
        first, last, _ = self.rows.indices(len(self.log.recording))
        return first / self.log.recording.rate, last / self.log.recording.rate


@dataclass(frozen=True, eq=False)
class _Judged:
    """Errors (k,) of identified actuators on parts that were not fitted."""

    found: Identified
    parts: Sequence[_Part]

    @cached_property
    def rollouts(self) -> list[Array]:
        """Squared errors (n, k) of the simulated positions of each part; none of a measured torque,
        whose commands are not known."""
        joints = self.found.rows.joints
        return [
            (simulated_positions(part.robot, self.found.drives, commands, part.rows)
             - commands.q[part.rows]) ** 2
            for part in self.parts
            if part.log.commands is not None
            for commands in [part.log.commands.of(joints)]
        ]  # fmt: skip

    @cached_property
    def torques(self) -> tuple[Array, Array]:
        """RMS of the torque, filtered, and of its error (k,)."""
        joints = self.found.rows.joints
        rows = pooled_rows([drive_rows(p.robot, p.log, joints, p.rows) for p in self.parts])
        tau = rows.torque(self.found.delay)
        error = tau - np.einsum("nkc,kc->nk", rows.features, self.found.fit.values)
        return _rms(tau + rows.links), _rms(error)


def identify_actuators(request: RecordedRequest) -> ActuatorsResult:
    """Identify armature, friction, offset and, where it is unknown, the delay of commands.

    Raises UsageError for descriptions, files, names or options that cannot be used and for
    contradictions in the data that `accept` does not name.
    """
    _check_options(request)
    training, tests = described_logs(request)
    manifest = find_manifest(request.model, request.robots_dir)
    manifest = lock_manifest(manifest, load_robot(manifest), [*training, *tests.values()])
    check_files(load_robot(manifest), request.task, request.model_out, request.json_out)
    logs = [_read(log, manifest, request.accept) for log in training]
    others = [_read(log, manifest, request.accept) for log in tests.values()]
    share = 1.0 if others else FITTED
    parts = [_cut(log, slice(0, int(share * len(log.log.recording)))) for log in logs]
    judged = [_cut(log, _rest(log, share)) for log in (others or logs)]
    joints = parts[0].log.joints
    singles = [drive_rows(part.robot, part.log, joints, part.rows) for part in parts]
    delay = _delay(parts)
    found = identify_drives(pooled_rows(singles), request.share, delay)
    result = _result(request, manifest, parts, _Judged(found, judged))
    result = replace(result, **file_fields(singles, request.share, delay))
    if request.model_out is None:
        return result
    return replace(result, **_written(request.model_out, found, judged[0]))


def _check_options(request: RecordedRequest) -> None:
    given = [f"--{name.replace('_', '-')}" for name in _OTHERS if getattr(request, name)]
    if given:
        raise UsageError(
            f"{', '.join(given)}: not for the task {request.task!r}, which has its own bounded "
            "least squares and signals; leave it out, or use the task 'robot'."
        )


def _read(log: LogDescription, manifest: Manifest, accept: Sequence[str]) -> _Part:
    robot = load_robot(manifest, payload_of(log))
    found = read_log(log, robot)
    check_findings(found.findings, accept, str(log.source))
    return _Part(found, robot, slice(None))


def _cut(part: _Part, rows: slice) -> _Part:
    return replace(part, rows=rows)


def _rest(part: _Part, share: float) -> slice:
    """Samples that are judged: those after the fitted ones, or all of a test recording."""
    count = len(part.log.recording)
    first = 0 if share == 1.0 else int(share * count)
    return slice(first, max(count - MARGIN, first + 1))


def _delay(parts: Sequence[_Part]) -> float | None:
    """The stated delay (s), zero for measured torques; None where it is unknown.

    Raises UsageError where the recordings differ in it.
    """
    stated = {0.0 if p.log.commands is None else p.log.commands.delay for p in parts}
    if len(stated) > 1:
        raise UsageError(
            "The recordings state different delays (tau.pd.delay); identify them one by one, or "
            "write delay = 'profile' in all of them."
        )
    return stated.pop()


def _result(
    request: RecordedRequest, manifest: Manifest, parts: Sequence[_Part], judged: _Judged
) -> ActuatorsResult:
    found = judged.found
    torque, error = judged.torques
    rollouts = judged.rollouts
    names = list(found.rows.joints)
    pooled = np.concatenate(rollouts) if rollouts else None
    return ActuatorsResult(
        model=manifest.name,
        file=str(manifest.path),
        task=request.task,
        terms=list(UNKNOWNS),
        rows=names,
        estimator=METHOD,
        rank=_count(found) - int(found.fit.at_bound.sum()),
        data_rank=None,
        parameters=_count(found),
        rmse_train=_total(found.fit.errors),
        rmse_test=_total(error),
        torque_error=_total(error / np.maximum(torque, 1e-12)),
        rollout_error=None if pooled is None else float(np.sqrt(pooled.mean())),
        **delay_fields(found),
        joints=joint_fields(found, pooled, error / np.maximum(torque, 1e-12)),
        shared=list(request.share),
        files=None,
        judged=_periods(judged),
        seconds=sum(part.seconds[1] - part.seconds[0] for part in parts),
        std_from="residuals",
        std_limit=LIMITS["residuals"],
        warnings=[*_warnings(parts), *_edge_warning(found)],
    )


def _count(found: Identified) -> int:
    """Number of values: those of joints that share them count once."""
    distinct = {tuple(row[:SIGNED]) for row in found.fit.values.tolist()}
    return SIGNED * len(distinct) + len(found.rows.joints)


def _total(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))


def _periods(judged: _Judged) -> list[dict[str, Any]]:
    parts = [part for part in judged.parts if part.log.commands is not None]
    return [
        {
            "log": part.name,
            "from": part.seconds[0],
            "to": part.seconds[1],
            "rollout": float(np.sqrt(squares.mean())),
        }
        for part, squares in zip(parts, judged.rollouts, strict=True)
    ]


def _written(target: Path, found: Identified, judged: _Part) -> dict[str, Any]:
    """Write the model, read it again by MuJoCo alone, and repeat the judged simulation."""
    commands = judged.log.commands
    if commands is None:
        raise UsageError(
            "A model with position actuators needs their gains: describe the torque by tau = { pd "
            "= { q_des = ..., kp = ..., kd = ... } }, or use the values of --json-out."
        )
    commands = commands.of(found.rows.joints)
    text = written_mjcf(judged.robot, found.drives, commands)
    target.write_text(text, encoding="utf-8")
    gap = None
    if not judged.robot.manifest.locked and judged.robot.payload_body is None:
        again = replayed_positions(target, commands, judged.rows)
        gap = largest_difference(
            again, simulated_positions(judged.robot, found.drives, commands, judged.rows)
        )
    return {"model_out": file_text(target), "written": {"file": str(target), "gap": gap}}


def _edge_warning(found: Identified) -> list[str]:
    """Sentence about a delay at the end of those that were tried."""
    if found.profile is None or not found.profile.on_edge:
        return []
    return [
        f"the delay is the longest that was tried, {1e3 * found.delay:.3g} ms: check the times of "
        "q_des, or state a delay"
    ]


def _warnings(parts: Sequence[_Part]) -> list[str]:
    """Repairs of the model, and findings in the recordings."""
    found = [f"{part.name}: {f.text}" for part in parts for f in part.log.findings]
    return list(dict.fromkeys([*parts[0].robot.repairs, *found]))
