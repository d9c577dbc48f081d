"""Diagnosis of recordings: what contradicts the model or physics, and what cures it."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from sysid_bench.commands.result import OMIT_NONE, Result, file_text
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, NOTE, SEVERITIES, Finding
from sysid_bench.diagnosis.hypothesis import first_hypothesis
from sysid_bench.diagnosis.run_checks import contradictions_left
from sysid_bench.diagnosis.run_checks import diagnose as findings_of
from sysid_bench.errors import UsageError, count_text, unknown_name
from sysid_bench.experiments.recorded.process_log import ProcessedLog, lock_manifest, payload_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.reporting.html import TorqueFit, write_findings_html
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_data import LogLike, log_list
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.verbs.recorded.find_description import find_description
from sysid_bench.words import FINDINGS

PathLike = str | Path


@dataclass(frozen=True, kw_only=True)
class DiagnoseRequest:
    """Diagnosis of recordings described by TOML files, or in memory.

    `model`: a robot's name, a URDF or an MJCF file. `accept`: names of contradictions behind which
    the checks go on. `html`: a page with figures; `json_out`: the result as a file.
    """

    logs: tuple[Path | LogDescription, ...]
    model: str
    accept: tuple[str, ...] = ()
    html: Path | None = None
    json_out: Path | None = None
    robots_dir: Path | None = None


@dataclass(frozen=True, eq=False, repr=False)
class DiagnoseResult(Result):
    """Findings in recordings, those of each log in the order of the checks.

    `ok`: no contradiction but accepted ones. `logs`: samples, rate and the residual of each joint
    after the fit near the model, relative to its RMS torque. `findings`: log, name, severity,
    message, joints, explains, confidence, blind, edit.
    """

    model: str
    file: str
    ok: bool
    accepted: list[str]
    logs: list[dict[str, Any]]
    findings: list[dict[str, Any]]
    html: str | None = field(default=None, metadata=OMIT_NONE)

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """One line per finding, the gravest of each group first, with its cure."""
        lines = [line for log in self.logs for line in self._lines_of(log)]
        return "\n".join(lines + ([f"  page: {self.html}"] if self.html else []))

    def _lines_of(self, log: Mapping[str, Any]) -> list[str]:
        found = [finding for finding in self.findings if finding["log"] == log["log"]]
        counts = Counter(finding["severity"] for finding in found)
        words = [count_text(counts[severity], severity) for severity in SEVERITIES]
        head = (
            f"{log['log']}: {self.model}, {log['samples']} samples, {log['rate']:.4g} Hz: "
            f"{', '.join(words)}"
        )
        return [head, *chain.from_iterable(map(_finding_lines, found))]


def _finding_lines(finding: Mapping[str, Any]) -> list[str]:
    share = finding["explains"]
    explains = "" if share is None else f" [explains {100 * share:.0f} %]"
    lines = [f"  {finding['severity']}: {finding['name']}: {finding['message']}{explains}"]
    if finding["edit"]:
        lines.append(f"      cure: {finding['edit']}")
    if finding["blind"] and finding["severity"] == ERROR:
        lines.append(f"      blind for: {finding['blind']}")
    return lines


def diagnose(
    log: LogLike | Sequence[LogLike] | DiagnoseRequest,
    model: str | Path = "",
    *,
    accept: Sequence[str] = (),
    html: PathLike | None = None,
    json_out: PathLike | None = None,
    robots_dir: Path | None = None,
) -> DiagnoseResult:
    """Diagnose the recordings `log` of a robot; a request stands for all arguments.

    A recording is the path of its description, or numbers in memory: see `sysid_bench.log_of`.
    Raises UsageError for descriptions, files or names that cannot be used.
    """
    request = log if isinstance(log, DiagnoseRequest) else DiagnoseRequest(
        logs=log_list(log, "log"), model=str(model), accept=tuple(accept),
        html=None if html is None else Path(html),
        json_out=None if json_out is None else Path(json_out), robots_dir=robots_dir,
    )  # fmt: skip
    result = _diagnosed(request)
    if request.json_out is not None:
        result.write_json(request.json_out)
    return result


def _diagnosed(request: DiagnoseRequest) -> DiagnoseResult:
    _check(request)
    manifest = find_manifest(request.model, request.robots_dir)
    logs = [find_description(log) for log in request.logs]
    names = [str(log.source) for log in logs]
    evidence = [_evidence_of(manifest, log) for log in logs]
    found = [_findings(one, request.accept) for one in evidence]
    findings = list(chain.from_iterable(map(_fields_of, names, found)))
    if request.html is not None:
        torques = list(map(_torque, names, evidence))
        write_findings_html(request.html, f"Diagnosis: {manifest.name}", findings, torques)
    return DiagnoseResult(
        model=manifest.name,
        file=str(manifest.path),
        ok=not any(contradictions_left(part, request.accept) for part in found),
        accepted=list(request.accept),
        logs=list(map(_log_fields, names, evidence)),
        findings=findings,
        html=file_text(request.html),
    )


def _fields_of(log: str, findings: Sequence[Finding]) -> list[dict[str, Any]]:
    return [{"log": log, **finding.to_json()} for finding in findings]


def _findings(evidence: DiagnoseInput, accept: Collection[str]) -> list[Finding]:
    """Findings on a recording, that on the delay of its commands last."""
    # A fit of actuators loads for longer than a recording with measured torque is judged.
    from sysid_bench.verbs.recorded.command_delay import command_delay

    findings = findings_of(evidence, accept)
    return [*findings, *command_delay(evidence.robot, evidence.log, findings)]


def _check(request: DiagnoseRequest) -> None:
    """Raise UsageError for a request without a model or a log, or with unknown names."""
    if not request.model or not request.logs:
        raise UsageError(
            "Which recording of which robot? Give both: sysid-bench diagnose run.toml --model ur5."
        )
    for name in request.accept:
        if name not in FINDINGS:
            raise unknown_name("finding", name, FINDINGS, "Give --accept the names to let pass.")


def _evidence_of(manifest: Manifest, log: LogDescription) -> DiagnoseInput:
    """Read one recording of a robot, with those joints locked that it does not list."""
    locked = lock_manifest(manifest, load_robot(manifest), [log])
    robot = load_robot(locked, payload_of(log))
    if not log.has_torque:
        raise UsageError(
            f"{log.source} has no torques of joints, which are what is diagnosed; write tau = "
            "{ columns = [...] }."
        )
    return DiagnoseInput(read_log(log, robot), robot)


def check_contradictions(logs: Sequence[ProcessedLog], accept: Collection[str]) -> list[str]:
    """Diagnose recordings that are about to be used; return their warnings, and the contradictions
    that are accepted, as sentences.

    Raises UsageError for contradictions that are not accepted.
    """
    with_torque = (log for log in logs if log.log.description.has_torque)
    return list(chain.from_iterable(_torque_warnings(log, accept) for log in with_torque))


def _torque_warnings(log: ProcessedLog, accept: Collection[str]) -> list[str]:
    """Warnings on the torque of joints; UsageError for contradictions that are not accepted."""
    source = log.log.description.source
    findings = findings_of(DiagnoseInput(log.log, log.robot), accept)
    wrong = contradictions_left(findings, accept)
    if wrong:
        raise UsageError(_refusal(str(source), wrong))
    return [f"{source.name}: {one.message}" for one in findings if one.severity != NOTE]


def _refusal(source: str, wrong: Sequence[Finding]) -> str:
    names = ",".join(dict.fromkeys(one.name for one in wrong))
    texts = "; ".join(f"{one.message} (cure: {one.edit})" for one in wrong)
    return f"{source}: {texts}. Fix the description, or go on with --accept {names}."


def _log_fields(name: str, evidence: DiagnoseInput) -> dict[str, Any]:
    residual = first_hypothesis(evidence).fit.residual
    recording = evidence.log.recording
    return {
        "log": name,
        "samples": evidence.log.samples,
        "rate": recording.rate,
        "seconds": float(np.ptp(recording.t)),
        "residual": dict(zip(evidence.joints, residual.tolist(), strict=True)),
    }


def _torque(name: str, evidence: DiagnoseInput) -> TorqueFit:
    motion, measured = evidence.fit_samples
    fitted = evidence.predict(first_hypothesis(evidence).fit)
    t = np.linspace(0.0, float(np.ptp(evidence.log.recording.t)), len(motion))
    units = ["N m" if kind == "hinge" else "N" for kind in evidence.kinds]
    return TorqueFit(name, t, evidence.joints, measured, fitted, units)
