"""Verb `diagnose`: what contradicts the model or physics in recordings, and what cures it."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.request import FAILED, OK, Request, argument, option
from sysid_bench.commands.result import OMIT_NONE, Result, file_text
from sysid_bench.commands.values import parse_names
from sysid_bench.errors import UsageError, count_text, unknown_name
from sysid_bench.words import FINDINGS

if TYPE_CHECKING:
    from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
    from sysid_bench.diagnosis.finding import Finding
    from sysid_bench.experiments.recorded.process_log import ProcessedLog
    from sysid_bench.models.manifest import Manifest
    from sysid_bench.reporting.html import TorqueFit
    from sysid_bench.signals.log_data import LogLike
    from sysid_bench.signals.log_description import LogDescription

PathLike = str | Path

ACTUATORS: Final = "actuators"
"""Task of position-commanded robots, which judges the time of their commands."""


class DiagnoseRequest(Request["DiagnoseResult"]):
    """Find what is wrong with recordings: signs, units, columns, gains, time, missing terms.

    Exit code 1 where a recording contradicts its model or physics.
    """

    logs: tuple[Any, ...] = argument("LOG.toml...", several=True, path="new", complete="files")
    model: str = option("Robot: a name or a model file.", metavar="MODEL", complete="robots files")
    accept: tuple[str, ...] = option(
        "Contradictions behind which the checks go on.",
        default=(), metavar="rate,gain", parse=parse_names, complete="findings", separated=True,
    )  # fmt: skip
    html: Path | None = option(
        "A page with figures.", default=None, metavar="FILE.html", complete="files"
    )
    json_out: Path | None = None
    robots_dir: Path | None = None

    def run(self) -> "DiagnoseResult":
        """Return the findings in recordings: paths of their descriptions, or numbers in memory.

        Raises UsageError for descriptions, files or names that cannot be used.
        """
        from sysid_bench.diagnosis.run_checks import contradictions_left
        from sysid_bench.models.manifest import find_manifest
        from sysid_bench.reporting.html import write_findings_html
        from sysid_bench.signals.log_description import find_description

        self._check()
        manifest = find_manifest(self.model, self.robots_dir)
        inputs = [_input_of(manifest, find_description(log)) for log in self.logs]
        found = [_findings(one, self.accept) for one in inputs]
        findings = [
            {"log": str(one.log.description.source), **finding.to_json()}
            for one, part in zip(inputs, found, strict=True)
            for finding in part
        ]
        if self.html is not None:
            title = f"Diagnosis: {manifest.name}"
            write_findings_html(self.html, title, findings, [_torque(one) for one in inputs])
        result = DiagnoseResult(
            model=manifest.name,
            file=str(manifest.path),
            ok=not any(contradictions_left(part, self.accept) for part in found),
            accepted=list(self.accept),
            logs=[_log_fields(one) for one in inputs],
            findings=findings,
            html=file_text(self.html),
        )
        if self.json_out is not None:
            result.write_json(self.json_out)
        return result

    def _check(self) -> None:
        if not self.model or not self.logs:
            raise UsageError(
                "Which recording of which robot? Give both: sysid-bench diagnose run.toml --model "
                "ur5."
            )
        for name in self.accept:
            if name not in FINDINGS:
                advice = "Give --accept the names to let pass."
                raise unknown_name("finding", name, FINDINGS, advice)

    def exit_code(self, result: "DiagnoseResult") -> int:
        return OK if result.ok else FAILED

    def plugins(self) -> Iterable[tuple[str, str | None]]:
        from sysid_bench.experiments.third_party import reader_names

        return reader_names(self.logs)


def diagnose(
    log: "LogLike | Sequence[LogLike] | DiagnoseRequest",
    model: str | Path = "",
    *,
    accept: Sequence[str] = (),
    html: PathLike | None = None,
    json_out: PathLike | None = None,
    robots_dir: Path | None = None,
) -> "DiagnoseResult":
    """Diagnose the recordings `log` of a robot; a request stands for all arguments.

    A recording is the path of its description, or numbers in memory: see `sysid_bench.log_of`.
    `accept`: names of contradictions behind which the checks go on. `html`: a page with figures;
    `json_out`: the result as a file. Raises UsageError for descriptions, files or names that
    cannot be used.
    """
    from sysid_bench.signals.log_data import log_list

    request = log if isinstance(log, DiagnoseRequest) else DiagnoseRequest(
        logs=log_list(log, "log"), model=str(model), accept=tuple(accept),
        html=None if html is None else Path(html),
        json_out=None if json_out is None else Path(json_out), robots_dir=robots_dir,
    )  # fmt: skip
    return request.run()


@dataclass(frozen=True, eq=False, repr=False)
class DiagnoseResult(Result):
    """Findings in recordings, those of each log in the order of the checks.

    `ok`: no contradiction but accepted ones. `logs`: samples, rate and the residual of each joint
    after the fit near the model, relative to its RMS torque. `findings`: log, name, severity,
    message, joints, explains, confidence, blind, edit; `alternatives` of a contradiction: all
    explanations of it, the best first, each with name, joints, estimate, interval, explains,
    evidence, message, edit, text.
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
        lines = [line for log in self.logs for line in self._log_lines(log)]
        return "\n".join(lines + ([f"  page: {self.html}"] if self.html else []))

    def _log_lines(self, log: Mapping[str, Any]) -> list[str]:
        from sysid_bench.diagnosis.finding import ERROR, SEVERITIES

        found = [finding for finding in self.findings if finding["log"] == log["log"]]
        counts = Counter(finding["severity"] for finding in found)
        words = [count_text(counts[severity], severity) for severity in SEVERITIES]
        lines = [
            f"{log['log']}: {self.model}, {log['samples']} samples, {log['rate']:.4g} Hz: "
            f"{', '.join(words)}"
        ]
        for finding in found:
            share = finding["explains"]
            explains = "" if share is None else f" [explains {100 * share:.0f} %]"
            lines.append(
                f"  {finding['severity']}: {finding['name']}: {finding['message']}{explains}"
            )
            if finding["edit"]:
                lines.append(f"      cure: {finding['edit']}")
            rivals = [one["text"] for one in finding["alternatives"][1:]]
            if rivals:
                lines.append(f"      other explanations: {'; '.join(rivals)}")
            if finding["blind"] and finding["severity"] == ERROR:
                lines.append(f"      blind for: {finding['blind']}")
        return lines


def check_contradictions(logs: "Sequence[ProcessedLog]", accept: Collection[str]) -> list[str]:
    """Diagnose recordings that are about to be used; return their warnings, and the contradictions
    that are accepted, as sentences.

    Raises UsageError for contradictions that are not accepted.
    """
    from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
    from sysid_bench.diagnosis.finding import NOTE
    from sysid_bench.diagnosis.run_checks import contradictions_left
    from sysid_bench.diagnosis.run_checks import diagnose as findings_of

    warnings: list[str] = []
    for log in logs:
        description = log.log.description
        # A recording behind a force/torque sensor has no joint torques: nothing here can judge it.
        if not description.has_torque:
            continue
        source = description.source
        findings = findings_of(DiagnoseInput(log.log, log.robot), accept)
        wrong = contradictions_left(findings, accept)
        if wrong:
            names = ",".join(dict.fromkeys(one.name for one in wrong))
            texts = "; ".join(f"{one.message} (cure: {one.edit})" for one in wrong)
            raise UsageError(
                f"{source}: {texts}. Fix the description, or go on with --accept {names}."
            )
        told = [one for one in findings if one.severity != NOTE or one.name == "non-finite"]
        warnings += [f"{source.name}: {one.message}" for one in told]
    return warnings


def _input_of(manifest: "Manifest", log: "LogDescription") -> "DiagnoseInput":
    """Read one recording of a robot, with those joints locked that it does not list."""
    from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
    from sysid_bench.experiments.recorded.process_log import lock_manifest, payload_of
    from sysid_bench.models.load import load_robot
    from sysid_bench.signals.log import read_log

    locked = lock_manifest(manifest, load_robot(manifest), [log])
    robot = load_robot(locked, payload_of(log))
    if not log.has_torque:
        raise UsageError(
            f"{log.source} has no torques of joints, which are what is diagnosed; write tau = "
            "{ columns = [...] }."
        )
    return DiagnoseInput(read_log(log, robot), robot)


def _findings(evidence: "DiagnoseInput", accept: Collection[str]) -> "list[Finding]":
    """Findings on a recording; of a position controller that on the delay of its commands last."""
    from sysid_bench.commands.task_terms import verb_of_task
    from sysid_bench.diagnosis.run_checks import diagnose as findings_of
    from sysid_bench.experiments.tasks.task import find_task

    findings = findings_of(evidence, accept)
    if evidence.log.commands is not None:
        command_delay = verb_of_task(find_task(ACTUATORS), "diagnose")
        assert command_delay is not None
        findings += command_delay(evidence.robot, evidence.log, findings)
    return findings


def _log_fields(one: "DiagnoseInput") -> dict[str, Any]:
    from sysid_bench.diagnosis.hypothesis import first_hypothesis

    residual, recording = first_hypothesis(one).fit.residual.tolist(), one.log.recording
    return {
        "log": str(one.log.description.source),
        "samples": one.log.samples,
        "rate": recording.rate,
        "seconds": float(recording.t.max() - recording.t.min()),
        "residual": dict(zip(one.joints, residual, strict=True)),
    }


def _torque(one: "DiagnoseInput") -> "TorqueFit":
    import numpy as np

    from sysid_bench.diagnosis.hypothesis import first_hypothesis
    from sysid_bench.reporting.html import TorqueFit

    motion, measured = one.fit_samples
    t = np.linspace(0.0, float(np.ptp(one.log.recording.t)), len(motion))
    units = ["N m" if kind == "hinge" else "N" for kind in one.kinds]
    fitted = one.predict(first_hypothesis(one).fit)
    return TorqueFit(str(one.log.description.source), t, one.joints, measured, fitted, units)
